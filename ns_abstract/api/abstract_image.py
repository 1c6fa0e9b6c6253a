"""The result of bounding: an abstract image."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.io.arguments import array_of, file_path
from ns_abstract.io.assumptions import Assumption
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import is_number, show, unusable
from ns_abstract.refine.linear_map import LinearImage, bounds_at, linear_image
from ns_abstract.refine.result import ExtraOutput, FrameResult, Leaves, TracePoint
from ns_abstract.report.figures import ShownUnits, metrics, number
from ns_abstract.report.files import save_frame
from ns_abstract.report.notebook import frame_html


@dataclass(frozen=True, eq=False)
class BoundResult:
    """An abstract image: bounds of every picture of a set of poses.

    Attributes:
        lower, upper: [H, W, 3] float32, rounded outward: every picture of the set lies between them, after background
            and clamp to [0, 1].
        witness_lower, witness_upper: [H, W, 3] float32, least and largest values of pictures of the set that were
            really rendered.
        image: [H, W, 3] float32, the picture at the middle of the set.
        parameters: Names, units and ranges of what varies.
        guarantee: "float32-sound", "real-sound", or "sampled" (this machine's arithmetic failed its self-check); with
            ", of the Gaussians alone" behind it where the run's model may draw more (``assume_splatfacto``).
        seconds: Time spent.
        trace: Error over time.
        cell_count: Cells that were bounded.
        plan: What was left out and why, one sentence each.
        bounded: False while no bound but [0, 1] is known.
        interrupted: Whether the work was ended by Ctrl-C or by ``on_progress``.
        cells: Linear sets of the cells, if they were kept.
        layers: "depth" and "accumulation", if they were asked for; see `ns_abstract.refine.result.ExtraOutput`.
        assumptions: What the bounds rest on, and where each choice came from.
    """

    lower: np.ndarray
    upper: np.ndarray
    witness_lower: np.ndarray
    witness_upper: np.ndarray
    image: np.ndarray
    parameters: ParameterBox
    guarantee: str
    seconds: float
    trace: tuple[TracePoint, ...]
    cell_count: int
    plan: tuple[str, ...]
    bounded: bool
    interrupted: bool
    cells: Leaves | None = field(default=None, repr=False)
    target_ratio: float = 1.05
    about: dict[str, Any] = field(default_factory=dict, repr=False)
    layers: Mapping[str, ExtraOutput] = field(default_factory=dict, repr=False)
    assumptions: tuple[Assumption, ...] = field(default=(), repr=False)

    @classmethod
    def of(cls, frame: FrameResult, **more: Any) -> BoundResult:
        """Return the result of one frame; ``more`` are the attributes that a frame does not have."""
        same = {f.name for f in fields(cls)} & {f.name for f in fields(FrameResult)} - {"cells"}
        return cls(
            **{name: getattr(frame, name) for name in same},
            parameters=frame.box,
            cell_count=frame.cells,
            cells=frame.leaves,
            **more,
        )

    @property
    def _figures(self) -> dict[str, float | None]:
        return metrics(self.frame)

    @property
    def mpg(self) -> float:
        """Mean pixel gap: mean over the pixels of the Euclidean length over RGB of upper - lower."""
        return self._figures["mpg"] or 0.0

    @property
    def xpg(self) -> float:
        """Largest pixel gap."""
        return self._figures["xpg"] or 0.0

    @property
    def mpg_witness(self) -> float:
        """Mean pixel gap of what was really rendered."""
        return self._figures["mpg_witness"] or 0.0

    @property
    def xpg_witness(self) -> float:
        """Largest pixel gap of what was really rendered."""
        return self._figures["xpg_witness"] or 0.0

    @property
    def ratio(self) -> float | None:
        """``mpg / mpg_witness``: how loose the bounds can be at most; None where nothing that was rendered differs."""
        return self._figures["ratio"]

    @property
    def frame(self) -> FrameResult:
        """The same as refinement gives it, for `ns_abstract.report`."""
        same = {f.name for f in fields(self)} & {f.name for f in fields(FrameResult)} - {"cells"}
        return FrameResult(
            index=0,
            box=self.parameters,
            cells=self.cell_count,
            leaves=self.cells,
            **{name: getattr(self, name) for name in same},
        )

    @property
    def status(self) -> str:
        """One of "done", "partial" (the time was over before the target) and "missing" (nothing is known)."""
        if not self.bounded:
            return "missing"
        ratio_is_met = self.mpg == 0.0 or (self.ratio is not None and self.ratio <= self.target_ratio)
        return "done" if ratio_is_met or not self.parameters.dimensions else "partial"

    def linear(self, box: Mapping[str, tuple[float, float]] | ParameterBox | None = None) -> LinearImage:
        """Return the linear bounds of the whole picture over the set or a part of it, one map for all cells.

        Args:
            box: Ranges (low, high) by name, in the units of ``parameters``; what is not named stays whole. None: the
                whole set.

        Returns:
            A_lower, A_upper [H, W, 3, d] and b_lower, b_upper [H, W, 3], for parameters scaled to [-1, 1] on the box.

        Raises:
            InputError: The cells were not kept, or the box is no part of the set.
        """
        if self.cells is None:
            fix = "call bound with keep_cells=True and enough time"
            raise InputError("found no linear sets of cells", field="cells", fix=fix)
        return linear_image(self.cells, self.lower, self.upper, sub_box(self.parameters, box))

    def at(self, p: Mapping[str, float] | Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
        """Return bounds of the picture at one pose, float32 [H, W, 3] each; those of the whole set without kept cells.

        Args:
            p: Values by name, or in the order of ``parameters``, in their units.

        Raises:
            InputError: It is no pose of the set.
        """
        return bounds_at(self.cells, self.lower, self.upper, point_of(self.parameters, p))

    def to_torch(self) -> Any:
        """Return the first layer for a verifier of networks; see `ns_abstract.refine.linear_map.LinearImage.to_torch`.

        Raises:
            InputError: The cells were not kept.
        """
        return self.linear().to_torch()

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write an npz with the names of the files of ns-abstract-render.

        Raises:
            InputError: ``path`` can name no file.
            OSError: The file cannot be written.
        """
        save_frame(file_path(path, "path"), self.frame, status=self.status, about=self.about)

    def _lines(self) -> list[str]:
        box = self.parameters
        units = ShownUnits.of(self.about.get("scene", {}))
        sides = [units.interval(*side) for side in zip(box.names, box.units, box.lower, box.upper, strict=True)]
        summary = f"mean gap {number(self.mpg)}, largest {number(self.xpg)}, ratio to real renders {number(self.ratio)}"
        return [
            summary if self.bounded else "no bounds but [0, 1] yet",
            f"{self.guarantee}; {self.cell_count} cells, {self.seconds:.1f} s; {self.status}",
            "; ".join(sides) or "one camera pose",
        ]

    def __str__(self) -> str:
        height, width, _ = self.lower.shape
        return "\n".join([f"abstract image, {width} x {height} pixels", *(f"  {line}" for line in self._lines())])

    def __repr__(self) -> str:
        return f"<BoundResult: {'; '.join(self._lines())}>"

    def _repr_html_(self) -> str:
        return frame_html(self.frame, self._lines())


def sub_box(whole: ParameterBox, given: Any) -> ParameterBox:
    """Return the part of a set that ``given`` names: a box, or ranges (low, high) by name; None: the whole set.

    Raises:
        InputError: It names other parameters, or reaches out of the set.
    """
    if given is None:
        return whole
    if isinstance(given, ParameterBox):
        given = dict(zip(given.names, zip(given.lower, given.upper, strict=True), strict=True))
    if not isinstance(given, Mapping):
        raise unusable(given, field="box", fix='give ranges by name, such as {"x": (0.0, 0.01)}')
    box = whole
    for name, ends in given.items():
        if name not in whole.names:
            raise unusable(name, field="box", fix=f"the parameters are {', '.join(whole.names)}")
        axis = whole.names.index(name)
        low, high = whole.lower[axis], whole.upper[axis]
        pair = [float(end) if isinstance(end, np.number) else end for end in ends] if isinstance(ends, Sequence) else []
        if len(pair) != 2 or not all(map(is_number, pair)) or not low <= pair[0] <= pair[1] <= high:
            raise InputError(
                f"found {show(ends)}", field=f"box.{name}", fix=f"give (low, high) within {low:g} and {high:g}"
            )
        box = box.replace(axis, float(pair[0]), float(pair[1]))
    return box


def point_of(whole: ParameterBox, values: Any) -> NDArray[np.float64]:
    """Return values [d] of a pose of the set, from numbers in the order of the parameters or by name.

    Raises:
        InputError: They are none, or outside of the set.
    """
    if isinstance(values, Mapping) and set(values) == set(whole.names):
        values = [values[name] for name in whole.names]
    numbers = array_of(values, np.float64)
    point = np.full(whole.dimensions, np.nan) if numbers is None else numbers.reshape(-1)
    if point.shape != (whole.dimensions,) or not whole.contains(point):
        ends = zip(whole.names, whole.lower, whole.upper, strict=True)
        sides = ", ".join(f"{name} from {low:g} to {high:g}" for name, low, high in ends)
        raise InputError("no pose of the set", field="p", fix=f"give {sides}" if sides else "give no numbers")
    return point
