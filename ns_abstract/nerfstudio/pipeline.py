"""A pipeline that opens runs for evaluation on machines without CUDA or network."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig

from ns_abstract.nerfstudio.loading import lpips_weights
from ns_abstract.nerfstudio.outputs import AbstractOutputs


@dataclass
class AbstractPipelineConfig(VanillaPipelineConfig):
    """Pipeline of methods with abstract images."""

    _target: type = field(default_factory=lambda: AbstractPipeline)


class AbstractPipeline(VanillaPipeline):
    """nerfstudio's pipeline, which skips downloads and reads that a checkpoint replaces."""

    def __init__(
        self,
        config: AbstractPipelineConfig,
        device: str,
        test_mode: Literal["test", "val", "inference"] = "val",
        **more: Any,
    ) -> None:
        # "val" is what ns-train asks for
        evaluating = test_mode != "val"
        parser = getattr(config.datamanager, "dataparser", None)
        if evaluating and parser is not None and hasattr(parser, "load_3D_points"):
            # the points would need open3d, and the checkpoint replaces them
            parser.load_3D_points = False
        with lpips_weights(download=not evaluating):
            super().__init__(config, device, test_mode, **more)
        manager: Any = self.datamanager.config
        if hasattr(manager, "cache_images") and not torch.cuda.is_available():
            # "gpu" is the model's device; "cpu" pins memory, which needs an accelerator
            manager.cache_images = "gpu"
        assert isinstance(self.model, AbstractOutputs)
        if evaluating:
            self.model.start_evaluation()
        else:
            self.model.abstract.hide()
