"""A network in the loop: `reach`, its result, and the search that the command line runs, too."""

from __future__ import annotations

import copy
import hashlib
import io
import json
import os
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from ns_abstract.api.assumptions import choice, set_choices
from ns_abstract.api.bounding import listener
from ns_abstract.api.certification import MEMORY
from ns_abstract.api.job import Job, require_sound_platform
from ns_abstract.api.margins import NOT_ASKED, SHARE, Margins, certified_cells
from ns_abstract.api.scenes import Scene
from ns_abstract.api.searching import paced, search_blocks
from ns_abstract.arithmetic.forms import MAX_DIMENSIONS
from ns_abstract.execution.ending import AbandonedError, abandoning
from ns_abstract.execution.engines import Engine, EngineName, started
from ns_abstract.execution.opening import Recipe, opened
from ns_abstract.execution.stopping import StopRequest, interruptible
from ns_abstract.execution.threads import use_threads
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.io.assumptions import Assumption
from ns_abstract.io.errors import InputError
from ns_abstract.perturbation.specification import TRANSLATIONS
from ns_abstract.perturbation.variations import SceneVariation
from ns_abstract.reach.film import along, film_size, made
from ns_abstract.reach.learned import LearnedDynamics
from ns_abstract.reach.loop import Loop, load_loop, parse_loop
from ns_abstract.reach.page import loop_page
from ns_abstract.reach.search import QUESTIONS, LoopFindings, LoopSearch, Question, Run, pushes, simulate
from ns_abstract.reach.tubes import Dependence, Pictures, Pilot, Reacher, Tube
from ns_abstract.report.certificate import SCENE_MARGIN, LastReport, now
from ns_abstract.report.outside import Outside
from ns_abstract.report.record import file_stamp, guarantee_text, plain, versions
from ns_abstract.verify.cells import Cell, Grid
from ns_abstract.verify.model import NetworkModel
from ns_abstract.verify.network import NetworkArithmetic, load_network
from ns_abstract.verify.network.explain import check_cell
from ns_abstract.verify.response import Response
from ns_abstract.verify.scene_margin import (
    CAMERA_KINDS,
    KINDS,
    PLACES,
    REGISTRATION,
    Kind,
    SceneMargin,
    Settle,
    Settled,
)
from ns_abstract.verify.search import Verdict
from ns_abstract.verify.store import Block, Store, Tally, fractions

#: Of the search's rules: results of different ones are not mixed.
_RULES = 2
#: Random runs for the report, and part of the time for them; runs from a cell whose tube is shown; cells shown, and
#: part of the time for them.
_RUNS, _RUNS_SHARE, _CELL_RUNS, _SHOWN, _SHOWN_SHARE = 200, 0.1, 20, 2, 0.1
#: Part of the time for a film.
_FILM_SHARE = 0.1
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


class LoopJob:
    """An opened scene and a loop.

    Args:
        scene: The scene.
        loop: The loop.
        arithmetic: "float32" or "real", of the pictures; None: float32.
        network_arithmetic: The same of the network.

    Raises:
        InputError: The loop does not go with the scene or the network, or the platform's arithmetic is not sound.
    """

    def __init__(
        self,
        scene: Scene,
        loop: Loop,
        arithmetic: str | None = None,
        network_arithmetic: NetworkArithmetic = "float32",
    ) -> None:
        require_sound_platform()
        self.loop = loop
        self.network = load_network(loop.network, **loop.loading)
        self.model = NetworkModel(self.network, loop.preprocess, MEMORY, network_arithmetic)
        size = loop.preprocess.size(self.network.input_shape)
        outputs = loop.control.gain.shape[1]
        if self.network.output_size != outputs:
            raise InputError(
                f"the network has {self.network.output_size} outputs, the gain {outputs} columns",
                field="control.gain",
                fix=f"write one column by output, {self.network.output_size}",
            )
        self.job = Job(scene, [loop.camera.poses(size)], arithmetic=arithmetic)
        origin = "the network's input" if loop.preprocess.resize is None else "loop file: preprocess.resize"
        self.job.set_choices = set_choices(self.job.pose_sets, origin, "loop file: camera")
        if self.job.rays:
            raise InputError(
                f"loops are for splats, this run is a {self.job.method.content}",
                file=scene.source.file,
                fix="give a run of splatfacto or a .ply",
            )

    def reacher(self, dependence: Dependence = "kept") -> Reacher:
        """Computes tubes of the loop."""
        view = Pictures(self.job.method, self.job.pose_sets[0])
        return Reacher(self.loop, view, Pilot(self.model, self.loop.control), dependence)

    @cached_property
    def search(self) -> LoopSearch:
        """The search."""
        return LoopSearch(self.reacher())

    def around(self, extra: SceneVariation) -> LoopJob:
        """The same in all scenes of a set."""
        other = copy.copy(self)
        for name in ("search", "_fingerprint"):
            other.__dict__.pop(name, None)
        other.job = self.job.around(extra)
        return other

    @property
    def _moves(self) -> bool:
        # a place that does not depend on the state is no parameter that could be off
        return set(TRANSLATIONS) <= set(self.loop.camera.names)

    def places(self, kind: Kind) -> bool:
        """Whether the scene's place can be bounded beside the pose: within it, or as more parameters."""
        fits = len(self.loop.camera.names) + len(kind.place) <= MAX_DIMENSIONS
        return fits or (kind is REGISTRATION and self._moves)

    def settle(self, kind: Kind) -> Settle:
        """Bounds and attacks cells for all scenes around the stored one (V13)."""
        kept: dict[float, LoopSearch] = {}

        def settle(radius: float, number: int, box: ParameterBox) -> Settled:
            if radius not in kept:
                # radii come one after the other
                kept.clear()
                if kind is REGISTRATION and self._moves:
                    kept[radius] = LoopSearch(replace(self.reacher(), registration=radius))
                elif kind.place:
                    view = Pictures(self.job.method, self.job.pose_sets[0].registered(kind.place, radius))
                    kept[radius] = LoopSearch(replace(self.reacher(), view=view))
                elif kind.response is not None:
                    view = Pictures(self.job.method, self.job.pose_sets[0], Response(kind.response, radius))
                    kept[radius] = LoopSearch(replace(self.reacher(), view=view))
                else:
                    kept[radius] = self.around(kind.variation(radius)).search
            found = kept[radius].settle(QUESTIONS[number], box)
            if found.example is None:
                return found
            return replace(found, example={**found.example, "radius": np.array(radius)})

        return settle

    @property
    def questions(self) -> list[int]:
        """Numbers of the questions that are asked."""
        return [k for k, name in enumerate(QUESTIONS) if (self.loop.goal if name == "reaches" else self.loop.unsafe)]

    @property
    def recipe(self) -> Recipe[LoopJob]:
        """How another process opens it; files are looked for under the same paths."""
        loop = self.loop
        # laws of motion do not travel
        again = partial(
            _open, self.job.recipe.open, dict(loop.value), loop.network.absolute().parent, self.model.arithmetic
        )
        return Recipe(again, self.fingerprint, self.job.source.file)

    @property
    def assumptions(self) -> tuple[Assumption, ...]:
        """What the verdicts rest on, and where each choice came from."""
        output = self.loop.value.get("output")
        arithmetic = None if self.model.arithmetic == "float32" else self.model.arithmetic
        return (
            *self.job.assumptions,
            choice("network output", self.network.output or "the only one", output, "loop file: output"),
            choice("network_arithmetic", self.model.arithmetic, arithmetic, "--network-arithmetic"),
        )

    @property
    def fingerprint(self) -> dict[str, Any]:
        """What a stored search must agree with to be continued."""
        return self._fingerprint

    @cached_property
    def _fingerprint(self) -> dict[str, Any]:
        text = json.dumps(self.loop.value, sort_keys=True)
        law = self.loop.dynamics
        learned = {"dynamics": file_stamp(law.file)["sha256"]} if isinstance(law, LearnedDynamics) else {}
        return {
            **self.job.fingerprint,
            **learned,
            "network": file_stamp(self.loop.network)["sha256"],
            "loop": hashlib.sha256(text.encode()).hexdigest(),
            "network_arithmetic": self.model.arithmetic,
            "rules": _RULES,
        }


def _open(open_job: Callable[[], Job], value: dict[str, Any], folder: Path, arithmetic: NetworkArithmetic) -> LoopJob:
    require_sound_platform()
    job = LoopJob.__new__(LoopJob)
    job.loop, job.job = parse_loop(value, folder), open_job()
    job.network = load_network(job.loop.network, **job.loop.loading)
    job.model = NetworkModel(job.network, job.loop.preprocess, MEMORY, arithmetic)
    return job


def examine_cells(recipe: Recipe[LoopJob], number: int, grid: Grid, cells: tuple[Cell, ...]) -> LoopFindings:
    """Examine cells on a worker, which opens the files once and keeps them.

    Raises:
        InputError: The worker reads other files under the same names than the command did.
    """
    return examine_here(opened(recipe), number, grid, cells)


def examine_here(job: LoopJob, number: int, grid: Grid, cells: tuple[Cell, ...]) -> LoopFindings:
    """Examine cells in this process."""
    import torch

    use_threads(1)
    torch.set_num_threads(1)
    return job.search.examine(number, grid, cells)


@dataclass(frozen=True)
class ReachProgress:
    """Where a search stands: fractions of the initial box for the strongest question asked, and seconds.

    Attributes:
        safe, reaches: Fractions that are certified; None where it was not asked.
        falsified, open: Fractions for the strongest question.
        seconds: Time spent.
    """

    safe: float | None
    reaches: float | None
    falsified: float
    open: float
    seconds: float


class ReachRun:
    """The search of a loop, with its store and its report.

    Args:
        job: What is examined.
        folder: Output folder.
        settings: What the report says that was asked for.
        command: The command line, or the call.
    """

    def __init__(self, job: LoopJob, folder: Path, settings: Mapping[str, Any], command: tuple[str, ...]) -> None:
        self.job, self.folder, self.settings, self.command = job, folder, settings, command
        self.grids: dict[int, Grid] = {}
        self.rows: dict[int, list[dict[str, Any]]] = {}
        self.started = now()
        self.simulated: list[Run] = []
        self.tubes: list[dict[str, Any]] = []
        self.examples: list[dict[str, Any]] = []
        self.scene_margin: dict[str, Any] = {"skipped": NOT_ASKED, "kinds": []}
        self.film: dict[str, Any] | None = None
        self._strips: list[tuple[int, bytes]] = []
        elements = job.job.method.elements()
        self._outside = None if elements is None else Outside(elements)
        self.last = LastReport(folder)

    def run(
        self,
        engine: Callable[[ExitStack], Engine],
        budget: float,
        stop: StopRequest,
        *,
        resume: bool = False,
        on_open: Callable[[], object] = lambda: None,
        on_progress: Callable[[ReachProgress], object] = lambda progress: None,
        scene_margin: bool = False,
        on_margin: Callable[[SceneMargin], object] = lambda found: None,
        film: bool = False,
    ) -> dict[str, Any]:
        """Search, and write the results as they come; returns the content of report.json.

        Args:
            engine: Starts the engine, which ends with the stack.
            budget: Seconds.
            stop: Asked at least twice a second.
            resume: Whether to go on with what the folder holds.
            on_open: Called before the search, when there is a report.
            on_progress: Told about once a second.
            scene_margin: Whether to look for the largest variation of the scene for which what is certified holds, in
                half of the time.
            on_margin: Told what it is, kind by kind.
            film: Whether to make a film along the tube of a certified cell.

        Raises:
            InputError: The folder cannot be used.
        """
        searching = (1.0 - SHARE) * budget if scene_margin else budget
        job, box = self.job, self.job.loop.box
        filming = _FILM_SHARE * searching if film else 0.0
        parameters = list(zip(box.names, box.units, strict=True))
        with ExitStack() as stack:
            fixed: dict[int, dict[str, float]] = {number: {} for number in job.questions}
            # a signal waits until there is a store to report on
            store = Store(self.folder, job.fingerprint, parameters, fixed, resume=resume)
            stack.callback(store.close)
            stack.enter_context(store.told())
            stack.enter_context(stop.last_words(self.last.interrupted))
            try:
                self._begin(store, box)
                with stop.at_once():
                    # before kernels are compiled
                    self.report(store, "running")
                    on_open()
                    job.job.warm_up(0)
                begin = time.perf_counter()
                searched = begin + (1.0 - _SHOWN_SHARE) * searching - filming
                self._simulate(begin + _RUNS_SHARE * searching, stop)
                with ExitStack() as engines:
                    self._search(store, engine(engines), searched, stop, on_progress)
                self._show(store, begin + searching - filming, stop)
                if film:
                    self._film(store, begin + searching, stop)
                if scene_margin and not stop():
                    self._margins(store, begin + budget, stop, on_margin)
            finally:
                # also after a failure: what is finished is written
                store.finish(self.grids)
                document = self.report(store, "interrupted" if stop() else "budget" if store.open_blocks else "done")
        return document

    def _begin(self, store: Store, box: ParameterBox) -> None:
        for number in self.job.questions:
            grid = store.grid(number, box)
            if grid is None:
                grid = Grid.adaptive(box, [1] * box.dimensions)
                store.begin(number, grid, [grid.roots()])
            self.grids[number] = grid

    def _search(
        self,
        store: Store,
        engine: Engine,
        deadline: float,
        stop: StopRequest,
        on_progress: Callable[[ReachProgress], object],
    ) -> None:
        search_blocks(
            store,
            engine,
            self.grids,
            lambda *found: examine_here(self.job, *found),
            (examine_cells, self.job.recipe),
            deadline=deadline,
            stop=stop,
            keep=lambda block, findings: self._keep(store, block, findings),
            between=paced(store, lambda: on_progress(self.progress(store)), lambda: self.report(store, "running")),
        )
        store.trace()
        on_progress(self.progress(store))

    def progress(self, store: Store) -> ReachProgress:
        """Where the search stands."""
        shares = {QUESTIONS[tally.frame]: fractions(tally) for tally in store.tallies()}
        last = shares[list(shares)[-1]]
        known = {name: shares[name]["certified"] if name in shares else None for name in QUESTIONS}
        return ReachProgress(known["safe"], known["reaches"], last["falsified"], last["open"], store.seconds)

    def _keep(self, store: Store, block: Block, findings: LoopFindings) -> None:
        """Store runs that go wrong before their cells are said to be falsified."""
        for cell, run in findings.runs:
            place = "_".join(f"{a}-{b}" for a, b in zip(cell.first, cell.past, strict=True)) or "state"
            buffer = io.BytesIO()
            names = np.array(self.job.loop.names, str)
            np.savez(buffer, states=run.states, controls=run.controls, disturbances=run.disturbances, names=names)
            store.keep_image(f"{QUESTIONS[block.frame]}_{place}", buffer.getvalue())
            if len(self.examples) < _EXAMPLES:
                margin = run.margin(self.job.loop, QUESTIONS[block.frame])
                self.examples.append({"question": QUESTIONS[block.frame], "margin": margin, "states": run.states})

    # ---------------------------------------------------------------- report

    def _simulate(self, deadline: float, stop: StopRequest) -> None:
        """Random runs, the same ones every time."""
        loop, reacher = self.job.loop, self.job.search.reacher
        for number in range(_RUNS):
            generator = np.random.default_rng([17, number])
            start = loop.box.sample(1, generator)[0]
            if stop() or (self.simulated and time.perf_counter() >= deadline):
                return
            try:
                with abandoning(stop):
                    push = pushes(loop, generator, "random")
                    self.simulated.append(simulate(reacher, loop.state(loop.box, start), push))
            except AbandonedError:
                return

    def _show(self, store: Store, deadline: float, stop: StopRequest) -> None:
        """Tubes of a few certified cells beside simulated runs and what less dependence would give."""
        found = [row for number in self.job.questions for row in store.leaves(number, "certified")]
        if not found:
            return
        chosen = [found[len(found) * (2 * k + 1) // (2 * _SHOWN)] for k in range(_SHOWN)]
        for row in {json.dumps([row["lower"], row["upper"]]): row for row in chosen}.values():
            try:
                with abandoning(lambda: stop() or time.perf_counter() >= deadline):
                    self.tubes.append(shown_tube(self.job, row["lower"], row["upper"], _CELL_RUNS))
            except AbandonedError:
                return

    def _film(self, store: Store, deadline: float, stop: StopRequest) -> None:
        """Abstract images along the tube of the widest certified cell of the strongest question, or of the first."""
        job, steps, box = self.job, [], self.job.loop.box

        def strongest(kind: Verdict | None) -> list[dict[str, Any]]:
            return next((found for n in reversed(job.questions) if (found := store.leaves(n, kind))), [])

        def volume(row: dict[str, Any]) -> float:
            return float(np.prod(np.subtract(row["upper"], row["lower"])))

        row = max(strongest("certified"), key=volume, default=None) or next(iter(strongest(None)), None)
        if row is None:
            self.film = {"skipped": "no cell has a verdict"}
            return
        cell = ParameterBox(box.names, box.units, tuple(row["lower"]), tuple(row["upper"]))
        try:
            with abandoning(lambda: stop() or time.perf_counter() >= deadline):
                tube = job.search.reacher.tube(cell, whole=True)
                size = film_size(job.loop.preprocess.size(job.network.input_shape))
                for step in along(job.search.reacher, job.job.method, size, tube):
                    steps.append(step)
        except AbandonedError:
            pass
        if not steps:
            self.film = {"skipped": "the work was interrupted" if stop() else "the time ended first"}
            return
        found = made(steps, cell.lower, cell.upper, row["verdict"])
        ending, content = found.encoded()
        self.film = {"file": store.keep(f"film.{ending}", content).name, **found.about}
        self._strips = found.strips()

    def _margins(self, store: Store, deadline: float, stop: StopRequest, told: Callable[[SceneMargin], object]) -> None:
        """How far the scene may vary, for the strongest question of which anything is certified."""
        box = self.job.loop.box
        rows = {number: found for number in self.job.questions if (found := store.leaves(number, "certified"))}
        number = max(rows, default=0)
        cells = certified_cells(
            {number: rows.get(number, [])},
            lambda _, row: ParameterBox(box.names, box.units, tuple(row["lower"]), tuple(row["upper"])),
        )
        margins = Margins(cells, self.job.settle, store, told)
        try:
            places = [kind for kind in PLACES if self.job.places(kind)]
            margins.find(deadline, stop, (*KINDS, *CAMERA_KINDS, *places))
        finally:
            margins.keep()
            self.scene_margin = {"question": QUESTIONS[number], **margins.entry}

    def document(self, store: Store, state: str) -> dict[str, Any]:
        """Content of report.json."""
        job, loop = self.job, self.job.loop
        self.rows = {tally.frame: store.leaves(tally.frame) for tally in store.tallies()}
        entries = {QUESTIONS[tally.frame]: self._entry(tally) for tally in store.tallies()}
        program, scene = job.job.method.program, job.job.describe()
        learned: dict[str, Any] = {}
        if isinstance(loop.dynamics, LearnedDynamics):
            law = loop.dynamics
            learned = {"dynamics_model": file_stamp(law.file), "dynamics_guarantee": law.network.guarantee()}
        return plain(
            {
                "version": 1,
                "kind": "loop",
                "verdict": verdict(entries),
                "questions": entries,
                "guarantee": job.job.method.guarantee,
                "guarantee_text": guarantee_text(job.job.method.guarantee, program["name"], scene.get("bounded")),
                "network_guarantee": job.network.guarantee(job.model.arithmetic),
                "renderer": {name: program[name] for name in ("name", "version")},
                "scene": scene,
                "assumptions": [vars(entry) for entry in job.assumptions],
                "model": file_stamp(loop.network),
                "loop": loop.value,
                "dynamics": loop.dynamics.about,
                **learned,
                "parameters": [
                    {"name": n, "unit": u, "lower": a, "upper": b}
                    for n, u, a, b in zip(loop.box.names, loop.box.units, loop.box.lower, loop.box.upper, strict=True)
                ],
                "simulated_states": [run.states for run in self.simulated[:40]],
                "tubes": self.tubes,
                "film": self.film,
                "scene_margin": self.scene_margin,
                "falsifying": self.examples,
                "trace": store.points,
                "seconds": store.seconds,
                "effort": store.effort,
                "unknown_because": store.reasons,
                "cells_seal": {"rows": store.seal.rows, "sum": store.seal.text},
                "plan": job.job.plan,
                "state": state,
                "metrics": METRICS,
                "settings": self.settings,
                "fingerprint": job.fingerprint,
                "command": self.command,
                "packages": versions(),
                "started": self.started,
                "updated": now(),
            }
        )

    def _entry(self, tally: Tally) -> dict[str, Any]:
        question, shares = QUESTIONS[tally.frame], fractions(tally)
        rows = self.rows[tally.frame]
        kinds = ("certified", "falsified", "unknown")
        went_well = sum(run.margin(self.job.loop, question) > 0.0 for run in self.simulated)
        count = len(self.simulated)
        return {
            "text": SENTENCES[question],
            "certified": shares["certified"],
            "falsified": shares["falsified"],
            "unknown": shares["unknown"] + shares["open"],
            "not_examined": shares["open"],
            "cells": {kind: sum(row["verdict"] == kind for row in rows) for kind in kinds},
            "simulated": {"runs": count, "went_well": went_well / count if count else None},
            "certified_of_went_well": shares["certified"] * count / went_well if went_well else None,
            "least_margin": min((row["margin"] for row in rows if row["verdict"] == "certified"), default=None),
        }

    def report(self, store: Store, state: str) -> dict[str, Any]:
        """Write report.json and report.html; returns the former's content."""
        document = self.document(store, state)
        self.last.write(document, lambda: loop_page(document, self.rows, self.job.loop, self._outside, self._strips))
        return document


def verdict(entries: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the verdict over the whole initial box: falsified, reaches, safe or unknown."""
    if any(entry["cells"]["falsified"] for entry in entries.values()):
        return "falsified"
    done = [name for name, entry in entries.items() if entry["unknown"] == 0.0 and entry["cells"]["certified"]]
    return done[-1] if done else "unknown"


def shown_tube(job: LoopJob, lower: list[float], upper: list[float], runs: int) -> dict[str, Any]:
    """A tube beside the hull of simulated runs, and its widths with less dependence.

    Args:
        job: The loop.
        lower, upper: [m] the cell.
        runs: How many.
    """
    box = ParameterBox(job.loop.box.names, job.loop.box.units, tuple(lower), tuple(upper))
    kept = job.search.reacher
    tube = kept.tube(box, whole=True)
    generator = np.random.default_rng(5)
    starts = [*box.corners(), *box.sample(max(0, runs - 2**box.dimensions), generator)]
    found = [simulate(kept, job.loop.state(box, start), pushes(job.loop, generator, "ends")) for start in starts]
    states = np.stack([run.states for run in found])
    modes: tuple[Dependence, ...] = ("step", "none")
    hulls = [entry.hull() for entry in tube.sets]
    return {
        "lower": list(box.lower),
        "upper": list(box.upper),
        "tube": [[low.tolist(), high.tolist()] for low, high in hulls],
        "camera": [[end.tolist() for end in kept.places(entry)] for entry in tube.sets],
        "runs": len(found),
        "hull": [
            [low.tolist(), high.tolist()] for low, high in zip(states.min(axis=0), states.max(axis=0), strict=True)
        ],
        "width": widths(tube),
        "width_simulated": (states.max(axis=0) - states.min(axis=0)).mean(axis=1).tolist(),
        "width_by_dependence": {mode: widths(job.reacher(mode).tube(box, whole=True)) for mode in modes},
        "reason": tube.reason,
    }


def widths(tube: Tube) -> list[float]:
    """Return the mean width over the states of a tube, step by step, as far as the tube goes."""
    return [float(np.mean(np.subtract(*entry.hull()[::-1]))) for entry in tube.sets]


@dataclass(frozen=True)
class ReachCell:
    """A cell of the initial box.

    Attributes:
        question: "safe" or "reaches".
        lower, upper: Ends of its box, in the order of `ReachResult.parameters`.
        verdict: "certified", "falsified" or "unknown".
        margin: Proved lower bound of the distance to going wrong; that of the falsifying run; or None.
        start: Initial parameters of the falsifying run, or None.
    """

    question: str
    lower: np.ndarray
    upper: np.ndarray
    verdict: str
    margin: float | None
    start: np.ndarray | None


@dataclass(frozen=True)
class ReachResult:
    """The result of a loop: what was proved and falsified of its runs.

    Attributes:
        safe, reaches: Fractions of the initial box's volume that are certified to be so; None where it was not asked.
        falsified: Fraction in cells with a run that goes wrong, for the strongest question asked.
        verdict: Of the whole box: "falsified", "reaches", "safe" or "unknown".
        cells: What the fractions are made of.
        parameters: Names and units of the cells' axes.
        state: "done", "budget" (the time ended first) or "interrupted".
        seconds: Time spent.
        report: Content of report.json.
    """

    safe: float | None
    reaches: float | None
    falsified: float
    verdict: str
    cells: tuple[ReachCell, ...] = field(repr=False)
    parameters: tuple[tuple[str, str], ...]
    state: str
    seconds: float
    report: dict[str, Any] = field(repr=False)

    @property
    def assumptions(self) -> tuple[Assumption, ...]:
        """What the verdict rests on, and where each choice came from."""
        return tuple(Assumption(**entry) for entry in self.report["assumptions"])


def reach(
    scene: Scene,
    loop: str | os.PathLike[str],
    *,
    time_budget: float = 600.0,
    output_dir: str | os.PathLike[str] | None = None,
    arithmetic: str | None = None,
    network_arithmetic: NetworkArithmetic = "float32",
    resume: bool = False,
    on_progress: Callable[[ReachProgress], object] | None = None,
    workers: int = 1,
    engine: EngineName = "local",
    scheduler_address: str | None = None,
    scene_margin: bool = False,
    film: bool = False,
) -> ReachResult:
    """Prove of a network in the loop that no run from a box of initial states goes wrong, or find one that does.

    Ctrl-C and ``on_progress`` returning False end the work between two cells, with what is known.

    Args:
        scene: The scene.
        loop: LOOP.json.
        time_budget: Seconds.
        output_dir: Folder for cells.sqlite, the report and falsifying runs; None: nothing is kept on disk.
        arithmetic: "float32" or "real", of the pictures; None: float32.
        network_arithmetic: "float32": every float32 evaluation of the network; "real": the exact network alone.
        resume: Whether to go on with what ``output_dir`` holds.
        on_progress: Told about once a second.
        workers: Processes; with more than one, a script needs ``if __name__ == "__main__":``.
        engine: "dask" spreads the cells over a Dask cluster.
        scheduler_address: HOST:PORT of its scheduler; None: a cluster on this machine.
        scene_margin: Whether to look, in half of the time, for the largest variation of the Gaussians for which what is
            certified holds; see the report's key ``scene_margin``.
        film: Whether to write, in a tenth of the time, film.mp4 (film.gif without the package av) into ``output_dir``:
            the abstract image along the tube of the widest certified cell; see the report's key ``film``.

    Raises:
        InputError: An argument cannot be used.
    """
    if not 0.0 < time_budget < float("inf"):
        raise InputError(f"found {time_budget}", field="time_budget", fix="give a positive number")
    if workers < 1:
        raise InputError(f"found {workers}", field="workers", fix="give a number of at least 1")
    if resume and output_dir is None:
        raise InputError("given without output_dir", field="resume", fix="give the folder to go on with")
    job = open_loop(scene, Path(loop), arithmetic, network_arithmetic, workers)
    settings = {"time_budget": time_budget, "arithmetic": arithmetic, "workers": workers, "engine": engine}
    with ExitStack() as stack:
        folder = Path(output_dir) if output_dir is not None else Path(
            stack.enter_context(tempfile.TemporaryDirectory(prefix="ns-abstract-"))
        )  # fmt: skip
        stop = stack.enter_context(interruptible())
        run = ReachRun(job, folder, settings, ("ns_abstract.reach",))
        document = run.run(
            lambda engines: engines.enter_context(started(engine, scheduler_address, workers)),
            time_budget,
            stop,
            resume=resume,
            on_progress=listener(stop, on_progress),
            scene_margin=scene_margin,
            film=film,
        )
    return result(run, document)


def open_loop(
    scene: Scene,
    file: Path,
    arithmetic: str | None = None,
    network_arithmetic: NetworkArithmetic = "float32",
    workers: int = 1,
) -> LoopJob:
    """Open LOOP.json with its network.

    Raises:
        InputError: A file or a field cannot be used, or there is not the memory for ``workers`` processes.
    """
    loop = load_loop(file)
    try:
        job = LoopJob(scene, loop, arithmetic, network_arithmetic)
        dimensions = job.job.pose_sets[0].box.dimensions
        check_cell(job.network, dimensions, job.job.memory / workers, "fewer --workers")
        return job
    except InputError as error:
        raise error.within(file) if error.field and not error.field.startswith("--") else error from None


def result(run: ReachRun, document: Mapping[str, Any]) -> ReachResult:
    """The result of a search that has ended."""
    cells = [
        ReachCell(
            QUESTIONS[number],
            np.array(row["lower"], np.float64),
            np.array(row["upper"], np.float64),
            row["verdict"],
            row["margin"],
            None if row["counterexample"] is None else np.array(row["counterexample"], np.float64),
        )
        for number, rows in sorted(run.rows.items())
        for row in rows
    ]
    entries = document["questions"]
    known = {name: entries[name]["certified"] if name in entries else None for name in QUESTIONS}
    return ReachResult(
        safe=known["safe"],
        reaches=known["reaches"],
        falsified=list(entries.values())[-1]["falsified"],
        verdict=document["verdict"],
        cells=tuple(cells),
        parameters=tuple(zip(run.job.loop.box.names, run.job.loop.box.units, strict=True)),
        state=document["state"],
        seconds=document["seconds"],
        report=dict(document),
    )
