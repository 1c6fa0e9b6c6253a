"""Lets torchvision's wheel for CUDA be imported beside a PyTorch without CUDA.

The wheels of torchvision on PyPI are built for CUDA. Beside a CPU build of PyTorch their library of
operators does not load, which torchvision allows for, except that ``torchvision/_meta_registrations.py``
describes two of them without asking. Declaring these two is enough; they have no kernels, so that
calling them is an error. nerfstudio calls neither.

Nothing is declared unless `declare_missing` is called: `ns-abstract-viewer` and ``python -m ns_abstract.nerfstudio``
do so before they import nerfstudio.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

_SCHEMAS = (
    "nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor",
    "qnms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor",
)
#: Keeps the declarations alive.
_declared: list[Any] = []


def autoload() -> None:
    """Do nothing.

    Editable installs of version 0.1 and before tell PyTorch to call this function; without it, every
    ``import torch`` in their environment would fail.
    """


def declare_missing() -> None:
    """Declare torchvision's two operators if this PyTorch has no CUDA and torchvision's own library does not load."""
    import torch

    if _declared or torch.version.cuda is not None or "torchvision" in sys.modules:
        return
    spec = importlib.util.find_spec("torchvision")
    if spec is None or spec.origin is None:
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
