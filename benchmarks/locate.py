"""How much of a set of poses a photo leaves after a time, and whether the true pose is ever excluded.

    python benchmarks/locate.py CONFIG PATH [--set six|three] [--seconds 60] [--photos 5] [--no-contraction]
    python benchmarks/locate.py CONFIG PATH --follow 1000
    python benchmarks/locate.py CONFIG PATH --elsewhere
    python benchmarks/locate.py CONFIG PATH --sample 20
    python benchmarks/locate.py CONFIG PATH --processor 60 [--elsewhere]

Photos are rendered at hidden poses, 64 x 64 pixels, with noise uniform within 2/255 and 2 % of the pixels at random.
``--follow`` examines the cells that hold a hidden pose alone, until ``--depth`` of them or none is left, and exits with
1 where one of them is excluded. ``--elsewhere`` takes photos from outside of the set, whose answer has to be "none".
``--sample`` follows the cells that hold random poses of the set until these are excluded, and estimates from them what
a whole search takes: a cell that a random pose lies in with probability v stands for 1 / v cells. ``--processor``
searches in this process with one thread, until so many processor seconds are used: what others do on the machine
does not count.
"""

from __future__ import annotations

import argparse
import heapq
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

import ns_abstract as nsa
from ns_abstract.api.files import resized
from ns_abstract.api.job import Job
from ns_abstract.api.location import Location, PhotoOptions
from ns_abstract.execution.threads import use_threads
from ns_abstract.geometry.tiles import assemble

SETS = {
    "six": {"translation": dict.fromkeys("xyz", 0.05), "rotation": dict.fromkeys(("yaw", "pitch", "roll"), 0.05)},
    "three": {"translation": {"x": 0.3, "y": 0.3}, "rotation": {"yaw": 0.3}},
    "two": {"translation": {"x": 0.05}, "rotation": {"yaw": 0.05}},
}
SIZE, NOISE, OUTLIERS = 64, 2.0 / 255.0, 0.02
#: Cells that are not followed further by ``--sample``, as a part of the set.
FINEST = 3e-5


def photo(picture: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """A photo of 8 bits of a picture [H, W, 3]."""
    noisy = picture.astype(np.float64) + generator.uniform(-NOISE, NOISE, picture.shape)
    levels = np.rint(255.0 * np.clip(noisy, 0.0, 1.0)).astype(np.uint8)
    pixels = levels.reshape(-1, 3)
    places = generator.permutation(len(pixels))[: int(OUTLIERS * len(pixels))]
    pixels[places] = generator.integers(0, 256, (len(places), 3), np.uint8)
    return levels


def hidden(scene: nsa.Scene, poses: nsa.PoseSet, seed: int, beyond: bool) -> tuple[np.ndarray, np.ndarray]:
    """Parameters of a hidden pose, and its photo; ``beyond``: outside of the set by half of its width to once."""
    generator = np.random.default_rng(seed)
    frame = scene.method().frame(poses.of(scene))
    values = frame.box.sample(1, generator)[0]
    if beyond:
        half = 0.5 * (np.array(frame.box.upper) - frame.box.lower)
        values = frame.box.middle + half * generator.choice([-1.0, 1.0], len(half)) * generator.uniform(
            2.0, 3.0, len(half)
        )
        names = dict(zip(frame.box.names, values.tolist(), strict=True))
        turned = ("yaw", "pitch", "roll")
        ranges: list[Any] = [
            {n: (v - 1e-9, v + 1e-9) for n, v in names.items() if (n in turned) == t} for t in (False, True)
        ]
        frame = scene.method().frame(nsa.PoseSet(poses.camera, *ranges).of(scene))
        return values, photo(assemble(frame.render(frame.box.middle), frame.camera), generator)
    return values, photo(assemble(frame.render(values), frame.camera), generator)


def located(scene: nsa.Scene, poses: nsa.PoseSet, options: argparse.Namespace) -> bool:
    """Run whole searches; returns whether none of them excluded its true pose."""
    good = True
    print("seed,seconds,volume,answer,best_outliers,bounds,true_pose")
    for seed in range(options.photos):
        values, levels = hidden(scene, poses, seed, options.elsewhere)
        place = nsa.locate(
            scene, poses, levels, noise=NOISE, outliers=OUTLIERS, time_budget=options.seconds, workers=options.workers,
            contract=not options.no_contraction,
        )  # fmt: skip
        kept = any(
            (c.lower <= values).all() and (values <= c.upper).all() for c in place.cells if c.verdict != "excluded"
        )
        good &= place.answer == "none" if options.elsewhere else kept
        said = "elsewhere" if options.elsewhere else "kept" if kept else "EXCLUDED"
        best = "" if place.best is None else place.best["outliers"]
        effort = place.report["effort"]["cells_bounded"]
        print(
            f"{seed},{place.seconds:.1f},{place.possible_volume:.3g},{place.answer},{best},{effort},{said}", flush=True
        )
    return good


def followed(scene: nsa.Scene, poses: nsa.PoseSet, seed: int, depth: int, contract: bool) -> tuple[bool, int, float]:
    """Examine the cells that hold a hidden pose alone.

    Returns:
        Whether none of them was excluded, how many there were, and the part of the searched volume that is left.
    """
    values, levels = hidden(scene, poses, seed, False)
    location = Location(Job(scene, [poses.of(scene)]), levels, None, PhotoOptions(NOISE, OUTLIERS, contract))
    search = location.search(0)
    names, sheared = search.frame.box.names, values.copy()
    for name, factors in search.frame.pose_set.shear.items():
        sheared[names.index(name)] -= sum(f * values[names.index(other)] for other, f in factors.items())
    cells = search.grid.roots()
    count = 0
    while cells and count < depth:
        findings = search.examine(cells[:1])
        count += 1
        kept = [leaf.cell for leaf in findings.leaves if leaf.verdict != "certified"]
        parts = [*kept, *(cell for block in findings.blocks for cell in block)]
        holding = [cell for cell in parts if search.grid.box_of(cell).contains(sheared)]
        if not holding and len(cells) == 1:
            return False, count, 0.0
        cells = [*cells[1:], *(cell for cell in holding if cell not in kept)]
    return True, count, sum(cell.volume for cell in cells) / search.grid.volume


def sampled(scene: nsa.Scene, poses: nsa.PoseSet, count: int) -> None:
    """Print the processor time of a search down to cells of a size, and what it leaves, estimated at random poses."""
    _, levels = hidden(scene, poses, 0, False)
    location = Location(Job(scene, [poses.of(scene)]), levels, None, PhotoOptions(NOISE, OUTLIERS, True))
    search, generator = location.search(0), np.random.default_rng(1)
    many = in_units(search, search.plain.box.sample(200_000, generator))
    examined: dict[Any, Any] = {}
    chains = []
    for place in in_units(search, search.plain.box.sample(count, generator)):
        cell, chain, left = search.grid.roots()[0], [], True
        while cell is not None and (not chain or chain[-1][0] > FINEST):
            if cell not in examined:
                begin = time.process_time()
                findings = search.examine([cell])
                share = float(((many >= cell.first) & (many < cell.past)).all(axis=1).mean())
                examined[cell] = findings, time.process_time() - begin, max(share, 1.0 / len(many))
            findings, seconds, share = examined[cell]
            chain.append((share, seconds))
            inside = [c for b in findings.blocks for c in b if ((place >= c.first) & (place < c.past)).all()]
            kept = [leaf.cell for leaf in findings.leaves if leaf.verdict != "certified"]
            left = bool(inside) or any(((place >= c.first) & (place < c.past)).all() for c in kept)
            cell = inside[0] if inside else None
        chains.append((left, chain))
    print("smallest cell (part of the set),processor seconds,left")
    for least in (0.1, 0.03, 0.01, 0.003, 0.001, 3e-4, 1e-4, FINEST):
        cost = np.mean([sum(seconds / share for share, seconds in chain if share >= least) for _, chain in chains])
        rest = np.mean([left or chain[-1][0] < least for left, chain in chains])
        print(f"{least:g},{cost:.0f},{rest:.3f}", flush=True)


def searched(scene: nsa.Scene, poses: nsa.PoseSet, seed: int, options: argparse.Namespace) -> bool:
    """Search with one thread; returns whether the true pose is kept, or nothing is of a photo from elsewhere.

    What is left is counted among random poses of the set, and no more than the cells' volume.
    """
    values, levels = hidden(scene, poses, seed, options.elsewhere)
    location = Location(Job(scene, [poses.of(scene)]), levels, None, PhotoOptions(NOISE, OUTLIERS))
    search, generator = location.search(0), np.random.default_rng(1)
    search.frame.warm_up()
    if (frame := search.sub_box_frame) is not None:
        frame.warm_up_sub_boxes()
    many = in_units(search, search.plain.box.sample(100_000, generator))
    # shears keep volumes
    whole = np.prod(np.subtract(search.plain.box.upper, search.plain.box.lower))
    unit = np.prod(np.subtract(search.grid.box.upper, search.grid.box.lower)) / whole / search.grid.volume
    queue: list[Any] = [(0.0, 0, cell) for cell in search.grid.roots()]
    kept, number = [], 0
    bounds, outliers, begin, step = 0, float("inf"), time.process_time(), options.processor / 8.0
    while True:
        used = time.process_time() - begin
        if used >= step or not queue:
            cells = [*kept, *(entry[2] for entry in queue)]
            inside = np.zeros(len(many), bool)
            for cell in cells:
                inside |= ((many >= cell.first) & (many < cell.past)).all(axis=1)
            share = min(float(inside.mean()), sum(cell.volume for cell in cells) * unit)
            print(f"{seed},{used:.1f},{share:.3g},{len(cells)},{bounds},{outliers}", flush=True)
            # counting poses is no part of the search
            begin, step = time.process_time() - used, step * 2.0
            if not queue or used >= options.processor:
                break
        findings = search.examine([heapq.heappop(queue)[2]])
        bounds += findings.bounded
        if findings.best is not None:
            outliers = min(outliers, findings.best.outliers)
        kept += [leaf.cell for leaf in findings.leaves if leaf.verdict != "certified"]
        for block, rank in zip(findings.blocks, findings.ranks, strict=True):
            number += 1
            heapq.heappush(queue, (rank, number, *block))
    place = in_units(search, values[None])[0]
    held = any(((place >= np.subtract(c.first, 1)) & (place <= np.add(c.past, 1))).all() for c in cells)
    return not cells if options.elsewhere else held


def in_units(search: Any, values: np.ndarray) -> np.ndarray:
    """Poses [n, d] of a set in units of the grid that is searched."""
    box, names = search.grid.box, search.frame.box.names
    places = values.copy()
    for name, factors in search.frame.pose_set.shear.items():
        for other, factor in factors.items():
            places[:, names.index(name)] -= factor * values[:, names.index(other)]
    return (places - box.lower) / (np.array(box.upper) - box.lower) * np.array(search.grid.units)


def main() -> None:
    """Measure, and exit with 1 where a true pose was excluded, or a photo from elsewhere not."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config", type=Path)
    parser.add_argument("path", type=Path)
    parser.add_argument("--set", choices=SETS, default="six")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--photos", type=int, default=5)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--no-contraction", action="store_true")
    parser.add_argument("--follow", type=int, default=0)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--depth", type=int, default=40)
    parser.add_argument("--elsewhere", action="store_true")
    parser.add_argument("--sample", type=int, default=0)
    parser.add_argument("--processor", type=float, default=0.0)
    options = parser.parse_args()
    scene = nsa.load_scene(options.config)
    source = nsa.load_camera_path(options.path).cameras[0]
    given = nsa.PoseSet(source, **SETS[options.set])
    poses = nsa.PoseSet(resized(given.of(scene), SIZE, SIZE).camera, **SETS[options.set])
    if options.sample:
        use_threads(1)
        return sampled(scene, poses, options.sample)
    if options.processor:
        use_threads(1)
        print("seed,processor seconds,left,cells,bounds,best outliers")
        seeds = range(options.first, options.first + options.photos)
        good = [searched(scene, poses, seed, options) for seed in seeds]
        sys.exit(0 if all(good) else 1)
    if not options.follow:
        sys.exit(0 if located(scene, poses, options) else 1)
    use_threads(options.workers)
    begin, bad, cells, left = time.perf_counter(), 0, 0, []
    for seed in range(options.first, options.first + options.follow):
        kept, count, volume = followed(scene, poses, seed, options.depth, not options.no_contraction)
        bad, cells = bad + (not kept), cells + count
        left.append(volume)
        if not kept:
            print(f"seed {seed}: EXCLUDED", flush=True)
    seconds = time.perf_counter() - begin
    print(f"{options.follow} poses, {bad} excluded, {cells} cells, median left {np.median(left):.3g}, {seconds:.0f} s")
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
