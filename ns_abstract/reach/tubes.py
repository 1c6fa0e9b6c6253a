"""Tubes: sets of states over time as affine functions of initial state and disturbances (docs/dev/design.md, L2-L4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ns_abstract.arithmetic.rounding import (
    CLIP_ROUNDING,
    CLIP_UP,
    NARROWEST,
    PUSH_ROUNDING,
    SET_ROUNDINGS,
    SPREAD_ROUNDINGS,
    UNDERFLOW64,
    gamma,
)
from ns_abstract.execution.cancellation import check_cancelled
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.perturbation.specification import TRANSLATIONS
from ns_abstract.reach.dynamics import middle_half
from ns_abstract.reach.learned import LearnedDynamics
from ns_abstract.reach.loop import Control, HalfSpace, Loop
from ns_abstract.reach.pictures import PropertyView
from ns_abstract.verify.model import NetworkModel
from ns_abstract.verify.network import OutputBounds
from ns_abstract.verify.picture_sets import sane
from ns_abstract.verify.properties import Query
from ns_abstract.verify.scene_pictures import ScenePictures

Float64 = NDArray[np.float64]
#: What is kept from step to step: how states depend on the initial state and on earlier disturbances ("kept"); only how
#: control depends on the state within a step ("step"); nothing, intervals of states and of controls ("none").
Dependence = Literal["kept", "step", "none"]

#: Symbols beyond which the smallest ones are put together.
_MOST_GENERATORS = 64


@dataclass(frozen=True)
class AffineSet:
    """A zonotope plus a box: all ``center + generators s + e`` with s in [-1, 1]^q and |e| <= radius (L2).

    Attributes:
        center: [n].
        generators: [n, q]; sets of one step share ``s``; the first columns are those of the initial state.
        radius: [n].
        first: Number of the initial state's generators.
    """

    center: Float64
    generators: Float64
    radius: Float64
    first: int

    @classmethod
    def box(cls, lower: Float64, upper: Float64) -> AffineSet:
        """Return a box [n] as a set, with one generator for every side of positive width."""
        middle, half = middle_half(lower, upper)
        wide = np.flatnonzero(half > 0.0)
        return cls(middle, np.diag(half)[:, wide], np.zeros(len(middle)), len(wide))

    @property
    def finite(self) -> bool:
        """Whether all numbers of the set are finite."""
        return bool(all(np.isfinite(part).all() for part in (self.center, self.generators, self.radius)))

    @property
    def size(self) -> Float64:
        """Upper bounds [n] of absolute values."""
        spread = np.abs(self.generators).sum(axis=1) + self.radius
        return (np.abs(self.center) + spread) * (
            1.0 + 2.0 * gamma(self.generators.shape[1] + SPREAD_ROUNDINGS)
        ) + UNDERFLOW64

    def hull(self) -> tuple[Float64, Float64]:
        """Return ends [n], [n] of the smallest box around the set, rounded outward; a width of 0 stays 0."""
        spread = np.abs(self.generators).sum(axis=1) + self.radius
        spread = spread * (1.0 + 2.0 * gamma(self.generators.shape[1] + SPREAD_ROUNDINGS))
        still = spread == 0.0
        low, high = self.center - spread, self.center + spread
        low, high = np.nextafter(low, -np.inf), np.nextafter(high, np.inf)
        return np.where(still, self.center, low), np.where(still, self.center, high)

    def mapped(self, matrix: Float64, offset: Float64, radius: Float64 | float = 0.0) -> AffineSet:
        """Return the image ``matrix x + offset + e``, |e| <= radius, in the same ``s``.

        Entries of ``matrix`` and ``offset`` may err by `SET_ROUNDINGS` units.
        """
        n, q = self.generators.shape
        share = 2.0 * gamma(n + SET_ROUNDINGS)
        with np.errstate(all="ignore"):
            steep = np.abs(matrix)
            size = np.abs(self.center) + np.abs(self.generators).sum(axis=1) + self.radius
            # every entry is a sum of n products and an offset
            spread = steep @ (self.radius + share * size) + share * np.abs(offset) + radius
            spread = spread * (1.0 + 2.0 * gamma(n + q + SET_ROUNDINGS)) + np.where(steep.any(axis=1), UNDERFLOW64, 0.0)
            image = matrix @ self.center + offset, matrix @ self.generators
        return AffineSet(*image, spread, self.first)

    def beside(self, other: AffineSet) -> AffineSet:
        """Return the product of two sets in the same ``s``: the components of the other one follow this one's."""
        names = "center", "generators", "radius"
        parts = [np.concatenate([getattr(entry, name) for entry in (self, other)]) for name in names]
        return AffineSet(parts[0], parts[1], parts[2], self.first)

    def promoted(self) -> AffineSet:
        """Return the same set with a generator in place of every radius, so that later steps follow it.

        If that makes too many generators, the smallest are enclosed in a box first.
        """
        generators, radius = self.generators, self.radius
        n = len(radius)
        spare = generators.shape[1] + n - max(_MOST_GENERATORS, self.first + n)
        if spare > 0:
            weight = np.abs(generators).sum(axis=0)
            weight[: self.first] = np.inf
            gone = np.argsort(weight, kind="stable")[:spare]
            more = np.abs(generators[:, gone]).sum(axis=1)
            radius = (radius + more) * (1.0 + 2.0 * gamma(len(gone) + 4))
            generators = np.delete(generators, gone, axis=1)
        wide = np.flatnonzero(radius > 0.0)
        return AffineSet(
            self.center, np.concatenate([generators, np.diag(radius)[:, wide]], axis=1), np.zeros(n), self.first
        )

    def least(self, face: HalfSpace) -> float:
        """Return a lower bound of an affine function over the set; minus infinity where none is known."""
        image = self.mapped(np.array(face.normal)[None], np.array([-face.offset]))
        low = float(image.hull()[0][0])
        return low if np.isfinite(low) else -np.inf


def _scaled(values: AffineSet, middle: Float64, half: Float64) -> AffineSet:
    """Return ``(values - middle) / half``, positions in [-1, 1] in boxes; 0 where a box has no width."""
    with np.errstate(all="ignore"):
        usable = half > NARROWEST
        inverse = np.where(usable, 1.0 / half, 0.0)
    shifted = values.mapped(np.eye(len(middle)), -middle)
    # where a quotient could overflow, all that is known is that the position is in [-1, 1]
    return shifted.mapped(np.diag(inverse), np.zeros(len(middle)), np.where(usable | (half == 0.0), 0.0, 1.0))


# ---------------------------------------------------------------- the network


@dataclass(frozen=True)
class AffineBounds:
    """Bounds of y [m] at q in [-1, 1]^d: ``y = slopes q + center + e``, |e| <= radius, and ``lower <= y <= upper``."""

    slopes: Float64
    center: Float64
    radius: Float64
    lower: Float64
    upper: Float64


def clipped(raw: AffineBounds, lower: Float64, upper: Float64) -> AffineBounds:
    """Return bounds of ``clip(z, lower, upper)`` for z bounded by ``raw`` (L3).

    For any lambda, ``clip(z) - lambda z`` is extreme at the ends of z's range or where the clip begins.
    """
    low, high = np.clip(raw.lower, lower, upper), np.clip(raw.upper, lower, upper)
    inside = (raw.lower >= lower) & (raw.upper <= upper)
    with np.errstate(all="ignore"):
        slope = np.clip((high - low) / (raw.upper - raw.lower), 0.0, 1.0)
    slope = np.where(np.isfinite(slope), slope, 0.0)
    ends = np.stack([raw.lower, raw.upper, np.clip(lower, raw.lower, raw.upper), np.clip(upper, raw.lower, raw.upper)])
    room = CLIP_ROUNDING * (np.abs(ends).max(axis=0) + np.maximum(np.abs(low), np.abs(high)))
    distance = np.clip(ends, lower, upper) - slope * ends
    middle, half = middle_half(distance.min(axis=0) - room, distance.max(axis=0) + room)
    size = np.abs(raw.slopes).sum(axis=1) + np.abs(raw.center) + np.abs(middle)
    radius = (slope * raw.radius + half + CLIP_ROUNDING * size) * CLIP_UP + UNDERFLOW64
    # a relaxation that is wider than the range itself is none
    flat = ~inside & ~(radius < 0.5 * (high - low))
    center, spread = middle_half(low, high)

    def chosen(same: Float64, steep: Float64, level: Float64 | float) -> Float64:
        shape = (-1, *[1] * (same.ndim - 1))
        return np.where(inside.reshape(shape), same, np.where(flat.reshape(shape), level, steep))

    return AffineBounds(
        chosen(raw.slopes, slope[:, None] * raw.slopes, 0.0),
        chosen(raw.center, slope * raw.center + middle, center),
        chosen(raw.radius, radius, spread),
        low,
        high,
    )


class ControlBounds:
    """Bounds the controls over a set of pictures, through the network and the control law."""

    def __init__(self, model: NetworkModel, control: Control) -> None:
        self.model, self.control = model, control
        unit, zero = np.eye(control.gain.shape[1]), np.zeros(2 * sum(control.gain.shape))
        # lower and upper bounds of K y, and of y for its size
        rows = np.concatenate([control.gain, -control.gain, unit, -unit])
        self._query = Query(rows, zero)

    def concrete(self, image: np.ndarray) -> Float64:
        """Return the control [m] for a picture, as the deployed network computes it."""
        return self.control.of(self.model.outputs(image[None])[0].astype(np.float64))

    def bound(self, linear: Sequence[np.ndarray], lower: np.ndarray, upper: np.ndarray) -> AffineBounds | None:
        """Return bounds of the controls over a set of pictures, with float64 errors; None: none is known (L3)."""
        control = self.control
        m, o = control.gain.shape
        images = self.model.input_sets(tuple(part[None] for part in linear), lower[None], upper[None])
        output_bounds = self.model.bound(images, self._query)
        with np.errstate(all="ignore"):
            least = output_bounds.lower[0]
            outputs = np.maximum(-least[2 * m : 2 * m + o], -least[2 * m + o :])
            # K (y - goal) in float64, and K goal
            steep = np.abs(control.gain)
            room = 2.0 * gamma(2 * o + SET_ROUNDINGS) * (steep @ (np.abs(outputs) + np.abs(control.goal)))
            raw = between(output_bounds, m, control.gain @ control.goal, room)
            return None if raw is None else clipped(raw, control.lower, control.upper)


def between(bounds: OutputBounds, count: int, shift: Float64, room: Float64) -> AffineBounds | None:
    """Return affine bounds of quantities [count] of one cell from planes below them and below their negatives (L3).

    Args:
        bounds: Lower planes; the first ``count`` rows are of the quantities, the next of their negatives.
        shift: [count] is subtracted.
        room: [count] further errors.

    Returns:
        None where a bound is not finite: the quantity may not be a number either.
    """
    least = bounds.lower[0]
    if not np.isfinite(least).all():
        return None
    usable = np.isfinite(bounds.b[0])
    a, b = np.where(usable[:, None], bounds.a[0], 0.0), np.where(usable, bounds.b[0], least)
    a, b, least = a[: 2 * count], b[: 2 * count], least[: 2 * count]
    with np.errstate(all="ignore"):
        slopes = 0.5 * (a[:count] - a[count:])
        apart = 0.5 * np.abs(a[:count] + a[count:]).sum(axis=1)
        bottom, top = b[:count] - apart, -b[count:] + apart
        size = np.abs(a).sum(axis=1).reshape(2, count).sum(axis=0) + np.abs(bottom) + np.abs(top)
        center, half = middle_half(bottom, top)
        low, high = least[:count], -least[count:]
        # the sums above, and the shift
        wide = room + 2.0 * gamma(a.shape[1] + SET_ROUNDINGS) * (size + np.abs(shift))
        raw = AffineBounds(slopes, center - shift, half + wide, low - shift - wide, high - shift + wide)
        poor = ~(raw.radius < 0.5 * (raw.upper - raw.lower))
        middle, spread = middle_half(raw.lower, raw.upper)
    return AffineBounds(
        np.where(poor[:, None], 0.0, raw.slopes),
        np.where(poor, middle, raw.center),
        np.where(poor, spread, raw.radius),
        raw.lower,
        raw.upper,
    )


# ---------------------------------------------------------------- the tube


def clearance(state: AffineSet, unsafe: Sequence[Sequence[HalfSpace]]) -> float:
    """Return a lower bound, over the unsafe sets, of the distance to the set along its best face (L4)."""
    return min((max(state.least(face) for face in faces) for faces in unsafe), default=np.inf)


@dataclass(frozen=True)
class Tube:
    """The sets of states of all runs from a cell, step by step.

    Attributes:
        state_sets: By step, from 0, up to the last step or the one where the tube ends for ``reason``.
        controls: [steps, 2, m] least and largest control.
        slopes: [m] motion of the pictures by initial parameter, summed over the steps: the gain of a cut.
        views: [sets, properties] lower bounds of the margins of `Loop.views` (L7); minus infinity: none is known.
    """

    state_sets: tuple[AffineSet, ...]
    controls: Float64
    slopes: Float64
    views: Float64
    reason: str = ""

    def safe(self, loop: Loop) -> float:
        """Return a lower bound over all steps of the distance to unsafe sets (L4) and of required margins."""
        clearances = [clearance(step, loop.unsafe) for step in self.state_sets]
        return float(min([*clearances, *self.views[:, : len(loop.required)].ravel()], default=np.inf))

    def inside(self, step: int, faces: Sequence[HalfSpace]) -> float:
        """Return a lower bound of how deep all states of a step lie inside a box."""
        return min(self.state_sets[step].least(face) for face in faces)


@dataclass
class TubeBuilder:
    """Computes tubes of a loop.

    Attributes:
        registration: Largest offset of the scene along every world axis, constant over a run. The camera must move
            along all of them. Otherwise the pose set may tell the scene's offset (`PoseBox.registered`).
        views: The pictures of the properties of `Loop.views`, in their order.
    """

    loop: Loop
    view: ScenePictures
    pilot: ControlBounds
    dependence: Dependence = "kept"
    registration: float = 0.0
    views: tuple[PropertyView, ...] = ()
    _limits: tuple[Float64, Float64] = field(init=False)

    def __post_init__(self) -> None:
        box = self.view.pose_set.box
        self._limits = np.array(box.lower), np.array(box.upper)

    @property
    def shift(self) -> Float64:
        """Largest error [d] of pose parameters relative to the scene."""
        return np.array([self.registration if name in TRANSLATIONS else 0.0 for name in self.loop.camera.names])

    @property
    def place(self) -> Float64:
        """Largest offset [3] of the scene, where the pose set has parameters for it; else empty."""
        return self._limits[1][len(self.loop.camera.names) :]

    def seen_from(self, x: Float64, off: Float64 | None = None) -> Float64:
        """Return the pose set's parameters at a state [n], the scene being ``off`` (see `place` and `shift`)."""
        values = self.loop.camera.values(x)
        if self.place.size:
            return np.concatenate([values, np.zeros(self.place.size) if off is None else off])
        return values if off is None else values + off

    def tube(self, cell: ParameterBox, *, whole: bool = False) -> Tube:
        """Return the tube of a cell; unless ``whole`` it ends where an unsafe set cannot be excluded."""
        lower, upper = self.loop.initial(cell)
        state = AffineSet.box(lower, upper)
        # which generators are which parameters of the cell
        free = [k for k in range(len(lower)) if upper[k] > lower[k]]
        places = [cell.names.index(self.loop.names[k]) for k in free]
        slopes = np.zeros(cell.dimensions)
        sets, controls, views = [state], [], []
        reason = ""
        for step in range(self.loop.steps + 1):
            if not state.finite:
                reason = f"the states of step {step} are not finite"
            elif not whole and not clearance(state, self.loop.unsafe) > 0.0:
                reason = f"unsafe states cannot be ruled out at step {step}"
            elif not whole and self.views:
                margins, moved = self._view_margins(state, step)
                views.append(margins)
                if self.dependence == "kept":
                    slopes[places] += moved[: len(places)]
                if not (margins[: len(self.loop.required)] > 0.0).all():
                    reason = f"unsafe pictures cannot be ruled out at step {step}"
            if reason or step == self.loop.steps:
                break
            check_cancelled()
            if self.dependence != "kept":
                state = AffineSet.box(*state.hull())
            next_set = self._advanced(state.promoted())
            if isinstance(next_set, str):
                reason = f"{next_set} at step {step}"
                break
            state, control, moved = next_set
            if self.dependence == "kept":
                slopes[places] += moved[: len(places)]
            sets.append(state)
            controls.append(control)
        if self.dependence != "kept":
            slopes[:] = np.array(cell.upper) - np.array(cell.lower)
        return Tube(tuple(sets), np.array(controls), slopes, np.reshape(views, (len(views), len(self.views))), reason)

    def poses(self, state: AffineSet) -> AffineSet:
        """Return the set of pose parameters [d] at the states of a set, float64 evaluations included."""
        loop, camera = self.loop, self.loop.camera
        rounding = 2.0 * gamma(len(loop.names) + SET_ROUNDINGS)
        size = np.abs(camera.factors) @ state.size + np.abs(camera.offset) + self.shift
        # a scene elsewhere is a camera elsewhere (V13)
        return state.mapped(camera.factors, camera.offset, self.shift + rounding * size)

    def places(self, state: AffineSet) -> tuple[Float64, Float64]:
        """Return ends [3], [3] of a box of camera positions at the states of a set (world axes, normalised units)."""
        low, high = self.poses(state).hull()
        ends = [
            (low[names.index(axis)], high[names.index(axis)])
            if axis in (names := self.loop.camera.names)
            else (self.loop.camera.fixed[axis],) * 2
            for axis in TRANSLATIONS
        ]
        return np.array(ends)[:, 0], np.array(ends)[:, 1]

    def _pose_box(self, state: AffineSet) -> tuple[ParameterBox, AffineSet] | None:
        """Return the smallest box around the pose parameters at the states of a set, and the positions in it.

        None: the camera may leave the range of poses.
        """
        pose = self.poses(state)
        low, high = pose.hull()
        if not ((low >= self._limits[0][: len(low)]) & (high <= self._limits[1][: len(high)])).all():
            return None
        if (place := self.place).size:
            low, high = np.concatenate([low, -place]), np.concatenate([high, place])
            none = np.zeros((place.size, pose.generators.shape[1]))
            pose = pose.beside(AffineSet(np.zeros(place.size), none, place, pose.first))
        return self.view.pose_set.box.with_ends(low, high), _scaled(pose, *middle_half(low, high))

    def _view_margins(self, state: AffineSet, step: int) -> tuple[Float64, Float64]:
        """Return lower bounds [properties] of margins at a step (L7), and the motion of the pictures by generator."""
        margins, moved = np.full(len(self.views), -np.inf), np.zeros(state.generators.shape[1])
        poses, goal = self._pose_box(state), self.loop.goal
        for k, view in enumerate(self.views):
            counts = k < len(self.loop.required) or (goal is not None and step in goal.steps(self.loop.steps))
            if poses is not None and counts:
                check_cancelled()
                margins[k], slopes = view.bound(poses[0])
                moved += slopes @ np.abs(poses[1].generators)
        return margins, moved

    def _advanced(self, state: AffineSet) -> tuple[AffineSet, Float64, Float64] | str:
        """Return the set one step later (L4), its controls' ends [2, m], and the motion of the picture by generator."""
        poses = self._pose_box(state)
        if poses is None:
            return "the camera may leave the range of poses"
        box, scaled = poses
        linear, lower, upper, slopes = self.view.linear_sets(box)
        if not sane(linear, lower, upper):
            return "the picture's bounds are not finite"
        controls = self.pilot.bound(linear, lower, upper)
        if controls is None:
            return "the network's bounds are not finite"
        moved = np.abs(np.asarray(slopes, np.float64)) @ np.abs(scaled.generators)
        control = scaled.mapped(controls.slopes, controls.center, controls.radius)
        ends = control.hull()
        ends = np.maximum(ends[0], controls.lower), np.minimum(ends[1], controls.upper)
        if not (np.isfinite(ends[0]).all() and np.isfinite(ends[1]).all() and (ends[0] <= ends[1]).all()):
            return "the controls' bounds are not finite"
        if self.dependence == "none":
            middle, half = middle_half(*ends)
            control = AffineSet(middle, np.zeros_like(control.generators), half, control.first)
        hull = state.hull()
        follow = self._driven(state.beside(control), np.concatenate([hull, ends], axis=1))
        return follow if isinstance(follow, str) else (follow, np.stack(ends), moved)

    def _driven(self, both: AffineSet, ends: Float64) -> AffineSet | str:
        """Return the next states of states and controls in a set and between ``ends`` [2, n + m] (L4, L6)."""
        loop, law = self.loop, self.loop.dynamics
        push, wide = middle_half(*loop.disturbance)
        most = np.abs(loop.disturbance).max(axis=0)
        if isinstance(law, LearnedDynamics):
            output_bounds = law.bound(both.center, both.generators, both.radius, *ends)
            none = np.zeros(law.states)
            lines = None if output_bounds is None else between(output_bounds, law.states, none, none)
            if lines is None:
                return "the dynamics' bounds are not finite"
            moved = AffineSet(lines.center, lines.slopes, lines.radius, both.first)
            # the sum with the disturbance is rounded where a run is simulated, too
            return moved.mapped(np.eye(law.states), push, wide + PUSH_ROUNDING * (moved.size + most))
        step = law.enclose(*ends)
        place = _scaled(both, step.middle, step.half)
        added = PUSH_ROUNDING * (np.abs(step.center + push) + most)
        return place.mapped(step.slopes, step.center + push, step.radius + wide + added)
