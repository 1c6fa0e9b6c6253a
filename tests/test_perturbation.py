"""The perturbation object: what it means, and what is refused by name."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ns_abstract.io.errors import InputError
from ns_abstract.perturbation.specification import Orbit, Perturbation, load_perturbation, parse_perturbation

ORBIT = {"target": [0, 0, 0], "axis": [0, 0, 1], "azimuth": [0, 6.2832]}


def without(key: str) -> dict:
    return {k: v for k, v in ORBIT.items() if k != key}


REFUSED = [
    (None, "perturbation"),
    ([], "perturbation"),
    ("x", "perturbation"),
    (1, "perturbation"),
    ({"translations": {}}, "translations"),
    ({"": 1}, "perturbation"),
    ({"version": 2}, "version"),
    ({"version": "1"}, "version"),
    ({"version": True}, "version"),
    ({"version": None}, "version"),
    ({"version": [1]}, "version"),
    ({"frame": "object"}, "frame"),
    ({"frame": None}, "frame"),
    ({"frame": 0}, "frame"),
    ({"units": "metres"}, "units"),
    ({"units": True}, "units"),
    ({"sweep": "segment"}, "sweep"),
    ({"sweep": 1}, "sweep"),
    ({"hue": 1.5}, "hue"),
    ({"hue": [0.2, 0.1]}, "hue"),
    ({"saturation": "half"}, "saturation"),
    ({"scene": []}, "scene"),
    ({"scene": {}}, "scene"),
    ({"scene": None}, "scene"),
    ({"scene": [1]}, "scene[0]"),
    ({"scene": [{"mean": 0.1}]}, "scene[0].select"),
    ({"scene": [{"select": None, "mean": 0.1}]}, "scene[0].select"),
    ({"scene": [{"select": {}}]}, "scene[0]"),
    ({"scene": [{"select": {}, "scale": 0.1}]}, "scene[0].scale"),
    ({"scene": [{"select": {}, "mean": -0.1}]}, "scene[0].mean"),
    ({"scene": [{"select": {}, "mean": [0.2, 0.1]}]}, "scene[0].mean"),
    ({"scene": [{"select": {}, "mean": math.inf}]}, "scene[0].mean"),
    ({"scene": [{"select": {}, "opacity": [0, math.nan]}]}, "scene[0].opacity"),
    ({"scene": [{"select": {}, "opacity": True}]}, "scene[0].opacity"),
    ({"scene": [{"select": {}, "color": [0, 0, 0]}]}, "scene[0].color"),
    ({"scene": [{"select": {}, "mean": 0.1}, {"select": {"sphere": 1}, "mean": 0.1}]}, "scene[1].select.sphere"),
    ({"scene": [{"select": {"box": [[0, 0, 0]]}, "mean": 0.1}]}, "scene[0].select.box"),
    ({"scene": [{"select": {"box": [[0, 0, 0], [1, 1]]}, "mean": 0.1}]}, "scene[0].select.box"),
    ({"scene": [{"select": {"box": [[0, 0, 2], [1, 1, 1]]}, "mean": 0.1}]}, "scene[0].select.box"),
    ({"scene": [{"select": {"box": [[0, 0, math.nan], [1, 1, 1]]}, "mean": 0.1}]}, "scene[0].select.box"),
    ({"scene": [{"select": {"opacity": 0.5}, "mean": 0.1}]}, "scene[0].select.opacity"),
    ({"scene": [{"select": {"opacity": [1, 0]}, "mean": 0.1}]}, "scene[0].select.opacity"),
    ({"scene": [{"select": {"color": {}}, "mean": 0.1}]}, "scene[0].select.color"),
    ({"scene": [{"select": {"color": {"mid": [0, 0, 0]}}, "mean": 0.1}]}, "scene[0].select.color.mid"),
    ({"scene": [{"select": {"color": {"min": [0, 0]}}, "mean": 0.1}]}, "scene[0].select.color.min"),
    ({"scene": [{"select": {"color": {"min": [0, 1, 0], "max": [1, 0, 1]}}, "mean": 0.1}]}, "scene[0].select.color"),
    ({"scene": [{"select": {"indices": []}, "mean": 0.1}]}, "scene[0].select.indices"),
    ({"scene": [{"select": {"indices": [0.5]}, "mean": 0.1}]}, "scene[0].select.indices"),
    ({"scene": [{"select": {"indices": [True]}, "mean": 0.1}]}, "scene[0].select.indices"),
    ({"scene": [{"select": {"indices": [-1]}, "mean": 0.1}]}, "scene[0].select.indices"),
    ({"scene": [{"select": {"indices": {}}, "mean": 0.1}]}, "scene[0].select.indices"),
    ({"scene": [{"select": {"indices": "none.npy"}, "mean": 0.1}]}, "scene[0].select.indices"),
    ({"scene": [{"select": {"indices": "none.csv"}, "mean": 0.1}]}, "scene[0].select.indices"),
    ({"translation": 0.1}, "translation"),
    ({"translation": [0.1, 0.1, 0.1]}, "translation"),
    ({"translation": None}, "translation"),
    ({"translation": {"w": 0.1}}, "translation.w"),
    ({"translation": {"yaw": 0.1}}, "translation.yaw"),
    ({"translation": {"x": -0.1}}, "translation.x"),
    ({"translation": {"x": None}}, "translation.x"),
    ({"translation": {"x": True}}, "translation.x"),
    ({"translation": {"x": "0.1"}}, "translation.x"),
    ({"translation": {"x": []}}, "translation.x"),
    ({"translation": {"x": [0.1]}}, "translation.x"),
    ({"translation": {"x": [0, 1, 2]}}, "translation.x"),
    ({"translation": {"x": [0.2, 0.1]}}, "translation.x"),
    ({"translation": {"x": [0, None]}}, "translation.x"),
    ({"translation": {"x": [False, True]}}, "translation.x"),
    ({"translation": {"x": [0, math.inf]}}, "translation.x"),
    ({"translation": {"y": [math.nan, 1]}}, "translation.y"),
    ({"translation": {"y": math.nan}}, "translation.y"),
    ({"translation": {"z": math.inf}}, "translation.z"),
    ({"translation": {"z": 10**400}}, "translation.z"),
    ({"rotation": []}, "rotation"),
    ({"rotation": {"x": 0.1}}, "rotation.x"),
    ({"rotation": {"yaw": {"low": 0}}}, "rotation.yaw"),
    ({"rotation": {"pitch": [1, 0]}}, "rotation.pitch"),
    ({"rotation": {"roll": -1}}, "rotation.roll"),
    ({"orbit": []}, "orbit"),
    ({"orbit": {}}, "orbit.target"),
    ({"orbit": without("target")}, "orbit.target"),
    ({"orbit": without("axis")}, "orbit.axis"),
    ({"orbit": without("azimuth")}, "orbit.azimuth"),
    ({"orbit": ORBIT | {"radius": 1}}, "orbit.radius"),
    ({"orbit": ORBIT | {"target": [0, 0]}}, "orbit.target"),
    ({"orbit": ORBIT | {"target": [0, 0, math.nan]}}, "orbit.target"),
    ({"orbit": ORBIT | {"target": 0}}, "orbit.target"),
    ({"orbit": ORBIT | {"axis": [0, 0, 0]}}, "orbit.axis"),
    ({"orbit": ORBIT | {"axis": [0, "1", 0]}}, "orbit.axis"),
    ({"orbit": ORBIT | {"axis": [1e200, 1e200, 0]}}, "orbit.axis"),
    ({"orbit": ORBIT | {"azimuth": [1, 0]}}, "orbit.azimuth"),
    ({"orbit": ORBIT | {"azimuth": [0, 1e308]}}, "orbit.azimuth"),
    ({"orbit": ORBIT | {"target": [0, 1e300, 0]}}, "orbit.target"),
    # the width of these overflows
    ({"translation": {"x": 1e308}}, "translation.x"),
    ({"translation": {"x": 1, "z": [-1e16, 0]}}, "translation.z"),
    ({"rotation": {"roll": 1e308}}, "rotation.roll"),
    ({"scene": [{"select": {}, "color": 0.1}, {"select": {}, "mean": 1e308}]}, "scene[1].mean"),
    ({"orbit": ORBIT | {"azimuth": None}}, "orbit.azimuth"),
]


@pytest.mark.parametrize("value, field", REFUSED, ids=[str(i) for i in range(len(REFUSED))])
def test_refused(value, field):
    with pytest.raises(InputError) as caught:
        parse_perturbation(value)
    assert caught.value.field in (f"perturbation.{field}", field)
    text = str(caught.value)
    assert field in text and "\n" not in text and caught.value.fix


def test_meaning():
    found = parse_perturbation(
        {
            "version": 1,
            "frame": "world",
            "translation": {"x": 0.02, "y": [-0.01, 0.03]},
            "rotation": {"yaw": 0.01, "pitch": 0.0, "roll": [0, 0.02]},
            "sweep": "segments",
            "orbit": ORBIT,
        }
    )
    assert found == Perturbation(
        frame="world",
        translation={"x": (-0.02, 0.02), "y": (-0.01, 0.03)},
        rotation={"yaw": (-0.01, 0.01), "pitch": (0.0, 0.0), "roll": (0.0, 0.02)},
        sweep="segments",
        orbit=Orbit((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 6.2832)),
    )


def test_defaults():
    assert parse_perturbation({}) == Perturbation()
    assert parse_perturbation({"orbit": None}).orbit is None


def test_degrees():
    """Angles alone are converted, the orbit's too; the same set reads the same in radians."""
    value = {"angle_units": "degrees", "translation": {"x": 2.0}, "rotation": {"yaw": 180, "roll": [-90, 45]},
             "orbit": {"target": [1, 2, 3], "axis": [0, 0, 1], "azimuth": [0, 360]}}  # fmt: skip
    found = parse_perturbation(value)
    assert found.rotation == {"yaw": (-math.pi, math.pi), "roll": (-math.pi / 2, math.pi / 4)}
    assert found.orbit is not None and found.orbit.azimuth == (0.0, 2 * math.pi)
    assert found.translation == {"x": (-2.0, 2.0)} and found.orbit.target == (1.0, 2.0, 3.0)
    assert parse_perturbation(value | {"angle_units": "radians"}).rotation["yaw"] == (-180.0, 180.0)
    for wrong in ("deg", 1, None):
        with pytest.raises(InputError, match="angle_units"):
            parse_perturbation(value | {"angle_units": wrong})


def test_dataset_units_that_no_scene_states_are_refused():
    value = {"units": "dataset", "translation": {"x": 2.0}}
    with pytest.raises(InputError, match=r"perturbation\.units: found dataset.*dataparser_transforms\.json"):
        parse_perturbation(value, dataset_scale=None)
    assert parse_perturbation(value | {"units": "normalised"}, dataset_scale=None).translation["x"] == (-2.0, 2.0)
    # no length is stated
    assert not parse_perturbation({"units": "dataset", "rotation": {"yaw": 0.1}}, dataset_scale=None).translation


def test_dataset_units():
    """Lengths in the units of transforms.json are scaled; angles are not."""
    value = {"units": "dataset", "translation": {"x": 2.0, "z": [1, 3]}, "rotation": {"yaw": 0.5}}
    found = parse_perturbation(value, dataset_scale=0.25)
    assert found.translation == {"x": (-0.5, 0.5), "z": (0.25, 0.75)}
    assert found.rotation == {"yaw": (-0.5, 0.5)}
    same = parse_perturbation(value | {"units": "normalised"}, dataset_scale=0.25)
    assert same.translation == {"x": (-2.0, 2.0), "z": (1.0, 3.0)}


@given(st.floats(0.0, 1e6), st.floats(-1e6, 1e6), st.floats(-1e6, 1e6))
@settings(max_examples=50, deadline=None)
def test_ranges(radius, one, other):
    low, high = min(one, other), max(one, other)
    found = parse_perturbation({"translation": {"x": radius, "y": [low, high]}})
    assert found.translation == {"x": (-radius, radius), "y": (low, high)}


def test_file(tmp_path):
    """A specification file, or a camera path that holds one; errors name the file."""
    spec = tmp_path / "spec.json"
    spec.write_text(json.dumps({"translation": {"x": 0.5}}))
    path = tmp_path / "path.json"
    path.write_text(json.dumps({"camera_path": [], "perturbation": {"translation": {"x": 0.5}}}))
    assert load_perturbation(spec) == load_perturbation(path) == Perturbation(translation={"x": (-0.5, 0.5)})
    for text, field in (('{"frame": "up"}', "frame"), ("{", None), ('{"hue": 2}', "hue"), ("[]", None), ("NaN", None)):
        spec.write_text(text)
        with pytest.raises(InputError) as caught:
            load_perturbation(spec)
        assert caught.value.file == str(spec)
        assert field is None or caught.value.field == field
    with pytest.raises(InputError):
        load_perturbation(tmp_path / "absent.json")
