"""Quantised ONNX files: integer weights, and values that are rounded to steps (docs/dev/design.md, N25)."""

from __future__ import annotations

import numpy as np
import onnx

from ns_abstract.arithmetic.network_charges import LEAST_DIVISOR
from ns_abstract.io.errors import InputError
from ns_abstract.verify.network.byte_sums import refuse_saturating_operand, refuse_saturating_weights
from ns_abstract.verify.network.composite_activations import Quantised
from ns_abstract.verify.network.constant_enclosures import EnclosedConstant, exact_constant, scaled_integers
from ns_abstract.verify.network.onnx_choices import without_choices
from ns_abstract.verify.network.onnx_graph import Attributes, OnnxReader
from ns_abstract.verify.network.onnx_tensors import number_type

#: Operators that lay a matrix out otherwise and do not change its numbers.
_LAID_OUT = ("Transpose", "Identity", "Reshape", "Squeeze", "Unsqueeze", "Flatten", "Cast")
#: Operators that onnxruntime moves steps past, or leaves out.
_PASSED = (
    *_LAID_OUT,
    "Dropout",
    "MaxPool",
    "Slice",
    "Gather",
    "Split",
    "Concat",
    "Pad",
    "DepthToSpace",
    "SpaceToDepth",
)
#: Products of which it rounds the constants, and what it joins to them.
_PRODUCTS = ("Conv", "ConvTranspose", "Gemm", "MatMul")
_JOINED = ("Add", "Sub", "Mul", "Div", "BatchNormalization")
_RANGES = {
    np.dtype(kind): (np.iinfo(kind).min, np.iinfo(kind).max) for kind in (np.int8, np.uint8, np.int16, np.uint16)
}


def dequantize(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    """Read DequantizeLinear, ``(q - zero) scale``, of constants, and of values that `quantize` has read."""
    axis = int(a.get("axis", 1))
    a.only("block_size", 0)
    a.only("output_dtype", onnx.TensorProto.FLOAT, 0)
    scale, zero = r.weight(node, 1), r.constant(node, 2)
    if node.input[0] in r.constants:
        q = r.weight(node, 0)
        if q.dtype.kind not in "iu":
            raise InputError(f"reads type {q.dtype}", fix="store integers")
        if q.dtype.itemsize == 1:
            _refuse_products(r, node)
        refuse_saturating_weights(r.graph, q)
        number = q.astype(np.int64) - (0 if zero is None else _along(zero.astype(np.int64), q.ndim, axis))
        dequantised = scaled_integers(number, exact_constant(_along(scale, q.ndim, axis)))
        if isinstance(dequantised, EnclosedConstant):
            r.enclosed[node.output[0]] = dequantised
        r.fold(node, dequantised.value if isinstance(dequantised, EnclosedConstant) else dequantised)
        return
    quantised = r.quantised.get(node.input[0])
    own = _scalar(scale), 0 if zero is None else int(np.reshape(zero, -1)[0])
    if quantised is None or quantised != own:
        raise InputError("has another scale than the QuantizeLinear before it", fix="quantise with one scale a value")
    _refuse_rounded_constants(r, node)
    r.values[node.output[0]] = r.values[node.input[0]]


def _refuse_rounded_constants(r: OnnxReader, node: onnx.NodeProto) -> None:
    """Refuse a product of quantised values with float weights or bias whose result is quantised, too.

    onnxruntime then stores such weights in 8 bits, and rounds the bias to multiples of both scales' product (N25).
    """
    # steps, where onnxruntime moves them; results of products of steps, and whether floats are among their constants
    steps, results = set(node.output), dict[str, tuple[onnx.NodeProto, bool]]()
    integers = {name for one in r.graph.node if one.op_type == "DequantizeLinear" for name in one.output}
    values = {r.input_name}
    for reader in r.graph.node:
        if not values.isdisjoint(reader.input):
            values.update(reader.output)
        if not steps.isdisjoint(reader.input[:2]) and reader.op_type in _PRODUCTS:
            floats = any(name and name not in values | integers for name in reader.input)
            for name in reader.input[2:]:
                _refuse_other_scales(r, node, reader, name)
            # a matrix product becomes a Gemm with what is added to it
            results[reader.output[0]] = reader, floats and reader.op_type != "MatMul"
        elif not steps.isdisjoint(reader.input) and reader.op_type in _PASSED:
            steps.update(reader.output)
        found = next((results[name] for name in reader.input if name in results), None)
        if found is None:
            continue
        if reader.op_type in ("Relu", "Clip", *_PASSED):
            results.update(dict.fromkeys(reader.output, found))
        elif reader.op_type in _JOINED and len(values.intersection(reader.input)) == 1:
            for name in set(reader.input) - values:
                _refuse_other_scales(r, node, found[0], name)
            results[reader.output[0]] = found[0], found[1] or not integers.issuperset(set(reader.input) - values)
        elif reader.op_type == "QuantizeLinear" and found[1]:
            product = f"{found[0].name or found[0].output[0]} ({found[0].op_type})"
            problem = f"gives steps to {product}, whose weights or bias are floats, and which gives steps again"
            fix = "onnxruntime rounds these floats, too: store them as integers, and give their DequantizeLinear"
            raise InputError(problem, fix=fix)


def _refuse_other_scales(r: OnnxReader, node: onnx.NodeProto, product: onnx.NodeProto, bias: str) -> None:
    """Refuse a 32-bit bias whose scale is not the product of both scales, which onnxruntime uses (N25).

    onnxruntime includes alpha in that product.
    """
    makers = {name: maker for maker in r.graph.node for name in maker.output}

    def stored(name: str) -> onnx.NodeProto | None:
        maker = makers.get(name)
        while maker is not None and maker.op_type in _LAID_OUT:
            maker = makers.get(maker.input[0])
        return maker if maker is not None and maker.op_type == "DequantizeLinear" else None

    def number(one: onnx.NodeProto, place: int) -> np.ndarray:
        name = one.input[place] if place < len(one.input) else ""
        maker = makers.get(name)
        if maker is not None and maker.op_type == "Constant" and maker.attribute[0].name == "value":
            return r.stored.array(maker.attribute[0].t, f"node {maker.name} (Constant)")
        return np.zeros(()) if not name else r.constants.get(name, np.full((), np.nan))

    integers, weights = stored(bias), stored(product.input[1])
    if integers is None or weights is None or number(integers, 0).dtype not in (np.int32, np.float64):
        return
    expected = (number(node, 1).astype(np.float64) * number(weights, 1)).astype(np.float32).reshape(-1)
    scale = number(integers, 1).reshape(-1)
    alike = scale.size in (1, expected.size) or expected.size == 1
    factors = [a.f for a in product.attribute if a.name in ("alpha", "beta")]
    if not (alike and (scale == expected).all()) or number(integers, 2).any() or factors.count(1.0) < len(factors):
        problem = (
            f"gives steps to {product.name or product.output[0]} ({product.op_type}), whose bias has another scale"
        )
        raise InputError(problem, fix="onnxruntime takes the scale of the steps times that of the weights: store that")


def _refuse_products(r: OnnxReader, node: onnx.NodeProto) -> None:
    """Refuse a matrix of stored bytes times float32 values: onnxruntime rounds these to 8 bits, too.

    It does so for MatMul, and for Gemm without transB (N25). If the values are quantised themselves, it follows the
    file.
    """
    names, stepped = set(node.output), set[str]()
    for reader in without_choices(r.graph):
        if reader.op_type == "DequantizeLinear" and reader.input[0] not in r.constants:
            stepped.update(reader.output)
        read = names.intersection(reader.input)
        if not read:
            continue
        if reader.op_type in _LAID_OUT:
            names.update(reader.output)
        straight = reader.op_type == "Gemm" and any(a.name == "transB" and a.i for a in reader.attribute)
        straight = straight and not read.isdisjoint(node.output)
        if reader.op_type in ("MatMul", "Gemm") and not straight and stepped.isdisjoint(reader.input[:2]):
            problem = f"gives 8-bit weights to {reader.op_type} {reader.name or reader.output[0]}"
            fix = "onnxruntime rounds what they multiply to 8 bits, too: store these weights as floats"
            raise InputError(problem, fix=fix)


def _refuse_tables(r: OnnxReader, node: onnx.NodeProto) -> None:
    """Refuse a Softmax between 8-bit values: onnxruntime takes its exponentials from an integer table (N25)."""
    makers = {name: maker for maker in r.graph.node for name in maker.output}

    def behind(name: str) -> onnx.NodeProto | None:
        maker = makers.get(name)
        while maker is not None and maker.op_type in (*_LAID_OUT, "Dropout"):
            maker = makers.get(maker.input[0])
        return maker

    softmax = behind(node.input[0])
    if softmax is None or softmax.op_type != "Softmax":
        return
    before = behind(softmax.input[0])
    if before is not None and before.op_type == "DequantizeLinear":
        fix = "onnxruntime computes it with a table of integers: leave the values before or behind it in floats"
        raise InputError(f"rounds {softmax.name or softmax.output[0]} (Softmax) of steps to 8 bits", fix=fix)


def _refuse_signed_operands(r: OnnxReader, node: onnx.NodeProto) -> None:
    """Refuse a product whose second operand is rounded to signed bytes by ``node``, if its sums may saturate (N25)."""
    steps = set(node.output)
    for reader in r.graph.node:
        if reader.op_type in _PRODUCTS and reader.input[1] in steps:
            refuse_saturating_operand(reader)
        elif reader.op_type in ("DequantizeLinear", *_PASSED) and not steps.isdisjoint(reader.input):
            steps.update(reader.output)


def quantize(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    """Read QuantizeLinear, which rounds a value to steps; its readers must dequantise it."""
    a.ignore("axis", "saturate")
    a.only("block_size", 0)
    x, scale, zero = r.value(node), r.weight(node, 1), r.constant(node, 2)
    step = _scalar(scale)
    named = a.get("output_dtype", 0)
    kind = number_type(named) if named else np.dtype(np.uint8) if zero is None else zero.dtype
    if zero is not None and zero.dtype != kind:
        raise InputError(f"attribute output_dtype = {kind}, its zero has type {zero.dtype}", fix="give one of them")
    if kind not in _RANGES or not LEAST_DIVISOR < step < 1.0 / LEAST_DIVISOR or (zero is not None and zero.size != 1):
        raise InputError(f"scale {step:g} of type {kind}", fix="use 8 or 16 bits and one positive scale")
    if kind.itemsize == 1:
        _refuse_tables(r, node)
    if kind == np.int8:
        _refuse_signed_operands(r, node)
    offset = 0 if zero is None else int(np.reshape(zero, -1)[0])
    low, high = (step * (end - offset) for end in _RANGES[kind])
    index = r.builder.curve(x.index, Quantised, least=low, most=high, step=step)
    r.result(node, index, x.whole)
    r.quantised[node.output[0]] = step, offset


def _scalar(scale: np.ndarray) -> float:
    if scale.size != 1 or scale.dtype.kind != "f":
        raise InputError(f"scales of shape {list(scale.shape)}", fix="quantise values with one scale")
    return float(scale.reshape(-1)[0])


def _along(value: np.ndarray, rank: int, axis: int) -> np.ndarray:
    """Return one number for each place along an axis, broadcastable to ``rank`` axes; a single number as it is."""
    if value.size == 1:
        return value.reshape(())
    if value.ndim != 1 or not -rank <= axis < rank:
        raise InputError(f"scales of shape {list(value.shape)}", fix="give one, or one for each place along an axis")
    return value.reshape([-1 if k == axis % rank else 1 for k in range(rank)])
