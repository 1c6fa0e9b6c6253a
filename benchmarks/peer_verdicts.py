"""Verdicts of alpha-beta-CROWN on the instances that `published.py` decides, on the same cores.

    git clone --recursive https://github.com/Verified-Intelligence/alpha-beta-CROWN
    python benchmarks/peer_verdicts.py alpha-beta-CROWN CONFIG.yaml FOLDER [--count 10] [--seconds 60] [--python PYTHON]

alpha-beta-CROWN is no dependency: PYTHON is the interpreter of an environment with its requirements. CONFIG is the
configuration that it publishes for the category; where that asks for CPLEX, ``exp_configs/BICCOS/*/beta.yaml`` does
without. A row gives the instance, the verdict, the seconds that the program names, and the seconds and processor
seconds of its process. With ``--processor CORES`` its clock is processor seconds over CORES, for machines where others
work, too.
"""

from __future__ import annotations

import argparse
import collections
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

from published import listed, spread  # noqa: E402

from ns_abstract.bench.vnnlib import instances, stored_file  # noqa: E402
from ns_abstract.io.packed import unpacked  # noqa: E402

#: Runs the program in its own folder, by another clock where cores are named.
_START = """
import runpy, sys, time
cores = float(sys.argv.pop(1))
if cores:
    begin = time.time()
    time.time = lambda: begin + time.process_time() / cores
sys.path.insert(0, "")
sys.argv[0] = "abcrown.py"
runpy.run_path("abcrown.py", run_name="__main__")
"""


def plain(folder: Path, name: str, scratch: Path) -> Path:
    """The file that a line of the list names, unpacked where it is stored packed."""
    path = stored_file(folder, name)
    if path.suffix != ".gz":
        return path
    copy = scratch / path.stem
    copy.write_bytes(b"".join(unpacked(path, 1 << 30)))
    return copy


def verdict(
    options: argparse.Namespace, folder: Path, names: tuple[str, str], seconds: float
) -> tuple[str, str, float, float]:
    """The verdict, the seconds that the program names, seconds and processor seconds of the process."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    with tempfile.TemporaryDirectory() as scratch:
        network, query = (plain(folder, name, Path(scratch)).resolve() for name in names)
        command = [
            options.python, "-c", _START, str(options.processor), "--config", str(options.config.resolve()),
            "--device", "cpu", "--root_path", "", "--csv_name", "", "--onnx_path", str(network),
            "--vnnlib_path", str(query), "--timeout", f"{seconds:g}", "--results_file", f"{scratch}/result.txt",
        ]  # fmt: skip
        place = options.checkout / "complete_verifier"
        output = subprocess.run(
            command, cwd=place, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": ""}, check=False
        )
    lines = (output.stdout + output.stderr).strip().splitlines() or [""]
    said = {key: [line for line in lines if line.startswith(key)] for key in ("Result:", "Time:")}
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    result = said["Result:"][-1].split()[-1] if said["Result:"] else f"error ({lines[-1][:80]})"
    named = said["Time:"][-1].split()[-1] if said["Time:"] else ""
    return result, named[:5], time.perf_counter() - start, used


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkout", type=Path, help="of alpha-beta-CROWN, with auto_LiRPA in it")
    parser.add_argument("config", type=Path, help="its configuration of the category")
    parser.add_argument("folder", type=Path, help="of a category")
    parser.add_argument("--count", type=int, default=10, help="instances (10)")
    parser.add_argument("--seconds", type=float, default=60.0, help="limit of each (60)")
    parser.add_argument("--python", default=sys.executable, help="interpreter (this one)")
    parser.add_argument("--processor", type=float, default=0.0, metavar="CORES", help="its clock (0: the wall's)")
    options = parser.parse_args()
    folder, words = listed(options.folder).resolve(), collections.Counter[str]()
    print("| network | property | verdict | s | s in all | processor s |\n" + "|---" * 6 + "|")
    lines = instances(folder)
    for line in (lines[number] for number in spread(len(lines), options.count)):
        result, named, seconds, used = verdict(
            options, folder, (line.network, line.property), min(options.seconds, line.seconds)
        )
        words[result.split()[0]] += 1
        names = Path(line.network).name, Path(line.property).name
        print("|", " | ".join((*names, result, named, f"{seconds:.0f}", f"{used:.0f}")), "|", flush=True)
    print(f"| | | {', '.join(f'{n} {word}' for word, n in sorted(words.items()))} | | | |")


if __name__ == "__main__":
    main()
