"""Options that say of a scene what its files do not, or in place of them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated, Literal

import tyro

from ns_abstract.methods.overrides import Overrides


@dataclass(kw_only=True)
class GivenScene:
    """What the user says of the scene."""

    rasterize_mode: Literal["classic", "antialiased"] | None = None
    """Splats: how they are rasterised, in place of what config.yml or a comment of the .ply says."""
    background: tuple[float, float, float] | None = None
    """Red, green and blue from 0 to 1 behind the scene, in place of what config.yml says; for a .ply, of black."""
    load_step: int | None = None
    """Training step of the checkpoint. Default: what config.yml says, or else the highest."""
    assume_splatfacto: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Bound the Gaussians alone of a run whose class or modules are not Splatfacto's, and which may draw more."""
    drop_nan_gaussians: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Leave out Gaussians whose values are not finite; the report counts them."""


def overrides(options: GivenScene) -> Overrides:
    """What the options say of the scene.

    Raises:
        InputError: A value cannot be used.
    """
    return Overrides(**{entry.name: getattr(options, entry.name) for entry in fields(Overrides)})
