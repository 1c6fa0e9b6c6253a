"""The methods that this package registers with nerfstudio (entry points ``nerfstudio.method_configs``).

nerfstudio loads this module whenever one of its commands starts. The settings repeat those of
nerfstudio's own methods (configs/method_configs.py:351-369, 592-647), which cannot be imported from
here: that module is the one that loads this.
"""

from __future__ import annotations

from typing import Any

from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.optimizers import AdamOptimizerConfig, RAdamOptimizerConfig
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.models.nerfacto import NerfactoModelConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig
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
                dataparser=NerfstudioDataParserConfig(load_3D_points=True), cache_images_type="uint8"
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
            datamanager=VanillaDataManagerConfig(dataparser=BlenderDataParserConfig()), model=AbstractNerfModelConfig()
        ),
        optimizers={
            name: {"optimizer": RAdamOptimizerConfig(lr=5e-4, eps=1e-08), "scheduler": None}
            for name in ("fields", "temporal_distortion")
        },
    ),
    description="Vanilla NeRF of chosen size and smoothness, made to be bounded.",
)

abstract_nerfacto = MethodSpecification(
    TrainerConfig(
        method_name="abstract-nerfacto",
        steps_per_eval_batch=500,
        steps_per_save=2000,
        max_num_iterations=30000,
        mixed_precision=False,
        pipeline=VanillaPipelineConfig(
            datamanager=VanillaDataManagerConfig(
                dataparser=NerfstudioDataParserConfig(), train_num_rays_per_batch=1024, eval_num_rays_per_batch=1024
            ),
            model=NerfactoModelConfig(
                implementation="torch",
                # every resolution of a grid adds faces that a ray crosses, every sample a position
                num_levels=8,
                max_res=512,
                log2_hashmap_size=15,
                hidden_dim=32,
                hidden_dim_color=32,
                proposal_net_args_list=[
                    {"hidden_dim": 16, "log2_hashmap_size": 14, "num_levels": 4, "max_res": 64, "use_linear": False},
                    {"hidden_dim": 16, "log2_hashmap_size": 14, "num_levels": 5, "max_res": 128, "use_linear": False},
                ],
                num_proposal_samples_per_ray=(64, 32),
                num_nerf_samples_per_ray=24,
                far_plane=6.0,
                # black when it is shown; in training no colour of the field can stand for what is not there
                background_color="random",
                # empty space is empty from the start, and surfaces are thin
                average_init_density=0.01,
                distortion_loss_mult=0.01,
                use_appearance_embedding=False,
                camera_optimizer=CameraOptimizerConfig(mode="off"),
                eval_num_rays_per_chunk=1 << 12,
            ),
        ),
        optimizers={
            name: _adam(0.01, ExponentialDecaySchedulerConfig(lr_final=0.0001, max_steps=30000))
            for name in ("proposal_networks", "fields")
        }
        | {"camera_opt": _adam(0.001)},
    ),
    description="Nerfacto with few samples and coarse grids, made to be bounded; trains on a CPU as well.",
)
