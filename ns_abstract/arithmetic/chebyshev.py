"""Polynomials of ``[-1, 1]^d`` in Chebyshev's basis: interpolation, ranges and fits with certified errors.

A polynomial of total degree ``D`` is its coefficients in ``T_k(p) = prod_j T_{k_j}(p_j)``, ``|k| <= D`` (design.md,
F2). Who applies the matrices built here adds `CHEBYSHEV_ROUNDING` times the sum of absolute coefficients.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from ns_abstract.arithmetic.forms import Float64Array
from ns_abstract.arithmetic.rounding import GRID_UP, INTERPOLATION_ROUNDINGS, gamma


def chebyshev_values(points: Float64Array, degree: int) -> Float64Array:
    """Return [..., degree + 1] values of T_0 .. T_degree at ``points`` [...] in [-1, 1]."""
    angle = np.arccos(np.clip(points, -1.0, 1.0))
    return np.cos(angle[..., None] * np.arange(degree + 1))


@dataclass(frozen=True)
class ChebyshevBasis:
    """Polynomials of ``dimensions`` variables up to a total ``degree``.

    ``grid``, above ``degree``: intervals by axis of the grid (extrema of T_grid) on which ranges and fits are taken.
    """

    dimensions: int
    degree: int
    grid: int

    @cached_property
    def _tensor(self) -> list[tuple[int, ...]]:
        return list(itertools.product(range(self.degree + 1), repeat=self.dimensions))

    @cached_property
    def indices(self) -> NDArray[np.int64]:
        """[m, d] degrees by axis of every coefficient, the constant first."""
        exponents = sorted((k for k in self._tensor if sum(k) <= self.degree), key=lambda k: (sum(k), k))
        return np.array(exponents, np.int64).reshape(len(exponents), self.dimensions)

    @property
    def size(self) -> int:
        """Number m of coefficients."""
        return len(self.indices)

    def _points(self, axis_points: Float64Array) -> Float64Array:
        points = list(itertools.product(axis_points, repeat=self.dimensions))
        return np.array(points, np.float64).reshape(len(points), self.dimensions)

    def values(self, points: Float64Array) -> Float64Array:
        """Return [n, m] values of the basis at ``points`` [n, d]."""
        by_axis = chebyshev_values(np.asarray(points, np.float64), self.degree)
        out = np.ones((len(points), self.size))
        for j in range(self.dimensions):
            out *= by_axis[:, j][:, self.indices[:, j]]
        return out

    @cached_property
    def nodes(self) -> Float64Array:
        """[(degree + 1)^d, d] Chebyshev's nodes of interpolation."""
        n = self.degree + 1
        return self._points(np.cos(np.pi * (np.arange(n) + 0.5) / n))

    @cached_property
    def interpolation(self) -> tuple[Float64Array, Float64Array]:
        """Matrices from node values to coefficients of an interpolant: [m, nodes] of the basis, [rest, nodes] above."""
        n = self.degree + 1
        by_axis = chebyshev_values(np.cos(np.pi * (np.arange(n) + 0.5) / n), self.degree).T * (2.0 / n)
        by_axis[0] *= 0.5
        matrix = np.ones((1, 1))
        for _ in range(self.dimensions):
            matrix = np.kron(matrix, by_axis)
        places = {k: i for i, k in enumerate(self._tensor)}
        rows = [places[tuple(k)] for k in self.indices.tolist()]
        rest = [i for k, i in places.items() if sum(k) > self.degree]
        return matrix[rows], matrix[rest]

    @cached_property
    def interpolation_rounding(self) -> float:
        """Bound of the summed rounding errors of an interpolant's coefficients, by the largest value at a node (F3)."""
        size = sum(float(np.abs(matrix).sum()) for matrix in self.interpolation)
        return gamma(len(self.nodes) + INTERPOLATION_ROUNDINGS) * size * GRID_UP

    @property
    def lebesgue(self) -> float:
        """Upper bound of the norm of interpolation along one axis."""
        return 2.0 / math.pi * math.log(self.degree + 1) + 1.0

    @cached_property
    def evaluation(self) -> Float64Array:
        """[g, m] values on the grid of ``grid + 1`` points by axis, the last axis fastest."""
        return self.values(self._points(np.cos(np.pi * np.arange(self.grid + 1) / self.grid)))

    @cached_property
    def fit(self) -> Float64Array:
        """[m, g] coefficients of a function given on the grid: its Chebyshev series, cut after the degree."""
        n = self.grid
        weights = np.full(n + 1, 2.0 / n)
        weights[[0, -1]] *= 0.5
        whole = np.ones(1)
        for _ in range(self.dimensions):
            whole = np.outer(whole, weights).ravel()
        scale = np.prod(np.where(self.indices == 0, 0.5, 1.0), axis=1)
        return self.evaluation.T * whole * scale[:, None]

    @property
    def norming(self) -> float:
        """Bound of max |polynomial| on [-1, 1]^d divided by its maximum on the grid (Ehlich and Zeller 1964)."""
        return math.cos(0.5 * math.pi * self.degree / self.grid) ** -self.dimensions * GRID_UP

    @cached_property
    def chord(self) -> Float64Array:
        """[m] weights of |coefficients|: distance from a polynomial to its multilinear interpolant on the grid.

        In ``theta_j = arccos p_j`` the grid is uniform with step ``pi / grid``, and the second derivative of
        T_k is at most ``k_j^2`` along axis j.
        """
        step = np.pi / self.grid
        return 0.125 * step * step * GRID_UP * np.square(self.indices.astype(np.float64)).sum(axis=1)

    def bernstein(self, parts: tuple[int, ...]) -> Float64Array:
        """Return [n, (degree + 1)^d, m] Bernstein coefficients of every basis polynomial, on parts of ``[-1, 1]^d``.

        A polynomial's values on a part lie between its least and largest Bernstein coefficient there.

        Args:
            parts: Number of parts by axis; n is their product, the last axis runs fastest.
        """
        places = {k: i for i, k in enumerate(self._tensor)}
        columns = [places[tuple(k)] for k in self.indices.tolist()]
        coefficients = []
        for part in itertools.product(*(bernstein_matrices(self.degree, count) for count in parts)):
            matrix = np.ones((1, 1))
            for factor in part:
                matrix = np.kron(matrix, factor)
            coefficients.append(matrix[:, columns])
        return np.stack(coefficients)


@lru_cache(maxsize=64)
def bernstein_matrices(degree: int, parts: int) -> Float64Array:
    """Return [parts, degree + 1, degree + 1] Bernstein coefficients of T_0 .. T_degree on equal parts of [-1, 1].

    The monomials between the two bases cancel badly, so the entries are computed in integers and rounded once.
    """
    numerators, denominator = _bernstein_integers(degree, parts)
    # Python divides integers with one rounding
    return np.array([a / denominator for a in numerators.ravel()]).reshape(numerators.shape)


@lru_cache(maxsize=64)
def _bernstein_integers(degree: int, parts: int) -> tuple[NDArray[np.object_], int]:
    """Return `bernstein_matrices` as numerators [parts, degree + 1, degree + 1] and a common denominator."""
    n = degree + 1
    if parts % 2 == 0:
        # de Casteljau: a row of left ends and a row of right ends of the triangle are the halves' coefficients
        rows, denominator = _bernstein_integers(degree, parts // 2)
        rows = rows.copy()
        left, right = np.empty((2, *rows.shape), object)
        for i in range(n):
            left[:, i] = rows[:, 0] * 2 ** (degree - i)
            right[:, degree - i] = rows[:, -1] * 2 ** (degree - i)
            rows = rows[:, :-1] + rows[:, 1:]
        return np.stack([left, right], axis=1).reshape(parts, n, n), denominator * 2**degree
    series = [[0] * n for _ in range(n)]  # [monomial][k]
    series[0][0] = 1
    for k in range(1, n):
        for i in range(k + 1):
            twice = (2 if k > 1 else 1) * (series[i - 1][k - 1] if i else 0)
            series[i][k] = twice - (series[i][k - 2] if k > 1 else 0)
    out = np.empty((parts, n, n), object)
    common = math.lcm(*(math.comb(degree, j) for j in range(n)))
    weights = [[math.comb(i, j) * (common // math.comb(degree, j)) for j in range(i + 1)] for i in range(n)]
    for part in range(parts):
        # p = (start + 2 u) / parts with u in [0, 1]
        start = 2 * part - parts
        powers = [start**i for i in range(n)]
        shifted = [
            [
                2**j * sum(math.comb(i, j) * powers[i - j] * parts ** (degree - i) * series[i][k] for i in range(j, n))
                for k in range(n)
            ]
            for j in range(n)
        ]
        for i in range(n):
            for k in range(n):
                out[part, i, k] = sum(weights[i][j] * shifted[j][k] for j in range(i + 1))
    return out, common * parts**degree
