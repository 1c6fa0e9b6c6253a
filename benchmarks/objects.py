"""Splat scenes of things of several classes on a lawn, for detectors and classifiers.

    python benchmarks/objects.py OUTPUT_DIR

writes runs and camera paths (OUTPUT_DIR/NAME.json, with an orbit) of those that are certified: `RUNS`, and a small
NeRF. Classes have the numbers of VOC's, as the head of the detection property has them: `KINDS`.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from fit_buoy import REACH, buoy, fit_field
from nerf_network import NerfNetwork
from numpy.typing import ArrayLike, NDArray

from ns_abstract.demo.writing import TIMESTAMP
from ns_abstract.geometry.keyframe_cameras import KeyframeCamera, around, look_at, path_json
from ns_abstract.io.atomic import write_json
from ns_abstract.methods.nerf.scene import NerfScene
from ns_abstract.methods.nerf.write import write_nerf_run
from ns_abstract.methods.splat.activate import SH_C0
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.methods.splat.write import write_splatfacto_run

Array = NDArray[np.float64]

#: Kinds of things and their VOC numbers.
KINDS = {"aeroplane": 0, "boat": 3, "car": 6, "pottedplant": 15}
#: Colours of bodies; tones of the lawn and the sky.
_PAINTS = {
    "aeroplane": ((0.92, 0.93, 0.95), (0.75, 0.80, 0.88), (0.95, 0.88, 0.70)),
    "boat": ((0.15, 0.25, 0.60), (0.55, 0.12, 0.12), (0.10, 0.40, 0.42)),
    "car": ((0.80, 0.10, 0.08), (0.95, 0.75, 0.08), (0.12, 0.20, 0.75)),
    "pottedplant": ((0.72, 0.36, 0.18), (0.60, 0.30, 0.22), (0.80, 0.50, 0.30)),
}
_LAWN, _SKY = np.array([0.42, 0.55, 0.30]), np.array([0.72, 0.84, 0.94])
#: Discs of the lawn along a side, how far it reaches, and how deep it lies: Gaussians are sorted by their middles, and
#: no disc is to be nearer than a thing that stands before it.
_DISCS, _REACH, _DEPTH = 17, 3.0, 0.3
#: How many standard deviations of a Gaussian belong to the thing that a box is drawn around.
_EXTENT = 1.5

#: A Gaussian: mean [3], standard deviations [3] along x, y, z, colour [3].
Blob = tuple[ArrayLike, ArrayLike, ArrayLike]


def _aeroplane(paint: ArrayLike) -> list[Blob]:
    dark = (0.20, 0.24, 0.35)
    body = [
        ((x, 0.0, 0.14), (0.07, r, r), paint) for x, r in ((-0.22, 0.025), (-0.1, 0.04), (0.03, 0.045), (0.16, 0.04))
    ]
    wings = [((0.0, s * y, 0.14), (0.05, 0.07, 0.010), paint) for s in (-1, 1) for y in (0.12, 0.25)]
    tail = [((-0.27, s * 0.07, 0.17), (0.03, 0.05, 0.008), paint) for s in (-1, 1)]
    return [
        *body,
        *wings,
        *tail,
        ((-0.27, 0.0, 0.24), (0.035, 0.008, 0.05), dark),
        ((0.24, 0.0, 0.15), (0.02, 0.025, 0.02), dark),
    ]


def _boat(paint: ArrayLike) -> list[Blob]:
    hull = [
        ((x, 0.0, 0.06), (0.07, w, 0.035), paint) for x, w in ((-0.17, 0.06), (-0.04, 0.075), (0.09, 0.06), (0.2, 0.03))
    ]
    sail = [((0.0, 0.0, z), (w, 0.008, 0.06), (0.97, 0.97, 0.93)) for z, w in ((0.2, 0.09), (0.32, 0.06), (0.42, 0.03))]
    return [*hull, *sail]


def _car(paint: ArrayLike) -> list[Blob]:
    body = [((x, 0.0, 0.09), (0.07, 0.075, 0.035), paint) for x in (-0.14, 0.0, 0.14)]
    cabin = [((x, 0.0, 0.17), (0.055, 0.06, 0.03), (0.16, 0.20, 0.26)) for x in (-0.06, 0.05)]
    wheels = [((x, y, 0.045), (0.03, 0.015, 0.03), (0.06, 0.06, 0.07)) for x in (-0.14, 0.14) for y in (-0.1, 0.1)]
    return [*body, *cabin, *wheels]


def _pottedplant(paint: ArrayLike) -> list[Blob]:
    pot = [((0.0, 0.0, 0.06), (0.06, 0.06, 0.04), paint)]
    crown = [
        ((0.07 * np.cos(a), 0.07 * np.sin(a), z), (0.055, 0.055, 0.06), (0.10, g, 0.08))
        for a, z, g in ((0.3, 0.2, 0.34), (2.4, 0.24, 0.40), (4.4, 0.21, 0.30), (1.2, 0.34, 0.44))
    ]
    return [*pot, *crown]


_SHAPES = {"aeroplane": _aeroplane, "boat": _boat, "car": _car, "pottedplant": _pottedplant}


@dataclass(frozen=True)
class Thing:
    """Something that stands on the lawn.

    Attributes:
        kind: Of `KINDS`.
        place: x, y.
        turn: Radians about z.
        paint: Number of a colour.
        size: 1: about half a unit long.
    """

    kind: str
    place: tuple[float, float]
    turn: float
    paint: int = 0
    size: float = 1.0

    def blobs(self) -> tuple[Array, Array, Array]:
        """Means [n, 3] in the world, standard deviations [n, 3] along axes turned with the thing, colours [n, 3]."""
        parts = _SHAPES[self.kind](_PAINTS[self.kind][self.paint])
        means, sigmas, colors = (np.array(column, np.float64) for column in zip(*parts, strict=True))
        c, s = np.cos(self.turn), np.sin(self.turn)
        rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return self.size * means @ rotation.T + [*self.place, 0.0], self.size * sigmas, colors

    def corners(self) -> Array:
        """[n, 3] points of the world that a box around the thing holds."""
        means, sigmas, _ = self.blobs()
        c, s = np.cos(self.turn), np.sin(self.turn)
        axes = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        return np.concatenate(
            [means + sign * _EXTENT * sigmas[:, k : k + 1] * axes[k] for k in range(3) for sign in (-1, 1)]
        )


def random_thing(rng: np.random.Generator, kind: str, spread: float) -> Thing:
    """A thing within ``spread`` of the middle."""
    place = rng.uniform(-spread, spread, 2)
    return Thing(
        kind,
        (float(place[0]), float(place[1])),
        rng.uniform(0.0, 2.0 * np.pi),
        int(rng.integers(3)),
        rng.uniform(0.85, 1.15),
    )


def random_things(rng: np.random.Generator, count: int, spread: float = 0.8, apart: float = 0.62) -> list[Thing]:
    """Things of random kinds, at least ``apart`` from each other."""
    found: list[Thing] = []
    for _ in range(100 * count):
        thing = random_thing(rng, str(rng.choice(list(KINDS))), spread)
        if all(np.hypot(*np.subtract(thing.place, other.place)) > apart for other in found):
            found.append(thing)
        if len(found) == count:
            break
    return found


def _lawn(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Overlapping discs; see `Thing.blobs`."""
    step = 2.0 * _REACH / _DISCS
    grid = (np.stack(np.mgrid[:_DISCS, :_DISCS], axis=-1).reshape(-1, 2) + 0.5) * step - _REACH
    means = np.concatenate([grid + rng.uniform(-0.08, 0.08, grid.shape), np.full((len(grid), 1), -_DEPTH)], axis=1)
    sigmas = np.tile([0.62 * step, 0.62 * step, 0.02], (len(grid), 1))
    return means, sigmas, _LAWN * rng.uniform(0.9, 1.1, (len(grid), 1))


def scene(things: Sequence[Thing], seed: int = 0, background: ArrayLike | None = None) -> SplatScene:
    """Things on a lawn whose tones depend on ``seed``, under the sky; or before a ``background`` [3] alone."""
    parts = [(thing.blobs(), thing.turn) for thing in things]
    if background is None:
        parts.insert(0, (_lawn(np.random.default_rng(seed)), 0.0))
    means, sigmas, colors = (np.concatenate(column) for column in zip(*(blobs for blobs, _ in parts), strict=True))
    turns = np.concatenate([np.full(len(blobs[0]), turn) for blobs, turn in parts])
    zero = np.zeros_like(turns)
    return SplatScene(
        means=means.astype(np.float32),
        log_scales=np.log(sigmas).astype(np.float32),
        quats=np.stack([np.cos(0.5 * turns), zero, zero, np.sin(0.5 * turns)], axis=1).astype(np.float32),
        opacity_logits=np.full(len(means), 3.0, np.float32),
        sh=((np.clip(colors, 0.0, 1.0) - 0.5) / SH_C0)[:, None].astype(np.float32),
        background=np.asarray(_SKY if background is None else background, np.float32),
        name="things",
    )


#: Scenes that are certified: things, seed of the lawn, distance and elevation (degrees) of the camera.
RUNS: dict[str, tuple[list[Thing], int, float, float]] = {
    "lawn": (
        [
            Thing("aeroplane", (-0.35, 0.45), 2.2, 0, 1.05),
            Thing("car", (0.3, -0.35), 0.7, 0, 1.0),
            Thing("pottedplant", (0.45, 0.5), 0.0, 1, 1.1),
        ],
        101,
        2.6,
        32.0,
    ),
    **{kind: ([Thing(kind, (0.02, -0.03), 1.1, 1, 1.0)], 200 + k, 1.3, 30.0) for k, kind in enumerate(KINDS)},
}
#: Height of what is looked at, azimuth of the camera (degrees), and its pixels.
_HEIGHT, _AZIMUTH, _PIXELS = 0.1, 25.0, 32


#: The small NeRF: camera, field of view (degrees), end of the rays, and steps of its fit.
_EYE, _FOV, _FAR, _STEPS = (2.0, -1.4, 1.0), 40.0, 4.0, 1000


def _path(folder: Path, name: str, view: KeyframeCamera, target: tuple[float, float, float]) -> Path:
    orbit = {"target": list(target), "axis": [0.0, 0.0, 1.0], "azimuth": [0.0, 2.0 * np.pi]}
    value = path_json([view], perturbation={"version": 1, "sweep": "keyframes", "orbit": orbit})
    return write_json(folder / f"{name}.json", value)


def write_run(folder: Path, name: str) -> tuple[Path, Path]:
    """Write a run of `RUNS` and its camera path; returns config.yml and the path."""
    things, seed, far, elevation = RUNS[name]
    target = (0.0, 0.0, _HEIGHT)
    view = around(target, _AZIMUTH, elevation, far, height=_PIXELS, width=_PIXELS)
    config = write_splatfacto_run(
        scene(things, seed), folder, timestamp=TIMESTAMP, experiment_name=name, views=[view, view]
    )  # fmt: skip
    return config, _path(folder, name, view, target)


def write_nerf(folder: Path, steps: int = _STEPS) -> tuple[Path, Path]:
    """Fit a small NeRF (4 x 64) to the demo's buoy, which takes seconds, and write it and a path; see `write_run`."""
    torch.manual_seed(0)
    network = NerfNetwork(4, 64, 2, 2, 32)
    fit_field(network, buoy, REACH, steps, batch=1024)
    weights = network.weights()
    field = NerfScene(weights, weights, 0.0, _FAR, background=np.ones(3, np.float32), name="buoy")
    target = (0.0, 0.0, _HEIGHT)
    view = KeyframeCamera(look_at(_EYE, target), _FOV, _PIXELS, _PIXELS)
    config = write_nerf_run(field, folder, timestamp=TIMESTAMP, experiment_name="buoy")
    return config, _path(folder, "buoy", view, target)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output_dir", type=Path)
    folder = parser.parse_args().output_dir
    for name in RUNS:
        print(*write_run(folder, name))
    print(*write_nerf(folder))


if __name__ == "__main__":
    main()
