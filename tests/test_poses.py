"""Sets of poses against their definition, evaluated with 200 bits and compared at tolerance zero."""

from __future__ import annotations

import math
from fractions import Fraction

import mpmath
import numpy as np
import pytest
import torch
from flint import fmpq
from oracle import BITS, big, inside, rational, rational_of

from ns_abstract.arithmetic.rounding import UNIT64
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.differentiable_pose import differentiable_pose
from ns_abstract.geometry.poses import (
    SCENE_SHIFTS,
    SCENE_TURNS,
    PoseBox,
    axis_angle,
    orthonormal,
    rotation_about,
    translation_only,
)
from ns_abstract.io.errors import InputError
from ns_abstract.perturbation.specification import Orbit, Perturbation

Matrix = mpmath.matrix
FLIP = (1, -1, -1)


def turn(axis: Matrix, angle: mpmath.mpf) -> Matrix:
    """Right-handed rotation about the unit vector ``axis``."""
    x, y, z = axis
    c, s = mpmath.cos(angle), mpmath.sin(angle)
    k = Matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return mpmath.eye(3) + s * k + (1 - c) * (k * k)


def elementary(name: str, angle: mpmath.mpf) -> Matrix:
    """The elementary rotations Ry, Rx, Rz of contract.md section 2, written out."""
    c, s = mpmath.cos(angle), mpmath.sin(angle)
    return {
        "yaw": Matrix([[c, 0, s], [0, 1, 0], [-s, 0, c]]),
        "pitch": Matrix([[1, 0, 0], [0, c, -s], [0, s, c]]),
        "roll": Matrix([[c, -s, 0], [s, c, 0], [0, 0, 1]]),
    }[name]


def nearest_rotation(matrix: Matrix) -> Matrix:
    """Polar factor by Newton's iteration (A + A^-T)/2."""
    for _ in range(12):
        matrix = (matrix + (matrix**-1).T) / 2
    return matrix


def exact_matrix(array: np.ndarray) -> Matrix:
    return Matrix([[big(x) for x in row] for row in np.atleast_2d(array).tolist()])


def reference(poses: PoseBox, values: dict[str, fmpq]) -> tuple[Matrix, Matrix]:
    """Camera-to-world rotation and position by definition, from parameter values (missing ones are 0)."""
    names = ("x", "y", "z", "yaw", "pitch", "roll", "segment", "azimuth", *SCENE_SHIFTS, *SCENE_TURNS)
    p = {name: big(values.get(name, fmpq(0))) for name in names}
    start = exact_matrix(poses.camera.camera_to_world)
    rotation, position = start[:, :3], start[:, 3]
    if poses.target_camera is not None:
        end = exact_matrix(poses.target_camera.camera_to_world)
        first, last = nearest_rotation(rotation), nearest_rotation(end[:, :3])
        step = first.T * last
        vector = Matrix([step[2, 1] - step[1, 2], step[0, 2] - step[2, 0], step[1, 0] - step[0, 1]])
        length = mpmath.norm(vector)
        angle = mpmath.atan2(length, step[0, 0] + step[1, 1] + step[2, 2] - 1)
        rotation = first * turn(vector / length, p["segment"] * angle) if length > mpmath.mpf(2) ** -150 else first
        position = position + p["segment"] * (end[:, 3] - position)
    orbit = poses.perturbation.orbit
    if orbit is not None:
        axis = Matrix([big(x) for x in orbit.axis])
        target = Matrix([big(x) for x in orbit.target])
        rigid = turn(axis / mpmath.norm(axis), p["azimuth"])
        rotation, position = rigid * rotation, target + rigid * (position - target)
    shift = Matrix([p["x"], p["y"], p["z"]])
    position = position + (rotation * shift if poses.perturbation.frame == "camera" else shift)
    for name in ("yaw", "pitch", "roll"):
        rotation = rotation * elementary(name, p[name])
    # the scene is turned about z, then y, then x, then shifted
    x, y, z = (elementary(kind, p[name]) for kind, name in zip(("pitch", "yaw", "roll"), SCENE_TURNS, strict=True))
    scene, shift = x * y * z, Matrix([p[name] for name in SCENE_SHIFTS])
    return scene.T * rotation, scene.T * (position - shift)


def random_rotation(seed: int) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def camera(rotation: np.ndarray, position=(1.5, -0.5, 0.25), fx: float = 100.0) -> PinholeCamera:
    matrix = np.concatenate([rotation, np.array(position, np.float64)[:, None]], axis=1)
    return PinholeCamera(matrix, fx, fx, 16.0, 16.0, 32, 32)


def turned(rotation: np.ndarray, angle: float, seed: int = 8) -> np.ndarray:
    """``rotation`` followed by a turn by ``angle``, each entry the nearest float64."""
    axis = np.random.default_rng(seed).normal(size=3)
    with mpmath.workprec(BITS):
        unit = Matrix([big(x) for x in axis])
        result = exact_matrix(rotation) * turn(unit / mpmath.norm(unit), big(angle))
    return np.array(result.tolist(), dtype=np.float64)


def escapes(poses: PoseBox, box: ParameterBox, order: int, count: int = 4, seed: int = 0) -> list:
    """Entries of the enclosure over ``box`` that miss the pose of the definition, or the float64 pose."""
    forms = poses.enclosure(box, order)
    generator = np.random.default_rng(seed)
    scaled = [np.ones(box.dimensions), -np.ones(box.dimensions), np.zeros(box.dimensions)]
    scaled += [np.sign(generator.uniform(-1, 1, box.dimensions)) for _ in range(2)]
    scaled += list(generator.uniform(-1, 1, (count, box.dimensions)))
    found = []
    origin = exact_matrix(forms.origin).T
    for row in scaled:
        values, point = dict(poses.fixed), []
        values = {name: rational(v) for name, v in values.items()}
        for name, low, high, weight in zip(box.names, box.lower, box.upper, row, strict=True):
            v = rational(low) + (rational(weight) + 1) / 2 * (rational(high) - rational(low))
            values[name] = v
            # the parameter's form is middle + half p with float64 middle and half
            middle = 0.5 * (low + high)
            half = max(high - middle, middle - low) * (1.0 + 4.0 * UNIT64)
            point.append((v - rational(middle)) / rational(half) if half > 0 else fmpq(0))
        assert all(abs(p) <= 1 for p in point)
        own = dict(values)
        for name, factors in poses.shear.items():
            values[name] += sum((rational(f) * own[other] for other, f in factors.items()), fmpq(0))
        with mpmath.workprec(BITS):
            rotation, position = reference(poses, values)
            check(forms, rotation, position, origin, point, found, "definition")
            # what PoseSet.pose evaluates, where the parameters are float64 numbers
            if poses.shear:
                continue
            numbers = [int(values[name].p) / int(values[name].q) for name in box.names]
            if all(rational(n) == values[name] for n, name in zip(numbers, box.names, strict=True)):
                pose = exact_matrix(poses.pose(np.array(numbers)))
                check(forms, pose[:, :3], pose[:, 3], origin, point, found, "float64")
    return found


def check(forms, rotation, position, origin, point, found, what) -> None:
    world_to_camera = Matrix(3, 3)
    for i in range(3):
        for j in range(3):
            world_to_camera[i, j] = FLIP[i] * rotation[j, i]
    offset = world_to_camera * (origin - position)
    for i in range(3):
        parts = [("position", forms.position, i, position[i]), ("offset", forms.offset, i, offset[i])]
        parts += [("rotation", forms.rotation, 3 * i + j, world_to_camera[i, j]) for j in range(3)]
        for name, form, lane, exact in parts:
            number = rational_of(mpmath.mpf(exact))
            if not inside(form, lane, point, lambda: number):  # noqa: B023
                found.append((what, name, lane))


ALL = {"x": (-0.02, 0.03), "y": (0.0, 0.01), "z": (-0.05, -0.01)}
TURNS = {"yaw": (-0.1, 0.2), "pitch": (0.05, 0.06), "roll": (-0.3, 0.0)}
ORBIT = Orbit((0.1, -0.2, 0.3), (0.3, -1.0, 2.0), (0.0, 2 * math.pi))
SETS = {
    "x": Perturbation(translation={"x": (-0.1, 0.1)}),
    "translation": Perturbation(translation=ALL),
    "world": Perturbation(frame="world", translation=ALL, rotation={"yaw": (-0.1, 0.1)}),
    "rotation": Perturbation(rotation=TURNS),
    "six": Perturbation(translation=ALL, rotation=TURNS),
    "six_world": Perturbation(frame="world", translation=ALL, rotation=TURNS),
    "full_turn": Perturbation(rotation={"yaw": (-math.pi, math.pi)}),
    "many_turns": Perturbation(rotation={"roll": (-40.0, 60.0)}),
    "orbit": Perturbation(orbit=ORBIT),
    "orbit_six": Perturbation(
        translation=ALL, rotation=TURNS, orbit=Orbit((5.0, 0.0, 1.0), (0.0, 0.0, 1.0), (1.0, 1.2))
    ),
    "fixed": Perturbation(translation={"x": (0.3, 0.3)}, rotation={"yaw": (0.4, 0.4), "roll": (-2.0, -2.0)}),
    "fixed_orbit": Perturbation(
        orbit=Orbit((1.0, 2.0, 3.0), (1.0, 1.0, 0.0), (0.7, 0.7)), rotation={"pitch": (0.0, 0.1)}
    ),
    "nothing": Perturbation(),
    "narrow": Perturbation(translation={"x": (0.1, math.nextafter(0.1, 1))}, rotation={"yaw": (-1e-300, 1e-300)}),
    "far": Perturbation(translation={"x": (-1e3, 1e3)}, rotation={"yaw": (-0.01, 0.01)}),
}


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("name", SETS)
def test_enclosure(name, order):
    poses = PoseBox.around(camera(random_rotation(1)), SETS[name])
    assert escapes(poses, poses.box, order) == []


@pytest.mark.slow_cases(every=3)
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize(("names", "radius"), [(SCENE_SHIFTS, 0.03), (SCENE_TURNS, 0.2), (SCENE_TURNS, 1e-9)])
@pytest.mark.parametrize("name", ["nothing", "world", "orbit", "rotation"])
def test_enclosure_of_a_scene_elsewhere(name, names, radius, order):
    poses = PoseBox.around(camera(random_rotation(6)), SETS[name]).registered(names, radius)
    assert poses.box.names[-3:] == names and poses.box.upper[-3:] == (radius,) * 3
    assert escapes(poses, poses.box, order) == []
    point = ParameterBox(poses.box.names, poses.box.units, poses.box.upper, poses.box.upper)
    assert escapes(poses, point, order, 1) == []
    pose = differentiable_pose(poses)
    for values in poses.box.sample(5, np.random.default_rng(0)):
        assert np.allclose(pose(torch.from_numpy(values)).numpy(), poses.pose(values), rtol=0.0, atol=1e-13)


def test_a_set_that_grew_is_charged_for_where_it_reaches():
    """The positions of its float64 poses are off by no more than the charge, far beyond the ranges of the file, too."""
    rng, stated = np.random.default_rng(3), Perturbation(translation={"x": (-0.1, 0.1), "y": (-0.1, 0.1)})
    poses = PoseBox.around(camera(random_rotation(2)), stated)
    far = poses.within(ParameterBox(poses.box.names, poses.box.units, (1e6, 1e6), (1e6 + 0.2, 1e6 + 0.2)))
    matrix = [[Fraction(entry) for entry in row] for row in poses.camera.camera_to_world.tolist()]
    shares = []
    for values in far.box.sample(40, rng):
        shift = [Fraction(value) for value in values.tolist()]
        for row, entry in zip(matrix, far.pose(values)[:, 3].tolist(), strict=True):
            off = abs(row[0] * shift[0] + row[1] * shift[1] + row[3] - Fraction(entry))
            shares.append(off / Fraction(float(far._rounding[1])))
    assert 1e-3 < max(shares) <= 1
    outright = Perturbation(translation={"x": (1e6, 1e6 + 0.2), "y": (1e6, 1e6 + 0.2)})
    assert far._rounding == PoseBox.around(poses.camera, outright)._rounding


def test_a_scene_elsewhere_is_seen_as_it_would_be():
    """Points of a scene that is turned and shifted, and of the stored one by the pose that stands for it."""
    poses, rng = PoseBox.around(camera(random_rotation(7)), SETS["six"]), np.random.default_rng(1)
    points, turns, shifts = rng.normal(size=(20, 3)), rng.uniform(-0.5, 0.5, 3), rng.uniform(-0.5, 0.5, 3)
    values = poses.box.sample(1, rng)[0]
    pose = poses.pose(values)
    scene = np.linalg.multi_dot([rotation_about(axis, turn) for axis, turn in zip(np.eye(3), turns, strict=True)])
    for names, off, moved in ((SCENE_TURNS, turns, points @ scene.T), (SCENE_SHIFTS, shifts, points + shifts)):
        seen = poses.registered(names, 0.5).pose(np.concatenate([values, off]))
        assert np.allclose((moved - pose[:, 3]) @ pose[:, :3], (points - seen[:, 3]) @ seen[:, :3], atol=1e-12)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("name", ["six", "orbit", "full_turn"])
def test_enclosure_of_parts(name, order):
    """Cells of a set, and a cell of zero width."""
    poses = PoseBox.around(camera(random_rotation(2)), SETS[name])
    box = poses.box
    for axis in range(box.dimensions):
        box = box.split(axis, 3)[2]
    assert escapes(poses, box, order, 2) == []
    point = ParameterBox(box.names, box.units, box.lower, box.lower)
    assert escapes(poses, point, order, 1) == []


@pytest.mark.parametrize("distance", [1e-6, 1.0, 1e4])
def test_enclosure_scale(distance):
    """Cameras next to the origin and far from it."""
    rotation = random_rotation(3)
    for name in ("six", "orbit"):
        poses = PoseBox.around(camera(rotation, (distance, -0.3 * distance, 0.7 * distance)), SETS[name])
        assert escapes(poses, poses.box, 2, 2) == []


def test_written_rotation():
    """A keyframe's matrix is used as written, within the reader's tolerance of orthonormal."""
    rotation = random_rotation(4) + np.random.default_rng(0).uniform(-2e-4, 2e-4, (3, 3))
    poses = PoseBox.around(camera(rotation), SETS["six"])
    assert escapes(poses, poses.box, 1) == []
    assert np.array_equal(PoseBox.around(camera(rotation), SETS["nothing"]).pose(np.empty(0))[:, :3], rotation)


def segment(angle: float, perturbation: Perturbation | None = None, seed: int = 5) -> PoseBox:
    """A segment whose ends differ by a turn of ``angle``."""
    rotation = random_rotation(seed)
    sweep = Perturbation(sweep="segments") if perturbation is None else perturbation
    return PoseBox.around(camera(rotation), sweep, camera(turned(rotation, angle), (1.0, 0.5, 0.75)))


def thin_escapes(poses: PoseBox, order: int = 1) -> list:
    """`escapes` of cells of zero width along the segment: nothing but the rounding is left."""
    return [
        escape
        for s in (0.0, 0.3, 0.75, 1.0)
        for escape in escapes(poses, ParameterBox(("segment",), ("of the way",), (s,), (s,)), order, 0)
    ]


@pytest.mark.slow
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("angle", [0.01, 0.3, 1.0, 2.0, 3.0])
def test_segment(angle, order):
    poses = segment(angle)
    assert poses.box.names == ("segment",)
    assert escapes(poses, poses.box, order) == []
    assert thin_escapes(poses, order) == []


@pytest.mark.parametrize("order", [1, 2])
def test_segment_and_more(order):
    """A segment with an orbit and all six parameters on top."""
    orbit = Orbit((0.1, 0.2, 0.3), (0.0, 0.0, 1.0), (-0.1, 0.2))
    poses = segment(0.5, Perturbation(translation=ALL, rotation=TURNS, sweep="segments", orbit=orbit))
    assert poses.box.dimensions == 8
    assert escapes(poses, poses.box, order, 2) == []


@pytest.mark.slow_cases
@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-9, 4e-7, 6e-7, 1e-6, 1e-4])
def test_segment_nearly_equal(angle):
    poses = segment(angle)
    assert escapes(poses, poses.box, 1) == [] and thin_escapes(poses) == []


@pytest.mark.slow
@pytest.mark.parametrize("gap", [1e-1, 1e-2, 1e-4, 1e-6, 4e-7, 1e-9])
def test_segment_nearly_opposite(gap):
    for seed in range(3):
        poses = segment(math.pi - gap, seed=seed)
        assert thin_escapes(poses) == []


def test_segment_half_turn():
    """Both ways round are geodesics; the ends are the keyframes either way."""
    first = np.diag([1.0, 1.0, 1.0])
    for last in (np.diag([1.0, -1.0, -1.0]), np.diag([-1.0, 1.0, -1.0]), np.diag([-1.0, -1.0, 1.0])):
        poses = PoseBox.around(camera(first), Perturbation(sweep="segments"), camera(last))
        assert np.abs(poses.pose(np.array([0.0]))[:, :3] - first).max() < 1e-15
        assert np.abs(poses.pose(np.array([1.0]))[:, :3] - last).max() < 1e-15


def test_segment_fields_of_view():
    with pytest.raises(InputError, match="fov"):
        PoseBox.around(camera(np.eye(3)), Perturbation(sweep="segments"), camera(np.eye(3), fx=99.0))


def test_keyframes_ignore_the_next():
    poses = PoseBox.around(camera(np.eye(3)), SETS["x"], camera(random_rotation(6), fx=99.0))
    assert poses.target_camera is None and poses.box.names == ("x",)


def test_box_order():
    """Free parameters in the documented order; the others are fixed."""
    orbit = Perturbation(translation=ALL, rotation=TURNS, sweep="segments", orbit=ORBIT)
    poses = PoseBox.around(camera(np.eye(3)), orbit, camera(np.eye(3)))
    assert poses.box.names == ("x", "y", "z", "yaw", "pitch", "roll", "segment", "azimuth")
    assert poses.fixed == {}
    assert PoseBox.around(camera(np.eye(3)), SETS["fixed"]).fixed == {
        "x": 0.3, "y": 0.0, "z": 0.0, "yaw": 0.4, "pitch": 0.0, "roll": -2.0,
    }  # fmt: skip


def test_helpers():
    """`orthonormal` mends, `axis_angle` inverts `rotation_about`."""
    rotation = random_rotation(7)
    assert np.abs(orthonormal(1.0003 * rotation) - rotation).max() < 1e-15
    for angle in (0.1, 1.5, 3.0):
        axis, found = axis_angle(rotation_about(np.array([0.6, 0.0, -0.8]), angle))
        assert np.abs(axis - [0.6, 0.0, -0.8]).max() < 1e-14 and abs(found - angle) < 1e-14
    assert axis_angle(np.eye(3))[1] == 0.0


def test_translation_only():
    for name, expected in (("translation", True), ("nothing", True), ("fixed", True), ("six", False), ("orbit", False)):
        poses = PoseBox.around(camera(random_rotation(1)), SETS[name])
        assert translation_only(poses.enclosure(poses.box)) == expected


def widths(name: str, order: int) -> float:
    """Largest radius of the rotation's and offset's forms."""
    poses = PoseBox.around(camera(random_rotation(1)), SETS[name])
    forms = poses.enclosure(poses.box, order)
    return float(max(forms.rotation.radius.max(), forms.offset.radius.max()))


RECORDED = {
    ("x", 1): 3.341e-14,
    ("x", 2): 3.341e-14,
    ("translation", 1): 3.9e-14,
    ("rotation", 1): 0.02404,
    ("rotation", 2): 0.002912,
    ("six", 1): 0.02404,
    ("six", 2): 0.002912,
    ("orbit_six", 1): 0.1136,
    ("orbit_six", 2): 0.03016,
}


@pytest.mark.parametrize("name, order", RECORDED)
def test_tightness(name, order):
    assert widths(name, order) <= RECORDED[name, order] * 1.001
