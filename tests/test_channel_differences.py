"""Bounds of differences of channels over sub-boxes, at tolerance zero (docs/dev/design.md, B15, U10)."""

from __future__ import annotations

import dataclasses
import itertools
from fractions import Fraction

import numpy as np
import pytest
from test_bounds import Case, assert_differences, moves, scene
from test_depth_ranges import BACKGROUNDS, COUNTS, stack

from ns_abstract.arithmetic.rounding import FLOAT32
from ns_abstract.geometry.tiles import assemble
from ns_abstract.methods.splat import bounds as splat_bounds
from ns_abstract.methods.splat import frame as splat_frame
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0
from ns_abstract.methods.splat.frame import SplatFrame
from ns_abstract.methods.splat.stage_data import cell_parts
from ns_abstract.methods.splat.sub_box_bounds import SubBoxBounds, channel_differences, difference_ends
from ns_abstract.refine.protocol import CHANNEL_DIFFERENCES
from ns_abstract.verify.photo import Brightness, Photo

#: Colours and pictures are halved so many times, exactly, so that nothing of them is clamped.
DARKER = 0.125


def darker(case: Case) -> Case:
    """The same scene with colours, which depend on no direction, and a background of a part of the light."""
    splats = dataclasses.replace(case.splats, sh=DARKER * case.splats.sh, background=DARKER * case.splats.background)
    again = Case(case.splats, moves(x=0.1))
    again.camera, again.poses, again.splats, again.renderer = (
        case.camera,
        case.poses,
        splats,
        type(case.renderer)(splats, GSPLAT_1_4_0),
    )
    return again


@pytest.mark.parametrize("number", range(len(BACKGROUNDS)))
def test_differences_hold_pictures_before_they_are_clamped(number):
    """Colours up to 1.3: pictures of the middles and of random poses of each sub-box lie within both kinds of ends."""
    generator, parts = np.random.default_rng(number), cell_parts(COUNTS)
    for seed in range(2):
        case = stack(seed, BACKGROUNDS[number])
        dark, found = darker(case), case.difference_ends(case.poses.box, COUNTS, FLOAT32)
        for part in range(parts.middles.shape[1]):
            for turn in (0.0, 1.0):
                place = parts.middles[:, part] + turn * parts.half * generator.uniform(-1.0, 1.0, 2)
                image = dark.image(case.poses.box.at(place)).astype(np.float64) / DARKER
                for ends in found:
                    for k, (first, second) in enumerate(CHANNEL_DIFFERENCES):
                        value = image[..., first] - image[..., second]
                        assert (ends[:, :, 0, k, part] <= value).all() and (value <= ends[:, :, 1, k, part]).all()
        assert np.diff(found[1], axis=2).mean() < 1.9


def test_layers_of_one_hue_have_narrow_differences():
    """Grey layers over white: channels vary by nearly all that there is, their differences by what is rounded."""
    generator = np.random.default_rng(3)
    layers = [
        {
            "mean": (*generator.uniform(-1.0, 1.0, 2), generator.uniform(-5.01, -4.99)),
            "scale": generator.uniform(0.1, 1.2),
            "opacity": 0.9,
            "color": np.full(3, generator.uniform(0.0, 1.0)),
        }
        for _ in range(40)
    ]
    case = Case(scene(*layers, background=(1.0, 1.0, 1.0)), moves(x=0.15, yaw=0.04))
    channels, differences = (
        np.diff(find(case.poses.box, COUNTS, FLOAT32)[1], axis=2) for find in (case.sub_box_ends, case.difference_ends)
    )
    assert channels.mean() > 0.3 and differences.max() < 1e-3


@pytest.mark.parametrize("columns", [1, 4])
def test_forms_of_differences_hold_those_of_any_colours(columns):
    """Forms of two channels at the ends of their radii, at random places and corners, exactly."""
    generator, case = np.random.default_rng(columns), stack(0, BACKGROUNDS[2], 8)
    bounds, forms = SubBoxBounds(case.splats, GSPLAT_1_4_0, FLOAT32), case.poses.enclosure(case.poses.box, 1)
    colors = generator.normal(size=(8, 3 * columns)) * generator.choice([1e-9, 0.1, 1.0], (8, 3 * columns))
    projected = bounds.project(case.camera, forms)._replace(alive=np.arange(8), colors=colors)
    colors.reshape(8, 3, columns)[..., -1] = np.abs(colors.reshape(8, 3, columns)[..., -1])
    again, scale = channel_differences(projected)
    assert 0.0 < scale <= 0.5
    for row, mixed in zip(colors.reshape(8, 3, columns), again.colors.reshape(8, 3, columns), strict=True):
        places = (
            [[1, *generator.choice([-1.0, 1.0, 0.3, -0.7], columns - 1)[:-1]] for _ in range(4)]
            if columns > 1
            else [[1]]
        )
        for place, sign, (k, (first, second)) in itertools.product(places, (-1, 1), enumerate(CHANNEL_DIFFERENCES)):
            values = [
                sum(Fraction(a) * Fraction(p) for a, p in zip(form.tolist(), place, strict=False)) for form in row
            ]
            radii = [Fraction(form[-1]) if columns > 1 else Fraction(0) for form in row.tolist()]
            exact = Fraction(scale) * (values[first] - values[second] + sign * (radii[first] + radii[second]))
            middle = sum(Fraction(a) * Fraction(p) for a, p in zip(mixed[k].tolist(), place, strict=False)) - Fraction(
                1, 2
            )
            room = Fraction(float(mixed[k, -1])) if columns > 1 else Fraction(again.color_error - projected.color_error)
            assert abs(exact - middle) <= room


def test_colours_without_a_finite_bound_bound_nothing():
    case = stack(0, BACKGROUNDS[0], 8)
    bounds, forms = SubBoxBounds(case.splats, GSPLAT_1_4_0, FLOAT32), case.poses.enclosure(case.poses.box, 1)
    projected = bounds.project(case.camera, forms)
    projected.colors[projected.alive[0]] = np.nan
    again, scale = channel_differences(projected)
    assert scale == 0.0 and again is projected
    low, high = difference_ends(np.full((4, 6, 8), 0.5), scale)
    assert (low == -np.inf).all() and (high == np.inf).all()


def test_what_is_not_known_stays_unknown():
    """[0, 1] says nothing of a difference, nor do ends that cross or are no numbers."""
    parts = np.zeros((4, 6, 3))
    parts[:, :3], parts[:, 3:] = [0.0, 0.6, np.nan], [1.0, 0.4, 1.0]
    low, high = difference_ends(parts, 0.5)
    assert (low == -np.inf).all() and (high == np.inf).all()


def test_a_frame_bounds_differences_of_blocks_of_many_orders(monkeypatch):
    """Where no block's orders are few enough, those ends that have goals are bounded by ranges of depths, and hold."""
    monkeypatch.setattr(splat_bounds, "PART_PAIR_LIMIT", 1)
    case = stack(1, BACKGROUNDS[2])
    frame = SplatFrame(case.splats, GSPLAT_1_4_0, FLOAT32, case.poses)
    pixels = np.ones((frame.tile_count, frame.side, frame.side), bool)
    known = {}
    for goal in (np.nan, np.inf):
        low, high = frame.sub_box_ends(
            frame.box, COUNTS, np.arange(frame.tile_count), pixels, np.full((pixels.size, 6), goal),
            np.ones(pixels.size, bool),
        )  # fmt: skip
        shape = (*pixels.shape, 3 * COUNTS.prod())
        image = np.stack([assemble(end.reshape(shape), case.camera) for end in (low, high)], axis=2)
        image = image.reshape(*image.shape[:3], 3, -1)
        parts = cell_parts(COUNTS)
        for part in range(0, parts.middles.shape[1], 5):
            picture = case.image(case.poses.box.at(parts.middles[:, part])).astype(np.float64)
            assert_differences(picture, image[..., part : part + 1])
        known[goal] = np.isfinite(image).mean()
    assert known[np.nan] < 0.5 < known[np.inf]


def test_pixels_of_both_kinds_are_bounded_together(monkeypatch):
    """Each pixel has the ends that it has where all pixels are of its kind."""
    # what pairs of uncertain order tell of a pixel depends on the others of its block
    monkeypatch.setattr(splat_frame, "_TUNING", splat_frame.FrameTuning(crowded=-1))
    case = stack(1, BACKGROUNDS[2])
    frame = SplatFrame(case.splats, GSPLAT_1_4_0, FLOAT32, case.poses)
    tiles = np.arange(frame.tile_count)
    pixels = np.random.default_rng(0).uniform(size=(tiles.size, frame.side, frame.side)) < 0.3
    count = int(pixels.sum())
    goals, mixed = np.full((count, 6), np.inf), np.arange(count) % 3 == 0
    some, channels, differences = (
        np.stack(frame.sub_box_ends(frame.box, COUNTS, tiles, pixels, goals, kinds))
        for kinds in (mixed, np.zeros(count, bool), np.ones(count, bool))
    )
    assert np.array_equal(some, np.where(mixed[:, None, None], differences, channels))


@pytest.mark.parametrize("brightness", [Brightness(), Brightness((0.5, 2.0), (-0.1, 0.2))])
def test_pictures_that_explain_a_pixel_have_differences_within_its_ends(brightness):
    """Values before the clamp to [0, 1], of which some photo's values were made, at the ends of the noise, exactly."""
    generator, noise = np.random.default_rng(0), 0.02
    raw = generator.choice([-0.3, 0.0, 1e-9, 0.2, 0.7, 1.0, 1.4], (40, 50, 3)) * generator.uniform(
        0.9, 1.1, (40, 50, 3)
    )
    gain, offset = brightness.gain[0], brightness.offset[1]
    shown = np.clip(gain * np.clip(raw, 0.0, 1.0) + offset, 0.0, 1.0)
    levels = np.rint(255.0 * np.clip(shown + generator.choice([-noise, 0.0, noise], raw.shape), 0.0, 1.0))
    photo = Photo(levels.astype(np.uint8), noise, 0.0, np.ones((40, 50), bool), brightness)
    (low,), (high,) = photo.tiled(50).differences
    for k, (first, second) in enumerate(CHANNEL_DIFFERENCES):
        for value, a, b in zip(
            raw.reshape(-1, 3).tolist(), low[:40, ..., k].ravel(), high[:40, ..., k].ravel(), strict=True
        ):
            exact = Fraction(value[first]) - Fraction(value[second])
            assert (a == -np.inf or Fraction(float(a)) <= exact) and (b == np.inf or exact <= Fraction(float(b)))
    grey = Photo(np.full((4, 4, 3), 128, np.uint8), noise, 0.0, np.ones((4, 4), bool)).tiled(4).differences
    # twice the noise and the rounding of both channels
    assert np.abs(grey).max() < 2.0 * noise + 1.01 / 255.0


def test_differences_exclude_what_channels_leave():
    """A grey photo of a scene of a red and a green that may be anything between them and black."""
    photo = Photo(np.full((4, 4, 3), 60, np.uint8), 0.01, 0.0, np.ones((4, 4), bool)).tiled(4)
    shape = (16, 3, 2)
    assert not photo.excluding(np.zeros(shape), np.ones(shape), photo.counted).any()
    low = np.broadcast_to(np.array([[0.1, -np.inf], [-np.inf, -np.inf], [-np.inf, -np.inf]]), shape)
    assert (
        photo.excluding(low, np.full(shape, np.inf), photo.counted, np.ones(16, bool)).tolist() == [[True, False]] * 16
    )
    # as a channel's lower bound it would exclude nothing
    assert not photo.excluding(low, np.full(shape, np.inf), photo.counted).any()
