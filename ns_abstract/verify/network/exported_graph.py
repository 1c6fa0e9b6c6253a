"""The graph and the weights in a file of `torch.export.save`, and what turns its nodes into layers.

The archive holds the graph as JSON and the weights as raw bytes. `torch.export.load` would unpickle other
members; they are not touched here. Weights that were pickled are refused.
"""

from __future__ import annotations

import difflib
import json
import math
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from ns_abstract.arithmetic.network_charges import (
    DOUBTS_UP,
    FLUSH,
    FUNCTION_FLUSHES,
    LEAST_DIVISOR,
    OVERFLOW,
    OWN_WEIGHT_NORM,
    WEIGHT_NORM,
    gamma,
)
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import show
from ns_abstract.verify.network.chosen import chosen_output
from ns_abstract.verify.network.compose import Composer
from ns_abstract.verify.network.doubtful import Doubts
from ns_abstract.verify.network.graph import Network, item

_LARGEST_GRAPH = 64 << 20
_LARGEST_WEIGHTS = 4 << 30
#: torch's numbers of scalar types.
_TYPES = {4: np.dtype(np.int32), 5: np.dtype(np.int64), 7: np.dtype(np.float32), 8: np.dtype(np.float64)}
_DTYPES = {4: torch.int32, 5: torch.int64, 7: torch.float32, 8: torch.float64, 12: torch.bool}
#: Kinds of arguments that are what they say; and those that say where and how numbers are kept.
_PLAIN = frozenset(("as_int", "as_ints", "as_bool", "as_bools", "as_string"))
_PLAIN |= {"as_scalar_type", "as_device", "as_layout", "as_memory_format"}
#: Nodes that make nothing, and changes in place that change no number.
_CHECKS = frozenset(("torch.ops.aten._assert_tensor_metadata.default",))
_KEPT = frozenset(("torch.ops.aten.detach_.default",))
#: How often tensors may share the bytes of a file.
_SHARED = 4
FIX = "save it again with torch.export.save"


def contents(path: Path, archive: zipfile.ZipFile) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The graph and the weights by name."""

    def member(name: str, limit: int) -> bytes:
        found = [info for info in archive.infolist() if info.filename == name or info.filename.endswith("/" + name)]
        if len(found) != 1:
            raise InputError(f"holds {len(found)} members {name}", file=path, fix=FIX)
        if found[0].compress_type != zipfile.ZIP_STORED:
            raise InputError(f"{name} is compressed, which torch never writes", file=path, fix=FIX)
        if found[0].file_size > limit:
            raise InputError(f"{name} has {found[0].file_size:,} bytes", file=path, fix=f"at most {limit:,} are read")
        return archive.read(found[0])

    if member("byteorder", 64) != b"little":
        raise InputError("was written on a big-endian machine", file=path, fix=FIX)
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
                raise InputError("is pickled, which is not read", file=path, field=field, fix=FIX)
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
                raise InputError(problem, file=path, field=field, fix=FIX)
            left -= claimed * kind.itemsize
            if left < 0:
                raise InputError("shares its numbers with too many others", file=path, field=field, fix=FIX)
            steps = tuple(s * kind.itemsize for s in strides)
            array = np.array(np.lib.stride_tricks.as_strided(data[first:], shape, steps))
            if kind.kind == "f" and not np.isfinite(array).all():
                raise InputError("holds numbers that are not finite", file=path, field=field, fix="train again")
            weights[name] = array
    return model["graph_module"], weights


class Arguments:
    """A node's arguments, each of which a rule must ask for."""

    def __init__(self, reader: Reader, node: dict[str, Any]) -> None:
        self.reader, self.node = reader, node
        self.found = {entry["name"]: reader.value(entry["arg"]) for entry in node["inputs"]}
        self.asked: set[str] = set()

    def get(self, name: str, default: Any = None) -> Any:
        self.asked.add(name)
        return self.found.get(name, default)

    def image(self, name: str) -> int:
        """Index of the node that makes an argument."""
        value = self.get(name)
        if not isinstance(value, Index):
            raise InputError(f"argument {name} is a constant", fix="it must depend on the image")
        return value.number

    def array(self, name: str) -> np.ndarray | None:
        value = self.get(name)
        if isinstance(value, Index):
            raise InputError(f"argument {name} depends on the image", fix="it must be a constant")
        found = None if value is None else np.asarray(value, np.float64)
        if found is not None and not np.isfinite(found).all():
            raise InputError(f"argument {name} is not finite", fix="write the network without that")
        return found

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

    @property
    def constant(self) -> bool:
        """Whether nothing in it depends on the image."""
        return not any(isinstance(part, Index) for part in self._parts)

    @property
    def mixed(self) -> bool:
        """Whether a value in it has the batch inside its shape."""
        return any(isinstance(part, Index) and part.whole is not None for part in self._parts)

    @property
    def _parts(self) -> list[Any]:
        return [part for value in self.found.values() for part in (value if isinstance(value, list) else [value])]

    def done(self) -> None:
        for name, value in self.found.items():
            if name not in self.asked and value is not None:
                raise InputError(f"argument {name} is not supported", fix="export without it")


class Index:
    """A node of the network among constants.

    ``whole``: its shape in the file for a batch of 1, where that is not the batch and the item.
    """

    def __init__(self, number: int, whole: tuple[int, ...] | None = None) -> None:
        self.number, self.whole = number, whole


#: Makes what one node's arguments become: an `Index`, a number, or a list of them.
Rule = Callable[["Reader", Arguments], Any]


class Operators(NamedTuple):
    """What is known of torch's operators, by name and overload.

    Attributes:
        rules: How they are read.
        folded: Others that are read where all is constant.
        anywhere: Those that read values with the batch inside their shape, too.
        views: Names of those whose results may share memory with what they are given.
    """

    rules: Mapping[str, Rule]
    folded: frozenset[str]
    anywhere: frozenset[str]
    views: frozenset[str]


class Reader:
    """Turns one graph's nodes into layers."""

    def __init__(
        self,
        path: Path,
        module: dict[str, Any],
        weights: dict[str, np.ndarray],
        operators: Operators,
        output: str | None = None,
    ) -> None:
        self.path, self.graph, self.operators = path, module["graph"], operators
        self.constants: dict[str, np.ndarray] = {}
        images = []
        for spec in module["signature"]["input_specs"]:
            kind, content = next(iter(spec.items()))
            if kind == "user_input":
                images.append(content["arg"]["as_tensor"]["name"])
                continue
            stored = content.get(f"{kind}_name") or content.get("tensor_constant_name")
            if stored not in weights:
                raise InputError(f"input {stored!r} ({kind}) is not stored", file=path, fix=FIX)
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
        names = [str(result["as_tensor"]["name"]) for result in results]
        shapes = [[size.get("as_int", "?") for size in self.graph["tensor_values"][name]["sizes"]] for name in names]
        self.output = chosen_output(path, dict(zip(names, shapes, strict=True)), output)
        sizes = [size.get("as_int", 0) for size in self.graph["tensor_values"][self.image]["sizes"]]
        if len(sizes) < 2 or min(sizes[1:]) < 1:
            raise InputError(f"input has sizes {sizes}", file=path, fix="only the batch may be free")
        self.batch = max(1, sizes[0])
        #: Constants of the file alone; those that nodes make of them come to `constants`.
        self.stored = dict(self.constants)
        self.builder = Composer(path, tuple(sizes[1:]))
        self.values: dict[str, Any] = {self.image: Index(0)}
        #: how far computed weights may be from what `constants` holds
        self.doubted: dict[str, Doubts] = {}

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
        if kind == "as_optional_tensors":
            return [self.value(entry) for entry in content]
        if kind in ("as_float", "as_floats"):
            return _floats(content)
        if kind in _PLAIN:
            return content
        raise InputError(f"an argument of kind {kind} is not supported", fix=FIX)

    def _named(self, name: str) -> Any:
        if name in self.values:
            return self.values[name]
        if name in self.constants:
            return self.constants[name]
        raise InputError(f"value {name!r} is not known, or was changed in place", fix="write the network without that")

    def _symbol(self, entry: dict[str, Any]) -> int:
        return int(entry["as_int"]) if "as_int" in entry else int(self._named(entry["as_name"]))

    def network(self) -> Network:
        needed = self._ancestors()
        for node in self.graph["nodes"]:
            target = str(node["target"])
            if target in _CHECKS or not needed.intersection(_outputs(node)):
                continue
            name = _output(node)
            try:
                short = target.removeprefix("torch.ops.aten.")
                rule = self.operators.rules.get(short)
                if rule is None and short not in self.operators.folded:
                    near = difflib.get_close_matches(short, self.operators.rules, 5, 0.0)
                    fix = f"{len(self.operators.rules)} operators are, the nearest by name {', '.join(near)}"
                    raise InputError("operator is not supported", fix=fix)
                arguments = Arguments(self, node)
                if arguments.constant:
                    found = self._folded(node)
                else:
                    if rule is None:
                        raise InputError(
                            "operator is not supported on what depends on the image", fix="only constants are read here"
                        )
                    if arguments.mixed and short not in self.operators.anywhere:
                        raise InputError("works on a value with the batch inside its shape", fix="move the batch first")
                    found = rule(self, arguments)
                    arguments.done()
                    self._charge(node, short, found)
            except InputError as error:
                if error.file is not None:
                    raise
                raise InputError(
                    error.problem, file=self.path, field=f"node {name} ({target})", fix=error.fix
                ) from None
            self._forget_changed(target, node)
            for output, value in zip(_outputs(node), found if isinstance(found, list) else [found], strict=False):
                if isinstance(value, Index):
                    self.constants.pop(output, None)
                    self.builder.name(value.number, output, target)
                    self.values[output] = value
                else:
                    self.constants[output] = value
        result = self.values.get(self.output)
        if not isinstance(result, Index):
            raise InputError(f"output {self.output} does not depend on the image", file=self.path)
        return self.builder.network(result.number, self.output)

    def _ancestors(self) -> set[str]:
        """Names that the output depends on; what is changed in place may be shared by any of them."""
        needed = {self.output}
        for node in reversed(self.graph["nodes"]):
            changes = str(node["target"]).rpartition(".")[0].endswith("_")
            if changes or needed.intersection(_outputs(node)):
                needed.update(_outputs(node), _read(node["inputs"]))
        return needed

    def _made(self, name: str) -> dict[str, Any] | None:
        """The node that makes a value."""
        return next((n for n in self.graph["nodes"] if str(n["target"]) not in _CHECKS and name in _outputs(n)), None)

    def _forget_changed(self, target: str, node: dict[str, Any]) -> None:
        """What an operator changes in place, or may share memory with that, is not to be read again."""
        if target.split(".")[-2].endswith("_") and target not in _KEPT:
            changed = node["inputs"][0]["arg"]["as_tensor"]["name"]
            number = getattr(self.values.get(changed), "number", None)
            made = self._made(changed)
            while made is not None and str(made["target"]).split(".")[-2] == "alias":
                made = self._made(made["inputs"][0]["arg"]["as_tensor"]["name"])
            if made is None or str(made["target"]).split(".")[-2] in self.operators.views:
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
        values: dict[str, Any] = {name: torch.from_numpy(array) for name, array in self.stored.items()}
        values[self.image] = torch.from_numpy(np.repeat(image, self.batch, 0))
        with torch.no_grad():
            for node in self.graph["nodes"]:
                if str(node["target"]) in _CHECKS:
                    continue
                found = _applied(node, values)
                names = _outputs(node)
                values.update(zip(names, found if len(names) > 1 else [found], strict=True))
        return values[self.output][0].reshape(-1).numpy()

    def by_torch(self, node: dict[str, Any], values: dict[str, np.ndarray]) -> Any:
        """What torch's operator of a node makes of its constants and of ``values`` by name, once there is room for it.

        Raises:
            InputError: There is none, or torch refuses.
        """
        known = {**self.constants, **values}
        used = {name: known[name] for entry in node["inputs"] for name in named_values(entry["arg"]) if name in known}
        given = {name: v if isinstance(v, int) else torch.from_numpy(np.asarray(v)) for name, v in used.items()}
        shapes = {name: v.to("meta") if isinstance(v, torch.Tensor) else v for name, v in given.items()}
        try:
            size = _applied(node, shapes, "meta")
            for part in size if isinstance(size, (list, tuple)) else [size]:
                self.builder.reserve(2.0 * part.numel() if isinstance(part, torch.Tensor) else 1.0)
            return _applied(node, given)
        except InputError:
            raise
        except (RuntimeError, TypeError, ValueError, IndexError, KeyError) as error:
            raise InputError(f"torch refuses it ({show(str(error))})", fix=FIX) from None

    def _folded(self, node: dict[str, Any]) -> Any:
        """The constants that a node makes of constants."""
        target = str(node["target"])
        if target.split(".")[-2].endswith("_") and target not in _KEPT:
            raise InputError("changes a constant in place", fix="write the network without that")
        self._charge(node, "", None)
        found = self.by_torch(node, {})
        parts = found if isinstance(found, (list, tuple)) else [found]
        made = [part.contiguous().numpy() if isinstance(part, torch.Tensor) else part for part in parts]
        if ".aten._weight_norm." in target:
            # a sum of squares, its root, a quotient and a product: nothing cancels
            direction, size = (self._named(entry["arg"]["as_tensor"]["name"]) for entry in node["inputs"][:2])
            wide = self.by_torch(node, {k: np.asarray(v, np.float64) for k, v in self.constants.items()})
            made = [wide.numpy()]
            together = tuple(k for k, n in enumerate(np.shape(size)) if n == 1)
            squares = np.square(np.asarray(direction, np.float64)).sum(together)
            if not bool(((squares > LEAST_DIVISOR) & (squares < OVERFLOW)).all()):
                raise InputError("divides by a norm that float32 cannot compute with", fix="train the network again")
            # squares that are flushed are a quarter of a unit of that, each
            count = np.size(direction) / max(1, np.size(size)) + WEIGHT_NORM
            single = gamma(count) * DOUBTS_UP * np.abs(made[0]) + FUNCTION_FLUSHES * FLUSH * (1.0 + np.abs(made[0]))
            self.doubted[_output(node)] = (OWN_WEIGHT_NORM * np.abs(made[0]), single)
        elif any(isinstance(v, np.ndarray) and v.dtype == np.float32 for v in made):
            self._check_exact(node, made)
        return made if isinstance(found, (list, tuple)) else made[0]

    def _charge(self, node: dict[str, Any], short: str, found: Any) -> None:
        """Charge what a layer's weights may be off, where they are computed."""
        names = [name for entry in node["inputs"] for name in named_values(entry["arg"]) if name in self.doubted]
        if not names:
            return
        if short not in ("conv2d.default", "linear.default") or len(names) > 1:
            raise InputError("reads a constant that float32 rounds", fix="register it as a buffer")
        self.builder.doubt(found.number, self.doubted[names[0]], None)

    def _check_exact(self, node: dict[str, Any], made: list[Any]) -> None:
        """Refuse results that float32 rounds: another order of the same sums gives others (N23)."""
        wide = {k: v.astype(np.float64) for k, v in self.constants.items() if getattr(v, "dtype", None) == np.float32}
        again = self.by_torch(node, wide)
        parts = again if isinstance(again, (list, tuple)) else [again]
        for one, two in zip(made, parts, strict=True):
            if not isinstance(one, np.ndarray) or one.dtype != np.float32:
                continue
            if not np.array_equal(one.astype(np.float64), two.double().numpy()):
                raise InputError("computes a constant that float32 rounds", fix="register the result as a buffer")


def _floats(content: Any) -> Any:
    """Numbers of a file, which writes infinite ones as words."""
    return [float(v) for v in content] if isinstance(content, list) else float(content)


def named_values(argument: dict[str, Any]) -> list[str]:
    """Names of the tensors and sizes in an argument."""
    kind, content = next(iter(argument.items()))
    if kind == "as_optional_tensors":
        return [name for entry in content for name in named_values(entry)]
    if kind in ("as_tensor", "as_tensors"):
        return [str(entry["name"]) for entry in (content if kind == "as_tensors" else [content])]
    if kind in ("as_sym_int", "as_sym_ints"):
        return [str(e["as_name"]) for e in (content if kind == "as_sym_ints" else [content]) if "as_name" in e]
    return []


def _applied(node: dict[str, Any], values: dict[str, Any], device: str = "cpu") -> Any:
    """Torch's own operator of a node on values by name; what it makes of nothing is made on ``device``."""

    def take(argument: dict[str, Any]) -> Any:
        kind, content = next(iter(argument.items()))
        if kind == "as_tensor":
            return values[content["name"]]
        if kind == "as_tensors":
            return [values[entry["name"]] for entry in content]
        if kind == "as_optional_tensors":
            return [take(entry) for entry in content]
        if kind in ("as_float", "as_floats"):
            return _floats(content)
        if kind == "as_scalar_type":
            return _DTYPES[content]
        if kind == "as_device":
            return device
        if kind in ("as_layout", "as_memory_format"):
            return None
        if kind in ("as_sym_int", "as_sym_ints"):
            entries = content if kind == "as_sym_ints" else [content]
            found = [e["as_int"] if "as_int" in e else values[e["as_name"]] for e in entries]
            return found if kind == "as_sym_ints" else found[0]
        return None if kind == "as_none" else content

    _, _, _, operator, overload = str(node["target"]).split(".")
    positional = [take(e["arg"]) for e in node["inputs"] if e.get("kind", 1) == 1]
    named = {e["name"]: take(e["arg"]) for e in node["inputs"] if e.get("kind", 1) != 1}
    return getattr(getattr(torch.ops.aten, operator), overload)(*positional, **named)


def _read(inputs: Any) -> set[str]:
    """Names of tensors and numbers in the arguments of a node."""
    if isinstance(inputs, list):
        return {name for part in inputs for name in _read(part)}
    if not isinstance(inputs, dict):
        return set()
    own = {inputs[key] for key in ("name", "as_name") if isinstance(inputs.get(key), str)}
    return own.union(*(_read(part) for part in inputs.values()))


def _output(node: dict[str, Any]) -> str:
    return _outputs(node)[0]


def _outputs(node: dict[str, Any]) -> list[str]:
    """Names of what a node makes: one value, or a list of them."""
    entry = node["outputs"][0]
    if "as_tensors" in entry:
        return [str(part["name"]) for part in entry["as_tensors"]]
    return [str(entry["as_tensor"]["name"] if "as_tensor" in entry else entry["as_sym_int"]["as_name"])]
