"""Rules of ONNX operators on two values or more: sums, products, matrices, comparisons."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import onnx

from ns_abstract.io.errors import InputError
from ns_abstract.verify.network.composite_layers import CompositeBuilder
from ns_abstract.verify.network.constant_enclosures import EnclosedConstant
from ns_abstract.verify.network.contractions import Operand, einsum, matmul
from ns_abstract.verify.network.graph import item
from ns_abstract.verify.network.inexact_constants import ConstantIntervals
from ns_abstract.verify.network.layers import Shape
from ns_abstract.verify.network.onnx_graph import Attributes, OnnxReader, Rule, TensorValue

#: A mask that adds less than this takes a number out of a softmax: in float32 its exponential is zero.
_DROPPED = -3e38


def _gemm(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x, weight, bias = r.value(node), r.weight(node, 1, True), r.constant(node, 2, None, True)
    a.only("transA", 0)
    alpha, beta = float(a.get("alpha", 1.0)), float(a.get("beta", 1.0))
    if weight.ndim != 2:
        raise InputError(f"weights {item(weight.shape)}", fix="a matrix expected")
    matrix = weight.astype(np.float64) if a.get("transB", 0) else weight.astype(np.float64).T
    own, shift = r.doubts(node, 1), r.doubts(node, 2)
    own = own if own is None or a.get("transB", 0) else own.turned()
    bias = None if bias is None else beta * bias.astype(np.float64)
    added = intervals_of(None if shift is None else shift.times(beta))
    if alpha == 1.0:
        index = r.builder.doubt(r.builder.matrix(x.index, matrix, bias), intervals_of(own), added)
    else:
        # programs multiply the sums, or the weights
        index = r.builder.doubt(r.builder.matrix(x.index, matrix, None), intervals_of(own), None)
        index = r.builder.doubt(r.builder.scale(index, np.asarray(alpha), bias), None, added)
    r.result(node, index, (*x.whole[:-1], matrix.shape[0]))


def _binary(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    kind = node.op_type
    a.ignore("axis", "broadcast")
    one, two = (operand(r, node, k, True) for k in range(2))
    if isinstance(one, TensorValue) and isinstance(two, TensorValue):
        r.result(node, *_both(r.builder, kind, one, two))
        return
    own = r.doubts(node, 1 if isinstance(one, TensorValue) else 0)
    if isinstance(one, TensorValue):
        value, constant = one, np.asarray(two, np.float64)
    else:
        assert isinstance(two, TensorValue)
        value, constant = two, np.asarray(one, np.float64)
    x, whole = broadcast(r.builder, value, constant.shape)
    if kind == "Div" and not isinstance(one, TensorValue):
        kind, x = "Mul", r.builder.reciprocal(x)
    factor, offset = np.ones(()), None
    if kind == "Mul":
        factor = constant
    elif kind == "Div":
        if not constant.all():
            raise InputError("divides by zero", fix="check the constant")
        own = None if own is None else own.inverse()
        factor = 1.0 / constant if own is None else own.value
    elif kind == "Add":
        dropped = constant <= _DROPPED
        if dropped.any():
            r.dropped[node.output[0]] = np.broadcast_to(dropped, whole)
        offset = np.where(dropped, 0.0, constant)
    else:
        factor = np.ones(()) if isinstance(one, TensorValue) else -np.ones(())
        offset = -constant if isinstance(one, TensorValue) else constant
    index = r.builder.scale(x, factor, offset)
    if own is not None:
        off = intervals_of(own, r.builder.shape(x))
        index = r.builder.doubt(index, *((off, None) if kind in ("Mul", "Div") else (None, off)))
    r.result(node, index, whole)


def intervals_of(constant: EnclosedConstant | None, shape: Shape | None = None) -> ConstantIntervals | None:
    """Return an inexact constant's error intervals, broadcast to an item or to weights; None for an exact constant."""
    if constant is None:
        return None
    intervals = constant.doubts
    if shape is None:
        return intervals
    if intervals[0].size == math.prod(shape):
        return intervals[0].reshape(shape), intervals[1].reshape(shape)
    real, evaluated = (np.broadcast_to(part, (1, *shape))[0] for part in intervals)
    return real, evaluated


def operand(r: OnnxReader, node: onnx.NodeProto, position: int, doubtful: bool = False) -> TensorValue | np.ndarray:
    return r.value(node, position) if r.moves(node, position) else r.weight(node, position, doubtful)


def broadcast(b: CompositeBuilder, value: TensorValue, shape: Sequence[int]) -> tuple[int, Shape]:
    """Add the value broadcast against a constant of ``shape``; return its node and shape."""
    try:
        whole = np.broadcast_shapes(value.whole, tuple(shape))
    except ValueError:
        raise InputError(f"constant {item(shape)} with a value {item(value.whole)}") from None
    return _to(b, value, whole), whole


def _to(b: CompositeBuilder, value: TensorValue, whole: Shape) -> int:
    """Add the value broadcast to ``whole``; return its node."""
    if value.whole == tuple(whole):
        return value.index
    grown = (1,) * (len(whole) - len(value.whole)) + value.whole
    after = TensorValue(0, tuple(whole)).item
    before = grown[len(whole) - len(after) :]
    return b.spread(b.reshape(value.index, before), after)


def _together(*shapes: Shape) -> Shape:
    """Return the shape to which tensors broadcast."""
    try:
        return np.broadcast_shapes(*shapes)
    except ValueError:
        raise InputError(f"shapes {' and '.join(map(item, shapes))} do not fit") from None


def _both(b: CompositeBuilder, kind: str, one: TensorValue, two: TensorValue) -> tuple[int, Shape]:
    whole = _together(one.whole, two.whole)
    first, second = _to(b, one, whole), _to(b, two, whole)
    if kind in ("Add", "Sub"):
        return b.sum((first, second), (1, 1 if kind == "Add" else -1)), whole
    if kind == "Div":
        return b.product(first, _to(b, TensorValue(b.reciprocal(two.index), two.whole), whole)), whole
    return b.product(first, second), whole


def _variadic(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    """Max, Min and Sum of any number of values and constants."""
    kind = node.op_type
    first = next(k for k in range(len(node.input)) if r.moves(node, k))
    result = r.value(node, first)
    for k in range(len(node.input)):
        if k == first:
            continue
        other = operand(r, node, k)
        if isinstance(other, TensorValue):
            if kind == "Sum":
                result = TensorValue(*_both(r.builder, "Add", result, other))
                continue
            whole = _together(result.whole, other.whole)
            parts = _to(r.builder, result, whole), _to(r.builder, other, whole)
            result = TensorValue(r.builder.extreme(parts, kind == "Max"), whole)
            continue
        x, whole = broadcast(r.builder, result, other.shape)
        constant = np.asarray(other, np.float64)
        if kind == "Sum":
            result = TensorValue(r.builder.scale(x, np.ones(()), constant), whole)
            continue
        # max(x, c) = c + relu(x - c), min(x, c) = c - relu(c - x)
        sign = np.asarray(1.0 if kind == "Max" else -1.0)
        above = r.builder.leaky_relu(r.builder.scale(x, sign, -sign * constant), 0.0)
        result = TensorValue(r.builder.scale(above, sign, constant), whole)
    r.result(node, result.index, result.whole)


def _pow(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x, exponent = r.value(node), np.asarray(r.weight(node, 1), np.float64)
    if exponent.size != 1:
        raise InputError(f"exponents {item(exponent.shape)} are not supported", fix="use one exponent")
    r.result(node, r.builder.power(x.index, float(exponent.reshape(-1)[0])), x.whole)


def _greater(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    limit = np.asarray(r.weight(node, 1), np.float64)
    if limit.size != 1:
        raise InputError("compares with several numbers", fix="only softplus of torch's exporter is read")
    r.above[node.output[0]] = r.value(node), float(limit.reshape(-1)[0])


def _is_nan(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    # a cell in which a number may not be finite is unknown
    r.fold(node, np.zeros(r.value(node).whole, bool))


def _where(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    if node.input[0] in r.above:
        value, limit = r.above[node.input[0]]
        straight, curved = r.value(node, 1), r.value(node, 2)
        index = r.builder.switched_softplus(value.index, limit, straight.index, curved.index)
        if not index:
            raise InputError("chooses by a value that depends on the image", fix="only torch's softplus is read")
        r.result(node, index, curved.whole)
        return
    chosen = np.asarray(r.weight(node, 0), bool)
    parts = [operand(r, node, k) for k in (1, 2)]
    shapes = [chosen.shape, *(p.whole if isinstance(p, TensorValue) else p.shape for p in parts)]
    whole = _together(*shapes)
    moving, offset = [], np.zeros(whole)
    for part, mask in zip(parts, (chosen, ~chosen), strict=True):
        if isinstance(part, TensorValue):
            moving.append(r.builder.scale(_to(r.builder, part, whole), mask.astype(np.float64), None))
        else:
            offset = offset + np.where(mask, np.asarray(part, np.float64), 0.0)
    index = r.builder.sum(tuple(moving), (1,) * len(moving), exact=True) if len(moving) > 1 else moving[0]
    r.result(node, r.builder.scale(index, np.ones(()), offset) if offset.any() else index, whole)


def contraction_operand(operand: TensorValue | np.ndarray) -> Operand:
    return (operand.index, operand.whole) if isinstance(operand, TensorValue) else (operand, operand.shape)


def _matmul(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    if r.batch > 1 and (r.moves(node, 1) or r.weight(node, 1).ndim > 2):
        raise InputError(f"multiplies within a batch of {r.batch} items", fix="export with a batch of 1")
    own = r.doubts(node, 1)
    flat = own is not None and own.value.ndim == 2
    result = matmul(r.builder, *(contraction_operand(operand(r, node, k, k == 1 and flat)) for k in range(2)))
    if own is not None:
        r.builder.doubt(result[0], intervals_of(own.turned()), None)
    r.result(node, *result)


def _einsum(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    operands = [contraction_operand(operand(r, node, k)) for k in range(len(node.input))]
    r.result(node, *einsum(r.builder, str(a.get("equation", "")), operands))


ARITHMETIC_RULES: dict[str, Rule] = {
    "Add": _binary,
    "Div": _binary,
    "Einsum": _einsum,
    "Gemm": _gemm,
    "Greater": _greater,
    "IsNaN": _is_nan,
    "MatMul": _matmul,
    "Max": _variadic,
    "Min": _variadic,
    "Mul": _binary,
    "Pow": _pow,
    "Sub": _binary,
    "Sum": _variadic,
    "Where": _where,
}
