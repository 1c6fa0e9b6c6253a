"""Searches for proofs and counterexamples over a box of initial states (docs/dev/design.md, L5).

Two questions have cells of their own: do all runs stay out of the unsafe sets ("safe"), and do they also reach the
goal ("reaches")? The outcome of a cell depends on the cell alone.
"""

from __future__ import annotations

import itertools
import math
import time
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.io.errors import InputError
from ns_abstract.reach.loop import Loop
from ns_abstract.reach.tubes import Tube, TubeBuilder
from ns_abstract.refine.protocol import SceneSample
from ns_abstract.verify.cells import Cell, CellGrid
from ns_abstract.verify.scene_margin import CellOutcome
from ns_abstract.verify.search_results import FAILURES, BlockResult, ContradictionError, FinishedCell, failure_text

Float64 = NDArray[np.float64]
Question = Literal["safe", "reaches"]
#: The questions by the number that they have in the store.
QUESTIONS: tuple[Question, ...] = ("safe", "reaches")

#: Runs before a tube is computed, beside the one from the middle; and after it: from corners, and from elsewhere.
_EARLY, _CORNERS, _RANDOM = 2, 2, 1
#: Runs of the search for a smaller margin where a cell is proved and where not, and its first step as a part of the
#: cell.
_STEPS, _STEPS_OPEN, _FIRST_STEP = 3, 1, 0.25
#: Scenes of a set that are shown where a cell is not proved; one of them where it is.
_SCENES = 20
#: Ranks of cells, as in `ns_abstract.verify.search`: nothing is known; some run goes wrong.
_RANK_UNKNOWN, _RANK_BROKEN = 1e6, 2e3
#: Tubes and runs kept for the other question.
_KEPT, _KEPT_RUNS = 256, 4096
#: Parts that a cell is cut into, at most and where its tube ends before this part of the steps; what the cuts aim at.
_FEW, _MANY, _SOON = 2, 8, 0.75
_SHRINK = {_FEW: 1.0, _MANY: 0.5}


@dataclass(frozen=True, eq=False)
class SimulatedRun:
    """A simulated run of the loop.

    Attributes:
        states: [steps + 1, n] float64.
        controls: [steps, m].
        disturbances: [steps, n] that were added to the next states.
        views: [steps + 1, properties] margins of the pictures at these states; see `Loop.views`.
    """

    states: Float64
    controls: Float64
    disturbances: Float64
    views: Float64

    def margin(self, loop: Loop, question: Question) -> float:
        """Return the run's margin (L7): not positive where it fails. Its sign is exact; NaN where it is no number."""
        if not np.isfinite(self.states).all():
            return math.nan
        states = self.states.tolist()
        clearances: list[Any] = [max(face.exact(x) for face in faces) for x in states for faces in loop.unsafe]
        clearances += self.views[:, : len(loop.required)].ravel().tolist()
        if question == "reaches":
            assert loop.goal is not None
            steps = loop.goal.steps(loop.steps)
            if loop.goal.view is None:
                depths = [min(face.exact(states[k]) for face in loop.goal.faces) for k in steps]
            else:
                depths = self.views[steps, -1].tolist()
            # a picture that is no number says nothing, whatever else the run shows
            clearances += [math.nan] if any(map(_is_nan, depths)) else [max(depths)]
        if any(map(_is_nan, clearances)):
            return math.nan
        return float(min(clearances)) if clearances else math.inf


def simulate(
    reacher: TubeBuilder,
    start: Float64,
    disturbances: Float64,
    scene_sample: SceneSample | None = None,
    off: Float64 | None = None,
) -> SimulatedRun:
    """Return one run with the real renderer and the deployed network; everything else is float64.

    Args:
        disturbances: [steps, n], added to every next state.
        scene_sample: The scene that is rendered throughout; None: the stored one.
        off: The scene's offset throughout, as in `TubeBuilder.seen_from`; None: it is in its place.
    """
    loop = reacher.loop
    more = () if scene_sample is None else (scene_sample,)
    states, controls = [np.asarray(start, np.float64)], []
    margins = np.full((loop.steps + 1, len(reacher.views)), np.nan)
    with np.errstate(all="ignore"):
        for push in disturbances:
            x = states[-1]
            if not np.isfinite(x).all():
                break
            pose = reacher.seen_from(x, off)
            u = reacher.pilot.concrete(reacher.view.image(pose, *more))
            controls.append(u)
            states.append(loop.dynamics.step(x, u) + push)
    for k, x in enumerate(states):
        if reacher.views and np.isfinite(x).all():
            margins[k] = [view.margin(reacher.seen_from(x, off)) for view in reacher.views]
    missing = loop.steps + 1 - len(states)
    lost = np.full((missing, len(start)), np.nan)
    empty = np.full((loop.steps - len(controls), loop.dynamics.controls), np.nan)
    return SimulatedRun(
        np.concatenate([np.stack(states), lost]),
        np.concatenate([np.array(controls).reshape(-1, loop.dynamics.controls), empty]),
        np.asarray(disturbances, np.float64),
        margins,
    )


def _is_nan(value: Any) -> bool:
    return isinstance(value, float) and math.isnan(value)


def sampled_disturbances(
    loop: Loop, generator: np.random.Generator, kind: Literal["middle", "ends", "random"]
) -> Float64:
    """Return disturbances [steps, n] in their box: the middle, one corner throughout, or random values."""
    low, high = loop.disturbance
    shape = loop.steps, len(low)
    if kind == "middle":
        disturbances = np.broadcast_to(0.5 * (low + high), shape)
    elif kind == "ends":
        disturbances = np.broadcast_to(np.where(generator.random(len(low)) < 0.5, low, high), shape)
    else:
        disturbances = low + generator.random(shape) * (high - low)
    return np.clip(disturbances, low, high)


@dataclass(frozen=True)
class LoopBlockResult(BlockResult):
    """The result of a block of cells."""

    runs: tuple[tuple[Cell, SimulatedRun], ...] = ()


@dataclass
class _CellRuns:
    """Simulated runs that start in one cell, with their margins."""

    cell: Cell
    box: ParameterBox
    starts: list[Float64] = field(default_factory=list)
    runs: list[SimulatedRun] = field(default_factory=list)
    margins: list[float] = field(default_factory=list)

    @property
    def worst(self) -> int:
        return int(np.argmin(np.where(np.isfinite(self.margins), self.margins, np.inf)))

    @property
    def broken(self) -> int:
        return sum(math.isfinite(margin) and margin <= 0.0 for margin in self.margins)

    @property
    def undecided(self) -> int:
        return sum(math.isnan(margin) for margin in self.margins)


class LoopSearch:
    """Proves or refutes a question for cells of the initial box."""

    def __init__(self, reacher: TubeBuilder) -> None:
        self.reacher, self.loop = reacher, reacher.loop
        self._tubes: OrderedDict[ParameterBox, Tube | str] = OrderedDict()
        self._runs: OrderedDict[bytes, SimulatedRun] = OrderedDict()

    def tube(self, box: ParameterBox) -> Tube | str:
        """Return the tube of a cell, from a small cache, or the reason why there is none."""
        if box not in self._tubes:
            while len(self._tubes) >= _KEPT:
                self._tubes.popitem(last=False)
            try:
                self._tubes[box] = self.reacher.tube(box)
            except InputError:
                raise
            except FAILURES as error:
                self._tubes[box] = failure_text(error)
        return self._tubes[box]

    def proved(self, tube: Tube, question: Question) -> float:
        """Return a lower bound of the margin of all runs in a tube; minus infinity where none is known (L5)."""
        if (
            tube.reason
            or len(tube.state_sets) != self.loop.steps + 1
            or not all(step.finite for step in tube.state_sets)
        ):
            return -math.inf
        clearance = tube.safe(self.loop)
        if question == "reaches":
            goal = self.loop.goal
            assert goal is not None
            steps = goal.steps(self.loop.steps)
            # some one step is in the goal for all runs
            depths = [tube.inside(k, goal.faces) if goal.view is None else float(tube.views[k, -1]) for k in steps]
            clearance = min(clearance, max(depths))
        return clearance if math.isfinite(clearance) or clearance == math.inf else -math.inf

    def _scenes(self, generator: np.random.Generator) -> Iterator[tuple[SceneSample | None, Float64 | None]]:
        """Yield scenes of the set without end: scene samples, or offsets of the stored scene, corners first."""
        reach = self.reacher.place if self.reacher.place.size else self.reacher.shift
        if not reach.any():
            yield from ((scene_sample, None) for scene_sample in self.reacher.view.scene_samples(0))
            return
        for signs in itertools.product((-1.0, 1.0), repeat=int(np.count_nonzero(reach))):
            corner = reach.copy()
            corner[reach > 0.0] *= signs
            yield None, corner
        while True:
            yield None, generator.uniform(-1.0, 1.0, len(reach)) * reach

    def prove_cell(self, question: Question, box: ParameterBox) -> CellOutcome:
        """Return the outcome of an undivided cell for all scenes of the set: its tube, and runs in some scenes (V13).

        Raises:
            ContradictionError: A run leaves its tube: the program has a fault.
        """
        tube = self.tube(box)
        has_tube = not isinstance(tube, str)
        bound = self.proved(tube, question) if has_tube else -math.inf
        proved, width = bound > 0.0, np.array(box.upper) - np.array(box.lower)
        generator = np.random.default_rng(np.frombuffer(np.array(box.lower + box.upper).tobytes(), np.uint32))
        starts = [box.middle, np.array(box.lower), np.array(box.upper)]
        first = int(generator.integers(_SCENES)) if proved else 0
        scenes = itertools.islice(self._scenes(generator), first, first + 1 if proved else _SCENES)
        for number, (scene_sample, off) in enumerate(scenes):
            state = self.loop.state(box, starts[number % len(starts)])
            push = sampled_disturbances(self.loop, generator, "ends" if number % 2 else "middle")
            run = simulate(self.reacher, state, push, scene_sample, off)
            outside = first_outside(tube, run) if has_tube else None
            margin = run.margin(self.loop, question)
            if outside is not None or (proved and margin <= 0.0):
                raise ContradictionError(
                    f"internal error: in a scene, the run from {state.tolist()} has the margin {margin}, proved to be "
                    f"at least {bound}; outside: {outside}"
                )
            if math.isnan(margin):
                return CellOutcome("unknown", "the states of a run are no finite numbers", width)
            if (
                margin <= 0.0
                and simulate(self.reacher, state, push, scene_sample, off).margin(self.loop, question) <= 0.0
            ):
                arrays = {"states": run.states, "controls": run.controls, "disturbances": run.disturbances}
                arrays |= {"names": np.array(self.loop.names, str)}
                varied = {} if scene_sample is None else scene_sample.arrays
                arrays |= {f"scene_{name}": array for name, array in varied.items()}
                arrays |= {} if off is None else {"place" if self.reacher.place.size else "shift": off}
                return CellOutcome("falsified", "a run goes wrong", width, arrays)
        if proved:
            return CellOutcome("holds", "", width)
        reason = tube.reason if has_tube else str(tube)
        slopes = tube.slopes if has_tube and tube.slopes.any() else width
        return CellOutcome("unknown", reason or "the margin's bound is not above 0", slopes)

    def examine(self, number: int, grid: CellGrid, block: Sequence[Cell]) -> LoopBlockResult:
        """Return the outcomes of cells for a question.

        Raises:
            ContradictionError: A run leaves its tube: the program has a fault.
            WorkCancelledError: The deadline is over (`ns_abstract.execution.cancellation`).
        """
        question = QUESTIONS[number]
        begin = time.perf_counter()
        leaves: list[FinishedCell] = []
        children: list[tuple[float, Cell]] = []
        samples: list[tuple[Cell, bool]] = []
        runs: list[tuple[Cell, SimulatedRun]] = []
        bounded = 0
        for cell in block:
            begun = time.perf_counter()
            cell_runs, bound, reason, slopes, parts = self._one(question, grid, cell)
            bounded += bound is not None
            samples.append((cell, cell_runs.margins[0] > 0.0))
            seconds = time.perf_counter() - begun
            if bound is not None and bound > 0.0 and not cell_runs.undecided:
                # without unsafe sets nothing can go wrong, which is as good as any number
                leaves.append(FinishedCell(cell, "certified", min(bound, 1e300), seconds))
                continue
            if cell_runs.undecided:
                reason = "the states of a run are no finite numbers"
            hopeless = cell_runs.broken + cell_runs.undecided == len(cell_runs.margins)
            if cell.volume > 1 and not hopeless:
                rank = self._rank(cell_runs, bound, cell.volume / grid.volume)
                children += [(rank, part) for part in grid.divide(cell, slopes, _SHRINK[parts], parts)]
            elif cell_runs.broken:
                leaf, run = self._counterexample(question, cell_runs, seconds)
                leaves.append(leaf)
                if leaf.verdict == "falsified":
                    runs.append((cell, run))
            else:
                leaves.append(FinishedCell(cell, "unknown", None, seconds, reason=reason or "the finest cell"))
        return LoopBlockResult(
            tuple(leaves),
            tuple((cell,) for _, cell in children),
            tuple(samples),
            bounded,
            time.perf_counter() - begin,
            tuple(rank for rank, _ in children),
            tuple(runs),
        )

    def _one(self, question: Question, grid: CellGrid, cell: Cell) -> tuple[_CellRuns, float | None, str, Float64, int]:
        """Return a cell's runs, proved margin or None, the reason, gains [m] of cuts by parameter, number of parts."""
        box = grid.box_of(cell)
        cell_runs, generator = _CellRuns(cell, box), np.random.default_rng([*cell.first, *cell.past])
        self._run(question, cell_runs, box.middle, sampled_disturbances(self.loop, generator, "middle"))
        for end in (box.lower, box.upper)[: _EARLY if box.dimensions else 0]:
            self._run(question, cell_runs, np.array(end), sampled_disturbances(self.loop, generator, "ends"))
        width = np.array(box.upper) - np.array(box.lower)
        if cell_runs.broken or cell_runs.undecided:
            return cell_runs, None, "", width, _FEW
        tube = self.tube(box)
        if isinstance(tube, str):
            return cell_runs, None, tube, width, _FEW
        bound = self.proved(tube, question)
        # no proof is believed without an attack, and no doubt is left without one
        proved = bound > 0.0
        for _ in range(_CORNERS if box.dimensions and proved else 1):
            corner = np.where(generator.random(box.dimensions) < 0.5, box.lower, box.upper)
            self._run(question, cell_runs, corner, sampled_disturbances(self.loop, generator, "ends"))
        for start in box.sample(_RANDOM, generator):
            self._run(question, cell_runs, start, sampled_disturbances(self.loop, generator, "random"))
        self._descend(question, cell_runs, generator, _STEPS if proved else _STEPS_OPEN)
        for start, run in zip(cell_runs.starts, cell_runs.runs, strict=True):
            outside = first_outside(tube, run)
            if outside is not None:
                raise ContradictionError(f"internal error: the run from {start.tolist()} leaves its tube at {outside}")
        if proved and cell_runs.broken:
            raise ContradictionError(
                f"internal error: margin proved to be at least {bound} from {box.lower} to {box.upper}, found "
                f"{cell_runs.margins[cell_runs.worst]} from {cell_runs.starts[cell_runs.worst].tolist()}"
            )
        slopes = tube.slopes if tube.slopes.any() else width
        # a tube that ends far from the end is far too wide
        parts = _MANY if tube.reason and len(tube.state_sets) < _SOON * self.loop.steps else _FEW
        return cell_runs, bound if bound > -math.inf else None, tube.reason, slopes, parts

    def _run(self, question: Question, cell_runs: _CellRuns, start: Float64, disturbances: Float64) -> float:
        state = self.loop.state(cell_runs.box, start)
        key = state.tobytes() + disturbances.tobytes()
        if key not in self._runs:
            while len(self._runs) >= _KEPT_RUNS:
                self._runs.popitem(last=False)
            self._runs[key] = simulate(self.reacher, state, disturbances)
        run = self._runs[key]
        cell_runs.starts.append(start)
        cell_runs.runs.append(run)
        cell_runs.margins.append(run.margin(self.loop, question))
        return cell_runs.margins[-1]

    def _descend(self, question: Question, cell_runs: _CellRuns, generator: np.random.Generator, steps: int) -> None:
        """Search for a lower margin by random steps from the worst start, each kept where the margin falls."""
        box = cell_runs.box
        if not box.dimensions or cell_runs.broken:
            return
        low, high = np.array(box.lower), np.array(box.upper)
        best, step = cell_runs.worst, _FIRST_STEP
        for _ in range(steps):
            turn = generator.standard_normal(box.dimensions)
            start = np.clip(cell_runs.starts[best] + step * turn * (high - low), low, high)
            if self._run(question, cell_runs, start, cell_runs.runs[best].disturbances) < cell_runs.margins[best]:
                best = len(cell_runs.starts) - 1
            else:
                step *= 0.5

    def _rank(self, cell_runs: _CellRuns, bound: float | None, share: float) -> float:
        """Return how many times the bound misses the least margin of the runs; cells nearest to a proof come first."""
        if cell_runs.broken:
            return _RANK_BROKEN - math.log2(share)
        margin = cell_runs.margins[cell_runs.worst]
        if bound is None or not 0.0 < margin < math.inf:
            return 10.0 - math.log2(share) if bound is None else _RANK_UNKNOWN * (1.0 + share)
        return min((margin - bound) / margin, _RANK_UNKNOWN)

    def _counterexample(
        self, question: Question, cell_runs: _CellRuns, seconds: float
    ) -> tuple[FinishedCell, SimulatedRun]:
        """Return the falsified cell and its worst run, simulated once more."""
        start, old = cell_runs.starts[cell_runs.worst], cell_runs.runs[cell_runs.worst]
        run = simulate(self.reacher, self.loop.state(cell_runs.box, start), old.disturbances)
        margin = run.margin(self.loop, question)
        low, high = self.loop.disturbance
        inside = cell_runs.box.contains(start) and bool(((low <= run.disturbances) & (run.disturbances <= high)).all())
        if not (margin <= 0.0 and inside):
            return FinishedCell(
                cell_runs.cell, "unknown", None, seconds, reason="a run that goes wrong was not confirmed"
            ), run
        leaf = FinishedCell(cell_runs.cell, "falsified", margin, seconds, counterexample=tuple(start.tolist()))
        return leaf, run


def first_outside(tube: Tube, run: SimulatedRun) -> str | None:
    """Return a sentence on a run's first state or control outside of a tube (no tolerance); None if all are inside."""
    for step, entry in enumerate(tube.state_sets):
        if not entry.finite:
            return None
        low, high = entry.hull()
        state = run.states[step]
        if not ((low <= state) & (state <= high)).all():
            return f"step {step}: {state.tolist()} not in {low.tolist()} to {high.tolist()}"
    for step, least in enumerate(tube.views):
        if (run.views[step] < least).any():
            return f"step {step}: margins of pictures {run.views[step].tolist()} below {least.tolist()}"
    for step, (low, high) in enumerate(tube.controls):
        if not ((low <= run.controls[step]) & (run.controls[step] <= high)).all():
            return f"the control of step {step}"
    return None
