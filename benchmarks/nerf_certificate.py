"""A certificate of a small NeRF: which side of the object is shown, over an arc of an orbit, attacked afterwards.

    python benchmarks/nerf_certificate.py RUN/config.yml OUTPUT_DIR [--path CAMERA_PATH.json] [--arc 0.5] [--side 16]

Trains a small classifier of the side (four sectors of the path's orbit) on renders of the NeRF, asks
`ns-abstract-certify` whether it names the right one everywhere on an arc in the middle of a sector, and then renders
poses of certified cells: the network must be right on all of them, and every pixel must lie in the bounds of its cell.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from nerfacto import camera_of
from torch import nn
from torch.nn import functional
from views import HELD, export, fit, pictures

import ns_abstract as nsa
from ns_abstract.geometry.camera_path import load_camera_path
from ns_abstract.io.jsonio import load_json
from ns_abstract.refine.protocol import RayFrame
from ns_abstract.verify.model import NetworkModel
from ns_abstract.verify.network import load_network
from ns_abstract.verify.preprocess import Preprocess

SECTORS = 4


def network(side: int) -> nn.Sequential:
    """Two strided convolutions and two linear layers."""
    return nn.Sequential(
        nn.Conv2d(3, 8, 4, 2, 1), nn.ReLU(), nn.Conv2d(8, 12, 4, 2, 1), nn.ReLU(), nn.Flatten(),
        nn.Linear(12 * (side // 4) ** 2, 24), nn.ReLU(), nn.Linear(24, SECTORS),
    )  # fmt: skip


def vertical_orbit() -> dict[str, Any]:
    """A camera path of the view of `nerfacto.py`, with an orbit about the vertical axis."""
    camera = camera_of(1)
    pose = np.vstack([camera.camera_to_world, [0.0, 0.0, 0.0, 1.0]])
    fov = math.degrees(2.0 * math.atan(0.5 / camera.fx))
    view = {"camera_to_world": pose.ravel().tolist(), "fov": fov, "aspect": 1}
    orbit = {"target": [0.0, 0.0, 0.1], "axis": [0.0, 0.0, 1.0], "azimuth": [0.0, 2.0 * math.pi]}
    perturbation = {"version": 1, "sweep": "keyframes", "orbit": orbit}
    return {"camera_type": "perspective", "camera_path": [view], "fps": 1, "seconds": 1, "perturbation": perturbation}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("run", type=Path)
    parser.add_argument("output_dir", type=Path)
    parser.add_argument("--path", type=Path, help="with an orbit; without it, one about the vertical axis")
    parser.add_argument("--side", type=int, default=16)
    parser.add_argument("--arc", type=float, default=0.5, help="radians")
    parser.add_argument("--num-samples", type=int, help="of a vanilla-nerf's rays")
    parser.add_argument("--near-plane", type=float, help="of a vanilla-nerf's rays")
    parser.add_argument("--pictures", type=int, default=600)
    parser.add_argument("--steps", type=int, default=800)
    parser.add_argument("--minutes", type=float, default=20.0, help="of the certificate")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--comparisons", type=int, default=200_000)
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu", help="where the field is bounded")
    options = parser.parse_args()
    torch.manual_seed(0)
    options.output_dir.mkdir(parents=True, exist_ok=True)
    side = options.side
    value = vertical_orbit() if options.path is None else load_json(options.path, "camera path")
    value["render_height"] = value["render_width"] = side
    orbit = value["perturbation"]["orbit"]
    (options.output_dir / "path.json").write_text(json.dumps(value))
    camera = load_camera_path(options.output_dir / "path.json").cameras[0]
    scene = nsa.load_scene(
        options.run, num_samples=options.num_samples, near_plane=options.near_plane, device=options.device
    )
    begin = time.perf_counter()
    whole = nsa.PoseSet(camera, orbit={**orbit, "azimuth": [0.0, 2.0 * math.pi]}, translation={"x": 0.01, "y": 0.01})
    frame = scene.method().frame(whole.of(scene))
    values = frame.box.sample(options.pictures, np.random.default_rng(0))
    images = pictures(scene.method(), whole.of(scene), values)
    azimuth = torch.from_numpy(values[:, frame.box.names.index("azimuth")])
    labels = (azimuth / (2.0 * math.pi) * SECTORS).long().clamp(max=SECTORS - 1)
    model = network(side)
    held = torch.arange(len(images)) % HELD == 0
    right = labels[~held]

    def loss(outputs: torch.Tensor, which: torch.Tensor) -> torch.Tensor:
        return functional.cross_entropy(outputs, right[which], label_smoothing=0.02)

    fit(model, images[~held], loss, steps=options.steps)
    with torch.no_grad():
        accuracy = float((model(images[held]).argmax(dim=1) == labels[held]).float().mean())
    file = options.output_dir / "sectors.onnx"
    export(model, side, file)
    print(f"classifier: {accuracy:.3f} held back, {time.perf_counter() - begin:.0f} s", flush=True)
    middle = 1.5 * 2.0 * math.pi / SECTORS
    arc = [middle - 0.5 * options.arc, middle + 0.5 * options.arc]
    poses = nsa.PoseSet(camera, orbit={**orbit, "azimuth": arc})
    prop = {"type": "classification", "label": 1}
    begin = time.perf_counter()
    found = nsa.certify(
        scene, poses, file, prop, time_budget=60.0 * options.minutes, workers=options.workers,
        output_dir=options.output_dir / "certificate",
    )  # fmt: skip
    minutes = (time.perf_counter() - begin) / 60.0
    frame = scene.method().frame(poses.of(scene))
    judge = NetworkModel(load_network(file), Preprocess(), 1 << 30)
    right = np.mean([
        judge.outputs(frame.render(np.array([a])).reshape(1, side, side, 3))[0].argmax() == 1
        for a in np.linspace(arc[0], arc[1], 200)
    ])  # fmt: skip
    print(
        f"{scene.method().content}, {side} x {side}, {options.arc} rad: certified "
        f"{found.certified:.3f}, falsified {found.falsified:.3f}, unknown {found.unknown:.3f}; right on {right:.3f} of "
        f"200 samples; {minutes:.1f} minutes, {options.workers} processes, {found.state}",
        flush=True,
    )
    attack(scene, poses, judge, found, side, options.comparisons)


def attack(
    scene: nsa.Scene, poses: nsa.PoseSet, judge: NetworkModel, found: nsa.Certificate, side: int, n: int
) -> None:
    """Render poses of certified cells; compare pixels with bounds of their cells, and outputs with the claim."""
    cells = [cell for cell in found.cells if cell.verdict == "certified"]
    if not cells:
        return
    frame = cast("RayFrame", scene.method().frame(poses.of(scene)))
    rng = np.random.default_rng(1)
    compared = violated = wrong = 0
    while compared < n:
        cell = cells[rng.integers(len(cells))]
        box = frame.box.replace(0, float(cell.lower[0]), float(cell.upper[0]))
        bounds = frame.cell_bounds(box)
        assert bounds.linear is not None
        a_lower, b_lower, a_upper, b_upper = (part.astype(np.float64) for part in bounds.linear)
        for p in (-1.0, 1.0, *rng.uniform(-1.0, 1.0, 6)):
            picture = frame.render(box.at(np.array([p])))
            low, high = b_lower + a_lower @ [p], b_upper + a_upper @ [p]
            shown = picture.astype(np.float64)
            violated += int((~((low <= shown) & (shown <= high))).sum())
            violated += int((~((bounds.lower <= picture) & (picture <= bounds.upper))).sum())
            compared += 2 * picture.size
            outputs = judge.outputs(picture.reshape(1, side, side, 3))[0]
            wrong += int(outputs.argmax() != 1 or outputs[1] - np.delete(outputs, 1).max() < (cell.margin or 0.0))
    print(f"attack: {compared:,} comparisons, {violated} violated; {wrong} wrong or below the proved margin")


if __name__ == "__main__":
    main()
