"""Kernels for a wheel: compiles those of the README's first commands, and of some more, for levels of x86-64.

    python benchmarks/ship_kernels.py [--level x86-64-v3 --level x86-64-v4]
    python -m build --wheel -C--build-option=--plat-name=manylinux_2_28_x86_64 -C--build-option=--python-tag=cp312

The first line runs the commands in an empty folder once for each level and puts their kernels into
``ns_abstract/kernels/LEVEL``; the second, with the same Python, makes a wheel that holds them. A wheel from a checkout
without that folder has none. Kernels are for one version of Python, numba and the sources; any other installation
compiles its own. The machine that compiles has to have the level, since it runs what it compiles.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from first_picture import commands

from ns_abstract.arithmetic.kernel_cache import VARIABLE, source_key
from ns_abstract.arithmetic.shipped_kernels import LEVELS, SHIPPED, runs

ROOT = Path(__file__).resolve().parents[1]
#: After the README's commands, in the same folder: several parameters, a certificate, and a loop of the demo scene.
MORE = (
    "ns-abstract-render --load-config CONFIG --camera-path-filename demo/camera_path.json --translation 0.002 0.002 0"
    " --downscale-factor 4 --frames 0 --time-budget 5 --output-dir demo/two",
    "ns-abstract-reach --load-config demo/gate/gate/splatfacto/2026-01-01_120000/config.yml --loop demo/gate/LOOP.json"
    " --time-budget 10 --output-dir demo/loop",
)


def compile_for(level: str, folder: Path) -> Path:
    """The folder of the sources' kernels, compiled for a level in ``folder``.

    Raises:
        CalledProcessError: A command fails.
    """
    steps = commands((ROOT / "README.md").read_text(encoding="utf-8"))
    config = next(word for word in steps[-1] if word.endswith("config.yml"))
    steps += [line.replace("CONFIG", config).split() for line in MORE]
    target = {"NUMBA_CPU_NAME": level, "NUMBA_CPU_FEATURES": "", VARIABLE: str(folder / "kernels")}
    for step in steps:
        program = str(Path(sys.executable).parent / Path(step[0]).name)
        subprocess.run([program, *step[1:]], cwd=folder, env=os.environ | target, check=True, stdout=subprocess.DEVNULL)
    return folder / "kernels" / source_key()[:32]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--level", action="append", choices=list(LEVELS))
    levels = parser.parse_args().level or list(LEVELS)
    if lacking := [level for level in levels if not runs(level)]:
        parser.error(f"this processor has not all features of {', '.join(lacking)}")
    for level in levels:
        with tempfile.TemporaryDirectory() as folder:
            kernels = compile_for(level, Path(folder))
            shipped = ROOT / "ns_abstract" / SHIPPED / level
            shutil.rmtree(shipped, ignore_errors=True)
            kept = shutil.ignore_patterns("session-*", "lock")
            shutil.copytree(kernels, shipped / kernels.name, ignore=kept)
        size = sum(file.stat().st_size for file in shipped.rglob("*") if file.is_file())
        print(f"{level}: {len(list(shipped.rglob('blobs/*')))} files, {size / 2**20:.1f} MiB")


if __name__ == "__main__":
    main()
