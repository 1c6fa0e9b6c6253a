"""Rules that turn ONNX operators into layers; other operators are refused with a fix."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import onnx

from ns_abstract.arithmetic.network_charges import LEAST_DIVISOR
from ns_abstract.io.errors import InputError
from ns_abstract.verify.network import activations
from ns_abstract.verify.network.composite_layers import CompositeBuilder
from ns_abstract.verify.network.onnx_arithmetic import ARITHMETIC_RULES
from ns_abstract.verify.network.onnx_graph import Attributes, OnnxReader, Rule
from ns_abstract.verify.network.onnx_norms import NORM_RULES
from ns_abstract.verify.network.onnx_quantised import dequantize, quantize
from ns_abstract.verify.network.onnx_shapes import SHAPE_RULES
from ns_abstract.verify.network.onnx_windows import WINDOW_RULES
from ns_abstract.verify.network.scalar_function import ScalarFunction


def _unary(make: Callable[[CompositeBuilder, int, Attributes], int]) -> Rule:
    """Return the rule of an elementwise function."""

    def rule(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
        x = r.value(node)
        r.result(node, make(r.builder, x.index, a), x.whole)

    return rule


def _curve(kind: Callable[..., ScalarFunction]) -> Rule:
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


#: The rule of every operator that is read.
RULES: dict[str, Rule] = {
    "Abs": _curve(activations.Abs),
    "Cast": _cast,
    "Celu": _unary(_celu),
    "Clip": _clip,
    "Constant": _constant,
    "DequantizeLinear": dequantize,
    "Dropout": _dropout,
    "Elu": _unary(_elu),
    "Erf": _curve(activations.Erf),
    "Exp": _curve(activations.Exp),
    "Gelu": _unary(_gelu),
    "HardSigmoid": _unary(_hard_sigmoid),
    "HardSwish": _curve(activations.HardSwish),
    "Identity": _identity,
    "LeakyRelu": _unary(lambda b, x, a: b.prelu(x, np.asarray(float(a.get("alpha", 0.01))))),
    "Log": _unary(lambda b, x, a: b.logarithm(x)),
    "Mish": _curve(activations.Mish),
    "Neg": _unary(lambda b, x, a: b.scale(x, -np.ones(()), None)),
    "PRelu": _prelu,
    "QuantizeLinear": quantize,
    "Reciprocal": _unary(lambda b, x, a: b.reciprocal(x)),
    "Relu": _unary(lambda b, x, a: b.leaky_relu(x, 0.0)),
    "Selu": _unary(_selu),
    "Shape": _shape,
    "Sigmoid": _curve(activations.Sigmoid),
    "Size": _number,
    "Softplus": _curve(activations.Softplus),
    "Softsign": _unary(lambda b, x, a: b.softsign(x)),
    "Sqrt": _unary(lambda b, x, a: b.power(x, 0.5)),
    "Tanh": _curve(activations.Tanh),
    **ARITHMETIC_RULES,
    **SHAPE_RULES,
    **WINDOW_RULES,
    **NORM_RULES,
}
