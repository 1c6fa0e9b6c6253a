"""Proofs by branching on the signs of units (docs/design.md, N15)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ns_abstract.execution.ending import checkpoint
from ns_abstract.verify.network.bounds import ImageSets, OutputBounds, Signs, bound_outputs
from ns_abstract.verify.network.graph import Network, NetworkArithmetic

#: Branches that are bounded together.
_TOGETHER = 16
#: Steps towards the best slopes and multipliers of each.
_STEPS = 12


@dataclass(frozen=True)
class Branching:
    """What became of a proof.

    Attributes:
        proved: Whether every branch was.
        branches: How many were bounded.
        least: By how much the weakest branch holds or fails; minus infinity where nothing is known of it.
    """

    proved: bool
    branches: int
    least: float


@dataclass(frozen=True)
class _Branch:
    """Signs that are assumed, with the value and the unit that `_judge` found for the branch they are of."""

    signs: Mapping[int, Signs]
    value: float
    unit: tuple[int, int]

    def halves(self) -> list[dict[int, Signs]]:
        """The same with either sign of the unit assumed besides."""
        node, place = self.unit
        flat, side = self.signs.get(node, (np.zeros(0, np.int64), np.zeros(0)))
        flat = np.append(flat, np.int64(place))
        return [{**self.signs, node: (flat, np.append(side, sign))} for sign in (1.0, -1.0)]


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
    enough: Callable[[], bool] = lambda: False,
) -> Branching:
    """Try to prove that in every group some of ``rows @ network(x) + offset`` is positive, on one set of images.

    Whichever evaluation is meant, the input of a ReLU is not negative or not positive in it: where the bounds leave
    the claim open, either is assumed, and both branches have to be proved. The weakest come first, so that a hopeless
    claim ends soon.

    Args:
        network, rows, offset, memory, arithmetic: See `bound_outputs`.
        images: One cell.
        groups: Numbers of rows.
        most: Branches after which it is given up.
        enough: Asked between batches of branches: whether to give up.
    """
    waiting: list[_Branch] = []
    count, least = 0, np.inf
    assumed: list[dict[int, Signs]] = [{}]
    while assumed:
        checkpoint()
        found = bound_outputs(
            network, _repeated(images, len(assumed)), rows, offset,
            memory=memory, arithmetic=arithmetic, slope_steps=_STEPS, assumed=assumed,
        )  # fmt: skip
        count += len(assumed)
        for number, signs in enumerate(assumed):
            value, unit = _judge(found, number, groups)
            if value > 0.0:
                least = min(least, value)
                continue
            waiting.append(_Branch(signs, value, unit))
        waiting.sort(key=lambda entry: entry.value)
        if waiting and (waiting[0].unit[0] < 0 or count + 2 > most or enough()):
            return Branching(False, count, waiting[0].value)
        taken, waiting = waiting[: _TOGETHER // 2], waiting[_TOGETHER // 2 :]
        assumed = [half for entry in taken for half in entry.halves()]
    return Branching(True, count, least)


def _repeated(images: ImageSets, count: int) -> ImageSets:
    """The one cell of ``images``, ``count`` times."""
    return ImageSets(*(np.repeat(getattr(images, name), count, axis=0) for name in ImageSets.__dataclass_fields__))


def _judge(found: OutputBounds, number: int, groups: Sequence[Sequence[int]]) -> tuple[float, tuple[int, int]]:
    """How far a branch is from its proof (positive: proved; NaN is minus infinity), and the unit to branch on."""
    value, unit = np.inf, (-1, -1)
    assert found.loosest is not None
    for group in groups:
        lower = np.where(np.isnan(found.lower[number]), -np.inf, found.lower[number])[list(group)]
        best = int(lower.argmax()) if len(group) else -1
        here = float(lower[best]) if len(group) else -np.inf
        if here < value:
            node, place = found.loosest[number, group[best]].tolist() if len(group) else (-1, -1)
            value, unit = here, (node, place)
    return value, unit
