"""Verdicts of published instances of the verification competitions: ten of each category, spread over its list.

    git clone https://github.com/stanleybak/vnncomp2021
    git clone https://github.com/ChristopherBrix/vnncomp2022_benchmarks
    git clone https://github.com/ChristopherBrix/vnncomp2023_benchmarks
    python benchmarks/published.py vnncomp2021/benchmarks/oval21 ... [--count 10] [--seconds 60] [--jobs 2]

A row gives the instance, the verdict, the seconds to decide it and in all, those over
the limit, and how many boxes or branches were bounded;
the last row of a category its verdicts together. Bounds are in real arithmetic, as those of other tools are.
"""

from __future__ import annotations

import argparse
import collections
import multiprocessing
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]

from ns_abstract.bench.vnnlib import instances, run_folder, version_folder  # noqa: E402
from ns_abstract.verify.network import NetworkArithmetic  # noqa: E402

Job = tuple[Path, int, float, int, NetworkArithmetic, bool]


def listed(folder: Path) -> Path:
    """The folder of a category whose list has the usual name; a copy of it where another name is used."""
    folder = version_folder(folder)
    lists = sorted(folder.glob("*instances.csv"))
    if not lists or (folder / "instances.csv").exists():
        return folder
    copy = Path(tempfile.mkdtemp()) / folder.name
    shutil.copytree(folder, copy)
    shutil.copy(lists[0], copy / "instances.csv")
    return copy


def spread(known: int, count: int) -> list[int]:
    """``count`` numbers of a list of ``known`` lines, evenly spread; all of a shorter one."""
    count = min(count, known)
    return [k * known // count for k in range(count)]


def decided(job: Job) -> dict[str, Any]:
    """The row of one instance, by its number in the list."""
    folder, number, seconds, memory, arithmetic, processor = job
    if processor:
        time.perf_counter = time.process_time
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as scratch:
        (row,) = run_folder(
            folder, Path(scratch), numbers=(number,), seconds=seconds, memory=memory << 30, arithmetic=arithmetic
        )
    listed_seconds = instances(folder)[number].seconds
    spent = time.perf_counter() - start
    return {**row, "all": spent, "over": max(0.0, spent - min(seconds, listed_seconds))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER", help="of a category")
    parser.add_argument("--count", type=int, default=10, help="instances of each (10)")
    parser.add_argument("--seconds", type=float, default=60.0, help="limit of each (60)")
    parser.add_argument("--jobs", type=int, default=2, help="instances at a time (2)")
    parser.add_argument("--memory", type=int, default=4, help="GiB of bounds (4)")
    parser.add_argument("--arithmetic", choices=("real", "float32"), default="real", help="what unsat covers (real)")
    parser.add_argument("--processor", action="store_true", help="processor seconds instead, where others work, too")
    options = parser.parse_args()
    print("| category | network | property | verdict | s | s in all | over | boxes | |\n" + "|---" * 9 + "|")
    for folder in map(listed, options.folders):
        jobs = [
            (folder, number, options.seconds, options.memory, options.arithmetic, options.processor)
            for number in spread(len(instances(folder)), options.count)
        ]
        words: collections.Counter[str] = collections.Counter()
        with multiprocessing.get_context("spawn").Pool(options.jobs, maxtasksperchild=1) as pool:
            for row in pool.imap(decided, jobs):
                words[row["verdict"]] += 1
                cells = (
                    folder.name, Path(row["network"]).name, Path(row["property"]).name, row["verdict"],
                    f"{row['seconds']:.1f}", f"{row['all']:.1f}", f"{row['over']:.1f}",
                    row["boxes"], row["why"],
                )  # fmt: skip
                print("|", " | ".join(map(str, cells)), "|", flush=True)
        print(f"| {folder.name} | | | {', '.join(f'{n} {word}' for word, n in sorted(words.items()))} | | | | | |")


if __name__ == "__main__":
    main()
