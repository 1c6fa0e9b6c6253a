"""A scene that stands elsewhere as a whole: sets, bounds of a network, scene samples, on pictures with a formula."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from onnx_files import OnnxFile
from waves import Waves

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.verify.model import NetworkModel
from ns_abstract.verify.network import load_network
from ns_abstract.verify.preprocess import Preprocess
from ns_abstract.verify.properties import Query
from ns_abstract.verify.registration import RegisteredImages, RegisteredModel

SIDE = 2


class Wall(Waves):
    """Pictures of d parameters and three of the scene's place."""

    def __init__(self, d: int, radius: float) -> None:
        self.box = ParameterBox(
            (*"abcde"[:d], "sx", "sy", "sz"),
            ("",) * (d + 3),
            (0.1,) * d + (-radius,) * 3,
            (0.2,) * d + (radius,) * 3,
        )
        super().__init__((SIDE, SIDE), d + 3)

    def render(self, values: np.ndarray, tiles: Any = None) -> np.ndarray:
        return self.image(values)

    def differentiable(self, values: torch.Tensor) -> torch.Tensor:
        return 0.5 + 0.3 * torch.from_numpy(self.slopes) @ torch.sin(values)


@pytest.mark.parametrize("d", [0, 1, 2])
def test_bounds_hold_for_every_place_of_the_scene(tmp_path: Path, d: int) -> None:
    """Planes in the poses' parameters and constants, below outputs of pictures from all places, without a tolerance."""
    f = OnnxFile((3, SIDE, SIDE))
    f.node("Flatten")
    f.gemm(12, 8)
    f.node("Relu")
    f.gemm(8, 3)
    wall = Wall(d, 0.1)
    scene: Any = RegisteredImages(wall, wall)  # type: ignore[arg-type]
    plain = NetworkModel(load_network(f.write(tmp_path / "net.onnx")), Preprocess(), 1 << 28)
    model = RegisteredModel(plain)
    assert scene.box.dimensions == d
    box, rng = scene.box, np.random.default_rng(1)
    linear, lower, upper, slopes = scene.linear_sets(box)
    assert slopes.shape == (d,)
    rows = np.concatenate([np.eye(3), -np.eye(3)])
    images = model.input_sets(tuple(part[None] for part in linear), lower[None], upper[None])
    found = model.bound(images, Query(rows, np.zeros(6)))
    assert found.a.shape == (1, 6, d) and np.isfinite(found.b).all()
    nearest, reached = np.inf, 0.0
    for scene_sample in itertools.islice(scene.scene_samples(2), 300):
        p = rng.choice([-1.0, 1.0], d) if rng.random() < 0.5 else rng.uniform(-1.0, 1.0, d)
        outputs = model.outputs(scene.image(box.at(p), scene_sample)[None])[0].astype(np.float64)
        room = rows @ outputs - (found.a[0] @ p + found.b[0])
        assert (room >= 0.0).all() and (rows @ outputs >= found.lower[0]).all()
        nearest, reached = min(nearest, float(room.min())), max(reached, float(np.abs(scene_sample.offset).max()))
    # and are reached, but for what curves
    assert nearest < 0.01 and reached == 0.1


def test_steps_go_uphill_and_stay_in_the_set() -> None:
    wall = Wall(2, 0.1)
    scene: Any = RegisteredImages(wall, wall)  # type: ignore[arg-type]
    values, scene_sample = scene.box.middle, next(scene.scene_samples(0)).nearest
    assert (scene_sample.offset == 0.0).all() and (scene.image(values) == scene.image(values, scene_sample)).all()

    def score(picture: torch.Tensor, pose: torch.Tensor) -> torch.Tensor:
        return picture.sum()

    moved, other = scene_sample.signed_gradient_step(scene.box, values, score, 2.0)
    assert scene.box.contains(moved) and (np.abs(other.offset) == 0.1).all()
    assert other(moved).sum() > scene.image(values).sum()
    assert float(scene.image(moved, other).sum()) >= max(
        float(scene.image(pose, m).sum())
        for m in itertools.islice(scene.scene_samples(0), 8)
        for pose in scene.box.corners()
    )
    assert (other.arrays["place"] == other.offset).all()
