"""Bound rules for the operations of rendering, each with a concrete, an interval and an affine face."""

from ns_abstract.paper.affine import Enclosure
from ns_abstract.paper.blend import blend, cumulative_blend, sumcumprod
from ns_abstract.paper.depth_order import sort_by, sorted_blend, surely_in_front, vr_ind
from ns_abstract.paper.interval import Interval
from ns_abstract.paper.matrix_inverse import adjugate_inverse, matrix_inverse

__all__ = [
    "Enclosure",
    "Interval",
    "adjugate_inverse",
    "blend",
    "cumulative_blend",
    "matrix_inverse",
    "sort_by",
    "sorted_blend",
    "sumcumprod",
    "surely_in_front",
    "vr_ind",
]
