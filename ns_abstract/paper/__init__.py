"""Bound rules for the operations of rendering, each with a concrete, an interval and an affine face."""

from ns_abstract.paper.affine import Enclosure
from ns_abstract.paper.blend import blend, convex_combination, cumulative_blend, sumcumprod
from ns_abstract.paper.depth_order import (
    ordered_blend,
    sort_by,
    sorted_blend,
    surely_in_front,
    vr_ind,
    vr_ind_weights,
)
from ns_abstract.paper.interval import Interval
from ns_abstract.paper.linear import LinearBounds
from ns_abstract.paper.matrix_inverse import adjugate_inverse, corner_inverse, matrix_inverse
from ns_abstract.paper.table import RULES, Rule

__all__ = [
    "RULES",
    "Enclosure",
    "Interval",
    "LinearBounds",
    "Rule",
    "adjugate_inverse",
    "blend",
    "convex_combination",
    "corner_inverse",
    "cumulative_blend",
    "matrix_inverse",
    "ordered_blend",
    "sort_by",
    "sorted_blend",
    "sumcumprod",
    "surely_in_front",
    "vr_ind",
    "vr_ind_weights",
]
