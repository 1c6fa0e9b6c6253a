"""Pictures of a scene with uncertain registration: the whole scene may be shifted (docs/dev/design.md, V13, P3).

The scene's position adds three parameters, which sets of pictures and bounds keep until the outputs.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import torch

from ns_abstract.arithmetic.network_charges import OWN_LINE
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.refine.protocol import Frame, SceneSample, Score
from ns_abstract.verify.network import ImageSets, OutputBounds
from ns_abstract.verify.properties import Query
from ns_abstract.verify.protocol import FrameImages, Model

#: Parameters of where a scene stands.
PLACE = 3


class RegisteredImages:
    """Pictures at every pose and position of the scene in a set of `PoseBox.registered`; see `FrameImages`."""

    def __init__(self, scene: FrameImages, frame: Frame) -> None:
        self.scene, self.frame = scene, frame
        box = scene.box
        self.box = box.without(box.names[-PLACE:])
        #: [3] how far each may be off
        self.reach = np.array(box.upper[-PLACE:])

    def image(self, values: np.ndarray, scene_sample: SceneSample | None = None) -> np.ndarray:
        assert scene_sample is None or isinstance(scene_sample, RegisteredSample)
        return self.scene.image(
            np.concatenate([values, np.zeros(PLACE) if scene_sample is None else scene_sample.offset])
        )

    def scene_samples(self, seed: int) -> Iterator[RegisteredSample]:
        """Yield positions of the scene without end, corners first."""
        for signs in itertools.product((-1.0, 1.0), repeat=PLACE):
            yield RegisteredSample(self, self.reach * signs)
        generator = np.random.default_rng(seed)
        while True:
            yield RegisteredSample(self, self.reach * generator.uniform(-1.0, 1.0, PLACE))

    def widened(self, box: ParameterBox) -> ParameterBox:
        """Return a box of poses extended by all positions of the scene."""
        whole = self.scene.box
        lower, upper = (*box.lower, *whole.lower[-PLACE:]), (*box.upper, *whole.upper[-PLACE:])
        return ParameterBox(whole.names, whole.units, lower, upper)

    def linear_sets(self, box: ParameterBox) -> tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray, np.ndarray]:
        """Return linear sets like a scene's, with the three `PLACE` parameters added."""
        linear, lower, upper, slopes = self.scene.linear_sets(self.widened(box))
        return linear, lower, upper, slopes[:-PLACE]

    def differentiable(self, values: torch.Tensor) -> torch.Tensor:
        return self.scene.differentiable(torch.cat([values, torch.zeros(PLACE, dtype=values.dtype)]))


@dataclass(frozen=True)
class RegisteredSample:
    """One position [3] of the scene; see `ns_abstract.refine.protocol.SceneSample`."""

    scene: RegisteredImages = field(repr=False)
    offset: np.ndarray

    def __call__(self, values: np.ndarray, tiles: np.ndarray | None = None) -> np.ndarray:
        return self.scene.frame.render(np.concatenate([values, self.offset]), tiles)

    def signed_gradient_step(
        self, box: ParameterBox, values: np.ndarray, score: Score, size: float
    ) -> tuple[np.ndarray, RegisteredSample]:
        pose, offset = (torch.tensor(part, dtype=torch.float64, requires_grad=True) for part in (values, self.offset))
        gradient_source = score(self.scene.scene.differentiable(torch.cat([pose, offset])), pose)
        if gradient_source.requires_grad:
            gradient_source.backward()
        low, high, reach = np.array(box.lower), np.array(box.upper), self.scene.reach
        values = np.clip(values + 0.5 * size * _sign(pose) * (high - low), low, high)
        return values, RegisteredSample(self.scene, np.clip(self.offset + size * _sign(offset) * reach, -reach, reach))

    @property
    def nearest(self) -> RegisteredSample:
        return RegisteredSample(self.scene, np.zeros(PLACE))

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """Return the offset of the scene as a whole, by name."""
        return {"place": self.offset}


def _sign(leaf: torch.Tensor) -> np.ndarray:
    """Return the signs of the gradient; 0 where there is no gradient."""
    return np.zeros(len(leaf)) if leaf.grad is None else np.sign(np.nan_to_num(leaf.grad.numpy()))


class RegisteredModel:
    """A network whose input is such pictures; see `ns_abstract.verify.protocol.Model`."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.outputs, self.differentiable, self.input_sets = model.outputs, model.differentiable, model.input_sets
        # what holds for all parameters holds for all places
        self.branch = model.branch

    def bound(self, images: ImageSets, query: Query) -> OutputBounds:
        """Return bounds in the poses' parameters, over all positions of the scene."""
        output_bounds = self.model.bound(images, query)
        image_dimensions = images.dimensions - PLACE
        lost = np.abs(output_bounds.a[..., image_dimensions:]).sum(axis=-1)
        with np.errstate(invalid="ignore"):
            b = output_bounds.b - lost - OWN_LINE * (np.abs(output_bounds.b) + lost)
        return OutputBounds(output_bounds.lower, output_bounds.a[..., :image_dimensions], b)
