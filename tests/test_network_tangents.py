"""Lines that rows choose: tangents and slopes against 200-bit balls, and bounds of whole networks with them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import flint
import numpy as np
import pytest
import torch
from flint import arb
from onnx_files import OnnxFile
from test_network_curves import CURVES, Exact, above, below, intervals, points

from ns_abstract.arithmetic.network_charges import UNIT
from ns_abstract.verify.network import ImageSets, bound_outputs
from ns_abstract.verify.network.graph import NetworkArithmetic
from ns_abstract.verify.network.layers import Activation, LeakyRelu
from ns_abstract.verify.network.load import load_network, read_onnx
from ns_abstract.verify.network.relaxations import Relaxations
from ns_abstract.verify.network.scalar_function import ScalarFunction, Tangents
from ns_abstract.verify.network.slope_choices import UnstableNeurons

BENT = [name for name, (curve, _, _) in CURVES.items() if any(curve.bends)]
DOUBLE = torch.float64


def ends_of_part(curve: ScalarFunction, tangents: Tangents) -> tuple[torch.Tensor, torch.Tensor]:
    """Of the one part that bends towards the side, also where tangents cross the function elsewhere."""
    edges = [tangents.lower, *(torch.full_like(tangents.lower, b) for b in curve.breaks), tangents.upper]
    edges = [torch.minimum(torch.maximum(edge, tangents.lower), tangents.upper) for edge in edges]
    first, last = tangents.first.clone(), tangents.last.clone()
    for before, after, bend in zip(edges[:-1], edges[1:], curve.bends, strict=True):
        here = (after > before) & (bend == -tangents.side)
        first, last = torch.where(here, before, first), torch.where(here, after, last)
    return first, last


@pytest.mark.parametrize("name", BENT)
def test_tangents_are_on_one_side(name: str) -> None:
    """Whatever they touch of the part that bends towards the side, with slopes of either type."""
    curve, exact, range_ = CURVES[name]
    lower, upper = intervals(*range_)
    rng, tried = np.random.default_rng(0), 0
    with flint.ctx.workprec(200):
        for side, holds in ((-1.0, below), (1.0, above)):
            tangents = Tangents.of(curve, lower, upper, side)
            at = tangents.known.nonzero()[:, 0]
            tangents = tangents[at]
            for dtype in (torch.float32, DOUBLE):
                part = torch.from_numpy(rng.choice([0.0, 1.0, *rng.uniform(size=3)], len(at)))
                first, last = ends_of_part(curve, tangents)
                t = torch.minimum(first + part * (last - first), last)
                slope, offset = tangents.line(t, dtype)
                for k in range(len(at)):
                    ends = float(tangents.lower[k]), float(tangents.upper[k])
                    for z in [float(t[k]), *points(*ends, curve.breaks)]:
                        tried += 1
                        assert holds(float(slope[k]), float(offset[k]), min(max(z, ends[0]), ends[1]), exact)
    assert tried > 100


def test_rounded_slopes_are_charged() -> None:
    """A slope near 1 is rounded by more than a flat curve bends away from its tangent."""
    curve, exact, _ = CURVES["softplus"]
    lower, upper = torch.full((40,), 10.0, dtype=DOUBLE), torch.full((40,), 25.0, dtype=DOUBLE)
    t = torch.linspace(15.0, 18.0, 40, dtype=DOUBLE)
    slope, offset = Tangents.of(curve, lower, upper, -1.0).line(t, torch.float32)
    with flint.ctx.workprec(200):
        for k in range(40):
            for z in np.linspace(float(t[k]) - 0.5, float(t[k]) + 0.5, 11):
                assert below(float(slope[k]), float(offset[k]), z, exact)


def neurons(layer: Activation, lower: torch.Tensor, upper: torch.Tensor, dtype: torch.dtype) -> UnstableNeurons:
    """Neurons of one cell about references of their own, whose rows are not charged."""
    count = len(lower)
    rng = np.random.default_rng(3)
    reference = lower.numpy() + rng.uniform(-0.2, 1.2, count) * (upper - lower).numpy()
    image, none = rng.normal(size=count), np.zeros(count)
    relaxations = Relaxations(dtype, UNIT, 2.0**-45)
    return UnstableNeurons(
        none.astype(int),
        np.arange(count),
        lower.numpy(),
        upper.numpy(),
        reference,
        image,
        none,
        none,
        layer,
        relaxations,
    )


@pytest.mark.parametrize("name", ["leaky relu", "sigmoid", "tanh", "gelu", "silu", "exp", "elu"])
@pytest.mark.parametrize("dtype", [torch.float32, DOUBLE])
def test_chosen_lines_enclose_the_function(name: str, dtype: torch.dtype) -> None:
    """As rows take them, about references; on both sides of a row."""
    layer: Activation
    exact: Exact
    if name == "leaky relu":
        layer, exact, range_ = LeakyRelu((1,), 0.25), lambda z: z if z > 0 else z / 4, (-3.0, 3.0)
    else:
        layer, exact, range_ = CURVES[name]
    lower, upper = intervals(*range_)
    wide = upper - lower > 1e-6
    if name == "leaky relu":
        wide = (lower < 0.0) & (upper > 0.0)
    lower, upper = lower[wide], upper[wide]
    own, rng = neurons(layer, lower, upper, dtype), np.random.default_rng(4)
    choices = own.choices(0)
    assert choices
    for choice in choices:
        units, number = choice.units, choice.units.relaxations.number
        lines = np.full((6, 3, len(lower)), np.nan, number)
        # a step too far is no line that crosses the function
        choice.put(rng.uniform(-0.3, 1.3, (3, len(units.flat))), lines)
        with flint.ctx.workprec(200):
            for k, flat in enumerate(units.flat):
                for slope, one, two in (lines[:3, :, flat].T.tolist(), lines[[3, 5, 4]][:, :, flat].T.tolist())[
                    bool(np.isnan(lines[0, 0, flat]))
                ]:
                    for z in points(float(units.lower[k]), float(units.upper[k]), ()):
                        shift = arb(units.reference[k]) * slope - arb(units.image[k])
                        value = exact(arb(z)) - arb(slope) * arb(z) + shift
                        assert value - arb(one) >= 0 and arb(two) - value >= 0


def mlp(folder: Path, function: str, seed: int) -> tuple[Path, Sequence[tuple[np.ndarray, np.ndarray]]]:
    """Three fully connected layers with a function between, and their constants."""
    rng = np.random.default_rng(seed)
    f, layers = OnnxFile((6,), seed), []
    for before, after in ((6, 8), (8, 8), (8, 3)):
        weight = (1.6 * rng.normal(size=(before, after)) / before**0.5).astype(np.float32)
        bias = rng.normal(scale=0.3, size=after).astype(np.float32)
        if layers:
            f.node(function)
        f.node("Add", f.node("MatMul", f.last, f.constant(weight)), f.constant(bias))
        layers.append((weight, bias))
    return f.write(folder / "network.onnx"), layers


def outputs(layers: Sequence[tuple[np.ndarray, np.ndarray]], function: Exact, x: np.ndarray) -> list[arb]:
    values = [arb(float(v)) for v in x]
    for number, (weight, bias) in enumerate(layers):
        values = [function(v) for v in values] if number else values
        columns = zip(weight.T.tolist(), bias.tolist(), strict=True)
        values = [sum((arb(w) * v for w, v in zip(column, values, strict=True)), arb(b)) for column, b in columns]
    return values


@pytest.mark.parametrize(
    ("function", "arithmetic"), [("Sigmoid", "real"), ("Tanh", "float32"), ("Gelu", "real"), ("Relu", "real")]
)
def test_bounds_with_chosen_lines_everywhere(function: str, arithmetic: NetworkArithmetic, tmp_path: Path) -> None:
    """Below exact values, not far below them, and tighter than without."""
    file, layers = mlp(tmp_path, function, 1)
    exact = {"Relu": lambda z: z.max(arb(0)), "Gelu": CURVES["gelu"][1]}.get(function) or CURVES[function.lower()][1]
    network = (read_onnx if function == "Gelu" else load_network)(file)
    rng = np.random.default_rng(2)
    x, rows = rng.normal(size=6), np.concatenate([np.eye(3), -np.eye(3)])
    low, high = (x + side * 0.25 for side in (-1.0, 1.0))
    none = np.zeros((1, 6, 1))
    images = ImageSets(none, low[None], none, high[None], low[None], high[None])
    found = {
        steps: bound_outputs(
            network, images, rows, np.zeros(6), arithmetic=arithmetic, slope_steps=steps, intermediate_steps=steps
        ).lower[0]
        for steps in (0, 10)
    }
    tries = np.concatenate([rng.uniform(low, high, (20, 6)), np.where(rng.random((40, 6)) < 0.5, low, high)])
    with flint.ctx.workprec(200):
        for v in tries:
            for k, value in enumerate(outputs(layers, exact, v)):
                assert all(
                    value >= arb(float(lower[k])) and value <= -arb(float(lower[3 + k])) for lower in found.values()
                )
    assert found[10].sum() > found[0].sum() + 1e-3
    assert (found[10] >= found[0] - 1e-5).all()
