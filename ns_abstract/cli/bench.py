"""``ns-abstract-bench``: cost, tightness and soundness, measured."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from ns_abstract.cli.common import DONE, run


@dataclass
class Cell:
    """What one bounded cell costs in units of the concrete render of the same view."""

    load_config: tuple[Path, ...] = ()
    """Runs (config.yml or .ply). Default: the demo scene."""
    camera_path_filename: Path | None = None
    """Default: camera_path.json in the folder that holds the method's folder."""
    output_dir: Path = Path("bench")
    """Folder for the tables."""
    sets: tuple[str, ...] = ("x",)
    """Sets of poses: x, yaw, roll, six, segments, orbit, point."""
    frame: int = 0
    """Entry of the camera path."""
    downscale_factor: float = 1.0
    """Images become this many times smaller."""
    repeats: int = 15
    """Times that everything is measured."""


@dataclass
class Tightness:
    """Error against run time: ratio of outer to inner gap, with curves."""

    load_config: tuple[Path, ...] = ()
    """Runs (config.yml or .ply). Default: the demo scene."""
    camera_path_filename: Path | None = None
    """Default: camera_path.json in the folder that holds the method's folder."""
    output_dir: Path = Path("bench")
    """Folder for tables, traces and curves."""
    sets: tuple[str, ...] = ("x", "yaw")
    """Sets of poses: x, yaw, roll, six, segments, orbit, point."""
    frame: int = 0
    """Entry of the camera path."""
    downscale_factor: float = 1.0
    """Images become this many times smaller."""
    seconds: float = 60.0
    """Time for every scene and set."""
    target_ratio: float = 1.01
    """Where a set is tight enough."""
    scale: float = 1.0
    """Multiplies the ranges of translations and rotations."""


@dataclass
class Soundness:
    """Attack abstract images by random poses, corners, gradient ascent and threshold jumps."""

    load_config: tuple[Path, ...] = ()
    """Runs (config.yml or .ply). Default: the demo scene."""
    camera_path_filename: Path | None = None
    """Default: camera_path.json in the folder that holds the method's folder."""
    output_dir: Path = Path("bench")
    """Folder for the tables."""
    sets: tuple[str, ...] = ("x", "yaw", "roll", "six", "segments", "orbit")
    """Sets of poses: x, yaw, roll, six, segments, orbit, point."""
    frame: int = 0
    """Entry of the camera path."""
    downscale_factor: float = 1.0
    """Images become this many times smaller."""
    seconds: float = 10.0
    """Time for bounding every scene and set."""
    poses: int = 200
    """Images by the compiled renderer for every scene and set."""
    reference_poses: int = 20
    """Images by the independent reference."""
    scale: float = 1.0
    """Multiplies the ranges of translations and rotations."""
    seed: int = 0
    """Decides every random choice."""


def bench(options: Cell | Tightness | Soundness) -> int:
    """Run one benchmark; the exit code of a soundness benchmark with violations is 1."""
    from ns_abstract.bench.sets import open_jobs
    from ns_abstract.bench.tables import markdown, write

    jobs = open_jobs(options.load_config, options.camera_path_filename, options.downscale_factor)
    rows: list[dict[str, object]] = []
    results = {}
    for job in jobs:
        for name in options.sets:
            if isinstance(options, Cell):
                from ns_abstract.bench.cell import cell_cost

                rows.append(cell_cost(job, name, options.frame, options.repeats))
            elif isinstance(options, Tightness):
                from ns_abstract.bench.tightness import refine, summary

                result = refine(job, name, options.frame, options.seconds, options.target_ratio, options.scale)
                results[f"{job.scene.name} {name}"] = result
                rows.append(summary(job, name, result))
            else:
                from ns_abstract.bench.soundness import attack

                rows.append(
                    attack(
                        job,
                        name,
                        options.frame,
                        options.seconds,
                        options.poses,
                        options.reference_poses,
                        options.seed,
                        options.scale,
                    )
                )
            print(markdown(rows[-1:]) if len(rows) == 1 else markdown(rows[-1:]).splitlines()[2], flush=True)
    kind = type(options).__name__.lower()
    write(
        rows,
        options.output_dir,
        kind,
        {"cell": "Cost of a cell", "tightness": "Error against run time"}.get(kind, "Soundness"),
    )
    if results:
        from ns_abstract.bench.plots import save_curves

        save_curves(options.output_dir / "tightness.png", results)
    violations = sum(int(str(row.get("violations", 0))) for row in rows)
    if isinstance(options, Soundness):
        total = sum(int(str(row["comparisons"])) for row in rows)
        print(f"{total:,} comparisons, {violations} violations")
    return 1 if violations else DONE


def main() -> None:
    """Entry point of the console script."""
    kinds = tyro.extras.subcommand_type_from_defaults(
        {"cell": Cell(), "tightness": Tightness(), "soundness": Soundness()}
    )
    run(bench, lambda: tyro.cli(kinds, prog="ns-abstract-bench"))


if __name__ == "__main__":
    main()
