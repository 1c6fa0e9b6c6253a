"""The table of the charges of networks: every layer is in it, every number of a proof, and what layers charge is it."""

from __future__ import annotations

import ast
import inspect
import math
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from benchmark_scripts import script

import ns_abstract
from ns_abstract.arithmetic import network_charges
from ns_abstract.arithmetic.network_table import FUNCTIONS, ROWS, SYMBOLS, Row
from ns_abstract.verify.network import curves, doubtful, layers, maps, maxima, products, recognised
from ns_abstract.verify.network.layers import Activation

ledger = script("network_ledger")

NETWORK = Path(ns_abstract.__file__).parent / "verify" / "network"
DESIGN = Path(__file__).resolve().parents[1] / "docs" / "design.md"
CONSTANTS = {name: value for name, value in vars(network_charges).items() if name.isupper()}
#: Names of the modules above that are no layers by themselves.
BASES = {"Activation", "Assumed", "Curve", "Weighted", "Lines", "Axis"}
#: Numbers that no proof rests on: defaults of torch's operators, limits of what is read, sizes of memory.
PREFERENCES = re.compile(
    r"a\.get\(\"eps|not 0\.0 < value <|GiB|2\*\*31|_LARGE|normal\(size=shape\)|np\.log\(max|clamp\(min=2\.0\*\*-1000\)"
)


def found_layers() -> Iterator[type]:
    for module in (layers, maps, curves, recognised, doubtful, maxima, products):
        for name, kind in vars(module).items():
            own = inspect.isclass(kind) and kind.__module__ == module.__name__ and not name.startswith("_")
            if own and issubclass(kind, (layers.Linear, Activation, maxima.MaxPool, products.Product)):
                yield kind


def test_every_layer_has_a_row() -> None:
    named = {name for row in ROWS for name in row.layers}
    classes = {kind.__name__ for kind in found_layers()} - BASES
    assert classes == named


def test_rows_name_what_there_is() -> None:
    """Constants, symbols and attributes in an expression exist, and so do the labels."""
    design = DESIGN.read_text(encoding="utf-8") if DESIGN.exists() else ""
    kinds = {kind.__name__: kind for kind in found_layers()}
    assert len({row.kind for row in ROWS}) == len(ROWS)
    for row in ROWS:
        for name in re.findall(r"\b[A-Z][A-Z_]+\b", row.charge):
            assert name in CONSTANTS, f"{row.kind}: {name}"
        for label in row.labels.split(", "):
            assert f"\n**{label} (" in design or not design, f"{row.kind}: {label}"
        if row in FUNCTIONS:
            own = {k for name in row.layers for k in dir(kinds[name])}
            own.update(("exp", "log", "sqrt", "min", "max", "abs", "and", "if", "else"))
            for name in re.findall(r"\b[a-z]\w*\b", row.charge):
                assert name in SYMBOLS or name in own, f"{row.kind}: {name}"


def test_every_constant_is_used_and_every_charge_in_a_row() -> None:
    """No constant is left over; those that pay for a program's rounding are in the table."""
    words: Counter[str] = Counter()
    for path in NETWORK.parents[1].rglob("*.py"):
        words.update(re.findall(r"\b[A-Z][A-Z_]+\b", path.read_text(encoding="utf-8")))
    assert {name for name in CONSTANTS if words[name] < 2} == set()
    text = Path(network_charges.__file__).read_text(encoding="utf-8")
    tabled = " ".join(row.charge + row.programs for row in ROWS)
    parts = re.split(r"\n# -{16} ", text)
    for part in parts[1:5]:
        for name in re.findall(r"^([A-Z_]+) = ", part, re.MULTILINE):
            if not name.startswith(("OWN_", "SPARE", "DOUBTS", "FORMATS", "EXACT", "NEAR")):
                assert re.search(rf"\b{name}\b", tabled), f"no row names {name}"


# ---------------------------------------------------------------- the rows are what layers charge


def instances() -> list[tuple[str, Activation]]:
    shape = (1,)
    return [
        ("ReLU", layers.LeakyRelu(shape)),
        ("leaky ReLU", layers.LeakyRelu(shape, 0.1)),
        ("sigmoid, tanh", layers.Sigmoid(shape)),
        ("sigmoid, tanh", layers.Tanh(shape)),
        ("clip", curves.Clip(shape, least=-1.0, most=2.0)),
        ("hard sigmoid", curves.Clip(shape, factor=0.2, offset=0.5)),
        ("absolute value", curves.Abs(shape)),
        ("hard swish", curves.HardSwish(shape)),
        ("hard swish", recognised.GatedClip(shape, factor=0.17)),
        ("square", curves.Power(shape)),
        ("power of a whole number", curves.Power(shape, exponent=5)),
        ("reciprocal, quotient", curves.Reciprocal(shape)),
        ("reciprocal, quotient", curves.Share(shape)),
        ("share of a sum that is cut off", curves.Share(shape)),
        ("root", curves.Root(shape)),
        ("reciprocal root", curves.Root(shape, inverse=True)),
        ("exponential", curves.Exp(shape)),
        ("softmax's exponentials", curves.CappedExp(shape, count=200)),
        ("logarithm", curves.Log(shape)),
        ("softplus", curves.Softplus(shape)),
        ("softplus", recognised.SwitchedSoftplus(shape, limit=20.0, excess=1e-7)),
        ("switched softplus", recognised.SwitchedSoftplus(shape, limit=20.0, excess=1e-7)),
        ("ELU, SELU, CELU", curves.Elu(shape, alpha=1.5, scale=1.1)),
        ("error function", curves.Erf(shape)),
        ("SiLU, GELU, Mish", curves.Silu(shape)),
        ("SiLU, GELU, Mish", curves.Gelu(shape)),
        ("SiLU, GELU, Mish", curves.GeluTanh(shape)),
        ("SiLU, GELU, Mish", curves.Mish(shape)),
        ("SiLU, GELU, Mish", recognised.ScaledGelu(shape, rate=1.001)),
        ("functions with constants of the file", recognised.ScaledGelu(shape, rate=1.001)),
        ("functions with constants of the file", recognised.GatedClip(shape)),
        ("values in steps", recognised.Quantised(shape, least=-128.0, most=127.0, step=0.5)),
    ]


INSTANCES = instances()


@pytest.mark.parametrize(("kind", "layer"), INSTANCES, ids=[f"{k}-{type(v).__name__}" for k, v in INSTANCES])
def test_layers_charge_what_the_table_says(kind: str, layer: Any) -> None:
    (row,) = (row for row in ROWS if row.kind == kind)
    assert type(layer).__name__ in row.layers
    for low, high in ((0.25, 0.5), (0.25, 25.0), (0.0625, 0.0625), (1e20, 1e30), (-3.0, 2.0), (-2.0, -0.5)):
        lower, upper = torch.tensor([low], dtype=torch.float64), torch.tensor([high], dtype=torch.float64)
        found = layer.missing(lower, upper) if row.real else layer.error(lower, upper)
        names = {name: getattr(layer, name) for name in dir(layer) if not name.startswith("_")}
        own = {"lower": low, "upper": high, "size": max(abs(low), abs(high))}
        functions = {"exp": math.exp, "log": math.log, "sqrt": math.sqrt}
        try:
            wanted = eval(row.charge, {}, {**names, **CONSTANTS, **functions, **own})
        except (ValueError, OverflowError):
            continue
        value = float(torch.as_tensor(found, dtype=torch.float64))
        assert math.isnan(value) or value == pytest.approx(wanted, rel=1e-12, abs=0.0), (low, high)


def test_functions_have_instances() -> None:
    assert {row.kind for row in FUNCTIONS} == {kind for kind, _ in INSTANCES}
    assert {name for row in FUNCTIONS for name in row.layers} == {type(layer).__name__ for _, layer in INSTANCES}


# ---------------------------------------------------------------- no number of a proof is elsewhere


def numbers(path: Path) -> Iterator[tuple[int, float]]:
    """Tiny and huge numbers of a file but for preferences: constants that a comment calls so, or what is read."""
    text = path.read_text(encoding="utf-8")
    lines, tree = text.splitlines(), ast.parse(text)
    preferred: set[int] = set()
    for node in tree.body:
        if isinstance(node, ast.Assign):
            above = lines[node.lineno - 2] if node.lineno > 1 else ""
            if above.startswith(("#:", "_")):
                preferred.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    for node in ast.walk(tree):
        value = None
        if isinstance(node, ast.Constant) and isinstance(node.value, float):
            value = node.value
        elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow):
            base, power = node.left, node.right
            if isinstance(base, ast.Constant) and base.value in (2, 2.0, 10, 10.0) and not isinstance(power, ast.Name):
                try:
                    value = float(eval(ast.unparse(node), {}))
                except NameError:
                    continue
        if not value or 2.0**-10 <= abs(value) <= 2.0**16:
            continue
        if node.lineno not in preferred and not PREFERENCES.search(lines[node.lineno - 1]):
            yield node.lineno, value


def test_no_number_of_a_proof_is_elsewhere() -> None:
    bare = {f"{path.name}:{line}": value for path in sorted(NETWORK.glob("*.py")) for line, value in numbers(path)}
    assert bare == {}


def test_bare_numbers_are_found(tmp_path: Path) -> None:
    file = tmp_path / "layer.py"
    file.write_text("#: A preference.\n_FEW = 1e-9\n\ndef f(x):\n    return x * (1.0 + 2.0**-40) + 1e-12\n")
    assert sorted(value for _, value in numbers(file)) == [2.0**-40, 1e-12]


def test_the_page_is_what_the_table_makes() -> None:
    assert ledger.CHARGES.read_text(encoding="utf-8") == ledger.page()


# ---------------------------------------------------------------- the ledger


def test_the_ledger_measures_every_row() -> None:
    assert set(ledger.MEASURED) | set(ledger.UNMEASURED) == {row.kind for row in ROWS}
    assert not set(ledger.MEASURED) & set(ledger.UNMEASURED)


@pytest.mark.parametrize("kind", ledger.MEASURED)
def test_every_charge_pays(kind: str) -> None:
    """No float32 program is farther from the value with 200 bits than is charged; nor are real bounds from it."""
    entry = ledger.ratios(1, 2, (kind,))[kind]
    assert entry.compared > 100 and entry.ratio <= 1.0 and not entry.outside_real, entry


def _row(kind: str) -> Row:
    return next(row for row in ROWS if row.kind == kind)


@pytest.mark.parametrize("kind", ["layer of sums: fully connected, (transposed) convolution, mean, average pooling"])
def test_the_ledger_sees_what_is_not_charged(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bounds without a float32 charge are left by float32 programs."""
    assert _row(kind).layers
    monkeypatch.setattr(ledger, "bound_outputs", lambda *a, **k: _bound(*a, **{**k, "arithmetic": "real"}))
    assert ledger.ratios(1, 3, (kind,))[kind].ratio > 1.0


_bound = ledger.bound_outputs
