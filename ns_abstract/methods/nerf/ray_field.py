"""Records of bounds of rays, and a scene's field along the rays of a sampling (docs/dev/design.md, F6-F8)."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from ns_abstract.arithmetic.chebyshev import ChebyshevBasis
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.methods.nerf.division import Division
from ns_abstract.methods.nerf.hsv import Range
from ns_abstract.methods.nerf.ray_bundle import TAYLOR
from ns_abstract.methods.nerf.render import Sampling
from ns_abstract.methods.nerf.sample_paths import SamplePaths
from ns_abstract.methods.nerf.scene import FieldWeights, NerfScene
from ns_abstract.methods.nerf.white import WhiteSamples
from ns_abstract.methods.nerf.zonotope import ERROR_TERMS, FieldBounds

#: (degree, grid) of the polynomials by number of parameters.
_DEGREES = {0: (1, 2), 1: (28, 112), 2: (6, 20), 3: (4, 10), 4: (2, 5)}
#: The same of one parameter for a field whose base has at most so many layers: it bears cells as wide as its waves are
#: followed, while deeper ones bend more.
_SHALLOW, _SHALLOW_DEGREE = 4, (35, 126)
#: Cells bounded at once by compiled kernels, whose numbers stay in a core's cache.
_BATCH = 128
#: Elsewhere: values of a layer's neurons on the grid, and how many arrays as large there may be at a time, about.
_VALUES, _ARRAYS = 1 << 25, 12


@dataclass(frozen=True)
class RayTuning:
    """From which light and motion on samples are refined; soundness does not depend on it."""

    #: Light (in [0, 1]) that a skipped sample may add, as a share of the tolerance.
    quiet: float = 0.02
    #: Opacities of at most this share of the tolerance are not told apart by parts of a cell.
    alike: float = 2.0**-9
    #: Light that a sample may leave open before compositing has shown where it matters.
    coarse: float = 0.1
    #: Half the way of a sample over a cell to begin with.
    displacement: float = 0.02
    #: Half the way of one that is followed, whose place the coarse pass moves, too.
    followed: float = 5e-4
    least_followed: float = 2e-6
    #: Light from a sample whose colour's shift is not looked at.
    unseen: float = 1e-5


RAY_TUNING = RayTuning()

#: Intervals of hue and saturation.
Shifts = tuple[Range, Range]


def basis_of(dimensions: int, field: FieldWeights) -> ChebyshevBasis:
    """Return the polynomials for ``dimensions`` parameters of a ``field``."""
    degree, grid = _DEGREES.get(dimensions, (1, 2))
    if dimensions == 1 and len(field.base) <= _SHALLOW:
        degree, grid = _SHALLOW_DEGREE
    return ChebyshevBasis(dimensions, degree, grid)


def cells_at_once(field: FieldWeights, basis: ChebyshevBasis) -> int:
    """Return the number of cells of a batch where kernels are not compiled."""
    return max(1, _VALUES // (len(basis.evaluation) * field.width))


def device_bytes(field: FieldWeights, basis: ChebyshevBasis) -> int:
    """Return the approximate memory of such a batch."""
    # error terms before and after a layer, and their product with slopes
    columns = 3 * ERROR_TERMS * cells_at_once(field, basis) * field.width
    return 8 * (_ARRAYS * _VALUES + columns) + (1 << 29)


@dataclass
class RayBounds:
    """Bounds of n rays over a box.

    Attributes:
        lower, upper: [n, 3] float64 bounds of the colours.
        alpha: [n, samples] float32 upper bounds of the opacity of every sample over the box.
        cells: Number of bounded cells of the network.
        displacement: Half the motion of a sample over a cell of suitable width, learned from these rays.
        parts: [2, n, shifts, *parts, 3] float32 lower and upper bounds, rounded outward, by part of the box, if a
            division was given; one row of ``shifts`` if there are none.
    """

    lower: np.ndarray
    upper: np.ndarray
    alpha: np.ndarray
    cells: int
    displacement: float
    parts: np.ndarray | None = None


def typical_displacement(parts: Sequence[RayBounds]) -> float:
    """Return the geometric mean of the displacements of ``parts``, independent of their order."""
    return math.exp(sum(math.log(part.displacement) for part in parts) / len(parts))


@dataclass(frozen=True)
class RayRequest:
    """The arguments of `BoundedRays.rays`."""

    pose_set: PoseBox
    box: ParameterBox
    pixels: np.ndarray
    tolerance: float
    most_alpha: np.ndarray | None
    aim: tuple[np.ndarray, np.ndarray] | None
    shifts: list[Shifts]

    def take(self, which: np.ndarray) -> RayRequest:
        """Return the request for the rays numbered ``which``."""
        most_alpha = None if self.most_alpha is None else self.most_alpha[which]
        aim = None if self.aim is None else (self.aim[0][which], self.aim[1][which])
        return replace(self, pixels=self.pixels[which], most_alpha=most_alpha, aim=aim)


class BoundedRays(ABC):
    """Bounds of a field's rays over boxes of poses.

    Attributes:
        displacement: Half the motion of a sample over a first cell, as learned from earlier rays.
        distances, lengths: [samples] distances, and lengths of bins around them.
    """

    displacement: float
    distances: np.ndarray
    lengths: np.ndarray
    taylor: int

    @property
    @abstractmethod
    def compiled(self) -> bool:
        """Whether compiled kernels bound rays, a few at a time."""

    @abstractmethod
    def division(self, moves: np.ndarray, most_parts: int = ..., deeper: int | None = None) -> Division | None:
        """Return the cells of a box, as wide as is suitable for the field's bounds; None: the box is too wide.

        Args:
            moves: [n, samples, d] motion of samples along each parameter.
            deeper: Halvings of the first cells; None: as usual.
        """

    def rays(
        self,
        pose_set: PoseBox,
        box: ParameterBox,
        pixels: np.ndarray,
        tolerance: float,
        most_alpha: np.ndarray | None = None,
        aim: tuple[np.ndarray, np.ndarray] | None = None,
        shifts: list[Shifts] | None = None,
        division: Division | None = None,
    ) -> RayBounds:
        """Return bounds of the colours of ``pixels`` [n, 2] over every pose of ``box``.

        Args:
            tolerance: Change of a pixel by a sample's open opacity or colour above which its cells are halved.
            most_alpha: [n, samples] upper bounds of opacities over a larger box.
            aim: [n, 3] lower and upper colours; bounds between them are tight enough (before the shifts).
            shifts: Intervals of hue and saturation that are added to all colours; bounds hold over all of them.
            division: The cells, in place of those that suit the rays; bounds are then kept by part.
        """
        return self.bounded(RayRequest(pose_set, box, pixels, tolerance, most_alpha, aim, shifts or []), division)

    @abstractmethod
    def bounded(self, request: RayRequest, division: Division | None) -> RayBounds:
        """Return bounds of the requested rays; see `rays`."""


class RayField(BoundedRays):
    """A scene's field along the rays of a sampling, and its bounds.

    Args:
        sampling: Uniform, or hierarchical: bounded where the coarse pass puts samples (docs/dev/design.md, F16), or
            wherever they may be (F10, F14).
        compiled: Whether compiled kernels are used; None: where ``device`` is a CPU.
        white: The samples that are white, the others black, in place of the field's colours; None: the latter. For
            uniform samples alone.
    """

    def __init__(
        self,
        scene: NerfScene,
        sampling: Sampling,
        dimensions: int,
        device: torch.device | str = "cpu",
        compiled: bool | None = None,
        white: WhiteSamples | None = None,
    ) -> None:
        self.white = white
        self.sampling, self.device = sampling, torch.device(device)
        self.swept = sampling.kind == "hierarchical"
        self.basis = basis_of(dimensions + self.swept, scene.fine)
        self.field = FieldBounds(scene.fine, self.basis, device=device, compiled=compiled)
        #: Cells bounded at once.
        self.batch = _BATCH if self.field.compiled else cells_at_once(scene.fine, self.basis)
        self.occupancy = scene.occupancy
        self.distances, self.lengths = sampling.bins
        #: Samples that the coarse pass places.
        self.paths = None
        if self.swept:
            coarse = FieldBounds(scene.coarse, basis_of(dimensions, scene.coarse), device=device, compiled=compiled)
            self.paths = SamplePaths(coarse, self.field, sampling, scene.occupancy, self.batch)
        self.taylor = min(TAYLOR, max(1, self.basis.degree))
        #: Where to begin to look for `RayBounds.displacement`.
        self.displacement = RAY_TUNING.displacement if self.paths is None else RAY_TUNING.followed

    @property
    def compiled(self) -> bool:
        """Whether compiled kernels bound the field."""
        return self.field.compiled
