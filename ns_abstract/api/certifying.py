"""Certificates: `certify`, its result, and the question that the command line asks, too."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

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
from ns_abstract.api.certificate_report import CertificateReport
from ns_abstract.api.certification import MEMORY, Certification, PropertySource, question_of
from ns_abstract.api.job import Job
from ns_abstract.api.poses import PoseSet, pose_sets
from ns_abstract.api.scenes import Scene, checked_scene
from ns_abstract.api.search_options import SearchKeywords, SearchOptions, SearchResult
from ns_abstract.execution.cancellation import Deadline
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.io.arguments import file_path, one_of, plain
from ns_abstract.io.errors import InputError
from ns_abstract.io.memory import allowed_memory
from ns_abstract.report.certificate import coverage, verdict
from ns_abstract.report.figures import percent, short_guarantee
from ns_abstract.report.notebook import verdicts_html
from ns_abstract.report.run import CommandRun
from ns_abstract.report.verdict_picture import clear_pictures
from ns_abstract.verify.cells import Cell, CellGrid
from ns_abstract.verify.eight_bit import Picture
from ns_abstract.verify.network import NetworkArithmetic
from ns_abstract.verify.scene_margin import ProveCell, VariationKind, check_scenes
from ns_abstract.verify.store import Store, fractions

if TYPE_CHECKING:
    from typing import Unpack  # pyright: ignore[reportAttributeAccessIssue]  # of Python 3.11

#: Seconds that pictures for the last report may take beyond the budget and the search.
_LAST = 5.0


def network_memory(limit: float | None, workers: int) -> int:
    """Return bytes for the network's bounds of one of ``workers`` processes; ``limit`` in GiB for all, or None."""
    # half: images and torch need room beside the bounds; a power of two, so that it hardly depends on the moment
    return min(MEMORY, 1 << int(np.log2(max(2.0, 0.5 * allowed_memory(limit) / workers))))


def check_network_memory(certification: Certification, limit: float | None, workers: int) -> None:
    """Raise InputError, with the size, if a network's cell takes, by an estimate, too much memory of a process."""
    job = certification.job
    certification.question.check_memory(len(job.parameters), allowed_memory(limit) / (1 if job.rays else workers))


@dataclass(frozen=True)
class CertifyProgress(SearchProgress):
    """Progress of a search for certificates: mean fractions over the frames, and seconds.

    Attributes:
        certified, falsified, unknown: Fractions of the parameter volume that have this verdict.
        open: The rest, which is still to be examined; the result counts it as unknown.
        seconds: Time spent, with that of the earlier searches that this one continues.
    """

    certified: float
    falsified: float
    unknown: float
    open: float
    seconds: float

    @property
    def done(self) -> float:
        """Part of the volume that was examined."""
        return 1.0 - self.open

    @property
    def sentence(self) -> str:
        return shares_text(self.certified, self.falsified, self.unknown, self.open)


class CertificateQuestion(CellQuestion[CertifyProgress]):
    """The claim that a property holds on every picture of some frames' sets, and the report on it."""

    def __init__(
        self, job: Certification, frames: Sequence[int], settings: Mapping[str, Any], command: tuple[str, ...]
    ) -> None:
        sets = {index: job.job.pose_sets[index].box for index in frames}
        super().__init__(job, job.job.parameters, sets, job.job.fixed)
        self.job, self.finish_one = job, not job.job.rays
        self.about = CommandRun.of(
            job.job, settings, command, fingerprint=job.fingerprint, assumptions=job.assumptions,
            plan=(*job.job.plan, *job.scenes, *job.property.notes),
        )  # fmt: skip
        self._report: CertificateReport | None = None

    def reports(self, search: CellSearch[Any]) -> CertificateReport:
        """Return the writer of the search's report."""
        if self._report is None or self._report.search is not search:
            self._report = CertificateReport(self.job, self.about, search)
        return self._report

    def grid(self, number: int) -> CellGrid:
        return self.job.grid(number)

    def first_blocks(self, number: int, grid: CellGrid) -> list[list[Cell]]:
        return self.job.first_blocks(grid)

    def stored_set(self, number: int) -> ParameterBox | None:
        return self.job.job.pose_sets[number].box

    def counterexamples(self, number: int, grid: CellGrid, findings: Any) -> Iterator[tuple[str, dict[str, Any]]]:
        pictures = None
        for leaf in findings.leaves:
            if leaf.counterexample is None or leaf.image is None or leaf.outputs is None:
                continue
            values = np.array(leaf.counterexample)
            pictures = self.job.pictures(number) if pictures is None else pictures
            arrays: dict[str, Any] = {
                "image": pictures.completed(leaf.image, values),
                "outputs": leaf.outputs,
                "values": values,
                "names": np.array(grid.box.names, str),
                "camera_to_world": self.job.job.pose_sets[number].pose(values),
                "margin": np.array(np.nan if leaf.margin is None else leaf.margin),
            }
            arrays |= {f"scene_{name}": array for name, array in (leaf.scene or {}).items()}
            yield f"frame_{number:05d}_{cell_place(leaf.cell, 'pose')}", arrays

    def check(self, request: Request) -> None:
        if request.scene_margin:
            check_scenes(any(p.perturbation.scene for p in self.job.job.pose_sets), self.job.job.rays)

    def prepare(self, search: CellSearch[CertifyProgress], request: Request) -> None:
        if request.report:
            clear_pictures(search.folder)
            self.reports(search).write("running", pictures=False)
        try:
            self.job.foresee(next(iter(self.sets)), request.budget)
        except InputError:
            # there is no time for pictures either
            search.deadline = Deadline(-math.inf)
            raise
        request.on_open(search.store)
        if request.report:
            # renders pictures, for which kernels may have to be compiled
            search.report("running")

    def finish(self, search: CellSearch[CertifyProgress]) -> None:
        seconds = min(search.deadline.left, max(search.whole.left, 0.0)) + _LAST
        search.deadline = Deadline(seconds, search.stop)

    def varied_scenes(self) -> tuple[Sequence[VariationKind], Callable[[VariationKind], ProveCell]]:
        return self.job.kinds, self.job.prover

    def progress(self, store: Store) -> CertifyProgress:
        shares = [fractions(tally) for tally in store.tallies()]
        mean = {key: sum(s[key] for s in shares) / len(shares) for key in shares[0]}
        return CertifyProgress(mean["certified"], mean["falsified"], mean["unknown"], mean["open"], store.seconds)

    def report(self, search: CellSearch[CertifyProgress], state: str) -> dict[str, Any]:
        report = self.reports(search)
        return report.write(state) if search.request.report else report.document(search.store, state)[0]


@dataclass(frozen=True)
class CertifiedCell:
    """A cell of the search.

    Attributes:
        frame: Number of its set of poses.
        lower, upper: Ends of its box, in the order of `Certificate.parameters`.
        verdict: "certified", "falsified" or "unknown".
        margin: Proved lower bound of the property's margin; the margin of the counterexample; or None.
        counterexample: Parameters of a pose whose image breaks the property, or None.
    """

    frame: int
    lower: np.ndarray
    upper: np.ndarray
    verdict: Literal["certified", "falsified", "unknown"]
    margin: float | None
    counterexample: np.ndarray | None


@dataclass(frozen=True)
class Certificate(SearchResult):
    """A certificate: what was proved and falsified of a network over a set of poses.

    Attributes:
        certified, falsified, unknown: Fractions of the parameter volume, mean over the sets; they add up to 1.
        cells: What the fractions are made of.
        verdict: "falsified" if any pose breaks the property, "certified" if all is proved, else "unknown".
        sentence: The property in words, as the end of "on every image ...".
        guarantee: Of the pictures: "float32-sound" or "real-sound", and what of the scene it holds if not all (as in
            `ns_abstract.BoundResult`).
        network_guarantee: What holds of the network, one sentence each.
    """

    certified: float
    falsified: float
    unknown: float
    cells: tuple[CertifiedCell, ...] = field(repr=False)
    verdict: str
    sentence: str
    guarantee: str
    network_guarantee: tuple[str, ...] = field(repr=False)

    def _shares(self) -> dict[str, float]:
        return {"certified": self.certified, "falsified": self.falsified, "unknown": self.unknown}

    def _lines(self) -> list[str]:
        return [
            f"{self.verdict}: on every image {self.sentence}",
            ", ".join(f"{kind} {percent(share)}" for kind, share in self._shares().items()),
            f"{self.guarantee}; {len(self.cells)} cells, {self.seconds:.1f} s; {self.state}",
        ]

    def __str__(self) -> str:
        return "\n".join(["certificate", *(f"  {line}" for line in self._lines())])

    def _repr_html_(self) -> str:
        return verdicts_html(self._shares(), self._lines())


def certify(
    scene: Scene,
    poses: PoseSet | PinholeCamera | Sequence[PoseSet | PinholeCamera],
    model: str | os.PathLike[str] | None,
    property: Mapping[str, Any] | str | os.PathLike[str],
    *,
    network_arithmetic: NetworkArithmetic = "float32",
    picture: Picture = "float",
    on_progress: Callable[[CertifyProgress], object] | None = None,
    memory_limit: float | None = None,
    scene_margin: bool = False,
    **search: Unpack[SearchKeywords],
) -> Certificate:
    """Prove, or break, a property of a network, or of the picture itself, on every picture over sets of poses.

    Ctrl-C and ``on_progress`` returning False end the work between two cells, with what is known.

    Args:
        scene: The scene.
        poses: One set, or several; a camera is the set of its one pose.
        model: Network, .onnx; None: the property is one of the picture (visible, clear, picture, all, any).
        property: What is to hold, as the object of a property file, or that file.
        network_arithmetic: "float32": every float32 evaluation of the network; "real": the exact network alone.
        picture: "float": the renderer's floats; "8-bit": these rounded to multiples of 1/255, as files have them.
        on_progress: Told about once a second.
        memory_limit: GiB; None: 80 % of what is free.
        scene_margin: Whether to look, in half of the time, for the largest variation of the Gaussians for which what is
            certified holds; see the report's key ``scene_margin``.
        **search: Fields of `SearchOptions`: ``time_budget``, ``output_dir``, ``arithmetic``, ``resume``, ``workers``,
            ``engine``, ``scheduler_address``.

    Raises:
        InputError: An argument cannot be used.
    """
    options = SearchOptions(**search)
    one_of(picture, ("float", "8-bit"), "picture")
    one_of(network_arithmetic, ("float32", "real"), "network_arithmetic")
    source = plain(property) if isinstance(property, Mapping) else file_path(property, "property")
    question = question_of(None if model is None else file_path(model, "model"), PropertySource.of(source))
    drawn = [question.drawn(entry.of(checked_scene(scene))) for entry in pose_sets(poses)]
    memory = network_memory(memory_limit, options.workers)
    job = Job(scene, drawn, arithmetic=options.arithmetic, workers=options.workers)
    certification = Certification(job, question, memory, network_arithmetic=network_arithmetic, picture=picture)
    check_network_memory(certification, memory_limit, options.workers)
    settings = {**options.settings, "picture": picture}
    rows, document = options.search(
        CertificateQuestion(certification, range(len(drawn)), settings, ("ns_abstract.certify",)),
        on_progress,
        workers=1 if scene.rays else options.workers,
        report=options.output_dir is not None,
        scene_margin=scene_margin,
    )
    return certificate(certification, rows, document)


def certificate(job: Certification, rows: Mapping[int, list[Row]], document: Mapping[str, Any]) -> Certificate:
    """Return the result of a search that has ended with these rows of cells by frame."""
    covered = coverage(document["frames"])
    return Certificate.of(
        job.job.parameters,
        document,
        certified=covered["certified"],
        falsified=covered["falsified"],
        unknown=covered["unknown"],
        cells=result_cells(rows, CertifiedCell, "margin"),
        verdict=verdict(document["frames"]),
        sentence=job.property.sentence(),
        guarantee=short_guarantee(job.job.method.guarantee, document["scene"].get("bounded")),
        network_guarantee=tuple(document["network_guarantee"]),
    )
