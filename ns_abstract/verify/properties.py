"""Properties of a network on every image of a set: their concrete check, and their proof.

A property holds where its margin, a function of the network's outputs and the pose, is positive (docs/dev/design.md,
V2-V5). A ``Property`` is the content of a file; ``bind`` makes it a ``Claim`` about one frame's set of poses. A claim
knows the margin of concrete outputs, the linear rows whose lower bounds a proof needs, and the bound of the margin that
these prove.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ns_abstract.arithmetic.form_array import FormArray
from ns_abstract.arithmetic.network_charges import OWN_MARGIN
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.differentiable_pose import differentiable_pose
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.verify.preprocess import Preprocess
from ns_abstract.verify.vnnlib_sets import UnsafeSet

if TYPE_CHECKING:
    from ns_abstract.verify.network import OutputBounds

CLASSES, _ANCHORS = 20, 5
#: Anchors of the VOC TinyYOLO head, widths and heights in grid cells.
ANCHORS = ((1.19, 1.98), (2.79, 4.59), (4.53, 8.92), (8.06, 5.29), (10.32, 10.65))
HEAD = _ANCHORS * (1 + CLASSES + 4)
#: Boxes looked at in a proof of a detection: the best of each cell's sample, and in all.
_BEST, _CANDIDATES = 2, 6
COMPONENTS = ("camera.x", "camera.y", "camera.z", "object.x", "object.y", "object.z", "distance")


@dataclass(frozen=True)
class Query:
    """The linear functions ``rows @ y + offset``, [k, output_size] and [k], whose lower bounds a proof needs."""

    rows: np.ndarray
    offset: np.ndarray
    about: Any = None


class Claim(ABC):
    """A property that is bound to one frame's set of poses."""

    @abstractmethod
    def margin(self, outputs: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        """Return margins [B] of outputs [B, n] at parameter values [B, d]; the property holds where positive."""

    @abstractmethod
    def query(self, outputs: np.ndarray) -> Query:
        """Return the rows whose bounds a proof needs, given outputs [s, n] of samples in the cells."""

    @abstractmethod
    def proved(self, query: Query, bounds: OutputBounds, boxes: Sequence[ParameterBox]) -> np.ndarray:
        """Return lower bounds [m] of the margin over the cells ``boxes``; -inf where none is known."""

    def refuted(self, query: Query, bounds: OutputBounds, boxes: Sequence[ParameterBox]) -> np.ndarray:
        """Return upper bounds [m] of the margin over the cells ``boxes``; infinite where none is known."""
        return np.full(len(boxes), np.inf)


@dataclass(frozen=True, kw_only=True)
class Property(ABC):
    """A property as its file states it."""

    preprocess: Preprocess = field(default_factory=Preprocess)
    partitions: tuple[int, ...] | None = None

    @abstractmethod
    def sentence(self) -> str:
        """Return the property in words, as the end of "on every image ..."."""

    @abstractmethod
    def bind(self, pose_set: PoseBox, nominal: Callable[[], np.ndarray]) -> Claim:
        """Return the claim about a frame; ``nominal`` returns outputs [n] at the middle of the set."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on parts of the file that are ignored."""
        return ()


# ---------------------------------------------------------------- linear properties


@dataclass(frozen=True)
class LinearClaim(Claim):
    """A claim with margin ``min over groups of max over the group's rows of rows @ y + offset`` (V2)."""

    rows: np.ndarray
    offset: np.ndarray
    groups: tuple[tuple[int, ...], ...]

    def margin(self, outputs: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        row_values = outputs @ torch.from_numpy(self.rows).to(outputs.dtype).T
        row_values = row_values + torch.from_numpy(self.offset).to(outputs.dtype)
        return torch.stack([row_values[:, list(group)].amax(dim=1) for group in self.groups]).amin(dim=0)

    def query(self, outputs: np.ndarray) -> Query:
        return Query(self.rows, self.offset)

    def proved(self, query: Query, bounds: OutputBounds, boxes: Sequence[ParameterBox]) -> np.ndarray:
        # a maximum of lower bounds would ignore NaN in one order of arguments and not in the other
        lower = np.where(np.isnan(bounds.lower), -np.inf, bounds.lower)
        return np.min([lower[:, list(group)].max(axis=1) for group in self.groups], axis=0)


@dataclass(frozen=True)
class Classification(Property):
    """The property that the logit of ``label`` is the largest."""

    label: int
    classes: int

    def sentence(self) -> str:
        others = "the other" if self.classes == 2 else f"each of the other {self.classes - 1}"
        return f"output {self.label} is larger than {others}"

    def bind(self, pose_set: PoseBox, nominal: Callable[[], np.ndarray]) -> Claim:
        others = [k for k in range(self.classes) if k != self.label]
        rows = np.zeros((len(others), self.classes))
        rows[:, self.label] = 1.0
        rows[np.arange(len(others)), others] = -1.0
        return LinearClaim(rows, np.zeros(len(others)), tuple((k,) for k in range(len(others))))


@dataclass(frozen=True)
class VnnLibProperty(Property):
    """The property that no output is in the unsafe set of a VNN-LIB file."""

    file: Path
    unsafe: UnsafeSet

    def sentence(self) -> str:
        return f"the outputs are outside the unsafe set of {self.file.name}"

    @property
    def notes(self) -> tuple[str, ...]:
        count = self.unsafe.inputs
        if not count:
            return ()
        return (f"{count} assertions on inputs set aside: the images of the scene take their place",)

    def bind(self, pose_set: PoseBox, nominal: Callable[[], np.ndarray]) -> Claim:
        return LinearClaim(self.unsafe.rows, self.unsafe.offset, self.unsafe.groups)


# ---------------------------------------------------------------- regression


@dataclass(frozen=True)
class TrueValues:
    """True values as functions of the pose.

    Attributes:
        components: A number, or one of ``camera.x`` ... (position minus origin, world axes), ``object.x``
            ... (origin in camera coordinates: x right, y up, z back), ``distance``.
        origin: World point, normalised frame.
        scale: Factor on every component that is no number: network units per normalised unit.
    """

    components: tuple[float | str, ...]
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    scale: float = 1.0

    def forms(self, pose_set: PoseBox, box: ParameterBox) -> FormArray:
        """Return forms [c] of order 1 that enclose the values over a cell."""
        poses = pose_set.enclosure(box, 1)
        # OpenCV to OpenGL camera axes
        flip = np.array([1.0, -1.0, -1.0])
        camera = poses.position - np.array(self.origin)
        parts: dict[str, FormArray] = {}
        if any(isinstance(c, str) and c.startswith("object") for c in self.components):
            in_camera = (poses.rotation @ (np.array(self.origin) - poses.origin) + poses.offset) * flip
            parts |= {f"object.{name}": in_camera[k] for k, name in enumerate("xyz")}
        parts |= {f"camera.{name}": camera[k] for k, name in enumerate("xyz")}
        if "distance" in self.components:
            parts["distance"] = camera.square().sum(0).sqrt()
        basis = poses.position.basis
        columns = [
            (parts[c] * self.scale if isinstance(c, str) else FormArray.constant(basis, c)).data.reshape(-1, 1)
            for c in self.components
        ]
        return FormArray(basis, np.ascontiguousarray(np.concatenate(columns, axis=1)), (len(columns),))

    def at(self, pose: torch.Tensor) -> torch.Tensor:
        """Return values [c] at a camera-to-world pose [3, 4]."""
        origin = torch.tensor(self.origin, dtype=pose.dtype)
        camera = pose[:, 3] - origin
        in_camera = -(pose[:, :3].T @ camera)
        parts = {f"camera.{n}": camera[k] for k, n in enumerate("xyz")}
        parts |= {f"object.{n}": in_camera[k] for k, n in enumerate("xyz")}
        parts["distance"] = camera.norm()
        numbers = [torch.tensor(0.0 if isinstance(c, str) else c, dtype=pose.dtype) for c in self.components]
        return torch.stack(
            [parts[c] * self.scale if isinstance(c, str) else n for c, n in zip(self.components, numbers, strict=True)]
        )


@dataclass(frozen=True, eq=False)
class RegressionClaim(Claim):
    """The claim that outputs are close to the true values (V3)."""

    truth: TrueValues
    absolute: tuple[float, ...] | None
    relative: float | None
    pose_set: PoseBox

    def margin(self, outputs: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        pose = differentiable_pose(self.pose_set)
        truth = torch.stack([self.truth.at(pose(v.to(torch.float64))) for v in values]).to(outputs.dtype)
        error = outputs - truth
        if self.relative is not None:
            return self.relative * truth.norm(dim=1) - error.norm(dim=1)
        assert self.absolute is not None
        if len(self.absolute) == 1:
            return self.absolute[0] - error.norm(dim=1)
        return (torch.tensor(self.absolute, dtype=outputs.dtype) - error.abs()).amin(dim=1)

    def query(self, outputs: np.ndarray) -> Query:
        unit = np.eye(outputs.shape[1])
        return Query(np.concatenate([unit, -unit]), np.zeros(2 * len(unit)))

    def proved(self, query: Query, bounds: OutputBounds, boxes: Sequence[ParameterBox]) -> np.ndarray:
        margins = np.full(len(boxes), -np.inf)
        for cell, box in enumerate(boxes):
            with np.errstate(all="ignore"):
                margin = self._cell(bounds.lower[cell], bounds.a[cell], bounds.b[cell], box)
            margins[cell] = margin if math.isfinite(margin) else -np.inf
        return margins

    def _cell(self, lower: np.ndarray, a: np.ndarray, b: np.ndarray, box: ParameterBox) -> float:
        truth = self.truth.forms(self.pose_set, box)
        count, signs = len(self.truth.components), np.array([[1.0], [-1.0]])
        low, high = truth.bounds()
        # lower bounds of y - t and t - y: from both ranges, and from both lines
        ranges = lower.reshape(2, count) - np.stack([high, -low])
        a, b = a.reshape(2, count, -1), b.reshape(2, count)
        slope = a - signs[..., None] * truth.linear.T
        size = np.abs(b) + np.abs(truth.center) + np.abs(a).sum(-1) + np.abs(truth.linear).sum(0) + truth.radius
        lines = b - signs * truth.center - truth.radius - np.abs(slope).sum(axis=-1) - OWN_MARGIN * size
        ranges -= OWN_MARGIN * (np.abs(lower.reshape(2, count)) + np.abs(high) + np.abs(low))
        # fmax: where one says nothing the other holds
        sides = np.fmax(ranges, lines)
        error = np.maximum(-sides[0], -sides[1]).clip(min=0.0)
        if self.absolute is not None and len(self.absolute) > 1:
            return float((np.array(self.absolute) * (1.0 - OWN_MARGIN) - error).min())
        length = float(np.sqrt((error * error).sum())) * (1.0 + OWN_MARGIN)
        if self.absolute is not None:
            return float(min(self.absolute)) * (1.0 - OWN_MARGIN) - length * (1.0 + OWN_MARGIN)
        assert self.relative is not None
        nearest = np.where((low <= 0.0) & (high >= 0.0), 0.0, np.minimum(np.abs(low), np.abs(high)))
        radius = self.relative * float(np.sqrt((nearest * nearest).sum())) * (1.0 - OWN_MARGIN)
        return radius - length - OWN_MARGIN * (radius + length)


@dataclass(frozen=True)
class Regression(Property):
    """The property that outputs are within a tolerance of the truth."""

    truth: TrueValues
    absolute: tuple[float, ...] | None
    relative: float | None

    def sentence(self) -> str:
        names = ", ".join(c if isinstance(c, str) else f"{c:g}" for c in self.truth.components)
        if self.relative is not None:
            return f"the outputs are closer to ({names}) than {self.relative:g} times its length"
        assert self.absolute is not None
        if len(self.absolute) == 1:
            return f"the outputs are closer to ({names}) than {self.absolute[0]:g} (Euclidean length)"
        return f"each output is closer to its value of ({names}) than {', '.join(f'{v:g}' for v in self.absolute)}"

    def bind(self, pose_set: PoseBox, nominal: Callable[[], np.ndarray]) -> Claim:
        return RegressionClaim(self.truth, self.absolute, self.relative, pose_set)


# ---------------------------------------------------------------- detection


def decode(outputs: torch.Tensor, stride: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return objectness, class probabilities and boxes of the VOC TinyYOLO head (V4, after Redmon and Farhadi).

    Args:
        outputs: [B, 125 g g]: channels of [125, g, g] are 5 objectness logits, 5 x 20 class logits and 5 x 4 numbers
            tx, ty, tw, th, each by anchor.
        stride: Pixels by grid cell.

    Returns:
        Objectness [B, 5, g, g], class probabilities [B, 5, 20, g, g], and boxes [B, 5, 4, g, g] x0, y0, x1, y1 in
            pixels: centres at ``(sigmoid(t) + cell) stride``, sides ``anchor exp(t) stride``.
    """
    grid = math.isqrt(outputs.shape[1] // HEAD)
    head = outputs.reshape(-1, HEAD, grid, grid)
    objectness = torch.sigmoid(head[:, :_ANCHORS])
    logits = head[:, _ANCHORS : _ANCHORS * (1 + CLASSES)].reshape(-1, _ANCHORS, CLASSES, grid, grid)
    t = head[:, _ANCHORS * (1 + CLASSES) :].reshape(-1, _ANCHORS, 4, grid, grid)
    steps = torch.arange(grid, dtype=outputs.dtype)
    centre = torch.stack([torch.sigmoid(t[:, :, 0]) + steps, torch.sigmoid(t[:, :, 1]) + steps[:, None]], dim=2)
    anchors = torch.tensor(ANCHORS, dtype=outputs.dtype)[None, :, :, None, None]
    half = 0.5 * anchors * torch.exp(t[:, :, 2:])
    return objectness, torch.softmax(logits, dim=2), stride * torch.cat([centre - half, centre + half], dim=2)


@dataclass(frozen=True)
class DetectionClaim(Claim):
    """The claim that some detected box has score and overlap above their thresholds (V4).

    Attributes:
        label: Class, or None: objectness alone.
        confidence: Threshold of objectness times class probability.
        iou: Threshold of the overlap with ``box``, or None: anywhere.
        box: x0, y0, x1, y1 in pixels, or None.
        stride: Pixels by grid cell.
    """

    label: int | None
    confidence: float
    iou: float | None
    box: tuple[float, float, float, float] | None
    stride: float
    grid: int

    def margins(self, outputs: torch.Tensor) -> torch.Tensor:
        """Return margins [B, 5 g g] by box."""
        objectness, classes, boxes = decode(outputs, self.stride)
        score = objectness if self.label is None else objectness * classes[:, :, self.label]
        margin = score - self.confidence
        if self.iou is not None:
            assert self.box is not None
            x0, y0, x1, y1 = boxes.unbind(2)
            across = (x1.clamp(max=self.box[2]) - x0.clamp(min=self.box[0])).clamp(min=0.0)
            down = (y1.clamp(max=self.box[3]) - y0.clamp(min=self.box[1])).clamp(min=0.0)
            common = across * down
            whole = (x1 - x0) * (y1 - y0) + (self.box[2] - self.box[0]) * (self.box[3] - self.box[1]) - common
            margin = torch.minimum(margin, common / whole - self.iou)
        return margin.reshape(len(outputs), -1)

    def margin(self, outputs: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        return self.margins(outputs).amax(dim=1)

    def query(self, outputs: np.ndarray) -> Query:
        with torch.no_grad():
            margins = self.margins(torch.from_numpy(np.asarray(outputs, np.float64))).numpy()
        margins = np.where(np.isnan(margins), -np.inf, margins)
        ranks = np.argsort(-margins, axis=1, kind="stable")[:, :_BEST]
        chosen = list(dict.fromkeys(ranks.T.ravel().tolist()))[:_CANDIDATES]
        rows = [self._rows(number) for number in chosen]
        return Query(np.concatenate(rows), np.zeros(sum(map(len, rows))), tuple(chosen))

    def _rows(self, number: int) -> np.ndarray:
        """Return a box's rows: objectness; class logit minus each other; tx, ty, tw, th and their negatives."""
        plane = self.grid * self.grid
        anchor, place = divmod(number, plane)

        def at(channel: int) -> int:
            return channel * plane + place

        width = HEAD * plane
        columns: list[tuple[int, int | None]] = [(at(anchor), None)]
        if self.label is not None:
            first = _ANCHORS + anchor * CLASSES
            columns += [(at(first + self.label), at(first + k)) for k in range(CLASSES) if k != self.label]
        rows = np.zeros((len(columns), width))
        for row, (plus, minus) in zip(rows, columns, strict=True):
            row[plus] = 1.0
            if minus is not None:
                row[minus] = -1.0
        if self.iou is None:
            return rows
        sides = np.zeros((4, width))
        sides[np.arange(4), [at(_ANCHORS * (1 + CLASSES) + 4 * anchor + k) for k in range(4)]] = 1.0
        return np.concatenate([rows, sides, -sides])

    def proved(self, query: Query, bounds: OutputBounds, boxes: Sequence[ParameterBox]) -> np.ndarray:
        size = len(query.rows) // len(query.about)
        margins = np.full(len(boxes), -np.inf)
        for k, number in enumerate(query.about):
            lower = bounds.lower[:, k * size : (k + 1) * size]
            with np.errstate(all="ignore"):
                margin = self._candidate(np.where(np.isnan(lower), -np.inf, lower), number)
            margins = np.fmax(margins, np.where(np.isfinite(margin), margin, -np.inf))
        return margins

    def _candidate(self, lower: np.ndarray, number: int) -> np.ndarray:
        """Return lower bounds [m] of one box's margin."""
        score = _sigmoid(lower[:, 0])[0]
        count = 1
        if self.label is not None:
            count += CLASSES - 1
            # probability 1 / (1 + sum of exp(other - own)), each difference at its largest
            score = score / (1.0 + np.exp(-lower[:, 1:count]).sum(axis=1)) * (1.0 - OWN_MARGIN)
        margin = score - self.confidence - OWN_MARGIN * (score + self.confidence)
        if self.iou is None:
            return margin
        return np.minimum(margin, self._overlap(lower[:, count : count + 4], -lower[:, count + 4 :], number))

    def _overlap(self, low: np.ndarray, high: np.ndarray, number: int) -> np.ndarray:
        """Return lower bounds [m] of the overlap minus its threshold, for ranges [m, 4] of tx, ty, tw, th."""
        assert self.iou is not None and self.box is not None
        anchor, place = divmod(number, self.grid * self.grid)
        row, column = divmod(place, self.grid)
        common, area_high = np.ones(len(low)), np.ones(len(low))
        for axis, step in ((0, column), (1, row)):
            centre_low = (_sigmoid(low[:, axis])[0] + step) * self.stride
            centre_high = (_sigmoid(high[:, axis])[1] + step) * self.stride
            factor = ANCHORS[anchor][axis] * self.stride
            side_low, side_high = factor * np.exp(low[:, 2 + axis]), factor * np.exp(high[:, 2 + axis])
            charge = OWN_MARGIN * (centre_high + side_high + abs(self.box[axis]) + abs(self.box[2 + axis]))
            first, last = self.box[axis], self.box[2 + axis]
            # the overlap of an interval of centre c and side s with [first, last]: each of the four ways
            # that it can be cut is monotone in s and monotone in c
            ways = [
                side_low,
                np.full(len(low), last - first),
                centre_low + 0.5 * side_low - first,
                last - centre_high + 0.5 * side_low,
            ]
            common = common * (np.min(ways, axis=0) - charge).clip(min=0.0)
            area_high = area_high * (side_high + charge)
        reference = (self.box[2] - self.box[0]) * (self.box[3] - self.box[1])
        # common / (area + reference - common) grows with the common part and falls with the area
        union = area_high + reference - common
        return common / (union * (1.0 + OWN_MARGIN)) - self.iou - OWN_MARGIN


def _sigmoid(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return lower and upper bounds of the sigmoid of float64 numbers."""
    value = 1.0 / (1.0 + np.exp(-x))
    return value * (1.0 - OWN_MARGIN), np.minimum(value * (1.0 + OWN_MARGIN), 1.0)


@dataclass(frozen=True)
class Detection(Property):
    """The property that a box of the class is detected on every image."""

    label: int | None
    confidence: float
    iou: float | None
    box: tuple[float, float, float, float] | None
    grid: int
    stride: float

    def sentence(self) -> str:
        what = "objectness" if self.label is None else f"score of class {self.label}"
        where = ""
        if self.iou is not None:
            reference = "the best box at the middle of the set" if self.box is None else f"the box {list(self.box)}"
            where = f" and an overlap (IoU) above {self.iou:g} with {reference}"
        return f"the detector finds a box with {what} above {self.confidence:g}{where}"

    def bind(self, pose_set: PoseBox, nominal: Callable[[], np.ndarray]) -> Claim:
        box = self.box
        if self.iou is not None and box is None:
            anywhere = DetectionClaim(self.label, self.confidence, None, None, self.stride, self.grid)
            outputs = torch.from_numpy(np.asarray(nominal(), np.float64))[None]
            best = int(anywhere.margins(outputs).argmax())
            corners = decode(outputs, self.stride)[2].movedim(2, -1).reshape(-1, 4)[best].tolist()
            box = (corners[0], corners[1], corners[2], corners[3])
        return DetectionClaim(self.label, self.confidence, self.iou, box, self.stride, self.grid)


# ---------------------------------------------------------------- the file
