"""Image files that users give."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import read_bytes

#: Most bytes of a mask, and most pixels.
_MOST_BYTES, _MOST_PIXELS = 64 << 20, 1 << 26
#: Grey level of 255 from which on a pixel of a mask is white.
_WHITE = 128


def read_mask(file: Path) -> np.ndarray:
    """Return [H, W] bool: the white pixels of a .png.

    Raises:
        InputError: It cannot be read, or is no .png.
    """
    from PIL import Image

    data = read_bytes(file, "mask", _MOST_BYTES)
    try:
        with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
            width, height = image.size
            if width * height > _MOST_PIXELS:
                raise InputError(f"{width} x {height} pixels", file=file, fix="give a mask of the picture's size")
            return np.asarray(image.convert("L")) >= _WHITE
    except InputError:
        raise
    except Exception as error:  # Pillow raises many types on damaged files
        text = " ".join(str(error).split())[:120] or type(error).__name__
        raise InputError(f"no .png: {text}", file=file, fix="write a .png, white where pixels count") from None
