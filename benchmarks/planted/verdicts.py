"""Faults in the bounds of networks' rounding, in verdicts and in VNN-LIB's constraints."""

from planted.fault import Fault

_SEARCH = "verify/search.py"
_VNNLIB = "verify/vnnlib.py"
_NETWORK = "verify/network/bounds.py"

VERDICTS = (
    Fault(
        "a margin that is no number breaks the property",
        _SEARCH,
        "_fails",
        "math.isfinite(margin) and margin <= 0.0",
        "not margin > 0.0",
        "test_certify_search.py::test_network_without_a_number_decides_nothing[nan]",
    ),
    Fault(
        "a proof outlives the loss of a picture's margin",
        _SEARCH,
        "Search._verdicts",
        "not cell.undecided",
        "True",
        "test_certify_search.py::test_number_that_is_lost_after_a_proof_takes_it_back[nan]",
    ),
    Fault(
        "huge factors of a constraint are rescaled without its constant",
        _VNNLIB,
        "_scaled",
        "np.ldexp(row, shift), moved",
        "np.ldexp(row, shift), constant",
        "test_certify_properties.py::test_vnnlib_factors_change_no_verdict[1e300]",
    ),
    Fault(
        "network: half of a sum's roundings are charged",
        _NETWORK,
        "_Cells._combine",
        "count + _FOLDING",
        "0.5 * (count + _FOLDING)",
        "test_network_rounding.py::test_sums_that_lose_as_much_as_they_can[1]",
    ),
    Fault(
        "network: the first layer's rounding is dropped",
        _NETWORK,
        "_Cells._combine",
        "moves + rows * width",
        "(moves if k > 1 else 0.0 * moves) + rows * width",
        "test_network_rounding.py::test_sums_that_lose_as_much_as_they_can[2]",
    ),
    Fault(
        "network: rounding before an activation is dropped",
        _NETWORK,
        "_Cells._activate",
        "rounded.abs()",
        "0.0",
        "test_network_rounding.py::test_sums_that_lose_as_much_as_they_can[3]",
    ),
    Fault(
        "network: rounding is charged at the middle of a set alone",
        _NETWORK,
        "_Cells._combine",
        "torch.maximum(f.interval.size, f.reference.abs())",
        "f.reference.abs() + 0.0 * f.interval.size",
        "test_network_rounding.py::test_rounding_counts_the_largest_image_of_a_set",
    ),
    Fault(
        "network: rows' own rounding is dropped",
        _NETWORK,
        "_Cells._combine",
        "rows",
        "0.0",
        "test_network_rounding.py::test_rounding_of_rows_over_sets",
    ),
    Fault(
        "network: references' own rounding is dropped",
        _NETWORK,
        "_Cells._combine",
        "(layer.terms + len(inputs) + 8) * 2.0**-52",
        "0.0",
        "test_network_rounding.py::test_exact_network_at_single_images[1024.0-False]",
    ),
    Fault(
        "network: units that may be on count as zeros",
        _NETWORK,
        "_Cells._activate",
        "upper > 0.0",
        "lower > 0.0",
        "test_network_rounding.py::test_units_that_may_be_on_are_terms",
    ),
)
