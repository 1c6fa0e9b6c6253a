"""Attacks an abstract image: searches its set of poses for a rendered image outside its bounds, at tolerance zero.

The result is a lower bound of the violation. The poses tried are given ones, the middle and corners of the box, random
ones, and two searches where an image comes closest to a bound relative to the gap: projected gradient ascent through a
differentiable twin of the renderer, and bisection towards jumps, whose two sides are rendered.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from ns_abstract.geometry.box import Float64Array, ParameterBox
from ns_abstract.verify.attack.violations import KEPT, STRATEGIES, Attack, Violation, _severity
from ns_abstract.verify.margin_descent import descend

#: Parameter values [d] to an image [H, W, 3].
Render = Callable[[Float64Array], NDArray[np.floating]]
#: Parameter values [d] and pixels [k, 2] (row, column) to colours [k, 3].
RenderPixels = Callable[[Float64Array, NDArray[np.int64]], NDArray[np.floating]]
#: The same in torch, differentiable with respect to the values.
DifferentiableRender = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]


_CORNERS = 64
# of the poses left after the given ones
_SHARES = {"corners": 0.4, "random": 0.4, "ascent": 0.6}
_ASCENT_STEPS = 16
_LINE = 9
_HALVINGS = 60


@dataclass(frozen=True)
class SuspectTuning:
    """When an attack assumes that a function jumps; whatever it reports is rendered again."""

    #: A continuous function falls by about 2^-16 in so many halvings; what falls less than this jumps.
    suspect_halvings: int = 16
    suspect_fall: float = 2.0**-11


_TUNING = SuspectTuning()


class _BudgetSpentError(Exception):
    """The budget is spent."""


class _ImageExtremes:
    """Compares images with the bounds and keeps the extreme values with their poses."""

    def __init__(
        self, lower: ArrayLike, upper: ArrayLike, box: ParameterBox, render: Render, limit: int, deadline: float
    ) -> None:
        self.lower = np.asarray(lower, np.float64)
        self.upper = np.asarray(upper, np.float64)
        if self.lower.shape != self.upper.shape or self.lower.ndim != 3 or self.lower.shape[2] != 3:
            raise ValueError(f"bounds [H, W, 3] expected, got {self.lower.shape} and {self.upper.shape}")
        self.box = box
        self.render = render
        self.limit = limit
        self.deadline = deadline
        shape = self.lower.shape
        self.poses: list[Float64Array] = []
        self.seen: set[bytes] = set()
        self.tried: dict[str, int] = dict.fromkeys(STRATEGIES, 0)
        self.probes = self.steps = self.comparisons = self.violations = self.not_finite = 0
        self.least = np.full(shape, np.inf)
        self.most = np.full(shape, -np.inf)
        self.least_at = np.full(shape, -1)
        self.most_at = np.full(shape, -1)
        self.worst_by_channel: dict[tuple[int, int, int], Violation] = {}
        bad = ~(np.isfinite(self.lower) & np.isfinite(self.upper))
        self.not_finite += int(bad.sum())
        self.violations += int(bad.sum())
        for place in np.argwhere(bad)[:KEPT]:
            bound = self.lower[tuple(place)] if not np.isfinite(self.lower[tuple(place)]) else self.upper[tuple(place)]
            row, column, channel = map(int, place)
            self._keep(Violation((), row, column, channel, float("nan"), float(bound), float("nan")))

    def _keep(self, violation: Violation) -> None:
        place = (violation.row, violation.column, violation.channel)
        current = self.worst_by_channel.get(place)
        if current is None or _severity(violation) > _severity(current):
            self.worst_by_channel[place] = violation

    def image(self, values: Float64Array, strategy: str) -> Float64Array:
        """Render and compare one pose."""
        if len(self.poses) >= self.limit or time.perf_counter() >= self.deadline:
            raise _BudgetSpentError
        values = np.clip(np.asarray(values, np.float64), self.box.lower, self.box.upper)
        image = np.asarray(self.render(values), np.float64)
        if image.shape != self.lower.shape:
            raise ValueError(f"rendered image {image.shape}, bounds {self.lower.shape}")
        self.tried[strategy] += 1
        number = len(self.poses)
        self.poses.append(values)
        self.seen.add(values.tobytes())
        less, more = image < self.least, image > self.most
        self.least[less] = image[less]
        self.most[more] = image[more]
        self.least_at[less] = number
        self.most_at[more] = number
        self._compare(values, image, self.lower, self.upper, None)
        return image

    def image_once(self, values: Float64Array, strategy: str) -> None:
        """Render and compare one pose, unless that has been done."""
        if values.tobytes() not in self.seen:
            self.image(values, strategy)

    def _compare(
        self,
        values: Float64Array,
        image: Float64Array,
        lower: Float64Array,
        upper: Float64Array,
        pixels: NDArray[np.int64] | None,
    ) -> None:
        """Compare values [..., 3] with their bounds; ``pixels`` [k, 2] names them if they are no whole image."""
        self.comparisons += image.size
        self.not_finite += int((~np.isfinite(image)).sum())
        inside = (lower <= image) & (image <= upper)
        if inside.all():
            return
        outside = ~inside
        # bounds that are not numbers were counted once
        counted = outside & np.isfinite(lower) & np.isfinite(upper)
        self.violations += int(counted.sum())
        amount = np.where(image < lower, lower - image, image - upper)
        places = np.argwhere(counted)
        # worst first, NaN before all
        ranks = np.argsort(-np.nan_to_num(amount[counted], nan=np.inf, posinf=np.inf), kind="stable")[:KEPT]
        for place in places[ranks]:
            index = tuple(place)
            row, column = (int(place[0]), int(place[1])) if pixels is None else map(int, pixels[place[0]])
            bound = lower[index] if image[index] < lower[index] else upper[index]
            where = (row, column, int(place[-1]))
            values_at = (float(image[index]), float(bound), float(amount[index]))
            self._keep(Violation(tuple(values.tolist()), *where, *values_at))

    def pixel(self, probe: RenderPixels | None, values: Float64Array, target: _Target) -> float:
        """Return the target's value at a pose, compared with its bounds; without a probe the image is rendered."""
        if probe is None:
            return float(self.image(values, "jumps")[target.row, target.column, target.channel])
        if time.perf_counter() >= self.deadline:
            raise _BudgetSpentError
        where = np.array([[target.row, target.column]], np.int64)
        color = np.asarray(probe(values, where), np.float64)
        self.probes += 1
        here = (where[:, 0], where[:, 1])
        self._compare(values, color, self.lower[here], self.upper[here], where)
        return float(color[0, target.channel])

    def _ranking(self) -> NDArray[np.int64]:
        """Return flat indices into [2, H, W, 3] (upper, lower bound), the relatively closest to its bound first."""
        gap = self.upper - self.lower
        with np.errstate(divide="ignore", invalid="ignore"):
            score = np.stack([(self.most - self.lower) / gap, (self.upper - self.least) / gap])
            # what never moved cannot be pushed, and no image leaves [0, 1]
            score[:, ~((self.most > self.least) & (gap > 0.0))] = -np.inf
            score[0, self.upper >= 1.0] = -np.inf
            score[1, self.lower <= 0.0] = -np.inf
        score[~np.isfinite(score)] = -np.inf
        order = np.argsort(-score, axis=None, kind="stable")
        return order[: int(np.isfinite(score).sum())]

    def _target(self, flat: int) -> _Target:
        side, row, column, channel = (int(v) for v in np.unravel_index(flat, (2, *self.lower.shape)))
        number = (self.most_at, self.least_at)[side][row, column, channel]
        return _Target(row, column, channel, 1.0 if side == 0 else -1.0, self.poses[number])

    def targets(self, count: int, generator: np.random.Generator, done: set[int]) -> list[_Target]:
        """Return pixel channels to push that are not in ``done``, to which they are added.

        A third each: the closest to a bound; the closest whose extreme pose is no corner of the box (at a corner there
        is rarely further to go); any of the closest half.
        """
        order = self._ranking()
        if done:
            order = order[~np.isin(order, np.fromiter(done, np.int64))]
        at_corner = np.array(
            [bool(np.all((pose == self.box.lower) | (pose == self.box.upper))) for pose in self.poses], bool
        )
        extreme_at = np.stack([self.most_at, self.least_at]).ravel()
        third = (count + 2) // 3
        best = list(dict.fromkeys([*order[:third], *order[~at_corner[extreme_at[order]]][: 2 * third]]))[: 2 * third]
        rest = np.setdiff1d(order[: max(1, len(order) // 2)], best)
        if len(rest):
            best += list(generator.choice(rest, min(max(0, count - len(best)), len(rest)), replace=False))
        done.update(int(flat) for flat in best)
        return [self._target(flat) for flat in best]

    def closest(self) -> Float64Array:
        """Return poses [n, d] of the closest approaches, each once."""
        order = self._ranking()
        poses = [self._target(flat).pose for flat in order[:256]]
        unique = list(dict.fromkeys(tuple(pose.tolist()) for pose in poses))[:8]
        return np.array(unique, np.float64).reshape(len(unique), self.box.dimensions)

    def attack(self, seconds: float) -> Attack:
        worst = sorted(self.worst_by_channel.values(), key=_severity, reverse=True)[:KEPT]
        unseen = self.most < self.least
        return Attack(
            poses=len(self.poses),
            probes=self.probes,
            steps=self.steps,
            comparisons=self.comparisons,
            violations=self.violations,
            not_finite=self.not_finite,
            worst=tuple(worst),
            witness_lower=np.where(unseen, np.nan, self.least),
            witness_upper=np.where(unseen, np.nan, self.most),
            tried=dict(self.tried),
            closest=self.closest(),
            seconds=seconds,
        )


@dataclass(frozen=True)
class _Target:
    """A pixel channel to push up (sign 1) or down (-1), and the pose where it went furthest."""

    row: int
    column: int
    channel: int
    sign: float
    pose: Float64Array


def _corners(box: ParameterBox, count: int, generator: np.random.Generator) -> Float64Array:
    """Return all corners [n, d], or ``count`` different ones drawn at random."""
    if box.dimensions == 0:
        return np.zeros((0, 0))
    count = min(count, _CORNERS)
    if 2**box.dimensions <= count:
        return box.corners()
    numbers = generator.choice(2**box.dimensions, count, replace=False)
    bits = (numbers[:, None] >> np.arange(box.dimensions)) & 1
    return np.where(bits == 1, np.array(box.upper), np.array(box.lower))


def _ascend(extremes: _ImageExtremes, twin: DifferentiableRender, target: _Target, start: Float64Array) -> Float64Array:
    """Return the final pose of projected gradient ascent of one pixel channel."""
    pixel = torch.tensor([[target.row, target.column]])

    def value(values: torch.Tensor) -> torch.Tensor:
        extremes.steps += 1
        return -target.sign * twin(values, pixel)[0, target.channel]

    end = descend(extremes.box, start, value, _ASCENT_STEPS, lambda _: time.perf_counter() >= extremes.deadline)
    return start if end is None else end


def _jump(extremes: _ImageExtremes, probe: RenderPixels | None, target: _Target, random: np.random.Generator) -> None:
    """Search for a jump of the target on a random line through its pose, and render both sides of it."""
    low, high = np.array(extremes.box.lower), np.array(extremes.box.upper)
    direction = random.normal(size=low.size) * (high - low)
    # the line's ends in the box
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack([(low - target.pose) / direction, (high - target.pose) / direction])
    ends = ends[:, direction != 0.0]
    if ends.size == 0:
        return
    first, last = np.minimum(ends[0], ends[1]).max(), np.maximum(ends[0], ends[1]).min()
    places = np.linspace(min(first, 0.0), max(last, 0.0), _LINE)

    def at(place: float) -> Float64Array:
        return np.clip(target.pose + place * direction, low, high)

    values = [extremes.pixel(probe, at(place), target) for place in places]
    k = int(np.argmax(np.abs(np.diff(values))))
    a, b, value_a, value_b = places[k], places[k + 1], values[k], values[k + 1]
    difference = abs(value_b - value_a)
    for halving in range(_HALVINGS):
        if not abs(value_b - value_a) > (
            _TUNING.suspect_fall * difference if halving >= _TUNING.suspect_halvings else 0.0
        ):
            return
        middle = 0.5 * (a + b)
        if not (min(a, b) < middle < max(a, b)) or np.array_equal(at(a), at(b)):
            break
        value = extremes.pixel(probe, at(middle), target)
        # the half with the larger difference holds the larger jump
        if abs(value - value_a) >= abs(value_b - value):
            b, value_b = middle, value
        else:
            a, value_a = middle, value
    extremes.image_once(at(a), "jumps")
    extremes.image_once(at(b), "jumps")


def falsify(
    lower: ArrayLike,
    upper: ArrayLike,
    box: ParameterBox,
    render: Render,
    twin: DifferentiableRender | None = None,
    *,
    probe: RenderPixels | None = None,
    poses: int = 200,
    seconds: float = float("inf"),
    seed: int = 0,
    starts: ArrayLike | None = None,
    strategies: Sequence[str] = STRATEGIES,
) -> Attack:
    """Return the result of attacking the abstract image [lower, upper] [H, W, 3] of the poses of ``box``.

    Args:
        lower, upper, box: See above.
        render: Maps parameter values [d] to an image [H, W, 3], which must lie inside.
        twin: The same, differentiable; it guides the ascent. Without it there is none.
        probe: The value of single pixels, equal to ``render``'s; saves rendering whole images.
        poses: Largest number of rendered images.
        seconds: Most time spent; a limit makes the outcome depend on the machine.
        seed: Of the random choices.
        starts: [n, d] poses to try first, clipped into the box.
        strategies: Which of `STRATEGIES` to use. Poses that one does not need go to the next.
    """
    unknown = set(strategies) - set(STRATEGIES)
    if unknown:
        raise ValueError(f"unknown strategies {sorted(unknown)}; there are {', '.join(STRATEGIES)}")
    began = time.perf_counter()
    extremes = _ImageExtremes(lower, upper, box, render, poses, began + seconds)
    generator = np.random.default_rng(seed)
    used = [name for name in strategies if name != "ascent" or twin is not None]
    try:
        _search(extremes, twin, probe, generator, np.zeros((0, 0)) if starts is None else np.asarray(starts), used)
    except _BudgetSpentError:
        pass
    return extremes.attack(time.perf_counter() - began)


def _search(
    extremes: _ImageExtremes,
    twin: DifferentiableRender | None,
    probe: RenderPixels | None,
    generator: np.random.Generator,
    starts: Float64Array,
    strategies: Sequence[str],
) -> None:
    """Run the strategies one after the other until the budget is spent."""
    box, limit = extremes.box, extremes.limit

    def share(name: str) -> int:
        """Poses of the rest that a strategy may use; all of it for the last one."""
        rest = limit - len(extremes.poses)
        later = STRATEGIES[STRATEGIES.index(name) + 1 :]
        return max(1, round(_SHARES[name] * rest)) if any(s in strategies for s in later) else rest

    if "given" in strategies:
        for values in starts:
            extremes.image(values, "given")
    if "corners" in strategies:
        count = share("corners")
        extremes.image(box.middle, "corners")
        for values in _corners(box, count - 1, generator):
            extremes.image(values, "corners")
    if box.dimensions == 0:
        return
    if "random" in strategies:
        for values in box.sample(share("random"), generator):
            extremes.image(values, "random")
    if "ascent" in strategies and twin is not None and extremes.poses:
        # an ascent that ends where an image was rendered before (often a corner) costs no pose
        count = share("ascent")
        last, climbs = len(extremes.poses) + count, 4 * count
        done: set[int] = set()
        while len(extremes.poses) < last and climbs > 0:
            # a few at a time, so that later targets profit from earlier poses
            targets = extremes.targets(9, generator, done)
            if not targets:
                break
            pairs = [(target, start) for target in targets for start in (target.pose, box.sample(1, generator)[0])]
            for target, start in pairs:
                if len(extremes.poses) < last:
                    extremes.image_once(_ascend(extremes, twin, target, start), "ascent")
                climbs -= 1
    if "jumps" in strategies and extremes.poses:
        while targets := extremes.targets(3, generator, set()):
            before = len(extremes.poses)
            for target in targets:
                _jump(extremes, probe, target, generator)
            if len(extremes.poses) == before:
                # no jump along these lines
                extremes.image(box.sample(1, generator)[0], "random")
    if "random" in strategies:
        # nothing moved enough to be searched
        while True:
            extremes.image(box.sample(1, generator)[0], "random")
