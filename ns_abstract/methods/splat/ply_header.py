"""The header of a standard 3DGS ``.ply``: its columns, and the picture's options in its comments."""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import file_size, show
from ns_abstract.io.kinds import refuse_other_kind
from ns_abstract.io.memory import check_memory
from ns_abstract.methods.splat.formats.decoded import RENDER_ELSEWHERE, TWO_D

FIX = "export the scene again as a standard, uncompressed 3DGS .ply"
#: Bands of spherical harmonics by the number of f_rest columns.
DEGREES = {0: 0, 9: 1, 24: 2, 45: 3}
#: Columns by what they hold.
GROUPS = {
    "means": ("x", "y", "z"),
    "f_dc": ("f_dc_0", "f_dc_1", "f_dc_2"),
    "opacity": ("opacity",),
    "scales": ("scale_0", "scale_1", "scale_2"),
    "quats": ("rot_0", "rot_1", "rot_2", "rot_3"),
}
_GROUPED = {name for group in GROUPS.values() for name in group}
#: The column of mip-splatting.
FILTER = "filter_3D"

_HEADER_LIMIT = 64 * 2**10
_SIZES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "int32", "uint32", "float", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}
_FLOATS = ("float", "float32", "double", "float64")
#: Beginnings of columns of Gaussians that are drawn in another way, and what they are.
_FAMILIES = (
    ("sg_", "Gaussians with lobes of spherical Gaussians", RENDER_ELSEWHERE),
    ("f_asg", "Gaussians with anisotropic spherical Gaussians", RENDER_ELSEWHERE),
    ("sb_", "beta kernels with spherical betas", RENDER_ELSEWHERE),
    ("beta", "beta kernels", RENDER_ELSEWHERE),
    ("shape", "generalised exponential kernels", RENDER_ELSEWHERE),
    ("trbf_", "Gaussians that move in time", RENDER_ELSEWHERE),
    ("motion_", "Gaussians that move in time", RENDER_ELSEWHERE),
    ("omega_", "Gaussians that move in time", RENDER_ELSEWHERE),
    ("scale_t", "Gaussians that move in time", RENDER_ELSEWHERE),
    ("t_scale", "Gaussians that move in time", RENDER_ELSEWHERE),
    ("rot_r_", "Gaussians that move in time", RENDER_ELSEWHERE),
    ("f_offset", "anchors of neural Gaussians", RENDER_ELSEWHERE),
    ("f_anchor_feat", "anchors of neural Gaussians", RENDER_ELSEWHERE),
    ("tex_", "textured Gaussians", RENDER_ELSEWHERE),
    ("texture_", "textured Gaussians", RENDER_ELSEWHERE),
    ("albedo", "Gaussians of materials, which a shader lights", RENDER_ELSEWHERE),
    ("base_color", "Gaussians of materials, which a shader lights", RENDER_ELSEWHERE),
    ("roughness", "Gaussians of materials, which a shader lights", RENDER_ELSEWHERE),
    ("metallic", "Gaussians of materials, which a shader lights", RENDER_ELSEWHERE),
)
_MODES = {"mip": "antialiased", "default": "classic"}
_COMPENSATED = {"0": "classic", "1": "antialiased", "false": "classic", "true": "antialiased"}


@dataclass(frozen=True)
class PlyElement:
    """An element that a header declares; ``types``: scalar type by property, or "list"."""

    name: str
    count: int
    types: dict[str, str]

    def least_size(self, ascii_text: bool) -> int:
        """Return the least bytes that the rows take."""
        if ascii_text:
            return self.count * max(1, 2 * len(self.types))
        return self.count * sum(_SIZES.get(kind, 1) for kind in self.types.values())


@dataclass(frozen=True)
class PlyHeader:
    """The content of a checked header.

    Attributes:
        bands: K, bands of spherical harmonics.
        mode: "classic" or "antialiased" if a comment says so.
        unused: Columns and elements that have no effect.
    """

    vertex: PlyElement
    bands: int
    mode: str | None
    comment: str
    unused: tuple[str, ...]


@dataclass(frozen=True)
class PlyDeclaration:
    """The declarations of a header, checked against the size of the file.

    Attributes:
        mode: "classic" or "antialiased" if a comment says so.
    """

    elements: list[PlyElement]
    mode: str | None
    comment: str


def read_declaration(path: Path, mode_given: bool) -> PlyDeclaration:
    """Return the declarations in the header of ``path``.

    ``mode_given``: whether the user says how to rasterise, so that a comment that cannot be understood does not matter.
    Raises InputError where it is not the header of a .ply of splats, or the file is cut off.
    """
    size = file_size(path, ".ply")
    refuse_other_kind(path)
    try:
        with path.open("rb") as stream:
            head = stream.read(_HEADER_LIMIT)
    except OSError as error:
        message = error.strerror or type(error).__name__
        raise InputError(f".ply cannot be read: {message}", file=path, fix="check the permissions") from None
    end = re.search(rb"^end_header\r?\n", head, re.MULTILINE)
    if not head.startswith((b"ply\n", b"ply\r\n")) or end is None:
        raise InputError("not a .ply file with a header", file=path, fix=FIX)
    text = head[: end.start()].decode("latin-1")
    ascii_text, elements = _parse(text, path)
    vertex = next((element for element in elements if element.name == "vertex"), None)
    if vertex is not None:
        _refuse_other_splats(vertex, path)
    for element in elements:
        if element.count and (not element.types or "list" in element.types.values()):
            problem = "has list properties" if element.types else "has no properties"
            raise InputError(problem, file=path, field=f"element {element.name}", fix=FIX)
    needed = sum(element.least_size(ascii_text) for element in elements)
    # The last line of a text file may lack its line break.
    if needed - ascii_text > size - end.end():
        raise InputError(
            f"the header claims at least {needed} bytes of data, {size - end.end()} follow",
            file=path,
            field="header",
            fix="the file is cut off: copy or export it again",
        )
    return PlyDeclaration(elements, *_comments(text, path, mode_given))


def standard_header(declared: PlyDeclaration, path: Path) -> PlyHeader:
    """Return the header of a standard 3DGS .ply. Raises InputError where its columns are not those of one."""
    vertex = next((element for element in declared.elements if element.name == "vertex"), None)
    if vertex is None or vertex.count < 1:
        raise InputError("no Gaussians", file=path, field="element vertex", fix=FIX)
    bands = _bands(vertex, path)
    check_memory(2 * 4 * vertex.count * (11 + 3 * bands), path, f"the scene of {vertex.count} Gaussians")
    used = {*_GROUPED, FILTER}
    unused = [name for name in vertex.types if name not in used and not name.startswith("f_rest_")]
    others = [f"element {element.name}" for element in declared.elements if element is not vertex]
    return PlyHeader(vertex, bands, declared.mode, declared.comment, (*unused, *others))


def read_elements(path: Path, elements: list[PlyElement]) -> dict[str, Any]:
    """Return tables of the named elements, as numpy's structured arrays. Raises InputError for a damaged file."""
    import plyfile

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            data = plyfile.PlyData.read(str(path))
        tables = {element.name: data[element.name].data for element in elements}
        if any(len(tables[e.name]) != e.count or tables[e.name].dtype.names != tuple(e.types) for e in elements):
            raise ValueError("ambiguous header")
        return tables
    except MemoryError:
        raise
    except Exception as error:  # numpy and plyfile raise many types on damaged files
        text = " ".join(str(error).split())[:160] or type(error).__name__
        raise InputError(f"damaged .ply: {text}", file=path, fix=FIX) from None


def _comments(text: str, path: Path, mode_given: bool) -> tuple[str | None, str]:
    """Return the mode in the last comment about it, and that comment; (None, "") without one."""
    mode, said = None, ""
    for line in text.split("\n"):
        words = line.strip().split(None, 1)
        if len(words) < 2 or words[0].lower() not in ("comment", "obj_info"):
            continue
        match = re.fullmatch(r"(splatrendermode|antialiased)\b[\s:=]*(.*)", words[1].strip(), re.IGNORECASE)
        if match is None:
            continue
        value = match[2].strip().strip("'\"").lower()
        if match[1].lower() == "splatrendermode":
            if value == "2dgs":
                raise InputError(TWO_D, file=path, field="comment SplatRenderMode", fix=RENDER_ELSEWHERE)
            options = _MODES
        else:
            options = _COMPENSATED
        if value not in options and not mode_given:
            raise InputError(
                f"found {show(match[2].strip())}, expected one of {', '.join(options)}",
                file=path,
                field=f"comment {match[1]}",
                fix="give --rasterize-mode",
            )
        mode, said = options.get(value), " ".join(words[1].split())
    return mode, said


def _refuse_other_splats(vertex: PlyElement, path: Path) -> None:
    """Refuse point clouds, 2-D Gaussians and Gaussians that are drawn in another way, by name."""
    for column in vertex.types:
        for beginning, what, fix in _FAMILIES:
            if column.lower().startswith(beginning):
                raise InputError(
                    f"{what}: its picture is not that of its other columns alone",
                    file=path,
                    field=f"vertex.{column}",
                    fix=fix.replace("{name}", path.name),
                )
        further = re.fullmatch(r"(f_dc|scale|rot)_\d+", column)
        if further is not None and column not in _GROUPED:
            raise InputError(
                f"more columns {further[1]}_* than a Gaussian in space has: another rasteriser draws by them",
                file=path,
                field=f"vertex.{column}",
                fix=RENDER_ELSEWHERE,
            )
    scales = [name for name in GROUPS["scales"] if name in vertex.types]
    if scales == ["scale_0", "scale_1"]:
        raise InputError(TWO_D, file=path, field="vertex.scale_2", fix=RENDER_ELSEWHERE)
    if not scales and "opacity" not in vertex.types and set("xyz") <= set(vertex.types):
        raise InputError(
            "a point cloud: it has no scales and opacities",
            file=path,
            field="element vertex",
            fix="give the trained scene, not the points that training begins with",
        )


def _bands(vertex: PlyElement, path: Path) -> int:
    rest = [name for name in vertex.types if name.startswith("f_rest_")]
    if len(rest) not in DEGREES or set(rest) != {f"f_rest_{i}" for i in range(len(rest))}:
        what = "spherical harmonics of degree 4; " if len(rest) == 72 else ""
        raise InputError(
            f"{what}{len(rest)} properties, expected f_rest_0 to f_rest_8, f_rest_23 or f_rest_44, or none",
            file=path,
            field="vertex.f_rest_*",
            fix=FIX,
        )
    for name in [*(column for group in GROUPS.values() for column in group), *rest]:
        kind = vertex.types.get(name)
        if kind is None:
            fix = FIX
            if name.startswith("f_dc") and "red" in vertex.types:
                fix = "export with --ply-color-mode sh_coeffs"
            raise InputError("property missing", file=path, field=f"vertex.{name}", fix=fix)
        if kind not in _FLOATS:
            raise InputError(f"type {kind}, expected float", file=path, field=f"vertex.{name}", fix=FIX)
    if vertex.types.get(FILTER, "float") not in _FLOATS:
        problem = f"type {vertex.types[FILTER]}, expected float"
        raise InputError(problem, file=path, field=f"vertex.{FILTER}", fix=FIX)
    return len(rest) // 3 + 1


def _parse(header: str, path: Path) -> tuple[bool, list[PlyElement]]:
    """Return whether the data is text, and the declared elements."""
    formats: list[str] = []
    elements: list[PlyElement] = []
    for number, line in enumerate(header.split("\n")[1:], start=2):
        words = line.split()
        good = True
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) == 3:
            formats.append(words[1])
        elif words[0] == "element" and len(words) == 3 and re.fullmatch(r"[0-9]{1,12}", words[2]):
            elements.append(PlyElement(words[1], int(words[2]), {}))
        elif words[0] == "property" and elements and len(words) in (3, 5):
            kind = "list" if words[1] == "list" else words[1]
            good = words[-1] not in elements[-1].types
            good = good and (kind == "list" if len(words) == 5 else kind in _SIZES)
            elements[-1].types[words[-1]] = kind
        else:
            good = False
        if not good:
            raise InputError(f"line {number}: {show(line.strip())}", file=path, field="header", fix=FIX)
    if formats not in (["ascii"], ["binary_little_endian"], ["binary_big_endian"]):
        raise InputError(f"format {show(' '.join(formats))}", file=path, field="header", fix=FIX)
    return formats == ["ascii"], elements
