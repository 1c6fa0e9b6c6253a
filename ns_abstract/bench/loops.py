"""Benchmarks of loops: certified fraction against time, tubes against the hull of many runs, attacks on tubes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ns_abstract.api.certifying import CertifyProgress, certify
from ns_abstract.api.loop_job import LoopJob, open_loop
from ns_abstract.api.loop_report import widths
from ns_abstract.api.poses import PoseSet
from ns_abstract.api.reaching import ReachCell, ReachProgress, ReachResult, reach
from ns_abstract.api.scenes import Scene
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.reach.search import QUESTIONS, SimulatedRun, first_outside, sampled_disturbances, simulate
from ns_abstract.reach.tubes import Dependence, Tube

#: What tubes keep, by how a table calls it.
_MODES: dict[Dependence, str] = {"kept": "kept", "step": "within a step", "none": "none"}
#: Seconds between two words of where a search stands.
_SAID = 10.0
#: Sets by name, as a perturbation file writes them.
SETS: dict[str, dict[str, Any]] = {
    "x": {"translation": {"x": 0.05}},
    "xyz": {"translation": {"x": 0.05, "y": 0.05, "z": 0.05}},
    "xyz-small": {"translation": {"x": 0.01, "y": 0.01, "z": 0.01}},
    "six": {
        "translation": {"x": 0.005, "y": 0.005, "z": 0.005},
        "rotation": {"yaw": 0.005, "pitch": 0.005, "roll": 0.005},
    },
    "six-wide": {
        "translation": {"x": 0.05, "y": 0.05, "z": 0.05},
        "rotation": {"yaw": 0.02, "pitch": 0.02, "roll": 0.02},
    },
}


class LoopTables(NamedTuple):
    """Rows of a benchmark, of its ``search`` and of its ``steps``.

    ``search`` is one row: certified fraction by time, the fraction of random runs that succeed, states compared with
    tubes. ``steps`` is a row by step: mean widths of a certified cell's tubes, and of the hull of runs from it.
    """

    search: list[dict[str, Any]]
    steps: list[dict[str, Any]]


def measure(
    scene: Scene,
    loop: Path,
    seconds: float,
    workers: int,
    runs: int,
    marks: Sequence[float],
    seed: int = 0,
    said: Callable[[str], object] = lambda text: None,
) -> LoopTables:
    """Return the tables of a loop: it is searched, certified cells are attacked, one is compared with simulated runs.

    ``runs``: number of random runs from the whole initial box, each compared with the tube of its cell, and of runs
    from one cell. ``marks``: seconds at which the certified fraction is recorded.
    """
    points: list[ReachProgress] = []
    said(f"searching for {seconds:g} s")
    result = reach(scene, loop, time_budget=seconds, workers=workers, on_progress=points.append)
    job, rng = open_loop(scene, loop), np.random.default_rng(seed)
    question = QUESTIONS[job.questions[-1]]
    cells = [cell for cell in result.cells if cell.question == question]
    row: dict[str, Any] = {"question": question, "seconds": result.seconds}
    told = [(point.seconds, getattr(point, question)) for point in points]
    row |= _at_marks(marks, told, result.seconds, getattr(result, question))
    said(f"{runs} runs from the whole box")
    row |= _attack(job, result, cells, runs, rng)
    certified = [cell for cell in cells if cell.verdict == "certified"]
    if not certified:
        return LoopTables([row], [])
    middle = sorted(certified, key=lambda cell: float(np.prod(cell.upper - cell.lower)))[len(certified) // 2]
    said(f"{runs} runs from one cell")
    steps, outside = _by_step(job, _box(job, middle), runs, rng)
    row["violations"] += outside
    row["states compared"] += runs * (job.loop.steps + 1)
    return LoopTables([row], steps)


def _at_marks(
    marks: Sequence[float], told: Sequence[tuple[float, float]], seconds: float, last: float
) -> dict[str, float]:
    """Return the fraction at each of ``marks`` seconds, by ``told`` pairs (seconds, fraction); ``last`` at the end."""
    return {
        f"at {mark:g} s": last if seconds <= mark else next((f for t, f in reversed(told) if t <= mark), 0.0)
        for mark in marks
    }


def _box(job: LoopJob, cell: ReachCell) -> ParameterBox:
    return job.loop.box.with_ends(cell.lower, cell.upper)


def _runs(
    job: LoopJob, box: ParameterBox, count: int, rng: np.random.Generator
) -> Iterator[tuple[np.ndarray, SimulatedRun]]:
    """Yield random starts and their runs, by turns with disturbances at an end throughout and anywhere."""
    reacher = job.search.reacher
    for number, start in enumerate(box.sample(count, rng)):
        push = sampled_disturbances(job.loop, rng, "ends" if number % 2 else "random")
        yield start, simulate(reacher, job.loop.state(box, start), push)


def _attack(
    job: LoopJob, found: ReachResult, cells: Sequence[ReachCell], count: int, rng: np.random.Generator
) -> dict[str, Any]:
    """Return how many random runs succeed, and how many states leave the tube of their cell."""
    question = QUESTIONS[job.questions[-1]]
    low, high = np.stack([cell.lower for cell in cells]), np.stack([cell.upper for cell in cells])
    by_cell: dict[int, list[SimulatedRun]] = {}
    well = 0
    for start, run in _runs(job, job.loop.box, count, rng):
        by_cell.setdefault(int(np.argmax(((low <= start) & (start <= high)).all(axis=1))), []).append(run)
        well += run.margin(job.loop, question) > 0.0
    compared = outside = wrong = 0
    for number, runs in by_cell.items():
        tube = job.search.reacher.tube(_box(job, cells[number]))
        for run in runs:
            outside += first_outside(tube, run) is not None
            compared += len(tube.state_sets)
            wrong += cells[number].verdict == "certified" and not run.margin(job.loop, question) > 0.0
    certified = getattr(found, question)
    return {
        "certified": certified,
        "falsified": found.falsified,
        "went well": well / count,
        "certified / went well": certified * count / well if well else float("nan"),
        "cells": len(cells),
        "runs": count,
        "states compared": compared,
        "violations": outside + wrong,
    }


def _by_step(job: LoopJob, box: ParameterBox, count: int, rng: np.random.Generator) -> tuple[list[dict[str, Any]], int]:
    """Return widths by step of tubes by kept dependence and of the hull of runs, and how many runs leave a tube."""
    tubes: dict[str, Tube] = {name: job.reacher(mode).tube(box, whole=True) for mode, name in _MODES.items()}
    corners = [
        simulate(job.search.reacher, job.loop.state(box, c), sampled_disturbances(job.loop, rng, "ends"))
        for c in box.corners()
    ]
    runs = [*corners, *(run for _, run in _runs(job, box, count - len(corners), rng))]
    outside = sum(first_outside(tube, run) is not None for tube in tubes.values() for run in runs)
    states = np.stack([run.states for run in runs])
    hull = (states.max(axis=0) - states.min(axis=0)).mean(axis=1)
    rows = []
    for step, width in enumerate(hull):
        row = {"step": step, "simulated": float(width)}
        for name, tube in tubes.items():
            tube_widths = widths(tube)
            row[name] = tube_widths[step] if step < len(tube_widths) else float("inf")
        rows.append(row | {"kept / simulated": row["kept"] / float(width)})
    return rows, outside


def curve(
    scene: Scene,
    camera: PinholeCamera,
    name: str,
    specification: dict[str, Any],
    model: Path,
    prop: Path,
    seconds: float,
    workers: int,
    marks: Sequence[float],
    said: Callable[[str], object] = lambda text: None,
    following: PinholeCamera | None = None,
) -> dict[str, Any]:
    """Search one set for ``seconds``.

    Args:
        marks: Times, in seconds from the call, at which the certified fraction is told; kernels have to be loaded, and
            compiled at the first time, within them.
        said: Told from time to time where the search stands.
        following: The camera after ``camera`` on its path, for sets that sweep segments.

    Returns:
        A row: certified fraction at the marks and at the end, falsified and unknown ones, cells bounded by the network,
        worker seconds by bounded cell.
    """
    points: list[CertifyProgress] = []
    said(f"{name}: searching for {seconds:g} s")
    due = _SAID

    def on_progress(point: CertifyProgress) -> None:
        nonlocal due
        points.append(point)
        if point.seconds >= due:
            due = point.seconds + _SAID
            said(
                f"{name}: {point.seconds:.0f} s, certified {point.certified:.2%}, falsified {point.falsified:.2%}, "
                f"unknown {point.unknown:.2%}"
            )

    certificate = certify(
        scene, PoseSet.from_json(camera, specification, following=following), model, prop,
        time_budget=seconds, workers=workers, on_progress=on_progress,
    )  # fmt: skip
    effort = certificate.report["effort"]
    bounded = effort["cells_bounded"]
    row: dict[str, Any] = {"set": name, "parameters": len(certificate.parameters), "network": model.stem}
    told = [(point.seconds, point.certified) for point in points]
    row |= _at_marks(marks, told, certificate.seconds, certificate.certified)
    return row | {
        "seconds": certificate.seconds,
        "certified": certificate.certified,
        "falsified": certificate.falsified,
        "unknown": certificate.unknown,
        "bounded": bounded,
        "worker s / bounded": effort["worker_seconds"] / bounded if bounded else float("nan"),
    }
