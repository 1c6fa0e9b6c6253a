"""Bounds of a field over curves of points, by propagating Chebyshev zonotopes through its layers (F3-F6).

A batch of B pieces, each a curve (or patch) of points over its own cell of poses ``p in [-1, 1]^d``, is kept as

    h_j(p) = sum_k c_kj T_k(p) + sum_i g_ij e_i + s_j,   |e_i| <= 1,  |s_j| <= r_j

for every neuron j: polynomials of the pose, shared error terms ("columns") and a box. A linear layer is exact on
all three; a ReLU whose sign is open over the cell is replaced by a polynomial of the pose fitted to it, and its
error becomes a column of its own. All columns of a batch stand in one matrix, so pieces with many error terms do
not make the others wait. Arithmetic is float64, or float32 for the columns of later layers, and its rounding is
charged to the box.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ns_abstract.arithmetic.chebyshev import ChebyshevBasis
from ns_abstract.arithmetic.rounding import (
    BIAS_ROUNDING,
    CHEBYSHEV_ROUNDING,
    ELLIPSE_UP,
    FIELD_UP,
    LEAST_SLOPE,
    NARROW_ROUNDING,
    RELU_ROUNDING,
    UNDERFLOW_COLUMNS,
    WAVE_ROUNDING,
    gamma,
)
from ns_abstract.arithmetic.simd.lanes import LINE
from ns_abstract.methods.nerf import layer_kernel
from ns_abstract.methods.nerf.field_kernel import FieldOutputs, StackedLayers, stacked, through_layers
from ns_abstract.methods.nerf.layer_kernel import LayerWeights, linear
from ns_abstract.methods.nerf.layer_polynomials import PostActivation, PreActivation, column_sums
from ns_abstract.methods.nerf.ray_bundle import TAYLOR
from ns_abstract.methods.nerf.relu_kernel import FitGrid, grid_of
from ns_abstract.methods.nerf.scene import Encoding, FieldWeights, Layer, Waves

#: Radii of Bernstein ellipses that are tried for the remainder of an encoding.
_ELLIPSES = (1.05, 1.15, 1.3, 1.6, 2.0, 2.6, 3.5, 5.0, 8.0, 14.0, 30.0, 80.0, 300.0)
#: Last layers of the base whose columns are multiplied in float32, as those of the head: the later a radius begins, the
#: less it grows.
_NARROW_LAYERS = 4
#: Largest degree by variable of a vector to encode: `TAYLOR`, and one more if the distance moves with the pose.
VECTOR_DEGREE = TAYLOR + 1
#: Most error terms of a piece; with more, it fails and its outputs have no bounds.
ERROR_TERMS = 400
#: Polynomials [B, m, k] and remainders [B, k] of an encoded vector.
Encoded = tuple[Tensor, Tensor]


def _rounding(inputs: int) -> float:
    """Return the relative error of a layer with so many ``inputs``: of these sums and a float64 evaluation together."""
    return 2.0 * gamma(inputs + 4)


def _before(pieces: PostActivation, kind: torch.dtype) -> PostActivation:
    """Return ``pieces`` as NumPy arrays for compiled layers, with columns of the type ``kind``."""
    return PostActivation(*(tensor.numpy() for tensor in pieces._replace(columns=pieces.columns.to(kind))))


@dataclass(frozen=True)
class _FieldLayer:
    """A linear layer: transposed ``weight`` [in, out], its ``absolute`` value and ``bias`` [out], all float64.

    The first ``seen`` inputs are an encoded vector's, the others neurons. For compiled products, ``lines`` is the
    weight with rows padded to whole pairs of cache lines; ``narrow`` is the same in float32 (exact), or None.
    """

    seen: int
    weight: Tensor
    absolute: Tensor
    bias: Tensor
    lines: Tensor
    narrow: Tensor | None


def _seeing(layer: Layer, encoding: Encoding, waves: Waves) -> Layer:
    """Return ``layer``, whose first inputs are the encoded vector, without the inputs outside of ``waves``."""
    columns = np.concatenate([waves.columns, np.arange(encoding.size, layer.weight.shape[1])])
    return replace(layer, weight=np.ascontiguousarray(layer.weight[:, columns]))


class FieldBounds:
    """Propagates Chebyshev zonotopes through one field's networks.

    Args:
        basis: Chebyshev basis of the polynomials.
        limit: Most error terms of a piece before it fails.
        compiled: Whether compiled CPU kernels are used; None: if ``device`` is a CPU.
    """

    def __init__(
        self,
        weights: FieldWeights,
        basis: ChebyshevBasis,
        limit: int = ERROR_TERMS,
        device: torch.device | str = "cpu",
        compiled: bool | None = None,
    ) -> None:
        self.basis, self.limit, self.device = basis, limit, torch.device(device)
        self.compiled = self.device.type == "cpu" if compiled is None else compiled
        wide = len(weights.base) - _NARROW_LAYERS
        self.position, self.direction = weights.position_waves, weights.direction_waves
        self._base = [
            self._put(layer, i >= wide, (weights.position, self.position) if i == 0 or layer.skip else None)
            for i, layer in enumerate(weights.base)
        ]
        self._head = [
            self._put(layer, True, None if i else (weights.direction, self.direction))
            for i, layer in enumerate(weights.head)
        ]
        self._density, self._color = self._put(weights.density, True), self._put(weights.color, True)
        low_degrees, rest = (torch.from_numpy(a).to(device) for a in basis.interpolation)
        self._kept, self._rest = low_degrees, rest
        self._evaluation = torch.from_numpy(basis.evaluation).to(device)
        self._fit = torch.from_numpy(np.ascontiguousarray(basis.fit)).to(device)
        self._chord = torch.from_numpy(basis.chord).to(device)
        self._grid = grid_of(basis) if self.compiled and basis.dimensions == 1 and basis.grid % 2 == 0 else None
        degrees = torch.from_numpy(basis.indices).to(device, torch.float64)
        ellipses = torch.tensor(_ELLIPSES, dtype=torch.float64, device=device)
        # [ellipses, d, m]: bound of |Im T_k| on the ellipse of one variable, rounded up
        self._imaginary = (
            0.5 * (ellipses[:, None, None] ** degrees.T - ellipses[:, None, None] ** -degrees.T) * ELLIPSE_UP
        )
        # [ellipses, d] the same bound for the highest degree of a vector to encode
        self._steepest = self._imaginary.masked_fill(degrees.T > VECTOR_DEGREE, 0.0).amax(dim=2)
        self._decay = 4.0 * ellipses**-basis.degree / (ellipses - 1.0) * ELLIPSE_UP
        self._bernstein: dict[tuple[int, ...], Tensor] = {}

    def bernstein(self, parts: tuple[int, ...]) -> Tensor:
        """Return `ChebyshevBasis.bernstein` of the basis for ``parts`` by axis, cached."""
        if parts not in self._bernstein:
            self._bernstein[parts] = torch.from_numpy(self.basis.bernstein(parts)).to(self.device)
        return self._bernstein[parts]

    def _put(self, layer: Layer, narrow: bool, sees: tuple[Encoding, Waves] | None = None) -> _FieldLayer:
        if sees is not None:
            layer = _seeing(layer, *sees)
        seen_inputs = 0 if sees is None else sees[1].columns.size
        weight = torch.from_numpy(layer.weight).to(self.device, torch.float64).T.contiguous()
        bias = torch.from_numpy(layer.bias).to(self.device, torch.float64)
        # only the compiled product gains by float32
        narrow &= self.compiled
        lines = functional.pad(weight, (0, -weight.shape[1] % (LINE // 2))) if self.compiled else weight
        return _FieldLayer(seen_inputs, weight, weight.abs(), bias, lines, lines.float() if narrow else None)

    def encode(self, nodes: Tensor, radius: Tensor, seen: Waves) -> tuple[Tensor, Tensor]:
        """Return polynomials and remainders of an encoded vector (design.md, F3).

        Returns [B, m, k] coefficients and [B, k] remainders of the k components ``seen``.

        Args:
            nodes: [B, nodes, 3] the vector's polynomial at the basis' nodes. Its degree by variable is at most
                the basis' and `VECTOR_DEGREE`.
            radius: [B, 3] distance of the vector from the polynomial.
        """
        omega = 2.0 * np.pi * torch.from_numpy(seen.frequencies).to(self.device)
        angles = (nodes[..., None] * omega).flatten(-2)
        values = torch.cat([torch.sin(angles), torch.cos(angles), nodes], dim=-1)
        poly = torch.matmul(self._kept, values)
        dropped = torch.matmul(self._rest, values).abs().sum(dim=1) if self._rest.shape[0] else 0.0
        x = poly[..., -3:]
        rest = torch.matmul(self._rest, nodes).abs().sum(dim=1) if self._rest.shape[0] else torch.zeros_like(radius)
        lebesgue, largest = self.basis.lebesgue, nodes.abs().amax(dim=1)
        remainder = torch.zeros_like(radius)[..., None].expand(-1, -1, omega.numel())
        for j in range(self.basis.dimensions):
            # terms of x above the degree are bounded like the basis' highest degree
            tops = self._imaginary[:, j].max(dim=1).values
            phase = torch.einsum("em,bmi->bie", self._imaginary[:, j], x.abs()) + rest[..., None] * tops
            rounded = self.basis.interpolation_rounding * largest[..., None] * self._steepest[:, j]
            exponent = omega[:, None] * (phase * ELLIPSE_UP + rounded)[..., None, :]
            growth = torch.where(exponent < 600.0, torch.cosh(exponent.clamp(max=600.0)), torch.inf)
            error = (growth * self._decay).amin(dim=-1).clamp(max=1.0 + lebesgue)
            remainder = remainder + lebesgue**j * error
        # the vector's own radius; the argument's and the functions' rounding, seen through the interpolation
        argument = lebesgue**self.basis.dimensions * WAVE_ROUNDING * (omega * (largest[..., None] + 1.0))
        rounding = argument + self.basis.interpolation_rounding
        waves = (remainder + omega * radius[..., None] + rounding).flatten(-2)
        plain = radius + rest + self.basis.interpolation_rounding * (1.0 + largest)
        return poly, (torch.cat([waves, waves, plain], dim=-1) + dropped) * FIELD_UP

    def _linear(self, pieces: PostActivation, layer: _FieldLayer, first: Encoded) -> PreActivation:
        """Propagate ``pieces`` through a linear layer; ``first``: encoded vector, used if it is an input (F4)."""
        if self.compiled:
            return self._linear_compiled(pieces, layer, first)
        seen_inputs, rounding = layer.seen, _rounding(layer.weight.shape[0])
        radius = (pieces.size + pieces.box).mul_(rounding).add_(pieces.box)
        box = radius @ layer.absolute[seen_inputs:]
        weight = layer.weight[seen_inputs:]
        columns = (pieces.columns * pieces.slope[pieces.owner]) @ weight
        columns = torch.cat([columns, weight[pieces.new_neuron] * pieces.new_size[:, None]])
        owner = torch.cat([pieces.owner, pieces.new_owner])
        poly = pieces.poly @ weight
        if seen_inputs:
            encoded, remainder = first
            poly += encoded @ layer.weight[:seen_inputs]
            box += (remainder + rounding * (encoded.abs().sum(dim=1) + remainder)) @ layer.absolute[:seen_inputs]
        poly[:, 0] += layer.bias
        box += BIAS_ROUNDING * (layer.bias.abs() + poly[:, 0].abs())
        spread = column_sums(columns, owner, poly.shape[0])
        return PreActivation(poly, columns, owner, spread, box * FIELD_UP, pieces.failed, pieces.count)

    def _weights(self, layer: _FieldLayer) -> LayerWeights:
        """Return ``layer`` as arrays for compiled products."""
        seen_inputs, narrow = layer.seen, layer.narrow is not None
        kind = layer.lines if layer.narrow is None else layer.narrow
        lines, absolute = layer.lines.numpy(), layer.absolute.numpy()
        return LayerWeights(
            lines[:seen_inputs],
            absolute[:seen_inputs],
            lines[seen_inputs:],
            kind.numpy()[seen_inputs:],
            absolute[seen_inputs:],
            layer.bias.numpy(),
            _rounding(len(absolute)),
            NARROW_ROUNDING if narrow else 0.0,
            UNDERFLOW_COLUMNS if narrow else 0.0,
        )

    def _linear_compiled(self, pieces: PostActivation, layer: _FieldLayer, first: Encoded) -> PreActivation:
        """Return `_linear` by compiled kernels."""
        encoded, remainder = (a.contiguous() for a in first)
        (batch, m, _), n = pieces.poly.shape, layer.weight.shape[1]
        total = pieces.owner.shape[0] + pieces.new_owner.shape[0]
        poly, sums = torch.empty(batch, m, n, dtype=torch.float64), torch.empty(batch, n, dtype=torch.float64)
        columns = torch.empty(total, n, dtype=torch.float64 if layer.narrow is None else torch.float32)
        owner, box = torch.empty(total, dtype=torch.int64), torch.empty(batch, n, dtype=torch.float64)
        columns_behind = linear(
            _before(pieces, columns.dtype), encoded.numpy(), remainder.numpy(), self._weights(layer),
            layer_kernel.LayerOutput(*(a.numpy() for a in (poly, columns, owner, sums, box))),
        )  # fmt: skip
        return PreActivation(
            poly, columns[:columns_behind], owner[:columns_behind], sums, box, pieces.failed, pieces.count
        )

    def _through(
        self, pieces: PostActivation, layers: StackedLayers, last: StackedLayers, first: Encoded, grid: FitGrid
    ) -> tuple[PostActivation, PreActivation]:
        """Propagate ``pieces`` through ``layers`` with ReLU and the ``last`` layer without, by compiled kernels.

        Returns zonotopes behind both; those behind ``last`` have no columns, only their sums. ``first``: see `_linear`.
        """
        encoded, remainder = (a.contiguous() for a in first)
        (batch, m, _), n = pieces.poly.shape, int(layers.shapes[-1, 2])
        kind = torch.from_numpy(layers.columns).dtype
        rooms = batch * self.limit, batch * n
        size, spread, box, slope = torch.empty(4, batch, n, dtype=torch.float64)
        out = PostActivation(
            torch.empty(batch, m, n, dtype=torch.float64), size, spread, box, slope,
            torch.empty(batch, dtype=torch.bool), torch.empty(batch, dtype=torch.int64),
            torch.empty(rooms[0], n, dtype=kind), torch.empty(rooms[0], dtype=torch.int64),
            torch.empty(rooms[1], dtype=torch.int64), torch.empty(rooms[1], dtype=torch.int64),
            torch.empty(rooms[1], dtype=torch.float64),
        )  # fmt: skip
        count = int(last.shapes[:, 2].sum())
        poly = torch.empty(batch, m, count, dtype=torch.float64)
        sums, radius = torch.empty(2, batch, count, dtype=torch.float64)
        columns, terms = through_layers(
            _before(pieces, kind), encoded.numpy(), remainder.numpy(), layers, last, grid, self.limit,
            _before(out, kind), FieldOutputs(poly.numpy(), sums.numpy(), radius.numpy()),
        )  # fmt: skip
        out = out._replace(
            columns=out.columns[:columns], owner=out.owner[:columns], new_owner=out.new_owner[:terms],
            new_neuron=out.new_neuron[:terms], new_size=out.new_size[:terms],
        )  # fmt: skip
        return out, PreActivation(poly, out.columns[:0, :0], out.owner[:0], sums, radius, out.failed, out.count)

    def _relu(self, z: PreActivation) -> PostActivation:
        """Return zonotopes behind a ReLU of the zonotopes ``z`` (design.md, F5)."""
        rho = z.spread * FIELD_UP
        poly, box = z.poly, z.box
        spread = poly[:, 1:].abs().sum(dim=1) * FIELD_UP
        radius = spread + rho + box
        middle = poly[:, 0]
        active = middle >= radius
        open_ = ~active & (middle > -radius) & ~z.failed[:, None]
        slope = active.to(torch.float64)
        which, neuron = torch.nonzero(open_, as_tuple=True)
        p = poly[which, :, neuron]
        values = p @ self._evaluation.T
        low, high = values.amin(dim=1), values.amax(dim=1)
        slack = CHEBYSHEV_ROUNDING * p.abs().sum(dim=1)
        centre, half = 0.5 * (low + high), 0.5 * (high - low) * self.basis.norming + slack
        low, high = centre - half, centre + half
        e, r = rho[which, neuron], box[which, neuron]
        now_active = low >= e + r
        slope[which, neuron] = now_active.to(torch.float64)
        # one look at the device for all of them
        kink = torch.nonzero(~now_active & ~(high <= -(e + r)))[:, 0]
        which, neuron, p, values, low, high, e, r, slack = (
            a[kink] for a in (which, neuron, p, values, low, high, e, r, slack)
        )
        # a polynomial in place of max(0, p); columns by half
        q, error = self._fitted(p, values)
        error = (error + 0.5 * e + 2.0 * slack) * FIELD_UP
        # or a line through the whole range
        bottom, top = (low - e - r), (high + e + r)
        line = (top / (top - bottom)).clamp(min=LEAST_SLOPE)
        line_error = (0.5 * line * -bottom + 4.0 * slack) * FIELD_UP
        use_line = line_error + line * r < error + r
        q = torch.where(use_line[:, None], p * line[:, None], q)
        q[:, 0] += torch.where(use_line, 0.5 * line * -bottom, 0.0)
        relu_slope = torch.where(use_line, line, 0.5)
        error = torch.where(use_line, line_error, error)
        # the new polynomial's and the slopes' own rounding
        error = error + RELU_ROUNDING * (q.abs().sum(dim=1) + e)
        box = box * slope
        box[which, neuron] = r * torch.where(use_line, line, 1.0)
        poly = poly * slope[:, None]
        poly[which, :, neuron] = q
        slope[which, neuron] = relu_slope
        size = (middle.abs() + spread + rho) * slope
        size[which, neuron] = q.abs().sum(dim=1) + relu_slope * e + error
        size *= FIELD_UP
        box *= FIELD_UP
        spread = rho * slope
        spread[which, neuron] += error
        spread *= FIELD_UP
        count = z.count.index_add(0, which, torch.ones_like(which))
        failed = z.failed | (count > self.limit) | ~torch.isfinite(size).all(dim=1)
        columns, owner = z.columns, z.owner
        if bool((failed & ~z.failed).any()):
            stays = ~failed[owner]
            columns, owner = columns[stays], owner[stays]
            stays = ~failed[which]
            which, neuron, error = which[stays], neuron[stays], error[stays]
            poly[failed], box[failed], size[failed], spread[failed] = 0.0, 0.0, 0.0, 0.0
        return PostActivation(poly, size, spread, box, slope, failed, count, columns, owner, which, neuron, error)

    def _fitted(self, p: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
        """Polynomials q [k, m] and errors [k]: ``|max(0, p) - q| <= error`` over the cell (design.md, F5)."""
        positive = values.clamp(min=0.0)
        q = positive @ self._fit.T
        fitted = q @ self._evaluation.T
        below = q.abs() @ self._chord
        above = (p - q).abs() @ self._chord
        # max(0, p) - q is the larger of p - q and -q, and each lies near its multilinear interpolant
        most = (positive - fitted).amax(dim=1) + torch.maximum(above, below)
        least = torch.maximum(
            self._least(values - fitted) - above[:, None], self._least(-fitted) - below[:, None]
        ).amin(dim=1)
        shift = 0.5 * (most + least)
        error = 0.5 * (most - least) + CHEBYSHEV_ROUNDING * (q.abs().sum(dim=1) + p.abs().sum(dim=1))
        q[:, 0] += shift
        return q, error

    def _least(self, values: Tensor) -> Tensor:
        """Return the [k, cells] least of ``values`` [k, g] at the corners of every interval (or box) of the grid."""
        side, d = self.basis.grid + 1, self.basis.dimensions
        if d == 0:
            return values
        grid = values.reshape(-1, *(side,) * d)
        for axis in range(1, d + 1):
            grid = torch.minimum(grid.narrow(axis, 0, side - 1), grid.narrow(axis, 1, side - 1))
        return grid.flatten(1)

    def base(self, poly: Tensor, remainder: Tensor) -> tuple[PostActivation, PreActivation]:
        """Return zonotopes of the base network's and of the density's outputs, from an encoded position (`encode`).

        The latter is before softplus, one output, and without columns.
        """
        first, pieces = (poly, remainder), self._nothing(poly)
        if self._grid is not None:
            *before, (layers, last) = self._base_stacks
            for early, none in before:
                pieces, _ = self._through(pieces, early, none, first, self._grid)
            return self._through(pieces, layers, last, first, self._grid)
        for layer in self._base:
            pieces = self._relu(self._linear(pieces, layer, first))
        density = self._linear(pieces, self._density, first)
        return pieces, density.without_columns(torch.arange(len(poly), device=self.device))

    @cached_property
    def _base_stacks(self) -> list[tuple[StackedLayers, StackedLayers]]:
        """Base layers, stacked by type of columns, each stack with the layer behind it: density's, or none."""
        layers = [self._weights(layer) for layer in self._base]
        parts = [stacked(list(group)) for _, group in itertools.groupby(layers, key=lambda layer: layer.columns.dtype)]
        last = stacked([self._weights(self._density)])
        return [(part, part.none()) for part in parts[:-1]] + [(parts[-1], last)]

    @cached_property
    def _head_stacks(self) -> tuple[StackedLayers, StackedLayers]:
        """Stacks of the head's layers, and of the colour layer alone."""
        return stacked([self._weights(layer) for layer in self._head]), stacked([self._weights(self._color)])

    def _nothing(self, poly: Tensor) -> PostActivation:
        """Return a `PostActivation` of B pieces without neurons, as many pieces as ``poly`` [B, m, k] has."""
        none = poly[:, 0, :0]
        index = torch.zeros(0, dtype=torch.int64, device=self.device)
        failed = torch.zeros(len(poly), dtype=torch.bool, device=self.device)
        return PostActivation(
            poly[..., :0].contiguous(), none, none, none, none, failed, failed.to(torch.int64), none[:0], index, index,
            index, poly.new_zeros(0),
        )  # fmt: skip

    def color(self, pieces: PostActivation, poly: Tensor, remainder: Tensor) -> PreActivation:
        """Return zonotopes, without columns, of RGB before the sigmoid, from base outputs and an encoded direction."""
        first = poly, remainder
        if self._grid is not None:
            return self._through(pieces, *self._head_stacks, first, self._grid)[1]
        for layer in self._head:
            pieces = self._relu(self._linear(pieces, layer, first))
        return self._linear(pieces, self._color, first).without_columns(torch.arange(len(poly), device=self.device))
