"""Compares our bounds with the paper's rules, on the same Gaussians, pixels and cells.

The cost of the paper's depth-order rule grows with the square of the number of Gaussians, so each pixel gets a scene of
its own: the Gaussians with the largest weights there.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ns_abstract.api.files import PathJob
from ns_abstract.arithmetic.forms import Float64Array
from ns_abstract.arithmetic.rounding import REAL
from ns_abstract.bench.sets import pose_set, splat_of
from ns_abstract.geometry.box import ParameterBox
from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.methods.splat.activate import Splats, activate
from ns_abstract.methods.splat.bounds import SplatBounds
from ns_abstract.methods.splat.constants import PAPER
from ns_abstract.paper import Enclosure
from ns_abstract.paper import splat as paper

#: Poses rendered for the range that the bounds are compared with.
_SAMPLES = 33
#: Gaussians fainter than this at a pixel are no part of its scene.
_FAINT = 1e-3

#: Bounds [3] of the only pixel that a scene's camera has.
_Rule = Callable[[Splats, PinholeCamera], tuple[Float64Array, Float64Array]]

#: The paper's rules, and what they are without one of their parts.
PAPER_RULES: dict[str, dict[str, object]] = {
    "MATRIXINV, VR-IND": {},
    "adjugate, VR-IND": {"inverse": "adjugate"},
    "MATRIXINV, sorting": {"blend": "sort"},
    "MATRIXINV, VR-IND, interval alpha": {"linear": False},
}


def weights_at(splats: Splats, camera: PinholeCamera, rotation: Float64Array, position: Float64Array, u: Float64Array):
    """Return each Gaussian's compositing weight [N] at the point ``u`` [2], by Algorithm 1."""
    x, y, z = ((splats.means - position) @ rotation.T).T
    visible = np.flatnonzero((z >= PAPER.near) & (z <= PAPER.far))
    x, y, z = x[visible], y[visible], z[visible]
    axes = np.einsum("ij,njk->nik", rotation, splats.axes[visible])
    rows = [
        focal / z[:, None] * (axes[:, k] - (side / z)[:, None] * axes[:, 2])
        for k, (focal, side) in enumerate(((camera.fx, x), (camera.fy, y)))
    ]
    a, b, c = ((p * q).sum(axis=1) for p, q in ((rows[0], rows[0]), (rows[0], rows[1]), (rows[1], rows[1])))
    dx, dy = u[0] - camera.fx * x / z - camera.cx, u[1] - camera.fy * y / z - camera.cy
    with np.errstate(all="ignore"):
        q = (c * dx * dx - 2.0 * b * dx * dy + a * dy * dy) / (a * c - b * b)
        alpha = np.nan_to_num(splats.opacity[visible] * np.exp(-0.5 * q))
    order = np.argsort(z, kind="stable")
    light = np.concatenate([[1.0], np.cumprod(1.0 - alpha[order])[:-1]])
    weights = np.zeros(splats.count)
    weights[visible[order]] = light * alpha[order]
    return weights


def _pixel_camera(camera: PinholeCamera, column: int, row: int) -> PinholeCamera:
    """Return a camera of one pixel, whose centre is that of ``camera``'s pixel (column, row)."""
    return replace(camera, cx=camera.cx - column, cy=camera.cy - row, width=1, height=1)


def _own(
    splats: Splats, camera: PinholeCamera, poses: PoseBox, cell: ParameterBox
) -> tuple[Float64Array, Float64Array]:
    """Return our lower and upper bounds [3] of the only pixel, by the compiled stages."""
    bounds = SplatBounds(splats, PAPER, REAL)
    cell_bounds = bounds.cell(camera, poses.enclosure(cell, 2 if cell.dimensions == 1 else 1))
    return cell_bounds.lower[0, 0, 0], cell_bounds.upper[0, 0, 0]


def _all_rules(poses: PoseBox, cell: ParameterBox) -> dict[str, _Rule]:
    """Return our rules and the paper's, by name, for a cell of a set."""
    forms = poses.enclosure(cell, 1)

    def by_paper(options: dict[str, object]) -> _Rule:
        def bounded(scene: Splats, view: PinholeCamera) -> tuple[Float64Array, Float64Array]:
            enclosure: Enclosure = paper.bound(scene, view, forms, **options)  # pyright: ignore[reportArgumentType]
            low, high = enclosure.bounds()
            return np.clip(low[0], 0.0, 1.0), np.clip(high[0], 0.0, 1.0)

        return bounded

    rules: dict[str, _Rule] = {"ours": lambda scene, view: _own(scene, view, poses, cell)}
    return rules | {rule: by_paper(options) for rule, options in PAPER_RULES.items()}


def _scene_of_pixel(splats: Splats, weights: Float64Array, most: int) -> Splats | None:
    """Return the ``most`` Gaussians of the largest weights [N]; None where these sum to less than half."""
    chosen = np.sort(np.argsort(-weights, kind="stable")[:most])
    chosen = chosen[weights[chosen] >= _FAINT]
    if weights[chosen].sum() < 0.5:
        return None
    return replace(
        splats, means=splats.means[chosen], axes=splats.axes[chosen], opacity=splats.opacity[chosen],
        sh=splats.sh[chosen],
    )  # fmt: skip


def compare(
    job: PathJob, name: str, frame: int, parts: int, pixels: int, most: int, seed: int = 0
) -> list[dict[str, object]]:
    """Return mean gaps of all rules over sampled pixels, for the middle one of ``parts`` equal cells by axis.

    ``pixels`` are drawn from those where Gaussians have at least half of the weight; a pixel's scene has at most
    ``most`` Gaussians, those with the largest weights at the cell's middle. A row has the gap (length over RGB)
    relative to that of renders within the cell, its largest value over the pixels, and milliseconds by pixel.
    """
    splats = activate(splat_of(job).scene, PAPER)
    poses = pose_set(job, name, frame)
    cell = poses.box
    for axis in range(cell.dimensions):
        cell = cell.split(axis, parts)[parts // 2]
    camera, random = poses.camera, np.random.default_rng(seed)
    places = random.permutation(camera.width * camera.height)
    rules = _all_rules(poses, cell)
    gaps: dict[str, list[float]] = {rule: [] for rule in ("renders", *rules)}
    seconds = dict.fromkeys(rules, 0.0)
    outside = dict.fromkeys(rules, 0)
    counts: list[int] = []
    for place in places.tolist():
        row, column = divmod(place, camera.width)
        view = _pixel_camera(camera, column, row)
        weights = weights_at(splats, view, *poses.world_to_camera(cell.middle), np.array([0.5, 0.5]))
        scene = _scene_of_pixel(splats, weights, most)
        if scene is None:
            continue
        draws = [*cell.corners(), *cell.sample(_SAMPLES, random)]
        renders = np.stack([paper.render(scene, view, *poses.world_to_camera(values))[0] for values in draws])
        renders = np.clip(renders, 0.0, 1.0)
        least, greatest = renders.min(axis=0), renders.max(axis=0)
        gaps["renders"].append(float(np.linalg.norm(greatest - least)))
        counts.append(scene.count)
        for rule, bounded in rules.items():
            started = time.process_time()
            low, high = bounded(scene, view)
            seconds[rule] += time.process_time() - started
            gaps[rule].append(float(np.linalg.norm(high - low)))
            # renders are rounded, bounds are of real numbers
            outside[rule] += int((least < low - 1e-12).any() or (greatest > high + 1e-12).any())
        if len(counts) == pixels:
            break
    inner = float(np.mean(gaps["renders"]))
    return [
        {
            "scene": job.method.name,
            "size": f"{camera.width}x{camera.height}",
            "set": name,
            "cell": f"1/{parts}",
            "Gaussians": float(np.mean(counts)),
            "rules": rule,
            "renders' gap": inner,
            "gap": float(np.mean(gaps[rule])),
            "gap / renders'": float(np.mean(gaps[rule])) / inner,
            "largest gap": max(gaps[rule]),
            "ms by pixel": 1e3 * seconds[rule] / len(counts),
            "violations": outside[rule],
        }
        for rule in rules
    ]
