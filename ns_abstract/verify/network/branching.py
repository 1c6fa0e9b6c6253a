"""Branch and bound on the activation phases of unstable neurons (docs/dev/design.md, N16)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ns_abstract.execution.cancellation import check_cancelled
from ns_abstract.verify.network.bounds import bound_outputs
from ns_abstract.verify.network.graph import Network, NetworkArithmetic
from ns_abstract.verify.network.image_sets import ActivationPhases, ImageSets, OutputBounds

#: Branches that are bounded together.
_TOGETHER = 16
#: Steps towards the best slopes and multipliers of each.
_STEPS = 12


@dataclass(frozen=True)
class BranchingResult:
    """The result of branch and bound.

    Attributes:
        proved: Whether every branch was.
        branches: How many were bounded.
        least: By how much the weakest branch holds or fails; minus infinity where nothing is known of it.
    """

    proved: bool
    branches: int
    least: float


@dataclass(frozen=True)
class _PhaseBranch:
    """One branch: its assumed phases, its bound, and the neuron to split next (-1: none is left)."""

    phases: Mapping[int, ActivationPhases]
    value: float
    unit: tuple[int, int]

    def halves(self) -> list[dict[int, ActivationPhases]]:
        """The same with either sign of the unit assumed besides."""
        node, place = self.unit
        flat, side = self.phases.get(node, (np.zeros(0, np.int64), np.zeros(0)))
        flat = np.append(flat, np.int64(place))
        return [{**self.phases, node: (flat, np.append(side, sign))} for sign in (1.0, -1.0)]


def branch(
    network: Network,
    images: ImageSets,
    rows: Any,
    offset: NDArray[np.float64],
    groups: Sequence[Sequence[int]],
    most: int,
    *,
    memory: int = 1 << 30,
    arithmetic: NetworkArithmetic = "float32",
    intermediate_steps: int = 0,
    enough: Callable[[], bool] = lambda: False,
) -> BranchingResult:
    """Try to prove that in every group some of ``rows @ network(x) + offset`` is positive, on one set of images.

    Whichever evaluation is meant, the input of a ReLU is not negative or not positive in it: where the bounds leave
    a group open, either is assumed, and both branches have to be proved, each group for itself. The weakest come first,
    so that a hopeless claim ends soon.

    Args:
        network, rows, offset, memory, arithmetic: See `bound_outputs`.
        images: One cell.
        groups: Numbers of rows.
        most: Branches after which it is given up.
        intermediate_steps: Steps towards the best lines of intermediate bounds before anything is branched on.
        enough: Asked between batches of branches: whether to give up.
    """
    dense = np.asarray(rows.toarray() if hasattr(rows, "toarray") else rows, np.float64)

    def bounded(group: Sequence[int], assumed: list[dict[int, ActivationPhases]]) -> list[_PhaseBranch]:
        check_cancelled()
        output_bounds = bound_outputs(
            network, _repeat_cell(images, len(assumed)), dense[list(group)], offset[list(group)],
            memory=memory, arithmetic=arithmetic, slope_steps=_STEPS, assumed=assumed,
        )  # fmt: skip
        return [_branch_of(output_bounds, number, phases) for number, phases in enumerate(assumed)]

    count, least = 0, np.inf
    settled = np.full(len(groups), -np.inf)
    if intermediate_steps and all(map(len, groups)):
        for steps in (0, intermediate_steps):
            if not (settled > 0.0).all():
                check_cancelled()
                branch_lower = bound_outputs(
                    network, images, dense, offset, memory=memory, arithmetic=arithmetic, slope_steps=steps,
                    intermediate_steps=steps,
                ).lower[0]  # fmt: skip
                count += 1
                settled = np.fmax(settled, [branch_lower[list(group)].max() for group in groups])
    for group, value in zip(groups, settled, strict=True):
        if value > 0.0:
            least = min(least, float(value))
            continue
        if not len(group):
            return BranchingResult(False, count, -np.inf)
        waiting: list[_PhaseBranch] = []
        assumed: list[dict[int, ActivationPhases]] = [{}]
        while assumed:
            branches = bounded(group, assumed)
            count += len(assumed)
            least = min([least, *(entry.value for entry in branches if entry.value > 0.0)])
            waiting = sorted([*waiting, *(entry for entry in branches if not entry.value > 0.0)], key=lambda e: e.value)
            if waiting and (waiting[0].unit[0] < 0 or count + 2 > most or enough()):
                return BranchingResult(False, count, waiting[0].value)
            taken, waiting = waiting[: _TOGETHER // 2], waiting[_TOGETHER // 2 :]
            assumed = [half for entry in taken for half in entry.halves()]
    return BranchingResult(True, count, least)


def _repeat_cell(images: ImageSets, count: int) -> ImageSets:
    """Return ``count`` copies of the single cell of ``images``."""
    return ImageSets(*(np.repeat(getattr(images, name), count, axis=0) for name in ImageSets.__dataclass_fields__))


def _branch_of(bounds: OutputBounds, number: int, phases: Mapping[int, ActivationPhases]) -> _PhaseBranch:
    """A branch by the bounds of its group's rows, of which one has to be positive; NaN is minus infinity."""
    lower = np.where(np.isnan(bounds.lower[number]), -np.inf, bounds.lower[number])
    best = int(lower.argmax())
    assert bounds.loosest is not None
    node, place = bounds.loosest[number, best].tolist()
    return _PhaseBranch(phases, float(lower[best]), (node, place))
