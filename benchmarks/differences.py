"""How tight bounds of differences of two scenes are: compressed and pruned versions of runs against themselves.

    python benchmarks/differences.py RUNS [--seconds 300] [--until 1.1] [--arithmetic float32] [--only quantised/x ...]

prints a table in Markdown, a row a pair of scenes and a set of poses: largest and mean difference, bound and rendered,
and whether the largest bound is at most 1.3 times what was rendered, or 0.01 above it. RUNS holds the folders of two
runs of Nerfstudio, playbot_lod3 and plant. `--variants FOLDER` alone writes the versions as runs of their own.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import ns_abstract as nsa
from ns_abstract.methods.splat.load import load_scene
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.methods.splat.write import write_splatfacto_run

#: Columns of the table.
COLUMNS = (
    "pair", "set", "largest, bound", "largest, rendered", "ratio", "mean, bound", "mean, rendered", "seconds",
    "processor s", "cells", "reached",
)  # fmt: skip
#: Ratio, or difference, of the largest bound to the largest rendered difference that is asked for.
RATIO, ROOM = 1.3, 0.01


def rounded(values: np.ndarray) -> np.ndarray:
    """``values`` [N, ...] with 8 bits between the least and the greatest of each column."""
    low, high = values.min(axis=0), values.max(axis=0)
    step = np.where(high > low, (high - low) / 255.0, 1.0)
    return (low + np.round((values - low) / step) * step).astype(np.float32)


def quantised(scene: SplatScene) -> SplatScene:
    """Colours, rotations and scales with 8 bits."""
    quats = scene.quats / np.linalg.norm(scene.quats, axis=1, keepdims=True)
    return replace(scene, sh=rounded(scene.sh), quats=rounded(quats), log_scales=rounded(scene.log_scales))


def kept(scene: SplatScene, score: np.ndarray, part: float) -> SplatScene:
    """The Gaussians but for that part which scores least."""
    which = np.sort(np.argsort(score, kind="stable")[int(part * scene.count) :])
    names = ("means", "log_scales", "quats", "opacity_logits", "sh")
    return replace(scene, **{name: getattr(scene, name)[which] for name in names}, stored=None)


def without_faintest(scene: SplatScene) -> SplatScene:
    """Without the tenth of least opacity."""
    return kept(scene, scene.opacity_logits, 0.1)


def pruned(scene: SplatScene) -> SplatScene:
    """The half of largest opacity times area."""
    area = np.exp(scene.log_scales.astype(np.float64)).prod(axis=1) ** (2.0 / 3.0)
    return kept(scene, area / (1.0 + np.exp(-scene.opacity_logits.astype(np.float64))), 0.5)


PAIRS: dict[str, tuple[str, Callable[[SplatScene], SplatScene]]] = {
    "quantised": ("playbot_lod3", quantised),
    "without the faintest tenth": ("playbot_lod3", without_faintest),
    "pruned half": ("plant", pruned),
}


def sets(scene: SplatScene) -> dict[str, dict[str, Any]]:
    """Keywords of `ns_abstract.PoseSet` by name."""
    target = np.median(scene.means, axis=0).tolist()
    orbit = {"target": target, "axis": [0.0, 0.0, 1.0], "azimuth": [-0.1, 0.1]}
    return {"x": {"translation": {"x": 0.03}}, "orbit": {"orbit": orbit}}


def config(runs: Path, name: str) -> Path:
    return next((runs / name / "splatfacto").glob("*/config.yml"))


def row(name: str, kind: str, change: nsa.Comparison, processor: float) -> str:
    ratio = change.largest_upper / change.largest_lower if change.largest_lower > 0.0 else float("inf")
    reached = change.largest_upper <= max(RATIO * change.largest_lower, change.largest_lower + ROOM)
    return (
        f"| {name} | {kind} | {change.largest_upper:.4f} | {change.largest_lower:.4f} | {ratio:.3f} "
        f"| {change.mean_upper:.5f} | {change.mean_lower:.5f} | {change.seconds:.0f} | {processor:.0f} "
        f"| {change.cell_count} | {'yes' if reached else 'no'} |"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--seconds", type=float, default=300.0, help="budget of each row")
    parser.add_argument("--until", type=float, default=1.0, help="end a row at this ratio of its largest bound")
    parser.add_argument("--arithmetic", choices=("float32", "real"))
    parser.add_argument("--downscale-factor", type=float, default=1.0)
    parser.add_argument("--only", nargs="+", help="rows such as quantised/x")
    parser.add_argument("--variants", type=Path, help="write the versions there, and measure nothing")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.variants or Path(scratch)
        print(f"| {' | '.join(COLUMNS)} |")
        print("|---" * len(COLUMNS) + "|", flush=True)
        for name, (run, change) in PAIRS.items():
            file = config(options.runs, run)
            stored = load_scene(file)
            changed = write_splatfacto_run(
                change(stored), folder, timestamp="2026-01-01_120000", experiment_name=name.replace(" ", "_")
            )
            if options.variants:
                continue
            first, second = nsa.load_scene(file), nsa.load_scene(changed)
            path = nsa.load_camera_path(options.runs / run / "camera_path.json")
            given = path.cameras[0]
            size = [round(side / options.downscale_factor) for side in (given.height, given.width)]
            camera = given.resized(*size)
            for kind, keywords in sets(stored).items():
                if options.only and f"{name}/{kind}" not in options.only:
                    continue
                poses = nsa.PoseSet(camera, **keywords)
                begun = time.process_time()
                found = nsa.compare(
                    first, second, poses, time_budget=options.seconds, arithmetic=options.arithmetic,
                    on_progress=lambda now: now.covered < 1.0 or now.mpg > options.until * now.mpg_witness,
                )  # fmt: skip
                print(row(name, kind, found, time.process_time() - begun), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
