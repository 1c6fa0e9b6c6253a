"""Export abstract images to other verifiers: ONNX with a linear renderer before the network, and VNN-LIB.

See design.md, N8.

The written network takes ``X = (p, e)``, the cell's parameters p in [-1, 1]^d and one e in [-1, 1] for every
number of the image, and computes ``A p + c + r e`` (the abstract image), the network, and the rows of the
property. The VNN-LIB file (version 1 or 2) asks for an X in that box with a group of rows none of which is positive:
"unsat" means that the property holds for every image of the set.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from ns_abstract.arithmetic.network_charges import UNIT, WRITTEN_FLUSH, WRITTEN_TERMS
from ns_abstract.io.atomic import write_atomic
from ns_abstract.io.errors import InputError
from ns_abstract.verify.network import ImageSets, Network, load_network
from ns_abstract.verify.network.onnx_tensors import parse_model
from ns_abstract.verify.vnnlib2 import violation, write_query

Form = Literal["slice", "gemm"]
#: Version of VNN-LIB that is written.
LibraryVersion = Literal["1.0", "2.0"]

#: Roundoff of float32; the layer's constants and sums are rounded to it.


def write_vnnlib(
    model: Path | Network,
    images: ImageSets,
    rows: Any,
    offset: np.ndarray,
    target: Path,
    form: Form = "slice",
    groups: Sequence[Sequence[int]] | None = None,
    version: LibraryVersion = "1.0",
) -> tuple[Path, Path]:
    """Write one abstract image, a network and a property as ``target.onnx`` and ``target.vnnlib``.

    The set that is written contains the abstract image: planes that are not parallel become parallel, and
    float32 constants are rounded outward. It leaves out the box ``images.lower``, ``images.upper``.

    Args:
        model: The network, or its .onnx file, with its weights inside.
        rows, offset: [k, output_size] and [k], both rounded to float32; the property is that in every group
            some row of ``rows @ y + offset`` is above 0.
        form: "slice" needs n (d + 2) numbers for an image of n; "gemm" n (n + d), and no operator but Gemm
            and Reshape, for verifiers that know little.
        groups: Row numbers of each group; None: every row is one.
        version: Of VNN-LIB; 2.0 asks about float32.
    """
    network = load_network(model) if isinstance(model, Path) else model
    model = network.source
    if model.suffix.lower() != ".onnx":
        raise InputError("only .onnx networks can be extended", file=model, fix="export the network to ONNX")
    if network.whole_numbers:
        raise InputError("takes uint8 numbers", file=model, fix="export the network with a float input")
    if images.count != 1 or images.a_lower.shape[1] != network.input_size:
        raise ValueError(f"one cell of {network.input_size} numbers expected")
    matrix = np.asarray(rows.toarray() if hasattr(rows, "toarray") else rows, np.float64)
    if matrix.shape != (len(offset), network.output_size):
        raise ValueError(f"rows {(len(offset), network.output_size)} expected, got {matrix.shape}")
    proto = parse_model(model)
    if any(tensor.data_location == TensorProto.EXTERNAL for tensor in proto.graph.initializer):
        raise InputError("keeps its weights in another file", file=model, fix="save it as a single file")
    if proto.ir_version < 4:
        raise InputError(f"has IR version {proto.ir_version}", file=model, fix="export with IR version 4 or later")
    stored = {tensor.name for tensor in proto.graph.initializer}
    image = next(value for value in proto.graph.input if value.name not in stored)
    sizes = image.type.tensor_type.shape.dim
    if len(sizes) != len(network.input_shape) + 1 or sizes[0].dim_value > 1:
        raise InputError("takes other inputs than a batch of 1", file=model, fix="export it with a free batch")
    _extend(proto, _parallel(images), network, matrix, np.asarray(offset, np.float64), form)
    d, n = images.dimensions, network.input_size
    network_file, property_file = target.with_name(target.name + ".onnx"), target.with_name(target.name + ".vnnlib")
    chosen = [(k,) for k in range(len(matrix))] if groups is None else groups
    note = f"the first {d} inputs: parameters of the cell; the rest: slack of the image's {n} numbers"
    write = _vnnlib if version == "1.0" else write_query
    text = write(d, n, chosen, len(matrix), [note]).encode("ascii")
    write_atomic(network_file, lambda stream: stream.write(proto.SerializeToString()))
    write_atomic(property_file, lambda stream: stream.write(text))
    return network_file, property_file


def _parallel(images: ImageSets) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A [n, d], c [n], r [n] in float32 such that ``A p + c + r [-1, 1]`` contains every image of the cell."""
    slopes = 0.5 * (images.a_lower[0] + images.a_upper[0])
    apart = 0.5 * np.abs(images.a_upper[0] - images.a_lower[0]).sum(axis=1)
    center = 0.5 * (images.b_lower[0] + images.b_upper[0])
    radius = np.maximum(0.5 * (images.b_upper[0] - images.b_lower[0]) + apart, 0.0)
    A, c = slopes.astype(np.float32), center.astype(np.float32)
    lost = np.abs(A.astype(np.float64) - slopes).sum(axis=1) + np.abs(c.astype(np.float64) - center)
    # what a float32 evaluation of the layer may lose, and rounding of the lines above
    size = np.abs(slopes).sum(axis=1) + np.abs(center) + radius
    radius = radius + lost + (slopes.shape[1] + WRITTEN_TERMS) * UNIT * size + WRITTEN_FLUSH
    return A, c, np.nextafter(radius.astype(np.float32), np.float32(np.inf))


def _extend(
    proto: onnx.ModelProto,
    planes: tuple[np.ndarray, np.ndarray, np.ndarray],
    network: Network,
    rows: np.ndarray,
    offset: np.ndarray,
    form: Form,
) -> None:
    """Put the linear layer in front of the graph, and the rows of the property behind it."""
    graph = proto.graph
    A, c, r = planes
    n, d = A.shape
    stored = {tensor.name for tensor in graph.initializer}
    image = next(value for value in graph.input if value.name not in stored)
    output, shape = network.output, network.input_shape
    used = {name for node in graph.node for name in (*node.input, *node.output)} | stored

    def name(text: str) -> str:
        while text in used:
            text += "_"
        used.add(text)
        return text

    def constant(text: str, value: np.ndarray) -> str:
        key = name(text)
        graph.initializer.append(numpy_helper.from_array(value, key))
        return key

    whole, flat, result = name("parameters"), name("abstract_image"), name("property")
    to_image = constant("image_shape", np.array([1, *shape], np.int64))
    if form == "gemm":
        wide = constant("renderer", np.concatenate([A, np.diag(r)], axis=1))
        front = [helper.make_node("Gemm", [whole, wide, constant("center", c)], [flat], transB=1)]
    else:
        opset = max(entry.version for entry in proto.opset_import if entry.domain in ("", "ai.onnx"))
        parts = []
        for key, first, last in ((name("p"), 0, d), (name("e"), d, d + n)):
            if opset < 10:
                parts.append(helper.make_node("Slice", [whole], [key], axes=[1], starts=[first], ends=[last]))
                continue
            where = [constant(key + text, np.array([v], np.int64)) for text, v in (("0", first), ("1", last), ("2", 1))]
            parts.append(helper.make_node("Slice", [whole, *where], [key]))
        p, e = parts[0].output[0], parts[1].output[0]
        moved, scaled = name("moved"), name("scaled")
        front = [
            *parts,
            helper.make_node("Gemm", [p, constant("renderer", A), constant("center", c)], [moved], transB=1),
            helper.make_node("Mul", [e, constant("radius", r[None])], [scaled]),
            helper.make_node("Add", [moved, scaled], [flat]),
        ]
    front.append(helper.make_node("Reshape", [flat, to_image], [image.name]))
    scores = constant("rows", rows.astype(np.float32)), constant("offset", offset.astype(np.float32))
    flattened = name("scores")
    back = [
        helper.make_node("Reshape", [output, constant("score_shape", np.array([1, -1], np.int64))], [flattened]),
        helper.make_node("Gemm", [flattened, *scores], [result], transB=1),
    ]
    nodes = [*front, *graph.node, *back]
    graph.input.remove(image)
    graph.input.insert(0, helper.make_tensor_value_info(whole, TensorProto.FLOAT, [1, d + n]))
    del graph.node[:], graph.output[:], graph.value_info[:]
    graph.node.extend(nodes)
    graph.output.append(helper.make_tensor_value_info(result, TensorProto.FLOAT, [1, len(rows)]))


def _vnnlib(d: int, n: int, groups: Sequence[Sequence[int]], k: int, notes: Sequence[str]) -> str:
    """Return VNN-LIB 1 text: the box of (p, e) and the negated property of ``k`` rows."""
    lines = [f"; {note}" for note in notes]
    lines += [f"(declare-const X_{i} Real)" for i in range(d + n)]
    lines += [f"(declare-const Y_{i} Real)" for i in range(k)]
    lines += violation("X_{}", "Y_{}", d + n, groups)
    return "\n".join(lines) + "\n"
