"""What a pose shows, about: the picture of a pose near it, moved (docs/dev/design.md, U8).

Pixels of a wide cell are chosen by the picture in its middle. One picture, drawn once, serves all cells nearby. It
decides nothing but which pixels are bounded.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ns_abstract.geometry.box import Float64Array, ParameterBox
from ns_abstract.geometry.enclosing_boxes import box_of_motion
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
class MovedPictureTuning:
    """Preferences about the pictures. None of them decides whether a bound holds."""

    #: Pixels that a picture moves by along each parameter, about, between the poses that share one.
    motion: float = 2.0
    #: Most bytes that are kept.
    most: int = 1 << 27


@dataclass(frozen=True)
class _Kept:
    """The picture [H, W, c] of the middle of a box, how it moves over the box, and what it misses of the photo."""

    picture: np.ndarray
    motion: MotionField
    pose: FoundPose

    @property
    def nbytes(self) -> int:
        return self.picture.nbytes + self.motion.pixels.nbytes


class MovedPictures:
    """Pictures of the middles of boxes by which a set is divided evenly; the latest are kept.

    Args:
        frame: What is searched.
        field: Tells how the picture moves over a box.
        motion: [d] pixels that the picture moves by over each parameter's range.
        look: Tells the picture's tiles at parameters of the frame, and what they miss of the photo.
    """

    def __init__(
        self,
        frame: Frame,
        field: Callable[[ParameterBox], MotionField],
        motion: Float64Array,
        look: Callable[[Float64Array], tuple[np.ndarray, FoundPose]],
    ) -> None:
        self._frame, self._field, self._motion, self._look = frame, field, motion, look
        self._tuning = MovedPictureTuning()
        self._kept: dict[ParameterBox, _Kept] = {}

    def near(self, box: ParameterBox) -> tuple[np.ndarray, FoundPose] | None:
        """About what the middle of ``box`` shows, in tiles, and the pose that was rendered.

        None: ``box`` reaches beyond the set.
        """
        camera = self._frame.camera
        around = box_of_motion(box, self._frame.box, self._motion, self._tuning.motion)
        if around is None:
            return None
        kept = self._kept.pop(around, None)
        if kept is None:
            tiles, pose = self._look(around.middle)
            kept = _Kept(assemble(tiles, camera), self._field(around), pose)
        self._kept[around] = kept
        while len(self._kept) > 1 and sum(one.nbytes for one in self._kept.values()) > self._tuning.most:
            del self._kept[next(iter(self._kept))]
        half = 0.5 * (np.array(around.upper) - around.lower)
        motion = kept.motion.at((box.middle - around.middle) / half, camera.height, camera.width)
        return in_tiles(moved(kept.picture, motion), self._frame.side), kept.pose
