"""Properties of the picture without a network: measures and their bounds, files, and certificates that are attacked."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import InProcess, Inputs
from PIL import Image
from test_certify_cli import cells, report

import ns_abstract as nsa
from ns_abstract.api.certification import CertifySettings, open_certification
from ns_abstract.api.files import Settings
from ns_abstract.api.picture_question import PlanePictures, depth_range
from ns_abstract.cli import certify as certify_command
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.io.atomic import write_json
from ns_abstract.io.errors import InputError
from ns_abstract.refine.protocol import WeightPlane
from ns_abstract.verify.network import OutputBounds
from ns_abstract.verify.picture_measures import CellParts, Measure, PlaneSets, ranked, shared_counts
from ns_abstract.verify.picture_properties import FARTHEST, PictureClaim, parse_picture_property

SWEEP = {"version": 1, "translation": {"x": 0.15}}
VISIBLE = {"type": "visible", "select": {"box": [[-1, -1, -1], [1, 1, 0]]}, "weight": 0.5, "pixels": 60}
CLEAR = {"type": "clear", "distance": 1.45, "weight": 0.5, "region": [4, 4, 28, 28]}
PICTURE = {"type": "picture", "statistic": "mean", "channel": "luminance", "max": 0.4, "minus": [0, 0, 8, 8]}


# ---------------------------------------------------------------- measures


def exact(measure: Measure, picture: np.ndarray) -> Fraction:
    """The value of a picture [n, c] in rational numbers."""
    weights = [Fraction(w) for w in measure.channels]
    cap = None if math.isinf(measure.cap) else Fraction(measure.cap)
    single = [sum((w * Fraction(float(v)) for w, v in zip(weights, row, strict=True)), Fraction(0)) for row in picture]
    single = [value if cap is None else min(value, cap) for value in single]

    def statistic(places: np.ndarray) -> Fraction:
        chosen = sorted((single[k] for k in places), reverse=not measure.least)
        return sum(chosen, Fraction(0)) / len(chosen) if measure.rank is None else chosen[measure.rank - 1]

    value = statistic(measure.pixels)
    return value if measure.minus is None else value - statistic(measure.minus)


def random_sets(rng: np.random.Generator, d: int, n: int = 20, c: int = 3) -> PlaneSets:
    a = rng.normal(size=(n, c, d)).astype(np.float32)
    tilt = 0.05 * rng.normal(size=a.shape).astype(np.float32)
    b = rng.uniform(-1.0, 1.0, (n, c)).astype(np.float32)
    room = rng.uniform(0.0, 0.2, (n, c)).astype(np.float32) + np.abs(tilt).sum(axis=-1)
    reach = (np.abs(a) + np.abs(tilt)).sum(axis=-1) * rng.uniform(0.7, 1.2, (n, c)).astype(np.float32) + room
    return PlaneSets((a - tilt, b - room, a + tilt, b + room), b - reach, b + reach)


def members(sets: PlaneSets, p: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
    """Pictures at ``p`` of the sets: the lowest, the highest, and one in between."""
    low = np.maximum(sets.lower, sets.linear[0].astype(np.float64) @ p + sets.linear[1])
    high = np.maximum(low, np.minimum(sets.upper, sets.linear[2].astype(np.float64) @ p + sets.linear[3]))
    return [low, high, low + rng.uniform(size=low.shape) * (high - low)]


@pytest.mark.parametrize("d", [0, 1, 2, 3])
def test_measures_stay_inside(d: int) -> None:
    rng = np.random.default_rng(d)
    widths = []
    for k in range(12):
        sets, one, other = random_sets(rng, d), rng.permutation(20)[:9], rng.permutation(20)[:5]
        rank = [None, 1, 4, 5][k % 4]
        luminance = (0.2126, 0.7152, 0.0722)
        measure = Measure(
            "colors", luminance if k % 2 else (1.0,), rank, one, k % 3 == 0, other if k % 5 == 0 else None,
            0.3 if k == 7 else math.inf,
        )  # fmt: skip
        first = 0 if k % 2 else 1
        parts = CellParts.equal(shared_counts(rng.uniform(0.1, 1.0, d), 16))
        low, high = measure.bounds(sets, first, parts)
        for _ in range(6):
            p = rng.choice([-1.0, 1.0], d) if rng.random() < 0.3 else rng.uniform(-1.0, 1.0, d)
            inside = (np.abs(p - parts.middles) <= parts.halves).all(axis=1)
            assert inside.any()
            for picture in members(sets, p, rng):
                value = exact(measure, picture[:, first : first + len(measure.channels)])
                for a, b in zip(low[inside].tolist(), high[inside].tolist(), strict=True):
                    assert Fraction(a) <= value <= Fraction(b)
                shown = float(measure.value(torch.from_numpy(picture)[None, None], first)[0])
                assert shown == pytest.approx(float(value), abs=1e-12)
        widths.append(float((high - low).mean()))
    assert np.median(widths) < 3.0


def test_ranks_are_those_of_whole_rows() -> None:
    rng = np.random.default_rng(0)
    for k in range(200):
        rows, n = int(rng.integers(1, 6)), int(rng.integers(1, 12))
        values = np.tile(rng.integers(0, 6, n).astype(np.float64), (rows, 1))
        some = rng.random(n) < k % 4 / 3.0
        values[:, some] = rng.integers(0, 6, (rows, int(some.sum())))
        for place in range(n):
            np.testing.assert_array_equal(ranked(values, place), np.sort(values, axis=1)[:, place])


def test_parts_follow_the_pose() -> None:
    """One pixel rises and one falls: one of two is always bright, which bounds of the whole cell do not say."""
    a, b = np.array([[[1.0]], [[-1.0]]], np.float32), np.zeros((2, 1), np.float32)
    sets = PlaneSets((a, b, a, b), np.full((2, 1), -1.0), np.full((2, 1), 1.0))
    measure = Measure("depth", (1.0,), 1, np.arange(2))
    assert measure.bounds(sets, 0, CellParts.equal(np.array([1])))[0].min() < -0.99
    assert -0.07 < measure.bounds(sets, 0, CellParts.equal(np.array([32])))[0].min() <= 0.0
    # what both regions do together cancels
    same = PlaneSets((np.abs(a), b, np.abs(a), b), sets.lower, sets.upper)
    both = Measure("depth", (1.0,), None, np.zeros(1, int), minus=np.ones(1, int))
    low, high = both.bounds(same, 0, CellParts.equal(np.array([1])))
    assert -1e-9 < low.min() <= 0.0 <= high.max() < 1e-9


def test_claims_are_trees() -> None:
    root = {"all": [{**PICTURE, "min": -0.2}, {"any": [VISIBLE, CLEAR]}]}
    prop = parse_picture_property(root, Path())
    claim = prop.bind(None, lambda: np.zeros(0))  # type: ignore[arg-type]
    assert isinstance(claim, PictureClaim) and len(claim.limits) == 3
    rng, box = np.random.default_rng(0), ParameterBox((), (), (), ())
    for _ in range(50):
        values = rng.uniform(-0.5, 1.0, 3)
        here = [min(values[0] + 0.2, 0.4 - values[0]), values[1] - 0.5, 0.5 - values[2]]
        expected = min(here[0], max(here[1], here[2]))
        assert float(claim.margin(torch.from_numpy(values)[None], torch.zeros(1, 0))[0]) == pytest.approx(expected)
        room = rng.uniform(0.0, 0.1, (4, 3))
        lower = np.stack([values - room, -values - room], axis=1)
        margin = claim.proved(claim.query(values[None]), OutputBounds(lower.reshape(1, -1), lower, lower), [box])[0]
        assert margin <= expected and margin > expected - 0.11
        # a number that is none proves nothing, unless something else does
        lower[0, :, 0] = np.nan
        margin = claim.proved(claim.query(values[None]), OutputBounds(lower.reshape(1, -1), lower, lower), [box])[0]
        assert margin == -np.inf


def test_parts_of_a_cell_must_all_hold() -> None:
    claim = parse_picture_property(VISIBLE, Path()).bind(None, lambda: np.zeros(0))  # type: ignore[arg-type]
    # two parts, of which one holds: lower bounds of the value and of its negative
    lower = np.array([[[0.9], [-1.0]], [[0.4], [-1.0]]])
    margin = claim.proved(
        claim.query(np.ones((1, 1))), OutputBounds(lower.reshape(1, -1), lower, lower), [ParameterBox((), (), (), ())]
    )
    assert margin[0] == pytest.approx(-0.1) and margin[0] <= -0.1 + 1e-9


def test_limits_include_themselves() -> None:
    claim = parse_picture_property({**PICTURE, "min": 0.25, "max": 0.25}, Path()).bind(None, lambda: np.zeros(0))  # type: ignore[arg-type]
    below, there, above = (
        float(claim.margin(torch.tensor([[v]], dtype=torch.float64), torch.zeros(1, 0))[0])
        for v in (np.nextafter(0.25, 0.0), 0.25, np.nextafter(0.25, 1.0))
    )
    assert below <= 0.0 < there and above <= 0.0


@pytest.mark.parametrize("distance", [1e-15, 1e6, 2.0**20, 1e15])
def test_rays_that_hit_nothing_are_clear_at_any_distance(distance: float) -> None:
    prop = parse_picture_property({"type": "clear", "measure": "expected", "distance": distance}, Path())
    model, claim = prop.model(1, 1), prop.bind(None, lambda: np.zeros(0))  # type: ignore[arg-type]
    values = model.outputs(np.full((1, 1, 1, model.channels), FARTHEST))
    assert claim.margin(torch.from_numpy(values), torch.zeros(1, 0))[0] > 0.0


@pytest.mark.parametrize("scale", [1e300, 1e-300])
def test_distances_in_units_of_the_data_set_have_limits(scale: float) -> None:
    root = {"type": "clear", "units": "dataset", "distance": 1e10}
    assert parse_picture_property(root, Path(), 1e-3)
    with pytest.raises(nsa.InputError) as caught:
        parse_picture_property(root, Path(), scale)
    assert caught.value.field == "distance" and caught.value.fix


def test_depths_where_nothing_may_be_drawn() -> None:
    inf = np.inf
    #: accumulation from and to, depth from and to, and what these leave of a depth where nothing is as far as can be
    cases = [
        (0.2, 0.9, 1.0, 2.0, 1.0, 2.0), (0.0, 0.9, 1.0, 2.0, 1.0, FARTHEST), (0.0, 0.0, inf, -inf, FARTHEST, FARTHEST),
        (0.0, 0.5, -inf, inf, -inf, FARTHEST),
    ]  # fmt: skip
    lower, upper = np.zeros((1, len(cases), 5)), np.zeros((1, len(cases), 5))
    for k, (dim, bright, near, far, *_) in enumerate(cases):
        lower[0, k, 3:], upper[0, k, 3:] = (dim, near), (bright, far)
    low, high = depth_range(lower, upper)
    assert [(a, b) for a, b in zip(low[0], high[0], strict=True)] == [case[4:] for case in cases]


# ---------------------------------------------------------------- certificates


class Case:
    """Files of one certification without a network."""

    def __init__(self, folder: Path, blobs: Inputs, prop: Any, spec: Any = SWEEP) -> None:
        folder.mkdir(exist_ok=True, parents=True)
        self.blobs, self.folder = blobs, folder
        self.prop, self.spec = write_json(folder / "prop.json", prop), write_json(folder / "spec.json", spec)

    def options(self, output: Path, *more: str) -> list[str]:
        return [
            "--load-config", str(self.blobs.config), "--camera-path-filename", str(self.blobs.path), "--property",
            str(self.prop), "--perturbation-filename", str(self.spec), "--output-dir", str(output), "--frames", "0",
            "--workers", "1", *more,
        ]  # fmt: skip

    @property
    def pictures(self) -> tuple[Any, PlanePictures]:
        settings = CertifySettings(Settings(self.blobs.config, self.blobs.path, self.spec), None, self.prop)
        job = open_certification(settings)
        found = job.pictures(0)
        assert isinstance(found, PlanePictures)
        return job, found


def value_at(case: Case, kind: str, values: np.ndarray) -> float:
    """What the property's measure is at a pose, from the planes as they are rendered."""
    _, pictures = case.pictures
    image = pictures.image(values).astype(np.float64)
    if kind == "visible":
        return float(np.sort(image[..., 3].ravel())[-60])
    return float(image[4:28, 4:28, 3].max()) if kind == "clear" else float(image[4:28, 4:28, 3].min())


PROPERTIES: dict[str, Callable[[float], dict[str, Any]]] = {
    "visible": lambda limit: {**VISIBLE, "weight": limit},
    "clear": lambda limit: {**CLEAR, "weight": limit},
    "expected": lambda limit: (
        {k: v for k, v in CLEAR.items() if k != "weight"} | {"measure": "expected", "distance": limit}
    ),
}


@pytest.mark.parametrize("height, width", [(16, 16), (24, 16), (16, 24)])
def test_depths_stay_inside_whatever_tiles_pictures_have(
    height: int, width: int, blobs: Inputs, tmp_path: Path
) -> None:
    """Pictures that are one tile wide, too, whose tiles are laid out already."""
    prop = {"type": "clear", "measure": "expected", "distance": 1.0, "preprocess": {"resize": [height, width]}}
    _, pictures = Case(tmp_path / "case", blobs, prop).pictures
    box = pictures.box.with_ends(np.array([-0.01]), np.array([0.02]))
    sets = pictures.linear_sets(box)
    # colours are not read
    a_lower, b_lower, a_upper, b_upper, lower, upper = (
        side[..., 3] if side.ndim == 3 else side[..., 3, 0] for side in (*sets[0], *sets[1:3])
    )
    depths = []
    for p in np.linspace(-1.0, 1.0, 9):
        values = np.clip(box.middle + p * (np.array(box.upper) - box.middle), box.lower, box.upper)
        depth = pictures.image(values)[..., 3]
        assert (lower <= depth).all() and (depth <= upper).all()
        assert (a_lower * p + b_lower <= depth).all() and (depth <= a_upper * p + b_upper).all()
        depths.append(depth)
    seen = np.max(depths, axis=0) < 2.0
    assert seen.mean() > 0.3 and 0.0 < np.median((upper - lower)[seen]) < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("kind", PROPERTIES)
def test_certificates_hold(kind: str, blobs: Inputs, tmp_path: Path, in_process: InProcess) -> None:
    line = np.linspace(-0.15, 0.15, 41)[:, None]
    probe = Case(tmp_path / "probe", blobs, PROPERTIES[kind](0.5))
    seen = np.array([value_at(probe, kind, values) for values in line[::5]])
    # in the middle of what is seen: the property holds in a part of the set
    case = Case(tmp_path / "case", blobs, PROPERTIES[kind](float(0.5 * (seen.min() + seen.max()))))
    output = tmp_path / "out"
    assert in_process(certify_command.main, case.options(output))[0] == 0
    found = report(output)
    shares = found["coverage"]
    assert shares["certified"] > 0.1 and shares["falsified"] > 0.1 and shares["unknown"] < 0.02
    job, pictures = case.pictures
    claim, rng = job.claim(pictures), np.random.default_rng(3)
    for _, low, high, verdict, margin, example in cells(output):
        (a,), (b,) = json.loads(low), json.loads(high)
        inside = [[a], [b], *rng.uniform(a, b, (2, 1))]
        poses = np.array(inside if verdict == "certified" else [json.loads(example or "[0]")])
        outputs = job.model.outputs(np.stack([pictures.image(pose) for pose in poses]))
        margins = claim.margin(torch.from_numpy(outputs), torch.from_numpy(poses)).numpy()
        if verdict == "certified":
            assert 0.0 < margin <= margins.min()
        if verdict == "falsified":
            assert margins[0] == margin <= 0.0
    # it goes on with what there is, and only with that
    assert in_process(certify_command.main, case.options(output, "--resume"))[0] == 0
    assert report(output)["coverage"] == shares
    other = Case(tmp_path / "case", blobs, PROPERTIES[kind](0.123))
    assert in_process(certify_command.main, other.options(output, "--resume"))[0] == 2


def test_several_parameters_and_scenes(blobs: Inputs) -> None:
    """The Python interface, with Gaussians that vary: a counterexample names its scene and is that scene's picture."""
    scene = nsa.load_scene(blobs.config)
    camera = nsa.load_camera_path(blobs.path).cameras[0]
    spec = {
        "version": 1, "translation": {"x": 0.01, "z": 0.01},
        "scene": [{"select": {"opacity": [0.3, 1.0]}, "opacity": [-0.5, 0.0], "color": 0.9}],
    }  # fmt: skip
    poses = nsa.PoseSet.from_json(camera, spec)
    easy = nsa.certify(scene, poses, None, {**VISIBLE, "weight": 0.02, "pixels": 5}, time_budget=60.0)
    assert easy.verdict == "certified" and "no network" in easy.network_guarantee[0]
    hard = nsa.certify(scene, poses, None, {**VISIBLE, "pixels": 120}, time_budget=20.0)
    assert hard.falsified > 0.0
    with pytest.raises(InputError, match="asks no network"):
        nsa.certify(scene, poses, "net.onnx", VISIBLE)
    with pytest.raises(InputError, match="there is no network"):
        nsa.certify(scene, poses, None, VISIBLE, network_arithmetic="real")


BAD: dict[str, tuple[Any, tuple[str, ...]]] = {
    "network": ({"type": "classification", "label": 0}, ("prop.json", "type", "--model")),
    "selection": ({**VISIBLE, "select": {"box": [[50, 50, 50], [60, 60, 60]]}}, ("prop.json", "select", "widen")),
    "no selection": ({"type": "visible"}, ("prop.json", "select", "missing")),
    "region": ({**CLEAR, "region": [0, 0, 33, 8]}, ("prop.json", "region", "beyond the picture of 32 x 32")),
    "reversed": ({**CLEAR, "region": [8, 0, 8, 8]}, ("region", "x0 < x1")),
    "pixels": ({**VISIBLE, "pixels": 2000}, ("pixels", "1024 pixels")),
    "both": ({**VISIBLE, "fraction": 0.5}, ("fraction", "together with pixels")),
    "key": ({**CLEAR, "with": 1}, ("with", "unknown key")),
    "mean": ({**CLEAR, "preprocess": {"mean": [0, 0, 0]}}, ("preprocess.mean", "unknown key", "resize")),
    "distance": ({"type": "clear", "distance": -1}, ("distance", "-1")),
    "weight of expected": ({**CLEAR, "measure": "expected"}, ("weight", "remove")),
    "nothing": ({"type": "picture"}, ("min", "missing")),
    "limits": ({**PICTURE, "min": 0.5, "max": 0.2}, ("min", "above max")),
    "empty": ({"all": []}, ("all", "list")),
    "inner": ({"any": [VISIBLE, {"type": "clear", "distance": "far"}]}, ("any[1].distance", "far")),
    "inner network": ({"all": [{"type": "vnnlib", "file": "x"}]}, ("all[0].type", "visible")),
    "two kinds": ({"all": [CLEAR], "any": [CLEAR]}, ("any", "unknown key")),
    "mask": ({"type": "clear", "distance": 1.0, "mask": "mask.png"}, ("mask.png", "8 x 8", "resize it to 32 x 32")),
    "no mask": ({"type": "clear", "distance": 1.0, "mask": "none.png"}, ("none.png",)),
    "mask is none": ({"type": "clear", "distance": 1.0, "mask": "prop.json"}, ("prop.json", "no .png")),
}


@pytest.mark.slow
def test_bad_input_is_one_line(blobs: Inputs, tmp_path: Path, in_process: InProcess) -> None:
    Image.fromarray(np.full((8, 8), 255, np.uint8)).save(tmp_path / "mask.png")
    for name, (prop, mentions) in BAD.items():
        case = Case(tmp_path, blobs, prop)
        code, _, error = in_process(certify_command.main, case.options(tmp_path / "out"))
        assert code == 2 and error.count("\n") == 1, (name, error)
        assert all(text in error for text in mentions), (name, error)
    case = Case(tmp_path, blobs, VISIBLE)
    for more, text in (
        (["--model", "x.onnx"], "--model: given with a property of the picture"), (["--picture", "8-bit"], "--picture"),
        (["--network-arithmetic", "real"], "--network-arithmetic"),
    ):  # fmt: skip
        code, _, error = in_process(certify_command.main, case.options(tmp_path / "out", *more))
        assert code == 2 and text in error


def test_masks_and_planes_are_read_where_they_should(blobs: Inputs, tmp_path: Path) -> None:
    mask = np.zeros((32, 32), np.uint8)
    mask[3:5, 7:20] = 255
    (tmp_path / "case").mkdir()
    Image.fromarray(mask).save(tmp_path / "case" / "mask.png")
    root = {"all": [{**VISIBLE, "mask": "mask.png", "pixels": 2}, PICTURE, {"type": "clear", "distance": 1.4}]}
    case = Case(tmp_path / "case", blobs, root)
    job, pictures = case.pictures
    assert pictures.channels == 5 and job.model.places == (3, 0, 4)
    image = pictures.image(pictures.box.middle)
    values = job.model.outputs(image[None])[0]
    chosen = np.sort(image[..., 3][mask > 0].astype(np.float64))
    assert values[0] == chosen[-2] and values[2] == image[..., 4].max()
    luminance = image[..., :3].astype(np.float64) @ np.array([0.2126, 0.7152, 0.0722])
    assert values[1] == pytest.approx(luminance.mean() - luminance[:8, :8].mean(), abs=1e-12)
    # sets hold what is rendered, of every plane
    (_, b_low, _, b_high), lower, upper, _ = pictures.linear_sets(pictures.box.replace(0, 0.0, 1e-6))
    assert (lower <= image).all() and (image <= upper).all() and (b_low <= b_high).all()
    assert isinstance(job.property.planes[0], WeightPlane)
