"""Scenes, as the Python interface and the command lines open them."""

from __future__ import annotations

import os
from copy import copy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.geometry.tiles import assemble
from ns_abstract.geometry.transform import DataparserTransform
from ns_abstract.io.arguments import file_path, one_of
from ns_abstract.io.assumptions import Assumption
from ns_abstract.io.errors import InputError
from ns_abstract.methods.load import open_scene
from ns_abstract.methods.overrides import UNSAID, OverrideKeywords, Overrides, assumption_of
from ns_abstract.methods.program_options import ProgramOptions
from ns_abstract.methods.runs import NO_TRANSFORMS, placing_parser, read_config
from ns_abstract.perturbation.specification import Perturbation
from ns_abstract.refine.protocol import Method, PreciseFrame

if TYPE_CHECKING:
    from typing import Unpack  # pyright: ignore[reportAttributeAccessIssue]  # of Python 3.11

#: It reads COLMAP's model, and no ``transforms.json``.
_COLMAP_PARSER = "ColmapDataParser"


@dataclass(frozen=True)
class SceneSource:
    """Where a scene is read from."""

    file: Path
    options: ProgramOptions = field(default_factory=ProgramOptions)
    overrides: Overrides = field(default_factory=Overrides)

    @property
    def absolute(self) -> SceneSource:
        """The same with absolute paths."""
        grid = None if self.options.occupancy_grid is None else self.options.occupancy_grid.absolute()
        return replace(self, file=self.file.absolute(), options=replace(self.options, occupancy_grid=grid))

    def open(self) -> Scene:
        """Read it. Raises InputError where a file or an option cannot be used."""
        return Scene(self)


class Scene:
    """A trained scene and the program that draws it.

    Args:
        source: Where it is read from.

    Raises:
        InputError: A file or an option cannot be used.
    """

    def __init__(self, source: SceneSource) -> None:
        self.source = source
        self._representation, self._content = open_scene(source.file, source.overrides)
        self._methods: dict[tuple[str | None, int], Method] = {}

    def method(self, arithmetic: str | None = None, workers: int = 1) -> Method:
        """Return the bounding method of this scene.

        Args:
            arithmetic: "float32" or "real"; None: the strongest that the representation has.

        Raises:
            InputError: An option does not go with the scene.
        """
        if arithmetic is not None:
            one_of(arithmetic, ("float32", "real"), "--arithmetic")
        key = arithmetic, workers if self.rays else 1
        if key not in self._methods:
            self._methods[key] = self._representation.method(self._content, self.source.options, arithmetic, workers)
        return self._methods[key]

    @property
    def rays(self) -> bool:
        """Whether pictures are made ray by ray; see `ns_abstract.methods.representation.Representation`."""
        return self._representation.rays

    @property
    def name(self) -> str:
        return self.method().name

    @property
    def notes(self) -> tuple[str, ...]:
        """What was assumed on reading it, one sentence each."""
        return tuple(self.method().notes)

    @property
    def run_frame(self) -> DataparserTransform | None:
        """From the frame of the run's data set to the run's; None where no run says so."""
        if any(entry.origin == NO_TRANSFORMS for entry in self.assumptions):
            return None
        if self.source.file.is_file() and self.source.file.suffix.lower() not in (".yml", ".yaml"):
            return None
        return self._content.dataparser

    @property
    def data_frame(self) -> DataparserTransform | None:
        """From the frame of a ``transforms.json`` to the run's; None where no run says so."""
        frame = self.run_frame
        parser = None if frame is None else placing_parser(read_config(self.source.file))
        return None if frame is None or parser is None else replace(frame, original=parser == _COLMAP_PARSER)

    @property
    def background(self) -> tuple[float, ...] | None:
        """RGB behind the scene; None where its file says nothing of it."""
        unsaid = any(entry.name == "background" and entry.origin == UNSAID for entry in self.assumptions)
        color = self._content.background
        return None if unsaid or isinstance(color, str) else tuple(map(float, color))

    def on_background(self, color: tuple[float, ...], origin: str) -> Scene:
        """Return the same scene on another RGB ``color``, not read again; ``origin`` says who chose it.

        Raises:
            InputError: It is no color of three numbers from 0 to 1.
        """
        scene, overrides = copy(self), replace(self.source.overrides, background=color)  # pyright: ignore[reportArgumentType]
        color = overrides.background or color
        scene.source, scene._methods = replace(self.source, overrides=overrides), {}
        record = assumption_of("background", None, "", color, origin)
        choices = tuple(record if entry.name == record.name else entry for entry in self.assumptions)
        scene._content = replace(self._content, background=np.array(color, np.float32), assumptions=choices)
        return scene

    @property
    def assumptions(self) -> tuple[Assumption, ...]:
        """What was decided of the picture on reading it, and where each choice came from."""
        return tuple(self._content.assumptions)

    def __repr__(self) -> str:
        method = self.method()
        return f"<Scene {self.name}: {method.content}, {method.program['name']} {method.program['version']}>"


def checked_scene(value: Any) -> Scene:
    """Return ``value``, which is a scene. Raises InputError where it is none."""
    if not isinstance(value, Scene):
        fix = "give what ns_abstract.load_scene returns"
        raise InputError(f"found {type(value).__name__}", field="scene", fix=fix)
    return value


def not_a_camera(value: Any, field: str = "camera") -> InputError:
    """Return the error of the argument ``field`` that is no camera."""
    fix = "give an ns_abstract.Camera, or one of a path's .cameras"
    return InputError(f"found {type(value).__name__}", field=field, fix=fix)


def load_scene(
    path: str | os.PathLike[str],
    *,
    renderer: str | None = None,
    sampling: str | None = None,
    num_samples: int | None = None,
    near_plane: float | None = None,
    occupancy_grid: str | os.PathLike[str] | None = None,
    gsplat_version: str | None = None,
    device: str | None = None,
    **overrides: Unpack[OverrideKeywords],
) -> Scene:
    """Read a scene; nothing in the files is executed.

    Args:
        path: ``config.yml`` of a Splatfacto, vanilla-nerf or nerfacto run, or a scene file (docs/formats.md).
        renderer: "gsplat" (what Nerfstudio shows of splats; their default) or "paper" (Algorithm 1 or 2 of "Abstract
            Rendering").
        sampling: NeRF: "uniform" (default) or "hierarchical".
        num_samples: NeRF: bins of every ray; 64.
        near_plane: NeRF: start of the rays in normalised units; 0.
        occupancy_grid: NeRF: a grid outside of which the field is declared empty.
        gsplat_version: Splats: whose rules are bounded, "1.4.0" (default), "1.5.3" or "1.6.0".
        device: NeRF: where the field is bounded, "cpu" (default) or "cuda" (a GPU's float64).
        **overrides: Fields of `Overrides`: what is said in place of the files.

    Raises:
        InputError: A file or an option cannot be used.
    """
    grid = None if occupancy_grid is None else file_path(occupancy_grid, "occupancy_grid")
    file = file_path(path, "path")
    options = ProgramOptions(renderer, gsplat_version, sampling, num_samples, near_plane, grid, device)  # pyright: ignore[reportArgumentType]
    scene = SceneSource(file, options, Overrides(**overrides)).open()  # pyright: ignore[reportArgumentType]
    # options that do not go with the scene are told at once
    scene.method()
    return scene


def render(scene: Scene, camera: PinholeCamera) -> np.ndarray:
    """Return the picture of one camera, float64 [H, W, 3] in [0, 1]: what `bound` encloses.

    Raises:
        InputError: The camera cannot be used.
    """
    if not isinstance(camera, PinholeCamera):
        raise not_a_camera(camera)
    frame = checked_scene(scene).method().frame(PoseBox.around(camera, Perturbation()))
    draw = frame.precise if isinstance(frame, PreciseFrame) else frame.render
    return assemble(draw(frame.box.middle), frame.camera).astype(np.float64)
