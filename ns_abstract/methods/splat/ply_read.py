"""Read the Gaussians of a 3DGS ``.ply``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ns_abstract.io.errors import visible
from ns_abstract.methods.overrides import Overrides
from ns_abstract.methods.splat.formats import inria
from ns_abstract.methods.splat.formats.compressed_ply import decode_compressed_ply, is_compressed
from ns_abstract.methods.splat.formats.decoded import DecodedSplats, float32_rows, scene_of
from ns_abstract.methods.splat.ply_header import (
    FILTER,
    GROUPS,
    PlyHeader,
    read_declaration,
    read_elements,
    standard_header,
)
from ns_abstract.methods.splat.scene import Float32Array, SplatScene

_FIELDS = {"scales": "vertex.scale_*", "quats": "vertex.rot_*", "opacities": "vertex.opacity", "colours": "vertex.f_*"}


def load_ply(path: Path, overrides: Overrides) -> SplatScene:
    """The scene of a standard or compressed ``.ply``.

    A ``cfg_args`` in the folder that the file was trained in says the background. Raises InputError: for any content of
    the file, or an override, that cannot be used.
    """
    overrides.refuse(("load_step", "assume_splatfacto"), "is for runs, this file is a .ply")
    declared = read_declaration(path, overrides.rasterize_mode is not None)
    if is_compressed(declared.elements):
        decoded = decode_compressed_ply(path, declared.elements, declared.mode, declared.comment)
    else:
        decoded = _decode(path, standard_header(declared, path))
    arguments = inria.arguments_beside(path)
    if arguments is not None:
        background = inria.background(inria.read_arguments(arguments), arguments)
        decoded = replace(
            decoded,
            background=background,
            background_origin=f"{inria.ARGUMENTS}: white_background" if background else "",
        )
    return scene_of(decoded, overrides)


def _decode(path: Path, header: PlyHeader) -> DecodedSplats:
    vertex = read_elements(path, [header.vertex])[header.vertex.name]
    arrays = {name: _columns(vertex, columns) for name, columns in GROUPS.items()}
    count, bands = arrays["means"].shape[0], header.bands
    rest = _columns(vertex, tuple(f"f_rest_{i}" for i in range(3 * (bands - 1))))
    # f_rest is channel-major: f_rest[c * (K - 1) + k].
    rest = rest.reshape(count, 3, bands - 1).transpose(0, 2, 1)
    scales, opacities = arrays["scales"], arrays["opacity"].reshape(count)
    notes = [f"not used: {visible(', '.join(header.unused))}"] if header.unused else []
    if FILTER in header.vertex.types:
        scales, opacities = filtered(scales, opacities, _columns(vertex, (FILTER,))[:, 0])
        notes.append(
            f"{FILTER} is applied to scales and opacities, as mip-splatting does on export; its own rasteriser blurs "
            "by 0.1 square pixels and compensates opacities, gsplat blurs by 0.3"
        )
    return DecodedSplats(
        "a .ply",
        (path,),
        float32_rows(arrays["means"], scales, arrays["quats"], opacities, arrays["f_dc"], rest),
        _FIELDS,
        mode=header.mode,
        mode_origin=f"comment in the file: {visible(header.comment)}" if header.mode else "",
        notes=tuple(notes),
    )


def filtered(
    log_scales: Float32Array, opacity_logits: Float32Array, width: Float32Array
) -> tuple[Float32Array, Float32Array]:
    """Scales and opacities with mip-splatting's 3-D filter, as its ``save_fused_ply`` stores them.

    With s the scales and f the filter's ``width`` [N], the scales become sqrt(s^2 + f^2) and the opacity is multiplied
    by sqrt(prod(s^2) / prod(s^2 + f^2)). Takes logarithms [N, 3] and logits [N]; computed in float64 and rounded once
    to float32; rows of width 0 stay as they are.
    """
    with np.errstate(all="ignore"):
        square = np.square(np.exp(log_scales.astype(np.float64)))
        total = square + np.square(width.astype(np.float64))[:, None]
        weight = np.sqrt(np.prod(square / total, axis=1))
        opacity = weight / (1.0 + np.exp(-opacity_logits.astype(np.float64)))
        scales_and_opacities = (
            (0.5 * np.log(total)).astype(np.float32),
            (np.log(opacity) - np.log1p(-opacity)).astype(np.float32),
        )
    same = width == 0
    return np.where(same[:, None], log_scales, scales_and_opacities[0]), np.where(
        same, opacity_logits, scales_and_opacities[1]
    )


def _columns(vertex: Any, names: tuple[str, ...]) -> Float32Array:
    """Columns of the vertex table as [N, len(names)] float32."""
    array = np.empty((len(vertex), len(names)), np.float32)
    for i, name in enumerate(names):
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):
            array[:, i] = vertex[name]
    return array
