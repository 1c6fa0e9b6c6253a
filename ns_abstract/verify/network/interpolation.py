"""Matrices that resize one axis of a map, as ONNX's Resize does."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ns_abstract.arithmetic.network_charges import POLYNOMIAL, POSITION
from ns_abstract.io.errors import InputError


class ResizeAxis(NamedTuple):
    """The interpolation matrix [out, size] along one axis, and bounds of its weights' float32 errors."""

    weight: np.ndarray
    doubt: np.ndarray


def nearest_pixels(size: int, out: int, coordinates: str, nearest: str, ratio: float) -> np.ndarray:
    """Return the input pixels [out] that onnxruntime picks along one axis; it computes positions in float32."""
    half = np.float32(0.5)
    k, scale = np.arange(out, dtype=np.float32), np.float32(ratio)
    if coordinates == "align_corners":
        place = k * np.float32(size - 1) / np.float32(out - 1) if out > 1 else 0.0 * k
    elif coordinates == "asymmetric":
        place = k / scale
    elif coordinates == "pytorch_half_pixel" and out == 1:
        place = 0.0 * k
    else:
        place = (k + half) / scale - half
    # half way from zero, as C rounds
    rounded = np.trunc(place) + np.sign(place) * (np.abs(place - np.trunc(place)) >= half)
    places = {
        "floor": np.floor(place),
        "ceil": np.ceil(place),
        "round_prefer_floor": np.where(place == np.trunc(place) + half, np.floor(place), rounded),
        "round_prefer_ceil": rounded,
    }
    if nearest not in places:
        raise InputError(f"attribute nearest_mode = {nearest} is not supported", fix="use floor")
    return np.clip(places[nearest], 0, size - 1).astype(np.int64)


def interpolation(
    size: int, out: int, mode: str, coordinates: str, nearest: str, scale: float | None, bend: float = -0.75
) -> ResizeAxis:
    """Return the matrix of ONNX's Resize along one axis; ``bend`` is `cubic_coeff_a`."""
    k = np.arange(out, dtype=np.float64)
    ratio = out / size if scale is None else scale
    if coordinates == "align_corners":
        step = (size - 1) / (out - 1) if out > 1 else 0.0
        place = k * step
    elif coordinates == "asymmetric":
        step, place = ratio, k / ratio
    elif coordinates == "pytorch_half_pixel" and out == 1:
        step, place = 0.0, 0.0 * k
    elif coordinates in ("half_pixel", "pytorch_half_pixel"):
        step, place = ratio, (k + 0.5) / ratio - 0.5
    else:
        raise InputError(
            f"attribute coordinate_transformation_mode = {coordinates} is not supported",
            fix="use half_pixel, asymmetric or align_corners",
        )
    matrix, doubt = np.zeros((out, size)), np.zeros((out, size))
    rows = np.arange(out)
    if mode == "nearest":
        matrix[rows, nearest_pixels(size, out, coordinates, nearest, ratio)] = 1.0
        return ResizeAxis(matrix, doubt)
    cubic = mode == "cubic"
    if cubic and not abs(bend) <= 1.0:
        raise InputError(f"attribute cubic_coeff_a = {bend} is not supported", fix="between -1 and 1")
    if not cubic:
        place = np.clip(place, 0.0, size - 1.0)
    low = np.floor(place).astype(np.int64)
    part = place - low
    taps, weights = (0, 1), (1.0 - part, part)
    if cubic:
        far, near, across, beyond = (np.abs(part - tap) for tap in (-1, 0, 1, 2))
        inner = [(bend + 2.0) * t**3 - (bend + 3.0) * t**2 + 1.0 for t in (near, across)]
        outer = [bend * (t**3 - 5.0 * t**2 + 8.0 * t - 4.0) for t in (far, beyond)]
        taps, weights = (-1, 0, 1, 2), (outer[0], *inner, outer[1])
    for tap, weight in zip(taps, weights, strict=True):
        np.add.at(matrix, (rows, np.clip(low + tap, 0, size - 1)), weight)
    # scale, quotient or product of a reciprocal, difference; exact where the scale is a power of two
    moved = np.zeros(out) if np.frexp(step)[0] in (0.0, 0.5) else POSITION * (np.abs(place) + 1.0)
    steepest = 2.0 if cubic else 1.0
    # weights of a known place are exact but for the polynomials'
    own = POLYNOMIAL if cubic else 0.0
    for tap in range(min(taps) - 1, max(taps) + 2):
        # one beside those of a place counts where the place may be past a number
        inside = min(taps) <= tap <= max(taps)
        weighted = inside | (part <= moved if tap < 0 else 1.0 - part <= moved)
        np.add.at(doubt, (rows, np.clip(low + tap, 0, size - 1)), np.where(weighted, steepest * moved + own, 0.0))
    return ResizeAxis(matrix, doubt)
