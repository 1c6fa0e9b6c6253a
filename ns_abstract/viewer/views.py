"""View requests, snapshots of their bounds, and the sources of bounds (design.md, W1, W3, W6)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from ns_abstract.arithmetic.rounding import arithmetic as arithmetic_named
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import parse_json
from ns_abstract.methods.nerf.frame import NerfFrame
from ns_abstract.methods.nerf.method import NerfMethod
from ns_abstract.methods.nerf.scene import NerfScene
from ns_abstract.methods.splat.activate import Splats
from ns_abstract.methods.splat.constants import rasteriser_named
from ns_abstract.methods.splat.frame import SplatFrame
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.methods.splat.variations import VariedSplats, vary
from ns_abstract.perturbation.specification import ROTATIONS, TRANSLATIONS, Perturbation, parse_perturbation
from ns_abstract.perturbation.variations import VARIATIONS, SceneVariation
from ns_abstract.refine.engine import Frame
from ns_abstract.refine.result import FrameResult
from ns_abstract.report.figures import metrics
from ns_abstract.report.files import check_frame

#: Sets of one and of several parameters, for which kernels are compiled.
_WARM_UP = ({"x": 1e-4}, {"x": 1e-4, "yaw": 1e-4})
#: Longest sides of the pictures that come before the one asked for, and the seconds that each may take: of splats,
#: and of NeRFs, whose rays are bounded one after the other.
SPLAT_LADDER = {64: 0.25, 128: 0.6, 256: 1.5}
NERF_LADDER = {8: 30.0, 16: 60.0}
#: Longest sides of a NeRF's pictures by the number of its weights, the last for all larger ones.
_NERF_MOST = ((200_000, 32), (2_000_000, 16), (None, 8))


def perturbation_of(radii: Mapping[str, float], select: str = "{}") -> Perturbation:
    """Return the set of poses within ``radii`` of a camera, and of scenes within ``radii`` of the stored one.

    Args:
        radii: x, y, z (normalised units), yaw, pitch, roll (radians); mean (normalised units), opacity, color.
        select: Which Gaussians vary: a ``select`` object of the perturbation file, as text.

    Raises:
        InputError: Gaussians are to vary and ``select`` cannot be read.
    """

    def given(names: Sequence[str]) -> dict[str, Any]:
        return {name: radii[name] for name in names if radii.get(name, 0.0) > 0.0}

    value: dict[str, Any] = {"translation": given(TRANSLATIONS), "rotation": given(ROTATIONS)}
    if ranges := given(VARIATIONS):
        chosen = parse_json(select.strip() or "{}", "select")
        if isinstance(chosen, dict) and isinstance(chosen.get("indices"), str):
            # whoever reaches the viewer would read files here
            raise InputError("names a file", field="select.indices", fix="write the numbers of the Gaussians")
        value["scene"] = [{"select": chosen, **ranges}]
    return parse_perturbation(value, field_prefix="")


@dataclass(frozen=True, eq=False)
class ViewRequest:
    """A camera with the size it is shown at, and the set of poses and scenes around it."""

    camera: PinholeCamera
    perturbation: Perturbation

    @property
    def key(self) -> tuple[bytes, tuple[float, ...], str]:
        """Equal for views that differ in the size of the picture only."""
        camera = self.camera
        around = f"{self.perturbation!r} {self.perturbation.scene!r}"
        lens = camera.fy / camera.height, camera.fx / camera.fy
        # a smaller picture's sides are rounded, and its middle is off by that
        if max(abs(camera.cx - 0.5 * camera.width), abs(camera.cy - 0.5 * camera.height)) > 1.0:
            lens += camera.cx / camera.fy, camera.cy / camera.fy
        return camera.camera_to_world.tobytes(), tuple(round(value, 6) for value in lens), around

    def at_most(self, side: int | None) -> ViewRequest:
        """Return this view with a picture of no more than ``side`` pixels along its longest side."""
        if side is None or self.side <= side:
            return self
        return replace(self, camera=self.camera.rescaled(self.side / side))

    @property
    def side(self) -> int:
        """Longest side in pixels."""
        return max(self.camera.width, self.camera.height)

    def fits(self, height: int, width: int) -> bool:
        """Whether a picture of ``height`` x ``width`` pixels shows this view, its sides rounded to whole pixels."""
        camera = self.camera
        slack = 2.0 / min(height, width, camera.height, camera.width)
        return abs(width * camera.height / (height * camera.width) - 1.0) <= slack

    def stages(
        self, seconds: float, known: int = 0, ladder: Mapping[int, float] = SPLAT_LADDER
    ) -> list[tuple[PinholeCamera, float]]:
        """Return cameras of growing size above the longest side ``known``, with their times; this view's is last."""
        smaller = [(self.camera.rescaled(self.side / s), t) for s, t in ladder.items() if known < s < self.side]
        return [*smaller, (self.camera, seconds)]


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The bounds of a view at one size.

    ``lower``, ``upper``, ``witness_lower`` and ``witness_upper``, extremes of real renders, are [h, w, 3] float32;
    ``figures`` as `ns_abstract.report.figures.metrics`; ``guarantee``: "float32-sound", "real-sound" or "sampled";
    ``depth`` [2, h, w] float32 bounds the expected depth, normalised units, if it was bounded.
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
    depth: np.ndarray | None = None

    @classmethod
    def of(cls, result: FrameResult, *, final: bool, guarantee: str) -> Snapshot:
        """Return the snapshot of a refinement's result.

        Raises:
            ValueError: The result is one that no sound refinement can have.
        """
        check_frame(result)
        depth = result.layers.get("depth")
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
            None if depth is None else np.stack([depth.lower, depth.upper]),
        )

    @property
    def untreated(self) -> int:
        """Number of pixels without bounds: [0, 1] in every channel."""
        return int(((self.lower == 0.0) & (self.upper == 1.0)).all(axis=-1).sum())

    def says_less(self, other: Snapshot) -> bool:
        """Whether a larger part of this picture than of ``other`` has no bounds."""
        return self.untreated * other.size[0] * other.size[1] > other.untreated * self.size[0] * self.size[1]

    @property
    def size(self) -> tuple[int, int]:
        return self.lower.shape[0], self.lower.shape[1]

    @property
    def bytes(self) -> int:
        return 4 * self.lower.nbytes


class Source(ABC):
    """A scene that frames can be made of; crosses to the worker process.

    ``ladder``: longest sides of previews and the seconds that each may take. ``patience``: seconds that a worker may go
    on with an outdated request before another takes over.
    """

    ladder: ClassVar[Mapping[int, float]]
    patience: ClassVar[float]

    @property
    def most(self) -> int | None:
        """Longest side that is worth bounding, or None."""
        return None

    @property
    @abstractmethod
    def about(self) -> str:
        """Sentence on the bounded picture if it is not the one on screen; else ""."""

    @property
    @abstractmethod
    def guarantee(self) -> str:
        """What the bounds are worth on a platform that passes its self-check."""

    @abstractmethod
    def frame(self, camera: PinholeCamera, perturbation: Perturbation) -> Frame:
        """Return frame of ``camera`` and a set of poses around it. Raises InputError: the scene does not vary so."""

    @abstractmethod
    def _camera(self) -> PinholeCamera:
        """Return a small camera whose frames need the kernels of all views."""

    def warm_up(self) -> None:
        """Compile the kernels for one and for several parameters."""
        camera = self._camera()
        for radii in _WARM_UP:
            self.frame(camera, perturbation_of(radii)).warm_up()


@dataclass(frozen=True, eq=False)
class SplatSource(Source):
    """A splat scene as it is shown: activated ``splats`` with the background, and the stored ``scene`` for selections.

    ``renderer``: "gsplat" or "paper"; ``version``: gsplat's; None: 1.4.0; ``arithmetic``: "float32" or "real".
    """

    splats: Splats
    scene: SplatScene
    renderer: str = "gsplat"
    version: str | None = None
    arithmetic: str = "float32"
    layers: bool = False
    _kept: dict[tuple[SceneVariation, ...], VariedSplats] = field(default_factory=dict, init=False, repr=False)

    ladder: ClassVar[Mapping[int, float]] = SPLAT_LADDER
    patience: ClassVar[float] = 0.4

    @property
    def about(self) -> str:
        """Sentence on the gsplat version whose pictures are bounded, if it was asked for; else ""."""
        return "" if self.version is None else f"Bounds of the pictures of gsplat {self.version}."

    @property
    def guarantee(self) -> str:
        return f"{self.arithmetic}-sound"

    def frame(self, camera: PinholeCamera, perturbation: Perturbation) -> SplatFrame:
        return SplatFrame(
            self.splats,
            rasteriser_named(self.renderer, self.version),
            arithmetic_named(self.arithmetic),
            PoseBox.around(camera, perturbation),
            varied=self._varied(perturbation),
            sheared=True,
            layers=self.layers,
        )

    def _varied(self, perturbation: Perturbation) -> VariedSplats:
        """Return the scenes of a set; those of the last set are cached, for pictures of several sizes."""
        if perturbation.scene not in self._kept:
            varied = vary(self.scene, self.splats, perturbation.scene)
            self._kept.clear()
            self._kept[perturbation.scene] = varied
        return self._kept[perturbation.scene]

    def _camera(self) -> PinholeCamera:
        means = self.splats.means
        middle = np.median(means, axis=0)
        distance = 4.0 * float(np.median(np.linalg.norm(means - middle, axis=1))) + 0.1
        pose = np.eye(3, 4)
        pose[:, 3] = middle
        pose[2, 3] += distance
        return PinholeCamera(pose, 32.0, 32.0, 16.0, 16.0, 32, 32)


@dataclass(frozen=True, eq=False)
class NerfSource(Source):
    """A vanilla NeRF as it is bounded: its fine field at uniform samples, in small pictures."""

    scene: NerfScene

    ladder: ClassVar[Mapping[int, float]] = NERF_LADDER
    #: a few rays are bounded at once, and a new worker has to compile
    patience: ClassVar[float] = 5.0

    @property
    def most(self) -> int:
        """Longest side: so that all rays can be bounded within minutes."""
        weights = sum(array.size for array in self.scene.fine.arrays())
        return next(side for limit, side in _NERF_MOST if limit is None or weights <= limit)

    @cached_property
    def _method(self) -> NerfMethod:
        return NerfMethod(self.scene)

    @property
    def guarantee(self) -> str:
        """What the bounds are worth on a platform that passes its self-check."""
        return self._method.guarantee

    @property
    def about(self) -> str:
        s = self._method.sampling
        return f"of the fine field at {s.samples} uniform samples by ray, not of the picture with importance samples"

    def frame(self, camera: PinholeCamera, perturbation: Perturbation) -> NerfFrame:
        self._method.prepare([perturbation])
        return self._method.frame(PoseBox.around(camera, perturbation))

    def _camera(self) -> PinholeCamera:
        return PinholeCamera(np.eye(3, 4), 2.0, 2.0, 1.0, 1.0, 2, 2)
