"""Linear sets of images, and output bounds over them (docs/dev/design.md, N)."""

from __future__ import annotations

from dataclasses import dataclass

from ns_abstract.verify.network.coefficients import Float64


@dataclass(frozen=True)
class ImageSets:
    """``m`` linear sets of the network's input, flattened to ``n = prod(input_shape)`` numbers.

    For every p in [-1, 1]^d the images x(p) of cell k obey both
    ``a_lower[k] p + b_lower[k] <= x(p) <= a_upper[k] p + b_upper[k]`` and ``lower[k] <= x(p) <= upper[k]``;
    the arrays contain whatever rounding produced the images.

    Attributes:
        a_lower, a_upper: [m, n, d] float64.
        b_lower, b_upper, lower, upper: [m, n] float64.
    """

    a_lower: Float64
    b_lower: Float64
    a_upper: Float64
    b_upper: Float64
    lower: Float64
    upper: Float64

    def __post_init__(self) -> None:
        m, n, d = self.a_lower.shape
        for name in ("a_upper", "b_lower", "b_upper", "lower", "upper"):
            shape = (m, n, d) if name.startswith("a") else (m, n)
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} {shape} expected, got {getattr(self, name).shape}")

    @property
    def count(self) -> int:
        """Number of cells m."""
        return self.a_lower.shape[0]

    @property
    def dimensions(self) -> int:
        """Number of parameters d."""
        return self.a_lower.shape[2]

    def __getitem__(self, cells: slice) -> ImageSets:
        return ImageSets(*(getattr(self, name)[cells] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class OutputBounds:
    """Lower bounds of ``rows @ y + offset``; minus infinity where none is known, never NaN.

    Attributes:
        lower: [m, k] for every p of the cell.
        a, b: [m, k, d], [m, k]: ``a p + b`` is a lower bound at p.
    """

    lower: Float64
    a: Float64
    b: Float64
