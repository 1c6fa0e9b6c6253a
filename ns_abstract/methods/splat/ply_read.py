"""Read the Gaussians of a standard 3DGS ``.ply``."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from ns_abstract.io.assumptions import Assumption
from ns_abstract.io.errors import InputError, visible
from ns_abstract.methods.overrides import Overrides, chosen
from ns_abstract.methods.splat.ply_header import DEGREES, FILTER, FIX, GROUPS, PlyElement, PlyHeader, read_header
from ns_abstract.methods.splat.rows import StoredRows, coordinates_note, drawable
from ns_abstract.methods.splat.scene import DataparserTransform, Float32Array, SplatScene

_FIELDS = {"scales": "vertex.scale_*", "quats": "vertex.rot_*", "opacities": "vertex.opacity", "colours": "vertex.f_*"}


def load_ply(path: Path, overrides: Overrides) -> SplatScene:
    """The scene of a ``.ply``.

    Raises:
        InputError: For any content of the file, or an override, that cannot be used.
    """
    overrides.refuse(("load_step", "assume_splatfacto"), "is for runs, this file is a .ply")
    header = read_header(path, overrides.rasterize_mode is not None)
    vertex = _read_vertex(path, header.vertex)
    arrays = {name: _columns(vertex, columns) for name, columns in GROUPS.items()}
    count, bands = arrays["means"].shape[0], header.bands
    rest = _columns(vertex, tuple(f"f_rest_{i}" for i in range(3 * (bands - 1))))
    # f_rest is channel-major: f_rest[c * (K - 1) + k].
    rest = rest.reshape(count, 3, bands - 1).transpose(0, 2, 1)
    scales, opacities = arrays["scales"], arrays["opacity"].reshape(count)
    notes = list(_notes(header, overrides))
    if FILTER in header.vertex.types:
        scales, opacities = filtered(scales, opacities, _columns(vertex, (FILTER,))[:, 0])
        notes.append(
            f"{FILTER} is applied to scales and opacities, as mip-splatting does on export; its own rasteriser blurs "
            "by 0.1 square pixels and compensates opacities, gsplat blurs by 0.3"
        )
    stored = StoredRows(
        means=arrays["means"],
        log_scales=scales,
        quats=arrays["quats"],
        opacity_logits=opacities,
        sh=np.ascontiguousarray(np.concatenate([arrays["f_dc"][:, None, :], rest], axis=1)),
    )
    stored, dropped = drawable(stored, path, _FIELDS, overrides.drop_nan_gaussians)
    assumptions = _assumptions(header, overrides)
    background = np.array(overrides.background or (0.0, 0.0, 0.0), np.float32)
    return SplatScene(
        **vars(stored),
        color_model="sh",
        sh_degree=DEGREES[3 * (bands - 1)],
        rasterize_mode=cast(Literal["classic", "antialiased"], assumptions[0].value),
        background=background,
        dataparser=DataparserTransform(),
        name=visible(path.stem),
        source=str(path),
        **dropped,
        notes=(*notes, *coordinates_note(stored.means, stored.log_scales)),
        assumptions=assumptions,
    )


def filtered(
    log_scales: Float32Array, opacity_logits: Float32Array, width: Float32Array
) -> tuple[Float32Array, Float32Array]:
    """Scales and opacities with mip-splatting's 3-D filter, as its ``save_fused_ply`` stores them.

    With s the scales and f the filter's width, the scales become sqrt(s^2 + f^2) and the opacity is multiplied by
    sqrt(prod(s^2) / prod(s^2 + f^2)). Computed in float64 and rounded once to float32; rows of width 0 stay as they
    are.

    Args:
        log_scales: [N, 3] logarithms.
        opacity_logits: [N] logits.
        width: [N], units of the scales.
    """
    with np.errstate(all="ignore"):
        square = np.square(np.exp(log_scales.astype(np.float64)))
        total = square + np.square(width.astype(np.float64))[:, None]
        weight = np.sqrt(np.prod(square / total, axis=1))
        opacity = weight / (1.0 + np.exp(-opacity_logits.astype(np.float64)))
        found = (0.5 * np.log(total)).astype(np.float32), (np.log(opacity) - np.log1p(-opacity)).astype(np.float32)
    same = width == 0
    return np.where(same[:, None], log_scales, found[0]), np.where(same, opacity_logits, found[1])


def _assumptions(header: PlyHeader, overrides: Overrides) -> tuple[Assumption, ...]:
    mode, origin = header.mode, f"comment in the file: {visible(header.comment)}"
    if mode is None:
        mode, origin = "classic", "default: the file says nothing"
    return (
        chosen("rasterize_mode", overrides.rasterize_mode, "--rasterize-mode", mode, origin),
        chosen("background", overrides.background, "--background", (0.0, 0.0, 0.0), "default: a .ply says nothing"),
        Assumption("units", "those of the file", "default: a .ply says nothing"),
    )


def _notes(header: PlyHeader, overrides: Overrides) -> list[str]:
    notes = []
    if header.mode is None and overrides.rasterize_mode is None:
        notes.append("assumed classic: nothing in the file says how it was rasterised (--rasterize-mode says it)")
    if header.unused:
        notes.append(f"not used: {visible(', '.join(header.unused))}")
    return notes


def _read_vertex(path: Path, element: PlyElement) -> Any:
    import plyfile

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            vertex = plyfile.PlyData.read(str(path))["vertex"].data
            if len(vertex) != element.count or vertex.dtype.names != tuple(element.types):
                raise ValueError("ambiguous header")
            return vertex
    except MemoryError:
        raise
    except Exception as error:  # numpy and plyfile raise many types on damaged files
        text = " ".join(str(error).split())[:160] or type(error).__name__
        raise InputError(f"damaged .ply: {text}", file=path, fix=FIX) from None


def _columns(vertex: Any, names: tuple[str, ...]) -> Float32Array:
    """Columns of the vertex table as [N, len(names)] float32."""
    array = np.empty((len(vertex), len(names)), np.float32)
    for i, name in enumerate(names):
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):
            array[:, i] = vertex[name]
    return array
