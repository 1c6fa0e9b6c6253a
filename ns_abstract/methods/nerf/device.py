"""The device on which fields are bounded: the CPU, or a GPU in float64 (design.md, F15)."""

from __future__ import annotations

import os
from functools import cache

from ns_abstract.io.errors import InputError

#: Makes cuBLAS put float64 products together from products of integers, whose errors are none of float64 sums.
EMULATION = "CUBLAS_EMULATE_DOUBLE_PRECISION"


def check_device(device: str | None) -> str:
    """Return the device on which fields are bounded; "cpu" by default.

    Raises:
        InputError: It is not there, or does not compute in float64.
    """
    if device in (None, "cpu"):
        return "cpu"
    if device != "cuda":
        raise InputError(f"found {device}", field="--device", fix="use cpu or cuda")
    import torch

    if not torch.cuda.is_available():
        raise InputError("PyTorch finds no CUDA device", field="--device", fix="use cpu, or a PyTorch with CUDA")
    if os.environ.get(EMULATION, "0") not in ("", "0"):
        raise InputError("emulated float64 products have no error bound", field=EMULATION, fix="unset it")
    return device


@cache
def processes_that_fit(needed: int, most_processes: int) -> int:
    """Return how many processes, at most ``most_processes``, fit into a GPU's memory at ``needed`` bytes each.

    It is found once, before their memory is taken. Raises InputError where not one fits.
    """
    import torch

    free, _ = torch.cuda.mem_get_info()
    if needed > free:
        raise InputError(
            f"the GPU has {free / 2**30:.1f} GiB free, {needed / 2**30:.1f} GiB may be needed",
            field="--device",
            fix="free some, or use cpu",
        )
    return min(most_processes, free // needed)
