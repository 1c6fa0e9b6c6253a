"""Files of networks: what is refused and how it is said, and torch.export as a second way in."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, numpy_helper
from onnx_files import OnnxFile, image_sets, session

from ns_abstract.io.errors import InputError
from ns_abstract.verify.network import bound_outputs, load_network
from ns_abstract.verify.network.explain import check_cell, measured, moving_picture

SHAPE = (2, 4, 4)


def refused(file: Path, *words: str) -> None:
    with pytest.raises(InputError) as error:
        load_network(file)
    text = str(error.value)
    assert text.startswith(str(file))
    assert "\n" not in text
    for word in words:
        assert word in text, text


def small() -> OnnxFile:
    f = OnnxFile(SHAPE)
    f.conv(2, 2)
    f.node("Relu")
    return f


def _weight(f: OnnxFile, value: float) -> None:
    array = numpy_helper.to_array(f.constants[0]).copy()
    array.flat[3] = value
    f.constants[0].CopyFrom(numpy_helper.from_array(array, f.constants[0].name))


BAD: dict[str, tuple[Callable[[OnnxFile], object], tuple[str, ...]]] = {
    "operator": (lambda f: f.node("ArgMax", axis=1), ("ArgMax_v2", "ArgMax", "make its input")),
    "activation": (lambda f: f.node("Shrink"), ("Shrink_v2", "not supported", "nearest by name")),
    "mask of all": (
        lambda f: f.node("Softmax", f.node("Add", f.last, f.constant(np.full((1, 2, 1, 1), -np.inf))), axis=1),
        ("Softmax", "all numbers of a row"),
    ),
    "mask without a softmax": (
        lambda f: f.node("Relu", f.node("Add", f.last, f.constant(-np.inf))),
        ("Relu", "minus infinity", "Softmax"),
    ),
    "infinite factor": (lambda f: f.node("Mul", f.last, f.constant(-np.inf)), ("minus infinity", "Softmax")),
    "einsum of a diagonal": (lambda f: f.node("Einsum", equation="aabc->abc"), ("equation = aabc->abc", "once")),
    "einsum of three": (
        lambda f: f.node("Einsum", f.last, f.constant(1.0), f.constant(1.0), equation="abcd,,->abcd"),
        ("one or two values",),
    ),
    "softmax over the batch": (lambda f: f.node("Softmax", axis=0), ("axis = 0", "batch")),
    "power": (lambda f: f.node("Pow", f.last, f.constant(9.5)), ("exponent 9.5", "from -8 to 8")),
    "half precision": (lambda f: f.node("Cast", to=TensorProto.FLOAT16), ("to = FLOAT16", "float32")),
    "cubic": (
        lambda f: f.node("Resize", f.last, "", f.constant([1, 1, 2, 2]), mode="cubic", exclude_outside=1),
        ("exclude_outside = 1", "only 0"),
    ),
    "indices": (lambda f: f.node("Gather", f.last, f.constant([5], np.int64), axis=1), ("indices", "axis 1")),
    "huge constant": (
        lambda f: f.node(
            "Add",
            f.last,
            f.node("ConstantOfShape", f.constant([1 << 20, 1 << 20, 1 << 20], np.int64)),
        ),
        ("ConstantOfShape", "numbers"),
    ),
    "group": (lambda f: f.conv(2, 2, k=1, groups=1) and f.nodes[-1].attribute[0].__setattr__("i", 3), ("group = 3",)),
    "transposed batch": (
        lambda f: f.node("Transpose", perm=[1, 0, 2, 3]) and f.conv(1, 2, k=1),
        ("mixes the batch", "keep the batch first"),
    ),
    "gemm": (lambda f: f.node("Flatten") and f.node("Gemm", f.last, f.weights(8, 3), transA=1), ("transA = 1",)),
    "alpha": (lambda f: f.node("Elu", alpha=-0.5), ("alpha = -0.5",)),
    "division": (lambda f: f.node("Div", f.last, f.constant(0.0)), ("zero",)),
    "huge pads": (
        lambda f: f.node("Pad", f.last, f.constant([0, 0, 0, 0, 0, 0, 1 << 28, 1 << 28], np.int64)),
        ("numbers",),
    ),
    "huge conv pads": (lambda f: f.conv(2, 2, pads=[1 << 20, 1 << 20, 1 << 20, 1 << 20]), ("numbers",)),
    "negative variance": (
        lambda f: f.node(
            "BatchNormalization", f.last, f.weights(2), f.weights(2), f.weights(2), f.constant([-1.0, 1.0])
        ),
        ("variance",),
    ),
    "training": (
        lambda f: f.node("Dropout", f.last, f.constant(0.5), f.constant(True, np.bool_)),
        ("Dropout", "training"),
    ),
    "reshape": (lambda f: f.node("Reshape", f.last, f.constant([4, 3], np.int64)), ("shape [4, 3]",)),
    "infinite weight": (lambda f: _weight(f, np.inf), ("initializer c0", "not finite")),
    "nan weight": (lambda f: _weight(f, np.nan), ("initializer c0", "not finite")),
    "two inputs": (lambda f: f.node("Add", f.last, "other"), ("other",)),
    "concat batch": (lambda f: f.node("Concat", f.last, f.last, axis=0), ("axis = 0",)),
    "unknown attribute": (lambda f: f.node("Relu", slope=2.0), ("slope",)),
}


@pytest.mark.parametrize("name", BAD)
def test_refuses(name: str, tmp_path: Path) -> None:
    damage, words = BAD[name]
    f = small()
    damage(f)
    refused(f.write(tmp_path / "net.onnx"), *words)


def test_files_that_are_no_networks(tmp_path: Path) -> None:
    refused(tmp_path / "none.onnx", "no such network")
    refused(tmp_path, "is a folder, not a network")
    for name, data in (("a.onnx", b"\x00\xffgarbage"), ("b.onnx", b""), ("c.pt2", b"PK\x03\x04zip"), ("d.txt", b"")):
        (tmp_path / name).write_bytes(data)
        refused(tmp_path / name)


def test_refuses_free_sizes(tmp_path: Path) -> None:
    f = OnnxFile((2, "H", 4))  # type: ignore[arg-type]
    f.node("Relu")
    refused(f.write(tmp_path / "net.onnx"), "input image", "preprocess.resize")


def test_refuses_old_operator_sets(tmp_path: Path) -> None:
    f = small()
    f.opset = 5
    refused(f.write(tmp_path / "net.onnx"), "operator set 5")


def _external(folder: Path, location: str, **extra: str) -> Path:
    model = small().model()
    tensor = model.graph.initializer[0]
    data = tensor.raw_data
    (folder / "weights.bin").write_bytes(data)
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    for key, value in {"location": location, **extra}.items():
        entry = tensor.external_data.add()
        entry.key, entry.value = key, value
    (folder / "net.onnx").write_bytes(model.SerializeToString())
    return folder / "net.onnx"


def test_external_data(tmp_path: Path) -> None:
    inside = tmp_path / "model"
    inside.mkdir()
    network = load_network(_external(inside, "weights.bin"))
    assert network.output_shape == (2, 2, 2)
    (tmp_path / "secret.bin").write_bytes((inside / "weights.bin").read_bytes())
    refused(_external(inside, "../secret.bin"), "outside the model's folder")
    refused(_external(inside, str(tmp_path / "secret.bin")), "outside the model's folder")
    (inside / "link.bin").symlink_to(tmp_path / "secret.bin")
    refused(_external(inside, "link.bin"), "outside the model's folder")
    refused(_external(inside, "missing.bin"), "missing.bin")
    refused(_external(inside, "weights.bin", offset="1000000"), "initializer c0")
    twice = _external(inside, "weights.bin")
    model = onnx.load(str(twice), load_external_data=False)
    model.graph.initializer[0].external_data.add(key="location", value="weights.bin")
    twice.write_bytes(model.SerializeToString())
    refused(twice, "twice")


def test_a_claim_of_a_huge_tensor_is_refused(tmp_path: Path) -> None:
    model = small().model()
    model.graph.initializer[0].dims[:] = [1 << 20, 1 << 20, 3, 3]
    (tmp_path / "net.onnx").write_bytes(model.SerializeToString())
    refused(tmp_path / "net.onnx", "initializer c0", "numbers")


def test_a_reading_that_computes_something_else_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from ns_abstract.verify.network.layers import Convolution

    file = small().write(tmp_path / "net.onnx")
    monkeypatch.setattr(Convolution, "bias", None)
    refused(file, "computes something else")


# ---------------------------------------------------------------- torch.export


def test_networks_are_pickled_for_other_processes(tmp_path: Path) -> None:
    file = small().write(tmp_path / "net.onnx")
    network = load_network(file)
    images = image_sets(SHAPE, 2, 1, 0.1, 0.1)
    rows = np.eye(network.output_size)
    before = bound_outputs(network, images, rows, np.zeros(len(rows)))
    again = pickle.loads(pickle.dumps(network))
    after = bound_outputs(again, images, rows, np.zeros(len(rows)))
    assert (before.lower == after.lower).all()
    assert session(file)(np.zeros((1, *SHAPE), np.float32)).shape == (1, 8)
    assert onnx.__version__


def test_a_network_is_explained_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from ns_abstract.cli import certify

    file = small().write(tmp_path / "net.onnx")
    monkeypatch.setattr("sys.argv", ["ns-abstract-certify", "--model", str(file), "--explain"])
    with pytest.raises(SystemExit) as end:
        certify.main()
    text = capsys.readouterr().out
    assert end.value.code == 0
    assert "Convolution" in text and "LeakyRelu" in text and "GiB" in text and "Conv_v0" in text
    widths = [float(line.split()[-1]) for line in text.splitlines() if line.startswith("  values move by")]
    assert len(widths) == 3 and 0.0 < widths[0] < widths[1] < widths[2]


@pytest.mark.parametrize("dimensions", [0, 1, 5])
def test_times_are_of_a_picture_that_moves_as_is_said(dimensions: int) -> None:
    images = moving_picture(SHAPE, dimensions, 0.01)
    assert images.dimensions == dimensions
    assert np.allclose(images.upper - images.b_upper, np.abs(images.a_upper).sum(-1), rtol=0.0, atol=1e-15)
    half = 0.5 * (images.upper - images.lower)
    assert 0.005 < half.max() <= 0.0106 and images.lower.min() >= 0.0 and images.upper.max() <= 1.0


def test_cells_that_take_too_long_are_given_up(tmp_path: Path) -> None:
    network = load_network(small().write(tmp_path / "net.onnx"))
    assert list(measured(network, 2, seconds=0.0)) == ["  values move by 0.001: not bounded within 0 s"]


@pytest.mark.slow
def test_cells_that_need_too_much_memory_are_refused_by_an_estimate(tmp_path: Path) -> None:
    f = OnnxFile((3, 256, 256))
    f.node("Unsqueeze", f.last, f.constant([2], np.int64))
    f.node("Expand", f.last, f.constant([1, 3, 40, 256, 256], np.int64))
    f.node("Exp")
    f.node("Flatten")
    f.node("ReduceMean", axes=[1])
    network = load_network(f.write(tmp_path / "net.onnx"))
    check_cell(network, 2, 16 << 30)
    with pytest.raises(InputError, match=r"net.onnx: needs about \d.*GiB.*numbers.*--memory-limit"):
        check_cell(network, 2, 1 << 30)


def test_sizes_are_refused_before_they_are_allocated(tmp_path: Path) -> None:
    f = OnnxFile((8, 64, 64))
    for _ in range(14):
        f.node("Concat", f.last, f.last, axis=1)
    refused(f.write(tmp_path / "concat.onnx"), "Concat", "numbers")
    f = OnnxFile((3, 64, 64))
    f.node("Resize", f.last, "", f.constant([1, 1, 900, 900]), mode="linear")
    refused(f.write(tmp_path / "resize.onnx"), "Resize", "numbers")
    f = OnnxFile((3, 64, 64))
    f.node("Tile", f.last, f.constant([1, 1 << 14, 1 << 10, 1], np.int64))
    refused(f.write(tmp_path / "tile.onnx"), "Tile", "numbers")
    f = OnnxFile((3, 8, 8))
    f.node("AveragePool", kernel_shape=[2, 2], strides=[0, 1])
    refused(f.write(tmp_path / "stride.onnx"), "strides")


def test_data_that_is_no_plain_file_is_not_opened(tmp_path: Path) -> None:
    file = _external(tmp_path, "pipe")
    os.mkfifo(tmp_path / "pipe")
    refused(file, "pipe", "regular file")
    with (tmp_path / "hole").open("wb") as stream:
        stream.truncate(3 << 30)
    refused(_external(tmp_path, "hole", length=str(3 << 30)), "initializer c0", "bytes")


def test_channels_that_double_are_refused_by_their_number(tmp_path: Path) -> None:
    f = OnnxFile((3, 8, 8))
    for _ in range(30):
        f.node("Concat", f.last, f.last, axis=1)
    with pytest.raises(InputError, match="between 1 and 67,108,864 are supported") as caught:
        load_network(f.write(tmp_path / "net.onnx"))
    # no matrices of one channel by another are made on the way
    assert "Concat_v18" in str(caught.value)
