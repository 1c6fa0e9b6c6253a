"""Faults in the program that checks results: a false result would pass, or a sound one would not."""

from planted.fault import Fault

_AUDIT, _FORMS, _RESULTS, _SPLATS = "check/audit.py", "check/forms.py", "check/results.py", "check/splats.py"
_PIXELS = "test_check.py::test_pixels_contain_pictures_of_another_renderer[classic-1.4.0]"

CHECKS = (
    Fault(
        "checker: squares forget what is quadratic",
        _FORMS,
        "Form.square",
        "half = 0.5 * a * a",
        "half = 0.0 * a",
        "test_check.py::test_forms_contain_exact_values[square]",
    ),
    Fault(
        "checker: functions are taken to be straight",
        _FORMS,
        "Form.composed",
        "np.maximum(high, 0.0) * square",
        "0.0 * square",
        "test_check.py::test_forms_contain_exact_values[exponential]",
    ),
    Fault(
        "checker: an open depth order is that of the middle",
        _SPLATS,
        "_swaps",
        "not pair.any()",
        "True",
        "test_check.py::test_a_change_of_order_is_enclosed",
    ),
    Fault(
        "checker: a stop that is open is none",
        _SPLATS,
        "_blended",
        "np.where(may.any(axis=1), may.argmax(axis=1), n)",
        "np.full(count, n)",
        "test_check.py::test_a_stop_that_is_open_is_enclosed",
    ),
    Fault(
        "checker: an alpha that may be skipped is never skipped",
        _SPLATS,
        "_fragments",
        "np.where(surely, np.minimum(least, rules.cap), 0.0)",
        "np.minimum(least, rules.cap)",
        _PIXELS,
    ),
    Fault(
        "checker: alphas have no cap",
        _SPLATS,
        "_fragments",
        "top = np.minimum(most, rules.cap)",
        "top = most",
        "test_check.py::test_a_capped_alpha_lets_light_through",
    ),
    Fault(
        "checker: cells may leave gaps",
        _RESULTS,
        "partition",
        "volume == whole",
        "volume <= whole",
        "test_check.py::test_partitions_are_exact",
    ),
    Fault(
        "checker: files may be others than those of the report",
        _RESULTS,
        "read_cells",
        "content.hexdigest() != digest",
        "False",
        "test_check.py::test_a_file_with_another_digest_is_refused",
    ),
    Fault(
        "checker: linear sets are not looked at",
        _AUDIT,
        "_Bounds.excess",
        "np.where(beyond <= 0.0, -1.0, linear)",
        "np.full(len(c), -1.0)",
        "test_check.py::test_a_claim_is_about_both_bounds",
    ),
    Fault(
        "checker: a frame's own bounds are not looked at",
        _AUDIT,
        "_Bounds.excess",
        "np.maximum(linear, constant_)",
        "linear",
        "test_check.py::test_a_claim_is_about_both_bounds",
    ),
    Fault(
        "checker: the least part is stated at 5 %",
        _AUDIT,
        "least_part",
        "tail <= 1.0 - CONFIDENCE",
        "tail <= CONFIDENCE",
        "test_check.py::test_the_least_part_is_that_of_clopper_and_pearson",
    ),
)
