"""Attack on the charges of networks: a search for a float32 program whose outputs leave their bounds.

Networks of one to three layers with extreme constants are made at random. The search then changes constants, images
and layers, and keeps what brings the output of any float32 program nearest to its bound, relative to the bounds' width
for a single image, until it finds an output outside, or nothing new for a while.

    python benchmarks/network_attack.py [--seconds S] [--seed N]

prints what was compared and how near the programs came, by kind of layer; the exit code is 1 if any output was outside.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.nn import functional

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import extreme_networks as extreme  # noqa: E402  # pyright: ignore[reportMissingImports]

from ns_abstract.io.errors import InputError  # noqa: E402
from ns_abstract.verify.network import ImageSets, Network, bound_outputs  # noqa: E402
from ns_abstract.verify.network.load import read_onnx  # noqa: E402

Array = np.ndarray
#: Powers of two that constants and images are multiplied by.
POWERS = (-149, -140, -127, -126, -100, -64, -24, -12, -1, 1, 12, 24, 64, 100, 120)
#: Changes without a gain after which the next network is made.
PATIENCE = 24


@dataclass(frozen=True)
class Gene:
    """One layer: its kind and its constants."""

    kind: str
    values: dict[str, Array] = field(default_factory=dict)


@dataclass(frozen=True)
class Genome:
    """A network on vectors of ``n`` numbers, and an image."""

    n: int
    genes: tuple[Gene, ...]
    image: Array


#: kind: names of constants, "w" [n, n], "s" one number, others [n]
KINDS: dict[str, tuple[str, ...]] = {
    "gemm": ("w", "b"),
    "sum": ("w", "b"),
    "scale": ("a", "t"),
    "shift": ("a", "t"),
    "batch norm": ("a", "t", "m", "v"),
    "computed": ("a", "t", "m"),
    "relu": (),
    "leaky": ("s",),
    "prelu": ("a",),
    "clip": ("s",),
    "hard sigmoid": ("s",),
    "square": (),
    "cube": (),
    "root": (),
    "inverse root": (),
    "fractional power": (),
    "local response": ("s",),
    "reciprocal": (),
    "norm": (),
    "spelled norm": (),
    "softmax": (),
    "log softmax": (),
    "residual": (),
    "gate": (),
    "product": (),
    "maximum": ("t",),
    "mean": (),
    "quotient": ("s",),
    "attention": ("a",),
    "quantised": ("s",),
    **dict.fromkeys(("Abs", "Exp", "Sigmoid", "Tanh", "Erf", "Elu", "Selu", "Softplus", "HardSwish", "Mish"), ()),
    "Gelu": (),
    "Log": (),
}
SIMPLE: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
    "Abs": torch.abs,
    "Exp": torch.exp,
    "Sigmoid": torch.sigmoid,
    "Tanh": torch.tanh,
    "Erf": torch.erf,
    "Elu": functional.elu,
    "Selu": functional.selu,
    "Softplus": lambda x: torch.log1p(torch.exp(-x.abs())) + torch.relu(x),
    "HardSwish": functional.hardswish,
    "Mish": functional.mish,
    "Log": torch.log,
}


def _values(rng: np.random.Generator, shape: tuple[int, ...], power: int) -> Array:
    value = np.ldexp(rng.normal(size=shape), power)
    if rng.random() < 0.3:
        value = np.ldexp(np.sign(value) * (1.0 + np.ldexp(rng.integers(-2, 3, shape), -23)), power)
    return np.clip(value, -1e37, 1e37).astype(np.float32)


def random_gene(rng: np.random.Generator, n: int, kinds: tuple[str, ...]) -> Gene:
    kind = str(rng.choice(kinds))
    power = int(rng.choice([0, 0, 0, *POWERS]))
    shapes = {"w": (n, n), "s": ()}
    values = {name: _values(rng, shapes.get(name, (n,)), power) for name in KINDS[kind]}
    for name in ("v", "s"):
        if name in values:
            values[name] = np.abs(values[name])
    return Gene(kind, values)


def random_genome(rng: np.random.Generator, kinds: tuple[str, ...] = tuple(KINDS)) -> Genome:
    n = int(rng.choice([1, 2, 3, 8, 17]))
    genes = tuple(random_gene(rng, n, kinds) for _ in range(int(rng.integers(1, 4))))
    image = rng.normal(size=n) + rng.choice([0.0, 0.0, 5.0, 1000.0])
    if rng.random() < 0.3:
        image = np.full(n, image[0]) + np.ldexp(rng.normal(size=n), -int(rng.integers(4, 24)))
    if rng.random() < 0.2:
        image = np.ldexp(image, int(rng.choice(POWERS)))
    return Genome(n, genes, np.clip(image, -1e37, 1e37).astype(np.float32))


def changed(rng: np.random.Generator, genome: Genome, kinds: tuple[str, ...]) -> Genome:
    """The genome with one change."""
    genes, choice = list(genome.genes), rng.random()
    if choice < 0.1:
        genes[int(rng.integers(len(genes)))] = random_gene(rng, genome.n, kinds)
        return replace(genome, genes=tuple(genes))
    if choice < 0.15 and len(genes) < 3:
        genes.insert(int(rng.integers(len(genes) + 1)), random_gene(rng, genome.n, kinds))
        return replace(genome, genes=tuple(genes))
    at = int(rng.integers(len(genes)))
    if choice < 0.4 or not genes[at].values:
        return replace(genome, image=_changed(rng, genome.image))
    name = str(rng.choice(list(genes[at].values)))
    value = _changed(rng, genes[at].values[name])
    if name in ("v", "s"):
        value = np.abs(value)
    genes[at] = Gene(genes[at].kind, {**genes[at].values, name: value})
    return replace(genome, genes=tuple(genes))


def _changed(rng: np.random.Generator, value: Array) -> Array:
    """Some numbers multiplied by a power of two, nudged, exchanged or negated, or all of them."""
    found = value.astype(np.float64).reshape(-1).copy()
    chosen = rng.random(found.size) < rng.choice([0.2, 0.5, 1.0])
    kind = int(rng.integers(0, 6))
    if kind == 0:
        found[chosen] = np.ldexp(found[chosen], int(rng.choice(POWERS)) // int(rng.choice([1, 4, 12])))
    elif kind == 1:
        found[chosen] *= 1.0 + np.ldexp(rng.normal(size=int(chosen.sum())), -int(rng.integers(1, 24)))
    elif kind == 2:
        found[chosen] = -rng.permutation(found)[chosen]
    elif kind == 3:
        found[chosen] = found[int(rng.integers(found.size))]
    elif kind == 4:
        # products of such numbers are rounded by half a unit
        found[chosen] = np.ldexp(1.0 + np.ldexp(2.0 * rng.integers(1, 1 << 12, int(chosen.sum())) + 1.0, -14), 0)
    else:
        found = np.full(found.size, found[0]) + np.ldexp(rng.normal(size=found.size), -int(rng.integers(4, 24)))
    with np.errstate(over="ignore", invalid="ignore"):
        return np.clip(np.nan_to_num(found), -1e37, 1e37).astype(np.float32).reshape(value.shape)


def layer(gene: Gene, n: int) -> Any:
    """The gene as `extreme_networks.Layer`."""
    kind, v = gene.kind, gene.values
    if kind in ("gemm", "sum"):
        return extreme.gemm(v["w"] if kind == "gemm" else np.ones((n, n)), v["b"])
    if kind in ("scale", "shift"):
        return extreme.scale(v["a"], v["t"], kind == "shift")
    if kind == "batch norm":
        return extreme.batch_norm(v["a"], v["t"], v["m"], v["v"])
    if kind == "leaky":
        alpha = float(v["s"]) if float(v["s"]) <= 1.0 else 0.01
        return extreme.plain("LeakyRelu", lambda x: functional.leaky_relu(x, alpha), alpha=alpha)
    if kind == "clip":
        return extreme.clip(-float(v["s"]), float(v["s"]))
    if kind in ("norm", "spelled norm"):
        return extreme.layer_norm(n, op=kind == "norm")
    powers = {
        "square": 2.0,
        "cube": 3.0,
        "root": 0.5,
        "inverse root": -0.5,
        "reciprocal": -1.0,
        "fractional power": -0.75,
    }
    if kind in powers:
        return extreme.power(powers[kind])
    if kind == "relu":
        return extreme.plain("Relu", torch.relu)
    if kind in SIMPLE:
        return extreme.plain(kind, SIMPLE[kind])
    if kind in ("softmax", "log softmax"):
        op = "Softmax" if kind == "softmax" else "LogSoftmax"
        step = torch.softmax if kind == "softmax" else torch.log_softmax
        return extreme.plain(op, lambda x: step(x, -1), axis=-1)
    if kind in ("residual", "gate", "mean"):
        return extreme.joined(kind)
    return joined(gene, n)


def joined(gene: Gene, n: int) -> Any:
    """Layers of several nodes."""
    kind, v = gene.kind, dict(gene.values)
    t = {name: torch.from_numpy(np.asarray(value)) for name, value in v.items()}
    s = float(v["s"]) if "s" in v else 0.0

    def write(f: Any) -> None:
        x = f.last
        c = {name: f.constant(value) for name, value in v.items()}
        if kind == "computed":
            f.node("Add", f.node("Mul", x, f.node("Mul", c["a"], c["m"])), f.node("Sub", c["t"], c["m"]))
        elif kind == "prelu":
            f.node("PRelu", x, c["a"])
        elif kind == "hard sigmoid":
            f.node("HardSigmoid", x, alpha=s, beta=0.5)
        elif kind == "product":
            f.node("Mul", x, f.node("Relu", x))
        elif kind == "maximum":
            f.node("Max", x, f.node("Add", x, c["t"]))
        elif kind == "quotient":
            f.node("Div", x, f.node("Add", f.node("Abs", x), c["s"]))
        elif kind == "attention":
            f.node("Unsqueeze", f.node("Mul", x, c["a"]), f.constant([-1], np.int64))
            row = f.node("Unsqueeze", x, f.constant([1], np.int64))
            scores = f.node("Softmax", f.node("MatMul", f"v{len(f.nodes) - 2}", row), axis=-1)
            f.node("Squeeze", f.node("MatMul", scores, f.node("Unsqueeze", x, f.constant([-1], np.int64))),
                   f.constant([-1], np.int64))  # fmt: skip
        elif kind == "local response":
            f.node("Reshape", x, f.constant([0, n, 1, 1], np.int64))
            f.node("LRN", f.last, size=3, alpha=min(s, 1e30), beta=0.75, bias=1.0)
            f.node("Flatten")
        elif kind == "quantised":
            zero = f.constant(0, np.int8)
            f.node("DequantizeLinear", f.node("QuantizeLinear", x, c["s"], zero), c["s"], zero)
        else:
            half = f.node("Mul", x, f.constant(0.5))
            f.node("Mul", half, f.node("Add", f.node("Erf", f.node("Mul", x, f.constant(np.sqrt(0.5)))), f.constant(1)))

    steps: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
        "computed": lambda x: x * (t["a"] * t["m"]) + (t["t"] - t["m"]),
        "prelu": lambda x: torch.where(x >= 0, x, x * t["a"]),
        "hard sigmoid": lambda x: (x * s + 0.5).clamp(0.0, 1.0),
        "product": lambda x: x * torch.relu(x),
        "maximum": lambda x: torch.maximum(x, x + t["t"]),
        "quotient": lambda x: x / (x.abs() + t["s"]),
        "attention": lambda x: (
            torch.softmax((x * t["a"])[..., None] @ x[:, None], -1) @ x[..., None]
        )[..., 0],
        "quantised": lambda x: (x / t["s"]).round().clamp(-128, 127) * t["s"],
        "local response": lambda x: (
            functional.local_response_norm(x[:, :, None, None], 3, min(s, 1e30), 0.75, 1.0).flatten(1)
        ),
        "Gelu": functional.gelu,
    }  # fmt: skip
    return extreme.Layer(write, steps[kind], kind=kind)


def bounds(network: Network, image: Array) -> tuple[Array, Array]:
    """Bounds [m] of the outputs for one image."""
    flat = np.asarray(image, np.float64).reshape(1, -1)
    zero, m = np.zeros((*flat.shape, 1)), network.output_size
    rows = np.concatenate([np.eye(m), -np.eye(m)])
    found = bound_outputs(network, ImageSets(zero, flat, zero, flat, flat, flat), rows, np.zeros(2 * m)).lower[0]
    return found[:m], -found[m:]


def nearness(genome: Genome, folder: Path) -> tuple[float, str, int]:
    """(Greatest distance from the bounds' middle over half of their width, program, outputs compared).

    An output is outside where the first is above 1.

    Raises:
        InputError: The network is refused.
    """
    net = extreme.Extreme((genome.n,), [layer(gene, genome.n) for gene in genome.genes])
    file = net.write(folder / "net.onnx")
    network = read_onnx(file)
    low, high = bounds(network, genome.image)
    finite = np.isfinite(low) & np.isfinite(high)
    if not finite.any():
        return 0.0, "", 0
    try:
        runners = extreme.runs(file)
    except Exception:  # onnxruntime refuses some networks itself
        runners = []
    best, by, compared = 0.0, "", 0
    middle, half = 0.5 * (low + high)[finite], 0.5 * (high - low)[finite]
    for name, y in net.values(genome.image[None], runners):
        y = y.astype(np.float64)[:, finite]
        outside = ~((y >= low[finite]) & (y <= high[finite]))
        with np.errstate(all="ignore"):
            ratio = np.where(half > 0.0, np.abs(y - middle) / half, 0.0)
        ratio = np.where(outside, np.maximum(np.nan_to_num(ratio, nan=np.inf), 1.0 + 1e-9), np.minimum(ratio, 1.0))
        compared += y.size
        if float(ratio.max()) > best:
            best, by = float(ratio.max()), name
    return best, by, compared


@dataclass
class Record:
    """What an attack has found."""

    networks: int = 0
    compared: int = 0
    finite: int = 0
    refused: int = 0
    nearest: dict[str, float] = field(default_factory=dict)
    outside: list[tuple[Genome, float, str]] = field(default_factory=list)
    unread: Counter[str] = field(default_factory=Counter)


def attack(seconds: float, seed: int = 0, kinds: tuple[str, ...] = tuple(KINDS), networks: int = 1 << 30) -> Record:
    """Search for ``seconds`` or until ``networks`` were tried."""
    rng, record, end = np.random.default_rng(seed), Record(), time.monotonic() + seconds

    def tried(genome: Genome, folder: Path) -> float:
        record.networks += 1
        try:
            ratio, by, compared = nearness(genome, folder)
        except InputError as error:
            record.refused += 1
            record.unread[str(error).split(": ", 1)[-1][:60]] += 1
            return 0.0
        record.compared, record.finite = record.compared + compared, record.finite + bool(compared)
        if ratio > 1.0:
            record.outside.append((genome, ratio, by))
        for gene in genome.genes:
            record.nearest[gene.kind] = max(record.nearest.get(gene.kind, 0.0), ratio)
        return ratio

    with tempfile.TemporaryDirectory() as name, np.errstate(all="ignore"):
        folder = Path(name)
        while time.monotonic() < end and record.networks < networks:
            genome = random_genome(rng, kinds)
            best, idle = tried(genome, folder), 0
            while idle < PATIENCE and best <= 1.0 and time.monotonic() < end and record.networks < networks:
                other = changed(rng, genome, kinds)
                ratio = tried(other, folder)
                idle = 0 if ratio > best else idle + 1
                if ratio >= best:
                    genome, best = other, ratio
                if best == 0.0 and idle > 3:
                    break
    return record


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    found = attack(options.seconds, options.seed)
    print(
        f"{found.networks:,} networks, {found.finite:,} with finite bounds, {found.refused:,} refused, "
        f"{found.compared:,} outputs compared, {len(found.outside)} networks outside"
    )
    for kind, ratio in sorted(found.nearest.items()):
        print(f"  {kind:14} {ratio:.3f}")
    for genome, ratio, by in found.outside[:20]:
        print(f"outside by {by}: {ratio:.6g}", genome.image.tolist())
        for gene in genome.genes:
            print("   ", gene.kind, {name: value.tolist() for name, value in gene.values.items()})
    return 1 if found.outside else 0


if __name__ == "__main__":
    sys.exit(main())
