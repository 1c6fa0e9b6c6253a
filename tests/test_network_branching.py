"""Branches on signs of units: never a wrong proof, also behind residuals; what slopes leave open is proved."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from onnx_files import OnnxFile, attack, image_sets, session
from test_network_bounds import exact_least, mlp, residual

from ns_abstract.verify.model import NetworkModel
from ns_abstract.verify.network import ImageSets, Network, NetworkArithmetic, bound_outputs, load_network
from ns_abstract.verify.network.bounds import NetworkBounds
from ns_abstract.verify.network.phase_tree import PhaseTree, TreeResult
from ns_abstract.verify.preprocess import Preprocess
from ns_abstract.verify.properties import Query

MOST = 100


def branch(
    network: Network,
    images: ImageSets,
    rows: np.ndarray,
    offset: np.ndarray,
    groups: Sequence[Sequence[int]],
    most: int,
    *,
    arithmetic: NetworkArithmetic = "float32",
    intermediate_steps: int = 0,
) -> TreeResult:
    """All groups, up to the first that is not proved."""
    cells = NetworkBounds(network, images, 1 << 30, arithmetic, 1, intermediate_steps=intermediate_steps)
    tree, results = PhaseTree(cells, rows, offset), []
    for group in groups:
        results.append(tree.prove(group, most))
        if not results[-1].proved:
            break
    return TreeResult(all(r.proved for r in results), sum(r.branches for r in results), min(r.least for r in results))


def line(rng: np.random.Generator, n: int) -> ImageSets:
    """Images on a line, one cell."""
    b, a = rng.normal(size=(1, n)), rng.normal(size=(1, n, 1))
    reach = np.abs(a[..., 0])
    return ImageSets(a, b, a, b, np.nextafter(b - reach, -np.inf), np.nextafter(b + reach, np.inf))


@pytest.mark.slow
@pytest.mark.parametrize("arithmetic", ["float32", "real"])
def test_claims_next_to_the_exact_minimum(arithmetic: NetworkArithmetic, tmp_path: Path) -> None:
    """What some image breaks exactly is never proved; a little below it is, where slopes alone prove less."""
    gained = 0
    for seed in range(4):
        network, layers, _ = mlp(tmp_path, seed, 2.0)
        rng = np.random.default_rng(seed)
        images, rows = line(rng, 3), rng.normal(size=(3, 2))
        alone = bound_outputs(network, images, rows, np.zeros(3), arithmetic=arithmetic, slope_steps=12).lower[0]
        least = [exact_least(layers, images.b_lower[0], images.a_lower[0, :, 0], row) for row in rows]
        # not above the exact minimum
        broken = -np.array([np.nextafter(float(v), np.inf) for v in least])
        for k in range(3):
            assert Fraction(float(broken[k])) + least[k] <= 0
            found = branch(network, images, rows[k : k + 1], broken[k : k + 1], [[0]], 12, arithmetic=arithmetic)
            assert not found.proved and found.least <= 0.0
        gap = -broken - alone
        held = -(alone + 0.5 * gap)
        open_ = gap > 1e-3
        gained += int(open_.sum())
        held[~open_] = 1e-6 - alone[~open_]
        for k in range(3):
            found = branch(network, images, rows[k : k + 1], held[k : k + 1], [[0]], MOST, arithmetic=arithmetic)
            assert found.proved and found.least > 0.0 and (found.branches > 1 or not open_[k])
        # one group that fails is enough, but not one row of a group
        offset = np.where(np.arange(3) == 1, broken, held)
        assert branch(network, images, rows, held, [[0], [1], [2]], MOST, arithmetic=arithmetic).proved
        assert not branch(network, images, rows, offset, [[0], [1]], 12, arithmetic=arithmetic).proved
        for claim, most in ((held, MOST), (broken, 4)):
            steps = branch(
                network, images, rows, claim, [[0], [1], [2]], most, arithmetic=arithmetic, intermediate_steps=6
            )
            assert steps.proved == (claim is held)
        assert branch(network, images, rows, offset, [[1, 0], [2]], MOST, arithmetic=arithmetic).proved
    assert gained >= 4


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 2, 3])
def test_behind_residuals(seed: int, tmp_path: Path) -> None:
    """Rows on units that are read twice; what attacks break is not proved, what slopes leave open may be."""
    residual(tmp_path)
    network, run = load_network(tmp_path / "residual.onnx"), session(tmp_path / "residual.onnx")
    images, rows = image_sets((2, 16, 16), 1, 1, 0.01, 0.004, seed), np.random.default_rng(2 + seed).normal(size=(1, 3))
    reached, _ = attack(network, run, images, 0, rows, 64, seed)
    assert not branch(network, images, rows, -reached, [[0]], 8).proved
    if seed:
        plain = bound_outputs(network, images, rows, np.zeros(1), slope_steps=12).lower[0]
        found = branch(network, images, rows, -(plain + 0.05 * (reached - plain)), [[0]], MOST)
        assert found.proved and found.branches > 1


def test_an_end_comes_soon(tmp_path: Path) -> None:
    network, layers, _ = mlp(tmp_path, 1, 2.0)
    images, row = line(np.random.default_rng(1), 3), np.array([[1.0, 0.5]])
    least = float(exact_least(layers, images.b_lower[0], images.a_lower[0, :, 0], row[0]))
    found = branch(network, images, row, np.array([-least - 1e-6]), [[0]], 1)
    assert not found.proved and found.branches == 1
    assert not branch(network, images, row, np.array([np.nan]), [[0]], MOST).proved
    assert not branch(network, images, row, np.array([1e3 - least]), [[]], MOST).proved


def test_a_network_without_units(tmp_path: Path) -> None:
    f = OnnxFile((3,), 0)
    f.gemm(3, 2)
    network = load_network(f.write(tmp_path / "linear.onnx"))
    images = line(np.random.default_rng(0), 3)
    least = bound_outputs(network, images, np.eye(2), np.zeros(2)).lower[0]
    assert branch(network, images, np.eye(2), 1e-3 - least, [[0], [1]], MOST).proved
    assert not branch(network, images, np.eye(2), -1e-3 - least, [[0], [1]], MOST).proved


def test_margins_that_branches_prove(tmp_path: Path) -> None:
    """A positive margin is not above the exact one of any group; a group that fails leaves none, whatever follows."""
    network, layers, _ = mlp(tmp_path, 2, 2.0)
    rng = np.random.default_rng(2)
    images, rows = line(rng, 3), rng.normal(size=(3, 2))
    least = np.array([float(exact_least(layers, images.b_lower[0], images.a_lower[0, :, 0], row)) for row in rows])
    alone = bound_outputs(network, images, rows, np.zeros(3), slope_steps=12).lower[0]
    assert (least - alone).min() > 0.1
    model = NetworkModel(network, Preprocess(), 1 << 30)
    # the last group has the greatest margin
    held = -(alone + 0.5 * (least - alone)) + np.array([0.0, 1.0, 2.0])
    for groups in ([[0], [1], [2]], [[0], [2, 1]]):
        exact = min(max(least[k] + held[k] for k in group) for group in groups)
        assert 0.0 < model.branch(images, Query(rows, held), groups, MOST) <= exact
    broken = np.where(np.arange(3) == 1, -least - 1e-3, held)
    for groups in ([[0], [1], [2]], [[1], [0]], [[0], []]):
        assert not model.branch(images, Query(rows, broken), groups, MOST) > 0.0
