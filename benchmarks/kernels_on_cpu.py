"""Attack float32 bounds by gsplat's own kernels, compiled for the CPU.

    python benchmarks/kernels_on_cpu.py [RUN/config.yml ...] [--stiff] [--sets x yaw six] [--modes classic antialiased]
        [--layers]

For each run, mode and set: cells about random poses of the set, of width zero and of ``--widths`` times the set's, each
bounded with float32 arithmetic and compared, with tolerance zero, with renders of poses of the cell: its middle, its
corners, random ones, by turns by the builds in `BUILDS` with a new seed each time. The small cells are the hard ones:
next to nothing but the charge for float32 rounding lies between their bounds and the renders.

What is executed: gsplat's kernels for projection, spherical harmonics, tile intersection and rasterisation, in IEEE
float32, with and without fused multiply-adds, and with division, roots, exponential and logarithm erring by what
CUDA's programming guide allows, in random and in adverse directions (``tests/gsplat_kernels``). Not executed: a GPU.

"spread" is the mean gap between the least and the greatest of a cell's renders: at width zero, of one pose, it is what
float32 alone makes of the picture, and no bounds of every evaluation can be narrower.

``--planted`` bounds another rasteriser (alpha at most 0.98); violations are then expected, and none is a failure.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from both_ways import bounded_both_ways
from gsplat_kernels import Kernels, Unavailable

from ns_abstract.arithmetic.rounding import FLOAT32
from ns_abstract.bench.sets import open_jobs, pose_set, splat_of
from ns_abstract.bench.stiff_cases import all_cases
from ns_abstract.bench.tables import markdown, write
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.geometry.tiles import assemble
from ns_abstract.methods.splat.activate import activate
from ns_abstract.methods.splat.bounds import SplatBounds
from ns_abstract.methods.splat.constants import VERSIONS, Rasteriser
from ns_abstract.methods.splat.scene import SplatScene

BUILDS: tuple[dict[str, Any], ...] = (
    {"scalar": "float"},
    {"scalar": "float", "contracted": True},
    {"scalar": "fast", "kind": 0},
    {"scalar": "fast", "kind": 1, "contracted": True},
    {"scalar": "fast", "kind": 2},
)


def cell_about(box: ParameterBox, values: np.ndarray, width: float) -> ParameterBox:
    """The part of ``box`` within ``width`` of its own half-widths of ``values``."""
    half = width * 0.5 * (np.asarray(box.upper) - np.asarray(box.lower))
    lower = np.maximum(np.asarray(box.lower), values - half)
    upper = np.minimum(np.asarray(box.upper), values + half)
    return replace(box, lower=tuple(map(float, lower)), upper=tuple(map(float, upper)))


def attack(
    scene: SplatScene, poses: PoseBox, cells: list[ParameterBox], renders: int, version: str, rules: Rasteriser,
    seed: int, layers: bool,
) -> dict[str, Any]:  # fmt: skip
    """Bound each cell and compare ``renders`` renders with it; the numbers of a row."""
    bounds = SplatBounds(activate(scene, rules), rules, FLOAT32)
    rng = np.random.default_rng(seed)
    builds = [{**build, "noise": (0, build.get("kind", 0))} for build in BUILDS]
    for build in builds:
        build.pop("kind", None)
    programs = [Kernels(scene, version, **build) for build in builds]
    compared = violations = 0
    worst, gaps, spreads = 0.0, [], []
    for cell in cells:
        found, lower, upper = bounded_both_ways(bounds, poses, cell, layers)
        gaps.append(float(np.linalg.norm(upper.astype(np.float64) - lower, axis=-1).mean()))
        corners = np.asarray(cell.corners())
        picked = corners[rng.permutation(len(corners))[: max(1, renders // 2)]]
        values = [cell.middle, *picked, *cell.sample(max(0, renders - 1 - len(picked)), rng)][:renders]
        least, most = np.float32(np.inf), np.float32(-np.inf)
        for k, point in enumerate(values):
            program = programs[k % len(programs)]
            program.noise = (int(rng.integers(2**62)), program.noise[1])
            image = program.image(poses.camera, poses.pose(np.asarray(point)))
            # a NaN is outside
            violations += int((~((lower <= image) & (image <= upper))).sum())
            beyond = np.maximum(lower - image, image - upper)
            worst = max(worst, float(np.nan_to_num(beyond, nan=np.inf).max()))
            compared += image.size
            least, most = np.minimum(least, image), np.maximum(most, image)
            if found.layers is not None:
                # depth where anything is drawn
                values_there = program.layers(poses.camera, poses.pose(np.asarray(point))).astype(np.float64)
                of_layers = assemble(found.layers, poses.camera)
                drawn = np.stack([np.ones(values_there.shape[:2], bool), values_there[..., 0] > 0.0], axis=-1)
                inside = (of_layers[..., ::2] <= values_there) & (values_there <= of_layers[..., 1::2])
                violations += int((drawn & ~inside).sum())
                compared += int(drawn.sum())
        spreads.append(float(np.linalg.norm(most - np.asarray(least, np.float64), axis=-1).mean()))
    return {
        "cells": len(cells), "renders": renders * len(cells), "comparisons": compared, "violations": violations,
        "worst": worst, "gap": float(np.mean(gaps)), "spread": float(np.mean(spreads)),
    }  # fmt: skip


def main() -> int:
    """Run the comparison; 1 if something lies outside."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("load_config", type=Path, nargs="*")
    parser.add_argument("--stiff", action="store_true", help="the stiff cases, too")
    parser.add_argument("--gsplat-version", default="1.4.0", choices=VERSIONS)
    parser.add_argument("--sets", nargs="+", default=["x", "yaw", "six"])
    parser.add_argument("--modes", nargs="+", default=["classic", "antialiased"])
    parser.add_argument("--widths", nargs="+", type=float, default=[0.0, 1e-3, 0.1])
    parser.add_argument("--cells", type=int, default=2, help="by run, mode, set and width")
    parser.add_argument("--renders", type=int, default=10, help="by cell")
    parser.add_argument("--frame", type=int, default=0)
    parser.add_argument("--downscale-factor", type=float, default=1.0)
    parser.add_argument("--layers", action="store_true", help="compare accumulation and expected depth, too")
    parser.add_argument("--planted", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output-dir", type=Path, default=Path("bench"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    rules = VERSIONS[options.gsplat_version]
    if options.planted:
        rules = replace(rules, alpha_max=0.98)
    rows: list[dict[str, Any]] = []

    def add(scene: SplatScene, poses: PoseBox, name: str, width: float, cells: list[ParameterBox]) -> None:
        began = time.perf_counter()
        found = attack(
            scene, poses, cells, options.renders, options.gsplat_version, rules, options.seed + len(rows),
            options.layers,
        )  # fmt: skip
        size = f"{poses.camera.width}x{poses.camera.height}"
        head = {"scene": scene.name, "mode": scene.rasterize_mode, "set": name, "width": width, "size": size}
        rows.append({**head, **found, "s": time.perf_counter() - began})
        print(markdown(rows[-1:]).splitlines()[-1], flush=True)

    try:
        for job in open_jobs(tuple(options.load_config), None, options.downscale_factor) if options.load_config else ():
            for mode in options.modes:
                scene = replace(splat_of(job).scene, rasterize_mode=mode)
                for name in options.sets:
                    poses = pose_set(job, name, options.frame)
                    around = poses.box.sample(options.cells, np.random.default_rng(options.seed))
                    for width in options.widths:
                        add(scene, poses, name, width, [cell_about(poses.box, values, width) for values in around])
        for case in all_cases() if options.stiff else ():
            poses = case.pose_set()
            middle = poses.box.middle
            for width in options.widths:
                add(
                    replace(case.scene, name=case.name), poses, "its own", width, [cell_about(poses.box, middle, width)]
                )
    except Unavailable as reason:
        print(f"error: {reason}; nothing was compared", file=sys.stderr)
        return 2
    total, outside = sum(row["comparisons"] for row in rows), sum(row["violations"] for row in rows)
    write(rows, options.output_dir, "kernels", "gsplat's kernels on a CPU against the float32 bounds")
    print(f"{total:,} comparisons, {outside:,} outside")
    return int(not outside if options.planted else bool(outside))


if __name__ == "__main__":
    sys.exit(main())
