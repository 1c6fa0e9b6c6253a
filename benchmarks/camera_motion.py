"""A benchmark of camera motion for other verifiers: three scenes, five networks, 60 instances of VNN-LIB.

    python benchmarks/camera_motion.py make FOLDER [--vnnlib-version 2.0]
    python benchmarks/camera_motion.py verify FOLDER [--seconds 60]

``make`` writes three runs of splats (airfield, gate, things), trains five small networks for each that say which of
four views a picture shows, and writes ``FOLDER/instances`` with ``ns-abstract-export vnnlib``: instances.csv, boxes of
camera parameters, pictures, poses. ``verify`` decides them with this package, and with auto_LiRPA's CROWN and
alpha-CROWN where that and onnx2pytorch are installed, and writes ``FOLDER/verdicts.csv``. The exit code is 1 where one
says "unsat" and the other has a counterexample.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import torch
from objects import random_things
from objects import scene as things
from torch import nn
from views import export, pictures

from ns_abstract.api.files import Settings, open_job
from ns_abstract.bench.vnnlib import run_folder
from ns_abstract.cli.export import ExportVnnLib
from ns_abstract.cli.export import export as run_export
from ns_abstract.demo.paths import airfield_views, gate_views
from ns_abstract.demo.scenes import splat_scene
from ns_abstract.geometry.keyframe_cameras import KeyframeCamera, around, path_json
from ns_abstract.io.atomic import write_json
from ns_abstract.methods.splat.write import write_splatfacto_run

#: Pixels; pictures of a view to train with; steps of training; views by scene.
SIZE, SAMPLES, STEPS, VIEWS = 16, 48, 400, 4
#: Half-widths of the sets of the views: shift (normalised units) and yaw (radians).
SETS = ((0.002, 0.001), (0.005, 0.002), (0.02, 0.01), (0.06, 0.03))
_LIBRARY = "auto_LiRPA"


class Residual(nn.Module):
    """A convolution beside a shortcut."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.inner = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return torch.relu(x + self.inner(x))


def networks() -> dict[str, nn.Module]:
    """Five untrained networks of pictures [1, 3, `SIZE`, `SIZE`] by name."""
    n = SIZE * SIZE
    return {
        "linear": nn.Sequential(nn.Flatten(), nn.Linear(3 * n, VIEWS)),
        "wide": nn.Sequential(nn.Flatten(), nn.Linear(3 * n, 64), nn.ReLU(), nn.Linear(64, VIEWS)),
        "deep": nn.Sequential(
            nn.Flatten(), nn.Linear(3 * n, 32), nn.ReLU(), nn.Linear(32, 32), nn.ReLU(), nn.Linear(32, 32), nn.ReLU(),
            nn.Linear(32, VIEWS),
        ),
        "convolution": nn.Sequential(
            nn.Conv2d(3, 8, 3, stride=2, padding=1), nn.ReLU(), nn.Conv2d(8, 8, 3, stride=2, padding=1), nn.ReLU(),
            nn.Flatten(), nn.Linear(n // 2, VIEWS),
        ),
        "residual": nn.Sequential(
            nn.Conv2d(3, 6, 3, stride=2, padding=1), Residual(6), nn.AvgPool2d(2), nn.Flatten(),
            nn.Linear(6 * n // 16, VIEWS),
        ),
    }  # fmt: skip


def scenes() -> dict[str, tuple[Any, list[KeyframeCamera]]]:
    """The scenes and their views."""
    rng = np.random.default_rng(3)
    middle = (0.0, 0.0, 0.2)
    lawn = [around(middle, 90.0 * k + 20.0, 35.0, 2.2, height=SIZE, width=SIZE) for k in range(VIEWS)]
    return {
        "airfield": (splat_scene("airfield"), airfield_views(SIZE)[:VIEWS]),
        "gate": (splat_scene("gate"), gate_views(VIEWS, SIZE)),
        "things": (things(random_things(rng, 3), seed=1), lawn),
    }


def make(folder: Path, version: str) -> None:
    """Write runs, networks and instances."""
    for name, (scene, views) in scenes().items():
        config = write_splatfacto_run(
            scene, folder / "runs", timestamp="run", experiment_name=name, views=[*views, *views]
        )
        path = path_json(views)
        for entry, (shift, turn) in zip(path["camera_path"], SETS, strict=True):
            entry["perturbation"] = {"version": 1, "translation": {"x": shift}, "rotation": {"yaw": turn}}
        path_file = write_json(folder / f"{name}.json", path)
        job = open_job(Settings(config, path_file))
        rng, x, y = np.random.default_rng(0), [], []
        for k, poses in enumerate(job.pose_sets):
            values = rng.uniform(poses.box.lower, poses.box.upper, (SAMPLES, poses.box.dimensions))
            x.append(pictures(job.method, poses, values).float())
            y.append(torch.full((SAMPLES,), k))
        files = []
        for kind, network in networks().items():
            torch.manual_seed(0)
            for layer in network.modules():
                if hasattr(layer, "reset_parameters"):
                    layer.reset_parameters()  # pyright: ignore[reportCallIssue]
            right = _fit(network, torch.cat(x), torch.cat(y))
            file = folder / "networks" / f"{kind}.onnx"
            file.parent.mkdir(parents=True, exist_ok=True)
            export(network.eval(), SIZE, file)
            files.append(file)
            print(f"{name} {kind}: {100 * right:.0f} % of the training pictures are right", flush=True)
        for k in range(VIEWS):
            label = write_json(folder / f"label_{k}.json", {"type": "classification", "label": k})
            options = ExportVnnLib(
                load_config=config, camera_path_filename=path_file, model=tuple(files), property=(label,),
                output_dir=folder / "instances", frames=(k,), timeout=60, prefix=f"{name}_", append=True,
                pictures=True, vnnlib_version=version,  # pyright: ignore[reportArgumentType]
            )  # fmt: skip
            run_export(options)


def _fit(network: nn.Module, x: torch.Tensor, y: torch.Tensor) -> float:
    """Train; returns the part of the pictures that is right."""
    optimiser = torch.optim.Adam(network.parameters(), 2e-3)
    for _ in range(STEPS):
        chosen = torch.randint(len(x), (64,))
        optimiser.zero_grad()
        nn.functional.cross_entropy(network(x[chosen]), y[chosen]).backward()
        optimiser.step()
    return float((network(x).argmax(1) == y).float().mean())


def lirpa(network: Path) -> str:
    """The verdict of CROWN, then alpha-CROWN, over the whole box, and of random inputs; all groups are single rows."""
    from ns_abstract.nerfstudio.torchvision_operators import declare_missing

    declare_missing()
    import onnx
    from auto_LiRPA import BoundedModule, BoundedTensor, PerturbationLpNorm  # pyright: ignore[reportMissingImports]
    from onnx2pytorch import ConvertModel  # pyright: ignore[reportMissingImports]

    proto = onnx.load(str(network))
    size = proto.graph.input[0].type.tensor_type.shape.dim[1].dim_value
    model = ConvertModel(proto, experimental=True).eval()
    zero = torch.zeros(1, size)
    generator = torch.Generator().manual_seed(0)
    tried = torch.rand((200, size), generator=generator) * 2.0 - 1.0
    with torch.no_grad():
        if any(bool((model(x[None]) <= 0.0).any()) for x in tried):
            return "sat"
    bounded = BoundedModule(model, zero, bound_opts={"optimize_bound_args": {"iteration": 20}}, verbose=False)
    given = BoundedTensor(zero, PerturbationLpNorm(norm=float("inf"), x_L=zero - 1.0, x_U=zero + 1.0))
    for method in ("CROWN", "CROWN-Optimized"):
        lower, _ = bounded.compute_bounds(x=(given,), method=method, bound_upper=False)
        if bool((lower > 0.0).all()):
            return "unsat"
    return "unknown"


def verify(folder: Path, seconds: float) -> int:
    """Decide all instances; returns the exit code."""
    rows, contradictions = [], 0
    for row in run_folder(folder / "instances", folder / "results", seconds=seconds):
        start = time.perf_counter()
        try:
            other, why = lirpa(folder / "instances" / row["network"]), ""
        except ImportError as error:
            other, why = "absent", str(error)
        except (RuntimeError, NotImplementedError, TypeError, KeyError, AttributeError, ValueError) as error:
            other, why = "error", f"{type(error).__name__}: {error}"[:80]
        spent = time.perf_counter() - start
        contradictions += {row["verdict"], other} == {"sat", "unsat"}
        rows.append([row["network"], row["verdict"], row["seconds"], other, f"{spent:.2f}", why or row["why"]])
        print(*rows[-1], flush=True)
    with open(folder / "verdicts.csv", "w", newline="") as stream:
        csv.writer(stream).writerows([["instance", "ns-abstract", "seconds", _LIBRARY, "seconds", "why"], *rows])
    for name, column in (("ns-abstract", 1), (_LIBRARY, 3)):
        print(name, json.dumps(dict(Counter(row[column] for row in rows))))
    print(f"{len(rows)} instances, {contradictions} contradictions")
    return 1 if contradictions else 0


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=["make", "verify"])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--vnnlib-version", choices=["1.0", "2.0"], default="1.0")
    parser.add_argument("--seconds", type=float, default=60.0)
    options = parser.parse_args()
    if options.command == "make":
        make(options.folder, options.vnnlib_version)
    else:
        sys.exit(verify(options.folder, options.seconds))


if __name__ == "__main__":
    main()
