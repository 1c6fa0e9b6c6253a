"""The table of rules: one entry for each operation of "Abstract Rendering", Table 1."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from ns_abstract.arithmetic.form_array import FormArray
from ns_abstract.paper.affine import Enclosure
from ns_abstract.paper.depth_order import sort_by
from ns_abstract.paper.interval import Float64Array, Interval
from ns_abstract.paper.matrix_inverse import matrix_inverse

_INVERSE_ORDER = 4
#: Most entries of a matrix whose corners are enumerated.
CORNER_LIMIT = 9


@dataclass(frozen=True)
class Rule:
    """One operation and its faces.

    Attributes:
        name: The paper's name.
        concrete: The operation on float64 arrays.
        bound: The operation on `Interval` and on `Enclosure`.
        domain: Where the operation is defined; outside, the faces return ``[-inf, inf]``.
        source: Where the operation and its bound come from.
        continuous: False if both outcomes are enclosed where a decision is open.
    """

    name: str
    concrete: Callable[..., Float64Array]
    bound: Callable[..., Any]
    domain: str
    source: str
    continuous: bool = True

    def interval(self, *operands: Any) -> Interval:
        """Intervals that hold the result for all values of the operands' intervals.

        Args:
            operands: Intervals or numbers; exponents are integers.
        """
        return self.bound(*(x if isinstance(x, Interval | int) else Interval(x) for x in operands))

    def affine(self, *operands: Any) -> Enclosure:
        """Forms and ranges of the result; the range is never wider than `interval` of the ranges.

        Args:
            operands: Enclosures or forms, at least one, and numbers; exponents are integers.

        Raises:
            TypeError: No operand has a form.
        """
        bases = [x.basis for x in operands if isinstance(x, Enclosure | FormArray)]
        if not bases:
            raise TypeError(f"{self.name}: the affine face takes at least one form")
        lifted = [x if isinstance(x, int) else Enclosure.lift(x, bases[0]) for x in operands]
        whole = self.interval(*(x if isinstance(x, int) else x.range for x in lifted))
        return self.bound(*lifted).meet(whole)


def _matrix_power(x: Interval | Enclosure, exponent: int) -> Interval | Enclosure:
    n = x.shape[0]
    if n == 1:
        return x.power(exponent)
    identity = Interval(np.eye(n))
    result = identity if isinstance(x, Interval) else Enclosure.of(x.basis, identity)
    for step in range(exponent):
        result = result @ x if step else x
    return result


def _inverse(x: Interval | Enclosure) -> Interval | Enclosure:
    # any norm is sound; this one is the smaller of the two for most matrices
    if isinstance(x, Enclosure):
        return matrix_inverse(x, order=_INVERSE_ORDER, norm="spectral")
    taylor = matrix_inverse(x, order=_INVERSE_ORDER, norm="spectral")
    if x.lower.size <= CORNER_LIMIT and np.all(np.isfinite(x.lower) & np.isfinite(x.upper)):
        return taylor.intersect(corner_inverse(x))
    return taylor


def _frobenius(x: Float64Array) -> Float64Array:
    return np.sqrt(np.sum(np.square(x)))


def permute(x: Float64Array, y: Float64Array) -> Float64Array:
    """``x`` reordered by ascending ``y``, equal ones in place."""
    return np.asarray(x)[np.argsort(y, kind="stable")]


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


_TABLE = "Abstract Rendering, Table 1"
_ENTRIES = (
    Rule("Add", np.add, lambda x, y: x + y, "all reals", f"{_TABLE}: z_ij = x_ij + y_ij"),
    Rule("Mul", np.multiply, lambda x, y: x * y, "all reals", f"{_TABLE}: z_ij = x_ij y_ij; forms.py, multiply"),
    Rule("Div", np.reciprocal, lambda x: x.reciprocal(), "x > 0 (x < 0 as well)", f"{_TABLE}: z_ij = 1 / x_ij"),
    Rule("Mmul", np.matmul, lambda x, y: x @ y, "all reals", f"{_TABLE}: z = x y"),
    Rule("Inv", np.linalg.inv, _inverse, "det x != 0", f"{_TABLE}: z = x^-1; Algorithm 3; corner_inverse"),
    Rule("Pow", np.linalg.matrix_power, _matrix_power, "k a natural number", f"{_TABLE}: z = x^k, square x"),
    Rule("Sum", lambda x: np.sum(x, axis=-1), lambda x: x.sum(-1), "all reals", f"{_TABLE}: z = sum_i x_i"),
    Rule("Prod", lambda x: np.prod(x, axis=-1), lambda x: x.prod(-1), "all reals", f"{_TABLE}: z = prod_i x_i"),
    Rule("Transpose", np.transpose, lambda x: x.transpose(), "all reals", f"{_TABLE}: z_ij = x_ji"),
    Rule("Exp", np.exp, lambda x: x.exp(), "all reals", f"{_TABLE}: z_ij = exp(x_ij); elementary.py, exp_kernel"),
    Rule("Norm", _frobenius, lambda x: x.norm(), "all reals", f"{_TABLE}: z = |x|, Frobenius"),
    Rule(
        "Ind", lambda x: (np.asarray(x) > 0.0).astype(np.float64), lambda x: x.indicator(), "all reals",
        f"{_TABLE}: z_ij = 1 if x_ij > 0 else 0; eq. 17", continuous=False,
    ),
    Rule(
        "Sort", permute, sort_by, "all reals", f"{_TABLE}: permute x based on y; eq. 14", continuous=False,
    ),
)  # fmt: skip

#: The rules by name.
RULES: Mapping[str, Rule] = MappingProxyType({rule.name: rule for rule in _ENTRIES})
