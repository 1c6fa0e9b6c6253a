"""A loop for the gate: a drone flies towards it, steered by a small network that looks at 8 x 8 pixels.

The network estimates how far the camera is beside and above the gate's axis. Its hidden layer holds two linear
estimates, ridge regressions on renders, cut by ReLUs at a few places; its last layer is a ridge regression on these. So
it is made in seconds, is always the same, and its weights stay small: what bounds of pictures leave open is multiplied
by them.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ns_abstract.geometry.keyframe_cameras import look_at
from ns_abstract.io.atomic import write_atomic, write_json

Float64 = NDArray[np.float64]

SIZE = 8
FOV = 60.0
#: Largest offsets at the start; length of the box of starts along the course.
_ACROSS, _UP, _ALONG = 0.45, 0.3, 0.06
_DT, _SPEED, _STEPS = 0.1, 0.35, 24
#: The control: its gain, 1/s, and at most, units a second; time in which velocity follows, s.
_GAIN, _MOST, _LAG = 1.2, 0.25, 0.3
#: Half-width of the funnel that is not to be left, and by how much it narrows by unit; half-width of the goal.
_MOUTH, _FUNNEL, _NEAR = 0.44, 0.35, 0.06
#: Regressions: their ridges, places of the ReLUs, and pictures.
_RIDGE, _LAST_RIDGE, _KNOT, _PICTURES = 1e-3, 1e-5, 0.15, 600


def rotation() -> Float64:
    """[4, 4] camera to world at the origin: along the course."""
    return look_at((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))


def samples(count: int = _PICTURES, seed: int = 0) -> Float64:
    """[count, 3] positions about the approach to learn from; fewer are far off the axis late in the course."""
    rng = np.random.default_rng(seed)
    end = _ALONG + _DT * _SPEED * _STEPS
    along = rng.uniform(0.0, end, count)
    room = 1.1 - 0.5 * along / end
    return np.stack([along, *(room * rng.uniform(-most, most, count) for most in (_ACROSS, _UP))], axis=1)


def _ridge(features: Float64, targets: Float64, ridge: float) -> tuple[Float64, Float64]:
    """Weights [o, n] and biases [o] of a regression that leaves the means alone."""
    middle, level = features.mean(axis=0), targets.mean(axis=0)
    away = features - middle
    normal = away.T @ away + ridge * len(away) * np.eye(away.shape[1])
    weights = np.linalg.solve(normal, away.T @ (targets - level)).T
    return weights, level - weights @ middle


def fit(images: Float64, targets: Float64) -> list[Float64]:
    """Weights and biases of the hidden layer [h, n], [h] and of the last one [o, h], [o].

    Args:
        images: [count, n].
        targets: [count, o].
    """
    weights, bias = _ridge(images, targets, _RIDGE)
    # the first is always open
    signs, places = [1.0, 1.0, -1.0], [1.0, -_KNOT, -_KNOT]
    hidden = np.concatenate([sign * weights for sign in signs])
    hidden_bias = np.concatenate([sign * bias + place for sign, place in zip(signs, places, strict=True)])
    last, last_bias = _ridge(np.maximum(images @ hidden.T + hidden_bias, 0.0), targets, _LAST_RIDGE)
    return [hidden, hidden_bias, last, last_bias]


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
    """Content of LOOP.json: position and two velocities, a box of starts in three dimensions, a funnel."""
    a, b = np.eye(5), np.zeros((5, 2))
    for k in range(2):
        a[1 + k, 3 + k] = _DT
        a[3 + k, 3 + k] -= _DT / _LAG
        b[3 + k, k] = _DT / _LAG
    names = ["along", "across", "up", "v_across", "v_up"]
    return {
        "version": 1,
        "state": names,
        "units": ["units", "units", "units", "units/s", "units/s"],
        "initial": {
            "along": [0.0, _ALONG], "across": [-_ACROSS, _ACROSS], "up": [-_UP, _UP], "v_across": 0.0, "v_up": 0.0,
        },
        "steps": _STEPS,
        "sampling_time": _DT,
        "dynamics": {"type": "affine", "A": a.tolist(), "B": b.tolist(), "c": [_DT * _SPEED, 0.0, 0.0, 0.0, 0.0]},
        "disturbance": {"v_across": 0.002, "v_up": 0.002},
        "camera": {
            "camera_to_world": rotation().tolist(),
            "fov": FOV,
            "position": {"offset": [0.0, 0.0, 0.0], "matrix": np.eye(3, 5).tolist()},
        },
        "network": network,
        "preprocess": {"resize": [SIZE, SIZE]},
        "control": {
            "gain": [[-_GAIN, 0.0], [0.0, -_GAIN]],
            "goal": [0.0, 0.0],
            "clip": [[-_MOST, _MOST], [-_MOST, _MOST]],
        },
        "unsafe": [
            {"half_space": {"normal": [_FUNNEL, *side, 0.0, 0.0], "at_least": _MOUTH}}
            for side in ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))
        ],
        "goal": {"box": {"across": [-_NEAR, _NEAR], "up": [-_NEAR, _NEAR]}, "when": "end"},
    }  # fmt: skip


def write_approach(folder: Path, render: Callable[[Float64], NDArray[np.float32]]) -> Path:
    """Render, fit and write ``estimator.onnx`` and ``LOOP.json``; returns the latter.

    Args:
        folder: Where; made if missing.
        render: Position [3] to the picture [SIZE, SIZE, 3] of the camera there, with `rotation` and `FOV`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    places = samples()
    # as the network's input lies: channels first
    images = np.stack([np.moveaxis(render(place), -1, 0).reshape(-1) for place in places]).astype(np.float64)
    network, loop = folder / "estimator.onnx", folder / "LOOP.json"
    write_network(network, fit(images, places[:, 1:]))
    return write_json(loop, approach_loop(network.name))
