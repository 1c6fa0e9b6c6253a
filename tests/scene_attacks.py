"""An attack on the abstract image of a set of poses and of scenes whose Gaussians vary.

Tolerance is zero, as in `ns_abstract.verify.attack.falsify`; what differs is the number of parameters, seven by
Gaussian. Members of the set are rendered at corners (of all Gaussians alike and of random signs), inside, and
where signed gradients lead that go through the reference renderer from the pixels that came closest to a bound.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from ns_abstract.arithmetic.outward import outward
from ns_abstract.arithmetic.rounding import arithmetic as arithmetic_of
from ns_abstract.geometry.box import Float64Array, ParameterBox
from ns_abstract.geometry.camera_path import load_camera_path
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.geometry.tiles import assemble
from ns_abstract.methods.splat.activate import Splats, activate
from ns_abstract.methods.splat.bounds import SplatBounds
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0, Rasteriser
from ns_abstract.methods.splat.load import load_scene
from ns_abstract.methods.splat.reference import Reference
from ns_abstract.methods.splat.render import Renderer
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.methods.splat.signed_steps import signed_gradient_step
from ns_abstract.methods.splat.variations import VariedSplats, vary
from ns_abstract.perturbation.specification import parse_perturbation

#: Parameter values [d] and a scene sample of the set to a picture [H, W, 3].
Show = Callable[[Float64Array, Splats], np.ndarray]

_STEPS = 4


@dataclass
class VariedAttack:
    """What an attack did and found.

    Attributes:
        pictures: Rendered in full, by strategy.
        comparisons: Pixel channels compared with their bounds.
        violations: Comparisons that failed; a value or bound that is no number fails.
        amount: How far the worst value lies outside.
        least, most: [H, W, 3] extremes of what was rendered.
    """

    least: Float64Array = field(repr=False)
    most: Float64Array = field(repr=False)
    pictures: dict[str, int] = field(default_factory=dict)
    comparisons: int = 0
    violations: int = 0
    amount: float = 0.0


def show_compiled(renderer: Renderer, poses: PoseBox) -> Show:
    """Pictures of the compiled renderer."""
    return lambda values, scene_sample: renderer.image(poses.camera, *poses.world_to_camera(values), scene_sample)


def show_reference(reference: Reference, poses: PoseBox) -> Show:
    """Pictures of the reference renderer, in its own precision: a scene sample's values are rounded to it."""

    def show(values: Float64Array, scene_sample: Splats) -> np.ndarray:
        with torch.no_grad():
            other = reference.scene_sample(*_tensors(scene_sample))
            return other.image(poses.camera, torch.from_numpy(poses.pose(values))).numpy()

    return show


def _tensors(scene_sample: Splats) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
    shift = torch.from_numpy(scene_sample.color_shift) if scene_sample.color_shift.size else None
    return torch.from_numpy(scene_sample.means), torch.from_numpy(scene_sample.opacity), shift


def attack_varied(
    lower: np.ndarray,
    upper: np.ndarray,
    box: ParameterBox,
    varied: VariedSplats,
    shows: list[Show],
    scene: SplatScene,
    poses: PoseBox,
    rasteriser: Rasteriser,
    *,
    scene_samples: int = 40,
    targets: int = 12,
    seed: int = 0,
) -> VariedAttack:
    """Attack the abstract image [lower, upper] of the poses of ``box`` and the scenes of ``varied``.

    Args:
        lower, upper: [H, W, 3]; compared as they are.
        box: Parameters of the poses; d = 0 is one pose.
        varied: The scenes.
        shows: Renderers; every picture of every one must lie inside.
        scene, poses, rasteriser: What the reference renderer differentiates.
        scene_samples: Scenes rendered without gradients, each at a pose.
        targets: Pixel channels that gradients push, each along ``4`` signed steps.
        seed: Decides every random choice.
    """
    lower, upper = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    generator = np.random.default_rng(seed)
    record = VariedAttack(np.full(lower.shape, np.inf), np.full(lower.shape, -np.inf))
    seen: list[tuple[Float64Array, Splats]] = []
    least_at, most_at = np.zeros(lower.shape, np.int64), np.zeros(lower.shape, np.int64)

    def compare(values: Float64Array, scene_sample: Splats, strategy: str) -> None:
        number = len(seen)
        seen.append((values, scene_sample))
        for show in shows:
            picture = np.asarray(show(values, scene_sample), np.float64)
            outside = ~((lower <= picture) & (picture <= upper))
            record.pictures[strategy] = record.pictures.get(strategy, 0) + 1
            record.comparisons += picture.size
            if outside.any():
                record.violations += int(outside.sum())
                distance = np.maximum(lower - picture, picture - upper)[outside]
                record.amount = max(record.amount, float(np.nan_to_num(distance, nan=np.inf, posinf=np.inf).max()))
            least_at[picture < record.least], most_at[picture > record.most] = number, number
            record.least, record.most = np.fmin(record.least, picture), np.fmax(record.most, picture)

    corners = box.corners() if box.dimensions else np.empty((0, 0))
    for k, scene_sample in enumerate(itertools.islice(varied.scene_samples(generator), scene_samples)):
        at_corner = k % 3 == 1 and len(corners)
        values = corners[generator.integers(len(corners))] if at_corner else box.sample(1, generator)[0]
        compare(box.middle if k % 3 == 0 else values, scene_sample, "scene_samples")
    compare(box.middle, varied.nearest, "nearest")
    slow = Reference(scene, rasteriser)
    for number in range(targets):
        row, column, channel, sign = _target(record, lower, upper, number, generator)
        values, scene_sample = seen[(most_at if sign > 0.0 else least_at)[row, column, channel]]
        for step in range(_STEPS):
            # a full step to the ends first, then steps of half the rest
            values, scene_sample = signed_gradient_step(
                slow, poses, varied, box, values, scene_sample,
                lambda show, values, place=(row, column, channel), sign=sign: (
                    sign * show(torch.tensor([place[:2]]))[0, place[2]]
                ),
                2.0 if step == 0 else 0.5,
            )  # fmt: skip
            compare(values, scene_sample, "gradient")
    return record


def _target(
    record: VariedAttack, lower: Float64Array, upper: Float64Array, number: int, generator: np.random.Generator
) -> tuple[int, int, int, float]:
    """A pixel channel and a direction: in turn, what is closest to its bound relative to the gap, and any."""
    sign = 1.0 if number % 2 == 0 else -1.0
    gap = upper - lower
    with np.errstate(divide="ignore", invalid="ignore"):
        score = ((record.most - lower) if sign > 0.0 else (upper - record.least)) / gap
    score[~np.isfinite(score) | (record.most <= record.least)] = -np.inf
    order = np.argsort(-score, axis=None, kind="stable")
    usable = max(1, int(np.isfinite(score).sum()))
    flat = order[number // 4 % usable] if number % 4 < 2 else order[generator.integers(usable)]
    row, column, channel = (int(v) for v in np.unravel_index(flat, lower.shape))
    return row, column, channel, sign


def equal_cells(box: ParameterBox, parts: int | Sequence[int]) -> list[ParameterBox]:
    """The box cut into equal cells: ``parts`` along the first parameter, or one number per parameter."""
    counts = [parts] if isinstance(parts, int) else list(parts)
    cells = [box]
    for axis, count in enumerate(counts[: box.dimensions]):
        cells = [piece for cell in cells for piece in cell.split(axis, count)]
    return cells


def bound_cells(
    scene: SplatScene,
    pose_set: PoseBox,
    cells: Sequence[ParameterBox],
    *,
    rasteriser: Rasteriser = GSPLAT_1_4_0,
    arithmetic: str = "real",
    order: int = 1,
    varied: VariedSplats | None = None,
) -> tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray]:
    """float32 bounds [H, W, 3] (lower, upper) of every cell, and the summed statistics of the bounds.

    The bounds hold for every scene of ``varied``, if given.
    """
    bounds = SplatBounds(activate(scene, rasteriser), rasteriser, arithmetic_of(arithmetic), varied)
    camera = pose_set.camera
    out, statistics = [], np.zeros(5, np.int64)
    for cell in cells:
        result = bounds.cell(camera, pose_set.enclosure(cell, order))
        out.append(outward(assemble(result.lower, camera), assemble(result.upper, camera)))
        statistics += result.statistics
    return out, statistics


def check_varied(
    load_config: str | os.PathLike[str],
    camera_path: str | os.PathLike[str],
    spec: Mapping[str, Any],
    frame: int,
    cells: int = 1,
    *,
    scene_samples: int = 40,
    targets: int = 12,
    reference: bool = True,
    seed: int = 0,
    downscale_factor: float = 1,
    arithmetic: str = "real",
    rasteriser: Rasteriser = GSPLAT_1_4_0,
) -> dict[str, Any]:
    """Bound one frame over a set of poses and scenes, cell by cell, and attack every cell's own bounds.

    Args:
        load_config: config.yml, run folder or .ply.
        camera_path: The viewer's JSON.
        spec: A perturbation object with the key "scene".
        frame: Number of the entry of the camera path.
        cells: Equal parts along the first parameter of the poses, if there is any.
        scene_samples, targets: See `attack_varied`; of every cell.
        reference: Whether the reference renderer's pictures are compared besides the compiled one's.
        seed: Decides every random choice.
        downscale_factor: Images become this many times smaller.
        arithmetic: "real" or "float32".
        rasteriser: The rules.

    Returns:
        Counts of Gaussians that vary, mean and largest pixel gap of the bounds (``mpg``, ``xpg``) and of the
        pictures (``mpg_witness``, ``xpg_witness``), ``pictures``, ``comparisons``, ``violations``, ``amount``.

    Raises:
        InputError: A file or a field in it cannot be used, or an entry picks no Gaussian.
    """
    scene = load_scene(load_config)
    path = load_camera_path(camera_path, downscale_factor)
    perturbation = parse_perturbation(dict(spec))
    poses = PoseBox.around(path.cameras[frame], perturbation, path.following(frame))
    splats = activate(scene, rasteriser)
    varied = vary(scene, splats, perturbation.scene)
    boxes = equal_cells(poses.box, cells) if poses.box.dimensions else [poses.box]
    order = 2 if poses.box.dimensions == 1 else 1
    bounds, _ = bound_cells(
        scene, poses, boxes, rasteriser=rasteriser, arithmetic=arithmetic, order=order, varied=varied
    )
    shows = [show_compiled(Renderer(splats, rasteriser), poses)]
    if reference:
        shows.append(show_reference(Reference(scene, rasteriser), poses))
    attacks = [
        attack_varied(
            lower, upper, box, varied, shows, scene, poses, rasteriser,
            scene_samples=scene_samples, targets=targets, seed=seed + number,
        )
        for number, (box, (lower, upper)) in enumerate(zip(boxes, bounds, strict=True))
    ]  # fmt: skip
    outer = np.max([b[1] for b in bounds], axis=0).astype(np.float64) - np.min([b[0] for b in bounds], axis=0)
    inner = np.max([a.most for a in attacks], axis=0) - np.min([a.least for a in attacks], axis=0)
    gap, seen = np.linalg.norm(outer, axis=-1), np.linalg.norm(inner, axis=-1)
    return {
        "scene": scene.name,
        "gaussians": scene.count,
        "varied": varied.counts,
        "size": [poses.camera.width, poses.camera.height],
        "parameters": list(poses.box.names),
        "mpg": float(gap.mean()),
        "xpg": float(gap.max()),
        "mpg_witness": float(seen.mean()),
        "xpg_witness": float(seen.max()),
        "pictures": sum(sum(a.pictures.values()) for a in attacks),
        "comparisons": sum(a.comparisons for a in attacks),
        "violations": sum(a.violations for a in attacks),
        "amount": max(a.amount for a in attacks),
    }
