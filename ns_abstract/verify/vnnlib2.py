"""VNN-LIB queries of version 2, read as the assertions of version 1 (design.md, V11), and written.

One network with one input and one output is read. Comparisons with ``<=``, ``>=`` and ``==`` are closed sets; ``<``,
``>`` and ``!=`` are refused. The semantics follow the declared type. ``real``: numbers are exact. ``float32``: numbers
are the nearest float32, and comparisons of single elements are exact; sums and products would round, and are refused.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ns_abstract.io.errors import InputError

_HEADER = re.compile(r"(?:\s|;[^\n]*(?:\n|$))*\(\s*vnnlib-version\b")
_VERSION = re.compile(r"<2\.\d{1,3}>", re.ASCII)
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*", re.ASCII)
#: A name and the brackets behind it, between which there may be space.
_ELEMENT = re.compile(r"([A-Za-z0-9_]+)\s*\[([\d,\s]*)\]", re.ASCII)
_TENSOR = re.compile(r"([A-Za-z0-9_]+)(?:\[([\d,]*)\])?", re.ASCII)
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?", re.ASCII)
_COMPARISONS = {"<=": ("<=",), ">=": (">=",), "==": ("<=", ">=")}
_DIMENSIONS = 16
#: Elements of an input that is not compared with a network.
_LARGEST = 1 << 24
_ONE = "give a query about one network with one input and one output"


@dataclass(frozen=True)
class Tensor:
    """A declared tensor of elements of ``kind`` "real" or "float32"; an empty shape: a scalar."""

    name: str
    kind: str
    shape: tuple[int, ...]

    @property
    def size(self) -> int:
        """Number of elements."""
        return math.prod(self.shape)

    def assignment(self, values: np.ndarray) -> str:
        """Return ``values`` [size], in rows, in the standard's command-line format."""
        numbers = values.astype(np.float32).astype(np.float64) if self.kind == "float32" else values
        lines = [f"{self.name} {self.kind} [{','.join(map(str, self.shape))}]", *map(repr, numbers.tolist())]
        return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class Vnnlib2Query:
    """A query as declarations and assertions of version 1 about ``X_0, ...`` and ``Y_0, ...``, tensors in row order."""

    network: str
    input: Tensor
    output: Tensor
    expressions: list[Any]


def is_version_2(text: str) -> bool:
    """Return whether a file says that it is of version 2 or later; files of version 1 do not say."""
    return _HEADER.match(text) is not None


def joined(text: str) -> str:
    """Return the text with every element ``X [0, 1]`` as one token ``X[0,1]``, without comments.

    Raises:
        InputError: It names nodes by strings, or holds a zero byte, behind which some programs read nothing.
    """
    if "\0" in text:
        line = text.count("\n", 0, text.index("\0")) + 1
        raise InputError(f"a zero byte in line {line}", fix="remove it")
    text = re.sub(r";[^\n]*", "", text)
    if '"' in text:
        raise InputError("names nodes of the network (declare-hidden)", fix=_ONE)
    return _ELEMENT.sub(lambda m: f"{m[1]}[{''.join(m[2].split())}]", text)


def parse_query(
    expressions: list[Any], input_shape: Sequence[int] | int | None, output_shape: Sequence[int] | int
) -> Vnnlib2Query:
    """Return the query in the nested tokens of a file's `joined` text.

    Shapes are of the network, without the batch; a number: of elements alone; None: not compared.
    """
    if len(expressions) < 2 or not isinstance(expressions[0], list) or len(expressions[0]) != 2:
        raise InputError("no (vnnlib-version <2.0>) and network", fix="write (vnnlib-version <2.0>) first")
    version = expressions[0][1]
    if not isinstance(version, str) or not _VERSION.fullmatch(version):
        raise InputError(
            f"found version {source_text(version)}", field="vnnlib-version", fix="give a query of 1.0 or 2.0"
        )
    name, tensors = _network(expressions[1])
    inputs, result = tensors
    if input_shape is not None:
        _check_shape(inputs, input_shape, "input")
    elif inputs.size > _LARGEST:
        raise InputError(
            f"{inputs.name} has {inputs.size} elements", field="declare-input", fix="use a smaller network"
        )
    _check_shape(result, output_shape, "output")
    reader = _Reader({inputs.name: ("X", inputs), result.name: ("Y", result)}, inputs.kind)
    converted: list[Any] = [["declare-const", f"X_{k}", "Real"] for k in range(inputs.size)]
    converted += [["declare-const", f"Y_{k}", "Real"] for k in range(result.size)]
    for expression in expressions[2:]:
        if isinstance(expression, list) and expression and expression[0] == "declare-network":
            raise InputError("is about several networks", field="declare-network", fix=_ONE)
        if not (isinstance(expression, list) and len(expression) == 2 and expression[0] == "assert"):
            raise refused(expression, "write assertions behind the network")
        converted.append(["assert", reader.condition(expression[1])])
    return Vnnlib2Query(name, inputs, result, converted)


def _network(expression: Any) -> tuple[str, tuple[Tensor, Tensor]]:
    good = isinstance(expression, list) and len(expression) >= 2 and expression[0] == "declare-network"
    if not good or not isinstance(expression[1], str) or not _NAME.fullmatch(expression[1]):
        raise refused(expression, "write (declare-network f (declare-input ..) (declare-output ..)) behind the version")
    tensors: dict[str, list[Tensor]] = {"declare-input": [], "declare-output": []}
    for part in expression[2:]:
        head = part[0] if isinstance(part, list) and part else None
        if head not in tensors or len(part) != 3:
            raise refused(part, _ONE)
        tensors[head].append(_tensor(part))
    declared = [*tensors["declare-input"], *tensors["declare-output"]]
    if [len(group) for group in tensors.values()] != [1, 1] or declared[0].name == declared[1].name:
        raise InputError("declares other tensors than one input and one output", field="declare-network", fix=_ONE)
    if declared[0].kind != declared[1].kind:
        raise InputError("declares two types", field="declare-network", fix="declare both as real, or as float32")
    return expression[1], (declared[0], declared[1])


def _tensor(part: list[Any]) -> Tensor:
    _, name, declared = part
    match = _TENSOR.fullmatch(declared) if isinstance(declared, str) else None
    if match is None or match[2] is None or not isinstance(name, str) or not _NAME.fullmatch(name):
        raise refused(part, "write a name, a type and a shape, such as X float32 [1,3]")
    kind = match[1] if match[1] == "float32" else match[1].lower()
    if kind not in ("real", "float32"):
        fix = "declare real, if the network's exact function is meant, or float32"
        raise InputError(f"{name} has elements of type {match[1]}", field=part[0], fix=fix)
    sizes = _indices(match[2], name)
    if 0 in sizes:
        raise InputError(f"{name} has a side of 0", field=part[0], fix="write numbers above 0")
    return Tensor(name, kind, sizes)


def _indices(text: str, name: str) -> tuple[int, ...]:
    parts = text.split(",") if text else []
    if len(parts) > _DIMENSIONS or not all(0 < len(part) <= 9 for part in parts):
        raise InputError(f"found {name}[{text[:40]}]", fix="write whole numbers with commas between them")
    return tuple(map(int, parts))


def _check_shape(tensor: Tensor, shape: Sequence[int] | int, what: str) -> None:
    """Raise InputError for a tensor of another shape than the network's; sides of 1 do not count."""
    if isinstance(shape, int):
        good = tensor.size == shape
    else:
        good = [n for n in tensor.shape if n != 1] == [n for n in shape if n != 1]
    if not good:
        has = f"{shape} elements" if isinstance(shape, int) else f"shape {list(shape)} without the batch"
        problem = f"{tensor.name} has shape {list(tensor.shape)}, the network's {what} {has}"
        raise InputError(problem, field=f"declare-{what}", fix="use the network's file")


class _Reader:
    """Translates conditions to version 1."""

    def __init__(self, tensors: dict[str, tuple[str, Tensor]], kind: str) -> None:
        self.tensors, self.kind = tensors, kind

    def condition(self, expression: Any) -> Any:
        head = expression[0] if isinstance(expression, list) and expression else None
        if head in ("and", "or") and len(expression) > 1:
            return [head, *(self.condition(part) for part in expression[1:])]
        if head in ("<", ">", "!="):
            fix = "write <= or >=; the closed set holds the open one"
            raise InputError(f"a comparison with {head}: {source_text(expression)}", fix=fix)
        if not isinstance(head, str) or head not in _COMPARISONS or len(expression) != 3:
            raise refused(expression, "use <=, >=, ==, and, or of version 2")
        parts = [self._side(expression, head, operator) for operator in _COMPARISONS[head]]
        return parts[0] if len(parts) == 1 else ["and", *parts]

    def _side(self, expression: list[Any], head: str, operator: str) -> list[Any]:
        """Return one closed comparison; a float32 number is moved outward to its float32 value if that is further."""
        left, right = expression[1], expression[2]
        if self.kind == "real":
            return [operator, self.term(left), self.term(right)]
        numbers = [_literal(part) for part in (left, right)]
        if all(n is not None for n in numbers) or any(
            n is None and not self._is_element(part) for n, part in zip(numbers, (left, right), strict=True)
        ):
            problem = f"arithmetic of float32 would round: {source_text(expression)}"
            raise InputError(problem, fix="compare an element with an element or a number, or declare real")
        sides = []
        for place, (part, value) in enumerate(zip((left, right), numbers, strict=True)):
            # the number is the larger side of "element <= number" and of "number >= element"
            larger = (operator == "<=") == (place == 1)
            sides.append(self.term(part) if value is None else _outward(value, larger))
        return [operator, *sides]

    def _is_element(self, part: Any) -> bool:
        match = _TENSOR.fullmatch(part) if isinstance(part, str) else None
        return match is not None and match[1] in self.tensors

    def term(self, expression: Any) -> Any:
        if isinstance(expression, str):
            return expression if _NUMBER.fullmatch(expression) else self._element(expression)
        head, parts = (expression[0], expression[1:]) if expression else (None, [])
        if head in ("+", "-", "*") and parts:
            terms = [self.term(part) for part in parts]
            if head != "*":
                return [head, *terms]
            product = terms[0]
            for term in terms[1:]:
                product = ["*", product, term]
            return product
        raise refused(expression, "write a linear expression of elements")

    def _element(self, text: str) -> str:
        match = _TENSOR.fullmatch(text)
        if match is None or match[1] not in self.tensors:
            raise InputError(f"{text[:60]} is not declared", fix="name an element of a declared tensor, such as X[0]")
        letter, tensor = self.tensors[match[1]]
        place = _indices(match[2] or "", match[1])
        if len(place) != len(tensor.shape) or any(i >= n for i, n in zip(place, tensor.shape, strict=True)):
            problem = f"{text[:60]}: {tensor.name} has shape {list(tensor.shape)}"
            raise InputError(problem, fix="write an index within it for every side")
        return f"{letter}_{int(np.ravel_multi_index(place, tensor.shape)) if place else 0}"


def _literal(expression: Any) -> float | None:
    """Return the value of a number, or of the negative of one; None for anything else."""
    negative = isinstance(expression, list) and len(expression) == 2 and expression[0] == "-"
    text = expression[1] if negative else expression
    if not isinstance(text, str) or not _NUMBER.fullmatch(text):
        return None
    value = float(text)
    return -value if negative else value


def _outward(value: float, larger: bool) -> str:
    """Return the larger (or the smaller) of a number and its float32 value, as text."""
    with np.errstate(over="ignore"):
        single = float(np.float32(value))
    if not math.isfinite(single):
        raise InputError(f"found {value:g}", fix="write a number that float32 can hold")
    return repr(max(value, single) if larger else min(value, single))


def source_text(expression: Any) -> str:
    """Return an expression as text for messages, cut off where it is long."""
    text = f"({' '.join(map(source_text, expression))})" if isinstance(expression, list) else str(expression)
    return text if len(text) <= 60 else f"{text[:57]}..."


def refused(expression: Any, fix: str) -> InputError:
    """Return the error for an expression."""
    return InputError(f"not understood: {source_text(expression)}", fix=fix)


def write_query(d: int, n: int, groups: Sequence[Sequence[int]], k: int, notes: Sequence[str] = ()) -> str:
    """Return the query of ``d`` parameters and ``n`` slacks in [-1, 1], violated where a group of outputs is <= 0."""
    lines = ["(vnnlib-version <2.0>)", *(f"; {note}" for note in notes)]
    lines += [f"(declare-network f (declare-input X float32 [1,{d + n}]) (declare-output Y float32 [1,{k}]))"]
    lines += violation("X[0,{}]", "Y[0,{}]", d + n, groups)
    return "\n".join(lines) + "\n"


def violation(source: str, result: str, count: int, groups: Sequence[Sequence[int]]) -> list[str]:
    """Return the assertions that ``count`` inputs lie in [-1, 1] and a group of outputs is <= 0, in either version.

    ``source`` and ``result`` are names of an input and of an output, with {} for the number.
    """
    lines = []
    for name in map(source.format, range(count)):
        lines += [f"(assert (>= {name} -1.0))", f"(assert (<= {name} 1.0))"]
    lines.append("(assert (or")
    lines += ["    (and " + " ".join(f"(<= {result.format(i)} 0.0)" for i in group) + ")" for group in groups]
    return [*lines, "))"]
