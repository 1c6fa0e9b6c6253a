"""Frame pictures: lower bound, upper bound, gap and one render side by side.

Matplotlib is imported when a picture is drawn, not before.
"""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ns_abstract.io.atomic import write_atomic
from ns_abstract.refine.result import FrameResult, gap, max_pixel_gap
from ns_abstract.report.figures import ShownUnits, metrics, number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from PIL.Image import Image

    from ns_abstract.geometry.box import ParameterBox

#: Colour map of gaps: perceptually uniform, black where the bounds meet.
GAP_COLORS = "inferno"

#: Colour map of depths and accumulations.
_LAYER_COLORS = "viridis"
_LAYER_TITLES = {"depth": "expected depth", "accumulation": "accumulation"}
_PANEL_INCHES = 2.6
_LEAST_WIDTH, _LEAST_HEIGHT = 1.6, 0.6
_PANEL_PIXELS = 400
_PANEL_PIXELS_MAX = 1000
# inches
_MARGIN, _GUTTER, _LABEL, _LINE, _BAR, _BAR_TEXT = 0.14, 0.12, 0.24, 0.19, 0.09, 0.50
_INK, _SOFT, _WARN = "#1a1a1a", "#555555", "#a32a12"
_TITLE_POINTS, _TEXT_POINTS, _LABEL_POINTS, _TICK_POINTS = 10.5, 8.0, 8.5, 7.5
#: Columns of white between two pictures, and most planes that are drawn.
_GAP, _MOST = 2, 3
#: What pixels that are not read are darkened to, and the colours of planes.
_DIM, _MAP = 0.35, "viridis"


def to_bytes(image: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return an image [H, W, 3] in [0, 1] as uint8, as Nerfstudio's viewer does (render_state_machine.py:279)."""
    return (np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)


def _wrapped(items: list[str], width: int) -> list[str]:
    """Return lines of at most ``width`` characters, broken between items only; a longer item is cut."""
    lines: list[str] = []
    for item in items:
        item = item if len(item) <= width else f"{item[: width - 1]}…"
        if lines and len(lines[-1]) + 5 + len(item) <= width:
            lines[-1] += f"  ·  {item}"
        else:
            lines.append(item)
    return lines


def _box_items(box: ParameterBox, units: ShownUnits) -> list[str]:
    sides = zip(box.names, box.units, box.lower, box.upper, strict=True)
    return [units.interval(*side) for side in sides] or ["one camera pose"]


class _Sheet(NamedTuple):
    """Sizes in pixels of a figure with four panels; ``dpi``: pixels by inch."""

    dpi: float
    panel: tuple[int, int]
    width: int
    characters: int

    @classmethod
    def of(cls, height: int, width: int) -> _Sheet:
        """Return the sizes for images of ``height`` x ``width`` pixels."""
        panel_w = int(_PANEL_PIXELS_MAX if width > _PANEL_PIXELS_MAX else width * max(1, round(_PANEL_PIXELS / width)))
        panel_h = max(1, round(panel_w * height / width))
        if panel_h > 1.5 * panel_w:
            # tall images: the height sets the scale
            panel_h = int(min(1.5 * _PANEL_PIXELS_MAX, height * max(1, round(1.5 * _PANEL_PIXELS / height))))
            panel_w = max(1, round(panel_h * width / height))
        dpi = panel_w / min(_PANEL_INCHES, 1.5 * _PANEL_INCHES * panel_w / panel_h)
        # labels and the colour bar need room beside narrow and flat images, which keep their shape
        panel = max(panel_w, round(_LEAST_WIDTH * dpi)), max(panel_h, round(_LEAST_HEIGHT * dpi))
        sheet = cls(dpi, panel, 0, 0)
        total = 2 * sheet.px(_MARGIN) + 4 * panel[0] + 3 * sheet.px(_GUTTER) + sheet.bar
        return sheet._replace(width=total, characters=max(40, int(total / dpi / (_TEXT_POINTS * 0.0087))))

    def px(self, length: float) -> int:
        """Return a length in inches as pixels."""
        return round(length * self.dpi)

    @property
    def bar(self) -> int:
        """Width of the colour bar with its labels."""
        return self.px(_GUTTER / 2 + _BAR + _BAR_TEXT)


def frame_figure(
    result: FrameResult, *, guarantee: str = "", about: str = "", units: ShownUnits | None = None
) -> Figure:
    """Return the figure of one frame: lower bound, upper bound, gap with its colour bar, one render.

    Small images are enlarged by a whole factor. ``guarantee``: shown in the title; see
    `ns_abstract.report.figures.short_guarantee`. ``about``: more for the title, such as the scene's name.
    """
    from matplotlib.figure import Figure

    sheet = _Sheet.of(*result.lower.shape[:2])
    px = sheet.px
    ranges = _wrapped(_box_items(result.box, units or ShownUnits()), sheet.characters)
    measured = _wrapped(_metric_items(result), sheet.characters)
    head = px(_LINE) * (1 + len(ranges) + len(measured)) + px(_LINE) // 2
    total_h = px(_MARGIN) + head + px(_LABEL) + sheet.panel[1] + px(_MARGIN)
    figure = Figure(figsize=(sheet.width / sheet.dpi, total_h / sheet.dpi), dpi=sheet.dpi, facecolor="white")

    def write(x: float, y: float, content: str, points: float, **style: Any) -> None:
        figure.text(
            x / sheet.width, 1.0 - y / total_h, content, fontsize=points, va="baseline", parse_math=False, **style
        )  # fmt: skip

    title = "  ·  ".join(part for part in (f"Frame {result.index}", about, guarantee) if part)
    title_room = max(20, int(sheet.characters * _TEXT_POINTS / _TITLE_POINTS * 0.85))
    title = title if len(title) <= title_room else f"{title[: title_room - 1]}…"
    y = px(_MARGIN) + px(_LINE) * 0.7
    write(px(_MARGIN), y, title, _TITLE_POINTS, weight="bold", color=_INK)
    if not result.bounded:
        measured = ["no bound but [0, 1] is known: the time ended before this frame was done", *measured[1:]]
    for k, line in enumerate([*ranges, *measured]):
        warned = not result.bounded and k == len(ranges)
        write(px(_MARGIN), y + (k + 1) * px(_LINE), line, _TEXT_POINTS, color=_WARN if warned else _SOFT)
    _draw_panels(figure, result, sheet, total_h, write)
    return figure


def _metric_items(result: FrameResult) -> list[str]:
    figures = metrics(result)
    return [
        f"MPG {number(figures['mpg'])}",
        f"XPG {number(figures['xpg'])}",
        f"MPG of renders {number(figures['mpg_witness'])}",
        f"ratio {number(figures['ratio'])}",
        f"{result.cells} cells",
        f"{number(result.seconds, 3)} s",
    ]


def _draw_panels(figure: Figure, result: FrameResult, sheet: _Sheet, total_h: int, write: Callable[..., None]) -> None:
    """Draw the four images with labels and the colour bar of the gap at the foot of a figure of ``total_h`` pixels."""
    px, (panel_w, panel_h) = sheet.px, sheet.panel
    length = gap(result.lower, result.upper)
    top = float(length.max())
    panels: list[tuple[str, Any]] = [
        ("lower bound", to_bytes(result.lower)),
        ("upper bound", to_bytes(result.upper)),
        ("gap |upper − lower|", length),
        ("render at the middle" if result.box.dimensions else "render", to_bytes(result.image)),
    ]
    x, base = px(_MARGIN), px(_MARGIN)
    for k, (label, image) in enumerate(panels):
        axes = figure.add_axes((x / sheet.width, base / total_h, panel_w / sheet.width, panel_h / total_h))
        heat_map = axes.imshow(
            image, cmap=GAP_COLORS if k == 2 else None, vmin=0.0, vmax=top if top > 0.0 else 1.0,
            interpolation="antialiased",
        )  # fmt: skip
        bare_axes(axes)
        write(x, total_h - base - panel_h - px(0.075), label, _LABEL_POINTS, color=_INK)
        x += panel_w + px(_GUTTER)
        if k == 2:
            left = x - px(_GUTTER) + px(_GUTTER / 2)
            side = figure.add_axes((left / sheet.width, base / total_h, px(_BAR) / sheet.width, panel_h / total_h))
            _color_bar(figure, heat_map, side, panel_h / sheet.dpi)
            x += sheet.bar


def layer_figure(result: FrameResult, name: str) -> Figure:
    """Return the figure of one further output: lower bound, upper bound, gap, one render; the gap has its own scale.

    Args:
        name: Of `ns_abstract.refine.result.EXTRA_OUTPUTS`; the colour scale ends at the largest finite value.
    """
    layer = result.layers[name]
    finite = layer.upper[np.isfinite(layer.upper)]
    top = float(max(finite.max(initial=0.0), layer.image.max(initial=0.0))) or 1.0
    length = np.where(np.isfinite(layer.upper), layer.upper.astype(np.float64) - layer.lower, np.nan)
    middle = "render at the middle" if result.box.dimensions else "render"
    panels = [
        ("lower bound", layer.lower, _LAYER_COLORS, top),
        ("upper bound", np.minimum(layer.upper, np.float32(top)), _LAYER_COLORS, top),
        ("upper − lower", length, GAP_COLORS, float(np.nan_to_num(length).max(initial=0.0)) or 1.0),
        (middle, layer.image, _LAYER_COLORS, top),
    ]
    unit = " (units of the normalised frame)" if name == "depth" else ""
    return panels_figure(panels, f"Frame {result.index}  ·  {_LAYER_TITLES[name]}{unit}", bars=range(4))


def panels_figure(
    panels: Sequence[tuple[str, NDArray[Any], str | None, float]], title: str, bars: Iterable[int]
) -> Figure:
    """Return a figure of pictures side by side below a title.

    Args:
        panels: Label, picture, colour map and end of its scale; without a colour map the picture has colours.
        bars: Numbers of the panels that have a colour bar.
    """
    from matplotlib.figure import Figure

    height, width = panels[0][1].shape[:2]
    panel_height = _PANEL_INCHES * min(1.5, max(0.25, height / width))
    figure = Figure(
        figsize=(len(panels) * _PANEL_INCHES + 1.2, panel_height + 0.9), facecolor="white", layout="constrained"
    )
    axes: Any = figure.subplots(1, len(panels))
    for k, (place, (label, image, colors, top)) in enumerate(zip(axes, panels, strict=True)):
        mapped = place.imshow(image, cmap=colors, vmin=0.0, vmax=top, interpolation="antialiased")
        bare_axes(place)
        place.set_title(label, fontsize=_LABEL_POINTS, color=_INK)
        if k in bars:
            figure.colorbar(mapped, ax=place, fraction=0.05, pad=0.02).ax.tick_params(labelsize=_TICK_POINTS)
    figure.suptitle(title, fontsize=_TITLE_POINTS, color=_INK)
    return figure


def save_figure(path: str | os.PathLike[str], figure: Figure, dpi: int | None = None) -> None:
    """Write a figure as PNG, whole or not at all. Raises OSError where the file cannot be written."""
    about = {"Software": "ns_abstract"}
    write_atomic(path, lambda stream: figure.savefig(stream, format="png", dpi=dpi or "figure", metadata=about))


def bare_axes(axes: Axes) -> None:
    """Remove the ticks of a picture's axes and make their frame thin."""
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_linewidth(0.4)
        spine.set_color(_SOFT)


def _color_bar(figure: Figure, mapped: Any, side: Axes, inches: float) -> None:
    """Draw a colour bar with as many ticks as fit into ``inches``."""
    from matplotlib.ticker import MaxNLocator, ScalarFormatter

    bar = figure.colorbar(mapped, cax=side)
    bar.outline.set_linewidth(0.4)  # pyright: ignore[reportCallIssue]
    bar.locator = MaxNLocator(nbins=max(1, min(6, int(inches / 0.4))))
    # a common factor of small gaps stands above the bar
    bar.formatter = ScalarFormatter(useMathText=True)
    bar.formatter.set_powerlimits((-2, 3))
    bar.update_ticks()
    side.yaxis.get_offset_text().set(size=_TICK_POINTS, color=_INK, horizontalalignment="left")
    side.tick_params(labelsize=_TICK_POINTS, width=0.4, length=2.0, pad=2.0, colors=_INK)


def save_picture(path: str | os.PathLike[str], result: FrameResult, **labels: Any) -> None:
    """Write `frame_figure` with ``labels``; see `save_figure`."""
    save_figure(path, frame_figure(result, **labels))


def heat(length: NDArray[np.floating], top: float, colors: str = GAP_COLORS) -> NDArray[np.uint8]:
    """Return gaps [H, W] as colours [H, W, 3] uint8 of the scale from 0 to ``top``."""
    from matplotlib import colormaps

    scaled = np.asarray(length, np.float64) / (top if top > 0.0 else 1.0)
    return colormaps[colors](scaled, bytes=True)[..., :3]


def color_stops(count: int = 9) -> list[str]:
    """Return ``count`` evenly spaced colours of the gap scale as hex codes."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    return [to_hex(colormaps[GAP_COLORS](k / (count - 1))) for k in range(count)]


def color_table() -> str:
    """Return the 256 colours of the gap scale as hexadecimal digits, six for each colour."""
    return heat(np.arange(256)[None] / 255.0, 1.0).tobytes().hex()


def png(image: Image) -> bytes:
    """Return an image as PNG bytes."""
    buffer = io.BytesIO()
    image.save(buffer, "png")
    return buffer.getvalue()


def preview(image: NDArray[np.uint8], side: int) -> bytes:
    """Return a PNG of ``image`` [H, W, 3], reduced by area average where a side exceeds ``side`` pixels."""
    from PIL import Image

    picture = Image.fromarray(image)
    if max(picture.size) > side:
        picture.thumbnail((side, side), Image.Resampling.BOX)
    return png(picture)


def previews(result: FrameResult, side: int) -> Mapping[str, bytes]:
    """Return PNGs of a frame for the page, by name: lower, upper, gap, gap of renders (same scale), render, others.

    The others are further outputs, named ``depth_lower`` and so on; their scale ends at the largest finite value.
    """
    top = max_pixel_gap(result.lower, result.upper)
    images = {
        "lower": to_bytes(result.lower),
        "upper": to_bytes(result.upper),
        "gap": heat(gap(result.lower, result.upper), top),
        "witness": heat(gap(result.witness_lower, result.witness_upper), top),
        "image": to_bytes(result.image),
    }
    for name, layer in result.layers.items():
        finite = np.isfinite(layer.upper)
        high = np.where(finite, layer.upper, 0.0)
        length = np.where(finite, high - layer.lower, 0.0)
        whole = float(max(high.max(initial=0.0), layer.image.max(initial=0.0)))
        high = np.where(finite, high, whole)
        for kind, array in (("lower", layer.lower), ("upper", high), ("image", layer.image)):
            images[f"{name}_{kind}"] = heat(array, whole, _LAYER_COLORS)
        images[f"{name}_gap"] = heat(length, float(length.max(initial=0.0)))
    return {name: preview(image, side) for name, image in images.items()}


def planes_picture(image: np.ndarray, wanted: np.ndarray, depth: int | None) -> np.ndarray:
    """Return a picture [h, w, 3] uint8: colours with unread pixels darkened, then further channels side by side.

    Args:
        image: [H, W, C] colours, then channels in [0, 1]; one of them may be depths.
        wanted: [H, W] the pixels that are read.
        depth: Number of the channel of depths, or None.
    """
    colors = np.clip(image[..., :3], 0.0, 1.0)
    images = [to_bytes(np.where(wanted[..., None], colors, _DIM * colors))]
    for channel in range(3, min(image.shape[2], 3 + _MOST)):
        plane, top = image[..., channel], 1.0
        if channel == depth:
            near = plane < np.max(plane)
            top = float(plane[near].max(initial=0.0)) or 1.0
        images.append(heat(np.clip(plane, 0.0, top), top, _MAP))
    gap = np.full((image.shape[0], _GAP, 3), 255, np.uint8)
    parts = [part for one in images for part in (one, gap)][:-1]
    return np.concatenate(parts, axis=1)
