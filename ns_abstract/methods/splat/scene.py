"""A trained Gaussian-splat scene as plain arrays, independent of where it came from."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ns_abstract.geometry.transform import DataparserTransform
from ns_abstract.io.assumptions import Assumption

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]


@dataclass(frozen=True)
class SplatScene:
    """The parameters of N Gaussians as stored, before activation.

    Frames and units: world is the run's normalised frame; ``log_scales`` are natural logarithms of standard deviations
    in that frame.

    Attributes:
        means: [N, 3] float32, world.
        log_scales: [N, 3] float32.
        quats: [N, 4] float32, (w, x, y, z), not necessarily of unit length.
        opacity_logits: [N] float32.
        sh: [N, K, 3] float32 spherical-harmonics coefficients, K = (degree + 1)^2, band 0 first; for ``color_model``
            "sigmoid" K = 1 and holds logits.
        color_model: "sh" (0.5 + SH, clamped below at 0) or "sigmoid" (nerfstudio trained with ``sh_degree`` 0).
        sh_degree: Degree evaluated at render time (0 to 3).
        rasterize_mode: "classic" or "antialiased" (opacity compensation).
        background: [3] float32 RGB shown where nothing is opaque.
        dataparser: Units of the training data relative to the normalised frame.
        dropped: Count of stored Gaussians that gsplat can never draw, by reason.
        stored: [N] numbers of the Gaussians in the source, ascending, where some were dropped; else None.
        notes: Sentences on what was assumed where the source does not say.
        assumptions: Choices that affect the picture, and where each came from.
        gaussians_alone: Whether the run's model draws more than these Gaussians, so that bounds are of them alone.
    """

    means: Float32Array
    log_scales: Float32Array
    quats: Float32Array
    opacity_logits: Float32Array
    sh: Float32Array
    color_model: Literal["sh", "sigmoid"] = "sh"
    sh_degree: int = 0
    rasterize_mode: Literal["classic", "antialiased"] = "classic"
    background: Float32Array = field(default_factory=lambda: np.zeros(3, np.float32))
    dataparser: DataparserTransform = field(default_factory=DataparserTransform)
    name: str = "scene"
    source: str = ""
    dropped: dict[str, int] = field(default_factory=dict)
    stored: NDArray[np.int64] | None = None
    notes: tuple[str, ...] = ()
    assumptions: tuple[Assumption, ...] = ()
    gaussians_alone: bool = False

    def __post_init__(self) -> None:
        n = self.means.shape[0]
        k = (self.sh_degree + 1) ** 2
        expected = {
            "means": (n, 3),
            "log_scales": (n, 3),
            "quats": (n, 4),
            "opacity_logits": (n,),
            "sh": (n, k, 3),
            "background": (3,),
        }
        for name, shape in expected.items():
            array = getattr(self, name)
            if array.shape != shape or array.dtype != np.float32:
                raise ValueError(f"{name}: expected float32 {shape}, got {array.dtype} {array.shape}")

    @property
    def count(self) -> int:
        """Number of Gaussians N."""
        return self.means.shape[0]
