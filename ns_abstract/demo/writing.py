"""Writes the demo scene; imported only when it is asked for."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ns_abstract.demo.airfield import airfield
from ns_abstract.demo.approach import FOV, SIZE, rotation, write_approach
from ns_abstract.demo.buoy import buoy_path, buoy_scene, buoy_views
from ns_abstract.demo.paths import dataset_views, write_airfield_paths
from ns_abstract.geometry.camera_path import Camera, focal_length
from ns_abstract.geometry.views import View
from ns_abstract.methods.nerf.write import write_nerf_run
from ns_abstract.methods.run_writer import write_file
from ns_abstract.methods.splat.activate import activate
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0
from ns_abstract.methods.splat.render import Renderer
from ns_abstract.methods.splat.write import write_splatfacto_run

#: Name of the run's folder: a fixed time, so that the demo is the same every time.
TIMESTAMP = "2026-01-01_120000"


def write_nerf_demo(folder: Path) -> tuple[Path, Path]:
    """Fit and write the NeRF and its camera path; returns config.yml and the path."""
    scene = buoy_scene()
    config = write_nerf_run(scene, folder, timestamp=TIMESTAMP, experiment_name="buoy", views=buoy_views())
    path = folder / "camera_path_buoy.json"
    write_file(path, (json.dumps(buoy_path(), indent=1) + "\n").encode())
    return config, path


def write_demo(folder: Path) -> tuple[Path, dict[str, Path]]:
    """Write run, camera paths and perturbation; returns config.yml and the files by name."""
    scene = airfield()
    renderer = Renderer(activate(scene, GSPLAT_1_4_0), GSPLAT_1_4_0)

    def picture(view: View) -> np.ndarray:
        focal = 0.5 * view.height / np.tan(np.radians(view.fov) / 2.0)
        camera = Camera(
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

    config = write_splatfacto_run(
        scene, folder, timestamp=TIMESTAMP, experiment_name="airfield", views=dataset_views(), render=picture
    )
    return config, write_airfield_paths(folder)


def write_loop_demo(folder: Path) -> tuple[Path, Path]:
    """Fit and write the network and LOOP.json of an approach to the airfield of `write_demo`; returns both files."""
    renderer = Renderer(activate(airfield(), GSPLAT_1_4_0), GSPLAT_1_4_0)
    focal = focal_length(FOV, SIZE, "fov")
    pose = rotation()
    camera = Camera(pose[:3], focal, focal, 0.5 * SIZE, 0.5 * SIZE, SIZE, SIZE)
    view = np.ascontiguousarray(pose[:3, :3].T * np.array([1.0, -1.0, -1.0])[:, None])
    return write_approach(folder, lambda place: renderer.image(camera, view, place).astype(np.float32))
