"""One linear map for a whole picture: exact on random leaves, and around real renders of a scene."""

from __future__ import annotations

import dataclasses
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
import torch
from conftest import Inputs

import ns_abstract as nsa
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.tiles import assemble
from ns_abstract.refine.linear_map import LinearImage, bounds_at, linear_image
from ns_abstract.refine.result import Leaves

SIDE = 2


def cut(box: ParameterBox, rng: np.random.Generator, count: int) -> list[ParameterBox]:
    """A box in ``count`` pieces with random cuts."""
    pieces = [box]
    while len(pieces) < count:
        piece = pieces.pop(int(rng.integers(len(pieces))))
        axis = int(rng.integers(piece.dimensions))
        low, high = piece.lower[axis], piece.upper[axis]
        middle = min(high, max(low, low + float(rng.uniform(0.2, 0.8)) * (high - low)))
        pieces += [piece.replace(axis, low, middle), piece.replace(axis, middle, high)]
    return pieces


def random_leaves(box: ParameterBox, seed: int) -> tuple[Leaves, np.ndarray, np.ndarray]:
    """Leaves of a picture of 3 x 3 pixels in 4 tiles, and bounds of the whole set below and above all planes."""
    rng = np.random.default_rng(seed)
    boxes, tiles = [], []
    for tile in ((0, 0), (0, SIDE), (SIDE, 0), (SIDE, SIDE)):
        pieces = cut(box, rng, int(rng.integers(1, 9)))
        boxes += pieces
        tiles += [tile] * len(pieces)
    shape = (len(boxes), SIDE, SIDE, 3)
    slopes = rng.normal(size=(2, *shape, box.dimensions)) * 10.0 ** rng.uniform(-3, 1, (2, *shape, 1))
    offsets = rng.normal(size=(2, *shape))
    leaves = Leaves(
        np.array([b.lower for b in boxes]), np.array([b.upper for b in boxes]), np.array(tiles, np.int32),
        slopes[0].astype(np.float32), offsets[0].astype(np.float32),
        slopes[1].astype(np.float32), offsets[1].astype(np.float32),
    )  # fmt: skip
    far = np.full((3, 3, 3), 1e4, np.float32)
    return leaves, -far, far


def exact(values: Any) -> list[Fraction]:
    return [Fraction(float(v)) for v in np.ravel(values)]


def plane(slope: np.ndarray, offset: float, place: list[Fraction]) -> Fraction:
    return Fraction(float(offset)) + sum((a * t for a, t in zip(exact(slope), place, strict=True)), Fraction(0))


def scaled(low: Any, high: Any, point: list[Fraction]) -> list[Fraction]:
    """``point`` as the box's parameters in [-1, 1]; 0 where it has no width."""
    ends = zip(exact(low), exact(high), point, strict=True)
    return [(2 * x - a - b) / (b - a) if b > a else Fraction(0) for a, b, x in ends]


#: Boxes: far from 0, of one parameter, of a tiny one beside a wide one.
BOXES = {
    "far from 0": ParameterBox(("x", "azimuth"), ("", ""), (3.0, -70.0), (3.0 + 1e-9, -69.999)),
    "one": ParameterBox(("x",), ("",), (-0.1,), (0.2,)),
    "wide and narrow": ParameterBox(("x", "y", "z"), ("",) * 3, (-1e6, 0.1, -1e-7), (1e5, 0.3, 1e-7)),
}


@pytest.mark.parametrize("name", BOXES)
@pytest.mark.parametrize("part", [False, True])
def test_planes_hold_exactly(name: str, part: bool) -> None:
    """In rational numbers, without a tolerance: below and above every leaf's planes at its corners and inside."""
    whole = BOXES[name]
    box = whole
    if part:
        for axis in range(whole.dimensions):
            low, high = whole.lower[axis], whole.upper[axis]
            box = box.replace(axis, low + 0.3 * (high - low), high if axis else low + 0.55 * (high - low))
    leaves, lower, upper = random_leaves(whole, 3)
    found = linear_image(leaves, lower, upper, box)
    assert (found.b_lower > -1e3).all() and (found.b_upper < 1e3).all()
    touched = checked = 0
    for n in range(len(leaves.tile)):
        low, high = np.maximum(leaves.box_lower[n], box.lower), np.minimum(leaves.box_upper[n], box.upper)
        if (low > high).any():
            continue
        row, column = leaves.tile[n]
        corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(whole.dimensions, -1).T
        for corner in [*corners, low + 0.37 * (high - low)]:
            point = exact(np.clip(corner, low, high))
            own, ours = scaled(leaves.box_lower[n], leaves.box_upper[n], point), scaled(box.lower, box.upper, point)
            tight_low, tight_high = bounds_at(leaves, lower, upper, np.clip(corner, low, high))
            for i, j in np.ndindex(min(SIDE, 3 - row), min(SIDE, 3 - column)):
                y, x, c = row + i, column + j, (i + j) % 3
                below = plane(leaves.A_lower[n, i, j, c], leaves.b_lower[n, i, j, c], own)
                above = plane(leaves.A_upper[n, i, j, c], leaves.b_upper[n, i, j, c], own)
                gaps = (
                    below - plane(found.A_lower[y, x, c], found.b_lower[y, x, c], ours),
                    plane(found.A_upper[y, x, c], found.b_upper[y, x, c], ours) - above,
                )
                assert min(gaps) >= 0
                touched += min(gaps) < 1e-5
                checked += 1
                # at a pose: at least as tight as this leaf, but for the rounding to float32
                assert Fraction(float(tight_low[y, x, c])) >= below - Fraction(1, 10**5)
                assert Fraction(float(tight_high[y, x, c])) <= above + Fraction(1, 10**5)
                assert len(own) == 0 or max(map(abs, own)) <= 1
    assert checked > 50 and touched > 5


def test_bounds_at_a_pose_are_below_the_planes_of_its_leaf() -> None:
    """One leaf and tile: what `bounds_at` returns is on the safe side of the exact planes, rounded to float32."""
    for seed, box in enumerate(BOXES.values()):
        rng = np.random.default_rng(seed)
        leaves, lower, upper = random_leaves(box, seed)
        n = 0
        one = Leaves(*(getattr(leaves, entry)[:1] for entry in Leaves.__dataclass_fields__))
        for _ in range(20):
            point = np.clip(rng.uniform(one.box_lower[0], one.box_upper[0]), one.box_lower[0], one.box_upper[0])
            own = scaled(one.box_lower[0], one.box_upper[0], exact(point))
            low, high = bounds_at(one, lower, upper, point)
            for y, x, c in np.ndindex(SIDE, SIDE, 3):
                assert Fraction(float(low[y, x, c])) <= plane(one.A_lower[n, y, x, c], one.b_lower[n, y, x, c], own)
                assert Fraction(float(high[y, x, c])) >= plane(one.A_upper[n, y, x, c], one.b_upper[n, y, x, c], own)


def test_where_leaves_are_missing_the_picture_stays() -> None:
    leaves, lower, upper = random_leaves(BOXES["one"], 5)
    keep = np.ones(len(leaves.tile), bool)
    keep[0] = False
    some = Leaves(*(getattr(leaves, entry)[keep] for entry in Leaves.__dataclass_fields__))
    found = linear_image(some, lower, upper, BOXES["one"])
    row, column = leaves.tile[0]
    assert (found.b_lower[row : row + SIDE, column : column + SIDE] == -1e4).all()
    assert (found.b_lower > -1e4).any()


@pytest.fixture(scope="module")
def result(blobs: Inputs) -> tuple[nsa.Scene, nsa.PoseSet, nsa.BoundResult]:
    scene, camera = nsa.load_scene(blobs.config), nsa.load_camera_path(blobs.path).cameras[0]
    poses = nsa.PoseSet(camera, {"x": 0.05}, {"yaw": (-0.01, 0.03)})
    return scene, poses, nsa.bound(scene, poses, target_ratio=1.2, time_budget=10.0, keep_cells=True)


@pytest.mark.slow
def test_pictures_lie_between_the_planes(result: tuple[nsa.Scene, nsa.PoseSet, nsa.BoundResult]) -> None:
    """Renders of random poses, the set's corners and a part's: inside, without a tolerance."""
    scene, poses, bounds = result
    frame = scene.method().frame(poses.of(scene))
    rng = np.random.default_rng(0)
    part = {"yaw": (0.01, 0.03)}
    for box, found in ((None, bounds.linear()), (part, bounds.linear(part))):
        assert isinstance(found, LinearImage) and found.A_lower.shape == (*bounds.lower.shape, 2)
        for values in [*found.box.sample(40, rng), *found.box.corners(), found.box.middle]:
            place = 2.0 * (values - found.box.middle) / (np.array(found.box.upper) - found.box.lower)
            image = _render(frame, values)
            low, high = found.A_lower @ place + found.b_lower, found.A_upper @ place + found.b_upper
            assert (low <= image).all() and (image <= high).all()
            at_low, at_high = bounds.at(values)
            assert (at_low <= image).all() and (image <= at_high).all()
            assert (at_low >= bounds.lower).all() and (at_high <= bounds.upper).all()
        # never worse than the abstract image on average, and better somewhere
        width = (found.b_upper - found.b_lower).mean()
        assert width < 0.9 * (bounds.upper - bounds.lower).mean(), box
    narrow = bounds.linear(part)
    assert (narrow.b_upper - narrow.b_lower).mean() < (bounds.linear().b_upper - bounds.linear().b_lower).mean()


def _render(frame: Any, values: np.ndarray) -> np.ndarray:
    return assemble(frame.precise(values), frame.camera)


def test_torch_layer_holds_every_picture(result: tuple[nsa.Scene, nsa.PoseSet, nsa.BoundResult]) -> None:
    scene, poses, bounds = result
    frame = scene.method().frame(poses.of(scene))
    layer = bounds.to_torch().double()
    found = bounds.linear()
    for values in [*found.box.sample(10, np.random.default_rng(1)), *found.box.corners()]:
        place = 2.0 * (values - found.box.middle) / (np.array(found.box.upper) - found.box.lower)
        image = torch.from_numpy(_render(frame, values).transpose(2, 0, 1))[None]
        zero = torch.zeros_like(image)
        middle = layer(torch.from_numpy(place)[None], zero)
        assert layer(torch.from_numpy(place)[None], zero + 1.0).shape == image.shape
        assert ((image - middle).abs() <= layer.radius).all()
    assert sum(p.requires_grad for p in layer.parameters()) == 0


def test_slack_reaches_both_planes() -> None:
    """Exactly, at the corners of the parameters: radius and middle plane hold both planes between them."""
    rng = np.random.default_rng(4)
    box = ParameterBox(("x", "y"), ("", ""), (-1.0, -1.0), (1.0, 1.0))
    A, b = rng.normal(size=(2, 4, 4, 3, 2)).astype(np.float32), rng.normal(size=(2, 4, 4, 3)).astype(np.float32)
    image = LinearImage(box, A[0], b[0], A[1], b[1] + np.float32(9.0))
    slope, offset, radius = image.middle()
    for corner in box.corners():
        for pixel in np.ndindex(4, 4, 3):
            middle = plane(slope[pixel], offset[pixel], exact(corner))
            low = plane(image.A_lower[pixel], image.b_lower[pixel], exact(corner))
            high = plane(image.A_upper[pixel], image.b_upper[pixel], exact(corner))
            reach = Fraction(float(radius[pixel]))
            assert middle - reach <= low and high <= middle + reach


def test_auto_lirpa_takes_the_layer(result: tuple[nsa.Scene, nsa.PoseSet, nsa.BoundResult]) -> None:
    """The manual's example: CROWN's bounds of a network behind the layer hold for outputs at renders."""
    lirpa = pytest.importorskip("auto_LiRPA", reason="auto_LiRPA is not installed")
    unit = pytest.importorskip("auto_LiRPA.perturbations").PerturbationLpNorm(norm=np.inf, eps=1.0)
    scene, poses, bounds = result
    layer = bounds.to_torch()
    torch.manual_seed(0)
    size = int(np.prod(layer.shape))
    network = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(size, 8), torch.nn.ReLU(), torch.nn.Linear(8, 3))

    class Seen(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.layer, self.network = layer, network

        def forward(self, p: torch.Tensor, e: torch.Tensor) -> torch.Tensor:
            return self.network(self.layer(p, e))

    p, e = torch.zeros(1, len(bounds.parameters.names)), torch.zeros(1, *layer.shape)
    model = lirpa.BoundedModule(Seen(), (p, e), bound_opts={"conv_mode": "matrix"})
    low, high = model.compute_bounds(
        x=(lirpa.BoundedTensor(p, unit), lirpa.BoundedTensor(e, unit)), method="CROWN"
    )  # fmt: skip
    frame = scene.method().frame(poses.of(scene))
    for values in frame.box.sample(20, np.random.default_rng(2)):
        image = torch.from_numpy(_render(frame, values).transpose(2, 0, 1)[None]).float()
        out = network(image)
        # auto_LiRPA and this evaluation round to float32, which neither charges
        assert ((low - 1e-5 <= out) & (out <= high + 1e-5)).all()
    assert torch.isfinite(low).all() and torch.isfinite(high).all()


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda r: r.linear({"w": (0, 1)}), "box"),
        (lambda r: r.linear({"x": (0.0, 0.06)}), "box.x"),
        (lambda r: r.linear({"x": 0.01}), "box.x"),
        (lambda r: r.linear(0.01), "box"),
        (lambda r: r.at([0.0]), "p"),
        (lambda r: r.at({"x": 0.0}), "p"),
        (lambda r: r.at([0.06, 0.0]), "p"),
        (lambda r: r.at(["a", 0.0]), "p"),
        (lambda r: r.at([float("nan"), 0.0]), "p"),
    ],
)
def test_what_is_no_part_of_the_set_is_refused(
    call: Any, field: str, result: tuple[nsa.Scene, nsa.PoseSet, nsa.BoundResult]
) -> None:
    with pytest.raises(nsa.InputError) as caught:
        call(result[2])
    assert caught.value.field == field and caught.value.fix


def test_without_cells(result: tuple[nsa.Scene, nsa.PoseSet, nsa.BoundResult]) -> None:
    bare = dataclasses.replace(result[2], cells=None)
    low, high = bare.at({"yaw": 0.0, "x": 0.0})
    assert (low == bare.lower).all() and (high == bare.upper).all()
    with pytest.raises(nsa.InputError, match="keep_cells"):
        bare.linear()
