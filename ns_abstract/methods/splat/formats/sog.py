"""SOG scenes: pictures of quantised numbers and a ``meta.json``, in a zip archive or a folder (PlayCanvas).

Version 2 has codebooks of 256 numbers for scales and colours and opacities of one byte; version 1, which names no
version, has limits between which bytes lie, and logits of opacities. Positions are 16-bit parts between limits of
sign(x) log(1 + |x|); quaternions are the place of the largest of (w, x, y, z), 252 + place, and three bytes; the other
bands are rows of a palette of at most 65,536.
"""

from __future__ import annotations

import stat
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ns_abstract.io.errors import InputError, visible
from ns_abstract.io.jsonio import is_moderate, load_json, parse_json, read_bytes, show
from ns_abstract.io.packed import open_zip
from ns_abstract.methods.overrides import Overrides
from ns_abstract.methods.splat.formats.decoded import (
    AXES,
    RENDER_ELSEWHERE,
    TWO_D,
    Bytes,
    DecodedSplats,
    float32_rows,
    lossless_picture,
    opacity_logits,
    reserve,
    smallest_three,
)

META = "meta.json"
_META_LIMIT = 2**20
#: Entries of the palette in a row of its picture, and such rows at most.
_PALETTE_ROW, _PALETTE_ROWS = 64, 1024
#: Degree by the number of coefficients of a channel.
_COEFFICIENTS = {3: 1, 8: 2, 15: 3}
_MODES = {"default": "classic", "antialiased": "antialiased"}
_FIX = "export the scene again, or convert it to .ply"
_FIELDS = {name: name for name in ("scales", "quats")} | {"opacities": "sh0", "colours": "sh0"}
#: Files that a picture may be larger than its texels: headers, and codes that do not compress.
_PICTURE_SPARE = 2**16


def is_archive(path: Path) -> bool:
    """Whether a zip archive holds the description of a SOG scene; a damaged one is judged by its name."""
    try:
        with open_zip(path) as archive:
            return any(name.rpartition("/")[2] == META for name in archive.namelist())
    except (OSError, zipfile.BadZipFile, ValueError, RuntimeError):
        return path.suffix.lower() == ".sog"


def decode_sog(path: Path, overrides: Overrides) -> DecodedSplats:
    """Return the Gaussians of a SOG scene: an archive, its ``meta.json`` outside an archive, or the folder of that.

    Raises InputError where it is of another version or model, or damaged.
    """
    if path.is_dir() or path.suffix.lower() == ".json":
        file = path / META if path.is_dir() else path
        meta = load_json(file, "SOG scene", _META_LIMIT)
        files = (file, *(file.parent / name for name in _names(meta, file)))
        return _Description(meta, file, lambda name: _beside(file, name)).decoded(files, overrides)
    try:
        with open_zip(path) as archive:
            entries = _entries(archive, path)
            if META not in entries:
                raise InputError("a zip archive without meta.json", file=path, fix=_FIX)
            meta = parse_json(_member(archive, entries[META], _META_LIMIT, path).decode("utf-8-sig"), path)
            _names(meta, path)
            # pictures are packed already, so that they are not larger than the archive by much
            limit = 4 * path.stat().st_size + _PICTURE_SPARE

            def read(name: str) -> bytes:
                if name not in entries:
                    raise InputError("missing in the archive", file=path, field=visible(name), fix=_FIX)
                return _member(archive, entries[name], limit, path)

            return _Description(meta, path, read).decoded((path,), overrides)
    except (InputError, MemoryError):
        raise
    except OSError as error:
        problem = f"cannot be read: {error.strerror or type(error).__name__}"
        raise InputError(problem, file=path, fix="check the permissions") from None
    except Exception as error:  # zipfile raises many types on damaged files
        text = " ".join(str(error).split())[:120] or type(error).__name__
        raise InputError(f"damaged archive: {text}", file=path, fix=_FIX) from None


class _Description:
    """A parsed ``meta.json``; ``meta``: what it holds, with plain names of pictures."""

    def __init__(self, meta: dict[str, Any], file: Path, read: Callable[[str], bytes]) -> None:
        self._meta, self._file, self._read = meta, file, read
        version = meta.get("version", 1)
        if isinstance(version, bool) or version not in (1, 2):
            raise self._error("version", version, "2")
        self._version: int = version
        count = meta.get("count") if version == 2 else self._item("means", "shape", 0)
        if isinstance(count, bool) or not isinstance(count, int) or not 0 < count < 2**31:
            raise self._error("count", count, "a number of Gaussians")
        self._count = count

    def decoded(self, files: tuple[Path, ...], overrides: Overrides) -> DecodedSplats:
        """Return the Gaussians, read from ``files``."""
        mode, origin = self._mode(overrides)
        # as many bands as there can be
        reserve(self._count, 16 if self._meta.get("shN") is not None else 1, self._file, 32 * self._count)
        low, high = self._texels("means", 0), self._texels("means", 1)
        means = self._between("means", (low[:, :3].astype(np.float64) + 256.0 * high[:, :3]) / 65535.0)
        scales, colors = self._texels("scales", 0)[:, :3], self._texels("sh0", 0)
        if self._version == 2:
            log_scales = self._codebook("scales")[scales]
            base, logits = self._codebook("sh0")[colors[:, :3]], opacity_logits(colors[:, 3])
        else:
            log_scales = self._between("scales", scales / 255.0)
            both = self._between("sh0", colors / 255.0)
            base, logits = both[:, :3], both[:, 3]
        return DecodedSplats(
            f"a SOG scene, version {self._version}",
            files,
            float32_rows(
                np.sign(means) * np.expm1(np.abs(means)), log_scales, self._quaternions(), logits, base, self._rest()
            ),
            _FIELDS,
            mode=mode,
            mode_origin=origin,
            notes=(AXES,),
        )

    def _quaternions(self) -> NDArray[np.float64]:
        """Return [N, 4] quaternions; those with an unknown place are no rotations."""
        turned = self._texels("quats", 0)
        tag = turned[:, 3].astype(np.int64)
        quats = smallest_three((turned[:, :3] / 255.0 * 2.0 - 1.0) * np.sqrt(0.5), np.maximum(tag - 252, 0))
        quats[tag < 252] = 1.0, 0.0, 0.0, 0.0
        return quats

    def _rest(self) -> NDArray[np.float64] | None:
        """Return [N, K - 1, 3] coefficients: the palette's rows that the labels name; None without further bands."""
        section = self._meta.get("shN")
        if section is None or (self._version == 2 and self._item("shN", "bands") == 0):
            return None
        picture = self._picture("shN", 0, _PALETTE_ROW, _PALETTE_ROW * max(_COEFFICIENTS) * _PALETTE_ROWS)
        coefficients, odd = divmod(picture.shape[1], _PALETTE_ROW)
        degree = _COEFFICIENTS.get(coefficients)
        if odd or degree is None or (self._version == 2 and self._item("shN", "bands") != degree):
            raise self._error("shN.bands", section.get("bands"), f"those of a palette {picture.shape[1]} wide")
        palette = picture[:, :, :3].reshape(-1, coefficients, 3)
        size = section.get("count", len(palette)) if self._version == 2 else len(palette)
        labels = self._texels("shN", 1).astype(np.int64)
        label = labels[:, 0] + 256 * labels[:, 1]
        if isinstance(size, bool) or not isinstance(size, int) or not label.max() < min(size, len(palette)):
            raise self._error("shN.count", size, f"more than the label {int(label.max())}")
        if self._version == 2:
            return self._codebook("shN")[palette[label]]
        ends = self._item("shN", "mins"), self._item("shN", "maxs")
        if not all(map(is_moderate, ends)):
            raise self._error("shN.mins", ends[0], "a number")
        part = np.arange(256) / 255.0
        return (ends[0] * (1.0 - part) + ends[1] * part)[palette[label]]

    def _mode(self, overrides: Overrides) -> tuple[str | None, str]:
        model = self._meta.get("model")
        if model is None:
            return None, ""
        if model == "2dgs":
            raise InputError(TWO_D, file=self._file, field="model", fix=RENDER_ELSEWHERE)
        if not isinstance(model, str) or model not in _MODES:
            if overrides.rasterize_mode is None:
                raise self._error("model", model, " or ".join(_MODES), "give --rasterize-mode")
            return None, ""
        return _MODES[model], f"meta.json: model {model}"

    def _texels(self, section: str, place: int) -> Bytes:
        """Return the texels [N, 4] of picture number ``place`` of a section."""
        # writers round the width up, never by as much as this
        return self._picture(section, place, self._count, 2 * self._count + 4096).reshape(-1, 4)[: self._count]

    def _picture(self, section: str, place: int, least: int, most: int) -> Bytes:
        name = self._item(section, "files", place)
        return lossless_picture(self._read(name), name, least, most, self._file)

    def _between(self, section: str, part: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return numbers between the section's limits, at fractions ``part`` [N, size]."""
        low, high = (self._numbers(section, end, part.shape[1]) for end in ("mins", "maxs"))
        return low * (1.0 - part) + high * part

    def _codebook(self, section: str) -> NDArray[np.float64]:
        return self._numbers(section, "codebook", 256)

    def _numbers(self, section: str, key: str, size: int) -> NDArray[np.float64]:
        values = self._item(section, key)
        if not isinstance(values, list) or len(values) != size or not all(map(is_moderate, values)):
            raise self._error(f"{section}.{key}", values, f"{size} numbers")
        return np.array(values, np.float64)

    def _item(self, section: str, key: str, place: int | None = None) -> Any:
        """Return the section's value under ``key``, or entry ``place`` of it."""
        return _item(self._meta, self._file, section, key, place)

    def _error(self, field: str, value: Any, wanted: str, fix: str = _FIX) -> InputError:
        return InputError(f"found {show(value)}, expected {wanted}", file=self._file, field=field, fix=fix)


def _item(meta: dict[str, Any], file: Path, section: str, key: str, place: int | None = None) -> Any:
    part = meta.get(section)
    value = part.get(key) if isinstance(part, dict) else None
    if place is not None:
        value = value[place] if isinstance(value, list) and place < len(value) else None
    if value is None:
        raise InputError("missing", file=file, field=f"{section}.{key}", fix=_FIX)
    return value


def _names(meta: Any, file: Path) -> list[str]:
    """Return the pictures that a description names: plain names, each once."""
    if not isinstance(meta, dict):
        raise InputError("the top level is not a mapping", file=file, fix=_FIX)
    if "lodLevels" in meta:
        fix = f"convert with: splat-transform {file.name} out.ply"
        raise InputError("the index of a scene in levels of detail", file=file, fix=fix)
    names: list[str] = []
    for section, count in {"means": 2, "scales": 1, "quats": 1, "sh0": 1, "shN": 2}.items():
        if section == "shN" and meta.get("shN") is None:
            continue
        files = _item(meta, file, section, "files")
        good = isinstance(files, list) and len(files) == count and all(isinstance(name, str) for name in files)
        if not good or any(not name or Path(name).name != name or "\\" in name or "\0" in name for name in files):
            raise InputError(f"expected {count} plain names", file=file, field=f"{section}.files", fix=_FIX)
        names += files
    if len(set(names)) != len(names):
        raise InputError("a picture is named twice", file=file, field="files", fix=_FIX)
    return names


def _entries(archive: zipfile.ZipFile, path: Path) -> dict[str, zipfile.ZipInfo]:
    """Return files of an archive by name, all in its top folder or all in one folder."""
    infos = [info for info in archive.infolist() if not info.is_dir()]
    folders = {info.filename.rpartition("/")[0] for info in infos if info.filename.rpartition("/")[2] == META}
    if len(infos) > 64 or len(folders) > 1:
        raise InputError(f"an archive of {len(infos)} files, not a SOG scene", file=path, fix=_FIX)
    folder = next(iter(folders), "")
    entries = {}
    for info in infos:
        outer, _, name = info.filename.rpartition("/")
        if outer == folder:
            if name in entries or stat.S_ISLNK(info.external_attr >> 16):
                raise InputError(f"{show(name)} stands twice or is a link", file=path, fix=_FIX)
            entries[name] = info
    return entries


def _member(archive: zipfile.ZipFile, info: zipfile.ZipInfo, limit: int, path: Path) -> bytes:
    if info.file_size > limit or info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        problem = f"{info.file_size} bytes unpacked, more than {limit}, or packed in another way"
        raise InputError(problem, file=path, field=visible(info.filename), fix=_FIX)
    with archive.open(info) as stream:
        data = stream.read(limit + 1)
    if len(data) != info.file_size:
        raise InputError("another size than declared", file=path, field=visible(info.filename), fix=_FIX)
    return data


def _beside(meta_file: Path, name: str) -> bytes:
    return read_bytes(meta_file.parent / name, "picture of a SOG scene", 2**31)
