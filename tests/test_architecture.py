"""What holds for the whole source tree: imports point one way, no unsafe calls, exact kernels, honest packaging."""

from __future__ import annotations

import ast
import graphlib
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "ns_abstract"
#: A module imports from its own level or lower ones.
LEVELS = (
    "io",
    "execution",
    "arithmetic",
    "perturbation",
    "geometry",
    "refine",
    "methods",
    "paper",
    "demo",
    "report",
    "verify",
    "reach",
    "check",
    "api",
    "viewer",
    "nerfstudio",
    "bench",
    "cli",
)
#: Names of distributions whose modules are called otherwise.
DISTRIBUTIONS = {"yaml": "pyyaml", "PIL": "pillow", "distributed": "dask", "google": "protobuf"}
JIT = ("njit", "jit", "vectorize", "guvectorize", "cfunc", "stencil")

Finder = Callable[[ast.AST], Iterator[str]]


def sources() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def imported(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and dotted name of every absolute import, down to what is taken from a module."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: relative import"
            assert node.module is not None
            # "from ns_abstract.io import errors" names a module, too
            yield from ((node.lineno, f"{node.module}.{alias.name}") for alias in node.names)


@cache
def imports(text: str) -> list[tuple[int, str]]:
    """`imported` of a source, looked for once."""
    return list(imported(ast.parse(text)))


def dotted(node: ast.AST) -> str:
    """``a.b.c`` of a name or attribute, else what can be told of it."""
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else "?"


def keyword(call: ast.Call, name: str) -> object:
    """Value of a constant keyword argument, or None."""
    for item in call.keywords:
        if item.arg == name and isinstance(item.value, ast.Constant):
            return item.value.value
    return None


def upward(tree: ast.AST, unit: str) -> Iterator[str]:
    """Imports of a higher level than ``unit``."""
    for line, name in imported(tree):
        parts = name.split(".")
        if parts[0] == "ns_abstract" and len(parts) > 1 and LEVELS.index(parts[1]) > LEVELS.index(unit):
            yield f"line {line}: {unit} imports {name}"


def module(file: Path) -> str:
    """The dotted name of a file of the package."""
    parts = file.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def circle(texts: dict[str, str]) -> list[str]:
    """Modules that import one another in a circle, given their texts; what is imported for types alone counts, too."""
    used = {}
    for name, text in texts.items():
        found = {which for _, which in imports(text)}
        used[name] = {w if w in texts else w.rpartition(".")[0] for w in found} & texts.keys()
    try:
        graphlib.TopologicalSorter(used).prepare()
    except graphlib.CycleError as error:
        return error.args[1]
    return []


def unsafe(tree: ast.AST) -> Iterator[str]:
    """Calls that run what a file or a user says."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        name, end = dotted(node.func), dotted(node.func).rpartition(".")[2]
        bad = name in {"eval", "exec", "compile", "__import__", "os.system", "os.popen"}
        top = name.split(".")[0]
        bad = bad or (end in {"load", "loads", "Unpickler"} and top in {"pickle", "dill", "marshal", "shelve"})
        bad = bad or (name.startswith("yaml.") and "load" in end and end != "safe_load")
        bad = bad or (name == "torch.load" and keyword(node, "weights_only") is not True)
        bad = bad or (end == "load" and top in {"np", "numpy"} and keyword(node, "allow_pickle") is not False)
        bad = bad or keyword(node, "shell") is True
        if bad:
            yield f"line {node.lineno}: {name}"


def inexact(tree: ast.AST) -> Iterator[str]:
    """Kernels whose arithmetic is not IEEE 754's, and kernels that stop at a division by zero."""
    for node in ast.walk(tree):
        if isinstance(node, ast.keyword) and node.arg == "fastmath":
            yield f"line {node.value.lineno}: fastmath"
        if isinstance(node, ast.Constant) and node.value == "fastmath":
            yield f"line {node.lineno}: fastmath"
        for decorator in getattr(node, "decorator_list", []):
            call = decorator if isinstance(decorator, ast.Call) else None
            if dotted(call.func if call else decorator).rpartition(".")[2] not in JIT:
                continue
            # an inlined body becomes part of its caller
            inlined = call is not None and keyword(call, "inline") == "always"
            if call is None or (keyword(call, "error_model") != "numpy" and not inlined):
                yield f"line {decorator.lineno}: no error_model"
            elif keyword(call, "cache") is not True and not inlined:
                yield f"line {decorator.lineno}: not cached"


def unfinished(text: str) -> list[str]:
    """Marks of unfinished work."""
    words = "|".join(("TO" + "DO", "FIX" + "ME", "X" + "XX", "HA" + "CK", "NotImplemented" + "Error"))
    return [match[0] for match in re.finditer(rf"\b({words})\b", text)]


def drawing() -> str:
    """Which folder imports from which: a row's folder from those with a mark, columns as rows, from the left."""
    used = {folder: set() for folder in LEVELS}
    for file in sources():
        folder = file.relative_to(PACKAGE).parts[0]
        if folder in used:
            names = [name.split(".") for _, name in imports(file.read_text(encoding="utf-8"))]
            used[folder] |= {parts[1] for parts in names if parts[0] == "ns_abstract" and len(parts) > 1}
    width = max(map(len, LEVELS))
    rows = []
    for k, folder in enumerate(LEVELS):
        marks = " ".join("x" if other in used[folder] else "." for other in LEVELS[:k])
        rows.append(f"{folder:{width}}  {marks}".rstrip())
    return "\n".join(rows)


# ---------------------------------------------------------------- the tree


@pytest.mark.slow
@pytest.mark.skipif(not (ROOT / "docs").exists(), reason="the documentation is not beside the tests")
def test_drawing_of_imports_is_that_of_the_sources() -> None:
    page = (ROOT / "docs" / "dev" / "architecture.md").read_text(encoding="utf-8")
    assert f"```text\n{drawing()}\n```" in page, drawing()


@pytest.mark.parametrize("file", sources(), ids=lambda file: str(file.relative_to(PACKAGE)))
def test_source_file(file: Path) -> None:
    text = file.read_text(encoding="utf-8")
    tree = ast.parse(text)
    unit = file.relative_to(PACKAGE).parts[0].removesuffix(".py")
    found = [*unsafe(tree), *inexact(tree), *unfinished(text)]
    if unit != "__init__":
        assert unit in LEVELS, f"{unit} has no place in the order of imports"
        found += upward(tree, unit)
    assert not found


@pytest.mark.slow
def test_modules_import_one_way() -> None:
    texts = {module(file): file.read_text(encoding="utf-8") for file in sources()}
    assert len(texts) > 200 and circle(texts) == []


@pytest.mark.slow
def test_only_the_plug_in_imports_nerfstudio() -> None:
    plug_in = {"nerfstudio", "viser", "torchmetrics", "gsplat"}
    for file in sources():
        if file.relative_to(PACKAGE).parts[0] != "nerfstudio":
            found = {name.split(".")[0] for _, name in imports(file.read_text(encoding="utf-8"))}
            assert not found & plug_in, file


def test_the_package_stands_alone() -> None:
    text = "\n".join(file.read_text(encoding="utf-8") for file in sources())
    assert not re.search(r"\bshared/|/work/|import tests|from tests", text)


@pytest.mark.parametrize("kind", ["tests", "benchmarks"])
def test_no_unfinished_work_elsewhere(kind: str) -> None:
    for file in sorted((ROOT / kind).rglob("*.py")):
        assert not unfinished(file.read_text(encoding="utf-8")), file


# ---------------------------------------------------------------- the rules above find what they should

BAD = {
    "import up": (lambda tree: upward(tree, "geometry"), "from ns_abstract.methods.splat import scene"),
    "import up inside": (lambda tree: upward(tree, "refine"), "def f():\n    import ns_abstract.cli.render"),
    "import up by name": (lambda tree: upward(tree, "arithmetic"), "from ns_abstract import refine"),
    "eval": (unsafe, "x = eval('1')"),
    "exec": (unsafe, "exec(text)"),
    "pickle": (unsafe, "import pickle\npickle.load(f)"),
    "unpickler": (unsafe, "pickle.Unpickler(f).load()"),
    "yaml": (unsafe, "yaml.load(t, Loader=yaml.Loader)"),
    "yaml unsafe": (unsafe, "yaml.unsafe_load(t)"),
    "torch": (unsafe, "torch.load(p)"),
    "torch without care": (unsafe, "torch.load(p, weights_only=False)"),
    "numpy": (unsafe, "np.load(p)"),
    "shell": (unsafe, "subprocess.run(c, shell=True)"),
    "fastmath": (inexact, "@njit(cache=True, error_model='numpy', fastmath=True)\ndef f(): pass"),
    "fastmath in a mapping": (inexact, "options = {'fastmath': {'contract'}}"),
    "bare njit": (inexact, "@njit\ndef f(): pass"),
    "python errors": (inexact, "@numba.njit(cache=True)\ndef f(): pass"),
    "other errors": (inexact, "@njit(cache=True, error_model='python')\ndef f(): pass"),
    "no cache": (inexact, "@njit(error_model='numpy')\ndef f(): pass"),
}
GOOD = {
    "import down": (lambda tree: upward(tree, "methods"), "from ns_abstract.geometry.box import ParameterBox"),
    "safe loads": (unsafe, "yaml.safe_load(t)\ntorch.load(p, weights_only=True)\nnp.load(p, allow_pickle=False)"),
    "kernel": (inexact, "@njit(cache=True, error_model='numpy')\ndef f(): pass"),
}


@pytest.mark.parametrize("name", BAD)
def test_rule_finds(name: str) -> None:
    find, text = BAD[name]
    assert len(list(find(ast.parse(text)))) == 1


@pytest.mark.parametrize("name", GOOD)
def test_rule_lets_pass(name: str) -> None:
    find, text = GOOD[name]
    assert not list(find(ast.parse(text)))


def test_circles_are_found() -> None:
    texts = {
        "ns_abstract.io.one": "def f():\n    from ns_abstract.api import two",
        "ns_abstract.api.two": "if TYPE_CHECKING:\n    from ns_abstract.three import f",
        "ns_abstract.three": "import ns_abstract.io.one",
    }
    assert set(circle(texts)) == texts.keys()
    texts["ns_abstract.three"] = "import ns_abstract.io.other"
    assert circle(texts) == []


def test_unfinished_work_is_found() -> None:
    assert unfinished("# " + "TO" + "DO: later") and unfinished("raise " + "NotImplemented" + "Error")
    assert not unfinished("mastodon hackle")


# ---------------------------------------------------------------- packaging


def project() -> dict:
    tomllib = pytest.importorskip("tomllib", reason="tomllib comes with Python 3.11")
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def required(lines: list[str]) -> set[str]:
    return {re.split(r"[\[<>=;~! ]", line)[0].lower() for line in lines}


def test_every_import_is_a_dependency() -> None:
    about = project()
    extras = about["optional-dependencies"]
    declared = required(about["dependencies"])
    optional = required(extras["nerfstudio"] + extras["cluster"] + extras["formats"] + extras["video"])
    used: set[str] = set()
    for file in sources():
        for _, name in imports(file.read_text(encoding="utf-8")):
            top = name.split(".")[0]
            if top not in sys.stdlib_module_names and top != "ns_abstract":
                used.add(DISTRIBUTIONS.get(top, top).lower())
    assert used <= declared | optional
    assert declared <= used, "a dependency that nothing imports"


def test_scripts_point_to_functions() -> None:
    scripts = project()["scripts"]
    assert {"ns-abstract-render", "ns-abstract-demo"} <= set(scripts)
    for target in scripts.values():
        module, _, function = target.partition(":")
        tree = ast.parse((ROOT / f"{module.replace('.', '/')}.py").read_text(encoding="utf-8"))
        assert function in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def ci_command(root: Path) -> subprocess.CompletedProcess[str]:
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("bash is not installed")
    return subprocess.run(
        [bash, str(root / ".ci" / "run"), "--print"], capture_output=True, text=True, timeout=60, check=False
    )


def copy_of_ci(folder: Path, readme: str) -> Path:
    (folder / ".ci").mkdir()
    shutil.copy(ROOT / ".ci" / "run", folder / ".ci" / "run")
    (folder / "README.md").write_text(readme)
    return folder


def test_ci_runs_the_readmes_test_command() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    blocks = [block.strip() for block in re.findall(r"^```\w+\n(.*?)^```", text, re.MULTILINE | re.DOTALL)]
    expected = [block for block in blocks if "pytest" in block]
    assert len(expected) == 1
    found = ci_command(ROOT)
    assert (found.returncode, found.stdout.strip()) == (0, expected[0])
    for part in ("-m venv", "pip install", "constraints.txt", "[test]", "&&"):
        assert part in expected[0]


@pytest.mark.parametrize("count", [0, 2])
def test_ci_refuses_a_readme_with_any_other_number_of_test_commands(tmp_path: Path, count: int) -> None:
    found = ci_command(copy_of_ci(tmp_path, "```sh\npytest\n```\n\n" * count))
    assert found.returncode != 0
    assert f"has {count} fenced" in found.stderr


@pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")
@pytest.mark.parametrize("status", [0, 7])
def test_ci_runs_in_a_copy_and_passes_the_exit_code_on(tmp_path: Path, status: int) -> None:
    where = copy_of_ci(tmp_path, f"```sh\necho pytest in $PWD with [$PYTHONPATH]; ls; touch made; exit {status}\n```\n")
    (where / "kept.txt").write_text("")
    (where / ".gitignore").write_text("ignored.txt\n")
    (where / "ignored.txt").write_text("")
    subprocess.run(["git", "init", "-q", str(where)], check=True, timeout=30)
    found = subprocess.run(
        ["bash", str(where / ".ci" / "run")],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        env={
            "PATH": ":".join(str(p) for p in _path()),
            "PYTHONPATH": "/nowhere",
            "HOME": str(tmp_path),
            "NS_ABSTRACT_INSTALL": "0",
        },
    )
    assert found.returncode == status, found.stderr
    assert "with []" in found.stdout
    assert f"in {where} " not in found.stdout
    assert "kept.txt" in found.stdout and "ignored.txt" not in found.stdout
    assert not (where / "made").exists()


#: Stands in for python3: an environment that it makes holds tools that say their name and fail if they are told to.
_PYTHON = """#!/bin/sh
if [ "$2" != venv ]; then exec {python} "$@"; fi
mkdir -p "$3/bin"
for name in pip ruff pyright pytest; do
    printf '#!/bin/sh\\necho "ran %s $*"\\n[ "%s" != "$FAILS" ]\\n' $name $name > "$3/bin/$name"
    chmod +x "$3/bin/$name"
done
"""


@pytest.mark.slow_cases(every=3)
@pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")
@pytest.mark.parametrize("fails", ["", "ruff", "pyright", "pytest"])
def test_ci_lints_first_and_goes_on_after_a_failure(tmp_path: Path, fails: str) -> None:
    tools = tmp_path / "tools"
    tools.mkdir()
    (tools / "python3").write_text(_PYTHON.replace("{python}", sys.executable))
    (tools / "python3").chmod(0o755)
    (tmp_path / "here").mkdir()
    command = "python3 -m venv .venv && .venv/bin/pip install -e . && .venv/bin/pytest -n 2"
    where = copy_of_ci(tmp_path / "here", f"```sh\n{command}\n```\n")
    (where / "pyproject.toml").write_text("")
    subprocess.run(["git", "init", "-q", str(where)], check=True, timeout=30)
    found = subprocess.run(
        ["bash", str(where / ".ci" / "run")], capture_output=True, text=True, timeout=60, check=False,
        env={"PATH": ":".join(map(str, [tools, *_path()])), "NS_ABSTRACT_INSTALL": "0", "FAILS": fails},
    )  # fmt: skip
    ran = [line.removeprefix("ran ") for line in found.stdout.splitlines() if line.startswith("ran ")]
    assert [line.split()[0] for line in ran] == ["pip", "ruff", "ruff", "pip", "pyright", "pip", "pytest"]
    assert ran[0].endswith("ruff") and ran[1:3] == ["ruff check .", "ruff format --check ."]
    assert f"+ {command}" in found.stdout.splitlines()
    assert (found.returncode == 0) == (not fails)
    told = {"": "", "ruff": "failed: lint format", "pyright": "failed: types", "pytest": "failed: tests"}
    assert found.stderr.strip() == told[fails]


def _path() -> list[Path]:
    folders = {Path(sys.executable).parent}
    for name in ("git", "bash", "tar", "mktemp"):
        file = shutil.which(name)
        if file is not None:
            folders.add(Path(file).parent)
    return sorted(folders)
