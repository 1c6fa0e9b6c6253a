"""Are a GPU's float32 functions as exact as the constants in ``ns_abstract/arithmetic/rounding.py`` say?

    python benchmarks/cuda_functions.py [--binary FILE] [--seconds 20] [--output-dir bench]

Two parts. ``cuda_functions.cu`` calls what gsplat's kernels call, compiled as they are (``-O3 --use_fast_math``): each
one-argument function with every float32, divisions with as many pairs of mantissas as ``--seconds`` allow, sums,
products and fused operations with random numbers, and the rotation of a quaternion. Then what Splatfacto has PyTorch
compute before: ``torch.exp`` of scales and ``torch.sigmoid`` of opacities of every float32, the view matrix by
``torch.bmm``, and the camera's position by ``torch.inverse``.

The largest error of each is compared with what bounds are charged for it; exit status 1 if one is larger, 2 if nothing
could be measured. ``--planted`` divides the charges, whereupon each has to be exceeded. With ``--device cpu`` the C
library and PyTorch's CPU functions stand in, for ``--sample`` inputs each: that tests this program, not a device.

It needs no other file of the package: PyTorch, and nvcc or ``--binary`` (see the first lines of ``cuda_functions.cu``).
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch

SOURCE = Path(__file__).with_suffix(".cu")
UNIT = 2.0**-24
TINY = 2.0**-126
LARGEST = float(torch.finfo(torch.float32).max)

#: What bounds are charged, in units of 2^-24 if nothing else is said; `tests/test_cuda_functions.py` compares them with
#: the package's.
CHARGES: dict[str, float] = {
    # FLOAT32 of ns_abstract/arithmetic/rounding.py
    "exp": 4.0,
    "exp_slope": 2.346,
    "sqrt": 6.0,
    "rsqrt": 4.0,
    "division": 4.0,
    "torch_exp": 4.0,
    # docs/dev/design.md, G12: absolute from 0.5 to 2, elsewhere ulps
    "log_absolute": 2.0**24 * 2.0**-21.41,
    "log_ulps": 3.0,
    # of 2^-126, one operation (UNDERFLOW32 is 2^10 of them)
    "flush": 1.0,
    # G6, of an entry; C3, of a direction's normalisation
    "rotation": 52.0,
    "direction": 8.0,
    # G9; C1, absolute
    "sigmoid": 12.0,
    "sigmoid_color": 8.0,
    # G2: of |R| |C|, a product and two sums; C3: of 1 + |C|
    "translation": 3.0,
    "position": 80.0,
}
#: Of these the binary is told.
_OF_KERNELS = (
    "exp", "exp_slope", "log_absolute", "log_ulps", "sqrt", "rsqrt", "division", "flush", "rotation", "direction",
)  # fmt: skip
#: The least squared length of a quaternion that ``methods/splat/load.py`` accepts.
LEAST_SQUARED = 2.0**-100
#: As in the other part: results this near to 2^-126 may be flushed.
_FLUSHED = TINY * (1.0 + 2.0**-15)
_FLUSH_ROOM = 1.0 + 2.0**-10
#: Inputs of one step of PyTorch's part, and the time that random inputs may take.
_CHUNK, _SECONDS = 1 << 25, 5.0

Row = dict[str, Any]


class Unavailable(RuntimeError):
    """There is no device or no compiler."""


def build(device: str, folder: Path) -> Path:
    """Compile ``cuda_functions.cu``; for device "cpu" with functions that stand in."""
    binary = folder / "cuda_functions"
    if device == "cpu":
        command = ["g++", "-x", "c++", "-DHOST", "-O2"]
    else:
        command = ["nvcc", "-O3", "--use_fast_math", "-arch=native"]
    command += ["-std=c++17", "-o", str(binary), str(SOURCE)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        raise Unavailable(f"{command[0]} cannot be run ({error.strerror}); give --binary") from error
    if done.returncode:
        raise Unavailable(f"{command[0]}: {(done.stderr or done.stdout).strip().splitlines()[0]}")
    return binary


def kernel_rows(
    binary: Path, charges: dict[str, float], sample: int, seconds: float, planted: bool
) -> Iterator[dict[str, Any]]:
    """What the binary prints, as it does: first the device, then rows."""
    given = {name: charges[name] for name in _OF_KERNELS}
    given |= {"least_squared": LEAST_SQUARED, "sample": sample, "seconds": seconds, "truncated": int(planted)}
    command = [str(binary.resolve()), *(f"{name}={value!r}" for name, value in given.items())]
    try:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    except OSError as error:
        raise Unavailable(f"{binary} cannot be run ({error.strerror})") from error
    assert process.stdout is not None
    for line in process.stdout:
        yield json.loads(line)
    if process.wait():
        raise Unavailable(f"{binary.name} ended with status {process.returncode}")


class Range:
    """The largest error of one function over one range: a row of the table."""

    def __init__(self, function: str, name: str, unit: str, charge: float) -> None:
        self.function, self.name, self.unit, self.charge = function, name, unit, charge
        self.inputs, self.error, self.ulps, self.at = 0, 0.0, float("nan"), "-"

    def add(self, error: torch.Tensor, where: Callable[[int], str], exact: torch.Tensor | None = None) -> None:
        """``error``: in units; ``where``: an input by its place; ``exact``: results, if ulps mean something."""
        if not error.numel():
            return
        self.inputs += error.numel()
        # it finds what is no number, if there is any
        place = int(torch.argmax(error))
        largest = float(error[place])
        # no number is larger than any
        if self.at == "-" or (not math.isnan(self.error) and not largest <= self.error):
            self.error, self.at = largest, where(place)
        if exact is not None:
            size = exact.abs()
            ulp = torch.ldexp(torch.ones_like(size), torch.frexp(size).exponent - 24)
            ulps = float((error * UNIT * size / ulp).max())
            self.ulps = ulps if math.isnan(self.ulps) else max(self.ulps, ulps)

    def row(self) -> Row:
        share = self.error / self.charge
        return {
            "function": self.function, "range": self.name, "inputs": self.inputs, "unit": self.unit,
            "ulps": self.ulps, "error": self.error, "charge": self.charge, "share": share,
            "error_at": self.at, "share_at": self.at,
        }  # fmt: skip


def _floats(first: int, last: int, stride: int, device: str) -> torch.Tensor:
    """The finite ones of the float32 whose bits are ``first``, ``first + stride``, ... below ``last``."""
    bits = torch.arange(first, last, stride, dtype=torch.int64, device=device)
    bits = torch.where(bits >= 1 << 31, bits - (1 << 32), bits).to(torch.int32)
    values = bits.view(torch.float32)
    return values[torch.isfinite(values)]


def activation_rows(charges: dict[str, float], sample: int, device: str) -> Iterator[Row]:
    """``torch.exp`` and ``torch.sigmoid`` of every float32, or of ``sample`` of them."""
    exp, sigmoid, flush = charges["torch_exp"], charges["sigmoid"], charges["flush"] * _FLUSH_ROOM
    ranges = {
        "exp": Range("torch.exp", "result normal", "2^-24", exp),
        "exp_small": Range("torch.exp", "result below 2^-126", "2^-126", flush),
        "sigmoid": Range("torch.sigmoid", "result normal", "2^-24", sigmoid),
        "sigmoid_small": Range("torch.sigmoid", "result below 2^-126", "2^-126", flush),
        "color": Range("torch.sigmoid", "every x", "2^-24 (absolute)", charges["sigmoid_color"]),
    }
    stride = max(1, (1 << 32) // sample | 1) if sample else 1
    started = time.perf_counter()
    for first in range(0, 1 << 32, _CHUNK * stride):
        x = _floats(first, min(1 << 32, first + _CHUNK * stride), stride, device)
        for name, function in (("exp", torch.exp), ("sigmoid", torch.sigmoid)):
            exact, got = function(x.double()), function(x).double()
            error = (got - exact).abs()
            normal = (exact >= _FLUSHED) & (exact <= LARGEST * (1.0 - 2.0**-12))
            for range_, chosen, unit in (
                (ranges[name], normal, exact * UNIT),
                (ranges[f"{name}_small"], exact < _FLUSHED, torch.full_like(exact, TINY)),
            ):
                inputs = x[chosen]
                relative = range_ is ranges[name]
                range_.add(
                    error[chosen] / unit[chosen],
                    lambda place, inputs=inputs: f"{float(inputs[place]):.9g}",
                    exact[chosen] if relative else None,
                )
            if name == "sigmoid":
                ranges["color"].add(error / UNIT, lambda place, x=x: f"{float(x[place]):.9g}")
    _progress("torch.exp, torch.sigmoid", ranges["color"].inputs, started)
    yield from (found.row() for found in ranges.values())


def _poses(count: int, device: str, generator: torch.Generator) -> torch.Tensor:
    """[count, 3, 4] float32 camera to world, positions at 0.01 to 10 000 from the origin."""
    q = torch.randn(count, 4, device=device, generator=generator, dtype=torch.float64)
    w, x, y, z = (q / q.norm(dim=1, keepdim=True)).unbind(1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    direction = torch.randn(count, 3, device=device, generator=generator, dtype=torch.float64)
    length = 10.0 ** (6.0 * torch.rand(count, 1, device=device, generator=generator, dtype=torch.float64) - 2.0)
    position = direction / direction.norm(dim=1, keepdim=True) * length
    return torch.cat([torch.stack(rows, 1).view(-1, 3, 3), position[:, :, None]], dim=2).float()


def _view_matrices(poses: torch.Tensor) -> torch.Tensor:
    """splatfacto.py:128-143."""
    rotation = poses[:, :3, :3] * torch.tensor([[[1, -1, -1]]], device=poses.device, dtype=poses.dtype)
    inverse = rotation.transpose(1, 2)
    view = torch.zeros(poses.shape[0], 4, 4, device=poses.device, dtype=poses.dtype)
    view[:, 3, 3] = 1.0
    view[:, :3, :3] = inverse
    view[:, :3, 3:4] = -torch.bmm(inverse, poses[:, :3, 3:4])
    return view


def pose_rows(charges: dict[str, float], sample: int, device: str) -> Iterator[Row]:
    """View matrices and camera positions, of many poses at once and, as Splatfacto has them, one at a time."""
    generator = torch.Generator(device=device).manual_seed(0)
    kinds = (
        ("many at once", sample or 100_000_000, min(sample, 1 << 18) or 1 << 18),
        ("one at a time", min(sample, 300) or 3000, 1),
    )
    for name, count, batch in kinds:
        translation = Range("torch.bmm of view matrix", name, "2^-24 of |R| |C|", charges["translation"])
        position = Range("torch.inverse of view matrix", name, "2^-24 of 1 + |C|", charges["position"])
        started = time.perf_counter()
        while translation.inputs < 3 * count and time.perf_counter() - started < _SECONDS:
            poses = _poses(max(batch, min(count, 1 << 12)), device, generator)
            views = torch.cat([_view_matrices(part) for part in poses.split(batch)])
            # gsplat's rendering.py
            positions = torch.cat([torch.inverse(part) for part in views.split(batch)])[:, :3, 3].double()
            rotation, center = views[:, :3, :3].double(), poses[:, :, 3].double()
            products = rotation * center[:, None, :]
            error = (views[:, :3, 3].double() + products.sum(2)).abs() / (UNIT * products.abs().sum(2))

            def pose(place: int, center: torch.Tensor = center) -> str:
                return "C = " + ", ".join(f"{value:.6g}" for value in center[place].tolist())

            translation.add(error.view(-1), lambda place, pose=pose: pose(place // 3))
            away = (positions - center).norm(dim=1)
            position.add(away / (UNIT * (1.0 + center.abs().sum(1))), pose)
        _progress(f"view matrices, {name}", position.inputs, started)
        yield from (translation.row(), position.row())


def _progress(what: str, inputs: int, started: float) -> None:
    print(f"{what:32} {inputs:14} inputs {time.perf_counter() - started:6.2f} s", file=sys.stderr, flush=True)


def verdict(row: Row) -> str:
    """Whether a row's charge covers its error; a negative charge: there is none."""
    if row["charge"] < 0:
        return "not charged"
    return "within" if row["share"] <= 1.0 else "EXCEEDED"


def table(rows: list[Row]) -> str:
    """A Markdown table."""

    def number(value: float) -> str:
        return "NaN" if math.isnan(value) else f"{value:.4g}"

    names = ("function", "range", "inputs", "ulps", "error", "unit", "at", "charge", "share", "share at", "verdict")
    lines = ["| " + " | ".join(names) + " |", "|" + "---|" * len(names)]
    for row in rows:
        share = (number(row["charge"]), number(row["share"]), row["share_at"] if row["share"] else "-")
        cells = (
            row["function"], row["range"].replace("|", r"\|"), f"{row['inputs']:,}",
            number(row["ulps"]) if row["ulps"] > 0 else "-", number(row["error"]), row["unit"].replace("|", r"\|"),
            row["error_at"] if row["error"] else "-", *(share if row["charge"] >= 0 else "---"), verdict(row),
        )  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


class Results:
    """Rows and what they are of, written to a folder with every row: a run that is cut off leaves what it had."""

    def __init__(self, folder: Path, charges: dict[str, float]) -> None:
        self.folder, self.rows = folder, list[Row]()
        self.about: dict[str, Any] = {"torch": torch.__version__, "charges": charges, "least_squared": LEAST_SQUARED}
        folder.mkdir(parents=True, exist_ok=True)

    def add(self, row: Row) -> None:
        if "function" in row:
            self.rows.append({**row, "verdict": verdict(row)})
        else:
            self.about |= row
        text = json.dumps({**self.about, "rows": self.rows}, indent=1)
        (self.folder / "cuda_functions.json").write_text(text + "\n", encoding="utf-8")

    def exceeded(self) -> list[Row]:
        return [row for row in self.rows if row["verdict"] == "EXCEEDED"]


def main(arguments: list[str] | None = None) -> int:
    """Measure; 1 if a charge is exceeded, 2 if nothing could be measured."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--binary", type=Path, help="cuda_functions.cu, compiled; without it, it is compiled here")
    parser.add_argument("--device", choices=["cuda", "cpu"], default="cuda")
    parser.add_argument("--sample", type=int, default=0, help="inputs of each function; 0: all of them, or very many")
    parser.add_argument("--seconds", type=float, default=20.0, help="time for pairs of mantissas")
    parser.add_argument("--planted", type=float, nargs="?", const=64.0, default=1.0, help="what charges are divided by")
    parser.add_argument("--output-dir", type=Path, default=Path("bench"))
    options = parser.parse_args(arguments)
    if options.device == "cuda" and not torch.cuda.is_available():
        print("error: no CUDA GPU is available; nothing was measured", file=sys.stderr)
        return 2
    charges = {name: value / options.planted for name, value in CHARGES.items()}
    results = Results(options.output_dir, charges)
    sample = options.sample or (1 << 20 if options.device == "cpu" else 0)
    status = 0
    try:
        with tempfile.TemporaryDirectory() as folder:
            binary = options.binary or build(options.device, Path(folder))
            for row in kernel_rows(binary, charges, sample, options.seconds, options.planted != 1.0):
                results.add(row)
        if options.device == "cuda":
            results.add({"tf32": torch.backends.cuda.matmul.allow_tf32, "torch_cuda": torch.version.cuda})
        for part in (activation_rows, pose_rows):
            for row in part(charges, sample, options.device):
                results.add(row)
    except Unavailable as error:
        print(f"error: {error}", file=sys.stderr)
        status = 2
    text = table(results.rows)
    about = results.about
    title = f"{about.get('device', '-')}, CUDA {about.get('cuda', '-')}, PyTorch {about['torch']}"
    (options.output_dir / "cuda_functions.md").write_text(f"# float32 functions of {title}\n\n{text}", encoding="utf-8")
    print(f"{title}\n\n{text}", flush=True)
    for row in results.exceeded():
        print(f"exceeded: {row['function']}, {row['range']}, at {row['share_at']}", flush=True)
    return status or int(bool(results.exceeded()))


if __name__ == "__main__":
    sys.exit(main())
