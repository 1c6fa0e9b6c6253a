"""The table of the charges of networks: every layer is in it, every number of a proof, and what layers charge is it."""

from __future__ import annotations

import ast
import inspect
import math
import re
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from benchmark_scripts import script
from onnx_files import OnnxFile

import ns_abstract
from ns_abstract.arithmetic import network_charges
from ns_abstract.io.errors import InputError
from ns_abstract.verify.network import (
    activations,
    bilinear,
    composite_activations,
    inexact_constants,
    layers,
    max_pooling,
    sparse_layers,
)
from ns_abstract.verify.network import rounding as network_rounding
from ns_abstract.verify.network.layers import Activation
from ns_abstract.verify.network.load import read_onnx

ledger = script("network_ledger")
table = script("network_table")
FUNCTIONS, ROWS, SYMBOLS = table.FUNCTIONS, table.ROWS, table.SYMBOLS
attack = script("network_attack")

NETWORK = Path(ns_abstract.__file__).parent / "verify" / "network"
DESIGN = Path(__file__).resolve().parents[1] / "docs" / "dev" / "design.md"
CONSTANTS = {name: value for name, value in vars(network_charges).items() if name.isupper()}
#: Names of the modules above that are no layers by themselves.
BASES = {"Activation", "LibraryFunction", "ScalarFunction", "Weighted", "LinearRelaxation", "ResizeAxis", "WindowLayer"}
#: Numbers that no proof rests on: defaults of torch's operators, limits of what is read, sizes of memory.
PREFERENCES = re.compile(
    r"a\.get\(\"eps|LEAST_DIVISOR < value <|GiB|2\*\*31|_LARGE|normal\(size=shape\)|"
    r"np\.log\(max|clamp\(min=2\.0\*\*-1000\)"
)


def found_layers() -> Iterator[type]:
    for module in (layers, sparse_layers, activations, composite_activations, inexact_constants, max_pooling, bilinear):
        for name, kind in vars(module).items():
            own = inspect.isclass(kind) and kind.__module__ == module.__name__ and not name.startswith("_")
            if own and issubclass(kind, (layers.LinearLayer, Activation, max_pooling.MaxPool, bilinear.Product)):
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
        ("sigmoid, tanh", activations.Sigmoid(shape)),
        ("sigmoid, tanh", activations.Tanh(shape)),
        ("clip", activations.Clip(shape, least=-1.0, most=2.0)),
        ("hard sigmoid", activations.Clip(shape, factor=0.2, offset=0.5)),
        ("absolute value", activations.Abs(shape)),
        ("hard swish", activations.HardSwish(shape)),
        ("hard swish", composite_activations.GatedClip(shape, factor=0.17)),
        ("square", activations.Power(shape)),
        ("power of a whole number", activations.Power(shape, exponent=5)),
        ("reciprocal, quotient", activations.Reciprocal(shape)),
        ("reciprocal, quotient", composite_activations.SoftmaxReciprocal(shape)),
        ("share of a sum that is cut off", composite_activations.SoftmaxReciprocal(shape)),
        ("root", activations.Root(shape)),
        ("reciprocal root", activations.Root(shape, inverse=True)),
        ("power of positive numbers", activations.PositivePower(shape)),
        ("power of positive numbers", activations.PositivePower(shape, exponent=1.7)),
        ("exponential", activations.Exp(shape)),
        ("softmax's exponentials", composite_activations.CappedExp(shape, count=200)),
        ("logarithm", activations.Log(shape)),
        ("softplus", activations.Softplus(shape)),
        ("softplus", composite_activations.SwitchedSoftplus(shape, limit=20.0, excess=1e-7)),
        ("switched softplus", composite_activations.SwitchedSoftplus(shape, limit=20.0, excess=1e-7)),
        ("ELU, SELU, CELU", activations.Elu(shape, alpha=1.5, scale=1.1)),
        ("error function", activations.Erf(shape)),
        ("SiLU, GELU, Mish", activations.Silu(shape)),
        ("SiLU, GELU, Mish", activations.Gelu(shape)),
        ("SiLU, GELU, Mish", activations.GeluTanh(shape)),
        ("SiLU, GELU, Mish", activations.Mish(shape)),
        ("SiLU, GELU, Mish", composite_activations.ScaledGelu(shape, rate=1.001)),
        ("functions with constants of the file", composite_activations.ScaledGelu(shape, rate=1.001)),
        ("functions with constants of the file", composite_activations.GatedClip(shape)),
        ("values in steps", composite_activations.Quantised(shape, least=-128.0, most=127.0, step=0.5)),
    ]


INSTANCES = instances()


@pytest.mark.parametrize(("kind", "layer"), INSTANCES, ids=[f"{k}-{type(v).__name__}" for k, v in INSTANCES])
def test_layers_charge_what_the_table_says(kind: str, layer: Any) -> None:
    (row,) = (row for row in ROWS if row.kind == kind)
    assert type(layer).__name__ in row.layers
    for low, high in ((0.25, 0.5), (0.25, 25.0), (0.0625, 0.0625), (1e20, 1e30), (-3.0, 2.0), (-2.0, -0.5), (0.0, 1.0)):
        lower, upper = torch.tensor([low], dtype=torch.float64), torch.tensor([high], dtype=torch.float64)
        found = layer.missing(lower, upper) if row.real else layer.error(lower, upper)
        names = {name: getattr(layer, name) for name in dir(layer) if not name.startswith("_")}
        own = {"lower": low, "upper": high, "size": max(abs(low), abs(high))}
        functions = {"exp": math.exp, "log": math.log, "sqrt": math.sqrt}
        try:
            wanted = eval(row.charge, {}, {**names, **CONSTANTS, **functions, **own})
        except (ValueError, OverflowError, ZeroDivisionError):
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


@pytest.mark.slow_cases(every=30)
@pytest.mark.parametrize("kind", ledger.MEASURED)
def test_every_charge_pays(kind: str) -> None:
    """No float32 program is farther from the value with 200 bits than is charged; nor are real bounds from it."""
    entry = ledger.ratios(1, 2, (kind,), sizes=(6,))[kind]
    assert entry.compared > 100 and entry.ratio <= 1.0 and not entry.outside_real, entry


def _row(kind: str) -> Any:
    return next(row for row in ROWS if row.kind == kind)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["layer of sums: fully connected, (transposed) convolution, mean, average pooling"])
def test_the_ledger_sees_what_is_not_charged(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bounds without a float32 charge are left by float32 programs."""
    assert _row(kind).layers
    monkeypatch.setattr(ledger, "bound_outputs", lambda *a, **k: _bound(*a, **{**k, "arithmetic": "real"}))
    assert ledger.ratios(1, 2, (kind,))[kind].ratio > 1.0


_bound = ledger.bound_outputs


# ---------------------------------------------------------------- what the ledger and its making found


@pytest.mark.parametrize("flavour", ["subnormal", "cancelling"])
def test_cubic_weights_are_charged_in_real_arithmetic(flavour: str) -> None:
    """Weights of resized maps are rounded by float64, too."""
    entry = ledger.Entry()
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(4):
            ledger.measure(ledger.case(("cubic map",), flavour, seed, 4), entry, Path(folder))
    assert entry.compared and not entry.outside_real and entry.ratio <= 1.0


@pytest.mark.parametrize("kind", ["flushed", "product", "squares", "norm", "mean", "matrix"])
def test_constants_that_pass_the_ends_of_float32(kind: str, tmp_path: Path) -> None:
    """A constant that is computed may overflow or be flushed on the way, though its value is ordinary."""
    f = OnnxFile((1,))
    up, down = f.constant([2.0**100, 2.0**100]), f.constant([2.0**-100, 2.0**-100])
    both = f.node("Concat", down, up, axis=0)
    if kind == "flushed":
        quiet = f.constant([2.0**-100, 2.0**-60, 1.5, 2.0**120])
        made = f.node("Mul", f.node("ReduceProd", quiet, keepdims=0), f.constant(2.0**40))
    elif kind == "product":
        made = f.node("ReduceProd", both, keepdims=0)
    elif kind == "squares":
        made = f.node("Mul", f.node("ReduceL2", up, keepdims=0), f.constant(2.0**-100))
    elif kind == "norm":
        made = f.node("ReduceL2", down, keepdims=0)
    elif kind == "mean":
        made = f.node("Mul", f.node("ReduceMean", f.constant([2.0**125] * 8), keepdims=0), f.constant(2.0**-125))
    else:
        one = f.node("Unsqueeze", up, f.constant([0], np.int64))
        other = f.node("Unsqueeze", f.constant([2.0**100, -(2.0**100)]), f.constant([1], np.int64))
        made = f.node("Reshape", f.node("MatMul", one, other), f.constant([1], np.int64))
    f.node("Mul", "image", made)
    file = f.write(tmp_path / "net.onnx")
    if kind in ("flushed", "norm"):
        low, high = attack.bounds(read_onnx(file), np.ones(1))
        exact = 1.5 if kind == "flushed" else 2.0**-99.5
        # products that begin with the small numbers are flushed to zero
        assert low[0] <= 0.0 and high[0] >= exact
    else:
        with pytest.raises(InputError, match="overflow"):
            read_onnx(file)


def test_defaults_are_float32_numbers(tmp_path: Path) -> None:
    """An attribute that a file leaves out is the number that it would hold."""
    found = []
    for given in ({}, {"alpha": 0.01}):
        f = OnnxFile((1,))
        f.node("LeakyRelu", **given)
        network = read_onnx(f.write(tmp_path / "net.onnx"))
        assert isinstance(network.nodes[0].layer, layers.LeakyRelu)
        found.append(network.nodes[0].layer.alpha)
    assert found == [float(np.float32(0.01))] * 2


# ---------------------------------------------------------------- the attack


@pytest.mark.slow
def test_no_network_is_found_outside() -> None:
    """A short part of the search that `benchmarks/network_attack.py` makes for an hour."""
    found = attack.attack(1e9, 47, networks=140)
    assert found.networks == 140 and found.finite > 60 and found.compared > 3000
    assert found.outside == []


def test_the_attack_finds_what_is_not_charged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sums without a charge are left after a few networks."""
    monkeypatch.setattr(network_rounding, "gamma", lambda count, unit=None: 0.0 * count)
    assert attack.attack(1e9, 0, ("gemm", "sum", "mean"), networks=40).outside
