"""Photos of other brightness, calibrated noise, and sequences of photos: what is excluded never made the photo."""

import json
import shutil
import sqlite3
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import InProcess, Inputs
from PIL import Image
from test_locate import taken

import ns_abstract as nsa
from ns_abstract.api.files import Settings
from ns_abstract.api.location import LocateSettings, Location, calibrate, training_data
from ns_abstract.api.sequence import following, grown, open_sequence
from ns_abstract.cli.certify import main as certify_main
from ns_abstract.cli.locate import main
from ns_abstract.geometry.camera_path import load_camera_path
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.geometry.tiles import assemble
from ns_abstract.io.folder import claim
from ns_abstract.io.photos import missing_photos, sequence_photos
from ns_abstract.perturbation.specification import Perturbation
from ns_abstract.verify.photo import Brightness, Photo

RNG = np.random.default_rng


def exposed(picture: np.ndarray, gain: float, offset: float) -> np.ndarray:
    return np.clip(gain * picture.astype(np.float64) + offset, 0.0, 1.0)


# ---------------------------------------------------------------- brightness


@pytest.mark.parametrize("seed", range(4))
def test_values_before_any_brightness_are_held(seed: int) -> None:
    """Every value that some gain and offset take to within the noise and a rounding of a level, exactly."""
    rng, noise = RNG(seed), [0.0, 0.02, 0.3, 0.004][seed]
    levels = np.arange(256, dtype=np.uint8).repeat(3).reshape(16, 16, 3)
    brightness = Brightness((0.5, 2.0) if seed % 2 else (0.9, 1.1), (-0.1, 0.05))
    photo = Photo(levels, noise, 0.0, np.ones((16, 16), bool), brightness)
    low, high = photo.ends
    for level, a, b in zip(levels.ravel().tolist(), low.ravel().tolist(), high.ravel().tolist(), strict=True):
        for _ in range(3):
            gain, offset = (Fraction(rng.choice([*ends, rng.uniform(*ends)])) for ends in vars(brightness).values())
            # what the camera shows: a value at an end of the noise and of the step, or anything that is clipped
            shown = Fraction(level, 255) + int(rng.choice([-1, 0, 1])) * (Fraction(noise) + Fraction(1, 510))
            beyond = Fraction(int(rng.integers(0, 5))) if shown >= 1 else Fraction()
            below = Fraction(int(rng.integers(0, 5))) if shown <= 0 else Fraction()
            value = (shown + beyond - below - offset) / gain
            assert (a == -np.inf or Fraction(a) <= value) and (b == np.inf or value <= Fraction(b))
    # and not everything: levels in the middle leave values out on both sides
    assert np.isfinite(low[8]).all() or noise > 0.2
    still = Photo(levels, noise, 0.0, np.ones((16, 16), bool))
    assert (still.ends[0] == still.shown[0]).all() and (low <= still.ends[0]).all() and (high >= still.ends[1]).all()


def test_one_brightness_for_all_pixels_explains_a_photo() -> None:
    """The fit finds it beside outliers; pixels that would need one each are no explanation; NaN is none."""
    rng = RNG(1)
    picture = rng.uniform(0.1, 0.8, (16, 16, 3))
    levels = taken(exposed(picture, 1.15, -0.04), 0.0, 20, rng)
    photo = Photo(levels, 0.004, 0.1, np.ones((16, 16), bool), Brightness((0.8, 1.25), (-0.05, 0.05)))
    assert photo.outside(picture).sum() <= 20
    assert photo.tiled(4).outside(np.full((16, 4, 4, 3), np.nan)).all()
    each = taken(picture * rng.choice([0.85, 1.2], (16, 16, 1)), 0.0, 0, rng)
    mixed = Photo(each, 0.004, 0.1, np.ones((16, 16), bool), photo.brightness)
    assert mixed.outside(picture).sum() > 60
    # bounds that hold the picture exclude none of them
    tiled, whole = photo.tiled(16), picture[None].astype(np.float32)
    assert tiled.beyond(whole, whole, np.arange(1)).sum() <= 20


@pytest.mark.slow
def test_locate_allows_another_brightness(blobs: Inputs) -> None:
    rng, scene = RNG(2), nsa.load_scene(blobs.config)
    poses = nsa.PoseSet(nsa.load_camera_path(blobs.path).cameras[0], translation={"x": 0.3})
    frame = scene.method().frame(poses.of(scene))
    pose = frame.box.sample(1, rng)[0]
    levels = taken(exposed(assemble(frame.render(pose), frame.camera), 1.1, 0.01), 0.004, 10, rng)
    given: dict[str, Any] = {"noise": 0.006, "outliers": 40 / 1024, "time_budget": 20.0}
    assert nsa.locate(scene, poses, levels, **given).possible_volume == 0.0
    place = nsa.locate(scene, poses, levels, brightness={"gain": (0.9, 1.15), "offset": (-0.02, 0.02)}, **given)
    assert place.hull is not None and place.hull[0][0] <= pose[0] <= place.hull[1][0]
    assert place.possible_volume < 0.1 and place.answer == "possible"
    assert place.report["photo"]["brightness"] == {"gain": [0.9, 1.15], "offset": [-0.02, 0.02]}
    with pytest.raises(nsa.InputError, match="--brightness-gain: found"):
        nsa.locate(scene, poses, levels, brightness={"gain": (1.1, 0.9)})


# ---------------------------------------------------------------- calibration


def with_photos(inputs: Inputs, error: float) -> tuple[nsa.Scene, Path]:
    """The run with training photos that differ from its renders by up to ``error``, and 2 % of the pixels by more."""
    scene, rng = nsa.load_scene(inputs.config), RNG(3)
    data = training_data(scene)
    cameras = load_camera_path(data, run_frame=scene.run_frame).cameras
    for k, entry in enumerate(json.loads(data.read_text())["frames"]):
        picture = nsa.render(scene, cameras[k])
        count = picture[..., 0].size // 50
        Image.fromarray(taken(picture, error, count, rng)).save(data.parent / entry["file_path"])
    return scene, data


def test_noise_and_outliers_explain_all_training_photos(make_blobs: Callable[..., Inputs]) -> None:
    scene, data = with_photos(make_blobs(), 0.06)
    found = calibrate(scene, 10_000, noise=0.02, outliers=0.01)
    assert 0.05 < found.noise <= 0.0601 and found.outliers == 0.02
    cameras = load_camera_path(data, run_frame=scene.run_frame).cameras
    for camera, entry in zip(cameras, json.loads(data.read_text())["frames"], strict=True):
        frame = scene.method().frame(PoseBox.around(camera, Perturbation()))
        levels = np.array(Image.open(data.parent / entry["file_path"]))
        photo = Photo(levels, found.noise, found.outliers, np.ones(levels.shape[:2], bool))
        assert photo.outside(assemble(frame.render(frame.box.middle), frame.camera)).sum() <= photo.allowed
    # what is given is the least
    assert calibrate(scene, 10_000, noise=0.2, outliers=0.3).noise == 0.2
    assert calibrate(scene, 8, noise=0.0, outliers=0.0).size[0] == 8


def test_calibration_needs_the_photos(make_blobs: Callable[..., Inputs], tmp_path: Path, in_process: InProcess) -> None:
    inputs = make_blobs()
    data = training_data(nsa.load_scene(inputs.config))
    image = tmp_path / "photo.png"
    Image.new("RGB", (32, 32), 0).save(image)
    (data.parent / json.loads(data.read_text())["frames"][0]["file_path"]).unlink()
    for damage, words in ((lambda: None, "--calibrate: no such file"), (data.unlink, "no transforms.json in")):
        damage()
        code, _, err = in_process(
            main, inputs.options(tmp_path / "out", image=image, frames=0, workers=1, calibrate=True)
        )
        assert code == 2 and words in err and err.count("\n") == 1, err
        assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_used_is_one_line(blobs: Inputs, tmp_path: Path, in_process: InProcess) -> None:
    """What is searched for is told once it is searched for."""
    image, file = tmp_path / "photo.png", tmp_path / "file"
    Image.new("RGB", (32, 32), 0).save(image)
    file.touch()
    options = blobs.options(file, image=image, frames=0, workers=1)
    prop = {"type": "picture", "region": [0, 0, 4, 4], "statistic": "mean", "channel": "r", "max": 1.0}
    (tmp_path / "prop.json").write_text(json.dumps(prop))
    claimed = blobs.options(file, property=tmp_path / "prop.json", frames=0, workers=1)
    for command, given in ((main, options), (certify_main, claimed)):
        code, _, err = in_process(command, given)
        assert code == 2 and "--output-dir" in err and err.count("\n") == 1, err


# ---------------------------------------------------------------- sequences


def test_a_grown_set_holds_every_pose_that_a_motion_leads_to() -> None:
    rng = RNG(4)
    camera = nsa.Camera(np.eye(4), fov=45.0, width=8, height=8)
    ranges = {"x": (-0.1, 0.1), "y": (-0.05, 0.2)}
    poses = PoseBox.around(camera, Perturbation(translation=ranges, rotation={"yaw": (-0.3, 0.1)}))
    for _ in range(50):
        hull = {name: tuple(np.sort(rng.uniform(-0.3, 0.3, 2)).tolist()) for name in poses.box.names}
        motion = {"x": (-0.01, 0.03), "yaw": (0.1, 0.2)}
        box = grown(poses, hull, motion).box
        for k, name in enumerate(box.names):
            low, high = motion.get(name, (0.0, 0.0))
            assert Fraction(box.lower[k]) <= Fraction(hull[name][0]) + Fraction(low)
            assert Fraction(box.upper[k]) >= Fraction(hull[name][1]) + Fraction(high)
            assert box.upper[k] - box.lower[k] <= hull[name][1] - hull[name][0] + high - low + 1e-12


def test_a_camera_leaves_one_segment_for_another() -> None:
    """Poses along the path and off it, of the next photo: on the same segment, and on one where nothing was left."""
    rng = RNG(7)
    matrices = [np.eye(4) for _ in range(4)]
    for k, matrix in enumerate(matrices):
        matrix[:3, 3] = (0.3 * k, 0.0, 0.1 * k)
    cameras = [nsa.Camera(matrix, fov=45.0, width=8, height=8) for matrix in matrices]
    off = [{"x": (-0.1, 0.1)}, {"x": (-0.1, 0.1)}, {}]
    turns = {"yaw": (-0.1, 0.1)}
    swept = [Perturbation(translation=shift, rotation=turns, sweep="segments") for shift in off]
    sets = {k: PoseBox.around(cameras[k], swept[k], cameras[k + 1]) for k in range(3)}
    motion = {"yaw": (-0.02, 0.05)}

    def report(k: int, left: tuple[list[float], list[float]] | None) -> dict[str, Any]:
        hull = None if left is None else {"lower": left[0], "upper": left[1]}
        return {"index": k, "parameters": [{"name": name} for name in sets[k].box.names], "hull": hull}

    left = [([0.02, -0.05, 0.9], [0.03, 0.0, 1.0]), None, ([0.02, 0.0], [0.06, 0.1])]
    found = following(sets, [report(k, hull) for k, hull in enumerate(left)], motion)
    assert sorted(found) == [0, 1, 2]
    for poses in found.values():
        box = dict(zip(poses.box.names, zip(poses.box.lower, poses.box.upper, strict=True), strict=True))
        assert box["segment"] == (0.0, 1.0)
        for _ in range(50):
            turn = rng.choice([rng.uniform(-0.05, 0.0), rng.uniform(0.02, 0.06), 0.06, -0.05])
            assert box["yaw"][0] <= turn - 0.02 and turn + 0.05 <= box["yaw"][1]
        assert box["yaw"] == pytest.approx((-0.07, 0.11))
        if "x" in box:
            # the last segment has no offset: 0 is one that the camera comes from
            assert box["x"] == pytest.approx((0.0, 0.03), abs=1e-12)
    # around keyframes a set is left by the motion alone, and nothing follows from nothing
    sets = {k: PoseBox.around(cameras[k], Perturbation(translation=off[0])) for k in range(3)}
    assert list(following(sets, [report(0, ([0.02], [0.03])), report(1, None), report(2, None)], {})) == [0]
    assert following(sets, [report(k, None) for k in range(3)], {}) == {}


@pytest.mark.parametrize("fixed", [0.0, 0.05])
def test_an_offset_that_is_fixed_in_one_segment_is_taken_to_the_next(fixed: float) -> None:
    cameras = [nsa.Camera(np.eye(4) + 0.3 * k * np.eye(4, k=3), fov=45.0, width=8, height=8) for k in range(3)]
    offsets = [(fixed, fixed), (-0.1, 0.1)]
    swept = [Perturbation(translation={"x": ends}, rotation={"yaw": ends}, sweep="segments") for ends in offsets]
    sets = {k: PoseBox.around(cameras[k], swept[k], cameras[k + 1]) for k in range(2)}
    left = {"index": 0, "parameters": [{"name": "segment"}], "hull": {"lower": [0.9], "upper": [1.0]}}
    found = following(sets, [left, {"index": 1, "parameters": [], "hull": None}], {})
    assert found[0].fixed["x"] == fixed
    for name, low, high in zip(found[1].box.names, found[1].box.lower, found[1].box.upper, strict=True):
        assert (low, high) == (0.0, 1.0) if name == "segment" else low < fixed < high and high - low < 1e-12


def test_a_camera_leaves_the_segments_that_it_began_in(blobs: Inputs, tmp_path: Path) -> None:
    """Frames are those of the first photo: the next one may come from any segment of the path."""
    (tmp_path / "photos").mkdir()
    for k in range(2):
        Image.new("RGB", (32, 32)).save(tmp_path / "photos" / f"{k}.png")
    (tmp_path / "motion.json").write_text('{"version": 1, "translation": {"x": 0.01}}')
    found: dict[str, Any] = {
        "answer": "possible", "possible_volume": 1.0, "hull": None, "best": None, "seconds": 1.0, "state": "done",
    }  # fmt: skip
    for sweep, sets in (("segments", [1, 3]), ("keyframes", [1, 1])):
        spec = {"version": 1, "translation": {"x": 0.02}, "sweep": sweep}
        (tmp_path / "spec.json").write_text(json.dumps(spec))
        settings = LocateSettings(Settings(blobs.config, blobs.path, tmp_path / "spec.json"), tmp_path / "photos/0.png")
        photos = open_sequence(
            settings, tmp_path / "photos", tmp_path / "motion.json", tmp_path / sweep, frames=(0,), resume=False
        )
        box, searched = photos.sets[0].box, []

        def search(
            location: Location, frames: tuple[int, ...], folder: Path, box=box, searched=searched
        ) -> dict[str, Any]:
            searched.append(len(frames))
            hull = {"lower": box.lower, "upper": box.upper}
            entry = {"parameters": [{"name": name} for name in box.names], "hull": hull}
            return found | {"frames": [{"index": k, **entry} for k in frames]}

        report = photos.follow(search)
        assert searched == sets
        assert [[frame["index"] for frame in image["frames"]] for image in report["images"]] == [[0], [*range(sets[1])]]


@pytest.mark.slow
def test_sets_of_a_sequence_have_the_numbers_of_their_entries(
    travelled: tuple[list[str], np.ndarray, Path], blobs: Inputs, tmp_path: Path, in_process: InProcess
) -> None:
    options, _, folder = travelled
    rng, scene = RNG(8), nsa.load_scene(blobs.config)
    camera = nsa.load_camera_path(blobs.path).cameras[2]
    frame = scene.method().frame(nsa.PoseSet(camera, translation={"x": 0.03}).of(scene))
    photos = Path(options[options.index("--image-sequence") + 1])
    for photo in photos.iterdir():
        Image.fromarray(taken(assemble(frame.render(np.array([0.01])), camera), 0.004, 5, rng)).save(photo)
    options[options.index("--frames") + 1 : options.index("--frames") + 2] = ["1", "2"]
    assert in_process(main, options)[0] == 0
    report = json.loads((folder / "report.json").read_text())
    found = [[1, 2], *[[2]] * (len(report["images"]) - 1)]
    assert len(found) == 5 and report["answer"] == "possible"
    for image, numbers in zip(report["images"], found, strict=True):
        one = json.loads((folder / image["folder"] / "report.json").read_text())
        with sqlite3.connect(folder / image["folder"] / "cells.sqlite") as base:
            stored = sorted(row[0] for row in base.execute("SELECT DISTINCT frame FROM cells"))
        assert numbers == stored == [entry["index"] for entry in one["frames"]]
        assert image["best"]["frame"] == one["best"]["frame"] == 2 and image["frames"] == one["frames"]


def test_photos_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    def folder(*names: str) -> Path:
        place = tmp_path / str(len(list(tmp_path.iterdir())))
        place.mkdir()
        for name in names:
            (place / name).touch()
        return place

    for names in (
        ("9.png", "10.png"), ("a1_9.jpg", "a1_10.jpg"), ("IMG_3.png", "img_2.png"), ("b2c1.png", "b10c1.png"),
    ):  # fmt: skip
        with pytest.raises(nsa.InputError, match="by name, and behind it by number"):
            sequence_photos(folder(*names))
    for names in (("09.png", "10.png"), ("IMG_002.JPG", "IMG_010.JPG"), ("left.png", "right.png"), ("a.png",)):
        photos = sequence_photos(folder(*names))
        assert [photo.name for photo in photos] == list(names) and missing_photos(photos) is None
    # every second one, or times that are not quite even, are no gap
    for names, told in (
        (("f02.png", "f04.png", "f06.png"), None),
        (("1403636579.png", "1403636629.png", "1403636678.png"), None),
        (("f1.png", "f2.png", "f4.png"), "between f2.png and f4.png"),
        (("1403636579.png", "1403636629.png", "1403636729.png"), "between 1403636629.png and 1403636729.png"),
    ):
        warning = missing_photos(sequence_photos(folder(*names)))
        assert warning is None if told is None else told in (warning or "")


def test_photos_that_are_no_files_are_not_left_out(tmp_path: Path) -> None:
    for name in ("1.png", "3.png", "._1.png"):
        (tmp_path / name).touch()
    assert [photo.name for photo in sequence_photos(tmp_path)] == ["1.png", "3.png"]
    (tmp_path / "2.png").symlink_to(tmp_path / "gone.png")
    with pytest.raises(nsa.InputError, match=r"2\.png: --image-sequence: is no file"):
        sequence_photos(tmp_path)


@pytest.fixture
def travelled(blobs: Inputs, tmp_path: Path) -> tuple[list[str], np.ndarray, Path]:
    """Options of a sequence of three photos and one that no pose made, the poses, and the folder of results."""
    rng, scene = RNG(6), nsa.load_scene(blobs.config)
    camera = nsa.load_camera_path(blobs.path).cameras[0]
    wide = scene.method().frame(nsa.PoseSet(camera, translation={"x": 1.0}).of(scene))
    # out of the first photo's set by far
    places = np.array([0.02, 0.035, 0.05])
    (tmp_path / "photos").mkdir()
    for k, x in enumerate(places):
        levels = taken(assemble(wide.render(np.array([x])), wide.camera), 0.004, 5, rng)
        Image.fromarray(levels).save(tmp_path / "photos" / f"{k}.png")
    Image.fromarray(rng.integers(0, 256, (32, 32, 3), np.uint8)).save(tmp_path / "photos" / "3.png")
    Image.new("RGB", (32, 32)).save(tmp_path / "photos" / "4.png")
    (tmp_path / "motion.json").write_text('{"version": 1, "translation": {"x": [0.0, 0.02]}}')
    folder = tmp_path / "out"
    options = blobs.options(
        folder, image_sequence=tmp_path / "photos", motion=tmp_path / "motion.json", noise=0.004, outliers=0.01,
        frames=0, workers=1, time_budget=20,
    )  # fmt: skip
    return options, places, folder


@pytest.mark.slow
def test_a_sequence_is_followed_and_resumed(
    travelled: tuple[list[str], np.ndarray, Path], in_process: InProcess
) -> None:
    options, places, folder = travelled
    code, _, err = in_process(main, options)
    assert code == 0 and "none: no pose explains 3.png, 1 after it not examined" in err
    report = json.loads((folder / "report.json").read_text())
    assert [entry["answer"] for entry in report["images"]] == ["possible"] * 3 + ["none"]
    assert report["answer"] == "none" and report["not_examined"] == 1
    for entry, x in zip(report["images"], places, strict=False):
        assert entry["hull"]["lower"][0] <= x <= entry["hull"]["upper"][0] <= x + 0.01
        with sqlite3.connect(folder / entry["folder"] / "cells.sqlite") as base:
            kinds = {row[0] for row in base.execute("SELECT verdict FROM cells")}
        assert "possible" in kinds
    # the sets are the last results, grown
    for before, after in zip(report["images"][:3], report["images"][1:], strict=True):
        (entry,) = after["frames"][0]["parameters"]
        assert entry["lower"] == pytest.approx(before["hull"]["lower"][0], abs=1e-12)
        assert entry["upper"] == pytest.approx(before["hull"]["upper"][0] + 0.02, abs=1e-12)
    # cut off after the second photo: its results are read, the same comes out
    cut = {**report, "images": report["images"][:2]}
    (folder / "report.json").write_text(json.dumps(cut))
    stamps = [(folder / entry["folder"] / "report.json").stat().st_mtime_ns for entry in report["images"][:2]]
    # what a folder after that holds may follow from other results, as of a command that was cut off in its turn
    shutil.copy(folder / report["images"][0]["folder"] / "cells.sqlite", folder / report["images"][3]["folder"])
    assert in_process(main, [*options, "--resume"])[0] == 0
    again = json.loads((folder / "report.json").read_text())
    assert [(e["answer"], e["hull"]) for e in again["images"]] == [(e["answer"], e["hull"]) for e in report["images"]]
    assert stamps == [(folder / entry["folder"] / "report.json").stat().st_mtime_ns for entry in report["images"][:2]]
    for more, words in ((["--noise", "0.01"], "is of other inputs"), (["--outliers", "0.2"], "is of other inputs")):
        code, _, err = in_process(main, [*options, *more, "--resume"])
        assert code == 2 and words in err and err.count("\n") == 1
    # what others have changed is not continued, nor are other photos, nor a folder in which a command works
    for name, change in CHANGES.items():
        changed = change(json.loads(json.dumps(again)))
        (folder / "report.json").write_text(json.dumps(changed))
        code, _, err = in_process(main, [*options, "--resume"])
        assert code == 2 and "were changed since" in err and err.count("\n") == 1, name
        assert json.loads((folder / "report.json").read_text()) == changed
    (folder / "report.json").write_text(json.dumps(again))
    photos = Path(options[options.index("--image-sequence") + 1])
    for photo in sorted(photos.iterdir())[2:]:
        photo.unlink()
    code, _, err = in_process(main, [*options, "--resume"])
    assert code == 2 and "2.png is missing" in err and err.count("\n") == 1
    with claim(folder):
        code, _, err = in_process(main, options)
    assert code == 2 and "locked by a command" in err and json.loads((folder / "report.json").read_text()) == again


@pytest.mark.parametrize("name", ["size", "kind"])
def test_a_photo_that_cannot_be_used_is_refused_before_the_first_is_located(
    name: str, travelled: tuple[list[str], np.ndarray, Path], in_process: InProcess
) -> None:
    options, _, folder = travelled
    last = Path(options[options.index("--image-sequence") + 1]) / "4.png"
    Image.new("RGB" if name == "size" else "L", (32, 31) if name == "size" else (32, 32)).save(last)
    code, _, err = in_process(main, options)
    words = {"size": "has 32 x 31 pixels, '0.png' 32 x 32", "kind": "holds pixels of kind L"}[name]
    assert code == 2 and words in err and str(last) in err and err.count("\n") == 1
    assert not folder.exists()


def test_a_sequence_that_is_cut_off_is_not_told_as_done(blobs: Inputs, tmp_path: Path) -> None:
    """After a photo there is a report, which says that there are more."""
    (tmp_path / "photos").mkdir()
    for k in range(2):
        Image.new("RGB", (32, 32)).save(tmp_path / "photos" / f"{k}.png")
    (tmp_path / "motion.json").write_text('{"version": 1}')
    files = Settings(blobs.config, blobs.path)
    settings = LocateSettings(files, tmp_path / "photos" / "0.png")
    photos = open_sequence(settings, tmp_path / "photos", tmp_path / "motion.json", tmp_path / "out", (0,), False)
    names = photos.sets[0].box.names
    found = {
        "answer": "possible", "possible_volume": 1.0, "hull": None, "best": None, "seconds": 1.0, "state": "done",
        "frames": [{
            "index": 0, "parameters": [{"name": name} for name in names],
            "hull": {"lower": photos.sets[0].box.lower, "upper": photos.sets[0].box.upper},
        }],
    }  # fmt: skip
    states = []

    def search(location: Location, frames: tuple[int, ...], folder: Path) -> dict[str, Any]:
        if (tmp_path / "out" / "report.json").exists():
            states.append(json.loads((tmp_path / "out" / "report.json").read_text())["state"])
        return found

    assert photos.follow(search)["state"] == "done" and states == ["running"]
    # one that is begun anew leaves no report of the one before, also where it is killed

    def killed(location: Location, frames: tuple[int, ...], folder: Path) -> dict[str, Any]:
        raise MemoryError

    again = open_sequence(settings, tmp_path / "photos", tmp_path / "motion.json", tmp_path / "out", (0,), False)
    with pytest.raises(MemoryError):
        again.follow(killed)
    assert not (tmp_path / "out" / "report.json").exists()
    resumed = open_sequence(settings, tmp_path / "photos", tmp_path / "motion.json", tmp_path / "out", (0,), True)
    assert not resumed.entries


#: What others may make of a sequence's report.
CHANGES: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
    "no images": lambda r: {key: value for key, value in r.items() if key != "images"},
    "no list": lambda r: r | {"images": {}},
    "no entry": lambda r: r | {"images": [1]},
    "no state": lambda r: r | {"images": [{k: v for k, v in r["images"][0].items() if k != "state"}]},
    "another hull": lambda r: r["images"][1]["frames"][0]["hull"].update(lower=[0.2], upper=[0.3]) or r,
}


def test_files_of_others_are_not_replaced_by_a_sequence(
    travelled: tuple[list[str], np.ndarray, Path], in_process: InProcess
) -> None:
    options, _, folder = travelled
    folder.mkdir()
    (folder / "report.json").write_text("mine")
    code, _, err = in_process(main, options)
    assert code == 2 and "was not written by this program" in err
    assert [file.name for file in folder.iterdir()] == ["report.json"]


@pytest.mark.parametrize(
    "motion, words",
    [
        ({"translation": {"y": 0.1}}, "motion.json: y: does not vary in the set"),
        ({"translation": {"x": 0.1}, "frame": "world"}, "motion.json: frame: found world"),
        ({"translation": {"x": 0.1}, "sweep": "segments"}, "motion.json: sweep: is no motion"),
        ({"translation": {"x": [1, 0]}}, "motion.json: translation.x"),
        (None, "--motion"),
    ],
)
def test_bad_motions_are_one_line(
    motion: Any, words: str, travelled: tuple[list[str], np.ndarray, Path], tmp_path: Path, in_process: InProcess
) -> None:
    options, _, folder = travelled
    if motion is None:
        place = options.index("--motion")
        options = options[:place] + options[place + 2 :]
    else:
        (tmp_path / "motion.json").write_text(json.dumps({"version": 1, **motion}))
    code, _, err = in_process(main, options)
    assert code == 2 and words in err and err.count("\n") == 1, err
    assert not folder.exists()


def test_a_folder_without_photos_is_one_line(blobs: Inputs, tmp_path: Path, in_process: InProcess) -> None:
    for folder, words in ((tmp_path, "holds no photos"), (tmp_path / "none", "no such folder")):
        code, _, err = in_process(
            main, blobs.options(tmp_path / "out", image_sequence=folder, motion=blobs.spec, workers=1)
        )
        assert code == 2 and words in err and err.count("\n") == 1
    code, _, err = in_process(main, blobs.options(tmp_path / "out", workers=1))
    assert code == 2 and "--image: found both or neither" in err
