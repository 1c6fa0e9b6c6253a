"""Property files, what they prove, and the preprocessing that is part of what is bounded."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ns_abstract.api.certification import PropertySource
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.keyframe_cameras import look_at
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.io.atomic import write_json
from ns_abstract.io.errors import InputError
from ns_abstract.perturbation.specification import parse_perturbation
from ns_abstract.verify.network import OutputBounds
from ns_abstract.verify.preprocess import Preprocess, parse_preprocess
from ns_abstract.verify.properties import Claim, DetectionClaim, TrueValues, decode
from ns_abstract.verify.property_reading import parse_property
from ns_abstract.verify.vnnlib import load_vnnlib

SHAPE = (3, 16, 16)
HEAD = (3, 12, 12), (125, 3, 3)


def camera() -> PinholeCamera:
    return PinholeCamera(look_at((1.5, 0.4, 0.6), (0.0, 0.0, 0.0))[:3], 20.0, 20.0, 8.0, 8.0, 16, 16)


def poses(spec: dict[str, Any] | None = None) -> PoseBox:
    return PoseBox.around(camera(), parse_perturbation(spec or {"translation": {"x": 0.1}, "rotation": {"yaw": 0.05}}))


def parsed(tmp_path: Path, value: Any, shapes: Any = (SHAPE, (10,))) -> Any:
    return loaded(write_json(tmp_path / "prop.json", value), *shapes)


def loaded(file: Path, *shapes: Any) -> Any:
    source = PropertySource.of(file)
    try:
        return parse_property(source.value, source.folder, *shapes)
    except InputError as error:
        raise source.within(error) from None


# ---------------------------------------------------------------- mistakes

BAD: dict[str, tuple[Any, str, Any]] = {
    "no object": ([1], "top level", None),
    "no type": ({"label": 1}, "type", None),
    "type": ({"type": "segmentation"}, "type", None),
    "type is a list": ({"type": ["classification"]}, "type", None),
    "unknown key": ({"type": "classification", "label": 1, "lable": 1}, "lable", None),
    "no label": ({"type": "classification"}, "label: missing", None),
    "label is text": ({"type": "classification", "label": "cat"}, "label", None),
    "label is true": ({"type": "classification", "label": True}, "label", None),
    "label too large": ({"type": "classification", "label": 10}, "label", None),
    "negative label": ({"type": "classification", "label": -1}, "label", None),
    "partitions 0": ({"type": "classification", "label": 1, "partitions": 0}, "partitions", None),
    "partitions 1.5": ({"type": "classification", "label": 1, "partitions": [1.5]}, "partitions", None),
    "no target": ({"type": "regression", "tolerance": {"relative": 0.2}}, "target", None),
    "target word": ({"type": "regression", "target": "pose", "tolerance": {"relative": 0.2}}, "target", None),
    "target length": ({"type": "regression", "target": [1, 2], "tolerance": {"relative": 0.2}}, "target", None),
    "no tolerance": ({"type": "regression", "target": [0] * 10}, "tolerance", None),
    "two tolerances": (
        {"type": "regression", "target": [0] * 10, "tolerance": {"relative": 1, "absolute": 1}}, "tolerance", None,
    ),
    "tolerance 0": (
        {"type": "regression", "target": [0] * 10, "tolerance": {"relative": 0}}, "tolerance.relative", None,
    ),
    "origin": (
        {"type": "regression", "target": [0] * 10, "origin": [0, 0], "tolerance": {"relative": 1}}, "origin", None,
    ),
    "scale": ({"type": "regression", "target": [0] * 10, "scale": 0, "tolerance": {"relative": 1}}, "scale", None),
    **{
        f"{name} {number:g}": (
            {"type": "regression", "target": [0] * 10, "tolerance": {"relative": 1}} | {name: value}, name, None,
        )
        for number in (1e308, -1e308, 1e-200)
        for name, value in {
            "target": [0] * 9 + [number], "origin": [0, 0, number], "scale": number, "tolerance": {"absolute": number},
        }.items()
    },
    "std 1e-300": ({"type": "classification", "label": 1, "preprocess": {"std": [1, 1e-300, 1]}}, "std", None),
    "mean 1e300": ({"type": "classification", "label": 1, "preprocess": {"mean": [1, 1e300, 1]}}, "mean", None),
    "range 1e300": ({"type": "classification", "label": 1, "preprocess": {"range": [0, 1e300]}}, "range", None),
    "box 1e308": (
        {"type": "detection", "class": 7, "iou": 0.1, "confidence": 0.4, "box": [0, 0, 1e308, 1e308]}, "box", HEAD,
    ),
    "confidence 1e-320": ({"type": "detection", "class": 7, "iou": None, "confidence": 1e-320}, "confidence", HEAD),
    "no head": ({"type": "detection", "class": 7, "iou": 0.5, "confidence": 0.4}, "type", None),
    "no class": ({"type": "detection", "iou": 0.5, "confidence": 0.4}, "class", HEAD),
    "class": ({"type": "detection", "class": 20, "iou": 0.5, "confidence": 0.4}, "class", HEAD),
    "confidence": ({"type": "detection", "class": 7, "iou": 0.5, "confidence": 1.4}, "confidence", HEAD),
    "no confidence": ({"type": "detection", "class": 7, "iou": 0.5}, "confidence", HEAD),
    "iou": ({"type": "detection", "class": 7, "iou": 0, "confidence": 0.4}, "iou", HEAD),
    "box": ({"type": "detection", "class": 7, "iou": 0.5, "confidence": 0.4, "box": [5, 0, 1, 9]}, "box", HEAD),
    "box without iou": (
        {"type": "detection", "class": 7, "iou": None, "confidence": 0.4, "box": [0, 0, 1, 9]}, "box", HEAD,
    ),
    "no file": ({"type": "vnnlib"}, "file", None),
    "absent file": ({"type": "vnnlib", "file": "none.vnnlib"}, "none.vnnlib", None),
    "preprocess": ({"type": "classification", "label": 1, "preprocess": 3}, "preprocess", None),
    "preprocess key": ({"type": "classification", "label": 1, "preprocess": {"crop": 3}}, "preprocess.crop", None),
    "std 0": ({"type": "classification", "label": 1, "preprocess": {"std": [1, 0, 1]}}, "preprocess.std", None),
    "mean": ({"type": "classification", "label": 1, "preprocess": {"mean": [1, 0]}}, "preprocess.mean", None),
    "layout": ({"type": "classification", "label": 1, "preprocess": {"layout": "HWC"}}, "preprocess.layout", None),
    "layout of another network": (
        {"type": "classification", "label": 1, "preprocess": {"layout": "NHWC"}}, "preprocess.layout", None,
    ),
    "resize": ({"type": "classification", "label": 1, "preprocess": {"resize": [8, 8]}}, "preprocess.resize", None),
    "resize text": ({"type": "classification", "label": 1, "preprocess": {"resize": "8"}}, "preprocess.resize", None),
    "range": ({"type": "classification", "label": 1, "preprocess": {"range": [1, 0]}}, "preprocess.range", None),
    "channels": (
        {"type": "classification", "label": 1, "preprocess": {"channels": "GBR"}}, "preprocess.channels", None,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_mistake_names_file_field_and_fix(name: str, tmp_path: Path) -> None:
    value, fragment, shapes = BAD[name]
    with pytest.raises(InputError) as caught:
        parsed(tmp_path, value, shapes or (SHAPE, (10,)))
    assert fragment in str(caught.value)
    assert caught.value.file is not None and caught.value.fix


def test_sentence_of_a_class(tmp_path: Path) -> None:
    for outputs, words in ((2, "the other"), (10, "each of the other 9")):
        found = parsed(tmp_path, {"type": "classification", "label": 1}, (SHAPE, (outputs,)))
        assert found.sentence() == f"output 1 is larger than {words}"


@pytest.mark.parametrize("text", ["", "{", '{"type": "classification", "label": NaN}', '{"label": 1, "label": 2}'])
def test_broken_json(text: str, tmp_path: Path) -> None:
    file = tmp_path / "prop.json"
    file.write_text(text)
    with pytest.raises(InputError) as caught:
        loaded(file, SHAPE, (10,))
    assert caught.value.file == str(file)


# ---------------------------------------------------------------- linear properties


def boxed(claim: Claim, low: np.ndarray, high: np.ndarray, pose_set: PoseBox, seen: np.ndarray) -> float:
    """What the claim proves of outputs in [low, high]."""
    query = claim.query(seen[None])
    plus, minus = query.rows.clip(min=0.0), query.rows.clip(max=0.0)
    lower = (plus @ low + minus @ high + query.offset)[None]
    bounds = OutputBounds(lower, np.zeros((1, lower.shape[1], pose_set.box.dimensions)), lower)
    return float(claim.proved(query, bounds, [pose_set.box])[0])


def attacked(claim: Claim, low: np.ndarray, high: np.ndarray, pose_set: PoseBox, count: int = 4000) -> float:
    """The smallest margin of random and extreme outputs and poses."""
    rng = np.random.default_rng(1)
    weight = rng.random((count, len(low)))
    weight[::2] = weight[::2].round()
    outputs = torch.from_numpy(low + weight * (high - low))
    box = pose_set.box
    values = np.concatenate([box.corners(), box.sample(count - 2**box.dimensions, rng)])[:count]
    return float(claim.margin(outputs, torch.from_numpy(values)).min())


def test_classification(tmp_path: Path) -> None:
    prop = parsed(tmp_path, {"type": "classification", "label": 3})
    claim = prop.bind(poses(), lambda: np.zeros(10))
    y = torch.zeros(2, 10, dtype=torch.float64)
    y[:, 3] = 1.0
    y[1, 7] = 1.0
    # a tie is no win
    assert claim.margin(y, torch.zeros(2, 2)).tolist() == [1.0, 0.0]
    low, high = np.zeros(10), np.full(10, 0.5)
    low[3], high[3] = 0.6, 0.7
    found = boxed(claim, low, high, poses(), low)
    assert found == pytest.approx(0.1)
    assert attacked(claim, low, high, poses()) >= found
    high[5] = np.nan
    assert boxed(claim, low, high, poses(), low) == -np.inf


VNNLIB = (
    """
; inputs and outputs
"""
    + "\n".join(f"(declare-const X_{k} Real)" for k in range(3 * 16 * 16))
    + """
(declare-const Y_0 Real)
(declare-const Y_1 Real)
(declare-const Y_2 Real)
(assert (<= X_0 0.5))
(assert (>= X_0 -0.5))
(assert (or
  (and (>= Y_1 Y_0) (<= (+ Y_1 (* 2.0 Y_2)) 3.0))
  (and (>= (- Y_2 1e-1) Y_0))
))
"""
)


def test_vnnlib(tmp_path: Path) -> None:
    (tmp_path / "a.vnnlib").write_text(VNNLIB)
    prop = parsed(tmp_path, {"type": "vnnlib", "file": "a.vnnlib"}, (SHAPE, (3,)))
    assert "2 assertions on inputs" in prop.notes[0]
    claim = prop.bind(poses(), lambda: np.zeros(3))
    rng = np.random.default_rng(0)
    y = rng.normal(size=(5000, 3))
    unsafe = ((y[:, 1] >= y[:, 0]) & (y[:, 1] + 2.0 * y[:, 2] <= 3.0)) | (y[:, 2] - 0.1 >= y[:, 0])
    margin = claim.margin(torch.from_numpy(y), torch.zeros(5000, 2)).numpy()
    assert ((margin > 0.0) == ~unsafe).all() and unsafe.any() and not unsafe.all()
    for low in y[:200]:
        high = low + rng.random(3)
        assert boxed(claim, low, high, poses(), low) <= attacked(claim, low, high, poses(), 200) + 1e-12


@pytest.mark.parametrize(
    "text",
    [
        "(declare-const Y_0 Real)",
        "(declare-const Y_0 Real)(assert (< Y_0 1))",
        "(declare-const Y_0 Real)(assert (<= Y_0 1)",
        "(declare-const Y_0 Real)(assert (<= Y_0 1)))",
        "(declare-const Y_0 Int)(assert (<= Y_0 1))",
        "(assert (<= Y_0 1))",
        "(declare-const Y_9 Real)(assert (<= Y_9 1))",
        "(declare-const Y_0 Real)(declare-const X_0 Real)(assert (<= Y_0 X_0))",
        "(declare-const Y_0 Real)(assert (<= (* Y_0 Y_0) 1))",
        "(declare-const Y_0 Real)(assert (<= Y_0 inf))",
        "(declare-const Y_0 Real)(check-sat)",
        "(vnnlib-version <2.0>)",
        "(" * 300,
        "(declare-const Y_0 Real)(assert (<= (* 1e300 (* 1e300 Y_0)) 1))",
        "(declare-const Y_0 Real)(assert (<= (* 1e-300 (* 1e-300 Y_0)) 1))",
        "(declare-const Y_0 Real)(assert (<= (+ (* 1e308 Y_0) (* 1e308 Y_0)) 1))",
        "(declare-const Y_0 Real)(assert (<= (+ Y_0 1e308 1e308) 1))",
        "(declare-const Y_0 Real)(declare-const Y_1 Real)(assert (<= (* 1e300 Y_0) (* 1e-300 Y_1)))",
        "(declare-const Y_0 Real)(assert (<= (* 1e-300 Y_0) 1e300))",
        "(declare-const Y_0 Real)(assert (<= (* 1e300 Y_0) 1e-12))",
        "(declare-const Y_0 Real)(assert (<= Y_0 1e-400))",
        "(declare-const Y_0 Real)(assert (<= Y_0 1_000))",
        "(declare-const Y_0 Real)(assert (<= Y_0 " + "9" * 400 + "))",
        "(declare-const Y_" + "1" * 5000 + " Real)",
    ],
)
def test_vnnlib_mistakes(text: str, tmp_path: Path) -> None:
    file = tmp_path / "a.vnnlib"
    file.write_text(text)
    with pytest.raises(InputError) as caught:
        load_vnnlib(file, 3)
    assert caught.value.file == str(file) and caught.value.fix


@pytest.mark.parametrize("factor", ["1", "1e300", "-1e300", "1e-300", "1e38"])
def test_vnnlib_factors_change_no_verdict(factor: str, tmp_path: Path) -> None:
    """Both sides of a constraint times one number: the same margins' signs, however large the outputs are."""
    sign = ">=" if factor.startswith("-") else "<="
    (tmp_path / "a.vnnlib").write_text(
        "(declare-const Y_0 Real)(declare-const Y_1 Real)"
        f"(assert ({sign} (* {factor} (+ Y_0 (* 3.0 Y_1))) (* {factor} 0.5)))"
    )
    claim = parsed(tmp_path, {"type": "vnnlib", "file": "a.vnnlib"}, (SHAPE, (2,))).bind(poses(), lambda: np.zeros(2))
    for size in (1.0, 1e10, 1e38):
        y = size * np.random.default_rng(0).normal(size=(200, 2))
        margin = claim.margin(torch.from_numpy(y), torch.zeros(200, 2)).numpy()
        assert np.isfinite(margin).all() and ((margin > 0.0) == (y[:, 0] + 3.0 * y[:, 1] > 0.5)).all()
    exact = load_vnnlib(tmp_path / "a.vnnlib", 2)
    if factor in ("1", "1e38"):
        assert math.frexp(exact.rows[0, 1])[0] == math.frexp(3.0 * float(factor))[0]


# ---------------------------------------------------------------- regression

TARGETS = ("camera", "object", ["distance", 0.4, "object.z"], [1.0, -0.5, 0.25])
TOLERANCES = ({"relative": 0.4}, {"absolute": 0.7}, {"absolute": [0.7, 0.8, 0.9]})


@pytest.mark.slow
@pytest.mark.parametrize("tolerance", TOLERANCES, ids=str)
@pytest.mark.parametrize("target", TARGETS, ids=str)
def test_regression(target: Any, tolerance: dict[str, Any], tmp_path: Path) -> None:
    """Boxes and lines of outputs around the truth: what is proved is never above what is found."""
    value = {"type": "regression", "target": target, "tolerance": tolerance, "origin": [0.1, 0.0, -0.1], "scale": 1.3}
    prop = parsed(tmp_path, value, (SHAPE, (3,)))
    pose_set = poses()
    claim = prop.bind(pose_set, lambda: np.zeros(3))
    middle = prop.truth.at(torch.from_numpy(pose_set.pose(pose_set.box.middle))).numpy()
    rng = np.random.default_rng(2)
    proved = 0
    for _ in range(24):
        low = middle + 0.5 * rng.normal(size=3) - 0.1
        high = low + 0.3 * rng.random(3)
        found = boxed(claim, low, high, pose_set, low)
        assert found <= attacked(claim, low, high, pose_set, 150)
        proved += found > 0.0
    assert proved


def test_regression_uses_correlation(tmp_path: Path) -> None:
    """Outputs that follow the truth are proved over a set on which the truth moves by more than the tolerance."""
    pose_set = poses({"translation": {"x": 0.5}})
    value = {"type": "regression", "target": "camera", "tolerance": {"absolute": 0.01}}
    claim = parsed(tmp_path, value, (SHAPE, (3,))).bind(pose_set, lambda: np.zeros(3))
    truth = TrueValues(("camera.x", "camera.y", "camera.z")).forms(pose_set, pose_set.box)
    slope, centre = truth.linear.T, truth.center
    query = claim.query(np.zeros((1, 3)))
    a, b = np.concatenate([slope, -slope])[None], np.concatenate([centre, -centre])[None]
    bounds = OutputBounds(b - np.abs(a).sum(-1), a, b)
    assert 0.009 < claim.proved(query, bounds, [pose_set.box])[0] <= 0.01
    # without the lines nothing is proved
    assert claim.proved(query, OutputBounds(bounds.lower, 0.0 * a, bounds.lower), [pose_set.box])[0] < 0.0
    # nor by lines that stay where they are while the truth moves
    still = OutputBounds(np.full_like(b, -np.inf), 0.0 * a, b)
    assert claim.proved(query, still, [pose_set.box])[0] < 0.0
    for bad in (np.nan, np.inf, -np.inf):
        broken = OutputBounds(*(np.full_like(v, bad) for v in (bounds.lower, a, b)))
        assert not claim.proved(query, broken, [pose_set.box])[0] > 0.0


@pytest.mark.parametrize(
    "components", [("camera.x", "camera.y", "camera.z", "distance"), ("object.x", "object.y", "object.z")]
)
def test_truth_forms_contain_the_truth(components: tuple[str, ...]) -> None:
    spec = {
        "translation": {"x": 0.2, "z": [0.1, 0.3]}, "rotation": {"yaw": 0.2, "roll": 0.3},
        "orbit": {"target": [0, 0, 0], "axis": [0, 0, 1], "azimuth": [0.0, 0.4]},
    }  # fmt: skip
    pose_set = poses(spec)
    truth = TrueValues(components, (0.2, -0.1, 0.3), 2.0)
    low, high = truth.forms(pose_set, pose_set.box).bounds()
    rng = np.random.default_rng(0)
    for values in (*pose_set.box.corners(), *pose_set.box.sample(500, rng)):
        found = truth.at(torch.from_numpy(pose_set.pose(values))).numpy()
        assert (low <= found).all() and (found <= high).all()


# ---------------------------------------------------------------- detection


def head(seed: int = 0, spread: float = 1.0) -> np.ndarray:
    return spread * np.random.default_rng(seed).normal(size=125 * 9)


def test_decode_by_hand() -> None:
    y = np.zeros((125, 3, 3))
    y[2, 1, 0] = 2.0  # objectness of anchor 2 in row 1, column 0
    y[5 + 2 * 20 + 7, 1, 0] = 3.0
    y[105 + 2 * 4 : 105 + 3 * 4, 1, 0] = (0.5, -0.5, 0.1, -0.2)
    objectness, classes, boxes = decode(torch.from_numpy(y.reshape(1, -1)), 4.0)
    assert float(objectness[0, 2, 1, 0]) == pytest.approx(1 / (1 + math.exp(-2)))
    assert float(classes[0, 2, 7, 1, 0]) == pytest.approx(math.exp(3) / (math.exp(3) + 19))
    x, y_ = 4 / (1 + math.exp(-0.5)), 4 * (1 / (1 + math.exp(0.5)) + 1)
    w, h = 4 * 4.53 * math.exp(0.1), 4 * 8.92 * math.exp(-0.2)
    assert boxes[0, 2, :, 1, 0].tolist() == pytest.approx([x - w / 2, y_ - h / 2, x + w / 2, y_ + h / 2])


@pytest.mark.slow_cases(every=3)
@pytest.mark.parametrize("label", [None, 7])
@pytest.mark.parametrize("iou", [None, 0.2])
def test_detection(label: int | None, iou: float | None, tmp_path: Path) -> None:
    value = {"type": "detection", "class": label, "iou": iou, "confidence": 0.02}
    prop = parsed(tmp_path, value, HEAD)
    proved = 0
    for seed in range(12):
        centre = head(seed)
        claim = prop.bind(poses(), lambda centre=centre: centre)
        low, high = centre - 0.03, centre + 0.03
        found = boxed(claim, low, high, poses(), centre)
        assert found <= attacked(claim, low, high, poses(), 300)
        # a single point is proved nearly exactly
        exact = float(claim.margin(torch.from_numpy(centre[None]), torch.zeros(1, 2))[0])
        assert boxed(claim, centre, centre, poses(), centre) == pytest.approx(exact, abs=1e-9)
        proved += found > 0.0
    assert proved
    assert not boxed(claim, low * np.nan, high, poses(), centre) > 0.0


@pytest.mark.slow
def test_overlap_against_sampling() -> None:
    rng = np.random.default_rng(5)
    for _ in range(200):
        claim = DetectionClaim(None, 0.1, 0.3, tuple(np.sort(rng.uniform(0, 12, (2, 2)), axis=0).ravel()), 4.0, 3)
        number = int(rng.integers(45))
        low = 0.5 * rng.normal(size=(1, 4))
        high = low + 0.4 * rng.random((1, 4))
        bound = claim._overlap(low, high, number)[0]
        y = np.zeros((500, 125, 9))
        t = low + rng.random((500, 4)).round(1) * (high - low)
        anchor, place = divmod(number, 9)
        y[:, 105 + 4 * anchor : 109 + 4 * anchor, place] = t
        y[:, anchor, place] = 50.0
        found = claim.margins(torch.from_numpy(y.reshape(500, -1)))[:, number].min()
        assert bound <= float(found)


def test_reference_box_is_the_best_of_the_middle(tmp_path: Path) -> None:
    prop = parsed(tmp_path, {"type": "detection", "class": None, "iou": 0.9, "confidence": 0.3}, HEAD)
    centre = head(3)
    claim = prop.bind(poses(), lambda: centre)
    margin = claim.margins(torch.from_numpy(centre[None]))[0]
    objectness = decode(torch.from_numpy(centre[None]), 4.0)[0]
    assert int(margin.argmax()) == int(objectness.argmax())
    # overlap with itself is 1
    assert float(margin.max()) == pytest.approx(min(float(objectness.max()) - 0.3, 0.1))


# ---------------------------------------------------------------- preprocessing


@pytest.mark.parametrize("channels", ["RGB", "BGR"])
@pytest.mark.parametrize("layout", ["NCHW", "NHWC"])
def test_sets_contain_what_float32_preprocessing_gives(channels: str, layout: str) -> None:
    pre = parse_preprocess(
        {"mean": [0.4, 0.5, 0.1], "std": [0.2, 0.3, 0.7], "channels": channels, "layout": layout, "range": [-3, 255]}
    )
    rng = np.random.default_rng(0)
    base, slope = rng.uniform(0.3, 0.7, (2, 5, 4, 3)), 0.1 * rng.uniform(-1.0, 1.0, (2, 5, 4, 3, 2))
    slack = 0.05 * rng.random((2, 5, 4, 3))
    reach = np.abs(slope).sum(-1) + slack
    sets = pre.input_sets((slope, base - slack, slope, base + slack), base - reach, base + reach)
    for cell in range(2):
        for _ in range(200):
            p = rng.uniform(-1, 1, 2).round(1)
            low, high = base[cell] + slope[cell] @ p - slack[cell], base[cell] + slope[cell] @ p + slack[cell]
            image = np.where(rng.random(low.shape) < 0.5, low, high)
            # a float32 picture inside the set
            single = image.astype(np.float32)
            single = np.where(single < low, np.nextafter(single, np.float32(2)), single)
            single = np.where(single > high, np.nextafter(single, np.float32(-2)), single)
            for picture in (image, single):
                y = pre.apply(torch.from_numpy(picture[None])).numpy().reshape(-1).astype(np.float64)
                assert (y >= sets.a_lower[cell] @ p + sets.b_lower[cell]).all()
                assert (y <= sets.a_upper[cell] @ p + sets.b_upper[cell]).all()
                assert (sets.lower[cell] <= y).all() and (y <= sets.upper[cell]).all()


def test_sets_are_tight_and_contain_rounding() -> None:
    """A set of one exactly representable picture: float32 evaluation inside, and hardly any width."""
    pre = Preprocess(mean=(0.4914, 0.4822, 0.4465), std=(0.2471, 0.2435, 0.2616))
    image = np.random.default_rng(0).random((1, 32, 32, 3)).astype(np.float32)
    zero, wide = np.zeros((*image.shape, 1)), image.astype(np.float64)
    sets = pre.input_sets((zero, wide, zero, wide), wide, wide)
    y = pre.apply(torch.from_numpy(image)).numpy().reshape(1, -1).astype(np.float64)
    assert (sets.b_lower <= y).all() and (y <= sets.b_upper).all()
    assert (sets.lower <= y).all() and (y <= sets.upper).all()
    assert float((sets.b_upper - sets.b_lower).max()) < 1e-5
    # without the charge the float32 program would leave the set
    exact = ((wide - pre.mean) / pre.std).transpose(0, 3, 1, 2).reshape(1, -1)
    assert not (exact == y).all()


def test_apply_by_hand() -> None:
    pre = parse_preprocess({"mean": [1, 2, 3], "std": [2, 2, 4], "channels": "BGR", "range": [0, 255]})
    y = pre.apply(torch.tensor([[[[0.0, 0.5, 1.0]]]], dtype=torch.float64))
    assert y.reshape(-1).tolist() == [(255 - 1) / 2, (127.5 - 2) / 2, (0 - 3) / 4]


def test_resized_camera_shows_the_same_rays() -> None:
    small = camera().resized(8, 32)
    assert (small.height, small.width) == (8, 32)
    for u, v in ((0.0, 0.0), (16.0, 16.0), (3.0, 11.0)):
        before = ((u - 8.0) / 20.0, (v - 8.0) / 20.0)
        after = ((2 * u - small.cx) / small.fx, (0.5 * v - small.cy) / small.fy)
        assert before == pytest.approx(after)


def test_contract_examples_parse(tmp_path: Path) -> None:
    pre = {"resize": [16, 16], "mean": [0.5, 0.5, 0.5], "std": [0.2, 0.2, 0.2], "layout": "NCHW"}
    parsed(tmp_path, {"type": "classification", "label": 3, "preprocess": pre})
    parsed(tmp_path, {"type": "regression", "target": [1, 2, 3], "tolerance": {"relative": 0.2}}, (SHAPE, (3,)))
    parsed(tmp_path, {"type": "detection", "class": 7, "iou": 0.5, "confidence": 0.45}, HEAD)
    parsed(tmp_path, {"type": "detection", "class": None, "iou": None, "confidence": 0.45}, HEAD)
    assert json.loads((tmp_path / "prop.json").read_text())["confidence"] == 0.45
