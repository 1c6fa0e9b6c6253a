"""Work that is given up: at checkpoints, on signals, and with the process that asked for it."""

from __future__ import annotations

import importlib.util
import io
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import SHIFT, Inputs, environment, ring
from nerfs import UNIFORM, images, poses, tiny_scene
from test_certify_search import fill, open_store, search_of
from test_cli import call, one_line  # noqa: F401
from waiting import until

from ns_abstract.api import bounding
from ns_abstract.api import job as job_module
from ns_abstract.api.bounding import TileTask, bound, bound_frames, bound_part
from ns_abstract.api.cell_search import search_blocks
from ns_abstract.api.files import Settings, open_job
from ns_abstract.api.job import Job
from ns_abstract.api.poses import PoseSet
from ns_abstract.api.scenes import load_scene
from ns_abstract.arithmetic.kernel_cache import store
from ns_abstract.cli import certify as certify_command
from ns_abstract.cli import render as render_command
from ns_abstract.cli.common import SignalStop, run
from ns_abstract.execution import cancellation
from ns_abstract.execution.cancellation import Deadline, WorkCancelledError, cancel_when, check_cancelled
from ns_abstract.execution.engines import Machine, Processes, SerialEngine
from ns_abstract.execution.stopping import StopRequest
from ns_abstract.geometry.keyframe_cameras import path_json
from ns_abstract.io.atomic import write_json
from ns_abstract.io.errors import InputError
from ns_abstract.methods.nerf.bounds import NerfBounds
from ns_abstract.methods.nerf.frame import NerfFrame
from ns_abstract.methods.nerf.render import NerfRenderer
from ns_abstract.methods.nerf.write import write_nerf_run
from ns_abstract.refine.engine import Refinement, RefinementGoal
from ns_abstract.verify.cells import CellGrid
from ns_abstract.verify.search_results import BlockResult

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
    check_cancelled()
    with cancel_when(After(2)):
        check_cancelled()
        with cancel_when(lambda: False):
            check_cancelled()
        check_cancelled()
        with pytest.raises(WorkCancelledError):
            check_cancelled()
    check_cancelled()


@pytest.mark.slow
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
    with cancel_when(After(asked)):
        found = frame.bound(part, np.arange(12))
    assert sum(rays) <= asked + 1
    assert found.lower.shape == (12, 1, 1, 3) and (found.lower[-1] == 0.0).all() and (found.upper[-1] == 1.0).all()
    pictures = images(scene, pose_set, part.sample(5, np.random.default_rng(3)), sampling)[:, :, None, None]
    assert (found.lower <= pictures).all() and (pictures <= found.upper).all()
    if kind == "uniform":
        # narrower than nothing for those that were done
        whole = frame.bound(part, np.arange(12))
        assert (whole.upper - whole.lower).max() < 1.0


def test_one_ray_is_given_up_inside(monkeypatch: pytest.MonkeyPatch) -> None:
    frame = NerfFrame(tiny_scene(0), UNIFORM, poses(YAW))
    steps: list[int] = []
    step = frame.bounds.field.base
    monkeypatch.setattr(frame.bounds.field, "base", lambda *rest: steps.append(1) or step(*rest))
    arguments = frame._geometry, poses(YAW).box, frame._pixels(np.arange(1)), 1e-3
    frame.bounds.rays(*arguments)
    assert len(steps) >= 4
    steps.clear()
    with cancel_when(lambda: len(steps) >= 2), pytest.raises(WorkCancelledError):
        frame.bounds.rays(*arguments)
    assert len(steps) == 2


@pytest.mark.slow_cases
@pytest.mark.parametrize("count", [0, 1, 5, 40, 200])
def test_refinement_ends_soundly_wherever_it_is_stopped(count: int) -> None:
    scene, pose_set = tiny_scene(0), poses(YAW)
    frame: Any = NerfFrame(scene, UNIFORM, pose_set)
    refinement = Refinement(frame, 0, RefinementGoal(1.0, LONG, 60, keep_leaves=True), stopped=After(count))
    try:
        result = refinement.run()
    except WorkCancelledError:
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


@pytest.fixture
def nerf(tmp_path: Path) -> Settings:
    config = write_nerf_run(tiny_scene(), tmp_path, timestamp="run", experiment_name="tiny", views=ring(2, 8))
    path, spec = write_json(tmp_path / "path.json", path_json(ring(2, 8))), write_json(tmp_path / "spec.json", SHIFT)
    return Settings(config, path, spec)


@pytest.mark.slow
def test_a_picture_that_takes_too_long_is_told_at_once(nerf: Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rays are costly: a few show that the time does not do for one picture."""
    render = NerfFrame.render

    def slowly(self: NerfFrame, *rest: Any) -> np.ndarray:
        time.sleep(0.2)
        return render(self, *rest)

    job = open_job(nerf)
    job.check_time(0, LONG)
    monkeypatch.setattr(NerfFrame, "render", slowly)
    monkeypatch.setattr(job_module, "_LOOK_RAYS", 2)
    with pytest.raises(InputError, match="one picture of 8 x 8 pixels takes about") as caught:
        list(bound_frames(job, [0], engine=SerialEngine(), budget=1.0))
    assert caught.value.field == "--time-budget"
    scene = load_scene(nerf.load_config)
    with pytest.raises(InputError, match="one picture"):
        bound(scene, PoseSet(job.pose_sets[0].camera, {"x": 0.01}), time_budget=1.0)


@pytest.mark.parametrize("compiles", [False, True])
def test_only_compiling_comes_on_top_of_the_budget(
    compiles: bool, blobs: Inputs, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a clock that stands still but for the first look at a scene."""
    job = open_job(Settings(blobs.config, blobs.path, blobs.spec))
    clock, seen = SimpleNamespace(now=0.0, compiled=0), []

    def warm_up(self: Job, index: int) -> None:
        clock.now, clock.compiled = 60.0, clock.compiled + compiles

    def bound_part(self: Job, index: int, goal: RefinementGoal, *rest: Any, **more: Any) -> Any:
        seen.append(goal.seconds)
        raise WorkCancelledError

    monkeypatch.setattr(cancellation, "time", SimpleNamespace(perf_counter=lambda: clock.now))
    monkeypatch.setattr(bounding, "kernels", lambda: clock)
    monkeypatch.setattr(Job, "warm_up", warm_up)
    monkeypatch.setattr(Job, "bound_part", bound_part)
    assert list(bound_frames(job, [0], engine=SerialEngine(), budget=100.0)) == []
    assert seen == [100.0 if compiles else 40.0]


def test_a_ray_that_takes_long_is_given_up_when_kernels_are_compiled(
    nerf: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No command waits for a whole ray before its clock starts."""
    job = open_job(nerf)
    looks: list[int] = []

    def endless(self: NerfBounds, *rest: Any) -> Any:
        while True:
            looks.append(1)
            check_cancelled()
            time.sleep(0.01)

    monkeypatch.setattr(job_module, "_WARM_RAY", 0.2)
    monkeypatch.setattr(NerfBounds, "rays", endless)
    job.warm_up(0)
    assert looks


def test_a_ray_is_not_given_up_while_kernels_are_compiled(nerf: Settings, monkeypatch: pytest.MonkeyPatch) -> None:
    """The others would be compiled in the time that the budget counts."""
    job = open_job(nerf)
    done: list[int] = []

    def compiling(self: NerfBounds, *rest: Any) -> Any:
        for k in range(3):
            time.sleep(0.3)
            store().function_done()
            check_cancelled()
            done.append(k)

    monkeypatch.setattr(job_module, "_WARM_RAY", 0.2)
    monkeypatch.setattr(NerfBounds, "rays", compiling)
    job.warm_up(0)
    assert done == [0, 1, 2]


@pytest.mark.slow
def test_a_frame_ends_with_its_time_while_the_first_picture_is_rendered(
    nerf: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The picture of a frame does not count for its clock, but for the time that there is."""
    job = open_job(nerf)
    pixels = NerfRenderer.pixels
    shown: list[int] = []

    def endless(self: NerfRenderer, camera: Any, pose: Any, rays: np.ndarray, shift: Any = None) -> np.ndarray:
        while len(rays) == 64:
            shown.append(1)
            check_cancelled()
            time.sleep(0.01)
        return pixels(self, camera, pose, rays, shift)

    monkeypatch.setattr(NerfRenderer, "pixels", endless)
    monkeypatch.setattr(Job, "check_time", lambda *rest: None)  # a busy machine may be too slow for half a second
    assert list(bound_frames(job, [0], engine=SerialEngine(), budget=0.5)) == [] and shown
    assert bound_part(job.recipe, TileTask(0, None), RefinementGoal(1.05, 0.5), False) is None
    with pytest.raises(InputError, match="before one picture") as caught:
        bound(load_scene(nerf.load_config), PoseSet(job.pose_sets[0].camera, {"x": 0.01}), time_budget=3.0)
    assert caught.value.field == "time_budget"


def count_checkpoints(file: str) -> int:
    """Works until it is asked to end."""
    Path(file).touch()
    count = 0
    while True:
        check_cancelled()
        count += 1
        time.sleep(0.01)


def square(number: int) -> int:
    return number * number


@pytest.mark.slow
def test_workers_are_asked_to_end_and_work_on(tmp_path: Path) -> None:
    engine = Processes(1)
    try:
        engine.submit(0, count_checkpoints, str(tmp_path / "begun"))
        engine.submit(1, square, 3)
        until((tmp_path / "begun").exists)
        (pid,) = engine.pids
        engine.abandon()
        found: list[tuple[int, Any]] = []
        while engine.unfinished:
            found += engine.collect(1.0)
        assert [key for key, _ in found] == [0] and isinstance(found[0][1], WorkCancelledError)
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


UNGUARDED_CLUSTER = """
from ns_abstract.execution.cluster import connected
from ns_abstract.io.errors import InputError
try:
    with connected(None, 1):
        pass
except InputError as error:
    print(error)
"""


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("distributed") is None, reason="dask is not installed")
def test_a_cluster_without_a_guard_is_told_what_it_needs(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(UNGUARDED_CLUSTER)
    process = subprocess.run(
        [sys.executable, str(script)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment(),
        timeout=LONG, check=False,
    )  # fmt: skip
    (said,) = process.stdout.splitlines()
    assert str(script) in said and 'if __name__ == "__main__":' in said


UNGUARDED = """
from ns_abstract.execution.engines import Processes
from ns_abstract.io.errors import InputError
from test_ending import square
engine = Processes(2)
try:
    engine.submit(0, square, 3)
    while not (found := engine.collect(1.0)):
        pass
    print(found)
except InputError as error:
    print(error)
finally:
    engine.close()
"""


@pytest.mark.slow
@pytest.mark.parametrize("guarded", [False, True])
def test_a_script_without_a_guard_is_told_what_it_needs(tmp_path: Path, guarded: bool) -> None:
    """Fresh processes import the script, and would start processes of their own."""
    script = tmp_path / "script.py"
    guard = 'if __name__ == "__main__":\n    '
    script.write_text(guard + UNGUARDED.replace("\n", "\n    ") if guarded else UNGUARDED)
    variables = environment()
    variables["PYTHONPATH"] += os.pathsep + str(Path(__file__).parent)
    process = subprocess.run(
        [sys.executable, str(script)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=variables,
        timeout=LONG, check=False,
    )  # fmt: skip
    (said,) = process.stdout.splitlines()
    if guarded:
        assert said == "[(0, 9)]"
    else:
        assert str(script) in said and 'if __name__ == "__main__":' in said and "workers=1" in said
        assert "memory" not in said


def alive(pid: int) -> bool:
    try:
        # a process that nobody has waited for is not alive
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.slow
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
        assert len(pids) == 2
        until(lambda: all((tmp_path / f"begun{k}").exists() for k in range(2)))
        assert all(map(alive, pids))
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    until(lambda: not any(map(alive, pids)))


# ---------------------------------------------------------------- signals


def test_a_signal_ends_at_once_where_nothing_is_to_be_saved() -> None:
    stop = SignalStop()
    with stop.installed():
        with pytest.raises(KeyboardInterrupt), stop.at_once():
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(LONG)
        assert stop()
        with pytest.raises(KeyboardInterrupt), stop.at_once():
            raise AssertionError("the request had come before")
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


def _in_compiled_code(cause: BaseException | None) -> int:
    """What a compiled function does that an exception of a signal's handler reaches."""
    raise SystemError("returned a result with an exception set") from cause


def test_a_signal_in_compiled_code(capsys: pytest.CaptureFixture[str]) -> None:
    stop = StopRequest()
    with pytest.raises(KeyboardInterrupt), stop.at_once():
        _in_compiled_code(KeyboardInterrupt())
    with pytest.raises(SystemError), stop.at_once():
        _in_compiled_code(ValueError())
    with pytest.raises(SystemExit) as left:
        run(lambda options: _in_compiled_code(KeyboardInterrupt()), lambda: None)
    assert left.value.code == 3 and capsys.readouterr().err == "interrupted\n"
    with pytest.raises(SystemError):
        run(lambda options: _in_compiled_code(None), lambda: None)


def test_a_signal_is_noted_where_something_is(capfd: pytest.CaptureFixture[str]) -> None:
    stop = SignalStop()
    with stop.installed():
        os.kill(os.getpid(), signal.SIGINT)
        assert stop() and "being saved" in capfd.readouterr().err
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)


def test_a_signal_in_the_middle_of_a_print() -> None:
    """Python refuses to begin to print while it prints."""

    class Stream(io.RawIOBase):
        def writable(self) -> bool:
            return True

        def write(self, data: Any) -> int:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.0)
            return len(data)

    buffer = io.BufferedWriter(Stream())
    before, sys.stderr = sys.stderr, io.TextIOWrapper(buffer, write_through=True)
    try:
        stop = SignalStop()
        with stop.installed():
            print("told", file=sys.stderr, flush=True)
        assert stop()
    finally:
        sys.stderr = before


@pytest.mark.slow
def test_a_signal_ends_a_library_call() -> None:
    """Nothing runs between two lines of Python while a kernel is compiled."""
    code = """
import ctypes
from ns_abstract.cli.common import SignalStop
library, mutex = ctypes.CDLL(None), ctypes.create_string_buffer(256)
library.pthread_mutex_lock(mutex)
stop = SignalStop()
def fail():
    print("saved", flush=True)
    raise OSError("disk full")
with stop.installed(), stop.last_words(lambda: None), stop.last_words(fail):
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
        shown, said = process.communicate(timeout=LONG)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 3 and said == "interrupted\n" and shown == "saved\n"


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("atexit.register(lambda: os.kill(os.getpid(), signal.SIGINT)); run(lambda options: 0, lambda: None)", ""),
        (
            "atexit.register(lambda: os.kill(os.getpid(), signal.SIGTERM)); run(stopped, lambda: None)",
            "interrupted\n",
        ),
        ("run(lambda options: os.kill(os.getpid(), signal.SIGTERM), lambda: None)", "interrupted\n"),
        ("run(lambda options: 0, lambda: os.kill(os.getpid(), signal.SIGINT))", "interrupted\n"),
        # Python notes that such text was interrupted, and ends by the signal
        ("run(lambda options: exec('raise KeyboardInterrupt'), lambda: None)", "interrupted\n"),
        ("run(lambda options: [Half(lambda: None), stopped(options)], lambda: None)", "interrupted\n"),
        (
            "run(lambda options: [[Half(lambda: os.kill(os.getpid(), 15))].clear(), time.sleep(9)], lambda: 0)",
            "interrupted\n",
        ),
    ],
)
def test_a_signal_before_and_after_the_work_is_no_traceback(code: str, said: str) -> None:
    """Who presses Ctrl-C twice meets the end of the command with the second one."""
    begin = "import atexit, os, signal, time\nfrom ns_abstract.cli.common import run\n"
    begin += "def stopped(options):\n    kept = Half(lambda: 1 / 0)\n    raise KeyboardInterrupt\n"
    begin += "class Half:\n    def __init__(self, end):\n        self.end = end\n"
    begin += "    def __del__(self):\n        self.end()\n"
    done = subprocess.run(
        [sys.executable, "-c", begin + code], capture_output=True, text=True, env=environment(), check=False
    )
    assert (done.returncode, done.stderr) == (3, said)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("script", [True, False])
def test_a_signal_while_a_command_is_imported_is_one_line(number: int, script: bool) -> None:
    """Other programs that import the package keep their signals."""
    name = "/usr/bin/ns-abstract-compare" if script else "other"
    code = f"import os, sys\nsys.argv = [{name!r}]\nimport ns_abstract.cli\nos.kill(os.getpid(), {int(number)})\n"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment(), check=False)
    if script:
        assert (done.returncode, done.stderr) == (3, "interrupted\n")
    else:
        assert done.returncode == -number and done.stderr != "interrupted\n"


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
        RuntimeError("CUDA out of memory. Tried to allocate 2.00 GiB."),
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


@pytest.mark.slow
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
    job = open_job(Settings(blobs.config, blobs.path, blobs.spec, memory_limit=1e300))
    assert job.memory == 2**50


# ---------------------------------------------------------------- early results


def test_first_blocks_are_small_and_hold_every_cell() -> None:
    from ns_abstract.api.certification import Certification

    box = poses(YAW).box
    for cells in (1, 2, 5, 8, 19, 33):
        for block in (1, 2, 4, 8):
            grid = CellGrid.adaptive(box, (cells,))

            class Stub:
                pass

            stub: Any = Stub()
            stub.block = block
            found = Certification.first_blocks(stub, grid)
            assert [cell for part in found for cell in part] == grid.roots()
            assert len(found[0]) == 1 and max(map(len, found)) <= block


class Starting:
    """Workers that need a while: nothing comes for some looks, then all results do."""

    capacity, threads, shares = 3, 3, False

    def __init__(self, looks: int) -> None:
        self.starting, self.looks, self.tasks = True, looks, []

    def machine(self) -> Machine:
        return Machine(3, 3)

    def submit(self, key: int, function: Callable[..., Any], *arguments: Any) -> None:
        self.tasks.append((key, function, arguments))

    def collect(self, seconds: float) -> list[tuple[int, Any]]:
        self.looks -= 1
        if self.looks >= 0:
            return []
        self.starting = False
        done, self.tasks = self.tasks, []
        return [(key, function(*arguments)) for key, function, arguments in done]

    def close(self) -> None:
        self.tasks.clear()


@pytest.mark.slow
@pytest.mark.parametrize("looks", [0, 1, 4, 1000])
def test_blocks_are_examined_while_workers_start(looks: int, tmp_path: Path) -> None:
    """Each once, and the cells are those of an uninterrupted search; a stop is heeded meanwhile."""
    search = search_of(coarse=(40,))
    whole = open_store(tmp_path / "whole")
    fill(whole, search)
    expected = whole.tallies(), whole.leaves(0)
    whole.close()
    here: list[Any] = []
    there: list[Any] = []

    def told(list_: list[Any]) -> Callable[..., BlockResult]:
        return lambda *found: (list_.append(found[-1]), search.examine(found[-1]))[1]

    store = open_store(tmp_path / "out")
    fill(store, search, 0)
    kept: list[int] = []
    arguments: Any = (told(there), None)
    search_blocks(
        store, Starting(looks), {0: search.grid}, told(here), arguments, deadline=Deadline(LONG),
        stop=StopRequest(), keep=lambda block, findings: kept.append(block.number), on_tick=lambda instant: None,
    )  # fmt: skip
    timeless = [[{**row, "seconds": 0.0} for row in rows] for rows in (store.leaves(0), expected[1])]
    assert store.tallies() == expected[0] and timeless[0] == timeless[1]
    assert len(kept) == len(set(kept)) == len(here) + len(there)
    assert len(here) >= min(looks, 2) and (len(there) > 0 or looks == 1000)
    store.close()
    # a request to stop is asked for between blocks
    store, stop = open_store(tmp_path / "stopped"), StopRequest()
    fill(store, search, 0)
    kept.clear()

    def keep(block: Any, findings: BlockResult) -> None:
        kept.append(block.number)
        stop.ask()

    search_blocks(
        store, Starting(1000), {0: search.grid}, told(here), arguments, deadline=Deadline(LONG), stop=stop,
        keep=keep, on_tick=lambda instant: None,
    )  # fmt: skip
    assert len(kept) == 1
    store.close()


@pytest.mark.slow
def test_processes_start_until_the_first_result() -> None:
    engine = Processes(1)
    try:
        assert engine.starting
        engine.submit(0, square, 3)
        while not engine.collect(1.0):
            assert engine.starting
        assert not engine.starting
    finally:
        engine.close()
