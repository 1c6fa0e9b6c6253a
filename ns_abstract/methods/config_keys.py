"""The keys of config.yml: what each does to the picture that Nerfstudio shows of a trained run.

Lines are those of Nerfstudio 1.1.5; `docs/keys.md` is made from these tables.
"""

from __future__ import annotations

from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import show
from ns_abstract.io.keys import Key, KeyTable, sentence
from ns_abstract.methods import runs

_MODEL = "pipeline.model."
_SPLAT, _NERF, _BASE = "models/splatfacto.py", "models/vanilla_nerf.py", "models/base_model.py"
_FACTO = "models/nerfacto.py"
_STRATEGY = "densification (`self.config.{}`), which runs in training alone"
_START = "how training starts (`self.config.{}`); the checkpoint replaces it"
_LOSS = "the loss of training (`self.config.{}`)"
_NEWER = "training in versions after 1.1.5"


def _all(why: str, file: str, lines: dict[str, int]) -> tuple[Key, ...]:
    """Return irrelevant keys with one reason, and the lines of Nerfstudio that show it."""
    return tuple(Key(name, "irrelevant", why.format(name), f"{file}:{line}") for name, line in lines.items())


def _absent(why: str, *names: str) -> tuple[Key, ...]:
    """Return irrelevant keys of Nerfstudio versions other than 1.1.5."""
    return tuple(Key(name, "irrelevant", why) for name in names)


_ABSTRACT = Key("abstract", "irrelevant", "abstract images that Nerfstudio's viewer shows beside the picture")
_EVERY_MODEL = (
    Key("_target", "used", "the class (`_target`) whose rules are bounded", "configs/base_config.py:49"),
    Key("eval_num_rays_per_chunk", "irrelevant", "rays are evaluated one by one; how many at once", f"{_BASE}:185"),
    Key("prompt", "irrelevant", "models that edit by text; neither model reads it", f"{_BASE}:54"),
)

SPLATFACTO = KeyTable(
    "`pipeline.model` of Splatfacto",
    (
        *_EVERY_MODEL,
        Key("sh_degree", "used", "the bands of the colours", f"{_SPLAT}:594"),
        Key("sh_degree_interval", "used", "the bands that step 30000 evaluates", f"{_SPLAT}:594"),
        Key("rasterize_mode", "used", "classic or antialiased", f"{_SPLAT}:616"),
        Key("background_color", "used", "the colour behind the Gaussians", f"{_SPLAT}:499"),
        Key("enable_collider", "irrelevant", "ends of rays; `get_outputs` is called without them", f"{_SPLAT}:755"),
        Key("collider_params", "irrelevant", "ends of rays; `get_outputs` is called without them", f"{_SPLAT}:755"),
        Key("loss_coefficients", "irrelevant", "weights of a NeRF's losses; Splatfacto has its own", f"{_BASE}:50"),
        Key("camera_optimizer", "irrelevant", "moves cameras under `self.training` alone", f"{_SPLAT}:543"),
        Key("use_bilateral_grid", "irrelevant", "changes colours under `self.training` alone", f"{_SPLAT}:631"),
        Key("grid_shape", "irrelevant", "size of the grid of use_bilateral_grid", f"{_SPLAT}:309"),
        Key("color_corrected_metrics", "irrelevant", "metrics that evaluation prints", f"{_SPLAT}:778"),
        Key("output_depth_during_training", "irrelevant", "depth in training; else depth is made", f"{_SPLAT}:588"),
        *_all("pictures are smaller in training alone (`self.training`)", _SPLAT, {
            "num_downscales": 477, "resolution_schedule": 477,
        }),
        *_all(_STRATEGY, _SPLAT, {
            "warmup_length": 323, "refine_every": 326, "cull_alpha_thresh": 316, "cull_scale_thresh": 320,
            "reset_alpha_every": 325, "densify_grad_thresh": 317, "use_absgrad": 328, "densify_size_thresh": 318,
            "cull_screen_size": 321, "split_screen_size": 319, "stop_screen_size_at": 322, "stop_split_at": 324,
        }),
        Key("n_split_samples", "irrelevant", "densification, which runs in training alone", f"{_SPLAT}:173"),
        *_all(_START, _SPLAT, {"random_init": 242, "num_random": 245, "random_scale": 245}),
        *_all(_LOSS, _SPLAT, {"ssim_lambda": 733, "use_scale_regularization": 719, "max_gauss_ratio": 724}),
        *_absent("densification in versions before 1.1.4", "continue_cull_post_densification"),
        *_absent(_NEWER, "strategy", "max_gs_num", "noise_lr", "mcmc_opacity_reg", "mcmc_scale_reg"),
        _ABSTRACT,
    ),
)  # fmt: skip

VANILLA_NERF = KeyTable(
    "`pipeline.model` of vanilla-nerf",
    (
        *_EVERY_MODEL,
        Key("num_coarse_samples", "used", "samples of every ray in the coarse field", f"{_NERF}:106"),
        Key("num_importance_samples", "used", "samples of every ray that are drawn by weight", f"{_NERF}:107"),
        Key("background_color", "used", "the colour behind the field; last_sample is not supported", f"{_NERF}:110"),
        Key("enable_temporal_distortion", "refused", "scenes that move cannot be bounded", f"{_NERF}:126", (False,)),
        Key("temporal_distortion_params", "irrelevant", "of what moves a scene, which is refused", f"{_NERF}:127"),
        Key("use_gradient_scaling", "irrelevant", "scales gradients; values stay", f"{_NERF}:156"),
        Key("enable_collider", "refused", "rays without ends cannot be bounded", f"{_BASE}:106", (True,),
            fix="train with a collider"),
        Key("collider_params", "used", "ends of rays", f"{_BASE}:107"),
        Key("collider_params.near_plane", "irrelevant", "0 outside of training (`self.training`)",
            "model_components/scene_colliders.py:188"),
        Key("collider_params.far_plane", "used", "where rays end", "model_components/scene_colliders.py:190"),
        Key("loss_coefficients", "irrelevant", "weights of the losses of training", f"{_NERF}:215"),
        Key("use_integrated_encoding", "refused", "mip-NeRF cannot be bounded", "", (False,)),
        Key("num_frequencies", "used", "frequencies of positions (abstract-nerf)"),
        Key("max_frequency_exponent", "used", "highest frequency of positions (abstract-nerf)"),
        Key("num_direction_frequencies", "used", "frequencies of directions (abstract-nerf)"),
        *_absent("size of the layers (abstract-nerf), which the checkpoint shows", "width", "depth"),
        *_absent("loss of training (abstract-nerf)", "smoothness_penalty"),
        _ABSTRACT,
    ),
)  # fmt: skip

_SIZE = "the size of layers and grids, as in the checkpoint (`self.config.{}`)"
_REPLACED = "ends of rays that `self.collider` replaces"
NERFACTO = KeyTable(
    "`pipeline.model` of nerfacto",
    (
        *_EVERY_MODEL,
        Key("far_plane", "used", "where rays end", f"{_FACTO}:230"),
        Key("near_plane", "irrelevant", "0 outside of training (`self.training`)",
            "model_components/scene_colliders.py:188"),
        Key("background_color", "used", "the colour behind the last sample, or that of the last sample",
            f"{_FACTO}:233"),
        *(Key(name, "used", _SIZE.format(name), f"{_FACTO}:{line}") for name, line in {
            "hidden_dim": 158, "hidden_dim_color": 164, "num_levels": 159, "features_per_level": 162,
            "log2_hashmap_size": 163,
        }.items()),
        Key("base_res", "used", "resolutions of the grids", f"{_FACTO}:161"),
        Key("max_res", "used", "resolutions of the grids", f"{_FACTO}:160"),
        Key("hidden_dim_transient", "irrelevant", "layers of transient and semantic heads, which are never built",
            f"{_FACTO}:165"),
        Key("num_proposal_samples_per_ray", "used", "samples of every ray in the proposal fields", f"{_FACTO}:222"),
        Key("num_nerf_samples_per_ray", "used", "samples of every ray in the field", f"{_FACTO}:221"),
        Key("num_proposal_iterations", "used", "rounds of proposals", f"{_FACTO}:223"),
        Key("use_same_proposal_network", "used", "one proposal field for all rounds", f"{_FACTO}:182"),
        Key("proposal_net_args_list", "used", "sizes and resolutions of the proposal fields", f"{_FACTO}:196"),
        Key("proposal_initial_sampler", "used", "how the first samples are spaced", f"{_FACTO}:217"),
        Key("use_appearance_embedding", "used", "whether colours depend on an embedding", f"{_FACTO}:153"),
        Key("use_average_appearance_embedding", "used", "the mean embedding, or zeros", f"{_FACTO}:169"),
        Key("appearance_embed_dim", "used", "the length of the embedding", f"{_FACTO}:153"),
        Key("average_init_density", "used", "a factor of all densities", f"{_FACTO}:171"),
        Key("implementation", "used", "whether grids and networks are those of torch; a checkpoint of tcnn is refused",
            f"{_FACTO}:172"),
        Key("disable_scene_contraction", "refused", "a field that ends at a box cannot be bounded", f"{_FACTO}:148",
            (False,)),
        Key("predict_normals", "irrelevant", "normals, which are drawn beside the picture", f"{_FACTO}:168"),
        Key("enable_collider", "irrelevant", _REPLACED, f"{_FACTO}:230"),
        Key("collider_params", "irrelevant", _REPLACED, f"{_FACTO}:230"),
        Key("camera_optimizer", "irrelevant", "moves rays under `self.training` alone", f"{_FACTO}:300"),
        Key("use_gradient_scaling", "irrelevant", "scales gradients; values stay", f"{_FACTO}:305"),
        Key("loss_coefficients", "irrelevant", "weights of a NeRF's losses; nerfacto has its own", f"{_BASE}:50"),
        *_all("jitter of samples in training (`self.config.{}`)", _FACTO, {"use_single_jitter": 224}),
        *_all("how often proposals are trained (`self.config.{}`)", _FACTO, {
            "proposal_update_every": 212, "proposal_warmup": 210,
        }),
        *_all("an exponent of weights in training, which a loaded model leaves at 1 (`self.config.{}`)", _FACTO, {
            "use_proposal_weight_anneal": 266, "proposal_weights_anneal_slope": 279,
            "proposal_weights_anneal_max_num_iters": 268,
        }),
        *_all(_LOSS, _FACTO, {
            "interlevel_loss_mult": 374, "distortion_loss_mult": 378, "orientation_loss_mult": 381,
            "pred_normal_loss_mult": 386,
        }),
    ),
)  # fmt: skip

_DATA = "pipeline.datamanager."
_PHOTOS = "photos and batches of training; the cameras of a path are drawn without them"
_HERE = "the run is read from the folder of config.yml"
_TRAINED = "training and its progress; a checkpoint is shown as it is"

RUN = KeyTable(
    "config.yml outside of `pipeline.model`",
    (
        Key("pipeline.model", "used", "see the tables of the models", "pipelines/base_pipeline.py:219"),
        Key("method_name", "used", "which model the run is of", "utils/eval_utils.py:93"),
        Key("experiment_name", "used", "the scene's name in reports", "configs/experiment_config.py:117"),
        Key("relative_model_dir", "used", "the folder of the checkpoints", "configs/experiment_config.py:122"),
        Key("load_step", "used", "the checkpoint that is shown", "utils/eval_utils.py:59"),
        Key("load_dir", "irrelevant", "set anew before a checkpoint is loaded", "utils/eval_utils.py:102"),
        Key("load_checkpoint", "irrelevant", "where training goes on from", "engine/trainer.py:441"),
        Key("load_config", "irrelevant", "the configuration that training took", "engine/trainer.py:81"),
        Key("mixed_precision", "irrelevant", "training steps alone (`autocast`)", "engine/trainer.py:501"),
        Key("_target", "irrelevant", "the trainer", "engine/trainer.py:58"),
        Key("pipeline._target", "irrelevant", "ns-render draws with `pipeline.model` alone", "scripts/render.py:197"),
        *_all(_HERE, "configs/experiment_config.py", {"output_dir": 118, "timestamp": 118}),
        *_all(_TRAINED, "configs/experiment_config.py", {
            "machine": 49, "logging": 51, "viewer": 53, "vis": 66, "project_name": 45, "optimizers": 57, "data": 70,
            "prompt": 72, "load_scheduler": 76,
        }),
        *_all(_TRAINED, "engine/trainer.py", {
            "steps_per_save": 60, "steps_per_eval_batch": 62, "steps_per_eval_image": 64,
            "steps_per_eval_all_images": 66, "max_num_iterations": 68, "use_grad_scaler": 72,
            "save_only_latest_checkpoint": 74, "log_gradients": 85, "gradient_accumulation_steps": 87,
            "start_paused": 89,
        }),
        Key(f"{_DATA}dataparser", "used", "whether a data set's transforms.json can be placed in the run's frame",
            "data/datamanagers/base_datamanager.py:312"),
        *_all(_PHOTOS, "data/datamanagers/base_datamanager.py", {f"{_DATA}{name}": line for name, line in {
            "_target": 104, "data": 106, "masks_on_gpu": 108, "images_on_gpu": 110,
            "train_num_rays_per_batch": 314, "train_num_images_to_sample_from": 316,
            "train_num_times_to_repeat_images": 318, "eval_num_rays_per_batch": 321,
            "eval_num_images_to_sample_from": 323, "eval_num_times_to_repeat_images": 325, "eval_image_indices": 328,
            "collate_fn": 330, "camera_res_scale_factor": 332, "patch_size": 336, "camera_optimizer": 340,
            "pixel_sampler": 342,
        }.items()}),
        *_all(_PHOTOS, "data/datamanagers/full_images_datamanager.py", {f"{_DATA}{name}": line for name, line in {
            "cache_images": 66, "cache_images_type": 68, "max_thread_workers": 70,
            "train_cameras_sampling_strategy": 72, "train_cameras_sampling_seed": 76, "fps_reset_every": 79,
        }.items()}),
        *_all(_PHOTOS, "data/datamanagers/parallel_datamanager.py", {
            f"{_DATA}num_processes": 57, f"{_DATA}queue_size": 59,
        }),
        *_absent("photos of training, in versions after 1.1.5", *(f"{_DATA}{name}" for name in (
            "dataloader_num_workers", "prefetch_factor", "cache_compressed_images", "load_from_disk",
        ))),
    ),
)  # fmt: skip

TABLES = (SPLATFACTO, VANILLA_NERF, NERFACTO, RUN)

#: Classes of ``pipeline.model`` whose defaults are known.
_CONFIGS = frozenset({
    "nerfstudio.models.splatfacto.SplatfactoModelConfig",
    "nerfstudio.models.vanilla_nerf.VanillaModelConfig",
    "nerfstudio.models.nerfacto.NerfactoModelConfig",
    "ns_abstract.nerfstudio.splat.AbstractSplatfactoModelConfig",
    "ns_abstract.nerfstudio.nerf.AbstractNerfModelConfig",
})  # fmt: skip


def _check_defaults(run: runs.RunConfig, model: KeyTable) -> None:
    """Refuse a run of a configuration class with other defaults, where a key is absent that the picture depends on."""
    name = runs.config_class(run)
    if not name or name in _CONFIGS:
        return
    for key in model.keys:
        if key.status != "irrelevant" and key.name != "_target" and key.name.partition(".")[0] not in run.model:
            raise InputError(
                f"is absent: its value is the default of {show(name)}, which is not known here",
                file=run.file,
                field=_MODEL + key.name,
                fix="write its value",
            )


def check_keys(run: runs.RunConfig, model: KeyTable, refuse_unknown: bool = True) -> tuple[str, ...]:
    """Return notes on unknown keys of a run's config.yml, which are not used.

    ``model``: the keys of ``pipeline.model``: `SPLATFACTO`, `VANILLA_NERF` or `NERFACTO`. ``refuse_unknown``: whether a
    key of ``pipeline.model`` that is in no table is refused, or named in the notes. Raises InputError where a key of
    ``pipeline.model`` is unknown, a key has a value that is refused, or one is absent whose default is not known.
    """
    _check_defaults(run, model)
    try:
        names = RUN.unknown(run.root, "", runs.as_mapping)
        inner = model.unknown(run.model, _MODEL, runs.as_mapping)
        if inner and refuse_unknown:
            raise InputError(
                f"unknown key; it may change the picture, and nothing here draws by it ({', '.join(inner)})",
                field=_MODEL + inner[0],
                fix="give a run of splatfacto, nerfacto or vanilla-nerf, or remove the key if it changes nothing",
            )
    except InputError as error:
        raise error.within(run.file) from None
    return sentence([*names, *(_MODEL + name for name in inner)], run.file.name)
