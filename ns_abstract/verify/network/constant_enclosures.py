"""Enclosures of constants that programs compute from stored ones: exact values, and every float32 evaluation.

A folded constant is not the one number that one library returns (docs/dev/design.md, N23). Every result is enclosed
twice: ``real`` holds the exact value, ``evaluated`` the results of every evaluation in the constant's own type, with
sums in any order, fused multiply-add and flushed subnormals. Where both are one number, the constant is exact.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import onnx

from ns_abstract.arithmetic.network_charges import (
    CONSTANT_SUMS,
    DOUBLE_UNIT,
    DOUBTS_UP,
    EXACT,
    FORMATS,
    LIBRARY,
    MAGNITUDES_UP,
    ONCE,
    ONCE_FLUSHES,
    OTHER_LIBRARY,
    OWN_ARGUMENT,
    OWN_CONSTANT,
    FloatFormat,
    gamma,
)
from ns_abstract.io.errors import InputError
from ns_abstract.verify.network.onnx_fold import COMPARES, GROWS, LIBRARIES, MOVES, SHAPES, STEPS, fold
from ns_abstract.verify.network.onnx_tensors import number_type

Interval64 = tuple[np.ndarray, np.ndarray]
_FIX = "fold constants when exporting, in float64"


class EnclosedConstant(NamedTuple):
    """Two float64 enclosures of a constant of the type ``kind``: of its exact value, and of its evaluations."""

    kind: np.dtype
    real: Interval64
    evaluated: Interval64

    @property
    def value(self) -> np.ndarray:
        """A number within ``real``, by element."""
        low, high = self.real
        return np.where(low == high, low, 0.5 * (low + high))

    @property
    def doubts(self) -> Interval64:
        """Distances of ``real`` and ``evaluated`` from `value`, a sixteenth larger for inexact factors."""
        value = self.value
        far = [np.maximum(high - value, value - low) * DOUBTS_UP for low, high in (self.real, self.evaluated)]
        return far[0], far[1]

    @property
    def exact(self) -> bool:
        """Whether every evaluation returns the same numbers."""
        return all(np.array_equal(self.real[0], end) for end in (self.real[1], *self.evaluated))

    def inverse(self) -> EnclosedConstant:
        """Return ``1 / c`` without the rounding of a division."""
        if any(bool((low * high <= 0.0).any()) for low, high in (self.real, self.evaluated)):
            raise InputError("divides by what may be zero", fix="check the constant")
        ends = [
            _widened((1.0 / high, 1.0 / low), OWN_CONSTANT * np.abs(1.0 / low))
            for low, high in (self.real, self.evaluated)
        ]
        return EnclosedConstant(self.kind, ends[0], ends[1])

    def turned(self) -> EnclosedConstant:
        """Return the transposed matrix."""
        real, evaluated = ((low.T, high.T) for low, high in (self.real, self.evaluated))
        return EnclosedConstant(self.kind, real, evaluated)

    def times(self, factor: np.ndarray | float) -> EnclosedConstant:
        """Return the constant multiplied by exact numbers."""
        ends = [_product(pair, (np.asarray(factor), np.asarray(factor))) for pair in (self.real, self.evaluated)]
        wide = [_widened(e, OWN_CONSTANT * np.maximum(np.abs(e[0]), np.abs(e[1]))) for e in ends]
        return EnclosedConstant(self.kind, wide[0], wide[1])


def scaled_integers(number: np.ndarray, scale: EnclosedConstant) -> np.ndarray | EnclosedConstant:
    """Return integers times floats, rounded once."""
    whole = number.astype(np.float64)
    ends = [
        _elementary("Mul", [(whole, whole), part], rounds)
        for part, rounds in ((scale.real, EXACT), (scale.evaluated, FORMATS[scale.kind.itemsize]))
    ]
    product = EnclosedConstant(scale.kind, ends[0], ends[1])
    return product.value.astype(scale.kind) if product.exact else product


def exact_constant(value: np.ndarray) -> EnclosedConstant:
    """Return the enclosure of a stored constant: its exact value."""
    number = value.astype(np.float64)
    return EnclosedConstant(value.dtype, (number, number), (number, number))


def arithmetic(node: onnx.NodeProto, values: Sequence[np.ndarray | None], doubtful: bool) -> bool:
    """Return whether a constant node computes with floats, so that its results need an enclosure."""
    if doubtful:
        return True
    kind = node.op_type
    if kind in MOVES | GROWS | STEPS | SHAPES | {"Abs", "Neg"}:
        return False
    if kind in ("Cast", "CastLike"):
        return True
    if kind == "Range":
        # whole numbers are added without rounding
        return any(v is not None and not np.array_equal(v, np.round(v)) for v in values)
    return any(v is not None and v.dtype.kind == "f" for v in values) and kind not in COMPARES


def fold_enclosed(
    node: onnx.NodeProto, values: Sequence[np.ndarray | EnclosedConstant | None], opset: int
) -> list[np.ndarray | EnclosedConstant]:
    """Return the results of a constant node: arrays where every evaluation agrees, else enclosures.

    Raises:
        InputError: They would be too large, cannot be enclosed, or may be decided either way.
    """
    name = node.op_type
    parts = [
        v if isinstance(v, EnclosedConstant) else exact_constant(v) if v is not None and v.dtype.kind == "f" else None
        for v in values
    ]
    kinds = [p.kind for p in parts if p is not None]
    if name in ("Cast", "CastLike"):
        return [_cast(node, values)]
    if name in COMPARES or name == "Mod":
        raise InputError("decides by a constant that rounding may change", fix=_FIX)
    if not kinds:
        raise InputError("is not computed with floats", fix=_FIX)
    kind = kinds[0]

    def run(side: str) -> list[Interval64]:
        ends = [None if p is None else (p.real if side == "real" else p.evaluated) for p in parts]
        rounds = EXACT if side == "real" else FORMATS[kind.itemsize]

        def put(*numbers: np.ndarray | None) -> list[np.ndarray]:
            """The operator's results where the floats among its inputs are these."""
            arguments = [v if n is None else n for v, n in zip(values, (*numbers, *[None] * len(values)), strict=False)]
            return fold(node, arguments, opset)  # type: ignore[arg-type]

        if name in MOVES | GROWS:
            lower, upper = ([None if e is None else e[k] for e in ends] for k in range(2))
            return list(zip(put(*lower), put(*upper), strict=True))
        return [_computed(name, [e for e in ends if e is not None], lambda v: put(v)[0], rounds)]

    results: list[np.ndarray | EnclosedConstant] = []
    for real, evaluated in zip(run("real"), run("evaluated"), strict=True):
        folded = EnclosedConstant(kind, real, evaluated)
        for end in (*real, *evaluated):
            if not np.isfinite(end).all() or (end.size and np.abs(end).max() >= FORMATS[kind.itemsize].largest):
                if name in MOVES | GROWS and not np.isnan(end).any():
                    continue
                raise InputError("makes a constant that may overflow", fix="check its constants")
        results.append(folded.value.astype(kind) if folded.exact else folded)
    return results


def _computed(
    name: str, given: list[Interval64], put: Callable[[np.ndarray], np.ndarray], rounds: FloatFormat
) -> Interval64:
    """Return the ends of one result; ``put`` applies the operator to a replacement of its first input."""
    unit, tiny, _ = rounds
    low, high = given[0]
    if name == "Neg":
        return -high, -low
    if name == "Abs":
        return _size(given[0])
    if name in STEPS:
        below, above = put(low), put(high)
        if not np.array_equal(below, above):
            raise InputError("rounds a constant that may fall either way", fix=_FIX)
        return below, above
    if name in ("Add", "Sub", "Mul", "Div", "Reciprocal", "Sqrt"):
        return _elementary(name, given, rounds)
    if name in LIBRARIES:
        below, above = put(low), put(high)
        return _widened((below, above), _library(unit) * (1.0 + np.maximum(np.abs(below), np.abs(above))) + tiny)
    if name in ("Sin", "Cos"):
        value = (np.sin if name == "Sin" else np.cos)(0.5 * (low + high))
        own = OWN_ARGUMENT * np.maximum(np.abs(low), np.abs(high))
        return _widened((value, value), 0.5 * (high - low) + _library(unit) + own + tiny)
    if name == "Pow" and len(given) == 2:
        return _power(given, rounds)
    if name.startswith("Reduce"):
        return _reduced(name, given[0], put, rounds)
    if name == "MatMul":
        return _matmul(given[0], given[1], rounds)
    raise InputError("cannot be enclosed on constants that are computed", fix=_FIX)


def _library(unit: float) -> float:
    # relative to the value and 1, as in `activations`
    return OWN_CONSTANT if unit == OWN_CONSTANT else max(2.0 * LIBRARY, OTHER_LIBRARY * unit)


def _widened(ends: Interval64, by: np.ndarray | float) -> Interval64:
    low, high = ends[0] - by, ends[1] + by
    moved = np.broadcast_to(np.asarray(by) > 0.0, low.shape)
    return np.where(moved, np.nextafter(low, -np.inf), low), np.where(moved, np.nextafter(high, np.inf), high)


def _size(ends: Interval64) -> Interval64:
    low, high = np.abs(ends[0]), np.abs(ends[1])
    across = (ends[0] <= 0.0) & (ends[1] >= 0.0)
    return np.where(across, 0.0, np.minimum(low, high)), np.maximum(low, high)


def _product(a: Interval64, b: Interval64) -> Interval64:
    corners = [u * v for u in a for v in b]
    return np.minimum.reduce(corners), np.maximum.reduce(corners)


def _elementary(name: str, operands: Sequence[Interval64], rounds: FloatFormat) -> Interval64:
    """Return enclosures of operations that are rounded once; results that the type represents are exact."""
    unit, tiny, _ = rounds
    if name == "Reciprocal":
        name, operands = "Div", [(np.ones(()), np.ones(())), operands[0]]
    if name == "Sub":
        name, operands = "Add", [operands[0], (-operands[1][1], -operands[1][0])]
    first, second = operands[0], operands[-1]
    if name == "Sqrt":
        if bool((first[0] < 0.0).any()):
            raise InputError("takes the root of what may be negative", fix="check the constant")
        low, high = np.sqrt(first[0]), np.sqrt(first[1])
        sure = (low * low == first[0]) & (2 * _digits(low) <= 53)
    elif name == "Add":
        low, high = first[0] + second[0], first[1] + second[1]
        part = low - first[0]
        sure = (first[0] - (low - part)) + (second[0] - part) == 0.0
    elif name == "Mul":
        low, high = _product(first, second)
        sure = _digits(first[0]) + _digits(second[0]) <= 53
    else:
        if bool((second[0] * second[1] <= 0.0).any()) or bool((_size(second)[0] < tiny).any()):
            raise InputError("divides by what may be zero", fix="check the constant")
        corners = [u / v for u in first for v in second]
        low, high = np.minimum.reduce(corners), np.maximum.reduce(corners)
        sure = (low * second[0] == first[0]) & (_digits(low) + _digits(second[0]) <= 53)
    small = np.zeros(())
    for ends in operands:
        sure = sure & (ends[0] == ends[1])
        small = np.maximum(small, ((_size(ends)[0] < tiny) & (_size(ends)[1] > 0.0)).astype(np.float64))
    size = np.maximum(np.abs(low), np.abs(high))
    exact = sure & (_digits(low) <= _held(unit)) & ((size == 0.0) | (size >= 2.0 * tiny)) & (small == 0.0)
    low, high = _widened((low, high), np.where(exact, 0.0, (ONCE * unit + OWN_CONSTANT) * size + ONCE_FLUSHES * tiny))
    # an operand below the normal numbers may count as zero
    return np.where(small > 0.0, np.minimum(low, 0.0), low), np.where(small > 0.0, np.maximum(high, 0.0), high)


def _held(unit: float) -> int:
    """Return the number of significant binary digits of a type."""
    return 53 if unit == OWN_CONSTANT else round(-math.log2(unit))


def _digits(value: np.ndarray) -> np.ndarray:
    """Return the number of binary digits of numbers from the first to the last that is not zero."""
    mantissa = np.abs(np.ldexp(np.frexp(value)[0], 53)).astype(np.int64)
    last = (mantissa & -mantissa).astype(np.float64)
    return np.where(mantissa == 0, 0, 53 - np.log2(np.where(last > 0.0, last, 1.0))).astype(np.int64)


def _power(operands: Sequence[Interval64], rounds: FloatFormat) -> Interval64:
    unit, tiny, _ = rounds
    base, exponent = operands
    if not np.array_equal(*exponent):
        raise InputError("has an exponent that is computed", fix=_FIX)
    power = exponent[0]
    if bool((power == 2.0).all()):
        low, high = _size(base)
        shape = np.broadcast_shapes(low.shape, power.shape)
        low, high = np.broadcast_to(low, shape), np.broadcast_to(high, shape)
        same = [(low, low), (low, low)] if np.array_equal(low, high) else None
        if same:
            return _elementary("Mul", same, rounds)
        return _widened(
            (low * low, high * high), (ONCE * unit + OWN_CONSTANT) * high * high + ONCE_FLUSHES * tiny * (1.0 + high)
        )
    if bool((base[0] <= 0.0).any()):
        raise InputError("raises what may not be positive to a power", fix=_FIX)
    corners = [e**power for e in base]
    low, high = np.minimum(*corners), np.maximum(*corners)
    return _widened((low, high), _library(unit) * high + tiny)


def _reduced(
    name: str, operand: Interval64, put: Callable[[np.ndarray], np.ndarray], rounds: FloatFormat
) -> Interval64:
    """Return enclosures of sums in any order; small multiples of one number are summed exactly."""
    unit, tiny, largest = rounds
    still, size = np.array_equal(*operand), _size(operand)
    count = max(1.0, float(operand[0].size))
    if name == "ReduceProd":
        low = put(operand[0])
        if not still:
            raise InputError("multiplies constants that are computed", fix=_FIX)
        if bool((operand[0] == np.round(operand[0])).all()) and bool((put(size[1]) < 2.0 ** _held(unit)).all()):
            return low, low
        # partial products, of the large numbers alone or of the small ones, in any order
        most = put(np.maximum(size[1], 1.0))
        _check_bounded(most, largest)
        lost = ONCE_FLUSHES * count * tiny * most
        return _widened((low, low), gamma(count + CONSTANT_SUMS, unit + OWN_CONSTANT) * np.abs(low) + lost)
    parts = count / max(1.0, float(put(operand[0]).size))
    reach = gamma(parts + CONSTANT_SUMS, unit + OWN_CONSTANT)
    if name == "ReduceL2":
        low, high = put(size[0]), put(size[1])
        _check_bounded(high * high, largest)
        return _widened((low, high), reach * high + math.sqrt(parts * tiny))
    if name not in ("ReduceSum", "ReduceMean", "ReduceL1"):
        raise InputError("cannot be enclosed on constants that are computed", fix=_FIX)
    low, high = (put(end) for end in (size if name == "ReduceL1" else operand))
    mean, total = name == "ReduceMean", put(size[1])
    _check_bounded(total * (parts if mean else 1.0), largest)
    held = total * (parts if mean else 1.0) <= 2.0 ** _held(unit) * _grain(operand[0])
    large = not size[1].any() or float(size[1][size[1] > 0.0].min()) >= 2.0 * tiny * parts
    if still and large and bool(np.all(held)) and (not mean or math.frexp(parts)[0] == 0.5):
        return low, high
    return _widened((low, high), reach * total + (parts + 1.0) * tiny)


def _matmul(first: Interval64, second: Interval64, rounds: FloatFormat) -> Interval64:
    """Return enclosures of matrix products, from middles and radii."""
    unit, tiny, largest = rounds
    (a, r), (b, q) = ((0.5 * (low + high), 0.5 * (high - low)) for low, high in (first, second))
    count = float(a.shape[-1])
    value, size = a @ b, (np.abs(a) + r) @ (np.abs(b) + q)
    _check_bounded(size, largest)
    still = not r.any() and not q.any()
    if (
        still
        and bool((size <= 2.0 ** _held(unit) * _grain(a) * _grain(b)).all())
        and _plain(a, tiny)
        and _plain(b, tiny)
    ):
        return value, value
    # flushed operands lose a product with what is beside them
    lost = tiny * (np.abs(a).max(initial=0.0) + np.abs(b).max(initial=0.0) + 2.0) * count
    radius = np.abs(a) @ q + r @ (np.abs(b) + q)
    return _widened(
        (value, value), (radius + gamma(count + CONSTANT_SUMS, unit + OWN_CONSTANT) * size) * MAGNITUDES_UP + lost
    )


def _check_bounded(size: np.ndarray, largest: float) -> None:
    """Raise InputError where partial results may overflow."""
    if not bool((size < largest).all()):
        raise InputError("computes numbers that may overflow", fix="check its constants")


def _plain(value: np.ndarray, tiny: float) -> bool:
    """Return whether products and sums of the numbers stay far above the smallest normal number of the type."""
    used = np.abs(value[value != 0.0])
    return tiny == 0.0 or not used.size or float(used.min()) >= math.sqrt(tiny) * 4.0


def _cast(
    node: onnx.NodeProto, values: Sequence[np.ndarray | EnclosedConstant | None]
) -> np.ndarray | EnclosedConstant:
    """Return a constant in another type."""
    operand = values[0]
    if node.op_type == "CastLike":
        other = values[1]
        kind = other.kind if isinstance(other, EnclosedConstant) else np.asarray(other).dtype
    else:
        kind = number_type(next((a.i for a in node.attribute if a.name == "to"), 0))
    if isinstance(operand, EnclosedConstant):
        if kind.kind != "f":
            ends = [np.asarray(end).astype(kind) for end in (*operand.real, *operand.evaluated)]
            if any(not np.array_equal(ends[0], other) for other in ends[1:]):
                raise InputError("rounds a constant that may fall either way", fix=_FIX)
            return ends[0]
        real, evaluated = operand.real, operand.evaluated
    else:
        array = np.asarray(operand)
        if kind.kind != "f":
            return array.astype(kind)
        number = array.astype(np.float64)
        real = evaluated = (number, number)
        if array.dtype.kind in "iu" and array.size and bool((np.abs(number) * DOUBLE_UNIT > 1.0).any()):
            real = evaluated = _widened(real, OWN_CONSTANT * np.abs(number))
    unit, tiny, _ = FORMATS[kind.itemsize]
    with np.errstate(over="ignore"):
        rounded = [end.astype(kind).astype(np.float64) for end in evaluated]
    same = (evaluated[0] == evaluated[1]) & (rounded[0] == evaluated[0])
    size = np.maximum(np.abs(evaluated[0]), np.abs(evaluated[1]))
    finite = np.where(np.isfinite(size), size, 0.0)
    if bool((finite >= FORMATS[kind.itemsize].largest).any()) and not bool(np.all(same)):
        raise InputError("makes a constant that may overflow", fix="check its constants")
    evaluated = _widened(evaluated, np.where(same, 0.0, ONCE * unit * finite + tiny))
    ends = EnclosedConstant(kind, real, evaluated)
    return ends.value.astype(kind) if ends.exact else ends


def _grain(value: np.ndarray) -> float:
    """Return the largest power of two of which all numbers are multiples."""
    used = value[value != 0.0]
    if not used.size:
        return 1.0
    mantissa, exponent = np.frexp(used)
    whole = np.abs(np.ldexp(mantissa, 53)).astype(np.int64)
    return float(np.ldexp((whole & -whole).astype(np.float64), exponent - 53).min())
