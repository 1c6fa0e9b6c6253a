"""Writes the demo scene; imported only when it is asked for."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ns_abstract.demo.paths import dataset_views, gate_views, write_airfield_paths
from ns_abstract.demo.scenes import (
    DATA,
    NERFACTO_SCALE,
    buoy_path,
    buoy_scene,
    buoy_views,
    nerfacto_path,
    nerfacto_scene,
    splat_scene,
)
from ns_abstract.geometry.camera_path import PinholeCamera, focal_length
from ns_abstract.geometry.keyframe_cameras import KeyframeCamera
from ns_abstract.io.atomic import write_json
from ns_abstract.io.errors import InputError
from ns_abstract.methods.nerf.write import write_nerf_run, write_nerfacto_run
from ns_abstract.methods.splat.activate import activate
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0
from ns_abstract.methods.splat.render import Renderer
from ns_abstract.methods.splat.write import write_splatfacto_run

#: Name of the run's folder: a fixed time, so that the demo is the same every time.
TIMESTAMP = "2026-01-01_120000"
#: What the demo writes into its folder beside the airfield's run.
_WRITTEN = (
    "SPEC.json", "camera_path.json", "camera_path_orbit.json", "camera_path_buoy.json", "camera_path_nerfacto.json",
    "data", "data-buoy", "data-buoy-nerfacto", "buoy", "buoy-nerfacto", "gate",
)  # fmt: skip


def refuse_others(folder: Path) -> None:
    """Raise InputError where the demo would replace what is not an earlier demo's."""
    if (folder / "airfield" / "splatfacto" / TIMESTAMP).is_dir():
        return
    there = next((name for name in _WRITTEN if os.path.lexists(folder / name)), None)
    if there is not None:
        problem = f"holds {there}, which is no earlier demo's"
        raise InputError(problem, file=folder, field="--output-dir", fix="choose another folder")


def write_nerf_demo(folder: Path) -> tuple[Path, Path]:
    """Write the NeRF and its camera path; returns config.yml and the path."""
    scene = buoy_scene()
    config = write_nerf_run(scene, folder, timestamp=TIMESTAMP, experiment_name="buoy", views=buoy_views())
    return config, write_json(folder / "camera_path_buoy.json", buoy_path())


def write_nerfacto_demo(folder: Path) -> tuple[Path, Path]:
    """Write the nerfacto and its camera path; returns config.yml and the path."""
    config = write_nerfacto_run(
        nerfacto_scene(), folder, timestamp=TIMESTAMP, experiment_name="buoy-nerfacto",
        views=buoy_views(scale=NERFACTO_SCALE),
    )  # fmt: skip
    return config, write_json(folder / "camera_path_nerfacto.json", nerfacto_path())


def _picture(renderer: Renderer) -> Callable[[KeyframeCamera], NDArray[np.float64]]:
    """Gives the image [H, W, 3] of a view."""

    def picture(view: KeyframeCamera) -> NDArray[np.float64]:
        focal = focal_length(view.fov, view.height, "fov")
        camera = PinholeCamera(
            camera_to_world=view.camera_to_world,
            fx=focal,
            fy=focal,
            cx=0.5 * view.width,
            cy=0.5 * view.height,
            width=view.width,
            height=view.height,
        )
        pose = view.camera_to_world
        rotation = np.ascontiguousarray(pose[:3, :3].T * np.array([1.0, -1.0, -1.0])[:, None])
        return renderer.image(camera, rotation, np.ascontiguousarray(pose[:3, 3]))

    return picture


def write_demo(folder: Path) -> tuple[Path, dict[str, Path]]:
    """Write run, camera paths and perturbation; returns config.yml and the files by name."""
    scene = splat_scene("airfield")
    picture = _picture(Renderer(activate(scene, GSPLAT_1_4_0), GSPLAT_1_4_0))
    config = write_splatfacto_run(
        scene, folder, timestamp=TIMESTAMP, experiment_name="airfield", views=dataset_views(), render=picture
    )
    return config, write_airfield_paths(folder)


def write_loop_demo(folder: Path) -> tuple[Path, Path]:
    """Write the gate's run, and the network and LOOP.json of a flight towards it; returns config.yml and LOOP.json."""
    scene = splat_scene("gate")
    picture = _picture(Renderer(activate(scene, GSPLAT_1_4_0), GSPLAT_1_4_0))
    config = write_splatfacto_run(
        scene, folder, timestamp=TIMESTAMP, experiment_name="gate", render=picture, views=gate_views()
    )
    for name in ("estimator.onnx", "LOOP.json"):
        shutil.copyfile(DATA / name, folder / name)
    return config, folder / "LOOP.json"
