"""``ns-abstract-render``: abstract images of a camera path."""

from __future__ import annotations

from dataclasses import replace

from ns_abstract.cli.commands import Render
from ns_abstract.cli.common import DONE, INTERRUPTED, SignalStop, command, run
from ns_abstract.cli.sets import given_set
from ns_abstract.io.arguments import at_least, positive, whole
from ns_abstract.io.errors import InputError

#: Seconds by frame where --explain is given none.
_EXPLAINED_S = 30.0


def explain(options: Render) -> int:
    """Bound and explain frame by frame; returns the exit code."""
    from ns_abstract.api.bounding import bound_frames
    from ns_abstract.api.explaining import check_explained
    from ns_abstract.api.explaining import explain as explained
    from ns_abstract.api.files import open_job
    from ns_abstract.api.job import check_frames
    from ns_abstract.execution.engines import SerialEngine

    job = open_job(replace(options.settings, workers=1))
    check_explained(job)
    frames = check_frames(options.frames, job.frame_count)
    stop = SignalStop()
    with stop.installed():
        results = bound_frames(
            job, frames, engine=SerialEngine(), budget=options.time_budget or _EXPLAINED_S * len(frames),
            target_ratio=options.target_ratio, keep_leaves=True, stop=stop,
        )  # fmt: skip
        for result in results:
            for line in explained(job, result.index, result, options.seed).lines():
                print(line, flush=True)
    return INTERRUPTED if stop() else DONE


def describe(options: Render) -> int:
    """Print what is about to be bounded; returns the exit code."""
    from ns_abstract.api.describe import describe as described
    from ns_abstract.api.files import open_job
    from ns_abstract.api.job import check_frames
    from ns_abstract.io.errors import visible
    from ns_abstract.perturbation.specification import Perturbation

    # a path that says nothing of a set is looked at all the same
    job = open_job(replace(options.settings, workers=1), default=Perturbation())
    for line in described(job, check_frames(options.frames, job.frame_count)):
        print(visible(line))
    return DONE


def render(options: Render) -> int:
    if options.describe:
        return describe(options)
    if options.output_dir is None:
        if options.explain:
            return explain(options)
        raise InputError("missing --output-dir", fix="--help lists the options")
    if options.time_budget is not None:
        positive(options.time_budget, "--time-budget")
    at_least(options.target_ratio, 1, "--target-ratio")
    whole(options.seed, 0, "--seed")
    options.where.check()
    given_set(options)
    stop = SignalStop()
    with stop.installed():
        with stop.at_once():
            from ns_abstract.cli.rendering import render_path
        complete = render_path(options, stop)
    return DONE if complete and not stop() else INTERRUPTED


def main() -> None:
    run(render, command("ns-abstract-render", Render))


if __name__ == "__main__":
    main()
