"""Parts of a cell that linear sets prove, against rational arithmetic (design.md, Q8)."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from test_certify_search import drive, interval, volume

from ns_abstract.arithmetic.rounding import SUB_BOX_OVERLAP
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.verify.cells import Cell, CellGrid
from ns_abstract.verify.part_proofs import CellPart, partly_proved
from ns_abstract.verify.picture_measures import CellParts, Measure, shared_counts
from ns_abstract.verify.picture_properties import MeasureModel, parse_picture_property
from ns_abstract.verify.search import Search
from ns_abstract.verify.search_results import ContradictionError

VISIBLE = {"type": "visible", "select": {"box": [[-1, -1, -1], [1, 1, 0]]}, "weight": 0.5}
PIXELS, RANK = 12, 7


def _claim() -> Any:
    return parse_picture_property({**VISIBLE, "pixels": RANK}, Path()).bind(None, lambda: np.zeros(0))  # type: ignore[arg-type]


def _model() -> MeasureModel:
    return MeasureModel([Measure("depth", (1.0,), RANK, np.arange(PIXELS))], [0], 1)


def _sets(rng: np.random.Generator, d: int) -> tuple[np.ndarray, ...]:
    """A_lower, b_lower, A_upper, b_upper, lower and upper of pixels that pass the limit in the cell."""
    a = (0.2 * rng.normal(size=(1, PIXELS, 1, d))).astype(np.float32)
    b = (0.5 + 0.15 * rng.normal(size=(1, PIXELS, 1))).astype(np.float32)
    room = np.float32(0.01)
    reach = np.abs(a).sum(axis=-1) + np.float32(0.02)
    return a, b - room, a, b + room, b - reach, b + reach


def _grid(d: int) -> CellGrid:
    """Cells whose ends are rounded."""
    box = ParameterBox(("x", "y", "z")[:d], ("",) * d, (0.1, -0.7, 1.0 / 3.0)[:d], (0.37, 1.1, 2.3)[:d])
    return CellGrid(box, (48, 96, 32)[:d], (3, 3, 1)[:d])


def _holds(sets: tuple[np.ndarray, ...], box: ParameterBox, pose: np.ndarray) -> bool:
    """Whether the claim holds of the darkest picture of the sets at a pose, in rational numbers."""
    p = []
    for value, low, high in zip(pose.tolist(), box.lower, box.upper, strict=True):
        middle, half = (Fraction(low) + Fraction(high)) / 2, (Fraction(high) - Fraction(low)) / 2
        p.append((Fraction(value) - middle) / half)
    bright = 0
    for a, b, least in zip(
        sets[0][0, :, 0].tolist(), sets[1][0, :, 0].tolist(), sets[4][0, :, 0].tolist(), strict=True
    ):
        line = Fraction(b) + sum((Fraction(s) * x for s, x in zip(a, p, strict=True)), Fraction(0))
        bright += max(line, Fraction(least)) >= Fraction(1, 2)
    return bright >= RANK


def _provable(sets: tuple[np.ndarray, ...]) -> float:
    """The share of sixty-four parts of a cell over which enough pixels are bright, each by itself."""
    a = sets[0][0, :, 0].astype(np.float64)
    parts = CellParts.equal(shared_counts(np.abs(a).sum(axis=0), 64))
    darkest = parts.middles @ a.T + sets[1][0, :, 0] - parts.halves @ np.abs(a).T
    return float(((np.maximum(darkest, sets[4][0, :, 0]) > 0.5).sum(axis=1) >= RANK).mean())


def _parts(sets: tuple[np.ndarray, ...], cell: Cell, box: ParameterBox) -> list[CellPart]:
    model, claim = _model(), _claim()
    images = model.input_sets(sets[:4], sets[4], sets[5])
    return partly_proved(claim, model, claim.query(np.zeros((1, 1))), images, cell, box)


@pytest.mark.parametrize("d", [2, 3])
def test_parts_that_are_proved_hold_everywhere(d: int) -> None:
    rng, grid = np.random.default_rng(d), _grid(d)
    proved, provable = 0.0, 0.0
    for _ in range(60):
        sets = _sets(rng, d)
        first = [int(rng.integers(0, 3)) * 16 for _ in range(d)]
        cell = Cell(tuple(first[:2] + [0] * (d - 2)), tuple(a + 16 for a in first[:2] + [0] * (d - 2)))
        box = grid.box_of(cell)
        parts = _parts(sets, cell, box)
        provable += _provable(sets)
        if not parts:
            continue
        # they tile the cell
        owned = np.zeros(grid.units, int)
        for part in parts:
            owned[tuple(slice(a, b) for a, b in zip(part.cell.first, part.cell.past, strict=True))] += 1
        inside = np.zeros(grid.units, int)
        inside[tuple(slice(a, b) for a, b in zip(cell.first, cell.past, strict=True))] = 1
        np.testing.assert_array_equal(owned, inside)
        # none that is left is as large as the cell
        assert max(part.cell.volume for part in parts) <= cell.volume // 2
        for part in parts:
            if part.margin is None:
                continue
            assert part.margin > 0.0
            within = grid.box_of(part.cell)
            for pose in (*within.corners(), *within.sample(6, rng)):
                assert _holds(sets, box, pose)
        proved += sum(part.cell.volume for part in parts if part.margin is not None) / cell.volume
    # what is left out are parts among others that are left
    assert provable > 1.0 and proved > 0.6 * provable, (proved, provable)


def test_a_part_s_margin_is_its_least() -> None:
    """One pixel of twelve decides: the bound over a part is that of its darkest end."""
    d, grid = 2, _grid(2)
    a, b = np.zeros((1, PIXELS, 1, d), np.float32), np.full((1, PIXELS, 1), 0.9, np.float32)
    b[0, RANK:], a[0, RANK - 1, 0, 0], b[0, RANK - 1] = 0.1, 0.25, 0.625
    reach = np.abs(a).sum(axis=-1)
    cell = Cell((0, 0), (16, 32))
    parts = _parts((a, b, a, b, b - reach, b + reach), cell, grid.box_of(cell))
    assert {part.margin is None for part in parts} == {True, False}
    for part in parts:
        if part.margin is not None:
            darkest = 0.625 + 0.25 * (2.0 * part.cell.first[0] / 16.0 - 1.0) - 0.5
            assert darkest - 1e-6 < part.margin <= darkest


def test_parts_overlap() -> None:
    """Grid lines are rounded; parts reach beyond their ends."""
    counts = shared_counts(np.array([3.0, 1.0]), 16)
    parts, exact = CellParts.equal(counts, SUB_BOX_OVERLAP), CellParts.equal(counts)
    assert counts.tolist() == [8, 2]
    np.testing.assert_array_equal(parts.middles, exact.middles)
    np.testing.assert_array_equal(exact.halves, np.tile(1.0 / counts, (16, 1)))
    assert (parts.halves - exact.halves == SUB_BOX_OVERLAP).all()
    # a cell whose ends are rounded by more than that has none
    cell, box = Cell((0, 0), (16, 16)), interval(2)
    far = ParameterBox(box.names, box.units, (1e9, 1e9), (1e9 + 1e-5, 1e9 + 1e-5))
    sets = _sets(np.random.default_rng(2), 2)
    bright = (sets[0], sets[1] + 0.1, sets[2], sets[3] + 0.1, sets[4], sets[5] + 0.1)
    assert _parts(bright, cell, box) and not _parts(bright, cell, far)


class Disc:
    """Pictures of `PIXELS` pixels that are bright inside of a circle, each with a radius of its own."""

    def __init__(self, lie: float = 0.0) -> None:
        self.box, self.lie, self.bounded = interval(2), lie, 0
        self.radii = np.linspace(0.4, 0.9, PIXELS)

    def image(self, values: np.ndarray, member: Any = None) -> np.ndarray:
        return (0.5 + self.radii**2 - values @ values).reshape(1, PIXELS, 1).astype(np.float32)

    def linear_sets(self, box: ParameterBox) -> Any:
        self.bounded += 1
        half, middle = 0.5 * (np.array(box.upper) - np.array(box.lower)), box.middle
        a = np.broadcast_to(-2.0 * middle * half, (1, PIXELS, 1, 2))
        b = (0.5 + self.radii**2 - middle @ middle).reshape(1, PIXELS, 1)
        curve = half @ half
        room = 1e-6
        low, high = b - curve - room + self.lie, b + room + self.lie
        reach = np.abs(a).sum(axis=-1)
        return (a, low, a, high), low - reach, high + reach, np.abs(a).mean(axis=(0, 1, 2))

    def scene_samples(self, seed: int) -> Iterator[Any]:
        return iter(())

    def differentiable(self, values: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(self.image(values.numpy()))


def _search(scene: Disc) -> Search:
    return Search(scene, _model(), _claim(), CellGrid(scene.box, (128, 128), (2, 2)), costly=False)


def test_cells_are_certified_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Verdicts are the truth, cells tile the set, and what is unknown lies within a unit or so of the circle."""
    scene = Disc()
    search = _search(scene)
    leaves, _ = drive(search)
    grid, radius = search.grid, np.sort(scene.radii)[::-1][RANK - 1]
    assert volume(leaves) == grid.volume
    for leaf in leaves:
        box = grid.box_of(leaf.cell)
        far = np.maximum(np.abs(box.lower), np.abs(box.upper))
        if leaf.verdict == "certified":
            assert far @ far <= radius**2
        elif leaf.verdict == "unknown":
            assert abs(np.sqrt(box.middle @ box.middle) - radius) < 4.0 * np.sqrt(2.0) / 128.0
    assert volume(leaves, "certified") > 0.9 * np.pi / 4.0 * radius**2 * grid.volume
    # without parts, the same is certified by more cells
    whole = Disc()
    monkeypatch.setattr("ns_abstract.verify.search.partly_proved", lambda *_: [])
    others, _ = drive(_search(whole))
    assert volume(leaves, "certified") >= volume(others, "certified")
    assert scene.bounded < 0.8 * whole.bounded, (scene.bounded, whole.bounded)


def test_parts_are_attacked() -> None:
    """Sets that miss the pictures by a little prove parts in which the property fails at a corner or a random pose."""
    with pytest.raises(ContradictionError, match="internal error"):
        drive(_search(Disc(lie=0.1)))
