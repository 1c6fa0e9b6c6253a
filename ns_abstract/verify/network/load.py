"""Loading a network from a file, and comparing it with another program that reads the same file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnxruntime
import torch

from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import file_size
from ns_abstract.verify.network.exported import read_exported
from ns_abstract.verify.network.graph import Network
from ns_abstract.verify.network.onnx_file import read_onnx

#: A reading that differs more than this, relative to the largest output, is wrong and not rounded.
_DIFFERENCE = 2.0**-10
_IMAGES = 3


def load_network(path: Path, *, vector: bool = False) -> Network:
    """The network in an .onnx or a .pt2 file, compared with the program that usually runs such a file.

    Args:
        path: The file.
        vector: Whether an .onnx file's input may be a vector [n], without a batch.

    Raises:
        InputError: The file cannot be read, uses what is not supported, or computes something else elsewhere.
    """
    path = Path(path)
    file_size(path, "network")
    if path.suffix == ".onnx":
        network = read_onnx(path, vector=vector)
        run = onnx_runner(path)
    elif path.suffix == ".pt2":
        network, run = read_exported(path)
    else:
        raise InputError(
            f"has the ending {path.suffix!r}", file=path, fix="give an .onnx file or a .pt2 file of torch.export"
        )
    generator = np.random.default_rng(0)
    for k in range(_IMAGES):
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
    return network


def onnx_runner(path: Path) -> Callable[[np.ndarray], np.ndarray]:
    """Runs the model in onnxruntime on one image [1, ...] in the type that it wants; all outputs one after another.

    A model of vectors [n] is given one.

    Raises:
        InputError: onnxruntime refuses the file.
    """
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        wanted = session.get_inputs()[0]
    except Exception as error:
        raise InputError(f"onnxruntime refuses it: {error}", file=path, fix="export the network again") from None
    kind = np.float64 if wanted.type == "tensor(double)" else np.float32
    vector = len(wanted.shape) == 1

    def run(image: np.ndarray) -> np.ndarray:
        image = (image.reshape(-1) if vector else image).astype(kind)
        found = session.run(None, {wanted.name: image})
        return np.concatenate([np.asarray(output).reshape(-1) for output in found])

    return run
