"""Splatfacto with abstract images, drawn by this package's renderer where there is no CUDA."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any, Literal, cast

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.models.splatfacto import SplatfactoModel, SplatfactoModelConfig

from ns_abstract.io.errors import InputError
from ns_abstract.methods.splat.activate import Splats, activate
from ns_abstract.methods.splat.constants import VERSIONS, Rasteriser, installed_gsplat
from ns_abstract.methods.splat.load import scene_from_parameters
from ns_abstract.methods.splat.render import Renderer
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.nerfstudio.outputs import AbstractConfig, AbstractOutputs, uninterrupted
from ns_abstract.nerfstudio.panel import camera_of
from ns_abstract.viewer.views import SplatSource

_FLIP = np.array([1.0, -1.0, -1.0])


@dataclass
class AbstractSplatfactoModelConfig(SplatfactoModelConfig):
    """Splatfacto, with abstract images of the trained scene."""

    _target: type = field(default_factory=lambda: AbstractSplatfactoModel)
    abstract: AbstractConfig = field(default_factory=AbstractConfig)
    """Abstract images"""

    @classmethod
    def of(cls, config: SplatfactoModelConfig) -> AbstractSplatfactoModelConfig:
        names = {entry.name for entry in dataclasses.fields(cls)} - {"_target"}
        return cls(**{name: value for name, value in vars(config).items() if name in names})


class AbstractSplatfactoModel(AbstractOutputs, SplatfactoModel):
    """Trains as Splatfacto does; in evaluation it also bounds, and it needs no CUDA."""

    config: AbstractSplatfactoModelConfig
    gaussians = True

    def populate_modules(self) -> None:
        """Set up the parameters; without CUDA a checkpoint brings them, so that none are made of points."""
        self._shown: tuple[Any, SplatSource, Renderer] | None = None
        self._active: tuple[Any, SplatScene, Splats] | None = None
        config = self.config
        if not torch.cuda.is_available():
            self.seed_points = None
            self.config = dataclasses.replace(config, random_init=True, num_random=8)
        super().populate_modules()
        self.config = config

    def _splats(self) -> tuple[SplatScene, Splats]:
        """Return the model's current Gaussians, as a scene and activated; kept until parameters or the step change."""
        state = tuple((id(value), value._version) for value in self.gauss_params.values())
        if self._active is None or self._active[0] != (state, self.step):
            plain = self.config.sh_degree == 0
            degree = min(self.step // self.config.sh_degree_interval, self.config.sh_degree)
            if degree > 3:
                raise InputError(f"spherical harmonics of degree {degree}", fix="train with degree 3 or less")
            scene = scene_from_parameters(
                {name: value.detach().cpu().numpy() for name, value in self.gauss_params.items()},
                source="the loaded model",
                name="model",
                color_model="sigmoid" if plain else "sh",
                sh_degree=0 if plain else degree,
                rasterize_mode=cast(Literal["classic", "antialiased"], self.config.rasterize_mode),
                background=np.zeros(3, np.float32),
            )
            self._active = (state, self.step), scene, activate(scene, self._rules)
        return self._active[1:]

    @property
    def _rules(self) -> Rasteriser:
        """Rasteriser that is drawn and bounded: that of `gsplat_version`, if set, else of the installed gsplat."""
        version = self.config.abstract.gsplat_version
        return installed_gsplat() if version is None else VERSIONS[version]

    def _scene(self) -> tuple[SplatSource, Renderer]:
        """Return the shown scene: the Gaussians inside the crop box, before the background."""
        scene, splats = self._splats()
        # of the whole scene, and where the crop box leaves no Gaussian (splatfacto.py:551-554)
        background, without = (
            color.detach().cpu().numpy().astype(np.float64)
            for color in (self._get_background_color(), self.background_color)
        )
        box = self.crop_box
        crop = None if box is None else np.hstack([*map(np.ravel, (box.R, box.T, box.S)), without]).tobytes()
        state = (id(splats), background.tobytes(), crop)
        if self._shown is None or self._shown[0] != state:
            if box is not None:
                inside = box.within(torch.from_numpy(splats.means.astype(np.float32))).reshape(-1).numpy()
                parts = {name: getattr(splats, name)[inside] for name in ("means", "axes", "opacity", "sh")}
                splats = dataclasses.replace(splats, **parts)
                scene = cropped(scene, inside)
                background = background if inside.any() else without
            splats = dataclasses.replace(splats, background=background)
            rules = self._rules
            source = SplatSource(splats, scene, version=rules.version, layers=self.config.abstract.depth)
            self._shown = state, source, Renderer(splats, rules)
        return self._shown[1:]

    def abstract_source(self) -> SplatSource:
        return self._scene()[0]

    def get_outputs(self, camera: Cameras) -> dict[str, Any]:
        """Return Splatfacto's outputs; without CUDA by this package's renderer (splatfacto.py:547-665)."""
        if self.device.type == "cuda" or not isinstance(camera, Cameras):
            return super().get_outputs(camera)
        if self.training:
            raise RuntimeError("gsplat trains on CUDA only; without it, runs can be viewed, rendered and bounded")
        with uninterrupted():
            view, renderer = camera_of(camera), self._scene()[1]
            if renderer.splats.count == 0:
                return self.get_empty_outputs(view.width, view.height, self.background_color)
            background = self._get_background_color()
            pose = view.camera_to_world
            layers = renderer.layers(view, pose[:, :3].T * _FLIP[:, None], pose[:, 3])
        rgb, accumulation, depth = (torch.from_numpy(layer.astype(np.float32)) for layer in layers)
        return {
            "rgb": rgb,
            "depth": depth,
            "accumulation": accumulation,
            "background": background.expand(view.height, view.width, 3),
        }


def cropped(scene: SplatScene, inside: np.ndarray) -> SplatScene:
    """Return the Gaussians of ``scene`` where ``inside`` [N] is true; they keep their numbers in the source."""
    parts = {name: getattr(scene, name)[inside] for name in ("means", "log_scales", "quats", "opacity_logits", "sh")}
    stored = np.arange(scene.count) if scene.stored is None else scene.stored
    left_out = scene.dropped | {"outside the crop box": int((~inside).sum())}
    return dataclasses.replace(scene, **parts, stored=stored[inside], dropped=left_out)
