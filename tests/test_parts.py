"""Frames that are bounded in groups of tiles: sound, complete, and the same wherever the groups are bounded."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import Inputs, command_options
from nerfs import UNIFORM, images, poses, tiny_scene

from ns_abstract.api import bounding
from ns_abstract.api.bounding import TileTask, bound_frames, bound_part
from ns_abstract.api.files import PathJob, Settings, open_job
from ns_abstract.cli.render import Render, render
from ns_abstract.execution import cancellation
from ns_abstract.execution.cluster import Cluster, connected
from ns_abstract.execution.engines import Machine
from ns_abstract.geometry.tiles import assemble
from ns_abstract.io.errors import InputError
from ns_abstract.methods.nerf.frame import NerfFrame
from ns_abstract.refine.engine import Refinement, RefinementGoal, groups, shared_goal
from ns_abstract.refine.result import FrameResult, PartResult, joined, mean_pixel_gap

#: Seconds that no machine needs, however busy: what ends a search here is never the time.
FOREVER = 1e6
PICTURES = ("lower", "upper", "witness_lower", "witness_upper", "image")
LEAVES = ("box_lower", "box_upper", "tile", "A_lower", "b_lower", "A_upper", "b_upper")
VARIED = {
    "version": 1, "translation": {"x": 0.01},
    "scene": [{"select": {"box": [[-1, -1, -1], [1, 1, 0.1]]}, "opacity": 0.1, "color": 0.1}],
}  # fmt: skip

needs_dask = pytest.mark.skipif(importlib.util.find_spec("distributed") is None, reason="dask is not installed")


def job_of(blobs: Inputs) -> PathJob:
    return open_job(Settings(blobs.config.absolute(), blobs.path.absolute(), blobs.spec.absolute()))


def in_groups(
    job: PathJob, count: int, goal: RefinementGoal, index: int = 0, keep_leaves: bool = False
) -> list[PartResult]:
    frame = job.frame(index)
    goal = shared_goal(frame, index, goal, job.seed)
    return [job.bound_part(index, goal, tiles, keep_leaves=keep_leaves) for tiles in groups(frame, count)]


def same(first: FrameResult, second: FrameResult) -> None:
    for name in PICTURES:
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    assert (first.cells, first.bounded, first.plan) == (second.cells, second.bounded, second.plan)
    assert (first.leaves is None) == (second.leaves is None)
    if first.leaves is not None and second.leaves is not None:
        for name in LEAVES:
            np.testing.assert_array_equal(getattr(first.leaves, name), getattr(second.leaves, name))


def violations(job: PathJob, result: FrameResult, count: int = 40, index: int = 0) -> int:
    """Pixel channels of pictures of the set, of members too, outside the bounds."""
    frame = job.frame(index)
    rng = np.random.default_rng(5)
    values = [*frame.box.sample(count, rng), *(frame.box.corners() if frame.box.dimensions else [])]
    shows = [frame.render, *(show for _, show in zip(range(8), frame.scene_samples(11), strict=False))]
    found = 0
    for k, v in enumerate(values):
        image = assemble(shows[k % len(shows)](v, None), frame.camera)
        found += int((~((result.lower <= image) & (image <= result.upper))).sum())
    return found


# ---------------------------------------------------------------- groups


def test_groups_hold_every_tile_once(blobs: Inputs) -> None:
    frame = job_of(blobs).frame(0)
    for count in (1, 2, 3, frame.tile_count, 99):
        found = groups(frame, count)
        assert len(found) == min(count, frame.tile_count) and all(np.diff(g).min(initial=1) == 1 for g in found)
        np.testing.assert_array_equal(np.concatenate(found), np.arange(frame.tile_count))
    rays = groups(NerfFrame(tiny_scene(0), UNIFORM, poses({"rotation": {"yaw": 0.01}})), 5)
    np.testing.assert_array_equal(np.sort(np.concatenate(rays)), np.arange(12))
    np.testing.assert_array_equal(rays[1], [1, 6, 11])


def test_one_group_is_the_frame(blobs: Inputs) -> None:
    job, goal = job_of(blobs), RefinementGoal(1.05, FOREVER, 40)
    whole = job.joined([job.bound_part(0, goal, keep_leaves=True)])
    everything = np.arange(job.frame(0).tile_count)
    part = job.bound_part(0, goal, everything, keep_leaves=True)
    same(job.joined([part]), whole)
    assert [dataclasses.replace(p, seconds=0.0) for p in part.trace] == [
        dataclasses.replace(p, seconds=0.0) for p in whole.trace
    ]


def test_some_tiles_are_no_frame(blobs: Inputs) -> None:
    """A missing group is never taken for bounds."""
    job = job_of(blobs)
    parts = in_groups(job, 3, RefinementGoal(1.5, FOREVER, 4))
    for wrong in (parts[:2], parts[1:], [*parts, parts[0]], [parts[0], parts[0], parts[2]]):
        with pytest.raises(ValueError, match="missing or there twice"):
            job.joined(wrong)
    other = dataclasses.replace(parts[0], index=1)
    with pytest.raises(ValueError, match="another set"):
        job.joined([other, *parts[1:]])
    # a group without a cover leaves the frame without bounds
    late = job.joined([dataclasses.replace(parts[0], bounded=False), *parts[1:]])
    assert not late.bounded and late.leaves is None
    with pytest.raises(ValueError, match="run_part"):
        Refinement(job.frame(0), 0, RefinementGoal(1.5, FOREVER, 4), tiles=np.arange(2)).run()


def test_joined_groups_are_sound_and_reach_the_target(blobs: Inputs) -> None:
    job = job_of(blobs)
    parts = in_groups(job, 4, RefinementGoal(1.1, FOREVER, 4000), keep_leaves=True)
    result = job.joined(parts)
    assert violations(job, result) == 0
    point = result.trace[-1]
    assert point.mpg <= 1.1 * point.mpg_witness
    assert point.mpg == pytest.approx(mean_pixel_gap(result.lower, result.upper))
    assert point.mpg_witness == pytest.approx(mean_pixel_gap(result.witness_lower, result.witness_upper))
    assert result.cells == sum(p.cells for p in parts) == point.cells
    assert [p.seconds for p in result.trace] == sorted(p.seconds for p in result.trace)
    assert all(a.cells <= b.cells for a, b in zip(result.trace, result.trace[1:], strict=False))
    assert any("4 groups of tiles" in sentence for sentence in result.plan)
    dim = job.joined([*parts[:3], dataclasses.replace(parts[3], floor=0.0041)])
    said = [sentence for sentence in dim.plan if sentence not in result.plan]
    assert len(said) == 1 and "at most 0.41% of a pixel" in said[0]
    # bounds are about as tight as those of the frame as a whole
    whole = job.joined([job.bound_part(0, RefinementGoal(1.1, FOREVER, 4000))])
    assert mean_pixel_gap(result.lower, result.upper) <= 1.1 * mean_pixel_gap(whole.lower, whole.upper)
    # leaves of every tile cover the set and hold its pictures
    assert result.leaves is not None
    frame = job.frame(0)
    for v in frame.box.sample(5, np.random.default_rng(1)):
        tiles = frame.render(v)
        seen = set()
        for k in np.flatnonzero((result.leaves.box_lower <= v).all(1) & (v <= result.leaves.box_upper).all(1)):
            low, high = result.leaves.box_lower[k], result.leaves.box_upper[k]
            p = 2.0 * (v - low) / (high - low) - 1.0
            row, column = result.leaves.tile[k] // frame.side
            number = int(row * frame.across + column)
            seen.add(number)
            least = result.leaves.A_lower[k].astype(np.float64) @ p + result.leaves.b_lower[k]
            most = result.leaves.A_upper[k].astype(np.float64) @ p + result.leaves.b_upper[k]
            # the last bits: evaluation of the planes here
            assert (least <= tiles[number] + 1e-12).all() and (tiles[number] <= most + 1e-12).all()
        assert seen == set(range(frame.tile_count))


def test_planted_gap_is_found(blobs: Inputs) -> None:
    """The attack of these tests can fail: one group's tiles put where another's belong."""
    job = job_of(blobs)
    parts = in_groups(job, 2, RefinementGoal(1.1, FOREVER, 200))
    first, second = parts
    n = min(first.tiles.size, second.tiles.size)
    swapped = dataclasses.replace(first, lower=np.concatenate([second.lower[:n], first.lower[n:]]))
    assert violations(job, job.joined([swapped, second])) > 0


def test_slack_is_what_the_whole_allows(blobs: Inputs) -> None:
    job = job_of(blobs)
    goal = shared_goal(job.frame(0), 0, RefinementGoal(1.05), 0)
    assert 1.0 < goal.ratio < 1.05 and goal.slack > 0.0
    result = job.joined(in_groups(job, 3, RefinementGoal(1.05, FOREVER, 60)))
    # the slack comes out of pictures that every group's witnesses hold
    assert (1.05 - goal.ratio) * mean_pixel_gap(result.witness_lower, result.witness_upper) >= goal.slack
    frame = job.frame(0)
    assert shared_goal(frame, 0, RefinementGoal(1.0), 0).slack == 0.0
    still = NerfFrame(tiny_scene(0), UNIFORM, poses({"rotation": {"yaw": 0.01}}))
    assert shared_goal(still, 0, RefinementGoal(1.05), 0) == RefinementGoal(1.05)


def test_scenes_that_vary(make_blobs: Callable[..., Inputs]) -> None:
    job = job_of(make_blobs(spec=VARIED))
    result = job.joined(in_groups(job, 3, RefinementGoal(1.05, FOREVER, 6)))
    assert violations(job, result) == 0
    assert any("scene variations" in sentence for sentence in result.plan)
    assert mean_pixel_gap(result.lower, result.upper) < 0.5


@pytest.mark.slow
def test_rays_of_a_nerf() -> None:
    scene, pose_set = tiny_scene(2, density=30.0), poses({"rotation": {"yaw": 0.01}})
    frame = NerfFrame(scene, UNIFORM, pose_set)
    parts = [
        Refinement(frame, 0, RefinementGoal(1.2, FOREVER, 200), tiles=tiles).run_part() for tiles in groups(frame, 3)
    ]
    result = joined(parts, frame.camera)
    assert result.bounded and mean_pixel_gap(result.lower, result.upper) < 0.9
    for picture in images(scene, pose_set, pose_set.box.sample(100, np.random.default_rng(0))):
        shown = picture.reshape(result.lower.shape)
        assert (result.lower <= shown).all() and (shown <= result.upper).all()


# ---------------------------------------------------------------- a cluster


@pytest.mark.slow
@needs_dask
def test_two_workers_one_of_them_killed_equal_this_process(blobs: Inputs) -> None:
    job = job_of(blobs)
    goal = RefinementGoal(1.02, FOREVER, 60)
    expected = job.joined(in_groups(job, 4, goal, keep_leaves=True))
    frame = job.frame(0)
    shared = shared_goal(frame, 0, goal, job.seed)
    with connected(None, 2) as client:
        engine = Cluster(client)
        assert engine.threads == 2
        for key, tiles in enumerate(groups(frame, 4)):
            engine.submit(key, bound_part, job.recipe, TileTask(0, tiles), shared, True, 2)
        found: dict[int, PartResult] = {}
        # a worker that has begun; as long as it takes, and pytest's own limit ends what hangs
        while not (begun := [address for address, tasks in client.processing().items() if tasks]):
            time.sleep(0.05)
        os.kill(client.run(os.getpid, workers=begun[:1])[begun[0]], signal.SIGKILL)
        while len(found) < 4:
            for key, part in engine.collect(0.5):
                assert key not in found
                found[key] = part
        engine.close()
    same(job.joined([found[k] for k in sorted(found)]), expected)
    # in whatever order they come
    same(job.joined([found[k] for k in (2, 0, 3, 1)]), expected)


class Machines:
    """An engine on several machines that works in this process: tasks in order, their goals noted.

    Args:
        threads: Threads by process, the processes by machine.
    """

    shares = False
    starting = False

    def __init__(self, *threads: list[int]) -> None:
        self._machines = threads
        self.threads = sum(map(sum, threads))
        self.capacity = 2 * self.threads
        self.goals: list[RefinementGoal] = []
        self.parts: list[TileTask] = []
        self.done: list[int] = []
        self._tasks: list[tuple[int, Any, Any]] = []

    def machine(self) -> Machine:
        return Machine(max(map(len, self._machines)), max(map(sum, self._machines)))

    def submit(self, key: int, function: Any, *arguments: Any) -> None:
        self._tasks.append((key, function, arguments))
        self.goals.append(arguments[2])
        self.parts.append(arguments[1])
        assert len(self._tasks) <= self.threads

    def collect(self, seconds: float) -> list[tuple[int, Any]]:
        key, function, arguments = self._tasks.pop(0)
        self.done.append(key)
        return [(key, function(*arguments))]

    def close(self) -> None:
        self._tasks.clear()


def options(blobs: Inputs, folder: Path, **more: Any) -> Render:
    files = {"load_config": blobs.config, "camera_path_filename": blobs.path, "output_dir": folder}
    return command_options(Render, **files, perturbation_filename=blobs.spec, **more)


def test_frames_are_divided_where_threads_are_many(blobs: Inputs, monkeypatch: pytest.MonkeyPatch) -> None:
    """By a clock that every task puts forward by a second."""
    job = job_of(blobs)
    for frames, threads, tasks in (([0, 1, 2], 2, 3), ([0], 1, 1), ([0], 2, 4), ([0, 2], 3, 6)):
        engine = Machines([threads])
        clock = SimpleNamespace(perf_counter=lambda done=engine.done: float(len(done)))
        monkeypatch.setattr(cancellation, "time", clock)
        results = list(bound_frames(job, frames, engine=engine, budget=60.0, target_ratio=3.0))
        assert sorted(r.index for r in results) == frames and all(r.bounded for r in results)
        assert len(engine.goals) == tasks
        # all the time that is left, shared by the rounds that are
        seconds = []
        for number in range(tasks):
            spent = max(0, number - threads + 1)
            seconds.append((60.0 - spent) / -(-(tasks - number) // threads))
        assert [goal.seconds for goal in engine.goals] == pytest.approx(seconds)
        for result in results:
            assert violations(job, result, 5, result.index) == 0


def test_no_time_leaves_frames_missing_but_no_frame_in_part(blobs: Inputs) -> None:
    job = job_of(blobs)
    engine = Machines([4])
    results = list(bound_frames(job, [0, 1, 2], engine=engine, budget=1e-9))
    # the first frame is begun and finished, others are not begun
    assert [r.index for r in results] == [0] and {p.index for p in engine.parts} == {0}
    assert violations(job, results[0]) == 0
    # stopped before its last group is there: no result
    asked = iter([False, False, True, True, True])
    assert not list(bound_frames(job, [0], engine=engine, budget=60.0, stop=lambda: next(asked)))


def test_memory_is_shared_by_the_tasks_of_a_machine(blobs: Inputs) -> None:
    job = job_of(blobs)
    limit = (4 * job.base_memory(2) + (6 << 30)) / 2**30
    limited = open_job(dataclasses.replace(job.settings, memory_limit=limit))
    engine = Machines([2, 1], [1])
    list(bound_frames(limited, [0], engine=engine, budget=60.0, target_ratio=3.0))
    leaves = (limited.memory - 2 * job.base_memory(2)) // 2
    assert {goal.leaf_bytes for goal in engine.goals} == {leaves // 3}
    tight = open_job(dataclasses.replace(job.settings, memory_limit=1.5 * job.base_memory(2) / 2**30))
    with pytest.raises(InputError, match="2 workers on one machine") as refused:
        list(bound_frames(tight, [0], engine=engine, budget=60.0))
    assert refused.value.field == "--memory-limit"


@pytest.mark.slow
@needs_dask
def test_one_frame_on_two_workers_from_the_command_line(
    blobs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bounding, "local_workers", lambda job: 2)
    done = render(options(blobs, tmp_path / "out", frames=(1,), engine="dask", save_cells=True, time_budget=60.0))
    assert done == 0
    (entry,) = json.loads((tmp_path / "out" / "report.json").read_text())["frames"]
    assert entry["status"] != "missing" and any("groups of tiles" in sentence for sentence in entry["plan"])
    job = job_of(blobs)
    with np.load(tmp_path / "out" / "frame_00001.npz") as stored:
        frame = job.frame(1)
        for v in frame.box.sample(10, np.random.default_rng(2)):
            shown = assemble(frame.render(v), frame.camera)
            assert (stored["lower"] <= shown).all() and (shown <= stored["upper"]).all()
