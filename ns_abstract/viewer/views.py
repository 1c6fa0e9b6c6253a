"""What is looked at, what is known about it, and where bounds come from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ns_abstract.arithmetic.units import arithmetic as arithmetic_named
from ns_abstract.methods.splat.activate import Splats
from ns_abstract.methods.splat.constants import RASTERISERS
from ns_abstract.methods.splat.frame import SplatFrame
from ns_abstract.refine.engine import Frame
from ns_abstract.refine.result import FrameResult
from ns_abstract.report.figures import metrics
from ns_abstract.report.files import check_frame
from ns_abstract.sets.path import Camera
from ns_abstract.sets.perturbation import ROTATIONS, TRANSLATIONS, Perturbation
from ns_abstract.sets.poses import PoseSet

#: Longest sides of the pictures that come before the one asked for, and the seconds that each may take.
LADDER = {64: 0.25, 128: 0.6, 256: 1.5}


def perturbation_of(radii: dict[str, float]) -> Perturbation:
    """The set of poses within ``radii`` (x, y, z in normalised units; yaw, pitch, roll in radians) of a camera."""

    def ranges(names: tuple[str, ...]) -> dict[str, tuple[float, float]]:
        return {name: (-radii[name], radii[name]) for name in names if radii.get(name, 0.0) > 0.0}

    return Perturbation(translation=ranges(TRANSLATIONS), rotation=ranges(ROTATIONS))


@dataclass(frozen=True, eq=False)
class View:
    """A camera with the size it is shown at, and the set of poses around it."""

    camera: Camera
    perturbation: Perturbation

    @property
    def key(self) -> tuple[bytes, float, str]:
        """Equal for views that differ in the size of the picture only."""
        camera = self.camera
        return camera.camera_to_world.tobytes(), round(camera.fy / camera.height, 6), repr(self.perturbation)

    @property
    def side(self) -> int:
        """Longest side in pixels."""
        return max(self.camera.width, self.camera.height)

    def fits(self, height: int, width: int) -> bool:
        """Whether a picture of ``height`` x ``width`` pixels shows this view, its sides rounded to whole pixels."""
        camera = self.camera
        slack = 2.0 / min(height, width, camera.height, camera.width)
        return abs(width * camera.height / (height * camera.width) - 1.0) <= slack

    def stages(self, seconds: float, known: int = 0) -> list[tuple[Camera, float]]:
        """Cameras of growing size above the longest side ``known`` and their times; the last is this view's own."""
        smaller = [(self.camera.rescaled(self.side / s), t) for s, t in LADDER.items() if known < s < self.side]
        return [*smaller, (self.camera, seconds)]


@dataclass(frozen=True, eq=False)
class Snapshot:
    """What is known about a view at one size.

    Attributes:
        lower, upper: [h, w, 3] float32 bounds.
        witness_lower, witness_upper: [h, w, 3] float32 extremes of real renders.
        figures: As `ns_abstract.report.figures.metrics`.
        seconds: Time spent at this size.
        cells: Cells bounded at this size.
        final: Whether the work at this size has ended.
        guarantee: "float32-sound", "real-sound" or "sampled".
    """

    lower: np.ndarray
    upper: np.ndarray
    witness_lower: np.ndarray
    witness_upper: np.ndarray
    figures: dict[str, float | None]
    seconds: float
    cells: int
    final: bool
    guarantee: str

    @classmethod
    def of(cls, result: FrameResult, *, final: bool, guarantee: str) -> Snapshot:
        """The snapshot of a refinement's result.

        Raises:
            ValueError: The result is one that no sound refinement can have.
        """
        check_frame(result)
        return cls(
            result.lower,
            result.upper,
            result.witness_lower,
            result.witness_upper,
            metrics(result),
            result.seconds,
            result.cells,
            final,
            guarantee,
        )

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return self.lower.shape[0], self.lower.shape[1]

    @property
    def bytes(self) -> int:
        """Memory of the pictures."""
        return 4 * self.lower.nbytes


class Source(Protocol):
    """A scene that frames can be made of; crosses to the worker process."""

    @property
    def guarantee(self) -> str:
        """What the bounds are worth on a platform that passes its self-check."""
        ...

    def frame(self, camera: Camera, perturbation: Perturbation) -> Frame:
        """The frame of ``camera`` and a set of poses around it."""
        ...

    def warm_up(self) -> None:
        """Compile what frames will need."""
        ...


@dataclass(frozen=True, eq=False)
class SplatSource:
    """A splat scene as it is shown.

    Attributes:
        splats: The activated Gaussians, with the background that is shown.
        renderer: Name in `RASTERISERS`.
        arithmetic: "float32" or "real".
    """

    splats: Splats
    renderer: str = "gsplat"
    arithmetic: str = "float32"

    @property
    def guarantee(self) -> str:
        """What the bounds are worth on a platform that passes its self-check."""
        return f"{self.arithmetic}-sound"

    def frame(self, camera: Camera, perturbation: Perturbation) -> SplatFrame:
        """The frame of ``camera`` and a set of poses around it."""
        return SplatFrame(
            self.splats,
            RASTERISERS[self.renderer],
            arithmetic_named(self.arithmetic),
            PoseSet.around(camera, perturbation),
        )

    def warm_up(self) -> None:
        """Compile the kernels for one and for several parameters."""
        means = self.splats.means
        middle = np.median(means, axis=0)
        distance = 4.0 * float(np.median(np.linalg.norm(means - middle, axis=1))) + 0.1
        pose = np.eye(3, 4)
        pose[:, 3] = middle
        pose[2, 3] += distance
        camera = Camera(pose, 32.0, 32.0, 16.0, 16.0, 32, 32)
        for radii in ({"x": 1e-4}, {"x": 1e-4, "yaw": 1e-4}):
            self.frame(camera, perturbation_of(radii)).warm_up()
