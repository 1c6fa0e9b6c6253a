"""Write a splat scene as a standard 3DGS ``.ply``."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from ns_abstract.io.atomic import write_atomic
from ns_abstract.methods.splat.activate import SH_C0
from ns_abstract.methods.splat.scene import SplatScene


def write_ply(scene: SplatScene, file: Path) -> tuple[str, ...]:
    """Write ``scene``; `ns_abstract.methods.splat.load.load_scene` reads the same numbers back.

    A comment says how the scene is rasterised. The file holds what the standard has room for: means in the run's
    normalised frame, logarithms of scales, logits of opacities, quaternions as stored, spherical harmonics channel by
    channel.

    Returns:
        What it has no room for, one sentence each.

    Raises:
        OSError: The file cannot be written.
    """
    import plyfile

    sh, lost = scene.sh, []
    if scene.color_model == "sigmoid":
        colors = 1.0 / (1.0 + np.exp(-sh.astype(np.float64)))
        sh = ((colors - 0.5) / SH_C0).astype(np.float32)
        lost.append("colours were turned from logits into spherical harmonics of degree 0, rounded to float32")
    if scene.rasterize_mode != "classic":
        lost.append(
            f"rasterize_mode {scene.rasterize_mode} but as a comment: programs that do not read it draw the scene as "
            "classic"
        )
    if np.any(scene.background):
        red, green, blue = (float(value) for value in scene.background)
        lost.append(
            f"the background ({red:.3g}, {green:.3g}, {blue:.3g}): this package takes black for a .ply unless "
            "--background says it"
        )
    columns: dict[str, np.ndarray] = dict(zip("xyz", scene.means.T, strict=True))
    columns |= {name: np.zeros(scene.count, np.float32) for name in ("nx", "ny", "nz")}
    columns |= {f"f_dc_{c}": sh[:, 0, c] for c in range(3)}
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(scene.count, -1)
    columns |= {f"f_rest_{k}": rest[:, k] for k in range(rest.shape[1])}
    columns["opacity"] = scene.opacity_logits
    columns |= {f"scale_{k}": scene.log_scales[:, k] for k in range(3)}
    columns |= {f"rot_{k}": scene.quats[:, k] for k in range(4)}
    table = np.empty(scene.count, [(name, "<f4") for name in columns])
    for name, column in columns.items():
        table[name] = column
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mode = "mip" if scene.rasterize_mode == "antialiased" else "default"
        content = plyfile.PlyData(
            [plyfile.PlyElement.describe(table, "vertex")], byte_order="<", comments=[f"SplatRenderMode: {mode}"]
        )
    write_atomic(file, content.write)
    return tuple(lost)
