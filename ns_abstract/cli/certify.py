"""``ns-abstract-certify``: what a network does on every image of a set of poses."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ns_abstract.cli.commands import Certify
from ns_abstract.cli.common import DONE, INTERRUPTED, SignalStop, command, run
from ns_abstract.cli.sets import given_set
from ns_abstract.io.arguments import positive
from ns_abstract.io.errors import InputError


def certify(options: Certify) -> int:
    if options.time_budget is not None:
        positive(options.time_budget, "--time-budget")
    options.where.check()
    given_set(options)
    stop = SignalStop()
    with stop.installed():
        with stop.at_once():
            from ns_abstract.cli.searching import certify_path
        complete = certify_path(options, stop)
    return DONE if complete and not stop() else INTERRUPTED


@dataclass
class ExplainNetwork:
    """Print a network's layers, the memory of a cell, and the time of cells of a made-up picture, a minute at most."""

    model: Path
    """Network: .onnx."""
    explain: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Only this."""
    parameters: int = 2
    """How many parameters the poses will have."""
    output: str | None = None
    """Name of the network's output. Default: the only one."""


def explain(options: ExplainNetwork) -> int:
    """Print what a network consists of; returns the exit code."""
    from ns_abstract.execution.threads import use_threads
    from ns_abstract.verify.network.explain import explain as explained
    from ns_abstract.verify.network.load import load_network

    if not 0 <= options.parameters <= 64:
        raise InputError(f"found {options.parameters}", field="--parameters", fix="give a number from 0 to 64")
    network = load_network(options.model, output=options.output, whole_numbers=True)
    use_threads(1)
    for line in explained(network, options.parameters):
        print(line, flush=True)
    return DONE


def main() -> None:
    if "--explain" in sys.argv[1:]:
        run(explain, command("ns-abstract-certify", ExplainNetwork))
    run(certify, command("ns-abstract-certify", Certify), "give fewer --workers or free memory")


if __name__ == "__main__":
    main()
