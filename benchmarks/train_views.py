"""Train a small pose estimator, detector or classifier on pictures of the CPU renderer, and write it as ONNX.

    python benchmarks/train_views.py estimator RUN/config.yml ORBIT.json NET.onnx [--side 64] [--x 0.4 --y 0.15 --z 0.2]
    python benchmarks/train_views.py detector NET.onnx
    python benchmarks/train_views.py classifier NET.onnx

An estimator's outputs are the orbit's target as seen from the camera (x right, y up, z back; normalised units), for
cameras around the path's first one. Detector and classifier know the things of `objects.py`. Every fifth picture is
held back. With ``--certified`` an estimator's loss holds bounds over cells of poses of half-width ``--cell`` (parts of
its ranges), computed once, besides pictures; ``--training certified`` is the same of a classifier, whose cells also
hold all scenes of which colours and opacities of Gaussians are off by ``--color`` and ``--opacity``.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from objects import KINDS, RUNS, Thing, random_thing, random_things, scene
from torch import Tensor, nn
from torch.nn import functional
from views import HELD, Cells, cells, export, fit, head, joined, pictures

import ns_abstract as nsa
from ns_abstract.api.certification import FramePictures
from ns_abstract.api.files import resized
from ns_abstract.geometry.camera_path import PinholeCamera, load_camera_path
from ns_abstract.geometry.keyframe_cameras import around
from ns_abstract.geometry.poses import PoseBox
from ns_abstract.methods.splat.method import SplatMethod
from ns_abstract.perturbation.specification import parse_perturbation
from ns_abstract.verify.properties import ANCHORS, TrueValues, decode

#: Radians by which an estimator's camera is turned in training.
_TURN = 0.02
#: How small NeRFs are sampled, and where their rays begin.
SAMPLES, NEAR_PLANE = 32, 1.2
#: Classes and numbers of the head of the detection property (docs/dev/design.md, V4), and its anchors.
_VOC, _ANCHORS = 20, 5


@dataclass(frozen=True)
class Stand:
    """Where cameras stand: distance, and elevation in degrees, each from and to."""

    far: tuple[float, float]
    elevation: tuple[float, float] = (20.0, 42.0)


_STANDS = {"detector": Stand((2.4, 2.8)), "classifier": Stand((1.15, 1.45))}
#: Height of what they look at.
_HEIGHT = 0.1
#: With a run: parts of the distance that its cameras are shifted by, and how far those of other things are from its
#: camera's distance (parts) and elevation (degrees).
_SHIFT, _NEAR, _TILT = 0.05, 0.1, 10.0
#: Of how many first members (the brightest, the darkest, and random ones) a picture shows one.
_MEMBERS = 12
#: Radians by which a detector's camera is turned away from what a run shows.
_AWAY = 0.7
#: Score from which a box counts: the paper's threshold.
CONFIDENCE = 0.45


def sampled(options: argparse.Namespace) -> dict[str, Any]:
    """How a scene is opened."""
    return {"num_samples": SAMPLES, "near_plane": options.near_plane} if options.nerf else {}


def orbit_of(path: Path) -> dict[str, Any]:
    """A path's orbit."""
    return json.loads(path.read_text(encoding="utf-8"))["perturbation"]["orbit"]


def target_of(path: Path) -> list[float]:
    """The point that a path's orbit is about."""
    return orbit_of(path)["target"]


def truths(origin: list[float], poses: PoseBox, values: np.ndarray) -> Tensor:
    """[n, 3] where ``origin`` is seen from the camera, at parameter values [n, d]."""
    truth = TrueValues(("object.x", "object.y", "object.z"), (origin[0], origin[1], origin[2]))
    return torch.stack([truth.at(torch.from_numpy(poses.pose(v))) for v in values]).float()


def within(outputs: Tensor, truth: Tensor, part: float) -> float:
    """Share of outputs [n, 3] closer to the truth than ``part`` of its length."""
    return float(((outputs - truth).norm(dim=1) < part * truth.norm(dim=1)).float().mean())


def estimator(options: argparse.Namespace) -> None:
    shown = nsa.load_scene(options.run, **sampled(options))
    camera, origin = load_camera_path(options.path).cameras[0], target_of(options.path)
    ranges = {"x": options.x, "y": options.y, "z": options.z}
    turns = dict.fromkeys(("yaw", "pitch", "roll"), _TURN)
    poses = nsa.PoseSet(camera, translation={n: r for n, r in ranges.items() if r}, rotation=turns)
    drawn = resized(poses.of(shown), options.side, options.side)
    method, rng = shown.method(), np.random.default_rng(options.seed)
    values = drawn.box.sample(options.pictures, rng)
    images, truth = pictures(method, drawn, values), truths(origin, drawn, values)
    print(f"{len(images)} pictures, {time.process_time():.0f} CPU s", flush=True)
    held = torch.arange(len(images)) % HELD == 0
    model = head(options.side, 3)
    with torch.no_grad():
        model[-1].bias.copy_(truth.mean(dim=0))  # pyright: ignore
    right = truth[~held]
    size = right.norm(dim=1)

    def loss(outputs: Tensor, which: Tensor) -> Tensor:
        return (((outputs - right[which]) / size[which, None]) ** 2).sum(dim=1).mean() / options.tolerance**2

    sets, set_loss = None, None
    if options.certified > 0:
        moved = nsa.PoseSet(camera, translation={n: r for n, r in ranges.items() if r and n in options.cell_axes})
        small = resized(moved.of(shown), options.side, options.side)
        half = options.cell * 0.5 * (np.array(small.box.upper) - np.array(small.box.lower))
        sets = cells(method, small, small.box.sample(options.cells, rng), half)
        set_loss = regression_loss(sets, small, origin, options.tolerance)
        print(f"{options.cells} cells, {time.process_time():.0f} CPU s", flush=True)
    steps = fit(
        model, images[~held], loss, options.seconds, steps=options.steps, sets=sets, set_loss=set_loss,
        weight=options.certified,
    )  # fmt: skip
    export(model, options.side, options.network)
    with torch.no_grad():
        found = model(images[held])
    constant = truth[~held].mean(dim=0).expand_as(found)
    for part in (0.05, 0.1, 0.2):
        print(
            f"held back: within {part:.0%} of the distance {within(found, truth[held], part):.3f}; "
            f"the best constant {within(constant, truth[held], part):.3f}"
        )
    error = (found - truth[held]).norm(dim=1) / truth[held].norm(dim=1)
    print(f"mean relative error {float(error.mean()):.4f}, {steps} steps, {time.process_time():.0f} CPU s")


def regression_loss(sets: Cells, poses: PoseBox, origin: list[float], tolerance: float) -> Any:
    """Loss of the largest error over a cell, which should stay below ``tolerance`` times the distance."""
    middle = truths(origin, poses, sets.values)
    slopes = []
    for axis in range(sets.values.shape[1]):
        step = np.zeros_like(sets.values)
        step[:, axis] = sets.half[:, axis]
        slopes.append(0.5 * (truths(origin, poses, sets.values + step) - truths(origin, poses, sets.values - step)))
    slope, size = torch.stack(slopes, dim=1), middle.norm(dim=1)

    def loss(found: tuple[Tensor, Tensor, Tensor], which: Tensor, grown: float) -> Tensor:
        centre, along, radius = found
        worst = (centre - middle[which]).abs() + (along - grown * slope[which]).abs().sum(dim=1) + radius
        return ((worst.norm(dim=1) / (tolerance * size[which])) ** 2).mean()

    return loss


def photographed(
    things: Sequence[Thing],
    rng: np.random.Generator,
    stand: Stand,
    side: int,
    more: Mapping[str, Any] | None = None,
    background: np.ndarray | None = None,
) -> tuple[SplatMethod, PoseBox]:
    """Things and a camera somewhere around, with ``more`` of a perturbation file about it; see `scene`."""
    view = around((0.0, 0.0, _HEIGHT), rng.uniform(0.0, 360.0), rng.uniform(*stand.elevation), rng.uniform(*stand.far))
    camera = nsa.Camera(view.camera_to_world, view.fov, side, side)
    poses = PoseBox.around(camera, parse_perturbation({"version": 1, **(more or {})}))
    return SplatMethod(scene(things, int(rng.integers(1 << 30)), background), None, None), poses


def photo(things: Sequence[Thing], rng: np.random.Generator, kind: str, side: int) -> tuple[Tensor, PoseBox]:
    """The picture [3, side, side] of things from somewhere around, and its pose."""
    method, poses = photographed(things, rng, _STANDS[kind], side)
    return pictures(method, poses, np.zeros((1, 0)))[0], poses


# ---------------------------------------------------------------- detector


def backbone(channels: int = 32) -> nn.Sequential:
    """Features [channels, side / 8, side / 8]."""
    return nn.Sequential(
        nn.Conv2d(3, 16, 6, 4, 1), nn.ReLU(), nn.Conv2d(16, channels, 4, 2, 1), nn.ReLU(),
        nn.Conv2d(channels, channels, 3, 1, 1), nn.ReLU(),
    )  # fmt: skip


def whole_head(used: nn.Conv2d) -> nn.Conv2d:
    """The head of the detection property, whose first anchor and classes of `KINDS` are those of ``used``.

    ``used``: objectness, the classes in order, tx, ty, tw, th. All others are as good as never.
    """
    places = [0, *(_ANCHORS + number for number in KINDS.values()), *(_ANCHORS * (1 + _VOC) + k for k in range(4))]
    found = nn.Conv2d(used.in_channels, _ANCHORS * (1 + _VOC + 4), 1)
    with torch.no_grad():
        found.weight.zero_()
        found.bias.fill_(-8.0)  # pyright: ignore
        found.weight[places], found.bias[places] = used.weight, used.bias  # pyright: ignore
    return found


#: Pictures with boxes [n, 4] (x0, y0, x1, y1 in pixels) and numbers in `KINDS` [n] of what they show.
Marked = tuple[list[Tensor], list[Tensor], list[Tensor]]


def box_of(corners: np.ndarray, pose: np.ndarray, camera: PinholeCamera) -> Tensor:
    """x0, y0, x1, y1 in pixels around points [n, 3], seen from a pose [3, 4]."""
    x, y, z = pose[:, :3].T @ (corners - pose[:, 3]).T
    across, down = camera.cx - camera.fx * x / z, camera.cy + camera.fy * y / z
    return torch.tensor([across.min(), down.min(), across.max(), down.max()]).float()


def seen(boxes: Tensor, side: int) -> Tensor:
    """[n] whether a box's middle is in the picture."""
    middle = 0.5 * (boxes[:, :2] + boxes[:, 2:])
    return ((middle > 0.0) & (middle < side)).all(dim=1)


def photos_of_things(options: argparse.Namespace, rng: np.random.Generator) -> Marked:
    images, boxes, kinds = [], [], []
    for _ in range(options.pictures):
        things = random_things(rng, int(rng.integers(1, 5)))
        image, poses = photo(things, rng, "detector", options.side)
        pose = poses.pose(np.zeros(0))
        found = torch.stack([box_of(thing.corners(), pose, poses.camera) for thing in things])
        there = seen(found, options.side)
        images.append(image)
        boxes.append(found[there])
        kinds.append(torch.tensor([list(KINDS).index(t.kind) for t in things])[there])
    return images, boxes, kinds


def photos_of_run(options: argparse.Namespace, rng: np.random.Generator) -> Marked:
    """What a run shows: one thing at the path's target, or some of `RUNS`; often outside of the picture."""
    shown = nsa.load_scene(options.run, **sampled(options))
    camera, origin = load_camera_path(options.path).cameras[0], np.array(target_of(options.path))
    poses = nsa.PoseSet(
        camera, translation={"x": options.x, "y": 0.2, "z": 0.2}, rotation={"yaw": _AWAY, "pitch": 0.05, "roll": 0.05}
    )
    drawn = resized(poses.of(shown), options.side, options.side)
    values = drawn.box.sample(options.pictures, rng)
    # half of them as upright as those that are certified
    values[::2, 3:] *= 0.05
    if options.things is None:
        cube = origin + options.extent * np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
        there = [(options.kind_of_run, cube)]
    else:
        there = [(thing.kind, thing.corners()) for thing in RUNS[options.things][0]]
    number = torch.tensor([list(KINDS).index(kind) for kind, _ in there])
    boxes, kinds = [], []
    for v in values:
        found = torch.stack([box_of(corners, drawn.pose(v), drawn.camera) for _, corners in there])
        inside = seen(found, options.side)
        boxes.append(found[inside])
        kinds.append(number[inside])
    return list(pictures(shown.method(), drawn, values)), boxes, kinds


def overlaps(a: Tensor, b: Tensor) -> Tensor:
    """[n, m] IoU of boxes [n, 4] and [m, 4]."""
    common = (torch.minimum(a[:, None, 2:], b[:, 2:]) - torch.maximum(a[:, None, :2], b[:, :2])).clamp(min=0).prod(2)
    areas = [(box[:, 2:] - box[:, :2]).prod(dim=1) for box in (a, b)]
    return common / (areas[0][:, None] + areas[1] - common)


def detector(options: argparse.Namespace) -> None:
    rng, side = np.random.default_rng(options.seed), options.side
    grid, stride = side // 8, 8.0
    images, boxes, kinds = (photos_of_things if options.run is None else photos_of_run)(options, rng)
    print(f"{len(images)} pictures, {time.process_time():.0f} CPU s", flush=True)
    # what the head is to say: objectness, class and box of every grid cell
    there, kind = torch.zeros(len(images), grid, grid), torch.zeros(len(images), grid, grid, dtype=torch.long)
    target = torch.zeros(len(images), 4, grid, grid)
    for k, (found, numbers) in enumerate(zip(boxes, kinds, strict=True)):
        for (x0, y0, x1, y1), number in zip(found.tolist(), numbers.tolist(), strict=True):
            x, y = 0.5 * (x0 + x1) / stride, 0.5 * (y0 + y1) / stride
            i, j = int(y), int(x)
            there[k, i, j], kind[k, i, j] = 1.0, number
            sizes = np.log([(x1 - x0) / (ANCHORS[0][0] * stride), (y1 - y0) / (ANCHORS[0][1] * stride)])
            target[k, :, i, j] = torch.tensor([x - j, y - i, *sizes])
    held = torch.arange(len(images)) % HELD == 0
    shown, count = torch.stack(images), len(KINDS)
    there_, kind_, target_ = there[~held], kind[~held], target[~held]
    used = nn.Conv2d(32, 1 + count + 4, 1)
    with torch.no_grad():
        used.bias[0] = -3.0  # pyright: ignore
    model = nn.Sequential(*backbone(), used)

    def loss(outputs: Tensor, which: Tensor) -> Tensor:
        mask = there_[which] > 0
        value = functional.binary_cross_entropy_with_logits(outputs[:, 0], there_[which])
        logits, t = outputs[:, 1 : 1 + count].movedim(1, -1)[mask], outputs[:, 1 + count :].movedim(1, -1)[mask]
        right = target_[which].movedim(1, -1)[mask]
        centre = functional.mse_loss(torch.sigmoid(t[:, :2]), right[:, :2])
        size = functional.mse_loss(t[:, 2:], right[:, 2:])
        return 4.0 * value + functional.cross_entropy(logits, kind_[which][mask]) + 4.0 * centre + 2.0 * size

    steps = fit(model, shown[~held], loss, options.seconds, steps=options.steps)
    whole = nn.Sequential(*model[:-1], whole_head(used), nn.Flatten())
    export(whole, side, options.network)
    hits = said = things = 0
    with torch.no_grad():
        objectness, classes, where = decode(whole(shown[held]), stride)
    scores = (objectness[:, 0, None] * classes[:, 0, list(KINDS.values())]).flatten(2)
    for row, k in enumerate(held.nonzero().ravel().tolist()):
        best, which = scores[row].max(dim=0)
        chosen = best > CONFIDENCE
        found = where[row, 0].reshape(4, -1).T[chosen]
        match = (overlaps(boxes[k], found) > 0.5) & (kinds[k][:, None] == which[chosen])
        hits, said, things = hits + int(match.any(dim=1).sum()), said + int(chosen.sum()), things + len(boxes[k])
    print(
        f"held back, score above {CONFIDENCE} and IoU above 0.5: {hits} of {things} things found "
        f"({hits / max(1, things):.3f}), {said} boxes said ({hits / max(1, said):.3f}); {steps} steps, "
        f"{time.process_time():.0f} CPU s"
    )


# ---------------------------------------------------------------- classifier


def shown_member(method: SplatMethod, poses: PoseBox, values: np.ndarray, rng: np.random.Generator) -> Tensor:
    """[3, H, W] one of the scenes of a set, at parameter values [d]."""
    shown = FramePictures(method, poses)
    members = shown.scene_samples(int(rng.integers(1 << 30)))
    image = shown.image(values, next(itertools.islice(members, int(rng.integers(_MEMBERS)), None), None))
    return torch.from_numpy(image[..., :3]).permute(2, 0, 1).float()


def moved(shift: float, turn: float) -> dict[str, Any]:
    """A set of poses: shifts along the camera's axes and turns about them, of a perturbation file."""
    found = {"translation": dict.fromkeys("xyz", shift)}
    if turn > 0.0:
        found["rotation"] = dict.fromkeys(("yaw", "pitch", "roll"), turn)
    return found


class Turning:
    """Sets of poses of one run of a kind: all around the target of a path's orbit.

    Attributes:
        method: The run.
        whole: [azimuth and shifts] what pictures are taken from.
        cells: What cells lie in: the circle [azimuth], or shifts and turns of the path's first camera.
        background: [3] of the run.
        stand: Where cameras of other things stand.
    """

    def __init__(
        self, run: Path, path: Path, side: int, more: Mapping[str, Any], shift: float = 0.0, turn: float = 0.0
    ) -> None:
        given = nsa.load_scene(run)
        camera = load_camera_path(path).cameras[0]
        orbit = {**orbit_of(path), "azimuth": [-math.pi, math.pi]}
        out = camera.camera_to_world[:, 3] - np.array(orbit["target"])
        far = float(np.linalg.norm(out))
        elevation = math.degrees(math.asin(abs(float(out @ np.array(orbit["axis"]))) / far))

        def set_of(about: Mapping[str, Any]) -> PoseBox:
            value = {"version": 1, **about, **more}
            return resized(nsa.PoseSet.from_json(camera, value).of(given), side, side)

        method = given.method()
        if not isinstance(method, SplatMethod):
            raise SystemExit(f"{run}: other things can only stand before a splat scene's background")
        self.method = method
        self.cells = set_of(moved(shift, turn) if shift > 0.0 else {"orbit": orbit})
        self.whole = set_of({"orbit": orbit, **moved(_SHIFT * far, turn)})
        self.background = self.method.scene.background
        self.stand = Stand(
            ((1.0 - _NEAR) * far, (1.0 + _NEAR) * far), (max(0.0, elevation - _TILT), elevation + _TILT)
        )  # fmt: skip


def class_loss(right: Tensor, count: int) -> tuple[Tensor, Any]:
    """Rows of the outputs, and the cross-entropy of the least that each class [n] can be ahead of all others by.

    The rows [count^2, count] are all differences of two outputs: first the one that is ahead.
    """
    one = torch.eye(count)
    rows = (one[:, None] - one[None]).reshape(count * count, count)

    def loss(found: tuple[Tensor, Tensor, Tensor], which: Tensor, grown: float) -> Tensor:
        centre, along, radius = found
        ahead = (centre - along.abs().sum(dim=1) - radius).unflatten(1, (count, count))
        label = right[which]
        return functional.cross_entropy(-ahead[torch.arange(len(label)), label], label)

    return rows, loss


def classifier(options: argparse.Namespace) -> None:
    rng, names = np.random.default_rng(options.seed), list(KINDS)
    kinds = torch.arange(options.pictures) // 2 % len(names)
    limits = {name: r for name, r in (("color", options.color), ("opacity", options.opacity)) if r > 0.0}
    more: dict[str, Any] = {"scene": [{"select": {}, **limits}]} if limits else {}
    half = np.array([options.cell])
    if options.shift > 0.0:
        half = np.repeat([options.cell_shift, options.cell_turn], 3)
        # turns that make up for the shifts are among them, since all is farther than 1
        about = moved(options.cell_shift, options.cell_shift + options.cell_turn)
    else:
        turn = {"target": [0.0, 0.0, _HEIGHT], "axis": [0.0, 0.0, 1.0], "azimuth": [-options.cell, options.cell]}
        about = {"orbit": turn}
    run = None
    if options.run is not None:
        run = Turning(options.run, options.path, options.side, more, options.shift, options.turn)
    held = torch.arange(options.pictures) % HELD == 0
    bounded = options.training in ("signs", "certified")
    every = max(1, options.pictures // options.cells)
    images, sets, sides = [], [], []
    for k, kind in enumerate(kinds.tolist()):
        cell = bounded and not held[k] and k // (2 * len(names)) % every == 0
        if run is not None and names[kind] == options.kind_of_run:
            method, whole, around_it = run.method, run.whole, run.cells
        else:
            thing = random_thing(rng, names[kind], 0.06)
            stand, background = (_STANDS["classifier"], None) if run is None else (run.stand, run.background)
            method, whole = photographed(
                [thing], rng, stand, options.side, {**more, **(about if bounded else {})}, background
            )
            around_it = whole
        values = whole.box.sample(1, rng)[0]
        plain = pictures(method, whole, values[None])[0]
        images.append(plain if options.training == "plain" else shown_member(method, whole, values, rng))
        if cell:
            middle = around_it.box.sample(1, rng) if around_it is not whole else around_it.box.middle[None]
            sets.append(cells(method, around_it, middle, half, options.shift > 0.0))
            sides.append(kind)
    shown = torch.stack(images)
    print(f"{len(images)} pictures, {len(sets)} cells, {time.process_time():.0f} CPU s", flush=True)
    model, right = head(options.side, len(names)), kinds[~held]

    def entropy(outputs: Tensor, label: Tensor) -> Tensor:
        return functional.cross_entropy(outputs, label, label_smoothing=0.02)

    more_loss: dict[str, Any] = {}
    if bounded:
        label = torch.tensor(sides)
        rows, set_loss = class_loss(label, len(names))
        with_bounds = {"rows": rows, "set_loss": set_loss}
        with_signs = {"attacked": lambda outputs, which: entropy(outputs, label[which])}
        more_loss = {"sets": joined(sets), "weight": options.weight}
        more_loss |= with_bounds if options.training == "certified" else with_signs
    begin = time.process_time()
    steps = fit(
        model, shown[~held], lambda outputs, which: entropy(outputs, right[which]), options.seconds,
        steps=options.steps, **more_loss,
    )  # fmt: skip
    export(model, options.side, options.network)
    with torch.no_grad():
        accuracy = float((model(shown[held]).argmax(dim=1) == kinds[held]).float().mean())
    print(
        f"held back: {accuracy:.3f} right of {int(held.sum())}; {steps} steps in {time.process_time() - begin:.0f} CPU "
        f"s, {time.process_time():.0f} in all"
    )


def parser() -> argparse.ArgumentParser:
    found = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    kinds = found.add_subparsers(dest="kind", required=True)
    one = kinds.add_parser("estimator")
    one.add_argument("run", type=Path)
    one.add_argument("path", type=Path, help="camera path with an orbit")
    one.add_argument("--x", type=float, default=0.4, help="radius of the camera's shift, normalised units")
    one.add_argument("--y", type=float, default=0.15)
    one.add_argument("--z", type=float, default=0.2)
    one.add_argument("--tolerance", type=float, default=0.1, help="part of the distance")
    one.add_argument("--nerf", action="store_true", help="32 samples")
    one.add_argument("--certified", type=float, default=0.0, help="weight of the bounds; 0: plain training")
    one.add_argument("--cell", type=float, default=0.01, help="half-width of a cell, parts of the range's")
    one.add_argument("--cell-axes", default="x")
    one.add_argument("--cells", type=int, default=600)
    two = kinds.add_parser("detector")
    two.add_argument("--run", type=Path, help="left out: pictures of things on lawns")
    two.add_argument("--things", choices=list(RUNS), help="what the run shows; left out: one thing of --kind-of-run")
    two.add_argument("--kind-of-run", choices=list(KINDS), default="boat")
    two.add_argument("--path", type=Path, help="with --run: camera path with an orbit")
    two.add_argument("--x", type=float, default=0.5)
    two.add_argument("--extent", type=float, default=0.22, help="half a side of the cube around the thing")
    two.add_argument("--nerf", action="store_true")
    three = kinds.add_parser("classifier")
    three.add_argument("--run", type=Path, help="what shows one kind, before whose background the others stand")
    three.add_argument("--kind-of-run", choices=list(KINDS), default="aeroplane")
    three.add_argument("--path", type=Path, help="with --run: camera path with an orbit")
    three.add_argument("--color", type=float, default=0.0, help="how far the colour of every Gaussian may be off")
    three.add_argument("--opacity", type=float, default=0.0, help="the same of opacities")
    three.add_argument(
        "--training", choices=("plain", "members", "signs", "certified"), default="plain",
        help="on pictures of the scene, of scenes of the set; beside these, on cells: of the picture that a step by "
        "signs leads to, or of bounds",
    )  # fmt: skip
    three.add_argument("--weight", type=float, default=1.0, help="of cells")
    three.add_argument("--cell", type=float, default=0.0031, help="half-width of a cell, radians of the orbit")
    three.add_argument("--cells", type=int, default=800, help="about")
    three.add_argument(
        "--shift", type=float, default=0.0,
        help="with --run: cells are slanted parts of shifts of the path's first camera by this, normalised units, and "
        "--turn",
    )  # fmt: skip
    three.add_argument("--turn", type=float, default=0.0, help="radians of yaw, pitch and roll")
    three.add_argument("--cell-shift", type=float, default=0.012, help="half-widths of such a part")
    three.add_argument("--cell-turn", type=float, default=0.004)
    for kind in (one, two):
        kind.add_argument("--near-plane", type=float, default=NEAR_PLANE, help="where a NeRF's rays begin")
    for kind in (one, two, three):
        kind.add_argument("network", type=Path, help="where to write it")
        kind.add_argument("--side", type=int, default=64, help="pixels")
        kind.add_argument("--pictures", type=int, default=3000)
        kind.add_argument("--seconds", type=float, default=60.0, help="processor time of the training")
        kind.add_argument("--steps", type=int, help="of the training, in place of its time")
        kind.add_argument("--seed", type=int, default=0)
    return found


def main() -> None:
    options = parser().parse_args()
    torch.manual_seed(options.seed)
    options.network.parent.mkdir(parents=True, exist_ok=True)
    {"estimator": estimator, "detector": detector, "classifier": classifier}[options.kind](options)


if __name__ == "__main__":
    main()
