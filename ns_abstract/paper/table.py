"""The table of rules: one entry for each operation of "Abstract Rendering", Table 1."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from ns_abstract.arithmetic.form_array import FormArray
from ns_abstract.paper.affine import Enclosure
from ns_abstract.paper.depth_order import permute, sort_by
from ns_abstract.paper.interval import Float64Array, Interval
from ns_abstract.paper.matrix_inverse import CORNER_LIMIT, corner_inverse, matrix_inverse

_INVERSE_ORDER = 4


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
