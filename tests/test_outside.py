"""The scene seen from outside, behind loops' tubes and certificates' cameras; sets in planes of positions; films."""

from __future__ import annotations

import io
import itertools
import json
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image
from test_reach import specification

from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.io.errors import InputError
from ns_abstract.perturbation.specification import parse_perturbation
from ns_abstract.reach.loop import Loop, parse_loop
from ns_abstract.reach.planes import plane_marks, region, views
from ns_abstract.refine.protocol import SceneElements
from ns_abstract.report.cameras import MOST, CameraDrawings, cameras_entry, cell_cameras, looked_at, standing, upward
from ns_abstract.report.export import encode_gif, encode_mp4
from ns_abstract.report.outside import PlotWindow, SceneDrawing
from ns_abstract.verify.store import Store

RED, GREEN, BLUE = np.eye(3)


def elements(*rows: tuple[Any, Any, float, float]) -> SceneElements:
    """Balls: place, colour, radius, opacity."""
    places, colors, sizes, opacities = (np.array(column, np.float64) for column in zip(*rows, strict=True))
    return SceneElements(places, sizes[:, None, None] * np.eye(3), colors, opacities)


def read(data: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(int)


def color_at(image: np.ndarray, window: PlotWindow, place: tuple[float, float]) -> str:
    """The strongest channel at a place of the plane, or "none"."""
    part = (np.array(place) - window.low) / (np.array(window.high) - window.low)
    pixel = image[int((1.0 - part[1]) * image.shape[0]), int(part[0] * image.shape[1])]
    return "none" if np.ptp(pixel) < 30 else "rgb"[int(np.argmax(pixel))]


def test_elements_are_drawn_where_they_are_and_the_nearest_on_top() -> None:
    scene = elements(
        ((0.5, 0.5, 0.0), RED, 0.1, 0.95),
        ((-0.5, 0.2, 0.0), BLUE, 0.1, 0.95),
        # above and before the blue one
        ((-0.5, -0.4, 0.5), GREEN, 0.15, 0.95),
        ((0.0, 0.2, 0.5), GREEN, 0.1, 0.95),
        # hardly to be seen
        ((0.0, -0.5, 0.0), RED, 0.1, 0.1),
    )
    outside, low, high = SceneDrawing(scene), (-1.0, -0.8), (1.0, 0.8)
    above = PlotWindow((0, 1), low, high, (300, 240))
    image = read(outside.picture(above))
    assert image.shape == (240, 300, 3)
    found = [color_at(image, above, place) for place in ((0.5, 0.5), (-0.5, 0.2), (0.0, 0.2), (0.0, -0.5), (0.8, 0.0))]
    assert found == ["r", "b", "g", "none", "none"]
    # no roof
    open_top = read(outside.picture(above, nearest=0.2))
    assert color_at(open_top, above, (0.0, 0.2)) == "none" and color_at(open_top, above, (0.5, 0.5)) == "r"
    # from -y, where the green ball at y = -0.4 hides nothing of the blue one at another height
    side = PlotWindow((0, 2), low, high, (300, 240))
    image = read(outside.picture(side))
    assert color_at(image, side, (-0.5, 0.5)) == "g" and color_at(image, side, (-0.5, 0.0)) == "b"
    one_behind_another = elements(((0.0, 1.0, 0.0), RED, 0.2, 0.95), ((0.0, -1.0, 0.0), BLUE, 0.2, 0.95))
    assert color_at(read(SceneDrawing(one_behind_another).picture(side)), side, (0.0, 0.0)) == "b"
    beside = PlotWindow((1, 2), low, high, (300, 240))
    turned = elements(((-1.0, 0.0, 0.0), RED, 0.2, 0.95), ((1.0, 0.0, 0.0), BLUE, 0.2, 0.95))
    assert color_at(read(SceneDrawing(turned).picture(beside)), beside, (0.0, 0.0)) == "b"


@pytest.mark.slow
def test_a_picture_of_many_elements_is_small_and_always_the_same() -> None:
    rng = np.random.default_rng(2)
    count = 30_000
    scene = SceneElements(
        rng.uniform(-1.0, 1.0, (count, 3)),
        0.02 * rng.normal(size=(count, 3, 3)),
        rng.random((count, 3)),
        rng.random(count),
    )
    window = PlotWindow((0, 1), (-1.0, -0.7), (1.0, 0.7), (756, 529))
    data = SceneDrawing(scene).picture(window)
    # two of them, as text, are less than 300 kB
    assert len(data) <= 100_000 and data == SceneDrawing(scene).picture(window)
    assert read(data).std() > 10.0


def test_a_window_holds_what_is_marked_and_some_of_the_scene() -> None:
    low, high = np.array([0.0, -0.1]), np.array([1.0, 0.1])
    scene = elements(*(((3.0, 0.1 * k, 0.0), RED, 0.1, 0.9) for k in range(-20, 21)), ((99.0, 0, 0), RED, 0.1, 0.9))
    window = SceneDrawing(scene).window((0, 1), low, high, np.inf, 400)
    assert window.low[0] <= 0.0 and 3.0 <= window.high[0] < 6.0
    across, up = np.subtract(window.high, window.low)
    assert abs(across / up - window.size[0] / window.size[1]) < 0.02
    outside = SceneDrawing(scene)
    # what was drawn is not drawn again
    assert outside.picture(window) is outside.picture(outside.window((0, 1), low, high, np.inf, 400))
    alone = SceneDrawing(elements(((0.0, 0.0, 0.0), RED, 0.1, 0.0))).window((0, 1), low, high, np.inf, 400)
    assert alone.low[0] <= 0.0 and 1.0 <= alone.high[0] < 1.2


# ---------------------------------------------------------------- planes


def loop(tmp_path: Path, **changes: Any) -> Loop:
    value = json.loads(json.dumps(specification("double integrator"))) | changes
    value["camera"]["position"] = {
        "offset": [1.0, 2.0, 0.5],
        # x from the second state, backwards; y from the first; z stands
        "matrix": [[0.0, -2.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]],
    }
    (tmp_path / "net.onnx").touch()
    return parse_loop(value, tmp_path)


WINDOW = PlotWindow((0, 1), (0.0, 0.0), (4.0, 4.0), (100, 100))


def inside(corners: list[tuple[float, float]], point: tuple[float, float]) -> bool:
    """Whether a convex polygon, corners in the order of the clock or against it, holds a point."""
    turns = [
        (u - x) * (point[1] - y) - (v - y) * (point[0] - x)
        for (x, y), (u, v) in zip(corners, [*corners[1:], *corners[:1]], strict=True)
    ]
    return bool(corners) and (min(turns) >= 0.0 or max(turns) <= 0.0)


def test_sets_are_drawn_where_the_camera_would_be(tmp_path: Path) -> None:
    """Any state whose camera is in the polygon is in the set, and no other."""
    sets = [
        {"box": {"p": [-0.5, 0.7], "q": [None, 0.2]}},
        {"half_space": {"normal": [1.0, 2.0, 0.0, 0.0], "at_least": 0.4}},
        {"box": {"p": [50.0, None]}},
    ]
    course, rng = loop(tmp_path, unsafe=sets), np.random.default_rng(1)
    matrix, offset = course.camera.place
    hits = 0
    for faces in course.unsafe:
        corners = region(faces, course, (0, 1), WINDOW, -1.0)
        for _ in range(800):
            x = np.append(rng.uniform(-2.0, 2.0, 2), (0.0, 0.0))
            place = matrix @ x + offset
            if not (0.0 < place[0] < 4.0 and 0.0 < place[1] < 4.0):
                continue
            unsafe = all(face.exact(x.tolist()) <= 0 for face in faces)
            assert inside(corners, (place[0], place[1])) == unsafe
            hits += unsafe
    assert hits > 100


def test_what_is_no_set_of_places_is_not_drawn(tmp_path: Path) -> None:
    sets = [{"box": {"p": [0.0, None], "r": [0.0, None]}}, {"half_space": {"normal": [1, 0, 1, 0], "at_least": 0}}]
    course = loop(tmp_path, unsafe=sets)
    assert [region(faces, course, (0, 1), WINDOW, -1.0) for faces in course.unsafe] == [[], []]
    # z stands still
    assert region(course.unsafe[0], course, (0, 2), WINDOW, -1.0) == []


def document(course: Loop, camera: Any = ()) -> dict[str, Any]:
    names = course.box.names
    tube = {"tube": [[[0.0] * 4, [0.1] * 4]], "camera": list(camera)}
    return {
        "parameters": [{"name": name} for name in names],
        "tubes": [tube],
        "simulated_states": [np.zeros((3, 4)), [[0.1, 0.0, 0.0, 0.0], [None] * 4]],
        "falsifying": [],
    }


def test_marks_are_places_of_the_camera(tmp_path: Path) -> None:
    course = loop(tmp_path)
    matrix, offset = course.camera.place
    assert matrix[2].tolist() == [0.0] * 4 and offset.tolist() == [1.0, 2.0, 0.5]
    camera = [[[0.5, 1.5, 0.5], [1.5, 2.5, 0.5]], [[None] * 3, [None] * 3]]
    cells = [{"lower": [-0.01] * 3, "upper": [0.02] * 3, "verdict": "certified"}]
    marks = plane_marks(document(course, camera), cells, course, matrix[:2], offset[:2], (0, 1))
    (kind, low, high), (other, *tube) = marks.boxes
    assert kind == "certified" and other == "tube"
    np.testing.assert_allclose([low, high], [[0.96, 1.99], [1.02, 2.02]])
    np.testing.assert_array_equal(tube, [[0.5, 1.5], [1.5, 2.5]])
    assert [len(line) for _, line in marks.lines] == [3, 1]
    np.testing.assert_allclose(marks.lines[1][1], [[1.0, 2.1]])
    found = views(document(course, camera), cells, course, None, 300)
    assert [view.axes for view in found] == [(0, 1), (0, 2)] and found[0].clip == 0.5


# ---------------------------------------------------------------- cameras of a certificate

NAMES = ("x", "y", "azimuth")
KINDS = ("certified", "falsified", "unknown")
#: Looks along -x from (1, 0, 0.3), z up.
AHEAD = np.array([[0.0, 0.0, 1.0, 1.0], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.3]])


def poses(specification: dict[str, Any] | None = None, pose: np.ndarray = AHEAD) -> PoseBox:
    return PoseBox.around(PinholeCamera(pose, 20.0, 30.0, 16.0, 12.0, 32, 24), parse_perturbation(specification or {}))


def around(low: float = 0.0, high: float = 6.0) -> PoseBox:
    return poses({"orbit": {"target": [0.0, 0.0, 0.0], "axis": [0.0, 0.0, 1.0], "azimuth": [low, high]}})


def shifts() -> PoseBox:
    turned = np.array([[1.0, 0.0, 0.0, 2.0], [0.0, 0.0, -1.0, -1.0], [0.0, 1.0, 0.0, 0.5]])
    return poses({"translation": {"x": 0.3, "y": 0.2}, "rotation": {"yaw": 0.1}}, turned)


def azimuths(ends: np.ndarray) -> list[dict[str, Any]]:
    """Cells between angles, verdicts in turn."""
    return [
        {"lower": [0.0, 0.0, a], "upper": [0.0, 0.0, b], "verdict": KINDS[k % 3]}
        for k, (a, b) in enumerate(itertools.pairwise(ends.tolist()))
    ]


def tick_map(plot: ElementTree.Element, along: str) -> np.ndarray:
    """Scale and offset from a plot's coordinates to the numbers at its ticks."""
    anchor, at = ("middle", "x") if along == "x" else ("end", "y")
    ticks = [
        (float(entry.get(at, "nan")) - (4.0 if along == "y" else 0.0), float(entry.text or "nan"))
        for entry in plot.findall("text")
        if entry.get("text-anchor") == anchor and "units" not in (entry.text or "")
    ]
    assert len(ticks) > 1
    places, values = np.array(ticks).T
    return np.polyfit(places, values, 1)


def test_cameras_are_drawn_where_the_middles_of_their_cells_are() -> None:
    sets = {3: around(), 7: shifts()}
    names = ("x", "y", "yaw", "azimuth")
    rows = {
        3: [
            {"lower": [0.0] * 3 + [2.0 * k], "upper": [0.0] * 3 + [2.0 * k + 2.0], "verdict": kind}
            for k, kind in enumerate(KINDS)
        ],
        7: [
            {"lower": [a, -0.2, -0.1, 0.0], "upper": [a + 0.3, 0.2, b, 0.0], "verdict": "unknown"}
            for a, b in ((-0.3, 0.1), (0.0, 0.05))
        ],
    }
    cells, left_out = cell_cameras(sets, rows, names)
    assert left_out == 0 and [(cell.frame, cell.row) for cell in cells] == [(3, 0), (3, 1), (3, 2), (7, 0), (7, 1)]
    angles = np.array([1.0, 3.0, 5.0])
    places = np.stack([np.cos(angles), np.sin(angles), np.full(3, 0.3)], axis=1)
    places = np.concatenate([places, [[1.85, -1.0, 0.5], [2.15, -1.0, 0.5]]])
    entry = cameras_entry(cells, left_out)
    np.testing.assert_allclose([cell["position"] for cell in entry["cells"]], places, atol=1e-5)
    np.testing.assert_allclose(entry["cells"][0]["direction"], [-np.cos(1.0), -np.sin(1.0), 0.0], atol=1e-5)
    np.testing.assert_allclose(entry["cells"][3]["direction"], [0.0, 1.0, 0.0], atol=1e-5)
    assert [cell["verdict"] for cell in entry["cells"]] == [*KINDS, "unknown", "unknown"]
    for cell in cells:
        # through the corners of the picture
        x, y, z = (cell.rays @ cell.pose[:, :3]).T
        np.testing.assert_allclose(x / -z, [-0.8, 0.8, 0.8, -0.8])
        np.testing.assert_allclose(y / -z, [0.4, 0.4, -0.4, -0.4])

    page = CameraDrawings(cells, left_out, standing(sets), None).html({(3, 1): 4})
    assert "further" not in page and "cameras alone" in page and page.count('data-cell="4"') == 2
    # well-formed: nothing is left open, and no text is taken for a tag
    plots = ElementTree.fromstring(f"<part>{page}</part>").findall("figure/svg")
    assert len(plots) == 2
    for plot, axes in zip(plots, ((0, 1), (0, 2)), strict=True):
        across, up = tick_map(plot, "x"), tick_map(plot, "y")
        shapes = plot.findall("g/path")
        assert sorted(s.get("class", "") for s in shapes) == sorted([*KINDS, "unknown", "unknown"])
        assert [s.get("class") for s in shapes][-1] == "falsified"
        for kind in KINDS:
            wanted = [places[k, list(axes)] for k, cell in enumerate(cells) if cell.verdict == kind]
            drawn = [
                np.array([p.split(",") for p in s.get("d", "").strip("MZ").split("L")], np.float64)
                for s in shapes
                if s.get("class") == kind
            ]
            corners = [np.stack([np.polyval(across, d[:, 0]), np.polyval(up, d[:, 1])]) for d in drawn]
            for place in wanted:
                away = [c - place[:, None] for c in corners]
                if axes == (0, 1):
                    # from above a camera that looks ahead is a corner of a small shape
                    assert any(np.abs(a).max(axis=0).min() < 0.01 and 0.02 < np.abs(a).max() < 0.3 for a in away)
                else:
                    # who looks at one who looks has its tip in the middle
                    assert any((a.min(axis=1) < 0.01).all() and (a.max(axis=1) > -0.01).all() for a in away)


@pytest.mark.parametrize("up", [0, 1, 2])
def test_an_orbit_is_drawn_in_its_plane(up: int) -> None:
    """Whatever is up: the plan shows both coordinates that an orbit changes, and is a circle."""
    axis, eye = np.eye(3)[up] + 0.1, 2.0 * np.eye(3)[(up + 1) % 3]
    turned = np.concatenate([np.eye(3), eye[:, None]], axis=1)
    sets = {0: poses({"orbit": {"target": [0, 0, 0], "axis": axis.tolist(), "azimuth": [0.0, 6.0]}}, turned)}
    assert upward(sets) == up
    low, high = standing(sets)
    plan, side = CameraDrawings([], 0, (low, high), None, upward(sets)).views(300)
    assert set(plan.window.axes) == {0, 1, 2} - {up} and side.window.axes[1] == up
    assert SceneDrawing.sight(plan.window.axes) == (up, 1.0)
    assert min(high[list(plan.window.axes)] - low[list(plan.window.axes)]) > 2.0
    assert upward({0: shifts()}) == 2


def test_the_widest_cells_have_cameras_and_the_others_are_counted() -> None:
    narrow = np.linspace(0.0, 3.0, 1001)
    rows = azimuths(np.append(narrow, [4.0, 5.0, 6.0]))
    cells, left_out = cell_cameras({0: around()}, {0: rows}, NAMES)
    drawn = [cell.row for cell in cells]
    assert len(drawn) == MOST and left_out == len(rows) - MOST and drawn[-3:] == [1000, 1001, 1002]
    # of equal cells, some from everywhere
    assert drawn[0] < 10 and drawn[-4] > 990 and max(np.diff(drawn[:-3])) < 10
    assert f"{left_out} further cells" in CameraDrawings(cells, left_out, standing({0: around()}), None).html({})


def test_cameras_that_stand_still_are_drawn() -> None:
    one = {"lower": [0.0] * 3, "upper": [0.0] * 3, "verdict": "certified"}
    turned = {"lower": [-0.1], "upper": [0.1], "verdict": "unknown"}
    for still, row, names in ((poses(), one, NAMES), (poses({"rotation": {"yaw": 0.1}}), turned, ("yaw",))):
        cells, left_out = cell_cameras({0: still}, {0: [row]}, names)
        np.testing.assert_array_equal(cells[0].pose, AHEAD)
        page = CameraDrawings(cells, left_out, standing({0: still}), None).html({})
        assert page.count(f'<path class="{row["verdict"]}"') == 2 and "nan" not in page
    assert CameraDrawings([], 0, standing({0: poses()}), None).html({}) == ""


def test_what_cameras_look_at_is_shown() -> None:
    """A camera that hardly moves is drawn with what it sees, and not with what is beside or behind it."""
    sets = {0: shifts()}
    pose = sets[0].pose(np.asarray(sets[0].box.middle))
    ahead, across = -pose[:, 2], pose[:, 0]
    places = [pose[:, 3] + 4.0 * ahead, pose[:, 3] + 5.0 * ahead + across, pose[:, 3] + 6.0 * ahead]
    beside = [pose[:, 3] - 3.0 * ahead, pose[:, 3] + 1.0 * ahead + 2.0 * across]
    outside = SceneDrawing(elements(*[(place, np.ones(3), 0.03, 0.9) for place in [*places, *beside]]))
    (point,) = looked_at(sets, outside)
    np.testing.assert_allclose(point, pose[:, 3] + 5.0 * ahead)
    drawings = CameraDrawings([], 0, standing(sets), outside, sights=looked_at(sets, outside))
    for view in drawings.views(300):
        chosen = list(view.window.axes)
        assert (np.array(view.window.low) < point[chosen]).all() and (point[chosen] < view.window.high).all()
    blind = SceneDrawing(elements(*[(place, np.ones(3), 0.03, 0.9) for place in beside]))
    assert looked_at(sets, blind).shape == looked_at(sets, None).shape == (0, 3)


@pytest.mark.slow
def test_the_scene_behind_cameras_is_the_same_in_every_report() -> None:
    rng = np.random.default_rng(5)
    scene = elements(*[(rng.normal(size=3) * 0.3, rng.uniform(size=3), 0.03, 0.9) for _ in range(3000)])
    outside, sets = SceneDrawing(scene), {0: around()}
    found = []
    for count in (1, 700):
        cells, left_out = cell_cameras(sets, {0: azimuths(np.linspace(0.0, 6.0, count + 1))}, NAMES)
        page = CameraDrawings(cells, left_out, standing(sets), outside).html({})
        assert page.count("<path") == 2 * len(cells) and len(page) < 310_000
        found.append(re.findall(r'<image [^>]*href="data:image/png;base64,[^"]*"/>', page))
    assert found[0] == found[1] and len(found[0]) == 2 and "Gaussians" in page


# ---------------------------------------------------------------- films


def frames() -> list[np.ndarray]:
    """A bright bar that moves on, of odd size."""
    found = []
    for k in range(5):
        frame = np.zeros((31, 61, 3), np.uint8)
        frame[:, 10 * k : 10 * k + 10, 1] = 255
        found.append(frame)
    return found


def test_a_gif_shows_every_frame() -> None:
    buffer = io.BytesIO()
    encode_gif(buffer, iter(frames()), 4.0)
    film = Image.open(buffer)
    assert getattr(film, "n_frames", 1) == 5 and film.info["duration"] == 250
    for k, frame in enumerate(frames()):
        film.seek(k)
        np.testing.assert_array_equal(np.asarray(film.convert("RGB")), frame)


def test_an_mp4_shows_every_frame() -> None:
    av = pytest.importorskip("av", reason="needs the extra video")
    buffer = io.BytesIO()
    encode_mp4(buffer, iter(frames()), 4.0)
    buffer.seek(0)
    with av.open(buffer) as container:
        shown = [frame.to_ndarray(format="rgb24").astype(int) for frame in container.decode(video=0)]
    assert len(shown) == 5 and shown[0].shape == (32, 62, 3)
    for picture, frame in zip(shown, frames(), strict=True):
        assert np.abs(picture[:31, :61] - frame).mean() < 20.0


def test_a_film_leaves_files_of_others_alone(tmp_path: Path) -> None:
    (tmp_path / "film.mp4").write_bytes(b"holidays")
    names = []
    for resume in (False, True, False):
        store = Store(tmp_path, {"a": 1}, [("p", "")], {0: {}}, resume=resume)
        names.append(store.keep("film.mp4", b"new").name)
        store.close()
    # our own is written over, and removed when a search begins anew
    assert names == ["film_2.mp4"] * 3 and (tmp_path / "film.mp4").read_bytes() == b"holidays"
    store = Store(tmp_path, {"a": 2}, [("p", "")], {0: {}}, resume=False)
    store.close()
    assert not (tmp_path / "film_2.mp4").exists() and (tmp_path / "film.mp4").exists()


def test_a_full_disk_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(tmp_path, {"a": 1}, [("p", "")], {0: {}}, resume=False)

    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("ns_abstract.verify.store_file.write_atomic", full)
    with pytest.raises(InputError, match="No space left"):
        store.keep("film.mp4", b"new")
    store.close()
