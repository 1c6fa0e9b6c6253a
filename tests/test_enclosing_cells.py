"""Cells around others: what they show holds all that the cells within them show."""

from __future__ import annotations

import numpy as np
import pytest
from test_bounds import GSPLAT_1_4_0, Case, camera, moves, scene
from test_depth_ranges import BACKGROUNDS, COUNTS, stack

from ns_abstract.arithmetic.rounding import FLOAT32
from ns_abstract.geometry import enclosing_boxes
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.enclosing_boxes import EnclosingBoxes, box_of_motion
from ns_abstract.methods.splat.enclosing_cells import EnclosingContext
from ns_abstract.methods.splat.frame import SplatFrame
from ns_abstract.methods.splat.lists import rectangles_by_place

SET = ParameterBox(("x", "yaw", "z"), ("", "", ""), (-1.0, -0.1, 2.0), (1.0, 0.3, 2.0))
MOTION = np.array([16.0, 5.0, 0.0])


def cells(found: list[ParameterBox]) -> EnclosingBoxes[EnclosingContext]:
    """Of `SET`; boxes whose context is found are added to a list."""

    def context(box: ParameterBox) -> EnclosingContext:
        found.append(box)
        return EnclosingContext(np.zeros(25, np.int64), np.full((25, 4), len(found), np.int32), np.zeros((0, 0)))

    return EnclosingBoxes(SET, lambda box: MOTION, context)


@pytest.mark.parametrize("seed", range(5))
def test_a_cell_lies_within_the_one_around_it(seed):
    """Also where it crosses the lines by which the set is divided, has no width or is the whole set."""
    generator, found = np.random.default_rng(seed), []
    around = cells(found)
    for width in (0.0, 1e-9, 0.02, 0.3, 1.0):
        for _ in range(20):
            middle, half = SET.sample(1, generator)[0], 0.5 * width * (np.array(SET.upper) - SET.lower)
            ends = np.maximum(middle - half, SET.lower), np.minimum(middle + half, SET.upper)
            box = SET.with_ends(*ends)
            assert around.around(box) is not None
            enclosing = box_of_motion(box, SET, MOTION, 2.0)
            assert enclosing is not None and enclosing in found
            assert all(a <= c <= d <= b for a, b, c, d in zip(enclosing.lower, enclosing.upper, *ends, strict=True))
    # narrow cells do not have one each
    assert len(found) < 80


def test_what_reaches_beyond_the_set_has_none_around_it():
    found: list[ParameterBox] = []
    assert cells(found).around(SET.replace(0, -1.0, np.nextafter(1.0, 2.0))) is None and not found


def test_the_latest_are_kept_within_their_memory(monkeypatch):
    monkeypatch.setattr(enclosing_boxes, "_TUNING", enclosing_boxes.EnclosingTuning(most=2000))
    found: list[ParameterBox] = []
    around = cells(found)
    narrow = [SET.replace(0, x, x + 0.001) for x in (-0.9, -0.3, 0.3, 0.9)]
    first = around.around(narrow[0])
    assert around.around(narrow[0]) is first and len(found) == 1
    # two of 25 Gaussians are more
    for box in narrow[1:]:
        around.around(box)
    assert around.around(narrow[3]) is not None and len(found) == 4
    assert around.around(narrow[0]) is not first and len(found) == 5


def test_pixels_have_the_ends_that_all_gaussians_leave(monkeypatch):
    """Those that no pose of a cell around shows on the wanted pixels change nothing."""
    case = Case(stack(2, BACKGROUNDS[1]).splats, moves(x=1.0, yaw=0.2))
    frame = SplatFrame(case.splats, GSPLAT_1_4_0, FLOAT32, case.poses)
    tiles, generator = np.arange(frame.tile_count), np.random.default_rng(0)
    box = frame.box.split(0, 16)[5].split(1, 16)[9]
    for _ in range(4):
        pixels = generator.uniform(size=(tiles.size, frame.side, frame.side)) < 0.02
        arguments = box, COUNTS, tiles, pixels, np.full((pixels.sum(), 6), np.inf), np.zeros(pixels.sum(), bool)
        fast = np.stack(frame.sub_box_ends(*arguments))
        with monkeypatch.context() as without:
            without.setattr(frame, "enclosing", lambda box: None)
            assert np.abs(np.stack(frame.sub_box_ends(*arguments)) - fast).max() < 1e-9
    assert frame.element_counts(box).max() <= case.splats.count


def test_rectangles_are_counted_at_every_place():
    generator = np.random.default_rng(0)
    # some reach beyond all places, as tiles reach beyond a picture
    rectangles = np.sort(generator.integers(-2, 14, (50, 2, 2)), axis=2).reshape(50, 4).astype(np.int32)
    counts = np.zeros((6, 6), np.int64)
    for x0, x1, y0, y1 in rectangles:
        counts[max(0, y0) : max(0, y1), max(0, x0) : max(0, x1)] += 1
    assert np.array_equal(rectangles_by_place(rectangles, 6, 6), counts)
    assert not rectangles_by_place(rectangles[:0], 6, 6).any()


@pytest.mark.parametrize("size", [(20, 17), (1, 1), (33, 5)])
def test_elements_are_counted_in_pictures_of_every_size(size):
    """Also where tiles reach beyond the picture, and Gaussians beyond both."""
    blobs = [{"mean": (x, 0.0, -5.0), "scale": scale, "opacity": 0.9} for x, scale in ((0.0, 3.0), (0.5, 0.1))]
    case = Case(scene(*blobs), moves(x=0.1, yaw=0.02), camera(*size))
    frame = SplatFrame(case.splats, GSPLAT_1_4_0, FLOAT32, case.poses)
    context, counts = frame.enclosing(frame.box), frame.element_counts(frame.box)
    expected = np.zeros((size[1], size[0]), np.int64)
    assert context is not None
    for x0, x1, y0, y1 in context.reach:
        expected[y0:y1, x0:x1] += 1
    assert np.array_equal(counts, expected) and counts.min() >= 1
