"""Ledger of charges: the largest rounding error seen over the error charged, for every charge of the splat bounds.

Each charge of `ns_abstract.arithmetic.rounding.Charges` pays for a few operations of gsplat's formulas. These are
evaluated on random and extreme inputs with numbers of the program's format, as IEEE 754 rounds them and (float32) with
errors as large as the CUDA guide allows in random directions, and beside them with 200 bits from the same inputs. A
ratio above 1 is a bug; a ratio far below 1 is room.

    python benchmarks/ledger.py [--count N] [--write]

prints the table; ``--write`` puts it into docs/dev/measurements.md, between the marks of the ledger.
"""

from __future__ import annotations

import argparse
import math
import operator
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mpmath
import numpy as np

from ns_abstract.arithmetic.rounding import FLOAT32, REAL, Arithmetic, Charges, charges

PAGE = Path(__file__).resolve().parents[1] / "docs" / "dev" / "measurements.md"
MARKS = "<!-- ledger of charges -->", "<!-- end of the ledger -->"
#: What is not measured here, and why.
UNMEASURED = {
    "flush": "absolute; subnormal results that the GPU flushes to zero do not occur in these formulas' usual range",
    "overflow": "a limit, no error",
    "covariance_size": "of second order: raises a bound that multiplies another error",
    "covariance_size_products": "of second order, likewise",
}
_PIXELS = 256.0


class Format:
    """Numbers of one arithmetic; `number` takes inputs that are rounded to it first."""

    def __init__(self, arithmetic: Arithmetic, kind: str, seed: int) -> None:
        self.a, self.kind, self.random = arithmetic, kind, np.random.default_rng(seed)
        self.type = np.float32 if arithmetic.name == "float32" else np.float64

    def given(self, x: np.ndarray | float) -> Value:
        """Inputs that the format holds exactly."""
        array = np.asarray(x, np.float64)
        if self.kind == "exact":
            return Value(np.vectorize(mpmath.mpf, otypes=[object])(array), self)
        return Value(array.astype(self.type) if self.kind == "ieee" else array, self)

    def number(self, x: np.ndarray | float) -> Value:
        """Inputs that are rounded to the format."""
        return self.given(x) if self.kind != "worst" else self.rounded(np.asarray(x, np.float64), 1.0)

    def rounded(self, x: np.ndarray, units: float) -> Value:
        """A result that the program finds with an error of up to ``units``."""
        if self.kind == "worst":
            x = x * (1.0 + units * self.a.unit * self.random.choice([-1.0, 0.0, 1.0], np.shape(x)))
        return Value(x, self)

    def function(self, name: str, x: Value, units: Callable[[np.ndarray], np.ndarray] | float) -> Value:
        """An elementary function; ``units`` may grow with the argument."""
        if self.kind == "exact":
            return Value(np.vectorize(getattr(mpmath, name), otypes=[object])(x.x), self)
        found = getattr(np, name)(x.x)
        if self.kind != "worst":
            return Value(found, self)
        size = units(np.abs(x.x)) if callable(units) else units
        return Value(found * (1.0 + size * self.a.unit * self.random.choice([-1.0, 0.0, 1.0], found.shape)), self)


@dataclass
class Value:
    """An array of a format's numbers."""

    x: np.ndarray
    f: Format

    def _with(self, other: Value | float, operation: Callable, units: float = 1.0) -> Value:
        value = other if isinstance(other, Value) else self.f.given(other)
        return self.f.rounded(operation(self.x, value.x), units)

    def __add__(self, other: Value | float) -> Value:
        return self._with(other, operator.add)

    def __sub__(self, other: Value | float) -> Value:
        return self._with(other, operator.sub)

    def __mul__(self, other: Value | float) -> Value:
        # a power of two only moves the exponent
        exact = not isinstance(other, Value) and abs(math.frexp(other)[0]) == 0.5
        return self._with(other, operator.mul, 0.0 if exact else 1.0)

    def __truediv__(self, other: Value | float) -> Value:
        return self._with(other, operator.truediv, self.f.a.division)

    def root(self) -> Value:
        return self.f.function("sqrt", self, self.f.a.sqrt)

    def exp(self, fast: bool = False) -> Value:
        """expf, or __expf."""
        a = self.f.a
        return self.f.function(
            "exp", self, (lambda x: a.fast_exp + a.fast_exp_per_unit_argument * x) if fast else a.exp
        )


def dot(a: list[Value], b: list[Value]) -> Value:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def product(a: list[list[Value]], b: list[list[Value]]) -> list[list[Value]]:
    return [[dot(row, [line[j] for line in b]) for j in range(len(b[0]))] for row in a]


def transposed(a: list) -> list:
    return [list(row) for row in zip(*a, strict=True)]


def rotation(q: list[np.ndarray]) -> np.ndarray:
    """[3, 3, n] of unit quaternions."""
    w, x, y, z = np.array(q) / np.linalg.norm(q, axis=0)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


class Inputs:
    """Random and extreme inputs of n cases that float32 holds exactly, but for the camera's pose."""

    def __init__(self, n: int, seed: int) -> None:
        random = np.random.default_rng(seed)

        def single(x: np.ndarray) -> np.ndarray:
            return x.astype(np.float32).astype(np.float64)

        def powers(low: float, high: float, *shape: int) -> np.ndarray:
            return single(10.0 ** random.uniform(low, high, (*shape, n)))

        self.n = n
        self.pose = rotation(list(random.normal(size=(4, n))))
        self.turn = single(self.pose)
        self.camera = random.normal(size=(3, n)) * 10.0 ** random.uniform(-2.0, 3.0, n)
        self.mean = single(random.normal(size=(3, n)) * 10.0 ** random.uniform(-2.0, 3.0, n))
        self.quat = single(random.normal(size=(4, n)) * 10.0 ** random.uniform(-1.0, 1.0, n))
        # needles and plates too
        self.scale = powers(-4.0, 1.0, 3)
        self.depth = powers(-1.9, 3.0)
        self.across = single(random.uniform(-1.5, 1.5, (2, n)) * self.depth)
        self.focal = random.uniform(50.0, 3000.0, n)
        self.center = random.uniform(10.0, 2000.0, n)
        self.principal = random.uniform(0.0, _PIXELS, n)
        # covariance after the blur, from round to thin as a hair
        a, c, skew = powers(-0.5, 6.0), powers(-0.5, 6.0), random.uniform(-1.0, 1.0, n)
        self.a, self.c = single(a + 0.3), single(c + 0.3)
        self.b = single(np.sign(skew) * (1.0 - 10.0 ** random.uniform(-4.0, 0.0, n)) * np.sqrt(self.a * self.c))
        self.offset = single(random.normal(size=(2, n)) * 10.0 ** random.uniform(-1.0, 2.0, n))
        self.logit = single(random.uniform(-6.0, 8.0, n))
        self.sigma = single(random.uniform(0.0, 10.0, n))
        self.alpha = single(random.uniform(1.0 / 255.0, 0.999, n))
        self.light = single(random.uniform(1e-4, 1.0, n))
        self.color = single(random.uniform(0.0, 1.0, (24, n)))
        self.alphas = single(random.uniform(1.0 / 255.0, 0.3, (24, n)))
        self.sh = single(random.uniform(-1.0, 1.0, (16, n)))


def _quaternion_axes(f: Format, i: Inputs) -> list[list[Value]]:
    """R(q/|q|) diag(s)."""
    q = [f.given(v) for v in i.quat]
    inverse = f.function("sqrt", q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3], 0.0)
    # rsqrt
    one = f.given(np.ones(i.n))
    inverse = f.rounded((one.x / inverse.x), f.a.rsqrt)
    w, x, y, z = (v * inverse for v in q)
    r = [
        [one - (y * y + z * z) * 2.0, (x * y - w * z) * 2.0, (x * z + w * y) * 2.0],
        [(x * y + w * z) * 2.0, one - (x * x + z * z) * 2.0, (y * z - w * x) * 2.0],
        [(x * z - w * y) * 2.0, (y * z + w * x) * 2.0, one - (x * x + y * y) * 2.0],
    ]
    scale = [f.given(v) for v in i.scale]
    return [[r[row][k] * scale[k] for k in range(3)] for row in range(3)]


def _harmonics(f: Format, i: Inputs) -> Value:
    """Bands 1 to 3 for a unit direction, as gsplat sums them."""
    x, y, z = (f.given(v) for v in i.turn[0])
    sh = [f.given(v) for v in i.sh]
    z2, c1, s1 = z * z, x * x - y * y, x * y * 2.0
    c2, s2 = x * c1 - y * s1, x * s1 + y * c1
    g = z2 * f.number(-2.285228997322329) + f.number(0.4570457994644658)
    basis = [
        y * f.number(-0.48860251190292), z * f.number(0.48860251190292), x * f.number(-0.48860251190292),
        s1 * f.number(0.5462742152960395), z * y * f.number(-1.092548430592079),
        z2 * f.number(0.9461746957575601) - f.number(0.3153915652525201), z * x * f.number(-1.092548430592079),
        c1 * f.number(0.5462742152960395), s2 * f.number(-0.5900435899266435),
        z * f.number(1.445305721320277) * s1, g * y,
        z * (z2 * f.number(1.865881662950577) - f.number(1.119528997770346)), g * x,
        z * f.number(1.445305721320277) * c1, c2 * f.number(-0.5900435899266435),
    ]  # fmt: skip
    total = sh[0] * f.number(0.2820947917738781)
    for weight, value in zip(sh[1:], basis, strict=True):
        total = total + weight * value
    return total


def _blended(f: Format, i: Inputs, count: int) -> Value:
    """``count`` fragments over a background of 1."""
    light, total = f.given(np.ones(i.n)), f.given(np.zeros(i.n))
    for alpha, color in zip(i.alphas[:count], i.color[:count], strict=True):
        a = f.given(alpha)
        total = total + f.given(color) * (a * light)
        light = light * (f.given(1.0) - a)
    return total + light * f.number(1.0)


def evaluated(f: Format, i: Inputs) -> dict[str, Value]:
    """What each charge pays for, in the numbers of ``f``."""
    pose = [[f.number(i.pose[r, k]) for k in range(3)] for r in range(3)]
    turn = [[f.given(i.turn[r, k]) for k in range(3)] for r in range(3)]
    mean, camera = [f.given(v) for v in i.mean], [f.number(v) for v in i.camera]
    z, x = f.given(i.depth), f.given(i.across[0])
    focal, center = f.number(i.focal), f.number(i.center)
    one = f.given(np.ones(i.n))
    found = {}
    shift = dot(pose[0], camera) * -1.0
    found["camera_coordinate"] = dot(pose[0], mean) + shift
    inverse = one / z
    found["reciprocal_depth"] = inverse
    u = f.given(i.across[0] / i.depth)
    found["ratio"] = x * f.given(1.0 / i.depth)
    found["mean"] = focal * u + center
    half = one * (0.5 * _PIXELS) / focal
    found["clamp"] = (f.given(_PIXELS) - f.number(i.principal)) / focal + half * f.number(0.3)
    r = f.given(1.0 / i.depth)
    found["jacobian"] = focal * (z * u) * (r * r)
    found["rotation"] = f.rounded(pose[0][0].x, 1.0)
    axes = _quaternion_axes(f, i)
    found["rotation_entry"] = axes[0][0]
    # axes, covariance and Jacobian as the program may hold them
    m = [[f.given(v) for v in row] for row in (i.turn * i.scale[None]).astype(np.float32).astype(np.float64)]
    found["covariance_products"] = dot(m[0], m[1])
    world = [[f.given(v) for v in row] for row in _covariance(i)]
    row = [f.given(v) for v in _jacobian_row(i)]
    seen = product(product(pose, world), transposed(pose))
    found["covariance"] = dot(row, [dot(line, row) for line in seen])
    gram = product(product(turn, product(m, transposed(m))), transposed(turn))
    found["gram"] = dot(row, [dot(line, row) for line in gram])
    a, b, c = f.given(i.a), f.given(i.b), f.given(i.c)
    found["blur"] = a + f.number(0.3)
    det = a * c - b * b
    found["determinant"] = det
    half = (a + c) * 0.5
    found["half_trace"] = half
    given_half, given_det = f.given(0.5 * (i.a + i.c)), f.given(i.a * i.c - i.b * i.b)
    found["discriminant"] = given_half * given_half - given_det
    found["radius"] = (given_half + given_half.root()).root() * 3.0
    dx, dy = (f.given(v) for v in i.offset)
    conic = [c / det, b / det * -1.0, a / det]
    found["conic"] = (conic[0] * dx * dx + conic[2] * dy * dy) * 0.5 + conic[1] * dx * dy
    found["compensation"] = (f.given(i.b * i.b) / f.given(i.a * i.c)).root() * f.given(i.alpha)
    found["near"] = f.number(np.full(i.n, 0.01))
    found["tile"] = (f.given(i.offset[0]) - given_half) / 16.0
    opacity = one / (one + (f.given(i.logit) * -1.0).exp())
    found["opacity"] = opacity
    sigma = f.given(i.sigma * -0.555)
    found["exponent_limit"] = opacity * sigma.exp(fast=True)
    found["depth_products"] = dot(turn[2], mean)
    found["depth"] = f.given(i.mean[0]) + f.given(i.mean[1])
    found["viewing_axis"] = dot([f.rounded(v.x, 1.0) for v in pose[2]], [f.given(v) for v in i.mean])
    found["camera_position"] = dot(transposed(pose)[0], [dot(line, camera) * -1.0 for line in pose]) * -1.0
    found["direction_mean"] = mean[0] - f.given(i.camera[0].astype(np.float32).astype(np.float64))
    length = dot(mean, mean).root()
    found["direction"] = mean[0] / length
    found["harmonics"] = _harmonics(f, i)
    found["color_sum"] = f.given(0.5 * i.sh[0]) + 0.5
    found["shifted_color"] = f.given(i.color[0]) + f.number(i.camera[1])
    found["plain_color"] = f.given(i.sh[0]) * f.number(0.2820947917738781) + 0.5
    found["threshold"] = f.number(np.full(i.n, 1.0 / 255.0))
    found["exponential"] = f.given(i.alpha) * f.given(i.sigma * -1e-3).exp(fast=True)
    found["exponential_by_argument"] = f.given(i.sigma * -1.0).exp(fast=True)
    found["exponential_by_range"] = f.given(i.sigma * -4.0).exp(fast=True)
    after = f.given(i.light) * (one - f.given(i.alpha))
    found["transmittance"] = after
    found["lost_light"] = f.number(np.full(i.n, 1e-4)) / (one - f.given(i.alpha))
    found["blend_fragment"] = _blended(f, i, 24)
    found["blend_pixel"] = _blended(f, i, 0) * f.number(0.7)
    found["left_out"] = f.given(i.color[0]) + f.given(i.color[1])
    found["expected_depth"] = f.given(i.color[0]) / f.given(i.depth)
    return found


def _covariance(i: Inputs) -> np.ndarray:
    """[3, 3, n] covariances that float32 holds."""
    m = i.turn * i.scale[None]
    return np.einsum("rkn,ckn->rcn", m, m).astype(np.float32).astype(np.float64)


def _jacobian_row(i: Inputs) -> np.ndarray:
    """[3, n] rows of J that float32 holds."""
    found = np.array([i.focal / i.depth, np.zeros(i.n), -i.focal * i.across[0] / i.depth**2])
    return found.astype(np.float32).astype(np.float64)


def allowed(c: Charges, i: Inputs) -> dict[str, np.ndarray]:
    """Errors [n] that the charges ``c`` pay for, for `evaluated`."""
    size = np.abs(i.pose[0])
    size_of_terms = (size * (np.abs(i.mean) + np.abs(i.camera))).sum(axis=0)
    u = np.abs(i.across[0] / i.depth)
    world, row = _covariance(i), np.abs(_jacobian_row(i))
    m = np.abs((i.turn * i.scale[None]).astype(np.float32).astype(np.float64))
    gx = np.einsum("rn,rkn->kn", row, np.abs(i.pose))
    rows = np.einsum("kn,kjn->jn", np.einsum("rn,rkn->kn", row, np.abs(i.turn)), m)
    det = i.a * i.c - i.b * i.b
    half = 0.5 * (i.a + i.c)
    dx, dy = i.offset
    sigma = (0.5 * (i.c * dx * dx + i.a * dy * dy) - i.b * dx * dy) / det
    opacity = 1.0 / (1.0 + np.exp(-i.logit))
    limit = np.maximum(i.principal, _PIXELS - i.principal) / i.focal + 0.15 * _PIXELS / i.focal
    camera = np.abs(i.camera).sum(axis=0)
    sizes = [0.283, *[0.489] * 3, 0.547, 0.547, 0.631, 0.547, 0.547, 0.591, 0.557, 0.64, 0.747, 0.64, 0.557, 0.591]
    harmonics = (np.abs(i.sh) * np.array(sizes)[:, None]).sum(axis=0)
    n = np.ones(i.n)
    return {
        "camera_coordinate": c.camera_coordinate * size_of_terms,
        "reciprocal_depth": c.reciprocal_depth / i.depth,
        "ratio": c.ratio * u,
        "mean": c.mean * (i.focal * u + np.abs(i.center)),
        "clamp": c.clamp * limit,
        "jacobian": c.jacobian * i.focal * u / i.depth,
        "rotation": c.rotation * size[0],
        "rotation_entry": c.rotation_entry * i.scale[0],
        "covariance_products": c.covariance_products * (m[0] * m[1]).sum(axis=0),
        "covariance": c.covariance * np.einsum("kn,kjn,jn->n", gx, np.abs(world), gx),
        "gram": c.gram * (rows * rows).sum(axis=0),
        "blur": c.blur * (i.a + 0.3),
        "determinant": c.determinant * (i.a * i.c + i.b * i.b),
        "half_trace": c.half_trace * half,
        "discriminant": c.discriminant * half * half,
        "radius": c.radius * 3.0 * np.sqrt(half + np.sqrt(half)),
        "conic": c.conic * (i.a * i.c) / det * sigma,
        "compensation": c.compensation * np.abs(i.b) / np.sqrt(i.a * i.c) * i.alpha,
        "near": c.near * 0.01 * n,
        "tile": c.tile * (np.abs(dx) + half) / 16.0,
        "opacity": c.opacity * opacity,
        "exponent_limit": c.exponent_limit * opacity * np.exp(-0.555 * i.sigma),
        "depth_products": c.depth_products * (np.abs(i.turn[2]) * np.abs(i.mean)).sum(axis=0),
        "depth": c.depth * np.abs(i.mean[0] + i.mean[1]),
        # the products' own rounding is G10's
        "viewing_axis": (c.viewing_axis + 3.0 * c.depth / 1.1) * (np.abs(i.pose[2]) * np.abs(i.mean)).sum(axis=0)
        if c.viewing_axis else 0.0 * n,
        "camera_position": c.camera_position * (1.0 + camera),
        "direction_mean": c.direction_mean * (np.abs(i.mean[0]) + np.abs(i.camera[0])),
        "direction": c.direction * n,
        "harmonics": c.harmonics * harmonics,
        "color_sum": c.color_sum * n,
        "shifted_color": c.shifted_color * (i.color[0] + np.abs(i.camera[1])),
        "plain_color": c.plain_color * np.maximum(1.0, np.abs(i.sh[0])),
        "threshold": c.threshold / 255.0 * n,
        "exponential": (c.exponential + 1e-3 * c.exponential_by_argument * i.sigma) * i.alpha * np.exp(-1e-3 * i.sigma)
        if c.exponential else 0.0 * n,
        # beside what stands at an exponent of 0
        "exponential_by_argument": (c.exponential + c.exponential_by_argument * i.sigma) * np.exp(-i.sigma)
        if c.exponential_by_argument else 0.0 * n,
        "exponential_by_range": (c.exponential + c.exponential_by_range * 2.0 * i.sigma) * np.exp(-4.0 * i.sigma)
        if c.exponential_by_range else 0.0 * n,
        "transmittance": c.transmittance * i.light * (1.0 - i.alpha),
        "lost_light": c.lost_light * 1e-4 / (1.0 - i.alpha),
        "blend_fragment": (24.0 * c.blend_fragment + c.blend_pixel) * n if c.blend_fragment else 0.0 * n,
        "blend_pixel": c.blend_pixel * n,
        "left_out": c.left_out * (i.color[0] + i.color[1]),
        "expected_depth": c.expected_depth * i.color[0] / i.depth,
    }  # fmt: skip


def ratios(arithmetic: Arithmetic, c: Charges, count: int = 60, repeats: int = 4, seed: int = 0) -> dict[str, float]:
    """The largest error seen over the error that charges ``c`` pay for, by charge; infinite where nothing is paid."""
    inputs = Inputs(count, seed)
    with mpmath.workprec(200):
        exact = evaluated(Format(arithmetic, "exact", 0), inputs)
        paid = allowed(c, inputs)
        kinds = [("ieee", 0)] + [("worst", k) for k in range(repeats) if arithmetic.name == "float32"]
        worst = dict.fromkeys(exact, 0.0)
        for kind, k in kinds:
            for name, value in evaluated(Format(arithmetic, kind, k), inputs).items():
                flat = np.broadcast_to(np.asarray(value.x), exact[name].x.shape).ravel()
                error = np.array(
                    [float(abs(mpmath.mpf(float(v)) - e)) for v, e in zip(flat, exact[name].x.ravel(), strict=True)]
                )
                with np.errstate(divide="ignore", invalid="ignore"):
                    ratio = np.where(error > 0.0, error / np.broadcast_to(paid[name], error.shape), 0.0)
                worst[name] = max(worst[name], float(ratio.max()))
    return worst


def table(count: int) -> str:
    """The ledger in Markdown."""
    found = [ratios(a, charges(a), count) for a in (FLOAT32, REAL)]
    units = charges(FLOAT32)
    lines = ["| charge | units of float32 | seen / charged, float32 | seen / charged, real |", "|---|---|---|---|"]
    for name in Charges._fields:
        if name in UNMEASURED:
            lines.append(f"| `{name}` | | not measured: {UNMEASURED[name]} | |")
        else:
            values = " | ".join(f"{r[name]:.2f}" for r in found)
            lines.append(f"| `{name}` | {getattr(units, name) / FLOAT32.unit:.4g} | {values} |")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=2000, help="random inputs")
    parser.add_argument("--write", action="store_true", help="put the table into docs/dev/measurements.md")
    options = parser.parse_args()
    text = table(options.count)
    print(text)
    if options.write:
        page = PAGE.read_text(encoding="utf-8")
        begin, end = (page.index(mark) for mark in MARKS)
        PAGE.write_text(f"{page[: begin + len(MARKS[0])]}\n\n{text}\n\n{page[end:]}", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
