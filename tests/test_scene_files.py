"""Scenes are those that their files say: step, mode, background, class, values that are not finite, other kinds.

Pictures are compared with gsplat's own kernels, built for the processor, and with formulas in high precision.
"""

from __future__ import annotations

import dataclasses
import json
import pickle
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import pytest
import torch
from conftest import blob_scene
from nerfs import tiny_scene
from scene_files import (
    EARLY,
    LATE,
    MIP,
    NAN,
    change,
    checkpoint_of,
    differ,
    edit,
    nerf_run,
    origin_of,
    path_of,
    picture,
    ply,
    refused,
    shows,
    thin_scene,
    two_steps,
)

import ns_abstract as nsa
from ns_abstract.api.files import Settings, open_job
from ns_abstract.io.assumptions import Assumption
from ns_abstract.methods.load import load_any
from ns_abstract.methods.nerf.write import write_nerf_run
from ns_abstract.methods.overrides import Overrides
from ns_abstract.methods.splat.load import load_scene
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.methods.splat.write import write_ply, write_splatfacto_run
from ns_abstract.report import record
from ns_abstract.report.export import Results
from ns_abstract.report.run import guarantee_text

torch.set_num_threads(1)


# Steps


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run of Splatfacto with the steps 29999 and 9999, of which the first is another scene."""
    return two_steps(tmp_path)


def test_the_step_of_the_configuration_is_shown(run: Path) -> None:
    assert differ(EARLY, LATE)
    shows(run, LATE)
    # evaluation replaces load_dir by the run's own folder and does not read load_checkpoint
    edit(run, ("load_step: null", "load_step: 9999"), ("load_dir: null", "load_dir: /elsewhere"))
    edit(run, ("load_checkpoint: null", "load_checkpoint: /elsewhere/step-000000001.ckpt"))
    scene = shows(run, EARLY)
    assert origin_of(scene, "load_step") == Assumption("load_step", "9999", "config.yml: load_step")


def test_the_option_wins_over_the_configuration(run: Path) -> None:
    edit(run, ("load_step: null", "load_step: 9999"))
    record = origin_of(shows(run, LATE, load_step=29999), "load_step")
    assert record.value == "29999" and record.origin == "--load-step (in place of 9999, config.yml: load_step)"


def test_a_missing_step_names_those_that_are_there(run: Path) -> None:
    edit(run, ("load_step: null", "load_step: 5000"))
    refused(run, "load_step: names step 5000", "9999, 29999", "--load-step", str(run))
    message = refused(run, "--load-step: names step 7", "9999, 29999", overrides=Overrides(load_step=7))
    assert str(run) not in message


@pytest.mark.slow_cases(every=4)
@pytest.mark.parametrize("value", ["-1", "9999.0", "true", "text", "[9999]", "!!python/name:os.system ''"])
def test_a_step_that_is_none_is_refused(run: Path, value: str) -> None:
    edit(run, ("load_step: null", f"load_step: {value}"))
    refused(run, "load_step", "write a step")


def test_the_name_that_nerfstudio_writes_comes_first(run: Path) -> None:
    folder = run.parent / "nerfstudio_models"
    other = write_splatfacto_run(blob_scene(3), run.parents[4] / "x", timestamp="t", experiment_name="e")
    content = next((other.parent / "nerfstudio_models").glob("*.ckpt")).read_bytes()
    for name in ("step-9999.ckpt", "step-0000009999.ckpt", "step-0000029999.ckpt"):
        (folder / name).write_bytes(content)
    assert load_scene(run).count == 50
    assert load_scene(run, Overrides(load_step=9999)).count == 40
    (folder / "step-000009999.ckpt").unlink()
    assert load_scene(run, Overrides(load_step=9999)).count == 3


def test_a_nerf_is_of_the_step_of_the_configuration(tmp_path: Path) -> None:
    late, early = nerf_run(tmp_path), write_nerf_run(tiny_scene(2), tmp_path / "2", timestamp="t", experiment_name="n")
    checkpoint_of(early).rename(checkpoint_of(late).with_name("step-000009999.ckpt"))

    def weights(scene: Any) -> np.ndarray:
        return scene.fine.base[0].weight

    assert np.array_equal(weights(load_any(late)), weights(tiny_scene(1)))
    edit(late, ("load_step: null", "load_step: 9999"))
    assert np.array_equal(weights(load_any(late)), weights(tiny_scene(2)))
    assert np.array_equal(weights(load_any(late, Overrides(load_step=29999))), weights(tiny_scene(1)))
    edit(late, ("load_step: 9999", "load_step: 10000"))
    refused(late, "names step 10000", "9999, 29999", "--load-step")


def test_workers_and_continued_results_see_what_was_given(run: Path, tmp_path: Path) -> None:
    path = path_of(tmp_path)
    given = Overrides(rasterize_mode="antialiased", background=(1.0, 0.0, 0.0), load_step=9999)
    jobs = [open_job(Settings(run, path, overrides=overrides)) for overrides in (given, Overrides())]
    assert jobs[0].fingerprint != jobs[1].fingerprint
    again = pickle.loads(pickle.dumps(jobs[0].recipe)).open()
    assert again.fingerprint == jobs[0].fingerprint
    scene = again.method.scene  # type: ignore[attr-defined]
    assert (scene.count, scene.rasterize_mode, scene.background.tolist()) == (40, "antialiased", [1, 0, 0])


# .ply files


COMMENTS = {
    "Brush": (MIP, "antialiased"),
    "Brush, default": (("SplatRenderMode: default",), "classic"),
    "Postshot": (("antialiased 1",), "antialiased"),
    "Postshot, off": (("antialiased 0",), "classic"),
    "capitals": (("SPLATRENDERMODE: MIP",), "antialiased"),
    "small letters": (("splatrendermode:mip",), "antialiased"),
    "spaces": (("   SplatRenderMode   :   Mip   ",), "antialiased"),
    "the last one is default": (("antialiased 1", "SplatRenderMode: default"), "classic"),
    "the last one is 1": (("SplatRenderMode: default", "Antialiased 1"), "antialiased"),
    "the last one is 0": ((*MIP, "antialiased 0"), "classic"),
    "among others": (("Generated by us", *MIP, "Vertical axis: y", "mip is nice"), "antialiased"),
    "other words": (("trained with antialiased 1",), "classic"),
}


@pytest.mark.parametrize("case", COMMENTS)
@pytest.mark.parametrize("text", [False, True])
def test_comments_say_the_mode(tmp_path: Path, case: str, text: bool) -> None:
    comments, mode = COMMENTS[case]
    path = ply(tmp_path / "a.ply", thin_scene(), comments, text)
    scene = load_scene(path)
    assert scene.rasterize_mode == origin_of(scene, "rasterize_mode").value == mode
    assert origin_of(scene, "rasterize_mode").origin.startswith(("comment in the file", "default"))
    assert any("assumed classic" in note for note in scene.notes) == (case == "other words")


@pytest.mark.parametrize("comments", [MIP, ("antialiased 1",)])
def test_a_file_of_compensated_opacities_is_shown_so(tmp_path: Path, comments: tuple[str, ...]) -> None:
    scene = dataclasses.replace(thin_scene("antialiased"), background=np.zeros(3, np.float32))
    assert differ(scene, dataclasses.replace(scene, rasterize_mode="classic"))
    shows(ply(tmp_path / "a.ply", scene, comments), scene)


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_an_exported_scene_is_the_same_scene(tmp_path: Path, mode: str) -> None:
    scene = thin_scene(mode)
    write_ply(scene, tmp_path / "a.ply")
    said = "mip" if mode == "antialiased" else "default"
    assert f"comment SplatRenderMode: {said}\n".encode() in (tmp_path / "a.ply").read_bytes()
    red, green, blue = map(float, scene.background)
    back = load_scene(tmp_path / "a.ply", Overrides(background=(red, green, blue)))
    assert np.array_equal(picture(back), picture(scene))


def test_options_win_over_a_file_and_a_configuration(tmp_path: Path) -> None:
    path = ply(tmp_path / "a.ply", thin_scene(), MIP)
    expected = dataclasses.replace(thin_scene(), background=np.array([1, 0.5, 0], np.float32))
    scene = shows(path, expected, rasterize_mode="classic", background=[1, 0.5, 0])
    mode, color = origin_of(scene, "rasterize_mode"), origin_of(scene, "background")
    assert (mode.value, color.value) == ("classic", "1 0.5 0")
    assert mode.origin == "--rasterize-mode (in place of antialiased, comment in the file: SplatRenderMode: mip)"
    assert color.origin.startswith("--background (in place of 0 0 0, default")
    config = write_splatfacto_run(thin_scene("antialiased"), tmp_path, timestamp="t", experiment_name="e")
    origin = origin_of(shows(config, expected, rasterize_mode="classic", background=(1, 0.5, 0)), "rasterize_mode")
    assert origin.origin == "--rasterize-mode (in place of antialiased, config.yml: pipeline.model.rasterize_mode)"


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"rasterize_mode": "mip"}, "--rasterize-mode"),
        ({"background": (0, 1)}, "--background"),
        ({"background": (0, 1, 2)}, "--background"),
        ({"background": (0, 1, NAN)}, "--background"),
        ({"load_step": -1}, "--load-step"),
        ({"load_step": 3}, "--load-step"),
        ({"assume_splatfacto": True}, "--assume-splatfacto"),
    ],
)
def test_options_that_cannot_be_used(tmp_path: Path, options: dict[str, Any], field: str) -> None:
    with pytest.raises(nsa.InputError, match=field):
        nsa.load_scene(ply(tmp_path / "a.ply", thin_scene()), **options)


@pytest.mark.parametrize("comment", ["SplatRenderMode: surfels", "antialiased 2", "SplatRenderMode:", "antialiased"])
def test_a_mode_that_nobody_knows_is_refused(tmp_path: Path, comment: str) -> None:
    path = ply(tmp_path / "a.ply", thin_scene(), (comment,))
    refused(path, "comment", "--rasterize-mode")
    assert load_scene(path, Overrides(rasterize_mode="antialiased")).rasterize_mode == "antialiased"


def exactly_filtered(scene: SplatScene, width: np.ndarray) -> SplatScene:
    """mip-splatting's 3-D filter (``get_scaling_with_3D_filter``, ``get_opacity_with_3D_filter``), in 40 digits."""
    scales, opacities = scene.log_scales.copy(), scene.opacity_logits.copy()
    with mpmath.workdps(40):
        for i, f in enumerate(width):
            squares = [mpmath.exp(mpmath.mpf(float(s))) ** 2 for s in scene.log_scales[i]]
            after = [square + mpmath.mpf(float(f)) ** 2 for square in squares]
            weight = mpmath.sqrt(mpmath.fprod(squares) / mpmath.fprod(after))
            opacity = weight / (1 + mpmath.exp(-mpmath.mpf(float(scene.opacity_logits[i]))))
            scales[i] = [float(mpmath.log(mpmath.sqrt(value))) for value in after]
            opacities[i] = float(mpmath.log(opacity / (1 - opacity)))
    return dataclasses.replace(scene, log_scales=scales, opacity_logits=opacities)


def test_the_filter_of_mip_splatting_is_applied(tmp_path: Path) -> None:
    scene = dataclasses.replace(thin_scene(), background=np.zeros(3, np.float32))
    width = np.random.default_rng(0).uniform(0.0, 0.05, scene.count).astype(np.float32)
    expected = exactly_filtered(scene, width)
    assert differ(scene, expected)
    found = load_scene(ply(tmp_path / "a.ply", scene, filter_3D=width))
    np.testing.assert_allclose(found.log_scales, expected.log_scales, rtol=1.3e-7)
    np.testing.assert_allclose(found.opacity_logits, expected.opacity_logits, rtol=1.3e-7, atol=1e-7)
    assert any("filter_3D is applied" in note for note in found.notes)
    shows(tmp_path / "a.ply", expected)
    width[:] = 0.0
    same = load_scene(ply(tmp_path / "b.ply", scene, filter_3D=width))
    assert np.array_equal(same.log_scales, scene.log_scales)
    assert np.array_equal(same.opacity_logits, scene.opacity_logits)


def test_columns_that_are_not_used_are_named(tmp_path: Path) -> None:
    scene = load_scene(ply(tmp_path / "a.ply", thin_scene(), label=1.0, red=0.0))
    assert "not used: nx, ny, nz, label, red" in scene.notes


OTHER_SPLATS = {
    "no third scale": ({"scale_2": None}, (), "2-D Gaussians"),
    "a comment": ({}, ("SplatRenderMode: 2dgs",), "2-D Gaussians"),
    "a comment of capitals before another": ({}, ("SPLATRENDERMODE: 2DGS", "antialiased 1"), "2-D Gaussians"),
    "spherical Gaussians": ({"sg_axis_0": 0.0}, (), "vertex.sg_axis_0"),
    "spherical Gaussians in capitals": ({"SG_sharpness": 0.0}, (), "spherical Gaussians"),
    "time": ({"trbf_center": 0.0}, (), "move in time"),
    "a fourth scale": ({"scale_3": 0.0}, (), "vertex.scale_3"),
    "a fifth number of a rotation": ({"rot_4": 0.0}, (), "more columns rot_*"),
    "a fourth channel": ({"f_dc_3": 0.0}, (), "vertex.f_dc_3"),
    "anchors": ({"f_anchor_feat_0": 0.0}, (), "neural Gaussians"),
    "points": (
        dict.fromkeys(("scale_0", "scale_1", "scale_2", "opacity", "rot_0", "rot_1", "rot_2", "rot_3")),
        (),
        "a point cloud",
    ),
}


@pytest.mark.parametrize("case", OTHER_SPLATS)
def test_what_is_drawn_otherwise_is_refused_by_name(tmp_path: Path, case: str) -> None:
    columns, comments, name = OTHER_SPLATS[case]
    path = ply(tmp_path / "a.ply", thin_scene(), comments, **columns)
    refused(path, name)
    # no mode makes it another kind
    refused(path, name, overrides=Overrides(rasterize_mode="classic"))


def test_every_command_that_takes_a_scene_takes_the_options() -> None:
    from ns_abstract.cli import bench, certify, export, reach, render, viewer

    count = 0
    for module in (bench, certify, export, reach, render, viewer):
        for found in vars(module).values():
            if dataclasses.is_dataclass(found) and "load_config" in {entry.name for entry in dataclasses.fields(found)}:
                assert {"overrides"} <= {entry.name for entry in dataclasses.fields(found)}, found
                count += 1
    assert count >= 10


# Models of other classes


@pytest.fixture
def plain(tmp_path: Path) -> Path:
    return write_splatfacto_run(LATE, tmp_path / "plain", timestamp="t", experiment_name="e")


STOCK = "_target: !!python/name:nerfstudio.models.splatfacto.SplatfactoModel ''"
TAG = "!!python/object:nerfstudio.models.splatfacto.SplatfactoModelConfig"


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        (((STOCK, "_target: !!python/name:sea.WaterModel ''"),), "sea.WaterModel"),
        (((STOCK, "_target: !!python/name:mine.SplatfactoModel ''"),), "mine.SplatfactoModel"),
        (((STOCK, "_target: sea.WaterModel"),), "sea.WaterModel"),
        (((STOCK, ""), (TAG, "!!python/object:sea.WaterModelConfig")), "sea.WaterModel"),
    ],
)
def test_another_class_is_refused_unless_it_is_declared(
    plain: Path, changes: tuple[tuple[str, str], ...], name: str
) -> None:
    edit(plain, *changes)
    refused(plain, "pipeline.model._target", name, "--assume-splatfacto")
    scene = shows(plain, LATE, assume_splatfacto=True)
    assert origin_of(scene, "bounded") == Assumption("bounded", "the Gaussians alone", "--assume-splatfacto")
    assert "Gaussians alone" in scene.method().content


@pytest.mark.parametrize("key", ["rasterize_mode", "background_color", "sh_degree_interval"])
def test_absent_keys_have_the_defaults_of_their_own_class_alone(plain: Path, key: str) -> None:
    """A configuration class of somebody else may have another default than Nerfstudio's."""
    edit(plain, (TAG, "!!python/object:sea.WaterModelConfig"))
    shows(plain, LATE)
    (line,) = (line for line in plain.read_text().splitlines() if line.strip().startswith(f"{key}:"))
    edit(plain, (line + "\n", ""))
    refused(plain, f"pipeline.model.{key}", "sea.WaterModelConfig")
    edit(plain, ("!!python/object:sea.WaterModelConfig", TAG))
    assert load_scene(plain).count


MODULES = ("background_model.0.weight", "medium_mlp.bias", "gauss_params.features_medium", "exposure", "lpips_.x")


@pytest.mark.slow_cases(every=3)
@pytest.mark.parametrize("module", MODULES)
def test_unknown_modules_are_refused_unless_they_are_declared(plain: Path, module: str) -> None:
    change(plain, lambda state: state.update({f"_model.{module}": torch.ones(3)}))
    shown = module if module.startswith("gauss_params") else module.partition(".")[0]
    refused(plain, shown, "--assume-splatfacto")
    scene = load_scene(plain, Overrides(assume_splatfacto=True))
    assert scene.gaussians_alone and shown in origin_of(scene, "bounded").value


IDLE = (
    "camera_optimizer.pose_adjustment",
    "bil_grids.grids",
    "ssim.win",
    "psnr.total",
    "lpips.net.lin0.model.1.weight",
)


def test_what_draws_nothing_is_accepted_and_listed(plain: Path) -> None:
    change(plain, lambda state: state.update({f"_model.{name}": torch.ones(3) for name in IDLE}))
    edit(plain, ("use_bilateral_grid: false", "use_bilateral_grid: true"))
    ours = "_target: !!python/name:ns_abstract.nerfstudio.splat.AbstractSplatfactoModel ''"
    edit(plain, (STOCK, ours))
    scene = load_scene(plain)
    listed = {record.name for record in scene.assumptions if record.value.startswith("left out")}
    assert listed == {f"module {name.partition('.')[0]}" for name in IDLE}
    assert not scene.gaussians_alone
    shows(plain, LATE)


def test_an_assumption_that_nothing_needs_takes_nothing_away(plain: Path) -> None:
    assert not load_scene(plain, Overrides(assume_splatfacto=True)).gaussians_alone


def test_the_guarantee_says_of_the_gaussians_alone(plain: Path) -> None:
    edit(plain, (STOCK, "_target: !!python/name:sea.WaterModel ''"))
    method = nsa.load_scene(plain, assume_splatfacto=True).method()
    told = guarantee_text(method.guarantee, "gsplat", method.describe()["bounded"])
    assert "of the Gaussians alone" in told
    assert method.fingerprint["bounded"] == "Gaussians alone"
    assert "alone" not in guarantee_text(method.guarantee, "gsplat", None)


@pytest.mark.slow
def test_the_report_says_of_the_gaussians_alone(
    plain: Path, tmp_path: Path, in_process: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from ns_abstract.cli import render

    titles: list[str] = []
    save = record.save_picture
    monkeypatch.setattr(record, "save_picture", lambda *a, **k: titles.append(k["guarantee"]) or save(*a, **k))
    edit(plain, (STOCK, "_target: !!python/name:sea.WaterModel ''"))
    options = ["--load-config", str(plain), "--camera-path-filename", str(path_of(tmp_path)), "--time-budget", "5"]
    code, _, said = in_process(render.main, [*options, "--output-dir", str(tmp_path / "refused")])
    assert code == 2 and "--assume-splatfacto" in said and len(said.splitlines()) == 1
    out = tmp_path / "out"
    code, _, said = in_process(render.main, [*options, "--output-dir", str(out), "--assume-splatfacto"])
    assert code == 0, said
    report = json.loads((out / "report.json").read_text())
    assert report["guarantee"] == "float32-sound" and "of the Gaussians alone" in report["guarantee_text"]
    page = (out / "report.html").read_text()
    # wherever the guarantee is named
    assert page.count("float32-sound") == page.count("float32-sound, of the Gaussians alone") > 0
    assert set(titles) == {"float32-sound, of the Gaussians alone"}
    assert Results(out).guarantees == {"float32-sound, of the Gaussians alone"}


@pytest.mark.slow_cases(every=3)
@pytest.mark.parametrize(
    ("changes", "edits", "mention"),
    [
        ((("nerfstudio.models.vanilla_nerf.NeRFModel ''", "fog.FogModel ''"),), {}, "fog.FogModel"),
        ((), {"_model.medium.weight": torch.ones(2)}, "medium.weight"),
        ((), {"_model.field_fine.mlp_base.layers.3.weight": torch.ones(2)}, "layers.3"),
        ((), {"_model.field_fine.embedding.weight": torch.ones(2)}, "field_fine.embedding.weight"),
        ((), {"_model.temporal_distortion.mlp.weight": torch.ones(2)}, "temporal_distortion"),
    ],
)
def test_a_nerf_of_another_class_or_with_more_is_refused(
    tmp_path: Path, changes: tuple[tuple[str, str], ...], edits: dict[str, Any], mention: str
) -> None:
    config = nerf_run(tmp_path)
    change(config, lambda state: state.update({"_model.psnr.total": torch.ones(1)}))
    assert origin_of(load_any(config), "module psnr").value == "left out: a metric"
    edit(config, *changes)
    change(config, lambda state: state.update(edits))
    refused(config, mention)


def test_last_sample_is_not_supported(tmp_path: Path) -> None:
    config = nerf_run(tmp_path)
    edit(config, ("background_color: white", "background_color: last_sample"))
    assert "not supported" in refused(config, "pipeline.model.background_color", "--background")
    scene = load_any(config, Overrides(background=(0.0, 0.5, 1.0)))
    assert scene.background.tolist() == [0.0, 0.5, 1.0]
    assert "in place of last_sample" in origin_of(scene, "background").origin


@pytest.mark.parametrize("name", ["rasterize_mode", "assume_splatfacto", "drop_nan_gaussians"])
def test_options_of_splats_are_none_of_a_nerf(tmp_path: Path, name: str) -> None:
    given = Overrides(**{name: "classic" if name == "rasterize_mode" else True})  # type: ignore[arg-type]
    refused(nerf_run(tmp_path), "--" + name.replace("_", "-"), overrides=given)
