"""A loop for the airfield: an approach along the runway, flown by a small network that looks at 8 x 8 pixels.

The network estimates how far the camera is off the centreline and off the glide path. It has one hidden layer of ReLUs
on fixed random combinations of the pictures' principal components, and its last layer is a ridge regression on renders,
so that it is made in seconds and always the same.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ns_abstract.geometry.views import look_at
from ns_abstract.io.atomic import write_atomic

Float64 = NDArray[np.float64]

SIZE = 8
FOV = 60.0
#: Start of the approach and its end, units along the runway; height of the glide path at the start, and its slope.
_START, _END, _HEIGHT, _SLOPE = -1.0, -0.5, 0.08, 0.1
_DT, _SPEED, _STEPS = 0.1, 0.25, 20
#: The control: its gain, and at most, units a second.
_GAIN, _MOST = 2.0, 0.15
_HIDDEN, _COMPONENTS, _RIDGE, _PICTURES = 24, 8, 1e-3, 500


def rotation() -> Float64:
    """[4, 4] camera to world at the origin: along the runway, a little down."""
    return look_at((0.0, 0.0, 0.0), (1.0, 0.0, -_SLOPE))


def off_path(position: Float64) -> Float64:
    """[n, 2] distance from the centreline and from the glide path of positions [n, 3]."""
    height = _HEIGHT - _SLOPE * (position[:, 0] - _START)
    return np.stack([position[:, 1], position[:, 2] - height], axis=1)


def samples(count: int = _PICTURES, seed: int = 0) -> Float64:
    """[count, 3] positions about the approach to learn from."""
    low, high = np.array([_START - 0.05, -0.09, -0.07]), np.array([_END + 0.05, 0.09, 0.07])
    found = np.random.default_rng(seed).uniform(low, high, (count, 3))
    found[:, 2] += _HEIGHT - _SLOPE * (found[:, 0] - _START)
    return found


def fit(images: Float64, targets: Float64, seed: int = 0) -> list[Float64]:
    """Weights and biases of the hidden layer [h, n], [h] and of the last one [o, h], [o].

    Args:
        images: [count, n].
        targets: [count, o].
        seed: Of the hidden layer.
    """
    rng = np.random.default_rng(seed)
    mean = images.mean(axis=0)
    _, scales, axes = np.linalg.svd(images - mean, full_matrices=False)
    # signs of singular vectors are the library's choice
    axes = axes[:_COMPONENTS] * np.sign(axes[:_COMPONENTS].sum(axis=1, keepdims=True))
    spread = scales[0] / np.sqrt(len(images))
    hidden = rng.standard_normal((_HIDDEN, len(axes))) @ axes / spread
    bias = rng.standard_normal(_HIDDEN) - hidden @ mean
    features = np.maximum(images @ hidden.T + bias, 0.0)
    known = np.concatenate([features, np.ones((len(images), 1))], axis=1)
    normal = known.T @ known + _RIDGE * len(images) * np.eye(_HIDDEN + 1)
    last = np.linalg.solve(normal, known.T @ targets).T
    return [hidden, bias, last[:, :-1], last[:, -1]]


def write_network(file: Path, weights: list[Float64], size: int = SIZE) -> None:
    """Write the layers of `fit` as an .onnx file of pictures [1, 3, size, size]."""
    from onnx import TensorProto, helper, numpy_helper

    names = "hidden", "hidden_bias", "last", "last_bias"
    constants = [
        numpy_helper.from_array(np.ascontiguousarray(w, np.float32), n) for n, w in zip(names, weights, strict=True)
    ]
    nodes = [
        helper.make_node("Flatten", ["image"], ["flat"], axis=1),
        helper.make_node("Gemm", ["flat", "hidden", "hidden_bias"], ["sum"], transB=1),
        helper.make_node("Relu", ["sum"], ["features"]),
        helper.make_node("Gemm", ["features", "last", "last_bias"], ["estimate"], transB=1),
    ]
    graph = helper.make_graph(
        nodes,
        "estimator",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, size, size])],
        [helper.make_tensor_value_info("estimate", TensorProto.FLOAT, [1, len(weights[3])])],
        constants,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    write_atomic(file, lambda stream: stream.write(model.SerializeToString()))


def approach_loop(network: str = "estimator.onnx") -> dict[str, Any]:
    """Content of LOOP.json: 3 states (along, across, up), 20 steps, a box of initial states and a touchdown zone."""
    end = _HEIGHT - _SLOPE * (_END - _START)
    return {
        "version": 1,
        "state": ["along", "across", "up"],
        "units": ["units", "units", "units"],
        "initial": {"along": [_START, _START + 0.04], "across": [-0.04, 0.04], "up": [_HEIGHT - 0.03, _HEIGHT + 0.03]},
        "steps": _STEPS,
        "sampling_time": _DT,
        "dynamics": {
            "type": "affine",
            "A": np.eye(3).tolist(),
            "B": [[0.0, 0.0], [_DT, 0.0], [0.0, _DT]],
            "c": [_DT * _SPEED, 0.0, -_DT * _SPEED * _SLOPE],
        },
        "disturbance": {"across": 0.0002, "up": 0.0002},
        "camera": {
            "camera_to_world": rotation().tolist(),
            "fov": FOV,
            "position": {"offset": [0.0, 0.0, 0.0], "matrix": np.eye(3).tolist()},
        },
        "network": network,
        "preprocess": {"resize": [SIZE, SIZE]},
        "control": {
            "gain": [[-_GAIN, 0.0], [0.0, -_GAIN]],
            "goal": [0.0, 0.0],
            "clip": [[-_MOST, _MOST], [-_MOST, _MOST]],
        },
        "unsafe": [
            {"box": {"up": [None, -0.02]}},
            {"half_space": {"normal": [0.0, 1.0, 0.0], "at_least": 0.07}},
            {"half_space": {"normal": [0.0, -1.0, 0.0], "at_least": 0.07}},
        ],
        "goal": {"box": {"across": [-0.025, 0.025], "up": [end - 0.025, end + 0.03]}, "when": "end"},
    }


def write_approach(folder: Path, render: Callable[[Float64], NDArray[np.float32]]) -> tuple[Path, Path]:
    """Render, fit and write ``estimator.onnx`` and ``LOOP.json``.

    Args:
        folder: Where; made if missing.
        render: Position [3] to the picture [SIZE, SIZE, 3] of the camera there, with `rotation` and `FOV`.

    Returns:
        LOOP.json and the network.
    """
    folder.mkdir(parents=True, exist_ok=True)
    places = samples()
    # as the network's input lies: channels first
    images = np.stack([np.moveaxis(render(place), -1, 0).reshape(-1) for place in places]).astype(np.float64)
    network, loop = folder / "estimator.onnx", folder / "LOOP.json"
    write_network(network, fit(images, off_path(places)))
    text = json.dumps(approach_loop(network.name), indent=1) + "\n"
    write_atomic(loop, lambda stream: stream.write(text.encode()))
    return loop, network
