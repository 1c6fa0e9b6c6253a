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
from ns_abstract.geometry.enclosing_boxes import enclosing_box, shared_box
from ns_abstract.geometry.tiles import assemble, in_tiles
from ns_abstract.io.errors import InputError
from ns_abstract.refine.protocol import Bounds, ElementFrame, Frame, SceneSample
from ns_abstract.verify.picture_measures import SubBoxEnds, shared_counts
from ns_abstract.verify.picture_sets import PictureSets
from ns_abstract.verify.protocol import FrameImages, PixelSets
from ns_abstract.verify.search_results import FAILURES, ContradictionError
from ns_abstract.verify.settled_pixels import LimitedMeasure, unsettled


@dataclass(frozen=True)
class NearbyTuning:
    """What is kept of enclosing boxes, and what cuts are chosen by. None of it decides whether a bound holds."""

    #: Bytes of enclosing boxes, and elements of those that pictures were drawn in, about 200 bytes each.
    memory: int = 1 << 27
    drawn: int = 1 << 18
    #: Pixels at which cuts of a cell are compared. Measured at the plant's pot in the middle.
    compared: int = 6


_TUNING = NearbyTuning()


@dataclass(frozen=True)
class DrawnElements:
    """What a box shows on the ``pixels`` [t, side, side] of one frame that are not settled.

    ``tiles`` [t] are numbers of the tiles that hold them; ``context`` of the box is for bounds of cells inside.
    """

    tiles: np.ndarray
    pixels: np.ndarray
    context: Any


@dataclass(frozen=True)
class KnownBox:
    """Bounds ``lower``, ``upper`` [H, W, C] float32 of all pictures over a box.

    ``open`` [H, W] are the pixels that are not settled; ``elements`` by frame of weights; None: every pixel is settled.
    """

    lower: np.ndarray
    upper: np.ndarray
    open: np.ndarray
    elements: tuple[DrawnElements, ...] | None

    @property
    def nbytes(self) -> int:
        """Memory that it holds, without what draws pictures."""
        drawn = sum(one.context.nbytes + one.pixels.nbytes for one in self.elements or ())
        return self.lower.nbytes + self.upper.nbytes + self.open.nbytes + drawn


#: Tiles [t, side, side, 3] of a picture at parameter values [d]; right at the pixels that are not settled alone.
Draw = Callable[[np.ndarray], np.ndarray]
#: Frames of weights, with the channels that their planes have in pictures.
Weights = Sequence[tuple[ElementFrame, Sequence[int]]]


class KnownBoxes:
    """What is known of boxes around cells (Q5).

    ``pictures`` are blending weights alone, which ``weights`` bounds and draws; ``wanted`` [H, W] are the pixels that
    are read; ``measures`` all that the claim reads of them.
    """

    def __init__(
        self, pictures: FrameImages, weights: Weights, wanted: np.ndarray, measures: Sequence[LimitedMeasure]
    ) -> None:
        self._pictures, self._weights, self._wanted, self._measures = pictures, weights, wanted, measures
        self._channels = [channel for _, some in weights for channel in some]
        self._known: OrderedDict[ParameterBox, KnownBox] = OrderedDict()
        self._draws: OrderedDict[ParameterBox, tuple[int, tuple[Draw, ...]]] = OrderedDict()
        frame = weights[0][0]
        motion = np.asarray(frame.motion(pictures.box), np.float64)
        self._motion = np.where(np.isfinite(motion), motion, np.inf)

    def near(self, cell: ParameterBox) -> NearbyPictures | None:
        """Return pictures of a cell, by what is known of a box around it; None: that box would be too wide."""
        box = enclosing_box(cell, self._pictures.box, self._motion)
        if box is None:
            return None
        return self._inside(box, self._about(box))

    def _inside(self, box: ParameterBox, box_bounds: KnownBox) -> NearbyPictures:
        """Return pictures of cells inside ``box``, built on its known bounds and on draws of its unsettled pixels."""
        draws = self._drawn(box, box_bounds)
        return NearbyPictures(self._pictures, self._weights, box_bounds, draws, self._measures, self._motion)

    def _about(self, box: ParameterBox) -> KnownBox:
        """Return the known bounds of ``box``, from those of its shared box, if any; cached within `_TUNING.memory`."""
        if box not in self._known:
            around = shared_box(box, self._pictures.box, self._motion)
            if around is None:
                self._known[box] = self._examined(box, None, self._pictures)
            else:
                outer = self._about(around)
                self._known[box] = self._examined(box, outer, self._inside(around, outer))
            while (
                sum(box_bounds.nbytes for box_bounds in self._known.values()) > _TUNING.memory and len(self._known) > 1
            ):
                self._known.popitem(last=False)
        self._known.move_to_end(box)
        return self._known[box]

    def _drawn(self, box: ParameterBox, box_bounds: KnownBox) -> tuple[Draw, ...]:
        """By frame of weights, a `Draw` of the unsettled pixels of ``box``; the latest boxes are cached."""
        if box not in self._draws:
            pairs = list(zip(self._weights, box_bounds.elements or (), strict=False))
            draws = tuple(frame.drawn_alone(one.context, one.tiles, one.pixels) for (frame, _), one in pairs)
            self._draws[box] = sum(len(one.context.shown) for _, one in pairs), draws
            while sum(count for count, _ in self._draws.values()) > _TUNING.drawn and len(self._draws) > 1:
                self._draws.popitem(last=False)
        self._draws.move_to_end(box)
        return self._draws[box][1]

    def _examined(self, box: ParameterBox, outer: KnownBox | None, pictures: FrameImages) -> KnownBox:
        """Return bounds over a box, itself inside of one of which ``outer`` is known, with the ``pictures`` there."""
        shape = (*self._wanted.shape, 1 + max(self._channels))
        lower, upper = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        asked, elements = self._wanted, None
        if outer is not None:
            lower, upper, asked, elements = outer.lower.copy(), outer.upper.copy(), outer.open, outer.elements
        if not asked.any():
            return KnownBox(lower, upper, asked, None)
        bounds_by_frame: list[Bounds] = []
        for k, (frame, channels) in enumerate(self._weights):
            pixels = in_tiles(asked, frame.side)
            tiles = np.flatnonzero(pixels.any(axis=(1, 2)))
            context = None if elements is None else elements[k].context
            bounds = frame.bound_parts([box], tiles, context, False, pixels[tiles])[0]
            bounds_by_frame.append(bounds)
            place((lower, upper), (bounds.lower, bounds.upper), frame, tiles, channels, asked)
        self._attack(box, lower, upper, asked, pictures)
        still = unsettled(self._measures, lower, upper) & asked
        if not still.any():
            return KnownBox(lower, upper, still, None)
        drawn_elements = []
        for (frame, _), bounds in zip(self._weights, bounds_by_frame, strict=True):
            pixels = in_tiles(still, frame.side)
            tiles = np.flatnonzero(pixels.any(axis=(1, 2)))
            drawn_elements.append(DrawnElements(tiles, pixels[tiles], bounds.context))
        return KnownBox(lower, upper, still, tuple(drawn_elements))

    def _attack(
        self, box: ParameterBox, lower: np.ndarray, upper: np.ndarray, bounded: np.ndarray, pictures: FrameImages
    ) -> None:
        """Draw the ``bounded`` pixels [H, W] at the box's middle: what is settled is not drawn for the cells inside.

        Raises:
            ContradictionError: One lies outside of its bounds.
        """
        image = pictures.image(box.middle)
        inside = (lower <= image) & (image <= upper)
        if not inside[bounded][:, self._channels].all():
            raise ContradictionError(
                f"internal error: a picture at {box.middle.tolist()} lies outside of its bounds over {box.lower} to "
                f"{box.upper}"
            )


class NearbyPictures:
    """Pictures [H, W, C] of cells inside of a box; see `ns_abstract.verify.protocol.FrameImages`.

    Arguments as of `KnownBoxes`; ``box_bounds`` is what is known of the box, ``draws`` by frame what draws the pixels
    that are not settled; empty where there are none. ``motion`` [d] are the pixels that the picture moves by over the
    set.
    """

    def __init__(
        self,
        pictures: FrameImages,
        weights: Weights,
        box_bounds: KnownBox,
        draws: Sequence[Draw],
        measures: Sequence[LimitedMeasure],
        motion: np.ndarray,
    ) -> None:
        self._pictures, self._weights, self._known, self.box = pictures, weights, box_bounds, pictures.box
        self._draws, self._measures, self._motion = draws, measures, motion

    def image(self, values: np.ndarray, scene_sample: SceneSample | None = None) -> np.ndarray:
        """Return the picture at a pose of the box: pixels that are settled are in the middle of their bounds."""
        assert scene_sample is None
        box_bounds = self._known
        image = 0.5 * (box_bounds.lower + box_bounds.upper)
        if box_bounds.elements is not None:
            for (frame, channels), elements, draw in zip(self._weights, box_bounds.elements, self._draws, strict=True):
                drawn = draw(np.asarray(values, np.float64))
                place((image,), (drawn,), frame, elements.tiles, channels, box_bounds.open)
        return image

    def scene_samples(self, seed: int) -> Iterator[SceneSample]:
        """Yield nothing: the scene does not vary."""
        return self._pictures.scene_samples(seed)

    def differentiable(self, values: torch.Tensor) -> torch.Tensor:
        """Return the picture at parameter values [d], every pixel as it is."""
        return self._pictures.differentiable(values)

    def linear_sets(self, box: ParameterBox) -> PixelSets:
        """Sets over a cell: of settled pixels what holds over the box around it."""
        return self._sets(box, None)[0]

    def sub_box_counts(self, box: ParameterBox, most: int) -> np.ndarray | None:
        """Return the numbers of sub-boxes along each parameter; None where a claim needs more than a pixel's side."""
        if self._known.elements is None or not all(one.counts for one in self._measures):
            return None
        whole = self.box
        widths = [
            (past - first) / (high - low) if high > low else 0.0
            for first, past, low, high in zip(box.lower, box.upper, whole.lower, whole.upper, strict=True)
        ]
        return shared_counts(self._motion * np.array(widths), most)

    def divided_sets(self, box: ParameterBox, counts: np.ndarray) -> tuple[PixelSets, SubBoxEnds | None]:
        """Return linear sets of a cell, and bounds of deciding pixels over ``counts`` [d] sub-boxes, or None (Q8)."""
        return self._sets(box, counts)

    def _sets(self, box: ParameterBox, counts: np.ndarray | None) -> tuple[PixelSets, SubBoxEnds | None]:
        """Return linear sets over a cell, and bounds of unsettled pixels over ``counts`` [d] sub-boxes, or None."""
        box_bounds, d = self._known, box.dimensions
        flat = [np.zeros((*box_bounds.lower.shape, d), np.float32) for _ in range(2)]
        lower, upper, slopes = box_bounds.lower.copy(), box_bounds.upper.copy(), np.zeros(d)
        linear = (flat[0], lower.copy(), flat[1], upper.copy())
        if box_bounds.elements is None:
            return (linear, lower, upper, slopes), None
        ends = None if counts is None else self._no_ends(counts)
        for (frame, channels), elements in zip(self._weights, box_bounds.elements, strict=True):
            context, pixels = elements.context, elements.pixels
            if ends is None:
                bounds = frame.bound_parts([box], elements.tiles, context, True, pixels)[0]
            else:
                levels = [limit for one in self._measures for limit in one.limits]
                bounds, by_box = frame.bound_sub_boxes(box, elements.tiles, context, pixels, ends.counts, levels)
                places = in_tiles(np.cumsum(box_bounds.open).reshape(box_bounds.open.shape) - 1, frame.side)
                for whole, part in zip((ends.lower, ends.upper), by_box, strict=True):
                    for source, target in enumerate(channels):
                        whole[:, places[elements.tiles][pixels], target] = part[:, source].T
            place_sets((*linear, lower, upper), bounds, frame, elements.tiles, channels, box_bounds.open)
            slopes = slopes + bounds.slopes
        return (linear, lower, upper, slopes), ends

    def narrowed(self, ends: SubBoxEnds, sub_boxes: np.ndarray) -> NearbyPictures:
        """Pictures of what some ``sub_boxes`` [counts] of a cell cover, by bounds ``ends`` over all of them (Q9).

        They are for bounds alone: none can be drawn.
        """
        box_bounds, chosen = self._known, sub_boxes.ravel()
        lower, upper = box_bounds.lower.copy(), box_bounds.upper.copy()
        shape = lower.shape[-1]
        flat = lower.reshape(-1, shape), upper.reshape(-1, shape)
        least, most = ends.lower[chosen].min(axis=0), ends.upper[chosen].max(axis=0)
        # ends that cross or are no numbers bound nothing
        sane = (ends.lower[chosen] <= ends.upper[chosen]).all(axis=0)
        pixels = ends.pixels
        flat[0][pixels] = np.where(sane, np.maximum(flat[0][pixels], least), flat[0][pixels])
        flat[1][pixels] = np.where(sane, np.minimum(flat[1][pixels], most), flat[1][pixels])
        still = unsettled(self._measures, lower, upper) & box_bounds.open
        if box_bounds.elements is None or not still.any():
            return self
        elements = []
        for (frame, _), one in zip(self._weights, box_bounds.elements, strict=True):
            whole = in_tiles(still, frame.side)
            tiles = np.flatnonzero(whole.any(axis=(1, 2)))
            elements.append(DrawnElements(tiles, whole[tiles], one.context))
        narrower = KnownBox(lower, upper, still, tuple(elements))
        return NearbyPictures(self._pictures, self._weights, narrower, (), self._measures, self._motion)

    def _no_ends(self, counts: np.ndarray) -> SubBoxEnds:
        """Return ends over ``counts`` [d] sub-boxes of the pixels that are not settled, all zeros."""
        pixels = np.flatnonzero(self._known.open)
        shape = int(counts.prod()), pixels.size, self._known.lower.shape[-1]
        return SubBoxEnds(counts, pixels, np.zeros(shape), np.zeros(shape))

    def cut_gains(self, box: ParameterBox) -> np.ndarray:
        """Return [d] estimates of how much sets of pixels narrow where a cell is cut to nothing along an axis (Q7).

        Slopes do not tell: sets follow them, and are as wide as pictures may be off these. Twice what the middle half
        of the cell is narrower, at a few of the pixels that are not settled. Zeros where nothing is to be compared.
        """
        if self._known.elements is None or box.dimensions < 2:
            return np.zeros(box.dimensions)
        quarters = [box.split(axis, 4) for axis in range(box.dimensions)]
        halves = [box.replace(k, part[1].lower[k], part[2].upper[k]) for k, part in enumerate(quarters)]
        try:
            widths = [self._compared_width(part) for part in (box, *halves)]
        except InputError:
            raise
        except FAILURES:
            # they stop the cell's own bounds, too
            return np.zeros(box.dimensions)
        return 2.0 * np.maximum(0.0, widths[0] - np.array(widths[1:]))

    def _compared_width(self, box: ParameterBox) -> float:
        """Return the width of the linear sets of a cell at a pose, a mean over pixels by frame."""
        box_bounds, width = self._known, 0.0
        assert box_bounds.elements is not None
        places = np.flatnonzero(box_bounds.open)
        compared = np.zeros(box_bounds.open.shape, bool)
        compared.flat[places[:: -(-places.size // _TUNING.compared)]] = True
        for (frame, channels), elements in zip(self._weights, box_bounds.elements, strict=True):
            pixels = in_tiles(compared, frame.side)[elements.tiles]
            some = pixels.any(axis=(1, 2))
            tiles, pixels = elements.tiles[some], pixels[some]
            (bounds,) = frame.bound_parts([box], tiles, elements.context, True, pixels)
            assert bounds.linear is not None
            sets = PictureSets(box, bounds.linear, bounds.lower, bounds.upper)
            width += float(sets.widths[pixels][:, : len(channels)].mean())
        return width


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
    """Write the tiles of a picture's linear bounds, and of its lower and upper bounds, into whole pictures."""
    assert bounds.linear is not None
    place(wholes, (*bounds.linear, bounds.lower, bounds.upper), frame, tiles, channels, pixels)
