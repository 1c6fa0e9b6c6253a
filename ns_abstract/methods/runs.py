"""Read the run folders that ``ns-train`` writes, without Nerfstudio and without running code in them.

A run folder holds ``config.yml``, ``dataparser_transforms.json`` and
``nerfstudio_models/step-*.ckpt``. Only paths relative to ``config.yml`` are used, so a folder
may be moved. Nothing here is specific to one method.
"""

from __future__ import annotations

import math
import os
import pickle
import pickletools
import re
import warnings
import zipfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import yaml
import yaml.composer
import yaml.constructor
from numpy.typing import NDArray

from ns_abstract.io.errors import InputError, visible
from ns_abstract.io.jsonio import FIX_ACCESS, file_size, is_number, load_json, read_text, show
from ns_abstract.methods.transform import DataparserTransform

if TYPE_CHECKING:
    import torch

CONFIG_NAME = "config.yml"
TRANSFORMS_NAME = "dataparser_transforms.json"
DEFAULT_MODEL_FOLDER = "nerfstudio_models"

CONFIG_BYTES_LIMIT = 2**20
CONFIG_NODES_LIMIT = 100_000
CONFIG_DEPTH_LIMIT = 64
NUMBER_CHARACTERS_LIMIT = 300
TRANSFORMS_BYTES_LIMIT = 2**20
PICKLE_BYTES_LIMIT = 16 * 2**20
ARCHIVE_MEMBERS_LIMIT = 100_000

_PYTHON_TAG = "tag:yaml.org,2002:python/"
_MERGE_TAG = "tag:yaml.org,2002:merge"
_NUMBER_TAGS = {f"tag:yaml.org,2002:{python}{kind}" for python in ("", "python/") for kind in ("int", "long", "float")}
_CHECKPOINT_NAME = re.compile(r"step-(\d{1,18})\.ckpt")
_RECOPY = "copy the checkpoint again from the run"
_PICKLE_MODULES = {"torch", "collections", "numpy", "_codecs"}
# Schedulers and optimizers hold numpy scalars; none of their values is used.
_NUMPY_NAMES = (
    "numpy.core.multiarray.scalar",
    "numpy._core.multiarray.scalar",
    "numpy.dtype",
    *(
        f"numpy.dtypes.{kind}DType"
        for kind in ("Bool", "Float16", "Float32", "Float64", "Int8", "Int16", "Int32", "Int64")
    ),
    *(f"numpy.dtypes.UInt{bits}DType" for bits in (8, 16, 32, 64)),
)
# nerfstudio/utils/colors.py; "random" is what Splatfacto shows outside training.
_COLORS = {
    "white": (1.0, 1.0, 1.0),
    "black": (0.0, 0.0, 0.0),
    "red": (1.0, 0.0, 0.0),
    "green": (0.0, 1.0, 0.0),
    "blue": (0.0, 0.0, 1.0),
}


@dataclass(frozen=True)
class Tagged:
    """A YAML node whose tag names a Python object: the tag and the plain value below it."""

    tag: str
    value: Any


@dataclass(frozen=True)
class RunConfig:
    """The parts of ``config.yml`` that matter after training.

    Attributes:
        file: The configuration file.
        folder: The folder that holds it.
        method_name: Name given to ns-train, such as "splatfacto"; "unknown" if absent.
        experiment_name: Name of the experiment, or the folder's name if absent.
        model: ``pipeline.model`` as a mapping; Python objects in it are :class:`Tagged`.
        model_folder: The folder of the checkpoints.
        root: The whole file as a mapping.
    """

    file: Path
    folder: Path
    method_name: str
    experiment_name: str
    model: dict[str, Any]
    model_folder: Path
    root: dict[str, Any]

    def integer(self, name: str, default: int, least: int, most: int | None = None) -> int:
        """Integer field of ``pipeline.model`` in [least, most]; ``default`` if absent."""
        value = self.model.get(name, default)
        fits = isinstance(value, int) and not isinstance(value, bool)
        if not fits or value < least or (most is not None and value > most):
            wanted = f"at least {least}" if most is None else f"from {least} to {most}"
            raise self._error(name, value, f"an integer {wanted}")
        return value

    def choice(self, name: str, default: str, options: tuple[str, ...]) -> str:
        """Text field of ``pipeline.model`` out of ``options``; ``default`` if absent."""
        value = self.model.get(name, default)
        if not isinstance(value, str) or value not in options:
            raise self._error(name, value, f"one of {', '.join(options)}")
        return value

    def color(self, name: str, default: str, extra: dict[str, tuple[float, float, float]]) -> NDArray[np.float32]:
        """RGB field of ``pipeline.model`` as float32 [3] in [0, 1]; ``default`` if absent.

        Args:
            name: Field name.
            default: Colour name used if the field is absent.
            extra: Names beyond Nerfstudio's own, with their colours.
        """
        value = self.model.get(name, default)
        if isinstance(value, str):
            found = extra.get(value) or _COLORS.get(value.lower())
            if found is not None:
                return np.array(found, np.float32)
        elif isinstance(value, (list, tuple)) and len(value) == 3 and all(map(is_number, value)):
            if all(0 <= part <= 1 for part in value):
                return np.array(value, np.float32)
        names = ", ".join([*extra, *_COLORS])
        raise self._error(name, value, f"{names} or three numbers from 0 to 1")

    def _error(self, name: str, value: Any, wanted: str) -> InputError:
        return InputError(f"found {show(value)}", file=self.file, field=f"pipeline.model.{name}", fix=f"write {wanted}")


def read_config(path: str | os.PathLike[str]) -> RunConfig:
    """Read ``config.yml``.

    Args:
        path: The file, or the folder that holds it.

    Raises:
        InputError: The file is absent, not YAML, too large, or lacks ``pipeline.model``.
    """
    file = Path(path)
    if os.path.isdir(file):
        file = file / CONFIG_NAME
        file_size(file, "run configuration", fix="give a folder that ns-train wrote, or its config.yml")
    text = read_text(file, "run configuration", CONFIG_BYTES_LIMIT)
    root = as_mapping(_parse_yaml(text, file))
    if root is None:
        raise InputError("the top level is not a mapping", file=file, fix="give the config.yml of ns-train")
    pipeline = _section(root, "pipeline", "pipeline", file)
    model = _section(pipeline, "model", "pipeline.model", file)
    folder = file.parent
    return RunConfig(
        file=file,
        folder=folder,
        method_name=_name(root, "method_name", "unknown", file),
        experiment_name=_name(root, "experiment_name", visible(folder.resolve().name) or "run", file),
        model=model,
        model_folder=folder / _model_folder(root, file),
        root=root,
    )


def as_mapping(value: Any) -> dict[str, Any] | None:
    """The mapping that a YAML value holds, with a Python object's tag removed; None if it holds none."""
    if isinstance(value, Tagged):
        inner = value.value
        if isinstance(inner, dict) and isinstance(inner.get("state"), dict) and "object/" in value.tag:
            return inner["state"]
        return inner if isinstance(inner, dict) else None
    return value if isinstance(value, dict) else None


def find_checkpoint(run: RunConfig) -> Path:
    """The checkpoint of the highest step in the run's model folder.

    Raises:
        InputError: There is none, or the folder cannot be listed.
    """
    folder = run.model_folder
    try:
        names = os.listdir(folder)
    except FileNotFoundError:
        raise InputError(
            "no such folder of checkpoints", file=folder, fix="copy it from the machine that trained the run"
        ) from None
    except OSError as error:
        raise InputError(
            f"folder of checkpoints cannot be listed: {error.strerror or type(error).__name__}",
            file=folder,
            fix=FIX_ACCESS,
        ) from None
    matches = [match for name in names if (match := _CHECKPOINT_NAME.fullmatch(name))]
    if not matches:
        raise InputError("no step-*.ckpt here", file=folder, fix="train the run until it saves a checkpoint")
    return folder / max(matches, key=lambda match: (int(match[1]), len(match[1])))[0]


def read_dataparser_transform(run: RunConfig) -> tuple[DataparserTransform, tuple[str, ...]]:
    """Read ``dataparser_transforms.json`` beside ``config.yml``.

    Returns:
        The transform, and notes about what was assumed: without the file it is the identity.

    Raises:
        InputError: The file exists and is not what Nerfstudio writes.
    """
    path = run.folder / TRANSFORMS_NAME
    if not os.path.lexists(path):
        note = f"{path} is missing: dataset units are taken to be those of the normalised frame"
        return DataparserTransform(), (note,)
    data = load_json(path, "dataparser transform", TRANSFORMS_BYTES_LIMIT)
    if not isinstance(data, dict):
        raise InputError(f"found {show(data)}", file=path, field="top level", fix="write an object")
    rows = data.get("transform")
    if not (isinstance(rows, list) and len(rows) == 3 and all(_is_list(row, 4) for row in rows)):
        fix = "write three rows of four numbers"
        raise InputError("not a 3x4 matrix", file=path, field="transform", fix=fix)
    for i, row in enumerate(rows):
        for j, value in enumerate(row):
            if not is_number(value):
                field = f"transform[{i}][{j}]"
                raise InputError(f"found {show(value)}", file=path, field=field, fix="write a finite number")
    matrix = np.array(rows, np.float64)
    with np.errstate(all="ignore"):
        determinant = float(np.linalg.det(matrix[:, :3]))
    if not math.isfinite(determinant) or abs(determinant) < 1e-12:
        raise InputError(
            f"the 3x3 part cannot be inverted (determinant {determinant:.3g})",
            file=path,
            field="transform",
            fix="copy the file again from the run",
        )
    scale = data.get("scale")
    if not is_number(scale) or not scale > 0:
        raise InputError(f"found {show(scale)}", file=path, field="scale", fix="write a number above 0")
    return DataparserTransform(matrix=matrix, scale=float(scale)), ()


def available_memory() -> int | None:
    """Bytes of memory this process may still take, or None where the system does not say."""
    amounts = []
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                amounts.append(int(line.split()[1]) * 1024)
    except (OSError, ValueError, IndexError):
        pass
    try:
        amounts.append(int(Path("/sys/fs/cgroup/memory.max").read_text()))
    except (OSError, ValueError):
        pass
    return min(amounts) if amounts else None


def check_memory(needed: int, file: Path, what: str) -> None:
    """Raise InputError if ``needed`` bytes are more than the memory available."""
    available = available_memory()
    if available is not None and needed > available:
        raise InputError(
            f"{what} needs about {needed / 2**30:.1f} GiB of memory, {available / 2**30:.1f} GiB are free",
            file=file,
            fix="use a machine with more memory or a smaller scene",
        )


def read_model_state(path: Path) -> dict[str, torch.Tensor]:
    """Read the model's tensors from a checkpoint, on the CPU, without running code in the file.

    Checksums of all members are compared first. Tensors are views of the mapped file.

    Args:
        path: A ``step-*.ckpt`` file.

    Returns:
        The state of the model: keys as in ``Model.state_dict()``, that is without the
        ``_model.`` prefix of the pipeline and the ``module.`` of distributed training.

    Raises:
        InputError: The file is damaged, holds other Python objects than tensors and plain
            values, or has no ``pipeline``.
    """
    size = file_size(path, "checkpoint")
    check_memory(size, path, "the checkpoint")
    _check_archive(path, size)
    root = _load_checkpoint(path)
    pipeline = root.get("pipeline") if isinstance(root, dict) else None
    if not isinstance(pipeline, dict):
        raise InputError("no model state", file=path, field="pipeline", fix="give a checkpoint that ns-train wrote")
    state = {}
    for key, value in pipeline.items():
        if not isinstance(key, str):
            raise InputError(f"key {show(key)} is not text", file=path, field="pipeline", fix=_RECOPY)
        name = key.removeprefix("module.")
        if name.startswith("_model."):
            state[name.removeprefix("_model.")] = value
    # Nerfstudio removes a second "module." only if every key has it (pipelines/base_pipeline.py).
    if state and all(key.startswith("module.") for key in state):
        state = {key.removeprefix("module."): value for key, value in state.items()}
    return state


def tensor_to_float32(value: Any, file: Path, field: str) -> NDArray[np.float32]:
    """A checkpoint tensor as a float32 array of the same shape, copied out of the file.

    Args:
        value: What the checkpoint holds under ``field``.
        file: The checkpoint.
        field: Name for messages.

    Raises:
        InputError: Not a dense tensor of float16, bfloat16, float32 or float64, or a value is
            not finite in float32.
    """
    import torch

    if not isinstance(value, torch.Tensor):
        raise InputError(f"found {show(value)}, not a tensor", file=file, field=field, fix=_RECOPY)
    kind = _unusual_kind(value)
    if kind:
        raise InputError(f"{kind} tensor", file=file, field=field, fix="save it as a dense float32 tensor")
    # Strides of 0 let a small file claim any size.
    if value.numel() * value.element_size() > value.untyped_storage().nbytes():
        raise InputError("claims more values than the file holds", file=file, field=field, fix=_RECOPY)
    try:
        array = np.array(value.detach().resolve_neg().to(torch.float32).numpy(), np.float32, order="C")
    except (RuntimeError, TypeError, ValueError) as error:
        problem = f"cannot be read: {_first_line(error)}"
        raise InputError(problem, file=file, field=field, fix=_RECOPY) from None
    require_finite(array, file, field)
    return array


def require_finite(array: NDArray[np.float32], file: Path, field: str) -> None:
    """Raise InputError that names the first row and the count of values that are NaN or infinite."""
    bad = ~np.isfinite(array)
    if bad.any():
        rows = np.flatnonzero(bad.reshape(array.shape[0], -1).any(axis=1)) if array.ndim else np.zeros(1, int)
        raise InputError(
            f"{int(bad.sum())} values are not finite in float32, the first in row {int(rows[0])}",
            file=file,
            field=field,
            fix="remove these rows or train again",
        )


class _Inert:
    """Stands for a numpy object in a checkpoint and keeps nothing of it."""

    def __init__(self, *_arguments: Any) -> None:
        pass

    def __setstate__(self, _state: Any) -> None:
        pass


def _unusual_kind(tensor: torch.Tensor) -> str | None:
    import torch

    tests = (
        (tensor.is_nested, "nested"),
        (tensor.layout != torch.strided, "sparse"),
        (tensor.is_quantized, "quantized"),
        (tensor.device.type == "meta", "empty (meta)"),
        (tensor.dtype.is_complex, "complex"),
    )
    for found, kind in tests:
        if found:
            return kind
    if tensor.dtype not in (torch.float16, torch.bfloat16, torch.float32, torch.float64):
        return str(tensor.dtype).removeprefix("torch.")
    return None


def _first_line(error: BaseException) -> str:
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= 160 else f"{text[:157]}..."


def _check_archive(path: Path, size: int) -> None:
    """Refuse archives that torch.save does not write, before torch sees them."""
    try:
        with path.open("rb") as stream:
            if stream.read(4) != b"PK\x03\x04":
                raise InputError("not a PyTorch checkpoint", file=path, fix=_RECOPY)
        with zipfile.ZipFile(path) as archive:
            _check_members(archive, path, size)
            names = [m.filename for m in archive.infolist() if m.filename.endswith("/data.pkl")]
            data = archive.read(names[0])
            # pickletools prints nothing and builds nothing: it only lists the instructions.
            wanted = {
                str(argument or "unnamed").replace(" ", ".")
                for opcode, argument, _ in pickletools.genops(data)
                if opcode.name in ("GLOBAL", "INST", "STACK_GLOBAL")
            }
    except InputError:
        raise
    except MemoryError:
        raise
    except OSError as error:
        problem = f"checkpoint cannot be read: {error.strerror or type(error).__name__}"
        raise InputError(problem, file=path, fix="check the permissions") from None
    except Exception as error:  # zipfile and pickletools raise many types on damaged files
        raise InputError(f"damaged checkpoint: {_first_line(error)}", file=path, fix=_RECOPY) from None
    for name in sorted(wanted):
        if name.partition(".")[0] not in _PICKLE_MODULES:
            raise _forbidden(name, path)


def _forbidden(name: str, path: Path) -> InputError:
    return InputError(
        f"asks for the Python object {show(name)}; nothing was run",
        file=path,
        field="data.pkl",
        fix="use only checkpoints that ns-train wrote",
    )


def _check_members(archive: zipfile.ZipFile, path: Path, size: int) -> None:
    members = archive.infolist()
    names = Counter(member.filename.casefold() for member in members)
    pickles = [m for m in members if m.filename.endswith("/data.pkl")]
    problem = None
    if len(members) > ARCHIVE_MEMBERS_LIMIT:
        problem = f"{len(members)} members in the archive"
    elif any(member.compress_type != zipfile.ZIP_STORED for member in members):
        problem = "compressed members, which torch.save never writes"
    elif sum(member.file_size for member in members) > size:
        problem = "members larger than the file"
    elif names and names.most_common(1)[0][1] > 1:
        problem = f"member {show(names.most_common(1)[0][0])} stands twice"
    elif len(pickles) != 1 or any(m.filename.endswith("/constants.pkl") for m in members):
        problem = "not an archive of torch.save"
    elif pickles[0].file_size > PICKLE_BYTES_LIMIT:
        problem = f"its index has {pickles[0].file_size} bytes, more than {PICKLE_BYTES_LIMIT}"
    if problem is None:
        broken = archive.testzip()
        problem = None if broken is None else f"checksum of {show(broken)} does not match"
    if problem:
        raise InputError(f"damaged checkpoint: {problem}", file=path, fix=_RECOPY)


@contextmanager
def _allowed_alone(names: list[Any]) -> Iterator[None]:
    """Let ``torch.load`` see these names only: others' objects of the same names would take turns with ours."""
    import torch

    others = torch.serialization.get_safe_globals()
    torch.serialization.clear_safe_globals()
    torch.serialization.add_safe_globals(names)
    try:
        yield
    finally:
        torch.serialization.clear_safe_globals()
        torch.serialization.add_safe_globals(others)


def _load_checkpoint(path: Path) -> Any:
    import torch

    inert: list[Any] = [(_Inert, name) for name in _NUMPY_NAMES]
    try:
        with _allowed_alone(inert), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                return torch.load(str(path), map_location="cpu", weights_only=True, mmap=True)
            except RuntimeError as error:
                # Some network file systems cannot map files.
                if "mmap" not in str(error):
                    raise
                return torch.load(str(path), map_location="cpu", weights_only=True)
    except MemoryError:
        raise
    except pickle.UnpicklingError as error:
        # The rest of torch's text recommends to load without restrictions.
        name = re.search(r"GLOBAL ([\w.]+)", str(error))
        if name:
            raise _forbidden(name[1], path) from None
        raise InputError("damaged checkpoint: unusual contents", file=path, fix=_RECOPY) from None
    except Exception as error:  # torch.load raises many types on damaged files
        problem = f"checkpoint cannot be read: {_first_line(error)}"
        raise InputError(problem, file=path, fix=_RECOPY) from None


def _is_list(value: Any, length: int) -> bool:
    return isinstance(value, list) and len(value) == length


def _section(parent: dict[str, Any], key: str, field: str, file: Path) -> dict[str, Any]:
    section = as_mapping(parent.get(key))
    if section is None:
        found = "missing" if key not in parent else f"found {show(parent[key])}, not a mapping"
        raise InputError(found, file=file, field=field, fix="give the config.yml of ns-train")
    return section


def _name(root: dict[str, Any], key: str, default: str, file: Path) -> str:
    value = root.get(key)
    if value is None:
        return default
    if not isinstance(value, (str, int, float)) or isinstance(value, bool):
        raise InputError(f"found {show(value)}", file=file, field=key, fix="write a name")
    text = value if isinstance(value, str) else show(value)
    return visible(" ".join(text.split()))[:120] or default


def _model_folder(root: dict[str, Any], file: Path) -> str:
    value = root.get("relative_model_dir")
    if value is None:
        return DEFAULT_MODEL_FOLDER
    parts = PurePosixPath(value).parts if isinstance(value, str) and "\0" not in value else ("..",)
    if ".." in parts or PurePosixPath(*parts).is_absolute() or PureWindowsPath(*parts).anchor:
        raise InputError(
            f"found {show(value)}, not a path inside the run folder",
            file=file,
            field="relative_model_dir",
            fix=f"write {DEFAULT_MODEL_FOLDER}",
        )
    return str(PurePosixPath(*parts))


def _parse_yaml(text: str, file: Path) -> Any:
    fix = "give the config.yml of ns-train"
    try:
        loader = _InertLoader(text)
        try:
            return loader.get_single_data()
        finally:
            loader.dispose()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = "" if mark is None else f" at line {mark.line + 1}"
        problem = show(error.problem or error.context or "syntax error").strip("'\"")
        raise InputError(f"not valid YAML: {problem}{line}", file=file, fix=fix) from None
    except MemoryError:
        raise
    except Exception as error:  # PyYAML raises KeyError, ValueError, AttributeError... on bad scalars
        raise InputError(f"not valid YAML: {_first_line(error)}", file=file, fix=fix) from None


def _composer_error(problem: str, mark: Any) -> yaml.MarkedYAMLError:
    return yaml.composer.ComposerError(None, None, problem, mark)


def _constructor_error(problem: str, mark: Any) -> yaml.MarkedYAMLError:
    return yaml.constructor.ConstructorError(None, None, problem, mark)


class _InertLoader(yaml.SafeLoader):
    """SafeLoader that keeps tags of Python objects as data and bounds depth and aliases."""

    def __init__(self, stream: str) -> None:
        super().__init__(stream)
        self._depth = 0
        # Sizes after alias expansion, of nodes under construction and of finished ones.
        self._open: list[int] = [0]
        self._sizes: dict[int, int] = {}

    def compose_node(self, parent: Any, index: Any) -> Any:
        alias = self.check_event(yaml.AliasEvent)
        mark = self.peek_event().start_mark
        self._depth += 1
        if self._depth > CONFIG_DEPTH_LIMIT:
            raise _composer_error(f"nested more than {CONFIG_DEPTH_LIMIT} levels deep", mark)
        self._open.append(1)
        node = super().compose_node(parent, index)
        size = self._open.pop()
        self._depth -= 1
        if alias:
            if id(node) not in self._sizes:
                raise _composer_error("an alias refers to itself", mark)
            size = self._sizes[id(node)]
        self._sizes[id(node)] = size
        self._open[-1] += size
        if self._open[-1] > CONFIG_NODES_LIMIT:
            raise _composer_error(f"more than {CONFIG_NODES_LIMIT} values after expansion of aliases", mark)
        return node

    def construct_scalar(self, node: Any) -> Any:
        value = super().construct_scalar(node)
        # PyYAML's time for a number grows with the square of its length
        if node.tag in _NUMBER_TAGS and len(value) > NUMBER_CHARACTERS_LIMIT:
            raise _constructor_error(f"a number of {len(value):,} characters", node.start_mark)
        return value

    def flatten_mapping(self, node: Any) -> None:
        for key, _ in node.value:
            if key.tag == _MERGE_TAG:
                raise _constructor_error("merge keys (<<) are not supported", key.start_mark)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        if isinstance(node, yaml.MappingNode):
            seen = set()
            for key_node, _ in node.value:
                if not isinstance(key_node, yaml.ScalarNode):
                    raise _constructor_error("a key is not a scalar", key_node.start_mark)
                key = self.construct_object(key_node, deep=True)
                if key in seen:
                    problem = f"key {show(key)} stands twice in one mapping"
                    raise _constructor_error(problem, key_node.start_mark)
                seen.add(key)
        return super().construct_mapping(node, deep=deep)

    def construct_inert(self, node: Any) -> Any:
        """Value of a node with a tag that YAML itself does not define."""
        if isinstance(node, yaml.SequenceNode):
            value: Any = self.construct_sequence(node, deep=True)
        elif isinstance(node, yaml.MappingNode):
            value = self.construct_mapping(node, deep=True)
        else:
            value = self.construct_scalar(node)
        if not node.tag.startswith(_PYTHON_TAG):
            return Tagged(node.tag, value)
        kind, _, name = node.tag.removeprefix(_PYTHON_TAG).partition(":")
        if kind == "tuple" and isinstance(value, list):
            return tuple(value)
        if kind in ("str", "unicode") and isinstance(value, str):
            return value
        parts = value.get("args") if isinstance(value, dict) else value
        if name.startswith("pathlib.") and isinstance(parts, list) and all(isinstance(p, str) for p in parts):
            flavour = PureWindowsPath if "Windows" in name else PurePosixPath
            return str(flavour(*parts))
        return Tagged(node.tag, value)


# None stands for every tag without a constructor of its own.
_InertLoader.add_constructor(cast(Any, None), _InertLoader.construct_inert)
for _kind in ("int", "long", "float", "bool"):
    _method = getattr(yaml.SafeLoader, f"construct_yaml_{_kind.replace('long', 'int')}")
    _InertLoader.add_constructor(f"{_PYTHON_TAG}{_kind}", _method)
