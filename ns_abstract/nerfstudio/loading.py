"""What stands between nerfstudio 1.1.5 and opening a run on a machine without CUDA or network."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from nerfstudio.utils.rich_utils import CONSOLE
from torchmetrics.functional.image import lpips as lpips_module


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
        found = original(net, False)
        for parameter in found.parameters():
            parameter.data.zero_()
        return found

    lpips_module._get_tv_model_features = features
    try:
        yield
    finally:
        lpips_module._get_tv_model_features = original


def lpips_known(metric: torch.nn.Module) -> bool:
    """Whether an LPIPS metric has weights."""
    return any(bool(parameter.any()) for name, parameter in metric.named_parameters() if "slice1" in name)
