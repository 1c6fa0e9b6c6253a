"""Pictures of sets of poses with what is true of them, and training of small networks, plain and certified.

Shared by `train_views.py`, `certify_views.py` and `nerf_certificate.py`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from ns_abstract.api.certification import FramePictures
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.geometry.tiles import assemble
from ns_abstract.refine.protocol import Method

#: Every so many-th picture is held back.
HELD = 5
#: Standard deviation of the noise on pictures that are trained on.
NOISE = 0.03
_RATE, _DECAY, _BATCH, _CELL_BATCH = 3e-3, 2e-2, 64, 32
#: Shares of the time: before cells count, and until they count in full.
_WARM, _RAMP = 0.2, 0.6


def pictures(method: Method, poses: PoseBox, values: np.ndarray) -> Tensor:
    """Renders [n, 3, H, W] at parameter values [n, d]."""
    frame = method.frame(poses)
    found = [assemble(frame.render(v), frame.camera)[..., :3] for v in values]
    return torch.from_numpy(np.stack(found)).permute(0, 3, 1, 2).contiguous().float()


# ---------------------------------------------------------------- networks


def head(side: int, outputs: int, channels: tuple[int, int, int] = (12, 16, 32)) -> nn.Sequential:
    """A small GateNet: convolution, pool, convolution, two linear layers; pictures of a multiple of 16 pixels."""
    first, second, hidden = channels
    stride = side // 16
    return nn.Sequential(
        nn.Conv2d(3, first, stride + 2, stride, 1), nn.ReLU(), nn.AvgPool2d(2),
        nn.Conv2d(first, second, 3, 2, 1), nn.ReLU(), nn.Flatten(),
        nn.Linear(16 * second, hidden), nn.ReLU(), nn.Linear(hidden, outputs),
    )  # fmt: skip


def export(model: nn.Module, side: int, file: Path) -> None:
    """Write a network of pictures [1, 3, side, side] with torch's exporter, weights in the file."""
    shown = torch.zeros(1, 3, side, side)
    program = torch.onnx.export(
        model.eval(), (shown,), dynamo=True, input_names=["image"], output_names=["y"], verbose=False
    )
    assert program is not None
    program.save(file, external_data=False)


# ---------------------------------------------------------------- cells of poses, for certified training


@dataclass(frozen=True)
class Cells:
    """Sets of pictures ``middle + sum_k slopes_k p_k`` within ``radius``, p in [-1, 1]^d, around single poses.

    Attributes:
        middle, radius: [n, 3, H, W].
        slopes: [n, d, 3, H, W].
        values: [n, d] the parameters at the middle.
        half: [n, d] half-widths.
    """

    middle: Tensor
    slopes: Tensor
    radius: Tensor
    values: np.ndarray
    half: np.ndarray


def cells(method: Method, poses: PoseBox, values: np.ndarray, half: np.ndarray, sheared: bool = False) -> Cells:
    """Bounded cells of half-widths [d] around parameter values [n, d], cut off at the ends of the set.

    ``slanted``: the cells' parameters, but not ``values``, are counted as certificates count them (design.md, P2).
    """
    shown = FramePictures(method, poses, sheared=sheared)
    whole, found, boxes = shown.box, [], []
    for v in counted(shown.pose_set, values):
        box = whole
        for axis in range(whole.dimensions):
            low, high = whole.lower[axis], whole.upper[axis]
            box = box.replace(axis, max(low, v[axis] - half[axis]), min(high, v[axis] + half[axis]))
        box = shown.frame.feasible(box)
        assert box is not None, "no cell around a pose is empty"
        linear, lower, upper, _ = shown.linear_sets(box)
        a_lower, b_lower, a_upper, b_upper = (np.asarray(part, np.float64) for part in linear)
        slopes, middle = 0.5 * (a_lower + a_upper), 0.5 * (b_lower + b_upper)
        radius = 0.5 * (b_upper - b_lower) + 0.5 * np.abs(a_upper - a_lower).sum(axis=-1)
        # where the interval says more, planes are flat
        better = 0.5 * (upper - lower) < radius + np.abs(slopes).sum(axis=-1)
        better &= 0.5 * (upper - lower) < radius
        middle[better], radius[better] = 0.5 * (lower + upper)[better], 0.5 * (upper - lower)[better]
        slopes[better] = 0.0
        found.append((middle.transpose(2, 0, 1), slopes.transpose(3, 2, 0, 1), radius.transpose(2, 0, 1)))
        boxes.append(([0.5 * (a + b) for a, b in zip(box.lower, box.upper, strict=True)], box))
    middle, slopes, radius = (torch.from_numpy(np.stack(part)).float() for part in zip(*found, strict=True))
    sizes = [[0.5 * (b - a) for a, b in zip(box.lower, box.upper, strict=True)] for _, box in boxes]
    return Cells(middle, slopes, radius, np.array([centre for centre, _ in boxes]), np.array(sizes))


def counted(poses: PoseBox, values: np.ndarray) -> np.ndarray:
    """Parameters [n, d] of a set as a slanted one counts them (`PoseBox.sheared`)."""
    found, names = np.array(values, np.float64), poses.box.names
    for name, factors in poses.shear.items():
        found[:, names.index(name)] -= sum(factor * values[:, names.index(other)] for other, factor in factors.items())
    return found


def joined(found: Sequence[Cells]) -> Cells:
    """Cells of several scenes, one after the other."""
    middle, slopes, radius = (
        torch.cat([getattr(one, name) for one in found]) for name in ("middle", "slopes", "radius")
    )  # fmt: skip
    values, half = (np.concatenate([getattr(one, name) for one in found]) for name in ("values", "half"))
    return Cells(middle, slopes, radius, values, half)


def ranges(
    model: nn.Sequential, middle: Tensor, slopes: Tensor, radius: Tensor, rows: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """The network's outputs over cells, as sets of the same kind: [n, k], [n, d, k], [n, k]; differentiable.

    Linear layers map the set exactly, but for the radius, which takes their absolute weights. ReLU: the parallel band
    of the chord of the range (DeepZ of Singh et al., with one radius for all errors). Float64 charges are left out:
    this is for training, not a proof. With ``rows`` [k, outputs] those combinations of the outputs of a last linear
    layer, which they are multiplied into: tighter than combining what the outputs' radii say.
    """
    count, parameters = slopes.shape[:2]
    for number, layer in enumerate(model):
        if isinstance(layer, nn.ReLU):
            reach = slopes.abs().sum(dim=1) + radius
            low, high = middle - reach, middle + reach
            slope = (high / (high - low).clamp(min=1e-9)).clamp(0.0, 1.0)
            slope = torch.where(low >= 0.0, torch.ones_like(slope), torch.where(high <= 0.0, 0.0, slope))
            half = torch.where((low < 0.0) & (high > 0.0), -0.5 * slope * low, 0.0)
            middle, radius = slope * middle + half, slope * radius + half
            slopes = slope[:, None] * slopes
            continue
        flat = slopes.reshape(count * parameters, *slopes.shape[2:])
        if isinstance(layer, nn.Conv2d):
            place: dict[str, Any] = {"stride": layer.stride, "padding": layer.padding}
            middle = layer(middle)
            flat = functional.conv2d(flat, layer.weight, None, **place)
            radius = functional.conv2d(radius, layer.weight.abs(), None, **place)
        elif isinstance(layer, nn.Linear):
            weight, bias = layer.weight, layer.bias
            if rows is not None and number == len(model) - 1:
                weight, bias = rows @ weight, rows @ bias
            middle, flat = functional.linear(middle, weight, bias), functional.linear(flat, weight)
            radius = functional.linear(radius, weight.abs())
        else:
            assert isinstance(layer, (nn.AvgPool2d, nn.Flatten)), layer
            middle, flat, radius = layer(middle), layer(flat), layer(radius)
        slopes = flat.reshape(count, parameters, *flat.shape[1:])
    return middle, slopes, radius


# ---------------------------------------------------------------- training

#: Outputs [b, k] and which pictures [b] they are of, to a loss.
Loss = Callable[[Tensor, Tensor], Tensor]
#: Sets of outputs (see `ranges`), which cells [b] they are of, and their size now (1: the cells), to a loss.
CellLoss = Callable[[tuple[Tensor, Tensor, Tensor], Tensor, float], Tensor]


def signed(model: nn.Module, cell: tuple[Tensor, Tensor, Tensor], loss: Loss, which: Tensor) -> Tensor:
    """Members of cells (`Cells`: middle, slopes, radius) where one step by the sign of the loss's slope leads.

    From a random member to an end for every parameter and every pixel by itself: more than what colours of Gaussians,
    which pixels share, can do.
    """
    middle, slopes, radius = cell
    p = (2.0 * torch.rand(slopes.shape[:2]) - 1.0).requires_grad_()
    r = (2.0 * torch.rand_like(middle) - 1.0).requires_grad_()

    def member(p: Tensor, r: Tensor) -> Tensor:
        return middle + (slopes * p[:, :, None, None, None]).sum(dim=1) + radius * r

    along = torch.autograd.grad(loss(model(member(p, r)), which), (p, r))
    return member(*(torch.sign(slope) for slope in along)).detach()


def fit(
    model: nn.Sequential,
    images: Tensor,
    loss: Loss,
    seconds: float = 0.0,
    *,
    steps: int | None = None,
    sets: Cells | None = None,
    set_loss: CellLoss | None = None,
    rows: Tensor | None = None,
    attacked: Loss | None = None,
    weight: float = 1.0,
) -> int:
    """Train on pictures [n, 3, H, W] for so much processor time, or so many steps.

    With ``sets`` the loss of bounded cells counts ``weight`` times, after a warm-up in which they grow from points:
    ``set_loss`` of the outputs' ranges (of ``rows`` of them, as `ranges` has them), or ``attacked`` of the pictures
    that `signed` finds.

    Returns:
        The number of steps.
    """
    optimizer = torch.optim.AdamW(model.parameters(), lr=_RATE, weight_decay=_DECAY)
    started, step, share = time.process_time(), 0, 0.0
    model.train()
    while share < 1.0:
        for group in optimizer.param_groups:
            group["lr"] = _RATE * (0.5 + 0.5 * math.cos(math.pi * share)) * min(1.0, (step + 1) / 30) + 1e-6
        which = torch.randint(len(images), (_BATCH,))
        shown = images[which]
        value = loss(model(shown + NOISE * torch.randn_like(shown)), which)
        grown = min(1.0, max(0.0, (share - _WARM) / (_RAMP - _WARM)))
        if sets is not None and grown > 0.0:
            some = torch.randint(len(sets.middle), (_CELL_BATCH,))
            cell = sets.middle[some], grown * sets.slopes[some], grown * sets.radius[some]
            if set_loss is not None:
                value = value + weight * grown * set_loss(ranges(model, *cell, rows), some, grown)
            if attacked is not None:
                value = value + weight * grown * attacked(model(signed(model, cell, attacked, some)), some)
        optimizer.zero_grad(set_to_none=True)
        value.backward()
        nn.utils.clip_grad_norm_(model.parameters(), 5.0)
        optimizer.step()
        step += 1
        share = step / steps if steps is not None else (time.process_time() - started) / seconds
    model.eval()
    return step
