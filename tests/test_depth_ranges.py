"""Bounds over sub-boxes from the ranges of the Gaussians' depths, at tolerance zero (docs/dev/design.md, B14)."""

from __future__ import annotations

import math

import numba
import numpy as np
import pytest
from test_bounds import Case, moves, scene

from ns_abstract.arithmetic.rounding import FLOAT32
from ns_abstract.geometry.tiles import assemble, tile_grid
from ns_abstract.methods.splat import bounds as splat_bounds
from ns_abstract.methods.splat import sub_box_bounds
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0
from ns_abstract.methods.splat.frame import SplatFrame
from ns_abstract.methods.splat.stage_data import PART_LANES, cell_parts, strips_of
from ns_abstract.methods.splat.sub_box_bounds import SubBoxBounds

COUNTS = np.array([4, 8])
BACKGROUNDS = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.5, 0.4, 0.6))


def stack(seed: int, background: tuple[float, float, float], count: int = 60) -> Case:
    """Many layers at nearly one depth, some of them opaque, whose order depends on the pose."""
    generator = np.random.default_rng(seed)
    layers = [
        {
            "mean": (*generator.uniform(-1.0, 1.0, 2), generator.uniform(-5.2, -4.8)),
            "scale": generator.uniform(0.1, 1.2),
            "opacity": generator.choice([0.02, 0.3, 0.9, 0.998]),
            "color": generator.uniform(0.0, 1.3, 3),
        }
        for _ in range(count)
    ]
    return Case(scene(*layers, background=background), moves(x=0.15, yaw=0.04))


def ends_of(case: Case, goal: float = math.inf) -> np.ndarray:
    """[H, W, 2, 3, parts] ends over the sub-boxes of the whole set; only their sides of ``goal`` matter."""
    bounds, forms = SubBoxBounds(case.splats, GSPLAT_1_4_0, FLOAT32), case.poses.enclosure(case.poses.box, 1)
    tiles = np.arange(math.prod(tile_grid(case.camera, bounds.side)))
    pixels = np.ones((tiles.size, bounds.side, bounds.side), bool)
    projected, goals = bounds.project(case.camera, forms), np.full((pixels.sum(), 6), goal)
    out = bounds.by_depth_ranges(case.camera, forms, projected, tiles, pixels, COUNTS, goals)
    ends = assemble(out.reshape(*pixels.shape, -1), case.camera)
    return ends.reshape(*ends.shape[:2], 2, 3, -1)


@pytest.mark.parametrize("number", range(len(BACKGROUNDS)))
def test_bounds_hold_pictures_of_random_stacks(number):
    """Pictures of random poses of each sub-box lie in its bounds, which say something."""
    generator, parts = np.random.default_rng(number), cell_parts(COUNTS)
    for seed in range(3):
        case = stack(seed, BACKGROUNDS[number])
        ends = ends_of(case)
        assert np.isfinite(ends).all()
        for part in range(parts.middles.shape[1]):
            for place in (
                parts.middles[:, part],
                parts.middles[:, part] + parts.half * generator.uniform(-1.0, 1.0, 2),
            ):
                image = case.image(case.poses.box.at(place)).clip(0.0, 1.0)
                assert (ends[:, :, 0, :, part].clip(0.0, 1.0) <= image).all(), (seed, part)
                assert (image <= ends[:, :, 1, :, part].clip(0.0, 1.0)).all(), (seed, part)
        width = np.diff(ends.clip(0.0, 1.0), axis=2)
        assert width.mean() < 0.95


def assert_holds(case: Case, ends: np.ndarray) -> None:
    """Pictures of the middles and corners of all sub-boxes lie within their ends."""
    parts = cell_parts(COUNTS)
    for part in range(parts.middles.shape[1]):
        for corner in (0.0, -0.999, 0.999):
            place = parts.middles[:, part] + corner * parts.half
            image = case.image(case.poses.box.at(place)).clip(0.0, 1.0)
            assert (ends[:, :, 0, :, part].clip(0.0, 1.0) <= image).all(), (part, corner)
            assert (image <= ends[:, :, 1, :, part].clip(0.0, 1.0)).all(), (part, corner)


def test_layers_of_one_colour_add_up_to_it():
    """Nine layers of one colour show no other, although what lies behind the fifth hardly matters."""
    layer = {"scale": 6.0, "opacity": 0.7, "color": (1.0, 0.7, 0.4)}
    layers = [layer | {"mean": (0.0, 0.0, -5.0 - 0.1 * k)} for k in range(9)]
    case = Case(scene(*layers, background=BACKGROUNDS[0]), moves(x=0.01, yaw=0.001))
    ends = ends_of(case)
    assert_holds(case, ends)
    # the charge of a stop behind alpha 0.7, and little more
    assert (ends[:, :, 1] - np.array(layer["color"])[:, None]).max() < 1e-3


@pytest.mark.parametrize(("front", "behind"), [(0.0, 1.0), (1.0, 0.0)])
def test_what_is_surely_in_front_hides_what_is_behind(front, behind):
    """A layer before forty others, whose order among themselves is uncertain, shows as much as it covers."""
    generator = np.random.default_rng(0)
    layer = {"scale": 6.0, "opacity": 0.5, "color": (behind,) * 3}
    layers = [layer | {"mean": (*generator.uniform(-1.0, 1.0, 2), generator.uniform(-6.2, -6.0))} for _ in range(40)]
    layers.append({"mean": (0.0, 0.0, -5.0), "scale": 40.0, "opacity": 0.9, "color": (front,) * 3})
    case = Case(scene(*layers, background=BACKGROUNDS[2]), moves(x=0.02, yaw=0.01))
    ends = ends_of(case)
    assert_holds(case, ends)
    # whatever the order, the forty could hide the one
    assert np.abs(ends - front).max() < 0.13


def test_a_colour_inside_a_band_shows_and_covers():
    """Layers of many colours at one depth: what each adds to the bands that it lies in is part of their picture."""
    generator = np.random.default_rng(3)
    layers = [
        {"mean": (0.0, 0.0, -5.0 - 1e-4 * k), "scale": 8.0, "opacity": 0.2, "color": generator.uniform(0.3, 0.7, 3)}
        for k in range(40)
    ]
    case = Case(scene(*layers, background=BACKGROUNDS[2]), moves(x=0.01, yaw=0.05))
    ends = ends_of(case)
    assert_holds(case, ends)
    assert np.diff(ends, axis=2).max() < 0.4


@pytest.mark.parametrize("goal", [0.2, 0.5, 0.8])
def test_ends_are_on_the_same_side_of_their_goals(goal):
    """Where only the sides of goals matter, ends hold as well, and tell the same."""
    for number in range(3):
        case = stack(number + 7, BACKGROUNDS[number])
        every, some = ends_of(case), ends_of(case, goal)
        assert_holds(case, some)
        for told, known in (
            (some[:, :, 0] > goal, every[:, :, 0] > goal),
            (some[:, :, 1] < goal, every[:, :, 1] < goal),
        ):
            assert (told == known).mean() > 0.99
        assert (every[:, :, 1] < goal).any() or (every[:, :, 0] > goal).any()


@pytest.mark.parametrize(("near", "far"), [(0.4, 0.0), (0.6, 1.0)])
def test_a_layer_over_a_more_extreme_one_covers_as_much_as_it_may(near, far):
    """A small layer's alpha has a range in every sub-box, and what lies behind it is further from the background."""
    case = Case(
        scene(
            {"mean": (0.0, 0.0, -5.0), "scale": 0.3, "opacity": 0.95, "color": (near,) * 3},
            {"mean": (0.0, 0.0, -5.5), "scale": 6.0, "opacity": 0.9, "color": (far,) * 3},
            background=(0.5, 0.5, 0.5),
        ),
        moves(x=0.3, yaw=0.02),
    )
    assert_holds(case, ends_of(case))


@pytest.mark.parametrize(("color", "behind"), [(0.0, 1.0), (1.0, 0.0)])
def test_a_stop_shows_what_two_layers_would_hide(color, behind):
    """The second of two opaque layers is not drawn: a stop leaves the background two hundredths at most."""
    layer = {"scale": 6.0, "opacity": 0.995, "color": (color,) * 3}
    layers = [layer | {"mean": (0.0, 0.0, -5.0 - 0.1 * k)} for k in range(2)]
    case = Case(scene(*layers, background=(behind,) * 3), moves(x=0.01, yaw=0.001))
    ends = ends_of(case)
    assert_holds(case, ends)
    assert np.abs(case.image(case.poses.box.at(np.zeros(2))) - color).max() > 4e-3
    assert np.abs(ends - color).max() < 0.03


def test_strips_hold_what_their_sub_boxes_reach():
    """A small layer that some sub-box shows is drawn there, wherever it lies among those of a strip."""
    case = Case(
        scene({"mean": (0.3, 0.1, -5.0), "scale": 0.05, "opacity": 0.95, "color": (1.0, 0.7, 0.4)}),
        moves(x=0.05, yaw=0.2),
    )
    assert_holds(case, ends_of(case))
    shown = [(case.image(case.poses.box.at(place)) > 0.1).any() for place in cell_parts(COUNTS).middles.T]
    assert sum(shown) > 16


@pytest.mark.parametrize("counts", [(4, 8), (8, 4), (1, 8), (2, 64), (16, 2), (16, 16)])
def test_strips_cover_their_sub_boxes(counts):
    """The middles of a strip's sub-boxes lie within its half-width, exactly."""
    parts = cell_parts(np.array(counts))
    strips = strips_of(parts)
    lanes = parts.middles.reshape(2, -1, PART_LANES)
    away = np.abs(lanes - strips.middles[:, : lanes.shape[1], None])
    assert (away <= strips.half[:, None, None]).all()
    assert strips.middles.shape[1] == strips.room and strips.room % PART_LANES == 0


def test_sub_boxes_beyond_the_largest_set_of_strips_are_refused():
    """Strips that no set holds would stay without what they show."""
    with pytest.raises(ValueError, match="512 sub-boxes are more than 504"):
        strips_of(cell_parts(np.array([16, 32])))


@pytest.mark.parametrize("count", [1, 8])
def test_a_stop_shows_no_more_than_the_background(count):
    """A possible stop widens an end to what is left of the list at most, and not where the list ended early."""
    layers = [
        {"mean": (0.0, 0.0, -5.0 - 0.001 * k), "scale": 40.0, "opacity": 0.998, "color": (color,) * 3}
        for k, color in enumerate((0.9, 0.1) * count)
    ]
    case = Case(scene(*layers, background=(0.5, 0.5, 0.5)), moves(x=0.001, yaw=0.2))
    ends, parts = ends_of(case), cell_parts(COUNTS)
    for part in range(parts.middles.shape[1]):
        image = case.image(case.poses.box.at(parts.middles[:, part]))
        assert (ends[:, :, 0, :, part] <= image).all() and (image <= ends[:, :, 1, :, part]).all()
    # with one layer of each colour the picture is 0.998 of the nearer one's over the background
    assert ends.min() > 0.1 - 1e-4 and ends.max() < 0.9 + 1e-4
    if count == 1:
        assert ends.min() > 0.998 * 0.1 + 0.002 * 0.5 - 1e-3 and ends.max() < 0.998 * 0.9 + 0.002 * 0.5 + 1e-3


def test_pixels_that_nothing_reaches_show_the_background():
    """No fragment reaches a corner: its bounds are the background, up to their charge."""
    case = Case(
        scene({"mean": (0.0, 0.0, 5.0), "scale": 0.05, "opacity": 0.95}, background=BACKGROUNDS[2]),
        moves(x=0.1, yaw=0.02),
    )
    ends = ends_of(case)
    background = np.array(BACKGROUNDS[2])[:, None]
    assert (ends[:, :, 0] <= background).all() and (background <= ends[:, :, 1]).all()
    assert np.abs(ends - background).max() < 1e-4


def wanted(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Goals of all ends of the channels of all ``pixels``."""
    return np.ones((pixels.size, 6)), np.zeros(pixels.size, bool)


def test_what_warms_up_is_what_a_search_calls(monkeypatch):
    """A kernel is compiled for the types of its arguments: those of the warm-up are those of bounds over sub-boxes."""
    case, calls = stack(0, BACKGROUNDS[0], 8), []
    frame = SplatFrame(case.splats, GSPLAT_1_4_0, FLOAT32, case.poses)
    tiles = np.arange(frame.tile_count)
    pixels = np.ones((tiles.size, frame.side, frame.side), bool)
    # so that no block has few enough uncertain pairs
    monkeypatch.setattr(splat_bounds, "PART_PAIR_LIMIT", 1)
    monkeypatch.setattr(sub_box_bounds, "depth_range_stage", lambda *values: calls.append([*map(numba.typeof, values)]))
    frame.warm_up_sub_boxes()
    warm = len(calls)
    assert frame.sub_box_ends(frame.box, COUNTS, tiles, pixels, *wanted(pixels)) is not None
    assert len(calls) > warm > 0 and all(call == calls[0] for call in calls)
    # a set of one parameter has no sub-boxes
    SplatFrame(case.splats, GSPLAT_1_4_0, FLOAT32, Case(case.splats, moves(x=0.1)).poses).warm_up_sub_boxes()
