"""Photos and masks, read from files that nobody vouches for."""

from __future__ import annotations

import io
import itertools
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ns_abstract.io.errors import InputError, first_line
from ns_abstract.io.jsonio import read_bytes, show

#: Most pixels of a photo or a mask, and most bytes of a mask of greys.
_MOST_PIXELS, _MOST_MASK_BYTES = 1 << 26, 64 << 20
#: Grey level of 255 from which on a pixel of such a mask is white.
_WHITE = 128
#: Formats that hold values without loss of meaning: a .jpg's compression is noise like others.
_FORMATS = ("PNG", "JPEG", "BMP", "TIFF", "WEBP", "PPM")
#: Names of pictures in a folder.
_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm")


def read_photo(file: Path, field: str = "--image") -> np.ndarray:
    """The values [H, W, 3] uint8 of a photo of 8 bits by channel.

    Raises:
        InputError: The file is missing, is no such photo, or is partly transparent.
    """
    image = _opened(file, field)
    if image.mode in ("RGBA", "PA", "LA"):
        image = image.convert("RGBA")
        if image.getchannel("A").getextrema() != (255, 255):
            raise InputError("is partly transparent", file=file, field=field, fix="save it without an alpha channel")
    if image.mode not in ("RGB", "RGBA", "P"):
        raise InputError(
            f"holds pixels of kind {image.mode}", file=file, field=field, fix="save it as RGB with 8 bits by channel"
        )
    return np.array(image.convert("RGB"), np.uint8)


def sequence_photos(folder: Path, field: str = "--image-sequence") -> list[Path]:
    """The pictures of a folder, in the order of their names, but for hidden ones.

    Raises:
        InputError: There is no such folder, it cannot be listed or holds none, one of them is no file, or the numbers
            in the names have another order than the names.
    """
    if not os.path.isdir(folder):
        raise InputError("no such folder", file=folder, field=field, fix="give a folder of photos")
    try:
        named = (file for file in folder.iterdir() if not file.name.startswith("."))
        photos = sorted(file for file in named if file.suffix.lower() in _ENDINGS)
    except OSError as error:
        problem = f"cannot be listed: {error.strerror or type(error).__name__}"
        raise InputError(problem, file=folder, field=field, fix="check the permissions") from None
    if not photos:
        fix = f"give a folder with files that end in {', '.join(_ENDINGS)}"
        raise InputError("holds no photos", file=folder, field=field, fix=fix)
    # left out, the motion from the photo before to the one behind would be another
    if (lost := next((photo for photo in photos if not photo.is_file()), None)) is not None:
        raise InputError("is no file", file=lost, field=field, fix="copy the photo there, or remove it")
    for before, after in itertools.pairwise(photos):
        if _numbered(after) < _numbered(before):
            problem = f"{show(before.name)} comes before {show(after.name)} by name, and behind it by number"
            fix = "rename them with numbers of as many digits, and in one case"
            raise InputError(problem, file=folder, field=field, fix=fix)
    return photos


def missing_photos(photos: Sequence[Path]) -> str | None:
    """Where numbers are left out between photos in the order of their names; None: nowhere, or they have no number."""
    parts = [_numbered(photo) for photo in photos]
    if len({len(part) for part in parts}) > 1:
        return None
    varied = [k for k in range(len(parts[0])) if len({part[k] for part in parts}) > 1]
    if len(varied) != 1 or not varied[0] % 2:
        return None
    steps = [after[varied[0]] - before[varied[0]] for before, after in itertools.pairwise(parts)]
    at = next((k for k, step in enumerate(steps) if step >= 2 * min(steps)), None)
    if at is None:
        return None
    pair = f"{photos[at].name} and {photos[at + 1].name}"
    return f"photos may be missing between {pair}: the motion must allow for the way from one to the other"


def _numbered(photo: Path) -> list[Any]:
    """Parts of a photo's name: text at even places, numbers at odd ones."""
    return [int(part) if k % 2 else part for k, part in enumerate(re.split(r"([0-9]+)", photo.name.casefold()))]


def read_mask(file: Path, size: tuple[int, int], field: str = "--mask") -> np.ndarray:
    """Which pixels [H, W] of a mask are white; it has to be black and white.

    Raises:
        InputError: The file is missing, of another size, or holds other values.
    """
    values = np.array(_opened(file, field).convert("RGBA"), np.uint8)
    if values.shape[:2] != size:
        fix = f"resize it to {size[1]} x {size[0]} with nearest neighbours"
        raise InputError(f"has {values.shape[1]} x {values.shape[0]} pixels", file=file, field=field, fix=fix)
    white, black = (values[..., :3] == 255).all(axis=-1), (values[..., :3] == 0).all(axis=-1)
    if not (white | black).all() or (values[..., 3] != 255).any():
        raise InputError(
            "has pixels that are neither black nor white", file=file, field=field,
            fix="write white where pixels count and black elsewhere",
        )  # fmt: skip
    return white


def read_grey_mask(file: Path) -> np.ndarray:
    """Return [H, W] bool: the white pixels of a .png. Raises InputError where it cannot be read, or is no .png."""
    from PIL import Image

    data = read_bytes(file, "mask", _MOST_MASK_BYTES)
    try:
        with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
            width, height = image.size
            if width * height > _MOST_PIXELS:
                raise InputError(f"{width} x {height} pixels", file=file, fix="give a mask of the picture's size")
            _refuse_other_bits(image, file)
            return np.asarray(image.convert("L")) >= _WHITE
    except InputError:
        raise
    except Exception as error:  # Pillow raises many types on damaged files
        text = " ".join(str(error).split())[:120] or type(error).__name__
        raise InputError(f"no .png: {text}", file=file, fix="write a .png, white where pixels count") from None


def other_bits(image: Any) -> bool:
    """Whether Pillow makes bytes of values of another range: of an opened image whose pixels are not read yet.

    It cuts 16 bits to their upper 8 and spreads 5, and says RGB of all.
    """
    for codec, _, _, arguments in image.tile:
        raw, *more = arguments if isinstance(arguments, tuple) else (arguments,)
        if re.search(r";\d\d", str(raw)) or (codec.startswith("ppm") and more != [255]):
            return True
    return False


def _refuse_other_bits(image: Any, file: Path, field: str | None = None) -> None:
    if other_bits(image):
        raise InputError("does not hold 8 bits by channel", file=file, field=field, fix="save it as a PNG of 8 bits")


def _opened(file: Path, field: str) -> Any:
    from PIL import Image

    if not os.path.isfile(file):
        raise InputError("no such file", file=file, field=field, fix="give an existing picture")
    try:
        with Image.open(file, formats=_FORMATS) as image:
            if image.width * image.height > _MOST_PIXELS:
                raise InputError(
                    f"has {image.width} x {image.height} pixels", file=file, field=field, fix="give a smaller one"
                )
            _refuse_other_bits(image, file, field)
            image.load()
            return image.copy()
    except InputError:
        raise
    # decoders raise what they like
    except Exception as error:
        raise InputError(
            f"cannot be read: {first_line(error)}", file=file, field=field, fix="give a PNG of 8 bits"
        ) from None
