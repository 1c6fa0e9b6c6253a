"""Our figures in the form of the paper's Tables 2 and 6, and the paper's own."""

from __future__ import annotations

from typing import Any

from ns_abstract.api.files import PathJob
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.methods.splat.method import SplatMethod
from ns_abstract.refine.result import FrameResult, max_pixel_gap

_NAMES = ("scene", "CPR", "Dim", "Res", "method", "Rt min", "MPG", "XPG", "empirical MPG", "empirical XPG")
#: The paper's figures; it gives no time for scene variations. Table 2 ran on a GPU.
_TABLE_2 = (
    ("Lego", "0.1 rad", "yaw", "80x80", "GS", 22.0, 0.51, 1.73, 0.22, 1.57),
    ("Lego", "0.1 rad", "yaw", "80x80", "NeRF", 25.0, 0.40, 1.73, 0.22, 1.57),
    ("Chair", "0.1 rad", "yaw", "50x50", "GS", 17.0, 0.46, 1.73, 0.40, 1.72),
    ("Chair", "0.1 rad", "yaw", "50x50", "NeRF", 20.0, 0.40, 1.73, 0.40, 1.72),
    ("Drums", "0.1 m", "x", "50x50", "GS", 5.3, 0.19, 1.62, 0.13, 1.54),
    ("Drums", "0.1 m", "x", "50x50", "NeRF", 5.8, 0.16, 1.55, 0.13, 1.54),
    ("PineTree", "2 m", "x", "72x72", "GS", 4.1, 0.27, 1.73, 0.06, 1.37),
    ("PineTree", "2 m", "x", "72x72", "NeRF", 4.9, 0.23, 1.73, 0.06, 1.37),
    ("PineTree", "10 m", "x", "72x72", "GS", 24.0, 0.47, 1.73, 0.18, 1.37),
    ("PineTree", "10 m", "x", "72x72", "NeRF", 28.0, 0.36, 1.73, 0.18, 1.37),
    ("Airport", "0.027 rad", "roll", "160x160", "GS", 27.0, 0.56, 1.69, 0.21, 1.38),
    ("Airport", "0.027 rad", "roll", "160x160", "NeRF", 35.0, 0.42, 1.63, 0.21, 1.38),
    ("Airport", "0.03 rad", "roll", "160x160", "GS", 30.0, 0.59, 1.70, 0.22, 1.41),
    ("Airport", "0.03 rad", "roll", "160x160", "NeRF", 43.0, 0.51, 1.68, 0.22, 1.41),
    ("Garden", "0.5 m", "x", "100x100", "GS", 20.0, 0.53, 1.59, 0.34, 1.21),
    ("Garden", "0.5 m", "x", "100x100", "NeRF", 11.0, 0.37, 1.53, 0.34, 1.21),
    ("Airplane", "2 m", "x", "80x80", "GS", 16.0, 0.41, 1.68, 0.15, 1.39),
    ("Airplane", "2 m", "x", "80x80", "NeRF", 19.0, 0.33, 1.61, 0.15, 1.39),
)
_TABLE_6 = (
    ("Lego", "0.15", "hue", "80x80", "NeRF", None, 0.17, 1.51, 0.14, 1.45),
    ("Lego", "0.3", "saturation", "80x80", "NeRF", None, 0.10, 1.34, 0.09, 1.33),
    ("Chair", "0.2", "hue", "80x80", "NeRF", None, 0.65, 1.71, 0.37, 1.71),
    ("Chair", "0.5", "saturation", "80x80", "NeRF", None, 0.76, 1.73, 0.52, 1.73),
    ("Drums", "0.2", "hue", "80x80", "NeRF", None, 0.63, 1.20, 0.62, 1.20),
    ("Drums", "0.5", "saturation", "80x80", "NeRF", None, 0.96, 1.36, 0.88, 1.36),
    ("PineTree", "0.1", "mean", "96x96", "GS", None, 0.27, 1.62, 0.11, 1.27),
    ("PineTree", "0.2", "mean", "96x96", "GS", None, 0.41, 1.73, 0.25, 1.43),
    ("PineTree", "0.1", "opacity", "96x96", "GS", None, 0.29, 1.53, 0.14, 1.25),
    ("PineTree", "0.2", "opacity", "96x96", "GS", None, 0.59, 1.73, 0.27, 1.23),
)


def _completed(values: tuple[Any, ...]) -> dict[str, Any]:
    row = dict(zip(_NAMES, values, strict=True))
    return {**row, "MPG / empirical": row["MPG"] / row["empirical MPG"] if row["empirical MPG"] else None}


def table_of(poses: PoseBox) -> int:
    """Return the number of the paper's table for a set: 6 where the scene varies, else 2."""
    perturbation = poses.perturbation
    varies = perturbation.scene or perturbation.hue is not None or perturbation.saturation is not None
    return 6 if varies else 2


def _range(poses: PoseBox) -> str:
    """Return the widths of the set's ranges as text, in the paper's form."""
    box, perturbation = poses.box, poses.perturbation
    widths = {f"{high - low:g} {unit}" for low, high, unit in zip(box.lower, box.upper, box.units, strict=True)}
    for entry in perturbation.scene:
        for ends in (entry.mean, entry.opacity, entry.color):
            if ends is not None:
                widths.add(f"{ends[1] - ends[0]:g}")
    return ", ".join(sorted(widths))


def ours(job: PathJob, name: str, poses: PoseBox, result: FrameResult) -> dict[str, Any]:
    """Return one row of our figures: ranges are whole widths, "empirical" is of rendered pictures."""
    last = result.trace[-1]
    method = "GS" if isinstance(job.method, SplatMethod) else "NeRF"
    return _completed(
        (
            job.method.name, _range(poses), name, f"{result.lower.shape[1]}x{result.lower.shape[0]}", method,
            last.seconds / 60.0, last.mpg, max_pixel_gap(result.lower, result.upper), last.mpg_witness,
            max_pixel_gap(result.witness_lower, result.witness_upper),
        )
    )  # fmt: skip


#: The paper's rows by the number of their table.
TABLES = {2: [_completed(values) for values in _TABLE_2], 6: [_completed(values) for values in _TABLE_6]}
