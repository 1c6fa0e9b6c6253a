"""The display of progress: fractions that sum to 1, seconds of the budget, and an estimate that never exceeds it."""

from __future__ import annotations

import io
import json
import math
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from certifying import classifier
from conftest import Inputs, environment
from rich.console import Console

import ns_abstract as nsa
from ns_abstract.api import bounding
from ns_abstract.report import progress

CERTIFY = nsa.CertifyProgress(0.2, 0.1, 0.0253, 0.6747, 50.0, elapsed=30.0, total_budget=60.0)
REACH = {
    "both": nsa.ReachProgress(0.6, 0.5, 0.1, 0.3, 9.0, 0.1),
    "safe": nsa.ReachProgress(0.6, None, 0.1, 0.3, 9.0, 0.0),
    "reaches": nsa.ReachProgress(None, 0.2, 0.0, 0.8, 9.0, 0.0),
}


def parts(sentence: str) -> float:
    """Sum of the four parts that a sentence ends with."""
    found = re.search(
        r"certified ([\d.]+) %, falsified ([\d.]+) %, unknown ([\d.]+) %, not examined ([\d.]+) %$", sentence
    )
    assert found, sentence
    return sum(map(float, found.groups()))


def test_parts_sum_to_one() -> None:
    assert parts(CERTIFY.sentence) == pytest.approx(100.0)
    for name, point in REACH.items():
        assert parts(point.sentence) == pytest.approx(100.0), name
        assert point.done == pytest.approx(1.0 - point.open)
    assert REACH["both"].sentence.startswith("safe 60.00 %; reaches: certified 50.00 %")


def test_the_estimate_follows_the_rate_and_stays_within_the_budget() -> None:
    start = SimpleNamespace(done=0.1, sentence="", elapsed=2.0, total_budget=100.0)
    for done, elapsed, text in (
        (0.1, 2.0, "2 of 100 s used, at most 98 s left"),
        # since the start 0.5 of 1 in 10 s: 0.4 takes 8 s
        (0.6, 12.0, "12 of 100 s used, about 8 s left"),
        # at this rate the budget ends first
        (0.11, 50.0, "50 of 100 s used, at most 50 s left"),
        (1.0, 12.0, "12 of 100 s used"),
        (0.11, 130.0, "130 of 100 s used, at most 0 s left"),
    ):
        point = SimpleNamespace(done=done, sentence="", elapsed=elapsed, total_budget=100.0)
        assert progress.time_text(point, start) == text
    endless = SimpleNamespace(done=0.1, sentence="", elapsed=5.0, total_budget=math.inf)
    assert progress.time_text(endless, start) == "5 s used"


def frame_point(**more: Any) -> nsa.Progress:
    values = {"frame": 1, "frames_done": 1, "seconds": 2.0, "budget": 10.0, "cells": 5, "covered": 1.0, "mpg": 0.3,
              "mpg_witness": 0.2, "frames": 4, "target_ratio": 1.25, "elapsed": 9.0, "total_budget": 40.0}  # fmt: skip
    return nsa.Progress(**(values | more))


def test_frames_count_by_time_to_the_target() -> None:
    # ratio - 1 is 0.5, twice the goal: as much time again
    assert frame_point().done == pytest.approx((1 + 0.5) / 4)
    assert frame_point(mpg=0.2).done == pytest.approx(2 / 4)
    # below a whole cover, or for a goal that is never met, the budget counts
    assert frame_point(covered=0.5).done == frame_point(target_ratio=1.0).done == pytest.approx((1 + 0.2) / 4)
    assert "covering the set, 50%" in frame_point(covered=0.5).sentence and "target 1.25" in frame_point().sentence


def test_display_on_a_terminal_in_a_pipe_and_in_a_notebook(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    with nsa.ProgressBar(Console(file=stream, force_terminal=True, width=160)) as bar:
        bar(CERTIFY)
        bar._bar.refresh()
    assert "certified 20.00 %" in stream.getvalue() and "30 of 60 s used" in stream.getvalue()
    pipe, clock = io.StringIO(), iter([0.0, 1.0, 16.0, 16.0, 17.0, *range(18, 40)])
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    with nsa.ProgressBar(Console(file=pipe, width=60)) as bar:
        for _ in range(3):
            bar(CERTIFY)
    # a line every fifteen seconds, not wrapped
    assert pipe.getvalue().count("\n") == 1 and "not examined 67.47 %" in pipe.getvalue()
    monkeypatch.undo()
    shown: list[Any] = []
    handle = SimpleNamespace(update=lambda value, raw: shown.append(value["text/plain"]))
    monkeypatch.setitem(sys.modules, "ipykernel", SimpleNamespace())
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace())
    monkeypatch.setitem(sys.modules, "IPython.display", SimpleNamespace(display=lambda *_, **__: handle))
    with nsa.ProgressBar() as bar:
        bar(frame_point())
    assert shown and "frame 1: ratio to real renders 1.500" in shown[0]


def test_work_tells_what_the_display_needs(blobs: Inputs, tmp_path: Path) -> None:
    scene, camera = nsa.load_scene(blobs.config), nsa.load_camera_path(blobs.path).cameras[0]
    poses, points = nsa.PoseSet(camera, {"x": 0.05}), []
    nsa.bound(scene, poses, target_ratio=1.5, time_budget=30.0, on_progress=points.append)
    assert points and all(p.total_budget == 30.0 and 0.0 <= p.done <= 1.0 for p in points)
    assert [p.elapsed for p in points] == sorted(p.elapsed for p in points)
    assert isinstance(points[-1], bounding.Progress) and points[-1].target_ratio == 1.5
    net, found = classifier(tmp_path / "net.onnx", camera.width), []
    prop = {"type": "classification", "label": 0}
    cert = nsa.certify(scene, poses, net, prop, time_budget=4.0, on_progress=found.append)
    for point in found:
        assert parts(point.sentence) == pytest.approx(100.0, abs=0.02) and point.total_budget == 4.0
    assert cert.certified + cert.falsified + cert.unknown == pytest.approx(1.0)
    assert np.isfinite([point.elapsed for point in found]).all()


SPEAKS = """
import sys, time
from ns_abstract.cli.common import run
from ns_abstract.report.progress import plain_console

def main(options):
    sys.stdin.readline()
    sys.stderr.write("left in the stream")
    try:
        {call}
    except SystemExit:
        raise AssertionError
run(main, lambda: None)
"""


@pytest.mark.parametrize("call", ["plain_console().print('lost')", "print('lost', file=sys.stderr, flush=True)"])
def test_a_reader_that_has_gone_interrupts(call: str) -> None:
    """rich would end the process with code 1, before a report says that the work was interrupted."""
    script = [sys.executable, "-c", SPEAKS.format(call=call)]
    process = subprocess.Popen(script, stdin=subprocess.PIPE, stderr=subprocess.PIPE, env=environment(), text=True)
    assert process.stderr is not None and process.stdin is not None
    process.stderr.close()
    process.stdin.write("\n")
    process.stdin.close()
    assert process.wait(timeout=60) == 3


@pytest.mark.slow
def test_a_report_says_that_its_reader_has_gone(blobs: Inputs, tmp_path: Path) -> None:
    options = map(str, blobs.options(tmp_path, time_budget=60))
    script = [sys.executable, "-c", "from ns_abstract.cli.render import main; main()", *options]
    process = subprocess.Popen(script, stderr=subprocess.PIPE, env=environment())
    assert process.stderr is not None
    process.stderr.close()
    assert process.wait(timeout=120) == 3
    assert json.loads((tmp_path / "report.json").read_text())["state"] == "interrupted"
