"""Work-arounds that let nerfstudio 1.1.5 open a run on a machine without CUDA or network."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.utils.rich_utils import CONSOLE
from torchmetrics.functional.image import lpips as lpips_module

from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import show
from ns_abstract.methods.runs import Tagged

#: Packages whose objects a run may name, by the way of naming them.
_OURS = ("nerfstudio.", "ns_abstract.")
_MODULES = {"name": (*_OURS, "torch.optim."), "object": _OURS, "object/apply": _OURS}
_PYTHON = "tag:yaml.org,2002:python/"
_FUNCTIONS = ("nerfstudio.data.utils.nerfstudio_collate.nerfstudio_collate",)


def allow_numpy_scalars() -> None:
    """Let ``torch.load`` read the numpy scalars that the schedulers of a checkpoint hold.

    nerfstudio calls it without ``weights_only``, which PyTorch since 2.6 takes for true. The names
    allowed here are types and one constructor of plain numbers; nothing in a file can run through them.
    """
    scalar = np._core.multiarray.scalar  # pyright: ignore[reportAttributeAccessIssue]
    kinds = [getattr(np.dtypes, name) for name in np.dtypes.__all__ if name.endswith("DType")]
    torch.serialization.add_safe_globals(
        [(scalar, "numpy.core.multiarray.scalar"), (scalar, "numpy._core.multiarray.scalar"), np.dtype, *kinds]
    )


@contextmanager
def lpips_weights(*, download: bool) -> Iterator[None]:
    """Build LPIPS metrics inside the block without the network where it must be.

    Args:
        download: Whether weights are wanted at all; they are not where a checkpoint brings them.
            Weights that are wanted and cannot be had are zero, see `lpips_known`.
    """
    original = lpips_module._get_tv_model_features

    def features(net: str, pretrained: bool = False) -> torch.nn.Sequential:
        if pretrained and download:
            try:
                return original(net, True)
            except OSError as error:
                CONSOLE.print(f"[yellow]No weights for LPIPS ({error}): the metric is left out.")
        features = original(net, False)
        for parameter in features.parameters():
            parameter.data.zero_()
        return features

    lpips_module._get_tv_model_features = features
    try:
        yield
    finally:
        lpips_module._get_tv_model_features = original


def lpips_known(metric: torch.nn.Module) -> bool:
    """Whether an LPIPS metric has weights."""
    return any(bool(parameter.any()) for name, parameter in metric.named_parameters() if "slice1" in name)


def check_tags(value: Any, file: Path) -> None:
    """Refuse a configuration that names other Python objects than nerfstudio's own runs do.

    nerfstudio reads config.yml with a loader that imports and calls what the file names. What its runs name are classes
    of nerfstudio, of this package and of torch.optim, members of nerfstudio's enumerations, paths, and the function in
    `_FUNCTIONS`. ``value``: what `ns_abstract.methods.runs` has read, without running anything. Raises InputError:
    names the first other object.
    """
    if isinstance(value, Tagged):
        if _is_member(value):
            return
        kind, _, name = value.tag.removeprefix(_PYTHON).partition(":")
        if not _expected(kind, name):
            raise InputError(
                f"names the Python object {show(name or value.tag)} ({kind}); nothing was run",
                file=file,
                fix="open only runs that ns-train wrote; ns-abstract-render reads this file without running anything",
            )
        check_tags(value.value, file)
    elif isinstance(value, dict):
        for key, item in value.items():
            check_tags(key, file)
            check_tags(item, file)
    elif isinstance(value, (list, tuple)):
        for item in value:
            check_tags(item, file)


def _is_member(value: Tagged) -> bool:
    """Whether this is a member of an enumeration as Python 3.11.0 to 3.11.3 write it: ``getattr(Class, "NAME")``."""
    parts = value.value
    if value.tag != f"{_PYTHON}object/apply:builtins.getattr" or not isinstance(parts, list) or len(parts) != 2:
        return False
    owner, member = parts
    if not isinstance(owner, Tagged) or not owner.tag.startswith(f"{_PYTHON}name:") or owner.value != "":
        return False
    name = owner.tag.removeprefix(f"{_PYTHON}name:")
    if not _expected("object/apply", name):
        return False
    module, _, last = name.rpartition(".")
    return isinstance(member, str) and member in getattr(importlib.import_module(module), last).__members__


def _expected(kind: str, name: str) -> bool:
    """Whether a run of nerfstudio may name an object in this way."""
    if kind == "name" and name in _FUNCTIONS:
        return True
    if not name.startswith(_MODULES.get(kind, ())):
        return False
    module, _, last = name.rpartition(".")
    try:
        named_object = getattr(importlib.import_module(module), last)
    except (ImportError, AttributeError, ValueError):
        return False
    if not isinstance(named_object, type):
        return False
    return {"name": True, "object": is_dataclass(named_object), "object/apply": issubclass(named_object, Enum)}[kind]
