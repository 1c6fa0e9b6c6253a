"""Parts of command lines, each declared once where it is used; tyro puts their options beside the command's own."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Annotated, Any

import tyro

from ns_abstract.execution.engine_options import EngineOptions
from ns_abstract.methods.overrides import Overrides
from ns_abstract.methods.program_options import ProgramOptions

_BESIDE = tyro.conf.arg(name="")
#: What the user says of the scene in place of its files.
SceneOverrides = Annotated[Overrides, _BESIDE, tyro.conf.FlagCreatePairsOff]
#: The program that draws the scene.
Program = Annotated[ProgramOptions, _BESIDE]
#: Where the work is done.
Where = Annotated[EngineOptions, _BESIDE]


def stated(options: Any) -> dict[str, Any]:
    """All options of a command by name, as reports state them."""
    options_by_name: dict[str, Any] = {}
    for entry in fields(options):
        value = getattr(options, entry.name)
        options_by_name |= stated(value) if is_dataclass(value) else {entry.name: value}
    return options_by_name
