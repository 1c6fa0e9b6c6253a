"""Rules of ONNX operators that reduce axes, or normalise over them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import onnx

from ns_abstract.arithmetic.network_charges import LEAST_DIVISOR, OVERFLOW
from ns_abstract.io.errors import InputError
from ns_abstract.verify.network import activations
from ns_abstract.verify.network.composite_layers import CompositeBuilder
from ns_abstract.verify.network.graph import item
from ns_abstract.verify.network.onnx_graph import Attributes, OnnxReader, Rule
from ns_abstract.verify.network.onnx_shapes import axes_of

#: What ONNX adds to variances where the node says nothing.
_EPSILON = 1e-5


def _global_average(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.source(node)
    r.result(node, r.builder.reduce(x, list(range(1, len(r.builder.shape(x)))), True, True))


def _batch_norm(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.source(node)
    a.only("training_mode", 0)
    a.only("spatial", 1)
    a.ignore("momentum")
    scale, shift, mean, variance = (r.weight(node, k) for k in range(1, 5))
    r.result(node, r.builder.batch_norm(x, scale, shift, mean, variance, float(a.get("epsilon", _EPSILON))))


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
    axes = axes_of(r, node, a, rank)
    if not axes and a.get("noop_with_empty_axes", 0):
        if _SUMMED.get(kind, (None, False))[0] is not None:
            # onnxruntime takes sizes and squares all the same
            raise InputError("attribute noop_with_empty_axes = 1: programs differ", fix="name the axes")
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
    a.only("stash_type", onnx.TensorProto.FLOAT, onnx.TensorProto.DOUBLE)
    if axis < x.batched or any(node.output[1:]):
        raise InputError(f"attribute axis = {axis} is not supported", fix="normalise over axes of the item alone")
    inner = list(range(axis - x.batched, rank - x.batched))
    index = r.builder.normalise(x.index, inner, float(a.get("epsilon", _EPSILON)))
    index = r.builder.scale(index, np.asarray(r.weight(node, 1), np.float64), None)
    r.result(node, r.builder.shift(index, r.constant(node, 2)), x.whole)


def _group_norm(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x = r.source(node)
    shape = r.builder.shape(x)
    channels = shape[0]
    groups = channels if node.op_type == "InstanceNormalization" else int(a.get("num_groups", 0))
    a.only("stash_type", onnx.TensorProto.FLOAT, onnx.TensorProto.DOUBLE)
    if groups < 1 or channels % groups or len(shape) < 2:
        raise InputError(f"attribute num_groups = {groups} of {channels} channels", fix="it must divide them")
    split = (groups, channels // groups, *shape[1:])
    index = r.builder.normalise(
        r.builder.reshape(x, split), list(range(1, len(split))), float(a.get("epsilon", _EPSILON))
    )
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


#: What attributes of LRN are where a file leaves them out.
_LOCAL_RESPONSE = {"alpha": 1e-4, "beta": 0.75, "bias": 1.0}


def _local_response(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x, size = r.source(node), int(a.get("size", 0))
    alpha, beta, bias = (float(np.float32(a.get(name, default))) for name, default in _LOCAL_RESPONSE.items())
    if size < 1 or not (0.0 <= alpha < OVERFLOW and 0.0 < beta <= 8.0 and LEAST_DIVISOR < bias < OVERFLOW):
        raise InputError(
            f"attributes size = {size}, alpha = {alpha}, beta = {beta}, bias = {bias} are not supported",
            fix="a size, an alpha of 0 or more, a beta up to 8 and a bias above 0 expected",
        )
    r.result(node, r.builder.local_response(x, size, alpha, beta, bias))


NORM_RULES: dict[str, Rule] = {
    "BatchNormalization": _batch_norm,
    "GlobalAveragePool": _global_average,
    "GlobalMaxPool": _global_max,
    "GroupNormalization": _group_norm,
    "InstanceNormalization": _group_norm,
    "LRN": _local_response,
    "LayerNormalization": _layer_norm,
    "LogSoftmax": _softmax,
    "ReduceL1": _reduce,
    "ReduceL2": _reduce,
    "ReduceMax": _reduce,
    "ReduceMean": _reduce,
    "ReduceMin": _reduce,
    "ReduceSum": _reduce,
    "ReduceSumSquare": _reduce,
    "Softmax": _softmax,
}
