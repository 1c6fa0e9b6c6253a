"""Bounds of matrix inverses of a set of matrices: the paper's MATRIXINV, and the adjugate."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from ns_abstract.paper.affine import Face, constant_like, range_of
from ns_abstract.paper.interval import Float64Array, Interval

Norm = Literal["frobenius", "spectral"]


def matrix_norm(x: Interval, norm: Norm) -> Float64Array | np.float64:
    """Return an upper bound of a submultiplicative norm of a matrix [n, m] that is at least the largest entry.

    "spectral" is bounded by ``sqrt(|x|_1 |x|_inf)``.
    """
    if norm == "frobenius":
        return x.norm().upper
    size = Interval(x.magnitude)
    columns, rows = size.sum(0).upper.max(initial=0.0), size.sum(1).upper.max(initial=0.0)
    return (Interval(columns) * rows).sqrt().upper if np.isfinite(columns + rows) else np.float64(np.inf)


def _unbounded(x: Face) -> Face:
    return constant_like(x, Interval.entire(x.shape))


def matrix_inverse(x: Face, reference: Float64Array | None = None, order: int = 2, norm: Norm = "frobenius") -> Face:
    """Return MATRIXINV (Algorithm 3): ``X^-1`` by a Taylor polynomial around a reference matrix.

    With ``R`` a floating-point inverse of the reference and ``D = I - X R``,

        X^-1 = R (D^0 + ... + D^k) + E,    |E_ij| <= |R| |D|^(k+1) / (1 - |D|)       (eqs. 9-12)

    The paper's ``-(X - X_ref) X_ref^-1`` is ``I - X R`` for the exact inverse; written so, the
    identity holds for every ``R``, whose rounding then needs no bound. Powers are taken by Horner's
    rule. Costs k products of n x n matrices.

    Args:
        x: Matrices [n, n], of any face.
        reference: [n, n] the expansion point; the middle of ``x`` if None.
        order: Taylor order k.

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
    middle = range_of(x).middle if reference is None else np.asarray(reference, np.float64)
    try:
        inverse = np.linalg.inv(middle)
    except np.linalg.LinAlgError:
        return _unbounded(x)
    if not np.all(np.isfinite(inverse)):
        return _unbounded(x)
    identity = np.eye(n)
    difference = identity - x @ inverse
    distance, scale = matrix_norm(range_of(difference), norm), matrix_norm(Interval(inverse), norm)
    if not (distance < 1.0 and scale < np.inf):
        return _unbounded(x)
    size = Interval(distance)
    remainder = (Interval(scale) * size.power(order + 1) / (1.0 - size)).upper
    if not remainder < np.inf:
        return _unbounded(x)
    total = difference + identity if order else difference * 0.0 + identity
    for _ in range(order - 1):
        total = total @ difference + identity
    return inverse @ total + Interval(np.full((n, n), -remainder), np.full((n, n), remainder))


def adjugate_inverse(x: Face) -> Face:
    """Return the inverse of 2 x 2 matrices as adjugate over determinant, the paper's point of comparison.

    Args:
        x: Matrices [2, 2], of any face.

    Raises:
        ValueError: Another shape.
    """
    if x.shape != (2, 2):
        raise ValueError(f"the adjugate is written out for [2, 2], got {x.shape}")
    a, b, c, d = x[0, 0], x[0, 1], x[1, 0], x[1, 1]
    determinant = a * d - b * c
    factor = determinant.reciprocal()
    # of the face of x, which checkers lose in a list
    entries: list[Any] = [e * factor for e in (d, -b, -c, a)]
    return type(x).stack(entries).reshape(2, 2)
