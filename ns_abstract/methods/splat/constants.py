"""The constants of the splat rasterisers that can be bounded, keyed by name and version."""

from __future__ import annotations

import importlib.metadata
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ns_abstract.arithmetic.rounding import BOX_ROOM, ELLIPSE_ROOM, NEGLIGIBLE_ALPHA

#: Tile side where the rasteriser itself has no tiles.
WORK_TILE = 16

#: The least accumulation that an expected depth is divided by (rendering.py of gsplat, RGB+ED).
ACCUMULATION_MIN = 1e-10


@dataclass(frozen=True)
class Rasteriser:
    """Rules of one rasteriser. File names are those of gsplat's ``cuda/csrc``.

    Attributes:
        near, far: Depths kept, both ends included (fully_fused_projection_fwd.cu:73).
        eps2d: Added to the diagonal of the projected covariance, square pixels (utils.cuh, add_blur).
        tile_size: Pixels on a tile's side; 0: every Gaussian reaches every pixel.
        radius_sigmas: Radius in standard deviations of the longest axis (fully_fused_projection_fwd.cu:165-167).
        axis_sigmas: From 1.5 on: half-width and half-height of the box that meets tiles, at most this many standard
            deviations along the image's axes, and no more than an opacity above ``alpha_min`` reaches
            (ProjectionEWA3DGSFused.cu:164-184, IntersectTile.cu:55-77); 0: a square of the radius.
        ellipse_tiles: From 1.6 on: tiles are those that the ellipse meets in which alpha reaches ``alpha_min``
            (IntersectTile.cu:84-207, 288-373). In exact arithmetic that changes no picture.
        discriminant_min: Lower clamp under the root of the larger eigenvalue (same lines).
        view_margin: The Jacobian is evaluated at most this fraction of the half field of view
            outside the image (utils.cuh:267-277); negative: no clamp.
        compensation_min: Least factor of the opacity in antialiased mode (Common.h:110).
        eye_from_view: Colours are seen from -R^T t, with the view matrix (R, t), not from the position in its inverse
            (SphericalHarmonics.cuh:40-71).
        alpha_min: Smaller alphas are skipped (rasterize_to_pixels_fwd.cu).
        alpha_max: Larger alphas are lowered to it.
        transmittance_min: The Gaussian that would bring the transmittance to this or below is not drawn, nor is any
            behind it; negative: there is no early termination.
        background: Whether the scene's background shows through (else black).
        view_dependent: Whether colours use spherical harmonics beyond band 0.
        alpha_negligible: Numerical cut-off where ``alpha_min`` is 0; the dropped alphas are bounded and added to the
            result.
    """

    name: str
    version: str
    near: float = 0.01
    far: float = 1e10
    eps2d: float = 0.3
    tile_size: int = 16
    radius_sigmas: float = 3.0
    axis_sigmas: float = 0.0
    ellipse_tiles: bool = False
    compensation_min: float = 0.0
    eye_from_view: bool = False
    discriminant_min: float = 0.01
    view_margin: float = 0.3
    alpha_min: float = 1.0 / 255.0
    alpha_max: float = 0.999
    transmittance_min: float = 1e-4
    background: bool = True
    view_dependent: bool = True
    alpha_negligible: float = 0.0

    @property
    def work_tile(self) -> int:
        """Side of the tiles in which pictures are computed."""
        return self.tile_size or WORK_TILE

    @property
    def tile_room(self) -> float:
        """Roundings, in units, by which an alpha may exceed ``alpha_min`` and yet miss its tile (design.md, G12)."""
        if not self.axis_sigmas:
            return 0.0
        return ELLIPSE_ROOM if self.ellipse_tiles else BOX_ROOM


#: What nerfstudio 1.1.5 pins (pyproject.toml, ``gsplat==1.4.0``).
GSPLAT_1_4_0 = Rasteriser("gsplat", "1.4.0")

GSPLAT_1_5_3 = Rasteriser("gsplat", "1.5.3", axis_sigmas=3.33)

GSPLAT_1_6_0 = Rasteriser(
    "gsplat",
    "1.6.0",
    axis_sigmas=3.33,
    ellipse_tiles=True,
    # a float32: two Gaussians of this alpha meet the stop
    alpha_max=float(np.float32(0.99)),
    compensation_min=float(np.float32(0.005)),
    eye_from_view=True,
)

#: gsplat's rules by version.
VERSIONS = {rules.version: rules for rules in (GSPLAT_1_4_0, GSPLAT_1_5_3, GSPLAT_1_6_0)}

#: Algorithm 1 of "Abstract Rendering" (NeurIPS 2025): RGB colours, no blur, no thresholds, black behind.
#: The paper leaves Gaussians behind the camera open; they are left out by the same near plane.
PAPER = Rasteriser(
    "paper",
    "algorithm-1",
    eps2d=0.0,
    tile_size=0,
    view_margin=-1.0,
    alpha_min=0.0,
    alpha_max=1.0,
    transmittance_min=-1.0,
    background=False,
    view_dependent=False,
    alpha_negligible=NEGLIGIBLE_ALPHA,
)

RASTERISERS = {"gsplat": GSPLAT_1_4_0, "paper": PAPER}

_RELEASES = {(1, 4): GSPLAT_1_4_0, (1, 5): GSPLAT_1_5_3, (1, 6): GSPLAT_1_6_0}


def rasteriser_named(renderer: str | None = None, version: str | None = None) -> Rasteriser:
    """Return the rules of "gsplat" (None) in a version of `VERSIONS` (None: 1.4.0), or of "paper", without versions."""
    if renderer in (None, "gsplat"):
        return VERSIONS[version or GSPLAT_1_4_0.version]
    return RASTERISERS[renderer]


def installed_gsplat() -> Rasteriser:
    """Return the rules of the installed gsplat; those of 1.4.0 without one, or for unknown versions."""
    try:
        numbers = importlib.metadata.version("gsplat").split(".")
        return _RELEASES.get((int(numbers[0]), int(numbers[1])), GSPLAT_1_4_0)
    except (importlib.metadata.PackageNotFoundError, ValueError, IndexError):
        return GSPLAT_1_4_0


class RasterRules(NamedTuple):
    """A `Rasteriser` and a run's mode as kernels take them; lengths in pixels, depths in world units.

    ``tile_size`` 0: every Gaussian reaches every pixel. ``alpha_min`` is the threshold, or the numerical cut-off where
    there is none. Pictures are computed in tiles of the side ``work_tile``. ``antialiased`` tells whether opacity is
    compensated for the blur. ``tile_room``, ``ellipse_tiles``: see `Rasteriser`.
    """

    near: float
    far: float
    eps2d: float
    tile_size: float
    radius_sigmas: float
    discriminant_min: float
    view_margin: float
    alpha_min: float
    alpha_max: float
    transmittance_min: float
    work_tile: int
    compensation_min: float
    tile_room: float
    ellipse_tiles: bool
    antialiased: bool


def raster_rules(rasteriser: Rasteriser, antialiased: bool) -> RasterRules:
    """Return the rasteriser's constants for kernels."""
    r = rasteriser
    alpha_min = r.alpha_min if r.alpha_min > 0.0 else r.alpha_negligible
    return RasterRules(
        near=r.near,
        far=r.far,
        eps2d=r.eps2d,
        tile_size=0.0 if r.axis_sigmas else float(r.tile_size),
        radius_sigmas=r.axis_sigmas or r.radius_sigmas,
        discriminant_min=r.discriminant_min,
        view_margin=r.view_margin,
        alpha_min=alpha_min,
        alpha_max=r.alpha_max,
        transmittance_min=r.transmittance_min,
        work_tile=r.work_tile,
        compensation_min=r.compensation_min,
        tile_room=r.tile_room,
        ellipse_tiles=r.ellipse_tiles,
        antialiased=bool(antialiased),
    )
