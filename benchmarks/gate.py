"""Makes the demo's gate on a meadow, the network of a drone that flies towards it, and LOOP.json.

    python benchmarks/gate.py ns_abstract/demo

Frame: z up, the course runs along +x from about x = 0, the gate's ring stands at x = `GATE`. All Gaussians are wide and
soft, so that pictures of few pixels change smoothly with the camera's place, and no two are equally far along +x, so
that their order is known from everywhere on the course.
"""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from airfield import write_scene
from approach import FOV, SIZE, rotation, write_approach
from numpy.typing import ArrayLike, NDArray

from ns_abstract.geometry.camera_path import PinholeCamera, focal_length
from ns_abstract.methods.splat.activate import SH_C0, activate
from ns_abstract.methods.splat.constants import GSPLAT_1_4_0
from ns_abstract.methods.splat.render import Renderer
from ns_abstract.methods.splat.scene import SplatScene

Array = NDArray[np.float64]

#: x of the ring, its radius, and z of the ground.
GATE, RADIUS, GROUND = 2.6, 0.55, -0.85
#: Beads of the ring; least distance along x between two Gaussians.
_BEADS, _APART = 12, 1e-3

_SKY = np.array([0.62, 0.78, 0.93])
_ORANGE, _WHITE, _POST = (0.98, 0.42, 0.06), (0.97, 0.95, 0.90), (0.35, 0.33, 0.36)


class _Blob(NamedTuple):
    """A Gaussian.

    Attributes:
        mean: [3] world.
        sigma: [3] standard deviations along x and along y and z turned about x.
        color: [3] RGB.
        opacity: In (0, 1).
        turn: Radians about x.
    """

    mean: ArrayLike
    sigma: ArrayLike
    color: ArrayLike
    opacity: float
    turn: float = 0.0


def _hills(rng: np.random.Generator) -> list[_Blob]:
    found = []
    for k in range(7):
        y = (k - 3.0) * 3.1 + rng.uniform(-0.4, 0.4)
        tone = np.array([0.42, 0.56, 0.60]) * rng.uniform(0.92, 1.08)
        found.append(_Blob((11.0, y, GROUND + 0.2), (0.3, 1.9, rng.uniform(0.7, 1.2)), tone, 0.8))
    return found


def _meadow(rng: np.random.Generator) -> list[_Blob]:
    """Overlapping discs of grass from the gate to the horizon, and a wide soft one in front."""
    found = [_Blob((2.2, 0.0, GROUND - 0.7), (0.2, 3.0, 0.5), (0.33, 0.50, 0.20), 0.95)]
    for row, x in enumerate(np.geomspace(2.7, 10.0, 7)):
        step = 0.55 * x
        for column in range(-3, 4):
            place = np.array([x, (column + 0.5 * (row % 2)) * step, GROUND]) + rng.uniform(-0.06, 0.06, 3) * [x, x, 0.2]
            tone = np.array([0.30, 0.47, 0.17]) * rng.uniform(0.85, 1.15) + rng.uniform(0.0, 0.05, 3)
            haze = np.clip((x - 3.0) / 9.0, 0.0, 1.0)
            found.append(_Blob(place, (0.16 * x, 0.42 * step, 0.03 * x), (1 - haze) * tone + haze * _SKY, 0.85))
    return found


def _ring() -> list[_Blob]:
    """A ring of long soft beads, orange and some white, on two posts."""
    found = []
    for k in range(_BEADS):
        angle = 2.0 * np.pi * (k + 0.5) / _BEADS
        mean = GATE, RADIUS * np.cos(angle), RADIUS * np.sin(angle)
        size = 0.04, 0.13, 1.3 * np.pi * RADIUS / _BEADS
        found.append(_Blob(mean, size, _WHITE if k % 4 == 3 else _ORANGE, 0.92, angle))
    for side in (-1.0, 1.0):
        for k in range(3):
            found.append(_Blob((GATE + 0.08, side * 0.8 * RADIUS, GROUND + 0.12 * k), (0.04, 0.05, 0.1), _POST, 0.9))
    return found


def gate(seed: int = 0) -> SplatScene:
    """The scene; equal seeds give equal arrays."""
    rng = np.random.default_rng(seed)
    blobs = [*_hills(rng), *_meadow(rng), *_ring()]
    means, sigma, colors, opacity, turn = (np.array(column, np.float64) for column in zip(*blobs, strict=True))
    for before, after in pairwise(np.argsort(means[:, 0], kind="stable")):
        means[after, 0] = max(means[after, 0], means[before, 0] + _APART)
    half, zero = 0.5 * turn, np.zeros_like(turn)
    return SplatScene(
        means=means.astype(np.float32),
        log_scales=np.log(sigma).astype(np.float32),
        quats=np.stack([np.cos(half), np.sin(half), zero, zero], axis=1).astype(np.float32),
        opacity_logits=np.log(opacity / (1.0 - opacity)).astype(np.float32),
        sh=((np.clip(colors, 0.0, 1.0) - 0.5) / SH_C0)[:, None].astype(np.float32),
        background=_SKY.astype(np.float32),
        name="gate",
    )


def main(folder: Path) -> None:
    scene = gate()
    write_scene(folder / "gate.npz", scene)
    renderer = Renderer(activate(scene, GSPLAT_1_4_0), GSPLAT_1_4_0)
    pose = rotation()
    turn = np.ascontiguousarray(pose[:3, :3].T * np.array([1.0, -1.0, -1.0])[:, None])
    focal = focal_length(FOV, SIZE, "fov")

    def render(place: Array) -> NDArray[np.float32]:
        pose[:3, 3] = place
        camera = PinholeCamera(
            camera_to_world=pose, fx=focal, fy=focal, cx=0.5 * SIZE, cy=0.5 * SIZE, width=SIZE, height=SIZE
        )
        return renderer.image(camera, turn, np.ascontiguousarray(place)).astype(np.float32)

    write_approach(folder, render)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
