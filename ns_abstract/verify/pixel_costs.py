"""Estimate how much of a property's margin each pixel's bounds cost: where refining pays."""

from __future__ import annotations

import numpy as np
import torch

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.verify.properties import Claim
from ns_abstract.verify.protocol import FrameImages, Model


def pixel_weights(scene: FrameImages, model: Model, claim: Claim, box: ParameterBox) -> np.ndarray | None:
    """[H, W, 3] slopes of the margin by pixel in the middle of a cell, as parts of the margin there (an estimate).

    None where the margin is not above 0, or a slope is no number. What is found decides about work alone.
    """
    values = box.middle
    image = torch.from_numpy(scene.image(values).astype(np.float64)).requires_grad_(True)
    margin = claim.margin(model.differentiable(image[None]), torch.from_numpy(values)[None])[0]
    size = float(margin.detach())
    if not margin.requires_grad or not 0.0 < size < float("inf"):
        return None
    (slope,) = torch.autograd.grad(margin, image)
    costs = slope.abs().numpy() / size
    return costs if np.isfinite(costs).all() else None
