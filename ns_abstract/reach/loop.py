"""LOOP.json: a camera, a network and a law of motion in a closed loop, and the property to prove."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.camera_path import PinholeCamera, checked_pose, focal_length, stated_intrinsics
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.io.errors import InputError
from ns_abstract.io.fields import fail, interval, known
from ns_abstract.io.jsonio import is_moderate, is_number, load_json, show
from ns_abstract.perturbation.specification import ROTATIONS, TRANSLATIONS, Perturbation
from ns_abstract.reach.dynamics import MOST, Dynamics, matrix, named_file, number, numbers, parse_dynamics
from ns_abstract.reach.learned import LearnedDynamics
from ns_abstract.verify.picture_properties import PictureProperty, is_of_picture, parse_picture_property
from ns_abstract.verify.preprocess import Preprocess, parse_preprocess

Float64 = NDArray[np.float64]

#: Most steps, unsafe sets, and outputs of the network.
MOST_STEPS, _MOST_SETS, _MOST_OUTPUTS = 1000, 64, 64
#: Poses that may be looked at: positions in normalised units, angles in radians.
FARTHEST, _TURN = 1e4, 10.0
KEYS = (
    "version", "state", "units", "initial", "steps", "sampling_time", "dynamics", "disturbance", "camera", "network",
    "preprocess", "control", "unsafe", "goal", "output",
)  # fmt: skip


@dataclass(frozen=True)
class HalfSpace:
    """The affine function ``normal . x - offset`` of the state x [n], which is positive on one side of a plane."""

    normal: tuple[float, ...]
    offset: float

    def exact(self, x: Sequence[float]) -> Fraction:
        """Return the exact value at a state of float64 numbers."""
        terms = (Fraction(a) * Fraction(v) for a, v in zip(self.normal, x, strict=True) if a)
        return sum(terms, start=Fraction(0)) - Fraction(self.offset)


@dataclass(frozen=True)
class Goal:
    """The goal: an open box of states, or a property of the picture.

    Attributes:
        faces: Functions that are all positive inside the box; empty where a property is the goal.
        when: "end", after the last step; "any", after at least one step.
        view: The property, or None.
    """

    faces: tuple[HalfSpace, ...]
    when: Literal["end", "any"]
    view: PictureProperty | None = None

    def steps(self, last: int) -> range:
        """Return the steps, of 0 to ``last``, at which the goal counts."""
        return range(last if self.when == "end" else 0, last + 1)


#: A property of the picture, for errors.
_VIEW = 'a property of the picture {"type": "clear", ..}'
#: Intrinsics in pixels that a file may state.
LENS = ("fx", "fy", "cx", "cy")


@dataclass(frozen=True)
class CameraMount:
    """A camera whose pose is an affine function of the state.

    Attributes:
        rotation: [3, 3] camera to world (OpenGL axes: x right, y up, z back) where all angles are 0.
        fov: Vertical angle of view, degrees.
        lens: The stated ones of ``fx``, ``fy``, ``cx``, ``cy``, in pixels of the network's picture.
        names: Pose parameters that move, of x, y, z (world axes, normalised units) and yaw, pitch, roll (radians,
            about the camera's own axes, in this order).
        offset: [d] their values at state 0.
        factors: [d, n] their derivatives by the state.
    """

    rotation: Float64
    fov: float
    lens: Mapping[str, float]
    names: tuple[str, ...]
    offset: Float64
    factors: Float64
    fixed: Mapping[str, float]

    def enlarged(self, down: float, across: float) -> CameraMount:
        """Return the same camera for pictures with ``down`` times the rows and ``across`` times the columns."""
        factors = {"fx": across, "fy": down, "cx": across, "cy": down}
        return replace(self, lens={name: value * factors[name] for name, value in self.lens.items()})

    def poses(self, size: tuple[int, int]) -> PoseBox:
        """Return the set of all poses for which pictures may be bounded, with pictures of ``size`` (height, width)."""
        ranges = {name: (-FARTHEST, FARTHEST) if name in TRANSLATIONS else (-_TURN, _TURN) for name in self.names}
        ranges |= {name: (value, value) for name, value in self.fixed.items()}
        height, width = size
        focal = partial(focal_length, self.fov, height, "camera.fov")
        lens = stated_intrinsics(self.lens, focal, height, width, "camera.")
        pose = np.concatenate([self.rotation, np.zeros((3, 1))], axis=1)
        camera = PinholeCamera(pose, *lens[:4], width=width, height=height)
        chosen = [{n: ranges[n] for n in group if n in ranges} for group in (TRANSLATIONS, ROTATIONS)]
        return PoseBox.around(camera, Perturbation(frame="world", translation=chosen[0], rotation=chosen[1]))

    @property
    def place(self) -> tuple[Float64, Float64]:
        """Matrix [3, n] and offset [3] of the camera's position ``matrix x + offset`` (world axes, normalised)."""
        matrix, offset = np.zeros((3, self.factors.shape[1])), np.zeros(3)
        for axis, name in enumerate(TRANSLATIONS):
            if name in self.names:
                k = self.names.index(name)
                matrix[axis], offset[axis] = self.factors[k], self.offset[k]
            else:
                offset[axis] = self.fixed[name]
        return matrix, offset

    def values(self, x: Float64) -> Float64:
        """Return the pose parameters [d] at a state [n], in float64."""
        return self.offset + self.factors @ x


@dataclass(frozen=True)
class Control:
    """The control law ``u = clip(K (y - goal))`` of the network's outputs y.

    Attributes:
        gain: [m, o] K.
        goal: [o].
        lower, upper: [m] limits, infinite where nothing is clipped.
    """

    gain: Float64
    goal: Float64
    lower: Float64
    upper: Float64

    def of(self, outputs: Float64) -> Float64:
        """Return the control [m] for outputs [o], in float64."""
        return np.clip(self.gain @ (outputs - self.goal), self.lower, self.upper)


@dataclass(frozen=True)
class Loop:
    """A closed loop as LOOP.json describes it.

    Attributes:
        names, units: Of the states [n].
        lower, upper: [n] initial box.
        dt: Sampling time, seconds.
        disturbance: [2, n] least and most of what is added to every next state.
        control: The control law; None until the number of the network's outputs is known.
        unsafe: Closed sets, each given by functions: a state is outside where any of them is positive.
        required: Properties of the picture: a state is unsafe where its picture lacks one of them.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    lower: Float64
    upper: Float64
    steps: int
    dt: float
    dynamics: Dynamics | LearnedDynamics
    disturbance: Float64
    camera: CameraMount
    network: Path
    preprocess: Preprocess
    control: Control
    unsafe: tuple[tuple[HalfSpace, ...], ...]
    required: tuple[PictureProperty, ...]
    goal: Goal | None
    value: Mapping[str, Any]

    @property
    def views(self) -> dict[str, PictureProperty]:
        """All properties of the picture, by the key of LOOP.json that states them; the goal's is the last."""
        keys = [f"unsafe[{k}]" for k, entry in enumerate(self.value.get("unsafe", [])) if is_of_picture(entry)]
        named = dict(zip(keys, self.required, strict=True))
        return named if self.goal is None or self.goal.view is None else {**named, "goal": self.goal.view}

    @property
    def loading(self) -> dict[str, Any]:
        """Keyword arguments for `load_network`."""
        # pictures of loops are the renderer's floats
        return {**self.preprocess.loading(self.value.get("output")), "whole_numbers": False}

    @property
    def box(self) -> ParameterBox:
        """The box of the initial states that vary; cells are cut from it."""
        free = [k for k in range(len(self.names)) if self.lower[k] < self.upper[k]]
        return ParameterBox(
            tuple(self.names[k] for k in free),
            tuple(self.units[k] for k in free),
            tuple(float(self.lower[k]) for k in free),
            tuple(float(self.upper[k]) for k in free),
        )

    def initial(self, box: ParameterBox) -> tuple[Float64, Float64]:
        """Return lower and upper ends [n] of all states for a cell of the initial box."""
        lower, upper = self.lower.copy(), self.upper.copy()
        for name, low, high in zip(box.names, box.lower, box.upper, strict=True):
            lower[self.names.index(name)], upper[self.names.index(name)] = low, high
        return lower, upper

    def state(self, box: ParameterBox, values: Sequence[float] | Float64) -> Float64:
        """Return the state [n] at parameter values [m] in a cell of the initial box."""
        x = self.lower.copy()
        for name, value in zip(box.names, values, strict=True):
            x[self.names.index(name)] = value
        return x


def load_loop(path: str | Path) -> Loop:
    """Return the loop in LOOP.json; the files that it names lie beside it. InputError."""
    path = Path(path)
    value = load_json(path, "loop file")
    try:
        return parse_loop(value, path.parent)
    except InputError as error:
        raise error.within(path) from None


def parse_loop(value: Any, folder: Path, dataset_scale: float | None = 1.0) -> Loop:
    """Return the loop of LOOP.json's content, checked. InputError.

    Args:
        dataset_scale: Normalised units per unit of the data set, for distances in pictures; None: not known.
    """
    if not isinstance(value, dict):
        raise fail("", f"found {show(value)}", "write an object")
    known(value, KEYS, "", fail)
    if value.get("version") != 1 or isinstance(value.get("version"), bool):
        raise fail("version", f"found {show(value.get('version'))}", "write 1")
    names = _names(value.get("state"))
    n = len(names)
    units = value.get("units", [""] * n)
    if not (isinstance(units, list) and len(units) == n and all(isinstance(u, str) and len(u) < 40 for u in units)):
        raise fail("units", f"found {show(units)}", f"write {n} short texts")
    lower, upper = _ranges(value.get("initial"), "initial", names, every=True)
    steps = value.get("steps")
    if type(steps) is not int or not 1 <= steps <= MOST_STEPS:
        raise fail("steps", f"found {show(steps)}", f"write a whole number from 1 to {MOST_STEPS}")
    dt = number(value.get("sampling_time"), "sampling_time", positive=True)
    dynamics = parse_dynamics(value.get("dynamics"), n, dt, folder)
    disturbance = np.stack(_ranges(value.get("disturbance", {}), "disturbance", names))
    network = named_file(value.get("network"), "network", folder)
    if "output" in value and not (isinstance(output := value["output"], str) and output):
        raise fail("output", f"found {show(output)}", "write the name of one of the network's outputs")
    unsafe = value.get("unsafe", [])
    if not isinstance(unsafe, list) or len(unsafe) > _MOST_SETS:
        raise fail("unsafe", f"found {show(unsafe)}", f"write a list of at most {_MOST_SETS} sets")
    view = partial(_view, folder=folder, dataset_scale=dataset_scale)
    required = tuple(view(entry, f"unsafe[{k}]") for k, entry in enumerate(unsafe) if is_of_picture(entry))
    goal = None if "goal" not in value else _goal(value["goal"], names, view)
    if not unsafe and goal is None:
        raise fail("unsafe", "missing", "give unsafe sets, or a goal, or both")
    return Loop(
        names,
        tuple(units),
        lower,
        upper,
        steps,
        dt,
        dynamics,
        disturbance,
        _camera(value.get("camera"), n),
        network,
        parse_preprocess(value.get("preprocess", {})),
        _control(value.get("control"), dynamics.controls),
        tuple(_unsafe(entry, f"unsafe[{k}]", names) for k, entry in enumerate(unsafe) if not is_of_picture(entry)),
        required,
        goal,
        value,
    )


def _names(value: Any) -> tuple[str, ...]:
    good = isinstance(value, list) and 1 <= len(value) < MOST
    good = good and all(isinstance(v, str) and 0 < len(v) <= 40 and v.isprintable() for v in value)
    if not good or len(set(value)) != len(value):
        raise fail("state", f"found {show(value)}", f"write 1 to {MOST - 1} different short names")
    return tuple(value)


def _ranges(value: Any, field: str, names: tuple[str, ...], *, every: bool = False) -> tuple[Float64, Float64]:
    """Return ends [2][n] of intervals by state; a number r stands for [-r, r], or with ``every`` for r itself."""
    if not isinstance(value, Mapping):
        raise fail(field, f"found {show(value)}", "write an object with a range by state")
    known(value, names, f"{field}.", fail)
    ends = np.zeros((2, len(names)))
    for k, name in enumerate(names):
        entry = value.get(name)
        if entry is None and not every:
            continue
        if every and is_number(entry):
            entry = [entry, entry]
        low, high = interval(entry, f"{field}.{name}", fail)
        if not is_moderate(low) or not is_moderate(high):
            raise fail(f"{field}.{name}", f"found {show([low, high])}", "write moderate numbers")
        ends[:, k] = low, high
    return ends[0], ends[1]


def _camera(value: Any, n: int) -> CameraMount:
    if not isinstance(value, Mapping):
        raise fail("camera", f"found {show(value)}", "write an object")
    known(value, ("camera_to_world", "fov", *LENS, "position", *ROTATIONS), "camera.", fail)
    pose = checked_pose(value.get("camera_to_world"), "camera.camera_to_world")
    fov = value.get("fov", 45.0)
    focal_length(fov, 1, "camera.fov")
    lens = {name: value[name] for name in LENS if value.get(name) is not None}
    stated_intrinsics(lens, lambda: 1.0, 1, 1, "camera.")
    names: list[str] = []
    rows: list[Float64] = []
    offsets: list[float] = []
    fixed: dict[str, float] = {}

    def take(name: str, offset: float, row: Float64) -> None:
        if row.any():
            names.append(name)
            rows.append(row)
            offsets.append(offset)
        elif abs(offset) > (FARTHEST if name in TRANSLATIONS else _TURN):
            raise fail("camera", f"{name} is {offset:g}", f"stay within {FARTHEST:g} units and {_TURN:g} rad")
        else:
            fixed[name] = offset

    place = value.get("position")
    if not isinstance(place, Mapping):
        raise fail("camera.position", f"found {show(place)}", "write an object with offset and matrix")
    known(place, ("offset", "matrix"), "camera.position.", fail)
    start = numbers(place.get("offset", [0.0] * 3), "camera.position.offset", 3)
    factors = matrix(place.get("matrix"), "camera.position.matrix", 3, n)
    if pose[:, 3].any():
        raise fail("camera.camera_to_world", "has a position", "write 0, 0, 0 there: camera.position says where it is")
    for name, offset, row in zip(TRANSLATIONS, start, factors, strict=True):
        take(name, float(offset), row)
    for name in ROTATIONS:
        entry = value.get(name, {})
        if not isinstance(entry, Mapping):
            raise fail(f"camera.{name}", f"found {show(entry)}", "write an object with offset and row")
        known(entry, ("offset", "row"), f"camera.{name}.", fail)
        offset = number(entry.get("offset", 0.0), f"camera.{name}.offset")
        take(name, offset, numbers(entry.get("row", [0.0] * n), f"camera.{name}.row", n))
    if not names:
        raise fail("camera", "the pose does not depend on the state", "give it a matrix or a row that is not 0")
    return CameraMount(pose[:, :3].copy(), float(fov), lens, tuple(names), np.array(offsets), np.stack(rows), fixed)


def _control(value: Any, controls: int) -> Control:
    if not isinstance(value, Mapping):
        raise fail("control", f"found {show(value)}", "write an object with gain, goal and clip")
    known(value, ("gain", "goal", "clip"), "control.", fail)
    gain = np.eye(controls) if "gain" not in value else matrix(value["gain"], "control.gain", controls, None)
    if gain.shape[1] > _MOST_OUTPUTS:
        raise fail("control.gain", f"{gain.shape[1]} columns", f"use a network of at most {_MOST_OUTPUTS} outputs")
    goal = numbers(value.get("goal", [0.0] * gain.shape[1]), "control.goal", gain.shape[1])
    lower, upper = np.full(controls, -np.inf), np.full(controls, np.inf)
    clip = value.get("clip")
    if clip is not None:
        if not isinstance(clip, list) or len(clip) != controls:
            raise fail("control.clip", f"found {show(clip)}", f"write {controls} intervals [low, high]")
        for k, entry in enumerate(clip):
            lower[k], upper[k] = interval(entry, f"control.clip[{k}]", fail, symmetric=False)
    return Control(gain, goal, lower, upper)


def _box_faces(value: Any, field: str, names: tuple[str, ...], *, inside: bool) -> tuple[HalfSpace, ...]:
    """Return the functions of a box's sides: all positive ``inside``, or else each positive beyond its own side."""
    if not isinstance(value, Mapping) or not value:
        raise fail(field, f"found {show(value)}", "write an object with [low, high] by state, null for no end")
    known(value, names, f"{field}.", fail)
    faces = []
    for name, ends in value.items():
        good = isinstance(ends, list) and len(ends) == 2 and all(v is None or is_number(v) for v in ends)
        if not good or ends == [None, None] or (None not in ends and ends[0] > ends[1]):
            raise fail(f"{field}.{name}", f"found {show(ends)}", "write [low, high], null where there is no end")
        unit = np.eye(len(names))[names.index(name)]
        for end, sign in zip(ends, (1.0, -1.0), strict=True):
            if end is not None:
                side = sign if inside else -sign
                faces.append(HalfSpace(tuple((side * unit).tolist()), side * float(end)))
    return tuple(faces)


def _unsafe(value: Any, field: str, names: tuple[str, ...]) -> tuple[HalfSpace, ...]:
    if not isinstance(value, Mapping) or len(value) != 1:
        raise fail(field, f"found {show(value)}", f'write {{"box": ..}}, {{"half_space": ..}} or {_VIEW}')
    known(value, ("box", "half_space"), f"{field}.", fail)
    if "box" in value:
        return _box_faces(value["box"], f"{field}.box", names, inside=False)
    entry = value["half_space"]
    if not isinstance(entry, Mapping):
        raise fail(f"{field}.half_space", f"found {show(entry)}", "write an object with normal and at_least")
    known(entry, ("normal", "at_least"), f"{field}.half_space.", fail)
    normal = numbers(entry.get("normal"), f"{field}.half_space.normal", len(names))
    if not normal.any():
        raise fail(f"{field}.half_space.normal", "all are 0", "write a direction")
    end = number(entry.get("at_least"), f"{field}.half_space.at_least")
    return (HalfSpace(tuple((-normal).tolist()), -end),)


def _view(value: Mapping[str, Any], field: str, folder: Path, dataset_scale: float | None) -> PictureProperty:
    """Return the property of the picture under the key ``field``."""
    try:
        if "partitions" in value:
            raise fail("partitions", "is for certificates", "remove it")
        return parse_picture_property(dict(value), folder, dataset_scale)
    except InputError as error:
        raise within_field(error, field) from None


def within_field(error: InputError, field: str) -> InputError:
    """Return an error of a property's key with the key ``field`` of the property in front of it."""
    return InputError(error.problem, file=error.file, field=f"{field}.{error.field}", fix=error.fix)


def _goal(value: Any, names: tuple[str, ...], view: Callable[[Any, str], PictureProperty]) -> Goal:
    if not isinstance(value, Mapping):
        raise fail("goal", f"found {show(value)}", f"write an object with box and when, or {_VIEW}")
    when = value.get("when", "end")
    if when not in ("end", "any") or not isinstance(when, str):
        raise fail("goal.when", f"found {show(when)}", "write end or any")
    if is_of_picture(value):
        return Goal((), when, view({key: v for key, v in value.items() if key != "when"}, "goal"))
    known(value, ("box", "when"), "goal.", fail)
    return Goal(_box_faces(value.get("box"), "goal.box", names, inside=True), when)  # pyright: ignore[reportArgumentType]
