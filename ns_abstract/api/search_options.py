"""Options of a search that `ns_abstract.certify`, `locate` and `reach` have in common, and the search itself."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypedDict, TypeVar, get_args

from ns_abstract.api.bounding import listener
from ns_abstract.api.cell_search import CellQuestion, CellSearch, Request, Row
from ns_abstract.execution.starting import EngineName, started
from ns_abstract.execution.stopping import interruptible
from ns_abstract.io.arguments import file_path, flag, one_of, positive, workers_of
from ns_abstract.io.assumptions import Assumption
from ns_abstract.io.errors import InputError

P = TypeVar("P")
R = TypeVar("R", bound="SearchResult")


class SearchKeywords(TypedDict, total=False):
    """The fields of `SearchOptions` as keyword arguments."""

    time_budget: float
    output_dir: str | os.PathLike[str] | None
    arithmetic: str | None
    resume: bool
    workers: int
    engine: EngineName
    scheduler_address: str | None


@dataclass(frozen=True)
class SearchOptions:
    """How long, where and in how many processes verdicts are searched for.

    Attributes:
        time_budget: Seconds for all sets together.
        output_dir: Folder for cells.sqlite, the report and counterexamples, as the command writes them; None: none.
        arithmetic: "float32" or "real", of the pictures; None: float32.
        resume: Whether to go on with what ``output_dir`` holds.
        workers: Processes (for a NeRF: that bound rays, which all cells share); with more than one, a script needs
            ``if __name__ == "__main__":``.
        engine: "dask" spreads the cells over a Dask cluster.
        scheduler_address: HOST:PORT of its scheduler; None: a cluster on this machine.

    Raises:
        InputError: One of them cannot be used.
    """

    time_budget: float = 600.0
    output_dir: str | os.PathLike[str] | None = None
    arithmetic: str | None = None
    resume: bool = False
    workers: int = 1
    engine: EngineName = "local"
    scheduler_address: str | None = None

    def __post_init__(self) -> None:
        checked = {
            "time_budget": positive(self.time_budget, "time_budget"),
            "workers": workers_of(self.workers),
            "resume": flag(self.resume, "resume"),
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        if self.output_dir is not None:
            file_path(self.output_dir, "output_dir")
        one_of(self.engine, get_args(EngineName), "engine")
        if self.resume and self.output_dir is None:
            raise InputError("given without output_dir", field="resume", fix="give the folder to go on with")

    @property
    def settings(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("time_budget", "arithmetic", "workers", "engine")}

    def search(
        self,
        question: CellQuestion[P],
        on_progress: Callable[[P], object] | None,
        *,
        workers: int,
        report: bool = True,
        scene_margin: bool = False,
    ) -> tuple[dict[int, list[Row]], dict[str, Any]]:
        """Return the cells by number and the content of report.json; Ctrl-C or the listener may end the search.

        Args:
            question: What is claimed.
            on_progress: Told about once a second.
            workers: Processes that examine cells.
            report, scene_margin: See `Request`.
        """
        with ExitStack() as stack:
            folder = self.output_dir
            if folder is None:
                folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="ns-abstract-"))
            stop = stack.enter_context(interruptible())
            request = Request(self.time_budget, self.resume, report, flag(scene_margin, "scene_margin"))
            search = CellSearch(question, Path(folder))
            document = search.run(
                lambda engines: engines.enter_context(started(self.engine, self.scheduler_address, workers)),
                stop,
                replace(request, on_progress=listener(stop, on_progress)),
            )
            return search.rows, document


@dataclass(frozen=True, kw_only=True)
class SearchResult:
    """How a search has ended.

    Attributes:
        parameters: Names and units of the cells' axes.
        state: "done", "budget" (the time ended first) or "interrupted".
        seconds: Time spent.
        report: Content of report.json.
    """

    parameters: tuple[tuple[str, str], ...]
    state: str
    seconds: float
    report: dict[str, Any] = field(repr=False)

    @classmethod
    def of(cls: type[R], parameters: Sequence[tuple[str, str]], document: Mapping[str, Any], **more: Any) -> R:
        """Return the result of a report's ``document``; ``more`` are the attributes of its kind."""
        state, seconds = document["state"], document["seconds"]
        return cls(parameters=tuple(parameters), state=state, seconds=seconds, report=dict(document), **more)

    @property
    def assumptions(self) -> tuple[Assumption, ...]:
        """What the verdict rests on, and where each choice came from."""
        return tuple(Assumption(**entry) for entry in self.report["assumptions"])

    @property
    def interrupted(self) -> bool:
        """Whether the work was ended by Ctrl-C or by ``on_progress``."""
        return self.state == "interrupted"
