"""Slanted cells: rotations that make up for what other parameters move (design.md, P2)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from flint import fmpq
from oracle import rational
from test_poses import SETS, camera, escapes, random_rotation

from ns_abstract.api.files import PathJob
from ns_abstract.bench.sets import open_jobs, pose_set, splat_of
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.geometry.tiles import assemble
from ns_abstract.methods.splat.frame import SplatFrame
from ns_abstract.refine.engine import Refinement, RefinementGoal
from ns_abstract.refine.result import FrameResult

#: As found for real scenes, and steeper, of both signs.
SHEARS = {
    "six": {"yaw": {"x": 0.43, "z": 0.01}, "pitch": {"y": -0.44, "z": 0.07}, "roll": {"x": -0.06}},
    "six_world": {"yaw": {"x": 3.7, "y": -2.9, "z": 0.11}, "roll": {"z": 1e-3}},
    "orbit_six": {"pitch": {"azimuth": -1.3}, "yaw": {"x": -11.0, "azimuth": 0.9}},
    "far": {"yaw": {"x": 1e-5}},
}


def slanted(name: str) -> PoseBox:
    return PoseBox.around(camera(random_rotation(1)), SETS[name]).sheared(SHEARS[name])


def exact(poses: PoseBox, values: dict[str, fmpq]) -> dict[str, fmpq]:
    """Slanted parameters of a pose, without rounding."""
    found = dict(values)
    for name, factors in poses.shear.items():
        found[name] -= sum((rational(f) * values[other] for other, f in factors.items()), fmpq(0))
    return found


def members(poses: PoseBox, plain: ParameterBox, count: int) -> list[dict[str, fmpq]]:
    """Slanted parameters of poses of the set: its corners, and inside."""
    random = np.random.default_rng(3)
    inner = random.uniform(-1, 1, (count, plain.dimensions))
    found = []
    for row in [*np.sign(random.uniform(-1, 1, (count, plain.dimensions))), *inner]:
        values = {}
        for name, low, high, weight in zip(plain.names, plain.lower, plain.upper, row, strict=True):
            values[name] = rational(low) + (rational(weight) + 1) / 2 * (rational(high) - rational(low))
        found.append(exact(poses, values))
    return found


def holds(box: ParameterBox, values: dict[str, fmpq]) -> bool:
    return all(
        rational(low) <= values[name] <= rational(high)
        for name, low, high in zip(box.names, box.lower, box.upper, strict=True)
    )


@pytest.mark.parametrize("name", SHEARS)
def test_every_pose_has_slanted_parameters(name: str) -> None:
    poses = slanted(name)
    plain = PoseBox.around(poses.camera, poses.perturbation).box
    assert all(holds(poses.box, values) for values in members(poses, plain, 100))


@pytest.mark.slow_cases(every=3)
@pytest.mark.parametrize("name", SHEARS)
def test_feasible_loses_no_pose(name: str) -> None:
    poses = slanted(name)
    plain = PoseBox.around(poses.camera, poses.perturbation).box
    points = members(poses, plain, 60)
    boxes = [poses.box]
    for axis in (*range(poses.box.dimensions), *range(poses.box.dimensions)):
        boxes = [half for box in boxes for half in box.split(axis)]
        if len(boxes) > 64:
            boxes = [boxes[i] for i in np.random.default_rng(axis).permutation(len(boxes))[:64]]
        for box in boxes:
            found = poses.feasible(box)
            for values in points:
                if holds(box, values):
                    assert found is not None and holds(found, values)


def test_feasible_shrinks_and_empties() -> None:
    poses = slanted("six")
    box = poses.box
    axis, x = box.names.index("yaw"), box.names.index("x")
    width = box.upper[axis] - box.lower[axis]
    end = box.replace(axis, box.upper[axis] - 0.01 * width, box.upper[axis])
    found = poses.feasible(end)
    # at the end of the slanted yaw only one end of x belongs to the set
    assert found is not None and found.upper[x] < box.middle[x]
    assert poses.feasible(end.replace(x, box.middle[x], box.upper[x])) is None
    plain = PoseBox.around(poses.camera, poses.perturbation)
    assert plain.feasible(plain.box) == plain.box


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("name", SHEARS)
def test_enclosure(name: str, order: int) -> None:
    poses = slanted(name)
    assert escapes(poses, poses.box, order, 2) == []
    box = poses.box
    for axis in range(box.dimensions):
        box = box.split(axis, 3)[1]
    assert escapes(poses, box, order, 2) == []


def test_concrete_poses_belong_to_the_set() -> None:
    """Witnesses are members: rotations beyond the set's go to its end, corners to corners."""
    poses = slanted("six")
    plain = PoseBox.around(poses.camera, poses.perturbation)
    shown = {tuple(np.round(poses.pose(v), 12).ravel()) for v in poses.box.corners()}
    assert shown == {tuple(np.round(plain.pose(v), 12).ravel()) for v in plain.box.corners()}


@pytest.fixture(scope="module")
def job(blobs) -> PathJob:
    return open_jobs((blobs.config,), blobs.path, 1.0)[0]


def program_of(job: PathJob) -> tuple[Any, Any, Any]:
    splat = splat_of(job)
    return splat.splats, splat.rasteriser, splat.arithmetic


def refined(job: PathJob, slant: bool, cells: int) -> tuple[PoseBox, FrameResult]:
    poses = pose_set(job, "six", 0, 8.0)
    frame = SplatFrame(*program_of(job), poses, sheared=slant)
    assert bool(frame.pose_set.shear) == slant
    return poses, Refinement(frame, 0, RefinementGoal(1.0001, 300.0, cells)).run()


@pytest.mark.slow
def test_slanted_cells_enclose_and_are_tighter(job: PathJob) -> None:
    poses, result = refined(job, True, 150)
    frame = SplatFrame(*program_of(job), poses)
    for values in [*poses.box.corners(), *poses.box.sample(60, np.random.default_rng(1))]:
        picture = assemble(frame.render(values), frame.camera)
        assert (result.lower <= picture).all() and (picture <= result.upper).all()
    _, straight = refined(job, False, 150)
    excess = [r.trace[-1].mpg - r.trace[-1].mpg_witness for r in (result, straight)]
    assert excess[0] < excess[1]


def test_what_turns_undo_does_not_move(job: PathJob) -> None:
    """Motion is that of the slanted parameters, also where the box holds parameters of no pose (R1)."""
    poses = pose_set(job, "six", 0, 8.0)
    straight, slant = (SplatFrame(*program_of(job), poses, sheared=sheared) for sheared in (False, True))
    shifts = [poses.box.names.index(name) for name in ("x", "y")]
    assert (slant.motion(slant.box)[shifts] < 0.5 * straight.motion(straight.box)[shifts]).all()
    # a pose beyond the set is another one than what is rendered for it
    corner = slant.box.corners()[0]
    assert not np.allclose(slant.pose_set.pose(corner), slant.pose_set.pose(corner, beyond=True))
    assert np.array_equal(poses.pose(poses.box.corners()[0]), poses.pose(poses.box.corners()[0], beyond=True))


def test_a_shear_that_loses_poses_is_noticed(job: PathJob, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = PoseBox.sheared

    def narrowed(self, shear):
        return replace(whole(self, shear), box=self.box.replace(3, 0.0, 0.001))

    monkeypatch.setattr(PoseBox, "sheared", narrowed)
    poses, result = refined(job, True, 150)
    frame = SplatFrame(*program_of(job), poses)
    pictures = [assemble(frame.render(values), frame.camera) for values in poses.box.corners()]
    assert any((p < result.lower).any() or (p > result.upper).any() for p in pictures)
