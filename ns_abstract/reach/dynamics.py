"""Discrete dynamics ``x' = f(x, u)``: one concrete step in float64, and its enclosure over a box (design.md, L1).

Every law is written once, over an arithmetic: `Floats` evaluates it, `Forms` encloses it, and `TermSizes` follows
how large its terms are, which is what a float64 evaluation's rounding is charged by.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ns_abstract.arithmetic.form_array import FormArray
from ns_abstract.arithmetic.forms import MAX_DIMENSIONS, Basis
from ns_abstract.arithmetic.rounding import HALF_UP, STEP_ROUNDINGS, STEP_UP, UNDERFLOW64, gamma
from ns_abstract.arithmetic.trigonometry import cos_sin
from ns_abstract.io.fields import fail, known
from ns_abstract.io.jsonio import FIX_MODERATE, file_beside, is_moderate, show
from ns_abstract.reach.learned import LearnedDynamics

Float64 = NDArray[np.float64]

#: Most states and controls together.
MOST = MAX_DIMENSIONS


class Floats:
    """Arithmetic on plain numbers of any type with + and *: float64, or exact fractions where no angle occurs."""

    @staticmethod
    def cos_sin(angle: Any) -> tuple[Any, Any]:
        """Return cosine and sine of an angle in radians."""
        return np.cos(angle), np.sin(angle)

    @staticmethod
    def signed_square(value: Any) -> Any:
        """Return ``v |v|``."""
        return value * abs(value)

    @staticmethod
    def scaled(value: Any, factor: float) -> Any:
        """Return ``factor * value``."""
        return value * factor


class Forms(Floats):
    """Arithmetic on affine forms, which enclose quantities (A1-A3)."""

    @staticmethod
    def cos_sin(angle: FormArray) -> tuple[FormArray, FormArray]:
        return cos_sin(angle)

    @staticmethod
    def signed_square(value: FormArray) -> FormArray:
        """Return ``v |v|``, whose derivative is ``2 |v|``, and half its second one is the sign of v (A3)."""
        low, high = value.bounds()
        middle = value.center
        least = np.where(low > 0.0, 1.0, -1.0)
        most = np.where(high < 0.0, -1.0, 1.0)
        return value.compose(middle * np.abs(middle), 2.0 * np.abs(middle), least, most, 0.0)


class TermSizes(Floats):
    """Arithmetic on upper bounds of the sizes of terms; no sum cancels."""

    @staticmethod
    def cos_sin(angle: Any) -> tuple[Any, Any]:
        # an error of the angle is one of its cosine; the library's own is relative to 1
        return 1.0 + angle, 1.0 + angle

    @staticmethod
    def scaled(value: Any, factor: float) -> Any:
        return value * abs(factor)


#: Law of motion: states [n], controls [m] and arithmetic to states [n].
Law = Callable[[Sequence[Any], Sequence[Any], type[Floats]], list[Any]]


class StepEnclosure(NamedTuple):
    """Encloses the exact step and its float64 evaluation: ``f(x, u) = center + slopes (xi, eta) + e``, |e| <= radius.

    ``xi`` and ``eta`` in [-1, 1] are the positions of x and u in their boxes, from the middle, in half-widths.

    Attributes:
        center: [n].
        slopes: [n, n + m].
        radius: [n].
        middle, half: [n + m] of the boxes of x and u.
    """

    center: Float64
    slopes: Float64
    radius: Float64
    middle: Float64
    half: Float64


def middle_half(lower: Float64, upper: Float64) -> tuple[Float64, Float64]:
    """Return middles and half-widths of intervals, with ``middle - half <= lower`` and ``upper <= middle + half``."""
    middle = 0.5 * (lower + upper)
    return middle, np.maximum(upper - middle, middle - lower) * HALF_UP


@dataclass(frozen=True)
class Dynamics:
    """A law of motion in discrete time, ``x' = f(x, u)``."""

    name: str
    states: int
    controls: int
    law: Law
    about: str

    def step(self, x: Float64, u: Float64) -> Float64:
        """Return the next state [n], evaluated in float64, from a state [n] and a control [m]."""
        return np.array(self.law(list(map(np.float64, x)), list(map(np.float64, u)), Floats), np.float64)

    def enclose(self, lower: Float64, upper: Float64) -> StepEnclosure:
        """Return an enclosure of the exact law and of `step` over a box [n + m] of states and controls (L1).

        Components that may leave the range of float64 get a radius that is not finite.
        """
        n, m = self.states, self.controls
        middle, half = middle_half(lower, upper)
        basis = Basis(n + m, 1)
        with np.errstate(all="ignore"):
            forms = [FormArray.parameter(basis, k, middle[k], half[k]) for k in range(n + m)]
            next_state = self.law(forms[:n], forms[n:], Forms)
            sizes = list(np.maximum(np.abs(lower), np.abs(upper)))
            size = np.array(self.law(sizes[:n], sizes[n:], TermSizes), np.float64)
            radius = np.array([float(form.radius) for form in next_state])
            radius = (radius + 2.0 * gamma(STEP_ROUNDINGS) * size) * STEP_UP + UNDERFLOW64
        center = np.array([float(form.center) for form in next_state])
        slopes = np.array([form.linear.reshape(-1) for form in next_state]).reshape(n, n + m)
        return StepEnclosure(center, slopes, radius, middle, half)


# ---------------------------------------------------------------- the family


def affine(a: Float64, b: Float64, c: Float64) -> Dynamics:
    """Return the law ``x' = A x + B u + c`` with A [n, n], B [n, m], c [n]."""

    def law(x: Sequence[Any], u: Sequence[Any], kind: type[Floats]) -> list[Any]:
        next_state = []
        for row in range(a.shape[0]):
            total = x[0] * 0.0
            for value, factor in zip((*x, *u), (*a[row], *b[row]), strict=True):
                total = total + kind.scaled(value, float(factor))
            next_state.append(total + (abs(float(c[row])) if kind is TermSizes else float(c[row])))
        return next_state

    return Dynamics("affine", a.shape[0], b.shape[1], law, "x' = A x + B u + c")


def unicycle(dt: float, speed: float | None) -> Dynamics:
    """Return a unicycle's dynamics, ``(x, y, heading)``, by Euler's rule: it moves along its heading and turns.

    ``x' = x + dt v cos(heading)``, ``y' = y + dt v sin(heading)``, ``heading' = heading + dt w``; the controls are
    (v, w), or w alone where ``speed`` gives v.
    """

    def law(x: Sequence[Any], u: Sequence[Any], kind: type[Floats]) -> list[Any]:
        cosine, sine = kind.cos_sin(x[2])

        def moved(part: Any) -> Any:
            return kind.scaled(part, dt * speed) if speed is not None else kind.scaled(u[0] * part, dt)

        return [x[0] + moved(cosine), x[1] + moved(sine), x[2] + kind.scaled(u[-1], dt)]

    text = "x' = x + dt v cos(h), y' = y + dt v sin(h), h' = h + dt w"
    return Dynamics("unicycle", 3, 2 if speed is None else 1, law, text)


def double_integrator(dt: float, axes: int, linear: float, quadratic: float) -> Dynamics:
    """Return the dynamics of 1 to 4 axes, ``(p_1, .., v_1, ..)``, driven by accelerations, with drag.

    ``p' = p + dt v``, ``v' = v + dt (u - linear v - quadratic v |v|)`` by Euler's rule, axis by axis.
    """

    def law(x: Sequence[Any], u: Sequence[Any], kind: type[Floats]) -> list[Any]:
        places = [x[k] + kind.scaled(x[axes + k], dt) for k in range(axes)]
        speeds = []
        for k in range(axes):
            v = x[axes + k]
            total = v + kind.scaled(u[k], dt) + kind.scaled(v, -dt * linear)
            if quadratic:
                total = total + kind.scaled(kind.signed_square(v), -dt * quadratic)
            speeds.append(total)
        return [*places, *speeds]

    text = "p' = p + dt v, v' = v + dt (u - linear v - quadratic v |v|)"
    return Dynamics("double integrator", 2 * axes, axes, law, text)


def fixed_wing(dt: float, speed: float) -> Dynamics:
    """Return an aeroplane's dynamics at constant speed, ``(x, y, z, heading, climb)``, by Euler's rule; radians.

    ``x' = x + dt v cos(climb) cos(heading)``, ``y' = y + dt v cos(climb) sin(heading)``, ``z' = z + dt v sin(climb)``;
    the controls are the rates of heading and climb.
    """

    def law(x: Sequence[Any], u: Sequence[Any], kind: type[Floats]) -> list[Any]:
        ahead, across = kind.cos_sin(x[3])
        level, up = kind.cos_sin(x[4])
        moved = [kind.scaled(part, dt * speed) for part in (level * ahead, level * across, up)]
        return [*(x[k] + moved[k] for k in range(3)), *(x[k] + kind.scaled(u[k - 3], dt) for k in (3, 4))]

    text = (
        "x' = x + dt v cos(c) cos(h), y' = y + dt v cos(c) sin(h), z' = z + dt v sin(c), h' = h + dt r, c' = c + dt q"
    )
    return Dynamics("fixed wing", 5, 2, law, text)


def quadrotor(dt: float, lag: float, gravity: float) -> Dynamics:
    """Return the dynamics of a quadrotor in the plane across its view, ``(across, up, v_across, v_up, roll)``.

    An inner loop lets the roll follow its command: ``roll' = roll + dt / lag (command - roll)``. With the thrust
    T = ``gravity`` + its command (accelerations), ``v_across' = v_across + dt T sin(roll)`` and ``v_up' = v_up + dt
    (T cos(roll) - gravity)``; the controls are the commands of roll and thrust.
    """

    def law(x: Sequence[Any], u: Sequence[Any], kind: type[Floats]) -> list[Any]:
        upright, tilted = kind.cos_sin(x[4])
        thrust = u[1] + gravity
        weight = dt * gravity if kind is TermSizes else -dt * gravity
        return [
            x[0] + kind.scaled(x[2], dt),
            x[1] + kind.scaled(x[3], dt),
            x[2] + kind.scaled(thrust * tilted, dt),
            x[3] + kind.scaled(thrust * upright, dt) + weight,
            x[4] + kind.scaled(u[0] + kind.scaled(x[4], -1.0), dt / lag),
        ]

    text = (
        "y' = y + dt v, z' = z + dt w, v' = v + dt T sin(r), w' = w + dt (T cos(r) - g), r' = r + dt / lag (u - r), "
        "T = g + thrust"
    )
    return Dynamics("quadrotor", 5, 2, law, text)


# ---------------------------------------------------------------- LOOP.json

#: m / s^2.
_GRAVITY = 9.81

KEYS = {
    "affine": ("type", "A", "B", "c"),
    "unicycle": ("type", "speed"),
    "double integrator": ("type", "axes", "drag", "quadratic_drag"),
    "fixed wing": ("type", "speed"),
    "quadrotor": ("type", "lag", "gravity"),
    "onnx": ("type", "file"),
}


def matrix(value: Any, name: str, rows: int, columns: int | None) -> Float64:
    """Return a [rows, columns] matrix of moderate numbers from JSON; ``columns`` None: as the first row. InputError."""
    if columns is None and isinstance(value, list) and value and isinstance(value[0], list):
        columns = len(value[0])
    good = isinstance(value, list) and len(value) == rows and columns is not None
    good = good and all(
        isinstance(row, list) and len(row) == columns and all(is_moderate(v) for v in row) for row in value
    )
    if not good or not columns:
        fix = f"write {rows} rows of {columns or 'equally many'} numbers, each {FIX_MODERATE}"
        raise fail(name, f"found {show(value)}", fix)
    return np.array(value, np.float64)


def numbers(value: Any, name: str, count: int) -> Float64:
    """Return [count] moderate numbers from JSON; InputError where it holds anything else."""
    if not (isinstance(value, list) and len(value) == count and all(is_moderate(v) for v in value)):
        raise fail(name, f"found {show(value)}", f"write {count} numbers, each {FIX_MODERATE}")
    return np.array(value, np.float64)


def number(value: Any, name: str, *, positive: bool = False) -> float:
    """Return one moderate number from JSON; InputError where it is anything else."""
    if not is_moderate(value) or (positive and not value > 0):
        raise fail(name, f"found {show(value)}", f"write a {'positive ' if positive else ''}number, {FIX_MODERATE}")
    return float(value)


def named_file(value: Any, name: str, folder: Path) -> Path:
    """Return the .onnx file beside LOOP.json that a field names; InputError where there is none."""
    if not isinstance(value, str) or not value:
        raise fail(name, f"found {show(value)}", "name an .onnx file beside this one")
    return file_beside(folder, value, name)


def parse_dynamics(value: Any, states: int, dt: float, folder: Path) -> Dynamics | LearnedDynamics:
    """Return the law of motion under the key ``dynamics`` of LOOP.json; ``dt`` is the sampling time in seconds."""
    kinds = ", ".join(KEYS)
    if not isinstance(value, Mapping):
        raise fail("dynamics", f"found {show(value)}", f"write an object with a type: {kinds}")
    kind = value.get("type")
    if not isinstance(kind, str) or kind not in KEYS:
        raise fail("dynamics.type", f"found {show(kind)}", f"write one of {kinds}")
    known(value, KEYS[kind], "dynamics.", fail)
    dynamics: Dynamics | LearnedDynamics
    if kind == "onnx":
        dynamics = LearnedDynamics(named_file(value.get("file"), "dynamics.file", folder), states)
    elif kind == "affine":
        a = matrix(value.get("A"), "dynamics.A", states, states)
        b = matrix(value.get("B"), "dynamics.B", states, None)
        c = numbers(value.get("c", [0.0] * states), "dynamics.c", states)
        dynamics = affine(a, b, c)
    elif kind == "unicycle":
        speed = None if "speed" not in value else number(value["speed"], "dynamics.speed")
        dynamics = unicycle(dt, speed)
    elif kind == "fixed wing":
        dynamics = fixed_wing(dt, number(value.get("speed"), "dynamics.speed", positive=True))
    elif kind == "quadrotor":
        lag = number(value.get("lag"), "dynamics.lag", positive=True)
        dynamics = quadrotor(dt, lag, number(value.get("gravity", _GRAVITY), "dynamics.gravity", positive=True))
    else:
        axes = value.get("axes")
        if type(axes) is not int or not 1 <= axes <= MOST // 3:
            raise fail("dynamics.axes", f"found {show(axes)}", f"write a whole number from 1 to {MOST // 3}")
        drags = [number(value.get(key, 0), f"dynamics.{key}") for key in ("drag", "quadratic_drag")]
        dynamics = double_integrator(dt, axes, *drags)
    if dynamics.states != states:
        raise fail("state", f"{states} names", f"dynamics of type {kind} have {dynamics.states} here; name as many")
    if dynamics.states + dynamics.controls > MOST:
        count = f"{dynamics.states} states and {dynamics.controls} controls"
        raise fail("dynamics", count, f"use at most {MOST} together")
    return dynamics
