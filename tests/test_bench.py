"""The benchmarks of rules and plans, and proof that they would notice what they are there to notice."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from certifying import linear

from ns_abstract.api.certifying import CertifyProgress
from ns_abstract.api.files import PathJob
from ns_abstract.bench import loops, plan, rules, scale
from ns_abstract.bench import paper as paper_tables
from ns_abstract.bench.sets import open_jobs, pose_set, splat_of
from ns_abstract.cli.bench import bench
from ns_abstract.cli.bench_options import Certificates, PlanBenchmark, RulesBenchmark, ScaleBenchmark, Tightness
from ns_abstract.cli.common import DONE
from ns_abstract.io.errors import InputError
from ns_abstract.methods.program_options import ProgramOptions
from ns_abstract.methods.splat.activate import activate
from ns_abstract.methods.splat.constants import PAPER
from ns_abstract.methods.splat.frame import SplatFrame
from ns_abstract.paper import splat as paper


def test_version_of_gsplat(blobs) -> None:
    (job,) = open_jobs((blobs.config,), blobs.path, 1.0, program=ProgramOptions(gsplat_version="1.6.0"))
    assert job.method.program["version"] == "1.6.0"
    assert open_jobs((blobs.config,), blobs.path, 1.0)[0].method.program["version"] == "1.4.0"


@pytest.fixture(scope="module")
def job(blobs) -> PathJob:
    return open_jobs((blobs.config,), blobs.path, 1.0)[0]


@pytest.mark.slow
def test_ours_are_tighter_than_the_papers(job: PathJob) -> None:
    rows = rules.compare(job, "yaw", 0, 8, pixels=3, most=12)
    assert [row["rules"] for row in rows] == ["ours", *rules.PAPER_RULES]
    assert all(row["violations"] == 0 for row in rows)
    ours, *others = (float(str(row["gap"])) for row in rows)
    assert float(str(rows[0]["renders' gap"])) <= ours < min(others)
    # without its linear part the paper's alpha is worth less
    assert others[0] < others[-1]


@pytest.mark.slow
def test_wrong_rules_are_noticed(job: PathJob, monkeypatch: pytest.MonkeyPatch) -> None:
    own = rules._own

    def shrunk(*arguments):
        low, high = own(*arguments)
        return 0.6 * low + 0.4 * high, high

    monkeypatch.setattr(rules, "_own", shrunk)
    rows = rules.compare(job, "x", 0, 8, pixels=2, most=12)
    assert [row["violations"] for row in rows] == [2, 0, 0, 0, 0]


def test_weights_are_algorithm_1(job: PathJob) -> None:
    """The weights make the picture."""
    splats, poses = activate(splat_of(job).scene, PAPER), pose_set(job, "point", 0)
    pose = poses.world_to_camera(poses.box.middle)
    for u in ([10.5, 12.5], [16.5, 16.5], [20.5, 14.5]):
        shown = paper.render(splats, poses.camera, *pose, np.array([u]))[0]
        weights = rules.weights_at(splats, poses.camera, *pose, np.array(u))
        np.testing.assert_allclose(weights @ splats.sh[:, 0], shown, rtol=0.0, atol=1e-12)


def test_plan_changes_nothing(job: PathJob) -> None:
    rows = plan.cost_of_omissions(job, "x", 0, 6)
    assert [row["taken back"] for row in rows] == [
        "as planned", "every Gaussian in every cell", "harmonics that are zero",
    ]  # fmt: skip
    for row in rows:
        assert row["cells"] == 6 and row["tighter by"] == 0.0
    # in float32 harmonics are charged the rounding of their evaluation
    assert rows[1]["looser by"] == 0.0 and rows[2]["looser by"] < 1e-4


def test_a_plan_that_loses_something_is_noticed(job: PathJob, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = SplatFrame._bound

    def wider(self, box, tiles, within, candidates, *rest):
        found = whole(self, box, tiles, within, candidates, *rest)
        every = within is not None and candidates is None
        return replace(found, upper=found.upper + np.float32(0.01)) if every else found

    monkeypatch.setattr(SplatFrame, "_bound", wider)
    # parts inherit their parents' bounds: wide enough that those do not hide it
    rows = plan.cost_of_omissions(job, "x", 0, 6, 2.0)
    assert rows[0]["looser by"] == 0.0 and rows[1]["looser by"] > 0.005


@pytest.mark.slow
def test_commands(blobs, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = {"load_config": (blobs.config,), "camera_path_filename": blobs.path}
    assert bench(PlanBenchmark(**files, output_dir=tmp_path, sets=("x",), cells=4)) == DONE
    assert (
        bench(RulesBenchmark(**files, output_dir=tmp_path, sets=("x", "roll"), parts=(8,), pixels=1, gaussians=5))
        == DONE
    )
    printed = capsys.readouterr().out
    assert printed.count("every Gaussian in every cell") == 1 and printed.count("MATRIXINV, sorting") == 2
    for name, count in (("plan", 3), ("rules", 10)):
        with open(tmp_path / f"{name}.csv", newline="") as stream:
            assert len(list(csv.DictReader(stream))) == count
        assert (tmp_path / f"{name}.md").read_text().startswith("# ")


def test_tables_in_the_papers_shape(blobs, tmp_path: Path) -> None:
    options = Tightness(
        (blobs.config,), blobs.path, tmp_path, sets=("x", "opacity"), seconds=2.0, target_ratio=1.2, downscale_factor=2
    )
    assert bench(options) == DONE
    for number, name in ((2, "x"), (6, "opacity")):
        with open(tmp_path / f"table-{number}.csv", newline="") as stream:
            ours, *others = csv.DictReader(stream)
        assert ours["by"] == "ns-abstract" and ours["Dim"] == name and {row["by"] for row in others} == {"paper"}
        assert 0.0 < float(ours["empirical MPG"]) <= float(ours["MPG"]) <= float(ours["XPG"])
        # a table's ratio is that of its own columns
        for row in others:
            ratio = float(row["MPG"]) / float(row["empirical MPG"])
            assert float(row["MPG / empirical"]) == pytest.approx(ratio, rel=1e-12)
    assert paper_tables.TABLES[2][0]["MPG"] == 0.51


@pytest.mark.parametrize("count", [5, 40, 130])
def test_resampled_scenes_cover_as_much(job: PathJob, count: int) -> None:
    scene = splat_of(job).scene
    found = scale.resampled(scene, count)
    assert found.count == count

    def area(some) -> float:
        return float(np.exp(2.0 * some.log_scales.astype(np.float64)).mean()) * some.count

    chosen = scale.resampled(replace(scene, log_scales=np.zeros_like(scene.log_scales)), count)
    assert area(chosen) == pytest.approx(scene.count, rel=1e-5)
    if count <= scene.count:
        # a part of the stored means, otherwise new ones near them
        assert {tuple(m) for m in found.means} <= {tuple(m) for m in scene.means}


@pytest.mark.slow
def test_cost_by_scale(blobs, tmp_path: Path) -> None:
    options = ScaleBenchmark(
        (blobs.config,), blobs.path, tmp_path, gaussians=(10, 60), widths=(24,), repeats=1, seconds=1.0
    )
    assert bench(options) == DONE
    with open(tmp_path / "scale.csv", newline="") as stream:
        small, large = csv.DictReader(stream)
    assert small["Gaussians"] == "10" and small["ratio"] == "" and float(large["ratio"]) >= 1.0
    assert 0.0 < float(large["peak GiB"]) < 4.0 and (tmp_path / "scale.png").stat().st_size > 10_000


def test_scale_needs_one_run(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="found 0 runs"):
        bench(ScaleBenchmark(output_dir=tmp_path))


@pytest.mark.parametrize(("label", "verdict"), [(0, "certified"), (1, "falsified")])
def test_certified_fraction_of_a_network_that_always_says_the_same(
    blobs, tmp_path: Path, label: int, verdict: str
) -> None:
    net = linear(tmp_path / "net.onnx", np.zeros((2, 3 * 16 * 16)), np.array([1.0, -1.0]), 16)
    prop = tmp_path / "property.json"
    prop.write_text(json.dumps({"type": "classification", "label": label, "preprocess": {"resize": [16, 16]}}))
    options = Certificates(
        (blobs.config,), blobs.path, tmp_path, model=net, property=prop, sets=("x",), seconds=600.0, workers=1,
        marks=(600.0, 900.0),
    )  # fmt: skip
    assert bench(options) == DONE
    with open(tmp_path / "certificates.csv", newline="") as stream:
        (row,) = csv.DictReader(stream)
    assert float(row[verdict]) == 1.0 and row["at 600 s"] == row["certified"] and "at 900 s" not in row


def test_certified_fraction_against_time(monkeypatch: pytest.MonkeyPatch) -> None:
    points = [CertifyProgress(0.1 * k, 0.0, 0.0, 1.0 - 0.1 * k, 4.0 * k) for k in range(9)]

    def certify(*_: Any, on_progress: Any, **__: Any) -> Any:
        for point in points:
            on_progress(point)
        effort = {"cells_bounded": 20, "worker_seconds": 60.0}
        return SimpleNamespace(
            report={"effort": effort}, parameters=("x",), certified=0.8, falsified=0.05, unknown=0.15, seconds=33.0
        )

    monkeypatch.setattr(loops, "certify", certify)
    monkeypatch.setattr(loops.PoseSet, "from_json", lambda *_, **__: None)
    said: list[str] = []
    any_: Any = None
    row = loops.curve(any_, any_, "x", {}, Path("net.onnx"), any_, 60.0, 2, (3.0, 10.0, 32.0, 40.0), said.append)
    assert [row[f"at {mark} s"] for mark in (3, 10, 32, 40)] == pytest.approx([0.0, 0.2, 0.8, 0.8])
    assert row["worker s / bounded"] == 3.0
    # at 12, 24 seconds, and not at every point
    assert [text.split(",")[0] for text in said] == ["x: searching for 60 s", "x: 12 s", "x: 24 s"]
    assert "certified 30.00%" in said[1]
