"""Bounds of matrix inverses: the paper's MATRIXINV, the adjugate, and the exact hull over corners.

All take a set of matrices ``X`` and return a set that holds ``X^-1`` of each of them.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from ns_abstract.paper.affine import Enclosure
from ns_abstract.paper.interval import Float64Array, Interval
from ns_abstract.paper.linear import Face, LinearBounds, constant_like

Norm = Literal["frobenius", "spectral"]

#: Most entries of a matrix whose corners are enumerated.
CORNER_LIMIT = 9


def _range(x: Interval | Enclosure | LinearBounds) -> Interval:
    return x if isinstance(x, Interval) else x.range


def matrix_norm(x: Interval, norm: Norm) -> Float64Array | np.float64:
    """Upper bound of a submultiplicative norm that is at least the largest entry.

    Args:
        x: Matrix [n, m].
        norm: "frobenius", or "spectral", bounded by ``sqrt(|x|_1 |x|_inf)``.
    """
    if norm == "frobenius":
        return x.norm().upper
    size = Interval(x.magnitude)
    columns, rows = size.sum(0).upper.max(initial=0.0), size.sum(1).upper.max(initial=0.0)
    return (Interval(columns) * rows).sqrt().upper if np.isfinite(columns + rows) else np.float64(np.inf)


def _unbounded(x: Face) -> Face:
    return constant_like(x, Interval.entire(x.shape))


def _product(x: Face, y: Face, weight: float) -> Face:
    """``x * y``, with this weight of McCormick's planes where there are any."""
    if isinstance(x, LinearBounds) and isinstance(y, LinearBounds):
        return x.multiply(y, weight)
    return x * y


def _matrix_product(x: Face, y: Face, weight: float) -> Face:
    """``x @ y``, with this weight of McCormick's planes where there are any."""
    if isinstance(x, LinearBounds) and isinstance(y, LinearBounds):
        return x.matmul(y, weight)
    return x @ y


def matrix_inverse(
    x: Face,
    reference: Float64Array | None = None,
    order: int = 2,
    norm: Norm = "frobenius",
    weights: Sequence[float] = (),
) -> Face:
    """MATRIXINV (Algorithm 3): ``X^-1`` by a Taylor polynomial around a reference matrix.

    With ``R`` a floating-point inverse of the reference and ``D = I - X R``,

        X^-1 = R (D^0 + ... + D^k) + E,    |E_ij| <= |R| |D|^(k+1) / (1 - |D|)       (eqs. 9-12)

    The paper's ``-(X - X_ref) X_ref^-1`` is ``I - X R`` for the exact inverse; written so, the
    identity holds for every ``R``, whose rounding then needs no bound. Powers are taken by Horner's
    rule. Costs k products of n x n matrices.

    Args:
        x: Matrices [n, n], of any face.
        reference: [n, n] the expansion point; the middle of ``x`` if None.
        order: Taylor order k.
        norm: The norm of the remainder.
        weights: Weights of McCormick's planes in the k - 1 products of `LinearBounds` (default 1).

    Returns:
        The same face; unbounded where ``|D| < 1`` cannot be shown (the paper's line 2 fails there).

    Raises:
        ValueError: The matrices are not square or the order is negative.
    """
    n = x.shape[0]
    if len(x.shape) != 2 or x.shape[1] != n:
        raise ValueError(f"only square matrices have an inverse, got shape {x.shape}")
    if order < 0:
        raise ValueError(f"the Taylor order must not be negative, got {order}")
    middle = _range(x).middle if reference is None else np.asarray(reference, np.float64)
    try:
        inverse = np.linalg.inv(middle)
    except np.linalg.LinAlgError:
        return _unbounded(x)
    if not np.all(np.isfinite(inverse)):
        return _unbounded(x)
    identity = np.eye(n)
    difference = identity - x @ inverse
    distance, scale = matrix_norm(_range(difference), norm), matrix_norm(Interval(inverse), norm)
    if not (distance < 1.0 and scale < np.inf):
        return _unbounded(x)
    size = Interval(distance)
    remainder = (Interval(scale) * size.power(order + 1) / (1.0 - size)).upper
    if not remainder < np.inf:
        return _unbounded(x)
    total = difference + identity if order else difference * 0.0 + identity
    for step in range(order - 1):
        weight = weights[step] if step < len(weights) else 1.0
        total = _matrix_product(total, difference, weight) + identity
    return inverse @ total + Interval(np.full((n, n), -remainder), np.full((n, n), remainder))


def adjugate_inverse(x: Face, weights: tuple[float, float] = (1.0, 1.0)) -> Face:
    """The inverse of 2 x 2 matrices as adjugate over determinant, the paper's point of comparison.

    Args:
        x: Matrices [2, 2], of any face.
        weights: Weights of McCormick's planes in the determinant and in the last product
            (`LinearBounds` only).

    Raises:
        ValueError: Another shape.
    """
    if x.shape != (2, 2):
        raise ValueError(f"the adjugate is written out for [2, 2], got {x.shape}")
    a, b, c, d = x[0, 0], x[0, 1], x[1, 0], x[1, 1]
    determinant = _product(a, d, weights[0]) - b * c
    factor = determinant.reciprocal()
    # of the face of x, which checkers lose in a list
    entries: list[Any] = [_product(e, factor, weights[1]) for e in (d, -b, -c, a)]
    return type(x).stack(entries).reshape(2, 2)


def corner_inverse(x: Interval) -> Interval:
    """The interval hull of ``X^-1``, exact up to rounding, for up to 3 x 3 independent entries.

    The determinant and every cofactor are affine in each entry of X by itself, so each entry of the
    inverse is a linear-fractional, hence monotone, function of each entry of X wherever the
    determinant keeps its sign: its extremes lie on the 2^(n^2) corners of the box. The determinant,
    multi-affine, keeps its sign if it has the same sign on all corners.

    Args:
        x: Matrices [n, n].

    Returns:
        [n, n]; unbounded where the set may hold a singular matrix.

    Raises:
        ValueError: Not square, or more than `CORNER_LIMIT` entries.
    """
    n = x.shape[0]
    if x.shape != (n, n) or x.lower.size > CORNER_LIMIT:
        raise ValueError(f"corners are enumerated for square matrices of up to 3 rows, got {x.shape}")
    ends = [sorted({low, high}) for low, high in zip(x.lower.ravel(), x.upper.ravel(), strict=True)]
    corners = Interval(np.array(list(itertools.product(*ends))).reshape(-1, n, n))
    determinant, adjugate = _determinant(corners), _adjugate(corners)
    if not (np.all(determinant.lower > 0.0) or np.all(determinant.upper < 0.0)):
        return Interval.entire((n, n))
    inverses = adjugate / determinant.reshape(-1, 1, 1)
    return Interval(inverses.lower.min(axis=0), inverses.upper.max(axis=0))


def _determinant(x: Interval) -> Interval:
    """Determinants of [..., n, n], expanded along the first row."""
    n = x.shape[-1]
    if n == 1:
        return x[..., 0, 0]
    total = Interval(np.zeros(x.shape[:-2]))
    for j in range(n):
        term = x[..., 0, j] * _determinant(x[..., 1:, [k for k in range(n) if k != j]])
        total = total - term if j % 2 else total + term
    return total


def _adjugate(x: Interval) -> Interval:
    """Adjugates of [..., n, n]."""
    n = x.shape[-1]
    if n == 1:
        return Interval(np.ones(x.shape))
    rows = []
    for i in range(n):
        entries = []
        for j in range(n):
            # entry (i, j) is the cofactor of (j, i)
            keep_rows, keep_columns = [k for k in range(n) if k != j], [k for k in range(n) if k != i]
            minor = _determinant(x[..., keep_rows, :][..., keep_columns])
            entries.append(-minor if (i + j) % 2 else minor)
        rows.append(Interval.stack(entries))
    stacked = Interval.stack(rows)
    return Interval(*(np.moveaxis(end, (0, 1), (-2, -1)) for end in stacked.bounds()))
