"""Rewrites `Where` nodes that are continuous functions: thresholds and shrinking, as exporters spell them out."""

from __future__ import annotations

import math
from collections.abc import Callable

import onnx

#: What compares a value with a number, and whether it is true above the number.
_COMPARED = {"Greater": True, "GreaterOrEqual": True, "Less": False, "LessOrEqual": False}

#: The node that makes a name, and the number that a name stands for.
_Maker = Callable[[str], onnx.NodeProto | None]
_Number = Callable[[str], float | None]


def without_choices(graph: onnx.GraphProto) -> list[onnx.NodeProto]:
    """Return the nodes of a graph, with `Where` replaced where it equals a maximum, minimum, ReLU or soft threshold.

    The replacement returns the same float32 number for every input: both branches meet where the condition changes.
    """
    made = {name: node for node in graph.node for name in node.output if name}
    stored = {tensor.name: tensor for tensor in graph.initializer}

    def number(name: str) -> float | None:
        tensor, node = stored.get(name), made.get(name)
        if node is not None and node.op_type == "Constant":
            tensor = next((a.t for a in node.attribute if a.name == "value"), None)
        if tensor is None or math.prod(tensor.dims) != 1 or tensor.data_location == onnx.TensorProto.EXTERNAL:
            return None
        return float(onnx.numpy_helper.to_array(tensor).reshape(-1)[0])

    return [new for node in graph.node for new in _replaced(node, made.get, number) or [node]]


def _replaced(node: onnx.NodeProto, made: _Maker, number: _Number) -> list[onnx.NodeProto]:
    """Return nodes that are equivalent to a `Where`; none if it is of no known kind."""
    compared = made(node.input[0]) if node.op_type == "Where" and len(node.input) == 3 else None
    if compared is None or compared.op_type not in _COMPARED or len(compared.input) != 2:
        return []
    x, limit = compared.input[0], number(compared.input[1])
    if limit is None or not math.isfinite(limit):
        return []
    above, below = node.input[1:] if _COMPARED[compared.op_type] else (node.input[2], node.input[1])

    def instead(kind: str, *inputs: str) -> list[onnx.NodeProto]:
        return [onnx.helper.make_node(kind, list(inputs), list(node.output), name=node.name)]

    if above == x and number(below) == limit:
        return instead("Max", x, below)
    if below == x and number(above) == limit:
        return instead("Min", x, above)
    if number(below) == 0.0 and _shifted(above, made, number) == (x, -limit):
        return instead("Relu", above)
    if number(above) == 0.0 and _shifted(below, made, number) == (x, -limit):
        return instead("Min", below, above)
    argument = _shrunk(x, above, below, limit, made, number)
    if argument is None:
        return []
    clipped = f"{node.output[0]} within the limits"
    clip = onnx.helper.make_node("Clip", [argument], [clipped], name=node.name, min=-limit, max=limit)
    return [clip, *instead("Sub", argument, clipped)]


def _shrunk(x: str, above: str, below: str, limit: float, made: _Maker, number: _Number) -> str | None:
    """Return v, if ``x`` is |v|, ``above`` is v less the limit with v's sign, and ``below`` is 0; else None."""
    size, rest, zero = made(x), made(above), made(below)
    if size is None or size.op_type != "Abs" or limit < 0.0 or rest is None or rest.op_type != "Sub":
        return None
    v, moved = size.input[0], made(rest.input[1])
    if rest.input[0] != v or moved is None or moved.op_type != "Mul" or number(moved.input[1]) != limit:
        return None
    sign = made(moved.input[0])
    if sign is None or sign.op_type != "Sign" or sign.input[0] != v:
        return None
    product = zero is not None and zero.op_type == "Mul" and zero.input[0] == v and number(zero.input[1]) == 0.0
    return v if product or number(below) == 0.0 else None


def _shifted(name: str, made: _Maker, number: _Number) -> tuple[str, float] | None:
    """Return the value and the number of whose sum a name is the result; else None."""
    node = made(name)
    if node is None or node.op_type not in ("Add", "Sub") or len(node.input) != 2:
        return None
    shift = number(node.input[1])
    if shift is None:
        return None
    return node.input[0], shift if node.op_type == "Add" else -shift
