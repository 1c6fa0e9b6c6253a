"""Properties of the picture itself, as the search for certificates asks them: pictures with further planes.

The planes behind a picture's colours are blending weights of chosen scene elements and expected depths; what no
measure reads is not bounded.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, cast

import numpy as np
import torch

from ns_abstract.api.assumptions import choice
from ns_abstract.api.files import resized
from ns_abstract.api.frame_pictures import FramePictures, PropertySource
from ns_abstract.api.job import Job
from ns_abstract.api.nearby_pictures import KnownBoxes, place_sets
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.geometry.tiles import assemble, in_tiles
from ns_abstract.io.assumptions import Assumption
from ns_abstract.io.digests import recorded
from ns_abstract.io.errors import InputError
from ns_abstract.refine.protocol import (
    COLORS,
    DEPTH,
    MOST_PLANES,
    Bounds,
    ElementFrame,
    Frame,
    Method,
    RayFrame,
    SceneSample,
    Score,
    WeightFrame,
    WeightMethod,
    WeightPlane,
)
from ns_abstract.report.picture import planes_picture
from ns_abstract.verify.eight_bit import Picture
from ns_abstract.verify.network import NetworkArithmetic
from ns_abstract.verify.picture_properties import FARTHEST, MeasureModel, PictureProperty, parse_picture_property
from ns_abstract.verify.protocol import FrameImages
from ns_abstract.verify.settled_pixels import LimitedMeasure, unsettled

#: Rays that are bounded before it is asked whether these say enough.
_FEW_RAYS = 8


@dataclass(frozen=True)
class PlaneSample:
    """A scene of a set, for pictures with planes; see `ns_abstract.refine.protocol.SceneSample`.

    Attributes:
        base: The scene, of the coloured frame.
        steps: Whether the score is one of colours alone, so that its gradient is that of the coloured picture.
    """

    base: SceneSample
    steps: bool

    def __call__(self, values: np.ndarray, tiles: np.ndarray | None = None) -> np.ndarray:
        return self.base(values, tiles)

    def signed_gradient_step(
        self, box: ParameterBox, values: np.ndarray, score: Score, size: float
    ) -> tuple[np.ndarray, PlaneSample]:
        """Return values and a scene one signed gradient step on; weights and depths have no gradient and stay."""
        if not self.steps:
            return values, self
        values, moved = self.base.signed_gradient_step(box, values, score, size)
        return values, PlaneSample(moved, True)

    @property
    def nearest(self) -> PlaneSample:
        return PlaneSample(self.base.nearest, self.steps)

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        return self.base.arrays


class PlanePictures(FramePictures):
    """One frame's pictures [H, W, C]: colours, then the further planes of a property, in its order.

    Raises:
        InputError: A selection picks nothing, or the scene has no such planes.
    """

    def __init__(self, method: Method, poses: PoseBox, prop: PictureProperty) -> None:
        self._property, self._read = prop, prop.planes
        super().__init__(method, poses)
        height, width = poses.camera.height, poses.camera.width
        #: [H, W] the pixels that some measure reads
        self.wanted = np.zeros(height * width, bool)
        for measure in prop.measures(height, width):
            self.wanted[measure.pixels] = True
            if measure.minus is not None:
                self.wanted[measure.minus] = True
        self.wanted = self.wanted.reshape(height, width)
        weights = [(k, plane) for k, plane in enumerate(self._planes) if isinstance(plane, WeightPlane)]
        #: Frames of weights, with the channels that their planes have here.
        self.weights: list[tuple[WeightFrame, list[int]]] = []
        for first in range(0, len(weights), MOST_PLANES):
            some = weights[first : first + MOST_PLANES]
            if not isinstance(method, WeightMethod):
                raise InputError(
                    f"blending weights of {method.content} are not bounded", field="type", fix="use picture"
                )
            frame = method.weight_frame(poses, [plane for _, plane in some], self.wanted)
            self.weights.append((frame, [COLORS + k for k, _ in some]))
        self._depth = COLORS + self._planes.index("depth") if "depth" in self._planes else None

    @property
    def _planes(self) -> list[Any]:
        return [plane for plane in self._read if plane != "colors"]

    @cached_property
    def _dark(self) -> bool:
        """Whether the search leaves colours out of images: they cost as much as weights, and are not read.

        Of other scenes of a set colours are kept, which nobody could render later.
        """
        weights = all(isinstance(plane, WeightPlane) for plane in self._read)
        return weights and next(iter(self.frame.scene_samples(0)), None) is None

    @property
    def _few_rays(self) -> bool:
        """Whether a few rays may say enough: nothing else is read."""
        return self._dark and len(self.weights) == 1 and self.weights[0][0].tilewise

    @property
    def effort(self) -> tuple[Frame, int]:
        if "colors" in self._read:
            return super().effort
        rays = int(self.wanted.sum())
        return self.weights[0][0], min(_FEW_RAYS, rays) if self._few_rays else rays

    def _frame(self, method: Method, poses: PoseBox, sheared: bool) -> Frame:
        try:
            return method.frame(poses, sheared, "depth" in self._read)
        except InputError as error:
            raise InputError(error.problem, field="measure", fix="measure weights") from None

    @property
    def channels(self) -> int:
        """Number of channels C."""
        return COLORS + len(self._planes)

    def image(self, values: np.ndarray, scene_sample: SceneSample | None = None) -> np.ndarray:
        """Return the concrete picture [H, W, C] float32; see `ns_abstract.verify.protocol.FrameImages`."""
        values = np.asarray(values, np.float64)
        base = scene_sample.base if isinstance(scene_sample, PlaneSample) else scene_sample
        image = np.zeros((*self.wanted.shape, self.channels), np.float32)
        whole = None if self._dark else super().image(values, base)
        if whole is not None:
            image[..., :COLORS] = whole[..., :COLORS]
        for frame, channels in self.weights:
            tiles = frame.of_sample(values, base)
            image[..., channels] = assemble(tiles, frame.camera)[..., : len(channels)]
        if self._depth is not None:
            assert whole is not None
            depth = whole[..., DEPTH]
            image[..., self._depth] = np.where(np.isnan(depth), FARTHEST, np.minimum(depth, FARTHEST))
        return image

    def scene_samples(self, seed: int) -> Iterator[PlaneSample]:
        steps = self._read == ("colors",)
        return (PlaneSample(sample, steps) for sample in self.frame.scene_samples(seed))

    def linear_sets(self, box: ParameterBox) -> tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray, np.ndarray]:
        """Sets of the planes [H, W, C]; pixels and channels that no measure reads have none: all zeros.

        Of rays only as many are bounded as decide what is claimed (Q6).
        """
        shape, d = (*self.wanted.shape, self.channels), box.dimensions
        linear = tuple(np.zeros((*shape, d) if k % 2 == 0 else shape, np.float32) for k in range(4))
        lower, upper, slopes = np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros(d)
        if "colors" in self._read or self._depth is not None:
            bounds, tiles = self._bounded(self.frame, box, [0, 1, 2])
            slopes = slopes + bounds.slopes
            if "colors" in self._read:
                place_sets((*linear, lower, upper), bounds, self.frame, tiles, range(COLORS))
            if self._depth is not None:
                whole = np.zeros((self.frame.tile_count, *bounds.lower.shape[1:]), np.float32)
                ends = []
                for side in (bounds.lower, bounds.upper):
                    whole[tiles] = side
                    ends.append(assemble(whole, self.frame.camera))
                low, high = depth_range(ends[0], ends[1])
                low, high = np.where(self.wanted, low, 0.0), np.where(self.wanted, high, 0.0)
                for side, value in ((lower, low), (linear[1], low), (upper, high), (linear[3], high)):
                    side[..., self._depth] = value
        rays = int(self.wanted.sum())
        for frame, channels in self.weights:
            most = _FEW_RAYS if self._few_rays else rays
            while True:
                bounds, tiles = self._bounded(frame, box, channels, most if most < rays else None)
                place_sets((*linear, lower, upper), bounds, frame, tiles, channels)
                if most >= rays or not unsettled(self._limited, lower, upper).any():
                    break
                most *= 2
            slopes = slopes + bounds.slopes
        return linear, lower, upper, slopes

    def _bounded(
        self, frame: Frame, box: ParameterBox, channels: list[int], most_rays: int | None = None
    ) -> tuple[Bounds, np.ndarray]:
        """Return bounds of the tiles that hold `wanted` pixels, and these tiles' numbers.

        ``most_rays``: As of `RayFrame.cell_bounds`, where the frame is bounded ray by ray.
        """
        if frame.tilewise:

            def weigh() -> np.ndarray | None:
                weights = self.weigh(box)
                costs = np.zeros((*self.wanted.shape, COLORS))
                if weights is not None:
                    costs[..., : len(channels)] = weights[..., channels]
                return None if weights is None else costs

            return cast("RayFrame", frame).cell_bounds(box, weigh, most_rays), np.arange(frame.tile_count)
        pixels = in_tiles(self.wanted, frame.side)
        tiles = np.flatnonzero(pixels.any(axis=(1, 2)))
        return frame.bound_parts([box], tiles, None, True, pixels[tiles])[0], tiles

    @cached_property
    def _limited(self) -> tuple[LimitedMeasure, ...]:
        return self._property.limited(*self.wanted.shape)

    @cached_property
    def _boxes(self) -> KnownBoxes | None:
        """Cached bounds of boxes around cells; None unless only one scene's `ElementFrame` weights are read."""
        weights = [(frame, channels) for frame, channels in self.weights if isinstance(frame, ElementFrame)]
        if not self._dark or len(weights) < len(self.weights):
            return None
        return KnownBoxes(self, weights, self.wanted, self._limited)

    def near(self, cell: ParameterBox) -> FrameImages:
        """Return the pictures and sets for poses of ``cell``, cheaper by bounds of a box around it."""
        pictures = None if self._boxes is None else self._boxes.near(cell)
        return self if pictures is None else pictures

    def differentiable(self, values: torch.Tensor) -> torch.Tensor:
        """Return the picture [H, W, C] at parameter values [d]; depths have no slope."""
        planes: list[torch.Tensor] = [torch.zeros((*self.wanted.shape, 1), dtype=torch.float64)] * self.channels
        if "colors" in self._read:
            colors = super().differentiable(values)
            planes[:COLORS] = list(colors.split(1, dim=-1))
        for frame, channels in self.weights:
            for channel, plane in zip(channels, frame.differentiable(values).split(1, dim=-1), strict=False):
                planes[channel] = plane
        if self._depth is not None:
            image = self.image(values.detach().numpy())[..., self._depth, None]
            planes[self._depth] = torch.from_numpy(image.astype(np.float64))
        return torch.cat([plane.to(torch.float64) for plane in planes], dim=-1)

    def completed(self, image: np.ndarray, values: np.ndarray) -> np.ndarray:
        if not self._dark:
            return image
        return np.concatenate([super().image(values)[..., :COLORS], image[..., COLORS:]], axis=-1)

    def shown(self, image: np.ndarray, values: np.ndarray) -> np.ndarray:
        return planes_picture(self.completed(image, values), self.wanted, self._depth)


def depth_range(lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return bounds [H, W] of depths, where nothing drawn is `FARTHEST`, from those of accumulation and depth (Q4).

    Args:
        lower, upper: [H, W, 5] bounds of a frame with layers.
    """
    low, high = lower[..., DEPTH], upper[..., DEPTH]
    # bounds of what is drawn; infinity before its negative where nothing can be
    nothing = low == np.inf
    # where the accumulation may be 0, some pose may draw nothing
    maybe = ~(lower[..., DEPTH - 1] > 0.0)
    low = np.where(nothing, FARTHEST, np.minimum(low, FARTHEST))
    return low, np.where(nothing | maybe, FARTHEST, np.minimum(high, FARTHEST))


class PictureQuestion:
    """A property of the picture itself; see `ns_abstract.api.network_question.Question`, which has a network.

    Raises:
        InputError: A field cannot be used.
    """

    def __init__(self, source: PropertySource) -> None:
        self.source = source
        self._dataset_scale: float | None = 1.0
        self.property = self._parsed(1.0)

    def _parsed(self, dataset_scale: float | None) -> PictureProperty:
        try:
            with recorded(self.source.digests):
                return parse_picture_property(self.source.value, self.source.folder, dataset_scale)
        except InputError as error:
            raise self.source.within(error) from None

    def drawn(self, poses: PoseBox) -> PoseBox:
        """Return the set with pictures of the size that the property asks for; by default their own."""
        resize = self.property.preprocess.resize
        return poses if resize is None else resized(poses, *resize)

    def opened(self, job: Job) -> None:
        """Take the units of the scene's data set, and check the regions and selections against the frames.

        Raises:
            InputError: A region reaches beyond the pictures, or a selection picks nothing.
        """
        self._dataset_scale = job.method.dataset_scale
        self.property = self._parsed(self._dataset_scale)
        sizes = {(poses.camera.height, poses.camera.width) for poses in job.pose_sets}
        if len(sizes) > 1:
            raise self.source.within(
                InputError("the frames have pictures of different sizes", field="preprocess.resize", fix="write a size")
            )
        self._size = sizes.pop()
        try:
            self.property.measures(*self._size)
            PlanePictures(job.method, job.pose_sets[0], self.property)
        except InputError as error:
            raise (error if error.file is not None else self.source.within(error)) from None

    def searched(self, memory: int, arithmetic: NetworkArithmetic, picture: Picture) -> MeasureModel:
        """Return the property's measures as a model of the search.

        Raises:
            InputError: An option asks for another network or for what a network is shown.
        """
        if arithmetic != "float32":
            raise InputError("there is no network", field="--network-arithmetic", fix="leave it out")
        if picture != "float":
            raise InputError("is what a network is shown, and there is none", field="--picture", fix="leave it out")
        return self.property.model(*self._size)

    def pictures(self, method: Method, poses: PoseBox, picture: Picture) -> PlanePictures:
        """Return the pictures of a set, with the planes that the property reads."""
        return PlanePictures(method, poses, self.property)

    #: What the property is about, and what a measure costs beside a network; see `Question`.
    name, numbers = "the picture itself", 1
    #: Measures bear wider cells than networks do.
    motion = (0.6, 0.6)
    #: The search goes from frame to frame, and what is known of boxes around cells takes long to find again.
    frames = 8

    def guarantee(self, arithmetic: NetworkArithmetic) -> tuple[str, ...]:
        return ("no network: sums and order statistics of pixels, bounded with the rounding of their float64 sums",)

    def check_memory(self, dimensions: int, memory: float) -> None:
        """Nothing is refused: measures take no memory to speak of."""

    def describe(self) -> dict[str, Any]:
        return {"name": self.name}

    def fingerprint(self, arithmetic: NetworkArithmetic) -> dict[str, Any]:
        """Return the fingerprint besides the property: the length of a unit of the data set."""
        return {"model": None, "dataset_scale": self._dataset_scale}

    def choices(self, arithmetic: NetworkArithmetic, picture: Picture) -> tuple[Assumption, ...]:
        return (choice("network", "none: the property is one of the picture", None, "--model"),)

    def absolute(self) -> partial[PictureQuestion]:
        return partial(PictureQuestion, self.source.absolute())
