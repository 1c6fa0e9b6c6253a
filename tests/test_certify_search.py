"""The search on stand-in scenes and networks whose truth is known: right verdicts, no other way to be certified."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.io.errors import InputError
from ns_abstract.verify.cells import HALVINGS, Cell, CellGrid, initial_divisions
from ns_abstract.verify.network import ImageSets, OutputBounds
from ns_abstract.verify.properties import LinearClaim, Query
from ns_abstract.verify.search import BLOCK, Search
from ns_abstract.verify.search_results import BlockResult, ContradictionError, FinishedCell
from ns_abstract.verify.store import CellBlock, Store, fractions

CLAIM = LinearClaim(np.array([[1.0, -1.0]]), np.zeros(1), ((0,),))
FINGERPRINT = {"scene": "a", "rules": 1}


def interval(d: int = 1) -> ParameterBox:
    names = ("x", "y", "z")[:d]
    return ParameterBox(names, ("m",) * d, (-1.0,) * d, (1.0,) * d)


class Ramp:
    """Pictures whose brightness is ``0.5 + 0.2 x`` (plus ``0.1 y``): linear sets are exact up to ``slack``."""

    def __init__(self, d: int = 1, slack: float = 1e-3) -> None:
        self.box, self.slack = interval(d), slack
        self.gains = np.array([0.2, 0.1, 0.05])[:d]
        self.bounded = 0

    def image(self, values: np.ndarray) -> np.ndarray:
        return np.full((2, 2, 3), 0.5 + self.gains @ values, np.float32)

    def linear_sets(self, box: ParameterBox) -> Any:
        self.bounded += 1
        half = 0.5 * (np.array(box.upper) - np.array(box.lower))
        a = np.broadcast_to(self.gains * half, (2, 2, 3, len(half)))
        b = np.full((2, 2, 3), 0.5 + self.gains @ box.middle)
        reach = np.abs(a).sum(-1) + self.slack
        return (a, b - self.slack, a, b + self.slack), b - reach, b + reach, self.gains * half

    def differentiable(self, values: torch.Tensor) -> torch.Tensor:
        return (0.5 + (torch.from_numpy(self.gains) * values).sum()).expand(2, 2, 3)

    def scene_samples(self, seed: int) -> Iterator[Any]:
        return iter(())


class Threshold:
    """``y = (brightness, threshold)``: the property holds where the picture is brighter."""

    def __init__(self, threshold: float) -> None:
        self.threshold = threshold

    def outputs(self, images: np.ndarray) -> np.ndarray:
        bright = images.reshape(len(images), -1).astype(np.float64).mean(1)
        return np.stack([bright, np.full_like(bright, self.threshold)], 1)

    def differentiable(self, images: torch.Tensor) -> torch.Tensor:
        bright = images.reshape(len(images), -1).mean(1)
        return torch.stack([bright, torch.full_like(bright, self.threshold)], 1)

    def input_sets(self, linear: tuple[np.ndarray, ...], lower: np.ndarray, upper: np.ndarray) -> ImageSets:
        m, d = len(lower), linear[0].shape[-1]
        return ImageSets(
            *(v.reshape(m, 12, d) if k % 2 == 0 else v.reshape(m, -1) for k, v in enumerate(linear)),
            lower.reshape(m, -1), upper.reshape(m, -1),
        )  # fmt: skip

    def bound(self, images: ImageSets, query: Query) -> OutputBounds:
        a, b = images.a_lower.mean(1)[:, None], images.b_lower.mean(1)[:, None] - self.threshold
        return OutputBounds(b - np.abs(a).sum(-1), a, b)

    def branch(self, images: ImageSets, query: Query, groups: Any, most: int) -> float:
        return -np.inf


def drive(search: Search, limit: int = 100_000, shuffle: int | None = None) -> tuple[list[FinishedCell], int]:
    """Examine all blocks, in order or at random; leaves by cell, and the number of blocks."""
    roots = search.grid.roots()
    blocks = [tuple(roots[i : i + BLOCK]) for i in range(0, len(roots), BLOCK)]
    rng = np.random.default_rng(shuffle)
    leaves: list[FinishedCell] = []
    count = 0
    while blocks and count < limit:
        block = blocks.pop(0 if shuffle is None else int(rng.integers(len(blocks))))
        found = search.examine(block)
        leaves += found.leaves
        blocks += found.blocks
        count += 1
    return sorted(leaves, key=lambda leaf: leaf.cell.first), count


def volume(leaves: list[FinishedCell], verdict: str | None = None) -> int:
    return sum(leaf.cell.volume for leaf in leaves if verdict in (None, leaf.verdict))


def overlapping(leaves: list[FinishedCell]) -> bool:
    """Whether any two cells share a part."""
    first, past = (np.array([getattr(leaf.cell, end) for leaf in leaves]) for end in ("first", "past"))
    shared = (np.minimum(past[:, None], past) > np.maximum(first[:, None], first)).all(axis=2)
    return bool(shared.sum() > len(leaves))


def search_of(scene: Any = None, model: Any = None, coarse: tuple[int, ...] = (5,), **more: Any) -> Search:
    scene = scene or Ramp()
    return Search(scene, model or Threshold(0.43), CLAIM, CellGrid.adaptive(scene.box, coarse), **more)


def same(first: list[FinishedCell], second: list[FinishedCell]) -> None:
    assert [(x.cell, x.verdict, x.margin, x.counterexample) for x in first] == [
        (x.cell, x.verdict, x.margin, x.counterexample) for x in second
    ]


# ---------------------------------------------------------------- right verdicts


@pytest.mark.slow_cases
@pytest.mark.parametrize("threshold", [0.0, 0.31, 0.43, 0.5, 0.6, 1.0])
@pytest.mark.parametrize("d", [1, 2])
def test_verdicts_are_the_truth(threshold: float, d: int) -> None:
    """The counterexample's place is known: x <= (threshold - 0.5) / 0.2."""
    scene = Ramp(d)
    search = search_of(scene, Threshold(threshold), (5, 3)[:d])
    leaves, _ = drive(search, 3000 if d == 1 else 600)
    for leaf in leaves:
        box = search.grid.box_of(leaf.cell)
        ends = [float(0.5 + scene.gains @ corner) - threshold for corner in box.corners()]
        if leaf.verdict == "certified":
            assert min(ends) > 0.0 and 0.0 < leaf.margin <= min(ends) + 1e-12
        if leaf.verdict == "falsified":
            assert leaf.counterexample is not None and box.contains(np.array(leaf.counterexample))
            assert float(0.5 + scene.gains @ np.array(leaf.counterexample)) <= threshold + 1e-7
            assert leaf.image is not None and leaf.outputs is not None and min(ends) <= 1e-7
    whole = search.grid.volume
    if d == 1:
        assert volume(leaves) == whole
        true = min(1.0, max(0.0, (1.0 - (threshold - 0.5) / 0.2) / 2.0))
        assert volume(leaves, "certified") / whole == pytest.approx(true, abs=0.01)
        assert volume(leaves, "unknown") / whole < 0.01
    else:
        assert not overlapping(leaves)
        x = np.linspace(-1.0, 1.0, 2001)
        true = float((0.5 + 0.2 * x[:, None] + 0.1 * x > threshold).mean())
        # what is still open lies along the line where the property begins to hold
        assert true - 0.02 <= volume(leaves, "certified") / whole <= true + 1e-3
        assert 1.0 - true - 0.02 <= volume(leaves, "falsified") / whole <= 1.0 - true + 0.02
        assert volume(leaves, "unknown") / whole < 1e-3


def test_cells_of_cheap_models_fail_as_a_whole_only_after_a_second_look() -> None:
    """The middle and two corners fail, another corner does not: the cell is cut."""
    scene = Ramp(2)
    scene.gains = np.array([0.2, -0.2])
    search = search_of(scene, Threshold(0.52), (1, 1), costly=False)
    first = search.examine(search.grid.roots())
    assert not first.leaves and first.blocks
    leaves, _ = drive(search, 60)
    for leaf in leaves:
        ends = [float(0.5 + scene.gains @ corner) - 0.52 for corner in search.grid.box_of(leaf.cell).corners()]
        assert leaf.verdict != "certified" or min(ends) > 0.0
        assert leaf.verdict != "falsified" or min(ends) <= 1e-7
    assert not overlapping(leaves)
    # x - y > 0.1 on this part of the square
    true, whole = 1.9**2 / 8.0, search.grid.volume
    assert 0.35 < volume(leaves, "certified") / whole <= true
    assert 0.53 < volume(leaves, "falsified") / whole < 1.0 - true + 0.01


class Peak(Ramp):
    """Pictures whose brightness is greatest at one x, and is bounded by numbers alone."""

    def image(self, values: np.ndarray) -> np.ndarray:
        return np.full((2, 2, 3), 0.5 - 0.2 * abs(values[0] - 0.35), np.float32)

    def linear_sets(self, box: ParameterBox) -> Any:
        ends = [abs(end[0] - 0.35) for end in (box.lower, box.upper)]
        nearest = 0.0 if box.lower[0] <= 0.35 <= box.upper[0] else min(ends)
        a = np.zeros((2, 2, 3, 1))
        low, high = (np.full((2, 2, 3), 0.5 - 0.2 * reach) for reach in (max(ends), nearest))
        return (a, low - self.slack, a, high + self.slack), low - self.slack, high + self.slack, np.array([0.2])


@pytest.mark.parametrize("costly", [False, True])
def test_a_wide_cell_fails_as_a_whole_only_after_many_looks(costly: bool) -> None:
    """The property holds on a 25th of the set, where no corner nor middle of the whole set lies."""
    search = search_of(Peak(slack=1e-5), Threshold(0.492), (1,), costly=costly)
    leaves, _ = drive(search, 200)
    assert 0.03 < volume(leaves, "certified") / search.grid.volume < 0.041
    assert not overlapping(leaves)


class Compared(Ramp):
    """A ramp whose bounds say that cuts along y alone help."""

    def cut_gains(self, box: ParameterBox) -> np.ndarray:
        return np.array([0.0, 1.0])


def test_cells_are_cut_where_bounds_narrow_most() -> None:
    """Bounds of narrower cells tell where to cut, and not slopes, if the pictures have them."""
    for scene, axis in ((Ramp(2), 0), (Compared(2), 1)):
        search = search_of(scene, Threshold(0.55), (1, 1), costly=False)
        (root,) = search.grid.roots()
        cells = [cell for block in search.examine([root]).blocks for cell in block]
        assert cells
        lengths = [[cell.past[k] - cell.first[k] for cell in cells] for k in range(2)]
        shares = [max(lengths[k]) / (root.past[k] - root.first[k]) for k in range(2)]
        assert shares[axis] < 1.0 and shares[axis] <= shares[1 - axis]
        assert axis == 0 or shares[0] == 1.0


def test_order_of_blocks_does_not_matter() -> None:
    first, count = drive(search_of())
    for seed in range(3):
        again, blocks = drive(search_of(), shuffle=seed)
        same(first, again)
        assert blocks == count


def test_cells_share_ends_and_cover_the_set() -> None:
    search = search_of()
    leaves, _ = drive(search)
    boxes = [search.grid.box_of(leaf.cell) for leaf in leaves]
    assert boxes[0].lower == search.grid.box.lower and boxes[-1].upper == search.grid.box.upper
    for left, right in itertools.pairwise(boxes):
        assert left.upper == right.lower


def test_single_pose() -> None:
    """A set without parameters has one cell."""

    class Still(Ramp):
        def __init__(self) -> None:
            super().__init__()
            self.box = ParameterBox((), (), (), ())
            self.gains = np.zeros(0)

    for threshold, verdict in ((0.4, "certified"), (0.6, "falsified"), (0.4999, "unknown")):
        search = search_of(Still(), Threshold(threshold), ())
        leaves, blocks = drive(search)
        assert [leaf.verdict for leaf in leaves] == [verdict] and blocks == 1
        assert leaves[0].counterexample == (() if verdict == "falsified" else None)
        assert search.grid.volume == 1


def test_gradient_finds_what_samples_miss() -> None:
    """A small dark spot inside a cell of two parameters, where neither middle nor corners nor random poses look."""
    spot = np.array([0.83, -0.62])

    class Spot(Ramp):
        def image(self, values: np.ndarray) -> np.ndarray:
            return np.full((2, 2, 3), 0.2 + 0.1 * np.sum((values - spot) ** 2), np.float32)

        def differentiable(self, values: torch.Tensor) -> torch.Tensor:
            return (0.2 + 0.1 * ((values - torch.from_numpy(spot)) ** 2).sum()).expand(2, 2, 3)

        def linear_sets(self, box: ParameterBox) -> Any:
            raise ValueError("no bounds")

    search = Search(Spot(2), Threshold(0.2004), CLAIM, CellGrid(interval(2), (1, 1), (1, 1)))
    leaves, _ = drive(search)
    assert [leaf.verdict for leaf in leaves] == ["falsified"]
    assert np.linalg.norm(np.array(leaves[0].counterexample) - spot) < 0.07


# ---------------------------------------------------------------- no other way to be certified


def spoilt(change: Callable[[Any], Any]) -> type[Ramp]:
    class Spoilt(Ramp):
        def linear_sets(self, box: ParameterBox) -> Any:
            return change(super().linear_sets(box))

    return Spoilt


def fail(*_: Any) -> Any:
    raise RuntimeError("planted")


SPOILT_IMAGES: dict[str, Callable[[Any], Any]] = {
    "NaN slope": lambda s: ((s[0][0] * np.nan, *s[0][1:]), *s[1:]),
    "NaN offset": lambda s: ((s[0][0], s[0][1] * np.nan, *s[0][2:]), *s[1:]),
    "infinite offset": lambda s: ((s[0][0], s[0][1] + np.inf, *s[0][2:]), *s[1:]),
    "NaN bound": lambda s: (s[0], s[1] * np.nan, *s[2:]),
    "infinite bound": lambda s: (s[0], s[1] + np.inf, s[2] + np.inf, s[3]),
    "crossed": lambda s: (s[0], s[2] + 0.1, s[1], s[3]),
    "exception": fail,
}


@pytest.mark.parametrize("name", SPOILT_IMAGES)
def test_bad_image_bounds_certify_nothing(name: str) -> None:
    scene = spoilt(SPOILT_IMAGES[name])()
    search = Search(scene, Threshold(0.1), CLAIM, CellGrid(scene.box, (8,), (2,)))
    leaves, _ = drive(search)
    assert {leaf.verdict for leaf in leaves} == {"unknown"}
    # told as what it is: the network is not even asked
    why = "RuntimeError: planted" if name == "exception" else "the image's bounds are not finite or cross"
    assert volume(leaves) == 8 and {leaf.reason for leaf in leaves} == {why}


SPOILT_BOUNDS: dict[str, Callable[[OutputBounds], OutputBounds]] = {
    "NaN": lambda b: OutputBounds(b.lower * np.nan, b.a * np.nan, b.b * np.nan),
    "infinity": lambda b: OutputBounds(b.lower + np.inf, b.a, b.b + np.inf),
    "minus infinity": lambda b: OutputBounds(b.lower - np.inf, b.a, b.b - np.inf),
    "exception": fail,
}


@pytest.mark.parametrize("name", SPOILT_BOUNDS)
def test_bad_network_bounds_certify_nothing(name: str) -> None:
    class Spoilt(Threshold):
        def bound(self, images: ImageSets, query: Query) -> OutputBounds:
            return SPOILT_BOUNDS[name](super().bound(images, query))

    search = Search(Ramp(), Spoilt(0.1), CLAIM, CellGrid(interval(), (8,), (2,)))
    leaves, _ = drive(search)
    why = "RuntimeError: planted" if name == "exception" else "the network's bounds are not finite"
    assert volume(leaves) == 8
    assert {(leaf.verdict, leaf.reason, leaf.margin) for leaf in leaves} == {("unknown", why, None)}


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_network_without_a_number_decides_nothing(value: float) -> None:
    class Broken(Threshold):
        def outputs(self, images: np.ndarray) -> np.ndarray:
            return super().outputs(images) * value

    search = Search(Ramp(), Broken(0.1), CLAIM, CellGrid(interval(), (8,), (2,)))
    leaves, _ = drive(search)
    assert {leaf.verdict for leaf in leaves} == {"unknown"}
    assert {leaf.reason for leaf in leaves} == {"the margin of a picture is no finite number"}
    assert not any(holds for _, holds in search.examine(search.grid.roots()).samples)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_number_that_is_lost_after_a_proof_takes_it_back(value: float) -> None:
    """Middle and ends have margins, what is rendered after the proof has none."""
    known = {-1.0, 0.0, 1.0}

    class Gap(Ramp):
        def image(self, values: np.ndarray) -> np.ndarray:
            return super().image(values) * np.float32(1.0 if float(values[0]) in known else value)

    leaves, _ = drive(Search(Gap(), Threshold(-0.5), CLAIM, CellGrid(interval(), (1,), (1,))))
    reason = "the margin of a picture is no finite number"
    assert [(leaf.verdict, leaf.reason, leaf.margin) for leaf in leaves] == [("unknown", reason, None)]


def test_false_proof_is_noticed() -> None:
    """A bound that lies (it proves everything) meets a pose that breaks the property."""
    hidden = {-1.0, 0.0, 1.0}

    class Hidden(Ramp):
        """Bright at middle and ends, dark elsewhere."""

        def image(self, values: np.ndarray) -> np.ndarray:
            return np.full((2, 2, 3), 0.9 if float(values[0]) in hidden else 0.1, np.float32)

    class Liar(Threshold):
        def bound(self, images: ImageSets, query: Query) -> OutputBounds:
            found = super().bound(images, query)
            return OutputBounds(np.ones_like(found.lower), found.a, found.b)

    with pytest.raises(ContradictionError, match="internal error"):
        drive(Search(Hidden(), Liar(0.5), CLAIM, CellGrid(interval(), (1,), (1,))))


def test_users_mistakes_and_lack_of_memory_end_the_run() -> None:
    for error in (InputError("planted"), MemoryError("planted"), KeyboardInterrupt()):

        class Spoilt(Ramp):
            def linear_sets(self, box: ParameterBox, error: BaseException = error) -> Any:
                raise error

        with pytest.raises(type(error)) as caught:
            drive(search_of(Spoilt()))
        assert caught.value is error


def test_unconfirmed_counterexample_is_unknown() -> None:
    class Moody(Ramp):
        calls = 0

        def image(self, values: np.ndarray) -> np.ndarray:
            Moody.calls += 1
            return np.full((2, 2, 3), 0.1 if Moody.calls <= 3 else 0.9, np.float32)

    leaves, _ = drive(Search(Moody(), Threshold(0.5), CLAIM, CellGrid(interval(), (1,), (1,))))
    assert [(leaf.verdict, leaf.reason) for leaf in leaves] == [("unknown", "a counterexample was not confirmed")]


# ---------------------------------------------------------------- grids and fixed partitions


def test_fixed_partition_gives_every_part_that_fails_its_own_verdict() -> None:
    scene = Ramp()
    grid = CellGrid.fixed(scene.box, (1000,), (7,))
    leaves, _ = drive(Search(scene, Threshold(0.43), CLAIM, grid, every_unit=True))
    assert volume(leaves) == 1000
    # x = -0.35 is the end of part 325
    assert volume(leaves, "falsified") in (325, 326)
    assert all(leaf.cell.volume == 1 for leaf in leaves if leaf.verdict != "certified")
    # the rest, but for the parts beside that end
    assert volume(leaves, "certified") >= 672 and volume(leaves, "unknown") <= 3


@pytest.mark.parametrize("partitions", [(3, 4), (), (10**6,) * 2])
def test_partition_that_does_not_fit(partitions: tuple[int, ...]) -> None:
    d = 2 if len(partitions) == 2 and partitions[0] > 10 else 1
    with pytest.raises(InputError, match="partitions"):
        CellGrid.fixed(interval(d), partitions, (1,) * d)


class Shade:
    """A scene of a `Shaded` set: brighter by ``shift``."""

    def __init__(self, owner: Shaded, shift: float) -> None:
        self.owner, self.shift = owner, shift

    def __call__(self, values: np.ndarray, tiles: np.ndarray | None = None) -> np.ndarray:
        return self.owner.image(values, self)

    def signed_gradient_step(
        self, box: ParameterBox, values: np.ndarray, score: Any, size: float
    ) -> tuple[np.ndarray, Shade]:
        shift = torch.tensor(self.shift, requires_grad=True)
        place = torch.from_numpy(values)
        (slope,) = torch.autograd.grad(score(self.owner.differentiable(place) + shift, place), shift)
        reach = self.owner.reach
        return values, Shade(
            self.owner, float(np.clip(self.shift + size * reach * np.sign(float(slope)), -reach, reach))
        )

    @property
    def nearest(self) -> Shade:
        return Shade(self.owner, 0.0)

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        return {"color": np.array([self.shift])}


class Shaded(Ramp):
    """A ramp whose scenes may be brighter or darker by up to ``reach``; those that are listed change nothing."""

    def __init__(self, d: int = 1, reach: float = 0.05) -> None:
        super().__init__(d)
        self.reach = reach

    def image(self, values: np.ndarray, scene_sample: Any = None) -> np.ndarray:
        return super().image(values) + np.float32(0.0 if scene_sample is None else scene_sample.shift)

    def scene_samples(self, seed: int) -> Iterator[Any]:
        return itertools.repeat(Shade(self, 0.0))

    def linear_sets(self, box: ParameterBox) -> Any:
        (a, low, _, high), lower, upper, slopes = super().linear_sets(box)
        return (a, low - self.reach, a, high + self.reach), lower - self.reach, upper + self.reach, slopes


@pytest.mark.slow
def test_scenes_of_a_set() -> None:
    """Where some scene is too dark the cell is falsified by it, although the stored scene is bright enough there."""
    scene = Shaded()
    leaves, _ = drive(Search(scene, Threshold(0.5), CLAIM, CellGrid.adaptive(scene.box, (5,))), 3000)
    # 0.5 + 0.2 x - 0.05 > 0.5 from x = 0.25 on
    for leaf in leaves:
        low, high = leaf.cell.first[0], leaf.cell.past[0]
        ends = [-1.0 + 2.0 * k / (5 << HALVINGS) for k in (low, high)]
        if leaf.verdict == "certified":
            assert ends[0] > 0.25 and leaf.scene is None
        elif leaf.verdict == "falsified":
            assert ends[0] <= 0.2500001 and leaf.counterexample is not None and leaf.margin is not None
            shift = 0.0 if leaf.scene is None else float(leaf.scene["color"][0])
            assert abs(shift) <= scene.reach
            assert leaf.margin == pytest.approx(0.2 * leaf.counterexample[0] + shift, abs=1e-6)
    whole = volume(leaves)
    assert volume(leaves, "falsified") > 0.62 * whole and volume(leaves, "certified") > 0.36 * whole
    # beyond x = 0 the stored scene holds
    dark = [leaf for leaf in leaves if leaf.verdict == "falsified" and leaf.counterexample[0] > 0.0]
    assert dark and all(leaf.scene is not None for leaf in dark)
    single = Search(Shaded(0), Threshold(0.48), CLAIM, CellGrid(interval(0), (), ()))
    (leaf,), _ = drive(single)
    assert leaf.verdict == "falsified" and leaf.scene is not None and leaf.scene["color"][0] == pytest.approx(-0.05)


def test_networks_are_asked_only_where_that_may_prove() -> None:
    """Wide cells are cut at once into as many parts as the margin's gradient asks for; what is bounded is proved."""
    scene = Ramp(2, slack=0.0)

    class Wide(Ramp):
        def linear_sets(self, box: ParameterBox) -> Any:
            (a, low, _, high), lower, upper, slopes = super().linear_sets(box)
            # falls with the square of the width
            more = 0.04 * float(np.square(np.subtract(box.upper, box.lower)).sum())
            return (a, low - more, a, high + more), lower - more, upper + more, slopes

    scene = Wide(2, slack=0.0)
    search = Search(scene, Threshold(0.1), CLAIM, CellGrid.adaptive(scene.box, (1, 1)))
    first = search.examine(search.grid.roots())
    assert first.bounded == 0 and sum(map(len, first.blocks)) >= 4
    assert sum(cell.volume for block in first.blocks for cell in block) == search.grid.volume
    leaves, _ = drive(search)
    assert {leaf.verdict for leaf in leaves} == {"certified"} and volume(leaves) == search.grid.volume
    assert len(leaves) <= 64


def test_grid() -> None:
    grid = CellGrid.adaptive(interval(2), (3, 2))
    assert grid.units == (3 << HALVINGS, 2 << HALVINGS) and len(grid.roots()) == 6
    assert sum(cell.volume for cell in grid.roots()) == grid.volume
    cell = Cell((0, 0), (1, 5))
    parts = grid.divide(cell, np.array([9.0, 1.0]), 0.25, 64)
    # the first parameter cannot be cut any more
    assert [(p.first[1], p.past[1]) for p in parts] == [(0, 1), (1, 2), (2, 3), (3, 5)]
    assert grid.divide(Cell((0, 0), (1, 1)), np.ones(2), 0.5, 64) == []
    assert grid.divide(Cell((0, 0), (4, 4)), np.array([np.nan, 0.0]), 1.0, 64)[0].past == (2, 4)
    # both are halved where that shrinks the sum, and no more often than allowed
    assert len(grid.divide(Cell((0, 0), (8, 8)), np.array([1.0, 1.0]), 0.5, 64)) == 4
    assert len(grid.divide(Cell((0, 0), (8, 8)), np.array([1.0, 1.0]), 0.01, 20)) == 16
    found = grid.divide(Cell((0, 0), (7, 5)), np.array([3.0, 1.0]), 0.2, 64)
    assert sum(part.volume for part in found) == 35 and len(set(found)) == len(found)
    assert initial_divisions(np.array([10.0, 0.0, np.inf]), 2.0) == (5, 1, 1)
    assert math.prod(initial_divisions(np.array([1e4, 1e4]), 0.1)) <= 1 << 16


# ---------------------------------------------------------------- store


def open_store(folder: Path, **more: Any) -> Store:
    arguments: dict[str, Any] = {"resume": False, "fingerprint": FINGERPRINT} | more
    return Store(folder, arguments["fingerprint"], [("x", "m")], {0: {}}, resume=arguments["resume"])


def fill(store: Store, search: Search, limit: int = 1 << 60) -> int:
    if store.grid(0, search.grid.box) is None:
        roots = search.grid.roots()
        store.begin(0, search.grid, [roots[i : i + BLOCK] for i in range(0, len(roots), BLOCK)])
    count = 0
    while count < limit and (blocks := store.pending(set(), 1)):
        assert store.close_block(blocks[0], search.examine(blocks[0].cells), search.grid)
        count += 1
    return count


def cells_of(folder: Path) -> list[Any]:
    with sqlite3.connect(folder / "cells.sqlite") as base:
        rows = base.execute("SELECT frame, lower, upper, verdict, margin, counterexample FROM cells").fetchall()
    return sorted(rows, key=lambda row: (row[0], json.loads(row[1])))


def test_schema_is_the_contracts(tmp_path: Path) -> None:
    store = open_store(tmp_path)
    fill(store, search_of())
    store.close()
    with sqlite3.connect(tmp_path / "cells.sqlite") as base:
        columns = {
            table: [(row[1], row[2]) for row in base.execute(f"PRAGMA table_info({table})")]
            for table in ("parameters", "cells")
        }
        assert base.execute("SELECT * FROM parameters").fetchall() == [(0, "x", "m")]
        kinds = {row[0] for row in base.execute("SELECT DISTINCT verdict FROM cells")}
    assert columns == {
        "parameters": [("position", "INTEGER"), ("name", "TEXT"), ("unit", "TEXT")],
        "cells": [
            ("frame", "INTEGER"), ("lower", "TEXT"), ("upper", "TEXT"), ("verdict", "TEXT"), ("margin", "REAL"),
            ("seconds", "REAL"), ("counterexample", "TEXT"),
        ],
    }  # fmt: skip
    assert kinds == {"certified", "falsified", "unknown"}
    for frame, lower, upper, verdict, margin, example in cells_of(tmp_path):
        assert frame == 0 and json.loads(lower) < json.loads(upper)
        assert (example is not None) == (verdict == "falsified")
        if verdict == "certified":
            assert margin > 0.0
        if example is not None:
            assert json.loads(lower) <= json.loads(example) <= json.loads(upper)


def test_resumed_store_equals_an_uninterrupted_one(tmp_path: Path) -> None:
    whole = open_store(tmp_path / "whole")
    count = fill(whole, search_of())
    tallies = whole.tallies()
    whole.close()
    # interrupted after every number of blocks, with and without a proper end
    for stops in (1, 3, count // 2):
        folder = tmp_path / str(stops)
        store = open_store(folder)
        done = fill(store, search_of(), stops)
        for proper in (True, False):
            if proper:
                store.finish({0: search_of().grid})
                # the cells cover the set: what is open is unknown
                covered = sum(json.loads(u)[0] - json.loads(l)[0] for _, l, u, *_ in cells_of_open(store))
                assert covered == pytest.approx(2.0)
            store.close()
            store = open_store(folder, resume=True)
            assert store.resumed
            done += fill(store, search_of(), stops)
        done += fill(store, search_of())
        assert done == count and store.tallies() == tallies
        store.close()
        assert cells_of(folder) == cells_of(tmp_path / "whole")


def cells_of_open(store: Store) -> list[Any]:
    return store._base.execute("SELECT frame, lower, upper FROM cells").fetchall()


def test_result_that_comes_twice_counts_once(tmp_path: Path) -> None:
    store, search = open_store(tmp_path), search_of()
    fill(store, search, 1)
    block = store.pending(set(), 1)[0]
    findings = search.examine(block.cells)
    assert store.close_block(block, findings, search.grid)
    before = store.tallies(), store.count, store.open_blocks
    assert not store.close_block(block, findings, search.grid)
    assert (store.tallies(), store.count, store.open_blocks) == before


def test_impossible_leaves_are_refused_and_nothing_is_stored(tmp_path: Path) -> None:
    store, search = open_store(tmp_path), search_of()
    fill(store, search, 0)
    block = store.pending(set(), 1)[0]
    for leaf in (
        FinishedCell(block.cells[0], "certified", None, 0.0),
        FinishedCell(block.cells[0], "certified", -1.0, 0.0),
        FinishedCell(block.cells[0], "certified", math.nan, 0.0),
        FinishedCell(block.cells[0], "falsified", -1.0, 0.0),
    ):
        with pytest.raises(ValueError, match=r"certified|falsified"):
            store.close_block(block, BlockResult((leaf,), (), (), 0, 0.0), search.grid)
        assert store.count == 0 and store.pending(set(), 1) == [block]


def test_pending_takes_what_is_nearest_to_a_proof_and_now_and_then_the_largest(tmp_path: Path) -> None:
    store, search = open_store(tmp_path), search_of(coarse=(40,))
    fill(store, search, 0)
    blocks = store.pending(set(), 3)
    assert [b.number for b in blocks] == [1, 2, 3]
    parts = tuple((Cell((k,), (k + 1,)),) for k in range(3))
    store.close_block(blocks[0], BlockResult((), parts, (), 0, 0.0, ranks=(5.0, 2.0, 1e9)), search.grid)
    # the fourth is the largest, the part with the last rank comes behind all first cells
    assert [b.number for b in store.pending({2}, 10)] == [3, 7, 6, 4, 5, 8]
    assert store.pending({2, 3, 4, 5, 6, 7, 8}, 10) == []


def test_cells_far_from_a_proof_come_last() -> None:
    """Ranks: a near miss, a far one, a broken one, and one of which nothing is known."""
    search = search_of(Ramp(slack=0.02), Threshold(0.43), (16,))
    found = search.examine(search.grid.roots()[:BLOCK])
    assert list(found.ranks) == sorted(found.ranks) and found.ranks
    near, far = (search_of(Ramp(slack=s), Threshold(0.49), (4,)) for s in (0.03, 0.045))
    cell = near.grid.roots()[2]
    assert 1.0 < near.examine([cell]).ranks[0] < far.examine([cell]).ranks[0]
    nothing = search_of(spoilt(fail)(), Threshold(0.43), (4,))
    assert nothing.examine([cell]).ranks[0] > 1e6


@pytest.mark.slow
def test_deep_first_proves_early() -> None:
    """Where every cell needs several cuts, half of the work proves nearly half of the set."""

    class Even(Ramp):
        """One brightness, and bounds that miss it by a quarter of a cell's width."""

        def __init__(self) -> None:
            super().__init__(2)
            self.gains = np.zeros(2)

        def linear_sets(self, box: ParameterBox) -> Any:
            self.slack = 0.125 * float(np.mean(np.array(box.upper) - np.array(box.lower)))
            return super().linear_sets(box)

    search = search_of(Even(), Threshold(0.48), (2, 2))
    roots = [(1e6, tuple(search.grid.roots()))]
    done = proved = 0
    shares = []
    while roots:
        roots.sort(key=lambda item: item[0])
        _, block = roots.pop(0)
        found = search.examine(block)
        roots += zip(found.ranks, found.blocks, strict=True)
        done += len(block)
        proved += volume(list(found.leaves), "certified")
        shares.append((done, proved / search.grid.volume))
    half = max(share for count, share in shares if count <= 0.5 * done)
    assert shares[-1][1] == 1.0 and half > 0.45


@pytest.mark.parametrize("change", [{"scene": "b", "rules": 1}, {"scene": "a"}, {"scene": "a", "rules": 2}])
def test_another_search_is_not_continued(change: dict[str, Any], tmp_path: Path) -> None:
    open_store(tmp_path).close()
    with pytest.raises(InputError) as caught:
        open_store(tmp_path, resume=True, fingerprint=change)
    assert caught.value.field == "--resume" and caught.value.fix
    # without --resume it is replaced, and nothing speaks of it any more
    reports = [tmp_path / "report.json", tmp_path / "report.html"]
    for report in reports:
        report.write_text("{}")
    open_store(tmp_path, resume=True).close()
    assert all(report.exists() for report in reports)
    store = open_store(tmp_path, fingerprint=change)
    assert store.tallies() == [] and not store.resumed
    assert not any(report.exists() for report in reports)


def test_damaged_store_and_second_command(tmp_path: Path) -> None:
    store = open_store(tmp_path)
    with pytest.raises(InputError, match="locked"):
        open_store(tmp_path, resume=True)
    store.close()
    (tmp_path / "cells.sqlite").write_bytes(b"no database" * 1000)
    with pytest.raises(InputError, match="cannot be used"):
        open_store(tmp_path, resume=True)
    (tmp_path / "cells.sqlite").write_bytes(b"")
    with pytest.raises(InputError, match=r"cells\.sqlite") as caught:
        open_store(tmp_path, resume=True)
    assert caught.value.fix
    open_store(tmp_path).close()


def test_others_may_read_while_cells_come_in(tmp_path: Path) -> None:
    store, search = open_store(tmp_path), search_of()
    fill(store, search, 3)
    assert len(cells_of(tmp_path)) == store.count > 0
    before = cells_of(tmp_path)
    fill(store, search)
    whole = cells_of(tmp_path)
    assert len(whole) == store.count > len(before) and all(row in whole for row in before)
    ends = [(json.loads(lower)[0], json.loads(upper)[0]) for _, lower, upper, *_ in whole]
    assert ends[0][0] == -1.0 and ends[-1][1] == 1.0
    assert all(left[1] == right[0] for left, right in itertools.pairwise(ends))
    store.close()


def test_fractions_are_a_measure(tmp_path: Path) -> None:
    store, search = open_store(tmp_path), search_of()
    fill(store, search, 2)
    (tally,) = store.tallies()
    assert sum(fractions(tally).values()) == pytest.approx(1.0)
    fill(store, search)
    (tally,) = store.tallies()
    assert tally.open == 0 and tally.certified + tally.falsified + tally.unknown == search.grid.volume
    # first cells alone are evenly spread
    assert tally.poses == 5 and tally.holding == 3
    store.trace()
    assert store.points[-1]["certified"] == fractions(tally)["certified"]


def test_blocks_survive_as_they_are(tmp_path: Path) -> None:
    store, search = open_store(tmp_path), search_of(Ramp(2), coarse=(3, 3))
    fill(store, search, 0)
    assert [dataclasses.astuple(b) for b in store.pending(set(), 9)] == [
        dataclasses.astuple(CellBlock(k + 1, 0, 0, tuple(search.grid.roots()[i : i + BLOCK])))
        for k, i in enumerate(range(0, 9, BLOCK))
    ]
