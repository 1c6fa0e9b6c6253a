"""Vanilla-NeRF runs as a method for commands and the Python API; see `ns_abstract.refine.protocol.Method`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.differentiable_pose import differentiable_pose
from ns_abstract.geometry.poses import COLOR_SHIFTS, PoseBox
from ns_abstract.io.arguments import float64_of, whole
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import unusable
from ns_abstract.methods.nerf.bounds import NerfBounds
from ns_abstract.methods.nerf.device import check_device, processes_that_fit
from ns_abstract.methods.nerf.field_method import (
    FieldMethod,
    arrays_digest,
    check_arithmetic,
    picture_of_parameters,
    refuse_layers,
)
from ns_abstract.methods.nerf.frame import NerfFrame
from ns_abstract.methods.nerf.occupancy import VOXEL_BYTES, OccupancyGrid
from ns_abstract.methods.nerf.ray_field import basis_of, device_bytes
from ns_abstract.methods.nerf.render import NerfRenderer, Sampling
from ns_abstract.methods.nerf.scene import NerfScene
from ns_abstract.methods.nerf.white import WhiteSamples
from ns_abstract.refine.protocol import MOST_PLANES, Bounds, SceneSample, WeightPlane

#: Samples by ray where nothing is said: those of Nerfstudio's coarse pass.
_SAMPLES = 64
_SAMPLES_LIMIT = 4096


class NerfMethod(FieldMethod):
    """A vanilla NeRF and the program that is bounded: the fine field at N uniform samples.

    Args:
        renderer: "paper" (black behind the last sample) or None.
        arithmetic: "real" or None: float32 evaluations of a network are not enclosed.
        sampling: "uniform" (None: the same), or "hierarchical": Nerfstudio's own picture (design.md, F16).
        num_samples: N of uniform samples; None: 64.
        near_plane: Start of the rays, normalised units; None: 0, as in Nerfstudio's evaluation.
        workers: Processes that bound rays; on a GPU, as many of them as have room there.
        occupancy: Declared as part of the scene: density is 0 outside of its occupied voxels.
        device: Where the field is bounded and drawn: "cpu" (None: the same) or "cuda".
    """

    def __init__(
        self,
        scene: NerfScene,
        renderer: str | None = None,
        arithmetic: str | None = None,
        sampling: str | None = None,
        num_samples: int | None = None,
        near_plane: float | None = None,
        occupancy: OccupancyGrid | None = None,
        workers: int = 1,
        device: str | None = None,
    ) -> None:
        if renderer not in (None, "paper"):
            raise InputError(f"{renderer} draws splats, this run is a NeRF", field="--renderer", fix="leave it out")
        check_arithmetic(arithmetic)
        if sampling not in (None, "uniform", "hierarchical"):
            raise InputError(f"found {sampling}", field="--sampling", fix="use uniform or hierarchical")
        hierarchical = sampling == "hierarchical"
        if hierarchical and num_samples is not None:
            raise InputError(
                "hierarchical sampling has the run's numbers of samples",
                field="--num-samples",
                fix="leave it out, or use --sampling uniform",
            )
        if hierarchical and renderer == "paper":
            raise InputError("the paper's renderer samples uniformly", field="--sampling", fix="use uniform")
        samples = whole(_SAMPLES if num_samples is None else num_samples, 1, "--num-samples", _SAMPLES_LIMIT)
        plane = scene.near if near_plane is None else near_plane
        near = float64_of(plane)
        if not 0.0 <= near < scene.far:
            raise unusable(plane, field="--near-plane", fix=f"give 0 or more, below {scene.far:g}")
        super().__init__(scene)
        self.scene = scene if occupancy is None else replace(scene, occupancy=occupancy)
        self.workers = workers
        self.device = check_device(device)
        self.paper = renderer == "paper"
        background = np.zeros(3) if self.paper else scene.background
        red, green, blue = (float(v) for v in background)
        self.sampling = Sampling("uniform", near, scene.far, samples, 0, (red, green, blue))
        if hierarchical:
            bins, importance = scene.coarse_samples, scene.importance_samples
            self.sampling = Sampling("hierarchical", near, scene.far, bins, importance, (red, green, blue))

    @property
    def program(self) -> dict[str, Any]:
        s = self.sampling
        version = "algorithm-2" if self.paper else "nerfstudio-1.1.5-field"
        return {
            "name": "paper-nerf" if self.paper else f"nerf-{s.kind}",
            "version": version,
            "sampling": s.kind,
            "samples": s.samples,
            **({} if self.scene.occupancy is None else {"occupancy": self.scene.occupancy.describe()}),
            "near": s.near,
            "far": s.far,
        }

    @property
    def content(self) -> str:
        return f"vanilla NeRF, {self.scene.fine.text}"

    def frame(self, poses: PoseBox, sheared: bool = False, layers: bool = False) -> NerfFrame:
        """Return one frame; its cells are never ``sheared``."""
        refuse_layers(layers)
        return NerfFrame(self.scene, self.sampling, poses, self.device, self._processes(poses.geometry.box.dimensions))

    def weight_frame(self, poses: PoseBox, planes: Sequence[WeightPlane], pixels: np.ndarray) -> NerfWeightFrame:
        """Return the frame of the weights of samples in boxes, or of distances along the rays."""
        workers = self._processes(poses.geometry.box.dimensions)
        return NerfWeightFrame(self.scene, self.sampling, poses, planes, pixels, self.device, workers)

    def _processes(self, dimensions: int) -> int:
        """Return the number of processes that bound rays of a set with ``dimensions`` parameters."""
        if self.device == "cpu":
            return self.workers
        field, swept = self.scene.fine, self.sampling.kind == "hierarchical"
        return processes_that_fit(device_bytes(field, basis_of(dimensions + swept, field)), self.workers)

    def memory(self, pixels: int, threads: int) -> int:
        """Return the bytes that a frame needs; rays are bounded one after another."""
        weights = sum(array.nbytes for array in self.scene.fine.arrays())
        voxels = 0 if self.scene.occupancy is None else self.scene.occupancy.occupied.size
        return 8 * weights + VOXEL_BYTES * voxels + pixels * (400 + 4 * self.sampling.samples) + (1 << 30)

    @property
    def plan(self) -> tuple[str, ...]:
        s, scene = self.sampling, self.scene
        grid = scene.occupancy
        declared = () if grid is None else (f"density declared 0 outside of a grid: {grid.describe()}",)
        declared += scene.fine.plan
        shows = scene.coarse_samples + scene.importance_samples + 1
        if s.kind == "hierarchical":
            return (
                f"bounded: Nerfstudio's own {shows} samples from {s.near:g} to {s.far:g}, followed where the coarse "
                f"field puts them; on cells too wide for that, anywhere in the {s.samples} bins of the coarse pass",
                *declared,
            )
        return (
            f"bounded: the fine field at the middles of {s.samples} equal bins from {s.near:g} to {s.far:g} "
            f"(Algorithm 2 of the paper); Nerfstudio's own picture puts {shows} samples where the coarse field "
            "has weight and differs from it",
            "the coarse field left out: uniform samples do not need it",
            *declared,
        )

    @property
    def fingerprint(self) -> dict[str, Any]:
        fields = [self.scene.fine] + [self.scene.coarse] * (self.sampling.kind == "hierarchical")
        digest = arrays_digest(array for field in fields for array in field.arrays())
        if self.scene.occupancy is not None:
            digest.update(self.scene.occupancy.digest)
        digest.update(repr((self.scene.fine.position, self.scene.fine.direction, self.sampling)).encode())
        return {"scene": digest.hexdigest(), "renderer": self.program["name"], "arithmetic": "real"}

    def describe(self) -> dict[str, Any]:
        scene, s = self.scene, self.sampling
        return {
            "name": scene.name,
            "source": str(scene.source),
            "field": scene.fine.text,
            "device": self.device,
            "samples": s.samples,
            "near": s.near,
            "far": s.far,
            "background": list(s.background),
            "notes": list(scene.notes),
        }

    def differentiable(self, poses: PoseBox) -> Callable[[torch.Tensor], torch.Tensor]:
        """Return the renderer, from parameter values [d] to the picture [H, W, 3]."""
        return picture_of_parameters(poses, NerfRenderer(self.scene, self.sampling).picture)


def white_samples(planes: Sequence[WeightPlane], sampling: Sampling) -> WhiteSamples:
    """Return the samples that the planes select.

    Raises:
        InputError: A selection is one of Gaussians, or the samples' positions depend on the picture.
    """
    if sampling.kind != "uniform":
        raise InputError(
            "weights are bounded of uniform samples", field="--sampling", fix="use uniform, or a property of colours"
        )
    lower, upper = np.full((MOST_PLANES, 3), np.inf), np.full((MOST_PLANES, 3), -np.inf)
    nearer = np.full(MOST_PLANES, np.inf)
    for k, plane in enumerate(planes):
        lower[k], upper[k] = -np.inf, np.inf
        if plane.select is not None:
            others = replace(plane.select, box=None)
            if plane.select.box is None or others != type(others)():
                raise InputError("a NeRF has no Gaussians", field="select", fix="give a box alone")
            lower[k], upper[k] = plane.select.box
        if plane.nearer is not None:
            nearer[k] = plane.nearer
    return WhiteSamples(lower, upper, nearer)


class NerfWeightFrame(NerfFrame):
    """A NeRF's frame of blending weights, which shifts of colours do not change.

    ``scene``, ``sampling``, ``pose_set``, ``device``, ``workers``: as in `NerfFrame`. ``pixels``: [H, W] the rays that
    are read; others have no meaningful bounds. Raises InputError: see `white_samples`.
    """

    def __init__(
        self,
        scene: NerfScene,
        sampling: Sampling,
        pose_set: PoseBox,
        planes: Sequence[WeightPlane],
        pixels: np.ndarray,
        device: str = "cpu",
        workers: int = 1,
    ) -> None:
        white = white_samples(planes, sampling)
        # the poses alone, and black behind the last sample
        super().__init__(scene, replace(sampling, background=(0.0,) * 3), pose_set.geometry, device, workers)
        self.renderer = NerfRenderer(scene, self._recipe[1], device=device, white=white)
        self._recipe = (*self._recipe, None, white)
        self.bounds = NerfBounds(*self._recipe)
        # the brightest first, so that few of them may say enough
        rays, weights = np.flatnonzero(pixels), np.zeros(pixels.size)
        weights[rays] = self.render(self.box.middle, rays).max(axis=(1, 2, 3))
        self.rays = rays[np.argsort(-weights[rays], kind="stable")]
        self._dimensions = pose_set.box.dimensions

    def of_sample(self, values: np.ndarray, sample: SceneSample | None) -> np.ndarray:
        """Return the tiles of weights at a pose, of the stored scene or of ``sample``; 0 on rays that are not read."""
        tiles = np.zeros((self.tile_count, 1, 1, 3), np.float32)
        tiles[self.rays] = self.render(values[: self.box.dimensions], self.rays)
        return tiles

    def differentiable(self, values: torch.Tensor) -> torch.Tensor:
        """Return weights [H, W, 3] at parameter values [d], differentiable where samples are selected."""
        return self.renderer.picture(self.camera, differentiable_pose(self.pose_set)(values[: self.box.dimensions]))

    def cell_bounds(
        self, box: ParameterBox, weigh: Callable[[], np.ndarray | None] | None = None, most_rays: int | None = None
    ) -> Bounds:
        """Return linear bounds of all tiles over a cell; rays that are not read have zeros."""
        plain = super().cell_bounds(box.without(COLOR_SHIFTS), weigh, most_rays)
        assert plain.linear is not None
        d, more = self.box.dimensions, self._dimensions - self.box.dimensions
        linear = list(plain.linear)
        for k in (0, 2):
            linear[k] = np.concatenate([linear[k], np.zeros((*linear[k].shape[:-1], more), np.float32)], axis=-1)
        slopes = np.concatenate([plain.slopes[:d], np.zeros(more)])
        return replace(plain, linear=(linear[0], linear[1], linear[2], linear[3]), slopes=slopes)
