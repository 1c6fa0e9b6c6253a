"""At home in the real nerfstudio: its eval_setup, viewer, trainer, renderer and evaluation, without CUDA or network."""

from __future__ import annotations

import dataclasses
import importlib
import itertools
import json
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import blob_scene, ring
from nerfstudio_runs import Server, command, environment, free_port, lpips_cache, needs_nerfstudio, wrapped
from PIL import Image
from waiting import LONG, until

from ns_abstract.cli.viewer import Viewer
from ns_abstract.geometry.camera_path import load_camera_path
from ns_abstract.geometry.keyframe_cameras import path_json
from ns_abstract.io.errors import InputError
from ns_abstract.methods.load import load_any
from ns_abstract.methods.nerf.render import NerfRenderer, Sampling
from ns_abstract.methods.nerf.scene import Encoding, NerfScene
from ns_abstract.methods.overrides import Overrides
from ns_abstract.methods.runs import Tagged
from ns_abstract.methods.splat.activate import activate
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0
from ns_abstract.methods.splat.load import load_scene
from ns_abstract.methods.splat.render import Renderer
from ns_abstract.methods.splat.write import write_ply, write_splatfacto_run
from ns_abstract.nerfstudio import torchvision_operators
from ns_abstract.perturbation.specification import load_perturbation
from ns_abstract.viewer.background import Status
from ns_abstract.viewer.views import ViewRequest, perturbation_of

pytestmark = [needs_nerfstudio, pytest.mark.filterwarnings("ignore")]
STAMP = "2026-01-01_000000"
#: With a background that nerfstudio has a name for.
SCENE = dataclasses.replace(blob_scene(), background=np.array([0.1490, 0.1647, 0.2157], np.float32))
OUTPUTS = ["abstract_lower", "abstract_upper", "abstract_gap", "abstract_witness"]


@pytest.fixture(scope="module")
def nerfstudio() -> SimpleNamespace:
    """nerfstudio's modules and this package's beside them."""
    torchvision_operators.declare_missing()
    # nerfstudio's other way of registration, for when this package is not installed
    found = [
        f"{n}=ns_abstract.nerfstudio.methods:{n.replace('-', '_')}" for n in ("abstract-nerf", "abstract-splatfacto")
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NERFSTUDIO_METHOD_CONFIGS", ",".join(found))
        importlib.import_module("nerfstudio.configs.method_configs")
    names = ("loading", "methods", "nerf", "outputs", "panel", "pipeline", "splat", "viewing")
    modules = {name: importlib.import_module(f"ns_abstract.nerfstudio.{name}") for name in names}
    modules["method_configs"] = importlib.import_module("nerfstudio.configs.method_configs")
    return SimpleNamespace(Cameras=importlib.import_module("nerfstudio.cameras.cameras").Cameras, **modules)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A working directory of nerfstudio with a run of `blob_scene` and its data set."""
    where = tmp_path_factory.mktemp("nerfstudio")
    views = ring(8, 40)
    write_splatfacto_run(SCENE, where, timestamp=STAMP, experiment_name="blobs", views=views)
    (where / "path.json").write_text(json.dumps(path_json(ring(2, 24), seconds=1.0)))
    lpips_cache(where)
    return where


@pytest.fixture(scope="module")
def config_file(folder: Path) -> Path:
    return folder / "blobs" / "splatfacto" / STAMP / "config.yml"


@pytest.fixture(scope="module")
def opened(nerfstudio: SimpleNamespace, config_file: Path) -> tuple[Any, Any]:
    """The stock run, opened by the real eval_setup: configuration and pipeline."""
    config, pipeline, step = nerfstudio.viewing.open_run(config_file)
    assert step == 29999
    return config, pipeline


@pytest.fixture
def model(opened: tuple[Any, Any]) -> Iterator[Any]:
    found = opened[1].model
    found._source = None
    yield found
    found._background.close()
    found.set_crop(None)


def longer(background: Any, seconds: float) -> Callable[[], None]:
    """Asks for more time for the last view, twice as much each time: a busy machine may need any number of seconds."""
    times = (seconds * 2.0**k for k in itertools.count())
    return lambda: background.more(next(times))


def cameras(nerfstudio: SimpleNamespace, k: int = 0, height: int = 40, width: int = 56) -> Any:
    import torch

    focal = 0.5 * height / np.tan(np.radians(22.5))
    pose = torch.from_numpy(ring()[k].camera_to_world[:3].astype(np.float32))
    return nerfstudio.Cameras(pose[None], focal, focal, 0.5 * width, 0.5 * height)


def abstract_run(nerfstudio: SimpleNamespace, folder: Path, config_file: Path) -> Path:
    """The run as ns-train abstract-splatfacto would have left it."""
    import yaml

    run = folder / "blobs" / "abstract-splatfacto" / STAMP
    if not run.exists():
        shutil.copytree(config_file.parent, run)
        stock = yaml.load(config_file.read_text(), Loader=yaml.Loader)
        config = dataclasses.replace(nerfstudio.methods.abstract_splatfacto.config)
        for name in ("data", "experiment_name", "output_dir", "timestamp", "machine", "relative_model_dir", "vis"):
            setattr(config, name, getattr(stock, name))
        config.pipeline = dataclasses.replace(config.pipeline, datamanager=stock.pipeline.datamanager)
        config.pipeline.model = nerfstudio.splat.AbstractSplatfactoModelConfig.of(stock.pipeline.model)
        config.pipeline.model.abstract.seconds = 1.0
        (run / "config.yml").write_text(yaml.dump(config))
    return run / "config.yml"


# ---------------------------------------------------------------- opening


@pytest.mark.slow
def test_the_real_eval_setup_opens_the_run(opened: tuple[Any, Any], nerfstudio: SimpleNamespace) -> None:
    _, pipeline = opened
    assert isinstance(pipeline, nerfstudio.pipeline.AbstractPipeline)
    np.testing.assert_array_equal(pipeline.model.means.detach().numpy(), SCENE.means)
    assert len(pipeline.datamanager.cached_eval) == 1


@pytest.mark.slow
def test_a_run_that_was_moved_opens(nerfstudio: SimpleNamespace, folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder / "blobs", tmp_path / "elsewhere" / "renamed")
    shutil.copytree(folder / "data", tmp_path / "elsewhere" / "data")
    file = tmp_path / "elsewhere" / "renamed" / "splatfacto" / STAMP / "config.yml"
    config, pipeline, _ = nerfstudio.viewing.open_run(file)
    assert config.load_dir == file.parent / "nerfstudio_models"
    assert pipeline.model.num_points == 50
    shutil.rmtree(tmp_path / "elsewhere" / "data")
    with pytest.raises(InputError, match=r"no data set data; start the command"):
        nerfstudio.viewing.open_run(file)


@pytest.mark.slow
def test_other_methods_are_refused(nerfstudio: SimpleNamespace, folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder / "blobs", tmp_path / "blobs")
    file = tmp_path / "blobs" / "splatfacto" / STAMP / "config.yml"
    text = file.read_text()
    file.write_text(text.replace("models.splatfacto.SplatfactoModel", "models.tensorf.TensoRFModel"))
    with pytest.raises(InputError, match=r"names the model class 'nerfstudio.models.tensorf.TensoRFModel'"):
        nerfstudio.viewing.open_run(file)
    file.write_text(text.replace("engine.trainer.TrainerConfig", "engine.trainer.NoSuchConfig"))
    with pytest.raises(InputError, match="nerfstudio cannot open it"):
        nerfstudio.viewing.open_run(file)


@pytest.mark.slow
def test_options_of_the_scene_reach_the_viewer(nerfstudio: SimpleNamespace, folder: Path) -> None:
    file = folder / "blobs" / "splatfacto" / STAMP / "config.yml"
    overrides = Overrides(rasterize_mode="antialiased", background=(1.0, 0.5, 0.0), load_step=29999)
    config, pipeline, step = nerfstudio.viewing.open_run(file, overrides=overrides)
    assert (config.load_step, step) == (29999, 29999)
    assert pipeline.model.config.rasterize_mode == "antialiased"
    assert pipeline.model._get_background_color().tolist() == [1.0, 0.5, 0.0]
    for refused in (Overrides(load_step=3), Overrides(assume_splatfacto=True), Overrides(drop_nan_gaussians=True)):
        with pytest.raises(InputError, match="--"):
            nerfstudio.viewing.open_run(file, overrides=refused)


def test_ply_opens(nerfstudio: SimpleNamespace, tmp_path: Path) -> None:
    write_ply(blob_scene(), tmp_path / "scene.ply")
    _, pipeline, _ = nerfstudio.viewing.open_run(nerfstudio.viewing.run_of_ply(tmp_path / "scene.ply", tmp_path))
    np.testing.assert_array_equal(pipeline.model.means.detach().numpy(), blob_scene().means)


# ---------------------------------------------------------------- outputs


def test_outputs_are_splatfactos(model: Any, nerfstudio: SimpleNamespace, config_file: Path) -> None:
    camera = cameras(nerfstudio)
    found = model.get_outputs(camera)
    splats = activate(load_scene(config_file), GSPLAT_1_4_0)
    view = nerfstudio.panel.camera_of(camera)
    pose = view.camera_to_world
    renderer = Renderer(splats, GSPLAT_1_4_0)
    expected = renderer.image(view, pose[:, :3].T * np.array([1.0, -1.0, -1.0])[:, None], pose[:, 3])
    np.testing.assert_array_equal(found["rgb"].numpy(), expected.astype(np.float32))
    for name, channels in (("depth", 1), ("accumulation", 1), ("background", 3)):
        assert found[name].shape == (40, 56, channels)
        assert found[name].isfinite().all()
    # black and white backgrounds tell how much of them shows
    shown = []
    for colour in (0.0, 1.0):
        plain = dataclasses.replace(splats, background=np.full(3, colour))
        renderer = Renderer(plain, GSPLAT_1_4_0)
        layers = renderer.layers(view, pose[:, :3].T * np.array([1.0, -1.0, -1.0])[:, None], pose[:, 3])
        shown.append(layers)
    low, high = (layers[0][..., 0] for layers in shown)
    free = high < 1.0
    np.testing.assert_allclose((1.0 - shown[0][1][..., 0])[free], (high - low)[free], atol=1e-12)


def test_depth_of_one_gaussian(nerfstudio: SimpleNamespace) -> None:
    scene = blob_scene(1)
    scene = dataclasses.replace(scene, means=np.zeros((1, 3), np.float32), opacity_logits=np.full(1, 9.0, np.float32))
    view = nerfstudio.panel.camera_of(cameras(nerfstudio))
    pose = view.camera_to_world
    renderer = Renderer(activate(scene, GSPLAT_1_4_0), GSPLAT_1_4_0)
    _, accumulation, depth = renderer.layers(view, pose[:, :3].T * np.array([1.0, -1.0, -1.0])[:, None], pose[:, 3])
    expected = float(-(pose[:, :3].T @ -pose[:, 3])[2])
    assert accumulation[20, 28, 0] > 0.9 and accumulation[0, 0, 0] == 0.0
    np.testing.assert_allclose(depth, expected, rtol=1e-12)


@pytest.mark.parametrize("attack", ["poses", "lower bound raised"])
def test_abstract_outputs_hold(model: Any, nerfstudio: SimpleNamespace, attack: str) -> None:
    found = model.get_outputs_for_camera(cameras(nerfstudio))
    assert list(found)[-4:] == OUTPUTS
    shapes = [tuple(found[name].shape) for name in OUTPUTS]
    assert shapes == [(40, 56, 3), (40, 56, 3), (40, 56, 1), (40, 56, 1)]
    lower, upper = (found[name].numpy() for name in OUTPUTS[:2])
    if attack != "poses":
        lower = lower + np.float32(0.02)
    assert (found["abstract_witness"] <= found["abstract_gap"]).all()
    violations = 0
    rng = np.random.default_rng(1)
    for shift in (0.0, -0.01, 0.01, *rng.uniform(-0.01, 0.01, 20)):
        moved = cameras(nerfstudio)
        right = moved.camera_to_worlds[0, :, 0].double()
        position = moved.camera_to_worlds[0, :, 3].double() + float(shift) * right
        moved.camera_to_worlds[0, :, 3] = position.float()
        picture = model.get_outputs(moved)["rgb"].numpy()
        violations += int(((picture < lower) | (picture > upper)).sum())
    # shifts are rounded to float32 here, so the ends stay inside up to that
    assert (violations == 0) == (attack == "poses")


@pytest.mark.slow
def test_crop_and_background_reach_the_bounds(
    model: Any, nerfstudio: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    import torch
    from nerfstudio.data.scene_box import OrientedBox

    whole = model.get_outputs_for_camera(cameras(nerfstudio))
    box = OrientedBox.from_params((0.0, 0.0, 0.0), (0.0, 0.0, 0.3), (0.4, 0.4, 0.4))
    part = model.get_outputs_for_camera(cameras(nerfstudio), box)
    assert not torch.equal(whole["rgb"], part["rgb"])
    assert (part["abstract_lower"] <= part["rgb"]).all() and (part["rgb"] <= part["abstract_upper"]).all()
    nothing = OrientedBox.from_params((9.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.1, 0.1, 0.1))
    empty = model.get_outputs_for_camera(cameras(nerfstudio), nothing)
    assert (empty["accumulation"] == 0).all() and empty["rgb"].unique().numel() <= 3
    assert (empty["abstract_lower"] <= empty["rgb"]).all() and (empty["rgb"] <= empty["abstract_upper"]).all()
    # there, Nerfstudio shows the viewer's colour, whatever the run's is (splatfacto.py:551-554)
    monkeypatch.setattr(model.config, "background_color", "white")
    monkeypatch.setattr(model, "background_color", torch.tensor([0.25, 0.5, 0.125]))
    empty = model.get_outputs_for_camera(cameras(nerfstudio), nothing)
    assert (empty["rgb"] == model.background_color).all()
    assert (empty["abstract_lower"] <= empty["rgb"]).all() and (empty["rgb"] <= empty["abstract_upper"]).all()
    monkeypatch.undo()
    source = model.abstract_source()
    assert model.abstract_source() is source
    model.set_crop(None)
    assert model.abstract_source() is not source


def test_no_abstract_outputs_in_training(model: Any, nerfstudio: SimpleNamespace) -> None:
    model.train()
    try:
        with pytest.raises(RuntimeError, match="CUDA only"):
            model.get_outputs(cameras(nerfstudio))
    finally:
        model.eval()
    model._evaluating = False
    try:
        assert not set(OUTPUTS) & set(model.get_outputs_for_camera(cameras(nerfstudio)))
    finally:
        model._evaluating = True


def test_an_error_leaves_trivial_bounds(
    model: Any, nerfstudio: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail() -> None:
        raise ArithmeticError("trouble")

    monkeypatch.setattr(model, "abstract_source", fail)
    found = model.get_outputs_for_camera(cameras(nerfstudio))
    assert (found["abstract_lower"] == 0).all() and (found["abstract_upper"] == 1).all()
    assert found["rgb"].shape == (40, 56, 3)


def test_depth_outputs_hold(model: Any, nerfstudio: SimpleNamespace, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(model.config.abstract, "depth", True)
    monkeypatch.setattr(model.config.abstract, "gsplat_version", "1.5.3")
    monkeypatch.setattr(model, "_shown", None)
    found = model.get_outputs_for_camera(cameras(nerfstudio))
    assert list(found)[-2:] == ["abstract_depth_lower", "abstract_depth_upper"]
    assert model.abstract_source().version == "1.5.3"
    lower, upper = (found[name].numpy() for name in list(found)[-2:])
    assert lower.shape == (40, 56, 1) and (upper - lower).mean() < 1.0
    for shift in (0.0, -0.01, 0.01, *np.random.default_rng(1).uniform(-0.01, 0.01, 6)):
        moved = cameras(nerfstudio)
        position = moved.camera_to_worlds[0, :, 3].double() + float(shift) * moved.camera_to_worlds[0, :, 0].double()
        moved.camera_to_worlds[0, :, 3] = position.float()
        depth = model.get_outputs(moved)["depth"].numpy()
        assert ((lower <= depth) & (depth <= upper)).all()
    nothing = nerfstudio.outputs.pictures(None, 2, 3, depth=True)
    assert (nothing["abstract_depth_lower"] == 0.0).all() and (nothing["abstract_depth_upper"] == 1e10).all()


def test_pixels_of_small_pictures_are_repeated(nerfstudio: SimpleNamespace) -> None:
    from ns_abstract.viewer.views import Snapshot

    rng = np.random.default_rng(0)
    lower = rng.uniform(0.0, 0.5, (4, 6, 3)).astype(np.float32)
    snapshot = Snapshot(lower, lower + np.float32(0.5), lower, lower, {}, 0.0, 1, True, "float32-sound")
    found = nerfstudio.outputs.pictures(snapshot, 8, 18)
    np.testing.assert_array_equal(found["abstract_lower"], lower.repeat(2, 0).repeat(3, 1))
    assert (found["abstract_witness"] == 0).all()
    odd = nerfstudio.outputs.pictures(snapshot, 7, 5)
    assert odd["abstract_upper"].shape == (7, 5, 3)
    nothing = nerfstudio.outputs.pictures(None, 2, 3)
    assert (nothing["abstract_gap"] == np.float32(np.sqrt(3.0))).all()


# ---------------------------------------------------------------- the viewer


@pytest.fixture
def viewer(opened: tuple[Any, Any], model: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """nerfstudio's real viewer on localhost, as run_viewer starts it, with one client that is no browser."""
    from nerfstudio.configs.base_config import ViewerConfig
    from nerfstudio.scripts.viewer import run_viewer

    config, pipeline = opened
    config.vis = "viewer"
    config.viewer = ViewerConfig(websocket_port=free_port(), websocket_host="127.0.0.1")
    made: list[Any] = []
    original = run_viewer.ViewerState

    def remember(*arguments: Any, **options: Any) -> Any:
        made.append(original(*arguments, **options))
        return made[-1]

    def end(seconds: float) -> None:
        if seconds == 0.01 and made and getattr(made[0], "over", False):
            raise SystemExit
        time.sleep(seconds)

    monkeypatch.setattr(run_viewer, "ViewerState", remember)
    monkeypatch.setattr(run_viewer, "time", SimpleNamespace(sleep=end))
    thread = threading.Thread(target=run_viewer._start_viewer, args=(config, pipeline, 29999), daemon=True)
    thread.start()
    until(lambda: made and made[0].ready and hasattr(made[0], "camera_handles"), "the viewer")
    yield made[0]
    made[0].over = True
    thread.join(30)
    made[0].viser_server.stop()


class Machine:
    """Stands for a render thread with its client."""

    def __init__(self) -> None:
        self.actions: list[Any] = []
        self.client = SimpleNamespace(
            camera=SimpleNamespace(wxyz=(1.0, 0.0, 0.0, 0.0), position=(0.0, 0.0, 0.0), fov=0.8, aspect=1.0)
        )
        self.running = True

    def action(self, action: Any) -> None:
        self.actions.append(action)


@pytest.mark.slow
def test_viewer_finds_the_panel_and_works_in_the_background(
    viewer: Any, model: Any, nerfstudio: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = [path for path, _ in viewer.viewer_elements]
    assert all(path.startswith("Custom Elements/model/abstract/") for path in paths)
    names = [element.name for _, element in viewer.viewer_elements]
    units = {"0.001 units": ("x", "y", "z"), "mrad": ("yaw", "pitch", "roll"), "0.001": ("mean", "opacity", "color")}
    sliders = [f"± {name} ({unit})" for unit, kinds in units.items() for name in kinds]
    selection = ["select", "select what is in the middle"]
    assert names == ["figures", *sliders, *selection, "time by view (s)", "refine", "file", "send to certify"]
    assert model.abstract.control.present
    machine = Machine()
    viewer.render_statemachines[77] = machine
    model.abstract._seconds.value = 1.0
    camera = cameras(nerfstudio, height=80, width=100)

    def draw() -> dict[str, Any]:
        with viewer.train_lock:
            return model.get_outputs_for_camera(camera)

    first = draw()
    # nothing is waited for: what is not known yet is not claimed
    assert (first["abstract_lower"] == 0).all() and (first["abstract_upper"] == 1).all()

    more = longer(model._background, 1.0)

    def bounded() -> Any:
        """What is drawn once bounds say something of most of the picture."""
        if draw() and model._background.status.state != "idle":
            return None
        drawn = draw()
        if float(drawn["abstract_gap"].mean()) < 0.5:
            return drawn
        return more()

    found = until(bounded, "bounds")
    assert (found["abstract_lower"] <= found["rgb"]).all() and (found["rgb"] <= found["abstract_upper"]).all()
    # new pictures are asked for without a hand on the mouse
    assert machine.actions and {action.action for action in machine.actions} == {"step"}
    text = model.abstract._figures.text
    assert "(100 x 80)" in text and "MPG" in text and "ratio" in text and "float32-sound; done" in text
    # a slider: the set changes, what was known of the other set is not shown for it
    slider = model.abstract._sliders["yaw"]
    slider.value = 2.0
    slider.cb_hook(slider)
    moved = draw()
    assert (moved["abstract_lower"] == 0).all() and (moved["abstract_upper"] == 1).all()
    slider.value = 0.0
    again = draw()
    assert all((again[name] == found[name]).all() for name in OUTPUTS)
    # refine goes on
    cells = model._background.best(model.abstract._last, 1.0).cells
    model.abstract.elements[-3].cb_hook(model.abstract.elements[-3])
    until(lambda: model._background.status.state == "idle", "refinement")
    assert model._background.best(model.abstract._last, 1.0).cells >= cells
    # send to certify
    model.abstract._file.value = str(tmp_path / "sent" / "view.json")
    model.abstract.send()
    path = load_camera_path(tmp_path / "sent" / "view.json")
    assert load_perturbation(tmp_path / "sent" / "view.json") == perturbation_of({"x": 0.01})
    sent, shown = path.cameras[0], nerfstudio.panel.camera_of(camera)
    np.testing.assert_array_equal(sent.camera_to_world, shown.camera_to_world)
    np.testing.assert_allclose([sent.fx, sent.fy], [shown.fx, shown.fy], rtol=1e-12)
    assert (sent.width, sent.height) == (100, 80)
    said = model.abstract._figures.text
    assert "ns-abstract-certify" in said and "\n  --property PROP.json" in said
    # the panel is narrow: an option a line
    assert all(line.count(" --") <= 1 for line in said.splitlines())
    # the run's folder is never written to: not by name, and not from a shell that stands in it
    run_folder = model.abstract.control.folder
    before = sorted(run_folder.rglob("*"))
    model.abstract._file.value = str(run_folder / "view.json")
    model.abstract.send()
    assert "The run's folder stays as it is" in model.abstract._figures.text
    model.abstract._file.value = ""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    for where in (tmp_path, run_folder):
        monkeypatch.chdir(where)
        model.abstract.send()
    assert (tmp_path / "view_000.json").is_file() and sorted(run_folder.rglob("*")) == before
    # a variation of the scene: around what is in the middle of the picture, and sent as it is
    refined = draw()
    whole = float(refined["abstract_gap"].mean())
    assert whole <= float(found["abstract_gap"].mean())
    model.abstract.select_middle()
    box = json.loads(model.abstract._select.value)["box"]
    forward = -camera.camera_to_worlds[0, :, 2].numpy()
    middle = camera.camera_to_worlds[0, :, 3].numpy() + float(found["depth"][40, 50, 0]) * forward
    assert (np.array(box[0]) < middle).all() and (middle < np.array(box[1])).all()
    model.abstract._select.value = '{"box": [[-9, -9, -9], [9, 9, 9]]}'
    model.abstract._sliders["color"].value = 50.0
    assert (draw()["abstract_upper"] == 1).all()
    until(lambda: draw() and model._background.status.state == "idle", "bounds of the variation")
    varied = draw()
    assert float(varied["abstract_gap"].mean()) > whole
    assert (varied["abstract_lower"] <= varied["rgb"]).all() and (varied["rgb"] <= varied["abstract_upper"]).all()
    model.abstract._file.value = str(tmp_path / "varied.json")
    model.abstract.send()
    expected = perturbation_of({"x": 0.01, "color": 0.05}, model.abstract._select.value)
    assert load_perturbation(tmp_path / "varied.json") == expected and expected.scene
    assert "ns-abstract-render" in model.abstract._figures.text
    # whoever reaches the viewer replaces no file, and writes none of another kind
    for name, wrong in (("varied.json", "exists"), (".profile", "does not end in .json")):
        model.abstract._file.value = str(tmp_path / name) + "\0"
        before = (tmp_path / "varied.json").stat().st_mtime_ns
        model.abstract.send()
        assert f"{wrong}: give another" in model.abstract._figures.text
        assert (tmp_path / "varied.json").stat().st_mtime_ns == before and not (tmp_path / ".profile").exists()
    # what cannot be read is said, and nothing is claimed
    model.abstract._select.value = '{"box": '
    assert (draw()["abstract_upper"] == 1).all() and "not valid JSON" in model.abstract._figures.text
    model.abstract._select.value = "{}"
    model.abstract._sliders["color"].value = 0.0
    assert float(draw()["abstract_gap"].mean()) == whole
    model.abstract._file.value = "/proc/none/view.json"
    model.abstract.send()
    assert "cannot be written" in model.abstract._figures.text
    del viewer.render_statemachines[77]


@pytest.mark.slow
def test_render_thread_survives_interrupts(
    model: Any, nerfstudio: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A camera move raises an exception at any traced line; compiled code must not meet it."""
    from nerfstudio.viewer.render_state_machine import RenderStateMachine
    from nerfstudio.viewer_legacy.server.viewer_utils import IOChangeException, SetTrace

    machine = RenderStateMachine(SimpleNamespace(), 10.0, Machine().client)  # type: ignore[arg-type]
    camera = cameras(nerfstudio)
    inside: list[Any] = []
    original = Renderer.layers

    def layers(self: Renderer, *arguments: Any) -> Any:
        machine.interrupt_render_flag = True
        inside.append(sys.gettrace())
        return original(self, *arguments)

    monkeypatch.setattr(Renderer, "layers", layers)
    with pytest.raises(IOChangeException), SetTrace(machine.check_interrupt):
        model.get_outputs_for_camera(camera)
    assert inside == [None]
    assert sys.gettrace() is None


def test_requests_that_are_lost_are_made_again(nerfstudio: SimpleNamespace) -> None:
    made: list[int] = []
    heeded = threading.Event()

    def draw() -> None:
        made.append(len(made))
        if len(made) == 4:
            heeded.set()

    redraw = nerfstudio.panel.RedrawUntilCurrent(draw, heeded.is_set, 0.01)

    def over() -> bool:
        # each look starts the next one before it ends
        looks = [thread for thread in threading.enumerate() if getattr(thread, "function", None) == redraw._look]
        return not looks

    # and from then on as before
    for _ in range(2):
        heeded.clear()
        del made[:]
        redraw()
        until(over, "the last look")
        # the event is set by the fourth request, not before, and nothing is asked for after it
        assert heeded.is_set() and len(made) == 4


@pytest.mark.parametrize(
    ("status", "words"),
    [
        (Status("off"), ""),
        (Status("starting"), "starting"),
        (Status("working"), "refining …"),
        (Status("idle"), "done"),
        (Status("failed", "out of memory"), "stopped: out of memory"),
    ],
)
def test_every_state_has_words(nerfstudio: SimpleNamespace, status: Status, words: str) -> None:
    view = ViewRequest(nerfstudio.panel.camera_of(cameras(nerfstudio)), perturbation_of({"x": 0.01}))
    first, second = nerfstudio.panel.describe(view, None, status).split("\n")
    assert "no bounds yet" in first and second == words


def test_options_are_ns_viewers(nerfstudio: SimpleNamespace) -> None:
    from nerfstudio.configs.base_config import ViewerConfig
    from nerfstudio.scripts.viewer.run_viewer import RunViewer

    theirs = {entry.name: entry.default for entry in dataclasses.fields(ViewerConfig)}
    del theirs["num_rays_per_chunk"]
    # ours listens on this machine alone
    theirs["websocket_host"] = "127.0.0.1"
    assert {entry.name: entry.default for entry in dataclasses.fields(Viewer)} == theirs
    from ns_abstract.cli.viewer import ViewRun as Command

    names = [entry.name for entry in dataclasses.fields(RunViewer)]
    own = [entry.name for entry in dataclasses.fields(Command) if entry.name != "overrides"]
    assert own == [*names, "depth", "gsplat_version"]


# ---------------------------------------------------------------- registered methods


@pytest.mark.slow
@pytest.mark.parametrize(("ours", "theirs"), [("abstract_splatfacto", "splatfacto"), ("abstract_nerf", "vanilla-nerf")])
def test_methods_train_like_their_parents(nerfstudio: SimpleNamespace, ours: str, theirs: str) -> None:
    mine = getattr(nerfstudio.methods, ours).config
    stock = nerfstudio.method_configs.method_configs[theirs]
    for entry in dataclasses.fields(stock):
        if entry.name not in ("method_name", "pipeline"):
            assert getattr(mine, entry.name) == getattr(stock, entry.name), entry.name
    assert mine.pipeline.datamanager == stock.pipeline.datamanager
    for entry in dataclasses.fields(stock.pipeline.model):
        if entry.name != "_target":
            assert getattr(mine.pipeline.model, entry.name) == getattr(stock.pipeline.model, entry.name)


def test_nerf_has_the_chosen_size(nerfstudio: SimpleNamespace) -> None:
    import torch
    from nerfstudio.data.scene_box import SceneBox

    config = nerfstudio.nerf.AbstractNerfModelConfig(width=32, depth=3, num_frequencies=4, smoothness_penalty=0.1)
    with nerfstudio.loading.lpips_weights(download=False):
        model = config.setup(scene_box=SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3])), num_train_data=1)
    field = model.field_fine
    shapes = [tuple(layer.weight.shape) for layer in field.mlp_base.layers]
    assert shapes == [(32, 27), (32, 59), (32, 32)]
    assert field.direction_encoding.get_out_dim() == 15 and field.mlp_head.layers[0].weight.shape == (16, 47)
    # the penalty is the logarithm of the product of row sums, of both fields
    expected = []
    for one in (model.field_coarse, model.field_fine):
        layers = [layer.weight for layer in one.modules() if isinstance(layer, torch.nn.Linear)]
        expected.append(sum(float(np.log(np.abs(w.detach().numpy()).sum(axis=1).max())) for w in layers))
    rays = {
        f"{name}_{kind}": torch.zeros(2, n)
        for kind in ("coarse", "fine")
        for name, n in (("rgb", 3), ("accumulation", 1))
    }
    losses = model.get_loss_dict(rays, {"image": torch.zeros(2, 3)})
    np.testing.assert_allclose(float(losses["smoothness"]), 0.1 * np.mean(expected), rtol=1e-5)
    losses["smoothness"].backward()
    assert any(bool(p.grad.any()) for p in field.parameters() if p.grad is not None)
    # a steeper network has a larger bound, and really is no steeper than the bound says
    assert not nerfstudio.loading.lpips_known(model.lpips)


@pytest.mark.parametrize(
    ("lens", "said"),
    [({"camera_type": 2}, "perspective"), ({"distortion_params": [0.3, 0.1, 0.0, 0.0, 0.0, 0.0]}, "distorted")],
)
def test_other_lenses_of_a_nerf_are_drawn_and_not_bounded(
    nerfstudio: SimpleNamespace, monkeypatch: pytest.MonkeyPatch, lens: dict[str, Any], said: str
) -> None:
    import torch
    from nerfstudio.data.scene_box import SceneBox
    from nerfstudio.models.vanilla_nerf import NeRFModel

    config = nerfstudio.nerf.AbstractNerfModelConfig(width=8, depth=3, num_coarse_samples=8, num_importance_samples=8)
    with nerfstudio.loading.lpips_weights(download=False):
        model = config.setup(scene_box=SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3])), num_train_data=1).eval()
    model.start_evaluation()
    pose, size = torch.eye(4)[None, :3], (9.0, 9.0, 8.0, 8.0, 16, 16)
    given = {key: torch.tensor(value) if isinstance(value, list) else value for key, value in lens.items()}
    other, usual = nerfstudio.Cameras(pose, *size, **given), nerfstudio.Cameras(pose, *size)
    model.get_outputs_for_camera(usual)
    assert model.abstract_source() is not None
    model.get_outputs_for_camera(other)
    with pytest.raises(InputError, match=said):
        model.abstract_source()
    # in a viewer, too
    monkeypatch.setattr(model.abstract.control, "draw", lambda: None)
    model.abstract.control._present.set()
    model._speed = 100.0
    found = model.get_outputs_for_camera(other)
    shown, straight = (NeRFModel.get_outputs_for_camera(model, camera)["rgb_fine"] for camera in (other, usual))
    assert torch.equal(found["rgb_fine"], shown) and not torch.equal(shown, straight)
    assert (found["abstract_lower"] == 0).all() and (found["abstract_upper"] == 1).all()
    assert said in model.abstract._figures.text


# ---------------------------------------------------------------- nerfstudio's own commands


@pytest.mark.slow
@pytest.mark.parametrize("first", ["splat", "nerf"])
def test_registration_does_not_depend_on_what_is_imported_first(folder: Path, first: str) -> None:
    code = (
        "from ns_abstract.nerfstudio.torchvision_operators import declare_missing\ndeclare_missing()\n"
        f"import ns_abstract.nerfstudio.{first}\n"
        "from nerfstudio.configs.method_configs import all_methods\n"
        "assert {'abstract-nerf', 'abstract-splatfacto'} <= set(all_methods)"
    )
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code],
        env=environment(folder), capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


_TRAIN = [
    "--machine.device-type", "cpu", "--vis", "tensorboard", "--max-num-iterations", "3", "--steps-per-save", "2",
    "--steps-per-eval-image", "100000", "--steps-per-eval-batch", "100000", "--steps-per-eval-all-images", "100000",
    "--pipeline.datamanager.train-num-rays-per-batch", "16", "--pipeline.datamanager.eval-num-rays-per-batch", "16",
    "--pipeline.model.eval-num-rays-per-chunk", "512", "--timestamp", "t0", "--experiment-name", "e",
    "--output-dir", "outputs", "--data", "data",
]  # fmt: skip


@pytest.mark.slow
def test_train_and_open(nerfstudio: SimpleNamespace, folder: Path) -> None:
    """A run of nerfstudio's own method; `trained` is one of ours."""
    said = command("ns-train", "vanilla-nerf", *_TRAIN, "nerfstudio-data", folder=folder, where=folder)
    assert "Training Finished" in said
    file = folder / "outputs" / "e" / "vanilla-nerf" / "t0" / "config.yml"
    _config, pipeline, step = nerfstudio.viewing.open_run(file)
    assert step == 2 and isinstance(pipeline.model, nerfstudio.nerf.AbstractNerfModel)
    assert pipeline.model.field_fine.mlp_base.layers[0].weight.shape[0] == 256
    found = pipeline.model.get_outputs_for_camera(cameras(nerfstudio, height=6, width=6))
    assert found["rgb_fine"].shape == (6, 6, 3)


#: Of abstract-nerf, each with a value of its own.
CHOSEN = {
    "width": 24, "depth": 3, "num_frequencies": 5, "max_frequency_exponent": 3.5, "num_direction_frequencies": 3,
}  # fmt: skip


@pytest.fixture(scope="module")
def trained(folder: Path) -> Path:
    """The configuration that ns-train abstract-nerf leaves with the options `CHOSEN`."""
    flags = [part for key, v in CHOSEN.items() for part in (f"--pipeline.model.{key.replace('_', '-')}", v)]
    training = ["options" if part == "e" else part for part in _TRAIN]
    said = command("ns-train", "abstract-nerf", *training, *flags, "nerfstudio-data", folder=folder, where=folder)
    assert "Training Finished" in said
    return folder / "outputs" / "options" / "abstract-nerf" / "t0" / "config.yml"


@pytest.mark.slow
def test_the_loader_reads_what_was_trained(nerfstudio: SimpleNamespace, trained: Path) -> None:
    """Every option of abstract-nerf changes the picture, and both renderers change alike; vanilla-nerf has none."""
    import torch

    _config, pipeline, step = nerfstudio.viewing.open_run(trained)
    loaded = load_any(trained)
    assert step == 2 and isinstance(loaded, NerfScene)
    directions = CHOSEN["num_direction_frequencies"]
    encodings = (
        Encoding(int(CHOSEN["num_frequencies"]), 0.0, CHOSEN["max_frequency_exponent"]),
        Encoding(int(directions), 0.0, directions - 1.0),
    )
    assert (loaded.fine.position, loaded.fine.direction) == encodings
    assert [layer.weight.shape[0] for layer in loaded.fine.base] == [24] * 3
    model, camera = pipeline.model, cameras(nerfstudio, height=6, width=8)
    with torch.no_grad():
        # what three steps leave is nearly transparent
        for field in (model.field_coarse, model.field_fine):
            field.field_output_density.net.bias += 2.0
            field.field_heads[0].net.weight *= 8.0
    scene = model.abstract_source().scene
    assert scene.fine.position == loaded.fine.position and scene.far == loaded.far
    for ours, theirs in zip(loaded.fine.arrays()[:2], scene.fine.arrays()[:2], strict=True):
        np.testing.assert_array_equal(ours, theirs)
    shown = nerfstudio.panel.camera_of(camera)
    background = tuple(float(v) for v in scene.background)
    sampling = Sampling("hierarchical", scene.near, scene.far, 64, 128, background)  # type: ignore[arg-type]
    expected = model.get_outputs_for_camera(camera)["rgb_fine"].numpy()
    found = NerfRenderer(scene, sampling, torch.float32).image(shown, shown.camera_to_world)
    assert expected.std() > 0.005 and np.abs(found - expected).max() <= 1e-5
    # the exponents of the encodings matter: with nerfstudio's own the picture is another
    stock = dataclasses.replace(
        scene, fine=dataclasses.replace(scene.fine, position=Encoding(scene.fine.position.count, 0.0, 8.0))
    )
    other = NerfRenderer(stock, sampling, torch.float32).image(shown, shown.camera_to_world)
    assert np.abs(other - expected).max() > 1e-3


@pytest.mark.slow
def test_a_nerf_in_the_viewer(nerfstudio: SimpleNamespace, trained: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Concrete pictures grow while the view stays, bounds come ray by ray, and the panel says of what they are."""
    _config, pipeline, _ = nerfstudio.viewing.open_run(trained)
    model, camera = pipeline.model, cameras(nerfstudio, height=96, width=128)
    draws: list[int] = []
    monkeypatch.setattr(model.abstract.control, "draw", lambda: draws.append(1))
    monkeypatch.setattr(nerfstudio.panel.Attached, "watched", False)
    # every picture takes a second, whatever the machine
    monkeypatch.setattr(nerfstudio.nerf, "time", SimpleNamespace(perf_counter=itertools.count().__next__))
    model.abstract.control._present.set()
    model._speed = 1000.0
    model.abstract._sliders["x"].value = 1.0
    model.abstract._seconds.value = 5.0
    assert not any(element.name.startswith("± mean") for element in model.abstract.elements)
    try:
        sizes = []
        for _ in range(8):
            found = model.get_outputs_for_camera(camera)
            assert found["rgb_fine"].shape == (96, 128, 3) and list(found)[-4:] == OUTPUTS
            # the viewer's render thread looks for it
            assert found["depth"].shape == (96, 128, 1)
            sizes.append(model._drawn[1]["rgb_fine"].shape[0])
        assert sizes == [12, 12, 21, 21, 21, 21, 21, 21] and len(draws) >= 3
        more = longer(model._background, 20.0)

        def told() -> str | None:
            model.get_outputs_for_camera(camera)
            said = model.abstract._figures.text
            if model._background.status.state != "idle":
                return None
            return said if "pixels" in said else more()

        text = until(told, "bounds of rays")
        assert "uniform samples" in text and "real-sound" in text
        source = model.abstract_source()
        assert model.abstract_source() is source
        small = ViewRequest(nerfstudio.panel.camera_of(camera), model.abstract.perturbation).at_most(source.most)

        def bounded() -> Any:
            found = model._background.best(small, 20.0)
            if model._background.status.state != "idle":
                return None
            if found is not None and found.untreated < found.size[0] * found.size[1]:
                return found
            # there was no time for any pixel
            return more()

        snapshot = until(bounded, "bounds of some pixel")
        frame = source.frame(small.camera.rescaled(small.camera.height / snapshot.size[0]), small.perturbation)
        for values in [*frame.box.corners(), *frame.box.sample(10, np.random.default_rng(0))]:
            picture = frame.renderer.image(frame.camera, frame.pose_set.pose(values))
            assert ((picture >= snapshot.lower) & (picture <= snapshot.upper)).all()
        # a moved camera begins with a small picture again
        model.get_outputs_for_camera(cameras(nerfstudio, 1, 96, 128))
        assert model._drawn[1]["rgb_fine"].shape[0] == 9
        # what is cropped is not what is bounded
        from nerfstudio.data.scene_box import OrientedBox

        part = OrientedBox.from_params((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.4, 0.4, 0.4))
        found = model.get_outputs_for_camera(camera, part)
        assert (found["abstract_upper"] == 1).all() and "crop box" in model.abstract._figures.text
    finally:
        model._background.close()


@pytest.mark.slow
def test_stock_viewer_starts(nerfstudio: SimpleNamespace, folder: Path, config_file: Path) -> None:
    from websockets.sync.client import connect

    config = abstract_run(nerfstudio, folder, config_file)
    arguments = [*wrapped("ns-viewer"), "--load-config", config.relative_to(folder)]
    with Server(arguments, free_port(), folder, folder) as server:
        with connect(server.url.replace("http", "ws"), max_size=None, proxy=None) as client:
            said = b""
            # the panel first, at last the cameras of the data set; where the viewer ends this raises
            while b"/cameras/camera_" not in said:
                message = client.recv(timeout=LONG)
                said += message if isinstance(message, bytes) else message.encode()
        assert b"send to certify" in said
        assert server.process.poll() is None and "Traceback" not in server.said(), server.said()


@pytest.mark.slow
def test_eval_reports_abstract_figures(nerfstudio: SimpleNamespace, folder: Path, config_file: Path) -> None:
    config = abstract_run(nerfstudio, folder, config_file)
    command(
        "ns-eval", "--load-config", config.relative_to(folder), "--output-path", "eval.json",
        "--render-output-path", "eval", folder=folder, where=folder,
    )  # fmt: skip
    results = json.loads((folder / "eval.json").read_text())["results"]
    assert 0.0 < results["abstract_mpg_witness"] <= results["abstract_mpg"] <= results["abstract_xpg"]
    # no weights, no value
    assert "lpips" not in results and "psnr" in results
    assert Image.open(folder / "eval" / "eval_abstract_0000.png").size == (80, 40)


@pytest.mark.slow
def test_render_writes_abstract_images(nerfstudio: SimpleNamespace, folder: Path, config_file: Path) -> None:
    config = abstract_run(nerfstudio, folder, config_file)
    tools = folder / "tools"
    tools.mkdir(exist_ok=True)
    if shutil.which("ffmpeg") is None:
        # nerfstudio asks for it also where it only writes images
        (tools / "ffmpeg").write_text("#!/bin/sh\nexit 0\n")
        (tools / "ffmpeg").chmod(0o755)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PATH", f"{tools}:{environment(folder)['PATH']}")
        command(
            "ns-render", "camera-path", "--load-config", config.relative_to(folder), "--camera-path-filename",
            "path.json", "--output-path", "renders", "--output-format", "images", "--image-format", "png",
            "--rendered-output-names", "rgb", "abstract_lower", "abstract_upper", "abstract_gap",
            folder=folder, where=folder,
        )  # fmt: skip
    pictures = sorted((folder / "renders").glob("*.png"))
    assert len(pictures) == 2
    strip = np.asarray(Image.open(pictures[0]).convert("RGB"), np.int64)
    rgb, lower, upper, _ = np.split(strip, 4, axis=1)
    # 8 bits each, rounded alike
    assert (lower <= rgb).all() and (rgb <= upper).all() and (upper > lower).any()


def test_members_of_enumerations_as_some_pythons_write_them() -> None:
    """Python 3.11.0 to 3.11.3 store a member as ``getattr(Class, "NAME")``: that much may be named, and no more."""
    loading = importlib.import_module("ns_abstract.nerfstudio.loading")
    python = "tag:yaml.org,2002:python/"

    def taken(owner: str, *rest: Any) -> Tagged:
        return Tagged(f"{python}object/apply:builtins.getattr", [Tagged(f"{python}name:{owner}", ""), *rest])

    known = "nerfstudio.utils.writer.EventName"
    loading.check_tags({"stats": [taken(known, "ITER_TRAIN_TIME")]}, Path("config.yml"))
    for found in (
        taken(known, "__class__"), taken(known, "NOWHERE"), taken(known), taken(known, "ITER_TRAIN_TIME", "x"),
        taken("subprocess.call", "__call__"), taken("nerfstudio.utils.scripts", "run_command"),
    ):  # fmt: skip
        with pytest.raises(InputError, match="getattr"):
            loading.check_tags([found], Path("config.yml"))
