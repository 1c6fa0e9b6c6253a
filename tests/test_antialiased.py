"""Opacity compensated for the blur: what float32 makes of the factor lies inside its bounds, which are tight (G11)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ns_abstract.arithmetic.rounding import FLOAT32, REAL, UNIT32
from ns_abstract.bench.sets import open_jobs, pose_set, splat_of
from ns_abstract.bench.tightness import attack
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.geometry.tiles import assemble
from ns_abstract.methods.splat.activate import activate, rotation_matrices
from ns_abstract.methods.splat.bounds import SplatBounds
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0
from ns_abstract.methods.splat.frame import SplatFrame
from ns_abstract.methods.splat.projection_errors import FORMS, OPACITY_HIGH, OPACITY_LOW, UNBOUNDED, columns
from ns_abstract.methods.splat.reference import Reference
from ns_abstract.methods.splat.render import Renderer
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.perturbation.specification import Perturbation

torch.set_num_threads(1)
RUNS = Path(__file__).resolve().parents[2] / "shared" / "runs"
FOCAL, SIDE = 80.0, 24
CAMERA = PinholeCamera(np.concatenate([np.eye(3), np.zeros((3, 1))], 1), FOCAL, FOCAL, SIDE / 2, SIDE / 2, SIDE, SIDE)
#: Powers of ten of the standard deviations in pixels, least and most by axis.
SHAPES = {
    "thin": ((0.0, 1.3), (-4.0, -1.0), (-4.0, -1.0)),
    "flat": ((-0.3, 1.0), (-0.3, 1.0), (-5.0, -2.0)),
    "tiny": ((-3.0, 0.0), (-3.0, 0.0), (-3.0, 0.0)),
    "huge": ((1.0, 2.0), (0.8, 1.6), (0.5, 1.6)),
}
SETS = {
    "one pose": (Perturbation(), 1),
    "x": (Perturbation(translation={"x": (-0.01, 0.01)}), 2),
    "three": (
        Perturbation(translation={"x": (-0.003, 0.003)}, rotation={"yaw": (-2e-3, 2e-3), "roll": (0.0, 0.01)}),
        1,
    ),
}


def scene_of(
    shapes: tuple[str, ...], count: int, seed: int = 0, opacity: tuple[float, float] = (0.3, 0.99)
) -> SplatScene:
    """``count`` Gaussians of every shape, in random directions, in front of `CAMERA`."""
    random = np.random.default_rng(seed)
    n = count * len(shapes)
    depth = random.uniform(1.0, 4.0, n)
    powers = np.repeat(np.array([SHAPES[name] for name in shapes]), count, axis=0)
    pixels = 10.0 ** random.uniform(powers[..., 0], powers[..., 1])
    o = random.uniform(*opacity, n)
    place = random.uniform(-0.45, 0.45, (n, 2)) * SIDE / FOCAL * depth[:, None]
    return SplatScene(
        means=np.column_stack([place, -depth]).astype(np.float32),
        log_scales=np.log(pixels * depth[:, None] / FOCAL).astype(np.float32),
        quats=random.normal(size=(n, 4)).astype(np.float32),
        opacity_logits=np.log(o / (1.0 - o)).astype(np.float32),
        sh=random.uniform(-1.5, 1.5, (n, 1, 3)).astype(np.float32),
        background=np.array([0.1, 0.2, 0.3], np.float32),
        rasterize_mode="antialiased",
    )


@dataclass
class Rounded:
    """Numbers of a program whose every operation errs by up to a unit of float32, at random."""

    value: np.ndarray
    random: np.random.Generator

    def _of(self, value: np.ndarray) -> Rounded:
        return Rounded(value * (1.0 + UNIT32 * self.random.choice([-1.0, 0.0, 1.0], value.shape)), self.random)

    def __add__(self, other: Rounded | float) -> Rounded:
        return self._of(self.value + (other.value if isinstance(other, Rounded) else other))

    def __mul__(self, other: Rounded | float) -> Rounded:
        return self._of(self.value * (other.value if isinstance(other, Rounded) else other))

    def __sub__(self, other: Rounded) -> Rounded:
        return self._of(self.value - other.value)

    def __truediv__(self, other: Rounded) -> Rounded:
        return self._of(self.value / other.value)

    def root(self) -> Rounded:
        return self._of(np.sqrt(np.maximum(0.0, self.value)))


@dataclass
class Single:
    """Numbers of IEEE float32."""

    value: np.ndarray

    def __add__(self, other: Single | float) -> Single:
        return Single(self.value + (other.value if isinstance(other, Single) else np.float32(other)))

    def __mul__(self, other: Single | float) -> Single:
        return Single(self.value * (other.value if isinstance(other, Single) else np.float32(other)))

    def __sub__(self, other: Single) -> Single:
        return Single(self.value - other.value)

    def __truediv__(self, other: Single) -> Single:
        return Single(self.value / other.value)

    def root(self) -> Single:
        return Single(np.sqrt(np.maximum(np.float32(0.0), self.value)))


def product(a, b):
    """Products of matrices, given as lists of rows, from left to right."""
    return [[row[0] * b[0][j] + row[1] * b[1][j] + row[2] * b[2][j] for j in range(len(b[0]))] for row in a]


def transposed(a):
    return [list(row) for row in zip(*a, strict=True)]


def compensations(scene: SplatScene, number) -> np.ndarray:
    """[n] sqrt(max(0, det before / det after the blur)) at `CAMERA`'s pose (utils.cuh), in ``number``'s arithmetic."""
    # entries of rotations as float32 finds them, from exact ones
    turns = rotation_matrices(scene.quats.astype(np.float64)).astype(np.float32)
    scales = np.exp(scene.log_scales)
    axes = [[number(turns[:, r, k]) * number(scales[:, k]) for k in range(3)] for r in range(3)]
    flip = [[number(np.full(scene.count, v, np.float32)) for v in row] for row in np.diag([1.0, -1.0, -1.0])]
    covariance = product(product(flip, product(axes, transposed(axes))), transposed(flip))
    x, y, z = (number(v) for v in (scene.means * np.array([1, -1, -1], np.float32)).T)
    nothing, focal, one = (number(np.full(scene.count, v, np.float32)) for v in (0.0, FOCAL, 1.0))
    inverse = one / z
    limit = np.float32(1.3 * 0.5 * SIDE / FOCAL)
    assert np.abs(scene.means[:, :2] / scene.means[:, 2:]).max() < 0.99 * limit
    tx, ty = z * (x * inverse), z * (y * inverse)
    jacobian = [
        [focal * inverse, nothing, nothing - focal * tx * (inverse * inverse)],
        [nothing, focal * inverse, nothing - focal * ty * (inverse * inverse)],
    ]
    s = product(product(jacobian, covariance), transposed(jacobian))
    before = s[0][0] * s[1][1] - s[0][1] * s[1][0]
    after = (s[0][0] + 0.3) * (s[1][1] + 0.3) - s[0][1] * s[1][0]
    return (before / after).root().value.astype(np.float64)


def records(scene: SplatScene, poses: PoseBox, order: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Bounds [n] of the compensated opacity in float32, whether each Gaussian is unbounded, and whether it is drawn."""
    bounds = SplatBounds(activate(scene, GSPLAT_1_4_0), GSPLAT_1_4_0, FLOAT32)
    forms = poses.enclosure(poses.box, order)
    bounds.cell(CAMERA, forms, wanted=np.zeros(0, np.int64))
    m = forms.rotation.basis.monomials
    antialiased = scene.rasterize_mode == "antialiased"
    found = bounds._buffer("record", (scene.count, columns(6 if antialiased else 5, m))).copy()
    shown = bounds._buffer("state", (scene.count,), np.uint8) == 1
    form = found[:, FORMS + 5 * (m + 1) : FORMS + 6 * (m + 1)] if antialiased else np.zeros((scene.count, 1))
    spread = np.abs(form[:, 1:]).sum(axis=1)
    low = found[:, OPACITY_LOW] * np.exp(-form[:, 0] - spread)
    high = found[:, OPACITY_HIGH] * np.exp(-form[:, 0] + spread)
    return low, high, found[:, UNBOUNDED] != 0.0, shown


@pytest.mark.slow_cases
@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("shape", SHAPES)
def test_computed_factor(shape: str, name: str) -> None:
    """What float32 finds for each Gaussian's opacity, in IEEE arithmetic and with errors as large as they may be."""
    scene = scene_of((shape,), 150, seed=len(shape))
    perturbation, order = SETS[name]
    low, high, unbounded, shown = records(scene, PoseBox.around(CAMERA, perturbation), order)
    _, _, unbounded_without, _ = records(
        replace(scene, rasterize_mode="classic"), PoseBox.around(CAMERA, perturbation), order
    )
    assert (unbounded & shown).sum() <= unbounded_without.sum()
    opacity = 1.0 / (1.0 + np.exp(-scene.opacity_logits.astype(np.float64)))
    random = np.random.default_rng(1)
    for number in (Single, *[lambda v: Rounded(v.astype(np.float64), random)] * 6):
        value = opacity * compensations(scene, number)
        assert (value[~shown] < GSPLAT_1_4_0.alpha_min).all()
        assert (value[shown] <= np.where(unbounded, 1.0, high)[shown]).all()
        assert (value[shown] >= np.where(unbounded, 0.0, low)[shown]).all()
    if name == "one pose":
        # of what is drawn
        width = (high - low)[shown & ~unbounded]
        assert width.size == 0 or (np.median(width) < 2e-3 and width.max() < 0.1)


@pytest.mark.parametrize("name", SETS)
def test_pictures(name: str) -> None:
    """Pictures in float64 and float32 lie inside; float32's bounds are hardly wider than those of exact evaluation."""
    scene = scene_of(tuple(SHAPES), 20)
    perturbation, order = SETS[name]
    poses = PoseBox.around(CAMERA, perturbation)
    splats = activate(scene, GSPLAT_1_4_0)
    box = poses.box
    if box.dimensions:
        box = box.split(0, 4)[1]
    cells = [SplatBounds(splats, GSPLAT_1_4_0, a).cell(CAMERA, poses.enclosure(box, order)) for a in (REAL, FLOAT32)]
    (real_low, real_high), (low, high) = [[assemble(b, CAMERA) for b in (c.lower, c.upper)] for c in cells]
    renderer, single = Renderer(splats, GSPLAT_1_4_0), Reference(scene, dtype=torch.float32)
    corners = box.corners() if box.dimensions else np.empty((1, 0))
    for values in (*corners, *box.sample(5, np.random.default_rng(0))):
        image = renderer.image(CAMERA, *poses.world_to_camera(values))
        assert (real_low <= image).all() and (image <= real_high).all()
        assert (low <= image).all() and (image <= high).all()
        image = single.image(CAMERA, torch.from_numpy(poses.pose(values))).double().numpy()
        assert (low <= image).all() and (image <= high).all()
    assert (high - low).mean() < 1.05 * (real_high - real_low).mean() + 2e-3


@pytest.fixture
def run(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[Path, Path]:
    """A run's config.yml with the switch thrown, and its camera path."""
    if not RUNS.exists():
        pytest.skip("the shared runs are not beside the repository")
    (source,) = (RUNS / request.param / "splatfacto").iterdir()
    folder = tmp_path / source.name
    folder.mkdir()
    for file in source.iterdir():
        (folder / file.name).symlink_to(file)
    config = folder / "config.yml"
    text = config.read_text()
    assert "rasterize_mode: classic" in text
    config.unlink()
    config.write_text(text.replace("rasterize_mode: classic", "rasterize_mode: antialiased"))
    return config, RUNS / request.param / "camera_path.json"


@pytest.mark.slow
@pytest.mark.parametrize("run", ["playbot_lod3", "plant"], indirect=True)
def test_runs(run: tuple[Path, Path]) -> None:
    """A trained scene: one pose, and a set that moves the camera by 0.02."""
    gaps = {}
    for arithmetic in ("real", "float32"):
        (job,) = open_jobs((run[0],), run[1], 4.0, arithmetic)
        for name in ("point", "x"):
            poses, splat = pose_set(job, name, 0, 0.4), splat_of(job)
            frame = SplatFrame(splat.splats, splat.rasteriser, splat.arithmetic, poses)
            tiles = np.arange(frame.tile_count)
            lowest, highest = np.inf, -np.inf
            for box in poses.box.split(0, 8) if name == "x" else (poses.box,):
                found = frame.bound(box, tiles)
                low, high, image = (
                    assemble(v, frame.camera) for v in (found.lower, found.upper, frame.render(box.middle, tiles))
                )
                assert (low <= image).all() and (image <= high).all()
                lowest, highest = np.minimum(lowest, low), np.maximum(highest, high)
            gaps[arithmetic, name] = float((highest - lowest).mean())
    assert gaps["float32", "point"] < 1e-3
    assert gaps["float32", "x"] < 1.02 * gaps["real", "x"]


@pytest.mark.slow
@pytest.mark.parametrize("run", ["playbot_lod3"], indirect=True)
def test_attack(run: tuple[Path, Path]) -> None:
    """Refined float32 bounds against both renderers."""
    (job,) = open_jobs((run[0],), run[1], 8.0, "float32")
    row = attack(job, "x", 0, 600.0, 12, 4, 0, 0.4, 1.3)
    assert (row["violations"], row["not finite"]) == (0, 0)
