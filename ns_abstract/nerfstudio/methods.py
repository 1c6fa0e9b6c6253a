"""The methods that this package registers with nerfstudio (entry points ``nerfstudio.method_configs``).

nerfstudio loads this module whenever one of its commands starts. The settings repeat those of
nerfstudio's own methods (configs/method_configs.py:351-369, 592-647), which cannot be imported from
here: that module is the one that loads this.
"""

from __future__ import annotations

from typing import Any

from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.optimizers import AdamOptimizerConfig, RAdamOptimizerConfig
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.plugins.types import MethodSpecification

from ns_abstract.nerfstudio.loading import allow_numpy_scalars
from ns_abstract.nerfstudio.nerf import AbstractNerfModelConfig
from ns_abstract.nerfstudio.pipeline import AbstractPipelineConfig
from ns_abstract.nerfstudio.splat import AbstractSplatfactoModelConfig

# also for nerfstudio's own commands on its own methods
allow_numpy_scalars()


def _adam(rate: float, scheduler: Any = None, eps: float = 1e-15) -> dict[str, Any]:
    return {"optimizer": AdamOptimizerConfig(lr=rate, eps=eps), "scheduler": scheduler}


abstract_splatfacto = MethodSpecification(
    TrainerConfig(
        method_name="abstract-splatfacto",
        steps_per_eval_image=100,
        steps_per_eval_batch=0,
        steps_per_save=2000,
        steps_per_eval_all_images=1000,
        max_num_iterations=30000,
        mixed_precision=False,
        pipeline=AbstractPipelineConfig(
            datamanager=FullImageDatamanagerConfig(
                dataparser=NerfstudioDataParserConfig(load_3D_points=True),
                cache_images_type="uint8",
            ),
            model=AbstractSplatfactoModelConfig(),
        ),
        optimizers={
            "means": _adam(1.6e-4, ExponentialDecaySchedulerConfig(lr_final=1.6e-6, max_steps=30000)),
            "features_dc": _adam(0.0025),
            "features_rest": _adam(0.0025 / 20),
            "opacities": _adam(0.05),
            "scales": _adam(0.005),
            "quats": _adam(0.001),
            "camera_opt": _adam(
                1e-4,
                ExponentialDecaySchedulerConfig(lr_final=5e-7, max_steps=30000, warmup_steps=1000, lr_pre_warmup=0),
            ),
            "bilateral_grid": _adam(
                2e-3,
                ExponentialDecaySchedulerConfig(lr_final=1e-4, max_steps=30000, warmup_steps=1000, lr_pre_warmup=0),
            ),
        },
        viewer=ViewerConfig(num_rays_per_chunk=1 << 15),
        vis="viewer",
    ),
    description="Splatfacto; trained scenes show abstract images and open without CUDA.",
)

abstract_nerf = MethodSpecification(
    TrainerConfig(
        method_name="abstract-nerf",
        pipeline=AbstractPipelineConfig(
            datamanager=VanillaDataManagerConfig(dataparser=BlenderDataParserConfig()),
            model=AbstractNerfModelConfig(),
        ),
        optimizers={
            name: {"optimizer": RAdamOptimizerConfig(lr=5e-4, eps=1e-08), "scheduler": None}
            for name in ("fields", "temporal_distortion")
        },
    ),
    description="Vanilla NeRF of chosen size and smoothness, made to be bounded.",
)
