"""Reports and results name what they rest on: each choice with its value and where it came from."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from certifying import classifier
from conftest import InProcess, Inputs, blob_scene
from nerfs import tiny_scene, view

import ns_abstract as nsa
from ns_abstract.api.certification import CertifySettings, open_certification
from ns_abstract.api.certifying import CertificateQuestion
from ns_abstract.api.files import Settings, open_job
from ns_abstract.api.reaching import open_loop
from ns_abstract.cli import render as render_command
from ns_abstract.demo.writing import write_loop_demo
from ns_abstract.geometry.keyframe_cameras import KeyframeCamera, path_json
from ns_abstract.io.assumptions import Assumption
from ns_abstract.io.atomic import write_json
from ns_abstract.methods.nerf.write import write_nerf_run
from ns_abstract.methods.overrides import Overrides
from ns_abstract.methods.program_options import ProgramOptions
from ns_abstract.methods.splat.write import write_ply
from ns_abstract.report.page import render_page
from ns_abstract.report.record import Report, RunRecord

EVIL = "<script>alert(1)</script>"


def table(found: Any) -> dict[str, tuple[str, str]]:
    """Value and origin by name; every name is there once."""
    names = [entry.name for entry in found]
    assert len(set(names)) == len(names) and all(entry.value and entry.origin for entry in found)
    return {entry.name: (entry.value, entry.origin) for entry in found}


def test_defaults_and_options_of_a_run(blobs: Inputs) -> None:
    found = table(open_job(Settings(blobs.config, blobs.path, blobs.spec)).assumptions)
    assert found["renderer"] == ("gsplat", "default") and found["renderer version"] == ("1.4.0", "default")
    assert found["arithmetic"] == ("float32", "default") and found["downscale_factor"] == ("1", "default")
    assert found["picture size"] == ("32 x 32", "camera_path.json: render_width, render_height")
    assert found["varied"][1] == "spec.json" and {"rasterize_mode", "background", "load_step", "units"} <= set(found)
    assert found["rasterize_mode"] == ("classic", "config.yml: pipeline.model.rasterize_mode")
    given = Settings(
        blobs.config, blobs.path, None, 2.0, "real", program=ProgramOptions("gsplat", "1.5.3"),
        given_set={"version": 1, "rotation": {"yaw": 0.1}},
        overrides=Overrides("antialiased", (0.0, 0.5, 1.0)),
    )  # fmt: skip
    found = table(open_job(given).assumptions)
    assert found["renderer"] == ("gsplat", "--renderer") and found["renderer version"] == ("1.5.3", "--gsplat-version")
    assert found["arithmetic"] == ("real", "--arithmetic") and found["downscale_factor"] == ("2", "--downscale-factor")
    assert found["picture size"][0] == "16 x 16" and "--downscale-factor" in found["picture size"][1]
    assert found["varied"] == ("yaw", "options")
    assert found["rasterize_mode"][0] == "antialiased" and found["rasterize_mode"][1].startswith("--rasterize-mode")
    assert found["background"][0] == "0 0.5 1" and found["background"][1].startswith("--background")


def test_paper_renderer_draws_on_black(blobs: Inputs) -> None:
    found = table(open_job(Settings(blobs.config, blobs.path, blobs.spec, program=ProgramOptions("paper"))).assumptions)
    assert found["renderer"] == ("paper", "--renderer") and found["background"][0] == "0 0 0"
    assert found["background"][1].startswith("--renderer paper")


def test_ply(blobs: Inputs, tmp_path: Path) -> None:
    file = tmp_path / "scene.ply"
    write_ply(replace(blob_scene(), rasterize_mode="antialiased"), file)
    found = table(open_job(Settings(file, blobs.path, blobs.spec)).assumptions)
    assert found["rasterize_mode"][0] == "antialiased" and "comment" in found["rasterize_mode"][1]
    assert found["background"] == ("0 0 0", "default: the file says nothing")
    assert "load_step" not in found


def test_perturbations_of_a_path_and_none(make_blobs: Any) -> None:
    inputs = make_blobs()
    value = json.loads(inputs.path.read_text())
    inputs.path.write_text(json.dumps(value | {"perturbation": {"version": 1, "translation": {"z": 0.1}}}))
    assert (
        table(open_job(Settings(inputs.config, inputs.path)).assumptions)["varied"][1]
        == "camera_path.json: perturbation"
    )


def question(blobs: Inputs, folder: Path, spec: Path | None) -> CertifySettings:
    net = classifier(folder / "net.onnx")
    prop = {"type": "classification", "label": 0, "preprocess": {"resize": [16, 16]}}
    return CertifySettings(Settings(blobs.config, blobs.path, spec), net, write_json(folder / "prop.json", prop))


def test_certificate(blobs: Inputs, tmp_path: Path) -> None:
    job = open_certification(question(blobs, tmp_path, blobs.spec))
    found = table(job.assumptions)
    assert found["picture size"] == ("16 x 16", "prop.json: preprocess.resize")
    assert found["network output"] == ("y", "default") and found["network_arithmetic"] == ("float32", "default")
    assert found["picture"] == ("float", "default") and found["varied"][1] == "spec.json"
    told = replace(question(blobs, tmp_path, None), picture="8-bit", network_arithmetic="real")
    found = table(open_certification(told).assumptions)
    assert found["picture"] == ("8-bit", "--picture") and found["network_arithmetic"] == (
        "real",
        "--network-arithmetic",
    )
    assert found["varied"] == ("nothing", "default: single poses")
    assert CertificateQuestion(job, [0], {}, ()).about.assumptions == job.assumptions


def test_loop(tmp_path: Path) -> None:
    config, loop = write_loop_demo(tmp_path)
    found = table(open_loop(nsa.load_scene(config), loop).assumptions)
    assert found["varied"][1] == "loop file: camera" and "network output" in found
    assert found["picture size"][1] in ("the network's input", "loop file: preprocess.resize")


@pytest.mark.slow
def test_reports_and_results_have_them(blobs: Inputs, tmp_path: Path, in_process: InProcess) -> None:
    code, *_ = in_process(render_command.main, blobs.options(tmp_path, time_budget=5, target_ratio=3, frames=0))
    document = json.loads((tmp_path / "report.json").read_text())
    expected = open_job(Settings(blobs.config, blobs.path, blobs.spec)).assumptions
    assert code == 0 and document["assumptions"] == [vars(entry) for entry in expected]
    assert "What this rests on" in (tmp_path / "report.html").read_text()
    scene, camera = nsa.load_scene(blobs.config), nsa.load_camera_path(blobs.path).cameras[0]
    poses = nsa.PoseSet(camera, {"x": 0.01})
    found = table(nsa.bound(scene, poses, time_budget=5.0, target_ratio=3.0).assumptions)
    assert found["picture size"] == ("32 x 32", "the camera") and found["varied"] == ("x", "the set of poses")
    asked = question(blobs, tmp_path, blobs.spec)
    certificate = nsa.certify(scene, poses, asked.model, asked.property, time_budget=5.0)
    assert table(certificate.assumptions)["network output"] == ("y", "default")


def test_page_escapes(tmp_path: Path) -> None:
    entry = Assumption(EVIL, EVIL, EVIL)
    run = RunRecord(
        guarantee="real-sound", renderer={"name": "gsplat", "version": "1"}, scene={}, frames=(0,), fingerprint={},
        settings={}, assumptions=(entry,),
    )  # fmt: skip
    document = Report(tmp_path, run).document()
    assert document["assumptions"] == [{"name": EVIL, "value": EVIL, "origin": EVIL}]
    text = render_page(document, {})
    assert text.count("&lt;script&gt;") == 3 and "<script>" not in text, "markup of a file reaches the page"


@pytest.mark.parametrize("sampling", [None, "hierarchical"])
def test_nerf(sampling: str | None, tmp_path: Path) -> None:
    config = write_nerf_run(tiny_scene(1), tmp_path / "runs", timestamp="t", experiment_name="tiny")
    pose = np.eye(4)
    pose[:3] = view().camera_to_world
    path = write_json(tmp_path / "path.json", path_json([KeyframeCamera(pose, 40.0, 3, 4)]))
    spec = write_json(tmp_path / "spec.json", {"version": 1, "rotation": {"yaw": 0.002}})
    found = table(open_job(Settings(config, path, spec, program=ProgramOptions(sampling=sampling))).assumptions)
    samples = ("num_samples", "default") if sampling is None else (
        "num_coarse_samples", "the run: pipeline.model.num_coarse_samples"
    )  # fmt: skip
    assert found[samples[0]] == ("64", samples[1]) and found["near_plane"] == ("0", "default")
    assert found["arithmetic"] == ("real", "default") and found["device"] == ("cpu", "default")
    assert found["renderer"] == (f"nerf-{sampling or 'uniform'}", "default" if sampling is None else "--sampling")
