"""Bounds of a cell by forms and over parts, as the checks of compiled kernels attack them."""

from __future__ import annotations

import numpy as np

from ns_abstract.arithmetic.outward import outward
from ns_abstract.geometry.box import ParameterBox, shared_out
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.geometry.tiles import assemble
from ns_abstract.methods.splat.bounds import CellBounds, SplatBounds

#: Parts of a cell that is bounded over them, too.
_PARTS = 16


def bounded_both_ways(
    bounds: SplatBounds, poses: PoseBox, cell: ParameterBox, layers: bool
) -> tuple[CellBounds, np.ndarray, np.ndarray]:
    """A cell's bounds by forms, and [H, W, 3] float32 bounds of its picture: theirs or those over parts, the tighter.

    To attack them is to attack both.
    """
    forms = poses.enclosure(cell, 1)
    cell_bounds = bounds.cell(poses.camera, forms, layers=layers)
    lower, upper = cell_bounds.lower, cell_bounds.upper
    if cell.dimensions:
        over_parts = bounds.cell(poses.camera, forms, parts=shared_out(np.ones(cell.dimensions), _PARTS))
        lower, upper = np.maximum(lower, over_parts.lower), np.minimum(upper, over_parts.upper)
    return cell_bounds, *outward(assemble(lower, poses.camera), assemble(upper, poses.camera))
