"""What torch's exporters write by default is read, computes the same, and is bounded soundly."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx_files import attack, image_sets, session
from torch import nn

from ns_abstract.io.errors import InputError
from ns_abstract.verify.network import bound_outputs, load_network

SHAPE = (3, 8, 8)


class Flattened(nn.Module):
    """Both ways in which people flatten."""

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Conv2d(3, 4, 3, 2, 1)
        self.second = nn.Linear(64, 8)
        self.third = nn.Linear(8, 4)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = torch.relu(self.first(x)).view(x.shape[0], -1)
        x = torch.relu(self.second(x))
        return self.third(torch.flatten(x.reshape(-1, 2, 4), 1))


class Pieces(nn.Module):
    """Splits, steps, dropped channels, normalised weights, pads of a number, repeated axes and a second output."""

    def __init__(self) -> None:
        super().__init__()
        self.first = torch.nn.utils.weight_norm(nn.Conv2d(3, 8, 3))
        self.drop, self.act = nn.Dropout2d(), nn.SiLU()
        self.up, self.norm = nn.Upsample(scale_factor=2), nn.GroupNorm(2, 4)
        self.last = nn.ConvTranspose2d(4, 2, 2, 2)

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        one, two = self.act(self.drop(self.first(x))).chunk(2, 1)
        three, four = (one * torch.sigmoid(two)).split([1, 3], 1)
        x = nn.functional.pad(torch.cat([four, three.clamp(-0.1, 0.2)], 1), (1, 0, 0, 1), value=0.3)
        x = self.norm(self.up(x[:, :, ::2, 1::2]))
        wide = two[:, :1, :2].expand(-1, 3, -1, -1)
        return torch.flatten(self.last(x).mean(1, keepdim=True).softmax(-1), 1), nn.functional.logsigmoid(wide)


def exported(module: nn.Module, file: Path, dynamo: bool) -> Path:
    torch.manual_seed(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(module.eval(), (torch.randn(1, *SHAPE),), str(file), dynamo=dynamo, verbose=False)
    return file


@pytest.mark.slow
@pytest.mark.parametrize("which", [0, 1])
def test_pieces_are_bounded(which: int, tmp_path: Path) -> None:
    torch.manual_seed(0)
    module = Pieces().eval()
    file = exported(module, tmp_path / "net.onnx", False)
    names = [value.name for value in onnx.load(file).graph.output]
    with pytest.raises(InputError, match=f"has 2 outputs: {names[0]} .*, {names[1]} "):
        load_network(file)
    network = load_network(file, output=names[which])

    def run(images: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return module(torch.from_numpy(images))[which].numpy().reshape(len(images), -1)

    x = np.random.default_rng(0).normal(size=(2, *SHAPE)).astype(np.float32)
    np.testing.assert_allclose(network(torch.from_numpy(x)).numpy(), run(x), rtol=1e-4, atol=1e-5)
    rows = np.random.default_rng(0).normal(size=(2, network.output_size))
    images = image_sets(SHAPE, 1, 2, 0.01, 0.005)
    least, _ = attack(network, run, images, 0, rows, 32, 4)
    lower = bound_outputs(network, images, rows, np.zeros(2)).lower[0]
    assert (lower <= least).all() and np.isfinite(lower).all()


@pytest.mark.parametrize("dynamo", [True, False])
def test_exported_network_is_bounded(dynamo: bool, tmp_path: Path) -> None:
    if dynamo:
        pytest.importorskip("onnxscript", reason="torch's exporter needs onnxscript")
    torch.manual_seed(0)
    file = exported(Flattened(), tmp_path / "net.onnx", dynamo)
    network, run = load_network(file), session(file)
    rows = np.eye(4)
    images = image_sets(SHAPE, 1, 2, 0.1, 0.05)
    least, compared = attack(network, run, images, 0, rows)
    lower = bound_outputs(network, images, rows, np.zeros(4)).lower[0]
    assert (lower <= least).all() and np.isfinite(lower).all() and compared > 200
