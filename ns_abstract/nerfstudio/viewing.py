"""Opens a run in nerfstudio's viewer; imported only when it is asked for."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import yaml
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.models.splatfacto import SplatfactoModelConfig
from nerfstudio.models.vanilla_nerf import VanillaModelConfig
from nerfstudio.pipelines.base_pipeline import Pipeline
from nerfstudio.scripts.viewer.run_viewer import _start_viewer
from nerfstudio.utils.eval_utils import eval_setup

from ns_abstract.geometry.keyframe_cameras import around
from ns_abstract.io.errors import InputError
from ns_abstract.methods.load import load_any
from ns_abstract.methods.overrides import Overrides
from ns_abstract.methods.runs import read_config
from ns_abstract.methods.splat.formats.readers import scene_file
from ns_abstract.methods.splat.load import load_scene
from ns_abstract.methods.splat.write import write_splatfacto_run
from ns_abstract.nerfstudio.loading import allow_numpy_scalars, check_tags
from ns_abstract.nerfstudio.nerf import AbstractNerfModelConfig
from ns_abstract.nerfstudio.pipeline import AbstractPipeline
from ns_abstract.nerfstudio.splat import AbstractSplatfactoModelConfig

#: Hosts that only this machine reaches.
_LOOPBACK = ("127.0.0.1", "localhost", "::1")
#: Rays of a NeRF that are drawn at once on a CPU.
_CHUNK = 256
_FIX_DATA = "start the command in the folder that ns-train was started in, or put the data set back"


def view(
    load_config: Path,
    vis: Literal["viewer", "viewer_legacy"],
    options: dict[str, Any],
    abstract: dict[str, Any],
    overrides: Overrides | None = None,
) -> None:
    """Open the run and serve the viewer until the process is interrupted.

    ``options``: of its ``ViewerConfig``. ``abstract``: of splats' `AbstractConfig`. Raises InputError where the run
    cannot be opened.
    """
    overrides = overrides or Overrides()
    with tempfile.TemporaryDirectory(prefix="ns-abstract-viewer-") as scratch:
        config_file = load_config
        named = config_file.suffix.lower() in (".yml", ".yaml")
        if not named and not (config_file.is_dir() and scene_file(config_file, None) is None):
            config_file = run_of_ply(config_file, Path(scratch), overrides)
            overrides = Overrides(background=overrides.background)
        config, pipeline, step = open_run(config_file, abstract, overrides)
        if options["websocket_host"] not in _LOOPBACK or options["make_share_url"]:
            print(
                "the viewer is open to others: whoever reaches this machine sees the scene, moves the camera and "
                "starts work here",
                flush=True,
            )
        chunk = config.viewer.num_rays_per_chunk
        config.vis = vis
        config.viewer = ViewerConfig(**options, num_rays_per_chunk=chunk)
        _start_viewer(config, pipeline, step)


def run_of_ply(file: Path, folder: Path, overrides: Overrides | None = None) -> Path:
    """Write the scene of a file as a run into ``folder``; returns its config.yml."""
    scene = load_scene(file, overrides)
    middle = np.median(scene.means.astype(np.float64), axis=0)
    distance = 3.0 * float(np.quantile(np.linalg.norm(scene.means - middle, axis=1), 0.8)) + 1e-3
    views = [around(middle, 45.0 * k, 20.0, distance) for k in range(8)]
    return write_splatfacto_run(scene, folder, timestamp="ply", experiment_name="scene", views=views)


def open_run(
    config_file: Path, abstract: Mapping[str, Any] | None = None, overrides: Overrides | None = None
) -> tuple[TrainerConfig, Pipeline, int]:
    """Return Nerfstudio's ``eval_setup`` with models that bound; the run may have been moved.

    config.yml is read by nerfstudio's own loader, which can run code, so it is read before by ours, which runs none,
    and so is the checkpoint: what names other objects than runs of nerfstudio do is refused. ``abstract`` are options
    of splats' `AbstractConfig`; ``overrides`` are set in the configuration. A model that is not known to draw what
    Splatfacto or vanilla-nerf draws is refused. Returns configuration, pipeline and training step. Raises InputError
    where the run cannot be opened.
    """
    run = read_config(config_file)
    check_tags(run.root, run.file)
    overrides = overrides or Overrides()
    problem = "does not change what the viewer loads; export the run with ns-abstract-export ply and open the .ply"
    overrides.refuse(("assume_splatfacto", "drop_nan_gaussians"), problem)
    # refuses classes and modules that draw more, and checkpoints that hold other objects
    load_any(run.file, overrides)
    allow_numpy_scalars()

    def prepare(config: TrainerConfig) -> TrainerConfig:
        config = _prepared(config, run.file)
        _set_options(config.pipeline.model, abstract or {})
        _set_overrides(config, overrides)
        return config

    try:
        config, pipeline, _, step = eval_setup(run.file, test_mode="test", update_config_callback=prepare)
    except (yaml.YAMLError, AttributeError, ImportError) as error:
        raise InputError(
            f"nerfstudio cannot open it: {error}", file=run.file, fix="give a run of nerfstudio 1.1.5"
        ) from None
    if overrides.background is not None and isinstance(config.pipeline.model, AbstractSplatfactoModelConfig):
        model: Any = pipeline.model
        model.set_background(torch.tensor(overrides.background))
    return config, pipeline, step


def _set_options(model: Any, abstract: Mapping[str, Any]) -> None:
    for name, value in abstract.items():
        if value and not isinstance(model, AbstractSplatfactoModelConfig):
            raise InputError("this run is no splat", field="--" + name.replace("_", "-"), fix="leave it out")
        setattr(model.abstract, name, value)


def _set_overrides(config: TrainerConfig, overrides: Overrides) -> None:
    model: Any = config.pipeline.model
    if overrides.load_step is not None:
        config.load_step = overrides.load_step
    if overrides.rasterize_mode is not None:
        model.rasterize_mode = overrides.rasterize_mode
    if overrides.background is not None:
        # splatfacto.py:498-509: "random" is the colour that the model's set_background was given
        splat = isinstance(config.pipeline.model, AbstractSplatfactoModelConfig)
        model.background_color = "random" if splat else torch.tensor(overrides.background)


def _prepared(config: TrainerConfig, file: Path) -> TrainerConfig:
    model: Any = config.pipeline.model
    if type(model) is SplatfactoModelConfig:
        config.pipeline.model = AbstractSplatfactoModelConfig.of(model)
    elif type(model) is VanillaModelConfig:
        config.pipeline.model = AbstractNerfModelConfig.of(model)
    elif not isinstance(model, (AbstractSplatfactoModelConfig, AbstractNerfModelConfig)):
        raise InputError(
            f"the method {config.method_name} is not bounded in the viewer",
            file=file,
            field="pipeline.model",
            fix="bound it with ns-abstract-render; the viewer takes splatfacto, vanilla-nerf, abstract-splatfacto "
            "and abstract-nerf",
        )
    config.pipeline._target = AbstractPipeline
    if isinstance(config.pipeline.model, AbstractNerfModelConfig) and not torch.cuda.is_available():
        # pictures are interrupted between chunks when the camera moves
        config.pipeline.model.eval_num_rays_per_chunk = min(_CHUNK, config.pipeline.model.eval_num_rays_per_chunk)
    folder = file.resolve().parent
    if (folder.name, folder.parent.name) == (config.timestamp, config.method_name):
        # nerfstudio looks below the working directory
        config.output_dir, config.experiment_name = folder.parents[2], folder.parents[1].name
    _find_data(config, file)
    return config


def _find_data(config: TrainerConfig, file: Path) -> None:
    """Point the data manager to the data set, which config.yml names relative to some folder."""
    manager: Any = config.pipeline.datamanager
    named = manager.data if manager.data is not None else manager.dataparser.data
    for base in (Path(), *file.resolve().parents):
        # beside the method's folder, where the whole folder was moved
        for folder in (base / named, base / named.name):
            if folder.exists():
                manager.data = manager.dataparser.data = folder
                if config.data is not None:
                    config.data = folder
                return
    raise InputError(f"no data set {named}", file=file, field="pipeline.datamanager.data", fix=_FIX_DATA)
