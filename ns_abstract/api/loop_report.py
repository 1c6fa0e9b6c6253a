"""The report on a network in the loop: figures, tubes beside simulated runs, and a film."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ns_abstract.api.cell_search import CellSearch, Row
from ns_abstract.api.loop_job import LoopJob
from ns_abstract.execution.cancellation import Deadline, WorkCancelledError, cancel_when
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.reach.film import along, film_size, made
from ns_abstract.reach.learned import LearnedDynamics
from ns_abstract.reach.page import loop_page
from ns_abstract.reach.search import QUESTIONS, Question, SimulatedRun, sampled_disturbances, simulate
from ns_abstract.reach.tubes import Dependence, Tube
from ns_abstract.report.certificate import SCENE_MARGIN, search_figures
from ns_abstract.report.outside import SceneDrawing
from ns_abstract.report.run import CommandRun, plain, sides
from ns_abstract.verify.search_results import Verdict
from ns_abstract.verify.store import Store, Tally, fractions

#: Random runs; runs from a cell whose tube is shown; cells whose tube is shown.
_RUNS, _CELL_RUNS, _SHOWN = 200, 20, 2
#: Falsifying runs in report.json.
_EXAMPLES = 5
#: What is said in the report of every question.
SENTENCES: dict[Question, str] = {
    "safe": "no state of any run from the cell is in an unsafe set, at the sampling times 0 to the last",
    "reaches": "that, and every run from the cell is inside the goal, at the end or (when: any) at some one step",
}
#: What the words of the report mean.
METRICS = {
    "certified": "part of the initial box's volume where the question is answered yes for every run",
    "falsified": "part in cells with a run, stored and simulated again, that goes wrong",
    "unknown": "the rest",
    "simulated": "runs from random initial states with random disturbances, and the part that went well; says nothing "
    "about others",
    "width": "mean over the states of the width of the tube by step, and of the hull of simulated runs from the same "
    "cell",
    "camera": "of a tube, by step: least and largest x, y, z of the camera's position, normalised units",
    "film": "of the widest certified cell (or the first one), by step: mean and largest gap of the abstract image of "
    "all poses of the tube, in a picture of the given height and width; null: not asked for",
    "scene_margin": SCENE_MARGIN,
}


class LoopReport:
    """Writes report.json and report.html of a search."""

    def __init__(self, job: LoopJob, settings: Mapping[str, Any], command: tuple[str, ...]) -> None:
        self.job = job
        self.about = CommandRun.of(job.job, settings, command, fingerprint=job.fingerprint, assumptions=job.assumptions)
        self.simulated: list[SimulatedRun] = []
        self.tubes: list[dict[str, Any]] = []
        self.examples: list[dict[str, Any]] = []
        self.film: dict[str, Any] | None = None
        self._strips: list[tuple[int, bytes]] = []
        elements = job.job.method.elements()
        self._outside = None if elements is None else SceneDrawing(elements)

    def add_example(self, question: Question, run: SimulatedRun) -> None:
        """Add a failing run to the report's examples, up to their limit."""
        if len(self.examples) < _EXAMPLES:
            margin = run.margin(self.job.loop, question)
            self.examples.append({"question": question, "margin": margin, "states": run.states})

    def simulate_runs(self, deadline: Deadline) -> None:
        """Simulate random runs from a fixed seed, for the report."""
        loop, reacher = self.job.loop, self.job.search.reacher
        for number in range(_RUNS):
            generator = np.random.default_rng([17, number])
            start = loop.box.sample(1, generator)[0]
            if deadline.request() or (self.simulated and deadline.late):
                return
            try:
                with cancel_when(deadline.request):
                    push = sampled_disturbances(loop, generator, "random")
                    self.simulated.append(simulate(reacher, loop.state(loop.box, start), push))
            except WorkCancelledError:
                return

    def show_tubes(self, store: Store, deadline: Deadline) -> None:
        """Add tubes of a few certified cells to the report, beside simulated runs and the widths of simpler tubes."""
        certified = [row for number in self.job.questions for row in store.leaves(number, "certified")]
        if not certified:
            return
        chosen = [certified[len(certified) * (2 * k + 1) // (2 * _SHOWN)] for k in range(_SHOWN)]
        for row in {json.dumps([row["lower"], row["upper"]]): row for row in chosen}.values():
            try:
                with deadline.enforced():
                    self.tubes.append(shown_tube(self.job, row["lower"], row["upper"], _CELL_RUNS))
            except WorkCancelledError:
                return

    def make_film(self, store: Store, deadline: Deadline) -> None:
        """Make the film: abstract images along the tube of the widest certified cell of the strongest question."""
        job, steps, box = self.job, [], self.job.loop.box

        def strongest(kind: Verdict | None) -> list[dict[str, Any]]:
            return next((leaves for n in reversed(job.questions) if (leaves := store.leaves(n, kind))), [])

        def volume(row: dict[str, Any]) -> float:
            return float(np.prod(np.subtract(row["upper"], row["lower"])))

        row = max(strongest("certified"), key=volume, default=None) or next(iter(strongest(None)), None)
        if row is None:
            self.film = {"skipped": "no cell has a verdict"}
            return
        cell = ParameterBox(box.names, box.units, tuple(row["lower"]), tuple(row["upper"]))
        try:
            with deadline.enforced():
                tube = job.search.reacher.tube(cell, whole=True)
                size = film_size(job.loop.preprocess.size(job.network.input_shape))
                for step in along(job.search.reacher, job.job.method, size, tube):
                    steps.append(step)
        except WorkCancelledError:
            pass
        if not steps:
            self.film = {"skipped": "the work was interrupted" if deadline.request() else "the time ended first"}
            return
        film = made(steps, cell.lower, cell.upper, row["verdict"])
        ending, content = film.encoded()
        self.film = {"file": store.keep(f"film.{ending}", content).name, **film.about}
        self._strips = film.strips()

    def write(self, search: CellSearch[Any], state: str) -> dict[str, Any]:
        """Write report.json and report.html; returns the former's content."""
        rows = {tally.frame: search.store.leaves(tally.frame) for tally in search.store.tallies()}
        document = self._document(search, rows, state)
        search.last.write(document, lambda: loop_page(document, rows, self.job.loop, self._outside, self._strips))
        return document

    def _document(self, search: CellSearch[Any], rows: Mapping[int, list[Row]], state: str) -> dict[str, Any]:
        job, loop, store = self.job, self.job.loop, search.store
        entries = {QUESTIONS[tally.frame]: self._entry(tally, rows[tally.frame]) for tally in store.tallies()}
        learned: dict[str, Any] = {}
        if isinstance(loop.dynamics, LearnedDynamics):
            law = loop.dynamics
            learned = {"dynamics_model": law.network.stamp, "dynamics_guarantee": law.network.guarantee()}
        return plain(
            self.about.head()
            | {
                "kind": "loop",
                "verdict": verdict(entries),
                "questions": entries,
                "network_guarantee": job.network.guarantee(job.model.arithmetic),
                "intrinsics": job.job.pose_sets[0].camera.intrinsics._asdict(),
                "model": job.network.stamp,
                "loop": loop.value,
                "dynamics": loop.dynamics.about,
                **learned,
                "parameters": sides(loop.box),
                "simulated_states": [run.states for run in self.simulated[:40]],
                "tubes": self.tubes,
                "film": self.film,
                "scene_margin": search.scene_margin,
                "falsifying": self.examples,
                **search_figures(store),
            }
            | self.about.tail(state, METRICS)
        )

    def _text(self, question: Question) -> str:
        loop = self.job.loop
        text = SENTENCES[question]
        if question == "safe" and loop.required:
            text += "".join(f"; on the picture from every such state, {prop.sentence()}" for prop in loop.required)
        if question == "reaches" and loop.goal is not None and loop.goal.view is not None:
            text += f"; inside the goal: {loop.goal.view.sentence()}"
        notes = dict.fromkeys(note for prop in loop.views.values() for note in prop.notes)
        return "; ".join([text, *notes])

    def _entry(self, tally: Tally, rows: Sequence[Row]) -> dict[str, Any]:
        question, shares = QUESTIONS[tally.frame], fractions(tally)
        kinds = ("certified", "falsified", "unknown")
        went_well = sum(run.margin(self.job.loop, question) > 0.0 for run in self.simulated)
        count = len(self.simulated)
        return {
            "text": self._text(question),
            "certified": shares["certified"],
            "falsified": shares["falsified"],
            "unknown": shares["unknown"] + shares["open"],
            "not_examined": shares["open"],
            "cells": {kind: sum(row["verdict"] == kind for row in rows) for kind in kinds},
            "simulated": {"runs": count, "went_well": went_well / count if count else None},
            "certified_of_went_well": shares["certified"] * count / went_well if went_well else None,
            "least_margin": min((row["margin"] for row in rows if row["verdict"] == "certified"), default=None),
        }


def verdict(entries: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the verdict on the whole initial box: falsified, reaches, safe or unknown."""
    if any(entry["cells"]["falsified"] for entry in entries.values()):
        return "falsified"
    done = [name for name, entry in entries.items() if entry["unknown"] == 0.0 and entry["cells"]["certified"]]
    return done[-1] if done else "unknown"


def shown_tube(job: LoopJob, lower: list[float], upper: list[float], runs: int) -> dict[str, Any]:
    """Return a tube beside the hull of simulated runs, and its widths with less dependence.

    Args:
        lower, upper: [m] the cell.
    """
    box = ParameterBox(job.loop.box.names, job.loop.box.units, tuple(lower), tuple(upper))
    builder = job.search.reacher
    tube = builder.tube(box, whole=True)
    generator = np.random.default_rng(5)
    starts = [*box.corners(), *box.sample(max(0, runs - 2**box.dimensions), generator)]
    runs_from_cell = [
        simulate(builder, job.loop.state(box, start), sampled_disturbances(job.loop, generator, "ends"))
        for start in starts
    ]
    states = np.stack([run.states for run in runs_from_cell])
    modes: tuple[Dependence, ...] = ("step", "none")
    hulls = [entry.hull() for entry in tube.state_sets]
    return {
        "lower": list(box.lower),
        "upper": list(box.upper),
        "tube": [[low.tolist(), high.tolist()] for low, high in hulls],
        "camera": [[end.tolist() for end in builder.places(entry)] for entry in tube.state_sets],
        "runs": len(runs_from_cell),
        "hull": [
            [low.tolist(), high.tolist()] for low, high in zip(states.min(axis=0), states.max(axis=0), strict=True)
        ],
        "width": widths(tube),
        "width_simulated": (states.max(axis=0) - states.min(axis=0)).mean(axis=1).tolist(),
        "width_by_dependence": {mode: widths(job.reacher(mode).tube(box, whole=True)) for mode in modes},
        "reason": tube.reason,
    }


def widths(tube: Tube) -> list[float]:
    """Return, by step, the mean over the states of a tube's width, as far as the tube goes."""
    return [float(np.mean(np.subtract(*entry.hull()[::-1]))) for entry in tube.state_sets]
