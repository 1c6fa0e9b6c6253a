"""Photos whose values are not bytes are refused: what a decoder makes of them is another photo."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from splat_files import deep_png

from ns_abstract.io.errors import InputError
from ns_abstract.io.photos import read_grey_mask, read_mask, read_photo, sequence_photos

DEEP = np.random.default_rng(0).integers(0, 1 << 16, (5, 7, 3)).astype(np.uint16)


def bitmap(bits: int) -> bytes:
    """A .bmp of 2 x 2 pixels."""
    rows = bytes(2 * (-(-2 * bits // 32) * 4))
    return (
        b"BM" + struct.pack("<IHHI", 54 + len(rows), 0, 0, 54)
        + struct.pack("<IiiHHIIiiII", 40, 2, 2, 1, bits, 0, len(rows), 0, 0, 0, 0) + rows
    )  # fmt: skip


FILES = {
    "16 bits.png": deep_png(DEEP),
    "16 bits.ppm": b"P6 7 5 65535\n" + DEEP.astype(">u2").tobytes(),
    "7 bits.ppm": b"P6 7 5 100\n" + bytes(105),
    "plain.ppm": b"P3 1 1 1000\n1 2 3",
    "5 bits.bmp": bitmap(16),
}


@pytest.mark.parametrize("name", FILES)
def test_values_that_are_no_bytes_are_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(FILES[name])
    with pytest.raises(InputError, match="8 bits by channel"):
        read_photo(tmp_path / name)
    with pytest.raises(InputError, match="8 bits by channel"):
        read_mask(tmp_path / name, (5, 7))


@pytest.mark.parametrize("kind", ["PNG", "BMP", "TIFF", "PPM", "WEBP"])
def test_bytes_are_read_as_they_are(kind: str, tmp_path: Path) -> None:
    file, values = tmp_path / f"photo.{kind.lower()}", (DEEP >> 8).astype(np.uint8)
    Image.fromarray(values).save(file, kind, **({"lossless": True} if kind == "WEBP" else {}))
    np.testing.assert_array_equal(read_photo(file), values)


def test_grey_masks_of_16_bits_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "mask.png"
    Image.fromarray(DEEP[..., 0]).save(file)
    with pytest.raises(InputError, match="8 bits by channel"):
        read_grey_mask(file)
    values = (DEEP[..., 0] >> 8).astype(np.uint8)
    Image.fromarray(values).save(file)
    np.testing.assert_array_equal(read_grey_mask(file), values >= 128)


@pytest.mark.parametrize("name", ["x" * 5000, "a\0b"])
def test_names_that_no_file_has(name: str) -> None:
    for read in (read_photo, sequence_photos, lambda file: read_mask(file, (5, 7))):
        with pytest.raises(InputError, match="no such"):
            read(Path(name))
