"""Pixels that are bounded in rounds exclude what all of them would at once, and never the true pose."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ns_abstract.verify.cell_boxes import meeting
from ns_abstract.verify.cells import Cell
from ns_abstract.verify.photo import TiledPhoto
from ns_abstract.verify.pixel_rounds import BoundedPixels, PixelRounds, RoundTuning

T, SIDE = 3, 4


def photo_of(values: np.ndarray, allowed: int, counted: np.ndarray | None = None) -> TiledPhoto:
    """A photo that pictures within 0.01 of ``values`` [T, side, side, 3] explain."""
    counted = np.ones(values.shape[:3], bool) if counted is None else counted
    return TiledPhoto(values - 0.01, values + 0.01, counted, allowed)


def bounds_of(lower: np.ndarray, upper: np.ndarray, linear: tuple[np.ndarray, ...]) -> Any:
    return SimpleNamespace(lower=lower, upper=upper, linear=linear)


@pytest.mark.parametrize("seed", range(20))
def test_rounds_exclude_what_all_pixels_do_and_never_the_true_pose(seed: int) -> None:
    """Pictures are lines in one parameter, so that the ends over a sub-box are exact."""
    generator = np.random.default_rng(seed)
    a, b = generator.normal(size=(2, T, SIDE, SIDE, 3))
    pose, allowed, parts = float(generator.random()), int(generator.integers(0, 8)), 16
    values = a * pose + b
    values.reshape(-1, 3)[generator.permutation(T * SIDE * SIDE)[:allowed]] += 5.0
    counted = generator.random((T, SIDE, SIDE)) < 0.9
    photo = photo_of(values, allowed, counted)
    lines = np.linspace(0.0, 1.0, parts + 1)
    ends = np.stack([a[..., None] * lines[:-1] + b[..., None], a[..., None] * lines[1:] + b[..., None]])
    lower, upper = ends.min(axis=0) - 1e-9, ends.max(axis=0) + 1e-9
    order = generator.permutation(np.flatnonzero(counted))
    # rounds that go on as long as there are pixels
    rounds = PixelRounds(photo, parts, tuning=RoundTuning(first=1.0, hopeless=0.0, few=0.0))
    shares = np.ones(order.size)
    seen = np.zeros_like(counted)
    while (chosen := rounds.following(order, shares)) is not None:
        assert not (chosen & seen).any()
        seen |= chosen
        rounds.count(lower[chosen], upper[chosen], chosen)
        # what is excluded by the pixels so far, counted one by one
        for part in range(parts):
            out = (lower[..., part] > photo.high).any(axis=-1) | (upper[..., part] < photo.low).any(axis=-1)
            assert rounds.numbers[part] == int((out & seen & counted).sum())
            assert rounds.left[part] == (rounds.numbers[part] <= allowed)
    assert rounds.left[min(int(pose * parts), parts - 1)]
    # most others are excluded: lines as steep as these leave little
    assert rounds.left.mean() < 0.5 and (seen == counted)[seen].all()


def test_a_pixel_counts_once() -> None:
    photo = photo_of(np.zeros((T, SIDE, SIDE, 3)), 20)
    pixels = np.zeros((T, SIDE, SIDE), bool)
    pixels[0] = True
    rounds = PixelRounds(photo, 2)
    ends = np.full((16, 3, 2), 0.5)
    for _ in range(2):
        rounds.count(ends, ends, pixels)
        assert rounds.numbers.tolist() == [16, 16] and rounds.left.all()
    pixels[1] = True
    rounds.count(np.full((32, 3, 2), 0.5), np.full((32, 3, 2), 0.5), pixels)
    assert rounds.numbers.tolist() == [32, 32] and not rounds.left.any()


@pytest.mark.parametrize("seed", range(20))
def test_a_part_inherits_what_excludes_all_of_it(seed: int) -> None:
    """Pictures are lines in one parameter; a part of the cell begins and ends within sub-boxes."""
    generator = np.random.default_rng(seed)
    a, b = generator.normal(size=(2, T, SIDE, SIDE, 3))
    values, counted = a * generator.random() + b, generator.random((T, SIDE, SIDE)) < 0.9
    photo = photo_of(values, 12, counted)
    lines = np.linspace(0.0, 1.0, 17)
    ends = np.stack([a[..., None] * lines[:-1] + b[..., None], a[..., None] * lines[1:] + b[..., None]])
    lower, upper = ends.min(axis=0) - 1e-9, ends.max(axis=0) + 1e-9
    known = generator.random((T, SIDE, SIDE)) < 0.7
    rounds = PixelRounds(photo, 16)
    rounds.count(lower[known], upper[known], known)
    cell, most = Cell((64,), (128,)), 0
    for first in range(64, 128, 3):
        part = Cell((first,), (int(generator.integers(first + 1, min(first + 12, 128) + 1)),))
        place = np.linspace(first - 64, part.past[0] - 64, 9) / 64.0
        picture = a[..., None] * place + b[..., None]
        outlier = ((picture < photo.low[..., None]) | (picture > photo.high[..., None])).any(axis=-2) & counted[
            ..., None
        ]
        inherited = rounds.excluded(meeting(cell, np.array([16]), part))
        # every one is an outlier at every pose of the part, and so is each that was bounded over little more
        assert not (inherited & ~(known & outlier.all(axis=-1))).any()
        beyond = (lower > photo.high[..., None]) | (upper < photo.low[..., None])
        met = slice((first - 64) // 4, (part.past[0] - 64 + 3) // 4)
        assert (inherited == known & counted & beyond.any(axis=-2)[..., met].all(axis=-1)).all()
        most = max(most, int(inherited.sum()))
        # they count once, whether they are bounded again or not
        heir = PixelRounds(photo, 1, inherited)
        chosen = heir.following(np.flatnonzero(counted), np.ones(int(counted.sum())))
        assert chosen is None or not (chosen & inherited).any()
        ends = np.stack([picture[..., 0], picture[..., -1]])
        tight = ends.min(axis=0)[..., None], ends.max(axis=0)[..., None]
        everywhere = np.ones_like(counted)
        heir.count(tight[0][everywhere], tight[1][everywhere], everywhere)
        out = (tight[0][..., 0] > photo.high).any(axis=-1) | (tight[1][..., 0] < photo.low).any(axis=-1)
        assert heir.numbers.tolist() == [int((inherited | (out & counted)).sum())]
        assert (heir.excluded(np.ones(1, bool)) == inherited | (out & counted)).all()
    assert most >= 6


def test_heirs_are_excluded_by_fewer_pixels() -> None:
    """Three of the five pixels that exclude a cell are known, so that its first round looks for two."""
    photo = photo_of(np.zeros((T, SIDE, SIDE, 3)), 4)
    inherited = np.zeros((T, SIDE, SIDE), bool)
    inherited[1, 0, :3] = True
    rounds = PixelRounds(photo, 8, inherited)
    chosen = rounds.following(np.arange(T * SIDE * SIDE), np.ones(T * SIDE * SIDE))
    assert chosen is not None and chosen.sum() == 3 and not (chosen & inherited).any() and rounds.left.all()
    rounds.count(np.ones((3, 3, 8)), np.ones((3, 3, 8)), chosen)
    assert rounds.numbers.tolist() == [6] * 8 and not rounds.left.any()
    # what is inherited cuts, too
    known = BoundedPixels(photo, 1)
    known.outliers = inherited
    assert known.reach[0] <= known.reach[1]
    known.outliers = np.ones_like(inherited)
    assert known.reach[0] > known.reach[1]


def test_the_outliers_are_those_of_the_whole_photo() -> None:
    """A few pixels are bounded; as many of these may be outliers as of the whole photo."""
    photo = photo_of(np.zeros((T, SIDE, SIDE, 3)), 4)
    for count in (4, 5):
        pixels = np.zeros(T * SIDE * SIDE, bool)
        pixels[:count] = True
        rounds = PixelRounds(photo, 1)
        ends = np.ones((count, 3, 1))
        rounds.count(ends, ends, pixels.reshape(T, SIDE, SIDE))
        assert rounds.left.tolist() == [count == 4]


def test_pixels_that_do_not_count_exclude_nothing() -> None:
    counted = np.zeros((T, SIDE, SIDE), bool)
    counted[0, 0] = True
    photo = photo_of(np.zeros((T, SIDE, SIDE, 3)), 0, counted)
    rounds = PixelRounds(photo, 1)
    ends = np.ones((T * SIDE * SIDE - 4, 3, 1))
    rounds.count(ends, ends, ~counted)
    assert rounds.left.all() and rounds.rest.sum() == 4


def test_pixels_that_were_not_bounded_exclude_and_cut_nothing() -> None:
    """Five pixels are known of a cell, which cut it; of the others nothing is."""
    photo = photo_of(np.full((T, SIDE, SIDE, 3), 0.5), 4)
    a, b = np.full((1, SIDE, SIDE, 3, 1), 0.1), np.full((1, SIDE, SIDE, 3), 0.55)
    pixels = np.zeros((T, SIDE, SIDE), bool)
    for count in (4, 5):
        pixels[1].reshape(-1)[:count] = True
        known = BoundedPixels(photo, 1)
        known.add(bounds_of(b - 0.1, b + 0.1, (a, b, a, b)), np.array([1]), pixels)
        assert known.explained == 0
        assert not photo.beyond(known.lower, known.upper, np.arange(T)).any()
        least, most = known.reach
        # more pixels than may show anything ask for 0.55 + 0.1 p from 0.49 to 0.51
        wanted = (-1.0, 1.0) if count == 4 else (-0.6, -0.4)
        assert (least[0], most[0]) == pytest.approx(wanted, abs=1e-6)
        assert least[0] <= wanted[0] and most[0] >= wanted[1]


def test_rounds_stop_where_pixels_do_not_help() -> None:
    """One round is enough where its pixels exclude everything, and where they exclude nothing."""
    photo = photo_of(np.zeros((T, SIDE, SIDE, 3)), 4)
    order, shares = np.arange(T * SIDE * SIDE), np.ones(T * SIDE * SIDE)
    for value, left in ((1.0, False), (0.0, True)):
        rounds = PixelRounds(photo, 8)
        chosen = rounds.following(order, shares)
        assert chosen is not None and chosen.sum() == 7
        ends = np.full((7, 3, 8), value)
        rounds.count(ends, ends, chosen)
        assert rounds.following(order, shares) is None and rounds.left.all() == left
    # too few pixels for any verdict
    assert PixelRounds(photo, 8).following(order[:2], shares[:2]) is None
    # pixels that are likely to exclude half of what is left count half
    chosen = PixelRounds(photo, 8).following(order, 0.5 * shares)
    assert chosen is not None and chosen.sum() == 14


def test_the_last_pixels_of_a_round_tell_how_many_more_help() -> None:
    """The first half of a round excludes, the second does not: what comes next would not, either."""
    photo = photo_of(np.zeros((T, SIDE, SIDE, 3)), 7)
    order, shares = np.arange(T * SIDE * SIDE), np.ones(T * SIDE * SIDE)
    for late, goes_on in ((False, False), (True, True)):
        rounds = PixelRounds(photo, 2, tuning=RoundTuning(first=1.0))
        chosen = rounds.following(order, shares)
        assert chosen is not None and chosen.sum() == 8
        excluding = np.arange(8)[:, None] % 2 == 0 if late else np.arange(8)[:, None] < 4
        rounds.take(np.repeat(excluding, 2, axis=1), chosen)
        assert rounds.numbers.tolist() == [4, 4]
        assert (rounds.following(order, shares) is not None) == goes_on


@pytest.mark.parametrize("dimensions", [0, 2])
def test_nothing_fits_better_where_nothing_moves_the_picture(dimensions: int) -> None:
    """A set of one pose has no parameters, and its linear bounds no slopes."""
    photo = photo_of(np.zeros((T, SIDE, SIDE, 3)), 0)
    known, shape = BoundedPixels(photo, dimensions), (T, SIDE, SIDE, 3)
    flat, ends = np.zeros((*shape, dimensions)), np.full(shape, 0.5)
    known.add(bounds_of(ends, ends, (flat, ends, flat, ends)), np.arange(T), np.ones((T, SIDE, SIDE), bool))
    assert known.best_fit(3) is None
