"""The shared networks: loaded like onnxruntime reads them, and bounded soundly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from onnx_files import attack, boxed, session

from ns_abstract.api.files import Settings, open_job
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.methods.splat.frame import linear_sets
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

    def grown(t: np.ndarray) -> np.ndarray:
        return np.repeat(np.repeat(t, -(-h // 4), -2), -(-w // 4), -1)[..., :h, :w]

    c, a = grown(c).reshape(1, n), radius * grown(a).reshape(d, n).T[None]
    reach = np.abs(a).sum(-1) + slack
    return ImageSets(a, c - slack, a, c + slack, c - reach, c + reach)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES[:4])
@pytest.mark.parametrize("d", [1, 3])
def test_bounds_hold_for_onnxruntime(name: str, d: int) -> None:
    file = model(name)
    network = load_network(file)
    rows = np.random.default_rng(1).normal(size=(3, network.output_size))
    images = curve(network.input_shape, d, 0.02, 0.002, 0)
    least, _ = attack(network, session(file), images, 0, rows, 60, 10)
    lower, box = (bound_outputs(network, sets, rows, np.zeros(3)).lower[0] for sets in (images, boxed(images)))
    for bounds in (lower, box):
        assert np.isfinite(bounds).all()
        assert (bounds <= least).all()
    assert (lower >= box - 1e-3 * np.abs(box)).all()


@pytest.mark.slow_cases
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


@pytest.mark.slow
def test_detector_rows_stay_in_their_windows() -> None:
    """Single outputs of the detector depend on windows only; a narrow cell is bounded within a fixed memory."""
    file = model("tinyyolo_voc")
    network = load_network(file)
    images = curve(network.input_shape, 1, 1e-3, 1e-4, 0)
    rows = np.zeros((4, network.output_size))
    for k, place in enumerate(((0, 6, 6), (7, 0, 0), (30, 12, 5), (120, 3, 12))):
        rows[k, np.ravel_multi_index(place, (125, 13, 13))] = (-1.0) ** k
    least, _ = attack(network, session(file), images, 0, rows, 24, 6)
    lower = bound_outputs(network, images, rows, np.zeros(4)).lower[0]
    assert (lower <= least).all()
    nominal = rows @ network(torch.from_numpy(0.5 * (images.b_lower + images.b_upper)).reshape(1, 3, 52, 52))[0].numpy()
    assert (nominal - lower).max() < 0.04


MEAN, STD = np.array((0.4914, 0.4822, 0.4465)), np.array((0.2471, 0.2435, 0.2616))


def channels_first(tiles: np.ndarray) -> np.ndarray:
    """[4, 16, 16, 3, ...] tiles to [1, 3 * 32 * 32, ...]."""
    image = tiles.reshape(2, 2, 16, 16, *tiles.shape[3:]).swapaxes(1, 2).reshape(32, 32, *tiles.shape[3:])
    return np.moveaxis(image, 2, 0).reshape(1, 3072, *tiles.shape[4:])


@pytest.mark.slow
@pytest.mark.parametrize("width", [1e-3, 8e-3])
def test_rendered_images_of_an_orbit(width: float) -> None:
    """Float32 runs on really rendered images obey bounds and planes; margins are certified with room."""
    file = model("cifar10_resnet2b")
    runs = MODELS.parent / "runs" / "airplane"
    configs = list(runs.glob("splatfacto/*/config.yml"))
    if not configs:
        pytest.skip(f"{runs} is not there")
    job = open_job(Settings(configs[0], runs / "camera_path_orbit.json"))
    frame, network, run = job.frame(0), load_network(file), session(file)
    whole, tiles = job.pose_sets[0].box, np.arange(frame.tile_count)
    rows = np.concatenate([np.eye(10), -np.eye(10), np.eye(10)[:1] - np.eye(10)[1:]])
    rng, certified = np.random.default_rng(0), 0
    for azimuth in rng.uniform(0.1, 6.1, 6):
        box = ParameterBox(whole.names, whole.units, (azimuth - width / 2,), (azimuth + width / 2,))
        cell = frame.bounds.cell(frame.camera, frame.pose_set.enclosure(box, frame.order), tiles, None, True)
        assert cell.linear is not None
        a_lower, b_lower, a_upper, b_upper = (
            v.astype(np.float64) for v in linear_sets(cell.linear, cell.lower, cell.upper, 1)
        )
        # normalised, with room for its rounding
        scale, shift, room = STD[:, None], MEAN, 1e-5
        images = ImageSets(
            channels_first(a_lower / scale),
            channels_first((b_lower - shift) / STD) - room,
            channels_first(a_upper / scale),
            channels_first((b_upper - shift) / STD) + room,
            channels_first((cell.lower - shift) / STD) - room,
            channels_first((cell.upper - shift) / STD) + room,
        )
        found = bound_outputs(network, images, rows, np.zeros(len(rows)))
        p = np.concatenate([[-1.0, 0.0, 1.0], rng.uniform(-1, 1, 9)])
        pictures = np.concatenate([channels_first((frame.render(box.at(q[None])) - shift) / STD) for q in p])
        y = run(pictures.astype(np.float32).reshape(-1, 3, 32, 32)).astype(np.float64) @ rows.T
        assert (found.lower[0] <= y).all()
        assert (found.a[0, :, 0] * p[:, None] + found.b[0] <= y).all()
        certified += bool((found.lower[0, 20:] > 0.0).all())
        assert (found.lower[0, 20:] > 0.0).all() or y[:, 20:].min() < 0.4
    assert certified >= 4
