"""Bounds of networks: an exact oracle, degenerate and extreme sets, modes, parts and dense or sparse rows."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from onnx_files import OnnxFile, attack, boxed, image_sets, members, session

from ns_abstract.arithmetic import network_charges
from ns_abstract.io.errors import InputError
from ns_abstract.verify.network import (
    ImageSets,
    Network,
    NetworkArithmetic,
    backward,
    bound_outputs,
    cost_model,
    intermediate_bounds,
    layers,
    load_network,
    max_pool_propagation,
    neuron_bounds,
    neuron_selection,
    output_bounds,
    work_budget,
)
from ns_abstract.verify.network.bounds import NetworkBounds
from ns_abstract.verify.network.coefficients import Coefficients, columns_of, concretize, full
from ns_abstract.verify.network.intermediate_bounds import IntermediateBounds
from ns_abstract.verify.network.layers import Convolution
from ns_abstract.verify.network.neuron_bounds import NeuronBounds
from ns_abstract.verify.network.stopping import BackwardBounds, NeuronTarget, StoppingCriterion

Vector = list[Fraction]
SHAPE = (2, 4, 4)


def mlp(
    folder: Path, seed: int, scale: float = 1.0, sizes: tuple[int, ...] = (3, 5, 4, 2)
) -> tuple[Network, list[tuple[np.ndarray, np.ndarray]], Path]:
    """A ReLU network and its weights."""
    from onnx import numpy_helper

    f = OnnxFile(sizes[:1], seed)
    for k, (before, after) in enumerate(itertools.pairwise(sizes)):
        if k:
            f.node("Relu")
        f.gemm(before, after, 1.0 if k else scale)
    file = f.write(folder / "mlp.onnx")
    arrays = [numpy_helper.to_array(c) for c in f.constants]
    return load_network(file), list(zip(arrays[::2], arrays[1::2], strict=True)), file


def affine(weight: np.ndarray, bias: np.ndarray, x: Vector) -> Vector:
    return [
        sum((Fraction(float(w)) * v for w, v in zip(row, x, strict=True)), Fraction(float(b)))
        for row, b in zip(weight, bias, strict=True)
    ]


def exact_least(layers: list[tuple[np.ndarray, np.ndarray]], b: np.ndarray, a: np.ndarray, row: np.ndarray) -> Fraction:
    """The least ``row @ y`` over x = b + a p, p in [-1, 1], in exact arithmetic.

    Along a line every number is piecewise linear in p; it is followed from kink to kink.
    """

    def pieces(ends: list[Fraction]) -> list[Fraction]:
        """All p where some number of some layer changes sign."""
        cuts = sorted(set(ends))
        for depth in range(len(layers) - 1):
            found = list(cuts)
            for low, high in itertools.pairwise(cuts):
                z0, z1 = (before(p, depth) for p in (low, high))
                for u, v in zip(z0, z1, strict=True):
                    if (u < 0) != (v < 0) and u != v:
                        found.append(low + (high - low) * u / (u - v))
            cuts = sorted(set(found))
        return cuts

    def before(p: Fraction, depth: int) -> Vector:
        x = [Fraction(float(v)) + Fraction(float(s)) * p for v, s in zip(b, a, strict=True)]
        for weight, bias in layers[:depth]:
            x = [max(v, Fraction(0)) for v in affine(weight, bias, x)]
        return affine(*layers[depth], x)

    def value(p: Fraction) -> Fraction:
        return sum((Fraction(float(r)) * v for r, v in zip(row, before(p, len(layers) - 1), strict=True)), Fraction(0))

    return min(value(p) for p in pieces([Fraction(-1), Fraction(1)]))


@pytest.mark.slow_cases(every=4)
@pytest.mark.parametrize("radius", [0.0, 1e-6, 0.1, 1.0, 30.0])
def test_bounds_lie_below_the_exact_minimum(radius: float, tmp_path: Path) -> None:
    gaps, spans = 0.0, 0.0
    for seed in range(6):
        network, layers, _ = mlp(tmp_path, seed)
        rng = np.random.default_rng(seed)
        b, a = rng.normal(size=(1, 3)), radius * rng.normal(size=(1, 3, 1))
        reach = np.abs(a[..., 0])
        rows = rng.normal(size=(3, 2))
        images = ImageSets(a, b, a, b, np.nextafter(b - reach, -np.inf), np.nextafter(b + reach, np.inf))
        found = bound_outputs(network, images, rows, np.zeros(3))
        middle = rows @ network(torch.from_numpy(b))[0].numpy()
        for k, row in enumerate(rows):
            least = exact_least(layers, b[0], a[0, :, 0], row)
            # the network's float32 rounding is inside, so the exact value is, too
            assert Fraction(float(found.lower[0, k])) <= least
            gaps, spans = gaps + middle[k] - found.lower[0, k], spans + middle[k] - float(least)
    if radius <= 1e-6:
        assert gaps <= spans + 18 * 2e-5
    else:
        assert gaps <= {0.1: 1.1, 1.0: 1.7, 30.0: 3.7}[radius] * spans


def test_the_oracle_finds_kinks() -> None:
    """|p| = relu(p) + relu(-p) is least at 0, which no end of the interval is."""
    one = np.array([[1.0], [-1.0]]), np.zeros(2)
    two = np.array([[1.0, 1.0]]), np.zeros(1)
    assert exact_least([one, two], np.array([0.25]), np.array([1.0]), np.array([1.0])) == 0


@pytest.mark.slow
def test_modes_are_ordered_on_average(tmp_path: Path) -> None:
    """Correlation helps; single bounds may be worse, as lines with less area are not always the better ones."""
    gains = []
    for seed in range(4):
        f = OnnxFile(SHAPE, seed)
        for _ in range(3):
            f.conv(int(f.shape[0]) if f.last == "image" else 4, 4, pads=[1, 1, 1, 1])
            f.node("Relu")
        f.node("Flatten")
        f.gemm(64, 3)
        network = load_network(f.write(tmp_path / "net.onnx"))
        images = image_sets(SHAPE, 3, 2, 0.3, 0.01, seed)
        rows = np.random.default_rng(seed).normal(size=(5, 3))
        box, sets = (bound_outputs(network, s, rows, np.zeros(5)).lower for s in (boxed(images), images))
        gains.append((sets - box).mean())
        assert ((sets >= box - 0.02 * (1 + np.abs(box))).mean()) > 0.9
    assert min(gains) > 0.0


def residual(folder: Path) -> Path:
    """Max pooling, two residual blocks with a stride between, and a linear layer."""
    f = OnnxFile((2, 16, 16), 3)
    f.conv(2, 6, pads=[1, 1, 1, 1])
    f.node("Relu")
    f.node("MaxPool", kernel_shape=[3, 3], strides=[2, 2], pads=[1, 1, 1, 1])
    for stride, size in ((1, 6), (2, 8)):
        before = f.last
        f.conv(6, size, pads=[1, 1, 1, 1], strides=[stride, stride])
        f.node("Relu")
        f.conv(size, size, pads=[1, 1, 1, 1])
        branch = f.last
        f.last = before
        if stride == 2:
            f.conv(6, size, k=1, strides=[2, 2])
        f.node("Add", branch, f.last)
        f.node("Relu")
    f.node("Flatten")
    f.gemm(128, 3)
    return f.write(folder / "residual.onnx")


@pytest.mark.slow
@pytest.mark.parametrize("allowed", [1e12, 3e6, 0.0])
def test_deep_networks_are_bounded(allowed: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rationed rows are sound, whatever they may take; with enough of them little is lost."""
    file = residual(tmp_path)
    network, rows = load_network(file), np.random.default_rng(0).normal(size=(4, 3))
    images = image_sets((2, 16, 16), 2, 2, 0.01, 0.002)
    plain = bound_outputs(network, images, rows, np.zeros(4))
    monkeypatch.setattr(cost_model, "_DEEP", 0.0)
    for module in (cost_model, work_budget):
        monkeypatch.setattr(module, "ALLOWED_PRODUCTS", allowed)
    for module in (cost_model, work_budget):
        monkeypatch.setattr(module, "PLANNED_PRODUCTS", allowed)
    threads = torch.get_num_threads()
    found = []
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            found.append(bound_outputs(network, images, rows, np.zeros(4)))
    finally:
        torch.set_num_threads(threads)
    middle = rows @ network(torch.from_numpy(0.5 * (images.lower + images.upper)).reshape(2, 2, 16, 16)).numpy().T
    for cell in range(2):
        least, _ = attack(network, session(file), images, cell, rows, 32, 5)
        for one in found:
            assert (one.lower[cell] <= least).all() and np.isfinite(one.lower).all()
    np.testing.assert_allclose(found[0].lower, found[1].lower, rtol=1e-5)
    gaps = [(middle.T - one.lower).mean() for one in (plain, found[0])]
    assert gaps[1] <= (1.1 if allowed > 1e9 else 1e4) * gaps[0]
    assert gaps[1] >= (0.9 if allowed else 1.1) * gaps[0]


@pytest.mark.slow
@pytest.mark.parametrize("enough", [0.0, 0.3, 1e9])
def test_rows_that_end_on_the_way_lie_below_the_exact_minimum(
    enough: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows for all numbers of a layer may end at an earlier one: what they say there holds, and is not for nothing."""
    monkeypatch.setattr(cost_model, "_DEEP", 0.0)
    monkeypatch.setattr(work_budget, "_SMALL_SHARE", 0.0)
    monkeypatch.setattr(work_budget, "_MANY_UNSTABLE", -1.0)
    monkeypatch.setattr(work_budget, "_STOPPING_WIDTH", enough)
    ended, said, gaps, spans = 0, {}, 0.0, 0.0
    one_hot, bounded = NeuronBounds._one_hot, NeuronBounds.bounded

    def watched(*arguments: Any) -> Any:
        nonlocal ended
        found = one_hot(*arguments)
        ended += int((found.ended > 0).sum())
        return found

    def heard(numbers: NeuronBounds, index: int, *arguments: Any) -> Any:
        said[index] = bounded(numbers, index, *arguments)
        return said[index]

    monkeypatch.setattr(NeuronBounds, "_one_hot", watched)
    monkeypatch.setattr(NeuronBounds, "bounded", heard)
    for seed in range(3):
        network, layers, _ = mlp(tmp_path, seed, sizes=(3, 6, 6, 6, 2))
        rng = np.random.default_rng(seed)
        b, a = rng.normal(size=(1, 3)), 0.7 * rng.normal(size=(1, 3, 1))
        reach, rows = np.abs(a[..., 0]), rng.normal(size=(3, 2))
        images = ImageSets(a, b, a, b, np.nextafter(b - reach, -np.inf), np.nextafter(b + reach, np.inf))
        middle = rows @ network(torch.from_numpy(b))[0].numpy()
        found = bound_outputs(network, images, rows, np.zeros(3), arithmetic="real")
        for k, row in enumerate(rows):
            least = exact_least(layers, b[0], a[0, :, 0], row)
            assert Fraction(float(found.lower[0, k])) <= least
            gaps, spans = gaps + middle[k] - found.lower[0, k], spans + middle[k] - float(least)
        assert set(said) == {3, 5}
        for index, form in said.items():
            for unit, (low, high) in enumerate(zip(*(v[0].tolist() for v in form.interval), strict=True)):
                least, most = (
                    exact_least(layers[: index // 2 + 1], b[0], a[0, :, 0], s * np.eye(6)[unit]) for s in (1, -1)
                )
                assert Fraction(low) <= least and -most <= Fraction(high)
    assert (ended > 0) == (enough > 0.0)
    assert gaps <= 3.0 * spans


def planned(monkeypatch: pytest.MonkeyPatch, which: int | None = None) -> list[cost_model.BackwardRoute]:
    """Let rows of all networks end by plan, or go the ``which``-th way of theirs; the ways that are gone."""
    monkeypatch.setattr(cost_model, "_DEEP", 0.0)
    monkeypatch.setattr(cost_model, "_OVER", 0.0)
    monkeypatch.setattr(cost_model, "_APART", 0.0)
    if which is not None:

        def ways(run: work_budget.WorkBudget, index: int, _: int) -> tuple[list[cost_model.BackwardRoute], float]:
            known = run.costs.routes(index)
            return [known[min(which, len(known) - 1)]], 0.0

        monkeypatch.setattr(work_budget.WorkBudget, "routes", ways)
    used: list[cost_model.BackwardRoute] = []
    ready = IntermediateBounds.ready

    def heard(known: IntermediateBounds, way: cost_model.BackwardRoute) -> int:
        used.append(way)
        return ready(known, way)

    monkeypatch.setattr(IntermediateBounds, "ready", heard)
    return used


@pytest.mark.slow
@pytest.mark.parametrize("which", [0, 1, 9])
def test_rows_that_end_by_plan_lie_below_the_exact_minimum(
    which: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    used = planned(monkeypatch, which)
    bounded, said = NeuronBounds.bounded, {}

    def heard(numbers: NeuronBounds, index: int, *arguments: Any) -> Any:
        said[index] = bounded(numbers, index, *arguments)
        return said[index]

    monkeypatch.setattr(NeuronBounds, "bounded", heard)
    gaps = spans = 0.0
    for seed in range(3):
        network, layers, _ = mlp(tmp_path, seed, sizes=(3, 6, 6, 6, 6, 2))
        rng = np.random.default_rng(seed)
        b, a = rng.normal(size=(1, 3)), 0.7 * rng.normal(size=(1, 3, 1))
        reach, rows = np.abs(a[..., 0]), rng.normal(size=(3, 2))
        images = ImageSets(a, b, a, b, np.nextafter(b - reach, -np.inf), np.nextafter(b + reach, np.inf))
        middle = rows @ network(torch.from_numpy(b))[0].numpy()
        found = bound_outputs(network, images, rows, np.zeros(3), arithmetic="real")
        for k, row in enumerate(rows):
            least = exact_least(layers, b[0], a[0, :, 0], row)
            assert Fraction(float(found.lower[0, k])) <= least
            gaps, spans = gaps + middle[k] - found.lower[0, k], spans + middle[k] - float(least)
        for index, form in said.items():
            for unit, (low, high) in enumerate(zip(*(v[0].tolist() for v in form.interval), strict=True)):
                least, most = (
                    exact_least(layers[: index // 2 + 1], b[0], a[0, :, 0], s * np.eye(6)[unit]) for s in (1, -1)
                )
                assert Fraction(low) <= least and -most <= Fraction(high)
    assert set(said) == {3, 5, 7}
    assert {way.cut for way in used} == {0: {1, 3, 5}, 1: {0, 1, 3}, 9: {0}}[which]
    assert gaps <= 7.0 * spans


@pytest.mark.slow_cases
@pytest.mark.parametrize("which", [0, 1, 2, None])
@pytest.mark.parametrize("net", ["residual", "gate"])
def test_rows_that_rest_on_several_nodes(
    net: str, which: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What rows gather of branches is added up: every number of every node stays within its bounds."""
    used = planned(monkeypatch, which)
    f = OnnxFile((2, 8, 8), 3)
    if net == "residual":
        file, shape = residual(tmp_path), (2, 16, 16)
    else:
        shape = (2, 8, 8)
        for channels in (2, 4):
            f.conv(channels, 4, pads=[1, 1, 1, 1])
            before = f.node("Relu")
            f.conv(4, 4, pads=[1, 1, 1, 1])
            gate = f.node("Sigmoid")
            f.node("Mul", before, gate)
        f.node("Flatten")
        f.gemm(256, 3)
        file = f.write(tmp_path / "gate.onnx")
    network, rows = load_network(file), np.random.default_rng(0).normal(size=(4, 3))
    rng = np.random.default_rng(1)
    n, slack = network.input_size, 0.004
    b, a = rng.normal(size=(1, n)), 0.02 * rng.normal(size=(1, n, 2))
    reach = np.abs(a).sum(-1) + slack
    images = ImageSets(a, b - slack, a, b + slack, b - reach, b + reach)
    forms: dict[int, Any] = {}
    leave = NetworkBounds._leave

    def left(cells: NetworkBounds, index: int) -> None:
        forms[index] = cells.intermediate.forms[index]
        leave(cells, index)

    monkeypatch.setattr(NetworkBounds, "_leave", left)
    found = []
    threads = torch.get_num_threads()
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            found.append(bound_outputs(network, images, rows, np.zeros(4), arithmetic="real"))
    finally:
        torch.set_num_threads(threads)
    np.testing.assert_allclose(found[0].lower, found[1].lower, rtol=1e-5)
    for k in range(64):
        p = rng.choice([-1.0, 1.0], 2) if k % 2 else rng.uniform(-1.0, 1.0, 2)
        x = a[0] @ p + b[0] + slack * rng.choice([-1.0, 1.0], n)
        values = [torch.from_numpy(x).reshape(1, *shape)]
        for node in network.nodes:
            values.append(node.layer([values[at] for at in node.inputs]))
        for at, form in forms.items():
            room = 2.0**-45 * values[at].abs()
            lower, upper = form.interval
            assert bool((lower <= values[at] + room).all()) and bool((values[at] - room <= upper).all())
        assert (found[0].lower[0] <= rows @ values[-1][0].numpy()).all()
    if which in (0, 1):
        assert max(len(way.ends) for way in used) > 1
    middle = rows @ network(torch.from_numpy(0.5 * (images.lower + images.upper)).reshape(1, *shape)).numpy().T
    monkeypatch.setattr(work_budget.WorkBudget, "routes", lambda *_: ([], 0.0))
    none = bound_outputs(network, images, rows, np.zeros(4), arithmetic="real")
    gaps = [(middle.T - one.lower).mean() for one in (found[0], none)]
    assert gaps[0] <= (0.8 if which is None else 1.05) * gaps[1]


def chain(folder: Path) -> Network:
    """Eleven convolutions of 8x8 pixels, and a linear layer."""
    f = OnnxFile((2, 8, 8), 5)
    for k in range(11):
        f.conv(8 if k else 2, 8, pads=[1, 1, 1, 1])
        f.node("Relu")
    f.node("Flatten")
    f.gemm(512, 3)
    return load_network(f.write(folder / "net.onnx"))


@pytest.mark.slow
def test_short_rows_keep_deep_networks_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A tenth of what all rows to the image take leaves bounds that say something, and none leaves none."""
    network, rows = chain(tmp_path), np.eye(3)
    images = image_sets((2, 8, 8), 1, 2, 1e-5, 1e-6)
    middle = rows @ network(torch.from_numpy(0.5 * (images.lower + images.upper)).reshape(1, 2, 8, 8)).numpy().T
    used = planned(monkeypatch)
    total = cost_model.CostModel(network).total
    gaps = []
    for part in (10.0, 0.1, 0.03, 0.0):
        for module in (cost_model, work_budget):
            monkeypatch.setattr(module, "PLANNED_PRODUCTS", part * total)
        taken: list[work_budget.WorkBudget] = []
        start = work_budget.WorkBudget.__init__
        monkeypatch.setattr(
            work_budget.WorkBudget,
            "__init__",
            lambda run, net, start=start, taken=taken: (taken.append(run), start(run, net))[1],
        )
        found = bound_outputs(network, images, rows, np.zeros(3), arithmetic="real").lower
        assert 0.0 <= taken[0].left <= part * total
        gaps.append(float((middle.T - found).mean()))
    print(gaps, [way.cut for way in used])
    assert max(gaps[:2]) < 10.0 * min(gaps[:2]) and 100.0 * gaps[1] < gaps[3]
    assert gaps[2] < gaps[3]


_MEASURED = """
import sys
from pathlib import Path
import numpy as np, torch
from onnx_files import image_sets
from ns_abstract.verify.network import bound_outputs, load_network, cost_model, work_budget
from ns_abstract.verify.network.explain import cell_bytes
torch.set_num_threads(1)
cost_model._DEEP = cost_model._OVER = 0.0

def peak(name):
    line = next(v for v in Path("/proc/self/status").read_text().splitlines() if v.startswith(name))
    return int(line.split()[1]) << 10

network = load_network(Path(sys.argv[1]))
images = image_sets(network.input_shape, 1, 2, 1e-4, 1e-4)
small = image_sets(network.input_shape, 1, 2, 1e-30, 1e-31)
rows = np.eye(3)
cost_model.PLANNED_PRODUCTS = work_budget.PLANNED_PRODUCTS = 0.0
bound_outputs(network, small, rows, np.zeros(3), arithmetic="real")
cost_model.PLANNED_PRODUCTS = work_budget.PLANNED_PRODUCTS = float(sys.argv[3])
before = peak("VmRSS")
Path("/proc/self/clear_refs").write_text("5")
found = bound_outputs(network, images, rows, np.zeros(3), memory=int(sys.argv[2]), arithmetic="real")
print(peak("VmHWM") - before, cell_bytes(network, 2), np.isfinite(found.lower).all())
"""


@pytest.mark.slow
def test_rows_that_end_by_plan_keep_within_memory(tmp_path: Path) -> None:
    """Wide maps whose rows would take gigabytes together stay within what is allowed, and near the estimate."""
    f = OnnxFile((3, 24, 24), 5)
    for k in range(6):
        f.conv(24 if k else 3, 24, pads=[1, 1, 1, 1])
        f.node("Relu")
    f.node("GlobalAveragePool")
    f.node("Flatten")
    f.gemm(24, 3)
    file, memory = f.write(tmp_path / "net.onnx"), 208 << 20
    words = subprocess.run(
        [sys.executable, "-c", _MEASURED, str(file), str(memory), "1e13"],
        cwd=Path(__file__).parent,
        # what is freed goes back at once: what the allocator would keep, 10 to 110 MiB by chance, is not measured
        env=os.environ | {"MALLOC_MMAP_THRESHOLD_": str(1 << 16)},
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    taken, foreseen = float(words[0]), float(words[1])
    print(f"{taken / 2**20:.0f} MiB taken, {foreseen / 2**20:.0f} foreseen")
    assert words[2] == "True"
    assert 4 << 20 < taken <= memory and taken <= 1.5 * foreseen


def test_plans_keep_to_what_is_allowed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    network = chain(tmp_path)
    costs = cost_model.CostModel(network)
    widest = []
    for part in (10.0, 0.3, 0.1, 0.03):
        plan = costs.plan(part * costs.total, [1e-4], 1.0)
        assert plan.products <= part * costs.total
        assert plan.products == pytest.approx(
            sum(costs.refined_counts[k] * way.price for k, way in plan.routes.items())
        )
        widest.append(plan.widest)
    assert sorted(widest) == widest and widest[-1] > 10.0 * widest[0]
    # where bounds are close enough in any case, no rows are worth their price
    assert costs.plan(costs.total, [1e-30], 1.0).products < 0.1 * costs.total
    monkeypatch.setattr(cost_model, "_OVER", 0.0)
    monkeypatch.setattr(cost_model, "_DEEP", 0.0)
    run = work_budget.WorkBudget(network)
    for k in range(4):
        run.record_width(k, 1e9, 1.0)
    run.routes(3, 512)
    assert run.left == 0.0, "nothing is spent on bounds that cannot say anything"


def test_what_ends_rows() -> None:
    """A sign; or both ends close, and no kink between; what a ReLU cuts off may be as wide as it likes."""
    lower = np.array([-3.0, -3.0, 1.0, 1.0, -1.0, -0.1, 2.0])
    upper = np.array([-1.0, 3.0, 1.1, 3.0, -0.9, 0.1, 2.1])
    found = BackwardBounds(np.zeros((7, 2, 2)), lower, upper, np.zeros(7, np.int64))
    every = np.arange(7)

    def done(goal: NeuronTarget, negative: bool, zero: float = 0.0) -> list[int]:
        enough = StoppingCriterion(goal, np.full(7, zero), np.full(7, negative))
        return np.flatnonzero(enough.done(found, every)).tolist()

    assert done(NeuronTarget(), False) == [2, 3, 6]
    assert done(NeuronTarget(0.2), False) == [0, 2, 4, 6]
    assert done(NeuronTarget(0.2), True) == [2, 3, 4, 6]
    assert done(NeuronTarget(0.2, cut=False), False) == [2, 4, 6]
    assert done(NeuronTarget(0.2, kink=False), False) == [2, 4, 5, 6]
    # relative to references zero is elsewhere
    assert done(NeuronTarget(0.2, cut=False), False, zero=2.05) == [2, 4, 5]
    enough = StoppingCriterion(NeuronTarget(0.2), np.zeros(7), every > 3)
    np.testing.assert_array_equal(enough[4:].done(found, every[:3]), [False, False, True])


@pytest.mark.slow
def test_early_rows_keep_later_ones_exact(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What rows lose of themselves is relative to what is known: cheap nodes are bounded though none is open."""
    shape = (2, 8, 8)
    f = OnnxFile(shape, 5)
    for k in range(11):
        f.conv(8 if k else 2, 8, pads=[1, 1, 1, 1])
        f.node("Relu")
    f.node("Flatten")
    f.gemm(512, 3)
    network, rows = load_network(f.write(tmp_path / "net.onnx")), np.eye(3)
    images = image_sets(shape, 1, 2, 1e-8, 1e-9)
    monkeypatch.setattr(cost_model, "_DEEP", 0.0)
    middle = rows @ network(torch.from_numpy(0.5 * (images.lower + images.upper)).reshape(1, *shape)).numpy().T
    gaps = []
    for cheap in (0.0, 0.03):
        monkeypatch.setattr(work_budget, "_SMALL_SHARE", cheap)
        cells = NetworkBounds(network, images, 1 << 30, "real")
        # rows of outputs in float64 lose next to nothing of themselves
        cells.intermediate.relaxations.pop()
        gaps.append((middle.T - cells.outputs(rows, np.zeros(3)).lower).mean())
    assert 0.0 < gaps[1] < 0.5 * gaps[0]


@pytest.mark.slow_cases
@pytest.mark.parametrize("arithmetic", ["float32", "real"])
def test_chosen_slopes_are_never_worse_and_sound(arithmetic: NetworkArithmetic, tmp_path: Path) -> None:
    gains = 0.0
    for seed in range(6):
        network, layers, _ = mlp(tmp_path, seed, 2.0)
        rng = np.random.default_rng(seed)
        b, a = rng.normal(size=(2, 3)), rng.normal(size=(2, 3, 1))
        reach, rows = np.abs(a[..., 0]), rng.normal(size=(3, 2))
        images = ImageSets(a, b, a, b, np.nextafter(b - reach, -np.inf), np.nextafter(b + reach, np.inf))
        plain, chosen = (
            bound_outputs(network, images, rows, np.zeros(3), arithmetic=arithmetic, slope_steps=steps)
            for steps in (0, 12)
        )
        assert (chosen.lower >= plain.lower).all()
        gains += (chosen.lower - plain.lower).sum()
        for cell, k in itertools.product(range(2), range(3)):
            least = exact_least(layers, b[cell], a[cell, :, 0], rows[k])
            assert Fraction(float(chosen.lower[cell, k])) <= least
    assert gains > 1.0


@pytest.mark.slow
def test_chosen_slopes_behind_maxima_and_products(tmp_path: Path) -> None:
    """Planes with slopes of their own hold wherever images are; something is gained."""
    f = OnnxFile((2, 16, 16), 3)
    residual(tmp_path)
    gate = OnnxFile((2, 8, 8), 5)
    gate.conv(2, 4, pads=[1, 1, 1, 1])
    one = gate.node("Relu")
    gate.conv(4, 4, pads=[1, 1, 1, 1])
    two = gate.node("Sigmoid")
    gate.node("Mul", one, two)
    gate.conv(4, 3, 3, pads=[1, 1, 1, 1])
    gate.node("Relu")
    gate.node("Flatten")
    gate.gemm(192, 3)
    for file, shape in ((tmp_path / "residual.onnx", f.shape), (gate.write(tmp_path / "gate.onnx"), gate.shape)):
        network, rows = load_network(file), np.random.default_rng(1).normal(size=(4, 3))
        images = image_sets(shape, 2, 2, 0.05, 0.02)
        plain, chosen = (bound_outputs(network, images, rows, np.zeros(4), slope_steps=n) for n in (0, 8))
        assert (chosen.lower >= plain.lower).all() and (chosen.lower > plain.lower + 1e-4).any()
        run, rng = session(file), np.random.default_rng(0)
        for cell in range(2):
            least, _ = attack(network, run, images, cell, rows, 32, 5)
            assert (chosen.lower[cell] <= least).all()
            p, t = rng.uniform(-1, 1, (64, 2)), rng.uniform(size=(64, images.lower.shape[1]))
            x, inside = members(images, cell, p, t)
            y = run(x.reshape(-1, *shape)) @ rows.T
            planes = p @ chosen.a[cell].T + chosen.b[cell]
            assert inside.any() and (planes <= y)[inside].all()


@pytest.mark.slow
def test_chains_of_maxima_beside_their_input(tmp_path: Path) -> None:
    """Pooling makes windows of rows as large as the map, beside windows of a single number."""
    f = OnnxFile((2, 4, 4), 2)
    f.conv(2, 4, pads=[1, 1, 1, 1])
    parts = [f.node("Sigmoid")]
    parts += [f.node("MaxPool", kernel_shape=[3, 3], pads=[1, 1, 1, 1]) for _ in range(3)]
    f.node("Concat", *parts, axis=1)
    f.conv(16, 4, pads=[1, 1, 1, 1])
    f.node("Relu")
    f.conv(4, 2)
    file = f.write(tmp_path / "chain.onnx")
    network, rows = load_network(file), np.random.default_rng(0).normal(size=(3, 8))
    images = image_sets((2, 4, 4), 2, 2, 0.3, 0.1)
    lower = bound_outputs(network, images, rows, np.zeros(3)).lower
    for cell in range(2):
        least, _ = attack(network, session(file), images, cell, rows, 32, 5)
        assert (lower[cell] <= least).all() and np.isfinite(lower[cell]).all()


@pytest.mark.slow_cases
@pytest.mark.parametrize("deep", [False, True])
def test_curves_are_bounded_by_what_rows_leave(deep: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lines that are close beside the width of a form may be far apart beside the true one: rows find out."""
    shape = (2, 8, 8)
    f = OnnxFile(shape, 5)
    for k in range(7):
        f.conv(2 if not k else 8, 8, pads=[1, 1, 1, 1])
        gate, value = f.node("Sigmoid", f.last), f.nodes[-2].output[0]
        f.node("Mul", value, gate)
    f.node("Flatten")
    f.gemm(512, 3)
    file = f.write(tmp_path / "net.onnx")
    network, images, rows = load_network(file), image_sets(shape, 2, 2, 1e-3, 1e-4), np.eye(3)
    if deep:
        monkeypatch.setattr(cost_model, "_DEEP", 0.0)
        # nor are all numbers of a node bounded for another reason
        monkeypatch.setattr(work_budget, "_SMALL_SHARE", 0.0)
    found = bound_outputs(network, images, rows, np.zeros(3), arithmetic="real").lower
    with monkeypatch.context() as patch:
        patch.setattr(neuron_selection, "_HALF", -1.0)
        without = bound_outputs(network, images, rows, np.zeros(3), arithmetic="real").lower
    middle = network(torch.from_numpy(0.5 * (images.lower + images.upper)).reshape(2, *shape)).numpy()
    assert (found <= middle).all()
    assert (middle - without).mean() > 3.0 * (middle - found).mean()
    found = bound_outputs(network, images, rows, np.zeros(3)).lower
    for cell in range(2):
        least, _ = attack(network, session(file), images, cell, rows, 32, 5)
        assert (found[cell] <= least).all()


@pytest.mark.slow
def test_deep_networks_are_given_up_early(tmp_path: Path) -> None:
    network = load_network(residual(tmp_path))
    run = work_budget.WorkBudget(network)
    assert run.is_futile(0.95, 0.0, 0.1) and run.left > 0.0
    assert not run.is_futile(0.5, 0.5, 0.9) and run.left > 0.0
    assert run.is_futile(0.5, 0.95, 0.9) and run.left == 0.0


@pytest.mark.slow
def test_rows_cost_what_their_windows_hold(tmp_path: Path) -> None:
    network = load_network(residual(tmp_path))
    costs = cost_model.CostModel(network)
    first = next(k for k, node in enumerate(network.nodes, 1) if node.op == "Conv")
    layer = network.nodes[first - 1].layer
    assert isinstance(layer, Convolution)
    # one number of the first convolution: its channels there, the weights, and its window of the image
    assert costs.pass_price(first) == cost_model._PASSING * (6 + 18) + layer.weight.numel()
    assert costs.pass_price(len(network.nodes)) > 10 * costs.pass_price(first)


def test_a_point_and_a_constant_image(tmp_path: Path) -> None:
    network, _, file = mlp(tmp_path, 1)
    for x in (np.zeros((1, 3)), np.full((1, 3), 0.5), np.array([[1e-30, -1e-38, 3e-45]])):
        zero = np.zeros((1, 3, 0))
        x = x.astype(np.float32).astype(np.float64)
        found = bound_outputs(network, ImageSets(zero, x, zero, x, x, x), np.eye(2), np.zeros(2))
        y = session(file)(x.astype(np.float32))[0]
        assert (found.lower[0] <= y).all()
        assert (found.lower[0] >= y - 1e-4).all()
        assert found.a.shape == (1, 2, 0)


def test_no_cells_and_zero_rows(tmp_path: Path) -> None:
    network, _, _ = mlp(tmp_path, 0)
    images = image_sets((3,), 2, 1, 0.1, 0.1)
    none = bound_outputs(network, images[0:0], np.eye(2), np.zeros(2))
    assert none.lower.shape == (0, 2) and none.a.shape == (0, 2, 1)
    zero = bound_outputs(network, images, np.zeros((1, 2)), np.array([3.0]))
    assert (zero.lower <= 3.0).all() and (zero.lower > 3.0 - 1e-9).all()


def test_dead_units_and_large_weights(tmp_path: Path) -> None:
    for scale in (1e-30, 1e4, 1e10):
        network, _, file = mlp(tmp_path, 3, scale)
        images = image_sets((3,), 3, 2, 0.2, 0.1)
        found = bound_outputs(network, images, np.eye(2), np.zeros(2))
        for cell in range(3):
            least, _ = attack(network, session(file), images, cell, np.eye(2))
            assert (found.lower[cell] <= least).all()
            assert np.isfinite(found.lower[cell]).all()
    f = OnnxFile((3,))
    f.node("Gemm", f.last, f.constant(np.zeros((4, 3))), f.constant(np.full(4, -1.0)), transB=1)
    f.node("Relu")
    f.gemm(4, 2)
    network = load_network(f.write(tmp_path / "dead.onnx"))
    found = bound_outputs(network, images, np.eye(2), np.zeros(2))
    np.testing.assert_allclose(found.lower[0], network(torch.zeros(1, 3))[0].numpy(), atol=1e-5)


def test_weights_that_overflow(tmp_path: Path) -> None:
    f = OnnxFile((3,))
    f.node("Gemm", f.last, f.constant(np.full((4, 3), 1e30)), transB=1)
    f.node("Relu")
    f.node("Gemm", f.last, f.constant(np.full((2, 4), 1e-30)), transB=1)
    network = load_network(f.write(tmp_path / "large.onnx"))
    images = image_sets((3,), 1, 1, 0.1, 0.1)
    found = bound_outputs(network, images, np.eye(2), np.zeros(2))
    assert not np.isnan(found.lower).any()
    far = ImageSets(*(1e10 * getattr(images, name) for name in images.__dataclass_fields__))
    found = bound_outputs(network, far, np.eye(2), np.zeros(2))
    assert (found.lower == -np.inf).all() and (found.b == -np.inf).all() and (found.a == 0.0).all()
    f.node("Gemm", f.last, f.constant(np.full((1, 2), 2e38)), transB=1)
    with pytest.raises(InputError, match="float32"):
        load_network(f.write(tmp_path / "larger.onnx"))


@pytest.mark.parametrize("damage", ["nan", "inf", "crossed", "nan plane", "disjoint"])
def test_a_bad_cell_is_unknown_and_leaves_the_others_alone(damage: str, tmp_path: Path) -> None:
    network, _, _ = mlp(tmp_path, 2)
    images = image_sets((3,), 3, 2, 0.2, 0.1)
    fields = {name: getattr(images, name).copy() for name in images.__dataclass_fields__}
    if damage == "nan":
        fields["lower"][1, 2] = np.nan
    elif damage == "inf":
        fields["upper"][1, 2] = np.inf
    elif damage == "crossed":
        fields["lower"][1], fields["upper"][1] = images.upper[1], images.lower[1]
    elif damage == "nan plane":
        fields["a_upper"][1, 0, 1] = np.nan
    else:
        fields["b_lower"][1] += 50.0
        fields["b_upper"][1] += 50.0
    good = bound_outputs(network, images, np.eye(2), np.zeros(2))
    found = bound_outputs(network, ImageSets(**fields), np.eye(2), np.zeros(2))
    assert (found.lower[1] == -np.inf).all()
    assert (found.lower[[0, 2]] == good.lower[[0, 2]]).all()
    assert not np.isnan(found.a).any() and not np.isnan(found.b).any()


@pytest.mark.slow
def test_parts_change_nothing_but_rounding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    f = OnnxFile(SHAPE)
    f.conv(2, 4, pads=[1, 1, 1, 1])
    f.node("Relu")
    f.conv(4, 4, pads=[1, 1, 1, 1])
    f.node("Relu")
    f.conv(4, 3)
    network = load_network(f.write(tmp_path / "net.onnx"))
    images = image_sets(SHAPE, 5, 2, 0.3, 0.1)
    rows = np.random.default_rng(0).normal(size=(6, network.output_size))
    rows[:3] = np.eye(3, network.output_size, 4)
    whole = bound_outputs(network, images, rows, np.zeros(6))
    tiny = bound_outputs(network, images, rows, np.zeros(6), memory=1)
    for part in (backward, neuron_bounds, output_bounds, max_pool_propagation):
        monkeypatch.setattr(part, "ROWS_AT_ONCE", 1)
    single = bound_outputs(network, images, rows, np.zeros(6))
    one = [bound_outputs(network, images[k : k + 1], rows[[0, 4]], np.zeros(2)).lower[0] for k in range(5)]
    for other in (tiny.lower, single.lower):
        np.testing.assert_allclose(whole.lower, other, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(whole.lower[:, [0, 4]], np.stack(one), rtol=1e-4, atol=1e-4)


def test_sparse_rows(tmp_path: Path) -> None:
    sparse = pytest.importorskip("scipy.sparse", reason="scipy is not installed")
    network, _, _ = mlp(tmp_path, 2)
    images = image_sets((3,), 2, 2, 0.2, 0.1)
    rows = np.array([[0.0, 1.0], [0.0, 0.0], [0.3, 0.0]])
    dense = bound_outputs(network, images, rows, np.ones(3))
    found = bound_outputs(network, images, sparse.csr_array(rows), np.ones(3))
    assert (dense.lower == found.lower).all()


def test_rows_that_float32_cannot_hold(tmp_path: Path) -> None:
    """Rows are rounded to float32 on the way; what that loses is charged."""
    network, _, file = mlp(tmp_path, 2)
    images = image_sets((3,), 1, 1, 1e-9, 1e-9)
    rows = np.array([[1.0 + 2.0**-30, -1.0 / 3.0], [1e-42, 1e-60], [1e25, -1e25]])
    found = bound_outputs(network, images, rows, np.zeros(3))
    least, _ = attack(network, session(file), images, 0, rows)
    assert (found.lower[0] <= least).all() and np.isfinite(found.lower).all()


def test_wrong_shapes_are_errors(tmp_path: Path) -> None:
    network, _, _ = mlp(tmp_path, 2)
    images = image_sets((3,), 1, 1, 0.1, 0.1)
    with pytest.raises(ValueError, match="rows"):
        bound_outputs(network, images, np.eye(3), np.zeros(3))
    with pytest.raises(ValueError, match="images"):
        bound_outputs(network, image_sets((4,), 1, 1, 0.1, 0.1), np.eye(2), np.zeros(2))
    with pytest.raises(ValueError, match="b_lower"):
        ImageSets(
            images.a_lower,
            images.b_lower[:, 1:],
            *(getattr(images, n) for n in ("a_upper", "b_upper", "lower", "upper")),
        )
    with pytest.raises(ValueError, match="images"):
        network(torch.zeros(3))


def test_float32_rounding_is_needed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without its charge, runs in float32 break the bounds of single images."""
    broken = {True: 0, False: 0}
    rng = np.random.default_rng(0)
    f = OnnxFile((40,))
    f.gemm(40, 60, 3.0)
    f.node("Relu")
    f.gemm(60, 30, 3.0)
    f.node("Relu")
    f.gemm(30, 4)
    file = f.write(tmp_path / "net.onnx")
    network, run = load_network(file), session(file)
    x = rng.normal(size=(40, 40)).astype(np.float32)
    y = run(x).astype(np.float64)
    zero, b = np.zeros((40, 40, 1)), x.astype(np.float64)
    images = ImageSets(zero, b, zero, b, b, b)
    rows = np.concatenate([np.eye(4), -np.eye(4)])
    for charged in (True, False):
        if not charged:
            for part in (intermediate_bounds, network_charges):
                monkeypatch.setattr(part, "UNIT", 0.0)
        lower = bound_outputs(network, images, rows, np.zeros(8)).lower
        broken[charged] = int((lower > y @ rows.T).sum())
    assert broken[True] == 0
    assert broken[False] > 0


@pytest.mark.parametrize("tilted", [False, True])
@pytest.mark.parametrize("window", [(3, 3), (2, 11), (5, 13)])
def test_rows_are_bounded_on_windows_as_on_maps(window: tuple[int, int], tilted: bool) -> None:
    """Sums of rows over windows that lie partly outside, against exact ones; what lies beside them plays no part."""
    rng = np.random.default_rng(sum(window))
    (h, w), (m, d, channels, height, width), count = window, (2, 3, 2, 5, 13), 12
    value = rng.normal(size=(count, channels, h, w)).astype(np.float32)
    whole = (h, w) == (height, width)
    y, x = (
        np.zeros(count, np.int64) if whole else rng.integers(1 - n, size, count)
        for n, size in ((h, height), (w, width))
    )
    cell = rng.integers(0, m, count)
    shape = (m, 2, channels, height, width)
    slopes, offsets = rng.normal(size=(*shape, d)), np.sort(rng.normal(size=shape), axis=1)
    if not tilted:
        slopes[:, 1] = slopes[:, 0]
    lower, upper = offsets[:, 0] - 0.1, offsets[:, 1] + 0.1
    # a number that no row reaches
    reached = np.zeros((m, height, width), bool)
    for k in range(count):
        reached[cell[k], max(0, y[k]) : max(0, y[k] + h), max(0, x[k]) : max(0, x[k] + w)] = True
    for array in (offsets[:, 1], upper):
        array.transpose(0, 2, 3, 1)[~reached] = np.inf
    total = np.sort(rng.normal(size=(count, 2)), axis=1)
    plane, box = np.zeros((count, 2, d + 1)), np.zeros((count, 2))
    concretize(value, y, x, cell, columns_of(slopes, offsets, lower, upper), total, plane, box)
    assert np.isfinite(plane).all() and np.isfinite(box).all()
    for k in range(count):
        sums = [[Fraction(float(v)) for v in total[k]] for _ in range(2)]
        steep = [[Fraction(0)] * d for _ in range(2)]
        for c, i, j in itertools.product(range(channels), range(h), range(w)):
            at = (c, i + y[k], j + x[k])
            if not (0 <= at[1] < height and 0 <= at[2] < width):
                continue
            a = Fraction(float(value[k, c, i, j]))
            for side in range(2):
                # what is below a number is above its negative
                other = side if a > 0 else 1 - side
                sums[0][side] += a * Fraction(float(offsets[(cell[k], other, *at)]))
                sums[1][side] += a * Fraction(float((lower, upper)[other][(cell[k], *at)]))
                for l in range(d):
                    steep[side][l] += a * Fraction(float(slopes[(cell[k], other, *at)][l]))
        for side, sign in ((0, 1), (1, -1)):
            found = plane[k, side].tolist()
            lost = sum(abs(Fraction(found[l]) - steep[side][l]) for l in range(d))
            assert lost <= sign * (sums[0][side] - Fraction(found[d])) <= Fraction(2.0**-18)
            assert 0 <= sign * (sums[1][side] - Fraction(float(box[k, side]))) <= Fraction(2.0**-18)


@pytest.mark.parametrize(("size", "stride"), [(3, 2), (2, 3), (1, 2), (4, 4), (5, 2)])
def test_transposed_strides(size: int, stride: int, tmp_path: Path) -> None:
    """Rows on a strided convolution's output become rows on its input: exact for small whole numbers."""
    f = OnnxFile((2, 11, 9), size)
    f.conv(2, 3, size, strides=[stride, stride])
    net = load_network(f.write(tmp_path / "strided.onnx"))
    layer = next(node.layer for node in net.nodes if isinstance(node.layer, Convolution))
    rng = np.random.default_rng(size)
    value = torch.from_numpy(rng.integers(-8, 9, (5, 3, 3, 2)).astype(np.float32))
    weight = torch.from_numpy(rng.integers(-8, 9, tuple(layer.weight.shape)).astype(np.float64))
    found = replace(layer, weight=weight)._transposed(value)
    assert torch.equal(found, torch.nn.functional.conv_transpose2d(value, weight.float(), stride=stride))


def test_whole_maps_pass_strides_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the padding, and where inputs are read by no window: exact for small whole numbers."""
    rng = np.random.default_rng(0)
    joined = layers.interleave

    def onto_used_memory(*given: Any) -> None:
        given[-1].fill(np.nan)
        joined(*given)

    monkeypatch.setattr(layers, "interleave", onto_used_memory)
    for _ in range(60):
        (kh, kw), (s, t) = rng.integers(1, 6, 2).tolist(), rng.integers(1, 4, 2).tolist()
        pads, (height, width) = tuple(rng.integers(0, 3, 4).tolist()), rng.integers(6, 12, 2).tolist()
        h, w = (height + pads[0] + pads[2] - kh) // s + 1, (width + pads[1] + pads[3] - kw) // t + 1
        weight = torch.from_numpy(rng.integers(-8, 9, (3, 2, kh, kw)).astype(np.float64))
        layer = Convolution(((2, height, width),), (3, h, w), weight=weight, stride=(s, t), pads=pads)
        value = rng.integers(-8, 9, (2, 3, h, w)).astype(np.float32)
        found = full(layer.backward(Coefficients.whole(value.copy()))[0], layer.input_shapes[0], force=True).value
        x = torch.zeros((2, 2, height, width), requires_grad=True)
        (layer.apply([x]) * torch.from_numpy(value)).sum().backward()
        assert x.grad is not None
        assert torch.equal(torch.from_numpy(found), x.grad), (kh, kw, s, t, pads)
