"""Branches over fixed intermediate bounds: whatever rows choose, they hold for the images with the assumed phases."""

from __future__ import annotations

import dataclasses
import heapq
import math
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from onnx_files import OnnxFile, session
from test_network_bounds import exact_least, mlp, residual
from test_network_branching import line

from ns_abstract.arithmetic.network_charges import UNIT
from ns_abstract.execution.cancellation import Deadline
from ns_abstract.verify import box_decisions
from ns_abstract.verify.network import ImageSets, Network, NetworkArithmetic, bound_outputs, load_network
from ns_abstract.verify.network.bounds import NetworkBounds
from ns_abstract.verify.network.coefficients import grid
from ns_abstract.verify.network.layers import Convolution, LeakyRelu, Matrix
from ns_abstract.verify.network.phase_tree import PhaseTree, SplitGains, _Branch, _GroupRows, _Half
from ns_abstract.verify.network.relaxations import Relaxations
from ns_abstract.verify.network.slope_choices import ReluSlopes, UnstableNeurons
from ns_abstract.verify.network.stopping import BackwardBounds
from ns_abstract.verify.vnnlib_sets import InputRegion, UnsafeSet

MOST = 100


def tree_of(
    network: Network, images: ImageSets, rows: np.ndarray, offset: np.ndarray, arithmetic: NetworkArithmetic = "real"
) -> PhaseTree:
    return PhaseTree(NetworkBounds(network, images, 1 << 30, arithmetic, 1), rows, offset)


def box(lower: np.ndarray, upper: np.ndarray) -> ImageSets:
    none = np.zeros((1, len(lower), 1))
    return ImageSets(none, lower[None], none, upper[None], lower[None], upper[None])


@pytest.mark.slow_cases
@pytest.mark.parametrize("arithmetic", ["float32", "real"])
def test_claims_next_to_the_exact_minimum(arithmetic: NetworkArithmetic, tmp_path: Path) -> None:
    """What some image breaks exactly is never proved; a little below it is, where slopes alone prove less."""
    gained = 0
    for seed in (1,):
        network, layers, _ = mlp(tmp_path, seed, 2.0)
        rng = np.random.default_rng(seed)
        images, rows = line(rng, 3), rng.normal(size=(3, 2))
        least = [exact_least(layers, images.b_lower[0], images.a_lower[0, :, 0], row) for row in rows]
        broken = -np.array([np.nextafter(float(v), np.inf) for v in least])
        assert all(Fraction(float(b)) + v <= 0 for b, v in zip(broken, least, strict=True))
        held = broken.copy()
        for k in range(3):
            assert not tree_of(network, images, rows, broken, arithmetic).prove([k], MOST).proved
            # most of what the root misses is there to be gained
            held[k] += 0.7 * -tree_of(network, images, rows, broken, arithmetic).prove([k], 1).least + 1e-6
            found = tree_of(network, images, rows, held, arithmetic).prove([k], MOST)
            assert found.proved
            gained += found.branches > 1
        # one row of a group is enough
        either = np.where(np.arange(3) == 1, broken, held)
        assert tree_of(network, images, rows, either, arithmetic).prove([1, 0], MOST).proved
        assert not tree_of(network, images, rows, np.full(3, np.nan), arithmetic).prove([0], MOST).proved
    assert gained >= 1


def leaky(folder: Path) -> Path:
    f = OnnxFile((1, 6, 6), 1)
    f.conv(1, 4, pads=[1, 1, 1, 1])
    f.node("LeakyRelu", alpha=0.3)
    f.conv(4, 4, pads=[1, 1, 1, 1], strides=[2, 2])
    f.node("Relu")
    f.node("Flatten")
    f.gemm(36, 3)
    return f.write(folder / "leaky.onnx")


def phases_at(network: Network, tree: PhaseTree, x: np.ndarray) -> dict[int, np.ndarray]:
    """What the image [n] itself has at the unstable neurons."""
    values = [torch.from_numpy(x).reshape(1, *network.input_shape)]
    for node in network.nodes:
        values.append(node.layer([values[i] for i in node.inputs]))
    found = {}
    for k, own in tree.relus.items():
        z = values[network.nodes[k - 1].inputs[0]].reshape(-1).numpy()[own.units.flat]
        found[k] = np.where(z >= 0.0, 1, -1).astype(np.int8)
    return found


def least_excess(network: Network, tree: PhaseTree, images: ImageSets, rows: np.ndarray, count: int) -> float:
    """By how much bounds of branches that an image is in are below its outputs, at least; negative: above."""
    rng, least = np.random.default_rng(0), np.inf
    group = _GroupRows.of(tree.shifted, list(range(len(rows))), (1, 1, network.output_size))
    for _ in range(count):
        # corners, and what is near them
        part = np.where(rng.uniform(size=images.lower.shape[1]) < 0.7, rng.integers(0, 2, images.lower.shape[1]), 0.5)
        x = images.lower[0] + part * (images.upper[0] - images.lower[0])
        own = phases_at(network, tree, x)
        branches = []
        for share in (0.0, 0.2, 1.0):
            phases = {k: np.where(rng.uniform(size=v.shape) < share, v, 0).astype(np.int8) for k, v in own.items()}
            sizes = {k: (len(rows), len(v)) for k, v in own.items()}
            scale = rng.choice([0.0, 0.5])
            multipliers = {k: rng.exponential(scale, size).astype(np.float32) for k, size in sizes.items()}
            parameters = {k: [rng.uniform(size=size).astype(np.float32)] for k, size in sizes.items()}
            branches.append(_Branch(phases, np.full(len(rows), -np.inf), parameters, multipliers))
        ascent, _ = tree._ascent(group, branches)
        _, bounds = tree.ascent.evaluate(tree.index, group.start(len(branches)), 0, ascent)
        lower = group.lower(bounds).reshape(len(branches), -1)
        assert np.isfinite(lower).all()
        with torch.no_grad():
            y = network(torch.from_numpy(x).reshape(1, *network.input_shape))[0].numpy()
        least = min(least, float((rows @ y - lower).min()))
    return least


def small(folder: Path) -> Path:
    """Few neurons, nearly all of them unstable: bounds of branches are nearly reached."""
    f = OnnxFile((3,), 2)
    f.gemm(3, 6)
    f.node("LeakyRelu", alpha=0.3)
    f.gemm(6, 4)
    f.node("Relu")
    f.gemm(4, 2)
    return f.write(folder / "small.onnx")


@pytest.mark.parametrize(("name", "radius"), [("small", 1.0), ("leaky", 0.05), ("residual", 0.05)])
def test_branches_hold_for_the_images_in_them(name: str, radius: float, tmp_path: Path) -> None:
    """Random slopes, multipliers and phases, of which an image has all: the bound is not above its output."""
    makes = {"leaky": leaky, "residual": residual, "small": small}
    network = load_network(makes[name](tmp_path))
    rng = np.random.default_rng(3)
    x = rng.uniform(size=network.input_size)
    images, rows = box(x - radius, x + radius), rng.normal(size=(2, network.output_size))
    rows = np.concatenate([rows, -rows])
    tree = tree_of(network, images, rows, np.zeros(4))
    assert sum(len(own.units.flat) for own in tree.relus.values()) >= 5
    assert least_excess(network, tree, images, rows, 40 if name == "small" else 4) >= 0.0


def test_halves_are_bounded_as_the_branches_that_they_become(tmp_path: Path) -> None:
    """Halves of several branches together, each with what its own branch has chosen and assumes."""
    network = load_network(small(tmp_path))
    rng = np.random.default_rng(5)
    tree = tree_of(network, box(np.full(3, -1.0), np.full(3, 1.0)), np.array([[1.0, -1.0]]), np.zeros(1))
    group = _GroupRows.of(tree.shifted, [0], (1, 1, 2))
    sizes = {k: len(own.units.flat) for k, own in tree.relus.items()}
    branches, halves = [], []
    for number in range(2):
        phases = {k: rng.integers(-1, 2, size).astype(np.int8) for k, size in sizes.items()}
        parameters = {k: [rng.uniform(size=(1, size)).astype(np.float32)] for k, size in sizes.items()}
        multipliers = {k: rng.exponential(size=(1, size)).astype(np.float32) for k, size in sizes.items()}
        branches.append(_Branch(phases, np.full(1, -np.inf), parameters, multipliers))
        halves += [_Half(number, (min(sizes), 1), side) for side in (1, -1)]
    together, _ = tree._ascent(group, branches, halves)
    _, found = tree.ascent.evaluate(tree.index, group.start(len(halves)), 0, together)
    children = [half for branch in branches for half in branch.halves((min(sizes), 1))]
    alone, _ = tree._ascent(group, children)
    _, wanted = tree.ascent.evaluate(tree.index, group.start(len(children)), 0, alone)
    assert (group.lower(found) == group.lower(wanted)).all() and len(set(group.lower(found))) == 4


@pytest.mark.parametrize("number", ["float32", "float64"])
def test_lines_of_assumed_phases_enclose_the_piece(number: str) -> None:
    """With a slope that the rows' type cannot hold, about references, on both sides of a row; tolerance zero."""
    alpha, dtype = 0.3, {"float32": torch.float32, "float64": torch.float64}[number]
    rng, count = np.random.default_rng(2), 40
    lower, upper = -rng.exponential(1e3, count), rng.exponential(1e3, count)
    # references that neither hide what a slope misses nor round it away
    none, reference = np.zeros(count), np.round(rng.uniform(lower, upper))
    units = UnstableNeurons(
        none.astype(int), np.arange(count), lower, upper, reference, none, none, none,
        LeakyRelu((count,), alpha), Relaxations(dtype, UNIT, 2.0**-45),
    )  # fmt: skip
    sides = np.stack([np.full(count, side, np.int8) for side in (1, -1)])
    lines = np.full((6, 2, count), np.nan, np.float32 if number == "float32" else np.float64)
    ReluSlopes(units, alpha).put(np.full((2, count), 0.5), lines, sides)
    for r, exact in enumerate((Fraction(1), Fraction(alpha))):
        for u in range(count):
            slope, below, above = (Fraction(float(v)) for v in lines[:3, r, u])
            assert [Fraction(float(v)) for v in lines[3:, r, u]] == [slope, above, below]
            for z in (Fraction(0), Fraction(float((upper, lower)[r][u]))):
                value = exact * z - slope * (z - Fraction(float(reference[u])))
                assert below <= value <= above
                # nor is much more charged than a float32 slope misses
                assert above - below <= Fraction(2.0**-20) * Fraction(float(upper[u] - lower[u] + 1.0))


def test_several_threads_bound_the_same_rows(tmp_path: Path) -> None:
    """Rows that threads share are each bounded once: intermediate bounds with chosen lines are those of one thread."""
    f = OnnxFile((8,), 3)
    f.relu_layers(8, 96, 96, 2)
    network = load_network(f.write(tmp_path / "threads.onnx"))
    images, threads = box(np.full(8, -0.4), np.full(8, 0.6)), torch.get_num_threads()
    found = []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            cells = NetworkBounds(network, images, 1 << 30, "real", 1, intermediate_steps=3, coarse=True)
            found.append(cells.intermediate.unstable[max(cells.intermediate.unstable)])
    finally:
        torch.set_num_threads(threads)
    one, two = found
    assert len(one.flat) >= 64 and (one.flat == two.flat).all()
    assert np.allclose(one.lower, two.lower, rtol=1e-5) and np.allclose(one.upper, two.upper, rtol=1e-5)


def test_what_is_not_known_is_not_proved(tmp_path: Path) -> None:
    """Neither in a cell without finite intermediate bounds, nor by a bound of a row that is not finite."""
    network = load_network(small(tmp_path))
    x, rows = np.zeros(math.prod(network.input_shape)), np.ones((1, math.prod(network.output_shape)))
    tree = tree_of(network, box(x - 1.0, x + 1.0), rows, np.array([1e6]))
    assert tree.prove([0], MOST).proved
    tree.intermediate.usable[0] = False
    assert tree.prove([0], MOST) == (False, 0, -np.inf)
    group = _GroupRows.of(tree.shifted, [0], grid(network.shape(tree.index)))
    bounds = BackwardBounds.unknown(3, 1)
    bounds.plane[:], bounds.lower[:] = 0.0, [np.inf, np.nan, 1.0]
    assert np.isfinite(group.lower(bounds)).tolist() == [False, False, True]
    assert (group.lower(bounds)[:2] == -np.inf).all()


def test_functions_without_curved_parts_choose_nothing(tmp_path: Path) -> None:
    """Clips and absolute values have no tangents; rows pass them with the lines of the cell."""
    f = OnnxFile((4,), 0)
    f.gemm(4, 6)
    f.node("Clip", f.last, f.constant(-0.1), f.constant(0.3))
    f.gemm(6, 6)
    f.node("Abs")
    f.gemm(6, 2)
    network = load_network(f.write(tmp_path / "clip.onnx"))
    x, rows = np.full(4, 0.3), np.eye(2)
    images = box(x - 0.2, x + 0.2)
    plain = bound_outputs(network, images, rows, np.zeros(2), arithmetic="real").lower[0]
    chosen = bound_outputs(network, images, rows, np.zeros(2), arithmetic="real", slope_steps=2, intermediate_steps=2)
    assert np.isfinite(plain).all() and (chosen.lower[0] >= plain).all()


@pytest.mark.parametrize("steps", [3, 4])
def test_ends_of_unstable_neurons_gain_by_lines_of_their_own(steps: int, tmp_path: Path) -> None:
    """The end that is nearer to zero is raised or lowered, from four steps on the other one, too, and both hold."""
    f = OnnxFile((6,), 3)
    f.relu_layers(6, 24, 24, 2)
    network = load_network(f.write(tmp_path / "ends.onnx"))
    rng = np.random.default_rng(0)
    x = rng.normal(size=6)
    images = box(x - 0.5, x + 0.5)
    plain, chosen = (
        NetworkBounds(network, images, 1 << 30, "real", 1, intermediate_steps=number).intermediate
        for number in (0, steps)
    )
    node = max(plain.unstable)
    one, two = plain.unstable[node], chosen.unstable[node]
    # others are stable now
    at = np.searchsorted(one.flat, two.flat)
    assert len(at) >= 5 and (one.flat[at] == two.flat).all()
    below = one.upper[at] >= -one.lower[at]
    gained = {"below": two.lower - one.lower[at], "above": one.upper[at] - two.upper}
    assert all((gain >= 0.0).all() for gain in gained.values())
    near = np.where(below, gained["below"], gained["above"])
    far = np.where(below, gained["above"], gained["below"])
    assert (near > 0.0).mean() > 0.5
    assert (far == 0.0).all() if steps < 4 else (far > 0.0).mean() > 0.5
    points = torch.from_numpy(images.lower + rng.uniform(size=(4096, 6)) * (images.upper - images.lower))
    for layer in network.nodes[: node - 1]:
        points = layer.layer([points])
    reached = points[:, torch.from_numpy(two.flat)].numpy()
    assert (reached >= two.lower).all() and (reached <= two.upper).all()


def test_the_later_attack_takes_a_part_of_the_time(tmp_path: Path) -> None:
    network = load_network(small(tmp_path))
    search = box_decisions._BoxSearch(network, session(tmp_path / "small.onnx"), Deadline(60.0), 1 << 30, "real")
    tuning = box_decisions.BoxTuning()
    search.seconds_by_input = 1e-6
    assert search._later_attack(3) == tuning.later_attack
    for groups in (1, 4):
        search.seconds_by_input = 2e-3
        starts, steps = search._later_attack(groups)
        assert (
            tuning.least_attack[0] <= starts < tuning.later_attack[0]
            and tuning.least_attack[1] <= steps < tuning.later_attack[1]
        )
        assert groups * starts * steps * search.seconds_by_input <= tuning.later_share * 60.0
    search.seconds_by_input = 1e3
    assert search._later_attack(1) == tuning.least_attack


def test_deadlines_are_asked_often(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between two questions whether time is up lies the work of a few layers, in attacks, bounds and branches."""
    network, file = load_network(leaky(tmp_path)), tmp_path / "leaky.onnx"
    work, asked, most = 0, 0, 0

    def counted(kind: type, name: str) -> None:
        before = getattr(kind, name)

        def call(*given: Any, **named: Any) -> Any:
            nonlocal work
            work += 1
            return before(*given, **named)

        monkeypatch.setattr(kind, name, call)

    for kind in (Convolution, Matrix):
        for name in ("apply", "magnitude", "backward"):
            counted(kind, name)
    for name in ("function", "lines", "band"):
        counted(LeakyRelu, name)

    def request() -> bool:
        nonlocal asked, most, work
        asked, most, work = asked + 1, max(most, work), 0
        return asked > 1500

    x = np.random.default_rng(0).uniform(size=36)
    unsafe = UnsafeSet(np.array([[1.0, -1.0, 0.0]]), np.array([0.0]), ((0,),), 0)
    run = session(file)
    y = run(x.astype(np.float32).reshape(1, 1, 6, 6))[0].astype(np.float64)
    # unsafe at the middle, so nothing is proved; the program says nothing, so nothing is found
    offset = np.array([-(y[0] - y[1])])
    region = InputRegion(x - 0.1, x + 0.1, dataclasses.replace(unsafe, offset=offset))
    nothing: Sequence[float] = [np.nan] * 3
    answer = box_decisions.decide(network, lambda _: np.array(nothing), [region], Deadline(request=request))
    assert answer.word in ("timeout", "unknown")
    assert asked > 500
    assert most <= 12


def test_splits_that_gained_little_are_not_bounded_again() -> None:
    gains = SplitGains(2, 3)
    splits = [(4, k) for k in range(5)]
    for gain in (9.0, 9.0):
        # noted too seldom to be left out
        gains.note(splits[4], gain)
    assert gains.hopeful(splits) == splits
    for split, gain in zip(splits[:4], (0.1, 0.5, 0.3, 0.2), strict=True):
        for part in (0.5, 1.0, 1.5):
            gains.note(split, part * gain)
    # one is unknown, and two of the others are best
    assert gains.hopeful(splits) == [splits[1], splits[2], splits[4]]
    assert gains.hopeful(splits[2:4]) == splits[2:4]


@pytest.mark.slow
@pytest.mark.parametrize("room", [0, 1 << 30])
def test_branches_without_room_are_not_lost(room: int, tmp_path: Path) -> None:
    """The strongest come first where no more fit; each comes once, and what holds is proved all the same."""
    network = load_network(small(tmp_path))
    images, rows = box(np.full(3, -1.0), np.full(3, 1.0)), np.array([[1.0, -1.0]])
    tree = tree_of(network, images, rows, np.zeros(1))
    tree.room = room
    order = [3.0, 1.0, 5.0, 2.0, 4.0]
    waiting = [(v, k, _Branch({}, np.array([v]))) for k, v in enumerate(order)]
    heapq.heapify(waiting)
    taken = [[float(branch.lower[0]) for branch in tree._taken(waiting, 2)] for _ in range(3)]
    assert taken == ([[1.0, 2.0], [3.0, 4.0], [5.0]] if room else [[4.0, 5.0], [2.0, 3.0], [1.0]])
    assert not waiting
    corners = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 41)] * 3), -1).reshape(-1, 3)
    least = float((network(torch.from_numpy(corners)).numpy() @ rows[0]).min())
    for offset, holds in ((0.2 - least, True), (-1e-9 - least, False)):
        tree = tree_of(network, images, rows, np.array([offset]))
        tree.room = room
        assert tree.prove([0], 400).proved == holds
