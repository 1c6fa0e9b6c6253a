"""Named scenes and sets of poses for the benchmarks."""

from __future__ import annotations

import copy
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ns_abstract.api.files import PathJob, Settings, open_job
from ns_abstract.api.files import pose_set as path_pose_set
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.io.errors import InputError
from ns_abstract.methods.overrides import Overrides
from ns_abstract.methods.program_options import ProgramOptions
from ns_abstract.methods.splat.method import SplatMethod
from ns_abstract.perturbation.specification import Perturbation, parse_perturbation

#: Perturbation objects by name; "orbit" turns about the vertical through the median Gaussian, or a NeRF's origin, and
#: what varies of a splat scene is the half of it with x above the median.
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
    "mean": {"scene": [{"select": {"box": None}, "mean": 0.002}]},
    "opacity": {"scene": [{"select": {"box": None}, "opacity": 0.05}]},
    "color": {"scene": [{"select": {"box": None}, "color": 0.05}]},
    "hue": {"hue": 0.075},
    "saturation": {"saturation": 0.15},
}
#: What the command line says of them.
SET_NAMES = ", ".join(SETS)


def open_jobs(
    load_config: tuple[Path, ...],
    camera_path: Path | None,
    downscale_factor: float,
    arithmetic: str | None = None,
    program: ProgramOptions | None = None,
    overrides: Overrides | None = None,
) -> list[PathJob]:
    """Return the jobs of the runs, or of the demo scene where none is named.

    Without ``arithmetic`` it is the strongest of the method; ``program`` are options of the renderer, ``overrides``
    replace values of the files. Without ``camera_path`` each run's own ``camera_path.json`` is used, from the folder
    that holds the method's folder. Raises InputError where a file cannot be used.
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
            config, path, downscale_factor=downscale_factor, arithmetic=arithmetic,
            program=program or ProgramOptions(), overrides=overrides or Overrides(),
        )  # fmt: skip
        jobs.append(open_job(settings, Perturbation()))
    return jobs


def splat_of(job: PathJob) -> SplatMethod:
    """Return the method of a splat scene. Raises InputError where the run is of another method."""
    if not isinstance(job.method, SplatMethod):
        raise InputError("not a splat scene", file=job.settings.load_config, fix="give a run of splatfacto")
    return job.method


def pose_set(job: PathJob, name: str, frame: int, scale: float = 1.0) -> PoseBox:
    """Return the set ``name`` around entry ``frame`` of the job's path; ``scale`` multiplies every range.

    Raises:
        InputError: There is no such set, or not for this method.
    """
    if name not in SETS:
        raise InputError(f"found {name}", field="--sets", fix=f"the sets are {SET_NAMES}")
    spec = copy.deepcopy(SETS[name])
    method = job.method
    means = method.scene.means.astype(np.float64) if isinstance(method, SplatMethod) else np.zeros((1, 3))
    if name == "orbit":
        spec["orbit"]["target"] = [float(v) for v in np.median(means, axis=0)]
    for entry in spec.get("scene", ()):
        low, high = means.min(axis=0), means.max(axis=0)
        low[0] = np.median(means[:, 0])
        entry["select"]["box"] = [low.tolist(), high.tolist()]
    perturbation = parse_perturbation(spec)
    job.method.prepare([perturbation])

    def scaled(ranges):
        return {key: (scale * low, scale * high) for key, (low, high) in ranges.items()}

    perturbation = replace(
        perturbation, translation=scaled(perturbation.translation), rotation=scaled(perturbation.rotation)
    )
    return path_pose_set(job.path, frame, perturbation)
