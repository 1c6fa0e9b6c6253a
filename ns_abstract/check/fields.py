"""Enclosures of pixels of a vanilla NeRF's fine field at the middles of equal bins, in real numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ns_abstract.check.forms import Affine, Array, U, total
from ns_abstract.check.networks import CheckedLayer, CheckedNetwork, product
from ns_abstract.check.poses import CameraForms, CheckedCamera
from ns_abstract.check.splats import from_the_back, wide


class CheckedField:
    """A field's layers; where rays are sampled is said from outside: near, far, samples, background.

    Attributes:
        network: From the encodings of position and direction, one behind the other, to density and colour.
        counts: Number of frequencies, and exponent of the highest, of positions and directions.
        arrays: All weights and biases in the order of the digest.
    """

    near: float
    far: float
    samples: int
    background: tuple[float, ...]

    def __init__(self, tensors: dict[str, Array]) -> None:
        def layers(name: str) -> list[tuple[Tensor, Tensor]]:
            keys = [f"field_fine.{name}.layers.{k}" for k in range(64)]
            keys = [k for k in keys if f"{k}.weight" in tensors] or [f"field_fine.{name}.net"]
            return [
                tuple(torch.from_numpy(tensors[f"{k}.{part}"]).double() for part in ("weight", "bias")) for k in keys
            ]

        names = ("mlp_base", "field_output_density", "mlp_head", "field_heads.0")
        base, density, head, color = map(layers, names)
        parts = (*base, *density, *head, *color)
        if 2 * len(parts) != len(tensors):
            raise ValueError("other tensors")
        self.arrays = [a.float().numpy() for part in parts for a in part]
        widths = base[0][0].shape[1], head[0][0].shape[1] - len(base[-1][0])
        self.counts, self.width = tuple(((w - 3) // 6, m) for w, m in zip(widths, (8.0, 4.0), strict=True)), sum(widths)
        self.network, hidden = CheckedNetwork([], "code", ["density.0", "color.0"], 0.0), None
        for k, layer in enumerate(base):
            hidden = self._dense(f"base{k}", layer, hidden, 0)
        self._dense("density", density[0], hidden, 0)
        for k, layer in enumerate(head):
            hidden = self._dense(f"head{k}", layer, hidden, widths[0])
        self._dense("color", color[0], hidden, 0)

    def _dense(self, name: str, layer: Any, hidden: tuple[str, int] | None, place: int) -> tuple[str, int]:
        """Adds a layer, and a ReLU, behind columns of the encoding from ``place`` on, and ``hidden`` behind these."""
        (weight, bias), layers, (before, width) = layer, self.network.layers, hidden or ("", 0)
        own = weight.shape[1] - width
        code = functional.pad(weight[:, :own], (place, self.width - place - own))
        parts = [("code", code)] * (own > 0) + [(before, weight[:, own:])] * (width > 0)
        names = [f"{name}.{k}" for k in range(len(parts))]
        for made, (source, matrix) in zip(names, parts, strict=True):
            addend = bias * (made == names[0])
            layers.append(CheckedLayer([source], made, *product(matrix), addend, matrix.shape[1]))
        if len(parts) > 1:
            layers.append(CheckedLayer(names, f"{name}.sum", terms=1))
            names = [f"{name}.sum"]
        layers.append(CheckedLayer(names, name))
        return name, len(weight)

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
        starts = [wide(e) + view.origin[:, k, None] for k, e in enumerate(view.position)]
        places = [(o + e * middles).wider(8.0 * U * self.far) for o, e in zip(starts, along, strict=True)]
        shape, encodings = (
            places[0].c.shape,
            (_encoded(e, *n) for e, n in zip((places, along), self.counts, strict=True)),
        )
        # a row for every sample of every box
        flat = [e.of(lambda a: np.broadcast_to(a, (*a.shape[:-3], *shape, a.shape[-1]))) for e in encodings]
        rows = Affine.joined(flat, -1).of(lambda a: a.reshape(*a.shape[:-3], -1, a.shape[-1]))
        raw, color = (e.of(lambda a: a.reshape(*a.shape[:-2], *shape, a.shape[-1])) for e in self.network.outputs(rows))
        raw = raw.of(lambda a: a[..., 0])
        low, high = raw.range()
        f, slope = np.logaddexp(0.0, raw.c), 1.0 / (1.0 + np.exp(-raw.c))
        # half the second derivative is at most 1/8, and half the exponential of its argument
        bend = np.minimum(0.5 * np.exp(np.minimum(high, 0.0)) * (1.0 + 1e-12), 0.125)
        # torch's softplus is its argument from 20 on
        density = raw.composed(f, slope, 0.0 * f, bend).wider(np.where(high > 19.0, 2.1e-9, 0.0))
        ends = [np.logaddexp(0.0, e) * (1.0 + s * 1e-9) for e, s in ((low, -1.0), (high, 1.0))]
        density = density.within(*ends)
        thin = (density * -lengths).exp()
        thick, thinned = (np.exp(-e * lengths) for e in ends)
        thin = thin.within(thinned * (1.0 - 1e-12), thick * (1.0 + 1e-12))
        f = 1.0 / (1.0 + np.exp(-color.c))
        ends = [1.0 / (1.0 + np.exp(-e)) * (1.0 + room) for e, room in zip(color.range(), (-1e-12, 1e-12), strict=True)]
        color = color.composed(f, f * (1.0 - f), -0.0482 + 0.0 * f, 0.0482 + 0.0 * f).within(*ends)
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
