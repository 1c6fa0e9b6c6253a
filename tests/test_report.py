"""Files, pictures and the report of ns-abstract-render."""

from __future__ import annotations

import html.parser
import io
import itertools
import json
import math
import os
import re
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.io.atomic import write_atomic
from ns_abstract.io.errors import InputError
from ns_abstract.io.folder import first_command, remove_parts
from ns_abstract.io.stamps import file_stamp
from ns_abstract.refine.result import FrameResult, Leaves, TracePoint, merged
from ns_abstract.report import files, page, picture, record
from ns_abstract.report.figures import interval, metrics, number
from ns_abstract.report.files import IMAGES, LEAVES, check_frame, frame_name, load_frame, save_frame
from ns_abstract.report.record import Report, RunRecord
from ns_abstract.report.run import differences, guarantee_text, plain

ROOT = Path(__file__).resolve().parents[1]
EVIL = '<script>alert("x")</script>&$a_b$'
SIX = ParameterBox(
    ("x", "y", "z", "yaw", "pitch", "roll"),
    ("normalised units",) * 3 + ("rad",) * 3,
    (-0.05, -0.0123456, 0.0, -0.01, -0.2, 0.001),
    (0.05, 0.0333333, 1e-5, 0.01, 0.2, 0.002),
)


def frame(
    index: int = 0, height: int = 5, width: int = 7, *, box: ParameterBox = SIX, spread: float = 0.3,
    witness: float = 0.5, seed: int = 0, **changes: Any,
) -> FrameResult:  # fmt: skip
    """A consistent frame whose witnesses span ``witness`` of its bounds' width."""
    rng = np.random.default_rng(seed)
    image = rng.uniform(0.2, 0.8, (height, width, 3)).astype(np.float32)
    reach = (0.5 * spread * rng.uniform(0.1, 1.0, image.shape)).astype(np.float32)
    result = FrameResult(
        index, box, np.clip(image - reach, 0, 1), np.clip(image + reach, 0, 1),
        np.clip(image - np.float32(witness) * reach, 0, 1), np.clip(image + np.float32(witness) * reach, 0, 1),
        image, 3.0, 12,
        trace=tuple(TracePoint(0.1 * 3.0**k, 2**k, 0.5 / (k + 1), 0.1 * k) for k in range(4)),
        plan=("the set only translates: no depth order changes",),
    )  # fmt: skip
    return replace(result, **changes)


def leaves(d: int, count: int = 3, side: int = 4) -> Leaves:
    rng = np.random.default_rng(1)

    def coefficients(*shape: int) -> np.ndarray:
        return rng.normal(size=shape).astype(np.float32)

    return Leaves(
        rng.normal(size=(count, d)), rng.normal(size=(count, d)), rng.integers(0, 9, (count, 2), np.int32),
        coefficients(count, side, side, 3, d), coefficients(count, side, side, 3),
        coefficients(count, side, side, 3, d), coefficients(count, side, side, 3),
    )  # fmt: skip


def run(**changes: Any) -> RunRecord:
    given_values: dict[str, Any] = {
        "guarantee": "float32-sound",
        "renderer": {"name": "gsplat", "version": "1.4.0"},
        "scene": {"name": "plant", "source": "runs/plant/config.yml", "gaussians": 113648},
        "frames": (0, 1, 2),
        "fingerprint": {"scene": {"sha256": "ab"}, "perturbation": {"translation": {"x": [-0.1, 0.1]}}, "factor": 1},
        "settings": {"target_ratio": 1.05, "time_budget": math.inf, "seed": 0, "save_cells": False},
        "plan": ("SH bands 1 to 3 are zero",),
        "command": ("ns-abstract-render", "--output-dir", "my out"),
    }
    return RunRecord(**(given_values | changes))


def read(folder: Path) -> dict[str, Any]:
    def refuse(constant: str) -> float:
        raise AssertionError(f"{constant} in report.json")

    return json.loads((folder / "report.json").read_text(), parse_constant=refuse)


def same(one: FrameResult, other: FrameResult) -> None:
    for name in IMAGES:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        assert getattr(other, name).dtype == np.float32
    for name in ("index", "box", "seconds", "cells", "trace", "plan", "bounded"):
        assert getattr(one, name) == getattr(other, name)


# files


@settings(deadline=None, max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    height=st.integers(1, 6), width=st.integers(1, 6), d=st.integers(0, 6), index=st.integers(0, 10**6),
    with_leaves=st.booleans(), bounded=st.booleans(),
)  # fmt: skip
def test_round_trip(tmp_path, height, width, d, index, with_leaves, bounded):
    box = ParameterBox(SIX.names[:d], SIX.units[:d], SIX.lower[:d], SIX.upper[:d])
    kept = leaves(d) if with_leaves else None
    result = frame(index, height, width, box=box, leaves=kept, bounded=bounded)
    path = tmp_path / frame_name(index, "npz")
    save_frame(path, result, status="partial", about={"guarantee": "real-sound", "name": EVIL})
    stored = load_frame(path)
    same(result, stored.result)
    assert (stored.status, stored.about["name"], stored.has_leaves) == ("partial", EVIL, with_leaves)
    assert (load_frame(path, leaves=False).result.leaves is None) and (stored.result.leaves is None) != with_leaves
    with np.load(path, allow_pickle=False) as arrays:
        assert set(arrays.files) == {*IMAGES, "parameters", "record", *(LEAVES if with_leaves else ())}
        assert [str(n) for n in arrays["parameters"]["name"]] == list(box.names)
        np.testing.assert_array_equal(arrays["parameters"]["upper"], box.upper)
        for name in LEAVES if with_leaves else ():
            np.testing.assert_array_equal(arrays[name], getattr(kept, name))
    path.unlink()


def test_interrupted_write(tmp_path):
    path = tmp_path / "frame_00000.npz"
    save_frame(path, frame())
    before = path.read_bytes()

    def interrupted(stream):
        stream.write(b"half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_atomic(path, interrupted)
    assert path.read_bytes() == before and os.listdir(tmp_path) == [path.name]


def test_refused_write(tmp_path, monkeypatch):
    path = tmp_path / "value.json"
    path.write_bytes(b"old")

    def refuse(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(OSError, match="disk full"):
        write_atomic(path, lambda stream: stream.write(b"new"))
    assert path.read_bytes() == b"old" and os.listdir(tmp_path) == [path.name]


def test_killed_write(tmp_path):
    path = tmp_path / "report.json"
    path.write_text("old")
    code = (
        "import os, sys\nfrom ns_abstract.io.atomic import write_atomic\n"
        "def die(stream):\n    stream.write(b'half'); stream.flush(); os._exit(9)\n"
        "write_atomic(sys.argv[1], die)"
    )
    killed = subprocess.run([sys.executable, "-c", code, str(path)], cwd=ROOT, check=False)
    assert killed.returncode == 9 and path.read_text() == "old" and len(os.listdir(tmp_path)) == 2
    remove_parts(tmp_path)
    assert os.listdir(tmp_path) == ["report.json"]


@pytest.mark.slow
@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged(tmp_path, data):
    path = tmp_path / "frame_00000.npz"
    result = frame(leaves=leaves(6, 1, 2))
    save_frame(path, result)
    content = bytearray(path.read_bytes())
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content) - 1))]
    else:
        position = data.draw(st.integers(0, len(content) - 1))
        content[position] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content)
    # a changed byte of the archive's own book-keeping may be harmless; the content never is another
    try:
        stored = load_frame(path)
    except InputError as error:
        assert error.file == str(path) and "\n" not in str(error)
    else:
        same(result, stored.result)


def test_foreign_files(tmp_path):
    path = tmp_path / "frame_00000.npz"
    with pytest.raises(InputError, match="no such file"):
        load_frame(path)
    np.savez(path, lower=np.zeros((2, 2, 3)))
    with pytest.raises(InputError, match="no image, parameters, record, upper"):
        load_frame(path)
    arrays = {name: getattr(frame(), name) for name in IMAGES}
    objects = np.array([os.system], dtype=object)
    np.savez(path, **arrays, parameters=objects, record=objects)
    with pytest.raises(InputError, match="Python objects"):
        load_frame(path)
    for content in (b"", b"text", b"\x93NUMPY\x01\x00", b"PK\x03\x04"):
        path.write_bytes(content)
        with pytest.raises(InputError):
            load_frame(path)
    save_frame(path, frame(3))
    with pytest.raises(InputError, match="holds frame 3"):
        load_frame(path)
    crossed = replace(frame(), upper=frame().lower, lower=frame().upper)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(files, "check_frame", lambda result: None)
        save_frame(path, crossed)
    with pytest.raises(InputError, match="not sound"):
        load_frame(path)


def broken() -> list[tuple[str, FrameResult]]:
    good = frame()
    spoiled = good.upper.copy()
    spoiled[1, 2, 0] = np.nan
    outside = good.witness_upper.copy()
    outside[0, 0, 0] = np.nextafter(good.upper[0, 0, 0], np.float32(2))
    return [
        ("not in", replace(good, upper=spoiled)),
        ("not in", replace(good, lower=good.lower - np.float32(1))),
        ("not sound", replace(good, witness_upper=outside)),
        ("not sound", replace(good, lower=good.upper, upper=good.lower)),
        ("not sound", replace(good, image=good.upper)),
        ("float64", replace(good, lower=good.lower.astype(np.float64))),
        ("not float32", replace(good, lower=good.lower[:2])),
        ("ranges from", replace(good, box=ParameterBox(("x",), ("rad",), (1.0,), (0.0,)))),
        ("finite", replace(good, seconds=math.nan)),
        ("leaves: box_lower", replace(good, leaves=leaves(5))),
        ("leaves: A_lower", replace(good, leaves=replace(leaves(6), A_lower=leaves(5).A_lower))),
        ("leaves: tile", replace(good, leaves=replace(leaves(6), tile=np.zeros((3, 2))))),
    ]


@pytest.mark.parametrize(("problem", "result"), broken())
def test_unsound_is_refused(tmp_path, problem, result):
    with pytest.raises(ValueError, match=problem):
        check_frame(result)
    report = Report(tmp_path, run())
    with pytest.raises(ValueError, match=problem):
        report.add(result)
    assert read(tmp_path)["frames"] == [] and not list(tmp_path.glob("frame_*"))


# figures


@given(seed=st.integers(0, 1000), height=st.integers(1, 4))
@settings(deadline=None, max_examples=20)
def test_metrics(seed, height):
    result = frame(height=height, seed=seed)
    figures = metrics(result)
    lengths = [
        math.sqrt(sum((float(u) - float(l)) ** 2 for u, l in zip(upper, lower, strict=True)))
        for upper, lower in zip(result.upper.reshape(-1, 3), result.lower.reshape(-1, 3), strict=True)
    ]
    assert figures["mpg"] == pytest.approx(sum(lengths) / len(lengths), rel=1e-12)
    assert figures["xpg"] == pytest.approx(max(lengths), rel=1e-12)
    assert figures["ratio"] == figures["mpg"] / figures["mpg_witness"] >= 1.0
    assert metrics(frame(witness=0.0))["ratio"] is None


def test_numbers_for_people():
    assert [number(v) for v in (None, 0.0, 1.23456, 3.3e-5, 31)] == ["–", "0", "1.235", "3.3e-5", "31"]
    assert interval("x", "m", -0.05, 0.05) == "x ± 0.05 m"
    assert interval("yaw", "rad", 0.0, 0.2) == "yaw ∈ [0, 0.2] rad"


# pictures


@pytest.mark.slow
def test_matplotlib_is_imported_late(tmp_path):
    code = (
        "import sys\nfrom ns_abstract.report import files, page, picture, record\n"
        "from test_report import run\nrecord.Report(sys.argv[1], run())\n"
        "assert 'matplotlib' not in sys.modules and 'PIL' not in sys.modules"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], cwd=ROOT, env=environment, check=True)


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    ("height", "width", "changes"),
    [
        (1, 1, {}),
        (100, 100, {}),
        (60, 34, {"bounded": False}),
        (18, 64, {"box": ParameterBox((), (), (), ())}),
        (60, 6, {"index": 12345}),
        (6, 120, {}),
        (30, 1200, {"spread": 0.0}),
    ],
)
def test_text_does_not_overlap(height, width, changes):
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.text import Text

    figure = picture.frame_figure(frame(height=height, width=width, **changes), guarantee="float32-sound", about=EVIL)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    drawn = [text for text in figure.findobj(Text) if text.get_text() and text.get_visible()]
    boxes = [text.get_window_extent() for text in drawn]
    labels = {text.get_text() for text in drawn}
    assert {"lower bound", "upper bound", "gap |upper − lower|"} <= labels
    for one, other in itertools.combinations(range(len(boxes)), 2):
        if boxes[one].overlaps(boxes[other]):
            raise AssertionError(f"{drawn[one].get_text()!r} and {drawn[other].get_text()!r} overlap")
    edge = figure.bbox
    for text, box in zip(drawn, boxes, strict=True):
        assert edge.x0 <= box.x0 and box.x1 <= edge.x1 and edge.y0 <= box.y0 and box.y1 <= edge.y1, text.get_text()
        for axes in figure.axes:
            panel = axes.get_window_extent()
            assert not (panel.shrunk(0.999, 0.999).overlaps(box)), text.get_text()


def test_panels_show_the_pixels(tmp_path):
    from matplotlib.image import imread

    result = frame(height=10, width=20)
    path = tmp_path / "frame.png"
    picture.save_picture(path, result, guarantee="real-sound")
    shown = np.round(255 * imread(path)[..., :3]).astype(np.uint8)
    figure = picture.frame_figure(result, guarantee="real-sound")
    panels = [axes.get_position() for axes in figure.axes if axes.images]
    rows, columns = shown.shape[:2]
    top = float(np.linalg.norm(result.upper - result.lower, axis=-1).max())
    wanted = [picture.to_bytes(result.lower), picture.to_bytes(result.upper)]
    wanted += [picture.heat(np.linalg.norm(result.upper.astype(float) - result.lower, axis=-1), top)]
    wanted += [picture.to_bytes(result.image)]
    assert len(panels) == 4
    for panel, image in zip(panels, wanted, strict=True):
        x = np.round(columns * (panel.x0 + panel.width * (np.arange(20) + 0.5) / 20)).astype(int)
        y = np.round(rows * (1 - panel.y1 + panel.height * (np.arange(10) + 0.5) / 10)).astype(int)
        difference = np.abs(shown[np.ix_(y, x)].astype(int) - image)
        assert difference.max() <= 2


def test_previews_are_small():
    from PIL import Image

    made = picture.previews(frame(height=40, width=600), 128)
    assert set(made) == {"lower", "upper", "gap", "witness", "image"}
    for data in made.values():
        assert Image.open(io.BytesIO(data)).size == (128, 9)
    flat = np.full((50, 30, 3), 77, np.uint8)
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(picture.preview(flat, 256)))), flat)


# report.json


def test_report_end_to_end(tmp_path):
    report = Report(tmp_path / "new" / "out", run())
    folder = report.folder
    assert read(folder)["missing"] == [0, 1, 2] and read(folder)["interrupted"]
    report.add(frame(0, witness=0.97))
    middle = read(folder)
    assert [entry["status"] for entry in middle["frames"]] == ["done"] and middle["state"] == "running"
    report.add(frame(2, witness=0.5), picture=False)
    unbounded = replace(frame(1), lower=np.zeros_like(frame().lower), upper=np.ones_like(frame().upper), bounded=False)
    report.add(unbounded, status="done", picture=False)
    assert not (folder / "frame_00002.png").exists()
    final = report.finish("budget")
    assert final["frames"] == read(folder)["frames"]
    document = read(folder)
    assert [entry["status"] for entry in document["frames"]] == ["done", "missing", "partial"]
    assert (document["version"], document["guarantee"]) == (1, "float32-sound")
    assert document["renderer"] == {"name": "gsplat", "version": "1.4.0"} and document["plan"] == list(run().plan)
    assert (document["missing"], document["interrupted"], document["state"]) == ([1], False, "budget")
    assert document["settings"]["time_budget"] is None and document["packages"]["numpy"] == np.__version__
    assert report.missing == [1] and report.pending == [1, 2]
    for entry in document["frames"]:
        assert entry["ratio"] == entry["mpg"] / entry["mpg_witness"]
        second = {"seconds": 0.1 * 3.0, "cells": 2, "mpg": 0.25, "mpg_witness": 0.1, "covered": 1.0}
        assert entry["trace"][1] == second
        # 0.17 / 0.2 is the first ratio below
        assert entry["seconds_to_ratio"] == dict.fromkeys(("1.5", "1.25", "1.1", "1.05"), 0.1 * 3.0**2)
        assert entry["parameters"][3] == {"name": "yaw", "unit": "rad", "lower": -0.01, "upper": 0.01}
        for file in entry["files"].values():
            assert (folder / file).stat().st_size > 0
    assert load_frame(folder / "frame_00002.npz").about["fingerprint"] == run().fingerprint
    assert "Bounds for 2 of 3 frames" in (folder / "report.html").read_text()
    assert not list(folder.glob(".*"))


def test_zero_width(tmp_path):
    report = Report(tmp_path, run(frames=(0,)))
    box = ParameterBox((), (), (), ())
    entry = report.add(frame(box=box, witness=0.0, trace=()), picture=False)
    assert entry["ratio"] is None and entry["mpg_witness"] == 0.0 and entry["status"] == "done"
    # without a witness gap nothing shows that a set of positive width is tight
    assert report.add(frame(0, box=box, witness=0.0), "partial", picture=False)["status"] == "partial"
    other = Report(tmp_path / "other", run(frames=(0,)))
    assert other.add(frame(witness=0.0), picture=False)["status"] == "partial"
    assert read(tmp_path)["frames"][0]["ratio"] is None


def test_resume(tmp_path):
    report = Report(tmp_path, run())
    report.add(frame(0, witness=0.97), picture=False)
    report.add(frame(1, witness=0.6), picture=False)
    report.add(frame(2, witness=0.97), picture=False)
    (tmp_path / "frame_00002.npz").write_bytes((tmp_path / "frame_00002.npz").read_bytes()[:200])
    (tmp_path / ".report.json.0123abcd.part").write_text("half")
    again = Report(tmp_path, run(settings={"target_ratio": 1.05, "seed": 7}), keep_stored=True)
    assert again.kept == [0, 1] and again.pending == [1, 2]
    assert len(again.ignored) == 1 and again.ignored[0].startswith("frame_00002.npz: cannot be read")
    assert read(tmp_path)["ignored"] == again.ignored and not list(tmp_path.glob(".*"))
    assert Report(tmp_path, run(settings={"target_ratio": 1.001}), keep_stored=True).pending == [0, 1, 2]
    assert Report(tmp_path, run(settings={"target_ratio": 2.0}), keep_stored=True).pending == [2]
    needs_leaves = Report(tmp_path, run(settings={"save_cells": True}), keep_stored=True)
    assert needs_leaves.kept == [] and "has no leaf cells" in needs_leaves.ignored[0]
    part = Report(tmp_path, run(frames=(5,)), keep_stored=True)
    assert part.pending == [5] and [e["index"] for e in read(tmp_path)["frames"]] == [0, 1]


def test_first_command_stays(tmp_path):
    """The command that began is kept beside those that go on, however many."""
    for k, keep in enumerate((False, True, True)):
        report = Report(tmp_path, run(command=("render", str(k))), keep_stored=keep)
        document = report.finish("done")
    assert document["first_command"] == ["render", "0"] and document["command"] == ["render", "2"]
    assert "Begun by" in (tmp_path / "report.html").read_text()
    assert "first_command" not in Report(tmp_path, run(command=("render", "3"))).finish("done")
    (tmp_path / "report.json").write_text('{"command": 3}')
    assert first_command(tmp_path) is None and first_command(tmp_path / "none") is None


def entry_of(trace: list[tuple[float, float, float, float]], status: str = "done") -> dict[str, Any]:
    keys = ("seconds", "mpg", "mpg_witness", "covered")
    return {"trace": [dict(zip(keys, point, strict=True)) for point in trace], "status": status}


def test_curves_begin_where_something_is_known():
    """No second before the first whole cover is drawn, and no band where one of its sides is missing."""
    late = [(1e-6, 1.73, 0.0, 0.0), (2.0, 1.73, 0.1, 0.5), (4.0, 0.5, 0.1, 1.0), (8.0, 0.2, 0.15, 1.0)]
    points = page._seen(entry_of(late)["trace"])
    assert [p["seconds"] for p in points] == [4.0, 8.0]
    plot = str(page._curve(entry_of(late)))
    band = re.search(r'class="band" d="M([\d.,L]+)Z"', plot)
    assert band
    corners = [tuple(map(float, pair.split(","))) for pair in band[1].split("L")]
    # along the bounds and back along the renders: the same times, no triangle
    times = [x for x, _ in corners]
    assert times == times[: len(times) // 2] + times[: len(times) // 2][::-1]
    nothing = [(1e-6, 1.73, 0.0, 0.0), (2.0, 1.73, 0.0, 0.5)]
    assert page._seen(entry_of(nothing)["trace"]) == entry_of(nothing)["trace"]
    never_seen = [(1.0, 0.3, 0.0, 1.0), (2.0, 0.2, 0.0, 1.0), (3.0, 0.1, 0.05, 1.0)]
    assert [p["seconds"] for p in page._seen(entry_of(never_seen)["trace"])] == [3.0]


@pytest.mark.slow
@pytest.mark.parametrize(("witness", "kind"), [(0.97, "good"), (0.3, "fair")])
def test_only_tight_bounds_are_green(tmp_path, witness, kind):
    report = Report(tmp_path, run(frames=(0,)))
    report.add(frame(0, witness=witness), picture=False)
    report.finish("done")
    text = (tmp_path / "report.html").read_text()
    assert f'<div class="verdict {kind}">' in text
    # nothing to move where cells were not kept
    assert "Look at a pixel" in text and "Move the camera" not in text and '<table id="play-table" hidden>' in text


def test_done_by_the_caller_stays_done(tmp_path):
    Report(tmp_path, run()).add(frame(0, witness=0.5), "done", picture=False)
    assert Report(tmp_path, run(), keep_stored=True).pending == [1, 2]
    assert Report(tmp_path, run(settings={"target_ratio": 1.01}), keep_stored=True).pending == [0, 1, 2]


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"scene": {"sha256": "cd"}, "perturbation": {"translation": {"x": [-0.1, 0.1]}}, "factor": 1}, "scene.sha256"),
        (
            {"scene": {"sha256": "ab"}, "perturbation": {"translation": {"x": [-0.2, 0.1]}}, "factor": 1},
            "translation.x",
        ),
        ({"scene": {"sha256": "ab"}, "perturbation": {"translation": {"x": [-0.1, 0.1]}}, "factor": 2}, "factor"),
        ({"scene": {"sha256": "ab"}, "perturbation": {"translation": {"x": [-0.1, 0.1]}}}, "factor"),
        ({}, "scene.sha256"),
    ],
)
def test_resume_refuses_other_settings(tmp_path, change, field):
    Report(tmp_path, run()).add(frame(0), picture=False)
    before = (tmp_path / "report.json").read_bytes()
    with pytest.raises(InputError, match=field) as caught:
        Report(tmp_path, run(fingerprint=change), keep_stored=True)
    assert "--output-dir" in str(caught.value) and (tmp_path / "report.json").read_bytes() == before
    # without its report, a frame file still knows what it holds
    (tmp_path / "report.json").unlink()
    report = Report(tmp_path, run(fingerprint=change), keep_stored=True)
    assert report.kept == [] and report.ignored == ["frame_00000.npz: computed with other settings"]


def test_resume_without_a_report(tmp_path):
    Report(tmp_path, run()).add(frame(0, witness=0.97), picture=False)
    for content in ("", "[1]", '{"version": 1', '{"version": 1}', '{"fingerprint": NaN}'):
        (tmp_path / "report.json").write_text(content)
        # nothing says that the frame is as it was written
        assert Report(tmp_path, run(), keep_stored=True).kept == []
    assert Report(tmp_path / "empty", run(), keep_stored=True).pending == [0, 1, 2]


def test_fresh_start_names_old_files(tmp_path):
    Report(tmp_path, run()).add(frame(7), picture=False)
    report = Report(tmp_path, run())
    assert read(tmp_path)["other_files"] == ["frame_00007.npz"] and read(tmp_path)["frames"] == []
    report.add(frame(7), picture=False)
    assert read(tmp_path)["other_files"] == []


@given(first=st.integers(0, 500), second=st.integers(0, 500))
@settings(deadline=None, max_examples=20)
def test_merged(first, second):
    image = frame(seed=1).image
    results = []
    for seed in (first, second):
        reach = [np.random.default_rng((seed, k)).uniform(0, 0.2, image.shape).astype(np.float32) for k in range(2)]
        low, high = np.sort(reach, axis=0)
        results.append(
            frame(seed=1, lower=image - high, upper=image + high, witness_lower=image - low, witness_upper=image + low)
        )
    older, newer = results
    try:
        check_frame(both := merged(older, newer))
    except ValueError:
        # a render of one outside the bounds of the other must be found out
        assert (older.witness_upper > newer.upper).any() or (newer.witness_upper > older.upper).any()
        return
    for one in results:
        assert (both.lower >= one.lower).all() and (both.upper <= one.upper).all()
        assert (both.witness_lower <= one.witness_lower).all() and (both.witness_upper >= one.witness_upper).all()
    assert (both.seconds, both.cells, len(both.trace)) == (6.0, 24, 8)
    assert all(a.seconds <= b.seconds and a.mpg >= b.mpg for a, b in itertools.pairwise(both.trace[3:]))


def test_added_again(tmp_path):
    wide, tight = frame(0, spread=0.3, witness=0.2), frame(0, spread=0.2, witness=0.3, seconds=4.0, cells=20)
    report = Report(tmp_path, run())
    report.add(wide, picture=False)
    entry = report.add(tight, picture=False)
    # the same command: time and trace are those of the last call
    assert (entry["seconds"], entry["cells"], len(entry["trace"])) == (4.0, 20, 4)
    assert entry["mpg"] == metrics(tight)["mpg"]
    later = Report(tmp_path, run(), keep_stored=True)
    for _ in range(2):
        entry = later.add(wide, picture=False)
        assert (entry["seconds"], entry["cells"], len(entry["trace"])) == (7.0, 32, 8)
        assert entry["mpg"] == metrics(tight)["mpg"]
    same(replace(tight, **{k: getattr(load_frame(tmp_path / "frame_00000.npz").result, k)
                           for k in ("seconds", "cells", "trace", "witness_lower", "witness_upper")}),
         load_frame(tmp_path / "frame_00000.npz").result)  # fmt: skip
    with pytest.raises(ValueError, match="another set"):
        later.add(frame(0, height=6), picture=False)


def test_unwritable(tmp_path):
    (tmp_path / "file").write_text("")
    for make in (Report, partial(Report, keep_stored=True)):
        with pytest.raises(InputError, match="cannot be written") as caught:
            make(tmp_path / "file" / "out", run())
        assert "--output-dir" in str(caught.value)


def test_guarantee_texts():
    assert "every float32 evaluation" in guarantee_text("float32-sound")
    assert guarantee_text("real-sound") == "encloses the real-number renderer and this package's float64 evaluation"
    assert "not a guarantee" in guarantee_text("sampled") and "gsplat" not in guarantee_text("float32-sound", "paper")
    with pytest.raises(ValueError, match="certain"):
        guarantee_text("certain")


def test_plain_and_differences():
    value = {"a": np.float32(0.5), "b": (1, np.int64(2)), "c": math.nan, "d": Path("x"), "e": np.arange(2), 3: True}
    assert plain(value) == {"a": 0.5, "b": [1, 2], "c": None, "d": "x", "e": [0, 1], "3": True}
    with pytest.raises(TypeError, match="object"):
        plain(object())
    assert differences({"a": {"b": 1, "c": 2}}, {"a": {"b": 1, "c": 3}, "d": None}) == ["a.c", "d"]
    assert differences({}, {}) == [] and differences(value, plain(value)) == []


def test_file_stamp(tmp_path):
    path, moved = tmp_path / "a.ckpt", tmp_path / "sub" / "a.ckpt"
    path.write_bytes(bytes(range(256)) * 5000)
    moved.parent.mkdir()
    moved.write_bytes(path.read_bytes())
    assert file_stamp(path) == file_stamp(moved)
    moved.write_bytes(path.read_bytes()[:-1] + b"!")
    assert file_stamp(path) != file_stamp(moved)
    with pytest.raises(InputError, match="no such file"):
        file_stamp(tmp_path / "none")


# report.html


class Reader(html.parser.HTMLParser):
    """Collects tags and addresses; fails on tags that are not closed in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: list[str] = []
        self.addresses: list[str] = []
        self.text = ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.seen.append(tag)
        if tag not in ("meta", "img", "br", "line", "circle", "rect", "path", "input"):
            self.open.append(tag)
        for name, value in attrs:
            assert value is None or ("NaN" not in value and "nan" not in value.split())
            assert not name.startswith("on")
            if name in ("src", "href"):
                self.addresses.append(value or "")

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if self.open and self.open[-1] == tag:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def written(folder: Path, results: list[FrameResult], outcome: record.Outcome = "done", **changes: Any) -> Reader:
    """The page of a report, with one frame's pictures for all."""
    report = Report(folder, run(**changes))
    for result in results:
        report.add(result, picture=False)
    report._state = outcome
    document = report.document()
    pictures = dict.fromkeys([r.index for r in results], picture.previews(results[0], 64)) if results else {}
    return Reader(page.render_page(document, pictures))


def test_page_escapes(tmp_path):
    box = ParameterBox((EVIL,), (EVIL,), (0.0,), (1.0,))
    reader = written(
        tmp_path, [frame(0, plan=(EVIL,), box=box)],
        scene={"name": EVIL, EVIL: EVIL}, renderer={"name": EVIL, "version": EVIL}, plan=(EVIL,),
        command=("run", EVIL), limits=(EVIL,), settings={"target_ratio": 1.1, EVIL: [EVIL]},
        fingerprint={EVIL: {EVIL: EVIL}},
    )  # fmt: skip
    assert "script" not in reader.seen and reader.text.count("<script>") >= 12
    assert all(a.startswith(("data:image/png;base64,", "frame_0")) for a in reader.addresses)


def test_pages_turn_no_text_round(tmp_path):
    """A file's name would look like another; accents and line ends stay."""
    name = "frame\u202egnp.exe\u200b \ud800 caf\u00e9"
    reader = written(tmp_path, [frame(0)], command=("run", name), limits=("one\ntwo",), scene={"name": name})
    assert "\u202e" not in reader.text and "frame\\u202egnp.exe\\u200b \\ud800 café" in reader.text
    assert "one\ntwo" in reader.text


@pytest.mark.parametrize("count", [0, 1, 2, 30])
def test_page_of_many_frames(tmp_path, count):
    results = [frame(k, 3, 4, seed=k, spread=0.01 * (k + 1)) for k in range(count)]
    asked = tuple(range(max(count, 1)))
    reader = written(tmp_path, results, frames=asked)
    title = {0: "No bounds yet: 0 of 1 frame", 1: "Bounds for the frame"}.get(count, f"Bounds for all {count} frames")
    whose = "the frame's set" if count == 1 else "a frame's set"
    assert (whose in reader.text) == (count > 0)
    assert title in reader.text and "compared with exact results on one GPU" in reader.text
    assert reader.seen.count("img") == 5 * count and reader.seen.count("svg") == count + 2 * (count > 1)
    assert reader.seen.count("details") == count


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"trace": ()}, "No progress over time"),
        ({"trace": (TracePoint(0.0, 0, 1.0, 0.0),)}, "No progress over time"),
        ({"trace": (TracePoint(1.0, 1, 0.2, 0.0),)}, "bounds (MPG)"),
        ({"trace": (TracePoint(1e-6, 1, 1e-9, 1e-12), TracePoint(1e6, 9, 1e-9, 1e-12))}, "bounds (MPG)"),
        ({"bounded": False, "trace": ()}, "No bound but [0, 1]"),
        ({"witness": 0.0, "spread": 0.0}, "ratio –"),
        ({"height": 1, "width": 1}, "1 × 1 pixels"),
        ({"box": ParameterBox((), (), (), ())}, "one camera pose"),
        ({"trace": tuple(TracePoint(0.01 * k, k, 1.0 / (k + 1), 0.1) for k in range(5000))}, "bounds (MPG)"),
    ],
)
def test_page_edge_cases(tmp_path, changes, text):
    assert text in written(tmp_path, [frame(0, **changes)]).text


def test_page_never_promises_too_much(tmp_path):
    sampled = written(tmp_path, [frame(0), frame(1)], guarantee="sampled").text
    assert "No guarantee" in sampled and "is not a guarantee" in sampled
    for promise in ("lies between", "no image of the set", "enclose every image", "lies in the bar"):
        assert promise not in sampled
    killed = written(tmp_path / "b", [frame(0)], "interrupted").text
    assert "Bounds for 1 of 3 frames" in killed and "interrupted" in killed and "No bounds of frames 1, 2" in killed


def test_page_shows_the_widest():
    entries = [{"index": k, "mpg": float((7 * k) % 10)} for k in range(10)]
    assert [entry["index"] for entry in page.shown_frames(entries, 3)] == [1, 4, 7]
    assert page.shown_frames(entries, 10) == entries


@given(low=st.floats(1e-12, 1e6), span=st.floats(1.0, 1e9))
@settings(deadline=None, max_examples=100)
def test_log_axis(low, span):
    axis = page.PlotAxis(low, low * span, 50.0, 400.0, log=True)
    ticks = axis.ticks()
    assert ticks == sorted(set(ticks)) and 1 <= len(ticks) <= 16
    assert all(50.0 - 1e-6 <= axis(tick) <= 400.0 + 1e-6 for tick in [*ticks, low, low * span])


@given(high=st.floats(1e-9, 1e9))
@settings(deadline=None, max_examples=50)
def test_linear_axis(high):
    axis = page.PlotAxis(0.0, high, 200.0, 20.0, log=False)
    ticks = axis.ticks()
    assert 3 <= len(ticks) <= 8 and ticks[0] == 0.0 and all(20.0 - 1e-6 <= axis(tick) <= 200.0 for tick in ticks)


def test_names_that_are_no_utf8(tmp_path):
    """Linux lets a file have any bytes as its name; Python has surrogates in it, which no page and no JSON has."""
    name = os.fsdecode(b"caf\xe9.yml")
    report = Report(tmp_path, run(command=("render", name), settings={"load_config": Path(name)}))
    report.add(frame(0))
    report.finish("done")
    assert read(tmp_path)["command"] == ["render", name] and first_command(tmp_path) == ["render", name]
    assert r"caf\udce9.yml" in (tmp_path / "report.html").read_text()
