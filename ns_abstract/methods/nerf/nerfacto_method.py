"""Nerfacto runs as a method for commands and the Python API; see `ns_abstract.refine.protocol.Method`."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ns_abstract.geometry.poses import PoseBox
from ns_abstract.io.errors import InputError
from ns_abstract.methods.nerf.device import check_device
from ns_abstract.methods.nerf.field_method import (
    FieldMethod,
    arrays_digest,
    check_arithmetic,
    picture_of_parameters,
    refuse_layers,
)
from ns_abstract.methods.nerf.hash_bounds.bounds import NerfactoFrame
from ns_abstract.methods.nerf.hash_field import NerfactoScene
from ns_abstract.methods.nerf.nerfacto_render import NerfactoRenderer
from ns_abstract.methods.program_options import ProgramOptions

if TYPE_CHECKING:
    import torch

#: Options of vanilla fields, and why nerfacto does not take them.
_OTHERS = {
    "num_samples": "nerfacto has the run's numbers of samples",
    "near_plane": "rays of nerfacto begin at the camera, as in Nerfstudio's evaluation",
    "occupancy_grid": "grids are declared for fields of vanilla-nerf",
}


class NerfactoMethod(FieldMethod):
    """A nerfacto and Nerfstudio's own picture of it, in real numbers and in float64.

    ``arithmetic``: "real" or None: float32 evaluations are not enclosed. Raises InputError where an option does not go
    with nerfacto.
    """

    def __init__(
        self,
        scene: NerfactoScene,
        options: ProgramOptions | None = None,
        arithmetic: str | None = None,
        workers: int = 1,
    ) -> None:
        super().__init__(scene)
        options = options or ProgramOptions()
        check_arithmetic(arithmetic)
        if options.renderer is not None:
            fix = "leave it out"
            raise InputError(f"{options.renderer} does not draw nerfacto", field="--renderer", fix=fix)
        options.refuse(("gsplat_version",), "is for splats, this run is a NeRF")
        for name, why in _OTHERS.items():
            options.refuse((name,), why)
        if options.sampling not in (None, "hierarchical"):
            raise InputError(
                "nerfacto is sampled where its proposal fields say", field="--sampling", fix="leave it out"
            )
        if check_device(options.device) != "cpu":
            raise InputError("nerfacto is evaluated on the CPU", field="--device", fix="use cpu")
        self.scene, self.workers = scene, workers

    @property
    def program(self) -> dict[str, Any]:
        f = self.scene.field
        return {
            "name": "nerfacto",
            "version": "nerfstudio-1.1.5-torch",
            "sampling": f.spacing,
            "samples": list(f.samples),
            "near": f.near,
            "far": f.far,
        }

    @property
    def content(self) -> str:
        return f"nerfacto, {self.scene.field.text}"

    def frame(self, poses: PoseBox, sheared: bool = False, layers: bool = False) -> NerfactoFrame:
        """Return one frame. Raises InputError: layers are requested: a NeRF's depth is a median."""
        refuse_layers(layers)
        return NerfactoFrame(self.scene, poses, self.workers)

    def memory(self, pixels: int, threads: int) -> int:
        """Return the bytes that a frame needs; rays are bounded one after another."""
        weights = sum(array.nbytes for array in self.scene.field.arrays())
        return 2 * weights + pixels * (400 + 4 * sum(self.scene.field.samples)) + (1 << 30)

    @property
    def plan(self) -> tuple[str, ...]:
        f = self.scene.field
        rounds = " and ".join(map(str, f.samples[:-1]))
        return (
            f"bounded: Nerfstudio's own {f.samples[-1]} samples from {f.near:g} to {f.far:g}, where proposal fields at "
            f"{rounds} samples put them; in real numbers and in float64, of which Nerfstudio's float32 may differ",
        )

    @property
    def fingerprint(self) -> dict[str, Any]:
        f = self.scene.field
        digest = arrays_digest(f.arrays())
        behind = f.background if isinstance(f.background, str) else f.background.tolist()
        factors = f.average_init_density, *(one.average_init_density for one in f.proposals)
        digest.update(repr((f.samples, f.near, f.far, f.spacing, behind, factors, f.contraction)).encode())
        return {"scene": digest.hexdigest(), "renderer": self.program["name"], "arithmetic": "real"}

    def describe(self) -> dict[str, Any]:
        scene, f = self.scene, self.scene.field
        return {
            "name": scene.name,
            "source": str(scene.source),
            "field": f.text,
            "resolutions": f.encoding.resolutions.tolist(),
            "device": "cpu",
            "samples": list(f.samples),
            "near": f.near,
            "far": f.far,
            "background": f.background if isinstance(f.background, str) else f.background.tolist(),
            "notes": list(scene.notes),
        }

    def differentiable(self, poses: PoseBox) -> Callable[[torch.Tensor], torch.Tensor]:
        return picture_of_parameters(poses, NerfactoRenderer(self.scene.field).picture)
