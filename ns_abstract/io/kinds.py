"""Files of other kinds, recognised by their first bytes."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path

from ns_abstract.io.errors import InputError
from ns_abstract.io.packed import open_zip

#: Bytes at a file's beginning that are read.
_HEAD = 512
_GIVE = "give the config.yml of a run, its folder, or a scene file such as a .ply"
_EXPORT = "export the scene as .ply"
_DOWNLOAD = "download the file itself (its raw version), not the page that shows it"
_CONVERT = "convert with: splat-transform {name} out.ply"

#: First bytes, what the file is, and what can be done about it; "{name}" is the file's name.
_BEGINNINGS = (
    (
        b"version https://git-lfs.github.com/spec/",
        "a Git LFS pointer, not the file",
        "fetch the file with: git lfs pull",
    ),
    (b"glTF", "a binary glTF file (.glb)", _EXPORT),
    (b"NGSP", "an SPZ file (.spz)", _CONVERT),
    (b"\x28\xb5\x2f\xfd", "a file compressed by zstd", "unpack it with: zstd -d {name}"),
    (b"PXR-USDC", "a USD file", _EXPORT),
    (b"#usda", "a USD file", _EXPORT),
    (b"\x93NUMPY", "a NumPy array", _GIVE),
    (b"\x89PNG", "a PNG picture", _GIVE),
    (b"\xff\xd8\xff", "a JPEG picture", _GIVE),
    (b"%PDF", "a PDF document", _GIVE),
    (b"7z\xbc\xaf\x27\x1c", "a 7-Zip archive", "unpack it with: 7z x {name}"),
    (b"Rar!", "a RAR archive", "unpack it"),
    (b"SQLite format 3\x00", "an SQLite database", _GIVE),
)
#: Kinds without a mark of their own, by the ending of their names.
_ENDINGS = {
    ".ksplat": ("a .ksplat file", _CONVERT),
    ".splat": ("a .splat file", _CONVERT),
    ".spz": ("an SPZ file (.spz)", _CONVERT),
    ".sog": ("a SOG file (.sog)", _CONVERT),
    ".lcc": ("an LCC file", _CONVERT),
    ".gltf": ("a glTF file", _EXPORT),
    ".usd": ("a USD file", _EXPORT),
    ".usdz": ("a USD file", _EXPORT),
}


def is_ply(path: Path) -> bool:
    """Whether a file begins as a .ply does."""
    try:
        return _head(path).startswith((b"ply\n", b"ply\r"))
    except OSError:
        return False


def refuse_other_kind(path: Path) -> None:
    """Raise InputError for a file of a kind that is no scene, by its first bytes or else by its name.

    Raises InputError: names the kind, and the command that converts or fetches it; or the file may not be read.
    """
    try:
        head = _head(path)
    except PermissionError as error:
        # its name alone would make a file of another kind of it
        raise InputError(f"cannot be read: {error.strerror}", file=path, fix="check the permissions") from None
    except OSError:
        # what reads the file says why
        head = b""
    kind = _other_kind(path, head)
    if kind is not None:
        raise InputError(f"is {kind[0]}", file=path, fix=kind[1].replace("{name}", path.name))


def _head(path: Path) -> bytes:
    with path.open("rb") as stream:
        return stream.read(_HEAD)


def _other_kind(path: Path, head: bytes) -> tuple[str, str] | None:
    for beginning, what, fix in _BEGINNINGS:
        if head.startswith(beginning):
            return what, fix
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    if text.startswith((b"<!doctype html", b"<html")):
        return "a web page (HTML)", _DOWNLOAD
    if head.startswith(b"PK\x03\x04") and path.suffix.lower() not in (".ckpt", ".pt", ".pth"):
        return _kind_of_zip(path)
    if head.startswith(b"\x1f\x8b"):
        begins = zlib.decompressobj(31)
        try:
            inner = begins.decompress(head, 16)
        except zlib.error:
            inner = b""
        if inner.startswith(b"NGSP"):
            return "an SPZ file (.spz)", _CONVERT
        return "a file compressed by gzip", "unpack it with: gunzip {name}"
    return _ENDINGS.get(path.suffix.lower())


def _kind_of_zip(path: Path) -> tuple[str, str]:
    try:
        with open_zip(path) as archive:
            names = [Path(name).name for name in archive.namelist()]
    except (OSError, zipfile.BadZipFile, ValueError, RuntimeError):
        names = []
    if "data.pkl" in names:
        return "a checkpoint", "give the config.yml of its run"
    if "meta.json" in names or path.suffix.lower() == ".sog":
        return "a SOG file (.sog)", _CONVERT
    if any(name.endswith((".usd", ".usda", ".usdc")) for name in names):
        return "a USD file", _EXPORT
    return "a zip archive", "unpack it and give the config.yml or the .ply inside"
