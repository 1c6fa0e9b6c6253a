"""Bounds of a field over curves of points: Chebyshev zonotopes through its layers (design.md, F3-F6).

A batch of B pieces, each a curve (or patch) of points over its own cell of poses ``p in [-1, 1]^d``, is kept as

    h_j(p) = sum_k c_kj T_k(p) + sum_i g_ij e_i + s_j,   |e_i| <= 1,  |s_j| <= r_j

for every neuron j: polynomials of the pose, shared error terms ("columns") and a box. A linear layer is exact on
all three; a ReLU whose sign is open over the cell is replaced by a polynomial of the pose fitted to it, and its
error becomes a column of its own. All columns of a batch stand in one matrix, so pieces with many error terms do
not make the others wait. All arithmetic is float64 and its rounding is charged to the box.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numba import njit
from torch import Tensor

from ns_abstract.arithmetic.chebyshev import ChebyshevBasis
from ns_abstract.arithmetic.rounding import CHEBYSHEV_ROUNDING, FIELD_UP, UNIT64, gamma
from ns_abstract.methods.nerf.relu_kernel import Grid, relu
from ns_abstract.methods.nerf.scene import Encoding, FieldWeights, Layer

#: Radii of Bernstein ellipses that are tried for the remainder of an encoding.
_ELLIPSES = (1.05, 1.15, 1.3, 1.6, 2.0, 2.6, 3.5, 5.0, 8.0, 14.0, 30.0, 80.0, 300.0)


def _rounding(inputs: int) -> float:
    """Relative error of a layer of ``inputs``: of this module's sums, and of a concrete float64 evaluation."""
    return 2.0 * gamma(inputs + 4)


@njit(cache=True, error_model="numpy")
def _sum_by_owner(columns, owner, out):
    """``out[owner[c]] += |columns[c]|``."""
    for c in range(columns.shape[0]):
        b = owner[c]
        for j in range(columns.shape[1]):
            out[b, j] += abs(columns[c, j])


@njit(cache=True, error_model="numpy")
def _scale_by_owner(columns, owner, slope):
    """``columns[c] *= slope[owner[c]]``."""
    for c in range(columns.shape[0]):
        b = owner[c]
        for j in range(columns.shape[1]):
            columns[c, j] *= slope[b, j]


def column_sums(columns: Tensor, owner: Tensor, pieces: int) -> Tensor:
    """[pieces, n] sums of absolute columns [C, n] by owner [C]."""
    out = torch.zeros(pieces, columns.shape[1], dtype=columns.dtype, device=columns.device)
    if columns.device.type == "cpu":
        _sum_by_owner(columns.numpy(), owner.numpy(), out.numpy())
    else:
        out.index_add_(0, owner, columns.abs())
    return out


def scale_columns(columns: Tensor, owner: Tensor, slope: Tensor) -> None:
    """Multiply columns [C, n] in place by ``slope`` [pieces, n] of their owners."""
    if columns.device.type == "cpu":
        _scale_by_owner(columns.numpy(), owner.numpy(), slope.numpy())
    else:
        columns.mul_(slope[owner])


@dataclass
class Pieces:
    """A batch after some layer.

    Attributes:
        poly: [B, m, n] Chebyshev coefficients.
        columns, owner: [C, n] error terms and the piece [C] that each belongs to.
        new_owner, new_neuron, new_size: [N] error terms that move one neuron only, not yet in ``columns``.
        box: [B, n] radius of the rest.
        size: [B, n] sum of the absolute coefficients and columns.
        failed: [B] whether the piece was given up: its other values mean nothing.
        count: [B] error terms.
    """

    poly: Tensor
    columns: Tensor
    owner: Tensor
    new_owner: Tensor
    new_neuron: Tensor
    new_size: Tensor
    box: Tensor
    size: Tensor
    failed: Tensor
    count: Tensor

    def select(self, which: Tensor) -> Pieces:
        """The pieces ``which`` [k] (indices)."""
        place = torch.full_like(self.failed, -1, dtype=torch.int64)
        place[which] = torch.arange(which.numel(), device=which.device)
        kept, new = place[self.owner] >= 0, place[self.new_owner] >= 0
        return Pieces(
            self.poly[which],
            self.columns[kept],
            place[self.owner[kept]],
            place[self.new_owner[new]],
            self.new_neuron[new],
            self.new_size[new],
            self.box[which],
            self.size[which],
            self.failed[which],
            self.count[which],
        )


@dataclass
class Affine:
    """A batch before an activation: as in `Pieces`, with all error terms in ``columns``."""

    poly: Tensor
    columns: Tensor
    owner: Tensor
    box: Tensor
    failed: Tensor
    count: Tensor

    @property
    def radius(self) -> Tensor:
        """[B, n] columns and box together."""
        return (column_sums(self.columns, self.owner, self.poly.shape[0]) + self.box) * FIELD_UP


class FieldBounds:
    """Bounds of one field.

    Args:
        weights: The field.
        basis: Polynomials of the pose.
        limit: Error terms by piece beyond which it is given up.
        device: Where the work is done.
    """

    def __init__(
        self, weights: FieldWeights, basis: ChebyshevBasis, limit: int = 400, device: torch.device | str = "cpu"
    ) -> None:
        self.weights, self.basis, self.limit, self.device = weights, basis, limit, torch.device(device)
        self._base = [self._put(layer) for layer in weights.base]
        self._head = [self._put(layer) for layer in weights.head]
        self._density, self._color = self._put(weights.density), self._put(weights.color)
        kept, rest = (torch.from_numpy(a).to(device) for a in basis.interpolation)
        self._kept, self._rest = kept, rest
        self._evaluation = torch.from_numpy(basis.evaluation).to(device)
        self._fit = torch.from_numpy(np.ascontiguousarray(basis.fit)).to(device)
        self._chord = torch.from_numpy(basis.chord).to(device)
        self._compiled = self.device.type == "cpu" and basis.dimensions == 1 and basis.grid % 2 == 0
        middle = basis.grid // 2 + 1
        halves = (basis.evaluation.T[:, :middle], basis.fit[0::2, :middle].T, basis.fit[1::2, :middle].T)
        half, fit_even, fit_odd = map(np.ascontiguousarray, halves)
        self._halves = half, fit_even, fit_odd
        degrees = torch.from_numpy(basis.indices).to(device, torch.float64)
        ellipses = torch.tensor(_ELLIPSES, dtype=torch.float64, device=device)
        # [ellipses, d, m]: bound of |Im T_k| on the ellipse of one variable, rounded up
        self._imaginary = (0.5 * (ellipses[:, None, None] ** degrees.T - ellipses[:, None, None] ** -degrees.T)) * (
            1.0 + 2.0**-30
        )
        self._decay = 4.0 * ellipses**-basis.degree / (ellipses - 1.0) * (1.0 + 2.0**-30)

    def _put(self, layer: Layer) -> tuple[Tensor, Tensor, Tensor]:
        """Transposed weight [in, out], its absolute value, bias [out]."""
        weight = torch.from_numpy(layer.weight).to(self.device, torch.float64).T.contiguous()
        return weight, weight.abs(), torch.from_numpy(layer.bias).to(self.device, torch.float64)

    # --- encodings -----------------------------------------------------------------------------

    def encode(self, nodes: Tensor, radius: Tensor, encoding: Encoding) -> tuple[Tensor, Tensor]:
        """Polynomials and remainders of an encoded vector (design.md, F3).

        Args:
            nodes: [B, nodes, 3] the vector's polynomial at the basis' nodes. Its degree by variable is at most
                the basis'.
            radius: [B, 3] distance of the vector from the polynomial.
            encoding: Its frequencies.

        Returns:
            [B, m, size] coefficients, [B, size] remainders.
        """
        omega = 2.0 * np.pi * torch.from_numpy(encoding.frequencies).to(self.device)
        angles = (nodes[..., None] * omega).flatten(-2)
        values = torch.cat([torch.sin(angles), torch.cos(angles), nodes], dim=-1)
        poly = torch.matmul(self._kept, values)
        dropped = torch.matmul(self._rest, values).abs().sum(dim=1) if self._rest.shape[0] else 0.0
        x = poly[..., -3:]
        rest = torch.matmul(self._rest, nodes).abs().sum(dim=1) if self._rest.shape[0] else torch.zeros_like(radius)
        lebesgue = self.basis.lebesgue
        remainder = torch.zeros_like(radius)[..., None].expand(-1, -1, omega.numel())
        for j in range(self.basis.dimensions):
            # the parts of x above the degree belong to the highest power that the basis has
            tops = self._imaginary[:, j].max(dim=1).values
            phase = torch.einsum("em,bmi->bie", self._imaginary[:, j], x.abs()) + rest[..., None] * tops
            exponent = omega[:, None] * (phase * (1.0 + 2.0**-30) + 2.0**-40)[..., None, :]
            growth = torch.where(exponent < 600.0, torch.cosh(exponent.clamp(max=600.0)), torch.inf)
            error = (growth * self._decay).amin(dim=-1).clamp(max=1.0 + lebesgue)
            remainder = remainder + lebesgue**j * error
        # the vector's own radius; the argument's and the functions' rounding, seen through the interpolation
        largest = nodes.abs().amax(dim=1)
        rounding = lebesgue**self.basis.dimensions * (16.0 * UNIT64 * (omega * (largest[..., None] + 1.0)) + 2.0**-44)
        waves = (remainder + omega * radius[..., None] + rounding).flatten(-2)
        plain = radius + rest + 2.0**-44 * (1.0 + largest) * lebesgue**self.basis.dimensions
        return poly, (torch.cat([waves, waves, plain], dim=-1) + dropped) * FIELD_UP

    # --- layers --------------------------------------------------------------------------------

    def _linear(
        self, pieces: Pieces, layer: tuple[Tensor, Tensor, Tensor], first: tuple[Tensor, Tensor] | None = None
    ) -> Affine:
        """A linear layer on ``pieces``, after ``first`` (polynomials, remainders) in the order of its inputs (F4)."""
        weight, absolute, bias = layer
        count = 0 if first is None else first[0].shape[-1]
        rounding = _rounding(weight.shape[0])
        right, right_absolute = weight[count:], absolute[count:]
        poly = pieces.poly @ right
        radius = pieces.box + rounding * (pieces.size + pieces.box)
        box = radius @ right_absolute
        if first is not None:
            poly += first[0] @ weight[:count]
            box += (first[1] + rounding * (first[0].abs().sum(dim=1) + first[1])) @ absolute[:count]
        poly[:, 0] += bias
        box += 4.0 * UNIT64 * (bias.abs() + poly[:, 0].abs())
        moved = right[pieces.new_neuron] * pieces.new_size[:, None]
        columns = torch.cat([pieces.columns @ right, moved]) if pieces.columns.shape[0] else moved
        owner = torch.cat([pieces.owner, pieces.new_owner])
        return Affine(poly, columns, owner, box * FIELD_UP, pieces.failed, pieces.count)

    def _first(self, poly: Tensor, remainder: Tensor, layer: tuple[Tensor, Tensor, Tensor]) -> Affine:
        """A linear layer on polynomials and remainders alone."""
        weight, absolute, bias = layer
        out = poly @ weight
        box = (remainder + _rounding(weight.shape[0]) * (poly.abs().sum(dim=1) + remainder)) @ absolute
        out[:, 0] += bias
        box += 4.0 * UNIT64 * (bias.abs() + out[:, 0].abs())
        pieces = poly.shape[0]
        return Affine(
            out,
            torch.zeros(0, weight.shape[1], dtype=torch.float64, device=self.device),
            torch.zeros(0, dtype=torch.int64, device=self.device),
            box * FIELD_UP,
            torch.zeros(pieces, dtype=torch.bool, device=self.device),
            torch.zeros(pieces, dtype=torch.int64, device=self.device),
        )

    def _relu(self, z: Affine) -> Pieces:
        """max(0, z) (design.md, F5)."""
        rho = column_sums(z.columns, z.owner, z.poly.shape[0]) * FIELD_UP
        found = self._relu_compiled(z, rho) if self._compiled else self._relu_torch(z, rho)
        poly, box, size, slope, which, neuron, error = found
        columns, owner = z.columns, z.owner
        scale_columns(columns, owner, slope)
        count = z.count.index_add(0, which, torch.ones_like(which))
        failed = z.failed | (count > self.limit) | ~torch.isfinite(size).all(dim=1)
        if bool((failed & ~z.failed).any()):
            stays = ~failed[owner]
            columns, owner = columns[stays], owner[stays]
            stays = ~failed[which]
            which, neuron, error = which[stays], neuron[stays], error[stays]
            poly[failed], box[failed], size[failed] = 0.0, 0.0, 0.0
        return Pieces(poly, columns, owner, which, neuron, error, box, size, failed, count)

    def _relu_compiled(self, z: Affine, rho: Tensor) -> tuple[Tensor, ...]:
        """See `_relu_torch`; ``z`` is used up."""
        pieces, _, n = z.poly.shape
        slope, size = torch.empty(2, pieces, n, dtype=torch.float64)
        places = torch.empty(2, pieces * n, dtype=torch.int64)
        error = torch.empty(pieces * n, dtype=torch.float64)
        poly, grid = z.poly.contiguous(), Grid(*self._halves, self._chord.numpy(), self.basis.norming)
        found = relu(
            poly.numpy(), rho.numpy(), z.box.numpy(), z.failed.numpy(), grid, slope.numpy(), size.numpy(),
            places[0].numpy(), places[1].numpy(), error.numpy(),
        )  # fmt: skip
        return poly, z.box, size, slope, places[0, :found], places[1, :found], error[:found]

    def _relu_torch(self, z: Affine, rho: Tensor) -> tuple[Tensor, ...]:
        """New polynomials, box and sizes, slopes of the columns, and piece, neuron and size of new error terms."""
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
        slope[which[now_active], neuron[now_active]] = 1.0
        kink = ~now_active & ~(high <= -(e + r))
        which, neuron, p, values, low, high, e, r, slack = (
            a[kink] for a in (which, neuron, p, values, low, high, e, r, slack)
        )
        # a polynomial in place of max(0, p); columns by half
        q, error = self._fitted(p, values)
        error = (error + 0.5 * e + 2.0 * slack) * FIELD_UP
        # or a line through the whole range
        bottom, top = (low - e - r), (high + e + r)
        line = top / (top - bottom)
        line_error = (0.5 * line * -bottom + 4.0 * slack) * FIELD_UP
        use_line = line_error + line * r < error + r
        q = torch.where(use_line[:, None], p * line[:, None], q)
        q[:, 0] += torch.where(use_line, 0.5 * line * -bottom, 0.0)
        kept = torch.where(use_line, line, 0.5)
        error = torch.where(use_line, line_error, error)
        # the new polynomial's and the slopes' own rounding
        error = error + 8.0 * UNIT64 * (q.abs().sum(dim=1) + e)
        box = box * slope
        box[which, neuron] = r * torch.where(use_line, line, 1.0)
        poly = poly * slope[:, None]
        poly[which, :, neuron] = q
        slope[which, neuron] = kept
        size = (middle.abs() + spread + rho) * slope
        size[which, neuron] = q.abs().sum(dim=1) + kept * e + error
        return poly, box * FIELD_UP, size * FIELD_UP, slope, which, neuron, error

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
        """Least value at the corners of every interval (rectangle, ...) of the grid: [k, cells] of [k, g]."""
        side, d = self.basis.grid + 1, self.basis.dimensions
        if d == 0:
            return values
        grid = values.reshape(-1, *(side,) * d)
        for axis in range(1, d + 1):
            grid = torch.minimum(grid.narrow(axis, 0, side - 1), grid.narrow(axis, 1, side - 1))
        return grid.flatten(1)

    # --- networks ------------------------------------------------------------------------------

    def base(self, poly: Tensor, remainder: Tensor) -> Pieces:
        """The base network on an encoded position (`encode`)."""
        pieces = self._relu(self._first(poly, remainder, self._base[0]))
        for layer, tensors in zip(self.weights.base[1:], self._base[1:], strict=True):
            pieces = self._relu(self._linear(pieces, tensors, (poly, remainder) if layer.skip else None))
        return pieces

    def density(self, pieces: Pieces) -> Affine:
        """The density before its softplus, one output."""
        return self._linear(pieces, self._density)

    def color(self, pieces: Pieces, poly: Tensor, remainder: Tensor) -> Affine:
        """The colour before its sigmoid, three outputs, from an encoded direction."""
        pieces = self._relu(self._linear(pieces, self._head[0], (poly, remainder)))
        for tensors in self._head[1:]:
            pieces = self._relu(self._linear(pieces, tensors))
        return self._linear(pieces, self._color)
