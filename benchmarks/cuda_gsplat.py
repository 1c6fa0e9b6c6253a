"""Attack float32 bounds by real CUDA gsplat, on a machine that need not have this package's dependencies.

    python benchmarks/cuda_gsplat.py prepare RUN/config.yml ... --output-dir CELLS [--stiff] [--layers] [--planted]
        [--sets x yaw roll six orbit] [--modes classic antialiased] [--versions 1.4.0 1.5.3 1.6.0]
    python benchmarks/cuda_gsplat.py compare CELLS [--seconds 60] [--output-dir bench]

``prepare`` needs no GPU. It bounds cells of each set, of width zero and of ``--widths`` times the set's, as
``kernels_on_cpu.py`` does, and writes them, one file by run, mode and version of gsplat, with the poses to render and
the parameters as stored. Where only one pose is in a cell, nothing but the charge for float32 rounding lies between its
bounds and the render, so these cells are the hard ones.

``compare`` needs a CUDA GPU, gsplat and numpy. It takes the files of the installed gsplat's version, activates and
renders as Splatfacto does (nerfstudio 1.1.5, splatfacto.py:127-143 and 536-643), and compares with tolerance zero.
Until ``--seconds`` have passed it goes on with poses that it searches in the cells that have a width; that alone
imports this package, for poses.

``used`` is how much of a bound a render took: its distance from the middle in half-widths; 1 is the bound itself. Where
rounding decides whether a Gaussian is drawn, renders take nearly all of it; ``used by 99%`` says what others take.

``--planted`` bounds another rasteriser (alpha at most 0.98); that nothing is outside is then the failure.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

#: What a scene's file holds as stored.
PARAMETERS = ("means", "log_scales", "quats", "opacity_logits", "sh", "background")
CAMERA = ("fx", "fy", "cx", "cy", "width", "height")
#: Half-widths below this are roundings of the bounds themselves: nothing is said of how much of them is used.
LEAST_HALF = 2.0**-21
#: Poses rendered at once by the search, and poses kept to search on from.
AT_ONCE, KEPT = 16, 8
#: Part of the seconds that cells of runs get, if there are stiff cases, too; these come last, should they stop CUDA.
FIRST_PART = 0.7


# --- Files -----------------------------------------------------------------------------------------------------------


def read(file: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """A file's header and its arrays."""
    with np.load(file, allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    return json.loads(str(arrays.pop("header"))), arrays


def save(file: Path, header: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
    """Write what `read` reads."""
    file.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(file, header=np.array(json.dumps(header)), **arrays)  # pyright: ignore[reportArgumentType]


# --- Preparing -------------------------------------------------------------------------------------------------------


@dataclass
class Bounded:
    """The cells of one file, as they are bounded.

    Attributes:
        header: See `save`.
        arrays: By name, one entry a cell; poses have several.
    """

    header: dict[str, Any]
    arrays: dict[str, list[np.ndarray]] = field(default_factory=dict)

    def append(self, **arrays: np.ndarray) -> None:
        """Keep a cell's arrays."""
        for name, array in arrays.items():
            self.arrays.setdefault(name, []).append(array)

    def save(self, file: Path) -> None:
        """Write the file."""
        joined = {name: np.concatenate(parts) if name == "poses" else np.stack(parts) for name, parts in
                  self.arrays.items()}  # fmt: skip
        save(file, self.header, joined)


def camera_object(camera: Any) -> dict[str, Any]:
    """A camera as a header holds it."""
    return {name: getattr(camera, name) for name in CAMERA} | {"camera_to_world": camera.camera_to_world.tolist()}


def add_cell(
    found: Bounded, bounds: Any, poses: Any, number: int, cell: Any, width: float, renders: int, layers: bool,
    rng: np.random.Generator,
) -> None:  # fmt: skip
    """Bound a cell of the set with this number and pick its poses."""
    from both_ways import bounded_both_ways  # pyright: ignore[reportMissingImports]

    from ns_abstract.arithmetic.outward import outward
    from ns_abstract.geometry.tiles import assemble

    of_cell, lower, upper = bounded_both_ways(bounds, poses, cell, layers)
    if of_cell.layers is not None:
        values = assemble(of_cell.layers, poses.camera)
        ends = outward(np.ascontiguousarray(values[..., ::2]), np.ascontiguousarray(values[..., 1::2]))
        found.append(layer_lower=ends[0], layer_upper=ends[1])
    points = [cell.middle]
    if cell.lower != cell.upper:
        corners = np.asarray(cell.corners())
        points += [*corners[rng.permutation(len(corners))[: max(1, renders // 2)]]]
        points += [*cell.sample(max(0, renders - len(points)), rng)]
    found.append(
        lower=lower, upper=upper, poses=np.array([poses.pose(np.asarray(point)) for point in points], np.float32)
    )
    found.header["cells"].append(
        {"set": number, "width": width, "lower": cell.lower, "upper": cell.upper, "poses": len(points)}
    )


def start(scene_file: str, scene: Any, rules: Any, planted: bool, stiff: bool) -> Bounded:
    """A file without cells."""
    header = {
        "scene": scene_file, "name": scene.name, "mode": scene.rasterize_mode, "version": rules.version,
        "planted": planted, "stiff": stiff, "sets": [], "cells": [],
    }  # fmt: skip
    return Bounded(header)


def add_set(found: Bounded, name: str, poses: Any) -> int:
    """The number of a set of poses in the header."""
    from ns_abstract.perturbation.specification import perturbation_object

    following = None if poses.target_camera is None else camera_object(poses.target_camera)
    entry = {"name": name, "camera": camera_object(poses.camera), "following": following}
    found.header["sets"].append(entry | {"perturbation": perturbation_object(poses.perturbation)})
    return len(found.header["sets"]) - 1


def save_scene(folder: Path, name: str, scene: Any) -> str:
    """Write a scene's parameters; the file's name."""
    file = f"scene-{name}.npz"
    header = {"color_model": scene.color_model, "sh_degree": scene.sh_degree}
    save(folder / file, header, {key: getattr(scene, key) for key in PARAMETERS})
    return file


def plain(name: str) -> str:
    """A name for a file."""
    return "".join(letter if letter.isalnum() or letter in "._-" else "_" for letter in name)


def prepare(options: argparse.Namespace) -> int:
    """Write the files that `compare` takes."""
    from kernels_on_cpu import cell_about

    from ns_abstract.arithmetic.rounding import FLOAT32
    from ns_abstract.bench.sets import open_jobs, pose_set, splat_of
    from ns_abstract.bench.stiff_cases import all_cases
    from ns_abstract.methods.splat.activate import activate
    from ns_abstract.methods.splat.bounds import SplatBounds
    from ns_abstract.methods.splat.constants import VERSIONS

    torch.set_num_threads(1)
    folder: Path = options.output_dir
    rules_of = {version: VERSIONS[version] for version in options.versions}
    if options.planted:
        rules_of = {version: replace(rules, alpha_max=0.98) for version, rules in rules_of.items()}
    mark = "-planted" if options.planted else ""

    def done(found: Bounded, began: float, name: str) -> None:
        found.save(folder / f"cells-{found.header['version']}-{name}{mark}.npz")
        took, count = time.perf_counter() - began, len(found.header["cells"])
        print(f"{found.header['version']} {name}: {count} cells, {took:.1f} s", flush=True)

    for job in open_jobs(tuple(options.load_config), None, options.downscale_factor) if options.load_config else ():
        stored = splat_of(job).scene
        # a run is named by the folder that its method's folder is in
        run = plain(job.settings.load_config.resolve().parents[2].name)
        file = save_scene(folder, run, stored)
        for mode in options.modes:
            scene = replace(stored, rasterize_mode=mode, name=run)
            for rules in rules_of.values():
                began, rng = time.perf_counter(), np.random.default_rng(options.seed)
                found = start(file, scene, rules, options.planted, stiff=False)
                bounds = SplatBounds(activate(scene, rules), rules, FLOAT32)
                for name in options.sets:
                    poses = pose_set(job, name, options.frame)
                    number = add_set(found, name, poses)
                    for width in options.widths:
                        # more of the cells of one pose, since each is but one render
                        count = options.points if width == 0.0 else options.cells
                        for values in poses.box.sample(count, rng):
                            cell = cell_about(poses.box, values, width)
                            add_cell(found, bounds, poses, number, cell, width, options.poses, options.layers, rng)
                done(found, began, f"{mode}-{run}")
    for case in all_cases() if options.stiff else ():
        poses, scene = case.pose_set(), replace(case.scene, name=case.name)
        file = save_scene(folder, f"stiff-{plain(case.name)}", scene)
        for rules in rules_of.values():
            began, rng = time.perf_counter(), np.random.default_rng(options.seed)
            found = start(file, scene, rules, options.planted, stiff=True)
            bounds = SplatBounds(activate(scene, rules), rules, FLOAT32)
            number = add_set(found, "its own", poses)
            for width in options.widths:
                cell = cell_about(poses.box, poses.box.middle, width)
                add_cell(found, bounds, poses, number, cell, width, options.poses, options.layers, rng)
            done(found, began, f"stiff-{plain(case.name)}")
    return 0


# --- Rendering -------------------------------------------------------------------------------------------------------


class Renderer(Protocol):
    """Renders a scene."""

    def images(self, camera: dict[str, Any], poses: np.ndarray) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Colours [n, H, W, 3], and accumulation and expected depth [n, H, W, 2], of float32 poses [n, 3, 4]."""
        ...


class CudaRenderer:
    """A scene on the GPU, rendered by the installed gsplat as Splatfacto calls it.

    Args:
        header, arrays: The scene's file.
        mode: "classic" or "antialiased".
        device: Where to render.
    """

    def __init__(self, header: dict[str, Any], arrays: dict[str, np.ndarray], mode: str, device: str = "cuda") -> None:
        stored = {name: torch.from_numpy(np.ascontiguousarray(arrays[name])).to(device) for name in PARAMETERS}
        self.device, self.mode = device, mode
        self.means, self.quats = stored["means"], stored["quats"]
        self.scales = torch.exp(stored["log_scales"])
        self.opacities = torch.sigmoid(stored["opacity_logits"][:, None]).squeeze(-1)
        plain_colors = header["color_model"] == "sigmoid"
        self.colors = torch.sigmoid(stored["sh"]).squeeze(1) if plain_colors else stored["sh"]
        self.degree = None if plain_colors else header["sh_degree"]
        self.background = stored["background"]

    @torch.no_grad()
    def images(self, camera: dict[str, Any], poses: np.ndarray) -> tuple[torch.Tensor, torch.Tensor | None]:
        """See `Renderer`."""
        from gsplat import rasterization  # pyright: ignore[reportMissingImports, reportAttributeAccessIssue]

        pose = torch.from_numpy(np.ascontiguousarray(poses, np.float32)).to(self.device)
        rotation = pose[:, :3, :3] * torch.tensor([[[1, -1, -1]]], device=pose.device, dtype=pose.dtype)
        inverse = rotation.transpose(1, 2)
        view = torch.zeros(len(pose), 4, 4, device=pose.device, dtype=pose.dtype)
        view[:, 3, 3] = 1.0
        view[:, :3, :3] = inverse
        view[:, :3, 3:4] = -torch.bmm(inverse, pose[:, :3, 3:4])
        fx, fy, cx, cy = (camera[name] for name in CAMERA[:4])
        intrinsics = torch.tensor([[[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]], dtype=pose.dtype).to(pose.device)
        render, alpha, _ = rasterization(
            means=self.means,
            quats=self.quats,
            scales=self.scales,
            opacities=self.opacities,
            colors=self.colors,
            viewmats=view,
            Ks=intrinsics.expand(len(pose), 3, 3).contiguous(),
            width=camera["width"],
            height=camera["height"],
            packed=False,
            near_plane=0.01,
            far_plane=1e10,
            render_mode="RGB+ED",
            sh_degree=self.degree,
            sparse_grad=False,
            absgrad=False,
            rasterize_mode=self.mode,
        )
        colors = torch.clamp(render[..., :3] + (1 - alpha) * self.background, 0.0, 1.0)
        return colors, torch.cat([alpha, render[..., 3:4]], dim=-1)


# --- Comparing -------------------------------------------------------------------------------------------------------


@dataclass
class Tally:
    """What was compared of one file.

    Attributes:
        renders, searched: Renders; those of poses that were searched.
        comparisons, outside: Numbers compared, and those outside.
        excess: The largest distance by which one is outside.
        gaps: Mean widths of the bounds of cells of width zero.
        used, used_elsewhere: See the module; the largest, of cells of width zero, and of others.
        mostly: How much 99% of the colours of a render use at most, by render of a cell of width zero.
        worst: Where most was outside: cell, pose, pixel, values.
        error: What stopped the file.
    """

    renders: int = 0
    searched: int = 0
    comparisons: int = 0
    outside: int = 0
    excess: float = 0.0
    gaps: list[float] = field(default_factory=list)
    used: float = 0.0
    used_elsewhere: float = 0.0
    mostly: list[float] = field(default_factory=list)
    worst: dict[str, Any] | None = None
    error: str | None = None


class Cells:
    """The cells of one file, on the device.

    Args:
        file: Written by `prepare`.
        renderer: The scene's.
        device: Where the bounds are compared.
    """

    def __init__(self, file: Path, header: dict[str, Any], arrays: dict[str, np.ndarray], renderer: Renderer,
                 device: str) -> None:  # fmt: skip
        self.name, self.header, self.renderer = file.stem, header, renderer
        self.poses = np.split(arrays["poses"], np.cumsum([cell["poses"] for cell in header["cells"]])[:-1])
        self.bounds = [torch.from_numpy(arrays[name]).to(device) for name in ("lower", "upper")]
        self.layers = None
        if "layer_lower" in arrays:
            self.layers = [torch.from_numpy(arrays[name]).to(device) for name in ("layer_lower", "layer_upper")]
        self.tally = Tally()
        self.kept: dict[int, list[tuple[float, np.ndarray]]] = {}
        for number, cell in enumerate(header["cells"]):
            if cell["width"] == 0.0:
                gap = (self.bounds[1][number].double() - self.bounds[0][number].double()).norm(dim=-1)
                self.tally.gaps.append(float(gap.mean()))

    def compare(self, number: int, poses: np.ndarray) -> np.ndarray:
        """Render poses [n, 3, 4] of a cell and compare; how much of the bounds each used [n]."""
        cell, tally = self.header["cells"][number], self.tally
        colors, layers = self.renderer.images(self.header["sets"][cell["set"]]["camera"], poses)
        lower, upper = (bound[number] for bound in self.bounds)
        parts = [(colors, lower, upper, torch.ones_like(colors, dtype=torch.bool))]
        if self.layers is not None and layers is not None:
            drawn = torch.ones_like(layers, dtype=torch.bool)
            # what Splatfacto puts where nothing is drawn is not gsplat's depth
            drawn[..., 1] = layers[..., 0] > 0
            parts.append((layers, self.layers[0][number], self.layers[1][number], drawn))
        rows = []
        for values, low, high, drawn in parts:
            # a NaN is outside
            outside = drawn & ~((low <= values) & (values <= high))
            beyond = torch.maximum(low.double() - values.double(), values.double() - high.double())
            beyond = torch.where(outside, beyond, 0.0).nan_to_num(nan=math.inf)
            rows.append(torch.stack([outside.flatten(1).sum(1), drawn.flatten(1).sum(1), beyond.flatten(1).amax(1)], 1))
        half = 0.5 * (upper.double() - lower.double())
        # a colour that is clamped is at its bound for that alone
        said = (half >= LEAST_HALF) & (colors > 0.0) & (colors < 1.0)
        share = torch.where(said, (colors.double() - lower.double() - half).abs() / half, 0.0)
        used = share.flatten(1).amax(dim=1)
        found = torch.cat([torch.cat(rows, dim=1).double(), used[:, None]], dim=1).cpu().numpy()
        tally.renders += len(poses)
        # by render and part: how many are outside, how many were compared, the largest excess
        outside, compared, excess = np.moveaxis(found[:, :-1].reshape(len(found), -1, 3), 2, 0)
        tally.outside += int(outside.sum())
        tally.comparisons += int(compared.sum())
        if outside.any() and (tally.worst is None or excess.max() > tally.excess):
            render, part = np.unravel_index(int(excess.argmax()), excess.shape)
            tally.worst = self._place(number, poses[render], [values[render] for values, *_ in parts], parts, int(part))
        tally.excess = max(tally.excess, float(excess.max()))
        if cell["width"] == 0.0:
            tally.used = max(tally.used, float(found[:, -1].max()))
            pairs = zip(share, said, strict=True)
            tally.mostly += [float(torch.quantile(few[those], 0.99)) for few, those in pairs if those.any()]
        else:
            tally.used_elsewhere = max(tally.used_elsewhere, float(found[:, -1].max()))
        return found[:, -1]

    def _place(self, number: int, pose: np.ndarray, values: list[torch.Tensor], parts: Sequence[Any],
               part: int) -> dict[str, Any]:  # fmt: skip
        """The number that is farthest outside, of the colours (part 0) or the layers (part 1)."""
        value = values[part].double().cpu().numpy()
        low, high = (bound.double().cpu().numpy() for bound in parts[part][1:3])
        beyond = np.nan_to_num(np.maximum(low - value, value - high), nan=math.inf)
        if part == 1:
            beyond[..., 1] = np.where(value[..., 0] > 0, beyond[..., 1], -math.inf)
        at = np.unravel_index(int(beyond.argmax()), beyond.shape)
        cell = self.header["cells"][number]
        return {
            "file": self.name, "of": ("colour", "layer")[part], "cell": number, "set": cell["set"],
            "width": cell["width"], "pixel": [int(i) for i in at], "value": float(value[at]), "lower": float(low[at]),
            "upper": float(high[at]), "pose": pose.tolist(),
        }  # fmt: skip

    def prepared(self) -> None:
        """Compare what was prepared, one pose at a time as Splatfacto renders."""
        for number, poses in enumerate(self.poses):
            for pose in poses:
                self.compare(number, pose[None])

    def search(self, number: int, poses_of: Any, rng: np.random.Generator) -> None:
        """Compare one batch of a cell: new poses, and poses beside those that used most of the bounds so far."""
        cell = self.header["cells"][number]
        low, high = np.array(cell["lower"]), np.array(cell["upper"])
        kept = self.kept.setdefault(number, [])
        points = [rng.uniform(low, high) for _ in range(AT_ONCE)]
        for k in range(AT_ONCE // 2 if kept else 0):
            step = (high - low) * 10.0 ** rng.uniform(-5.0, -0.5) * rng.normal(size=len(low))
            points[k] = np.clip(kept[int(rng.integers(len(kept)))][1] + step, low, high)
        # a corner, in some of the parameters
        points[-1] = np.where(rng.random(len(low)) < 0.7, np.where(rng.random(len(low)) < 0.5, low, high), points[-1])
        used = self.compare(number, np.array([poses_of.pose(point) for point in points], np.float32))
        self.tally.searched += len(points)
        kept += zip(used.tolist(), points, strict=True)
        kept.sort(key=lambda entry: -entry[0])
        del kept[KEPT:]

    def row(self) -> dict[str, Any]:
        """The figures of the table."""
        tally, header = self.tally, self.header
        return {
            "scene": header["name"] + (" (planted)" if header["planted"] else ""), "mode": header["mode"],
            "cells": len(header["cells"]), "renders": tally.renders, "searched": tally.searched,
            "comparisons": tally.comparisons, "outside": tally.outside, "excess": tally.excess,
            "gap": float(np.mean(tally.gaps)) if tally.gaps else math.nan, "used": tally.used,
            "used by 99%": float(np.mean(tally.mostly)) if tally.mostly else math.nan,
            "used elsewhere": tally.used_elsewhere,
        }  # fmt: skip


def sets_of_poses(header: dict[str, Any]) -> list[Any]:
    """The sets of a file, as this package has them."""
    from ns_abstract.geometry.camera_path import PinholeCamera
    from ns_abstract.geometry.poses import PoseBox
    from ns_abstract.perturbation.specification import parse_perturbation

    def camera(entry: dict[str, Any] | None) -> Any:
        if entry is None:
            return None
        return PinholeCamera(np.array(entry["camera_to_world"]), *(entry[name] for name in CAMERA))

    return [
        PoseBox.around(camera(entry["camera"]), parse_perturbation(entry["perturbation"]), camera(entry["following"]))
        for entry in header["sets"]
    ]


def attempt(cells: Cells, work: Callable[[], None]) -> bool:
    """Whether a file could be worked on; what stops it is printed and kept."""
    if cells.tally.error is not None:
        return False
    try:
        work()
    except Exception as error:
        traceback.print_exc()
        cells.tally.error = f"{type(error).__name__}: {error}"
        return False
    return True


def searching(group: list[Cells], until: float) -> None:
    """Go round the cells that have a width until the time is over."""
    try:
        import ns_abstract.geometry.poses  # noqa: F401
    except ImportError as error:
        print(f"no poses are searched: {error}")
        return
    jobs: list[tuple[Cells, int, Any]] = []
    for cells in group:
        of_sets: list[Any] = []
        if attempt(cells, lambda cells=cells, of_sets=of_sets: of_sets.extend(sets_of_poses(cells.header))):
            wide = [k for k, cell in enumerate(cells.header["cells"]) if cell["lower"] != cell["upper"]]
            jobs += [(cells, k, of_sets[cells.header["cells"][k]["set"]]) for k in wide]
    rng = np.random.default_rng(0)
    while jobs and time.perf_counter() < until:
        for k in rng.permutation(len(jobs)):
            cells, number, poses = jobs[k]
            if time.perf_counter() >= until:
                break
            attempt(cells, lambda c=cells, n=number, p=poses: c.search(n, p, rng))
        jobs = [job for job in jobs if job[0].tally.error is None]


def loaded(folder: Path, version: str, renderer_of: Callable[..., Renderer], device: str) -> Iterator[Cells]:
    """The files of a version; scenes are read once."""
    scenes: dict[str, Any] = {}
    for file in sorted(folder.glob(f"cells-{version}-*.npz")):
        header, arrays = read(file)
        if header["scene"] not in scenes:
            scenes[header["scene"]] = read(folder / header["scene"])
        yield Cells(file, header, arrays, renderer_of(*scenes[header["scene"]], header["mode"], device), device)


def compare(
    folder: Path, version: str, seconds: float, renderer_of: Callable[..., Renderer] = CudaRenderer,
    device: str = "cuda",
) -> list[Cells]:  # fmt: skip
    """Compare everything of a version of gsplat.

    Args:
        folder: Written by `prepare`.
        version: gsplat's.
        seconds: Go on searching until so many have passed.
        renderer_of: Makes the renderer of a scene's header, arrays, mode and device.
        device: Where bounds and renders are compared.
    """
    began = time.perf_counter()
    every = list(loaded(folder, version, renderer_of, device))
    runs, stiff = ([cells for cells in every if cells.header["stiff"] == kind] for kind in (False, True))
    for group, until in ((runs, FIRST_PART if stiff else 1.0), (stiff, 1.0)):
        for cells in group:
            attempt(cells, cells.prepared)
        searching([cells for cells in group if not cells.header["planted"]], began + until * seconds)
    return every


def failed(cells: Cells) -> bool:
    """Whether something is outside, or, where a fault is planted, nothing is; or the file could not be compared."""
    found = cells.tally.outside > 0
    return cells.tally.error is not None or (not found if cells.header["planted"] else found)


def together(group: list[Cells]) -> dict[str, Any]:
    """One row for stiff cases."""
    rows = [cells.row() for cells in group]
    sums = ("cells", "renders", "searched", "comparisons", "outside")
    found: dict[str, Any] = {"scene": f"{len(group)} stiff cases", "mode": "both"}
    found |= {name: sum(row[name] for row in rows) for name in sums}
    found["excess"] = max(row["excess"] for row in rows)
    for name in ("gap", "used", "used by 99%", "used elsewhere"):
        values = [row[name] for row in rows]
        found[name] = max(values) if name in ("used", "used elsewhere") else float(np.nanmean(values))
    return found


def report(every: list[Cells], about: dict[str, str], folder: Path) -> None:
    """Print the table and write all of it as JSON."""
    stiff = [cells for cells in every if cells.header["stiff"]]
    rows = [cells.row() for cells in every if not cells.header["stiff"]]
    rows += [together(stiff)] if stiff else []
    print(", ".join(f"{name} {value}" for name, value in about.items()))
    names = list(rows[0])
    for row in ({name: name for name in names}, dict.fromkeys(names, "---"), *rows):
        texts = (f"{value:.4g}" if isinstance(value, float) else str(value) for value in row.values())
        print("| " + " | ".join(texts) + " |")
    for cells in every:
        if failed(cells) or cells.tally.error:
            print(f"FAILED {cells.name}: {json.dumps(cells.tally.error or cells.tally.worst)}")
    folder.mkdir(parents=True, exist_ok=True)
    full = [
        cells.row() | {"file": cells.name, "worst": cells.tally.worst, "error": cells.tally.error} for cells in every
    ]
    (folder / f"cuda-{about['gsplat']}.json").write_text(json.dumps({"about": about, "files": full}, indent=1))


def compare_command(options: argparse.Namespace) -> int:
    """Compare on this machine's GPU; 1 if something is as it should not be."""
    if not torch.cuda.is_available():
        print("error: no CUDA GPU is available; nothing was compared", file=sys.stderr)
        return 2
    import gsplat  # pyright: ignore[reportMissingImports]

    version: str = gsplat.__version__.split("+")[0]
    about = {
        "GPU": torch.cuda.get_device_name(), "torch": torch.__version__, "CUDA": str(torch.version.cuda),
        "gsplat": version,
    }  # fmt: skip
    every = compare(options.cells, version, options.seconds)
    if not every:
        print(f"error: no cells of gsplat {version} in {options.cells}", file=sys.stderr)
        return 2
    report(every, about, options.output_dir)
    total = sum(cells.tally.comparisons for cells in every)
    outside = sum(cells.tally.outside for cells in every if not cells.header["planted"])
    print(f"gsplat {version}: {total:,} comparisons, {outside:,} outside, planted faults aside")
    return int(any(map(failed, every)))


def main(arguments: Sequence[str] | None = None) -> int:
    """Prepare or compare."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    commands = parser.add_subparsers(required=True)
    preparing = commands.add_parser("prepare", help="bound cells and write them, without a GPU")
    preparing.add_argument("load_config", type=Path, nargs="*")
    preparing.add_argument("--stiff", action="store_true", help="the stiff cases, too")
    preparing.add_argument("--versions", nargs="+", default=["1.4.0", "1.5.3", "1.6.0"])
    preparing.add_argument("--sets", nargs="+", default=["x", "yaw", "roll", "six", "orbit"])
    preparing.add_argument("--modes", nargs="+", default=["classic", "antialiased"])
    preparing.add_argument("--widths", nargs="+", type=float, default=[0.0, 1e-3, 1.0])
    preparing.add_argument("--points", type=int, default=4, help="cells of width zero by set")
    preparing.add_argument("--cells", type=int, default=1, help="other cells by set and width")
    preparing.add_argument("--poses", type=int, default=10, help="prepared by cell")
    preparing.add_argument("--frame", type=int, default=0)
    preparing.add_argument("--downscale-factor", type=float, default=1.0)
    preparing.add_argument("--layers", action="store_true", help="accumulation and expected depth, too")
    preparing.add_argument("--planted", action="store_true")
    preparing.add_argument("--seed", type=int, default=0)
    preparing.add_argument("--output-dir", type=Path, default=Path("cells"))
    preparing.set_defaults(command=prepare)
    comparing = commands.add_parser("compare", help="render on a GPU what was prepared")
    comparing.add_argument("cells", type=Path)
    comparing.add_argument("--seconds", type=float, default=60.0)
    comparing.add_argument("--output-dir", type=Path, default=Path("bench"))
    comparing.set_defaults(command=compare_command)
    options = parser.parse_args(arguments)
    return options.command(options)


if __name__ == "__main__":
    sys.exit(main())
