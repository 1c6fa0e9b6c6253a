"""Reads VNN-LIB files (versions 1 and 2): sets of unsafe outputs, and boxes of inputs.

It reads ``declare-const`` (of version 2: `ns_abstract.verify.vnnlib2`), and ``assert`` of ``<=``, ``>=``, ``and``,
``or`` over bounds of single inputs and linear expressions of the outputs. In certificates of scenes the images take the
place of the inputs' bounds. No overflow may become a verdict: numbers that overflow or vanish on the way are refused,
and constraints with huge or tiny factors are multiplied by powers of two.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ns_abstract.execution.cancellation import check_cancelled
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import read_text
from ns_abstract.io.packed import unpacked
from ns_abstract.verify.vnnlib2 import Vnnlib2Query, is_version_2, joined, parse_query, refused
from ns_abstract.verify.vnnlib_sets import InputRegion, UnsafeSet

_LIMIT = 256 << 20
_TOKEN = re.compile(r'\s+|;[^\n]*|(?P<text>[()]|"[^"]*"|[^\s();"]+)|(?P<bad>.)', re.DOTALL)
#: Bounds of single inputs next to each other, as files of many boxes hold them by the million.
_RUN = re.compile(r"(?:\([<>]= X_\d{1,9} [-+.\deE]{1,40}\)\s*){8,}", re.ASCII)
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?", re.ASCII)
_VARIABLE = re.compile(r"([XY])_(\d{1,9})", re.ASCII)
_OTHER = "use the network's file"
#: Most conjunctions that a file's assertions may multiply out to.
_CONJUNCTIONS = 50_000
_DEPTH = 200
#: Exponents of two that the largest factor of a constraint may have before the constraint is rescaled, that any
#: factor may have below the largest, and that the constant may have above it.
_PLAIN, _SPREAD, _FAR = 30, 90, 120

#: Least size at which a product of numbers keeps all of its digits.
_SMALLEST = float(np.finfo(np.float64).tiny)

#: Tokens that are read between questions whether to go on.
_ASKED = 1 << 12
#: Numbers that the boxes of a file may have together.
_BOXES = 1 << 25
#: Coefficients of outputs by number (of input i by -1 - i), and a constant.
_Linear = tuple[dict[int, float], float]


@dataclass(frozen=True)
class _InputBounds:
    """A conjunction of bounds of single inputs: one text each, without the closing bracket.

    ``limits``, shared by all runs: by text, the side (0 below, 1 above), the input and the limit.
    """

    texts: list[str]
    limits: dict[str, tuple[int, int, float]]

    def __str__(self) -> str:
        return " ".join(f"{text})" for text in self.texts)

    def read(self, declared: set[str], size: _VariableCounts) -> None:
        """Parse the bounds in ``texts`` that are not in ``limits`` yet, and add them there."""
        for text in set(self.texts).difference(self.limits):
            ((constraint,),) = _disjunction(_expressions(text + ")")[0], declared, size)
            assert not isinstance(constraint, _InputBounds)
            ends = np.array([[-np.inf], [np.inf]]) * np.ones(size.inputs or 0)
            _bound(constraint, ends)
            ((side, index),) = np.argwhere(np.isfinite(ends))
            self.limits[text] = int(side), int(index), float(ends[side, index])

    def limit(self, ends: np.ndarray) -> None:
        """Narrow ``ends`` [2, n] by the bounds."""
        side, index, value = (np.array(v) for v in zip(*map(self.limits.__getitem__, self.texts), strict=True))
        np.maximum.at(ends[0], index[side == 0], value[side == 0])
        np.minimum.at(ends[1], index[side == 1], value[side == 1])


#: ``rows @ y + offset <= 0`` for all rows of a list: one way to be unsafe.
_Conjunction = list[_Linear | _InputBounds]


class _VariableCounts(NamedTuple):
    """Numbers of inputs and outputs; inputs may be None where no assertion may name them."""

    inputs: int | None
    outputs: int


#: A network's shape without the batch, or its number of elements.
Shape = Sequence[int] | int


def _size(shape: Shape) -> int:
    return shape if isinstance(shape, int) else math.prod(shape)


def load_vnnlib(path: Path, output_shape: Shape, input_shape: Shape | None = None) -> UnsafeSet:
    """Return the unsafe set of a VNN-LIB file, packed (.gz) or not, for a network of these shapes.

    As many outputs must be declared, and as many inputs or none; ``input_shape`` None: inputs are not compared.
    """
    text = _text(path)
    try:
        expressions, _ = _read(text, input_shape, output_shape)
        inputs = None if input_shape is None else _size(input_shape)
        return _parse(expressions, _size(output_shape), inputs)
    except InputError as error:
        raise error.within(path) from None


def _read(
    text: str, input_shape: Shape | None, output_shape: Shape, runs: bool = False
) -> tuple[list[Any], Vnnlib2Query | None]:
    """Return a file's expressions as those of version 1, and the query of a file of version 2, or None.

    ``runs``: whether bounds of single inputs may be a `_InputBounds`.
    """
    if not is_version_2(text):
        return _expressions(text, runs), None
    expressions = _expressions(joined(text))
    query = parse_query(expressions, input_shape, output_shape)
    return query.expressions, query


def _text(path: Path) -> str:
    if not path.name.lower().endswith(".gz"):
        return read_text(path, "VNN-LIB file", _LIMIT)
    data = b"".join(unpacked(path, _LIMIT))
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise InputError("VNN-LIB file is not UTF-8 text", file=path, fix="save it as UTF-8") from None


def _check_declared(declared: set[str], kind: str, count: int) -> None:
    """Raise InputError for a file that was written for a network of another size."""
    names = {name for name in declared if name[0] == kind}
    if names != {f"{kind}_{k}" for k in range(count)}:
        what = "inputs" if kind == "X" else "outputs"
        raise InputError(
            f"declares {len(names)} variables {kind}_, the network has {count} {what}",
            field=f"declare-const {kind}_",
            fix=f"{_OTHER}, or declare {kind}_0 to {kind}_{count - 1}",
        )


def load_query(
    path: Path, input_shape: Shape, output_shape: Shape, text: str | None = None
) -> tuple[tuple[InputRegion, ...], Vnnlib2Query | None]:
    """Return the regions of a VNN-LIB file with its inputs, and the query of a file of version 2, or None.

    The property is violated if some region has an input with an unsafe output. ``path`` is only named in errors if
    ``text`` is given.
    """
    text = _text(path) if text is None else text
    try:
        expressions, query = _read(text, input_shape, output_shape, True)
        return _regions(expressions, _VariableCounts(_size(input_shape), _size(output_shape))), query
    except InputError as error:
        raise error.within(path) from None


def _regions(expressions: list[Any], sizes: _VariableCounts) -> tuple[InputRegion, ...]:
    declared: set[str] = set()
    assert sizes.inputs is not None
    ends = np.full((2, sizes.inputs), np.inf) * np.array([[-1.0], [1.0]])
    cases: list[_Conjunction] = [[]]
    for expression in expressions:
        check_cancelled()
        if _declares(expression, declared):
            continue
        ways = _disjunction(expression[1], declared, sizes)
        if len(ways) == 1:
            rest = [v for v in ways[0] if not _bound(v, ends)]
            cases = [[*case, *rest] for case in cases] if rest else cases
            continue
        if len(cases) * len(ways) > _CONJUNCTIONS or len(cases) * sum(map(len, ways)) > _BOXES:
            raise InputError(f"more than {_CONJUNCTIONS} combinations of cases", fix="use fewer assertions of (or")
        cases = [[*old, *new] for old in cases for new in ways]
    _check_declared(declared, "X", sizes.inputs)
    _check_declared(declared, "Y", sizes.outputs)
    boxes: dict[bytes, tuple[np.ndarray, list[_Conjunction]]] = {}
    for case in cases:
        check_cancelled()
        own = ends.copy()
        outputs = [v for v in case if not _bound(v, own)]
        if (len(boxes) + 1) * ends.size > _BOXES:
            raise InputError(f"boxes of inputs with more than {_BOXES} numbers", fix="use fewer boxes")
        boxes.setdefault(own.tobytes(), (own, []))[1].append(outputs)
    regions = []
    for own, conjunctions in boxes.values():
        if not np.isfinite(own).all():
            index = int(np.flatnonzero(~np.isfinite(own).all(0))[0])
            raise InputError(f"X_{index} has no bounds", fix="assert a lower and an upper bound of every input")
        regions.append(InputRegion(own[0], own[1], _unsafe(conjunctions, sizes.outputs, 0)))
    return tuple(regions)


def _bound(constraint: _Linear | _InputBounds, ends: np.ndarray) -> bool:
    """Narrow ``ends`` [2, n] and return True if ``constraint`` bounds one input; InputError: it joins several."""
    if isinstance(constraint, _InputBounds):
        constraint.limit(ends)
        return True
    coefficients, constant = constraint
    used = [(key, value) for key, value in coefficients.items() if value]
    if all(key >= 0 for key, _ in used):
        return False
    if len(used) > 1:
        raise InputError(
            "a constraint joins several inputs, or inputs and outputs", fix="assert bounds of single inputs"
        )
    value, index = used[0][1], -1 - used[0][0]
    limit = -constant / value
    side = 1 if value > 0.0 else 0
    if abs(value) != 1.0:
        limit = float(np.nextafter(limit, np.inf if side else -np.inf))
    ends[side, index] = min(ends[1, index], limit) if side else max(ends[0, index], limit)
    return True


def _declares(expression: Any, declared: set[str]) -> bool:
    """Return whether an expression declares a variable; else it is an assertion, or InputError is raised."""
    head = expression[0] if isinstance(expression, list) and expression else None
    if head == "declare-const" and len(expression) == 3:
        _, name, kind = expression
        if not (isinstance(name, str) and _VARIABLE.fullmatch(name)) or kind != "Real":
            raise refused(expression, "declare X_0, X_1, ..., Y_0, Y_1, ... as Real")
        declared.add(name)
        return True
    if head == "assert" and len(expression) == 2:
        return False
    raise refused(expression, "use declare-const and assert of VNN-LIB version 1")


def _expressions(text: str, runs: bool = False) -> list[Any]:
    """Return nested lists of tokens; with ``runs`` also `_InputBounds` inside of conjunctions."""
    stack: list[list[Any]] = [[]]
    places: dict[str, tuple[int, int, float]] = {}
    at, number = 0, 0
    while at < len(text):
        if number % _ASKED == 0:
            check_cancelled()
        number += 1
        run = _RUN.match(text, at) if runs and stack[-1][:1] == ["and"] else None
        if run:
            check_cancelled()
            stack[-1].append(_InputBounds([part.strip() for part in run[0].split(")")[:-1]], places))
            at = run.end()
            continue
        match = _TOKEN.match(text, at)
        assert match is not None
        at, token = match.end(), match["text"]
        if match["bad"]:
            line = text.count("\n", 0, match.start()) + 1
            raise InputError(f"unexpected {match['bad']!r} in line {line}", fix="close the string or remove the sign")
        if token == "(":
            stack.append([])
            if len(stack) > _DEPTH:
                raise InputError(f"nested more than {_DEPTH} deep", fix="remove the nesting")
        elif token == ")":
            if len(stack) == 1:
                line = text.count("\n", 0, match.start()) + 1
                raise InputError(f"a bracket too many in line {line}", fix="remove it")
            done = stack.pop()
            stack[-1].append(done)
        elif token:
            stack[-1].append(token)
    if len(stack) > 1:
        raise InputError("a bracket is never closed", fix="add the missing )")
    return stack[0]


def _parse(expressions: list[Any], output_size: int, input_size: int | None) -> UnsafeSet:
    declared: set[str] = set()
    unsafe: list[_Conjunction] = [[]]
    inputs = 0
    for expression in expressions:
        if _declares(expression, declared):
            continue
        names = {name[0] for name in _names(expression[1])}
        if names == {"X"}:
            inputs += 1
            continue
        ways = _disjunction(expression[1], declared, _VariableCounts(None, output_size))
        if len(unsafe) * len(ways) > _CONJUNCTIONS:
            raise InputError(f"more than {_CONJUNCTIONS} combinations of cases", fix="use fewer assertions of (or")
        unsafe = [[*old, *new] for old in unsafe for new in ways]
    if not any(unsafe):
        raise InputError("no assertion on an output", fix="assert which outputs are unsafe")
    _check_declared(declared, "Y", output_size)
    if input_size is not None and any(name[0] == "X" for name in declared):
        _check_declared(declared, "X", input_size)
    return _unsafe(unsafe, output_size, inputs)


def _unsafe(conjunctions: list[_Conjunction], output_size: int, inputs: int) -> UnsafeSet:
    rows: list[np.ndarray] = []
    offsets: list[float] = []
    group_numbers: dict[tuple[Any, float], int] = {}
    groups = []
    for conjunction in conjunctions:
        group = []
        for constraint in conjunction:
            assert not isinstance(constraint, _InputBounds)
            coefficients, constant = constraint
            key = (tuple(sorted(coefficients.items())), constant)
            if key not in group_numbers:
                group_numbers[key] = len(rows)
                row, offset = _scaled(coefficients, constant, output_size)
                rows.append(row)
                offsets.append(offset)
            group.append(group_numbers[key])
        groups.append(tuple(group))
    return UnsafeSet(np.array(rows).reshape(-1, output_size), np.array(offsets), tuple(groups), inputs)


def _scaled(coefficients: dict[int, float], constant: float, size: int) -> tuple[np.ndarray, float]:
    """Return a constraint as a row and an offset, multiplied by a power of two where factors are huge or tiny.

    Raises:
        InputError: Its numbers are too far apart for arithmetic that decides on which side an output lies.
    """
    row = np.zeros(size)
    for index, value in coefficients.items():
        row[index] = value
    used = np.abs(row[row != 0.0])
    if not used.size:
        return row, constant
    exponents = np.frexp(used)[1]
    largest = int(exponents.max())
    if largest - int(exponents.min()) > _SPREAD:
        problem = f"factors {used.min():g} and {used.max():g} of outputs in one constraint"
        raise InputError(problem, fix=f"stay within a ratio of 2^{_SPREAD}")
    shift = -largest if abs(largest) > _PLAIN else 0
    with np.errstate(over="ignore", under="ignore"):
        moved = float(np.ldexp(constant, shift))
    if np.frexp(constant)[1] + shift > _FAR or float(np.ldexp(moved, -shift)) != constant:
        problem = f"the constant {constant:g} beside factors of {used.max():g}"
        raise InputError(problem, fix=f"stay within a ratio of 2^{_FAR}")
    return np.ldexp(row, shift), moved


def _names(expression: Any) -> set[str]:
    """Return the variables of an expression."""
    if isinstance(expression, list):
        return {name for part in expression for name in _names(part)}
    return {expression} if _VARIABLE.fullmatch(expression) else set()


def _disjunction(expression: Any, declared: set[str], size: _VariableCounts) -> list[_Conjunction]:
    """Return the expression as a disjunction of conjunctions."""
    head = expression[0] if isinstance(expression, list) and expression else None
    if head == "or" and len(expression) > 1:
        return [way for part in expression[1:] for way in _disjunction(part, declared, size)]
    if head == "and" and len(expression) > 1:
        check_cancelled()
        ways: list[_Conjunction] = [[]]
        for part in expression[1:]:
            if isinstance(part, _InputBounds):
                part.read(declared, size)
            more: list[_Conjunction] = (
                [[part]] if isinstance(part, _InputBounds) else _disjunction(part, declared, size)
            )
            if len(more) == 1:
                for way in ways:
                    way += more[0]
                continue
            if len(ways) * len(more) > _CONJUNCTIONS:
                raise InputError(f"more than {_CONJUNCTIONS} combinations of cases", fix="use fewer nested (or")
            ways = [[*old, *new] for old in ways for new in more]
        return ways
    if head in ("<=", ">=") and len(expression) == 3:
        left, right = (_linear(part, declared, size) for part in expression[1:])
        low, high = (left, right) if head == "<=" else (right, left)
        return [[_sum(low, high, -1.0)]]
    raise refused(expression, "use <=, >=, and, or of version 1")


def _sum(first: _Linear, second: _Linear, factor: float) -> _Linear:
    coefficients = dict(first[0])
    for index, value in second[0].items():
        coefficients[index] = _added(coefficients.get(index, 0.0), factor, value)
    return coefficients, _added(first[1], factor, second[1])


def _added(total: float, factor: float, value: float) -> float:
    """Return ``total + factor * value``; InputError if it overflows, or the product vanishes."""
    product = factor * value
    sum_ = total + product
    if not math.isfinite(sum_) or (factor and value and abs(product) < _SMALLEST):
        raise InputError(f"numbers overflow or vanish at {factor:g} times {value:g}", fix="use factors nearer to 1")
    return sum_


def _linear(expression: Any, declared: set[str], size: _VariableCounts) -> _Linear:
    if isinstance(expression, str):
        return _atom(expression, declared, size)
    head, parts = (expression[0], expression[1:]) if expression else (None, [])
    terms = [_linear(part, declared, size) for part in parts]
    if head == "+" and terms:
        total = terms[0]
        for term in terms[1:]:
            total = _sum(total, term, 1.0)
        return total
    if head == "-" and len(terms) == 1:
        return _sum(({}, 0.0), terms[0], -1.0)
    if head == "-" and terms:
        total = terms[0]
        for term in terms[1:]:
            total = _sum(total, term, -1.0)
        return total
    if head == "*" and len(terms) == 2 and not all(term[0] for term in terms):
        factor, other = (terms[0][1], terms[1]) if not terms[0][0] else (terms[1][1], terms[0])
        return _sum(({}, 0.0), other, factor)
    raise refused(expression, "write a linear expression of outputs")


def _atom(text: str, declared: set[str], size: _VariableCounts) -> _Linear:
    match = _VARIABLE.fullmatch(text)
    if match is None:
        number = _NUMBER.fullmatch(text)
        if number is None:
            raise refused(text, "write a number or a variable such as Y_0")
        value = float(text)
        if not math.isfinite(value) or (abs(value) < _SMALLEST and re.search("[1-9]", number[1])):
            raise refused(text, "write a number that float64 can hold")
        return {}, value
    if text not in declared:
        raise InputError(f"{text} is not declared", fix=f"add (declare-const {text} Real)")
    index = int(match[2])
    if match[1] == "X":
        if size.inputs is None:
            raise InputError(f"an assertion joins {text} with outputs", fix="assert inputs and outputs apart")
        if index >= size.inputs:
            raise InputError(f"{text}: the network has the inputs X_0 to X_{size.inputs - 1}", fix=_OTHER)
        return {-1 - index: 1.0}, 0.0
    if index >= size.outputs:
        raise InputError(f"{text}: the network has the outputs Y_0 to Y_{size.outputs - 1}", fix=_OTHER)
    return {index: 1.0}, 0.0
