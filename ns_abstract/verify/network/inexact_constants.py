"""Layers whose constants are intervals, because programs compute them from stored ones (N23)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from torch import Tensor

from ns_abstract.verify.network.graph import as_double
from ns_abstract.verify.network.layers import Convolution, LinearLayer, Matrix, ScaleLayer
from ns_abstract.verify.network.sparse_layers import TransposedConvolution

#: (exact value, float32 evaluations): how far either may be from the number that the layer holds.
ConstantIntervals = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False, kw_only=True)
class InexactLayer(LinearLayer):
    """A linear layer with interval constants: charges their widths times the input's magnitude.

    ``real`` and ``evaluated`` are layers whose weights are the errors of the exact value and of float32 evaluations.
    """

    real: LinearLayer
    evaluated: LinearLayer

    def inexact(self, sizes: Sequence[Tensor]) -> Tensor | float:
        return self.real(sizes)

    def spare(self, sizes: Sequence[Tensor]) -> Tensor | float:
        return super().spare(sizes) + self.evaluated(sizes)


@dataclass(frozen=True, eq=False, kw_only=True)
class InexactConvolution(InexactLayer, Convolution):
    """A convolution."""


@dataclass(frozen=True, eq=False, kw_only=True)
class InexactMatrix(InexactLayer, Matrix):
    """A fully connected layer."""


@dataclass(frozen=True, eq=False, kw_only=True)
class InexactScale(InexactLayer, ScaleLayer):
    """A factor and an offset."""


@dataclass(frozen=True, eq=False, kw_only=True)
class InexactTransposedConvolution(InexactLayer, TransposedConvolution):
    """A transposed convolution."""


_KINDS = {
    Convolution: InexactConvolution,
    Matrix: InexactMatrix,
    ScaleLayer: InexactScale,
    TransposedConvolution: InexactTransposedConvolution,
}


def with_inexact_constants(
    layer: LinearLayer, weight: ConstantIntervals | None, offset: ConstantIntervals | None
) -> LinearLayer:
    """Return the layer with interval weights (a scale's factor) and offset, in their shapes; None: exact."""
    name = "factor" if isinstance(layer, ScaleLayer) else "weight"
    sides = []
    for side in range(2):
        parts = {}
        for key, doubts in ((name, weight), ("offset", offset)):
            own = getattr(layer, key)
            if own is None:
                continue
            end = np.zeros(()) if doubts is None else doubts[side]
            parts[key] = as_double(np.broadcast_to(np.abs(end), tuple(own.shape)))
        sides.append(replace(layer, **parts))
    end = {f.name: getattr(layer, f.name) for f in fields(layer)}
    return _KINDS[type(layer)](**end, real=sides[0], evaluated=sides[1])
