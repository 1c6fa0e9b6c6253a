"""Chooses the initial partition of a refinement: the cells that cover the set before any is split."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ns_abstract.refine.box_splitter import BoxSplitter, SubBox
from ns_abstract.refine.frame_tiles import FrameTiles, context_bytes
from ns_abstract.refine.goal import RefinementGoal
from ns_abstract.refine.inner import InnerBound
from ns_abstract.refine.leaves import linear_bytes
from ns_abstract.refine.protocol import Bounds
from ns_abstract.refine.tuning import TUNING, Tuning


class Partition(NamedTuple):
    """Sub-boxes that cover the set, and the bounds of a sub-box that was ``tried``."""

    parts: list[SubBox]
    tried: SubBox
    bounds: Bounds


class InitialPartition:
    """Chooses the number of initial cells by the goal, within the time and memory."""

    def __init__(
        self, tiles: FrameTiles, splitter: BoxSplitter, inner: InnerBound, goal: RefinementGoal, tuning: Tuning = TUNING
    ) -> None:
        self.tiles, self.splitter, self.inner, self.goal, self.tuning = tiles, splitter, inner, goal, tuning

    def choose(self) -> Partition:
        """Return the partition."""
        frame, parts = self.tiles.frame, [self.splitter.whole]
        if frame.tilewise or not frame.box.dimensions:
            return Partition(parts, parts[0], self._probe(parts[0])[0])
        if frame.box.dimensions == 1:
            return self._equal_parts()
        history = [parts]
        motion = np.nan_to_num(np.array(frame.motion(frame.box), np.float64), nan=0.0)
        while motion.max() > self.tuning.first_motions and 2 * len(parts) <= self.tuning.most_initial_cells:
            axis = int(np.argmax(motion))
            parts = self.splitter.cut_all(parts, axis)
            motion[axis] *= 0.5
            history.append(parts)
        first = parts[len(parts) // 2]
        probe, allowed = self._probe(first)
        if len(parts) <= allowed:
            return self._finer_parts(Partition(parts, first, probe), allowed)
        while len(parts) > allowed and len(history) > 1:
            history.pop()
            parts = history[-1]
        return Partition(parts, first, probe)

    def _finer_parts(self, now: Partition, allowed: float) -> Partition:
        """Return parts halved along the axis of most variation while the excess of a middle cell is too large."""
        tuning = self.tuning
        aim = tuning.aim_multiple * self.goal.excess(self.inner.mean_gap)
        best, least, idle = now, np.inf, 0
        while True:
            excess = self._beyond(now)
            if excess <= aim:
                return now
            if self._helped(excess, least, tuning.helpful_halving ** (idle + 1)):
                best, least, idle = now, excess, 0
            else:
                idle += 1
            patient = idle == 0 or (idle < tuning.patience and excess > tuning.patient_multiple * aim)
            if not patient or 2 * len(now.parts) > min(allowed, tuning.most_initial_cells):
                return best
            axis = self.splitter.steepest_axis(now.tried.box, now.bounds.slopes)
            parts = self.splitter.cut_all(now.parts, axis)
            first = parts[len(parts) // 2]
            probe, allowed = self._probe(first)
            now = Partition(parts, first, probe)

    def _equal_parts(self) -> Partition:
        """Return equal parts of one parameter, as many as the excess of a middle cell demands."""
        tuning, frame, whole = self.tuning, self.tiles.frame, self.splitter.whole
        motion = float(np.nan_to_num(frame.motion(frame.box)[0], nan=0.0))
        # odd: the middle of the set, which is rendered, is that of a part
        count, before = 2 * int(min(motion / tuning.first_motion, tuning.most_initial_cells) / 2.0) + 1, np.inf
        goal = replace(self.goal, ratio=max(self.goal.ratio, tuning.aim_ratio))
        if count > 1 and self.tiles.count >= tuning.sampled_tiles:
            count = self._sampled_count(count, goal)
        finer: int | None = None
        while True:
            part = self.splitter.cut(whole, 0, count)[count // 2]
            probe, affordable = self._probe(part)
            if affordable <= 1.0:
                return Partition([whole], part, probe)
            excess = self._beyond(Partition([], part, probe))
            aim = tuning.aim_share * goal.excess(self.inner.mean_gap)
            most = int(min(affordable, tuning.most_initial_cells))
            helped = self._helped(excess, before, tuning.helpful_share)
            # it falls with the square of the width, and of wider cells faster, where intervals take the place of forms
            share = min(excess / aim, 1e6) if aim > 0.0 < excess else 1.0
            wanted = math.ceil(count * (math.sqrt(share) if share > 1.0 else share**0.25))
            if finer is not None:
                # known to be fine enough
                wanted = min(wanted, finer)
            elif wanted < tuning.coarser_share * count:
                # it is tried, so it may be as coarse as the square says
                finer, count = count, math.ceil(count * math.sqrt(share)) | 1
                continue
            if wanted < 2 * count or 2 * count > most or not helped:
                parts = self.splitter.cut(whole, 0, max(1, min(wanted if helped else count, most)))
                return Partition(parts, part, probe)
            count, before = 2 * count + 1, excess

    def _sampled_count(self, count: int, goal: RefinementGoal) -> int:
        """Return an odd number of equal parts, at most twice ``count``, for little enough excess in sampled tiles."""
        tuning, inner = self.tuning, self.inner
        random, tiles = np.random.default_rng(0), self.tiles
        places = np.sort(random.choice(tiles.count, tiles.count // tuning.tiles_a_sample, replace=False))
        part = self.splitter.cut(self.splitter.whole, 0, count)[count // 2]
        bounds = tiles.frame.bound(part.box, tiles.numbers(places), None, False)
        excess = inner.beyond(part, bounds.lower, bounds.upper, places)
        aim = tuning.aim_share * goal.excess(tiles.mean_gap(inner.lower[places], inner.upper[places], places))
        # it falls with the square of the width
        return math.ceil(count * math.sqrt(min(excess / aim, 4.0))) | 1 if aim > 0.0 < excess else count

    def _helped(self, excess: float, before: float, share: float) -> bool:
        """Return whether smaller cells left at most ``share`` of the excess ``before``, or it may be clipped."""
        if excess <= share * before or before == math.inf:
            return True
        most = self.tiles.mean_gap(np.zeros_like(self.inner.image), np.ones_like(self.inner.image))
        return before >= self.tuning.clipped_share * most

    def _beyond(self, partition: Partition) -> float:
        """Return the excess of the tried sub-box: its MPG beyond that of renders."""
        return self.inner.beyond(partition.tried, partition.bounds.lower, partition.bounds.upper)

    def _probe(self, part: SubBox) -> tuple[Bounds, float]:
        """Return bounds of ``part``, and the number of such cells that time and memory allow."""
        started = time.perf_counter()
        tiles = self.tiles
        probe = tiles.frame.bound(part.box, tiles.numbers(None), None, tiles.keep_linear)
        seconds = time.perf_counter() - started
        allowed = self.tuning.initial_time_share * self.goal.seconds / max(seconds, self.tuning.least_seconds)
        if self.goal.cells is not None:
            allowed = self.goal.cells / 2
        size = probe.lower.nbytes + probe.upper.nbytes + context_bytes(probe.context) + linear_bytes(probe)
        # half: cells that are split need room, too
        return probe, max(1.0, min(allowed, 0.5 * self.goal.leaf_bytes / size))
