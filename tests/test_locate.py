"""Where a photo was taken: what is excluded never holds the pose that made it."""

import itertools
import json
import sqlite3
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import InProcess, Inputs
from interrupting import check_interrupted, interrupted_at
from PIL import Image

import ns_abstract as nsa
from ns_abstract.api.job import Job
from ns_abstract.api.location import Location, PhotoOptions
from ns_abstract.cli.locate import main
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.camera_path import load_camera_path
from ns_abstract.geometry.tiles import assemble
from ns_abstract.verify.cell_boxes import between, divided, inner_cell, meeting, resolved, slabs, sub_box_counts
from ns_abstract.verify.cells import Cell, CellGrid
from ns_abstract.verify.location import LocationSearch, LocationTuning
from ns_abstract.verify.location_cover import ShearedBoxes, cover
from ns_abstract.verify.location_store import LocationStore
from ns_abstract.verify.moved_pictures import FoundPose
from ns_abstract.verify.neighbouring_pixels import nearby
from ns_abstract.verify.photo import Photo, TiledPhoto

#: Half a step of 8 bits.
HALF = Fraction(1, 510)
SET: dict[str, Any] = {"translation": {"x": 0.03, "y": 0.02}, "rotation": {"yaw": 0.03, "roll": 0.05}}


COVER = Location.cover


def box_of(lower: Any, upper: Any) -> ParameterBox:
    names = ("x", "y", "z", "yaw", "pitch", "roll")[: len(lower)]
    return ParameterBox(names, ("",) * len(names), tuple(map(float, lower)), tuple(map(float, upper)))


def taken(picture: np.ndarray, noise: float, outliers: int, generator: np.random.Generator) -> np.ndarray:
    """A photo of 8 bits of a picture [H, W, 3], with noise up to its ends and pixels that show anything."""
    error = noise * np.where(generator.random(picture.shape) < 0.3, generator.choice([-1.0, 1.0], picture.shape),
                             generator.uniform(-1.0, 1.0, picture.shape))  # fmt: skip
    levels = np.rint(255.0 * np.clip(picture.astype(np.float64) + error, 0.0, 1.0)).astype(np.uint8)
    places = generator.permutation(levels[..., 0].size)[:outliers]
    levels.reshape(-1, 3)[places] = generator.integers(0, 256, (outliers, 3), np.uint8)
    return levels


def test_a_photo_allows_its_noise_and_every_rounding() -> None:
    """Any value that rounds, up or down at ties, to the photo's after noise lies within what is allowed, exactly."""
    levels = np.arange(256, dtype=np.uint8).repeat(3).reshape(16, 16, 3)
    for noise in (0.0, 2.0 / 255.0, 0.02, 0.3):
        low, high = Photo(levels, noise, 0.0, np.ones((16, 16), bool)).ends
        for level, a, b in zip(levels.ravel().tolist(), low.ravel().tolist(), high.ravel().tolist(), strict=True):
            assert Fraction(a) <= Fraction(level, 255) - Fraction(noise) - HALF
            assert Fraction(b) >= Fraction(level, 255) + Fraction(noise) + HALF
            assert b - a <= 2.0 * noise + 1.01 / 255.0


def test_what_is_no_number_explains_and_excludes_nothing() -> None:
    photo = Photo(np.zeros((4, 4, 3), np.uint8), 0.0, 0.5, np.ones((4, 4), bool)).tiled(4)
    nothing = np.full((1, 4, 4, 3), np.nan, np.float32)
    tiles = np.arange(1)
    assert photo.outside(nothing).all()
    assert not photo.beyond(nothing, nothing, tiles).any()
    # bounds that cross bound nothing
    assert not photo.beyond(np.ones_like(nothing), np.full_like(nothing, 0.5), tiles).any()
    assert photo.beyond(np.full_like(nothing, 0.5), np.ones_like(nothing), tiles).all()
    assert photo.explained(nothing, nothing, tiles) == 0
    # nor over sub-boxes: the first may be anything, the second's bounds cross, the third is beyond the photo
    lower = np.full((16, 3, 4), [np.nan, 1.0, 0.5, 0.0])
    upper = np.full((16, 3, 4), [np.nan, 0.5, 1.0, 1.0])
    assert photo.excluding(lower, upper, photo.counted).sum(axis=0).tolist() == [0, 0, 16, 0]


@pytest.mark.parametrize("seed", range(30))
def test_contraction_keeps_every_pose_that_explains_the_photo(seed: int) -> None:
    """Poses at which all pixels but the allowed ones lie between exact linear bounds, some of them only just."""
    generator = np.random.default_rng(seed)
    d, side, allowed = int(generator.integers(1, 7)), 4, int(generator.integers(0, 6))
    a = (
        generator.normal(size=(1, side, side, 3, d)) * generator.choice([0.0, 1e-6, 0.1], (1, side, side, 3, 1))
    ).astype(np.float32)
    b = generator.uniform(0.0, 1.0, (1, side, side, 3)).astype(np.float32)
    width = np.float32(generator.choice([0.0, 0.01]))
    linear = a, b - width, a.copy(), b + width
    pose = generator.uniform(-1.0, 1.0, d) if seed % 3 else generator.choice([-1.0, 1.0], d)
    low, high = np.full((1, side, side, 3), -5.0), np.full((1, side, side, 3), 5.0)
    for place in np.ndindex(low.shape):
        move = sum((Fraction(float(s)) * Fraction(float(p)) for s, p in zip(a[place], pose, strict=True)), Fraction())
        # a picture at one of its bounds is explained, and only just; the other end is far off, or as near
        if place[-1] != 0 or width == 0.0:
            high[place] = np.nextafter(float(move + Fraction(float(linear[1][place]))), np.inf)
        if place[-1] == 0 or width == 0.0:
            low[place] = np.nextafter(float(move + Fraction(float(linear[3][place]))), -np.inf)
    places = generator.permutation(side * side)[:allowed]
    for part in (low, high):
        part.reshape(-1, 3)[places] += 5.0
    photo = TiledPhoto(low, high, np.ones((1, side, side), bool), allowed)
    steep = np.abs(a).sum(axis=-1)
    lower, upper = linear[1] - steep - 1e-5, linear[3] + steep + 1e-5
    tiles = np.arange(1)
    beyond = photo.beyond(lower, upper, tiles)
    assert beyond.sum() <= allowed
    least, most = photo.reach(linear, beyond, tiles)
    assert (least <= pose).all() and (pose <= most).all()
    box = box_of(generator.uniform(-1.0, 0.0, d), generator.uniform(0.5, 1.0, d))
    part = between(box, least, most)
    assert part.contains(box.at(pose))
    if allowed == 0 and width == 0.0 and d == 1:
        # and it is sharp
        assert (most - least < 1e-3).all()


def test_a_box_that_too_many_pixels_rule_out_is_empty() -> None:
    """Half of the pixels ask for one end of a parameter, half for the other: two more than may show anything."""
    a, b = np.full((1, 2, 4, 3, 1), 0.1, np.float32), np.full((1, 2, 4, 3), 0.5, np.float32)
    value = np.full((1, 2, 4, 3), 0.55)
    value[:, 1] = 0.45
    counted = np.ones((1, 2, 4), bool)
    for allowed, empty in ((3, True), (4, False)):
        photo = TiledPhoto(value - 0.01, value + 0.01, counted, allowed)
        least, most = photo.reach((a, b, a, b), np.zeros_like(counted), np.arange(1))
        assert (least > most).any() == empty


def test_slabs_and_the_inner_cell_tile_a_cell() -> None:
    generator = np.random.default_rng(0)
    for _ in range(200):
        d = int(generator.integers(1, 7))
        lower = generator.uniform(-1.0, 1.0, d)
        grid = CellGrid(box_of(lower, lower + generator.uniform(1e-9, 1.0, d)), (1 << 12,) * d, (1,) * d)
        first = generator.integers(0, 2000, d)
        cell = Cell(tuple(first.tolist()), tuple((first + generator.integers(1, 2000, d)).tolist()))
        ends = np.sort(grid.box_of(cell).sample(2, generator), axis=0)
        wanted = box_of(*ends)
        inner = inner_cell(grid, cell, wanted)
        held = grid.box_of(inner)
        assert all(a <= b for a, b in zip(held.lower, wanted.lower, strict=True))
        assert all(a >= b for a, b in zip(held.upper, wanted.upper, strict=True))
        parts = [inner, *slabs(cell, inner)]
        assert sum(part.volume for part in parts) == cell.volume
        for p, q in ((p, q) for k, p in enumerate(parts) for q in parts[:k]):
            both = zip(p.first, p.past, q.first, q.past, strict=True)
            assert any(b <= c or e <= a for a, b, c, e in both)


def test_sub_boxes_that_are_left_are_kept() -> None:
    """What `divided` calls empty holds no sub-box that is left, and its cells tile the cell."""
    generator = np.random.default_rng(0)
    for trial in range(60):
        counts = np.array(2 ** generator.integers(0, 4, int(generator.integers(1, 5))))
        first = generator.integers(0, 100, counts.size)
        units = generator.integers(1, 5, counts.size)
        cell = Cell(tuple(first.tolist()), tuple((first + units * counts).tolist()))
        left = generator.random(counts) < generator.choice([0.0, 0.05, 0.5, 0.95, 1.0])
        parts = list(divided(cell, left, 0.5))
        assert sum(part.volume for part, _ in parts) == cell.volume
        for place in np.ndindex(*left.shape):
            low = first + units * place
            holding = [
                some for part, some in parts
                if ((np.array(part.first) < low + units) & (low < np.array(part.past))).all()
            ]  # fmt: skip
            assert holding and (not left[place] or holding == [True]), (trial, place)


def test_sub_boxes_that_meet_a_part_are_those_that_hold_one_of_its_units() -> None:
    generator = np.random.default_rng(5)
    for _ in range(200):
        counts = 1 << generator.integers(0, 3, 3)
        first = generator.integers(-9, 9, 3)
        units = counts * generator.integers(1, 4, 3)
        cell = Cell(tuple(first.tolist()), tuple((first + units).tolist()))
        a = generator.integers(0, units)
        b = generator.integers(a, units) + 1
        chosen = np.zeros(counts, bool)
        for unit in np.ndindex(*(b - a).tolist()):
            chosen[tuple((a + unit) * counts // units)] = True
        part = Cell(tuple((first + a).tolist()), tuple((first + b).tolist()))
        assert (meeting(cell, counts, part) == chosen).all()


def test_known_outliers_are_stored_with_their_cell(tmp_path: Path) -> None:
    """What a block results in depends on the block alone, wherever and whenever it is examined."""
    grid = CellGrid(box_of([0.0, 0.0], [1.0, 1.0]), (8, 8), (1, 1))
    cells = [Cell((0, 0), (4, 8), outliers=(3, 70)), Cell((4, 0), (8, 8))]
    photo = Photo(np.zeros((8, 12, 3), np.uint8), 0.0, 0.5, np.ones((8, 12), bool)).tiled(4)
    store = LocationStore(tmp_path, {}, [("x", ""), ("y", "")], {0: {}}, resume=False)
    store.begin(0, grid, [cells[:1], cells[1:]])
    stored = {cell.first: cell for block in store.pending(set(), 2) for cell in block.cells}
    assert {cell.first: cell.outliers for cell in cells} == {first: cell.outliers for first, cell in stored.items()}
    assert set(stored.values()) == set(cells)
    assert np.flatnonzero(photo.chosen(stored[(0, 0)].outliers)).tolist() == [3, 70]


def test_numbers_of_sub_boxes_divide_the_units() -> None:
    cell = Cell((0, 3, 7), (1 << 10, 3 + 12, 7 + 5))
    assert sub_box_counts(cell, np.array([8, 8, 8])).tolist() == [8, 4, 1]
    assert sub_box_counts(cell, np.array([8, 2, 1])).tolist() == [8, 2, 1]
    grid = CellGrid(box_of([1.0, 1.0], [1.0 + 1e-3, 2.0]), (1 << 20,) * 2, (1, 1))
    assert resolved(grid.box_of(Cell((0, 0), (1 << 20, 1 << 20))), np.array([4, 4]))
    # lines of so small a cell are rounded by more than sub-boxes overlap, and two of them are too few
    assert not resolved(grid.box_of(Cell((4, 0), (8, 1 << 20))), np.array([4, 4]))
    assert not resolved(grid.box_of(Cell((0, 0), (1 << 20, 1 << 20))), np.array([2, 1]))


@pytest.mark.parametrize("seed", range(6))
def test_a_cover_holds_every_pose_of_sheared_boxes(seed: int) -> None:
    generator = np.random.default_rng(seed)
    box = box_of([-0.1, -0.2, -0.1, -0.05], [0.1, 0.1, 0.2, 0.1])
    shear = {"yaw": {"x": 0.7, "z": -0.2}} if seed else {}
    count = 12
    lower = np.stack([generator.uniform(a, b, count) for a, b in zip(box.lower, box.upper, strict=True)], axis=1)
    upper = lower + generator.uniform(0.0, 0.05, lower.shape)
    found = cover(box, ShearedBoxes(lower, upper, box.names, shear), 200)
    cells = [*found.left, *found.excluded]
    assert sum(cell.volume for cell in cells) == found.grid.volume
    left = [found.grid.box_of(cell) for cell in found.left]
    inside = 0
    for k in range(count):
        for _ in range(40):
            values = generator.choice([0.0, 1.0, generator.random()], 4) * (upper[k] - lower[k]) + lower[k]
            for other, factor in shear.get("yaw", {}).items():
                values[3] += factor * values[box.names.index(other)]
            if box.contains(values):
                inside += 1
                assert any(part.contains(values) for part in left)
    assert inside > 20
    assert found.volume < 0.5


@pytest.mark.parametrize("shear", [{}, {"yaw": {"x": 0.7, "z": -0.2}}, {"yaw": {"x": 0.5}, "z": {"y": -0.4}}])
def test_the_volume_of_sheared_boxes_within_a_set(shear: dict[str, dict[str, float]]) -> None:
    """At most what random poses tell, and little more; exactly that of boxes that are not sheared."""
    generator = np.random.default_rng(3)
    box = box_of([-0.1, -0.2, -0.1, -0.05], [0.1, 0.1, 0.2, 0.1])
    count, many = 30, 20_000
    lower = generator.uniform(np.array(box.lower) - 0.05, np.array(box.upper), (count, 4))
    upper = lower + generator.uniform(0.02, 0.2, lower.shape)
    found = ShearedBoxes(lower, upper, box.names, shear).volume_within(box)
    sampled, error = 0.0, 0.0
    for low, high in zip(lower, upper, strict=True):
        values = generator.uniform(low, high, (many, 4))
        own = values.copy()
        for name, factors in shear.items():
            for other, factor in factors.items():
                values[:, box.names.index(name)] += factor * own[:, box.names.index(other)]
        share = float(((values >= box.lower) & (values <= box.upper)).all(axis=1).mean())
        sampled += float(np.prod(high - low)) * share
        error += float(np.prod(high - low)) ** 2 * share * (1.0 - share) / many
    assert sampled - 5.0 * error**0.5 <= found <= (1.1 if shear else 1.0) * sampled + 5.0 * error**0.5
    assert ShearedBoxes(lower[:0], upper[:0], box.names, shear).volume_within(box) == 0.0


@pytest.mark.parametrize("factor", [0.2, 3.0, -20.0])
def test_the_volume_of_a_sheared_box_around_a_set_is_that_of_the_set(factor: float) -> None:
    """However much of the box lies beyond the set: a pose has as much of the turn as the set has, at most."""
    box = box_of([-0.1, -0.2, -0.1, -0.05], [0.1, 0.1, 0.2, 0.1])
    lower, upper = np.array([box.lower, box.upper])
    reach = abs(factor) * 0.3
    lower[3], upper[3] = lower[3] - reach, upper[3] + reach
    whole = float(np.prod(np.subtract(box.upper, box.lower)))

    def volume(low: np.ndarray, high: np.ndarray) -> float:
        sheared = ShearedBoxes(low[None], high[None], box.names, {"yaw": {"x": factor, "y": 0.5 * factor}})
        return sheared.volume_within(box) / whole

    assert volume(lower, upper) == pytest.approx(1.0)
    # poses of both parts: those that each holds add up to all, and to little more
    half = 0.5 * (lower[3] + upper[3])
    parts = volume(lower, np.array([*upper[:3], half])), volume(np.array([*lower[:3], half]), upper)
    assert 1.0 - 1e-9 <= sum(parts) <= 1.25


def test_a_cover_takes_little_that_is_excluded() -> None:
    """A set of which a part is excluded is not reported as left as a whole."""
    box = box_of([0.0, 0.0, 0.0, 0.0], [1.0, 1.0, 1.0, 1.0])
    lower = np.array([[0.0, 0.0, 0.0, 0.0], [0.5, 0.0, 0.0, 0.0]])
    upper = np.array([[0.5, 1.0, 1.0, 1.0], [1.0, 0.75, 1.0, 1.0]])
    found = cover(box, ShearedBoxes(lower, upper, box.names, {}))
    assert 0.875 <= found.volume <= 1.03 * 0.875


def test_a_cover_ends_with_its_time() -> None:
    """It holds all that is left however early it ends."""
    generator = np.random.default_rng(0)
    lower = generator.uniform(-1.0, 0.9, (300, 6))
    upper = lower + 0.1 * generator.uniform(size=(300, 6))
    names, shear = tuple("abcdef"), {"a": {"d": 0.3, "e": -0.1}}
    box = ParameterBox(names, ("",) * 6, (-1.0,) * 6, (1.0,) * 6)
    asked = itertools.count()
    early = cover(box, ShearedBoxes(lower, upper, names, shear), late=lambda: next(asked) >= 5)
    assert len(early.left) <= 6 and early.volume > 0.1
    holders = [early.grid.box_of(cell) for cell in early.left]
    inside = generator.uniform(lower, upper)
    inside[:, 0] += 0.3 * inside[:, 3] - 0.1 * inside[:, 4]
    kept = inside[(np.abs(inside) <= 1.0).all(axis=1)]
    assert len(kept) > 200 and all(any(holder.contains(values) for holder in holders) for values in kept)


def test_what_is_left_is_told_apart_from_the_boxes_around_it(blobs: Inputs, tmp_path: Path) -> None:
    """Six parameters, of which two cells far apart are left: the boxes around them hold far more."""
    camera = nsa.load_camera_path(blobs.path).cameras[0]
    scene = nsa.load_scene(blobs.config)
    poses = nsa.PoseSet(
        camera, translation={"x": 0.03, "y": 0.03, "z": 0.03}, rotation={"yaw": 0.03, "pitch": 0.03, "roll": 0.03}
    )
    job = Job(scene, [poses.of(scene)])
    location = Location(job, np.zeros((32, 32, 3), np.uint8), None, PhotoOptions())
    grid = location.search(0).grid
    middle = [units // 2 for units in grid.units]
    half = 1 << 15
    left = [
        Cell(tuple(middle), tuple(m + half for m in middle)),
        Cell(tuple(m - 2 * half for m in middle), tuple(m - half for m in middle)),
    ]
    part = location.possible_volume(0, left)
    assert 0.0 < part < 1e-7
    whole, own = (np.subtract(b.upper, b.lower) for b in (grid.box, location.search(0).plain.box))
    assert part == pytest.approx(2 * (half / grid.units[0]) ** 6 * np.prod(whole / own))
    assert location.cover(0, left, lambda: True).volume > 100.0 * part
    assert location.possible_volume(0, grid.roots()) == 1.0 and location.possible_volume(0, []) == 0.0


def test_a_locate_command_ends_with_its_time(
    blobs: Inputs, tmp_path: Path, in_process: InProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The boxes around what is left are cut until the time is over, and no longer."""
    image = tmp_path / "photo.png"
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (32, 32, 3), np.uint8)).save(image)
    ends: list[float] = []
    monkeypatch.setattr(
        Location,
        "cover",
        lambda self, number, cells, late: (ends.append(late.left), COVER(self, number, cells, late))[1],
    )
    code, _, _ = in_process(main, options(blobs, tmp_path / "out", image, time_budget=3))
    assert code == 0 and len(ends) == 1 and ends[0] <= 3.0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["possible_volume"] <= report["boxes_volume"] <= 1.0


def test_nearby_values() -> None:
    image = np.random.default_rng(0).random((5, 6, 3))
    least, most = nearby(image, 2)
    for y, x in np.ndindex(5, 6):
        part = image[max(0, y - 2) : y + 3, max(0, x - 2) : x + 3].reshape(-1, 3)
        np.testing.assert_array_equal(least[y, x], part.min(axis=0))
        np.testing.assert_array_equal(most[y, x], part.max(axis=0))


def followed(location: Location, pose: np.ndarray, most: int) -> tuple[int, float]:
    """Examine the cells that hold a pose alone; how many there were, and the part of the set that is left."""
    search = location.search(0)
    # others, too: what is known of cells has to hold at every pose
    poses = np.concatenate([pose[None], search.plain.box.sample(60, np.random.default_rng(0))])
    missed = [np.flatnonzero(search.tiled.outside(search.plain.render(values))) for values in poses]
    places = poses.copy()
    for name, factors in search.frame.pose_set.shear.items():
        names = search.frame.box.names
        places[:, names.index(name)] -= sum(f * poses[:, names.index(other)] for other, f in factors.items())
    sheared = places[0]
    cells = search.grid.roots()
    for count in range(most):
        if not cells:
            return count, 0.0
        findings = search.examine(cells[:1])
        for leaf in findings.leaves:
            assert leaf.verdict != "certified" or not holds(search.grid.box_of(leaf.cell), sheared)
        parts = [cell for block in findings.blocks for cell in block]
        for cell, (place, outliers) in itertools.product(parts, zip(places, missed, strict=True)):
            if holds(search.grid.box_of(cell), place):
                assert set(cell.outliers) <= set(outliers.tolist())
        kept = [leaf.cell for leaf in findings.leaves if leaf.verdict != "certified"]
        cells = [*cells[1:], *(cell for cell in parts if search.grid.box_of(cell).contains(sheared))]
        assert cells or any(search.grid.box_of(cell).contains(sheared) for cell in kept)
    return most, sum(cell.volume for cell in cells) / search.grid.volume


def holds(box: ParameterBox, values: np.ndarray) -> bool:
    """Whether values lie inside a box, farther from its ends than they are rounded."""
    room = 1e-13
    return bool(np.all((values > np.array(box.lower) + room) & (values < np.array(box.upper) - room)))


def test_known_outliers_exclude_a_cell_without_bounds(blobs: Inputs) -> None:
    scene, camera = nsa.load_scene(blobs.config), nsa.load_camera_path(blobs.path).cameras[0]
    job = Job(scene, [nsa.PoseSet(camera, translation={"x": 0.001}).of(scene)])
    search = Location(job, np.zeros((32, 32, 3), np.uint8), None, PhotoOptions(1.0 - 1e-9, 0.01)).search(0)
    (root,) = search.grid.roots()
    numbers = np.flatnonzero(search.tiled.counted)[: search.tiled.allowed + 1].tolist()
    findings = search.examine([replace(root, outliers=tuple(numbers))])
    assert [(leaf.cell, leaf.verdict) for leaf in findings.leaves] == [(root, "certified")] and not findings.bounded
    # any picture explains this photo
    findings = search.examine([replace(root, outliers=tuple(numbers[:-1]))])
    assert not any(leaf.verdict == "certified" for leaf in findings.leaves)


@pytest.mark.parametrize("outliers", [0, 100])
def test_a_set_of_one_pose_is_searched(outliers: int, blobs: Inputs) -> None:
    scene, camera = nsa.load_scene(blobs.config), nsa.load_camera_path(blobs.path).cameras[0]
    poses, generator = nsa.PoseSet(camera), np.random.default_rng(0)
    frame = Job(scene, [poses.of(scene)]).frame(0)
    levels = taken(assemble(frame.render(np.zeros(0)), camera), 0.0, outliers, generator)
    found = nsa.locate(scene, poses, levels, noise=0.01, outliers=0.02, time_budget=60.0)
    assert found.answer == ("none" if outliers else "possible")
    assert found.possible_volume == found.boxes_volume == (0.0 if outliers else 1.0)
    assert found.best is not None and abs(found.best["outliers"] - outliers) <= 5


def test_a_pose_beside_a_cell_does_not_make_it_possible(blobs: Inputs, monkeypatch: pytest.MonkeyPatch) -> None:
    """The picture that pixels are chosen by is of a pose nearby; what that one explains is told, of no cell."""
    scene, camera = nsa.load_scene(blobs.config), nsa.load_camera_path(blobs.path).cameras[0]
    poses = nsa.PoseSet(camera, translation={"x": 0.03, "y": 0.03}, rotation={"yaw": 0.02})
    job = Job(scene, [poses.of(scene)])
    frame = job.frame(0)
    levels = taken(assemble(frame.render(frame.box.middle), frame.camera), 0.0, 0, np.random.default_rng(0))
    photo = Location(job, levels, None, PhotoOptions(0.01, 0.02)).photo
    # every cell is the finest, and has sub-boxes
    tuning = LocationTuning(finest=1.0, contracted=0.0)
    search = LocationSearch(job.frame(0, sheared=True), job.frame(0), photo, tuning=tuning)
    (root,) = search.grid.roots()
    beside = search.grid.box.middle

    class Beside:
        def near(self, box: ParameterBox) -> tuple[np.ndarray, FoundPose]:
            return search.look(beside)

    monkeypatch.setattr(LocationSearch, "moved_pictures", Beside())
    verdicts, told = set(), False
    for cell in search.grid.cut(root, [8, 8, 8]):
        if not search.grid.box_of(cell).contains(beside):
            findings = search.examine([cell])
            verdicts |= {leaf.verdict for leaf in findings.leaves}
            told |= findings.best is not None and findings.best.outliers <= search.tiled.allowed
    assert told and verdicts == {"certified", "unknown"}


@pytest.mark.parametrize(("shifts", "turns"), [("xy", ()), ("xy", ("yaw",)), ("xyz", ("yaw", "pitch", "roll"))])
def test_sub_boxes_are_shared_out_by_motion(shifts: str, turns: tuple[str, ...], blobs: Inputs) -> None:
    camera = nsa.load_camera_path(blobs.path).cameras[0]
    poses = nsa.PoseSet(camera, translation=dict.fromkeys(shifts, 0.05), rotation=dict.fromkeys(turns, 0.05))
    scene = nsa.load_scene(blobs.config)
    location = Location(Job(scene, [poses.of(scene)]), np.zeros((32, 32, 3), np.uint8), None, PhotoOptions())
    search = location.search(0)
    box = search.frame.box
    counts, moved = search.along(box), search.moved(box)
    if len(moved) >= search.tuning.many:
        # parts of all axes move the picture by about as much
        assert counts.prod() == search.tuning.sub_boxes and (counts & (counts - 1) == 0).all()
        assert (moved / counts).max() <= 2.0 * np.where(counts > 1, moved / counts, np.inf).min() + 1e-9
    else:
        assert counts[np.argsort(-moved)].tolist() == [8, 8, 1][: len(moved)]
    # a set that is too wide for bounds begins with parts that tile it
    first = search.first_cells()
    assert (len(first) > 1) == (search.width(box) > search.tuning.coarse[search.by_motion])
    assert sum(cell.volume for cell in first) == search.grid.volume
    # without contraction cells are bounded as a whole
    whole = Location(location.job, location.photo.levels, None, PhotoOptions(contract=False)).search(0)
    assert whole.motion_cells(box) is None and search.motion_cells(box) is not None


@pytest.mark.slow_cases(every=4)
@pytest.mark.parametrize("seed", range(4))
def test_the_true_pose_is_never_excluded(seed: int, blobs: Inputs) -> None:
    generator = np.random.default_rng(seed)
    scene = nsa.load_scene(blobs.config)
    camera = nsa.load_camera_path(blobs.path).cameras[seed % 3]
    job = Job(scene, [nsa.PoseSet(camera, **SET).of(scene)])
    frame = job.frame(0)
    pose = frame.box.sample(1, generator)[0] if seed else np.array(frame.box.upper)
    noise, outliers = float(generator.choice([0.0, 2.0 / 255.0])), int(generator.choice([0, 20]))
    levels = taken(assemble(frame.render(pose), frame.camera), noise, outliers, generator)
    location = Location(job, levels, None, PhotoOptions(noise, outliers / levels[..., 0].size))
    assert location.photo.outside(location.picture(0, pose)).sum() <= location.photo.allowed
    _, left = followed(location, pose, 24)
    assert left < 0.01


@pytest.mark.slow
def test_locate_finds_the_pose(blobs: Inputs, tmp_path: Path) -> None:
    generator = np.random.default_rng(5)
    scene = nsa.load_scene(blobs.config)
    poses = nsa.PoseSet(nsa.load_camera_path(blobs.path).cameras[0], translation={"x": 0.03}, rotation={"yaw": 0.02})
    frame = scene.method().frame(poses.of(scene))
    pose = frame.box.sample(1, generator)[0]
    levels = taken(assemble(frame.render(pose), frame.camera), 2.0 / 255.0, 20, generator)
    place = nsa.locate(
        scene, poses, levels, noise=2.0 / 255.0, outliers=20 / 1024, time_budget=20.0, output_dir=tmp_path
    )
    assert place.possible_volume < 0.01
    assert place.hull is not None and place.best is not None
    assert (place.hull[0] <= pose).all() and (pose <= place.hull[1]).all()
    assert np.abs(np.array(place.best["pose"]) - pose).max() < 2e-3
    sizes = np.array(frame.box.upper) - np.array(frame.box.lower)
    volumes = {
        kind: sum(np.prod((c.upper - c.lower) / sizes) for c in place.cells if (c.verdict == "excluded") == kind)
        for kind in (True, False)
    }
    assert volumes[False] == pytest.approx(place.boxes_volume)
    assert 0.0 < place.possible_volume <= place.boxes_volume
    assert sum(volumes.values()) == pytest.approx(1.0)
    for cell in place.cells:
        if cell.verdict == "possible":
            assert cell.pose is not None and (cell.lower <= cell.pose).all() and (cell.pose <= cell.upper).all()
            shown = assemble(frame.render(cell.pose), frame.camera)
            photo = Photo(levels, 2.0 / 255.0, 20 / 1024, np.ones((32, 32), bool))
            assert photo.outside(shown).sum() <= 20
    page = (tmp_path / "report.html").read_text()
    assert "best render" in page and "What is left" in page


def options(blobs: Inputs, output: Path, image: Path, **more: Any) -> list[str]:
    return blobs.options(output, image=image, frames=0, workers=1, **more)


@pytest.mark.slow
def test_command_says_none_and_resumes(blobs: Inputs, tmp_path: Path, in_process: InProcess) -> None:
    """A photo of something else; the answer is none, and the table's cells tile the set."""
    image = tmp_path / "photo.png"
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (32, 32, 3), np.uint8)).save(image)
    for more in ({}, {"resume": True}):
        code, _, err = in_process(main, options(blobs, tmp_path / "out", image, time_budget=60, **more))
        assert code == 0 and "none: no pose of the set made the photo" in err
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["frames"][0]["intrinsics"] == load_camera_path(blobs.path).cameras[0].intrinsics._asdict()
    assert report["answer"] == "none" and report["possible_volume"] == 0.0 and report["hull"] is None
    with sqlite3.connect(tmp_path / "out" / "cells.sqlite") as base:
        rows = base.execute("SELECT lower, upper, verdict, counterexample FROM cells").fetchall()
    assert {row[2] for row in rows} == {"excluded"}
    total = sum(json.loads(row[1])[0] - json.loads(row[0])[0] for row in rows)
    assert total == pytest.approx(0.06)
    code, _, err = in_process(main, options(blobs, tmp_path / "out", image, noise=0.1, resume=True))
    assert code == 2 and "another noise" in err


@pytest.mark.parametrize(
    "place",
    [
        "ns_abstract.api.locating:LocationQuestion.opened",
        "ns_abstract.api.locating:warm_up_sub_boxes",
        "ns_abstract.cli.searching:compile_beside",
        "ns_abstract.api.cell_search:examine_here",
    ],
)
def test_a_locate_command_is_interrupted_before_its_first_cell(
    place: str, blobs: Inputs, tmp_path: Path, in_process: InProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = tmp_path / "photo.png"
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (32, 32, 3), np.uint8)).save(image)
    with monkeypatch.context() as patched:
        interrupted_at(place, patched)
        check_interrupted(in_process, main, options(blobs, tmp_path / "out", image), tmp_path / "out")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["answer"] != "possible" and (report["answer"] == "none") == (report["possible_volume"] == 0.0)
    code, _, err = in_process(main, options(blobs, tmp_path / "out", image, time_budget=60, resume=True))
    assert code == 0 and "none: no pose of the set made the photo" in err


@pytest.mark.parametrize(
    "size, mode, more, words",
    [
        ((40, 30), "RGB", {}, "resize it to 32 x 32"),
        ((32, 32), "L", {}, "save it as RGB"),
        ((32, 32), "RGBA", {}, "without an alpha channel"),
        ((32, 32), "RGB", {"noise": -0.1}, "--noise: found -0.1"),
        ((32, 32), "RGB", {"noise": "nan"}, "--noise: found nan"),
        ((32, 32), "RGB", {"outliers": 1.0}, "--outliers: found 1.0"),
        ((32, 32), "RGB", {"mask": "black.png"}, "counts no pixel"),
        ((32, 32), "RGB", {"mask": "grey.png"}, "neither black nor white"),
        ((32, 32), "RGB", {"mask": "small.png"}, "resize it to 32 x 32 with nearest"),
        ((32, 32), "RGB", {"mask": "missing.png"}, "no such file"),
        ((32, 32), "RGB", {"mask": "text.png"}, "cannot be read"),
        ((32, 32), "RGB", {"time_budget": 0}, "--time-budget: found 0.0"),
    ],
)
def test_bad_input_is_one_line(
    size: tuple[int, int], mode: str, more: dict[str, Any], words: str, blobs: Inputs, tmp_path: Path,
    in_process: InProcess,
) -> None:  # fmt: skip
    image = tmp_path / "photo.png"
    Image.new(mode, size, 0).save(image)
    Image.new("RGB", (32, 32), "black").save(tmp_path / "black.png")
    Image.new("RGB", (32, 32), "grey").save(tmp_path / "grey.png")
    Image.new("RGB", (16, 16), "white").save(tmp_path / "small.png")
    (tmp_path / "text.png").write_text("no picture")
    if "mask" in more:
        more = {"mask": tmp_path / more["mask"]}
    code, _, err = in_process(main, options(blobs, tmp_path / "out", image, **more))
    assert code == 2 and words in err and err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_photos_of_the_python_interface(blobs: Inputs) -> None:
    scene = nsa.load_scene(blobs.config)
    poses = nsa.PoseSet(nsa.load_camera_path(blobs.path).cameras[0], translation={"x": 0.01})
    for photo, words in (
        (np.zeros((32, 32), np.uint8), "found uint8 of shape"),
        (np.full((32, 32, 3), 0.5), "round it to 8 bits"),
        (np.full((32, 32, 3), np.nan), "round it to 8 bits"),
        (np.full((32, 32, 3), 2.0), "round it to 8 bits"),
    ):
        with pytest.raises(nsa.InputError, match=words):
            nsa.locate(scene, poses, photo)
    with pytest.raises(nsa.InputError, match="bool"):
        nsa.locate(scene, poses, np.zeros((32, 32, 3), np.uint8), mask=np.ones((32, 32)))
