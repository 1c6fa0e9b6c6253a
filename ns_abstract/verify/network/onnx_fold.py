"""Folds constants of an ONNX graph (shapes, masks, indices) with the reference operators of `onnx`."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import onnx
from onnx import TensorProto, helper

from ns_abstract.io.errors import InputError

#: Numbers that a result may have.
_LARGEST = 1 << 24
#: Operators that move numbers of their arguments and compute none.
MOVES = frozenset(
    (
        *("Concat", "Expand", "Flatten", "Gather", "Identity", "Reshape", "ScatterElements", "ScatterND", "Slice"),
        *("Split", "Squeeze", "Tile", "Transpose", "Trilu", "Unsqueeze", "Where"),
    )
)
#: Nothing is rounded, and results grow with arguments.
GROWS = frozenset(("Clip", "Max", "Min", "ReduceMax", "ReduceMin", "Relu"))
#: Results change at once.
STEPS = frozenset(("Ceil", "Floor", "Round", "Sign"))
#: Functions of a library.
LIBRARIES = frozenset(("Erf", "Exp", "Log", "Sigmoid", "Tanh"))
#: Functions of shapes, which no rounding changes.
SHAPES = frozenset(("ConstantOfShape", "EyeLike", "Shape", "Size"))
#: Comparisons, and what joins them.
COMPARES = frozenset(("And", "Equal", "Greater", "GreaterOrEqual", "Less", "LessOrEqual", "Not", "Or", "Xor"))
_COMPUTES = frozenset(
    (
        *("Abs", "Add", "Cast", "CastLike", "Cos", "Div", "MatMul", "Mod", "Mul", "Neg", "Pow", "Range", "Reciprocal"),
        *("ReduceL1", "ReduceL2", "ReduceMean", "ReduceProd", "ReduceSum", "Sin", "Sqrt", "Sub"),
    )
)
#: Operators whose results on constants are computed when the file is read.
FOLDED = MOVES | GROWS | STEPS | LIBRARIES | SHAPES | COMPARES | _COMPUTES
#: Results are no larger than the operands spread over each other.
_SPREAD = (COMPARES - {"Not"}) | {"Add", "Div", "Expand", "Max", "Min", "Mod", "Mul", "Pow", "Sub", "Where"}


def _size(kind: str, node: onnx.NodeProto, values: Sequence[np.ndarray]) -> float:
    """Return an upper bound of the count of numbers of a node's result."""
    if kind in _SPREAD:
        shapes = [v.shape for v in values]
        if kind == "Expand":
            shapes[1] = tuple(int(v) for v in values[1].reshape(-1))
            if any(v < 0 for v in shapes[1]) or math.prod(shapes[1]) > _LARGEST:
                return math.inf
        if math.prod(max(1, v.size) for v in values) <= _LARGEST and kind != "Expand":
            return 0.0
        return float(math.prod(np.broadcast_shapes(*shapes)))
    if kind == "ConstantOfShape":
        return float(math.prod(float(v) for v in values[0].reshape(-1)))
    if kind == "Tile":
        return float(values[0].size) * math.prod(float(v) for v in values[1].reshape(-1))
    if kind == "Range":
        start, limit, delta = (float(v.reshape(-1)[0]) for v in values)
        return abs((limit - start) / delta) if delta else math.inf
    if kind == "Gather":
        axis = next((a.i for a in node.attribute if a.name == "axis"), 0)
        return values[0].size / max(1, values[0].shape[axis]) * values[1].size
    if kind == "MatMul":
        return (
            float(math.prod(values[0].shape[:-1])) * float(math.prod(values[1].shape)) / max(1, values[1].shape[-2:][0])
        )
    return float(sum(v.size for v in values))


def _refuse_unlike(node: onnx.NodeProto, values: Sequence[np.ndarray]) -> None:
    """Raise InputError for nodes that the reference operators compute otherwise than the format says."""
    fix = "fold constants when exporting"
    for attribute in node.attribute:
        if attribute.name == "reduction" and attribute.s not in (b"", b"none"):
            # the reference has not all of them, and sums of floats are rounded
            raise InputError(f"attribute reduction = {attribute.s.decode(errors='replace')} is not supported", fix=fix)
        sizes_taken = node.op_type in ("ReduceL1", "ReduceL2") and (len(values) < 2 or not values[1].size)
        if attribute.name == "noop_with_empty_axes" and attribute.i and sizes_taken:
            raise InputError("attribute noop_with_empty_axes = 1: programs differ", fix="name the axes")
    if node.op_type == "Slice" and len(values) == 5:
        starts, axes, steps = (values[k].reshape(-1) for k in (1, 3, 4))
        rank = values[0].ndim
        sizes = np.array([values[0].shape[k] if -rank <= k < rank else 0 for k in axes.tolist()])
        if starts.shape == sizes.shape == steps.shape and ((steps < 0) & (starts < -sizes)).any():
            # the format begins with the first number, the reference with none
            raise InputError(f"starts {starts.tolist()} with steps {steps.tolist()} are not supported", fix=fix)


def fold(node: onnx.NodeProto, values: Sequence[np.ndarray | None], opset: int) -> list[np.ndarray]:
    """Return the results of a node of constants (None: an absent input).

    Raises:
        InputError: The results would be too large, or cannot be computed.
    """
    from onnx.reference import ReferenceEvaluator

    present = [v for v in values if v is not None]
    _refuse_unlike(node, present)
    try:
        size = _size(node.op_type, node, present)
    except (ValueError, IndexError, ZeroDivisionError) as error:
        raise InputError(f"cannot be computed ({error})", fix="check its constants") from None
    if not 0.0 <= size <= _LARGEST:
        raise InputError(f"makes a constant of {size:,.0f} numbers", fix=f"at most {_LARGEST:,} are made")
    names = [name for name in node.input if name]
    kinds = [helper.np_dtype_to_tensor_dtype(v.dtype) for v in present]
    inputs = [helper.make_tensor_value_info(n, k, None) for n, k in dict(zip(names, kinds, strict=True)).items()]
    outputs = [helper.make_tensor_value_info(n, TensorProto.UNDEFINED, None) for n in node.output if n]
    model = helper.make_model(
        helper.make_graph([node], "constants", inputs, outputs), opset_imports=[helper.make_opsetid("", opset)]
    )
    try:
        with np.errstate(all="ignore"):
            results = ReferenceEvaluator(model).run(None, dict(zip(names, present, strict=True)))
    except Exception as error:  # the reference operators raise whatever they meet
        raise InputError(f"cannot be computed ({error})", fix="check its constants") from None
    return [np.asarray(v) for v in results]  # type: ignore[union-attr]
