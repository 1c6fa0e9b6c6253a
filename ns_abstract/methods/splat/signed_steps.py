"""Signed-gradient steps (FGSM) of a pose and of all Gaussians at once (design.md, V12)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.differentiable_pose import differentiable_pose
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.methods.splat.activate import Splats
from ns_abstract.methods.splat.reference import Reference
from ns_abstract.methods.splat.scene import Float64Array
from ns_abstract.methods.splat.variations import VariedSplats

#: The picture [H, W, 3] of a pose and a scene that carry gradients, or the colours [k, 3] of pixels [k, 2] of it.
DifferentiableRender = Callable[[torch.Tensor | None], torch.Tensor]


def signed_gradient_step(
    reference: Reference,
    poses: PoseBox,
    varied: VariedSplats,
    box: ParameterBox,
    values: Float64Array,
    scene_sample: Splats,
    score: Callable[[DifferentiableRender, torch.Tensor], torch.Tensor],
    size: float,
) -> tuple[Float64Array, Splats]:
    """Return a pose of ``box`` and a scene of the set one signed-gradient step uphill (design.md, V12).

    Args:
        poses, varied, box: The pose set, the set of scenes, the range of the pose's parameters.
        values, scene_sample: Where the step begins.
        score: The score to raise, of a picture or of pixels and of the pose's parameters.
        size: Length in half-widths of every range; 2 goes from one end to the other. The step ends in the set.
    """
    shift = torch.from_numpy(scene_sample.color_shift.copy()) if scene_sample.color_shift.size else None
    leaves = [torch.from_numpy(np.array(v, np.float64)) for v in (values, scene_sample.means, scene_sample.opacity)]
    for leaf in (*leaves, shift):
        if leaf is not None:
            leaf.requires_grad_(True)
    other = reference.scene_sample(leaves[1], leaves[2], shift)
    pose = differentiable_pose(poses)(leaves[0])

    def show(pixels: torch.Tensor | None = None) -> torch.Tensor:
        if pixels is None:
            return other.image(poses.camera, pose)
        return other.pixels(poses.camera, pose, pixels)

    value = score(show, leaves[0])
    if value.requires_grad:
        value.backward()
    steps = [0.5 * size * _sign(leaf) for leaf in (*leaves, shift)]
    low, high = np.array(box.lower), np.array(box.upper)
    values = np.clip(values + steps[0] * (high - low), low, high) if values.size else values
    means = scene_sample.means
    if varied.mean_low.size:
        means = means + steps[1] * (varied.mean_high - varied.mean_low)
    opacity = scene_sample.opacity + steps[2] * (varied.opacity_high - varied.opacity_low)
    moved = scene_sample.color_shift
    if varied.shift_low.size:
        moved = moved + steps[3] * (varied.shift_high - varied.shift_low)
    return values, varied.at(means, opacity, moved)


def _sign(leaf: torch.Tensor | None) -> Float64Array:
    """Return the gradient's signs; 0 where there is none."""
    if leaf is None or leaf.grad is None:
        return np.zeros(1 if leaf is None else tuple(leaf.shape))
    return np.sign(np.nan_to_num(leaf.grad.numpy()))
