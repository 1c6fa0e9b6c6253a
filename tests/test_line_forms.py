"""Forms of one parameter in registers: the rules of the array kernels, exactly enclosed and no looser."""

from __future__ import annotations

import numpy as np
import pytest
from oracle import between, escapes, points, random_forms, rational, value, weights
from test_forms import BINARY, LANES, POSITIVE, SIZES, layout

from ns_abstract.arithmetic import line_forms
from ns_abstract.arithmetic.form_array import FormArray
from ns_abstract.arithmetic.forms import Basis, clamp_below, set_norms

BASIS = Basis(1, 2)


def lanes(function, *operands: FormArray, numbers: tuple[np.ndarray, ...] = ()) -> FormArray:
    """``function`` lane by lane; ``numbers`` are further arguments, [lanes] each."""
    data = np.zeros_like(operands[0].data)
    for lane in range(data.shape[1]):
        forms = [line_forms.LineForm(*map(float, form.data[:4, lane])) for form in operands]
        data[:4, lane] = function(*forms, *(float(n[lane]) for n in numbers))
    set_norms(data, *layout(BASIS))
    return FormArray(BASIS, data, operands[0].shape)


def forms(seed: int, size: str, **options) -> FormArray:
    return random_forms(BASIS, LANES, np.random.default_rng([seed, len(size)]), **SIZES[size], **options)


def same(found: FormArray, kernel: FormArray) -> bool:
    """The same polynomial up to rounding, and a radius that is hardly larger."""
    scale = np.abs(kernel.data[:3]).sum(axis=0)
    with np.errstate(invalid="ignore"):
        polynomial = np.abs(found.data[:3] - kernel.data[:3]) <= 4.0 * np.finfo(float).eps * scale
    finite = np.isfinite(kernel.radius)
    return bool(
        polynomial[:, finite].all()
        and (found.radius[finite] <= kernel.radius[finite] * (1.0 + 1e-10) + 1e-15 * scale[finite]).all()
        and np.array_equal(finite, np.isfinite(found.radius))
    )


PAIRS = {
    "multiplied": (line_forms.multiplied, *BINARY["mul"]),
    "combined": (
        lambda a, b: line_forms.combined(a, 0.1, b, -0.7),
        lambda a, b: a * 0.1 - b * 0.7,
        lambda x, y: rational(0.1) * x + rational(-0.7) * y,
    ),
    "scaled": (lambda a, b: line_forms.scaled(a, -0.3), lambda a, b: a * -0.3, lambda x, y: rational(-0.3) * x),
}
SINGLE = {
    "inverse": (line_forms.inverse, *POSITIVE["reciprocal"]),
    "inverse_root": (line_forms.inverse_root, *POSITIVE["rsqrt"]),
}


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", PAIRS)
def test_pairs(name, size):
    a, b = forms(1, size), forms(2, size)
    line, kernel, exact = PAIRS[name]
    result = lanes(line, a, b)
    assert escapes(result, exact, [a, b], np.random.default_rng(3), 4) == []
    assert same(result, kernel(a, b))


@pytest.mark.slow_cases(every=3)
@pytest.mark.parametrize("size", ["plain", "exact", "narrow", "constant", "uncertain"])
@pytest.mark.parametrize("name", SINGLE)
def test_functions(name, size):
    a = forms(4, size, positive=True)
    line, kernel, exact = SINGLE[name]
    result = lanes(line, a)
    assert np.isfinite(result.radius).all()
    assert escapes(result, exact, [a], np.random.default_rng(5), 4) == []
    assert same(result, kernel(a))


@pytest.mark.parametrize("name", SINGLE)
def test_domain(name):
    """What may be 0 or below, too small, too large or is no number has no finite answer, nor has what comes of it."""
    a = FormArray.constant(BASIS, np.array([0.0, -1.0, 1.0, -1e-300, 1.0, np.nan, 1e-80, 1e80, 1.0]))
    a.data[3, 2], a.data[3, 4], a.data[1, 8] = 1.0, np.inf, 1.0
    set_norms(a.data, *layout(BASIS))
    result = lanes(SINGLE[name][0], a)
    assert not np.isfinite(result.radius).any()
    twice = lanes(lambda x: line_forms.combined(x, 1.0, x, 1.0), result)
    for later in (lanes(line_forms.multiplied, result, a), twice):
        assert not np.isfinite(later.radius).any()


@pytest.mark.parametrize("size", [size for size in SIZES if size not in ("denormal", "tiny")])
def test_ends(size):
    generator = np.random.default_rng(6)
    a = forms(7, size)
    # vertices inside the box, on its border, and just outside
    a.data[1, ::3] = 2.0 * a.data[2, ::3]
    a.data[1, 1::3] = 0.0
    set_norms(a.data, *layout(BASIS))
    low, high = a.bounds()
    for lane in range(LANES):
        bottom, top = line_forms.ends(line_forms.LineForm(*map(float, a.data[:4, lane])))
        for point in points(1, 6, generator):
            for weight in weights(3, generator):
                assert between(bottom, top, lambda: value(a, lane, point, weight))  # noqa: B023
        slack = 1e-14 * (abs(bottom) + abs(top))
        assert bottom >= low[lane] - slack and top <= high[lane] + slack


@pytest.mark.parametrize("floor", [0.0, -0.3, 0.7])
@pytest.mark.parametrize("size", ["plain", "exact", "constant", "uncertain"])
def test_raised(size, floor):
    a = forms(8, size)
    a.data[0, 0] = floor
    low, high = a.bounds()
    result = lanes(lambda x, bottom, top: line_forms.raised(x, floor, bottom, top), a, numbers=(low, high))
    limit = rational(floor)
    assert escapes(result, lambda x: max(x, limit), [a], np.random.default_rng(9), 5) == []
    kernel = a.data.copy()
    clamp_below(kernel, floor, low, high, *layout(BASIS))
    assert same(result, FormArray(BASIS, kernel, a.shape))


def test_raised_without_bounds():
    """Bounds that are infinite or no numbers leave nothing that can be relied on."""
    for a in (line_forms.LineForm(1.0, 1.0, 0.0, np.inf), line_forms.LineForm(1.0, np.nan, 0.0, 0.0)):
        low, high = line_forms.ends(a)
        assert not np.isfinite(sum(line_forms.raised(a, 0.5, low, high)))


def test_never_raised():
    """A floor of minus infinity stands for none."""
    a = line_forms.LineForm(1.0, 0.5, -0.25, 0.125)
    assert line_forms.raised(a, -np.inf, *line_forms.ends(a)) == a
