"""Faults in the search over boxes of inputs."""

from planted.fault import Fault

_BOXES = "verify/box_decisions.py"
_DOMINATED = "test_input_shares.py::test_no_half_and_no_group_is_left_out"
_TREE = "verify/network/phase_tree.py"
_ROOM = "test_phase_tree.py::test_branches_without_room_are_not_lost[0]"

BOXES = (
    Fault(
        "boxes: one half of a box that an input dominates is proved",
        _BOXES, "_BoxSearch._branch", "[(*half, left) for half in halves]", "[(*half, left) for half in halves[:1]]",
        _DOMINATED,
    ),
    Fault(
        "boxes: halves are asked for one group of those that are left",
        _BOXES, "_BoxSearch._branch", "(*half, left)", "(*half, left[:1])", _DOMINATED,
    ),
    Fault(
        "boxes: halves leave a gap",
        _BOXES, "_halves", "left[at] = right[at] = middle", "left[at], right[at] = lower[at], upper[at]",
        "test_input_shares.py::test_halves_meet_and_are_smaller",
    ),
    Fault(
        "boxes: an input's part is that of its largest value",
        "verify/network/dependence.py", "_motions", "v[1] - v[0]", "v[1]",
        "test_input_shares.py::test_parts_are_those_of_the_first_layer",
    ),
    Fault(
        "phase tree: branches that find no room are lost",
        _TREE, "PhaseTree._taken", "del waiting[-size:]", "del waiting[:size]", _ROOM,
    ),
    Fault(
        "phase tree: a neuron that gained little is bounded again and again",
        _TREE, "SplitGains.hopeful", "split not in means or split in best", "True",
        "test_phase_tree.py::test_splits_that_gained_little_are_not_bounded_again",
    ),
)  # fmt: skip
