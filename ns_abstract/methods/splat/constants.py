"""The constants of the splat rasterisers that can be bounded, keyed by name and version."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: Tile side where the rasteriser itself has no tiles.
WORK_TILE = 16


@dataclass(frozen=True)
class Rasteriser:
    """Rules of one rasteriser. File names are those of gsplat's ``cuda/csrc``.

    Attributes:
        near, far: Depths kept, both ends included (fully_fused_projection_fwd.cu:73).
        eps2d: Added to the diagonal of the projected covariance, square pixels (utils.cuh, add_blur).
        tile_size: Pixels on a tile's side; 0: every Gaussian reaches every pixel.
        radius_sigmas: Radius in standard deviations of the longest axis
            (fully_fused_projection_fwd.cu:165-167).
        discriminant_min: Lower clamp under the root of the larger eigenvalue (same lines).
        view_margin: The Jacobian is evaluated at most this fraction of the half field of view
            outside the image (utils.cuh:267-277); negative: no clamp.
        alpha_min: Smaller alphas are skipped (rasterize_to_pixels_fwd.cu).
        alpha_max: Larger alphas are lowered to it.
        transmittance_min: The Gaussian that would bring the transmittance to this or below is not
            drawn, nor is any behind it; negative: there is no stop.
        background: Whether the scene's background shows through (else black).
        view_dependent: Whether colours use spherical harmonics beyond band 0.
        alpha_negligible: Numerical cut-off where ``alpha_min`` is 0; what it drops is bounded and
            added to the result.
    """

    name: str
    version: str
    near: float = 0.01
    far: float = 1e10
    eps2d: float = 0.3
    tile_size: int = 16
    radius_sigmas: float = 3.0
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
        """Side of the tiles that pictures are computed in."""
        return self.tile_size or WORK_TILE


#: What nerfstudio 1.1.5 pins (pyproject.toml, ``gsplat==1.4.0``).
GSPLAT_1_4_0 = Rasteriser("gsplat", "1.4.0")

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
    alpha_negligible=2.0**-40,
)

RASTERISERS = {"gsplat": GSPLAT_1_4_0, "paper": PAPER}


def rules_array(rasteriser: Rasteriser) -> np.ndarray:
    """The rasteriser's constants in the order the kernels expect."""
    r = rasteriser
    alpha_min = r.alpha_min if r.alpha_min > 0.0 else r.alpha_negligible
    return np.array(
        [
            r.near, r.far, r.eps2d, float(r.tile_size), r.radius_sigmas, r.discriminant_min, r.view_margin,
            alpha_min, r.alpha_max, r.transmittance_min, float(r.work_tile),
        ]
    )  # fmt: skip
