"""Sets of poses that a command line gives without a file; importing it needs no numpy, as --help must not."""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from ns_abstract.execution.engine_options import EngineOptions
from ns_abstract.io.errors import InputError
from ns_abstract.methods.overrides import Overrides
from ns_abstract.methods.program_options import ProgramOptions

#: Keys of a perturbation file, in the order of the options' numbers.
_AXES = {"translation": ("x", "y", "z"), "rotation": ("yaw", "pitch", "roll")}
_BESIDE = tyro.conf.arg(name="")
#: What the user says of the scene in place of its files.
SceneOverrides = Annotated[Overrides, _BESIDE, tyro.conf.FlagCreatePairsOff]
#: The program that draws the scene.
Program = Annotated[ProgramOptions, _BESIDE]
#: Where the work is done.
Where = Annotated[EngineOptions, _BESIDE]


@dataclass(kw_only=True)
class GivenSet:
    """Options of commands that take a set of poses."""

    perturbation_filename: Path | None = None
    """Set of poses (JSON). Default: the key "perturbation" of the camera path."""
    translation: tuple[float, ...] | None = None
    """Largest shift, in place of a file: one number for all three axes of the camera, or three for x, y, z."""
    rotation: tuple[float, ...] | None = None
    """Largest turn, in place of a file: one number for all three angles, or three for yaw, pitch, roll."""
    units: Literal["normalised", "dataset"] = "normalised"
    """Units of --translation: those of the run's normalised frame, or of transforms.json."""
    angle_units: Literal["radians", "degrees"] = "radians"
    """Units of --rotation."""


def given_set(options: GivenSet) -> dict[str, Any] | None:
    """Return the set of --translation and --rotation as the content of a perturbation file, or None.

    Raises:
        InputError: They do not go together, or with other options.
    """
    if options.translation is None and options.rotation is None:
        return None
    if options.perturbation_filename is not None:
        field = "--translation" if options.translation is not None else "--rotation"
        raise InputError("given beside --perturbation-filename", field=field, fix="give one of them")
    perturbation: dict[str, Any] = {"version": 1, "units": options.units, "angle_units": options.angle_units}
    for name, axes in _AXES.items():
        radii = getattr(options, name)
        if radii is None:
            continue
        if len(radii) not in (1, 3):
            fix = f"give one number for all, or three for {', '.join(axes)}"
            raise InputError(f"found {len(radii)} numbers", field=f"--{name}", fix=fix)
        perturbation[name] = dict(zip(axes, radii if len(radii) == 3 else radii * 3, strict=True))
    return perturbation


def stated(options: Any) -> dict[str, Any]:
    """Return all options of a command by name, in the form of reports."""
    options_by_name: dict[str, Any] = {}
    for entry in fields(options):
        value = getattr(options, entry.name)
        options_by_name |= stated(value) if is_dataclass(value) else {entry.name: value}
    return options_by_name
