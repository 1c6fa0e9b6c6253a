"""``ns-abstract-locate``: which poses of a set can have made a photo."""

from __future__ import annotations

from ns_abstract.cli.commands import Locate
from ns_abstract.cli.common import DONE, INTERRUPTED, SignalStop, command, run
from ns_abstract.cli.sets import given_set
from ns_abstract.io.errors import InputError


def locate(options: Locate) -> int:
    if options.time_budget is not None and not 0.0 < options.time_budget < float("inf"):
        raise InputError(f"found {options.time_budget}", field="--time-budget", fix="give a positive number")
    options.where.check()
    given_set(options)
    stop = SignalStop()
    with stop.installed():
        with stop.at_once():
            from ns_abstract.cli.searching import locate_photos
        locate_photos(options, stop)
    return INTERRUPTED if stop() else DONE


def main() -> None:
    run(locate, command("ns-abstract-locate", Locate), "give fewer --workers or free memory")


if __name__ == "__main__":
    main()
