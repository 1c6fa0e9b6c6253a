"""The command lines from outside: exit codes, one-line errors, signals, resuming, stored cells."""

from __future__ import annotations

import dataclasses
import errno
import importlib.util
import json
import os
import pickle
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import SHIFT, InProcess, Inputs, blob_scene, environment, ring
from interrupting import check_ended_in_a_library_call, check_interrupted, interrupted_at
from waiting import LONG, until

from ns_abstract.api.files import Settings, open_job
from ns_abstract.cli import demo as demo_command
from ns_abstract.cli import render as render_command
from ns_abstract.cli.common import complaint
from ns_abstract.geometry.camera_path import load_camera_path
from ns_abstract.geometry.keyframe_cameras import KeyframeCamera, path_json
from ns_abstract.io.atomic import write_json
from ns_abstract.io.folder import MARK
from ns_abstract.methods.program_options import ProgramOptions
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.report.figures import listed
from ns_abstract.report.files import StoredFrame, load_frame

MODULE = "ns_abstract.cli.render"
POSE = {"version": 1}
SIX = {"translation": {"x": 0.2, "y": 0.2, "z": 0.2}, "rotation": {"yaw": 0.2, "pitch": 0.2, "roll": 0.2}}


@pytest.fixture
def call(in_process: InProcess) -> Callable[..., tuple[int, str]]:
    """Runs a command in this process: exit code and what it wrote to stderr."""

    def run(options: list[str], main: Callable[[], None] = render_command.main) -> tuple[int, str]:
        code, _, err = in_process(main, options)
        return code, err

    return run


def outside(options: list[str], *python: str, module: str = MODULE, **more: Any) -> subprocess.CompletedProcess[str]:
    """Runs a command in a process of its own."""
    return subprocess.run(
        [sys.executable, *python, "-m", module, *options],
        capture_output=True, text=True, timeout=900, check=False, env=environment(), **more,
    )  # fmt: skip


def one_line(code: int, text: str, *fragments: str) -> None:
    """A user's mistake: exit code 2, one line that names what the fragments say and how to mend it."""
    assert code == 2, text
    assert text.count("\n") == 1 and text.endswith("\n"), text
    assert text.startswith("error: ")
    assert "Traceback" not in text
    for fragment in fragments:
        assert fragment in text, text
    assert "; " in text, "no fix is named"


def report(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "report.json").read_text())


def frame(folder: Path, index: int) -> StoredFrame:
    return load_frame(folder / f"frame_{index:05d}.npz")


def same_pictures(first: StoredFrame, second: StoredFrame) -> None:
    for name in ("lower", "upper", "witness_lower", "witness_upper", "image"):
        np.testing.assert_array_equal(getattr(first.result, name), getattr(second.result, name), name)


def check_samples(inputs: Inputs, folder: Path, index: int, **settings: Any) -> None:
    """Renders at random poses lie in a stored frame's bounds, without any tolerance."""
    settings["program"] = ProgramOptions(settings.pop("renderer", None))
    job = open_job(Settings(inputs.config, inputs.path, inputs.spec, **settings))
    live, result = job.frame(index), frame(folder, index).result
    for values in live.box.sample(12, np.random.default_rng(5)):
        picture = live.renderer.image(live.camera, *live.pose_set.world_to_camera(values))
        assert (result.lower <= picture).all() and (picture <= result.upper).all()


# ---------------------------------------------------------------- help


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    ("module", "option"),
    [
        (MODULE, "--output-dir"),
        ("ns_abstract.cli.demo", "--output-dir"),
        ("ns_abstract.cli.viewer", "--viewer.websocket-port"),
        ("ns_abstract.cli.export", "mp4"),
        ("ns_abstract.cli.check", "--claims"),
    ],
)
def test_help_is_light(module: str, option: str) -> None:
    shown = outside(["--help"], "-X", "importtime", module=module)
    assert shown.returncode == 0
    assert option in shown.stdout
    loaded = {line.rpartition("|")[2].strip().split(".")[0] for line in shown.stderr.splitlines()}
    assert "tyro" in loaded
    assert not loaded & {"torch", "numba", "nerfstudio", "matplotlib", "numpy"}


def test_help_states_every_option_and_exit_code() -> None:
    shown = outside(["--help"]).stdout
    for option in (
        "load-config", "camera-path-filename", "output-dir", "perturbation-filename", "time-budget", "target-ratio",
        "frames", "downscale-factor", "renderer", "arithmetic", "seed", "engine", "scheduler-address", "resume",
        "save-cells", "memory-limit",
    ):  # fmt: skip
        assert f"--{option}" in shown
    assert "2 bad input" in shown and "3 interrupted" in shown


# ---------------------------------------------------------------- mistakes

Change = Callable[[Inputs], "dict[str, Any] | None"]


def text(name: str, content: str | bytes) -> Change:
    """Replace a file of the inputs."""

    def change(inputs: Inputs) -> None:
        file = _file(inputs, name)
        file.unlink()
        file.write_bytes(content if isinstance(content, bytes) else content.encode())

    return change


def _file(inputs: Inputs, name: str) -> Path:
    if name == "transforms":
        return inputs.config.parent / "dataparser_transforms.json"
    return getattr(inputs, name)


def edit(name: str, **values: Any) -> Change:
    """Set keys of a JSON file; ``entry_x`` sets x of the second camera, and Ellipsis removes a key."""

    def change(inputs: Inputs) -> None:
        file = _file(inputs, name)
        root = json.loads(file.read_text())
        for key, value in values.items():
            holder = root["camera_path"][1] if key.startswith("entry_") else root
            key = key.removeprefix("entry_")
            holder.pop(key, None)
            if value is not ...:
                holder[key] = value
        write_json(file, root)

    return change


def swap(old: str, new: str) -> Change:
    """Replace text in config.yml."""

    def change(inputs: Inputs) -> None:
        content = inputs.config.read_text()
        assert old in content
        inputs.config.write_text(content.replace(old, new))

    return change


def option(**values: Any) -> Change:
    """Give the command other options."""
    return lambda inputs: values


def _half_checkpoint(inputs: Inputs) -> None:
    data = inputs.checkpoint.read_bytes()
    inputs.checkpoint.write_bytes(data[: len(data) // 2])


def _weights(change: Callable[[dict[str, Any]], None]) -> Change:
    """Change the checkpoint's tensors."""

    def apply(inputs: Inputs) -> None:
        import torch

        state = torch.load(inputs.checkpoint, weights_only=True)
        change(state["pipeline"])
        torch.save(state, inputs.checkpoint)

    return apply


def _nan(pipeline: dict[str, Any]) -> None:
    pipeline["_model.gauss_params.opacities"][3, 0] = float("nan")


def _matrix(x: float, y: float, z: float) -> list[float]:
    return np.diag([x, y, z, 1.0]).flatten().tolist()


def _folder_of_file(inputs: Inputs) -> dict[str, Any]:
    return {"output_dir": inputs.spec / "below"}


MISTAKES: dict[str, tuple[Change, tuple[str, ...]]] = {
    # the run
    "no config": (lambda i: {"load_config": i.config.parent / "none.yml"}, ("none.yml",)),
    "empty config": (text("config", ""), ("config.yml",)),
    "config is no YAML": (text("config", "a: [1, 2"), ("config.yml", "YAML")),
    "config is a list": (text("config", "- 1\n- 2\n"), ("config.yml",)),
    "config is binary": (text("config", b"\xff\xfe\x00\x01"), ("config.yml", "UTF-8")),
    "wrong degree": (swap("sh_degree: 3", "sh_degree: 2"), ("features_rest", "sh_degree")),
    "wrong mode": (swap("rasterize_mode: classic", "rasterize_mode: fast"), ("config.yml", "rasterize_mode")),
    "wrong background": (swap("background_color:", "background_color: [2]\n    noise_lr:"), ("background_color",)),
    "no checkpoint": (lambda i: i.checkpoint.unlink(), ("nerfstudio_models", "step-")),
    "half a checkpoint": (_half_checkpoint, ("step-000029999.ckpt",)),
    "checkpoint is text": (text("checkpoint", "weights"), ("step-000029999.ckpt", "not a PyTorch checkpoint")),
    "no Gaussians": (_weights(lambda p: p.pop("_model.gauss_params.means")), ("gauss_params.means",)),
    "NaN among the opacities": (_weights(_nan), ("gauss_params.opacities", "row 3")),
    "transform is no JSON": (text("transforms", "{"), ("dataparser_transforms.json", "JSON")),
    "a checkpoint as scene": (lambda i: {"load_config": i.checkpoint}, (".ckpt", "config.yml")),
    # the camera path
    "no path": (lambda i: {"camera_path_filename": i.path.parent / "none.json"}, ("none.json", "no such camera path")),
    "path is a folder": (lambda i: {"camera_path_filename": i.path.parent}, ("is a folder",)),
    "path is no JSON": (text("path", "{'a': 1}"), ("camera_path.json", "line 1")),
    "path is a list": (text("path", "[]"), ("camera_path.json", "object")),
    "no entries": (edit("path", camera_path=[]), ("camera_path.json", "camera_path")),
    "angle of zero": (edit("path", entry_fov=0), ("camera_path[1].fov", "degrees")),
    "no angle": (edit("path", entry_fov=..., default_fov=...), ("camera_path[1].fov", "missing")),
    "15 numbers": (edit("path", entry_camera_to_world=[0.0] * 15), ("camera_path[1].camera_to_world", "16")),
    "NaN in the path": (text("path", '{"render_height": NaN}'), ("camera_path.json", "NaN")),
    "mirror": (edit("path", entry_camera_to_world=_matrix(1.0, 1.0, -1.0)), ("[1].camera_to_world", "mirror")),
    "stretched": (edit("path", entry_camera_to_world=_matrix(2.0, 2.0, 2.0)), ("[1].camera_to_world", "orthonormal")),
    "no height": (edit("path", render_height=0), ("camera_path.json", "render_height")),
    "fisheye": (edit("path", camera_type="fisheye"), ("camera_type", "perspective")),
    "crop": (edit("path", crop={}), ("crop",)),
    "key twice": (text("path", '{"fps": 1, "fps": 2}'), ("camera_path.json", "fps", "twice")),
    # the set of poses
    "no perturbation": (option(perturbation_filename=None), ("camera_path.json", "perturbation")),
    "perturbation file missing": (lambda i: {"perturbation_filename": i.path.parent / "none.json"}, ("none.json",)),
    "unknown key": (edit("spec", translations={"x": 1}), ("spec.json", "translations", "unknown key")),
    "unknown axis": (edit("spec", translation={"w": 1}), ("spec.json", "translation.w")),
    "reversed": (edit("spec", translation={"y": [0.2, -0.1]}), ("spec.json", "translation.y", "reversed")),
    "infinite": (text("spec", '{"translation": {"x": 1e999}}'), ("spec.json", "too large")),
    "negative radius": (edit("spec", rotation={"yaw": -0.1}), ("spec.json", "rotation.yaw", "-0.1")),
    "angle as text": (edit("spec", rotation={"yaw": "1 degree"}), ("spec.json", "rotation.yaw")),
    "list for an object": (edit("spec", translation=[0.1]), ("spec.json", "translation")),
    "hue": (edit("spec", hue=0.1), ("spec.json", "hue")),
    "scene": (edit("spec", scene=[]), ("spec.json", "scene")),
    "version": (edit("spec", version=2), ("spec.json", "version", "found 2")),
    "frame": (edit("spec", frame="body"), ("spec.json", "frame", "camera or world")),
    "no azimuth": (edit("spec", orbit={"target": [0, 0, 0], "axis": [0, 0, 1]}), ("spec.json", "orbit.azimuth")),
    "orbit without axis": (
        edit("spec", orbit={"target": [0, 0, 0], "axis": [0, 0, 0], "azimuth": [0, 1]}),
        ("spec.json", "orbit.axis"),
    ),
    "entry's own": (
        lambda i: edit("path", entry_perturbation={"rotation": {"yaw": [1, 0]}}, perturbation=SHIFT)(i)
        or {"perturbation_filename": None},
        ("camera_path.json", "camera_path[1].perturbation.rotation.yaw", "reversed"),
    ),
    # options
    "frame too large": (option(frames=[0, 3]), ("--frames", "found 3", "0 to 2")),
    "frame below zero": (option(frames=[-1]), ("--frames", "found -1")),
    "frame as text": (option(frames=["first"]), ("--frames", "first")),
    "factor of zero": (option(downscale_factor=0), ("--downscale-factor",)),
    "factor too large": (option(downscale_factor=100), ("--downscale-factor", "32x32")),
    "factor NaN": (option(downscale_factor="nan"), ("--downscale-factor",)),
    "ratio below 1": (option(target_ratio=0.9), ("--target-ratio", "0.9")),
    "budget below 0": (option(time_budget=-1), ("--time-budget",)),
    "budget NaN": (option(time_budget="nan"), ("--time-budget", "nan")),
    "negative seed": (option(seed=-1), ("--seed",)),
    "no memory": (option(memory_limit=0), ("--memory-limit",)),
    "too little memory": (option(memory_limit=0.001), ("--memory-limit", "need")),
    "address without engine": (option(scheduler_address="h:1"), ("--scheduler-address", "--engine dask")),
    "unknown renderer": (option(renderer="ray"), ("--renderer", "ray", "gsplat", "paper")),
    "unknown arithmetic": (option(arithmetic="half"), ("--arithmetic", "half")),
    "unknown option": (option(budget=3), ("--budget", "--time-budget")),
    "option without value": (option(time_budget=[]), ("--time-budget",)),
    "no scene": (option(load_config=None), ("--load-config", "missing")),
    "stray word": (option(resume=["yes"]), ("yes",)),
    "output is a file": (lambda i: {"output_dir": i.spec}, ("spec.json", "cannot be written")),
    "output below a file": (_folder_of_file, ("spec.json/below", "cannot be written")),
}  # fmt: skip


@pytest.mark.slow_cases(every=28)
@pytest.mark.parametrize("name", MISTAKES)
def test_mistake_is_one_line(
    name: str, make_blobs: Callable[..., Inputs], tmp_path: Path, call: Callable[..., tuple[int, str]]
) -> None:
    change, fragments = MISTAKES[name]
    inputs = make_blobs()
    changes = change(inputs)
    one_line(*call(inputs.options(tmp_path / "out", **(changes or {}))), *fragments)
    assert not list((tmp_path / "out").glob("frame_*"))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["path is no JSON", "unknown option", "half a checkpoint"])
def test_mistake_is_one_line_from_a_shell(name: str, make_blobs: Callable[..., Inputs], tmp_path: Path) -> None:
    change, fragments = MISTAKES[name]
    inputs = make_blobs()
    changes = change(inputs)
    done = outside(inputs.options(tmp_path / "out", **(changes or {})))
    one_line(done.returncode, done.stderr, *fragments)
    assert done.stdout == ""


def test_a_pipe_as_camera_path_does_not_hang(
    blobs: Inputs, tmp_path: Path, call: Callable[..., tuple[int, str]]
) -> None:
    os.mkfifo(tmp_path / "pipe")
    one_line(*call(blobs.options(tmp_path / "out", camera_path_filename=tmp_path / "pipe")), "not a regular file")


@pytest.mark.parametrize("boxes", [True, False])
@pytest.mark.parametrize("colours", [True, False])
@pytest.mark.parametrize("name", ["no scene", "unknown option", "unknown renderer", "frame as text"])
def test_every_kind_of_error_box_is_understood(
    blobs: Inputs,
    tmp_path: Path,
    call: Callable[..., tuple[int, str]],
    monkeypatch: pytest.MonkeyPatch,
    boxes: bool,
    colours: bool,
    name: str,
) -> None:
    from tyro import _fmtlib

    monkeypatch.setattr(_fmtlib, "_FORCE_UTF8_BOXES", boxes)
    monkeypatch.setattr(_fmtlib, "_FORCE_ANSI", colours)
    change, fragments = MISTAKES[name]
    code, said = call(blobs.options(tmp_path / "out", **(change(blobs) or {})))
    one_line(code, said, *fragments)
    assert "\x1b" not in said and "│" not in said and "helptext" not in said
    assert "perhaps ;" not in said and "missing ;" not in said


def test_no_error_box_at_all() -> None:
    assert complaint("") == "the options cannot be read"


# ---------------------------------------------------------------- nothing in the files is run


class _Touch:
    """Pickles as a call that makes a file."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> tuple[Any, ...]:
        return (os.system, (f"touch {self.file}",))


def test_pickle_in_the_checkpoint_is_not_run(
    make_blobs: Callable[..., Inputs], tmp_path: Path, call: Callable[..., tuple[int, str]]
) -> None:
    import torch

    inputs, mark = make_blobs(), tmp_path / "mark"
    state = torch.load(inputs.checkpoint, weights_only=True) | {"extra": _Touch(mark)}
    torch.save(state, inputs.checkpoint)
    one_line(*call(inputs.options(tmp_path / "out")), "step-000029999.ckpt", "system", "nothing was run")
    assert not mark.exists()
    pickle.loads(pickle.dumps(_Touch(mark)))
    assert mark.exists(), "the payload does nothing, so the test above shows nothing"


def test_python_tags_in_the_config_are_not_run(
    make_blobs: Callable[..., Inputs], tmp_path: Path, call: Callable[..., tuple[int, str]]
) -> None:
    import yaml

    inputs, mark = make_blobs(), tmp_path / "mark"
    payload = f"!!python/object/apply:os.system ['touch {mark}']"
    inputs.config.write_text(inputs.config.read_text() + f"extra: {payload}\n")
    # an unknown key is none of our business
    code, said = call(inputs.options(tmp_path / "out", frames=[0], time_budget=20))
    assert code == 0, said
    assert not mark.exists()
    # the same where a value is needed
    config = inputs.config.read_text()
    inputs.config.write_text(config.replace("rasterize_mode: classic", f"rasterize_mode: {payload}"))
    one_line(*call(inputs.options(tmp_path / "out2")), "rasterize_mode")
    assert not mark.exists()
    yaml.unsafe_load(payload)
    assert mark.exists(), "the payload does nothing, so the test above shows nothing"


# ---------------------------------------------------------------- runs


@pytest.fixture(scope="module")
def finished(blobs: Inputs, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output of an undisturbed run over all frames."""
    folder = tmp_path_factory.mktemp("finished") / "made" / "deeper"
    done = outside(blobs.options(folder, time_budget=120))
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.slow
def test_a_run_writes_what_it_promises(blobs: Inputs, finished: Path) -> None:
    names = {file.name for file in finished.iterdir()}
    frames = {f"frame_0000{k}.{kind}" for k in range(3) for kind in ("npz", "png")}
    assert names == frames | {"report.json", "report.html", MARK}
    document = report(finished)
    assert (document["version"], document["state"], document["guarantee"]) == (1, "done", "float32-sound")
    assert document["renderer"] == {"name": "gsplat", "version": "1.4.0"}
    assert [entry["index"] for entry in document["frames"]] == [0, 1, 2]
    for entry in document["frames"]:
        assert 1.0 <= entry["ratio"] <= 1.05
        assert entry["trace"][-1]["mpg"] == pytest.approx(entry["mpg"])
        stored = frame(finished, entry["index"])
        assert stored.status == "done"
        assert stored.result.box.names == ("x",)
        check_samples(blobs, finished, entry["index"])


@pytest.mark.slow
def test_frames_and_size_are_those_asked_for(
    blobs: Inputs, tmp_path: Path, call: Callable[..., tuple[int, str]]
) -> None:
    assert call(blobs.options(tmp_path, frames=[2, 0, 2], downscale_factor=2, time_budget=60))[0] == 0
    assert sorted(file.name for file in tmp_path.glob("*.npz")) == ["frame_00000.npz", "frame_00002.npz"]
    assert frame(tmp_path, 2).result.lower.shape == (16, 16, 3)
    check_samples(blobs, tmp_path, 2, downscale_factor=2)


@pytest.mark.parametrize(
    ("options", "guarantee", "name"),
    [({"renderer": "paper"}, "float32-sound", "paper"), ({"arithmetic": "real"}, "real-sound", "gsplat")],
)
def test_other_renderers(
    blobs: Inputs,
    tmp_path: Path,
    call: Callable[..., tuple[int, str]],
    options: dict[str, str],
    guarantee: str,
    name: str,
) -> None:
    assert call(blobs.options(tmp_path, frames=[1], time_budget=60, **options))[0] == 0
    document = report(tmp_path)
    assert (document["guarantee"], document["renderer"]["name"]) == (guarantee, name)
    assert document["frames"][0]["ratio"] <= 1.05
    camera = load_camera_path(blobs.path).cameras[1]
    assert document["frames"][0]["intrinsics"] == camera.intrinsics._asdict()
    check_samples(blobs, tmp_path, 1, **options)


@pytest.mark.slow
def test_real_bounds_lie_inside_float32_bounds_of_one_pose(
    make_blobs: Callable[..., Inputs], tmp_path: Path, call: Callable[..., tuple[int, str]]
) -> None:
    inputs = make_blobs(spec={"translation": {"x": [0.01, 0.01]}, "rotation": {"yaw": [0.02, 0.02]}})
    results = {}
    for kind in ("real", "float32"):
        assert call(inputs.options(tmp_path / kind, frames=[0], arithmetic=kind))[0] == 0
        stored = frame(tmp_path / kind, 0)
        assert (stored.status, stored.result.box.names, stored.result.cells) == ("done", (), 1)
        check_samples(inputs, tmp_path / kind, 0, arithmetic=kind)
        results[kind] = stored.result
    widths = {kind: float((result.upper - result.lower).mean()) for kind, result in results.items()}
    assert widths["real"] <= widths["float32"] < 1e-2


def test_ply_gives_the_same_as_the_run(
    make_blobs: Callable[..., Inputs], tmp_path: Path, call: Callable[..., tuple[int, str]]
) -> None:
    scene = blob_scene()
    black = SplatScene(**{**vars(scene), "background": np.zeros(3, np.float32)})
    inputs = make_blobs(scene=black)
    write_ply(black, tmp_path / "scene.ply")
    for name, scene_file in (("run", inputs.config), ("ply", tmp_path / "scene.ply")):
        assert call(inputs.options(tmp_path / name, load_config=scene_file, frames=[0], time_budget=60))[0] == 0
    same_pictures(frame(tmp_path / "run", 0), frame(tmp_path / "ply", 0))


def write_ply(scene: SplatScene, file: Path) -> None:
    """A standard 3DGS .ply; f_rest is channel-major."""
    plyfile = pytest.importorskip("plyfile")
    columns = {
        **dict(zip(("x", "y", "z"), scene.means.T, strict=True)),
        **{f"f_dc_{c}": scene.sh[:, 0, c] for c in range(3)},
        **{f"f_rest_{k}": v for k, v in enumerate(scene.sh[:, 1:].transpose(2, 1, 0).reshape(-1, scene.count))},
        "opacity": scene.opacity_logits,
        **{f"scale_{k}": scene.log_scales[:, k] for k in range(3)},
        **{f"rot_{k}": scene.quats[:, k] for k in range(4)},
    }
    rows = np.array(list(zip(*columns.values(), strict=True)), [(name, "f4") for name in columns])
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")]).write(str(file))


# ---------------------------------------------------------------- stored cells


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    "spec",
    [SHIFT, {"translation": {"x": 0.01}, "rotation": {"yaw": [-0.005, 0.01]}}],
    ids=["shift", "shift and yaw"],
)
def test_stored_cells_cover_the_set_and_hold_renders(
    make_blobs: Callable[..., Inputs], tmp_path: Path, call: Callable[..., tuple[int, str]], spec: dict[str, Any]
) -> None:
    # no multiple of the tile's side, so that tiles reach beyond the picture
    inputs = make_blobs(views=[KeyframeCamera(view.camera_to_world, view.fov, 24, 40) for view in ring(1)], spec=spec)
    assert call(inputs.options(tmp_path / "out", save_cells=True, time_budget=5))[0] == 0
    result = frame(tmp_path / "out", 0).result
    leaves, box = result.leaves, result.box
    assert leaves is not None
    side = leaves.b_lower.shape[1]
    whole = float(np.prod(np.array(box.upper) - np.array(box.lower)))
    volume = np.prod(leaves.box_upper - leaves.box_lower, axis=1)
    tiles = sorted(set(map(tuple, leaves.tile.tolist())))
    assert tiles == [(row, column) for row in range(0, 24, side) for column in range(0, 40, side)]
    for tile in tiles:
        mine = (leaves.tile == tile).all(axis=1)
        assert volume[mine].sum() == pytest.approx(whole, rel=1e-12)
    live = open_job(Settings(inputs.config, inputs.path, inputs.spec)).frame(0)
    rng = np.random.default_rng(11)
    for values in [*box.sample(25, rng), *box.corners()]:
        picture = live.renderer.image(live.camera, *live.pose_set.world_to_camera(values))
        holds = np.flatnonzero(((leaves.box_lower <= values) & (values <= leaves.box_upper)).all(axis=1))
        assert sorted(set(map(tuple, leaves.tile[holds].tolist()))) == tiles
        for row in holds:
            low, high = (end[row].astype(np.longdouble) for end in (leaves.box_lower, leaves.box_upper))
            scaled = (2.0 * values - low - high) / (high - low)
            top, left = leaves.tile[row]
            part = picture[top : top + side, left : left + side]
            inner = np.s_[: part.shape[0], : part.shape[1]]
            below = (leaves.A_lower[row][inner] * scaled).sum(axis=-1) + leaves.b_lower[row][inner]
            above = (leaves.A_upper[row][inner] * scaled).sum(axis=-1) + leaves.b_upper[row][inner]
            assert (below <= part).all() and (part <= above).all()


# ---------------------------------------------------------------- budget, resuming, signals


def test_budget_too_small_for_every_frame(blobs: Inputs, tmp_path: Path, call: Callable[..., tuple[int, str]]) -> None:
    code, said = call(blobs.options(tmp_path, time_budget=0.001))
    assert code == 3
    assert "no bounds yet for frames 1, 2" in said
    document = report(tmp_path)
    assert (document["state"], document["missing"], document["interrupted"]) == ("budget", [1, 2], False)
    check_samples(blobs, tmp_path, 0)


@pytest.mark.parametrize("place", ["save_frame", "save_picture"])
def test_a_full_disk_is_not_told_as_the_end_of_the_time(
    place: str, blobs: Inputs, tmp_path: Path, in_process: InProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(f"ns_abstract.report.record.{place}", full)
    code, _, err = in_process(render_command.main, blobs.options(tmp_path, frames=0, time_budget=0.5))
    assert code == 2 and "No space left on device; make room there" in err
    assert report(tmp_path)["state"] == "interrupted"


@pytest.mark.slow
def test_budget_reached_with_a_result_for_every_frame_is_success(
    make_blobs: Callable[..., Inputs], tmp_path: Path, call: Callable[..., tuple[int, str]]
) -> None:
    inputs = make_blobs(views=ring(1), spec=SIX)
    code, said = call(inputs.options(tmp_path / "out", time_budget=0.5, target_ratio=1.0))
    assert code == 0 and "frame 0 ended before the target: go on with --resume" in said
    document = report(tmp_path / "out")
    assert document["frames"][0]["status"] == "partial"
    assert document["missing"] == []
    check_samples(inputs, tmp_path / "out", 0)


@pytest.mark.slow
def test_resuming_keeps_finished_frames_and_ends_the_same(
    blobs: Inputs, finished: Path, tmp_path: Path, call: Callable[..., tuple[int, str]]
) -> None:
    # as if the first run had been stopped after two frames
    assert call(blobs.options(tmp_path, frames=[0, 1], time_budget=120))[0] == 0
    before = {k: (tmp_path / f"frame_0000{k}.npz").read_bytes() for k in (0, 1)}
    code, said = call(blobs.options(tmp_path, time_budget=120, resume=True))
    assert code == 0
    assert "kept from before: frames 0, 1" in said
    for k, data in before.items():
        assert (tmp_path / f"frame_0000{k}.npz").read_bytes() == data
    for k in range(3):
        same_pictures(frame(tmp_path, k), frame(finished, k))
    assert report(tmp_path)["state"] == "done" and "go on with" not in said
    code, said = call(blobs.options(tmp_path, time_budget=120, resume=True))
    assert code == 0 and "every frame has reached the target" in said


@pytest.mark.slow
def test_resuming_with_any_budget_gets_on(blobs: Inputs, tmp_path: Path, call: Callable[..., tuple[int, str]]) -> None:
    missing = []
    for _ in range(3):
        code, _ = call(blobs.options(tmp_path, time_budget=0.001, resume=True))
        missing.append(report(tmp_path)["missing"])
        assert code == (3 if missing[-1] else 0)
    assert missing == [[1, 2], [2], []]


@pytest.mark.slow
def test_damaged_frames_are_computed_again(
    blobs: Inputs, finished: Path, tmp_path: Path, call: Callable[..., tuple[int, str]]
) -> None:
    assert call(blobs.options(tmp_path, frames=[0, 1], time_budget=120))[0] == 0
    file = tmp_path / "frame_00001.npz"
    file.write_bytes(file.read_bytes()[:-200])
    code, said = call(blobs.options(tmp_path, frames=[0, 1], time_budget=120, resume=True))
    assert code == 0
    assert "frame_00001.npz" in said
    same_pictures(frame(tmp_path, 1), frame(finished, 1))


@pytest.mark.slow_cases
@pytest.mark.parametrize("change", ["spec", "downscale_factor", "renderer", "arithmetic", "scene"])
def test_resuming_with_other_settings_is_refused(
    change: str, make_blobs: Callable[..., Inputs], tmp_path: Path, call: Callable[..., tuple[int, str]]
) -> None:
    inputs, folder = make_blobs(), tmp_path / "out"
    assert call(inputs.options(folder, time_budget=60, frames=[0]))[0] == 0
    before = (folder / "frame_00000.npz").read_bytes()
    changes: dict[str, Any] = {"downscale_factor": 2, "renderer": "paper", "arithmetic": "real"}
    if change == "spec":
        write_json(inputs.spec, SHIFT | {"translation": {"x": 0.031}})
    elif change == "scene":
        _weights(lambda p: p["_model.gauss_params.means"].mul_(1.001))(inputs)
    extra = {change: changes[change]} if change in changes else {}
    one_line(*call(inputs.options(folder, resume=True, frames=[0], **extra)), "report.json", "--output-dir")
    assert (folder / "frame_00000.npz").read_bytes() == before


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=["SIGINT", "SIGTERM"])
def test_signal_saves_what_is_finished(number: int, make_blobs: Callable[..., Inputs], tmp_path: Path) -> None:
    inputs, folder = make_blobs(), tmp_path / "out"
    # two frames of one pose each are done at once, the third takes all the time it is given
    path = path_json(ring(), perturbation=POSE)
    path["camera_path"][2]["perturbation"] = SIX
    write_json(inputs.path, path)
    options = inputs.options(folder, perturbation_filename=None, time_budget=900, target_ratio=1.0)
    command = [sys.executable, "-m", MODULE, *options]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment())
    try:
        until((folder / "frame_00001.png").exists, alive=lambda: process.poll() is None)
        time.sleep(0.5)
        assert process.poll() is None
        process.send_signal(number)
        _, said = process.communicate(timeout=LONG)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 3, said
    assert "Traceback" not in said
    assert "being saved" in said
    document = report(folder)
    assert (document["state"], document["interrupted"]) == ("interrupted", True)
    assert [entry["status"] for entry in document["frames"]][:2] == ["done", "done"]
    for index in (0, 1):
        assert frame(folder, index).status == "done"
    assert all(frame(folder, entry["index"]).status == entry["status"] for entry in document["frames"])
    assert not list(folder.glob("*.part"))
    assert "</html>" in (folder / "report.html").read_text()


@pytest.mark.slow
@pytest.mark.parametrize(
    "place",
    [
        "ns_abstract.cli.rendering:open_job",
        "ns_abstract.cli.rendering:compile_beside",
        "ns_abstract.api.job:Job.warm_up",
        "ns_abstract.api.job:Job.bound_part",
    ],
)
def test_interrupted_before_the_first_frame(
    place: str, blobs: Inputs, finished: Path, tmp_path: Path, in_process: InProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "out"
    options = blobs.options(folder, frames=[0], time_budget=120)
    with monkeypatch.context() as patched:
        interrupted_at(place, patched)
        check_interrupted(in_process, render_command.main, options, folder)
    assert folder.exists() == ("open_job" not in place)
    if "bound_part" in place:
        assert in_process(render_command.main, [*options, "--resume"])[0] == 0
        same_pictures(frame(folder, 0), frame(finished, 0))


@pytest.mark.slow
def test_ended_while_kernels_are_compiled(blobs: Inputs, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    options = blobs.options(folder, frames=[0])
    check_ended_in_a_library_call(MODULE, "ns_abstract.cli.rendering.compile_beside", options, folder)


# ---------------------------------------------------------------- cluster


def test_engine_without_dask_says_how_to_get_it(
    blobs: Inputs, tmp_path: Path, call: Callable[..., tuple[int, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    one_line(*call(blobs.options(tmp_path / "out", engine="dask")), "--engine", "ns-abstract[cluster]")


needs_dask = pytest.mark.skipif(importlib.util.find_spec("distributed") is None, reason="dask is not installed")


@pytest.mark.slow
@needs_dask
def test_cluster_on_this_machine_gives_the_same(blobs: Inputs, finished: Path, tmp_path: Path) -> None:
    # relative paths: a worker's folder is another one
    here = blobs.path.parent
    options = [re.sub(rf"^{re.escape(str(here))}/", "", word) for word in blobs.options(tmp_path, time_budget=120)]
    done = outside([*options, "--engine", "dask", "--frames", "2", "0"], cwd=here)
    assert done.returncode == 0, done.stderr
    for index in (0, 2):
        same_pictures(frame(tmp_path, index), frame(finished, index))


@needs_dask
def test_worker_with_other_files_is_refused(blobs: Inputs, tmp_path: Path) -> None:
    from ns_abstract.api.bounding import TileTask, bound_part
    from ns_abstract.io.errors import InputError

    job = open_job(Settings(blobs.config, blobs.path, blobs.spec))
    goal = job.goal(1.5, 1.0, 2)
    assert bound_part(job.recipe, TileTask(0, None), goal, False).index == 0
    with pytest.raises(InputError, match="other content"):
        other = dataclasses.replace(job.recipe, fingerprint=job.fingerprint | {"scene": "another"})
        bound_part(other, TileTask(0, None), goal, False)


@pytest.mark.slow
@needs_dask
def test_no_scheduler_at_the_address(
    blobs: Inputs, tmp_path: Path, call: Callable[..., tuple[int, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    from ns_abstract.execution import cluster

    monkeypatch.setattr(cluster, "_CONNECT", "1s")
    options = blobs.options(tmp_path / "out", engine="dask", scheduler_address="127.0.0.1:1")
    one_line(*call(options), "--scheduler-address", "127.0.0.1:1", "dask scheduler")


# ---------------------------------------------------------------- the demo


def test_demo_into_a_file_is_refused(tmp_path: Path, call: Callable[..., tuple[int, str]]) -> None:
    (tmp_path / "file").write_text("")
    one_line(*call(["--output-dir", str(tmp_path / "file")], demo_command.main), "file", "--output-dir")


def test_demo_replaces_no_files_of_others(tmp_path: Path, call: Callable[..., tuple[int, str]]) -> None:
    mine = tmp_path / "camera_path.json"
    mine.write_text("mine")
    one_line(*call(["--output-dir", str(tmp_path)], demo_command.main), "camera_path.json", "--output-dir")
    assert mine.read_text() == "mine" and list(tmp_path.iterdir()) == [mine]


def test_demo_options_are_checked(call: Callable[..., tuple[int, str]]) -> None:
    one_line(*call([], demo_command.main), "--output-dir", "missing")


def test_demo_writes_what_the_next_command_needs(
    tmp_path: Path, call: Callable[..., tuple[int, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert call(["--output-dir", str(tmp_path), "--splats-only"], demo_command.main)[0] == 0
    job = open_job(
        Settings(
            next((tmp_path / "airfield").rglob("config.yml")), tmp_path / "camera_path.json", tmp_path / "SPEC.json"
        )
    )
    assert job.frame_count == 5
    assert job.pose_sets[0].box.names == ("x",)
    assert len(list((tmp_path / "data" / "images").glob("*.png"))) == 10
    # an earlier demo is written anew
    assert call(["--output-dir", str(tmp_path), "--splats-only"], demo_command.main)[0] == 0


def test_many_frames_are_told_in_few_words() -> None:
    assert listed([]) == "" and listed([4]) == "4" and listed([0, 1]) == "0, 1" and listed([0, 1, 3]) == "0, 1, 3"
    assert listed(range(7, 100000)) == "7 to 99999" and listed([0, 2, 3, 4, 9]) == "0, 2 to 4, 9"
    assert listed(range(0, 100, 2)) == "0, 2, 4, 6, 8, 10, 12, 14 and others, 50 together"


def test_a_machine_without_a_temporary_folder_is_one_line(
    blobs: Inputs, call: Callable[..., tuple[int, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Libraries look for one while they are imported."""

    def library(options: object) -> int:
        monkeypatch.setattr(tempfile, "tempdir", None)
        monkeypatch.setattr(tempfile, "_candidate_tempdir_list", lambda: [str(tmp_path / "missing")])
        return len(tempfile.gettempdir())

    monkeypatch.setattr(render_command, "render", library)
    options = ["--load-config", str(blobs.config), "--camera-path-filename", str(blobs.path)]
    code, err = call([*options, "--output-dir", str(tmp_path / "out")])
    one_line(code, err, "No usable temporary directory", "TMPDIR")
