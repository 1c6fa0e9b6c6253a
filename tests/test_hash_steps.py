"""Steps of the bounds of hash-grid fields: each encloses what it bounds, at tolerance zero (design.md, H1 to H7)."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction

import mpmath
import numpy as np
import pytest
import torch
from nerfactos import random_net

from ns_abstract.methods.nerf.hash_bounds import (
    composition,
    distribution,
    edges,
    features,
    forms,
    light,
    network,
    points,
)
from ns_abstract.methods.nerf.hsv import shifted
from ns_abstract.methods.nerf.nerfacto_render import next_places
from ns_abstract.methods.nerf.render import HISTOGRAM_PADDING, interval_weights

#: Draws of each step; interpreted kernels are slow.
DRAWS = 40
LINE, POSES = True, 2


def form(rng: np.random.Generator, center: float, spread: float, place: float = 0.0, radius: float = 0.0) -> np.ndarray:
    """A form of two pose symbols."""
    return np.array([center, *(spread * rng.uniform(-1.0, 1.0, POSES)), place, radius])


def symbols(p: np.ndarray, line: bool) -> list[Fraction]:
    """Values of the pose symbols at a point of the piece."""
    exact = [Fraction(float(x)) for x in p]
    return [exact[0], 2 * exact[0] ** 2 - 1] if line else exact


def value(one: np.ndarray, pose: list[Fraction], place: float = 0.0) -> Fraction:
    """A form without its radius, exactly."""
    terms = zip(one[1 : 1 + POSES], pose, strict=True)
    return (
        Fraction(float(one[0]))
        + sum(Fraction(float(g)) * s for g, s in terms)
        + Fraction(float(one[3])) * Fraction(place)
    )


def member(rng: np.random.Generator, one: np.ndarray, pose: list[Fraction], place: float) -> Fraction:
    """A value that the form allows, often an extreme one."""
    part = rng.choice([-1.0, 1.0, rng.uniform(-1.0, 1.0)])
    return value(one, pose, place) + Fraction(float(one[-1])) * Fraction(float(part))


def holds(one: np.ndarray, pose: list[Fraction], place: float, exact: Fraction) -> bool:
    """Whether a form allows ``exact``."""
    return abs(exact - value(one, pose, place)) <= Fraction(float(one[-1]))


def draw(rng: np.random.Generator) -> tuple[bool, list[Fraction], float]:
    """Kind of symbols, and values of pose and place symbols."""
    line = bool(rng.integers(2))
    p = rng.uniform(-1.0, 1.0, POSES) if rng.integers(2) else rng.choice([-1.0, 1.0], POSES)
    return line, symbols(p, line), float(rng.choice([-1.0, 1.0, rng.uniform(-1.0, 1.0)]))


def random_form(rng: np.random.Generator, center: float, size: float) -> np.ndarray:
    spread = size * 10.0 ** rng.uniform(-9.0, 0.0, 3)
    return form(rng, center, spread[0], spread[1] * rng.choice([-1.0, 1.0]), spread[2] * rng.integers(2))


def test_products_and_quotients_of_forms_are_enclosed() -> None:
    rng = np.random.default_rng(0)
    for _ in range(DRAWS):
        line, pose, place = draw(rng)
        a, b = (random_form(rng, rng.normal(), 0.3) for _ in range(2))
        out, scratch = np.zeros(5), np.zeros((2, 5))
        x, y = (member(rng, one, pose, place) for one in (a, b))
        forms.multiply(a, b, line, out)
        assert holds(out, pose, place, x * y)
        forms.scale_add(a, -0.3, b, 0.7, out)
        assert holds(out, pose, place, Fraction(-0.3) * x + y + Fraction(0.7))
        low, high = forms.form_range(a, line)
        assert low <= x <= high
        a[0] = 1.0 + abs(a[0])
        x = member(rng, a, pose, place)
        forms.reciprocal(a, line, out, scratch)
        assert not np.isfinite(out[-1]) or holds(out, pose, place, 1 / x)


@pytest.mark.parametrize(
    ("band", "exact"),
    [(forms.exp_band, mpmath.exp), (forms.sigmoid_band, lambda x: 1 / (1 + mpmath.exp(-x)))],
    ids=["exp", "sigmoid"],
)
def test_bands_enclose_their_function(band: Callable, exact: Callable) -> None:
    rng = np.random.default_rng(1)
    with mpmath.workdps(60):
        for _ in range(4 * DRAWS):
            center, reach = rng.uniform(-30.0, 30.0), 10.0 ** rng.uniform(-8.0, 1.5)
            low, high = center - reach * rng.uniform(), center + reach * rng.uniform()
            v, slope, curvature, rest = band(center, low, high)
            for x in (low, high, *rng.uniform(low, high, 4)):
                t = mpmath.mpf(x) - mpmath.mpf(center)
                found = mpmath.mpf(v) + mpmath.mpf(slope) * t + mpmath.mpf(curvature) * t * t
                assert abs(exact(mpmath.mpf(x)) - found) <= rest
            line, pose, place = draw(rng)
            one, out = random_form(rng, center, min(reach, 3.0)), np.zeros(5)
            x = member(rng, one, pose, place)
            ends = forms.form_range(one, line)
            forms.apply_band(one, band(one[0], *ends), line, out)
            there = exact(mpmath.mpf(x.numerator) / x.denominator)
            center_value = value(out, pose, place)
            assert abs(there - mpmath.mpf(center_value.numerator) / center_value.denominator) <= out[-1]
    assert forms.exp_band(0.0, -1.0, 710.0)[3] == np.inf


def contracted(x: list[Fraction]) -> list[Fraction]:
    """What nerfstudio's contraction gives, scaled to [0, 1]."""
    m = max(abs(v) for v in x)
    inside = x if m < 1 else [(2 - 1 / m) * (v / m) for v in x]
    return [(v + 2) / 4 for v in inside]


def test_contracted_points_are_enclosed() -> None:
    """Inside, outside, far away, and where the contraction has kinks."""
    rng = np.random.default_rng(2)
    inside = 0
    for k in range(3 * DRAWS):
        line, pose, place = draw(rng)
        far = (0.3, 1.0, 3.0, 300.0)[k % 4]
        direction = rng.normal(size=3)
        if k % 3 == 0:
            # the two largest coordinates are nearly as large
            direction[1] = direction[0] * rng.choice([-1.0, 1.0]) * (1.0 + rng.normal() * 1e-3)
        direction /= np.linalg.norm(direction)
        origin = rng.normal(size=3) * (0.0 if k % 3 == 0 else 0.5)
        size = 10.0 ** rng.uniform(-6.0, -2.0)
        o, d = (np.stack([random_form(rng, c, size) for c in vector]) for vector in (origin, direction))
        o[:, 3] = d[:, 3] = 0.0
        t = random_form(rng, far, size * far)
        t[-1] = 0.0
        ratios, shifts, along = np.zeros((3, 3, 5)), np.zeros((3, 3, 5)), np.zeros(3, np.bool_)
        work, out = np.zeros((24, 5)), np.zeros((3, 5))
        points.quotients(o, d, line, ratios, shifts, along, work)
        surely = points.point((o, d, ratios, shifts, along), t, line, out, work)
        inside += surely
        there = value(t, pose, place)
        x = [member(rng, o[a], pose, 0.0) + there * member(rng, d[a], pose, 0.0) for a in range(3)]
        exact = contracted(x)
        assert all(holds(out[a], pose, place, exact[a]) for a in range(3))
        assert not surely or all(0 < v < 1 for v in exact)
    assert inside > DRAWS


def test_kinks_of_the_contraction_are_enclosed() -> None:
    """The largest coordinate changes in the middle of the piece, and nothing else has a radius."""
    o = np.zeros((3, 5))
    d = np.array([[0.7, 0.0, 0.0, 0.0, 0.0], [0.7, 0.02, 0.0, 0.0, 0.0], [0.1, 0.0, 0.0, 0.0, 0.0]])
    t = np.array([3.0, 0.0, 0.0, 0.0, 0.0])
    ratios, shifts, along = np.zeros((3, 3, 5)), np.zeros((3, 3, 5)), np.zeros(3, np.bool_)
    work, out = np.zeros((24, 5)), np.zeros((3, 5))
    points.quotients(o, d, LINE, ratios, shifts, along, work)
    assert points.point((o, d, ratios, shifts, along), t, LINE, out, work)
    for p in (-1.0, -0.5, 0.0, 0.5, 1.0):
        pose = symbols(np.array([p, 0.0]), LINE)
        exact = contracted([3 * value(d[a], pose) for a in range(3)])
        assert all(holds(out[a], pose, 0.0, exact[a]) for a in range(3))


def test_far_points_lose_no_more_than_their_depth_tells() -> None:
    """The rest of a far point's place is of second order in its relative depth, not of its distance."""
    rng = np.random.default_rng(3)
    o, d = (np.array([[c, 0.0, 0.0, 0.0, 0.0] for c in vector]) for vector in ((0.3, 0.2, -0.1), (0.6, 0.48, 0.64)))
    ratios, shifts, along = np.zeros((3, 3, 5)), np.zeros((3, 3, 5)), np.zeros(3, np.bool_)
    work, out = np.zeros((24, 5)), np.zeros((3, 5))
    points.quotients(o, d, LINE, ratios, shifts, along, work)
    points.point((o, d, ratios, shifts, along), form(rng, 500.0, 0.0, 50.0), LINE, out, work)
    assert np.abs(out[:, 3]).max() < 1e-3 and out[:, 4].max() < 1e-4


def trilinear(table: np.ndarray, resolution: int, x: list[Fraction]) -> list[Fraction]:
    """Features [F] of a level at a place in [0, 1]^3, exactly."""
    cells = [v * resolution for v in x]
    first = [int(v // 1) for v in cells]
    found = [Fraction(0)] * table.shape[1]
    for corner in np.ndindex(2, 2, 2):
        share = Fraction(1)
        for a in range(3):
            part = cells[a] - first[a]
            share *= part if corner[a] else 1 - part
        row = features.hash_row(*(first[a] + corner[a] for a in range(3)), len(table))
        found = [f + share * Fraction(float(v)) for f, v in zip(found, table[row], strict=True)]
    return found


def test_features_are_enclosed_across_faces() -> None:
    rng = np.random.default_rng(4)
    table = rng.normal(size=(64, 2))
    ranges = np.stack([table.min(axis=0), table.max(axis=0)])
    for k in range(3 * DRAWS):
        _line, pose, place = draw(rng)
        resolution = int(rng.integers(4, 600))
        # on a face, near one, anywhere; within a cell, over some, over many
        center = rng.integers(1, resolution, 3) / resolution + (k % 3) * rng.uniform(0.0, 0.3, 3) / resolution
        size = (1e-9, 0.02, 0.7, 3.0, 40.0)[k % 5] / resolution
        x = np.stack([random_form(rng, min(max(c, 0.01), 0.99), size) for c in center])
        out = np.zeros((2, 5))
        features.level_features(table, float(resolution), x, ranges, out, features.feature_room(2))
        exact = trilinear(table, resolution, [member(rng, one, pose, place) for one in x])
        assert all(holds(one, pose, place, v) for one, v in zip(out, exact, strict=True))


def test_networks_are_enclosed() -> None:
    rng = np.random.default_rng(5)
    rest = np.zeros((6, 16))
    for k in range(DRAWS // 2):
        _line, pose, place = draw(rng)
        net, head = random_net(rng, 6, 8, 8, 4), random_net(rng, 16 + 3, 8, 8, 3)
        weights, head_weights = network.net_weights(net), network.head_weights(head, 16)
        size = (1e-8, 1e-3, 0.1, 1.0)[k % 4]
        inputs = np.stack([random_form(rng, rng.normal(), size) for _ in range(6)])
        seen = np.stack([random_form(rng, rng.normal(), size) for _ in range(16)])
        seen[:, 3] = 0.0
        # room for a layer that this network does not have
        rooms = tuple(network.zonotope(10 + 16, n) for n in (8, 8, 4, 1))
        color_rooms = tuple(network.zonotope(26 + 16, n) for n in (8, 8, 3))
        live = np.zeros(16, np.int64)
        count = network.remaining_layers(rooms, network.from_features(inputs, weights, rooms[0]), weights, live, rest)
        rows, radius = np.zeros((4, 8)), np.zeros(8)
        network.weigh_direction(seen, head_weights, rows, radius)
        total = network.colors(rooms[2], count, (rows, radius), head_weights, color_rooms, live, rest)
        x = np.array([float(member(rng, one, pose, place)) for one in inputs])
        h = x
        for i, (w, b) in enumerate(zip(net.weights, net.biases, strict=True)):
            h = w @ h + b if i == 2 else np.maximum(w @ h + b, 0.0)
        c = np.concatenate([[float(member(rng, one, pose, 0.0)) for one in seen], h[1:]])
        for i, (w, b) in enumerate(zip(head.weights, head.biases, strict=True)):
            c = w @ c + b if i == 2 else np.maximum(w @ c + b, 0.0)
        out = np.zeros(5)
        for room, many, exact in ((rooms[2], count, h), (color_rooms[-1], total, c)):
            for j, v in enumerate(exact):
                network.output_form(room, many, j, 4, out)
                assert holds(out, pose, place, Fraction(float(v)))


class Ray:
    """A ray whose intervals, densities and colours are forms, and a member of the set."""

    def __init__(self, seed: int, count: int = 14) -> None:
        self.rng = rng = np.random.default_rng(seed)
        self.count, self.spacing = count, (True, 0.0, 0.99)
        self.line = bool(seed % 2)
        size = 10.0 ** rng.uniform(-7.0, -2.0)
        self.edges = edges.edges_of(count, POSES)
        work = np.zeros((4, 5))
        # apart, and inside of the ray: edges of a member are in order
        middles = np.linspace(0.01, 0.99, count + 1) + (seed % 3) * rng.uniform(-0.1, 0.1, count + 1) / count
        for j, middle in enumerate(middles):
            self.edges.place[j] = form(rng, middle, 0.2 * size / count, 0.2 * size / count)
            reach = forms.spread_of(self.edges.place[j])
            self.edges.low[j], self.edges.high[j] = middle - reach, middle + reach
            edges.space(self.edges, j, self.spacing, self.line, work)
        density = 10.0 ** rng.uniform(-3.0, 3.0 if seed % 4 else 1.0, count) * rng.integers(0, 2, count)
        self.density = np.stack([random_form(rng, v, v * size) for v in density])
        self.light = light.light_of(count, POSES)
        light.begin(self.light)
        self.shares = []
        self.known = True
        for i in range(count):
            middle = np.zeros(5)
            self.shares.append(edges.middle_of(self.edges, i, middle))
            low, high = forms.form_range(self.density[i], self.line)
            bounds = max(low, 0.0), high
            if seed % 5 == 0 and i == count // 2:
                # nothing is known of this density
                self.density[i], bounds = np.array([0.0, 0.0, 0.0, 0.0, np.inf]), (0.0, 1e300)
            self.known &= light.add_depth(
                self.edges, i, self.density[i], bounds, self.shares[i], self.line, self.light, np.zeros((2, 6))
            )

    def draw(self) -> tuple[list[Fraction], np.ndarray, np.ndarray, np.ndarray]:
        """Pose symbols, places, distances and densities of a member."""
        rng = self.rng
        _, pose, _ = draw(rng)
        if self.line:
            p = rng.choice([-1.0, 1.0, rng.uniform(-1.0, 1.0)])
            pose = symbols(np.array([p, 0.0]), True)
        elif not all(abs(s) <= 1 for s in pose):
            pose = [Fraction(0)] * 2
        signs = rng.choice([-1.0, 1.0], self.count + 1) if rng.integers(2) else rng.uniform(-1.0, 1.0, self.count + 1)
        places = np.array([float(value(one, pose, s)) for one, s in zip(self.edges.place, signs, strict=True)])
        along = 0.99 * places
        distances = np.where(along < 0.5, 2.0 * along, 1.0 / (2.0 - 2.0 * along))
        densities = np.zeros(self.count)
        for i in range(self.count):
            middle = np.zeros(5)
            edges.middle_of(self.edges, i, middle)
            apart = 0.5 * (distances[i] + distances[i + 1]) - float(value(middle, pose, 0.0))
            place = min(max(apart / middle[3], -1.0), 1.0) if middle[3] > 0.0 else 0.0
            if np.isfinite(self.density[i, -1]):
                densities[i] = max(float(member(rng, self.density[i], pose, place)), 0.0)
            else:
                densities[i] = 10.0 ** rng.uniform(-4.0, 8.0)
        return pose, places, distances, densities


def weights_of(distances: np.ndarray, densities: np.ndarray) -> torch.Tensor:
    """[n] weights of intervals."""
    return interval_weights(torch.from_numpy(densities)[None], torch.from_numpy(np.diff(distances))[None])[0]


def test_light_and_places_of_samples_are_enclosed() -> None:
    tight = 0
    for seed in range(DRAWS):
        ray = Ray(seed)
        if not ray.known:
            continue
        wanted = 9
        following = edges.edges_of(wanted - 1, POSES)
        if not distribution.follow(ray.light, ray.count, ray.edges, wanted, ray.line, following, np.zeros((3, 5))):
            continue
        for _ in range(6):
            pose, places, distances, densities = ray.draw()
            weights = weights_of(distances, densities)
            found = next_places(torch.from_numpy(places)[None], weights[None], wanted - 1)[0].numpy()
            left = np.exp(-np.append(0.0, np.cumsum(np.diff(distances) * densities)))
            assert np.all(ray.light.left[:, 0] <= left) and np.all(left <= ray.light.left[:, 1])
            for j in range(wanted):
                assert following.low[j] <= found[j] <= following.high[j]
                apart = abs(Fraction(float(found[j])) - value(following.place[j], pose))
                assert apart <= Fraction(float(following.place[j, 3]))
        tight += bool(following.place[:, 3].max() < 1e-3)
    assert tight > DRAWS // 4
    assert HISTOGRAM_PADDING == 0.01


def test_colours_of_rays_are_enclosed() -> None:
    for seed in range(DRAWS):
        ray = Ray(seed)
        if not ray.known:
            continue
        rng, count, last = ray.rng, ray.count, seed % 3 == 0
        colors = np.zeros((count, 6))
        for i in range(count):
            one = random_form(rng, rng.uniform(0.2, 0.8), 0.05)
            start, stop = ray.shares[i]
            colors[i] = [*one[:3], one[3] * start, one[3] * stop, one[4] + abs(one[3]) * max(1.0 - start - stop, 0.0)]
            colors[i, 5] += 1e-15
        reach = np.abs(colors[:, 1:]).sum(axis=1) + 1e-12
        low, high = colors[:, 0] - reach, colors[:, 0] + reach
        out, ends, behind = np.zeros(5), np.zeros((2, 3)), 0.3
        composition.form_color(ray.light, count, colors, behind, last, ray.line, out)
        three = [np.repeat(side[:, None], 3, axis=1) for side in (low, high)]
        composition.interval_colors(ray.light, count, *three, np.full(3, behind), last, ends)
        bounds = composition.form_bounds(out, ray.line)
        shifts, moved = np.array([[0.1, 0.2], [-0.1, 0.3]]), np.zeros((2, 3))
        room = np.zeros((2, count, 3))
        composition.shifted_interval_colors(
            ray.light, count, np.stack(three), shifts, np.full(3, behind), last, room, moved
        )
        for _ in range(6):
            pose, _, distances, densities = ray.draw()
            weights = weights_of(distances, densities).numpy()
            # symbols of the edges as they are
            edge = np.zeros(count + 1)
            for j in range(count + 1):
                own = ray.edges.distance[j]
                rest = distances[j] - float(value(np.append(own[:3], [0.0, 0.0]), pose))
                edge[j] = min(max(rest / own[3], -1.0), 1.0) if own[3] > 0.0 else 0.0
            picked = np.array(
                [
                    float(value(np.append(colors[i, :3], [0.0, 0.0]), pose)) + colors[i, 3] * edge[i]
                    + colors[i, 4] * edge[i + 1] + colors[i, 5] * rng.choice([-1.0, 1.0])
                    for i in range(count)
                ]
            )  # fmt: skip
            picked = np.clip(picked, low, high)
            shown = (weights * picked).sum() + (picked[-1] if last else behind) * (1.0 - weights.sum())
            assert ends[0, 0] <= shown <= ends[1, 0] and bounds[0] <= shown <= bounds[1]
            grey = torch.from_numpy(np.repeat(picked[:, None], 3, axis=1))
            colors_moved = shifted(grey, *(float(rng.uniform(*one)) for one in shifts)).numpy()
            total = weights @ colors_moved + (colors_moved[-1] if last else behind) * (1.0 - weights.sum())
            assert np.all(moved[0] <= total) and np.all(total <= moved[1])
            if np.isfinite(out[-1]):
                assert abs(Fraction(float(shown)) - value(np.append(out[:3], [0.0, 0.0]), pose)) <= Fraction(
                    float(out[-1])
                )
