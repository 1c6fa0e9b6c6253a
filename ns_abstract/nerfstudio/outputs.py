"""Abstract images among the outputs of a nerfstudio model (design.md, W4)."""

from __future__ import annotations

import sys
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from nerfstudio.utils.rich_utils import CONSOLE

from ns_abstract.arithmetic.selfcheck import check_functions
from ns_abstract.io.errors import InputError
from ns_abstract.nerfstudio.loading import lpips_known
from ns_abstract.nerfstudio.panel import AbstractPanel, RedrawUntilCurrent, camera_of
from ns_abstract.perturbation.specification import ROTATIONS, TRANSLATIONS
from ns_abstract.perturbation.variations import VARIATIONS
from ns_abstract.refine.engine import Refinement, RefinementGoal
from ns_abstract.viewer.background import Background
from ns_abstract.viewer.views import Snapshot, Source, ViewRequest

if TYPE_CHECKING:
    from nerfstudio.models.base_model import Model

    _Base = Model
else:
    _Base = object

OUTPUTS = ("abstract_lower", "abstract_upper", "abstract_gap", "abstract_witness")
#: Further ones, where the depth is bounded.
DEPTH_OUTPUTS = ("abstract_depth_lower", "abstract_depth_upper")
#: gsplat draws nothing that is farther away.
_FAR = 1e10


@dataclass
class AbstractConfig:
    """Abstract images of a trained model."""

    translation: tuple[float, float, float] = (0.01, 0.0, 0.0)
    """Radii of the set of poses along the camera's x, y and z, in scene units; sliders in the viewer."""
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Radii of yaw, pitch and roll in radians; sliders in the viewer."""
    mean: float = 0.0
    """Radius of the mean of every selected Gaussian, in scene units; a slider in the viewer."""
    opacity: float = 0.0
    """Radius of the opacity of every selected Gaussian; a slider in the viewer."""
    color: float = 0.0
    """Radius of the colour of every selected Gaussian; a slider in the viewer."""
    select: str = "{}"
    """Which Gaussians vary: "select" of the perturbation file; {} stands for all."""
    seconds: float = 2.0
    """Time for every image of ns-render and ns-eval; 0: no abstract images there."""
    viewer_seconds: float = 10.0
    """Time for every view in the viewer."""
    depth: bool = False
    """Splats: bound the expected depth, too."""
    gsplat_version: Literal["1.4.0", "1.5.3", "1.6.0"] | None = None
    """Splats: whose rules are drawn and bounded. Default: the installed version's."""

    @property
    def radii(self) -> dict[str, float]:
        poses = dict(zip((*TRANSLATIONS, *ROTATIONS), (*self.translation, *self.rotation), strict=True))
        return {**poses, **{name: getattr(self, name) for name in VARIATIONS}}


def pictures(snapshot: Snapshot | None, height: int, width: int, depth: bool = False) -> dict[str, torch.Tensor]:
    """Return outputs [height, width, 3] for the bounds and [height, width, 1] for the gaps, enlarged to that size.

    ``abstract_gap`` is the length over RGB of upper - lower, ``abstract_witness`` the same of the least
    and largest values that were really rendered. Without a snapshot the bounds are 0 and 1. With ``depth`` also
    ``abstract_depth_lower`` and ``abstract_depth_upper`` [height, width, 1], normalised units, at most the far plane.
    """
    if snapshot is None:
        zero = np.zeros((1, 1, 3), np.float32)
        lower, upper, least, most = zero, zero + 1.0, zero, zero
    else:
        lower, upper = snapshot.lower, snapshot.upper
        least, most = snapshot.witness_lower, snapshot.witness_upper
    gaps = [np.linalg.norm(high - low, axis=-1, keepdims=True) for low, high in ((lower, upper), (least, most))]
    images = [resampled(torch.from_numpy(image), height, width) for image in (lower, upper, *gaps)]
    named: dict[str, torch.Tensor] = dict(zip(OUTPUTS, images, strict=True))
    if depth:
        depth_bounds = None if snapshot is None else snapshot.depth
        ends = (
            np.array([[[0.0]], [[_FAR]]], np.float32)
            if depth_bounds is None
            else np.minimum(depth_bounds, np.float32(_FAR))
        )
        for name, end in zip(DEPTH_OUTPUTS, ends, strict=True):
            named[name] = resampled(torch.from_numpy(np.ascontiguousarray(end))[..., None], height, width)
    return named


def resampled(image: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """Return [height, width, c] of an image [h, w, c]: at every place the pixel that covers its middle."""

    def places(wanted: int, there: int) -> torch.Tensor:
        return ((torch.arange(wanted, dtype=torch.float64) + 0.5) * (there / wanted)).clamp(max=there - 1).long()

    rows, columns = places(height, image.shape[0]), places(width, image.shape[1])
    return image[rows[:, None], columns].contiguous()


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Keep the viewer from interrupting this thread inside the block.

    It interrupts by an exception from a trace function (render_state_machine.py, check_interrupt), which
    compiled code turns into a SystemError that would end the render thread.
    """
    trace = sys.gettrace()
    sys.settrace(None)
    try:
        yield
    finally:
        sys.settrace(trace)


class AbstractOutputs(_Base):
    """Comes before a nerfstudio model in a class's bases.

    In a viewer, bounds are worked out in the background and what is known is shown; elsewhere
    (ns-render, ns-eval) every image waits for its bounds. During training there are none.
    """

    #: Whether the scene consists of Gaussians, which may vary.
    gaussians = False

    def populate_modules(self) -> None:
        super().populate_modules()
        options: AbstractConfig = self.config.abstract  # pyright: ignore[reportAttributeAccessIssue]
        # the viewer follows attributes of modules: a plain reference from the panel would lead it in circles
        here = weakref.ref(self)

        self.abstract = AbstractPanel(
            options.radii,
            options.select if self.gaussians else None,
            options.viewer_seconds,
            attached=lambda: (model := here()) and model._attached(),
            refine=lambda seconds: (model := here()) and model._background.more(seconds),
        )
        self._background = Background(lambda: (model := here()) and model._news())
        self._redraw = RedrawUntilCurrent(
            lambda: (model := here()) and model.abstract.control.draw(),
            lambda: (model := here()) is None or model._current(),
        )
        self._source: Source | None = None
        self._evaluating = False
        self._problems: list[str] | None = None

    def start_evaluation(self) -> None:
        """Allow abstract images from now on: the model's parameters change no more."""
        self._evaluating = True

    def abstract_source(self) -> Source | None:
        """Return the shown scene; the same object as long as nothing changes. None: there are no bounds for it."""
        return None

    @torch.no_grad()
    def get_outputs_for_camera(self, camera: Any, obb_box: Any = None) -> dict[str, torch.Tensor]:
        """Return the model's outputs and the abstract images."""
        outputs = self._concrete(camera, obb_box)
        if not self._evaluating or self.training:
            return outputs
        if "depth" in outputs:
            depth = outputs["depth"]
            self.abstract.depth = float(depth[depth.shape[0] // 2, depth.shape[1] // 2, 0])
        try:
            with uninterrupted():
                abstract_outputs = self._abstract(camera)
        except Exception as error:
            # the viewer's render thread must not end; nothing is known, and that is what is shown
            CONSOLE.print(f"[yellow]No abstract image: {type(error).__name__}: {error}")
            abstract_outputs = self._pictures(None, int(camera.height.reshape(-1)[0]), int(camera.width.reshape(-1)[0]))
        return {**outputs, **{name: value.to(self.device) for name, value in abstract_outputs.items()}}

    def _concrete(self, camera: Any, obb_box: Any) -> dict[str, torch.Tensor]:
        return super().get_outputs_for_camera(camera, obb_box)

    def _abstract(self, camera: Any) -> dict[str, torch.Tensor]:
        options: AbstractConfig = self.config.abstract  # pyright: ignore[reportAttributeAccessIssue]
        if not (self.abstract.control.present or options.seconds > 0.0):
            return {}
        pinhole = camera_of(camera)
        try:
            source = self.abstract_source()
            if source is None:
                return {}
            view = ViewRequest(pinhole, self.abstract.perturbation)
        except InputError as error:
            self.abstract.refuse(error)
            return self._pictures(None, pinhole.height, pinhole.width)
        if self.abstract.control.present:
            self._show(source)
            snapshot = self._background.best(view.at_most(source.most), self.abstract.seconds)
            self.abstract.show(view, snapshot, self._background.status, source.about)
        else:
            snapshot = self._now(source, view, options.seconds)
        return self._pictures(snapshot, view.camera.height, view.camera.width)

    def _pictures(self, snapshot: Snapshot | None, height: int, width: int) -> dict[str, torch.Tensor]:
        options: AbstractConfig = self.config.abstract  # pyright: ignore[reportAttributeAccessIssue]
        return pictures(snapshot, height, width, options.depth and self.gaussians)

    def _now(self, source: Source, view: ViewRequest, seconds: float) -> Snapshot:
        if self._problems is None:
            self._problems = check_functions()
        frame = source.frame(view.camera, view.perturbation)
        result = Refinement(frame, 0, RefinementGoal(seconds=seconds), scene_samples=frame.scene_samples(0)).run()
        return Snapshot.of(result, final=True, guarantee="sampled" if self._problems else source.guarantee)

    def _attached(self) -> None:
        source = self.abstract_source() if self._evaluating else None
        if source is not None:
            self._show(source)

    def _show(self, source: Source) -> None:
        if self._source is not source:
            self._source = source
            self._background.show(source)

    def _news(self) -> None:
        if self._background.status.state != "off":
            self._redraw()

    def _current(self) -> bool:
        """Whether the panel needs no update: no or the current status reported, bounding off, or nobody watching."""
        reported, now = self.abstract.reported, self._background.status
        return reported in (None, now) or now.state == "off" or not self.abstract.control.watched

    def get_image_metrics_and_images(
        self, outputs: dict[str, torch.Tensor], batch: dict[str, torch.Tensor]
    ) -> tuple[dict[str, float], dict[str, torch.Tensor]]:
        """Return the model's metrics and, where there are abstract images, theirs; LPIPS only with weights."""
        metrics, images = super().get_image_metrics_and_images(outputs, batch)
        if not lpips_known(self.lpips):  # pyright: ignore[reportArgumentType]
            metrics = {name: value for name, value in metrics.items() if "lpips" not in name}
        if OUTPUTS[2] in outputs:
            gap, witness = outputs["abstract_gap"].double(), outputs["abstract_witness"].double()
            metrics["abstract_mpg"], metrics["abstract_xpg"] = float(gap.mean()), float(gap.max())
            metrics["abstract_mpg_witness"] = float(witness.mean())
            images["abstract"] = torch.cat([outputs["abstract_lower"], outputs["abstract_upper"]], dim=1)
        return metrics, images
