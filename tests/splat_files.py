"""Scene files of other programs' formats, written row by row, and read back by decoders of plain Python.

The decoders here follow each format's description one Gaussian at a time and share nothing with the package's.
"""

from __future__ import annotations

import gzip
import io
import json
import math
import struct
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.methods.splat.write import write_ply

C0 = 0.28209479177387814
QUAT_OTHERS = ((1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2))


def sigmoid(logit: float) -> float:
    return 1.0 / (1.0 + math.exp(-logit))


def byte(value: float) -> int:
    return min(255, max(0, round(value)))


def logit_of(code: int) -> float:
    return 40.0 if code == 255 else -40.0 if code == 0 else math.log(code / 255.0 / (1.0 - code / 255.0))


def unit(quat: Sequence[float]) -> list[float]:
    length = math.sqrt(sum(float(q) ** 2 for q in quat))
    return [float(q) / length for q in quat]


def three(quat: Sequence[float]) -> tuple[int, list[float]]:
    """Place of the largest component, and the others where that one is positive."""
    whole = unit(quat)
    place = max(range(4), key=lambda k: abs(whole[k]))
    sign = 1.0 if whole[place] >= 0 else -1.0
    return place, [sign * whole[k] for k in QUAT_OTHERS[place]]


def whole(place: int, parts: Sequence[float]) -> list[float]:
    quat = [0.0] * 4
    for k, part in zip(QUAT_OTHERS[place], parts, strict=True):
        quat[k] = part
    quat[place] = math.sqrt(max(0.0, 1.0 - sum(p * p for p in parts)))
    return quat


def scene(rows: list[dict[str, Any]], mode: str = "classic", **more: Any) -> SplatScene:
    sh = np.array([row["sh"] for row in rows], np.float32)
    return SplatScene(
        means=np.array([row["mean"] for row in rows], np.float32),
        log_scales=np.array([row["scale"] for row in rows], np.float32),
        quats=np.array([row["quat"] for row in rows], np.float32),
        opacity_logits=np.array([row["opacity"] for row in rows], np.float32),
        sh=sh,
        sh_degree=math.isqrt(sh.shape[1]) - 1,
        rasterize_mode=mode,  # type: ignore[arg-type]
        **more,
    )


# .splat


def write_splat(source: SplatScene, file: Path) -> Path:
    data = b""
    for i in range(source.count):
        color = [byte(255 * (0.5 + C0 * float(c))) for c in source.sh[i, 0]]
        data += struct.pack("<6f", *source.means[i], *np.exp(source.log_scales[i]))
        data += bytes([*color, byte(255 * sigmoid(float(source.opacity_logits[i])))])
        data += bytes(byte(128 * q + 128) for q in unit(source.quats[i]))
    file.write_bytes(data)
    return file


def read_splat(file: Path) -> SplatScene:
    rows = []
    for values in struct.iter_unpack("<6f4B4B", file.read_bytes()):
        rows.append({
            "mean": values[:3], "scale": [math.log(s) for s in values[3:6]],
            "sh": [[(c / 255 - 0.5) / C0 for c in values[6:9]]], "opacity": logit_of(values[9]),
            "quat": [(b - 128) / 128 for b in values[10:]],
        })  # fmt: skip
    return scene(rows)


# .glb


def glb_parts(source: SplatScene, bytes_: bool = False) -> tuple[dict[str, Any], bytes]:
    """JSON and binary part of a .glb of KHR_gaussian_splatting; with ``bytes_``, integers where there may be some."""
    prefix, n = "KHR_gaussian_splatting:", source.count
    quats = np.array([unit(q) for q in source.quats])[:, [1, 2, 3, 0]]
    opacities = np.array([[sigmoid(float(o))] for o in source.opacity_logits])
    columns: dict[str, tuple[str, int, bool, np.ndarray]] = {
        "POSITION": ("VEC3", 5126, False, source.means),
        prefix + "SCALE": ("VEC3", 5126, False, np.exp(source.log_scales.astype(float))),
        prefix + "ROTATION": ("VEC4", 5126, False, quats),
        prefix + "OPACITY": ("SCALAR", 5126, False, opacities),
    }
    if bytes_:
        columns[prefix + "ROTATION"] = ("VEC4", 5122, True, np.round(quats * 32767))
        columns[prefix + "OPACITY"] = ("SCALAR", 5121, True, np.round(opacities * 255))
    k = 0
    for degree in range(source.sh_degree + 1):
        for m in range(2 * degree + 1):
            columns[f"{prefix}SH_DEGREE_{degree}_COEF_{m}"] = ("VEC3", 5126, False, source.sh[:, k])
            k += 1
    data, views, accessors = b"", [], []
    for kind, component, normalized, values in columns.values():
        dtype = {5126: "<f4", 5122: "<i2", 5121: "<u1"}[component]
        rows = np.asarray(values, dtype).reshape(n, -1)
        # bytes stand apart by four
        stride = -(-rows.shape[1] * rows.itemsize // 4) * 4
        padded = b"".join(row.tobytes().ljust(stride, b"\0") for row in rows)
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(padded), "byteStride": stride})
        accessors.append({"bufferView": len(accessors), "componentType": component, "count": n, "type": kind,
                          "normalized": normalized})  # fmt: skip
        data += padded
    extension = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {"mode": 0, "attributes": {name: i for i, name in enumerate(columns)},
                 "extensions": {"KHR_gaussian_splatting": extension}}  # fmt: skip
    root = {
        "asset": {"version": "2.0"}, "extensionsUsed": ["KHR_gaussian_splatting"], "scene": 0,
        "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}], "meshes": [{"primitives": [primitive]}],
        "accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": len(data)}],
    }  # fmt: skip
    return root, data


def write_glb(file: Path, root: Any, data: bytes) -> Path:
    text = json.dumps(root).encode()
    text += b" " * (-len(text) % 4)
    parts = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    file.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(parts)) + parts)
    return file


def read_glb(file: Path) -> SplatScene:
    content = file.read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    root, data = json.loads(content[20 : 20 + length]), content[28 + length :]
    attributes = root["meshes"][0]["primitives"][0]["attributes"]

    def row(name: str, i: int) -> list[float]:
        accessor = root["accessors"][attributes[name]]
        view = root["bufferViews"][accessor["bufferView"]]
        letter, most = {5126: ("f", 1), 5122: ("h", 32767), 5121: ("B", 255)}[accessor["componentType"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        return [
            v / most for v in struct.unpack_from(f"<{width}{letter}", data, view["byteOffset"] + i * view["byteStride"])
        ]

    rows, prefix = [], "KHR_gaussian_splatting:"
    for i in range(root["accessors"][0]["count"]):
        (opacity,) = row(prefix + "OPACITY", i)
        x, y, z, w = row(prefix + "ROTATION", i)
        rows.append({
            "mean": row("POSITION", i), "scale": [math.log(s) for s in row(prefix + "SCALE", i)], "quat": [w, x, y, z],
            "opacity": math.log(opacity / (1 - opacity)),
            "sh": [row(name, i) for name in attributes if "SH_DEGREE" in name],
        })  # fmt: skip
    return scene(rows)


# compressed.ply


def _pack(parts: Sequence[float], bits: Sequence[int]) -> int:
    value = 0
    for part, n in zip(parts, bits, strict=True):
        value = value << n | min(2**n - 1, max(0, round(part * (2**n - 1))))
    return value


def _part(value: float, low: float, high: float) -> float:
    return (value - low) / (high - low) if high > low else 0.0


def write_compressed(
    source: SplatScene, file: Path, comments: Sequence[str] = (), colors: bool = True, harmonics: bool = True
) -> Path:
    count, rest = source.count, source.sh[:, 1:].transpose(0, 2, 1).reshape(source.count, -1)
    names = [f"{end}_{a}{c}" for a in ("", "scale_") for end in ("min", "max") for c in "xyz"]
    names += [f"{end}_{c}" for end in ("min", "max") for c in "rgb"] if colors else []
    chunks, rows, sh = b"", b"", b""
    for first in range(0, count, 256):
        of = slice(first, first + 256)
        groups = [source.means[of], source.log_scales[of]]
        groups += [0.5 + C0 * source.sh[of, 0]] if colors else []
        ends = [(g.min(axis=0).astype(np.float32), g.max(axis=0).astype(np.float32)) for g in groups]
        chunks += b"".join(low.tobytes() + high.tobytes() for low, high in ends)
        for i in range(first, min(first + 256, count)):
            packed = []
            for (low, high), group in zip(ends[:2], groups[:2], strict=True):
                parts = [
                    _part(float(v), float(a), float(b)) for v, a, b in zip(group[i - first], low, high, strict=True)
                ]
                packed.append(_pack(parts, (11, 10, 11)))
            place, parts = three(source.quats[i])
            rotation = place << 30 | _pack([p * math.sqrt(0.5) + 0.5 for p in parts], (10, 10, 10))
            shown = [0.5 + C0 * float(c) for c in source.sh[i, 0]]
            if colors:
                low, high = ends[2]
                shown = [_part(v, float(a), float(b)) for v, a, b in zip(shown, low, high, strict=True)]
            color = _pack([*shown, sigmoid(float(source.opacity_logits[i]))], (8, 8, 8, 8))
            rows += struct.pack("<4I", packed[0], rotation, packed[1], color)
            sh += bytes(min(255, max(0, int((float(v) / 8 + 0.5) * 256))) for v in rest[i])
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {c}" for c in comments)]
    header += [f"element chunk {-(-count // 256)}", *(f"property float {name}" for name in names)]
    header += [f"element vertex {count}"]
    header += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    if rest.shape[1] and harmonics:
        header += [f"element sh {count}", *(f"property uchar f_rest_{k}" for k in range(rest.shape[1]))]
    else:
        sh = b""
    file.write_bytes(("\n".join([*header, "end_header"]) + "\n").encode() + chunks + rows + sh)
    return file


def read_compressed(file: Path, mode: str = "classic") -> SplatScene:
    head, _, data = file.read_bytes().partition(b"end_header\n")
    lines = head.decode().split("\n")
    counts = {line.split()[1]: int(line.split()[2]) for line in lines if line.startswith("element")}
    width = sum(line.startswith("property float") for line in lines)
    rest = sum(line.startswith("property uchar") for line in lines)
    ends = list(struct.iter_unpack(f"<{width}f", data[: 4 * width * counts["chunk"]]))
    at = 4 * width * counts["chunk"]
    rows = []
    for i in range(counts["vertex"]):
        position, rotation, scale, color = struct.unpack_from("<4I", data, at + 16 * i)
        end = ends[i // 256]

        def places(value: int, first: int, end: tuple[float, ...] = end) -> list[float]:
            parts = (value >> 21) / 2047, (value >> 11 & 1023) / 1023, (value & 2047) / 2047
            return [end[first + k] + (end[first + 3 + k] - end[first + k]) * parts[k] for k in range(3)]

        shown = [(color >> s & 255) / 255 for s in (24, 16, 8)]
        if width == 18:
            shown = [end[12 + k] + (end[15 + k] - end[12 + k]) * shown[k] for k in range(3)]
        codes = data[at + 16 * counts["vertex"] + rest * i :][:rest]
        values = [-4.0 if b == 0 else 4.0 if b == 255 else (b + 0.5) / 32 - 4 for b in codes]
        sh = [[(v - 0.5) / C0 for v in shown]]
        sh += [[values[c * (rest // 3) + k] for c in range(3)] for k in range(rest // 3)]
        parts = [((rotation >> s & 1023) / 1023 - 0.5) * math.sqrt(2) for s in (20, 10, 0)]
        rows.append({
            "mean": places(position, 0), "scale": places(scale, 6), "sh": sh, "opacity": logit_of(color & 255),
            "quat": whole(rotation >> 30, parts),
        })  # fmt: skip
    return scene(rows, mode)


# SPZ


def write_spz(source: SplatScene, file: Path, version: int = 3, fraction: int = 12, flags: int = 0) -> Path:
    streams = [b""] * 6
    for i in range(source.count):
        for v in source.means[i]:
            streams[0] += (round(float(v) * 2**fraction) & 0xFFFFFF).to_bytes(3, "little")
        streams[1] += bytes([byte(255 * sigmoid(float(source.opacity_logits[i])))])
        streams[2] += bytes(byte(255 * (0.15 * float(c) + 0.5)) for c in source.sh[i, 0])
        streams[3] += bytes(byte((float(s) + 10) * 16) for s in source.log_scales[i])
        w, x, y, z = unit(source.quats[i])
        if version == 2:
            sign = 1.0 if w >= 0 else -1.0
            streams[4] += bytes(byte(127.5 * (sign * q + 1)) for q in (x, y, z))
        else:
            place, parts = three((x, y, z, w))
            packed = place
            for part in parts:
                packed = packed << 10 | (part < 0) << 9 | min(511, round(511 * abs(part) / math.sqrt(0.5)))
            streams[4] += struct.pack("<I", packed)
        streams[5] += bytes(byte(128 * float(v) + 128) for v in source.sh[i, 1:].reshape(-1))
    head = struct.pack("<4sIIBBB", b"NGSP", version, source.count, source.sh_degree, fraction, flags)
    if version < 4:
        file.write_bytes(gzip.compress(head + b"\0" + b"".join(streams), mtime=0))
        return file
    import zstandard

    used = [stream for stream in streams if stream]
    packed = [zstandard.ZstdCompressor().compress(stream) for stream in used]
    table = b"".join(struct.pack("<QQ", len(p), len(s)) for p, s in zip(packed, used, strict=True))
    file.write_bytes(head + bytes([len(used)]) + struct.pack("<I12x", 32) + table + b"".join(packed))
    return file


def read_spz(file: Path) -> SplatScene:
    data = file.read_bytes()
    if data[:4] != b"NGSP":
        data = gzip.decompress(data)
        at = 16
    _, version, count, degree, fraction, flags = struct.unpack_from("<4sIIBBB", data)
    rest = 3 * ((degree + 1) ** 2 - 1)
    sizes = [9, 1, 3, 3, 3 if version == 2 else 4, rest]
    if version == 4:
        import zstandard

        streams, at = [], 32 + 16 * data[15]
        for k in range(data[15]):
            packed, _ = struct.unpack_from("<QQ", data, 32 + 16 * k)
            streams.append(zstandard.ZstdDecompressor().decompress(data[at : at + packed]))
            at += packed
    else:
        streams = []
        for size in sizes:
            streams.append(data[at : at + size * count])
            at += size * count
    streams.append(b"")
    rows = []
    for i in range(count):
        row = [streams[k][size * i : size * (i + 1)] for k, size in enumerate(sizes)]
        mean = [int.from_bytes(row[0][k : k + 3], "little", signed=False) for k in (0, 3, 6)]
        mean = [(m - 2**24 if m >= 2**23 else m) / 2**fraction for m in mean]
        if version == 2:
            x, y, z = (b / 127.5 - 1 for b in row[4])
            quat = whole(0, (x, y, z))
        else:
            (packed,) = struct.unpack("<I", row[4])
            parts = []
            for shift in (20, 10, 0):
                field = packed >> shift & 1023
                parts.append((-1 if field & 512 else 1) * math.sqrt(0.5) * (field & 511) / 511)
            x, y, z, w = whole(packed >> 30, parts)
            quat = [w, x, y, z]
        sh = [[(c / 255 - 0.5) / 0.15 for c in row[2]]]
        sh += [[(b - 128) / 128 for b in row[5][k : k + 3]] for k in range(0, rest, 3)]
        rows.append({
            "mean": mean, "scale": [b / 16 - 10 for b in row[3]], "sh": sh, "quat": quat,
            "opacity": logit_of(row[1][0]),
        })  # fmt: skip
    return scene(rows, "antialiased" if flags & 1 else "classic")


# SOG


def picture_bytes(texels: np.ndarray, kind: str = "WEBP", **options: Any) -> bytes:
    stream = io.BytesIO()
    options = options or ({"lossless": True, "exact": True} if kind == "WEBP" else {})
    Image.fromarray(texels).save(stream, kind, **options)
    return stream.getvalue()


def deep_png(texels: np.ndarray) -> bytes:
    """A PNG of RGB with 16 bits by channel, of texels [H, W, 3] uint16."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    height, width, _ = texels.shape
    lines = b"".join(b"\0" + row.astype(">u2").tobytes() for row in texels)
    head = struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(lines)) + chunk(b"IEND", b"")


def _texture(rows: list[list[int]], width: int) -> np.ndarray:
    height = -(-len(rows) // width)
    texels = np.zeros((height * width, 4), np.uint8)
    texels[:, 3] = 255
    texels[: len(rows)] = np.array(rows, np.uint8)
    return texels.reshape(height, width, 4)


def sog_parts(
    source: SplatScene, version: int = 2, model: str | None = None
) -> tuple[dict[str, Any], dict[str, bytes]]:
    """``meta.json`` and the pictures."""
    count, width = source.count, 4 * -(-math.isqrt(source.count) // 4)
    logs = np.sign(source.means) * np.log1p(np.abs(source.means.astype(np.float64)))
    low, high = logs.min(axis=0), logs.max(axis=0)
    codes = np.rint((logs - low) / (high - low) * 65535).astype(int)
    means = (
        [[*(c & 255 for c in row), 255] for row in codes.tolist()],
        [[*(c >> 8 for c in row), 255] for row in codes.tolist()],
    )
    quats = []
    for quat in source.quats:
        place, parts = three(quat)
        quats.append([*(byte((p * math.sqrt(2) + 1) / 2 * 255) for p in parts), 252 + place])
    meta: dict[str, Any] = {
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "quats": {"files": ["quats.webp"]},
    }
    base, logits = source.sh[:, 0].astype(np.float64), source.opacity_logits.astype(np.float64)

    def code(values: np.ndarray, name: str, axis: int | None) -> np.ndarray:
        least, most = values.min(axis=axis), values.max(axis=axis)
        if version == 2:
            meta[name] = {"codebook": (least + (most - least) * np.arange(256) / 255).tolist()}
        else:
            meta[name] = {"mins": np.asarray(least).tolist(), "maxs": np.asarray(most).tolist()}
        return np.rint((values - least) / (most - least) * 255).astype(int)

    axis = None if version == 2 else 0
    scales = [[*row, 255] for row in code(source.log_scales.astype(np.float64), "scales", axis).tolist()]
    if version == 2:
        opacity = [byte(255 * sigmoid(v)) for v in logits]
        colors = [[*row, a] for row, a in zip(code(base, "sh0", None).tolist(), opacity, strict=True)]
        meta |= {"version": 2, "count": count}
    else:
        colors = code(np.concatenate([base, logits[:, None]], axis=1), "sh0", 0).tolist()
        meta["means"]["shape"] = [count, 3]
    meta["scales"]["files"], meta["sh0"]["files"] = ["scales.webp"], ["sh0.webp"]
    pictures = {
        "means_l.webp": _texture(means[0], width), "means_u.webp": _texture(means[1], width),
        "quats.webp": _texture(quats, width), "scales.webp": _texture(scales, width),
        "sh0.webp": _texture(colors, width),
    }  # fmt: skip
    if source.sh_degree:
        rest = code(source.sh[:, 1:].astype(np.float64), "shN", None)
        palette = np.zeros((-(-count // 64), 64, rest.shape[1], 4), np.uint8)
        palette[..., 3] = 255
        palette.reshape(-1, rest.shape[1], 4)[:count, :, :3] = rest
        meta["shN"] |= {"files": ["shN_centroids.webp", "shN_labels.webp"]}
        if version == 2:
            meta["shN"] |= {"count": count, "bands": source.sh_degree}
        pictures["shN_centroids.webp"] = palette.reshape(len(palette), -1, 4)
        pictures["shN_labels.webp"] = _texture([[i & 255, i >> 8, 0, 255] for i in range(count)], width)
    if model is not None:
        meta["model"] = model
    return meta, {name: picture_bytes(texels) for name, texels in pictures.items()}


def write_sog(file: Path, meta: dict[str, Any], pictures: dict[str, bytes], folder: str = "") -> Path:
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr(f"{folder}meta.json", json.dumps(meta))
        for name, data in pictures.items():
            archive.writestr(folder + name, data)
    return file


def read_sog(meta: dict[str, Any], pictures: dict[str, bytes]) -> SplatScene:
    def texels(name: str) -> tuple[list[tuple[int, ...]], int]:
        with Image.open(io.BytesIO(pictures[name])) as image:
            return [tuple(texel) for texel in np.asarray(image.convert("RGBA")).reshape(-1, 4).tolist()], image.width

    def lies(section: str, k: int, part: float) -> float:
        low, high = meta[section]["mins"], meta[section]["maxs"]
        return low + (high - low) * part if isinstance(low, float) else low[k] + (high[k] - low[k]) * part

    version = meta.get("version", 1)
    low, high, quats, scales, colors = (
        texels(f"{name}.webp")[0] for name in ("means_l", "means_u", "quats", "scales", "sh0")
    )
    rows = []
    for i in range(meta["count"] if version == 2 else meta["means"]["shape"][0]):
        logs = [lies("means", k, (low[i][k] + 256 * high[i][k]) / 65535) for k in range(3)]
        row: dict[str, Any] = {"mean": [math.copysign(math.exp(abs(v)) - 1, v) for v in logs]}
        row["quat"] = whole(quats[i][3] - 252, [(b / 255 * 2 - 1) / math.sqrt(2) for b in quats[i][:3]])
        if version == 2:
            row["scale"] = [meta["scales"]["codebook"][b] for b in scales[i][:3]]
            row["sh"] = [[meta["sh0"]["codebook"][b] for b in colors[i][:3]]]
            row["opacity"] = logit_of(colors[i][3])
        else:
            row["scale"] = [lies("scales", k, b / 255) for k, b in enumerate(scales[i][:3])]
            row["sh"] = [[lies("sh0", k, b / 255) for k, b in enumerate(colors[i][:3])]]
            row["opacity"] = lies("sh0", 3, colors[i][3] / 255)
        if "shN" in meta:
            palette, width = texels("shN_centroids.webp")
            label = texels("shN_labels.webp")[0][i]
            entry = label[0] + 256 * label[1]
            for k in range(width // 64):
                found = palette[entry // 64 * width + entry % 64 * (width // 64) + k][:3]
                row["sh"].append(
                    [meta["shN"]["codebook"][b] if version == 2 else lies("shN", 0, b / 255) for b in found]
                )
        rows.append(row)
    return scene(rows, meta.get("model", "classic").replace("default", "classic"))


# Checkpoints of gsplat's trainer, folders of Inria's


def write_inria(source: SplatScene, folder: Path, arguments: str, iteration: int = 7) -> Path:
    """``point_cloud`` and ``cfg_args``; the folder."""
    inner = folder / f"point_cloud/iteration_{iteration}"
    inner.mkdir(parents=True)
    write_ply(source, inner / "point_cloud.ply")
    (folder / "cfg_args").write_text(arguments)
    return folder


def write_checkpoints(source: SplatScene, folder: Path, ranks: int = 1, config: str | None = None, **more: Any) -> Path:
    """``ckpts`` and ``cfg.yml``; the first rank's file."""
    (folder / "ckpts").mkdir(parents=True)
    for rank in range(ranks):
        of = slice(rank * source.count // ranks, (rank + 1) * source.count // ranks)
        arrays = {
            "means": source.means[of], "scales": source.log_scales[of], "quats": source.quats[of],
            "opacities": source.opacity_logits[of], "sh0": source.sh[of, :1], "shN": source.sh[of, 1:],
        }  # fmt: skip
        splats = {name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in arrays.items()}
        extra = {name: value for name, value in more.items() if not name.startswith("splats_")}
        splats |= {name.removeprefix("splats_"): value for name, value in more.items() if name.startswith("splats_")}
        torch.save({"step": 29999, "splats": splats, **extra}, folder / f"ckpts/ckpt_29999_rank{rank}.pt")
    if config is not None:
        (folder / "cfg.yml").write_text(config)
    return folder / "ckpts/ckpt_29999_rank0.pt"
