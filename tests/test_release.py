"""What is said of the package elsewhere is what it is: the method page, the list entry, versions."""

from __future__ import annotations

import re
from fnmatch import fnmatch
from importlib.metadata import entry_points
from pathlib import Path

import pytest

import ns_abstract
from ns_abstract.arithmetic.shipped_kernels import SHIPPED
from ns_abstract.nerfstudio.torchvision_operators import declare_missing

ROOT = Path(__file__).resolve().parents[1]
pytestmark = pytest.mark.skipif(not (ROOT / "docs").is_dir(), reason="the documentation is not beside the tests")


@pytest.mark.slow
def test_method_page_names_what_is_registered() -> None:
    pytest.importorskip("nerfstudio")
    declare_missing()
    from nerfstudio.configs import external_methods

    page = (ROOT / "docs" / "dev" / "method.md").read_text(encoding="utf-8")
    text = next(block for block in re.findall(r"```python\n(.*?)```", page, re.S) if "external_methods" in block)
    known: list[external_methods.ExternalMethod] = []
    # the entry as nerfstudio's own file would hold it
    exec(text, {"external_methods": known, "ExternalMethod": external_methods.ExternalMethod})
    (entry,) = known
    points = {point.name: point.load() for point in entry_points(group="nerfstudio.method_configs")}
    registered = {name: method.description for name, method in points.items() if name.startswith("abstract-")}
    assert dict(entry.configurations) == registered
    assert {name: method.config.method_name for name, method in points.items() if name in registered} == {
        name: name for name in registered
    }
    for name, description in registered.items():
        assert f"| `{name}` | {description} |" in page


def test_versions_agree() -> None:
    version = re.escape(ns_abstract.__version__)
    assert re.search(rf"^version: {version}$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.M)
    assert re.search(rf"^## \[?({version}|Unreleased)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.M)


def unpackaged(files: list[str], patterns: list[str]) -> list[str]:
    """Files, relative to the package, that are neither sources nor of the package data."""
    # as setuptools has it: a star stops at a folder
    depth = [(pattern, pattern.count("/")) for pattern in patterns]
    return [f for f in files if not any(fnmatch(f, pattern) and f.count("/") == d for pattern, d in depth)]


def test_everything_that_is_read_is_installed() -> None:
    """Scripts, templates, weights and schemas beside the sources are in a wheel."""
    tomllib = pytest.importorskip("tomllib", reason="tomllib comes with Python 3.11")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    patterns = project["tool"]["setuptools"]["package-data"]["ns_abstract"]
    package = ROOT / "ns_abstract"
    there = [path for path in package.rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    files = [path.relative_to(package).as_posix() for path in there if path.suffix != ".py"]
    assert "py.typed" in files and unpackaged(files, patterns) == []
    # every folder of sources is a package, and every pattern has its files but for those of kernels, which are not kept
    assert all((path.parent / "__init__.py").exists() for path in there if path.suffix == ".py")
    kept = [pattern for pattern in patterns if not pattern.startswith(f"{SHIPPED}/")]
    assert all(unpackaged(files, [pattern]) != files for pattern in kept)


def test_what_is_not_installed_is_noticed() -> None:
    assert unpackaged(["a/b.js", "a/b/c.js", "d.html"], ["a/*.js"]) == ["a/b/c.js", "d.html"]
