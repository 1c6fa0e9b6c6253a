"""The scene margin: the largest variation of the scene that keeps a certificate, by bisection (design.md, V13).

Cells that were certified for the stored scene are bounded again for all scenes around it. Sets of scenes are nested: a
proof for a radius holds for every smaller one. So one pass over the cells suffices, with the smallest radius so far.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from ns_abstract.execution.cancellation import WorkCancelledError, cancel_when, check_cancelled
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.poses import SCENE_SHIFTS, SCENE_TURNS
from ns_abstract.io.errors import InputError
from ns_abstract.perturbation.variations import SceneVariation, Selection
from ns_abstract.verify.camera_response import ResponseName
from ns_abstract.verify.cells import Cell, CellGrid

Outcome = Literal["holds", "falsified", "unknown"]


@dataclass(frozen=True)
class MarginTuning:
    """Preferences of the search for a margin; the result is what was proved for the last radius that held."""

    #: Bisection ends where the ends are this close, by their quotient; radii tried first grow and shrink by `stride`.
    close: float = 1.1
    stride: float = 4.0
    #: A radius below this part of the first one is called 0.
    least_share: float = 2.0**-20
    #: Cuts of a cell one inside the other, parts by cut, and most parts that a cell is examined in.
    depth: int = 2
    parts: int = 4
    most_parts: int = 24
    #: Doublings of the radius in search of a scene that breaks what is certified.
    doublings: int = 6
    #: Trials that a report lists.
    listed: int = 200


_TUNING = MarginTuning()


@dataclass(frozen=True)
class VariationKind:
    """A kind of variation: of each Gaussian (`KINDS`), of the camera (`CAMERA_KINDS`), of the whole scene (`PLACES`).

    Attributes:
        name: Key of a scene variation, of `KINDS`.
        place: Parameters of the whole scene's position, if these vary (`PoseBox.registered`).
    """

    name: str
    text: str
    unit: str
    first: float
    largest: float
    response: ResponseName | None = None
    place: tuple[str, ...] = ()

    def variation(self, radius: float) -> SceneVariation:
        """Return the set of all scenes within ``radius`` of the stored one."""
        ends: dict[str, Any] = {self.name: (-radius, radius)}
        return SceneVariation(Selection(), **ends)


KINDS = (
    VariationKind("mean", "every coordinate of every Gaussian's mean", "normalised units", 0.001, 10.0),
    VariationKind("opacity", "every Gaussian's opacity", "of 1", 0.01, 1.0),
    VariationKind("color", "every channel of every Gaussian's colour", "of 1", 0.01, 1.0),
)

#: Of the camera, the same all over the picture (V14).
CAMERA_KINDS: tuple[VariationKind, ...] = (
    VariationKind("brightness", "the factor of the camera's brightness", "of 1", 0.01, 0.9, "brightness"),
    VariationKind("white_balance", "the factor of every channel", "of 1", 0.01, 0.9, "white balance"),
    VariationKind("gamma", "the power of the camera's response", "of 1", 0.01, 0.9, "gamma"),
)

#: The scene as a whole, the same for a whole run of a loop.
REGISTRATION = VariationKind(
    "registration",
    "the place of the whole scene along every world axis",
    "normalised units",
    0.001,
    10.0,
    place=SCENE_SHIFTS,
)
TURN = VariationKind(
    "turn",
    "the turn of the whole scene about every world axis through the origin",
    "rad",
    0.001,
    1.5,
    place=SCENE_TURNS,
)
PLACES = (REGISTRATION, TURN)


def bounded_kinds(places: Callable[[VariationKind], bool]) -> tuple[VariationKind, ...]:
    """Return all kinds of variation; those of the whole scene only if ``places`` says that they can be bounded."""
    return (*KINDS, *CAMERA_KINDS, *(kind for kind in PLACES if places(kind)))


@dataclass(frozen=True)
class CellOutcome:
    """The outcome of a cell for all scenes of a set, with the arrays of a scene that breaks it.

    ``slopes`` [d] are the gains of a cut along each parameter.
    """

    outcome: Outcome
    reason: str
    slopes: np.ndarray
    example: Mapping[str, np.ndarray] | None = None


#: A cell as it is (it is not cut), by radius, frame and box.
ProveCell = Callable[[float, int, ParameterBox], CellOutcome]


@dataclass(frozen=True)
class CertifiedBox:
    """A certified cell with its proved margin, and its fraction of the certified volume."""

    frame: int
    box: ParameterBox
    margin: float
    part: float


@dataclass(frozen=True)
class Trial:
    """A cell at a radius, with its outcome."""

    cell: int
    radius: float
    outcome: Outcome
    reason: str
    parts: int
    seconds: float


@dataclass
class SceneMargin:
    """The result of a bisection.

    Attributes:
        radius: All certified cells hold for all scenes this far from the stored one; 0: nothing more is known.
        reached, part: Radius at which the examined fraction of the certified volume holds, and that fraction.
        state: "done", or "ended": by the time, or by a request to stop.
        cells: Number of certified cells.
        example: Arrays of the scene at the smallest falsified radius, or None.
    """

    kind: VariationKind
    cells: int
    radius: float = 0.0
    reached: float = 0.0
    part: float = 0.0
    state: Literal["done", "ended"] = "done"
    trials: list[Trial] = field(default_factory=list)
    seconds: float = 0.0
    example: Mapping[str, np.ndarray] | None = None

    def _least(self, *outcomes: Outcome) -> Trial | None:
        trials = [trial for trial in self.trials if trial.outcome in outcomes]
        return min(trials, key=lambda trial: trial.radius, default=None)

    @property
    def failing(self) -> Trial | None:
        """The trial with the smallest radius that is not certified; None: all are."""
        return self._least("falsified", "unknown")

    @property
    def falsified(self) -> Trial | None:
        """The trial with the smallest radius at which a scene breaks a certified cell; None: at no radius."""
        return self._least("falsified")

    @property
    def sentence(self) -> str:
        """The result as text."""
        kind, failing = self.kind, self.failing
        if self.radius > 0.0:
            more = " (no larger one was tried)" if self.radius >= kind.largest else ""
            text = f"{kind.text} may be off by {self.radius:.4g} {kind.unit}{more}"
        elif self.state == "ended":
            text = (
                f"0, as the work ended first: {self.part:.2%} of what is certified holds for {kind.text} off by "
                f"{self.reached:.4g} {kind.unit}"
            )
        else:
            text = f"0: not even the smallest radius tried is proved for {kind.text}"
        if failing is not None:
            why = "a scene breaks it" if failing.outcome == "falsified" else f"not proved: {failing.reason}"
            text += f"; at {failing.radius:.4g}: {why}"
        if self.falsified is not None and self.falsified is not failing:
            text += f"; at {self.falsified.radius:.4g} a scene breaks it"
        return text

    @property
    def entry(self) -> dict[str, Any]:
        """The entry of report.json."""

        def record(trial: Trial | None) -> dict[str, Any] | None:
            return None if trial is None else vars(trial)

        # cells that held at once say little
        told_of = {trial.cell for trial in self.trials if trial.outcome != "holds"}
        listed = [trial for trial in self.trials if trial.cell in told_of or trial.radius == self.radius]
        return {
            "kind": self.kind.name,
            "unit": self.kind.unit,
            "radius": self.radius,
            "not_certified": record(self.failing),
            "falsified": record(self.falsified),
            "reached": {"radius": self.reached, "part": self.part},
            "state": self.state,
            "cells": self.cells,
            "runs": len(self.trials),
            "trials": [vars(trial) for trial in listed[: _TUNING.listed]],
            "seconds": self.seconds,
            "text": self.sentence,
        }


def largest_radius(
    kind: VariationKind, cells: Sequence[CertifiedBox], prove: ProveCell, over: Callable[[], bool]
) -> SceneMargin:
    """Return the largest radius, within a tenth, for which every cell is proved again (V13).

    ``prove``: bounds and attacks one cell. ``over``: whether to end with the result so far, called about once a second.
    """
    begin = time.perf_counter()
    margin = SceneMargin(kind, len(cells))
    work = _Bisection(margin, prove)
    try:
        with cancel_when(over):
            # those that are nearest to failing decide
            order = sorted(range(len(cells)), key=lambda k: (cells[k].margin, cells[k].frame, cells[k].box.lower))
            for place, number in enumerate(order):
                radius = work.largest(number, cells[number], margin.reached if place else None)
                margin.reached, margin.part = radius, margin.part + cells[number].part
                if radius == 0.0:
                    break
            else:
                margin.radius = margin.reached
            failing = margin.failing
            if failing is not None and margin.falsified is None:
                work.attack(failing, cells[failing.cell])
    except WorkCancelledError:
        margin.state = "ended"
    margin.seconds = time.perf_counter() - begin
    return margin


def three_digits(radius: float) -> float:
    """Return the radius rounded to three digits, so that a report states exactly what was proved."""
    return float(f"{radius:.3g}")


class _Bisection:
    """The bisection of one kind of variation."""

    def __init__(self, margin: SceneMargin, prove: ProveCell) -> None:
        self.margin, self.kind, self.prove = margin, margin.kind, prove

    def largest(self, number: int, cell: CertifiedBox, ceiling: float | None) -> float:
        """Return the largest radius for one cell, up to ``ceiling``; None: it is the first cell."""
        most = self.kind.largest if ceiling is None else ceiling
        radius = min(self.kind.first, most) if ceiling is None else ceiling
        low, high = 0.0, math.inf
        while low < most and not (low > 0.0 and high <= _TUNING.close * low):
            radius = min(most, three_digits(radius))
            if radius < _TUNING.least_share * self.kind.first:
                return 0.0
            if self._try(number, cell, radius):
                low = radius
            else:
                high = radius
            if high == math.inf:
                radius = min(most, _TUNING.stride * low)
            else:
                radius = math.sqrt(low * high) if low > 0.0 else high / _TUNING.stride
        return low

    def attack(self, failing: Trial, cell: CertifiedBox) -> None:
        """Double the radius of a failing trial until a scene breaks the cell, or the largest radius is reached."""
        radius = failing.radius
        for _ in range(_TUNING.doublings):
            if radius >= self.kind.largest:
                return
            radius = min(three_digits(2.0 * radius), self.kind.largest)
            self._try(failing.cell, cell, radius, cuts=False)
            if self.margin.trials[-1].outcome != "unknown":
                return

    def _try(self, number: int, cell: CertifiedBox, radius: float, *, cuts: bool = True) -> bool:
        """Return whether a cell is proved for a radius."""
        begin = time.perf_counter()
        outcome, reason, parts, example = self._examined(cell, radius, cuts)
        trial = Trial(number, radius, outcome, reason, parts, time.perf_counter() - begin)
        least = self.margin.falsified
        self.margin.trials.append(trial)
        if outcome == "falsified" and (least is None or radius < least.radius):
            self.margin.example = example
        return outcome == "holds"

    def _examined(
        self, cell: CertifiedBox, radius: float, cuts: bool
    ) -> tuple[Outcome, str, int, Mapping[str, np.ndarray] | None]:
        """Return the outcome of the cell, cut where it is not proved as a whole: all parts must be proved."""
        grid = CellGrid.adaptive(cell.box, [1] * cell.box.dimensions)
        waiting: list[tuple[Cell, int]] = [(part, 0) for part in grid.roots()]
        count = 0
        while waiting:
            part, depth = waiting.pop()
            check_cancelled()
            outcome = self.prove(radius, cell.frame, grid.box_of(part))
            count += 1
            if outcome.outcome == "falsified":
                return "falsified", outcome.reason, count, outcome.example
            if outcome.outcome == "holds":
                continue
            parts = (
                grid.divide(part, outcome.slopes, 1.0 / _TUNING.parts, _TUNING.parts)
                if cuts and depth < _TUNING.depth
                else []
            )
            if not parts or count + len(waiting) + len(parts) > _TUNING.most_parts:
                return "unknown", outcome.reason, count, None
            waiting += [(entry, depth + 1) for entry in parts]
        return "holds", "", count, None


def check_scenes(varied: bool, rays: bool) -> None:
    """Raise InputError where no scene margin is defined: there are no Gaussians, or they already vary."""
    if rays:
        raise InputError("Gaussians vary, a NeRF has none", field="--scene-margin", fix="leave it out")
    if varied:
        raise InputError(
            'the set has the key "scene" already', field="--scene-margin", fix="remove the key, or leave the option out"
        )
