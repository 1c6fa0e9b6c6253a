"""The interfaces of scene representations that refinement, certificates and the Python API use.

A representation (`ns_abstract.methods.splat`, `ns_abstract.methods.nerf`) is a folder whose `Method` makes a `Frame` of
every set of poses. Nothing above `ns_abstract.methods.load` asks which one it is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.motion_cells import MotionCells, MotionField
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.perturbation.specification import Perturbation
from ns_abstract.perturbation.variations import Selection

if TYPE_CHECKING:
    import torch

#: A_lower [..., d], b_lower [...], A_upper, b_upper: see `ns_abstract.refine.result.Leaves`.
LinearSets = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
#: Channels of a picture, and the places of what may stand behind them.
COLORS, ACCUMULATION, DEPTH = 3, 3, 4
#: Most cells that are bounded together.
MOST_PARTS = 4
#: Parameter values [d] and tile numbers (None: all) to tiles [t, side, side, channels] float32.
Render = Callable[[np.ndarray, "np.ndarray | None"], np.ndarray]
#: Picture [H, W, 3] and parameter values [d] to a number, differentiable.
Score = Callable[["torch.Tensor", "torch.Tensor"], "torch.Tensor"]


class SceneElements(NamedTuple):
    """Positions, sizes and colours of scene elements, for drawings of the scene from outside.

    Attributes:
        places: [n, 3] normalised frame.
        spreads: [n, 3, 3] columns are the principal axes scaled by their standard deviations, the same.
        colors: [n, 3] in [0, 1], without what depends on the view.
        opacities: [n] in [0, 1].
    """

    places: np.ndarray
    spreads: np.ndarray
    colors: np.ndarray
    opacities: np.ndarray


class SceneSample(Protocol):
    """One scene of a set of scenes; calling it renders the scene."""

    def __call__(self, values: np.ndarray, tiles: np.ndarray | None = None) -> np.ndarray:
        """Return tiles [t, side, side, 3] float32 of the image at parameter values [d]; all tiles if None."""
        ...

    def signed_gradient_step(
        self, box: ParameterBox, values: np.ndarray, score: Score, size: float
    ) -> tuple[np.ndarray, SceneSample]:
        """Return parameter values in ``box`` and a scene one signed gradient step on, to raise the picture's score.

        Args:
            values: [d] where the step begins.
            score: What is to be raised.
            size: Length in half-widths of every range.
        """
        ...

    @property
    def nearest(self) -> SceneSample:
        """The scene of the set that `Frame.render` shows."""
        ...

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """Return by name the numbers in which the scene differs from others of its set."""
        ...


class CellContext(Protocol):
    """Results of a bounded cell that speed up the cells inside it."""

    @property
    def nbytes(self) -> int:
        """The bytes that it holds."""
        ...

    @property
    def shown(self) -> np.ndarray | None:
        """Numbers [n] of the scene elements that the cell may show; None where elements have no numbers."""
        ...


@dataclass(frozen=True)
class Bounds:
    """Bounds of some tiles over one cell.

    Attributes:
        lower, upper: [t, side, side, channels] float32, rounded outward; see `Frame`.
        slopes: [d] variation of the picture by parameter: the gain of a cut along it.
        context: For the cells inside this one; None: there is nothing to reuse.
        linear: Linear bounds in the cell's parameters, if they were requested.
        forms: [t, side, side, 3, m + 1] with linear bounds: coefficients of polynomials in the cell's parameters and a
            radius, before the clamp to [0, 1]; None: there are none.
    """

    lower: np.ndarray
    upper: np.ndarray
    slopes: np.ndarray
    context: CellContext | None
    linear: LinearSets | None = None
    forms: np.ndarray | None = None


class Frame(Protocol):
    """One set of poses of a scene, ready to be rendered and bounded; a frame without varied scenes has the defaults.

    Attributes:
        pose_set: The poses; their parameters are those of ``box``.
        channels: `COLORS`; or 5: behind the colours the accumulation in [0, 1], and the expected depth in world units
            where anything is drawn. A render's depth is NaN where nothing is, bounds are infinity before its negative
            where nothing can be.
        side: Pixels along a tile's side.
        across, down: Tiles across and down; tiles are numbered row by row.
        tilewise: Whether tiles are costly and independent (rays): the whole set is then bounded by [0, 1] at no cost,
            as a first cover, and tiles are taken a few at a time. Otherwise a call shares most of its work among tiles.
        tiles_at_once: Most tiles of one call while cells are split, so that time is looked at in between; None: all
            that a cell concerns.
        witnesses: Poses rendered in every part of a cell of one parameter that is split.
        stages: Parts of the kernels that can be compiled apart, the slowest first; none: they cannot.
    """

    pose_set: PoseBox
    box: ParameterBox
    camera: PinholeCamera
    channels: int
    side: int
    across: int
    down: int
    tilewise: bool
    tiles_at_once: int | None
    witnesses: int
    stages: tuple[str, ...] = ()

    @property
    def tile_count(self) -> int:
        """Number of tiles."""
        return self.across * self.down

    def warm_up(self, stage: str | None = None) -> None:
        """Compile the kernels that are compiled at first use: all of them, or one of `stages`."""
        ...

    def render(self, values: np.ndarray, tiles: np.ndarray | None = None) -> np.ndarray:
        """Return tiles [t, side, side, channels] float32 of the image at parameter values [d]; all tiles if None."""
        ...

    def scene_samples(self, seed: int) -> Iterator[SceneSample]:
        """Yield other scenes of the set; none where only poses vary."""
        return iter(())

    def bound(self, box: ParameterBox, tiles: np.ndarray, within: Any = None, keep_linear: bool = False) -> Bounds:
        """Return bounds of ``tiles`` over ``box``; ``within`` is the context of these tiles and an enclosing box."""
        return self.bound_parts([box], tiles, within, keep_linear, None)[0]

    def bound_parts(
        self, boxes: Sequence[ParameterBox], tiles: np.ndarray, within: Any, keep_linear: bool,
        pixels: np.ndarray | None,
    ) -> Sequence[Bounds]:  # fmt: skip
        """Return the result of `bound` for each of ``boxes``, at most `MOST_PARTS`, computed side by side.

        ``within``: the context of a box around all cells. ``pixels`` [t, side, side]: the needed ones, others may stay
        at [0, 1]; None: all.
        """
        ...

    def feasible(self, box: ParameterBox) -> ParameterBox | None:
        """Return a part of ``box`` that contains all parameters in it of poses of the set; None: there are none."""
        ...

    def motion(self, box: ParameterBox) -> np.ndarray:
        """Return the estimated image motion [d] in pixels over each parameter's range."""
        ...

    def depths(self) -> np.ndarray | None:
        """Return distances [n] along the optical axis of some visible scene elements at the middle pose (normalised).

        None: elements have no position.
        """
        return None

    def observe(self, tiles: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> None:
        """Receive the inner bounds [t, side, side, 3] of ``tiles`` [t]; a refinement calls it at every change."""

    def set_tolerance(self, excess: float) -> float:
        """Let later bounds be looser by a small fraction of ``excess`` on average; return the light left out, or 0."""
        return 0.0

    def plan(self, visible: int | None, lower: np.ndarray, upper: np.ndarray) -> list[str]:
        """Return a sentence on each thing that was left out for this frame, and why.

        ``visible``: number of scene elements that some cell shows, if they have numbers; bounds [H, W, 3] are those of
        refinement.
        """
        return []


@runtime_checkable
class CountedFrame(Protocol):
    """An optional interface of a `Frame` without stages: the cost of compiling its kernels.

    ``compiled``: approximate number of functions of the kernels, and the seconds of one core.
    """

    compiled: tuple[int, float]


#: Channels whose differences are bounded, the first less the second.
CHANNEL_DIFFERENCES = (0, 1), (1, 2), (0, 2)
FIRST_CHANNELS, SECOND_CHANNELS = ([pair[k] for pair in CHANNEL_DIFFERENCES] for k in (0, 1))


@runtime_checkable
class SubBoxFrame(Protocol):
    """An optional interface of a `Frame`: bounds over each of many equal parts of a wide cell."""

    def motion_field(self, box: ParameterBox) -> MotionField:
        """Return the estimated motion of the picture's blocks over a cell of poses."""
        ...

    def parallax(self, box: ParameterBox) -> np.ndarray:
        """Return pixels [d] by which typical elements move over each parameter's range relative to their block."""
        ...

    def enclosing(self, box: ParameterBox) -> Any:
        """Return the context of a wider cell around ``box``, for `Frame.bound`; None: there is none."""
        ...

    def element_counts(self, box: ParameterBox) -> np.ndarray:
        """Return the estimated number [H, W] of scene elements that bounds of each pixel over a cell look at."""
        ...

    def sub_box_ends(
        self, box: ParameterBox, counts: np.ndarray | MotionCells, tiles: np.ndarray, pixels: np.ndarray,
        goals: np.ndarray, differences: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray] | None:  # fmt: skip
        """Return lower and upper bounds [n, 3, k] of ``n`` pixels over ``k`` sub-boxes; None: none for this set.

        There are ``counts`` [d] sub-boxes along the axes, powers of two, at least 8 together, in the order of an array
        of this shape; or cells of the image motion. Each is widened by `SUB_BOX_OVERLAP` of the half-widths. ``pixels``
        [t, side, side]: the ``n`` pixels. ``differences`` [n]: the pixels whose `CHANNEL_DIFFERENCES`, not clamped to
        [0, 1], are bounded in place of channels. ``goals`` [n, 6], of the lower, then the upper bounds of channels:
        values on one side of which a bound only has to be known to lie; infinite: the bound itself is needed; NaN: it
        is not needed.
        """
        ...

    def warm_up_sub_boxes(self) -> None:
        """Compile the kernels that `sub_box_ends` needs in addition to the frame's own."""
        ...


class SharedOrder(Protocol):
    """Two scenes with elements at the same places, which are drawn in the same order in both."""

    def bounds(
        self, box: ParameterBox, tile: int, pixels: np.ndarray, contexts: tuple[Any, Any]
    ) -> Sequence[tuple[Bounds, Bounds]] | None:
        """Return linear bounds of both scenes, once for every depth order that a pose of ``box`` may have.

        ``pixels`` [side, side] are needed; ``contexts`` are of this tile and this or an enclosing cell. None: there are
        too many orders, or only one.
        """
        ...


@runtime_checkable
class OrderedFrame(Protocol):
    """An optional interface of a `Frame`: the order of elements may be shared with another scene's."""

    def shared_order(self, other: Frame) -> SharedOrder | None:
        """Return the elements that both scenes share; None: there are none. ``other`` has the same poses."""
        ...


@runtime_checkable
class PreciseFrame(Protocol):
    """An optional interface of a `Frame`: pictures that are not rounded."""

    def precise(self, values: np.ndarray, tiles: np.ndarray | None = None) -> np.ndarray:
        """Return the result of `Frame.render` before it is rounded: float64."""
        ...


class RayFrame(Frame, Protocol):
    """A frame whose pictures are rendered ray by ray (`ns_abstract.methods.representation.Representation.rays`)."""

    def cell_bounds(
        self, box: ParameterBox, weigh: Callable[[], np.ndarray | None] | None = None, most_rays: int | None = None
    ) -> Bounds:
        """Return linear bounds of all tiles over a cell, for certificates, whatever was bounded before.

        ``weigh``: returns [H, W, 3] the fraction of a margin that a unit of each pixel's width costs, or None; called
        at most once. ``most_rays``: approximate number of bounded rays, those that matter most first; others stay at
        [0, 1].

        Raises:
            WorkCancelledError: The deadline is over.
        """
        ...

    def effort(self) -> tuple[float | None, int]:
        """Return the estimated seconds of one ray over one part of the set, and the number of parts.

        None: there was no time to find out.
        """
        ...


@dataclass(frozen=True)
class WeightPlane:
    """The selection of scene elements whose blending weights a plane adds up; None in a rule: any element.

    ``nearer``: distance to the camera (normalised units), along the optical axis for elements with a position, along
    the ray for samples of a field.
    """

    select: Selection | None = None
    nearer: float | None = None


#: Most planes of one frame of blending weights: as many as colours have channels.
MOST_PLANES = COLORS


class WeightFrame(Frame, Protocol):
    """A frame whose three channels are blending weights of selected scene elements, with an empty background."""

    def of_sample(self, values: np.ndarray, sample: SceneSample | None) -> np.ndarray:
        """Return the result of `Frame.render` for a scene sample of the coloured frame; None: for the stored scene."""
        ...

    def differentiable(self, values: torch.Tensor) -> torch.Tensor:
        """Return weights [H, W, 3] at parameter values [d], differentiable where elements are selected."""
        ...


@runtime_checkable
class ElementFrame(WeightFrame, Protocol):
    """An optional interface of a `WeightFrame`: renders few pixels from the elements that show there alone."""

    def drawn_alone(self, context: Any, tiles: np.ndarray, pixels: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        """Return a function that renders ``tiles`` at parameter values [d] of a box; only ``pixels`` are right.

        ``context``: of these pixels and the box.
        """
        ...

    def bound_sub_boxes(
        self, box: ParameterBox, tiles: np.ndarray, within: Any, pixels: np.ndarray, counts: np.ndarray,
        levels: Sequence[float],
    ) -> tuple[Bounds, tuple[np.ndarray, np.ndarray]]:  # fmt: skip
        """Return `Frame.bound_parts` of one box with linear bounds, and bounds over sub-boxes.

        The latter are as in `SubBoxFrame.sub_box_ends`. They are as tight as possible only where one of ``levels`` lies
        between a pixel's ends over a sub-box; without levels everywhere.
        """
        ...


@runtime_checkable
class WeightMethod(Protocol):
    """An optional interface of a `Method`: frames of blending weights."""

    def weight_frame(self, poses: PoseBox, planes: Sequence[WeightPlane], pixels: np.ndarray) -> WeightFrame:
        """Return the frame whose first channels are ``planes``, at most `MOST_PLANES`; ``pixels`` [H, W] are read.

        Raises:
            InputError: A selection is empty, or this renderer's weights are not bounded.
        """
        ...


class Method(Protocol):
    """A scene and the renderer whose pictures are bounded."""

    #: What bounds of this program are called: "float32-sound" or "real-sound".
    guarantee: str

    @property
    def name(self) -> str:
        """The scene's name."""
        ...

    @property
    def notes(self) -> Sequence[str]:
        """Sentences on what was assumed when the scene was read."""
        ...

    @property
    def dataset_scale(self) -> float | None:
        """Normalised units per unit of the data set; None: unknown."""
        ...

    @property
    def program(self) -> dict[str, Any]:
        """``name`` and ``version`` of the bounded renderer, and what else identifies it."""
        ...

    @property
    def content(self) -> str:
        """The scene in a few words."""
        ...

    @property
    def plan(self) -> tuple[str, ...]:
        """What is left out for this scene in every frame."""
        ...

    @property
    def fingerprint(self) -> dict[str, Any]:
        """Identity of scene and renderer, for results that are continued."""
        ...

    def describe(self) -> dict[str, Any]:
        """Return the scene's description for reports; ``name`` is among the keys."""
        ...

    def prepare(self, perturbations: Sequence[Perturbation]) -> None:
        """Find the variations of the scene itself; InputError: not supported for this scene."""
        ...

    def memory(self, pixels: int, threads: int) -> int:
        """Return the bytes, without leaves, of a process with ``threads`` that bounds pictures of ``pixels``."""
        ...

    def frame(self, poses: PoseBox, sheared: bool = False, layers: bool = False) -> Frame:
        """Return one frame.

        ``sheared``: its box may have sheared parameters, where that is tighter. ``layers``: accumulation and expected
        depth follow the colours; InputError: this representation has none.
        """
        ...

    def ablations(self, poses: PoseBox) -> Iterator[tuple[str, Frame]]:
        """Yield causes of looseness of a set's bounds, in words, each with the frame without it."""
        return iter(())

    def attribution(self, frame: Frame, box: ParameterBox, tile: int, count: int) -> list[tuple[int, float]]:
        """Return scene elements whose removal narrows a tile's mean gap over a cell, with the amount, largest first."""
        return []

    def elements(self) -> SceneElements | None:
        """Return the scene's elements for drawings from outside; None: they have no positions."""
        return None

    def differentiable(self, poses: PoseBox) -> Callable[[torch.Tensor], torch.Tensor] | None:
        """Return a function from parameter values [d] to the picture [H, W, 3], differentiable; None: unsupported."""
        return None
