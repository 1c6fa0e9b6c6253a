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
        """Return the picture [H, W, 3] float32 at parameter values [d], of ``scene_sample`` if it is given."""
        ...

    def scene_samples(self, seed: int) -> Iterator[SceneSample]:
        """Yield other scenes of the set, without end; none where only poses vary."""
        ...

    def linear_sets(self, box: ParameterBox) -> PixelSets:
        """Return (A_lower, b_lower, A_upper, b_upper) [H, W, 3, d] and [H, W, 3]; lower, upper; and slopes [d]."""
        ...

    def differentiable(self, values: torch.Tensor) -> torch.Tensor:
        """Return the picture [H, W, 3] at parameter values [d], differentiable."""
        ...


@runtime_checkable
class NearImages(Protocol):
    """An optional interface of `FrameImages`: pictures in a cell are cheaper with bounds around it."""

    def near(self, cell: ParameterBox) -> FrameImages:
        """Return the pictures and sets for poses of ``cell`` and boxes inside it.

        Pixels may have other values than the picture's, but every margin has the sign of the picture's.
        """
        ...


#: (A_lower, b_lower, A_upper, b_upper), lower, upper, and slopes; see `FrameImages.linear_sets`.
PixelSets = tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray, np.ndarray]


@runtime_checkable
class DividedImages(Protocol):
    """An optional interface of `FrameImages`: bounds over sub-boxes of a cell cost little in addition to its sets."""

    def sub_box_counts(self, box: ParameterBox, most: int) -> np.ndarray | None:
        """Return the best numbers [d] of sub-boxes of a cell, powers of two, ``most`` together; None: none."""
        ...

    def divided_sets(self, box: ParameterBox, counts: np.ndarray) -> tuple[PixelSets, SubBoxEnds | None]:
        """Return `FrameImages.linear_sets`, and sub-box bounds of the pixels that decide; None: there are none.

        There are ``counts`` [d] sub-boxes, at least 8.
        """
        ...

    def narrowed(self, ends: SubBoxEnds, sub_boxes: np.ndarray) -> FrameImages:
        """Return pictures, for bounds alone, over some ``sub_boxes`` [counts] of a cell with bounds ``ends``."""
        ...


@runtime_checkable
class ComparedCuts(Protocol):
    """An optional interface of `FrameImages`: compares cuts of a cell by bounds of narrower cells."""

    def cut_gains(self, box: ParameterBox) -> np.ndarray:
        """Return the gain [d] of a cut of the cell along each parameter, in place of its sets' slopes."""
        ...


class Model(Protocol):
    """A network with its preprocessing."""

    def outputs(self, images: np.ndarray) -> np.ndarray:
        """Return outputs [B, n] of the deployed program for pictures [B, H, W, 3]."""
        ...

    def differentiable(self, images: torch.Tensor) -> torch.Tensor:
        """Return outputs [B, n] for pictures [B, H, W, 3], differentiable."""
        ...

    def input_sets(self, linear: tuple[np.ndarray, ...], lower: np.ndarray, upper: np.ndarray) -> ImageSets:
        """Return sets of the network's input; see `ns_abstract.verify.preprocess.Preprocess.input_sets`."""
        ...

    def bound(self, images: ImageSets, query: Query) -> OutputBounds:
        """Return bounds of the query's rows over the sets."""
        ...

    def branch(self, images: ImageSets, query: Query, groups: Sequence[Sequence[int]], most_branches: int) -> float:
        """Return a lower bound of the margin of a linear claim over one set, by at most ``most_branches`` branches."""
        ...


@runtime_checkable
class PartsModel(Model, Protocol):
    """An optional interface of `Model`: bounds of parts of a cell cost little in addition to its sets."""

    def part_counts(self, images: ImageSets, most_parts: int) -> np.ndarray:
        """Return the best numbers [d] of parts of one cell along its parameters, powers of two."""
        ...

    def bound_parts(self, images: ImageSets, counts: np.ndarray, ends: SubBoxEnds | None = None) -> OutputBounds:
        """Return bounds of the query's rows over equal parts of one cell, a row each; the last parameter is fastest.

        Parts extend by `SUB_BOX_OVERLAP` of the cell's half-widths beyond their ends; ``ends`` bound pixels over the
        same parts.
        """
        ...
