"""Pictures of docs/gallery.md from the built-in demo: runs the commands that the page shows, and draws what they wrote.

    python benchmarks/gallery.py --folder WORK [--only abstract loop ...] [--page]

WORK gets the demo and all results (about half an hour on two cores); what is there already is not made again. The
pictures go to docs/images/gallery/. ``--page`` writes docs/gallery.md alone, from the table below.
"""

from __future__ import annotations

import argparse
import base64
import io
import json
import math
import re
import shlex
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from approach import FOV, rotation
from PIL import Image

from ns_abstract.geometry.keyframe_cameras import KeyframeCamera, path_json
from ns_abstract.io.atomic import write_atomic
from ns_abstract.refine.result import gap
from ns_abstract.report.files import load_frame
from ns_abstract.report.picture import heat, to_bytes

ROOT = Path(__file__).resolve().parents[1]
IMAGES, PAGE = ROOT / "docs" / "images" / "gallery", ROOT / "docs" / "gallery.md"
#: Bytes and colours of a picture at most, and its width in pixels.
_MOST_BYTES, _COLORS, _WIDTH = 80_000, (256, 128, 64, 32), 900
#: Places of the runs below the working folder: the demo's names do not change.
AIRFIELD = "demo/airfield/splatfacto/2026-01-01_120000/config.yml"
BUOY = "demo/buoy/vanilla-nerf/2026-01-01_120000/config.yml"
GATE = "demo/gate/gate/splatfacto/2026-01-01_120000/config.yml"
PATH = "demo/camera_path.json"
_GOOD, _BAD, _OPEN, _BLUE, _INK = "#1d7440", "#b3261e", "#9aa0a6", "#0b57d0", "#333333"


def gate_camera(*places: tuple[float, float, float]) -> dict[str, Any]:
    """The gate seen along x, from its axis or from ``places``, 8 x 8 pixels, as the demo's network sees it."""
    views = []
    for place in places or ((0.5, 0.0, 0.0),):
        pose = rotation()
        pose[:3, 3] = place
        views.append(KeyframeCamera(pose, FOV, 8, 8))
    return path_json(views)


@dataclass(frozen=True)
class Entry:
    """A picture of the gallery.

    Attributes:
        name: Of the PNG.
        title: Of the section.
        sentence: What one sees.
        command: What makes it.
        output: Its folder of results.
        draw: From the working folder to the picture.
        files: JSON files that the command reads, by name; shown in the page unless they are long.
        hidden: Names of those that are not shown, and what is said of them instead.
    """

    name: str
    title: str
    sentence: str
    command: str
    output: str
    draw: Callable[[Path], Image.Image]
    files: dict[str, Any] = field(default_factory=dict)
    hidden: dict[str, str] = field(default_factory=dict)


# ---------------------------------------------------------------- drawing


def frame_picture(output: str) -> Callable[[Path], Image.Image]:
    """The PNG that ns-abstract-render itself writes."""
    return lambda work: Image.open(work / output / "frame_00000.png").convert("RGB")


def drawn(figure: Any) -> Image.Image:
    """A matplotlib figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return Image.open(buffer).convert("RGB")


def figure_of(width: float, height: float) -> Any:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), facecolor="white", layout="constrained")


def path_picture(work: Path) -> Image.Image:
    """All frames of a path: a column each."""
    results = [load_frame(file, leaves=False).result for file in sorted((work / "out/path").glob("frame_*.npz"))]
    largest = max(float(gap(r.lower, r.upper).max()) for r in results)
    rows = (
        ("lower bound", lambda r: to_bytes(r.lower)), ("upper bound", lambda r: to_bytes(r.upper)),
        ("gap", lambda r: heat(gap(r.lower, r.upper), largest)), ("render", lambda r: to_bytes(r.image)),
    )  # fmt: skip
    figure = figure_of(6.2, 6.2 * len(rows) / len(results) + 0.3)
    axes = figure.subplots(len(rows), len(results), squeeze=False)
    for line, (label, shown) in zip(axes, rows, strict=True):
        for place, result in zip(line, results, strict=True):
            place.imshow(shown(result), interpolation="antialiased")
            place.set_xticks([])
            place.set_yticks([])
        line[0].set_ylabel(label, fontsize=10, color=_INK)
    for place, result in zip(axes[0], results, strict=True):
        place.set_title(f"keyframe {result.index} to {result.index + 1}", fontsize=10, color=_INK)
    return drawn(figure)


def time_picture(work: Path) -> Image.Image:
    """Mean gaps against time: the bounds' comes down, the renders' goes up."""
    (entry,) = json.loads((work / "out/six/report.json").read_text())["frames"]
    points = [p for p in entry["trace"] if p["covered"] == 1.0 and p["mpg_witness"] > 0.0]
    seconds, outer, inner = (np.array([p[key] for p in points]) for key in ("seconds", "mpg", "mpg_witness"))
    figure = figure_of(7.2, 4.0)
    axes = figure.subplots()
    axes.fill_between(seconds, inner, outer, step="post", color="#c0430f", alpha=0.12, lw=0)
    axes.step(seconds, outer, where="post", color="#c0430f", lw=1.8, label="bounds")
    axes.step(seconds, inner, where="post", color="#1769aa", lw=1.8, label="renders")
    axes.set(xscale="log", xlabel="seconds of work", ylabel="mean pixel gap", ylim=(0.0, None))
    axes.legend(frameon=False, fontsize=10)
    axes.grid(visible=True, which="both", color="#e6e6e2", lw=0.6)
    return drawn(figure)


def certificate_picture(work: Path) -> Image.Image:
    """Cells by verdict over the two offsets."""
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Rectangle

    with closing(sqlite3.connect(work / "out/certificate/cells.sqlite")) as base:
        rows = base.execute("SELECT lower, upper, verdict FROM cells").fetchall()
        names = [name for (name,) in base.execute("SELECT name FROM parameters ORDER BY position")]
    report = json.loads((work / "out/certificate/report.json").read_text())
    sides = report["frames"][0]["parameters"]
    figure = figure_of(7.2, 5.4)
    axes = figure.subplots()
    colors = {"certified": _GOOD, "falsified": _BAD, "unknown": _OPEN}
    for kind, color in colors.items():
        boxes = [(json.loads(a), json.loads(b)) for a, b, verdict in rows if verdict == kind]
        patches = [Rectangle((a[0], a[1]), b[0] - a[0], b[1] - a[1]) for a, b in boxes]
        axes.add_collection(PatchCollection(patches, facecolor=color, edgecolor="white", lw=0.25, alpha=0.75))
        part = report["coverage"][kind]
        axes.plot([], [], "s", color=color, label=f"{kind} {100.0 * part:.1f} %")
    axes.set(xlim=(sides[0]["lower"], sides[0]["upper"]), ylim=(sides[1]["lower"], sides[1]["upper"]))
    axes.set(xlabel=f"{names[0]}: beside the axis, units", ylabel=f"{names[1]}: above the axis, units")
    axes.set_aspect("equal")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False)
    return drawn(figure)


def kept_picture(file: str) -> Callable[[Path], Image.Image]:
    """An SVG that ns-abstract-certify itself writes, as Chromium draws it."""

    def drawn(work: Path) -> Image.Image:
        width, height = re.findall(r'width="([0-9.]+)" height="([0-9.]+)"', (work / file).read_text())[0]
        size = f"--window-size={math.ceil(float(width))},{math.ceil(float(height))}"
        picture = (work / file).with_suffix(".png")
        command = ["chromium", "--headless", "--no-sandbox", size, f"--screenshot={picture}", str(work / file)]
        subprocess.run(command, check=True, capture_output=True)
        return Image.open(picture).convert("RGB")

    return drawn


def broken_picture(work: Path) -> Image.Image:
    """The largest region's two pictures, as the report's page has them."""
    page = (work / "out/certificate/report.html").read_text()
    region = page[page.index('<div class="region">') :].split('<div class="region">')[1]
    found = re.findall(
        r'base64,([^"]+)" alt="([^"]+)"><figcaption><b[^>]*>[^<]*</b>(, margin [^<]*)<br>([^<]*)<', region
    )
    figure = figure_of(6.0, 3.5)
    for axes, (data, title, margin, pose) in zip(figure.subplots(1, len(found)), found, strict=True):
        axes.imshow(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"), interpolation="nearest")
        axes.set_title(f"{title}{margin}", fontsize=9, color=_BAD if title == "counterexample" else _GOOD)
        axes.set_xlabel(pose, fontsize=9, color=_INK)
        axes.set_xticks([])
        axes.set_yticks([])
    return drawn(figure)


def loop_picture(work: Path) -> Image.Image:
    """Tubes from above and from the side over the scene, as the report's page has them."""
    from matplotlib.patches import Polygon, Rectangle

    from ns_abstract.api.scenes import load_scene
    from ns_abstract.reach.loop import load_loop
    from ns_abstract.reach.planes import region, views
    from ns_abstract.report.outside import SceneDrawing

    document = json.loads((work / "out/loop/report.json").read_text())
    loop = load_loop(work / "demo/gate/LOOP.json")
    elements = load_scene(work / GATE).method().elements()
    assert elements is not None
    outside = SceneDrawing(elements)
    figure = figure_of(8.2, 8.6)
    for axes, view in zip(figure.subplots(2, 1), views(document, [], loop, outside, 900), strict=True):
        window = view.window
        scene = Image.open(io.BytesIO(outside.picture(window, view.nearest))).convert("RGB")
        extent = (window.low[0], window.high[0], window.low[1], window.high[1])
        axes.imshow(scene, extent=extent, interpolation="antialiased")
        sets = [(faces, -1.0, _BAD) for faces in loop.unsafe]
        sets += [] if loop.goal is None else [(loop.goal.faces, 1.0, "#00695c")]
        for faces, sign, color in sets:
            corners = region(faces, loop, view.axes, window, sign)
            if corners:
                axes.add_patch(Polygon(corners, facecolor=color, alpha=0.12))
                axes.add_patch(Polygon(corners, fill=False, edgecolor=color, lw=1.0, ls="--"))
        for kind, line in view.marks.lines:
            axes.plot(line[:, 0], line[:, 1], color=_BAD if "bad" in kind else "#5f6368", lw=0.6, alpha=0.8)
        for _, low, high in view.marks.boxes:
            axes.add_patch(Rectangle(low, *(high - low), fill=False, edgecolor=_BLUE, lw=1.1))
        axes.set(xlim=extent[:2], ylim=extent[2:], aspect="equal", title=view.title)
        axes.set(xlabel=f"{'xyz'[view.axes[0]]}, units", ylabel=f"{'xyz'[view.axes[1]]}, units")
    return drawn(figure)


def film_picture(work: Path) -> Image.Image:
    """The strips of the report's page."""
    page = (work / "out/loop/report.html").read_text()
    strips = re.findall(r'src="data:image/png;base64,([^"]+)" alt="step (\d+)"', page)
    figure = figure_of(8.6, 3.7)
    for axes, (data, step) in zip(figure.subplots(1, len(strips)), strips, strict=True):
        image = Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")
        axes.imshow(image, interpolation="antialiased")
        axes.set_title(f"step {step}", fontsize=9, color=_INK)
        axes.set_xticks([])
        axes.set_yticks((np.arange(4) + 0.5) * image.height / 4, ["lower", "upper", "gap", "render"])
        axes.tick_params(length=0, labelleft=step == strips[0][1])
    return drawn(figure)


# ---------------------------------------------------------------- the table

_SEGMENTS = {"version": 1, "sweep": "segments"}
_BRIGHT = {
    "version": 1,
    "scene": [
        {
            "select": {"box": [[-1, -1, -0.1], [1, 1, 1]], "color": {"min": [0.5, 0.5, 0.5]}},
            "color": 0.1,
            "opacity": 0.05,
        }
    ],
}
_OFFSETS = {"version": 1, "frame": "world", "translation": {"y": 0.6, "z": 0.5}}
_NEAR = {
    "type": "regression",
    "target": ["camera.y", "camera.z"],
    "tolerance": {"absolute": 0.03},
    "preprocess": {"resize": [8, 8]},
}
_THREE = {"version": 1, "frame": "world", "translation": {"x": 0.1, "y": 0.6, "z": 0.5}}
_ROUTE = (0.2, 0.3, 0.1), (0.7, 0.1, 0.25), (1.1, -0.1, 0.0), (1.5, 0.0, -0.1)
_CERTIFY_COMMAND = (
    f"ns-abstract-certify --load-config {GATE} --camera-path-filename gate_path.json "
    "--perturbation-filename offsets.json --model demo/gate/estimator.onnx --property near.json "
    "--output-dir out/certificate --time-budget 240"
)
_CERTIFY_FILES = {"gate_path.json": gate_camera(), "offsets.json": _OFFSETS, "near.json": _NEAR}
_PATH_COMMAND = (
    f"ns-abstract-render --load-config {AIRFIELD} --camera-path-filename {PATH} --perturbation-filename segments.json "
    "--frames 0 1 2 3 --downscale-factor 2 --output-dir out/path --time-budget 160"
)
_SIX_COMMAND = (
    f"ns-abstract-render --load-config {AIRFIELD} --camera-path-filename {PATH} --translation 0.002 --rotation 0.1 "
    "--angle-units degrees --frames 0 --downscale-factor 2 --output-dir out/six --time-budget 120"
)
_LOOP_COMMAND = (
    f"ns-abstract-reach --load-config {GATE} --loop demo/gate/LOOP.json --output-dir out/loop --time-budget 240 --film"
)
DEMO = "ns-abstract-demo --output-dir demo"
ENTRIES = (
    Entry(
        "abstract", "An abstract image",
        "The camera may stand anywhere within 0.02 units to either side: no picture from there is darker than the "
        "first image or brighter than the second, and they differ only at edges of near things.",
        f"ns-abstract-render --load-config {AIRFIELD} --camera-path-filename {PATH} "
        "--perturbation-filename demo/SPEC.json --frames 0 --output-dir out/abstract --time-budget 60",
        "out/abstract", frame_picture("out/abstract"),
    ),
    Entry(
        "six", "Six parameters at once",
        "The camera may be off by 0.002 units along every axis and by 0.1 degrees about every axis. Bounds are wider "
        "than with one parameter: six dimensions need many more cells, so in the same time each cell stays larger.",
        _SIX_COMMAND,
        "out/six", frame_picture("out/six"),
    ),
    Entry(
        "time", "Error over time",
        "The mean gap of these bounds falls towards that of real renders; the true one lies in the band between them.",
        _SIX_COMMAND, "out/six", time_picture,
    ),
    Entry(
        "path", "Along a path",
        "Each column holds every picture on the way from one keyframe of the approach to the next: the farther the "
        "camera moves against what it looks at, the wider the gap.",
        _PATH_COMMAND, "out/path", path_picture, {"segments.json": _SEGMENTS},
    ),
    Entry(
        "nerf", "A NeRF",
        "The demo's buoy, a field of 8 layers of 256 units at 32 samples by ray, while the camera turns by 0.002 rad "
        "to either side: every ray is bounded through the network, and only edges of the buoy are open.",
        f"ns-abstract-render --load-config {BUOY} --camera-path-filename demo/camera_path_buoy.json "
        "--num-samples 32 --output-dir out/nerf --time-budget 600",
        "out/nerf", frame_picture("out/nerf"),
    ),
    Entry(
        "scene", "A scene that may vary",
        "The camera stands still, but every bright Gaussian near the aeroplane may have another colour, by up to 0.1, "
        "and opacity, by up to 0.05: the white of fuselage and wings carries the gap, and all else stays as it is.",
        f"ns-abstract-render --load-config {AIRFIELD} --camera-path-filename {PATH} "
        "--perturbation-filename bright.json --frames 0 --output-dir out/scene --time-budget 60",
        "out/scene", frame_picture("out/scene"), {"bright.json": _BRIGHT},
    ),
    Entry(
        "certificate", "A certificate",
        "Green: from every place of the cell, proved, the network tells how far beside and above the gate's axis it "
        "is, within 0.03; red: at a place of the cell it does not.",
        _CERTIFY_COMMAND,
        "out/certificate", certificate_picture,
        _CERTIFY_FILES,
        {"gate_path.json": "a camera path with one pose, 8 × 8 pixels, at (0.5, 0, 0) and looking along x"},
    ),
    Entry(
        "broken", "Where it fails",
        "From the page of that certificate: the largest region where the network errs by more, its worst picture, and "
        "the nearest pose at which it is proved not to.",
        _CERTIFY_COMMAND, "out/certificate", broken_picture, _CERTIFY_FILES,
    ),
    Entry(
        "pairs", "A certificate over three parameters",
        "Every map is over two of them: below the diagonal what part of the volume over the third is certified, above "
        "it what part is falsified; on the diagonal both along one parameter.",
        f"ns-abstract-certify --load-config {GATE} --camera-path-filename gate_path.json "
        "--perturbation-filename three.json --model demo/gate/estimator.onnx --property wide.json "
        "--output-dir out/pairs --time-budget 240",
        "out/pairs", kept_picture("out/pairs/verdicts_00000.svg"),
        {"gate_path.json": gate_camera(), "three.json": _THREE,
         "wide.json": _NEAR | {"tolerance": {"absolute": 0.15}}},
        {"gate_path.json": "as above"},
    ),
    Entry(
        "route", "A certificate along a path",
        "The camera flies from keyframe to keyframe, and every pose on the way is looked at: the network is right on "
        "every picture until the gate is near.",
        f"ns-abstract-certify --load-config {GATE} --camera-path-filename route.json "
        "--perturbation-filename segments.json --model demo/gate/estimator.onnx --property close.json "
        "--output-dir out/route --time-budget 60",
        "out/route", kept_picture("out/route/cameras.svg"),
        {"route.json": gate_camera(*_ROUTE), "segments.json": _SEGMENTS,
         "close.json": _NEAR | {"tolerance": {"absolute": 0.08}}},
        {"route.json": "a camera path with four such poses, at (0.2, 0.3, 0.1), (0.7, 0.1, 0.25), (1.1, -0.1, 0) and "
         "(1.5, 0, -0.1)", "segments.json": "as above"},
    ),
    Entry(
        "loop", "A network in the loop",
        "Blue boxes hold all positions of the drone at each of 24 steps, from two cells of the starting box, over the "
        "scene; red is the outside of the funnel, which must not be entered, green the goal, grey are simulated "
        "flights.",
        _LOOP_COMMAND, "out/loop", loop_picture,
    ),
    Entry(
        "film", "What the drone may see on its way",
        "Bounds of the picture at some steps of one tube, from the film that the command above writes: the ring comes "
        "nearer, and the bounds widen.",
        _LOOP_COMMAND, "out/loop", film_picture,
    ),
)  # fmt: skip


# ---------------------------------------------------------------- page and pictures


def wrapped(command: str, width: int = 110) -> str:
    """A command over several lines, cut before options."""
    lines = [""]
    for part in re.split(r" (?=--)", command):
        if lines[-1] and len(lines[-1]) + 1 + len(part) > width:
            lines.append(f"  {part}")
        else:
            lines[-1] = f"{lines[-1]} {part}".lstrip() if len(lines) == 1 else f"{lines[-1]} {part}"
    return " \\\n".join(lines)


def page() -> str:
    """Content of docs/gallery.md."""
    parts = [
        "# Gallery",
        "Pictures of the built-in demo, made by the commands below them. `python benchmarks/gallery.py --folder WORK` "
        "runs\nall of them and draws the pictures anew. The demo comes first:",
        f"```sh\n{DEMO}\n```",
    ]
    told: set[str] = set()
    for entry in ENTRIES:
        picture = f"![{entry.title}](images/gallery/{entry.name}.png)"
        parts += [f"## {entry.title}", picture, fill(entry.sentence, 118)]
        if entry.command in told:
            parts.append(f"From the same command, `--output-dir {entry.output}`.")
            continue
        told.add(entry.command)
        parts.append(f"```sh\n{wrapped(entry.command)}\n```")
        for name, content in entry.files.items():
            if name in entry.hidden:
                parts.append(f"`{name}`: {entry.hidden[name]}.")
            else:
                parts.append(f"`{name}`:\n\n```json\n{fill(json.dumps(content), 118)}\n```")
    return "\n\n".join(parts) + "\n"


def small(image: Image.Image) -> bytes:
    """A PNG of at most `_MOST_BYTES`, in as many colours as that leaves."""
    if image.width > _WIDTH:
        image = image.resize((_WIDTH, round(image.height * _WIDTH / image.width)), Image.Resampling.LANCZOS)
    data = b""
    for colors in _COLORS:
        buffer = io.BytesIO()
        image.quantize(colors, dither=Image.Dither.NONE).save(buffer, "png", optimize=True)
        data = buffer.getvalue()
        if len(data) <= _MOST_BYTES:
            break
    return data


def run(command: str, work: Path) -> None:
    """Run a console script of this package in the working folder."""
    script, *options = shlex.split(command)
    module = f"ns_abstract.cli.{script.removeprefix('ns-abstract-')}"
    code = subprocess.run([sys.executable, "-m", module, *options], cwd=work, check=False).returncode
    # 3: the budget ended before every frame had a result
    if code not in (0, 3):
        raise SystemExit(f"exit code {code}: {command}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--only", nargs="+", choices=[entry.name for entry in ENTRIES])
    parser.add_argument("--page", action="store_true")
    options = parser.parse_args()
    if options.page:
        PAGE.write_text(page(), encoding="utf-8")
        return
    if options.folder is None:
        raise SystemExit("--folder is missing")
    work = options.folder
    work.mkdir(parents=True, exist_ok=True)
    IMAGES.mkdir(parents=True, exist_ok=True)
    if not (work / "demo").exists():
        run(DEMO, work)
    for entry in ENTRIES:
        if options.only and entry.name not in options.only:
            continue
        for name, content in entry.files.items():
            (work / name).write_text(json.dumps(content))
        if not (work / entry.output / "report.html").exists():
            run(entry.command, work)
        data = small(entry.draw(work))
        write_atomic(IMAGES / f"{entry.name}.png", lambda stream, data=data: stream.write(data))
        print(f"{entry.name}: {len(data):,} bytes")
    PAGE.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
