"""The demo's NeRF comes from weights that ship: they are what was fitted, and what is damaged is refused."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from benchmark_scripts import script

from ns_abstract.demo.scenes import DATA, NERFACTO_SCALE, buoy_scene, buoy_weights, nerfacto_scene
from ns_abstract.demo.writing import write_nerf_demo, write_nerfacto_demo
from ns_abstract.geometry.camera_path import load_camera_path
from ns_abstract.io.errors import InputError
from ns_abstract.methods.load import load_any
from ns_abstract.methods.nerf.nerfacto_render import NerfactoRenderer
from ns_abstract.methods.nerf.render import NerfRenderer, Sampling

WEIGHTS, NERFACTO = DATA / "buoy.npz", DATA / "buoy_nerfacto.npz"
NerfNetwork = script("nerf_network").NerfNetwork


def fitted() -> Any:
    """The network of the weights that ship."""
    network = NerfNetwork()
    with torch.no_grad():
        for parameter, values in zip(network.parameters(), buoy_weights().arrays(), strict=True):
            parameter.copy_(torch.from_numpy(values))
    return network


@pytest.fixture
def fit() -> ModuleType:
    """The script that fitted the weights."""
    return script("fit_buoy")


def test_weights_show_the_buoy(fit: ModuleType) -> None:
    """Opacity of 3 cm and colour, on average, at points all around; an unfitted network errs by 0.3 and 0.4."""
    generator = torch.Generator().manual_seed(5)
    x = torch.randn(20_000, 3, generator=generator)
    x *= fit.REACH * torch.rand(20_000, 1, generator=generator).sqrt() / x.norm(dim=1, keepdim=True)
    direction = torch.nn.functional.normalize(torch.randn(20_000, 3, generator=generator), dim=1)
    density, color = fit.buoy(x, direction)
    network = fitted()
    with torch.no_grad():
        raw, h = network.raw_density(x)
        found = network.colors(h, direction)
    clear = torch.exp(-0.03 * torch.nn.functional.softplus(raw)) - torch.exp(-0.03 * density)
    assert float(clear.abs().mean()) < 0.03
    assert float((found - color)[density > 0.5].abs().mean()) < 0.03


def test_weights_are_small() -> None:
    assert WEIGHTS.stat().st_size < 500_000


def test_run_holds_the_weights(tmp_path: Path) -> None:
    config, _ = write_nerf_demo(tmp_path)
    for found, wanted in zip(load_any(config).fine.arrays(), buoy_scene().fine.arrays(), strict=True):
        np.testing.assert_array_equal(found, wanted)


def test_quantised_parameters_are_read_back(fit: ModuleType, tmp_path: Path) -> None:
    """Every weight within half a step of what was fitted."""
    np.savez(tmp_path / "again.npz", **fit.quantised(fitted()))
    again = buoy_weights(tmp_path / "again.npz")
    for before, after in zip(buoy_weights().arrays(), again.arrays(), strict=True):
        step = np.abs(before).max(axis=1, keepdims=True) / 31 if before.ndim == 2 else 0.0
        assert bool((np.abs(before - after) <= 0.51 * step).all())


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda a: a.pop("base.3.weight"), "base.3.weight"),
        (lambda a: a.pop("base.3.weight.scale"), "base.3.weight.scale"),
        (lambda a: a.update({"color.bias": np.zeros(4, np.float32)}), "color.bias"),
        (lambda a: a.update({"density.bias": np.array([np.nan], np.float32)}), "not finite"),
        (lambda a: a.update({"base.0.weight": a["base.0.weight"].astype(np.float32)}), "float32"),
        (lambda a: a.update({"base.0.bias": np.array([{}], object)}), "base.0.bias|allow_pickle"),
    ],
)
def test_damaged_weights_are_refused(tmp_path: Path, change: Any, words: str) -> None:
    arrays = dict(np.load(WEIGHTS))
    change(arrays)
    np.savez(tmp_path / "changed.npz", **arrays)
    with pytest.raises(InputError, match=words):
        buoy_weights(tmp_path / "changed.npz")


def test_files_that_are_no_archive_are_refused(tmp_path: Path) -> None:
    (tmp_path / "cut.npz").write_bytes(WEIGHTS.read_bytes()[:1000])
    for file in (tmp_path / "cut.npz", tmp_path / "none.npz"):
        with pytest.raises(InputError, match=r"cannot be read|no such scene"):
            buoy_weights(file)


# ---------------------------------------------------------------- nerfacto


@pytest.mark.slow
def test_the_nerfacto_shows_the_buoy(tmp_path: Path) -> None:
    """The run that is written has the weights that ship, and shows what the field was trained on."""
    config, path = write_nerfacto_demo(tmp_path)
    field = load_any(config).field
    for found, wanted in zip(field.arrays(), nerfacto_scene().field.arrays(), strict=True):
        np.testing.assert_array_equal(found, wanted)
    camera = load_camera_path(path).cameras[0].rescaled(0.5)
    grid = np.indices((camera.height, camera.width)).reshape(2, -1).T
    shown = NerfactoRenderer(field).pixels(camera, camera.camera_to_world, grid)
    pose = camera.camera_to_world.copy()
    pose[:, 3] /= NERFACTO_SCALE
    wanted = NerfRenderer(buoy_scene(), Sampling("hierarchical", 0.0, 6.0, 64, 128, (0.0, 0.0, 0.0)), torch.float32)
    difference = shown - wanted.pixels(camera, pose, grid)
    assert np.abs(difference).mean() < 0.02 and shown.std() > 0.1
    assert NERFACTO.stat().st_size < 300_000


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda a: a.pop("field.table"), "field.table"),
        (lambda a: a.update({"proposal0.scale": np.ones((3, 1, 1), np.float32)}), "proposal0.scale"),
        (lambda a: a.update({"color.0.weight": np.zeros((32, 30), np.float32)}), "color.0.weight"),
        (lambda a: a.update({"density.1.bias": np.full(16, np.nan, np.float32)}), "not finite"),
    ],
)
def test_damaged_nerfacto_weights_are_refused(tmp_path: Path, change: Any, words: str) -> None:
    arrays = dict(np.load(NERFACTO))
    change(arrays)
    np.savez(tmp_path / "changed.npz", **arrays)
    with pytest.raises(InputError, match=words):
        nerfacto_scene(tmp_path / "changed.npz")
