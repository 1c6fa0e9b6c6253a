"""Stored results go on, and are checked, only with the files that they were computed from."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from certifying import classifier
from conftest import Inputs, blob_scene
from onnx.external_data_helper import convert_model_to_external_data
from PIL import Image

import ns_abstract as nsa
from ns_abstract.api.certification import CertifySettings, open_certification
from ns_abstract.api.files import Settings
from ns_abstract.api.reaching import open_loop
from ns_abstract.check.inputs import BadInput
from ns_abstract.check.verdicts import NetworkOnPictures
from ns_abstract.demo.writing import write_loop_demo
from ns_abstract.io.atomic import write_json
from ns_abstract.io.stamps import file_stamp
from ns_abstract.methods.splat.drawable import StoredGaussians, drawable
from ns_abstract.methods.splat.method import SplatMethod
from ns_abstract.verify.network import load
from ns_abstract.verify.picture_properties import PictureProperty

CLASSES = {"type": "classification", "label": 0, "preprocess": {"resize": [16, 16]}}
#: Of the picture, at a distance in units of the data set.
DISTANCE = {"type": "clear", "distance": 0.5, "units": "dataset", "preprocess": {"resize": [16, 16]}}


def apart(file: Path) -> Path:
    """Move a network's constants into a file beside it; returns that file."""
    model = onnx.load(str(file))
    convert_model_to_external_data(model, location=f"{file.stem}.bin", size_threshold=0)
    onnx.save(model, str(file))
    return file.with_suffix(".bin")


def nudge(file: Path) -> None:
    """Change one number of a file of float32, and nothing else of the file."""
    numbers = np.fromfile(file, np.float32)
    numbers[np.argmax(np.abs(numbers))] *= 1.5
    file.write_bytes(numbers.tobytes())


def certified(blobs: Inputs, net: Path | None, prop: Path) -> dict[str, Any]:
    return open_certification(CertifySettings(Settings(blobs.config, blobs.path, blobs.spec), net, prop)).fingerprint


def rescale(config: Path, scale: float) -> None:
    file = config.parent / "dataparser_transforms.json"
    content = json.loads(file.read_text())
    write_json(file, content | {"scale": scale})


def test_certificates_know_constants_beside_the_network(blobs: Inputs, tmp_path: Path) -> None:
    net, prop = classifier(tmp_path / "net.onnx"), write_json(tmp_path / "prop.json", CLASSES)
    assert "model_data" not in certified(blobs, net, prop)
    data = apart(net)
    before, model = certified(blobs, net, prop), net.read_bytes()
    assert certified(blobs, net, prop) == before and list(before.get("model_data", {})) == [data.name]
    nudge(data)
    after = certified(blobs, net, prop)
    assert net.read_bytes() == model and after["model"] == before["model"] and after != before


def test_reports_name_the_network_that_was_read(blobs: Inputs, tmp_path: Path) -> None:
    """A file that is replaced while its network is certified gives no name to the verdicts, and runs no picture."""
    net, prop = classifier(tmp_path / "net.onnx"), write_json(tmp_path / "prop.json", CLASSES)
    data = apart(net)
    for change in (lambda: nudge(data), lambda: classifier(net, seed=1), net.unlink):
        job = open_certification(CertifySettings(Settings(blobs.config, blobs.path, blobs.spec), net, prop))
        told = job.question.describe()
        change()
        assert job.question.describe() == told and told["sha256"] == job.fingerprint["model"]
        with pytest.raises(nsa.InputError, match="was replaced" if net.exists() else "onnxruntime refuses it"):
            job.model.outputs(np.zeros((1, 16, 16, 3)))


def test_a_network_that_is_replaced_while_it_is_read_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    net, read = classifier(tmp_path / "net.onnx"), load.read_onnx
    numbers = net.read_bytes()

    def replaced(path: Path, asked: Any) -> Any:
        network = read(path, asked)
        # a last bit of a weight: no comparison with onnxruntime would see it
        classifier(path, gain=4.0 * (1.0 + 2e-7))
        return network

    monkeypatch.setattr(load, "read_onnx", replaced)
    with pytest.raises(nsa.InputError, match="was replaced"):
        load.load_network(net)
    assert net.read_bytes() != numbers


def library(outputs: int, value: float) -> str:
    """A VNN-LIB file that forbids first outputs of at most ``value``."""
    names = [f"(declare-const X_{i} Real)" for i in range(16 * 16 * 3)]
    names += [f"(declare-const Y_{i} Real)" for i in range(outputs)]
    return "\n".join([*names, f"(assert (<= Y_0 {value}))"])


@pytest.mark.parametrize("kind", ["mask.png", "index.txt", "index.npy", "net.vnnlib", "net.vnnlib.gz"])
def test_reports_name_the_files_of_a_property_that_were_read(blobs: Inputs, tmp_path: Path, kind: str) -> None:
    """A mask, a list of Gaussians or a VNN-LIB file that is replaced after it was read gives no name to verdicts."""
    file, net = tmp_path / kind, None

    def write(version: int) -> None:
        if kind == "mask.png":
            Image.fromarray(np.where(np.arange(1024).reshape(32, 32) < 99 + version, 255, 0).astype(np.uint8)).save(
                file
            )
        elif kind == "index.txt":
            file.write_text(f"0 1 {2 + version}")
        elif kind == "index.npy":
            np.save(file, np.array([0, 1, 2 + version]))
        else:
            text = library(3, float(version)).encode()
            file.write_bytes(gzip.compress(text, mtime=0) if kind.endswith(".gz") else text)

    value: dict[str, Any] = {"type": "visible", "select": {"indices": kind}}
    if kind == "mask.png":
        value = {"type": "clear", "distance": 0.5, "mask": kind}
    elif "vnnlib" in kind:
        value, net = (
            {"type": "vnnlib", "file": kind, "preprocess": {"resize": [16, 16]}},
            classifier(tmp_path / "net.onnx"),
        )
    prop = write_json(tmp_path / "prop.json", value)
    prints = []
    for version in (0, 1):
        write(version)
        prints.append(certified(blobs, net, prop)["property"])
    write(0)
    job = open_certification(CertifySettings(Settings(blobs.config, blobs.path, blobs.spec), net, prop))
    write(1)
    assert job.fingerprint["property"] == prints[0] != prints[1]


def test_a_mask_is_read_once(blobs: Inputs, tmp_path: Path) -> None:
    mask = np.zeros((32, 32), np.uint8)
    mask[3:5, 7:20] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    prop = write_json(tmp_path / "prop.json", {"type": "clear", "distance": 0.5, "mask": "mask.png"})
    job = open_certification(CertifySettings(Settings(blobs.config, blobs.path, blobs.spec), None, prop))
    Image.fromarray(255 - mask).save(tmp_path / "mask.png")
    assert isinstance(job.property, PictureProperty)
    (measure,) = job.property.measures(32, 32)
    assert np.array_equal(measure.pixels, np.flatnonzero(mask))


@pytest.mark.slow
def test_loops_know_constants_beside_the_network(tmp_path: Path) -> None:
    config, loop = write_loop_demo(tmp_path)
    data = apart(loop.parent / json.loads(loop.read_text())["network"])
    prints = []
    for _ in range(2):
        prints.append(open_loop(nsa.load_scene(config), loop).fingerprint)
        nudge(data)
    assert prints[0] != prints[1] and prints[0]["network"] == prints[1]["network"]


def test_checks_know_constants_beside_the_network(tmp_path: Path) -> None:
    net = classifier(tmp_path / "net.onnx")
    data = apart(net)
    stamp = {"sha256": file_stamp(net)["sha256"]}
    sums = {data.name: file_stamp(data)["sha256"]}
    report = {"model": stamp | {"data": sums}, "fingerprint": {}}
    scene: Any = None
    NetworkOnPictures(scene, report, net, {})
    with pytest.raises(BadInput, match="is not the network of the result"):
        NetworkOnPictures(scene, report | {"model": stamp}, net, {})
    nudge(data)
    with pytest.raises(BadInput, match="is not the network of the result"):
        NetworkOnPictures(scene, report, net, {})
    data.unlink()
    with pytest.raises(BadInput, match="lacks a file"):
        NetworkOnPictures(scene, report, net, {})


def test_distances_of_properties_are_those_of_one_data_set(make_blobs: Any, tmp_path: Path) -> None:
    blobs = make_blobs()
    prop = write_json(tmp_path / "prop.json", DISTANCE)
    prints = []
    for scale in (0.5, 0.5, 0.25):
        rescale(blobs.config, scale)
        prints.append(certified(blobs, None, prop))
    assert prints[0] == prints[1] != prints[2]


@pytest.mark.slow
def test_distances_of_loops_are_those_of_one_data_set(tmp_path: Path) -> None:
    config, loop = write_loop_demo(tmp_path)
    content = json.loads(loop.read_text())
    write_json(loop, content | {"unsafe": [*content["unsafe"], DISTANCE]})
    prints = []
    for scale in (0.5, 0.25):
        rescale(config, scale)
        prints.append(open_loop(nsa.load_scene(config), loop).fingerprint)
    assert prints[0] != prints[1]


def test_numbers_of_gaussians_in_their_source_are_compared() -> None:
    """Selections name Gaussians so: the same ones behind one that is never drawn have other numbers."""
    scene = blob_scene(4)
    prints = []
    for place in (0, 2):
        keep = np.insert(np.arange(4), place, 0)
        arrays = {name: getattr(scene, name)[keep] for name in ("means", "log_scales", "quats", "opacity_logits", "sh")}
        arrays["means"][place] = np.nan
        rows, dropped = drawable(
            StoredGaussians(**arrays), Path("a.ply"), dict.fromkeys(("scales", "quats", "opacities", "colours"), "")
        )
        again = type(scene)(**{**vars(scene), **vars(rows), **dropped})
        prints.append(SplatMethod(again, None, None).fingerprint)
    assert prints[0]["scene"] == prints[1]["scene"] and prints[0] != prints[1]
