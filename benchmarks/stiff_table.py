"""Bound and attack the tests' tiny scenes at the ends of what can be loaded and asked; a table of all of them.

    python benchmarks/stiff_table.py [--compare] [--cases needles ...] [--output-dir bench]

The exit code is 1 if a bound was broken or a number was not finite.
"""

from __future__ import annotations

import faulthandler
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from stiff import compare, run_case
from stiff_cases import all_cases

from ns_abstract.bench.tables import Table, markdown, write
from ns_abstract.io.errors import InputError

#: Seconds after which a case that does not end ends the process, with a trace of where it stands.
STUCK = 900.0


@dataclass
class StiffTable:
    """Which cases, and how long each."""

    output_dir: Path = Path("bench")
    """Folder for the tables."""
    cases: tuple[str, ...] = ()
    """Parts of the names of the cases to run. Default: all cases."""
    arithmetics: tuple[Literal["float32", "real"], ...] = ("float32", "real")
    """What is bounded: float32, real."""
    cells: int = 16
    """Most cells bounded for every case."""
    seconds: float = 20.0
    """Limit of the refinement and of every attack."""
    poses: int = 60
    """Images by the compiled renderer for every case."""
    reference_poses: int = 16
    """Images by each reference."""
    seed: int = 0
    """Decides every random choice."""
    compare: bool = False
    """Also write what float32 costs against real arithmetic."""


def measure(options: StiffTable) -> int:
    cases = [c for c in all_cases() if not options.cases or any(part in c.name for part in options.cases)]
    if not cases:
        raise InputError(f"no case has {' or '.join(options.cases)} in its name", field="--cases")
    # a case that never ends must not take the others' rows with it
    table, failed = Table(options.output_dir, "stiff", "Stiff and extreme cases"), 0
    for case in cases:
        for kind in options.arithmetics:
            faulthandler.dump_traceback_later(STUCK, exit=True, file=2)
            try:
                outcome = run_case(
                    case, kind, cells=options.cells, seconds=options.seconds, poses=options.poses,
                    reference_poses=options.reference_poses, seed=options.seed,
                )  # fmt: skip
            finally:
                faulthandler.cancel_dump_traceback_later()
            table.add(outcome.row)
            failed += outcome.failed
            for violation in outcome.worst[:1]:
                print(f"  {violation}", flush=True)
    if options.compare and (differences := compare(table.rows)):
        write(differences, options.output_dir, "stiff-compare", "Float32 against real arithmetic")
        print(markdown(differences))
    total = sum(row["comparisons"] for row in table.rows)
    violations = sum(row["violations"] for row in table.rows)
    print(f"{len(table.rows)} runs, {failed} failed: {total:,} comparisons, {violations:,} violations")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(measure(tyro.cli(StiffTable)))
