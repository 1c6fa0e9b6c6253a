"""Chebyshev zonotopes through a field contain every concrete evaluation; planted faults do not."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from nerfs import raw_outputs, tiny_weights

from ns_abstract.methods.nerf import zonotope
from ns_abstract.methods.nerf.bounds import basis_of, opacity
from ns_abstract.methods.nerf.scene import FieldWeights
from ns_abstract.methods.nerf.zonotope import Affine, FieldBounds

#: A tolerance of zero: what is compared carries its own rounding.
FIELDS = {
    "plain": {},
    "spikes of density": {"density": 1e4},
    "saturated colours": {"color": 1e4},
    "high frequencies": {"rough": 60.0},
    "all of it": {"density": 1e4, "color": 300.0, "rough": 30.0},
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
    basis = basis_of(dimensions)
    field = FieldBounds(weights, basis)
    curve = curves(count, half, dimensions, seed)
    direction = curves(count, half, dimensions, seed + 1)
    zero = torch.zeros(count, 3, dtype=torch.float64)
    encoded = field.encode(on_curve(curve, basis.nodes), zero, weights.position)
    seen = field.encode(on_curve(direction, basis.nodes), zero, weights.direction)
    pieces = field.base(*encoded)
    found = [field.density(pieces), field.color(pieces, *seen)]
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


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("half", [0.0, 1e-4, 3e-3, 3e-2, 0.3])
def test_fields_are_enclosed(name: str, half: float) -> None:
    for seed in range(3):
        excess, _, _ = worst(tiny_weights(seed, **FIELDS[name]), half, seed=seed)
        assert excess <= 0.0


@pytest.mark.parametrize(("dimensions", "half"), [(0, 0.0), (2, 1e-3), (2, 1e-2), (3, 1e-3), (4, 1e-4), (6, 1e-5)])
def test_several_parameters(dimensions: int, half: float) -> None:
    excess, compared, _ = worst(tiny_weights(4), half, dimensions, count=6)
    assert excess <= 0.0 and compared > 0


def random_batch(field: FieldBounds, width: int, seed: int) -> Affine:
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
    return Affine(*map(torch.from_numpy, (poly, columns, owner, box)), failed, count)


def moved(columns: torch.Tensor, owner: torch.Tensor, signs: torch.Tensor, pieces: int) -> torch.Tensor:
    """[pieces, n] what error terms [C, n] of values ``signs`` [C] add."""
    return torch.zeros(pieces, columns.shape[1], dtype=torch.float64).index_add_(0, owner, columns * signs[:, None])


#: What the comparison's own arithmetic may be off by, far below what is charged for anything but rounding.
ROUNDING = 1e-12


@pytest.mark.parametrize(("dimensions", "compiled"), [(1, True), (1, False), (2, False)])
def test_every_unit_is_enclosed(dimensions: int, compiled: bool) -> None:
    """max(0, z) of one unit after the other, at the ends of its error terms and box."""
    weights, basis, kinds = tiny_weights(0), basis_of(dimensions), set()
    field = FieldBounds(weights, basis)
    field._compiled = field._compiled and compiled
    assert field._compiled == compiled
    rng = np.random.default_rng(1)
    points = np.concatenate([rng.uniform(-1, 1, (300, dimensions)), rng.choice([-1.0, 1.0], (8, dimensions))])
    values = torch.from_numpy(basis.values(points))
    for seed in range(3):
        z = random_batch(field, 16, seed)
        given = torch.matmul(values, z.poly)
        rho, box = zonotope.column_sums(z.columns, z.owner, 16), z.box.clone()
        before = z.columns.clone()
        found = field._relu(z)
        slope = zonotope.column_sums(found.columns, found.owner, 16) / rho.clamp(min=1e-300)
        new = torch.zeros(16, 16, dtype=torch.float64)
        new[found.new_owner, found.new_neuron] = found.new_size
        kinds |= {"open" if x > 0.0 else "closed" for x in new.ravel().tolist()}
        result = torch.matmul(values, found.poly)
        assert before.shape == found.columns.shape and not found.failed.any()
        for u in (-1.0, 0.0, 1.0):
            for v in (-1.0, 1.0):
                true = (given + (u * rho + v * box)[:, None]).clamp(min=0.0)
                away = (true - result - (u * slope * rho)[:, None]).abs().amax(dim=1)
                assert (away <= new + found.box + ROUNDING).all()
    assert kinds == {"open", "closed"}


def test_linear_layers_are_enclosed() -> None:
    """Error terms keep their values through a layer: those that move one neuron, too."""
    weights, basis = tiny_weights(0), basis_of(1)
    field = FieldBounds(weights, basis)
    weight, absolute, bias = field._base[1]
    width = weight.shape[0]
    layer = weight, absolute, bias + torch.linspace(-1.0, 1.0, len(bias), dtype=torch.float64)
    pieces = field._relu(random_batch(field, width, 5))
    after = field._linear(pieces, layer)
    rng = np.random.default_rng(2)
    values = torch.from_numpy(basis.values(rng.uniform(-1, 1, (50, 1))))
    units = torch.zeros(len(pieces.new_size), width, dtype=torch.float64)
    units[torch.arange(len(units)), pieces.new_neuron] = pieces.new_size
    columns, owner = torch.cat([pieces.columns, units]), torch.cat([pieces.owner, pieces.new_owner])
    assert len(units) > 10 and torch.equal(owner, after.owner)
    for _ in range(20):
        signs = torch.from_numpy(rng.choice([-1.0, 1.0], len(owner)))
        rest = pieces.box * torch.from_numpy(rng.choice([-1.0, 1.0], pieces.box.shape))
        inner = torch.matmul(values, pieces.poly) + (moved(columns, owner, signs, 16) + rest)[:, None]
        outer = torch.matmul(values, after.poly) + moved(after.columns, after.owner, signs, 16)[:, None]
        away = (inner @ layer[0] + layer[2] - outer).abs().amax(dim=1)
        assert (away <= after.box + ROUNDING).all()


def test_tightness() -> None:
    """No unnoticed loosening: widths over true widths on smooth, medium and rough pieces."""
    for half, limit in ((1e-4, 1.001), (3e-3, 1.02), (6e-3, 2.3)):
        assert 1.0 <= worst(tiny_weights(1), half)[2] < limit


def test_pieces_with_too_many_terms_are_given_up() -> None:
    weights, basis = tiny_weights(0, rough=60.0), basis_of(1)
    field = FieldBounds(weights, basis, limit=3)
    curve = curves(8, 0.3, 1, 0)
    nodes = on_curve(curve, basis.nodes)
    pieces = field.base(*field.encode(nodes, torch.zeros(8, 3, dtype=torch.float64), weights.position))
    assert pieces.failed.any()
    assert not pieces.failed[pieces.owner].any() and not pieces.failed[pieces.new_owner].any()


def test_numbers_that_are_none_fail() -> None:
    weights, basis = tiny_weights(0), basis_of(1)
    field = FieldBounds(weights, basis)
    nodes = on_curve(curves(4, 0.01, 1, 0), basis.nodes).clone()
    nodes[2] = float("nan")
    pieces = field.base(*field.encode(nodes, torch.zeros(4, 3, dtype=torch.float64), weights.position))
    assert pieces.failed.tolist() == [False, False, True, False]


def test_compiled_and_torch_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    """The compiled ReLU of one parameter follows the general one up to rounding."""
    weights, basis = tiny_weights(2, rough=5.0), basis_of(1)
    nodes, zero = on_curve(curves(16, 6e-3, 1, 0), basis.nodes), torch.zeros(16, 3, dtype=torch.float64)
    found = []
    for compiled in (True, False):
        field = FieldBounds(weights, basis)
        assert field._compiled
        field._compiled = compiled
        found.append(field.base(*field.encode(nodes, zero, weights.position)))
    assert found[0].new_size.numel() > 0
    for name in ("owner", "new_owner", "new_neuron", "failed", "count"):
        assert torch.equal(getattr(found[0], name), getattr(found[1], name)), name
    for name in ("poly", "columns", "new_size", "box", "size"):
        torch.testing.assert_close(getattr(found[0], name), getattr(found[1], name), rtol=1e-9, atol=1e-11)


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
    monkeypatch.setattr(zonotope, "scale_columns", lambda columns, owner, slope: columns.mul_(0.1))


def faulty_sums(monkeypatch: pytest.MonkeyPatch) -> None:
    sums = zonotope.column_sums
    monkeypatch.setattr(zonotope, "column_sums", lambda *arguments: 0.1 * sums(*arguments))


@pytest.mark.parametrize(
    ("fault", "half"),
    [(faulty_fit, 2e-2), (faulty_remainder, 0.1), (faulty_columns, 2e-2), (faulty_sums, 2e-2)],
)
def test_planted_faults_are_found(monkeypatch: pytest.MonkeyPatch, fault, half: float) -> None:
    weights = [tiny_weights(seed, rough=20.0) for seed in range(3)]
    assert max(worst(w, half, seed=s)[0] for s, w in enumerate(weights)) <= 0.0
    if fault is faulty_fit:
        # the general rule, which the compiled one agrees with
        monkeypatch.setattr(zonotope.FieldBounds, "_relu_compiled", zonotope.FieldBounds._relu_torch)
    fault(monkeypatch)
    assert max(worst(w, half, seed=s)[0] for s, w in enumerate(weights)) > 0.0


# ---------------------------------------------------------------- opacities


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
