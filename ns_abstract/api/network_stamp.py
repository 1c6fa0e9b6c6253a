"""Identity of a network by the content of its files."""

from __future__ import annotations

from typing import Any

from ns_abstract.verify.network.graph import Network


def network_prints(name: str, network: Network) -> dict[str, Any]:
    """Return the fingerprint of a network that a search calls ``name``: its files as they were read."""
    stamp = network.stamp
    return {name: stamp["sha256"], **({f"{name}_data": stamp["data"]} if "data" in stamp else {})}
