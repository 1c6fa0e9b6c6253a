"""``ns-abstract-compare``: how far apart pictures of two scenes can be over sets of poses."""

from __future__ import annotations

from ns_abstract.cli.commands import Compare
from ns_abstract.cli.common import DONE, INTERRUPTED, SignalStop, command, run
from ns_abstract.cli.sets import given_set
from ns_abstract.io.errors import InputError


def compare(options: Compare) -> int:
    if options.seed < 0:
        raise InputError(f"found {options.seed}", field="--seed", fix="give a number of at least 0")
    options.where.check()
    given_set(options)
    stop = SignalStop()
    with stop.installed():
        with stop.at_once():
            from ns_abstract.cli.rendering import compare_path
        complete = compare_path(options, stop)
    return DONE if complete and not stop() else INTERRUPTED


def main() -> None:
    run(compare, command("ns-abstract-compare", Compare))


if __name__ == "__main__":
    main()
