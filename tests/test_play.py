"""Reports that one can play with: what the page shows of a pose is what the frame's file says, rounded outward."""

from __future__ import annotations

import base64
import json
import re
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import Browser, chromium, until
from test_report import Reader, frame, run

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.refine.result import FrameResult, Leaves, SampleImages
from ns_abstract.report import play
from ns_abstract.report.certificate import certificate_document
from ns_abstract.report.certificate_page import CertificateDetails, certificate_page
from ns_abstract.report.files import load_frame, save_frame
from ns_abstract.report.picture import preview
from ns_abstract.report.play import play_data
from ns_abstract.report.record import Report
from ns_abstract.report.regions import PoseImage, stops
from ns_abstract.report.run import CommandRun

SIDE = 16
LARGE = 10**9
#: Of what the page shows of small pictures.
STEP = 1e-4


def sloped(height: int = 20, width: int = 24, d: int = 2, seed: int = 0) -> FrameResult:
    """A frame whose every value is ``b + A p`` for p in [-1, 1]^d; leaves are the halves of each parameter's range."""
    rng = np.random.default_rng(seed)
    middle = rng.uniform(0.3, 0.7, (height, width, 3))
    slope = rng.uniform(-0.25, 0.25, (height, width, 3, d)) / d
    names, units = ("x", "yaw", "roll")[:d], ("normalised units", "rad", "rad")[:d]
    box = ParameterBox(names, units, (-0.5,) * d, (1.5,) * d)
    rows = []
    for corner in np.ndindex(*(2,) * d):
        center = np.array(corner) - 0.5
        for top in range(0, height, SIDE):
            for left in range(0, width, SIDE):
                inner = tuple(
                    np.clip(np.arange(start, start + SIDE), 0, size - 1)
                    for start, size in ((top, height), (left, width))
                )
                A, b = slope[np.ix_(*inner)] * 0.5, (middle + slope @ center)[np.ix_(*inner)]
                low, high = np.array(box.at(center - 0.5)), np.array(box.at(center + 0.5))
                rows.append((low, high, (top, left), A, b - 0.003, A, b + 0.002))
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    leaves = Leaves(columns[0], columns[1], columns[2].astype(np.int32), *(c.astype(np.float32) for c in columns[3:]))
    values = np.array([box.at(np.full(d, scaled)) for scaled in (-1.0, 0.0, 1.0)])
    poses = np.stack([middle + slope @ (values[k] - 0.5) for k in range(3)]).astype(np.float32)
    reach = np.abs(slope).sum(axis=-1)
    return frame(
        0,
        height,
        width,
        box=box,
        image=poses[1],
        lower=(middle - reach - 0.004).astype(np.float32),
        upper=(middle + reach + 0.003).astype(np.float32),
        witness_lower=poses.min(axis=0),
        witness_upper=poses.max(axis=0),
        leaves=leaves,
        views=SampleImages(values, poses),
    )


def bounds_at(result: FrameResult, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[H, W, 3] linear bounds of the leaves at a pose, cut off at the frame's."""
    leaves = result.leaves
    assert leaves is not None
    lower, upper = result.lower.astype(np.float64), result.upper.astype(np.float64)
    height, width = lower.shape[:2]
    for k in np.flatnonzero(((leaves.box_lower <= values) & (values <= leaves.box_upper)).all(axis=1)):
        scaled = 2.0 * (values - leaves.box_lower[k]) / (leaves.box_upper[k] - leaves.box_lower[k]) - 1.0
        (top, left), s = leaves.tile[k], slice(None)
        rows, columns = slice(top, min(top + SIDE, height)), slice(left, min(left + SIDE, width))
        inner = (slice(0, rows.stop - top), slice(0, columns.stop - left), s)
        low = (leaves.A_lower[k].astype(np.float64) @ scaled + leaves.b_lower[k])[inner]
        high = (leaves.A_upper[k].astype(np.float64) @ scaled + leaves.b_upper[k])[inner]
        lower[rows, columns] = np.maximum(lower[rows, columns], low)
        upper[rows, columns] = np.minimum(upper[rows, columns], high)
    return lower, upper


def unpacked(text: str) -> dict[str, Any]:
    """What the page reads."""
    head, _, rest = zlib.decompress(base64.b64decode(text)).partition(b"\n")
    found, at = json.loads(head), 0
    for entry in found["arrays"]:
        kind = np.dtype("<" + entry["type"])
        count = int(np.prod(entry["shape"]))
        planes = np.frombuffer(rest, np.uint8, count * kind.itemsize, at).reshape(kind.itemsize, count)
        at += planes.size
        found[entry["name"]] = np.ascontiguousarray(planes.T).view(kind).reshape(entry["shape"])
    assert at == len(rest)
    for name, axis in (("lower", 1), ("image", 1), ("view_images", 0)):
        if name in found:
            found[name] = np.cumsum(found[name], axis=axis, dtype=found[name].dtype)
    for name, base in (("upper", "lower"), ("witness_lower", "lower"), ("witness_upper", "upper")):
        found[name] = found[name] + found[base]
    if "slope" in found:
        slope, offset, tile = found["slope"], found["offset"], found["tile"].tolist()
        for leaf in range(len(tile)):
            if leaf and slope.shape[1] == 1 and tile[leaf] == tile[leaf - 1]:
                slope[leaf] += slope[leaf - 1]
                offset[leaf] += offset[leaf - 1] + slope[leaf, 0] + slope[leaf - 1, 0]
            else:
                slope[leaf], offset[leaf] = (np.cumsum(a[leaf], axis=-1, dtype=np.int16) for a in (slope, offset))
        found |= {f"{name}_more": found[f"{name}_more"] + found[name] for name in ("slope", "offset")}
    return found


def stored_bounds(found: dict[str, Any], leaf: int, scaled: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[3, s, s] linear bounds of a leaf as they stand in the page."""
    pairs = (("slope", "offset"), ("slope_more", "offset_more"))
    low, high = (
        (np.tensordot(scaled, found[a][leaf].astype(np.float64), 1) + found[b][leaf]) / found["cell_steps"]
        for a, b in pairs
    )
    return low, high


@pytest.mark.parametrize("steps", [10_000, 1000, 100])
@pytest.mark.parametrize("d", [1, 2, 3])
def test_numbers_of_the_page_enclose_those_of_the_file(d: int, steps: int, monkeypatch: pytest.MonkeyPatch) -> None:
    result, rng = sloped(d=d, seed=d), np.random.default_rng(steps)
    monkeypatch.setattr(play, "LEVELS", ((10_000, steps),))
    leaves = result.leaves
    assert leaves is not None
    # an upper slope of zero, bounds that cross nothing and say nothing, numbers that no step can hold
    leaves.A_upper[0] = 0.0
    leaves.A_lower[1] *= -1.0
    leaves.b_upper[1] += 1.3
    leaves.b_lower[2] = -40.0
    leaves.A_upper[2, :, :, 0] = 1e9
    text = play_data(result, LARGE)
    assert text is not None
    found = unpacked(text)
    places = {(*tile, *box): leaf for leaf, (tile, box) in enumerate(
        zip(leaves.tile.tolist(), leaves.box_lower.tolist(), strict=True))}  # fmt: skip
    worst = 0.0
    for row, (tile, box) in enumerate(zip(found["tile"].tolist(), found["box_lower"].tolist(), strict=True)):
        leaf = places[(*tile, *box)]
        np.testing.assert_array_equal(found["box_upper"][row], leaves.box_upper[leaf])
        for scaled in (*rng.uniform(-1.0, 1.0, (6, d)), np.ones(d), -np.ones(d)):
            low, high = (
                (A[leaf].astype(np.float64) @ scaled + b[leaf]).transpose(2, 0, 1)
                for A, b in ((leaves.A_lower, leaves.b_lower), (leaves.A_upper, leaves.b_upper))
            )
            stored = stored_bounds(found, row, scaled)
            # pictures lie in [0, 1], whatever the file says
            assert (stored[0] <= np.maximum(low, 0.0)).all() and (stored[1] >= np.minimum(high, 1.0)).all()
            if leaf > 2:
                worst = max(worst, float((low - stored[0]).max()), float((stored[1] - high).max()))
    # half a step by slope, twice where the slope rounds the other way, and one for the offset
    assert 0.0 < worst <= (1.0 + d) / steps + 1e-9


def test_finished_bounds_stand_as_whole_steps() -> None:
    result = sloped()
    found = unpacked(play_data(result, LARGE) or "")
    for name, outward in (
        ("lower", np.floor),
        ("upper", np.ceil),
        ("witness_lower", np.ceil),
        ("witness_upper", np.floor),
    ):
        values = getattr(result, name).astype(np.float64)
        np.testing.assert_array_equal(found[name], outward(values * 1e4))
    assert (found["lower"] * 1e-4 <= result.lower).all() and (
        found["upper"].astype(np.float64) / 1e4 >= result.upper
    ).all()
    assert found["steps"] == 10_000 and found["ends"] == [[-0.5, 1.5]] * 2


def test_what_does_not_fit_is_left_out() -> None:
    result, sizes = sloped(d=1), []
    for level in play.LEVELS:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(play, "LEVELS", (level,))
            sizes.append(len(play_data(result, LARGE) or ""))
    assert sizes[:4] == sorted(sizes[:4], reverse=True) and sizes[-2] > sizes[-1] > 0 and sizes[3] > sizes[-1]
    for size, level in zip(sizes, play.LEVELS, strict=True):
        text = play_data(result, size)
        assert text is not None and len(text) <= size
        found = unpacked(text)
        # the first that fits; a coarser one may fit where a finer one is no larger
        first = next(k for k, other in enumerate(sizes) if other <= size)
        assert (found["steps"], found["cell_steps"]) == play.LEVELS[first] and first <= play.LEVELS.index(level)
    assert play_data(result, min(sizes) - 1) is None
    assert play_data(replace(result, leaves=None), sizes[-1]) is not None


def test_views_are_kept_and_checked(tmp_path: Path) -> None:
    result, file = sloped(), tmp_path / "frame_00000.npz"
    save_frame(file, result)
    stored = load_frame(file).result.views
    assert result.views is not None and stored is not None
    np.testing.assert_array_equal(stored.images, result.views.images)
    np.testing.assert_array_equal(stored.values, result.views.values)
    assert load_frame(file, leaves=False).result.views is None
    outside, elsewhere = result.views.images.copy(), result.views.values.copy()
    outside[1, 3, 4, 0] = result.upper[3, 4, 0] + 1e-3
    elsewhere[0, 0] = -0.6
    for views, problem in (
        (SampleImages(result.views.values, outside), "lies outside the bounds"),
        (SampleImages(elsewhere, result.views.images), "not one of the set"),
        (SampleImages(result.views.values, result.views.images[:, 1:]), "images are"),
        (SampleImages(result.views.values[:, :1], result.views.images), "values are"),
    ):
        with pytest.raises(ValueError, match=problem):
            save_frame(file, replace(result, views=views))


def written(folder: Path, result: FrameResult, **changes: Any) -> str:
    report = Report(folder, run(frames=(0,), **changes))
    report.add(result)
    report.finish("done")
    return (folder / "report.html").read_text()


def test_page_without_cells_or_without_a_guarantee(tmp_path: Path) -> None:
    page = written(tmp_path / "a", replace(sloped(), leaves=None, views=None))
    assert Reader(page).seen.count("script") == 2
    (text,) = re.findall(r'class="play-data">([^<]*)<', page)
    names = {entry["name"] for entry in unpacked(text)["arrays"]}
    assert names == {"lower", "upper", "witness_lower", "witness_upper", "image"}
    # samples are no bounds: nothing is played with
    assert "<script" not in written(tmp_path / "b", sloped(), guarantee="sampled")


# ------------------------------------------------------------------- in a browser


needs_browser = pytest.mark.skipif(chromium() is None, reason="no Chromium (Debian: apt-get install chromium)")


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """One tab for all pages."""
    pytest.importorskip("websockets", reason="the browser is steered through a web socket (extra nerfstudio)")
    with Browser("about:blank", tmp_path_factory.mktemp("browser") / "profile", height=1000) as browser:
        yield browser


def opened(tab: Browser, file: Path, question: str) -> None:
    tab.call("Page.navigate", url=file.as_uri())
    until(lambda: tab.ask(question), "the page")


def picture(tab: Browser) -> np.ndarray:
    """[H, W, 3] what the canvas holds."""
    height, width, data = tab.ask(
        "(() => { const c = document.getElementById('play-picture');"
        " return [c.height, c.width, [...c.getContext('2d').getImageData(0, 0, c.width, c.height).data]]; })()"
    )
    return np.array(data, np.int64).reshape(height, width, 4)[..., :3]


def told(tab: Browser) -> np.ndarray:
    """[3, 4] lower, upper, least and largest rendered of the pixel that the page tells about, in steps."""
    texts = tab.ask(
        "[...document.querySelectorAll('#play-values tr')].map(r => [...r.cells].slice(1).map(c => c.innerText))"
    )
    return np.array([[round(float(text) / STEP) for text in row] for row in texts])


def slide(tab: Browser, axis: int, position: int) -> None:
    tab.ask(
        f"(() => {{ const s = document.getElementById('play-slider-{axis}'); s.value = {position};"
        " s.dispatchEvent(new Event('input')); })()"
    )


def point_at(tab: Browser, row: int, column: int, height: int, width: int) -> None:
    x, y, w, h = tab.ask(
        "(() => { const c = document.getElementById('play-picture'); c.scrollIntoView({block: 'center'});"
        " const r = c.getBoundingClientRect(); return [r.x, r.y, r.width, r.height]; })()"
    )
    at = x + (column + 0.5) * w / width, y + (row + 0.5) * h / height
    tab.call("Input.dispatchMouseEvent", type="mouseMoved", x=at[0], y=at[1])


@pytest.mark.slow
@needs_browser
def test_slider_moves_pixels_and_pixels_are_those_of_the_file(tab: Browser, tmp_path: Path) -> None:
    result = sloped()
    page = written(tmp_path, result)
    assert len(page) < 2_000_000
    height, width = result.lower.shape[:2]
    opened(tab, tmp_path / "report.html", "document.getElementById('play')?.dataset.ready === '0'")
    with np.load(tmp_path / "frame_00000.npz") as file:
        stored = {name: file[name].astype(np.float64) for name in ("lower", "upper", "witness_lower", "witness_upper")}

    # the whole set: every number as in the file, outward
    tab.ask("document.getElementById('play-whole').click()")
    np.testing.assert_array_equal(picture(tab), np.floor(np.floor(stored["lower"] * 1e4) * 255 / 1e4 + 1e-9))
    for row, column in ((0, 0), (7, 19), (height - 1, width - 1)):
        point_at(tab, row, column, height, width)
        assert f"row {row}, column {column}" in tab.text()
        wanted = [np.floor(stored["lower"] * 1e4), np.ceil(stored["upper"] * 1e4),
                  np.ceil(stored["witness_lower"] * 1e4), np.floor(stored["witness_upper"] * 1e4)]  # fmt: skip
        np.testing.assert_array_equal(told(tab), np.stack([a[row, column] for a in wanted], axis=-1))
    whole = picture(tab)

    # one pose: the leaves' linear bounds there
    seen = []
    for positions in ((0, 500), (250, 900), (1000, 500)):
        for axis, position in enumerate(positions):
            slide(tab, axis, position)
        values = np.array([-0.5 + 2.0 * position / 1000 for position in positions])
        lower, upper = bounds_at(result, values)
        shown = picture(tab)
        seen.append(shown)
        # 8 bits, rounded down, of numbers rounded down
        assert (shown <= lower * 255).all() and (shown >= lower * 255 - 1.1).all()
        point_at(tab, 11, 17, height, width)
        low, high = told(tab)[:, 0] * STEP, told(tab)[:, 1] * STEP
        assert (low <= lower[11, 17] + 1e-12).all() and (low >= lower[11, 17] - 3e-4).all()
        assert (high >= upper[11, 17] - 1e-12).all() and (high <= upper[11, 17] + 3e-4).all()
    assert all((np.abs(a - b).mean() > 3.0) for a, b in ((seen[0], seen[1]), (seen[1], seen[2]), (seen[0], whole)))
    assert (whole <= np.minimum.reduce(seen)).all()

    # another quantity, and a render that follows the slider
    for name, changes in (("upper", True), ("gap", None), ("image", True), ("witness", False)):
        before = picture(tab)
        tab.ask(f"document.querySelector('input[value={name}]').click()")
        assert np.abs(picture(tab) - before).mean() > 1.0
        slide(tab, 0, 1000)
        slide(tab, 1, 1000)
        first = picture(tab)
        slide(tab, 0, 0)
        slide(tab, 1, 0)
        assert changes is None or (np.abs(picture(tab) - first).max() > 10) == changes
    tab.ask("document.querySelector('input[value=image]').click()")
    assert result.views is not None
    np.testing.assert_array_equal(picture(tab), np.rint(result.views.images[0] * np.float32(255.0)))
    assert "nearest render: x = -0.5 normalised units, yaw = -0.5 rad" in tab.text()
    tab.screenshot(tmp_path / "report.png")
    assert (tmp_path / "report.png").stat().st_size > 10_000


@pytest.mark.slow
@needs_browser
def test_policy_refuses_other_scripts(tab: Browser, tmp_path: Path) -> None:
    written(tmp_path, sloped())
    opened(tab, tmp_path / "report.html", "document.getElementById('play')?.dataset.ready === '0'")
    for code in (
        "const s = document.createElement('script'); s.textContent = 'window.hacked = 1'; document.body.append(s);",
        "document.body.insertAdjacentHTML('beforeend', '<img src=x onerror=\"window.hacked = 1\">');",
        "const t = document.createElement('script'); t.src = 'data:text/javascript,window.hacked=1'; "
        "document.body.append(t);",
    ):
        tab.ask(f"(() => {{ {code} }})()")
    assert tab.ask("new Promise(done => setTimeout(() => done(window.hacked === undefined), 300))")
    assert tab.ask("fetch('data:text/plain,x').then(() => 'loaded', () => 'refused')") == "refused"


def certificate(folder: Path) -> Path:
    """The page of a certificate of one azimuth and of two parameters."""
    kinds = ("certified", "falsified", "unknown", "certified")

    def entry(index: int, names: tuple[str, ...]) -> dict[str, Any]:
        sides = [
            {"name": n, "unit": "rad", "lower": 0.0, "upper": 4.0 if n in names else 0.0} for n in ("azimuth", "<b>")
        ]
        return {
            "index": index, "parameters": sides, "least_margin": 0.25, "counterexamples": [],
            "coverage": {"certified": 0.5, "falsified": 0.25, "unknown": 0.25, "not_examined": 0.0},
            "cells": {"certified": 2, "falsified": 1, "unknown": 1, "open": 0},
            "sampled": {"poses": 0, "right": 0, "sampled_right": None}, "partition": None,
        }  # fmt: skip

    def rows(last: float) -> list[dict[str, Any]]:
        return [
            {
                "lower": [float(k), 0.0], "upper": [k + 1.0, last], "verdict": kind,
                "margin": {"certified": 0.25 * (k + 1), "falsified": -0.5, "unknown": None}[kind],
                "counterexample": [k + 0.5, 0.0] if kind == "falsified" else None,
            }
            for k, kind in enumerate(kinds)
        ]  # fmt: skip

    about = CommandRun(
        guarantee="float32-sound", renderer={"name": "gsplat", "version": "1.4.0"}, scene={"name": "a <script>"},
        fingerprint={}, settings={}, command=("run",),
    )  # fmt: skip
    claim = {
        "property": {}, "property_text": "it holds", "network_guarantee": ("sound",), "picture": "float",
        "model": {"name": "net"},
    }  # fmt: skip
    figures = {
        "trace": [], "seconds": 1.0, "effort": {"worker_seconds": 1.0, "cells_bounded": 8}, "unknown_because": {},
        "cells_seal": {},
    }  # fmt: skip
    document = certificate_document(
        about, claim, [entry(0, ("azimuth",)), entry(1, ("azimuth", "<b>"))], figures, state="done",
        scene_margin={"skipped": "not asked for", "kinds": []}, cameras={"cells": [], "left_out": 0},
    )  # fmt: skip
    red = preview(np.full((4, 4, 3), (200, 10, 10), np.uint8), 64)
    cells = {0: rows(0.0), 1: rows(4.0)}
    found = [
        (stop, PoseImage(stop.at, stop.values, red, [1.0], 0.5)) for stop in stops(document["frames"], cells, most=8)
    ]
    seen = {(0, 1): {"png": red, "text": "broken </script>"}}
    page = certificate_page(document, cells, [], seen, closer=CertificateDetails(stops=found))
    (folder / "certificate.html").write_text(page)
    return folder / "certificate.html"


@pytest.mark.slow
@needs_browser
def test_cell_of_a_certificate_is_told_about(tab: Browser, tmp_path: Path) -> None:
    opened(tab, certificate(tmp_path), "document.getElementById('cell-hint')?.hidden === false")
    assert tab.ask("document.getElementById('cell').hidden")
    for number, words in (
        (0, ("certified, frame 0", "azimuth", "[0, 1] rad", "at least 0.25", "No picture of this cell")),
        (1, ("falsified, frame 0", "-0.5", "azimuth = 1.5 rad, <b> = 0 rad", "broken </script>")),
        (6, ("unknown, frame 1", "<b>", "[2, 3] rad", "[0, 4] rad")),
    ):
        x, y = tab.place(f"document.querySelector('[data-cell=\"{number}\"]')")
        tab.click(x, y)
        text = tab.ask("document.getElementById('cell').innerText")
        assert all(word in text for word in words), text
        assert tab.ask("document.querySelectorAll('.chosen').length") == 1
    tab.ask("document.getElementById('cell-before').click()")
    assert "falsified, frame 1" in tab.ask("document.getElementById('cell').innerText")
    tab.click(*tab.place("document.querySelector('[data-cell=\"1\"]')"))
    size = tab.ask(
        "(() => { const i = document.getElementById('cell-picture'); return [i.hidden, i.naturalWidth]; })()"
    )
    assert size == [False, 4]
    tab.screenshot(tmp_path / "certificate.png")


@pytest.mark.slow
@needs_browser
def test_slider_of_a_certificate_shows_one_picture_at_a_time(tab: Browser, tmp_path: Path) -> None:
    opened(tab, certificate(tmp_path), "!!document.getElementById('walk-slider')")
    seen = "[...document.querySelectorAll('#walk figure')].map(f => f.getBoundingClientRect().height > 0)"
    # it begins at what is certified
    assert tab.ask(seen) == [True] + [False] * 7
    assert "1 of 8: frame 0, azimuth = 0 rad" in tab.ask("document.getElementById('walk').innerText")
    tab.click(*tab.place("document.getElementById('walk-slider')"))
    before = tab.ask("Number(document.getElementById('walk-slider').value)")
    tab.key("ArrowRight", 39, 2)
    at = tab.ask("Number(document.getElementById('walk-slider').value)")
    assert at == before + 2 and tab.ask(seen) == [k == at for k in range(8)]
    text = tab.ask("document.getElementById('walk').innerText")
    assert f"{at + 1} of 8: frame {at // 4}, azimuth" in text and "margin of this picture 0.5" in text
    assert tab.ask("[...document.querySelectorAll('#walk-verdicts .here')].length") == 1
    # printed, and without scripts, all pictures are there
    tab.call("Emulation.setScriptExecutionDisabled", value=True)
    tab.call("Page.reload")
    until(lambda: tab.ask("document.readyState") == "complete", "the page")
    assert tab.ask(seen) == [True] * 8
    tab.call("Emulation.setScriptExecutionDisabled", value=False)
