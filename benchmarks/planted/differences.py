"""Faults in bounds of differences of two scenes, and in the verdicts on them."""

from planted.fault import Fault

_FRAME, _LARGEST, _REPORT = "refine/difference.py", "refine/largest.py", "report/comparison.py"
_CELLS = "test_differences.py::test_differences_of_parabolas_hold_every_render[-0.2]"
_POLYNOMIALS = "test_differences.py::test_polynomials_hold_exact_values[1-2]"
_JOB = "api/comparing.py"

DIFFERENCES = (
    Fault(
        "differences: B's lower bound is its upper one",
        _FRAME,
        "_signed_upper",
        "b[:2]",
        "b[2:]",
        "test_differences.py::test_linear_bounds_hold_exact_differences",
    ),
    Fault(
        "differences: slopes of both scenes are taken to agree",
        _FRAME,
        "_signed_upper",
        "high - low + np.abs(slope_high - slope_low).sum(axis=-1)",
        "high - low",
        "test_differences.py::test_linear_bounds_hold_exact_differences",
    ),
    Fault(
        "differences: only A may exceed B",
        _FRAME,
        "form_upper",
        "np.maximum(rise, fall) + radius + DIFFERENCE_ROUNDING * size",
        "rise + radius + DIFFERENCE_ROUNDING * size",
        "test_differences.py::test_differences_of_parabolas_hold_every_render[0.01]",
    ),
    Fault(
        "differences: B's radius is left out",
        _FRAME,
        "form_upper",
        "a.forms[..., -1] + b.forms[..., -1]",
        "0.0 * a.forms[..., -1]",
        _CELLS,
    ),
    Fault(
        "differences: the vertex of a parabola lies outside the cell",
        _FRAME,
        "_polynomial_upper",
        "(squares < 0.0) & (slope < 2.0 * steep)",
        "(squares > 0.0) & (slope < 2.0 * steep)",
        _POLYNOMIALS,
    ),
    Fault(
        "differences: squares never matter",
        _FRAME,
        "_polynomial_upper",
        "np.where(vertex, inner, slope + squares)",
        "np.where(vertex, inner, slope)",
        _POLYNOMIALS,
    ),
    Fault(
        "differences: pixels that were not asked for are taken for bounded",
        _FRAME,
        "DifferenceFrame._difference",
        "high[~pixels] = 1.0",
        "high[~pixels] = self.floor",
        _CELLS,
    ),
    Fault(
        "differences: what is no number is nothing",
        _FRAME,
        "DifferenceFrame._difference",
        "np.maximum(high, self.floor)",
        "np.fmax(high, self.floor)",
        "test_differences.py::test_what_is_no_number_is_no_bound",
    ),
    Fault(
        "differences: a floor counts as rendered",
        _LARGEST,
        "LargestDifference._bound",
        "part.witness_upper > least",
        "part.witness_upper >= least",
        "test_differences.py::test_floors_leave_nothing_out[0.02]",
    ),
    Fault(
        "differences: B's cells are those of the set's own parameters",
        _JOB,
        "ComparisonJob.frame",
        "self.other.method.frame(first.pose_set)",
        "self.other.method.frame(self.pose_sets[index])",
        "test_differences.py::test_sheared_sets_and_groups_of_tiles",
        compiled=True,
    ),
    Fault(
        "differences: a sample certifies",
        _REPORT,
        "verdict",
        'guarantee != "sampled" and result.bounded and float(result.upper.max()) <= tolerance',
        "result.bounded and float(result.upper.max()) <= tolerance",
        "test_differences.py::test_verdicts",
    ),
    Fault(
        "differences: what is not bounded is certified",
        _REPORT,
        "verdict",
        'guarantee != "sampled" and result.bounded and float(result.upper.max()) <= tolerance',
        'guarantee != "sampled" and float(result.upper.max()) <= tolerance',
        "test_differences.py::test_verdicts",
    ),
    Fault(
        "differences: frames that are missing are certified with the others",
        _REPORT,
        "overall",
        'complete and verdicts and set(verdicts) == {"certified"}',
        'verdicts and set(verdicts) == {"certified"}',
        "test_differences.py::test_verdicts",
    ),
    Fault(
        "differences: two runs of other frames are compared",
        _JOB,
        "_check_comparable",
        "np.abs(matrices[0] - matrices[1]).max() <= _SAME_FRAME * np.abs(matrices[0]).max()",
        "np.isfinite(matrices[0]).all()",
        "test_differences.py::test_mistakes_are_one_line[_scaled-mentions1]",
    ),
    Fault(
        "differences: results with another B go on",
        _JOB,
        "ComparisonJob.fingerprint",
        '{**super().fingerprint, "other": self.other.method.fingerprint}',
        "super().fingerprint",
        "test_differences.py::test_results_name_both_scenes",
    ),
)
