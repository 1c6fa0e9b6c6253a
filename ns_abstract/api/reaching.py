"""A network in the loop: `reach`, its result, and the question that the command line asks, too."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from ns_abstract.api.cell_search import (
    CellQuestion,
    CellSearch,
    Request,
    Row,
    SearchProgress,
    cell_place,
    result_cells,
    shares_text,
)
from ns_abstract.api.loop_job import LoopJob, open_loop
from ns_abstract.api.loop_report import LoopReport
from ns_abstract.api.scenes import Scene, checked_scene
from ns_abstract.api.search_options import SearchKeywords, SearchOptions, SearchResult
from ns_abstract.execution.cancellation import Deadline
from ns_abstract.io.arguments import file_path, flag, one_of
from ns_abstract.reach.search import QUESTIONS
from ns_abstract.report.figures import percent
from ns_abstract.verify.cells import CellGrid
from ns_abstract.verify.network import NetworkArithmetic
from ns_abstract.verify.scene_margin import ProveCell, VariationKind, bounded_kinds
from ns_abstract.verify.store import Store, fractions

if TYPE_CHECKING:
    from typing import Unpack  # pyright: ignore[reportAttributeAccessIssue]  # of Python 3.11

#: Parts of the time for random runs, for tubes that the report shows, and for a film.
_RUNS_SHARE, _SHOWN_SHARE, _FILM_SHARE = 0.1, 0.1, 0.1


@dataclass(frozen=True)
class ReachProgress(SearchProgress):
    """Where a search stands: fractions of the initial box for the strongest question asked, and seconds.

    Attributes:
        safe, reaches: Fractions that are certified; None where it was not asked.
        falsified, open, unknown: Fractions for the strongest question; what is open is still to be examined.
        seconds: Time spent, earlier searches that this one goes on with included.
        examined: Part of the initial box that was examined, mean over the questions.
    """

    safe: float | None
    reaches: float | None
    falsified: float
    open: float
    seconds: float
    unknown: float = 0.0
    examined: float | None = None

    @property
    def done(self) -> float:
        """Part of the initial box that was examined, mean over the questions."""
        return 1.0 - self.open if self.examined is None else self.examined

    @property
    def sentence(self) -> str:
        """The four parts of the initial box for the strongest question, after what is certified of a weaker one."""
        strongest = self.safe if self.reaches is None else self.reaches
        parts = shares_text(strongest or 0.0, self.falsified, self.unknown, self.open)
        weaker = "" if self.safe is None or self.reaches is None else f"safe {percent(self.safe)}; "
        return f"{weaker}{QUESTIONS[0] if self.reaches is None else QUESTIONS[-1]}: {parts}"


class LoopQuestion(CellQuestion[ReachProgress]):
    """What holds of every run of a loop, by the numbers of `QUESTIONS`, and the report on it.

    Args:
        film: Whether to make a film along the tube of a certified cell.
    """

    def __init__(
        self, job: LoopJob, settings: Mapping[str, Any], command: tuple[str, ...], *, film: bool = False
    ) -> None:
        box = job.loop.box
        parameters = list(zip(box.names, box.units, strict=True))
        super().__init__(job, parameters, dict.fromkeys(job.questions, box), {n: {} for n in job.questions})
        self.job, self.film = job, film
        self.reports = LoopReport(job, settings, command)

    def counterexamples(self, number: int, grid: CellGrid, findings: Any) -> Iterator[tuple[str, dict[str, Any]]]:
        question, names = QUESTIONS[number], np.array(self.job.loop.names, str)
        for cell, run in findings.runs:
            arrays = {"states": run.states, "controls": run.controls, "disturbances": run.disturbances, "names": names}
            arrays |= {"views": run.views} if self.job.loop.views else {}
            yield f"{question}_{cell_place(cell, 'state')}", arrays
            self.reports.add_example(question, run)

    def reserved(self, seconds: float) -> float:
        return (_SHOWN_SHARE + (_FILM_SHARE if self.film else 0.0)) * seconds

    def prepare(self, search: CellSearch[ReachProgress], request: Request) -> None:
        # the report comes before kernels are compiled
        super().prepare(search, request)
        self.job.job.warm_up(0)

    def before(self, search: CellSearch[ReachProgress], deadline: Deadline) -> None:
        self.reports.simulate_runs(deadline.within(_RUNS_SHARE * deadline.left))

    def after(self, search: CellSearch[ReachProgress], deadline: Deadline) -> None:
        search.tell_progress()
        filming = _FILM_SHARE / self.reserved(1.0) * deadline.left if self.film else 0.0
        self.reports.show_tubes(search.store, deadline.before(filming))
        if self.film:
            self.reports.make_film(search.store, deadline)

    def varied_scenes(self) -> tuple[Sequence[VariationKind], Callable[[VariationKind], ProveCell]]:
        kinds = bounded_kinds(self.job.places)
        # scenes of a set are rendered for the network alone
        return tuple(kind for kind in kinds if kind.place or not self.job.loop.views), self.job.prover

    def margin_rows(self, rows: dict[int, list[Row]]) -> tuple[dict[int, list[Row]], dict[str, Any]]:
        # the strongest question of which anything is certified
        number = max((number for number, entries in rows.items() if entries), default=0)
        return {number: rows.get(number, [])}, {"question": QUESTIONS[number]}

    def progress(self, store: Store) -> ReachProgress:
        shares = {QUESTIONS[tally.frame]: fractions(tally) for tally in store.tallies()}
        last = shares[list(shares)[-1]]
        certified = {name: shares[name]["certified"] if name in shares else None for name in QUESTIONS}
        examined = 1.0 - sum(share["open"] for share in shares.values()) / len(shares)
        return ReachProgress(
            certified["safe"], certified["reaches"], last["falsified"], last["open"], store.seconds, last["unknown"],
            examined,
        )  # fmt: skip

    def report(self, search: CellSearch[ReachProgress], state: str) -> dict[str, Any]:
        return self.reports.write(search, state)


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
class ReachResult(SearchResult):
    """The result of a loop: what was proved and falsified of its runs.

    Attributes:
        safe, reaches: Fractions of the initial box's volume that are certified to be so; None where it was not asked.
        falsified: Fraction in cells with a run that goes wrong, for the strongest question asked.
        verdict: Of the whole box: "falsified", "reaches", "safe" or "unknown".
        cells: What the fractions are made of.
    """

    safe: float | None
    reaches: float | None
    falsified: float
    verdict: str
    cells: tuple[ReachCell, ...] = field(repr=False)


def reach(
    scene: Scene,
    loop: str | os.PathLike[str],
    *,
    network_arithmetic: NetworkArithmetic = "float32",
    on_progress: Callable[[ReachProgress], object] | None = None,
    scene_margin: bool = False,
    film: bool = False,
    **search: Unpack[SearchKeywords],
) -> ReachResult:
    """Prove of a network in the loop that no run from a box of initial states goes wrong, or find one that does.

    Ctrl-C and ``on_progress`` returning False end the work between two cells, with what is known.

    Args:
        scene: The scene.
        loop: LOOP.json.
        network_arithmetic: "float32": every float32 evaluation of the network; "real": the exact network alone.
        on_progress: Told about once a second.
        scene_margin: Whether to look, in half of the time, for the largest variation of the Gaussians for which what is
            certified holds; see the report's key ``scene_margin``.
        film: Whether to write, in a tenth of the time, film.mp4 (film.gif without the package av) into ``output_dir``:
            the abstract image along the tube of the widest certified cell; see the report's key ``film``.
        **search: Fields of `SearchOptions`: ``time_budget``, ``output_dir``, ``arithmetic``, ``resume``, ``workers``,
            ``engine``, ``scheduler_address``.

    Raises:
        InputError: An argument cannot be used.
    """
    options = SearchOptions(**search)
    one_of(network_arithmetic, ("float32", "real"), "network_arithmetic")
    job = open_loop(
        checked_scene(scene), file_path(loop, "loop"), options.arithmetic, network_arithmetic, options.workers
    )
    question = LoopQuestion(job, options.settings, ("ns_abstract.reach",), film=flag(film, "film"))
    rows, document = options.search(question, on_progress, workers=options.workers, scene_margin=scene_margin)
    return result(job, rows, document)


def result(job: LoopJob, rows: Mapping[int, list[Row]], document: Mapping[str, Any]) -> ReachResult:
    """Return the result of a search that has ended with these rows of cells by question."""
    questions = document["questions"]
    fractions = {name: questions[name]["certified"] if name in questions else None for name in QUESTIONS}
    return ReachResult.of(
        list(zip(job.loop.box.names, job.loop.box.units, strict=True)),
        document,
        safe=fractions["safe"],
        reaches=fractions["reaches"],
        falsified=list(questions.values())[-1]["falsified"],
        verdict=document["verdict"],
        cells=result_cells(rows, lambda number, *more: ReachCell(QUESTIONS[number], *more), "margin"),
    )
