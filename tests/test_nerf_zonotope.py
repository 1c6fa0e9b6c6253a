"""Chebyshev zonotopes through a field contain every concrete evaluation; planted faults do not."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
import torch
from nerfs import raw_outputs, tiny_weights

from ns_abstract.arithmetic.rounding import UNIT64
from ns_abstract.arithmetic.simd.lanes import LINE
from ns_abstract.methods.nerf import relu_kernel, zonotope
from ns_abstract.methods.nerf.field_kernel import CHUNK
from ns_abstract.methods.nerf.layer_kernel import BLOCK, LayerOutput, LayerWeights, linear
from ns_abstract.methods.nerf.layer_polynomials import PostActivation, PreActivation
from ns_abstract.methods.nerf.outputs import greatest, opacity
from ns_abstract.methods.nerf.ray_field import basis_of
from ns_abstract.methods.nerf.scene import Encoding, FieldWeights, Layer
from ns_abstract.methods.nerf.zonotope import FieldBounds

#: A tolerance of zero: what is compared carries its own rounding.
FIELDS = {
    "plain": {},
    "spikes of density": {"density": 1e4},
    "saturated colours": {"color": 1e4},
    "high frequencies": {"rough": 60.0},
    "all of it": {"density": 1e4, "color": 300.0, "rough": 30.0},
    "many layers": {"layers": 6},
}


def curves(count: int, half: float, dimensions: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Random curves (patches) of points: centre and linear and quadratic coefficients of polynomials."""
    rng = np.random.default_rng(seed)
    centre = torch.from_numpy(rng.uniform(-1, 1, (count, 1, 3)))
    slope = torch.from_numpy(half * rng.normal(size=(count, max(1, dimensions), 3)))
    return centre, slope


def on_curve(curve: tuple[torch.Tensor, torch.Tensor], points: np.ndarray) -> torch.Tensor:
    """[count, n, 3] the curves at parameters [n, d]."""
    centre, slope = curve
    p = torch.from_numpy(points)
    if not points.shape[1]:
        return centre.expand(-1, points.shape[0], 3)
    return centre + torch.einsum("nd,bdi->bni", p, slope) + 0.3 * (p**2).sum(1)[None, :, None] * slope.sum(1)[:, None]


def worst(
    weights: FieldWeights, half: float, dimensions: int = 1, count: int = 24, seed: int = 0, samples: int = 400
) -> tuple[float, int, float]:
    """Largest excess of concrete outputs beyond the bounds, comparisons, and mean width over true width."""
    basis = basis_of(dimensions, weights)
    field = FieldBounds(weights, basis)
    curve = curves(count, half, dimensions, seed)
    direction = curves(count, half, dimensions, seed + 1)
    zero = torch.zeros(count, 3, dtype=torch.float64)
    encoded = field.encode(on_curve(curve, basis.nodes), zero, field.position)
    seen = field.encode(on_curve(direction, basis.nodes), zero, field.direction)
    pieces, density = field.base(*encoded)
    found = [density, field.color(pieces, *seen)]
    rng = np.random.default_rng(seed + 2)
    points = np.concatenate([rng.uniform(-1, 1, (samples, dimensions)), rng.choice([-1.0, 1.0], (8, dimensions))])
    values = torch.from_numpy(basis.values(points))
    density, color = raw_outputs(weights, on_curve(curve, points), on_curve(direction, points))
    excess, compared, ratios = -np.inf, 0, []
    for part, true in zip(found, (density[..., None], color), strict=True):
        polynomial = torch.matmul(values, part.poly)
        good = ~part.failed
        distance = (true - polynomial).abs() - part.radius[:, None]
        if good.any():
            excess = max(excess, float(distance[good].max()))
            compared += int(distance[good].numel())
            width = polynomial.amax(1) - polynomial.amin(1) + 2.0 * part.radius
            ratios.append((width / (true.amax(1) - true.amin(1)).clamp(min=1e-300))[good].median())
    return excess, compared, float(np.mean(ratios)) if ratios else np.inf


@pytest.mark.slow_cases(every=10)
@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("half", [0.0, 1e-4, 3e-3, 3e-2, 0.3])
def test_fields_are_enclosed(name: str, half: float) -> None:
    for seed in range(3):
        excess, _, _ = worst(tiny_weights(seed, **FIELDS[name]), half, seed=seed)
        assert excess <= 0.0


@pytest.mark.slow
@pytest.mark.parametrize(("dimensions", "half"), [(0, 0.0), (2, 1e-3), (2, 1e-2), (3, 1e-3), (4, 1e-4), (6, 1e-5)])
def test_several_parameters(dimensions: int, half: float) -> None:
    excess, compared, _ = worst(tiny_weights(4), half, dimensions, count=6)
    assert excess <= 0.0 and compared > 0


def unseeing(weights: FieldWeights, position: list[int], direction: list[int]) -> FieldWeights:
    """``weights`` without those of some frequencies, and without the weight of one wave of a coordinate."""

    def without(layer: Layer, encoding: Encoding, gone: list[int]) -> Layer:
        matrix = layer.weight.copy()
        waves = matrix[:, : encoding.size - 3].reshape(-1, 2, 3, encoding.count)
        waves[..., gone] = 0.0
        waves[:, 1, 2, 0] = 0.0
        matrix[:, : encoding.size - 3] = waves.reshape(len(matrix), -1)
        return replace(layer, weight=matrix)

    base = tuple(
        without(layer, weights.position, position) if i == 0 or layer.skip else layer
        for i, layer in enumerate(weights.base)
    )
    head = (without(weights.head[0], weights.direction, direction), *weights.head[1:])
    return replace(weights, base=base, head=head)


@pytest.mark.parametrize("gone", [[], [2], [1, 3]])
def test_waves_that_no_weight_looks_at_are_left_out(gone: list[int]) -> None:
    whole = tiny_weights(3)
    weights = unseeing(whole, gone, [0])
    for waves, encoding, left in (
        (weights.position_waves, weights.position, gone),
        (weights.direction_waves, weights.direction, [0]),
    ):
        kept = [k for k in range(encoding.count) if k not in left]
        assert waves.frequencies.tolist() == encoding.frequencies[kept].tolist()
        assert waves.columns.size == 6 * len(kept) + 3
    assert len(weights.plan) == bool(gone) + 1 and not whole.plan
    # one layer that looks is enough
    other = replace(weights, base=(weights.base[0], *whole.base[1:]))
    assert any(layer.skip for layer in whole.base) and other.position_waves.frequencies.size == whole.position.count
    excess, compared, ratio = worst(weights, 3e-3)
    assert excess <= 0.0 and compared > 0 and ratio < 3.0


def test_a_wave_that_is_wrongly_left_out_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    weights = tiny_weights(3)
    fewer = unseeing(weights, [2], []).position_waves
    monkeypatch.setattr(FieldWeights, "position_waves", fewer)
    assert worst(weights, 3e-3)[0] > 0.0


def random_batch(field: FieldBounds, width: int, seed: int) -> PreActivation:
    """Every unit of a layer before its activation: dead, active and open ones, with and without columns and box."""
    rng, pieces, terms = np.random.default_rng(seed), 16, 3
    monomials = field.basis.evaluation.shape[1]
    poly = rng.normal(size=(pieces, monomials, width)) * 0.5 ** np.arange(monomials)[:, None]
    poly[:, 0] *= rng.choice([0.3, 1.0, 3.0], (pieces, width))
    columns = 0.3 * rng.normal(size=(pieces * terms, width)) * rng.choice([0.0, 0.1, 1.0], (pieces * terms, width))
    columns[: 4 * terms] = 0.0
    box = 0.2 * rng.uniform(size=(pieces, width)) * rng.choice([0.0, 0.1, 1.0], (pieces, width))
    owner = np.repeat(np.arange(pieces), terms)
    count = torch.full((pieces,), terms, dtype=torch.int64)
    failed = torch.zeros(pieces, dtype=torch.bool)
    spread = np.abs(columns).reshape(pieces, terms, width).sum(axis=1)
    arrays = [torch.from_numpy(a) for a in (poly, columns, owner, spread, box)]
    return PreActivation(arrays[0], arrays[1], arrays[2], arrays[3], arrays[4], failed, count)


def moved(columns: torch.Tensor, owner: torch.Tensor, signs: torch.Tensor, pieces: int) -> torch.Tensor:
    """[pieces, n] what error terms [C, n] of values ``signs`` [C] add."""
    return torch.zeros(pieces, columns.shape[1], dtype=torch.float64).index_add_(0, owner, columns * signs[:, None])


def compiled_relu(field: FieldBounds, z: PreActivation) -> PostActivation:
    """`FieldBounds._relu` by the compiled kernel."""
    assert field._grid is not None
    pieces, _, n = z.poly.shape
    slope, size, spread = torch.empty(3, pieces, n, dtype=torch.float64)
    failed, count = torch.empty_like(z.failed), torch.empty_like(z.count)
    piece, neuron = torch.empty(2, pieces * n, dtype=torch.int64)
    error = torch.empty(pieces * n, dtype=torch.float64)
    before = relu_kernel.ReluInput(*(a.numpy() for a in (z.poly, z.spread, z.box, z.failed, z.count)))
    behind = relu_kernel.ReluOutput(*(a.numpy() for a in (slope, size, spread, failed, count, piece, neuron, error)))
    found = relu_kernel.relu(before, field._grid, field.limit, behind)
    new = piece[:found], neuron[:found], error[:found]
    return PostActivation(z.poly, size, spread, z.box, slope, failed, count, z.columns, z.owner, *new)


#: An encoded vector of no number, for layers that see none.
NOTHING = torch.zeros(16, 1, 0, dtype=torch.float64), torch.zeros(16, 0, dtype=torch.float64)


def hidden_layer(field: FieldBounds) -> zonotope._FieldLayer:
    """A layer of ``field`` all of whose inputs are neurons."""
    return replace(field._base[1], seen=0)


#: What the comparison's own arithmetic may be off by, far below what is charged for anything but rounding.
ROUNDING = 1e-12


@pytest.mark.slow
@pytest.mark.parametrize(("dimensions", "compiled"), [(1, True), (1, False), (2, False)])
def test_every_unit_is_enclosed(dimensions: int, compiled: bool) -> None:
    """max(0, z) of one unit after the other, at the ends of its error terms and box."""
    weights, kinds = tiny_weights(0), set()
    basis = basis_of(dimensions, weights)
    field = FieldBounds(weights, basis)
    rng = np.random.default_rng(1)
    points = np.concatenate([rng.uniform(-1, 1, (300, dimensions)), rng.choice([-1.0, 1.0], (8, dimensions))])
    values = torch.from_numpy(basis.values(points))
    for seed in range(3):
        z = random_batch(field, 16, seed)
        given = torch.matmul(values, z.poly)
        rho, box = z.spread, z.box.clone()
        before = z.columns.clone()
        found = compiled_relu(field, z) if compiled else field._relu(z)
        slope = found.slope
        new = torch.zeros(16, 16, dtype=torch.float64)
        new[found.new_owner, found.new_neuron] = found.new_size
        kinds |= {"open" if x > 0.0 else "closed" for x in new.ravel().tolist()}
        result = torch.matmul(values, found.poly * (found.size != 0.0)[:, None])
        assert (found.spread >= slope * rho + new).all()
        assert before.shape == found.columns.shape and not found.failed.any()
        for u in (-1.0, 0.0, 1.0):
            for v in (-1.0, 1.0):
                true = (given + (u * rho + v * box)[:, None]).clamp(min=0.0)
                away = (true - result - (u * slope * rho)[:, None]).abs().amax(dim=1)
                assert (away <= new + found.box + ROUNDING).all()
    assert kinds == {"open", "closed"}


@pytest.mark.slow
@pytest.mark.parametrize(("compiled", "narrow"), [(True, True), (True, False), (False, False)])
def test_linear_layers_are_enclosed(compiled: bool, narrow: bool) -> None:
    """Error terms keep their values through a layer: those that move one neuron, too."""
    weights = tiny_weights(0)
    basis = basis_of(1, weights)
    field = FieldBounds(weights, basis)
    layer = hidden_layer(field)
    width, count = layer.weight.shape
    layer = replace(layer, bias=layer.bias + torch.linspace(-1.0, 1.0, count, dtype=torch.float64))
    assert layer.narrow is not None
    if not narrow:
        layer = replace(layer, narrow=None)
    if not compiled:
        field.compiled, field._grid = False, None
    pieces = field._relu(random_batch(field, width, 5))
    after = field._linear(pieces, layer, NOTHING)
    rng = np.random.default_rng(2)
    values = torch.from_numpy(basis.values(rng.uniform(-1, 1, (50, 1))))
    units = torch.zeros(len(pieces.new_size), width, dtype=torch.float64)
    units[torch.arange(len(units)), pieces.new_neuron] = pieces.new_size
    columns = torch.cat([pieces.columns * pieces.slope[pieces.owner], units])
    owner = torch.cat([pieces.owner, pieces.new_owner])
    if compiled:
        order = torch.argsort(owner, stable=True)
        columns, owner = columns[order], owner[order]
    assert len(units) > 10 and torch.equal(owner, after.owner)
    assert after.columns.dtype == (torch.float32 if narrow else torch.float64)
    exact = zonotope.column_sums(after.columns.double(), owner, 16)
    torch.testing.assert_close(after.spread, exact, rtol=1e-12, atol=0.0)
    poly = pieces.poly * (pieces.size != 0.0)[:, None]
    for _ in range(20):
        signs = torch.from_numpy(rng.choice([-1.0, 1.0], len(owner)))
        rest = pieces.box * torch.from_numpy(rng.choice([-1.0, 1.0], pieces.box.shape))
        inner = torch.matmul(values, poly) + (moved(columns, owner, signs, 16) + rest)[:, None]
        outer = torch.matmul(values, after.poly) + moved(after.columns.double(), after.owner, signs, 16)[:, None]
        away = (inner @ layer.weight + layer.bias - outer).abs().amax(dim=1)
        assert (away <= after.box + ROUNDING).all()


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1.0, 1e-25, 1e-39])
def test_columns_in_float32_are_charged(scale: float) -> None:
    """What float32 products of columns are off by lies in the box, which is hardly wider; gradual underflow, too."""
    field = FieldBounds(tiny_weights(0), basis_of(1, tiny_weights(0)))
    layer = hidden_layer(field)
    pieces = field._relu(random_batch(field, layer.weight.shape[0], 5))
    pieces = pieces._replace(
        columns=scale * pieces.columns, new_size=scale * pieces.new_size, spread=scale * pieces.spread,
        box=0.0 * pieces.box, size=scale * pieces.size, poly=0.0 * pieces.poly,
    )  # fmt: skip
    after = field._linear(pieces, layer, NOTHING)
    wide = field._linear(pieces, replace(layer, narrow=None), NOTHING)
    bias = 4.0 * UNIT64 * (layer.bias.abs() + after.poly[:, 0].abs())
    away = zonotope.column_sums(after.columns.double() - wide.columns, after.owner, 16)
    assert (away > 0.0).any() and (away <= after.box - bias).all()
    if scale == 1.0:
        assert (after.box - 2.0 * bias).max() < 1e-5 * after.spread.max()


def test_columns_beyond_float32_fail() -> None:
    field = FieldBounds(tiny_weights(0), basis_of(1, tiny_weights(0)))
    layer = hidden_layer(field)
    pieces = field._relu(random_batch(field, layer.weight.shape[0], 5))
    columns = pieces.columns.clone()
    columns[pieces.owner == 7] *= 1e39
    after = field._relu(field._linear(pieces._replace(columns=columns), layer, NOTHING))
    assert after.failed[7] and after.failed.sum() == 1


@pytest.mark.slow_cases(every=8)
@pytest.mark.parametrize("kind", [np.float64, np.float32])
@pytest.mark.parametrize(("inputs", "live", "outputs"), [(5, 0, 3), (1, 1, 1), (7, 6, 3), (96, 71, 40), (64, 64, 1)])
def test_products_leave_out_what_is_off(kind: type, inputs: int, live: int, outputs: int) -> None:
    """Pieces with no, one and many columns; what is off, and what fills up a row's last line, holds no numbers."""
    rng, batch, m = np.random.default_rng(inputs), 3, 5
    counts, new_counts = np.array([0, 1, BLOCK + 6]), np.array([2, 0, 1]) * (live > 0)
    off = np.ones((batch, inputs), bool)
    for row in off:
        row[rng.permutation(inputs)[:live]] = False
    poly = np.where(off[:, None], np.nan, rng.normal(size=(batch, m, inputs)))
    owner, new_owner = np.repeat(np.arange(batch), counts), np.repeat(np.arange(batch), new_counts)
    columns = np.where(off[owner], np.nan, rng.normal(size=(len(owner), inputs))).astype(kind)
    slope = np.where(off, np.nan, rng.uniform(size=(batch, inputs)))
    neuron = np.array([rng.choice(np.flatnonzero(~off[b])) for b in new_owner], np.int64)
    sizes = rng.uniform(size=len(neuron))
    wide = rng.normal(size=(inputs, outputs)).astype(np.float32).astype(np.float64)
    total = len(owner) + len(neuron)
    out = LayerOutput(
        np.full((batch, m, outputs), np.nan), np.full((total, outputs), np.nan, kind), np.full(total, -1),
        *np.full((2, batch, outputs), np.nan),
    )  # fmt: skip
    rest = np.where(off, np.nan, rng.uniform(size=(batch, inputs)))
    failed, none = np.zeros(batch, bool), np.zeros(batch, np.int64)
    before = PostActivation(
        poly, np.where(off, 0.0, 1.0), rest, rest, slope, failed, none, columns, owner, new_owner, neuron, sizes
    )
    # columns and rows of an encoded vector come first
    lines = np.full((2 + inputs, outputs + -outputs % (LINE // 2)), np.nan)
    given = rng.normal(size=(2, outputs))
    lines[:, :outputs] = np.concatenate([given, wide])
    encoded, remainder, bias = rng.normal(size=(batch, m, 2)), rng.uniform(size=(batch, 2)), rng.normal(size=outputs)
    weights = LayerWeights(
        lines[:2], np.abs(given), lines[2:], lines[2:].astype(kind), np.abs(wide), bias, 0.0, 0.0, 0.0
    )
    assert linear(before, encoded, remainder, weights, out) == total
    result = np.where(off[:, None], 0.0, poly) @ wide + encoded @ given
    result[:, 0] += bias
    np.testing.assert_allclose(out.poly, result, atol=1e-12)
    box = np.where(off, 0.0, rest) @ np.abs(wide) + remainder @ np.abs(given)
    np.testing.assert_allclose(out.box, box, atol=1e-12)
    for b in range(batch):
        old = np.where(off[b], 0.0, columns[owner == b] * slope[b]).astype(np.float64) @ wide
        new = sizes[new_owner == b, None] * wide[neuron[new_owner == b]]
        expected = np.concatenate([old, new])
        np.testing.assert_allclose(out.columns[out.owner == b], expected, atol=1e-12 if kind is np.float64 else 1e-4)
        np.testing.assert_allclose(out.sums[b], np.abs(out.columns[out.owner == b].astype(np.float64)).sum(axis=0))
    assert (np.diff(out.owner) >= 0).all()


def test_tightness() -> None:
    """No unnoticed loosening: widths over true widths on smooth, medium and rough pieces."""
    for half, limit in ((1e-4, 1.001), (3e-3, 1.02), (6e-3, 2.3)):
        assert 1.0 <= worst(tiny_weights(1), half)[2] < limit


def test_pieces_with_too_many_terms_are_given_up() -> None:
    """At any layer, the last one too, behind which failed pieces have columns still."""
    weights = tiny_weights(0, rough=60.0)
    basis = basis_of(1, weights)
    nodes = on_curve(curves(8, 0.3, 1, 0), basis.nodes)
    for limit in (3, 12, 18, 24, 30, 36):
        field = FieldBounds(weights, basis, limit=limit)
        pieces, _ = field.base(*field.encode(nodes, torch.zeros(8, 3, dtype=torch.float64), field.position))
        assert pieces.failed.any() or limit > 3
        assert not pieces.failed[pieces.owner].any() and not pieces.failed[pieces.new_owner].any()


@pytest.mark.parametrize("compiled", [True, False])
def test_numbers_that_are_none_fail(compiled: bool) -> None:
    weights = tiny_weights(0)
    basis = basis_of(1, weights)
    field = FieldBounds(weights, basis)
    if not compiled:
        field._grid = None
    nodes = on_curve(curves(4, 0.01, 1, 0), basis.nodes).clone()
    nodes[2] = float("nan")
    pieces, _ = field.base(*field.encode(nodes, torch.zeros(4, 3, dtype=torch.float64), field.position))
    assert pieces.failed.tolist() == [False, False, True, False]


def test_compiled_and_torch_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    """The compiled ReLU of one parameter follows the general one up to rounding."""
    weights = tiny_weights(2, rough=5.0)
    basis = basis_of(1, weights)
    nodes, zero = on_curve(curves(16, 6e-3, 1, 0), basis.nodes), torch.zeros(16, 3, dtype=torch.float64)
    found = []
    for compiled in (True, False):
        field = FieldBounds(weights, basis)
        assert field._grid is not None
        if not compiled:
            field._grid = None
        found.append(field.base(*field.encode(nodes, zero, field.position))[0])
    assert found[0].new_size.numel() > 0
    for name in ("owner", "new_owner", "new_neuron", "failed", "count"):
        assert torch.equal(getattr(found[0], name), getattr(found[1], name)), name
    found = [pieces._replace(poly=pieces.poly * (pieces.size != 0.0)[:, None]) for pieces in found]
    for name in ("poly", "columns", "slope", "new_size", "spread", "box", "size"):
        torch.testing.assert_close(getattr(found[0], name), getattr(found[1], name), rtol=1e-9, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("layers", [3, 6])
def test_chunks_are_as_good_as_layer_after_layer(layers: int) -> None:
    """Pieces of several chunks, the last one smaller, in fields whose early layers have float64 columns or not."""
    weights = tiny_weights(2, rough=5.0, layers=layers)
    basis = basis_of(1, weights)
    field = FieldBounds(weights, basis)
    assert field._grid is not None
    count = 2 * CHUNK + 3
    zero = torch.zeros(count, 3, dtype=torch.float64)
    encoded = field.encode(on_curve(curves(count, 6e-3, 1, 0), basis.nodes), zero, field.position)
    seen = field.encode(on_curve(curves(count, 6e-3, 1, 1), basis.nodes), zero, field.direction)
    pieces, density = field.base(*encoded)
    # colours are of some pieces, whose columns begin anywhere
    some = torch.tensor([1, 2, *range(CHUNK - 1, count)])
    color = field.color(pieces.select(some), *(part[some] for part in seen))
    after = field._nothing(encoded[0])
    for layer in field._base:
        after = field._relu(field._linear(after, layer, encoded))
    assert torch.equal(pieces.failed, after.failed) and not after.failed.any()
    for name in ("owner", "new_owner", "new_neuron", "count"):
        assert torch.equal(getattr(pieces, name), getattr(after, name)), name
    for name in ("columns", "slope", "new_size", "spread", "box", "size"):
        torch.testing.assert_close(getattr(pieces, name), getattr(after, name), rtol=1e-9, atol=1e-11)
    head, of_some = after.select(some), (seen[0][some], seen[1][some])
    for layer in field._head:
        head = field._relu(field._linear(head, layer, of_some))
    for found, expected in (
        (density, field._linear(after, field._density, encoded)),
        (color, field._linear(head, field._color, of_some)),
    ):
        for name in ("poly", "spread", "box"):
            torch.testing.assert_close(getattr(found, name), getattr(expected, name), rtol=1e-9, atol=1e-11)


# ---------------------------------------------------------------- planted faults


def faulty_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    fitted = FieldBounds._fitted

    def halved(self: FieldBounds, p: torch.Tensor, values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        q, error = fitted(self, p, values)
        return q, 0.3 * error

    monkeypatch.setattr(FieldBounds, "_fitted", halved)


def faulty_remainder(monkeypatch: pytest.MonkeyPatch) -> None:
    encode = FieldBounds.encode

    def without(self: FieldBounds, *arguments: object) -> tuple[torch.Tensor, torch.Tensor]:
        poly, remainder = encode(self, *arguments)  # type: ignore[arg-type]
        return poly, 0.0 * remainder

    monkeypatch.setattr(FieldBounds, "encode", without)


def faulty_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    linear = FieldBounds._linear

    def narrowed(self: FieldBounds, pieces: PostActivation, *arguments: object) -> PreActivation:
        return linear(self, pieces._replace(slope=0.1 * pieces.slope), *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(FieldBounds, "_linear", narrowed)


def faulty_sums(monkeypatch: pytest.MonkeyPatch) -> None:
    linear = FieldBounds._linear

    def narrowed(self: FieldBounds, *arguments: object) -> PreActivation:
        found = linear(self, *arguments)  # type: ignore[arg-type]
        return replace(found, spread=0.1 * found.spread)

    monkeypatch.setattr(FieldBounds, "_linear", narrowed)


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    ("fault", "half"),
    [(faulty_fit, 2e-2), (faulty_remainder, 0.1), (faulty_columns, 2e-2), (faulty_sums, 2e-2)],
)
def test_planted_faults_are_found(monkeypatch: pytest.MonkeyPatch, fault, half: float) -> None:
    weights = [tiny_weights(seed, rough=20.0) for seed in range(3)]
    assert max(worst(w, half, seed=s)[0] for s, w in enumerate(weights)) <= 0.0
    if fault is not faulty_remainder:
        # the general rules, which the compiled ones agree with
        monkeypatch.setattr(zonotope, "grid_of", lambda basis: None)
    fault(monkeypatch)
    assert max(worst(w, half, seed=s)[0] for s, w in enumerate(weights)) > 0.0


# ---------------------------------------------------------------- opacities


def test_greatest_values_on_whole_cells() -> None:
    """Never below what a piece reaches, and reached where coefficients do not alternate."""
    basis, rng = basis_of(1, tiny_weights(0)), np.random.default_rng(3)
    poly = rng.normal(size=(40, basis.size, 2)) * 10.0 ** rng.uniform(-3, 3, (40, 1, 2))
    poly[:8] = np.abs(poly[:8])
    poly[8:12, 0] *= 1e12
    spread, box = rng.uniform(0.0, 2.0, (2, 40, 2)) * (rng.uniform(size=(40, 1)) < 0.7)
    nothing = torch.zeros(40, dtype=torch.int64)
    value = PreActivation(
        torch.from_numpy(poly), torch.zeros(0, 2), nothing[:0], torch.from_numpy(spread), torch.from_numpy(box),
        nothing > 0, nothing,
    )  # fmt: skip
    found = greatest(value).numpy()
    for b, n in np.ndindex(40, 2):
        # exact values at the ends, where T_k is 1 or (-1)^k
        coefficients = [Fraction(c) for c in poly[b, :, n].tolist()]
        ends = [sum(coefficients), sum(c * (-1) ** k for k, c in enumerate(coefficients))]
        reached = max(ends) + Fraction(spread[b, n]) + Fraction(box[b, n])
        assert Fraction(found[b, n]) >= reached
        if b < 8:
            assert found[b, n] <= float(reached) * (1.0 + 1e-10)


def test_opacities_are_monotone_bounds() -> None:
    z = torch.cat([torch.linspace(-800, 800, 4001), torch.tensor([20.0 - 1e-9, 20.0, 20.0 + 1e-9, 1e9, -1e9])]).double()
    for length in (1e-6, 0.1, 100.0):
        exact = torch.tensor(length, dtype=torch.float64)
        low, high = opacity(z, exact, up=False), opacity(z, exact, up=True)
        concrete = 1.0 - torch.exp(-length * torch.nn.functional.softplus(z))
        assert (low <= high).all() and (low >= 0.0).all() and (high <= 1.0).all()
        # the renderer's 1 - exp(-x) carries an absolute rounding, which compositing is charged with
        assert (low <= concrete + 2.0**-52).all() and (concrete <= high + 2.0**-52).all()
        assert (high - low).max() < 1e-8
