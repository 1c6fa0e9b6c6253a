"""Which program draws a scene, as users say it; importing this is quick, as ``--help`` must be."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import unusable


@dataclass(frozen=True)
class ProgramOptions:
    """Which program draws the scene; None: the representation's own choice."""

    renderer: Literal["gsplat", "paper"] | None = None
    """gsplat: what Nerfstudio shows of splats (the default for them). paper: Algorithm 1 (splats: no thresholds,
    RGB) or 2 (NeRF: black behind the last sample) of "Abstract Rendering"."""
    gsplat_version: Literal["1.4.0", "1.5.3", "1.6.0"] | None = None
    """Splats: whose rules are bounded. Default: 1.4.0, which nerfstudio 1.1.5 asks for."""
    sampling: Literal["uniform", "hierarchical"] | None = None
    """NeRF. uniform (default): the fine field in the middles of equal bins. hierarchical: Nerfstudio's own picture,
    its samples followed where the coarse pass puts them."""
    num_samples: int | None = None
    """NeRF: bins of every ray. Default: 64."""
    near_plane: float | None = None
    """NeRF: distance at which rays start. Default: 0, as in Nerfstudio's evaluation."""
    occupancy_grid: Path | None = None
    """NeRF: declare the field empty outside of this grid's occupied voxels (.npz, see ns-abstract-export occupancy).
    That makes it another scene, for which the bounds hold."""
    device: Literal["cpu", "cuda"] | None = None
    """NeRF. cuda: bound the field on a GPU, in float64. Default: cpu."""

    def __post_init__(self) -> None:
        for name in ("renderer", "gsplat_version", "sampling", "device"):
            value = getattr(self, name)
            if value is not None and not isinstance(value, str):
                raise unusable(value, field="--" + name.replace("_", "-"), fix="give a text, or leave it out")

    def refuse(self, names: tuple[str, ...], problem: str) -> None:
        """Refuse options of other representations. Raises InputError where one of ``names`` is given."""
        for name in names:
            if getattr(self, name) is not None:
                raise InputError(problem, field="--" + name.replace("_", "-"), fix="leave it out")
