"""Camera paths and perturbations for the demonstration scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ns_abstract.geometry.keyframe_cameras import KeyframeCamera, around, look_at, path_json, ring
from ns_abstract.io.atomic import write_json

#: The middle of the airfield's aircraft.
TARGET = (0.0, 0.0, 0.01)


def airfield_views(size: int = 200) -> list[KeyframeCamera]:
    """Return the five views of the airfield: from the aircraft's side round to the front, runway behind it."""
    places = ((-62.0, 13.0), (-50.0, 14.0), (-37.0, 15.0), (-25.0, 16.0), (-12.0, 17.0))
    return [around(TARGET, a, e, 1.0, height=size, width=size) for a, e in places]


def dataset_views(count: int = 10, size: int = 200) -> list[KeyframeCamera]:
    """Return views all around the airfield for the data set beside a run."""
    return ring(TARGET, 1.05, count, size)


def gate_views(count: int = 10, size: int = 200) -> list[KeyframeCamera]:
    """Return views along the gate's course for the data set beside a run; the nearer, the closer to the gate's axis."""
    rng = np.random.default_rng(0)
    end = 0.06 + 0.1 * 0.35 * 24
    along = rng.uniform(0.0, end, count)
    room = 1.1 - 0.5 * along / end
    across, up = (room * rng.uniform(-most, most, count) for most in (0.45, 0.3))
    views = []
    for place in np.stack([along, across, up], axis=1):
        pose = look_at((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
        pose[:3, 3] = place
        views.append(KeyframeCamera(pose, 60.0, size, size))
    return views


def airfield_path(size: int = 200) -> dict[str, Any]:
    """Return the five views of ``airfield_views`` as a camera path."""
    return path_json(airfield_views(size))


def airfield_perturbation() -> dict[str, Any]:
    """Return the set of sideways shifts by up to 0.02 scene units."""
    return {"version": 1, "frame": "camera", "translation": {"x": 0.02}, "sweep": "keyframes"}


def airfield_orbit(size: int = 32) -> dict[str, Any]:
    """Return one view, and the set of all its rotations about the vertical axis through the aircraft."""
    perturbation = {
        "version": 1,
        "sweep": "keyframes",
        "orbit": {"target": list(TARGET), "axis": [0.0, 0.0, 1.0], "azimuth": [0.0, 2.0 * np.pi]},
    }
    view = around(TARGET, -50.0, 24.0, 1.0, height=size, width=size)
    return path_json([view], seconds=1.0, perturbation=perturbation)


def write_airfield_paths(folder: str | Path) -> dict[str, Path]:
    """Write ``camera_path.json``, ``camera_path_orbit.json`` and ``SPEC.json`` into ``folder``.

    Returns:
        The three files by the names "path", "orbit" and "spec".
    """
    folder = Path(folder)
    files = {
        "path": (folder / "camera_path.json", airfield_path()),
        "orbit": (folder / "camera_path_orbit.json", airfield_orbit()),
        "spec": (folder / "SPEC.json", airfield_perturbation()),
    }
    return {name: write_json(file, value) for name, (file, value) in files.items()}
