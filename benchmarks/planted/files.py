"""Faults in what is read of scenes of other programs, and of queries in VNN-LIB 2.0."""

from planted.fault import Fault

_QUERY, _GLTF, _BENCH = "verify/vnnlib2.py", "methods/splat/formats/gltf.py", "bench/vnnlib.py"
_NUMBERS = "test_vnnlib2.py::test_numbers_of_float32_queries_are_their_float32_values"
_DAMAGED = "test_formats.py::test_bad_files_end_in_one_line"

FILES = (
    Fault(
        "numbers of float32 queries stay as they are written",
        _QUERY,
        "_outward",
        "max(value, single) if larger else min(value, single)",
        "value",
        _NUMBERS,
    ),
    Fault(
        "numbers of float32 queries are moved inward",
        _QUERY,
        "_Reader._side",
        "(operator == '<=') == (place == 1)",
        "(operator == '<=') == (place == 0)",
        _NUMBERS,
    ),
    Fault(
        "tensors of as many elements are taken for those of the network",
        _QUERY,
        "_check_shape",
        "[n for n in tensor.shape if n != 1] == [n for n in shape if n != 1]",
        "tensor.size == math.prod(shape)",
        "test_vnnlib2.py::test_elements_are_counted_in_rows",
    ),
    Fault(
        "equality is one inequality",
        _QUERY,
        "",
        "('<=', '>=')",
        "('<=',)",
        "test_vnnlib2.py::test_conditions_mean_what_the_standard_says[equality]",
    ),
    Fault(
        "arithmetic of float32 in a query does not round",
        _QUERY,
        "_Reader._side",
        "self.kind == 'real'",
        "True",
        "test_vnnlib2.py::test_bad_queries_are_errors_of_one_line[rounded sum]",
    ),
    Fault(
        "proofs of real numbers answer queries about float32",
        _BENCH,
        "_question",
        "query is not None and query.input.kind == 'float32' and (arithmetic != 'float32')",
        "False",
        "test_vnnlib2.py::test_a_folder_of_2026",
    ),
    Fault(
        "a query is asked of a network of another name",
        _BENCH,
        "_question",
        "query is not None and name not in ('', query.network)",
        "False",
        "test_vnnlib2.py::test_a_folder_of_2026",
    ),
    Fault(
        "nodes of a .glb move nothing",
        _GLTF,
        "_primitive",
        "name in node and node[name] != still",
        "False",
        f"{_DAMAGED}[glb: turned node]",
    ),
    Fault(
        "colours of a .glb are those of the display whatever it says",
        _GLTF,
        "_checked",
        "value != _VALUES[name][0]",
        "False",
        f"{_DAMAGED}[glb: linear colours]",
    ),
    Fault(
        "quaternions of a .glb begin with w",
        _GLTF,
        "decode_glb",
        "[3, 0, 1, 2]",
        "[0, 1, 2, 3]",
        "test_formats.py::test_numbers_are_those_of_the_description[glb-1]",
    ),
    Fault(
        "rows of a .glb may end behind their view",
        _GLTF,
        "_Accessors.read",
        "start + (count - 1) * stride + width * item > length",
        "False",
        f"{_DAMAGED}[glb: offset of an accessor]",
    ),
)
