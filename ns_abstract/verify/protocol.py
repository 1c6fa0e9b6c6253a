"""The interfaces of pictures and networks that a search uses (docs/dev/design.md, V6, V15)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Protocol, runtime_checkable

import numpy as np
import torch

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.refine.protocol import SceneSample
from ns_abstract.verify.network import ImageSets, OutputBounds
from ns_abstract.verify.picture_measures import SubBoxEnds
from ns_abstract.verify.properties import Query


class FrameImages(Protocol):
    """The pictures of one frame at the network's resolution."""

    box: ParameterBox

    def image(self, values: np.ndarray, scene_sample: SceneSample | None = None) -> np.ndarray:
        """Concrete picture [H, W, 3] float32 at parameter values [d], of another scene of the set if one is named."""
        ...

    def scene_samples(self, seed: int) -> Iterator[SceneSample]:
        """Other scenes of the set, without end; none where only poses vary."""
        ...

    def linear_sets(self, box: ParameterBox) -> PixelSets:
        """(A_lower, b_lower, A_upper, b_upper) [H, W, 3, d] and [H, W, 3], lower, upper, and slopes [d]."""
        ...

    def differentiable(self, values: torch.Tensor) -> torch.Tensor:
        """Picture [H, W, 3] at parameter values [d], differentiable."""
        ...


@runtime_checkable
class NearImages(Protocol):
    """An optional interface of `FrameImages`: what is known around a cell makes its pictures cheaper."""

    def near(self, cell: ParameterBox) -> FrameImages:
        """Pictures and sets for poses of ``cell`` and boxes inside it.

        Every margin has the sign of that of the picture as it is, though pixels may have other values.
        """
        ...


#: (A_lower, b_lower, A_upper, b_upper), lower, upper, and slopes; see `FrameImages.linear_sets`.
PixelSets = tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray, np.ndarray]


@runtime_checkable
class DividedImages(Protocol):
    """An optional interface of `FrameImages`: bounds over equal sub-boxes of a cell cost little beside its sets."""

    def sub_box_counts(self, box: ParameterBox, most: int) -> np.ndarray | None:
        """[d] into how many sub-boxes a cell is best divided, powers of two, ``most`` together; None: into none."""
        ...

    def divided_sets(self, box: ParameterBox, counts: np.ndarray) -> tuple[PixelSets, SubBoxEnds | None]:
        """`FrameImages.linear_sets`, and bounds over sub-boxes of pixels that decide; None: there are no such pixels.

        There are ``counts`` [d] sub-boxes, at least 8.
        """
        ...

    def narrowed(self, ends: SubBoxEnds, sub_boxes: np.ndarray) -> FrameImages:
        """Pictures, for bounds alone, of what some ``sub_boxes`` [counts] of a cell cover, over which ``ends`` hold."""
        ...


@runtime_checkable
class ComparedCuts(Protocol):
    """An optional interface of `FrameImages`: cuts of a cell are compared by bounds of narrower cells."""

    def cut_gains(self, box: ParameterBox) -> np.ndarray:
        """[d] what a cut of the cell along each parameter may gain, in place of the slopes of its sets."""
        ...


class Model(Protocol):
    """A network with its preprocessing."""

    def outputs(self, images: np.ndarray) -> np.ndarray:
        """[B, n] outputs that the deployed program gives for pictures [B, H, W, 3]."""
        ...

    def differentiable(self, images: torch.Tensor) -> torch.Tensor:
        """[B, n] outputs for pictures [B, H, W, 3], differentiable."""
        ...

    def input_sets(self, linear: tuple[np.ndarray, ...], lower: np.ndarray, upper: np.ndarray) -> ImageSets:
        """Sets of the network's input; see `ns_abstract.verify.preprocess.Preprocess.input_sets`."""
        ...

    def bound(self, images: ImageSets, query: Query) -> OutputBounds:
        """Bounds of the query's rows over the sets."""
        ...

    def branch(self, images: ImageSets, query: Query, groups: Sequence[Sequence[int]], most_branches: int) -> float:
        """A lower bound of the margin of a linear claim over one set, by at most so many branches."""
        ...


@runtime_checkable
class PartsModel(Model, Protocol):
    """An optional interface of `Model`: bounds of parts of a cell cost next to nothing beside its sets."""

    def part_counts(self, images: ImageSets, most_parts: int) -> np.ndarray:
        """[d] into how many parts one cell is best divided along its parameters, powers of two."""
        ...

    def bound_parts(self, images: ImageSets, counts: np.ndarray, ends: SubBoxEnds | None = None) -> OutputBounds:
        """Bounds of the query's rows over equal parts of one cell, a row for each, the last parameter's first.

        Parts reach by `SUB_BOX_OVERLAP` of the cell's half-widths beyond their ends; ``ends`` bound pixels over the
        same parts.
        """
        ...
