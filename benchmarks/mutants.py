"""Mutation check of the soundness tests: each planted fault must be caught by the test named beside it.

Every mutant is one change of one file of a copy of the package, and one test that has to fail on it. The folder
`planted` lists them: a function, and an expression or statement that stands in it once.
The compiled kernels run interpreted (NUMBA_DISABLE_JIT=1), so that nothing is compiled per mutant; ``--compiled``
compiles instead, into a cache of each mutant's own. Each test is also run once on the unchanged copy, where it
has to pass.

    python benchmarks/mutants.py [--only NAME ... | --sample N | --missing] [--compiled] [--seconds N]

runs the mutants that are chosen, all of them if nothing is said, and exits with 1 if not all of these are killed.
benchmarks/mutants.md has a row for every mutant: what became of it when it was last run as it is, and on what day.
``--table`` writes that file without running any; ``--list`` checks that every change applies.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import astuple, dataclass
from datetime import date
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
    """What became of one mutant: how it ended, how long its test took, and the day.

    Attributes:
        verdict: "killed", or what happened instead.
        seconds: That the test took.
        day: ISO date.
    """

    verdict: str
    seconds: float
    day: str


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


def digest(fault: Fault) -> str:
    """Eight hexadecimal digits that change whenever anything of the fault does."""
    return hashlib.sha256(repr(astuple(fault)).encode()).hexdigest()[:8]


def read_outcomes(text: str) -> dict[str, Outcome]:
    """The outcomes in a table, by `digest`."""
    rows = re.findall(r"^\|.*\| `([0-9a-f]{8})` \| (.+) \| ([\d.]+) \| (\S+) \|$", text, re.M)
    return {key: Outcome(verdict.strip("*"), float(seconds), day) for key, verdict, seconds, day in rows}


def table(outcomes: dict[str, Outcome]) -> str:
    """All mutants and what is known of them, in Markdown."""
    known = [outcomes[key] for key in map(digest, FAULTS) if key in outcomes]
    killed = sum(outcome.verdict == "killed" for outcome in known)
    lines = [
        "# Planted faults and the tests that catch them",
        "",
        f"Written by `python benchmarks/mutants.py`. {len(FAULTS)} faults are planted. {len(known)} were run as "
        f"they are, and {killed} of these were killed.",
        "",
        "| mutant | file | test | version | outcome | seconds | day |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for fault in FAULTS:
        key = digest(fault)
        end = "not run since it was planted or changed | |"
        if key in outcomes:
            one = outcomes[key]
            word = one.verdict if one.verdict == "killed" else f"**{one.verdict}**"
            end = f"{word} | {one.seconds:.1f} | {one.day} |"
        lines.append(f"| {fault.name} | {fault.file} | `{fault.test}` | `{key}` | {end}")
    return "\n".join(lines) + "\n"


def main() -> int:
    """Run the mutants one after the other."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[], help="run the mutants whose names contain one of these")
    parser.add_argument("--sample", type=int, help="run so many, drawn at random")
    parser.add_argument("--missing", action="store_true", help="run those that were not run as they are")
    parser.add_argument("--compiled", action="store_true", help="compile the kernels, into a private cache")
    parser.add_argument("--list", action="store_true", help="check that every change applies, and stop")
    parser.add_argument("--table", action="store_true", help="write the table, and stop")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin with no mutant after so many")
    options = parser.parse_args()
    outcomes = read_outcomes(REPORT.read_text())
    chosen = [m for m in FAULTS if not options.only or any(part in m.name for part in options.only)]
    if options.missing:
        chosen = [m for m in chosen if digest(m) not in outcomes]
    if options.sample is not None:
        chosen = random.sample(chosen, min(options.sample, len(chosen)))
    if options.table:
        REPORT.write_text(table(outcomes))
        return 0
    begun, ran, killed = time.perf_counter(), 0, 0
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        copy_package(folder)
        for mutant in chosen:
            original = mutate(folder, mutant)
            (folder / "ns_abstract" / mutant.file).write_text(original)
        if options.list:
            print(f"{len(chosen)} mutants apply")
            return 0
        healthy: dict[str, int] = {}
        for mutant in chosen:
            if time.perf_counter() - begun > options.seconds:
                break
            compiled = options.compiled or mutant.compiled
            if mutant.test not in healthy:
                code, output, _ = run_test(folder, mutant.test, compiled)
                healthy[mutant.test] = code
                if code != _PASSED:
                    print(output[-2000:])
            verdict, seconds = "its test fails without it", 0.0
            if healthy[mutant.test] == _LATE:
                verdict = "timed out"
            elif healthy[mutant.test] == _PASSED:
                original = mutate(folder, mutant)
                code, output, seconds = run_test(folder, mutant.test, compiled)
                (folder / "ns_abstract" / mutant.file).write_text(original)
                # an assertion that fails, not a crash
                asserted = code == _FAILED and ("AssertionError" in output or "DID NOT RAISE" in output)
                verdicts = {_PASSED: "survived", _FAILED: "killed" if asserted else "crashed", _LATE: "timed out"}
                verdict = verdicts.get(code, f"pytest {code}")
            ran, killed = ran + 1, killed + (verdict == "killed")
            # a machine that is busy says nothing of a fault
            if verdict != "timed out":
                outcomes[digest(mutant)] = Outcome(verdict, seconds, date.today().isoformat())
            REPORT.write_text(table(outcomes))
            print(f"{verdict:10s} {seconds:6.1f} s  {mutant.name}", flush=True)
    print(f"{killed} of {len(chosen)} mutants killed, {len(chosen) - ran} were not run.")
    return 0 if killed == len(chosen) else 1


if __name__ == "__main__":
    sys.exit(main())
