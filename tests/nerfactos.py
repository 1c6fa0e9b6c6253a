"""Small random nerfactos that tests share."""

from __future__ import annotations

import numpy as np

from ns_abstract.methods.nerf.hash_field import DenseNet, HashEncoding, NerfactoField, NerfactoScene, ProposalField
from ns_abstract.methods.nerf.nerfacto_load import FEATURES, HARMONICS, resolutions


def random_net(rng: np.random.Generator, *widths: int, bias: float = 0.0) -> DenseNet:
    """Layers whose outputs have standard deviations of about 1, all values those of float32."""

    def near(values: np.ndarray) -> np.ndarray:
        return np.asarray(values, np.float32).astype(np.float64)

    pairs = list(zip(widths[1:], widths[:-1], strict=True))
    biases = [near(0.3 * rng.standard_normal(n)) for n, _ in pairs]
    biases[-1][0] = near(biases[-1][0] + bias)
    return DenseNet(tuple(near(rng.standard_normal((n, m)) * (2.0 / m) ** 0.5) for n, m in pairs), tuple(biases))


def random_grid(rng: np.random.Generator, levels: int, log2_size: int, most: int, features: int = 2) -> HashEncoding:
    """A grid whose finer levels have smaller features, as trained ones."""
    table = rng.standard_normal((levels, 1 << log2_size, features))
    table *= 0.7 ** np.arange(levels)[:, None, None]
    return HashEncoding(table.astype(np.float32).astype(np.float64), resolutions(levels, 16, most))


def tiny_nerfacto(seed: int = 0, density: float = 4.0, samples: tuple[int, ...] = (24, 16, 12)) -> NerfactoScene:
    """A field of 4 levels to resolution 100, which is neither opaque nor empty; black behind it, far 6.

    ``density`` is the mean logarithm of the densities over 0.01.
    """
    rng = np.random.default_rng(seed)
    grid = random_grid(rng, 4, 9, 100)
    rounds = []
    for _ in samples[1:]:
        proposal = random_grid(rng, 3, 8, 50)
        rounds.append(ProposalField(proposal, random_net(rng, proposal.size, 8, 1, bias=density), 0.01))
    field = NerfactoField(
        grid,
        random_net(rng, grid.size, 16, 1 + FEATURES, bias=density),
        random_net(rng, HARMONICS + FEATURES, 16, 16, 3),
        0.01,
        tuple(rounds),
        samples,
        far=6.0,
        background=np.zeros(3),
    )
    return NerfactoScene(field, name="tiny")
