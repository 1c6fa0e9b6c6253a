"""The common parts of the loaders of both kinds of fields: model class, tensors, background, and records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ns_abstract.geometry.transform import DataparserTransform
from ns_abstract.io.assumptions import Assumption
from ns_abstract.io.errors import InputError, visible
from ns_abstract.io.jsonio import show
from ns_abstract.methods import runs
from ns_abstract.methods.checkpoint import to_float32
from ns_abstract.methods.overrides import Overrides, assumption_of

#: nerfstudio/model_components/renderers.py:75-145, utils/colors.py: what it shows outside training; at others, also
#: of another case, it stops.
_BACKGROUNDS = {
    "random": (0.0, 0.0, 0.0),
    "white": (1.0, 1.0, 1.0),
    "black": (0.0, 0.0, 0.0),
    "red": (1.0, 0.0, 0.0),
    "green": (0.0, 1.0, 0.0),
    "blue": (0.0, 0.0, 1.0),
}
LAST_SAMPLE = "last_sample"
_IDLE = runs.IDLE_MODULES
_SHOWN = 8
_SPLATS = ("rasterize_mode", "assume_splatfacto", "drop_nan_gaussians")


class ModelState(dict[str, Any]):
    """A model's state in a checkpoint, which records the tensors that were read; ``fix``: advice for its errors."""

    def __init__(self, state: Mapping[str, Any], checkpoint: Path, fix: str) -> None:
        super().__init__(state)
        self.checkpoint, self.fix = checkpoint, fix
        self.read: set[str] = set()

    def __getitem__(self, key: str) -> Any:
        self.read.add(key)
        return super().__getitem__(key)

    def refused(self, problem: str, key: str, fix: str | None = None) -> InputError:
        """Return the error of the tensor ``key``."""
        return InputError(problem, file=self.checkpoint, field=_name(key), fix=fix or self.fix)

    def refuse_unread(self, method: str) -> None:
        """Raise InputError that names the tensors that were not read and may change the picture."""
        unknown = sorted(key for key in self if key not in self.read and not key.startswith(tuple(_IDLE)))
        if unknown:
            more = f" and {len(unknown) - _SHOWN} more" if len(unknown) > _SHOWN else ""
            raise InputError(
                f"holds tensors that {method} does not have: {visible(', '.join(unknown[:_SHOWN]))}{more}",
                file=self.checkpoint,
                field="pipeline",
                fix=self.fix,
            )

    def float32(self, key: str) -> NDArray[np.float32]:
        """Return a tensor, which must be there."""
        if key not in self:
            raise self.refused("missing", key)
        return to_float32(self[key], self.checkpoint, _name(key))

    def linear(self, key: str) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return weight [out, in] and bias [out] of a linear layer."""
        weight, bias = self.float32(f"{key}.weight"), self.float32(f"{key}.bias")
        if weight.ndim != 2 or 0 in weight.shape or bias.shape != weight.shape[:1]:
            raise self.refused(
                f"shapes {list(weight.shape)} and {list(bias.shape)} are not those of a linear layer", key
            )
        return weight, bias


def _name(key: str) -> str:
    return f"pipeline._model.{key}"


def check_model(run: runs.RunConfig, overrides: Overrides, classes: Sequence[str], method: str, fix: str) -> None:
    """Refuse options of splats, and model classes whose picture may not be that of ``method``."""
    overrides.refuse(_SPLATS, "is for splats, this run is a NeRF")
    target = runs.target_class(run)
    if target and target not in classes:
        raise InputError(
            f"names the model class {show(target)}, which may draw another picture than {method}",
            file=run.file,
            field="pipeline.model._target",
            fix=fix,
        )


def background(run: runs.RunConfig, overrides: Overrides, default: str) -> tuple[Assumption, NDArray[np.float32] | str]:
    """Return the record of the background's choice, and its colour [3] or `LAST_SAMPLE`.

    ``run``: its ``background_color`` is read. ``overrides``: its ``background`` comes first. Raises InputError: no such
    background.
    """
    named, origin = "background_color" in run.model, "config.yml: pipeline.model.background_color"
    stored: Any = LAST_SAMPLE
    if str(run.model.get("background_color", default)).lower() != LAST_SAMPLE:
        stored = tuple(float(part) for part in run.color("background_color", default, _BACKGROUNDS))
        if named and not isinstance(run.model["background_color"], str):
            origin += ", three numbers, at which Nerfstudio's own model stops"
    override = overrides.background
    record = assumption_of(
        "background", override, "--background", stored, origin if named else "default of nerfstudio 1.1.5"
    )
    chosen = stored if override is None else override
    return record, chosen if isinstance(chosen, str) else np.array(chosen, np.float32)


def records(
    run: runs.RunConfig,
    state: ModelState,
    overrides: Overrides,
    stock: str,
    transform: DataparserTransform,
    assumed_units: bool,
) -> tuple[Assumption, ...]:
    """Return records of the step, class, modules and units, and where each choice came from.

    Args:
        stock: Nerfstudio's own class, where config.yml names none.
        assumed_units: Whether ``transform`` is a default.
    """
    target = runs.target_class(run)
    whose = "config.yml: pipeline.model._target" if target else "default: config.yml names no class"
    return (
        runs.step_assumption(run, state.checkpoint, overrides.load_step),
        Assumption("model", target or stock.rpartition(".")[2], whose),
        *runs.idle_assumptions(state, _IDLE),
        runs.units_assumption(transform, assumed_units),
    )
