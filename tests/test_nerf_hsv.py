"""Shifts of hue and saturation: against Python's own conversion; bounds contain them."""

from __future__ import annotations

import colorsys

import numpy as np
import pytest
import torch
from nerfs import UNIFORM, pixels_of, poses, tiny_scene

from ns_abstract.io.errors import InputError
from ns_abstract.methods.nerf import frame as frame_module
from ns_abstract.methods.nerf.frame import NerfFrame
from ns_abstract.methods.nerf.hsv import shifted, shifted_bounds
from ns_abstract.refine.engine import Refinement, RefinementGoal
from ns_abstract.verify.attack.falsify import falsify
from ns_abstract.verify.attack.soundness import nerf_renderer


def test_shifts_are_those_of_hsv() -> None:
    rng = np.random.default_rng(0)
    colors = np.concatenate([rng.uniform(size=(200, 3)), rng.integers(0, 3, (100, 3)) / 2.0])
    for hue, saturation in ((0.0, 0.0), (0.15, 0.0), (-0.7, 0.3), (1.0, -0.4), (0.4, 1.0), (0.0, -1.0)):
        found = shifted(torch.from_numpy(colors), hue, saturation).numpy()
        for color, new in zip(colors, found, strict=True):
            h, s, v = colorsys.rgb_to_hsv(*color)
            expected = colorsys.hsv_to_rgb((h + hue) % 1.0, min(1.0, max(0.0, s + saturation)), v)
            if v > 0.0:
                np.testing.assert_allclose(new, expected, atol=1e-12)


def boxes(rng: np.random.Generator, count: int, width: float, special: int) -> tuple[np.ndarray, np.ndarray]:
    """Boxes of colours [n, 3], ``special`` of them about grey, black, white and pure ones."""
    centre = rng.uniform(size=(count, 3))
    centre[:special] = rng.integers(0, 3, (special, 3)) / 2.0
    size = width * rng.uniform(size=(count, 3)) * rng.integers(0, 2, (count, 3))
    return np.clip(centre - size, 0.0, 1.0), np.clip(centre + size, 0.0, 1.0)


def excess(width: float, span: float, seed: int, special: int = 100, samples: int = 60) -> tuple[float, float]:
    """Largest distance of a shifted colour beyond its bounds, and mean width over true width."""
    rng = np.random.default_rng(seed)
    low, high = boxes(rng, 300, width, special)
    hue = tuple(np.sort(rng.uniform(-1, 1) + span * rng.uniform(-0.5, 0.5, 2)).tolist())
    saturation = tuple(np.sort(rng.uniform(-0.6, 0.6) + span * rng.uniform(-0.5, 0.5, 2)).tolist())
    down, up = shifted_bounds(low, high, hue, saturation)
    found = []
    for k in range(samples):
        share = rng.uniform(size=low.shape) if k % 2 else rng.integers(0, 2, low.shape)
        at = rng.uniform(size=2) if k % 3 else rng.integers(0, 2, 2)
        color = torch.from_numpy(np.clip(low + share * (high - low), low, high))
        shift = [a + t * (b - a) for (a, b), t in zip((hue, saturation), at, strict=True)]
        found.append(shifted(color, *shift).numpy())
    lowest, highest = np.min(found, axis=0), np.max(found, axis=0)
    wider = (up - down).mean() / max(1e-300, (highest - lowest).mean())
    return float(max((down - lowest).max(), (highest - up).max())), float(wider)


@pytest.mark.slow_cases
@pytest.mark.parametrize("width", [0.0, 1e-3, 0.05, 0.4, 1.0])
@pytest.mark.parametrize("span", [0.0, 0.02, 0.3, 2.0])
def test_bounds_contain_every_shifted_colour(width: float, span: float) -> None:
    for seed in range(4):
        assert excess(width, span, seed)[0] <= 0.0


def test_tightness() -> None:
    """No unnoticed loosening, over the widths that sampling finds."""
    for width, span, limit in ((0.0, 0.02, 1.6), (0.02, 0.0, 3.2), (0.02, 0.1, 2.2)):
        assert max(excess(width, span, seed, special=0)[1] for seed in range(4)) < limit


SETS = {
    "hue": {"hue": 0.15},
    "saturation": {"saturation": [-0.3, 0.3]},
    "both": {"hue": [0.0, 0.1], "saturation": 0.2},
    "fixed": {"hue": [0.3, 0.3], "rotation": {"yaw": 0.002}},
    "hue and yaw": {"hue": 0.05, "rotation": {"yaw": 0.002}},
}


def attacked(spec: dict, cells: int) -> tuple[int, int, float]:
    scene, pose_set = tiny_scene(3, density=30.0), poses(spec)
    frame = NerfFrame(scene, UNIFORM, pose_set)
    result = Refinement(frame, 0, RefinementGoal(ratio=1.1, seconds=120.0, cells=cells)).run()
    render, probe, twin = nerf_renderer(scene, pose_set, UNIFORM)
    found = falsify(result.lower, result.upper, pose_set.box, render, twin, probe=probe, poses=80, seed=1)
    last = result.trace[-1]
    return found.comparisons, found.violations, last.mpg / last.mpg_witness


@pytest.mark.slow
@pytest.mark.parametrize("name", SETS)
def test_sets_of_colours_are_enclosed(name: str) -> None:
    compared, violations, ratio = attacked(SETS[name], 40)
    assert compared > 0 and violations == 0
    assert ratio < 2.5


@pytest.mark.slow
def test_forgotten_shifts_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frame_module.NerfFrame, "_shifts", lambda self, box: [])
    assert attacked(SETS["hue"], 8)[1] > 0


def test_a_hue_turned_right_round_changes_nothing() -> None:
    scene, pose_set = tiny_scene(3), poses({"hue": [1.0, 1.0]})
    shown = NerfFrame(scene, UNIFORM, pose_set).render(np.zeros(0))
    plain = NerfFrame(scene, UNIFORM, poses({})).render(np.zeros(0))
    np.testing.assert_allclose(shown, plain, atol=1e-6)
    assert len(pixels_of(pose_set.camera)) == len(shown)


def test_shifts_out_of_range_are_refused() -> None:
    with pytest.raises(InputError, match="within -1 and 1"):
        poses({"saturation": 1.5})
