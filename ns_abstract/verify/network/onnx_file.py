"""Reading an ONNX file into a network. Nothing in the file is executed; what is not understood is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from google.protobuf.message import DecodeError
from onnx import numpy_helper

from ns_abstract.errors import InputError
from ns_abstract.verify.network.build import Builder
from ns_abstract.verify.network.graph import Network, item

#: Numbers that one stored constant may have.
_LARGEST = 1 << 28
#: Operator sets whose meaning is known here.
_OPSETS = range(7, 24)


def read_onnx(path: Path) -> Network:
    """The network in an ONNX file.

    Raises:
        InputError: The file cannot be read, or uses what is not supported; names node, operator and attribute.
    """
    model = parse_model(path)
    opset = _opset(model, path)
    reader = _Reader(path, model.graph, opset)
    return reader.network()


def parse_model(path: Path) -> onnx.ModelProto:
    """The messages of an ONNX file, without data that lie in other files.

    Raises:
        InputError: The file cannot be read.
    """
    try:
        model = onnx.load(str(path), load_external_data=False)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}", file=path, fix="check the path") from None
    except (DecodeError, ValueError, TypeError) as error:
        raise InputError(
            f"is not an ONNX model ({str(error) or type(error).__name__})", file=path, fix="export the network again"
        ) from None
    if not model.graph.node or not model.graph.output:
        raise InputError("holds no network", file=path, field="graph", fix="export the network again")
    return model


def _opset(model: onnx.ModelProto, path: Path) -> int:
    version = 0
    for entry in model.opset_import:
        if entry.domain in ("", "ai.onnx"):
            version = entry.version
    if version not in _OPSETS:
        raise InputError(
            f"operator set {version} is not supported",
            file=path,
            field="opset_import",
            fix=f"export with an operator set from {_OPSETS[0]} to {_OPSETS[-1]}",
        )
    return version


class _Reader:
    """Turns one graph's nodes into layers."""

    def __init__(self, path: Path, graph: onnx.GraphProto, opset: int) -> None:
        self.path, self.graph, self.opset = path, graph, opset
        self.constants: dict[str, np.ndarray] = {}
        for tensor in graph.initializer:
            self.constants[tensor.name] = self._array(tensor, f"initializer {tensor.name}")
        if graph.sparse_initializer:
            raise InputError("sparse constants are not supported", file=path, fix="store them as dense tensors")
        self.input_name, shape = self._input()
        self.builder = Builder(path, shape)
        #: node index of every value
        self.values: dict[str, int] = {self.input_name: 0}

    def _fail(self, node: onnx.NodeProto, problem: str, fix: str | None = None) -> InputError:
        name = node.name or (node.output[0] if node.output else "")
        return InputError(problem, file=self.path, field=f"node {name} ({node.op_type})", fix=fix)

    def _array(self, tensor: onnx.TensorProto, field: str) -> np.ndarray:
        """A stored constant, from the file or from a file beside it."""
        count = 1
        for size in tensor.dims:
            if size < 0:
                raise InputError(f"has a negative size {size}", file=self.path, field=field)
            count *= size
        if count > _LARGEST:
            raise InputError(
                f"has {count:,} numbers", file=self.path, field=field, fix=f"at most {_LARGEST:,} are read"
            )
        if tensor.data_location == onnx.TensorProto.EXTERNAL:
            tensor = self._external(tensor, field)
        try:
            array = numpy_helper.to_array(tensor)
        except Exception as error:  # numpy_helper raises whatever it meets
            raise InputError(f"cannot be read ({error})", file=self.path, field=field) from None
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise InputError("holds numbers that are not finite", file=self.path, field=field, fix="train again")
        if array.dtype.kind not in "fiub":
            raise InputError(f"has type {array.dtype}", file=self.path, field=field, fix="use float32")
        return array

    def _external(self, tensor: onnx.TensorProto, field: str) -> onnx.TensorProto:
        """The tensor with its data read from a file that must lie beside the model."""
        where = {entry.key: entry.value for entry in tensor.external_data}
        folder = self.path.resolve().parent
        location = where.get("location", "")
        target = (folder / location).resolve()
        if not location or Path(location).is_absolute() or not target.is_relative_to(folder) or target == folder:
            raise InputError(
                f"points to {location!r}, outside the model's folder",
                file=self.path,
                field=field,
                fix="put the data beside the model",
            )
        try:
            start, length = int(where.get("offset", 0)), int(where.get("length", -1))
            if start < 0 or length < -1:
                raise ValueError("negative offset or length")
            with target.open("rb") as stream:
                size = target.stat().st_size
                stream.seek(start)
                data = stream.read(min(length, size) if length >= 0 else min(size, 8 * _LARGEST))
        except (OSError, ValueError) as error:
            raise InputError(f"cannot read {location!r} ({error})", file=self.path, field=field) from None
        inside = onnx.TensorProto()
        inside.CopyFrom(tensor)
        inside.data_location = onnx.TensorProto.DEFAULT
        del inside.external_data[:]
        inside.raw_data = data
        return inside

    def _input(self) -> tuple[str, tuple[int, ...]]:
        inputs = [value for value in self.graph.input if value.name not in self.constants]
        if len(inputs) != 1:
            raise InputError(f"has {len(inputs)} inputs", file=self.path, field="graph.input", fix="one image expected")
        value = inputs[0]
        field = f"input {value.name}"
        kind = value.type.tensor_type
        if kind.elem_type not in (onnx.TensorProto.FLOAT, onnx.TensorProto.DOUBLE):
            raise InputError("is not a float32 tensor", file=self.path, field=field, fix="export with a float input")
        sizes = [d.dim_value if d.HasField("dim_value") else 0 for d in kind.shape.dim]
        if len(sizes) < 2 or sizes[0] not in (0, 1) or min(sizes[1:]) < 1:
            shown = [d.dim_value if d.HasField("dim_value") else d.dim_param or "?" for d in kind.shape.dim]
            raise InputError(
                f"has shape {shown}",
                file=self.path,
                field=field,
                fix="export with a free batch or a batch of 1 and all other sizes fixed",
            )
        return value.name, tuple(sizes[1:])

    def network(self) -> Network:
        if len(self.graph.output) != 1:
            raise InputError(
                f"has {len(self.graph.output)} outputs", file=self.path, field="graph.output", fix="one expected"
            )
        for node in self.graph.node:
            if node.domain not in ("", "ai.onnx"):
                raise self._fail(node, f"operator of domain {node.domain} is not supported")
            rule = _RULES.get(node.op_type)
            if rule is None:
                fix = "leave it out of the exported network" if node.op_type == "Softmax" else "use a supported layer"
                raise self._fail(node, "operator is not supported", f"{fix}: {', '.join(sorted(_RULES))}")
            attributes = _Attributes(self, node)
            try:
                rule(self, node, attributes)
            except InputError as error:
                if error.field is not None:
                    raise
                raise self._fail(node, error.problem, error.fix) from None
            attributes.done()
        name = self.graph.output[0].name
        if name not in self.values:
            raise InputError(f"output {name!r} does not depend on the image", file=self.path, field="graph.output")
        return self.builder.network(self.values[name])

    # what rules use

    def source(self, node: onnx.NodeProto, position: int = 0) -> int:
        """Index of the node that makes input ``position``."""
        name = node.input[position] if position < len(node.input) else ""
        if name in self.values:
            return self.values[name]
        if name in self.constants:
            raise InputError(f"input {position} ({name}) is a constant", fix="it must depend on the image")
        raise InputError(f"input {position} ({name!r}) is not known", fix="export the network again")

    def constant(self, node: onnx.NodeProto, position: int, default: Any = None) -> Any:
        """Constant input ``position``; ``default`` if it is absent."""
        name = node.input[position] if position < len(node.input) else ""
        if not name:
            return default
        if name not in self.constants:
            raise InputError(f"input {position} ({name}) is not a constant", fix="fold constants when exporting")
        return self.constants[name]

    def weight(self, node: onnx.NodeProto, position: int) -> np.ndarray:
        found = self.constant(node, position)
        if found is None:
            raise InputError(f"input {position} is missing", fix="export the network again")
        return found

    def result(self, node: onnx.NodeProto, index: int) -> None:
        """Name the node's only output."""
        if any(node.output[1:]):
            raise InputError("has several outputs", fix="only the first is supported")
        self.builder.name(index, node.name or node.output[0], node.op_type)
        self.values[node.output[0]] = index

    def fold(self, node: onnx.NodeProto, value: np.ndarray) -> None:
        self.constants[node.output[0]] = value


class _Attributes:
    """A node's attributes, each of which a rule must ask for."""

    def __init__(self, reader: _Reader, node: onnx.NodeProto) -> None:
        self.reader, self.node = reader, node
        self.found = {a.name: a for a in node.attribute}
        self.asked: set[str] = set()

    def get(self, name: str, default: Any = None) -> Any:
        self.asked.add(name)
        if name not in self.found:
            return default
        value = onnx.helper.get_attribute_value(self.found[name])
        return value.decode() if isinstance(value, bytes) else value

    def ints(self, name: str, count: int, default: int | None = None) -> tuple[int, ...] | None:
        value = self.get(name)
        if value is None:
            return None if default is None else (default,) * count
        if len(value) != count:
            raise InputError(f"attribute {name} = {list(value)}", fix=f"{count} numbers expected: two dimensions")
        return tuple(int(v) for v in value)

    def only(self, name: str, *allowed: Any) -> None:
        """The attribute may be absent or one of ``allowed``."""
        value = self.get(name)
        if value is not None and value not in allowed:
            raise InputError(f"attribute {name} = {value} is not supported", fix=f"only {allowed[0]} is")

    def ignore(self, *names: str) -> None:
        """Attributes that do not matter."""
        self.asked.update(names)

    def done(self) -> None:
        for name in self.found:
            if name not in self.asked:
                raise self.reader._fail(self.node, f"attribute {name} is not supported", "export without it")


Rule = Callable[[_Reader, onnx.NodeProto, _Attributes], None]


def _pads(a: _Attributes, size: tuple[int, int], kernel: Any, stride: Any, dilation: Any) -> tuple[int, int, int, int]:
    """Pads top, left, bottom, right of a window operator."""
    auto = a.get("auto_pad", "NOTSET")
    explicit = a.ints("pads", 4, 0)
    assert explicit is not None
    if auto == "NOTSET":
        return explicit  # type: ignore[return-value]
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


def _conv(r: _Reader, node: onnx.NodeProto, a: _Attributes) -> None:
    x, weight, bias = r.source(node), r.weight(node, 1), r.constant(node, 2)
    shape = r.builder.shape(x)
    if weight.ndim != 4 or len(shape) != 3:
        raise InputError(
            f"weights {item(weight.shape)} on {item(shape)}", fix="only two-dimensional convolutions are read"
        )
    kernel = a.ints("kernel_shape", 2) or weight.shape[2:]
    if tuple(kernel) != weight.shape[2:]:
        raise InputError(f"attribute kernel_shape = {list(kernel)}, weights are {item(weight.shape)}")
    stride, dilation = a.ints("strides", 2, 1) or (1, 1), a.ints("dilations", 2, 1) or (1, 1)
    pads = _pads(a, shape[1:], kernel, stride, dilation)
    r.result(node, r.builder.convolution(x, weight, bias, stride, dilation, pads, int(a.get("group", 1))))


def _pool_window(r: _Reader, node: onnx.NodeProto, a: _Attributes):
    x = r.source(node)
    shape = r.builder.shape(x)
    if len(shape) != 3:
        raise InputError(f"input {item(shape)}", fix="only two-dimensional pooling is read")
    kernel = a.ints("kernel_shape", 2)
    if kernel is None:
        raise InputError("attribute kernel_shape is missing")
    stride, dilation = a.ints("strides", 2, 1) or (1, 1), a.ints("dilations", 2, 1) or (1, 1)
    pads = _pads(a, shape[1:], kernel, stride, dilation)
    r.builder.check_window(x, kernel, stride, dilation, pads, bool(a.get("ceil_mode", 0)))
    return x, kernel, stride, dilation, pads


def _average_pool(r: _Reader, node: onnx.NodeProto, a: _Attributes) -> None:
    x, kernel, stride, dilation, pads = _pool_window(r, node, a)
    if dilation != (1, 1):
        raise InputError(f"attribute dilations = {list(dilation)} is not supported", fix="only 1 is")
    counted = bool(a.get("count_include_pad", 0))
    r.result(node, r.builder.average_pool(x, kernel, stride, pads, counted))


def _max_pool(r: _Reader, node: onnx.NodeProto, a: _Attributes) -> None:
    x, kernel, stride, dilation, pads = _pool_window(r, node, a)
    a.ignore("storage_order")  # of the second output, which is refused
    r.result(node, r.builder.max_pool(x, kernel, stride, dilation, pads))


def _global_average(r: _Reader, node: onnx.NodeProto, a: _Attributes) -> None:
    x = r.source(node)
    shape = r.builder.shape(x)
    if len(shape) != 3:
        raise InputError(f"input {item(shape)}", fix="only two-dimensional pooling is read")
    r.result(node, r.builder.average_pool(x, shape[1:], (1, 1), (0, 0, 0, 0), True))


def _gemm(r: _Reader, node: onnx.NodeProto, a: _Attributes) -> None:
    x, weight, bias = r.source(node), r.weight(node, 1), r.constant(node, 2)
    a.only("transA", 0)
    alpha, beta = float(a.get("alpha", 1.0)), float(a.get("beta", 1.0))
    if weight.ndim != 2:
        raise InputError(f"weights {item(weight.shape)}", fix="a matrix expected")
    matrix = weight.astype(np.float64) if a.get("transB", 0) else weight.astype(np.float64).T
    r.result(node, r.builder.matrix(x, alpha * matrix, None if bias is None else beta * bias.astype(np.float64)))


def _matmul(r: _Reader, node: onnx.NodeProto, a: _Attributes) -> None:
    x, weight = r.source(node), r.weight(node, 1)
    if weight.ndim != 2:
        raise InputError(f"weights {item(weight.shape)}", fix="a matrix expected")
    r.result(node, r.builder.matrix(x, weight.astype(np.float64).T, None))


def _batch_norm(r: _Reader, node: onnx.NodeProto, a: _Attributes) -> None:
    x = r.source(node)
    a.only("training_mode", 0)
    a.only("spatial", 1)
    a.ignore("momentum")
    scale, shift, mean, variance = (r.weight(node, k) for k in range(1, 5))
    r.result(node, r.builder.batch_norm(x, scale, shift, mean, variance, float(a.get("epsilon", 1e-5))))


def _binary(r: _Reader, node: onnx.NodeProto, a: _Attributes) -> None:
    kind = node.op_type
    names = [node.input[k] if k < len(node.input) else "" for k in range(2)]
    images = [name in r.values for name in names]
    if all(images):
        if kind not in ("Add", "Sub"):
            raise InputError("of two values that both depend on the image is not supported", fix="only Add and Sub are")
        index = r.builder.sum((r.source(node, 0), r.source(node, 1)), (1, 1 if kind == "Add" else -1))
        r.result(node, index)
        return
    x = r.source(node, 0 if images[0] else 1)
    constant = r.weight(node, 1 if images[0] else 0).astype(np.float64)
    if kind == "Mul":
        factor, offset = constant, None
    elif kind == "Div":
        if not images[0]:
            raise InputError("by a value that depends on the image is not supported")
        if not constant.all():
            raise InputError("divides by zero", fix="check the constant")
        factor, offset = 1.0 / constant, None
    elif kind == "Add":
        factor, offset = np.ones(()), constant
    else:
        factor = np.ones(()) if images[0] else -np.ones(())
        offset = -constant if images[0] else constant
    r.result(node, r.builder.scale(x, factor, offset))


def _neg(r: _Reader, node: onnx.NodeProto, a: _Attributes) -> None:
    r.result(node, r.builder.scale(r.source(node), -np.ones(()), None))


def _relu(r: _Reader, node: onnx.NodeProto, a: _Attributes) -> None:
    r.result(node, r.builder.leaky_relu(r.source(node), 0.0))


def _leaky_relu(r: _Reader, node: onnx.NodeProto, a: _Attributes) -> None:
    r.result(node, r.builder.leaky_relu(r.source(node), float(a.get("alpha", 0.01))))


def _sigmoid(r: _Reader, node: onnx.NodeProto, a: _Attributes) -> None:
    r.result(node, r.builder.sigmoid(r.source(node)))


def _tanh(r: _Reader, node: onnx.NodeProto, a: _Attributes) -> None:
    r.result(node, r.builder.tanh(r.source(node)))


def _identity(r: _Reader, node: onnx.NodeProto, a: _Attributes) -> None:
    if node.input[0] in r.constants:
        r.fold(node, r.constants[node.input[0]])
    else:
        r.values[node.output[0]] = r.source(node)


def _dropout(r: _Reader, node: onnx.NodeProto, a: _Attributes) -> None:
    a.ignore("ratio", "seed")
    a.only("is_test", 1)
    training = r.constant(node, 2)
    if training is not None and bool(np.any(training)):
        raise InputError("is in training mode", fix="export the network in evaluation mode")
    if any(node.output[1:]):
        raise InputError("has a mask as second output", fix="export the network in evaluation mode")
    r.values[node.output[0]] = r.source(node)


def _constant(r: _Reader, node: onnx.NodeProto, a: _Attributes) -> None:
    value = a.get("value")
    if value is not None:
        r.fold(node, r._array(value, f"node {node.name} (Constant)"))
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


def _flatten(r: _Reader, node: onnx.NodeProto, a: _Attributes) -> None:
    x = r.source(node)
    axis = int(a.get("axis", 1))
    rank = 1 + len(r.builder.shape(x))
    if axis not in (1, 1 - rank):
        raise InputError(f"attribute axis = {axis} is not supported", fix="only 1 is: the batch stays")
    r.result(node, r.builder.reshape(x, (int(np.prod(r.builder.shape(x))),)))


def _reshape(r: _Reader, node: onnx.NodeProto, a: _Attributes) -> None:
    x = r.source(node)
    a.only("allowzero", 0)
    shape = r.builder.shape(x)
    target = [int(v) for v in np.atleast_1d(r.weight(node, 1))]
    whole = (1, *shape)
    for k, size in enumerate(target):
        if size == 0:
            if k >= len(whole):
                raise InputError(f"shape {target} copies a size that is not there")
            target[k] = whole[k]
    total = int(np.prod(shape))
    rest = int(np.prod([v for v in target if v != -1], dtype=np.int64))
    if target.count(-1) > 1 or rest <= 0 or total % rest:
        raise InputError(f"shape {target} of {total} numbers")
    found = tuple(total // rest if v == -1 else v for v in target)
    if int(np.prod(found)) != total or found[:1] != (1,):
        raise InputError(f"shape {target} of an item {item(shape)} moves the batch", fix="keep the batch first")
    r.result(node, r.builder.reshape(x, found[1:]))


def _axes(r: _Reader, node: onnx.NodeProto, a: _Attributes, rank: int) -> list[int]:
    axes = a.get("axes")
    if axes is None:
        axes = r.constant(node, 1)
    if axes is None:
        raise InputError("axes are missing", fix="name them")
    found = sorted(int(v) % rank if -rank <= int(v) < rank else -1 for v in np.atleast_1d(axes))
    if not found or found[0] < 1 or len(set(found)) != len(found):
        raise InputError(f"axes {list(axes)} are not supported", fix="the batch, axis 0, must stay")
    return found


def _squeeze(r: _Reader, node: onnx.NodeProto, a: _Attributes) -> None:
    x = r.source(node)
    shape = (1, *r.builder.shape(x))
    axes = _axes(r, node, a, len(shape))
    if any(shape[k] != 1 for k in axes):
        raise InputError(f"axes {axes} of {item(shape)} are not 1")
    r.result(node, r.builder.reshape(x, tuple(v for k, v in enumerate(shape) if k not in axes)[1:]))


def _unsqueeze(r: _Reader, node: onnx.NodeProto, a: _Attributes) -> None:
    x = r.source(node)
    shape = list(r.builder.shape(x))
    count = (
        1
        if a.get("axes") is None and r.constant(node, 1) is None
        else len(np.atleast_1d(a.get("axes") or r.constant(node, 1)))
    )
    for k in _axes(r, node, a, 1 + len(shape) + count):
        shape.insert(k - 1, 1)
    r.result(node, r.builder.reshape(x, tuple(shape)))


def _transpose(r: _Reader, node: onnx.NodeProto, a: _Attributes) -> None:
    x = r.source(node)
    rank = 1 + len(r.builder.shape(x))
    order = [int(v) for v in a.get("perm", range(rank - 1, -1, -1))]
    if sorted(order) != list(range(rank)) or order[0] != 0:
        raise InputError(f"attribute perm = {order} is not supported", fix="the batch must stay first")
    r.result(node, r.builder.transpose(x, [v - 1 for v in order[1:]]))


def _pad(r: _Reader, node: onnx.NodeProto, a: _Attributes) -> None:
    x = r.source(node)
    shape = r.builder.shape(x)
    rank = 1 + len(shape)
    mode = a.get("mode", "constant")
    pads = a.get("pads")
    if pads is None:
        pads = r.weight(node, 1)
    value = a.get("value")
    if value is None:
        value = r.constant(node, 2, 0.0)
    if any(node.input[3:]):
        raise InputError("axes as a fourth input are not supported", fix="give pads of every axis")
    pads = [int(v) for v in np.atleast_1d(pads)]
    if len(pads) != 2 * rank or pads[0] or pads[rank]:
        raise InputError(f"pads = {pads} is not supported", fix="give pads of every axis, none of the batch")
    before, after = pads[1:rank], pads[rank + 1 :]
    r.result(node, r.builder.pad(x, before, after, mode, float(np.asarray(value).reshape(-1)[0])))


def _concat(r: _Reader, node: onnx.NodeProto, a: _Attributes) -> None:
    axis = a.get("axis")
    sources = [r.source(node, k) for k in range(len(node.input))]
    rank = 1 + len(r.builder.shape(sources[0]))
    if axis is None or not -rank <= axis < rank or axis % rank == 0:
        raise InputError(f"attribute axis = {axis} is not supported", fix="the batch, axis 0, must stay")
    r.result(node, r.builder.concat(sources, axis % rank - 1))


def _slice(r: _Reader, node: onnx.NodeProto, a: _Attributes) -> None:
    x = r.source(node)
    shape = r.builder.shape(x)
    starts, ends = a.get("starts"), a.get("ends")
    if starts is None:
        starts, ends = r.weight(node, 1), r.weight(node, 2)
    starts, ends = np.atleast_1d(starts), np.atleast_1d(ends)
    axes = a.get("axes")
    axes = np.atleast_1d(r.constant(node, 3, np.arange(len(starts))) if axes is None else axes)
    steps = np.atleast_1d(r.constant(node, 4, np.ones(len(starts), np.int64)))
    if not len(starts) == len(ends) == len(axes) == len(steps):
        raise InputError("starts, ends, axes and steps differ in length")
    chosen = [slice(None)] * (1 + len(shape))
    for start, end, axis, step in zip(starts, ends, axes, steps, strict=True):
        if not -len(chosen) <= axis < len(chosen) or axis % len(chosen) == 0 or step < 1:
            raise InputError(
                f"axis {axis} with step {step} is not supported", fix="the batch must stay; steps positive"
            )
        chosen[int(axis)] = slice(int(start), int(end), int(step))
    r.result(node, r.builder.slice(x, chosen[1:]))


def _reduce_mean(r: _Reader, node: onnx.NodeProto, a: _Attributes) -> None:
    x = r.source(node)
    shape = r.builder.shape(x)
    a.only("noop_with_empty_axes", 0)
    if len(shape) != 3 or _axes(r, node, a, 4) != [2, 3]:
        raise InputError(f"axes of an item {item(shape)} are not supported", fix="only rows and columns, axes 2 and 3")
    index = r.builder.average_pool(x, shape[1:], (1, 1), (0, 0, 0, 0), True)
    if not a.get("keepdims", 1):
        index = r.builder.reshape(index, shape[:1])
    r.result(node, index)


_RULES: dict[str, Rule] = {
    "Add": _binary,
    "AveragePool": _average_pool,
    "BatchNormalization": _batch_norm,
    "Concat": _concat,
    "Constant": _constant,
    "Conv": _conv,
    "Div": _binary,
    "Dropout": _dropout,
    "Flatten": _flatten,
    "Gemm": _gemm,
    "GlobalAveragePool": _global_average,
    "Identity": _identity,
    "LeakyRelu": _leaky_relu,
    "MatMul": _matmul,
    "MaxPool": _max_pool,
    "Mul": _binary,
    "Neg": _neg,
    "Pad": _pad,
    "ReduceMean": _reduce_mean,
    "Relu": _relu,
    "Reshape": _reshape,
    "Sigmoid": _sigmoid,
    "Slice": _slice,
    "Squeeze": _squeeze,
    "Sub": _binary,
    "Tanh": _tanh,
    "Transpose": _transpose,
    "Unsqueeze": _unsqueeze,
}
