"""``ns-abstract-certify`` from outside: verdicts that are attacked, exit codes, kills, engines, reports."""

from __future__ import annotations

import base64
import hashlib
import importlib.util
import io
import itertools
import json
import math
import os
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch
from certifying import classifier, linear
from conftest import InProcess, Inputs, command_options, environment
from interrupting import check_ended_in_a_library_call, check_interrupted, held_at, interrupted_at
from PIL import Image
from waiting import LONG, until

from ns_abstract.api import certificate_report
from ns_abstract.api.cell_search import examine_block
from ns_abstract.api.certificate_report import PoseRenderer, look_closer
from ns_abstract.api.certification import Certification, CertifySettings, FramePictures, open_certification
from ns_abstract.api.certifying import CertificateQuestion
from ns_abstract.api.files import Settings
from ns_abstract.cli import certify as certify_command
from ns_abstract.cli.certify import Certify, certify
from ns_abstract.demo.writing import write_demo
from ns_abstract.execution.cancellation import Deadline
from ns_abstract.execution.engines import Processes, SerialEngine
from ns_abstract.execution.worker_cache import clear_cache
from ns_abstract.io.atomic import write_json
from ns_abstract.io.errors import InputError
from ns_abstract.methods.splat.method import SplatMethod
from ns_abstract.methods.splat.reference import Reference
from ns_abstract.perturbation.variations import SceneVariation, Selection
from ns_abstract.verify import model
from ns_abstract.verify.camera_response import CameraResponse
from ns_abstract.verify.eight_bit import rounded
from ns_abstract.verify.network import OutputBounds
from ns_abstract.verify.registration import RegisteredImages
from ns_abstract.verify.scene_margin import CAMERA_KINDS, KINDS, PLACES

MODULE = "ns_abstract.cli.certify"
SIZE = 16

PRE = {"resize": [SIZE, SIZE], "mean": [0.4, 0.45, 0.5], "std": [0.25, 0.25, 0.3]}
SWEEP = {"version": 1, "translation": {"x": 0.15}}


class Case:
    """Files of one certification."""

    def __init__(
        self, folder: Path, blobs: Inputs, net: Path, prop: Any, spec: Any = SWEEP, picture: Any = "float"
    ) -> None:
        folder.mkdir(exist_ok=True)
        self.blobs, self.net, self.picture = blobs, net, picture
        self.prop = write_json(folder / "prop.json", prop)
        self.spec = None if spec is None else write_json(folder / "spec.json", spec)

    def values(self, output: Path, **more: Any) -> dict[str, Any]:
        found = {
            "load_config": self.blobs.config, "camera_path_filename": self.blobs.path, "model": self.net,
            "property": self.prop, "output_dir": output, "perturbation_filename": self.spec, "frames": (0,),
            "workers": 1, "picture": self.picture,
        }  # fmt: skip
        return found | more

    def options(self, output: Path, **more: Any) -> list[str]:
        found = []
        for name, value in self.values(output, **more).items():
            if value is None or value is False:
                continue
            found.append(f"--{name.replace('_', '-')}")
            if value is not True:
                found += map(str, value if isinstance(value, tuple) else [value])
        return found

    def run(self, output: Path, **more: Any) -> dict[str, Any]:
        assert certify(command_options(Certify, **self.values(output, **more))) == 0
        return report(output)

    @property
    def job(self) -> Certification:
        files = Settings(self.blobs.config, self.blobs.path, self.spec)
        return open_certification(CertifySettings(files, self.net, self.prop, picture=self.picture))


def report(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "report.json").read_text())


def cells(folder: Path) -> list[tuple[Any, ...]]:
    with sqlite3.connect(folder / "cells.sqlite") as base:
        rows = base.execute("SELECT frame, lower, upper, verdict, margin, counterexample FROM cells").fetchall()
    return sorted(rows, key=lambda row: (row[0], json.loads(row[1])))


def start(options: list[str], **more: Any) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", MODULE, *options], text=True, env=environment(), stderr=subprocess.PIPE, **more
    )


@pytest.fixture(scope="session")
def net(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return classifier(tmp_path_factory.mktemp("net") / "net.onnx", SIZE)


@pytest.fixture(scope="session")
def bright(blobs: Inputs, net: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, float, float]:
    """A network ``y = (contrast, threshold)`` whose sign flips inside the set, and the range of the contrast."""
    folder = tmp_path_factory.mktemp("bright")
    row = np.zeros((3, SIZE, SIZE))
    row[:, :, : SIZE // 2], row[:, :, SIZE // 2 :] = 1.0, -1.0
    rows = np.stack([row.reshape(-1), 0.0 * row.reshape(-1)]) / row.size
    file = linear(folder / "net.onnx", rows, np.zeros(2), SIZE)
    case = Case(folder / "case", blobs, file, {"type": "classification", "label": 0, "preprocess": PRE})
    pictures = case.job.pictures(0)
    images = np.stack([pictures.image(np.array([x])) for x in np.linspace(-0.15, 0.15, 31)])
    contrast = case.job.model.outputs(images)[:, 0]
    threshold = float(np.quantile(contrast, 0.4))
    return linear(folder / "net.onnx", rows, np.array([0.0, threshold]), SIZE), float(contrast.min()), threshold


@pytest.fixture(scope="session")
def planted(blobs: Inputs, bright: tuple[Path, float, float], tmp_path_factory: pytest.TempPathFactory) -> Case:
    folder = tmp_path_factory.mktemp("planted")
    return Case(folder, blobs, bright[0], {"type": "classification", "label": 0, "preprocess": PRE})


@pytest.fixture(scope="session")
def finished(planted: Case, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An uninterrupted run of the planted violation."""
    folder = tmp_path_factory.mktemp("finished") / "out"
    planted.run(folder)
    return folder


def attack(case: Case, folder: Path, frame: int = 0, poses: int = 6) -> tuple[int, int, float]:
    """Certified cells attacked by two renderers: random poses, ends, and descent through renderer and network.

    Returns:
        Comparisons, violations, and the least slack between a margin found and the one proved.
    """
    job = case.job
    pictures = job.pictures(frame)
    claim = job.claim(pictures)
    splat = job.job.method
    assert isinstance(splat, SplatMethod)
    reference = Reference(splat.scene, splat.rasteriser)
    names = [name for name, _ in job.job.parameters]
    order = [names.index(name) for name in pictures.box.names]
    session = onnxruntime.InferenceSession(str(case.net), providers=["CPUExecutionProvider"])
    rng = np.random.default_rng(7)
    comparisons, violations, slack = 0, 0, np.inf

    def compare(image: np.ndarray, values: np.ndarray, proved: float) -> None:
        nonlocal comparisons, violations, slack
        image = rounded(image) if case.picture == "8-bit" else image
        inputs = job.property.preprocess.apply(torch.from_numpy(image.astype(np.float32))[None]).numpy()
        outputs = torch.from_numpy(session.run(None, {session.get_inputs()[0].name: inputs})[0]).double().reshape(1, -1)
        margin = float(claim.margin(outputs, torch.from_numpy(values)[None])[0])
        comparisons += 1
        violations += not margin >= proved
        slack = min(slack, margin - proved)

    for index, lower, upper, verdict, proved, _ in cells(folder):
        if verdict != "certified" or index != frame:
            continue
        low, high = (np.array(json.loads(ends))[order] for ends in (lower, upper))
        values = [low, high, *rng.uniform(low, high, (poses, len(low)))] if len(low) else [low]
        middle = torch.from_numpy(0.5 * (low + high)).requires_grad_(True)
        if len(low):
            margin = claim.margin(job.model.differentiable(pictures.differentiable(middle)[None]), middle[None])[0]
            (slope,) = torch.autograd.grad(margin, middle)
            values.append(np.where(slope.numpy() > 0, low, high))
        for number, pose in enumerate(values):
            compare(pictures.image(pose), pose, proved)
            if number < 2:
                image = reference.image(pictures.frame.camera, torch.from_numpy(pictures.pose_set.pose(pose)))
                compare(image.detach().numpy(), pose, proved)
    return comparisons, violations, slack


# ---------------------------------------------------------------- verdicts


@pytest.mark.slow
def test_given_set_is_that_of_a_file(
    blobs: Inputs, net: Path, tmp_path: Path, in_process: InProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    """--translation and --rotation, as ns-abstract-render has them; without a set, the path's poses alone."""
    orders: list[Any] = []
    monkeypatch.setattr("ns_abstract.cli.searching.certify_path", lambda order, stop: orders.append(order) or True)
    prop = {"type": "classification", "label": 0, "preprocess": PRE}
    for more, spec in (
        ({"translation": 0.05, "rotation": (2, 1, 0), "angle_units": "degrees"},
         {"version": 1, "angle_units": "degrees", "translation": dict.fromkeys("xyz", 0.05),
          "rotation": {"yaw": 2, "pitch": 1}}),
        ({"translation": (0.1, 0, 0.2), "units": "dataset"},
         {"version": 1, "units": "dataset", "translation": {"x": 0.1, "z": 0.2}}),
        ({}, None),
    ):  # fmt: skip
        case = Case(tmp_path / "case", blobs, net, prop, spec)
        options = case.options(tmp_path / "out", perturbation_filename=None, **more)
        code, _, said = in_process(certify_command.main, options)
        assert code == 0, said
        job = open_certification(orders[-1].settings)
        assert [poses.box for poses in job.job.pose_sets] == [poses.box for poses in case.job.job.pose_sets]
    case = Case(tmp_path / "case", blobs, net, prop)
    code, _, said = in_process(certify_command.main, case.options(tmp_path / "out", rotation=0.1))
    assert code == 2 and said.count("\n") == 1 and "--rotation: given beside --perturbation-filename" in said
    wrong = case.options(tmp_path / "out", perturbation_filename=None, translation=(0.1, 0.2))
    code, _, said = in_process(certify_command.main, wrong)
    assert code == 2 and said.count("\n") == 1 and "--translation: found 2 numbers" in said
    files = Settings(blobs.config, blobs.path, given_set={"version": 1, "rotation": {"yaw": -1.0}})
    with pytest.raises(InputError, match="not negative") as caught:
        open_certification(CertifySettings(files, net, case.prop))
    assert caught.value.field == "--rotation.yaw" and caught.value.file is None


@pytest.mark.slow
def test_planted_violation(planted: Case, finished: Path, bright: tuple[Path, float, float]) -> None:
    """The set holds poses whose images break the property: they are found, and no cell with one is certified."""
    document = report(finished)
    assert document["verdict"] == "falsified" and document["state"] == "done"
    covered = document["coverage"]
    assert sum(covered[k] for k in ("certified", "falsified", "unknown")) == pytest.approx(1.0)
    assert covered["certified"] > 0.3 and covered["falsified"] > 0.1 and covered["unknown"] < 0.02
    pictures = planted.job.pictures(0)
    broken = [
        x for x in np.linspace(-0.15, 0.15, 301)
        if not np.subtract(*planted.job.model.outputs(pictures.image(np.array([x]))[None])[0]) > 0.0
    ]  # fmt: skip
    assert broken
    for x in broken:
        kinds = {row[3] for row in cells(finished) if json.loads(row[1])[0] <= x <= json.loads(row[2])[0]}
        assert "certified" not in kinds


@pytest.mark.slow
def test_every_certified_cell_is_attacked(planted: Case, finished: Path) -> None:
    comparisons, violations, slack = attack(planted, finished)
    assert comparisons > 100 and violations == 0
    # the proofs are not idle: somewhere the margin found comes close to the one proved
    assert 0.0 <= slack < 0.05


@pytest.mark.slow
def test_counterexamples_are_stored_and_break_the_property(planted: Case, finished: Path) -> None:
    rows = [row for row in cells(finished) if row[3] == "falsified"]
    files = sorted((finished / "counterexamples").iterdir())
    assert len(files) == len(rows) > 0
    pictures = planted.job.pictures(0)
    stored = set()
    for file in files:
        with np.load(file, allow_pickle=False) as found:
            np.testing.assert_array_equal(pictures.image(found["values"]), found["image"])
            np.testing.assert_array_equal(planted.job.model.outputs(found["image"][None])[0], found["outputs"])
            assert found["outputs"][0] <= found["outputs"][1] and float(found["margin"]) <= 0.0
            np.testing.assert_array_equal(pictures.pose_set.pose(found["values"]), found["camera_to_world"])
            assert list(found["names"]) == ["x"]
            stored.add(tuple(found["values"].tolist()))
    assert stored == {tuple(json.loads(row[5])) for row in rows}


@pytest.mark.slow
def test_rounded_pictures(planted: Case, tmp_path: Path) -> None:
    """8 bits: certified cells are attacked, and counterexamples stored, with the pictures of a file."""
    case = Case(tmp_path / "case", planted.blobs, planted.net, json.loads(planted.prop.read_text()), picture="8-bit")
    document = case.run(tmp_path / "out")
    covered = document["coverage"]
    assert document["picture"] == "8-bit" and covered["certified"] > 0.3 and covered["falsified"] > 0.1
    comparisons, violations, slack = attack(case, tmp_path / "out")
    assert comparisons > 100 and violations == 0 and slack < 0.05
    files = list((tmp_path / "out" / "counterexamples").iterdir())
    assert files
    for file in files:
        with np.load(file, allow_pickle=False) as found:
            image = found["image"]
            np.testing.assert_array_equal(image, np.rint(image * 255.0).astype(np.float32) / np.float32(255.0))
            np.testing.assert_array_equal(case.job.model.outputs(image[None])[0], found["outputs"])
    # another picture is another search
    with pytest.raises(InputError, match="picture"):
        planted.run(tmp_path / "out", resume=True)
    assert "rounded to 8 bits" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.slow
def test_random_network(blobs: Inputs, net: Path, tmp_path: Path) -> None:
    """Two parameters, a network with two layers of ReLU; the label is the one of the middle."""
    spec = {"version": 1, "translation": {"x": 0.004}, "rotation": {"yaw": 0.004}}
    case = Case(tmp_path / "case", blobs, net, {"type": "classification", "label": 0, "preprocess": PRE}, spec)
    pictures = case.job.pictures(0)
    label = int(case.job.model.outputs(pictures.image(pictures.box.middle)[None])[0].argmax())
    case = Case(tmp_path / "case", blobs, net, {"type": "classification", "label": label, "preprocess": PRE}, spec)
    document = case.run(tmp_path / "out", time_budget=60.0)
    assert document["coverage"]["certified"] > 0.2
    comparisons, violations, _ = attack(case, tmp_path / "out", poses=3)
    assert comparisons and violations == 0


@pytest.mark.slow
def test_unsound_network_bounds_are_caught_by_the_attack(
    planted: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The attack of these tests can fail: bounds raised a little are noticed."""
    real = model.bound_outputs

    def raised(*arguments: Any, **more: Any) -> OutputBounds:
        found = real(*arguments, **more)
        return OutputBounds(found.lower + 2e-2, found.a, found.b + 2e-2)

    monkeypatch.setattr(model, "bound_outputs", raised)
    clear_cache()
    try:
        assert certify(command_options(Certify, **planted.values(tmp_path / "out"))) == 0
    except RuntimeError as error:
        # its own attack noticed it first
        assert "internal error" in str(error)
        return
    finally:
        clear_cache()
    assert attack(planted, tmp_path / "out")[1] > 0


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["nan", "infinite", "crossed", "raises"])
def test_broken_bounds_never_certify(kind: str, planted: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = model.bound_outputs

    def broken(network: Any, images: Any, *arguments: Any, **more: Any) -> OutputBounds:
        if kind == "raises":
            raise ArithmeticError("planted")
        if kind == "crossed":
            object.__setattr__(images, "lower", images.upper + 1.0)
            return real(network, images, *arguments, **more)
        value = np.nan if kind == "nan" else np.inf
        found = real(network, images, *arguments, **more)
        return OutputBounds(np.full_like(found.lower, value), found.a * value, found.b * value)

    monkeypatch.setattr(model, "bound_outputs", broken)
    clear_cache()
    assert certify(command_options(Certify, **planted.values(tmp_path / "out", time_budget=5.0))) == 0
    clear_cache()
    document = report(tmp_path / "out")
    assert document["coverage"]["certified"] == 0.0
    assert {row[3] for row in cells(tmp_path / "out")} <= {"falsified", "unknown"}


@pytest.mark.slow
def test_single_poses_and_paths_without_a_perturbation(
    blobs: Inputs, bright: tuple[Path, float, float], tmp_path: Path
) -> None:
    prop = {"type": "classification", "label": 0, "preprocess": PRE}
    case = Case(tmp_path / "case", blobs, bright[0], prop, None)
    document = case.run(tmp_path / "out", frames=None)
    assert len(document["frames"]) == 3
    found = cells(tmp_path / "out")
    assert [row[0] for row in found] == [0, 1, 2]
    assert {(row[1], row[2]) for row in found} == {("[]", "[]")}
    assert {row[3] for row in found} <= {"certified", "falsified"}
    for row in found:
        pictures = case.job.pictures(row[0])
        margin = -np.diff(case.job.model.outputs(pictures.image(np.zeros(0))[None])[0])[0]
        assert (row[3] == "certified") == (margin > 0.0)
        assert row[4] == pytest.approx(margin, abs=2e-3)
    assert "one pose" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.slow
def test_segments_have_one_table_of_parameters(
    blobs: Inputs, bright: tuple[Path, float, float], tmp_path: Path
) -> None:
    """The last entry of a path has no segment behind it; its cells are listed with the parameter at 0."""
    spec = {"version": 1, "sweep": "segments", "translation": {"z": 0.001}}
    case = Case(tmp_path / "case", blobs, bright[0], {"type": "classification", "label": 0, "preprocess": PRE}, spec)
    case.run(tmp_path / "out", frames=(1, 2), time_budget=2.0)
    with sqlite3.connect(tmp_path / "out" / "cells.sqlite") as base:
        assert [row[1] for row in base.execute("SELECT * FROM parameters ORDER BY position")] == ["z", "segment"]
    sides = [(row[0], json.loads(row[1]), json.loads(row[2])) for row in cells(tmp_path / "out")]
    assert {frame for frame, *_ in sides} == {1, 2}
    assert all(low[1] == high[1] == 0.0 for frame, low, high in sides if frame == 2)


@pytest.mark.slow
def test_partitions(blobs: Inputs, bright: tuple[Path, float, float], tmp_path: Path) -> None:
    prop = {"type": "classification", "label": 0, "preprocess": PRE, "partitions": 300}
    case = Case(tmp_path / "case", blobs, bright[0], prop)
    document = case.run(tmp_path / "out")
    parts = document["partitions"]
    assert parts["partitions"] == 300 and 0.3 < parts["PCP-V"] <= parts["PCP-S"] < 1.0
    width = 0.3 / 300
    pictures = case.job.pictures(0)
    right = 0
    for number in range(300):
        x = [-0.15 + width * (number + t) for t in (0.0, 0.5, 1.0)]
        y = case.job.model.outputs(np.stack([pictures.image(np.array([v]).clip(-0.15, 0.15)) for v in x]))
        right += bool((y[:, 0] > y[:, 1]).all())
    assert abs(right / 300 - parts["PCP-S"]) <= 2.5 / 300
    for _, lower, upper, verdict, *_ in cells(tmp_path / "out"):
        size = (json.loads(upper)[0] - json.loads(lower)[0]) / width
        assert round(size) == pytest.approx(size) and (verdict == "certified" or round(size) == 1)


@pytest.mark.slow
def test_parts_without_a_number_are_not_right(
    blobs: Inputs, bright: tuple[Path, float, float], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the network's outputs are NaN, parts are neither certified nor right, and the report counts them."""
    prop = {"type": "classification", "label": 0, "preprocess": PRE, "partitions": 20}
    case = Case(tmp_path / "case", blobs, bright[0], prop)
    outputs = model.NetworkModel.outputs
    poses = np.linspace(-0.15, 0.15, 81)
    contrast = outputs(case.job.model, np.stack([case.job.pictures(0).image(np.array([x])) for x in poses]))[:, 0]
    limit = float(np.quantile(contrast, 0.8))

    def without(self: Any, images: np.ndarray) -> np.ndarray:
        found = np.array(outputs(self, images))
        found[found[:, 0] > limit] = np.nan
        return found

    monkeypatch.setattr(model.NetworkModel, "outputs", without)
    # bounds know nothing of it
    document = case.run(tmp_path / "out")
    parts, (frame,) = document["partitions"], document["frames"]
    assert parts["undecided"] == frame["partition"]["undecided"] / 20 >= 0.1
    assert parts["PCP-V"] <= parts["PCP-S"] <= 1.0 - parts["undecided"] - frame["coverage"]["falsified"]
    assert document["unknown_because"]["the margin of a picture is no finite number"] >= 2
    assert "unknown (no finite margin)" in (tmp_path / "out" / "report.html").read_text()
    # no part with such a picture at its ends or middle is certified, and every one is counted
    width, low = 0.3 / 20, -0.15
    rows = [
        (json.loads(lower)[0], json.loads(upper)[0], verdict)
        for _, lower, upper, verdict, *_ in cells(tmp_path / "out")
    ]
    undecided = 0
    for number in range(20):
        ends = [low + width * (number + t) for t in (0.0, 0.5, 1.0)]
        values = outputs(
            case.job.model, np.stack([case.job.pictures(0).image(np.array([x]).clip(low, -low)) for x in ends])
        )
        lost = bool((values[:, 0] > limit).any())
        undecided += lost
        (verdict,) = {kind for a, b, kind in rows if a <= ends[1] <= b}
        assert not (lost and verdict == "certified")
    assert 0 < undecided <= frame["partition"]["undecided"]


# ---------------------------------------------------------------- long runs


@pytest.mark.slow
def test_same_again(planted: Case, finished: Path, tmp_path: Path) -> None:
    planted.run(tmp_path / "out")
    assert cells(tmp_path / "out") == cells(finished)


@pytest.mark.slow
def test_killed_run_resumed_equals_an_uninterrupted_one(planted: Case, finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    for resume in (False, True, True):
        # killed as soon as it has stored something new
        process = held_at(1, MODULE, planted.options(folder, resume=resume))
        process.kill()
        process.wait()
    assert certify(command_options(Certify, **planted.values(folder, resume=True))) == 0
    assert cells(folder) == cells(finished)
    one, other = report(folder), report(finished)
    for key in ("verdict", "coverage", "sampled"):
        assert one[key] == other[key]
    assert one["frames"] == other["frames"]


@pytest.mark.slow
def test_interrupt_leaves_what_is_finished(planted: Case, finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    process = held_at(3, MODULE, planted.options(folder, workers=2))
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=LONG)
    assert process.returncode == 3 and "Traceback" not in said, said
    assert report(folder)["state"] == "interrupted"
    covered = sum(json.loads(row[2])[0] - json.loads(row[1])[0] for row in cells(folder))
    assert covered == pytest.approx(0.3)
    planted.run(folder, resume=True)
    assert cells(folder) == cells(finished)


@pytest.mark.slow
@pytest.mark.parametrize(
    "place",
    [
        "ns_abstract.cli.searching:open_certification",
        "ns_abstract.cli.searching:compile_beside",
        "ns_abstract.api.certificate_report:preview",
        "ns_abstract.api.cell_search:examine_here",
    ],
)
def test_interrupted_before_the_first_block(
    place: str, planted: Case, finished: Path, tmp_path: Path, in_process: InProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "out"
    with monkeypatch.context() as patched:
        interrupted_at(place, patched)
        check_interrupted(in_process, certify_command.main, planted.options(folder), folder)
    assert folder.exists() == ("open_certification" not in place)
    planted.run(folder, resume=True)
    assert cells(folder) == cells(finished)


@pytest.mark.slow
def test_ended_while_kernels_are_compiled(planted: Case, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    options = planted.options(folder)
    check_ended_in_a_library_call(MODULE, "ns_abstract.cli.searching.compile_beside", options, folder)


@pytest.mark.slow
def test_budget_ends_with_a_result_and_is_continued(
    planted: Case, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "out"
    assert certify(command_options(Certify, **planted.values(folder, time_budget=1e-6))) == 0
    assert "the time budget ended first: go on with --resume" in "".join(capsys.readouterr())
    first = report(folder)
    assert first["state"] == "budget" and first["verdict"] != "certified"
    assert first["coverage"]["not_examined"] > 0.0 and first["frames"][0]["cells"]["open"] > 0
    # a second frame without any result is not done
    assert certify(command_options(Certify, **planted.values(tmp_path / "two", time_budget=1e-6, frames=(0, 1)))) == 3
    planted.run(folder, resume=True)
    assert cells(folder) == cells(finished)


@pytest.mark.slow
def test_resume_refuses_other_inputs(planted: Case, net: Path, finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    certify(command_options(Certify, **planted.values(folder, time_budget=1e-6)))
    before = cells(folder)
    for change in ({"model": net}, {"arithmetic": "real"}, {"perturbation_filename": None}):
        with pytest.raises(InputError) as caught:
            certify(command_options(Certify, **planted.values(folder, resume=True, **change)))
        assert caught.value.field == "--resume"
    assert [row[:3] for row in cells(folder)] == [row[:3] for row in before]


@pytest.mark.slow
def test_processes_equal_one_process(planted: Case, finished: Path, tmp_path: Path) -> None:
    planted.run(tmp_path / "out", workers=2)
    assert cells(tmp_path / "out") == cells(finished)


def sleep_or_die(marker: str, number: int) -> int:
    """Kills its process the first time it is asked for number 3."""
    file = Path(marker)
    if number == 3 and not file.exists():
        file.write_text("died")
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def die(number: int) -> int:
    os._exit(7)


@pytest.mark.slow
def test_killed_worker_loses_nothing_and_counts_nothing_twice(tmp_path: Path) -> None:
    engine = Processes(2)
    try:
        for number in range(8):
            engine.submit(number, sleep_or_die, str(tmp_path / "marker"), number)
        found: list[tuple[int, int]] = []
        until(lambda: bool(found.extend(engine.collect(1.0))) or len(found) >= 8)
        assert sorted(found) == [(n, n * n) for n in range(8)] and (tmp_path / "marker").exists()
        assert engine.collect(0.1) == []
    finally:
        engine.close()


@pytest.mark.slow
def test_worker_that_always_dies_is_an_error() -> None:
    engine = Processes(1)
    try:
        engine.submit(0, die, 0)
        with pytest.raises(InputError, match="ended 4 times"):
            for _ in range(100):
                engine.collect(1.0)
    finally:
        engine.close()


def test_engine_here() -> None:
    engine = SerialEngine()
    engine.submit(1, divmod, 7, 2)
    assert engine.collect(0.0) == [(1, (3, 1))] and engine.collect(0.0) == []


needs_dask = pytest.mark.skipif(importlib.util.find_spec("distributed") is None, reason="dask is not installed")


@pytest.mark.slow
@needs_dask
def test_two_dask_workers_equal_one_process(planted: Case, finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    process = start(planted.options(folder, workers=2, engine="dask"), cwd=tmp_path)
    _, said = process.communicate(timeout=LONG)
    assert process.returncode == 0, said
    assert cells(folder) == cells(finished)


@pytest.mark.slow
@needs_dask
def test_dask_worker_killed(planted: Case, finished: Path, tmp_path: Path) -> None:
    from ns_abstract.execution.cluster import Cluster, connected
    from ns_abstract.verify.store import Store

    job = planted.job
    recipe, grid = job.recipe, job.grid(0)
    store = Store(tmp_path / "out", job.fingerprint, job.job.parameters, job.job.fixed, resume=False)
    store.begin(0, grid, job.first_blocks(grid))
    with connected(None, 2) as client:
        engine = Cluster(client)
        flying: dict[int, Any] = {}
        killed = False
        while True:
            for block in store.pending(set(flying), engine.capacity - len(flying)):
                flying[block.number] = block
                engine.submit(block.number, examine_block, recipe, 0, grid, block.cells)
            if not flying:
                break
            if not killed and store.count:
                killed = True
                os.kill(next(iter(client.run(os.getpid).values())), signal.SIGKILL)
            for number, findings in engine.collect(0.5):
                assert store.close_block(flying.pop(number), findings, grid)
        engine.close()
    assert killed
    store.close()
    assert cells(tmp_path / "out") == cells(finished)


@pytest.mark.slow
@needs_dask
def test_cluster_on_this_machine_keeps_torch_quick() -> None:
    from ns_abstract.execution.cluster import connected

    with connected(None, 1) as client:
        (found,) = client.run(lambda: os.environ.get("MALLOC_TRIM_THRESHOLD_")).values()
        assert found is None
        (threads,) = client.run(lambda: os.environ.get("OMP_NUM_THREADS")).values()
        assert threads == "1"


# ---------------------------------------------------------------- reports


@pytest.mark.slow
def test_report(planted: Case, finished: Path) -> None:
    document = report(finished)
    for key in (
        "version", "verdict", "guarantee", "guarantee_text", "network_guarantee", "renderer", "scene", "model",
        "property", "coverage", "sampled", "frames", "trace", "seconds", "plan", "settings", "fingerprint", "command",
        "assumptions",
    ):  # fmt: skip
        assert key in document, key
    assert document["guarantee"] == "float32-sound" and document["model"]["input"] == [3, SIZE, SIZE]
    assert document["property"]["type"] == "classification"
    (frame,) = document["frames"]
    assert frame["parameters"] == [{"name": "x", "unit": "normalised units", "lower": -0.15, "upper": 0.15}]
    assert frame["intrinsics"] == planted.job.job.pose_sets[0].camera.intrinsics._asdict()
    assert (frame["intrinsics"]["width"], frame["intrinsics"]["height"]) == (SIZE, SIZE)
    assert frame["least_margin"] > 0.0 and frame["counterexamples"][0]["margin"] <= 0.0
    assert frame["counterexamples"][0]["values"].keys() == {"x"}
    volumes = dict.fromkeys(("certified", "falsified", "unknown"), 0.0)
    for _, lower, upper, verdict, *_ in cells(finished):
        volumes[verdict] += (json.loads(upper)[0] - json.loads(lower)[0]) / 0.3
    for kind, volume in volumes.items():
        assert document["coverage"][kind] == pytest.approx(volume)
    assert document["trace"][-1]["certified"] == pytest.approx(document["coverage"]["certified"])
    # one camera by cell, at its middle
    places, poses = document["cameras"], planted.job.job.pose_sets[0]
    middles = [0.5 * (json.loads(lower)[0] + json.loads(upper)[0]) for _, lower, upper, *_ in cells(finished)]
    found = sorted(cell["position"] for cell in places["cells"])
    assert places["left_out"] == 0 and {cell["frame"] for cell in places["cells"]} == {0}
    np.testing.assert_allclose(found, sorted(poses.pose(np.array([x]))[:, 3].tolist() for x in middles), atol=1e-5)


def test_page(finished: Path) -> None:
    page = (finished / "report.html").read_text()
    assert page.index("Falsified; certified on") < page.index("<h2>")
    for part in (
        "<svg", 'class="certified"', 'class="falsified"', "Counterexamples", "What is guaranteed", "data:image/png",
        "not its rounding to 8 bits", "every float32", "worst certified", "cells.sqlite", "How to reproduce",
    ):  # fmt: skip
        assert part in page, part
    assert "https://" not in page and "http://" not in page
    # frusta of all cells, twice, over the scene
    kinds = [verdict for _, _, _, verdict, *_ in cells(finished)]
    groups = re.findall(r'<image [^>]*href="data:image/png[^>]*><g class="frusta">(.*?)</g>', page)
    assert [sorted(re.findall(r'class="(\w+)"', group)) for group in groups] == [sorted(kinds)] * 2
    # one script, which the policy names by its hash, and its data
    scripts = re.findall(r"<script([^>]*)>(.*?)</script>", page, re.DOTALL)
    (_, data), (_, code) = scripts
    digest = base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'\"" in page and scripts[0][0] == ' type="application/json" id="cell-data"'
    # every cell can be chosen, and some show a picture
    found = json.loads(data)
    chosen = {int(number) for number in re.findall(r'data-cell="(\d+)"', page)}
    assert chosen == set(range(len(found["cells"]))) and len(chosen) > 3
    rows = sqlite3.connect(finished / "cells.sqlite").execute("SELECT verdict, margin FROM cells").fetchall()
    assert sorted((cell[1], cell[4]) for cell in found["cells"]) == sorted(rows)
    assert found["pictures"] and {cell[6] for cell in found["cells"]} >= set(range(len(found["pictures"])))


def test_where_it_fails_is_looked_at_closely(planted: Case, finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures, outputs and margins are those of the renderer and the network; all is bounded in time, and repeats."""
    entries = report(finished)["frames"]
    names = "lower", "upper", "verdict", "margin", "counterexample"
    rows: list[dict[str, Any]] = [
        dict(
            zip(names, (json.loads(low), json.loads(high), kind, margin, example and json.loads(example)), strict=True)
        )
        for _, low, high, kind, margin, example in cells(finished)
    ]
    job = planted.job
    monkeypatch.setattr(certificate_report, "SECONDS", np.inf)
    found = look_closer(PoseRenderer(job, lambda *_: None), entries, {0: rows}, lambda: False)
    broken = sum(r["upper"][0] - r["lower"][0] for r in rows if r["verdict"] == "falsified") / 0.3
    assert sum(region.share for region in found.regions) == pytest.approx(broken) and found.why == ""
    pictures = job.pictures(0)
    claim = job.claim(pictures)
    proved = [(r["lower"][0], r["upper"][0]) for r in rows if r["verdict"] == "certified"]
    assert len(found.pictures) == min(6, len(found.regions)) > 0
    for region, (bad, good) in zip(found.regions, found.pictures, strict=False):
        assert good is not None and tuple(bad.values) == region.pose and bad.margin == pytest.approx(region.margin)
        assert bad.margin is not None and good.margin is not None and bad.margin <= 0.0 < good.margin
        (x,), (pose,) = good.values, bad.values
        assert any(low <= x <= high for low, high in proved)
        assert abs(x - pose) == min(min(abs(end - pose) for end in ends) for ends in proved)
    for shown in [s for pair in found.pictures for s in pair if s] + [s for _, s in found.stops]:
        image = pictures.image(np.array(shown.values))
        outputs = np.asarray(job.model.outputs(image[None]), np.float64)
        assert shown.outputs == outputs[0].tolist()
        margin = claim.margin(torch.from_numpy(outputs), torch.tensor([list(shown.values)], dtype=torch.float64))
        assert shown.margin == float(margin[0])
        stored = np.asarray(Image.open(io.BytesIO(shown.png)), np.int64)
        assert np.abs(stored - image * 255.0).max() <= 1.0
    assert len(found.stops) == 24 and {stop.verdict for stop, _ in found.stops} >= {"certified", "falsified"}
    for stop, shown in found.stops:
        assert stop.proven is None or (shown.margin is not None and shown.margin >= stop.proven)
    assert look_closer(PoseRenderer(job, lambda *_: None), entries, {0: rows}, lambda: False) == found
    # no time: what is known without pictures stays
    late = look_closer(PoseRenderer(job, lambda *_: None), entries, {0: rows}, lambda: True)
    assert late.regions == found.regions and not late.pictures and not late.stops and "time" in late.why
    # nothing certified: a right pose of a cell without a verdict
    unsure = [r | {"verdict": "unknown"} if r["verdict"] == "certified" else r for r in rows]
    found = look_closer(PoseRenderer(job, lambda *_: None), entries, {0: unsure}, lambda: False)
    assert any(good and "not certified" in good.title and good.margin > 0.0 for _, good in found.pictures)  # type: ignore[operator]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("deadline", "left", "least", "most"),
    # a search that may finish what it began; one that ends with the budget; one that has no time for pictures
    [
        (math.inf, -30.0, 4.0, 5.0),
        (math.inf, 100.0, 104.0, 105.0),
        (-30.0, -30.0, -26.0, -25.0),
        (-math.inf, 9.0, -math.inf, -99.0),
    ],
)
def test_last_pictures_end_with_the_time(deadline: float, left: float, least: float, most: float) -> None:
    search: Any = SimpleNamespace(deadline=Deadline(deadline), whole=Deadline(left), stop=lambda: False)
    CertificateQuestion.finish(object.__new__(CertificateQuestion), search)
    assert least <= search.deadline.left <= most


def test_pictures_of_a_resumed_command(planted: Case, finished: Path, tmp_path: Path) -> None:
    """They are made again, and are the same; what an interrupted command leaves is none of them."""
    page = (finished / "report.html").read_text()
    assert "Where it fails" in page and "Along the set" in page
    names = {"verdicts_00000.svg", "cameras.svg"}
    assert {file.name for file in finished.glob("*.svg")} == names
    shutil.copytree(finished, tmp_path / "out")
    for name in names:
        (tmp_path / "out" / name).write_bytes(b"another command's")
    planted.run(tmp_path / "out", resume=True)
    for name in names:
        assert (tmp_path / "out" / name).read_bytes() == (finished / name).read_bytes()


def test_ring_strip_plane_and_bars() -> None:
    from ns_abstract.report import certificate_page as page

    covered = {"certified": 0.5, "falsified": 0.25, "unknown": 0.25, "not_examined": 0.0}

    def entry(index: int, *names: str) -> dict[str, Any]:
        sides = [{"name": n, "unit": "rad", "lower": 0.0, "upper": 6.0} for n in names]
        return {"index": index, "parameters": sides, "coverage": covered}

    def rows(d: int) -> list[dict[str, Any]]:
        kinds = ("certified", "certified", "falsified", "unknown")
        return [
            {"lower": [1.5 * k] + [0.0] * (d - 1), "upper": [1.5 * (k + 1)] + [6.0] * (d - 1), "verdict": kind}
            for k, kind in enumerate(kinds)
        ]

    frames = [entry(0, "azimuth"), entry(1, "x"), entry(2, "x", "y"), entry(3, "x", "y", "z")]

    def shown(cells: dict[int, list[dict[str, Any]]], numbers: dict[tuple[int, int], int]) -> str:
        maps, bars = page.verdict_drawings(frames, cells, numbers)
        return "".join(drawing[0] for drawing in (*maps, *bars))

    drawn = shown({k: rows(max(1, k)) for k in range(4)}, {})
    assert "data-cell" not in drawn
    numbers = page._numbered({"frames": frames}, cells := {k: rows(max(1, k)) for k in range(4)})
    each = shown(cells, numbers)
    # every cell of rings, strips and planes; a bar has the first of each verdict
    assert sorted(map(int, re.findall(r'data-cell="(\d+)"', each))) == [*range(13), 14, 15]
    assert drawn.count("<svg") == 4
    for title in ("Verdicts around the orbit", "Verdicts along x", "Verdicts over two parameters", "Parts of each"):
        assert title in drawn
    # neighbours of one verdict are one span
    assert page._merged(rows(1), 0) == [(0.0, 3.0, "certified"), (3.0, 4.5, "falsified"), (4.5, 6.0, "unknown")]
    assert [page.percent(p) for p in (1.0, 0.999999, 1e-9, 0.0, 0.12345)] == [
        "100.00 %", "> 99.99 %", "< 0.01 %", "0.00 %", "12.35 %",
    ]  # fmt: skip


@pytest.mark.slow
def test_foreign_text_is_escaped(blobs: Inputs, bright: tuple[Path, float, float], tmp_path: Path) -> None:
    net = tmp_path / "<b>net&.onnx"
    net.write_bytes(bright[0].read_bytes())
    prop = {"type": "classification", "label": 0, "preprocess": PRE}
    Case(tmp_path / "case", blobs, net, prop, None).run(tmp_path / "out")
    page = (tmp_path / "out" / "report.html").read_text()
    assert "<b>net&.onnx" not in page and "&lt;b&gt;net&amp;.onnx" in page


# ---------------------------------------------------------------- the command line


@pytest.fixture
def call(in_process: InProcess) -> Callable[[list[str]], tuple[int, str]]:
    def run(options: list[str]) -> tuple[int, str]:
        code, _, err = in_process(certify_command.main, options)
        return code, err

    return run


MISTAKES: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
    "budget": ({"time_budget": -1}, ("--time-budget",)),
    "workers": ({"workers": 0}, ("--workers",)),
    "memory": ({"memory_limit": -1}, ("--memory-limit",)),
    "address": ({"scheduler_address": "h:1"}, ("--scheduler-address", "--engine dask")),
    "frame": ({"frames": (9,)}, ("--frames",)),
    "no model": ({"model": Path("none.onnx")}, ("none.onnx",)),
    "model of another kind": ({"model": Path(__file__)}, ("test_certify_cli.py",)),
    "no property": ({"property": Path("none.json")}, ("none.json", "property file")),
    "no run": ({"load_config": Path("none.yml")}, ("none.yml",)),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistake_is_one_line(name: str, planted: Case, call: Callable[..., tuple[int, str]], tmp_path: Path) -> None:
    changes, fragments = MISTAKES[name]
    code, said = call(planted.options(tmp_path / "out", **changes))
    assert code == 2 and said.count("\n") == 1 and said.startswith("error: ") and "; " in said, said
    for fragment in fragments:
        assert fragment in said


def test_size_that_does_not_fit(blobs: Inputs, net: Path, call: Callable[..., tuple[int, str]], tmp_path: Path) -> None:
    case = Case(tmp_path / "case", blobs, net, {"type": "classification", "label": 0})
    code, said = call(case.options(tmp_path / "out"))
    assert code == 2 and "prop.json" in said and "preprocess.resize" in said and f"[{SIZE}, {SIZE}]" in said


def test_partition_that_does_not_fit(
    blobs: Inputs, net: Path, call: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    prop = {"type": "classification", "label": 0, "preprocess": PRE, "partitions": [3, 4]}
    code, said = call(Case(tmp_path / "case", blobs, net, prop).options(tmp_path / "out"))
    assert code == 2 and "prop.json: partitions" in said


EVERYTHING = {"select": {"box": [[-9, -9, -9], [9, 9, 9]]}}


@pytest.mark.slow
@pytest.mark.parametrize(
    "entry", [{"color": 0.02}, {"opacity": [-0.1, 0.02]}, {"mean": 0.002}], ids=lambda e: next(iter(e))
)
@pytest.mark.parametrize("moves", [True, False])
def test_scene_variations(
    blobs: Inputs, bright: tuple[Path, float, float], entry: dict[str, Any], moves: bool, tmp_path: Path
) -> None:
    """Members of the set break no certificate; counterexamples name a scene that breaks the property."""
    spec = {"version": 1, "scene": [EVERYTHING | entry]} | ({"translation": {"x": [-0.15, -0.1]}} if moves else {})
    case = Case(tmp_path / "case", blobs, bright[0], {"type": "classification", "label": 0, "preprocess": PRE}, spec)
    job = case.job
    # compiles what the time would go to
    examine_block(job.recipe, 0, job.grid(0), tuple(job.grid(0).roots()[:1]))
    found = case.run(tmp_path / "out", time_budget=3.0)
    assert any("scenes of the set" in line for line in found["plan"])
    pictures = job.pictures(0)
    claim = job.claim(pictures)

    def margin(image: np.ndarray, values: np.ndarray) -> float:
        outputs = torch.from_numpy(np.asarray(job.model.outputs(image[None]), np.float64))
        return float(claim.margin(outputs, torch.from_numpy(values)[None])[0])

    def loss(picture: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        return -claim.margin(job.model.differentiable(picture[None]), values[None])[0]

    rng = np.random.default_rng(3)
    for _, lower, upper, verdict, proved, _ in cells(tmp_path / "out"):
        if verdict != "certified":
            continue
        box = pictures.box
        for axis, ends in enumerate(zip(json.loads(lower), json.loads(upper), strict=True)):
            box = box.replace(axis, *ends)
        for scene_sample in itertools.islice(pictures.scene_samples(5), 0, 26, 5):
            values = box.sample(1, rng)[0] if box.dimensions else box.middle
            assert margin(pictures.image(values, scene_sample), values) >= proved
        values, scene_sample = scene_sample.signed_gradient_step(box, values, loss, 2.0)
        assert box.contains(values) and margin(pictures.image(values, scene_sample), values) >= proved
    for file in (tmp_path / "out" / "counterexamples").glob("*.npz"):
        with np.load(file) as stored:
            assert margin(stored["image"], stored["values"]) <= 0.0
            # what varies is stored where another scene than the nearest is shown
            for name in set(stored.files) & {"scene_mean", "scene_opacity", "scene_color"}:
                assert name == f"scene_{next(iter(entry))}"


@pytest.mark.slow
def test_a_variation_of_the_scene_breaks_what_poses_do_not(
    blobs: Inputs, bright: tuple[Path, float, float], tmp_path: Path
) -> None:
    """One pose at which the property holds: colours that may be anything break it, and the page shows how."""
    pose = {"version": 1, "translation": {"x": [0.1, 0.1]}}
    prop = {"type": "classification", "label": 0, "preprocess": PRE}
    job = Case(tmp_path / "one", blobs, bright[0], prop, pose).job
    assert np.subtract(*job.model.outputs(job.pictures(0).image(np.zeros(0))[None])[0]) > 0.0
    case = Case(tmp_path / "case", blobs, bright[0], prop, pose | {"scene": [EVERYTHING | {"color": 1.0}]})
    found = case.run(tmp_path / "out")
    assert found["verdict"] == "falsified" and found["coverage"]["falsified"] == 1.0
    (file,) = (tmp_path / "out" / "counterexamples").glob("*.npz")
    with np.load(file) as stored:
        assert np.abs(stored["scene_color"]).max() <= 1.0
        assert not np.subtract(*case.job.model.outputs(stored["image"][None])[0]) > 0.0
        assert not np.array_equal(stored["image"], case.job.pictures(0).image(np.zeros(0)))


KINDS_BY_NAME = {kind.name: kind for kind in (*KINDS, *CAMERA_KINDS, *PLACES)}


@pytest.mark.slow
def test_scene_margin(blobs: Inputs, bright: tuple[Path, float, float], tmp_path: Path) -> None:
    """Scenes at the ends of the certified radius break nothing, whatever varies; scenes that do lie farther off."""
    spec = {"version": 1, "translation": {"x": [0.1, 0.11]}}
    case = Case(tmp_path / "case", blobs, bright[0], {"type": "classification", "label": 0, "preprocess": PRE}, spec)
    found = case.run(tmp_path / "out", time_budget=600.0, scene_margin=True)
    assert found["verdict"] == "certified" and found["scene_margin"]["skipped"] is None
    job, rng = case.job, np.random.default_rng(4)
    kinds = {entry["kind"]: entry for entry in found["scene_margin"]["kinds"]}
    assert list(kinds) == ["mean", "opacity", "color", "brightness", "white_balance", "gamma", "registration", "turn"]
    for name, entry in kinds.items():
        radius, broken = entry["radius"], entry["falsified"]
        assert entry["state"] == "done" and radius > 0.0 and entry["runs"] >= entry["cells"]
        # it was bisected to the end, and what was found to break the property lies beyond
        assert radius < entry["not_certified"]["radius"] <= 1.2 * radius or radius == KINDS_BY_NAME[name].most
        assert broken is None or broken["radius"] > radius
        pictures: FramePictures | RegisteredImages
        if place := KINDS_BY_NAME[name].place:
            shown = FramePictures(job.job.method, job.job.pose_sets[0].registered(place, radius))
            pictures = RegisteredImages(shown, shown.frame)
        elif (response := KINDS_BY_NAME[name].response) is not None:
            set_ = CameraResponse(response, radius)
            pictures = FramePictures(job.job.method, job.job.pose_sets[0], "float", set_)
        else:
            ends: dict[str, Any] = {name: (-radius, radius)}
            pictures = FramePictures(job.job.method, job.job.varied(0, SceneVariation(Selection(), **ends)))
        claim = job.claim(job.pictures(0))

        def loss(picture: torch.Tensor, values: torch.Tensor, claim: Any = claim) -> torch.Tensor:
            return -claim.margin(job.model.differentiable(picture[None]), values[None])[0]

        for number, scene_sample in enumerate(itertools.islice(pictures.scene_samples(2), 0, 24, 2)):
            values = pictures.box.sample(1, rng)[0]
            if number % 4 == 0:
                values, scene_sample = scene_sample.signed_gradient_step(pictures.box, values, loss, 2.0)
            outputs = job.model.outputs(pictures.image(values, scene_sample)[None])
            assert (
                float(claim.margin(torch.from_numpy(np.asarray(outputs, np.float64)), torch.from_numpy(values)[None]))
                > 0
            )
    assert any(entry["falsified"] for entry in kinds.values())
    # the means of all Gaussians together are less than each by itself
    assert kinds["registration"]["radius"] > kinds["mean"]["radius"]
    # factors of the channels are one factor, too
    assert kinds["white_balance"]["radius"] <= kinds["brightness"]["radius"]
    for name, entry in kinds.items():
        files = list((tmp_path / "out" / "counterexamples").glob(f"scene_margin_{name}.npz"))
        assert bool(files) == bool(entry["falsified"])
        for file in files:
            with np.load(file) as stored:
                assert float(stored["radius"]) == entry["falsified"]["radius"]
                assert not np.subtract(*job.model.outputs(stored["image"][None])[0]) > 0.0
                kind = KINDS_BY_NAME[name]
                told = "place" if kind.place else "response" if kind.response is not None else name
                assert stored[f"scene_{told}"].shape[0] > 0
                if kind.place:
                    shown = FramePictures(job.job.method, job.job.pose_sets[0].registered(kind.place, 1.0))
                    seen = np.concatenate([stored["values"], stored["scene_place"]])
                    assert (shown.image(seen) == stored["image"]).all()
    page = (tmp_path / "out" / "report.html").read_text()
    assert "How wrong the scene may be" in page


def test_a_variation_that_picks_nothing(
    blobs: Inputs, net: Path, call: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    spec = SWEEP | {"scene": [{"select": {"box": [[90, 90, 90], [91, 91, 91]]}, "color": 0.1}]}
    case = Case(tmp_path / "case", blobs, net, {"type": "classification", "label": 0, "preprocess": PRE}, spec)
    code, said = call(case.options(tmp_path / "out"))
    assert code == 2 and said.count("\n") == 1 and "spec.json: scene[0].select" in said and "picks none" in said


@pytest.mark.slow
def test_help_is_quick_and_light() -> None:
    shown = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", MODULE, "--help"],
        capture_output=True, text=True, check=True, env=environment(), timeout=60,
    )  # fmt: skip
    for option in ("--model", "--property", "--time-budget", "--engine", "--scheduler-address", "--resume"):
        assert option in shown.stdout
    loaded = {line.rpartition("|")[2].strip().split(".")[0] for line in shown.stderr.splitlines()}
    assert not loaded & {"torch", "numba", "onnx", "onnxruntime", "numpy", "matplotlib"}


# ---------------------------------------------------------------- whole scenes


@pytest.mark.slow
def test_demo_from_end_to_end(tmp_path: Path) -> None:
    """The demo's orbit, a random network, the label of the middle: some part is certified and nothing wrongly."""
    config, files = write_demo(tmp_path / "demo")
    net = classifier(tmp_path / "net.onnx", 32, seed=3, gain=2.0)
    pre = {"resize": [32, 32], "mean": [0.5, 0.5, 0.5], "std": [0.25, 0.25, 0.25]}
    orbit = json.loads(files["orbit"].read_text())
    orbit["perturbation"]["orbit"]["azimuth"] = [0.0, 0.02]
    path = write_json(tmp_path / "orbit.json", orbit)
    inputs = Inputs(config, path, tmp_path / "unused")
    prop = {"type": "classification", "label": 0, "preprocess": pre}
    case = Case(tmp_path / "case", inputs, net, prop, None)
    pictures = case.job.pictures(0)
    label = int(case.job.model.outputs(pictures.image(pictures.box.middle)[None])[0].argmax())
    case = Case(tmp_path / "case", inputs, net, prop | {"label": label}, None)
    document = case.run(tmp_path / "out", time_budget=60.0)
    assert document["coverage"]["certified"] > 0.0
    comparisons, violations, _ = attack(case, tmp_path / "out", poses=2)
    assert comparisons and violations == 0
    # a short arc is drawn as a strip
    assert "Verdicts along azimuth" in (tmp_path / "out" / "report.html").read_text()
