"""Read an ONNX file into a network; nothing in it is executed, and unsupported operators are refused."""

from __future__ import annotations

from pathlib import Path

from ns_abstract.verify.network.graph import Network
from ns_abstract.verify.network.onnx_epsilons import refuse_lost_epsilons
from ns_abstract.verify.network.onnx_graph import OnnxReader, ReadRequest, operator_set
from ns_abstract.verify.network.onnx_rules import RULES
from ns_abstract.verify.network.onnx_tensors import parse_model


def read_onnx(path: Path, asked: ReadRequest | None = None) -> Network:
    """The network in an ONNX file, up to the output that is asked for.

    Raises:
        InputError: The file cannot be read, or uses what is not supported; names node, operator and attribute.
    """
    model = parse_model(path)
    refuse_lost_epsilons(model.graph, path)
    return OnnxReader(path, model.graph, operator_set(model, path), RULES, asked or ReadRequest()).network()
