"""Encloses pixels of a vanilla NeRF's fine field, sampled at the middles of equal bins, in real numbers."""

from __future__ import annotations

import numpy as np
import torch

from ns_abstract.check.blending import from_the_back
from ns_abstract.check.forms import Affine, Array, U, total
from ns_abstract.check.poses import CameraForms, CheckedCamera
from ns_abstract.check.splats import wide

#: Room for numpy's exponential; by how much torch's softplus, which is its argument from 20 on, is below the function.
#: Numbers of a layer and sample that have symbols of their own at most.
_LIBRARY, _SOFTPLUS_CUT, SYMBOLS = 1e-12, 2.1e-9, 256


class CheckedField:
    """A NeRF's fine field: its layers, the ends and number of samples of its rays, and the background."""

    def __init__(
        self, tensors: dict[str, Array], near: float, far: float, samples: int, background: tuple[float, ...]
    ) -> None:
        self.near, self.far, self.samples, self.background = near, far, samples, background

        def layers(name: str) -> list[tuple[Array, Array]]:
            keys = [f"field_fine.{name}.layers.{k}" for k in range(64)]
            keys = [k for k in keys if f"{k}.weight" in tensors] or [f"field_fine.{name}.net"]
            return [(tensors[f"{k}.weight"].astype(np.float64), tensors[f"{k}.bias"].astype(np.float64)) for k in keys]

        names = ("mlp_base", "field_output_density", "mlp_head", "field_heads.0")
        # (weight [out, in], bias [out]) of every layer; ReLU behind those of base and head
        self.base, self.density, self.head, self.color = map(layers, names)
        parts = (*self.base, *self.density, *self.head, *self.color)
        if 2 * len(parts) != len(tensors):
            raise ValueError("other tensors")
        # in the order of the digest
        self.arrays = [a.astype(np.float32) for part in parts for a in part]
        widths = self.base[0][0].shape[1], self.head[0][0].shape[1] - self.base[-1][0].shape[0]
        # number of frequencies, and exponent of the highest, of positions and directions
        self.counts = tuple(((w - 3) // 6, m) for w, m in zip(widths, (8.0, 4.0), strict=True))

    def pixels(self, cam: CheckedCamera, view: CameraForms, pixel: tuple[Array, Array]) -> Affine:
        """Return a pixel's colours [B, 3] before the clamp over B boxes of poses; ``pixel``: rows [B], columns [B]."""
        ray = ((pixel[1] + 0.5 - cam.cx) / cam.fx, -(pixel[0] + 0.5 - cam.cy) / cam.fy, -np.ones(len(pixel[0])))
        along = [total(e * v for e, v in zip(row, ray, strict=True)) for row in view.turn]
        along = [e.wider(8.0 * U * sum(abs(v) for v in ray)) for e in along]
        inverse = total(e.square() for e in along).power(-0.5)
        along = [wide(e * inverse) for e in along]
        edges = np.linspace(0.0, 1.0, self.samples + 1)
        edges = edges * self.far + (1.0 - edges) * self.near
        middles, lengths = 0.5 * (edges[1:] + edges[:-1]), edges[1:] - edges[:-1]
        one = np.ones(self.samples)
        starts = [wide(e) * one + view.origin[:, k, None] for k, e in enumerate(view.position)]
        places = [(o + e * middles).wider(8.0 * U * self.far) for o, e in zip(starts, along, strict=True)]
        with np.errstate(all="ignore"):
            return self._ray(places, along, lengths)

    def _ray(self, places: list[Affine], along: list[Affine], lengths: Array) -> Affine:
        """Return colours [B, 3] from samples at ``places`` [B, S], directions ``along``, and bin lengths [S]."""
        d = len(places[0].g)
        position, direction = (_encoded(e, *n) for e, n in zip((places, along), self.counts, strict=True))
        x = code = position.with_symbols(SYMBOLS)
        for k, (weight, bias) in enumerate(self.base):
            if k and weight.shape[1] != x.c.shape[-1]:
                x = Affine.joined([code.padded(len(x.g)), x], -1)
            x = x.dense(weight, bias).relu(SYMBOLS)
        raw = x.dense(*self.density[0]).keep_symbols(d).apply(lambda a: a[..., 0])
        low, high = raw.range()
        f, slope = np.logaddexp(0.0, raw.c), 1.0 / (1.0 + np.exp(-raw.c))
        # half the second derivative is at most 1/8, and half the exponential of its argument
        bend = np.minimum(0.5 * np.exp(np.minimum(high, 0.0)) * (1.0 + _LIBRARY), 0.125)
        # torch's softplus is its argument from 20 on
        density = raw.taylor(f, slope, 0.0 * f, bend).wider(np.where(high > 19.0, _SOFTPLUS_CUT, 0.0))
        ends = [np.logaddexp(0.0, e) * (1.0 + s * 1e-9) for e, s in ((low, -1.0), (high, 1.0))]
        thin = (density.narrowed(*ends) * -lengths).exp()
        thick, thinned = (np.exp(-e * lengths) for e in ends)
        thin = thin.narrowed(thinned * (1.0 - _LIBRARY), thick * (1.0 + _LIBRARY))
        direction = direction.apply(lambda a: np.broadcast_to(a, (*a.shape[:-2], *x.c.shape[-2:-1], a.shape[-1])))
        x = Affine.joined([direction.padded(len(x.g)), x], -1)
        for weight, bias in self.head:
            x = x.dense(weight, bias).relu(SYMBOLS)
        raw = x.dense(*self.color[0]).keep_symbols(d)
        f = 1.0 / (1.0 + np.exp(-raw.c))
        color = raw.taylor(f, f * (1.0 - f), -0.0482 + 0.0 * f, 0.0482 + 0.0 * f)
        ends = zip(raw.range(), (-_LIBRARY, _LIBRARY), strict=True)
        color = color.narrowed(*(1.0 / (1.0 + np.exp(-e)) * (1.0 + room) for e, room in ends))
        alpha = -thin + 1.0
        return from_the_back(alpha, color, np.ones(alpha.c.shape, bool), np.array(self.background), 0.0)


def _encoded(x: list[Affine], count: int, most: float) -> Affine:
    """Return Nerfstudio's encoding of coordinates [B, S]: sines, cosines (by coordinate and frequency), coordinates."""
    # the float32 powers that nerfstudio computes
    frequencies = (2.0 ** torch.linspace(0.0, most, count)).double().tolist()
    angles = [wide(e) * (2.0 * np.pi * f) for e in x for f in frequencies]
    waves = [e.sine() for e in angles]
    parts = [*(s for s, _ in waves), *(c for _, c in waves), *(wide(e) for e in x)]
    return Affine.joined(parts, -1)
