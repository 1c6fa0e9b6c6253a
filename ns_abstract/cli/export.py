"""``ns-abstract-export``: abstract images and scenes in other programs' formats."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from ns_abstract.cli.common import DONE, run
from ns_abstract.errors import InputError

Picture = Literal["lower", "upper", "gap", "witness", "image"]


@dataclass
class Npz:
    """All frames of a path in one npz: lower, upper, witness_lower, witness_upper, image [K, H, W, 3]."""

    input_dir: Path
    """Folder that ns-abstract-render wrote."""
    output_filename: Path
    """The npz file; replaced if it exists."""


@dataclass
class Png:
    """Plain pictures of every frame. Lower bounds are rounded down to 8 bits, upper bounds up."""

    input_dir: Path
    """Folder that ns-abstract-render wrote."""
    output_dir: Path
    """Folder for the pictures; made if missing."""
    pictures: tuple[Picture, ...] = ("lower", "upper", "gap", "image")
    """lower, upper, gap (heat map), witness (gap of real renders, same scale), image (one render)."""


@dataclass
class Mp4:
    """A video of a path, pictures side by side."""

    input_dir: Path
    """Folder that ns-abstract-render wrote."""
    output_filename: Path
    """The mp4 file; replaced if it exists."""
    pictures: tuple[Picture, ...] = ("lower", "upper", "gap", "image")
    """lower, upper, gap (heat map), witness (gap of real renders, same scale), image (one render)."""
    fps: float = 24.0
    """Frames per second."""


@dataclass
class Ply:
    """The Gaussians of a run as a standard 3DGS .ply, in the run's normalised frame."""

    load_config: Path
    """config.yml of a Splatfacto run, or a .ply."""
    output_filename: Path
    """The .ply file; replaced if it exists."""


Command = (
    Annotated[Npz, tyro.conf.subcommand("npz")]
    | Annotated[Png, tyro.conf.subcommand("png")]
    | Annotated[Mp4, tyro.conf.subcommand("mp4")]
    | Annotated[Ply, tyro.conf.subcommand("ply")]
)


def export(options: Npz | Png | Mp4 | Ply) -> int:
    """Run the command; returns the exit code.

    Raises:
        InputError: A file or an option cannot be used.
    """
    target = options.output_dir if isinstance(options, Png) else options.output_filename
    try:
        if not isinstance(options, Png):
            target.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(options, Ply):
            from ns_abstract.methods.splat.load import load_scene
            from ns_abstract.methods.splat.ply import write_ply

            notes = [f"not in the file: {sentence}" for sentence in write_ply(load_scene(options.load_config), target)]
        else:
            notes = _path(options)
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror})", file=target, fix="choose another place") from None
    for note in notes:
        print(note, file=sys.stderr)
    print(target)
    return DONE


def _path(options: Npz | Png | Mp4) -> list[str]:
    from ns_abstract.report.export import Results, write_archive, write_pictures, write_video

    results = Results(options.input_dir)
    if isinstance(options, Npz):
        write_archive(results, options.output_filename)
    elif not options.pictures:
        raise InputError("none given", field="--pictures", fix="name at least one")
    elif isinstance(options, Png):
        write_pictures(results, options.output_dir, options.pictures)
    else:
        write_video(results, options.output_filename, options.pictures, options.fps)
    if results.unbounded:
        return [f"no bounds but [0, 1] in frames {', '.join(map(str, results.unbounded))}"]
    return []


def main() -> None:
    """Entry point of the console script."""
    run(export, lambda: tyro.cli(Command, prog="ns-abstract-export"))  # pyright: ignore[reportCallIssue, reportArgumentType]


if __name__ == "__main__":
    main()
