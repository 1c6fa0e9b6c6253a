"""Every process that bounds is one whose arithmetic was checked, and no default of torch changes a bound."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
import torch
from certifying import classifier
from conftest import Inputs
from nerfs import tiny_scene, view
from test_certify_cli import PRE, Case
from test_reach_cli import course  # noqa: F401
from test_selfcheck import off

import ns_abstract as nsa
from ns_abstract.api.bounding import bound_frames
from ns_abstract.api.cell_search import examine_block
from ns_abstract.api.files import Settings, open_job
from ns_abstract.arithmetic import selfcheck
from ns_abstract.cli.render import Render, render
from ns_abstract.execution.engines import SerialEngine
from ns_abstract.execution.worker_cache import clear_cache
from ns_abstract.methods.nerf.write import write_nerf_run


class FaultyWorker(SerialEngine):
    """An engine whose tasks run as on another machine, whose exp errs by an ulp more than bounds are charged."""

    shares = False

    def collect(self, seconds: float) -> list[tuple[int, Any]]:
        with pytest.MonkeyPatch.context() as patch:
            faulty(patch)
            try:
                return super().collect(seconds)
            finally:
                sound_again()


def faulty(patch: pytest.MonkeyPatch) -> None:
    """Make this process one whose exp is too inaccurate, with nothing kept open."""
    patch.setitem(selfcheck.FUNCTIONS, "exp", off("exp", 9))
    sound_again()


def sound_again() -> None:
    selfcheck.platform_problems.cache_clear()
    clear_cache()


@pytest.fixture(autouse=True)
def checked_afresh() -> Iterator[None]:
    yield
    sound_again()


def test_a_faulty_worker_takes_the_guarantee_away(blobs: Inputs) -> None:
    job = open_job(Settings(blobs.config, blobs.path, blobs.spec))
    assert job.method.guarantee == "float32-sound"
    (sound,) = bound_frames(job, [0], engine=SerialEngine(), budget=60.0, target_ratio=3.0)
    (unsound,) = bound_frames(job, [0], engine=FaultyWorker(), budget=60.0, target_ratio=3.0)
    assert sound.problems == ()
    (problem,) = unsound.problems
    assert problem.startswith("exp(")


def test_a_report_with_a_faulty_worker_is_sampled(
    blobs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def command(resume: bool = False) -> dict[str, Any]:
        frames = Render(
            load_config=blobs.config, camera_path_filename=blobs.path, output_dir=tmp_path, time_budget=60.0,
            perturbation_filename=blobs.spec, frames=(0, 1), target_ratio=3.0, resume=resume,
        )  # fmt: skip
        assert render(frames) == 0
        return json.loads((tmp_path / "report.json").read_text())

    with monkeypatch.context() as patch:
        patch.setattr("ns_abstract.execution.starting.started", lambda *_: nullcontext(FaultyWorker()))
        report = command()
    assert report["guarantee"] == "sampled"
    assert any("self-check" in limit and "exp(" in limit for limit in report["limits"])
    assert "No guarantee" in (tmp_path / "report.html").read_text()
    # what that worker left is not taken over where everything is sound
    report = command(resume=True)
    assert report["guarantee"] == "float32-sound" and "self-check" not in str(report["limits"])


@pytest.mark.slow
def test_a_faulty_worker_certifies_nothing(blobs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    net = classifier(tmp_path / "net.onnx")
    job = Case(tmp_path / "case", blobs, net, {"type": "classification", "label": 0, "preprocess": PRE}).job
    grid = job.grid(0)
    block = 0, grid, tuple(grid.roots()[:1])
    assert examine_block(job.recipe, *block)
    faulty(monkeypatch)
    with pytest.raises(nsa.InputError, match="self-check"):
        examine_block(job.recipe, *block)


@pytest.mark.slow
def test_a_faulty_worker_reaches_nothing(course: Any, monkeypatch: pytest.MonkeyPatch) -> None:  # noqa: F811
    job = course.job
    faulty(monkeypatch)
    with pytest.raises(nsa.InputError, match="self-check"):
        examine_block(job.recipe, 0, job.search, ())  # type: ignore[arg-type]


def bits(run: Path, folder: Path, blobs: Inputs) -> list[Any]:
    """What the Python interface gives for a NeRF and for a network, as bytes."""
    scene = nsa.load_scene(run, num_samples=8)
    camera = nsa.Camera(view(4, 3).camera_to_world, fov=40.0, width=4, height=3)
    result = nsa.bound(scene, nsa.PoseSet(camera, rotation={"yaw": 1e-4}), target_ratio=50.0, time_budget=600.0)
    image = nsa.render(scene, camera)
    splat = nsa.load_scene(blobs.config)
    camera = nsa.Camera(nsa.load_camera_path(blobs.path).cameras[0].camera_to_world, fov=50.0, width=16, height=16)
    found = nsa.certify(
        splat, nsa.PoseSet(camera, translation={"x": 1e-3}), classifier(folder / "net.onnx"),
        {"type": "classification", "label": 0, "preprocess": PRE}, time_budget=600.0,
    )  # fmt: skip
    margins = [(cell.verdict, cell.margin) for cell in found.cells]
    return [result.lower.tobytes(), result.upper.tobytes(), image.tobytes(), margins]


def test_bounds_do_not_depend_on_torchs_default_type(blobs: Inputs, tmp_path: Path) -> None:
    run = write_nerf_run(tiny_scene(), tmp_path, timestamp="run", experiment_name="tiny")
    usual = bits(run, tmp_path, blobs)
    torch.set_default_dtype(torch.float64)
    try:
        assert bits(run, tmp_path, blobs) == usual
    finally:
        torch.set_default_dtype(torch.float32)
