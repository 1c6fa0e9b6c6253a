"""Lets torchvision's wheel for CUDA be imported beside a PyTorch without CUDA.

The wheels of torchvision on PyPI are built for CUDA. Beside a CPU build of PyTorch their library of
operators does not load, which torchvision allows for, except that ``torchvision/_meta_registrations.py``
describes two of them without asking. Declaring these two is enough; they have no kernels, so that
calling them is an error. nerfstudio calls neither.

PyTorch calls `autoload` at the end of ``import torch`` (entry point ``torch.backends``;
TORCH_DEVICE_BACKEND_AUTOLOAD=0 switches that off), so nerfstudio's own commands profit as well.
"""

from __future__ import annotations

import importlib.util
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

_SCHEMAS = (
    "nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor",
    "qnms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor",
)
#: Keeps the declarations alive.
_declared: list[Any] = []


class _Watch:
    """Looks at torchvision right before it is imported, and at nothing else."""

    def find_spec(self, name: str, path: Any = None, target: ModuleType | None = None) -> ModuleSpec | None:
        if name == "torchvision":
            sys.meta_path.remove(self)
            declare_missing()
        return None


def autoload() -> None:
    """Watch for the import of torchvision if this PyTorch has no CUDA."""
    import torch

    if torch.version.cuda is None and "torchvision" not in sys.modules:
        sys.meta_path.insert(0, _Watch())


def declare_missing() -> None:
    """Declare torchvision's two operators unless its own library does."""
    import torch

    spec = importlib.util.find_spec("torchvision")
    if _declared or spec is None or spec.origin is None:
        return
    for library in Path(spec.origin).parent.glob("_C*.so"):
        try:
            torch.ops.load_library(str(library))
            return
        except OSError:
            continue
    fragment = torch.library.Library("torchvision", "FRAGMENT")
    for schema in _SCHEMAS:
        fragment.define(schema)
    _declared.append(fragment)
