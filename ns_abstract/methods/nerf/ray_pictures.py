"""What frames and methods of both kinds of field share: pictures that are made ray by ray."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.poses import COLOR_SHIFTS, PoseBox
from ns_abstract.geometry.tiles import tile_grid
from ns_abstract.io.errors import InputError
from ns_abstract.methods.nerf.hsv import color_shift
from ns_abstract.methods.nerf.render import RayRenderer
from ns_abstract.methods.nerf.scene import FieldScene
from ns_abstract.perturbation.specification import Perturbation
from ns_abstract.refine.protocol import Frame, SceneSample

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True)
class MotionTuning:
    """How motion of pictures is told. None of them decides whether a bound holds."""

    #: Step of the difference quotient that tells how far the picture moves, as a part of the parameter's range.
    step: float = 2.0**-10
    #: Pixels that a turn of the whole circle of hues counts for.
    shift: float = 6.0


_MOTION_STEP, _SHIFT_MOTION = MotionTuning.step, MotionTuning.shift


class RayPictures:
    """Renders one frame's set of poses. Every ray is a tile of its own."""

    #: Every ray is work of its own.
    tilewise = True
    channels = 3
    #: Poses rendered in every part of a cell that is split.
    witnesses = 8
    #: Few kernels, which are compiled together.
    stages: tuple[str, ...] = ()
    #: A distance that is typical of what a ray meets, normalised units; subclasses set it.
    typical_distance: float

    def __init__(self, pose_set: PoseBox, renderer: RayRenderer) -> None:
        self.pose_set, self.camera, self.box = pose_set, pose_set.camera, pose_set.box
        self.side = 1
        self.across, self.down = tile_grid(self.camera, 1)
        self.renderer = renderer

    @property
    def tile_count(self) -> int:
        """Number of rays, row by row."""
        return self.across * self.down

    def scene_samples(self, seed: int) -> Iterator[SceneSample]:
        """Other scenes of the set: none, only poses vary."""
        return iter(())

    def _pixels(self, tiles: np.ndarray) -> np.ndarray:
        return np.stack([tiles // self.across, tiles % self.across], axis=1)

    def render(self, values: np.ndarray, tiles: np.ndarray | None = None) -> np.ndarray:
        """Rays [t, 1, 1, 3] float32 of the concrete image at parameter values [d]."""
        return self.precise(values, tiles).astype(np.float32)

    def precise(self, values: np.ndarray, tiles: np.ndarray | None = None) -> np.ndarray:
        """What `render` rounds: float64."""
        which = np.arange(self.tile_count) if tiles is None else tiles
        shift = color_shift(self.pose_set, values)
        colors = self.renderer.pixels(self.pose_set.camera, self.pose_set.pose(values), self._pixels(which), shift)
        return colors[:, None, None, :]

    def feasible(self, box: ParameterBox) -> ParameterBox | None:
        """All of ``box``: every parameter in it belongs to a pose of the set."""
        return box

    def depths(self) -> None:
        """A field is everywhere; nothing in it has a distance of its own."""

    def motion(self, box: ParameterBox) -> np.ndarray:
        """[d] pixels that points at a typical distance move by over each parameter's range (an estimate)."""
        d = box.dimensions
        low, high = np.array(box.lower), np.array(box.upper)
        distance = self.typical_distance
        largest = np.zeros(d)
        here = self._point(box.middle, distance)
        for k in range(d):
            step = np.zeros(d)
            step[k] = _MOTION_STEP * (high[k] - low[k])
            moved = np.linalg.norm(self._point(box.middle + step, distance) - here) / _MOTION_STEP
            largest[k] = moved / distance * self.camera.fx
            if box.names[k] in COLOR_SHIFTS:
                largest[k] = _SHIFT_MOTION * (high[k] - low[k])
        return largest

    def _point(self, values: np.ndarray, distance: float) -> np.ndarray:
        pose = self.pose_set.pose(values)
        return pose[:, 3] - distance * pose[:, 2]


class FieldMethod:
    """What `ns_abstract.refine.protocol.Method` says of any field."""

    #: What bounds of this program are called.
    guarantee = "real-sound"

    def __init__(self, scene: FieldScene) -> None:
        self._named = scene

    @property
    def name(self) -> str:
        """The scene's name."""
        return self._named.name

    @property
    def notes(self) -> tuple[str, ...]:
        """What was assumed on reading the scene."""
        return self._named.notes

    @property
    def dataset_scale(self) -> float:
        """Normalised units per unit of the data set."""
        return self._named.dataparser.scale

    def attribution(self, frame: Frame, box: ParameterBox, tile: int, count: int) -> list[tuple[int, float]]:
        """A field has no elements."""
        return []

    def elements(self) -> None:
        """A field has none."""

    def ablations(self, poses: PoseBox) -> Iterator[tuple[str, Frame]]:
        """None are known."""
        return iter(())

    def prepare(self, perturbations: Sequence[Perturbation]) -> None:
        """Refuse what needs Gaussians. Raises InputError where a set varies the scene."""
        if any(perturbation.scene for perturbation in perturbations):
            raise InputError("a NeRF has no Gaussians", field="scene", fix="leave the key out")


def check_arithmetic(arithmetic: str | None) -> None:
    """Raise InputError where bounds of float32 are asked for."""
    if arithmetic not in (None, "real"):
        raise InputError(
            "float32 evaluations of a NeRF's networks cannot be enclosed tightly", field="--arithmetic", fix="use real"
        )


def refuse_layers(layers: bool) -> None:
    """Raise InputError where depth or accumulation are asked for: a NeRF's depth is a median."""
    if layers:
        raise InputError("depth and accumulation of a NeRF are not bounded", field="--outputs", fix="leave it out")


def arrays_digest(arrays: Iterable[np.ndarray]) -> hashlib._Hash:
    """SHA-256 of the arrays' shapes and contents, one after another."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(repr(array.shape).encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest


def picture_of_parameters(
    poses: PoseBox, picture: Callable[[PinholeCamera, torch.Tensor, Any], torch.Tensor]
) -> Callable[[torch.Tensor], torch.Tensor]:
    """Parameter values [d] to the picture [H, W, 3]; ``picture`` draws that of a camera, a pose and a colour shift."""
    from ns_abstract.geometry.differentiable_pose import differentiable_pose

    pose, camera = differentiable_pose(poses.geometry), poses.camera
    count = poses.geometry.box.dimensions
    return lambda values: picture(camera, pose(values[:count]), color_shift(poses, values.unbind()))
