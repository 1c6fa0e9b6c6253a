"""The program that checks results: it is independent, its enclosures hold, and false results do not pass."""

from __future__ import annotations

import ast
import dataclasses
import hashlib
import itertools
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import pytest
import torch
from conftest import InProcess, Inputs, blob_scene, environment, ring

import ns_abstract as nsa
from ns_abstract.api import checking
from ns_abstract.api.checking import check
from ns_abstract.check import results
from ns_abstract.check.audit import ClaimOutcome
from ns_abstract.check.claims import _divided
from ns_abstract.check.forms import Affine, parameters
from ns_abstract.check.inputs import BadInput, read_poses
from ns_abstract.check.pictures import ClaimedBounds, Picture
from ns_abstract.check.poses import CheckedCamera, Poses
from ns_abstract.check.results import partition, read_cells
from ns_abstract.check.splats import FLOAT, ActivatedScene, activated, gaussians_at, pixel_extents, pixels
from ns_abstract.cli import check as check_command
from ns_abstract.geometry.camera_path import PinholeCamera as PathCamera
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.io.errors import InputError
from ns_abstract.methods.splat.constants import VERSIONS
from ns_abstract.methods.splat.reference import Reference
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.perturbation.specification import parse_perturbation

FOLDER = Path(nsa.__file__).parent / "check"
PLANT = Path(__file__).resolve().parents[1].parent / "shared" / "runs" / "plant"

# ---------------------------------------------------------------- independence


def lines_of_code(text: str) -> int:
    """Lines that are no blank lines and no comments; docstrings count."""
    return sum(bool(line.strip()) and not line.strip().startswith("#") for line in text.splitlines())


#: What reads files; the rest of the folder proves.
READING = ("inputs.py", "results.py")


def test_it_shares_no_code_and_stays_small() -> None:
    lines = {True: 0, False: 0}
    for file in FOLDER.glob("*.py"):
        text = file.read_text(encoding="utf-8")
        lines[file.name in READING] += lines_of_code(text)
        for node in ast.walk(ast.parse(text)):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            for name in names:
                assert not name.startswith("ns_abstract") or name.startswith("ns_abstract.check."), (file, name)
    assert 0 < lines[False] <= 1502 and 0 < lines[True] <= 478


# ---------------------------------------------------------------- enclosures

OPERATIONS: dict[str, tuple[Callable[[Affine], Affine], Callable[[Any], Any]]] = {
    "square": (lambda f: f.square(), lambda x: x * x),
    "product": (lambda f: f * (f + 1.5), lambda x: x * (x + mpmath.mpf(1.5))),
    "reciprocal": (lambda f: f.power(-1.0), lambda x: 1 / x),
    "reciprocal root": (lambda f: f.power(-0.5), lambda x: 1 / mpmath.sqrt(x)),
    "root": (lambda f: f.power(0.5), mpmath.sqrt),
    "exponential": (lambda f: f.exp(), mpmath.exp),
    "sine": (lambda f: f.sine()[0], mpmath.sin),
    "cosine": (lambda f: f.sine()[1], mpmath.cos),
    "clamp": (lambda f: f.clamped(0.7, 1.9), lambda x: min(max(x, mpmath.mpf(0.7)), mpmath.mpf(1.9))),
}


@pytest.mark.parametrize("name", OPERATIONS)
def test_forms_contain_exact_values(name: str) -> None:
    enclose, exact = OPERATIONS[name]
    rng = np.random.default_rng(5)
    with mpmath.workprec(200):
        for half in (0.0, 1e-9, 1e-3, 0.2):
            middle = rng.uniform(0.5, 2.0, (20, 2))
            radius = np.full((20, 2), half)
            a, b = parameters(middle, radius)
            # a + b / 8, which is exact enough in 200 bits
            found = enclose(a + b * 0.125)
            for k in range(20):
                for s in rng.uniform(-1.0, 1.0, (8, 2)):
                    x, y = (mpmath.mpf(m) + mpmath.mpf(half) * e for m, e in zip(middle[k], s.tolist(), strict=True))
                    true = exact(x + y / 8)
                    plane = mpmath.mpf(float(found.c[k])) + sum(
                        mpmath.mpf(float(g)) * mpmath.mpf(float(e)) for g, e in zip(found.g[:, k], s, strict=True)
                    )
                    assert abs(true - plane) <= mpmath.mpf(float(found.r[k]))


def test_what_is_not_defined_is_not_bounded() -> None:
    form = Affine(np.array([0.1, -1.0]), np.array([[0.2, 0.1]]), np.array([0.0, 0.0]))
    assert all(np.isinf(form.power(k).r).all() for k in (-1.0, -0.5, 0.5))


SPEC = {
    "version": 1, "translation": {"x": 0.05, "y": 0.02}, "rotation": {"yaw": 0.03},
    "orbit": {"target": [0, 0, 0.1], "axis": [0, 0.2, 1], "azimuth": [-0.3, 0.3]},
}  # fmt: skip


def splats_of(scene: SplatScene, version: str = "1.4.0") -> ActivatedScene:
    return activated(
        [scene.means, scene.log_scales, scene.quats, scene.opacity_logits, scene.sh], sigmoid=False,
        degree=scene.sh_degree, antialiased=scene.rasterize_mode == "antialiased", background=scene.background,
        version=version,
    )  # fmt: skip


def cameras(pose: np.ndarray, focal: float) -> tuple[CheckedCamera, PathCamera]:
    """One camera of 32 x 32 pixels, for both programs."""
    values = (pose, focal, focal, 16.0, 16.0, 32, 32)
    return CheckedCamera(*values), PathCamera(*values)


def candidates(
    splats: ActivatedScene, poses: Poses, low: np.ndarray, high: np.ndarray, pixel: tuple[int, int]
) -> np.ndarray:
    view = poses.view(low[None], high[None])
    return gaussians_at(pixel_extents(splats, poses.camera, view, 0.0)[0], *pixel)


def pixel_form(
    splats: ActivatedScene,
    poses: Poses,
    low: np.ndarray,
    high: np.ndarray,
    index: np.ndarray,
    pixel: tuple[int, int],
    channel: int,
    unit: float = 0.0,
) -> tuple[Affine, np.ndarray, np.ndarray]:
    """One channel of a pixel over boxes [B, d]."""
    at, place = np.broadcast_to(index, (len(low), len(index))), tuple(np.full(len(low), v) for v in pixel)
    form, kept, motion = pixels(splats, poses.camera, poses.view(low, high), at, place, unit)  # pyright: ignore[reportArgumentType]
    return form.apply(lambda a: a[..., channel]), kept, motion


def opaque(scene: SplatScene) -> SplatScene:
    """The scene with opacities at which the rasteriser caps alphas and stops."""
    return dataclasses.replace(scene, opacity_logits=3.0 * scene.opacity_logits)


@pytest.mark.slow
@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_pixels_contain_pictures_of_another_renderer(mode: str, version: str) -> None:
    scene = dataclasses.replace(opaque(blob_scene(120, degree=3)), rasterize_mode=mode)
    pose = np.asarray(ring()[1].camera_to_world, np.float64)[:3]
    focal = 16.0 / np.tan(np.radians(45.0) / 2.0)
    ours, theirs = cameras(pose, focal)
    pose_set = PoseBox.around(theirs, parse_perturbation(SPEC))
    poses = Poses(ours, pose_set.box.names, {}, False, (np.array([0, 0, 0.1]), np.array([0, 0.2, 1.0])))
    splats, reference, rng = splats_of(scene, version), Reference(scene, VERSIONS[version]), np.random.default_rng(3)
    narrow = 0
    for half in (0.0, 1e-5, 1e-3, 0.01):
        middle = rng.uniform(-0.9, 0.9, 4) * np.array([0.05, 0.02, 0.03, 0.3])
        low, high = (middle - half)[None], (middle + half)[None]
        places = [np.clip(middle + half * s, low[0], high[0]) for s in rng.uniform(-1.0, 1.0, (4, 4))]
        pictures = [reference.image(theirs, torch.from_numpy(pose_set.pose(p))).numpy() for p in places]
        for _ in range(12):
            pixel, channel = tuple(int(v) for v in rng.integers(0, 32, 2)), int(rng.integers(3))
            index = candidates(splats, poses, low[0], high[0], pixel)  # pyright: ignore[reportArgumentType]
            form, kept, _ = pixel_form(splats, poses, low, high, index, pixel, channel)  # pyright: ignore[reportArgumentType]
            again, _, _ = pixel_form(splats, poses, low, high, index[kept[0]], pixel, channel)  # pyright: ignore[reportArgumentType]
            narrow += bool(form.r[0] < 1e-2)
            for found in (form, again):
                for p, picture in zip(places, pictures, strict=True):
                    s = (p - middle) / half if half else np.zeros(4)
                    value = found.c[0] + found.g[:, 0] @ s
                    # what the other renderer's float64 errs by
                    room = found.r[0] + 1e-10
                    assert np.clip(value - room, 0, 1) <= picture[pixel][channel] + 1e-12
                    assert np.clip(value + room, 0, 1) >= picture[pixel][channel] - 1e-12
    assert narrow > 24


def test_a_change_of_order_is_enclosed() -> None:
    """Two Gaussians at nearly one depth, of other colours, seen from both sides of the tie."""
    scene = blob_scene(2, degree=0)
    scene = dataclasses.replace(
        scene,
        means=np.array([[-0.02, 0.0, 0.0], [0.02, 0.0, 0.0]], np.float32),
        log_scales=np.full((2, 3), -2.0, np.float32),
        opacity_logits=np.full(2, 2.0, np.float32),
        sh=np.array([[[1.5, -1.5, 0.0]], [[-1.5, 1.5, 0.0]]], np.float32),
    )
    pose = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2.0]])
    ours, theirs = cameras(pose, 40.0)
    # far enough off the axis for the order to change by a small turn
    pose_set = PoseBox.around(theirs, parse_perturbation({"version": 1, "rotation": {"yaw": 0.01}}))
    poses, splats, reference = Poses(ours, ("yaw",)), splats_of(scene), Reference(scene)
    low, high = np.array([[-0.01]]), np.array([[0.01]])
    index = candidates(splats, poses, low[0], high[0], (16, 16))
    form, _, _ = pixel_form(splats, poses, low, high, index, (16, 16), 0)
    least, most = (float(v[0]) for v in form.range())
    seen = [
        float(reference.image(theirs, torch.from_numpy(pose_set.pose(np.array([yaw]))))[16, 16, 0])
        for yaw in (-0.01, -1e-6, 1e-6, 0.01)
    ]
    assert max(seen) - min(seen) > 0.1
    assert least <= min(seen) and max(seen) <= most


def test_a_capped_alpha_lets_light_through() -> None:
    """One opaque Gaussian in front of the background: 0.999 of its colour and a thousandth of the background's."""
    scene = dataclasses.replace(
        blob_scene(1, degree=0),
        # in the middle of a pixel
        means=np.array([[0.025, -0.025, 0.0]], np.float32),
        log_scales=np.full((1, 3), -1.0, np.float32),
        opacity_logits=np.full(1, 12.0, np.float32),
        sh=np.zeros((1, 1, 3), np.float32),
        background=np.ones(3, np.float32),
    )
    ours, _ = cameras(np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2.0]]), 40.0)
    poses, splats, box = Poses(ours, ("x",)), splats_of(scene), np.array([[0.0]])
    form, _, _ = pixel_form(splats, poses, box, box, np.arange(1), (16, 16), 0)
    assert abs(form.c[0] - (0.999 * 0.5 + 0.001)) <= form.r[0] < 1e-12


@pytest.mark.parametrize("unit", [0.0, FLOAT])
def test_an_alpha_that_may_be_skipped_may_be_nothing(unit: float) -> None:
    """A Gaussian whose alpha reaches 1/255 for some poses of a box alone, in front of black."""
    scene = dataclasses.replace(
        blob_scene(1, degree=0),
        means=np.zeros((1, 3), np.float32),
        log_scales=np.full((1, 3), -1.0, np.float32),
        opacity_logits=np.full(1, -1.0, np.float32),
        background=np.zeros(3, np.float32),
    )
    ours, theirs = cameras(np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2.0]]), 40.0)
    pose_set = PoseBox.around(theirs, parse_perturbation({"version": 1, "translation": {"x": 2.0}}))
    poses, splats, reference = Poses(ours, ("x",)), splats_of(scene), Reference(scene)
    places = np.linspace(1.13, 1.2, 21)
    seen = [
        float(reference.image(theirs, torch.from_numpy(pose_set.pose(np.array([x]))))[16, 16].max()) for x in places
    ]
    assert min(seen) == 0.0 < max(seen)
    form, _, _ = pixel_form(splats, poses, places[None, :1], places[None, -1:], np.arange(1), (16, 16), 0, unit)
    assert form.range()[0][0] <= 0.0 and form.range()[1][0] > 0.0


@pytest.mark.parametrize("unit", [0.0, FLOAT])
def test_the_background_is_drawn_exactly(unit: float) -> None:
    """A box over which nothing shows, beside one over which a Gaussian does."""
    scene = dataclasses.replace(blob_scene(1, degree=0), background=np.full(3, 0.3, np.float32))
    scene = dataclasses.replace(scene, means=np.zeros((1, 3), np.float32), opacity_logits=np.full(1, 2.0, np.float32))
    ours, _ = cameras(np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2.0]]), 40.0)
    box = np.array([[0.0], [9.0]])
    form, kept, _ = pixel_form(splats_of(scene), Poses(ours, ("x",)), box, box, np.arange(1), (16, 16), 0, unit)
    assert kept[:, 0].tolist() == [True, False] and form.r[0] > 0.0
    assert form.c[1] == np.float32(0.3) and form.r[1] == 0.0 and not form.g[:, 1].any()


@pytest.mark.slow
def test_a_stop_that_is_open_is_enclosed() -> None:
    """Behind 0.999 the rasteriser stops at an alpha of 0.9, which a second Gaussian has for some poses of a box."""
    scene = dataclasses.replace(
        blob_scene(2, degree=0),
        means=np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -0.5]], np.float32),
        log_scales=np.array([[-1.0] * 3, [-2.0] * 3], np.float32),
        opacity_logits=np.array([12.0, 2.9], np.float32),
        sh=np.array([[[0.0] * 3], [[-1.7] * 3]], np.float32),
        background=np.ones(3, np.float32),
    )
    ours, theirs = cameras(np.array([[1.0, 0, 0, -0.0125], [0, 1, 0, 0.0125], [0, 0, 1, 2.0]]), 40.0)
    pose_set = PoseBox.around(theirs, parse_perturbation({"version": 1, "translation": {"x": 0.06}}))
    poses, splats, reference = Poses(ours, ("x",)), splats_of(scene), Reference(scene)
    low, high = np.array([[-0.06]]), np.array([[0.06]])
    seen = [
        float(reference.image(theirs, torch.from_numpy(pose_set.pose(np.array([x]))))[16, 16, 0])
        for x in np.linspace(-0.06, 0.06, 61)
    ]
    assert max(np.abs(np.diff(seen))) > 5e-4
    form, _, _ = pixel_form(splats, poses, low, high, np.arange(2), (16, 16), 0)
    values = form.c[0] + form.g[0, 0] * np.linspace(-1.0, 1.0, 61)
    assert (np.abs(values - seen) <= form.r[0] + 1e-12).all()
    # the enclosure knows where it stops
    parts = np.linspace(-0.06, 0.06, 2001)[:, None]
    form, _, _ = pixel_form(splats, poses, parts[:-1], parts[1:], np.arange(2), (16, 16), 0)
    assert np.median(form.r) < 1e-6 and form.r.max() > 4e-4


def test_a_claim_is_about_both_bounds() -> None:
    def excess(most: float, plane: float) -> list[float]:
        slope, low, high = np.zeros(1), np.zeros(1), np.ones(1)
        bounds = ClaimedBounds((0.2, most), ((slope, 0.3), (slope, plane)), low, high)
        form = Affine(np.full(1, 0.5), np.full((1, 1), 0.01), np.zeros(1))
        surely, perhaps = bounds.excess(low[None], high[None], form)
        assert (surely <= perhaps).all()
        return perhaps[:, 0].tolist()

    assert max(excess(0.8, 0.7)) <= 0.0
    assert excess(0.505, 0.7)[3] > 0.0 and excess(0.8, 0.505)[2] > 0.0
    # the clamped picture is not below 0
    assert excess(0.8, -0.1)[2] > 0.0


@pytest.mark.parametrize(("low", "high"), [(-0.2, 0.1), (0.4, 0.5), (0.9, 1.4), (1.2, 1.3), (-2.0, -1.0)])
def test_excesses_are_those_of_clamped_pictures(low: float, high: float) -> None:
    """Over a box of one parameter, against values of planes and of pictures at sampled places."""
    rng = np.random.default_rng(2)
    for _ in range(50):
        flat, heights = rng.uniform(-0.2, 1.2, 2).tolist(), rng.uniform(-0.2, 1.2, 2)
        slopes, radius, slope = rng.uniform(-0.3, 0.3, (2, 1)), 0.5 * (high - low), rng.uniform(-0.5, 0.5)
        planes = ((slopes[0], heights[0]), (slopes[1], heights[1]))
        bounds = ClaimedBounds((flat[0], flat[1]), planes, np.array([1.0]), np.array([3.0]))
        c, g, r = 0.5 * (low + high), slope * radius, (1.0 - abs(slope)) * radius
        form = Affine(np.array([c]), np.array([[g]]), np.array([r]))
        surely, perhaps = bounds.excess(np.array([[1.5]]), np.array([[3.0]]), form)
        seen = []
        for s, e in itertools.product((-1, -0.75, 0, 0.5, 1), (-1, 0.25, 1)):
            value = min(
                max(Fraction(c) + Fraction(s) * Fraction(g) + Fraction(e) * Fraction(r), Fraction(0)), Fraction(1)
            )
            # the box's middle is 2.25, half as wide as three quarters of the cell
            p = Fraction(0.25) + Fraction(0.75) * Fraction(s)
            lower, upper = (Fraction(float(h)) + Fraction(float(a[0])) * p for a, h in planes)
            seen.append([lower - value, Fraction(flat[0]) - value, value - upper, value - Fraction(flat[1])])
            assert all(a <= v <= b for a, v, b in zip(surely[:, 0], seen[-1], perhaps[:, 0], strict=True))
        if low > 0.0 and high < 1.0:
            # what is not clamped is enclosed without loss
            values = np.array(seen, np.float64)
            assert np.abs(values.max(axis=0) - perhaps[:, 0]).max() < 1e-12
            assert np.abs(values.min(axis=0) - surely[:, 0]).max() < 1e-12


def test_planes_of_narrow_cells_far_from_zero_are_enclosed() -> None:
    rng = np.random.default_rng(4)
    form = Affine(np.array([0.5]), np.zeros((2, 1)), np.zeros(1))
    for width in (1e-3, 1e-9, 1e-13):
        for _ in range(40):
            low = rng.uniform(1.0, 3.0, 2)
            high, slope, height = low + width, rng.uniform(-1.0, 1.0, 2), float(rng.uniform(0.0, 1.0))
            bounds = ClaimedBounds((-9.0, 9.0), ((slope, height), (slope, height)), low, high)
            pose = low + rng.uniform(0.0, 1.0, 2) * (high - low)
            surely, perhaps = (e[0, 0] for e in bounds.excess(pose[None], pose[None], form))
            parts = [
                Fraction(float(a)) * (2 * Fraction(p) - Fraction(x) - Fraction(y)) / (Fraction(y) - Fraction(x))
                for a, p, x, y in zip(slope, pose.tolist(), low.tolist(), high.tolist(), strict=True)
            ]
            assert surely <= Fraction(height) + sum(parts) - Fraction(0.5) <= perhaps
            assert perhaps - surely < 1e-13 / width + 1e-13


def test_bounds_that_are_the_picture_hold() -> None:
    """Nothing is lost by rounding where nothing moves: the background's bounds may be the background."""
    for value in (0.0, 0.3, 1.0):
        bounds = ClaimedBounds((value, value), ((np.zeros(1), value),) * 2, np.zeros(1), np.ones(1))
        form = Affine(np.full(1, value), np.zeros((1, 1)), np.zeros(1))
        assert bounds.excess(np.zeros((1, 1)), np.ones((1, 1)), form)[1].max() <= 0.0


def test_a_file_with_another_digest_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "frame_00000.npz", lower=np.zeros(3))
    with pytest.raises(BadInput, match="sha256"):
        read_cells(tmp_path, "frame_00000.npz", 0, "0" * 64)


@pytest.mark.parametrize(("writable", "log", "fixed"), [(True, False, 0), (False, False, 1), (False, True, 0)])
def test_cells_in_a_folder_that_cannot_be_written_are_read(
    writable: bool, log: bool, fixed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SQLite would make a file beside the table; what is not in the table yet would be missed without."""
    opened: list[str] = []

    def connect(place: str, uri: bool) -> Any:
        opened.append(place)
        raise OSError

    monkeypatch.setattr(results.os, "access", lambda folder, mode: writable)
    monkeypatch.setattr(results.sqlite3, "connect", connect)
    if log:
        (tmp_path / "cells.sqlite-wal").touch()
    with pytest.raises(BadInput):
        results.read_verdicts(tmp_path, {"frames": []})
    assert opened[0].endswith("cells.sqlite?mode=ro" + fixed * "&immutable=1")


def test_a_frame_that_unpacks_to_half_of_the_memory_is_not_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "frame_00000.npz"
    np.savez_compressed(file, box_lower=np.zeros((1000, 3)))
    assert os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") >= 2 * results._MOST
    monkeypatch.setattr(results, "_MOST", 20_000)
    monkeypatch.setattr(np, "load", lambda *_, **__: pytest.fail("was unpacked"))
    assert file.stat().st_size < 1000
    with pytest.raises(BadInput, match="too large"):
        read_cells(tmp_path, file.name, 0, hashlib.sha256(file.read_bytes()).hexdigest())


@pytest.mark.parametrize("motion", [[1.0, 0.0], [0.0, 1.0], [np.nan, np.inf], [0.0, 0.0]])
def test_parts_of_a_box_are_the_box(motion: list[float]) -> None:
    low, high = np.array([0.1, -0.3]), np.array([0.2, 0.7])
    for d in (1, 2):
        ends = low[:d], high[:d]
        parts = _divided(*ends, np.array(motion[:d]), high[:d] - low[:d])
        bottom, top = (np.stack([part[k] for part in parts]) for k in (0, 1))
        assert len(parts) > 1 and partition(bottom, top, *ends) == 1
    assert len(_divided(low, low, np.array(motion), high - low)) == 1


def test_partitions_are_exact() -> None:
    low, high = np.array([[0.0], [0.1]]), np.array([[0.1], [0.3]])
    first, last = np.array([0.0]), np.array([0.3])
    assert partition(low, high, first, last) == 1
    assert partition(low, np.array([[np.nextafter(0.1, 0)], [0.3]]), first, last) != 1
    assert partition(low, np.array([[np.nextafter(0.1, 1)], [0.3]]), first, last) is None
    assert partition(low[:1], high[:1], first, last) != 1


def test_the_least_part_is_that_of_clopper_and_pearson() -> None:
    # all of n: 0.05^(1/n)
    assert checking.least_part(59, 59) == pytest.approx(0.05 ** (1 / 59), rel=1e-9)
    assert checking.least_part(0, 10) == 0.0
    # tables: 8 of 10, one-sided 95 %
    assert checking.least_part(8, 10) == pytest.approx(0.4931, abs=1e-4)


# ---------------------------------------------------------------- results


@pytest.fixture(scope="module")
def result(blobs: Inputs, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("checked") / "out"
    rendered(blobs.options(folder, frames=[0], time_budget=15, save_cells=True))
    return folder


def rendered(options: list[str]) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "ns_abstract.cli.render", *options],
        capture_output=True, text=True, timeout=600, check=False, env=environment(),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


@pytest.fixture
def copy(result: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(result, tmp_path / "copy"))


def rewrite(folder: Path, change: Callable[[dict[str, np.ndarray]], object], frame: int = 0) -> None:
    """Change a frame file's arrays, its digest and figures, as who forges a result would."""
    file = folder / f"frame_{frame:05d}.npz"
    with np.load(file, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    change(arrays)
    np.savez(file, **arrays)  # pyright: ignore[reportArgumentType]
    gaps = {
        end: np.linalg.norm(arrays[f"{of}upper"] - arrays[f"{of}lower"], axis=-1).astype(np.float64)
        for of, end in (("", ""), ("witness_", "_witness"))
    }
    figures = {
        f"{name}{end}": float(f(gap)) for end, gap in gaps.items() for name, f in (("mpg", np.mean), ("xpg", np.max))
    }
    figures["ratio"] = figures["mpg"] / figures["mpg_witness"]
    report(folder, lambda d: d["frames"][frame].update(figures))
    report(folder, lambda d: d["sha256"].update({file.name: hashlib.sha256(file.read_bytes()).hexdigest()}))


def report(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    file = folder / "report.json"
    document = json.loads(file.read_text())
    change(document)
    file.write_text(json.dumps(document))


@pytest.mark.slow
def test_a_sound_result_is_proved(copy: Path) -> None:
    found = check(copy, claims=30, seconds=200)
    assert (found.claims, found.refuted, found.structure) == (30, 0, [])
    assert found.proved >= 27 and found.exit_code == 0
    assert found.uniform["claims"] == 15 and found.uniform["holds_at_least"] > 0.5
    stored = json.loads((copy / "check.json").read_text())
    assert [stored[name] for name in ("claims", "proved", "refuted", "unsettled", "refutations")] == [
        found.claims, found.proved, found.refuted, found.unsettled, [],
    ]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("version", ["1.4.0", "1.5.3", "1.6.0"])
def test_antialiased_results_of_every_version_are_proved(
    version: str, make_blobs: Callable[..., Inputs], tmp_path: Path
) -> None:
    scene = dataclasses.replace(opaque(blob_scene()), rasterize_mode="antialiased")
    spec = {"version": 1, "translation": {"x": 0.01}, "rotation": {"yaw": 0.005, "roll": [0, 0.01]}}
    inputs = make_blobs(scene=scene, spec=spec)
    more = {"time_budget": 4, "save_cells": True, "gsplat_version": version, "arithmetic": "real"}
    rendered(inputs.options(tmp_path / "out", frames=[1], **more))
    found = check(tmp_path / "out", claims=20, seconds=100)
    assert found.refuted == 0 and found.proved >= 16 and found.exit_code == 0


@pytest.mark.slow
def test_bounds_moved_inward_are_refuted(copy: Path) -> None:
    def inward(a: dict[str, np.ndarray]) -> None:
        # where renders come: beyond them by 2e-3
        wide = a["witness_upper"] - a["witness_lower"] > 0.05
        a["upper"] = np.where(wide, a["witness_upper"] - np.float32(2e-3), a["upper"])
        a["witness_upper"] = np.minimum(a["witness_upper"], a["upper"])

    rewrite(copy, inward)
    found = check(copy, claims=30, seconds=60)
    assert found.refuted > 0 and found.exit_code == 1
    worst = found.refutations[0]
    assert worst["bound"] == "upper" and worst["error"] < 1e-3 and worst["excess"] > worst["error"]


@pytest.mark.slow
@pytest.mark.parametrize("side", ["lower", "upper"])
def test_linear_sets_moved_inward_are_never_proved(copy: Path, side: str) -> None:
    def inward(a: dict[str, np.ndarray]) -> None:
        middle = 0.5 * (a["b_lower"] + a["b_upper"])
        a[f"b_{side}"] = middle + (np.float32(0.003) if side == "lower" else np.float32(-0.003))

    rewrite(copy, inward)
    found = check(copy, claims=20, seconds=40)
    # a picture of the middle of [0, 1] cannot keep to a set without width
    assert found.refuted >= 8
    assert all(entry["bound"] in ("lower", "upper") for entry in found.refutations)


@pytest.mark.slow
def test_cells_that_leave_a_gap_are_refuted(copy: Path, in_process: InProcess) -> None:
    rewrite(copy, lambda a: a["box_lower"].__setitem__((0, 0), np.nextafter(a["box_lower"][0, 0], 1.0)))
    code, out, _ = in_process(check_command.main, [str(copy), "--claims", "4"])
    assert code == 1 and "no partition of the set" in out


@pytest.mark.slow
def test_figures_that_are_not_the_bounds_are_refuted(copy: Path) -> None:
    (frame,) = json.loads((copy / "report.json").read_text())["frames"]
    figures = {name: frame[name] for name in ("mpg", "ratio", "xpg", "xpg_witness")}
    for name, value in figures.items():
        report(copy, lambda d, n=name, v=value: d["frames"][0].update({n: 0.99 * v}))
        wrong = check(copy, claims=2)
        assert wrong.exit_code == 1 and any(text.startswith(f"frame 0: {name} is") for text in wrong.structure)
        report(copy, lambda d, n=name, v=value: d["frames"][0].update({n: v}))
    assert check(copy, claims=2).structure == []
    # another set of poses, and a second entry, which nobody would look at
    sides = [{**side, "lower": 2.0 * side["lower"]} for side in frame["parameters"]]
    report(copy, lambda d: d["frames"][0].update(parameters=sides))
    assert check(copy, claims=2).structure == ["frame 0: the report says another set of poses"]
    report(copy, lambda d: d.update(frames=[frame | {"height": 2 * frame["height"]}]))
    assert check(copy, claims=2).structure == ["frame 0: the report says another size"]
    report(copy, lambda d: d.update(frames=[frame, frame | {"mpg": 0.0, "ratio": 1.0}]))
    assert set(check(copy, claims=2).structure) == {"frame 0: the report has more than one entry of it"}
    report(copy, lambda d: d.update(frames=[frame]))
    # a rendered picture outside of the bounds
    rewrite(copy, lambda a: a["witness_upper"].__setitem__((3, 4, 1), a["upper"][3, 4, 1] + np.float32(0.01)))
    assert "frame 0: a picture that was rendered lies outside of the bounds" in check(copy, claims=2).structure


@pytest.mark.slow
def test_frames_of_which_nothing_is_claimed_are_named(copy: Path, in_process: InProcess) -> None:
    assert check(copy, claims=2).unclaimed == []

    def add(document: dict[str, Any]) -> None:
        (frame,) = document["frames"]
        half = frame | {"index": 1, "trace": [frame["trace"][-1] | {"covered": 0.5}]}
        document["frames"] += [half, {"index": 2, "status": "missing"}]

    report(copy, add)
    code, out, _ = in_process(check_command.main, [str(copy), "--claims", "2"])
    assert code == 0 and "nothing is claimed, and checked, of frames 1, 2" in out
    assert json.loads((copy / "check.json").read_text())["unclaimed"] == [1, 2]


def test_seconds_of_a_claim_are_those_of_settled_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def settled(*arguments: object) -> Iterator[ClaimOutcome]:
        time.sleep(0.1)
        yield ClaimOutcome(True, True, True, {})
        for _ in range(5):
            yield ClaimOutcome(None, False, False, {})

    monkeypatch.setattr(checking, "open_result", lambda folder, moved: ([], [], []))
    monkeypatch.setattr(checking, "settle_claims", settled)
    audit = check(tmp_path, claims=6)
    assert (audit.claims, audit.unsettled) == (6, 5) and audit.median_seconds >= 0.1


@pytest.mark.slow
def test_too_little_time_is_no_success(copy: Path, in_process: InProcess) -> None:
    code, out, _ = in_process(check_command.main, [str(copy), "--claims", "50", "--seconds", "0.001"])
    assert code == 3 and "50 not settled" in out
    assert json.loads((copy / "check.json").read_text())["uniform"]["claims"] == 25


@pytest.mark.slow
def test_claims_past_the_time_are_not_drawn(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """However many they are: drawing one takes time, too."""
    drawn: list[Any] = []

    draw = Picture.draw

    def counted(*given: Any, **more: Any) -> Any:
        drawn.append(given)
        return draw(*given, **more)

    monkeypatch.setattr(Picture, "draw", counted)
    found = check(copy, claims=100_000, seconds=0.5)
    assert len(drawn) < 10_000 and found.claims == 100_000 and found.unsettled >= 90_000 and found.exit_code == 3
    with pytest.raises(InputError, match="claims"):
        check(copy, claims=10**23)


@pytest.mark.parametrize("name", ["x" * 5000, "a\0b"])
def test_names_that_no_file_has_are_one_line(name: str) -> None:
    for options in ({"output_dir": name}, {"output_dir": ".", "model": name}):
        with pytest.raises(InputError, match="cannot be opened"):
            check(**options)


BAD: dict[str, tuple[Callable[[Path], object], str]] = {
    "another file": (lambda f: (f / "frame_00000.npz").write_bytes(b"PK"), "sha256"),
    "forged": (lambda f: report(f, lambda d: d["sha256"].update({"frame_00000.npz": "0" * 64})), "sha256"),
    "no cells": (lambda f: rewrite(f, lambda a: a.pop("box_lower")), "--save-cells"),
    "another type": (lambda f: rewrite(f, lambda a: a.update(lower=a["lower"].astype("f8"))), "lower is not float32"),
    "another shape": (lambda f: rewrite(f, lambda a: a.update(b_lower=a["b_lower"][:-1])), "b_lower is not float32"),
    "not finite": (lambda f: rewrite(f, lambda a: a["A_lower"].fill(np.nan)), "not finite"),
    "another version": (lambda f: report(f, lambda d: d.update(version=2)), "version"),
    "another scene": (lambda f: report(f, lambda d: d["fingerprint"].update(scene="0")), "not the scene"),
    "other Gaussians": (lambda f: report(f, lambda d: d["scene"].update(gaussians=9)), "number of Gaussians"),
    "another mode": (lambda f: report(f, lambda d: d["scene"].update(rasterize_mode="antialiased")), "another mode"),
    "another program": (lambda f: report(f, lambda d: d["renderer"].update(name="paper")), "gsplat and nerf-uniform"),
    "moved run": (lambda f: report(f, lambda d: d["settings"].update(load_config="/nowhere")), "--load-config"),
    "moved path": (
        lambda f: report(f, lambda d: d["settings"].update(camera_path_filename="/nowhere.json")),
        "--camera-path-filename",
    ),
    "no table of cells": (lambda f: (f / "cells.sqlite").touch(), "cannot be read as the cells"),
    "no report": (lambda f: (f / "report.json").unlink(), "ns-abstract-render"),
    "damaged report": (lambda f: (f / "report.json").write_text("{"), "cannot be read"),
    "a report of something else": (lambda f: (f / "report.json").write_text('{"version": 1}'), "settings"),
    "differences": (lambda f: report(f, lambda d: d.update(kind="comparison")), "ns-abstract-compare"),
    "places of a photo": (lambda f: report(f, lambda d: d.update(answer="none")), "ns-abstract-locate"),
    "a report of other types": (lambda f: report(f, lambda d: d.update(frames=3)), "not the report of a result"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_one_line(name: str, copy: Path, in_process: InProcess) -> None:
    damage, words = BAD[name]
    damage(copy)
    code, out, err = in_process(check_command.main, [str(copy), "--claims", "2"])
    assert (code, out, len(err.splitlines())) == (2, "", 1)
    assert words in err and err.startswith("error: ")
    assert not (copy / "check.json").exists()


@pytest.mark.slow
def test_a_pickle_in_a_frame_file_is_not_run(copy: Path, in_process: InProcess, tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> Any:
            return (Path.touch, (tmp_path / "ran",))

    file = copy / "frame_00000.npz"
    with np.load(file, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    np.savez(file, **(arrays | {"tile": np.array([Evil()], object)}), allow_pickle=True)  # pyright: ignore[reportArgumentType]
    report(copy, lambda d: d["sha256"].update({file.name: hashlib.sha256(file.read_bytes()).hexdigest()}))
    code, _, _ = in_process(check_command.main, [str(copy)])
    assert code == 2 and not (tmp_path / "ran").exists()


@pytest.mark.slow
def test_another_set_of_poses_is_refused(copy: Path, blobs: Inputs, tmp_path: Path) -> None:
    other = tmp_path / "spec.json"
    other.write_text(json.dumps({"version": 1, "translation": {"x": 0.02}}))
    with pytest.raises(nsa.InputError, match="another set of poses"):
        check(copy, perturbation=other)
    other.write_text(blobs.spec.read_text())
    assert check(copy, claims=2, perturbation=other, camera_path=blobs.path, load_config=blobs.config).refuted == 0


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    "spec",
    [
        {"translation": {"x": 0.1}, "frame": "world", "rotation": {"roll": [0, 0.02], "pitch": 0.01}},
        {"sweep": "segments", "translation": {"z": [0.01, 0.01]}, "rotation": {"yaw": 1.0}, "angle_units": "degrees"},
        {
            "orbit": {"target": [0, 0, 0], "axis": [1, 2, 3], "azimuth": [0.5, 1.0]},
            "units": "dataset",
            "translation": {"y": 1},
        },
    ],
)
def test_poses_are_those_of_the_perturbation_file(blobs: Inputs, spec: dict[str, Any]) -> None:
    poses, free = read_poses(blobs.path, spec, 0, {}, 0.25)
    path = nsa.load_camera_path(blobs.path)
    theirs = PoseBox.around(path.cameras[0], parse_perturbation(spec, dataset_scale=0.25), path.cameras[1])
    assert free == list(zip(theirs.box.names, theirs.box.lower, theirs.box.upper, strict=True))
    rng = np.random.default_rng(1)
    low, high = (np.array([[e[k] for e in free]]) for k in (1, 2))
    for _ in range(20):
        p = rng.uniform(low, high)
        view = poses.view(p, p)
        expected = theirs.pose(p[0])
        found = np.array([[float(e.c[0]) for e in row] for row in view.rotation])
        assert np.abs(found - (expected[:, :3] * [1.0, -1.0, -1.0]).T).max() < 1e-13
        assert np.abs(view.origin[0] - expected[:, 3]).max() < 1e-13


def test_a_keyframes_camera_is_that_of_the_path(blobs: Inputs) -> None:
    poses, _ = read_poses(blobs.path, {}, 1, {"downscale_factor": 3.0}, 1.0)
    theirs = nsa.load_camera_path(blobs.path, 3.0).cameras[1]
    for name in ("fx", "fy", "cx", "cy", "width", "height"):
        assert getattr(poses.camera, name) == getattr(theirs, name)
