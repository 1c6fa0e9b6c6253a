"""The shared networks: loaded like onnxruntime reads them, and bounded soundly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch

from ns_abstract.verify.network import ImageSets, bound_outputs, load_network

_FOLDERS = [parent / "shared" / "models" for parent in Path(__file__).resolve().parents]
MODELS = next((folder for folder in _FOLDERS if folder.is_dir()), _FOLDERS[2])
NAMES = ("cifar10_resnet2b", "cifar10_resnet4b", "gatenet_circle", "gatenet_paper", "tinyyolo_voc")


def model(name: str) -> Path:
    file = MODELS / f"{name}.onnx"
    if not file.is_file():
        pytest.skip(f"{file} is not there")
    return file


def curve(shape: tuple[int, ...], d: int, radius: float, slack: float, seed: int) -> ImageSets:
    """One cell of smooth images in d parameters with some slack."""
    rng = np.random.default_rng(seed)
    n = int(np.prod(shape))
    c, a, h, w = rng.normal(size=(shape[0], 4, 4)), rng.normal(size=(d, shape[0], 4, 4)), shape[1], shape[2]
    grow = lambda t: np.repeat(np.repeat(t, -(-h // 4), -2), -(-w // 4), -1)[..., :h, :w]  # noqa: E731
    c, a = grow(c).reshape(1, n), radius * grow(a).reshape(d, n).T[None]
    reach = np.abs(a).sum(-1) + slack
    return ImageSets(a, c - slack, a, c + slack, c - reach, c + reach)


def attack(file: Path, images: ImageSets, rows: np.ndarray, count: int, seed: int = 0) -> np.ndarray:
    """Least ``rows @ y`` [k] in float32 by onnxruntime, over random and extreme images of cell 0."""
    rng = np.random.default_rng(seed)
    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    entry = session.get_inputs()[0]
    shape = (1, *entry.shape[1:])
    least = np.full(len(rows), np.inf)
    d = images.dimensions
    for k in range(count):
        p = rng.uniform(-1, 1, d) if k % 2 else rng.choice([-1.0, 1.0], d)
        low = np.maximum(images.a_lower[0] @ p + images.b_lower[0], images.lower[0])
        high = np.minimum(images.a_upper[0] @ p + images.b_upper[0], images.upper[0])
        t = rng.uniform(size=low.shape) if k % 3 else rng.integers(0, 2, low.shape)
        x = np.clip((low + t * (high - low)).astype(np.float32).astype(np.float64), low, high)
        image = x.astype(np.float32)
        # an image of float32 numbers inside the set
        image = np.where(image < low, np.nextafter(image, np.float32(np.inf)), image)
        image = np.where(image > high, np.nextafter(image, np.float32(-np.inf)), image)
        inside = (low <= image) & (image <= high)
        y = session.run(None, {entry.name: image.reshape(shape)})[0].reshape(-1).astype(np.float64)
        if inside.all():
            least = np.minimum(least, rows @ y)
    return least


@pytest.mark.parametrize("name", NAMES[:4])
@pytest.mark.parametrize("d", [1, 3])
def test_bounds_hold_for_onnxruntime(name: str, d: int) -> None:
    file = model(name)
    network = load_network(file)
    rows = np.random.default_rng(1).normal(size=(3, network.output_size))
    images = curve(network.input_shape, d, 0.02, 0.002, 0)
    least = attack(file, images, rows, 60)
    found = {
        mode: bound_outputs(network, images, rows, np.zeros(3), substitution=mode).lower[0]
        for mode in ("everywhere", "end", "box")
    }
    for lower in found.values():
        assert np.isfinite(lower).all()
        assert (lower <= least).all()
    assert (found["end"] >= found["box"]).all()
    assert (found["everywhere"] >= found["end"] - 1e-3 * np.abs(found["end"])).all()


@pytest.mark.parametrize("name", NAMES)
def test_network_agrees_with_onnxruntime(name: str) -> None:
    file = model(name)
    network = load_network(file)
    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    image = np.random.default_rng(3).uniform(-1, 2, (1, *network.input_shape)).astype(np.float32)
    expected = session.run(None, {session.get_inputs()[0].name: image})[0].reshape(-1)
    for dtype in (torch.float32, torch.float64):
        x = torch.from_numpy(image).to(dtype).requires_grad_()
        y = network(x)
        assert y.dtype == dtype
        assert y.shape == (1, network.output_size)
        np.testing.assert_allclose(y[0].detach().numpy(), expected, rtol=1e-4, atol=1e-4)
        y.sum().backward()
        assert x.grad is not None and float(x.grad.abs().max()) > 0.0
