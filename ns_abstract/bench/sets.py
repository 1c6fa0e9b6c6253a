"""Named scenes and sets of poses that the benchmarks run on."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ns_abstract.errors import InputError
from ns_abstract.pipeline import Job, Settings
from ns_abstract.sets.perturbation import Perturbation, parse_perturbation
from ns_abstract.sets.poses import PoseSet

#: Perturbation objects by name; "orbit" turns about the vertical through the median Gaussian, or a NeRF's origin.
SETS: dict[str, dict[str, Any]] = {
    "x": {"translation": {"x": 0.05}},
    "yaw": {"rotation": {"yaw": 0.05}},
    "roll": {"rotation": {"roll": 0.05}},
    "six": {
        "translation": {"x": 0.002, "y": 0.002, "z": 0.002},
        "rotation": {"yaw": 0.002, "pitch": 0.002, "roll": 0.002},
    },
    "segments": {"sweep": "segments"},
    "orbit": {"orbit": {"target": None, "axis": [0.0, 0.0, 1.0], "azimuth": [0.0, 0.1]}},
    "point": {},
}


def open_jobs(
    load_config: tuple[Path, ...],
    camera_path: Path | None,
    downscale_factor: float,
    arithmetic: str = "float32",
    occupancy_grid: Path | None = None,
) -> list[Job]:
    """The runs, or the demo scene where none is named.

    Without ``camera_path`` each run's own ``camera_path.json``, in the folder that holds the method's
    folder, is used.

    Raises:
        InputError: A file cannot be used.
    """
    if not load_config:
        from ns_abstract.demo.writing import write_demo

        folder = Path(tempfile.mkdtemp(prefix="ns-abstract-demo-"))
        config, files = write_demo(folder)
        load_config, camera_path = (config,), files["path"]
    jobs = []
    for config in load_config:
        path = camera_path if camera_path is not None else config.resolve().parents[2] / "camera_path.json"
        settings = Settings(
            config, path, downscale_factor=downscale_factor, arithmetic=arithmetic, occupancy_grid=occupancy_grid
        )
        jobs.append(Job(settings, Perturbation()))
    return jobs


def pose_set(job: Job, name: str, frame: int, scale: float = 1.0) -> PoseSet:
    """The set ``name`` around entry ``frame`` of the job's path; ``scale`` multiplies every range.

    Raises:
        InputError: There is no such set.
    """
    if name not in SETS:
        raise InputError(f"found {name}", field="--sets", fix=f"the sets are {', '.join(SETS)}")
    spec = dict(SETS[name].items())
    if name == "orbit":
        means = getattr(job.scene, "means", np.zeros((1, 3)))
        target = np.median(means.astype(np.float64), axis=0)
        spec["orbit"] = {**spec["orbit"], "target": [float(v) for v in target]}
    perturbation = parse_perturbation(spec)

    def scaled(ranges):
        return {key: (scale * low, scale * high) for key, (low, high) in ranges.items()}

    perturbation = replace(
        perturbation, translation=scaled(perturbation.translation), rotation=scaled(perturbation.rotation)
    )
    return job.pose_set(frame, perturbation)
