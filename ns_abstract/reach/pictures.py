"""Pictures along a loop: what the network sees, and what properties of the picture are read off (L7)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from ns_abstract.execution.cancellation import check_cancelled
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.geometry.tiles import assemble
from ns_abstract.refine.protocol import Frame, Method, SceneSample
from ns_abstract.verify.camera_response import CameraResponse, response_sets
from ns_abstract.verify.picture_properties import MeasureModel, PictureProperty
from ns_abstract.verify.picture_sets import sane

Float64 = NDArray[np.float64]


class LoopPictures(Protocol):
    """The interface of the pictures that the camera may take."""

    @property
    def pose_set(self) -> PoseBox:
        """The poses that may be looked at."""
        ...

    def image(self, values: Float64, member: SceneSample | None = None) -> np.ndarray:
        """[H, W, 3] float32 at pose parameters [d], of another scene of the set if one is named."""
        ...

    def scene_samples(self, seed: int) -> Iterator[SceneSample]:
        """Other scenes of the set, without end; none where only poses vary."""
        ...

    def sets(self, box: ParameterBox) -> tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray, np.ndarray]:
        """Return linear sets, bounds and slopes over a box of poses; see `ns_abstract.verify.protocol.FrameImages`."""
        ...


class Pictures:
    """A scene's pictures at ``poses``, boxes of which are bounded, as any camera of ``response`` shows them."""

    def __init__(self, method: Method, poses: PoseBox, response: CameraResponse | None = None) -> None:
        self.frame: Frame = method.frame(poses)
        self._response = response
        self.pose_set = self.frame.pose_set
        self._tiles = np.arange(self.frame.tile_count)

    def image(self, values: Float64, member: SceneSample | None = None) -> np.ndarray:
        check_cancelled()
        render = self.frame.render if member is None else member
        return assemble(render(np.asarray(values, np.float64)), self.frame.camera)

    def scene_samples(self, seed: int) -> Iterator[SceneSample]:
        return (
            self.frame.scene_samples(seed) if self._response is None else self._response.scene_samples(self.frame, seed)
        )

    def sets(self, box: ParameterBox) -> tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray, np.ndarray]:
        tile_bounds = self.frame.bound(box, self._tiles, keep_linear=True)
        linear, lower, upper = response_sets(tile_bounds, self.frame.camera, self._response)
        return linear, lower, upper, tile_bounds.slopes


@dataclass(frozen=True)
class PropertyView:
    """The pictures that a property is read off (L7), with the further planes that it reads behind the colours."""

    prop: PictureProperty
    pictures: LoopPictures
    model: MeasureModel

    def margin(self, values: Float64) -> float:
        """The margin of the rendered picture at pose parameters [d]; NaN where the picture is not finite."""
        image = self.pictures.image(values)
        if not np.isfinite(image).all():
            return math.nan
        outputs = torch.from_numpy(self.model.outputs(image[None]))
        claim = self.prop.bind(self.pictures.pose_set, lambda: image)
        return float(claim.margin(outputs, torch.from_numpy(np.asarray(values, np.float64)[None]))[0])

    def bound(self, box: ParameterBox) -> tuple[float, Float64]:
        """Lower bound of the margin over a box of poses, and slopes [d]; minus infinity where nothing is known."""
        linear, lower, upper, slopes = self.pictures.sets(box)
        steep = np.abs(np.asarray(slopes, np.float64))
        if not sane(linear, lower, upper):
            return -math.inf, steep
        claim = self.prop.bind(self.pictures.pose_set, lambda: lower)
        query = claim.query(np.zeros((1, len(claim.limits))))
        images = self.model.input_sets(tuple(part[None] for part in linear), lower[None], upper[None])
        margin = float(claim.proved(query, self.model.bound(images, query), [box])[0])
        return (-math.inf if math.isnan(margin) else margin), steep
