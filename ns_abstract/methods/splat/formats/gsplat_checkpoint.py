"""Checkpoints of gsplat's ``simple_trainer.py``: ``ckpts/ckpt_STEP_rankR.pt`` and ``cfg.yml`` beside their folder.

Every rank holds a part of the Gaussians; all are read. Only what the trainer's evaluation draws by gsplat's pinhole
rasteriser is taken: appearance models, other cameras and 3DGUT are refused.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from ns_abstract.io.errors import InputError, visible
from ns_abstract.io.jsonio import show, unusable
from ns_abstract.methods.checkpoint import read_checkpoint, to_float32
from ns_abstract.methods.overrides import Overrides
from ns_abstract.methods.runs import read_mapping
from ns_abstract.methods.splat.formats.decoded import RENDER_ELSEWHERE, TWO_D, DecodedSplats, float32_rows, reserve

CONFIG = "cfg.yml"
_NAME = re.compile(r"ckpt_(\d{1,12})_rank(\d{1,6})\.pt")
_PARAMETERS = ("means", "scales", "quats", "opacities", "sh0", "shN")
#: Other contents of a checkpoint that evaluation does not use: poses of the training pictures.
_UNUSED = ("step", "pose_adjust")
_BANDS = (1, 4, 9, 16)
#: Values of cfg.yml under which pictures are those that gsplat draws of the Gaussians alone.
_PLAIN: dict[str, tuple[Any, ...]] = {
    "camera_model": ("pinhole",),
    "with_ut": (False,),
    "with_eval3d": (False,),
    "app_opt": (False,),
    "near_plane": (0.01,),
    "far_plane": (1e10,),
}
_FIELDS = {"scales": "splats.scales", "quats": "splats.quats", "opacities": "splats.opacities", "colours": "splats.sh0"}


def is_gsplat_checkpoint(path: Path) -> bool:
    """Whether a file is named as gsplat's trainer names its checkpoints."""
    return _NAME.fullmatch(path.name) is not None


def checkpoint(folder: Path, step: int | None) -> Path | None:
    """Return the first rank of a checkpoint in a folder or its ``ckpts``; None where there is none.

    ``step``: whose checkpoint is wanted; None: the last one. Raises InputError where there are checkpoints, but not of
    this step.
    """
    for inner in (folder, folder / "ckpts"):
        names = (_NAME.fullmatch(file.name) for file in inner.iterdir()) if inner.is_dir() else ()
        checkpoints = {(int(match[1]), int(match[2])): inner / match[0] for match in names if match is not None}
        if checkpoints:
            wanted = max(at for at, _ in checkpoints) if step is None else step
            ranks = sorted(key for key in checkpoints if key[0] == wanted)
            if not ranks:
                there = ", ".join(map(str, sorted({at for at, _ in checkpoints})[:20]))
                problem = f"names step {step}, there are {there}"
                raise InputError(problem, file=inner, field="--load-step", fix="give one of these")
            return checkpoints[ranks[0]]
    return None


def decode_gsplat_checkpoint(path: Path, overrides: Overrides) -> DecodedSplats:
    """Return the Gaussians of a checkpoint, of all its ranks.

    Raises:
        InputError: A rank is missing, a part changes the picture, or a file is damaged.
    """
    files = _ranks(path)
    mode, origin, notes = _config(path)
    parts = [_splats(file) for file in files]
    bands = parts[0]["sh"].shape[1]
    if any(part["sh"].shape[1] != bands for part in parts):
        raise InputError("ranks of different degrees", file=path, field="splats.shN", fix="copy all files again")
    whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return DecodedSplats(
        "a checkpoint of gsplat's trainer",
        files,
        float32_rows(
            whole["means"], whole["scales"], whole["quats"], whole["opacities"], whole["sh"][:, 0], whole["sh"][:, 1:]
        ),
        _FIELDS,
        mode=mode,
        mode_origin=origin,
        notes=("world is the trainer's normalised frame, whose transform no file keeps", *notes),
    )


def _ranks(path: Path) -> tuple[Path, ...]:
    """Return all ranks of the checkpoint, the one given first."""
    match = _NAME.fullmatch(path.name)
    assert match is not None
    step = match[1]
    beside = {}
    try:
        for file in path.parent.iterdir():
            other = _NAME.fullmatch(file.name)
            if other is not None and other[1] == step:
                beside[int(other[2])] = file
    except OSError:
        beside = {int(match[2]): path}
    missing = sorted(set(range(max(beside, default=0) + 1)) - set(beside))
    if missing:
        problem = f"rank {missing[0]} of this step is missing: a rank holds a part of the Gaussians"
        raise InputError(problem, file=path, fix=f"give all ckpt_{step}_rank*.pt in one folder")
    others = sorted(rank for rank in beside if rank != int(match[2]))
    return (path, *(beside[rank] for rank in others))


def _splats(file: Path) -> dict[str, np.ndarray]:
    content = read_checkpoint(file)
    splats = content.get("splats") if isinstance(content, dict) else None
    if not isinstance(splats, dict):
        raise InputError(
            "no Gaussians in this checkpoint", file=file, field="splats", fix="give one of gsplat's trainer"
        )
    for name in content:
        if name != "splats" and name not in _UNUSED:
            problem = (
                "changes the picture of the Gaussians" if name in ("app_module", "post_processing") else "not known"
            )
            raise InputError(problem, file=file, field=visible(str(name)), fix=RENDER_ELSEWHERE)
    for name in splats:
        if name not in _PARAMETERS:
            problem = "Gaussians whose colours a network makes" if name in ("features", "colors") else "not known"
            raise InputError(problem, file=file, field=f"splats.{visible(str(name))}", fix=RENDER_ELSEWHERE)
    arrays = {}
    for name in _PARAMETERS:
        if name not in splats:
            raise InputError("missing", file=file, field=f"splats.{name}", fix="give a checkpoint of gsplat's trainer")
        arrays[name] = to_float32(splats[name], file, f"splats.{name}", finite=False)
    count = len(arrays["means"]) if arrays["means"].ndim else 0
    bands = 1 + (arrays["shN"].shape[1] if arrays["shN"].ndim == 3 else 0)
    shapes = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3), "shN": (bands - 1, 3)}
    if bands not in _BANDS:
        problem = f"{bands} bands of spherical harmonics, more than degree 3 has, or not all of a degree"
        raise InputError(problem, file=file, field="splats.shN", fix="train with degree 3 or less")
    for name, shape in shapes.items():
        if arrays[name].shape != (count, *shape):
            problem = f"shape {list(arrays[name].shape)}, expected {[count, *shape]}"
            raise InputError(problem, file=file, field=f"splats.{name}", fix="give a checkpoint of gsplat's trainer")
    reserve(count, bands, file)
    return {
        **{name: arrays[name] for name in ("means", "scales", "quats", "opacities")},
        "sh": np.concatenate([arrays["sh0"], arrays["shN"]], axis=1),
    }


def _config(path: Path) -> tuple[str | None, str, tuple[str, ...]]:
    """Return the mode, its origin and notes, from the trainer's configuration where that exists."""
    file = next((folder / CONFIG for folder in path.parents[:2] if (folder / CONFIG).is_file()), None)
    if file is None:
        return None, "", (f"{CONFIG} of the trainer is missing: camera model and rasteriser are taken as its defaults",)
    config = read_mapping(file, "configuration of gsplat's trainer")
    if config.get("model_type") == "2dgs":
        raise InputError(TWO_D, file=file, field="model_type", fix=RENDER_ELSEWHERE)
    for key, values in _PLAIN.items():
        if key in config and config[key] not in values:
            problem = f"found {show(config[key])}: another picture than gsplat's of these Gaussians alone"
            raise InputError(problem, file=file, field=key, fix=RENDER_ELSEWHERE)
    antialiased = config.get("antialiased", False)
    if not isinstance(antialiased, bool):
        raise unusable(antialiased, file=file, field="antialiased", fix="write true or false")
    return "antialiased" if antialiased else "classic", f"{CONFIG}: antialiased", ()
