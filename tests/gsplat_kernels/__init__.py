"""gsplat's own CUDA kernels, compiled for the CPU: a renderer that owes this package nothing.

Projection, spherical harmonics, tile intersection and rasterisation are cut out of gsplat's source files, by name,
and compiled by g++ behind `cuda.h`, one thread at a time. What is replaced in their text is listed in `_translated`.
What gsplat and Splatfacto do in Python around the kernels is `Kernels.image`.

The sources are those of the installed gsplat of the version, else of its package on PyPI, downloaded once.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.methods.splat.scene import SplatScene

_HERE = Path(__file__).resolve().parent
#: A folder with the trees of further versions, e.g. ``1.6.0/gsplat/cuda``.
SOURCES_VARIABLE = "NS_ABSTRACT_GSPLAT_SOURCES"
#: What PyPI has: pure Python packages that hold the sources of the kernels, and glm.
_WHEELS = {
    "1.4.0": "283d96724a8e41af4b338a2882285845ef2e04f3abcdb158bfbe9d515a64cdf0",
    "1.5.3": "515a3773641f5e7f7717acab6276c0b1d6dbcad087b7968ca653337c3189a982",
}
_TILE = 16
_COMPILE_SECONDS = 300
_DOWNLOAD_SECONDS = 300


class Unavailable(Exception):
    """The kernels cannot be had here; says why."""


# --- Sources ---------------------------------------------------------------------------------------------------------


def _cache_folder() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(base) / "ns_abstract_tests"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        folder = Path(tempfile.gettempdir()) / "ns_abstract_tests"
        folder.mkdir(exist_ok=True)
    return folder


def _downloaded(version: str) -> Path:
    """The package of PyPI, unpacked; its digest is checked by pip."""
    target = _cache_folder() / f"gsplat-{version}"
    if target.exists():
        return target
    with tempfile.TemporaryDirectory(dir=target.parent) as folder:
        requirement = Path(folder) / "requirements.txt"
        requirement.write_text(f"gsplat=={version} --hash=sha256:{_WHEELS[version]}\n")
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary", ":all:"]
        command += ["--require-hashes", "--requirement", str(requirement), "--dest", folder]
        try:
            subprocess.run(command, check=True, capture_output=True, text=True, timeout=_DOWNLOAD_SECONDS)
        except (OSError, subprocess.SubprocessError) as error:
            said = (getattr(error, "stderr", None) or str(error)).strip().splitlines()
            reason = said[-1] if said else "pip failed"
            raise Unavailable(f"gsplat {version} cannot be downloaded: {reason}") from None
        unpacked = Path(folder) / "unpacked"
        with zipfile.ZipFile(next(Path(folder).glob("*.whl"))) as archive:
            archive.extractall(unpacked)
        try:
            unpacked.rename(target)
        except OSError:
            # someone else was faster
            if not target.exists():
                raise
    return target


def sources(version: str) -> Path:
    """The folder ``gsplat`` of a version's sources.

    Raises:
        Unavailable: They are nowhere.
    """
    given = os.environ.get(SOURCES_VARIABLE)
    if given and (Path(given) / version / "gsplat" / "cuda").is_dir():
        return Path(given) / version / "gsplat"
    try:
        found = importlib.metadata.distribution("gsplat")
        if found.version.split("+")[0] == version:
            folder = Path(str(found.locate_file("gsplat")))
            if (folder / "cuda" / "csrc" / "third_party" / "glm").is_dir():
                return folder
    except importlib.metadata.PackageNotFoundError:
        pass
    if version not in _WHEELS:
        raise Unavailable(f"gsplat {version} is not on PyPI; set {SOURCES_VARIABLE}")
    return _downloaded(version) / "gsplat"


# --- Translation -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Parts:
    """What is cut out of a version's sources, in order: definitions by file, below ``cuda``."""

    number: int
    templated: bool
    definitions: tuple[tuple[str, tuple[str, ...]], ...]
    macros: tuple[tuple[str, tuple[str, ...]], ...] = ()


_HELPERS = ("quat_to_rotmat", "quat_scale_to_covar_preci", "persp_proj")
_PARTS = {
    "1.4.0": _Parts(
        140,
        True,
        (
            ("csrc/utils.cuh", (*_HELPERS, "pos_world_to_cam", "covar_world_to_cam", "inverse", "add_blur")),
            ("csrc/fully_fused_projection_fwd.cu", ("fully_fused_projection_fwd_kernel",)),
            ("csrc/spherical_harmonics.cuh", ("sh_coeffs_to_color_fast",)),
            ("csrc/isect_tiles.cu", ("isect_tiles",)),
            ("csrc/rasterize_to_pixels_fwd.cu", ("rasterize_to_pixels_fwd_kernel",)),
        ),
    ),
    "1.5.3": _Parts(
        153,
        False,
        (
            ("include/Utils.cuh", (*_HELPERS, "posW2C", "covarW2C", "add_blur")),
            ("csrc/ProjectionEWA3DGSFused.cu", ("projection_ewa_3dgs_fused_fwd_kernel",)),
            ("csrc/SphericalHarmonicsCUDA.cu", ("sh_coeffs_to_color_fast",)),
            ("csrc/IntersectTile.cu", ("intersect_tile_kernel",)),
            ("csrc/RasterizeToPixels3DGSFwd.cu", ("rasterize_to_pixels_3dgs_fwd_kernel",)),
        ),
        (("include/Common.h", ("ALPHA_THRESHOLD",)),),
    ),
    "1.6.0": _Parts(
        160,
        False,
        (
            ("include/Utils.cuh", (*_HELPERS, "posW2C", "covarW2C", "add_blur")),
            ("csrc/ProjectionEWA3DGSFused.cu", ("projection_ewa_3dgs_fused_fwd_kernel",)),
            (
                "csrc/SphericalHarmonics.cuh",
                ("camera_offset_from_world_to_camera", "view_direction_from_world_to_camera"),
            ),
            ("csrc/SphericalHarmonicsCUDA.cu", ("sh_coeffs_to_color_fast",)),
            (
                "csrc/IntersectTile.cu",
                (
                    "struct TileColumnRange",
                    "row_key_column_range",
                    "accutile_ellipse_intersection",
                    "accutile_process_tiles",
                    "intersect_tile_kernel",
                ),
            ),
            ("csrc/RasterizeToPixels3DGSDevice.cuh", ("struct GaussianWeight", "eval_gaussian_weight")),
            ("csrc/RasterizeToPixels3DGSSerialBatchFwd.cu", ("rasterize_to_pixels_3dgs_fwd_kernel",)),
        ),
        (
            (
                "include/Common.h",
                ("ALPHA_THRESHOLD", "GAUSSIAN_EXTEND", "MAX_ALPHA", "TRANSMITTANCE_THRESHOLD", "MIN_COMPENSATION"),
            ),
        ),
    ),
}  # fmt: skip


def _closing(text: str, start: int) -> int:
    """Behind the bracket that closes the one at ``start``; text within comments counts, gsplat's is balanced."""
    pair = {"(": ")", "{": "}"}
    level = 0
    for k in range(start, len(text)):
        if text[k] == text[start]:
            level += 1
        elif text[k] == pair[text[start]]:
            level -= 1
            if level == 0:
                return k + 1
    raise ValueError("brackets do not match")


def definition(text: str, name: str) -> str:
    """The definition of a function, or of a struct (``name`` "struct S"), from its first line to its last bracket."""
    struct = name.startswith("struct ")
    for match in re.finditer(rf"\b{re.escape(name)}\s*[{'{' if struct else '('}]", text):
        body = match.end() - 1 if struct else _closing(text, match.end() - 1)
        while text[body].isspace():
            body += 1
        if text[body] != "{":
            continue
        lines = text[: match.start()].split("\n")
        first = len(lines) - 1
        # the lines before it, up to an empty one, a comment, or the end of something else
        while first > 0 and not re.search(r"^\s*$|^\s*//|^\s*\*|^#|[;}{]\s*$", lines[first - 1]):
            first -= 1
        start = len("\n".join(lines[:first])) + (first > 0)
        return text[start : _closing(text, body)] + (";" if struct else "")
    raise ValueError(f"no definition of {name}")


def _translated(text: str, scalar: str) -> str:
    """gsplat's text with its scalar type, its conversions to integers and its shared memory replaced."""
    text = re.sub(r"\bfloat([234])\b", r"real\1", text)
    text = re.sub(r"\bfloat\b", "real", text)
    text = re.sub(r"\((?:int32_t|int)\)(?=\w|\()", "(saturated_int)", text)
    text = re.sub(r"\(uint32_t\)(?=\w|\()", "(saturated_unsigned)", text)
    text = text.replace("extern __shared__ int s[];", "alignas(16) int s[64];")
    text = text.replace("glm::max(", "max(")
    if scalar == "double":
        # the bits of a double are no key; the driver sorts by the depth itself
        text = re.sub(r"\*\s*\(int32_t \*\)\s*&\(depths\[idx\]\)", "0", text)
        # 0.99f and (1 - 0.99f)^2 <= 1e-4 belong together
        text = re.sub(r"(?<![\w.])(?!0\.99f)(\d+\.?\d*(?:e[-+]?\d+)?)f\b", r"\1", text)
    return text


def translation(folder: Path, version: str, scalar: str) -> str:
    """The C++ text of a version's kernels."""
    parts = _PARTS[version]
    pieces = ['#include "cuda.h"', "namespace gsplat {"]

    def read(file: str) -> str:
        return (folder / "cuda" / file).read_text(encoding="utf-8")

    for file, names in parts.macros:
        for name in names:
            found = re.search(rf"^#define {name}\s.*$", read(file), re.M)
            if found is None:
                raise ValueError(f"no macro {name}")
            pieces.append(_translated(found.group(), scalar))
    for file, names in parts.definitions:
        pieces += [_translated(definition(read(file), name), scalar) for name in names]
    return "\n\n".join([*pieces, "}  // namespace gsplat", '#include "driver.h"', ""])


# --- Building --------------------------------------------------------------------------------------------------------

#: Scalar types: exact formulas; IEEE float32; float32 with the device's stated errors of division, roots, exponential
#: and logarithm, in random directions.
SCALARS = ("double", "float", "fast")


def _glm(folder: Path) -> Path:
    own = folder / "cuda" / "csrc" / "third_party" / "glm"
    if (own / "glm" / "glm.hpp").exists():
        return own
    # a checkout without its submodule
    return sources("1.4.0") / "cuda" / "csrc" / "third_party" / "glm"


@cache
def library(version: str, scalar: str, contracted: bool, change: Callable[[str], str] | None = None) -> ctypes.CDLL:
    """The compiled kernels of a version.

    Args:
        version: "1.4.0", "1.5.3" or "1.6.0".
        scalar: One of `SCALARS`.
        contracted: Whether products and sums may become one fused operation, as nvcc does by default.
        change: Applied to the translated text.

    Raises:
        Unavailable: There is no g++, or there are no sources.
    """
    compiler = shutil.which("g++")
    if compiler is None:
        raise Unavailable("g++ is not installed")
    if contracted and " fma " not in _processor():
        raise Unavailable("this processor has no fused multiply-add")
    folder = sources(version)
    text = translation(folder, version, scalar)
    if change is not None:
        text = change(text)
    flags = ["-std=c++20", "-O2", "-shared", "-fPIC", "-w", "-fno-strict-aliasing"]
    flags += ["-mfma", "-ffp-contract=fast"] if contracted else ["-ffp-contract=off"]
    flags += [f"-DREAL_KIND={SCALARS.index(scalar)}", f"-DVERSION={_PARTS[version].number}"]
    flags += [f"-DTEMPLATED_TYPES={int(_PARTS[version].templated)}"]
    headers = "".join((_HERE / name).read_text() for name in ("cuda.h", "driver.h"))
    identity = hashlib.sha256("\0".join([text, headers, *flags]).encode()).hexdigest()[:20]
    target = _cache_folder() / f"kernels-{identity}.so"
    if not target.exists():
        with tempfile.TemporaryDirectory(dir=target.parent) as work:
            source = Path(work) / "kernels.cpp"
            source.write_text(text)
            built = Path(work) / "kernels.so"
            command = [compiler, *flags, f"-I{_HERE}", f"-I{_glm(folder)}", str(source), "-o", str(built)]
            done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=_COMPILE_SECONDS)
            if done.returncode:
                # not a reason to skip: a version that this cannot translate
                raise RuntimeError(f"g++ refuses gsplat {version}:\n{done.stderr[-4000:]}")
            built.replace(target)
    return ctypes.CDLL(str(target))


def _processor() -> str:
    try:
        return Path("/proc/cpuinfo").read_text().replace("\n", " ")
    except OSError:
        return ""


# --- Rendering -------------------------------------------------------------------------------------------------------


def _pointer(array: np.ndarray | None) -> ctypes.c_void_p | None:
    return None if array is None else ctypes.c_void_p(array.ctypes.data)


@dataclass(frozen=True)
class Stages:
    """What the kernels say before rasterisation, by Gaussian, and the tiles' lists.

    Attributes:
        radii: [N, 2] pixels; 0 where the Gaussian is not drawn.
        means2d, conics, depths, opacities, colors: [N, 2], [N, 3], [N], [N], [N, 3]; opacities with the antialias
            factor.
        offsets: [tiles + 1] where each tile's list begins.
        ids: Numbers of Gaussians, front to back within a tile.
    """

    radii: np.ndarray
    means2d: np.ndarray
    conics: np.ndarray
    depths: np.ndarray
    opacities: np.ndarray
    colors: np.ndarray
    offsets: np.ndarray
    ids: np.ndarray


class Kernels:
    """One scene, rendered by gsplat's kernels.

    Args:
        scene: The parameters as stored.
        version: gsplat's.
        scalar: "double", "float" or "fast" (see `SCALARS`).
        contracted: See `library`.
        noise: Seed and kind of the errors of "fast": 0 anywhere within what is documented, 1 at its ends, 2 at one end
            for each operation.
        change: See `library`.
    """

    def __init__(
        self, scene: SplatScene, version: str = "1.4.0", scalar: str = "float", contracted: bool = False,
        noise: tuple[int, int] = (0, 0), change: Callable[[str], str] | None = None,
    ) -> None:  # fmt: skip
        self.library: Any = library(version, scalar, contracted, change)
        self.version, self.noise = version, noise
        self.type: Any = torch.float64 if scalar == "double" else torch.float32
        self.scene = scene
        # splatfacto.py:590-628
        self.means, self.quats = self._stored(scene.means), self._stored(scene.quats)
        self.scales = torch.exp(self._stored(scene.log_scales))
        self.opacities = torch.sigmoid(self._stored(scene.opacity_logits))
        self.sh = self._stored(scene.sh)
        self.background = self._stored(scene.background)
        self.library.count_tiles.restype = ctypes.c_int64

    def _stored(self, array: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.array(array, order="C")).to(self.type)

    def _call(self, name: str, *arguments: Any) -> Any:
        given = []
        for value in arguments:
            if isinstance(value, torch.Tensor):
                value = value.numpy()
            if isinstance(value, np.ndarray):
                if not value.flags.c_contiguous:
                    raise ValueError("the kernels read C-contiguous arrays")
                value = _pointer(value)
            elif isinstance(value, int):
                value = ctypes.c_int64(value)
            given.append(value)
        return getattr(self.library, name)(*given)

    def view(self, camera_to_world: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        """World to camera [4, 4] (splatfacto.py:128-143) and the camera's position [3] (rendering.py of gsplat)."""
        pose = torch.from_numpy(np.array(camera_to_world)).to(self.type)[None]
        rotation = pose[:, :3, :3] * torch.tensor([[[1.0, -1.0, -1.0]]], dtype=self.type)
        inverse = rotation.transpose(1, 2)
        view = torch.zeros(1, 4, 4, dtype=self.type)
        view[:, 3, 3] = 1.0
        view[:, :3, :3] = inverse
        view[:, :3, 3:4] = -torch.bmm(inverse, pose[:, :3, 3:4])
        return view[0].contiguous(), torch.inverse(view)[0, :3, 3].contiguous()

    def stages(self, camera: PinholeCamera, camera_to_world: np.ndarray) -> Stages:
        """Projection, colours and tiles for one pose [3, 4] (OpenGL)."""
        n, dtype = self.scene.count, torch.zeros(0, dtype=self.type).numpy().dtype
        view, eye = self.view(camera_to_world)
        intrinsics = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], dtype)
        antialiased = self.scene.rasterize_mode == "antialiased"
        radii, depths = np.zeros((n, 2), np.int32), np.zeros(n, dtype)
        means2d, conics = np.zeros((n, 2), dtype), np.zeros((n, 3), dtype)
        factors = np.zeros(n, dtype) if antialiased else None
        self._call("set_noise", *self.noise)
        self._call(
            "project", n, self.means, self.quats, self.scales, self.opacities, view, intrinsics, camera.width,
            camera.height, radii, means2d, depths, conics, factors,
        )  # fmt: skip
        opacities = self.opacities.numpy() if factors is None else self.opacities.numpy() * factors
        if self.scene.color_model == "sigmoid":
            colors = torch.sigmoid(self.sh[:, 0]).numpy()
        else:
            colors = np.zeros((n, 3), dtype)
            self._call("shade", n, self.sh.shape[1], self.scene.sh_degree, self.means, eye, view, self.sh, colors)
        colors = np.ascontiguousarray(colors)
        across, down = -(-camera.width // _TILE), -(-camera.height // _TILE)
        projected = (n, means2d, radii, depths, conics, opacities, across, down)
        counts = np.zeros(n, np.int32)
        total = self._call("count_tiles", *projected, counts)
        offsets, ids = np.zeros(across * down + 1, np.int32), np.zeros(max(total, 1), np.int32)
        self._call("fill_tiles", *projected, counts, offsets, ids)
        return Stages(radii, means2d, conics, depths, opacities, colors, offsets, ids[:total])

    def pixels(
        self, camera: PinholeCamera, camera_to_world: np.ndarray, pixels: np.ndarray, found: Stages | None = None
    ) -> np.ndarray:
        """Colours [k, 3] in [0, 1] of pixels [k, 2] (row, column)."""
        if found is None:
            found = self.stages(camera, camera_to_world)
        colors, alphas = self._rasterized(camera, found, pixels, found.colors)
        # splatfacto.py:640-643
        render = torch.from_numpy(colors) + (1 - torch.from_numpy(alphas)[:, None]) * self.background
        return torch.clamp(render, 0.0, 1.0).numpy()

    def layers(self, camera: PinholeCamera, camera_to_world: np.ndarray) -> np.ndarray:
        """Accumulation and expected depth [H, W, 2], as of gsplat's render mode RGB+ED, before Splatfacto fills in the
        pixels where nothing is drawn, whose depth is NaN here."""
        found = self.stages(camera, camera_to_world)
        pixels = np.stack(np.mgrid[: camera.height, : camera.width], axis=-1).reshape(-1, 2)
        depths = np.ascontiguousarray(np.repeat(found.depths[:, None], 3, axis=1))
        sums, alphas = (torch.from_numpy(array) for array in self._rasterized(camera, found, pixels, depths))
        # gsplat's rendering.py; splatfacto.py:636
        depth = sums[:, :1] / alphas[:, None].clamp(min=1e-10)
        drawn = alphas[:, None] > 0
        both = torch.cat([alphas[:, None], torch.where(drawn, depth, torch.nan)], dim=1)
        return both.numpy().reshape(camera.height, camera.width, 2)

    def _rasterized(
        self, camera: PinholeCamera, found: Stages, pixels: np.ndarray, values: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Weighted sums [k, 3] of ``values`` [N, 3] and accumulations [k] of pixels [k, 2]."""
        pixels = np.ascontiguousarray(pixels, np.int64)
        colors, alphas = np.zeros((len(pixels), 3), found.depths.dtype), np.zeros(len(pixels), found.depths.dtype)
        across, down = -(-camera.width // _TILE), -(-camera.height // _TILE)
        ids = found.ids if len(found.ids) else np.zeros(1, np.int32)
        self._call(
            "rasterize", self.scene.count, found.means2d, found.conics, values, found.opacities, camera.width,
            camera.height, across, down, found.offsets, ids, len(pixels), pixels, colors, alphas,
        )  # fmt: skip
        return colors, alphas

    def image(self, camera: PinholeCamera, camera_to_world: np.ndarray) -> np.ndarray:
        """The picture [H, W, 3] in [0, 1]."""
        pixels = np.stack(np.mgrid[: camera.height, : camera.width], axis=-1).reshape(-1, 2)
        return self.pixels(camera, camera_to_world, pixels).reshape(camera.height, camera.width, 3)
