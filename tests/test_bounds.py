"""The bounds of tiny synthetic scenes, each aimed at one rule of the rasteriser.

Every test compares the bounds of cells of poses with concrete renders of poses of those cells: the ends, a
dense line (one parameter) or corners and random poses (more), at tolerance zero.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from ns_abstract.arithmetic.rounding import FLOAT32, REAL, SUB_BOX_OVERLAP
from ns_abstract.geometry.box import ParameterBox, shared_out
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.motion_cells import MotionCells, MotionField
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.geometry.tiles import assemble, tile_grid
from ns_abstract.methods.splat.activate import Splats, rotation_matrices
from ns_abstract.methods.splat.bounds import SplatBounds
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0, PAPER
from ns_abstract.methods.splat.frame import SplatFrame
from ns_abstract.methods.splat.intervals import sort_keys as sort_group
from ns_abstract.methods.splat.projection_errors import FORMS, SPREAD, UNBOUNDED, columns
from ns_abstract.methods.splat.render import Renderer
from ns_abstract.methods.splat.stage_data import SubBoxes, cell_parts
from ns_abstract.methods.splat.sub_box_bounds import SubBoxBounds, channel_differences, difference_ends
from ns_abstract.perturbation.specification import Perturbation
from ns_abstract.refine.protocol import CHANNEL_DIFFERENCES

both_orders = pytest.mark.parametrize("order", [1, 2])
TURN = (0.8, 0.3, -0.4, 0.33)


def scene(*gaussians: dict, background=(0.0, 0.0, 0.0), antialiased: bool = False) -> Splats:
    """Activated Gaussians from ``mean``, ``scale``, ``quat``, ``opacity`` and ``color`` or ``sh`` [K, 3]."""
    quats = np.array([g.get("quat", (1.0, 0.0, 0.0, 0.0)) for g in gaussians], np.float64)
    scales = np.array([np.broadcast_to(g["scale"], 3) for g in gaussians], np.float64)
    sh = np.array([g.get("sh", [g.get("color", (1.0, 1.0, 1.0))]) for g in gaussians], np.float64)
    return Splats(
        means=np.array([g["mean"] for g in gaussians], np.float64),
        axes=np.ascontiguousarray(rotation_matrices(quats) * scales[:, None]),
        opacity=np.array([g["opacity"] for g in gaussians], np.float64),
        sh=sh,
        degree=math.isqrt(sh.shape[1]) - 1,
        background=np.array(background, np.float64),
        antialiased=antialiased,
    )


def camera(width: int = 16, height: int = 16, focal: float = 16.0, position=(0.0, 0.0, 0.0)) -> PinholeCamera:
    """A camera at ``position`` that looks along -z of the world."""
    pose = np.concatenate([np.eye(3), np.array(position, np.float64)[:, None]], axis=1)
    return PinholeCamera(pose, focal, focal, width / 2, height / 2, width, height)


def moves(**limits) -> Perturbation:
    """Ranges by parameter name; a number r means [-r, r]."""
    ranges = {k: v if isinstance(v, tuple) else (-v, v) for k, v in limits.items()}
    return Perturbation(
        translation={k: v for k, v in ranges.items() if k in ("x", "y", "z")},
        rotation={k: v for k, v in ranges.items() if k in ("yaw", "pitch", "roll")},
    )


class Case:
    """A scene, a camera and a set of poses."""

    def __init__(self, splats: Splats, perturbation: Perturbation, view: PinholeCamera | None = None) -> None:
        self.camera = view or camera()
        self.splats = splats
        self.poses = PoseBox.around(self.camera, perturbation)
        self.renderer = Renderer(splats, GSPLAT_1_4_0)

    def image(self, values: np.ndarray) -> np.ndarray:
        return self.renderer.image(self.camera, *self.poses.world_to_camera(values))

    def bounds(self, box: ParameterBox, order: int, arithmetic=REAL, **options):
        return SplatBounds(self.splats, GSPLAT_1_4_0, arithmetic).cell(
            self.camera, self.poses.enclosure(box, order), **options
        )

    def sub_box_ends(self, box: ParameterBox, counts: np.ndarray | MotionCells, arithmetic=REAL) -> list[np.ndarray]:
        """As `ends`, by pairs of uncertain order, and by ranges of depths."""
        bounds, forms = SubBoxBounds(self.splats, GSPLAT_1_4_0, arithmetic), self.poses.enclosure(box, 1)
        found = self._orders(bounds, forms, bounds.project(self.camera, forms), counts)
        return [self._laid_out(ends).clip(0.0, 1.0) for ends in found]

    def motion_cells(self, box: ParameterBox) -> MotionCells:
        """Cells of linear maps at random: any map is sound (B16)."""
        generator, shape = np.random.default_rng(box.dimensions), (self.camera.height * self.camera.width, 2)
        pixels = generator.normal(size=(*shape, box.dimensions)) * (generator.uniform(size=(*shape, 1)) < 0.9)
        return MotionField(pixels, 1).cells(np.array([4, 2]))

    def check_motion(self, cells: MotionCells, ends: np.ndarray, p: np.ndarray, image: np.ndarray) -> None:
        """Each pixel of the ``image`` at scaled parameters ``p`` [d] lies within the ends over its motion cells."""
        parts = cell_parts(cells.counts, SUB_BOX_OVERLAP)
        motion = (cells.motion[:, :2] @ p).reshape(*image.shape[:2], 2, 1)
        within = (np.abs(motion - parts.middles) <= parts.half[:, None]).all(axis=2)
        assert within.any(axis=-1).all()
        low, high = (np.where(within[:, :, None], ends[:, :, side], float(side)) for side in (0, 1))
        assert (low <= image[..., None]).all() and (image[..., None] <= high).all()

    def difference_ends(self, box: ParameterBox, counts: np.ndarray, arithmetic=REAL) -> list[np.ndarray]:
        """As `sub_box_ends`, of differences of channels."""
        bounds, forms = SubBoxBounds(self.splats, GSPLAT_1_4_0, arithmetic), self.poses.enclosure(box, 1)
        projected, scale = channel_differences(bounds.project(self.camera, forms))
        found = []
        for parts in self._orders(bounds, forms, projected, counts):
            ends = difference_ends(parts.reshape(-1, *parts.shape[3:]), scale)
            found.append(self._laid_out(np.concatenate(ends, axis=1).reshape(parts.shape)))
        return found

    def _orders(self, bounds: SubBoxBounds, forms, projected, counts: np.ndarray | MotionCells) -> list[np.ndarray]:
        """Ends [T, side, side, 6, parts] by pairs of uncertain order, and by ranges of depths."""
        tiles = np.arange(math.prod(tile_grid(self.camera, bounds.side)))
        pixels = np.ones((tiles.size, bounds.side, bounds.side), bool)
        found = []
        for crowded, goal in ((False, np.nan), (True, np.inf)):
            goals = np.full((pixels.size, 6), goal)
            ends = bounds.sub_boxes(
                self.camera, forms, projected, tiles, pixels, counts, goals, np.full(pixels.size, crowded)
            )
            found.append(ends.reshape(*pixels.shape, 6, -1))
        return found

    def _laid_out(self, ends: np.ndarray) -> np.ndarray:
        """[H, W, 2, 3, parts] from tiles [T, side, side, 6, parts]."""
        image = assemble(ends.reshape(*ends.shape[:3], -1), self.camera)
        return image.reshape(*image.shape[:2], 2, 3, -1)

    def samples(self, box: ParameterBox, count: int) -> np.ndarray:
        """Ends and a line of poses for one parameter; corners and random poses for more."""
        if box.dimensions == 1:
            return box.at(np.linspace(-1.0, 1.0, count)[:, None])
        generator = np.random.default_rng(0)
        return np.concatenate([box.corners()[:4], box.corners()[-4:], box.sample(count, generator)])

    def ends(self, cell) -> np.ndarray:
        """Lower and upper bounds [H, W, 2, 3, parts] over parts or sub-boxes of a cell."""
        return self._laid_out(cell.parts).clip(0.0, 1.0)

    def check(
        self, order: int, parts: int = 2, count: int = 9, arithmetic=REAL, floor: float = -1.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of the set from ``parts`` cells along the first parameter, after checking each cell.

        With forms of order 1 bounds over parts of each cell are checked, too. Returns the width of the bounds by forms
        and the width of the sampled images, [H, W, 3].
        """
        lowest, highest = np.ones((2, self.camera.height, self.camera.width, 3)) * [[[[1.0]]], [[[0.0]]]]
        least, most = lowest.copy(), highest.copy()
        for box in self.poses.box.split(0, parts):
            sub_boxes = SubBoxes(shared_out(np.ones(box.dimensions), 16)) if box.dimensions else None
            cell = self.bounds(box, order, arithmetic, keep_linear=True, floor=floor, sub_boxes=sub_boxes)
            assert cell.statistics[4] == 0
            lower, upper = assemble(cell.lower, self.camera), assemble(cell.upper, self.camera)
            linear = assemble(cell.linear, self.camera)
            found = [(lower, upper)]
            over_parts = [] if sub_boxes is None else [(cell_parts(sub_boxes.counts), self.ends(cell))]
            differences = []
            if order == 1:
                divided = shared_out(np.ones(box.dimensions), 16)
                by_parts = self.bounds(box, 1, arithmetic, floor=floor, parts=divided)
                assert by_parts.statistics[4] == 0
                over_parts += [(cell_parts(divided), ends) for ends in self.sub_box_ends(box, divided, arithmetic)]
                differences = [(cell_parts(divided), ends) for ends in self.difference_ends(box, divided, arithmetic)]
                found.append((assemble(by_parts.lower, self.camera), assemble(by_parts.upper, self.camera)))
            motion = self.motion_cells(box) if order == 1 and box.dimensions > 1 else None
            by_motion = [] if motion is None else self.sub_box_ends(box, motion, arithmetic)
            pairs = self.poses.enclosure(box, order).rotation.basis.pairs
            for values in self.samples(box, count):
                image = self.image(values)
                p = 2.0 * (values - np.array(box.lower)) / (np.array(box.upper) - np.array(box.lower)) - 1.0
                # the polynomial sets hold the picture before it is clamped; evaluated in float64 here
                middle = linear[..., :-1] @ np.array([1.0, *p, *(p[k] * p[l] for k, l in pairs)])
                radius = linear[..., -1] + 1e-12
                assert (np.minimum(1.0, middle - radius) <= image).all(), (box, values)
                assert (np.maximum(0.0, middle + radius) >= image).all(), (box, values)
                # and each of the parts holds the pictures of its own poses
                for sub, ends in over_parts:
                    within = (np.abs(p[:, None] - sub.middles) <= sub.half[:, None]).all(axis=0)
                    assert within.any()
                    assert (ends[:, :, 0, :, within] <= image).all() and (ends[:, :, 1, :, within] >= image).all()
                for ends in by_motion:
                    self.check_motion(motion, ends, p, image)
                for sub, ends in differences:
                    within = (np.abs(p[:, None] - sub.middles) <= sub.half[:, None]).all(axis=0)
                    assert_differences(image, ends[..., within])
                for low, high in found:
                    assert (low <= image).all() and (image <= high).all(), (box, values, worst(low, image, high))
                least, most = np.minimum(least, image), np.maximum(most, image)
            lowest, highest = np.minimum(lowest, lower), np.maximum(highest, upper)
        return highest - lowest, most - least


def assert_differences(image: np.ndarray, ends: np.ndarray) -> None:
    """Differences of channels of a picture lie within their ``ends`` [H, W, 2, 3, k] where none is clamped."""
    inside = (image > 0.0) & (image < 1.0)
    for k, (first, second) in enumerate(CHANNEL_DIFFERENCES):
        values, low, high = (image[..., first] - image[..., second])[..., None], ends[:, :, 0, k], ends[:, :, 1, k]
        known = (inside[..., first] & inside[..., second])[..., None]
        # the subtraction of two float64 numbers that stand for the program's float32 ones is exact or nearly so
        assert (~known | ((low <= values) & (values <= high))).all()


def worst(lower: np.ndarray, image: np.ndarray, upper: np.ndarray) -> float:
    """How far the image leaves the bounds."""
    return float(max((lower - image).max(), (image - upper).max()))


def swap_case() -> Case:
    """Two overlapping layers side by side at equal depth: yaw decides which is nearer."""
    return Case(
        scene(
            {"mean": (-0.4, 0.0, -5.0), "scale": 0.8, "opacity": 0.9, "color": (1.0, 0.1, 0.0)},
            {"mean": (0.4, 0.1, -5.0), "scale": 0.8, "opacity": 0.8, "color": (0.0, 0.9, 1.0)},
            background=(0.2, 0.3, 0.4),
        ),
        moves(yaw=0.05),
    )


@both_orders
def test_depth_swap(order):
    """The cell that spans the swap holds both orders."""
    case = swap_case()
    near, far = case.image(np.array([-1e-9])), case.image(np.array([1e-9]))
    assert np.abs(near - far).max() > 0.2
    width, sampled = case.check(order, parts=1)
    assert width.mean() < 2.0 * sampled.mean()
    case.check(order, parts=3)


def test_motion_cells_hold_every_map():
    """Three layers of small blobs that move by pixels, over motion cells of maps at random (B16)."""
    generator = np.random.default_rng(3)
    layers = [
        {"mean": tuple(place), "scale": 0.15, "opacity": 0.8, "color": tuple(generator.uniform(size=3))}
        for place in generator.uniform((-1.5, -1.5, -6.0), (1.5, 1.5, -4.0), (40, 3))
    ]
    Case(scene(*layers), moves(x=0.1, yaw=0.03, pitch=0.02, roll=0.05)).check(1, parts=1, count=40)


@both_orders
def test_order_of_layers_that_differ_in_one_channel(order):
    """Layers of one colour keep no order, and two that share a channel are not of one colour (O5)."""
    case = Case(
        scene(
            {"mean": (-0.4, 0.0, -5.0), "scale": 0.8, "opacity": 0.9, "color": (0.5, 0.1, 0.3)},
            {"mean": (0.4, 0.1, -5.0), "scale": 0.8, "opacity": 0.8, "color": (0.5, 0.1, 1.0)},
        ),
        moves(yaw=0.05),
    )
    near, far = case.image(np.array([-1e-9])), case.image(np.array([1e-9]))
    assert np.abs(near - far)[..., 2].max() > 0.1
    assert np.abs(near - far)[..., :2].max() < 1e-6
    case.check(order, parts=1)


@both_orders
def test_layers_of_one_color_are_no_pairs(order, monkeypatch):
    """Where no two colours differ, any number of layers may change places (O5)."""
    near, far = (
        {"mean": (x, 0.1 * x, -5.0), "scale": 0.8, "opacity": 0.7, "color": (0.9, 0.2, 0.0)} for x in (-0.4, 0.4)
    )
    case = Case(scene(near, far, {**far, "mean": (0.0, 0.1, -5.0)}, background=(0.2, 0.3, 0.4)), moves(yaw=0.05))
    width, sampled = case.check(order, parts=1)
    assert width.mean() < 2.0 * sampled.mean()
    monkeypatch.setattr("ns_abstract.methods.splat.bounds.PAIR_LIMIT", 0)
    again, _ = case.check(order, parts=1)
    assert (again == width).all()
    # any other pair is one too many
    swapped, _ = swap_case().check(order, parts=1)
    assert swapped.max() == 1.0


@both_orders
def test_three_layers_swap(order):
    """Three layers that all change places, the middle one much brighter than 1."""
    case = Case(
        scene(
            {"mean": (-0.5, 0.0, -5.0), "scale": 0.7, "opacity": 0.9, "color": (1.0, 0.0, 0.3)},
            {"mean": (0.0, 0.1, -5.0), "scale": 0.7, "opacity": 0.7, "color": (0.0, 3.0, 0.2)},
            {"mean": (0.5, -0.1, -5.0), "scale": 0.7, "opacity": 0.8, "color": (0.5, 0.2, 2.0)},
            background=(1.0, 0.0, 0.5),
        ),
        moves(yaw=0.04),
    )
    case.check(order, parts=1)


def test_order_by_pitch_and_roll():
    """Several rotations at once."""
    case = swap_case()
    case.poses = PoseBox.around(case.camera, moves(yaw=0.02, pitch=0.03, roll=0.05))
    case.check(1, parts=2, count=6)


@pytest.mark.parametrize("names", [(), ("x", "yaw")])
def test_curvature_of_one_parameter_only(names):
    """Forms of order 2 have one parameter: anything else is refused."""
    case = Case(swap_case().splats, moves(**dict.fromkeys(names, 0.01)))
    with pytest.raises(ValueError, match=f"one parameter, not {len(names)}"):
        case.bounds(case.poses.box, 2)


@both_orders
def test_tile_cut(order):
    """A layer reaches the second tile with its 3-sigma square at some poses only."""
    splats = scene({"mean": (-2.8125, 0.0, -5.0), "scale": 0.78, "opacity": 1.0}, background=(0.5, 0.0, 0.0))
    case = Case(splats, moves(x=0.15), camera(32, 16))
    jumps = np.array([case.image(v)[:, 16].max(axis=0) for v in case.samples(case.poses.box, 41)])
    assert np.abs(np.diff(jumps, axis=0)).max() > 3e-3
    case.check(order, parts=1, count=41)
    case.check(order, parts=4)


@both_orders
def test_tile_cut_vertical(order):
    splats = scene({"mean": (0.0, 2.8125, -5.0), "scale": 0.78, "opacity": 1.0}, background=(0.5, 0.0, 0.0))
    Case(splats, moves(y=0.15), camera(16, 32)).check(order, parts=1, count=41)


@both_orders
def test_alpha_threshold(order):
    """Layers whose alpha crosses 1/255 at most pixels."""
    splats = scene(
        {"mean": (0.3, 0.0, -5.0), "scale": 1.0, "opacity": 0.006},
        {"mean": (-0.2, 0.2, -6.0), "scale": 0.7, "opacity": 0.02},
    )
    width, sampled = Case(splats, moves(x=0.1)).check(order, parts=2, count=15)
    assert sampled.max() > 1 / 256 and width.max() < 0.02


@both_orders
def test_one_layer(order):
    """One layer that hides and uncovers a background of another colour."""
    splats = scene(
        {"mean": (0.0, 0.0, -5.0), "scale": 0.7, "opacity": 0.9, "color": (1.0, 0.0, 0.5)}, background=(0.0, 1.0, 0.5)
    )
    width, sampled = Case(splats, moves(x=0.1)).check(order, parts=2)
    assert width.mean() < 1.5 * sampled.mean()


@both_orders
def test_alpha_threshold_of_all(order):
    """The whole layer is below the threshold at some poses."""
    # the mean crosses the centre of pixel (8, 8), and nowhere else is alpha large enough
    splats = scene({"mean": (0.0, -0.15625, -5.0), "scale": 0.01, "opacity": 0.00396}, background=(0.3, 0.3, 0.3))
    _, sampled = Case(splats, moves(x=0.3)).check(order, parts=1, count=61)
    assert np.argwhere(sampled[..., 0]).tolist() == [[8, 7], [8, 8]]


@pytest.mark.parametrize("antialiased", [False, True], ids=["classic", "antialiased"])
@pytest.mark.parametrize(
    "order, limits, most, off",
    [
        (2, {"x": 0.03}, 1.05, 9.1e-5),
        (1, {"x": 0.02, "yaw": 0.004}, 1.18, 2.35e-4),
        (1, dict.fromkeys("xyz", 0.02), 1.18, 2.31e-4),
    ],
    ids=["one", "two", "three"],
)
def test_many_layers_at_the_threshold(order, limits, most, off, antialiased):
    """A hundred faint layers, of which any may be skipped: bounds know where each is (B11)."""
    generator = np.random.default_rng(3)
    layers = [
        {
            "mean": (*generator.uniform(-1.2, 1.2, 2), generator.uniform(-7.0, -5.0)),
            "scale": generator.uniform(0.15, 0.3),
            "opacity": generator.uniform(0.02, 0.06),
            "color": tuple(generator.random(3)),
        }
        for _ in range(100)
    ]
    case = Case(scene(*layers, background=(0.5, 0.4, 0.6), antialiased=antialiased), moves(**limits))
    width, sampled = case.check(order, parts=2, count=60)
    # without regard to where each is skipped: 1.12, 1.31 and 1.25
    assert width.mean() < most * sampled.mean()
    # so do linear sets, whose radii would be 9.65e-5, 2.46e-4 and 2.38e-4
    parts = [case.bounds(box, order, keep_linear=True) for box in case.poses.box.split(0, 2)]
    assert np.mean([cell.linear[..., -1].mean() for cell in parts]) < off


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("order, names", [(1, ("x",)), (2, ("x",)), (1, ("x", "yaw", "roll"))])
def test_extent_counts_every_error(order, antialiased, names):
    """What a record says of how far its forms may be from their centres covers all terms, the float error too."""
    places = np.random.default_rng(5).uniform(-1.0, 1.0, (70, 2))
    splats = scene(
        *({"mean": (*place, -6.0), "scale": 0.3, "opacity": 0.9, "quat": TURN} for place in places),
        antialiased=antialiased,
    )
    case = Case(splats, moves(**dict.fromkeys(names, 0.01)))
    bounds = SplatBounds(splats, GSPLAT_1_4_0, FLOAT32)
    forms = case.poses.enclosure(case.poses.box, order)
    bounds.cell(case.camera, forms)
    m = forms.rotation.basis.monomials
    width = columns(6 if antialiased else 5, m)
    record = bounds._buffer("record", (70, width))
    assert (record[:, UNBOUNDED] == 0.0).all() and width % 8 == 0
    for f in range(5):
        form = record[:, FORMS + f * (m + 1) : FORMS + (f + 1) * (m + 1)]
        spread = np.abs(form[:, 1:]).sum(axis=1)
        assert (record[:, SPREAD + f] >= spread * (1.0 - 1e-14)).all()
        assert (record[:, SPREAD + f] <= spread * (1.0 + 1e-14) + 1e-14 * np.abs(form[:, 0])).all()


@both_orders
def test_alpha_clamp(order):
    """Opacity 1: alpha stays at 0.999, so that a thousandth of a bright background remains."""
    # the mean falls on the centre of pixel (8, 8)
    mean = (0.15625, -0.15625, -5.0)
    splats = scene({"mean": mean, "scale": 3.0, "opacity": 1.0, "color": (0.0, 0.5, 1.0)}, background=(1.0, 1.0, 0.0))
    case = Case(splats, moves(x=0.01))
    assert case.image(np.zeros(1))[8, 8, 0] == pytest.approx(0.001, abs=1e-5)
    width, _ = case.check(order, parts=1)
    assert width[8, 8].max() < 2.5e-3


@both_orders
def test_alpha_clamp_crossed(order):
    """Alpha leaves the clamp within the cell."""
    mean = (0.15625, -0.15625, -5.0)
    splats = scene({"mean": mean, "scale": 0.9, "opacity": 1.0, "color": (0.0, 0.5, 1.0)}, background=(1.0, 1.0, 0.0))
    width, sampled = Case(splats, moves(x=0.2)).check(order, parts=1)
    assert sampled[8, 8, 0] > 0.01 and width[8, 8, 0] < 1.5 * sampled[8, 8, 0]


def stop_scene(opacity: float) -> Splats:
    return scene(
        {"mean": (0.0, 0.0, -5.0), "scale": 2.0, "opacity": opacity, "color": (0.1, 0.0, 0.0)},
        {"mean": (0.1, 0.0, -6.0), "scale": 2.0, "opacity": opacity, "color": (0.0, 0.2, 0.0)},
        {"mean": (0.0, 0.1, -7.0), "scale": 2.0, "opacity": 0.9, "color": (9.0, 9.0, 9.0)},
        background=(0.0, 1.0, 1.0),
    )


@both_orders
def test_stop(order):
    """Two layers reach a transmittance of 1e-4 at some poses; a bright one stands behind them."""
    case = Case(stop_scene(0.9902), moves(x=0.3))
    middle = [case.image(v)[8, 8] for v in case.samples(case.poses.box, 15)]
    assert np.abs(np.diff(middle, axis=0)).max() > 1e-3
    for floor in (-1.0, 0.003, 0.2):
        case.check(order, parts=1, count=21, floor=floor)
        case.check(order, parts=4, count=5, floor=floor)


@both_orders
def test_stop_everywhere(order):
    """The second layer stops every pose at the middle pixel: it is never drawn."""
    case = Case(stop_scene(0.998), moves(x=0.02))
    width, _ = case.check(order, parts=1)
    assert width[8, 8].max() < 0.1


@both_orders
def test_stop_and_swap(order):
    """The two layers that end the light change places as well."""
    splats = scene(
        {"mean": (0.05, -0.15625, -5.0), "scale": 2.0, "opacity": 0.9915, "color": (1.0, 0.0, 0.0)},
        {"mean": (0.25, -0.15625, -5.0), "scale": 2.0, "opacity": 0.9915, "color": (0.0, 1.0, 0.0)},
        {"mean": (0.0, 0.1, -7.0), "scale": 2.0, "opacity": 0.9, "color": (0.5, 0.5, 0.5)},
        background=(0.0, 0.0, 1.0),
    )
    case = Case(splats, moves(yaw=0.02))
    middle = [case.image(v)[8, 8, 2] for v in case.samples(case.poses.box, 15)]
    assert max(middle) > 5e-3
    for floor in (-1.0, 0.003, 0.2):
        case.check(order, parts=1, count=25, floor=floor)


@both_orders
def test_a_stop_hides_no_more_than_lies_behind_it(order):
    """The brightest layer lies in front of the two that end the light."""
    splats = scene(
        {"mean": (0.0, 0.1, -4.0), "scale": 2.0, "opacity": 0.3, "color": (2.0, 2.0, 2.0)},
        {"mean": (0.1, 0.0, -5.0), "scale": 2.0, "opacity": 0.992, "color": (0.1, 0.0, 0.0)},
        {"mean": (0.1, 0.0, -6.0), "scale": 2.0, "opacity": 0.992, "color": (0.4, 0.2, 0.6)},
        {"mean": (0.0, 0.1, -7.0), "scale": 2.0, "opacity": 0.9, "color": (0.3, 0.9, 0.1)},
        background=(0.0, 0.5, 0.1),
    )
    case = Case(splats, moves(x=0.05))
    middle = [case.image(v)[8, 8] for v in case.samples(case.poses.box, 15)]
    assert np.abs(np.diff(middle, axis=0)).max() > 1e-3
    for arithmetic in (REAL, FLOAT32):
        width, sampled = case.check(order, parts=1, count=21, arithmetic=arithmetic)
        # a stop leaves up to 0.012 of the light, and the brightest layer is 1.5 brighter than the background
        assert (width[8, 8] < 1.7 * sampled[8, 8]).all() and sampled[8, 8].max() < 0.005
        case.check(order, parts=4, count=5, arithmetic=arithmetic, floor=0.003)


@both_orders
@pytest.mark.parametrize("seed", range(4))
def test_stops_in_random_stacks(order, seed):
    random = np.random.default_rng(seed)
    stack = [
        {
            "mean": (*random.uniform(-0.2, 0.2, 2), -5.0 - 0.05 * k), "scale": random.uniform(1.0, 3.0),
            "opacity": random.uniform(0.9, 0.995), "color": random.uniform(0.0, 1.5, 3),
        }
        for k in range(7)
    ]  # fmt: skip
    splats = scene(*stack, background=random.uniform(0.0, 1.0, 3))
    for limits in ({"x": 0.1}, {"yaw": 0.1}):
        case = Case(splats, moves(**limits), camera(8, 8, 8.0))
        for parts in (1, 8, 64):
            case.check(order, parts=parts, count=5)


def dim_case(background: float, moving: bool) -> Case:
    """A stack of layers that dims the light to 1e-3 half of the way."""
    places = [(0.02 * k, -0.01 * k, -4.0 - 0.3 * k) for k in range(20)]
    colors = [(0.1 * k, 0.2, 2.0 - 0.1 * k) for k in range(20)]
    stack = [
        {"mean": place, "scale": 4.0, "opacity": 0.5, "color": color}
        for place, color in zip(places, colors, strict=True)
    ]
    ranges = moves(x=0.05) if moving else moves(yaw=0.01)
    return Case(scene(*stack, background=(background,) * 3), ranges, camera(8, 8, 8.0))


@both_orders
@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("background", [0.0, 1.0])
def test_layers_in_dim_light_are_left_out(order, moving, background):
    """What little light comes to may have any colour that is there: fewer layers, and hardly wider bounds."""
    case = dim_case(background, moving)
    full, _ = case.check(order, parts=1, count=5)
    before = case.bounds(case.poses.box, order).statistics[1]
    for floor in (5e-3, 0.02, 0.1):
        width, _ = case.check(order, parts=1, count=5, floor=floor)
        # no colour is farther than 2 from the background
        assert (width <= full + 2.1 * floor).all() and (width > full).any()
        layers = case.bounds(case.poses.box, order, floor=floor).statistics[1]
        assert layers < before
        before = layers


@both_orders
def test_left_out_layers_that_swap_with_listed_ones(order):
    """No layer is left out that may come before one that counts."""
    splats = scene(
        {"mean": (0.0, 0.0, -4.0), "scale": 2.0, "opacity": 0.9, "color": (0.2, 0.0, 0.0)},
        {"mean": (-0.4, 0.0, -5.0), "scale": 0.8, "opacity": 0.9, "color": (1.0, 0.1, 0.0)},
        {"mean": (0.4, 0.1, -5.0), "scale": 0.8, "opacity": 0.95, "color": (0.0, 0.9, 1.0)},
        {"mean": (0.4, 0.1, -6.0), "scale": 2.0, "opacity": 0.9, "color": (9.0, 0.9, 1.0)},
        background=(0.2, 0.3, 0.4),
    )
    case = Case(splats, moves(yaw=0.05), camera(8, 8, 8.0))
    for floor in (0.003, 0.02, 0.2):
        case.check(order, parts=1, floor=floor)


@both_orders
def test_layers_that_were_left_out_are_there_for_cells_inside(order):
    """A cell lists for its parts what it left out itself; only what no pose shows is missing there."""
    case = dim_case(1.0, True)
    box = case.poses.box
    visible = case.bounds(box, order, floor=0.1).visible
    assert visible.size == 20
    part = box.split(0, 4)[0]
    cell = case.bounds(part, order, candidates=visible.astype(np.int32))
    lower, upper = assemble(cell.lower, case.camera), assemble(cell.upper, case.camera)
    for values in case.samples(part, 9):
        image = case.image(values)
        assert (lower <= image).all() and (image <= upper).all()


@pytest.mark.parametrize("rasteriser", [GSPLAT_1_4_0, PAPER])
def test_a_frame_leaves_out_what_little_light_comes_to_as_far_as_that_is_allowed(rasteriser):
    case = dim_case(1.0, True)
    frame = SplatFrame(case.splats, rasteriser, FLOAT32, case.poses)
    part, tiles, gaps = case.poses.box.split(0, 8)[0], np.arange(frame.tile_count), []
    for excess in (0.0, 1e-6, 0.01, 1.0, 0.0):
        frame.set_tolerance(excess)
        bounds = frame.bound(part, tiles)
        gaps.append(float((bounds.upper - bounds.lower).mean()))
    assert gaps[0] == gaps[1] == gaps[4]
    if rasteriser is PAPER:
        # without a stop nobody knows how many layers there are behind
        assert gaps[0] == gaps[2] == gaps[3]
    else:
        assert gaps[0] < gaps[2] < gaps[0] + 0.01
        assert gaps[2] < gaps[3] < gaps[0] + 0.02


def test_colors_are_shared_by_cells_that_turn_and_not_by_others():
    """Cells seen from the same place have the same colours; from another one they do not."""
    sh = np.random.default_rng(1).normal(0.0, 0.4, (6, 4, 3))
    splats = scene(*({"mean": (0.3 * k - 0.8, 0.0, -4.0), "scale": 0.3, "opacity": 0.7, "sh": sh[k]} for k in range(6)))
    here, there = (
        PoseBox.around(camera(position=place), moves(yaw=0.05)) for place in ((0.0, 0.0, 0.0), (0.5, 0.2, -1.0))
    )
    kept = SplatBounds(splats, GSPLAT_1_4_0, FLOAT32)
    for poses in (here, here, there, here):
        for box in (*poses.box.split(0, 2), poses.box):
            for candidates in (None, np.arange(1, 6, dtype=np.int32)):
                forms = poses.enclosure(box, 2)
                found, fresh = (
                    bounds.cell(poses.camera, forms, candidates=candidates)
                    for bounds in (kept, SplatBounds(splats, GSPLAT_1_4_0, FLOAT32))
                )
                assert (found.lower == fresh.lower).all() and (found.upper == fresh.upper).all()
                assert (found.visible == fresh.visible).all() and (found.reach == fresh.reach).all()


@both_orders
def test_near_plane(order):
    """A layer passes the near plane."""
    splats = scene(
        {"mean": (0.0, 0.0, -0.05), "scale": 0.004, "opacity": 0.9, "color": (1.0, 0.2, 0.0)},
        {"mean": (0.0, 0.0, -3.0), "scale": 0.5, "opacity": 0.5, "color": (0.0, 0.4, 1.0)},
    )
    case = Case(splats, moves(z=(-0.06, 0.0)))
    case.check(order, parts=1, count=31)
    case.check(order, parts=3)


@both_orders
def test_near_plane_alone(order):
    """A single layer, large enough to be seen on both sides of the near plane."""
    splats = scene({"mean": (0.0, 0.0, -0.02), "scale": 0.004, "opacity": 0.9}, background=(0.0, 0.5, 0.0))
    case = Case(splats, moves(z=(-0.014, -0.002)))
    assert case.image(np.array([-0.0139])).max() < 0.6 < case.image(np.array([-0.005])).max()
    case.check(order, parts=1, count=25)


@pytest.mark.parametrize("antialiased", [False, True])
@both_orders
def test_what_passes_the_near_plane_is_projected(order, antialiased):
    """One layer that is never in the picture, one that is: cells that straddle the plane are as tight as others."""
    aside = {"mean": (1.0, 1.0, -0.02), "scale": (0.17, 0.02, 0.06), "opacity": 0.97}
    seen = {"mean": (0.001, 0.0, -0.02), "scale": 0.004, "opacity": 0.9, "color": (0.2, 0.9, 0.1)}
    for layer, most in ((aside, 1e-9), (seen, 0.05)):
        case = Case(scene(layer, background=(0.4, 0.5, 0.6), antialiased=antialiased), moves(z=(-0.0101, -0.0099)))
        assert case.poses.box.lower[0] < -0.01 < case.poses.box.upper[0]
        for parts in (1, 3):
            width, sampled = case.check(order, parts, count=31)
            assert (width - sampled).max() < most
        assert (sampled.max() > 0.2) == (layer is seen)


@both_orders
def test_behind(order):
    """A large layer behind the camera is not drawn, and in front of it is."""
    splats = scene({"mean": (0.0, 0.0, 0.3), "scale": 0.5, "opacity": 0.9})
    Case(splats, moves(yaw=(0.0, math.pi))).check(order, parts=3, count=8)


@both_orders
def test_jacobian_clamp(order):
    """A large layer outside the view, where the Jacobian is evaluated at the margin."""
    splats = scene({"mean": (1.62, 0.1, -2.4), "scale": (0.5, 0.3, 0.9), "quat": TURN, "opacity": 0.95})
    case = Case(splats, moves(yaw=0.1))
    width, sampled = case.check(order, parts=4, count=8)
    assert sampled.max() > 0.05 and width.mean() < 3.0 * sampled.mean()


@both_orders
def test_jacobian_clamp_all_sides(order):
    """The four margins, from far outside."""
    splats = scene(
        *({"mean": mean, "scale": (0.9, 0.5, 0.7), "quat": TURN, "opacity": 0.8, "color": color}
          for mean, color in (
              ((-2.4, 0.1, -2.0), (1.0, 0.0, 0.0)), ((2.4, 0.2, -2.0), (0.0, 1.0, 0.0)),
              ((0.1, -2.4, -2.0), (0.0, 0.0, 1.0)), ((0.2, 2.4, -2.0), (1.0, 1.0, 0.0)),
          ))
    )  # fmt: skip
    Case(splats, moves(z=0.02)).check(order, parts=1)


@both_orders
def test_antialiased(order):
    """Layers thinner than a pixel, whose opacity is compensated."""
    splats = scene(
        {"mean": (0.1, 0.0, -4.0), "scale": (0.05, 0.1, 0.02), "quat": TURN, "opacity": 0.95, "color": (1.0, 0.3, 0.0)},
        {"mean": (-0.3, 0.3, -5.0), "scale": 0.2, "opacity": 0.9, "color": (0.0, 1.0, 0.6)},
        background=(0.1, 0.1, 0.3),
        antialiased=True,
    )
    width, sampled = Case(splats, moves(z=0.2)).check(order, parts=2)
    assert sampled.max() > 1e-3 and width.mean() < 5.0 * sampled.mean()


@both_orders
@pytest.mark.parametrize("degree", [1, 2, 3])
def test_view_dependence(degree, order):
    """Colours that turn with the direction from a camera that moves."""
    generator = np.random.default_rng(degree)
    splats = scene(
        *({"mean": mean, "scale": 0.5, "opacity": 0.9, "sh": generator.normal(size=((degree + 1) ** 2, 3)) * 0.6}
          for mean in ((0.2, 0.1, -1.5), (-0.3, -0.1, -2.0)))
    )  # fmt: skip
    case = Case(splats, moves(x=0.4))
    width, sampled = case.check(order, parts=4, count=7)
    assert width.mean() < 4.0 * sampled.mean()


@both_orders
def test_view_dependence_alone(order):
    """A layer that covers the picture evenly: what changes is its colour."""
    generator = np.random.default_rng(5)
    splats = scene(
        {"mean": (0.0, 0.0, -2.0), "scale": 60.0, "opacity": 0.9, "sh": generator.normal(size=(16, 3)) * 0.15}
    )
    case = Case(splats, moves(x=0.5), camera(8, 8))
    width, sampled = case.check(order, parts=3, count=9)
    assert width.mean() < 3.0 * sampled.mean()


@both_orders
def test_turning_colors(order):
    """A camera that turns on the spot sees every Gaussian in its one colour."""
    generator = np.random.default_rng(4)
    splats = scene({"mean": (0.2, 0.1, -1.5), "scale": 0.3, "opacity": 0.9, "sh": generator.normal(size=(16, 3)) * 0.4})
    Case(splats, moves(yaw=0.1)).check(order, parts=1)


@both_orders
def test_needle(order):
    """Long thin layers in several directions."""
    splats = scene(
        {"mean": (0.0, 0.0, -4.0), "scale": (2.0, 1e-3, 1e-3), "quat": TURN, "opacity": 0.95, "color": (1.0, 0.0, 0.2)},
        {"mean": (0.3, 0.1, -4.5), "scale": (1e-4, 3.0, 0.01), "quat": (0.7, -0.2, 0.5, 0.4), "opacity": 0.9},
        background=(0.0, 0.2, 0.2),
    )
    case = Case(splats, moves(x=0.02))
    case.check(order, parts=2)
    for motion in (moves(y=0.02), moves(roll=0.05)):
        case.poses = PoseBox.around(case.camera, motion)
        case.check(order, parts=2)


def permuted(splats: Splats, order: list[int]) -> Splats:
    return replace(
        splats, means=splats.means[order], axes=splats.axes[order], opacity=splats.opacity[order], sh=splats.sh[order]
    )


@both_orders
def test_ties(order):
    """Exactly equal depths: the bounds hold whichever layer the sort puts first, but for those of one mean."""
    splats = scene(
        {"mean": (0.0, 0.0, -4.0), "scale": 0.5, "opacity": 0.9, "color": (1.0, 0.0, 0.0)},
        {"mean": (0.0, 0.0, -4.0), "scale": 0.6, "opacity": 0.8, "color": (0.0, 1.0, 0.0)},
        {"mean": (0.3, 0.1, -4.0), "scale": 0.4, "opacity": 0.7, "color": (0.0, 0.0, 1.0)},
    )
    perturbation = moves(x=0.05)
    case = Case(splats, perturbation)
    cell = case.bounds(case.poses.box, order)
    lower, upper = assemble(cell.lower, case.camera), assemble(cell.upper, case.camera)
    images = []
    for arrangement in ([0, 1, 2], [2, 0, 1], [0, 2, 1]):
        other = Case(permuted(splats, arrangement), perturbation)
        for values in case.samples(case.poses.box, 5):
            image = other.image(values)
            assert (lower <= image).all() and (image <= upper).all(), worst(lower, image, upper)
        images.append(image)
    assert np.abs(images[0] - images[1]).max() > 0.1


@both_orders
@pytest.mark.parametrize("name", ["x", "yaw"])
def test_coincident(order, name):
    """Gaussians of one mean keep the order of their numbers, however many there are."""
    generator = np.random.default_rng(0)
    values = generator.uniform(size=(300, 7))
    splats = scene(
        *(
            {"mean": (0.1, 0.05, -4.0), "scale": 0.2 + 0.4 * v[:3], "opacity": 0.9 * v[3], "color": v[4:]}
            for v in values
        )
    )
    case = Case(splats, moves(**{name: 0.01}))
    cell = case.bounds(case.poses.box, order)
    assert cell.statistics[2] == 0 and cell.statistics[3] == 0
    width, sampled = case.check(order, parts=2, count=5)
    assert width.mean() < 1.5 * sampled.mean()
    backward = Case(permuted(splats, range(299, -1, -1)), moves())
    assert np.abs(backward.image(np.empty(0)) - Case(splats, moves()).image(np.empty(0))).max() > 0.1


def test_nearly_coincident():
    """Means that differ by less than their differences to the camera can tell have no certain order."""
    near = {"scale": 0.5, "opacity": 0.9, "color": (1.0, 0.0, 0.0)}
    splats = scene({"mean": (0.0, 0.0, -4.0), **near}, {**near, "mean": (0.0, 1e-30, -4.0), "color": (0.0, 1.0, 0.0)})
    case = Case(splats, moves(x=0.01), camera(position=(0.0, 0.125, 0.0)))
    assert case.bounds(case.poses.box, 2).statistics[2] > 0


@both_orders
def test_layers_apart_have_no_order(order):
    """Gaussians of one block and one depth count as a pair where they share a pixel, and only there."""
    dot, colors = {"scale": 0.05, "opacity": 0.9}, ((1.0, 0.5, 0.0), (0.0, 0.5, 1.0))
    for column, pairs in ((6.5, 0), (2.5, 1)):
        # pixel = 8 + 16 x / 5
        places = [((1.5 - 8.0) * 5.0 / 16.0, 2.0, -5.0), ((column - 8.0) * 5.0 / 16.0, 2.0, -5.0)]
        dots = (dot | {"mean": place, "color": color} for place, color in zip(places, colors, strict=True))
        case = Case(scene(*dots), moves(yaw=0.01))
        assert case.bounds(case.poses.box, order).statistics[2] == pairs
        case.check(order, parts=1)


def test_sorting_of_a_group():
    """Keys end in order, each beside the place where it stood."""
    rng = np.random.default_rng(0)
    for count in (0, 1, 2, 3, 7, 50, 400):
        for values in (rng.random(count), np.round(4.0 * rng.random(count)), np.arange(count, 0.0, -1.0)):
            keys, order = np.append(values, -1.0), np.full(count + 1, -7)
            sort_group(keys, order, count)
            assert np.array_equal(keys[:count], np.sort(values)) and np.array_equal(values[order[:count]], keys[:count])
            assert sorted(order[:count].tolist()) == list(range(count)) and (keys[count], order[count]) == (-1.0, -7)


POINTS = {
    "none": moves(),
    "six": moves(x=(0.02, 0.02), y=(-0.1, -0.1), z=(0.3, 0.3), yaw=(0.1, 0.1), pitch=(-0.05, -0.05), roll=(1.0, 1.0)),
}


def quiet_scene(antialiased: bool = False) -> Splats:
    """Layers with no rule near its switch."""
    return scene(
        {"mean": (0.11, 0.02, -4.0), "scale": (1.9, 1.4, 1.7), "quat": TURN, "opacity": 0.6, "color": (0.9, 0.2, 0.1)},
        {"mean": (-0.23, 0.17, -5.0), "scale": 1.8, "opacity": 0.5, "color": (0.1, 0.7, 0.3)},
        {"mean": (0.05, -0.3, -6.0), "scale": (2.5, 1.8, 2.2), "opacity": 0.7, "color": (0.3, 0.1, 0.8)},
        background=(0.25, 0.5, 0.75),
        antialiased=antialiased,
    )


@pytest.mark.parametrize("name", POINTS)
@pytest.mark.parametrize("antialiased", [False, True])
def test_one_pose(name, antialiased):
    """A single pose in real arithmetic: the bounds are the render, up to rounding."""
    case = Case(quiet_scene(antialiased), POINTS[name])
    image = case.image(np.empty(0))
    for arithmetic, limit in ((REAL, 1e-6), (FLOAT32, 1e-2)):
        cell = case.bounds(case.poses.box, 1, arithmetic)
        lower, upper = assemble(cell.lower, case.camera), assemble(cell.upper, case.camera)
        assert (lower <= image).all() and (image <= upper).all()
        assert (upper - lower).max() <= limit


def test_zero_width_cell():
    """The same with parameters whose cell has shrunk to a point."""
    case = Case(quiet_scene(), moves(x=0.1, yaw=0.1))
    box = case.poses.box.replace(0, 0.05, 0.05).replace(1, -0.03, -0.03)
    image = case.image(np.array([0.05, -0.03]))
    cell = case.bounds(box, 1)
    lower, upper = assemble(cell.lower, case.camera), assemble(cell.upper, case.camera)
    assert (lower <= image).all() and (image <= upper).all() and (upper - lower).max() <= 1e-6


def test_six_parameters():
    case = Case(quiet_scene(), moves(x=0.01, y=0.01, z=0.01, yaw=0.005, pitch=0.005, roll=0.005), camera(8, 8, 8.0))
    width, sampled = case.check(1, parts=1, count=12)
    assert width.mean() < 4.0 * sampled.mean()


def test_second_order_is_tighter():
    case = Case(quiet_scene(), moves(x=0.05))
    widths = [case.check(order, parts=2, count=3)[0].mean() for order in (1, 2)]
    assert widths[1] <= widths[0]


def test_narrower_cells_are_tighter():
    """Widths fall to the sampled ones: within a few per cent from sixteen cells."""
    case = Case(quiet_scene(), moves(x=0.1), camera(8, 8, 8.0))
    ratios = []
    for parts in (1, 4, 16):
        width, sampled = case.check(2, parts=parts, count=3)
        ratios.append(width.mean() / sampled.mean())
    assert ratios[0] >= ratios[1] >= ratios[2] and ratios[2] < 1.02


@both_orders
def test_float32_is_wider(order):
    """What a float32 program may show includes what exact evaluation shows."""
    case = swap_case()
    real, single = case.bounds(case.poses.box, order, REAL), case.bounds(case.poses.box, order, FLOAT32)
    assert (single.lower <= real.lower).all() and (single.upper >= real.upper).all()


@pytest.mark.parametrize(
    "parameters, order",
    [
        (moves(x=0.05), 1),
        (moves(x=0.05), 2),
        (moves(yaw=0.02), 1),
        (moves(yaw=0.02), 2),
        (moves(x=0.02, roll=0.05), 1),
        (moves(x=0.05, y=0.04), 1),
        (moves(x=0.02, y=0.02, z=0.04, yaw=0.01, pitch=0.01, roll=0.02), 1),
    ],
    ids=["x-1", "x-2", "yaw-1", "yaw-2", "two-1", "shifts-1", "six-1"],
)
def test_linear(parameters, order):
    """The linear sets hold the picture before it is clamped, colours above 1 included."""
    bright = scene(
        {"mean": (-0.3, 0.0, -5.0), "scale": 0.8, "opacity": 0.9, "color": (4.0, 0.1, 0.0)},
        {"mean": (0.3, 0.1, -5.0), "scale": 0.8, "opacity": 0.7, "color": (0.0, 0.9, 2.5)},
        background=(0.5, 0.5, 3.0),
    )
    case = Case(bright, parameters)
    # the picture is linear in the colours; scaled by a power of two it is not clamped
    dark = Case(replace(bright, sh=bright.sh / 8.0, background=bright.background / 8.0), parameters)
    box = case.poses.box
    cell = case.bounds(box, order, keep_linear=True)
    linear = assemble(cell.linear, case.camera)
    basis = case.poses.enclosure(box, order).rotation.basis
    assert linear.shape == (16, 16, 3, basis.monomials + 1)
    generator = np.random.default_rng(1)
    brightest = 0.0
    for scaled in [np.ones(box.dimensions), -np.ones(box.dimensions), *generator.uniform(-1, 1, (6, box.dimensions))]:
        image = 8.0 * dark.image(box.at(scaled))
        brightest = max(brightest, image.max())
        point = [1.0, *scaled, *(scaled[k] * scaled[l] for k, l in basis.pairs)]
        error = np.abs(linear[..., :-1] @ point - image)
        assert (error <= linear[..., -1] + 1e-14).all()
    assert brightest > 1.5


@pytest.mark.parametrize("antialiased", [False, True], ids=["classic", "antialiased"])
@pytest.mark.parametrize(
    "parameters, most",
    [
        (moves(x=0.04, y=0.04), 1.6),
        (moves(x=0.03, y=0.03, z=0.05), 1.7),
        (moves(**dict.fromkeys("xyz", 0.01), yaw=0.004, pitch=0.004, roll=0.01), 3.0),
    ],
    ids=["two", "three", "six"],
)
def test_curvature_of_several_parameters(parameters, most, antialiased):
    """Linear sets are not much wider than what the pictures differ from linear functions by (design.md, B10)."""
    layers = scene(
        {"mean": (-0.3, 0.0, -5.0), "scale": 0.8, "opacity": 0.9, "color": (0.9, 0.1, 0.0)},
        {"mean": (0.3, 0.1, -6.0), "scale": 0.9, "opacity": 0.7, "color": (0.0, 0.9, 0.5)},
        {"mean": (0.0, -0.2, -7.0), "scale": 1.5, "opacity": 0.8, "color": (0.2, 0.2, 0.9)},
    )
    case = Case(replace(layers, antialiased=antialiased), parameters, camera(8, 8, 16.0))
    box = case.poses.box
    linear = assemble(case.bounds(box, 1, REAL, keep_linear=True).linear, case.camera)
    generator = np.random.default_rng(2)
    places = [*itertools.product((-1.0, 1.0), repeat=box.dimensions), *generator.uniform(-1, 1, (60, box.dimensions))]
    images = np.stack([case.image(box.at(np.array(place))) for place in places])
    polynomials = np.column_stack([np.ones(len(places)), places])
    off = images - np.einsum("pk,...k->p...", polynomials, linear[..., :-1])
    assert (np.abs(off) <= linear[..., -1] + 1e-14).all()
    assert 2.0 * linear[..., -1].mean() < most * (off.max(axis=0) - off.min(axis=0)).mean()


def test_wanted_tiles():
    """Bounds of chosen tiles and candidates are those of the whole picture."""
    splats = scene(
        {"mean": (-1.0, 0.0, -5.0), "scale": 0.5, "opacity": 0.9, "color": (1.0, 0.0, 0.0)},
        {"mean": (1.5, 0.0, -5.0), "scale": 0.5, "opacity": 0.9, "color": (0.0, 1.0, 0.0)},
        {"mean": (0.0, 50.0, -5.0), "scale": 0.5, "opacity": 0.9},
    )
    case = Case(splats, moves(x=0.1), camera(32, 16))
    whole = case.bounds(case.poses.box, 2)
    assert whole.visible.tolist() == [0, 1]
    part = case.bounds(case.poses.box, 2, wanted=np.array([1]), candidates=whole.visible)
    assert np.array_equal(part.lower[0], whole.lower[1]) and np.array_equal(part.upper[0], whole.upper[1])


@both_orders
def test_too_many_pairs(order, monkeypatch):
    """Where depth orders are not examined, nothing is claimed."""
    monkeypatch.setattr("ns_abstract.methods.splat.bounds.PAIR_LIMIT", 0)
    case = swap_case()
    cell = case.bounds(case.poses.box, order)
    assert cell.statistics[3] > 0
    assert (cell.lower <= 0.0).any() and (cell.upper >= 1.0).any()
    case.check(order, parts=1, count=3)


def test_inner_cells_leave_out_what_is_hidden():
    """What no pixel of a cell draws or stops at can be left out of the cells inside it."""
    generator = np.random.default_rng(5)
    wall = [
        {
            # no two depths are equal
            "mean": (x, y, -2.0 - 0.1 * layer - 0.01 * x - 0.017 * y),
            "scale": (0.12, 0.12, 0.01),
            "opacity": 0.998,
            "color": (0.2, 0.3, 0.4),
        }
        for layer in range(4)
        for x in np.arange(-1.2, 0.05, 0.1)
        for y in np.arange(-1.2, 1.25, 0.1)
    ]
    behind = [
        {"mean": (*generator.uniform(-1.5, 1.5, 2), -3.5), "scale": 0.15, "opacity": 0.8, "color": generator.random(3)}
        for _ in range(40)
    ]
    case = Case(scene(*wall, *behind), moves(x=0.003, y=0.003), camera(32, 32, 32.0))
    outer = case.bounds(case.poses.box, 1)
    count = len(wall) + len(behind)
    assert 0 < outer.visible.size < count
    # neither the wall's visible side nor what shows beside it is left out
    assert set(range(len(wall), count)) & set(outer.visible.tolist())
    for box in case.poses.box.split(1, 2):
        inner = case.bounds(box, 1, candidates=outer.visible)
        lower, upper = assemble(inner.lower, case.camera), assemble(inner.upper, case.camera)
        whole = case.bounds(box, 1)
        assert np.abs(inner.lower - whole.lower).max() < 1e-3 and np.abs(inner.upper - whole.upper).max() < 1e-3
        for values in case.samples(box, 30):
            image = case.image(values)
            assert (lower <= image).all() and (image <= upper).all(), worst(lower, image, upper)
