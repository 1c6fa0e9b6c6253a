"""Certificates of the networks in `networks/`, in the shape of Tables 3 and 4 of "Abstract Rendering".

    ns-abstract-demo --output-dir DEMO
    python benchmarks/certify_views.py OUTPUT_DIR --demo DEMO [--airplane RUN/config.yml --airplane-path ORBIT.json]
                                       [--only NAME ...] [--minutes 20]

Writes camera path, property and certificate of every row below OUTPUT_DIR (as `ns-abstract-certify` takes and leaves
them), and prints the table. PCP-S and PCP-V are of a fixed partition (docs/certificates.md). Certified cells are then
attacked: random poses are rendered, shown to onnxruntime, and the margin found is compared with the one proved.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from train_views import target_of
from views import write_json

import ns_abstract as nsa
from ns_abstract.api.certification import FramePictures, PropertySource, Question
from ns_abstract.geometry.camera_path import load_camera_path
from ns_abstract.verify.model import NetworkModel

NETWORKS = Path(__file__).resolve().parent / "networks"


@dataclass(frozen=True)
class Row:
    """A certificate.

    Attributes:
        network: Name in `NETWORKS`, also of the row.
        scene: Which run: a key of `scenes`.
        perturbation: The set, without its version.
        property: What is to hold; "origin" of a regression is put in from the path's orbit.
        partitions: Of the set.
    """

    network: str
    scene: str
    about: str
    perturbation: dict[str, Any]
    property: dict[str, Any]
    partitions: int


def estimate(part: float) -> dict[str, Any]:
    return {"type": "regression", "target": "object", "tolerance": {"relative": part}}


ROWS = {
    "airplane-x": Row(
        "estimator_airplane", "airplane", "estimate within 5 %, x", {"translation": {"x": 0.4}}, estimate(0.05), 1000
    ),
    "airplane-z": Row(
        "estimator_airplane", "airplane", "estimate within 5 %, z", {"translation": {"z": 0.2}}, estimate(0.05), 1000
    ),
}


def scenes(options: argparse.Namespace) -> dict[str, Callable[[], tuple[nsa.Scene, Path]]]:
    """How to open the scenes of the rows, each with its camera path."""
    found: dict[str, Callable[[], tuple[nsa.Scene, Path]]] = {}
    if options.airplane is not None:
        found["airplane"] = lambda: (nsa.load_scene(options.airplane), options.airplane_path)
    if options.demo is not None:
        run = next((options.demo / "airfield").rglob("config.yml"))
        found["airfield"] = lambda: (nsa.load_scene(run), options.demo / "camera_path_orbit.json")
    return found


def attack(pictures: FramePictures, question: Question, found: nsa.Certificate, count: int) -> tuple[int, int]:
    """Random poses of certified cells that were looked at, and those whose margin is below the one proved."""
    certified = [cell for cell in found.cells if cell.verdict == "certified"]
    if not certified:
        return 0, 0
    model, rng = NetworkModel(question.network, question.property.preprocess, 1 << 30), np.random.default_rng(1)

    def nominal() -> np.ndarray:
        return model.outputs(pictures.image(pictures.box.middle)[None])[0]

    claim, wrong = question.property.bind(pictures.pose_set, nominal), 0
    for _ in range(count):
        cell = certified[rng.integers(len(certified))]
        values = rng.uniform(cell.lower, cell.upper)
        outputs = model.outputs(pictures.image(values)[None]).astype(np.float64)
        margin = float(claim.margin(torch.from_numpy(outputs), torch.from_numpy(values[None]))[0])
        wrong += not margin >= max(cell.margin or 0.0, 0.0)
    return count, wrong


def certify(name: str, row: Row, scene: nsa.Scene, path: Path, folder: Path, minutes: float) -> str:
    """Certify a row and write what it takes; returns its line of the table."""
    folder.mkdir(parents=True, exist_ok=True)
    file = NETWORKS / f"{row.network}.onnx"
    prop = {**row.property, "partitions": row.partitions}
    if prop["type"] == "regression":
        prop["origin"] = target_of(path)
    value = json.loads(path.read_text(encoding="utf-8"))
    question = Question(file, PropertySource.of(prop))
    value["render_height"], value["render_width"] = question.size
    orbit = value["perturbation"]["orbit"]
    value["perturbation"] = {"version": 1, **row.perturbation}
    if "orbit" in row.perturbation:
        value["perturbation"]["orbit"] = {**orbit, **row.perturbation["orbit"]}
    camera = load_camera_path(write_json(folder / "path.json", value)).cameras[0]
    write_json(folder / "property.json", prop)
    poses = nsa.PoseSet.from_json(camera, value["perturbation"])
    begin = time.process_time()
    found = nsa.certify(
        scene, poses, file, folder / "property.json", time_budget=60.0 * minutes, output_dir=folder / "certificate"
    )  # fmt: skip
    spent = (time.process_time() - begin) / 60.0
    part = found.report["frames"][0]["partition"]
    tried, wrong = attack(FramePictures(scene.method(), poses.of(scene)), question, found, 300)
    right, certified = (part[key] / part["partitions"] for key in ("right", "certified"))
    distance = float(np.linalg.norm(camera.camera_to_world[:, 3] - np.array(orbit["target"])))
    return (
        f"| {name} | {scene.method().content} | {row.about} | {distance:.2f} | {row.partitions} | {right:.1%} | "
        f"{certified:.1%} | {certified / right if right else math.nan:.3f} | {len(found.cells)} | {spent:.1f} | "
        f"{found.state} | {tried} / {wrong} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output_dir", type=Path)
    parser.add_argument("--demo", type=Path)
    parser.add_argument("--airplane", type=Path, help="config.yml of the run that the network was trained on")
    parser.add_argument("--airplane-path", type=Path)
    parser.add_argument("--only", nargs="*", choices=list(ROWS))
    parser.add_argument("--minutes", type=float, default=20.0, help="by row")
    options = parser.parse_args()
    known = scenes(options)
    lines = []
    for name, row in ROWS.items():
        if row.scene in known and (not options.only or name in options.only):
            scene, path = known[row.scene]()
            lines.append(certify(name, row, scene, path, options.output_dir / name, options.minutes))
            print(lines[-1], flush=True)
    heads = (
        "row", "scene", "set", "d", "parts", "PCP-S", "PCP-V", "V / S", "cells", "CPU minutes", "state",
        "attacked / violated",
    )  # fmt: skip
    print("\n".join(["", f"| {' | '.join(heads)} |", "|---" * len(heads) + "|", *lines]))


if __name__ == "__main__":
    main()
