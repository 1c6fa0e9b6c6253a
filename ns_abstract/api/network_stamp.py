"""Identity of a network by the content of its files."""

from __future__ import annotations

from typing import Any

from ns_abstract.report.run import file_stamp
from ns_abstract.verify.network.graph import Network


def network_stamp(network: Network) -> dict[str, Any]:
    """``name``, ``bytes`` and ``sha256`` of the network's file; ``data``: sums of files beside it with its constants.

    ``data`` is left out where the file holds all constants.

    Raises:
        InputError: A file is absent or cannot be read.
    """
    folder = network.source.resolve().parent
    data = {str(file.relative_to(folder)): file_stamp(file)["sha256"] for file in network.data}
    return {**file_stamp(network.source), **({"data": data} if data else {})}


def network_prints(name: str, network: Network) -> dict[str, Any]:
    """What a stored search must agree with on a network that it calls ``name``.

    Raises:
        InputError: A file is absent or cannot be read.
    """
    stamp = network_stamp(network)
    return {name: stamp["sha256"], **({f"{name}_data": stamp["data"]} if "data" in stamp else {})}
