"""Approximates the picture at a pose by a rendered picture nearby, moved (docs/dev/design.md, U8).

Pixels of a wide cell are chosen by the picture in its middle. One rendered picture serves all cells nearby. It only
affects which pixels are bounded.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ns_abstract.geometry.box import Float64Array, ParameterBox
from ns_abstract.geometry.enclosing_boxes import EnclosingBoxes
from ns_abstract.geometry.motion_cells import MotionField
from ns_abstract.geometry.tiles import assemble, in_tiles
from ns_abstract.refine.protocol import Frame
from ns_abstract.verify.neighbouring_pixels import moved


@dataclass(frozen=True)
class FoundPose:
    """A rendered pose."""

    values: tuple[float, ...]
    outliers: int


@dataclass(frozen=True)
class _Drawn:
    """The picture [H, W, c] of the middle of a box, its motion over the box, and its outliers."""

    box: ParameterBox
    picture: np.ndarray
    motion: MotionField
    pose: FoundPose

    @property
    def nbytes(self) -> int:
        return self.picture.nbytes + self.motion.pixels.nbytes


class MovedPictures:
    """Rendered pictures of the middles of boxes around cells, and approximations of cells from these.

    Args:
        frame: The frame that is searched.
        field: Returns the picture's motion over a box.
        look: Returns the picture's tiles at parameters of the frame, and the pose with its outliers.
    """

    def __init__(
        self,
        frame: Frame,
        field: Callable[[ParameterBox], MotionField],
        look: Callable[[Float64Array], tuple[np.ndarray, FoundPose]],
    ) -> None:
        self._frame, self._field, self._look = frame, field, look
        self._boxes = EnclosingBoxes(frame.box, frame.motion, self._draw)

    def near(self, box: ParameterBox) -> tuple[np.ndarray, FoundPose] | None:
        """Return approximate tiles at the middle of ``box``, and the pose that was rendered.

        None: ``box`` reaches beyond the set.
        """
        drawn = self._boxes.around(box)
        if drawn is None:
            return None
        camera, half = self._frame.camera, 0.5 * (np.array(drawn.box.upper) - drawn.box.lower)
        motion = drawn.motion.at((box.middle - drawn.box.middle) / half, camera.height, camera.width)
        return in_tiles(moved(drawn.picture, motion), self._frame.side), drawn.pose

    def _draw(self, box: ParameterBox) -> _Drawn:
        tiles, pose = self._look(box.middle)
        return _Drawn(box, assemble(tiles, self._frame.camera), self._field(box), pose)
