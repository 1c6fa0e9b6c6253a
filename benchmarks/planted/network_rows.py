"""Faults in every row of the table of networks' charges, in what reads constants, and in the caller's subnormals."""

from planted.fault import Fault

_NETWORK = "verify/network/"
_CHARGES = "arithmetic/network_charges.py"
_HOME = "test_network_charges_home.py::"
_TABLE = _HOME + "test_layers_charge_what_the_table_says"
_PAYS = _HOME + "test_every_charge_pays"
_TESTS = "test_network_charges.py::"
_SUBNORMALS = "test_network_subnormals.py::"
_ORDER = "test_network_order.py::test_networks_that_sense_their_program"


def _curve(kind: str, place: str, old: str, new: str, test: str, file: str = "activations.py") -> Fault:
    return Fault(f"charges: {kind}", _NETWORK + file, place, old, new, f"{_TABLE}[{test}]")


NETWORK_ROWS = (
    # sums, scales, maps
    Fault(
        "charges: sums lose nothing",
        _NETWORK + "rounding.py",
        "Rounding.charge",
        "gamma(count) * (peak + gamma(count + FOLDING + 1) * size) + few",
        "few",
        "test_network_rounding.py::test_sums_that_lose_as_much_as_they_can[1]",
    ),
    Fault(
        "charges: a shift loses nothing of its own",
        _NETWORK + "rounding.py",
        "Rounding.charge",
        "gamma(folding + PRODUCTS + len(inputs)) * size",
        "0.0 * size",
        _PAYS + "[scale, shift, batch normalisation]",
    ),
    Fault(
        "charges: a sum of nodes is not rounded",
        _NETWORK + "rounding.py",
        "Rounding.charge",
        "few + (torch.maximum(*charges) if len(charges) == 2 else sum(charges))",
        "0.0 * size",
        "test_network_rounding.py::test_sums_that_start_with_what_is_added",
    ),
    Fault(
        "charges: a product of values is exact",
        _NETWORK + "propagation.py",
        "ForwardPropagation.product",
        "PRODUCT * size",
        "0.0 * size",
        _PAYS + "[product of two values, matrix product]",
    ),
    Fault(
        "charges: places of resized maps are float32's",
        _NETWORK + "sparse_layers.py",
        "Resize.spare",
        "off @ sizes[0] @ (across + apart).T + own @ sizes[0] @ apart.T",
        "0.0 * (off @ sizes[0] @ (across + apart).T)",
        "test_network_operators.py::test_positions_of_resized_maps_are_charged",
    ),
    Fault(
        "charges: weights of resized maps are exact in real arithmetic",
        _CHARGES,
        "",
        "2.0 * DOUBLE_UNIT / UNIT",
        "0.0",
        _HOME + "test_cubic_weights_are_charged_in_real_arithmetic",
    ),
    Fault(
        "charges: channels that have left a window leave nothing behind",
        _NETWORK + "sparse_layers.py",
        "ChannelWindows.spare",
        "gamma(self.terms) * 2.0 * weight * left * UP",
        "0.0 * left",
        _TESTS + "test_running_sums_over_channels[3]",
    ),
    # functions of one number
    _curve("a ReLU flushes nothing", "LeakyRelu.error", "lower < FLUSH", "lower < 0.0", "ReLU-LeakyRelu", "layers.py"),
    _curve("a slope's product is exact", "LeakyRelu.error", "AFFINE * self.alpha * size", "0.0 * size",
           "leaky ReLU-LeakyRelu", "layers.py"),
    _curve("sigmoid is exact", "_Sigmoidal.error", "LIBRARY", "0.0", "sigmoid, tanh-Sigmoid"),
    _curve("a clip flushes nothing", "Clip.error", "FLUSHED * (1.0 + self.factor + _size(lower, upper))", "0.0",
           "clip-Clip"),
    _curve("hard sigmoid's line is exact", "Clip.error",
           "AFFINE * (self.factor * _size(lower, upper) + abs(self.offset))",
           "0.0", "hard sigmoid-Clip"),
    _curve("absolute values flush nothing", "Abs.error", "FLUSHED", "0.0", "absolute value-Abs"),
    _curve("hard swish is exact", "HardSwish.error", "HARD * _size(lower, upper)", "0.0", "hard swish-HardSwish"),
    _curve("a square is exact", "Power.error", "SQUARE if self.exponent == 2 else LIBRARY",
           "0.0 if self.exponent == 2 else LIBRARY", "square-Power"),
    _curve("a power is a square", "Power.error", "SQUARE if self.exponent == 2 else LIBRARY", "SQUARE",
           "power of a whole number-Power"),
    _curve("a quotient is exact", "Reciprocal.error", "QUOTIENT / torch.minimum(lower.abs(), upper.abs())",
           "0.0 * lower", "reciprocal, quotient-Reciprocal"),
    _curve("a fractional power is exact", "PositivePower.error",
           "LIBRARY * torch.maximum(lower**self.exponent, upper**self.exponent)", "0.0 * lower",
           "power of positive numbers-PositivePower0"),
    _curve("a root is exact", "Root.error", "ROOT * (lower.rsqrt() if self.inverse else upper.sqrt())", "0.0 * lower",
           "root-Root"),
    _curve("a reciprocal root is charged at its far end", "Root.error", "lower.rsqrt()", "upper.rsqrt()",
           "reciprocal root-Root"),
    _curve("an exponential has one unit", "Exp.error", "2.0 * LIBRARY * upper.exp()", "2.0**-24 * upper.exp()",
           "exponential-Exp"),
    _curve("fused attention is as good as a library", "CappedExp.error", "ATTENTION + ATTENTION_BLOCKS * self.count",
           "2.0 * LIBRARY", "softmax's exponentials-CappedExp", "composite_activations.py"),
    _curve("a logarithm is relative to itself", "Log.error",
           "1.0 + torch.maximum(lower.log().abs(), upper.log().abs())",
           "torch.maximum(lower.log().abs(), upper.log().abs())", "logarithm-Log"),
    _curve("softplus is exact", "Softplus.error", "2.0 * LIBRARY * (1.0 + _size(lower, upper))", "0.0 * upper",
           "softplus-Softplus"),
    _curve("ELU forgets alpha", "Elu.error", "self.alpha + size", "size", "ELU, SELU, CELU-Elu"),
    _curve("the error function is exact", "Erf.error", "2.0 * LIBRARY", "0.0", "error function-Erf"),
    _curve("a gate is one function", "_Gated.error", "4.0 * LIBRARY * _size(lower, upper)",
           "LIBRARY * _size(lower, upper)", "SiLU, GELU, Mish-Gelu"),
    _curve("the file's quotients are exact", "ScaledGelu.missing", "OWN_QUOTIENTS * _size(lower, upper)", "0.0",
           "functions with constants of the file-ScaledGelu", "composite_activations.py"),
    _curve("a switch leaves no gap", "SwitchedSoftplus.missing", "math.exp(-self.limit) * SWITCH", "0.0",
           "switched softplus-SwitchedSoftplus", "composite_activations.py"),
    _curve("steps are half as large", "Quantised.missing", "0.5 * self.step * SWITCH", "0.25 * self.step * SWITCH",
           "values in steps-Quantised", "composite_activations.py"),
    # constants that are computed
    Fault(
        "constants: sums have one order",
        _NETWORK + "constant_enclosures.py",
        "_reduced",
        "reach * total + (parts + 1.0) * tiny",
        "0.0 * total",
        "test_network_reading.py::test_folded_sums_hold_for_every_order",
    ),
    Fault(
        "constants: products of few numbers flush nothing on the way",
        _NETWORK + "constant_enclosures.py",
        "_reduced",
        "ONCE_FLUSHES * count * tiny * most",
        "0.0 * most",
        _HOME + "test_constants_that_pass_the_ends_of_float32[flushed]",
    ),
    Fault(
        "constants: squares overflow nowhere",
        _NETWORK + "constant_enclosures.py",
        "_check_bounded",
        "bool((size < largest).all())",
        "True",
        _HOME + "test_constants_that_pass_the_ends_of_float32[squares]",
    ),
    Fault(
        "constants: defaults of attributes are float64 numbers",
        _NETWORK + "onnx_graph.py",
        "Attributes.get",
        "float(np.float32(default)) if isinstance(default, float) else default",
        "default",
        _HOME + "test_defaults_are_float32_numbers",
    ),
    # the caller's subnormals
    Fault(
        "subnormals: the caller's flushing is not seen",
        _NETWORK + "subnormals.py",
        "_flushed",
        "bool(half + half != tiny)",
        "False",
        _SUBNORMALS + "test_bounds_do_not_depend_on_the_callers_subnormals",
    ),
    Fault(
        "subnormals: the caller's flushing is not put back",
        _NETWORK + "subnormals.py",
        "subnormals_kept",
        "torch.set_flush_denormal(True)",
        "pass",
        _SUBNORMALS + "test_the_thread_is_left_as_it_was",
    ),
    Fault(
        "subnormals: torch's threads are not asked",
        _NETWORK + "subnormals.py",
        "subnormals_kept",
        "_flushed() or _flushed_by_workers()",
        "_flushed()",
        _SUBNORMALS + "test_threads_that_flush_are_refused",
    ),
    Fault(
        "order: a norm's variance is the exact one",
        _CHARGES,
        "",
        "VARIANCE_PASSES = 3",
        "VARIANCE_PASSES = 0",
        _ORDER + "[norm of nearly equal features]",
    ),
)  # fmt: skip
