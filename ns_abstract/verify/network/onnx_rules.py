"""Rules that turn ONNX operators into layers; other operators are refused with a fix."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import onnx

from ns_abstract.arithmetic.network_charges import LEAST_DIVISOR
from ns_abstract.io.errors import InputError
from ns_abstract.verify.network import activations
from ns_abstract.verify.network.composite_layers import CompositeBuilder, interpolation
from ns_abstract.verify.network.constant_enclosures import EnclosedConstant
from ns_abstract.verify.network.contractions import Operand, concatenated, einsum, matmul
from ns_abstract.verify.network.graph import item
from ns_abstract.verify.network.inexact_constants import ConstantIntervals
from ns_abstract.verify.network.layers import Shape
from ns_abstract.verify.network.onnx_graph import Attributes, OnnxReader, Rule, TensorValue
from ns_abstract.verify.network.onnx_quantised import dequantize, quantize

#: A mask that adds less than this takes a number out of a softmax: in float32 its exponential is zero.
_DROPPED = -3e38


def _ints(a: Attributes, name: str, line: bool, default: int | None = None, beside: int = 1) -> Any:
    """Two numbers of a window operator; of one along a line ``beside`` is the other."""
    values = a.ints(name, 1 if line else 2, default)
    return (*values, beside) if line and values is not None else values


def _pads(
    a: Attributes, size: Sequence[int], kernel: Any, stride: Any, dilation: Any, line: bool
) -> tuple[int, int, int, int]:
    """Pads top, left, bottom, right of a window operator."""
    auto = a.get("auto_pad", "NOTSET")
    explicit = a.ints("pads", 2 if line else 4, 0)
    assert explicit is not None
    if auto == "NOTSET":
        return (explicit[0], 0, explicit[1], 0) if line else explicit  # type: ignore[return-value]
    if auto == "VALID":
        return 0, 0, 0, 0
    if auto not in ("SAME_UPPER", "SAME_LOWER"):
        raise InputError(f"attribute auto_pad = {auto} is not supported", fix="use explicit pads")
    ends = []
    for n, k, s, d in zip(size, kernel, stride, dilation, strict=True):
        if s < 1:
            raise InputError(f"attribute strides = {list(stride)}", fix="positive numbers expected")
        total = max(0, (-(-n // s) - 1) * s + (k - 1) * d + 1 - n)
        half = total // 2
        ends.append((half, total - half) if auto == "SAME_UPPER" else (total - half, half))
    return ends[0][0], ends[1][0], ends[0][1], ends[1][1]


def _map(r: OnnxReader, x: int) -> tuple[int, bool]:
    """An item as a map of rows and columns; one of channels along a line [C, L] is a map [C, L, 1]."""
    shape = r.builder.shape(x)
    if len(shape) == 2:
        return r.builder.reshape(x, (*shape, 1)), True
    return x, False


def _mapped(r: OnnxReader, node: onnx.NodeProto, index: int, line: bool) -> None:
    """Name the result of a window operator."""
    shape = r.builder.shape(index)
    r.result(node, r.builder.reshape(index, shape[:2]) if line else index)


def _conv(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x, weight, bias = r.source(node), r.weight(node, 1, True), r.constant(node, 2, None, True)
    shape = r.builder.shape(x)
    if (weight.ndim, len(shape)) not in ((4, 3), (3, 2)):
        problem = f"weights {item(weight.shape)} on {item(shape)}"
        raise InputError(problem, fix="only one- and two-dimensional convolutions are read")
    x, line = _map(r, x)
    weight = weight.reshape(*weight.shape, *[1] * line)
    kernel = _ints(a, "kernel_shape", line) or weight.shape[2:]
    if tuple(kernel) != weight.shape[2:]:
        raise InputError(f"attribute kernel_shape = {list(kernel)}, weights are {item(weight.shape)}")
    stride, dilation = _ints(a, "strides", line, 1), _ints(a, "dilations", line, 1)
    pads = _pads(a, r.builder.shape(x)[1:], kernel, stride, dilation, line)
    index = r.builder.convolution(x, weight, bias, stride, dilation, pads, int(a.get("group", 1)))
    r.builder.doubt(index, _doubts(r.doubts(node, 1), weight.shape), _doubts(r.doubts(node, 2)))
    _mapped(r, node, index, line)


def _pool_window(r: OnnxReader, node: onnx.NodeProto, a: Attributes):
    x, line = _map(r, r.source(node))
    shape = r.builder.shape(x)
    if len(shape) != 3:
        raise InputError(f"input {item(shape)}", fix="only one- and two-dimensional pooling is read")
    kernel = _ints(a, "kernel_shape", line)
    if kernel is None:
        raise InputError("attribute kernel_shape is missing")
    stride, dilation = _ints(a, "strides", line, 1), _ints(a, "dilations", line, 1)
    pads = _pads(a, shape[1:], kernel, stride, dilation, line)
    more = r.builder.rounded_up(x, kernel, stride, dilation, pads) if a.get("ceil_mode", 0) else (0, 0)
    return x, kernel, stride, dilation, pads, more, line


def _average_pool(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x, kernel, stride, dilation, pads, more, line = _pool_window(r, node, a)
    if dilation != (1, 1):
        raise InputError(f"attribute dilations = {list(dilation)} is not supported", fix="only 1 is")
    counted = bool(a.get("count_include_pad", 0))
    _mapped(r, node, r.builder.average_windows(x, kernel, stride, pads, more, counted), line)


def _max_pool(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x, kernel, stride, dilation, pads, more, line = _pool_window(r, node, a)
    a.ignore("storage_order")  # of the second output, which is refused where it is read
    pads = (*pads[:2], pads[2] + more[0], pads[3] + more[1])
    _mapped(r, node, r.builder.max_pool(x, kernel, stride, dilation, pads), line)


def _global_average(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.source(node)
    r.result(node, r.builder.reduce(x, list(range(1, len(r.builder.shape(x)))), True, True))


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
    added = _doubts(None if shift is None else shift.times(beta))
    if alpha == 1.0:
        index = r.builder.doubt(r.builder.matrix(x.index, matrix, bias), _doubts(own), added)
    else:
        # programs multiply the sums, or the weights
        index = r.builder.doubt(r.builder.matrix(x.index, matrix, None), _doubts(own), None)
        index = r.builder.doubt(r.builder.scale(index, np.asarray(alpha), bias), None, added)
    r.result(node, index, (*x.whole[:-1], matrix.shape[0]))


def _batch_norm(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.source(node)
    a.only("training_mode", 0)
    a.only("spatial", 1)
    a.ignore("momentum")
    scale, shift, mean, variance = (r.weight(node, k) for k in range(1, 5))
    r.result(node, r.builder.batch_norm(x, scale, shift, mean, variance, float(a.get("epsilon", 1e-5))))


def _unary(make: Callable[[CompositeBuilder, int, Attributes], int]) -> Rule:
    """A function of every number, whatever the shape."""

    def rule(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
        x = r.value(node)
        r.result(node, make(r.builder, x.index, a), x.whole)

    return rule


def _curve(kind: Callable[..., activations.ScalarFunction]) -> Rule:
    return _unary(lambda builder, x, a: builder.curve(x, kind))


def _clip(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.value(node)
    limits = []
    for position, (name, default) in enumerate((("min", -math.inf), ("max", math.inf)), 1):
        limit = a.get(name)
        limits.append(float(np.reshape(r.constant(node, position, default), -1)[0] if limit is None else limit))
    r.result(node, r.builder.clip(x.index, *limits), x.whole)


def _elu(b: CompositeBuilder, x: int, a: Attributes) -> int:
    return b.curve(x, activations.Elu, alpha=_positive(a, "alpha", 1.0))


def _celu(b: CompositeBuilder, x: int, a: Attributes) -> int:
    alpha = _positive(a, "alpha", 1.0)
    return b.curve(x, activations.Elu, alpha=alpha, width=alpha)


def _selu(b: CompositeBuilder, x: int, a: Attributes) -> int:
    alpha, gamma = _positive(a, "alpha", 1.67326319217681884765625), _positive(a, "gamma", 1.05070102214813232421875)
    return b.curve(x, activations.Elu, alpha=alpha, scale=gamma)


def _hard_sigmoid(b: CompositeBuilder, x: int, a: Attributes) -> int:
    return b.curve(x, activations.Clip, factor=_positive(a, "alpha", 0.2), offset=float(a.get("beta", 0.5)))


def _gelu(b: CompositeBuilder, x: int, a: Attributes) -> int:
    a.only("approximate", "none", "tanh")
    return b.curve(x, activations.GeluTanh if a.get("approximate", "none") == "tanh" else activations.Gelu)


def _positive(a: Attributes, name: str, default: float) -> float:
    value = float(a.get(name, default))
    if not LEAST_DIVISOR < value < 2.0**20:
        raise InputError(f"attribute {name} = {value} is not supported", fix="between 1e-30 and 1e6 expected")
    return value


def _prelu(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.value(node)
    r.result(node, r.builder.prelu(x.index, r.weight(node, 1)), x.whole)


def _cast(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.value(node)
    a.ignore("saturate")
    if a.get("to") not in (onnx.TensorProto.FLOAT, onnx.TensorProto.DOUBLE):
        name = onnx.TensorProto.DataType.Name(int(a.get("to", 0)))
        fix = "export the network in float32" + (": write model.float() before it" if "FLOAT16" in name else "")
        raise InputError(f"attribute to = {name} is not supported", fix=fix)
    r.values[node.output[0]] = x


def _identity(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    r.values[node.output[0]] = r.value(node)


def _dropout(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    a.ignore("ratio", "seed")
    a.only("is_test", 1)
    training = r.constant(node, 2)
    if training is not None and bool(np.any(training)):
        raise InputError("is in training mode", fix="export the network in evaluation mode")
    if any(node.output[1:]):
        raise InputError("gives its mask to other nodes", fix="export the network in evaluation mode")
    r.values[node.output[0]] = r.value(node)


def _constant(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    value = a.get("value")
    if value is not None:
        r.fold(node, r.stored.array(value, f"node {node.name} (Constant)"))
        return
    for name, kind in (
        ("value_float", np.float32),
        ("value_int", np.int64),
        ("value_floats", np.float32),
        ("value_ints", np.int64),
    ):
        value = a.get(name)
        if value is not None:
            r.fold(node, np.array(value, kind))
            return
    raise InputError("holds no number", fix="only value, value_float(s) and value_int(s) are read")


def _shape(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    whole = r.value(node).whole
    start, end = int(a.get("start", 0)), a.get("end")
    r.fold(node, np.array(whole[slice(start, None if end is None else int(end))], np.int64))


def _number(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    r.fold(node, np.array(math.prod(r.value(node).whole), np.int64))


# ---------------------------------------------------------------- two values


def _binary(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    kind = node.op_type
    a.ignore("axis", "broadcast")
    one, two = (_operand(r, node, k, True) for k in range(2))
    if isinstance(one, TensorValue) and isinstance(two, TensorValue):
        r.result(node, *_both(r.builder, kind, one, two))
        return
    own = r.doubts(node, 1 if isinstance(one, TensorValue) else 0)
    if isinstance(one, TensorValue):
        value, constant = one, np.asarray(two, np.float64)
    else:
        assert isinstance(two, TensorValue)
        value, constant = two, np.asarray(one, np.float64)
    x, whole = _spread(r.builder, value, constant.shape)
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
        off = _doubts(own, r.builder.shape(x))
        index = r.builder.doubt(index, *((off, None) if kind in ("Mul", "Div") else (None, off)))
    r.result(node, index, whole)


def _doubts(constant: EnclosedConstant | None, shape: Shape | None = None) -> ConstantIntervals | None:
    """Doubts of a constant, spread to an item or given the shape of weights."""
    if constant is None:
        return None
    intervals = constant.doubts
    if shape is None:
        return intervals
    if intervals[0].size == math.prod(shape):
        return intervals[0].reshape(shape), intervals[1].reshape(shape)
    real, single = (np.broadcast_to(part, (1, *shape))[0] for part in intervals)
    return real, single


def _operand(r: OnnxReader, node: onnx.NodeProto, position: int, doubtful: bool = False) -> TensorValue | np.ndarray:
    return r.value(node, position) if r.moves(node, position) else r.weight(node, position, doubtful)


def _spread(b: CompositeBuilder, value: TensorValue, shape: Sequence[int]) -> tuple[int, Shape]:
    """The value repeated to what a constant of ``shape`` makes of it."""
    try:
        whole = np.broadcast_shapes(value.whole, tuple(shape))
    except ValueError:
        raise InputError(f"constant {item(shape)} with a value {item(value.whole)}") from None
    return _to(b, value, whole), whole


def _to(b: CompositeBuilder, value: TensorValue, whole: Shape) -> int:
    """The value repeated to a shape, as an item of what will have that shape."""
    if value.whole == tuple(whole):
        return value.index
    grown = (1,) * (len(whole) - len(value.whole)) + value.whole
    after = TensorValue(0, tuple(whole)).item
    before = grown[len(whole) - len(after) :]
    return b.spread(b.reshape(value.index, before), after)


def _both(b: CompositeBuilder, kind: str, one: TensorValue, two: TensorValue) -> tuple[int, Shape]:
    try:
        whole = np.broadcast_shapes(one.whole, two.whole)
    except ValueError:
        raise InputError(f"shapes {item(one.whole)} and {item(two.whole)} do not fit") from None
    first, second = _to(b, one, whole), _to(b, two, whole)
    if kind in ("Add", "Sub"):
        return b.sum((first, second), (1, 1 if kind == "Add" else -1)), whole
    if kind == "Div":
        return b.product(first, _to(b, TensorValue(b.reciprocal(two.index), two.whole), whole)), whole
    return b.product(first, second), whole


def _variadic(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    """Max, Min and Sum of any number of values and constants."""
    kind = node.op_type
    result = r.value(node, next(k for k in range(len(node.input)) if r.moves(node, k)))
    done = False
    for k in range(len(node.input)):
        other = _operand(r, node, k)
        if isinstance(other, TensorValue):
            if other is result and not done:
                done = True
                continue
            if kind == "Sum":
                result = TensorValue(*_both(r.builder, "Add", result, other))
                continue
            whole = np.broadcast_shapes(result.whole, other.whole)
            parts = _to(r.builder, result, whole), _to(r.builder, other, whole)
            result = TensorValue(r.builder.extreme(parts, kind == "Max"), whole)
            continue
        x, whole = _spread(r.builder, result, other.shape)
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
    parts = [_operand(r, node, k) for k in (1, 2)]
    shapes = [chosen.shape, *(p.whole if isinstance(p, TensorValue) else p.shape for p in parts)]
    whole = np.broadcast_shapes(*shapes)
    moving, offset = [], np.zeros(whole)
    for part, mask in zip(parts, (chosen, ~chosen), strict=True):
        if isinstance(part, TensorValue):
            moving.append(r.builder.scale(_to(r.builder, part, whole), mask.astype(np.float64), None))
        else:
            offset = offset + np.where(mask, np.asarray(part, np.float64), 0.0)
    index = r.builder.sum(tuple(moving), (1,) * len(moving), exact=True) if len(moving) > 1 else moving[0]
    r.result(node, r.builder.scale(index, np.ones(()), offset) if offset.any() else index, whole)


def _given(operand: TensorValue | np.ndarray) -> Operand:
    return (operand.index, operand.whole) if isinstance(operand, TensorValue) else (operand, operand.shape)


def _matmul(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    if r.batch > 1 and (r.moves(node, 1) or r.weight(node, 1).ndim > 2):
        raise InputError(f"multiplies within a batch of {r.batch} items", fix="export with a batch of 1")
    own = r.doubts(node, 1)
    flat = own is not None and own.value.ndim == 2
    result = matmul(r.builder, *(_given(_operand(r, node, k, k == 1 and flat)) for k in range(2)))
    if own is not None:
        r.builder.doubt(result[0], _doubts(own.turned()), None)
    r.result(node, *result)


def _einsum(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    operands = [_given(_operand(r, node, k)) for k in range(len(node.input))]
    r.result(node, *einsum(r.builder, str(a.get("equation", "")), operands))


# ---------------------------------------------------------------- shapes


def _places(r: OnnxReader, value: TensorValue) -> np.ndarray:
    """Flat positions in the shape that the file sees."""
    return r.builder.positions(value.index).reshape(value.whole)


def _moved(r: OnnxReader, node: onnx.NodeProto, value: TensorValue, places: np.ndarray, output: int = 0) -> None:
    """An output that holds the numbers at flat positions of a value."""
    if places.size == 0:
        raise InputError(f"nothing is left of {item(value.whole)}", fix="check the constants")
    index = value.index
    if places.size != math.prod(value.whole) or not np.array_equal(places.reshape(-1), np.arange(places.size)):
        index = r.builder.rearranged(index, places.reshape(TensorValue(0, places.shape or (1,)).item))
    r.result(node, index, places.shape or (1,), output)


def _flatten(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x, axis = r.value(node), int(a.get("axis", 1))
    if not -len(x.whole) <= axis <= len(x.whole):
        raise InputError(f"attribute axis = {axis} of {item(x.whole)}", fix="use 1")
    axis = axis + len(x.whole) if axis < 0 else axis
    if r.batch > 1 and axis != 1:
        raise InputError(f"attribute axis = {axis} on a batch of {r.batch} items", fix="use 1")
    r.result(node, x.index, (math.prod(x.whole[:axis]), math.prod(x.whole[axis:])))


def _reshape(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.value(node)
    target = [int(v) for v in np.atleast_1d(r.weight(node, 1))]
    if 0 in target:
        # without a 0 in the shape, as the exporters write it, the attribute means nothing
        a.only("allowzero", 0)
    a.ignore("allowzero")
    for k, size in enumerate(target):
        if size == 0:
            if k >= len(x.whole):
                raise InputError(f"shape {target} copies a size that is not there", fix="check the shape")
            target[k] = x.whole[k]
    if r.batch > 1:
        if not x.batched or not target or target[0] not in (r.batch, -1):
            raise InputError(f"shape {target} mixes the {r.batch} items of a batch", fix="export with a batch of 1")
        target[0] = 1 if target[0] == r.batch else -1
    total, rest = math.prod(x.whole), math.prod(v for v in target if v != -1)
    if target.count(-1) > 1 or rest <= 0 or total % rest or (-1 not in target and rest != total):
        raise InputError(f"shape {target} of {total} numbers", fix="export with a batch of 1")
    r.result(node, x.index, tuple(total // rest if v == -1 else v for v in target))


def _axes(r: OnnxReader, node: onnx.NodeProto, a: Attributes, rank: int) -> list[int] | None:
    """Axes of the shape that the file sees, from an attribute or the second input."""
    axes = a.get("axes")
    if axes is None:
        axes = r.constant(node, 1)
    if axes is None:
        return None
    numbers = [int(v) for v in np.atleast_1d(axes)]
    if any(not -rank <= v < rank for v in numbers) or len({v % rank for v in numbers}) != len(numbers):
        raise InputError(f"axes {numbers} of {rank}", fix="check the axes")
    return sorted(v % rank for v in numbers)


def _squeeze(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.value(node)
    axes = _axes(r, node, a, len(x.whole))
    axes = [k for k, n in enumerate(x.whole) if n == 1] if axes is None else axes
    if any(x.whole[k] != 1 for k in axes):
        raise InputError(f"axes {axes} of {item(x.whole)} are not 1", fix="check the axes")
    r.result(node, x.index, tuple(n for k, n in enumerate(x.whole) if k not in axes) or (1,))


def _unsqueeze(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.value(node)
    named = a.get("axes")
    count = np.size(r.weight(node, 1) if named is None else named)
    shape = list(x.whole)
    for k in _axes(r, node, a, len(shape) + count) or []:
        shape.insert(k, 1)
    r.result(node, x.index, tuple(shape))


def _transpose(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.value(node)
    rank = len(x.whole)
    order = [int(v) for v in a.get("perm", range(rank - 1, -1, -1))]
    if sorted(order) != list(range(rank)):
        raise InputError(f"attribute perm = {order} of {rank} axes", fix="check the axes")
    _moved(r, node, x, _places(r, x).transpose(order))


def _pad(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.source(node)
    rank = 1 + len(r.builder.shape(x))
    mode, pads = a.get("mode", "constant"), a.get("pads")
    if pads is None:
        pads = r.weight(node, 1)
    value = a.get("value")
    if value is None:
        value = r.constant(node, 2, 0.0)
    pads = [int(v) for v in np.atleast_1d(pads)]
    axes = r.constant(node, 3)
    if axes is not None:
        axes = [int(v) for v in np.atleast_1d(axes)]
        if len(pads) != 2 * len(axes) or any(not -rank <= v < rank for v in axes):
            raise InputError(f"pads = {pads} of axes {axes}", fix="give two pads an axis")
        spread = [0] * (2 * rank)
        for k, axis in enumerate(axes):
            spread[axis % rank], spread[rank + axis % rank] = pads[k], pads[len(axes) + k]
        pads = spread
    if len(pads) != 2 * rank or pads[0] or pads[rank]:
        raise InputError(f"pads = {pads} is not supported", fix="give pads of every axis, none of the batch")
    before, after = pads[1:rank], pads[rank + 1 :]
    r.result(node, r.builder.pad(x, before, after, mode, float(np.asarray(value).reshape(-1)[0])))


def _concat(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    axis = a.get("axis")
    parts = [_operand(r, node, k) for k in range(len(node.input))]
    wholes = [p.whole if isinstance(p, TensorValue) else p.shape for p in parts]
    rank = len(wholes[0])
    if axis is None or not -rank <= axis < rank:
        raise InputError(f"attribute axis = {axis} is not supported", fix="name an axis of the item")
    axis %= rank
    if any(len(w) != rank or w[:axis] + w[axis + 1 :] != wholes[0][:axis] + wholes[0][axis + 1 :] for w in wholes):
        raise InputError(f"shapes {[item(w) for w in wholes]} do not fit", fix="check the axis")
    values = [p for p in parts if isinstance(p, TensorValue)]
    if len(values) == len(parts) and axis > 0 and all(v.batched for v in values):
        r.result(node, r.builder.concat([v.index for v in values], axis - 1))
        return
    if axis == 0 and all(v.batched for v in values):
        raise InputError("attribute axis = 0 is not supported", fix="the batch, axis 0, must stay")
    r.result(node, *concatenated(r.builder, [_given(p) for p in parts], axis))


def _slice(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.value(node)
    starts, ends = a.get("starts"), a.get("ends")
    if starts is None:
        starts, ends = r.weight(node, 1), r.weight(node, 2)
    starts, ends = np.atleast_1d(starts), np.atleast_1d(ends)
    axes = a.get("axes")
    axes = np.atleast_1d(r.constant(node, 3, np.arange(len(starts))) if axes is None else axes)
    steps = np.atleast_1d(r.constant(node, 4, np.ones(len(starts), np.int64)))
    if not len(starts) == len(ends) == len(axes) == len(steps):
        raise InputError("starts, ends, axes and steps differ in length", fix="check the constants")
    rank = len(x.whole)
    chosen = [slice(None)] * rank
    for start, end, axis, step in zip(starts, ends, axes, steps, strict=True):
        if not -rank <= axis < rank or step == 0:
            raise InputError(f"axis {axis} with step {step} of {item(x.whole)}", fix="check the constants")
        start, end, size = int(start), int(end), x.whole[int(axis)]
        if step < 0:
            # before the first number is None for Python, and far below for ONNX
            start, end = min(start, size - 1), None if end < -size else end
        chosen[int(axis)] = slice(start, end, int(step))
    if x.batched and len(range(1)[chosen[0]]) == 1:
        _part(r, node, x, chosen)
    else:
        _moved(r, node, x, _places(r, x)[tuple(chosen)])


def _part(r: OnnxReader, node: onnx.NodeProto, x: TensorValue, chosen: Sequence[slice], output: int = 0) -> None:
    """Part of an item."""
    if not x.batched:
        _moved(r, node, x, _places(r, x)[tuple(chosen)], output)
        return
    index = r.builder.part(x.index, chosen[1:])
    r.result(node, index, (1, *r.builder.shape(index)), output)


def _split(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.value(node)
    axis, rank = int(a.get("axis", 0)), len(x.whole)
    if not -rank <= axis < rank:
        raise InputError(f"attribute axis = {axis} of {item(x.whole)}", fix="check the axis")
    axis %= rank
    sizes = a.get("split")
    if sizes is None:
        sizes = r.constant(node, 1)
    size, count = x.whole[axis], len(node.output)
    a.only("num_outputs", count)
    if sizes is None:
        each = -(-size // count)
        sizes = [each] * (count - 1) + [size - each * (count - 1)]
    sizes = [int(v) for v in np.atleast_1d(sizes)]
    if sum(sizes) != size or len(sizes) != count or min(sizes) < 1:
        raise InputError(f"split = {sizes} of {size}", fix="check the sizes")
    done = 0
    for output, length in enumerate(sizes):
        if node.output[output]:
            chosen = [slice(None)] * rank
            chosen[axis] = slice(done, done + length)
            _part(r, node, x, chosen, output)
        done += length


def _gather(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x, indices = r.value(node), np.asarray(r.weight(node, 1))
    axis, rank = int(a.get("axis", 0)), len(x.whole)
    if not -rank <= axis < rank:
        raise InputError(f"attribute axis = {axis} of {item(x.whole)}", fix="check the axis")
    size = x.whole[axis]
    if indices.dtype.kind not in "iu" or (indices.size and not (-size <= indices.min() and indices.max() < size)):
        raise InputError(f"indices do not lie in the {size} numbers of axis {axis}", fix="check the indices")
    r.builder.reserve(float(math.prod(x.whole)) / size * indices.size)
    _moved(r, node, x, np.take(_places(r, x), indices, axis))


def _gather_nd(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x, indices = r.value(node), np.asarray(r.weight(node, 1))
    a.only("batch_dims", 0)
    count = indices.shape[-1] if indices.ndim else 0
    if not 1 <= count <= len(x.whole) or indices.dtype.kind not in "iu" or not indices.size:
        raise InputError(f"indices {item(indices.shape)} of {item(x.whole)}", fix="check the indices")
    sizes = np.array(x.whole[:count])
    if not bool(((-sizes <= indices) & (indices < sizes)).all()):
        raise InputError(f"indices do not lie in {item(x.whole[:count])}", fix="check the indices")
    r.builder.reserve(float(indices.size // count) * math.prod(x.whole[count:]))
    _moved(r, node, x, _places(r, x)[tuple(np.moveaxis(indices, -1, 0))])


def _expand(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x, shape = r.value(node), [int(v) for v in np.atleast_1d(r.weight(node, 1))]
    index, whole = _spread(r.builder, x, shape)
    r.result(node, index, whole)


def _tile(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x, repeats = r.value(node), [int(v) for v in np.atleast_1d(r.weight(node, 1))]
    r.builder.reserve(float(math.prod(x.whole)) * math.prod(float(max(0, v)) for v in repeats))
    _moved(r, node, x, np.tile(_places(r, x), repeats))


def _depth_to_space(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.value(node)
    size, mode = int(a.get("blocksize", 0)), a.get("mode", "DCR")
    n, c, h, w = x.whole if len(x.whole) == 4 else (0, 0, 0, 0)
    if size < 1 or n != 1:
        raise InputError(f"attribute blocksize = {size} of {item(x.whole)}", fix="check the size")
    if node.op_type == "SpaceToDepth":
        if h % size or w % size:
            raise InputError(f"attribute blocksize = {size} of {item(x.whole)}", fix="it must divide the size")
        places = _places(r, x).reshape(n, c, h // size, size, w // size, size).transpose(0, 3, 5, 1, 2, 4)
        _moved(r, node, x, places.reshape(n, c * size * size, h // size, w // size))
        return
    if c % (size * size) or mode not in ("DCR", "CRD"):
        raise InputError(f"attributes blocksize = {size}, mode = {mode} of {item(x.whole)}", fix="check the size")
    rest = c // (size * size)
    if mode == "DCR":
        places = _places(r, x).reshape(n, size, size, rest, h, w).transpose(0, 3, 4, 1, 5, 2)
    else:
        places = _places(r, x).reshape(n, rest, size, size, h, w).transpose(0, 1, 4, 2, 5, 3)
    _moved(r, node, x, places.reshape(n, rest, h * size, w * size))


def _resize(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.source(node)
    shape = r.builder.shape(x)
    if len(shape) != 3:
        raise InputError(f"input {item(shape)}", fix="only maps of rows and columns are resized")
    mode = a.get("mode", "nearest")
    a.only("antialias", 0)
    a.only("keep_aspect_ratio_policy", "stretch")
    a.ignore("extrapolation_value")
    if mode not in ("nearest", "linear", "bilinear", "cubic"):
        raise InputError(f"attribute mode = {mode} is not supported", fix="use nearest, linear or cubic")
    if mode == "cubic":
        a.only("exclude_outside", 0)
    bend = float(a.get("cubic_coeff_a", -0.75))
    a.ignore("exclude_outside")
    axes = [int(v) % 4 for v in a.get("axes", range(4))]
    old = node.op_type == "Upsample" or r.opset < 11
    scales = a.get("scales")
    if scales is None:
        scales = r.constant(node, 1 if old else 2)
    sizes = None if old else r.constant(node, 3)
    coordinates = a.get("coordinate_transformation_mode", "asymmetric" if old else "half_pixel")
    nearest = a.get("nearest_mode", "floor" if old else "round_prefer_floor")
    whole: list[int] = [1, *shape]
    ratio: list[float | None] = [None] * 4
    out = list(whole)
    if sizes is not None and np.size(sizes):
        for axis, size in zip(axes, np.atleast_1d(sizes), strict=True):
            out[axis] = int(size)
    elif scales is not None and np.size(scales) == len(axes):
        for axis, scale in zip(axes, np.atleast_1d(scales), strict=True):
            if not 0.0 < float(scale) < 1024.0:
                raise InputError(f"scales {list(np.atleast_1d(scales))}", fix="positive numbers expected")
            out[axis], ratio[axis] = int(np.float32(whole[axis]) * np.float32(scale)), float(scale)
    else:
        raise InputError("neither scales nor sizes are given", fix="export with fixed sizes")
    if out[:2] != whole[:2] or min(out) < 1:
        raise InputError(f"resizes {item(whole)} to {item(out)}", fix="only rows and columns may change")
    if out == whole and any(v not in (None, 1.0) for v in ratio):
        # onnxruntime copies, the operator's definition does not
        raise InputError(f"scales of {item(whole)} that keep its size", fix="export with sizes, or without the node")
    r.builder.reserve(float(math.prod(out)) * 4.0)
    maps = [interpolation(whole[k], out[k], mode, coordinates, nearest, ratio[k], bend) for k in (2, 3)]
    r.result(node, r.builder.resize(x, maps))


# ---------------------------------------------------------------- windows, means and norms


def _conv_transpose(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    (x, line), weight, bias = _map(r, r.source(node)), r.weight(node, 1, True), r.constant(node, 2, None, True)
    weight = weight.reshape(*weight.shape, *[1] * line)
    a.only("auto_pad", "NOTSET", "VALID")
    _ints(a, "kernel_shape", line)
    stride, dilation = _ints(a, "strides", line, 1), _ints(a, "dilations", line, 1)
    pads, more = a.ints("pads", 2 if line else 4, 0), _ints(a, "output_padding", line, 0, 0)
    assert pads is not None
    pads = (pads[0], 0, pads[1], 0) if line else pads
    if a.get("output_shape") is not None:
        raise InputError("attribute output_shape is not supported", fix="use pads and output_padding")
    groups = int(a.get("group", 1))
    index = r.builder.transposed_convolution(x, weight, bias, stride, dilation, pads, more, groups)
    r.builder.doubt(index, _doubts(r.doubts(node, 1), weight.shape), _doubts(r.doubts(node, 2)))
    _mapped(r, node, index, line)


def _squared(b: CompositeBuilder, x: int) -> int:
    return b.curve(x, activations.Power, exponent=2)


#: What is summed up, and whether the root of the sum is taken.
_SUMMED: dict[str, tuple[Callable[[CompositeBuilder, int], int] | None, bool]] = {
    "ReduceL1": (lambda b, x: b.curve(x, activations.Abs), False),
    "ReduceL2": (_squared, True),
    "ReduceMean": (None, False),
    "ReduceSum": (None, False),
    "ReduceSumSquare": (_squared, False),
}


def _reduce(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.value(node)
    kind, rank = node.op_type, len(x.whole)
    axes = _axes(r, node, a, rank)
    if not axes and a.get("noop_with_empty_axes", 0):
        r.values[node.output[0]] = x
        return
    a.ignore("noop_with_empty_axes")
    axes = axes or list(range(rank))
    keep = bool(a.get("keepdims", 1))
    inner = [k - x.batched for k in axes if k >= x.batched]
    if kind in _SUMMED:
        before, behind = _SUMMED[kind]
        index = x.index if before is None else before(r.builder, x.index)
        index = r.builder.reduce(index, inner, kind == "ReduceMean", True)
        index = r.builder.power(index, 0.5) if behind else index
    else:
        index = r.builder.greatest(x.index, inner, True, kind == "ReduceMax") if inner else x.index
    whole = tuple(1 if k in axes else n for k, n in enumerate(x.whole))
    r.result(node, index, whole if keep else tuple(n for k, n in enumerate(whole) if k not in axes) or (1,))


def _global_max(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.source(node)
    r.result(node, r.builder.greatest(x, list(range(1, len(r.builder.shape(x)))), True))


def _softmax(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.value(node)
    rank = len(x.whole)
    axis = int(a.get("axis", -1 if r.opset >= 13 else 1))
    if not -rank <= axis < rank:
        raise InputError(f"attribute axis = {axis} of {item(x.whole)}", fix="check the axis")
    axis %= rank
    if r.opset < 13 and axis != rank - 1:
        raise InputError(f"attribute axis = {axis} before operator set 13", fix="use the last axis, or operator set 13")
    if axis < x.batched:
        raise InputError(f"attribute axis = {axis} is not supported", fix="the batch must stay")
    dropped = r.dropped.get(node.input[0])
    if dropped is not None:
        dropped = dropped.reshape(r.builder.shape(x.index))
    index = r.builder.softmax(x.index, axis - x.batched, node.op_type == "LogSoftmax", dropped)
    r.result(node, index, x.whole)


def _layer_norm(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.value(node)
    rank = len(x.whole)
    axis = int(a.get("axis", -1)) % rank
    a.ignore("stash_type")
    if axis < x.batched or any(node.output[1:]):
        raise InputError(f"attribute axis = {axis} is not supported", fix="normalise over axes of the item alone")
    inner = list(range(axis - x.batched, rank - x.batched))
    index = r.builder.normalise(x.index, inner, float(a.get("epsilon", 1e-5)))
    index = r.builder.scale(index, np.asarray(r.weight(node, 1), np.float64), None)
    r.result(node, r.builder.shift(index, r.constant(node, 2)), x.whole)


def _group_norm(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.source(node)
    shape = r.builder.shape(x)
    channels = shape[0]
    groups = channels if node.op_type == "InstanceNormalization" else int(a.get("num_groups", 0))
    a.ignore("stash_type")
    if groups < 1 or channels % groups or len(shape) < 2:
        raise InputError(f"attribute num_groups = {groups} of {channels} channels", fix="it must divide them")
    split = (groups, channels // groups, *shape[1:])
    index = r.builder.normalise(r.builder.reshape(x, split), list(range(1, len(split))), float(a.get("epsilon", 1e-5)))
    index = r.builder.reshape(index, shape)
    parts = []
    for k in (1, 2):
        weights = np.asarray(r.weight(node, k), np.float64)
        if weights.shape not in ((channels,), (groups,)):
            raise InputError(
                f"input {k} {item(weights.shape)} of {channels} channels", fix="one number a channel expected"
            )
        parts.append(np.repeat(weights, channels // weights.size).reshape(-1, *[1] * (len(shape) - 1)))
    r.result(node, r.builder.shift(r.builder.scale(index, parts[0], None), parts[1]))


RULES: dict[str, Rule] = {
    "Abs": _curve(activations.Abs),
    "Add": _binary,
    "AveragePool": _average_pool,
    "BatchNormalization": _batch_norm,
    "Cast": _cast,
    "Celu": _unary(_celu),
    "Clip": _clip,
    "Concat": _concat,
    "Constant": _constant,
    "Conv": _conv,
    "ConvTranspose": _conv_transpose,
    "DepthToSpace": _depth_to_space,
    "DequantizeLinear": dequantize,
    "Div": _binary,
    "Dropout": _dropout,
    "Einsum": _einsum,
    "Elu": _unary(_elu),
    "Erf": _curve(activations.Erf),
    "Exp": _curve(activations.Exp),
    "Expand": _expand,
    "Flatten": _flatten,
    "Gather": _gather,
    "GatherND": _gather_nd,
    "Gelu": _unary(_gelu),
    "Gemm": _gemm,
    "GlobalAveragePool": _global_average,
    "GlobalMaxPool": _global_max,
    "Greater": _greater,
    "GroupNormalization": _group_norm,
    "HardSigmoid": _unary(_hard_sigmoid),
    "HardSwish": _curve(activations.HardSwish),
    "Identity": _identity,
    "InstanceNormalization": _group_norm,
    "IsNaN": _is_nan,
    "LayerNormalization": _layer_norm,
    "LeakyRelu": _unary(lambda b, x, a: b.prelu(x, np.asarray(float(a.get("alpha", 0.01))))),
    "Log": _unary(lambda b, x, a: b.logarithm(x)),
    "LogSoftmax": _softmax,
    "MatMul": _matmul,
    "Max": _variadic,
    "MaxPool": _max_pool,
    "Min": _variadic,
    "Mish": _curve(activations.Mish),
    "Mul": _binary,
    "Neg": _unary(lambda b, x, a: b.scale(x, -np.ones(()), None)),
    "PRelu": _prelu,
    "Pad": _pad,
    "Pow": _pow,
    "QuantizeLinear": quantize,
    "Reciprocal": _unary(lambda b, x, a: b.reciprocal(x)),
    "ReduceL1": _reduce,
    "ReduceL2": _reduce,
    "ReduceMax": _reduce,
    "ReduceMean": _reduce,
    "ReduceMin": _reduce,
    "ReduceSum": _reduce,
    "ReduceSumSquare": _reduce,
    "Relu": _unary(lambda b, x, a: b.leaky_relu(x, 0.0)),
    "Reshape": _reshape,
    "Resize": _resize,
    "Selu": _unary(_selu),
    "Shape": _shape,
    "Sigmoid": _unary(lambda b, x, a: b.sigmoid(x)),
    "Size": _number,
    "Slice": _slice,
    "Softmax": _softmax,
    "Softplus": _curve(activations.Softplus),
    "Softsign": _unary(lambda b, x, a: b.softsign(x)),
    "SpaceToDepth": _depth_to_space,
    "Split": _split,
    "Sqrt": _unary(lambda b, x, a: b.power(x, 0.5)),
    "Squeeze": _squeeze,
    "Sub": _binary,
    "Sum": _variadic,
    "Tanh": _unary(lambda b, x, a: b.tanh(x)),
    "Tile": _tile,
    "Transpose": _transpose,
    "Unsqueeze": _unsqueeze,
    "Upsample": _resize,
    "Where": _where,
}
