"""Reading a file of `torch.export.save` into a network, without unpickling or executing anything in it.

The archive holds the graph as JSON and the weights as raw bytes. `torch.export.load` would unpickle other
members; they are not touched here. Weights that were pickled are refused.
"""

from __future__ import annotations

import difflib
import json
import math
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import file_size, show
from ns_abstract.io.memory import check_memory
from ns_abstract.verify.network import curves
from ns_abstract.verify.network.compose import Composer, interpolation
from ns_abstract.verify.network.graph import Network, item

_LARGEST_GRAPH = 64 << 20
_LARGEST_WEIGHTS = 4 << 30
#: torch's numbers of scalar types.
_TYPES = {4: np.dtype(np.int32), 5: np.dtype(np.int64), 7: np.dtype(np.float32), 8: np.dtype(np.float64)}
#: Bytes in memory for a byte of a file, and how often tensors may share the bytes of it.
_COPIES, _SHARED = 6, 4
_FIX = "save it again with torch.export.save"
_ONES = (1, 1)

Run = Callable[[np.ndarray], np.ndarray]


def read_exported(path: Path) -> tuple[Network, Run]:
    """The network in a .pt2 file, and the same graph run with torch's own operators on one image [1, ...].

    Raises:
        InputError: The file cannot be read, or uses what is not supported; names node, operator and argument.
    """
    try:
        check_memory(_COPIES * file_size(path, "network"), path, "the network")
        with zipfile.ZipFile(path) as archive:
            graph, weights = _contents(path, archive)
        reader = _Reader(path, graph, weights)
        return reader.network(), reader.run
    except (InputError, MemoryError):
        raise
    except (OSError, zipfile.BadZipFile) as error:
        raise InputError(f"is not an archive of torch.export ({error})", file=path, fix=_FIX) from None
    except RecursionError:
        raise InputError("its graph is nested too deep", file=path, fix=_FIX) from None
    except Exception as error:  # zipfile, json and the graph's own reading raise many types on damaged files
        problem = f"holds what is not read here, or is damaged ({show(repr(error))})"
        raise InputError(problem, file=path, fix=_FIX) from None


def _contents(path: Path, archive: zipfile.ZipFile) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The graph and the weights by name."""

    def member(name: str, limit: int) -> bytes:
        found = [info for info in archive.infolist() if info.filename == name or info.filename.endswith("/" + name)]
        if len(found) != 1:
            raise InputError(f"holds {len(found)} members {name}", file=path, fix=_FIX)
        if found[0].compress_type != zipfile.ZIP_STORED:
            raise InputError(f"{name} is compressed, which torch never writes", file=path, fix=_FIX)
        if found[0].file_size > limit:
            raise InputError(f"{name} has {found[0].file_size:,} bytes", file=path, fix=f"at most {limit:,} are read")
        return archive.read(found[0])

    if member("byteorder", 64) != b"little":
        raise InputError("was written on a big-endian machine", file=path, fix=_FIX)
    model = json.loads(member("models/model.json", _LARGEST_GRAPH))
    described = json.loads(member("data/weights/model_weights_config.json", _LARGEST_GRAPH))["config"]
    constants = json.loads(member("data/constants/model_constants_config.json", _LARGEST_GRAPH))["config"]
    weights: dict[str, np.ndarray] = {}
    # tensors may be views of the same bytes
    left = _SHARED * path.stat().st_size
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
            claimed = math.prod(shape)
            if min((*shape, *strides, first, 0)) < 0 or (claimed and last >= data.size) or claimed > data.size:
                problem = f"{item(shape)} with strides {item(strides)} does not fit its {data.size} numbers"
                raise InputError(problem, file=path, field=field, fix=_FIX)
            left -= claimed * kind.itemsize
            if left < 0:
                raise InputError("shares its numbers with too many others", file=path, field=field, fix=_FIX)
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
        results = [spec["user_output"]["arg"] for spec in module["signature"]["output_specs"] if "user_output" in spec]
        if len(images) != 1 or not results or len(results) != len(module["signature"]["output_specs"]):
            raise InputError(
                f"has {len(images)} inputs and {len(results)} outputs",
                file=path,
                fix="one image and outputs that are tensors expected",
            )
        if not all("as_tensor" in result for result in results):
            raise InputError("has outputs that are no tensors", file=path, fix="return tensors alone")
        self.image = images[0]
        #: all outputs, bounded one after another
        self.outputs = [str(result["as_tensor"]["name"]) for result in results]
        sizes = [size.get("as_int", 0) for size in self.graph["tensor_values"][self.image]["sizes"]]
        if len(sizes) < 2 or min(sizes[1:]) < 1:
            raise InputError(f"input has sizes {sizes}", file=path, fix="only the batch may be free")
        self.batch = max(1, sizes[0])
        self.builder = Composer(path, tuple(sizes[1:]))
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
                    near = difflib.get_close_matches(target.removeprefix("torch.ops.aten."), _RULES, 5, 0.0)
                    fix = f"{len(_RULES)} operators are, the nearest by name {', '.join(near)}"
                    raise InputError("operator is not supported", fix=fix)
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
            for output, value in zip(_outputs(node), found if isinstance(found, list) else [found], strict=False):
                if isinstance(value, _Index):
                    self.builder.name(value.number, output, target)
                self.values[output] = value
        found = []
        for name in self.outputs:
            result = self.values.get(name)
            if not isinstance(result, _Index):
                raise InputError(f"output {name} does not depend on the image", file=self.path)
            found.append(result.number)
        if len(found) > 1:
            flat = [self.builder.reshape(k, (math.prod(self.builder.shape(k)),)) for k in found]
            found = [self.builder.concat(flat, 0)]
        return self.builder.network(found[0])

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
                found = getattr(getattr(torch.ops.aten, operator), overload)(*positional, **named)
                names = _outputs(node)
                values.update(zip(names, found if len(names) > 1 else [found], strict=True))
        return np.concatenate([values[name][0].reshape(-1).numpy() for name in self.outputs])


def _output(node: dict[str, Any]) -> str:
    return _outputs(node)[0]


def _outputs(node: dict[str, Any]) -> list[str]:
    """Names of what a node makes: one value, or a list of them."""
    entry = node["outputs"][0]
    if "as_tensors" in entry:
        return [str(part["name"]) for part in entry["as_tensors"]]
    return [str(entry["as_tensor"]["name"] if "as_tensor" in entry else entry["as_sym_int"]["as_name"])]


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


def _unary(make: Callable[[Composer, int, _Arguments], int], name: str = "self") -> Rule:
    """A function of every number."""
    return lambda r, a: _Index(make(r.builder, a.image(name), a))


def _curve(kind: Callable[..., curves.Curve]) -> Rule:
    return _unary(lambda b, x, a: b.curve(x, kind))


def _number(a: _Arguments, name: str, default: float) -> float:
    value = a.get(name)
    return default if value is None else float(np.asarray(value, np.float64).reshape(-1)[0])


def _positive(a: _Arguments, name: str, default: float) -> float:
    value = _number(a, name, default)
    if not 0.0 < value < 2.0**20:
        raise InputError(f"argument {name} = {value} is not supported", fix="it must be positive")
    return value


def _elu(b: Composer, x: int, a: _Arguments) -> int:
    a.only("input_scale", 1, 1.0)
    return b.curve(x, curves.Elu, alpha=_positive(a, "alpha", 1.0), scale=_positive(a, "scale", 1.0))


def _selu(b: Composer, x: int, a: _Arguments) -> int:
    return b.curve(x, curves.Elu, alpha=1.6732632423543772, scale=1.0507009873554805)


def _celu(b: Composer, x: int, a: _Arguments) -> int:
    alpha = _positive(a, "alpha", 1.0)
    return b.curve(x, curves.Elu, alpha=alpha, width=alpha)


def _gelu(b: Composer, x: int, a: _Arguments) -> int:
    a.only("approximate", "none", "tanh")
    return b.curve(x, curves.GeluTanh if a.get("approximate", "none") == "tanh" else curves.Gelu)


def _softplus(b: Composer, x: int, a: _Arguments) -> int:
    a.only("beta", 1, 1.0)
    if _number(a, "threshold", 20.0) < 16.0:
        raise InputError("argument threshold is not supported", fix="at least 16")
    return b.curve(x, curves.Softplus)


def _clamp(b: Composer, x: int, a: _Arguments) -> int:
    low = [_number(a, name, -np.inf) for name in ("min", "min_val") if name in a.found]
    high = [_number(a, name, np.inf) for name in ("max", "max_val") if name in a.found]
    return b.clip(x, max(low, default=-np.inf), min(high, default=np.inf))


def _hardtanh(b: Composer, x: int, a: _Arguments) -> int:
    return b.clip(x, _number(a, "min_val", -1.0), _number(a, "max_val", 1.0))


def _hard_sigmoid(b: Composer, x: int, a: _Arguments) -> int:
    return b.curve(x, curves.Clip, factor=1.0 / 6.0, offset=0.5)


def _spread(b: Composer, x: int, constant: np.ndarray) -> int:
    """The value repeated to what a constant makes of it."""
    try:
        whole = np.broadcast_shapes((1, *b.shape(x)), constant.shape)
    except ValueError:
        raise InputError(f"constant {item(constant.shape)} with an item {item(b.shape(x))}") from None
    return b.spread(x, whole[1:])


def _sum(sign: int) -> Rule:
    def rule(r: _Reader, a: _Arguments) -> _Index:
        a.only("alpha", 1)
        one, two = a.get("self"), a.get("other")
        if isinstance(one, _Index) and isinstance(two, _Index):
            return _Index(r.builder.plus((one.number, two.number), (1, sign)))
        name, other, first = ("self", "other", 1) if isinstance(one, _Index) else ("other", "self", sign)
        constant = a.needed(other)
        x = _spread(r.builder, a.image(name), constant)
        return _Index(r.builder.scale(x, first * np.ones(()), constant * (sign if name == "self" else 1)))

    return rule


def _expand(r: _Reader, a: _Arguments) -> _Index:
    x, sizes = a.image("self"), [int(v) for v in a.get("size")]
    a.ignore("implicit")
    shape = r.builder.shape(x)
    if len(sizes) != 1 + len(shape) or sizes[0] not in (-1, 1, r.batch):
        raise InputError(f"argument size = {sizes} of an item {item(shape)}", fix="keep the batch and the axes")
    whole = tuple(n if size == -1 else size for n, size in zip(shape, sizes[1:], strict=True))
    if any(n not in (1, size) for n, size in zip(shape, whole, strict=True)):
        raise InputError(f"argument size = {sizes} of an item {item(shape)}", fix="only axes of 1 are repeated")
    return _Index(r.builder.spread(x, whole))


def _log_sigmoid(b: Composer, x: int, a: _Arguments) -> int:
    # log sigmoid z = -softplus(-z)
    minus = -np.ones(())
    return b.scale(b.curve(b.scale(x, minus, None), curves.Softplus), minus, None)


def _rsub(r: _Reader, a: _Arguments) -> _Index:
    a.only("alpha", 1)
    return _Index(r.builder.scale(a.image("self"), -np.ones(()), a.needed("other")))


def _mul(r: _Reader, a: _Arguments) -> _Index:
    one, two = a.get("self"), a.get("other")
    if isinstance(one, _Index) and isinstance(two, _Index):
        return _Index(r.builder.product(one.number, two.number))
    name, other = ("self", "other") if isinstance(one, _Index) else ("other", "self")
    constant = a.needed(other)
    return _Index(r.builder.scale(_spread(r.builder, a.image(name), constant), constant, None))


def _div(r: _Reader, a: _Arguments) -> _Index:
    one, two = a.get("self"), a.get("other")
    if isinstance(two, _Index):
        inverse = r.builder.reciprocal(two.number)
        if isinstance(one, _Index):
            return _Index(r.builder.product(one.number, inverse))
        return _Index(r.builder.scale(inverse, a.needed("self"), None))
    divisor = a.needed("other")
    if not divisor.all():
        raise InputError("divides by zero", fix="check the constant")
    return _Index(r.builder.scale(_spread(r.builder, a.image("self"), divisor), 1.0 / divisor, None))


def _pow(r: _Reader, a: _Arguments) -> _Index:
    return _Index(r.builder.power(a.image("self"), _number(a, "exponent", 1.0)))


def _prelu(r: _Reader, a: _Arguments) -> _Index:
    x, slope = a.image("self"), a.needed("weight")
    return _Index(r.builder.prelu(x, slope.reshape(-1, *[1] * (len(r.builder.shape(x)) - 1))))


def _extreme(most: bool) -> Rule:
    return lambda r, a: _Index(r.builder.extreme((a.image("self"), a.image("other")), most))


def _inner(a: _Arguments, name: str, rank: int) -> list[int]:
    """Axes of the item, none of them the batch."""
    found = a.get(name)
    values = [int(v) for v in np.atleast_1d(found if found is not None else [])]
    return sorted(_axis(v, rank) for v in values) or list(range(rank - 1))


def _reduced(kind: str) -> Rule:
    def rule(r: _Reader, a: _Arguments) -> _Index:
        x = a.image("self")
        a.only("dtype", None)
        axes, keep = _inner(a, "dim", 1 + len(r.builder.shape(x))), bool(a.get("keepdim", False))
        if kind in ("mean", "sum"):
            return _Index(r.builder.reduce(x, axes, kind == "mean", keep))
        return _Index(r.builder.greatest(x, axes, keep, kind == "amax"))

    return rule


def _softmax(logarithm: bool) -> Rule:
    def rule(r: _Reader, a: _Arguments) -> _Index:
        x = a.image("self")
        a.only("dtype", None)
        return _Index(r.builder.softmax(x, _axis(int(a.get("dim")), 1 + len(r.builder.shape(x))), logarithm))

    return rule


def _layer_norm(r: _Reader, a: _Arguments) -> _Index:
    x, count = a.image("input"), len(a.get("normalized_shape"))
    a.ignore("cudnn_enable")
    rank = len(r.builder.shape(x))
    index = r.builder.normalise(x, list(range(rank - count, rank)), float(a.get("eps", 1e-5)))
    weight = a.array("weight")
    index = index if weight is None else r.builder.scale(index, weight, None)
    return _Index(r.builder.shift(index, a.array("bias")))


def _group_norm(r: _Reader, a: _Arguments) -> _Index:
    x = a.image("input")
    a.ignore("cudnn_enabled", "momentum", "running_mean", "running_var")
    a.only("use_input_stats", True)
    shape = r.builder.shape(x)
    groups = int(a.get("num_groups", shape[0]))
    if groups < 1 or shape[0] % groups:
        raise InputError(f"argument num_groups = {groups} of {shape[0]} channels", fix="it must divide them")
    split = (groups, shape[0] // groups, *shape[1:])
    index = r.builder.normalise(r.builder.reshape(x, split), list(range(1, len(split))), float(a.get("eps", 1e-5)))
    index, spread = r.builder.reshape(index, shape), (-1, *[1] * (len(shape) - 1))
    weight, bias = a.array("weight"), a.array("bias")
    index = index if weight is None else r.builder.scale(index, weight.reshape(spread), None)
    return _Index(r.builder.shift(index, None if bias is None else bias.reshape(spread)))


def _matmul(r: _Reader, a: _Arguments) -> _Index:
    one, two = a.get("self"), a.get("other")
    if isinstance(one, _Index) and isinstance(two, _Index):
        return _Index(r.builder.matmul(one.number, two.number))
    if not isinstance(one, _Index):
        raise InputError("argument self is a constant", fix="put the value that depends on the image first")
    weight = a.needed("other")
    if weight.ndim != 2:
        raise InputError(f"weights {item(weight.shape)}", fix="a matrix expected")
    return _Index(r.builder.matrix(one.number, weight.T, None))


def _conv_transpose(r: _Reader, a: _Arguments) -> _Index:
    x, weight = a.image("input"), a.needed("weight")
    pads, more = a.pair("padding", (0, 0)) * 2, a.pair("output_padding", (0, 0))
    stride, dilation = a.pair("stride", _ONES), a.pair("dilation", _ONES)
    groups = int(a.get("groups", 1))
    bias = a.array("bias")
    return _Index(r.builder.transposed_convolution(x, weight, bias, stride, dilation, pads, more, groups))


def _upsample(mode: str) -> Rule:
    def rule(r: _Reader, a: _Arguments) -> _Index:
        x = a.image("input")
        shape = r.builder.shape(x)
        align = bool(a.get("align_corners", False))
        sizes, scales = a.get("output_size"), a.get("scale_factors")
        if len(shape) != 3 or (sizes is None and scales is None):
            raise InputError(f"input {item(shape)}", fix="only maps of rows and columns are resized")
        ratios: list[Any] = [None, None] if scales is None else [float(v) for v in scales]
        found = [int(v) for v in sizes] if sizes else [int(n * f) for n, f in zip(shape[1:], ratios, strict=True)]
        r.builder.reserve(4.0 * shape[0] * found[0] * found[1])
        coordinates = "asymmetric" if mode == "nearest" else "align_corners" if align else "half_pixel"
        maps = [
            interpolation(n, m, mode, coordinates, "floor", ratio)
            for n, m, ratio in zip(shape[1:], found, ratios, strict=True)
        ]
        return _Index(r.builder.resize(x, maps))

    return rule


def _parts(r: _Reader, a: _Arguments, name: str, kind: str) -> list[_Index]:
    """Split, chunk and unbind."""
    x = a.image("self")
    shape = r.builder.shape(x)
    axis = _axis(int(a.get("dim", 0)), 1 + len(shape))
    size = shape[axis]
    given = 1 if kind == "unbind" else a.get(name)
    each = -(-size // max(1, int(given))) if kind == "chunk" else given
    sizes = [int(v) for v in each] if isinstance(each, list) else [int(each)] * (size // max(1, int(each)))
    if sum(sizes) < size and not isinstance(each, list):
        sizes.append(size - sum(sizes))
    if sum(sizes) != size or min(sizes) < 1:
        raise InputError(f"argument {name} = {given} of {size}", fix="check the sizes")
    found, done = [], 0
    for length in sizes:
        chosen = [slice(None)] * len(shape)
        chosen[axis] = slice(done, done + length)
        index = r.builder.part(x, chosen)
        if kind == "unbind":
            index = r.builder.reshape(index, (*shape[:axis], *shape[axis + 1 :]) or (1,))
        found.append(_Index(index))
        done += length
    return found


def _flip(r: _Reader, a: _Arguments) -> _Index:
    x = a.image("self")
    chosen = [slice(None)] * len(r.builder.shape(x))
    for axis in _inner(a, "dims", 1 + len(chosen)):
        chosen[axis] = slice(None, None, -1)
    return _Index(r.builder.slice(x, chosen))


def _select(r: _Reader, a: _Arguments) -> _Index:
    x = a.image("self")
    axis = _axis(int(a.get("dim")), 1 + len(r.builder.shape(x)))
    return _Index(r.builder.take(x, np.asarray(int(a.get("index"))), axis))


def _transpose(r: _Reader, a: _Arguments) -> _Index:
    x = a.image("self")
    shape = r.builder.shape(x)
    order = list(range(len(shape)))
    one, two = (_axis(int(a.get(name)), 1 + len(shape)) for name in ("dim0", "dim1"))
    order[one], order[two] = order[two], order[one]
    return _Index(r.builder.transpose(x, order))


def _unsqueeze(r: _Reader, a: _Arguments) -> _Index:
    x = a.image("self")
    shape = list(r.builder.shape(x))
    shape.insert(_axis(int(a.get("dim")), 2 + len(shape)), 1)
    return _Index(r.builder.reshape(x, shape))


def _squeeze(r: _Reader, a: _Arguments) -> _Index:
    x = a.image("self")
    shape = r.builder.shape(x)
    axes = [k for k in _inner(a, "dim", 1 + len(shape)) if shape[k] == 1]
    return _Index(r.builder.reshape(x, [n for k, n in enumerate(shape) if k not in axes] or [1]))


def _pixel_shuffle(r: _Reader, a: _Arguments) -> _Index:
    x, size = a.image("self"), int(a.get("upscale_factor"))
    c, h, w = r.builder.shape(x)
    places = r.builder.positions(x).reshape(c // size**2, size, size, h, w).transpose(0, 3, 1, 4, 2)
    return _Index(r.builder.rearranged(x, places.reshape(-1, h * size, w * size)))


def _weight_norm(r: _Reader, a: _Arguments) -> np.ndarray:
    weight, length, axis = a.needed("v"), a.needed("g"), int(a.get("dim", 0))
    others = tuple(k for k in range(weight.ndim) if k != axis % weight.ndim)
    return weight * (length / np.sqrt(np.square(weight).sum(axis=others, keepdims=True)))


def _pool(r: _Reader, a: _Arguments) -> tuple[int, Any, Any, Any, Any, Any]:
    x = a.image("self")
    if len(r.builder.shape(x)) != 3:
        raise InputError(f"input {item(r.builder.shape(x))}", fix="only two-dimensional pooling is read")
    kernel = a.pair("kernel_size", _ONES)
    stride, dilation = a.pair("stride", kernel), a.pair("dilation", _ONES)
    pads = a.pair("padding", (0, 0)) * 2
    more = r.builder.rounded_up(x, kernel, stride, dilation, pads) if a.get("ceil_mode", False) else (0, 0)
    return x, kernel, stride, dilation, pads, more


def _average_pool(r: _Reader, a: _Arguments) -> _Index:
    x, kernel, stride, _, pads, more = _pool(r, a)
    counted = bool(a.get("count_include_pad", True))
    return _Index(r.builder.average_windows(x, kernel, stride, pads, more, counted))


def _max_pool(r: _Reader, a: _Arguments) -> _Index:
    x, kernel, stride, dilation, pads, more = _pool(r, a)
    return _Index(r.builder.max_pool(x, kernel, stride, dilation, (*pads[:2], pads[2] + more[0], pads[3] + more[1])))


def _adaptive(r: _Reader, a: _Arguments) -> _Index:
    x, size = a.image("self"), a.pair("output_size", _ONES)
    shape = r.builder.shape(x)
    if len(shape) != 3 or shape[1] % size[0] or shape[2] % size[1]:
        raise InputError(f"argument output_size = {list(size)} of {item(shape)}", fix="it must divide the size")
    kernel = shape[1] // size[0], shape[2] // size[1]
    return _Index(r.builder.average_pool(x, kernel, kernel, (0, 0, 0, 0), True))


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
    step = int(a.get("step", 1))
    if dim % rank == 0:
        if start not in (None, 0) or (end is not None and end < 2**31):
            raise InputError("takes part of the batch", fix="keep the batch")
        return _Index(x)
    chosen = [slice(None)] * (rank - 1)
    chosen[_axis(dim, rank)] = slice(start, end, step)
    return _Index(r.builder.part(x, chosen))


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
    a.only("mode", "constant", "reflect", "replicate")
    mode, value = a.get("mode", "constant"), a.get("value")
    if len(pads) % 2 or len(pads) > 2 * len(shape):
        raise InputError(f"argument pad = {pads}", fix="two numbers an axis, none of the batch")
    before, after = [0] * len(shape), [0] * len(shape)
    for k in range(len(pads) // 2):
        before[-1 - k], after[-1 - k] = pads[2 * k], pads[2 * k + 1]
    mode = "edge" if mode == "replicate" else mode
    return _Index(r.builder.pad(x, before, after, mode, 0.0 if value is None else float(value)))


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


_VIEWS = frozenset(
    (
        "alias",
        "chunk",
        "contiguous",
        "dropout",
        "expand",
        "feature_dropout",
        "flatten",
        "permute",
        "reshape",
        "select",
        "slice",
    )
)
_VIEWS |= {"expand", "split", "split_with_sizes", "squeeze", "transpose", "unbind", "unsqueeze", "view"}
_RULES: dict[str, Rule] = {
    "_weight_norm.default": _weight_norm,
    "abs.default": _curve(curves.Abs),
    "adaptive_avg_pool2d.default": _adaptive,
    "add.Tensor": _sum(1),
    "add_.Tensor": _sum(1),
    "alias.default": _same,
    "amax.default": _reduced("amax"),
    "amin.default": _reduced("amin"),
    "avg_pool2d.default": _average_pool,
    "batch_norm.default": _batch_norm,
    "cat.default": _cat,
    "celu.default": _unary(_celu),
    "chunk.default": lambda r, a: _parts(r, a, "chunks", "chunk"),
    "clamp.default": _unary(_clamp),
    "clone.default": _same,
    "contiguous.default": _same,
    "conv2d.default": _conv,
    "conv_transpose2d.input": _conv_transpose,
    "div.Tensor": _div,
    "dropout.default": _dropout,
    "elu.default": _unary(_elu),
    "erf.default": _curve(curves.Erf),
    "exp.default": _curve(curves.Exp),
    "expand.default": _expand,
    "feature_dropout.default": _dropout,
    "flatten.using_ints": _flatten,
    "flip.default": _flip,
    "gelu.default": _unary(_gelu),
    "group_norm.default": _group_norm,
    "hardsigmoid.default": _unary(_hard_sigmoid),
    "hardswish.default": _curve(curves.HardSwish),
    "hardswish_.default": _curve(curves.HardSwish),
    "hardtanh.default": _unary(_hardtanh),
    "hardtanh_.default": _unary(_hardtanh),
    "instance_norm.default": _group_norm,
    "layer_norm.default": _layer_norm,
    "leaky_relu.default": _unary(lambda b, x, a: b.prelu(x, np.asarray(_number(a, "negative_slope", 0.01)))),
    "leaky_relu_.default": _unary(lambda b, x, a: b.prelu(x, np.asarray(_number(a, "negative_slope", 0.01)))),
    "linear.default": _linear,
    "log.default": _unary(lambda b, x, a: b.logarithm(x)),
    "log_sigmoid.default": _unary(_log_sigmoid),
    "log_softmax.int": _softmax(True),
    "matmul.default": _matmul,
    "max_pool2d.default": _max_pool,
    "maximum.default": _extreme(True),
    "mean.dim": _reduced("mean"),
    "minimum.default": _extreme(False),
    "mish.default": _curve(curves.Mish),
    "mul.Tensor": _mul,
    "neg.default": _unary(lambda b, x, a: b.scale(x, -np.ones(()), None)),
    "pad.default": _pad,
    "permute.default": _permute,
    "pixel_shuffle.default": _pixel_shuffle,
    "pow.Tensor_Scalar": _pow,
    "prelu.default": _prelu,
    "reciprocal.default": _unary(lambda b, x, a: b.reciprocal(x)),
    "relu.default": _unary(lambda b, x, a: b.leaky_relu(x, 0.0)),
    "relu6.default": _unary(lambda b, x, a: b.clip(x, 0.0, 6.0)),
    "relu_.default": _unary(lambda b, x, a: b.leaky_relu(x, 0.0)),
    "reshape.default": _view,
    "rsub.Scalar": _rsub,
    "select.int": _select,
    "selu.default": _unary(_selu),
    "sigmoid.default": _unary(lambda b, x, a: b.sigmoid(x)),
    "silu.default": _curve(curves.Silu),
    "silu_.default": _curve(curves.Silu),
    "slice.Tensor": _slice,
    "softmax.int": _softmax(False),
    "softplus.default": _unary(_softplus),
    "split.Tensor": lambda r, a: _parts(r, a, "split_size", "split"),
    "split_with_sizes.default": lambda r, a: _parts(r, a, "split_sizes", "split"),
    "sqrt.default": _unary(lambda b, x, a: b.power(x, 0.5)),
    "squeeze.dims": _squeeze,
    "squeeze.dim": _squeeze,
    "sub.Tensor": _sum(-1),
    "sum.dim_IntList": _reduced("sum"),
    "sym_size.int": _batch_size,
    "tanh.default": _unary(lambda b, x, a: b.tanh(x)),
    "transpose.int": _transpose,
    "unbind.int": lambda r, a: _parts(r, a, "dim", "unbind"),
    "unsqueeze.default": _unsqueeze,
    "upsample_bilinear2d.vec": _upsample("linear"),
    "upsample_nearest2d.vec": _upsample("nearest"),
    "view.default": _view,
}
