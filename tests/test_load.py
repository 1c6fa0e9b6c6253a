"""Reading run folders and .ply files: what is kept, what is refused, and that nothing is run."""

from __future__ import annotations

import errno
import json
import os
import pickle
import random
import re
import shutil
import struct
import subprocess
import sys
import textwrap
import warnings
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from plyfile import PlyData, PlyElement

from ns_abstract.io import memory
from ns_abstract.io.errors import InputError
from ns_abstract.methods import checkpoint, runs
from ns_abstract.methods.overrides import Overrides
from ns_abstract.methods.splat.load import load_scene
from ns_abstract.methods.splat.scene import SplatScene

torch.set_num_threads(1)
RUNS = Path(__file__).parents[2] / "shared" / "runs"

CONFIG = """\
!!python/object:nerfstudio.engine.trainer.TrainerConfig
_target: !!python/name:nerfstudio.engine.trainer.Trainer ''
data: &id003 !!python/object/apply:pathlib.PosixPath
- /
- home
- someone
- data
experiment_name: tiny
load_dir: null
load_step: null
logging: !!python/object:nerfstudio.configs.base_config.LoggingConfig
  local_writer: !!python/object:nerfstudio.configs.base_config.LocalWriterConfig
    _target: !!python/name:nerfstudio.utils.writer.LocalWriter ''
    stats_to_track: !!python/tuple
    - !!python/object/apply:nerfstudio.utils.writer.EventName
      - Train Iter (time)
  relative_log_dir: !!python/object/apply:pathlib.PosixPath []
method_name: splatfacto
output_dir: !!python/object/apply:pathlib.PosixPath
- outputs
pipeline: !!python/object:nerfstudio.pipelines.base_pipeline.VanillaPipelineConfig
  _target: !!python/name:nerfstudio.pipelines.base_pipeline.VanillaPipeline ''
  datamanager: !!python/object:nerfstudio.data.datamanagers.full_images_datamanager.FullImageDatamanagerConfig
    data: *id003
    eval_image_indices: !!python/tuple
    - 0
  model: !!python/object:nerfstudio.models.splatfacto.SplatfactoModelConfig
    _target: !!python/name:nerfstudio.models.splatfacto.SplatfactoModel ''
    background_color: random
    grid_shape: !!python/tuple
    - 16
    - 16
    - 8
    rasterize_mode: classic
    sh_degree: 3
    sh_degree_interval: 1000
    use_bilateral_grid: false
relative_model_dir: !!python/object/apply:pathlib.PosixPath
- nerfstudio_models
timestamp: 2026-11-21_000000
"""
TRANSFORM = {"transform": [[0.0, 1.0, 0.0, 0.5], [-1.0, 0.0, 0.0, 0.25], [0.0, 0.0, 1.0, 0.0]], "scale": 0.5}
GAUSSIANS = 5


class Call:
    """Pickles as a call of ``function`` on loading."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self.call = (function, arguments)

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return self.call


def parameters(count: int = GAUSSIANS, bands: int = 15) -> dict[str, torch.Tensor]:
    torch.manual_seed(0)
    shapes = {
        "means": (count, 3),
        "scales": (count, 3),
        "quats": (count, 4),
        "features_dc": (count, 3),
        "features_rest": (count, bands, 3),
        "opacities": (count, 1),
    }
    return {name: torch.randn(shape) for name, shape in shapes.items()}


def checkpoint_of(tensors: dict[str, Any], prefix: str = "_model.gauss_params.") -> dict[str, Any]:
    rate = np.float64(0.00016)
    return {
        "step": 29999,
        "pipeline": OrderedDict(
            [
                ("_model.device_indicator_param", torch.empty(0)),
                *((f"{prefix}{name}", tensor) for name, tensor in tensors.items()),
                ("_model.lpips.net.lin0.model.1.weight", torch.zeros(1, 4, 1, 1)),
            ]
        ),
        "optimizers": {"means": {"state": {}, "param_groups": [{"lr": rate, "params": [0]}]}},
        "schedulers": {"means": {"base_lrs": [0.00016], "_last_lr": [rate], "lr_lambdas": [None]}},
        "scalers": {},
    }


class Run:
    """A run folder to be spoiled by the tests."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.config = folder / "config.yml"
        self.transforms = folder / "dataparser_transforms.json"
        self.checkpoint = folder / "nerfstudio_models" / "step-000029999.ckpt"
        self.checkpoint.parent.mkdir(parents=True)
        self.config.write_text(CONFIG)
        self.transforms.write_text(json.dumps(TRANSFORM, indent=4))
        self.save(checkpoint_of(parameters()))

    def save(self, content: Any) -> None:
        torch.save(content, self.checkpoint)

    def save_with(self, **changes: Any) -> None:
        """Save a checkpoint in which some parameters are replaced, or left out if None."""
        tensors = {**parameters(), **changes}
        self.save(checkpoint_of({name: value for name, value in tensors.items() if value is not None}))

    def replace(self, old: str, new: str) -> None:
        text = self.config.read_text()
        assert old in text
        self.config.write_text(text.replace(old, new))


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return Run(tmp_path / "outputs" / "tiny" / "splatfacto" / "2026-11-21_000000")


def ply_table(count: int = GAUSSIANS, rest: int = 45, kind: str = "f4") -> np.ndarray:
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(rest)]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    table = np.zeros(count, [(name, kind) for name in names])
    generator = np.random.default_rng(0)
    for name in names:
        table[name] = generator.standard_normal(count)
    return table


def write_ply(path: Path, table: np.ndarray, text: bool = False, order: str = "<") -> Path:
    PlyData([PlyElement.describe(table, "vertex")], text=text, byte_order=order).write(str(path))
    return path


def refused(path: Path, *mentions: str) -> InputError:
    """Load ``path`` and check the form of the error."""
    with pytest.raises(InputError) as caught:
        load_scene(path)
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    assert caught.value.file and message.startswith(caught.value.file)
    assert caught.value.fix
    for mention in mentions:
        assert mention in message
    return caught.value


def equal(first: SplatScene, second: SplatScene) -> bool:
    names = ("means", "log_scales", "quats", "opacity_logits", "sh")
    return all(np.array_equal(getattr(first, name), getattr(second, name)) for name in names)


# What is kept


@pytest.mark.parametrize(
    ("name", "count", "scale", "rest_is_zero"),
    [
        ("playbot_lod4", 8406, 1.0, False),
        ("plant", 113648, 0.7340000804996579, True),
        ("airplane", 10000, 1.0, True),
    ],
)
def test_real_run(name: str, count: int, scale: float, rest_is_zero: bool) -> None:
    found = sorted((RUNS / name).glob("splatfacto/*/config.yml"))
    if not found:
        pytest.skip(f"no run folder {RUNS / name}")
    scene = load_scene(found[0])
    assert scene.count == count
    assert scene.sh.shape == (count, 16, 3)
    assert (scene.color_model, scene.sh_degree, scene.rasterize_mode) == ("sh", 3, "classic")
    assert scene.background.tolist() == [1, 1, 1]
    assert scene.dataparser.scale == scale
    assert bool((scene.sh[:, 1:] == 0).all()) == rest_is_zero
    assert (scene.name, scene.dropped, scene.notes) == (name, {}, ())
    stored = torch.load(scene.source, weights_only=False)["pipeline"]
    assert np.array_equal(stored["_model.gauss_params.means"].numpy(), scene.means)
    assert np.array_equal(stored["_model.gauss_params.features_rest"].numpy(), scene.sh[:, 1:])
    assert np.array_equal(stored["_model.gauss_params.opacities"].numpy()[:, 0], scene.opacity_logits)
    assert np.array_equal(stored["_model.gauss_params.scales"].numpy(), scene.log_scales)
    assert np.array_equal(stored["_model.gauss_params.quats"].numpy(), scene.quats)


def test_nerf_run_is_refused_as_scene_but_readable() -> None:
    found = sorted((RUNS / "lego_nerf").glob("vanilla-nerf/*/config.yml"))
    if not found:
        pytest.skip(f"no run folder {RUNS / 'lego_nerf'}")
    refused(found[0], "vanilla-nerf", "splatfacto")
    config = runs.read_config(found[0])
    assert (config.method_name, config.model["num_coarse_samples"]) == ("vanilla-nerf", 64)
    assert config.color("background_color", "white", {"black": (0.0, 0.0, 0.0)}).tolist() == [0, 0, 0]
    kind = config.model["temporal_distortion_params"]["kind"]
    assert isinstance(kind, runs.Tagged) and kind.value == ["dnerf"]
    state = runs.read_model_state(runs.find_checkpoint(config))
    assert state["field_fine.mlp_base.layers.4.weight"].shape == (256, 319)


def test_synthetic_run(run: Run) -> None:
    scene = load_scene(run.config)
    stored = parameters()
    assert np.array_equal(scene.means, stored["means"].numpy())
    assert np.array_equal(scene.sh[:, 0], stored["features_dc"].numpy())
    assert np.array_equal(scene.sh[:, 1:], stored["features_rest"].numpy())
    assert scene.background.tolist() == np.array([0.1490, 0.1647, 0.2157], np.float32).tolist()
    assert scene.dataparser.matrix.tolist() == TRANSFORM["transform"]
    assert scene.dataparser.scale == 0.5
    assert (scene.name, scene.source) == ("tiny", str(run.checkpoint))
    assert equal(scene, load_scene(run.folder))
    assert equal(scene, load_scene(str(run.config)))


def test_config_is_data(run: Run) -> None:
    config = runs.read_config(run.config)
    assert config.method_name == "splatfacto"
    assert config.root["data"] == "/home/someone/data"
    assert config.root["output_dir"] == "outputs"
    assert config.root["logging"].value["relative_log_dir"] == "."
    assert config.model["grid_shape"] == (16, 16, 8)
    target = config.model["_target"]
    assert isinstance(target, runs.Tagged)
    assert target.tag.endswith("python/name:nerfstudio.models.splatfacto.SplatfactoModel")


def test_moved_folder(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = load_scene(run.config)
    moved = tmp_path / "elsewhere" / "my run"
    shutil.move(run.folder, moved)
    assert equal(scene, load_scene(moved / "config.yml"))
    monkeypatch.chdir(moved)
    assert equal(scene, load_scene("config.yml"))
    assert equal(scene, load_scene("."))


def test_a_folder_of_runs_names_them(run: Run, tmp_path: Path) -> None:
    shutil.move(run.folder, tmp_path / "outputs" / "scene" / "splatfacto" / "date")
    for folder in ("outputs", "outputs/scene", "outputs/scene/splatfacto"):
        with pytest.raises(InputError, match=r"no such run configuration; give a run below it: .*date.config\.yml$"):
            load_scene(tmp_path / folder)
    with pytest.raises(InputError, match="give a folder that ns-train wrote"):
        load_scene(tmp_path / "outputs" / "scene" / "splatfacto" / "date" / "nerfstudio_models")


def test_newest_checkpoint_wins(run: Run) -> None:
    later = parameters(count=2)
    torch.save(checkpoint_of(later), run.checkpoint.with_name("step-000100000.ckpt"))
    for name in ("step-x.ckpt", "step-000999999.ckpt.tmp", "latest.ckpt", "step-0000100000.ckpt"):
        run.checkpoint.with_name(name).write_bytes(b"")
    assert load_scene(run.config).count == 2


def test_other_model_folder(run: Run) -> None:
    run.checkpoint.parent.rename(run.folder / "weights")
    run.replace("- nerfstudio_models", "- weights")
    assert load_scene(run.config).count == GAUSSIANS


def test_checkpoint_trained_on_cuda(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.serialization, "location_tag", lambda _storage: "cuda:0")
    run.save(checkpoint_of(parameters()))
    monkeypatch.undo()
    assert b"cuda:0" in run.checkpoint.read_bytes()
    assert np.array_equal(load_scene(run.config).means, parameters()["means"].numpy())


@pytest.mark.parametrize("module", ["numpy.core.multiarray", "numpy._core.multiarray"])
def test_numpy_scalars_of_both_major_versions(run: Run, tmp_path: Path, module: str) -> None:
    swapped = tmp_path / "swapped.ckpt"
    with zipfile.ZipFile(run.checkpoint) as old, zipfile.ZipFile(swapped, "w") as new:
        for member in old.infolist():
            data = old.read(member)
            if member.filename.endswith("data.pkl"):
                written = [b"numpy.core.multiarray", b"numpy._core.multiarray"]
                assert any(name + b"\nscalar" in data for name in written)
                for name in written:
                    data = data.replace(name + b"\nscalar", module.encode() + b"\nscalar")
            new.writestr(member.filename, data)
    shutil.copy(swapped, run.checkpoint)
    assert load_scene(run.config).count == GAUSSIANS


@pytest.mark.parametrize("module", ["numpy.core", "numpy._core"])
def test_what_others_allow_plays_no_part(run: Run, module: str) -> None:
    """Whatever wins where a name is allowed twice, it is not theirs; afterwards theirs is allowed as before."""

    before = torch.serialization.get_safe_globals()
    names = [f"{module}.multiarray.scalar", "numpy.dtype", "numpy.dtypes.Float64DType"]
    # of equal names any may win: theirs are many
    theirs = [type(f"Theirs{k}", (), {}) for k in range(32)]
    torch.serialization.add_safe_globals([(one, name) for one in theirs for name in names])
    try:
        given = set(map(str, torch.serialization.get_safe_globals()))
        test_numpy_scalars_of_both_major_versions(run, run.config.parent, f"{module}.multiarray")
        assert set(map(str, torch.serialization.get_safe_globals())) == given
    finally:
        torch.serialization.clear_safe_globals()
        torch.serialization.add_safe_globals(before)


def test_old_and_distributed_key_layouts(run: Run) -> None:
    expected = load_scene(run.config)
    for prefix in ("_model.", "module._model.gauss_params."):
        run.save(checkpoint_of(parameters(), prefix))
        assert equal(expected, load_scene(run.config))
    content = checkpoint_of(parameters())
    keys = {key.replace("_model.", "_model.module."): value for key, value in content["pipeline"].items()}
    run.save({**content, "pipeline": keys})
    assert equal(expected, load_scene(run.config))
    # nerfstudio overwrites the new keys by the old ones.
    content["pipeline"].update({f"_model.{name}": value for name, value in parameters(count=3).items()})
    run.save(content)
    assert load_scene(run.config).count == 3


def test_parameters_of_torch(run: Run) -> None:
    expected = load_scene(run.config)
    run.save(checkpoint_of({name: torch.nn.Parameter(value) for name, value in parameters().items()}))
    assert equal(expected, load_scene(run.config))


@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16, torch.float64])
def test_other_float_types(run: Run, kind: torch.dtype) -> None:
    run.save_with(**{name: value.to(kind) for name, value in parameters().items()})
    scene = load_scene(run.config)
    assert scene.means.dtype == np.float32
    assert np.array_equal(scene.means, parameters()["means"].to(kind).to(torch.float32).numpy())


def test_arrays_do_not_follow_the_file(run: Run) -> None:
    scene = load_scene(run.config)
    before = scene.means.copy()
    data = bytearray(run.checkpoint.read_bytes())
    with run.checkpoint.open("r+b") as stream:
        stream.write(bytes(len(data)))
    assert np.array_equal(scene.means, before)


def test_non_contiguous_tensors(run: Run) -> None:
    means = parameters()["means"]
    run.save_with(means=means.T.contiguous().T)
    assert np.array_equal(load_scene(run.config).means, means.numpy())


@pytest.mark.parametrize(
    ("stored", "interval", "degree", "model"),
    [
        (3, 1000, 3, "sh"),
        (3, 15000, 2, "sh"),
        (3, 20000, 1, "sh"),
        (2, 40000, 0, "sh"),
        (0, 1000, 0, "sigmoid"),
    ],
)
def test_degree_evaluated_after_loading(run: Run, stored: int, interval: int, degree: int, model: str) -> None:
    run.replace("sh_degree: 3", f"sh_degree: {stored}")
    run.replace("sh_degree_interval: 1000", f"sh_degree_interval: {interval}")
    tensors = parameters(bands=(stored + 1) ** 2 - 1)
    run.save(checkpoint_of(tensors))
    scene = load_scene(run.config)
    assert (scene.sh_degree, scene.color_model, scene.sh.shape[1]) == (degree, model, (degree + 1) ** 2)
    assert np.array_equal(scene.sh[:, 1:], tensors["features_rest"].numpy()[:, : (degree + 1) ** 2 - 1])


def test_degree_0_without_rest(run: Run) -> None:
    run.replace("sh_degree: 3", "sh_degree: 0")
    run.save_with(features_rest=None)
    assert load_scene(run.config).color_model == "sigmoid"


def test_zero_bands_do_not_lower_the_degree(run: Run) -> None:
    run.save_with(features_rest=torch.zeros(GAUSSIANS, 15, 3))
    assert load_scene(run.config).sh_degree == 3


@pytest.mark.parametrize(
    ("written", "color"),
    [
        ("white", [1, 1, 1]),
        ("black", [0, 0, 0]),
        ("[0.5, 0.25, 1]", [0.5, 0.25, 1]),
        ("!!python/tuple [0, 1, 0]", [0, 1, 0]),
    ],
)
def test_background(run: Run, written: str, color: list[float]) -> None:
    run.replace("background_color: random", f"background_color: {written}")
    scene = load_scene(run.config)
    assert scene.background.tolist() == color
    # numbers are this package's: nobody is told that Nerfstudio would show them
    (record,) = (record for record in scene.assumptions if record.name == "background")
    assert ("Nerfstudio's own model stops" in record.origin) == (written[0] in "[!")


@pytest.mark.parametrize("written", ["red", "White", "BLACK", "Random", "last_sample"])
def test_a_background_that_nerfstudio_does_not_show_is_refused(run: Run, written: str) -> None:
    """Splatfacto knows three names (splatfacto.py:498-509), letter by letter, and stops at all others."""
    run.replace("background_color: random", f"background_color: {written}")
    refused(run.config, "pipeline.model.background_color", written, "random, white, black or three numbers")


def test_fields_left_out_take_defaults_and_are_noted(run: Run) -> None:
    for line in ("    sh_degree: 3\n", "    rasterize_mode: classic\n", "    background_color: random\n"):
        run.replace(line, "")
    run.transforms.unlink()
    scene = load_scene(run.config)
    assert (scene.sh_degree, scene.rasterize_mode) == (3, "classic")
    assert np.array_equal(scene.dataparser.matrix, np.eye(3, 4)) and scene.dataparser.scale == 1
    assert len(scene.notes) == 2
    assert "dataparser_transforms.json is missing" in scene.notes[0]
    assert scene.dataparser.stated_scale is None
    assert "sh_degree, rasterize_mode, background_color" in scene.notes[1]


def test_other_methods_with_gaussians(run: Run) -> None:
    run.replace("method_name: splatfacto", "method_name: my-splats")
    run.replace("nerfstudio.models.splatfacto.SplatfactoModel ''", "mine.MyModel ''")
    run.replace("rasterize_mode: classic", "rasterize_mode: antialiased")
    refused(run.config, "pipeline.model._target", "mine.MyModel", "--assume-splatfacto")
    scene = load_scene(run.config, Overrides(assume_splatfacto=True))
    assert (scene.rasterize_mode, scene.gaussians_alone, scene.notes) == ("antialiased", True, ())


def test_zero_quaternions_are_dropped(run: Run) -> None:
    quats = parameters()["quats"]
    quats[[1, 3]] = torch.tensor([0.0, -0.0, 0.0, 0.0])
    run.save_with(quats=quats)
    scene = load_scene(run.config)
    assert scene.dropped == {"zero quaternion": 2}
    assert np.array_equal(scene.means, parameters()["means"].numpy()[[0, 2, 4]])
    assert scene.sh.shape == (3, 16, 3)


@pytest.mark.parametrize("order", ["<", ">", "text"])
@pytest.mark.parametrize(("rest", "degree"), [(0, 0), (9, 1), (24, 2), (45, 3)])
def test_ply(tmp_path: Path, order: str, rest: int, degree: int) -> None:
    table = ply_table(rest=rest)
    path = write_ply(tmp_path / "garden.PLY", table, order == "text", "<" if order == "text" else order)
    scene = load_scene(path)
    assert (scene.sh_degree, scene.color_model, scene.name) == (degree, "sh", "garden")
    assert scene.background.tolist() == [0, 0, 0] and scene.rasterize_mode == "classic"
    assert np.array_equal(scene.means, np.stack([table["x"], table["y"], table["z"]], 1))
    assert np.array_equal(scene.log_scales[:, 2], table["scale_2"])
    assert np.array_equal(scene.quats[:, 0], table["rot_0"])
    assert np.array_equal(scene.opacity_logits, table["opacity"])
    assert np.array_equal(scene.sh[:, 0, 1], table["f_dc_1"])
    bands = (degree + 1) ** 2
    for channel in range(3):
        for band in range(1, bands):
            stored = table[f"f_rest_{channel * (bands - 1) + band - 1}"]
            assert np.array_equal(scene.sh[:, band, channel], stored)


def test_ply_of_doubles(tmp_path: Path) -> None:
    scene = load_scene(write_ply(tmp_path / "a.ply", ply_table(kind="f8")))
    assert scene.means.dtype == np.float32


# What is refused

Spoil = Callable[[Run], object]


def _edit(old: str, new: str) -> Spoil:
    return lambda run: run.replace(old, new)


def _model(line: str) -> Spoil:
    """Replace the model's line of the same key."""
    key = line.partition(":")[0]
    old = next(row for row in CONFIG.splitlines() if row.strip().startswith(f"{key}:"))
    return _edit(f"{old}\n", f"    {line}\n")


def _config(text: str | bytes) -> Spoil:
    return lambda run: run.config.write_bytes(text.encode() if isinstance(text, str) else text)


def _loop(path: Path) -> None:
    path.unlink()
    path.symlink_to(path)


def _folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def _bomb(width: int) -> str:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    for level in range(1, width):
        lines.append(f"a{level}: &a{level} [{', '.join([f'*a{level - 1}'] * 9)}]")
    return "\n".join(lines) + "\n" + CONFIG.split("\n", 1)[1]


def _called(section: str, arguments: str) -> Spoil:
    """Make the object of a section by a call, its values as its state beside ``arguments``."""
    start = CONFIG.index(f"{section}: !!python/object:") + len(section) + 2 if section else 0
    line, rest = CONFIG[start:].split("\n", 1)
    indent = len(re.match(" *", rest)[0])  # type: ignore[index]
    end = re.search(rf"^ {{0,{indent - 1}}}[^ ]", rest, re.MULTILINE) if indent else None
    inside, after = (rest, "") if end is None else (rest[: end.start()], rest[end.start() :])
    values = textwrap.indent(inside, "  ")
    made = line.replace("object:", "object/apply:")
    prefix = " " * indent
    return _config(f"{CONFIG[:start]}{made}\n{prefix}{arguments}\n{prefix}state:\n{values}{after}")


BAD_CONFIGS: dict[str, tuple[Spoil, tuple[str, ...]]] = {
    "missing": (lambda run: run.config.unlink(), ("config.yml", "no such")),
    "folder": (lambda run: _folder(run.config), ("config.yml",)),
    "symlink loop": (lambda run: _loop(run.config), ("config.yml", "links")),
    "fifo": (lambda run: (run.config.unlink(), os.mkfifo(run.config)), ("not a regular file",)),
    "empty": (_config(""), ("empty",)),
    "blank": (_config(" \n\n"), ("empty",)),
    "not UTF-8": (_config(CONFIG.replace("tiny", "caf\xe9").encode("latin-1")), ("UTF-8",)),
    "NUL byte": (_config(CONFIG.replace("tiny", "a\0b")), ("YAML",)),
    "binary": (_config(bytes(range(128)) * 4), ("YAML",)),
    "a list": (_config("- a\n- b\n"), ("top level",)),
    "a scalar": (_config("hello"), ("top level",)),
    "two documents": (_config(CONFIG + "---\na: 1\n"), ("YAML",)),
    "syntax": (_config(CONFIG + "]: [\n"), ("YAML", "line")),
    "truncated": (_config(CONFIG[: CONFIG.index("rasterize_mode: c") + 8]), ("YAML",)),
    "cut before the model": (_config(CONFIG[: CONFIG.index("  model:")]), ("pipeline.model", "missing")),
    "cut before the pipeline": (_config(CONFIG[: CONFIG.index("pipeline:")]), ("pipeline",)),
    "pipeline a list": (_config("pipeline: [1]\n"), ("pipeline", "mapping")),
    "deep": (_config("a: " + "[" * 500 + "]" * 500), ("levels deep",)),
    "very deep": (_config("[" * 200_000), ("levels deep",)),
    "aliases": (_config(_bomb(12)), ("aliases",)),
    "merge keys": (_edit("pipeline:", "x: {<<: {a: 1}}\npipeline:"), ("merge",)),
    "alias to itself": (_config("&a [*a]"), ("itself",)),
    "unknown alias": (_config("a: *b"), ("YAML",)),
    "duplicate key": (
        _edit("    sh_degree: 3\n", "    sh_degree: 3\n    sh_degree: 0\n"),
        ("sh_degree", "twice"),
    ),
    "mapping as key": (_edit("load_step: null", "? {a: 1}\n: 2"), ("key",)),
    "bad timestamp": (_edit("load_step: null", "load_step: 2026-13-45"), ("YAML",)),
    "bad tagged int": (_edit("load_step: null", "load_step: !!int x"), ("YAML",)),
    "bad tagged time": (_edit("load_step: null", "load_step: !!timestamp x"), ("YAML",)),
    "5000 digits": (_edit("load_step: null", "load_step: " + "9" * 5000), ("YAML",)),
    "too large": (_config(CONFIG + "#" * (runs.CONFIG_BYTES_LIMIT + 1)), ("limit",)),
    "method a list": (_edit("method_name: splatfacto", "method_name: [1]"), ("method_name",)),
    "degree text": (_model("sh_degree: three"), ("pipeline.model.sh_degree", "three")),
    "degree a float": (_model("sh_degree: 3.0"), ("pipeline.model.sh_degree",)),
    "degree true": (_model("sh_degree: true"), ("pipeline.model.sh_degree",)),
    "degree negative": (_model("sh_degree: -1"), ("pipeline.model.sh_degree",)),
    "degree 4": (_model("sh_degree: 4"), ("pipeline.model.sh_degree", "degree 4")),
    "degree null": (_model("sh_degree: null"), ("pipeline.model.sh_degree",)),
    "degree an object": (_model("sh_degree: !!python/name:os.system ''"), ("pipeline.model.sh_degree",)),
    "interval 0": (_model("sh_degree_interval: 0"), ("sh_degree_interval", "at least 1")),
    "mode": (_model("rasterize_mode: fancy"), ("rasterize_mode", "antialiased")),
    "mode a list": (_model("rasterize_mode: [classic]"), ("rasterize_mode",)),
    "color name": (_model("background_color: purple"), ("background_color", "purple")),
    "color of two": (_model("background_color: [0, 1]"), ("background_color",)),
    "color NaN": (_model("background_color: [0, 1, .nan]"), ("background_color",)),
    "color of 255": (_model("background_color: [0, 1, 255]"), ("background_color", "from 0 to 1")),
    "model folder above": (_edit("- nerfstudio_models", "- ..\n- x"), ("relative_model_dir",)),
    "model folder absolute": (_edit("- nerfstudio_models", "- /\n- etc"), ("relative_model_dir",)),
    "model folder an int": (
        _edit(
            "relative_model_dir: !!python/object/apply:pathlib.PosixPath\n- nerf",
            "relative_model_dir: 3\nx:\n- ",
        ),
        ("relative_model_dir",),
    ),
    "a model with arguments": (
        _called("model", "kwds: {rasterize_mode: antialiased}"),
        ("pipeline.model", "SplatfactoModelConfig", "state"),
    ),
    "a pipeline with arguments": (_called("pipeline", "args: [1]"), ("pipeline", "VanillaPipelineConfig", "state")),
    "a run with arguments": (_called("", "kwds: {load_step: 1}"), ("top level", "mapping")),
    "model folder absent": (_edit("- nerfstudio_models", "- weights"), ("weights", "no such folder")),
}


@pytest.mark.parametrize("case", BAD_CONFIGS)
def test_bad_config(run: Run, case: str) -> None:
    spoil, mentions = BAD_CONFIGS[case]
    spoil(run)
    refused(run.folder if case == "missing" else run.config, *mentions)


@pytest.mark.parametrize("section", ["", "pipeline", "model"])
def test_an_object_of_its_state_alone_is_that_mapping(run: Run, section: str) -> None:
    before = runs.read_config(run.config)
    _called(section, "args: []")(run)
    assert "state:" in run.config.read_text()
    after = runs.read_config(run.config)
    assert (after.model, after.method_name, after.model_folder) == (
        before.model,
        before.method_name,
        before.model_folder,
    )


@pytest.mark.parametrize(
    "payload",
    [
        "!!python/object/apply:os.system ['touch MARK']",
        "!!python/object/apply:builtins.open ['MARK', w]",
        "!!python/object/new:subprocess.Popen [[touch, 'MARK']]",
        "!!python/object/apply:subprocess.call\n  args: [[touch, 'MARK']]",
        '!!python/object/apply:builtins.exec [\'open("MARK", "w")\']',
    ],
)
@pytest.mark.parametrize("place", ["load_step: ", "data: ", "pipeline: "])
def test_yaml_runs_nothing(run: Run, tmp_path: Path, payload: str, place: str) -> None:
    mark = tmp_path / "mark"
    text = "".join(
        f"{place}{payload.replace('MARK', str(mark))}\n" if line.startswith(place) else line
        for line in CONFIG.splitlines(keepends=True)
        if place != "data: " or not line.startswith("- ")
    )
    run.config.write_text(text.replace("    data: *id003\n", ""))
    try:
        load_scene(run.config)
    except InputError as error:
        assert len(str(error).splitlines()) == 1
    runs_nothing = not mark.exists()
    assert runs_nothing


def _rewrite(run: Run, change: Callable[[str, bytes], bytes], **options: Any) -> None:
    """Write the archive again with changed members and right checksums."""
    with zipfile.ZipFile(run.checkpoint) as old:
        members = [(member.filename, change(member.filename, old.read(member))) for member in old.infolist()]
    with zipfile.ZipFile(run.checkpoint, "w", **options) as new:
        for name, data in members:
            new.writestr(name, data)


def _index(change: Callable[[bytes], bytes]) -> Spoil:
    return lambda run: _rewrite(run, lambda name, data: change(data) if name.endswith("data.pkl") else data)


def _with(**changes: Any) -> Spoil:
    return lambda run: run.save_with(**changes)


def _cut(part: float) -> Spoil:
    def spoil(run: Run) -> None:
        data = run.checkpoint.read_bytes()
        run.checkpoint.write_bytes(data[: int(part * len(data))])

    return spoil


def _value(name: str, row: int, value: float) -> Spoil:
    def spoil(run: Run) -> None:
        tensor = parameters()[name]
        tensor[row].reshape(-1)[0] = value
        run.save_with(**{name: tensor})

    return spoil


def _member_twice(run: Run) -> None:
    with zipfile.ZipFile(run.checkpoint, "a") as archive:
        archive.writestr("STEP-000029999/DATA.PKL", b"x")


def _plain_pickle(run: Run) -> None:
    run.checkpoint.write_bytes(pickle.dumps({"pipeline": {}}))


def _flip_in_data(run: Run) -> None:
    data = bytearray(run.checkpoint.read_bytes())
    where = data.index(parameters()["means"].numpy().tobytes())
    data[where + 3] ^= 1
    run.checkpoint.write_bytes(data)


def _compressed(run: Run) -> None:
    run.save_with(means=torch.zeros(200_000, 3))
    _rewrite(run, lambda _name, data: data, compression=zipfile.ZIP_DEFLATED)


def _legacy(run: Run) -> None:
    torch.save(checkpoint_of(parameters()), run.checkpoint, _use_new_zipfile_serialization=False)


def _script(run: Run) -> None:
    # torch.load takes an archive with this member for TorchScript.
    with zipfile.ZipFile(run.checkpoint, "a") as archive:
        archive.writestr("step-000029999/constants.pkl", b"x")


def _quantized(run: Run) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        run.save_with(means=torch.quantize_per_tensor(ROWS, 0.1, 0, torch.qint8))


ROWS = torch.zeros(GAUSSIANS, 3)
BAD_CHECKPOINTS: dict[str, tuple[Spoil, tuple[str, ...]]] = {
    "missing": (lambda run: run.checkpoint.unlink(), ("nerfstudio_models", "no step-*.ckpt")),
    "folder": (lambda run: _folder(run.checkpoint), ("folder",)),
    "symlink loop": (lambda run: _loop(run.checkpoint), ("links",)),
    "model folder is a file": (
        lambda run: (shutil.rmtree(run.checkpoint.parent), run.checkpoint.parent.write_text("")),
        ("nerfstudio_models",),
    ),
    "empty": (lambda run: run.checkpoint.write_bytes(b""), ("PyTorch",)),
    "text": (lambda run: run.checkpoint.write_text("hello"), ("PyTorch",)),
    "truncated at 10 %": (_cut(0.1), ("damaged",)),
    "truncated at 50 %": (_cut(0.5), ("damaged",)),
    "truncated at 99 %": (_cut(0.99), ("damaged",)),
    "plain pickle": (_plain_pickle, ("PyTorch",)),
    "legacy format": (_legacy, ("PyTorch",)),
    "TorchScript": (_script, ("archive",)),
    "bit flip in a tensor": (_flip_in_data, ("checksum",)),
    "compressed": (_compressed, ("compressed",)),
    "member twice": (_member_twice, ("twice",)),
    "index cut": (_index(lambda data: data[:-40]), ("damaged",)),
    "index empty": (_index(lambda data: b""), ("damaged",)),
    "index of zeros": (_index(lambda data: bytes(len(data))), ("damaged",)),
    "unknown torch name": (
        _index(lambda data: data.replace(b"_rebuild_tensor_v2", b"_rebuild_tensor_xx")),
        ("_rebuild_tensor_xx",),
    ),
    "storage too small": (
        _index(lambda data: data.replace(b"K\x05K\x0f\x8a", b"K\xffK\x0f\x8a").replace(b"K\x05K\x03", b"K\xfeK\x03")),
        ("checkpoint",),
    ),
    "a list": (lambda run: run.save([1, 2]), ("pipeline",)),
    "no pipeline": (lambda run: run.save({"step": 1}), ("pipeline",)),
    "pipeline a tensor": (lambda run: run.save({"pipeline": ROWS}), ("pipeline",)),
    "keys of ints": (lambda run: run.save({"pipeline": {1: ROWS}}), ("pipeline",)),
    "no Gaussians": (lambda run: run.save(checkpoint_of({})), ("means", "splatfacto")),
    "whole module": (lambda run: run.save({"pipeline": torch.nn.Linear(2, 2)}), ("nothing was run",)),
    "no opacities": (_with(opacities=None), ("gauss_params.opacities", "missing")),
    "no rest": (_with(features_rest=None), ("gauss_params.features_rest",)),
    "means a number": (_with(means=3), ("gauss_params.means",)),
    "means a scalar": (_with(means=torch.tensor(1.0)), ("gauss_params.means",)),
    "no rows": (
        lambda run: run.save(checkpoint_of(parameters(count=0))),
        ("gauss_params.means", "at least 1"),
    ),
    "means of two": (_with(means=torch.zeros(GAUSSIANS, 2)), ("gauss_params.means", "[5, 3]")),
    "rows differ": (_with(scales=torch.zeros(4, 3)), ("gauss_params.scales", "[4, 3]")),
    "scales text": (_with(scales="abc"), ("gauss_params.scales",)),
    "scales a list": (_with(scales=[[0.0] * 3] * GAUSSIANS), ("gauss_params.scales",)),
    "fewer bands": (_with(features_rest=torch.zeros(GAUSSIANS, 8, 3)), ("features_rest", "sh_degree 3")),
    "more bands": (_with(features_rest=torch.zeros(GAUSSIANS, 24, 3)), ("features_rest", "sh_degree 3")),
    "sparse": (_with(means=ROWS.to_sparse()), ("gauss_params.means", "sparse")),
    "quantized": (_quantized, ("means",)),
    "integers": (_with(means=ROWS.to(torch.int32)), ("gauss_params.means", "int32")),
    "booleans": (_with(means=ROWS.to(torch.bool)), ("gauss_params.means", "bool")),
    "complex": (_with(means=ROWS.to(torch.complex64)), ("gauss_params.means", "complex")),
    "meta": (_with(means=ROWS.to("meta")), ("gauss_params.means",)),
    "float64 overflow": (
        _with(means=torch.full((GAUSSIANS, 3), 1e300, dtype=torch.float64)),
        ("5 have a mean", "finite"),
    ),
    "expanded": (lambda run: run.save(checkpoint_of(expanded(10**6))), ("more values than the file holds",)),
    "expanded further": (lambda run: run.save(checkpoint_of(expanded(10**14))), ("GiB",)),
    "NaN": (_value("opacities", 2, float("nan")), ("opacities", "row 2", "1 rows", "--drop-nan-gaussians")),
    "all NaN": (_with(opacities=torch.full((GAUSSIANS, 1), float("nan"))), ("opacities", "5 rows")),
    "infinity": (_value("features_dc", 1, float("inf")), ("features_dc", "row 1")),
    "NaN in a band": (_value("features_rest", 4, float("nan")), ("features_dc", "row 4")),
    "scale too large": (_value("scales", 3, 88.8), ("scales", "row 3")),
    "scale too small": (_value("scales", 0, -87.4), ("scales", "row 0")),
    "all quaternions zero": (_with(quats=torch.zeros(GAUSSIANS, 4)), ("quats", "zero")),
    "tiny quaternion": (_with(quats=torch.full((GAUSSIANS, 4), 1e-25)), ("quats", "row 0")),
    "quaternion of flushed squares": (_with(quats=torch.full((GAUSSIANS, 4), 0.499 * 2.0**-50)), ("quats", "2^-100")),
    "huge quaternion": (_with(quats=torch.full((GAUSSIANS, 4), 1e25)), ("quats", "row 0")),
}


def expanded(count: int) -> dict[str, torch.Tensor]:
    return {name: value[:1].expand(count, *value.shape[1:]) for name, value in parameters().items()}


@pytest.mark.parametrize("case", BAD_CHECKPOINTS)
def test_bad_checkpoint(run: Run, case: str) -> None:
    spoil, mentions = BAD_CHECKPOINTS[case]
    spoil(run)
    refused(run.config, *mentions)


_GLOBALS = b"ccollections\nOrderedDict\n"
_TUPLES = b"".join(b"q" + bytes([k]) + b"h" + bytes([k]) + b"\x86" for k in range(60))


def _tensor(shape: bytes = b"K\x03\x85", strides: bytes = b"K\x01\x85") -> bytes:
    """The instructions of a tensor of three values in storage 1, after those of the protocol."""
    storage = b"(X\x07\x00\x00\x00storagectorch\nFloatStorage\nX\x01\x00\x00\x001X\x03\x00\x00\x00cpuK\x03tQ"
    return b"ctorch._utils\n_rebuild_tensor_v2\n(" + storage + b"K\x00" + shape + strides + b"\x89" + _GLOBALS + b")RtR"


_LIST = b"](" + b"N" * 1000 + b"e"
HOSTILE_INDICES: dict[str, tuple[bytes, str]] = {
    "attributes of a tensor": (
        b"\x80\x02" + _tensor() + b"}X\x07\x00\x00\x00stridesJ\x00\x00\x00\x40\x85sb.",
        "attributes of a value",
    ),
    "attributes of a storage": (
        b"\x80\x02" + _tensor().replace(b"Q", b"Q}X\x04\x00\x00\x00kindNsb") + b".",
        "attributes of a value",
    ),
    "a key of tuples in tuples": (b"\x80\x02}N" + _TUPLES + b"Ns.", "as a key"),
    "a key nested without end": (b"\x80\x02}N" + b"\x85" * 500_000 + b"Ns.", "as a key"),
    "keys of one hash": (b"\x80\x02}\x8a\x08\xff\xff\xff\xff\xff\xff\xff\x1fNs.", "as a key"),
    "members of tuples in tuples": (b"\x80\x04\x8f(N" + _TUPLES + b"\x90.", "as a key"),
    "too many instructions": (b"\x80\x02](" + b"]" * 2**20 + b"e.", "more than 1048576"),
    "mappings copied many times": (
        b"\x80\x02"
        + _GLOBALS
        + b"q\x01}("
        + b"".join(b"K" + bytes([k]) + b"N" for k in range(256))
        + b"uq\x02"
        + b"h\x01h\x02\x85R" * 1000
        + b".",
        "copy more values",
    ),
    "shapes copied many times": (b"\x80\x02ctorch\nSize\n" + _LIST + b"\x85R.", "dimensions"),
    "a shape of no values": (
        b"\x80\x02" + _tensor(b"K\x00\x8a\x08" + bytes(7) + b"\x20\x86", b"K\x01K\x01\x86") + b".",
        "too many values",
    ),
    "a shape of many sizes": (
        b"\x80\x02" + _tensor(b"(" + b"K\x01" * 65 + b"t", b"(" + b"K\x01" * 65 + b"t") + b".",
        "dimensions",
    ),
    "a shape of truths": (b"\x80\x02" + _tensor(b"\x88\x85") + b".", "size"),
    "a memo of many gigabytes": (b"\x80\x02}r\xff\xff\xff\x7f.", "LONG_BINPUT"),
    "text of many gigabytes": (b"\x80\x02X\xff\xff\xff\x7fabc.", "damaged"),
    "bytes of many gigabytes": (b"\x80\x05\x96\xff\xff\xff\xff\xff\x00\x00\x00abc.", "damaged"),
    "an instance by name": (b"(icollections\nOrderedDict\n.", "INST"),
    "a name from the stack": (b"\x80\x04\x8c\x02os\x8c\x06system\x93.", "nothing was run"),
    "an extension's code": (b"\x80\x02\x82\x01.", "EXT1"),
    "an object in text": (b"P1\n.", "PERSID"),
    "a new object": (b"\x80\x02" + _GLOBALS + b")\x81.", "NEWOBJ"),
    "attributes of a function": (b"\x80\x02" + _GLOBALS + b"N}X\x04\x00\x00\x00callNs\x86b.", "damaged"),
    "a mapping of one number": (b"\x80\x02" + _GLOBALS + b"K\x01\x85R.", "damaged"),
    "a tensor of nothing": (b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n(NK\x00))tR.", "storage"),
    "a storage of another kind": (b"\x80\x02(X\x07\x00\x00\x00storageNX\x01\x00\x00\x000NK\x01tQ.", "unknown type"),
    "nested without end": (b"\x80\x02" + b"]" * 100_000 + b"a" * 99_999 + b".", "pipeline"),
}


@pytest.mark.parametrize("case", HOSTILE_INDICES)
def test_hostile_index(run: Run, case: str) -> None:
    index, mention = HOSTILE_INDICES[case]
    _index(lambda _data: index)(run)
    refused(run.config, mention)


def test_a_mapping_keeps_no_attributes(run: Run) -> None:
    """torch.save stores those of a module's state; a file could hide methods by them."""
    content = checkpoint_of(parameters())
    content["pipeline"] = OrderedDict(content["pipeline"])
    content["pipeline"].get = content["pipeline"].keys = None  # type: ignore[method-assign]
    expected = load_scene(run.config)
    run.save(content)
    assert equal(expected, load_scene(run.config))


def test_tensors_are_read_as_torch_reads_them(run: Run) -> None:
    """Views with offsets and strides, shared storages, and other kinds in the same file."""
    base = torch.arange(60, dtype=torch.float32).reshape(3, 4, 5)
    found: dict[str, Any] = {
        "base": base, "row": base[1], "column": base[:, 2], "turned": base.permute(2, 0, 1), "every": base[::2, 1::2],
        "none": base[:0], "number": base[1, 2, 3], "half": base.half()[1:], "double": base.double() / 3,
    }  # fmt: skip
    torch.save({**found, "integers": base.long(), "text": "x", "list": [1, (2.5, None)]}, run.checkpoint)
    read = checkpoint.read_checkpoint(run.checkpoint)
    for name, tensor in found.items():
        values = read[name].float32(run.checkpoint, name)
        assert values.shape == tuple(tensor.shape) and np.array_equal(values, tensor.float().numpy()), name
    assert read["integers"].kind == "int64" and read["text"] == "x" and read["list"] == [1, (2.5, None)]


def test_another_byte_order_is_refused(run: Run) -> None:
    _rewrite(run, lambda name, data: b"big" if name.endswith("byteorder") else data)
    refused(run.config, "byte order")


@pytest.mark.slow
def test_splats_are_opened_without_torch(run: Run) -> None:
    """It takes seconds to load."""
    code = "import sys, ns_abstract; ns_abstract.load_scene(sys.argv[1]).method(); sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", code, str(run.config)], check=True)


@pytest.mark.parametrize("place", ["root", "pipeline", "schedulers"])
@pytest.mark.parametrize("function", [os.system, eval, Path, bytearray])
def test_pickle_runs_nothing(run: Run, tmp_path: Path, place: str, function: Callable[..., Any]) -> None:
    mark = tmp_path / "mark"
    argument: Any = {os.system: f"touch {mark}", eval: f"open({str(mark)!r}, 'w')"}.get(function, str(mark))
    call = Call(function, 10**15 if function is bytearray else argument)
    content: Any = checkpoint_of(parameters())
    if place == "root":
        content = call
    else:
        content[place]["x"] = call
    run.save(content)
    refused(run.config, "nothing was run")
    assert not mark.exists()


def test_archive_that_claims_more_than_it_holds(run: Run) -> None:
    data = bytearray(run.checkpoint.read_bytes())
    central = data.rindex(b"PK\x01\x02")
    data[central + 20 : central + 28] = struct.pack("<II", 2**31, 2**31)
    run.checkpoint.write_bytes(data)
    refused(run.config, "larger than the file")


def test_memory_is_checked_before_reading(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available_memory", lambda: 1000)
    refused(run.config, "GiB", "memory")
    monkeypatch.setattr(memory, "available_memory", lambda: None)
    assert load_scene(run.config).count == GAUSSIANS


@pytest.mark.parametrize("limit", [0.0, -1.0, float("nan"), float("inf")])
def test_limits_of_memory_that_are_none(limit: float) -> None:
    with pytest.raises(InputError, match="--memory-limit: found"):
        memory.allowed_memory(limit)


def test_available_memory() -> None:
    found = memory.available_memory()
    assert found is None or found > 2**20


BAD_TRANSFORMS: dict[str, tuple[str | bytes, tuple[str, ...]]] = {
    "empty": ("", ("empty",)),
    "syntax": ('{"transform": [[1,0,0,0]', ("line 1",)),
    "not UTF-8": (b'{"scale": "\xff"}', ("UTF-8",)),
    "a list": ("[1]", ("top level",)),
    "no transform": ('{"scale": 1}', ("transform",)),
    "two rows": (json.dumps({**TRANSFORM, "transform": TRANSFORM["transform"][:2]}), ("transform", "3x4")),
    "short row": ('{"transform": [[1,0,0],[0,1,0],[0,0,1]], "scale": 1}', ("transform", "3x4")),
    "text in a row": ('{"transform": [[1,0,0,"a"],[0,1,0,0],[0,0,1,0]], "scale": 1}', ("transform[0][3]",)),
    "NaN": ('{"transform": [[1,0,0,0],\n[0,NaN,0,0],[0,0,1,0]], "scale": 1}', ("NaN", "line 2")),
    "singular": ('{"transform": [[1,0,0,0],[0,0,0,0],[0,0,1,0]], "scale": 1}', ("transform", "inverted")),
    "huge": ('{"transform": [[1e300,0,0,0],[0,1e300,0,0],[0,0,1,0]], "scale": 1}', ("transform",)),
    "no scale": (json.dumps({"transform": TRANSFORM["transform"]}), ("scale",)),
    "scale 0": (json.dumps({**TRANSFORM, "scale": 0}), ("scale", "above 0")),
    "scale negative": (json.dumps({**TRANSFORM, "scale": -1}), ("scale", "above 0")),
    "scale true": (json.dumps({**TRANSFORM, "scale": True}), ("scale",)),
    "scale infinite": (json.dumps(TRANSFORM).replace("0.5}", "1e999}"), ("line 1",)),
    "scale twice": (json.dumps(TRANSFORM)[:-1] + ', "scale": 2}', ("scale", "twice")),
    "deep": ("[" * 100_000, ("nested",)),
}


@pytest.mark.parametrize("case", BAD_TRANSFORMS)
def test_bad_transforms(run: Run, case: str) -> None:
    text, mentions = BAD_TRANSFORMS[case]
    run.transforms.write_bytes(text.encode() if isinstance(text, str) else text)
    refused(run.config, "dataparser_transforms.json", *mentions)


def test_transforms_behind_a_dangling_link(run: Run) -> None:
    run.transforms.unlink()
    run.transforms.symlink_to(run.folder / "absent.json")
    refused(run.config, "dataparser_transforms.json")


def _header(old: bytes, new: bytes) -> Callable[[bytes], bytes]:
    def change(data: bytes) -> bytes:
        assert old in data
        return data.replace(old, new, 1)

    return change


LIST_ELEMENT = b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
BAD_PLYS: dict[str, tuple[Callable[[bytes], bytes], tuple[str, ...]]] = {
    "empty": (lambda data: b"", ("header",)),
    "no magic": (lambda data: b"x" + data, ("header",)),
    "only magic": (lambda data: b"ply\n", ("header",)),
    "cut in the header": (lambda data: data[:200], ("header",)),
    "cut after the header": (lambda data: data[: data.index(b"end_header\n") + 11], ("cut off",)),
    "cut in the data": (lambda data: data[:-1], ("cut off",)),
    "huge count": (_header(b"vertex 5", b"vertex 999999999999"), ("cut off",)),
    "larger count": (_header(b"vertex 5", b"vertex 6"), ("cut off",)),
    "count of 40 digits": (_header(b"vertex 5", b"vertex " + b"9" * 40), ("header",)),
    "negative count": (_header(b"vertex 5", b"vertex -5"), ("header",)),
    "no rows": (_header(b"vertex 5", b"vertex 0"), ("vertex",)),
    "no vertex": (_header(b"vertex 5", b"points 5"), ("vertex",)),
    "no opacity": (_header(b"float opacity", b"float opacify"), ("vertex.opacity",)),
    "no rotation": (_header(b"float rot_3", b"float rod_3"), ("vertex.rot_3",)),
    "compressed": (
        _header(b"float f_dc_0", b"float packed_0"),
        ("header", "expected chunk, vertex and sh"),
    ),
    "colors": (_header(b"float f_dc_0", b"float red"), ("vertex.f_dc_0", "sh_coeffs")),
    "one coefficient less": (_header(b"float f_rest_44", b"float g_rest_44"), ("f_rest_", "44 properties")),
    "a gap": (_header(b"float f_rest_7\n", b"float f_rest_77\n"), ("f_rest_",)),
    "property twice": (_header(b"float ny", b"float nx"), ("header",)),
    "unknown type": (_header(b"float ny", b"quad ny"), ("header",)),
    "integer mean": (_header(b"float x", b"int x"), ("vertex.x", "int")),
    "list": (_header(b"property float ny", b"property list uchar float ny"), ("vertex", "list")),
    "list element": (_header(b"end_header\n", LIST_ELEMENT), ("face", "list")),
    "no format": (_header(b"format binary_little_endian 1.0\n", b""), ("header", "format")),
    "unknown format": (_header(b"binary_little_endian", b"binary_middle_endian"), ("header", "format")),
    "comment not ASCII": (_header(b"element vertex", b"comment \xe9\nelement vertex"), (".ply",)),
    "element twice": (_header(b"end_header", b"element vertex 0\nproperty float x\nend_header"), (".ply",)),
    "text as binary": (_header(b"binary_little_endian", b"ascii"), (".ply",)),
    "infinity": (lambda data: data[:-20] + struct.pack("<f", float("inf")) + data[-16:], ("scale_", "row 4")),
}


@pytest.mark.parametrize("case", BAD_PLYS)
def test_bad_ply(tmp_path: Path, case: str) -> None:
    path = write_ply(tmp_path / "scene.ply", ply_table())
    change, mentions = BAD_PLYS[case]
    path.write_bytes(change(path.read_bytes()))
    refused(path, "scene.ply", *mentions)


@pytest.mark.parametrize(
    ("old", "new"),
    [(r"^\S+ ", ""), (r"^\S+", "1,5"), (r"^", "0.5 "), (r"^.*\n", "")],
)
def test_bad_text_ply(tmp_path: Path, old: str, new: str) -> None:
    path = write_ply(tmp_path / "scene.ply", ply_table(rest=0), text=True)
    head, body = path.read_text().split("end_header\n")
    path.write_text(f"{head}end_header\n{re.sub(old, new, body, count=1)}")
    refused(path, "scene.ply")


def test_zero_quaternions_of_a_ply_are_dropped(tmp_path: Path) -> None:
    table = ply_table()
    for i in range(4):
        table[f"rot_{i}"][0] = 0
    scene = load_scene(write_ply(tmp_path / "scene.ply", table))
    assert (scene.count, scene.dropped) == (GAUSSIANS - 1, {"zero quaternion": 1})


@pytest.mark.parametrize("name", ["absent", "absent.yml", "absent.ply", "a\0b", "x" * 300, "a/" * 3000])
def test_absent_paths(tmp_path: Path, name: str) -> None:
    refused(tmp_path / name)


def test_other_files(run: Run) -> None:
    refused(run.checkpoint, "config.yml")
    refused(run.checkpoint.parent, "config.yml")
    refused(Path("/dev/zero"), "regular")


@pytest.mark.parametrize("name", ["config", "checkpoint", "transforms"])
def test_permission(run: Run, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    forbidden = getattr(run, name)
    opened = Path.open

    # Not by chmod: the superuser reads everything.
    def refuse(path: Path, *arguments: Any, **options: Any) -> Any:
        if path == forbidden:
            raise PermissionError(errno.EACCES, "Permission denied")
        return opened(path, *arguments, **options)

    monkeypatch.setattr(Path, "open", refuse)
    refused(run.config, forbidden.name, "Permission denied", "permissions")


# Fuzzing

FUZZ = settings(
    max_examples=150,
    deadline=None,
    database=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


def _damage(data: bytes, seed: int, flips: int) -> bytes:
    generator = random.Random(seed)
    damaged = bytearray(data)
    for _ in range(flips):
        choice = generator.randrange(4)
        where = generator.randrange(len(damaged))
        if choice <= 1:
            damaged[where] ^= 1 << generator.randrange(8)
        elif choice == 2:
            damaged[where] = generator.choice(b"\0\n [{:-\"'!&*9~\xff")
        else:
            end = where + generator.randrange(1, 9)
            damaged[where:end] = damaged[where:end] * generator.randrange(3)
            damaged = damaged or bytearray(b"x")
    return bytes(damaged)


def _loads_or_refuses(path: Path) -> None:
    try:
        load_scene(path)
    except InputError as error:
        assert len(str(error).splitlines()) == 1


@pytest.mark.slow
@FUZZ
@given(seed=st.integers(0, 2**32), flips=st.integers(1, 12))
def test_fuzzed_config(run: Run, seed: int, flips: int) -> None:
    run.config.write_bytes(_damage(CONFIG.encode(), seed, flips))
    _loads_or_refuses(run.config)


@pytest.mark.slow
@FUZZ
@given(seed=st.integers(0, 2**32), flips=st.integers(1, 12))
def test_fuzzed_transforms(run: Run, seed: int, flips: int) -> None:
    run.transforms.write_bytes(_damage(json.dumps(TRANSFORM).encode(), seed, flips))
    _loads_or_refuses(run.config)


@pytest.mark.slow
@FUZZ
@given(seed=st.integers(0, 2**32), flips=st.integers(1, 6))
def test_fuzzed_checkpoint(run: Run, seed: int, flips: int) -> None:
    original = run.checkpoint.read_bytes()
    run.checkpoint.write_bytes(_damage(original, seed, flips))
    try:
        _loads_or_refuses(run.config)
    finally:
        run.checkpoint.write_bytes(original)


@pytest.mark.slow
@FUZZ
@given(seed=st.integers(0, 2**32), flips=st.integers(1, 6))
def test_fuzzed_index_with_right_checksums(run: Run, seed: int, flips: int) -> None:
    original = run.checkpoint.read_bytes()
    _index(lambda data: _damage(data, seed, flips))(run)
    try:
        _loads_or_refuses(run.config)
    finally:
        run.checkpoint.write_bytes(original)


@pytest.mark.slow
@FUZZ
@given(seed=st.integers(0, 2**32), flips=st.integers(1, 6), text=st.booleans(), header=st.booleans())
def test_fuzzed_ply(tmp_path: Path, seed: int, flips: int, text: bool, header: bool) -> None:
    path = write_ply(tmp_path / "scene.ply", ply_table(count=2, rest=0), text=text)
    data = path.read_bytes()
    end = data.index(b"end_header\n") + 11 if header else len(data)
    path.write_bytes(_damage(data[:end], seed, flips) + data[end:])
    _loads_or_refuses(path)
