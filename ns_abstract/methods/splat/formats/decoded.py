"""Gaussians that a file of another format holds, decoded, and the scene that they make.

Every format is decoded in float64 and rounded once to float32 (docs/formats.md). An opacity of one
byte b stands for b/255 and becomes its logit; 255 becomes 40, whose float32 sigmoid is 1, and 0 becomes -40, which is
never drawn.
"""

from __future__ import annotations

import hashlib
import io
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from ns_abstract.io.assumptions import Assumption
from ns_abstract.io.errors import InputError, visible
from ns_abstract.io.memory import check_memory
from ns_abstract.io.photos import other_bits
from ns_abstract.methods.overrides import UNSAID, Overrides, assumption_of
from ns_abstract.methods.splat.drawable import StoredGaussians, coordinates_note, drawable
from ns_abstract.methods.splat.scene import DataparserTransform, SplatScene

#: Gaussians of 2-D splatting, and what can be done about them.
TWO_D = "2-D Gaussians, drawn by another rasteriser"
RENDER_ELSEWHERE = "render it with the program that trained it, or train Gaussians that gsplat's rasteriser draws"
AXES = (
    "the axes are those of the file, which says nothing of them (converters disagree): cameras must be given in the "
    "same axes"
)
_OPAQUE = 40.0
#: Bytes a Gaussian takes while it is decoded: float64 and float32 copies of 11 numbers and 3 a band.
_BYTES_BY_NUMBER = 16

Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class DecodedSplats:
    """Gaussians of a file, and what the file says of their picture.

    Attributes:
        format: What the file is, such as "an SPZ file, version 3".
        files: What was read; the first is the one that was given.
        mode: "classic" or "antialiased"; None where the file says nothing.
        mode_origin: Where the file says it.
        background: RGB in [0, 1]; None where the file says nothing.
        background_origin: Where the file says it.
        fields: Names in the file of scales, quats, opacities and colours, for messages.
    """

    format: str
    files: tuple[Path, ...]
    rows: StoredGaussians
    fields: dict[str, str]
    mode: str | None = None
    mode_origin: str = ""
    background: tuple[float, float, float] | None = None
    background_origin: str = ""
    notes: tuple[str, ...] = ()


def scene_of(decoded: DecodedSplats, overrides: Overrides) -> SplatScene:
    """Return the scene of decoded Gaussians; what the user states replaces what the file states.

    Raises:
        InputError: A Gaussian cannot be bounded.
    """
    file = decoded.files[0]
    rows, dropped = drawable(decoded.rows, file, decoded.fields, overrides.drop_nan_gaussians)
    mode, origin = decoded.mode or "classic", decoded.mode_origin or UNSAID
    background = decoded.background or (0.0, 0.0, 0.0)
    behind = decoded.background_origin or UNSAID
    notes = list(decoded.notes)
    if decoded.mode is None and overrides.rasterize_mode is None:
        notes.append("assumed classic: nothing in the file says how it was rasterised (--rasterize-mode says it)")
    assumptions = (
        assumption_of("rasterize_mode", overrides.rasterize_mode, "--rasterize-mode", mode, origin),
        assumption_of("background", overrides.background, "--background", background, behind),
        Assumption("units", "those of the file", f"default: {decoded.format} says nothing"),
        Assumption("decoded from", f"{decoded.format}, sha256 {_sha256(decoded.files)}", visible(file.name)),
        Assumption("decoded arrays", f"sha256 {_digest(decoded.rows)}", "docs/formats.md"),
    )
    return SplatScene(
        **vars(rows),
        color_model="sh",
        sh_degree=math.isqrt(rows.sh.shape[1]) - 1,
        rasterize_mode=cast(Literal["classic", "antialiased"], assumptions[0].value),
        background=np.array(overrides.background or background, np.float32),
        dataparser=DataparserTransform(stated=False),
        name=visible(file.stem),
        source=str(file),
        **dropped,
        notes=(*notes, *coordinates_note(rows.means, rows.log_scales)),
        assumptions=assumptions,
    )


def reserve(count: int, bands: int, file: Path, more: int = 0) -> None:
    """Check that there is memory to decode ``count`` Gaussians of ``bands`` bands and ``more`` bytes beside them.

    Raises:
        InputError: There are none, or too many.
    """
    if count < 1:
        raise InputError("no Gaussians", file=file, fix="export the scene again")
    check_memory(_BYTES_BY_NUMBER * count * (11 + 3 * bands) + more, file, f"the scene of {count} Gaussians")


def float32_rows(
    means: Any, log_scales: Any, quats: Any, opacity_logits: Any, colors: Any, rest: Any | None = None
) -> StoredGaussians:
    """Return rows rounded once to float32.

    ``means`` and ``log_scales`` are [N, 3], ``quats`` [N, 4] (w, x, y, z), ``opacity_logits`` [N], ``colors`` [N, 3]
    coefficients of band 0, ``rest`` [N, K - 1, 3] those of the other bands; None: there are none.
    """
    count = len(means)
    bands = 0 if rest is None else rest.shape[1]
    sh = np.empty((count, 1 + bands, 3), np.float32)
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        sh[:, 0] = colors
        if rest is not None:
            sh[:, 1:] = rest
        arrays = [np.ascontiguousarray(value, np.float32) for value in (means, log_scales, quats, opacity_logits)]
    return StoredGaussians(arrays[0], arrays[1], arrays[2], arrays[3], sh)


def opacity_logits(values: Bytes) -> NDArray[np.float64]:
    """Return logits of opacities of one byte each, of the same shape."""
    table = np.empty(256)
    inside = np.arange(1, 255)
    table[1:255] = np.log(inside / (255.0 - inside))
    table[0], table[255] = -_OPAQUE, _OPAQUE
    return table[values]


def smallest_three(parts: NDArray[np.float64], largest: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return unit quaternions [N, 4] of which the ``largest`` [N] component, 0 to 3, is left out; it is not negative.

    ``parts`` [N, 3] are the other components, in the order of their places.
    """
    quats = np.empty((len(parts), 4))
    # places of the three others, by the place left out
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    np.put_along_axis(quats, others, parts, axis=1)
    rest = np.sqrt(np.maximum(0.0, 1.0 - np.square(parts).sum(axis=1)))
    np.put_along_axis(quats, largest[:, None], rest[:, None], axis=1)
    return quats


def lossless_picture(data: bytes, name: str, least: int, most: int, file: Path) -> Bytes:
    """Return texels [H, W, 4] of a lossless WebP or PNG picture.

    Raises:
        InputError: Not such a picture, of another size, or damaged.
    """
    from PIL import Image

    again = "export the scene again, or convert it to .ply"
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        if data[12:16] != b"VP8L":
            what = "lossy or animated WebP: its numbers are not those exported"
            raise InputError(what, file=file, field=name, fix=again)
        packed = int.from_bytes(data[21:25], "little")
        width, height = (packed & 0x3FFF) + 1, (packed >> 14 & 0x3FFF) + 1
        kind = "WEBP"
    elif data[:8] == b"\x89PNG\r\n\x1a\n" and data[12:16] == b"IHDR":
        width, height = (int.from_bytes(data[at : at + 4], "big") for at in (16, 20))
        kind = "PNG"
    else:
        raise InputError("neither a lossless WebP nor a PNG picture", file=file, field=name, fix=again)
    if not least <= width * height <= most:
        problem = f"{width}x{height} texels, expected {least} to {most}"
        raise InputError(problem, file=file, field=name, fix=again)
    try:
        with Image.open(io.BytesIO(data), formats=(kind,)) as picture:
            if picture.size != (width, height) or picture.mode not in ("RGB", "RGBA") or other_bits(picture):
                raise ValueError(f"{picture.mode} of {picture.size}, or not 8 bits by channel")
            texels = np.asarray(picture.convert("RGBA"), np.uint8)
    except MemoryError:
        raise
    except Exception as error:  # Pillow raises many types on damaged files
        text = " ".join(str(error).split())[:80] or type(error).__name__
        raise InputError(f"damaged picture: {text}", file=file, field=name, fix=again) from None
    return texels


def _sha256(files: tuple[Path, ...]) -> str:
    digest = hashlib.sha256()
    for file in files:
        with file.open("rb") as stream:
            while part := stream.read(1 << 20):
                digest.update(part)
    return digest.hexdigest()


def _digest(rows: StoredGaussians) -> str:
    digest = hashlib.sha256()
    for array in vars(rows).values():
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


#: What reads a file of one format.
Decoder = Callable[[Path, Overrides], DecodedSplats]
