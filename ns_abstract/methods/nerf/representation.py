"""The representations of vanilla-NeRF and nerfacto runs; torch and the bounds are imported when a run is opened."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ns_abstract.methods.nerf.hash_field import NerfactoScene
from ns_abstract.methods.nerf.load import holds_nerf, load_nerf
from ns_abstract.methods.nerf.nerfacto_load import holds_nerfacto, load_nerfacto
from ns_abstract.methods.nerf.scene import NerfScene
from ns_abstract.methods.overrides import Overrides
from ns_abstract.methods.representation import ProgramOptions, Representation
from ns_abstract.methods.runs import RunConfig

if TYPE_CHECKING:
    from ns_abstract.methods.nerf.method import NerfMethod
    from ns_abstract.methods.nerf.nerfacto_method import NerfactoMethod


def _method(scene: NerfScene, options: ProgramOptions, arithmetic: str | None, workers: int) -> NerfMethod:
    from ns_abstract.methods.nerf.method import NerfMethod
    from ns_abstract.methods.nerf.occupancy import load_grid

    options.refuse(("gsplat_version",), "is for splats, this run is a NeRF")
    grid = None if options.occupancy_grid is None else load_grid(options.occupancy_grid)
    return NerfMethod(
        scene, options.renderer, arithmetic, options.sampling, options.num_samples, options.near_plane, grid, workers,
        options.device,
    )  # fmt: skip


def _nerfacto_method(
    scene: NerfactoScene, options: ProgramOptions, arithmetic: str | None, workers: int
) -> NerfactoMethod:
    from ns_abstract.methods.nerf.nerfacto_method import NerfactoMethod

    return NerfactoMethod(scene, options, arithmetic, workers)


def _of_runs(
    holds: Callable[[RunConfig], bool], load: Callable[[Any, Overrides], Any], method: Callable[..., Any]
) -> Representation:
    """Return the representation of the runs that ``holds`` recognises."""
    return Representation(lambda source: isinstance(source, RunConfig) and holds(source), load, method, rays=True)


NERF = _of_runs(holds_nerf, load_nerf, _method)
NERFACTO = _of_runs(holds_nerfacto, load_nerfacto, _nerfacto_method)
