"""Mutation check of the soundness tests: each planted fault must be caught by the test named beside it.

Every mutant is one change of one file of a copy of the package, and one test that has to fail on it. The folder
`planted` lists them: a function, and an expression or statement that stands in it once.
The compiled kernels run interpreted (NUMBA_DISABLE_JIT=1), so that nothing is compiled per mutant; ``--compiled``
compiles instead, into a cache of each mutant's own. Each test is also run once on the unchanged copy, where it
has to pass.

    python benchmarks/mutants.py [--only NAME ...] [--compiled] [--list] [--outcomes FILE [--seconds N]]

writes benchmarks/mutants.md and exits with 1 if not all are killed. With ``--outcomes`` what is known of a mutant is
kept in FILE, so that the list can be gone through in pieces; what survived is run again.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from planted import FAULTS, Fault, apply

ROOT = Path(__file__).resolve().parents[1]
REPORT = Path(__file__).with_suffix(".md")
_TIMEOUT_S = 600.0
# pytest's exit codes
_PASSED, _FAILED = 0, 1
_LATE = -1


@dataclass
class Outcome:
    """What became of one mutant: how it ended and how long its test took, seconds."""

    mutant: Fault
    verdict: str
    seconds: float


def copy_package(folder: Path) -> None:
    """The package, its tests and the scripts that these use, so that the tests import the copy."""
    skip = shutil.ignore_patterns("__pycache__", "*.nbi", "*.nbc")
    (folder / "benchmarks").mkdir()
    for script in (ROOT / "benchmarks").glob("*.py"):
        shutil.copy(script, folder / "benchmarks")
    shutil.copytree(ROOT / "ns_abstract", folder / "ns_abstract", ignore=skip)
    shutil.copytree(ROOT / "tests", folder / "tests", ignore=skip)


def mutate(folder: Path, mutant: Fault) -> str:
    """Apply the change to the copy; returns the original text.

    Raises:
        ValueError: ``old`` does not stand in its place exactly once.
    """
    path = folder / "ns_abstract" / mutant.file
    text = path.read_text()
    path.write_text(apply(text, mutant))
    return text


def run_test(folder: Path, test: str, compiled: bool) -> tuple[int, str, float]:
    """pytest's exit code, its output and the seconds it took, on the copy in ``folder``."""
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {
            "PYTHONPATH": str(folder),
            "PYTHONDONTWRITEBYTECODE": "1",
            "NS_ABSTRACT_CACHE_DIR": cache,
            "NUMBA_DISABLE_JIT": "0" if compiled else "1",
            "NUMBA_NUM_THREADS": "1",
        }
        command = [
            sys.executable, "-W", "ignore", "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider",
            "--hypothesis-seed=1", f"tests/{test}",
        ]  # fmt: skip
        start = time.perf_counter()
        try:
            done = subprocess.run(
                command, cwd=folder, env=environment, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False
            )
        except subprocess.TimeoutExpired:
            return _LATE, "", _TIMEOUT_S
        return done.returncode, done.stdout + done.stderr, time.perf_counter() - start


def read_outcomes(path: Path | None) -> dict[Fault, Outcome]:
    """Outcomes that an earlier run left, of mutants that were killed."""
    lines = path.read_text().splitlines() if path is not None and path.exists() else []
    found = [json.loads(line) for line in lines]
    outcomes = [Outcome(Fault(**line["fault"]), line["verdict"], line["seconds"]) for line in found]
    return {outcome.mutant: outcome for outcome in outcomes if outcome.verdict == "killed"}


def table(outcomes: list[Outcome]) -> str:
    """The outcomes as a Markdown table."""
    rows = ["| mutant | file | killed by | seconds |", "| --- | --- | --- | --- |"]
    for outcome in outcomes:
        m = outcome.mutant
        killer = f"`{m.test}`" if outcome.verdict == "killed" else f"**{outcome.verdict}** (`{m.test}`)"
        rows.append(f"| {m.name} | {m.file} | {killer} | {outcome.seconds:.1f} |")
    return "\n".join(rows)


def main() -> int:
    """Run the mutants one after the other."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[], help="run the mutants whose names contain one of these")
    parser.add_argument("--compiled", action="store_true", help="compile the kernels, into a private cache")
    parser.add_argument("--list", action="store_true", help="check that every change applies, and stop")
    parser.add_argument("--outcomes", type=Path, help="keep outcomes in this file, and go on from what it holds")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin with no mutant after so many")
    options = parser.parse_args()
    begun = time.perf_counter()
    chosen = [m for m in FAULTS if not options.only or any(part in m.name for part in options.only)]
    known = read_outcomes(options.outcomes)
    outcomes: list[Outcome] = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        copy_package(folder)
        for mutant in chosen:
            original = mutate(folder, mutant)
            (folder / "ns_abstract" / mutant.file).write_text(original)
        if options.list:
            print(f"{len(chosen)} mutants apply")
            return 0
        # what killed a mutant passed without it
        healthy = {outcome.mutant.test: True for outcome in known.values()}
        for mutant in chosen:
            if mutant in known:
                outcomes.append(known[mutant])
                continue
            if time.perf_counter() - begun > options.seconds:
                continue
            compiled = options.compiled or mutant.compiled
            if mutant.test not in healthy:
                code, output, _ = run_test(folder, mutant.test, compiled)
                healthy[mutant.test] = code == _PASSED
                if code != _PASSED:
                    print(output[-2000:])
            verdict, seconds = "its test fails without it", 0.0
            if healthy[mutant.test]:
                original = mutate(folder, mutant)
                code, output, seconds = run_test(folder, mutant.test, compiled)
                (folder / "ns_abstract" / mutant.file).write_text(original)
                # an assertion that fails, not a crash
                asserted = code == _FAILED and ("AssertionError" in output or "DID NOT RAISE" in output)
                verdicts = {_PASSED: "survived", _FAILED: "killed" if asserted else "crashed", _LATE: "timed out"}
                verdict = verdicts.get(code, f"pytest {code}")
            outcomes.append(Outcome(mutant, verdict, seconds))
            print(f"{verdict:10s} {seconds:6.1f} s  {mutant.name}", flush=True)
            if options.outcomes:
                with options.outcomes.open("a") as file:
                    file.write(json.dumps({"verdict": verdict, "seconds": seconds, "fault": asdict(mutant)}) + "\n")
    killed = sum(outcome.verdict == "killed" for outcome in outcomes)
    summary = f"{killed} of {len(chosen)} mutants killed, {sum(o.seconds for o in outcomes):.0f} s."
    if len(outcomes) < len(chosen):
        summary += f" {len(chosen) - len(outcomes)} were not run."
    print(summary)
    if not options.only:
        header = "# Planted faults and the tests that catch them\n\nWritten by `python benchmarks/mutants.py`. "
        REPORT.write_text(f"{header}{summary}\n\n{table(outcomes)}\n")
    return 0 if killed == len(chosen) else 1


if __name__ == "__main__":
    sys.exit(main())
