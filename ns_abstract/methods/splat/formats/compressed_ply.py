"""compressed.ply files: chunks of 256 Gaussians of packed numbers (PlayCanvas, ``splat-transform``).

Positions and logarithms of scales have 11, 10 and 11 bits between the chunk's limits, quaternions the place of the
largest component and three components of 10 bits, colours and opacities 8 bits. A byte b of the spherical harmonics
stands for the middle of its interval, ((b + 1/2) / 256 - 1/2) 8, but for 0 and 255, which are -4 and 4.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ns_abstract.io.errors import InputError, visible
from ns_abstract.methods.splat.activate import SH_C0
from ns_abstract.methods.splat.formats.decoded import (
    DecodedSplats,
    float32_rows,
    opacity_logits,
    reserve,
    smallest_three,
)
from ns_abstract.methods.splat.ply_header import DEGREES, PlyElement, read_elements

#: Gaussians a chunk.
CHUNK = 256
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_LIMITS = tuple(f"{end}_{name}{axis}" for name in ("", "scale_") for end in ("min", "max") for axis in "xyz")
_COLORS = tuple(f"{end}_{channel}" for end in ("min", "max") for channel in "rgb")
_FIX = "export the scene again, or convert it to a standard .ply"
_FIELDS = {
    "scales": "vertex.packed_scale",
    "quats": "vertex.packed_rotation",
    "opacities": "vertex.packed_color",
    "colours": "vertex.packed_color",
}


def is_compressed(elements: list[PlyElement]) -> bool:
    """Whether a header declares packed columns."""
    return any(name.startswith("packed_") for element in elements for name in element.types)


def decode_compressed_ply(path: Path, elements: list[PlyElement], mode: str | None, comment: str) -> DecodedSplats:
    """Return the Gaussians of a compressed .ply.

    ``elements``: what its header declares, checked against the file's size. ``mode``: "classic" or "antialiased" where
    a comment says it. Raises InputError where the elements are not those of the format, or the file is damaged.
    """
    count, bands = _check(elements, path)
    reserve(count, bands, path, 32 * count)
    table = read_elements(path, elements)
    vertex, chunk = table["vertex"], table["chunk"]
    limits = {name: chunk[name].astype(np.float64) for name in chunk.dtype.names}
    of = np.arange(count) // CHUNK

    def between(name: str, axis: str, part: NDArray[np.float64]) -> NDArray[np.float64]:
        low, high = limits[f"min_{name}{axis}"][of], limits[f"max_{name}{axis}"][of]
        return low * (1.0 - part) + high * part

    means = np.stack([between("", a, p) for a, p in zip("xyz", _unpack(vertex["packed_position"]), strict=True)], 1)
    scales = np.stack([between("scale_", a, p) for a, p in zip("xyz", _unpack(vertex["packed_scale"]), strict=True)], 1)
    color = vertex["packed_color"].astype(np.int64)
    parts = [(color >> shift & 255) / 255.0 for shift in (24, 16, 8)]
    if "min_r" in limits:
        parts = [between("", channel, part) for channel, part in zip("rgb", parts, strict=True)]
    rotation = vertex["packed_rotation"].astype(np.int64)
    components = [((rotation >> shift & 1023) / 1023.0 - 0.5) * np.sqrt(2.0) for shift in (20, 10, 0)]
    rest = None
    if bands > 1:
        columns = [_HARMONICS[table["sh"][f"f_rest_{i}"]] for i in range(3 * (bands - 1))]
        rest = np.stack(columns, axis=1).reshape(count, 3, bands - 1).transpose(0, 2, 1)
    return DecodedSplats(
        "a compressed .ply",
        (path,),
        float32_rows(
            means,
            scales,
            smallest_three(np.stack(components, axis=1), rotation >> 30),
            opacity_logits((color & 255).astype(np.uint8)),
            (np.stack(parts, axis=1) - 0.5) / SH_C0,
            rest,
        ),
        _FIELDS,
        mode=mode,
        mode_origin=f"comment in the file: {visible(comment)}" if mode else "",
    )


def _harmonics() -> NDArray[np.float64]:
    middle: NDArray[np.float64] = (np.arange(256, dtype=np.float64) + 0.5) / 256.0
    middle[0], middle[255] = 0.0, 1.0
    return np.asarray((middle - 0.5) * 8.0, np.float64)


_HARMONICS = _harmonics()


def _unpack(values: Any) -> list[NDArray[np.float64]]:
    """Return numbers of 11, 10 and 11 bits as fractions of their largest values."""
    value = values.astype(np.int64)
    return [(value >> 21 & 2047) / 2047.0, (value >> 11 & 1023) / 1023.0, (value & 2047) / 2047.0]


def _check(elements: list[PlyElement], path: Path) -> tuple[int, int]:
    """Return the number of Gaussians and of bands."""
    by_name = {element.name: element for element in elements}
    if (
        set(by_name) - {"vertex", "chunk", "sh"}
        or len(by_name) != len(elements)
        or not {"vertex", "chunk"} <= set(by_name)
    ):
        problem = f"elements {visible(', '.join(element.name for element in elements))}, expected chunk, vertex and sh"
        raise InputError(problem, file=path, field="header", fix=_FIX)
    vertex, chunk, sh = by_name["vertex"], by_name["chunk"], by_name.get("sh")
    if set(vertex.types) != set(_PACKED) or not set(vertex.types.values()) <= {"uint", "uint32"}:
        raise InputError(f"expected {', '.join(_PACKED)} of type uint", file=path, field="element vertex", fix=_FIX)
    if set(chunk.types) not in (set(_LIMITS), {*_LIMITS, *_COLORS}) or not set(chunk.types.values()) <= {
        "float",
        "float32",
    }:
        problem = "expected the limits of positions, scales and colours (min_x to max_b) of type float"
        raise InputError(problem, file=path, field="element chunk", fix=_FIX)
    if chunk.count != -(-vertex.count // CHUNK):
        problem = f"{chunk.count} chunks of {CHUNK} for {vertex.count} Gaussians"
        raise InputError(problem, file=path, field="element chunk", fix=_FIX)
    if sh is None:
        return vertex.count, 1
    names = {f"f_rest_{i}" for i in range(len(sh.types))}
    if len(names) not in DEGREES or set(sh.types) != names or not set(sh.types.values()) <= {"uchar", "uint8"}:
        problem = "expected f_rest_0 to f_rest_8, f_rest_23 or f_rest_44 of type uchar"
        raise InputError(problem, file=path, field="element sh", fix=_FIX)
    if sh.count != vertex.count:
        raise InputError(f"{sh.count} rows, expected {vertex.count}", file=path, field="element sh", fix=_FIX)
    return vertex.count, len(names) // 3 + 1
