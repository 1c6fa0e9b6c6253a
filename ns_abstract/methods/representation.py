"""The entry point of a scene representation: one `Representation` per folder of `ns_abstract.methods`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ns_abstract.io.errors import InputError
from ns_abstract.methods.overrides import Overrides
from ns_abstract.methods.runs import RunConfig
from ns_abstract.refine.protocol import Method


@dataclass(frozen=True)
class ProgramOptions:
    """Options of the program that renders the scene; None: the representation's default.

    Attributes:
        renderer: "gsplat" or "paper".
        sampling: "uniform" or "hierarchical" (NeRF).
        num_samples: Bins of every ray (NeRF).
        near_plane: Start of the rays, normalised units (NeRF).
        occupancy_grid: File of a grid that is declared as part of the scene (NeRF).
        gsplat_version: Whose rules draw splats, of `VERSIONS`; None: 1.4.0.
        device: Where the field is bounded, "cpu" or "cuda" (NeRF); None: "cpu".
    """

    renderer: str | None = None
    sampling: str | None = None
    num_samples: int | None = None
    near_plane: float | None = None
    occupancy_grid: Path | None = None
    gsplat_version: str | None = None
    device: str | None = None

    def refuse(self, names: tuple[str, ...], problem: str) -> None:
        """Refuse options of other representations.

        Raises:
            InputError: One of ``names`` is given.
        """
        for name in names:
            if getattr(self, name) is not None:
                raise InputError(problem, field="--" + name.replace("_", "-"), fix="leave it out")


@dataclass(frozen=True)
class Representation:
    """One way to represent scenes.

    Attributes:
        reads: Whether a scene file (config.yml, already parsed, or another file's path) is of this kind.
        load: Reads it, with what the user says in place of its files.
        method: The scene with the program that is bounded: scene, options, arithmetic ("float32", "real" or None: the
            strongest there is) and number of processes that may be used.
        rays: Whether pictures are made ray by ray, each at a cost: frames are then of the kind
            `ns_abstract.refine.protocol.RayFrame` and use several processes themselves.
    """

    reads: Callable[[RunConfig | Path], bool]
    load: Callable[[RunConfig | Path, Overrides], Any]
    method: Callable[[Any, ProgramOptions, str | None, int], Method]
    rays: bool = False
