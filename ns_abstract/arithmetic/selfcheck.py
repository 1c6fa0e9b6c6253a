"""Start-up check that this machine's elementary functions are as accurate as the bounds assume.

The bounds charge a fixed error to every elementary function. IEEE 754 fixes division and the square root;
the logarithm and the trigonometric functions come from libraries that differ between machines, and
`exp_kernel` relies on a true fused multiply-add. `check_functions` compares them all with stored values, in
a millisecond once the kernels are compiled.

The stored values were computed offline by python-flint's Arb: for each point x the two neighbouring float64
numbers (equal where the value is a float64 itself) that enclose f(x). A function's points are special ones
(next to zeros, ends of the argument reduction, ends of the range) and, of some 9 000 random ones, those whose
value lies nearest to the middle of two float64 numbers, where a faulty last bit shows first.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache

import numpy as np
from numba import njit

from ns_abstract.arithmetic.elementary import exp_kernel
from ns_abstract.arithmetic.forms import Float64Array
from ns_abstract.arithmetic.rounding import EXP_RELATIVE_ERROR, FUNCTION_ROUNDING, UNIT64

#: Assumed errors: (relative to the value, absolute), by function.
#: exp: `rounding.EXP_RELATIVE_ERROR`. log: `forms.logarithm` charges four units of ``|log x| + 1``. sqrt and
#: reciprocal: one rounding, as everywhere in `forms`. sin, cos: `trigonometry.cos_sin` charges four units.
ASSUMED_ERRORS = {
    "exp": (EXP_RELATIVE_ERROR, 0.0),
    "log": (FUNCTION_ROUNDING, FUNCTION_ROUNDING),
    "sqrt": (UNIT64, 0.0),
    "sin": (0.0, FUNCTION_ROUNDING),
    "cos": (0.0, FUNCTION_ROUNDING),
    "reciprocal": (UNIT64, 0.0),
}


@njit(cache=True, error_model="numpy")
def _exp(x, out):
    for i in range(x.size):
        out[i] = exp_kernel(x[i])


@njit(cache=True, error_model="numpy")
def _log(x, out):
    for i in range(x.size):
        out[i] = np.log(x[i])


@njit(cache=True, error_model="numpy")
def _sqrt(x, out):
    for i in range(x.size):
        out[i] = np.sqrt(x[i])


@njit(cache=True, error_model="numpy")
def _reciprocal(x, out):
    for i in range(x.size):
        out[i] = 1.0 / x[i]


def _sin(x: Float64Array, out: Float64Array) -> None:
    np.sin(x, out=out)


def _cos(x: Float64Array, out: Float64Array) -> None:
    np.cos(x, out=out)


#: What the bounds call: compiled code for the first four, numpy for the angles of a pose.
FUNCTIONS: dict[str, Callable[[Float64Array, Float64Array], None]] = {
    "exp": _exp,
    "log": _log,
    "sqrt": _sqrt,
    "sin": _sin,
    "cos": _cos,
    "reciprocal": _reciprocal,
}


def table(name: str) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Points of one function and the float64 neighbours of its values: x, lower, upper, each [n]."""
    x, lower, upper = (np.array([float.fromhex(token) for token in _TABLES[name].split()[k::3]]) for k in range(3))
    return x, lower, upper


def check_functions(
    functions: Mapping[str, Callable[[Float64Array, Float64Array], None]] | None = None,
) -> list[str]:
    """Compare this machine's functions with the stored values.

    Args:
        functions: ``f(x, out)`` for arrays [n], by the names of `ASSUMED_ERRORS`; those the bounds use if None.

    Returns:
        One sentence per function that is less accurate than the bounds assume; empty if all is well.
    """
    problems = []
    for name, function in (FUNCTIONS if functions is None else functions).items():
        x, lower, upper = table(name)
        computed = np.empty_like(x)
        function(x, computed)
        relative, absolute = ASSUMED_ERRORS[name]
        # no less than the error: the value lies between its neighbours
        error = np.maximum(np.abs(computed - lower), np.abs(computed - upper))
        allowed = relative * np.minimum(np.abs(lower), np.abs(upper)) + absolute
        if (relative, absolute) == (UNIT64, 0.0):
            # one rounding gives one of the neighbours
            bad = (computed != lower) & (computed != upper)
        else:
            bad = ~(error <= allowed)
        if bad.any():
            first = int(np.argmax(bad))
            at, value, low, high = (float(a[first]) for a in (x, computed, lower, upper))
            problems.append(
                f"{name}({at!r}) is {value!r}, the value lies in [{low!r}, {high!r}]: the error exceeds"
                f" the assumed {relative / UNIT64:g} relative and {absolute / UNIT64:g} absolute units"
            )
    return problems


@cache
def platform_problems() -> tuple[str, ...]:
    """What is wrong with this process' arithmetic, one sentence each; with any, nothing it computes is guaranteed."""
    return tuple(check_functions())


#: By function: lines of x, lower, upper.
_TABLES = {
    "exp": """
        -0x1.5e00000000000p+9 0x1.14f2b0fb9307fp-1010 0x1.14f2b0fb93080p-1010
        -0x1.5dddb4c1deeddp+9 0x1.6a09e667f3c5ap-1010 0x1.6a09e667f3c5bp-1010
        -0x1.e90287c7228f3p+8 0x1.6c048ae02cc26p-706 0x1.6c048ae02cc27p-706
        -0x1.e7cfb4094f1f8p+8 0x1.2db4a17ef1e3cp-704 0x1.2db4a17ef1e3dp-704
        -0x1.e6644b700a3ecp+8 0x1.37e98d8cd3300p-702 0x1.37e98d8cd3301p-702
        -0x1.5cdab565633ecp+8 0x1.a2a56a5e8df1dp-504 0x1.a2a56a5e8df1ep-504
        -0x1.1743250d10e9cp+8 0x1.1438fd1b097d2p-403 0x1.1438fd1b097d3p-403
        -0x1.73e1974e1f050p+7 0x1.acdf9032307a5p-269 0x1.acdf9032307a6p-269
        -0x1.e000000000000p+5 0x1.5ae191a99585ap-87 0x1.5ae191a99585bp-87
        -0x1.dfa868c9e324dp+5 0x1.6a09e667f3bdap-87 0x1.6a09e667f3bdbp-87
        -0x1.b8de2063a503dp+5 0x1.68dc4edd0cd03p-80 0x1.68dc4edd0cd04p-80
        -0x1.5b5fecd575da8p+5 0x1.478a57031afdcp-63 0x1.478a57031afddp-63
        -0x1.559de8270c996p+5 0x1.505dae85e505bp-62 0x1.505dae85e505cp-62
        -0x1.48b6150f50fe1p+5 0x1.a60a54484f5cbp-60 0x1.a60a54484f5ccp-60
        -0x1.3616f63dbfd14p+5 0x1.0e7b8a6d04d04p-56 0x1.0e7b8a6d04d05p-56
        -0x1.267d682603459p+5 0x1.db462218cd68fp-54 0x1.db462218cd690p-54
        -0x1.06ac216fd247bp+5 0x1.8c4f14263b315p-48 0x1.8c4f14263b316p-48
        -0x1.e26e3129c26c1p+4 0x1.6a09e667f3bd0p-44 0x1.6a09e667f3bd1p-44
        -0x1.6751726b395ccp+4 0x1.84400afde267cp-33 0x1.84400afde267dp-33
        -0x1.11ab8e06d4f94p+3 0x1.95013de9a44f9p-13 0x1.95013de9a44fap-13
        -0x1.edeacc856ca00p+2 0x1.d29b6c5830d29p-12 0x1.d29b6c5830d2ap-12
        -0x1.23110e2a26278p+2 0x1.5afd1081a07b0p-7 0x1.5afd1081a07b1p-7
        -0x1.bb9d3beb8c86bp+0 0x1.6a09e667f3bccp-3 0x1.6a09e667f3bcdp-3
        -0x1.0a2b23f3bab73p+0 0x1.6a09e667f3bcdp-2 0x1.6a09e667f3bcep-2
        -0x1.0000000000000p+0 0x1.78b56362cef37p-2 0x1.78b56362cef38p-2
        -0x1.acfccc12bc07ap-1 0x1.bb0410b94df9ap-2 0x1.bb0410b94df9bp-2
        -0x1.236941a8b9a2ap-1 0x1.21caa96400254p-1 0x1.21caa96400255p-1
        -0x1.dfe1f13bbc0b8p-2 0x1.40702ac41677fp-1 0x1.40702ac416780p-1
        -0x1.62e42fefa39f0p-2 0x1.6a09e667f3bccp-1 0x1.6a09e667f3bcdp-1
        -0x1.62e42fefa39efp-2 0x1.6a09e667f3bccp-1 0x1.6a09e667f3bcdp-1
        -0x1.0000000000000p-54 0x1.fffffffffffffp-1 0x1.0000000000000p+0
        0x0.0p+0 0x1.0000000000000p+0 0x1.0000000000000p+0
        0x0.0000000000001p-1022 0x1.0000000000000p+0 0x1.0000000000001p+0
        0x1.67090b7f514e0p-5 0x1.0b7827a8de489p+0 0x1.0b7827a8de48ap+0
        0x1.27405d5d8c998p-3 0x1.27b307a45f61ap+0 0x1.27b307a45f61bp+0
        0x1.62e42fefa39efp-2 0x1.6a09e667f3bccp+0 0x1.6a09e667f3bcdp+0
        0x1.62e42fefa39f0p-2 0x1.6a09e667f3bccp+0 0x1.6a09e667f3bcdp+0
        0x1.bfff9d7066104p-1 0x1.330e1d5f8aa00p+1 0x1.330e1d5f8aa01p+1
        0x1.d31b07666a5c8p-1 0x1.3ebb00b099cb4p+1 0x1.3ebb00b099cb5p+1
        0x1.0000000000000p+0 0x1.5bf0a8b145769p+1 0x1.5bf0a8b14576ap+1
        0x1.0a2b23f3bab73p+0 0x1.6a09e667f3bcbp+1 0x1.6a09e667f3bccp+1
        0x1.bb9d3beb8c86bp+0 0x1.6a09e667f3bccp+2 0x1.6a09e667f3bcdp+2
        0x1.e26e3129c26c1p+4 0x1.6a09e667f3bc8p+43 0x1.6a09e667f3bc9p+43
        0x1.dfa868c9e324dp+5 0x1.6a09e667f3bbep+86 0x1.6a09e667f3bbfp+86
        0x1.e43c77b024970p+5 0x1.40d35f3ce65f4p+87 0x1.40d35f3ce65f5p+87
        0x1.8e5e4e72d2078p+8 0x1.a6e066b04011dp+574 0x1.a6e066b04011ep+574
        0x1.a33326ffd223cp+8 0x1.b6d278c95d4fbp+604 0x1.b6d278c95d4fcp+604
        0x1.0c9c2687e18f8p+9 0x1.080608a31705ap+775 0x1.080608a31705bp+775
        0x1.5dddb4c1deeddp+9 0x1.6a09e667f3b3ep+1009 0x1.6a09e667f3b3fp+1009
        0x1.5e00000000000p+9 0x1.d945df4f8ec8ep+1009 0x1.d945df4f8ec8fp+1009
    """,
    "log": """
        0x0.0000000000001p-1022 -0x1.74385446d71c4p+9 -0x1.74385446d71c3p+9
        0x1.0000000000000p-1022 -0x1.6232bdd7abcd3p+9 -0x1.6232bdd7abcd2p+9
        0x1.6f13d4c4ba464p-841 -0x1.2349c6ee56254p+9 -0x1.2349c6ee56253p+9
        0x1.264d8da7e0c67p-784 -0x1.0fa4dbc952a00p+9 -0x1.0fa4dbc9529ffp+9
        0x1.f72b612fb4caap-784 -0x1.0f6035bd62621p+9 -0x1.0f6035bd62620p+9
        0x1.76a9af21930abp-615 -0x1.a9e7984185153p+8 -0x1.a9e7984185152p+8
        0x1.a28ef6b0ef01fp-565 -0x1.8722f2d67b927p+8 -0x1.8722f2d67b926p+8
        0x1.3842bf44beb50p-558 -0x1.8293d4ca799efp+8 -0x1.8293d4ca799eep+8
        0x1.c26aa1f94e31dp-489 -0x1.52624c3f7e6a3p+8 -0x1.52624c3f7e6a2p+8
        0x1.a36e2eb1c432dp-14 -0x1.26bb1bbb55516p+3 -0x1.26bb1bbb55515p+3
        0x1.0101010101010p-8 -0x1.62a40fda3e3cdp+2 -0x1.62a40fda3e3ccp+2
        0x1.682e651359950p-6 -0x1.e8a24e82fb780p+1 -0x1.e8a24e82fb77fp+1
        0x1.0000000000000p-1 -0x1.62e42fefa39f0p-1 -0x1.62e42fefa39efp-1
        0x1.0eda6d4b24638p-1 -0x1.4603c5ed8fdc1p-1 -0x1.4603c5ed8fdc0p-1
        0x1.6a09e667f3bcdp-1 -0x1.62e42fefa39eep-2 -0x1.62e42fefa39edp-2
        0x1.7f3348ba1daefp-1 -0x1.28b89b858d541p-2 -0x1.28b89b858d540p-2
        0x1.a1eb0f50415dep-1 -0x1.9fd2dbcf08a6ap-3 -0x1.9fd2dbcf08a69p-3
        0x1.e623520650b84p-1 -0x1.a89be69f0446ap-5 -0x1.a89be69f04469p-5
        0x1.ff7ced916872bp-1 -0x1.064670d979b74p-10 -0x1.064670d979b73p-10
        0x1.ffffffc000000p-1 -0x1.0000001000001p-27 -0x1.0000001000000p-27
        0x1.fffffffffffffp-1 -0x1.0000000000001p-53 -0x1.0000000000000p-53
        0x1.0000000000000p+0 0x0.0p+0 0x0.0p+0
        0x1.0000000000001p+0 0x1.fffffffffffffp-53 0x1.0000000000000p-52
        0x1.0000004000000p+0 0x1.ffffffc000000p-27 0x1.ffffffc000001p-27
        0x1.1f3fd5f22b902p+0 0x1.d7bfe4bfd28f0p-4 0x1.d7bfe4bfd28f1p-4
        0x1.6a09e667f3bcdp+0 0x1.62e42fefa39f0p-2 0x1.62e42fefa39f1p-2
        0x1.725f026dab94cp+0 0x1.7a312637de81bp-2 0x1.7a312637de81cp-2
        0x1.85d18dc3a1374p+0 0x1.ae98986330a9ap-2 0x1.ae98986330a9bp-2
        0x1.99376d6b4e008p+0 0x1.e05315c06e50ap-2 0x1.e05315c06e50bp-2
        0x1.bb52d4d0e0230p+0 0x1.192693a6478dap-1 0x1.192693a6478dbp-1
        0x1.d68e7dc45ab14p+0 0x1.37ac9d4d069e6p-1 0x1.37ac9d4d069e7p-1
        0x1.e3179866a2682p+0 0x1.4522a78a137a7p-1 0x1.4522a78a137a8p-1
        0x1.f1c8d347bd5e0p+0 0x1.547989880d103p-1 0x1.547989880d104p-1
        0x1.0000000000000p+1 0x1.62e42fefa39efp-1 0x1.62e42fefa39f0p-1
        0x1.5bf0a8b145769p+1 0x1.fffffffffffffp-1 0x1.0000000000000p+0
        0x1.3a658c4849008p+5 0x1.d5ea569139e34p+1 0x1.d5ea569139e35p+1
        0x1.a5cdc5e7ca489p+6 0x1.2a20b37d099aap+2 0x1.2a20b37d099abp+2
        0x1.22cd415f72f51p+7 0x1.3eb00a764d79cp+2 0x1.3eb00a764d79dp+2
        0x1.32e5aa9952b9fp+7 0x1.4222a8d066db2p+2 0x1.4222a8d066db3p+2
        0x1.6378f6beffb60p+7 0x1.4b8a0c2a84642p+2 0x1.4b8a0c2a84643p+2
        0x1.895e2f2897a9cp+7 0x1.5205b4387c283p+2 0x1.5205b4387c284p+2
        0x1.6ea2235461969p+52 0x1.23390342d7fbbp+5 0x1.23390342d7fbcp+5
        0x1.c1c858dcf9d96p+111 0x1.3602fe800616cp+6 0x1.3602fe800616dp+6
        0x1.63efa6ac5accep+159 0x1.ba28ef5c5a56bp+6 0x1.ba28ef5c5a56cp+6
        0x1.ae9c8d3051329p+282 0x1.87f99e08d9e92p+7 0x1.87f99e08d9e93p+7
        0x1.52b2c5b6b6e55p+297 0x1.9c4a0ee91fc8dp+7 0x1.9c4a0ee91fc8ep+7
        0x1.f8fb952c624f3p+406 0x1.1a18dbaf4b469p+8 0x1.1a18dbaf4b46ap+8
        0x1.0d8d2ddc5df92p+674 0x1.d33b979402afcp+8 0x1.d33b979402afdp+8
        0x1.7c3e7505be43ep+876 0x1.2fcbd93245772p+9 0x1.2fcbd93245773p+9
        0x1.fffffffffffffp+1023 0x1.62e42fefa39efp+9 0x1.62e42fefa39f0p+9
    """,
    "sqrt": """
        0x0.0p+0 0x0.0p+0 0x0.0p+0
        0x0.0000000000001p-1022 0x1.0000000000000p-537 0x1.0000000000000p-537
        0x1.0000000000000p-1022 0x1.0000000000000p-511 0x1.0000000000000p-511
        0x1.43264087d0b3cp-896 0x1.1f9f28d7e2925p-448 0x1.1f9f28d7e2926p-448
        0x1.665f427c459d9p-893 0x1.ac5a6f8eed7e7p-447 0x1.ac5a6f8eed7e8p-447
        0x1.27d09a96d4ab1p-765 0x1.852ccf1500330p-383 0x1.852ccf1500331p-383
        0x1.357175a531741p-640 0x1.1974ba0af61f7p-320 0x1.1974ba0af61f8p-320
        0x1.906fa57300b53p-484 0x1.402ca57715214p-242 0x1.402ca57715215p-242
        0x1.a08f62eedbaedp-237 0x1.cdd236c487d59p-119 0x1.cdd236c487d5ap-119
        0x1.30c02e578152dp-160 0x1.1750531a5c9d4p-80 0x1.1750531a5c9d5p-80
        0x1.27be8dede22f3p-14 0x1.1327cf788f09fp-7 0x1.1327cf788f0a0p-7
        0x1.8e91c95bd2f07p-14 0x1.3f6d6227c2c97p-7 0x1.3f6d6227c2c98p-7
        0x1.3333333333333p-2 0x1.186f174f88472p-1 0x1.186f174f88473p-1
        0x1.fffffffffffffp-1 0x1.fffffffffffffp-1 0x1.0000000000000p+0
        0x1.0000000000000p+0 0x1.0000000000000p+0 0x1.0000000000000p+0
        0x1.0000000000001p+0 0x1.0000000000000p+0 0x1.0000000000001p+0
        0x1.11b8cc2521ed5p+0 0x1.08b67183a6fb5p+0 0x1.08b67183a6fb6p+0
        0x1.3db15c40b213cp+0 0x1.1d2edb06d979ap+0 0x1.1d2edb06d979bp+0
        0x1.4b94d76941348p+0 0x1.23599bbb34eaap+0 0x1.23599bbb34eabp+0
        0x1.6bdcb717e95abp+0 0x1.3133e70f1f622p+0 0x1.3133e70f1f623p+0
        0x1.6f41bb3c2eaf4p+0 0x1.329f841d9dff5p+0 0x1.329f841d9dff6p+0
        0x1.9160475320282p+0 0x1.408cca5bab2cdp+0 0x1.408cca5bab2cep+0
        0x1.b900ebf0491a6p+0 0x1.500059e195ec1p+0 0x1.500059e195ec2p+0
        0x1.0000000000000p+1 0x1.6a09e667f3bccp+0 0x1.6a09e667f3bcdp+0
        0x1.0a28510dbc539p+1 0x1.7126b73df06cfp+0 0x1.7126b73df06d0p+0
        0x1.0cf0d3e2338f5p+1 0x1.73138b7af6a3fp+0 0x1.73138b7af6a40p+0
        0x1.15aaa39fe9ea5p+1 0x1.790c5107838ecp+0 0x1.790c5107838edp+0
        0x1.24b12d7f6804cp+1 0x1.831d8cc3041eap+0 0x1.831d8cc3041ebp+0
        0x1.2d5b22542f1dep+1 0x1.88cd975cee55fp+0 0x1.88cd975cee560p+0
        0x1.778aaa5329286p+1 0x1.b67e906352bc0p+0 0x1.b67e906352bc1p+0
        0x1.8000000000000p+1 0x1.bb67ae8584caap+0 0x1.bb67ae8584cabp+0
        0x1.87d666d65c268p+1 0x1.bfe83a222992ap+0 0x1.bfe83a222992bp+0
        0x1.943d792b680abp+1 0x1.c6f0caf40f1acp+0 0x1.c6f0caf40f1adp+0
        0x1.ac52a5d497d9dp+1 0x1.d44bd1498ace8p+0 0x1.d44bd1498ace9p+0
        0x1.d09460f8138b5p+1 0x1.e7b6bc0ec6af2p+0 0x1.e7b6bc0ec6af3p+0
        0x1.db35d148bc144p+1 0x1.ed432200b05d7p+0 0x1.ed432200b05d8p+0
        0x1.fffffffffffffp+1 0x1.fffffffffffffp+0 0x1.0000000000000p+1
        0x1.0000000000000p+2 0x1.0000000000000p+1 0x1.0000000000000p+1
        0x1.0000000000001p+2 0x1.0000000000000p+1 0x1.0000000000001p+1
        0x1.13343e2922981p+29 0x1.775f59b46b20ap+14 0x1.775f59b46b20bp+14
        0x1.68792a6cdfe71p+60 0x1.2fc734fab4747p+30 0x1.2fc734fab4748p+30
        0x1.b67c5ed35667cp+107 0x1.d9d1be757bbf4p+53 0x1.d9d1be757bbf5p+53
        0x1.ff649d4b958f4p+189 0x1.ffb248bfdad6dp+94 0x1.ffb248bfdad6ep+94
        0x1.476283aadf4aap+223 0x1.996a5c5e3d180p+111 0x1.996a5c5e3d181p+111
        0x1.a3bad3440f0fdp+299 0x1.cf932a00c9e78p+149 0x1.cf932a00c9e79p+149
        0x1.3fbad406c8cf7p+373 0x1.9499c1ceae35ap+186 0x1.9499c1ceae35bp+186
        0x1.c374da622f461p+558 0x1.53f5c7852a9f6p+279 0x1.53f5c7852a9f7p+279
        0x1.0b617f542e537p+572 0x1.05a0e88d91386p+286 0x1.05a0e88d91387p+286
        0x1.8d80796a97e59p+849 0x1.c32209bc9f4f7p+424 0x1.c32209bc9f4f8p+424
        0x1.fffffffffffffp+1023 0x1.fffffffffffffp+511 0x1.0000000000000p+512
    """,
    "sin": """
        -0x1.f1c923f967fe9p+9 -0x1.3bc0cdf214be1p-2 -0x1.3bc0cdf214be0p-2
        -0x1.bb64da457ac87p+9 -0x1.839bc6d0d6a1ep-1 -0x1.839bc6d0d6a1dp-1
        -0x1.3af1d577f6551p+9 -0x1.0000000000000p+0 -0x1.fffffffffffffp-1
        -0x1.373304e4cf691p+9 -0x1.6bd557d4e0f79p-2 -0x1.6bd557d4e0f78p-2
        -0x1.8706c2a36eae4p+7 -0x1.57229a6749d4dp-1 -0x1.57229a6749d4cp-1
        -0x1.32fa5f5579f60p+6 -0x1.f3265c2de4bfdp-1 -0x1.f3265c2de4bfcp-1
        -0x1.0db88dfbc4070p+5 -0x1.7e13f37d6adfep-1 -0x1.7e13f37d6adfdp-1
        -0x1.b0bc642e01d6fp+2 -0x1.d7543fecfaef2p-2 -0x1.d7543fecfaef1p-2
        -0x1.a1e5c02c8a1c7p+2 -0x1.f3a923850448cp-3 -0x1.f3a923850448bp-3
        -0x1.96a1dc706a486p+2 -0x1.204cb78ee628ap-4 -0x1.204cb78ee6289p-4
        -0x1.6b9ab44aa0188p+2 0x1.21e2c1a05a4e7p-1 0x1.21e2c1a05a4e8p-1
        -0x1.2620d43a8252ap+2 0x1.fc85790392deap-1 0x1.fc85790392debp-1
        -0x1.8c4664d877016p+1 -0x1.7632c2cb6e8f0p-5 -0x1.7632c2cb6e8efp-5
        -0x1.2d2336436630ap+1 -0x1.6b53052200621p-1 -0x1.6b53052200620p-1
        -0x1.1e1d317c2c52ap+1 -0x1.9311a461a9aecp-1 -0x1.9311a461a9aebp-1
        -0x1.921fb54442d18p+0 -0x1.0000000000000p+0 -0x1.fffffffffffffp-1
        -0x1.4c69d3fd2aae0p+0 -0x1.ed22679cb72ecp-1 -0x1.ed22679cb72ebp-1
        -0x1.1c76d7353c4f8p+0 -0x1.cade323f35aecp-1 -0x1.cade323f35aebp-1
        -0x1.026c52c8c8164p+0 -0x1.b16ea89172ed2p-1 -0x1.b16ea89172ed1p-1
        -0x1.464634e252c20p-1 -0x1.30a2a73ccd91ep-1 -0x1.30a2a73ccd91dp-1
        0x0.0p+0 0x0.0p+0 0x0.0p+0
        0x0.0000000000001p-1022 0x0.0p+0 0x0.0000000000001p-1022
        0x1.5798ee2308c3ap-27 0x1.5798ee2308c39p-27 0x1.5798ee2308c3ap-27
        0x1.71f7c30d08500p-4 0x1.717707e314ca5p-4 0x1.717707e314ca6p-4
        0x1.2c0713ea1b400p-3 0x1.2af4a36802f70p-3 0x1.2af4a36802f71p-3
        0x1.0549f050b43a8p-1 0x1.f4302ac513dbdp-2 0x1.f4302ac513dbep-2
        0x1.921fb54442d18p-1 0x1.6a09e667f3bccp-1 0x1.6a09e667f3bcdp-1
        0x1.425bf6518cfe8p+0 0x1.e758e90518fecp-1 0x1.e758e90518fedp-1
        0x1.921fb54442d18p+0 0x1.fffffffffffffp-1 0x1.0000000000000p+0
        0x1.d0fce9f65c0b8p+0 0x1.f0a3ecef8e2c3p-1 0x1.f0a3ecef8e2c4p-1
        0x1.d3a0d250aff78p+0 0x1.ef548a461ec3ap-1 0x1.ef548a461ec3bp-1
        0x1.2d97c7f3321d2p+1 0x1.6a09e667f3bcdp-1 0x1.6a09e667f3bcep-1
        0x1.7e5dfbe3ad510p+1 0x1.3adaa6b465c3cp-3 0x1.3adaa6b465c3dp-3
        0x1.921fb54442d18p+1 0x1.1a62633145c06p-53 0x1.1a62633145c07p-53
        0x1.93220baa6474cp+1 -0x1.0255b6bf59ffcp-7 -0x1.0255b6bf59ffbp-7
        0x1.e35101611b484p+1 -0x1.2f6cddca18c8ep-1 -0x1.2f6cddca18c8dp-1
        0x1.f75e276604250p+1 -0x1.6c0cb3659d6ddp-1 -0x1.6c0cb3659d6dcp-1
        0x1.7088b9bf1a830p+2 -0x1.008cdec774462p-1 -0x1.008cdec774461p-1
        0x1.802b57ec21298p+2 -0x1.1b84f7a6db027p-2 -0x1.1b84f7a6db026p-2
        0x1.921fb54442d18p+2 -0x1.1a62633145c07p-52 -0x1.1a62633145c06p-52
        0x1.6000000000000p+4 -0x1.220a29f6eb9f4p-7 -0x1.220a29f6eb9f3p-7
        0x1.b5dc547ccd980p+6 0x1.e2712702fccedp-2 0x1.e2712702fcceep-2
        0x1.bf63d6ffe4670p+6 -0x1.e5da84e76a0a5p-1 -0x1.e5da84e76a0a4p-1
        0x1.61e671055bcf0p+7 0x1.b484ad7ac6710p-1 0x1.b484ad7ac6711p-1
        0x1.3a28c59d5433bp+8 0x1.1b19140c0c0d5p-49 0x1.1b19140c0c0d6p-49
        0x1.6300000000000p+8 -0x1.f9bd0307d1de3p-16 -0x1.f9bd0307d1de2p-16
        0x1.646fb67386ffcp+8 -0x1.fb622ef473743p-1 -0x1.fb622ef473742p-1
        0x1.d24fce5c20080p+8 0x1.f43cc69d1d891p-1 0x1.f43cc69d1d892p-1
        0x1.f383632acb004p+9 -0x1.3d8c6e6e694a2p-46 -0x1.3d8c6e6e694a1p-46
        0x1.f400000000000p+9 0x1.a75cc150a206bp-1 0x1.a75cc150a206cp-1
    """,
    "cos": """
        -0x1.66d863e86cc42p+9 0x1.4d19ab7732aa3p-3 0x1.4d19ab7732aa4p-3
        -0x1.3beffe8e85916p+9 -0x1.d492f8de188b0p-1 -0x1.d492f8de188afp-1
        -0x1.3af1d577f6551p+9 0x1.069507580b909p-44 0x1.069507580b90ap-44
        -0x1.2d223f5ed13ffp+9 0x1.36e673ce001b1p-1 0x1.36e673ce001b2p-1
        -0x1.b3c1ec9731272p+8 -0x1.349aae602eaa0p-1 -0x1.349aae602ea9fp-1
        -0x1.afb915af1be3ap+8 -0x1.f2bf55b689d09p-3 -0x1.f2bf55b689d08p-3
        -0x1.5baa535c0b49ap+8 -0x1.fc3964cca23c8p-2 -0x1.fc3964cca23c7p-2
        -0x1.85371f90403f8p+6 -0x1.fe20bfc6a8255p-1 -0x1.fe20bfc6a8254p-1
        -0x1.ab5de6aa0d932p+2 0x1.d8b030e0a93e4p-1 0x1.d8b030e0a93e5p-1
        -0x1.73d1b1e5bc98fp+2 0x1.c7aa7884357abp-1 0x1.c7aa7884357acp-1
        -0x1.01cee72c7cf1ep+2 -0x1.4395f296ef805p-1 -0x1.4395f296ef804p-1
        -0x1.df22af1164c16p+1 -0x1.a617e1d2d5e73p-1 -0x1.a617e1d2d5e72p-1
        -0x1.921fb54442d18p+0 0x1.1a62633145c06p-54 0x1.1a62633145c07p-54
        -0x1.722a14367b210p-1 0x1.7feaed345ca00p-1 0x1.7feaed345ca01p-1
        -0x1.e81893fa89ef0p-2 0x1.c6edeec0673b8p-1 0x1.c6edeec0673b9p-1
        0x0.0p+0 0x1.0000000000000p+0 0x1.0000000000000p+0
        0x1.5798ee2308c3ap-27 0x1.fffffffffffffp-1 0x1.0000000000000p+0
        0x1.921fb54442d18p-1 0x1.6a09e667f3bccp-1 0x1.6a09e667f3bcdp-1
        0x1.dd204f366d318p-1 0x1.3150e047199b3p-1 0x1.3150e047199b4p-1
        0x1.57d2c20c5d388p+0 0x1.ce622f0b4f3c3p-3 0x1.ce622f0b4f3c4p-3
        0x1.921fb54442d18p+0 0x1.1a62633145c06p-54 0x1.1a62633145c07p-54
        0x1.0adc2755bf3ccp+1 -0x1.f781a141bdc45p-2 -0x1.f781a141bdc44p-2
        0x1.26e9280e55f40p+1 -0x1.56a7751c8a2f0p-1 -0x1.56a7751c8a2efp-1
        0x1.2d97c7f3321d2p+1 -0x1.6a09e667f3bccp-1 -0x1.6a09e667f3bcbp-1
        0x1.77d9c24aad0c8p+1 -0x1.f5408c5f18208p-1 -0x1.f5408c5f18207p-1
        0x1.921fb54442d18p+1 -0x1.0000000000000p+0 -0x1.fffffffffffffp-1
        0x1.00597567b9034p+2 -0x1.4c8b7b74a7026p-1 -0x1.4c8b7b74a7025p-1
        0x1.02414704c9a82p+2 -0x1.40ced85b6b55cp-1 -0x1.40ced85b6b55bp-1
        0x1.1cf1290076f8cp+2 -0x1.076b1f3d78210p-2 -0x1.076b1f3d7820fp-2
        0x1.3c8c584ff00d6p+2 0x1.da3a1b59c54cfp-3 0x1.da3a1b59c54d0p-3
        0x1.65be84b727e76p+2 0x1.89c1d324f4610p-1 0x1.89c1d324f4611p-1
        0x1.6c5edec39e6dcp+2 0x1.a978b890f7bf5p-1 0x1.a978b890f7bf6p-1
        0x1.8887e4ac3fe98p+2 0x1.fa42560df1065p-1 0x1.fa42560df1066p-1
        0x1.921fb54442d18p+2 0x1.fffffffffffffp-1 0x1.0000000000000p+0
        0x1.9ec8c5c523eb2p+2 0x1.f603c6fe979f9p-1 0x1.f603c6fe979fap-1
        0x1.ae90d9345f746p+2 0x1.ce44811293187p-1 0x1.ce44811293188p-1
        0x1.b68b3efb129c8p+2 0x1.af4fd4284d082p-1 0x1.af4fd4284d083p-1
        0x1.6000000000000p+3 0x1.220ae41ee2fdfp-8 0x1.220ae41ee2fe0p-8
        0x1.129cc3555a880p+6 0x1.ca55bb077f293p-1 0x1.ca55bb077f294p-1
        0x1.1381cf5556b40p+6 0x1.f188e489c27eep-1 0x1.f188e489c27efp-1
        0x1.646a57e995e90p+7 -0x1.4cda01e73a7dbp-1 -0x1.4cda01e73a7dap-1
        0x1.3bbae55298768p+8 0x1.edb9ff0d7e20bp-49 0x1.edb9ff0d7e20cp-49
        0x1.5800000000000p+8 -0x1.2011285e3d715p-8 -0x1.2011285e3d714p-8
        0x1.ece170d0de5c4p+8 -0x1.e10f8e238ef20p-1 -0x1.e10f8e238ef1fp-1
        0x1.923f477485cb4p+9 0x1.f0813f2e21d7fp-1 0x1.f0813f2e21d80p-1
        0x1.b28adb708c1d0p+9 -0x1.af042a2ab9fe5p-2 -0x1.af042a2ab9fe4p-2
        0x1.bbfabc06ac264p+9 -0x1.c5a0eac3bf564p-2 -0x1.c5a0eac3bf563p-2
        0x1.cf58e2edae4e2p+9 -0x1.fe8b850ec7f3dp-1 -0x1.fe8b850ec7f3cp-1
        0x1.f2ba535028dedp+9 -0x1.371c8302ce012p-44 -0x1.371c8302ce011p-44
        0x1.f400000000000p+9 0x1.1ff026793f1bbp-1 0x1.1ff026793f1bcp-1
    """,
    "reciprocal": """
        0x1.0000000000000p-1022 0x1.0000000000000p+1022 0x1.0000000000000p+1022
        0x1.c3baf2df26779p-882 0x1.2227cbabb1ed0p+881 0x1.2227cbabb1ed1p+881
        0x1.29755ec5365b5p-590 0x1.b8a3c03f67500p+589 0x1.b8a3c03f67501p+589
        0x1.7c285baac0b97p-514 0x1.58c884db9d773p+513 0x1.58c884db9d774p+513
        0x1.82dcfdbbca238p-253 0x1.52ce9b9d8b85cp+252 0x1.52ce9b9d8b85dp+252
        0x1.c614aba0ea9c0p-129 0x1.20a74c5ab214dp+128 0x1.20a74c5ab214ep+128
        0x1.c46f57cf76e88p-126 0x1.21b41aec5eadbp+125 0x1.21b41aec5eadcp+125
        0x1.4167e5d3d85b0p-125 0x1.97cef223e0b08p+124 0x1.97cef223e0b09p+124
        0x1.f741c9c6425ebp-70 0x1.04728c48a58e4p+69 0x1.04728c48a58e5p+69
        0x1.b7cdfd9d7bdbbp-34 0x1.2a05f1fffffffp+33 0x1.2a05f20000000p+33
        0x1.999999999999ap-4 0x1.3ffffffffffffp+3 0x1.4000000000000p+3
        0x1.fffffffffffffp-1 0x1.0000000000000p+0 0x1.0000000000001p+0
        0x1.0000000000000p+0 0x1.0000000000000p+0 0x1.0000000000000p+0
        0x1.0000000000001p+0 0x1.ffffffffffffep-1 0x1.fffffffffffffp-1
        0x1.0df62ec92c272p+0 0x1.e58553e3597dcp-1 0x1.e58553e3597ddp-1
        0x1.13a3293f783d6p+0 0x1.db85fb69b86a1p-1 0x1.db85fb69b86a2p-1
        0x1.162fd7c426eedp+0 0x1.d72a4f4d409d3p-1 0x1.d72a4f4d409d4p-1
        0x1.23c46a0fef4b0p+0 0x1.c13c1c06c3fb6p-1 0x1.c13c1c06c3fb7p-1
        0x1.248a096cf665cp+0 0x1.c00ca1ec54760p-1 0x1.c00ca1ec54761p-1
        0x1.332820ebd858ep+0 0x1.aaba0bb81afaep-1 0x1.aaba0bb81afafp-1
        0x1.370ad92bb8b78p+0 0x1.a5655d7a33c7dp-1 0x1.a5655d7a33c7ep-1
        0x1.44ae4b40599f9p+0 0x1.93b1e577a8031p-1 0x1.93b1e577a8032p-1
        0x1.4c30e7120808dp+0 0x1.8a9172921b75dp-1 0x1.8a9172921b75ep-1
        0x1.589e9163901f0p+0 0x1.7c56a29fbb4c1p-1 0x1.7c56a29fbb4c2p-1
        0x1.64ace08a0a038p+0 0x1.6f7b91bad4d5ap-1 0x1.6f7b91bad4d5bp-1
        0x1.8000000000000p+0 0x1.5555555555555p-1 0x1.5555555555556p-1
        0x1.8821bb94f4f2ap+0 0x1.4e4146f6a5c04p-1 0x1.4e4146f6a5c05p-1
        0x1.8d7890f4f811bp+0 0x1.49c3d51ab198ep-1 0x1.49c3d51ab198fp-1
        0x1.8e92206155cf9p+0 0x1.48dae0da497a6p-1 0x1.48dae0da497a7p-1
        0x1.9df2bed76b544p+0 0x1.3ca37d7627225p-1 0x1.3ca37d7627226p-1
        0x1.a7b22bee2d1a2p+0 0x1.355a987698075p-1 0x1.355a987698076p-1
        0x1.a89be780337c4p+0 0x1.34b04e8dbe39cp-1 0x1.34b04e8dbe39dp-1
        0x1.ab8f8b8a77a9bp+0 0x1.328ec08bc3873p-1 0x1.328ec08bc3874p-1
        0x1.b70fe4527d12bp+0 0x1.2a86faa8792d6p-1 0x1.2a86faa8792d7p-1
        0x1.b8aef3c454f3dp+0 0x1.296dcf36965c8p-1 0x1.296dcf36965c9p-1
        0x1.d5d8a195e2c80p+0 0x1.16f7c69bb56c7p-1 0x1.16f7c69bb56c8p-1
        0x1.e2d0d896cedcap+0 0x1.0f7960813284ap-1 0x1.0f7960813284bp-1
        0x1.fffffffffffffp+0 0x1.0000000000000p-1 0x1.0000000000001p-1
        0x1.8000000000000p+1 0x1.5555555555555p-2 0x1.5555555555556p-2
        0x1.8800000000000p+5 0x1.4e5e0a72f0539p-6 0x1.4e5e0a72f053ap-6
        0x1.fe00000000000p+7 0x1.0101010101010p-8 0x1.0101010101011p-8
        0x1.2a05f20000000p+33 0x1.b7cdfd9d7bdbap-34 0x1.b7cdfd9d7bdbbp-34
        0x1.9ef7374252515p+182 0x1.3bdcbd1e78446p-183 0x1.3bdcbd1e78447p-183
        0x1.a5acb7a2ea5a9p+185 0x1.36d637657300dp-186 0x1.36d637657300ep-186
        0x1.2a19e4ec473d1p+300 0x1.b7b08f18e113dp-301 0x1.b7b08f18e113ep-301
        0x1.2b653750f9106p+507 0x1.b5c9fb798220fp-508 0x1.b5c9fb7982210p-508
        0x1.7e790bf9f98e5p+551 0x1.56b23c21084a9p-552 0x1.56b23c21084aap-552
        0x1.2b4c247cd8383p+662 0x1.b5eea8700b9e2p-663 0x1.b5eea8700b9e3p-663
        0x1.79ece900ec4e3p+853 0x1.5ad1da917d7dfp-854 0x1.5ad1da917d7e0p-854
        0x1.fffffffffffffp+1021 0x1.0000000000000p-1022 0x1.0000000000001p-1022
    """,
}
