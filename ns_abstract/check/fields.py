"""Enclosures of pixels of a vanilla NeRF's fine field at the middles of equal bins, in real numbers."""

from __future__ import annotations

import numpy as np
import torch

from ns_abstract.check.blending import from_the_back
from ns_abstract.check.forms import Affine, Array, U, total
from ns_abstract.check.poses import CameraForms, CheckedCamera
from ns_abstract.check.splats import wide

#: Room for numpy's exponential; by how much torch's softplus, which is its argument from 20 on, is below the function.
#: Neurons of a layer and sample that keep a symbol of their own where they may bend; boxes that are looked at together.
_LIBRARY, _SOFTPLUS_CUT, SYMBOLS, TOGETHER = 1e-12, 2.1e-9, 256, 4


class CheckedField:
    """A field's layers; where rays are sampled is said from outside: near, far, samples, background.

    Attributes:
        base, density, head, color: Lists of (weight [out, in], bias [out]); ReLU behind those of base and head.
        counts: Number of frequencies, and exponent of the highest, of positions and directions.
        arrays: All weights and biases in the order of the digest.
    """

    near: float
    far: float
    samples: int
    background: tuple[float, ...]

    def __init__(self, tensors: dict[str, Array]) -> None:
        def layers(name: str) -> list[tuple[Array, Array]]:
            keys = [f"field_fine.{name}.layers.{k}" for k in range(64)]
            keys = [k for k in keys if f"{k}.weight" in tensors] or [f"field_fine.{name}.net"]
            return [(tensors[f"{k}.weight"].astype(np.float64), tensors[f"{k}.bias"].astype(np.float64)) for k in keys]

        names = ("mlp_base", "field_output_density", "mlp_head", "field_heads.0")
        self.base, self.density, self.head, self.color = map(layers, names)
        parts = (*self.base, *self.density, *self.head, *self.color)
        if 2 * len(parts) != len(tensors):
            raise ValueError("other tensors")
        self.arrays = [a.astype(np.float32) for part in parts for a in part]
        widths = self.base[0][0].shape[1], self.head[0][0].shape[1] - self.base[-1][0].shape[0]
        self.counts = tuple(((w - 3) // 6, m) for w, m in zip(widths, (8.0, 4.0), strict=True))

    def pixels(self, cam: CheckedCamera, view: CameraForms, pixel: tuple[Array, Array]) -> Affine:
        """Colours [B, 3] before the clamp of one pixel over each of B boxes."""
        ray = ((pixel[1] + 0.5 - cam.cx) / cam.fx, -(pixel[0] + 0.5 - cam.cy) / cam.fy, -np.ones(len(pixel[0])))
        along = [total(e * v for e, v in zip(row, ray, strict=True)) for row in view.turn]
        along = [e.wider(8.0 * U * sum(abs(v) for v in ray)) for e in along]
        inverse = total(e.square() for e in along).root().reciprocal()
        along = [wide(e * inverse) for e in along]
        edges = np.linspace(0.0, 1.0, self.samples + 1)
        edges = edges * self.far + (1.0 - edges) * self.near
        middles, lengths = 0.5 * (edges[1:] + edges[:-1]), edges[1:] - edges[:-1]
        one = np.ones(self.samples)
        starts = [wide(e) * one + view.origin[:, k, None] for k, e in enumerate(view.position)]
        places = [(o + e * middles).wider(8.0 * U * self.far) for o, e in zip(starts, along, strict=True)]
        parts = []
        for k in range(0, len(ray[0]), TOGETHER):
            some = [[e.of(lambda a, k=k: a[..., k : k + TOGETHER, :]) for e in es] for es in (places, along)]
            with np.errstate(all="ignore"):
                parts.append(self._ray(some[0], some[1], lengths))
        return Affine.joined(parts, -2)

    def _ray(self, places: list[Affine], along: list[Affine], lengths: Array) -> Affine:
        d, (position, direction) = (
            len(places[0].g),
            (_encoded(e, *n) for e, n in zip((places, along), self.counts, strict=True)),
        )
        code = _Zonotope.of(position)
        x = code
        for k, (weight, bias) in enumerate(self.base):
            x = (code.beside(x) if k and weight.shape[1] != x.c.shape[-1] else x).layer(weight, bias).bent()
        raw = x.layer(*self.density[0]).form(d).of(lambda a: a[..., 0])
        low, high = raw.range()
        f, slope = np.logaddexp(0.0, raw.c), 1.0 / (1.0 + np.exp(-raw.c))
        # half the second derivative is at most 1/8, and half the exponential of its argument
        bend = np.minimum(0.5 * np.exp(np.minimum(high, 0.0)) * (1.0 + _LIBRARY), 0.125)
        # torch's softplus is its argument from 20 on
        density = raw.composed(f, slope, 0.0 * f, bend).wider(np.where(high > 19.0, _SOFTPLUS_CUT, 0.0))
        ends = [np.logaddexp(0.0, e) * (1.0 + s * 1e-9) for e, s in ((low, -1.0), (high, 1.0))]
        density = density.within(*ends)
        thin = (density * -lengths).exp()
        thick, thinned = (np.exp(-e * lengths) for e in ends)
        thin = thin.within(thinned * (1.0 - _LIBRARY), thick * (1.0 + _LIBRARY))
        x = _Zonotope.of(direction).stretched(x).beside(x)
        for weight, bias in self.head:
            x = x.layer(weight, bias).bent()
        raw = x.layer(*self.color[0]).form(d)
        f = 1.0 / (1.0 + np.exp(-raw.c))
        color = raw.composed(f, f * (1.0 - f), -0.0482 + 0.0 * f, 0.0482 + 0.0 * f)
        ends = zip(raw.range(), (-_LIBRARY, _LIBRARY), strict=True)
        color = color.within(*(1.0 / (1.0 + np.exp(-e)) * (1.0 + room) for e, room in ends))
        alpha = -thin + 1.0
        return from_the_back(alpha, color, np.ones(alpha.c.shape, bool), np.array(self.background), 0.0)


def _encoded(x: list[Affine], count: int, most: float) -> Affine:
    """Sines and cosines of three coordinates [B, S], coordinate outside and frequency inside, and the coordinates."""
    # the float32 powers that nerfstudio computes
    frequencies = (2.0 ** torch.linspace(0.0, most, count)).double().tolist()
    angles = [wide(e) * (2.0 * np.pi * f) for e in x for f in frequencies]
    waves = [e.sine() for e in angles]
    parts = [*(s for s, _ in waves), *(c for _, c in waves), *(wide(e) for e in x)]
    return Affine.joined(parts, -1)


class _Zonotope:
    """Forms [B, S, n] whose remainders have symbols of their own, which are shared by the numbers of a sample."""

    def __init__(self, c: Array, g: Array, r: Array) -> None:
        self.c, self.g, self.r = c, g, r

    @classmethod
    def of(cls, form: Affine) -> _Zonotope:
        own = np.eye(form.c.shape[-1])[:, None, None] * form.r
        return cls(form.c, np.concatenate([form.g, own]), 0.0 * form.r)

    def stretched(self, other: _Zonotope) -> _Zonotope:
        """Over the samples of ``other``, its own symbols behind those of ``other``."""
        shape, d, k = other.c.shape[:2], len(self.g) - self.c.shape[-1], len(other.g)
        c, r, g = (np.broadcast_to(a, (*a.shape[:-3], *shape, a.shape[-1])) for a in (self.c, self.r, self.g))
        return _Zonotope(c, np.concatenate([g[:d], np.zeros((k - d, *c.shape)), g[d:]]), r)

    def beside(self, other: _Zonotope) -> _Zonotope:
        """Both one behind the other; equal symbols are the same."""
        most = max(len(self.g), len(other.g))
        full = [np.concatenate([e.g, np.zeros((most - len(e.g), *e.c.shape))]) for e in (self, other)]
        return _Zonotope(*(np.concatenate(p, axis=-1) for p in ((self.c, other.c), full, (self.r, other.r))))

    def width(self) -> Array:
        return (np.abs(self.g).sum(axis=0) + self.r) * (1.0 + 2.0 * U * (len(self.g) + 8))

    def layer(self, weight: Array, bias: Array) -> _Zonotope:
        size = (np.abs(self.c) + self.width()) @ np.abs(weight).T + np.abs(bias)
        r = self.r @ np.abs(weight).T + 2.0 * U * (weight.shape[1] + len(self.g) + 16) * size
        return _Zonotope(self.c @ weight.T + bias, self.g @ weight.T, r)

    def bent(self) -> _Zonotope:
        """Behind a ReLU: between two parallel lines, whose distance has a symbol."""
        w = self.width() + 2.0 * U * np.abs(self.c)
        low, high = self.c - w, self.c + w
        bends = (low < 0.0) & (high > 0.0)
        slope = np.where(bends, np.minimum(high / np.where(bends, high - low, 1.0) * (1.0 + 8.0 * U), 1.0), low >= 0.0)
        half = np.where(bends, -0.5 * slope * low * (1.0 + 8.0 * U), 0.0)
        c, r = slope * self.c + half, slope * self.r + 4.0 * U * (np.abs(self.c) + w)
        count = min(int(bends.sum(axis=-1).max(initial=0)), SYMBOLS)
        if count:
            which = np.argsort(-half, axis=-1)[..., :count]
            own = np.zeros((count, *c.shape))
            for k in range(count):
                np.put_along_axis(
                    own[k], which[..., k : k + 1], np.take_along_axis(half, which[..., k : k + 1], -1), -1
                )
            r = r + np.maximum(half - own.sum(axis=0), 0.0)
            return _Zonotope(c, np.concatenate([slope * self.g, own]), r)
        return _Zonotope(c, slope * self.g, r)

    def form(self, d: int) -> Affine:
        """Without the symbols behind the first d."""
        radius = np.abs(self.g[d:]).sum(axis=0) + self.r
        return Affine(self.c, self.g[:d], radius * (1.0 + 2.0 * U * (len(self.g) + 8)))
