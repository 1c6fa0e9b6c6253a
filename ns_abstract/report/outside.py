"""Drawings of a scene from above and from the side, as one small picture, as the ground of plots."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from ns_abstract.refine.protocol import SceneElements
from ns_abstract.report.html import uri
from ns_abstract.report.picture import png
from ns_abstract.report.svg import PlotAxis, draw_plot

Float64 = NDArray[np.float64]

#: Elements drawn at most, the numbers that are tried until a picture is small enough, and bytes of one.
_COUNTS, _MOST_BYTES = (4000, 2000, 1000, 400), 90_000
#: Opacity from which an element is drawn, and its strength; part of the paper's colour that is mixed in.
_OPAQUE, _STRENGTH, _FADED = 0.3, 0.9, 0.2
_PAPER = np.array([246.0, 246.0, 243.0])
#: Colours of a picture; corners of an ellipse; least half-axis, pixels; drawn pixels by side of one that is shown.
_COLORS, _CORNERS, _LEAST, _FINE = 64, 32, 0.75, 2
#: How much of the scene, and of how many elements at least, a window should hold, and how much wider than what it is
#: about it may get.
_SHARE, _ENOUGH, _WIDER = 0.1, 10, 2.5
#: Elements larger than this many windows are not drawn: they would cover everything.
_HUGE = 1.0
#: Windows and pictures that are remembered.
_KEPT = 4
#: Room beside the window of a plot: left, right, above, below; and the window's width.
_ROOM = 52, 12, 20, 34
PICTURE_WIDTH = 820 - _ROOM[0] - _ROOM[1]
#: The world's axes to the right and up, seen from the tip of each axis.
PLANS = ((1, 2), (2, 0), (0, 1))
#: The same seen from above, where z is up.
ABOVE = PLANS[2]


@dataclass(frozen=True)
class PlotWindow:
    """The window of a plot: a rectangle of a plane, drawn at one scale, ``size`` pixels wide and high.

    ``axes`` are the world's axes to the right and up, ``low`` and ``high`` [2] the ends along them, normalised units.
    """

    axes: tuple[int, int]
    low: tuple[float, float]
    high: tuple[float, float]
    size: tuple[int, int]


class SceneDrawing:
    """Draws a scene's opaque elements from outside."""

    def __init__(self, elements: SceneElements) -> None:
        self.elements = elements
        # reports are written again and again, mostly of the same windows
        self._window = lru_cache(_KEPT)(self._found_window)
        self._picture = lru_cache(_KEPT)(self._drawn_picture)

    @staticmethod
    def sight(axes: tuple[int, int]) -> tuple[int, float]:
        """Return the viewing axis of a plane, and the sign of the side that the viewer is on."""
        third = 3 - sum(axes)
        return third, float(np.cross(np.eye(3)[axes[0]], np.eye(3)[axes[1]])[third])

    @cached_property
    def _opaque(self) -> NDArray[np.bool_]:
        return np.isfinite(self.elements.places).all(axis=1) & (self.elements.opacities >= _OPAQUE)

    @property
    def opaque_places(self) -> Float64:
        """[n, 3] middles of the opaque elements, normalised units."""
        return self.elements.places[self._opaque]

    def _drawn(self, axes: tuple[int, int], nearest: float) -> NDArray[np.intp]:
        """Return numbers of the opaque elements beyond ``nearest`` from the viewer, the farthest first."""
        third, sign = self.sight(axes)
        depth = sign * self.elements.places[:, third]
        visible = np.flatnonzero(self._opaque & (depth <= nearest))
        return visible[np.argsort(depth[visible], kind="stable")]

    def window(self, axes: tuple[int, int], low: Float64, high: Float64, nearest: float, width: int) -> PlotWindow:
        """Return a window around the box ``low`` [2] to ``high`` [2], normalised units, with some of the scene.

        ``axes`` are the world's axes to the right and up; ``nearest`` as in `picture`; ``width`` of the picture in
        pixels.
        """
        return self._window(axes, tuple(low.tolist()), tuple(high.tolist()), nearest, width)

    def _found_window(
        self, axes: tuple[int, int], lower: tuple[float, ...], upper: tuple[float, ...], nearest: float, width: int
    ) -> PlotWindow:
        low, high = np.array(lower), np.array(upper)
        span = max(float((high - low).max()), 1e-6)
        places = self.elements.places[self._drawn(axes, nearest)][:, list(axes)]
        if len(places):
            away = np.linalg.norm(np.maximum(np.maximum(low - places, places - high), 0.0), axis=1)
            count = min(len(places), max(_ENOUGH, int(_SHARE * len(places))))
            near = places[np.argsort(away, kind="stable")[:count]]
            room = _WIDER * span
            low = np.minimum(low, np.maximum(near.min(axis=0), low - room))
            high = np.maximum(high, np.minimum(near.max(axis=0), high + room))
        return framed(axes, low, high, width)

    def picture(self, window: PlotWindow, nearest: float = np.inf) -> bytes:
        """Return a PNG of the elements in a window, without those that are nearer to the viewer than ``nearest``."""
        return self._picture(window, nearest)

    def _drawn_picture(self, window: PlotWindow, nearest: float) -> bytes:
        low, high = np.array(window.low), np.array(window.high)
        axes = list(window.axes)
        numbers = self._drawn(window.axes, nearest)
        scale = _FINE * window.size[0] / (high[0] - low[0])
        flat = self.elements.spreads[numbers][:, axes]
        half = np.sqrt((flat**2).sum(axis=2))
        places = self.elements.places[numbers][:, axes]
        inside = ((places + half >= low) & (places - half <= high)).all(axis=1)
        inside &= half.max(axis=1) <= _HUGE * float((high - low).max())
        numbers, flat, places = numbers[inside], flat[inside], places[inside]
        # corners of ellipses of one standard deviation, in pixels
        values, vectors = np.linalg.eigh(flat @ flat.swapaxes(1, 2)) if len(flat) else (np.ones((0, 2)), flat[..., :2])
        axis = np.maximum(scale * np.sqrt(np.maximum(values, 0.0)), _FINE * _LEAST)
        angles = 2.0 * np.pi * np.arange(_CORNERS) / _CORNERS
        circle = np.stack([np.cos(angles), np.sin(angles)])
        around = (vectors * axis[:, None]) @ circle
        middle = scale * (places - low)
        corners = (middle[..., None] + around).swapaxes(1, 2)
        corners[..., 1] = _FINE * window.size[1] - corners[..., 1]
        fill = np.concatenate(
            [255.0 * self.elements.colors[numbers], 255.0 * _STRENGTH * self.elements.opacities[numbers, None]], axis=1
        )
        fill = np.clip(fill, 0.0, 255.0).astype(np.uint8)
        data = b""
        for count in _COUNTS:
            drawn = np.arange(len(numbers))
            if len(drawn) > count:
                drawn = np.sort(np.random.default_rng(0).choice(len(drawn), count, replace=False))
            data = _ellipses(window.size, corners[drawn], fill[drawn])
            if len(data) <= _MOST_BYTES:
                break
        return data


def framed(axes: tuple[int, int], low: Float64, high: Float64, width: int) -> PlotWindow:
    """Return a window around the box with a margin, at one scale for both axes, neither flat nor tall."""
    margin = 0.06 * max(float((high - low).max()), 1e-6)
    low, high = low - margin, high + margin
    across, up = high - low
    shape = min(max(up / across, 0.25), 0.8)
    across, up = max(across, up / shape), max(up, across * shape)
    middle, half = 0.5 * (low + high), 0.5 * np.array([across, up])
    low, high = (middle - half).tolist(), (middle + half).tolist()
    return PlotWindow(axes, (low[0], low[1]), (high[0], high[1]), (width, max(1, round(width * shape))))


def sideways(low: Float64, high: Float64, up: int = 2) -> tuple[int, int]:
    """Return the axes to the right and up of the view from the side: the box's longer horizontal side, and ``up``."""
    first, second = sorted(PLANS[up])
    return (first, up) if high[first] - low[first] >= high[second] - low[second] else (second, up)


def about(
    outside: SceneDrawing | None, axes: tuple[int, int], low: Float64, high: Float64, nearest: float, width: int
) -> PlotWindow:
    """Return a window on the scene that holds the box ``low``, ``high``; without a scene, around the box alone."""
    return framed(axes, low, high, width) if outside is None else outside.window(axes, low, high, nearest, width)


def plane_axes(window: PlotWindow) -> tuple[PlotAxis, PlotAxis]:
    """Return the axes from the plane's coordinates to those of `draw_plane`."""
    (left, _, above, _), (width, height) = _ROOM, window.size
    return (
        PlotAxis(window.low[0], window.high[0], left, left + width, log=False),
        PlotAxis(window.low[1], window.high[1], above + height, above, log=False),
    )


def draw_plane(outside: SceneDrawing | None, window: PlotWindow, nearest: float, marks: str, title: str) -> Markup:
    """Return the SVG of a window: the scene, if ``outside`` draws one, and ``marks`` in `plane_axes` over it.

    ``nearest`` as in `SceneDrawing.picture`.
    """
    (left, right, above, below), (width, height) = _ROOM, window.size
    if outside is not None:
        marks = (
            f'<image x="{left}" y="{above}" width="{width}" height="{height}" preserveAspectRatio="none" '
            f'href="{uri(outside.picture(window, nearest))}"/>{marks}'
        )
    labels = f"{'xyz'[window.axes[0]]} units", f"{'xyz'[window.axes[1]]} units"
    size = width + left + right, height + above + below
    return draw_plot(*plane_axes(window), labels, marks, size=size, title=title)


def behind(outside: SceneDrawing | None, nearest: float, alone: str) -> str:
    """Return a plot's caption on the scene that it shows, or the caption ``alone`` if it shows none."""
    if outside is None:
        return f"The scene has no elements with a place of their own (a NeRF's field has none): {alone}."
    text = "Behind them the opaque Gaussians of the scene, as ellipses of one standard deviation"
    return text + (", without those above the cameras." if np.isfinite(nearest) else ".")


def _ellipses(size: tuple[int, int], corners: Float64, fill: NDArray[np.uint8]) -> bytes:
    """Return a PNG of polygons [n, c, 2] in colours [n, 4], drawn in order."""
    from PIL import Image, ImageDraw

    whole = Image.new("RGB", (_FINE * size[0], _FINE * size[1]), tuple(int(v) for v in _PAPER))
    pen = ImageDraw.Draw(whole, "RGBA")
    for polygon, color in zip(corners.tolist(), fill.tolist(), strict=True):
        pen.polygon([(x, y) for x, y in polygon], fill=tuple(color))
    image = np.asarray(whole.resize(size, Image.Resampling.BOX), np.float64)
    # what is drawn over it is to stand out
    faded = Image.fromarray(((1.0 - _FADED) * image + _FADED * _PAPER).astype(np.uint8))
    return png(faded.quantize(_COLORS, dither=Image.Dither.NONE))
