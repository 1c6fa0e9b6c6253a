"""CONTRIBUTING.md's recipes are followed: each patch applies, its tests pass, and its planted fault is noticed."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from benchmark_scripts import script

ROOT = Path(__file__).resolve().parents[1]
RECIPES = sorted((ROOT / "tests" / "recipes").glob("*.patch"), key=lambda path: path.stem)

pytestmark = pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")


def apply(folder: Path, *patches: Path, check: bool = False) -> None:
    command = ["git", "apply", "-C1", *(["--check"] if check else []), *map(str, patches)]
    # not the checkout's repository
    alone = {**os.environ, "GIT_CEILING_DIRECTORIES": str(folder.parent)}
    done = subprocess.run(command, check=False, cwd=folder, capture_output=True, text=True, env=alone)
    assert done.returncode == 0, done.stderr


def touched(patch: Path, pattern: str) -> list[str]:
    return re.findall(rf"^\+\+\+ b/({pattern})$", patch.read_text(encoding="utf-8"), re.M)


def new_tests(patch: Path) -> list[str]:
    return re.findall(r"^--- /dev/null\n\+\+\+ b/(tests/test_\w+\.py)$", patch.read_text(encoding="utf-8"), re.M)


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the recipes touch."""
    folder = tmp_path_factory.mktemp("recipes")
    for name in ("ns_abstract", "tests", "benchmarks"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    (folder / "docs").mkdir()
    for patch in RECIPES:
        for page in touched(patch, r"docs/\w+\.md"):
            shutil.copy(ROOT / page, folder / page)
    return folder


def test_every_recipe_has_a_patch_that_applies(copy: Path) -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    told = re.findall(r"^## Add an? (\w+)\n(?:(?!^## ).*\n)*?.*`tests/recipes/(\w+)\.patch`", text, re.M)
    assert sorted(told) == [(path.stem, path.stem) for path in RECIPES]
    # all together, too: what one of them touches is not what another one does
    apply(copy, *RECIPES, check=True)
    for patch in RECIPES:
        assert len(new_tests(patch)) == len(touched(patch, r"benchmarks/planted/\w+\.py")) == 1


@pytest.mark.slow
def test_recipes_are_sound_and_notice_faults(copy: Path) -> None:
    """The patches' tests pass, with interpreted kernels, and the fault that each plants makes one of them fail."""
    known = {fault.name for fault in script("planted").FAULTS}
    apply(copy, *RECIPES)
    environment = {
        **os.environ, "PYTHONPATH": os.pathsep.join(map(str, (copy, copy / "benchmarks"))), "NUMBA_DISABLE_JIT": "1",
    }  # fmt: skip

    def run(*command: str, ends: int = 0) -> str:
        done = subprocess.run(
            [sys.executable, *command], check=False, cwd=copy, capture_output=True, text=True, env=environment
        )
        assert done.returncode == ends, done.stdout[-3000:] + done.stderr[-3000:]
        return done.stdout

    test = ("-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-p", "no:xdist")
    listed = "import planted; print(*(f'{f.name}|{f.file}|{f.test}' for f in planted.FAULTS), sep='\\n')"
    planted = [line.split("|") for line in run("-c", listed).splitlines()]
    new = [(name, file, f"tests/{killer}") for name, file, killer in planted if name not in known]
    assert len(new) == len(RECIPES)
    run(*test, *(name for patch in RECIPES for name in new_tests(patch)), *(killer for *_, killer in new))
    for name, file, killer in new:
        path = copy / "ns_abstract" / file
        healthy = path.read_text(encoding="utf-8")
        change = f"import planted; (f,) = [f for f in planted.FAULTS if f.name == {name!r}]; "
        change += f"p = __import__('pathlib').Path({str(path)!r}); p.write_text(planted.apply(p.read_text(), f))"
        run("-c", change)
        said = run(*test, killer, ends=1)
        assert "AssertionError" in said or "assert " in said
        path.write_text(healthy, encoding="utf-8")
