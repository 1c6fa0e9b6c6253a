"""Measure certificates of the picture itself: what is decided in which time, beside what sampling says.

    python benchmarks/picture_properties.py OUT --runs RUNS --demo DEMO [--only NAME] [--poses N]

RUNS holds airplane, plant and lego_nerf, DEMO is what ns-abstract-demo wrote. Every row is one run of
ns-abstract-certify without --model; ``wrong`` counts sampled poses whose verdict the cells contradict: certified, and
the property fails there as rendered. The table is OUT/table.md.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from ns_abstract.api.certification import CertifySettings, open_certification
from ns_abstract.api.files import Settings
from ns_abstract.cli.common import DONE

NOSE = {"type": "visible", "select": {"box": [[0.3, -2, -2], [2, 2, 2]]}, "weight": 0.5, "pixels": 40}
POT = {
    "type": "visible", "select": {"box": [[-0.15, -0.15, -0.45], [0.15, 0.15, -0.2]]}, "weight": 0.46, "pixels": 390,
    "preprocess": {"resize": [64, 64]},
}  # fmt: skip
#: Within 0.02 of the way, along x and y, the whole picture shows 379 to 401 pixels of the pot at every pose. They
#: differ by how pixels fall on the pot's edge, so margins of POT lie within 0.05 of its limit nearly everywhere, and so
#: would those of other numbers of pixels. Where the pot lies in the picture does differ. It fills 60 % of the middle
#: 20 x 20 pixels at about 72 % of the poses, and 12 % of these margins lie within 0.1. POT's row is a marginal case.
MIDDLE = {
    "type": "visible", "select": POT["select"], "weight": 0.5, "fraction": 0.6, "region": [22, 22, 42, 42],
    "preprocess": {"resize": [64, 64]},
}  # fmt: skip
FUSELAGE = {
    "type": "visible", "select": {"box": [[-0.1, -0.1, 0.0], [0.1, 0.1, 0.3]]}, "weight": 0.5, "pixels": 60,
    "preprocess": {"resize": [64, 64]},
}  # fmt: skip
BRICKS = {
    "type": "visible", "select": {"box": [[-2, -2, 0], [2, 2, 2]]}, "weight": 0.5, "pixels": 6,
    "preprocess": {"resize": [8, 8]},
}  # fmt: skip
ALONG = {"version": 1, "sweep": "segments"}
AROUND = {**ALONG, "frame": "camera", "translation": {"x": 0.02, "y": 0.02}}
ARC = {"version": 1, "orbit": {"target": [0, 0, 0], "axis": [0, 0, 1], "azimuth": [0, 0.02]}}


def clear(distance: float, size: int | None = None) -> dict[str, Any]:
    """No ray of the whole picture hits anything nearer than a distance."""
    more = {} if size is None else {"preprocess": {"resize": [size, size]}}
    return {"type": "clear", "distance": distance, "weight": 0.5, **more}


class Row(NamedTuple):
    """One certificate: the run, its camera path and set, the property, and the seconds of its goal."""

    name: str
    run: str
    path: str
    spec: dict[str, Any] | None
    prop: dict[str, Any]
    seconds: int
    options: tuple[str, ...] = ()


#: Of a NeRF the rays begin where the scene does.
NERF = ("--num-samples", "64", "--near-plane", "2")
ROWS = (
    Row("airplane, orbit, nose visible", "airplane", "camera_path_orbit.json", None, NOSE, 120),
    Row("airplane, orbit, clear 0.75", "airplane", "camera_path_orbit.json", None, clear(0.75), 120),
    Row("plant, path, pot visible", "plant", "camera_path.json", ALONG, POT, 120),
    Row("plant, path, clear 0.8", "plant", "camera_path.json", ALONG, clear(0.8, 64), 120),
    Row("plant, path and x, y, pot in the middle", "plant", "camera_path.json", AROUND, MIDDLE, 600),
    Row("plant, path and x, y, pot at the edge", "plant", "camera_path.json", AROUND, POT, 600),
    Row("plant, path and x, y, clear 0.8", "plant", "camera_path.json", AROUND, clear(0.8, 64), 600),
    Row("demo, path, fuselage visible", "demo/airfield", "camera_path.json", ALONG, FUSELAGE, 120),
    Row("demo, path, clear 0.7", "demo/airfield", "camera_path.json", ALONG, clear(0.7, 64), 120),
    Row("lego_nerf, arc 0.02 rad, bricks visible", "lego_nerf", "camera_path.json", ARC, BRICKS, 120, NERF),
    Row("lego_nerf, arc 0.02 rad, clear 3.4", "lego_nerf", "camera_path.json", ARC, clear(3.4, 8), 120, NERF),
)  # fmt: skip


def files(row: Row, options: argparse.Namespace, folder: Path) -> tuple[Path, Path, Path, Path | None]:
    """config.yml, camera path, property and perturbation of a row."""
    folder.mkdir(parents=True, exist_ok=True)
    demo = row.run.startswith("demo/")
    root = options.demo / row.run.removeprefix("demo/") if demo else options.runs / row.run
    (folder / "prop.json").write_text(json.dumps(row.prop))
    spec = None if row.spec is None else folder / "spec.json"
    if spec is not None:
        spec.write_text(json.dumps(row.spec))
    (config,) = sorted(root.glob("*/*/config.yml"))
    return config, (options.demo if demo else root) / row.path, folder / "prop.json", spec


def command(row: Row, options: argparse.Namespace, folder: Path, seconds: int) -> list[str]:
    """The command line of a row."""
    config, path, prop, spec = files(row, options, folder)
    found = [
        "--load-config",
        config,
        "--camera-path-filename",
        path,
        "--property",
        prop,
        "--output-dir",
        folder / "out",
    ]
    found += [] if spec is None else ["--perturbation-filename", spec]
    found += ["--time-budget", seconds, "--workers", options.workers, *row.options]
    return [sys.executable, "-m", "ns_abstract.cli.certify", *map(str, found)]


def wrong(row: Row, options: argparse.Namespace, folder: Path, count: int) -> tuple[int, int, float]:
    """Sampled poses, those that contradict a certified cell, and the part at which the property holds."""
    import sqlite3

    config, path, prop, spec = files(row, options, folder)
    job = open_certification(CertifySettings(Settings(config, path, spec), None, prop))
    rng, contradictions, shares, looked = np.random.default_rng(11), 0, [], 0
    with sqlite3.connect(folder / "out" / "cells.sqlite") as base:
        rows = base.execute("SELECT frame, lower, upper FROM cells WHERE verdict = 'certified'").fetchall()
    names = [name for name, _ in job.job.parameters]
    each = max(1, count // job.job.frame_count)
    for frame in range(job.job.frame_count):
        pictures, boxes = job.pictures(frame), [(json.loads(a), json.loads(b)) for k, a, b in rows if k == frame]
        claim, order = job.claim(pictures), [names.index(name) for name in pictures.box.names]
        low, high = (np.array([box[k] for box in boxes]).reshape(-1, len(names))[:, order] for k in (0, 1))
        poses = pictures.box.sample(each if pictures.box.dimensions else 1, rng)
        right = 0
        for pose in poses:
            outputs = torch.from_numpy(job.model.outputs(pictures.image(pose)[None]))
            holds = float(claim.margin(outputs, torch.from_numpy(pose[None]))[0]) > 0.0
            certified = bool(((low <= pose) & (pose <= high)).all(axis=1).any())
            contradictions += certified and not holds
            right, looked = right + holds, looked + 1
        shares.append(right / len(poses))
    # frames count alike, as they do in the report
    return looked, contradictions, sum(shares) / len(shares)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("--runs", type=Path, required=True)
    parser.add_argument("--demo", type=Path, required=True)
    parser.add_argument("--only", default="", help="rows whose name holds this text")
    parser.add_argument("--seconds", type=int, help="in place of each row's own")
    parser.add_argument("--poses", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    heads = ("certificate", "certified", "falsified", "unknown", "of sampled right", "s", "load", "poses", "wrong")
    lines = [f"| {' | '.join(heads)} |", f"|---{'|---:' * (len(heads) - 1)}|"]
    for row in ROWS:
        if options.only not in row.name:
            continue
        folder = options.output / row.name.replace(", ", "_").replace(" ", "_")
        begin, load = time.perf_counter(), os.getloadavg()[0]
        done = subprocess.run(
            command(row, options, folder, options.seconds or row.seconds), check=False, capture_output=True, text=True
        )
        if done.returncode != DONE:
            print(row.name, done.stderr.strip()[-300:])
            continue
        report = json.loads((folder / "out" / "report.json").read_text())
        looked, contradictions, right = wrong(row, options, folder, options.poses)
        shares = report["coverage"]
        parts = [f"{100.0 * shares[kind]:.2f} %" for kind in ("certified", "falsified", "unknown")]
        found = shares["certified"] / right if right else 1.0
        more = [f"{found:.3f}", f"{report['seconds']:.0f}", f"{0.5 * (load + os.getloadavg()[0]):.1f}"]
        lines.append(f"| {row.name} | {' | '.join([*parts, *more, f'{looked:,}', str(contradictions)])} |")
        print(lines[-1], f"{time.perf_counter() - begin:.0f} s with the samples", flush=True)
        (options.output / "table.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
