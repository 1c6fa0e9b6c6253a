"""Which pixels of a photo are bounded: those that tell most, by what bounds lose where the same is seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_bounds import Case, moves, scene

from ns_abstract.arithmetic.rounding import FLOAT32
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.tiles import assemble
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0
from ns_abstract.methods.splat.frame import SplatFrame
from ns_abstract.verify.neighbouring_pixels import best_shift, filled, shifted, smoothed
from ns_abstract.verify.photo import Photo
from ns_abstract.verify.telling_pixels import CHANNELS, DIFFERENCES, TellingPixels, TypicalCell, typical_cell

SIDE = 8
CAMERA = PinholeCamera(np.eye(4)[:3], 8.0, 8.0, 4.0, 4.0, SIDE, SIDE)
#: Scene elements over each pixel.
NONE = np.zeros((SIDE, SIDE), np.int64)


@pytest.mark.parametrize("move", [(0, 0), (3, -2), (-5, 7), (11, 0)])
def test_images_that_show_the_same_elsewhere_are_found(move):
    generator = np.random.default_rng(0)
    large = smoothed(generator.uniform(size=(60, 70)), 2)
    image, other = large[12:48, 12:58], large[12 - move[0] : 48 - move[0], 12 - move[1] : 58 - move[1]]
    assert best_shift(image, other) == move
    rows, columns = (slice(max(0, k), n + min(0, k)) for k, n in zip(move, image.shape, strict=True))
    assert np.array_equal(shifted(image, *move)[rows, columns], other[rows, columns])


def test_edges_are_repeated_by_a_shift():
    image = np.arange(12.0).reshape(3, 4)
    assert shifted(image, 1, -2).tolist() == [[2, 3, 3, 3], [2, 3, 3, 3], [6, 7, 7, 7]]


def test_what_is_not_known_is_filled_with_means_nearby():
    image, known = np.full((9, 9, 2), np.nan), np.zeros((9, 9), bool)
    known[3, 3] = known[5, 5] = True
    image[3, 3], image[5, 5] = [1.0, 2.0], [3.0, 6.0]
    found = filled(image, known, 2, 7.0)
    assert np.allclose(found[4, 4], [2.0, 4.0]) and np.allclose(found[6, 6], [3.0, 6.0])
    assert np.array_equal(found[3, 3], [1.0, 2.0]) and np.array_equal(found[8, 8], [7.0, 7.0])


def test_differences_tell_where_channels_do_not():
    """Channels may be anything, and the differences of a grey scene are 0: differences alone miss a red photo."""
    levels = np.full((SIDE, SIDE, 3), 100, np.uint8)
    levels[:, 4:] = [200, 60, 60]
    photo = Photo(levels, 0.02, 0.0, np.ones((SIDE, SIDE), bool)).tiled(SIDE)
    picture = np.full((SIDE, SIDE, 3), 0.6)
    loose, tight = np.full((SIDE, SIDE, 3), 1.0), np.zeros((SIDE, SIDE, 3))
    telling = TellingPixels(photo, CAMERA, TypicalCell(picture, 1.0, ([loose, loose], [tight, tight])))
    order = telling.order(picture[None], 1, 1.0, photo.counted, 100, NONE)
    inside = assemble(order.kinds, CAMERA)
    # a pixel beside the edge misses as well
    assert (inside[:, 5:] == DIFFERENCES).all()
    numbers, shares = order.everywhere
    assert (
        sorted(numbers) == [8 * row + column for row in range(SIDE) for column in range(4, SIDE)]
        and (shares == 1.0).all()
    )
    assert (order.kinds.reshape(-1)[numbers] == DIFFERENCES).all()
    alone = telling.order(picture[None], 1, 1.0, photo.counted, 100, None)
    assert not alone.everywhere[0].size and len(alone.misses) == 1 and (alone.kinds == CHANNELS).all()
    # where bounds are a tenth as wide, channels lose less, and where both may exclude the tighter ones do
    near = telling.order(picture[None], 1, 0.1, photo.counted, 100, NONE)
    inside = assemble(near.kinds, CAMERA)
    assert (
        near.everywhere[0].size == SIDE * SIDE
        and (inside[:, 4:] == DIFFERENCES).all()
        and (inside[:, :4] == CHANNELS).all()
    )


def test_pixels_are_chosen_towards_what_is_left():
    """A white wall ends in the middle of a grey photo: where the wall moved in, other pixels miss the photo."""
    photo = Photo(np.full((SIDE, SIDE, 3), 128, np.uint8), 0.02, 0.0, np.ones((SIDE, SIDE), bool)).tiled(SIDE)
    picture = np.full((SIDE, SIDE, 3), 0.5)
    picture[:, 4:] = 1.0
    none = [np.zeros((SIDE, SIDE, 3))] * 2
    telling = TellingPixels(photo, CAMERA, TypicalCell(picture, 1.0, (none,)))
    order = telling.order(picture[None], 3, 1.0, photo.counted, 100, None)
    likely = {}
    for columns, first in ((2, 7), (0, 5), (-2, 3)):
        # a pixel beside the edge may show either
        numbers, shares = order.towards(np.full((5, 2), [columns, 0.0]))
        assert sorted(set(numbers % SIDE)) == list(range(first, SIDE)) and (shares > 0.5).all()
        # where the wall misses the photo wherever it is, by half
        assert (shares[numbers % SIDE == 7] > 0.9).all()
        likely[columns] = dict(zip(numbers.tolist(), shares.tolist(), strict=True))
    numbers, shares = order.towards(np.array([[2.0, 0.0], [-2.0, 0.0]]))
    for number, share in zip(numbers.tolist(), shares.tolist(), strict=True):
        assert share == 0.5 * (likely[2].get(number, 0.0) + likely[-2][number])
    # the most telling first, and no more than are asked for, or five times as many that are little work
    assert (np.diff(shares) <= 0.0).all()
    for work, count in ((1e3, 15), (1e9, 3)):
        some = replace(order, count=3, work=np.full(order.work.shape, work))
        assert len(some.towards(np.zeros((1, 2)))[0]) == count


def test_pixels_that_few_elements_lie_over_come_first():
    """A white wall before a grey photo misses it everywhere alike: what pixels take decides, and how many there are."""
    photo = Photo(np.full((SIDE, SIDE, 3), 128, np.uint8), 0.02, 0.0, np.ones((SIDE, SIDE), bool)).tiled(SIDE)
    picture, none = np.full((SIDE, SIDE, 3), 1.0), [np.zeros((SIDE, SIDE, 3))] * 2
    telling = TellingPixels(photo, CAMERA, TypicalCell(picture, 1.0, (none,)))
    elements = np.random.default_rng(0).permutation(SIDE * SIDE).reshape(SIDE, SIDE)
    work = elements.reshape(-1)
    for times, count in ((100, 35), (1_000_000, 7)):
        order = telling.order(picture[None], 1, 1.0, photo.counted, 7, times * elements)
        numbers, shares = order.everywhere
        # many pixels where all of them are little work
        assert np.array_equal(work[numbers], np.arange(count)) and (shares == shares[0]).all()


def test_losses_of_a_typical_cell():
    """Over parts there are losses of channels and of differences, over the cell of channels; a wall loses nothing."""
    layers = [{"mean": (0.0, 0.0, -5.0), "scale": 30.0, "opacity": 0.9, "color": (0.2, 0.5, 0.7)}]
    layers.append({"mean": (0.0, 0.0, -4.0), "scale": 0.2, "opacity": 0.9, "color": (0.9, 0.5, 0.1)})
    case = Case(scene(*layers), moves(x=0.3, yaw=0.05))
    frame = SplatFrame(case.splats, GSPLAT_1_4_0, FLOAT32, case.poses)
    box = case.poses.box
    cells = frame.motion_field(box).cells(np.array([4, 2]))
    typical = typical_cell(frame, box, cells, 1.0, case.image(box.middle))
    assert len(typical.losses) == 2
    for below, above in typical.losses:
        assert below.shape == (16, 16, 3) and np.isfinite(below).all() and (below >= 0.0).all()
        assert max(below[0].max(), above[0].max()) < 0.002
        assert max(below.max(), above.max()) > 0.01
    whole = typical_cell(frame, box, None, 1.0, case.image(box.middle))
    assert len(whole.losses) == 1 and whole.losses[0][0].mean() > typical.losses[0][0].mean()


def test_cells_that_are_far_too_wide_are_likely_to_exclude_nothing():
    """And what bounds lose there does not overflow."""
    levels = np.zeros((SIDE, SIDE, 3), np.uint8)
    photo = Photo(levels, 0.02, 0.0, np.ones((SIDE, SIDE), bool)).tiled(SIDE)
    picture, loose = np.full((SIDE, SIDE, 3), 0.6), np.full((SIDE, SIDE, 3), 1.0)
    telling = TellingPixels(photo, CAMERA, TypicalCell(picture, 1.0, ([loose, loose],)))
    with np.errstate(over="raise"):
        order = telling.order(picture[None], 1, 1000.0, photo.counted, 100, None)
        assert order.everywhere[0].size == 0 and order.towards(np.zeros((1, 2)))[1].sum() < 1e-9
