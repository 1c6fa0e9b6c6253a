"""Boxes of many inputs that one input dominates: cut across it, no part and no group is left out."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from onnx_files import OnnxFile

from ns_abstract.execution.cancellation import Deadline
from ns_abstract.verify import box_decisions
from ns_abstract.verify.network import Network, load_network
from ns_abstract.verify.network.dependence import input_shares
from ns_abstract.verify.network.graph import as_double
from ns_abstract.verify.network.layers import Matrix
from ns_abstract.verify.vnnlib_sets import InputRegion, UnsafeSet

INPUTS = 8


def wide(folder: Path, seed: int) -> tuple[Network, np.ndarray, np.ndarray]:
    """A network and a box in which the second input varies a hundred times as much as the others."""
    f = OnnxFile((INPUTS,), seed)
    f.relu_layers(INPUTS, 12, 12, 2)
    middle = np.random.default_rng(seed).uniform(-0.5, 0.5, INPUTS)
    half = np.where(np.arange(INPUTS) == 1, 2.0, 0.02)
    return load_network(f.write(folder / "wide.onnx")), middle - half, middle + half


def inputs(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Images of the box [4096, n], the second input from one end to the other."""
    x = lower + np.random.default_rng(1).uniform(size=(4096, INPUTS)) * (upper - lower)
    x[:, 1] = np.linspace(lower[1], upper[1], len(x))
    return x


def outputs(network: Network, x: np.ndarray) -> np.ndarray:
    return network(as_double(x)).numpy()


def answer(
    network: Network, lower: np.ndarray, upper: np.ndarray, offset: list[float], rows: np.ndarray
) -> box_decisions.Decision:
    """What is said of rows that are a group each, until time has been asked for often enough."""
    asked = iter(range(10**9))
    unsafe = UnsafeSet(rows, np.array(offset), tuple((k,) for k in range(len(rows))), 0)
    return box_decisions.decide(
        network, lambda image: np.full(2, np.nan), [InputRegion(lower, upper, unsafe)],
        Deadline(request=lambda: next(asked) > 4000), arithmetic="real",
    )  # fmt: skip


@pytest.fixture(autouse=True)
def proofs_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(box_decisions._BoxSearch, "_attack", lambda *given, **more: False)


def test_parts_are_those_of_the_first_layer(tmp_path: Path) -> None:
    """Before the only activation an input moves every neuron by its weight; one that does not vary has no part."""
    f = OnnxFile((4,), 1)
    f.gemm(4, 6)
    f.node("Relu")
    f.gemm(6, 2)
    network = load_network(f.write(tmp_path / "one.onnx"))
    layer = network.nodes[0].layer
    assert isinstance(layer, Matrix)
    lower, width = np.array([0.1, -0.2, 0.3, 0.0]), np.array([0.5, 0.0, 0.1, 2.0])
    moved = layer.weight.abs().sum(0).numpy() * width
    found = input_shares(network, lower, lower + width)
    assert found[1] == 0.0
    assert np.allclose(found, moved / moved.sum(), rtol=1e-9)
    assert (input_shares(network, lower, lower) == 0.0).all()


def test_halves_meet_and_are_smaller() -> None:
    """Across one input the halves share a face; across the others each is the box. One number has no halves."""
    lower, upper = np.array([-1.0, 0.1, 2.0]), np.array([1.0, np.nextafter(0.1, 1.0), 2.5])
    halves = box_decisions._halves(lower, upper, 2)
    assert halves is not None
    (first, face), (other, last) = halves
    assert face[2] == other[2] and lower[2] < face[2] < upper[2]
    assert (first == lower).all() and (last == upper).all()
    assert (face[:2] == upper[:2]).all() and (other[:2] == lower[:2]).all()
    assert box_decisions._halves(lower, upper, 1) is None


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 3])
def test_no_half_and_no_group_is_left_out(seed: int, tmp_path: Path) -> None:
    """What an input of either half reaches is never proved safe; a little less is."""
    network, lower, upper = wide(tmp_path, seed)
    x = inputs(lower, upper)
    y, rows = outputs(network, x)[:, 0], np.array([[1.0, 0.0], [-1.0, 0.0]])
    ends = [int(y.argmin()), int(y.argmax())]
    # one in each half
    assert sorted(end >= len(x) // 2 for end in ends) == [False, True]
    reached, size = [-y[ends[0]], y[ends[1]]], y.max() - y.min()
    safe = [v + 0.03 * size for v in reached]
    for k in range(2):
        broken = list(safe)
        broken[k] = reached[k] - 1e-9 * size
        assert answer(network, lower, upper, broken, rows).word in ("unknown", "timeout")
    assert answer(network, lower, upper, safe, rows).word == "unsat"


@pytest.mark.slow
def test_cutting_takes_fewer_bounds_than_assuming_phases(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    network, lower, upper = wide(tmp_path, 0)
    y, rows = outputs(network, inputs(lower, upper))[:, 0], np.array([[1.0, 0.0]])
    offset = [float(0.03 * (y.max() - y.min()) - y.min())]
    tuning, found = box_decisions.BoxTuning(), []
    for dominant in (tuning.dominant_share, np.inf):
        monkeypatch.setattr(box_decisions, "_TUNING", dataclasses.replace(tuning, dominant_share=dominant))
        found.append(answer(network, lower, upper, offset, rows))
    assert [one.word for one in found] == ["unsat", "unsat"]
    assert found[0].boxes < found[1].boxes
