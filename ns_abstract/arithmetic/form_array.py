"""Arrays of forms with the operators of numpy."""

from __future__ import annotations

from typing import Any

import numpy as np

from ns_abstract.arithmetic.forms import (
    Basis,
    Float64Array,
    bounds,
    compose,
    multiply,
    negate,
    reciprocal,
    reciprocal_square_root,
    scale_add,
    set_norms,
    square,
    square_root,
)


class FormArray:
    """An array of forms over one box, with numpy-like operators.

    ``data`` is [basis.rows, n] with n the product of ``shape``. Operators return new arrays;
    numbers and numpy arrays (exact constants) mix with forms by broadcasting.
    """

    #: numpy arrays on the left of an operator leave it to this class
    __array_ufunc__ = None

    def __init__(self, basis: Basis, data: Float64Array, shape: tuple[int, ...]) -> None:
        self.basis = basis
        self.data = data
        self.shape = shape

    @classmethod
    def constant(cls, basis: Basis, values: Float64Array | float, radius: Float64Array | float = 0.0) -> FormArray:
        """Return constant forms of the numbers ``values``, each with a ``radius`` around its number."""
        values = np.asarray(values, dtype=np.float64)
        data = np.zeros((basis.rows, values.size))
        data[0] = values.ravel()
        if np.ndim(radius) or radius != 0.0:
            data[basis.monomials].reshape(values.shape)[...] = radius
        return cls(basis, data, values.shape)

    @classmethod
    def parameter(cls, basis: Basis, index: int, middle: float = 0.0, half_width: float = 1.0) -> FormArray:
        """Return the scalar form ``middle + half_width * p_index``."""
        form = cls.constant(basis, middle)
        form.data[1 + index] = half_width
        set_norms(form.data, *form._layout)
        return form

    @property
    def _layout(self) -> tuple[int, int, int]:
        return self.basis.dimensions, self.basis.order, self.basis.monomials

    @property
    def center(self) -> Float64Array:
        """Values at the middle of the box (the polynomial's constant term)."""
        return self.data[0].reshape(self.shape)

    @property
    def radius(self) -> Float64Array:
        """Radius of each form: a bound of its non-polynomial part."""
        return self.data[self.basis.monomials].reshape(self.shape)

    @property
    def linear(self) -> Float64Array:
        """Linear coefficients, [d, *shape]."""
        return self.data[1 : 1 + self.basis.dimensions].reshape(-1, *self.shape)

    def bounds(self) -> tuple[Float64Array, Float64Array]:
        """Lower and upper bounds over the box, rounded outward."""
        low = np.empty(self.data.shape[1])
        high = np.empty(self.data.shape[1])
        bounds(self.data, low, high, *self._layout)
        return low.reshape(self.shape), high.reshape(self.shape)

    def _lift(self, other: FormArray | Float64Array | float) -> FormArray:
        return other if isinstance(other, FormArray) else FormArray.constant(self.basis, other)

    def broadcast_to(self, shape: tuple[int, ...]) -> FormArray:
        """Return the forms repeated to ``shape``."""
        if shape == self.shape:
            return self
        rows = self.basis.rows
        padded = (rows, *(1,) * (len(shape) - len(self.shape)), *self.shape)
        data = np.empty((rows, *shape))
        data[...] = self.data.reshape(padded)
        return FormArray(self.basis, data.reshape(rows, -1), shape)

    def _pair(self, other: FormArray | Float64Array | float) -> tuple[FormArray, FormArray]:
        other = self._lift(other)
        if other.shape == self.shape:
            return self, other
        shape = np.broadcast_shapes(self.shape, other.shape)
        return self.broadcast_to(shape), other.broadcast_to(shape)

    def _combine(self, s: float, other: FormArray | Float64Array | float, t: float) -> FormArray:
        a, b = self._pair(other)
        out = np.empty_like(a.data)
        scale_add(a.data, s, b.data, t, 0.0, out, *self._layout)
        return FormArray(self.basis, out, a.shape)

    def __add__(self, other: FormArray | Float64Array | float) -> FormArray:
        return self._combine(1.0, other, 1.0)

    def __sub__(self, other: FormArray | Float64Array | float) -> FormArray:
        return self._combine(1.0, other, -1.0)

    def __neg__(self) -> FormArray:
        out = self.data.copy()
        negate(out, self.basis.monomials)
        return FormArray(self.basis, out, self.shape)

    __radd__ = __add__

    def __rsub__(self, other: Float64Array | float) -> FormArray:
        return (-self) + other

    def __mul__(self, other: FormArray | Float64Array | float) -> FormArray:
        a, b = self._pair(other)
        out = np.empty_like(a.data)
        multiply(a.data, b.data, out, *self._layout)
        return FormArray(self.basis, out, a.shape)

    __rmul__ = __mul__

    def __getitem__(self, index: Any) -> FormArray:
        rows = self.basis.rows
        data = self.data.reshape(rows, *self.shape)[(slice(None), *(index if isinstance(index, tuple) else (index,)))]
        return FormArray(self.basis, np.ascontiguousarray(data.reshape(rows, -1)), data.shape[1:])

    def sum(self, axis: int) -> FormArray:
        """Return the sum over one axis, one addition at a time."""
        parts = [self[(slice(None),) * axis + (i,)] for i in range(self.shape[axis])]
        total = parts[0]
        for part in parts[1:]:
            total = total + part
        return total

    def flipped(self, signs: Float64Array) -> FormArray:
        """Return the forms times ``signs`` (1 or -1, broadcast against ``shape``), without rounding."""
        data = self.data.copy()
        data[: self.basis.monomials].reshape(-1, *self.shape)[...] *= signs
        return FormArray(self.basis, data, self.shape)

    def transpose(self) -> FormArray:
        """Return the matrix transpose of a two-dimensional array."""
        rows = self.basis.rows
        data = self.data.reshape(rows, *self.shape).swapaxes(1, 2)
        return FormArray(self.basis, np.ascontiguousarray(data).reshape(rows, -1), self.shape[::-1])

    def __matmul__(self, other: FormArray | Float64Array) -> FormArray:
        other = self._lift(other)
        n, k = self.shape
        if len(other.shape) == 1:
            return (self * FormArray(self.basis, other.data, (1, k)).broadcast_to((n, k))).sum(1)
        left = FormArray(self.basis, self.data, (n, k, 1))
        right = FormArray(self.basis, other.data, (1, k, other.shape[1]))
        return (left * right).sum(1)

    def __rmatmul__(self, other: Float64Array) -> FormArray:
        return self._lift(other) @ self

    def _unary(self, kernel) -> FormArray:
        out = np.empty_like(self.data)
        kernel(self.data, np.empty((5, out.shape[1])), out, *self._layout)
        return FormArray(self.basis, out, self.shape)

    def square(self) -> FormArray:
        """Return the element-wise square."""
        out = np.empty_like(self.data)
        square(self.data, out, *self._layout)
        return FormArray(self.basis, out, self.shape)

    def reciprocal(self) -> FormArray:
        """Return the element-wise ``1 / x``; its radius is not finite unless ``x`` is in `forms.reciprocal`'s range."""
        return self._unary(reciprocal)

    def sqrt(self) -> FormArray:
        """Return the element-wise square root; the radius is not finite where ``x`` may be 0 or below."""
        return self._unary(square_root)

    def rsqrt(self) -> FormArray:
        """Return the element-wise ``1 / sqrt(x)``; the radius is not finite where ``x`` may be 0 or below."""
        return self._unary(reciprocal_square_root)

    def compose(self, f0, f1, f2_low, f2_high, f3) -> FormArray:
        """Return the element-wise ``f(x)`` by the kernel `compose`, whose f0 to f3 are broadcast against ``shape``."""
        values = np.empty((5, *self.shape))
        for row, value in enumerate((f0, f1, f2_low, f2_high, f3)):
            values[row] = value
        out = np.empty_like(self.data)
        # one array per value
        compose(self.data, *values.reshape(5, -1), out, *self._layout)  # pyright: ignore[reportCallIssue]
        return FormArray(self.basis, out, self.shape)
