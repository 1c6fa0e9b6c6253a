"""Shifts of hue and saturation of all points' colours: for renders, and as bounds (docs/dev/design.md, F9)."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from ns_abstract.arithmetic.rounding import HUE_ROOM, HUE_ROUNDING
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.poses import COLOR_SHIFTS, PoseBox

Range = tuple[float, float]


def color_shift(pose_set: PoseBox, values: Any) -> tuple[Any, Any] | None:
    """Return the shifts of hue (turns) and saturation at parameter ``values`` [d] of a set; None if it has neither."""
    named = {**pose_set.fixed, **dict(zip(pose_set.box.names, values, strict=True))}
    if not any(name in named for name in COLOR_SHIFTS):
        return None
    hue, saturation = (named.get(name, 0.0) for name in COLOR_SHIFTS)
    return hue, saturation


def shift_ends(box: ParameterBox, fixed: Mapping[str, float], count: int) -> list[np.ndarray]:
    """Return edges of ``count`` equal parts of hue's and saturation's ranges in ``box``; two where one is ``fixed``."""
    ends_by_shift = []
    for name in COLOR_SHIFTS:
        low = high = fixed.get(name, 0.0)
        if name in box.names:
            low, high = box.lower[box.names.index(name)], box.upper[box.names.index(name)]
        ends = np.linspace(low, high, count + 1 if low < high else 2)
        ends[0], ends[-1] = low, high
        ends_by_shift.append(ends)
    return ends_by_shift


def shift_parts(ends: Sequence[np.ndarray]) -> list[tuple[Range, Range]]:
    """Return intervals of hue and saturation between `shift_ends`, the latter running faster; empty: no shifts."""
    ranges = [list(itertools.pairwise(edges.tolist())) for edges in ends]
    shifted = any(low or high for cuts in ranges for low, high in cuts)
    return [(hue, saturation) for hue, saturation in itertools.product(*ranges)] if shifted else []


def shifted(rgb: Tensor, hue: Tensor | float, saturation: Tensor | float) -> Tensor:
    """Return colours [..., 3] in [0, 1] with ``hue`` (turns) and ``saturation`` added in HSV; differentiable.

    With V and m the largest and least channel, ``S = 1 - m / V`` becomes ``clip(S + saturation, 0, 1)``, that is m
    becomes ``clip(m - saturation V, 0, V)``; V stays. Grey has hue 0 (red).
    """
    value, which = rgb.max(dim=-1)
    least = rgb.min(dim=-1).values
    chroma = value - least
    red, green, blue = rgb.unbind(dim=-1)
    rise = torch.where(which == 0, green - blue, torch.where(which == 1, blue - red, red - green))
    grey = chroma <= 0.0
    sixths = 2.0 * which + torch.where(grey, 0.0, rise / torch.where(grey, 1.0, chroma))
    sixths = torch.where(grey, 0.0, sixths) + 6.0 * hue
    low = torch.minimum((least - saturation * value).clamp(min=0.0), value)
    centre = torch.tensor([0.0, 2.0, 4.0], dtype=rgb.dtype, device=rgb.device)
    distance = (torch.remainder(sixths[..., None] - centre + 3.0, 6.0) - 3.0).abs()
    return low[..., None] + (value - low)[..., None] * (2.0 - distance).clamp(0.0, 1.0)


@njit(cache=True, error_model="numpy")
def _hues(low, high):
    """Return bounds of the hue (sixths of a turn) of a box of colours [3]; six apart where it may be any.

    Where one channel is the largest (least) all over the box, the hue is monotone in each channel, so its ends are at
    corners.
    """
    first, last = 0.0, 6.0
    for largest in (False, True):
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            if largest:
                sure, centre, up, down = low[i] > high[j] and low[i] > high[k], 2.0 * i, j, k
            else:
                sure, centre, up, down = high[i] < low[j] and high[i] < low[k], 2.0 * i + 3.0, k, j
            if not sure:
                continue
            start, end = np.inf, -np.inf
            for c in (low[i], high[i]):
                for a, b in ((low[up], high[down]), (high[up], low[down])):
                    part = (a - b) / (c - min(a, b) if largest else max(a, b) - c)
                    start, end = min(start, part), max(end, part)
            first, last = centre + min(max(start, -1.0), 1.0), centre + min(max(end, -1.0), 1.0)
    return first - HUE_ROOM, last + HUE_ROOM


@njit(cache=True, error_model="numpy")
def shift_box(low, high, hue, saturation, down, up):
    """Write bounds [3] of `shifted` over a box of colours [3] and intervals of both shifts (design.md, F9)."""
    first, last = _hues(low, high)
    value_low, value_high = max(low[0], low[1], low[2]), max(high[0], high[1], high[2])
    taken = max(saturation[1] * value_low, saturation[1] * value_high)
    scaled = min(saturation[0] * value_low, saturation[0] * value_high)
    least = min(max(min(low[0], low[1], low[2]) - taken, 0.0), value_low)
    most = min(max(min(high[0], high[1], high[2]) - scaled, 0.0), value_high)
    width = last - first + 6.0 * (hue[1] - hue[0]) + 2.0 * HUE_ROOM
    for c in range(3):
        start = (first + 6.0 * hue[0] - 2.0 * c - HUE_ROOM + 3.0) % 6.0 - 3.0
        end = start + width
        # where a range goes on beyond half a turn, so does its end, and the share is 0
        far = max(abs(start), abs(end))
        near = min(abs(start), abs(end - 6.0 if end >= 3.0 else end))
        if (start <= 0.0 and end >= 0.0) or end >= 6.0:
            near = 0.0
        share_low, share_high = min(max(2.0 - far, 0.0), 1.0), min(max(2.0 - near, 0.0), 1.0)
        down[c] = min(max(least + (value_low - least) * share_low - HUE_ROUNDING, 0.0), 1.0)
        up[c] = min(max(most + (value_high - most) * share_high + HUE_ROUNDING, 0.0), 1.0)


@njit(cache=True, error_model="numpy")
def shifted_bounds(low, high, hue, saturation):
    """Return bounds [n, 3] of `shifted` over boxes of colours [n, 3] and intervals of both shifts."""
    down, up = np.empty_like(low), np.empty_like(high)
    for i in range(low.shape[0]):
        shift_box(low[i], high[i], hue, saturation, down[i], up[i])
    return down, up
