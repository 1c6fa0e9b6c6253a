"""Pictures of blending weights over small cells, from what is known of boxes around these (docs/dev/design.md, Q5).

Over a box most pixels are settled: whatever they are, the claim says the same. Cells inside bound and draw the other
pixels alone, with the elements that the box shows there.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.tiles import assemble, in_tiles
from ns_abstract.refine.protocol import Bounds, ElementFrame, Frame, SceneSample
from ns_abstract.verify.enclosing_boxes import enclosing_box
from ns_abstract.verify.protocol import FrameImages
from ns_abstract.verify.search_results import ContradictionError
from ns_abstract.verify.settled_pixels import LimitedMeasure, unsettled

#: Elements that enclosing boxes may show together, of those that are kept: a few hundred bytes each.
_KEPT = 1 << 20


@dataclass(frozen=True)
class DrawnElements:
    """What a box shows on the pixels of one frame that are not settled.

    Attributes:
        tiles: [t] numbers of the tiles that hold these pixels.
        pixels: [t, side, side] these pixels.
        draw: Tiles [t, side, side, 3] of the picture at parameter values [d]; right at these pixels alone.
    """

    tiles: np.ndarray
    pixels: np.ndarray
    context: Any
    draw: Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class KnownBox:
    """Bounds of all pictures over a box.

    Attributes:
        lower, upper: [H, W, C] float32.
        open: [H, W] bool, the pixels that are not settled.
        elements: By frame of weights; None: every pixel is settled.
    """

    lower: np.ndarray
    upper: np.ndarray
    open: np.ndarray
    elements: tuple[DrawnElements, ...] | None

    @property
    def size(self) -> int:
        """Elements that it shows."""
        return sum(len(one.context.shown) for one in self.elements or ())


#: Frames of weights, with the channels that their planes have in pictures.
Weights = Sequence[tuple[ElementFrame, Sequence[int]]]


class KnownBoxes:
    """What is known of boxes around cells (Q5).

    Args:
        weights: What bounds and draws them.
        wanted: [H, W] the pixels that are read.
    """

    def __init__(
        self, pictures: FrameImages, weights: Weights, wanted: np.ndarray, measures: Sequence[LimitedMeasure]
    ) -> None:
        self._pictures, self._weights, self._wanted, self._measures = pictures, weights, wanted, measures
        self._channels = [channel for _, some in weights for channel in some]
        self._known: OrderedDict[ParameterBox, KnownBox] = OrderedDict()
        frame = weights[0][0]
        motion = np.asarray(frame.motion(pictures.box), np.float64)
        self._motion = np.where(np.isfinite(motion), motion, np.inf)

    def near(self, cell: ParameterBox) -> NearbyPictures | None:
        """Pictures of a cell, by what is known of a box around it; None: that box would be too wide."""
        box_bounds = self._around(cell)
        return None if box_bounds is None else NearbyPictures(self._pictures, self._weights, box_bounds)

    def _around(self, cell: ParameterBox) -> KnownBox | None:
        box = enclosing_box(cell, self._pictures.box, self._motion)
        if box is None:
            return None
        if box not in self._known:
            outer = self._around(box)
            self._known[box] = self._examined(box, outer)
            while sum(one.size for one in self._known.values()) > _KEPT and len(self._known) > 1:
                self._known.popitem(last=False)
        self._known.move_to_end(box)
        return self._known[box]

    def _examined(self, box: ParameterBox, outer: KnownBox | None) -> KnownBox:
        """Bounds over a box, itself inside of one of which ``outer`` is known."""
        shape = (*self._wanted.shape, 1 + max(self._channels))
        lower, upper = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        wanted, elements = self._wanted, None
        if outer is not None:
            lower, upper, wanted, elements = outer.lower.copy(), outer.upper.copy(), outer.open, outer.elements
        if not wanted.any():
            return KnownBox(lower, upper, wanted, None)
        bounds_by_frame: list[Bounds] = []
        for k, (frame, channels) in enumerate(self._weights):
            pixels = in_tiles(wanted, frame.side)
            tiles = np.flatnonzero(pixels.any(axis=(1, 2)))
            context = None if elements is None else elements[k].context
            bounds = frame.bound_parts([box], tiles, context, False, pixels[tiles])[0]
            bounds_by_frame.append(bounds)
            place((lower, upper), (bounds.lower, bounds.upper), frame, tiles, channels, wanted)
        self._attack(box, lower, upper)
        still = unsettled(self._measures, lower, upper) & wanted
        if not still.any():
            return KnownBox(lower, upper, still, None)
        drawn_elements = []
        for (frame, _), bounds in zip(self._weights, bounds_by_frame, strict=True):
            pixels = in_tiles(still, frame.side)
            tiles = np.flatnonzero(pixels.any(axis=(1, 2)))
            draw = frame.drawn_alone(bounds.context, tiles, pixels[tiles])
            drawn_elements.append(DrawnElements(tiles, pixels[tiles], bounds.context, draw))
        return KnownBox(lower, upper, still, tuple(drawn_elements))

    def _attack(self, box: ParameterBox, lower: np.ndarray, upper: np.ndarray) -> None:
        """Draw the whole picture at the box's middle: what is settled is not drawn again for the cells inside.

        Raises:
            ContradictionError: It lies outside of the bounds.
        """
        image = self._pictures.image(box.middle)
        inside = (lower <= image) & (image <= upper)
        if not inside[self._wanted][:, self._channels].all():
            raise ContradictionError(
                f"internal error: a picture at {box.middle.tolist()} lies outside of its bounds over {box.lower} to "
                f"{box.upper}"
            )


class NearbyPictures:
    """Pictures [H, W, C] of cells inside of a box; see `ns_abstract.verify.protocol.FrameImages`.

    Args:
        weights: What bounds and draws them.
    """

    def __init__(self, pictures: FrameImages, weights: Weights, box_bounds: KnownBox) -> None:
        self._pictures, self._weights, self._known, self.box = pictures, weights, box_bounds, pictures.box

    def image(self, values: np.ndarray, member: SceneSample | None = None) -> np.ndarray:
        """Picture at a pose of the box: pixels that are settled are in the middle of their bounds."""
        assert member is None
        box_bounds = self._known
        image = 0.5 * (box_bounds.lower + box_bounds.upper)
        if box_bounds.elements is not None:
            for (frame, channels), shown in zip(self._weights, box_bounds.elements, strict=True):
                drawn = shown.draw(np.asarray(values, np.float64))
                place((image,), (drawn,), frame, shown.tiles, channels, box_bounds.open)
        return image

    def scene_samples(self, seed: int) -> Iterator[SceneSample]:
        """There are no other scenes."""
        return self._pictures.scene_samples(seed)

    def differentiable(self, values: torch.Tensor) -> torch.Tensor:
        """Picture at parameter values [d], every pixel as it is."""
        return self._pictures.differentiable(values)

    def sets(self, box: ParameterBox) -> tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray, np.ndarray]:
        """Sets over a cell: of settled pixels what holds over the box around it."""
        box_bounds, d = self._known, box.dimensions
        flat = [np.zeros((*box_bounds.lower.shape, d), np.float32) for _ in range(2)]
        lower, upper, slopes = box_bounds.lower.copy(), box_bounds.upper.copy(), np.zeros(d)
        linear = (flat[0], lower.copy(), flat[1], upper.copy())
        if box_bounds.elements is None:
            return linear, lower, upper, slopes
        for (frame, channels), shown in zip(self._weights, box_bounds.elements, strict=True):
            bounds = frame.bound_parts([box], shown.tiles, shown.context, True, shown.pixels)[0]
            place_sets((*linear, lower, upper), bounds, frame, shown.tiles, channels, box_bounds.open)
            slopes = slopes + bounds.slopes
        return linear, lower, upper, slopes


def place(
    wholes: Sequence[np.ndarray],
    parts: Sequence[np.ndarray],
    frame: Frame,
    tiles: np.ndarray,
    channels: Sequence[int],
    pixels: np.ndarray | None = None,
) -> None:
    """Write each of the parts, ``tiles`` [t, side, side, 3, ...], to some ``channels`` of its picture [H, W, C, ...].

    To the ``pixels`` [H, W] alone; all if None.
    """
    rows, columns = np.nonzero(np.ones((frame.camera.height, frame.camera.width), bool) if pixels is None else pixels)
    for whole, part in zip(wholes, parts, strict=True):
        every = np.zeros((frame.tile_count, *part.shape[1:]), np.float32)
        every[tiles] = part
        values = assemble(every, frame.camera)[rows, columns]
        for source, target in enumerate(channels):
            whole[rows, columns, target] = values[:, source]


def place_sets(
    wholes: Sequence[np.ndarray],
    bounds: Bounds,
    frame: Frame,
    tiles: np.ndarray,
    channels: Sequence[int],
    pixels: np.ndarray | None = None,
) -> None:
    """`place` for the four arrays of a picture's linear bounds, its lower and its upper bounds."""
    assert bounds.linear is not None
    place(wholes, (*bounds.linear, bounds.lower, bounds.upper), frame, tiles, channels, pixels)
