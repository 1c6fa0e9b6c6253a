"""Numbers that rows of the outputs depend on, and rows in float32 in real arithmetic."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import test_phase_tree as trees
import torch
from onnx_files import OnnxFile

from ns_abstract.verify.network import ImageSets, Network, load_network
from ns_abstract.verify.network.bounds import NetworkBounds
from ns_abstract.verify.network.dependence import dependence
from ns_abstract.verify.network.phase_tree import PhaseTree


def maps(folder: Path) -> Network:
    f = OnnxFile((2, 9, 9), 3)
    f.conv(2, 4, pads=[1, 1, 1, 1])
    f.node("Relu")
    f.conv(4, 4, pads=[1, 1, 1, 1])
    f.node("Relu")
    f.conv(4, 3, pads=[1, 1, 1, 1])
    return load_network(f.write(folder / "maps.onnx"))


def bounds_of(network: Network, rows: np.ndarray, asked: np.ndarray | None, coarse: bool) -> np.ndarray:
    x = np.random.default_rng(1).uniform(size=network.input_size)
    none, lower, upper = np.zeros((1, len(x), 1)), x[None] - 0.2, x[None] + 0.2
    images = ImageSets(none, lower, none, upper, lower, upper)
    cells = NetworkBounds(network, images, 1 << 30, "real", 1, asked=asked, coarse=coarse)
    return cells.outputs(rows, np.zeros(len(rows))).lower[0]


def test_only_numbers_that_matter_are_refined(tmp_path: Path) -> None:
    """A corner of the output sees a corner of the maps; its bounds are those with every number refined."""
    network = maps(tmp_path)
    rows = np.zeros((2, 3, 9, 9))
    rows[0, 1, 0, 0], rows[1, :, 1, 0] = 1.0, -1.0
    flat = rows.reshape(2, -1)
    masks = dependence(network, flat)
    assert masks[4][:, :3, :2].all() and not masks[4][:, 3:].any() and not masks[4][:, :, 2:].any()
    assert masks[1][:, :4, :3].all() and not masks[1][:, 4:].any()
    np.testing.assert_array_equal(bounds_of(network, flat, flat, False), bounds_of(network, flat, None, False))


def test_rows_in_float32_are_charged(tmp_path: Path) -> None:
    """Rows in float32 prove less than rows in float64, by as much as their rounding may be, and little less."""
    network = maps(tmp_path)
    rows = np.random.default_rng(2).normal(size=(6, network.output_size))
    fine, coarse = (bounds_of(network, rows, None, kind) for kind in (False, True))
    # some hundred roundings of float32; what float32 really loses is a hundredth of that
    assert (coarse < fine - 1e-5 * np.abs(fine)).all()
    assert (coarse > fine - 1e-2 * np.abs(fine)).all()
    x = torch.from_numpy(np.random.default_rng(1).uniform(size=(1, 2, 9, 9)))
    assert (coarse < rows @ network(x)[0].numpy()).all()


@pytest.mark.parametrize("name", ["small", "leaky"])
def test_branches_hold_with_rows_in_float32(name: str, tmp_path: Path) -> None:
    network = load_network({"leaky": trees.leaky, "small": trees.small}[name](tmp_path))
    rng, radius = np.random.default_rng(3), 1.0 if name == "small" else 0.05
    x = rng.uniform(size=network.input_size)
    images, rows = trees.box(x - radius, x + radius), rng.normal(size=(2, network.output_size))
    rows = np.concatenate([rows, -rows])
    cells = NetworkBounds(network, images, 1 << 30, "real", 1, coarse=True)
    tree = PhaseTree(cells, rows, np.zeros(4))
    assert trees.least_excess(network, tree, images, rows, 40 if name == "small" else 4) >= 0.0
