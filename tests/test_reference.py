"""The reference renderer against the compiled one, against gsplat's own torch code, and against itself altered."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ns_abstract.geometry.camera_path import PinholeCamera, load_camera_path
from ns_abstract.geometry.poses import rotation_about
from ns_abstract.methods.splat.activate import activate
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0, PAPER, Rasteriser
from ns_abstract.methods.splat.load import load_scene
from ns_abstract.methods.splat.reference import Projection, Reference, project, rotations, sh_colors
from ns_abstract.methods.splat.render import Renderer
from ns_abstract.methods.splat.scene import SplatScene

torch.set_num_threads(1)
RUNS = Path(__file__).resolve().parents[2] / "shared" / "runs"
FLIP = np.array([1.0, -1.0, -1.0])
KINDS = {
    "degree0": {},
    "degree1": {"degree": 1},
    "degree2": {"degree": 2},
    "degree3": {"degree": 3},
    "sigmoid": {"sigmoid": True},
    "antialiased": {"antialiased": True, "degree": 1},
    "small": {"scale": 0.004},
    "needles": {"needle": 5.0},
    "huge": {"scale": 0.25},
    "around": {"spread": 4.0, "degree": 2},
}


def camera_at(seed: int) -> PinholeCamera:
    """A camera with sides that no tile divides, two focal lengths and its principal point off the centre."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    rotation = rotation_about(axis / np.linalg.norm(axis), rng.uniform(0, np.pi))
    pose = np.concatenate([rotation, rng.uniform(-2, 2, (3, 1))], axis=1)
    return PinholeCamera(pose, 38.0, 43.0, 21.5, 15.25, 44, 35)


def make_scene(
    camera: PinholeCamera,
    seed: int,
    *,
    count: int = 150,
    degree: int = 0,
    sigmoid: bool = False,
    antialiased: bool = False,
    scale: float = 0.08,
    needle: float = 1.0,
    spread: float = 1.0,
) -> SplatScene:
    """Gaussians at depths 0.6 to 4, a tenth -0.5 to 0.6; ``spread`` times as wide as the image."""
    rng = np.random.default_rng(seed)
    z = np.where(rng.uniform(size=count) < 0.1, rng.uniform(-0.5, 0.6, count), rng.uniform(0.6, 4.0, count))
    reach = spread * np.abs(z) * 0.6
    points = np.stack([rng.uniform(-1, 1, count) * reach, rng.uniform(-1, 1, count) * reach, -z], axis=1)
    pose = camera.camera_to_world
    log_scales = np.log(scale) + rng.normal(0, 0.7, (count, 3))
    log_scales[:, 0] += needle - 1.0
    return SplatScene(
        means=(points @ pose[:, :3].T + pose[:, 3]).astype(np.float32),
        log_scales=log_scales.astype(np.float32),
        quats=rng.normal(size=(count, 4)).astype(np.float32),
        opacity_logits=rng.normal(-0.5, 2.5, count).astype(np.float32),
        sh=rng.normal(0, 0.6, (count, (degree + 1) ** 2, 3)).astype(np.float32),
        color_model="sigmoid" if sigmoid else "sh",
        sh_degree=degree,
        rasterize_mode="antialiased" if antialiased else "classic",
        background=np.array([0.2, 0.5, 0.9], np.float32),
    )


def pose_of(camera: PinholeCamera) -> torch.Tensor:
    return torch.from_numpy(np.array(camera.camera_to_world))


def compiled(scene: SplatScene, camera: PinholeCamera, rasteriser: Rasteriser = GSPLAT_1_4_0) -> np.ndarray:
    rotation = np.ascontiguousarray(camera.camera_to_world[:, :3].T * FLIP[:, None])
    return Renderer(activate(scene, rasteriser), rasteriser).image(camera, rotation, camera.camera_to_world[:, 3])


def reference(scene: SplatScene, camera: PinholeCamera, rasteriser: Rasteriser = GSPLAT_1_4_0) -> np.ndarray:
    return Reference(scene, rasteriser).image(camera, pose_of(camera)).numpy()


def apart(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(a - b).max())


@pytest.mark.slow_cases(every=3)
@pytest.mark.parametrize("kind", KINDS)
def test_same_image(kind: str) -> None:
    # these seeds have no decision within rounding of its threshold, so that no pixel is excused
    varied = 0
    for seed in range(6):
        camera = camera_at(seed)
        scene = make_scene(camera, seed, **KINDS[kind])
        image = reference(scene, camera)
        varied += np.ptp(image, axis=(0, 1)).max() > 0.1
        assert apart(image, compiled(scene, camera)) <= 1e-9
    # a near Gaussian may hide the rest
    assert varied >= 2


@pytest.mark.parametrize("kind", ["degree3", "sigmoid", "antialiased", "needles", "around"])
def test_same_image_paper(kind: str) -> None:
    for seed in range(3):
        camera = camera_at(seed)
        scene = make_scene(camera, seed, **KINDS[kind])
        assert apart(reference(scene, camera, PAPER), compiled(scene, camera, PAPER)) <= 1e-9


def test_depth_ties() -> None:
    # coplanar copies of one Gaussian: the stored order decides
    camera = replace_pose(camera_at(0), np.eye(3, 4))
    scene = make_scene(camera, 1, count=40)
    means = scene.means.copy()
    means[:, 2] = -2.0
    for order in (np.arange(40), np.arange(40)[::-1]):
        tied = replace(
            scene,
            **{
                name: np.ascontiguousarray(value[order])
                for name, value in {
                    "means": means,
                    "log_scales": scene.log_scales,
                    "quats": scene.quats,
                    "opacity_logits": scene.opacity_logits,
                    "sh": scene.sh,
                }.items()
            },
        )
        assert apart(reference(tied, camera), compiled(tied, camera)) <= 1e-9
    assert apart(reference(replace(scene, means=means), camera), reference(tied, camera)) > 1e-3


def replace_pose(camera: PinholeCamera, pose: np.ndarray) -> PinholeCamera:
    return PinholeCamera(pose, camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)


ALTERED = {
    "no tiles": {"tile_size": 0},
    "smaller tiles": {"tile_size": 8},
    "near plane": {"near": 0.5},
    "far plane": {"far": 3.0},
    "blur": {"eps2d": 0.29},
    "radius": {"radius_sigmas": 2.5},
    "discriminant": {"discriminant_min": 100.0},
    "view margin": {"view_margin": 0.15},
    "alpha_min": {"alpha_min": 1.0 / 254.0},
    "alpha_max": {"alpha_max": 0.99},
    "transmittance_min": {"transmittance_min": 2e-4},
    "background": {"background": False},
    "view dependence": {"view_dependent": False},
}


@pytest.mark.slow_cases
@pytest.mark.parametrize("rule", ALTERED)
def test_every_rule_shows(rule: str) -> None:
    """A reference with one rule altered is not the renderer; the comparison above would notice."""
    altered = replace(GSPLAT_1_4_0, **ALTERED[rule])
    worst = 0.0
    for seed in range(4):
        camera = camera_at(seed)
        for kind in ("degree1", "around", "huge", "small"):
            scene = make_scene(camera, seed, **KINDS[kind])
            worst = max(worst, apart(reference(scene, camera, altered), compiled(scene, camera)))
        if worst > 1e-5:
            break
    assert worst > 1e-5


def one_gaussian(opacity_logit: float, offset: tuple[float, float] = (0.0, 0.0)) -> tuple[SplatScene, PinholeCamera]:
    """A red ball of standard deviation 0.1 at distance 2, seen from the origin against blue; 32x32, f 40."""
    camera = PinholeCamera(np.eye(3, 4), 40.0, 40.0, 16.0, 16.0, 32, 32)
    band0 = (np.array([1.0, 0.0, 0.0]) - 0.5) / 0.28209479177387814
    scene = SplatScene(
        means=np.array([[offset[0], offset[1], -2.0]], np.float32),
        log_scales=np.full((1, 3), math.log(0.1), np.float32),
        quats=np.array([[2.0, 0.0, 0.0, 0.0]], np.float32),
        opacity_logits=np.array([opacity_logit], np.float32),
        sh=band0.reshape(1, 1, 3).astype(np.float32),
        background=np.array([0.0, 0.0, 1.0], np.float32),
    )
    return scene, camera


def test_by_hand() -> None:
    # centred between four pixels: J = 20 I there, so the variance is (20 * 0.1)^2 + 0.3 in both axes
    scene, camera = one_gaussian(1.0)
    variance = (20.0 * float(np.exp(np.float32(math.log(0.1)).astype(np.float64)))) ** 2 + 0.3
    opacity = 1.0 / (1.0 + math.exp(-1.0))
    image = reference(scene, camera)
    for row, column in ((15, 15), (16, 18), (13, 20)):
        square = (column - 15.5) ** 2 + (row - 15.5) ** 2
        alpha = opacity * math.exp(-0.5 * square / variance)
        assert image[row, column] == pytest.approx([alpha, 0.0, 1.0 - alpha], abs=1e-7)
    # below 1/255 nothing is drawn: not even a rest
    far = math.sqrt(2.0 * variance * math.log(255.0 * opacity))
    assert image[15, int(16 + far) + 1].tolist() == [0.0, 0.0, 1.0]


def test_by_hand_opaque() -> None:
    scene, camera = one_gaussian(40.0)
    camera = PinholeCamera(np.eye(3, 4), 40.0, 40.0, 16.5, 16.5, 32, 32)
    assert reference(scene, camera)[16, 16] == pytest.approx([0.999, 0.0, 0.001], abs=1e-7)
    # without thresholds it hides everything
    black = reference(scene, camera, PAPER)[16, 16]
    assert black == pytest.approx([1.0, 0.0, 0.0], abs=1e-7)


def test_behind_and_outside() -> None:
    scene, camera = one_gaussian(3.0, (60.0, 0.0))
    assert (reference(scene, camera) == scene.background).all()
    behind = replace(scene, means=np.array([[0.0, 0.0, 2.0]], np.float32))
    assert len(project(behind, camera, pose_of(camera)).indices) == 0
    assert (reference(behind, camera) == scene.background).all()


def test_pixels_and_gradient() -> None:
    camera = camera_at(2)
    scene = make_scene(camera, 2, degree=2, antialiased=True)
    some = torch.tensor([[3, 4], [20, 30], [34, 43], [17, 16]])
    image = reference(scene, camera)
    picked = Reference(scene).pixels(camera, pose_of(camera), some)
    assert apart(picked.numpy(), image[some[:, 0], some[:, 1]]) <= 1e-12
    pose = pose_of(camera).requires_grad_(True)
    renderer = Reference(scene)
    moved = 0
    for pixel in some[:, None]:
        assert torch.autograd.gradcheck(
            lambda p, pixel=pixel: renderer.pixels(camera, p, pixel), (pose,), eps=1e-7, atol=1e-4, rtol=1e-4
        )
        (slope,) = torch.autograd.grad(renderer.pixels(camera, pose, pixel).sum(), pose)
        moved += float(slope.abs().max()) > 1e-3
    assert moved >= 2


def test_gradient_of_image() -> None:
    camera = camera_at(3)
    scene = make_scene(camera, 3, count=40)
    renderer = Reference(scene)
    pose = pose_of(camera).requires_grad_(True)
    (whole,) = torch.autograd.grad(renderer.image(camera, pose)[20, 21].sum(), pose)
    (single,) = torch.autograd.grad(renderer.pixels(camera, pose, torch.tensor([[20, 21]])).sum(), pose)
    assert float(whole.abs().max()) > 0.01
    assert torch.allclose(whole, single, rtol=1e-9, atol=1e-12)


def test_float32() -> None:
    camera = camera_at(4)
    scene = make_scene(camera, 4, degree=2)
    single = Reference(scene, dtype=torch.float32).image(camera, pose_of(camera))
    assert single.dtype == torch.float32
    difference = np.abs(single.numpy() - reference(scene, camera))
    # decisions may flip, so not every pixel need agree
    assert 0.0 < float(np.quantile(difference, 0.95)) < 1e-4


def run_scene(name: str) -> tuple[SplatScene, Path]:
    folder = RUNS / name
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    return load_scene(next(iter(sorted(folder.glob("splatfacto/*/config.yml"))))), folder / "camera_path.json"


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    ("name", "downscale", "frames"),
    [("playbot_lod4", 2, (0, 3)), ("playbot_lod3", 4, (1,)), ("airplane", 4, (2,)), ("plant", 5, (0,))],
)
def test_runs(name: str, downscale: int, frames: tuple[int, ...]) -> None:
    scene, file = run_scene(name)
    path = load_camera_path(file, downscale)
    for frame in frames:
        camera = path.cameras[frame]
        image = reference(scene, camera)
        assert image.std() > 0.02
        assert apart(image, compiled(scene, camera)) <= 1e-9


# gsplat's own torch code -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def gsplat():
    """gsplat.cuda._torch_impl 1.4.0, in float64."""
    pytest.importorskip("gsplat", reason="gsplat is not installed")
    import gsplat as package
    from gsplat.cuda import _torch_impl

    if package.__version__ != "1.4.0":
        pytest.skip(f"gsplat is {package.__version__}, these are the rules of 1.4.0")
    return _torch_impl


def tensor(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.array(array, np.float64))


def view(camera: PinholeCamera) -> tuple[torch.Tensor, torch.Tensor]:
    """View matrix [1, 4, 4] (splatfacto.py:128-143) and intrinsics [1, 3, 3]."""
    matrix = np.eye(4)
    matrix[:3, :3] = (camera.camera_to_world[:, :3] * FLIP).T
    matrix[:3, 3] = -matrix[:3, :3] @ camera.camera_to_world[:, 3]
    intrinsics = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    return tensor(matrix[None]), tensor(intrinsics[None])


def ours(scene: SplatScene, camera: PinholeCamera) -> Projection:
    return project(scene, camera, pose_of(camera))


@pytest.mark.parametrize("kind", ["degree0", "antialiased", "small", "needles", "huge", "around"])
def test_gsplat_projection(gsplat, kind: str) -> None:
    for seed in range(4):
        camera = camera_at(seed)
        scene = make_scene(camera, seed, **KINDS[kind])
        covariances, _ = gsplat._quat_scale_to_covar_preci(
            tensor(scene.quats), tensor(scene.log_scales).exp(), compute_preci=False
        )
        matrix, intrinsics = view(camera)
        radii, means2d, depths, conics, compensations = gsplat._fully_fused_projection(
            tensor(scene.means), covariances, matrix, intrinsics, camera.width, camera.height,
            calc_compensations=True,
        )  # fmt: skip
        p = ours(scene, camera)
        # its near and far planes are strict where the kernel's are not; no depth here equals one
        drawn = torch.nonzero(radii[0] > 0).squeeze(1)
        assert len(drawn) > 10
        assert torch.equal(p.indices, drawn)
        assert torch.equal(p.radii, radii[0, drawn].to(torch.float64))
        assert torch.allclose(p.means2d, means2d[0, drawn], rtol=1e-10, atol=1e-8)
        assert torch.allclose(p.depths, depths[0, drawn], rtol=1e-11, atol=1e-12)
        # both invert a 2x2 matrix whose determinant cancels
        assert torch.allclose(p.conics, conics[0, drawn], rtol=1e-6, atol=1e-10)
        opacity = torch.sigmoid(tensor(scene.opacity_logits))[drawn]
        if scene.rasterize_mode == "antialiased":
            opacity = opacity * compensations[0, drawn]
        assert torch.allclose(p.opacities, opacity, rtol=1e-7, atol=1e-9)


def test_gsplat_stages(gsplat) -> None:
    camera = camera_at(1)
    scene = make_scene(camera, 1, spread=0.9)
    quats, scales = tensor(scene.quats), tensor(scene.log_scales).exp()
    covariances, _ = gsplat._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    spread = rotations(quats) * scales[:, None]
    assert torch.allclose(spread @ spread.transpose(1, 2), covariances, rtol=1e-11, atol=1e-15)
    matrix, intrinsics = view(camera)
    means_c, covariances_c = gsplat._world_to_cam(tensor(scene.means), covariances, matrix)
    means2d, covariances2d = gsplat._persp_proj(means_c, covariances_c, intrinsics, camera.width, camera.height)
    p = ours(scene, camera)
    assert torch.allclose(p.depths, means_c[0, p.indices, 2], rtol=1e-11)
    assert torch.allclose(p.means2d, means2d[0, p.indices], rtol=1e-10, atol=1e-8)
    blurred = covariances2d[0, p.indices] + 0.3 * torch.eye(2, dtype=torch.float64)
    inverse = torch.linalg.inv(blurred)
    entries = torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], dim=1)
    assert torch.allclose(p.conics, entries, rtol=1e-7, atol=1e-10)


@pytest.mark.parametrize("kind", ["degree0", "huge", "around"])
def test_gsplat_tiles(gsplat, kind: str) -> None:
    camera = camera_at(5)
    scene = make_scene(camera, 5, **KINDS[kind])
    p = ours(scene, camera)
    across, down = -(-camera.width // 16), -(-camera.height // 16)
    counts, ids, flat = gsplat._isect_tiles(p.means2d[None], p.radii[None], p.depths[None], 16, across, down)
    first_x, past_x, first_y, past_y = p.tiles.unbind(1)
    assert torch.equal((past_x - first_x) * (past_y - first_y), counts[0].long())
    order = torch.argsort(p.depths, stable=True)
    for tile in range(across * down):
        x, y = tile % across, tile // across
        hit = (first_x <= x) & (x < past_x) & (first_y <= y) & (y < past_y)
        theirs = flat[(ids >> 32) == tile].long()
        assert torch.equal(order[hit[order]], theirs)
    assert int(counts.sum()) > 50


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gsplat_harmonics(gsplat, degree: int) -> None:
    rng = np.random.default_rng(degree)
    directions, sh = tensor(rng.normal(size=(200, 3))), tensor(rng.normal(size=(200, 16, 3)))
    theirs = (gsplat._spherical_harmonics(degree, directions, sh) + 0.5).clamp(min=0.0)
    assert (theirs == 0.0).any()
    assert torch.allclose(sh_colors(degree, directions, sh), theirs, rtol=1e-12, atol=1e-12)
    assert not torch.allclose(sh_colors(degree, -directions, sh), theirs, rtol=1e-3) or degree == 0


def test_gsplat_colors(gsplat) -> None:
    camera = camera_at(6)
    scene = make_scene(camera, 6, degree=3)
    p = ours(scene, camera)
    matrix, _ = view(camera)
    position = torch.inverse(matrix)[0, :3, 3]
    directions = tensor(scene.means)[p.indices] - position
    colors = gsplat._spherical_harmonics(3, directions, tensor(scene.sh)[p.indices])
    assert torch.allclose(p.colors, torch.clamp_min(colors + 0.5, 0.0), rtol=1e-10, atol=1e-10)
