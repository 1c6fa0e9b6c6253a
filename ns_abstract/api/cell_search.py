"""The search for verdicts on cells, the same for every question: open, examine, split, store, report.

A `CellQuestion` states the claim, with a margin that is positive where it holds; `CellSearch` does the rest.
"""

from __future__ import annotations

import io
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from ns_abstract.api.margins import NOT_ASKED, SHARE, Margins, certified_cells
from ns_abstract.arithmetic.kernel_cache import store as kernels
from ns_abstract.execution.cancellation import Deadline, WorkCancelledError, cancel_when
from ns_abstract.execution.engines import Engine
from ns_abstract.execution.scheduler import Task, work
from ns_abstract.execution.stopping import StopRequest
from ns_abstract.execution.threads import use_threads
from ns_abstract.execution.worker_cache import Recipe, load
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.io.errors import InputError
from ns_abstract.io.folder import first_command
from ns_abstract.report.certificate import LastReport
from ns_abstract.report.figures import percent
from ns_abstract.verify.cells import Cell, CellGrid
from ns_abstract.verify.scene_margin import ProveCell, SceneMargin, VariationKind
from ns_abstract.verify.search_results import BlockResult
from ns_abstract.verify.store import CellBlock, Store

P = TypeVar("P")
C = TypeVar("C")
#: A row of ``cells``, JSON read: see `Store.leaves`.
Row = dict[str, Any]
#: Seconds between notes of progress, and between reports.
_TRACE, _REPORT = 1.0, 30.0
#: Examines cells of a grid of the frame with this number.
Examine = Callable[[int, CellGrid, tuple[Cell, ...]], BlockResult]


@dataclass(frozen=True, kw_only=True)
class SearchProgress:
    """Progress of a search: its time, to which subclasses add fractions of the set.

    Attributes:
        elapsed: Seconds of this search; earlier ones that it continues are not counted.
        total_budget: Seconds that it may take.
    """

    elapsed: float = 0.0
    total_budget: float = math.inf


def shares_text(certified: float, falsified: float, unknown: float, not_examined: float) -> str:
    """Return a sentence with the four fractions of a set's volume, which sum to 1."""
    parts = {"certified": certified, "falsified": falsified, "unknown": unknown, "not examined": not_examined}
    return ", ".join(f"{name} {percent(part)}" for name, part in parts.items())


class Examiner(Protocol):
    """Bounds and attacks cells to find their verdicts; every process that examines cells opens one."""

    @property
    def fingerprint(self) -> Mapping[str, Any]:
        """Identity of scene, network and settings; a stored search with another fingerprint is not continued."""
        ...

    @property
    def recipe(self) -> Recipe[Any]:
        """Recipe by which another process opens the same examiner."""
        ...

    def examine(self, number: int, grid: CellGrid, cells: tuple[Cell, ...]) -> BlockResult:
        """Return verdicts on cells of the set with this number, and smaller cells in place of those without one.

        Depends on the cells alone. "certified" means a proved lower bound above 0 of the margin of every picture.
        Raises WorkCancelledError if the time is over.
        """
        ...


def examine_here(examiner: Examiner, number: int, grid: CellGrid, cells: tuple[Cell, ...]) -> BlockResult:
    import torch

    # as many workers as cores; more threads would only wait for each other
    use_threads(1)
    torch.set_num_threads(1)
    return examiner.examine(number, grid, cells)


def examine_block(recipe: Recipe[Any], number: int, grid: CellGrid, cells: tuple[Cell, ...]) -> BlockResult:
    """Examine cells on a worker, which opens the files once and keeps them.

    Raises:
        InputError: The worker reads other files under the same names than the command did.
    """
    return examine_here(load(recipe), number, grid, cells)


class CellQuestion(ABC, Generic[P]):
    """A claim with a margin about sets of poses, each under a number, and the report on it.

    Args:
        parameters: Names and units of the parameters of all sets together.
        fixed: By number, the values of parameters that do not vary in it.
    """

    #: Whether one block is waited for however late it is, so that resuming with any budget gets on.
    finish_one = True
    #: Where cells are kept.
    store: type[Store] = Store

    def __init__(
        self,
        examiner: Examiner,
        parameters: Sequence[tuple[str, str]],
        sets: Mapping[int, ParameterBox],
        fixed: Mapping[int, Mapping[str, float]],
    ) -> None:
        self.examiner, self.parameters = examiner, list(parameters)
        self.sets, self.fixed = dict(sets), fixed

    def grid(self, number: int) -> CellGrid:
        """Return the grid of cells with which the search of a set begins; by default the set is one cell."""
        return CellGrid.adaptive(self.sets[number], [1] * self.sets[number].dimensions)

    def first_blocks(self, number: int, grid: CellGrid) -> list[list[Cell]]:
        """Return the blocks of cells that the search of a set examines first."""
        return [grid.roots()]

    def stored_set(self, number: int) -> ParameterBox | None:
        """Return the box of a set that the stored, earlier search had under this number, or None."""
        return None

    def counterexamples(self, number: int, grid: CellGrid, findings: Any) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield file names and arrays of the counterexamples of a block's falsified cells."""
        return iter(())

    def check(self, request: Request) -> None:
        """Raise InputError, before anything is written, if this question cannot do what ``request`` asks."""

    def reserved(self, seconds: float) -> float:
        """Return how many of ``seconds``, for search and report together, are reserved for `after`."""
        return 0.0

    def opened(self, search: CellSearch[P]) -> None:
        """Called once the store is open, before a signal can end the search: stores values for the last report."""

    def prepare(self, search: CellSearch[P], request: Request) -> None:
        """Called before the first cell is examined, outside of the time budget; a signal ends it at once."""
        search.report("running")
        request.on_open(search.store)

    def before(self, search: CellSearch[P], deadline: Deadline) -> None:
        """Called at the start of the time budget, before cells are examined."""

    def after(self, search: CellSearch[P], deadline: Deadline) -> None:
        """Called after the search, in the reserved time: computes more results from the verdicts."""

    def finish(self, search: CellSearch[P]) -> None:
        """Called before the last report is written, also after a failure."""

    def varied_scenes(self) -> tuple[Sequence[VariationKind], Callable[[VariationKind], ProveCell]] | None:
        """Return kinds of variations of the scene, and a maker of cell provers under one (V13); None: unsupported."""
        return None

    def margin_rows(self, rows: dict[int, list[Row]]) -> tuple[dict[int, list[Row]], dict[str, Any]]:
        """Return the certified rows for which a scene margin is computed, and entries to add to report.json."""
        return rows, {}

    @abstractmethod
    def progress(self, store: Store) -> P:
        """Return the progress, read from the store."""

    @abstractmethod
    def report(self, search: CellSearch[P], state: str) -> dict[str, Any]:
        """Write report.json and report.html with `CellSearch.last`; returns the former's content."""


@dataclass(frozen=True)
class Request:
    """What a search is to do in ``budget`` seconds.

    ``scene_margin``: whether to use half of the time to find the largest variation of the scene under which every
    certified cell stays certified. ``rows``: whether the cells are read back at the end. ``on_open`` is called with the
    store before the search, when there is a report.
    """

    budget: float
    resume: bool = False
    report: bool = True
    scene_margin: bool = False
    on_open: Callable[[Store], object] = lambda store: None
    on_progress: Callable[[Any], object] = lambda progress: None
    on_margin: Callable[[SceneMargin], object] = lambda margin: None
    rows: bool = True


@dataclass
class CellSearch(Generic[P]):
    """The search for verdicts on a question's cells.

    ``store`` is ``cells.sqlite``, from `open` on; ``last`` writes the report, also when the process is ended;
    ``scene_margin`` is the entry of report.json of that name; after ``deadline`` the report gets no more pictures.
    """

    question: CellQuestion[P]
    folder: Path
    grids: dict[int, CellGrid] = field(default_factory=dict)
    rows: dict[int, list[Row]] = field(default_factory=dict)
    scene_margin: dict[str, Any] = field(default_factory=lambda: {"skipped": NOT_ASKED, "kinds": []})
    deadline: Deadline = field(default_factory=Deadline)
    whole: Deadline = field(default_factory=Deadline)
    request: Request = field(default_factory=lambda: Request(0.0))
    stop: StopRequest = field(default_factory=StopRequest)

    def __post_init__(self) -> None:
        self.last = LastReport(self.folder)
        self.store: Store

    def open(self, *, resume: bool) -> Store:
        """Open the store, with every set of the question begun in it. Raises InputError: an unusable folder."""
        question = self.question
        fingerprint = question.examiner.fingerprint
        self.store = store = question.store(
            self.folder, fingerprint, question.parameters, question.fixed, resume=resume
        )
        with store.errors_as_input():
            for number, box in question.sets.items():
                grid = store.grid(number, box)
                if grid is None:
                    grid = question.grid(number)
                    store.begin(number, grid, question.first_blocks(number, grid))
                self.grids[number] = grid
            # sets of an earlier command that were not asked for now
            for tally in store.tallies():
                box = None if tally.frame in self.grids else question.stored_set(tally.frame)
                stored = None if box is None else store.grid(tally.frame, box)
                if stored is not None:
                    self.grids[tally.frame] = stored
        return store

    def box(self, number: int, row: Mapping[str, Any]) -> ParameterBox:
        """Return the parameter box of a cell's ``row`` of the store."""
        names, box = [name for name, _ in self.question.parameters], self.grids[number].box
        for axis, name in enumerate(box.names):
            column = names.index(name)
            box = box.replace(axis, row["lower"][column], row["upper"][column])
        return box

    def report(self, state: str) -> dict[str, Any]:
        """Write the report anew; returns the content of report.json."""
        return self.question.report(self, state)

    def run(self, engine: Callable[[ExitStack], Engine], stop: StopRequest, request: Request) -> dict[str, Any]:
        """Search, and write the results as they come; returns the content of report.json.

        ``engine``: starts the engine, which ends with the stack. ``stop``: asked at least twice a second. Raises
        InputError where the folder cannot be used, or the question cannot be asked.
        """
        question, self.request, self.stop = self.question, request, stop
        question.check(request)
        budget = request.budget
        searching = (1.0 - SHARE) * budget if request.scene_margin else budget
        self.whole = whole = Deadline(budget, stop)
        # where one block may take longer than there is time, all that is done counts
        self.deadline = Deadline(request=stop) if question.finish_one else whole
        with ExitStack() as stack:
            # a signal waits until there is a store to report on
            self.last.first_command = first_command(self.folder) if request.resume else None
            store = self.open(resume=request.resume)
            stack.callback(store.close)
            question.opened(self)
            stack.enter_context(store.errors_as_input())
            stack.enter_context(stop.last_words(self.last.interrupted))
            stack.push(self._ended)
            failed = True
            try:
                with stop.at_once():
                    question.prepare(self, request)
                if question.finish_one:
                    self.whole = whole = Deadline(budget, stop)
                searched = whole.before(budget - searching)
                end = searched.before(question.reserved(searching))
                question.before(self, end)
                with ExitStack() as engines:
                    self.search(engine(engines), end, stop)
                question.after(self, searched)
                if request.scene_margin and not stop():
                    self._margins(whole)
                failed = False
            finally:
                # also after a failure: what is finished is written
                question.finish(self)
                store.finish(self.grids)
                document = self.report("interrupted" if stop() or failed else "budget" if store.open_blocks else "done")
            if request.rows:
                self.rows = {tally.frame: store.leaves(tally.frame) for tally in store.tallies()}
        return document

    def _ended(self, kind: type[BaseException] | None, *_error: object) -> None:
        """Mark the last written report as interrupted if an exception (``kind``) ended the search."""
        if kind is not None:
            with suppress(InputError):
                self.last.interrupted()

    def tell_progress(self) -> None:
        """Call ``on_progress`` with the question's progress."""
        point: Any = self.question.progress(self.store)
        if isinstance(point, SearchProgress):
            budget = self.request.budget
            point = replace(point, elapsed=max(0.0, budget - self.whole.left), total_budget=budget)
        self.request.on_progress(point)

    def search(self, engine: Engine, deadline: Deadline, stop: StopRequest) -> None:
        """Examine open blocks until none is left, the time is over or ``stop`` says so; closes the engine."""
        question, store, request = self.question, self.store, self.request
        search_blocks(
            store,
            engine,
            self.grids,
            lambda *block: examine_here(question.examiner, *block),
            (examine_block, question.examiner.recipe),
            deadline=deadline,
            stop=stop,
            keep=self._keep_counterexamples,
            on_tick=periodic_report(
                store, self.tell_progress, (lambda: self.report("running")) if request.report else lambda: None
            ),
            finish_one=question.finish_one,
        )
        store.trace()

    def _keep_counterexamples(self, block: CellBlock, findings: BlockResult) -> None:
        """Write the counterexamples' files of a block, before its cells are stored as falsified."""
        for name, arrays in self.question.counterexamples(block.frame, self.grids[block.frame], findings):
            buffer = io.BytesIO()
            np.savez(buffer, **arrays)
            self.store.keep_image(name, buffer.getvalue())

    def _margins(self, deadline: Deadline) -> None:
        """Compute the scene margin: the largest variation of each kind under which certified cells stay so."""
        question, store = self.question, self.store
        varied = question.varied_scenes()
        if varied is None:
            return
        kinds, prover = varied
        certified = {tally.frame: store.leaves(tally.frame, "certified") for tally in store.tallies()}
        rows, about = question.margin_rows(certified)
        margins = Margins(certified_cells(rows, self.box), prover, store, self.request.on_margin)
        try:
            margins.find(deadline, kinds)
        finally:
            margins.keep()
            self.scene_margin = {**about, **margins.entry}


def result_cells(rows: Mapping[int, list[Row]], make: Callable[..., C], *columns: str) -> tuple[C, ...]:
    """Return the cells of a result, made by ``make`` from rows of the store.

    Args:
        make: Takes the number, the ends of the box, the verdict, ``columns`` of the row and its counterexample or None.
    """

    def array(values: Any) -> np.ndarray | None:
        return None if values is None else np.array(values, np.float64)

    return tuple(
        make(
            number, array(row["lower"]), array(row["upper"]), row["verdict"], *(row[name] for name in columns),
            array(row["counterexample"]),
        )
        for number, entries in sorted(rows.items())
        for row in entries
    )  # fmt: skip


def cell_place(cell: Cell, otherwise: str) -> str:
    """Return a part of a file's name that identifies a cell among those of its set."""
    return "_".join(f"{a}-{b}" for a, b in zip(cell.first, cell.past, strict=True)) or otherwise


def periodic_report(
    store: Store, on_progress: Callable[[], object], report: Callable[[], object] = lambda: None
) -> Callable[[float], None]:
    """Return a function to call between results: it often calls ``on_progress``, and rarely ``report``."""
    traced = reported = time.perf_counter()

    def tick(instant: float) -> None:
        nonlocal traced, reported
        if instant - traced >= _TRACE:
            traced = instant
            store.trace()
            on_progress()
        if instant - reported >= _REPORT:
            reported = instant
            report()

    return tick


def search_blocks(
    store: Store,
    engine: Engine,
    grids: dict[int, CellGrid],
    examine: Examine,
    on_workers: tuple[Callable[..., BlockResult], Any],
    *,
    deadline: Deadline,
    stop: StopRequest,
    keep: Callable[[CellBlock, Any], object],
    on_tick: Callable[[float], object],
    finish_one: bool = True,
) -> None:
    """Examine open blocks until none is left, the time is over or ``stop`` says so.

    Until the engine's workers have started, this process examines blocks, too: a kill in the first seconds keeps those.

    Args:
        engine: Where blocks are examined; closed at the end.
        on_workers: For others: a function of a module, and what it takes before the arguments of ``examine``.
        stop: Asked at least twice a second, and ends a block at once in this process.
        keep: Given every block and its findings before they are stored.
        on_tick: Told the reading of the clock after results, and twice a second where others work.
        finish_one: Whether one block is waited for however late it is, so that resuming with any budget gets on.
    """
    # workers take the kernels that were compiled here
    kernels().publish()
    flying: dict[int, CellBlock] = {}
    finished = 0 if finish_one else 1

    def offer(room: int) -> Iterator[Task]:
        if deadline.late and (flying or finished):
            return
        for block in store.pending(set(flying), room):
            flying[block.number] = block
            arguments = block.frame, grids[block.frame], block.cells
            if engine.shares:
                yield Task(block.number, examined, arguments)
            else:
                yield Task(block.number, on_workers[0], (on_workers[1], *arguments))

    def over() -> bool:
        return stop() or (deadline.late and finished > 0)

    def examined(index: int, grid: CellGrid, cells: tuple[Cell, ...]) -> BlockResult | None:
        # in this process a block is given up at the deadline or a signal
        try:
            with stop.at_once(), cancel_when(lambda: deadline.late and finished > 0):
                return examine(index, grid, cells)
        except (KeyboardInterrupt, WorkCancelledError):
            return None

    def take(block: CellBlock, findings: BlockResult | None) -> None:
        nonlocal finished
        if findings is None:
            return
        keep(block, findings)
        store.close_block(block, findings, grids[block.frame])
        finished += 1

    for results in work(engine, offer, over):
        for number, findings in results:
            take(flying.pop(number), findings)
        if engine.starting and not over():
            for block in store.pending(set(flying), 1):
                take(block, examined(block.frame, grids[block.frame], block.cells))
        on_tick(time.perf_counter())
