"""Rendered pictures of one cell of a search with their margins, and the cell's bounds."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ns_abstract.execution.cancellation import check_cancelled
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.refine.protocol import SceneSample
from ns_abstract.verify.cells import Cell
from ns_abstract.verify.part_proofs import CellPart
from ns_abstract.verify.picture_measures import SubBoxEnds
from ns_abstract.verify.protocol import FrameImages
from ns_abstract.verify.search_results import ContradictionError

#: A pose, and the scene of the set that is shown; None: the stored one, or the nearest to it.
Sample = tuple[np.ndarray, "SceneSample | None"]


@dataclass
class CellSamples:
    """Rendered pictures of one cell with their margins, and the cell's bounds.

    Attributes:
        outputs: [n] of the model, for the first sample.
        bound: A lower bound of the margin; None: there is none, for the ``reason``.
        slopes: [d] estimated gain of a cut along each parameter.
        cost: Estimated loss of the margin by the width of the sets; NaN: unknown.
        cuts: Number of parts to cut the cell into along each parameter; empty: decided by slopes.
        ends: Bounds over the cell's sub-boxes; None: there are none.
        parts: Parts that tile the cell, where some of them are decided.
    """

    cell: Cell
    box: ParameterBox
    scene: FrameImages
    samples: list[Sample] = field(default_factory=list)
    margins: list[float] = field(default_factory=list)
    outputs: np.ndarray | None = None
    bound: float | None = None
    reason: str = ""
    slopes: np.ndarray = field(init=False)
    cost: float = math.nan
    cuts: tuple[int, ...] = ()
    ends: SubBoxEnds | None = None
    parts: list[CellPart] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.slopes = np.zeros(self.box.dimensions)

    @property
    def worst(self) -> int:
        """The number of the sample with the smallest margin that is a number."""
        return int(np.argmin(np.where(np.isfinite(self.margins), self.margins, np.inf)))

    @property
    def poses(self) -> dict[bytes, np.ndarray]:
        """The sampled poses, each once."""
        return {pose.tobytes(): pose for pose, _ in self.samples}

    def _where(self, holds: Callable[[float], bool]) -> set[bytes]:
        return {pose.tobytes() for (pose, _), margin in zip(self.samples, self.margins, strict=True) if holds(margin)}

    @property
    def broken(self) -> int:
        """The number of poses at which the property fails for some scene."""
        return len(self._where(_fails))

    @property
    def undecided(self) -> int:
        """The number of poses with a margin that is not finite."""
        return len(self._where(_not_finite))

    @property
    def hopeless(self) -> bool:
        """Whether the property holds for all scenes at no sampled pose."""
        return len(self._where(_not_positive)) == len(self.poses)

    @property
    def proved(self) -> bool:
        """Whether bounds prove the property of the whole cell."""
        return self.bound is not None and self.bound > 0.0

    @property
    def wavers(self) -> bool:
        """Whether margins vary so much that there may be poses where the property fails."""
        finite = [margin for margin in self.margins if math.isfinite(margin)]
        return bool(finite) and 2.0 * min(finite) <= max(finite)

    @property
    def holds(self) -> bool:
        """Whether the property holds for all sampled scenes at the first pose, the middle."""
        return self.samples[0][0].tobytes() not in self._where(_not_positive)

    def fresh_poses(self, generator: np.random.Generator, corners: int, random: int) -> list[np.ndarray]:
        """Return at most ``corners`` corners and ``random`` random poses that have not been sampled."""
        box = self.box
        if not box.dimensions:
            return []
        poses = [np.where(generator.random(box.dimensions) < 0.5, box.lower, box.upper) for _ in range(corners)]
        fresh = {pose.tobytes(): pose for pose in (*poses, *box.sample(random, generator))}
        return [pose for key, pose in fresh.items() if key not in self.poses]

    def check_proof(self, box: ParameterBox, bound: float) -> None:
        """Check the samples in ``box`` against a proved lower bound of the margin there (Q8).

        Raises:
            ContradictionError: The property fails at one of them: a proof and a counterexample cannot both be right.
        """
        for (pose, _), margin in self._within(box):
            if _fails(margin):
                raise _contradiction(box, f"at least {bound}", margin, pose)

    def check_refutation(self, box: ParameterBox, bound: float) -> Sample:
        """Return the first sample in ``box``, over which the margin is proved to be at most ``bound`` (Q8).

        Raises:
            ContradictionError: The property holds at one of them.
        """
        inside = self._within(box)
        for (pose, _), margin in inside:
            if 0.0 < margin < math.inf:
                raise _contradiction(box, f"at most {bound}", margin, pose)
        return inside[0][0]

    def _within(self, box: ParameterBox) -> list[tuple[Sample, float]]:
        """Return the samples in ``box`` with their margins."""
        pairs = zip(self.samples, self.margins, strict=True)
        return [(sample, margin) for sample, margin in pairs if box.contains(sample[0])]


def _contradiction(box: ParameterBox, proved: str, margin: float, pose: np.ndarray) -> ContradictionError:
    return ContradictionError(
        f"internal error: margin proved to be {proved} on {box.lower} to {box.upper}, found {margin} at {pose.tolist()}"
    )


def _fails(margin: float) -> bool:
    return math.isfinite(margin) and margin <= 0.0


def _not_finite(margin: float) -> bool:
    return not math.isfinite(margin)


def _not_positive(margin: float) -> bool:
    return not 0.0 < margin < math.inf


def sample_key(sample: Sample) -> tuple[bytes, int]:
    """Return a key that is equal for equal pictures; scene samples are distinguished by identity."""
    pose, scene_sample = sample
    return pose.tobytes(), id(scene_sample)


def drawn(scene: FrameImages, sample: Sample) -> np.ndarray:
    """Return the picture of a sample."""
    check_cancelled()
    values, scene_sample = sample
    return scene.image(values) if scene_sample is None else scene.image(values, scene_sample)
