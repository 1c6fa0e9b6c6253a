"""What kernels of hash-grid fields work on, from a field's record."""

from __future__ import annotations

import numpy as np

from ns_abstract.arithmetic.simd.lanes import LINE
from ns_abstract.arithmetic.simd.products import ROWS
from ns_abstract.methods.nerf.hash_bounds.edges import edges_of
from ns_abstract.methods.nerf.hash_bounds.features import feature_room
from ns_abstract.methods.nerf.hash_bounds.forms import form_width
from ns_abstract.methods.nerf.hash_bounds.light import light_of
from ns_abstract.methods.nerf.hash_bounds.network import (
    HeadWeights,
    LayerZonotope,
    NetWeights,
    head_weights,
    net_weights,
    zonotope,
)
from ns_abstract.methods.nerf.hash_bounds.pieces import DensityArrays, FieldArrays, PieceRoom
from ns_abstract.methods.nerf.hash_field import LAYERS_LIMIT, DenseNet, HashEncoding, NerfactoField

#: Harmonics of a direction.
HARMONICS = 16


def _density(encoding: HashEncoding, net: DenseNet, scale: float) -> DensityArrays:
    table = np.ascontiguousarray(encoding.table, np.float64)
    ranges = np.stack([table.min(axis=1), table.max(axis=1)], axis=1)
    resolutions = np.ascontiguousarray(encoding.resolutions, np.int64)
    return DensityArrays(table, resolutions, ranges, net_weights(net), float(scale))


def spacing_of(field: NerfactoField) -> tuple[bool, float, float]:
    """Whether distances are piecewise, and the ends of rays in the units in which edges are equally spaced."""
    if field.spacing == "uniform":
        return False, float(field.near), float(field.far)
    first, last = (x / 2.0 if x < 1.0 else 1.0 - 1.0 / (2.0 * x) for x in (field.near, field.far))
    return True, first, last


def field_arrays(field: NerfactoField) -> FieldArrays:
    """The arrays of ``field`` for kernels."""
    last = isinstance(field.background, str)
    return FieldArrays(
        tuple(_density(one.encoding, one.net, one.average_init_density) for one in field.proposals),
        _density(field.encoding, field.density_net, field.average_init_density),
        head_weights(field.color_net, HARMONICS),
        np.zeros(3) if last else np.ascontiguousarray(field.background, np.float64),
        last,
        spacing_of(field),
    )


def _rooms(net: NetWeights, symbols: int, layers: int = 0) -> tuple[LayerZonotope, ...]:
    """Neurons of every layer, at least ``layers``; ``symbols`` rows before its first ReLU."""
    rows = symbols + int(net.sizes[1:-1].sum())
    rooms = tuple(zonotope(rows, int(n)) for n in net.sizes[1:])
    return rooms + (zonotope(1, 1),) * (layers - len(rooms))


def piece_room(field: NerfactoField, arrays: FieldArrays, dimensions: int) -> PieceRoom:
    """Scratch of one thread for sets of so many parameters."""
    n = form_width(dimensions)
    densities = (*arrays.proposals, arrays.density)
    features = [one.table.shape[0] * one.table.shape[2] for one in densities]
    pairs = zip(densities, features, strict=True)
    rooms = tuple(_rooms(one.net, n + 2 + count, LAYERS_LIMIT) for one, count in pairs)
    head: HeadWeights = arrays.head
    neurons = int(head.net.sizes[1])
    most = max(int(net.sizes.max()) for net in (head.net, *(one.net for one in densities)))
    forms, count = np.zeros((3, n + 3)), field.samples[-1]
    return PieceRoom(
        (np.zeros((24, n + 3)), np.zeros((2, n + 4))),
        (forms, forms.copy(), np.zeros((3, 3, n + 3)), np.zeros((3, 3, n + 3)), np.zeros(3, np.bool_)),
        (np.zeros((HARMONICS, n + 3)), np.zeros((n + 2, neurons)), np.zeros(neurons)),
        np.zeros((max(features), n + 3)),
        feature_room(max(one.table.shape[2] for one in densities)),
        tuple(edges_of(count, n) for count in field.samples),
        tuple(light_of(count, n) for count in field.samples),
        rooms,
        _rooms(head.net, rooms[-1][0].rows.shape[0]),
        (np.zeros((count, 3, n + 4)), np.zeros((2, count, 3)), np.zeros((2, count, 3))),
        np.zeros(most, np.int64),
        np.zeros((ROWS, 2 * LINE // 8)),
    )  # fmt: skip
