"""The common content of every report.json: the bounded scene, the guarantee, and the program versions."""

from __future__ import annotations

import importlib.metadata
import math
import os
import platform
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.io.assumptions import Assumption
from ns_abstract.io.version import VERSION as PACKAGE

#: Of the format of report.json.
VERSION = 1

_PROGRAMS = {"gsplat": "gsplat's formulas give", "paper": "the paper's Algorithm 1 gives"}


def guarantee_text(guarantee: str, renderer: str = "gsplat", bounded: str | None = None) -> str:
    """Return the text of a guarantee, as the end of a sentence about an abstract image.

    ``guarantee``: "float32-sound", "real-sound" or "sampled". ``bounded``: what of the scene is bounded, such as "of
    the Gaussians alone"; None: all of it. Raises ValueError where the guarantee is not one of the three.
    """
    program = _PROGRAMS.get(renderer, f"{renderer} gives")
    texts = {
        "float32-sound": f"encloses the image that {program} in real numbers and in every float32 evaluation "
        "with CUDA fast-math error constants",
        "real-sound": "encloses the real-number renderer and this package's float64 evaluation",
        "sampled": "is not a guarantee: it holds only the images that were rendered",
    }
    if guarantee not in texts:
        raise ValueError(f"guarantee {guarantee!r} is not one of {', '.join(texts)}")
    if bounded is None or guarantee == "sampled":
        return texts[guarantee]
    return f"{texts[guarantee]}, {bounded}: the run's model may draw more, of which nothing is said"


def plain(value: Any) -> Any:
    """Return ``value`` as strict JSON: tuples and arrays as lists, paths as text, NaN and infinity as null.

    Raises:
        TypeError: A value has no JSON form.
    """
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, (np.generic, np.ndarray)):
        return plain(value.tolist())
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    raise TypeError(f"{type(value).__name__} has no JSON form")


def sides(
    box: ParameterBox, parameters: Sequence[tuple[str, str]] | None = None, fixed: Mapping[str, float] | None = None
) -> list[dict[str, Any]]:
    """Return name, unit, lower and upper end of every parameter of a box, as report.json has them.

    ``parameters``: names and units to list; None: the box's own. A parameter that the box lacks has its value in
    ``fixed``, or 0.
    """
    ends = dict(zip(box.names, zip(box.lower, box.upper, strict=True), strict=True))
    named = zip(box.names, box.units, strict=True) if parameters is None else parameters
    entries = ((name, unit, *ends.get(name, ((fixed or {}).get(name, 0.0),) * 2)) for name, unit in named)
    return [dict(zip(("name", "unit", "lower", "upper"), entry, strict=True)) for entry in entries]


@cache
def versions() -> dict[str, str | None]:
    """Return versions of the programs that computed the bounds; None where a package has no metadata."""
    packages: dict[str, str | None] = {"python": platform.python_version(), "machine": platform.machine()}
    packages["ns-abstract"] = PACKAGE
    for name in ("numpy", "numba"):
        try:
            packages[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            packages[name] = None
    return packages


def now() -> str:
    """Return the UTC time as ISO 8601."""
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())


@dataclass(frozen=True, kw_only=True)
class CommandRun:
    """A command's run, as every report.json describes it; all mappings must have a JSON form (see `plain`).

    Attributes:
        guarantee: "float32-sound", "real-sound" or "sampled", of the images.
        renderer: ``name`` and ``version`` of the bounded program.
        scene: ``name``, and whatever describes the scene (source, number of Gaussians, ...).
        fingerprint: Whatever changes the results: scene file (`file_stamp`), camera path, perturbation, renderer,
            arithmetic, network. Results are mixed only where it is the same. Effort (time budget, target ratio,
            seed) does not belong here.
        plan: What was left out for this scene and why, one sentence each.
        limits: Further conditions on the guarantee, one sentence each.
        assumptions: What the results rest on, and where each choice came from.
        started: When the command began.
    """

    guarantee: str
    renderer: Mapping[str, Any]
    scene: Mapping[str, Any]
    fingerprint: Mapping[str, Any]
    settings: Mapping[str, Any]
    command: tuple[str, ...] = ()
    plan: tuple[str, ...] = ()
    limits: tuple[str, ...] = ()
    assumptions: tuple[Assumption, ...] = ()
    started: str = field(default_factory=now)

    @classmethod
    def of(cls, job: Any, settings: Mapping[str, Any], command: tuple[str, ...], **more: Any) -> CommandRun:
        """Return the run of a command that searches the sets of a job; ``more`` replaces the job's values."""
        told = {
            "guarantee": job.method.guarantee,
            "renderer": {name: job.method.program[name] for name in ("name", "version")},
            "scene": job.describe(),
            "assumptions": job.assumptions,
            "plan": job.plan,
        }
        return cls(settings=settings, command=command, **(told | more))

    def head(self) -> dict[str, Any]:
        """Return the first keys of report.json: format, guarantee, renderer, scene, assumptions."""
        name = str(self.renderer.get("name", ""))
        return {
            "version": VERSION,
            "guarantee": self.guarantee,
            "guarantee_text": guarantee_text(self.guarantee, name, self.scene.get("bounded")),
            "renderer": self.renderer,
            "scene": self.scene,
            "assumptions": [vars(entry) for entry in self.assumptions],
        }

    def tail(self, state: str, metrics: Mapping[str, str]) -> dict[str, Any]:
        """Return the last keys of report.json; ``state``: "running", "done", "budget" or "interrupted"."""
        return {
            "plan": self.plan,
            "state": state,
            "metrics": metrics,
            "settings": self.settings,
            "fingerprint": self.fingerprint,
            "command": self.command,
            "packages": versions(),
            "started": self.started,
            "updated": now(),
        }


def _leaves_of(value: Any, path: str = "") -> dict[str, Any]:
    """Return the leaves of a JSON tree by their dotted paths."""
    if isinstance(value, dict) and (value or not path):
        leaves: dict[str, Any] = {}
        for key, item in value.items():
            leaves |= _leaves_of(item, f"{path}.{key}" if path else str(key))
        return leaves
    return {path: value}


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Return the dotted paths at which two JSON trees differ."""
    first, second = _leaves_of(plain(old)), _leaves_of(plain(new))
    absent = object()
    return [key for key in {**first, **second} if first.get(key, absent) != second.get(key, absent)]
