"""``ns-abstract-bench``: cost, tightness and soundness, measured."""

from __future__ import annotations

import faulthandler
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from ns_abstract.cli.bench_options import (
    CellBenchmark,
    Certificates,
    Compile,
    Loops,
    PlanBenchmark,
    Rays,
    RulesBenchmark,
    ScaleBenchmark,
    Soundness,
    Stiff,
    Tightness,
    Verify,
    Vnnlib,
)
from ns_abstract.cli.common import BAD_INPUT, DONE, command, run
from ns_abstract.cli.sets import ProgramOptions
from ns_abstract.io.errors import InputError

if TYPE_CHECKING:
    from ns_abstract.api.files import PathJob

#: Seconds after which a case that does not end ends the process, with a trace of where it stands.
_STUCK = 900.0
_ABOUT = "Measure cost, tightness and soundness; without options on the demo scene. Tables go to the folder bench."
#: Headings of the tables by benchmark.
_TITLES = {
    "cell": "Cost of a cell",
    "compile": "Seconds of compiling",
    "tightness": "Error against run time",
    "soundness": "Soundness",
    "plan": "What is left out, taken back",
    "rules": "Our bounds and the paper's rules",
    "rays": "Rays of a NeRF",
    "certificates": "Certified fraction against time",
    "loops": "A network in the loop: certified fraction against time",
}


def _said(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _check_positive(options: dict[str, float | None]) -> None:
    for name, value in options.items():
        if value is not None and not 0.0 < value <= 1e6:
            raise InputError(f"{value}", field=name, fix="give a positive number")


def vnnlib(options: Vnnlib) -> int:
    """Decide the instances; the exit code is 2 if a file could not be used."""
    from ns_abstract.bench.vnnlib import run_folder
    from ns_abstract.io.errors import visible

    _check_positive({"--seconds": options.seconds, "--memory-limit": options.memory_limit})
    words: dict[str, int] = {}
    for row in run_folder(
        options.folder,
        options.output_dir,
        only=options.only,
        seconds=options.seconds,
        memory=int(options.memory_limit * 2**30),
        arithmetic=options.network_arithmetic,
        output=options.output,
    ):
        words[row["verdict"]] = words.get(row["verdict"], 0) + 1
        names = visible(f"{row['network']} {row['property']}")
        print(f"{row['verdict']:8s} {row['seconds']:8.2f} s {row['boxes']:6d} boxes  {names}", flush=True)
        if row["why"]:
            print(f"error: {row['why']}", file=sys.stderr)
    print(", ".join(f"{count} {word}" for word, count in sorted(words.items())))
    return BAD_INPUT if "error" in words else DONE


def verify(options: Verify) -> int:
    """Decide the query and print the standard's answer."""
    from ns_abstract.bench.vnnlib import verify_query

    _check_positive({"--timeout": options.timeout, "--memory-limit": options.memory_limit})
    networks = {}
    for entry in options.network:
        name, equals, file = entry.partition("=")
        if not (name and equals and file) or name in networks:
            raise InputError(f"found {entry}", field="--network", fix="write NAME=FILE.onnx once for every network")
        networks[name] = Path(file)
    answer = verify_query(
        options.query, networks, seconds=options.timeout, memory=int(options.memory_limit * 2**30),
        arithmetic=options.network_arithmetic, output=options.output,
    )  # fmt: skip
    print(answer, end="")
    return DONE


def stiff(options: Stiff) -> int:
    """Run the stiff cases; the exit code is 1 if a bound was broken or a number was not finite."""
    from ns_abstract.bench.stiff import compare, run_case
    from ns_abstract.bench.stiff_cases import all_cases
    from ns_abstract.bench.tables import Table, markdown, write

    cases = [c for c in all_cases() if not options.cases or any(part in c.name for part in options.cases)]
    if not cases:
        raise InputError(
            f"no case has {' or '.join(options.cases)} in its name",
            field="--cases",
            fix="give parts of names, such as needles, or leave the option out",
        )
    # a case that never ends must not take the others' rows with it
    table, failed = Table(options.output_dir, "stiff", "Stiff and extreme cases"), 0
    for case in cases:
        for kind in options.arithmetics:
            faulthandler.dump_traceback_later(_STUCK, exit=True, file=2)
            try:
                outcome = run_case(
                    case,
                    kind,
                    cells=options.cells,
                    seconds=options.seconds,
                    poses=options.poses,
                    reference_poses=options.reference_poses,
                    seed=options.seed,
                )
            finally:
                faulthandler.cancel_dump_traceback_later()
            table.add(outcome.row)
            failed += outcome.failed
            for violation in outcome.worst[:1]:
                print(f"  {violation}", flush=True)
    if options.compare and (differences := compare(table.rows)):
        write(differences, options.output_dir, "stiff-compare", "Float32 against real arithmetic")
        print(markdown(differences))
    total = sum(row["comparisons"] for row in table.rows)
    violations = sum(row["violations"] for row in table.rows)
    print(f"{len(table.rows)} runs, {failed} failed: {total:,} comparisons, {violations:,} violations")
    return 1 if failed else DONE


def scale(options: ScaleBenchmark) -> int:
    """Measure how cost grows; the table and the picture are written after every row."""
    from ns_abstract.bench.scale import curve
    from ns_abstract.bench.tables import Table, plot_scaling

    if len(options.load_config) != 1:
        problem = f"found {len(options.load_config)} runs"
        raise InputError(problem, field="--load-config", fix="give one run, whose Gaussians are resampled")
    table = Table(options.output_dir, "scale", "Cost against Gaussians and pixels")
    for row in curve(
        options.load_config[0], options.camera_path_filename, options.frame, options.set, options.gaussians,
        options.widths, options.repeats, options.seconds, options.memory_limit, options.gsplat_version,
        options.overrides,
    ):  # fmt: skip
        table.add(row)
        plot_scaling(options.output_dir / "scale.png", table.rows)
    return DONE


def certificates(options: Certificates) -> int:
    """Measure how fast sets are certified; the table is written after every row."""
    from ns_abstract.api.scenes import SceneSource
    from ns_abstract.bench.loops import SETS, curve
    from ns_abstract.bench.tables import Table
    from ns_abstract.geometry.camera_path import load_camera_path

    if len(options.load_config) != 1 or options.model is None or options.property is None:
        field = "--load-config, --model, --property"
        raise InputError("missing, or several runs", field=field, fix="give one run, a network and a property")
    file = options.camera_path_filename or options.load_config[0].resolve().parents[2] / "camera_path.json"
    path, scene = (
        load_camera_path(file, options.downscale_factor),
        SceneSource(options.load_config[0], overrides=options.overrides).open(),
    )
    sets = SETS if path.perturbations[options.frame] is None else {**SETS, "path": path.perturbations[options.frame]}
    for name in options.sets:
        if name not in sets:
            raise InputError(f"found {name}", field="--sets", fix=f"the sets are {', '.join(sets)}")
    table = Table(options.output_dir, "certificates", _TITLES["certificates"])
    for name in options.sets:
        marks = [mark for mark in options.marks if mark <= options.seconds]
        table.add(
            curve(
                scene, path.cameras[options.frame], name, sets[name], options.model, options.property, options.seconds,
                options.workers, marks, _said, path.following(options.frame),
            )
        )  # fmt: skip
    return DONE


def loops(options: Loops) -> int:
    """Measure a loop; the exit code is 1 if a run left a tube or a certified cell had a run that went wrong."""
    from ns_abstract.api.scenes import SceneSource
    from ns_abstract.bench.loops import measure
    from ns_abstract.bench.tables import markdown, write

    if options.runs < 1:
        raise InputError(f"found {options.runs}", field="--runs", fix="give a number of at least 1")
    marks = [mark for mark in options.marks if mark <= options.seconds]
    tables = measure(
        SceneSource(options.load_config, overrides=options.overrides).open(), options.loop, options.seconds,
        options.workers, options.runs, marks,
        options.seed, _said,
    )  # fmt: skip
    for name, rows in (("loops", tables.search), ("loops-steps", tables.steps)):
        if rows:
            write(rows, options.output_dir, name, _TITLES["loops"] if name == "loops" else "Widths by step")
            print(markdown(rows))
    return 1 if tables.search[0]["violations"] else DONE


def rows_of(
    options: CellBenchmark | Compile | Soundness | PlanBenchmark | RulesBenchmark | Rays, job: PathJob, name: str
) -> list[dict[str, Any]]:
    """Return the rows of a benchmark without curves for one scene and set of poses."""
    if isinstance(options, CellBenchmark):
        from ns_abstract.bench.scale import cell_cost

        return [cell_cost(job, name, options.frame, options.repeats)]
    if isinstance(options, Compile):
        from ns_abstract.bench.compiling import compile_times

        return compile_times(job, name, options.frame)
    if isinstance(options, Soundness):
        from ns_abstract.bench.tightness import attack

        return [
            attack(
                job, name, options.frame, options.seconds, options.poses, options.reference_poses, options.seed,
                options.scale, options.target_ratio,
            )
        ]  # fmt: skip
    if isinstance(options, PlanBenchmark):
        from ns_abstract.bench.plan import cost_of_omissions

        return cost_of_omissions(job, name, options.frame, options.cells, options.scale)
    if isinstance(options, Rays):
        from ns_abstract.bench.rays import measure

        return [
            measure(
                job, name, options.frame, options.scale, rays=options.rays, ratio=options.target_ratio,
                seconds=options.seconds, poses=options.poses, seed=options.seed,
            )
        ]  # fmt: skip
    from ns_abstract.bench.rules import compare

    return [
        row
        for parts in options.parts
        for row in compare(job, name, options.frame, parts, options.pixels, options.gaussians, options.seed)
    ]


#: The benchmarks by the name that the command line gives them, with their options where none is given.
_DEFAULTS: dict[str, Any] = {
    "cell": CellBenchmark(),
    "compile": Compile(),
    "tightness": Tightness(),
    "soundness": Soundness(),
    "plan": PlanBenchmark(),
    "rules": RulesBenchmark(),
    "rays": Rays(),
    "scale": ScaleBenchmark(),
    "certificates": Certificates(),
    "loops": Loops(load_config=tyro.MISSING, loop=tyro.MISSING),
    "stiff": Stiff(),
    "vnnlib": Vnnlib(folder=tyro.MISSING),
    "verify": Verify(query=tyro.MISSING),
}


#: Benchmarks that say themselves what they measure.
_ALONE: dict[type, Callable[[Any], int]] = {
    Vnnlib: vnnlib, Verify: verify, Stiff: stiff, ScaleBenchmark: scale, Certificates: certificates, Loops: loops,
}  # fmt: skip


def bench(options: Any) -> int:
    """Run one benchmark, chosen by the type of its options; the exit code is 1 if a bound was violated."""
    if type(options) in _ALONE:
        return _ALONE[type(options)](options)
    from ns_abstract.bench import paper
    from ns_abstract.bench.sets import open_jobs, pose_set
    from ns_abstract.bench.tables import Table, write

    program = ProgramOptions(
        gsplat_version=options.gsplat_version,
        occupancy_grid=options.occupancy_grid if isinstance(options, Rays | Tightness) else None,
        device=options.device if isinstance(options, Rays) else None,
    )
    jobs = open_jobs(
        options.load_config, options.camera_path_filename, options.downscale_factor, None, program, options.overrides
    )
    kind = next(name for name, default in _DEFAULTS.items() if type(default) is type(options))
    table = Table(options.output_dir, kind, _TITLES[kind])
    tables: dict[int, list[dict[str, Any]]] = {}
    results = {}
    for job in jobs:
        for name in options.sets:
            if isinstance(options, Tightness):
                from ns_abstract.bench.tightness import refine, summary

                poses = pose_set(job, name, options.frame, options.scale)
                result = refine(job, poses, options.frame, options.seconds, options.target_ratio)
                results[f"{job.method.name} {name}"] = result
                table.add(summary(job, name, result))
                tables.setdefault(paper.table_of(poses), []).append(paper.ours(job, name, poses, result))
            else:
                table.add(*rows_of(options, job, name))
    if results:
        from ns_abstract.bench.tables import save_curves

        save_curves(options.output_dir / "tightness.png", results)
    for number, ours in tables.items():
        write(
            [{"by": "ns-abstract", **row} for row in ours] + [{"by": "paper", **row} for row in paper.TABLES[number]],
            options.output_dir,
            f"table-{number}",
            f"Beside the paper's Table {number}",
        )
    violations = sum(int(str(row.get("violations", 0))) for row in table.rows)
    if isinstance(options, Soundness | Rays):
        total = sum(int(str(row["comparisons"])) for row in table.rows)
        print(f"{total:,} comparisons, {violations} violations")
    return 1 if violations else DONE


def main() -> None:
    """Run the console script."""
    kinds = tyro.extras.subcommand_type_from_defaults(_DEFAULTS)
    run(bench, command("ns-abstract-bench", kinds, _DEFAULTS, _ABOUT))


if __name__ == "__main__":
    main()
