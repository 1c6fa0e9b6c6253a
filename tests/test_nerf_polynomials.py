"""Taylor models of poses and polynomials in Chebyshev's basis: everything is enclosed, nothing is loose."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction

import mpmath
import numpy as np
import pytest
from nerfs import poses

from ns_abstract.arithmetic.chebyshev import ChebyshevBasis, bernstein_matrices, chebyshev_values
from ns_abstract.arithmetic.rounding import CHEBYSHEV_ROUNDING
from ns_abstract.arithmetic.taylor import TaylorArray, TaylorBasis, taylor_cos_sin
from ns_abstract.geometry.poses import PoseBox

SETS = {
    "yaw": {"rotation": {"yaw": 0.05}},
    "shift": {"translation": {"x": 0.1}},
    "orbit": {"orbit": {"target": [0, 0.2, 0], "axis": [0.1, 0, 1], "azimuth": [0, 0.4]}},
    "segment": {"sweep": "segments"},
    "all": {
        "translation": {"x": 0.02, "z": [0, 0.05]},
        "rotation": {"yaw": 0.03, "pitch": [0.1, 0.1], "roll": 0.02},
        "orbit": {"target": [0, 0, 0], "axis": [0, 0, 1], "azimuth": [0, 0.1]},
    },
    "world": {"frame": "world", "translation": {"y": 0.03}, "rotation": {"roll": 0.2}},
    "point": {"rotation": {"yaw": [0.1, 0.1]}},
}


def evaluate(model: TaylorArray, scaled: np.ndarray) -> np.ndarray:
    exponents = np.array(model.basis.exponents, np.int64).reshape(model.coefficients.shape[0], scaled.size)
    return np.tensordot(np.prod(scaled**exponents, axis=1), model.coefficients, 1)


def worst_pose(pose_set: PoseBox, degree: int, shrink: float = 1.0) -> float:
    """Largest distance of a concrete pose from the model, in units of ``shrink`` times its radius."""
    models = pose_set.taylor(pose_set.box, degree)
    box, rng, worst = pose_set.box, np.random.default_rng(3), 0.0
    low, high = np.array(box.lower), np.array(box.upper)
    for values in [*box.corners(), *box.sample(60, rng)] if box.dimensions else [np.zeros(0)]:
        scaled = (2.0 * values - low - high) / (high - low) if box.dimensions else values
        pose = pose_set.pose(values)
        for model, part in zip(models, (pose[:, :3], pose[:, 3]), strict=True):
            worst = max(worst, float((np.abs(evaluate(model, scaled) - part) / (shrink * model.radius)).max()))
    return worst


@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("degree", [1, 3, 6])
def test_poses_are_enclosed(name: str, degree: int) -> None:
    assert worst_pose(poses(SETS[name]), degree) <= 1.0


def test_the_remainder_of_a_pose_is_needed_and_small() -> None:
    yaw = poses(SETS["yaw"])
    assert worst_pose(yaw, 3, shrink=0.5) > 1.0
    assert max(float(model.radius.max()) for model in yaw.taylor(yaw.box, 6)) < 1e-12


@pytest.mark.parametrize("half", [1e-9, 0.01, 0.1, 0.5, 3.0])
def test_functions_of_taylor_models(half: float) -> None:
    basis = TaylorBasis(1, 5)
    angle = TaylorArray.parameter(basis, 0, 0.7, half)
    square = TaylorArray.parameter(basis, 0, 2.0, min(half, 1.5)) * 1.0
    found = [*taylor_cos_sin(angle), square.rsqrt(), angle * angle * angle - angle]
    with mpmath.workdps(40):
        for p in np.linspace(-1, 1, 41):
            x = mpmath.mpf(0.7) + mpmath.mpf(half) * mpmath.mpf(p)
            y = mpmath.mpf(2) + mpmath.mpf(min(half, 1.5)) * mpmath.mpf(p)
            for model, true in zip(found, (mpmath.cos(x), mpmath.sin(x), 1 / mpmath.sqrt(y), x**3 - x), strict=True):
                value = sum(mpmath.mpf(float(c)) * mpmath.mpf(p) ** k for k, c in enumerate(model.coefficients))
                assert abs(value - true) <= mpmath.mpf(float(model.radius))


@pytest.mark.parametrize("basis", [TaylorBasis(1, 5), TaylorBasis(2, 4)], ids=str)
def test_rounding_of_products(basis: TaylorBasis) -> None:
    """Exact factors whose product's degree is kept: all that a radius pays for is rounding, and it is needed."""
    rng, worst = np.random.default_rng(5), 0.0
    for _ in range(40):
        factors = []
        for _ in range(2):
            coefficients = np.array([sum(e) <= basis.degree // 2 for e in basis.exponents]) * rng.uniform(
                -1.0, 1.0, len(basis.exponents)
            )
            factors.append(TaylorArray(basis, coefficients, np.zeros(())))
        a, b = factors
        product = a * b
        for p in itertools.product((Fraction(-1), Fraction(1, 3), Fraction(1)), repeat=basis.dimensions):
            powers = [math.prod(x**k for x, k in zip(p, e, strict=True)) for e in basis.exponents]
            values = [
                sum(Fraction(float(c)) * w for c, w in zip(model.coefficients, powers, strict=True))
                for model in (a, b, product)
            ]
            error = abs(values[0] * values[1] - values[2])
            assert error <= Fraction(float(product.radius))
            worst = max(worst, float(error))
    assert worst > 0.0


def test_root_of_what_may_vanish_is_not_bounded() -> None:
    model = TaylorArray.parameter(TaylorBasis(1, 3), 0, 1.0, 1.0).rsqrt()
    assert np.isinf(model.radius)


# ---------------------------------------------------------------- Chebyshev


@pytest.mark.parametrize(("degree", "parts"), [(0, 1), (1, 3), (5, 4), (20, 64)])
def test_bernstein_matrices_are_rounded_once(degree: int, parts: int) -> None:
    """Against exact arithmetic: the polynomial of the coefficients agrees at rational points."""
    matrix = bernstein_matrices(degree, parts)
    part = parts // 2
    start = Fraction(2 * part, parts) - 1
    for k in {0, degree // 2, degree}:
        for u in (Fraction(0), Fraction(1, 3), Fraction(1)):
            p, values = start + Fraction(2, parts) * u, [Fraction(1), start + Fraction(2, parts) * u]
            for _ in range(k - 1):
                values.append(2 * p * values[-1] - values[-2])
            size = sum(abs(Fraction(float(m))) for m in matrix[part, :, k])
            value = Fraction(0)
            for i in range(degree + 1):
                weight = Fraction(1)
                for j in range(i):
                    weight = weight * (degree - j) / (j + 1)
                value += Fraction(float(matrix[part, i, k])) * weight * u**i * (1 - u) ** (degree - i)
            assert abs(value - values[k]) <= Fraction(1, 2**52) * size


@pytest.mark.parametrize(("dimensions", "degree", "grid"), [(1, 20, 120), (2, 6, 20), (3, 4, 10), (0, 1, 2)])
def test_interpolation_ranges_and_fits(dimensions: int, degree: int, grid: int) -> None:
    basis, rng = ChebyshevBasis(dimensions, degree, grid), np.random.default_rng(1)
    points = rng.uniform(-1, 1, (2000, dimensions))
    parts = (4,) * dimensions
    bernstein = basis.bernstein(parts)
    place = np.zeros(len(points), int)
    for j in range(dimensions):
        place = place * 4 + np.minimum(3, ((points[:, j] + 1.0) * 2.0).astype(int))
    for decay in (0.0, 1.0, 3.0):
        c = rng.normal(size=basis.size) / (1.0 + basis.indices.sum(axis=1)) ** decay
        slack = CHEBYSHEV_ROUNDING * np.abs(c).sum()
        values, on_grid = basis.values(points) @ c, basis.evaluation @ c
        assert np.abs(basis.interpolation[0] @ (basis.values(basis.nodes) @ c) - c).max() < slack
        assert np.abs(basis.fit @ on_grid - c).max() < slack
        assert np.abs(values).max() <= np.abs(on_grid).max() * basis.norming + slack
        controls = bernstein @ c
        assert (values <= controls.max(axis=1)[place] + slack).all()
        assert (values >= controls.min(axis=1)[place] - slack).all()


def test_values_of_the_basis() -> None:
    points = np.array([-1.0, -0.3, 0.0, 0.999999, 1.0])
    with mpmath.workdps(30):
        for k, p in np.ndindex(21, points.size):
            value = float(chebyshev_values(points, 20)[p, k])
            assert abs(mpmath.chebyt(k, mpmath.mpf(points[p])) - value) < 40 * 20 * 2.0**-53
