"""Assumptions of bounds: choices about scene, program, pictures and set, each with its origin."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ns_abstract.api.scenes import Scene
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.io.assumptions import Assumption
from ns_abstract.methods.overrides import assumption_of
from ns_abstract.refine.protocol import Method

DEFAULT = "default"


def choice(name: str, value: object, requested: object, flag: str, default: str = DEFAULT) -> Assumption:
    """Return the record of an option: its origin is ``flag`` where ``requested`` is set, else ``default``."""
    return Assumption(name, str(value), default if requested is None else flag)


def scene_choices(scene: Scene, method: Method, arithmetic: str | None) -> tuple[Assumption, ...]:
    """Return the choices made on reading a scene, and about the program that renders it."""
    options, program = scene.source.options, method.program
    choices = list(scene.assumptions)
    if options.renderer == "paper":
        # the paper's programs draw on black, whatever a scene says
        choices = [
            assumption_of(a.name, (0.0, 0.0, 0.0), "--renderer paper", a.value, a.origin)
            if a.name == "background"
            else a
            for a in choices
        ]
    renderer = "--sampling" if options.renderer is None and options.sampling is not None else "--renderer"
    choices.append(choice("renderer", program["name"], options.renderer or options.sampling, renderer))
    if "sampling" not in program:
        default = "--renderer" if options.renderer == "paper" else DEFAULT
        choices.append(
            choice("renderer version", program["version"], options.gsplat_version, "--gsplat-version", default)
        )
    else:
        choices += _ray_choices(scene, program)
    choices.append(choice("arithmetic", method.guarantee.removesuffix("-sound"), arithmetic, "--arithmetic"))
    return tuple(choices)


def _ray_choices(scene: Scene, program: dict[str, Any]) -> list[Assumption]:
    options = scene.source.options
    if program["sampling"] == "hierarchical":
        samples = Assumption(
            "num_coarse_samples", str(program["samples"]), "the run: pipeline.model.num_coarse_samples"
        )
    else:
        samples = choice("num_samples", program["samples"], options.num_samples, "--num-samples")
    choices = [
        choice("renderer version", program["version"], options.renderer, "--renderer"),
        samples,
        choice("near_plane", f"{program['near']:.9g}", options.near_plane, "--near-plane"),
        choice("device", options.device or "cpu", options.device, "--device"),
    ]
    if options.occupancy_grid is not None:
        choices.append(Assumption("occupancy_grid", options.occupancy_grid.name, "--occupancy-grid"))
    return choices


def set_choices(pose_sets: Sequence[PoseBox], size: str, varied: str) -> tuple[Assumption, ...]:
    """Return the choices about the pictures' size and the varied parameters of the sets.

    ``size``: origin of the size. ``varied``: origin of the sets.
    """
    camera = pose_sets[0].camera
    names = dict.fromkeys(name for poses in pose_sets for name in poses.box.names)
    return (
        Assumption("picture size", f"{camera.width} x {camera.height}", size),
        Assumption("varied", ", ".join(names) or "nothing", varied),
    )
