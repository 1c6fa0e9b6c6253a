"""Faults in linear maps of whole pictures (R7)."""

from planted.fault import Fault

_MAP = "refine/linear_map.py"
_EXACT = "test_linear_map.py::test_planes_hold_exactly[False-one]"

MAPS = (
    Fault(
        "maps: leaves' slopes are not looked at", _MAP, "_offset_below",
        "offsets + (slopes * shift).sum(axis=-1) - (plane * box_shift).sum(axis=-1) - turn",
        "offsets + (slopes * shift).sum(axis=-1) - (plane * box_shift).sum(axis=-1)", _EXACT,
    ),
    Fault("maps: the last leaf decides", _MAP, "_offset_below",
          "np.minimum(least, (value - MAP_ROUNDING * size).min(axis=0))",
          "(value - MAP_ROUNDING * size)[-1]", _EXACT),
    Fault("maps: offsets are rounded to nearest", _MAP, "linear_image", "outward(least, least)[0]",
          "least.astype(np.float32)", "test_linear_map.py::test_planes_hold_exactly[False-wide and narrow]"),
    Fault("maps: leaves that are missing are not noticed", _MAP, "_covers_box",
          "bool(part.box_scale[:, varied].prod(axis=1).sum() >= COVER_DOWN)", "True",
          "test_linear_map.py::test_where_leaves_are_missing_the_picture_stays"),
    Fault("maps: at a pose, bounds are rounded to nearest", _MAP, "bounds_at", "outward(value, value)[0]",
          "value.astype(np.float32)", "test_linear_map.py::test_bounds_at_a_pose_are_below_the_planes_of_its_leaf"),
    Fault("maps: a verifier's slack forgets what slopes differ by", _MAP, "LinearImage.middle",
          "self.b_upper + np.abs(upper - slope).sum(axis=-1)", "self.b_upper.astype(np.float64)",
          "test_linear_map.py::test_slack_reaches_both_planes"),
)  # fmt: skip
