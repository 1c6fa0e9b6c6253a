"""Which decoder reads a file: a row of `_FORMATS` by format, told by first bytes, then by names."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from ns_abstract.methods.splat.formats import antimatter15, gltf, gsplat_checkpoint, inria, sog, spz
from ns_abstract.methods.splat.formats.decoded import Decoder

_HEAD = 512
_GZIP = b"\x1f\x8b"


class _Format(NamedTuple):
    """One format: whether a file, of these first bytes, is of it, and what reads it."""

    reads: Callable[[Path, bytes], bool]
    decode: Decoder


def _is_spz(path: Path, head: bytes) -> bool:
    if head.startswith(_GZIP):
        try:
            return zlib.decompressobj(31).decompress(head, len(spz.MAGIC)) == spz.MAGIC
        except zlib.error:
            return path.suffix.lower() == ".spz"
    return head.startswith(spz.MAGIC)


def _is_sog(path: Path, head: bytes) -> bool:
    return path.name == sog.META or (head.startswith(b"PK\x03\x04") and sog.is_archive(path))


_FORMATS = (
    _Format(_is_spz, spz.decode_spz),
    _Format(_is_sog, sog.decode_sog),
    _Format(lambda path, head: head.startswith(gltf.MAGIC), gltf.decode_glb),
    _Format(
        lambda path, head: gsplat_checkpoint.is_gsplat_checkpoint(path), gsplat_checkpoint.decode_gsplat_checkpoint
    ),
    _Format(lambda path, head: path.suffix.lower() == ".splat", antimatter15.decode_splat),
)


def decoder_of(path: Path) -> Decoder | None:
    """Return the decoder of a file; None where its format has no decoder here."""
    try:
        with path.open("rb") as stream:
            head = stream.read(_HEAD)
    except OSError:
        return None
    return next((format.decode for format in _FORMATS if format.reads(path, head)), None)


def scene_file(folder: Path, iteration: int | None) -> Path | None:
    """Return the scene's file in a folder that another program wrote; None without one: it may be a run's folder.

    The ``folder`` is of Inria's training, of a SOG scene, or of gsplat's trainer (or its ``ckpts``). ``iteration``:
    whose result is wanted; None: the last one. Raises InputError where the iteration is not there.
    """
    if (folder / "config.yml").is_file():
        return None
    if (folder / inria.ARGUMENTS).is_file():
        return inria.point_cloud(folder, iteration)
    if (folder / sog.META).is_file():
        return folder / sog.META
    return gsplat_checkpoint.checkpoint(folder, iteration)
