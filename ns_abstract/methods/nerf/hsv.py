"""Hue and saturation of the colours of all points, shifted together: concrete and as bounds (design.md, F9)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ns_abstract.arithmetic.rounding import HUE_ROOM, HUE_ROUNDING
from ns_abstract.geometry.poses import COLOR_SHIFTS, PoseBox

Float64Array = NDArray[np.float64]
Range = tuple[float, float]


def color_shift(pose_set: PoseBox, values: Any) -> tuple[Any, Any] | None:
    """Hue (turns) and saturation that are added at parameter ``values`` [d] of a set; None where neither is named."""
    named = {**pose_set.fixed, **dict(zip(pose_set.box.names, values, strict=True))}
    if not any(name in named for name in COLOR_SHIFTS):
        return None
    hue, saturation = (named.get(name, 0.0) for name in COLOR_SHIFTS)
    return hue, saturation


def shifted(rgb: Tensor, hue: Tensor | float, saturation: Tensor | float) -> Tensor:
    """Colours [..., 3] in [0, 1] with ``hue`` (turns) and ``saturation`` added in HSV; differentiable.

    With V and m the largest and least channel, ``S = 1 - m / V`` becomes ``clip(S + saturation, 0, 1)``, that is
    m becomes ``clip(m - saturation V, 0, V)``; V stays. Grey has hue 0 (red).
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


def _hues(low: Float64Array, high: Float64Array) -> tuple[Float64Array, Float64Array]:
    """[n] bounds of the hue (sixths of a turn) of boxes of colours [n, 3]; six apart where it may be any.

    Where one channel is the largest (least) all over the box, the hue is monotone in each channel, so its ends are
    at corners.
    """
    first, last = np.zeros(len(low)), np.full(len(low), 6.0)
    for extreme in (False, True):
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            with np.errstate(divide="ignore", invalid="ignore"):
                if extreme:
                    sure = (low[:, i] > high[:, j]) & (low[:, i] > high[:, k])
                    centre, up, down = 2.0 * i, j, k

                    def part(c, a, b):
                        return (a - b) / (c - np.minimum(a, b))
                else:
                    sure = (high[:, i] < low[:, j]) & (high[:, i] < low[:, k])
                    centre, up, down = 2.0 * i + 3.0, k, j

                    def part(c, a, b):
                        return (a - b) / (np.maximum(a, b) - c)

                ends = [part(c[:, i], high[:, up], low[:, down]) for c in (low, high)]
                starts = [part(c[:, i], low[:, up], high[:, down]) for c in (low, high)]
            first[sure] = centre + np.clip(np.minimum(*starts), -1.0, 1.0)[sure]
            last[sure] = centre + np.clip(np.maximum(*ends), -1.0, 1.0)[sure]
    return first - HUE_ROOM, last + HUE_ROOM


def shifted_bounds(
    low: Float64Array, high: Float64Array, hue: Range, saturation: Range
) -> tuple[Float64Array, Float64Array]:
    """Bounds [n, 3] of `shifted` over boxes of colours [n, 3] and intervals of both shifts (design.md, F9)."""
    first, last = _hues(low, high)
    value_low, value_high = low.max(axis=1)[:, None], high.max(axis=1)[:, None]
    taken = [saturation[1] * v for v in (value_low, value_high)]
    scaled = [saturation[0] * v for v in (value_low, value_high)]
    least = np.clip(low.min(axis=1)[:, None] - np.maximum(*taken), 0.0, value_low)
    most = np.clip(high.min(axis=1)[:, None] - np.minimum(*scaled), 0.0, value_high)
    centre = np.array([0.0, 2.0, 4.0])
    start = (first + 6.0 * hue[0])[:, None] - centre
    width = (last - first + 6.0 * (hue[1] - hue[0]) + 2.0 * HUE_ROOM)[:, None]
    start = np.mod(start - HUE_ROOM + 3.0, 6.0) - 3.0
    end = start + width
    # where a range goes on beyond half a turn, so does its end, and the share is 0
    far = np.maximum(np.abs(start), np.abs(end))
    near = np.minimum(np.abs(start), np.abs(np.where(end >= 3.0, end - 6.0, end)))
    near = np.where(((start <= 0.0) & (end >= 0.0)) | (end >= 6.0), 0.0, near)
    share_low, share_high = np.clip(2.0 - far, 0.0, 1.0), np.clip(2.0 - near, 0.0, 1.0)
    down = least + (value_low - least) * share_low - HUE_ROUNDING
    up = most + (value_high - most) * share_high + HUE_ROUNDING
    return np.clip(down, 0.0, 1.0), np.clip(up, 0.0, 1.0)
