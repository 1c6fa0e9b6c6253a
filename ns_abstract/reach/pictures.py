"""Bounds and renders of the pictures along a loop, for properties of the picture (docs/dev/design.md, L7)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.verify.picture_properties import MeasureModel, PictureProperty
from ns_abstract.verify.picture_sets import sane
from ns_abstract.verify.scene_pictures import ScenePictures

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class PropertyView:
    """The pictures that a property is evaluated on (L7): colours, then the further channels that it needs."""

    prop: PictureProperty
    pictures: ScenePictures
    model: MeasureModel

    def margin(self, values: Float64) -> float:
        """Return the margin of the picture rendered at pose parameters [d]; NaN where it is not finite."""
        image = self.pictures.image(values)
        if not np.isfinite(image).all():
            return math.nan
        outputs = torch.from_numpy(self.model.outputs(image[None]))
        claim = self.prop.bind(self.pictures.pose_set, lambda: image)
        return float(claim.margin(outputs, torch.from_numpy(np.asarray(values, np.float64)[None]))[0])

    def bound(self, box: ParameterBox) -> tuple[float, Float64]:
        """Return a lower bound of the margin over a box of poses, and its slopes [d]; -infinity if none is known."""
        linear, lower, upper, slopes = self.pictures.linear_sets(box)
        steep = np.abs(np.asarray(slopes, np.float64))
        if not sane(linear, lower, upper):
            return -math.inf, steep
        claim = self.prop.bind(self.pictures.pose_set, lambda: lower)
        query = claim.query(np.zeros((1, len(claim.limits))))
        images = self.model.input_sets(tuple(part[None] for part in linear), lower[None], upper[None])
        margin = float(claim.proved(query, self.model.bound(images, query), [box])[0])
        return (-math.inf if math.isnan(margin) else margin), steep
