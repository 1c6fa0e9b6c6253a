"""A trained vanilla NeRF as plain arrays: layers, encodings, sampling and background."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ns_abstract.geometry.transform import DataparserTransform
from ns_abstract.io.assumptions import Assumption

if TYPE_CHECKING:
    from ns_abstract.methods.nerf.occupancy import OccupancyGrid

Float32Array = NDArray[np.float32]


@dataclass(frozen=True)
class Encoding:
    """Sines and cosines of an input vector x (nerfstudio/field_components/encodings.py, ``NeRFEncoding``).

    ``[sin(2 pi f_j x_i)], [sin(2 pi f_j x_i + pi / 2)], x`` with the coordinate i outside and the
    frequency j inside; ``f`` grows geometrically from ``2^least`` to ``2^most``.
    """

    count: int
    least: float = 0.0
    most: float = 8.0

    @property
    def frequencies(self) -> NDArray[np.float64]:
        """[count] frequencies as Nerfstudio has them: a float32 power of a float32 exponent."""
        import torch

        return (2.0 ** torch.linspace(self.least, self.most, self.count, dtype=torch.float32)).double().numpy()

    @property
    def size(self) -> int:
        """Length of the encoded vector of a point."""
        return 6 * self.count + 3


@dataclass(frozen=True)
class Layer:
    """A linear layer: ``weight`` [out, in] and ``bias`` [out], float32; ``skip``: the encoding comes first."""

    weight: Float32Array
    bias: Float32Array
    skip: bool = False


class Waves(NamedTuple):
    """The components of an encoded vector that some weight uses.

    Attributes:
        frequencies: [k] used frequencies of `Encoding.frequencies`.
        columns: [6 k + 3] indices in the encoded vector of their sines and cosines, then of the input itself.
    """

    frequencies: NDArray[np.float64]
    columns: NDArray[np.int64]


def _waves(encoding: Encoding, layers: Sequence[Layer]) -> Waves:
    """Return `Waves` that have a nonzero weight in one of ``layers``, whose first inputs are the encoded vector."""
    looks = np.any([layer.weight[:, : encoding.size].any(axis=0) for layer in layers], axis=0)
    places = np.arange(encoding.size - 3).reshape(2, 3, encoding.count)
    used = looks[places].any(axis=(0, 1))
    own = np.arange(encoding.size - 3, encoding.size)
    return Waves(encoding.frequencies[used], np.concatenate([places[:, :, used].ravel(), own]))


@dataclass(frozen=True)
class FieldWeights:
    """One field (nerfstudio/fields/vanilla_nerf_field.py, ``NeRFField``).

    Attributes:
        base: ReLU after every layer; the first takes the encoded position.
        density: One output, softplus.
        head: ReLU after every layer; the first takes the encoded direction, then the base's output.
        color: Three outputs, sigmoid.
    """

    base: tuple[Layer, ...]
    density: Layer
    head: tuple[Layer, ...]
    color: Layer
    position: Encoding
    direction: Encoding

    def arrays(self) -> list[Float32Array]:
        """Return all weights and biases in a fixed order."""
        layers = (*self.base, self.density, *self.head, self.color)
        return [array for layer in layers for array in (layer.weight, layer.bias)]

    @cached_property
    def position_waves(self) -> Waves:
        """Components of the encoded position that the base uses."""
        return _waves(self.position, [layer for i, layer in enumerate(self.base) if i == 0 or layer.skip])

    @cached_property
    def direction_waves(self) -> Waves:
        """Components of the encoded direction that the head uses."""
        return _waves(self.direction, self.head[:1])

    @property
    def plan(self) -> tuple[str, ...]:
        """Sentences that count the frequencies that bounds leave out because all their weights are 0."""
        pairs = (
            ("positions", self.position, self.position_waves),
            ("directions", self.direction, self.direction_waves),
        )
        return tuple(
            f"{encoding.count - waves.frequencies.size} of {encoding.count} frequencies of encoded {name} left out: "
            "no weight looks at them"
            for name, encoding, waves in pairs
            if waves.frequencies.size < encoding.count
        )

    @property
    def width(self) -> int:
        """Most neurons of a layer."""
        return max(layer.weight.shape[0] for layer in (*self.base, *self.head))

    @property
    def text(self) -> str:
        """The architecture in a few words."""
        skips = [str(i) for i, layer in enumerate(self.base) if layer.skip]
        skip = f", skip into layer {', '.join(skips)}" if skips else ""
        width = self.base[0].weight.shape[0]
        return f"{len(self.base)} x {width}{skip}; head {len(self.head)} x {self.head[0].weight.shape[0]}"


@dataclass(frozen=True, kw_only=True)
class FieldScene:
    """Name, source, units and assumptions of a NeRF of either kind.

    Attributes:
        dataparser: Transform from the training data's frame to the normalised frame.
        notes: Sentences on what was assumed because the source does not state it.
        assumptions: Choices that the picture depends on, each with its origin.
    """

    dataparser: DataparserTransform = field(default_factory=DataparserTransform)
    name: str = "scene"
    source: str = ""
    notes: tuple[str, ...] = ()
    assumptions: tuple[Assumption, ...] = ()


@dataclass(frozen=True)
class NerfScene(FieldScene):
    """A vanilla NeRF.

    Attributes:
        near, far: Distances of the rays' ends in evaluation, units of the normalised frame.
        background: [3] float32 RGB behind the last sample.
        occupancy: Declared by the user: density is 0 outside of its occupied voxels.
    """

    coarse: FieldWeights
    fine: FieldWeights
    near: float = 0.0
    far: float = 6.0
    coarse_samples: int = 64
    importance_samples: int = 128
    background: Float32Array = field(default_factory=lambda: np.ones(3, np.float32))
    occupancy: OccupancyGrid | None = None
