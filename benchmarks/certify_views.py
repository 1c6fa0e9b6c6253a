"""Certificates of the networks in `networks/`, in the shape of Tables 3 and 4 of "Abstract Rendering".

    ns-abstract-demo --output-dir DEMO
    python benchmarks/certify_views.py OUTPUT_DIR --demo DEMO [--airplane RUN/config.yml --airplane-path ORBIT.json]
                                       [--nerfs FOLDER] [--models FOLDER] [--only NAME ...] [--minutes 20]

Writes camera path, property and certificate of every row below OUTPUT_DIR (as `ns-abstract-certify` takes and leaves
them), and prints the table. PCP-S and PCP-V are of a fixed partition (docs/certificates.md). Certified cells are then
attacked: random poses are rendered, shown to onnxruntime, and the margin found is compared with the one proved.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from objects import KINDS, RUNS, write_nerf, write_run
from train_views import CONFIDENCE, NEAR_PLANE, SAMPLES, orbit_of, target_of

import ns_abstract as nsa
from ns_abstract.api.certification import FramePictures, PropertySource
from ns_abstract.api.files import resized
from ns_abstract.api.network_question import Question
from ns_abstract.geometry.camera_path import load_camera_path
from ns_abstract.io.atomic import write_json
from ns_abstract.verify.model import NetworkModel

NETWORKS = Path(__file__).resolve().parent / "networks"
#: Radii of colours for `curve`.
_CURVE = (0.01, 0.02, 0.03, 0.05, 0.07)
#: Where the rays of NeRFs of splat scenes begin.
NERFS = {"airplane": 0.6, "lawn": 0.8}
#: Scenes of a set that certified cells are attacked with.
_MEMBERS = 20


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
    perturbation: dict[str, Any]
    property: dict[str, Any]
    partitions: tuple[int, ...]


_CIFAR = {"resize": [32, 32], "mean": [0.4914, 0.4822, 0.4465], "std": [0.2471, 0.2435, 0.2616]}


def estimate(part: float, **translation: float) -> tuple[dict[str, Any], dict[str, Any]]:
    """Set and property: the target's place within ``part`` of the distance."""
    prop = {"type": "regression", "target": "object", "tolerance": {"relative": part}}
    return {"translation": translation}, prop


def detect(kind: str, iou: float | None = None, **translation: float) -> tuple[dict[str, Any], dict[str, Any]]:
    """Set and property: a box of the kind, with the paper's threshold."""
    prop = {"type": "detection", "class": KINDS[kind], "confidence": CONFIDENCE, "iou": iou}
    return {"translation": translation}, prop


def turn(kind: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Set and property: the right class all around the thing."""
    prop = {"type": "classification", "label": list(KINDS).index(kind)}
    return {"orbit": {"azimuth": [0.0, 2.0 * math.pi]}}, prop


ROWS = {
    "airplane, x": Row("estimator_airplane", "airplane", *estimate(0.05, x=0.4), (1000,)),
    "airplane, z": Row("estimator_airplane", "airplane", *estimate(0.05, z=0.2), (1000,)),
    "airplane, x and z": Row("estimator_airplane", "airplane", *estimate(0.05, x=0.4, z=0.2), (400, 50)),
    "airplane, past its edge": Row("estimator_airplane", "airplane", *estimate(0.05, x=0.55), (1000,)),
    "airfield, x": Row("estimator_airfield", "airfield", *estimate(0.05, x=0.35), (1000,)),
    "airfield, z": Row("estimator_airfield", "airfield", *estimate(0.05, z=0.2), (1000,)),
    "buoy NeRF, x": Row("estimator_buoy", "buoy", *estimate(0.05, x=0.3), (100,)),
    **{
        f"lawn, {kind}": Row("detector_things", "lawn", *detect(kind, x=0.3), (1000,))
        for kind in ("aeroplane", "car", "pottedplant")
    },
    # NeRFs of the same scenes, trained on their renders
    "airplane NeRF, x": Row("estimator_airplane_nerf", "airplane NeRF", *estimate(0.05, x=0.08), (40,)),
    **{
        f"lawn NeRF, {kind}": Row("detector_lawn_nerf", "lawn NeRF", *detect(kind, x=0.1), (40,))
        for kind in ("aeroplane", "car")
    },
    "lawn, aeroplane, past its edge": Row("detector_things", "lawn", *detect("aeroplane", x=1.6), (1000,)),
    "lawn, car, IoU 0.5": Row("detector_things", "lawn", *detect("car", 0.5, x=0.05), (200,)),
    "buoy NeRF, boat": Row("detector_buoy", "buoy", *detect("boat", x=0.3), (100,)),
    **{f"{kind}, orbit": Row("classifier_things", kind, *turn(kind), (1000,)) for kind in KINDS},
}
# every Gaussian of the scene varies by itself; "airplane" is the class of the CIFAR-10 network
ROWS |= {
    f"airplane, orbit, {name}": Row(
        "cifar10_resnet2b",
        "airplane",
        {"orbit": {"azimuth": [0.0, 2.0 * math.pi]}, **({"scene": [{"select": {}, **varied}]} if varied else {})},
        {"type": "classification", "label": 0, "preprocess": _CIFAR},
        (1000,),
    )
    for name, varied in (("poses alone", {}), ("colour 0.05", {"color": 0.05}), ("opacity 0.05", {"opacity": 0.05}))
}
# the same question of networks that were trained on the run, plainly and for scenes that vary, and of things
ROWS |= {
    f"{'airplane run' if scene == 'airplane' else kind}, orbit, {training}, {quantity} {radius:g}": Row(
        f"classifier_{scene}_{training}",
        scene if scene == "airplane" else kind,
        {**turn(kind)[0], "scene": [{"select": {}, quantity: radius}]},
        turn(kind)[1],
        (1000,),
    )
    for scene, kinds, trainings in (
        ("airplane", ("aeroplane",), ("plain", "members", "signs", "certified")),
        ("things", KINDS, ("certified",)),
    )
    for kind in kinds
    for training in trainings
    for quantity, radius in (("color", 0.05), ("opacity", 0.05))
}
# what certified training is for: parts so coarse that not all can be certified
ROWS |= {
    f"airfield, {training}, {parts[0]}": Row(f"estimator_airfield{suffix}", "airfield", *estimate(0.05, x=0.35), parts)
    for parts in ((80,), (160,))
    for training, suffix in (("plain", ""), ("certified", "_certified"))
}


def scenes(options: argparse.Namespace) -> dict[str, Callable[[], tuple[nsa.Scene, Path]]]:
    """How to open the scenes of the rows, each with its camera path."""
    runs = options.output_dir / "runs"

    def thing(name: str) -> tuple[nsa.Scene, Path]:
        config, path = write_run(runs, name)
        return nsa.load_scene(config), path

    def nerf() -> tuple[nsa.Scene, Path]:
        config, path = write_nerf(runs)
        return nsa.load_scene(config, num_samples=SAMPLES, near_plane=NEAR_PLANE), path

    def trained(config: Path, near: float, splats: Callable[[], tuple[nsa.Scene, Path]]) -> tuple[nsa.Scene, Path]:
        return nsa.load_scene(config, num_samples=SAMPLES, near_plane=near), splats()[1]

    found: dict[str, Callable[[], tuple[nsa.Scene, Path]]] = {name: partial(thing, name) for name in RUNS}
    found["buoy"] = nerf
    if options.airplane is not None:
        found["airplane"] = lambda: (nsa.load_scene(options.airplane), options.airplane_path)
    for name, near in NERFS.items():
        config = None if options.nerfs is None else next((options.nerfs / name).rglob("config.yml"), None)
        if config is not None and name in found:
            found[f"{name} NeRF"] = partial(trained, config, near, found[name])
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
    others = [None, *itertools.islice(pictures.scene_samples(1), _MEMBERS)]
    for k in range(count):
        cell = certified[rng.integers(len(certified))]
        values = rng.uniform(cell.lower, cell.upper)
        outputs = model.outputs(pictures.image(values, others[k % len(others)])[None]).astype(np.float64)
        margin = float(claim.margin(torch.from_numpy(outputs), torch.from_numpy(values[None]))[0])
        wrong += not margin >= max(cell.margin or 0.0, 0.0)
    return count, wrong


def margins(pictures: FramePictures, question: Question, parts: int, every: int) -> tuple[np.ndarray, np.ndarray]:
    """Of each ``every``-th of equal parts of a set of one parameter: the margin proved at once, and the least found.

    Found: at the part's middle, for the scene as stored, the set's first members, and the member to which one step
    along the signs of the margin's slope leads, towards smaller margins. Unlike `ns_abstract.certify` nothing more is
    tried
    where a proof fails, so many networks can be compared.
    """
    model = NetworkModel(question.network, question.property.preprocess, 1 << 30)
    box, sets, found = pictures.box, [], []
    ends = np.linspace(box.lower[0], box.upper[0], parts + 1)
    boxes = [box.replace(0, float(ends[k]), float(ends[k + 1])) for k in range(0, parts, every)]
    claim = question.property.bind(pictures.pose_set, lambda: model.outputs(pictures.image(box.middle)[None])[0])
    some = list(itertools.islice(pictures.scene_samples(1), _MEMBERS))

    def loss(picture: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        return -claim.margin(model.differentiable(picture[None]), values[None])[0]

    for part in boxes:
        tried = [None, *some, *(one.nearest.signed_gradient_step(part, part.middle, loss, 2.0)[1] for one in some[:1])]
        linear, lower, upper, _ = pictures.linear_sets(part)
        sets.append((*linear, lower, upper))
        outputs = model.outputs(np.stack([pictures.image(part.middle, member) for member in tried])).astype(np.float64)
        values = torch.from_numpy(np.repeat(part.middle[None], len(tried), axis=0))
        found.append(claim.margin(torch.from_numpy(outputs), values).min().item())
    stacked = [np.stack(arrays) for arrays in zip(*sets, strict=True)]
    nominal = np.stack([model.outputs(pictures.image(part.middle)[None])[0] for part in boxes])
    query = claim.query(nominal)
    inputs = model.input_sets(tuple(stacked[:4]), stacked[4], stacked[5])
    return np.array(claim.proved(query, model.bound(inputs, query), boxes), np.float64), np.array(found)


def curve(options: argparse.Namespace) -> None:
    """Print what `margins` proves of things all around, by network and by how far all colours may be off."""
    known, folders = scenes(options), [NETWORKS, *([options.models] if options.models else [])]
    for file in sorted(file for folder in folders for file in folder.glob("classifier_things*.onnx")):
        for radius in _CURVE:
            shares = []
            for kind in KINDS:
                scene, path = known[kind]()
                perturbation, prop = turn(kind)
                value = {"version": 1, **perturbation, "scene": [{"select": {}, "color": radius}]}
                value["orbit"] = {**orbit_of(path), **perturbation["orbit"]}
                question = Question(file, PropertySource.of(prop))
                poses = nsa.PoseSet.from_json(load_camera_path(path).cameras[0], value).of(scene)
                pictures = FramePictures(scene.method(), resized(poses, *question.size))
                shares.append([float((part > 0.0).mean()) for part in margins(pictures, question, 1000, 20)])
            proved, right = np.mean(shares, axis=0)
            print(
                f"| {file.stem} | {radius:g} | proved {proved:.1%} | right as far as attacked {right:.1%} |", flush=True
            )


def certify(
    name: str, row: Row, file: Path, scene: nsa.Scene, path: Path, folder: Path, minutes: float, attacks: int = 300
) -> str:
    """Certify a row with the network ``file`` and write what it takes; returns its line of the table."""
    folder.mkdir(parents=True, exist_ok=True)
    prop = {**row.property, "partitions": list(row.partitions)}
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
    tried, wrong = attack(FramePictures(scene.method(), poses.of(scene)), question, found, attacks)
    right, certified = (part[key] / part["partitions"] for key in ("right", "certified"))
    distance = float(np.linalg.norm(camera.camera_to_world[:, 3] - np.array(orbit["target"])))
    about = ", ".join(f"{key} {value:g}" for key, value in row.perturbation.get("translation", {"orbit": 360}).items())
    count = " x ".join(map(str, row.partitions))
    return (
        f"| {name} | {scene.method().content} | {about} | {distance:.2f} | {count} | {right:.1%} | "
        f"{certified:.1%} | {certified / right if right else math.nan:.3f} | {len(found.cells)} | {spent:.1f} | "
        f"{found.state} | {tried} / {wrong} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output_dir", type=Path)
    parser.add_argument("--demo", type=Path)
    parser.add_argument("--airplane", type=Path, help="config.yml of the run that the network was trained on")
    parser.add_argument("--airplane-path", type=Path)
    parser.add_argument("--nerfs", type=Path, help="folder of NeRFs that train_lego.py made of airplane and lawn")
    parser.add_argument("--models", type=Path, help="folder of cifar10_resnet2b.onnx")
    parser.add_argument("--only", nargs="*", choices=list(ROWS))
    parser.add_argument("--minutes", type=float, default=20.0, help="by row")
    parser.add_argument("--curve", action="store_true", help="nothing but parts proved, by radius of all colours")
    options = parser.parse_args()
    if options.curve:
        curve(options)
        return
    known = scenes(options)
    lines, folders = [], [NETWORKS, *([options.models] if options.models else [])]
    for name, row in ROWS.items():
        file = next((found for found in (f / f"{row.network}.onnx" for f in folders) if found.exists()), None)
        if file is not None and row.scene in known and (not options.only or name in options.only):
            scene, path = known[row.scene]()
            folder = options.output_dir / re.sub(r"[^a-zA-Z0-9.]+", "_", name)
            lines.append(certify(name, row, file, scene, path, folder, options.minutes))
            print(lines[-1], flush=True)
    heads = (
        "row", "content", "radius", "d", "parts", "PCP-S", "PCP-V", "V / S", "cells", "CPU minutes", "state",
        "attacked / violated",
    )  # fmt: skip
    print("\n".join(["", f"| {' | '.join(heads)} |", "|---" * len(heads) + "|", *lines]))


if __name__ == "__main__":
    main()
