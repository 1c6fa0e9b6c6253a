"""Bound one frame of a run over a set of poses and attack the bounds with two renderers."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from ns_abstract.arithmetic.outward import outward
from ns_abstract.arithmetic.rounding import arithmetic as arithmetic_of
from ns_abstract.geometry.box import Float64Array, ParameterBox
from ns_abstract.geometry.camera_path import load_camera_path
from ns_abstract.geometry.differentiable_pose import differentiable_pose
from ns_abstract.geometry.poses import PoseSet
from ns_abstract.geometry.tiles import assemble, tile_grid
from ns_abstract.io.errors import InputError
from ns_abstract.methods.nerf.hsv import color_shift
from ns_abstract.methods.nerf.render import NerfRenderer, Sampling, camera_rays
from ns_abstract.methods.nerf.scene import NerfScene
from ns_abstract.methods.splat.activate import activate
from ns_abstract.methods.splat.bounds import SplatBounds
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0, Rasteriser
from ns_abstract.methods.splat.load import load_scene
from ns_abstract.methods.splat.reference import Reference
from ns_abstract.methods.splat.render import Renderer
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.methods.splat.variations import VariedSplats
from ns_abstract.perturbation.specification import parse_perturbation
from ns_abstract.verify.attack.falsify import Attack, Probe, Render, Twin, falsify, merge


def compiled_renderer(scene: SplatScene, pose_set: PoseSet, rasteriser: Rasteriser) -> tuple[Render, Probe]:
    """The compiled renderer of the set's camera, for `falsify`: whole images, and single pixels."""
    renderer = Renderer(activate(scene, rasteriser), rasteriser)
    camera, side = pose_set.camera, rasteriser.work_tile
    across, _ = tile_grid(camera, side)

    def render(values: Float64Array) -> Float64Array:
        return renderer.image(camera, *pose_set.world_to_camera(values))

    def probe(values: Float64Array, pixels: np.ndarray) -> Float64Array:
        rows, columns = pixels.T
        wanted, place = np.unique((rows // side) * across + columns // side, return_inverse=True)
        tiles = renderer.tiles(camera, *pose_set.world_to_camera(values), wanted)
        return tiles[place, rows % side, columns % side]

    return render, probe


def reference_renderer(
    scene: SplatScene, pose_set: PoseSet, rasteriser: Rasteriser, dtype: torch.dtype = torch.float64
) -> tuple[Render, Probe, Twin]:
    """The reference renderer of the set's camera, for `falsify`: images, single pixels, and the twin."""
    reference = Reference(scene, rasteriser, dtype)
    camera, pose = pose_set.camera, differentiable_pose(pose_set)

    def render(values: Float64Array) -> np.ndarray:
        with torch.no_grad():
            return reference.image(camera, torch.from_numpy(pose_set.pose(values))).numpy()

    def probe(values: Float64Array, pixels: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return reference.pixels(camera, torch.from_numpy(pose_set.pose(values)), torch.from_numpy(pixels)).numpy()

    def twin(values: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
        return reference.pixels(camera, pose(values), pixels)

    return render, probe, twin


def nerf_renderer(scene: NerfScene, pose_set: PoseSet, sampling: Sampling) -> tuple[Render, Probe, Twin]:
    """The renderer of a NeRF at the set's camera, for `falsify`: images, single pixels, and the twin."""
    renderer = NerfRenderer(scene, sampling)
    camera, pose = pose_set.camera, differentiable_pose(pose_set)

    def render(values: Float64Array) -> Float64Array:
        return renderer.image(camera, pose_set.pose(values), color_shift(pose_set, values))

    def probe(values: Float64Array, pixels: np.ndarray) -> Float64Array:
        return renderer.pixels(camera, pose_set.pose(values), pixels, color_shift(pose_set, values))

    def twin(values: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
        rays = torch.from_numpy(camera_rays(camera, pixels.numpy()))
        return renderer.rays(pose(values), rays, color_shift(pose_set, values.unbind()))

    return render, probe, twin


def equal_cells(box: ParameterBox, parts: int | Sequence[int]) -> list[ParameterBox]:
    """The box cut into equal cells: ``parts`` along the first parameter, or one number per parameter."""
    counts = [parts] if isinstance(parts, int) else list(parts)
    cells = [box]
    for axis, count in enumerate(counts[: box.dimensions]):
        cells = [piece for cell in cells for piece in cell.split(axis, count)]
    return cells


def bound_cells(
    scene: SplatScene,
    pose_set: PoseSet,
    cells: Sequence[ParameterBox],
    *,
    rasteriser: Rasteriser = GSPLAT_1_4_0,
    arithmetic: str = "real",
    order: int = 1,
    varied: VariedSplats | None = None,
) -> tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray]:
    """float32 bounds [H, W, 3] (lower, upper) of every cell, and the summed statistics of the bounds.

    They hold for every scene of ``varied``, if given.
    """
    bounds = SplatBounds(activate(scene, rasteriser), rasteriser, arithmetic_of(arithmetic), varied)
    camera = pose_set.camera
    out, statistics = [], np.zeros(5, np.int64)
    for cell in cells:
        result = bounds.cell(camera, pose_set.enclosure(cell, order))
        out.append(outward(assemble(result.lower, camera), assemble(result.upper, camera)))
        statistics += result.statistics
    return out, statistics


def _summary(attack: Attack) -> dict[str, Any]:
    """The numbers of an attack, as JSON has them."""
    return {
        "poses": attack.poses,
        "probes": attack.probes,
        "gradient_steps": attack.steps,
        "tried": attack.tried,
        "comparisons": attack.comparisons,
        "violations": attack.violations,
        "not_finite": attack.not_finite,
        "amount": attack.amount,
        "worst": [vars(violation) for violation in attack.worst],
        "seconds": attack.seconds,
    }


def check_run(
    load_config: str | os.PathLike[str],
    camera_path: str | os.PathLike[str],
    spec: Mapping[str, Any],
    frame: int,
    cells: int | Sequence[int],
    poses: int,
    seed: int = 0,
    *,
    reference_poses: int | None = None,
    downscale_factor: float = 1,
    order: int = 1,
    arithmetic: str = "real",
    rasteriser: Rasteriser = GSPLAT_1_4_0,
    seconds: float = float("inf"),
) -> dict[str, Any]:
    """Bound one frame over a set, cell by cell, and attack every cell's own bounds.

    A cell's bounds are rounded outward to float32; the abstract image is their union. Attacking the
    cells is stricter than attacking the union, which contains them.

    Args:
        load_config: config.yml, run folder or .ply.
        camera_path: The viewer's JSON.
        spec: A perturbation object (contract, section 2).
        frame: Number of the entry of the camera path.
        cells: Equal parts along the first parameter, or along each.
        poses: Images rendered by the compiled renderer, shared among the cells (at least 4 each).
        seed: Decides every random choice.
        reference_poses: The same for the reference renderer; default: a quarter of ``poses``.
            With float32 arithmetic as many are rendered by the reference in float32, too.
        downscale_factor: Images become this many times smaller.
        order: Of the forms, 1 or 2.
        arithmetic: "real" or "float32".
        rasteriser: The rules.
        seconds: Limit of each of the attacks, shared among the cells.

    Returns:
        Set, sizes, ``mpg`` and ``mpg_witness`` (mean over pixels of the length of the gap over RGB) of
        the union, ``violations`` of all attacks, and the numbers of each attack.

    Raises:
        InputError: A file or a field in it cannot be used.
    """
    scene = load_scene(load_config)
    path = load_camera_path(camera_path, downscale_factor)
    perturbation = parse_perturbation(dict(spec))
    if perturbation.scene:
        raise InputError("found variations of the scene", field="scene", fix="use verify.varied.check_varied")
    pose_set = PoseSet.around(path.cameras[frame], perturbation, path.following(frame))
    boxes = equal_cells(pose_set.box, cells)
    bounds, statistics = bound_cells(scene, pose_set, boxes, rasteriser=rasteriser, arithmetic=arithmetic, order=order)
    render, probe = compiled_renderer(scene, pose_set, rasteriser)
    other, other_probe, twin = reference_renderer(scene, pose_set, rasteriser)
    programs: list[tuple[str, Render, Probe, int]] = [("compiled", render, probe, poses)]
    fewer = poses // 4 if reference_poses is None else reference_poses
    programs.append(("reference", other, other_probe, fewer))
    if arithmetic == "float32":
        single, single_probe, _ = reference_renderer(scene, pose_set, rasteriser, torch.float32)
        programs.append(("reference_float32", single, single_probe, fewer))
    attacks: dict[str, list[Attack]] = {name: [] for name, *_ in programs}
    for number, (box, (lower, upper)) in enumerate(zip(boxes, bounds, strict=True)):
        starts = None
        for name, program, pixel, budget in programs:
            attack = falsify(
                lower, upper, box, program, twin,
                probe=pixel, poses=max(4, budget // len(boxes)), seconds=seconds / len(boxes),
                seed=seed + number, starts=None if starts is None else starts[:2],
            )  # fmt: skip
            attacks[name].append(attack)
            # where the first renderer came closest, the others look first
            starts = attack.closest if starts is None else starts
    merged = {name: merge(parts) for name, parts in attacks.items()}
    everything = merge(list(merged.values()))
    lower = np.min([low for low, _ in bounds], axis=0).astype(np.float64)
    upper = np.max([high for _, high in bounds], axis=0).astype(np.float64)
    mpg = float(np.linalg.norm(upper - lower, axis=-1).mean())
    witness = float(np.linalg.norm(everything.witness_upper - everything.witness_lower, axis=-1).mean())
    return {
        "scene": scene.name,
        "gaussians": scene.count,
        "size": [pose_set.camera.width, pose_set.camera.height],
        "frame": frame,
        "parameters": list(pose_set.box.names),
        "lower": list(pose_set.box.lower),
        "upper": list(pose_set.box.upper),
        "cells": len(boxes),
        "order": order,
        "arithmetic": arithmetic,
        "mpg": mpg,
        "mpg_witness": witness,
        "ratio": mpg / witness if witness > 0.0 else float("inf"),
        "statistics": statistics.tolist(),
        "violations": everything.violations,
        "attacks": {name: _summary(attack) for name, attack in merged.items()},
    }
