"""What the README's first command takes without a kernel there: seconds of each of its steps but the install.

    python benchmarks/first_picture.py [--times 3] [--keep benchmarks/first_picture.csv]

runs the commands of the README's first block behind the install, those of this environment, in an empty folder with an
empty folder of kernels, and prints wall and processor seconds by command. With ``--keep`` a row for each time is added
to a file, so that a change that makes the first picture slower is seen there; machines differ, so that only rows of one
machine compare.
"""

from __future__ import annotations

import argparse
import csv
import os
import platform
import re
import resource
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from datetime import date
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
COLUMNS = ("day", "version", "processor", "cores", "demo_wall", "demo_cpu", "render_wall", "render_cpu", "wall", "cpu")


def commands(readme: str) -> list[list[str]]:
    """The words of the commands that the README's first block runs after the install.

    Raises:
        ValueError: The block is not there, or runs other commands.
    """
    blocks = re.findall(r"^```sh\n(.*?)^```", readme, re.M | re.S)
    steps = [shlex.split(step) for step in blocks[0].split(" && ")] if blocks else []
    ours = [step for step in steps if Path(step[0]).name.startswith("ns-abstract-")]
    names = [Path(step[0]).name for step in ours]
    if names != ["ns-abstract-demo", "ns-abstract-render"]:
        raise ValueError(f"README.md's first block runs {names}, expected a demo and a render")
    return ours


def processor() -> str:
    """The processor's name."""
    info = Path("/proc/cpuinfo")
    text = info.read_text(encoding="utf-8") if info.exists() else ""
    named = re.search(r"^model name\s*: (.*)$", text, re.M)
    return named[1] if named else platform.processor() or platform.machine()


def measure(steps: list[list[str]], folder: Path) -> dict[str, object]:
    """A row: seconds of the steps, run in ``folder``, which holds their kernels, too.

    Raises:
        CalledProcessError: One fails.
    """
    environment = {**os.environ, "NS_ABSTRACT_CACHE_DIR": str(folder / "kernels")}
    seconds: list[float] = []
    for step in steps:
        before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        program = str(Path(sys.executable).parent / Path(step[0]).name)
        subprocess.run([program, *step[1:]], cwd=folder, env=environment, check=True, stdout=subprocess.DEVNULL)
        wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds += [wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime]
    from ns_abstract import __version__

    told = [date.today().isoformat(), __version__, processor(), len(os.sched_getaffinity(0))]
    figures = [f"{number:.1f}" for number in (*seconds, seconds[0] + seconds[2], seconds[1] + seconds[3])]
    return dict(zip(COLUMNS, (*told, *figures), strict=True))


def keep(rows: list[dict[str, object]], file: Path) -> None:
    """Add rows to a table, which is begun with its header."""
    new = not file.exists()
    with open(file, "a", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, COLUMNS, lineterminator="\n")
        if new:
            writer.writeheader()
        writer.writerows(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=1)
    parser.add_argument("--keep", type=Path)
    arguments = parser.parse_args()
    steps, rows = commands((ROOT / "README.md").read_text(encoding="utf-8")), []
    print("| demo s | its processor s | render s | its processor s | together s | processor s |")
    print("| ---: | ---: | ---: | ---: | ---: | ---: |")
    for _ in range(arguments.times):
        folder = Path(tempfile.mkdtemp())
        try:
            rows.append(measure(steps, folder))
        finally:
            shutil.rmtree(folder)
        print("| " + " | ".join(str(rows[-1][column]) for column in COLUMNS[4:]) + " |", flush=True)
    if arguments.keep is not None:
        keep(rows, arguments.keep)


if __name__ == "__main__":
    main()
