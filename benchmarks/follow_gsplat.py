"""What a new version of gsplat changes of the evaluation, and its kernels on a CPU against the bounds.

    python benchmarks/follow_gsplat.py CHECKOUT [--known 1.6.0] [--compare RUN/config.yml ...]

CHECKOUT holds the folder ``gsplat`` of the new sources. The kernels that pictures come from are cut out of the sources
of the version ``--known`` and of the new ones, by name, and compared without comments and space: each is the same,
changed (its difference is printed), or gone. The same is done with macros of limits and with the Python functions that
call the kernels. ``--compare`` compiles the new kernels with g++ and attacks the bounds of ``--known`` with them, as
``benchmarks/kernels_on_cpu.py`` does. docs/gsplat-versions.md says what to do with the answers.

The exit code is 0 if nothing has changed, 1 if something has or lies outside the bounds, 2 if sources are missing.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from gsplat_kernels import _PARTS, SOURCES_VARIABLE, Unavailable, definition, sources  # noqa: E402

#: Python functions around the kernels, by file below ``gsplat``.
CALLERS = {
    "rendering.py": ("rasterization",),
    "cuda/_wrapper.py": ("fully_fused_projection", "isect_tiles", "spherical_harmonics", "rasterize_to_pixels"),
}
#: Sources of kernels.
_ENDINGS = (".cu", ".cuh", ".h", ".cpp")


def plain(text: str) -> str:
    """C++ text without comments and formatting, a statement a line."""
    text = re.sub(r"//[^\n]*|/\*.*?\*/", " ", text, flags=re.DOTALL)
    text = re.sub(r"\s*([^\w\s])\s*", r"\1", " ".join(text.split()))
    return re.sub(r",(?=[)}])", "", re.sub(r"([;{}])", r"\1\n", text)).strip()


def found(folder: Path, file: str, name: str) -> str:
    """The plain text of a definition in ``file``, else in any source; empty if there is none."""
    places = [folder / "cuda" / file, *sorted(f for f in (folder / "cuda").rglob("*") if f.suffix in _ENDINGS)]
    for place in places:
        if "third_party" in place.parts or not place.is_file():
            continue
        try:
            return plain(definition(place.read_text(encoding="utf-8"), name))
        except ValueError:
            continue
    return ""


def macro(folder: Path, name: str) -> str:
    """The lines that define a macro or a constant of this name, in any source."""
    lines = set()
    for place in sorted((folder / "cuda").rglob("*")):
        if place.suffix in _ENDINGS and "third_party" not in place.parts:
            text = place.read_text(encoding="utf-8")
            lines |= {
                plain(m.group()) for m in re.finditer(rf"^.*(?:#define|constexpr)[^\n]*\b{name}\b.*$", text, re.M)
            }
    return "\n".join(sorted(lines))


def caller(folder: Path, file: str, name: str) -> str:
    """A Python function's code, without its docstring and comments."""
    place = folder / file
    if not place.is_file():
        return ""
    for node in ast.walk(ast.parse(place.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef) and node.name == name:
            if ast.get_docstring(node) is not None:
                node.body = node.body[1:] or [ast.Pass()]
            return ast.unparse(node)
    return ""


def compared(old: Path, new: Path, known: str) -> Iterator[tuple[str, str, str]]:
    """Name, old and new text of everything that pictures depend on."""
    parts = _PARTS[known]
    for file, names in parts.definitions:
        for name in names:
            yield f"{file}: {name}", found(old, file, name), found(new, file, name)
    for _, names in parts.macros:
        for name in names:
            yield f"limit {name}", macro(old, name), macro(new, name)
    for file, names in CALLERS.items():
        for name in names:
            yield f"{file}: {name}", caller(old, file, name), caller(new, file, name)


def report(old: Path, new: Path, known: str) -> int:
    """Print what has changed; returns how many parts have."""
    changed = 0
    for name, before, after in compared(old, new, known):
        if before == after:
            print(f"same     {name}" if before else f"absent   {name}")
            continue
        changed += 1
        print(f"{'changed ' if after else 'gone    '} {name}")
        if before and after:
            lines = difflib.unified_diff(before.splitlines(), after.splitlines(), known, "new", lineterm="", n=2)
            print("\n".join(f"         {line}" for line in lines))
    print(f"{changed} of the parts that pictures depend on have changed")
    return changed


def attack(new: Path, known: str, runs: list[Path]) -> int:
    """Attack the bounds of ``known`` with the new kernels; returns the exit code of ``kernels_on_cpu.py``."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / known).mkdir()
        (Path(folder) / known / "gsplat").symlink_to(new.resolve())
        command = [sys.executable, str(ROOT / "benchmarks" / "kernels_on_cpu.py"), *map(str, runs)]
        command += ["--gsplat-version", known, "--output-dir", str(Path(folder) / "bench")]
        return subprocess.run(command, env={**os.environ, SOURCES_VARIABLE: folder}, check=False).returncode


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkout", type=Path)
    parser.add_argument("--known", default="1.6.0", choices=sorted(_PARTS))
    parser.add_argument("--known-sources", type=Path, help="a checkout of --known; by default that of PyPI")
    parser.add_argument("--compare", type=Path, nargs="+", default=[], metavar="config.yml")
    options = parser.parse_args()
    new = options.checkout / "gsplat"
    try:
        old = options.known_sources / "gsplat" if options.known_sources else sources(options.known)
    except Unavailable as reason:
        print(f"error: {reason}, or give --known-sources", file=sys.stderr)
        return 2
    for folder in (old, new):
        if not (folder / "cuda").is_dir():
            print(f"error: no kernels in {folder}/cuda; give the folder that holds gsplat/", file=sys.stderr)
            return 2
    changed = report(old, new, options.known)
    outside = attack(new, options.known, options.compare) if options.compare else 0
    return outside if outside == 2 else int(bool(changed or outside))


if __name__ == "__main__":
    sys.exit(main())
