"""Lists of tiles: which Gaussians, in which order, and which thread works on which tile."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextvars import ContextVar

import numpy as np
import pytest
from numba import njit
from test_bounds import TURN, camera, moves, scene

from ns_abstract.arithmetic.rounding import FLOAT32, REAL
from ns_abstract.arithmetic.simd.intrinsics import pointer, taken
from ns_abstract.execution.threads import _pool, each, side_by_side, thread_group, threads, use_threads
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.methods.splat.activate import Splats
from ns_abstract.methods.splat.bounds import SplatBounds
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0
from ns_abstract.methods.splat.frame import SplatFrame
from ns_abstract.methods.splat.lists import (
    depth_order,
    longest_first,
    summed_area,
    tile_lists,
    touching,
    visible_again,
)

ACROSS, DOWN = 5, 4


def ranges(count: int, seed: int) -> np.ndarray:
    """Ranges of tiles [count, 4], some of them empty."""
    generator = np.random.default_rng(seed)
    columns = np.sort(generator.integers(0, ACROSS + 1, (count, 2)), axis=1)
    rows = np.sort(generator.integers(0, DOWN + 1, (count, 2)), axis=1)
    return np.concatenate([columns, rows], axis=1).astype(np.int32)


def held(tiles: np.ndarray, wanted: np.ndarray) -> set[int]:
    """The wanted tiles in one range."""
    x0, x1, y0, y1 = tiles
    return {t for y in range(y0, y1) for x in range(x0, x1) if wanted[t := y * ACROSS + x]}


@pytest.mark.parametrize("share", [0.0, 0.15, 1.0])
def test_touching_is_what_the_lists_hold(share):
    tiles = ranges(300, 1)
    wanted = (np.random.default_rng(2).uniform(size=ACROSS * DOWN) < share).astype(np.uint8)
    indices = np.random.default_rng(3).permutation(300)[:200]
    found = touching(indices, tiles, summed_area(wanted.reshape(DOWN, ACROSS)))
    assert found.tolist() == [i for i in indices if held(tiles[i], wanted)]
    _, entries = tile_lists(indices, tiles, wanted, ACROSS)
    assert set(entries.tolist()) == set(found.tolist())


def test_rectangles_hold_the_pixels_that_are_reached_and_no_others():
    generator, side, count = np.random.default_rng(6), 4, 400
    tiles = ranges(count, 7)
    box = np.sort(generator.uniform(-3.0, 23.0, (count, 2, 2)), axis=2)
    # ends at pixels' middles belong to them; pixels, or everything, may be unknown
    box[::3] = np.round(box[::3]) + 0.5
    box[::7, 0, 0], box[3::7, 1, 1], box[5::7] = -np.inf, np.nan, np.nan
    box = box.reshape(count, 4)
    marks = (generator.uniform(size=count) < 0.8).astype(np.uint8)
    numbers, rectangles = visible_again(marks, np.arange(100, 100 + count), box, tiles, side)
    assert (numbers == 100 + np.flatnonzero(marks)).all()
    rows, columns = np.mgrid[: DOWN * side, : ACROSS * side]
    chosen = generator.uniform(size=rows.shape) < 0.1
    seen = np.isin(np.arange(numbers.size), touching(np.arange(numbers.size), rectangles, summed_area(chosen)))
    for k, (x0, x1, y0, y1), said in zip(np.flatnonzero(marks), rectangles, seen, strict=True):
        # what is not a number leaves nothing out
        outside = (columns + 0.5 < box[k, 0]) | (columns + 0.5 > box[k, 1])
        outside |= (rows + 0.5 < box[k, 2]) | (rows + 0.5 > box[k, 3])
        left, past, top, end = side * tiles[k]
        outside |= (columns < left) | (columns >= past) | (rows < top) | (rows >= end)
        inside = (columns >= x0) & (columns < x1) & (rows >= y0) & (rows < y1)
        assert (inside == ~outside).all()
        assert said == (inside & chosen).any()
    assert 0 < seen.sum() < seen.size


def test_lists_are_by_depth_and_equal_depths_by_index():
    tiles, generator = ranges(300, 4), np.random.default_rng(5)
    depth = generator.integers(0, 40, 300).astype(np.float64)
    visible = np.flatnonzero(generator.uniform(size=300) < 0.7)
    wanted = np.ones(ACROSS * DOWN, np.uint8)
    offsets, entries = tile_lists(depth_order(visible, depth), tiles, wanted, ACROSS)
    for t in range(ACROSS * DOWN):
        mine = [i for i in visible.tolist() if t in held(tiles[i], wanted)]
        assert entries[offsets[t] : offsets[t + 1]].tolist() == sorted(mine, key=lambda i: (depth[i], i))


def test_longest_lists_first():
    offsets = np.array([0, 3, 3, 10, 11, 18])
    wanted = np.array([0, 1, 2, 4])
    assert longest_first(wanted, offsets).tolist() == [2, 3, 0, 1]


@njit(nogil=True)
def _take(thread, counter, owners):
    while True:
        number = taken(pointer(counter))
        if number >= owners.size:
            break
        owners[number] += 1 + 1000 * thread


def test_every_number_is_taken_once():
    owners, counter = np.zeros(200_000, np.int64), np.zeros(1, np.int64)
    # what is not taken at once can be taken twice: three more start than there may be cores
    side_by_side(lambda thread: _take(thread, counter, owners), 4)
    assert (owners % 1000 == 1).all()


def test_threads_are_waited_for_and_their_errors_heard():
    done: list[int] = []

    def work(number: int) -> None:
        if number == 2:
            raise ZeroDivisionError
        time.sleep(0.05 * number)
        done.append(number)

    side_by_side(work, 2)
    assert sorted(done) == [0, 1]
    with pytest.raises(ZeroDivisionError):
        side_by_side(work, 3)


def test_number_of_threads(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("numba.config.NUMBA_NUM_THREADS", 3)
    try:
        for asked, there in ((2, 2), (0, 1), (7, 3)):
            use_threads(asked)
            assert threads() == there
    finally:
        monkeypatch.undo()
        use_threads(threads())


@pytest.fixture
def four_threads(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """As on a machine with four cores."""
    monkeypatch.setattr("numba.config.NUMBA_NUM_THREADS", 4)
    _pool.cache_clear()
    use_threads(4)
    yield
    monkeypatch.undo()
    _pool.cache_clear()
    use_threads(threads())


@pytest.mark.parametrize(("count", "lanes", "share"), [(0, 0, 0), (1, 1, 4), (2, 2, 2), (3, 3, 1), (9, 4, 1)])
@pytest.mark.usefixtures("four_threads")
def test_pieces_of_work_share_the_threads(count, lanes, share):
    met = threading.Barrier(max(lanes, 1))
    state = ContextVar("state", default=0)
    state.set(7)

    def work(item: int) -> tuple[int, int, int, int]:
        if item < lanes:
            # all of them at once
            met.wait(20.0)
        seen: list[int] = []
        side_by_side(seen.append, threads())
        assert sorted(seen) == list(range(share))
        return item, thread_group(), threads(), state.get()

    found = each(work, range(count))
    assert [item for item, *_ in found] == list(range(count))
    assert {number for _, number, *_ in found} == set(range(lanes))
    assert all(rest == [share, 7] for _, _, *rest in found)
    assert (thread_group(), threads()) == (0, 4)


@pytest.mark.usefixtures("four_threads")
def test_the_first_error_of_a_piece_of_work_is_heard_when_all_have_ended():
    ended: list[int] = []

    def work(item: int) -> None:
        if item in (1, 2):
            time.sleep(0.1 * (3 - item))
            raise ValueError(item)
        time.sleep(0.3)
        ended.append(item)

    with pytest.raises(ValueError, match="1"):
        each(work, range(40))
    assert sorted(ended) == [0, 3]


@pytest.mark.usefixtures("four_threads")
def test_cells_that_are_bounded_at_once_have_memory_of_their_own():
    bounds, met = SplatBounds(many(), GSPLAT_1_4_0, REAL), threading.Barrier(2)

    def taken_in(item: int) -> np.ndarray:
        met.wait(20.0)
        return bounds._buffer("record", (7, 3))

    one, other = each(taken_in, range(2))
    assert one.shape == other.shape == (7, 3) and not np.shares_memory(one, other)
    assert np.shares_memory(bounds._buffer("record", (7, 3)), one) != np.shares_memory(
        bounds._buffer("record", (7, 3)), other
    )


@pytest.mark.slow
@pytest.mark.parametrize("radii", [{"yaw": 0.03}, {"x": 0.02, "yaw": 0.03}])
@pytest.mark.usefixtures("four_threads")
def test_cells_that_are_bounded_at_once_are_those_bounded_one_by_one(radii):
    """Also where cells that turn share their colours, and where there are fewer threads than cells, or more."""
    poses = PoseBox.around(camera(70, 50, 50.0), moves(**radii))
    alone, shared = (SplatFrame(many(degree=1), GSPLAT_1_4_0, FLOAT32, poses) for _ in range(2))
    tiles = np.arange(alone.tile_count)
    for count in (2, 9):
        boxes = poses.box.split(0, count)
        together = each(lambda box: shared.bound(box, tiles), boxes)
        for box, other in zip(boxes, together, strict=True):
            one = alone.bound(box, tiles)
            for name in ("lower", "upper", "slopes"):
                np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
            np.testing.assert_array_equal(one.context.visible, other.context.visible)


def many(antialiased: bool = False, degree: int = 0) -> Splats:
    """400 Gaussians before a background, of colours that depend on the direction if ``degree`` is 1."""
    generator, coefficients = np.random.default_rng(6), np.random.default_rng(7)
    return scene(
        *(
            {"mean": (*place, depth), "scale": 0.2, "opacity": 0.8, "quat": TURN, "color": color}
            | ({"sh": coefficients.normal(0.3, 0.3, (4, 3))} if degree else {})
            for place, depth, color in zip(
                generator.uniform(-3.0, 3.0, (400, 2)), generator.uniform(-9.0, -4.0, 400),
                generator.uniform(size=(400, 3)), strict=True,
            )
        ),
        background=(0.3, 0.1, 0.8), antialiased=antialiased,
    )  # fmt: skip


def test_partial_pictures_are_parts_of_the_whole():
    """Renders and bounds of some tiles are those of the whole picture, bit for bit."""
    poses = PoseBox.around(camera(70, 50, 50.0), moves(x=0.02, yaw=0.01))
    frame = SplatFrame(many(), GSPLAT_1_4_0, REAL, poses)
    every, some = np.arange(frame.tile_count), np.array([3, 7, 8, 19])
    whole = frame.bound(poses.box, every)
    for within in (None, whole.context):
        part = frame.bound(poses.box, some, within and frame.bound(poses.box, some, within).context)
        assert np.array_equal(part.lower, whole.lower[some]) and np.array_equal(part.upper, whole.upper[some])
    assert np.array_equal(frame.render(poses.box.middle, some), frame.render(poses.box.middle)[some])
    assert np.ptp(whole.lower[some]) > 0.1


@pytest.mark.slow_cases(every=10)
@pytest.mark.parametrize("arithmetic", [REAL, FLOAT32])
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize(
    "radii", [{"x": 0.02}, {"yaw": 0.03}, {"x": 0.02, "y": 0.01, "z": 0.3}, {"x": 0.02, "yaw": 0.03}]
)
def test_wanted_pixels_are_bounded_as_in_the_whole_picture(radii, order, antialiased, arithmetic):
    """They hold every picture, are no looser, and the same bit for bit where no order changes; nothing is said else."""
    if order == 2 and len(radii) > 1:
        pytest.skip("order 2 is of one parameter")
    poses = PoseBox.around(camera(80, 64, 50.0), moves(**radii))
    frame = SplatFrame(many(antialiased), GSPLAT_1_4_0, arithmetic, poses, order)
    tiles, random = np.array([3, 7, 8, 19]), np.random.default_rng(2)
    pixels = random.random((tiles.size, frame.side, frame.side)) < 0.3
    # no pixel of some blocks, one in a corner of another
    pixels[1, :8, :8] = pixels[2, 8:, :8] = False
    pixels[2, 15, 0] = True
    whole, part = frame.bound(poses.box, tiles), frame.bound(poses.box, tiles, None, False, pixels)
    assert (part.lower[~pixels] == 0.0).all() and (part.upper[~pixels] == 1.0).all()
    assert (part.lower[pixels] >= whole.lower[pixels]).all() and (part.upper[pixels] <= whole.upper[pixels]).all()
    if "yaw" not in radii:
        assert (part.lower[pixels] == whole.lower[pixels]).all() and (part.upper[pixels] == whole.upper[pixels]).all()
    assert np.ptp(part.lower[pixels]) > 0.1
    assert 0 < part.context.visible.size < whole.context.visible.size
    # what the cell shows on these pixels is all that its parts may show there
    inner, fewer = poses.box.split(0, 4)[1], pixels & (random.random(pixels.shape) < 0.5)
    alone, inside = frame.bound(inner, tiles, None, False, fewer), frame.bound(inner, tiles, part.context, False, fewer)
    assert (alone.lower == inside.lower).all() and (alone.upper == inside.upper).all()
    rest, single = np.zeros_like(pixels), tuple(np.argwhere(pixels)[0])
    rest[single] = True
    alone, close = frame.bound(inner, tiles, None, False, rest), frame.bound(inner, tiles, part.context, False, rest)
    assert (alone.lower == close.lower).all() and (alone.upper == close.upper).all()
    assert frame.candidates(tiles, part.context, rest).size < 0.5 * part.context.visible.size
    for values in (*poses.box.corners(), *poses.box.sample(8, random)):
        image = frame.render(values, tiles)
        assert (part.lower <= image).all() and (image <= part.upper).all()
    for values in (*inner.corners(), *inner.sample(4, random)):
        image = frame.render(values, tiles)
        assert (inside.lower <= image).all() and (image <= inside.upper).all()


def test_layers_of_pixels_that_are_not_wanted_are_unknown():
    poses = PoseBox.around(camera(80, 64, 50.0), moves(x=0.02))
    bounds, tiles = SplatBounds(many(), GSPLAT_1_4_0, REAL), np.array([3, 7])
    pixels = np.random.default_rng(2).random((2, bounds.side, bounds.side)) < 0.3
    forms = poses.enclosure(poses.box, 2)
    whole, part = (bounds.cell(poses.camera, forms, tiles, layers=True, pixels=chosen) for chosen in (None, pixels))
    assert (part.layers[pixels] == whole.layers[pixels]).all()
    assert (part.layers[~pixels] == [0.0, 1.0, 0.0, np.inf]).all()
