"""Reads the graph in an ONNX file, its constants and its attributes; nothing in the file is executed."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import onnx

from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import show
from ns_abstract.verify.network.composite_layers import CompositeBuilder
from ns_abstract.verify.network.constant_enclosures import EnclosedConstant, arithmetic, fold_enclosed
from ns_abstract.verify.network.graph import Network
from ns_abstract.verify.network.layers import Shape
from ns_abstract.verify.network.onnx_choices import without_choices
from ns_abstract.verify.network.onnx_fold import FOLDED, fold
from ns_abstract.verify.network.onnx_tensors import StoredTensors

#: Operator sets whose meaning is known here.
_OPSETS = range(7, 24)
#: Outputs that a message names.
_NAMED = 8

Rule = Callable[["OnnxReader", onnx.NodeProto, "Attributes"], None]


def operator_set(model: onnx.ModelProto, path: Path) -> int:
    versions = {entry.version for entry in model.opset_import if entry.domain in ("", "ai.onnx")}
    if len(versions) > 1:
        # programs take one or the other
        problem = f"states the operator sets {', '.join(map(str, sorted(versions)))}"
        raise InputError(problem, file=path, field="opset_import", fix="export the network again")
    version = next(iter(versions), 0)
    if version not in _OPSETS:
        raise InputError(
            f"operator set {version} is not supported",
            file=path,
            field="opset_import",
            fix=f"export with an operator set from {_OPSETS[0]} to {_OPSETS[-1]}",
        )
    return version


#: What people do instead of an operator that has no bounds here.
_INSTEAD = {
    "Atan": "use Tanh",
    "Ceil": "leave rounding out",
    "Col2Im": "use ConvTranspose, or DepthToSpace where blocks do not overlap",
    "Cos": "only constants may pass it",
    "CumSum": "use MatMul with a triangular matrix",
    "Equal": "only constants may be compared",
    "Floor": "leave rounding out",
    "GatherElements": "use Gather with constant indices",
    "GridSample": "use Resize",
    "If": "export without branches",
    "GreaterOrEqual": "use Max, Min or Clip instead of a choice",
    "Less": "use Max, Min or Clip instead of a choice",
    "LessOrEqual": "use Max, Min or Clip instead of a choice",
    "Loop": "export with fixed sizes",
    "LpPool": "use AveragePool",
    "LSTM": "use convolutions or attention",
    "GRU": "use convolutions or attention",
    "MaxRoiPool": "export without post-processing",
    "NonMaxSuppression": "export without post-processing",
    "NonZero": "export without post-processing",
    "RNN": "use convolutions or attention",
    "ReduceProd": "use ReduceSum of logarithms",
    "RoiAlign": "export without post-processing",
    "Round": "leave rounding out",
    "Scan": "export with fixed sizes",
    "ScatterND": "use Concat of slices",
    "Sign": "use Clip or Tanh",
    "Sin": "only constants may pass it",
}


#: Operators that work on every item of a batch by itself, and rules that refuse where they do not.
_BY_ITEM = frozenset(
    (
        *("Abs", "Add", "AveragePool", "BatchNormalization", "Cast", "Celu", "Clip", "Concat", "Conv", "ConvTranspose"),
        *("Div", "Dropout", "Elu", "Erf", "Exp", "Flatten", "Gelu", "Gemm", "GlobalAveragePool", "GlobalMaxPool"),
        *(
            "HardSigmoid",
            "HardSwish",
            "Identity",
            "LeakyRelu",
            "MatMul",
            "MaxPool",
            "Mish",
            "Mul",
            "PRelu",
            "Pad",
            "Relu",
        ),
        *("Relu", "Reshape", "Resize", "Selu", "Sigmoid", "Softmax", "Softplus", "Sub", "Tanh", "Upsample"),
    )
)


class ReadRequest(NamedTuple):
    """The requested output of a file, and the shape of its input.

    Attributes:
        output: Name of the output; None: the only one.
        vector: Whether the input may be a vector [n], without a batch.
        picture: Height and width where the file leaves them free.
        last: Whether channels come last in such a picture.
        whole_numbers: Whether the input may be uint8.
    """

    output: str | None = None
    vector: bool = False
    picture: tuple[int, int] | None = None
    last: bool = False
    whole_numbers: bool = False


#: What picks among scores, at the end of many networks.
_PICKS = frozenset(("ArgMax", "ArgMin", "TopK"))

#: What moves numbers, whatever they are.
_MOVES = frozenset(("Flatten", "Identity", "Reshape", "Squeeze", "Transpose", "Unsqueeze"))


class TensorValue(NamedTuple):
    """A tensor of the graph: its node of the network, and its shape in the file for a batch of 1."""

    index: int
    whole: Shape

    @property
    def item(self) -> Shape:
        """The shape without the batch axis; the whole shape where the file has merged the batch axis with others."""
        return self.whole[1:] if len(self.whole) > 1 and self.whole[0] == 1 else self.whole

    @property
    def batched(self) -> int:
        """Number of batch axes: 1, or 0 where the file has merged the batch axis with others."""
        return len(self.whole) - len(self.item)


class OnnxReader:
    """Converts the nodes of one ONNX graph to layers."""

    def __init__(
        self, path: Path, graph: onnx.GraphProto, opset: int, rules: dict[str, Rule], request: ReadRequest
    ) -> None:
        self.path, self.graph, self.opset, self.rules = path, graph, opset, rules
        self.stored = StoredTensors(path)
        self.constants: dict[str, np.ndarray] = {}
        #: constants that evaluations may round differently; `constants` holds numbers within
        self.enclosed: dict[str, EnclosedConstant] = {}
        for tensor in graph.initializer:
            if tensor.name in self.constants:
                # programs take one or the other
                problem, fix = "is stored twice", "export the network again"
                raise InputError(problem, file=path, field=f"initializer {tensor.name}", fix=fix)
            self.constants[tensor.name] = self.stored.array(tensor, f"initializer {tensor.name}")
        if graph.sparse_initializer:
            raise InputError("sparse constants are not supported", file=path, fix="store them as dense tensors")
        #: items that the file's batch always holds; all are the same picture
        self.batch = 1
        #: whether the input is uint8
        self.whole_numbers = False
        self.input_name, image = self._input(request)
        self.output = self._chosen(request.output)
        self.builder = CompositeBuilder(path, image.item)
        self.values: dict[str, TensorValue] = {self.input_name: image}
        #: whether a value is above a number: what the exporter makes of softplus
        self.above: dict[str, tuple[TensorValue, float]] = {}
        #: scale and zero of values that are rounded to steps, until they are dequantised
        self.quantised: dict[str, tuple[float, int]] = {}
        #: numbers of a value that a mask has set to minus infinity, in its whole shape; they stand as they were before
        self.dropped: dict[str, np.ndarray] = {}

    def _fail(self, node: onnx.NodeProto, problem: str, fix: str | None = None) -> InputError:
        name = node.name or (node.output[0] if node.output else "")
        return InputError(problem, file=self.path, field=f"node {name} ({node.op_type})", fix=fix)

    def _input(self, request: ReadRequest) -> tuple[str, TensorValue]:
        inputs = [value for value in self.graph.input if value.name not in self.constants]
        if len(inputs) != 1:
            raise InputError(f"has {len(inputs)} inputs", file=self.path, field="graph.input", fix="one image expected")
        value = inputs[0]
        field = f"input {value.name}"
        kind = value.type.tensor_type
        if kind.elem_type == onnx.TensorProto.UINT8:
            self._check_levels(value.name, field, request)
            self.whole_numbers = True
        elif kind.elem_type not in (onnx.TensorProto.FLOAT, onnx.TensorProto.DOUBLE):
            raise InputError("is not a float32 tensor", file=self.path, field=field, fix="export with a float input")
        # some exporters write -1 for what is free
        sizes = [max(0, d.dim_value) if d.HasField("dim_value") else 0 for d in kind.shape.dim]
        if len(sizes) == 4 and request.picture is not None:
            places = (1, 2) if request.last else (2, 3)
            for place, size in zip(places, request.picture, strict=True):
                side = kind.shape.dim[place]
                if not side.HasField("dim_value") or side.dim_value < 0:
                    sizes[place] = size
        if request.vector and len(sizes) == 1 and sizes[0] > 0:
            return value.name, TensorValue(0, tuple(sizes))
        if len(sizes) == 4 and sizes[0] > 1:
            self.batch, sizes[0] = sizes[0], 1
        if len(sizes) > 1 and sizes[0] > 1 and min(sizes) > 0:
            # no batch of pictures: the whole tensor is the item
            return value.name, TensorValue(0, tuple(sizes))
        if len(sizes) < 2 or sizes[0] not in (0, 1) or min(sizes[1:]) < 1:
            dimensions = [d.dim_value if d.HasField("dim_value") else d.dim_param or "?" for d in kind.shape.dim]
            raise InputError(
                f"has shape {dimensions}",
                file=self.path,
                field=field,
                fix="export with all sizes but the batch fixed, or say height and width in preprocess.resize",
            )
        return value.name, TensorValue(0, (1, *sizes[1:]))

    def _check_levels(self, name: str, field: str, request: ReadRequest) -> None:
        """Refuse a uint8 input that is used before it is cast to float, or that is not given whole numbers."""
        if not request.whole_numbers:
            fix = 'for pictures: write "range": [0, 255] alone in preprocess; else export with a float input'
            raise InputError("is a uint8 tensor", file=self.path, field=field, fix=fix)
        integers = {name}
        for node in self.graph.node:
            read = integers.intersection((*node.input, *_outer_names(node)))
            if node.op_type == "Cast" or not read:
                continue
            if node.op_type not in _MOVES or read != {node.input[0]}:
                raise self._fail(node, "computes with uint8 numbers", "cast the input to float before it")
            integers.update(node.output)

    def network(self) -> Network:
        """Return the network up to the chosen output; nodes that it does not depend on are not read."""
        needed, nodes = {self.output}, without_choices(self.graph)
        for node in reversed(nodes):
            if needed.intersection(node.output):
                needed.update(node.input, _outer_names(node))
        needed.discard("")
        for node in nodes:
            wanted = [name if name in needed else "" for name in node.output]
            if not any(wanted):
                continue
            read = onnx.NodeProto()
            read.CopyFrom(node)
            del read.output[:]
            read.output.extend(wanted)
            try:
                self._read(read)
            except InputError as error:
                if error.field is not None:
                    raise
                raise self._fail(node, error.problem, error.fix) from None
        name = self.output
        if name not in self.values:
            raise InputError(f"output {name!r} does not depend on the image", file=self.path, field="graph.output")
        if name in self.quantised:
            raise InputError(f"output {name!r} holds integers", file=self.path, field="graph.output")
        if name in self.dropped:
            raise InputError(f"output {name!r} holds minus infinity", file=self.path, field="graph.output")
        return self.builder.network(self.values[name].index, name, self.whole_numbers, self.stored.files)

    def _chosen(self, name: str | None) -> str:
        """Return the name of the output to read: the requested one, or the only one of scores.

        Outputs are never joined: a label would count through all of them. Masks and indices are no scores.
        """
        shapes, beside = {}, []
        for value in self.graph.output:
            kind = value.type.tensor_type
            shapes[value.name] = [
                d.dim_value if d.HasField("dim_value") else d.dim_param or "?" for d in kind.shape.dim
            ]
            if kind.elem_type not in (0, onnx.TensorProto.FLOAT, onnx.TensorProto.DOUBLE, onnx.TensorProto.FLOAT16):
                beside.append(value.name)
        if name is not None:
            if name not in shapes:
                fix = f"write {_named(shapes)}"
                raise InputError(f"has no output {show(name)}", file=self.path, field="output", fix=fix)
            return name
        scores = [name for name in shapes if name not in beside] or list(shapes)
        if len(scores) == 1:
            return scores[0]
        raise InputError(
            f"has {len(scores)} outputs: {_named({name: shapes[name] for name in scores})}",
            file=self.path,
            field="output",
            fix=f'write "output": {show(scores[0])} in the property, or export the network with one output',
        )

    def _read(self, node: onnx.NodeProto) -> None:
        kind = node.op_type
        if self.batch > 1 and kind not in _BY_ITEM and any(name in self.values for name in node.input):
            raise InputError(f"works on a batch of {self.batch} items", fix="export with a free batch or a batch of 1")
        if node.domain not in ("", "ai.onnx"):
            raise InputError(f"operator of domain {node.domain} is not supported", fix="export without it")
        inputs = [name for name in node.input if name]
        if kind in FOLDED and inputs and all(name in self.constants for name in inputs):
            values = [self.constants[name] if name else None for name in node.input]
            if not arithmetic(node, values, any(name in self.enclosed for name in inputs)):
                self.fold(node, *fold(node, values, self.opset))
                return
            with np.errstate(all="ignore"):
                within = [self.enclosed.get(n, v) for n, v in zip(node.input, values, strict=True)]
                folded = fold_enclosed(node, within, self.opset)
            names = [name for name in node.output if name]
            self.enclosed |= {n: v for n, v in zip(names, folded, strict=False) if isinstance(v, EnclosedConstant)}
            self.fold(node, *(v.value if isinstance(v, EnclosedConstant) else v for v in folded))
            return
        rule = self.rules.get(kind)
        if rule is None:
            near = difflib.get_close_matches(kind, self.rules, 5, 0.0)
            advice = f"{len(self.rules)} operators are, the nearest by name {', '.join(near)}"
            if kind in _PICKS:
                advice = (
                    f"make its input {node.input[0]!r} the network's output: properties compare the scores themselves"
                )
            raise InputError("operator is not supported", fix=_INSTEAD.get(kind, advice))
        attributes = Attributes(self, node)
        rule(self, node, attributes)
        attributes.done()

    # what rules use

    def value(self, node: onnx.NodeProto, position: int = 0) -> TensorValue:
        """Return the tensor at input ``position``, which must depend on the image."""
        name = node.input[position] if position < len(node.input) else ""
        if name in self.dropped and node.op_type != "Softmax":
            raise InputError("reads what a mask has set to minus infinity", fix="mask right before a Softmax")
        if name in self.quantised and node.op_type != "DequantizeLinear":
            raise InputError("reads integers", fix="put a DequantizeLinear between")
        if name in self.values:
            return self.values[name]
        if name in self.constants:
            raise InputError(f"input {position} ({name}) is a constant", fix="it must depend on the image")
        raise InputError(f"input {position} ({name!r}) is not known", fix="export the network again")

    def moves(self, node: onnx.NodeProto, position: int) -> bool:
        """Return whether an input depends on the image."""
        return position < len(node.input) and node.input[position] in self.values

    def source(self, node: onnx.NodeProto, position: int = 0) -> int:
        """Return the network's node at input ``position``, which must be a batch of items."""
        value = self.value(node, position)
        if not value.batched:
            raise InputError(f"input of shape {list(value.whole)} mixes the batch", fix="keep the batch first")
        return value.index

    def constant(self, node: onnx.NodeProto, position: int, default: Any = None, doubtful: bool = False) -> Any:
        """Return the constant input ``position``, or ``default``. ``doubtful``: the caller charges `doubts`."""
        name = node.input[position] if position < len(node.input) else ""
        if not name:
            return default
        if name not in self.constants:
            raise InputError(f"input {position} ({name}) is not a constant", fix="fold constants when exporting")
        if name in self.enclosed and not doubtful:
            problem = f"input {position} ({name}) is a constant that rounding changes"
            raise InputError(problem, fix="fold constants when exporting, in float64")
        constant = self.constants[name]
        if constant.dtype.kind == "f" and node.op_type != "Add" and np.isneginf(constant).any():
            raise InputError(f"input {position} ({name}) holds minus infinity", fix="mask right before a Softmax")
        return constant

    def doubts(self, node: onnx.NodeProto, position: int) -> EnclosedConstant | None:
        """Return the enclosures of a constant input that rounding changes; None if it is exact."""
        return self.enclosed.get(node.input[position]) if position < len(node.input) else None

    def weight(self, node: onnx.NodeProto, position: int, doubtful: bool = False) -> np.ndarray:
        constant = self.constant(node, position, None, doubtful)
        if constant is None:
            raise InputError(f"input {position} is missing", fix="export the network again")
        return constant

    def result(self, node: onnx.NodeProto, index: int, whole: Shape | None = None, output: int = 0) -> None:
        """Set an output of the node to items of network node ``index``, of shape ``whole`` for a batch of 1."""
        if whole is None:
            if any(node.output[1:]):
                raise InputError("has several outputs", fix="only the first is supported")
            whole = (1, *self.builder.shape(index))
        value = TensorValue(index, tuple(whole))
        if self.batch > 1 and not value.batched:
            raise InputError(f"mixes the {self.batch} items of a batch", fix="export with a batch of 1")
        value = TensorValue(self.builder.reshape(index, value.item), value.whole)
        self.builder.name(value.index, node.name or node.output[0], node.op_type)
        self.values[node.output[output]] = value

    def fold(self, node: onnx.NodeProto, *values: np.ndarray) -> None:
        """Set the node's outputs to constants."""
        for name, value in zip((n for n in node.output if n), values, strict=False):
            self.constants[name] = value


class Attributes:
    """A node's attributes; a node with an attribute that was not read is refused."""

    def __init__(self, reader: OnnxReader, node: onnx.NodeProto) -> None:
        self.reader, self.node = reader, node
        self.by_name = {a.name: a for a in node.attribute}
        self.asked: set[str] = set()

    def get(self, name: str, default: Any = None) -> Any:
        self.asked.add(name)
        if name not in self.by_name:
            # the format's attributes are float32 numbers, and so are its defaults
            return float(np.float32(default)) if isinstance(default, float) else default
        value = onnx.helper.get_attribute_value(self.by_name[name])
        return value.decode() if isinstance(value, bytes) else value

    def ints(self, name: str, count: int, default: int | None = None) -> tuple[int, ...] | None:
        value = self.get(name)
        if value is None:
            return None if default is None else (default,) * count
        if len(value) != count:
            raise InputError(f"attribute {name} = {list(value)}", fix=f"{count} numbers expected: two dimensions")
        return tuple(int(v) for v in value)

    def only(self, name: str, *allowed: Any) -> None:
        """Refuse an attribute that is none of ``allowed``; it may be absent."""
        value = self.get(name)
        if value is not None and value not in allowed:
            raise InputError(f"attribute {name} = {value} is not supported", fix=f"only {allowed[0]} is")

    def ignore(self, *names: str) -> None:
        """Accept attributes that change nothing."""
        self.asked.update(names)

    def done(self) -> None:
        for name in self.by_name:
            if name not in self.asked:
                raise InputError(f"attribute {name} is not supported", fix="export without it")


def _named(shapes: Mapping[str, Sequence[object]]) -> str:
    named = [f"{show(name)} {list(shape)}".replace("'", "") for name, shape in list(shapes.items())[:_NAMED]]
    return ", ".join(named) + (f" and {len(shapes) - _NAMED} more" if len(shapes) > _NAMED else "")


def _outer_names(node: onnx.NodeProto) -> set[str]:
    """Return names that the graphs inside a node may read from outside."""
    names: set[str] = set()
    for attribute in node.attribute:
        for graph in (*attribute.graphs, *([attribute.g] if attribute.HasField("g") else [])):
            for inner in graph.node:
                names.update(inner.input, _outer_names(inner))
    return names
