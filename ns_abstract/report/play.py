"""Compressed data with which a page shows a frame's bounds at any pose of its set, rounded outward.

On a leaf's box every pixel lies between two functions that are linear in the parameters
(`ns_abstract.refine.result.Leaves`). Their coefficients become whole multiples of one step; the error of that rounding
is added to the offsets, so that the shown bounds hold. Final bounds are whole multiples of a step, too.

Numbers are stored as differences from a prediction, modulo 2^16 (2^8 for images), which are small:

* ``lower``, ``image``: from the pixel to the left; ``upper`` and ``witness_lower``: from ``lower``; ``witness_upper``:
  from ``upper``; ``view_images``: from the view before;
* ``slope``, ``offset``: with one parameter and a leaf of the same tile before, from that leaf's slope, and from its
  offset moved on by both slopes; else from the pixel to the left; ``slope_more``, ``offset_more``: of the upper bound,
  from the lower one's.
"""

from __future__ import annotations

import base64
import json
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ns_abstract.refine.result import FrameResult, Leaves, mean_pixel_gap

#: Steps of finished bounds, and of leaves' coefficients if there are any, best first; the first that fits is taken.
LEVELS: tuple[tuple[int, int | None], ...] = (
    (10_000, 10_000),
    (1000, 1000),
    (1000, 250),
    (1000, 100),
    (10_000, None),
    (1000, None),
)
#: Room for float64 roundings, of the page's and of this module's evaluation.
_SLACK = 1e-12
#: Coefficients from here on, which say nothing of a value in [0, 1], are replaced.
_LARGE = 2.5
#: Every so many tiles tell how large all of them will be, and how sure that is.
_SAMPLED, _SURE = 8, 0.85


def play_data(result: FrameResult, most: int) -> str | None:
    """Return a frame's data for the page: a zlib stream of a JSON line and arrays, in base64.

    It holds the leaves' linear sets at the finest step that fits, else no leaves; None where nothing fits.
    """
    # one pose has nothing to move
    moves = result.leaves is not None and result.leaves.tile.shape[0] and result.box.dimensions
    leaves = result.leaves if moves else None
    for steps, finest in LEVELS:
        if finest is not None and leaves is None:
            continue
        head = {"steps": steps, "cell_steps": finest}
        arrays = _base(result, steps)
        if finest is not None and leaves is not None:
            if _guess(leaves, finest) > most:
                continue
            arrays |= _views(result) | _linear(leaves, finest)
        text = _packed(result, head, arrays)
        if len(text) <= most:
            return text
    return None


def play_moves(text: str) -> bool:
    """Return whether a frame's data have bounds at single poses."""
    head = zlib.decompressobj().decompress(base64.b64decode(text), 65536).split(b"\n", 1)[0]
    return json.loads(head)["cell_steps"] is not None


def _guess(leaves: Leaves, steps: int) -> float:
    """Return a lower estimate of the characters that leaves take, from a sample of tiles: trying all is slow."""
    numbers = leaves.tile[:, 0].astype(np.int64) * 65536 + leaves.tile[:, 1]
    some = np.flatnonzero(np.isin(numbers, np.unique(numbers)[::_SAMPLED]))
    part = Leaves(**{name: getattr(leaves, name)[some] for name in Leaves.__dataclass_fields__})
    packed = zlib.compress(b"".join(map(_planes, _linear(part, steps).values())), 6)
    return _SURE * len(packed) * numbers.size / some.size * 4.0 / 3.0


def _packed(result: FrameResult, head: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> str:
    box = result.box
    about = {
        "index": result.index,
        "height": result.lower.shape[0],
        "width": result.lower.shape[1],
        "mpg": mean_pixel_gap(result.lower, result.upper),
        "names": list(box.names),
        "units": list(box.units),
        "ends": [list(side) for side in zip(box.lower, box.upper, strict=True)],
        "arrays": [
            {"name": name, "type": array.dtype.str[1:], "shape": list(array.shape)} for name, array in arrays.items()
        ],
    }
    parts = [json.dumps(about | head, allow_nan=False).encode() + b"\n", *map(_planes, arrays.values())]
    return base64.b64encode(zlib.compress(b"".join(parts), 6)).decode()


def _planes(array: NDArray[Any]) -> bytes:
    """Return an array as little-endian bytes, the first bytes of all numbers first: similar bytes are neighbours."""
    flat = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<"), copy=False).reshape(-1)
    return flat.view(np.uint8).reshape(flat.size, array.itemsize).T.tobytes()


def _base(result: FrameResult, steps: int) -> dict[str, NDArray[Any]]:
    def whole(name: str, rounded: Any) -> NDArray[np.int16]:
        return rounded(getattr(result, name).astype(np.float64) * steps).astype(np.int16)

    lower, upper = whole("lower", np.floor), whole("upper", np.ceil)
    # what was rendered is rounded inward: it lies inside what the page shows as the bounds
    least, most = whole("witness_lower", np.ceil), whole("witness_upper", np.floor)
    return {
        "lower": _across(lower, 1),
        "upper": upper - lower,
        "witness_lower": least - lower,
        "witness_upper": most - upper,
        "image": _across(np.rint(result.image * 255.0).astype(np.uint8), 1),
    }


def _across(array: NDArray[Any], axis: int) -> NDArray[Any]:
    """Return the difference of every number from the one before it along an axis."""
    return np.diff(array, axis=axis, prepend=np.zeros_like(np.take(array, [0], axis)))


def _views(result: FrameResult) -> dict[str, NDArray[Any]]:
    if result.views is None or not result.views.values.shape[0]:
        return {}
    # as a screen shows them
    images = np.rint(result.views.images * 255.0).astype(np.uint8)
    return {"view_values": result.views.values, "view_images": _across(images, 0)}


def _linear(leaves: Leaves, steps: int) -> dict[str, NDArray[Any]]:
    """Return the leaves' linear sets by tile and box, as differences of whole coefficients, rounded outward."""
    order = np.lexsort((*leaves.box_lower.T[::-1], leaves.tile[:, 1], leaves.tile[:, 0]))
    low_slope, low = _whole(leaves.A_lower[order], leaves.b_lower[order], steps, -1.0)
    top_slope, top = _whole(leaves.A_upper[order], leaves.b_upper[order], steps, 1.0)
    boxes = leaves.box_lower[order], leaves.box_upper[order]
    tile, slope, offset = leaves.tile[order], low_slope.copy(), low.copy()
    follows = np.zeros(tile.shape[0], bool)
    if boxes[0].shape[1] == 1:
        follows[1:] = (tile[1:] == tile[:-1]).all(axis=1)
    after = np.flatnonzero(follows)
    slope[after] -= low_slope[after - 1]
    offset[after] -= low[after - 1] + low_slope[after, 0] + low_slope[after - 1, 0]
    slope[~follows], offset[~follows] = _across(low_slope[~follows], -1), _across(low[~follows], -1)
    return {
        "box_lower": boxes[0],
        "box_upper": boxes[1],
        "tile": tile,
        "slope": slope,
        "slope_more": top_slope - low_slope,
        "offset": offset,
        "offset_more": top - low,
    }


def _whole(
    slopes: NDArray[np.float32], offsets: NDArray[np.float32], steps: int, way: float
) -> tuple[NDArray[np.int16], NDArray[np.int16]]:
    """Return slopes [L, d, 3, s, s] and offsets [L, 3, s, s] in steps, rounded down (``way`` -1) or up (``way`` 1)."""
    axes = (0, *range(4, slopes.ndim), 3, 1, 2)
    a = np.ascontiguousarray(slopes.astype(np.float64).transpose(axes))
    b = np.ascontiguousarray(offsets.astype(np.float64).transpose(0, 3, 1, 2))
    representable = (np.abs(b) < _LARGE) & (np.abs(a).sum(axis=1) < _LARGE)
    # values lie in [0, 1] whatever the coefficients say
    a, b = np.where(representable[:, None], a, 0.0), np.where(representable, b, 0.5 + 0.5 * way)
    whole = np.rint(a * steps)
    lost = np.abs(a - whole / steps).sum(axis=1) + _SLACK
    outward = np.floor if way < 0.0 else np.ceil
    return whole.astype(np.int16), outward((b + way * lost) * steps).astype(np.int16)
