"""Reads an ONNX file's messages and tensors after checking their sizes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import onnx
import onnx.inliner
from google.protobuf.message import DecodeError
from onnx import numpy_helper

from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import file_size, show
from ns_abstract.io.memory import check_memory
from ns_abstract.io.packed import unpacked

#: Numbers that one stored tensor may have.
_LARGEST = 1 << 28
#: Largest file: the format's own limit.
_LARGEST_FILE = 1 << 31
#: Bytes in memory for a byte of a file: the file, its messages, tensors in float32 and float64, onnxruntime's copy.
_COPIES = 6
#: Part of a large file that must be stored; the rest are holes, which read as zeros.
_HOLES, _LARGE = 16, 16 << 20
#: How often tensors may share the bytes of files beside the model.
_SHARED = 4
#: Nodes that a graph may have with its local functions written out.
_MOST_NODES = 1 << 18
#: Ending of packed models.
PACKED = ".onnx.gz"
#: Domains of the operators that runtimes have themselves, with what begins so before a dot.
_OWN = ("", "ai.onnx", "com.microsoft", "com.ms")
_FIX = "export the network again"
_T = onnx.TensorProto
#: Types whose numbers numpy holds as they are.
_TYPES = frozenset((_T.FLOAT, _T.DOUBLE, _T.FLOAT16, _T.BOOL, _T.INT8, _T.INT16, _T.INT32, _T.INT64)) | frozenset(
    (_T.UINT8, _T.UINT16, _T.UINT32, _T.UINT64)
)
#: Types that numpy holds in bytes, and the operators that need no more than their numbers.
_FOUR_BITS, _OF_FOUR_BITS = (_T.INT4, _T.UINT4), ("DequantizeLinear", "Cast")


def parse_model(path: Path) -> onnx.ModelProto:
    """Return the messages of an ONNX file, without data in other files.

    Raises:
        InputError: The file cannot be read, or is too large for the free memory.
    """
    size = file_size(path, "network")
    if size > _LARGEST_FILE or (size > _LARGE and path.stat().st_blocks * 512 * _HOLES < size):
        problem = f"claims {size:,} bytes, {path.stat().st_blocks * 512:,} of them are stored"
        raise InputError(problem, file=path, fix="copy it again whole, or export with external data")
    check_memory(_COPIES * size, path, "the network")
    packed = path.name.lower().endswith(PACKED)
    try:
        if packed:
            model = onnx.load_model_from_string(unpacked_model(path))
        else:
            model = onnx.load(str(path), load_external_data=False)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}", file=path, fix="check the path") from None
    except (DecodeError, ValueError, TypeError) as error:
        raise InputError(f"is not an ONNX model ({str(error) or type(error).__name__})", file=path, fix=_FIX) from None
    if not model.graph.node or not model.graph.output:
        raise InputError("holds no network", file=path, field="graph", fix=_FIX)
    _check_attributes(model, path)
    model = _inlined(model, path) if model.functions else model
    _check_types(model.graph, path)
    return model


def number_type(data_type: int) -> np.dtype:
    """Return numpy's type of an ONNX type (N23). Raises InputError where numpy holds its bits, or a wider type."""
    if data_type not in _TYPES:
        named = data_type in _T.DataType.values()
        name = _T.DataType.Name(data_type) if named else str(data_type)  # pyright: ignore[reportArgumentType]
        raise InputError(f"has type {name}", fix="use float32")
    return np.dtype(onnx.helper.tensor_dtype_to_np_dtype(data_type))


def _check_types(graph: onnx.GraphProto, path: Path) -> None:
    """Refuse constants of types that numpy does not represent, except numbers of four bits."""
    four = {tensor.name for tensor in graph.initializer if tensor.data_type in _FOUR_BITS}
    for node in graph.node:
        field = f"node {node.name or ', '.join(node.output)} ({node.op_type})"
        for attribute in node.attribute:
            if attribute.type == onnx.AttributeProto.TENSOR and attribute.t.data_type not in _TYPES:
                with _at(path, field):
                    number_type(attribute.t.data_type)
        if not four.isdisjoint(node.input) and node.op_type not in _OF_FOUR_BITS:
            raise InputError("reads numbers of 4 bits", file=path, field=field, fix="use 8 bits")


def _check_attributes(model: onnx.ModelProto, path: Path) -> None:
    """Refuse attributes that occur twice, of which programs take either, or that refer to no function's attribute."""
    for body in (model.graph, *model.functions):
        for node in body.node:
            names = Counter(attribute.name for attribute in node.attribute)
            wrong = {name: "is given twice" for name, number in names.items() if number > 1}
            if body is model.graph:
                wrong |= {a.name: "refers to one of a function" for a in node.attribute if a.ref_attr_name}
            for name, problem in wrong.items():
                field = f"node {node.name or ', '.join(node.output)} ({node.op_type})"
                raise InputError(f"attribute {name} {problem}", file=path, field=field, fix=_FIX)


def unpacked_model(path: Path) -> bytes:
    """Return the contents of an .onnx.gz file.

    Raises:
        InputError: It is damaged, or unpacks to more than the format's limit or the free memory.
    """
    parts, total = [], 0
    for part in unpacked(path, _LARGEST_FILE):
        parts.append(part)
        total += len(part)
        check_memory(_COPIES * total, path, "the network")
    return b"".join(parts)


@contextmanager
def _at(path: Path, field: str) -> Iterator[None]:
    """Add file and field to an error inside the block."""
    try:
        yield
    except InputError as error:
        raise InputError(error.problem, file=path, field=field, fix=error.fix) from None


def _inlined(model: onnx.ModelProto, path: Path) -> onnx.ModelProto:
    """Return the model with calls of its local functions replaced by their nodes."""
    for function in model.functions:
        # runtimes call their own operator, or the function: the format leaves it to them
        if any(function.domain == own or (own and function.domain.startswith(f"{own}.")) for own in _OWN):
            problem = f"function {function.name} has the domain {show(function.domain)} of operators of runtimes"
            raise InputError(problem, file=path, field="functions", fix="export it with a domain of its own")
    _give_defaults(model)
    bodies = {(f.domain, f.name): [(n.domain, n.op_type) for n in f.node] for f in model.functions}
    counts: dict[tuple[str, str], float] = {}

    def count(key: tuple[str, str], within: tuple[tuple[str, str], ...]) -> float:
        if key not in bodies:
            return 1.0
        if key in within:
            raise InputError(f"function {key[1]} calls itself", file=path, field="functions", fix=_FIX)
        if key not in counts:
            counts[key] = sum(count(inner, (*within, key)) for inner in bodies[key])
        return counts[key]

    total = sum(count((node.domain, node.op_type), ()) for node in model.graph.node)
    if total > _MOST_NODES:
        problem = f"has functions of {total:,.0f} nodes together"
        raise InputError(problem, file=path, field="functions", fix=f"at most {_MOST_NODES:,} are read")
    try:
        return onnx.inliner.inline_local_functions(model)
    except Exception as error:  # the inliner raises whatever it meets
        raise InputError(
            f"has functions that cannot be read ({error})", file=path, field="functions", fix=_FIX
        ) from None


def _give_defaults(model: onnx.ModelProto) -> None:
    """Add the functions' default attributes to calls without them: the inliner forgets these."""
    defaults = {(f.domain, f.name, f.overload): f.attribute_proto for f in model.functions}
    for body in (model.graph, *model.functions):
        for node in body.node:
            names = {attribute.name for attribute in node.attribute}
            missing = defaults.get((node.domain, node.op_type, node.overload), ())
            node.attribute.extend(attribute for attribute in missing if attribute.name not in names)


class StoredTensors:
    """Reads the tensors of one model, also from files beside it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._sizes: dict[Path, int] = {}
        self._taken = 0

    @property
    def files(self) -> tuple[Path, ...]:
        """Files beside the model from which tensors were read."""
        return tuple(self._sizes)

    def array(self, tensor: onnx.TensorProto, field: str) -> np.ndarray:
        """Return a stored constant; InputError if it claims more than is stored, or cannot be used."""
        count = 1
        for size in tensor.dims:
            if size < 0:
                raise InputError(f"has a negative size {size}", file=self.path, field=field, fix=_FIX)
            count *= size
        if count > _LARGEST:
            problem = f"has {count:,} numbers"
            raise InputError(problem, file=self.path, field=field, fix=f"at most {_LARGEST:,} are read")
        if tensor.data_type in _FOUR_BITS:
            kind = np.dtype(np.int8 if tensor.data_type == _T.INT4 else np.uint8)
        else:
            with _at(self.path, field):
                kind = number_type(tensor.data_type)
        if tensor.data_location == onnx.TensorProto.EXTERNAL:
            array = self._external(tensor, field, kind, count)
        else:
            try:
                array = numpy_helper.to_array(tensor)
            except Exception as error:  # numpy_helper raises whatever it meets
                raise InputError(f"cannot be read ({error})", file=self.path, field=field, fix=_FIX) from None
        # what a mask sets to minus infinity is refused where something else than a softmax reads it
        if array.dtype.kind == "f" and not (np.isfinite(array) | np.isneginf(array)).all():
            raise InputError("holds numbers that are not finite", file=self.path, field=field, fix="train again")
        return array

    def _external(self, tensor: onnx.TensorProto, field: str, kind: np.dtype, count: int) -> np.ndarray:
        """Return a constant whose data are in a file, which must lie beside the model."""
        where = {entry.key: entry.value for entry in tensor.external_data}
        folder = self.path.resolve().parent
        location = where.get("location", "")

        def fail(problem: str, fix: str = "put the data beside the model") -> InputError:
            return InputError(problem, file=self.path, field=field, fix=fix)

        if len(where) < len(tensor.external_data):
            # programs take one or the other
            raise fail("states where its data lie twice", _FIX)
        try:
            target = (folder / location).resolve()
            start, length = int(where.get("offset", 0)), int(where.get("length", kind.itemsize * count))
        except (OSError, ValueError, RuntimeError) as error:
            raise fail(f"cannot read {show(location)} ({error})") from None
        if not location or Path(location).is_absolute() or not target.is_relative_to(folder) or target == folder:
            raise fail(f"points to {show(location)}, outside the model's folder")
        if target not in self._sizes:
            try:
                self._sizes[target] = file_size(target, "file of external data")
            except InputError as error:
                raise fail(f"cannot read {show(location)}: {error.problem}") from None
        if start < 0 or length != kind.itemsize * count or start + length > self._sizes[target]:
            problem = f"needs {kind.itemsize * count:,} bytes, has {length:,} at {start:,} of {show(location)}"
            raise fail(f"{problem}, a file of {self._sizes[target]:,}", _FIX)
        self._taken += length
        if self._taken > _SHARED * sum(self._sizes.values()):
            raise fail("shares its data with too many others", _FIX)
        check_memory(_COPIES * self._taken, self.path, "the network")
        try:
            with target.open("rb") as stream:
                stream.seek(start)
                data = stream.read(length)
            return np.frombuffer(data, kind.newbyteorder("<"), count).astype(kind).reshape(tuple(tensor.dims))
        except (OSError, ValueError) as error:
            raise fail(f"cannot read {show(location)} ({error})") from None
