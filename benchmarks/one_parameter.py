"""What forms of order 2 in one parameter gain over the general ones of order 1: time and gap of the same cells.

    python benchmarks/one_parameter.py RUN/config.yml [...] [--sets x yaw] [--repeats N]

prints a table in Markdown: processor seconds of a cell with either family, taken in turn, medians of their ratios, and
the mean gap between the bounds, for cells 1/32 and 1/128 as wide as the set.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

from ns_abstract.bench.scale import small_cell
from ns_abstract.bench.sets import open_jobs, pose_set, splat_of
from ns_abstract.methods.splat.frame import SplatFrame

HEADER = "| scene | set | cell | order 2 ms | time, order 2 / 1 | gap, order 1 | gap, order 2 | gap, order 2 / 1 |"


def rows(config: Path, sets: list[str], repeats: int, downscale: float) -> list[str]:
    """Rows of the table for one run."""
    (job,) = open_jobs((config,), None, downscale)
    splat, found = splat_of(job), []
    for name in sets:
        poses = pose_set(job, name, 0)
        views = [SplatFrame(splat.splats, splat.rasteriser, splat.arithmetic, poses, order=k) for k in (2, 1)]
        tiles = np.arange(views[0].tile_count)
        for part in (1.0 / 32.0, 1.0 / 128.0):
            cell = small_cell(poses, part)
            gaps = []
            for view in views:
                bounds = view.bound(cell, tiles)
                gaps.append(float((bounds.upper - bounds.lower).mean()))
            seconds = np.empty((repeats, 2))
            for r in range(repeats):
                for k, view in enumerate(views):
                    start = time.process_time()
                    view.bound(cell, tiles)
                    seconds[r, k] = time.process_time() - start
            ratio = float(np.median(seconds[:, 0] / seconds[:, 1]))
            found.append(
                f"| {job.method.name} | {name} | 1/{1.0 / part:.0f} | {1e3 * np.median(seconds[:, 0]):.1f} "
                f"| {ratio:.2f} | {gaps[1]:.5f} | {gaps[0]:.5f} | {gaps[0] / gaps[1]:.3f} |"
            )
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, help="config.yml of splats")
    parser.add_argument("--sets", nargs="+", default=["x", "yaw"], help="sets of one parameter")
    parser.add_argument("--repeats", type=int, default=11)
    parser.add_argument("--downscale-factor", type=float, default=2.0)
    options = parser.parse_args()
    print(HEADER)
    print("|---" * 8 + "|")
    for config in options.runs:
        print("\n".join(rows(config, options.sets, options.repeats, options.downscale_factor)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
