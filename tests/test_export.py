"""Exports: what is written is what was bounded, and other programs can read it."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from certifying import classifier
from conftest import Inputs, blob_scene
from onnx import numpy_helper
from PIL import Image
from test_cli import call, one_line  # noqa: F401

from ns_abstract.api.certification import Certification, CertifySettings, open_certification
from ns_abstract.api.files import Settings
from ns_abstract.cli import export as export_command
from ns_abstract.cli import render as render_command
from ns_abstract.io.atomic import write_json
from ns_abstract.io.errors import InputError
from ns_abstract.io.version import computed_by
from ns_abstract.methods.splat.load import load_scene
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.methods.splat.write import write_ply
from ns_abstract.refine.result import FrameResult
from ns_abstract.report.export import Results
from ns_abstract.report.export import picture as picture_of
from ns_abstract.report.files import IMAGES, load_frame, save_frame
from ns_abstract.verify.properties import LinearClaim
from ns_abstract.verify.vnnlib import load_vnnlib

Call = Callable[..., tuple[int, str]]
#: Of frames that are written here.
ABOUT = {"fingerprint": computed_by()}
ARRAYS = ("means", "log_scales", "quats", "opacity_logits", "sh")


@pytest.fixture(scope="module")
def bounded(blobs: Inputs, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of ns-abstract-render for the three frames of a small path."""
    folder = tmp_path_factory.mktemp("bounded") / "out"
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as leave:
        options = blobs.options(folder, time_budget=600, target_ratio=1.5)
        patch.setattr("sys.argv", ["command", *options])
        render_command.main()
    assert leave.value.code == 0
    return folder


def run(call: Call, *options: object) -> tuple[int, str]:  # noqa: F811
    return call([str(option) for option in options], export_command.main)


def frames(folder: Path) -> list[FrameResult]:
    return [load_frame(file).result for file in sorted(folder.glob("frame_*.npz"))]


@pytest.mark.slow
def test_archive_holds_every_frame(call: Call, bounded: Path, tmp_path: Path) -> None:  # noqa: F811
    file = tmp_path / "new" / "path.npz"
    code, error = run(call, "npz", "--input-dir", bounded, "--output-filename", file)
    assert (code, error) == (0, "")
    with np.load(file, allow_pickle=False) as archive:
        assert archive["frames"].tolist() == [0, 1, 2]
        about = json.loads(str(archive["about"]))
        assert about["guarantee"] == ["float32-sound"] and about["unbounded"] == []
        assert [p["name"] for p in about["parameters"][0]] == ["x"]
        for name in IMAGES:
            np.testing.assert_array_equal(archive[name], np.stack([getattr(f, name) for f in frames(bounded)]))


@pytest.mark.slow
def test_pictures_round_outward(call: Call, bounded: Path, tmp_path: Path) -> None:  # noqa: F811
    code, _ = run(call, "png", "--input-dir", bounded, "--output-dir", tmp_path, "--pictures", "lower", "upper", "gap")
    assert code == 0
    assert len(list(tmp_path.glob("*.png"))) == 9
    for result in frames(bounded):
        low, high = (np.asarray(Image.open(tmp_path / f"{n}_{result.index:05d}.png")) for n in ("lower", "upper"))
        assert (low / 255.0 <= result.lower.astype(np.float64)).all()
        assert (high / 255.0 >= result.upper.astype(np.float64)).all()
        assert (result.lower - low / 255.0).max() < 1 / 255.0 and (high / 255.0 - result.upper).max() < 1 / 255.0
        # the usual conversion, towards zero, would break the upper bound
        assert ((result.upper * 255.0).astype(np.uint8) / 255.0 < result.upper).any()


def test_video_of_panels_labels_pictures(call: Call, bounded: Path, tmp_path: Path) -> None:  # noqa: F811
    av = pytest.importorskip("av", reason="needs the extra video")
    file = tmp_path / "panels.mp4"
    code, said = run(call, "mp4", "--input-dir", bounded, "--output-filename", file, "--panels")
    assert code == 0, said
    with av.open(str(file)) as container:
        shown = [frame.to_ndarray(format="rgb24").astype(int) for frame in container.decode(video=0)]
    results = Results(bounded)
    height, width = results.size
    times = -(-200 // width)
    assert len(shown) == len(results.files)
    for picture, result in zip(shown, results, strict=True):  # type: ignore[call-overload]
        assert abs(picture.shape[0] - (times * height + 40)) <= 1
        for k, name in enumerate(("lower", "upper", "gap", "image")):
            left = k * (times * width + 6)
            panel = picture[20 : 20 + times * height, left : left + times * width]
            wanted = picture_of(result, name, results.largest).repeat(times, axis=0).repeat(times, axis=1).astype(int)
            # a lossy video
            assert np.abs(panel - wanted).mean() < 12.0, name
            label = picture[:20, left : left + times * width]
            assert label.max() > 230 and label.min() < 110, "no label"


def test_video_shows_every_frame(call: Call, bounded: Path, tmp_path: Path) -> None:  # noqa: F811
    av = pytest.importorskip("av", reason="needs the extra video")
    file = tmp_path / "path.mp4"
    code, _ = run(
        call, "mp4", "--input-dir", bounded, "--output-filename", file, "--pictures", "image", "gap", "--fps", 5
    )
    assert code == 0
    with av.open(str(file)) as container:
        assert container.streams.video[0].average_rate == 5
        shown = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    expected = frames(bounded)
    assert len(shown) == len(expected) and shown[0].shape == (32, 64, 3)
    for picture, result in zip(shown, expected, strict=True):
        assert np.abs(picture[:, :32] / 255.0 - result.image).mean() < 0.05


def test_frames_of_odd_size_and_without_bounds_are_filmed(bounded: Path, tmp_path: Path, call: Call) -> None:  # noqa: F811
    av = pytest.importorskip("av", reason="needs the extra video")
    result = frames(bounded)[0]
    cut = {name: np.ascontiguousarray(getattr(result, name)[:31, :29]) for name in IMAGES}
    cut["lower"], cut["upper"] = np.zeros_like(cut["lower"]), np.ones_like(cut["upper"])
    save_frame(
        tmp_path / "frame_00000.npz",
        dataclasses.replace(result, **cut, views=None, bounded=False),
        status="missing",
        about=ABOUT,
    )
    code, said = run(call, "mp4", "--input-dir", tmp_path, "--output-filename", tmp_path / "a.mp4")
    assert code == 0 and "no bounds but [0, 1] in frame 0" in said
    with av.open(str(tmp_path / "a.mp4")) as film:
        stream = film.streams.video[0]
        # even, as the codec wants it, and no picture is cut
        assert stream.height % 2 == 0 and stream.height >= 31 and stream.width % 2 == 0 and stream.width >= 29


@pytest.mark.parametrize("scene", [blob_scene(40, degree=3), blob_scene(7, degree=0)], ids=["degree 3", "degree 0"])
def test_ply_comes_back(tmp_path: Path, scene: SplatScene) -> None:
    file = tmp_path / "scene.ply"
    lost = write_ply(scene, file)
    back = load_scene(file)
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(back, name), getattr(scene, name), name)
    assert (back.sh_degree, back.color_model, back.rasterize_mode) == (scene.sh_degree, "sh", "classic")
    assert len(lost) == 1 and "background" in lost[0]


def test_ply_of_a_run(call: Call, blobs: Inputs, tmp_path: Path) -> None:  # noqa: F811
    file = tmp_path / "scene.ply"
    code, said = run(call, "ply", "--load-config", blobs.config, "--output-filename", file)
    assert code == 0 and "background" in said
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(load_scene(file), name), getattr(load_scene(blobs.config), name), name)


def test_ply_says_what_it_loses(tmp_path: Path) -> None:
    scene = dataclasses.replace(
        blob_scene(5, degree=0), color_model="sigmoid", rasterize_mode="antialiased", background=np.zeros(3, np.float32)
    )
    lost = write_ply(scene, tmp_path / "a.ply")
    assert ["logits" in lost[0], "antialiased" in lost[1], len(lost)] == [True, True, 2]
    back = load_scene(tmp_path / "a.ply")
    shown = 0.2820947917738781 * back.sh.astype(np.float64) + 0.5
    np.testing.assert_allclose(shown, 1.0 / (1.0 + np.exp(-scene.sh.astype(np.float64))), atol=1e-6)


def test_mistakes(call: Call, bounded: Path, tmp_path: Path) -> None:  # noqa: F811
    one_line(*run(call, "npz", "--input-dir", tmp_path, "--output-filename", tmp_path / "a.npz"), "no frame_*.npz")
    missing = tmp_path / "none"
    one_line(*run(call, "npz", "--input-dir", missing, "--output-filename", tmp_path / "a.npz"), "none")
    one_line(
        *run(call, "mp4", "--input-dir", bounded, "--output-filename", tmp_path / "a.mp4", "--fps", "nan"), "--fps"
    )
    one_line(*run(call, "png", "--input-dir", bounded, "--output-dir", tmp_path, "--pictures", "depth"), "--pictures")
    (tmp_path / "frame_00000.npz").write_bytes(b"no")
    with pytest.raises(InputError, match="cannot be read"):
        Results(tmp_path)


def test_sizes_must_agree(bounded: Path, tmp_path: Path) -> None:
    first, second = frames(bounded)[:2]
    cut = {name: np.ascontiguousarray(getattr(second, name)[:16]) for name in IMAGES}
    save_frame(tmp_path / "frame_00000.npz", first, about=ABOUT)
    save_frame(tmp_path / "frame_00001.npz", dataclasses.replace(second, **cut, views=None), about=ABOUT)
    with pytest.raises(InputError, match="one size"):
        Results(tmp_path)


# ---------------------------------------------------------------- VNN-LIB

PREPROCESS = {"resize": [16, 16], "mean": [0.4, 0.45, 0.5], "std": [0.25, 0.25, 0.3]}
UNSAFE = """
(declare-const Y_0 Real) (declare-const Y_1 Real) (declare-const Y_2 Real)
(assert (or (and (<= Y_0 Y_1) (<= Y_0 Y_2)) (and (>= Y_2 1.5))))
"""


@pytest.fixture(scope="module")
def instances(blobs: Inputs, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., tuple[Path, Certification]]:
    """Exports frame 0 with a random network and a property; returns the folder and the same certification."""
    folder = tmp_path_factory.mktemp("vnnlib")
    net = classifier(folder / "net.onnx")
    (folder / "unsafe.vnnlib").write_text(UNSAFE)

    def make(prop: dict, name: str, *more: object, spec: Path | None = blobs.spec) -> tuple[Path, Certification]:
        file = write_json(folder / f"{name}.json", prop | {"preprocess": PREPROCESS})
        settings = CertifySettings(Settings(blobs.config, blobs.path, spec), net, file)
        options: list[object] = ["vnnlib", "--frames", 0, "--output-dir", folder / name, "--model", net]
        options += ["--load-config", blobs.config, "--camera-path-filename", blobs.path, "--property", file]
        options += [] if spec is None else ["--perturbation-filename", spec]
        with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as leave:
            patch.setattr("sys.argv", ["command", *map(str, options), *map(str, more)])
            export_command.main()
        assert leave.value.code == 0
        return folder / name, open_certification(settings)

    return make


def exported_margins(
    network: Path, job: Certification, values: np.ndarray, box: list[dict]
) -> tuple[np.ndarray, float]:
    """The written network's outputs for the picture at ``values``, and the largest slack |e| that it takes."""
    stored = {t.name: numpy_helper.to_array(t).astype(np.float64) for t in onnx.load(str(network)).graph.initializer}
    middle, half = (np.array([0.5 * (b["upper"] + s * b["lower"]) for b in box]) for s in (1.0, -1.0))
    picture = torch.from_numpy(job.pictures(0).image(values)[None])
    x = job.property.preprocess.apply(picture).numpy().astype(np.float64).reshape(-1)
    p = (values - middle) / half if len(box) else np.zeros(1)
    slack = (x - stored["renderer"] @ p - stored["center"]) / stored["radius"][0]
    run = onnxruntime.InferenceSession(str(network), providers=["CPUExecutionProvider"])
    given = np.concatenate([p, slack])[None].astype(np.float32)
    return run.run(None, {run.get_inputs()[0].name: given})[0][0], float(np.abs(slack).max())


def test_vnnlib_holds_the_abstract_image_and_the_property(instances) -> None:
    folder, job = instances({"type": "classification", "label": 1}, "classes", "--parts", 3)
    lines = [line.split(",") for line in (folder / "instances.csv").read_text().splitlines()]
    boxes = json.loads((folder / "boxes.json").read_text())
    assert [line[2] for line in lines] == ["300"] * 3 and len(boxes) == 3
    ends = [(b[0]["lower"], b[0]["upper"]) for b in boxes.values()]
    assert ends[0][0] == -0.03 and ends[-1][1] == 0.03 and all(a[1] == b[0] for a, b in pairwise(ends))
    rng, outside = np.random.default_rng(2), 0.0
    rows = np.array([[-1.0, 1.0, 0.0], [0.0, 1.0, -1.0]])
    for (network, prop, _), (name, box) in zip(lines, boxes.items(), strict=True):
        assert (network, prop) == (f"{name}.onnx", f"{name}.vnnlib")
        low, high = box[0]["lower"], box[0]["upper"]
        for value in (low, high, *rng.uniform(low, high, 8)):
            values = np.array([value])
            found, slack = exported_margins(folder / network, job, values, box)
            # every picture of the box is the image of an input in the box
            assert slack <= 1.0
            y = job.model.outputs(job.pictures(0).image(values)[None])[0]
            np.testing.assert_allclose(found, rows @ y, atol=1e-4)
        outside = max(outside, exported_margins(folder / network, job, np.array([low - 0.03]), box)[1])
        unsafe = load_vnnlib(folder / prop, 2)
        assert unsafe.groups == ((0,), (1,)) and unsafe.inputs > 0
        np.testing.assert_array_equal(unsafe.rows, np.eye(2))
    # the check can fail: pictures of other poses are not in the sets
    assert outside > 1.0


def test_vnnlib_keeps_groups_of_rows(instances) -> None:
    folder, job = instances({"type": "vnnlib", "file": "unsafe.vnnlib"}, "groups", "--form", "gemm", spec=None)
    unsafe = load_vnnlib(folder / "frame_00000_box_00000.vnnlib", 3)
    assert unsafe.groups == ((0, 1), (2,))
    # a single pose has a parameter that moves nothing
    assert json.loads((folder / "boxes.json").read_text()) == {"frame_00000_box_00000": []}
    run = onnxruntime.InferenceSession(str(folder / "frame_00000_box_00000.onnx"), providers=["CPUExecutionProvider"])
    count = run.get_inputs()[0].shape[1]
    claim = job.claim(job.pictures(0))
    y = job.model.outputs(job.pictures(0).image(np.zeros(0))[None])
    found = run.run(None, {run.get_inputs()[0].name: np.zeros((1, count), np.float32)})[0]
    margins = [
        LinearClaim(unsafe.rows, unsafe.offset, unsafe.groups).margin(torch.from_numpy(found), torch.zeros(1, 0)),
        claim.margin(torch.from_numpy(y), torch.zeros(1, 0)),
    ]
    # the middle of the slack is the picture up to the rounding that the bounds allow for
    np.testing.assert_allclose(*margins, atol=1e-2)


def test_vnnlib_mistakes(call: Call, blobs: Inputs, tmp_path: Path) -> None:  # noqa: F811
    net = classifier(tmp_path / "net.onnx")
    prop = write_json(tmp_path / "p.json", {"type": "classification", "label": 1, "preprocess": PREPROCESS})
    other = write_json(
        tmp_path / "q.json",
        {"type": "regression", "target": [0, 0, 0], "tolerance": {"absolute": 1}, "preprocess": PREPROCESS},
    )

    def options(prop: Path, *more: object) -> tuple[int, str]:
        return run(
            call, "vnnlib", "--load-config", blobs.config, "--camera-path-filename", blobs.path, "--model", net,
            "--property", prop, "--perturbation-filename", blobs.spec, "--output-dir", tmp_path / "out", *more,
        )  # fmt: skip

    one_line(*options(other), "q.json", "linear")
    for flag, value in (("--parts", 0), ("--timeout", 0), ("--frames", 9)):
        one_line(*options(prop, flag, value), flag)
    one_line(*options(prop, "--parts", 2, 2), "--parts")
    assert not list((tmp_path / "out").glob("*.onnx"))
