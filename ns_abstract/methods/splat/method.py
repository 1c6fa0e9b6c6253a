"""Splatfacto scenes as a method for commands and the Python API; see `ns_abstract.refine.protocol.Method`."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ns_abstract.arithmetic.rounding import REAL, Arithmetic, charges
from ns_abstract.arithmetic.rounding import arithmetic as arithmetic_named
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.poses import COLOR_SHIFTS, PoseBox, PoseForms
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import unusable
from ns_abstract.methods.overrides import Overrides
from ns_abstract.methods.representation import ProgramOptions, Representation
from ns_abstract.methods.runs import RunConfig
from ns_abstract.methods.splat.activate import SH_C0, Splats, activate
from ns_abstract.methods.splat.bounds import SceneSums
from ns_abstract.methods.splat.constants import RASTERISERS, VERSIONS, Rasteriser, raster_rules, rasteriser_named
from ns_abstract.methods.splat.frame import SplatFrame
from ns_abstract.methods.splat.load import load_run, load_scene
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.methods.splat.stage_data import ProjectedGaussians, ViewingAxes
from ns_abstract.methods.splat.sub_box_bounds import SubBoxBounds
from ns_abstract.methods.splat.variations import VariedSplats, vary
from ns_abstract.methods.splat.weights import SplatWeightFrame, WhiteGaussians, plane_mask
from ns_abstract.perturbation.specification import Perturbation
from ns_abstract.perturbation.variations import SceneVariation
from ns_abstract.refine.protocol import MOST_PARTS, Frame, Method, SceneElements, WeightPlane

if TYPE_CHECKING:
    import torch

    from ns_abstract.methods.splat.reference import Reference

#: What bounds are of where the run's model may draw more.
GAUSSIANS_ALONE = "of the Gaussians alone"
#: Bytes that the kernels need by Gaussian and cell, beside the scene itself (record, boxes, colours, buffers).
_BYTES_BY_GAUSSIAN = 1200
#: The same of the ranges of a varied scene and of the scene sample that is rendered.
_BYTES_BY_VARIED = 400
#: Sets of scenes at hand.
_KEPT = 8
_WITH_TILES = "the alpha threshold and tiles"


class SplatMethod(Method):
    """A splat scene and the bounded renderer.

    Args:
        renderer: "gsplat" or "paper"; None: gsplat.
        version: gsplat's, of `VERSIONS`; None: 1.4.0.
        arithmetic: "float32" or "real"; None: float32.
    """

    def __init__(
        self, scene: SplatScene, renderer: str | None, arithmetic: str | None, version: str | None = None
    ) -> None:
        self.scene = scene
        self.rasteriser: Rasteriser = rasteriser_named(renderer, version)
        self.arithmetic: Arithmetic = arithmetic_named(arithmetic or "float32")
        self.guarantee = f"{self.arithmetic.name}-sound"
        self.splats: Splats = activate(scene, self.rasteriser)
        self._varied: dict[tuple[SceneVariation, ...], VariedSplats] = {}
        self._sums: dict[tuple[SceneVariation, ...], SceneSums] = {}
        self._reference: Reference | None = None

    @property
    def name(self) -> str:
        return self.scene.name

    @property
    def notes(self) -> tuple[str, ...]:
        return tuple(self.scene.notes)

    @property
    def dataset_scale(self) -> float | None:
        return self.scene.dataparser.stated_scale

    @property
    def program(self) -> dict[str, Any]:
        return {"name": self.rasteriser.name, "version": self.rasteriser.version}

    @property
    def content(self) -> str:
        alone = " alone, of a model that may draw more" if self.scene.gaussians_alone else ""
        return f"{self.scene.count:,} Gaussians{alone}"

    def frame(self, poses: PoseBox, sheared: bool = False, layers: bool = False) -> SplatFrame:
        """Return one frame; ``sheared``, ``layers``: see `SplatFrame`; the paper's renderer has no layers."""
        if layers and self.rasteriser.name != "gsplat":
            raise InputError("the paper's renderer has no depth", field="--outputs", fix="leave it out")
        varied = self.varied(poses.perturbation.scene)
        sums = self._sums[poses.perturbation.scene]
        return SplatFrame(
            self.splats, self.rasteriser, self.arithmetic, poses, varied=varied, sheared=sheared, layers=layers,
            reference=self._slow, sums=sums,
        )  # fmt: skip

    def weight_frame(self, poses: PoseBox, planes: Sequence[WeightPlane], pixels: np.ndarray) -> SplatWeightFrame:
        """Return the frame of the weights of selected Gaussians; tiles without a pixel to read cost nothing."""
        masks = [plane_mask(self.scene, self.splats.opacity, plane) for plane in planes]
        varied = self.varied(poses.perturbation.scene)
        sums = self._sums[poses.perturbation.scene]
        white = WhiteGaussians.of(masks, [plane.nearer for plane in planes])
        return SplatWeightFrame(white, self.splats, self.rasteriser, self.arithmetic, poses, varied, sums, self._slow)

    def ablations(self, poses: PoseBox) -> Iterator[tuple[str, SplatFrame]]:
        return ablations(self.scene, self.rasteriser, self.arithmetic, poses, self.varied(poses.perturbation.scene))

    def attribution(self, frame: Frame, box: ParameterBox, tile: int, count: int) -> list[tuple[int, float]]:
        assert isinstance(frame, SplatFrame)
        return attribution(frame, box, tile, count)

    def prepare(self, perturbations: Sequence[Perturbation]) -> None:
        """Find the Gaussians that vary.

        Raises:
            InputError: A selection is empty, its file cannot be used, or a variation is one of a NeRF.
        """
        for perturbation in perturbations:
            for name in COLOR_SHIFTS:
                if getattr(perturbation, name) is not None:
                    problem = "varies the colours of a NeRF, not of a Splatfacto scene"
                    raise InputError(problem, field=name, fix="remove the key")
            self.varied(perturbation.scene)

    def varied(self, variations: tuple[SceneVariation, ...]) -> VariedSplats:
        """Return the scenes of a set."""
        if variations not in self._varied:
            while len(self._varied) >= _KEPT:
                oldest = next(iter(self._varied))
                del self._varied[oldest], self._sums[oldest]
            varied = vary(self.scene, self.splats, variations)
            rules = raster_rules(self.rasteriser, self.splats.antialiased)
            self._sums[variations] = SceneSums(self.splats, varied, rules, charges(self.arithmetic))
            self._varied[variations] = varied
        return self._varied[variations]

    def memory(self, pixels: int, threads: int) -> int:
        arrays = (self.splats.means, self.splats.axes, self.splats.opacity, self.splats.sh)
        ranges = sum(v.varies for v in self._varied.values()) * _BYTES_BY_VARIED
        # cells that are bounded side by side have buffers of their own
        by_gaussian = self.splats.count * (min(threads, MOST_PARTS) * _BYTES_BY_GAUSSIAN + ranges)
        return 2 * sum(a.nbytes for a in arrays) + by_gaussian + pixels * 400 + (256 << 20)

    @property
    def plan(self) -> tuple[str, ...]:
        scene, splats, plan = self.scene, self.splats, []
        for reason, count in scene.dropped.items():
            plan.append(f"{count:,} stored Gaussians left out: {reason}")
        if scene.color_model == "sigmoid":
            plan.append("view dependence left out: the run stores plain colours (sh_degree 0)")
        elif splats.degree < scene.sh_degree:
            why = "the paper's renderer has RGB colours" if not self.rasteriser.view_dependent else "all zero"
            first, last = splats.degree + 1, scene.sh_degree
            bands = f"band {last}" if first == last else f"bands {first} to {last}"
            plan.append(f"spherical-harmonics {bands} left out: {why}")
        if not splats.antialiased:
            plan.append("opacity compensation left out: rasterize_mode is classic")
        return tuple(plan)

    @property
    def fingerprint(self) -> dict[str, Any]:
        scene, digest = self.scene, hashlib.sha256()
        for array in (scene.means, scene.log_scales, scene.quats, scene.opacity_logits, scene.sh, scene.background):
            digest.update(np.ascontiguousarray(array).tobytes())
        digest.update(repr((scene.color_model, scene.sh_degree, scene.rasterize_mode)).encode())
        return {
            "scene": digest.hexdigest(),
            "renderer": self.rasteriser.name,
            "version": self.rasteriser.version,
            "arithmetic": self.arithmetic.name,
            # selections name Gaussians by their numbers in the source
            **({} if scene.stored is None else {"stored": hashlib.sha256(scene.stored.tobytes()).hexdigest()}),
            **({"bounded": "Gaussians alone"} if scene.gaussians_alone else {}),
        }

    def describe(self) -> dict[str, Any]:
        scene = self.scene
        return {
            "name": scene.name,
            "source": str(scene.source),
            "gaussians": scene.count,
            "sh_degree": scene.sh_degree,
            "sh_degree_used": self.splats.degree,
            "rasterize_mode": scene.rasterize_mode,
            "background": [float(v) for v in scene.background],
            "notes": list(scene.notes),
            **({"bounded": GAUSSIANS_ALONE} if scene.gaussians_alone else {}),
        }

    def elements(self) -> SceneElements:
        """Return the Gaussians in the colours of band 0."""
        splats, base = self.splats, self.splats.sh[:, 0]
        colors = base if splats.degree == 0 else SH_C0 * base + 0.5
        return SceneElements(splats.means, splats.axes, np.clip(colors, 0.0, 1.0), splats.opacity)

    def differentiable(self, poses: PoseBox) -> Callable[[torch.Tensor], torch.Tensor]:
        """Return the reference renderer, from parameter values [d] to the picture [H, W, 3]."""
        from ns_abstract.geometry.differentiable_pose import differentiable_pose

        reference, pose = self._slow(), differentiable_pose(poses)
        return lambda values: reference.image(poses.camera, pose(values))

    def _slow(self) -> Reference:
        from ns_abstract.methods.splat.reference import Reference

        if self._reference is None:
            self._reference = Reference(self.scene, self.rasteriser)
        return self._reference


def _load(source: RunConfig | Path, overrides: Overrides) -> SplatScene:
    return load_run(source, overrides) if isinstance(source, RunConfig) else load_scene(source, overrides)


def _method(scene: SplatScene, options: ProgramOptions, arithmetic: str | None, workers: int) -> SplatMethod:
    nerf = ("sampling", "num_samples", "near_plane", "occupancy_grid", "device")
    options.refuse(nerf, "is for runs of vanilla-nerf, this run is a splat")
    if options.renderer == "paper":
        options.refuse(("gsplat_version",), "the paper's renderer is not gsplat")
    if options.renderer not in (None, *RASTERISERS):
        raise unusable(options.renderer, field="--renderer", fix=f"use {' or '.join(RASTERISERS)}")
    if options.gsplat_version not in (None, *VERSIONS):
        raise InputError(
            f"found {options.gsplat_version}", field="--gsplat-version", fix=f"use one of {', '.join(VERSIONS)}"
        )
    return SplatMethod(scene, options.renderer, arithmetic, options.gsplat_version)


# what no other representation reads is a splat's
SPLAT = Representation(lambda source: True, _load, _method)


@dataclass(frozen=True)
class CauseTuning:
    """How ablations replace a rule, and how many Gaussians attribution examines; no picture's bound uses them."""

    #: The threshold that stands for none: a jump by this part of it is not seen.
    threshold_part: float = 2.0**-5
    #: Groups of Gaussians that are left out in turn, and of them what is looked at closer.
    groups: int = 12
    closer: int = 3


_TUNING = CauseTuning()


class _OrderedBounds(SubBoxBounds):
    """Bounds that assume the depth order of the cell's middle."""

    def _viewing_axes(
        self, forms: PoseForms, rotation_magnitude: np.ndarray, gaussians: ProjectedGaussians
    ) -> ViewingAxes:
        axes = super()._viewing_axes(forms, rotation_magnitude, gaussians)
        gaussians.depth_error[:] = 0.0
        axes.depth[1:] = 0.0
        return axes


def ablations(
    scene: SplatScene, rasteriser: Rasteriser, arithmetic: Arithmetic, poses: PoseBox, varied: VariedSplats
) -> Iterator[tuple[str, SplatFrame]]:
    """Yield the causes of looseness that the scene has, each with the frame without it."""

    def frame(rules: Rasteriser = rasteriser, computed: Arithmetic = arithmetic, fixed: bool = False) -> SplatFrame:
        splats = activate(scene, rules)
        scenes = None
        if varied.varies and not fixed:
            scenes = vary(scene, splats, poses.perturbation.scene)
        return SplatFrame(splats, rules, computed, poses, varied=scenes)

    if arithmetic.name != REAL.name:
        yield "rounding of float32", frame(computed=REAL)
    ordered = frame()
    ordered.bounds = _OrderedBounds(ordered.bounds.splats, rasteriser, arithmetic, ordered.varied)
    yield "the order of depth", ordered
    if rasteriser.transmittance_min > 0.0:
        yield "the stop where little light is left", frame(replace(rasteriser, transmittance_min=-1.0))
    if rasteriser.tile_size and rasteriser.alpha_min > 0.0:
        smaller = replace(
            rasteriser, tile_size=0, axis_sigmas=0.0, alpha_min=_TUNING.threshold_part * rasteriser.alpha_min
        )
        # later versions miss no tile in which alpha reaches the threshold
        names = "the alpha threshold" if rasteriser.axis_sigmas or rasteriser.ellipse_tiles else _WITH_TILES
        yield names, frame(smaller)
    if ordered.bounds.splats.degree > 0:
        yield "colours that depend on the view", frame(replace(rasteriser, view_dependent=False))
    if varied.varies:
        yield "variations of the scene", frame(fixed=True)


def attribution(frame: SplatFrame, box: ParameterBox, tile: int, count: int) -> list[tuple[int, float]]:
    """Return the Gaussians that cost a tile the most mean gap over a cell, and how much each costs.

    Groups are left out in turn, and those that matter are subdivided, so Gaussians that matter only together may be
    missed.
    """
    forms, tiles = frame.pose_set.enclosure(box, frame.order), np.array([tile])

    def gap(candidates: np.ndarray | None) -> tuple[float, np.ndarray]:
        cell = frame.bounds.cell(frame.camera, forms, tiles, candidates)
        return float((cell.upper - cell.lower).mean()), cell.visible

    whole, visible = gap(None)
    groups = [visible.astype(np.int32)]
    while True:
        pieces = [
            piece for group in groups for piece in np.array_split(group, min(_TUNING.groups, group.size)) if piece.size
        ]
        gains = [whole - gap(np.setdiff1d(visible, piece).astype(np.int32))[0] for piece in pieces]
        best = np.argsort(gains)[::-1][: max(_TUNING.closer, count)]
        groups = [pieces[k] for k in best]
        if all(group.size <= 1 for group in groups):
            return [(int(pieces[k][0]), gains[k]) for k in best[:count] if gains[k] > 0.0]
