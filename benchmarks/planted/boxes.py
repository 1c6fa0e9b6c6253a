"""Faults in the search over boxes of inputs."""

from planted.fault import Fault

_BOXES = "verify/box_decisions.py"
_DOMINATED = "test_input_shares.py::test_no_half_and_no_group_is_left_out"

BOXES = (
    Fault(
        "boxes: one half of a box that an input dominates is proved",
        _BOXES, "_BoxSearch._assume", "[(*half, left) for half in halves]", "[(*half, left) for half in halves[:1]]",
        _DOMINATED,
    ),
    Fault(
        "boxes: halves are asked for one group of those that are left",
        _BOXES, "_BoxSearch._assume", "(*half, left)", "(*half, left[:1])", _DOMINATED,
    ),
    Fault(
        "boxes: halves leave a gap",
        _BOXES, "_halves", "left[at] = right[at] = middle", "left[at], right[at] = lower[at], upper[at]",
        "test_input_shares.py::test_halves_meet_and_are_smaller",
    ),
    Fault(
        "boxes: an input's part is that of its largest value",
        "verify/network/input_shares.py", "_motions", "v[1] - v[0]", "v[1]",
        "test_input_shares.py::test_parts_are_those_of_the_first_layer",
    ),
)  # fmt: skip
