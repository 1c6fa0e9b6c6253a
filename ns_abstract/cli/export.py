"""``ns-abstract-export``: abstract images and scenes in other programs' formats."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union

import tyro

from ns_abstract.cli.common import DONE, command, run
from ns_abstract.cli.sets import GivenSet, Overrides, ProgramOptions, SceneOverrides, given_set
from ns_abstract.io.errors import InputError, visible

if TYPE_CHECKING:
    from ns_abstract.report.export import Results

#: Along each axis of an occupancy grid.
_MOST_VOXELS = 512
Picture = Literal["lower", "upper", "gap", "witness", "image"]


@dataclass
class _ResultsFile:
    input_dir: Path
    """Folder that ns-abstract-render wrote."""
    output_filename: Path
    """The file; replaced if it exists."""


@dataclass
class _ResultsFolder:
    input_dir: Path
    """Folder that ns-abstract-render wrote."""
    output_dir: Path
    """Folder for the files; made if missing."""


@dataclass(kw_only=True)
class _Pictures:
    pictures: tuple[Picture, ...] = ("lower", "upper", "gap", "image")
    """lower, upper, gap (heat map), witness (gap of real renders, same scale), image (one render)."""


@dataclass
class Npz(_ResultsFile):
    """All frames of a path in one npz: lower, upper, witness_lower, witness_upper, image [K, H, W, 3]."""


@dataclass
class Png(_Pictures, _ResultsFolder):
    """Plain pictures of every frame. Lower bounds are rounded down to 8 bits, upper bounds up."""


@dataclass
class Mp4(_Pictures, _ResultsFile):
    """A video of a path, pictures side by side."""

    fps: float = 24.0
    """Frames per second."""
    panels: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Labels above the pictures, the frame's figures below; small pictures enlarged."""


@dataclass
class Ply:
    """The Gaussians of a run as a standard 3DGS .ply, in the run's normalised frame."""

    load_config: Path
    """config.yml of a Splatfacto run, or a scene file (.ply, .sog, .spz, .splat, .glb, .pt)."""
    output_filename: Path
    """The .ply file; replaced if it exists."""
    overrides: SceneOverrides = field(default_factory=Overrides)


@dataclass
class ExportVnnLib(GivenSet):
    """Abstract images, a network and a property as ONNX and VNN-LIB, for other verifiers.

    Cuts the set of poses of a frame into boxes and writes for each NAME.onnx, whose input is the box's parameters in
    [-1, 1] and the slack of every number of the image, and NAME.vnnlib ("unsat": the property holds on every image
    of the box). Beside them instances.csv, as verifiers of VNN-COMP read it, boxes.json, the boxes, and origins.json:
    scene, pose, property and picture of each. With several networks and --append a folder becomes a benchmark.
    """

    load_config: Path
    """config.yml of a Splatfacto run, or a scene file (.ply, .sog, .spz, .splat, .glb, .pt)."""
    camera_path_filename: Path
    """Camera path as Nerfstudio's viewer writes it."""
    model: tuple[Path, ...]
    """Networks: .onnx."""
    property: tuple[Path, ...]
    """What is to hold (JSON): classification or vnnlib, with the preprocessing. One for all networks, or one each."""
    output_dir: Path
    """Folder for the files; made if missing."""
    perturbation_filename: Path | None = field(default=None, kw_only=True)
    """Set of poses (JSON). Default: the key "perturbation" of the camera path, or its poses alone."""
    frames: tuple[int, ...] | None = None
    """Entries of the camera path, counted from 0. Default: all."""
    parts: tuple[int, ...] = ()
    """Boxes along each parameter of the set. Default: 1."""
    renderer: Literal["gsplat", "paper"] = "gsplat"
    """gsplat: what Nerfstudio shows. paper: Algorithm 1 of "Abstract Rendering" (no thresholds, RGB)."""
    arithmetic: Literal["float32", "real"] = "float32"
    """float32: images of every float32 evaluation. real: the real-number renderer and its float64 evaluation."""
    gsplat_version: Literal["1.4.0", "1.5.3", "1.6.0"] | None = None
    """Whose rules are bounded. Default: 1.4.0, which nerfstudio 1.1.5 asks for."""
    picture: Literal["float", "8-bit"] = "float"
    """float: the renderer's floats. 8-bit: these rounded to multiples of 1/255."""
    form: Literal["slice", "gemm"] = "slice"
    """slice: small files. gemm: no operators in front but Gemm and Reshape, for verifiers that know little."""
    timeout: int = 300
    """Seconds by box in instances.csv."""
    vnnlib_version: Literal["1.0", "2.0"] = "1.0"
    """Version of VNN-LIB. 2.0 asks about float32."""
    prefix: str = ""
    """What names of instances begin with, such as the scene's name."""
    append: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Keep the instances that the folder holds."""
    pictures: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Write the picture at the middle of every box to pictures/."""
    overrides: SceneOverrides = field(default_factory=Overrides)


@dataclass
class Occupancy:
    """Where a NeRF's field is not empty, by sampling it: a grid for the option --occupancy-grid.

    A proposal, not a proof: with the option, the grid is declared to be part of the scene. The npz holds occupied
    [X, Y, Z] bool and aabb [2, 3], corners in the run's normalised frame.
    """

    load_config: Path
    """config.yml of a vanilla-nerf run."""
    output_filename: Path
    """The npz file; replaced if it exists."""
    aabb: tuple[float, float, float, float, float, float] = (-1.5, -1.5, -1.5, 1.5, 1.5, 1.5)
    """Least x, y, z, then largest x, y, z of the grid, normalised units."""
    resolution: int = 128
    """Voxels along each axis."""
    threshold: float = 0.1
    """Densities above it, per normalised unit, are kept, with a margin of one voxel."""
    overrides: SceneOverrides = field(default_factory=Overrides)


@dataclass
class Exr(_ResultsFolder):
    """OpenEXR pictures of every frame: parts lower, upper, witness_lower, witness_upper and image, float32."""


@dataclass
class Safetensors(_ResultsFolder):
    """Bounds and linear sets of every frame as safetensors, of ns-abstract-render --save-cells."""


@dataclass
class Statement(_ResultsFile):
    """A certificate as an in-toto statement (JSON), which other tools sign."""

    input_dir: Path
    """Folder that ns-abstract-certify or ns-abstract-reach wrote."""


@dataclass(kw_only=True)
class _SceneFile:
    load_config: Path | None = None
    """config.yml of a Splatfacto run or a scene file (.ply, .sog, .spz, .splat, .glb, .pt), for its Gaussians."""
    overrides: SceneOverrides = field(default_factory=Overrides)


@dataclass
class Rrd(_SceneFile, _ResultsFile):
    """A Rerun recording (.rrd): bounds and figures frame by frame, and with a path its cameras in the scene."""

    camera_path_filename: Path | None = None
    """The path that was rendered, for the cameras."""


@dataclass
class Viser(_SceneFile, _ResultsFile):
    """A recording of viser (.viser): the gap of every frame at its camera, in the scene."""

    camera_path_filename: Path
    """The path that was rendered."""
    seconds: float = 0.5
    """Of each frame."""


@dataclass
class Schemas:
    """JSON Schemas of the perturbation file, the property and the loop, for editors that check files by "$schema"."""

    output_dir: Path
    """Folder for the schemas; made if missing."""


_ABOUT = "Write results of ns-abstract-render, scenes and properties in other programs' formats."
_PARTS = {
    "npz": Npz, "png": Png, "mp4": Mp4, "exr": Exr, "safetensors": Safetensors, "rrd": Rrd, "viser": Viser,
    "statement": Statement, "ply": Ply, "vnnlib": ExportVnnLib, "occupancy": Occupancy, "schemas": Schemas,
}  # fmt: skip
Command = Union[tuple(Annotated[kind, tyro.conf.subcommand(name)] for name, kind in _PARTS.items())]  # noqa: UP007


def export(options: Any) -> int:
    target = getattr(options, "output_dir", None) or options.output_filename
    try:
        if hasattr(options, "output_filename"):
            target.parent.mkdir(parents=True, exist_ok=True)
        notes = _WRITERS.get(type(options), _path)(options)
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror})", file=target, fix="choose another place") from None
    for note in notes:
        print(visible(note), file=sys.stderr)
    print(visible(str(target)))
    return DONE


def _ply(options: Ply) -> list[str]:
    from ns_abstract.methods.splat.load import load_scene
    from ns_abstract.methods.splat.write import write_ply

    scene = load_scene(options.load_config, options.overrides)
    notes = [f"left out: {count:,} Gaussians with {reason}" for reason, count in scene.dropped.items()]
    return notes + [f"not in the file: {sentence}" for sentence in write_ply(scene, options.output_filename)]


def _statement(options: Statement) -> list[str]:
    from ns_abstract.api.statement import statement
    from ns_abstract.io.atomic import write_json

    content, notes = statement(options.input_dir)
    write_json(options.output_filename, content)
    return notes


def _schemas(options: Schemas) -> list[str]:
    from ns_abstract.api.schemas import schema_files
    from ns_abstract.io.atomic import write_atomic

    options.output_dir.mkdir(parents=True, exist_ok=True)
    for name, content in schema_files().items():
        write_atomic(options.output_dir / name, lambda stream, content=content: stream.write(content))
    return []


def _occupancy(options: Occupancy) -> list[str]:
    from rich.progress import Progress

    from ns_abstract.methods.load import load_any
    from ns_abstract.methods.nerf.field import Field
    from ns_abstract.methods.nerf.occupancy import sample_grid
    from ns_abstract.methods.nerf.scene import NerfScene
    from ns_abstract.report.progress import plain_console

    lower, upper = options.aabb[:3], options.aabb[3:]
    if not all(-float("inf") < low < high < float("inf") for low, high in zip(lower, upper, strict=True)):
        raise InputError(f"found {options.aabb}", field="--aabb", fix="give least x y z, then largest x y z")
    if not 1 <= options.resolution <= _MOST_VOXELS:
        raise InputError(f"found {options.resolution}", field="--resolution", fix=f"give 1 to {_MOST_VOXELS}")
    if not 0.0 <= options.threshold < float("inf"):
        raise InputError(f"found {options.threshold}", field="--threshold", fix="give 0 or more")
    scene = load_any(options.load_config, options.overrides)
    if not isinstance(scene, NerfScene):
        raise InputError("is no run of vanilla-nerf", file=options.load_config, fix="give a run of vanilla-nerf")
    density = Field(scene.fine).density
    with Progress(console=plain_console()) as bar:
        task = bar.add_task("sampling the field", total=1.0)
        grid = sample_grid(
            lambda points: density(points)[0], lower, upper, options.resolution, options.threshold,
            lambda share: bar.update(task, completed=share),
        )  # fmt: skip
    if not grid.occupied.any():
        raise InputError("no density found", field="--threshold", fix="give a smaller one, or another --aabb")
    grid.write(options.output_filename)
    return [grid.describe()]


def _vnnlib(options: ExportVnnLib) -> list[str]:
    from ns_abstract.api.certification import CertifySettings, open_certification
    from ns_abstract.api.files import Settings
    from ns_abstract.api.job import check_frames
    from ns_abstract.api.verifier_instances import InstanceFolder

    if options.timeout < 1:
        raise InputError(f"found {options.timeout}", field="--timeout", fix="give a number of at least 1")
    if any(n < 1 for n in options.parts):
        raise InputError(f"found {min(options.parts)}", field="--parts", fix="give numbers of at least 1")
    if not re.fullmatch(r"[A-Za-z0-9_.-]{0,60}", options.prefix) or options.prefix.startswith("."):
        raise InputError(f"found {options.prefix[:80]}", field="--prefix", fix="give letters, digits and _ . -")
    if not options.model or len(options.property) not in (1, len(options.model)):
        problem = f"{len(options.property)} properties for {len(options.model)} networks"
        raise InputError(problem, field="--property", fix="give one for all networks, or one for each")
    names = [f"{model.stem}_" if len(options.model) > 1 else "" for model in options.model]
    if len(set(names)) < len(names):
        raise InputError("two networks of one name", field="--model", fix="rename one")
    folder = InstanceFolder(
        options.output_dir, options.timeout, options.form, options.vnnlib_version, options.prefix, options.pictures
    )
    if options.append:
        folder.keep_earlier()
    notes: list[str] = []
    properties = options.property * (1 if len(options.property) > 1 else len(options.model))
    files = Settings(
        options.load_config,
        options.camera_path_filename,
        options.perturbation_filename,
        arithmetic=options.arithmetic,
        given_set=given_set(options),
        program=ProgramOptions(options.renderer, options.gsplat_version),
        overrides=options.overrides,
    )
    for name, model, prop in zip(names, options.model, properties, strict=True):
        job = open_certification(CertifySettings(files, model, prop, picture=options.picture))
        for frame in check_frames(options.frames, job.job.frame_count):
            folder.add(job, frame, options.parts, name)
        notes += job.property.notes
    folder.write_lists()
    return list(dict.fromkeys(notes))


def _path(options: Npz | Png | Mp4 | Exr | Safetensors | Rrd | Viser) -> list[str]:
    from ns_abstract.report.export import Results, write_archive, write_pictures, write_video
    from ns_abstract.report.figures import frames_listed
    from ns_abstract.report.recordings import write_exr, write_safetensors

    results = Results(options.input_dir)
    if isinstance(options, Npz):
        write_archive(results, options.output_filename)
    elif isinstance(options, Exr):
        write_exr(results, options.output_dir)
    elif isinstance(options, Safetensors):
        write_safetensors(results, options.output_dir)
    elif isinstance(options, (Rrd, Viser)):
        _recording(options, results)
    elif not options.pictures:
        raise InputError("none given", field="--pictures", fix="name at least one")
    elif isinstance(options, Png):
        write_pictures(results, options.output_dir, options.pictures)
    else:
        write_video(results, options.output_filename, options.pictures, options.fps, options.panels)
    notes = [] if results.checked else ["no report.json beside the frames: nothing says whether they were changed"]
    if results.unbounded:
        notes.append(f"no bounds but [0, 1] in {frames_listed(results.unbounded)}")
    return notes


def _recording(options: Rrd | Viser, results: Results) -> None:
    from ns_abstract.geometry.camera_path import load_camera_path
    from ns_abstract.methods.splat.activate import SH_C0, activate
    from ns_abstract.methods.splat.constants import GSPLAT_1_4_0
    from ns_abstract.methods.splat.load import load_scene
    from ns_abstract.report.recordings import RecordedScene, write_rerun, write_viser

    scene, cameras = None, ()
    if options.load_config is not None:
        splats = activate(load_scene(options.load_config, options.overrides), GSPLAT_1_4_0)
        colors = splats.sh[:, 0] if splats.degree == 0 else SH_C0 * splats.sh[:, 0] + 0.5
        scene = RecordedScene(splats.means, splats.axes, colors.clip(0.0, 1.0), splats.opacity)
    if options.camera_path_filename is not None:
        cameras = load_camera_path(options.camera_path_filename).cameras
        if max(results.files) >= len(cameras):
            problem = f"has {len(cameras)} cameras, the results have a frame {max(results.files)}"
            raise InputError(problem, file=options.camera_path_filename, fix="give the path that was rendered")
    if isinstance(options, Rrd):
        write_rerun(results, cameras, scene, options.output_filename)
        return
    if not 0.01 <= options.seconds <= 3600.0:
        raise InputError(f"found {options.seconds}", field="--seconds", fix="give a number from 0.01 to 3600")
    write_viser(results, cameras, scene, options.output_filename, options.seconds)


#: What writes that is not of a path's frames.
_WRITERS: dict[type, Callable[[Any], list[str]]] = {
    Ply: _ply, Statement: _statement, Schemas: _schemas, Occupancy: _occupancy, ExportVnnLib: _vnnlib,
}  # fmt: skip


def main() -> None:
    run(export, command("ns-abstract-export", Command, _PARTS, _ABOUT))


if __name__ == "__main__":
    main()
