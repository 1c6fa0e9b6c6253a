"""``ns-abstract-render --explain``: scenes that are loose for one known reason."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import TIMESTAMP, InProcess, Inputs
from nerfs import tiny_scene

from ns_abstract.api.explaining import Explanation, explain
from ns_abstract.api.files import Settings, open_job
from ns_abstract.api.job import Job
from ns_abstract.cli import render as render_command
from ns_abstract.geometry.keyframe_cameras import KeyframeCamera, look_at
from ns_abstract.methods.nerf.write import write_nerf_run
from ns_abstract.methods.program_options import ProgramOptions
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.methods.splat.sub_box_bounds import SubBoxBounds
from ns_abstract.refine.engine import RefinementGoal

Make = Callable[..., Inputs]
#: From the front, one tile.
FRONT = [KeyframeCamera(look_at((0.0, -2.0, 0.0), (0.0, 0.0, 0.0)), 40.0, 16, 16)]
SHIFT = {"version": 1, "frame": "camera", "translation": {"x": 0.004}}
TURN = {"version": 1, "frame": "camera", "rotation": {"yaw": 0.02}}


def scene(means: list[list[float]], sizes: list[float], colors: np.ndarray, **changes: Any) -> SplatScene:
    """Balls; ``colors`` [n, bands, 3] are coefficients of spherical harmonics."""
    n = len(means)
    values: dict[str, Any] = {
        "means": np.array(means, np.float32),
        "log_scales": np.log(np.repeat(np.array(sizes)[:, None], 3, axis=1)).astype(np.float32),
        "quats": np.tile(np.array([[1.0, 0.0, 0.0, 0.0]], np.float32), (n, 1)),
        "opacity_logits": np.full(n, 1.0, np.float32),
        "sh": colors.astype(np.float32),
        "sh_degree": 1 if colors.shape[1] == 4 else 0,
        "background": np.zeros(3, np.float32),
        "name": "balls",
    }
    return SplatScene(**values | changes)


def plain(*colors: list[float]) -> np.ndarray:
    """Coefficients [n, 4, 3] of colours that do not depend on the view."""
    found = np.zeros((len(colors), 4, 3))
    found[:, 0] = (np.array(colors) - 0.5) / 0.28209479177387814
    return found


def explained(inputs: Inputs, cells: int = 2) -> tuple[Job, Explanation]:
    job = open_job(Settings(inputs.config, inputs.path, inputs.spec))
    result = job.joined([job.bound_part(0, RefinementGoal(1.0, 300.0, cells), keep_leaves=True)])
    return job, explain(job, 0, result)


def test_gaussians_that_change_places(make_blobs: Make) -> None:
    """Two of different colours, one beside the other and as far: a turn decides which is in front."""
    balls = scene([[-0.1, 0.0, 0.0], [0.1, 0.001, 0.0]], [0.2, 0.2], plain([1.0, 0.0, 0.0], [0.0, 0.0, 1.0]))
    _, found = explained(make_blobs(scene=balls, views=FRONT, spec=TURN))
    causes = dict(found.causes)
    assert causes.pop("the order of depth") > 0.5 > max(causes.values())
    assert found.excess > 0.0 and found.leaves > 0
    assert "the order of depth (time" in "\n".join(found.lines())


def test_other_layers_change_nothing(make_blobs: Make) -> None:
    """Depths have other units, and where nothing is drawn none at all."""
    balls = scene([[-0.1, 0.0, 0.0], [0.1, 0.001, 0.0]], [0.2, 0.2], plain([1.0, 0.0, 0.0], [0.0, 0.0, 1.0]))
    inputs = make_blobs(scene=balls, views=FRONT, spec=TURN)
    job, found = explained(inputs)
    layered = open_job(Settings(inputs.config, inputs.path, inputs.spec, outputs=("rgb", "depth", "accumulation")))
    assert layered.layers and job.layers == ()
    same = job.joined([job.bound_part(0, RefinementGoal(1.0, 300.0, 2), keep_leaves=True)])
    assert explain(layered, 0, same) == found


def test_versions_without_tiles_to_miss_are_not_told_of_them(make_blobs: Make) -> None:
    balls = scene([[0.0, 0.0, 0.0]], [0.2], plain([1.0, 0.0, 0.0]))
    inputs = make_blobs(scene=balls, views=FRONT, spec=TURN)
    for version, name in (("1.4.0", "the alpha threshold and tiles"), ("1.5.3", "the alpha threshold")):
        job = open_job(
            Settings(inputs.config, inputs.path, inputs.spec, program=ProgramOptions(gsplat_version=version))
        )
        found = explain(job, 0, job.joined([job.bound_part(0, RefinementGoal(1.0, 300.0, 2), keep_leaves=True)]))
        assert [cause for cause in found.causes if "threshold" in cause] == [name]


def test_colours_that_change_with_the_view(make_blobs: Make) -> None:
    """Its colour is 0 from one side and grows to the other."""
    colors = plain([0.0, 0.0, 0.0])
    # of x: gsplat's third band
    colors[:, 3] = 4.0
    spec = {"version": 1, "frame": "camera", "translation": {"x": 0.1}}
    _, found = explained(make_blobs(scene=scene([[0.0, 0.0, 0.0]], [0.5], colors), views=FRONT, spec=spec), 1)
    assert found.causes["colours that depend on the view"] == max(found.causes.values()) > 0.3


def test_the_gaussian_that_holds_most(make_blobs: Make) -> None:
    """One sharp bright ball among wide dim ones; what is found leaves the frame's own bounds as they are."""
    rng = np.random.default_rng(0)
    means = rng.uniform(-0.3, 0.3, (30, 3))
    sizes = np.full(30, 0.5)
    colors = plain(*np.full((30, 3), 0.2).tolist())
    means[17], sizes[17] = [0.0, -0.5, 0.0], 0.03
    colors[17] = plain([1.0, 1.0, 1.0])[0]
    job, found = explained(make_blobs(scene=scene(means.tolist(), sizes.tolist(), colors), views=FRONT, spec=SHIFT), 1)
    assert found.elements[0][0] == 17 and found.elements[0][1] > 0.3
    assert found.regions[0][1:] == (0, 16, 0, 16) and found.regions[0][0] == pytest.approx(1.0)
    frame: Any = job.frame(0)
    assert type(frame.bounds) is SubBoxBounds


def test_a_single_pose_has_nothing_to_explain(make_blobs: Make) -> None:
    still = {"version": 1, "frame": "camera", "translation": {"x": [0.0, 0.0]}}
    balls = scene([[0.0, 0.0, 0.0]], [0.2], plain([1.0, 0.0, 0.0]))
    _, found = explained(make_blobs(scene=balls, views=FRONT, spec=still))
    assert found.excess < 1e-3 and list(found.lines())


@pytest.fixture
def call(in_process: InProcess) -> Callable[[list[str]], tuple[int, str, str]]:
    return partial(in_process, render_command.main)


@pytest.mark.slow
def test_command(make_blobs: Make, call: Callable[[list[str]], tuple[int, str, str]], tmp_path: Path) -> None:
    balls = scene([[-0.1, 0.0, 0.0], [0.1, 0.001, 0.0]], [0.2, 0.2], plain([1.0, 0.0, 0.0], [0.0, 0.0, 1.0]))
    inputs = make_blobs(scene=balls, views=FRONT, spec=TURN)
    options = ["--load-config", str(inputs.config), "--camera-path-filename", str(inputs.path), "--explain"]
    code, out, _ = call([*options, "--perturbation-filename", str(inputs.spec), "--time-budget", "2"])
    assert code == 0 and "frame 0: mean gap" in out and "the order of depth" in out
    folder = tmp_path / "out"
    shown = [*options, "--perturbation-filename", str(inputs.spec), "--time-budget", "2", "--output-dir", str(folder)]
    code, _, err = call(shown)
    told = json.loads((folder / "report.json").read_text())["frames"][0]["explanation"]
    assert code == 0 and len(told) > 5 and set(told[1:]) <= set(err.splitlines())
    config = write_nerf_run(tiny_scene(), tmp_path, timestamp=TIMESTAMP, experiment_name="nerf")
    options[1] = str(config)
    code, _, err = call([*options, "--perturbation-filename", str(inputs.spec)])
    assert code == 2 and "--explain" in err and err.count("\n") == 1


@pytest.mark.slow
def test_the_report_tells_why(
    make_blobs: Make, call: Callable[[list[str]], tuple[int, str, str]], tmp_path: Path
) -> None:
    balls = scene([[-0.1, 0.0, 0.0], [0.1, 0.001, 0.0]], [0.2, 0.2], plain([1.0, 0.0, 0.0], [0.0, 0.0, 1.0]))
    inputs = make_blobs(scene=balls, views=FRONT, spec=TURN)
    out = tmp_path / "out"
    options = ["--load-config", str(inputs.config), "--camera-path-filename", str(inputs.path)]
    options += ["--output-dir", str(out)]
    options += ["--perturbation-filename", str(inputs.spec), "--time-budget", "2"]
    code, _, said = call([*options, "--explain"])
    entry = json.loads((out / "report.json").read_text())["frames"][0]
    assert code == 0 and "the order of depth" in said and any("the order of depth" in s for s in entry["explanation"])
    assert "the order of depth" in (out / "report.html").read_text()
    # cells are worked with, and not stored unless that is asked for
    assert not any(key.startswith("cell") for key in np.load(out / "frame_00000.npz").files)
    # what is kept stays explained
    assert call([*options, "--resume", "--target-ratio", "1000"])[0] == 0
    assert json.loads((out / "report.json").read_text())["frames"][0]["explanation"] == entry["explanation"]
    assert "the order of depth" in (out / "report.html").read_text()
    # a report that others have changed is no longer believed
    document = json.loads((out / "report.json").read_text())
    document["frames"][0]["explanation"] = [{"<script>": 1}]
    (out / "report.json").write_text(json.dumps(document))
    assert call([*options, "--resume", "--target-ratio", "1000"])[0] == 0
    assert "explanation" not in json.loads((out / "report.json").read_text())["frames"][0]


def test_a_field_is_not_explained_in_a_report(
    make_blobs: Make, call: Callable[[list[str]], tuple[int, str, str]], tmp_path: Path
) -> None:
    inputs = make_blobs(views=FRONT, spec=TURN)
    config = write_nerf_run(tiny_scene(), tmp_path, timestamp=TIMESTAMP, experiment_name="nerf")
    options = ["--load-config", str(config), "--camera-path-filename", str(inputs.path), "--explain"]
    options += ["--perturbation-filename", str(inputs.spec), "--output-dir", str(tmp_path / "out")]
    code, _, err = call(options)
    assert code == 2 and "--explain" in err and err.count("\n") == 1 and not (tmp_path / "out").exists()
