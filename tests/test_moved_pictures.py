"""A picture from near the middle of a cell, moved, shows about what the middle does; one serves many cells."""

from __future__ import annotations

import numpy as np
import pytest
from test_bounds import Case, moves, scene

from ns_abstract.arithmetic.rounding import FLOAT32
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.motion_cells import MotionField
from ns_abstract.geometry.tiles import assemble
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0
from ns_abstract.methods.splat.frame import SplatFrame
from ns_abstract.verify.moved_pictures import FoundPose, MovedPictures
from ns_abstract.verify.neighbouring_pixels import moved, shifted


@pytest.mark.parametrize("shape", [(5, 7, 3), (1, 4, 3), (4, 1), (3, 3)])
def test_whole_pixels_move_as_a_shift_does(shape: tuple[int, ...]) -> None:
    image = np.random.default_rng(0).uniform(size=shape).astype(np.float32)
    for rows, columns in ((0, 0), (2, -1), (-9, 3)):
        motion = np.broadcast_to([float(columns), float(rows)], (*shape[:2], 2))
        found = moved(image, motion)
        assert found.dtype == image.dtype and np.array_equal(found, shifted(image, rows, columns))


def test_between_pixels_it_is_linear_and_unknown_motion_is_none() -> None:
    image = np.add.outer(10.0 * np.arange(6), np.arange(8.0))
    motion = np.full((6, 8, 2), [0.25, -0.5])
    assert np.allclose(moved(image, motion)[1:5, 1:7], image[1:5, 1:7] - 0.25 + 5.0)
    assert np.array_equal(moved(image, np.full((6, 8, 2), np.nan)), image)


def test_motion_of_squares_is_that_of_their_pixels() -> None:
    generator = np.random.default_rng(1)
    pixels = generator.normal(size=(6, 2, 4))
    scaled = generator.uniform(-1.0, 1.0, 4)
    motion = MotionField(pixels, 8).at(scaled, 12, 20)
    assert motion.shape == (12, 20, 2)
    for row, column in ((0, 0), (11, 19), (7, 8), (8, 7)):
        assert np.array_equal(motion[row, column], pixels[row // 8 * 3 + column // 8] @ scaled)


def test_one_picture_serves_the_cells_nearby() -> None:
    """A moved picture is far nearer to what a cell's middle shows than it was, and the pose it comes from is told."""
    generator = np.random.default_rng(2)
    blobs = [
        {"mean": (x, y, -5.0 - x), "scale": 0.4, "opacity": 0.9, "color": tuple(generator.uniform(size=3))}
        for x in np.linspace(-3.0, 3.0, 14) for y in np.linspace(-3.0, 3.0, 14)
    ]  # fmt: skip
    case = Case(scene(*blobs), moves(x=0.4, y=0.4, yaw=0.1))
    frame = SplatFrame(case.splats, GSPLAT_1_4_0, FLOAT32, case.poses)
    looks: list[tuple[float, ...]] = []

    def look(values: np.ndarray) -> tuple[np.ndarray, FoundPose]:
        looks.append(tuple(values.tolist()))
        return frame.render(values), FoundPose(tuple(values.tolist()), len(looks))

    pictures = MovedPictures(frame, frame.motion_field, look)
    wide = np.array(frame.box.upper) - frame.box.lower
    errors = []
    for middle in frame.box.sample(60, generator):
        low, high = (np.clip(middle + sign * 0.02 * wide, frame.box.lower, frame.box.upper) for sign in (-1.0, 1.0))
        box = frame.box.with_ends(low, high)
        found = pictures.near(box)
        assert found is not None and found[1].values in looks and found[0].dtype == np.float32
        here = assemble(frame.render(box.middle), frame.camera)
        there = assemble(frame.render(np.array(found[1].values)), frame.camera)
        image = assemble(found[0], frame.camera)
        errors.append([np.abs(image - here).mean(), np.abs(there - here).mean()])
    assert len(looks) == len(set(looks)) and len(looks) < 30
    near, unmoved = np.mean(errors, axis=0)
    assert near < 0.5 * unmoved


def test_a_cell_that_reaches_beyond_the_set_has_none() -> None:
    case = Case(scene({"mean": (0.0, 0.0, -5.0), "scale": 1.0, "opacity": 0.9}), moves(x=0.1, yaw=0.02))
    frame = SplatFrame(case.splats, GSPLAT_1_4_0, FLOAT32, case.poses)
    pictures = MovedPictures(frame, frame.motion_field, lambda _: pytest.fail("a look"))
    beyond = ParameterBox(frame.box.names, frame.box.units, frame.box.lower, tuple(2.0 * x for x in frame.box.upper))
    assert pictures.near(beyond) is None
