"""Readers of photos and masks from untrusted files."""

from __future__ import annotations

import io
import itertools
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ns_abstract.io.errors import InputError, first_line
from ns_abstract.io.jsonio import read_bytes, show

#: Most pixels of a photo or a mask, and most bytes of a mask of greys.
_MOST_PIXELS, _MOST_MASK_BYTES = 1 << 26, 64 << 20
#: Grey level of 255 from which on a pixel of such a mask is white.
_WHITE = 128
#: Formats of photos and masks, as Pillow names them.
_FORMATS = ("PNG", "JPEG", "BMP", "TIFF", "WEBP", "PPM")
#: Kinds of pixels of a photo, as Pillow names them.
_COLORS = ("RGB", "RGBA", "P", "PA", "LA")
#: EXIF's number of how a picture is to be turned before it is shown; 1: not at all.
_ORIENTATION = 0x112
#: Names of pictures in a folder.
_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm")


def read_photo(file: Path, field: str = "--image", *, as_stored: bool = False) -> np.ndarray:
    """Return the values [H, W, 3] uint8 of a photo of 8 bits by channel.

    ``as_stored``: ignore the EXIF orientation, as Nerfstudio does for training photos. Otherwise a photo with another
    orientation than 1 is refused. Raises InputError: the file is missing, is no such photo, holds several, or is partly
    transparent.
    """
    with _opened(file, field, as_stored) as image:
        _refuse_kind(image, file, field)
        return np.array(_opaque(image, file, field), np.uint8)[..., :3]


def photo_size(file: Path, field: str) -> tuple[int, int]:
    """Return a photo's height and width by its head; InputError where that shows that `read_photo` refuses it."""
    with _opened(file, field) as image:
        _refuse_kind(image, file, field)
        return image.height, image.width


def sequence_photos(folder: Path, field: str = "--image-sequence") -> list[Path]:
    """Return the pictures of a folder, in the order of their names, but for hidden ones.

    Raises InputError: there is no such folder, it cannot be listed or holds none, one of them is no file, or the
    numbers in the names have another order than the names.
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
    """Return a note on the first gap in the numbers of ``photos``, sorted by name; None: no gap, or no numbers."""
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
    """Return the parts of a photo's name: text at even places, numbers at odd ones."""
    return [int(part) if k % 2 else part for k, part in enumerate(re.split(r"([0-9]+)", photo.name.casefold()))]


def read_mask(file: Path, size: tuple[int, int], field: str = "--mask") -> np.ndarray:
    """Return the white pixels [H, W], as bools, of a mask, which has to be black and white.

    Raises InputError: the file is missing, of another size, or holds other values.
    """
    with _opened(file, field) as image:
        values = np.array(_opaque(image, file, field), np.uint8)[..., :3]
    if values.shape[:2] != size:
        fix = f"resize it to {size[1]} x {size[0]} with nearest neighbours"
        raise InputError(f"has {values.shape[1]} x {values.shape[0]} pixels", file=file, field=field, fix=fix)
    white, black = (values == 255).all(axis=-1), (values == 0).all(axis=-1)
    if not (white | black).all():
        raise InputError(
            "has pixels that are neither black nor white", file=file, field=field,
            fix="write white where pixels count and black elsewhere",
        )  # fmt: skip
    return white


def read_grey_mask(file: Path) -> np.ndarray:
    """Return [H, W] bool: the white pixels of a .png. Raises InputError where it cannot be read, or is no .png."""
    data = read_bytes(file, "mask", _MOST_MASK_BYTES)
    with _opened(file, None, png=data) as image:
        return np.asarray(_opaque(image, file, None).convert("L")) >= _WHITE


def other_bits(image: Any) -> bool:
    """Whether an opened image, whose pixels are not read yet, stores another number of bits by channel than 8.

    Pillow converts such values to bytes: it cuts 16 bits to the upper 8, scales 5, and calls both RGB.
    """
    for codec, _, _, arguments in image.tile:
        raw, *more = arguments if isinstance(arguments, tuple) else (arguments,)
        if re.search(r";\d\d", str(raw)) or (codec.startswith("ppm") and more != [255]):
            return True
    return False


@contextmanager
def _opened(file: Path, field: str | None, as_stored: bool = False, png: bytes | None = None) -> Iterator[Any]:
    """Return a context of an opened picture of 8 bits by channel; any error in it becomes an InputError of the file.

    ``png``: the file's content, if it must be a .png.
    """
    from PIL import Image

    if not os.path.isfile(file):
        raise InputError("no such file", file=file, field=field, fix="give an existing picture")
    try:
        opened = file if png is None else io.BytesIO(png)
        with Image.open(opened, formats=_FORMATS if png is None else ("PNG",)) as image:
            if image.width * image.height > _MOST_PIXELS:
                raise InputError(f"has {image.width} x {image.height} pixels", fix="give a smaller one")
            if other_bits(image):
                raise InputError("does not hold 8 bits by channel", fix="save it as a PNG of 8 bits")
            # further pictures of a camera's .jpg are smaller ones of the same
            if image.format != "MPO" and getattr(image, "n_frames", 1) > 1:
                raise InputError(f"holds {image.n_frames} pictures", fix="give one by file")
            if not as_stored and image.getexif().get(_ORIENTATION, 1) != 1:
                raise InputError(
                    "is to be shown turned or mirrored (its EXIF orientation)",
                    fix="turn the pixels themselves, for example with: mogrify -auto-orient",
                )
            yield image
    except InputError as error:
        raise InputError(error.problem, file=file, field=field, fix=error.fix) from None
    except Exception as error:  # decoders raise what they like
        problem = f"{'cannot be read' if png is None else 'no .png'}: {first_line(error)}"
        raise InputError(problem, file=file, field=field, fix="give a PNG of 8 bits") from None


def _refuse_kind(image: Any, file: Path, field: str) -> None:
    if image.mode not in _COLORS:
        raise InputError(
            f"holds pixels of kind {image.mode}", file=file, field=field, fix="save it as RGB with 8 bits by channel"
        )


def _opaque(image: Any, file: Path, field: str | None) -> Any:
    """Return an opened image as RGB or RGBA of full opacity. Raises InputError where a pixel is transparent."""
    if image.mode not in ("RGBA", "PA", "LA") and "transparency" not in image.info:
        return image.convert("RGB")
    image = image.convert("RGBA")
    if image.getchannel("A").getextrema() != (255, 255):
        raise InputError("is partly transparent", file=file, field=field, fix="save it without an alpha channel")
    return image
