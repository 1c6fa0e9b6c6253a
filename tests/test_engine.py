"""Refinement on a picture whose exact range over any box is known: no kernels are involved."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ns_abstract.execution import cancellation
from ns_abstract.execution.cancellation import check_cancelled
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.tiles import assemble, in_tiles
from ns_abstract.refine import engine, initial, inner
from ns_abstract.refine.engine import Refinement, RefinementGoal
from ns_abstract.refine.frame_tiles import pixels_inside
from ns_abstract.refine.result import FrameResult, TracePoint, mean_pixel_gap
from ns_abstract.refine.tuning import TUNING, Tuning

SIDE = 4
FOREVER = 1e9


def outward(lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Float32 bounds around float64 ones."""
    return (
        np.nextafter(lower.astype(np.float32), np.float32(-np.inf)),
        np.nextafter(upper.astype(np.float32), np.float32(np.inf)),
    )


def sine_range(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Exact range of the sine over [low, high]."""

    def reaches(angle: float) -> np.ndarray:
        return np.floor((high - angle) / (2 * np.pi)) >= np.ceil((low - angle) / (2 * np.pi))

    ends = np.sin(low), np.sin(high)
    return (
        np.where(reaches(-0.5 * np.pi), -1.0, np.minimum(*ends)),
        np.where(reaches(0.5 * np.pi), 1.0, np.maximum(*ends)),
    )


class Waves:
    """Every value is ``0.5 + 0.4 sin(weight . p + phase)``; bounds are too wide by ``slack`` radius^2.

    Pixels outside the image are NaN everywhere.
    """

    channels = 3
    tilewise = False
    tiles_at_once: int | None = None
    witnesses = 1

    def __init__(
        self,
        dimensions: int,
        *,
        width: int = 10,
        height: int = 7,
        seed: int = 0,
        slack: float = 0.3,
        pace: float = 0.0,
        weights: np.ndarray | None = None,
        transposed: bool = False,
    ) -> None:
        rng = np.random.default_rng(seed)
        self.box = ParameterBox(
            tuple("uvwxyz"[:dimensions]),
            ("m",) * dimensions,
            tuple(-1.0 - 0.1 * k for k in range(dimensions)),
            tuple(0.7 + 0.2 * k for k in range(dimensions)),
        )
        self.camera: Any = SimpleNamespace(width=width, height=height)
        self.side, self.slack, self.pace = SIDE, slack, pace
        self.across, self.down = -(-width // SIDE), -(-height // SIDE)
        shape = (self.down * SIDE, self.across * SIDE, 3)
        weight = rng.normal(size=(*shape, dimensions))
        phase = rng.uniform(0.0, 6.0, shape)
        if weights is not None:
            weight[...] = weights
        phase[height:], phase[:, width:] = np.nan, np.nan
        if transposed:
            weight, phase = weight.swapaxes(0, 1), phase.swapaxes(0, 1)
            self.across, self.down = self.down, self.across
            self.camera = SimpleNamespace(width=height, height=width)
        self.weight, self.phase = self._tiles(weight), self._tiles(phase)
        self.calls: list[tuple[ParameterBox, list[int], Any]] = []
        self.wanted: list[int] = []

    def _tiles(self, picture: np.ndarray) -> np.ndarray:
        rest = picture.shape[2:]
        grid = picture.reshape(self.down, SIDE, self.across, SIDE, *rest).swapaxes(1, 2)
        return grid.reshape(self.down * self.across, SIDE, SIDE, *rest)

    @property
    def tile_count(self) -> int:
        return self.across * self.down

    def render(self, values: np.ndarray, tiles: np.ndarray | None = None) -> np.ndarray:
        which = slice(None) if tiles is None else tiles
        return (0.5 + 0.4 * np.sin(self.weight[which] @ values + self.phase[which])).astype(np.float32)

    def exact(self, box: ParameterBox) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Range [T, side, side, 3] over ``box``, and the radius of the angle."""
        low, high = np.array(box.lower), np.array(box.upper)
        middle = self.weight @ (0.5 * (low + high)) + self.phase
        radius = np.abs(self.weight) @ (0.5 * (high - low))
        low_sine, high_sine = sine_range(middle - radius, middle + radius)
        return 0.5 + 0.4 * low_sine, 0.5 + 0.4 * high_sine, radius

    def bound(
        self, box: ParameterBox, tiles: np.ndarray, within: Any = None, keep_linear: bool = False,
        pixels: np.ndarray | None = None,
    ) -> Any:  # fmt: skip
        self.calls.append((box, list(map(int, tiles)), within))
        lower, upper, radius = self.exact(box)
        lower, upper = outward((lower - self.slack * radius**2)[tiles], (upper + self.slack * radius**2)[tiles])
        wanted = np.zeros((self.tile_count, SIDE, SIDE), bool)
        wanted[tiles] = True if pixels is None else pixels
        self.wanted.append(int(wanted.sum()))
        # what a context was not asked for is not there
        assert within is None or not (wanted & ~within.wanted).any()
        lower[~wanted[tiles]], upper[~wanted[tiles]] = 0.0, 1.0
        half = 0.5 * (np.array(box.upper) - np.array(box.lower))
        linear = None
        if keep_linear:
            flat = np.zeros((*lower.shape, box.dimensions), np.float32)
            known = [np.where(np.isnan(a), b, a).astype(np.float32) for a, b in ((lower, 0.0), (upper, 1.0))]
            linear = (flat, known[0], flat.copy(), known[1])
        return SimpleNamespace(
            lower=lower,
            upper=upper,
            slopes=np.abs(self.weight).mean(axis=(0, 1, 2, 3)) * half,
            context=SimpleNamespace(box=box, shown=None, nbytes=0, wanted=wanted),
            linear=linear,
        )

    def bound_parts(
        self, boxes: Any, tiles: np.ndarray, within: Any, keep_linear: bool, pixels: np.ndarray | None
    ) -> list[Any]:
        return [self.bound(box, tiles, within, keep_linear, pixels) for box in boxes]

    def feasible(self, box: ParameterBox) -> ParameterBox | None:
        return box

    def observe(self, tiles: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> None:
        pass

    def set_tolerance(self, excess: float) -> float:
        return 0.0

    def motion(self, box: ParameterBox) -> np.ndarray:
        return self.pace * (np.array(box.upper) - np.array(box.lower))


def refine(frame: Any, goal: RefinementGoal, keep_leaves: bool = False, **options: Any) -> FrameResult:
    return Refinement(frame, 0, replace(goal, keep_leaves=keep_leaves), **options).run()


def check(frame: Waves, result: FrameResult) -> None:
    """The bounds hold the exact range, the witnesses lie inside it."""
    lower, upper, _ = frame.exact(frame.box)
    assert (result.lower <= assemble(lower, frame.camera)).all()
    assert (result.upper >= assemble(upper, frame.camera)).all()
    assert (result.lower >= 0.0).all() and (result.upper <= 1.0).all()
    for witness in (result.image, result.witness_lower, result.witness_upper):
        assert (result.lower <= witness).all() and (witness <= result.upper).all()


# ---------------------------------------------------------------- soundness


@settings(max_examples=40, deadline=None)
@given(
    dimensions=st.integers(0, 3),
    seed=st.integers(0, 1000),
    cells=st.integers(1, 60),
    pace=st.sampled_from([0.0, 1.0, 9.0]),
    width=st.integers(1, 11),
    leaf_bytes=st.sampled_from([1, 5000, 1 << 30]),
)
def test_bounds_hold_the_exact_range(**c: Any) -> None:
    frame = Waves(c["dimensions"], width=c["width"], height=5, seed=c["seed"], pace=c["pace"])
    result = refine(frame, RefinementGoal(1.0, FOREVER, c["cells"], c["leaf_bytes"]), seed=c["seed"])
    check(frame, result)
    assert result.bounded
    assert 1 <= result.cells <= c["cells"]
    # cells that were tried to find out how many are needed may be of no use
    assert 0 <= len(frame.calls) - result.cells <= {0: 1, 1: 12}.get(c["dimensions"], 5)


def after_cover(result: FrameResult) -> TracePoint:
    """The first point at which the whole set is covered."""
    return next(point for point in result.trace if point.covered == 1.0)


@pytest.mark.parametrize("pace", [0.0, 3.0])
@pytest.mark.parametrize("slack", [0.03, 0.3, 3.0])
@pytest.mark.parametrize("ratio", [1.05, 1.2])
def test_first_cover_of_one_parameter_is_what_the_goal_asks_for(ratio: float, slack: float, pace: float) -> None:
    goal, frame = RefinementGoal(ratio, FOREVER), Waves(1, slack=slack, pace=pace)
    first = after_cover(refine(frame, goal))
    assert goal.met(first)

    def met(count: int) -> bool:
        ranges = [[a - frame.slack * r**2 * s for a, s in ((low, 1), (high, -1))] for low, high, r in map(
            frame.exact, frame.box.split(0, count))]  # fmt: skip
        lower, upper = np.min([a for a, _ in ranges], axis=0), np.max([a for _, a in ranges], axis=0)
        gaps = mean_pixel_gap(*(assemble(np.clip(a, 0.0, 1.0), frame.camera) for a in (lower, upper)))
        return gaps <= ratio * first.mpg_witness

    least = next(count for count in itertools.count(1) if met(count))
    assert first.cells <= max(2 * least, pace * 8)


def test_some_of_many_tiles_tell_how_many_cells_are_tried_first() -> None:
    in_vain = {True: 0, False: 0}
    for sampled, pace, ratio in itertools.product((True, False), (4.0, 40.0), (1.05, 1.1, 1.2)):
        frame, goal = Waves(1, width=40, height=40, pace=pace), RefinementGoal(ratio, FOREVER)
        result = refine(frame, goal, tuning=Tuning(sampled_tiles=100 if sampled else 101))
        check(frame, result)
        first = after_cover(result)
        assert goal.met(first)
        sizes = [len(tiles) for _, tiles, within in frame.calls if within is None]
        assert sizes.count(100 // 8) == sampled
        in_vain[sampled] += sizes.count(100) - first.cells
    assert in_vain[True] <= 0.5 * in_vain[False]


class Watched(Waves):
    """Notes what is rendered, and what the refinement allows, before the first cell is split."""

    def __init__(self) -> None:
        super().__init__(1)
        self.rendered: list[float] = []
        self.allowed: list[float] = []
        self.before_splits: tuple[list[float], list[float]] | None = None

    def set_tolerance(self, excess: float) -> float:
        self.allowed.append(excess)
        return 0.5 * excess

    def render(self, values: np.ndarray, tiles: np.ndarray | None = None) -> np.ndarray:
        self.rendered.append(float(values[0]))
        return super().render(values, tiles)

    def bound(self, box: ParameterBox, tiles: np.ndarray, within: Any = None, *rest: Any) -> Any:
        if within is not None and self.before_splits is None:
            self.before_splits = list(self.rendered), list(self.allowed)
        return super().bound(box, tiles, within, *rest)


def test_first_cover_is_rendered_in_every_other_part_until_the_goal_asks_for_more() -> None:
    for ratio, split in ((1.06, False), (1.002, True)):
        frame = Watched()
        result = refine(frame, RefinementGoal(ratio, FOREVER, 4000))
        check(frame, result)
        assert (frame.before_splits is not None) == split
        rendered = frame.rendered if frame.before_splits is None else frame.before_splits[0]
        parts = frame.box.split(0, after_cover(result).cells)
        assert len(parts) > 4
        seen = sum(float(part.middle[0]) in rendered for part in parts)
        assert seen == len(parts) if split else seen <= len(parts) / 2 + 1


def test_only_a_cover_that_may_reach_the_goal_is_allowed_to_be_looser() -> None:
    """Cells that are split had better tell what they hide."""
    for ratio, looser in ((1.2, True), (1.05, True), (1.04, False)):
        frame = Watched()
        refinement = Refinement(frame, 0, RefinementGoal(ratio, FOREVER, 4000))
        result = refinement.run()
        first, *before, last = frame.allowed
        assert first == last == 0.0 and len(before) == looser
        assert refinement.floor == (0.5 * before[0] if looser else 0.0)
        if looser:
            assert 0.0 < before[0] <= (ratio - 1.0) * after_cover(result).mpg_witness


@pytest.mark.slow
@pytest.mark.parametrize("dimensions", [1, 2])
def test_trace_begins_with_the_first_cells(dimensions: int) -> None:
    """A set that is not covered yet has nothing but [0, 1], however tight the cells so far are."""
    frame = Waves(dimensions, pace=4.0)
    trace = refine(frame, RefinementGoal(1.002, FOREVER, 4000)).trace
    cover = [point for point in trace if point.covered < 1.0]
    assert [point.covered for point in trace] == sorted(point.covered for point in trace)
    assert (trace[0].seconds >= 0.0, trace[0].cells, trace[0].covered) == (True, 0, 0.0)
    assert [point.mpg for point in cover] == [pytest.approx(math.sqrt(3.0))] * len(cover)
    # the first cells one by one, then some of them
    count = next(point for point in trace if point.covered == 1.0).cells
    assert [point.cells for point in cover][: min(count, 9)] == list(range(min(count, 9))) and count >= 4
    assert len(cover) <= 9 + 32


def test_views_of_kept_leaves_are_renders_across_the_set() -> None:
    for dimensions, count in ((1, 9), (2, 9), (3, 13)):
        frame = Waves(dimensions)
        result = refine(frame, RefinementGoal(1.5, FOREVER, 40), keep_leaves=True)
        assert result.views is not None and result.views.values.shape == (count, dimensions)
        ends = result.views.values.min(axis=0), result.views.values.max(axis=0)
        np.testing.assert_allclose(ends, (frame.box.lower, frame.box.upper), rtol=1e-15)
        for values, image in zip(result.views.values, result.views.images, strict=True):
            np.testing.assert_array_equal(image, assemble(frame.render(values), frame.camera))
            assert (result.witness_lower <= image).all() and (image <= result.witness_upper).all()
        assert refine(frame, RefinementGoal(1.5, FOREVER, 40)).views is None


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_first_cover_of_several_parameters_is_halved_for_what_cells_leave_open(axis: int) -> None:
    frame = Waves(3, slack=3.0, weights=np.where(np.arange(3) == axis, 1.0, 0.01))
    covers = {ratio: after_cover(refine(frame, RefinementGoal(ratio, FOREVER, 400))) for ratio in (1.05, 1.2)}
    assert covers[1.05].cells > covers[1.2].cells > 1
    for ratio, cover in covers.items():
        # about three times what the goal allows, and no more cells than that takes
        assert 0.5 * (ratio - 1.0) < cover.mpg / cover.mpg_witness - 1.0 < 6.0 * (ratio - 1.0)
    lengths = {tuple(np.round(np.subtract(box.upper, box.lower), 9)) for box, _, within in frame.calls if not within}
    assert all(len({length[k] for length in lengths}) == 1 for k in range(3) if k != axis)


@pytest.mark.parametrize("cells", [2, 10, 50])
def test_bounds_of_a_cell_that_was_tried_are_not_those_of_a_wider_one(cells: int) -> None:
    # motion asks for more cells than are allowed
    frame = Waves(2, pace=30.0)
    result = refine(frame, RefinementGoal(1.0, FOREVER, cells))
    check(frame, result)
    assert result.bounded


@pytest.mark.parametrize("dimensions", [1, 2])
def test_first_cover_stays_coarse_where_smaller_cells_do_not_help(dimensions: int) -> None:
    frame = Waves(dimensions, slack=0.0)
    bound = frame.bound

    def loose(*arguments: Any) -> Any:
        found = bound(*arguments)
        found.lower[...], found.upper[...] = found.lower - 0.05, found.upper + 0.05
        return found

    frame.bound = loose  # type: ignore[method-assign]
    result = refine(frame, RefinementGoal(1.05, FOREVER, 200))
    assert after_cover(result).cells <= (7 if dimensions == 1 else 8)


@pytest.mark.parametrize(("dimensions", "ratio", "first"), [(1, 1.002, 1.01), (2, 1.1, 1.15)])
def test_ratio_falls_to_the_goal(dimensions: int, ratio: float, first: float) -> None:
    frame = Waves(dimensions)
    result = refine(frame, RefinementGoal(ratio, FOREVER, 4000))
    check(frame, result)
    gaps = [point.mpg for point in result.trace]
    assert all(after <= before for before, after in itertools.pairwise(gaps))
    inner = [point.mpg_witness for point in result.trace]
    assert all(after >= before for before, after in itertools.pairwise(inner))
    assert after_cover(result).mpg > first * after_cover(result).mpg_witness
    assert result.trace[-1].mpg <= ratio * result.trace[-1].mpg_witness
    assert result.trace[-1].mpg == pytest.approx(mean_pixel_gap(result.lower, result.upper), rel=1e-12)
    assert result.cells < 4000


class Whole(Waves):
    """Does not take some pixels of a tile."""

    def bound_parts(
        self, boxes: Any, tiles: np.ndarray, within: Any, keep_linear: bool, pixels: np.ndarray | None
    ) -> list[Any]:
        return [self.bound(box, tiles, within, keep_linear) for box in boxes]


@pytest.mark.parametrize("ratio", [1.0, 1.2])
def test_leaves_are_split_for_the_pixels_where_they_leave_much_open(ratio: float) -> None:
    shares = []
    for keep_leaves in (False, True):
        frame = Waves(2, slack=1.0)
        result = refine(frame, RefinementGoal(ratio, FOREVER, 400), keep_leaves=keep_leaves)
        check(frame, result)
        assert ratio == 1.0 or result.trace[-1].mpg <= ratio * result.trace[-1].mpg_witness
        splits = [k for k, (_, _, within) in enumerate(frame.calls) if within is not None]
        assert len(splits) > 20
        asked = sum(frame.wanted[k] for k in splits)
        shares.append(asked / sum(SIDE**2 * len(frame.calls[k][1]) for k in splits))
    # linear sets are kept of every pixel, and frames need not know better
    frame = Whole(2, slack=1.0)
    check(frame, refine(frame, RefinementGoal(ratio, FOREVER, 400)))
    assert frame.wanted == [SIDE**2 * len(tiles) for _, tiles, _ in frame.calls]
    assert 0.05 < shares[0] < 0.9 and shares[1] == 1.0


def test_a_stricter_goal_asks_for_no_pixel_that_was_left_before() -> None:
    frame = Waves(2, slack=1.0)
    refinement = Refinement(frame, 0, RefinementGoal(1.2, FOREVER, 4000))
    before = refinement.run()
    after = refinement.proceed(RefinementGoal(1.001, FOREVER, before.cells + 300))
    check(frame, after)
    assert after.trace[-1].mpg < before.trace[-1].mpg


def test_stops_at_the_goal_and_not_later() -> None:
    loose, tight = (refine(Waves(1), RefinementGoal(ratio, FOREVER, 4000)).cells for ratio in (1.5, 1.02))
    assert loose < tight


def test_no_time_still_gives_a_sound_cover() -> None:
    frame = Waves(2, pace=5.0)
    result = refine(frame, RefinementGoal(1.01, 0.0))
    check(frame, result)
    assert (result.bounded, result.cells) == (True, 1)


@pytest.mark.parametrize("dimensions", [1, 2])
def test_a_cover_that_takes_too_long_becomes_one_cell(dimensions: int, monkeypatch: pytest.MonkeyPatch) -> None:
    frame, hours = Waves(dimensions, pace=30.0), itertools.count()
    # the first bounds cost nothing, later ones an hour each
    clock = SimpleNamespace(perf_counter=lambda: 0.0 if len(frame.calls) < 2 else 3600.0 * next(hours))
    for module in (engine, initial):
        monkeypatch.setattr(module, "time", clock)
    result = refine(frame, RefinementGoal(1.0, 100.0), keep_leaves=True)
    check(frame, result)
    assert result.bounded
    assert frame.calls[-1][0] == frame.box
    assert result.leaves is not None
    assert {tuple(row) for row in result.leaves.box_lower.tolist()} == {frame.box.lower}
    assert len(result.leaves.tile) == frame.tile_count


class Slow(Waves):
    """A picture takes a second, bounds ``tile_seconds`` for each tile; cancelled work ends before it begins."""

    tile_seconds = 2.0
    clock = 0.0

    def render(self, values: np.ndarray, tiles: np.ndarray | None = None) -> np.ndarray:
        self.clock += 1.0
        return super().render(values, tiles)

    def bound(self, box: ParameterBox, tiles: np.ndarray, *rest: Any) -> Any:
        check_cancelled()
        self.clock += self.tile_seconds * len(tiles)
        return super().bound(box, tiles, *rest)


@pytest.mark.parametrize("dimensions", [1, 2, 3])
@pytest.mark.parametrize("tile_seconds", [2.0, 0.001])
def test_a_cell_that_takes_too_long_is_bounded_in_some_tiles(
    dimensions: int, tile_seconds: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame = Slow(dimensions, width=9 * SIDE, height=7 * SIDE - 1)
    frame.tile_seconds = tile_seconds
    for module in (engine, initial, inner, cancellation):
        monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=lambda: frame.clock))
    result = refine(frame, RefinementGoal(1.0, 50.0), keep_leaves=True)
    check(frame, result)
    assert (
        result.bounded
        and frame.clock < 50.0 + 4.0 * tile_seconds + TUNING.cover_seconds + 1.0 + TUNING.views * dimensions
    )
    known = ~in_tiles((result.lower == 0.0) & (result.upper == 1.0), SIDE).all(axis=(1, 2, 3))
    assert 8 <= known.sum() < 63 if tile_seconds > 1.0 else known.all()
    # every tile has a cover, sound where nothing is known, too
    leaves = result.leaves
    assert leaves is not None and len(np.unique(leaves.tile, axis=0)) == frame.tile_count
    if tile_seconds > 1.0:
        place = {tuple(tile): k for k, tile in enumerate(leaves.tile.tolist())}
        for tile, is_known in enumerate(known):
            k = place[tile // frame.across * SIDE, tile % frame.across * SIDE]
            assert is_known or (not leaves.b_lower[k].any() and (leaves.b_upper[k] == 1.0).all())
        # what nothing is known of comes first when the work goes on
        frame.clock = 0.0
        more = refine(frame, RefinementGoal(1.0, 50.0), earlier=result)
        check(frame, more)
        both = ~in_tiles((more.lower == 0.0) & (more.upper == 1.0), SIDE).all(axis=(1, 2, 3))
        assert both[known].all() and both.sum() >= known.sum() + 8


# ---------------------------------------------------------------- reproducible


@pytest.mark.parametrize("dimensions", [1, 2, 3])
def test_same_cells_same_result(dimensions: int) -> None:
    first, second = (refine(Waves(dimensions), RefinementGoal(1.0, FOREVER, 57), seed=3) for _ in range(2))
    for name in ("lower", "upper", "witness_lower", "witness_upper", "image"):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes(), name
    assert [(p.cells, p.mpg) for p in first.trace] == [(p.cells, p.mpg) for p in second.trace]


@pytest.mark.parametrize("dimensions", [1, 2])
@pytest.mark.parametrize("cells", [20, 41])
def test_numbering_of_tiles_does_not_matter(dimensions: int, cells: int) -> None:
    rows = refine(Waves(dimensions), RefinementGoal(1.0, FOREVER, cells))
    columns = refine(Waves(dimensions, transposed=True), RefinementGoal(1.0, FOREVER, cells))
    np.testing.assert_array_equal(rows.lower, columns.lower.swapaxes(0, 1))
    np.testing.assert_array_equal(rows.upper, columns.upper.swapaxes(0, 1))
    np.testing.assert_array_equal(rows.witness_upper, columns.witness_upper.swapaxes(0, 1))


@pytest.mark.parametrize("dimensions", [1, 2])
@pytest.mark.parametrize("cells", [1, 2, 3, 4, 5, 6, 7, 30])
def test_number_of_cells_is_kept_to(dimensions: int, cells: int) -> None:
    result = refine(Waves(dimensions, pace=3.0), RefinementGoal(1.0, FOREVER, cells))
    assert result.cells <= cells
    assert result.cells >= cells - 1 or cells < 4


def test_the_seed_chooses_corners_only_where_there_are_many() -> None:
    small, large = ParameterBox(("a",), ("",), (0.0,), (1.0,)), Waves(1)
    frame = Waves(6, width=4, height=4)
    assert frame.box.dimensions == 6
    assert Refinement(large, 0, RefinementGoal(), seed=1).inner.corners().shape == (2, 1)
    assert Refinement(frame, 0, RefinementGoal(), seed=1).inner.corners().shape == (64, 6)
    frame.box = ParameterBox(tuple("abcdefg"), ("",) * 7, (0.0,) * 7, (1.0,) * 7)
    chosen = [Refinement(frame, 0, RefinementGoal(), seed=k).inner.corners() for k in (1, 1, 2)]
    assert chosen[0].shape == (64, 7)
    assert np.array_equal(chosen[0], chosen[1]) and not np.array_equal(chosen[0], chosen[2])
    assert small.dimensions == 1


# ---------------------------------------------------------------- memory


@pytest.mark.parametrize("dimensions", [1, 2])
def test_memory_for_leaves_is_kept_to(dimensions: int) -> None:
    tile = 2 * SIDE * SIDE * 3 * 4
    frame = Waves(dimensions, pace=50.0)
    limit = 40 * tile
    refinement = Refinement(frame, 0, RefinementGoal(1.0, FOREVER, 400, limit))
    seen: list[int] = []
    choose = refinement.leaves.next_round

    def watched(goal: RefinementGoal) -> Any:
        jobs = choose(goal)
        seen.append(sum(0 if t.lower is None else 2 * t.lower.nbytes for t in refinement.leaves.by_tile))
        return jobs

    refinement.leaves.next_round = watched  # type: ignore[method-assign]
    check(frame, refinement.run())
    assert seen and max(seen) <= limit
    free = refine(Waves(dimensions, pace=50.0), RefinementGoal(1.0, FOREVER, 400))
    bound = refinement.trace[-1].mpg
    assert free.trace[-1].mpg <= bound


def test_kept_sets_end_the_work_when_memory_is_full() -> None:
    few = refine(Waves(1), RefinementGoal(1.0, FOREVER, 300, 20_000), keep_leaves=True)
    many = refine(Waves(1), RefinementGoal(1.0, FOREVER, 300, 1 << 30), keep_leaves=True)
    assert few.leaves is not None and many.leaves is not None
    assert few.cells < many.cells
    check(Waves(1), few)


# ---------------------------------------------------------------- stopping


def test_stop_during_the_cover_leaves_nothing_known() -> None:
    frame = Waves(1, pace=20.0)
    result = refine(frame, RefinementGoal(1.05, FOREVER), stopped=lambda: len(frame.calls) >= 3)
    assert not result.bounded
    assert result.leaves is None
    assert (result.lower == 0.0).all() and (result.upper == 1.0).all()
    assert (result.witness_lower <= result.image).all() and (result.image <= result.witness_upper).all()
    check(frame, result)


def test_a_cover_is_kept_for_others_whole_or_not_at_all() -> None:
    frame, kept = Waves(1, pace=20.0), []
    refinement = Refinement(
        frame, 0, RefinementGoal(1.05, FOREVER), stopped=lambda: len(frame.calls) >= 3, initial=kept
    )  # fmt: skip
    assert not refinement.run().bounded and kept == []
    refinement = Refinement(Waves(1, pace=20.0), 0, RefinementGoal(1.05, FOREVER), initial=kept)
    assert refinement.run().bounded and len(kept) > 3
    ends = sorted((cell.box.lower, cell.box.upper) for cell, _, _ in kept)
    assert (ends[0][0], ends[-1][1]) == (refinement.frame.box.lower, refinement.frame.box.upper)
    assert all(upper == lower for (_, upper), (lower, _) in itertools.pairwise(ends))
    assert all(lower.shape == upper.shape == refinement.leaves.lower.shape for _, lower, upper in kept)


@pytest.mark.parametrize("dimensions", [1, 2])
def test_gaps_that_are_reported_are_those_of_the_bounds_at_that_time(dimensions: int) -> None:
    reported: list[tuple[float, float]] = []

    def compare(point: TracePoint, share: float) -> None:
        tiles, leaves, inner = refinement.tiles, refinement.leaves, refinement.inner
        assert point.mpg == tiles.mean_gap(leaves.lower, leaves.upper)
        assert point.mpg_witness == tiles.mean_gap(inner.lower, inner.upper)
        reported.append((point.mpg, point.mpg_witness))

    refinement = Refinement(Waves(dimensions, pace=4.0), 0, RefinementGoal(1.0, FOREVER, 60), progress=compare)
    refinement.run()
    # both change on the way
    assert all(len(set(values)) > 2 for values in zip(*reported, strict=True))


def test_stop_after_the_cover_keeps_it() -> None:
    frame = Waves(1, pace=2.0)
    result = refine(frame, RefinementGoal(1.0, FOREVER), stopped=lambda: len(frame.calls) >= 12)
    check(frame, result)
    assert result.bounded
    assert result.cells <= 16


def test_progress_is_told() -> None:
    told: list[tuple[float, float]] = []
    refine(
        Waves(1, pace=4.0),
        RefinementGoal(1.1, FOREVER, 100),
        progress=lambda point, share: told.append((point.mpg, share)),
    )
    shares = [share for _, share in told]
    assert shares == sorted(shares)
    assert shares[0] < 1.0 and shares[-1] == 1.0


# ---------------------------------------------------------------- dimensions


def test_single_pose_takes_one_cell() -> None:
    frame = Waves(0)
    result = refine(frame, RefinementGoal(1.0, FOREVER), keep_leaves=True)
    check(frame, result)
    assert (result.cells, result.bounded) == (1, True)
    assert result.leaves is not None
    assert result.leaves.box_lower.shape == (frame.tile_count, 0)
    np.testing.assert_array_equal(result.image, result.witness_lower)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_splits_along_the_axis_that_matters(axis: int) -> None:
    weights = np.full(3, 1e-9)
    weights[axis] = 2.0
    frame = Waves(3, weights=weights)
    result = refine(frame, RefinementGoal(1.2, FOREVER, 500), keep_leaves=True)
    check(frame, result)
    assert result.trace[-1].mpg <= 1.2 * result.trace[-1].mpg_witness
    assert result.leaves is not None
    widths = result.leaves.box_upper - result.leaves.box_lower
    whole = np.array(frame.box.upper) - np.array(frame.box.lower)
    for other in {0, 1, 2} - {axis}:
        assert (widths[:, other] == whole[other]).all()
    assert (widths[:, axis] < whole[axis]).any()


def test_axes_without_slope_are_split_by_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    frame = Waves(2, weights=np.array([0.0, 1.5]))
    bound = frame.bound

    def flat(*arguments: Any) -> Any:
        found = bound(*arguments)
        found.slopes = np.zeros(2)
        return found

    monkeypatch.setattr(frame, "bound", flat)
    monkeypatch.setattr(frame, "motion", lambda box: np.array([0.0, box.upper[1] - box.lower[1]]))
    result = refine(frame, RefinementGoal(1.1, FOREVER, 300))
    check(frame, result)
    assert result.trace[-1].mpg <= 1.1 * result.trace[-1].mpg_witness


def test_an_axis_that_is_used_up_gives_way(monkeypatch: pytest.MonkeyPatch) -> None:
    frame = Waves(2, weights=np.array([0.0, 2.0]))
    bound = frame.bound

    def misled(*arguments: Any) -> Any:
        found = bound(*arguments)
        found.slopes = np.array([1.0, 0.1])
        return found

    monkeypatch.setattr(frame, "bound", misled)
    check(frame, refine(frame, RefinementGoal(1.0, FOREVER, 200), tuning=Tuning(narrowest=0.3)))
    widths = {(box.upper[0] - box.lower[0], box.upper[1] - box.lower[1]) for box, _, _ in frame.calls}
    assert min(w for w, _ in widths) == pytest.approx(1.7 / 4)
    assert min(h for _, h in widths) == pytest.approx(2.0 / 4)


@pytest.mark.parametrize("dimensions", [1, 2])
def test_contexts_come_from_boxes_around(dimensions: int) -> None:
    frame = Waves(dimensions, pace=1.0)
    refine(frame, RefinementGoal(1.0, FOREVER, 60))
    inner = [(box, within.box) for box, _, within in frame.calls if within is not None]
    assert len(inner) > 20
    for box, around in inner:
        assert all(a >= b for a, b in zip(box.lower, around.lower, strict=True))
        assert all(a <= b for a, b in zip(box.upper, around.upper, strict=True))


def test_tight_tiles_are_not_bounded_again() -> None:
    frame = Waves(1, width=8, height=4)
    frame.weight[0] = 0.0  # this tile never changes
    refine(frame, RefinementGoal(1.0, FOREVER, 40))
    with_first = [tiles for _, tiles, within in frame.calls if within is not None and 0 in tiles]
    # outward rounding leaves an excess of one unit in the last place, which is never worth a split
    assert len(with_first) == 0


# ---------------------------------------------------------------- leaves


@pytest.mark.parametrize("dimensions", [1, 2])
@pytest.mark.parametrize("leaf_bytes", [30_000, 1 << 30])
def test_leaves_cover_the_set_and_hold_its_pictures(dimensions: int, leaf_bytes: int) -> None:
    frame = Waves(dimensions, pace=1.0)
    result = refine(frame, RefinementGoal(1.0, FOREVER, 40, leaf_bytes), keep_leaves=True)
    leaves = result.leaves
    assert leaves is not None
    volume = np.prod(leaves.box_upper - leaves.box_lower, axis=1)
    whole = np.prod(np.array(frame.box.upper) - np.array(frame.box.lower))
    number = leaves.tile[:, 0] // SIDE * frame.across + leaves.tile[:, 1] // SIDE
    for t in range(frame.tile_count):
        # disjoint but for faces, so equal volumes mean that all of the box is covered
        assert volume[number == t].sum() == pytest.approx(whole, rel=1e-12)
    rng = np.random.default_rng(0)
    inside = pixels_inside(frame)
    for values in frame.box.sample(50, rng):
        picture = frame.render(values)
        holds = ((leaves.box_lower <= values) & (values <= leaves.box_upper)).all(axis=1)
        assert set(number[holds]) == set(range(frame.tile_count))
        for row in np.flatnonzero(holds):
            t = number[row]
            low, high = leaves.b_lower[row][inside[t]], leaves.b_upper[row][inside[t]]
            assert (low <= picture[t][inside[t]]).all() and (picture[t][inside[t]] <= high).all()


# ---------------------------------------------------------------- bad numbers


def spoilt(frame: Waves, spoil: Callable[[Any, int], None], every: int = 1) -> Waves:
    """The frame with bounds that ``spoil`` changes in every ``every``-th call."""
    bound = frame.bound

    def changed(*arguments: Any) -> Any:
        found = bound(*arguments)
        number = len(frame.calls)
        if number % every == 0:
            spoil(found, number)
        return found

    frame.bound = changed  # type: ignore[method-assign]
    return frame


def _set(name: str, value: float) -> Callable[[Any, int], None]:
    def change(found: Any, number: int) -> None:
        getattr(found, name)[:, 1, 2, 0] = value

    return change


def _cross(found: Any, number: int) -> None:
    found.lower, found.upper = found.upper, found.lower


SPOILT = {
    "lower NaN": _set("lower", np.nan),
    "upper NaN": _set("upper", np.nan),
    "lower infinite": _set("lower", np.inf),
    "upper infinite": _set("upper", np.inf),
    "upper minus infinite": _set("upper", -np.inf),
    "lower above 1": _set("lower", 1.5),
    "upper below 0": _set("upper", -0.5),
    "crossed": _cross,
}


@pytest.mark.parametrize("name", SPOILT)
@pytest.mark.parametrize("every", [1, 2, 5])
def test_bad_bounds_never_end_tight(name: str, every: int) -> None:
    frame = spoilt(Waves(1, width=8, height=8, pace=1.0), SPOILT[name], every)
    result = refine(frame, RefinementGoal(1.0, FOREVER, 40), keep_leaves=True)
    check(frame, result)
    assert np.isfinite(result.lower).all() and np.isfinite(result.upper).all()
    if every == 1:
        known = np.ones((8, 8, 3), bool) if name == "crossed" else np.zeros((8, 8, 3), bool)
        if name != "crossed":
            known[1::4, 2::4, 0] = True
        assert (result.lower[known] == 0.0).all() and (result.upper[known] == 1.0).all()


def test_bad_slopes_and_linear_sets_are_harmless() -> None:
    def spoil(found: Any, number: int) -> None:
        found.slopes[number % 2] = (np.nan, np.inf)[number % 2]
        if found.linear is not None:
            found.linear[0][:, 0, 0, 0, 0] = np.nan
            found.linear[1][:, 1, 1, 1] = np.nan
            found.linear[3][:, 2, 2, 2] = np.inf

    frame = spoilt(Waves(2, width=8, height=8), spoil)
    result = refine(frame, RefinementGoal(1.05, FOREVER, 60), keep_leaves=True)
    check(frame, result)
    leaves = result.leaves
    assert leaves is not None
    assert all(np.isfinite(a).all() for a in (leaves.A_lower, leaves.b_lower, leaves.A_upper, leaves.b_upper))
    assert (leaves.b_lower[:, 0, 0, 0] == 0.0).all() or (leaves.A_lower[:, 0, 0, 0] == 0.0).all()
    assert (leaves.b_lower[:, 1, 1, 1] == 0.0).all()
    assert (leaves.b_upper[:, 2, 2, 2] == 1.0).all()


def test_bad_motion_is_harmless() -> None:
    frame = Waves(2)
    frame.motion = lambda box: np.array([np.nan, 3.0])  # type: ignore[method-assign]
    check(frame, refine(frame, RefinementGoal(1.0, FOREVER, 30)))


def test_children_that_contradict_their_parent_are_not_believed() -> None:
    frame = Waves(1, width=4, height=4)
    bound = frame.bound

    def shifted(box: ParameterBox, tiles: np.ndarray, within: Any = None, *rest: Any) -> Any:
        found = bound(box, tiles, within, *rest)
        if within is not None:
            # beyond what the parent allows in some pixels
            found.lower[...], found.upper[...] = 0.96, 0.97
        return found

    frame.bound = shifted  # type: ignore[method-assign]
    _, upper, radius = (a[0] for a in frame.exact(frame.box))
    forbidden = upper + frame.slack * radius**2 < 0.95
    assert forbidden.any() and not forbidden.all()
    result = refine(frame, RefinementGoal(1.0, FOREVER, 3))
    assert (result.lower[forbidden] == 0.0).all() and (result.upper[forbidden] == 1.0).all()


class Triangle(Waves):
    """A set whose poses have ``u + v <= 0``: the box around it holds parameters of none, shown as the nearest pose."""

    shrinks = True

    def feasible(self, box: ParameterBox) -> ParameterBox | None:
        if box.lower[0] + box.lower[1] > 0.0:
            return None
        for axis in range(2 if self.shrinks else 0):
            box = box.replace(axis, box.lower[axis], min(box.upper[axis], 0.0 - box.lower[1 - axis]))
        return box

    def render(self, values: np.ndarray, tiles: np.ndarray | None = None) -> np.ndarray:
        nearest = np.array(values)
        nearest[1] = min(nearest[1], -nearest[0])
        return super().render(nearest, tiles)


@pytest.mark.slow_cases
@pytest.mark.parametrize("pace", [0.0, 4.0])
@pytest.mark.parametrize("shrinks", [True, False])
def test_parts_without_poses_take_no_work_and_leave_nothing_open(shrinks: bool, pace: float) -> None:
    frame = Triangle(3, pace=pace, slack=0.02, weights=np.array([1.0, 0.3, 0.0]))
    frame.shrinks = shrinks
    result = refine(frame, RefinementGoal(1.0, FOREVER, 1500))
    assert all(box.lower[0] + box.lower[1] <= 0.0 for box, _, _ in frame.calls)
    points = frame.box.sample(4000, np.random.default_rng(3))
    # those beyond the slanted side are taken to it
    pictures = np.stack([frame.render(values) for values in points])
    shown = [assemble(a, frame.camera) for a in (pictures.min(axis=0), pictures.max(axis=0))]
    assert (result.lower <= shown[0]).all() and (result.upper >= shown[1]).all()
    gaps = [point.mpg for point in result.trace]
    assert all(b <= a for a, b in itertools.pairwise(gaps))
    # nearer to what the poses show than to the range over the box
    low, high, _ = frame.exact(frame.box)
    seen, whole = (mean_pixel_gap(*shown), mean_pixel_gap(*(assemble(a, frame.camera) for a in (low, high))))
    assert gaps[-1] - seen < 0.5 * (whole - seen)


def test_poses_are_rendered_far_out() -> None:
    """A part that touches an end of the set is looked at there, one that touches both at either."""
    refinement = Refinement(Waves(3), 0, RefinementGoal())
    splitter = refinement.splitter
    whole = refinement.frame.box
    part = splitter.cut(splitter.cut(splitter.whole, 0)[0], 1, 4)[1]
    seen = np.array([refinement.inner.outlying(part) for _ in range(50)])
    assert (seen[:, 0] == whole.lower[0]).all() and (seen[:, 1] == part.box.middle[1]).all()
    assert set(seen[:, 2]) == {whole.lower[2], whole.upper[2]}
    part = splitter.cut(splitter.cut(splitter.whole, 0)[1], 2, 3)[2]
    assert (refinement.inner.outlying(part)[[0, 2]] == np.array(whole.upper)[[0, 2]]).all()


def test_ends_beyond_which_there_are_no_poses_are_far_out() -> None:
    refinement = Refinement(Triangle(2), 0, RefinementGoal())
    splitter = refinement.splitter
    # the upper quarter of u allows v below its lower end only, and no u near its own upper end
    part = splitter.cut(splitter.whole, 0, 4)[3]
    assert part.box.upper[1] == -part.box.lower[0] < refinement.frame.box.upper[1]
    assert part.last.all() and not part.first[0] and part.first[1]
    inner = splitter.cut(part, 1)[0]
    assert not inner.last[1] and inner.first[1]
