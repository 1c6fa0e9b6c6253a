"""Compare bounds of nerfacto with Nerfstudio's own picture in float64, at tolerance zero.

    python benchmarks/attack_nerfacto.py [--comparisons 1000000] [--seed 0] [--own]

Fields are small random ones, and such as are hard on the bounds: opaque, empty, of densities that overflow, of empty
tables, of proposals that contradict the field. Cameras are inside of walls, on faces of cells, parallel to axes and far
outside. Poses are corners, random ones, and floats on both sides of a face of the finest level or of a kink of the
contraction that some sample crosses. ``--own`` compares with this package's renderer, without Nerfstudio.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import math
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from ns_abstract.geometry.camera_path import PinholeCamera
from ns_abstract.geometry.keyframe_cameras import look_at
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.methods.nerf.hash_bounds import bounds
from ns_abstract.methods.nerf.hash_bounds.bounds import NerfactoFrame
from ns_abstract.methods.nerf.hash_field import DenseNet, HashEncoding, NerfactoField, NerfactoScene, ProposalField
from ns_abstract.methods.nerf.nerfacto_load import FEATURES, HARMONICS, resolutions
from ns_abstract.methods.nerf.nerfacto_render import NerfactoRenderer
from ns_abstract.methods.nerf.render import camera_rays
from ns_abstract.perturbation.specification import parse_perturbation

#: Draws colours [n, 3] of rays [n, 2, 3].
Draw = Callable[[np.ndarray], np.ndarray]


# ---------------------------------------------------------------- fields


def random_net(rng: np.random.Generator, *widths: int, bias: float = 0.0, scale: float = 1.0) -> DenseNet:
    """Layers whose outputs have standard deviations of about 1, the last one's first output ``bias + scale`` times."""

    def near(values: np.ndarray) -> np.ndarray:
        return np.asarray(values, np.float32).astype(np.float64)

    pairs = list(zip(widths[1:], widths[:-1], strict=True))
    weights = [near(rng.standard_normal((n, m)) * (2.0 / m) ** 0.5) for n, m in pairs]
    biases = [near(0.3 * rng.standard_normal(n)) for n, _ in pairs]
    weights[-1][0] = near(scale * weights[-1][0])
    biases[-1][0] = near(biases[-1][0] + bias)
    return DenseNet(tuple(weights), tuple(biases))


def random_grid(rng: np.random.Generator, levels: int, log2_size: int, most: int) -> HashEncoding:
    """A grid whose finer levels have smaller features."""
    table = rng.standard_normal((levels, 1 << log2_size, 2)) * 0.7 ** np.arange(levels)[:, None, None]
    return HashEncoding(table.astype(np.float32).astype(np.float64), resolutions(levels, 16, most))


#: Mean and spread of the logarithms of densities over 0.01: of the field, and of its proposals.
FIELDS: dict[str, tuple[tuple[float, float], tuple[float, float]]] = {
    "fog": ((4.0, 1.0), (4.0, 1.0)),
    "walls": ((0.0, 30.0), (0.0, 30.0)),
    "opaque": ((60.0, 1.0), (60.0, 1.0)),
    "empty": ((-900.0, 1.0), (-900.0, 1.0)),
    "overflow": ((0.0, 700.0), (0.0, 700.0)),
    "all overflows": ((900.0, 1.0), (900.0, 1.0)),
    "at overflow": ((714.0, 1.0), (714.0, 1.0)),
    "proposals overflow": ((4.0, 1.0), (900.0, 300.0)),
    "proposals see nothing": ((6.0, 3.0), (-900.0, 0.0)),
    "the field overflows": ((0.0, 1000.0), (3.0, 1.0)),
    "huge weights": ((0.0, 1e30), (0.0, 1e30)),
}


def random_field(rng: np.random.Generator, kind: str) -> NerfactoField:
    """A field of one of `FIELDS`, with any background, spacing and far end."""
    own, other = FIELDS[kind]
    samples = ((24, 16, 12), (16, 12), (1, 1), (3, 2, 1))[rng.integers(4)]
    grid = random_grid(rng, 4, 9, int(rng.choice([100, 2000])))
    if rng.random() < 0.1:
        grid = HashEncoding(np.zeros_like(grid.table), grid.resolutions)
    rounds = []
    for _ in samples[1:]:
        proposal = random_grid(rng, 3, 8, 50)
        rounds.append(
            ProposalField(proposal, random_net(rng, proposal.size, 8, 1, bias=other[0], scale=other[1]), 0.01)
        )
    backgrounds = "last_sample", np.zeros(3), np.ones(3)
    return NerfactoField(
        grid,
        random_net(rng, grid.size, 16, 1 + FEATURES, bias=own[0], scale=own[1]),
        random_net(rng, HARMONICS + FEATURES, 16, 16, 3),
        0.01,
        tuple(rounds),
        samples,
        far=float(rng.choice([6.0, 1000.0, 1e5])),
        spacing="uniform" if rng.random() < 0.2 else "piecewise",
        background=backgrounds[rng.integers(3)],
    )


# ---------------------------------------------------------------- cameras and sets

#: Origins of cameras.
PLACES: dict[str, Callable[[np.random.Generator], np.ndarray]] = {
    "near": lambda rng: rng.uniform(-0.8, 0.8, 3),
    "outside": lambda rng: 1.5 * rng.standard_normal(3),
    # multiples of every second cell of the finest level, and a corner of the cube that is not contracted
    "face": lambda rng: rng.integers(-12, 13, 3) / 12.5,
    "corner": lambda rng: rng.choice([-1.0, 1.0], 3),
    "axis": lambda rng: np.array([0.0, 0.0, rng.choice([0.0, 0.5, 1.0, 3.0])]),
    "far": lambda rng: 10.0 ** rng.uniform(2.0, 8.0) * rng.standard_normal(3),
    "beyond": lambda rng: 10.0 ** rng.uniform(14.0, 18.0) * rng.standard_normal(3),
}
SETS: dict[str, dict[str, Any]] = {
    "yaw": {"rotation": {"yaw": 3e-4}},
    "wide": {"rotation": {"yaw": 2e-3}},
    "narrow": {"rotation": {"yaw": 1e-9}},
    "x": {"translation": {"x": 3e-4}},
    "roll": {"rotation": {"roll": 3e-4}},
    "yaw and x": {"rotation": {"yaw": 5e-5}, "translation": {"x": 5e-5}},
    "three": {"rotation": {"yaw": 1e-5, "pitch": 1e-5}, "translation": {"z": 1e-5}},
}


def random_camera(rng: np.random.Generator, kind: str, side: int) -> PinholeCamera:
    """A camera at one of `PLACES`, an odd number of pixels wide; half of them look along an axis."""
    eye = PLACES[kind](rng)
    if rng.random() < 0.5:
        pose = np.eye(3, 4)
        pose[:, :3] = pose[:, rng.permutation(3)] * rng.choice([-1.0, 1.0], 3)
        pose[:, 0] *= np.linalg.det(pose[:, :3])
        pose[:, 3] = eye
    else:
        pose = look_at(tuple(eye), tuple(rng.uniform(-0.3, 0.3, 3)))[:3]
    focal = side * rng.choice([0.5, 1.4])
    return PinholeCamera(pose, focal, focal, 0.5 * side, 0.5 * side, side, side)


def rays_of(pose_set: PoseBox, values: np.ndarray) -> np.ndarray:
    """[pixels, 2, 3] origins and unit directions of all pixels at parameter ``values``."""
    camera, pose = pose_set.camera, np.asarray(pose_set.pose(values), np.float64)
    grid = np.indices((camera.height, camera.width)).reshape(2, -1).T
    world = camera_rays(camera, grid) @ pose[:, :3].T
    world /= np.linalg.norm(world, axis=1, keepdims=True)
    return np.stack([np.broadcast_to(pose[:, 3], world.shape), world], axis=1)


def labels_of(renderer: NerfactoRenderer, rays: np.ndarray, kinks: bool) -> np.ndarray:
    """[rays, samples, 3] cells of the finest level, or regions of the contraction [rays, samples, 1]."""
    finest, found = int(renderer.field.encoding.resolutions[-1]), []
    every = renderer.edges(*torch.from_numpy(rays).unbind(dim=1)).numpy()
    for ray, edges in zip(rays, every, strict=True):
        x = ray[0] + ray[1] * ((edges[1:] + edges[:-1]) / 2.0)[:, None]
        size = np.abs(x).max(axis=1)[:, None]
        if kinks:
            found.append(np.where(size < 1.0, -1, np.abs(x).argmax(axis=1)[:, None]))
        else:
            contracted = np.where(size < 1.0, x, (2.0 - 1.0 / np.maximum(size, 1.0)) * (x / np.maximum(size, 1.0)))
            found.append(np.floor((contracted + 2.0) / 4.0 * finest))
    return np.stack(found)


def crossings(rng: np.random.Generator, renderer: NerfactoRenderer, pose_set: PoseBox, count: int) -> list[np.ndarray]:
    """Parameter values on both sides of faces of the finest level and of kinks that samples cross."""
    low, high = np.array(pose_set.box.lower), np.array(pose_set.box.upper)
    found = []
    for kinks in (False, True):
        ends = low + rng.uniform(0.0, 0.1, low.size) * (high - low), high - rng.uniform(0.0, 0.1) * (high - low)
        start, end = (labels_of(renderer, rays_of(pose_set, v), kinks) for v in ends)
        for pixel, sample, axis in rng.permutation(np.argwhere(start != end))[:count]:
            a, b = ends
            for _ in range(60):
                middle = 0.5 * (a + b)
                there = labels_of(renderer, rays_of(pose_set, middle)[pixel : pixel + 1], kinks)[0, sample, axis]
                a, b = (a, middle) if there == end[pixel, sample, axis] else (middle, b)
            found += [a, b]
    return found


# ---------------------------------------------------------------- Nerfstudio


def nerfstudio_draw(field: NerfactoField) -> Draw:
    """Nerfstudio's own model of ``field`` in float64."""
    from ns_abstract.nerfstudio.torchvision_operators import declare_missing

    declare_missing()
    metric = importlib.import_module("torchmetrics.image.lpip")
    # its weights would be downloaded
    setattr(metric, "LearnedPerceptualImagePatchSimilarity", lambda **_options: torch.nn.Identity())  # noqa: B010
    nerfacto = importlib.import_module("nerfstudio.models.nerfacto")
    RayBundle = importlib.import_module("nerfstudio.cameras.rays").RayBundle
    box = importlib.import_module("nerfstudio.data.scene_box").SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3]))

    def sizes(encoding: HashEncoding) -> dict[str, int]:
        levels, rows, _ = encoding.table.shape
        return {
            "num_levels": levels,
            "log2_hashmap_size": rows.bit_length() - 1,
            "max_res": int(encoding.resolutions[-1]),
        }

    background = field.background
    if not isinstance(background, str):
        background = "white" if background.all() else "black"
    model = nerfacto.NerfactoModel(
        nerfacto.NerfactoModelConfig(
            implementation="torch", background_color=background, far_plane=field.far,
            average_init_density=field.average_init_density, use_appearance_embedding=False,
            hidden_dim=field.density_net.weights[0].shape[0], hidden_dim_color=field.color_net.weights[0].shape[0],
            num_proposal_iterations=len(field.proposals), num_proposal_samples_per_ray=field.samples[:-1],
            num_nerf_samples_per_ray=field.samples[-1], proposal_initial_sampler=field.spacing,
            proposal_net_args_list=[
                {**sizes(one.encoding), "hidden_dim": one.net.weights[0].shape[0], "use_linear": False}
                for one in field.proposals
            ], **sizes(field.encoding),
        ),
        scene_box=box, num_train_data=1,
    ).eval()  # fmt: skip

    def give_net(net: Any, values: DenseNet) -> None:
        for layer, weight, bias in zip(net.layers, values.weights, values.biases, strict=True):
            layer.weight.data, layer.bias.data = torch.from_numpy(weight).float(), torch.from_numpy(bias).float()

    def give(modules: Any, encoding: HashEncoding, values: DenseNet) -> None:
        grid, net = modules
        grid.hash_table.data = torch.from_numpy(encoding.table.reshape(-1, 2)).float()
        assert grid.scalings.int().tolist() == encoding.resolutions.tolist()
        give_net(net, values)

    give(model.field.mlp_base.model, field.encoding, field.density_net)
    give_net(model.field.mlp_head, field.color_net)
    for network, one in zip(model.proposal_networks, field.proposals, strict=True):
        give(network.mlp_base, one.encoding, one.net)
    model = model.double()

    def draw(rays: np.ndarray) -> np.ndarray:
        before = torch.get_default_dtype()
        torch.set_default_dtype(torch.float64)
        try:
            origins, directions = torch.from_numpy(rays).unbind(dim=1)
            n = len(rays)
            area, camera = torch.ones(n, 1), torch.zeros(n, 1, dtype=torch.long)
            with torch.no_grad():
                return model(RayBundle(origins, directions, area, camera_indices=camera))["rgb"].numpy()
        finally:
            torch.set_default_dtype(before)

    return draw


# ---------------------------------------------------------------- attack


@dataclasses.dataclass
class Attack:
    """What was compared: channels by kind, those outside of their bounds, and those of bounds narrower than 0.9."""

    compared: int = 0
    outside: int = 0
    known: int = 0
    special: int = 0
    worst: float = 0.0
    by_kind: Counter[str] = dataclasses.field(default_factory=Counter)
    cases: list[str] = dataclasses.field(default_factory=list)


def attack_once(seed: int, attack: Attack, side: int = 5, poses: int = 40, own: bool = False) -> None:
    """Draw a field, a camera and a set by ``seed``, bound all pixels over a part of the set and compare."""
    rng = np.random.default_rng(seed)
    kind, place, name = list(FIELDS)[seed % len(FIELDS)], rng.choice(list(PLACES)), rng.choice(list(SETS))
    field = random_field(rng, kind)
    pose_set = PoseBox.around(random_camera(rng, place, side), parse_perturbation(SETS[name]))
    frame = NerfactoFrame(NerfactoScene(field), pose_set)
    box = pose_set.box
    for axis in range(box.dimensions):
        box = box.split(axis, 2)[int(rng.integers(2))]
    part = dataclasses.replace(pose_set, box=box)
    found = frame.bound(box, np.arange(side * side))
    lower, upper = (one.reshape(-1, 3).astype(np.float64) for one in (found.lower, found.upper))
    renderer = NerfactoRenderer(field)
    special = crossings(rng, renderer, part, poses // 4)
    values = [box.middle, *box.corners(), *box.sample(poses, rng), *special]
    draw = nerfstudio_draw(field)
    if own:

        def draw(rays: np.ndarray) -> np.ndarray:
            return renderer.colors(*torch.from_numpy(rays).unbind(dim=1)).numpy()

    shown = draw(np.concatenate([rays_of(pose_set, v) for v in values])).reshape(len(values), -1, 3)
    off = np.maximum(lower - shown, shown - upper)
    # a colour that is no number counts as outside
    outside = int((~(off <= 0.0)).sum())
    attack.compared += shown.size
    attack.special += len(special) * shown[0].size
    attack.known += int((upper - lower < 0.9).sum()) * len(values)
    attack.by_kind[kind] += shown.size
    if outside:
        attack.outside += outside
        attack.worst = max(attack.worst, float(np.nan_to_num(off, nan=math.inf).max()))
        attack.cases.append(f"seed {seed}: {kind}, {place}, {name}: {outside} of {shown.size}, {off.max():.3g}")
        print(attack.cases[-1], flush=True)


def main() -> None:
    """Print what was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--comparisons", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--own", action="store_true")
    options = parser.parse_args()
    # many pieces would only make bounds tighter than they need to be here
    bounds._TUNING = dataclasses.replace(bounds._TUNING, deeper=4, most_pieces=64)
    attack, seed, start = Attack(), options.seed, time.perf_counter()
    while attack.compared < options.comparisons:
        attack_once(seed, attack, own=options.own)
        seed += 1
        if seed % 20 == 0:
            print(f"{attack.compared:,} after {time.perf_counter() - start:.0f} s", flush=True)
    print(
        f"{attack.compared:,} channels compared in {seed - options.seed} cases, {attack.special:,} next to faces and "
        f"kinks, {attack.known:,} of bounds narrower than 0.9: {attack.outside} outside, by {attack.worst:.3g}"
    )
    print(", ".join(f"{kind} {n:,}" for kind, n in attack.by_kind.items()))


if __name__ == "__main__":
    main()
