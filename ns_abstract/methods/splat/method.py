"""Splatfacto runs as the command lines see them; see `ns_abstract.pipeline.Method`."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from ns_abstract.arithmetic.units import Arithmetic
from ns_abstract.arithmetic.units import arithmetic as arithmetic_named
from ns_abstract.errors import InputError
from ns_abstract.methods.splat.activate import Splats, activate
from ns_abstract.methods.splat.constants import RASTERISERS, Rasteriser
from ns_abstract.methods.splat.frame import SplatFrame
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.methods.splat.variations import VariedSplats, vary
from ns_abstract.sets.perturbation import Perturbation
from ns_abstract.sets.poses import COLOR_SHIFTS, PoseSet, translation_only
from ns_abstract.sets.variations import SceneVariation

#: Bytes that the kernels need by Gaussian, beside the scene itself (record, boxes, colours, buffers).
_BYTES_BY_GAUSSIAN = 1200
#: The same of the ranges of a varied scene and of the member that is rendered.
_BYTES_BY_VARIED = 400


class SplatMethod:
    """A splat scene and the program that is bounded.

    Args:
        scene: The scene.
        renderer: "gsplat" or "paper"; None: gsplat.
        arithmetic: "float32" or "real"; None: float32.
    """

    def __init__(self, scene: SplatScene, renderer: str | None, arithmetic: str | None) -> None:
        self.scene = scene
        self.rasteriser: Rasteriser = RASTERISERS[renderer or "gsplat"]
        self.arithmetic: Arithmetic = arithmetic_named(arithmetic or "float32")
        self.splats: Splats = activate(scene, self.rasteriser)
        self._varied: dict[tuple[SceneVariation, ...], VariedSplats] = {}

    @property
    def program(self) -> dict[str, Any]:
        """Name and version of the bounded program."""
        return {"name": self.rasteriser.name, "version": self.rasteriser.version}

    @property
    def guarantee(self) -> str:
        """What bounds of this program are called."""
        return f"{self.arithmetic.name}-sound"

    @property
    def content(self) -> str:
        """The scene in a few words."""
        return f"{self.scene.count:,} Gaussians"

    def frame(self, poses: PoseSet, slanted: bool = False) -> SplatFrame:
        """One frame, ready for refinement; ``slanted``: see `SplatFrame`."""
        varied = self.varied(poses.perturbation.scene)
        return SplatFrame(self.splats, self.rasteriser, self.arithmetic, poses, varied=varied, slanted=slanted)

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
        """The scenes of a set."""
        if variations not in self._varied:
            self._varied[variations] = vary(self.scene, self.splats, variations)
        return self._varied[variations]

    def memory(self, pixels: int) -> int:
        """Bytes that bounding pictures of ``pixels`` needs beside the leaves."""
        arrays = (self.splats.means, self.splats.axes, self.splats.opacity, self.splats.sh)
        ranges = sum(v.varies for v in self._varied.values()) * _BYTES_BY_VARIED
        by_gaussian = self.splats.count * (_BYTES_BY_GAUSSIAN + ranges)
        return 2 * sum(a.nbytes for a in arrays) + by_gaussian + pixels * 400 + (256 << 20)

    def frame_plan(self, frame: SplatFrame, shown: int | None, lower: np.ndarray, upper: np.ndarray) -> list[str]:
        """What was left out for one frame, given what refinement found."""
        total = self.splats.count
        plan = []
        if shown is not None and shown < total:
            plan.append(
                f"{total - shown:,} of {total:,} Gaussians left out: no pose of the set shows them "
                "(behind, beside, hidden by others or below the alpha threshold)"
            )
        varied = frame.varied
        for quantity, name in (("mean", "mean"), ("opacity", "opacity"), ("color", "colour")):
            if count := varied.counts[quantity]:
                plan.append(f"scene variations: the {name} of {count:,} of {total:,} Gaussians varies")
            elif varied.varies:
                plan.append(f"ranges of the {name} left out: none varies")
        if not varied.counts["mean"] and translation_only(frame.pose_set.enclosure(frame.box, 1)):
            plan.append("depth-order rules left out but for near-ties: translations never change the order")
        return plan

    @property
    def plan(self) -> tuple[str, ...]:
        """What is left out for this scene, whatever the frame."""
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
        """Scene and program, for results that are continued."""
        scene, digest = self.scene, hashlib.sha256()
        for array in (scene.means, scene.log_scales, scene.quats, scene.opacity_logits, scene.sh, scene.background):
            digest.update(np.ascontiguousarray(array).tobytes())
        digest.update(repr((scene.color_model, scene.sh_degree, scene.rasterize_mode)).encode())
        return {
            "scene": digest.hexdigest(),
            "renderer": self.rasteriser.name,
            "arithmetic": self.arithmetic.name,
        }

    def describe(self) -> dict[str, Any]:
        """The scene for reports."""
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
        }
