"""Binary glTF files (.glb) with the extension KHR_gaussian_splatting: one primitive of Gaussians in one node.

Scales are linear, opacities are in [0, 1], quaternions are (x, y, z, w); spherical harmonics have gsplat's signs and
order. Numbers are float32, or integers that stand for them as glTF says. What the extension leaves to other extensions
(compression, kernels, projections), other colour spaces and transformed nodes are refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import JSON_BYTES_LIMIT, file_size, parse_json, show, unusable
from ns_abstract.io.memory import check_memory
from ns_abstract.methods.overrides import Overrides
from ns_abstract.methods.splat.formats.decoded import DecodedSplats, float32_rows, reserve

MAGIC = b"glTF"
_EXTENSION = "KHR_gaussian_splatting"
_HEADER, _CHUNK = 12, 8
#: Nodes that are looked at.
_NODES = 10_000
_AGAIN = "export the scene again, or as .ply"
_PLY = "export the scene as .ply"
#: Component types: dtype, and what an integer is divided by where it is normalised.
_TYPES = {
    5120: ("<i1", 127.0), 5121: ("<u1", 255.0), 5122: ("<i2", 32767.0), 5123: ("<u2", 65535.0), 5126: ("<f4", 1.0)
}  # fmt: skip
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
#: Attributes: their glTF type, component types, and whether integers must be normalised (None: either).
_FLOAT = (5126,)
_ATTRIBUTES: dict[str, tuple[str, tuple[int, ...], bool | None]] = {
    "ROTATION": ("VEC4", (5126, 5120, 5122), True),
    "SCALE": ("VEC3", (5126, 5121, 5123), None),
    "OPACITY": ("SCALAR", (5126, 5121, 5123), True),
}
_VALUES = {
    "kernel": ("ellipse", None),
    "colorSpace": ("srgb_rec709_display", None),
    "projection": ("perspective", "perspective"),
    "sortingMethod": ("cameraDistance", "cameraDistance"),
}
_MOVES = {
    "matrix": [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0],
    "rotation": [0.0, 0.0, 0.0, 1.0], "scale": [1.0, 1.0, 1.0], "translation": [0.0, 0.0, 0.0],
}  # fmt: skip
_LIMIT = 40.0


def decode_glb(path: Path, overrides: Overrides) -> DecodedSplats:
    """Return the Gaussians of a .glb file.

    Raises:
        InputError: The file is damaged, holds no or other Gaussians, or other things beside them.
    """
    try:
        root, data = _chunks(path)
        columns = _Accessors(root, data)
        attributes = _primitive(root)
        names = _harmonics(attributes)
        count = columns.count(attributes["POSITION"], "POSITION")
        reserve(count, len(names), path, len(data))
        read = {
            name: columns.read(attributes, f"{_EXTENSION}:{name}", count, *kind) for name, kind in _ATTRIBUTES.items()
        }
        means = columns.read(attributes, "POSITION", count, "VEC3", _FLOAT, None)
        bands = [columns.read(attributes, f"{_EXTENSION}:{name}", count, "VEC3", _FLOAT, None) for name in names]
    except InputError as error:
        raise error.within(path) from None
    opacity = read["OPACITY"][:, 0]
    for name, values, low, high in (("SCALE", read["SCALE"], 0.0, np.inf), ("OPACITY", opacity, 0.0, 1.0)):
        if ((values < low) | (values > high)).any():
            problem = f"holds a value outside [{low:g}, {high:g}]"
            raise InputError(problem, file=path, field=f"{_EXTENSION}:{name}", fix=_AGAIN)
    with np.errstate(divide="ignore", invalid="ignore"):
        logits = (np.log(opacity) - np.log1p(-opacity)).clip(-_LIMIT, _LIMIT)
        log_scales = np.log(read["SCALE"])
    rest = np.stack(bands[1:], axis=1) if len(bands) > 1 else None
    return DecodedSplats(
        "a .glb file of KHR_gaussian_splatting",
        (path,),
        float32_rows(means, log_scales, read["ROTATION"][:, [3, 0, 1, 2]], logits, bands[0], rest),
        {
            "scales": f"{_EXTENSION}:SCALE",
            "quats": f"{_EXTENSION}:ROTATION",
            "opacities": f"{_EXTENSION}:OPACITY",
            "colours": f"{_EXTENSION}:SH_DEGREE_0_COEF_0",
        },
        notes=(
            "the axes are those of the file (glTF's are y up): cameras must be given in the same axes",
            "glTF viewers sort by the distance from the camera and cut Gaussians at 3 standard deviations; gsplat "
            "sorts by depth",
        ),
    )


def _chunks(path: Path) -> tuple[dict[str, Any], bytes]:
    """Return the JSON and the binary chunk."""
    size = file_size(path, ".glb file")
    check_memory(size, path, "the file")
    with path.open("rb") as stream:
        head = stream.read(_HEADER + _CHUNK)
        if len(head) < _HEADER + _CHUNK or head[:4] != MAGIC or head[16:20] != b"JSON":
            raise InputError("not a binary glTF file (.glb), or cut off", fix=_AGAIN)
        version, length, text = (int.from_bytes(head[k : k + 4], "little") for k in (4, 8, 12))
        if version != 2:
            raise InputError(f"version {version} of glTF", fix=_AGAIN)
        if length != size:
            raise InputError(f"{size} bytes, its header says {length}: cut off, or more behind it", fix=_AGAIN)
        if text > min(JSON_BYTES_LIMIT, size - _HEADER - _CHUNK):
            raise InputError(f"a JSON part of {text} bytes", fix=_AGAIN)
        content = stream.read(text)
        head = stream.read(_CHUNK)
        binary = int.from_bytes(head[:4], "little")
        if head[4:] != b"BIN\0" or binary > size - _HEADER - 2 * _CHUNK - text:
            raise InputError("no binary part, or cut off", fix=_AGAIN)
        data = stream.read(binary)
        if stream.read(1):
            raise InputError("more parts than two", fix=_AGAIN)
    try:
        root = parse_json(content.decode("utf-8"))
    except UnicodeDecodeError:
        raise InputError("its JSON part is not UTF-8", fix=_AGAIN) from None
    if not isinstance(root, dict):
        raise InputError("its JSON part is no object", fix=_AGAIN)
    return root, data


def _list(value: Any, name: str) -> list[dict[str, Any]]:
    if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value):
        raise unusable(value, field=name, fix=_AGAIN)
    return value


def _primitive(root: dict[str, Any]) -> dict[str, int]:
    """Return the attributes of the one primitive of Gaussians, in a node that does not move it."""
    required = root.get("extensionsRequired", [])
    if not isinstance(required, list) or not set(map(str, required)) <= {_EXTENSION}:
        others = [str(name)[:60] for name in required if name != _EXTENSION] if isinstance(required, list) else required
        raise InputError(f"needs {show(others)}: {others}"[:200], field="extensionsRequired", fix=_PLY)
    meshes, nodes = _list(root.get("meshes", []), "meshes"), _list(root.get("nodes", []), "nodes")
    primitives = [p for k, mesh in enumerate(meshes) for p in _list(mesh.get("primitives"), f"meshes[{k}].primitives")]
    for primitive in primitives:
        if not isinstance(primitive.get("extensions", {}), dict):
            raise unusable(primitive["extensions"], field="meshes", fix=_AGAIN)
    splats = [p for p in primitives if _EXTENSION in p.get("extensions", {})]
    if not splats:
        raise InputError(f"holds no Gaussians ({_EXTENSION})", field="meshes", fix=_PLY)
    if len(primitives) > 1:
        raise InputError(
            f"{len(primitives)} things are drawn", field="meshes", fix="export the Gaussians alone, as one"
        )
    if len(nodes) > _NODES:
        raise InputError(f"{len(nodes)} nodes", field="nodes", fix=_PLY)
    if sum("mesh" in node for node in nodes) != 1 or any("skin" in node or "weights" in node for node in nodes):
        raise InputError("the Gaussians do not stand in one node", field="nodes", fix=_PLY)
    for k, node in enumerate(nodes):
        for name, still in _MOVES.items():
            if name in node and node[name] != still:
                raise InputError(f"moves what it holds: {show(node[name])}", field=f"nodes[{k}].{name}", fix=_PLY)
        if node.get("extensions"):
            raise InputError(f"has extensions: {show(node['extensions'])}", field=f"nodes[{k}].extensions", fix=_PLY)
    if root.get("animations"):
        raise InputError("moves with time", field="animations", fix=_PLY)
    return _checked(splats[0])


def _checked(primitive: dict[str, Any]) -> dict[str, int]:
    extension = primitive["extensions"][_EXTENSION]
    if not isinstance(extension, dict) or primitive.get("mode") != 0 or "targets" in primitive:
        raise InputError("is no primitive of points", field="meshes", fix=_AGAIN)
    others = [name for name in primitive["extensions"] if name != _EXTENSION]
    others += list(extension["extensions"]) if isinstance(extension.get("extensions"), dict) else []
    if others:
        raise InputError(f"is stored with {', '.join(others)[:120]}", field=_EXTENSION, fix=_PLY)
    for name, value in extension.items():
        if name not in ("extensions", "extras") and (name not in _VALUES or value != _VALUES[name][0]):
            raise unusable(value, field=f"{_EXTENSION}.{name}", fix=_PLY)
    for name, (_, default) in _VALUES.items():
        if name not in extension and default is None:
            raise InputError("missing", field=f"{_EXTENSION}.{name}", fix=_AGAIN)
    attributes = primitive.get("attributes")
    if not isinstance(attributes, dict) or not all(type(v) is int for v in attributes.values()):
        raise unusable(attributes, field="attributes", fix=_AGAIN)
    return attributes


def _harmonics(attributes: dict[str, int]) -> list[str]:
    """Return the names of the coefficients in order; unknown attributes are refused."""
    names: list[str] = []
    for degree in range(4):
        wanted = [f"SH_DEGREE_{degree}_COEF_{k}" for k in range(2 * degree + 1)]
        there = [f"{_EXTENSION}:{name}" in attributes for name in wanted]
        if not any(there) and degree:
            break
        if not all(there):
            raise InputError("missing", field=f"{_EXTENSION}:{wanted[there.index(False)]}", fix=_AGAIN)
        names += wanted
    # COLOR_0 is for programs that draw points
    readable = {"POSITION", "COLOR_0", *(f"{_EXTENSION}:{name}" for name in (*_ATTRIBUTES, *names))}
    if unknown := sorted(set(attributes) - readable):
        raise InputError(
            f"holds {', '.join(unknown)[:120]}", field="attributes", fix="export with degree 3 or less, as .ply"
        )
    if missing := [
        name for name in ("POSITION", *(f"{_EXTENSION}:{n}" for n in _ATTRIBUTES)) if name not in attributes
    ]:
        raise InputError("missing", field=missing[0], fix=_AGAIN)
    return names


class _Accessors:
    """Columns of the binary part."""

    def __init__(self, root: dict[str, Any], data: bytes) -> None:
        self.accessors = _list(root.get("accessors", []), "accessors")
        self.views = _list(root.get("bufferViews", []), "bufferViews")
        buffers = _list(root.get("buffers", []), "buffers")
        if len(buffers) != 1 or "uri" in buffers[0] or not _whole(buffers[0].get("byteLength"), len(data)):
            raise InputError("is not one buffer inside the file", field="buffers", fix=_AGAIN)
        self.data = np.frombuffer(data, np.uint8, buffers[0]["byteLength"])

    def count(self, index: int, name: str) -> int:
        """Return the number of rows of an accessor."""
        accessor = self._at(self.accessors, index, name)
        count = accessor.get("count")
        if not _whole(count, len(self.data)):
            raise unusable(count, field=f"{name}: count", fix=_AGAIN)
        return count

    def read(
        self,
        attributes: dict[str, int],
        name: str,
        count: int,
        kind: str,
        types: Sequence[int],
        normalised: bool | None,
    ) -> NDArray[np.float64]:
        """Return [count, width] numbers of an attribute."""
        accessor = self._at(self.accessors, attributes[name], name)
        stored = accessor.get("componentType"), accessor.get("type"), accessor.get("count")
        component = stored[0]
        if component not in types or stored[1] != kind or stored[2] != count or type(component) is not int:
            problem = f"{show(stored[2])} rows of {show(stored[1])}, component type {show(stored[0])}"
            raise InputError(problem, field=name, fix=f"store {count} rows of {kind} as float32")
        scaled = accessor.get("normalized", False)
        if "sparse" in accessor or "extensions" in accessor or type(scaled) is not bool:
            raise InputError("is stored sparsely or with extensions", field=name, fix=_PLY)
        if component != _FLOAT[0] and normalised is not None and scaled is not normalised:
            raise InputError("integers that are not normalised", field=name, fix=_AGAIN)
        view = self._at(self.views, accessor.get("bufferView"), name)
        dtype, most = _TYPES[component]
        width, item = _WIDTHS[kind], np.dtype(dtype).itemsize
        start, first, length = accessor.get("byteOffset", 0), view.get("byteOffset", 0), view.get("byteLength")
        stride = view.get("byteStride", width * item)
        inside = all(_whole(v, len(self.data), 0) for v in (start, first, length)) and _whole(stride, 252, width * item)
        if not inside or view.get("buffer") != 0 or view.get("extensions"):
            raise InputError("its buffer view is not in the file", field=name, fix=_AGAIN)
        if first + length > len(self.data) or start + (count - 1) * stride + width * item > length:
            raise InputError("cut off: its rows end behind its buffer view", field=name, fix=_AGAIN)
        begin = self.data[first + start :]
        rows = np.lib.stride_tricks.as_strided(begin, (count, width * item), (stride, 1), writeable=False)
        values = np.ascontiguousarray(rows).view(dtype).astype(np.float64).reshape(count, width)
        return np.maximum(values / most, -1.0) if scaled and component != _FLOAT[0] else values

    def _at(self, entries: list[dict[str, Any]], index: Any, name: str) -> dict[str, Any]:
        if type(index) is not int or not 0 <= index < len(entries):
            raise InputError(f"found {show(index)}, there are {len(entries)}", field=name, fix=_AGAIN)
        return entries[index]


def _whole(value: Any, most: int, least: int = 1) -> TypeGuard[int]:
    return type(value) is int and least <= value <= most
