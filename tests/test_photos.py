"""Photos whose values are not bytes are refused: what a decoder makes of them is another photo."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

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


def _chunks(*chunks: tuple[bytes, bytes]) -> bytes:
    parts = (struct.pack(">I", len(d)) + n + d + struct.pack(">I", zlib.crc32(n + d)) for n, d in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def transparent_colour(grey: bool) -> bytes:
    """A .png of 7 x 5 white pixels without alpha, of which it says that white is transparent."""
    kind, samples = (0, 1) if grey else (2, 3)
    rows = zlib.compress(5 * (b"\0" + b"\xff" * 7 * samples))
    head = struct.pack(">IIBBBBB", 7, 5, 8, kind, 0, 0, 0)
    return _chunks((b"IHDR", head), (b"tRNS", b"\0\xff" * samples), (b"IDAT", rows), (b"IEND", b""))


def saved(kind: str, mode: str = "RGB", **options: Any) -> bytes:
    """A white picture of 7 x 5 pixels."""
    stream = io.BytesIO()
    Image.new("L", (7, 5), 255).convert(mode).save(stream, kind, **options)
    return stream.getvalue()


def turned(kind: str) -> bytes:
    exif = Image.Exif()
    exif[0x112] = 6
    return saved(kind, exif=exif)


def several(kind: str) -> bytes:
    return saved(kind, save_all=True, append_images=[Image.new("RGB", (7, 5))])


#: What would be read as another picture than the one that the file shows, and the words of the refusal.
OTHERS: dict[str, tuple[bytes, str]] = {
    "palette.png": (saved("PNG", "P", transparency=255), "partly transparent"),
    "palette of bytes.png": (saved("PNG", "P", transparency=bytes(256)), "partly transparent"),
    "colour.png": (transparent_colour(False), "partly transparent"),
    "turned.png": (turned("PNG"), "turned or mirrored"),
    "turned.jpg": (turned("JPEG"), "turned or mirrored"),
    "turned.webp": (turned("WEBP"), "turned or mirrored"),
    "turned.tif": (turned("TIFF"), "turned or mirrored"),
    "several.png": (several("PNG"), "holds 2 pictures"),
    "several.webp": (several("WEBP"), "holds 2 pictures"),
    "several.tif": (several("TIFF"), "holds 2 pictures"),
}


@pytest.mark.parametrize("name", OTHERS)
def test_a_picture_that_is_shown_otherwise_is_refused(name: str, tmp_path: Path) -> None:
    file, (data, words) = tmp_path / name, OTHERS[name]
    file.write_bytes(data)
    readers: list[Callable[[Path], Any]] = [read_photo, lambda file: read_mask(file, (5, 7))]
    for read in readers + [read_grey_mask] * (file.suffix == ".png"):
        with pytest.raises(InputError, match=words):
            read(file)


@pytest.mark.parametrize("mode", ["LA", "RGBA", "L"])
def test_transparent_pixels_of_a_region_are_not_white(mode: str, tmp_path: Path) -> None:
    file = tmp_path / "mask.png"
    if mode == "L":
        file.write_bytes(transparent_colour(True))
    else:
        image = Image.new(mode, (7, 5), "white")
        image.save(file)
        assert read_grey_mask(file).all() and read_mask(file, (5, 7)).all()
        image.putpixel((3, 2), (255, 0) if mode == "LA" else (255, 255, 255, 0))
        image.save(file)
    with pytest.raises(InputError, match="partly transparent"):
        read_grey_mask(file)


def test_training_photos_are_taken_as_they_are_stored(tmp_path: Path) -> None:
    (tmp_path / "photo.jpg").write_bytes(turned("JPEG"))
    assert read_photo(tmp_path / "photo.jpg", as_stored=True).shape == (5, 7, 3)


def test_a_camera_adds_smaller_pictures(tmp_path: Path) -> None:
    (tmp_path / "photo.jpg").write_bytes(several("MPO"))
    assert read_photo(tmp_path / "photo.jpg").shape == (5, 7, 3)


@pytest.mark.parametrize("name", ["x" * 5000, "a\0b"])
def test_names_that_no_file_has(name: str) -> None:
    for read in (read_photo, sequence_photos, lambda file: read_mask(file, (5, 7))):
        with pytest.raises(InputError, match="no such"):
            read(Path(name))
