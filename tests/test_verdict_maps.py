"""What a certificate's page and pictures tell of cells: maps over pairs of parameters, regions, poses along a set."""

from __future__ import annotations

import io
import itertools
import math
import re
from fractions import Fraction
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.report import certificate_page as page
from ns_abstract.report.figures import ShownUnits
from ns_abstract.report.regions import (
    MOST,
    FailureRegion,
    PoseImage,
    cell_at,
    coarse_first,
    direction,
    distances,
    falsified_regions,
    nearest,
    regions_html,
    reported_outputs,
    stops,
    touching,
    walk_html,
)
from ns_abstract.report.regions import MOST_STOPS as STOPS
from ns_abstract.report.verdict_maps import (
    BAD,
    GOOD,
    NONE,
    OPEN,
    PairMaps,
    bin_ends,
    maps_of,
    matrix_rows,
    matrix_svg,
    mixed,
    pair_maps,
    shades,
)
from ns_abstract.report.verdict_picture import clear_pictures, write_pictures
from ns_abstract.verify.cells import CellGrid

KINDS = ("certified", "falsified", "unknown")


def cut(d: int, count: int, seed: int) -> tuple[np.ndarray, np.ndarray, list[str], tuple[np.ndarray, np.ndarray]]:
    """Ends and verdicts of at least ``count`` cells that a grid's search could end with, and the ends of the set."""
    rng = np.random.default_rng(seed)
    low = rng.normal(size=d)
    high = low + rng.uniform(0.1, 3.0, d)
    box = ParameterBox(tuple("abcdefgh"[:d]), ("rad",) * d, tuple(low.tolist()), tuple(high.tolist()))
    grid = CellGrid.adaptive(box, rng.integers(1, 4, d).tolist())
    cells = grid.roots()
    while len(cells) < count:
        cell = cells.pop(int(rng.integers(len(cells))))
        cells += grid.divide(cell, rng.uniform(size=d), 0.5, 2) or [cell]
    boxes = [grid.box_of(cell) for cell in cells]
    lower, upper = (np.array([getattr(box, key) for box in boxes]) for key in ("lower", "upper"))
    kinds = [KINDS[k] for k in rng.choice(3, len(cells), p=(0.6, 0.25, 0.15))]
    return lower, upper, kinds, (low, high)


def exact_share(low: float, high: float, first: float, past: float) -> Fraction:
    """Part of [first, past] that [low, high] takes."""
    return max(Fraction(0), Fraction(min(high, past)) - Fraction(max(low, first))) / (Fraction(past) - Fraction(first))


def exact_map(
    cells: tuple[np.ndarray, np.ndarray], ends: tuple[np.ndarray, np.ndarray], axes: tuple[int, ...], bins: int
) -> np.ndarray:
    """[bins, ...] parts of places along ``axes`` that cells take, as fractions."""
    lines = [bin_ends(*side, bins) for side in zip(*ends, strict=True)]
    found = np.full((bins,) * len(axes), Fraction(0), object)
    for low, high in zip(*cells, strict=True):
        rest = Fraction(1)
        for k in range(len(low)):
            if k not in axes:
                rest *= exact_share(low[k], high[k], ends[0][k], ends[1][k])
        shares = [[exact_share(low[k], high[k], *pair) for pair in itertools.pairwise(lines[k])] for k in axes]
        for place in itertools.product(*(range(bins) for _ in axes)):
            found[place] += math.prod((shares[n][p] for n, p in enumerate(place)), start=rest)
    return found


# ---------------------------------------------------------------- maps over pairs of parameters


@pytest.mark.parametrize(("d", "count", "seed"), [(2, 20, 0), (3, 24, 1), (4, 16, 2), (6, 12, 3)])
def test_parts_are_those_of_the_boxes(d: int, count: int, seed: int) -> None:
    """Against fractions, without a tolerance above: what is told is true, and hardly less than the truth."""
    bins = 5
    lower, upper, kinds, ends = cut(d, count, seed)
    maps = pair_maps(lower, upper, kinds, ends, complete=True, bins=bins)
    assert sorted(maps.certified) == sorted(maps.falsified) == list(itertools.combinations(range(d), 2))
    some = list(maps.certified)[:: max(1, d - 3)]
    for kind, pairs, along in (
        ("certified", maps.certified, maps.along_certified),
        ("falsified", maps.falsified, maps.along_falsified),
    ):
        chosen = np.array([k == kind for k in kinds])
        cells = lower[chosen], upper[chosen]
        wanted = {pair: exact_map(cells, ends, pair, bins) for pair in some}
        wanted |= {(k,): exact_map(cells, ends, (k,), bins) for k in range(d)}
        for axes, parts in wanted.items():
            found = pairs[axes[0], axes[1]] if len(axes) == 2 else along[axes[0]]
            for told, true in zip(found.ravel().tolist(), parts.ravel().tolist(), strict=True):
                assert true - Fraction(1, 10**10) <= Fraction(told) <= true
                # nothing and all are told exactly
                assert (told == 0.0) == (true == 0) and (told == 1.0) == (true == 1)


def test_a_place_is_whole_only_if_nothing_is_missing() -> None:
    lower, upper, _, ends = cut(3, 30, 5)
    kinds = ["certified"] * len(lower)
    maps = pair_maps(lower, upper, kinds, ends, complete=True)
    assert all((m == 1.0).all() for m in maps.certified.values()) and (maps.along_certified == 1.0).all()
    assert not any(m.any() for m in maps.falsified.values())
    # cells that are still open have no rows
    maps = pair_maps(lower, upper, kinds, ends, complete=False)
    assert all((m < 1.0).all() and (m > 1.0 - 1e-9).all() for m in maps.certified.values())
    # of a search that runs and of one that has ended, which lists what is open
    rows = [
        {"lower": a.tolist(), "upper": b.tolist(), "verdict": "certified"} for a, b in zip(lower, upper, strict=True)
    ]
    running = entry("x", "y", "z", open_part=0.5)
    for side, low, high in zip(running["parameters"], *ends, strict=True):
        side["lower"], side["upper"] = low, high
    assert (maps_of(rows, running).certified[0, 1] < 1.0).all()
    assert (maps_of(rows, running | {"cells": {"open": 3}}).certified[0, 1] == 1.0).all()
    # a sliver that breaks the property can be seen
    thin = upper[0].copy()
    thin[0] = lower[0, 0] + 1e-12 * (upper[0, 0] - lower[0, 0])
    rest = lower[0].copy()
    rest[0] = thin[0]
    lower, upper = np.vstack([lower, rest[None]]), np.vstack([thin[None], upper[1:], upper[:1]])
    maps = pair_maps(lower, upper, ["falsified", *kinds], ends, complete=True)
    for parts in maps.falsified.values():
        assert np.count_nonzero(parts) > 0 and (maps.certified[0, 1] < 1.0).any()
    shown = shades(maps.falsified[0, 1], BAD)
    assert (shown[maps.falsified[0, 1] > 0.0] != NONE).any(axis=1).all()
    assert (shown[maps.falsified[0, 1] == 0.0] == NONE).all()


def test_many_cells_are_added_up_in_parts() -> None:
    """The same parts however many cells are looked at together."""
    lower, upper, kinds, ends = cut(3, 9000, 7)
    whole = pair_maps(lower, upper, kinds, ends, complete=True, bins=6)
    total = sum(np.prod((upper - lower) / (ends[1] - ends[0]), axis=1)[np.array(kinds) == "certified"].tolist())
    for pair in whole.certified:
        assert whole.certified[pair].mean() == pytest.approx(total, rel=1e-9)
        others = [
            pair_maps(lower[part], upper[part], [kinds[k] for k in part], ends, complete=False, bins=6).certified[pair]
            for part in np.array_split(np.arange(len(lower)), 3)
        ]
        np.testing.assert_allclose(sum(others), whole.certified[pair], rtol=1e-9, atol=1e-12)


def test_pictures_of_maps_stand_the_right_way() -> None:
    """Certified where the first parameter is large, falsified where the second is small, of three."""
    lower = np.array([[0.5, 0.5, 0.0], [0.0, 0.0, 0.0], [0.0, 0.5, 0.0], [0.5, 0.0, 0.0]])
    upper = lower + np.array([0.5, 0.5, 1.0])
    maps = pair_maps(
        lower, upper, ["certified", "falsified", "unknown", "unknown"], (np.zeros(3), np.ones(3)), complete=True, bins=2
    )
    rows = matrix_rows(maps, 3)
    # below the diagonal: column is the first parameter, row the second, upward is more
    np.testing.assert_array_equal(rows[1][0], [[NONE, GOOD], [NONE, NONE]])
    np.testing.assert_array_equal(rows[0][1], [[NONE, NONE], [BAD, NONE]])
    half = shades(np.array(0.5), GOOD)
    np.testing.assert_array_equal(rows[2][0], [[NONE, half], [NONE, half]])
    half = shades(np.array(0.5), BAD)
    np.testing.assert_array_equal(rows[0][2], [[NONE, NONE], [half, half]])
    # along the first: red in its lower half, from above; green in its upper, from below
    np.testing.assert_array_equal(rows[0][0], [[BAD, OPEN], [OPEN, GOOD]])
    two = PairMaps(
        {(0, 1): maps.certified[0, 1]},
        {(0, 1): maps.falsified[0, 1]},
        maps.along_certified[:2],
        maps.along_falsified[:2],
    )
    np.testing.assert_array_equal(mixed(two), [[OPEN, GOOD], [BAD, OPEN]])


def entry(*names: str, index: int = 0, high: float = 6.0, open_part: float = 0.0) -> dict[str, Any]:
    """A frame of report.json."""
    covered = {"certified": 0.5, "falsified": 0.25, "unknown": 0.25, "not_examined": open_part}
    sides = [{"name": n, "unit": "rad", "lower": 0.0, "upper": high} for n in names]
    return {"index": index, "parameters": sides, "coverage": covered, "cells": {"open": 0}}


def cells(d: int, high: float = 6.0) -> list[dict[str, Any]]:
    """Four cells side by side along the first parameter."""
    kinds = ("certified", "falsified", "falsified", "unknown")
    step = high / 4
    return [
        {
            "lower": [step * k, *[0.0] * (d - 1)], "upper": [step * (k + 1), *[high] * (d - 1)], "verdict": kind,
            "margin": {"certified": 0.25, "falsified": -0.5 - k, "unknown": None}[kind],
            "counterexample": [step * (k + 0.5), *[high / 3] * (d - 1)] if kind == "falsified" else None,
        }
        for k, kind in enumerate(kinds)
    ]  # fmt: skip


@pytest.mark.parametrize(("d", "pairs"), [(3, 3), (6, 15)])
def test_every_pair_has_a_map_on_the_page(d: int, pairs: int) -> None:
    names = [f"<{k}>" for k in range(d)]
    fixed = entry("still", *names)
    fixed["parameters"][0]["upper"] = 0.0
    rows = [r | {"lower": [0.0, *r["lower"]], "upper": [0.0, *r["upper"]]} for r in cells(d)]
    maps = maps_of(rows, fixed)
    assert len(maps.certified) == pairs
    plot = ElementTree.fromstring(matrix_svg(maps, fixed["parameters"][1:]).replace(" href", " xlink"))
    images = plot.findall("image")
    assert len(images) == d * d
    titles = [image.findtext("title") or "" for image in images]
    assert sum(t.startswith("certified") for t in titles) == sum(t.startswith("falsified") for t in titles) == pairs
    # side by side, none over another or out of sight
    places = [tuple(float(image.get(key, "nan")) for key in ("x", "y", "width", "height")) for image in images]
    width, height = float(plot.get("width", "nan")), float(plot.get("height", "nan"))
    assert width <= 800 and all(x + w <= width and y + h <= height for x, y, w, h in places)
    for (x, y, w, h), (a, b, *_) in itertools.combinations(places, 2):
        assert abs(x - a) >= w or abs(y - b) >= h
    [(text, shown)], more = page._matrices([fixed], {0: rows})
    assert shown is fixed and more == 0
    assert text.count("<image") == d * d and "<0>" not in text and "&lt;0&gt;" in text
    assert page._matrices([entry("x", "y")], {0: cells(2)}) == ([], 0)


def test_of_many_frames_those_certified_least_have_maps() -> None:
    frames = [entry("x", "y", "z", index=k) for k in range(6)]
    for k, one in enumerate(frames):
        one["coverage"] = one["coverage"] | {"certified": 0.9 - 0.1 * (k % 3)}
    found, more = page._matrices(frames, {k: cells(3) for k in range(6)})
    assert [shown["index"] for _, shown in found] == [1, 2, 4, 5] and more == 2


# ---------------------------------------------------------------- the map of verdicts


def drawn(frames: list[dict[str, Any]], rows: dict[int, Any], numbers: Any = None) -> str:
    """All drawings of where verdicts are."""
    maps, several = page.verdict_drawings(frames, rows, numbers or {})
    return "".join(str(svg) for svg, *_ in (*maps, *several))


def test_counterexamples_are_marked_where_they_are() -> None:
    frame = entry("x", "y")
    plot = page._plane(cells(2), frame, [0, 1], {})
    assert "x (rad)" in plot and "y (rad)" in plot
    (path,) = re.findall(r'class="broken" d="([^"]*)"', plot)
    found = [(float(a) + 2.5, float(b) + 2.5) for a, b in re.findall(r"M([\d.]+),([\d.]+)", path)]
    # from 58 to 438 across, from 400 up to 20
    np.testing.assert_allclose(found, [(58 + 380 * v / 6, 400 - 380 * 2 / 6) for v in (2.25, 3.75)], atol=0.06)
    rings = drawn([entry("azimuth")], {0: cells(1)})
    ticks = [np.array(t.split(","), float) for t in re.findall(r'class="broken" d="M([^L]*)L', rings)]
    angles = [np.arctan2(170 - y, x - 170) % (2 * np.pi) for x, y in ticks]
    np.testing.assert_allclose(angles, [2.25, 3.75], atol=1e-3)
    # a short arc would hardly be seen as a ring
    arc = drawn([entry("azimuth", high=0.4)], {0: cells(1, 0.4)})
    assert "Verdicts along azimuth" in arc and arc.count('class="broken"') == 2


def test_axes_are_in_the_units_that_were_asked_for() -> None:
    frame, rows = entry("yaw", "x", high=0.5), cells(2, 0.5)
    frame["parameters"][1]["unit"] = "normalised units"
    units = ShownUnits("dataset", "degrees", 0.25)
    shown, leaves = units.drawn(frame, rows)
    (strip,), (plain,) = ([svg for svg, *_ in page.verdict_drawings([e], {0: r}, {})[0]] for e, r in
                          ((shown, leaves), (frame, rows)))  # fmt: skip
    assert "yaw (degrees)" in strip and "x (units of the data set)" in strip and "yaw (rad)" in plain
    # the same drawing but for what stands at the axes
    assert re.findall(r"<(?:rect|path)[^>]*class=.(?:certified|falsified|broken)[^>]*>", strip) != []
    np.testing.assert_allclose(shown["parameters"][0]["upper"], math.degrees(0.5))
    np.testing.assert_allclose(leaves[1]["counterexample"], [math.degrees(0.1875), 4 * 0.5 / 3])
    assert rows == cells(2, 0.5) and leaves[0]["counterexample"] is None
    assert stops([frame], {0: rows}, units)[-1].at == "frame 0, yaw = 28.65 degrees"
    assert units.value("yaw", "rad", 0.5) == "yaw = 0.5 (28.6479 degrees)"
    # a ring stays one
    ring = entry("azimuth")
    assert units.drawn(ring, cells(1))[0] == ring


def test_a_path_is_one_strip() -> None:
    frames = [entry("segment", index=k, high=1.0) for k in (0, 2, 3)]
    document = {"frames": frames}
    rows = {k: cells(1, 1.0) for k in (0, 2, 3)}
    numbers = page._numbered(document, rows)
    text = drawn(frames, rows, numbers)
    assert text.count("<svg") == 1 and "Verdicts along the path" in text and text.count("<rect") == 12
    starts = [float(x) for x in re.findall(r'<rect class="certified" data-cell="\d+" x="([\d.]+)"', text)]
    np.testing.assert_allclose(starts, [20 + 980 * k / 3 for k in range(3)], atol=0.01)
    assert sorted(map(int, re.findall(r'data-cell="(\d+)"', text))) == list(range(12))
    # the last keyframe is a single pose
    end = [*frames, entry("segment", index=4, high=0.0)]
    one = {"lower": [0.0], "upper": [0.0], "verdict": "falsified", "margin": -1.0, "counterexample": [0.0]}
    text = drawn(end, rows | {4: [one]})
    assert text.count("<svg") == 1 and text.count("<rect") == 13 and text.count('class="broken"') == 7
    x, width = re.findall(r'<rect class="falsified" x="([\d.]+)" y="8" width="([\d.]+)"', text)[-1]
    assert float(x) + float(width) == pytest.approx(1000.0, abs=0.02) and 5.0 < float(width) < 20.0
    # with another parameter every frame has a plot of its own
    other = [*frames[:2], entry("x", index=3, high=1.0)]
    assert drawn(other, rows).count("<svg") == 3


def test_very_many_cells_are_one_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page, "_MOST_CELLS", 3)
    text = page._plane(cells(2), entry("x", "y"), [0, 1], {})
    assert "<rect" not in text and text.count("<image") == 1 and 'class="broken"' in text


# ---------------------------------------------------------------- regions


def brute(lower: np.ndarray, upper: np.ndarray) -> list[set[int]]:
    """Regions by joining all pairs of closed boxes with a common point."""
    found = [{k} for k in range(len(lower))]
    for i, j in itertools.combinations(range(len(lower)), 2):
        if (lower[i] <= upper[j]).all() and (lower[j] <= upper[i]).all():
            (a,), (b,) = ([s for s in found if k in s] for k in (i, j))
            if a is not b:
                found.remove(b)
                a |= b
    return sorted(found, key=min)


@pytest.mark.parametrize("d", [1, 2, 3, 6])
def test_regions_are_what_touches(d: int) -> None:
    for seed in range(4):
        lower, upper, kinds, _ = cut(d, 150, seed)
        some = np.flatnonzero(np.array(kinds) == "falsified")[:: 1 + seed % 2]
        numbers = touching(lower[some], upper[some])
        found = [set(np.flatnonzero(numbers == k).tolist()) for k in range(int(numbers.max()) + 1)]
        assert sorted(found, key=min) == brute(lower[some], upper[some])
    # a corner is enough, a hair is not
    low, high = np.zeros((2, 2)), np.ones((2, 2))
    low[1], high[1] = 1.0, 2.0
    assert touching(low, high).tolist() == [0, 0]
    low[1, 0] = np.nextafter(1.0, 2.0)
    assert touching(low, high).tolist() == [0, 1]


def test_a_long_chain_is_one_region() -> None:
    lower = np.random.default_rng(0).permutation(np.arange(3000.0))[:, None]
    numbers = touching(lower, lower + 1.0)
    assert not numbers.any()


def test_regions_have_their_size_and_worst_counterexample() -> None:
    frame = entry("x", "y")
    rows = cells(2)
    apart = {
        "lower": [5.5, 3.0], "upper": [6.0, 6.0], "verdict": "falsified", "margin": None, "counterexample": [5.75, 4.0],
    }  # fmt: skip
    rows[3]["upper"] = [5.5, 6.0]
    found = falsified_regions([frame, entry("x", "y", index=1)], {0: [*rows, apart], 1: rows})
    assert [(r.frame, r.cells) for r in found] == [(0, (1, 2)), (1, (1, 2)), (0, (4,))]
    assert [r.share for r in found] == pytest.approx([0.5, 0.5, 0.25 / 6])
    assert found[0].lower == (1.5, 0.0) and found[0].upper == (4.5, 6.0)
    assert found[0].margin == -2.5 and found[0].pose == (3.75, 2.0)
    # what is no number is worse than all
    assert found[2].margin is None
    single = {"lower": [0.0], "upper": [0.0], "verdict": "falsified", "margin": -1.0, "counterexample": [0.0]}
    one = entry("x", high=0.0)
    single_last = falsified_regions([one, entry("x", index=1)], {0: [single], 1: cells(1)})
    assert [(r.frame, r.share) for r in single_last] == [(1, 0.5), (0, 1.0)]


def test_the_nearest_certified_pose() -> None:
    """Against many poses of all certified cells, with parameters of very different ranges."""
    rng = np.random.default_rng(4)
    lower, upper, kinds, (low, high) = cut(3, 80, 9)
    scale = np.array([1.0, 1e-3, 50.0])
    lower, upper, low, high = (v * scale for v in (lower, upper, low, high))
    sides = [{"lower": a, "upper": b} for a, b in zip(low, high, strict=True)]
    rows = [
        {"lower": a.tolist(), "upper": b.tolist(), "verdict": v} for a, b, v in zip(lower, upper, kinds, strict=True)
    ]
    proved = [k for k, kind in enumerate(kinds) if kind == "certified"]
    for _ in range(20):
        pose = rng.uniform(low, high)
        ((k, near),) = nearest(rows, "certified", pose.tolist(), sides)
        assert kinds[k] == "certified" and (lower[k] <= near).all() and (near <= upper[k]).all()
        least = distances(np.array([near]), pose.tolist(), sides)[0]
        others = rng.uniform(lower[proved], upper[proved], (200, len(proved), 3)).reshape(-1, 3)
        assert least <= distances(others, pose.tolist(), sides).min()
        several = nearest(rows, "certified", pose.tolist(), sides, 5)
        away = [distances(np.array([p]), pose.tolist(), sides)[0] for _, p in several]
        assert len(several) == 5 and several[0] == (k, near) and away == sorted(away)
    assert nearest(rows[:0], "certified", [0.0] * 3, sides) == []
    # a parameter that stands still does not count
    sides[1]["upper"] = sides[1]["lower"]
    assert np.isfinite(distances(lower, low.tolist(), sides)).all()


def shown(values: list[float], margin: float | None, outputs: list[float], title: str = "one") -> PoseImage:
    red = io.BytesIO()
    Image.new("RGB", (4, 4), (200, 10, 10)).save(red, "png")
    return PoseImage(title, values, red.getvalue(), outputs, margin)


def test_regions_on_the_page() -> None:
    frame = entry("x", "<y>")
    regions = [
        FailureRegion(0, (1, 2), 0.5 - 0.01 * k, (1.0, 0.0), (4.0, 6.0), (3.0, 2.0), -1.0) for k in range(MOST + 3)
    ]  # fmt: skip
    pictures = [
        (shown([3.0, 2.0], -1.0, [0.5, 2.0], "counterexample"), shown([1.0, 2.0], 0.25, [1.5, 2.5], "<right>")),
        (shown([3.0, 2.0], None, [float("nan"), 2.0], "counterexample"), None),
    ]
    text = regions_html(regions, pictures, {0: frame["parameters"]}, ": <why>")
    assert text.count("<img") == 3 and text.count('class="region"') == 2 and "<y>" not in text and "<right>" not in text
    assert f"make {MOST + 3} regions" in text and "7 further regions, none of them larger: &lt;why&gt;." in text
    assert "50.00 % of its set in 2 cells: x ∈ [1, 4] rad ([57.2958, 229.183] degrees)" in text
    assert "margin not a number" in text
    assert "&lt;y&gt; = 2 (same)" in text and "x = 1<br>" not in text and "No pose of its own set" in text
    assert "<td>0.5</td><td>1.5</td>" in text and "not finite" in text
    assert regions_html([], [], {}, "") == ""
    ElementTree.fromstring(f"<part>{re.sub(r'(<img[^>]*|<br)>', r'', text)}</part>")


def test_outputs_that_differ_most_are_told() -> None:
    broken, right = np.zeros(30), np.zeros(30)
    right[[3, 20]] = 1.0, -2.0
    broken[7] = np.nan
    assert reported_outputs(broken.tolist(), right.tolist(), 3) == [3, 7, 20]
    assert reported_outputs([0.5, 1.5], [0.5, 0.5]) == [0, 1]
    assert reported_outputs([0.5, -3.0, 1.0], None, 2) == [1, 2]


# ---------------------------------------------------------------- along a set


def test_stops_are_spread_along_the_set() -> None:
    # one direction, the others in the middle, ends included
    frame = entry("x", "y")
    found = stops([frame], {0: cells(2)})
    assert len(found) == STOPS and {s.values[1] for s in found} == {3.0}
    assert found[0].values[0] == 0.0 and found[-1].values[0] == 6.0
    np.testing.assert_allclose(np.diff([s.values[0] for s in found]), 6.0 / (STOPS - 1))
    assert [s.verdict for s in found] == [cell_at(cells(2), s.values)["verdict"] for s in found]  # type: ignore[index]
    assert {s.proven for s in found if s.verdict == "certified"} == {0.25}
    assert {s.proven for s in found if s.verdict != "certified"} == {None}
    # around an orbit its beginning comes once
    around = stops([entry("x", "azimuth", high=2.0 * np.pi)], {0: cells(2, 2.0 * np.pi)})
    assert direction(entry("x", "azimuth", "segment")["parameters"]) == 2
    angles = [s.values[1] for s in around]
    assert len(around) == STOPS and angles[0] == 0.0
    np.testing.assert_allclose(np.diff(angles), 2.0 * np.pi / STOPS)
    # along a path every keyframe comes once
    way = [entry("segment", index=k, high=1.0) for k in range(3)]
    along = stops(way, {k: cells(1, 1.0) for k in range(3)})
    places = [s.frame + s.values[0] for s in along]
    assert len(places) == len(set(places)) == STOPS and places == sorted(places) and places[-1] == 3.0
    # of many frames some, from the first to the last
    many = stops([entry(index=k) for k in range(100)], {k: cells(1) for k in range(100)})
    assert len(many) == STOPS and many[0].frame == 0 and many[-1].frame == 99
    # frames without cells are told, too
    assert [s.verdict for s in stops([frame], {})] == ["unknown"] * STOPS


def test_a_pose_between_cells_is_certified_if_one_of_them_is() -> None:
    rows = cells(1)
    assert cell_at(rows, [1.5]) is rows[0] and cell_at(rows, [1.6]) is rows[1] and cell_at(rows, [4.5]) is rows[2]
    assert cell_at(rows, [6.1]) is None and cell_at([], [0.0]) is None


@pytest.mark.parametrize("count", [1, 2, 5, 8, 24])
def test_every_beginning_is_spread(count: int) -> None:
    order = coarse_first(count)
    assert sorted(order) == list(range(count))
    for length in range(2, count + 1):
        gaps = np.diff([0, *sorted(order[:length]), count])
        assert gaps.max() <= 4 * count / length + 1


def test_the_slider_on_the_page() -> None:
    frame = entry("x")
    frame["parameters"][0]["name"] = "<x>"
    found = [(s, shown(list(s.values), 0.5, [1.0])) for s in stops([frame], {0: cells(1)}, most=8)]
    text = walk_html(found)
    assert text.count("<figure") == 8 and "<x>" not in text and "&lt;x&gt; = 6 rad" in text
    marks = re.findall(r'<i class="(\w+)-back">', text)
    assert marks == [s.verdict for s, _ in found] and "at least 0.25 everywhere in its cell" in text
    assert text.count("at least") == marks.count("certified")
    assert walk_html(found[:1]) == ""


# ---------------------------------------------------------------- pictures to keep


def test_pictures_are_written_and_those_of_others_are_left(tmp_path: Path) -> None:
    frames = [
        entry("azimuth"),
        entry("x", index=1),
        entry("x", "y", index=2),
        entry("x", "y", "z", index=3),
        entry(index=4),
    ]
    rows = {k: cells(max(1, k)) for k in range(4)} | {4: [{"lower": [], "upper": [], "verdict": "certified"}]}
    covered = frames[0]["coverage"]
    names = write_pictures(tmp_path, {"scene": {}, "frames": frames, "coverage": covered}, rows, None)
    assert names == [f"verdicts_{k:05d}.svg" for k in range(4)] == sorted(f.name for f in tmp_path.iterdir())
    for name in names:
        drawn = ElementTree.parse(tmp_path / name).getroot()
        kinds = [mark.get("class") for mark in drawn.iter() if mark.tag.rsplit("}", 1)[1] in ("rect", "path")]
        # beside the legend's
        wanted = 1 if name == names[-1] else 2
        assert all(kinds.count(kind) >= wanted for kind in ("certified", "falsified", "unknown")), name
    way = [entry("segment", index=k, high=1.0) for k in range(3)]
    clear_pictures(tmp_path)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "mine.png").write_bytes(b"")
    (tmp_path / "cameras.svg").symlink_to(tmp_path / "mine.png")
    way[2]["parameters"][0]["upper"] = 0.0
    rows = {0: cells(1, 1.0), 1: cells(1, 1.0), 2: [{"lower": [0.0], "upper": [0.0], "verdict": "unknown"}]}
    rows[2][0]["counterexample"] = None
    names = write_pictures(tmp_path, {"scene": {}, "frames": way, "coverage": covered}, rows, None)
    assert names == ["verdicts_path.svg"]
    clear_pictures(tmp_path)
    assert sorted(f.name for f in tmp_path.iterdir()) == ["cameras.svg", "mine.png"]
