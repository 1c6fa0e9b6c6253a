"""Results in other programs' formats: what is read back is what was bounded; what needs a package says so."""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from certifying import classifier
from conftest import Inputs
from test_cli import call, one_line  # noqa: F401

from ns_abstract.cli import certify as certify_command
from ns_abstract.cli import export as export_command
from ns_abstract.cli import render as render_command
from ns_abstract.report.files import IMAGES, LEAVES, load_frame

Call = Callable[..., tuple[int, str]]


@pytest.fixture(scope="module")
def bounded(blobs: Inputs, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of ns-abstract-render --save-cells for two frames of a small path."""
    folder = tmp_path_factory.mktemp("bounded") / "out"
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as leave:
        options = blobs.options(folder, time_budget=6, target_ratio=1.5)
        patch.setattr("sys.argv", ["command", *options, "--frames", "0", "2", "--save-cells"])
        render_command.main()
    assert leave.value.code == 0
    return folder


def run(call: Call, *options: object) -> tuple[int, str]:  # noqa: F811
    return call([str(option) for option in options], export_command.main)


@pytest.mark.slow
def test_exr_holds_the_bounds_bit_for_bit(call: Call, bounded: Path, tmp_path: Path) -> None:  # noqa: F811
    exr: Any = pytest.importorskip("OpenEXR", reason="OpenEXR is not installed (extra exr)")
    assert run(call, "exr", "--input-dir", bounded, "--output-dir", tmp_path / "new") == (0, "")
    assert {f.name for f in (tmp_path / "new").iterdir()} == {"frame_00000.exr", "frame_00002.exr"}
    for index in (0, 2):
        result = load_frame(bounded / f"frame_{index:05d}.npz").result
        parts = {part.name(): part for part in exr.File(str(tmp_path / "new" / f"frame_{index:05d}.exr")).parts}
        assert parts.keys() == set(IMAGES)
        for name in IMAGES:
            pixels = parts[name].channels["RGB"].pixels
            assert pixels.dtype == np.float32
            np.testing.assert_array_equal(pixels, getattr(result, name))


def test_safetensors_hold_the_linear_sets(call: Call, bounded: Path, tmp_path: Path) -> None:  # noqa: F811
    safetensors: Any = pytest.importorskip("safetensors", reason="safetensors is not installed")
    assert run(call, "safetensors", "--input-dir", bounded, "--output-dir", tmp_path / "new") == (0, "")
    for index in (0, 2):
        stored = load_frame(bounded / f"frame_{index:05d}.npz")
        with safetensors.safe_open(tmp_path / "new" / f"frame_{index:05d}.safetensors", "numpy") as file:
            about = file.metadata()
            assert set(file.keys()) == {*IMAGES, *LEAVES}
            for name in file.keys():  # noqa: SIM118
                source = stored.result if name in IMAGES else stored.result.leaves
                expected = getattr(source, name)
                assert file.get_tensor(name).dtype == expected.dtype
                np.testing.assert_array_equal(file.get_tensor(name), expected)
        assert about["format"] == "ns-abstract frame 1" and about["guarantee"] == "float32-sound"
        (side,) = json.loads(about["parameters"])
        assert (side["name"], side["lower"]) == (stored.result.box.names[0], stored.result.box.lower[0])


def test_frames_without_linear_sets_are_refused(call: Call, bounded: Path, tmp_path: Path) -> None:  # noqa: F811
    pytest.importorskip("safetensors", reason="safetensors is not installed")
    plain = tmp_path / "plain"
    plain.mkdir()
    with np.load(bounded / "frame_00000.npz", allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files if name not in LEAVES}
    np.savez(plain / "frame_00000.npz", **arrays)
    code, error = run(call, "safetensors", "--input-dir", plain, "--output-dir", tmp_path)
    one_line(code, error, "--save-cells")


@pytest.mark.parametrize(
    ("command", "module", "extra"),
    [("exr", "OpenEXR", "exr"), ("safetensors", "safetensors.numpy", "safetensors"), ("rrd", "rerun", "rerun"),
     ("viser", "viser", "viser")],
)  # fmt: skip
def test_a_missing_package_is_named_with_the_line_for_pip(
    call: Call, bounded: Path, blobs: Inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str,  # noqa: F811
    module: str, extra: str,
) -> None:  # fmt: skip
    monkeypatch.setitem(sys.modules, module, None)
    where = "--output-dir" if command in ("exr", "safetensors") else "--output-filename"
    options = ["--camera-path-filename", blobs.path] if command == "viser" else []
    code, error = run(call, command, "--input-dir", bounded, where, tmp_path / "out", *options)
    one_line(code, error, f"pip install 'ns-abstract[{extra}]'")
    assert not (tmp_path / "out").is_file()


@pytest.mark.slow
def test_a_rerun_recording_holds_every_frame(call: Call, bounded: Path, blobs: Inputs, tmp_path: Path) -> None:  # noqa: F811
    pytest.importorskip("rerun", reason="rerun-sdk is not installed (extra rerun)")
    file = tmp_path / "path.rrd"
    options = ["--camera-path-filename", blobs.path, "--load-config", blobs.config]
    assert run(call, "rrd", "--input-dir", bounded, "--output-filename", file, *options) == (0, "")
    data = file.read_bytes()
    assert data[:3] == b"RRF"
    for entity in (b"scene/gaussians", b"scene/camera", b"bounds/lower", b"bounds/gap", b"figures/mpg"):
        assert entity in data
    assert [f.name for f in tmp_path.iterdir()] == ["path.rrd"]


@pytest.mark.slow
def test_a_viser_recording_is_written(call: Call, bounded: Path, blobs: Inputs, tmp_path: Path) -> None:  # noqa: F811
    pytest.importorskip("viser", reason="viser is not installed (extra viser)")
    file = tmp_path / "path.viser"
    options = ["--camera-path-filename", blobs.path, "--load-config", blobs.config]
    code, error = run(call, "viser", "--input-dir", bounded, "--output-filename", file, *options)
    assert code == 0 and "Error" not in error
    assert file.stat().st_size > 1000


def test_a_path_of_other_frames_is_refused(call: Call, bounded: Path, blobs: Inputs, tmp_path: Path) -> None:  # noqa: F811
    content = json.loads(blobs.path.read_text())
    content["camera_path"] = content["camera_path"][:1]
    (tmp_path / "short.json").write_text(json.dumps(content))
    options = ["--camera-path-filename", tmp_path / "short.json", "--output-filename", tmp_path / "path.rrd"]
    code, error = run(call, "rrd", "--input-dir", bounded, *options)
    one_line(code, error, "1 cameras")


# ---------------------------------------------------------------- statements


@pytest.fixture(scope="module")
def certificate(blobs: Inputs, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A certificate; its network and property lie beside it."""
    folder = tmp_path_factory.mktemp("certificate")
    classifier(folder / "net.onnx", 16)
    (folder / "prop.json").write_text(
        json.dumps({"type": "classification", "label": 0, "preprocess": {"resize": [16, 16]}})
    )
    options = {"model": folder / "net.onnx", "property": folder / "prop.json", "frames": 0, "time_budget": 4}
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as leave:
        patch.setattr("sys.argv", ["command", *blobs.options(folder / "out", **options)])
        certify_command.main()
    assert leave.value.code == 0
    return folder


def stated(call: Call, folder: Path, target: Path) -> tuple[dict[str, Any], str]:  # noqa: F811
    code, error = run(call, "statement", "--input-dir", folder, "--output-filename", target / "statement.json")
    assert code == 0, error
    return json.loads((target / "statement.json").read_text()), error


@pytest.mark.slow
def test_a_statement_names_what_was_certified(
    call: Call, certificate: Path, blobs: Inputs, tmp_path: Path,  # noqa: F811
) -> None:  # fmt: skip
    content, error = stated(call, certificate / "out", tmp_path)
    report = json.loads((certificate / "out" / "report.json").read_text())
    assert content["_type"] == "https://in-toto.io/Statement/v1" and ":" in content["predicateType"] and error == ""
    assert content.keys() == {"_type", "subject", "predicateType", "predicate"}
    digests = {entry["name"]: entry["digest"]["sha256"] for entry in content["subject"]}
    files = (certificate / "net.onnx", certificate / "prop.json", blobs.checkpoint)
    for file in files:
        assert digests.pop(file.name) == hashlib.sha256(file.read_bytes()).hexdigest()
    assert digests == {name: report["fingerprint"][name] for name in ("scene", "property")}
    for name in ("verdict", "coverage", "property", "guarantee", "cells_seal", "frames"):
        assert content["predicate"][name] == report[name], name


@pytest.mark.slow
def test_a_statement_does_not_name_files_that_have_changed(
    call: Call, certificate: Path, tmp_path: Path,  # noqa: F811
) -> None:  # fmt: skip
    """A scene that cannot be read again, and a property that says something else, are named by their digests alone."""
    folder = tmp_path / "out"
    shutil.copytree(certificate / "out", folder)
    report = json.loads((folder / "report.json").read_text())
    (tmp_path / "prop.json").write_text(json.dumps({"type": "classification", "label": 1}))
    report["settings"]["property"] = str(tmp_path / "prop.json")
    report["settings"]["load_config"] = str(tmp_path / "none.yml")
    (folder / "report.json").write_text(json.dumps(report))
    content, error = stated(call, folder, tmp_path)
    assert {entry["name"] for entry in content["subject"]} == {"scene", "property", "net.onnx"}
    assert "no such run" in error and error.count("\n") == 1


@pytest.mark.slow
def test_cells_that_are_not_those_of_the_report_are_not_stated(
    call: Call, certificate: Path, tmp_path: Path, bounded: Path,  # noqa: F811
) -> None:  # fmt: skip
    folder = tmp_path / "out"
    shutil.copytree(certificate / "out", folder)
    report = json.loads((folder / "report.json").read_text())
    report["cells_seal"]["rows"] += 1
    (folder / "report.json").write_text(json.dumps(report))
    target = tmp_path / "statement.json"
    for wrong, words in ((folder, "cells_seal"), (bounded, "no certificate"), (tmp_path / "none", "no such folder")):
        code, error = run(call, "statement", "--input-dir", wrong, "--output-filename", target)
        one_line(code, error, words)
        assert not target.exists()
