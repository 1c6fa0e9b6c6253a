"""Fields bounded by torch alone, as on a GPU: attacked at tolerance zero, as tight as compiled kernels; --device."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from nerfs import UNIFORM, NerfNetwork, pixels_of, poses, tiny_scene
from test_nerf_certify import COSTLY, cells, outside
from test_nerf_frame import FIELDS, SETS, attack

from ns_abstract.arithmetic.rounding import UNIT64
from ns_abstract.io.errors import InputError
from ns_abstract.methods.nerf import device as device_module
from ns_abstract.methods.nerf import zonotope
from ns_abstract.methods.nerf.bounds import NerfBounds
from ns_abstract.methods.nerf.device import check_device, processes_that_fit
from ns_abstract.methods.nerf.frame import NerfFrame
from ns_abstract.methods.nerf.method import NerfMethod
from ns_abstract.methods.nerf.ray_field import RayBounds, basis_of, cells_at_once, device_bytes
from ns_abstract.methods.nerf.render import Sampling
from ns_abstract.methods.nerf.scene import NerfScene

#: Where torch bounds fields alone: here, and on a GPU if there is one.
DEVICES = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]


def bounded(
    scene: NerfScene, name: str, *, device: str = "cpu", compiled: bool = False, sampling: Sampling = UNIFORM
) -> RayBounds:
    pose_set = poses(SETS[name])
    bounds = NerfBounds(scene, sampling, pose_set.box.dimensions, device, compiled)
    return bounds.rays(pose_set, pose_set.box, pixels_of(pose_set.camera), 0.02)


@pytest.mark.slow_cases(every=5)
@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", ["point", "yaw", "orbit", "yaw and shift", "three"])
@pytest.mark.parametrize("field", FIELDS)
def test_no_render_lies_outside(field: str, name: str, device: str) -> None:
    scene = tiny_scene(3, **FIELDS[field])
    comparisons, violations = attack(scene, poses(SETS[name]), bounded(scene, name, device=device), 20)
    assert comparisons > (300 if name != "point" else 0) and violations == 0


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", ["yaw", "orbit", "yaw and shift"])
def test_as_tight_as_compiled_kernels(name: str, device: str) -> None:
    """The same rules in other orders of sums, and without the kernels' float32 columns."""
    scene = tiny_scene(3)
    mine, theirs = bounded(scene, name, device=device), bounded(scene, name, compiled=True)
    assert mine.cells == theirs.cells
    gap = (theirs.upper - theirs.lower).mean()
    assert 0.0 < gap < 0.5
    assert np.abs(mine.lower - theirs.lower).max() < 1e-3 * gap
    assert np.abs(mine.upper - theirs.upper).max() < 1e-3 * gap


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
def test_bins_of_the_coarse_pass(device: str) -> None:
    scene, pose_set = tiny_scene(0), poses(SETS["yaw"])
    bins = Sampling("hierarchical", 0.0, 4.0, 12, 12, (0.0, 0.0, 0.0))
    found = bounded(scene, "yaw", device=device, sampling=bins)
    assert (found.upper - found.lower).mean() < 1.0
    pixels = pixels_of(pose_set.camera)
    frame = NerfFrame(scene, bins, pose_set)
    for values in pose_set.box.sample(40, np.random.default_rng(0)):
        colors = frame.renderer.pixels(pose_set.camera, pose_set.pose(values), pixels)
        assert ((found.lower <= colors) & (colors <= found.upper)).all()


@pytest.mark.parametrize("device", DEVICES)
def test_cells_of_certificates(device: str) -> None:
    scene, pose_set = tiny_scene(3), poses(SETS["orbit"])
    frame = NerfFrame(scene, UNIFORM, pose_set, device)
    frame.bounds = NerfBounds(scene, UNIFORM, 1, device, compiled=False)
    for box in cells(frame.box):
        found = frame.cell_bounds(box, lambda: COSTLY)
        assert (found.upper - found.lower).mean() < 0.5, "nothing was bounded"
        assert outside(frame, box, found) == 0


@pytest.mark.slow
def test_a_planted_fault_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    sums = zonotope.column_sums
    monkeypatch.setattr(zonotope, "column_sums", lambda *arguments: 0.2 * sums(*arguments))
    violations = 0
    for seed in range(4):
        scene = tiny_scene(seed, rough=20.0)
        violations += attack(scene, poses(SETS["yaw"]), bounded(scene, "yaw"), 60)[1]
    assert violations > 0


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_functions_of_the_device_are_as_exact_as_charged() -> None:
    """Of float64 on a GPU, against the processor's."""
    x = torch.linspace(-40.0, 40.0, 1_000_001, dtype=torch.float64)
    for function in (torch.exp, torch.expm1, torch.sigmoid, torch.tanh, torch.cosh):
        here, there = function(x), function(x.cuda()).cpu()
        assert ((here - there).abs() <= 8.0 * UNIT64 * here.abs()).all(), function
    y = torch.exp(-x.abs())
    assert ((torch.log1p(y) - torch.log1p(y.cuda()).cpu()).abs() <= 8.0 * UNIT64 * torch.log1p(y)).all()
    z = 1000.0 * x
    for function in (torch.sin, torch.cos):
        assert (function(z) - function(z.cuda()).cpu()).abs().max() <= 8.0 * UNIT64


def test_batches_fit_the_fields() -> None:
    """Wider layers and finer grids have smaller batches."""
    narrow, wide = tiny_scene(0).fine, NerfNetwork(3, 256, 1, 2, 128).weights()
    for dimensions in (1, 2, 3):
        basis = basis_of(dimensions, wide)
        assert cells_at_once(narrow, basis) > cells_at_once(wide, basis) >= 1
        values = 8 * len(basis.evaluation) * cells_at_once(wide, basis) * wide.width
        assert values < device_bytes(wide, basis) < 2**33


def test_processes_share_a_devices_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda: (10 << 30, 16 << 30))
    processes_that_fit.cache_clear()
    assert [processes_that_fit(3 << 30, most) for most in (1, 2, 8)] == [1, 2, 3]
    with pytest.raises(InputError, match=r"10\.0 GiB free, 11\.0 GiB") as found:
        processes_that_fit(11 << 30, 1)
    assert found.value.field == "--device"
    processes_that_fit.cache_clear()


def test_devices_that_cannot_be_used(monkeypatch: pytest.MonkeyPatch) -> None:
    assert check_device(None) == check_device("cpu") == "cpu"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for device, words in (("cuda", "no CUDA device"), ("tpu", "tpu")):
        with pytest.raises(InputError, match=words) as found:
            NerfMethod(tiny_scene(0), device=device)
        assert found.value.field == "--device"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert check_device("cuda") == "cuda"
    monkeypatch.setenv(device_module.EMULATION, "1")
    with pytest.raises(InputError, match="emulated") as found:
        check_device("cuda")
    assert found.value.field == device_module.EMULATION


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_processes_of_a_device_find_the_same() -> None:
    scene, pose_set = tiny_scene(2, density=30.0), poses(SETS["yaw"])
    box, tiles = pose_set.box.split(0, 2)[0], np.arange(12)
    shared, alone = (NerfFrame(scene, UNIFORM, pose_set, "cuda", workers) for workers in (2, 1))
    together, apart = shared.bound(box, tiles), alone.bound(box, tiles)
    gap = float((apart.upper - apart.lower).mean())
    assert np.abs(together.lower - apart.lower).max() < 0.05 * gap
    assert np.abs(together.upper - apart.upper).max() < 0.05 * gap
