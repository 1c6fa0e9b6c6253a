"""One cell of a search: concrete pictures with their margins, and bounds."""

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
    """Concrete pictures of one cell, with their margins, and what bounds say of it.

    Attributes:
        outputs: [n] of the model, of the first sample.
        bound: A lower bound of the margin; None: there is none, for the ``reason``.
        slopes: [d] what a cut along each parameter may gain.
        cost: The part of the margin that the width of the sets costs, about; NaN: nobody knows.
        cuts: Into how many parts to cut the cell along each parameter; empty: as slopes say.
        ends: Bounds over the cell's sub-boxes; None: there are none.
        parts: That tile the cell, where some of them are decided.
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
        """The sample with the smallest margin that is a number."""
        return int(np.argmin(np.where(np.isfinite(self.margins), self.margins, np.inf)))

    @property
    def poses(self) -> dict[bytes, np.ndarray]:
        """Those that were looked at, each once."""
        return {pose.tobytes(): pose for pose, _ in self.samples}

    def _where(self, holds: Callable[[float], bool]) -> set[bytes]:
        return {pose.tobytes() for (pose, _), margin in zip(self.samples, self.margins, strict=True) if holds(margin)}

    @property
    def broken(self) -> int:
        """Poses at which the property fails, for some scene."""
        return len(self._where(_fails))

    @property
    def undecided(self) -> int:
        """Poses with a margin of which nothing is known: it is no finite number."""
        return len(self._where(_unknown))

    @property
    def hopeless(self) -> bool:
        """Whether there is no pose at which the property was seen to hold for all scenes."""
        return len(self._where(_spoilt)) == len(self.poses)

    @property
    def proved(self) -> bool:
        """Whether bounds prove the property of the whole cell."""
        return self.bound is not None and self.bound > 0.0

    @property
    def wavers(self) -> bool:
        """Whether margins differ so much that there may be poses where the property fails."""
        finite = [margin for margin in self.margins if math.isfinite(margin)]
        return bool(finite) and 2.0 * min(finite) <= max(finite)

    @property
    def holds(self) -> bool:
        """Whether the property was seen to hold at the first pose, the middle, for all scenes."""
        return self.samples[0][0].tobytes() not in self._where(_spoilt)

    def fresh_poses(self, generator: np.random.Generator, corners: int, random: int) -> list[np.ndarray]:
        """At most so many corners and random poses that no sample has been yet."""
        box = self.box
        if not box.dimensions:
            return []
        poses = [np.where(generator.random(box.dimensions) < 0.5, box.lower, box.upper) for _ in range(corners)]
        fresh = {pose.tobytes(): pose for pose in (*poses, *box.sample(random, generator))}
        return [pose for key, pose in fresh.items() if key not in self.poses]

    def check_proof(self, box: ParameterBox, bound: float) -> None:
        """Compare the samples in ``box`` with a lower bound of the margin there (Q8).

        Raises:
            ContradictionError: The property fails at one of them: a proof and a counterexample cannot both be right.
        """
        for (pose, _), margin in self._within(box):
            if _fails(margin):
                raise _contradiction(box, f"at least {bound}", margin, pose)

    def check_refutation(self, box: ParameterBox, bound: float) -> Sample:
        """The first sample in ``box``, on which the margin is proved to be at most ``bound`` (Q8).

        Raises:
            ContradictionError: The property holds at one of them.
        """
        inside = self._within(box)
        for (pose, _), margin in inside:
            if 0.0 < margin < math.inf:
                raise _contradiction(box, f"at most {bound}", margin, pose)
        return inside[0][0]

    def _within(self, box: ParameterBox) -> list[tuple[Sample, float]]:
        """The samples in ``box``, with their margins."""
        pairs = zip(self.samples, self.margins, strict=True)
        return [(sample, margin) for sample, margin in pairs if box.contains(sample[0])]


def _contradiction(box: ParameterBox, proved: str, margin: float, pose: np.ndarray) -> ContradictionError:
    return ContradictionError(
        f"internal error: margin proved to be {proved} on {box.lower} to {box.upper}, found {margin} at {pose.tolist()}"
    )


def _fails(margin: float) -> bool:
    return math.isfinite(margin) and margin <= 0.0


def _unknown(margin: float) -> bool:
    return not math.isfinite(margin)


def _spoilt(margin: float) -> bool:
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
