"""Planes and forms of the network's input, relative to a reference image (docs/dev/design.md, N, N0, N22, V9)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from ns_abstract.arithmetic.network_charges import OVERFLOW, OWN_FEW, OWN_IMAGE
from ns_abstract.verify.network.coefficients import Float64, grid
from ns_abstract.verify.network.forms import NodeForm
from ns_abstract.verify.network.image_sets import ImageSets


class ImagePlanes(NamedTuple):
    """Linear bounds of the input image as the backward pass reads them.

    Slopes [m, 2, C, H, W, d] and offsets [m, 2, C, H, W] of the lower and the upper plane; lower, upper [m, C, H, W].
    """

    slopes: Float64
    offsets: Float64
    lower: Float64
    upper: Float64


def finite(images: ImageSets) -> tuple[list[Float64], np.ndarray]:
    """Return the image sets with non-finite numbers replaced, and [m] which cells had none.

    Cells with numbers past the limit of N22 are not among these.
    """
    fields = [np.asarray(getattr(images, name), np.float64) for name in images.__dataclass_fields__]
    usable = np.logical_and.reduce([np.isfinite(f).reshape(images.count, -1).all(axis=1) for f in fields])
    usable &= (fields[4] <= fields[5]).all(axis=1)
    # what float32 programs may not be able to compute with (N22)
    usable &= (np.maximum(np.abs(fields[4]), np.abs(fields[5])) < OVERFLOW).all(axis=1)
    return [np.where(usable.reshape(-1, *[1] * (f.ndim - 1)), f, 0.0) for f in fields], usable


def middle_of(fields: list[Float64]) -> Float64:
    """Return [m, n] the middle picture of every set."""
    return 0.5 * (np.maximum(fields[1], fields[4]) + np.minimum(fields[3], fields[5]))


def planes_of(fields: list[Float64], middle: Float64, input_shape: tuple[int, ...]) -> ImagePlanes:
    """Return the image sets as planes relative to the reference ``middle``."""
    m, _, d = fields[0].shape
    shape = grid(input_shape)
    a_lower, b_lower, a_upper, b_upper, lower, upper = fields
    b_lower, lower = (v - middle - OWN_IMAGE * (np.abs(v) + np.abs(middle)) for v in (b_lower, lower))
    b_upper, upper = (v - middle + OWN_IMAGE * (np.abs(v) + np.abs(middle)) for v in (b_upper, upper))
    # numpy keeps the order of axes in memory that the images came with
    return ImagePlanes(
        np.ascontiguousarray(np.stack([a_lower, a_upper], 1)).reshape(m, 2, *shape, d),
        np.ascontiguousarray(np.stack([b_lower, b_upper], 1)).reshape(m, 2, *shape),
        np.ascontiguousarray(lower).reshape(m, *shape),
        np.ascontiguousarray(upper).reshape(m, *shape),
    )


def form_of(planes: ImagePlanes, middle: Float64, input_shape: tuple[int, ...]) -> NodeForm:
    """Return the input as a form: the mean of its lower and upper plane."""
    m, d = len(middle), planes.slopes.shape[-1]
    slopes, offsets = torch.from_numpy(planes.slopes), torch.from_numpy(planes.offsets)
    a = slopes.mean(1).movedim(-1, 1).reshape(m, d, *input_shape)
    c = offsets.mean(1)
    spread = 0.5 * (offsets[:, 1] - offsets[:, 0]) + 0.5 * (slopes[:, 1] - slopes[:, 0]).abs().sum(-1)
    spread = spread.clamp(min=0.0) + OWN_FEW * (offsets.abs().amax(1) + slopes.abs().amax(1).sum(-1))
    c, spread = c.reshape(-1, *input_shape), spread.reshape(-1, *input_shape)
    reference = torch.from_numpy(middle).reshape(-1, *input_shape)
    return NodeForm.ranged(reference, c, a, spread)
