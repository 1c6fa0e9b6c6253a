"""Products of bytes in onnxruntime, whose sums saturate on processors without VNNI (docs/dev/design.md, N25)."""

from __future__ import annotations

from functools import cache

import numpy as np
import onnx
import onnxruntime
from onnx import TensorProto, helper, numpy_helper

from ns_abstract.io.errors import InputError

#: Largest magnitude of signed bytes of which two, times 255, add up to a number of 16 bits: 2 * 64 * 255 < 2**15.
_EXACT_UP_TO = 64
_FIX = "quantise with reduce_range (weights of 7 bits) or with uint8 weights, or certify on a processor with VNNI"


@cache
def bytes_are_summed_exactly() -> bool:
    """Whether onnxruntime adds products of unsigned and signed bytes in 32 bits on this processor.

    Where it does not, it adds pairs of them in 16 bits, which saturate.
    """
    ends = (("x", TensorProto.UINT8, [1, 4]), ("y", TensorProto.INT32, [1, 1]))
    given, result = (helper.make_tensor_value_info(*end) for end in ends)
    weights = numpy_helper.from_array(np.full((4, 1), 127, np.int8), "w")
    product = helper.make_node("MatMulInteger", ["x", "w"], ["y"])
    graph = helper.make_graph([product], "bytes", [given], [result], [weights])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    total = session.run(None, {"x": np.full((1, 4), 255, np.uint8)})[0]
    return bool(np.asarray(total).item() == 4 * 255 * 127)


def refuse_saturating_weights(graph: onnx.GraphProto, stored: np.ndarray) -> None:
    """Raise InputError if values that are rounded to steps may multiply stored signed bytes whose sums saturate."""
    stepped = any(node.op_type == "QuantizeLinear" for node in graph.node)
    wide = stored.dtype == np.int8 and np.abs(stored.astype(np.int16)).max(initial=0) > _EXACT_UP_TO
    if stepped and wide and not bytes_are_summed_exactly():
        problem = f"has int8 weights beyond {_EXACT_UP_TO}, whose products saturate in onnxruntime on this processor"
        raise InputError(problem, fix=_FIX)


def refuse_saturating_operand(product: onnx.NodeProto) -> None:
    """Raise InputError if the sums of a product may saturate whose second operand is computed in signed bytes."""
    if not bytes_are_summed_exactly():
        name = f"{product.op_type} {product.name or product.output[0]}"
        problem = f"gives int8 values to {name} as its second operand, which saturate in onnxruntime on this processor"
        raise InputError(problem, fix="quantise them as uint8, or certify on a processor with VNNI")
