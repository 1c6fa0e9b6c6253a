"""Which pixels rule out which image motions: tables that many cells of poses share (docs/dev/design.md, U6).

The pixels of a small block see two or three numbers of a pose: how far the content of the block moves, and by how much
near and far things part. So each block is bounded once over parts of parameters that are sheared for it, and a cell of
poses is judged by the parts that it meets, block by block.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ns_abstract.arithmetic.rounding import PART_OVERLAP, POSE_ROUNDING
from ns_abstract.geometry.box import Float64Array, ParameterBox
from ns_abstract.refine.protocol import Frame, SubBoxFrame
from ns_abstract.verify.cell_boxes import resolved
from ns_abstract.verify.photo import TiledPhoto

#: Side of a block in pixels: its pixels are the bits of a word.
BLOCK = 8
#: Set bits of every 16-bit number.
_BITS = np.array([bin(number).count("1") for number in range(1 << 16)], np.uint8)
_NONE, _ALL = np.uint64(0), np.uint64(2**64 - 1)


@dataclass(frozen=True)
class MotionTuning:
    """Preferences of the tables. None of them decides whether an excluded cell holds no pose of the photo."""

    #: Parts that are bounded together: along each of the two axes that move a block most, and along each other one.
    along: int = 8
    across: int = 2
    #: Values that the photo must miss by, somewhere near, for a pixel to be bounded.
    missed: float = 0.02


def pixel_count(words: np.ndarray) -> np.ndarray:
    """Numbers of set bits of ``words`` [...] uint64."""
    return _BITS[np.ascontiguousarray(words).view(np.uint16).reshape(*words.shape, 4)].sum(axis=-1, dtype=np.int64)


@dataclass(frozen=True)
class _Grid:
    """Parts of a block's parameters at one level: ``counts`` [d], ``together`` [d] of which are bounded at once."""

    counts: np.ndarray
    together: np.ndarray

    @property
    def groups(self) -> np.ndarray:
        """[d] numbers of groups along the axes."""
        return self.counts // self.together


@dataclass
class _Block:
    """One block: its frame, its pixels, and what is known of its parts.

    Attributes:
        frame: Bounds over the block's own parameters.
        tile: Number of its tile.
        pixels: [side, side] counted pixels of the block.
        slopes, sizes: [d, d] the block's parameters from those of the search, and absolute terms of these sums.
        words: By level and group: [together] uint64, the pixels that each part excludes.
        contexts: By level and group.
        ruled_out: Pixels that it excluded by sub-box on average, lately.
    """

    frame: SubBoxFrame
    tile: int
    pixels: np.ndarray
    slopes: Float64Array
    sizes: Float64Array
    words: dict[tuple[int, ...], np.ndarray] = field(default_factory=dict)
    contexts: dict[tuple[int, ...], object] = field(default_factory=dict)
    grids: dict[int, _Grid] = field(default_factory=dict)
    ruled_out: float = math.inf

    @cached_property
    def moved(self) -> Float64Array:
        """[d] pixels that the block's content moves by along each of its parameters."""
        return np.nan_to_num(np.asarray(self.frame.motion(self.frame.box), np.float64), nan=0.0, posinf=0.0)

    def grid(self, level: int, tuning: MotionTuning) -> _Grid:
        """Parts over which the content moves by about 2^-level pixels along every axis."""
        if level not in self.grids:
            exponents = np.ceil(np.log2(np.maximum(self.moved, 1e-9)) + level).clip(0, 20).astype(int)
            counts = 1 << exponents
            limit = np.full(counts.size, tuning.across)
            limit[np.argsort(-self.moved, kind="stable")[:2]] = tuning.along
            together = np.minimum(counts, limit)
            while together.prod() < 8:
                axis = int(np.argmax(self.moved / counts))
                counts[axis] *= 2
                together[axis] *= 2
            self.grids[level] = _Grid(counts, together)
        return self.grids[level]

    def box(self, grid: _Grid, group: np.ndarray) -> ParameterBox:
        """The parameters of a group of parts; neighbours share their ends."""
        whole = self.frame.box
        low, width = np.array(whole.lower), np.array(whole.upper) - np.array(whole.lower)
        first, last = low + width * (group / grid.groups), low + width * ((group + 1) / grid.groups)
        last = np.where(group + 1 == grid.groups, whole.upper, last)
        return ParameterBox(whole.names, whole.units, tuple(first.tolist()), tuple(last.tolist()))


class ImageMotion:
    """Numbers of pixels that rule out sub-boxes of cells, from tables of blocks.

    Args:
        frame: What is searched.
        plain: The same set in its own parameters.
        photo: The photo.
        tuning: Preferences.
    """

    def __init__(self, frame: SubBoxFrame, plain: Frame, photo: TiledPhoto, tuning: MotionTuning | None = None) -> None:
        self.frame, self.plain, self.photo, self.tuning = frame, plain, photo, tuning or MotionTuning()
        self.blocks = list(self._blocks())
        #: Groups that were bounded.
        self.bounded = 0

    def _blocks(self) -> Iterator[_Block]:
        frame, side = self.frame, self.frame.side
        for tile in range(frame.tile_count):
            for y, x in itertools.product(range(0, side, BLOCK), repeat=2):
                pixels = np.zeros((side, side), bool)
                pixels[y : y + BLOCK, x : x + BLOCK] = self.photo.counted[tile, y : y + BLOCK, x : x + BLOCK]
                if not pixels.any():
                    continue
                left, top = tile % frame.across * side + x, tile // frame.across * side + y
                local = frame.local((float(left), float(left + BLOCK), float(top), float(top + BLOCK)))
                if local is not None:
                    yield _Block(local, tile, pixels, *relation(frame, local))

    def outliers(self, box: ParameterBox, counts: np.ndarray, level: int) -> np.ndarray:
        """[counts] pixels, at least, that no pose of each of a cell's equal sub-boxes explains.

        Args:
            box: The cell.
            counts: [d] sub-boxes along its axes.
            level: Parts of blocks move by 2^-level pixels.
        """
        number = np.zeros(int(counts.prod()), np.int64)
        lines = [np.linspace(a, b, n + 1) for a, b, n in zip(box.lower, box.upper, counts.tolist(), strict=True)]
        grid = np.meshgrid(*(0.5 * (line[1:] + line[:-1]) for line in lines), indexing="ij")
        middle = np.stack([part.ravel() for part in grid])
        half = np.array([0.5 * (line[1] - line[0]) for line in lines])
        size = np.maximum(np.abs(box.lower), np.abs(box.upper))
        for block in sorted(self.blocks, key=lambda block: -block.ruled_out):
            left = np.flatnonzero(number <= self.photo.allowed)
            if not left.size:
                break
            place = block.slopes @ middle[:, left]
            reach, room = np.abs(block.slopes) @ half, POSE_ROUNDING * (block.sizes @ size)
            ruled_out = self._ruled_out(block, place, reach, room, level)
            number[left] += ruled_out
            known = 0.0 if math.isinf(block.ruled_out) else block.ruled_out
            block.ruled_out = 0.5 * (known + float(ruled_out.mean()))
        return number.reshape(counts)

    def _ruled_out(
        self, block: _Block, place: np.ndarray, reach: np.ndarray, room: np.ndarray, level: int
    ) -> np.ndarray:
        """[k] pixels of a block that rule out boxes about ``place`` [d, k] of half-widths ``reach`` [d].

        Ends of the boxes are rounded by ``room`` [d] at most.
        """
        grid = block.grid(level, self.tuning)
        whole = block.frame.box
        low, width = np.array(whole.lower)[:, None], (np.array(whole.upper) - np.array(whole.lower))[:, None]
        scale = grid.counts[:, None] / width
        top = grid.counts[:, None] - 1
        # parts overlap: what reaches beyond a line by no more than that is in the part before it, too
        overlap = np.where(room[:, None] * scale <= PART_OVERLAP, PART_OVERLAP, -room[:, None] * scale)
        # what lies beyond the parts is no pose of the set
        first = np.floor((place - reach[:, None] - low) * scale + overlap).clip(0, top).astype(np.int64)
        last = (np.ceil((place + reach[:, None] - low) * scale - overlap) - 1.0).clip(first, top).astype(np.int64)
        window = (last - first).max(axis=1) + 1
        last = np.minimum(first + window[:, None] - 1, top)
        start, stop = first.min(axis=1), last.max(axis=1) + 1
        words = self._gathered(block, level, grid, first, last, start, stop)
        for axis, count in enumerate(window.tolist()):
            # beyond the end there are no parts
            words = _windows(words, axis, count)
        return pixel_count(words[tuple(first - start[:, None])])

    def _gathered(
        self, block: _Block, level: int, grid: _Grid, first: np.ndarray, last: np.ndarray, start: np.ndarray,
        stop: np.ndarray,
    ) -> np.ndarray:  # fmt: skip
        """Words of the parts from ``start`` to ``stop`` [d]; none where no box [first, last] [d, k] meets a group."""
        words = np.full(stop - start, _NONE)
        ends = np.stack([first, last]) // grid.together[:, None]
        met = set()
        wide = (ends[0] != ends[1]).any(axis=1)
        for corner in itertools.product(*((0, 1) if some else (0,) for some in wide.tolist())):
            chosen = ends[list(corner), np.arange(len(corner))]
            met.update(np.unique(np.ravel_multi_index(tuple(chosen), tuple(grid.groups))).tolist())
        for number in sorted(met):
            group = np.array(np.unravel_index(number, tuple(grid.groups)))
            inside, there = [], []
            for k, at in enumerate(group.tolist()):
                begin = at * int(grid.together[k])
                a, b = max(begin, int(start[k])), min(begin + int(grid.together[k]), int(stop[k]))
                inside.append(slice(a - begin, b - begin))
                there.append(slice(a - int(start[k]), b - int(start[k])))
            words[tuple(there)] = self._group(block, level, grid, group)[tuple(inside)]
        return words

    def _group(self, block: _Block, level: int, grid: _Grid, group: np.ndarray) -> np.ndarray:
        """[together] uint64 words of a group of parts; kept."""
        key = (level, *group.tolist())
        if key not in block.words:
            box = block.box(grid, group)
            feasible = block.frame.feasible(box)
            if feasible is None:
                # holds no pose: every pixel rules it out
                block.words[key] = np.full(grid.together, _ALL)
            else:
                block.words[key] = self._bounded(block, level, grid, group, box, feasible)
        return block.words[key]

    def _bounded(
        self, block: _Block, level: int, grid: _Grid, group: np.ndarray, box: ParameterBox, feasible: ParameterBox
    ) -> np.ndarray:
        """Words of a group of parts, from bounds over them."""
        pixels = block.pixels & self._useful(block, level, feasible)
        words = np.full(int(grid.together.prod()), _NONE)
        if not pixels.any() or not resolved(box, grid.together):
            return words.reshape(grid.together)
        self.bounded += 1
        tiles = np.array([block.tile])
        lower, upper, context = block.frame.sub_box_ends(
            box, grid.together, tiles, pixels[None], self._context(block, level, group, grid)
        )
        block.contexts[level, *group.tolist()] = context
        everywhere = np.zeros((self.frame.tile_count, *pixels.shape), bool)
        everywhere[block.tile] = pixels
        excluded = self.photo.excluded(lower, upper, everywhere)
        places = np.flatnonzero(block.pixels.ravel())
        for row, pixel in zip(excluded, np.flatnonzero(pixels.ravel()).tolist(), strict=True):
            bit = np.uint64(1 << int(np.searchsorted(places, pixel)))
            words |= np.where(row, bit, _NONE)
        return words.reshape(grid.together)

    def _context(self, block: _Block, level: int, group: np.ndarray, grid: _Grid) -> object:
        """Of a group of wider parts around this one that was bounded with all pixels, or None."""
        for wider in (level - 1, level - 2):
            if wider in block.grids:
                around = block.grids[wider].groups
                if ((grid.groups % around) == 0).all():
                    found = block.contexts.get((wider, *(group * around // grid.groups).tolist()))
                    if found is not None:
                        return found
        return None

    def _useful(self, block: _Block, level: int, box: ParameterBox) -> np.ndarray:
        """[side, side] pixels that may be excluded: a guess of work."""
        return np.ones(block.pixels.shape, bool)


def _windows(words: np.ndarray, axis: int, count: int) -> np.ndarray:
    """Bits that are set in all of ``count`` entries of an array from each on along an axis; there are none beyond."""
    result = words.copy()
    for step in range(1, min(count, words.shape[axis])):
        here = tuple(slice(None, -step) if k == axis else slice(None) for k in range(words.ndim))
        there = tuple(slice(step, None) if k == axis else slice(None) for k in range(words.ndim))
        result[here] &= words[there]
    return result


def relation(frame: Frame, local: Frame) -> tuple[Float64Array, Float64Array]:
    """Matrix [d, d] from parameters of ``frame`` to those of ``local``, and the sums of its entries' absolute terms.

    Both count the same poses, each with its own shear.
    """
    names = frame.box.names
    d = len(names)
    plain, sizes = np.eye(d), np.eye(d)
    for name, factors in frame.pose_set.shear.items():
        for other, factor in factors.items():
            plain[names.index(name), names.index(other)] += factor
            sizes[names.index(name), names.index(other)] += abs(factor)
    slopes, terms = plain.copy(), sizes.copy()
    for name, factors in local.pose_set.shear.items():
        for other, factor in factors.items():
            slopes[names.index(name)] -= factor * plain[names.index(other)]
            terms[names.index(name)] += abs(factor) * sizes[names.index(other)]
    return slopes, terms
