"""Loads a network from a file and compares it with the runtime of that file format."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import file_size, show
from ns_abstract.io.stamps import file_stamp
from ns_abstract.verify.network.comparison import Evaluate, compare, levels, probes
from ns_abstract.verify.network.graph import Network
from ns_abstract.verify.network.onnx_epsilons import refuse_lost_epsilons
from ns_abstract.verify.network.onnx_graph import OnnxReader, ReadRequest, operator_set
from ns_abstract.verify.network.onnx_rules import RULES
from ns_abstract.verify.network.onnx_tensors import PACKED, parse_model, unpacked_model
from ns_abstract.verify.network.subnormals import subnormals_kept

#: Types of inputs beside float32.
_KINDS: dict[str, type] = {"tensor(double)": np.float64, "tensor(uint8)": np.uint8}


@subnormals_kept()
def load_network(
    path: Path,
    *,
    vector: bool = False,
    output: str | None = None,
    picture: tuple[int, int] | None = None,
    layout: str = "NCHW",
    whole_numbers: bool = False,
    shown: Callable[[tuple[int, ...]], Iterable[np.ndarray]] | None = None,
) -> Network:
    """Return the network in an .onnx or .onnx.gz file, compared with onnxruntime.

    Args:
        path: The file.
        vector: Whether the input may be a vector [n], without a batch.
        output: Name of the output that is read; None: the only one.
        picture, layout: Height and width of pictures, where the file leaves them free, "NCHW" or "NHWC".
        whole_numbers: Whether the input may be uint8, for whole numbers from 0 to 255.
        shown: Returns further inputs [1, *input_shape] to compare, such as real pictures, for an input shape.

    Raises:
        InputError: The file cannot be read, uses what is not supported, computes something else elsewhere, or was
            replaced meanwhile.
    """
    path = Path(path)
    file_size(path, "network")
    name = path.name.lower()
    if not name.endswith((".onnx", PACKED)):
        raise InputError(f"has the ending {path.suffix!r}", file=path, fix=_instead(path))
    before = file_stamp(path)
    network = read_onnx(path, ReadRequest(output, vector, picture, layout == "NHWC", whole_numbers))
    network.stamp = network_stamp(network)
    run = onnx_runner(path, network.output, network.input_shape)
    usual, strange = probes(network)
    compare(network, run, usual)
    if shown is not None:
        strange = itertools.chain(shown(network.input_shape), strange)
    compare(network, run, strange, usual=False)
    if {**network.stamp, **before} != network.stamp:
        raise _replaced(path)
    require_unchanged(network)
    return network


def network_stamp(network: Network) -> dict[str, Any]:
    """Return ``name``, ``bytes`` and ``sha256`` of the network's file, and ``data``: sums of files with its constants.

    ``data`` is left out where the file holds all constants.

    Raises:
        InputError: A file is absent or cannot be read.
    """
    folder = network.source.resolve().parent
    data = {str(file.relative_to(folder)): file_stamp(file)["sha256"] for file in network.data}
    return {**file_stamp(network.source), **({"data": data} if data else {})}


def require_unchanged(network: Network) -> None:
    """Raise InputError where the network's files are others than those that were read."""
    if network_stamp(network) != network.stamp:
        raise _replaced(network.source)


def _replaced(path: Path) -> InputError:
    fix = "give a copy that nothing writes to"
    return InputError("was replaced while the command was at work", file=path, fix=fix)


def read_onnx(path: Path, request: ReadRequest | None = None) -> Network:
    """Return the network in an ONNX file, up to the requested output; nothing in it is executed.

    Raises:
        InputError: The file cannot be read, or uses what is not supported; names node, operator and attribute.
    """
    model = parse_model(path)
    refuse_lost_epsilons(model.graph, path)
    return OnnxReader(path, model.graph, operator_set(model, path), RULES, request or ReadRequest()).network()


def _instead(path: Path) -> str:
    """Return advice on a file that is not ONNX."""
    target = show(f"{path.stem}.onnx")
    if path.suffix.lower() == ".pt2":
        load = f"program = torch.export.load({show(path.name)})"
        return f"convert it in Python: {load}; torch.onnx.export(program, (), {target}, dynamo=True)"
    if path.suffix.lower() in (".pt", ".pth", ".ckpt"):
        return f"export the model in Python: torch.onnx.export(model.eval(), (images,), {target}, dynamo=True)"
    return "give an .onnx file"


def onnx_session(path: Path) -> onnxruntime.InferenceSession:
    """Return an onnxruntime session of a model on one thread; InputError if it refuses the file."""
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    packed = path.name.lower().endswith(PACKED)
    source = unpacked_model(path) if packed else str(path)
    try:
        return onnxruntime.InferenceSession(source, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise InputError(f"onnxruntime refuses it: {error}", file=path, fix="export the network again") from None


def onnx_runner(path: Path, output: str = "", shape: Sequence[int] | None = None) -> Evaluate:
    """Return a function that runs the model in onnxruntime on one image [1, ...] and returns one output, flattened.

    A model without a batch gets the image alone; one of a fixed batch, as many copies.

    Args:
        path, output: The model, and the name of the output; empty: the first.
        shape: One item of the network's input; None: the input is a vector or has a batch of 1.

    Raises:
        InputError: onnxruntime refuses the file.
    """
    session = onnx_session(path)
    wanted = session.get_inputs()[0]
    kind = _KINDS.get(wanted.type, np.float32)
    names = [output or session.get_outputs()[0].name]
    alone = len(wanted.shape) == (1 if shape is None else len(shape))
    first = wanted.shape[0] if wanted.shape else 1
    copies = first if not alone and isinstance(first, int) and first > 1 else 1

    def run(image: np.ndarray) -> np.ndarray:
        image = image[0] if alone else np.repeat(image, copies, 0)
        image = (levels(image) if kind is np.uint8 else image).astype(kind)
        output = np.asarray(session.run(names, {wanted.name: image})[0])
        return (output[0] if copies > 1 else output).reshape(-1)

    return run
