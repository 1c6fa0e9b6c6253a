"""Cells that are proved part by part: shared rows, joined sets, slanted parts, verdicts (design.md, N15, V15)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from flint import fmpq
from onnx_files import OnnxFile, attack, image_sets, members, session
from oracle import rational
from test_certify_search import CLAIM, Ramp, Threshold, drive, volume
from test_poses import SETS, camera, random_rotation
from test_slanted import SHEARS, exact, holds

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.verify.cells import CellGrid
from ns_abstract.verify.network import (
    ImageSets,
    Network,
    SharedCoefficients,
    bound_outputs,
    load_network,
    reusable_anywhere,
)
from ns_abstract.verify.network import shared_coefficients as family_module
from ns_abstract.verify.network.bounds import NetworkBounds
from ns_abstract.verify.network.shared_coefficients import _ReusedBounds, _ReusingCells
from ns_abstract.verify.picture_sets import PictureSets, hull_of_sets
from ns_abstract.verify.properties import Query
from ns_abstract.verify.search import Search
from ns_abstract.verify.sub_box_proof import PixelWeights, SubBoxProof, divisions

SHAPE = (2, 6, 6)


def network(folder: Path, seed: int, local: str = "") -> tuple[Network, Callable[[np.ndarray], np.ndarray]]:
    """Convolutions with a branch, a sum before an activation, two linear layers; a product of two nodes, or maxima."""
    f = OnnxFile(SHAPE, seed)
    f.conv(2, 4, pads=[1, 1, 1, 1], strides=[2, 2])
    one = f.node("Relu")
    before = f.conv(4, 4, pads=[1, 1, 1, 1])
    two = f.node("Relu")
    # what two nodes read has a charge of its own
    f.node("Add", two, before)
    f.node("Add", f.last, one)
    if local == "maximum":
        f.node("MaxPool", kernel_shape=[3, 3], pads=[1, 1, 1, 1])
    f.conv(4, 4, pads=[1, 1, 1, 1])
    three = f.node("Relu")
    f.conv(4, 4, 1)
    four = f.node("Sigmoid")
    f.node("Mul" if local == "product" else "Add", three, four)
    f.node("Flatten")
    f.gemm(36, 8)
    f.node("LeakyRelu", alpha=0.1)
    f.gemm(8, 3)
    file = f.write(folder / "shared.onnx")
    return load_network(file), session(file)


def split(box: ParameterBox, axes: list[int]) -> list[ParameterBox]:
    """The parts of a box that is halved along ``axes``."""
    parts = [box]
    for axis in axes:
        parts = [half for part in parts for half in part.split(axis)]
    return parts


def halved(images: ImageSets) -> ImageSets:
    """A cell in 2^d parts: the same images, in parameters of each part's own."""
    d = images.dimensions
    corners = np.array(np.meshgrid(*[[-0.5, 0.5]] * d)).reshape(d, -1).T
    found = {}
    for side in ("lower", "upper"):
        a, b = getattr(images, f"a_{side}")[0], getattr(images, f"b_{side}")[0]
        found[f"a_{side}"], found[f"b_{side}"] = np.repeat(0.5 * a[None], len(corners), 0), b + corners @ a.T
        found[side] = np.repeat(getattr(images, side), len(corners), 0)
    return ImageSets(**found)


def moved(images: ImageSets, by: float, seed: int) -> ImageSets:
    """Sets as wide about other pictures, with other slopes."""
    rng = np.random.default_rng(seed)
    shift = by * rng.normal(size=images.b_lower.shape)
    turn = by * 0.05 * rng.normal(size=images.a_lower.shape)
    reach = np.abs(turn).sum(-1)
    return ImageSets(
        images.a_lower + turn, images.b_lower + shift, images.a_upper + turn, images.b_upper + shift,
        images.lower + shift - reach, images.upper + shift + reach,
    )  # fmt: skip


def others(images: ImageSets, local: str) -> ImageSets:
    """Parts of a cell, and neighbours nearby and far away where rows serve for these."""
    cells = [halved(images)] if local else [halved(images), *(moved(images, by, 3) for by in (0.02, 0.2, 1.0))]
    fields = ImageSets.__dataclass_fields__
    return ImageSets(*(np.concatenate([getattr(cell, name) for cell in cells]) for name in fields))


@pytest.mark.slow
@pytest.mark.parametrize("local", ["", "product", "maximum", "short"])
@pytest.mark.parametrize("fresh", [False, True])
@pytest.mark.parametrize(("radius", "slack"), [(0.02, 0.02), (0.1, 0.05), (1e-6, 1e-6)])
def test_rows_of_one_cell_hold_for_others(
    radius: float, slack: float, fresh: bool, local: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if local == "short":
        monkeypatch.setattr(family_module, "_MOST_TRACED", 100)
    for seed in range(2):
        net, run = network(tmp_path, seed, local)
        assert reusable_anywhere(net) is not bool(local)
        images = image_sets(SHAPE, 1, 2, radius, slack, seed)
        rows = np.random.default_rng(seed).normal(size=(4, 3))
        family, cells = SharedCoefficients(net, images), others(images, local)
        found = family.others(cells, rows, np.zeros(4), fresh=fresh)
        assert np.isfinite(found.lower).all()
        for cell in range(cells.count):
            least, compared = attack(net, run, cells, cell, rows, 32, 5, seed)
            assert compared > 20
            assert (found.lower[cell] <= least).all()


@pytest.mark.slow
@pytest.mark.parametrize("local", ["", "product", "maximum", "short"])
def test_rows_of_one_cell_hold_every_value(local: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the first cell's rows say of every number, against the exact network on images of each other one."""
    found: dict[int, tuple[_ReusedBounds, np.ndarray]] = {}
    if local == "short":
        monkeypatch.setattr(family_module, "_MOST_TRACED", 100)
    borrowed = _ReusingCells._narrowed

    def watched(self: _ReusingCells, index: int, form: Any) -> Any:
        if index in self.first.stored:
            reference = form.reference.flatten(1).numpy()[:, self.first.stored[index].flat]
            found[index] = self._stored_bounds(index), reference
        return borrowed(self, index, form)

    monkeypatch.setattr(_ReusingCells, "_narrowed", watched)
    for seed in range(2):
        net, _ = network(tmp_path, seed, local)
        images = image_sets(SHAPE, 1, 2, 0.2, 1e-3, seed)
        family, cells = SharedCoefficients(net, images, arithmetic="real"), others(images, local)
        found.clear()
        family.others(cells, np.eye(3), np.zeros(3))
        lent = family._first.stored
        assert len(lent) >= 3 and found.keys() == lent.keys()
        rng = np.random.default_rng(seed)
        for cell in range(cells.count):
            p, t = rng.choice([-1.0, 1.0, 0.3], (160, 2)), rng.uniform(size=(160, net.input_size))
            x, inside = members(cells, cell, p, t)
            assert inside.sum() > 10
            values = [torch.from_numpy(x[inside].astype(np.float64)).reshape(-1, *SHAPE)]
            for node in net.nodes:
                values.append(node.layer([values[k] for k in node.inputs]))
            for index, (said, reference) in found.items():
                number = values[index].flatten(1).numpy()[:, lent[index].flat] - reference[cell]
                assert (number >= said.lower[cell]).all() and (number <= said.upper[cell]).all()
                plane = p[inside] @ said.slopes[cell].T + said.middle[cell]
                assert (np.abs(number - plane) <= said.half[cell]).all()


@pytest.mark.slow
@pytest.mark.parametrize("local", ["", "product", "maximum"])
def test_products_of_rows_are_charged(local: str, tmp_path: Path) -> None:
    """Beside the same sums in float64, for whatever products of float32 lose."""
    net, _ = network(tmp_path, 0, local)
    images = image_sets(SHAPE, 1, 2, 0.3, 1e-4)
    family, cells = SharedCoefficients(net, images, arithmetic="real"), others(images, local)
    other = _ReusingCells(family._first, cells, 1 << 30, "real", False)
    m, off = cells.count, []
    slopes, offsets = (
        other.intermediate.image.slopes.reshape(m, 2, -1, 2),
        other.intermediate.image.offsets.reshape(m, 2, -1),
    )
    for index, lent in family._first.stored.items():
        said = other._stored_bounds(index)
        tilt, noise = np.zeros((m, len(lent.flat), 2)), other.intermediate.flush[:, None]
        low, high = (np.repeat(v[None], m, 0) for v in lent.fixed.T)
        if index in other.intermediate.relaxations[0].noise:
            noise = noise + other.intermediate.relaxations[0].noise[index].reshape(m, -1).numpy()[:, lent.flat]
        for at, rows in lent.by_node.items():
            values = rows.astype(np.float64)
            one, two = np.maximum(values, 0.0), np.minimum(values, 0.0)
            if at == 0:
                tilt = tilt + values @ slopes.mean(1)
                middle = offsets.mean(1)
                half = 0.5 * (offsets[:, 1] - offsets[:, 0]) + 0.5 * np.abs(slopes[:, 1] - slopes[:, 0]).sum(-1)
                low = low + middle @ values.T - half @ np.abs(values).T
                high = high + middle @ values.T + half @ np.abs(values).T
            elif at in other.intermediate.reused_relaxations:
                offered = other.intermediate.reused_relaxations[at]
                _, below, above, _, top, bottom = offered.lines.reshape(6, m, -1).astype(np.float64)
                tilt = tilt + one @ np.moveaxis(offered.tilts[0], 1, 2) + two @ np.moveaxis(offered.tilts[1], 1, 2)
                low, high = low + below @ one.T + top @ two.T, high + above @ one.T + bottom @ two.T
            else:
                noise = noise + other.intermediate.relaxations[0].noise[at].reshape(m, -1).numpy() @ np.abs(values).T
        charged = said.half - 0.5 * (high - low) - noise
        for p in ((1.0, 1.0), (-1.0, 1.0), (0.0, 0.0)):
            exactly = (tilt @ p + 0.5 * (low + high)) * lent.sign
            found = np.abs(exactly - said.slopes @ p - said.middle)
            assert (found <= charged).all()
            off.append(found.max())
    assert max(off) > 0.0


@pytest.mark.slow
def test_parts_have_the_references_and_winners_of_the_whole(tmp_path: Path) -> None:
    """What rows gathered at maxima is relative to them; by themselves parts would follow others."""
    net, _ = network(tmp_path, 0, "maximum")
    images = image_sets(SHAPE, 1, 2, 2.0, 1e-3)
    family, parts = SharedCoefficients(net, images, arithmetic="real"), halved(images)
    part = _ReusingCells(family._first, parts, 1 << 30, "real", False)
    alone = NetworkBounds(net, parts, 1 << 30, "real")
    (at,) = family._first.intermediate.relaxations[0].maxima
    assert (
        part.intermediate.relaxations[0].maxima[at].winner
        == family._first.intermediate.relaxations[0].maxima[at].winner
    ).all()
    assert (
        alone.intermediate.relaxations[0].maxima[at].winner
        != family._first.intermediate.relaxations[0].maxima[at].winner
    ).any()
    found, whole = part.cells.last.reference, family._first.cells.last.reference
    assert torch.equal(found, whole.expand_as(found))


def test_rounding_is_charged_by_all_parts_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At least what each by itself is charged with, and of neighbours hardly more than the one with most."""
    net, _ = network(tmp_path, 0)
    images = image_sets(SHAPE, 1, 2, 0.3, 1e-3)
    family, cells = SharedCoefficients(net, images), halved(images)
    together = _ReusingCells(family._first, cells, 1 << 30, "float32", False)
    monkeypatch.setattr(_ReusingCells, "rounding_form", lambda self, form: form)
    alone = _ReusingCells(family._first, cells, 1 << 30, "float32", False)
    charged, singly = together.intermediate.relaxations[0].noise, alone.intermediate.relaxations[0].noise
    assert len(charged) > 3
    for k, noise in charged.items():
        each = singly[k]
        assert (noise != each).any()
        # what rounding leaves is read again, further on
        assert (noise >= (1.0 - 1e-5) * each).all()
        assert noise[0].sum() < 1.2 * each.amax(0).sum()
    assert (together.intermediate.flush >= (1.0 - 1e-5) * alone.intermediate.flush).all()


@pytest.mark.slow
def test_rows_of_a_cell_say_as_much_of_it_as_its_bounds(tmp_path: Path) -> None:
    """Of itself nothing is lost but rounding; of neighbours not much."""
    near = []
    for seed in range(4):
        net, _ = network(tmp_path, seed)
        images = image_sets(SHAPE, 1, 2, 0.1, 0.02, seed)
        rows, offset = np.random.default_rng(seed).normal(size=(4, 3)), np.zeros(4)
        family = SharedCoefficients(net, images)
        first = family.first(rows, offset).lower
        assert (first >= bound_outputs(net, images, rows, offset).lower - 1e-6).all()
        mine = family.others(images, rows, offset).lower
        middle = images.b_lower + 0.5 * (images.b_upper - images.b_lower)
        value = net(torch.from_numpy(middle.reshape(1, *SHAPE))).numpy() @ rows.T
        assert (first - mine).max() <= 0.06 * (value - first).max()
        cells = moved(images, 0.02, 3)
        alone = bound_outputs(net, cells, rows, offset).lower
        lent, fresh = (family.others(cells, rows, offset, fresh=own).lower for own in (False, True))
        away = net(torch.from_numpy((middle + cells.b_lower - images.b_lower).reshape(1, *SHAPE))).numpy() @ rows.T
        near.append([np.mean(away - v) / np.mean(away - alone) for v in (lent, fresh)])
    assert np.mean(near, axis=0)[0] < 1.5 and np.mean(near, axis=0)[1] < 1.4


@pytest.mark.slow
@pytest.mark.parametrize("local", ["product", "maximum"])
def test_rows_of_a_whole_serve_its_parts_behind_products_and_maxima(local: str, tmp_path: Path) -> None:
    gains = []
    for seed in range(2):
        net, _ = network(tmp_path, seed, local)
        images = image_sets(SHAPE, 1, 2, 0.1, 0.02, seed)
        rows, offset = np.random.default_rng(seed).normal(size=(4, 3)), np.zeros(4)
        family, parts = SharedCoefficients(net, images), halved(images)
        whole = family.first(rows, offset).lower
        alone = bound_outputs(net, parts, rows, offset).lower
        gains.append(np.mean(family.others(parts, rows, offset).lower - whole) / np.mean(alone - whole))
    assert np.mean(gains) > 0.5


def test_a_cell_without_bounds_helps_nothing(tmp_path: Path) -> None:
    net, _ = network(tmp_path, 0)
    images = image_sets(SHAPE, 1, 2, 0.1, 0.02)
    broken = replace(images, b_upper=np.full_like(images.b_upper, np.nan))
    rows, offset = np.eye(3), np.zeros(3)
    family, parts = SharedCoefficients(net, broken), halved(images)
    assert (family.first(rows, offset).lower == -np.inf).all()
    assert np.array_equal(family.others(parts, rows, offset).lower, bound_outputs(net, parts, rows, offset).lower)


@pytest.mark.slow
def test_rows_that_take_too_much_memory_are_not_kept(tmp_path: Path) -> None:
    """What is not known is not used, and bounds hold."""
    net, run = network(tmp_path, 0)
    images = image_sets(SHAPE, 1, 2, 0.1, 0.05)
    rows = np.eye(3)
    family = SharedCoefficients(net, images, memory=1 << 17)
    assert len(family._first.stored) < len(SharedCoefficients(net, images)._first.stored)
    found = family.others(moved(images, 0.02, 3), rows, np.zeros(3))
    least, _ = attack(net, run, moved(images, 0.02, 3), 0, rows, 32, 5)
    assert (found.lower[0] <= least).all()


# ---------------------------------------------------------------- joined sets


def random_sets(box: ParameterBox, rng: np.random.Generator) -> PictureSets:
    d = box.dimensions
    a, apart = rng.normal(size=(2, 3, 3, d)), 0.1 * rng.normal(size=(2, 3, 3, d))
    b, wide = rng.normal(size=(2, 3, 3)), np.abs(apart).sum(-1) + rng.uniform(0.0, 0.2, (2, 3, 3))
    reach = np.abs(a).sum(-1) + np.abs(apart).sum(-1) + wide
    return PictureSets(box, (a - apart, b - wide, a + apart, b + wide), b - reach, b + reach)


@pytest.mark.parametrize("offset", [0.0, 0.7, 3e5])
def test_joined_sets_hold_every_part(offset: float) -> None:
    """At exact corners of every part, in exact arithmetic."""
    names, rng = ("x", "y", "z"), np.random.default_rng(5)
    whole = ParameterBox(names, ("m",) * 3, (offset - 0.1,) * 3, (offset + 0.2, offset + 0.1, offset + 0.3))
    boxes = split(whole, [0, 2, 1])
    # slanted parts leave something out
    boxes[3] = boxes[3].replace(1, boxes[3].lower[1], boxes[3].middle[1])
    parts = [random_sets(box, rng) for box in boxes]
    found = hull_of_sets(parts)
    assert found.sane
    wide = found.box
    for part in parts:
        box = part.box
        assert (found.lower <= part.lower).all() and (found.upper >= part.upper).all()
        for corner in box.corners():
            q = [_scaled(v, low, high) for v, low, high in zip(corner, box.lower, box.upper, strict=True)]
            p = [_scaled(v, low, high) for v, low, high in zip(corner, wide.lower, wide.upper, strict=True)]
            for at in np.ndindex(2, 3, 3):
                for side, sign in ((0, 1), (2, -1)):
                    inner = _plane(part.linear, side, at, q)
                    assert sign * (inner - _plane(found.linear, side, at, p)) >= 0


def _scaled(value: float, low: float, high: float) -> fmpq:
    """A parameter as a form has it: the middle and the half of a box are floats."""
    middle = 0.5 * (low + high)
    half = max(high - middle, middle - low) * (1.0 + 2.0**-51)
    return (rational(value) - rational(middle)) / rational(half)


def _plane(linear: tuple[np.ndarray, ...], side: int, at: tuple[int, ...], p: list[fmpq]) -> fmpq:
    slopes = linear[side][at]
    return rational(float(linear[side + 1][at])) + sum(
        (rational(float(s)) * v for s, v in zip(slopes, p, strict=True)), fmpq(0)
    )


def test_joined_sets_of_what_is_linear_are_as_narrow() -> None:
    box = ParameterBox(("x", "y"), ("m",) * 2, (-1.0, -1.0), (1.0, 1.0))
    parts = [_ramp_sets(Ramp(2), part) for part in split(box, [0, 1, 0])]
    found = hull_of_sets(parts)
    assert np.allclose(found.widths, 2e-3, atol=1e-9)
    assert np.allclose(found.linear[0], [0.2, 0.1], atol=1e-9)


def _ramp_sets(scene: Ramp, box: ParameterBox) -> PictureSets:
    linear, lower, upper, _ = scene.linear_sets(box)
    return PictureSets(box, linear, lower, upper)


# ---------------------------------------------------------------- slanted parts


@pytest.mark.parametrize("name", SHEARS)
def test_poses_of_a_cell_are_in_its_slanted_parts(name: str) -> None:
    plain = PoseBox.around(camera(random_rotation(1)), SETS[name])
    cell = plain.box
    for axis in range(cell.dimensions):
        cell = cell.split(axis, 4)[1 + axis % 2]
    poses = plain.within(cell).sheared(SHEARS[name])
    parts = [box for part in split(poses.box, [0, 1, cell.dimensions - 1]) if (box := poses.feasible(part)) is not None]
    rng = np.random.default_rng(2)
    for weights in [*rng.choice([0.0, 1.0], (20, cell.dimensions)), *rng.uniform(0.0, 1.0, (20, cell.dimensions))]:
        values = {
            name: rational(low) + rational(float(w)) * (rational(high) - rational(low))
            for name, low, high, w in zip(cell.names, cell.lower, cell.upper, weights, strict=True)
        }
        assert any(holds(part, exact(poses, values)) for part in parts)


def test_divisions_aim_at_what_parts_may_cost() -> None:
    effects = np.array([4.0, 1.0, 0.0])
    counts = divisions(effects, 0.24 * 4.0**1.6, 0.24, 1 << 20)
    assert (effects / counts).sum() <= 0.25 * effects.sum() and counts[0] > counts[1] and counts[2] == 1
    assert math.prod(counts) <= 12
    assert divisions(effects, 0.1, 0.24, 16) == [1, 1, 1]
    assert 16 < math.prod(divisions(effects, 1e9, 0.24, 16)) <= 32


# ---------------------------------------------------------------- verdicts


class Rounded(Threshold):
    """A network whose bounds lose ``loss`` times, and then once, what the sets leave open, and that can be shared."""

    loss = 9.0

    def __init__(self, threshold: float, lends_anywhere: bool = True) -> None:
        super().__init__(threshold)
        self.reusable_anywhere = lends_anywhere
        self.asked: list[tuple[str, int]] = []

    def bound(self, images: ImageSets, query: Query) -> Any:
        self.asked.append(("alone", images.count))
        return self._lost(images, query)

    def _lost(self, images: ImageSets, query: Query) -> Any:
        found = super().bound(images, query)
        gap = (images.b_upper - images.b_lower + np.abs(images.a_upper - images.a_lower).sum(-1)).mean(1)[:, None]
        return replace(found, lower=found.lower - self.loss * gap, b=found.b - self.loss * gap)

    def shared_bounds(self, images: ImageSets) -> Any:
        return Shared(self, images)


class Shared:
    def __init__(self, model: Rounded, images: ImageSets) -> None:
        self.model, self.images = model, images

    def first(self, query: Query) -> Any:
        self.model.asked.append(("first", 1))
        return self.model._lost(self.images, query)

    def others(self, images: ImageSets, query: Query, *, fresh: bool = False) -> Any:
        self.model.asked.append(("fresh" if fresh else "others", images.count))
        return self.model._lost(images, query)


class Curved(Ramp):
    """Pictures of brightness ``0.5 + 0.2 x + 0.1 y``; sets are loose by the square of the width."""

    def linear_sets(self, box: ParameterBox) -> Any:
        half = 0.5 * (np.array(box.upper) - np.array(box.lower))
        self.slack = 0.05 * float(half.max()) ** 2
        return super().linear_sets(box)


#: A gradient that is the same at every pixel, and a margin.
EVEN = PixelWeights(np.full((2, 2, 3), 0.5 / 12.0), 0.4)


def covered(threshold: float, lends_anywhere: bool = True, **settings: Any) -> tuple[Search, Rounded]:
    scene, model = Curved(2), Rounded(threshold, lends_anywhere)
    pictures: Any = scene
    cover = SubBoxProof(pictures, model, model, CLAIM, **settings)
    return Search(pictures, model, CLAIM, CellGrid.adaptive(scene.box, (2, 2)), cover=cover), model


@pytest.mark.slow_cases
@pytest.mark.parametrize("lends_anywhere", [False, True])
@pytest.mark.parametrize("threshold", [0.1, 0.31, 0.43])
def test_verdicts_of_covered_cells_are_the_truth(threshold: float, lends_anywhere: bool) -> None:
    search, model = covered(threshold, lends_anywhere)
    leaves, _ = drive(search, 150)
    scene = Curved(2)
    assert {kind for kind, _ in model.asked} >= {"first"}
    for leaf in leaves:
        ends = [float(0.5 + scene.gains @ c) - threshold for c in search.grid.box_of(leaf.cell).corners()]
        if leaf.verdict == "certified":
            assert min(ends) > 0.0 and leaf.margin is not None and 0.0 < leaf.margin <= min(ends) + 1e-9
        if leaf.verdict == "falsified":
            assert min(ends) <= 1e-7
    if threshold == 0.1:
        assert volume(leaves, "certified") == search.grid.volume


def test_what_width_costs_is_found_about_the_middle() -> None:
    """Networks that bear wide sets have wide parts; the figure does not depend on cells."""
    found = []
    for loss in (30.0, 9.0, 0.1):
        search, model = covered(0.1)
        model.loss = loss
        assert search.cover is not None
        again = replace(search.cover)
        search.cover.prove(search.grid.box_of(search.grid.roots()[-1]), np.array([0.5, 0.1]), EVEN)
        assert search.cover.opening == again.opening
        found.append(again.opening)
    assert found[0] == 42.0 > found[1] > 2.0 * found[2]
    # nothing is proved at the middle
    cover = covered(0.6)[0].cover
    assert cover is not None and cover.opening == 42.0


class Wider(Curved):
    """The same pictures, known half as well."""

    def linear_sets(self, box: ParameterBox) -> Any:
        linear, lower, upper, slopes = super().linear_sets(box)
        (a_lower, b_lower, a_upper, b_upper), room = linear, 0.5 * (upper - lower)
        return (a_lower, b_lower - room, a_upper, b_upper + room), lower - room, upper + room, slopes


@pytest.mark.parametrize("first_is_wider", [False, True])
def test_the_way_with_fewer_parts_is_taken(first_is_wider: bool) -> None:
    """Whichever is asked, cells are proved by the same parts; the choice does not depend on cells."""
    found = []
    for wider in (first_is_wider, not first_is_wider):
        model = Rounded(0.1, True)
        scenes: list[Any] = [Curved(2), Wider(2)]
        first, second = scenes[::-1] if wider else scenes
        cover = SubBoxProof(first, model, model, CLAIM, other=SubBoxProof(second, model, model, CLAIM))
        assert cover.other is not None and (cover.parts > cover.other.parts) is wider
        search = Search(first, model, CLAIM, CellGrid.adaptive(first.box, (2, 2)), cover=cover)
        cell = search.grid.box_of(search.grid.roots()[-1])
        found.append(cover.prove(cell, np.array([0.5, 0.1]), EVEN))
        assert found[-1] == replace(cover, other=None, scene=scenes[0]).prove(cell, np.array([0.5, 0.1]), EVEN)
    assert found[0] == found[1]


def test_one_part_without_a_proof_leaves_the_cell_without() -> None:
    """Whatever bounds say of the other parts."""
    search, _ = covered(0.1, most_parts=64)
    cell = search.grid.box_of(search.grid.roots()[0])
    weights = EVEN
    assert search.cover is not None
    good = search.cover.prove(cell, np.array([0.5, 0.1]), weights)
    assert good.margin is not None and good.margin > 0.0

    class Hole(Curved):
        def linear_sets(self, box: ParameterBox) -> Any:
            linear, lower, upper, slopes = super().linear_sets(box)
            if box.contains(np.array([-0.37, -0.61])):
                linear = (*linear[:1], linear[1] - 0.6, *linear[2:])
                lower = lower - 0.6
            return linear, lower, upper, slopes

    scene = Hole(2)
    holed = replace(search.cover, scene=scene, most_parts=1 << 12).prove(cell, np.array([0.5, 0.1]), weights)
    assert holed.margin is None and math.prod(holed.cuts) > 1


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_bad_bounds_of_parts_certify_nothing(bad: float) -> None:
    search, _ = covered(0.1)
    cell = search.grid.box_of(search.grid.roots()[0])
    weights = EVEN

    class Bad(Curved):
        def linear_sets(self, box: ParameterBox) -> Any:
            linear, lower, upper, slopes = super().linear_sets(box)
            if box.contains(np.array([-0.37, -0.61])):
                upper = np.full_like(upper, bad)
            return linear, lower, upper, slopes

    assert search.cover is not None
    assert replace(search.cover, scene=Bad(2)).prove(cell, np.array([0.5, 0.1]), weights).margin is None


def test_cells_that_take_too_many_parts_are_cut_where_that_helps() -> None:
    """A cut of what needs no cut leaves as many parts to be bounded."""
    search, _ = covered(0.1, most_parts=4)
    assert search.cover is not None
    box = search.grid.box
    weights = PixelWeights(np.full((2, 2, 3), 20.0 / 12.0), 0.4)
    found = search.cover.prove(box, np.array([0.5, 0.1]), weights)
    assert found.margin is None and found.parts == 0
    assert found.cuts[0] > found.cuts[1] >= 1
