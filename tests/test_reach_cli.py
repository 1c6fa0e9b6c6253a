"""``ns-abstract-reach`` on the demo's gate: what is certified is attacked, whatever runs the search finds the same."""

from __future__ import annotations

import importlib.util
import itertools
import json
import re
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import InProcess, environment
from interrupting import check_ended_in_a_library_call, check_interrupted, held_at, interrupted_at
from onnx_files import OnnxFile
from waiting import LONG

from ns_abstract.api.reaching import LoopJob, open_loop, reach
from ns_abstract.api.scenes import load_scene
from ns_abstract.cli import reach as reach_command
from ns_abstract.demo.scenes import splat_scene
from ns_abstract.demo.writing import write_loop_demo
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.poses import SCENE_TURNS
from ns_abstract.io import memory
from ns_abstract.io.errors import InputError
from ns_abstract.perturbation.variations import SceneVariation, Selection
from ns_abstract.reach.film import along
from ns_abstract.reach.search import SimulatedRun, first_outside, sampled_disturbances, simulate
from ns_abstract.verify.camera_response import CameraResponse
from ns_abstract.verify.scene_margin import CAMERA_KINDS
from ns_abstract.verify.scene_pictures import ScenePictures

MODULE = "ns_abstract.cli.reach"
#: A part of the demo's box that takes seconds.
PART = {"along": [0.0, 0.03], "across": [-0.04, 0.04], "up": [0.0, 0.03], "v_across": 0.0, "v_up": 0.0}
#: A smaller one.
SMALL = {"along": 0.0, "across": [0.3, 0.302], "up": 0.0, "v_across": 0.0, "v_up": 0.0}
#: Starts on both sides of where the funnel is left, which is asked alone.
EDGE: dict[str, Any] = {
    "initial": {"along": 0.0, "across": [0.40, 0.44], "up": 0.02, "v_across": 0.0, "v_up": 0.0},
    "steps": 12,
}


@dataclass(frozen=True)
class Course:
    """The demo's files."""

    config: Path
    loop: Path

    def changed(self, name: str, without: str = "", **changes: Any) -> Course:
        """The same with other values in LOOP.json, and without a key."""
        file = self.loop.with_name(name)
        value = json.loads(self.loop.read_text()) | changes
        file.write_text(json.dumps({key: v for key, v in value.items() if key != without}))
        return Course(self.config, file)

    def options(self, folder: Path, **more: Any) -> list[str]:
        values = {"load_config": self.config, "loop": self.loop, "output_dir": folder, "time_budget": 300} | more
        found = []
        for name, value in values.items():
            found += ["--" + name.replace("_", "-")] + ([] if value is True else [str(value)])
        return found

    @property
    def job(self) -> LoopJob:
        return open_loop(load_scene(self.config), self.loop)

    def run(self, folder: Path, **more: Any) -> dict[str, Any]:
        return reach(load_scene(self.config), self.loop, time_budget=300.0, output_dir=folder, **more).report


@pytest.fixture(scope="module")
def course(tmp_path_factory: pytest.TempPathFactory) -> Course:
    return Course(*write_loop_demo(tmp_path_factory.mktemp("course")))


@pytest.fixture(scope="module")
def edge(course: Course) -> Course:
    return course.changed("edge.json", "goal", **EDGE)


@pytest.fixture(scope="module")
def finished(edge: Course, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An uninterrupted search."""
    folder = tmp_path_factory.mktemp("finished") / "out"
    edge.run(folder)
    return folder


def cells(folder: Path) -> list[tuple[Any, ...]]:
    with sqlite3.connect(folder / "cells.sqlite") as base:
        return sorted(base.execute("SELECT frame, lower, upper, verdict, margin, counterexample FROM cells").fetchall())


def test_a_network_that_does_not_fit_into_the_memory_is_refused(
    course: Course, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = load_scene(course.config)
    monkeypatch.setattr(memory, "available_memory", lambda: 1 << 30)
    open_loop(scene, course.loop, workers=1)
    with pytest.raises(InputError, match=r"onnx: needs about .* GiB for a cell in \d parameters .*fewer --workers"):
        open_loop(scene, course.loop, workers=1 << 16)


def test_no_two_gaussians_are_equally_deep() -> None:
    assert np.diff(np.sort(splat_scene("gate").means[:, 0])).min() > 5e-4


@pytest.mark.slow
def test_a_part_of_the_box_is_certified(course: Course, tmp_path: Path) -> None:
    """Three dimensions, 24 steps, all of it; then hundreds of runs stay inside the tubes of its cells."""
    part = course.changed("part.json", initial=PART)
    document = part.run(tmp_path / "out", film=True)
    assert document["verdict"] == "reaches"
    check_film(tmp_path / "out", document, 24)
    for entry in document["questions"].values():
        assert entry["certified"] == 1.0 and entry["simulated"]["went_well"] == 1.0
    tube = document["tubes"][0]
    # what is kept matters: without it, the same cell's tubes are several times as wide
    none = tube["width_by_dependence"]["none"]
    assert len(none) < 25 or none[-1] > 3.0 * tube["width"][-1]
    assert all(a >= b for a, b in zip(tube["width"], tube["width_simulated"], strict=True))
    job = part.job
    reacher, loop, rng = job.reacher(), job.loop, np.random.default_rng(1)
    compared = 0
    for row in document["tubes"]:
        box = ParameterBox(loop.box.names, loop.box.units, tuple(row["lower"]), tuple(row["upper"]))
        whole = reacher.tube(box)
        for number, start in enumerate([*box.corners(), *box.sample(20, rng)]):
            run = simulate(
                reacher, loop.state(box, start), sampled_disturbances(loop, rng, "ends" if number % 2 else "random")
            )
            assert first_outside(whole, run) is None
            compared += len(run.states)
    assert compared > 500


def check_film(folder: Path, document: dict[str, Any], last: int) -> None:
    """The film shows every step of a certified cell, the widest; the page some of them, and the scene behind tubes."""
    film, page = document["film"], (folder / "report.html").read_text()
    assert film["verdict"] == "certified" and film["steps"] == list(range(last + 1))
    assert all(0.0 < mean < most <= 3.0**0.5 for mean, most in zip(film["mean_gap"], film["largest_gap"], strict=True))
    shares = [np.prod(np.subtract(json.loads(upper), json.loads(lower))) for _, lower, upper, *_ in cells(folder)]
    assert np.prod(np.subtract(film["upper"], film["lower"])) == max(shares)
    content = (folder / film["file"]).read_bytes()
    assert content[4:8] == b"ftyp" if film["file"].endswith(".mp4") else content[:3] == b"GIF"
    images = re.findall('"data:image/png;base64,([^"]+)"', page)
    # the scene from above and from the side, and ten steps
    assert len(images) == 12 and sum(map(len, images[:2])) < 300_000
    assert "default-src 'none'; img-src data:" in page and "<script" not in page
    assert "Seen from above" in page and "Seen from the side" in page and f'href="{film["file"]}"' in page
    for tube in document["tubes"]:
        # this camera stands where the first three states say
        for box, (low, high) in zip(tube["tube"], tube["camera"], strict=True):
            assert np.allclose(box[0][:3], low) and np.allclose(box[1][:3], high)
            assert (np.array(low) <= box[0][:3]).all() and (np.array(high) >= box[1][:3]).all()


@pytest.mark.slow
def test_a_film_encloses_what_runs_see(course: Course) -> None:
    part = course.changed("film.json", initial=SMALL, steps=10).job
    loop, box, reacher, rng = part.loop, part.loop.box, part.reacher(), np.random.default_rng(4)
    steps = list(along(reacher, part.job.method, (24, 16), reacher.tube(box, whole=True)))
    assert [step.index for step in steps] == list(range(11)) and steps[0].image.shape == (24, 16, 3)
    view = ScenePictures(part.job.method.frame(loop.camera.poses((24, 16))))
    for number, start in enumerate([*box.corners(), *box.sample(4, rng)]):
        run = simulate(
            reacher, loop.state(box, start), sampled_disturbances(loop, rng, "ends" if number % 2 else "random")
        )
        for step, x in zip(steps, run.states, strict=True):
            seen = view.image(loop.camera.values(x))
            assert (step.lower <= seen).all() and (seen <= step.upper).all()


@pytest.mark.slow
def test_a_film_has_the_camera_of_the_network(course: Course) -> None:
    """Intrinsics in pixels of the network's picture are those of the film's larger ones."""
    mount = json.loads(course.loop.read_text())["camera"]
    (height, width), shown = (8, 8), []
    focal = 0.5 * height / np.tan(0.5 * np.radians(mount["fov"]))
    lens = {"fx": focal, "fy": focal, "cx": 0.5 * width, "cy": 0.5 * height}
    for name, camera in (
        ("fov.json", mount),
        ("lens.json", {key: v for key, v in mount.items() if key != "fov"} | lens),
    ):
        job = course.changed(name, initial=SMALL, steps=1, camera=camera).job
        assert job.loop.preprocess.size(job.network.input_shape) == (height, width)
        reacher = job.reacher()
        shown.append(list(along(reacher, job.job.method, (64, 64), reacher.tube(job.loop.box, whole=True))))
    for step, other in zip(*shown, strict=True):
        assert np.ptp(step.image) > 0.1
        for one, two in ((step.lower, other.lower), (step.upper, other.upper), (step.image, other.image)):
            np.testing.assert_allclose(one, two, rtol=0.0, atol=1e-5)


@pytest.mark.slow
def test_interrupted_in_a_film(
    course: Course, tmp_path: Path, in_process: InProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    part = course.changed("cut.json", "goal", initial=SMALL, steps=10)
    with monkeypatch.context() as patched:
        interrupted_at("ns_abstract.api.loop_report:along", patched)
        code, _, said = in_process(reach_command.main, part.options(tmp_path / "out", film=True))
    assert code == 3 and "Traceback" not in said
    document = json.loads((tmp_path / "out" / "report.json").read_text())
    assert document["film"] == {"skipped": "the work was interrupted"} and document["verdict"] == "safe"
    assert "No film: the work was interrupted" in (tmp_path / "out" / "report.html").read_text()
    assert not list((tmp_path / "out").glob("film*"))
    again = part.run(tmp_path / "out", resume=True, film=True)
    assert (tmp_path / "out" / again["film"]["file"]).exists()


@pytest.mark.slow
def test_without_video_a_film_is_a_gif(course: Course, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ns_abstract.report.export.has_video", lambda: False)
    document = course.changed("gif.json", "goal", initial=SMALL, steps=10).run(tmp_path / "out", film=True)
    assert document["film"]["file"] == "film.gif" and (tmp_path / "out" / "film.gif").read_bytes()[:3] == b"GIF"


@pytest.mark.slow
def test_without_elements_tubes_are_alone(course: Course, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ns_abstract.methods.splat.method.SplatMethod.elements", lambda self: None)
    course.changed("bare.json", "goal", initial=SMALL, steps=10).run(tmp_path / "out")
    page = (tmp_path / "out" / "report.html").read_text()
    assert "tubes alone" in page and "<image" not in page and 'class="tube"' in page and "Along a tube" not in page


@pytest.mark.slow
def test_where_runs_go_wrong(edge: Course, finished: Path) -> None:
    """The edge of the funnel's reach lies in the box: both verdicts, and stored runs that leave the funnel again."""
    document = json.loads((finished / "report.json").read_text())
    assert document["verdict"] == "falsified" and document["state"] == "done"
    assert document["intrinsics"] == edge.job.job.pose_sets[0].camera.intrinsics._asdict()
    shares = document["questions"]["safe"]
    assert shares["certified"] > 0.1 and shares["falsified"] > 0.1 and shares["unknown"] < 0.1
    # no more than runs show, of which there are 200
    assert abs(shares["certified"] - shares["simulated"]["went_well"]) < 0.15
    job = edge.job
    files = sorted((finished / "counterexamples").glob("*.npz"))
    broken = [row for row in cells(finished) if row[3] == "falsified"]
    assert len(files) == len(broken) > 0
    for file in files[:5]:
        stored = np.load(file)
        again = simulate(job.reacher(), stored["states"][0], stored["disturbances"])
        assert (again.states == stored["states"]).all() and again.margin(job.loop, "safe") <= 0.0


@pytest.mark.slow
def test_a_planted_bad_controller_is_falsified(course: Course, tmp_path: Path) -> None:
    """It steers away from the axis."""
    control = json.loads(course.loop.read_text())["control"] | {"gain": [[1.2, 0.0], [0.0, -1.2]]}
    bad = course.changed("bad.json", control=control, initial=PART | {"across": [0.1, 0.15]})
    document = bad.run(tmp_path / "out")
    assert document["verdict"] == "falsified"
    assert document["questions"]["reaches"]["falsified"] == 1.0 == document["questions"]["safe"]["falsified"]


@pytest.mark.slow
def test_pictures_along_a_loop(course: Course, tmp_path: Path, in_process: InProcess) -> None:
    """Nothing near is certified; a limit that pictures break is falsified by runs whose pictures are rendered again."""
    clear = {"type": "clear", "distance": 0.3, "weight": 0.5}
    bright = {"type": "picture", "statistic": "mean", "channel": "r", "max": 0.1, "when": "end"}
    seen = course.changed("seen.json", unsafe=[clear], goal=bright, initial=SMALL, steps=4)
    document = seen.run(tmp_path / "out")
    assert document["questions"]["safe"]["certified"] == 1.0 == document["questions"]["reaches"]["falsified"]
    assert "nearer than 0.3" in document["questions"]["safe"]["text"]
    job, files = seen.job, list((tmp_path / "out" / "counterexamples").glob("reaches_*.npz"))
    assert files
    for file in files:
        stored = np.load(file)
        again = simulate(job.reacher(), stored["states"][0], stored["disturbances"])
        assert (again.views == stored["views"]).all() and again.margin(job.loop, "reaches") <= 0.0
        image = ScenePictures(job.job.method.frame(job.job.pose_sets[0])).image(
            job.loop.camera.values(stored["states"][-1])
        )
        assert image[..., 0].mean() > 0.1
    wrong_values: tuple[tuple[str, Any, str], ...] = (
        ("unsafe", [clear | {"region": [0, 0, 9, 9]}], r"seen.json: unsafe\[0\].region: .* reaches beyond"),
        ("goal", {"type": "visible", "select": {"box": [[90, 90, 90], [91, 91, 91]]}}, r"seen.json: goal.*select"),
    )
    for key, wrong, told in wrong_values:
        changes: dict[str, Any] = {key: wrong, "initial": SMALL}
        course.changed("seen.json", "", **changes)
        code, _, said = in_process(reach_command.main, seen.options(tmp_path / "no"))
        assert code == 2 and re.search(told, said) and said.count("\n") == 1, said


@pytest.mark.slow
def test_scene_margin(course: Course, tmp_path: Path) -> None:
    """Runs in scenes at the ends of the certified radius stay in the tubes and go well; stored ones fail."""
    part = course.changed("margin.json", "goal", initial=SMALL, steps=10)
    document = part.run(tmp_path / "out", scene_margin=True)
    assert document["verdict"] == "safe" and document["scene_margin"]["question"] == "safe"
    job, rng = part.job, np.random.default_rng(8)
    loop, box = job.loop, job.loop.box
    kinds = {entry["kind"]: entry for entry in document["scene_margin"]["kinds"]}
    assert list(kinds) == ["mean", "opacity", "color", "brightness", "white_balance", "gamma", "registration", "turn"]
    responses = {kind.name: kind.response for kind in CAMERA_KINDS}
    compared = 0
    for name, entry in kinds.items():
        radius = entry["radius"]
        if name == "registration":
            reacher = replace(job.reacher(), registration=radius)
            scenes = [(None, radius * rng.choice([-1.0, 1.0], 3)) for _ in range(24)]
        elif name == "turn":
            view = ScenePictures(job.job.method.frame(job.job.pose_sets[0].registered(SCENE_TURNS, radius)))
            reacher = replace(job.reacher(), view=view)
            scenes = [(None, radius * rng.choice([-1.0, 1.0], 3)) for _ in range(24)]
        elif (of_camera := responses.get(name)) is not None:
            view = ScenePictures(job.job.method.frame(job.job.pose_sets[0]), CameraResponse(of_camera, radius))
            reacher = replace(job.reacher(), view=view)
            scenes = [(scene_sample, None) for scene_sample in itertools.islice(view.scene_samples(1), 24)]
        else:
            ends: dict[str, Any] = {name: (-radius, radius)}
            view = ScenePictures(job.job.method.frame(job.job.varied(0, SceneVariation(Selection(), **ends))))
            reacher = replace(job.reacher(), view=view)
            scenes = [(scene_sample, None) for scene_sample in itertools.islice(reacher.view.scene_samples(1), 24)]
        tube = reacher.tube(box)
        for number, (scene_sample, shift) in enumerate(scenes):
            start = box.corners()[number % 2] if number % 2 else box.sample(1, rng)[0]
            push = sampled_disturbances(loop, rng, "ends" if number % 3 else "random")
            run = simulate(reacher, loop.state(box, start), push, scene_sample, shift)
            assert run.margin(loop, "safe") > 0.0
            assert first_outside(tube, run) is None
            compared += len(run.states)
        assert (
            entry["state"] == "done"
            and entry["not_certified"]
            and 0.0 < radius < entry["not_certified"]["radius"] <= 1.2 * radius
        )
        broken: Any = entry["falsified"]
        assert not broken or broken["radius"] > radius
        files = list((tmp_path / "out" / "counterexamples").glob(f"scene_margin_{name}.npz"))
        assert bool(files) == bool(broken)
        for file in files:
            with np.load(file) as stored:
                run = SimulatedRun(stored["states"], stored["controls"], stored["disturbances"], np.zeros((11, 0)))
                assert (
                    run.margin(loop, "safe") <= 0.0
                    and broken is not None
                    and float(stored["radius"]) == broken["radius"]
                )
    assert compared == len(kinds) * 24 * 11 and any(entry["falsified"] for entry in kinds.values())
    assert "How wrong the scene may be" in (tmp_path / "out" / "report.html").read_text()


# ---------------------------------------------------------------- the command


def start(options: list[str]) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", MODULE, *options], text=True, env=environment(), stderr=subprocess.PIPE
    )


@pytest.mark.slow
def test_interrupted_and_resumed(edge: Course, finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    process = held_at(3, MODULE, edge.options(folder))
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=LONG)
    assert process.returncode == 3 and "Traceback" not in said, said
    document = json.loads((folder / "report.json").read_text())
    assert document["state"] == "interrupted" and document["verdict"] != "reaches"
    # by another number of processes
    edge.run(folder, resume=True, workers=2)
    assert cells(folder) == cells(finished)
    one, other = (json.loads((f / "report.json").read_text())["questions"] for f in (folder, finished))
    for name, entry in one.items():
        assert entry["certified"] == other[name]["certified"] and entry["falsified"] == other[name]["falsified"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "place",
    [
        "ns_abstract.api.reaching:open_loop",
        "ns_abstract.cli.searching:compile_beside",
        "ns_abstract.api.loop_report:simulate",
        "ns_abstract.api.cell_search:examine_here",
    ],
)
def test_interrupted_before_the_first_block(
    place: str, edge: Course, finished: Path, tmp_path: Path, in_process: InProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "out"
    with monkeypatch.context() as patched:
        interrupted_at(place, patched)
        check_interrupted(in_process, reach_command.main, edge.options(folder), folder)
    assert folder.exists() == ("open_loop" not in place)
    if "examine" in place:
        edge.run(folder, resume=True)
        assert cells(folder) == cells(finished)


@pytest.mark.slow
def test_ended_while_kernels_are_compiled(edge: Course, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    check_ended_in_a_library_call(MODULE, "ns_abstract.cli.searching.compile_beside", edge.options(folder), folder)


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("distributed") is None, reason="dask is not installed")
def test_two_dask_workers_equal_one_process(edge: Course, finished: Path, tmp_path: Path) -> None:
    process = start(edge.options(tmp_path / "out", workers=2, engine="dask"))
    _, said = process.communicate(timeout=LONG)
    assert process.returncode == 0, said
    assert cells(tmp_path / "out") == cells(finished)


@pytest.mark.slow
def test_resume_refuses_another_loop(course: Course, finished: Path, call: Callable[..., tuple[int, str]]) -> None:
    code, said = call(course.options(finished, resume=True))
    assert code == 2 and said.count("\n") == 1 and "--resume" in said


@pytest.fixture
def call(in_process: InProcess) -> Callable[[list[str]], tuple[int, str]]:
    def run(options: list[str]) -> tuple[int, str]:
        code, _, err = in_process(reach_command.main, options)
        return code, err

    return run


MISTAKES: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
    "budget": ({"time_budget": -1}, ("--time-budget",)),
    "workers": ({"workers": 0}, ("--workers",)),
    "address": ({"scheduler_address": "h:1"}, ("--scheduler-address", "--engine dask")),
    "no loop": ({"loop": Path("none.json")}, ("none.json", "loop file")),
    "no run": ({"load_config": Path("none.yml")}, ("none.yml",)),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistake_is_one_line(name: str, course: Course, call: Callable[..., tuple[int, str]], tmp_path: Path) -> None:
    changes, fragments = MISTAKES[name]
    code, said = call(course.options(tmp_path / "out", **changes))
    assert code == 2 and said.count("\n") == 1 and said.startswith("error: ") and "; " in said, said
    for fragment in fragments:
        assert fragment in said


def learned(course: Course, name: str = "law.onnx") -> Path:
    """The demo's dynamics as a file beside LOOP.json."""
    law = json.loads(course.loop.read_text())["dynamics"]
    f = OnnxFile((7,), batch=1)
    both = np.concatenate([np.array(law["A"]), np.array(law["B"])], axis=1)
    f.node("Gemm", "image", f.constant(both), f.constant(law["c"]), transB=1)
    return f.write(course.loop.with_name(name))


@pytest.mark.slow
def test_dynamics_in_a_file(course: Course, call: Callable[..., tuple[int, str]], tmp_path: Path) -> None:
    """The demo's law as a file is certified by two processes, and another file is not mixed in."""
    file = learned(course)
    small = {"along": [0.0, 0.01], "across": [0.0, 0.01], "up": 0.0, "v_across": 0.0, "v_up": 0.0}
    part = course.changed("learned.json", "goal", initial=small, steps=8, dynamics={"type": "onnx", "file": file.name})
    document = part.run(tmp_path / "out", workers=2)
    assert document["verdict"] == "safe" and document["questions"]["safe"]["simulated"]["went_well"] == 1.0
    assert document["dynamics_model"]["name"] == file.name and document["dynamics_guarantee"]
    assert "law.onnx(x, u)" in (tmp_path / "out" / "report.html").read_text()
    job, rng = part.job, np.random.default_rng(4)
    for row in document["tubes"]:
        box = ParameterBox(job.loop.box.names, job.loop.box.units, tuple(row["lower"]), tuple(row["upper"]))
        tube = job.reacher().tube(box)
        for start in [*box.corners(), *box.sample(10, rng)]:
            run = simulate(job.reacher(), job.loop.state(box, start), sampled_disturbances(job.loop, rng, "ends"))
            assert first_outside(tube, run) is None
    file.write_bytes(file.read_bytes().replace(b"network", b"another"))
    code, said = call(part.options(tmp_path / "out", resume=True))
    assert code == 2 and said.count("\n") == 1 and "--resume" in said, said


@pytest.mark.parametrize(
    ("node", "fragments"),
    [(None, ("none.onnx: no such network",)), ("Sin", ("bad.onnx: node Sin_v0 (Sin): operator is not supported",))],
)
def test_bad_files_of_dynamics(
    node: str | None, fragments: tuple[str, ...], course: Course, call: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    name = "none.onnx"
    if node is not None:
        f, name = OnnxFile((7,), batch=1), "bad.onnx"
        f.node(node)
        f.write(course.loop.with_name(name))
    wrong = course.changed("wrong.json", dynamics={"type": "onnx", "file": name})
    code, said = call(wrong.options(tmp_path / "out"))
    assert code == 2 and said.count("\n") == 1 and said.startswith("error: ") and "; " in said, said
    for fragment in fragments:
        assert fragment in said


def test_a_gain_that_does_not_fit(course: Course, call: Callable[..., tuple[int, str]], tmp_path: Path) -> None:
    wrong = course.changed("wrong.json", control={"gain": [[1.0], [1.0]]})
    code, said = call(wrong.options(tmp_path / "out"))
    assert code == 2 and said.count("\n") == 1 and "wrong.json: control.gain" in said
