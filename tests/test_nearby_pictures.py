"""Small cells from what is known of boxes around them: settled pixels, enclosing boxes, pictures of few pixels."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import Inputs
from test_picture_properties import Case

from ns_abstract.api.nearby_pictures import KnownBoxes, NearbyPictures, NearbyTuning
from ns_abstract.api.picture_question import PlanePictures
from ns_abstract.arithmetic.rounding import SUB_BOX_OVERLAP
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.enclosing_boxes import enclosing_box, shared_box
from ns_abstract.geometry.tiles import assemble
from ns_abstract.methods.splat.stage_data import cell_parts
from ns_abstract.methods.splat.weights import SplatWeightFrame
from ns_abstract.verify.picture_measures import CellParts, Measure, PlaneSets
from ns_abstract.verify.picture_sets import PictureSets
from ns_abstract.verify.protocol import ComparedCuts, DividedImages, NearImages
from ns_abstract.verify.search_results import ContradictionError
from ns_abstract.verify.settled_pixels import LimitedMeasure, unsettled

SPEC = {"version": 1, "translation": {"x": 0.05, "y": 0.05}, "rotation": {"yaw": 0.02}}
ONE = {"type": "visible", "select": {"box": [[-1, -1, -1], [1, 1, 0]]}, "weight": 0.5, "pixels": 60}
#: A quarter of the pixels.
SMALL = {**ONE, "pixels": 15, "preprocess": {"resize": [16, 16]}}
CLEAR = {"type": "clear", "distance": 1.45, "weight": 0.55, "region": [4, 4, 28, 28]}
OTHER = {"type": "visible", "select": {"box": [[-1, -1, 0], [1, 1, 1]]}, "weight": 0.4, "fraction": 0.1}


# ---------------------------------------------------------------- settled pixels


def _verdicts(one: LimitedMeasure, pictures: np.ndarray) -> np.ndarray:
    """On which side of every limit the value of each picture [B, n] lies."""
    value = one.measure.value(torch.from_numpy(pictures)[:, None, :, None], one.place).numpy()
    return np.stack([value > limit for limit in one.limits], axis=1)


def test_settled_pixels_change_no_verdict() -> None:
    rng, n = np.random.default_rng(0), 12
    settled = 0
    for k in range(300):
        low = rng.uniform(-0.2, 1.0, n)
        high = low + rng.uniform(0.0, 0.3, n)
        rank, least = int(rng.integers(1, n + 1)), bool(k % 2)
        limits = tuple(rng.uniform(0.1, 0.9, 1 + k % 2).tolist())
        one = LimitedMeasure(Measure("depth", (1.0,), rank, np.arange(n), least), 0, limits)
        (open_,) = unsettled([one], low[None, :, None], high[None, :, None])
        ends = np.where(rng.random((16, n)) < 0.5, low, high)
        inside = np.concatenate([ends, low + rng.uniform(size=(16, n)) * (high - low), [low, high]])
        # the pixels that are not settled are the same in all of them, of several kinds
        for kept in (low, high, low + rng.uniform(size=n) * (high - low)):
            verdicts = _verdicts(one, np.where(open_, kept, inside))
            assert (verdicts == verdicts[0]).all()
        settled += int((~open_).sum())
    # more than half of all; a rule that settles none would pass
    assert settled > 0.5 * 300 * n


def test_only_pixels_that_may_decide_are_open() -> None:
    low, high = np.array([0.9, 0.8, 0.4, 0.4, 0.0, 0.0]), np.array([1.0, 0.9, 0.6, 0.6, 0.1, 0.1])

    def of(rank: int | None, **more: Any) -> list[int]:
        measure = Measure("depth", (1.0,), rank, np.arange(6), **more)
        found = unsettled([LimitedMeasure(measure, 0, (0.5,))], low[None, :, None], high[None, :, None])
        return np.flatnonzero(found).tolist()

    # two are surely bright, and four at most
    assert [of(rank) for rank in (1, 2, 3, 4, 5, 6)] == [[], [], [2, 3], [2, 3], [], []]
    assert [of(rank, least=True) for rank in (1, 2, 3, 4, 5, 6)] == [[], [], [2, 3], [2, 3], [], []]
    # by how much pixels are beyond a limit matters to means, differences and depths that are capped
    every = list(range(6))
    assert of(None) == every and of(2, minus=np.arange(3)) == every and of(2, cap=0.7) == every
    assert not unsettled([], low[None, :, None], high[None, :, None]).any()


# ---------------------------------------------------------------- enclosing boxes


def test_enclosing_boxes_hold_cells_and_are_shared() -> None:
    rng = np.random.default_rng(0)
    whole = ParameterBox(("x", "y"), ("", ""), (-0.7, 2.0), (1.9, 2.3))
    shared = set()
    for _ in range(2000):
        width = 2.0 ** -rng.uniform(4.0, 12.0, 2) * (np.array(whole.upper) - whole.lower)
        low = np.array(whole.lower) + rng.uniform(size=2) * (np.array(whole.upper) - whole.lower - width)
        cell = ParameterBox(whole.names, whole.units, tuple(low.tolist()), tuple((low + width).tolist()))
        box = enclosing_box(cell, whole, np.ones(2))
        assert box is not None
        assert all(a >= b for a, b in zip(cell.lower, box.lower, strict=True))
        assert all(a <= b for a, b in zip(cell.upper, box.upper, strict=True))
        shares = (np.array(box.upper) - box.lower) / width
        assert (shares >= 1.99).all() and (shares <= 8.01).all()
        inner = enclosing_box(box, whole, np.ones(2))
        assert inner is None or inner != box
        shared.add(box)
    # of a cell that ends a rounding behind a line of the grid, too
    for end in (0.6, np.nextafter(0.6, 1.0), 0.6 + 1e-9):
        cell = whole.replace(0, 0.6 - 2.6 / 64.0, float(end)).replace(1, 2.0, 2.01)
        box = enclosing_box(cell, whole, np.ones(2))
        assert box is not None and box.contains(np.array(cell.upper)) and box.contains(np.array(cell.lower))
    # neighbours have the same one
    cells = [part for half in whole.split(0, 64) for part in half.split(1, 64)]
    assert len({enclosing_box(cell, whole, np.ones(2)) for cell in cells}) == 32 * 32
    # pictures that move far, or of which this is not known, have none
    assert enclosing_box(cells[0], whole, np.full(2, 1e3)) is None
    assert enclosing_box(cells[0], whole, np.full(2, math.inf)) is None
    assert enclosing_box(whole, whole, np.zeros(2)) is None


def test_boxes_around_enclosing_boxes_hold_them_and_are_few() -> None:
    rng = np.random.default_rng(1)
    whole = ParameterBox(("x", "y", "z"), ("", "", ""), (-0.7, 2.0, 0.0), (1.9, 2.3, 1.0))
    motion, size = np.array([3.0, 3.1, 0.4]), np.array(whole.upper) - whole.lower
    for _ in range(500):
        width = 2.0 ** -rng.uniform(2.0, 7.0, 3) * size
        low = np.array(whole.lower) + rng.uniform(size=3) * (size - width)
        cell = ParameterBox(whole.names, whole.units, tuple(low.tolist()), tuple((low + width).tolist()))
        box, chain = enclosing_box(cell, whole, motion), 0
        while box is not None and (around := shared_box(box, whole, motion)) is not None:
            assert all(a >= b for a, b in zip(box.lower, around.lower, strict=True))
            assert all(a <= b for a, b in zip(box.upper, around.upper, strict=True))
            assert around != box
            box, chain = around, chain + 1
        assert chain <= 8 and (box is None or box == whole)
    # whatever shapes cells have, the boxes around theirs have few: the picture moves alike over their sides
    shapes, shared = set(), set()
    for counts in ((16, 4, 1), (4, 16, 2), (16, 16, 1), (8, 16, 4)):
        parts = [whole]
        for axis, count in enumerate(counts):
            parts = [piece for part in parts for piece in part.split(axis, count)]
        for part in parts:
            around = shared_box(part, whole, motion)
            assert around is not None
            shapes.add(tuple(np.round(size / (np.array(around.upper) - around.lower)).astype(int).tolist()))
            shared.add(around)
    assert shapes == {(4, 4, 1), (8, 8, 2)} and len(shared) == 4 * 4 + 8 * 8 * 2
    assert shared_box(whole, whole, motion) is None
    assert shared_box(whole.split(0, 4)[1], whole, np.full(3, 1e3)) is None
    assert shared_box(whole.split(0, 4)[1], whole, np.array([1.0, math.inf, 0.0])) is None
    # a parameter that moves nothing is not cut
    around = shared_box(whole.split(0, 4)[1].split(2, 8)[3], whole, np.array([1.0, 1.0, 0.0]))
    assert around == whole


# ---------------------------------------------------------------- pictures


def _pictures(folder: Path, blobs: Inputs, prop: Any) -> tuple[Any, PlanePictures]:
    return Case(folder, blobs, prop, SPEC).pictures


def _frame(pictures: PlanePictures) -> tuple[SplatWeightFrame, list[int]]:
    frame, channels = pictures.weights[0]
    assert isinstance(frame, SplatWeightFrame)
    return frame, channels


def _tight(folder: Path, blobs: Inputs, props: list[Any]) -> Any:
    """A property whose limits are what the middle of the set has: it holds at some poses nearby and fails at others."""
    found = []
    for k, prop in enumerate(props):
        job, pictures = _pictures(folder / str(k), blobs, prop)
        value = job.model.outputs(pictures.image(pictures.box.middle)[None])[0, 0]
        found.append({**prop, "weight": float(value)})
    return {"all": [found[0], {"any": found[1:]}]} if found[1:] else found[0]


def _cells(whole: ParameterBox, count: int, rng: np.random.Generator, widest: float = 4.0) -> list[ParameterBox]:
    found = []
    for _ in range(count):
        width = 2.0 ** -rng.uniform(widest, 2.0 * widest, whole.dimensions) * (np.array(whole.upper) - whole.lower)
        low = np.array(whole.lower) + rng.uniform(size=width.size) * (np.array(whole.upper) - whole.lower - width)
        found.append(ParameterBox(whole.names, whole.units, tuple(low.tolist()), tuple((low + width).tolist())))
    return found


def _attack(job: Any, pictures: PlanePictures, cells: list[ParameterBox], poses: int) -> list[int]:
    """Compare pictures and sets near each cell with whole pictures; returns how many pixels are open by cell."""
    rng, count = np.random.default_rng(5), []
    claim = job.claim(pictures)
    channels = [channel for _, some in pictures.weights for channel in some]
    for cell in cells:
        near = pictures.near(cell)
        assert isinstance(near, NearbyPictures)
        open_ = near._known.open
        (a_low, b_low, a_high, b_high), lower, upper, _ = near.linear_sets(cell)
        assert (lower <= upper).all()
        middle, half = cell.middle, 0.5 * (np.array(cell.upper) - cell.lower)
        for pose in (middle, *cell.corners(), *cell.sample(poses, rng)):
            whole, shown = pictures.image(pose), near.image(pose)
            np.testing.assert_array_equal(shown[open_][:, channels], whole[open_][:, channels])
            values, scaled = whole[..., channels].astype(np.float64), (pose - middle) / half
            assert ((lower[..., channels] <= values) & (values <= upper[..., channels])).all()
            low, high = (
                a[..., channels, :].astype(np.float64) @ scaled + b[..., channels]
                for a, b in ((a_low, b_low), (a_high, b_high))
            )
            assert ((low <= values) & (values <= high)).all()
            margins = claim.margin(
                torch.from_numpy(job.model.outputs(np.stack([whole, shown]))), torch.from_numpy(np.stack([pose, pose]))
            )
            assert bool(margins[0] > 0.0) == bool(margins[1] > 0.0)
        count.append(int(open_.sum()))
    return count


def test_pictures_near_a_cell_are_those_of_the_set(blobs: Inputs, tmp_path: Path) -> None:
    job, pictures = _pictures(tmp_path, blobs, _tight(tmp_path, blobs, [SMALL]))
    assert isinstance(pictures, NearImages)
    count = _attack(job, pictures, _cells(pictures.box, 3, np.random.default_rng(1)), 1)
    # few pixels are left of 256
    assert 0 < np.mean(count) < 64


@pytest.mark.slow
@pytest.mark.parametrize("several", [False, True])
def test_many_pictures_near_cells_are_those_of_the_set(several: bool, blobs: Inputs, tmp_path: Path) -> None:
    job, pictures = _pictures(tmp_path, blobs, _tight(tmp_path, blobs, [ONE, CLEAR, OTHER] if several else [ONE]))
    count = _attack(job, pictures, _cells(pictures.box, 40, np.random.default_rng(2)), 120)
    assert 0 < np.mean(count) < 400


def _attack_sub_boxes(pictures: PlanePictures, cells: list[ParameterBox], poses: int) -> tuple[list[float], int]:
    """Compare bounds over sub-boxes with whole pictures; their widths beside those of the cells' sets, and ends."""
    rng, shares, count = np.random.default_rng(6), [], 0
    channels = [channel for _, some in pictures.weights for channel in some]
    for cell in cells:
        near = pictures.near(cell)
        assert isinstance(near, NearbyPictures) and isinstance(near, DividedImages)
        counts = near.sub_box_counts(cell, 16)
        if counts is None:
            continue
        assert counts.prod() == 16
        sets, ends = near.divided_sets(cell, counts)
        alone = near.linear_sets(cell)
        for one, other in zip((*sets[0], *sets[1:]), (*alone[0], *alone[1:]), strict=True):
            np.testing.assert_array_equal(one, other)
        assert ends is not None and ends.counts is counts
        np.testing.assert_array_equal(ends.pixels, np.flatnonzero(near._known.open))
        parts, half = cell_parts(counts, SUB_BOX_OVERLAP), 0.5 * (np.array(cell.upper) - cell.lower)
        middles = parts.middles.T
        for number, middle in enumerate(middles):
            signs = rng.choice([-1.0, 1.0], (poses, middle.size)), rng.uniform(-1.0, 1.0, (poses, middle.size))
            for place in np.clip(middle + parts.half * np.concatenate(signs), -1.0, 1.0):
                whole = pictures.image(cell.middle + half * place).reshape(-1, near._known.lower.shape[-1])
                values = whole[ends.pixels][:, channels].astype(np.float64)
                low, high = ends.lower[number][:, channels], ends.upper[number][:, channels]
                assert ((low <= values) & (values <= high)).all()
                count += values.size
        lower, upper = (a.reshape(-1, a.shape[-1]) for a in sets[1:3])
        planes = PlaneSets(tuple(a.reshape(-1, *a.shape[2:]) for a in sets[0]), lower, upper)
        found = planes.over(CellParts.equal(counts, SUB_BOX_OVERLAP), ends.pixels, channels[0], np.ones(1))
        shares.append(float((ends.upper - ends.lower)[..., channels[0]].mean() / (found[1] - found[0]).mean()))
    return shares, count


def test_bounds_over_sub_boxes_are_those_of_their_pictures(blobs: Inputs, tmp_path: Path) -> None:
    _, pictures = _pictures(tmp_path, blobs, _tight(tmp_path, blobs, [SMALL]))
    shares, count = _attack_sub_boxes(pictures, _cells(pictures.box, 3, np.random.default_rng(1)), 1)
    assert count > 0 and np.mean(shares) < 1.0, shares


@pytest.mark.slow
@pytest.mark.parametrize("several", [False, True])
def test_many_bounds_over_sub_boxes_are_those_of_their_pictures(several: bool, blobs: Inputs, tmp_path: Path) -> None:
    _, pictures = _pictures(tmp_path, blobs, _tight(tmp_path, blobs, [ONE, CLEAR, OTHER] if several else [ONE]))
    shares, count = _attack_sub_boxes(pictures, _cells(pictures.box, 12, np.random.default_rng(2)), 3)
    assert count > 0 and np.mean(shares) < 1.0, shares


def _attack_narrowed(job: Any, pictures: PlanePictures, cells: list[ParameterBox], poses: int) -> tuple[int, int]:
    """Compare sets over parts of cells, by what is known of their sub-boxes, with whole pictures; pixels before, after.

    Whatever lies within the bounds of pixels that are settled, every picture of the part has the verdict that it has.
    """
    rng, before, after = np.random.default_rng(8), 0, 0
    claim = job.claim(pictures)
    channels = [channel for _, some in pictures.weights for channel in some]
    for cell in cells:
        near = pictures.near(cell)
        assert isinstance(near, NearbyPictures)
        counts = near.sub_box_counts(cell, 32)
        if counts is None:
            continue
        _, ends = near.divided_sets(cell, counts)
        assert ends is not None
        # a block of sub-boxes, and the box that it covers
        first = [int(rng.integers(n)) for n in counts]
        past = [int(rng.integers(a + 1, min(n, a + 2) + 1)) for a, n in zip(first, counts.tolist(), strict=True)]
        chosen = np.zeros(counts, bool)
        chosen[tuple(slice(*span) for span in zip(first, past, strict=True))] = True
        part = cell
        for axis, (a, b) in enumerate(zip(first, past, strict=True)):
            pieces = cell.split(axis, int(counts[axis]))
            part = part.replace(axis, pieces[a].lower[axis], pieces[b - 1].upper[axis])
        narrowed = near.narrowed(ends, chosen)
        assert not (narrowed._known.open & ~near._known.open).any()
        before, after = before + int(near._known.open.sum()), after + int(narrowed._known.open.sum())
        sets = narrowed.linear_sets(part)
        (a_low, b_low, a_high, b_high), lower, upper, _ = sets
        assert (lower[..., channels] <= upper[..., channels]).all()
        middle, half, settled = part.middle, 0.5 * (np.array(part.upper) - part.lower), ~narrowed._known.open
        for pose in (middle, *part.corners(), *part.sample(poses, rng)):
            whole, scaled = pictures.image(pose), (pose - middle) / half
            values = whole[..., channels].astype(np.float64)
            assert ((lower[..., channels] <= values) & (values <= upper[..., channels])).all()
            low, high = (
                a[..., channels, :].astype(np.float64) @ scaled + b[..., channels]
                for a, b in ((a_low, b_low), (a_high, b_high))
            )
            assert ((low <= values) & (values <= high)).all()
            shown = [whole]
            for side in (lower, upper):
                shown.append(np.where(settled[..., None], side, whole))
            verdicts = claim.margin(
                torch.from_numpy(job.model.outputs(np.stack(shown))), torch.from_numpy(np.stack([pose] * 3))
            )
            assert len({bool(margin > 0.0) for margin in verdicts}) == 1
    return before, after


def test_parts_of_a_cell_bound_what_its_sub_boxes_leave_open(blobs: Inputs, tmp_path: Path) -> None:
    job, pictures = _pictures(tmp_path, blobs, _tight(tmp_path, blobs, [SMALL]))
    before, after = _attack_narrowed(job, pictures, _cells(pictures.box, 6, np.random.default_rng(1), 3.0), 1)
    assert 0 < after < 0.8 * before, (after, before)


@pytest.mark.slow
@pytest.mark.parametrize("several", [False, True])
def test_many_parts_of_cells_bound_what_is_left_open(several: bool, blobs: Inputs, tmp_path: Path) -> None:
    job, pictures = _pictures(tmp_path, blobs, _tight(tmp_path, blobs, [ONE, CLEAR, OTHER] if several else [ONE]))
    before, after = _attack_narrowed(job, pictures, _cells(pictures.box, 30, np.random.default_rng(3), 3.0), 40)
    assert 0 < after < 0.9 * before, (after, before)


def test_sub_boxes_without_bounds_settle_nothing(blobs: Inputs, tmp_path: Path) -> None:
    """Ends that cross or are no numbers say nothing, and what is settled by the cell's box stays so."""
    _, pictures = _pictures(tmp_path, blobs, _tight(tmp_path, blobs, [SMALL]))
    (cell,) = _cells(pictures.box, 1, np.random.default_rng(1))
    near = pictures.near(cell)
    assert isinstance(near, NearbyPictures)
    counts = near.sub_box_counts(cell, 8)
    assert counts is not None
    _, ends = near.divided_sets(cell, counts)
    assert ends is not None
    chosen = np.zeros(counts, bool)
    chosen[0] = True
    for side, value in (("lower", math.nan), ("upper", math.nan), ("lower", 2.0), ("upper", -1.0)):
        wrong = getattr(ends, side).copy()
        wrong[0] = value
        narrowed = near.narrowed(replace(ends, **{side: wrong}), chosen)
        np.testing.assert_array_equal(narrowed._known.open, near._known.open)
        np.testing.assert_array_equal(narrowed._known.lower, near._known.lower)
        np.testing.assert_array_equal(narrowed._known.upper, near._known.upper)


def test_claims_that_need_whole_values_have_no_sub_boxes(blobs: Inputs, tmp_path: Path) -> None:
    """Every end would have to be as narrow as it can be; and there are none where every pixel is settled."""
    job, pictures = _pictures(tmp_path, blobs, _tight(tmp_path, blobs, [SMALL]))
    (cell,) = _cells(pictures.box, 1, np.random.default_rng(1))
    limited = job.property.limited(16, 16)
    near = KnownBoxes(pictures, [_frame(pictures)], pictures.wanted, limited).near(cell)
    assert near is not None and near.sub_box_counts(cell, 8) is not None
    mean = [replace(one, measure=replace(one.measure, rank=None)) for one in limited]
    near = KnownBoxes(pictures, [_frame(pictures)], pictures.wanted, mean).near(cell)
    assert near is not None and near.sub_box_counts(cell, 8) is None
    _, dark = _pictures(tmp_path / "dark", blobs, {**SMALL, "weight": 0.999})
    near = dark.near(cell)
    assert isinstance(near, NearbyPictures) and near.sub_box_counts(cell, 8) is None
    assert near.divided_sets(cell, np.array([2, 2, 2]))[1] is None


def test_wide_cells_and_other_planes_are_bounded_as_they_are(blobs: Inputs, tmp_path: Path) -> None:
    _, pictures = _pictures(tmp_path / "a", blobs, ONE)
    assert pictures.near(pictures.box) is pictures
    (cell,) = _cells(pictures.box, 1, np.random.default_rng(1))
    mean = {"type": "picture", "statistic": "mean", "channel": "luminance", "max": 0.4}
    for k, prop in enumerate((mean, {"all": [ONE, mean]})):
        _, others = _pictures(tmp_path / str(k), blobs, prop)
        assert others.near(cell) is others


def test_bounds_of_enclosing_boxes_are_attacked(blobs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Settled pixels are not drawn again for the cells inside: a wrong bound of one must not stay."""
    _, pictures = _pictures(tmp_path, blobs, SMALL)
    frame, _ = _frame(pictures)
    bound_parts = type(frame).bound_parts

    def dark(*arguments: Any) -> Any:
        return [replace(found, lower=0.0 * found.lower, upper=0.0 * found.upper) for found in bound_parts(*arguments)]

    monkeypatch.setattr(type(frame), "bound_parts", dark)
    with pytest.raises(ContradictionError, match="outside of its bounds"):
        pictures.near(_cells(pictures.box, 1, np.random.default_rng(1))[0])


def test_bounds_inside_of_enclosing_boxes_are_attacked(
    blobs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a box leaves open is drawn where a box inside of it bounds it, and nothing else is."""
    _, pictures = _pictures(tmp_path, blobs, _tight(tmp_path, blobs, [SMALL]))
    (cell,) = _cells(pictures.box, 1, np.random.default_rng(1))
    frame, _ = _frame(pictures)
    bound_parts, drawn = type(frame).bound_parts, []

    def dark(*arguments: Any) -> Any:
        found = bound_parts(*arguments)
        # within a context alone
        return found if arguments[3] is None else [replace(one, upper=0.0 * one.upper) for one in found]

    image = type(pictures).image
    monkeypatch.setattr(type(pictures), "image", lambda *a: drawn.append(a[1]) or image(*a))
    pictures.near(cell)
    assert len(drawn) == 1
    _, again = _pictures(tmp_path / "again", blobs, _tight(tmp_path, blobs, [SMALL]))
    monkeypatch.setattr(type(frame), "bound_parts", dark)
    with pytest.raises(ContradictionError, match="outside of its bounds"):
        again.near(cell)


def test_few_boxes_are_kept(blobs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is known of a cell is the same after its box was dropped."""
    job, pictures = _pictures(tmp_path, blobs, _tight(tmp_path, blobs, [SMALL]))
    monkeypatch.setattr("ns_abstract.api.nearby_pictures._TUNING", NearbyTuning(memory=0, drawn=0))
    boxes = KnownBoxes(pictures, [_frame(pictures)], pictures.wanted, job.property.limited(16, 16))
    cells = _cells(pictures.box, 4, np.random.default_rng(3))
    first = [boxes.near(cell) for cell in cells]
    again = [boxes.near(cell) for cell in cells]
    for one, other, cell in zip(first, again, cells, strict=True):
        assert one is not None and other is not None
        np.testing.assert_array_equal(one.image(cell.middle), other.image(cell.middle))
    assert len(boxes._known) == 1 and len(boxes._draws) == 1


def test_pixels_that_are_not_wanted_take_no_light(blobs: Inputs, tmp_path: Path) -> None:
    _, pictures = _pictures(tmp_path, blobs, SMALL)
    frame, _ = _frame(pictures)
    chosen = np.random.default_rng(0).random((frame.tile_count, frame.side, frame.side)) < 0.2
    tiles = np.arange(frame.tile_count)
    context = frame.bound(pictures.box.split(0, 64)[9], tiles).context
    pose = pictures.box.split(0, 64)[9].middle
    found, whole = frame.drawn_alone(context, tiles, chosen)(pose), frame.render(pose)
    np.testing.assert_array_equal(found[chosen], whole[chosen])
    assert not found[~chosen].any() and assemble(whole, frame.camera)[..., 0].any()


def _widths(near: NearbyPictures, cell: ParameterBox) -> float:
    """The mean width of the sets of the pixels that are not settled."""
    linear, lower, upper, _ = near.linear_sets(cell)
    return float(PictureSets(cell, linear, lower, upper).widths[near._known.open][:, 3].mean())


def test_cuts_are_compared_by_what_they_narrow(blobs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a cut is said to gain is about what it narrows the sets by, which slopes do not tell."""
    _, pictures = _pictures(tmp_path, blobs, _tight(tmp_path, blobs, [SMALL]))
    (cell,) = _cells(pictures.box, 1, np.random.default_rng(1))
    near = pictures.near(cell)
    assert isinstance(near, NearbyPictures) and isinstance(near, ComparedCuts)
    gains = near.cut_gains(cell)
    assert gains.shape == (3,) and (gains > 0.0).all()
    whole = _widths(near, cell)
    narrowed = np.array([2.0 * (whole - np.mean([_widths(near, half) for half in cell.split(k)])) for k in range(3)])
    # some of the pixels, and the middle half in place of the two
    assert (np.abs(gains - narrowed) <= 0.5 * narrowed.max()).all()
    # of one parameter, and where bounds fail, nothing is compared
    assert not near.cut_gains(cell.without(cell.names[1:])).any()

    def failing(*_: Any) -> Any:
        raise RuntimeError("planted")

    monkeypatch.setattr(SplatWeightFrame, "bound_parts", failing)
    assert not near.cut_gains(cell).any()
