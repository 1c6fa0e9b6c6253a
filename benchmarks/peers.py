"""Widths of output bounds beside auto_LiRPA's CROWN and alpha-CROWN: the same networks, boxes and threads.

    PYTHONPATH=path/to/auto_LiRPA python benchmarks/peers.py [NAME ...] [--steps 20] [--boxes 2]

auto_LiRPA is no dependency: clone https://github.com/Verified-Intelligence/auto_LiRPA and name the folder. Ten networks
are made on the spot. A row gives the sum of the widths of all outputs over auto_LiRPA's, and the seconds of both; ours
are in real arithmetic, and in float32 beside it, which nobody else charges.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import nn

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]

from ns_abstract.verify.network import ImageSets, bound_outputs  # noqa: E402
from ns_abstract.verify.network.graph import Network, NetworkArithmetic  # noqa: E402
from ns_abstract.verify.network.load import read_onnx  # noqa: E402


def dense(sizes: Sequence[int], function: Callable[[], nn.Module], gain: float = 1.4) -> nn.Module:
    """Fully connected layers with a function between."""
    layers: list[nn.Module] = [nn.Flatten()]
    for before, after in itertools.pairwise(sizes):
        layer = nn.Linear(before, after)
        nn.init.normal_(layer.weight, std=gain / before**0.5)
        nn.init.normal_(layer.bias, std=0.1)
        layers += [layer, function()]
    return nn.Sequential(*layers[:-1])


def convolutional(function: Callable[[], nn.Module], pool: Callable[[], nn.Module] = nn.Identity) -> nn.Module:
    """Three convolutions and a fully connected layer."""
    layers: list[nn.Module] = []
    for before, after, stride in ((1, 8, 1), (8, 8, 2), (8, 16, 1)):
        layer = nn.Conv2d(before, after, 3, stride, 1)
        nn.init.normal_(layer.weight, std=1.4 / (9 * before) ** 0.5)
        layers += [layer, function()]
        if stride == 1:
            layers += [pool()]
    return nn.Sequential(*layers, nn.Flatten(), nn.LazyLinear(10))


class Residual(nn.Module):
    """Two blocks of two convolutions each, with their input added."""

    def __init__(self) -> None:
        super().__init__()
        self.first, self.last = nn.Conv2d(1, 8, 3, 2, 1), nn.Linear(8 * 36, 10)
        self.convolutions = nn.ModuleList(nn.Conv2d(8, 8, 3, 1, 1) for _ in range(4))
        for layer in (self.first, *self.convolutions):
            assert isinstance(layer, nn.Conv2d)
            nn.init.normal_(layer.weight, std=1.2 / (9 * layer.in_channels) ** 0.5)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = self.first(x).relu()
        for k in (0, 2):
            x = (x + self.convolutions[k + 1](self.convolutions[k](x).relu())).relu()
        return self.last(x.flatten(1))


IMAGE, VECTOR = (1, 12, 12), (16,)
#: Name: a network, the shape of its input, and half the width of the box.
NETWORKS: dict[str, tuple[Callable[[], nn.Module], tuple[int, ...], float]] = {
    "relu mlp": (lambda: dense((16, 64, 64, 64, 5), nn.ReLU), VECTOR, 0.05),
    "deep relu mlp": (lambda: dense((16, *[48] * 8, 5), nn.ReLU), VECTOR, 0.01),
    "leaky relu mlp": (lambda: dense((16, 64, 64, 64, 5), lambda: nn.LeakyReLU(0.1)), VECTOR, 0.05),
    "sigmoid mlp": (lambda: dense((16, 64, 64, 64, 5), nn.Sigmoid, 3.0), VECTOR, 0.2),
    "tanh mlp": (lambda: dense((16, 64, 64, 64, 5), nn.Tanh), VECTOR, 0.08),
    "deep tanh mlp": (lambda: dense((16, *[48] * 6, 5), nn.Tanh), VECTOR, 0.02),
    "gelu mlp": (lambda: dense((16, 64, 64, 64, 5), nn.GELU), VECTOR, 0.08),
    "relu cnn": (lambda: convolutional(nn.ReLU), IMAGE, 0.02),
    "sigmoid cnn": (lambda: convolutional(nn.Sigmoid), IMAGE, 0.1),
    "residual cnn": (Residual, IMAGE, 0.01),
    "max pooling cnn": (lambda: convolutional(nn.ReLU, lambda: nn.MaxPool2d(2)), IMAGE, 0.01),
}


def box(x: np.ndarray, radius: float) -> ImageSets:
    """The numbers within ``radius`` of ``x``."""
    lower, upper = ((x.astype(np.float64) + sign * radius).reshape(1, -1) for sign in (-1.0, 1.0))
    flat = np.zeros((*lower.shape, 1))
    return ImageSets(flat, lower, flat, upper, lower, upper)


def ours(
    network: Network, x: np.ndarray, radius: float, arithmetic: NetworkArithmetic, steps: int
) -> tuple[float, float]:
    """The sum of the outputs' widths, and seconds."""
    eye = np.eye(network.output_size)
    rows = np.concatenate([eye, -eye])
    start = time.perf_counter()
    lower = bound_outputs(
        network,
        box(x, radius),
        rows,
        np.zeros(len(rows)),
        arithmetic=arithmetic,
        slope_steps=steps,
        intermediate_steps=steps,
    ).lower
    return -float(lower.sum()), time.perf_counter() - start


def theirs(model: nn.Module, x: torch.Tensor, radius: float, steps: int) -> tuple[float, float]:
    """The same by auto_LiRPA."""
    from auto_LiRPA import BoundedModule, BoundedTensor, PerturbationLpNorm  # pyright: ignore[reportMissingImports]

    pools = any(isinstance(part, nn.MaxPool2d) for part in model.modules())
    options = {"conv_mode": "matrix" if pools else "patches"}
    bounded = BoundedModule(model, x, options, device="cpu", verbose=False)
    bounded.set_bound_opts({"optimize_bound_args": {"iteration": steps, "lr_alpha": 0.5}})
    around = BoundedTensor(x, PerturbationLpNorm(norm=np.inf, eps=radius))
    start = time.perf_counter()
    lower, upper = bounded.compute_bounds(x=(around,), method="alpha-CROWN" if steps else "CROWN")
    return float((upper - lower).sum()), time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=list(NETWORKS), metavar="NAME", help=", ".join(NETWORKS))
    parser.add_argument("--steps", type=int, default=20, help="of slopes, on both sides (20)")
    parser.add_argument("--boxes", type=int, default=1, help="boxes of every network (1)")
    options = parser.parse_args()
    warnings.filterwarnings("ignore")
    torch.set_num_threads(1)
    print("| network | box | CROWN | s | s | float32 | alpha-CROWN | s | s | float32 |\n" + "|---" * 10 + "|")
    for name in options.names:
        make, shape, radius = NETWORKS[name]
        torch.manual_seed(0)
        model = make().eval()
        for number in range(options.boxes):
            x = torch.rand(1, *shape)
            model(x)
            with tempfile.TemporaryDirectory() as folder:
                file = Path(folder) / "network.onnx"
                torch.onnx.export(model, (x,), file, dynamo=False)
                network = read_onnx(file)
            cells = []
            for steps in (0, options.steps):
                peer, their_time = theirs(model, x, radius, steps)
                real, time_ = ours(network, x.numpy(), radius, "real", steps)
                single, _ = ours(network, x.numpy(), radius, "float32", steps)
                cells += [f"{real / peer:.4f}", f"{time_:.2f}", f"{their_time:.2f}", f"{single / peer:.4f}"]
            print("|", " | ".join([name, str(number), *cells]), "|", flush=True)


if __name__ == "__main__":
    main()
