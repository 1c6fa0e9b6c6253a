"""Charges for rounding stand in their home, with a label of docs/dev/design.md, and nowhere else."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import mpmath
import numpy as np
import pytest

from ns_abstract.arithmetic import rounding
from ns_abstract.arithmetic.chebyshev import ChebyshevBasis
from ns_abstract.methods.nerf import ray_field
from ns_abstract.methods.splat import depth_pairs

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = Path(rounding.__file__).resolve().parents[1]
HOME = PACKAGE / "arithmetic" / "rounding.py"
#: Homes, and folders that bound nothing. The checker shares no code with what it checks, its charges included.
ELSEWHERE = (
    "arithmetic/rounding.py", "arithmetic/network_charges.py", "verify/network/", "check/", "report/", "demo/", "cli/",
    "bench/", "viewer/",
)  # fmt: skip
#: Small numbers that are no charges, by file: what they are.
KNOWN = {
    "arithmetic/elementary.py": {"1.9082149292705877e-10"},  # the low part of log 2
    "methods/nerf/render.py": {"1e-05"},  # Nerfstudio's least sum of weights
    "methods/splat/constants.py": {"1e-10"},  # gsplat's least accumulation
    "methods/splat/drawable.py": {"np.spacing"},  # a note on how coarse coordinates are
    "methods/nerf/nerfacto_load.py": {"np.spacing"},  # a note on resolutions near an integer
    # an optimiser's settings, which no picture sees
    "methods/nerf/write.py": {"1e-08"},
    "methods/splat/write.py": {"1e-15"},
    "nerfstudio/methods.py": {"1e-15", "1.6e-06", "5e-07", "1e-08"},
}
#: The formats' own numbers, which every label uses, and what stands for 0.
UNITS = {"UNIT64", "UNIT32", "UNDERFLOW64", "UNDERFLOW32", "NONZERO"}
#: What tells how exact a type is.
_EXACTNESS = ("eps", "epsneg", "resolution", "spacing", "fromhex")


def _number(node: ast.AST) -> float | None:
    """The number that a literal is, with its sign."""
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        value = _number(node.operand)
        return None if value is None else -value
    number = isinstance(node, ast.Constant) and type(node.value) in (int, float)
    return float(node.value) if number else None  # pyright: ignore[reportAttributeAccessIssue]


def _homely(tree: ast.AST) -> set[str]:
    """Units and charges that a module imports from the home."""
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module == "ns_abstract.arithmetic.rounding":
            names |= {alias.asname or alias.name for alias in node.names}
    return {name for name in names if re.match(r"UNIT|UNDERFLOW|.*(ROUNDING|ERROR)$", name)}


def _looked_at(node: ast.AST) -> Iterator[ast.AST]:
    """``node`` and what is below, but for records of preferences."""
    if not (isinstance(node, ast.ClassDef) and node.name.endswith("Tuning")):
        yield node
        for child in ast.iter_child_nodes(node):
            yield from _looked_at(child)


def bare(text: str) -> list[str]:
    """What of a module's ``text`` looks like a charge for rounding without a name."""
    tree = ast.parse(text)
    homely, found = _homely(tree), []
    for node in _looked_at(tree):
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow):
            base, power = _number(node.left), _number(node.right)
            if base in (2.0, 10.0, 0.5, 0.1) and power is not None and (power < 0.0) == (base > 1.0):
                found.append(ast.unparse(node))
        elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult):
            for one, other in ((node.left, node.right), (node.right, node.left)):
                times = _number(one)
                if times is not None and abs(times) > 1.0 and isinstance(other, ast.Name) and other.id in homely:
                    found.append(ast.unparse(node))
        elif isinstance(node, ast.Constant):
            value = _number(node)
            if value is not None and 0.0 < value < 1e-4:
                found.append(ast.unparse(node))
        elif isinstance(node, ast.Attribute) and node.attr in _EXACTNESS:
            # a field's spacing is no number's
            if node.attr == "spacing" and ast.unparse(node.value) != "np":
                continue
            # a table of exact values is read as such
            if node.attr != "fromhex" or "_TABLES" not in text:
                found.append(ast.unparse(node))
    return found


def test_charges_have_names_in_their_home() -> None:
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        place = path.relative_to(PACKAGE).as_posix()
        if not place.startswith(ELSEWHERE):
            strangers = set(bare(path.read_text(encoding="utf-8"))) - KNOWN.get(place, set())
            if strangers:
                found[place] = sorted(strangers)
    assert found == {}, "name them in arithmetic/rounding.py, or in a record of preferences (Tuning)"


@pytest.mark.parametrize(
    "planted",
    [
        "x = y * (1.0 + 2.0**-40)",
        "x = 2 ** -53 * y",
        "x = 0.5**44 * y",
        "def f(y):\n    return y + 1e-12",
        "x = 0.00001 * y",
        "x = float.fromhex('0x1p-44')",
        "import numpy as np\nx = 4 * np.finfo(np.float64).eps",
        "import numpy as np\nx = np.spacing(y)",
        "from ns_abstract.arithmetic.rounding import UNIT64\nx = 8.0 * UNIT64 * y",
        "from ns_abstract.arithmetic.rounding import FORM_ROUNDING as F_ROUNDING\nx = y * (F_ROUNDING * 4.0)",
        "class Tuned:\n    room: float = 2.0**-20",
    ],
)
def test_a_charge_without_a_name_is_found(planted: str) -> None:
    assert len(bare(planted)) == 1
    # and wherever it stands in a module of the product
    text = (PACKAGE / "methods" / "splat" / "frame.py").read_text(encoding="utf-8")
    assert bare(text) == [] and len(bare(f"{text}\n{planted}\n")) == 1


def test_what_is_no_charge_is_left_alone() -> None:
    text = """
from ns_abstract.arithmetic.rounding import UNIT64, UP
class FrameTuning:
    step: float = 2.0**-10
    share: float = 1e-9
x = 2**20 + 0.5 * UP + count * UNIT64 + 1e-3 + 2.0**n + 1e300
"""
    assert bare(text) == []


def stated() -> dict[str, str]:
    """What the home says above every number that it names."""
    found: dict[str, str] = {}
    said: list[str] = []
    for line in HOME.read_text(encoding="utf-8").splitlines():
        if line.startswith("#: "):
            said.append(line[3:])
            continue
        if match := re.match(r"([A-Z][A-Z0-9_]*(?:, [A-Z][A-Z0-9_]*)*) = ", line):
            found |= dict.fromkeys(match[1].split(", "), " ".join(said))
        said = []
    return found


def test_every_charge_says_what_it_is_for() -> None:
    design = ROOT / "docs" / "dev" / "design.md"
    if not design.exists():
        pytest.skip("the documents are not beside the tests")
    labels = set(re.findall(r"(?m)^\*\*([A-Z]\d+)[ .]", design.read_text(encoding="utf-8")))
    numbers = {name for name, value in vars(rounding).items() if name.isupper() and isinstance(value, int | float)}
    said = {name: text for name, text in stated().items() if name in numbers}
    assert numbers == set(said)
    wrong = {}
    for name, text in said.items():
        first = re.match(r"([A-Z]\d+(?:, [A-Z]\d+)*): ", text)
        cited = set(first[1].split(", ")) if first else set()
        if (not cited and name not in UNITS) or not cited <= labels:
            wrong[name] = text
    assert wrong == {}


@pytest.mark.parametrize("home", ["rounding.py", "network_charges.py"])
def test_a_charge_is_defined_once(home: str) -> None:
    """A second definition of a name would change what was charged by the first one."""
    tree = ast.parse((HOME.parent / home).read_text())
    stored = [node for statement in tree.body for node in ast.walk(statement) if isinstance(statement, ast.Assign)]
    names = [node.id for node in stored if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)]
    assert names and sorted(set(names)) == sorted(names)


def test_every_charge_is_used() -> None:
    used: set[str] = set()
    for path in PACKAGE.rglob("*.py"):
        names = re.findall(r"\b[A-Z][A-Z0-9_]+\b", path.read_text(encoding="utf-8"))
        used |= {name for name in names if path != HOME or names.count(name) > 1}
    assert sorted(set(stated()) - used) == []


#: Polynomials that fields are bounded with: number of variables, degree, grid.
BASES = [(d, *size) for d, size in ray_field._DEGREES.items()] + [(1, *ray_field._SHALLOW_DEGREE)]
BASES += [(d, 1, 2) for d in (5, 6, 7)]


@pytest.mark.parametrize(("dimensions", "degree", "grid"), BASES)
def test_interpolation_is_charged_for_its_matrices(dimensions: int, degree: int, grid: int) -> None:
    """All coefficients are off by no more than `interpolation_rounding`, whatever the values and the order of sums."""
    basis = ChebyshevBasis(dimensions, degree, grid)
    matrix = np.concatenate(basis.interpolation)
    n = degree + 1
    with mpmath.workprec(120):
        exact = [
            [mpmath.cos(k * mpmath.pi * (i + mpmath.mpf(1) / 2) / n) * (2 if k else 1) / n for i in range(n)]
            for k in range(n)
        ]
    # its entries are products of these, in the same order of nodes; float64 of each is exact enough by axis but one
    by_axis = np.array(exact, np.float64)
    places = np.array(list(np.ndindex(*(n,) * dimensions))).reshape(n**dimensions, dimensions)
    kept = basis.indices.tolist()
    rest = [k for k in places.tolist() if sum(k) > degree]
    rows = np.array([*kept, *rest], np.int64).reshape(len(matrix), dimensions)
    true = np.ones(matrix.shape)
    for axis in range(dimensions):
        true *= by_axis[rows[:, axis, None], places[None, :, axis]]
    size = np.abs(true)
    entries = np.abs(matrix - true) + (2.0 * dimensions * rounding.UNIT64) * size
    terms = len(places)
    needed = float(entries.sum()) + rounding.gamma(terms + 1) * float(size.sum())
    # a function of a node is off by four units as well
    needed += rounding.FUNCTION_ROUNDING * float(size.sum())
    assert needed <= basis.interpolation_rounding
    # and no more than a few times that is charged where much is
    assert dimensions == 0 or basis.interpolation_rounding < 4.0 * needed or terms < 16


def test_turns_near_one_are_charged_absolutely() -> None:
    """One less a block's turn is a lower bound, however little of it is left (design.md, O1)."""
    random, below = np.random.default_rng(0), 0
    for _ in range(400):
        m = int(random.integers(2, 9))
        slope, ray = random.normal(size=(m + 1, 3)), random.normal(size=3)
        slope[m] = np.abs(slope[m]) * random.choice([0.0, 1e-3])
        slope *= (1.0 - 10.0 ** random.uniform(-9.0, -3.0)) / depth_pairs._turn(slope, ray, m)
        along = depth_pairs._turn(slope, ray, m)
        rows = [[Fraction(float(x)) for x in row] for row in slope]
        there = [Fraction(float(x)) for x in ray]
        true = sum((abs(sum(a * b for a, b in zip(row, there, strict=True))) for row in rows[1:m]), Fraction(0))
        true += sum(a * abs(b) for a, b in zip(rows[m], there, strict=True))
        assert Fraction(float(depth_pairs._steadiness(along))) <= 1 - true
        below += Fraction((1.0 - along) * (1.0 - rounding.TURN_ROOM)) > 1 - true
    # a part of the difference would not do
    assert below > 0
