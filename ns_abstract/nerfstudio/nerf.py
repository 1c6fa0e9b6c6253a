"""A vanilla NeRF that is made to be bounded, and abstract images for vanilla NeRFs."""

from __future__ import annotations

import dataclasses
import math
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.field_components.encodings import NeRFEncoding
from nerfstudio.fields.vanilla_nerf_field import NeRFField
from nerfstudio.models.vanilla_nerf import NeRFModel, VanillaModelConfig
from nerfstudio.utils.colors import COLORS_DICT

from ns_abstract.io.errors import InputError
from ns_abstract.methods.nerf.load import FIX, field_weights
from ns_abstract.methods.nerf.model_state import ModelState
from ns_abstract.methods.nerf.scene import NerfScene
from ns_abstract.nerfstudio.outputs import AbstractConfig, AbstractOutputs, resampled
from ns_abstract.nerfstudio.panel import camera_of
from ns_abstract.viewer.views import NerfSource

#: Seconds that a picture may take while the camera moves, and in the end; each picture of a view that stays has so
#: many times the pixels of the one before.
_FIRST, _LAST, _GROWTH = 0.2, 3.2, 4.0
_CROPPED = "the whole field is bounded, a part of it is shown", "switch the crop box off"
#: Rays by second that are assumed before any was drawn, and fewest rows of a picture.
_RAYS, _ROWS = 200.0, 6


@dataclass
class AbstractNerfModelConfig(VanillaModelConfig):
    """A vanilla NeRF whose size and smoothness can be chosen; the defaults of the sizes are small."""

    _target: type = field(default_factory=lambda: AbstractNerfModel)
    width: int = 128
    """Units of every layer of the position network"""
    depth: int = 4
    """Layers of the position network; half way the encoded position is fed in again"""
    num_frequencies: int = 6
    """Frequencies of the encoded position, from 1 to 2^max_frequency_exponent"""
    max_frequency_exponent: float = 5.0
    """Exponent of the highest frequency of the encoded position"""
    num_direction_frequencies: int = 2
    """Frequencies of the encoded direction, from 1 to 2^(their number - 1)"""
    smoothness_penalty: float = 0.0
    """Weight of the logarithm of a Lipschitz bound of the networks in the loss; 1e-4 is a start"""
    abstract: AbstractConfig = field(default_factory=lambda: AbstractConfig(seconds=0.0, viewer_seconds=120.0))
    """Abstract images; rays are bounded one after the other, so they are for small pictures"""

    @classmethod
    def of(cls, config: VanillaModelConfig) -> AbstractNerfModelConfig:
        """Return the configuration of Nerfstudio's vanilla-nerf (vanilla_nerf.py:82-104) with abstract images."""
        names = {entry.name for entry in dataclasses.fields(VanillaModelConfig)} - {"_target"}
        settings = {name: value for name, value in vars(config).items() if name in names}
        return cls(
            **settings, width=256, depth=8, num_frequencies=10, max_frequency_exponent=8.0, num_direction_frequencies=0
        )


class AbstractNerfModel(AbstractOutputs, NeRFModel):
    """Trains as vanilla-nerf does, with networks of the chosen size and a penalty on their steepness."""

    config: AbstractNerfModelConfig

    def populate_modules(self) -> None:
        """Set up the fields."""
        super().populate_modules()
        self._shown: tuple[Any, NerfSource] | None = None
        #: what was drawn last: of which view, the outputs, and seconds for the next picture of it
        self._drawn: tuple[Any, dict[str, torch.Tensor], float] | None = None
        self._speed = _RAYS
        #: why the picture that was drawn last is not bounded: problem and fix
        self._unlike: tuple[str, str] | None = None
        c = self.config
        if c.num_direction_frequencies == 0:
            # nerfstudio's own fields
            return
        self.field_coarse, self.field_fine = (
            NeRFField(
                position_encoding=NeRFEncoding(3, c.num_frequencies, 0.0, c.max_frequency_exponent, include_input=True),
                direction_encoding=NeRFEncoding(
                    3, c.num_direction_frequencies, 0.0, c.num_direction_frequencies - 1.0, include_input=True
                ),
                base_mlp_num_layers=c.depth,
                base_mlp_layer_width=c.width,
                head_mlp_layer_width=max(1, c.width // 2),
                skip_connections=(c.depth // 2,),
            )
            for _ in range(2)
        )

    def abstract_source(self) -> NerfSource | None:
        """Return the shown fields; None where they cannot be bounded.

        Raises:
            InputError: Only a part is shown, or by another camera.
        """
        c = self.config
        if c.enable_temporal_distortion or not c.enable_collider or c.background_color == "last_sample":
            return None
        if self._unlike is not None:
            raise InputError(self._unlike[0], fix=self._unlike[1])
        fields = (self.field_coarse, self.field_fine)
        state = tuple((id(p), p._version) for one in fields if one is not None for p in one.parameters())
        background = self._color_behind()
        key = state, background.tobytes()
        if self._shown is None or self._shown[0] != key:
            self._shown = key, NerfSource(self._scene(background))
        return self._shown[1]

    def _scene(self, background: np.ndarray) -> NerfScene:
        c = self.config
        exponents = (8.0, 4.0)
        if c.num_direction_frequencies:
            exponents = c.max_frequency_exponent, c.num_direction_frequencies - 1.0
        arrays = {name: value.detach().cpu().float().numpy() for name, value in self.state_dict().items()}
        state = ModelState(arrays, Path("the loaded model"), FIX)
        coarse, fine = (field_weights(state, name, exponents) for name in ("field_coarse", "field_fine"))
        return NerfScene(
            coarse=coarse,
            fine=fine,
            near=0.0,
            far=float(c.collider_params["far_plane"]),  # pyright: ignore[reportOptionalSubscript]
            coarse_samples=c.num_coarse_samples,
            importance_samples=c.num_importance_samples,
            background=background,
            name="model",
            source="the loaded model",
        )

    def _color_behind(self) -> np.ndarray:
        """Return the [3] colour behind the last sample; black where it is random (renderers.py:144-146)."""
        color = self.renderer_rgb.background_color
        if isinstance(color, str):
            color = COLORS_DICT.get(color, torch.zeros(3, dtype=torch.float32))
        return color.detach().cpu().numpy().astype(np.float32).reshape(3)

    def _concrete(self, camera: Any, obb_box: Any) -> dict[str, torch.Tensor]:
        """Return the model's own outputs; in a viewer without CUDA small ones first, so that the camera can move."""
        lens = _other_lens(camera)
        self._unlike = lens if obb_box is None else _CROPPED
        if not self.abstract.control.present or self.device.type == "cuda" or self.training or lens is not None:
            return with_depth(super()._concrete(camera, obb_box))
        pinhole = camera_of(camera)
        box = None if obb_box is None else tuple(torch.cat([obb_box.R.flatten(), obb_box.T, obb_box.S]).tolist())
        key = pinhole.camera_to_world.tobytes(), round(pinhole.fy / pinhole.height, 6), box
        best, seconds = self._drawn[1:] if self._drawn is not None and self._drawn[0] == key else ({}, _FIRST)
        if seconds <= _LAST:
            # pictures of one view never shrink, however slow the machine has become
            rows = max([_ROWS, *(value.shape[0] for value in best.values())])
            factor = max(
                1.0, min(math.sqrt(pinhole.width * pinhole.height / (self._speed * seconds)), pinhole.height / rows)
            )
            small = pinhole.rescaled(factor)
            pose = camera.camera_to_worlds.reshape(-1, 3, 4)[:1]
            at = Cameras(pose, small.fx, small.fy, small.cx, small.cy, small.width, small.height).to(self.device)
            start = time.perf_counter()
            best = with_depth(super()._concrete(at, obb_box))
            self._speed = small.width * small.height / (time.perf_counter() - start)
            self._drawn = key, best, _GROWTH * seconds if factor > 1.0 else math.inf
            self.abstract.control.draw()
        return {name: resampled(value, pinhole.height, pinhole.width) for name, value in best.items()}

    def get_loss_dict(self, outputs: Any, batch: Any, metrics_dict: Any = None) -> dict[str, torch.Tensor]:
        """Return the losses of vanilla-nerf and the penalty."""
        losses = super().get_loss_dict(outputs, batch, metrics_dict)
        if self.config.smoothness_penalty > 0.0:
            fields = [f for f in (self.field_coarse, self.field_fine) if f is not None]
            steepness = torch.stack([log_lipschitz(f) for f in fields]).mean()
            losses["smoothness"] = self.config.smoothness_penalty * steepness
        return losses


def _other_lens(camera: Cameras) -> tuple[str, str] | None:
    """Return problem and fix where rays are not of a perspective camera without distortion (cameras.py:622-790)."""
    if bool((camera.camera_type != CameraType.PERSPECTIVE.value).any()):
        return "only perspective cameras are bounded", "choose Perspective in the viewer's Render tab"
    if camera.distortion_params is not None and bool(camera.distortion_params.any()):
        return "the lens is distorted, and cameras without distortion are bounded", "draw a camera path"
    return None


def with_depth(outputs: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return the outputs and ``depth``, without which the viewer's thread ends (render_state_machine.py:198)."""
    return {**outputs, "depth": outputs["depth_fine"]}


def log_lipschitz(module: torch.nn.Module) -> torch.Tensor:
    """Return the sum over the linear layers of the logarithm of their norm from maximum to maximum.

    The exponential bounds how much a network of these layers and of activations that are no steeper
    than 1 stretches a box, up to skip connections (H.-T. D. Liu et al., "Learning smooth neural
    functions via Lipschitz regularization", 2022, eq. 5); interval bounds widen by just these norms (design.md, W5).
    """
    norms = [layer.weight.abs().sum(dim=1).max() for layer in module.modules() if isinstance(layer, torch.nn.Linear)]
    return torch.stack(norms).log().sum()
