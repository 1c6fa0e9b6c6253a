"""Nerfacto: what is read, what is refused, and Nerfstudio's own picture in float64."""

from __future__ import annotations

import dataclasses
import importlib
import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from benchmark_scripts import BENCHMARKS
from nerfactos import tiny_nerfacto
from nerfs import view
from nerfstudio_runs import environment, needs_nerfstudio
from scene_files import change, checkpoint_of

import ns_abstract as nsa
from ns_abstract.geometry.keyframe_cameras import look_at
from ns_abstract.io.errors import InputError
from ns_abstract.methods.load import load_any
from ns_abstract.methods.nerf import nerfacto_load
from ns_abstract.methods.nerf.hash_bounds.features import hash_row
from ns_abstract.methods.nerf.hash_field import NerfactoField, NerfactoScene
from ns_abstract.methods.nerf.nerfacto_load import resolutions, with_mean
from ns_abstract.methods.nerf.nerfacto_render import (
    NerfactoRenderer,
    contracted,
    evaluate_net,
    even,
    grid_features,
    harmonics,
    next_places,
    quantiles,
)
from ns_abstract.methods.nerf.render import interval_weights
from ns_abstract.methods.nerf.write import write_nerfacto_run
from ns_abstract.methods.overrides import Overrides
from ns_abstract.nerfstudio.torchvision_operators import declare_missing


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return write_nerfacto_run(tiny_nerfacto(1), tmp_path / "runs", timestamp="t", experiment_name="tiny")


def some_rays(count: int, seed: int = 3) -> np.ndarray:
    """[count, 2, 3] origins, some of them in contracted space, and unit directions."""
    rng = np.random.default_rng(seed)
    directions = rng.standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.stack([0.9 * rng.standard_normal((count, 3)), directions], axis=1)


def colors(field: NerfactoField, rays: np.ndarray) -> np.ndarray:
    """[n, 3] of rays [n, 2, 3]."""
    origins, directions = torch.from_numpy(rays).unbind(dim=1)
    return NerfactoRenderer(field).colors(origins, directions).numpy()


# ---------------------------------------------------------------- files


def test_a_run_is_read_as_it_was_written(run: Path) -> None:
    scene, written = load_any(run), tiny_nerfacto(1)
    assert isinstance(scene, NerfactoScene)
    for found, expected in zip(scene.field.arrays(), written.field.arrays(), strict=True):
        np.testing.assert_array_equal(found, expected)
    for name in ("samples", "near", "far", "spacing", "average_init_density", "contraction"):
        assert getattr(scene.field, name) == getattr(written.field, name)
    np.testing.assert_array_equal(scene.field.background, np.zeros(3))
    assert "16 29 54 100; 16 28 50; 16 28 50" in {one.value for one in scene.assumptions}


TABLE, PROPOSAL = "_model.field.mlp_base.model.0.hash_table", "_model.proposal_networks.0."


@pytest.mark.slow_cases(every=3)
@pytest.mark.parametrize(
    ("edit", "fragment"),
    [
        (lambda s: s.pop(TABLE), "hash_table: missing"),
        (lambda s: s.update({TABLE: s[TABLE][:-1]}), "a table of [2047, 2], config.yml says [2048, 2]"),
        (lambda s: s[TABLE].view(-1)[5].fill_(math.nan), "not finite"),
        (lambda s: s.update({TABLE: s[TABLE].long()}), "int64 tensor"),
        (lambda s: s.update({TABLE: s[TABLE][:1].expand(2048, 2).to_sparse()}), "sparse tensor"),
        (lambda s: s["_model.field.num_levels"].fill_(5), "found 5, config.yml says 4"),
        (lambda s: s[PROPOSAL + "max_res"].fill_(64), "found 64, config.yml says"),
        (lambda s: s.update({PROPOSAL + "encoding.hash_table": s[PROPOSAL + "encoding.hash_table"] + 1}), "differs"),
        (lambda s: s.pop("_model.field.mlp_head.layers.1.bias"), "mlp_head.layers.1.bias: missing"),
        (lambda s: s.update({"_model.field.mlp_head.layers.1.weight": torch.zeros(16, 9)}), "config.yml says [16, 16]"),
        (lambda s: s.update({"_model.field.mlp_base.model.params": torch.zeros(9)}), "tiny-cuda-nn"),
        (lambda s: s.update({"_model.field.mlp_transient.layers.0.weight": torch.zeros(9, 9)}), "does not have"),
        (lambda s: s.update({"_model.field.embedding_appearance.embedding.weight": torch.zeros(3, 8)}), "does not"),
        (lambda s: [s.pop(k) for k in list(s) if ".field." in k], "no nerfacto"),
        (lambda s: [s.pop(k) for k in list(s) if "networks.1" in k], "proposal_networks.1.mlp_base.0.hash_table"),
    ],
)
def test_damaged_checkpoints(run: Path, edit: Callable[[dict], Any], fragment: str) -> None:
    change(run, edit)
    with pytest.raises(InputError) as error:
        load_any(run)
    assert fragment in str(error.value) and str(checkpoint_of(run)) in str(error.value)
    assert error.value.fix and len(str(error.value).splitlines()) == 1


def test_runs_of_tiny_cuda_nn_are_told_what_to_train(run: Path) -> None:
    change(run, lambda s: s.update({"_model.field.mlp_base.model.params": torch.zeros(9)}))
    with pytest.raises(InputError, match=r"--pipeline\.model\.implementation torch"):
        load_any(run)
    # without tiny-cuda-nn, Nerfstudio trains torch's fields under either name
    change(run, lambda s: s.pop("_model.field.mlp_base.model.params"))
    run.write_text(run.read_text().replace("implementation: torch", "implementation: tcnn"))
    np.testing.assert_array_equal(load_any(run).field.encoding.table, tiny_nerfacto(1).field.encoding.table)


def test_memory_is_estimated_before_tables_are_read(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def check(needed: int, file: Path, what: str) -> None:
        asked.append(needed)
        raise InputError(f"{what} need {needed}")

    monkeypatch.setattr(nerfacto_load, "check_memory", check)
    # sizes that nobody has: 2^30 rows by level
    run.write_text(run.read_text().replace("    log2_hashmap_size: 9", "    log2_hashmap_size: 30"))
    with pytest.raises(InputError, match="the hash tables need"):
        load_any(run)
    assert asked[0] >= 4 * 2**30 * 2 * 8


def test_backgrounds_and_overrides(run: Path) -> None:
    text = run.read_text()
    for name, color in (("white", [1.0] * 3), ("random", [0.0] * 3), ("last_sample", None)):
        run.write_text(text.replace("background_color: black", f"background_color: {name}"))
        found = load_any(run).field.background
        assert found == "last_sample" if color is None else found.tolist() == color
    assert load_any(run, Overrides(background=(0.5, 0.25, 0.0))).field.background.tolist() == [0.5, 0.25, 0.0]


def test_the_mean_embedding_is_rounded_once() -> None:
    from fractions import Fraction

    rng = np.random.default_rng(0)
    bias, weight = rng.standard_normal(3), rng.standard_normal((3, 4)).astype(np.float32).astype(np.float64)
    rows = (rng.standard_normal((7, 4)) * 10.0 ** rng.integers(-30, 20, (7, 4))).astype(np.float32)
    means = [sum(map(Fraction, column), Fraction(0)) / 7 for column in rows.T.astype(float).tolist()]
    exact = [
        Fraction(b) + sum(Fraction(w) * m for w, m in zip(row, means, strict=True))
        for b, row in zip(bias.tolist(), weight.tolist(), strict=True)
    ]
    assert with_mean(bias, weight, rows).tolist() == [float(value) for value in exact]


# ---------------------------------------------------------------- rules


def test_resolutions_are_rounded_down_in_float32() -> None:
    # 2048 and 512 are exact; float64 rounds the latter to 511
    assert resolutions(16, 16, 2048).tolist()[-1] == 2047
    assert resolutions(10, 16, 512).tolist()[-1] == 512
    assert resolutions(5, 16, 256).tolist() == [16, 32, 64, 128, 256]
    assert resolutions(6, 16, 500).tolist() == [16, 31, 63, 126, 251, 500]
    assert resolutions(1, 16, 500).tolist() == [16]


def test_corners_have_the_rows_of_the_hash() -> None:
    for x, y, z in ((0, 0, 0), (1, 2, 3), (2047, 2047, 2046), (511, 0, 300)):
        wanted = (x ^ (y * 2654435761) ^ (z * 805459861)) % 2**19
        assert hash_row(x, y, z, 2**19) == wanted


def test_features_are_interpolated_between_corners() -> None:
    """Also on faces of cells, where floor and ceiling agree."""
    encoding = tiny_nerfacto(2).field.encoding
    x = np.random.default_rng(0).uniform(0.0, 1.0, (60, 3))
    x[:20] = np.round(16.0 * x[:20]) / 16.0
    for place, found in zip(x, grid_features(encoding, torch.from_numpy(x)).numpy(), strict=True):
        features = []
        for table, size in zip(encoding.table, encoding.resolutions, strict=True):
            low = np.floor(place * size)
            part, total = place * size - low, np.zeros(table.shape[1])
            for corner in np.ndindex(2, 2, 2):
                node = (int(a) + (c if p else 0) for a, c, p in zip(low, corner, part, strict=True))
                share = np.prod([p if c else 1.0 - p for c, p in zip(corner, part, strict=True)])
                total += share * table[hash_row(*node, len(table))]
            features.append(total)
        np.testing.assert_allclose(found, np.concatenate(features), rtol=0.0, atol=2e-15)


def test_harmonics_are_of_shifted_directions() -> None:
    direction = np.array([0.48, -0.6, 0.64])
    found = harmonics(torch.from_numpy(direction)).numpy()
    # linear harmonics of (d + 1) / 2
    np.testing.assert_allclose(found[[3, 1, 2]], 0.4886025119029199 * (direction + 1.0) / 2.0, rtol=1e-15)


def test_harmonics_are_orthonormal_on_the_sphere() -> None:
    """Exact quadrature of polynomials of degree 6: Gauss's nodes along z, equal steps around it."""
    z, weights = np.polynomial.legendre.leggauss(8)
    turns = 2.0 * np.pi * np.arange(16) / 16
    z, turn = (a.ravel() for a in np.meshgrid(z, turns, indexing="ij"))
    points = np.stack([np.sqrt(1.0 - z * z) * np.cos(turn), np.sqrt(1.0 - z * z) * np.sin(turn), z], axis=1)
    values = harmonics(torch.from_numpy(2.0 * points - 1.0)).numpy()
    area = np.repeat(weights, 16) * 2.0 * np.pi / 16
    np.testing.assert_allclose(values.T @ (area[:, None] * values), np.eye(16), rtol=0.0, atol=1e-12)


def test_edges_are_quantiles_of_padded_weights() -> None:
    """Of an empty ray every bin is as likely: edges are equally spaced, from half a step on."""
    places, wanted = even(1.0, 33), quantiles(8)
    np.testing.assert_allclose(wanted, (np.arange(9) + 0.5) / 9, rtol=1e-15)
    found = next_places(places[None], torch.zeros(1, 32, dtype=torch.float64), 8)
    np.testing.assert_allclose(found[0], wanted, rtol=1e-14)
    # all weight in one bin: it has 1.01 of 1.32, every other 0.01
    weights = np.zeros(32)
    weights[4] = 1.0
    found = next_places(places[None], torch.from_numpy(weights)[None], 8)
    knots = np.concatenate([[0.0], np.cumsum(weights + 0.01) / 1.32])
    np.testing.assert_allclose(found[0], np.interp(wanted, knots, places), rtol=1e-13)


def test_weights_of_overflowing_densities_are_numbers() -> None:
    density = torch.tensor([[0.1, math.inf, 0.5], [0.0, math.inf, math.inf]], dtype=torch.float64)
    lengths = torch.tensor([[1.0, 0.0, 1.0], [1.0, 1.0, 1.0]], dtype=torch.float64)
    weights = interval_weights(density, lengths)
    assert abs(weights[0, 0] + math.expm1(-0.1)) < 1e-16
    assert weights[0, 1] == 0.0 and weights[0, 2] == 0.0
    assert weights[1].tolist() == [0.0, 1.0, 0.0]


@pytest.mark.parametrize("background", ["last_sample", None])
@pytest.mark.parametrize("spacing", ["piecewise", "uniform"])
def test_samples_without_weight_do_not_count(background: str | None, spacing: str) -> None:
    """Their colours are left out where no slopes are asked for."""
    field = tiny_nerfacto(3).field
    field = dataclasses.replace(field, spacing=spacing, background=background or np.array([0.2, 0.5, 1.0]))
    origins, directions = torch.from_numpy(some_rays(20)).unbind(dim=1)
    found = NerfactoRenderer(field).colors(origins, directions, (0.2, -0.1))
    assert found.std(dim=0).min() > 0.02
    shown = NerfactoRenderer(field).colors(origins.requires_grad_(), directions, (0.2, -0.1))
    np.testing.assert_allclose(shown.detach(), found, rtol=0.0, atol=1e-14)
    (slope,) = torch.autograd.grad(shown.sum(), origins)
    assert bool(torch.isfinite(slope).all()) and float(slope.abs().max()) > 0.0


def test_empty_rays_show_the_last_samples_colour() -> None:
    field = dataclasses.replace(tiny_nerfacto(3, density=-900.0).field, background="last_sample")
    origins, directions = torch.from_numpy(some_rays(5)).unbind(dim=1)
    shown, edges = colors(field, some_rays(5)), NerfactoRenderer(field).edges(origins, directions)
    assert shown.min() > 0.0
    points = contracted(origins + 0.5 * (edges[:, -2:].sum(dim=1, keepdim=True)) * directions)
    raw = evaluate_net(field.density_net, grid_features(field.encoding, points))
    wanted = torch.sigmoid(evaluate_net(field.color_net, torch.cat([harmonics(directions), raw[:, 1:]], dim=1)))
    np.testing.assert_allclose(shown, wanted, rtol=1e-12)


def test_pictures_of_the_interface_are_rendered(run: Path) -> None:
    scene, camera = nsa.load_scene(run), view()
    picture = nsa.render(scene, camera)
    grid = np.indices((camera.height, camera.width)).reshape(2, -1).T
    wanted = NerfactoRenderer(tiny_nerfacto(1).field).pixels(camera, camera.camera_to_world, grid)
    np.testing.assert_array_equal(picture.reshape(-1, 3), wanted)


@pytest.mark.parametrize(
    ("option", "fragment"),
    [
        ({"num_samples": 8}, "--num-samples"),
        ({"near_plane": 0.1}, "--near-plane"),
        ({"renderer": "paper"}, "--renderer"),
        ({"sampling": "uniform"}, "--sampling"),
        ({"gsplat_version": "1.5.3"}, "--gsplat-version"),
    ],
)
def test_options_of_other_methods_are_refused(run: Path, option: dict[str, Any], fragment: str) -> None:
    with pytest.raises(InputError, match=fragment):
        nsa.load_scene(run, **option)


# ---------------------------------------------------------------- Nerfstudio


def nerfstudio_model(config: Any) -> Any:
    """Nerfstudio's model of a configuration, opaque in places, with different colours."""
    module = importlib.import_module("nerfstudio.models.nerfacto")
    box = importlib.import_module("nerfstudio.data.scene_box").SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3]))
    torch.manual_seed(0)
    model = module.NerfactoModel(config, scene_box=box, num_train_data=5).eval()
    for name, value in model.named_parameters():
        if "hash_table" in name:
            value.data.mul_(2000.0)
        elif "layers" in name and name.endswith("weight"):
            value.data.mul_(2.5)
        elif name.endswith(("mlp_base.model.1.layers.1.bias", "mlp_base.1.layers.1.bias")):
            value.data[0] = 3.0
    return model


def loaded(folder: Path, model: Any, edits: dict[str, str]) -> NerfactoScene:
    """The scene of a run that holds the model's own state."""
    config = write_nerfacto_run(tiny_nerfacto(1), folder, timestamp="t", experiment_name="e")
    lines = []
    for line in config.read_text().splitlines():
        key = line.removeprefix("    ").partition(":")[0]
        if not line.startswith("    - {"):
            lines.append(f"    {key}: {edits[key]}" if key in edits and line.startswith("    ") else line)
    config.write_text("\n".join(lines) + "\n")
    state = {f"_model.{name}": value.clone() for name, value in model.state_dict().items()}
    torch.save({"step": 1, "pipeline": state}, checkpoint_of(config))
    return load_any(config)


@pytest.mark.slow
@needs_nerfstudio
def test_nerfstudio_shows_the_same_picture_in_float64(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """1,000 rays of a model with embedding and normals, and 50 before each other background and spacing."""
    declare_missing()
    metric = importlib.import_module("torchmetrics.image.lpip")
    monkeypatch.setattr(metric, "LearnedPerceptualImagePatchSimilarity", lambda **options: torch.nn.Identity())
    nerfacto = importlib.import_module("nerfstudio.models.nerfacto")
    samplers = importlib.import_module("nerfstudio.model_components.ray_samplers")
    RayBundle = importlib.import_module("nerfstudio.cameras.rays").RayBundle
    proposals = [
        {"hidden_dim": 16, "log2_hashmap_size": 10, "num_levels": 4, "max_res": 64, "use_linear": False},
        {"hidden_dim": 8, "log2_hashmap_size": 10, "num_levels": 5, "max_res": 128, "use_linear": False},
    ]
    model = nerfstudio_model(
        nerfacto.NerfactoModelConfig(
            implementation="torch", num_levels=6, max_res=500, log2_hashmap_size=12, average_init_density=0.01,
            num_proposal_samples_per_ray=(64, 32), num_nerf_samples_per_ray=24, proposal_net_args_list=proposals,
            predict_normals=True,
        )
    )  # fmt: skip
    written = ", ".join(str(one).replace("'", "").replace("False", "false") for one in proposals)
    field = loaded(
        tmp_path, model,
        {
            "num_levels": "6", "max_res": "500", "log2_hashmap_size": "12", "hidden_dim": "64",
            "hidden_dim_color": "64", "num_proposal_samples_per_ray": "[64, 32]", "num_nerf_samples_per_ray": "24",
            "far_plane": "1000.0", "background_color": "last_sample", "use_appearance_embedding": "true",
            "proposal_net_args_list": f"[{written}]", "predict_normals": "true",
        },
    ).field  # fmt: skip
    assert field.encoding.resolutions.tolist() == model.field.mlp_base.model[0].scalings.int().tolist()
    rays = some_rays(1000)
    try:
        # built in float32, which fixes the resolutions
        torch.set_default_dtype(torch.float64)
        model = model.double()

        def shown(count: int) -> np.ndarray:
            origins, directions = torch.from_numpy(rays[:count]).unbind(dim=1)
            places = torch.ones(count, 1), torch.zeros(count, 1, dtype=torch.long)
            with torch.no_grad():
                outputs = model(RayBundle(origins, directions, places[0], camera_indices=places[1]))
            return outputs["rgb"].numpy()

        wanted = shown(1000)
        assert wanted.std(axis=0).min() > 0.02
        np.testing.assert_allclose(colors(field, rays), wanted, rtol=0.0, atol=1e-12)
        for name, color in (("random", 0.0), ("white", 1.0)):
            model.renderer_rgb.background_color = name
            found = colors(dataclasses.replace(field, background=np.full(3, color)), rays[:50])
            np.testing.assert_allclose(found, shown(50), rtol=0.0, atol=1e-12)
        model.collider.far_plane, model.proposal_sampler.initial_sampler = 6.0, samplers.UniformSampler().eval()
        uniform = dataclasses.replace(field, background=np.ones(3), far=6.0, spacing="uniform")
        np.testing.assert_allclose(colors(uniform, rays[:50]), shown(50), rtol=0.0, atol=1e-12)
    finally:
        torch.set_default_dtype(torch.float32)


@pytest.mark.slow
@needs_nerfstudio
def test_runs_that_nerfstudio_trains_are_read(tmp_path: Path) -> None:
    """Two steps of abstract-nerfacto on four small pictures; all that the run holds is known."""
    poses = np.stack([look_at((3.0, k, 1.0), (0.0, 0.0, 0.0)) for k in range(4)])
    images = np.random.default_rng(0).integers(0, 256, (4, 8, 8, 4), dtype=np.uint8)
    np.savez(tmp_path / "pictures.npz", images=images, c2w=poses, focal=9.0)
    options = ["--steps", "2", "--rays", "16", "--log2-table", "8", "--levels", "3", "--max-res", "40"]
    # in a process of its own: Nerfstudio's training leaves writers behind
    subprocess.run(
        [sys.executable, BENCHMARKS / "train_nerfacto.py", tmp_path / "pictures.npz", tmp_path, *options],
        env=environment(tmp_path), cwd=tmp_path, check=True, capture_output=True, timeout=800,
    )  # fmt: skip
    scene = load_any(tmp_path / "lego" / "abstract-nerfacto" / "trained")
    assert (scene.field.samples, scene.field.far, scene.dataparser.scale) == ((64, 32, 24), 5.0, 0.8)
    assert scene.field.encoding.table.shape == (3, 256, 2)
    assert colors(scene.field, some_rays(3)).shape == (3, 3)
