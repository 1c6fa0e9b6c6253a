"""Exports the abstract images of a whole path: as one archive, as plain pictures, or as a video."""

from __future__ import annotations

import importlib.util
import io
import json
import math
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ns_abstract.io.atomic import write_atomic
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import load_json
from ns_abstract.io.stamps import file_stamp
from ns_abstract.io.version import ADVISORY, computed_by, stale
from ns_abstract.refine.result import FrameResult, gap
from ns_abstract.report.figures import metrics, number, short_guarantee
from ns_abstract.report.files import IMAGES, frame_index, load_frame
from ns_abstract.report.picture import heat, to_bytes
from ns_abstract.report.record import frame_digests
from ns_abstract.report.run import sides

PICTURES = ("lower", "upper", "gap", "witness", "image")
_LABELS = {
    "lower": "lower bound", "upper": "upper bound", "gap": "gap", "witness": "gap of renders", "image": "one render",
}  # fmt: skip
#: Least width of a panel, room between panels, height of a line of text.
_PANEL_WIDTH, _PANEL_GAP, _PANEL_TEXT = 200, 6, 20
_REPORT_LIMIT = 2**30
_FIX_RESULTS = "give the folder that ns-abstract-render wrote"


class Results:
    """The frames that a command wrote to a folder.

    Raises:
        InputError: There are no frames, one is damaged or is not the one that was written, or their sizes differ.

    Attributes:
        checked: Whether report.json is there and its digests are those of all frames.
    """

    def __init__(self, folder: Path) -> None:
        try:
            files = {index: file for file in folder.iterdir() if (index := frame_index(file)) is not None}
        except OSError as error:
            raise InputError(
                f"cannot be listed ({error.strerror})", file=folder, field="--input-dir", fix=_FIX_RESULTS
            ) from None
        if not files:
            raise InputError("no frame_*.npz here", file=folder, field="--input-dir", fix=_FIX_RESULTS)
        self.files = dict(sorted(files.items()))
        report = folder / "report.json"
        self.checked = report.exists()
        if self.checked:
            digests = frame_digests(load_json(report, "report", limit=_REPORT_LIMIT))
            for file in self.files.values():
                if digests.get(file.name) != file_stamp(file)["sha256"]:
                    raise InputError(
                        "not as report.json knows it",
                        file=file,
                        fix="wait for the command that writes it, or bound it again with ns-abstract-render --resume",
                    )
        self.size: tuple[int, int] = (0, 0)
        self.largest = 0.0
        self.guarantees: set[str] = set()
        self.unbounded: list[int] = []
        self.parameters: list[list[dict[str, Any]]] = []
        for index, file in self.files.items():
            stored = load_frame(file, leaves=False)
            prints = stored.about.get("fingerprint")
            if problem := stale(prints if isinstance(prints, dict) else {}, computed_by()):
                raise InputError(
                    problem, file=file, fix=f"bound it again with ns-abstract-render, without --resume; {ADVISORY}"
                )
            result, size = stored.result, stored.result.lower.shape[:2]
            if self.size not in ((0, 0), size):
                raise InputError(
                    f"{size[1]} x {size[0]} pixels, the frames before {self.size[1]} x {self.size[0]}",
                    file=file,
                    fix="bound the whole path at one size",
                )
            self.size = size
            self.largest = max(self.largest, float(gap(result.lower, result.upper).max()))
            bounded = stored.about.get("scene", {}).get("bounded")
            self.guarantees.add(short_guarantee(str(stored.about.get("guarantee", "unknown")), bounded))
            if not result.bounded:
                self.unbounded.append(index)
            self.parameters.append(sides(result.box))

    def __iter__(self) -> Iterator[FrameResult]:
        """Yield the frames in order, each read when it is needed."""
        return (load_frame(file, leaves=False).result for file in self.files.values())


def picture(result: FrameResult, name: str, largest: float) -> np.ndarray:
    """Return one of `PICTURES` as [H, W, 3] uint8: bounds rounded outward, gaps on a scale up to ``largest``."""
    if name == "lower":
        return np.floor(result.lower.astype(np.float64) * 255.0).astype(np.uint8)
    if name == "upper":
        return np.ceil(result.upper.astype(np.float64) * 255.0).astype(np.uint8)
    if name == "gap":
        return heat(gap(result.lower, result.upper), largest)
    if name == "witness":
        return heat(gap(result.witness_lower, result.witness_upper), largest)
    return to_bytes(result.image)


def write_archive(results: Results, file: Path) -> None:
    """Write one npz: ``frames`` [K], the arrays of frame files as [K, H, W, 3] float32, and ``about`` (JSON text).

    Read it with ``np.load(file, allow_pickle=False)``.
    """
    shape = (len(results.files), *results.size, 3)
    about = {
        "format": "ns-abstract path",
        "version": 1,
        "guarantee": sorted(results.guarantees),
        "parameters": results.parameters,
        "unbounded": results.unbounded,
    }

    def write(stream: BinaryIO) -> None:
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for name, array in (("frames", np.array(list(results.files))), ("about", np.array(json.dumps(about)))):
                with archive.open(f"{name}.npy", "w") as member:
                    np.lib.format.write_array(member, array, allow_pickle=False)
            for name in IMAGES:
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    header = {"descr": "<f4", "fortran_order": False, "shape": shape}
                    np.lib.format.write_array_header_1_0(member, header)
                    for result in results:
                        member.write(np.ascontiguousarray(getattr(result, name), "<f4").tobytes())

    write_atomic(file, write)


def write_pictures(results: Results, folder: Path, names: Sequence[str]) -> list[Path]:
    """Write one PNG for every frame and name, such as ``lower_00000.png``, in whole pixels without labels."""
    from PIL import Image

    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for result in results:
        for name in names:
            file = folder / f"{name}_{result.index:05d}.png"
            image = Image.fromarray(picture(result, name, results.largest))
            write_atomic(file, lambda stream, image=image: image.save(stream, "png"))
            written.append(file)
    return written


def panels(result: FrameResult, names: Sequence[str], largest: float, text: str) -> np.ndarray:
    """Return the pictures ``names`` side by side, [h, w, 3] uint8, each under its label, with ``text`` below.

    Small pictures are enlarged by a whole factor.
    """
    from PIL import Image, ImageDraw

    times = max(1, -(-_PANEL_WIDTH // result.image.shape[1]))
    pictures = [picture(result, name, largest).repeat(times, axis=0).repeat(times, axis=1) for name in names]
    height, width = pictures[0].shape[:2]
    step = width + _PANEL_GAP
    whole = Image.new("RGB", (step * len(names) - _PANEL_GAP, height + 2 * _PANEL_TEXT), "white")
    pen = ImageDraw.Draw(whole)
    for k, (name, image) in enumerate(zip(names, pictures, strict=True)):
        whole.paste(Image.fromarray(image), (k * step, _PANEL_TEXT))
        pen.text((k * step + 4, 4), _LABELS[name], fill="black")
    pen.text((4, height + _PANEL_TEXT + 4), text, fill="black")
    return np.asarray(whole)


def _figures(results: Results, result: FrameResult, names: Sequence[str]) -> str:
    """Return the text below a frame's panels."""
    if not result.bounded:
        return f"frame {result.index}   no bound but [0, 1]"
    figures = metrics(result)
    text = f"frame {result.index}   mean gap {number(figures['mpg'])}   ratio {number(figures['ratio'])}"
    if "gap" in names or "witness" in names:
        text += f"   brightest gap {number(results.largest)}"
    return text


def write_video(results: Results, file: Path, names: Sequence[str], fps: float, labelled: bool = False) -> None:
    """Write an H.264 video (mp4) of the pictures ``names`` side by side, one frame of the path after the other."""
    if not (math.isfinite(fps) and 0.1 <= fps <= 1000.0):
        raise InputError(f"found {fps}", field="--fps", fix="give a number from 0.1 to 1000")
    if not has_video():
        raise InputError("needs the package av", field="mp4", fix="pip install 'ns-abstract[video]'")

    def rows() -> Iterator[np.ndarray]:
        for result in results:
            if labelled:
                yield panels(result, names, results.largest, _figures(results, result, names))
            else:
                yield np.concatenate([picture(result, name, results.largest) for name in names], axis=1)

    write_atomic(file, lambda stream: encode_mp4(stream, rows(), fps))


def has_video() -> bool:
    """Return whether PyAV is installed, which encodes videos."""
    return importlib.util.find_spec("av") is not None


def encode_mp4(stream: BinaryIO, frames: Iterable[np.ndarray], fps: float) -> None:
    """Write ``frames`` [h, w, 3] uint8, all of one size, as an H.264 video; odd sides are padded by a black line."""
    import av

    with av.open(stream, "w", format="mp4") as container:
        video: Any = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
        video.pix_fmt, video.options = "yuv420p", {"crf": "18"}
        for k, frame in enumerate(frames):
            height, width = frame.shape[:2]
            # the colour planes have half the size
            even = height + height % 2, width + width % 2
            if k == 0:
                video.height, video.width = even
            padded = np.pad(frame, ((0, even[0] - height), (0, even[1] - width), (0, 0)))
            container.mux(video.encode(av.VideoFrame.from_ndarray(padded, "rgb24")))
        container.mux(video.encode())


def encode_gif(stream: BinaryIO, frames: Iterable[np.ndarray], fps: float) -> None:
    """Write ``frames`` [h, w, 3] uint8 as a GIF that repeats, with 256 colours for each frame."""
    from PIL import Image

    first, *others = (Image.fromarray(frame) for frame in frames)
    first.save(stream, "gif", save_all=True, append_images=others, duration=round(1000.0 / fps), loop=0)


def encoded(frames: Iterable[np.ndarray], fps: float) -> tuple[str, bytes]:
    """Return the file suffix and content of a film: mp4, or gif where PyAV is missing."""
    buffer = io.BytesIO()
    if has_video():
        encode_mp4(buffer, frames, fps)
        return "mp4", buffer.getvalue()
    encode_gif(buffer, frames, fps)
    return "gif", buffer.getvalue()
