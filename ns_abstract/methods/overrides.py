"""Options that override what a scene's files say, and the origin of each choice."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypedDict

from ns_abstract.io.arguments import array_of, flag
from ns_abstract.io.assumptions import Assumption
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import is_number, unusable

#: How Splatfacto can rasterise.
MODES = ("classic", "antialiased")
_STEP_LIMIT = 10**15


class OverrideKeywords(TypedDict, total=False):
    """The fields of `Overrides` as keyword arguments."""

    rasterize_mode: str | None
    background: Sequence[float] | None
    load_step: int | None
    assume_splatfacto: bool
    drop_nan_gaussians: bool


@dataclass(frozen=True)
class Overrides:
    """What the user says of a scene; None and False leave it to the scene's files."""

    rasterize_mode: Literal["classic", "antialiased"] | None = None
    """Splats: how they are rasterised, in place of what config.yml or the scene's file says."""
    background: tuple[float, float, float] | None = None
    """Red, green and blue from 0 to 1 behind the scene, in place of what the files say, or of black."""
    load_step: int | None = None
    """Training step of the checkpoint. Default: what config.yml says, or else the highest."""
    assume_splatfacto: bool = False
    """Bound the Gaussians alone of a run whose class or modules are not Splatfacto's, and which may draw more."""
    drop_nan_gaussians: bool = False
    """Leave out Gaussians whose values are not finite; the report counts them."""

    def __post_init__(self) -> None:
        mode, color, step = self.rasterize_mode, self.background, self.load_step
        for name in ("assume_splatfacto", "drop_nan_gaussians"):
            object.__setattr__(self, name, flag(getattr(self, name), "--" + name.replace("_", "-")))
        if mode is not None and not (isinstance(mode, str) and mode in MODES):
            raise unusable(mode, field="--rasterize-mode", fix=f"use {' or '.join(MODES)}")
        if color is not None:
            array = None if isinstance(color, list | tuple) else array_of(color)
            parts: list[Any] = list(color) if isinstance(color, list | tuple) else [color]
            parts = parts if array is None else array.ravel().tolist()
            if len(parts) != 3 or not all(is_number(part) and 0 <= part <= 1 for part in parts):
                raise unusable(parts, field="--background", fix="give three numbers from 0 to 1")
            object.__setattr__(self, "background", tuple(float(part) for part in parts))
        if step is not None and (isinstance(step, bool) or not isinstance(step, int) or not 0 <= step < _STEP_LIMIT):
            raise unusable(step, field="--load-step", fix="give the number of a step")

    def refuse(self, names: Iterable[str], problem: str) -> None:
        """Refuse what does not go with the scene. Raises InputError where one of ``names`` is given."""
        for name in names:
            if getattr(self, name) not in (None, False):
                raise InputError(problem, field="--" + name.replace("_", "-"), fix="leave it out")


#: Origin of a choice that a file leaves open.
UNSAID = "default: the file says nothing"


def assumption_of(name: str, requested: object, flag: str, stored: object, origin: str) -> Assumption:
    """Return the record of a choice: an option wins, and the record names what it replaces."""
    if requested is None:
        return Assumption(name, _text(stored), origin)
    return Assumption(name, _text(requested), f"{flag} (in place of {_text(stored)}, {origin})")


def _text(value: object) -> str:
    if isinstance(value, (tuple, list)):
        return " ".join(f"{part:.9g}" for part in value)
    return str(value)
