"""Results of another version, or of other rules, are refused wherever they could be taken for results of this one."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from certifying import classifier
from conftest import InProcess, Inputs

import ns_abstract as nsa
from ns_abstract.api import certification, job, loop_job
from ns_abstract.api.bounding import TileTask, bound_part
from ns_abstract.api.certification import CertifySettings, open_certification
from ns_abstract.api.files import Settings, open_job
from ns_abstract.api.reaching import open_loop
from ns_abstract.cli import export as export_command
from ns_abstract.cli import render as render_command
from ns_abstract.demo.writing import write_loop_demo
from ns_abstract.execution import worker_cache
from ns_abstract.io import version
from ns_abstract.io.atomic import write_json
from ns_abstract.io.errors import InputError
from ns_abstract.io.version import computed_by, stale
from ns_abstract.refine.result import FrameResult, TracePoint
from ns_abstract.report.files import save_frame
from ns_abstract.report.record import Report, RunRecord
from ns_abstract.verify.store import Store

Prints = dict[str, Any]
#: Fingerprints as other versions leave them.
OTHERS: dict[str, Callable[[Prints], Prints]] = {
    "before versions were written": lambda now: {k: v for k, v in now.items() if k not in computed_by()},
    "an earlier version": lambda now: now | {"ns_abstract": "0.1.9"},
    "a later version": lambda now: now | {"ns_abstract": "9.0.0"},
    "other rules for images": lambda now: now | {"render_rules": now["render_rules"] - 1},
}
others = pytest.mark.parametrize("name", OTHERS)


def result(opened: Any, index: int = 0) -> FrameResult:
    """A frame with bounds that say little, without the work."""
    camera, box = opened.pose_sets[index].camera, opened.pose_sets[index].box
    image = np.full((camera.height, camera.width, 3), 0.5, np.float32)
    low, high = image - np.float32(0.125), image + np.float32(0.125)
    return FrameResult(index, box, low, high, low, high, image, 1.0, 1, (TracePoint(1.0, 1, 0.1, 0.1),))


def write_results(blobs: Inputs, folder: Path, change: Callable[[Prints], Prints] = dict) -> Prints:
    """What ns-abstract-render leaves with a changed fingerprint; returns the unchanged one."""
    opened = open_job(Settings(blobs.config, blobs.path, blobs.spec))
    run = RunRecord(
        guarantee="float32-sound", renderer=opened.method.program, scene=opened.describe(), frames=(0,),
        fingerprint=change(opened.fingerprint), settings={"target_ratio": 1.05},
    )  # fmt: skip
    report = Report(folder, run)
    report.add(result(opened), "done")
    report.finish("done")
    return opened.fingerprint


def refused(code: int, text: str, *fragments: str) -> None:
    assert code == 2 and text.count("\n") == 1 and text.startswith("error: "), text
    for fragment in (*fragments, f"ns-abstract {nsa.__version__}", "docs/advisories.md"):
        assert fragment in text, text


def record_of(fingerprint: dict[str, Any]) -> RunRecord:
    return RunRecord(
        guarantee="float32-sound", renderer={"name": "gsplat", "version": "1.4.0"}, scene={}, frames=(0,),
        fingerprint=fingerprint, settings={"target_ratio": 1.05},
    )  # fmt: skip


def test_fingerprints_name_version_and_rules(blobs: Inputs, tmp_path: Path) -> None:
    net = classifier(tmp_path / "net.onnx")
    prop = write_json(
        tmp_path / "prop.json", {"type": "classification", "label": 0, "preprocess": {"resize": [16, 16]}}
    )
    rendered = open_job(Settings(blobs.config, blobs.path, blobs.spec)).fingerprint
    certified = open_certification(
        CertifySettings(Settings(blobs.config, blobs.path, blobs.spec), net, prop)
    ).fingerprint
    config, loop = write_loop_demo(tmp_path / "loop")
    reached = open_loop(nsa.load_scene(config), loop).fingerprint
    assert rendered["ns_abstract"] == nsa.__version__
    for found in (rendered, certified, reached):
        assert found["ns_abstract"] == nsa.__version__ and found["render_rules"] == version.RENDER_RULES >= 1
    assert "rules" not in rendered
    # 4 and 1 are those of searches that 0.1.0 left
    assert certified["rules"] == certification._RULES > 4 and reached["rules"] == loop_job._RULES > 1


def test_fingerprint_of_images_and_numbers_of_rules(blobs: Inputs) -> None:
    found = open_job(Settings(blobs.config, blobs.path, blobs.spec)).fingerprint
    assert {key: found.get(key) for key in computed_by()} == computed_by()
    assert certification._RULES > 4 and loop_job._RULES > 1


@pytest.mark.slow
@others
def test_render_is_not_resumed(name: str, blobs: Inputs, tmp_path: Path, in_process: InProcess) -> None:
    write_results(blobs, tmp_path / "out", OTHERS[name])
    options = [*blobs.options(tmp_path / "out", time_budget=5, target_ratio=1.5, frames=0), "--resume"]
    before = (tmp_path / "out" / "report.json").read_bytes()
    code, _, text = in_process(render_command.main, options)
    refused(code, text, "--resume", "leave it out")
    assert (tmp_path / "out" / "report.json").read_bytes() == before


def test_frame_of_another_version_is_not_kept(blobs: Inputs, tmp_path: Path) -> None:
    now = write_results(blobs, tmp_path, OTHERS["an earlier version"])
    # the report claims what its frame file does not
    document = json.loads((tmp_path / "report.json").read_text())
    (tmp_path / "report.json").write_text(json.dumps(document | {"fingerprint": now}))
    run = record_of(now)
    report = Report(tmp_path, run, keep_stored=True)
    assert report.kept == [] and "ns-abstract 0.1.9" in report.ignored[0]


def test_same_version_is_resumed_and_exported(blobs: Inputs, tmp_path: Path, in_process: InProcess) -> None:
    write_results(blobs, tmp_path / "out")
    export = ["npz", "--input-dir", str(tmp_path / "out"), "--output-filename", str(tmp_path / "all.npz")]
    assert in_process(export_command.main, export)[0] == 0
    now = open_job(Settings(blobs.config, blobs.path, blobs.spec)).fingerprint
    run = record_of(now)
    assert Report(tmp_path / "out", run, keep_stored=True).kept == [0]


@pytest.mark.slow_cases
@others
@pytest.mark.parametrize("kind", ["npz", "png"])
def test_results_are_not_exported(kind: str, name: str, blobs: Inputs, tmp_path: Path, in_process: InProcess) -> None:
    write_results(blobs, tmp_path / "out", OTHERS[name])
    target = ["--output-filename", str(tmp_path / "x.npz")] if kind == "npz" else ["--output-dir", str(tmp_path / "x")]
    code, _, text = in_process(export_command.main, [kind, "--input-dir", str(tmp_path / "out"), *target])
    refused(code, text, "frame_00000.npz", "ns-abstract-render")


def test_frames_that_do_not_say_are_not_exported(blobs: Inputs, tmp_path: Path, in_process: InProcess) -> None:
    opened = open_job(Settings(blobs.config, blobs.path, blobs.spec))
    for about in ({}, {"fingerprint": []}, {"fingerprint": {"ns_abstract": "\x1b[31m", "render_rules": "1"}}):
        save_frame(tmp_path / "frame_00000.npz", result(opened), about=about)
        options = ["npz", "--input-dir", str(tmp_path), "--output-filename", str(tmp_path / "all.npz")]
        code, _, text = in_process(export_command.main, options)
        refused(code, text)
        assert "\x1b" not in text


def test_saved_result_says_what_computed_it(
    blobs: Inputs, tmp_path: Path, in_process: InProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = nsa.load_scene(blobs.config)
    path = nsa.load_camera_path(blobs.path)
    poses = nsa.PoseSet(path.cameras[0], {"x": 0.01})
    nsa.bound(scene, poses, time_budget=5.0, target_ratio=3.0).save(tmp_path / "frame_00000.npz")
    options = ["npz", "--input-dir", str(tmp_path), "--output-filename", str(tmp_path / "all.npz")]
    assert in_process(export_command.main, options)[0] == 0
    monkeypatch.setattr(version, "RENDER_RULES", version.RENDER_RULES + 1)
    code, _, text = in_process(export_command.main, options)
    refused(code, text)


@pytest.mark.parametrize("name", [*OTHERS, "other rules of the search"])
def test_search_is_not_resumed(name: str, tmp_path: Path) -> None:
    change = OTHERS.get(name, lambda now: now | {"rules": now["rules"] - 1})
    now = {**computed_by(), "scene": "a", "rules": 5}
    Store(tmp_path, change(now), [("x", "m")], {0: {}}, resume=False).close()
    with pytest.raises(InputError) as caught:
        Store(tmp_path, now, [("x", "m")], {0: {}}, resume=True)
    refused(2, f"error: {caught.value}\n", "--resume", "cells.sqlite", "leave it out")
    # without --resume it is replaced
    Store(tmp_path, now, [("x", "m")], {0: {}}, resume=False).close()
    Store(tmp_path, now, [("x", "m")], {0: {}}, resume=True).close()


def test_searches_of_other_commands_are_not_taken_for_older_ones(tmp_path: Path) -> None:
    """Commands number their rules each for itself."""
    other = {**computed_by(), "scene": "a", "photo": "b", "rules": 9}
    Store(tmp_path, other, [("x", "m")], {0: {}}, resume=False).close()
    with pytest.raises(InputError, match="another photo, rules, loop") as caught:
        Store(tmp_path, {**computed_by(), "scene": "a", "loop": "c", "rules": 4}, [("x", "m")], {0: {}}, resume=True)
    assert version.ADVISORY not in str(caught.value)


def test_worker_of_another_version_is_refused(blobs: Inputs, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command's work reaches a process that has another version, which never opens the files."""
    opened = open_job(Settings(blobs.config, blobs.path, blobs.spec))
    recipe, goal = opened.recipe, opened.goal(1.5, 1.0, 2)
    worker_cache.clear_cache()

    def opens(*arguments: Any) -> None:
        raise AssertionError("files are opened")

    monkeypatch.setattr(worker_cache, "VERSION", "9.0.0")
    monkeypatch.setattr(job.Scene, "__init__", opens)
    with pytest.raises(InputError, match=rf"runs ns-abstract 9\.0\.0.*{re.escape(nsa.__version__)}.*same version"):
        bound_part(recipe, TileTask(0, None), goal, False)


@pytest.mark.parametrize("which", ["render", "certify"])
def test_worker_with_other_rules_is_refused(
    which: str, blobs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if which == "render":
        recipe: Any = open_job(Settings(blobs.config, blobs.path, blobs.spec)).recipe
        monkeypatch.setattr(version, "RENDER_RULES", version.RENDER_RULES - 1)
    else:
        net = classifier(tmp_path / "net.onnx")
        value = {"type": "classification", "label": 0, "preprocess": {"resize": [16, 16]}}
        prop = write_json(tmp_path / "prop.json", value)
        recipe = open_certification(CertifySettings(Settings(blobs.config, blobs.path, blobs.spec), net, prop)).recipe
        monkeypatch.setattr(certification, "_RULES", certification._RULES - 1)
    worker_cache.clear_cache()
    with pytest.raises(InputError, match=r"worker's results would be computed by.*same version on all machines"):
        worker_cache.load(recipe)
    worker_cache.clear_cache()


def test_what_is_compared() -> None:
    now = {**computed_by(), "rules": 5}
    assert stale(now, now) is None and stale(now | {"scene": "b"}, now) is None
    # a fingerprint that names no rules is compared by the rest
    assert stale(now, computed_by()) is None
    for key in now:
        assert stale({k: v for k, v in now.items() if k != key}, now) is not None
    assert "0.1.9 (render rules 1, rules 4)" in (
        stale({"ns_abstract": "0.1.9", "render_rules": 1, "rules": 4}, now) or ""
    )


ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.skipif(not (ROOT / "docs").is_dir(), reason="the documentation is not beside the tests")
def test_advisories_name_this_version() -> None:
    page = (ROOT / "docs" / "advisories.md").read_text(encoding="utf-8")
    numbers = version.RENDER_RULES, certification._RULES, loop_job._RULES
    assert f"| {nsa.__version__} | {' | '.join(map(str, numbers))} |" in page
    assert "advisories.md" in (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    assert "(advisories.md)" in (ROOT / "docs" / "guarantee.md").read_text(encoding="utf-8")
