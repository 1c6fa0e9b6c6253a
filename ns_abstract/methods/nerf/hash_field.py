"""A trained nerfacto as plain arrays: hash grids, small networks and the positions of its samples.

The semantics are those of Nerfstudio's torch implementation (nerfstudio/field_components/encodings.py,
``HashEncoding.pytorch_fwd``; fields/nerfacto_field.py; fields/density_fields.py), at the parameters' exact values.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ns_abstract.methods.nerf.scene import FieldScene

FloatArray = NDArray[np.float64]
#: nerfstudio/field_components/encodings.py:407, ``hash_fn``.
PRIME_Y, PRIME_Z = 2654435761, 805459861
#: Most layers of a network of densities.
LAYERS_LIMIT = 8


@dataclass(frozen=True)
class HashEncoding:
    """A multiresolution hash grid of positions in [0, 1]^3.

    On level l the position times ``resolutions[l]`` lies in a cell whose corners are its floors and ceilings. The
    corner (x, y, z) has row ``(x xor y * 2654435761 xor z * 805459861) mod 2^T`` of ``table[l]``, and rows are
    interpolated trilinearly. Features are ordered by level, then by feature.

    Attributes:
        table: [L, 2^T, F] float64, C order; the values are those of float32.
        resolutions: [L] int64, at least 1, as torch computes them in float32.
    """

    table: FloatArray
    resolutions: NDArray[np.int64]

    @property
    def size(self) -> int:
        """Number of features of a position."""
        return self.table.shape[0] * self.table.shape[2]


@dataclass(frozen=True)
class DenseNet:
    """Linear layers with a ReLU after every one but the last.

    Attributes:
        weights: [out, in] float64 each, C order.
        biases: [out] float64 each.
    """

    weights: tuple[FloatArray, ...]
    biases: tuple[FloatArray, ...]

    @property
    def text(self) -> str:
        """The layers' widths as text, from inputs to outputs."""
        return "-".join(str(n) for n in (self.weights[0].shape[1], *(w.shape[0] for w in self.weights)))


@dataclass(frozen=True)
class ProposalField:
    """Densities that place samples: ``average_init_density * exp(net(encoding(position)))``.

    Attributes:
        average_init_density: Factor of the density, above 0.
    """

    encoding: HashEncoding
    net: DenseNet
    average_init_density: float


@dataclass(frozen=True)
class NerfactoField:
    """The fields and sampling that nerfacto evaluates for a ray.

    Rays begin at ``near`` and end at ``far``. Positions x are contracted (nerfstudio's ``SceneContraction`` of the
    maximum norm) to u in (-2, 2)^3, and the grids take ``(u + 2) / 4``. Every round evaluates its proposal field in the
    middles of its intervals and places the edges of the next round's intervals by the weights.

    Attributes:
        density_net: Outputs are the logarithm of density over ``average_init_density``, then geometric features.
        color_net: From 16 harmonics of ``(direction + 1) / 2``, as nerfstudio's torch implementation evaluates them,
            then the geometric features; its outputs are before the sigmoid. The appearance embedding is part of the
            first bias, which is the exact value rounded to nearest float64 once.
        average_init_density: Factor of the density, above 0.
        proposals: The proposal field of every round; one field may serve several.
        samples: Numbers of intervals of every round, then of the picture's samples.
        near, far: Distances of the rays' ends, units of the normalised frame.
        spacing: "piecewise": edges of the first round are equally spaced in x / 2 below distance 1 and in 1 - 1 / (2 x)
            above; "uniform": in distance.
        background: [3] RGB behind the last sample, or "last_sample": the colour of the last sample.
        contraction: Whether positions are contracted; False is not supported.
    """

    encoding: HashEncoding
    density_net: DenseNet
    color_net: DenseNet
    average_init_density: float
    proposals: tuple[ProposalField, ...]
    samples: tuple[int, ...]
    near: float = 0.0
    far: float = 1000.0
    spacing: Literal["piecewise", "uniform"] = "piecewise"
    background: FloatArray | Literal["last_sample"] = "last_sample"
    contraction: bool = True

    def arrays(self) -> list[NDArray[np.float64] | NDArray[np.int64]]:
        """Return all parameters in a fixed order."""
        encodings = (self.encoding, *(one.encoding for one in self.proposals))
        nets = (self.density_net, self.color_net, *(one.net for one in self.proposals))
        grids = [array for one in encodings for array in (one.table, one.resolutions)]
        return [*grids, *(array for net in nets for array in (*net.weights, *net.biases))]

    @property
    def text(self) -> str:
        """The architecture as text."""
        levels, size, features = self.encoding.table.shape
        steps = "/".join(map(str, self.samples))
        return (
            f"{levels} levels of 2^{size.bit_length() - 1} x {features} features to resolution "
            f"{self.encoding.resolutions[-1]}, networks {self.density_net.text} and {self.color_net.text}, "
            f"samples {steps}"
        )


@dataclass(frozen=True)
class NerfactoScene(FieldScene):
    """A nerfacto."""

    field: NerfactoField
