"""Reading camera paths: geometry, down-scaling, and what is refused."""

from __future__ import annotations

import json
import math
import os
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ns_abstract.geometry.camera_path import CameraPath, load_camera_path
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import is_number, load_json, parse_json

RUNS = Path(__file__).parents[2] / "shared" / "runs"
POSE = [0.0, 0.0, 1.0, 2.0, 1.0, 0.0, 0.0, -0.5, 0.0, 1.0, 0.0, 0.25, 0.0, 0.0, 0.0, 1.0]


def content() -> dict[str, Any]:
    """What the viewer writes for two frames."""
    return {
        "default_fov": 75.0,
        "default_transition_sec": 2.0,
        "keyframes": [{"matrix": POSE, "fov": 75.0, "aspect": 1.5, "override_transition_enabled": False}],
        "camera_type": "perspective",
        "render_height": 200,
        "render_width": 300,
        "fps": 30.0,
        "seconds": 2.0,
        "is_cycle": True,
        "smoothness_value": 0.5,
        "camera_path": [
            {"camera_to_world": POSE, "fov": 60.0, "aspect": 1.5},
            {"camera_to_world": POSE, "fov": 45.0, "aspect": 1.5, "render_time": 0.5},
        ],
    }


def write(folder: Path, data: Any) -> Path:
    path = folder / "path.json"
    if isinstance(data, bytes):
        path.write_bytes(data)
    else:
        path.write_text(data if isinstance(data, str) else json.dumps(data, indent=1))
    return path


def refused(path: Path, *mentions: str, factor: Any = 1) -> InputError:
    """Load ``path`` and check the form of the error."""
    with pytest.raises(InputError) as caught:
        load_camera_path(path, factor)
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    assert caught.value.file and message.startswith(caught.value.file)
    assert caught.value.fix
    for mention in mentions:
        assert mention in message
    return caught.value


def test_geometry(tmp_path: Path) -> None:
    path = load_camera_path(write(tmp_path, content()))
    assert len(path.cameras) == 2
    camera = path.cameras[0]
    assert (camera.width, camera.height, camera.cx, camera.cy) == (300, 200, 150.0, 100.0)
    assert camera.fx == camera.fy == pytest.approx(100 / math.tan(math.radians(30)), rel=1e-15)
    assert camera.camera_to_world.dtype == np.float64
    assert camera.camera_to_world.tolist() == [POSE[0:4], POSE[4:8], POSE[8:12]]
    assert not camera.camera_to_world.flags.writeable
    assert (path.fps, path.is_cycle, path.source) == (30.0, True, str(tmp_path / "path.json"))
    assert path.perturbation is None and path.overrides == (None, None)


@pytest.mark.parametrize("name", ["playbot_lod4", "plant", "airplane"])
def test_real_paths(name: str) -> None:
    file = RUNS / name / "camera_path.json"
    if not file.exists():
        pytest.skip(f"no camera path {file}")
    path = load_camera_path(file)
    assert isinstance(path, CameraPath) and len(path.cameras) == 5
    for camera in path.cameras:
        assert (camera.width, camera.height) == (200, 200)
        assert camera.fx == 241.4213562373095  # of nerfstudio 1.1.5, get_path_from_json


def test_real_perturbation() -> None:
    file = RUNS / "airplane" / "camera_path_orbit.json"
    if not file.exists():
        pytest.skip(f"no camera path {file}")
    path = load_camera_path(file)
    found = path.perturbation_of(0)
    assert found is not None and found["orbit"]["azimuth"] == [0, 2 * math.pi]


# height, width, factor; then fx, cx, cy, height, width of nerfstudio 1.1.5
# (get_path_from_json, Cameras.rescale_output_resolution(1 / factor), fov 45).
RESCALED = [
    (200, 200, 3, 80.4737878107422, 33.333335876464844, 33.333335876464844, 66, 66),
    (1080, 1920, 7, 186.23934028004282, 137.1428680419922, 77.14286041259766, 154, 274),
    (49, 49, 49, 1.20710675645402, 0.5, 0.5, 1, 1),
    (1080, 1920, 1.5, 869.1169083560158, 640.0, 360.0, 720, 1280),
    (107, 113, 2, 64.5802127934803, 28.25, 26.75, 53, 56),
]


@pytest.mark.parametrize("case", RESCALED)
def test_downscale_agrees_with_nerfstudio(tmp_path: Path, case: tuple[float, ...]) -> None:
    height, width, factor, focal, cx, cy, rows, columns = case
    data = {**content(), "render_height": height, "render_width": width}
    camera = load_camera_path(write(tmp_path, data), factor).cameras[1]
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (focal, focal, cx, cy)
    assert (camera.height, camera.width) == (rows, columns)


def test_upscale(tmp_path: Path) -> None:
    camera = load_camera_path(write(tmp_path, content()), 0.5).cameras[0]
    assert (camera.width, camera.height, camera.cx) == (600, 400, 300.0)


def test_perturbations(tmp_path: Path) -> None:
    data = content()
    data["perturbation"] = {"version": 1, "rotation": {"yaw": 0.1}}
    data["camera_path"][1]["perturbation"] = {"version": 1}
    path = load_camera_path(write(tmp_path, data))
    assert path.overrides == (None, {"version": 1})
    assert path.perturbation_of(0) == data["perturbation"]
    assert path.perturbation_of(1) == {"version": 1}


def test_accepted_variants(tmp_path: Path) -> None:
    data = content()
    data |= {
        "render_height": 200.0,
        "crop": None,
        "camera_type": "Perspective",
        "is_cycle": None,
        "extra": [1],
    }
    del data["fps"]
    del data["camera_path"][0]["fov"], data["camera_path"][1]["fov"]
    data["camera_path"][1]["camera_to_world"] = [POSE[i : i + 4] for i in range(0, 16, 4)]
    path = load_camera_path(write(tmp_path, b"\xef\xbb\xbf" + json.dumps(data).encode()))
    assert path.cameras[0].height == 200 and isinstance(path.cameras[0].height, int)
    assert path.cameras[0].fx == path.cameras[1].fx == pytest.approx(100 / math.tan(math.radians(37.5)))
    assert np.array_equal(path.cameras[0].camera_to_world, path.cameras[1].camera_to_world)
    assert (path.fps, path.is_cycle) == (None, False)


def test_camera_type_may_be_absent(tmp_path: Path) -> None:
    data = content()
    del data["camera_type"]
    assert len(load_camera_path(write(tmp_path, data)).cameras) == 2


def test_small_errors_of_rotation_are_kept(tmp_path: Path) -> None:
    data = content()
    data["camera_path"][0]["camera_to_world"] = [*POSE[:2], 1.0004, *POSE[3:]]
    assert load_camera_path(write(tmp_path, data)).cameras[0].camera_to_world[0, 2] == 1.0004


def _text(old: str, new: str) -> str:
    text = json.dumps(content(), indent=1)
    assert old in text
    return text.replace(old, new, 1)


def _top(**changes: Any) -> dict[str, Any]:
    return {name: value for name, value in {**content(), **changes}.items() if value is not ...}


def _entry(**changes: Any) -> dict[str, Any]:
    data = content()
    entry = {**data["camera_path"][1], **changes}
    data["camera_path"][1] = {name: value for name, value in entry.items() if value is not ...}
    return data


def _pose(**changes: float) -> dict[str, Any]:
    pose: list[Any] = list(POSE)
    for position, value in changes.items():
        pose[int(position[1:])] = value
    return _entry(camera_to_world=pose)


def _no_fov() -> dict[str, Any]:
    data = _entry(fov=...)
    del data["default_fov"]
    return data


C2W = "camera_path[1].camera_to_world"
BAD: dict[str, tuple[Any, tuple[str, ...]]] = {
    "empty": ("", ("empty",)),
    "blank": (" \n ", ("empty",)),
    "not UTF-8": (b'{"a": "\xff"}', ("UTF-8",)),
    "UTF-16": ("{}".encode("utf-16"), ("UTF-8",)),
    "binary": (bytes(range(256)), ("UTF-8",)),
    "syntax": (_text('"fps": 30.0,', '"fps": 30.0'), ("line 33",)),
    "truncated early": (json.dumps(content())[:40], ("line 1",)),
    "truncated late": (json.dumps(content(), indent=1)[:-20], ("line",)),
    "comment": ("// path\n{}", ("line 1",)),
    "single quotes": ("{'a': 1}", ("line 1",)),
    "trailing text": (json.dumps(content()) + "x", ("line 1",)),
    "deep lists": ("[" * 100_000 + "]" * 100_000, ("nested",)),
    "deep objects": ('{"a":' * 200 + "1" + "}" * 200, ("nested", "line 1")),
    "top level a list": ([1, 2], ("top level",)),
    "top level null": ("null", ("top level",)),
    "NaN": (_text('"seconds": 2.0', '"seconds": NaN'), ("NaN", "line 33")),
    "infinity": (_text('"seconds": 2.0', '"seconds": -Infinity'), ("-Infinity", "line")),
    "number too large": (_text('"seconds": 2.0', '"seconds": 1e999'), ("too large", "line")),
    "integer too large": (_text('"seconds": 2.0', '"seconds": ' + "9" * 400), ("too large", "line")),
    "integer of 5000 digits": (_text('"seconds": 2.0', '"seconds": ' + "9" * 5000), ("too large",)),
    "key twice": (_text('"fps": 30.0', '"fps": 24,\n "fps": 30.0'), ("fps", "twice", "line")),
    "key twice, escaped": (_text('"fps": 30.0', '"fps": 24, "f\\u0070s": 30.0'), ("fps", "twice")),
    "key twice in an entry": (_text('"fov": 60.0', '"fov": 60.0, "fov": 60.0'), ("fov", "twice")),
    "no height": (_top(render_height=...), ("render_height", "missing")),
    "height text": (_top(render_height="200"), ("render_height", "'200'")),
    "height 0": (_top(render_height=0), ("render_height",)),
    "height negative": (_top(render_height=-5), ("render_height",)),
    "height a fraction": (_top(render_height=10.5), ("render_height",)),
    "height true": (_top(render_height=True), ("render_height",)),
    "width too large": (_top(render_width=16385), ("render_width", "16384")),
    "width huge": (_top(render_width=10**300), ("render_width",)),
    "width a list": (_top(render_width=[300]), ("render_width",)),
    "no cameras": (_top(camera_path=...), ("camera_path", "missing")),
    "empty cameras": (_top(camera_path=[], keyframes=[]), ("camera_path", "at least one")),
    "cameras an object": (_top(camera_path={}), ("camera_path",)),
    "entry a list": (_top(camera_path=[[1]]), ("camera_path[0]",)),
    "entry null": (_top(camera_path=[None]), ("camera_path[0]",)),
    "fisheye": (_top(camera_type="fisheye"), ("camera_type", "fisheye", "perspective")),
    "equirectangular": (_top(camera_type="equirectangular"), ("camera_type",)),
    "camera type null": (_top(camera_type=None), ("camera_type",)),
    "crop": (_top(crop={"crop_center": [0, 0, 0]}), ("crop", "changes the picture")),
    "crop of an entry": (_entry(crop={}), ("camera_path[1].crop",)),
    "no pose": (_entry(camera_to_world=...), (C2W, "missing")),
    "pose text": (_entry(camera_to_world="identity"), (C2W,)),
    "pose of 15": (_entry(camera_to_world=POSE[:15]), (C2W, "15")),
    "pose of 12": (_entry(camera_to_world=POSE[:12]), (C2W, "16 numbers")),
    "pose 3x4": (_entry(camera_to_world=[POSE[0:4], POSE[4:8], POSE[8:12]]), (C2W,)),
    "pose 4x3": (_entry(camera_to_world=[[1, 0, 0]] * 4), (f"{C2W}[0]",)),
    "pose holds text": (_pose(_3="x"), (f"{C2W}[3]",)),  # type: ignore[arg-type]
    "pose holds null": (_pose(_3=None), (f"{C2W}[3]",)),  # type: ignore[arg-type]
    "pose too large": (_pose(_3=1e39), (f"{C2W}[3]", "float32")),
    "pose column by column": (
        _entry(camera_to_world=np.array(POSE).reshape(4, 4).T.flatten().tolist()),
        (C2W, "last row", "row by row"),
    ),
    "last element 0": (_pose(_15=0.0), (C2W, "last row")),
    "rotation scaled": (_pose(_2=2.0), (C2W, "3 away from orthonormal")),
    "rotation slightly off": (_pose(_2=1.001), (C2W, "0.002 away", "0.001")),
    "rotation zero": (_pose(_2=0.0, _4=0.0, _9=0.0), (C2W, "orthonormal")),
    "rotation huge": (_pose(_2=1e38, _4=1e38), (C2W, "orthonormal")),
    "mirror": (_pose(_2=-1.0), (C2W, "mirror")),
    "fov 0": (_entry(fov=0), ("camera_path[1].fov",)),
    "fov 180": (_entry(fov=180), ("camera_path[1].fov", "180")),
    "fov negative": (_entry(fov=-3.0), ("camera_path[1].fov",)),
    "fov text": (_entry(fov="45"), ("camera_path[1].fov",)),
    # Nerfstudio draws it with a focal length of 50 pixels, not with default_fov
    "fov null": (_entry(fov=None), ("camera_path[1].fov", "null")),
    "fov true": (_entry(fov=True), ("camera_path[1].fov",)),
    "fov tiny": (_entry(fov=1e-300), ("camera_path[1].fov", "focal")),
    "no fov at all": (_no_fov(), ("camera_path[1].fov", "default_fov")),
    "default fov": ({**_entry(fov=...), "default_fov": 200}, ("default_fov",)),
    "perturbation a list": (_top(perturbation=[1]), ("perturbation",)),
    "perturbation of an entry": (_entry(perturbation=0.1), ("camera_path[1].perturbation",)),
    "fps 0": (_top(fps=0), ("fps",)),
    "fps text": (_top(fps="24"), ("fps",)),
    "cycle a number": (_top(is_cycle=1), ("is_cycle",)),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_path(tmp_path: Path, case: str) -> None:
    data, mentions = BAD[case]
    refused(write(tmp_path, data), "path.json", *mentions)


@pytest.mark.parametrize("factor", [0, -1, float("nan"), float("inf"), 201, 1e30, 1e-30, 1e-320, 0.01, True, "2"])
def test_bad_factor(tmp_path: Path, factor: Any) -> None:
    refused(write(tmp_path, content()), "--downscale-factor", factor=factor)


def test_bad_files(tmp_path: Path) -> None:
    refused(tmp_path / "absent.json", "no such camera path")
    refused(tmp_path, "folder")
    loop = tmp_path / "loop.json"
    loop.symlink_to(loop)
    refused(loop, "links")
    os.mkfifo(tmp_path / "fifo.json")
    refused(tmp_path / "fifo.json", "regular")
    refused(tmp_path / "a\0b.json", "path")
    refused(write(tmp_path, "method_name: splatfacto"), "give a JSON file")
    refused(write(tmp_path, '{"version": 1,}'), "correct the syntax")
    with pytest.raises(InputError, match="limit of 100"):
        load_json(write(tmp_path, content()), limit=100)


def test_large_file(tmp_path: Path) -> None:
    path = tmp_path / "path.json"
    with path.open("wb") as stream:
        stream.truncate(2**33)
    refused(path, "limit")


# The strict JSON reader


@pytest.mark.parametrize(
    "text",
    [
        '{"a": [1, -2.5e-3, true, null, "x\\"y: [{", {"a": {"a": 1}}], "b": "NaN 1e999"}',
        '[{"a": 1}, {"a": 2}]',
        '"a"',
        "0",
        "-1.7976931348623157e308",
        "[" * 64 + "]" * 64,
    ],
)
def test_strict_json_agrees_with_json(text: str) -> None:
    assert parse_json(text) == json.loads(text)


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)


@pytest.mark.slow
@settings(max_examples=150, deadline=None, database=None, derandomize=True)
@given(value=values, indent=st.sampled_from([None, 1]), plain=st.booleans())
def test_strict_json_round_trip(value: Any, indent: int | None, plain: bool) -> None:
    assert parse_json(json.dumps(value, indent=indent, ensure_ascii=plain)) == value


@settings(max_examples=150, deadline=None, database=None, derandomize=True)
@given(text=st.text(alphabet='{}[]":,\\0123456789.eE+-NaInfity truls\n', max_size=40))
def test_strict_json_refuses_or_parses(text: str) -> None:
    try:
        parse_json(text)
    except InputError as error:
        assert len(str(error).splitlines()) == 1


@pytest.mark.parametrize(
    ("value", "number"),
    [(1, True), (0.5, True), (True, False), (None, False), (10**400, False), (math.nan, False)],
)
def test_is_number(value: Any, number: bool) -> None:
    assert is_number(value) is number


FUZZ = settings(
    max_examples=150,
    deadline=None,
    database=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


@pytest.mark.slow
@FUZZ
@given(seed=st.integers(0, 2**32), flips=st.integers(1, 8))
def test_fuzzed_path(tmp_path: Path, seed: int, flips: int) -> None:
    generator = random.Random(seed)
    data = bytearray(json.dumps(content()).encode())
    for _ in range(flips):
        where = generator.randrange(len(data))
        if generator.random() < 0.5:
            data[where] ^= 1 << generator.randrange(8)
        else:
            data[where] = generator.choice(b'0919eE-.,:[]{}"\\ tn\0\xff')
    try:
        load_camera_path(write(tmp_path, bytes(data)), 2)
    except InputError as error:
        assert len(str(error).splitlines()) == 1


@pytest.mark.slow
@FUZZ
@given(field=st.sampled_from(sorted(content())), value=values)
def test_fuzzed_fields(tmp_path: Path, field: str, value: Any) -> None:
    try:
        load_camera_path(write(tmp_path, {**content(), field: value}))
    except InputError as error:
        assert len(str(error).splitlines()) == 1


@pytest.mark.slow
@FUZZ
@given(field=st.sampled_from(["camera_to_world", "fov", "aspect", "crop", "perturbation"]), value=values)
def test_fuzzed_entries(tmp_path: Path, field: str, value: Any) -> None:
    try:
        load_camera_path(write(tmp_path, _entry(**{field: value})))
    except InputError as error:
        assert len(str(error).splitlines()) == 1
