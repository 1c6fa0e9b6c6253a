"""Reading a file of `torch.export.save` into a network, without unpickling or executing anything in it.

The archive holds the graph as JSON and the weights as raw bytes. `torch.export.load` would unpickle other
members; they are not touched here. Weights that were pickled are refused.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ns_abstract.errors import InputError
from ns_abstract.verify.network.build import Builder
from ns_abstract.verify.network.graph import Network, item

_LARGEST_GRAPH = 64 << 20
_LARGEST_WEIGHTS = 4 << 30
#: torch's numbers of scalar types.
_TYPES = {4: np.dtype(np.int32), 5: np.dtype(np.int64), 7: np.dtype(np.float32), 8: np.dtype(np.float64)}
_FIX = "save it again with torch.export.save"
_ONES = (1, 1)

Run = Callable[[np.ndarray], np.ndarray]


def read_exported(path: Path) -> tuple[Network, Run]:
    """The network in a .pt2 file, and the same graph run with torch's own operators on one image [1, ...].

    Raises:
        InputError: The file cannot be read, or uses what is not supported; names node, operator and argument.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            graph, weights = _contents(path, archive)
        reader = _Reader(path, graph, weights)
        return reader.network(), reader.run
    except (OSError, zipfile.BadZipFile) as error:
        raise InputError(f"is not an archive of torch.export ({error})", file=path, fix=_FIX) from None
    except (KeyError, TypeError, IndexError, AttributeError, ValueError, json.JSONDecodeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"is damaged or of another version ({error!r})", file=path, fix=_FIX) from None


def _contents(path: Path, archive: zipfile.ZipFile) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The graph and the weights by name."""

    def member(name: str, limit: int) -> bytes:
        found = [info for info in archive.infolist() if info.filename == name or info.filename.endswith("/" + name)]
        if len(found) != 1:
            raise InputError(f"holds {len(found)} members {name}", file=path, fix=_FIX)
        if found[0].file_size > limit:
            raise InputError(f"{name} has {found[0].file_size:,} bytes", file=path, fix=f"at most {limit:,} are read")
        return archive.read(found[0])

    if member("byteorder", 64) != b"little":
        raise InputError("was written on a big-endian machine", file=path, fix=_FIX)
    model = json.loads(member("models/model.json", _LARGEST_GRAPH))
    described = json.loads(member("data/weights/model_weights_config.json", _LARGEST_GRAPH))["config"]
    constants = json.loads(member("data/constants/model_constants_config.json", _LARGEST_GRAPH))["config"]
    weights = {}
    for folder, config in (("weights", described), ("constants", constants)):
        for name, entry in config.items():
            field = f"{folder[:-1]} {name}"
            if entry.get("use_pickle", True):
                raise InputError("is pickled, which is not read", file=path, field=field, fix=_FIX)
            meta = entry["tensor_meta"]
            kind = _TYPES.get(meta["dtype"])
            if kind is None:
                raise InputError(f"has scalar type {meta['dtype']}", file=path, field=field, fix="use float32")
            shape = tuple(int(size["as_int"]) for size in meta["sizes"])
            strides = tuple(int(size["as_int"]) for size in meta["strides"])
            data = np.frombuffer(member(f"data/{folder}/{entry['path_name']}", _LARGEST_WEIGHTS), kind)
            first = int(meta["storage_offset"]["as_int"])
            last = first + sum((n - 1) * s for n, s in zip(shape, strides, strict=True))
            if min((*shape, *strides, first, 0)) < 0 or (0 not in shape and last >= data.size):
                raise InputError(f"{item(shape)} does not fit its {data.size} numbers", file=path, field=field)
            steps = tuple(s * kind.itemsize for s in strides)
            array = np.array(np.lib.stride_tricks.as_strided(data[first:], shape, steps))
            if kind.kind == "f" and not np.isfinite(array).all():
                raise InputError("holds numbers that are not finite", file=path, field=field, fix="train again")
            weights[name] = array
    return model["graph_module"], weights


class _Arguments:
    """A node's arguments, each of which a rule must ask for."""

    def __init__(self, reader: _Reader, node: dict[str, Any]) -> None:
        self.reader = reader
        self.found = {entry["name"]: reader.value(entry["arg"]) for entry in node["inputs"]}
        self.asked: set[str] = set()

    def get(self, name: str, default: Any = None) -> Any:
        self.asked.add(name)
        return self.found.get(name, default)

    def image(self, name: str) -> int:
        """Index of the node that makes an argument."""
        value = self.get(name)
        if not isinstance(value, _Index):
            raise InputError(f"argument {name} is a constant", fix="it must depend on the image")
        return value.number

    def array(self, name: str) -> np.ndarray | None:
        value = self.get(name)
        if isinstance(value, _Index):
            raise InputError(f"argument {name} depends on the image", fix="it must be a constant")
        return None if value is None else np.asarray(value, np.float64)

    def needed(self, name: str) -> np.ndarray:
        value = self.array(name)
        if value is None:
            raise InputError(f"argument {name} is missing")
        return value

    def pair(self, name: str, default: Any) -> tuple[int, int]:
        value = self.get(name)
        if value is None or value == []:
            return default
        values = [int(v) for v in np.atleast_1d(value)]
        if len(values) not in (1, 2):
            raise InputError(f"argument {name} = {values}", fix="two dimensions expected")
        return values[0], values[-1]

    def only(self, name: str, *allowed: Any) -> None:
        value = self.get(name, allowed[0])
        if value not in allowed:
            raise InputError(f"argument {name} = {value} is not supported", fix=f"only {allowed[0]} is")

    def ignore(self, *names: str) -> None:
        """Arguments that do not matter."""
        self.asked.update(names)

    def done(self) -> None:
        for name, value in self.found.items():
            if name not in self.asked and value is not None:
                raise InputError(f"argument {name} is not supported", fix="export without it")


class _Index:
    """A node of the network among constants."""

    def __init__(self, number: int) -> None:
        self.number = number


class _Reader:
    """Turns one graph's nodes into layers."""

    def __init__(self, path: Path, module: dict[str, Any], weights: dict[str, np.ndarray]) -> None:
        self.path, self.graph = path, module["graph"]
        self.constants: dict[str, np.ndarray] = {}
        images = []
        for spec in module["signature"]["input_specs"]:
            kind, content = next(iter(spec.items()))
            if kind == "user_input":
                images.append(content["arg"]["as_tensor"]["name"])
                continue
            stored = content.get(f"{kind}_name") or content.get("tensor_constant_name")
            if stored not in weights:
                raise InputError(f"input {stored!r} ({kind}) is not stored", file=path, fix=_FIX)
            self.constants[content["arg"]["name"]] = weights[stored]
        results = [spec for spec in module["signature"]["output_specs"] if "user_output" in spec]
        if len(images) != 1 or len(results) != 1 or len(module["signature"]["output_specs"]) != 1:
            raise InputError(
                f"has {len(images)} inputs and {len(results)} outputs",
                file=path,
                fix="one image and one output expected",
            )
        self.image, self.output = images[0], results[0]["user_output"]["arg"]["as_tensor"]["name"]
        sizes = [size.get("as_int", 0) for size in self.graph["tensor_values"][self.image]["sizes"]]
        if len(sizes) < 2 or min(sizes[1:]) < 1:
            raise InputError(f"input has sizes {sizes}", file=path, fix="only the batch may be free")
        self.batch = max(1, sizes[0])
        self.builder = Builder(path, tuple(sizes[1:]))
        self.values: dict[str, Any] = {self.image: _Index(0)}

    def value(self, argument: dict[str, Any]) -> Any:
        """An argument: a node, a constant, a number or a list of them; the batch counts as 1."""
        kind, content = next(iter(argument.items()))
        if kind == "as_none":
            return None
        if kind == "as_tensor":
            return self._named(content["name"])
        if kind == "as_tensors":
            return [self._named(entry["name"]) for entry in content]
        if kind == "as_sym_int":
            return self._symbol(content)
        if kind == "as_sym_ints":
            return [self._symbol(entry) for entry in content]
        if kind in ("as_int", "as_ints", "as_float", "as_floats", "as_bool", "as_string"):
            return content
        raise InputError(f"an argument of kind {kind} is not supported", fix=_FIX)

    def _named(self, name: str) -> Any:
        if name in self.values:
            return self.values[name]
        if name in self.constants:
            return self.constants[name]
        raise InputError(f"value {name!r} is not known, or was changed in place", fix="write the network without that")

    def _symbol(self, entry: dict[str, Any]) -> int:
        return int(entry["as_int"]) if "as_int" in entry else int(self._named(entry["as_name"]))

    def network(self) -> Network:
        for node in self.graph["nodes"]:
            target = str(node["target"])
            name = _output(node)
            try:
                rule = _RULES.get(target.removeprefix("torch.ops.aten."))
                if rule is None:
                    raise InputError("operator is not supported", fix=f"use one of {', '.join(sorted(_RULES))}")
                arguments = _Arguments(self, node)
                found = rule(self, arguments)
                arguments.done()
            except InputError as error:
                if error.file is not None:
                    raise
                raise InputError(
                    error.problem, file=self.path, field=f"node {name} ({target})", fix=error.fix
                ) from None
            self._forget_changed(target, node)
            if isinstance(found, _Index):
                self.builder.name(found.number, name, target)
            self.values[name] = found
        result = self.values.get(self.output)
        if not isinstance(result, _Index):
            raise InputError("output does not depend on the image", file=self.path)
        return self.builder.network(result.number)

    def _forget_changed(self, target: str, node: dict[str, Any]) -> None:
        """What an operator changes in place, or may share memory with that, is not to be read again."""
        if target.split(".")[-2].endswith("_"):
            changed = node["inputs"][0]["arg"]["as_tensor"]["name"]
            number = getattr(self.values.get(changed), "number", None)
            made = next((n for n in self.graph["nodes"] if _output(n) == changed), None)
            if made is None or str(made["target"]).split(".")[-2] in _VIEWS:
                raise InputError(
                    f"changes {changed} in place, which shares memory",
                    file=self.path,
                    field=f"node {_output(node)} ({target})",
                    fix="write the network without that",
                )
            for name in [k for k, v in self.values.items() if getattr(v, "number", None) == number]:
                del self.values[name]

    def run(self, image: np.ndarray) -> np.ndarray:
        """The graph by torch's own operators, those of the table only."""
        values: dict[str, Any] = {name: torch.from_numpy(array) for name, array in self.constants.items()}
        values[self.image] = torch.from_numpy(np.repeat(image, self.batch, 0))

        def take(argument: dict[str, Any]) -> Any:
            kind, content = next(iter(argument.items()))
            if kind == "as_tensor":
                return values[content["name"]]
            if kind == "as_tensors":
                return [values[entry["name"]] for entry in content]
            if kind in ("as_sym_int", "as_sym_ints"):
                entries = content if kind == "as_sym_ints" else [content]
                found = [e["as_int"] if "as_int" in e else values[e["as_name"]] for e in entries]
                return found if kind == "as_sym_ints" else found[0]
            return None if kind == "as_none" else content

        with torch.no_grad():
            for node in self.graph["nodes"]:
                _, _, _, operator, overload = str(node["target"]).split(".")
                positional = [take(e["arg"]) for e in node["inputs"] if e.get("kind", 1) == 1]
                named = {e["name"]: take(e["arg"]) for e in node["inputs"] if e.get("kind", 1) != 1}
                values[_output(node)] = getattr(getattr(torch.ops.aten, operator), overload)(*positional, **named)
        result = values[self.output]
        assert isinstance(result, Tensor)
        return result[:1].numpy()


def _output(node: dict[str, Any]) -> str:
    entry = node["outputs"][0]
    return str(entry["as_tensor"]["name"] if "as_tensor" in entry else entry["as_sym_int"]["as_name"])


Rule = Callable[[_Reader, _Arguments], Any]


def _conv(r: _Reader, a: _Arguments) -> _Index:
    x, weight, padding = a.image("input"), a.needed("weight"), a.get("padding", 0)
    if weight.ndim != 4 or len(r.builder.shape(x)) != 3 or isinstance(padding, str):
        raise InputError(f"weights {item(weight.shape)}", fix="only two-dimensional convolutions with numeric padding")
    pads = a.pair("padding", (0, 0)) * 2
    stride, dilation = a.pair("stride", _ONES), a.pair("dilation", _ONES)
    groups = int(a.get("groups", 1))
    return _Index(r.builder.convolution(x, weight, a.array("bias"), stride, dilation, pads, groups))


def _linear(r: _Reader, a: _Arguments) -> _Index:
    return _Index(r.builder.matrix(a.image("input"), a.needed("weight"), a.array("bias")))


def _batch_norm(r: _Reader, a: _Arguments) -> _Index:
    x = a.image("input")
    a.only("training", False)
    a.ignore("momentum", "cudnn_enabled")
    mean, variance = a.needed("running_mean"), a.needed("running_var")
    scale, shift = a.array("weight"), a.array("bias")
    scale, shift = np.ones_like(mean) if scale is None else scale, np.zeros_like(mean) if shift is None else shift
    return _Index(r.builder.batch_norm(x, scale, shift, mean, variance, float(a.get("eps", 1e-5))))


def _relu(r: _Reader, a: _Arguments) -> _Index:
    return _Index(r.builder.leaky_relu(a.image("self"), 0.0))


def _leaky_relu(r: _Reader, a: _Arguments) -> _Index:
    return _Index(r.builder.leaky_relu(a.image("self"), float(a.get("negative_slope", 0.01))))


def _sigmoid(r: _Reader, a: _Arguments) -> _Index:
    return _Index(r.builder.sigmoid(a.image("self")))


def _tanh(r: _Reader, a: _Arguments) -> _Index:
    return _Index(r.builder.tanh(a.image("self")))


def _neg(r: _Reader, a: _Arguments) -> _Index:
    return _Index(r.builder.scale(a.image("self"), -np.ones(()), None))


def _sum(sign: int) -> Rule:
    def rule(r: _Reader, a: _Arguments) -> _Index:
        a.only("alpha", 1)
        one, two = a.get("self"), a.get("other")
        if isinstance(one, _Index) and isinstance(two, _Index):
            return _Index(r.builder.sum((one.number, two.number), (1, sign)))
        if isinstance(one, _Index):
            return _Index(r.builder.scale(one.number, np.ones(()), sign * a.needed("other")))
        return _Index(r.builder.scale(a.image("other"), sign * np.ones(()), a.needed("self")))

    return rule


def _mul(r: _Reader, a: _Arguments) -> _Index:
    one = "self" if isinstance(a.get("self"), _Index) else "other"
    return _Index(r.builder.scale(a.image(one), a.needed("other" if one == "self" else "self"), None))


def _div(r: _Reader, a: _Arguments) -> _Index:
    divisor = a.needed("other")
    if not divisor.all():
        raise InputError("divides by zero", fix="check the constant")
    return _Index(r.builder.scale(a.image("self"), 1.0 / divisor, None))


def _pool(r: _Reader, a: _Arguments) -> tuple[int, Any, Any, Any, Any]:
    x = a.image("self")
    if len(r.builder.shape(x)) != 3:
        raise InputError(f"input {item(r.builder.shape(x))}", fix="only two-dimensional pooling is read")
    kernel = a.pair("kernel_size", _ONES)
    stride, dilation = a.pair("stride", kernel), a.pair("dilation", _ONES)
    pads = a.pair("padding", (0, 0)) * 2
    r.builder.check_window(x, kernel, stride, dilation, pads, bool(a.get("ceil_mode", False)))
    return x, kernel, stride, dilation, pads


def _average_pool(r: _Reader, a: _Arguments) -> _Index:
    x, kernel, stride, _, pads = _pool(r, a)
    return _Index(r.builder.average_pool(x, kernel, stride, pads, bool(a.get("count_include_pad", True))))


def _max_pool(r: _Reader, a: _Arguments) -> _Index:
    return _Index(r.builder.max_pool(*_pool(r, a)))


def _adaptive(r: _Reader, a: _Arguments) -> _Index:
    x, size = a.image("self"), a.pair("output_size", _ONES)
    shape = r.builder.shape(x)
    if len(shape) != 3 or shape[1] % size[0] or shape[2] % size[1]:
        raise InputError(f"argument output_size = {list(size)} of {item(shape)}", fix="it must divide the size")
    kernel = shape[1] // size[0], shape[2] // size[1]
    return _Index(r.builder.average_pool(x, kernel, kernel, (0, 0, 0, 0), True))


def _mean(r: _Reader, a: _Arguments) -> _Index:
    x = a.image("self")
    shape = r.builder.shape(x)
    a.only("dtype", None)
    if len(shape) != 3 or sorted(int(v) % 4 for v in a.get("dim") or ()) != [2, 3]:
        raise InputError(f"argument dim of an item {item(shape)}", fix="only rows and columns, 2 and 3, are supported")
    index = r.builder.average_pool(x, shape[1:], _ONES, (0, 0, 0, 0), True)
    return _Index(index if a.get("keepdim", False) else r.builder.reshape(index, shape[:1]))


def _axis(value: int, rank: int) -> int:
    """An axis of the item."""
    if not -rank <= value < rank or value % rank == 0:
        raise InputError(f"axis {value} is not supported", fix="the batch, axis 0, must stay")
    return value % rank - 1


def _flatten(r: _Reader, a: _Arguments) -> _Index:
    x = a.image("self")
    shape = r.builder.shape(x)
    rank = 1 + len(shape)
    first, last = _axis(int(a.get("start_dim", 0)), rank), _axis(int(a.get("end_dim", -1)), rank)
    joined = int(np.prod(shape[first : last + 1]))
    return _Index(r.builder.reshape(x, (*shape[:first], joined, *shape[last + 1 :])))


def _view(r: _Reader, a: _Arguments) -> _Index:
    x = a.image("self")
    shape = r.builder.shape(x)
    target = [int(v) for v in (a.get("size") if "size" in a.found else a.get("shape"))]
    total = int(np.prod(shape))
    # the stored batch stands for any
    if target[0] not in (1, r.batch, -1) or target.count(-1) > 1:
        raise InputError(f"shape {target} of an item {item(shape)} moves the batch", fix="keep the batch first")
    rest = int(np.prod([v for v in target[1:] if v != -1], dtype=np.int64))
    found = [total // max(1, rest) if v == -1 else v for v in target[1:]]
    if int(np.prod(found)) != total:
        raise InputError(f"shape {target} of an item {item(shape)} moves the batch", fix="keep the batch first")
    return _Index(r.builder.reshape(x, found))


def _permute(r: _Reader, a: _Arguments) -> _Index:
    x = a.image("self")
    rank = 1 + len(r.builder.shape(x))
    order = [int(v) % rank for v in a.get("dims")]
    if sorted(order) != list(range(rank)) or order[0] != 0:
        raise InputError(f"argument dims = {order} is not supported", fix="the batch must stay first")
    return _Index(r.builder.transpose(x, [v - 1 for v in order[1:]]))


def _slice(r: _Reader, a: _Arguments) -> _Index:
    x = a.image("self")
    rank = 1 + len(r.builder.shape(x))
    dim, start, end = int(a.get("dim", 0)), a.get("start"), a.get("end")
    a.only("step", 1)
    if dim % rank == 0:
        if start not in (None, 0) or (end is not None and end < 2**31):
            raise InputError("takes part of the batch", fix="keep the batch")
        return _Index(x)
    chosen = [slice(None)] * (rank - 1)
    chosen[_axis(dim, rank)] = slice(start, end)
    return _Index(r.builder.slice(x, chosen))


def _cat(r: _Reader, a: _Arguments) -> _Index:
    parts = a.get("tensors")
    if not all(isinstance(part, _Index) for part in parts):
        raise InputError("joins constants", fix="only values that depend on the image are joined")
    sources = [part.number for part in parts]
    return _Index(r.builder.concat(sources, _axis(int(a.get("dim", 0)), 1 + len(r.builder.shape(sources[0])))))


def _pad(r: _Reader, a: _Arguments) -> _Index:
    x = a.image("self")
    shape = r.builder.shape(x)
    pads = [int(v) for v in a.get("pad")]
    a.only("mode", "constant")
    value = a.get("value")
    if len(pads) % 2 or len(pads) > 2 * len(shape):
        raise InputError(f"argument pad = {pads}", fix="two numbers an axis, none of the batch")
    before, after = [0] * len(shape), [0] * len(shape)
    for k in range(len(pads) // 2):
        before[-1 - k], after[-1 - k] = pads[2 * k], pads[2 * k + 1]
    return _Index(r.builder.pad(x, before, after, "constant", 0.0 if value is None else float(value)))


def _same(r: _Reader, a: _Arguments) -> _Index:
    a.ignore("memory_format")
    return _Index(a.image("self"))


def _dropout(r: _Reader, a: _Arguments) -> _Index:
    a.only("train", False)
    a.ignore("p")
    return _Index(a.image("input"))


def _batch_size(r: _Reader, a: _Arguments) -> int:
    x, dim = a.image("self"), int(a.get("dim"))
    return int((1, *r.builder.shape(x))[dim])


_VIEWS = {"flatten", "view", "reshape", "permute", "slice", "alias", "contiguous", "dropout"}
_RULES: dict[str, Rule] = {
    "adaptive_avg_pool2d.default": _adaptive,
    "add.Tensor": _sum(1),
    "add_.Tensor": _sum(1),
    "alias.default": _same,
    "avg_pool2d.default": _average_pool,
    "batch_norm.default": _batch_norm,
    "cat.default": _cat,
    "clone.default": _same,
    "contiguous.default": _same,
    "conv2d.default": _conv,
    "div.Tensor": _div,
    "dropout.default": _dropout,
    "flatten.using_ints": _flatten,
    "leaky_relu.default": _leaky_relu,
    "leaky_relu_.default": _leaky_relu,
    "linear.default": _linear,
    "max_pool2d.default": _max_pool,
    "mean.dim": _mean,
    "mul.Tensor": _mul,
    "neg.default": _neg,
    "pad.default": _pad,
    "permute.default": _permute,
    "relu.default": _relu,
    "relu_.default": _relu,
    "reshape.default": _view,
    "sigmoid.default": _sigmoid,
    "slice.Tensor": _slice,
    "sub.Tensor": _sum(-1),
    "sym_size.int": _batch_size,
    "tanh.default": _tanh,
    "view.default": _view,
}
