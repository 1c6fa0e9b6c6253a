"""What scripts that measure runs share: their options, and the runs."""

from __future__ import annotations

import argparse
from pathlib import Path

from ns_abstract.api.files import PathJob
from ns_abstract.bench.sets import open_jobs
from ns_abstract.methods.program_options import ProgramOptions


def run_parser(about: str | None, *sets: str) -> argparse.ArgumentParser:
    """A parser of the runs, the camera path, an entry of it, and by default these ``sets`` of poses."""
    parser = argparse.ArgumentParser(description=(about or "").splitlines()[0])
    parser.add_argument("load_config", type=Path, nargs="*", help="runs, or scene files; the demo scene by default")
    parser.add_argument("--camera-path-filename", type=Path)
    parser.add_argument("--output-dir", type=Path, default=Path("bench"))
    parser.add_argument("--frame", type=int, default=0, help="entry of the camera path")
    parser.add_argument("--downscale-factor", type=float, default=1.0)
    parser.add_argument("--sets", nargs="+", default=list(sets))
    parser.add_argument("--seed", type=int, default=0)
    return parser


def runs(options: argparse.Namespace, program: ProgramOptions | None = None) -> list[PathJob]:
    """The runs of a command line, opened."""
    path, factor = options.camera_path_filename, options.downscale_factor
    return open_jobs(tuple(options.load_config), path, factor, program=program)
