"""A third representation: an infinite wall painted with a wave, seen straight on by an orthographic camera.

The colour of a pixel at wall coordinates (u, v) is ``0.5 + 0.4 sin(a u + b v + phase)`` with (a, b, phase) by channel.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ns_abstract.arithmetic.outward import outward
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.io.assumptions import Assumption
from ns_abstract.io.errors import InputError
from ns_abstract.methods.overrides import Overrides
from ns_abstract.methods.representation import ProgramOptions, Representation
from ns_abstract.methods.runs import RunConfig
from ns_abstract.perturbation.specification import Perturbation
from ns_abstract.refine.protocol import LinearSets, Render

SIDE = 4
#: Wall units by pixel.
SCALE = 0.05
#: More than the roundings of sums and sines here.
ROUNDING = 1e-12
WAVES = ((3.0, 1.0, 0.0), (1.0, -2.0, 1.0), (-2.0, 0.5, 2.0))


@dataclass(frozen=True)
class Wall:
    name: str
    waves: np.ndarray
    #: parts of the bounds' width that are cut off: a planted fault
    fault: float = 0.0
    assumptions: tuple[Assumption, ...] = ()


@dataclass(frozen=True)
class WallBounds:
    lower: np.ndarray
    upper: np.ndarray
    slopes: np.ndarray
    linear: LinearSets | None
    context: None = None


class WallFrame:
    channels = 3
    tilewise = False
    tiles_at_once = None
    witnesses = 1
    stages = ()

    def __init__(self, wall: Wall, pose_set: PoseBox) -> None:
        self.wall, self.pose_set = wall, pose_set
        self.box, self.camera, self.side = pose_set.box, pose_set.camera, SIDE
        self.across, self.down = -(-self.camera.width // SIDE), -(-self.camera.height // SIDE)

    @property
    def tile_count(self) -> int:
        return self.across * self.down

    def warm_up(self, stage: str | None = None) -> None:
        pass

    def _pixels(self, tiles: np.ndarray | None) -> np.ndarray:
        """[t, side, side, 2] places on the wall, seen from the origin."""
        which = np.arange(self.tile_count) if tiles is None else tiles
        inner = np.arange(SIDE)
        column = which[:, None, None] % self.across * SIDE + inner[None, None, :]
        row = which[:, None, None] // self.across * SIDE + inner[None, :, None]
        return SCALE * np.stack(np.broadcast_arrays(column, -row), axis=-1)

    def _angles(self, place: Any, tiles: np.ndarray | None) -> np.ndarray:
        a, b, phase = self.wall.waves.T
        seen = self._pixels(tiles)[..., None, :] + np.asarray(place, np.float64)[:2]
        return seen[..., 0] * a + seen[..., 1] * b + phase

    def render(self, values: np.ndarray, tiles: np.ndarray | None = None) -> np.ndarray:
        return (0.5 + 0.4 * np.sin(self._angles(self.pose_set.pose(values)[:, 3], tiles))).astype(np.float32)

    def scene_samples(self, seed: int) -> Iterator[Render]:
        return iter(())

    def bound(self, box: ParameterBox, tiles: np.ndarray, within: Any = None, keep_linear: bool = False) -> WallBounds:
        ends = np.array([self.pose_set.pose(corner)[:2, 3] for corner in box.corners()] or [
            self.pose_set.pose(box.middle)[:2, 3]
        ])  # fmt: skip
        middle, half = 0.5 * (ends.min(axis=0) + ends.max(axis=0)), 0.5 * (ends.max(axis=0) - ends.min(axis=0))
        angle = self._angles(middle, tiles)
        reach = np.abs(self.wall.waves[:, :2]) @ half + ROUNDING
        low, high = angle - reach, angle + reach
        # extremes inside, else at the ends
        turn = 2.0 * np.pi
        top, bottom = (np.floor((high - e) / turn) >= np.ceil((low - e) / turn) for e in (0.5 * np.pi, -0.5 * np.pi))
        most = np.where(top, 1.0, np.maximum(np.sin(low), np.sin(high)))
        least = np.where(bottom, -1.0, np.minimum(np.sin(low), np.sin(high)))
        cut = self.wall.fault * (most - least)
        lower, upper = outward(0.5 + 0.4 * (least + cut) - ROUNDING, 0.5 + 0.4 * (most - cut) + ROUNDING)
        flat = np.zeros((*lower.shape, box.dimensions), np.float32)
        sides = {"x": 0, "y": 1}
        slopes = np.array([
            np.abs(self.wall.waves[:, sides[name]]).mean() * (b - a) if name in sides else 0.0
            for name, a, b in zip(box.names, box.lower, box.upper, strict=True)
        ])  # fmt: skip
        return WallBounds(lower, upper, slopes, (flat, lower, flat.copy(), upper) if keep_linear else None)

    def bound_parts(
        self, boxes: Sequence[ParameterBox], tiles: np.ndarray, within: Any, keep_linear: bool, pixels: Any
    ) -> list[WallBounds]:
        return [self.bound(box, tiles, within, keep_linear) for box in boxes]

    def feasible(self, box: ParameterBox) -> ParameterBox | None:
        return box

    def motion(self, box: ParameterBox) -> np.ndarray:
        return (np.array(box.upper) - np.array(box.lower)) / SCALE

    def observe(self, tiles: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> None:
        pass

    def set_tolerance(self, excess: float) -> float:
        return 0.0

    def plan(self, shown: int | None, lower: np.ndarray, upper: np.ndarray) -> list[str]:
        return ["perspective left out: the camera is orthographic"]


class WallMethod:
    plan = ("lighting left out: the wall shines by itself",)
    guarantee = "real-sound"
    dataset_scale = 2.0
    notes = ()

    def __init__(self, wall: Wall) -> None:
        self.wall, self.name = wall, wall.name

    @property
    def program(self) -> dict[str, Any]:
        return {"name": "wall", "version": "1"}

    @property
    def content(self) -> str:
        return "a painted wall"

    @property
    def fingerprint(self) -> dict[str, Any]:
        return {"scene": self.wall.waves.tobytes().hex(), "renderer": "wall", "arithmetic": "real"}

    def describe(self) -> dict[str, Any]:
        return {"name": self.name, "source": "test"}

    def ablations(self, poses: PoseBox) -> Iterator[tuple[str, Any]]:
        return iter(())

    def attribution(self, frame: Any, box: ParameterBox, tile: int, count: int) -> list[tuple[int, float]]:
        return []

    def elements(self) -> None:
        return None

    def prepare(self, perturbations: Sequence[Perturbation]) -> None:
        for perturbation in perturbations:
            if perturbation.rotation or perturbation.scene:
                raise InputError("the camera looks straight on", field="rotation", fix="leave the key out")

    def memory(self, pixels: int, threads: int) -> int:
        return 1000 * pixels

    def frame(self, poses: PoseBox, sheared: bool = False, layers: bool = False) -> WallFrame:
        return WallFrame(self.wall, poses)

    def differentiable(self, poses: PoseBox) -> Callable[[torch.Tensor], torch.Tensor] | None:
        from ns_abstract.geometry.differentiable_pose import differentiable_pose

        pose, camera = differentiable_pose(poses), poses.camera
        a, b, phase = torch.from_numpy(self.wall.waves.T.copy())
        column = SCALE * torch.arange(camera.width, dtype=torch.float64)[None, :, None]
        row = -SCALE * torch.arange(camera.height, dtype=torch.float64)[:, None, None]

        def picture(values: torch.Tensor) -> torch.Tensor:
            place = pose(values)[:, 3]
            return 0.5 + 0.4 * torch.sin((column + place[0]) * a + (row + place[1]) * b + phase)

        return picture


def write_wall(file: Path, fault: float = 0.0) -> Path:
    """A scene file of this representation."""
    file.write_text(json.dumps({"waves": WAVES, "fault": fault}))
    return file


def _reads(source: RunConfig | Path) -> bool:
    return isinstance(source, Path) and source.suffix == ".wall"


def _load(source: RunConfig | Path, overrides: Overrides) -> Wall:
    assert isinstance(source, Path)
    found = json.loads(source.read_text())
    return Wall(source.stem, np.array(found["waves"]), found["fault"])


def _method(wall: Wall, options: ProgramOptions, arithmetic: str | None, workers: int) -> WallMethod:
    return WallMethod(wall)


WALL = Representation(_reads, _load, _method)
