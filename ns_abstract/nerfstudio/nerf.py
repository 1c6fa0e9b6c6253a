"""A vanilla NeRF that is made to be bounded, and abstract images for vanilla NeRFs."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

import torch
from nerfstudio.field_components.encodings import NeRFEncoding
from nerfstudio.fields.vanilla_nerf_field import NeRFField
from nerfstudio.models.vanilla_nerf import NeRFModel, VanillaModelConfig

from ns_abstract.nerfstudio.outputs import AbstractConfig, AbstractOutputs


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
    abstract: AbstractConfig = field(default_factory=AbstractConfig)
    """Abstract images"""

    @classmethod
    def of(cls, config: VanillaModelConfig) -> AbstractNerfModelConfig:
        """The configuration of nerfstudio's vanilla-nerf (vanilla_nerf.py:82-104) with abstract images."""
        known = {entry.name for entry in dataclasses.fields(VanillaModelConfig)} - {"_target"}
        given = {name: value for name, value in vars(config).items() if name in known}
        return cls(
            **given,
            width=256,
            depth=8,
            num_frequencies=10,
            max_frequency_exponent=8.0,
            num_direction_frequencies=0,
        )


class AbstractNerfModel(AbstractOutputs, NeRFModel):
    """Trains as vanilla-nerf does, with networks of the chosen size and a penalty on their steepness."""

    config: AbstractNerfModelConfig

    def populate_modules(self) -> None:
        """Set up the fields."""
        super().populate_modules()
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

    def get_loss_dict(self, outputs: Any, batch: Any, metrics_dict: Any = None) -> dict[str, torch.Tensor]:
        """The losses of vanilla-nerf and the penalty."""
        losses = super().get_loss_dict(outputs, batch, metrics_dict)
        if self.config.smoothness_penalty > 0.0:
            fields = [f for f in (self.field_coarse, self.field_fine) if f is not None]
            steepness = torch.stack([log_lipschitz(f) for f in fields]).mean()
            losses["smoothness"] = self.config.smoothness_penalty * steepness
        return losses


def log_lipschitz(module: torch.nn.Module) -> torch.Tensor:
    """Sum over the linear layers of the logarithm of their norm from maximum to maximum.

    The exponential bounds how much a network of these layers and of activations that are no steeper
    than 1 stretches a box, up to skip connections (H.-T. D. Liu et al., "Learning smooth neural
    functions via Lipschitz regularization", 2022, eq. 5); interval bounds widen by just these norms.
    """
    norms = [layer.weight.abs().sum(dim=1).max() for layer in module.modules() if isinstance(layer, torch.nn.Linear)]
    return torch.stack(norms).log().sum()
