"""The search for a proof or a counterexample, one block of cells at a time (docs/dev/design.md, V6).

The result of a block depends on the block alone. So the search's result is the same in whatever order, on however many
machines and after however many interruptions blocks are examined.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from ns_abstract.execution.cancellation import check_cancelled
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.io.errors import InputError
from ns_abstract.refine.protocol import SceneSample
from ns_abstract.verify.cell_samples import CellSamples, Sample, drawn, sample_key
from ns_abstract.verify.cells import Cell, CellGrid
from ns_abstract.verify.margin_descent import descend
from ns_abstract.verify.network import ImageSets
from ns_abstract.verify.part_proofs import CellPart, PartQuestion, divided_sets, narrowed
from ns_abstract.verify.picture_measures import SubBoxEnds
from ns_abstract.verify.picture_sets import PictureSets
from ns_abstract.verify.properties import Claim, LinearClaim, Query
from ns_abstract.verify.protocol import ComparedCuts, FrameImages, Model, NearImages, PartsModel, PixelSets
from ns_abstract.verify.search_results import FAILURES, BlockResult, FinishedCell, failure_text
from ns_abstract.verify.sub_box_proof import PixelWeights, SubBoxProof, margin_weights

#: Most cells examined together.
BLOCK = 8
#: Mean width of the linear sets, as a part of the range of a pixel, from which on a cell that can be cut is cut
#: without asking the network.
_HOPELESS = 0.1
#: The same of what the sets' width costs the margin to first order, as a part of the margin at the middle; the part
#: that the cuts aim at, the power of the width that it is about, and most parts at once.
_COSTLY, _AIM, _POWER, _MOST_PARTS = 0.35, 0.22, 1.6, 64
#: Rank of first cells: behind what is known to be near a proof, before what has been found to be far from one.
RANK_FIRST = 1e3
#: Rank of cells of which nothing is known, and of those in which the property fails in places: they are cut to the end,
#: and what is left shrinks slowly.
_RANK_UNKNOWN, _RANK_BROKEN = 1e6, 2e3
#: A cell is cut into four where its bound misses by more than so many times the margin that samples show.
_FAR = 4.0
#: Of a model without cost: the part of the margin that bounds of a cell's parts may miss it by, the least that cells
#: are narrowed by at once, and how many times the margin a bound is taken to miss where the property fails in places.
_LEFT, _NARROWEST, _AWAY = 0.7, 0.125, 4.0
#: Corners sampled in a cell without a proof, beside its two ends, and random poses.
_LATE, _RANDOM = 4, 2
#: Random poses sampled before the whole set is falsified as one cell; a smaller cell takes its part of these.
_WITNESSES = 64
#: Steps of the descent to a counterexample.
_STEPS = 6
#: Scenes of a set tried in a cell without a proof.
_SCENE_SAMPLES = 4
#: Why a cell is unknown where a sample's margin decides nothing.
NO_NUMBER = "the margin of a picture is no finite number"
#: Most branches on signs of units where a cell cannot be cut, and how many times the margin that samples show its bound
#: may miss for these to be tried.
_BRANCHES, _NEAR = 256, 3.0
#: A scene among so many, in their order, attacks a proof.
_ATTACKERS = 24


class Search:
    """Examines blocks of one frame.

    Args:
        every_unit: Whether each unit of the grid needs a verdict of its own where the property fails (PCP-S).
        cuts: Whether cells without a verdict are cut; else they are finished.
        cover: Proves wide cells sub-box by sub-box; None: they are cut.
        costly: Whether the model's bounds are expensive: cells with wide sets are then cut without them, and slopes of
            the margin are used.
    """

    def __init__(
        self,
        scene: FrameImages,
        model: Model,
        claim: Claim,
        grid: CellGrid,
        *,
        every_unit: bool = False,
        block: int = BLOCK,
        cuts: bool = True,
        cover: SubBoxProof | None = None,
        costly: bool = True,
    ) -> None:
        self.costly = costly
        self.scene, self.model, self.claim, self.grid = scene, model, claim, grid
        self.every_unit, self.cuts, self.cover = every_unit, cuts, cover
        self.block = block if cover is None else min(block, cover.block)
        self._latest: dict[tuple[bytes, int], np.ndarray] = {}
        self.varies = next(iter(scene.scene_samples(0)), None) is not None

    def _pictures_near(self, box: ParameterBox) -> FrameImages:
        """Return the pictures of a cell."""
        return self.scene.near(box) if isinstance(self.scene, NearImages) else self.scene

    def margins(
        self, samples: Sequence[Sample], scenes: Sequence[FrameImages] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return margins [s] and outputs [s, n] of samples, rendered by ``scenes`` or the set's pictures."""
        drawn_by = [self.scene] * len(samples) if scenes is None else scenes
        images = [drawn(scene, sample) for scene, sample in zip(drawn_by, samples, strict=True)]
        self._latest = {sample_key(sample): image for sample, image in zip(samples, images, strict=True)}
        return self._margins_of(samples, images)

    def _margins_of(self, samples: Sequence[Sample], images: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return `margins` of samples with pictures ``images``."""
        outputs = np.asarray(self.model.outputs(np.stack(images)), np.float64)
        with torch.no_grad():
            margin = self.claim.margin(torch.from_numpy(outputs), torch.from_numpy(np.stack([p for p, _ in samples])))
        return margin.numpy(), outputs

    def examine(self, block: Sequence[Cell]) -> BlockResult:
        """Return the result of the cells.

        Raises:
            ContradictionError: A cell was proved and has a counterexample: the program has a fault.
            WorkCancelledError: The deadline is over (`ns_abstract.execution.cancellation`).
        """
        begin = time.perf_counter()
        boxes = [self.grid.box_of(cell) for cell in block]
        samples = [CellSamples(cell, box, self._pictures_near(box)) for cell, box in zip(block, boxes, strict=True)]
        self._sample(samples, self._first_samples)
        by_parts = isinstance(self.model, PartsModel)
        if by_parts:
            # parts of broken cells may hold
            self._sample([cell for cell in samples if cell.broken], self._corners)
        open_cells = [c for c in samples if not (c.undecided or (c.broken and (c.hopeless or not by_parts)))]
        self._bound(open_cells)
        self._sample([cell for cell in open_cells if cell.proved], self._attack)
        self._sample([cell for cell in samples if cell.parts], self._attack_parts)
        failing = [cell for cell in open_cells if not (cell.proved or cell.broken)]
        if self.costly:
            self._sample(failing, self._more_samples)
        # a cell is falsified as a whole where nothing else is seen
        self._sample([cell for cell in samples if cell.broken and cell.hopeless], self._samples_that_may_hold)
        self._descend_worst_cell(failing)
        if self.varies:
            self._vary(failing)
        leaves, children = self._verdicts(samples)
        seconds = time.perf_counter() - begin
        # cells of one rank are examined together
        children.sort(key=lambda child: child[0])
        parts = [children[i : i + self.block] for i in range(0, len(children), self.block)]
        return BlockResult(
            leaves=tuple(replace(leaf, seconds=seconds / len(samples)) for leaf in leaves),
            blocks=tuple(tuple(cell for _, cell in part) for part in parts),
            ranks=tuple(part[0][0] for part in parts),
            samples=tuple((cell.cell, cell.holds) for cell in samples),
            bounded=sum(cell.bound is not None for cell in samples),
            seconds=seconds,
        )

    # ---------------------------------------------------------------- concrete poses

    def _first_samples(self, cell: CellSamples) -> list[Sample]:
        """Return the middle, and two opposite corners if they cost less than bounds."""
        return [(cell.box.middle, None), *(self._corners(cell) if self.costly else ())]

    def _corners(self, cell: CellSamples) -> list[Sample]:
        """Return those of two opposite corners that have not been sampled."""
        ends = [np.array(end) for end in (cell.box.lower, cell.box.upper) if end]
        return [(end, None) for end in ends if end.tobytes() not in cell.poses]

    def _attack(self, cell: CellSamples) -> list[Sample]:
        """Return a random pose and scene: every proof is attacked."""
        generator = _generator(cell.cell)
        poses = list(cell.box.sample(1, generator)) if cell.box.dimensions else []
        if not self.varies:
            return [(pose, None) for pose in poses]
        scene_sample = next(itertools.islice(self._scene_samples(cell), int(generator.integers(_ATTACKERS)), None))
        return [(pose, scene_sample) for pose in poses or [cell.box.middle]]

    def _attack_parts(self, cell: CellSamples) -> list[Sample]:
        """Return a random pose of one proved part, and the middle of every refuted part."""
        generator = _generator(cell.cell)
        proved = [part.cell for part in cell.parts if part.verdict == "certified"]
        refuted = [self.grid.box_of(part.cell) for part in cell.parts if part.verdict == "falsified"]
        poses = [box.middle for box in refuted]
        if proved:
            poses += list(self.grid.box_of(proved[int(generator.integers(len(proved)))]).sample(1, generator))
        return [(pose, None) for pose in poses if pose.tobytes() not in cell.poses]

    def _scene_samples(self, cell: CellSamples) -> Iterator[SceneSample]:
        return self.scene.scene_samples(int(_generator(cell.cell).integers(1 << 31)))

    def _more_samples(self, cell: CellSamples) -> list[Sample]:
        """Return corners and random poses that have not been sampled."""
        return [(pose, None) for pose in cell.fresh_poses(_generator(cell.cell), _LATE, _RANDOM)]

    def _samples_that_may_hold(self, cell: CellSamples) -> list[Sample]:
        """Return poses at which the property may hold after all, more for larger cells."""
        if self.every_unit:
            return []
        number = math.ceil(_WITNESSES * cell.cell.volume / self.grid.volume)
        corners, least = (0, 0) if self.costly else (_LATE, _RANDOM)
        poses = cell.fresh_poses(_generator(cell.cell), corners, max(least, number if number > 1 else 0))
        return [(pose, None) for pose in poses]

    def _sample(self, cells: Sequence[CellSamples], choose: Callable[[CellSamples], list[Sample]]) -> None:
        """Add the samples that ``choose`` returns to the cells."""
        chosen = [choose(cell) for cell in cells]
        # neighbours share corners
        unique = {
            sample_key(sample): (sample, cell.scene)
            for cell, samples in zip(cells, chosen, strict=True)
            for sample in samples
        }
        if not unique:
            return
        margins, outputs = self.margins(*zip(*unique.values(), strict=True))
        place = {key: k for k, key in enumerate(unique)}
        for cell, samples in zip(cells, chosen, strict=True):
            cell.samples += samples
            cell.margins += [float(margins[place[sample_key(sample)]]) for sample in samples]
            if cell.outputs is None:
                cell.outputs = outputs[place[sample_key(samples[0])]]

    def _vary(self, cells: Sequence[CellSamples]) -> None:
        """Attack every sampled pose of every unproved cell by other scenes of the set (V12).

        The stored scene is moved to the ends of its ranges along the signs of the margin's gradient, then the worst
        scene half as far. The worst scene of all is tried at the other poses, where it mostly breaks the property, too.
        """
        scene_samples: list[SceneSample] = []
        for cell in sorted(cells, key=lambda c: c.margins[c.worst]):
            pose = cell.samples[cell.worst][0]
            tried = [*itertools.islice(self._scene_samples(cell), _SCENE_SAMPLES), *scene_samples]
            margins = self._add_samples(cell, [(pose, scene_sample) for scene_sample in tried])
            least = min(range(len(tried)), key=lambda k: margins[k] if math.isfinite(margins[k]) else math.inf)
            best, margin = tried[least], margins[least]
            # colours that are clamped at an end of their range have no slope there
            for start, size in ((best.nearest, 2.0), (None, 1.0)):
                if margin <= 0.0:
                    break
                moved = (start or best).signed_gradient_step(cell.box, pose, self._loss, size)
                (image,) = self._add_samples(cell, [moved])
                if image < margin:
                    (pose, best), margin = moved, image
            scene_samples = [best]
            self._add_samples(cell, [(other, best) for key, other in cell.poses.items() if key != pose.tobytes()])

    def _add_samples(self, cell: CellSamples, samples: list[Sample]) -> list[float]:
        """Add samples to a cell and return their margins."""
        self._sample([cell], lambda _: samples)
        return cell.margins[len(cell.margins) - len(samples) :]

    def _loss(self, picture: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
        """Return the margin's negative."""
        return -self.claim.margin(self.model.differentiable(picture[None]), values[None])[0]

    def _descend_worst_cell(self, cells: Sequence[CellSamples]) -> None:
        """Descend the margin by projected gradients in the cell that came closest to a counterexample.

        With one parameter, and where a slope costs far more than bounds do, samples do better than gradients.
        """
        hopeful = [cell for cell in cells if not cell.broken and cell.wavers]
        if not self.costly or self.grid.box.dimensions < 2 or not hopeful:
            return
        cell = min(hopeful, key=lambda c: c.margins[c.worst])
        step = descend(cell.box, cell.samples[cell.worst][0], self._margin_at, _STEPS, lambda margin: margin <= 0.0)
        if step is not None:
            self._sample([cell], lambda c: [(step, None)])

    def _margin_at(self, values: torch.Tensor) -> torch.Tensor:
        """Return the margin at parameter values [d], differentiable."""
        outputs = self.model.differentiable(self.scene.differentiable(values)[None])
        return self.claim.margin(outputs, values[None])[0]

    # ---------------------------------------------------------------- bounds

    def _bound(self, cells: Sequence[CellSamples]) -> None:
        """Bound the margin of each cell; a cell without a bound gets the reason, and perhaps how to cut it."""
        usable: list[CellSamples] = []
        parts: list[Any] = []
        for cell in cells:
            check_cancelled()
            try:
                (linear, lower, upper, cell.slopes), cell.ends = self._sets(cell)
            except InputError:
                raise
            except FAILURES as error:
                cell.reason = failure_text(error)
                continue
            sets = PictureSets(cell.box, linear, lower, upper)
            if not sets.sane:
                cell.reason = "the image's bounds are not finite or cross"
            elif (
                self.costly
                and (self._splittable(cell.cell) or self._coverable(cell.cell))
                and self._too_wide(cell, sets)
            ):
                cell.reason = "the image's bounds are too wide"
                if self._coverable(cell.cell):
                    self._prove_by_sub_boxes(cell)
            else:
                usable.append(cell)
                parts.append((*linear, lower, upper, cell.box, cell.outputs))
        if not usable:
            return
        *arrays, boxes, outputs = zip(*parts, strict=True)
        stacked = [np.stack(values) for values in arrays]
        try:
            query = self.claim.query(np.stack(outputs))
            inputs = self.model.input_sets(tuple(stacked[:4]), stacked[4], stacked[5])
            margins = np.array(self.claim.proved(query, self.model.bound(inputs, query), boxes), np.float64)
            for place, cell in enumerate(usable):
                groups = self._branching(cell, float(margins[place]))
                if self._divisible(cell.cell) and not margins[place] > 0.0:
                    cell.parts = self._decided_parts(cell, query, inputs[place : place + 1])
                if groups:
                    better = self.model.branch(inputs[place : place + 1], query, groups, _BRANCHES)
                    margins[place] = max(margins[place], better)
        except InputError:
            raise
        except FAILURES as error:
            margins, reason = np.full(len(usable), -np.inf), failure_text(error)
        else:
            reason = "the network's bounds are not finite"
        for cell, margin in zip(usable, margins.tolist(), strict=True):
            # infinite or NaN bounds prove nothing
            if math.isfinite(margin):
                cell.bound = margin
            else:
                cell.reason = reason

    def _divisible(self, cell: Cell) -> bool:
        return isinstance(self.model, PartsModel) and self._splittable(cell)

    def _sets(self, cell: CellSamples) -> tuple[PixelSets, SubBoxEnds | None]:
        """Return sets of a cell, and bounds over its sub-boxes, or None."""
        if self._divisible(cell.cell):
            return divided_sets(cell.scene, cell.cell, cell.box)
        return cell.scene.linear_sets(cell.box), None

    def _decided_parts(self, cell: CellSamples, query: Query, images: ImageSets) -> list[CellPart]:
        """Return parts that tile a cell if some are decided (Q8); an open part is bounded again by itself."""
        assert isinstance(self.model, PartsModel)
        question = PartQuestion(self.claim, self.model, query, refute=not self.every_unit)
        parts: list[CellPart] = []
        for part in question.parts(images, cell.cell, cell.box, ends=cell.ends):
            finer = []
            if part.verdict is None:
                within = narrowed(cell.scene, cell.cell, part.cell, cell.ends)
                finer = question.bounded(within, self.grid, part.cell)
            parts += finer or [part]
        return parts

    def _too_wide(self, cell: CellSamples, sets: PictureSets) -> bool:
        """Return whether the sets are too wide for the network's bounds: an estimate by the margin's gradient."""
        weights = self._weights(cell)
        cell.cost = math.nan if weights is None else weights.cost(sets)
        return float(sets.widths.mean()) > _HOPELESS or cell.cost > _COSTLY

    def _coverable(self, cell: Cell) -> bool:
        return self.cover is not None and len(cell.first) > 1 and cell.volume > 1

    def _prove_by_sub_boxes(self, cell: CellSamples) -> None:
        """Bound a cell sub-box by sub-box, or find how to cut it."""
        weights = self._weights(cell)
        if weights is None or self.cover is None:
            return
        assert cell.outputs is not None
        try:
            outcome = self.cover.prove(cell.box, cell.outputs, weights)
        except InputError:
            raise
        except FAILURES as error:
            cell.reason = failure_text(error)
            return
        if outcome.margin is not None and math.isfinite(outcome.margin):
            cell.bound = outcome.margin
        else:
            cell.cuts = outcome.cuts

    def _weights(self, cell: CellSamples) -> PixelWeights | None:
        """Return the margin's gradient at the middle, relative to the margin; None where it is not finite."""
        values = cell.box.middle
        image = self._latest.get(sample_key((values, None)))
        image = drawn(self.scene, (values, None)) if image is None else image
        return margin_weights(self.model, self.claim, image, values)

    def _branching(self, cell: CellSamples, margin: float) -> Sequence[Sequence[int]]:
        """Return the claim's groups if only branching may prove a cell that cannot be cut further; else none (N16)."""
        if not isinstance(self.claim, LinearClaim) or self._splittable(cell.cell) or cell.broken or cell.undecided:
            return ()
        near = -_NEAR * min(cell.margins, default=0.0) < margin <= 0.0
        return self.claim.groups if near else ()

    def _splittable(self, cell: Cell) -> bool:
        return self.cuts and cell.volume > 1

    # ---------------------------------------------------------------- verdicts

    def _verdicts(self, cells: Sequence[CellSamples]) -> tuple[list[FinishedCell], list[tuple[float, Cell]]]:
        leaves: list[FinishedCell] = []
        children: list[tuple[float, Cell]] = []
        for cell in cells:
            if cell.bound is not None and cell.bound > 0.0:
                cell.check_proof(cell.box, cell.bound)
                if not cell.undecided:
                    leaves.append(FinishedCell(cell.cell, "certified", cell.bound, 0.0))
                    continue
            bound, reason = (None, NO_NUMBER) if cell.undecided else (cell.bound, cell.reason or "the finest cell")
            rank = self._rank(cell, bound)
            # where no number is known of a picture, bounds decide nothing
            parts = [] if cell.undecided else cell.parts
            for part in parts:
                within = self.grid.box_of(part.cell)
                if part.verdict is None:
                    children.append((rank, part.cell))
                elif part.verdict == "certified":
                    cell.check_proof(within, part.margin)
                    leaves.append(FinishedCell(part.cell, "certified", part.margin, 0.0))
                else:
                    leaves.append(self._counterexample(part.cell, within, cell.check_refutation(within, part.margin)))
            if parts:
                continue
            hopeless = cell.hopeless and not self.every_unit
            if self._splittable(cell.cell) and not hopeless:
                if cell.cuts and not cell.broken:
                    parts = self.grid.cut(cell.cell, cell.cuts)
                else:
                    scene = cell.scene
                    gains = scene.cut_gains(cell.box) if isinstance(scene, ComparedCuts) else cell.slopes
                    parts = self.grid.divide(cell.cell, gains, *self._cuts(cell, bound))
                children += [(rank, part) for part in parts]
            elif cell.broken:
                leaves.append(self._counterexample(cell.cell, cell.box, cell.samples[cell.worst]))
            else:
                undecided = cell.undecided > 0
                leaves.append(FinishedCell(cell.cell, "unknown", bound, 0.0, reason=reason, undecided=undecided))
        return leaves, children

    def _rank(self, cell: CellSamples, bound: float | None) -> float:
        """Return how many times the bound misses the margin of samples: about as many cuts are needed.

        Cells nearest to a proof go deep first, and return from where the property is about to fail.
        """
        share = cell.cell.volume / self.grid.volume
        if not self.costly:
            margin, away = cell.margins[cell.worst], _AWAY
            if bound is not None and 0.0 < margin < math.inf and not cell.broken:
                away = max(1.0, (margin - bound) / margin)
            # the cells that it takes for a part of the set, about; first cells rank as if they were nearly proved
            return RANK_FIRST * away / (share * math.prod(self.grid.coarse))
        if cell.broken:
            return _RANK_BROKEN - math.log2(share)
        margin = cell.margins[cell.worst]
        if not 0.0 < margin < math.inf:
            return _RANK_UNKNOWN * (1.0 + share)
        if bound is None:
            # the cuts are made for the parts to be near a proof
            return min(cell.cost, RANK_FIRST / 2.0) if math.isfinite(cell.cost) else _RANK_UNKNOWN * (1.0 + share)
        return min((margin - bound) / margin, _RANK_UNKNOWN)

    def _cuts(self, cell: CellSamples, bound: float | None) -> tuple[float, int]:
        """Return how many times narrower a cell's parts should be for a proof, and the largest number of parts."""
        if cell.broken:
            return 0.25, 4
        if bound is None:
            return ((_AIM / cell.cost) ** (1.0 / _POWER), _MOST_PARTS) if cell.cost > _COSTLY else (0.25, 4)
        margin = cell.margins[cell.worst]
        if self.costly:
            return (0.25, 4) if margin - bound > _FAR * margin else (0.5, 2)
        # bounds between here and a proof would be wasted
        return max(_NARROWEST, min(0.5, (_LEFT * margin / (margin - bound)) ** (1.0 / _POWER))), _MOST_PARTS

    def _counterexample(self, cell: Cell, box: ParameterBox, sample: Sample) -> FinishedCell:
        """Return the cell, falsified by a sample in ``box``, which is rendered and classified once more."""
        values, scene_sample = sample
        image = drawn(self.scene, sample)
        margins, outputs = self._margins_of([sample], [image])
        margin = float(margins[0])
        if not -math.inf < margin <= 0.0 or not box.contains(values):
            return FinishedCell(cell, "unknown", None, 0.0, reason="a counterexample was not confirmed", undecided=True)
        return FinishedCell(
            cell,
            "falsified",
            margin,
            0.0,
            counterexample=tuple(values.tolist()),
            image=image,
            outputs=outputs[0],
            scene=None if scene_sample is None else scene_sample.arrays,
        )


def _generator(cell: Cell) -> np.random.Generator:
    return np.random.default_rng([*cell.first, *cell.past])
