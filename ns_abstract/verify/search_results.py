"""Results of a search for a cell and for a block of cells, and the errors that end one cell alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ns_abstract.verify.cells import Cell

Verdict = Literal["certified", "falsified", "unknown"]


@dataclass(frozen=True)
class FinishedCell:
    """A finished cell with its verdict.

    Attributes:
        margin: Proved lower bound of the margin; that of the counterexample; or the best bound, or None.
        counterexample: Parameter values, or None.
        image: [H, W, 3] float32 picture of the counterexample, or None.
        outputs: [n] of the network for it, or None.
        undecided: Whether some picture of the cell has a margin that is not finite.
        scene: Arrays that identify the counterexample's scene in the set, by name; None: only poses vary.
    """

    cell: Cell
    verdict: Verdict
    margin: float | None
    seconds: float
    counterexample: tuple[float, ...] | None = None
    image: np.ndarray | None = field(default=None, repr=False)
    outputs: np.ndarray | None = field(default=None, repr=False)
    reason: str = ""
    undecided: bool = False
    scene: Mapping[str, np.ndarray] | None = field(default=None, repr=False)


@dataclass(frozen=True)
class BlockResult:
    """The result of a block of cells.

    Attributes:
        ranks: Distance of each new block from a proof (see `Search._rank`); the nearest are examined first.
        samples: Whether the property holds at the middle of each cell.
        bounded: Number of cells whose network bounds were computed.
    """

    leaves: tuple[FinishedCell, ...]
    blocks: tuple[tuple[Cell, ...], ...]
    samples: tuple[tuple[Cell, bool], ...]
    bounded: int
    seconds: float
    ranks: tuple[float, ...] = ()


class ContradictionError(RuntimeError):
    """Raised where a cell was proved although a pose in it breaks the property: a fault of the program."""


#: What may go wrong in one cell without ending the run; lack of memory and a user's mistake do end it.
FAILURES = (ArithmeticError, ValueError, IndexError, KeyError, TypeError, RuntimeError, AssertionError)


def failure_text(error: Exception) -> str:
    """Return one of `FAILURES` as a line of text."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:200]
