"""What a page needs to show a frame's bounds at any pose of its set: numbers, rounded outward, in few bytes.

On a leaf's box every pixel lies between two functions that are linear in the parameters
(`ns_abstract.refine.result.Leaves`). Their coefficients become whole numbers with one step by leaf; what that rounding
may move a pixel by is added to the offsets, so that what the page shows still holds. Finished bounds are whole
multiples of `STEP`.
"""

from __future__ import annotations

import base64
import json
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ns_abstract.refine.result import FrameResult, Leaves

#: Precision that the page shows pixels with; lower bounds are rounded down to it and upper bounds up.
STEP = 1e-4
#: Bits of coefficients, finest first.
_BITS = (16, 8)
#: Room for float64 roundings, of the page's and of this module's evaluation.
_SLACK = 1e-12
#: Part of its size that a compressed number takes at least; what is larger even so is not tried.
_BEST = 0.08


def play_data(result: FrameResult, most: int) -> str | None:
    """A frame for the page: a zlib stream of a JSON line and arrays, in base64.

    With the leaves' linear sets, as finely as they fit; else without them; None where nothing fits.

    Args:
        result: The frame.
        most: Characters that it may take.
    """
    base = _base(result)
    if result.leaves is not None and result.leaves.tile.shape[0]:
        for bits in _BITS:
            arrays = base | _views(result) | _linear(result.leaves, bits)
            text = _packed(result, arrays, most)
            if text is not None:
                return text
    return _packed(result, base, most)


def _packed(result: FrameResult, arrays: dict[str, NDArray[Any]], most: int) -> str | None:
    if sum(array.nbytes for array in arrays.values()) * _BEST > 0.75 * most:
        return None
    box = result.box
    head = {
        "index": result.index,
        "height": result.lower.shape[0],
        "width": result.lower.shape[1],
        "names": list(box.names),
        "units": list(box.units),
        "ends": [list(side) for side in zip(box.lower, box.upper, strict=True)],
        "step": STEP,
        "arrays": [
            {"name": name, "type": array.dtype.str[1:], "shape": list(array.shape)} for name, array in arrays.items()
        ],
    }
    parts = [json.dumps(head, allow_nan=False).encode() + b"\n", *map(_planes, arrays.values())]
    text = base64.b64encode(zlib.compress(b"".join(parts), 6)).decode()
    return text if len(text) <= most else None


def _planes(array: NDArray[Any]) -> bytes:
    """Little-endian bytes of an array, the first byte of every number first: alike bytes stand together."""
    flat = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<"), copy=False).reshape(-1)
    return flat.view(np.uint8).reshape(flat.size, array.itemsize).T.tobytes()


def steps_down(values: NDArray[np.floating]) -> NDArray[np.uint16]:
    """Values in [0, 1] as multiples of `STEP`, rounded down."""
    return np.floor(values.astype(np.float64) * (1.0 / STEP)).astype(np.uint16)


def steps_up(values: NDArray[np.floating]) -> NDArray[np.uint16]:
    """Values in [0, 1] as multiples of `STEP`, rounded up."""
    return np.ceil(values.astype(np.float64) * (1.0 / STEP)).astype(np.uint16)


def _base(result: FrameResult) -> dict[str, NDArray[Any]]:
    # what was rendered is rounded inward: it lies inside what the page shows as the bounds
    return {
        "lower": steps_down(result.lower),
        "upper": steps_up(result.upper),
        "witness_lower": steps_up(result.witness_lower),
        "witness_upper": steps_down(result.witness_upper),
        "image": np.rint(result.image.astype(np.float64) * (1.0 / STEP)).astype(np.uint16),
    }


def _views(result: FrameResult) -> dict[str, NDArray[Any]]:
    if result.views is None or not result.views.values.shape[0]:
        return {}
    # as a screen shows them
    images = np.rint(result.views.images * 255.0).astype(np.uint8)
    return {"view_values": result.views.values, "view_images": images}


def _linear(leaves: Leaves, bits: int) -> dict[str, NDArray[Any]]:
    """Whole coefficients with one step for slopes and one for offsets by leaf, rounded outward."""
    kind, top = (np.int16, 32767) if bits == 16 else (np.int8, 127)
    count = leaves.tile.shape[0]
    slopes = [leaves.A_lower.astype(np.float64), leaves.A_upper.astype(np.float64)]
    offsets = [leaves.b_lower.astype(np.float64), leaves.b_upper.astype(np.float64)]

    def step(arrays: list[NDArray[np.float64]]) -> NDArray[np.float64]:
        largest = np.maximum.reduce([np.abs(a).reshape(count, -1).max(axis=1, initial=0.0) for a in arrays])
        # a little more, so that what is rounded outward still fits
        return np.where(largest > 0.0, largest / (top - 2), 1.0)

    slope_step = step(slopes)
    whole = [np.rint(a / slope_step[:, None, None, None, None]) for a in slopes]
    lost = [
        np.abs(a - w * slope_step[:, None, None, None, None]).sum(axis=-1) + _SLACK
        for a, w in zip(slopes, whole, strict=True)
    ]
    low, high = offsets[0] - lost[0], offsets[1] + lost[1]
    offset_step = step([low, high])
    scaled = offset_step[:, None, None, None]
    bottom, top_end = np.floor(low / scaled), np.ceil(high / scaled)
    # as differences from the lower bound: mostly zero and small
    return {
        "box_lower": leaves.box_lower,
        "box_upper": leaves.box_upper,
        "tile": leaves.tile,
        "slope_step": slope_step,
        "offset_step": offset_step,
        "slope": _spread(whole[0], kind),
        "slope_more": _spread(_wrapped(whole[1] - whole[0], bits), kind),
        "offset": _spread(bottom, kind),
        "offset_more": _spread(_wrapped(top_end - bottom, bits), kind),
    }


def _wrapped(difference: NDArray[np.float64], bits: int) -> NDArray[np.float64]:
    """Differences modulo 2^bits: the page adds them in as many bits."""
    size = float(1 << bits)
    return np.mod(difference + 0.5 * size, size) - 0.5 * size


def _spread(whole: NDArray[np.float64], kind: Any) -> NDArray[Any]:
    """[L, s, s, 3, ...] as [L, ..., 3, s, s]: neighbouring pixels stand side by side."""
    axes = (0, *range(4, whole.ndim), 3, 1, 2)
    return np.ascontiguousarray(whole.transpose(axes)).astype(kind)
