"""Pictures of a frame over a set of poses, rendered and bounded without further changes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ns_abstract.execution.cancellation import check_cancelled
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.geometry.tiles import assemble
from ns_abstract.refine.protocol import Bounds, Frame, LinearSets, SceneSample
from ns_abstract.verify.camera_response import CameraResponse, response_sets


class ScenePictures:
    """Pictures of a frame as any camera of ``response`` shows them; see `ns_abstract.verify.protocol.FrameImages`."""

    def __init__(self, frame: Frame, response: CameraResponse | None = None) -> None:
        self.frame, self._response, self.box = frame, response, frame.box
        self._tiles = np.arange(frame.tile_count)

    @property
    def pose_set(self) -> PoseBox:
        """The set of all poses."""
        return self.frame.pose_set

    def image(self, values: np.ndarray, scene_sample: SceneSample | None = None) -> np.ndarray:
        check_cancelled()
        render = self.frame.render if scene_sample is None else scene_sample
        return assemble(render(np.asarray(values, np.float64)), self.frame.camera)

    def scene_samples(self, seed: int) -> Iterator[SceneSample]:
        return (
            self.frame.scene_samples(seed) if self._response is None else self._response.scene_samples(self.frame, seed)
        )

    def _bounds(self, box: ParameterBox) -> Bounds:
        """Return bounds of all tiles, with linear bounds."""
        return self.frame.bound(box, self._tiles, keep_linear=True)

    def linear_sets(self, box: ParameterBox) -> tuple[LinearSets, np.ndarray, np.ndarray, np.ndarray]:
        tile_bounds = self._bounds(box)
        return *response_sets(tile_bounds, self.frame.camera, self._response), tile_bounds.slopes
