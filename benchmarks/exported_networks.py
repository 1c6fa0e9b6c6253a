"""Which exported networks are read, and what one cell of them costs: both exporters of torch, random weights.

Each network is exported, loaded, bounded over one set of images, and attacked by float32 runs of onnxruntime in
the set and at its corners, drawn and along derivatives, in a process of its own.
Run ``python benchmarks/exported_networks.py --help``.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import nn
from torch.nn import functional

if TYPE_CHECKING:
    from ns_abstract.verify.network import ImageSets, Network, NetworkArithmetic

ROWS = 10


# ---------------------------------------------------------------- own shapes


class Conv(nn.Sequential):
    """Convolution, batch norm and an activation."""

    def __init__(self, cin: int, cout: int, k: int = 3, stride: int = 1, act: type[nn.Module] = nn.SiLU) -> None:
        super().__init__(nn.Conv2d(cin, cout, k, stride, k // 2, bias=False), nn.BatchNorm2d(cout), act())


class Stage(nn.Module):
    """YOLOv8's C2f: a split, bottlenecks, and everything joined."""

    def __init__(self, cin: int, cout: int, count: int, short: bool) -> None:
        super().__init__()
        self.half, self.short = cout // 2, short
        self.first = Conv(cin, cout, 1)
        self.inner = nn.ModuleList(
            [nn.Sequential(Conv(self.half, self.half), Conv(self.half, self.half)) for _ in range(count)]
        )
        self.last = Conv((2 + count) * self.half, cout, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        parts = list(self.first(x).chunk(2, 1))
        for inner in self.inner:
            parts.append(parts[-1] + inner(parts[-1]) if self.short else inner(parts[-1]))
        return self.last(torch.cat(parts, 1))


class Pyramid(nn.Module):
    """YOLOv8's pooling pyramid."""

    def __init__(self, channels: int, kernel: int = 3) -> None:
        super().__init__()
        self.first, self.last = Conv(channels, channels // 2, 1), Conv(channels * 2, channels, 1)
        self.pool = nn.MaxPool2d(kernel, 1, kernel // 2)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        parts = [self.first(x)]
        for _ in range(3):
            parts.append(self.pool(parts[-1]))
        return self.last(torch.cat(parts, 1))


class Yolo(nn.Module):
    """Backbone, upsampled neck and two heads, flattened and joined."""

    def __init__(self, width: int = 8, outputs: int = 6) -> None:
        super().__init__()
        w = width
        self.stem = nn.Sequential(Conv(3, w, 3, 2), Conv(w, 2 * w, 3, 2), Stage(2 * w, 2 * w, 1, True))
        self.deep = nn.Sequential(Conv(2 * w, 4 * w, 3, 2), Stage(4 * w, 4 * w, 1, True), Pyramid(4 * w))
        self.up = nn.Upsample(scale_factor=2, mode="nearest")
        self.neck = Stage(6 * w, 2 * w, 1, False)
        self.heads = nn.ModuleList([nn.Conv2d(2 * w, outputs, 1), nn.Conv2d(4 * w, outputs, 1)])

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        one = self.stem(x)
        two = self.deep(one)
        one = self.neck(torch.cat([self.up(two), one], 1))
        found = [head(v) for head, v in zip(self.heads, (one, two), strict=True)]
        return torch.cat([v.flatten(2) for v in found], 2).sigmoid()


class YoloTwo(Yolo):
    """The same with both heads as outputs."""

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:  # type: ignore[override]
        one = self.stem(x)
        two = self.deep(one)
        return self.heads[0](self.neck(torch.cat([self.up(two), one], 1))), self.heads[1](two)


class Nano(nn.Module):
    """The layers of YOLOv8n: five levels, three of them joined up and down, a head each for boxes and classes."""

    def __init__(self, classes: int = 4) -> None:
        super().__init__()
        self.one = nn.Sequential(Conv(3, 16, 3, 2), Conv(16, 32, 3, 2), Stage(32, 32, 1, True))
        self.two = nn.Sequential(Conv(32, 64, 3, 2), Stage(64, 64, 2, True))
        self.three = nn.Sequential(Conv(64, 128, 3, 2), Stage(128, 128, 2, True))
        self.four = nn.Sequential(Conv(128, 256, 3, 2), Stage(256, 256, 1, True), Pyramid(256, 5))
        self.up = nn.Upsample(scale_factor=2, mode="nearest")
        self.joins = nn.ModuleList(
            [Stage(384, 128, 1, False), Stage(192, 64, 1, False), Stage(192, 128, 1, False), Stage(384, 256, 1, False)]
        )
        self.downs = nn.ModuleList([Conv(64, 64, 3, 2), Conv(128, 128, 3, 2)])

        def head(channels: int, inner: int, outputs: int) -> nn.Sequential:
            return nn.Sequential(Conv(channels, inner), Conv(inner, inner), nn.Conv2d(inner, outputs, 1))

        self.boxes = nn.ModuleList([head(c, 64, 64) for c in (64, 128, 256)])
        self.classes = nn.ModuleList([head(c, 64, classes) for c in (64, 128, 256)])

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        two = self.two(self.one(x))
        three = self.three(two)
        four = self.four(three)
        middle = self.joins[0](torch.cat([self.up(four), three], 1))
        fine = self.joins[1](torch.cat([self.up(middle), two], 1))
        middle = self.joins[2](torch.cat([self.downs[0](fine), middle], 1))
        coarse = self.joins[3](torch.cat([self.downs[1](middle), four], 1))
        found = [
            torch.cat([box(v), kind(v).sigmoid()], 1).flatten(2)
            for box, kind, v in zip(self.boxes, self.classes, (fine, middle, coarse), strict=True)
        ]
        return torch.cat(found, 2)


class UNet(nn.Module):
    """Two levels down and up again."""

    def __init__(self, up: str = "transposed", act: type[nn.Module] = nn.ReLU, norm: str = "batch") -> None:
        super().__init__()

        def block(cin: int, cout: int) -> nn.Sequential:
            layer: nn.Module = nn.BatchNorm2d(cout)
            if norm == "group":
                layer = nn.GroupNorm(2, cout)
            elif norm == "instance":
                layer = nn.InstanceNorm2d(cout, affine=True)
            return nn.Sequential(nn.Conv2d(cin, cout, 3, padding=1), layer, act())

        self.down = nn.ModuleList([block(3, 4), block(4, 8)])
        self.pool, self.middle = nn.MaxPool2d(2), block(8, 8)

        def grow(cin: int, cout: int) -> nn.Module:
            if up == "transposed":
                return nn.ConvTranspose2d(cin, cout, 2, 2)
            return nn.Sequential(
                nn.Upsample(scale_factor=2, mode=up, align_corners=False if up == "bilinear" else None),
                nn.Conv2d(cin, cout, 1),
            )

        self.grow = nn.ModuleList([grow(8, 8), grow(8, 4)])
        self.up = nn.ModuleList([block(16, 8), block(8, 4)])
        self.head = nn.Conv2d(4, 2, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        kept = []
        for layer in self.down:
            x = layer(x)
            kept.append(x)
            x = self.pool(x)
        x = self.middle(x)
        for grow, layer, skip in zip(self.grow, self.up, reversed(kept), strict=True):
            x = layer(torch.cat([grow(x), skip], 1))
        return self.head(x)


class Attention(nn.Module):
    """Self-attention as in timm: one product for queries, keys and values."""

    def __init__(self, dim: int, heads: int, fused: bool) -> None:
        super().__init__()
        self.heads, self.fused = heads, fused
        self.qkv, self.out = nn.Linear(dim, 3 * dim), nn.Linear(dim, dim)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        b, n, c = x.shape
        q, k, v = self.qkv(x).reshape(b, n, 3, self.heads, c // self.heads).permute(2, 0, 3, 1, 4).unbind(0)
        if self.fused:
            x = functional.scaled_dot_product_attention(q, k, v)
        else:
            x = ((q * (c // self.heads) ** -0.5) @ k.transpose(-2, -1)).softmax(-1) @ v
        return self.out(x.transpose(1, 2).reshape(b, n, c))


class Vit(nn.Module):
    """A vision transformer with a class token."""

    def __init__(
        self, size: int = 16, patch: int = 8, dim: int = 8, heads: int = 2, fused: bool = False, depth: int = 1
    ):
        super().__init__()
        self.patch = nn.Conv2d(3, dim, patch, patch)
        self.token = nn.Parameter(torch.randn(1, 1, dim))
        self.position = nn.Parameter(0.1 * torch.randn(1, (size // patch) ** 2 + 1, dim))
        self.layers = nn.ModuleList()
        for _ in range(depth):
            mlp = nn.Sequential(nn.Linear(dim, 2 * dim), nn.GELU(), nn.Linear(2 * dim, dim))
            self.layers.append(nn.ModuleList([nn.LayerNorm(dim), Attention(dim, heads, fused), nn.LayerNorm(dim), mlp]))
        self.norm, self.head = nn.LayerNorm(dim), nn.Linear(dim, 4)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = self.patch(x).flatten(2).transpose(1, 2)
        x = torch.cat([self.token.expand(x.shape[0], -1, -1), x], 1) + self.position
        for one, attend, two, mlp in self.layers:  # type: ignore[misc]
            x = x + attend(one(x))
            x = x + mlp(two(x))
        return self.head(self.norm(x)[:, 0])


class Mixer(nn.Module):
    """An MLP mixer with one layer."""

    def __init__(self) -> None:
        super().__init__()
        self.patch = nn.Conv2d(3, 8, 8, 8)
        self.one, self.two = nn.LayerNorm(8), nn.LayerNorm(8)
        self.tokens = nn.Sequential(nn.Linear(4, 8), nn.GELU(), nn.Linear(8, 4))
        self.channels = nn.Sequential(nn.Linear(8, 16), nn.GELU(), nn.Linear(16, 8))
        self.head = nn.Linear(8, 4)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = self.patch(x).flatten(2).transpose(1, 2)
        x = x + self.tokens(self.one(x).transpose(1, 2)).transpose(1, 2)
        x = x + self.channels(self.two(x))
        return self.head(x.mean(1))


class PixelShuffled(nn.Module):
    """A super-resolution network."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(3, 8, 3, padding=1), nn.PReLU(8), nn.Conv2d(8, 12, 3, padding=1), nn.PixelShuffle(2)
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.layers(x).clamp(0, 1)


class Odds(nn.Module):
    """What small scripts use: flips, ranges of axes, extremes, padding by a number."""

    def __init__(self) -> None:
        super().__init__()
        self.conv, self.line = nn.Conv2d(3, 4, 3), nn.Linear(8, 3)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = functional.pad(self.conv(x.flip(3)), (1, 1, 1, 1), value=0.5)
        x = torch.maximum(x, 0.1 * x - 0.2).abs()
        x = x[:, :, ::2, ::2] - x.mean(1, keepdim=True)[:, :, 1::2, 1::2]
        return functional.log_softmax(self.line(torch.cat([x.amax((2, 3)), x.sum((2, 3)) / 64], 1)), 1)


class Plain(nn.Module):
    """Two convolutions and an activation between."""

    def __init__(self, act: nn.Module) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(3, 6, 3, 2), nn.BatchNorm2d(6), act, nn.Conv2d(6, 6, 3, 2), act, nn.Flatten(), nn.Linear(54, 5)
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.layers(x)


class Excited(nn.Module):
    """A squeeze-and-excite block of EfficientNet."""

    def __init__(self) -> None:
        super().__init__()
        self.stem, self.wide, self.last = Conv(3, 8, 3, 2), Conv(8, 16, 1), nn.Conv2d(16, 8, 1)
        self.one, self.two, self.head = nn.Conv2d(16, 4, 1), nn.Conv2d(4, 16, 1), nn.Linear(8, 4)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = self.wide(self.stem(x))
        gate = torch.sigmoid(self.two(functional.silu(self.one(x.mean((2, 3), keepdim=True)))))
        return self.head(self.last(x * gate).mean((2, 3)))


def _torchvision(name: str, **settings: Any) -> Callable[[], nn.Module]:
    def make() -> nn.Module:
        import torchvision

        return getattr(torchvision.models, name)(weights=None, num_classes=10, **settings)

    return make


def _timm(name: str, **settings: Any) -> Callable[[], nn.Module]:
    def make() -> nn.Module:
        import timm

        return timm.create_model(name, pretrained=False, num_classes=10, **settings)

    return make


def _timm_class(module: str, name: str, **settings: Any) -> Callable[[], nn.Module]:
    """Made by its class: `create_model` has sizes of its own and passes none twice."""

    def make() -> nn.Module:
        import importlib

        found = importlib.import_module(f"timm.models.{module}")
        made = {k: getattr(found, v) if k.endswith("_layer") else v for k, v in settings.items()}
        return getattr(found, name)(num_classes=10, **made)

    return make


def _features(name: str, channels: int) -> Callable[[], nn.Module]:
    """Without the classifier, which wants larger images."""

    def make() -> nn.Module:
        import torchvision

        features = getattr(torchvision.models, name)(weights=None).features
        return nn.Sequential(features, nn.Flatten(), nn.Linear(channels, 10))

    return make


#: Name: how to make it, and the side of its images.
NETWORKS: dict[str, tuple[Callable[[], nn.Module], int]] = {
    **{
        f"plain {name}": (lambda act=act: Plain(act()), 16)
        for name, act in {
            "ReLU": nn.ReLU,
            "ReLU6": nn.ReLU6,
            "LeakyReLU": nn.LeakyReLU,
            "SiLU": nn.SiLU,
            "GELU": nn.GELU,
            "GELU tanh": lambda: nn.GELU("tanh"),
            "Hardswish": nn.Hardswish,
            "Hardsigmoid": nn.Hardsigmoid,
            "Hardtanh": nn.Hardtanh,
            "Mish": nn.Mish,
            "ELU": nn.ELU,
            "SELU": nn.SELU,
            "CELU": nn.CELU,
            "Softplus": nn.Softplus,
            "PReLU": nn.PReLU,
            "Tanh": nn.Tanh,
            "Sigmoid": nn.Sigmoid,
            "Softsign": nn.Softsign,
            "LogSigmoid": nn.LogSigmoid,
        }.items()
    },
    "YOLO shape": (Yolo, 32),
    "YOLO shape, two outputs": (YoloTwo, 32),
    "YOLOv8n's layers at 64": (Nano, 64),
    "YOLOv8n's layers at 128": (Nano, 128),
    "U-Net transposed": (UNet, 16),
    "U-Net bilinear": (lambda: UNet("bilinear", nn.SiLU), 16),
    "U-Net nearest, group norm": (lambda: UNet("nearest", nn.SiLU, "group"), 16),
    "U-Net instance norm": (lambda: UNet("nearest", nn.LeakyReLU, "instance"), 16),
    "ViT": (Vit, 16),
    "ViT fused attention": (lambda: Vit(fused=True), 16),
    "ViT two layers": (lambda: Vit(depth=2), 16),
    "MLP mixer": (Mixer, 16),
    "pixel shuffle": (PixelShuffled, 12),
    "odds": (Odds, 12),
    "squeeze and excite": (Excited, 16),
    "alexnet's features": (_features("alexnet", 256), 64),
    "vgg11's features": (_features("vgg11", 512), 32),
    "resnet18": (_torchvision("resnet18"), 32),
    "resnet18 at 64": (_torchvision("resnet18"), 64),
    "resnet18 at 128": (_torchvision("resnet18"), 128),
    "resnet18 at 224": (_torchvision("resnet18"), 224),
    "mobilenet_v2 at 128": (_torchvision("mobilenet_v2"), 128),
    "squeezenet1_1": (_torchvision("squeezenet1_1"), 32),
    "mobilenet_v2 x0.25": (_torchvision("mobilenet_v2", width_mult=0.25), 32),
    "mobilenet_v3_small x0.25": (_torchvision("mobilenet_v3_small", width_mult=0.25), 32),
    "mnasnet0_5": (_torchvision("mnasnet0_5"), 32),
    "shufflenet_v2_x0_5": (_torchvision("shufflenet_v2_x0_5"), 32),
    "efficientnet_b0": (_torchvision("efficientnet_b0"), 32),
    "densenet121": (_torchvision("densenet121"), 32),
    "googlenet": (_torchvision("googlenet", aux_logits=False, init_weights=False), 32),
    "regnet_y_400mf": (_torchvision("regnet_y_400mf"), 32),
    "convnext_tiny": (_torchvision("convnext_tiny"), 32),
    "swin_t": (_torchvision("swin_t"), 32),
    "vit_b_32": (_torchvision("vit_b_32", image_size=64), 64),
    "timm resnet26d": (_timm("resnet26d"), 32),
    "timm mobilenetv3_small_050": (_timm("mobilenetv3_small_050"), 32),
    "timm lcnet_035": (_timm("lcnet_035"), 32),
    "timm tinynet_e": (_timm("tinynet_e"), 32),
    "timm ghostnet_050": (_timm("ghostnet_050"), 32),
    "timm tf_efficientnet_lite0": (_timm("tf_efficientnet_lite0"), 32),
    "timm repvgg_a2": (_timm("repvgg_a2"), 32),
    "timm cspdarknet53": (_timm("cspdarknet53"), 32),
    "timm dla34": (_timm("dla34"), 32),
    "timm vit_tiny, two layers": (
        _timm_class(
            "vision_transformer", "VisionTransformer", img_size=32, patch_size=16, embed_dim=192, depth=2, num_heads=3
        ),
        32,
    ),
    "timm mixer_s32, two blocks": (
        _timm_class("mlp_mixer", "MlpMixer", img_size=64, patch_size=32, num_blocks=2, embed_dim=512),
        64,
    ),
    "timm resmlp_12, two blocks": (
        _timm_class(
            "mlp_mixer",
            "MlpMixer",
            img_size=32,
            patch_size=16,
            num_blocks=2,
            embed_dim=384,
            mlp_ratio=4,
            block_layer="ResBlock",
            norm_layer="Affine",
        ),
        32,
    ),
    "timm poolformer_s12": (_timm("poolformer_s12"), 32),
    "inception_v3": (_torchvision("inception_v3", aux_logits=False, init_weights=False), 75),
}


# ---------------------------------------------------------------- one network


def export(name: str, exporter: str, file: Path) -> tuple[int, ...]:
    from ns_abstract.nerfstudio.torchvision_operators import declare_missing

    # torchvision and timm, and with dynamo the exporter itself, import torchvision's operators
    declare_missing()
    torch.manual_seed(0)
    make, side = NETWORKS[name]
    module = make().eval()
    for layer in module.modules():
        if isinstance(layer, nn.BatchNorm2d):
            assert layer.running_mean is not None and layer.running_var is not None
            layer.running_mean.normal_(0.0, 0.1)
            layer.running_var.uniform_(0.5, 1.5)
    image = torch.randn(1, 3, side, side)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if exporter == "dynamo":
            torch.onnx.export(module, (image,), str(file), dynamo=True, verbose=False)
        else:
            torch.onnx.export(module, (image,), str(file), dynamo=False, opset_version=int(exporter))
    return 3, side, side


def measure(name: str, exporter: str, runs: int, width: float, arithmetic: NetworkArithmetic) -> dict[str, Any]:
    """Everything about one network; runs in a process of its own.

    Bounds in real arithmetic are attacked by the network as it was read, in float64.
    """
    import onnxruntime

    from ns_abstract.io.errors import InputError
    from ns_abstract.verify.network import bound_outputs, load_network

    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "net.onnx"
        found: dict[str, Any] = {"name": name, "exporter": exporter}
        try:
            shape = export(name, exporter, file)
        except TimeoutError:
            raise
        except Exception as error:
            return {**found, "status": "not exported", "why": repr(error).splitlines()[0][:120]}
        start = time.perf_counter()
        try:
            network = load_network(file)
        except InputError as error:
            return {**found, "status": "refused", "why": f"{error.field or ''}: {error.problem}; {error.fix}"[:200]}
        found.update(status="loaded", layers=len(network.nodes), load=round(time.perf_counter() - start, 2))
        print(json.dumps(found), flush=True)
        if not runs:
            return found
        images, middle, a, slack = image_set(shape, width)
        k = min(ROWS, network.output_size)
        rows = np.concatenate([np.eye(k, network.output_size), -np.eye(k, network.output_size)])
        # the process's peak from here on
        Path("/proc/self/clear_refs").write_text("5")
        start = time.process_time()
        bounds = bound_outputs(network, images, rows, np.zeros(2 * k), arithmetic=arithmetic)
        found["seconds"] = round(time.process_time() - start, 2)
        peak = next(v for v in Path("/proc/self/status").read_text().splitlines() if v.startswith("VmHWM"))
        found["GiB"] = round(int(peak.split()[1]) / 2**20, 2)
        lower = bounds.lower[0]
        found["bounded"] = bool(np.isfinite(lower).all())
        found["width"] = float(f"{-np.median(lower[:k] + lower[k:]):.3g}")
        print(json.dumps(found), flush=True)
        session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
        entry = session.get_inputs()[0].name

        def output(x: np.ndarray) -> np.ndarray:
            if arithmetic == "real":
                return network(torch.from_numpy(x).reshape(1, *shape))[0].numpy()
            outputs = session.run(None, {entry: x.astype(np.float32).reshape(1, *shape)})
            return np.concatenate([np.asarray(v).reshape(-1) for v in outputs]).astype(np.float64)

        for kind, chosen in (
            ("random", random_runs(runs, d=a.shape[1], n=network.input_size)),
            ("searched", searched_runs(network, shape, middle, a, rows)),
        ):
            outside, least, done = 0, np.full(2 * k, np.inf), 0
            for p, t in chosen:
                # a hair inside: of what float32 makes of the image
                y = rows @ output(a @ p + middle + 0.999 * slack * t)
                least, done = np.minimum(least, y), done + 1
                outside += int((y < lower).sum() + (y < bounds.a[0] @ p + bounds.b[0]).sum())
            found[kind] = {"runs": done, "outside": outside}
            spread = (least[:k] + least[k:]) * -0.5
            moves = spread > 0.0
            if moves.any():
                ratios = ((lower[:k] + lower[k:]) * -0.5)[moves] / spread[moves]
                found[kind]["ratio"] = float(f"{np.median(ratios):.3g}")
        return found


def image_set(shape: tuple[int, ...], width: float) -> tuple[ImageSets, np.ndarray, np.ndarray, float]:
    """A set of images of blocks of one colour in two parameters.

    Returns:
        The set, its middle [n], slopes [n, 2] and how far each number moves alone.
    """
    from ns_abstract.verify.network import ImageSets

    rng = np.random.default_rng(0)
    n, d = int(np.prod(shape)), 2
    c = np.repeat(np.repeat(rng.normal(size=(3, 4, 4)), -(-shape[1] // 4), 1), -(-shape[2] // 4), 2)
    c = c[:, : shape[1], : shape[2]].reshape(1, n)
    a = width * rng.normal(size=(1, n, d))
    slack = 0.1 * width
    reach = np.abs(a).sum(-1) + slack
    return ImageSets(a, c - slack, a, c + slack, c - reach, c + reach), c[0], a[0], slack


#: Parameters [d] and what every number moves by alone [n], both in [-1, 1].
Run = tuple[np.ndarray, np.ndarray]


def random_runs(runs: int, d: int, n: int) -> Iterator[Run]:
    """Places in the set and corners of it, drawn."""
    rng = np.random.default_rng(1)
    for i in range(runs):
        p = rng.uniform(-1, 1, d) if i % 2 else rng.choice([-1.0, 1.0], d)
        yield p, rng.uniform(-1, 1, n) if i % 3 else 2.0 * rng.integers(0, 2, n) - 1.0


def searched_runs(
    network: Network, shape: tuple[int, ...], middle: np.ndarray, a: np.ndarray, rows: np.ndarray
) -> Iterator[Run]:
    """By row: the corner at which it is least, as its derivative in the middle has it."""
    for row in rows:
        x = torch.from_numpy(middle).reshape(1, *shape).requires_grad_()
        (network(x)[0] @ torch.from_numpy(row)).backward()
        assert x.grad is not None
        slope = x.grad.numpy().reshape(-1)
        yield -np.sign(slope @ a), -np.sign(slope)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", default=None, help="parts of names")
    parser.add_argument("--exact", nargs="*", default=None, help="whole names")
    parser.add_argument("--exporters", nargs="*", default=["dynamo", "17"], help="dynamo or operator sets")
    parser.add_argument("--runs", type=int, default=2000, help="of onnxruntime; 0: networks are loaded and not bounded")
    parser.add_argument("--width", type=float, default=2e-3, help="how far an image moves with one parameter")
    parser.add_argument("--arithmetic", choices=["float32", "real"], default="float32", help="that bounds are of")
    parser.add_argument("--limit", type=float, default=300.0, help="processor seconds a network may take")
    parser.add_argument("--output", type=Path, default=None, help="JSON lines")
    parser.add_argument("--together", action="store_true", help="in one process: quicker, and an end ends all")
    parser.add_argument("--one", nargs=2, default=None, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        print(json.dumps(measure(*arguments.one, arguments.runs, arguments.width, arguments.arithmetic)), flush=True)
        return
    signal.signal(signal.SIGALRM, _late)
    for name in NETWORKS:
        if arguments.only and not any(part in name for part in arguments.only):
            continue
        if arguments.exact is not None and name not in arguments.exact:
            continue
        for exporter in arguments.exporters:
            if arguments.together:
                signal.alarm(int(arguments.limit))
                try:
                    found = measure(name, exporter, arguments.runs, arguments.width, arguments.arithmetic)
                except TimeoutError:
                    found = {"name": name, "exporter": exporter, "why": f"more than {arguments.limit:.0f} s"}
                signal.alarm(0)
                _report(found, arguments.output)
                continue
            command = [sys.executable, __file__, "--one", name, exporter]
            command += ["--runs", str(arguments.runs), "--width", str(arguments.width)]
            command += ["--arithmetic", arguments.arithmetic]
            try:
                # of a busy machine a process may get a tenth
                command = ["prlimit", f"--cpu={arguments.limit:.0f}", *command]
                done = subprocess.run(
                    command, capture_output=True, text=True, timeout=10 * arguments.limit, env=os.environ, check=False
                )
                text, end = done.stdout, done.stderr.strip().splitlines()[-1:] if done.returncode else []
                if done.returncode in (-signal.SIGXCPU, -signal.SIGKILL):
                    end = [f"more than {arguments.limit:.0f} s"]
            except subprocess.TimeoutExpired as error:
                text = (error.stdout or b"").decode() if isinstance(error.stdout, bytes) else error.stdout or ""
                end = [f"more than {arguments.limit:.0f} s"]
            lines = [line for line in text.splitlines() if line.startswith("{")]
            found = json.loads(lines[-1]) if lines else {"name": name, "exporter": exporter, "status": "failed"}
            if end:
                found["why"] = end[0][:160]
            _report(found, arguments.output)


def _report(found: dict[str, Any], output: Path | None) -> None:
    print(json.dumps(found), flush=True)
    if output:
        with output.open("a") as stream:
            stream.write(json.dumps(found) + "\n")


def _late(*_: Any) -> None:
    raise TimeoutError


if __name__ == "__main__":
    main()
