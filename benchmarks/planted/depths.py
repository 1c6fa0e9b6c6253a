"""Faults in expected depth and accumulation."""

from planted.fault import Fault

_DEPTHS, _BOUNDS, _RESULT = "methods/splat/depths.py", "methods/splat/bounds.py", "refine/result.py"
_ATTACK = "test_depths.py::test_kernels_and_reference_stay_inside"
_WHOLE = "test_depths.py::test_whole_pictures_hold"
_DIM = "test_depths.py::test_dim_light_and_tightness"

DEPTHS = (
    Fault(
        "depth: rounding of the sums is not charged",
        _DEPTHS, "_expected_depth", "(rounding * total_high + rounding) * magnitude", "0.0 * magnitude",
        "test_depths.py::test_sums_of_weights_are_rounded",
    ),
    Fault(
        "depth: the coordinate's own rounding is not charged",
        _BOUNDS, "SplatBounds._depths",
        "self.charges.camera_coordinate * ((sizes + spread + poses.camera_magnitude) @ most) + spread @ most",
        "spread @ most", "test_depths.py::test_coordinates_far_from_the_origin_are_rounded",
    ),
    Fault(
        "depth: what all depths have in common is forgotten",
        _DEPTHS, "_expected_depth", "result[k] += common[k]", "result[k] += common[k] if k == 0 else 0.0",
        _ATTACK + "[z-classic-1.4.0]", compiled=True,
    ),
    Fault(
        "depth: sums are divided by the larger accumulation",
        _DEPTHS, "_weighted_mean", "max(abs(1.0 / total_low - factor), abs(factor - 1.0 / total_high))", "0.0", _WHOLE,
        compiled=True,
    ),
    Fault(
        "depth: fragments that are missing count for nothing",
        _DEPTHS, "shade_layers", "passed > 0.0", "passed > 2.0", _DIM + "[0.01]", compiled=True,
    ),
    Fault(
        "accumulation: fragments that are missing count for nothing",
        _DEPTHS, "shade_layers", "by_lane[4 + _SUM] + passed + rounding", "by_lane[4 + _SUM] + rounding",
        _DIM + "[0.01]", compiled=True,
    ),
    Fault(
        "accumulation: its rounding is not charged",
        _DEPTHS, "shade_layers", "SECOND_ORDER * (charges.blend_fragment * n + charges.blend_pixel)", "0.0",
        "test_depths.py::test_the_accumulation_is_rounded",
    ),
    Fault(
        "depth: empty pixels show the depth of what might be drawn there",
        _RESULT, "_whole_depth", "np.maximum(depth.upper, most)", "depth.upper", _WHOLE, compiled=True,
    ),
    Fault(
        "depth: the largest depth is taken from pixels that may be empty",
        _RESULT, "_whole_depth", "np.where(perhaps | never, 0.0, depth.lower)", "np.where(never, 0.0, depth.lower)",
        "test_depths.py::test_largest_depth_of_the_picture",
    ),
)  # fmt: skip
