"""SPZ files, versions 2 and 3 (one gzip stream) and 4 (a zstd stream by attribute); nianticlabs/spz, ``load-spz.cc``.

Positions have 24 bits, of which the header says how many are fractions; logarithms of scales are b/16 - 10, colours
(b/255 - 1/2) / 0.15, spherical harmonics (b - 128) / 128, colour by colour within a coefficient. Quaternions are
three bytes of x, y, z (version 2), or the place of the largest of x, y, z, w and three components of 9 bits and a sign.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import file_size
from ns_abstract.methods.overrides import Overrides
from ns_abstract.methods.splat.formats.decoded import (
    AXES,
    DecodedSplats,
    float32_rows,
    opacity_logits,
    reserve,
    smallest_three,
)

MAGIC = b"NGSP"
_BANDS = (1, 4, 9, 16)
_ANTIALIASED, _EXTENSIONS = 1, 2
_COLOR_SCALE = 0.15
_HEADER, _HEADER_4 = 16, 32
_STREAMS = ("positions", "alphas", "colors", "scales", "rotations", "sh")
_FIX = "export the scene again, or convert it to .ply"
_FIELDS = {"scales": "scales", "quats": "rotations", "opacities": "alphas", "colours": "colors"}
_FLAG = (
    "the file's flag says antialiased; one converter always sets it: give --rasterize-mode classic where the scene was "
    "trained so"
)


class _Header(NamedTuple):
    version: int
    count: int
    degree: int
    fraction: int
    flags: int

    @property
    def sizes(self) -> dict[str, int]:
        """Bytes of the streams."""
        by_row = (9, 1, 3, 3, 3 if self.version == 2 else 4, 3 * (_BANDS[self.degree] - 1))
        return {name: self.count * size for name, size in zip(_STREAMS, by_row, strict=True)}


def decode_spz(path: Path, overrides: Overrides) -> DecodedSplats:
    """Return the Gaussians of an SPZ file. Raises InputError: another version, degree 4, extensions, or damaged."""
    size = file_size(path, ".spz file")
    with path.open("rb") as stream:
        head = stream.read(_HEADER_4)
    if not head.startswith(MAGIC):
        header, data = _packed_streams(path, size)
    elif (header := _header(head, path)).version == 4:
        data = _streams_4(path, size, head, header)
    else:
        with path.open("rb") as stream:
            stream.seek(_HEADER)
            data = _split(header, stream.read(sum(header.sizes.values()) + 1), path)
    means = _signed_24(data["positions"]).reshape(-1, 3) * 2.0**-header.fraction
    rest = None
    if header.degree:
        rest = (data["sh"].reshape(header.count, -1, 3).astype(np.float64) - 128.0) / 128.0
    antialiased = bool(header.flags & _ANTIALIASED)
    return DecodedSplats(
        f"an SPZ file, version {header.version}",
        (path,),
        float32_rows(
            means,
            data["scales"].reshape(-1, 3) / 16.0 - 10.0,
            _quaternions(data["rotations"], header.version),
            opacity_logits(data["alphas"]),
            (data["colors"].reshape(-1, 3) / 255.0 - 0.5) / _COLOR_SCALE,
            rest,
        ),
        _FIELDS,
        mode="antialiased" if antialiased else "classic",
        mode_origin="the file's flag for antialiasing",
        notes=(AXES, _FLAG) if antialiased else (AXES,),
    )


def _header(head: bytes, path: Path) -> _Header:
    if len(head) < _HEADER or not head.startswith(MAGIC):
        raise InputError("not an SPZ file", file=path, fix=_FIX)
    header = _Header(*struct.unpack_from("<IIBBB", head, 4))
    if header.version not in (2, 3, 4):
        raise InputError(f"an SPZ file of version {header.version}, not 2 to 4", file=path, field="version", fix=_FIX)
    if header.degree >= len(_BANDS):
        problem = f"spherical harmonics of degree {header.degree}"
        raise InputError(problem, file=path, field="shDegree", fix="export it with degree 3 or less")
    if header.flags & _EXTENSIONS:
        problem = "has extensions, which may change its axes"
        raise InputError(problem, file=path, field="flags", fix="convert to .ply")
    if header.flags & ~_ANTIALIASED or header.fraction > 24:
        raise InputError("a header of unknown flags or fractions", file=path, field="flags", fix=_FIX)
    reserve(header.count, _BANDS[header.degree], path, sum(header.sizes.values()))
    return header


def _split(header: _Header, data: bytes, path: Path) -> dict[str, NDArray[np.uint8]]:
    """Return the streams of versions 2 and 3, which follow one another."""
    wanted = sum(header.sizes.values())
    if len(data) != wanted:
        raise InputError(f"{len(data)} bytes of Gaussians or more, expected {wanted}: cut off", file=path, fix=_FIX)
    streams, at = {}, 0
    for name, length in header.sizes.items():
        streams[name] = np.frombuffer(data, np.uint8, length, at)
        at += length
    return streams


def _packed_streams(path: Path, size: int) -> tuple[_Header, dict[str, NDArray[np.uint8]]]:
    """Return header and streams of versions 2 and 3, unpacked only as far as the header says."""
    inflate = zlib.decompressobj(31)
    try:
        with path.open("rb") as stream:
            packed = stream.read(size)
        data = inflate.decompress(packed, _HEADER)
        while len(data) < _HEADER and inflate.unconsumed_tail:
            data += inflate.decompress(inflate.unconsumed_tail, _HEADER - len(data))
        header = _header(data, path)
        if header.version == 4:
            raise InputError("version 4 inside gzip", file=path, field="version", fix=_FIX)
        wanted = sum(header.sizes.values())
        # one byte more shows whether the file holds more than it should
        data = inflate.decompress(inflate.unconsumed_tail, wanted + 1)
    except zlib.error as error:
        raise InputError(f"damaged gzip stream: {error}", file=path, fix=_FIX) from None
    except OSError as error:
        problem = f"cannot be read: {error.strerror or type(error).__name__}"
        raise InputError(problem, file=path, fix="check the permissions") from None
    if len(data) == wanted and not inflate.eof:
        raise InputError("a gzip stream without its end: cut off", file=path, fix=_FIX)
    if inflate.unused_data:
        # other programs join a second stream to the first
        raise InputError("bytes behind the gzip stream", file=path, fix=_FIX)
    return header, _split(header, data, path)


def _streams_4(path: Path, size: int, head: bytes, header: _Header) -> dict[str, NDArray[np.uint8]]:
    """Return streams of version 4."""
    if len(head) < _HEADER_4:
        raise InputError(f"{len(head)} bytes: cut off", file=path, fix=_FIX)
    sizes = {name: length for name, length in header.sizes.items() if length}
    number, table = head[15], int.from_bytes(head[16:20], "little")
    if number != len(sizes) or table != _HEADER_4 or table + 16 * number > size:
        problem = f"{number} streams with their table at {table}, expected {len(sizes)} at {_HEADER_4}"
        raise InputError(problem, file=path, field="numStreams", fix=_FIX)
    zstandard = _zstandard(path)
    streams = {}
    with path.open("rb") as stream:
        stream.seek(table)
        entries = struct.unpack(f"<{2 * number}Q", stream.read(16 * number))
        for (name, length), packed, unpacked in zip(sizes.items(), entries[::2], entries[1::2], strict=True):
            if unpacked != length or packed > size - stream.tell():
                problem = f"{packed} bytes for {unpacked}, expected {length}: cut off or damaged"
                raise InputError(problem, file=path, field=name, fix=_FIX)
            try:
                reader = zstandard.ZstdDecompressor().stream_reader(stream.read(packed), read_across_frames=False)
                data = reader.read(length + 1)
            except zstandard.ZstdError as error:
                raise InputError(f"damaged zstd stream: {error}", file=path, field=name, fix=_FIX) from None
            if len(data) != length:
                problem = f"{len(data)} bytes or more, expected {length}: cut off or damaged"
                raise InputError(problem, file=path, field=name, fix=_FIX)
            streams[name] = np.frombuffer(data, np.uint8)
        if stream.read(1):
            raise InputError("bytes behind the last stream", file=path, fix=_FIX)
    return streams


def _zstandard(path: Path) -> Any:
    try:
        import zstandard
    except ImportError:
        problem = "an SPZ file of version 4 needs the package zstandard"
        raise InputError(problem, file=path, fix="pip install 'ns-abstract[formats]'") from None
    return zstandard


def _signed_24(data: NDArray[np.uint8]) -> NDArray[np.float64]:
    low, middle, high = (data[k::3].astype(np.int32) for k in range(3))
    # the sign is the highest bit of 24
    return (((low | middle << 8 | high << 16) ^ 0x800000) - 0x800000).astype(np.float64)


def _quaternions(data: NDArray[np.uint8], version: int) -> NDArray[np.float64]:
    """Return [N, 4] quaternions, (w, x, y, z)."""
    if version == 2:
        return smallest_three(data.reshape(-1, 3) / 127.5 - 1.0, np.zeros(len(data) // 3, np.int64))
    packed = data.view("<u4").astype(np.int64)
    largest, parts = packed >> 30, np.empty((len(packed), 3))
    # the last of the three that are stored has the lowest bits
    for k, shift in enumerate((20, 10, 0)):
        field = packed >> shift
        parts[:, k] = np.where(field >> 9 & 1, -1.0, 1.0) * (field & 511) * (np.sqrt(0.5) / 511.0)
    # places are those of (x, y, z, w)
    return smallest_three(parts, largest)[:, [3, 0, 1, 2]]
