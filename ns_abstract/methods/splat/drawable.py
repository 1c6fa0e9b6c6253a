"""Select the stored Gaussians that can be drawn; gsplat provably never draws the others."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ns_abstract.arithmetic.rounding import LEAST_QUATERNION, NORMAL_ROOM
from ns_abstract.io.errors import InputError
from ns_abstract.methods.splat.scene import Float32Array

_NEVER_DRAWN = "a mean or quaternion that is not finite, or a scale that is NaN: gsplat never draws them"
_ZERO = "zero quaternion"
_DROPPED = "values that are not finite (--drop-nan-gaussians)"
_FIX = "give --drop-nan-gaussians to leave these Gaussians out"
#: Coordinates are coarse where float32 resolves less than this part of the scene.
_COARSE = 1e-3


@dataclass(frozen=True)
class StoredGaussians:
    """Stored parameters: [N, 3], [N, 3], [N, 4], [N], [N, K, 3], float32, of any value."""

    means: Float32Array
    log_scales: Float32Array
    quats: Float32Array
    opacity_logits: Float32Array
    sh: Float32Array

    def kept(self, rows: NDArray[np.bool_]) -> StoredGaussians:
        """Return the rows where ``rows`` [N] is true."""
        return StoredGaussians(**{name: np.ascontiguousarray(value[rows]) for name, value in vars(self).items()})


def drawable(
    rows: StoredGaussians, file: Path, fields: dict[str, str], drop_nan: bool = False
) -> tuple[StoredGaussians, dict[str, Any]]:
    """Return the Gaussians that gsplat may draw, and notes about those left out (docs/dev/design.md, Limits).

    gsplat draws no Gaussian whose mean or quaternion is not finite, or with a scale of NaN: its radius is NaN, which
    becomes the integer 0. An opacity of NaN is drawn: min(0.999, NaN) is 0.999 in CUDA. Infinite scales and colours
    that are not finite are drawn, too. Logits of opacities may be infinite, and logarithms of scales -inf. ``fields``:
    names in the file of means, scales, quats, opacities and colours. ``drop_nan``: whether Gaussians that would be
    drawn with values that are not finite are left out. Raises InputError where a Gaussian cannot be bounded, or none is
    left.
    """
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        scales = np.exp(rows.log_scales.astype(np.float64))
        squared = np.square(rows.quats.astype(np.float64)).sum(axis=1)
    limits = np.finfo(np.float32)
    # Strictly inside the normal range, so that any float32 exp stays inside it.
    low, high = float(limits.tiny) * (1.0 + NORMAL_ROOM), float(limits.max) * (1.0 - NORMAL_ROOM)
    undrawn = ~_all(np.isfinite(rows.means)) | ~_all(np.isfinite(rows.quats)) | ~_all(~np.isnan(rows.log_scales))
    zero = (squared == 0) & ~undrawn
    left_out = {_NEVER_DRAWN: undrawn, _ZERO: zero}
    drawn = ~undrawn & ~zero
    endless = {
        "scales": drawn & ~_all(scales < np.inf),
        "opacities": drawn & np.isnan(rows.opacity_logits),
        "colours": drawn & ~_all(np.isfinite(rows.sh)),
    }
    if drop_nan:
        large = drawn & ~_all(scales <= high)
        left_out[_DROPPED] = np.any([large, *endless.values()], axis=0)
        drawn &= ~left_out[_DROPPED]
    else:
        for name, bad in endless.items():
            _require(~bad, file, fields[name], "values that are not finite in float32", _FIX)
    normal = np.isneginf(rows.log_scales) | ((scales >= low) & (scales <= high))
    _require(~drawn | _all(normal), file, fields["scales"], "exp of the logarithm is not a normal float32")
    # Squares that a device flushes to 0 are then part of the kernel's own rounding (design.md, G6); beyond the largest
    # float32, rsqrt(|q|^2) is 0.
    _require(
        ~drawn | ((squared >= LEAST_QUATERNION) & (squared <= high)),
        file,
        fields["quats"],
        "squared length of the quaternion is below 2^-100 or above the largest float32",
    )
    dropped = {reason: int(rows_left_out.sum()) for reason, rows_left_out in left_out.items() if rows_left_out.any()}
    if not drawn.any():
        reasons = "; ".join(f"{count} have {reason}" for reason, count in dropped.items())
        raise InputError(f"no Gaussian is left to draw: {reasons}", file=file, field=fields["quats"], fix="train again")
    if drawn.all():
        return rows, {}
    return rows.kept(drawn), {"dropped": dropped, "stored": np.flatnonzero(drawn)}


def coordinates_note(means: Float32Array, log_scales: Float32Array) -> tuple[str, ...]:
    """Return a note if float32 resolves coordinates by less than a thousandth of the scene's size; else nothing."""
    if means.shape[0] == 0:
        return ()
    low, high = np.quantile(means.astype(np.float64), (0.05, 0.95), axis=0)
    with np.errstate(over="ignore"):
        size = max(float((high - low).max()), float(np.exp(np.median(log_scales.astype(np.float64)))))
    step = float(np.spacing(np.maximum(np.abs(low), np.abs(high)).astype(np.float32)).max())
    if step <= _COARSE * size:
        return ()
    largest = float(np.maximum(np.abs(low), np.abs(high)).max())
    return (
        f"coordinates reach {largest:.3g}, where float32 resolves {step:.2g}, and the scene is {size:.3g} wide: "
        "move it to the origin before training, or bounds and pictures are coarse",
    )


def _all(good: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return [N] whether all values of a row are good."""
    return np.asarray(good.reshape(good.shape[0], -1).all(axis=1))


def _require(
    good: NDArray[np.bool_], file: Path, field: str, problem: str, fix: str = "remove these rows or train again"
) -> None:
    if not good.all():
        bad = np.flatnonzero(~good)
        problem = f"{problem} in {len(bad)} rows, the first is row {int(bad[0])}"
        raise InputError(problem, file=file, field=field, fix=fix)
