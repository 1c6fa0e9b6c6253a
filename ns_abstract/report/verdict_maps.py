"""Maps of verdicts over pairs of parameters: certified and falsified fractions, exact from the cells' boxes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import combinations
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from ns_abstract.report.figures import number, unit_of_axis
from ns_abstract.report.html import uri
from ns_abstract.report.picture import png
from ns_abstract.report.svg import draw_svg

Float64 = NDArray[np.float64]

#: Places along a parameter; cells that are looked at together.
BINS, _TOGETHER = 24, 4096
#: Relative roundings of one term: of four differences and quotients by axis, and of their products; doubled.
_AXIS_ROUNDINGS = 10
_UNIT = float(np.finfo(np.float64).eps)
#: Colours of all, of nothing, and how strong what is hardly there and what is nearly all are.
GOOD, BAD, OPEN, NONE = (29, 116, 64), (179, 38, 30), (154, 160, 166), (250, 250, 247)
_LEAST, _MOST = 0.1, 0.85
#: Pixels of the whole matrix, between its maps, and beside them.
_WIDTH, _GAP, LEFT, _BELOW, _TOP, _PANEL = 760, 10, 62, 34, 8, 190


@dataclass(frozen=True)
class PairMaps:
    """Certified and falsified fractions of a set's volume by bin; none exceeds the true one.

    Those of a pair (i, j), i < j, of parameters are [bins, bins], the bin of i first: fractions of the volume over the
    other parameters. ``along_certified`` and ``along_falsified`` [d, bins] are those of single parameters.
    """

    certified: Mapping[tuple[int, int], Float64]
    falsified: Mapping[tuple[int, int], Float64]
    along_certified: Float64
    along_falsified: Float64


def bin_ends(low: float, high: float, bins: int) -> Float64:
    """Return ends [bins + 1] of equal bins of an interval, whose own ends are the first and the last."""
    ends = low + (high - low) * (np.arange(bins + 1) / bins)
    ends[-1] = high
    return ends


def overlaps(lower: Float64, upper: Float64, ends: Float64) -> Float64:
    """Return the fraction [n, bins] of every bin, between ``ends``, that intervals [n] to [n] cover."""
    shared = np.minimum(upper[:, None], ends[1:]) - np.maximum(lower[:, None], ends[:-1])
    return np.maximum(shared, 0.0) / (ends[1:] - ends[:-1])


def pair_maps(
    lower: Float64,
    upper: Float64,
    verdicts: Sequence[str],
    ends: tuple[Float64, Float64],
    *,
    complete: bool,
    bins: int = BINS,
) -> PairMaps:
    """Return certified and falsified fractions of every bin of two parameters, and of one (docs/dev/design.md, V16).

    ``lower`` and ``upper`` [n, d] are ends of disjoint cells, ``verdicts`` [n] "certified", "falsified" or anything
    else; ``ends`` [d], [d] are those of the set, each of positive width. Fractions are rounded down, but are exactly 1
    where cells of one verdict fill the bin.
    """
    count, d = lower.shape
    low, high = ends
    lines = [bin_ends(low[k], high[k], bins) for k in range(d)]
    pairs = list(combinations(range(d), 2))
    kinds = np.array([0 if v == "certified" else 1 if v == "falsified" else 2 for v in verdicts], np.int64)
    both = np.zeros((3, len(pairs), bins, bins))
    one = np.zeros((3, d, bins))
    for first in range(0, count, _TOGETHER):
        for kind in range(3):
            cells = first + np.flatnonzero(kinds[first : first + _TOGETHER] == kind)
            part = (upper[cells] - lower[cells]) / (high - low)
            shares = [overlaps(lower[cells, k], upper[cells, k], lines[k]) for k in range(d)]
            for k in range(d):
                one[kind, k] += np.delete(part, k, axis=1).prod(axis=1) @ shares[k]
            for n, (i, j) in enumerate(pairs):
                others = np.delete(part, (i, j), axis=1).prod(axis=1)
                both[kind, n] += (others[:, None] * shares[i]).T @ shares[j]
    slack = (count + _AXIS_ROUNDINGS * (d + 2)) * _UNIT
    pair = [_downward(both, kind, slack, complete) for kind in (0, 1)]
    along = [_downward(one, kind, slack, complete) for kind in (0, 1)]
    return PairMaps(dict(zip(pairs, pair[0], strict=True)), dict(zip(pairs, pair[1], strict=True)), along[0], along[1])


def _downward(parts: Float64, kind: int, slack: float, complete: bool) -> Float64:
    """Return lower bounds of one verdict's fractions; ``parts`` [3, ...] are computed fractions by verdict."""
    # no term is negative: a sum is 0 only where nothing of that verdict is
    others = np.delete(parts, kind, axis=0).sum(axis=0)
    whole = (others == 0.0) & complete
    return np.where(whole, 1.0, np.minimum(parts[kind], 1.0) * (1.0 - slack))


def shades(parts: Float64, color: tuple[int, int, int]) -> NDArray[np.uint8]:
    """Return colours [..., 3] of fractions, in which 0, nearly 0, nearly 1 and 1 can be told apart."""
    strength = np.where(parts >= 1.0, 1.0, _LEAST + (_MOST - _LEAST) * parts)
    strength = np.where(parts > 0.0, strength, 0.0)[..., None]
    mixed = (1.0 - strength) * np.array(NONE, np.float64) + strength * np.array(color, np.float64)
    return np.rint(mixed).astype(np.uint8)


def matrix_rows(maps: PairMaps, d: int) -> list[list[NDArray[np.uint8]]]:
    """Return pictures [d][d], the first parameter's column at the left and its row at the top; larger values are up.

    Certified fractions are below the diagonal, falsified ones above it; on it are both, along one parameter.
    """

    def picture(row: int, column: int) -> NDArray[np.uint8]:
        if row == column:
            return _profile(maps.along_certified[row], maps.along_falsified[row])
        key = min(row, column), max(row, column)
        parts = maps.certified[key] if row > column else maps.falsified[key]
        # rows of a picture: the row's parameter, from the top down
        parts = parts.T if row > column else parts
        return shades(parts[::-1], GOOD if row > column else BAD)

    return [[picture(row, column) for column in range(d)] for row in range(d)]


def _profile(certified: Float64, falsified: Float64) -> NDArray[np.uint8]:
    """Return a picture of columns, green from below and red from above, grey between."""
    bins = len(certified)
    level = (np.arange(bins)[::-1, None] + 0.5) / bins
    image = np.full((bins, bins, 3), OPEN, np.uint8)
    image[level < certified] = GOOD
    image[level > 1.0 - falsified] = BAD
    return image


def pixels(image: NDArray[np.uint8]) -> bytes:
    """Return an image as PNG without scaling."""
    from PIL import Image

    return png(Image.fromarray(image))


def mixed(maps: PairMaps) -> NDArray[np.uint8]:
    """Return a picture [bins, bins, 3] over two parameters of the verdicts' colours, mixed by fractions."""
    good, bad = maps.certified[0, 1], maps.falsified[0, 1]
    parts = np.stack([good, bad, np.maximum(1.0 - good - bad, 0.0)], axis=-1)
    colors = parts @ np.array([GOOD, BAD, OPEN], np.float64)
    return np.rint(np.clip(colors, 0.0, 255.0)).astype(np.uint8).swapaxes(0, 1)[::-1]


def free_parameters(parameters: Sequence[Mapping[str, Any]]) -> list[int]:
    """Return the numbers of the parameters that vary."""
    return [k for k, p in enumerate(parameters) if p["lower"] < p["upper"]]


def maps_of(rows: Sequence[Mapping[str, Any]], entry: Mapping[str, Any], bins: int = BINS) -> PairMaps:
    """Return the maps of a frame of report.json over its varying parameters, from its cells."""
    parameters = entry["parameters"]
    free = free_parameters(parameters)
    lower, upper = (np.array([row[key] for row in rows], np.float64)[:, free] for key in ("lower", "upper"))
    ends = tuple(np.array([parameters[k][key] for k in free], np.float64) for key in ("lower", "upper"))
    # a search that has ended lists what is open, all of it at once, as unknown
    complete = entry["coverage"]["not_examined"] == 0.0 or entry["cells"]["open"] > 0
    return pair_maps(lower, upper, [row["verdict"] for row in rows], (ends[0], ends[1]), complete=complete, bins=bins)


def matrix_svg(maps: PairMaps, parameters: Sequence[Mapping[str, Any]]) -> Markup:
    """Return the maps of all pairs of ``parameters`` (their names, units and ends) as one plot."""
    pictures = {
        (i, j): (picture, "along" if i == j else "certified" if i > j else "falsified")
        for i, row in enumerate(matrix_rows(maps, len(parameters)))
        for j, picture in enumerate(row)
    }

    def labels(k: int, x: float, y: float, panel: int, bottom: float) -> list[str]:
        p = parameters[k]
        label = escape(f"{p['name']} ({unit_of_axis(p['unit'])})")
        low, high = number(p["lower"], 3), number(p["upper"], 3)
        middle = x + 0.5 * panel
        return [
            f'<text x="{x}" y="{bottom + 13}">{low}</text>',
            f'<text x="{x + panel}" y="{bottom + 13}" text-anchor="end">{high}</text>',
            f'<text x="{middle:.0f}" y="{bottom + 28}" text-anchor="middle">{label}</text>',
            f'<text x="{LEFT - 4}" y="{y + panel}" text-anchor="end">{low}</text>',
            f'<text x="{LEFT - 4}" y="{y + 9}" text-anchor="end">{high}</text>',
            f'<text x="{LEFT - 4}" y="{y + 0.5 * panel + 4:.0f}" text-anchor="end">{escape(str(p["name"]))}</text>',
        ]

    return pairs_svg("Verdicts over pairs of parameters", parameters, pictures, labels)


def pairs_svg(
    title: str,
    parameters: Sequence[Mapping[str, Any]],
    pictures: Mapping[tuple[int, int], tuple[NDArray[np.uint8], str]],
    labels: Callable[[int, float, float, int, float], list[str]],
) -> Markup:
    """Return a square of maps by pairs of parameters as SVG.

    ``pictures``: by row and column, a map and its title. ``labels``: returns SVG of a parameter's labels; it takes the
    parameter's number, the start of its map on the diagonal, the side of a map, and the lower end of the square.
    """
    d = len(parameters)
    panel = min(_PANEL, (_WIDTH - LEFT - (d - 1) * _GAP) // d)
    step = panel + _GAP
    marks = []
    for (row, column), (picture, what) in pictures.items():
        names = escape(f"{parameters[row]['name']} over {parameters[column]['name']}")
        place = f'x="{LEFT + column * step}" y="{_TOP + row * step}" width="{panel}" height="{panel}"'
        marks.append(
            f'<image class="pixels" {place} preserveAspectRatio="none" href="{uri(pixels(picture))}">'
            f'<title>{what}: {names}</title></image><rect class="frame" {place}/>'
        )
    bottom = _TOP + d * step - _GAP
    for k in range(d):
        marks += labels(k, LEFT + k * step, _TOP + k * step, panel, bottom)
    return draw_svg(LEFT + d * step - _GAP + 8, bottom + _BELOW, title, "".join(marks), kind="pairs")
