"""Loading a network from a file, and comparing it with another program that reads the same file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import onnxruntime
import torch

from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import file_size
from ns_abstract.verify.network.exported import read_exported
from ns_abstract.verify.network.graph import Network
from ns_abstract.verify.network.onnx_file import read_onnx
from ns_abstract.verify.network.onnx_graph import Asked
from ns_abstract.verify.network.onnx_tensors import PACKED, unpacked_model

#: A reading that differs more than this, relative to the largest output, is wrong and not rounded.
_DIFFERENCE = 2.0**-10




def load_network(
    path: Path,
    *,
    vector: bool = False,
    output: str | None = None,
    picture: tuple[int, int] | None = None,
    layout: str = "NCHW",
) -> Network:
    """The network in an .onnx, .onnx.gz or .pt2 file, compared with the program that usually runs such a file.

    Args:
        path: The file.
        vector: Whether an .onnx file's input may be a vector [n], without a batch.
        output: Name of the output that is read; None: the only one.
        picture: Height and width of pictures, used where the file leaves them free.
        layout: "NCHW" or "NHWC", of such pictures.

    Raises:
        InputError: The file cannot be read, uses what is not supported, or computes something else elsewhere.
    """
    path = Path(path)
    file_size(path, "network")
    name = path.name.lower()
    if name.endswith((".onnx", PACKED)):
        network = read_onnx(path, Asked(output, vector, picture, layout == "NHWC"))
        run = onnx_runner(path, network.output, network.input_shape)
    elif name.endswith(".pt2"):
        network, run = read_exported(path, output)
    else:
        raise InputError(
            f"has the ending {path.suffix!r}", file=path, fix="give an .onnx file or a .pt2 file of torch.export"
        )
    compare(network, run)
    return network


def onnx_session(path: Path) -> onnxruntime.InferenceSession:
    """onnxruntime's session of a model on one thread.

    Raises:
        InputError: onnxruntime refuses the file.
    """
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    packed = path.name.lower().endswith(PACKED)
    source = unpacked_model(path) if packed else str(path)
    try:
        return onnxruntime.InferenceSession(source, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise InputError(f"onnxruntime refuses it: {error}", file=path, fix="export the network again") from None


def onnx_runner(path: Path, output: str = "", shape: Sequence[int] | None = None) -> Callable[[np.ndarray], np.ndarray]:
    """Runs the model in onnxruntime on one image [1, ...] in the type that it wants; returns one output, flattened.

    A model without a batch is given the image alone; one of a fixed batch, as many copies.

    Args:
        path: The model.
        output: Name of the output; empty: the first.
        shape: One item of the network's input; None: the input is a vector or has a batch of 1.

    Raises:
        InputError: onnxruntime refuses the file.
    """
    session = onnx_session(path)
    wanted = session.get_inputs()[0]
    kind = np.float64 if wanted.type == "tensor(double)" else np.float32
    names = [output or session.get_outputs()[0].name]
    alone = len(wanted.shape) == (1 if shape is None else len(shape))
    first = wanted.shape[0] if wanted.shape else 1
    copies = first if not alone and isinstance(first, int) and first > 1 else 1

    def run(image: np.ndarray) -> np.ndarray:
        image = (image[0] if alone else np.repeat(image, copies, 0)).astype(kind)
        found = np.asarray(session.run(names, {wanted.name: image})[0])
        return (found[0] if copies > 1 else found).reshape(-1)

    return run


def compare(network: Network, run: Callable[[np.ndarray], np.ndarray]) -> None:
    """Refuse a network whose reading gives other numbers than the program that runs the file.

    Raises:
        InputError: They differ by more than rounding.
    """
    path = network.source
    generator = np.random.default_rng(0)
    for k in range(3):
        image = generator.uniform(0.0, 1.0 + k, (1, *network.input_shape)).astype(np.float32)
        try:
            expected = run(image).reshape(-1).astype(np.float64)
        except Exception as error:  # the other program's own
            raise InputError(f"cannot be run: {error}", file=path, fix="export the network again") from None
        found = network(torch.from_numpy(image).double())[0].numpy()
        if expected.shape != found.shape:
            raise InputError(f"has {expected.size} outputs when run, {found.size} when read", file=path)
        if not np.isfinite(expected).all():
            raise InputError("computes numbers that are not finite", file=path, fix="train the network again")
        difference = float(np.abs(expected - found).max())
        if not difference <= _DIFFERENCE * max(1.0, float(np.abs(expected).max())):
            raise InputError(
                f"computes something else when run: outputs differ by {difference:.3g}",
                file=path,
                fix="export the network again in evaluation mode, or report the file",
            )
