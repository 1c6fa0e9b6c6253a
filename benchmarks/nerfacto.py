"""Ratio of the bounds' mean gap to the renders' against time, of a nerfacto run over sets of one and two parameters.

    python benchmarks/nerfacto.py CONFIG [--size 16] [--ratio 1.1] [--seconds 60] [--workers 2]

The camera looks at the origin of the normalised frame. Kernels are compiled before the clock starts.
"""

from __future__ import annotations

import argparse
import time

from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.keyframe_cameras import look_at
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.methods.load import load_any
from ns_abstract.methods.nerf.hash_bounds.frame import NerfactoFrame
from ns_abstract.perturbation.specification import parse_perturbation
from ns_abstract.refine.engine import Refinement, RefinementGoal

SETS = {
    "yaw 0.0001": {"rotation": {"yaw": 1e-4}},
    "yaw 0.001": {"rotation": {"yaw": 1e-3}},
    "yaw 0.01": {"rotation": {"yaw": 1e-2}},
    "yaw and x 0.0001": {"rotation": {"yaw": 1e-4}, "translation": {"x": 1e-4}},
}


def main() -> None:
    """Print one row for each set."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config")
    parser.add_argument("--size", type=int, default=16)
    parser.add_argument("--ratio", type=float, default=1.1)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--sets", nargs="+", choices=list(SETS), default=list(SETS))
    options = parser.parse_args()
    scene, n = load_any(options.config), options.size
    pose = look_at((1.3, -1.0, 0.8), (0.0, 0.0, 0.1))[:3]
    camera = PinholeCamera(pose, 1.4 * n, 1.4 * n, 0.5 * n, 0.5 * n, n, n)
    print(f"{scene.field.text}, {n}x{n}")
    for name in options.sets:
        frame = NerfactoFrame(scene, PoseBox.around(camera, parse_perturbation(SETS[name])), options.workers)
        frame.warm_up()
        wall, cpu = time.perf_counter(), time.process_time()
        goal = RefinementGoal(ratio=options.ratio, seconds=options.seconds)
        found = Refinement(frame, 0, goal, seed=0).run()
        gap, inner = (found.upper - found.lower).mean(), (found.witness_upper - found.witness_lower).mean()
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        print(
            f"{name:20s} ratio {gap / inner:.3f} in {wall:.1f} s, {cpu:.1f} CPU s; renders' gap {inner:.5f}", flush=True
        )


if __name__ == "__main__":
    main()
