"""Faults in Taylor models and in polynomials in Chebyshev's basis."""

from planted.fault import Fault

_TAYLOR, _CHEBYSHEV = "arithmetic/taylor.py", "arithmetic/chebyshev.py"
_FUNCTIONS = "test_nerf_polynomials.py::test_functions_of_taylor_models"
_POSES = "test_nerf_polynomials.py::test_poses_are_enclosed"
_RANGES = "test_nerf_polynomials.py::test_interpolation_ranges_and_fits"

POLYNOMIALS = (
    Fault(
        "Taylor models: terms above the degree are forgotten",
        _TAYLOR, "TaylorArray.__mul__", "dropped += np.abs(product)", "pass", _POSES,
    ),
    Fault(
        "Taylor models: a product forgets one operand's radius",
        _TAYLOR, "TaylorArray.__mul__", "a.size * b.radius", "0.0 * b.radius", _POSES,
    ),
    Fault(
        "Taylor models: a product's rounding is not charged",
        _TAYLOR, "TaylorArray.__mul__", "taylor_product_rounding(len(self.basis.exponents)) * a.size * b.size",
        "0.0 * a.size * b.size", "test_nerf_polynomials.py::test_rounding_of_products",
    ),
    Fault(
        "Taylor models: a sum forgets one operand's radius",
        _TAYLOR, "TaylorArray.__add__", "a.radius + b.radius + UNIT64 * np.abs(total).sum(axis=0) * TAYLOR_UP",
        "a.radius + 0.0 * b.radius + UNIT64 * np.abs(total).sum(axis=0) * TAYLOR_UP", _POSES,
    ),
    Fault(
        "Taylor models: composition forgets Lagrange's remainder",
        _TAYLOR, "TaylorArray.compose", "slack + last * largest ** (self.basis.degree + 1)", "slack + 0.0 * last",
        _FUNCTIONS + "[0.5]",
    ),
    Fault(
        "Taylor models: the remainder's power is one too high",
        _TAYLOR, "TaylorArray.compose", "largest ** (self.basis.degree + 1)", "largest ** (self.basis.degree + 2)",
        _FUNCTIONS + "[0.1]",
    ),
    Fault(
        "Taylor models: the largest step forgets the radius",
        _TAYLOR, "TaylorArray.compose", "(step.size + step.radius) * TAYLOR_UP",
        "0.5 * step.size", _FUNCTIONS + "[3.0]",
    ),
    Fault(
        "Taylor models: the root's last derivative is taken at the centre",
        _TAYLOR, "TaylorArray.rsqrt", "abs(factors[-1]) * low ** (-0.5 - (n + 1)) * REMAINDER_UP",
        "abs(factors[-1]) * self.center ** (-0.5 - (n + 1)) * REMAINDER_UP", _FUNCTIONS + "[3.0]",
    ),
    Fault(
        "Taylor models: a root of what may vanish is finite",
        _TAYLOR, "TaylorArray.rsqrt", "np.where(low > 0.0, low, np.nan)", "np.where(low > 0.0, low, 1e-3)",
        "test_nerf_polynomials.py::test_root_of_what_may_vanish_is_not_bounded",
    ),
    Fault(
        "Taylor models: sine and cosine change places in the cycle of derivatives",
        _TAYLOR, "taylor_cos_sin", "(cosine, -sine, -cosine, sine)", "(cosine, sine, -cosine, -sine)",
        _FUNCTIONS + "[0.5]",
    ),
    Fault(
        "Taylor models: factorials are left out of the last derivative",
        _TAYLOR, "taylor_cos_sin", "1.0 / math.factorial(n + 1) * FACTORIAL_UP",
        "0.1 / math.factorial(n + 1) * FACTORIAL_UP", _FUNCTIONS + "[0.5]",
    ),
    Fault(
        "Taylor models: the last coefficient of sine and cosine is too small",
        _TAYLOR, "taylor_cos_sin", "cycle[(k + offset) % 4] / math.factorial(k)",
        "cycle[(k + offset) % 4] / math.factorial(k + (k == n))", _FUNCTIONS + "[0.5]",
    ),
    Fault(
        "Chebyshev: an interpolant is charged less than its matrices round",
        "arithmetic/rounding.py", "", "INTERPOLATION_ROUNDINGS = 64", "INTERPOLATION_ROUNDINGS = 0",
        "test_rounding_home.py::test_interpolation_is_charged_for_its_matrices[1-35-126]",
    ),
    Fault(
        "Chebyshev: the grid's largest value bounds the polynomial",
        _CHEBYSHEV, "ChebyshevBasis.norming",
        "math.cos(0.5 * math.pi * self.degree / self.grid) ** -self.dimensions * GRID_UP", "0.97",
        _RANGES,
    ),
    Fault(
        "Chebyshev: the interpolant's constant is doubled",
        _CHEBYSHEV, "ChebyshevBasis.interpolation", "by_axis[0] *= 0.5", "pass", _RANGES + "[1-20-120]",
    ),
    Fault(
        "Chebyshev: the fit's ends weigh as much as its middle",
        _CHEBYSHEV, "ChebyshevBasis.fit", "weights[[0, -1]] *= 0.5", "pass", _RANGES + "[1-20-120]",
    ),
    Fault(
        "Chebyshev: a polynomial's parts change places",
        _CHEBYSHEV, "_bernstein_integers", "np.stack([left, right], axis=1)", "np.stack([right, left], axis=1)",
        _RANGES + "[1-20-120]",
    ),
    Fault(
        "Chebyshev: weights of Bernstein coefficients are off",
        _CHEBYSHEV, "_bernstein_integers", "2 if k > 1 else 1", "2",
        "test_nerf_polynomials.py::test_bernstein_matrices_are_rounded_once[5-4]",
    ),
    Fault(
        "Chebyshev: angles are taken as values",
        _CHEBYSHEV, "chebyshev_values", "np.cos(angle[..., None] * np.arange(degree + 1))",
        "np.cos(angle[..., None] + np.arange(degree + 1))", "test_nerf_polynomials.py::test_values_of_the_basis",
    ),
)  # fmt: skip
