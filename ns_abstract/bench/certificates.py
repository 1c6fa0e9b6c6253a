"""How much of a set of poses is certified, against time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ns_abstract.api.certifying import CertifyProgress, certify
from ns_abstract.api.poses import PoseSet
from ns_abstract.api.scenes import Scene
from ns_abstract.geometry.camera_path import PinholeCamera

#: Seconds between two words of where a search stands.
_SAID = 10.0
#: Sets by name, as a perturbation file writes them.
SETS: dict[str, dict[str, Any]] = {
    "x": {"translation": {"x": 0.05}},
    "xyz": {"translation": {"x": 0.05, "y": 0.05, "z": 0.05}},
    "xyz-small": {"translation": {"x": 0.01, "y": 0.01, "z": 0.01}},
    "six": {
        "translation": {"x": 0.005, "y": 0.005, "z": 0.005},
        "rotation": {"yaw": 0.005, "pitch": 0.005, "roll": 0.005},
    },
    "six-wide": {
        "translation": {"x": 0.05, "y": 0.05, "z": 0.05},
        "rotation": {"yaw": 0.02, "pitch": 0.02, "roll": 0.02},
    },
}


def curve(
    scene: Scene,
    camera: PinholeCamera,
    name: str,
    specification: dict[str, Any],
    model: Path,
    prop: Path,
    seconds: float,
    workers: int,
    marks: Sequence[float],
    said: Callable[[str], object] = lambda text: None,
    following: PinholeCamera | None = None,
) -> dict[str, Any]:
    """Search one set for ``seconds``.

    Args:
        marks: Times, in seconds from the call, at which the certified fraction is told; kernels have to be loaded, and
            compiled at the first time, within them.
        said: Told from time to time where the search stands.
        following: The camera after ``camera`` on its path, for sets that sweep segments.

    Returns:
        A row: certified fraction at the marks and at the end, falsified and unknown ones, cells bounded by the network,
        worker seconds by bounded cell.
    """
    points: list[CertifyProgress] = []
    said(f"{name}: searching for {seconds:g} s")
    due = _SAID

    def on_progress(point: CertifyProgress) -> None:
        nonlocal due
        points.append(point)
        if point.seconds >= due:
            due = point.seconds + _SAID
            said(
                f"{name}: {point.seconds:.0f} s, certified {point.certified:.2%}, falsified {point.falsified:.2%}, "
                f"unknown {point.unknown:.2%}"
            )

    certificate = certify(
        scene, PoseSet.from_json(camera, specification, following=following), model, prop,
        time_budget=seconds, workers=workers, on_progress=on_progress,
    )  # fmt: skip
    effort = certificate.report["effort"]
    bounded = effort["cells_bounded"]
    row: dict[str, Any] = {"set": name, "parameters": len(certificate.parameters), "network": model.stem}
    for mark in marks:
        certified = [point.certified for point in points if point.seconds <= mark]
        done = certificate.seconds <= mark
        row[f"at {mark:g} s"] = certificate.certified if done else certified[-1] if certified else 0.0
    return row | {
        "seconds": certificate.seconds,
        "certified": certificate.certified,
        "falsified": certificate.falsified,
        "unknown": certificate.unknown,
        "bounded": bounded,
        "worker s / bounded": effort["worker_seconds"] / bounded if bounded else float("nan"),
    }
