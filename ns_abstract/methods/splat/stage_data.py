"""Typed inputs and outputs of the compiled stages of the bounds (design.md, G and B).

Kernels take named tuples of arrays and numbers. Inside them the arrays of a record may be pointers to the elements
(`ns_abstract.arithmetic.simd.intrinsics.pointer`), which are not counted; the fields keep their names and meaning.
Throughout, n counts the candidates of a cell, m the coefficients of its forms, and t the tiles that are bounded.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ns_abstract.arithmetic.forms import Basis
from ns_abstract.arithmetic.rounding import Charges
from ns_abstract.geometry.box import part_middles
from ns_abstract.geometry.camera_path import Intrinsics
from ns_abstract.methods.splat.constants import RasterRules

#: Parts of a cell that are blended side by side; cells have a multiple of them.
PART_LANES = 8


class FormShape(NamedTuple):
    """The shape of a cell's forms: those of `Basis`, with ``order`` 2 for one parameter, else 1.

    Pixels have no forms where the cell has ``parts``, over which intervals bound them (B12). With ``sub_boxes`` their
    forms are bounded over each of these, too (B13). Parts divide the axes of the parameters, or ``by_motion`` the two
    of the image motion (B16).
    """

    dimensions: int
    order: int
    monomials: int
    parts: int = 0
    sub_boxes: int = 0
    by_motion: bool = False


def form_shape(basis: Basis, parts: int = 0, sub_boxes: int = 0, by_motion: bool = False) -> FormShape:
    """Return ``basis`` as kernels take it. Raises ValueError: curvature is kept for one parameter only."""
    if basis.order == 2 and basis.dimensions != 1:
        raise ValueError(f"forms of order 2 have one parameter, not {basis.dimensions}")
    if basis.order == 2 and parts:
        raise ValueError("cells of one parameter have no parts")
    return FormShape(basis.dimensions, basis.order, basis.monomials, parts, sub_boxes, by_motion)


class SceneGaussians(NamedTuple):
    """The arrays of a scene's N Gaussians that the per-Gaussian stage reads.

    Attributes:
        means: [N, 3] world, in the middle of their ranges.
        mean_radius: [N, 3] half-widths of independent ranges of the means, world axes, or [0, 3].
        axes: [N, 3, 3] principal axes by column, scaled by their standard deviations, world units.
        extents: [N] largest standard deviations, world units, up to rounding.
        noise: [N, 12] see `gaussians.covariance_noise`.
        opacity_low, opacity_high: [N] ends of the opacities' ranges.
        exponent_limits: [N] see `projection_errors.exponent_limits`.
    """

    means: np.ndarray
    mean_radius: np.ndarray
    axes: np.ndarray
    extents: np.ndarray
    noise: np.ndarray
    opacity_low: np.ndarray
    opacity_high: np.ndarray
    exponent_limits: np.ndarray


class CellPoses(NamedTuple):
    """The poses of a cell; see `ns_abstract.geometry.poses.PoseForms`.

    Attributes:
        rotation: [rows, 9] forms, world to camera, OpenCV axes, row-major.
        offset: [rows, 3] forms of the offset that is added to rotated means minus ``origin``, world units.
        origin: [3] world.
        camera_magnitude: [3] upper bounds of the absolute camera coordinates, world.
        rotation_magnitude: [9] upper bounds of the absolute entries of the rotation.
    """

    rotation: np.ndarray
    offset: np.ndarray
    origin: np.ndarray
    camera_magnitude: np.ndarray
    rotation_magnitude: np.ndarray


class ProjectionInputs(NamedTuple):
    """All inputs of the per-Gaussian stage."""

    scene: SceneGaussians
    poses: CellPoses
    camera: Intrinsics
    rules: RasterRules
    charges: Charges
    shape: FormShape


class SceneColors(NamedTuple):
    """The inputs for the colours of a scene's N Gaussians.

    Attributes:
        means, mean_radius: See `SceneGaussians`.
        low, high: [N, 3] ranges of shifts that are added to the colours, or [0, 3].
        sh: [N, K, 3] coefficients of the spherical harmonics.
        magnitudes: [N, 6] see `colors.color_magnitudes`.
        degree: Highest band.
    """

    means: np.ndarray
    mean_radius: np.ndarray
    low: np.ndarray
    high: np.ndarray
    sh: np.ndarray
    magnitudes: np.ndarray
    degree: int


class ProjectedGaussians(NamedTuple):
    """The projected Gaussians that the per-Gaussian stage writes (design.md, G4-G10).

    Attributes:
        record: [n, columns] see `projection_errors`: mean in pixels, opacity, whitening forms.
        box: [n, 4] pixels x0, x1, y0, y1 that may be reached.
        tiles: [n, 8] outer, then inner tile ranges x0, x1, y0, y1 (ends exclusive).
        depth: [n] at the cell's middle, world units.
        delta: [n, 3] mean minus the cell's origin, world axes.
        depth_error: [n] float error of the depth against another's, world units.
    """

    record: np.ndarray
    box: np.ndarray
    tiles: np.ndarray
    depth: np.ndarray
    delta: np.ndarray
    depth_error: np.ndarray


class ProjectedCell(NamedTuple):
    """The projected candidates of a cell, in memory that the next projection of the same thread group reuses.

    Attributes:
        candidates: [n] scene indices.
        poses: Of the cell.
        gaussians: Their forms.
        alive: [k] positions among the candidates of those that some pose shows.
        colors, background, color_error: See `Colors`.
    """

    candidates: np.ndarray
    poses: CellPoses
    gaussians: ProjectedGaussians
    alive: np.ndarray
    colors: np.ndarray
    background: np.ndarray
    color_error: float


class ViewingAxes(NamedTuple):
    """The camera's axes over a cell.

    Attributes:
        depth: [rows, 3] forms of the rotation's third row, world to camera; radii include its float error.
        middle: [9] the middle pose's rotation, world to camera, row-major.
        tied: Whether Gaussians of equal ``delta`` have equal depths in the program, and so are ordered by number.
    """

    depth: np.ndarray
    middle: np.ndarray
    tied: bool


class Colors(NamedTuple):
    """Colours of the Gaussians and of the background.

    Attributes:
        values: [n, channels] colours, or [n, channels (k + 1)] forms by channel: k coefficients and a radius; k is 1 or
            m.
        background: [3].
        error: Bound of the colours' float error, added to every result.
        channels: 3; or 4, the last of which is a form of the depth less ``common``, world units.
        common: [m + 1] form that is subtracted from all depths.
    """

    values: np.ndarray
    background: np.ndarray
    error: float
    channels: int
    common: np.ndarray


class Cutoffs(NamedTuple):
    """Cut-offs below which effects are bounded but not followed.

    Attributes:
        floor: Fragments are left out where no pose lets more light reach them (B6); none if negative.
        fade: Bound of the program's rounding when it adds up omitted fragments, in units of the brightest colour.
        negligible: Bound of the sum of all fragments omitted for a negligible alpha.
        pairs: Largest number of depth-order pairs considered in one block of pixels.
    """

    floor: float
    fade: float
    negligible: float
    pairs: int


class SubBoxes(NamedTuple):
    """Equal sub-boxes of a cell over which pixels' forms are bounded (docs/dev/design.md, B13).

    Attributes:
        counts: [d] numbers of them along the axes, powers of two, at least `PART_LANES` together.
        levels: Values of a channel. Bounds over a sub-box are as tight as possible only where one of these lies between
            them; no levels: everywhere.
    """

    counts: np.ndarray
    levels: tuple[float, ...] = ()


class Parts(NamedTuple):
    """Equal parts of a cell, with positions and widths in [-1, 1] (docs/dev/design.md, B12, B13, B16).

    Attributes:
        middles: [axes, parts].
        half: [axes] half-widths.
        slope: [axes] factors: the sum of ``middles`` times the ends of a quantity over the parts, times this, is its
            slope; 0 where an axis is not divided.
        levels: See `SubBoxes`.
        motion, side: See `MotionCells`; [0, 4, d]: axes are those of the parameters.
    """

    middles: np.ndarray
    half: np.ndarray
    slope: np.ndarray
    levels: np.ndarray
    motion: np.ndarray
    side: int


def check_parts(counts: np.ndarray, dimensions: int) -> None:
    """Raise ValueError for numbers of parts along axes that `cell_parts` and kernels do not take.

    They must be ``dimensions`` powers of two, at least `PART_LANES` together.
    """
    one_bit = counts.shape == (dimensions,) and bool(np.all((counts > 0) & (counts & (counts - 1) == 0)))
    if not one_bit or counts.prod() % PART_LANES:
        raise ValueError(f"{counts.tolist()} are no numbers of parts along {dimensions} axes")


def cell_parts(counts: np.ndarray, overlap: float = 0.0, levels: Sequence[float] = ()) -> Parts:
    """Return the parts of a cell, ``counts`` [axes] of them along its axes: powers of two, so that all is exact (B12).

    They extend beyond their ends by ``overlap`` of the cell's half-width.
    """
    middles = part_middles(counts)
    squares = np.square(middles).sum(axis=1)
    slope = np.where(counts > 1, 0.5 / np.where(counts > 1, squares, 1.0), 0.0)
    none = np.zeros((0, 4, counts.size))
    return Parts(middles, 1.0 / counts + overlap, slope, np.array(levels, np.float64), none, 1)


class Strips(NamedTuple):
    """Strips of `PART_LANES` sub-boxes of a cell, one after the other (docs/dev/design.md, B14).

    Attributes:
        middles: [d, room] positions in [-1, 1]; those beyond the last strip repeat it.
        half: [d] distances of the sub-boxes' middles from their strip's middle.
        room: Length of rows, whole lanes.
    """

    middles: np.ndarray
    half: np.ndarray
    room: int


#: Most strips: each is a bit of a number, whose last bit is its sign.
_MOST_STRIPS = 63


def strips_of(parts: Parts) -> Strips:
    """Return the strips of the sub-boxes ``parts``.

    Raises:
        ValueError: There are more than sets of strips can hold.
    """
    lanes = parts.middles.reshape(parts.half.size, -1, PART_LANES)
    if lanes.shape[1] > _MOST_STRIPS:
        raise ValueError(f"{parts.middles.shape[1]} sub-boxes are more than {_MOST_STRIPS * PART_LANES}")
    low, high = lanes.min(axis=2), lanes.max(axis=2)
    middles = 0.5 * (low + high)
    room = -(-middles.shape[1] // PART_LANES) * PART_LANES
    padding = np.repeat(middles[:, -1:], room - middles.shape[1], axis=1)
    # dyadic, so exact
    return Strips(np.ascontiguousarray(np.hstack([middles, padding])), (0.5 * (high - low)).max(axis=1), room)


class ColorEnds(NamedTuple):
    """Ends of the Gaussians' colours over a cell: the least of three channels, negated, then the largest (B14).

    Attributes:
        values: [6, n] colours.
        background: [6].
        opposite: [6] least of all colours of the row and of the background, for rows of largest ones.
        bright: Greatest absolute value of any colour, at least 1.
    """

    values: np.ndarray
    background: np.ndarray
    opposite: np.ndarray
    bright: float


class PixelBounds(NamedTuple):
    """The bounds that the pixel stage writes.

    Attributes:
        lower, upper: [t, side, side, 3].
        linear: [t, side, side, 3, m + 1] forms before the clamp, or empty.
        slopes: [t, d] sums of absolute linear coefficients, added to.
        statistics: [threads, 5] blocks, fragments of the longest lists, open pairs, blocks with too many open pairs,
            pixels with results that were not numbers.
        layers: [t, side, side, 4] bounds of the accumulation, and of the expected depth where anything is drawn (see
            `depths`; infinity before its negative: nothing can be), or empty.
        parts: [t, side, side, 6, parts] least of the three channels and largest in each part or sub-box of the cell,
            for requested pixels, or empty.
        marks: [n] uint8; set to 1 for every Gaussian that some requested pixel of these tiles may draw or terminate at.
            Those that stay 0 are hidden or too faint for every pose: leaving them out changes nothing.
    """

    lower: np.ndarray
    upper: np.ndarray
    linear: np.ndarray
    layers: np.ndarray
    slopes: np.ndarray
    statistics: np.ndarray
    parts: np.ndarray
    marks: np.ndarray


class PixelInputs(NamedTuple):
    """All inputs of the pixel stage for a cell.

    Attributes:
        gaussians: Projected.
        axes: The viewing axes, which decide the depth order.
        intrinsics: The camera's.
        colors: Of the Gaussians.
        rules: The rasteriser's.
        charges: For the program's rounding.
        cutoffs: For omitted fragments.
        shape: Of the Gaussians' forms.
        parts: Of the cell, or its sub-boxes, where ``shape`` has some.
    """

    gaussians: ProjectedGaussians
    axes: ViewingAxes
    intrinsics: Intrinsics
    colors: Colors
    rules: RasterRules
    charges: Charges
    cutoffs: Cutoffs
    shape: FormShape
    parts: Parts
