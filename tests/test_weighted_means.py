"""Weighted means written about their value at one input (design.md, N26)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ns_abstract.execution.cancellation import Deadline
from ns_abstract.verify import box_decisions
from ns_abstract.verify.network import ImageSets, Network, NetworkArithmetic, bound_outputs
from ns_abstract.verify.network.activations import Power, Reciprocal
from ns_abstract.verify.network.composite_layers import CompositeBuilder
from ns_abstract.verify.network.weighted_means import centred
from ns_abstract.verify.vnnlib_sets import InputRegion, UnsafeSet

WEIGHTS = np.array([[10.0, 20.0, 40.0, 80.0, 160.0, 320.0], [3.0, 1.0, 4.0, 1.0, 5.0, 9.0]])


def mean_network(weight: np.ndarray = WEIGHTS, sums: np.ndarray | None = None, power: int = 3) -> Network:
    """``weight p / (sums p)`` for powers p of six numbers near 100 that depend on four inputs."""
    generator = np.random.default_rng(4)
    builder = CompositeBuilder(Path("mean"), (4,))
    z = builder.matrix(0, generator.normal(0.0, 3.0, (6, 4)), 100.0 + generator.normal(0.0, 9.0, 6))
    p = builder.curve(builder.leaky_relu(z, 0.0), Power, exponent=power)
    if sums is None:
        total = builder.reduce(p, [0], False, False)
    else:
        total = builder._sparse(p, (1,), np.zeros(6, np.int64), np.arange(6), sums)
    shares = builder.product(p, builder.spread(builder.reciprocal(total), (6,)))
    return builder.network(builder.matrix(shares, weight, None))


def box(radius: float) -> ImageSets:
    lower, upper, none = np.full((1, 4), -radius), np.full((1, 4), radius), np.zeros((1, 4, 1))
    return ImageSets(none, lower, none, upper, lower, upper)


def test_equal_and_much_tighter() -> None:
    network = mean_network()
    moved = centred(network, torch.zeros(1, 4, dtype=torch.float64))
    assert moved is not network
    x = 2.0 * torch.rand(500, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) - 1.0
    values = network(x).numpy()
    np.testing.assert_allclose(moved(x).numpy(), values, rtol=1e-13)
    rows = np.concatenate([np.eye(2), -np.eye(2)])
    bounds = [bound_outputs(one, box(1.0), rows, np.zeros(4), arithmetic="real").lower[0] for one in (network, moved)]
    assert (bounds[1] <= (values @ rows.T).min(0)).all()
    widths = [-(lower[:2] + lower[2:]) for lower in bounds]
    assert (widths[1] < 0.6 * widths[0]).all()


def test_numbers_that_are_no_shares_stay() -> None:
    image = torch.zeros(1, 4, dtype=torch.float64)
    unequal = mean_network(sums=np.array([1.0, 1.0, 2.0, 1.0, 1.0, 1.0]))
    assert centred(unequal, image) is unequal
    # no number of float32 is 2^-30 less a whole number
    small = mean_network(weight=WEIGHTS + 2.0**-30)
    assert centred(small, image) is small


@pytest.mark.parametrize("shift", [0.0, 1.0])
def test_large_sums_have_tight_reciprocals(shift: float) -> None:
    lower, upper = torch.tensor([1e8 + shift], dtype=torch.float64), torch.tensor([1.2e8], dtype=torch.float64)
    least, most = Reciprocal((1,)).range(lower, upper)
    assert 0.999 / 1.2e8 < float(least) <= 1 / 1.2e8
    assert 1 / float(lower) <= float(most) < 1.001 / 1e8


def test_float32_computes_something_else(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is equal in real arithmetic is bounded where that is asked for, and only there."""
    network, seen = mean_network(), []

    def noticed(*given: Any) -> Network:
        seen.append(given)
        return centred(*given)

    def run(x: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return network(torch.from_numpy(x).double()).numpy()

    monkeypatch.setattr(box_decisions, "centred", noticed)
    unsafe = UnsafeSet(np.array([[1.0, 0.0]]), np.zeros(1), ((0,),), 0)
    region = InputRegion(np.full(4, -0.1), np.full(4, 0.1), unsafe)
    kinds: tuple[tuple[NetworkArithmetic, int], ...] = (("float32", 0), ("real", 1))
    for arithmetic, count in kinds:
        found = box_decisions.decide(network, run, [region], Deadline(60.0), arithmetic=arithmetic)
        assert found.word == "unsat" and len(seen) == count
