"""The demo's NeRF: a buoy on a round float, from weights that `benchmarks/fit_buoy.py` fitted."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ns_abstract.demo.nerf_fit import NerfNetwork
from ns_abstract.geometry.views import View, look_at, path_json
from ns_abstract.io.errors import InputError
from ns_abstract.methods.nerf.scene import NerfScene

#: Part of the package.
WEIGHTS = Path(__file__).with_name("buoy.npz")
_FIX = "install the package again"


def load_network(file: Path = WEIGHTS) -> NerfNetwork:
    """The fitted network of Nerfstudio's own size (8 x 256).

    Args:
        file: Holds every parameter by its name: float32, or for matrices int8 beside ``NAME.scale`` [rows, 1] float32.

    Raises:
        InputError: The file cannot be read, or an array is missing, has another type or shape, or is not finite.
    """
    network = NerfNetwork()
    state: dict[str, Tensor] = {}
    try:
        with np.load(file, allow_pickle=False) as arrays:
            for name, parameter in network.state_dict().items():
                values, shape = arrays[name], tuple(parameter.shape)
                matrix = len(shape) == 2
                _check(file, name, values, shape, np.int8 if matrix else np.float32)
                if matrix:
                    scale = arrays[f"{name}.scale"]
                    _check(file, f"{name}.scale", scale, (shape[0], 1), np.float32)
                    values = values * scale
                state[name] = torch.from_numpy(values)
    except InputError:
        raise
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"cannot be read ({error})", file=file, fix=_FIX) from None
    network.load_state_dict(state)
    return network


def _check(file: Path, name: str, values: np.ndarray, shape: tuple[int, ...], kind: type) -> None:
    if values.dtype != kind or values.shape != shape:
        raise InputError(
            f"{values.dtype}{list(values.shape)}, not {kind.__name__}{list(shape)}", file=file, field=name, fix=_FIX
        )
    if not np.isfinite(values).all():
        raise InputError("not finite", file=file, field=name, fix=_FIX)


def buoy_scene() -> NerfScene:
    """A NeRF of Nerfstudio's own size (8 x 256) that shows the buoy."""
    weights = load_network().weights()
    return NerfScene(weights, weights, background=np.array([1.0, 1.0, 1.0], np.float32), name="buoy")


def buoy_views(count: int = 8, size: int = 64) -> list[View]:
    """Views all around the buoy for the data set beside the run."""
    angles = 2.0 * np.pi * np.arange(count) / count
    eyes = [(3.2 * np.cos(a), 3.2 * np.sin(a), 1.2) for a in angles]
    return [View(look_at(eye, (0.0, 0.0, 0.1)), 40.0, size, size) for eye in eyes]


def buoy_path(size: int = 16) -> dict[str, Any]:
    """One small view of the buoy, and a yaw of 0.002 rad either way."""
    view = View(look_at((2.6, -1.8, 1.2), (0.0, 0.0, 0.1)), 40.0, size, size)
    return path_json([view], seconds=1.0, perturbation={"version": 1, "rotation": {"yaw": 0.002}})
