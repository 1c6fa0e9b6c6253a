"""The version of gsplat whose pictures are bounded, from the command line to the report."""

from __future__ import annotations

import importlib.metadata
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import Inputs, blob_scene, ring
from scene_attacks import bound_cells

from ns_abstract.api.files import PathJob, Settings, open_job
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.io.errors import InputError
from ns_abstract.methods.program_options import ProgramOptions
from ns_abstract.methods.splat.constants import VERSIONS, installed_gsplat, rasteriser_named
from ns_abstract.perturbation.specification import parse_perturbation
from ns_abstract.verify.attack.soundness import compiled_renderer


def job(inputs: Inputs, **options: Any) -> PathJob:
    return open_job(Settings(inputs.config, inputs.path, inputs.spec, program=ProgramOptions(**options)))


@pytest.mark.parametrize("version", [None, *VERSIONS])
def test_report_names_the_version(blobs: Inputs, version: str | None) -> None:
    found = job(blobs, gsplat_version=version)
    assert found.method.program == {"name": "gsplat", "version": version or "1.4.0"}


def test_results_of_versions_are_not_mixed(blobs: Inputs) -> None:
    prints = [repr(job(blobs, gsplat_version=version).fingerprint) for version in VERSIONS]
    assert len(set(prints)) == len(VERSIONS)


def test_paper_has_no_version(blobs: Inputs) -> None:
    with pytest.raises(InputError, match="gsplat-version"):
        job(blobs, renderer="paper", gsplat_version="1.5.3")


@pytest.mark.parametrize(
    ("installed", "rules"),
    [("1.4.0", "1.4.0"), ("1.5.0", "1.5.3"), ("1.5.3+pt24cu121", "1.5.3"), ("1.6.0", "1.6.0"), ("9.0", "1.4.0"),
     ("unknown", "1.4.0")],
)  # fmt: skip
def test_installed_version(monkeypatch: pytest.MonkeyPatch, installed: str, rules: str) -> None:
    monkeypatch.setattr(importlib.metadata, "version", lambda name: installed)
    assert installed_gsplat().version == rules


def test_no_gsplat_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> str:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", missing)
    assert installed_gsplat().version == "1.4.0"


def view() -> PinholeCamera:
    first = ring()[0]
    return PinholeCamera(np.asarray(first.camera_to_world)[:3], 38.6, 38.6, 16.0, 16.0, 32, 32)


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("version", VERSIONS)
def test_real_bounds_hold(version: str, mode: str) -> None:
    scene = replace(blob_scene(30, degree=1), rasterize_mode=mode)
    around = PoseBox.around(view(), parse_perturbation({"translation": {"x": 2e-3}, "rotation": {"yaw": 1e-3}}))
    rules = rasteriser_named("gsplat", version)
    (bounds,), _ = bound_cells(scene, around, [around.box], rasteriser=rules, arithmetic="real")
    render, _ = compiled_renderer(scene, around, rules)
    for values in (*around.box.corners(), *around.box.sample(4, np.random.default_rng(0))):
        picture = render(values)
        assert (bounds[0] <= picture).all() and (picture <= bounds[1]).all()
