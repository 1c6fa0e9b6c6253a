"""Ledger of networks' charges: the largest float32 error seen over the error charged, for every kind of layer.

Networks of one or two layers are evaluated on random and extreme images and constants (subnormal, huge, cancelling,
nearly constant) by onnxruntime (every level of graph optimisation, one and two threads), torch (eager; compiled with
``--compiled``), and numpy (sums one after another and by pairs, norms in one pass, folded scales), with subnormal
numbers kept and flushed, and beside them with 200 bits. A ratio above 1 is a bug; a ratio far below 1 is room.

    python benchmarks/network_ledger.py [--count N] [--compiled] [--write]

prints the table; ``--write`` puts it into docs/dev/measurements.md and writes docs/dev/network-charges.md anew.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import onnxruntime
import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "benchmarks")]

import extreme_networks as extreme  # noqa: E402  # pyright: ignore[reportMissingImports]
import network_attack as attack  # noqa: E402  # pyright: ignore[reportMissingImports]
from network_charges_page import CHARGES, page  # noqa: E402  # pyright: ignore[reportMissingImports]
from network_table import ROWS  # noqa: E402  # pyright: ignore[reportMissingImports]

from ns_abstract.io.errors import InputError  # noqa: E402
from ns_abstract.verify.network import ImageSets, bound_outputs  # noqa: E402
from ns_abstract.verify.network.load import read_onnx  # noqa: E402

PAGE = ROOT / "docs" / "dev" / "measurements.md"
MARKS = "<!-- ledger of networks -->", "<!-- end of the ledger of networks -->"
BITS = 200
Array = np.ndarray
Number = Any
Vector = list[Any]
#: What is not measured here, and why.
UNMEASURED = {
    "overflow": "a limit, no error",
    "share of a sum that is cut off": "of real arithmetic",
    "switched softplus": "of real arithmetic",
    "functions with constants of the file": "of real arithmetic",
}
#: Kinds of `network_attack.KINDS`, one layer after another, that measure a row.
MEASURED: dict[str, tuple[tuple[str, ...], ...]] = {
    "layer of sums: fully connected, (transposed) convolution, mean, average pooling": (("gemm",), ("sum",), ("mean",)),
    "shift folded into the sums behind it": (("scale", "gemm"), ("shift", "gemm"), ("batch norm", "gemm")),
    "scale, shift, batch normalisation": (("scale",), ("shift",), ("batch norm",), ("gemm", "scale")),
    "sum of nodes": (("mean",), ("gemm", "residual")),
    "flushed numbers of every linear layer": (("scale", "scale"), ("gemm", "scale", "scale")),
    "variance of a norm": (("norm",), ("spelled norm",)),
    "sums over windows of channels": (("local response",),),
    "maximum, minimum": (("maximum",),),
    "product of two values, matrix product": (("product",), ("attention",)),
    "computed constants": (("computed",),),
    "resized map": (("linear map",), ("cubic map",)),
    "ReLU": (("scale", "relu", "scale"),),
    "leaky ReLU": (("leaky",), ("prelu",)),
    "sigmoid, tanh": (("Sigmoid",), ("Tanh",)),
    "clip": (("clip", "scale"),),
    "hard sigmoid": (("hard sigmoid",),),
    "absolute value": (("Abs", "scale"),),
    "hard swish": (("HardSwish",),),
    "square": (("square",),),
    "power of a whole number": (("cube",),),
    "reciprocal, quotient": (("reciprocal",), ("quotient",)),
    "root": (("root",),),
    "reciprocal root": (("inverse root",),),
    "power of positive numbers": (("fractional power",),),
    "exponential": (("Exp",),),
    "softmax's exponentials": (("softmax",),),
    "logarithm": (("Log",), ("log softmax",)),
    "softplus": (("Softplus",),),
    "ELU, SELU, CELU": (("Elu",), ("Selu",)),
    "error function": (("Erf",),),
    "SiLU, GELU, Mish": (("gate",), ("Gelu",), ("Mish",)),
    "values in steps": (("quantised",),),
}
FLAVOURS = ("plain", "subnormal", "huge", "cancelling", "constant")


# ---------------------------------------------------------------- 200 bits


def _norm(x: Vector) -> Vector:
    mean = mpmath.fsum(x) / len(x)
    variance = mpmath.fsum((v - mean) ** 2 for v in x) / len(x)
    root = mpmath.sqrt(variance + mpmath.mpf(float(np.float32(1e-5))))
    return [(v - mean) / root for v in x]


def _softmax(x: Vector, logarithm: bool = False) -> Vector:
    top = max(x)
    powers = [mpmath.exp(v - top) for v in x]
    total = mpmath.fsum(powers)
    return [v - top - mpmath.log(total) for v in x] if logarithm else [v / total for v in powers]


def _each(function: Callable[[Number], Number]) -> Callable[[dict[str, Any], Vector], Vector]:
    return lambda v, x: [function(z) for z in x]


def _matrix(v: dict[str, Any], x: Vector) -> Vector:
    weight = v.get("w")
    rows = [[1] * len(x)] * len(x) if weight is None else weight
    return [mpmath.fsum(w * z for w, z in zip(row, x, strict=True)) + b for row, b in zip(rows, v["b"], strict=True)]


def _attention(v: dict[str, Any], x: Vector) -> Vector:
    rows = [_softmax([a * z * other for other in x]) for a, z in zip(v["a"], x, strict=True)]
    return [mpmath.fsum(p * z for p, z in zip(row, x, strict=True)) for row in rows]


def _sigmoid(z: Number) -> Number:
    return 1 / (1 + mpmath.exp(-z))


def _cut(z: Number, low: Number, high: Number) -> Number:
    return min(max(z, low), high)


def _scale(v: dict[str, Any], x: Vector) -> Vector:
    return [a * z + t for a, z, t in zip(v["a"], x, v["t"], strict=True)]


def _batch_norm(v: dict[str, Any], x: Vector) -> Vector:
    eps = mpmath.mpf(float(np.float32(1e-5)))
    return [
        (z - m) / mpmath.sqrt(s + eps) * a + t for z, a, t, m, s in zip(x, v["a"], v["t"], v["m"], v["v"], strict=True)
    ]


def _local_response(v: dict[str, Any], x: Vector) -> Vector:
    alpha = min(v["s"], _number(1e30))
    sums = [mpmath.fsum(z * z for z in x[max(0, k - 1) : k + 2]) for k in range(len(x))]
    return [z * (1 + alpha / 3 * total) ** mpmath.mpf(-0.75) for z, total in zip(x, sums, strict=True)]


def _number(value: float) -> Number:
    return mpmath.mpf(float(np.float32(value)))


#: How much longer a row becomes that is resized.
_STRETCH = 1.75


def _resized(x: Vector, cubic: bool) -> Vector:
    """A row between the numbers of another, as ONNX's Resize with half_pixel coordinates has it."""
    found = []
    for k in range(int(len(x) * _STRETCH)):
        place = (k + mpmath.mpf(0.5)) / _STRETCH - 0.5
        if not cubic:
            place = _cut(place, 0, len(x) - 1)
        low = int(mpmath.floor(place))
        total = mpmath.mpf(0)
        for at in range(low - 1, low + 3) if cubic else (low, low + 1):
            t, a = abs(place - at), mpmath.mpf(-0.75)
            if cubic:
                inner = (a + 2) * t**3 - (a + 3) * t**2 + 1
                weight = inner if t <= 1 else a * (t**3 - 5 * t**2 + 8 * t - 4)
            else:
                weight = 1 - t
            total += weight * x[min(max(at, 0), len(x) - 1)]
        found.append(total)
    return found


def layer(gene: attack.Gene, n: int) -> Any:
    """The gene as `extreme_networks.Layer`."""
    if not gene.kind.endswith(" map"):
        return attack.layer(gene, n)
    mode = gene.kind.removesuffix(" map")

    def write(f: Any) -> None:
        row = f.node("Reshape", f.last, f.constant([0, 1, 1, n], np.int64))
        f.node("Resize", row, "", f.constant([1.0, 1.0, 1.0, _STRETCH]), mode=mode)
        f.node("Flatten")

    def step(x: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.interpolate(
            x[:, None, None], scale_factor=(1.0, _STRETCH), mode={"linear": "bilinear"}.get(mode, "bicubic")
        ).flatten(1)

    return extreme.Layer(write, step, kind=gene.kind)


_SELU = 1.67326319217681884765625, 1.05070102214813232421875
EXACT: dict[str, Callable[[dict[str, Any], Vector], Vector]] = {
    "gemm": _matrix,
    "sum": lambda v, x: _matrix({"b": v["b"]}, x),
    "scale": _scale,
    "shift": lambda v, x: [(z + t) * a for a, z, t in zip(v["a"], x, v["t"], strict=True)],
    "batch norm": _batch_norm,
    "computed": lambda v, x: [
        z * (a * m) + (t - m) for z, a, t, m in zip(x, v["a"], v["t"], v["m"], strict=True)
    ],
    "relu": _each(lambda z: max(z, 0)),
    "leaky": lambda v, x: [z if z >= 0 else z * (v["s"] if v["s"] <= 1 else _number(0.01)) for z in x],
    "prelu": lambda v, x: [z if z >= 0 else z * a for z, a in zip(x, v["a"], strict=True)],
    "clip": lambda v, x: [_cut(z, -v["s"], v["s"]) for z in x],
    "hard sigmoid": lambda v, x: [_cut(v["s"] * z + 0.5, 0, 1) for z in x],
    "square": _each(lambda z: z * z),
    "cube": _each(lambda z: z**3),
    "root": _each(mpmath.sqrt),
    "inverse root": _each(lambda z: 1 / mpmath.sqrt(z)),
    "fractional power": _each(lambda z: z ** mpmath.mpf(-0.75)),
    "local response": _local_response,
    "reciprocal": _each(lambda z: 1 / z),
    "norm": lambda v, x: _norm(x),
    "spelled norm": lambda v, x: _norm(x),
    "softmax": lambda v, x: _softmax(x),
    "log softmax": lambda v, x: _softmax(x, True),
    "residual": _each(lambda z: z + max(z, 0)),
    "gate": _each(lambda z: z * _sigmoid(z)),
    "product": _each(lambda z: z * max(z, 0)),
    "maximum": lambda v, x: [max(z, z + t) for z, t in zip(x, v["t"], strict=True)],
    "mean": lambda v, x: [z - mpmath.fsum(x) / len(x) for z in x],
    "quotient": lambda v, x: [z / (abs(z) + v["s"]) for z in x],
    "attention": _attention,
    "quantised": lambda v, x: [_cut(mpmath.nint(z / v["s"]), -128, 127) * v["s"] for z in x],
    "Abs": _each(abs),
    "Exp": _each(mpmath.exp),
    "Sigmoid": _each(_sigmoid),
    "Tanh": _each(mpmath.tanh),
    "Erf": _each(mpmath.erf),
    "Elu": _each(lambda z: z if z > 0 else mpmath.expm1(z)),
    "Selu": _each(lambda z: _number(_SELU[1]) * (z if z > 0 else _number(_SELU[0]) * mpmath.expm1(z))),
    "Softplus": _each(lambda z: max(z, 0) + mpmath.log1p(mpmath.exp(-abs(z)))),
    "HardSwish": _each(lambda z: z * _cut(z + 3, 0, 6) / 6),
    "Mish": _each(lambda z: z * mpmath.tanh(max(z, 0) + mpmath.log1p(mpmath.exp(-abs(z))))),
    "Gelu": _each(lambda z: z / 2 * (1 + mpmath.erf(z * _number(np.sqrt(0.5))))),
    "Log": _each(mpmath.log),
    "linear map": lambda v, x: _resized(x, False),
    "cubic map": lambda v, x: _resized(x, True),
}  # fmt: skip


def exact(genome: attack.Genome, images: Array) -> list[Vector]:
    """[m][n] the network's outputs with `BITS` bits."""
    steps = []
    for gene in genome.genes:
        values = {name: _exactly(value) for name, value in gene.values.items()}
        steps.append((EXACT[gene.kind], values))
    found = []
    for image in images:
        x = _exactly(image)
        for step, values in steps:
            x = step(values, x)
        found.append(x)
    return found


def _exactly(value: Array) -> Any:
    """Numbers, or lists of them, with all their digits."""
    if value.ndim:
        return [_exactly(part) for part in value]
    return mpmath.mpf(float(value))


# ---------------------------------------------------------------- inputs and programs


@dataclass(frozen=True)
class Case:
    """A network and images [m, n] for it."""

    genome: attack.Genome
    images: Array


def case(kinds: tuple[str, ...], flavour: str, seed: int, count: int, sizes: tuple[int, ...] = (8, 16, 24)) -> Case:
    """A network of layers of these kinds, with constants and images of a flavour."""
    rng = np.random.default_rng([seed, FLAVOURS.index(flavour), *map(ord, "".join(kinds))])
    n = 5 if "attention" in kinds else int(rng.choice(sizes))
    grown = {"plain": 0, "subnormal": int(rng.choice([-140, -127, -100])), "huge": int(rng.choice([24, 40, 60]))}
    # products of sizes that are ordinary in the end
    powers = rng.permutation([grown.get(flavour, 0), *[0] * len(kinds)]) if rng.random() < 0.5 else [0] * 9
    genes = []
    for kind, power in zip(kinds, powers, strict=False):
        gene = attack.Gene(kind) if kind.endswith(" map") else attack.random_gene(rng, n, (kind,))
        values = {}
        for name, value in gene.values.items():
            new = np.ldexp(rng.normal(size=value.shape), int(power))
            if flavour == "cancelling" and name == "w":
                new[:, 1::2] = -new[:, : n // 2 * 2 : 2][:, : new[:, 1::2].shape[1]] * (1.0 + 2.0**-18)
            if flavour == "constant" and name in ("t", "m"):
                new = np.full(value.shape, 1000.0) + new
            values[name] = (np.abs(new) if name in ("v", "s") else new).astype(np.float32)
        if kind == "quantised":
            values["s"] = np.float32(2.0 ** rng.uniform(-8, 0))
        genes.append(attack.Gene(kind, values))
    images = np.ldexp(rng.normal(size=(count, n)), int(powers[-1]) if len(powers) <= len(kinds) + 1 else 0)
    if flavour in ("subnormal", "huge"):
        images = np.ldexp(images, rng.choice([0, grown[flavour] // 2, grown[flavour]], (count, 1)))
    if flavour == "constant":
        images = rng.normal(size=(count, 1)) * 10.0 + np.ldexp(images, -rng.integers(2, 22, (count, 1)))
    if kinds[0] in ("root", "inverse root", "fractional power", "Log"):
        images = np.abs(images)
    with np.errstate(over="ignore"):
        images = np.clip(images, -1e37, 1e37).astype(np.float32)
    return Case(attack.Genome(n, tuple(genes), images[0]), images)


def sessions(file: Path, everything: bool) -> Iterator[tuple[str, Callable[[Array], Array]]]:
    """onnxruntime with each level of graph optimisation, on one thread and on two."""
    levels = onnxruntime.GraphOptimizationLevel
    names = ("DISABLE_ALL", "ENABLE_BASIC", "ENABLE_EXTENDED", "ENABLE_ALL")
    for name, threads in itertools.product(
        names if everything else (names[0], names[3]), (1, 2) if everything else (1,)
    ):
        options = onnxruntime.SessionOptions()
        options.log_severity_level, options.intra_op_num_threads = 4, threads
        options.graph_optimization_level = getattr(levels, f"ORT_{name}")
        try:
            opened = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
        except Exception:  # it refuses some networks itself
            continue
        entry = opened.get_inputs()[0].name

        def run(x: Array, opened: Any = opened, entry: str = entry) -> Array:
            return np.asarray(opened.run(None, {entry: x})[0]).reshape(len(x), -1)

        yield f"onnxruntime {name.lower()}, {threads}", run


def pairwise(matrix: Array, x: Array, bias: Array) -> Array:
    """Float32 sums [B, out] of products, as numpy adds them by pairs."""
    return (x[:, None, :] * matrix[None]).sum(-1, dtype=np.float32) + bias


def programs(net: Any, images: Array, file: Path, everything: bool, compiled: bool) -> Iterator[tuple[str, Array]]:
    """(program, outputs [m, out]) of every float32 program."""
    runners = list(sessions(file, everything))
    yield from net.values(images, [run for _, run in runners[-1:]])
    with np.errstate(all="ignore"), torch.no_grad():
        for flushed in (False, True):
            with extreme.flushing(flushed):
                # two at a time: onnxruntime's own threads keep what they were made with
                found = [(name, run(images)) for name, run in runners]
                paired = [
                    extreme.Layer(layer.write, partial(_paired, layer.matrix), kind=layer.kind)
                    if layer.matrix
                    else layer
                    for layer in net.layers
                ]
                found.append(("numpy, pairs", extreme.through(paired, images, lambda layer: layer.step)))
                if compiled:
                    found.append(("torch, compiled", _compiled(net, images)))
            yield from ((name + " flushed" * flushed, value) for name, value in found)


def _paired(matrix: tuple[Array, Array], x: torch.Tensor) -> torch.Tensor:
    return torch.from_numpy(pairwise(matrix[0], x.numpy(), matrix[1]))


def _compiled(net: Any, images: Array) -> Array:
    torch._dynamo.reset()

    def whole(x: torch.Tensor) -> torch.Tensor:
        for layer in net.layers:
            x = layer.step(x)
        return x

    return torch.compile(whole)(torch.from_numpy(images)).reshape(len(images), -1).numpy().copy()


# ---------------------------------------------------------------- ratios


@dataclass
class Entry:
    """What was seen of one row: outputs compared, bounds that were infinite, the largest ratio and its program."""

    compared: int = 0
    unbounded: int = 0
    ratio: float = 0.0
    program: str = ""
    outside_real: int = 0


def measure(given: Case, entry: Entry, folder: Path, everything: bool = False, compiled: bool = False) -> None:
    """Compare every program with the bounds and the exact values of a case."""
    genome = given.genome
    net = extreme.Extreme((genome.n,), [layer(gene, genome.n) for gene in genome.genes])
    file = net.write(folder / "net.onnx")
    try:
        network = read_onnx(file)
    except InputError:
        return
    m, n = given.images.shape
    flat, zero, k = given.images.astype(np.float64), np.zeros((m, n, 1)), network.output_size
    sets, rows = ImageSets(zero, flat, zero, flat, flat, flat), np.concatenate([np.eye(k), -np.eye(k)])
    found = bound_outputs(network, sets, rows, np.zeros(2 * k)).lower
    low, high = found[:, :k], -found[:, k:]
    real = bound_outputs(network, sets, rows, np.zeros(2 * k), arithmetic="real").lower
    finite = np.isfinite(low) & np.isfinite(high)
    entry.unbounded += int((~finite).sum())
    if not finite.any():
        return
    with mpmath.workprec(BITS):
        kept = finite.any(1)
        centre = dict(zip(np.flatnonzero(kept).tolist(), exact(genome, given.images[kept]), strict=True))
        # how far the ends are from the exact value, and where the value lies
        places = [(i, j) for i, j in zip(*np.nonzero(finite), strict=True)]
        # the value as two numbers, from which differences are right to 2^-50
        first = np.array([float(centre[i][j]) for i, j in places])
        second = np.array([float(centre[i][j] - mpmath.mpf(v)) for (i, j), v in zip(places, first, strict=True)])
        below, above = (first - low[finite]) + second, (high[finite] - first) - second
        entry.outside_real += sum(
            not mpmath.mpf(real[i, j]) <= centre[i][j] <= -mpmath.mpf(real[i, k + j]) for i, j in places
        )
        for name, y in programs(net, given.images, file, everything, compiled):
            value = y.astype(np.float64)[finite]
            off = np.nan_to_num((value - first) - second, nan=np.inf)
            with np.errstate(all="ignore"):
                ratio = np.where(off > 0.0, off / above, np.where(off < 0.0, -off / below, 0.0))
            ratio = np.where((value >= low[finite]) & (value <= high[finite]), np.minimum(ratio, 1.0), np.inf)
            entry.compared += value.size
            if float(ratio.max()) > entry.ratio:
                entry.ratio, entry.program = float(ratio.max()), name


def ratios(
    count: int,
    images: int = 6,
    names: tuple[str, ...] = (),
    everything: bool = False,
    compiled: bool = False,
    sizes: tuple[int, ...] = (8, 16, 24),
) -> dict[str, Entry]:
    """The entry of every row, or of ``names``, from ``count`` networks of each kind and flavour."""
    found = {}
    with tempfile.TemporaryDirectory() as folder, np.errstate(all="ignore"):
        for name in names or MEASURED:
            entry = found[name] = Entry()
            for kinds, flavour, seed in itertools.product(MEASURED[name], FLAVOURS, range(count)):
                measure(case(kinds, flavour, seed, images, sizes), entry, Path(folder), everything, compiled)
    return found


def table(found: dict[str, Entry]) -> str:
    """The ledger in Markdown."""
    lines = ["| layer | outputs compared | unbounded | seen / charged | by |", "|---|---|---|---|---|"]
    for row in ROWS:
        if row.kind in UNMEASURED:
            lines.append(f"| {row.kind} | | | not measured: {UNMEASURED[row.kind]} | |")
        else:
            entry = found[row.kind]
            lines.append(
                f"| {row.kind} | {entry.compared:,} | {entry.unbounded:,} | {entry.ratio:.2f} | {entry.program} |"
            )
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=24, help="networks of each kind and flavour")
    parser.add_argument("--compiled", action="store_true", help="torch.compile, too")
    parser.add_argument("--write", action="store_true", help="write the tables of docs/dev")
    options = parser.parse_args()
    found = ratios(options.count, everything=True, compiled=options.compiled)
    text = table(found)
    print(text)
    if options.write:
        whole = PAGE.read_text(encoding="utf-8")
        begin, end = (whole.index(mark) for mark in MARKS)
        PAGE.write_text(f"{whole[: begin + len(MARKS[0])]}\n\n{text}\n\n{whole[end:]}", encoding="utf-8")
        CHARGES.write_text(page(), encoding="utf-8")
    bad = [name for name, entry in found.items() if not entry.ratio <= 1.0 or entry.outside_real]
    print(f"outside: {bad}" if bad else "none outside")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
