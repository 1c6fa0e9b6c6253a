"""Sub-boxes of a cell are excluded by pixels that exclude all motion cells that they may show."""

from __future__ import annotations

import numpy as np
import pytest
from test_bounds import Case, camera, moves, scene

from ns_abstract.arithmetic.rounding import FLOAT32, SUB_BOX_OVERLAP
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.motion_cells import MotionCells, MotionField, square_numbers
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0
from ns_abstract.methods.splat.frame import SplatFrame
from ns_abstract.methods.splat.stage_data import cell_parts
from ns_abstract.verify.motion_boxes import MotionBoxes

CAMERA = PinholeCamera(np.eye(4)[:3], 16.0, 16.0, 10.0, 6.0, 20, 12)
COUNTS, SIDE = np.array([4, 8]), 8
#: Tiles across and down.
ACROSS, DOWN = 3, 2


def cells_of(generator: np.random.Generator, d: int, side: int) -> MotionCells:
    squares = square_numbers(np.array([19]), np.array([11]), 20, side)[0] + 1
    pixels = generator.normal(size=(squares, 2, d)) * (generator.uniform(size=(squares, 1, d)) < 0.7)
    return MotionField(pixels, side).cells(COUNTS)


@pytest.mark.parametrize("side", [1, 8])
@pytest.mark.parametrize("d", [2, 3, 6])
def test_sub_boxes_are_excluded_by_all_motion_cells_of_their_poses(d: int, side: int) -> None:
    """For poses of a sub-box, found one by one: a motion cell that they show and that is kept keeps it."""
    generator = np.random.default_rng(10 * d + side)
    cells, counts = cells_of(generator, d, side), np.array([4, 2, 2, 1, 2, 1][:d])
    boxes, parts = MotionBoxes(cells, counts, CAMERA), cell_parts(counts, SUB_BOX_OVERLAP)
    pixels = np.zeros((ACROSS * DOWN, SIDE, SIDE), bool)
    inside = np.zeros((DOWN * SIDE, ACROSS * SIDE), bool)
    inside[:12, :20] = True
    pixels[:] = inside.reshape(DOWN, SIDE, ACROSS, SIDE).swapaxes(1, 2).reshape(pixels.shape)
    pixels &= generator.uniform(size=pixels.shape) < 0.3
    n = int(pixels.sum())
    excluding = generator.uniform(size=(n, int(COUNTS.prod()))) < generator.choice([0.9, 1.0], (n, 1))
    excluded = boxes.excluded(excluding, pixels)
    assert excluded.shape == (n, counts.prod()) and 0.05 < excluded.mean() < 0.95
    tile, row, column = np.nonzero(pixels)
    numbers = square_numbers(tile % ACROSS * SIDE + column, tile // ACROSS * SIDE + row, 20, side)
    motion = cells.motion[numbers, :2]
    for box, middle in enumerate(parts.middles.T):
        for _ in range(50):
            corner = generator.choice([-1.0, -0.9, 0.3, 1.0], d)
            q = motion @ np.clip(middle + parts.half * corner, -1.0, 1.0)
            assert (np.abs(q) <= 1.0).all()
            place = np.minimum((0.5 * (q + 1.0) * COUNTS).astype(int), COUNTS - 1)
            shown = ~excluding[np.arange(n), place[:, 0] * COUNTS[1] + place[:, 1]]
            assert not (excluded[:, box] & shown).any()
    # tight: a box whose motion cells are excluded is, and motion cells next to them do not matter
    for box, middle in enumerate(parts.middles.T):
        reach = np.abs(motion) @ parts.half
        ends = (0.5 * (motion @ middle + sign * reach + 1.0) * COUNTS for sign in (-1.0, 1.0))
        low, high = (np.clip(end, 0, COUNTS - 1).astype(int) for end in ends)
        open_ = ~excluding.reshape(n, *COUNTS)
        met = [open_[k, low[k, 0] : high[k, 0] + 1, low[k, 1] : high[k, 1] + 1].any() for k in range(n)]
        assert (excluded[:, box] == ~np.array(met)).all()


def test_motion_of_pixels_that_show_nothing_or_move_along_a_line() -> None:
    """No motion, motion along one direction alone, and large motion: maps into the square, with finite inverses."""
    pixels = np.array([[[0.0, 0.0], [0.0, 0.0]], [[3.0, 1.0], [3.0, 1.0]], [[1e200, 1.0], [0.0, 1e-200]]])
    cells = MotionField(pixels, 1).cells(COUNTS)
    assert np.isfinite(cells.motion).all()
    assert (np.abs(cells.motion[:, :2]).sum(axis=-1) <= 1.0).all() and (cells.motion[0] == 0.0).all()


def test_motion_cells_follow_a_turn() -> None:
    """A wall of blobs moves by pixels: bounds over motion cells are far narrower than over as many sub-boxes."""
    generator = np.random.default_rng(1)
    blobs = [
        {"mean": (x, y, -5.0), "scale": 0.12, "opacity": 0.9, "color": tuple(generator.uniform(size=3))}
        for x in np.linspace(-2.0, 2.0, 12) for y in np.linspace(-2.0, 2.0, 12)
    ]  # fmt: skip
    case = Case(scene(*blobs), moves(x=0.1, y=0.1, yaw=0.03, pitch=0.03))
    frame = SplatFrame(case.splats, GSPLAT_1_4_0, FLOAT32, case.poses)
    tiles = np.arange(frame.tile_count)
    pixels = np.ones((tiles.size, frame.side, frame.side), bool)
    cells = frame.motion_field(frame.box).cells(np.array([8, 8]))
    widths = []
    for parts in (np.array([2, 2, 4, 4]), cells):
        ends = frame.sub_box_ends(
            frame.box, parts, tiles, pixels, np.full((pixels.size, 6), np.inf), np.zeros(pixels.size, bool)
        )
        assert ends is not None
        widths.append(float((ends[1] - ends[0]).mean()))
    assert widths[1] < 0.8 * widths[0]


def test_a_large_picture_moves_by_squares() -> None:
    """Squares of pixels take the motion of what they show; a picture of few pixels has one for each."""
    wall = scene({"mean": (0.0, 0.0, -5.0), "scale": 30.0, "opacity": 0.9, "color": (0.2, 0.5, 0.7)})
    for size, side, squares in ((16, 1, 16 * 17), (300, 8, 38 * 38)):
        case = Case(wall, moves(x=0.1, yaw=0.02), camera(size, size + 1, float(size)))
        cells = SplatFrame(wall, GSPLAT_1_4_0, FLOAT32, case.poses).motion_field(case.poses.box).cells(COUNTS)
        assert (cells.side, len(cells.motion)) == (side, squares)
        # the wall moves as one
        assert np.abs(cells.typical[0]) == pytest.approx([0.1 * size / 5.0, 0.02 * size], rel=0.1)
