"""Scene files that tests write, and the pictures that gsplat's own kernels make of them."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import blob_scene
from gsplat_kernels import Kernels, Unavailable
from nerfs import tiny_scene
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

import ns_abstract as nsa
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.keyframe_cameras import look_at
from ns_abstract.io.assumptions import Assumption
from ns_abstract.io.errors import InputError
from ns_abstract.methods.load import load_any
from ns_abstract.methods.nerf.write import write_nerf_run
from ns_abstract.methods.overrides import Overrides
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.methods.splat.write import write_ply, write_splatfacto_run

torch.set_num_threads(1)
NAN, INF = float("nan"), float("inf")
CAMERA = PinholeCamera(np.asarray(look_at((1.6, 0.3, 0.4), (0.0, 0.0, 0.0)))[:3], 30.0, 30.0, 16.0, 12.0, 32, 24)
SHIFT = {"x": 0.01}


def thin_scene(mode: str = "classic") -> SplatScene:
    """Blobs that are thin on the screen, so that compensated and plain opacities differ much."""
    scene = blob_scene(60, degree=1)
    thin = scene.log_scales - np.float32(1.5)
    return dataclasses.replace(scene, log_scales=thin, rasterize_mode=mode)  # type: ignore[arg-type]


def picture(scene: SplatScene) -> NDArray[np.float64]:
    """The picture of gsplat's own kernels; skips where they cannot be built."""
    try:
        kernels = Kernels(scene, scalar="double")
    except Unavailable as reason:
        pytest.skip(str(reason))
    pixels = np.argwhere(np.ones((CAMERA.height, CAMERA.width)))
    return kernels.pixels(CAMERA, CAMERA.camera_to_world[:3], pixels).reshape(CAMERA.height, CAMERA.width, 3)


def shows(path: Path, expected: SplatScene, **options: Any) -> nsa.Scene:
    """Check that bounds of the scene in ``path`` hold the picture of ``expected``, which is what a render shows."""
    scene = nsa.load_scene(path, **options)
    wanted = picture(expected)
    np.testing.assert_allclose(nsa.render(scene, CAMERA), wanted, atol=2e-6)
    found = nsa.bound(scene, nsa.PoseSet(CAMERA, translation=SHIFT), target_ratio=3.0, time_budget=20.0)
    alone = ", of the Gaussians alone" if "bounded" in scene.method().describe() else ""
    assert found.guarantee == f"float32-sound{alone}" and found.guarantee in found._repr_html_()
    assert np.all(found.lower <= wanted) and np.all(wanted <= found.upper)
    # bounds of everything would hold it, too
    assert found.mpg < 0.5
    return scene


def differ(first: SplatScene, second: SplatScene) -> bool:
    return bool(np.abs(picture(first) - picture(second)).max() > 0.05)


def origin_of(scene: Any, name: str) -> Assumption:
    (found,) = [record for record in scene.assumptions if record.name == name]
    return found


def refused(path: Path, *mentions: str, overrides: Overrides | None = None) -> str:
    with pytest.raises(InputError) as caught:
        load_any(path, overrides)
    message = str(caught.value)
    assert len(message.splitlines()) == 1 and caught.value.fix
    for mention in mentions:
        assert mention in message, message
    return message


EARLY = dataclasses.replace(blob_scene(40, seed=11), background=np.array([0, 1, 0], np.float32))
LATE = dataclasses.replace(blob_scene(50, seed=7), background=np.array([0, 1, 0], np.float32))


def two_steps(folder: Path) -> Path:
    configs = [
        write_splatfacto_run(scene, folder / name, timestamp="t", experiment_name="e")
        for name, scene in (("early", EARLY), ("late", LATE))
    ]
    early, late = (next((config.parent / "nerfstudio_models").glob("step-*.ckpt")) for config in configs)
    early.rename(late.with_name("step-000009999.ckpt"))
    return configs[1]


def edit(config: Path, *changes: tuple[str, str]) -> None:
    text = config.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    config.write_text(text)


def nerf_run(folder: Path) -> Path:
    return write_nerf_run(tiny_scene(1), folder, timestamp="t", experiment_name="n")


def checkpoint_of(config: Path) -> Path:
    return max((config.parent / "nerfstudio_models").glob("step-*.ckpt"))


def change(config: Path, edit: Callable[[dict[str, Any]], Any]) -> None:
    """Edit the model's state in the latest checkpoint."""
    file = checkpoint_of(config)
    state = torch.load(file, weights_only=True)
    edit(state["pipeline"])
    torch.save(state, file)


def path_of(folder: Path) -> Path:
    """A camera path of one entry, 8 x 8 pixels, and a set of one pose."""
    pose = [*CAMERA.camera_to_world[:3].ravel().tolist(), 0.0, 0.0, 0.0, 1.0]
    entry = {"camera_to_world": pose, "fov": 45.0, "aspect": 1.0}
    content = {"camera_path": [entry], "render_height": 8, "render_width": 8, "perturbation": {"version": 1}}
    (folder / "path.json").write_text(json.dumps(content))
    return folder / "path.json"


def ply(
    path: Path, scene: SplatScene, comments: tuple[str, ...] = (), text: bool = False, order: str = "<",
    **columns: Any,
) -> Path:  # fmt: skip
    """Write a standard file with more ``columns``; a column of None is left out."""
    write_ply(scene, path)
    data = PlyData.read(str(path))["vertex"].data
    names = [name for name in data.dtype.names if columns.get(name, 0) is not None]
    more = {name: value for name, value in columns.items() if value is not None}
    table = np.zeros(len(data), [(name, "f4") for name in (*names, *(n for n in more if n not in names))])
    for name in table.dtype.names or ():
        table[name] = more[name] if name in more else data[name]
    element = PlyElement.describe(table, "vertex")
    PlyData([element], text=text, byte_order="=" if text else order, comments=list(comments)).write(str(path))
    return path


MIP = ("SplatRenderMode: mip",)
