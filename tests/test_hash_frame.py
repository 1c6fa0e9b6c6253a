"""Frames of nerfacto: bounds over sets of poses hold every render, at tolerance zero (design.md, H8, F12)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from benchmark_scripts import script
from nerfactos import random_net, tiny_nerfacto
from nerfs import poses

from ns_abstract.methods.nerf.hash_bounds.bounds import NerfactoFrame

attack_nerfacto = script("attack_nerfacto")

SETS = {
    "yaw": {"rotation": {"yaw": 1e-3}},
    "narrow": {"rotation": {"yaw": 1e-9}},
    "orbit": {"orbit": {"target": [0, 0, 0], "axis": [0, 0.1, 1], "azimuth": [0.3, 0.302]}},
    "hue": {"rotation": {"yaw": 1e-4}, "hue": 0.05, "saturation": [-0.2, 0.1]},
    "fixed": {"rotation": {"yaw": 1e-4}, "hue": [0.3, 0.3]},
    "two": {"rotation": {"yaw": 1e-4}, "translation": {"x": 1e-4}},
}


@pytest.mark.slow_cases
@pytest.mark.parametrize("name", [*SETS, "depths"])
def test_sets_of_poses_are_enclosed(name: str) -> None:
    """Bounds of rays, and planes of certificates, of half a set; ``depths``: proposals of unequal depth."""
    pose_set, scene = poses(SETS.get(name, SETS["yaw"])), tiny_nerfacto(1)
    if name == "depths":
        rng, (first, second) = np.random.default_rng(0), scene.field.proposals
        first = replace(first, net=random_net(rng, first.encoding.size, 8, 8, 1, bias=4.0))
        second = replace(second, net=random_net(rng, second.encoding.size, 1, bias=4.0))
        scene = replace(scene, field=replace(scene.field, proposals=(first, second)))
    frame = NerfactoFrame(scene, pose_set)
    tiles, rng = np.arange(4), np.random.default_rng(0)
    box = pose_set.box.split(0, 2)[0]
    found, planes = frame.bound(box, tiles), frame.cell_bounds(box)
    assert float((found.upper - found.lower).mean()) < 0.3
    values = [box.middle, *box.corners(), *box.sample(12, rng)]
    low, high, half = np.array(box.lower), np.array(box.upper), 0.5
    assert planes.linear is not None
    a_low, b_low, a_high, b_high = (part.astype(np.float64) for part in planes.linear)
    for v in values:
        exact = frame.precise(v)
        assert np.all(found.lower <= exact[tiles]) and np.all(exact[tiles] <= found.upper)
        p = (v - half * (low + high)) / (half * (high - low))
        assert np.all(a_low @ p + b_low <= exact) and np.all(exact <= a_high @ p + b_high)


@pytest.mark.slow
def test_fields_and_cameras_that_are_hard_are_enclosed() -> None:
    """Densities that overflow, empty and contradicting fields; poses beside faces and kinks, cameras far outside."""
    attack = attack_nerfacto.Attack()
    for seed in range(2 * len(attack_nerfacto.FIELDS)):
        attack_nerfacto.attack_once(seed, attack, side=3, poses=8, own=True)
    assert not attack.cases
    # most bounds say something, and poses were found where the field has kinks
    assert attack.known > attack.compared // 3 and attack.special > attack.compared // 32
