"""Kernels compiled by several processes at first use."""

from __future__ import annotations

import logging
import multiprocessing
import os
import re
import subprocess
import sys
import time
from multiprocessing import Pipe
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import Inputs

from ns_abstract.api import compiling
from ns_abstract.api import job as job_module
from ns_abstract.api.files import Settings, open_job
from ns_abstract.arithmetic import kernel_cache
from ns_abstract.arithmetic.kernel_cache import SESSION, KernelMissingError, store
from ns_abstract.cli.common import show_log
from ns_abstract.methods.nerf.frame import NerfFrame
from ns_abstract.methods.nerf.hash_bounds.bounds import NerfactoFrame
from ns_abstract.methods.splat.bounds import Stages


def test_stages_are_shared_out() -> None:
    stages = ("slow", "middle", "quick")
    assert compiling.shares(stages, 1) == [["slow", "middle", "quick"]]
    assert compiling.shares(stages, 2) == [["slow"], ["middle", "quick"]]
    assert compiling.shares(stages, 3) == compiling.shares(stages, 64) == [["slow"], ["middle"], ["quick"]]


def test_one_stage_alone_is_run_and_the_others_come_back(blobs: Inputs, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each stage is called with what it is called with otherwise, and afterwards bounds are what they were."""
    frame: Any = open_job(Settings(blobs.config, blobs.path, blobs.spec)).frame(0)
    tiles = np.arange(frame.tile_count)
    before = frame.bound(frame.box, tiles)
    kernels = frame.bounds.stages
    seen: dict[str, list[list[Any]]] = {name: [] for name in Stages._fields}

    def types(arguments: tuple[Any, ...]) -> list[Any]:
        import numba

        return [numba.typeof(argument) for argument in arguments]

    def spy(name: str) -> Any:
        def kernel(*arguments: Any) -> Any:
            seen[name].append(types(arguments))
            return getattr(kernels, name)(*arguments)

        return kernel

    frame.bounds.stages = spies = Stages(*map(spy, Stages._fields))
    assert set(Stages._fields) | {"render"} == set(frame.stages)
    frame.warm_up()
    assert all(len(calls) == 1 for calls in seen.values())
    for name in frame.stages:
        frame.warm_up(name)
        assert [len(calls) for calls in seen.values()] == [
            2 if other in frame.stages[: frame.stages.index(name) + 1] else 1 for other in Stages._fields
        ]
        # so that what was compiled is what will be used
        assert name not in seen or seen[name][0] == seen[name][1]
    assert frame.bounds.stages is spies
    monkeypatch.setattr(frame, "bound", lambda *_: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        frame.warm_up("pixel_stage")
    assert frame.bounds.stages is spies
    monkeypatch.undo()
    frame.bounds.stages = kernels
    after = frame.bound(frame.box, tiles)
    np.testing.assert_array_equal(before.lower, after.lower)
    np.testing.assert_array_equal(before.upper, after.upper)


def test_no_stage_is_missing_after_all_were_compiled(blobs: Inputs) -> None:
    frame: Any = open_job(Settings(blobs.config, blobs.path, blobs.spec)).frame(0)
    frame.warm_up()
    assert compiling.missing(frame) == []


def test_stages_are_missing_whose_kernels_are_not_kept() -> None:
    """Whatever else is kept: other commands leave kernels of their own."""

    def warm_up(stage: str) -> None:
        assert store()._complete
        if stage in ("pixel_stage", "render"):
            raise KernelMissingError(stage)

    frame: Any = SimpleNamespace(stages=("pixel_stage", "gaussian_stage", "render"), warm_up=warm_up)
    assert compiling.missing(frame) == ["pixel_stage", "render"] and not store()._complete


def test_nothing_is_started_where_kernels_are(blobs: Inputs, monkeypatch: pytest.MonkeyPatch) -> None:
    job = open_job(Settings(blobs.config, blobs.path, blobs.spec))
    monkeypatch.setattr(compiling.subprocess, "Popen", lambda *a, **k: pytest.fail("a process was started"))
    monkeypatch.setattr(compiling, "missing", lambda frame: [])
    compiling.compile_beside(job, 0, 3)
    monkeypatch.setattr(compiling, "missing", lambda frame: ["render"])
    compiling.compile_beside(job, 0, 3)
    monkeypatch.setattr(compiling, "missing", lambda frame: list(frame.stages))
    compiling.compile_beside(job, 0, 1)
    with pytest.raises(pytest.fail.Exception):
        compiling.compile_beside(job, 0, 2)


def test_processes_that_fail_leave_the_work_to_this_one(blobs: Inputs, monkeypatch: pytest.MonkeyPatch) -> None:
    job = open_job(Settings(blobs.config, blobs.path, blobs.spec))
    started: list[list[str]] = []
    monkeypatch.setattr(compiling, "missing", lambda frame: list(frame.stages))
    popen = subprocess.Popen

    def failing(command: list[str], **more: Any) -> Any:
        started.append(command[4:])
        assert more["env"][SESSION] == str(store().session)
        return popen([sys.executable, "-c", "raise SystemExit(3)"], **more)

    monkeypatch.setattr(compiling.subprocess, "Popen", failing)
    compiling.compile_beside(job, 0, 2)
    assert started == [["pixel_stage"], ["gaussian_stage", "moving_colors", "render"]]

    waiting: list[Any] = []
    ends: list[Any] = []

    def one_only(command: list[str], **more: Any) -> Any:
        if waiting:
            raise OSError("no more processes")
        waiting.append(popen([sys.executable, "-c", "import time; time.sleep(600)"], **more))
        return waiting[0]

    def pipe() -> Any:
        ends.extend(both := multiprocessing.Pipe())
        return both

    monkeypatch.setattr(compiling.subprocess, "Popen", one_only)
    monkeypatch.setattr(compiling, "Pipe", pipe)
    # what no process compiles is compiled here later: nothing is raised, and nothing is left behind
    compiling.compile_beside(job, 0, 2)
    assert len(waiting) == 1 and waiting[0].poll() is not None
    assert len(ends) == 4 and all(end.closed for end in ends)


_BUSY = """
import sys, time
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace
line = Connection(int(sys.argv[1]))
line.recv()
line.send(7)
while not Path(sys.argv[2]).exists():
    time.sleep(0.05)
"""


@pytest.mark.slow
def test_what_is_compiled_is_told_where_there_is_no_terminal(
    blobs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A line with two counts and the seconds left, at once and every few seconds."""
    job = open_job(Settings(blobs.config, blobs.path, blobs.spec))
    popen, told = subprocess.Popen, logging.getLogger("ns_abstract.kernels")
    wanted = "compiling kernels (first use only): 14 of "

    def seen(record: logging.LogRecord) -> bool:
        # both processes work until it was said
        if record.getMessage().startswith(wanted):
            (tmp_path / "said").touch()
        return True

    def busy(command: list[str], **more: Any) -> Any:
        return popen([sys.executable, "-c", _BUSY, command[3], str(tmp_path / "said")], **more)

    monkeypatch.setattr(compiling, "missing", lambda frame: list(frame.stages))
    monkeypatch.setattr(compiling.subprocess, "Popen", busy)
    monkeypatch.setattr(compiling, "_PACE", 0.0)
    monkeypatch.setattr(logging.getLogger("ns_abstract"), "handlers", [])
    level = told.level
    told.setLevel(logging.INFO)
    told.addFilter(seen)
    try:
        show_log()
        compiling.compile_beside(job, 0, 2)
    finally:
        told.removeFilter(seen)
        told.setLevel(level)
    said = capsys.readouterr().err.splitlines()
    pattern = r"compiling kernels \(first use only\): (\d+) of (\d+) functions, about \d+ s left"
    counts = [match.groups() if (match := re.fullmatch(pattern, line)) else None for line in said]
    # before anything is done, too; the whole is the same in every line
    assert counts[0] is not None and counts[0][0] == "0" and int(counts[0][1]) > 14
    assert all(pair is not None and pair[1] == counts[0][1] for pair in counts)
    assert any(line.startswith(wanted) for line in said)


def test_what_is_left_of_compiling_is_estimated_by_what_is_done_where_it_takes_long(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    begin = time.monotonic()
    progress = compiling._progress([["pixel_stage"]])
    monkeypatch.setattr(time, "monotonic", lambda: begin + 2.0 * progress.seconds)
    (left,) = re.findall(r"about (\d+) s left", progress.line(progress.functions // 10))
    assert int(left) > 10 * progress.seconds


def test_what_is_compiled_without_stages_is_told_of_all(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Kernels of a NeRF are compiled in one piece: from the first one on it is told how many there are, about."""

    def warm_up() -> None:
        for _ in range(3):
            store().function_done()

    rays: Any = SimpleNamespace(tilewise=False, compiled=(84, 40.0), warm_up=warm_up)
    monkeypatch.setattr(kernel_cache, "_PACE", -1.0)
    monkeypatch.setattr(logging.getLogger("ns_abstract"), "propagate", True)
    with caplog.at_level(logging.INFO, "ns_abstract.kernels"):
        job_module.warm_up(rays)
        store().function_done()
    counts = re.findall(r"(\d+) of (\d+) functions, about \d+ s left", caplog.text)
    assert list(dict.fromkeys(counts)) == [("1", "84"), ("2", "84"), ("3", "84")] and "functions done: " in caplog.text


@pytest.mark.parametrize("frame", [NerfFrame, NerfactoFrame])
def test_frames_without_stages_say_how_much_they_compile(frame: type[NerfFrame] | type[NerfactoFrame]) -> None:
    assert not frame.stages and frame.compiled[0] > 50 and frame.compiled[1] > 10.0


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["moving_colors", "no_stage"])
def test_a_worker_runs_the_stages_of_its_command_line(blobs: Inputs, stage: str) -> None:
    """A process of its own opens the job anew; kernels are there, so nothing is compiled. Another stage ends it."""
    job = open_job(Settings(blobs.config, blobs.path, blobs.spec))
    job.warm_up(0)
    here, there = Pipe()
    with there:
        worker = subprocess.Popen(
            [sys.executable, "-m", "ns_abstract.api.compiling", str(there.fileno()), stage],
            pass_fds=[there.fileno()], stderr=subprocess.PIPE, cwd=Path(compiling.__file__).parents[2],
            env=os.environ | {SESSION: str(store().session)},
        )  # fmt: skip
    with here:
        here.send((job.recipe, 0))
        _, said = worker.communicate()
    ran = worker.returncode == 0
    assert ran == (stage in job.frame(0).stages) and (ran or "no_stage" in said.decode()), said.decode()


@pytest.mark.slow
def test_worker_ends_with_the_one_that_started_it() -> None:
    here, there = Pipe()
    with there:
        command = (
            "from multiprocessing.connection import Connection; from ns_abstract.api import compiling; "
            f"compiling._watch(Connection({there.fileno()}))"
        )
        worker = subprocess.Popen(
            [sys.executable, "-c", command], pass_fds=[there.fileno()], cwd=Path(compiling.__file__).parents[2]
        )
    assert here.recv() >= 0
    here.close()
    assert worker.wait() == 1
