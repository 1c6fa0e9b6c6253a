"""Bounds of expected depth and accumulation, attacked by the renderer, the reference and gsplat's own kernels."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import Inputs, blob_scene
from test_gsplat_kernels import BUILDS, SETS, camera, kernels, scene_of

import ns_abstract as nsa
from ns_abstract.arithmetic.rounding import arithmetic as arithmetic_named
from ns_abstract.cli.render import Render, render
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.keyframe_cameras import look_at
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.geometry.tiles import assemble
from ns_abstract.io.errors import InputError
from ns_abstract.methods.splat.activate import activate
from ns_abstract.methods.splat.bounds import SplatBounds
from ns_abstract.methods.splat.constants import VERSIONS
from ns_abstract.methods.splat.frame import SplatFrame
from ns_abstract.methods.splat.reference import Reference
from ns_abstract.methods.splat.render import Renderer
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.perturbation.specification import parse_perturbation
from ns_abstract.refine.engine import Refinement, RefinementGoal
from ns_abstract.refine.result import ExtraOutput, _whole_depth
from ns_abstract.report.files import load_frame

#: Pose [3, 4] to accumulation and expected depth [H, W, 2], NaN where nothing is drawn.
Program = Callable[[np.ndarray], np.ndarray]
WIDE = {"translation": {"x": 0.01, "z": 0.02}, "rotation": {"yaw": 0.01}}
ALL = {**SETS, "z": {"translation": {"z": 1e-2}}, "wide": WIDE}


def cell(
    scene: SplatScene, around: PoseBox, arithmetic: str, version: str = "1.4.0", floor: float = -1.0
) -> tuple[np.ndarray, np.ndarray]:
    """[H, W, 4] bounds of a whole set, and the bounds of its colours."""
    rules = VERSIONS[version]
    order = 2 if around.box.dimensions == 1 else 1
    bounds = SplatBounds(activate(scene, rules), rules, arithmetic_named(arithmetic))
    found = bounds.cell(around.camera, around.enclosure(around.box, order), layers=True, floor=floor)
    plain = bounds.cell(around.camera, around.enclosure(around.box, order), floor=floor)
    # what is asked for besides changes no colour
    np.testing.assert_array_equal(found.lower, plain.lower)
    np.testing.assert_array_equal(found.upper, plain.upper)
    assert found.layers is not None
    return assemble(found.layers, around.camera), found.upper - found.lower


def outside(bounds: np.ndarray, values: np.ndarray) -> int:
    """Accumulations and depths [H, W, 2] that leave bounds [H, W, 4]; depth only where anything is drawn."""
    total, depth = values[..., 0].astype(np.float64), values[..., 1].astype(np.float64)
    drawn = total > 0.0
    count = (~((bounds[..., 0] <= total) & (total <= bounds[..., 1]))).sum()
    return int(count + (drawn & ~((bounds[..., 2] <= depth) & (depth <= bounds[..., 3]))).sum())


def programs(scene: SplatScene, around: PoseBox, version: str, exact: bool) -> list[Program]:
    view = around.camera
    reference = Reference(scene, VERSIONS[version])
    found: list[Program] = [lambda pose: reference.layers(view, torch.from_numpy(pose)).numpy()]
    if exact:
        kinds: list[dict[str, Any]] = [{"scalar": "double"}]
    else:
        kinds = list(BUILDS.values())
    for kind in kinds:
        built = kernels(scene, version, **kind)
        found.append(lambda pose, built=built: built.layers(view, pose))
    return found


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    ("name", "mode", "version"),
    [*((name, "classic", "1.4.0") for name in ALL), ("six", "antialiased", "1.4.0"), ("yaw", "classic", "1.6.0"),
     ("x", "antialiased", "1.6.0")],
)  # fmt: skip
def test_kernels_and_reference_stay_inside(name: str, mode: str, version: str) -> None:
    scene, around = scene_of(mode), PoseBox.around(camera(), parse_perturbation(ALL[name]))
    values = [around.box.middle, *around.box.corners()[:6], *around.box.sample(5, np.random.default_rng(1))]
    bounds, _ = cell(scene, around, "float32", version)
    attackers = programs(scene, around, version, exact=False)
    for k, point in enumerate(values):
        pose = around.pose(point)
        for attacker in attackers if k == 0 else [attackers[k % len(attackers)]]:
            assert outside(bounds, attacker(pose)) == 0
    real, _ = cell(scene, around, "real", version)
    renderer = Renderer(activate(scene, VERSIONS[version]), VERSIONS[version])
    for point in values:
        tiles = renderer.layer_tiles(around.camera, *around.world_to_camera(point))
        drawn = assemble(tiles, around.camera)[..., 3:]
        assert outside(real, drawn) == 0 and outside(bounds, drawn) == 0
    # bounds that say nothing would pass
    known = np.isfinite(bounds[..., 3])
    limit = 0.1 if mode == "classic" and name in SETS else 0.5
    assert (bounds[..., 1] - bounds[..., 0]).mean() < limit and known.mean() > 0.5


def test_exact_kernels_are_the_reference() -> None:
    scene, around = scene_of(), PoseBox.around(camera(), parse_perturbation(WIDE))
    for point in (around.box.middle, *around.box.sample(2, np.random.default_rng(0))):
        one, other = (program(around.pose(point)) for program in programs(scene, around, "1.4.0", exact=True))
        np.testing.assert_array_equal(np.isnan(one), np.isnan(other))
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)
        drawn = Renderer(activate(scene, VERSIONS["1.4.0"]), VERSIONS["1.4.0"]).layer_tiles(
            around.camera, *around.world_to_camera(point)
        )
        np.testing.assert_allclose(assemble(drawn, around.camera)[..., 3:], other, rtol=1e-9, atol=1e-12)


def test_kernels_leave_bounds_without_rounding() -> None:
    """The attack can fail: bounds of the real-number renderer do not hold float32's depths."""
    scene, around = scene_of(), PoseBox.around(camera(), parse_perturbation({}))
    bounds, _ = cell(scene, around, "real")
    assert sum(
        outside(bounds, program(around.pose(np.zeros(0)))) for program in programs(scene, around, "1.4.0", False)
    )


def plane(count: int, middle: tuple[float, float, float]) -> SplatScene:
    """Faint Gaussians that share their mean, and so their depth."""
    scene, rng = blob_scene(count), np.random.default_rng(4)
    return replace(
        scene,
        means=np.tile(np.float32(middle), (count, 1)),
        log_scales=np.full((count, 3), -1.0, np.float32),
        quats=np.tile(np.float32([1.0, 0.0, 0.0, 0.0]), (count, 1)),
        opacity_logits=rng.uniform(-5.0, -3.0, count).astype(np.float32),
    )


def depth_bounds(
    scene: SplatScene, pose: np.ndarray, middle: float = 4.0, **charges: float
) -> tuple[np.ndarray, list[np.ndarray]]:
    """[8, 8, 4] bounds of one pose [3, 4] with some ``charges`` replaced, and what programs draw there."""
    around = PoseBox.around(PinholeCamera(pose, 8.0, 8.0, middle, middle, 8, 8), parse_perturbation({}))
    rules = VERSIONS["1.4.0"]
    bounds = SplatBounds(activate(scene, rules), rules, arithmetic_named("float32"))
    bounds.charges = bounds.charges._replace(**charges)
    found = bounds.cell(around.camera, around.enclosure(around.box, 1), layers=True)
    assert found.layers is not None
    drawn = [program(pose) for program in programs(scene, around, "1.4.0", exact=False)[1:]]
    return assemble(found.layers, around.camera), drawn


def test_sums_of_weights_are_rounded() -> None:
    """Many faint Gaussians at one depth that is a float32: nothing but the sums rounds."""
    bounds, pictures = depth_bounds(plane(400, (0.0, 0.0, -1.1)), np.eye(3, 4), camera_coordinate=0.0)
    for drawn in pictures:
        assert (drawn[..., 0] > 0.0).mean() > 0.5 and outside(bounds, drawn) == 0


def test_the_accumulation_is_rounded() -> None:
    """In the pixel at the middle of many Gaussians exponentials are exp(0): nothing but sums and products rounds."""
    exact = dict.fromkeys(("exponential", "exponential_by_argument", "exponential_by_range", "opacity"), 0.0)
    bounds, pictures = depth_bounds(plane(400, (0.0, 0.0, -1.0)), np.eye(3, 4), middle=4.5, **exact)
    for drawn in pictures:
        assert outside(bounds[4:5, 4:5], drawn[4:5, 4:5]) == 0


def test_coordinates_far_from_the_origin_are_rounded() -> None:
    """One Gaussian, one weight: nothing but its coordinate rounds."""
    rng = np.random.default_rng(8)
    for _ in range(4):
        pose = np.asarray(look_at(tuple(rng.normal(size=3)), (0.0, 0.0, 0.0)))[:3].copy()
        pose[:, 3] = rng.uniform(-4000.0, 4000.0, 3)
        middle = pose[:, 3] - 1.1 * pose[:, 2]
        bounds, pictures = depth_bounds(plane(1, (float(middle[0]), float(middle[1]), float(middle[2]))), pose)
        for drawn in pictures:
            assert (drawn[..., 0] > 0.0).mean() > 0.5 and outside(bounds, drawn) == 0


@pytest.mark.parametrize("floor", [-1.0, 0.01])
def test_dim_light_and_tightness(floor: float) -> None:
    """What is missing behind dim light is inside, too; small cells are next to exact."""
    scene = blob_scene(60, degree=1)
    scene = replace(scene, opacity_logits=scene.opacity_logits + np.float32(3.0))
    around = PoseBox.around(camera(), parse_perturbation({"translation": {"x": 1e-3}}))
    bounds, _ = cell(scene, around, "real", floor=floor)
    renderer = Renderer(activate(scene, VERSIONS["1.4.0"]), VERSIONS["1.4.0"])
    drawn = [
        assemble(renderer.layer_tiles(around.camera, *around.world_to_camera(point)), around.camera)[..., 3:]
        for point in (*around.box.corners(), *around.box.sample(20, np.random.default_rng(0)))
    ]
    assert sum(outside(bounds, one) for one in drawn) == 0
    least, most = np.fmin.reduce(drawn), np.fmax.reduce(drawn)
    sure = (bounds[..., 0] > 0.5) & np.isfinite(most).all(axis=-1)
    assert sure.sum() > 100
    for k in range(2):
        outer, inner = bounds[..., 2 * k + 1] - bounds[..., 2 * k], most[..., k] - least[..., k]
        assert outer[sure].mean() < (1.3 if floor < 0.0 else 5.0) * inner[sure].mean()


def refined(around: PoseBox, scene: SplatScene, cells: int) -> Any:
    rules = VERSIONS["1.4.0"]
    frame = SplatFrame(activate(scene, rules), rules, arithmetic_named("float32"), around, layers=True)
    return Refinement(frame, 0, RefinementGoal(1.0, 1e6, cells)).run()


@pytest.mark.parametrize("cells", [3, 40])
def test_whole_pictures_hold(cells: int) -> None:
    """Splatfacto's own outputs: where nothing is drawn, the depth is the largest one of the picture."""
    scene, around = blob_scene(12, degree=0), PoseBox.around(camera(), parse_perturbation(WIDE))
    result = refined(around, scene, cells)
    depth, total = result.layers["depth"], result.layers["accumulation"]
    renderer = Renderer(activate(scene, VERSIONS["1.4.0"]), VERSIONS["1.4.0"])
    empty = 0
    for point in (*around.box.corners(), *around.box.sample(12, np.random.default_rng(2))):
        image, accumulation, expected = renderer.layers(around.camera, *around.world_to_camera(point))
        assert ((result.lower <= image) & (image <= result.upper)).all()
        empty += int((accumulation == 0.0).sum())
        for layer, found in ((depth, expected), (total, accumulation)):
            assert ((layer.lower <= found[..., 0]) & (found[..., 0] <= layer.upper)).all()
    assert empty > 50
    for layer in (depth, total):
        assert (layer.lower <= layer.witness_lower).all() and (layer.witness_upper <= layer.upper).all()
        assert (layer.witness_lower <= layer.image).all() and (layer.image <= layer.witness_upper).all()
    assert np.isfinite(depth.upper).all() and depth.mean_gap() < 8.0 * depth.mean_gap_witness()


def test_largest_depth_of_the_picture() -> None:
    """One pixel is surely drawn at 2 to 3, one perhaps at 7 to 9 or not at all, one never."""

    def row(*values: float) -> np.ndarray:
        return np.array([values], np.float32)

    nothing = row(np.inf, np.inf, np.inf), row(-np.inf, -np.inf, -np.inf), row(2.5, 7.5, np.nan)
    depth = _whole_depth(
        ExtraOutput(row(2.0, 7.0, np.inf), row(3.0, 9.0, -np.inf), *nothing),
        ExtraOutput(row(0.5, 0.0, 0.0), row(1.0, 0.4, 0.0), *nothing),
    )
    np.testing.assert_array_equal(depth.lower, row(2.0, 2.0, 2.0))
    np.testing.assert_array_equal(depth.upper, row(3.0, 9.0, 9.0))
    np.testing.assert_array_equal(depth.image, row(2.5, 7.5, 7.5))


def test_nothing_is_drawn_at_all() -> None:
    scene = blob_scene(3)
    away = replace(scene, means=scene.means + np.float32(1e4))
    result = refined(PoseBox.around(camera(), parse_perturbation(WIDE)), away, 3)
    for layer in result.layers.values():
        assert (layer.lower == 0.0).all() and (layer.upper == 0.0).all()


@pytest.mark.slow
def test_command(blobs: Inputs, tmp_path: Path) -> None:
    options = {
        "load_config": blobs.config, "camera_path_filename": blobs.path, "perturbation_filename": blobs.spec,
        "output_dir": tmp_path / "out", "downscale_factor": 2.0, "time_budget": 2.0, "frames": (0,),
        "outputs": ("rgb", "depth", "accumulation"),
    }  # fmt: skip
    assert render(Render(**options)) == 0
    with np.load(tmp_path / "out" / "frame_00000.npz", allow_pickle=False) as found:
        assert found["depth_lower"].shape == found["accumulation_upper"].shape == found["lower"].shape[:2]
        assert (found["depth_lower"] <= found["depth_witness_lower"]).all()
        assert (found["accumulation_image"] <= found["accumulation_upper"]).all()
    entry = json.loads((tmp_path / "out" / "report.json").read_text())["frames"][0]
    assert set(entry["layers"]) == {"depth", "accumulation"} and entry["layers"]["depth"]["ratio"] >= 1.0
    for name in ("depth", "accumulation"):
        assert (tmp_path / "out" / entry["files"][name]).stat().st_size > 5000
    assert "depth_lower" not in (page := (tmp_path / "out" / "report.html").read_text()) and "depth, lower" in page
    before = load_frame(tmp_path / "out" / "frame_00000.npz").result.layers["depth"]
    assert render(Render(**options | {"resume": True, "target_ratio": 1.0})) == 0
    after = load_frame(tmp_path / "out" / "frame_00000.npz").result.layers["depth"]
    assert (after.lower >= before.lower).all() and (after.upper <= before.upper).all()
    # other outputs are another run
    with pytest.raises(InputError, match="outputs"):
        render(Render(**options | {"resume": True, "outputs": ("rgb",)}))


def test_api(blobs: Inputs) -> None:
    scene = nsa.load_scene(blobs.config)
    view = nsa.load_camera_path(blobs.path).cameras[0]
    poses = nsa.PoseSet(nsa.Camera(view.camera_to_world, fov=45.0, width=16, height=16), translation={"x": 1e-3})
    found = nsa.bound(scene, poses, time_budget=2.0, outputs=("rgb", "depth"))
    assert set(found.layers) == {"depth"} and found.layers["depth"].lower.shape == (16, 16)
    assert not nsa.bound(scene, poses, time_budget=2.0).layers
    with pytest.raises(InputError, match="no depth"):
        nsa.bound(nsa.load_scene(blobs.config, renderer="paper"), poses, outputs=("depth",))
    with pytest.raises(InputError, match="median"):
        nsa.bound(scene, poses, outputs=("median",))
