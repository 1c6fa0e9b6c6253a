"""Rules of ONNX operators on windows: convolution and pooling."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import onnx

from ns_abstract.io.errors import InputError
from ns_abstract.verify.network.graph import item
from ns_abstract.verify.network.onnx_arithmetic import intervals_of
from ns_abstract.verify.network.onnx_graph import Attributes, OnnxReader, Rule

#: The operator set since which a mean of a window counts its pads, and not what lies past them.
_COUNTED_PADS = 19


def _ints(a: Attributes, name: str, line: bool, default: int | None = None, beside: int = 1) -> Any:
    """Return two numbers of a window operator; for an operator on a line the second one is ``beside``."""
    values = a.ints(name, 1 if line else 2, default)
    return (*values, beside) if line and values is not None else values


def _pads(
    a: Attributes, size: Sequence[int], kernel: Any, stride: Any, dilation: Any, line: bool
) -> tuple[int, int, int, int]:
    """Return the pads top, left, bottom, right of a window operator."""
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
    """Return the node as a map of rows and columns, and whether it was a line [C, L], which becomes [C, L, 1]."""
    shape = r.builder.shape(x)
    if len(shape) == 2:
        return r.builder.reshape(x, (*shape, 1)), True
    return x, False


def _mapped(r: OnnxReader, node: onnx.NodeProto, index: int, line: bool) -> None:
    """Set the output of a window operator, as a line again if its input was one."""
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
    r.builder.doubt(index, intervals_of(r.doubts(node, 1), weight.shape), intervals_of(r.doubts(node, 2)))
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
    if counted and any(more) and r.opset < _COUNTED_PADS:
        raise InputError(
            "attributes ceil_mode = 1, count_include_pad = 1: programs divide by different numbers",
            fix=f"export with operator set {_COUNTED_PADS} or later",
        )
    _mapped(r, node, r.builder.average_windows(x, kernel, stride, pads, more, counted), line)


def _max_pool(r: OnnxReader, node: onnx.NodeProto, a: Attributes) -> None:
    x, kernel, stride, dilation, pads, more, line = _pool_window(r, node, a)
    a.ignore("storage_order")  # of the second output, which is refused where it is read
    pads = (*pads[:2], pads[2] + more[0], pads[3] + more[1])
    _mapped(r, node, r.builder.max_pool(x, kernel, stride, dilation, pads), line)


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
    r.builder.doubt(index, intervals_of(r.doubts(node, 1), weight.shape), intervals_of(r.doubts(node, 2)))
    _mapped(r, node, index, line)


WINDOW_RULES: dict[str, Rule] = {
    "AveragePool": _average_pool,
    "Conv": _conv,
    "ConvTranspose": _conv_transpose,
    "MaxPool": _max_pool,
}
