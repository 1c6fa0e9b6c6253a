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
    """A sample of a set of scenes."""

    def __call__(self, values: np.ndarray, tiles: np.ndarray | None = None) -> np.ndarray:
        """Tiles [t, side, side, 3] float32 of the concrete image at parameter values [d]; all tiles if None."""
        ...

    def signed_gradient_step(
        self, box: ParameterBox, values: np.ndarray, score: Score, size: float
    ) -> tuple[np.ndarray, SceneSample]:
        """Parameter values in ``box`` and a scene a signed step on, along which the score of the picture should grow.

        Args:
            values: [d] where the step begins.
            score: What should grow.
            size: Length in half-widths of every range.
        """
        ...

    @property
    def nearest(self) -> SceneSample:
        """The scene of the set that `Frame.render` shows."""
        ...

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """The numbers in which the scene differs from others of its set, by name."""
        ...


class CellContext(Protocol):
    """Results of a bounded cell that speed up the cells inside it."""

    @property
    def nbytes(self) -> int:
        """Memory that it holds."""
        ...

    @property
    def shown(self) -> np.ndarray | None:
        """Numbers [n] of the scene elements that the cell may show; None where elements are not told apart."""
        ...


@dataclass(frozen=True)
class Bounds:
    """Bounds of some tiles over one cell.

    Attributes:
        lower, upper: [t, side, side, channels] float32, rounded outward; see `Frame`.
        slopes: [d] how much the picture varies by parameter: what a cut along it may gain.
        context: For the cells inside this one; None: nothing is known that would help.
        linear: Linear bounds in the cell's parameters, if they were asked for.
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
        """Compile what is compiled at first use, all of it or one of `stages`."""
        ...

    def render(self, values: np.ndarray, tiles: np.ndarray | None = None) -> np.ndarray:
        """Tiles [t, side, side, channels] float32 of the concrete image at parameter values [d]; all tiles if None."""
        ...

    def scene_samples(self, seed: int) -> Iterator[SceneSample]:
        """Other scenes of the set; none where only poses vary."""
        return iter(())

    def bound(self, box: ParameterBox, tiles: np.ndarray, within: Any = None, keep_linear: bool = False) -> Bounds:
        """Bounds of ``tiles`` over ``box``; ``within`` is the context of these tiles and a box around it."""
        return self.bound_parts([box], tiles, within, keep_linear, None)[0]

    def bound_parts(
        self, boxes: Sequence[ParameterBox], tiles: np.ndarray, within: Any, keep_linear: bool,
        pixels: np.ndarray | None,
    ) -> Sequence[Bounds]:  # fmt: skip
        """What `bound` returns of each of ``boxes``, at most `MOST_PARTS`, side by side.

        ``within``: the context from a box around all cells. ``pixels`` [t, side, side]: which are wanted, others may be
        left at [0, 1]; all if None.
        """
        ...

    def feasible(self, box: ParameterBox) -> ParameterBox | None:
        """A part of ``box`` that holds all parameters in it of poses of the set; None where there are none."""
        ...

    def motion(self, box: ParameterBox) -> np.ndarray:
        """[d] pixels that the picture moves by over each parameter's range (an estimate)."""
        ...

    def depths(self) -> np.ndarray | None:
        """[n] distances along the optical axis of some scene elements that the middle pose shows (normalised units).

        None: elements have no place of their own.
        """
        return None

    def observe(self, tiles: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> None:
        """Take the inner bounds [t, side, side, 3] of ``tiles`` [t] so far; a refinement calls it at every change."""

    def set_tolerance(self, excess: float) -> float:
        """Let later bounds be looser by a small part of ``excess`` on average; returns what light is left out, or 0."""
        return 0.0

    def plan(self, visible: int | None, lower: np.ndarray, upper: np.ndarray) -> list[str]:
        """What was left out for this frame and why, one sentence each.

        ``visible``: scene elements that some cell shows, if they are told apart; bounds [H, W, 3] are what refinement
        found.
        """
        return []


@runtime_checkable
class CountedFrame(Protocol):
    """An optional interface of a `Frame` without stages: what compiling its kernels takes.

    ``compiled``: functions of the kernels, about, and the seconds that one core compiles.
    """

    compiled: tuple[int, float]


#: Channels whose differences are bounded, the first less the second.
CHANNEL_DIFFERENCES = (0, 1), (1, 2), (0, 2)
FIRST_CHANNELS, SECOND_CHANNELS = ([pair[k] for pair in CHANNEL_DIFFERENCES] for k in (0, 1))


@runtime_checkable
class SubBoxFrame(Protocol):
    """An optional interface of a `Frame`: bounds over each of many equal parts of a wide cell."""

    def motion_field(self, box: ParameterBox) -> MotionField:
        """By how much the squares of a picture move over a cell of poses (an estimate)."""
        ...

    def parallax(self, box: ParameterBox) -> np.ndarray:
        """[d] pixels that typical elements move by, over each parameter's range, beside what their block does."""
        ...

    def enclosing(self, box: ParameterBox) -> Any:
        """What a wider cell around ``box`` shows, as `Frame.bound` takes it; None: nothing is known."""
        ...

    def element_counts(self, box: ParameterBox) -> np.ndarray:
        """[H, W] scene elements that bounds of each pixel over a cell look at (an estimate)."""
        ...

    def sub_box_ends(
        self, box: ParameterBox, counts: np.ndarray | MotionCells, tiles: np.ndarray, pixels: np.ndarray,
        goals: np.ndarray, differences: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray] | None:  # fmt: skip
        """Lower and upper bounds [n, 3, k] of ``n`` pixels over ``k`` sub-boxes; None: there are none for this set.

        ``differences`` [n]: of which pixels `CHANNEL_DIFFERENCES` are bounded, not clamped to [0, 1], not channels.

        There are ``counts`` [d] sub-boxes along the axes, powers of two, at least 8 together, numbered like entries of
        an array of this shape; or cells of the image motion. Each is widened by `SUB_BOX_OVERLAP` of the half-widths.
        ``pixels`` [t, side, side]: the ``n``. ``goals`` [n, 6]: values of the lower, then the upper bounds of channels
        that only have to be known to lie on one side of them; infinite: all of a bound matters; NaN: it is not wanted.
        """
        ...

    def warm_up_sub_boxes(self) -> None:
        """Compile what `sub_box_ends` needs at first use besides the frame's own kernels."""
        ...


class SharedOrder(Protocol):
    """Two scenes some of whose elements lie at the same places, and so are drawn in the same order in both."""

    def bounds(
        self, box: ParameterBox, tile: int, pixels: np.ndarray, contexts: tuple[Any, Any]
    ) -> Sequence[tuple[Bounds, Bounds]] | None:
        """Bounds of both scenes with linear bounds, once for every order of elements that a pose of ``box`` may have.

        ``pixels`` [side, side] are wanted; ``contexts`` are of this tile and cell, or one around it. None: there are
        too many orders, or one alone.
        """
        ...


@runtime_checkable
class OrderedFrame(Protocol):
    """An optional interface of a `Frame`: the order of elements may be shared with another scene's."""

    def shared_order(self, other: Frame) -> SharedOrder | None:
        """What both scenes' elements have in common; None: nothing. ``other`` has the same poses."""
        ...


@runtime_checkable
class PreciseFrame(Protocol):
    """What a `Frame` may have beside: pictures that are not rounded."""

    def precise(self, values: np.ndarray, tiles: np.ndarray | None = None) -> np.ndarray:
        """What `Frame.render` returns, before it is rounded: float64."""
        ...


class RayFrame(Frame, Protocol):
    """A frame whose pictures are made ray by ray (`ns_abstract.methods.representation.Representation.rays`)."""

    def cell_bounds(
        self, box: ParameterBox, weigh: Callable[[], np.ndarray | None] | None = None, most_rays: int | None = None
    ) -> Bounds:
        """Bounds of all tiles over a cell with linear bounds, for certificates, whatever was bounded before.

        ``weigh``: [H, W, 3] what part of a margin a unit of each pixel's width may cost, or None; asked at most once.
        ``most_rays``: rays that are bounded, about, those that matter most first; others are left at [0, 1].

        Raises:
            WorkCancelledError: There is no time for it.
        """
        ...

    def effort(self) -> tuple[float | None, int]:
        """Seconds that one ray takes over one part of the set, about, and in how many parts the set is bounded.

        None: there was no time to find out.
        """
        ...


@dataclass(frozen=True)
class WeightPlane:
    """Which scene elements a plane adds up the blending weights of: those that meet both rules, None: any.

    ``nearer``: distance to the camera (normalised units), along the optical axis for what has a place of its own, along
    the ray for samples of a field.
    """

    select: Selection | None = None
    nearer: float | None = None


#: Most planes of one frame of blending weights: as many as colours have channels.
MOST_PLANES = COLORS


class WeightFrame(Frame, Protocol):
    """A frame whose three channels are blending weights of chosen scene elements, and nothing behind them."""

    def of_sample(self, values: np.ndarray, sample: SceneSample | None) -> np.ndarray:
        """What `Frame.render` returns, of a scene sample of the coloured frame of the same set; None: of the scene."""
        ...

    def differentiable(self, values: torch.Tensor) -> torch.Tensor:
        """Weights [H, W, 3] at parameter values [d], differentiable where elements are chosen."""
        ...


@runtime_checkable
class ElementFrame(WeightFrame, Protocol):
    """An optional interface of a `WeightFrame`: pictures of few pixels, drawn by the elements that show there alone."""

    def drawn_alone(self, context: Any, tiles: np.ndarray, pixels: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        """What draws the ``tiles`` [t, side, side, 3] at parameter values [d] of a box; right at ``pixels`` alone.

        ``context``: of these pixels and the box.
        """
        ...

    def bound_sub_boxes(
        self, box: ParameterBox, tiles: np.ndarray, within: Any, pixels: np.ndarray, counts: np.ndarray,
        levels: Sequence[float],
    ) -> tuple[Bounds, tuple[np.ndarray, np.ndarray]]:  # fmt: skip
        """Bounds with linear bounds as `Frame.bound_parts` has them, and those over sub-boxes.

        The latter are a pair as of `SubBoxFrame.sub_box_ends`. Only where one of ``levels`` lies between the ends of a
        pixel over a sub-box are these made as narrow as they can be; none: everywhere.
        """
        ...


@runtime_checkable
class WeightMethod(Protocol):
    """An optional interface of a `Method`: frames of blending weights."""

    def weight_frame(self, poses: PoseBox, planes: Sequence[WeightPlane], pixels: np.ndarray) -> WeightFrame:
        """The frame whose first channels are ``planes``, at most `MOST_PLANES`; ``pixels`` [H, W] will be read.

        Raises:
            InputError: A selection picks nothing, or this program's weights are not bounded.
        """
        ...


class Method(Protocol):
    """A scene and the program whose pictures are bounded."""

    #: What bounds of this program are called: "float32-sound" or "real-sound".
    guarantee: str

    @property
    def name(self) -> str:
        """The scene's name."""
        ...

    @property
    def notes(self) -> Sequence[str]:
        """What was assumed on reading the scene, one sentence each."""
        ...

    @property
    def dataset_scale(self) -> float | None:
        """Normalised units per unit of the data set; None: the scene does not say."""
        ...

    @property
    def program(self) -> dict[str, Any]:
        """``name`` and ``version`` of the bounded program, and what else tells it from others."""
        ...

    @property
    def content(self) -> str:
        """The scene in a few words."""
        ...

    @property
    def plan(self) -> tuple[str, ...]:
        """What is left out for this scene, whatever the frame."""
        ...

    @property
    def fingerprint(self) -> dict[str, Any]:
        """Scene and program, for results that are continued."""
        ...

    def describe(self) -> dict[str, Any]:
        """The scene for reports; ``name`` is among the keys."""
        ...

    def prepare(self, perturbations: Sequence[Perturbation]) -> None:
        """Find out what the scene itself may do; InputError: not with this scene."""
        ...

    def memory(self, pixels: int, threads: int) -> int:
        """Bytes that a process of so many threads needs beside the leaves to bound pictures of ``pixels``."""
        ...

    def frame(self, poses: PoseBox, sheared: bool = False, layers: bool = False) -> Frame:
        """One frame.

        ``sheared``: its box may count parameters otherwise than the set does, where that is tighter. ``layers``:
        accumulation and expected depth stand behind the colours; InputError: this representation has none.
        """
        ...

    def ablations(self, poses: PoseBox) -> Iterator[tuple[str, Frame]]:
        """What makes bounds of a set loose, in words, and its frame without that: not the one asked for."""
        return iter(())

    def attribution(self, frame: Frame, box: ParameterBox, tile: int, count: int) -> list[tuple[int, float]]:
        """Scene elements without which the mean gap of a tile over a cell is less, and by how much, in that order."""
        return []

    def elements(self) -> SceneElements | None:
        """What can be drawn of the scene as it is seen from outside; None: nothing has a place of its own."""
        return None

    def differentiable(self, poses: PoseBox) -> Callable[[torch.Tensor], torch.Tensor] | None:
        """Parameter values [d] to the picture [H, W, 3], differentiable; None: there are no certificates of it."""
        return None
