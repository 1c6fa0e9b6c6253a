"""The entry point of a scene representation: one `Representation` per folder of `ns_abstract.methods`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ns_abstract.methods.overrides import Overrides
from ns_abstract.methods.program_options import ProgramOptions
from ns_abstract.methods.runs import RunConfig
from ns_abstract.refine.protocol import Method


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
