"""Parts of a cell that linear sets prove, against rational arithmetic (design.md, Q8)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
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
from ns_abstract.verify.part_proofs import CellPart, PartQuestion, narrowed
from ns_abstract.verify.picture_measures import CellParts, Measure, SubBoxEnds, planes_of, shared_counts
from ns_abstract.verify.picture_properties import MeasureModel, parse_picture_property
from ns_abstract.verify.properties import Claim
from ns_abstract.verify.protocol import DividedImages
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


def _holds(sets: tuple[np.ndarray, ...], box: ParameterBox, pose: np.ndarray, brightest: bool = False) -> bool:
    """Whether the claim holds of the darkest, or the brightest, picture of the sets at a pose, in rational numbers."""
    p = []
    for value, low, high in zip(pose.tolist(), box.lower, box.upper, strict=True):
        middle, half = (Fraction(low) + Fraction(high)) / 2, (Fraction(high) - Fraction(low)) / 2
        p.append((Fraction(value) - middle) / half)
    bright = 0
    slopes, offsets, ends = (sets[k][0, :, 0].tolist() for k in ((2, 3, 5) if brightest else (0, 1, 4)))
    for a, b, end in zip(slopes, offsets, ends, strict=True):
        line = Fraction(b) + sum((Fraction(s) * x for s, x in zip(a, p, strict=True)), Fraction(0))
        bright += (min if brightest else max)(line, Fraction(end)) >= Fraction(1, 2)
    return bright >= RANK


def _decidable(sets: tuple[np.ndarray, ...]) -> np.ndarray:
    """The shares of sixty-four parts of a cell over which enough pixels are bright, each by itself, and of its halves
    along all divided parameters over which enough are dark."""
    a = sets[0][0, :, 0].astype(np.float64)
    counts = shared_counts(np.abs(a).sum(axis=0), 64)
    parts = CellParts.equal(counts)
    middle, reach = parts.middles @ a.T, parts.halves @ np.abs(a).T
    darkest = np.maximum(middle + sets[1][0, :, 0] - reach, sets[4][0, :, 0])
    brightest = np.minimum(middle + sets[3][0, :, 0] + reach, sets[5][0, :, 0])
    bright, dark = (darkest > 0.5).sum(axis=1) >= RANK, (brightest < 0.5).sum(axis=1) > PIXELS - RANK
    dark = dark.reshape(counts)
    for axis, count in enumerate(counts.tolist()):
        if count > 1:
            dark = np.stack([half.all(axis=axis) for half in np.split(dark, 2, axis)], axis)
    return np.array([bright.mean(), dark.mean()])


def _parts(sets: tuple[np.ndarray, ...], cell: Cell, box: ParameterBox) -> list[CellPart]:
    model, claim = _model(), _claim()
    images = model.input_sets(sets[:4], sets[4], sets[5])
    return PartQuestion(claim, model, claim.query(np.zeros((1, 1)))).parts(images, cell, box)


@pytest.mark.parametrize("d", [2, 3])
def test_parts_that_are_decided_are_so_everywhere(d: int) -> None:
    rng, poses, grid = np.random.default_rng(d), np.random.default_rng(17), _grid(d)
    decided, decidable = np.zeros(2), np.zeros(2)
    for _ in range(60):
        sets = _sets(rng, d)
        first = [int(rng.integers(0, 3)) * 16 for _ in range(d)]
        cell = Cell(tuple(first[:2] + [0] * (d - 2)), tuple(a + 16 for a in first[:2] + [0] * (d - 2)))
        box = grid.box_of(cell)
        parts = _parts(sets, cell, box)
        decidable += _decidable(sets)
        if not parts:
            continue
        # they tile the cell
        owned = np.zeros(grid.units, int)
        for part in parts:
            owned[tuple(slice(a, b) for a, b in zip(part.cell.first, part.cell.past, strict=True))] += 1
        inside = np.zeros(grid.units, int)
        inside[tuple(slice(a, b) for a, b in zip(cell.first, cell.past, strict=True))] = 1
        np.testing.assert_array_equal(owned, inside)
        for part in parts:
            share = part.cell.volume / cell.volume
            if part.verdict is None:
                # none that is left is as large as the cell
                assert share <= 0.5
                continue
            fails = part.verdict == "falsified"
            assert part.margin <= 0.0 if fails else part.margin > 0.0
            within = grid.box_of(part.cell)
            for pose in (*within.corners(), *within.sample(6, poses if fails else rng)):
                assert _holds(sets, box, pose, brightest=fails) is not fails
            decided[int(fails)] += share
    # what is left out are parts among others that are left
    assert decidable[0] > 1.0 and decided[0] > 0.6 * decidable[0], (decided, decidable)
    assert decidable[1] > 0.5 and decided[1] > 0.99 * decidable[1], (decided, decidable)


def test_a_part_s_margin_is_its_least() -> None:
    """One pixel of twelve decides: bounds over a part are those of its darkest end, or of its brightest."""
    d, grid = 2, _grid(2)
    cell = Cell((0, 0), (16, 32))

    def parts(middle: float) -> list[CellPart]:
        a, b = np.zeros((1, PIXELS, 1, d), np.float32), np.full((1, PIXELS, 1), 0.9, np.float32)
        b[0, RANK:], a[0, RANK - 1, 0, 0], b[0, RANK - 1] = 0.1, 0.25, middle
        reach = np.abs(a).sum(axis=-1)
        return _parts((a, b, a, b, b - reach, b + reach), cell, grid.box_of(cell))

    proved = parts(0.625)
    assert {part.verdict for part in proved} == {"certified", None}
    for part in proved:
        if part.verdict == "certified":
            darkest = 0.625 + 0.25 * (2.0 * part.cell.first[0] / 16.0 - 1.0) - 0.5
            assert darkest - 1e-6 < part.margin <= darkest
    # a half that fails everywhere is one part, what is left beside what is proved is not cut further
    refuted = [part for part in parts(0.4375) if part.verdict == "falsified"]
    assert refuted and {(part.cell.first[0], part.cell.past[0]) for part in refuted} == {(0, 8)}
    assert all(-0.0625 <= part.margin < -0.0625 + 1e-6 for part in refuted)
    (whole,) = parts(0.125)
    assert whole.cell == cell and whole.verdict == "falsified" and -0.125 <= whole.margin < -0.125 + 1e-6


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


def test_ends_over_sub_boxes_are_those_of_their_pixels() -> None:
    """Each pixel and sub-box takes its own ends where these say more, in whatever region a measure reads (Q8)."""
    rng, d = np.random.default_rng(4), 2
    sets = _sets(rng, d)
    counts, some = np.array([4, 2]), np.array([1, 4, 7, 11])
    low = rng.uniform(0.2, 0.6, (8, some.size, 1))
    ends = SubBoxEnds(counts, some, low, low + rng.uniform(0.0, 0.4, low.shape))
    (planes,) = planes_of(_model().input_sets(sets[:4], sets[4], sets[5]), 1)
    parts = CellParts.equal(counts, SUB_BOX_OVERLAP)
    gained = 0
    for region in (np.arange(PIXELS), np.array([0, 4, 5, 11]), np.array([2, 3]), np.array([7]), np.array([0])):
        plain = planes.over(parts, region, 0, np.ones(1))
        found = replace(planes, ends=ends).over(parts, region, 0, np.ones(1))
        for column, pixel in enumerate(region.tolist()):
            (place,) = np.nonzero(some == pixel)
            for side, own, better in ((0, ends.lower, np.maximum), (1, ends.upper, np.minimum)):
                expected = plain[side][:, column]
                if place.size:
                    expected = better(expected, own[:, place[0], 0])
                    gained += int((expected != plain[side][:, column]).sum())
                np.testing.assert_allclose(found[side][:, column], expected, rtol=0.0, atol=1e-11)
                # outward
                np.testing.assert_array_equal(better(found[side][:, column], expected), expected)
    assert gained > 20
    # ends of other parts say nothing of these
    images = _model().input_sets(sets[:4], sets[4], sets[5])
    with pytest.raises(AssertionError):
        _model().bound_parts(images, counts[::-1], ends)


class Disc:
    """Pictures of `PIXELS` pixels that are bright inside of a circle, each with a radius of its own."""

    def __init__(self, lie: float = 0.0) -> None:
        self.box, self.lie, self.bounded, self.drawn = interval(2), lie, 0, 0
        self.radii = np.linspace(0.4, 0.9, PIXELS)

    def image(self, values: np.ndarray, scene_sample: Any = None) -> np.ndarray:
        self.drawn += 1
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
    monkeypatch.setattr(PartQuestion, "bounded", lambda *_: [])
    scene = Disc()
    leaves, _ = drive(_search(scene))
    whole = Disc()
    monkeypatch.setattr(PartQuestion, "parts", lambda *_: [])
    others, _ = drive(_search(whole))
    assert volume(leaves, "certified") >= volume(others, "certified")
    assert scene.bounded < 0.8 * whole.bounded, (scene.bounded, whole.bounded)


def test_parts_are_attacked() -> None:
    """Sets that miss the pictures by a little prove parts in which the property fails at a corner or a random pose."""
    with pytest.raises(ContradictionError, match="internal error"):
        drive(_search(Disc(lie=0.1)))


class Spots(Disc):
    """Those of `Disc`, with bounds that say less than the truth: that no picture is bright."""

    def linear_sets(self, box: ParameterBox) -> Any:
        (a, low, _, _), lower, _, slopes = super().linear_sets(box)
        top = np.full_like(low, 0.4)
        return (a, np.minimum(low, 0.3), 0.0 * a, top), np.minimum(lower, 0.3), top, slopes


def test_parts_that_are_refuted_are_attacked() -> None:
    """At the middle of such a part the property fails as it was drawn, or the program has a fault."""
    with pytest.raises(ContradictionError, match="margin proved to be at most"):
        drive(_search(Spots()))


def test_refuted_parts_are_falsified_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same is decided by fewer pictures; units of a fixed partition are decided one by one."""
    scene = Disc()
    leaves, _ = drive(_search(scene))
    monkeypatch.setattr("ns_abstract.verify.picture_properties.PictureClaim.refuted", Claim.refuted)
    blind = Disc()
    others, _ = drive(_search(blind))
    for verdict in ("certified", "falsified"):
        assert volume(leaves, verdict) > 0.999 * volume(others, verdict)
    assert scene.drawn < 0.9 * blind.drawn, (scene.drawn, blind.drawn)
    monkeypatch.undo()
    scene = Disc()
    grid = CellGrid.fixed(scene.box, (32, 32), (2, 2))
    leaves, _ = drive(Search(scene, _model(), _claim(), grid, costly=False, every_unit=True))
    assert volume(leaves) == grid.volume
    assert all(leaf.cell.volume == 1 for leaf in leaves if leaf.verdict == "falsified")


def test_parts_that_are_left_are_bounded_by_themselves(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same is decided by fewer pictures, and no part is said to be certified that is not."""
    scene = Disc()
    leaves, _ = drive(_search(scene))
    monkeypatch.setattr(PartQuestion, "bounded", lambda *_: [])
    once = Disc()
    others, _ = drive(_search(once))
    for verdict in ("certified", "falsified"):
        assert volume(leaves, verdict) > 0.99 * volume(others, verdict)
    assert scene.drawn < 0.96 * once.drawn, (scene.drawn, once.drawn)
    radius = np.sort(scene.radii)[::-1][RANK - 1]
    for leaf in leaves:
        if leaf.verdict == "certified":
            box = _search(scene).grid.box_of(leaf.cell)
            far = np.maximum(np.abs(box.lower), np.abs(box.upper))
            assert far @ far <= radius**2


class Halved(Disc):
    """Those of `Disc`, with bounds over sub-boxes; ``asked`` are what `narrowed` was given."""

    def __init__(self) -> None:
        super().__init__()
        self.asked: list[tuple[SubBoxEnds, np.ndarray]] = []

    def sub_box_counts(self, box: ParameterBox, most: int) -> np.ndarray:
        return np.array([4, 4])

    def divided_sets(self, box: ParameterBox, counts: np.ndarray) -> Any:
        sets = self.linear_sets(box)
        (planes,) = planes_of(_model().input_sets(tuple(a[None] for a in sets[0]), sets[1][None], sets[2][None]), 1)
        low, high = planes.over(CellParts.equal(counts, SUB_BOX_OVERLAP), np.arange(PIXELS), 0, np.ones(1))
        return sets, SubBoxEnds(counts, np.arange(PIXELS), low[..., None], high[..., None])

    def narrowed(self, ends: SubBoxEnds, sub_boxes: np.ndarray) -> Halved:
        self.asked.append((ends, sub_boxes))
        return self


def test_parts_are_narrowed_by_their_own_sub_boxes() -> None:
    """What is known of a part that is left are the sub-boxes of the cell that it consists of (Q9)."""
    scene = Halved()
    assert isinstance(scene, DividedImages)
    grid, cell = _search(scene).grid, Cell((32, 32), (64, 64))
    _, ends = scene.divided_sets(grid.box_of(cell), np.array([4, 4]))
    part = Cell((48, 40), (64, 48))
    assert narrowed(scene, cell, part, None) is scene and not scene.asked
    narrowed(scene, cell, part, ends)
    expected = np.zeros((4, 4), bool)
    expected[2:, 1:2] = True
    ((given, chosen),) = scene.asked
    assert given is ends
    np.testing.assert_array_equal(chosen, expected)
    # the search narrows every part that it bounds once more
    scene = Halved()
    leaves, _ = drive(_search(scene))
    assert scene.asked and volume(leaves) == _search(scene).grid.volume
    plain, _ = drive(_search(Disc()))
    assert volume(leaves, "certified") > 0.99 * volume(plain, "certified")


@pytest.mark.parametrize("name", ["exception", "no number", "crossed"])
def test_sets_of_a_part_that_cross_decide_nothing(name: str) -> None:
    """Where a part has no sets of its own it is left to the search, which says why."""

    class Bad(Disc):
        def linear_sets(self, box: ParameterBox) -> Any:
            if name == "exception":
                raise RuntimeError("planted")
            linear, lower, upper, slopes = super().linear_sets(box)
            return linear, upper + 0.1 if name == "crossed" else lower * np.nan, upper, slopes

    question = PartQuestion(_claim(), _model(), _claim().query(np.zeros((1, 1))))
    grid, cell = _search(Disc()).grid, Cell((44, 44), (60, 60))
    assert {part.verdict for part in question.bounded(Disc(), grid, cell)} == {"certified"}
    assert question.bounded(Bad(), grid, cell) == []
