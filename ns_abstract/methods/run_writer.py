"""What the writers of run folders share: Nerfstudio's files around the checkpoint, without importing Nerfstudio."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ns_abstract.geometry.keyframe_cameras import KeyframeCamera, ring
from ns_abstract.geometry.transform import DataparserTransform
from ns_abstract.io.atomic import write_atomic
from ns_abstract.io.errors import InputError

_TEMPLATES = Path(__file__).with_name("config_templates")
STEP = 29999  # the last of Splatfacto's 30,000 steps

# Shapes of the LPIPS metric that a Splatfacto checkpoint carries; rendering does not use them.
_LPIPS = {
    "net.slice1.0": (64, 3, 11, 11),
    "net.slice2.3": (192, 64, 5, 5),
    "net.slice3.6": (384, 192, 3, 3),
    "net.slice4.8": (256, 384, 3, 3),
    "net.slice5.10": (256, 256, 3, 3),
}
_LPIPS_HEADS = (64, 192, 384, 256, 256)


class DatasetScene(Protocol):
    """The properties of a scene that a data set beside its run needs."""

    @property
    def background(self) -> NDArray[np.float32]: ...

    @property
    def dataparser(self) -> DataparserTransform: ...


def write_run(
    scene: DatasetScene,
    folder: Path,
    method: str,
    timestamp: str,
    experiment_name: str,
    *,
    data: str,
    checkpoint: bytes,
    config: Mapping[str, Any],
    steps: str,
    views: Sequence[KeyframeCamera] | None,
    render: Callable[[KeyframeCamera], ArrayLike] | None,
) -> Path:
    """Write a run and a small data set beside it; config.yml comes last, so a run with a config is complete.

    Args:
        steps: Its last lines but those that every method has.
        views: Cameras of the data set, normalised frame, at least two of one size and field of view.
        render: Gives the image [H, W, 3] in [0, 1] of a view; without it images hold only the background colour.

    Returns:
        The path of config.yml.

    Raises:
        InputError: ``timestamp`` or ``experiment_name`` is not a plain folder name.
    """
    run = _run_folder(folder, method, timestamp, experiment_name)
    write_dataset(scene, folder / data, ring((0.0, 0.0, 0.0), 1.05) if views is None else views, render)
    transform = {"transform": scene.dataparser.matrix.tolist(), "scale": float(scene.dataparser.scale)}
    write_file(run / "dataparser_transforms.json", json.dumps(transform, indent=4).encode())
    # Nerfstudio reads the step out of every name in nerfstudio_models: nothing else may stand there.
    write_file(run / "nerfstudio_models" / f"step-{STEP:09d}.ckpt", checkpoint, scratch=run)
    # JSON strings and lists are YAML as well, and keep a name made of digits a string.
    names = {"experiment": experiment_name, "data": data, "timestamp": timestamp}
    parts = {"dataparser": _template("dataparser"), "camera_optimizer": _template("camera_optimizer")}
    parts["datamanager"] = _template("ray_datamanager", **parts)
    body = _template(method, **parts, **config)
    text = _template("trainer", body=body, steps=steps, **{key: json.dumps(name) for key, name in names.items()})
    write_file(run / "config.yml", f"{text}\n".encode())
    return run / "config.yml"


def _template(name: str, **values: Any) -> str:
    """Return the text of a part of config.yml, whose Python tags say how Nerfstudio rebuilds its configuration."""
    text = (_TEMPLATES / f"{name}.yml").read_text(encoding="utf-8").rstrip("\n")
    return Template(text).substitute(values)


def _run_folder(folder: Path, method: str, timestamp: str, experiment_name: str) -> Path:
    """Make the folder of a run. Raises InputError: ``timestamp`` or ``experiment_name`` is not a plain folder name."""
    for field, value in (("timestamp", timestamp), ("experiment_name", experiment_name)):
        if not value or value in {".", ".."} or any(c in value for c in "/\\\0\n"):
            raise InputError(f"{value!r} is not a folder name", fix="use letters, digits, _ and -", field=field)
    run = folder / experiment_name / method / timestamp
    run.mkdir(parents=True, exist_ok=True)
    return run


def write_file(file: Path, data: bytes, *, scratch: Path | None = None) -> None:
    """Write a file as a whole, in a folder that is made if missing."""
    file.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(file, lambda stream: stream.write(data), scratch=scratch)


def background_name(colour: NDArray[np.float32]) -> str:
    """Return Nerfstudio's name of a colour, or a list where it has none ("random" renders as a fixed grey)."""
    names = {"white": (1, 1, 1), "black": (0, 0, 0), "random": (0.1490, 0.1647, 0.2157)}
    for name, value in names.items():
        if np.array_equal(colour, np.asarray(value, np.float32)):
            return name
    return json.dumps([float(c) for c in colour])


def optimizer_lines(kind: str, eps: str, groups: Mapping[str, tuple[str, tuple[str, str, int] | None]]) -> str:
    """Return the lines of config.yml on the optimizers, from "optimizers:" to the line before "output_dir:".

    ``kind``: "Adam" or "RAdam". ``groups``: learning rate of each group of parameters, and of its schedule the last
    rate, the first one and the steps of warming up; numbers as YAML spells them.
    """
    lines = ["optimizers:"]
    target = f"&id001 !!python/name:torch.optim.{kind.lower()}.{kind} ''"
    schedule = "&id002 !!python/name:nerfstudio.engine.schedulers.ExponentialDecayScheduler ''"
    for name, (rate, decay) in groups.items():
        lines.append(f"""\
  {name}:
    optimizer: !!python/object:nerfstudio.engine.optimizers.{kind}OptimizerConfig
      _target: {target}
      eps: {eps}
      lr: {rate}
      max_norm: null
      weight_decay: 0""")
        target = "*id001"
        if decay is None:
            lines.append("    scheduler: null")
            continue
        last, first, warm_up = decay
        lines.append(f"""\
    scheduler: !!python/object:nerfstudio.engine.schedulers.ExponentialDecaySchedulerConfig
      _target: {schedule}
      lr_final: {last}
      lr_pre_warmup: {first}
      max_steps: 30000
      ramp: cosine
      warmup_steps: {warm_up}""")
        schedule = "*id002"
    return "\n".join(lines)


def checkpoint_bytes(
    model: Mapping[str, ArrayLike], optimizers: Mapping[str, Any], schedulers: Mapping[str, Any]
) -> bytes:
    """Return the bytes of a checkpoint of plain tensors, numbers, lists and dictionaries; loads with weights_only.

    Args:
        model: Arrays of the model by name; equal objects are stored once.
    """
    import torch

    tensors = {id(array): torch.tensor(array) for array in model.values()}
    pipeline = {"_model.device_indicator_param": torch.empty(0, dtype=torch.float32)}
    pipeline |= {f"_model.{key}": tensors[id(array)] for key, array in model.items()}
    pipeline |= _lpips_state("_model.lpips.net.")
    state = {
        "step": STEP, "pipeline": pipeline, "optimizers": optimizers, "schedulers": schedulers, "scalers": {},
    }  # fmt: skip
    buffer = io.BytesIO()
    torch.save(state, buffer)
    return buffer.getvalue()


def _lpips_state(prefix: str) -> dict[str, Any]:
    """Return zeros in place of the LPIPS metric's tensors, whose names begin with ``prefix``."""
    import torch

    def zeros(*shape: int) -> torch.Tensor:
        # One stored number stands for all.
        return torch.zeros(1, dtype=torch.float32).expand(shape)

    state = {}
    for name, shape in _LPIPS.items():
        state[f"{prefix}{name}.weight"] = zeros(*shape)
        state[f"{prefix}{name}.bias"] = zeros(shape[0])
    for kind in ("lin", "lins."):
        for i, channels in enumerate(_LPIPS_HEADS):
            state[f"{prefix}{kind}{i}.model.1.weight"] = zeros(1, channels, 1, 1)
    return state


def write_dataset(
    scene: DatasetScene,
    folder: Path,
    views: Sequence[KeyframeCamera],
    render: Callable[[KeyframeCamera], ArrayLike] | None,
) -> None:
    """Write transforms.json and one PNG per view; poses are stored in the normalised frame."""
    if len(views) < 2 or any(
        (v.height, v.width, v.fov) != (views[0].height, views[0].width, views[0].fov) for v in views
    ):
        raise ValueError("views: at least two of one size and field of view are needed")
    height, width = views[0].height, views[0].width
    focal = 0.5 * height / np.tan(0.5 * np.deg2rad(views[0].fov))
    frames = []
    for k, view in enumerate(views):
        name = f"images/{k:03d}.png"
        if render is None:
            image = np.broadcast_to(scene.background, (height, width, 3))
        else:
            image = np.asarray(render(view), np.float64)
        write_file(folder / name, _png(image))
        frames.append({"file_path": name, "transform_matrix": view.camera_to_world.tolist()})
    meta: dict[str, Any] = {
        "camera_model": "OPENCV",
        "fl_x": float(focal),
        "fl_y": float(focal),
        "cx": 0.5 * width,
        "cy": 0.5 * height,
        "w": width,
        "h": height,
        "k1": 0,
        "k2": 0,
        "p1": 0,
        "p2": 0,
    }
    identity = np.array_equal(scene.dataparser.matrix, np.eye(3, 4)) and scene.dataparser.scale == 1.0
    if not identity:
        # Nerfstudio composes these into the transform that it would write itself.
        meta["applied_transform"] = scene.dataparser.matrix.tolist()
        meta["applied_scale"] = float(scene.dataparser.scale)
    meta["frames"] = frames
    write_file(folder / "transforms.json", json.dumps(meta, indent=1).encode())


def _png(image: NDArray[Any]) -> bytes:
    """Return the bytes of an 8-bit RGB PNG of [H, W, 3] values in [0, 1]."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(np.rint(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)).save(buffer, "png")
    return buffer.getvalue()
