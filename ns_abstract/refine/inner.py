"""The inner bound of a refinement: extremes of rendered pictures of the set."""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.refine.box_splitter import SubBox
from ns_abstract.refine.frame_tiles import FrameTiles, LeafCell, pixels_inside, usable
from ns_abstract.refine.protocol import COLORS, DEPTH, Frame, Render
from ns_abstract.refine.result import SampleImages, gap
from ns_abstract.refine.tuning import TUNING, Tuning


class InnerBound:
    """Least and largest values of rendered pictures of the set.

    Args:
        scenes: Where the scene varies too: other scenes of the set, each as a function like `Frame.render`.

    Attributes:
        lower, upper: [t, side, side, channels] float32.
        picture_seconds: Shortest time of a render, without the first one, which may compile kernels; 0: unknown.
    """

    def __init__(
        self, tiles: FrameTiles, random: np.random.Generator, scenes: Iterator[Render], tuning: Tuning = TUNING
    ) -> None:
        self.tiles, self.random, self.scenes, self.tuning = tiles, random, scenes, tuning
        self.lower, self.upper = tiles.filled(np.inf), tiles.filled(-np.inf)
        self.image = tiles.filled(0.0)
        self.picture_seconds = 0.0
        self._mean_gap: float | None = None
        self._views: list[tuple[np.ndarray, np.ndarray]] = []

    @property
    def mean_gap(self) -> float:
        """MPG of the inner bound."""
        if self._mean_gap is None:
            self._mean_gap = self.tiles.mean_gap(self.lower, self.upper)
        return self._mean_gap

    def observed(self) -> None:
        """Report a change of the bound to the frame."""
        self._mean_gap = None
        self.tiles.frame.observe(self.tiles.numbers(None), self.lower, self.upper)

    def render(self, values: np.ndarray, places: np.ndarray | None = None) -> np.ndarray:
        """Render the pose at ``values``, and some other scenes there; return the picture of the tiles ``places``."""
        begin = time.perf_counter()
        picture = self.tiles.render(self.tiles.frame.render, values, places)
        if places is None:
            self.picture_seconds = min(self.picture_seconds or math.inf, time.perf_counter() - begin)
        self._widen(picture, places)
        for render in itertools.islice(self.scenes, self.tuning.scene_samples_by_pose):
            self._widen(self.tiles.render(render, values, places), places)
        return picture

    def render_middle(self) -> None:
        """Render the pose in the middle of the set, which becomes `image`."""
        self.image = self.render(self.tiles.frame.box.middle)
        self.picture_seconds = 0.0

    def render_scenes(self, over: Callable[[], bool]) -> None:
        """Render other scenes of the set at its middle, until ``over`` returns True."""
        for render in itertools.islice(self.scenes, self.tuning.scene_samples):
            self._widen(self.tiles.render(render, self.tiles.frame.box.middle, None), None)
            if over():
                break

    def render_all(self, poses: Iterator[np.ndarray] | np.ndarray, over: Callable[[], bool]) -> None:
        """Render poses [n, d], until ``over`` returns True."""
        for values in poses:
            self.render(values)
            if over():
                break

    def render_children(self, parent: LeafCell, children: Sequence[LeafCell], places: np.ndarray) -> None:
        """Render sample poses in the parts of a split cell, in the tiles ``places``, and widen the inner bound."""
        if parent.box.dimensions > 1:
            if children:
                # one of them: the first corners have shown most of what there is to see
                child = children[int(self.random.integers(len(children)))]
                self.render(self.outlying(child.part), places)
            return
        steps = self.tiles.frame.witnesses
        for number in range(1, steps * len(children)):
            child, step = children[(number - 1) // steps], (number - 1) % steps + 1
            end = np.array(child.box.upper)
            self.render(end if step == steps else child.box.at(np.array([2.0 * step / steps - 1.0])), places)

    def outlying(self, part: SubBox) -> np.ndarray:
        """Return the point [d] of ``part`` farthest out in the set, where pixels are likely to be extreme.

        Where the part spans the set along an axis, one end is chosen at random.
        """
        box = part.box
        last = part.last & (~part.first | (self.random.random(box.dimensions) < 0.5))
        return np.where(last, box.upper, np.where(part.first, box.lower, box.middle))

    def corners(self) -> np.ndarray:
        """Return the corners of the set [n, d] to render, a sample where there are many."""
        return _some_corners(self.tiles.frame.box, self.random, self.tuning.most_corners)

    def beyond(self, part: SubBox, lower: np.ndarray, upper: np.ndarray, places: np.ndarray | None = None) -> float:
        """Return the MPG of bounds of ``part`` beyond that of renders at its two ends and at the middle of the set.

        The bounds are those of the tiles at ``places``; None: all.
        """
        low = high = self.image if places is None else self.image[places]
        for end in (part.box.lower, part.box.upper):
            picture = self.render(np.array(end), places)
            low, high = np.minimum(low, picture), np.maximum(high, picture)
        return self.tiles.mean_gap(*usable(lower, upper), places) - self.tiles.mean_gap(low, high, places)

    def look_around(self, stopped: Callable[[], bool]) -> None:
        """Render poses across the set, to be shown beside linear sets."""
        for values in self._across():
            if stopped():
                return
            self._views.append((values, self.render(values)))

    def _across(self) -> Iterator[np.ndarray]:
        """Yield poses [d] across the set: evenly along one parameter, or along each axis of several."""
        box = self.tiles.frame.box
        count = self.tuning.views if box.dimensions == 1 else self.tuning.axis_views + 1
        for axis in range(box.dimensions):
            for step in np.linspace(-1.0, 1.0, count):
                # the middle of several belongs to all axes
                if step or not axis:
                    yield box.at(np.where(np.arange(box.dimensions) == axis, step, 0.0))

    @property
    def views(self) -> SampleImages:
        """The pictures of `look_around`."""
        values = [values for values, _ in self._views]
        images = [picture[..., :COLORS] for _, picture in self._views]
        whole = np.stack(images) if images else np.zeros((0, *self.image.shape[:-1], COLORS), np.float32)
        return SampleImages(np.array(values, np.float64).reshape(len(values), self.tiles.frame.box.dimensions), whole)

    def _widen(self, picture: np.ndarray, places: np.ndarray | None) -> None:
        which = slice(None) if places is None else places
        low, high = self.lower[which], self.upper[which]
        least, most = np.minimum(low, picture), np.maximum(high, picture)
        # no number: nothing is drawn there
        least[..., DEPTH:], most[..., DEPTH:] = (
            np.fmin(low[..., DEPTH:], picture[..., DEPTH:]), np.fmax(high[..., DEPTH:], picture[..., DEPTH:])
        )  # fmt: skip
        self.lower[which], self.upper[which] = least, most
        self.observed()


def sampled_gap(frame: Frame, index: int, seed: int, tuning: Tuning = TUNING) -> float:
    """Return the MPG of renders at the middle and at two corners of the set: at most the inner bound's."""
    corners = _some_corners(frame.box, np.random.default_rng([seed, index]), tuning.most_corners)
    pictures = [frame.render(values) for values in (frame.box.middle, *corners[[0, -1]])]
    least, most = np.minimum.reduce(pictures), np.maximum.reduce(pictures)
    return float(gap(least[..., :COLORS], most[..., :COLORS])[pixels_inside(frame)].mean())


def _some_corners(box: ParameterBox, random: np.random.Generator, most_corners: int) -> np.ndarray:
    """Return corners of a set [n, d], at most ``most_corners`` of them, drawn at random."""
    if not box.dimensions:
        return np.empty((0, 0))
    corners = box.corners()
    if corners.shape[0] > most_corners:
        corners = corners[np.sort(random.choice(corners.shape[0], most_corners, replace=False))]
    return corners
