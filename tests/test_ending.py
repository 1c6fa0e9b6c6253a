"""Work that is given up: at checkpoints, on signals, and with the process that asked for it."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Inputs
from nerfs import UNIFORM, images, poses, tiny_scene
from test_cli import call, environment, one_line  # noqa: F401

from ns_abstract.cli import certify as certify_command
from ns_abstract.cli import render as render_command
from ns_abstract.cli.common import Stop, run
from ns_abstract.execution.ending import AbandonedError, abandoning, checkpoint
from ns_abstract.execution.engines import Processes
from ns_abstract.methods.nerf.bounds import NerfBounds
from ns_abstract.methods.nerf.frame import NerfFrame
from ns_abstract.refine.engine import Goal, Refinement
from ns_abstract.verify.cells import Grid

YAW = {"rotation": {"yaw": 0.02}}
#: Long enough for any machine; what is waited for does not come by itself.
LONG = 300.0


class After:
    """True from the ``count``-th time on that it is asked."""

    def __init__(self, count: int) -> None:
        self.left = count

    def __call__(self) -> bool:
        self.left -= 1
        return self.left < 0


# ---------------------------------------------------------------- checkpoints


def test_checkpoints_end_what_is_over() -> None:
    checkpoint()
    with abandoning(After(2)):
        checkpoint()
        with abandoning(lambda: False):
            checkpoint()
        checkpoint()
        with pytest.raises(AbandonedError):
            checkpoint()
    checkpoint()


@pytest.mark.parametrize("kind", ["uniform", "hierarchical"])
@pytest.mark.parametrize("asked", [0, 3, 12])
def test_rays_without_time_are_left_open(kind: Any, asked: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """One ray is too large a unit of work: a request is looked at between the cells of its samples."""
    from dataclasses import replace

    sampling = replace(UNIFORM, kind=kind, importance=8 if kind == "hierarchical" else 0)
    scene, pose_set = tiny_scene(0), poses(YAW)
    frame = NerfFrame(scene, sampling, pose_set)
    part = pose_set.box.split(0)[0]
    rays: list[int] = []
    bound = NerfBounds.rays
    monkeypatch.setattr(NerfBounds, "rays", lambda self, *rest: rays.append(1) or bound(self, *rest))
    frame.tiles_at_once = 1
    with abandoning(After(asked)):
        found = frame.bound(part, np.arange(12))
    assert sum(rays) <= asked + 1
    assert found.lower.shape == (12, 1, 1, 3) and (found.lower[-1] == 0.0).all() and (found.upper[-1] == 1.0).all()
    pictures = images(scene, pose_set, part.sample(5, np.random.default_rng(3)), sampling)[:, :, None, None]
    assert (found.lower <= pictures).all() and (pictures <= found.upper).all()
    # narrower than nothing for those that were done
    whole = frame.bound(part, np.arange(12))
    assert kind == "hierarchical" or (whole.upper - whole.lower).max() < 1.0


def test_one_ray_is_given_up_inside(monkeypatch: pytest.MonkeyPatch) -> None:
    frame = NerfFrame(tiny_scene(0), UNIFORM, poses(YAW))
    steps: list[int] = []
    step = frame.bounds.field.base
    monkeypatch.setattr(frame.bounds.field, "base", lambda *rest: steps.append(1) or step(*rest))
    arguments = frame._geometry, poses(YAW).box, frame._pixels(np.arange(1)), 1e-3
    frame.bounds.rays(*arguments)
    assert len(steps) >= 4
    steps.clear()
    with abandoning(lambda: len(steps) >= 2), pytest.raises(AbandonedError):
        frame.bounds.rays(*arguments)
    assert len(steps) == 2


@pytest.mark.parametrize("count", [0, 1, 5, 40, 200])
def test_refinement_ends_soundly_wherever_it_is_stopped(count: int) -> None:
    scene, pose_set = tiny_scene(0), poses(YAW)
    frame: Any = NerfFrame(scene, UNIFORM, pose_set)
    refinement = Refinement(frame, 0, Goal(1.0, LONG, 60), keep_leaves=True, stopped=After(count))
    try:
        result = refinement.run()
    except AbandonedError:
        assert count < 40
        return
    pictures = images(scene, pose_set, pose_set.box.sample(9, np.random.default_rng(1))).reshape(9, 3, 4, 3)
    assert (result.lower <= pictures).all() and (pictures <= result.upper).all()
    leaves = result.leaves
    if leaves is not None:
        width = leaves.box_upper - leaves.box_lower
        for tile in np.unique(leaves.tile, axis=0):
            mine = (leaves.tile == tile).all(axis=1)
            assert width[mine].sum() == pytest.approx(0.04)


def count_checkpoints(file: str) -> int:
    """Works until it is asked to end."""
    Path(file).touch()
    count = 0
    while True:
        checkpoint()
        count += 1
        time.sleep(0.01)


def square(number: int) -> int:
    return number * number


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + LONG
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_workers_are_asked_to_end_and_work_on(tmp_path: Path) -> None:
    engine = Processes(1)
    try:
        engine.submit(0, count_checkpoints, str(tmp_path / "begun"))
        engine.submit(1, square, 3)
        wait_for((tmp_path / "begun").exists)
        (pid,) = engine.pids
        engine.abandon()
        found: list[tuple[int, Any]] = []
        while engine.unfinished:
            found += engine.collect(1.0)
        assert [key for key, _ in found] == [0] and isinstance(found[0][1], AbandonedError)
        engine.submit(2, square, 4)
        while engine.unfinished:
            found += engine.collect(1.0)
        assert found[1:] == [(2, 16)] and engine.pids == [pid]
    finally:
        engine.close()


PARENT = """
import sys, time
from pathlib import Path
from ns_abstract.execution.engines import Processes
from test_ending import count_checkpoints
if __name__ == "__main__":
    engine = Processes(2)
    for k in range(2):
        engine.submit(k, count_checkpoints, sys.argv[1] + str(k))
    print(*engine.pids, flush=True)
    time.sleep(600)
"""


def alive(pid: int) -> bool:
    try:
        # a process that nobody has waited for is not alive
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_workers_end_with_a_killed_parent(tmp_path: Path) -> None:
    """Also in the middle of a task that looks at nothing."""
    (tmp_path / "parent.py").write_text(PARENT)
    variables = environment()
    variables["PYTHONPATH"] += os.pathsep + str(Path(__file__).parent)
    process = subprocess.Popen(
        [sys.executable, str(tmp_path / "parent.py"), str(tmp_path / "begun")],
        stdout=subprocess.PIPE, text=True, env=variables,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        pids = [int(word) for word in process.stdout.readline().split()]
        wait_for(lambda: all((tmp_path / f"begun{k}").exists() for k in range(2)))
        assert len(pids) == 2 and all(map(alive, pids))
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    wait_for(lambda: not any(map(alive, pids)))


# ---------------------------------------------------------------- signals


def test_a_signal_ends_at_once_where_nothing_is_to_be_saved() -> None:
    stop = Stop()
    with stop.installed():
        with pytest.raises(KeyboardInterrupt), stop.at_once():
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(LONG)
        assert stop()
        with pytest.raises(KeyboardInterrupt), stop.at_once():
            raise AssertionError("the request had come before")
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


def test_a_signal_is_noted_where_something_is(capsys: pytest.CaptureFixture[str]) -> None:
    stop = Stop()
    with stop.installed():
        os.kill(os.getpid(), signal.SIGINT)
        assert stop() and "being saved" in capsys.readouterr().err
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)


def test_a_signal_ends_a_library_call() -> None:
    """Nothing runs between two lines of Python while a kernel is compiled."""
    code = """
import ctypes
from ns_abstract.cli.common import Stop
library, mutex = ctypes.CDLL(None), ctypes.create_string_buffer(256)
library.pthread_mutex_lock(mutex)
with Stop().installed():
    print("ready", flush=True)
    # goes on after signals, without Python in between
    library.pthread_mutex_lock(mutex)
"""
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment()
    )
    try:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
        time.sleep(0.5)
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate(timeout=LONG)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 3 and said == "interrupted\n"


# ---------------------------------------------------------------- memory and options


@pytest.mark.parametrize(
    "error",
    [
        MemoryError("Unable to allocate 9 GiB"),
        RuntimeError(
            "[enforce fail at alloc_cpu.cpp:118] err == 0. DefaultCPUAllocator: can't allocate memory: 9 bytes"
        ),
        ImportError("failed to map segment from shared object: Cannot allocate memory"),
        RuntimeError("std::bad_alloc"),
    ],
)
@pytest.mark.parametrize("relief", ["give fewer --workers", "raise --downscale-factor"])
def test_lack_of_memory_is_one_line(
    error: Exception, relief: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(options: object) -> int:
        raise error

    monkeypatch.setattr(sys, "argv", ["command"])
    with pytest.raises(SystemExit) as leave:
        run(fail, lambda: None, relief)
    one_line(leave.value.code, capsys.readouterr().err, "not enough memory", relief)  # type: ignore[arg-type]


def test_other_errors_are_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(options: object) -> int:
        raise RuntimeError("a fault")

    monkeypatch.setattr(sys, "argv", ["command"])
    with pytest.raises(RuntimeError, match="a fault"):
        run(fail, lambda: None)


def test_a_certificate_has_no_downscale_factor(
    call: Callable[..., tuple[int, str]],  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    def fail(options: object) -> int:
        raise MemoryError

    monkeypatch.setattr(certify_command, "certify", fail)
    names = ("load-config", "camera-path-filename", "model", "property", "output-dir")
    code, said = call([word for name in names for word in (f"--{name}", "x")], certify_command.main)
    one_line(code, said, "not enough memory", "--workers")
    assert "downscale" not in said


@pytest.mark.parametrize("limit", [0.5, 1.0, 2.0])
def test_a_small_address_space_is_one_line(limit: float, blobs: Inputs, tmp_path: Path) -> None:
    most = int(limit * 2**30)
    done = subprocess.run(
        [sys.executable, "-m", "ns_abstract.cli.render", *blobs.options(tmp_path / "out")],
        capture_output=True, text=True, env=environment(), check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (most, most)),
    )  # fmt: skip
    one_line(done.returncode, done.stderr, "address space", "ulimit -v")


@pytest.mark.parametrize("words", [["--output-dir", ""], ["--output-dir="], [""]])
def test_empty_options_are_refused(
    words: list[str],
    call: Callable[..., tuple[int, str]],  # noqa: F811
    blobs: Inputs,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    one_line(*call([*blobs.options(tmp_path / "out"), *words], render_command.main), "is empty")
    assert not os.listdir(tmp_path)


def test_a_limit_beyond_all_memory_is_none(blobs: Inputs) -> None:
    from ns_abstract.api.files import Settings, open_job

    job = open_job(Settings(blobs.config, blobs.path, blobs.spec, memory_limit=1e300))
    assert job.memory == 2**50


# ---------------------------------------------------------------- early results


def test_first_blocks_are_small_and_hold_every_cell() -> None:
    from ns_abstract.api.certification import Certification

    box = poses(YAW).box
    for cells in (1, 2, 5, 8, 19, 33):
        for block in (1, 2, 4, 8):
            grid = Grid.adaptive(box, (cells,))

            class Stub:
                pass

            stub: Any = Stub()
            stub.block = block
            found = Certification.first_blocks(stub, grid)
            assert [cell for part in found for cell in part] == grid.roots()
            assert len(found[0]) == 1 and max(map(len, found)) <= block
