""".splat files: 32 bytes a Gaussian (antimatter15/splat, ``convert.py``).

A row is float32 x, y, z; float32 scales; bytes of red, green, blue and opacity; bytes of a quaternion (w, x, y, z), of
which byte b stands for (b - 128) / 128, as the format's own converter writes them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import file_size
from ns_abstract.methods.overrides import Overrides
from ns_abstract.methods.splat.activate import SH_C0
from ns_abstract.methods.splat.formats.decoded import AXES, DecodedSplats, float32_rows, opacity_logits, reserve

_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("quat", "u1", 4)])
_FIELDS = {name: f"{name} of a row" for name in ("scales", "quats", "opacities", "colours")}


def decode_splat(path: Path, overrides: Overrides) -> DecodedSplats:
    """Return the Gaussians of a .splat file. Raises InputError: damaged, or of a size that is not whole rows."""
    size = file_size(path, ".splat file")
    if size % _ROW.itemsize:
        problem = f"{size} bytes, not a multiple of {_ROW.itemsize}: not a .splat file, or cut off"
        raise InputError(problem, file=path, fix="copy it again, or export the scene as .ply")
    reserve(size // _ROW.itemsize, 1, path, size)
    rows = np.fromfile(path, _ROW)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales = np.log(rows["scale"].astype(np.float64))
    return DecodedSplats(
        "a .splat file",
        (path,),
        float32_rows(
            rows["mean"],
            log_scales,
            (rows["quat"].astype(np.float64) - 128.0) / 128.0,
            opacity_logits(rows["color"][:, 3]),
            (rows["color"][:, :3] / 255.0 - 0.5) / SH_C0,
        ),
        _FIELDS,
        notes=(AXES, "a .splat file keeps colours and opacities of 8 bits and no view dependence"),
    )
