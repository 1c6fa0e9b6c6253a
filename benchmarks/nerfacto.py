"""Ratio of the bounds' mean gap to the renders' against time, of a nerfacto run, and what each step of a bound loses.

    python benchmarks/nerfacto.py CONFIG [--size 16] [--ratio 1.1] [--seconds 60] [--workers 2] [--losses]

The camera looks at the origin of the normalised frame. Kernels are compiled before the clock starts.
``--losses``: of random rays over one narrow set, in equal pieces, with the rest of one step at a time left out. That is
a diagnosis and no bound. Every step left out compiles the kernels anew, for minutes, into a folder of its own.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit

from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.keyframe_cameras import look_at
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.methods.load import load_any
from ns_abstract.methods.nerf.hash_bounds import composition, light, network, pieces
from ns_abstract.methods.nerf.hash_bounds.bounds import HashBounds, NerfactoFrame
from ns_abstract.perturbation.specification import parse_perturbation
from ns_abstract.refine.engine import Refinement, RefinementGoal

SETS = {
    "yaw 0.0001": {"rotation": {"yaw": 1e-4}},
    "yaw 0.001": {"rotation": {"yaw": 1e-3}},
    "yaw 0.01": {"rotation": {"yaw": 1e-2}},
    "yaw and x 0.0001": {"rotation": {"yaw": 1e-4}, "translation": {"x": 1e-4}},
}
#: Ratios whose times are printed.
MARKS = (3.0, 2.0, 1.5, 1.2, 1.1, 1.05)
#: Folders of kernels that are no bounds.
_OWN = "losses-"
#: Rays, renders, and equal pieces of the table of losses, and its set.
RAYS, RENDERS, PIECES, LOSS_SET = 24, 65, (8, 16, 64), "yaw 0.001"


def camera_of(size: int) -> PinholeCamera:
    """The view of all tables."""
    pose = look_at((1.3, -1.0, 0.8), (0.0, 0.0, 0.1))[:3]
    return PinholeCamera(pose, 1.4 * size, 1.4 * size, 0.5 * size, 0.5 * size, size, size)


def frame_of(scene: Any, size: int, name: str, workers: int) -> NerfactoFrame:
    """The frame of one of `SETS`."""
    return NerfactoFrame(scene, PoseBox.around(camera_of(size), parse_perturbation(SETS[name])), workers)


# ---------------------------------------------------------------- losses


def _band(band: Callable[..., Any]) -> Callable[..., Any]:
    @njit
    def without(center, low, high):
        value, slope, curvature, rest = band(center, low, high)
        return value, slope, curvature, 0.0 if rest < np.inf else rest

    return without


def leave_out(step: str) -> None:
    """Replace what makes the rest of a step, before anything is compiled."""
    # kernels without rests are no bounds, and must not be kept where others find them
    assert Path(os.environ["NS_ABSTRACT_CACHE_DIR"]).name.startswith(_OWN)
    point, features, relu, follow, products = (
        pieces.point, pieces.level_features, network.relu, pieces.follow, composition._products,
    )  # fmt: skip

    @njit
    def exact_point(ray, distance, line, out, work):
        inside = point(ray, distance, line, out, work)
        out[:, -1] = 0.0
        return inside

    @njit
    def exact_features(table, resolution, place, ranges, out, room):
        features(table, resolution, place, ranges, out, room)
        out[:, -1] = 0.0

    @njit
    def exact_relu(z, count, n, live):
        rows, alive = relu(z, count, n, live)
        z.rows[count:rows] = 0.0
        return rows, alive

    @njit
    def exact_places(light, count, edges, wanted, line, out, work):
        known = follow(light, count, edges, wanted, line, out, work)
        out.place[:, -2] = 0.0
        return known

    @njit
    def exact_products(light, count, i, whole, color, line):
        shift, bend, _ = products(light, count, i, whole, color, line)
        return shift, bend, 0.0

    modules: dict[str, tuple[Any, str, Any]] = {
        "points": (pieces, "point", exact_point),
        "features": (pieces, "level_features", exact_features),
        "ReLUs": (network, "relu", exact_relu),
        "exponentials of densities": (pieces, "exp_band", _band(pieces.exp_band)),
        "exponentials of depths": (light, "exp_band", _band(light.exp_band)),
        "places of samples": (pieces, "follow", exact_places),
        "sigmoids": (pieces, "sigmoid_band", _band(pieces.sigmoid_band)),
        "products in compositing": (composition, "_products", exact_products),
    }
    setattr(*modules[step])


STEPS = (
    "points", "features", "ReLUs", "exponentials of densities", "exponentials of depths", "places of samples",
    "sigmoids", "products in compositing",
)  # fmt: skip


def ratios_of_pieces(scene: Any, size: int) -> list[float]:
    """The ratio of random rays for every number of `PIECES`."""
    frame = frame_of(scene, size, LOSS_SET, 1)
    rng = np.random.default_rng(0)
    tiles = np.sort(rng.permutation(size * size)[:RAYS])
    low, high = frame.box.lower[0], frame.box.upper[0]
    shown = np.stack([frame.precise(np.array([v]))[tiles] for v in np.linspace(low, high, RENDERS)])
    inner = float((shown.max(axis=0) - shown.min(axis=0)).mean())
    bounds, found = HashBounds(scene.field, 1), []
    pixels = np.stack([tiles // size, tiles % size], axis=1)
    for count in PIECES:
        cells = np.full((RAYS, 1), count, np.int64)
        bounds._first_cells = lambda *_, cells=cells: cells  # type: ignore[method-assign]
        # pieces that may lose anything are not halved
        aim = np.zeros((RAYS, 3)), np.ones((RAYS, 3))
        result = bounds.rays(frame.pose_set, frame.box, pixels, 1e-4, aim=aim)
        found.append(float((result.upper - result.lower).mean()) / inner)
    return found


def print_losses(arguments: list[str]) -> None:
    """Print one row for each step, from a process of its own."""
    print("| left out | " + " | ".join(f"{n} pieces" for n in PIECES) + " |\n|---|" + "---|" * len(PIECES), flush=True)
    for step in ("", *STEPS):
        with tempfile.TemporaryDirectory(prefix=_OWN) as folder:
            keys = {**os.environ, "NS_ABSTRACT_CACHE_DIR": folder}
            command = [sys.executable, __file__, *arguments, "--without", step]
            subprocess.run(command, env=keys if step else None, check=True)


def main() -> None:
    """Print one row for each set, or for each step."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config")
    parser.add_argument("--size", type=int, default=16)
    parser.add_argument("--ratio", type=float, default=1.05)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--sets", nargs="+", choices=list(SETS), default=list(SETS))
    parser.add_argument("--losses", action="store_true")
    parser.add_argument("--without", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.losses:
        print_losses([options.config, "--size", str(options.size)])
        return
    scene, n = load_any(options.config), options.size
    if options.without is not None:
        if options.without:
            leave_out(options.without)
        row = " | ".join(f"{ratio:.3f}" for ratio in ratios_of_pieces(scene, n))
        print(f"| {options.without or 'nothing'} | {row} |", flush=True)
        return
    print(f"{scene.field.text}, {n}x{n}\n")
    print("| set | renders' gap | ratio | s | CPU s | " + " | ".join(f"s to {m:g}" for m in MARKS) + " |")
    print("|---|" + "---|" * (4 + len(MARKS)), flush=True)
    for name in options.sets:
        frame = frame_of(scene, n, name, options.workers)
        frame.warm_up()
        wall, cpu = time.perf_counter(), time.process_time()
        goal = RefinementGoal(ratio=options.ratio, seconds=options.seconds)
        found = Refinement(frame, 0, goal, seed=0).run()
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        gap, inner = (found.upper - found.lower).mean(), (found.witness_upper - found.witness_lower).mean()
        times = [next((p.seconds for p in found.trace if p.mpg <= m * p.mpg_witness), None) for m in MARKS]
        row = " | ".join("-" if t is None else f"{t:.1f}" for t in times)
        print(f"| {name} | {inner:.5f} | {gap / inner:.3f} | {wall:.1f} | {cpu:.1f} | {row} |", flush=True)


if __name__ == "__main__":
    main()
