"""Abstract images written for other verifiers: same numbers, same sets, a file they can read."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx_files import OnnxFile, image_sets, members, session

from ns_abstract.io.errors import InputError
from ns_abstract.verify.interop import write_vnnlib
from ns_abstract.verify.network import ImageSets, bound_outputs, load_network

SHAPE = (2, 3, 3)


def network_file(folder: Path, opset: int = 17) -> Path:
    f = OnnxFile(SHAPE, opset=opset)
    f.conv(2, 3)
    f.node("Relu")
    f.node("Flatten")
    f.gemm(3, 3)
    return f.write(folder / "net.onnx")


def inputs_of(images: ImageSets, x: np.ndarray, p: np.ndarray) -> np.ndarray:
    """The input (p, e) that gives images ``x`` at ``p``, from the set itself."""
    center = 0.5 * (images.b_lower[0] + images.b_upper[0]) + p @ (0.5 * (images.a_lower[0] + images.a_upper[0])).T
    radius = 0.5 * (images.b_upper[0] - images.b_lower[0])
    radius = radius + 0.5 * np.abs(images.a_upper[0] - images.a_lower[0]).sum(1)
    return np.concatenate([p, (x - center) / radius], axis=1)


@pytest.mark.parametrize("form", ["slice", "gemm"])
@pytest.mark.parametrize("opset", [9, 17])
def test_written_network_agrees(form: str, opset: int, tmp_path: Path) -> None:
    file = network_file(tmp_path, opset)
    images = image_sets(SHAPE, 1, 2, 0.2, 0.1)
    rows, offset = np.array([[1.0, -1.0, 0.0], [1.0, 0.0, -1.0]]), np.array([0.5, 0.25])
    written, _ = write_vnnlib(file, images, rows, offset, tmp_path / "cell", form)  # type: ignore[arg-type]
    onnx.checker.check_model(onnx.load(str(written)))
    rng = np.random.default_rng(0)
    p = rng.uniform(-1, 1, (20, 2))
    x, inside = members(images, 0, p, rng.uniform(size=(20, 18)))
    assert inside.all()
    given = inputs_of(images, x, p)
    # every image of the set is that of an input in the box
    assert np.abs(given).max() <= 1.0 + 1e-6
    run, whole = session(file), session(written)
    found = np.concatenate([whole(one[None].astype(np.float32)) for one in given])
    np.testing.assert_allclose(found, run(x.reshape(-1, *SHAPE)) @ rows.T + offset, atol=1e-5)


def test_written_network_is_read_and_bounded_again(tmp_path: Path) -> None:
    """Read back, with (p, e) as an image, it has bounds that agree with those of the set."""
    file = network_file(tmp_path)
    images = image_sets(SHAPE, 1, 2, 0.05, 0.02)
    rows, offset = np.array([[1.0, -1.0, 0.0], [1.0, 0.0, -1.0]]), np.array([0.5, 0.25])
    written, _ = write_vnnlib(file, images, rows, offset, tmp_path / "cell", "gemm")
    again = load_network(written)
    n = again.input_size
    zero, one = np.zeros((1, n, 1)), np.ones((1, n))
    box = ImageSets(zero, -one, zero, one, -one, one)
    found = bound_outputs(again, box, np.eye(2), np.zeros(2)).lower[0]
    direct = bound_outputs(load_network(file), images, rows, offset).lower[0]
    # the written set is a little larger: it has no box besides
    assert (found <= direct + 1e-3).all()
    assert (found >= direct - 0.05).all()


def test_property_file(tmp_path: Path) -> None:
    file = network_file(tmp_path)
    images = image_sets(SHAPE, 1, 2, 0.2, 0.1)
    _, written = write_vnnlib(file, images, np.eye(3)[:2], np.zeros(2), tmp_path / "cell")
    text = written.read_text()
    assert len(re.findall(r"\(declare-const X_\d+ Real\)", text)) == 20
    assert len(re.findall(r"\(declare-const Y_\d+ Real\)", text)) == 2
    assert len(re.findall(r"\(assert \(<= X_\d+ 1\.0\)\)", text)) == 20
    assert len(re.findall(r"\(assert \(>= X_\d+ -1\.0\)\)", text)) == 20
    assert re.search(r"\(assert \(or\s+\(and \(<= Y_0 0\.0\)\)\s+\(and \(<= Y_1 0\.0\)\)\s+\)\)", text)
    body = re.sub(r";.*", "", text)
    assert body.count("(") == body.count(")")


def test_another_verifier_decides_the_same(tmp_path: Path) -> None:
    marabou = pytest.importorskip("maraboupy.Marabou", reason="maraboupy is not installed")
    core = pytest.importorskip("maraboupy.MarabouCore", reason="maraboupy is not installed")
    file = network_file(tmp_path)
    images = image_sets(SHAPE, 1, 2, 0.05, 0.02)
    # what is written has neither a box nor planes that are not parallel
    slopes = images.a_lower
    images = ImageSets(slopes, images.b_lower, slopes, images.b_upper, images.b_lower - 1.0, images.b_upper + 1.0)
    network = load_network(file)
    y = network(torch.from_numpy(0.5 * (images.b_lower + images.b_upper)).reshape(1, *SHAPE))[0].numpy()
    rows = np.array([[1.0, -1.0, 0.0]])
    margin = float(rows[0] @ y)
    bound = float(bound_outputs(network, images, rows, np.zeros(1)).lower[0, 0])
    # the property holds with the certified offset and fails where the middle breaks it
    for offset, expected in ((-bound + 1e-2, "unsat"), (-margin - 1e-2, "sat")):
        written, _ = write_vnnlib(file, images, rows, np.array([offset]), tmp_path / "cell", "gemm")
        other = marabou.read_onnx(str(written))
        for variable in other.inputVars[0].flatten():
            other.setLowerBound(variable, -1.0)
            other.setUpperBound(variable, 1.0)
        other.setUpperBound(other.outputVars[0].flatten()[0], 0.0)
        verdict, _, _ = other.solve(verbose=False, options=core.Options())
        assert verdict == expected


def test_what_cannot_be_extended(tmp_path: Path) -> None:
    file = network_file(tmp_path)
    model = onnx.load(str(file))
    model.ir_version = 3
    (tmp_path / "old.onnx").write_bytes(model.SerializeToString())
    images = image_sets(SHAPE, 2, 2, 0.2, 0.1)
    with pytest.raises(ValueError, match="one cell"):
        write_vnnlib(file, images, np.eye(3), np.zeros(3), tmp_path / "cell")
    with pytest.raises((InputError, ValueError)):
        write_vnnlib(tmp_path / "old.onnx", images[:1], np.eye(3), np.zeros(3), tmp_path / "cell")
    assert not list(tmp_path.glob("cell*"))
