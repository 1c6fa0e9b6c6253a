"""gsplat's own kernels, compiled for the CPU, against the reference and against the float32 bounds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from conftest import blob_scene
from gsplat_kernels import Kernels, Unavailable, library
from scene_attacks import bound_cells

from ns_abstract.bench.stiff_cases import all_cases
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.keyframe_cameras import look_at
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0, GSPLAT_1_5_3, GSPLAT_1_6_0, VERSIONS, Rasteriser
from ns_abstract.methods.splat.reference import Reference
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.perturbation.specification import parse_perturbation
from ns_abstract.verify.attack.soundness import compiled_renderer

torch.set_num_threads(1)

WIDTH, HEIGHT, FOCAL = 40, 24, 36.0
MODES = ("classic", "antialiased")
#: Scalar type, contraction to fused operations, seed and kind of the errors.
BUILDS: dict[str, dict[str, Any]] = {
    "IEEE": {"scalar": "float"},
    "fused": {"scalar": "float", "contracted": True},
    "fast": {"scalar": "fast", "noise": (1, 0)},
    "fast, at the ends": {"scalar": "fast", "contracted": True, "noise": (2, 1)},
    "fast, to one side": {"scalar": "fast", "noise": (3, 2)},
}


def kernels(scene: SplatScene, version: str = "1.4.0", **options: Any) -> Kernels:
    """The scene's kernels; skips where they cannot be built."""
    try:
        return Kernels(scene, version, **options)
    except Unavailable as reason:
        pytest.skip(str(reason))


def camera() -> PinholeCamera:
    pose = look_at((1.6, 0.3, 0.4), (0.0, 0.0, 0.0))
    return PinholeCamera(np.asarray(pose)[:3], FOCAL, FOCAL * 1.1, WIDTH / 2 + 0.3, HEIGHT / 2 - 0.2, WIDTH, HEIGHT)


def scene_of(mode: str = "classic", model: str = "sh") -> SplatScene:
    """Blobs; a stack of opaque ones; a needle and a disc cut by tiles; one wide and faint, one at the near plane."""
    blobs = blob_scene(40, degree=3)
    eye = camera().camera_to_world[:, 3]
    toward = -eye / np.linalg.norm(eye)
    more = [
        # (mean, scales, opacity's logit)
        *[(eye + (0.9 + 0.2 * k) * toward, (0.15, 0.15, 0.1), 9.0 if k < 2 else 5.0) for k in range(3)],
        ((0.0, 0.2, 0.3), (0.6, 0.004, 0.004), 4.0),
        ((0.1, -0.35, -0.1), (0.2, 0.2, 0.001), 4.0),
        ((0.0, 0.0, 0.1), (0.7, 0.7, 0.7), -5.0),
        (eye + 0.012 * toward, (0.0005, 0.0007, 0.0004), -1.0),
        # far outside of the view, but wide
        (eye + 0.5 * toward + np.array([0.0, 1.5, 0.0]), (0.4, 0.5, 0.3), 2.0),
        ((-5e9, 1e9, 0.0), (6e8, 5e8, 4e8), 3.0),
        *[((0.3, 0.5 - 0.1 * k, 0.25), (0.0008, 0.0008, 0.0008), 6.0) for k in range(8)],
    ]
    rng = np.random.default_rng(3)
    count = len(more)
    bands = 1 if model == "sigmoid" else blobs.sh.shape[1]
    values = {
        "means": np.concatenate([blobs.means, [row[0] for row in more]]),
        "log_scales": np.concatenate([blobs.log_scales, np.log([row[1] for row in more])]),
        "quats": np.concatenate([blobs.quats, rng.normal(size=(count, 4))]),
        "opacity_logits": np.concatenate([blobs.opacity_logits, [row[2] for row in more]]),
        "sh": np.concatenate([blobs.sh, rng.normal(size=(count, blobs.sh.shape[1], 3)) * 0.3])[:, :bands],
    }
    return SplatScene(
        **{name: np.ascontiguousarray(value, np.float32) for name, value in values.items()},  # type: ignore[arg-type]
        sh_degree=0 if model == "sigmoid" else 3,
        color_model=model,  # type: ignore[arg-type]
        rasterize_mode=mode,  # type: ignore[arg-type]
        background=np.array([0.9, 0.2, 0.3], np.float32),
    )


def poses(count: int = 4) -> list[np.ndarray]:
    """The camera's pose and others about it."""
    around = PoseBox.around(camera(), parse_perturbation(SIX))
    others = around.box.sample(count - 1, np.random.default_rng(0))
    return [around.pose(values) for values in (around.box.middle, *others)]


SIX = {"translation": dict.fromkeys("xyz", 0.05), "rotation": dict.fromkeys(("yaw", "pitch", "roll"), 0.05)}


def distance(scene: SplatScene, rules: Rasteriser, **options: Any) -> float:
    """Largest difference of the pictures of a reference with ``rules`` and of the exact kernels."""
    exact, reference = kernels(scene, scalar="double", **options), Reference(scene, rules)
    differences = []
    for pose in poses():
        other = reference.image(camera(), torch.from_numpy(pose)).numpy()
        differences.append(np.abs(exact.image(camera(), pose) - other).max())
    return float(max(differences))


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("model", ["sh", "sigmoid"])
@pytest.mark.parametrize("mode", MODES)
def test_exact_kernels_are_the_reference(mode: str, model: str, version: str) -> None:
    # the exact kernels have 0.005 where the rules have its float32
    room = 1e-10 if version == "1.6.0" and mode == "antialiased" else 1e-12
    assert distance(scene_of(mode, model), VERSIONS[version], version=version) < room


@pytest.mark.parametrize("other", VERSIONS)
@pytest.mark.parametrize("version", VERSIONS)
def test_versions_are_told_apart(version: str, other: str) -> None:
    """The rules of one version are noticed in the lists or pictures of another."""
    rules, scene = VERSIONS[other], scene_of("antialiased")
    same = distance(scene, rules, version=version) < 1e-6
    if "1.6.0" not in (version, other):
        same &= equal_lists(scene, rules, version)[0]
    assert same == (version == other)


def equal_lists(scene: SplatScene, rules: Rasteriser, version: str = "1.4.0") -> tuple[bool, int]:
    """Whether the exact kernels and a reference with ``rules`` list the same Gaussians in every tile; how many."""
    exact, reference = kernels(scene, version, scalar="double"), Reference(scene, rules)
    equal, entries = True, 0
    for pose in poses():
        found, other = exact.stages(camera(), pose), reference.project(camera(), torch.from_numpy(pose))
        order = torch.argsort(other.depths, stable=True)
        x0, x1, y0, y1 = other.tiles[order].unbind(1)
        for tile in range(len(found.offsets) - 1):
            row, column = divmod(tile, -(-WIDTH // 16))
            inside = (x0 <= column) & (column < x1) & (y0 <= row) & (row < y1)
            listed = found.ids[found.offsets[tile] : found.offsets[tile + 1]]
            equal &= np.array_equal(other.indices[order[inside]].numpy(), listed)
            entries += len(listed)
    return equal, entries


@pytest.mark.parametrize("version", ["1.4.0", "1.5.3"])
@pytest.mark.parametrize("mode", MODES)
def test_tile_lists(mode: str, version: str) -> None:
    equal, entries = equal_lists(scene_of(mode), VERSIONS[version], version)
    assert equal and entries > 100


@pytest.mark.parametrize(
    "change",
    [
        {"near": 0.02}, {"far": 1e9}, {"eps2d": 0.31}, {"radius_sigmas": 2.5}, {"discriminant_min": 0.3},
        {"view_margin": 0.2}, {"alpha_min": 1.0 / 250.0}, {"alpha_max": 0.99}, {"transmittance_min": 2e-4},
        {"tile_size": 8},
    ],
    ids=lambda change: next(iter(change)),
)  # fmt: skip
def test_wrong_constant_is_noticed(change: dict[str, float]) -> None:
    rules = replace(GSPLAT_1_4_0, **change)
    if "discriminant_min" in change:
        # what it adds to a radius shows in lists before it shows in a picture
        assert not equal_lists(scene_of(), rules)[0]
    else:
        assert distance(scene_of(), rules) > 1e-6


def test_errors_of_the_device() -> None:
    """They are repeatable, differ by seed, and leave the exact picture by little more than IEEE's do."""
    scene, pose = scene_of(), poses(1)[0]
    noises = ((5, 0), (5, 0), (6, 0), (5, 1))
    images = [kernels(scene, scalar="fast", noise=noise).image(camera(), pose) for noise in noises]
    assert np.array_equal(images[0], images[1])
    assert not np.array_equal(images[0], images[2]) and not np.array_equal(images[0], images[3])
    exact = kernels(scene, scalar="double").image(camera(), pose)
    plain = np.abs(kernels(scene).image(camera(), pose) - exact)
    for image in images:
        assert plain.mean() < np.abs(image - exact).mean() < 20.0 * plain.mean()


def outside(bounds: tuple[np.ndarray, np.ndarray], image: np.ndarray) -> int:
    """Channels of pixels that leave the bounds; a NaN does."""
    assert image.dtype == np.float32
    return int((~((bounds[0] <= image) & (image <= bounds[1]))).sum())


def violations(
    scene: SplatScene, view: PinholeCamera, spec: dict[str, Any], count: int, version: str = "1.4.0", **options: Any
) -> tuple[int, float]:
    """What leaves the bounds of a set in ``count`` renders by each build, and the bounds' mean gap."""
    around = PoseBox.around(view, parse_perturbation(spec))
    (bounds,), _ = bound_cells(scene, around, [around.box], **({"rasteriser": VERSIONS[version]} | options))
    rng = np.random.default_rng(1)
    values = [around.box.middle, *around.box.corners(), *around.box.sample(count, rng)]
    builds = [kernels(scene, version, **build) for build in BUILDS.values()]
    found = 0
    for k, point in enumerate(values[:count]):
        pose = around.pose(point)
        # the first pose by all
        for build in builds if k == 0 else [builds[k % len(builds)]]:
            found += outside(bounds, build.image(view, pose))
    return found, float(np.mean(bounds[1] - bounds[0]))


SETS: dict[str, dict[str, Any]] = {
    "one pose": {},
    "x": {"translation": {"x": 1e-3}},
    "yaw": {"rotation": {"yaw": 1e-3}},
    "six": {"translation": dict.fromkeys("xyz", 1e-4), "rotation": dict.fromkeys(("yaw", "pitch", "roll"), 1e-4)},
}


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("spec", SETS.values(), ids=SETS)
@pytest.mark.parametrize("mode", MODES)
def test_float32_bounds_hold(mode: str, spec: dict[str, Any], version: str) -> None:
    found, gap = violations(scene_of(mode), camera(), spec, 12, version, arithmetic="float32")
    assert found == 0
    # bounds that say nothing would pass
    assert gap < (0.1 if mode == "classic" else 0.5)


def test_kernels_leave_wrong_bounds() -> None:
    """Bounds that charge no float32 rounding, or hold for other rules, are left."""
    scene = scene_of()
    assert violations(scene, camera(), {}, 2, arithmetic="real")[0] > 0
    for change in ({"alpha_max": 0.99}, {"radius_sigmas": 2.5}, {"eps2d": 0.31}):
        rules = replace(GSPLAT_1_4_0, **change)
        assert violations(scene, camera(), {}, 2, arithmetic="float32", rasteriser=rules)[0] > 0


@pytest.mark.parametrize(
    ("version", "rules"),
    [
        ("1.6.0", GSPLAT_1_5_3), ("1.4.0", GSPLAT_1_6_0),
        ("1.6.0", replace(GSPLAT_1_6_0, compensation_min=0.004)),
    ],
)  # fmt: skip
def test_rules_of_another_version_are_left(version: str, rules: Rasteriser) -> None:
    scene = scene_of("antialiased" if rules.compensation_min == 0.004 else "classic")
    assert violations(scene, camera(), {}, 2, version, arithmetic="float32", rasteriser=rules)[0] > 0


def test_gaussian_beyond_its_tile() -> None:
    """1.4.0's radius ends at a tile's edge, where alpha is above 1/255 still; later versions show it there."""
    view = PinholeCamera(np.eye(3, 4), 32.0, 32.0, 7.9, 8.0, 32, 16)
    blob = blob_scene(1)
    scene = replace(
        blob, means=np.array([[0.0, 0.0, -1.0]], np.float32), log_scales=np.full((1, 3), np.log(0.0804), np.float32),
        opacity_logits=np.array([5.0], np.float32), sh=np.abs(blob.sh) + np.float32(1.0),
    )  # fmt: skip
    for version in VERSIONS:
        found = {
            name: violations(scene, view, {}, 1, version, arithmetic="float32", rasteriser=rules)[0]
            for name, rules in VERSIONS.items()
        }
        # later caps and factors play no part here
        assert (found["1.4.0"] == 0) == (version == "1.4.0")
        assert (found["1.5.3"] == 0) == (version != "1.4.0") == (found["1.6.0"] == 0)


def skewed() -> PinholeCamera:
    """A camera whose matrix is no rotation, as far as camera paths may hold it."""
    plain = camera()
    matrix = plain.camera_to_world.copy()
    matrix[:, :3] = matrix[:, :3] @ np.array([[1.0004, 2e-4, 0.0], [-3e-4, 0.9996, 1e-4], [2e-4, 0.0, 1.0002]])
    return replace(plain, camera_to_world=matrix)


def test_colours_are_seen_from_the_view_matrix() -> None:
    """From 1.6.0 on, the eye is -R^T t, which is another place where R is no rotation."""
    view, scene = skewed(), scene_of()
    exact = kernels(scene, "1.6.0", scalar="double").image(view, view.camera_to_world)
    pose = torch.from_numpy(view.camera_to_world)
    assert np.abs(Reference(scene, GSPLAT_1_6_0).image(view, pose).numpy() - exact).max() < 1e-12
    other = Reference(scene, replace(GSPLAT_1_6_0, eye_from_view=False)).image(view, pose).numpy()
    assert np.abs(other - exact).max() > 1e-6
    around = PoseBox.around(view, parse_perturbation({}))
    render, _ = compiled_renderer(scene, around, GSPLAT_1_6_0)
    picture = render(around.box.middle)
    assert np.abs(picture - exact).max() < 1e-12
    (bounds,), _ = bound_cells(scene, around, [around.box], rasteriser=GSPLAT_1_6_0, arithmetic="real")
    assert (bounds[0] <= picture).all() and (picture <= bounds[1]).all()
    assert violations(scene, view, {}, 2, "1.6.0", arithmetic="float32")[0] == 0


STIFF = ("squares at the overflow", "all scales at once",
         "needles", "compensation above 1", "needle along the ray", "alpha at 1/255", "alpha at 0.999",
         "transmittance at 1e-4", "near plane, one pose", "tile border, one pose", "harmonics 1e3")  # fmt: skip


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("name", STIFF)
def test_stiff_cases_hold(name: str, version: str) -> None:
    case = next(case for case in all_cases() if case.name == name)
    assert violations(case.scene, case.camera, case.spec, 6, version, arithmetic="float32")[0] == 0


def needle(mean: Any, scales: tuple[float, float, float], quaternion: Any, antialiased: bool) -> SplatScene:
    """One bright Gaussian."""
    blob = blob_scene(1)
    turn = np.array([quaternion]) / np.linalg.norm(quaternion)
    return replace(
        blob, means=np.array([mean], np.float32), log_scales=np.log([scales]).astype(np.float32),
        quats=turn.astype(np.float32), opacity_logits=np.array([2.2], np.float32),
        sh=np.abs(blob.sh) + np.float32(1.0), rasterize_mode="antialiased" if antialiased else "classic",
    )  # fmt: skip


@pytest.mark.parametrize("version", ["1.4.0", "1.5.3"])
@pytest.mark.parametrize("antialiased", [False, True], ids=["classic", "antialiased"])
def test_needle_of_a_covariance_that_rounds_by_a_third(antialiased: bool, version: str) -> None:
    """Seen nearly end on from beside it: its exponent is known, so that it shows along its own line alone (G7)."""
    axis = np.array([0.7, 0.7, 0.14]) / np.linalg.norm([0.7, 0.7, 0.14])
    turned = [1.0 + axis[2], -axis[1], axis[0], 0.0]
    length = 4.9
    mean = np.array([0.0, 0.0, -2.0]) - 0.7 * length * axis
    scene = needle(mean, (4e-3, 1e-5, length), turned, antialiased)
    view = PinholeCamera(np.eye(3, 4), 113.0, 113.0, 25.0, 20.0, 50, 40)
    found, gap = violations(scene, view, {}, 9, version, arithmetic="float32")
    assert found == 0
    # half of the picture's values where nothing were known of it
    assert gap < 0.05


def test_real_pictures_have_no_tiles() -> None:
    """A needle of thousands of pixels, which an ellipse's tiles may miss in float32 alone (G12)."""
    scene = needle([0.0, 0.0, -3.0], (1e-3, 1e-3, 1e3), [0.9, 0.1, 0.4, 0.0], False)
    view = PinholeCamera(np.eye(3, 4), 20.0, 20.0, 16.0, 16.0, 32, 32)
    around = PoseBox.around(view, parse_perturbation({}))
    picture = compiled_renderer(scene, around, GSPLAT_1_6_0)[0](around.box.middle)
    assert picture.max() > 0.1
    for arithmetic, least, most in (("real", 0.0, 1e-6), ("float32", 0.01, 1.0)):
        (bounds,), _ = bound_cells(scene, around, [around.box], rasteriser=GSPLAT_1_6_0, arithmetic=arithmetic)
        assert (bounds[0] <= picture).all() and (picture <= bounds[1]).all()
        assert least <= float(np.mean(bounds[1] - bounds[0])) <= most


def test_missing_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(Unavailable, match="g\\+\\+"):
        library.__wrapped__("1.4.0", "double", False)


def test_unknown_version() -> None:
    with pytest.raises(Unavailable, match="not on PyPI"):
        library("1.6.0", "double", False) if not _has_sources("1.6.0") else library("9.9.9", "double", False)


def _has_sources(version: str) -> bool:
    from gsplat_kernels import sources

    try:
        sources(version)
    except Unavailable:
        return False
    return True
