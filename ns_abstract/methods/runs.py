"""Read the run folders that ``ns-train`` writes, without Nerfstudio and without running code in them.

A run folder holds ``config.yml``, ``dataparser_transforms.json`` and
``nerfstudio_models/step-*.ckpt``. Only paths relative to ``config.yml`` are used, so a folder
may be moved. Nothing here is specific to one method.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, cast

import numpy as np
import yaml
import yaml.composer
import yaml.constructor
from numpy.typing import NDArray

from ns_abstract.geometry.transform import DataparserTransform
from ns_abstract.io.assumptions import Assumption
from ns_abstract.io.errors import InputError, first_line, visible
from ns_abstract.io.jsonio import FIX_ACCESS, InputTuning, file_size, is_number, load_json, read_text, show, unusable
from ns_abstract.io.kinds import refuse_other_kind
from ns_abstract.methods.checkpoint import RECOPY, read_checkpoint
from ns_abstract.methods.overrides import assumption_of

CONFIG_NAME = "config.yml"
TRANSFORMS_NAME = "dataparser_transforms.json"
#: Data parsers whose ``dataparser_transforms.json`` begins where a ``transforms.json`` ends once what it says was
#: applied is undone.
_PLACING_PARSERS = ("Nerfstudio", "NerfstudioDataParser", "ColmapDataParser")
#: Origin of the units of a run without that file.
NO_TRANSFORMS = f"default: {TRANSFORMS_NAME} is missing"
DEFAULT_MODEL_FOLDER = "nerfstudio_models"

CONFIG_BYTES_LIMIT = 2**20
CONFIG_NODES_LIMIT = 100_000
CONFIG_DEPTH_LIMIT = 64
NUMBER_CHARACTERS_LIMIT = 300
TRANSFORMS_BYTES_LIMIT = 2**20

#: Modules of every model that draw nothing in evaluation, and what they are for.
IDLE_MODULES = {
    "device_indicator_param": "no values",
    "lpips.": "a metric",
    "psnr.": "a metric",
    "ssim.": "a metric",
    "camera_optimizer.": "poses of the training pictures, used in training alone",
}
_PYTHON_TAG = "tag:yaml.org,2002:python/"
_MERGE_TAG = "tag:yaml.org,2002:merge"
_NUMBER_TAGS = {f"tag:yaml.org,2002:{python}{kind}" for python in ("", "python/") for kind in ("int", "long", "float")}
#: Steps and runs that an error lists; folders that are looked into for these.
_STEPS_SHOWN, _RUNS_SHOWN, _FOLDERS_SEEN = 12, 4, 4096
_CHECKPOINT_NAME = re.compile(r"step-(\d{1,18})\.ckpt")


@dataclass(frozen=True)
class Tagged:
    """A YAML node whose tag names a Python object: the tag and the plain value below it."""

    tag: str
    value: Any


@dataclass(frozen=True)
class RunConfig:
    """The parts of ``config.yml`` that matter after training.

    Attributes:
        method_name: Name given to ns-train, such as "splatfacto"; "unknown" if absent.
        model: ``pipeline.model`` as a mapping; Python objects in it are :class:`Tagged`.
    """

    file: Path
    folder: Path
    method_name: str
    experiment_name: str
    model: dict[str, Any]
    model_folder: Path
    root: dict[str, Any]

    def integer(self, name: str, default: int, least: int, most: int | None = None) -> int:
        """Return the integer field of ``pipeline.model`` in [least, most]; ``default`` if absent."""
        value = self.model.get(name, default)
        fits = isinstance(value, int) and not isinstance(value, bool)
        if not fits or value < least or (most is not None and value > most):
            wanted = f"at least {least}" if most is None else f"from {least} to {most}"
            raise self.refused(name, value, f"an integer {wanted}")
        return value

    def choice(self, name: str, default: str, options: tuple[str, ...]) -> str:
        """Return the text field of ``pipeline.model`` out of ``options``; ``default`` if absent."""
        value = self.model.get(name, default)
        if not isinstance(value, str) or value not in options:
            raise self.refused(name, value, f"one of {', '.join(options)}")
        return value

    def color(self, name: str, default: str, names: Mapping[str, tuple[float, float, float]]) -> NDArray[np.float32]:
        """Return the RGB field of ``pipeline.model`` as float32 [3] in [0, 1]; ``default`` if absent.

        Args:
            names: Colours of the names that the model shows, letter by letter; it stops at others.
        """
        value = self.model.get(name, default)
        if isinstance(value, str):
            if value in names:
                return np.array(names[value], np.float32)
        elif isinstance(value, (list, tuple)) and len(value) == 3 and all(map(is_number, value)):
            if all(0 <= part <= 1 for part in value):
                return np.array(value, np.float32)
        raise self.refused(name, value, f"{', '.join(names)} or three numbers from 0 to 1")

    def flag(self, name: str, default: bool) -> bool:
        """Return the boolean field of ``pipeline.model``; ``default`` if absent."""
        value = self.model.get(name, default)
        if not isinstance(value, bool):
            raise self.refused(name, value, "true or false")
        return value

    def refused(self, name: str, value: Any, wanted: str) -> InputError:
        """Return an InputError of a field of ``pipeline.model``."""
        return unusable(value, field=f"pipeline.model.{name}", fix=f"write {wanted}", file=self.file)


def read_config(path: str | os.PathLike[str]) -> RunConfig:
    """Read ``config.yml``."""
    file = Path(path)
    if os.path.isdir(file):
        file = file / CONFIG_NAME
        file_size(file, "run configuration", fix=None if file.exists() else _which_run(file.parent))
    root = read_mapping(file, "run configuration")
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


def _which_run(folder: Path) -> str:
    """Return advice for a folder without a config.yml: the runs below it, such as those of an experiment."""
    below = (inner / CONFIG_NAME for depth in (1, 2, 3) for inner in folder.glob("*/" * depth))
    runs = sorted(islice((file for file in islice(below, _FOLDERS_SEEN) if file.is_file()), _RUNS_SHOWN))
    if not runs:
        return "give a folder that ns-train wrote, or its config.yml"
    return f"give a run below it: {', '.join(visible(str(run)) for run in runs)}"


def read_mapping(file: Path, what: str) -> dict[str, Any]:
    """Return the mapping in a YAML file; Python objects in it are kept as `Tagged`, never built."""
    refuse_other_kind(file)
    root = as_mapping(_parse_yaml(read_text(file, what, CONFIG_BYTES_LIMIT), file))
    if root is None:
        raise InputError("the top level is not a mapping", file=file, fix="give the configuration that training wrote")
    return root


def as_mapping(value: Any) -> dict[str, Any] | None:
    """Return the mapping that a YAML value holds, with a Python object's tag removed; None if it holds none.

    An object that is made by a call (``object/apply``, ``object/new``) is its state alone: with other arguments it may
    hold what nothing here reads.
    """
    if not isinstance(value, Tagged):
        return value if isinstance(value, dict) else None
    inner = value.value
    if not isinstance(inner, dict) or "object/" not in value.tag:
        return inner if isinstance(inner, dict) else None
    state = inner.get("state")
    alone = isinstance(state, dict) and not any(part for key, part in inner.items() if key != "state")
    return state if alone else None


def find_checkpoint(run: RunConfig, step: int | None = None) -> Path:
    """Return the checkpoint that Nerfstudio shows (nerfstudio/utils/eval_utils.py, ``eval_load_checkpoint``).

    Args:
        run: The run's configuration; ``load_step`` in it names a step. Nerfstudio's evaluation replaces ``load_dir``
            by the run's own folder and reads no ``load_checkpoint``.
        step: The step to read in place of that; without either it is the highest one.
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
    files_by_step: dict[int, list[str]] = {}
    for name in names:
        if match := _CHECKPOINT_NAME.fullmatch(name):
            files_by_step.setdefault(int(match[1]), []).append(name)
    if not files_by_step:
        raise InputError("no step-*.ckpt here", file=folder, fix="train the run until it saves a checkpoint")
    wanted = load_step(run) if step is None else step
    if wanted is not None and wanted not in files_by_step:
        steps = ", ".join(map(str, sorted(files_by_step)[-_STEPS_SHOWN:]))
        dots = "..., " if len(files_by_step) > _STEPS_SHOWN else ""
        raise InputError(
            f"names step {wanted}, and {folder} holds steps {dots}{steps}",
            file=run.file if step is None else None,
            field="load_step" if step is None else "--load-step",
            fix=f"copy step-{wanted:09d}.ckpt there, or give --load-step with one of these",
        )
    taken = max(files_by_step) if wanted is None else wanted
    # the name that Nerfstudio writes and reads comes first
    return folder / min(files_by_step[taken], key=lambda name: (name != f"step-{taken:09d}.ckpt", -len(name), name))


def load_step(run: RunConfig) -> int | None:
    """Return the training step that config.yml names for evaluation; None: the highest one."""
    value = run.root.get("load_step")
    if value is not None and (isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 10**18):
        raise unusable(value, field="load_step", fix="write a step, or null", file=run.file)
    return value


def step_assumption(run: RunConfig, checkpoint: Path, requested: int | None) -> Assumption:
    """Return the assumption on the training step that is shown, and its origin."""
    match = _CHECKPOINT_NAME.fullmatch(checkpoint.name)
    step = int(match[1]) if match else checkpoint.name
    stored = load_step(run)
    if stored is not None:
        return assumption_of("load_step", requested, "--load-step", stored, "config.yml: load_step")
    default = step if requested is None else "the highest one"
    return assumption_of("load_step", requested, "--load-step", default, "default: the highest step there is")


def idle_assumptions(state: Collection[str], idle: Mapping[str, str]) -> tuple[Assumption, ...]:
    """Return assumptions on the ``idle`` modules in a checkpoint's ``state``, which are left out."""
    return tuple(
        Assumption(f"module {prefix.rstrip('.')}", f"left out: {why}", "checkpoint")
        for prefix, why in idle.items()
        if why != "no values" and any(key.startswith(prefix) for key in state)
    )


def units_assumption(transform: DataparserTransform, assumed: bool) -> Assumption:
    """Return the assumption on the units of the data set; ``assumed``: the run does not state them."""
    origin = NO_TRANSFORMS if assumed else TRANSFORMS_NAME
    scale = transform.scale if assumed else transform.stated_scale
    text = "those of the data set differ by direction" if scale is None else f"1 of the data set is {scale:.9g}"
    return Assumption("units", text, origin)


def placing_parser(run: RunConfig) -> str | None:
    """Return the data parser that placed the run's frame against a ``transforms.json``; None: none that is known.

    Instant-NGP's leaves alone what the file says was applied to its poses. Orienting by "pca" may turn the transform
    that is stored, and not the poses (nerfstudio/cameras/camera_utils.py:579).
    """
    parser = (as_mapping((as_mapping(run.root.get("pipeline")) or {}).get("datamanager")) or {}).get("dataparser")
    options = as_mapping(parser) or {}
    target = options.get("_target", parser)
    if options.get("orientation_method") == "pca":
        return None
    if target is None:
        return _PLACING_PARSERS[0]
    name = target.tag.rpartition(".")[2].removesuffix("Config") if isinstance(target, Tagged) else ""
    return name if name in _PLACING_PARSERS else None


def config_class(run: RunConfig) -> str:
    """Return dotted name of the class of ``pipeline.model``, whose defaults absent keys have; "" without a class."""
    model = (as_mapping(run.root.get("pipeline")) or {}).get("model")
    return model.tag.rpartition(":")[2] if isinstance(model, Tagged) else ""


def target_class(run: RunConfig) -> str:
    """Return the dotted name of the model's class that config.yml names; "" where it names none."""
    target = run.model.get("_target")
    if target is None:
        return config_class(run).removesuffix("Config")
    return target.tag.rpartition(":")[2] if isinstance(target, Tagged) else show(target)


def read_dataparser_transform(run: RunConfig) -> tuple[DataparserTransform, tuple[str, ...]]:
    """Read ``dataparser_transforms.json`` beside ``config.yml``.

    Returns the transform, and notes about what was assumed: without the file it is the identity. Raises InputError
    where the file exists and is not what Nerfstudio writes.
    """
    path = run.folder / TRANSFORMS_NAME
    if not os.path.lexists(path):
        note = f"{path} is missing: units of the data set are not known"
        return DataparserTransform(stated=False), (note,)
    data = load_json(path, "dataparser transform", TRANSFORMS_BYTES_LIMIT)
    if not isinstance(data, dict):
        raise unusable(data, field="top level", fix="write an object", file=path)
    rows = data.get("transform")
    if not (isinstance(rows, list) and len(rows) == 3 and all(isinstance(row, list) and len(row) == 4 for row in rows)):
        raise InputError("not a 3x4 matrix", file=path, field="transform", fix="write three rows of four numbers")
    for i, row in enumerate(rows):
        for j, value in enumerate(row):
            if not is_number(value):
                raise unusable(value, field=f"transform[{i}][{j}]", fix="write a finite number", file=path)
    matrix = np.array(rows, np.float64)
    with np.errstate(all="ignore"):
        determinant = float(np.linalg.det(matrix[:, :3]))
    if not math.isfinite(determinant) or abs(determinant) < InputTuning.nothing:
        raise InputError(
            f"the 3x3 part cannot be inverted (determinant {determinant:.3g})",
            file=path,
            field="transform",
            fix="copy the file again from the run",
        )
    scale = data.get("scale")
    if not is_number(scale) or not scale > 0:
        raise unusable(scale, field="scale", fix="write a number above 0", file=path)
    return DataparserTransform(matrix=matrix, scale=float(scale)), ()


def read_model_state(path: Path) -> dict[str, Any]:
    """Return the model's tensors (`StoredTensor`) in a checkpoint, read without running code in the file.

    ``path``: a ``step-*.ckpt`` file. Returns the state of the model: keys as in ``Model.state_dict()``, that is without
    the ``_model.`` prefix of the pipeline and the ``module.`` of distributed training. Raises InputError where the file
    is damaged, holds other Python objects than tensors and plain values, or has no ``pipeline``.
    """
    root = read_checkpoint(path)
    pipeline = root.get("pipeline") if isinstance(root, dict) else None
    if not isinstance(pipeline, dict):
        raise InputError("no model state", file=path, field="pipeline", fix="give a checkpoint that ns-train wrote")
    state = {}
    for key, value in pipeline.items():
        if not isinstance(key, str):
            raise InputError(f"key {show(key)} is not text", file=path, field="pipeline", fix=RECOPY)
        name = key.removeprefix("module.")
        if name.startswith("_model."):
            state[name.removeprefix("_model.")] = value
    # Nerfstudio removes a second "module." only if every key has it (pipelines/base_pipeline.py).
    if state and all(key.startswith("module.") for key in state):
        state = {key.removeprefix("module."): value for key, value in state.items()}
    return state


def _section(parent: dict[str, Any], key: str, field: str, file: Path) -> dict[str, Any]:
    section = as_mapping(parent.get(key))
    if section is None:
        value = parent.get(key)
        problem = "missing" if key not in parent else f"found {show(value)}, not a mapping"
        if isinstance(value, Tagged):
            name = show(value.tag.rpartition(".")[2])
            problem = f"found an object {name} with other values than those of a mapping or a state"
        raise InputError(problem, file=file, field=field, fix="give the config.yml of ns-train")
    return section


def _name(root: dict[str, Any], key: str, default: str, file: Path) -> str:
    value = root.get(key)
    if value is None:
        return default
    if not isinstance(value, (str, int, float)) or isinstance(value, bool):
        raise unusable(value, field=key, fix="write a name", file=file)
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
        raise InputError(f"not valid YAML: {first_line(error)}", file=file, fix=fix) from None


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
            keys = set()
            for key_node, _ in node.value:
                if not isinstance(key_node, yaml.ScalarNode):
                    raise _constructor_error("a key is not a scalar", key_node.start_mark)
                key = self.construct_object(key_node, deep=True)
                if key in keys:
                    raise _constructor_error(f"key {show(key)} stands twice in one mapping", key_node.start_mark)
                keys.add(key)
        return super().construct_mapping(node, deep=deep)

    def construct_inert(self, node: Any) -> Any:
        """Return the value of a node with a tag that YAML itself does not define."""
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
