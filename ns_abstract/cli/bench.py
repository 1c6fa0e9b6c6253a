"""``ns-abstract-bench``: cost, tightness and soundness, measured."""

from __future__ import annotations

import faulthandler
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from ns_abstract.cli.common import BAD_INPUT, DONE, command, run
from ns_abstract.cli.options import Overrides, ProgramOptions, SceneOverrides
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


@dataclass
class SceneBenchmark:
    """What is measured."""

    load_config: tuple[Path, ...] = ()
    """Runs (config.yml or .ply). Default: the demo scene."""
    camera_path_filename: Path | None = None
    """Default: camera_path.json in the folder that holds the method's folder."""
    output_dir: Path = Path("bench")
    """Folder for tables and curves."""
    frame: int = 0
    """Entry of the camera path."""
    downscale_factor: float = 1.0
    """Images become this many times smaller."""
    gsplat_version: Literal["1.4.0", "1.5.3", "1.6.0"] | None = None
    """Splats: whose rules are bounded. Default: 1.4.0."""
    overrides: SceneOverrides = field(default_factory=Overrides)


@dataclass
class CellBenchmark(SceneBenchmark):
    """What one bounded cell costs in units of the concrete render of the same view."""

    sets: tuple[str, ...] = ("x",)
    """Sets of poses: x, yaw, roll, six, segments, orbit, point."""
    repeats: int = 15
    """Times that everything is measured."""


@dataclass
class Compile(SceneBenchmark):
    """What compiling costs at first use, by kernel: seconds by the clock, of the processor, and inside LLVM."""

    sets: tuple[str, ...] = ("x",)
    """Sets of poses: x, yaw, roll, six, segments, orbit, point."""


@dataclass
class Tightness(SceneBenchmark):
    """Error against run time: ratio of outer to inner gap, with curves."""

    sets: tuple[str, ...] = ("x", "yaw")
    """Sets: x, yaw, roll, six, segments, orbit, point; mean, opacity, color of a splat; hue, saturation of a NeRF."""
    seconds: float = 60.0
    """Time for every scene and set."""
    target_ratio: float = 1.01
    """Where a set is tight enough."""
    occupancy_grid: Path | None = None
    """Declare the fields of a NeRF empty outside of this grid's occupied voxels."""
    scale: float = 1.0
    """Multiplies the ranges of translations and rotations."""


@dataclass
class Soundness(SceneBenchmark):
    """Attack abstract images by random poses, corners, gradient ascent and threshold jumps."""

    sets: tuple[str, ...] = ("x", "yaw", "roll", "six", "segments", "orbit")
    """Sets of poses: x, yaw, roll, six, segments, orbit, point."""
    seconds: float = 10.0
    """Time for bounding every scene and set."""
    poses: int = 200
    """Images by the compiled renderer for every scene and set."""
    reference_poses: int = 20
    """Images by the independent reference."""
    target_ratio: float = 1.0
    """Where a set is tight enough; from 1.05 on, a first cover leaves out what hardly any light comes to."""
    scale: float = 1.0
    """Multiplies the ranges of translations and rotations."""
    seed: int = 0
    """Decides every random choice."""


@dataclass
class PlanBenchmark(SceneBenchmark):
    """Take back, one by one, what a scene's plan leaves out: what it costs, and how bounds differ."""

    sets: tuple[str, ...] = ("x", "yaw")
    """Sets of poses: x, yaw, roll, six, segments, orbit, point."""
    cells: int = 24
    """Cells that every scene and set is bounded with."""
    scale: float = 1.0
    """Multiplies the ranges of translations and rotations."""


@dataclass
class RulesBenchmark(SceneBenchmark):
    """Our bounds against the paper's rules, on the same Gaussians, pixels and cells."""

    sets: tuple[str, ...] = ("x", "yaw")
    """Sets of poses: x, yaw, roll, six, segments, orbit, point."""
    parts: tuple[int, ...] = (8, 64)
    """Cells by axis that a set is cut into; the middle one is bounded."""
    pixels: int = 8
    """Pixels for every scene, set and cell."""
    gaussians: int = 30
    """Most Gaussians by pixel."""
    seed: int = 0
    """Decides every random choice."""


@dataclass
class Rays(SceneBenchmark):
    """Random rays of a NeRF: CPU seconds by ray to a ratio, then attacks on the bounds."""

    sets: tuple[str, ...] = ("yaw",)
    """Sets of poses: x, yaw, roll, six, segments, orbit, point."""
    rays: int = 20
    """Number of rays."""
    target_ratio: float = 1.1
    """Where the rays are tight enough."""
    seconds: float = 600.0
    """Time for every scene and set."""
    poses: int = 200
    """Poses of the attacks, beside gradient ascent."""
    occupancy_grid: Path | None = None
    """Declare the fields empty outside of this grid's occupied voxels."""
    device: Literal["cpu", "cuda"] | None = None
    """cuda: bound the field on a GPU. Default: cpu."""
    scale: float = 1.0
    """Multiplies the ranges of translations and rotations."""
    seed: int = 0
    """Decides every random choice."""


@dataclass
class ScaleBenchmark(SceneBenchmark):
    """Cost and peak memory of a cell, by number of Gaussians (the scene is resampled) and size of the picture."""

    set: str = "x"
    """Set of poses; wider pictures have proportionally smaller ones."""
    gaussians: tuple[int, ...] = (10_000, 30_000, 100_000, 300_000, 1_000_000)
    """Numbers of Gaussians."""
    widths: tuple[int, ...] = (100, 200, 400, 800)
    """Widths of pictures in pixels."""
    repeats: int = 3
    """Times that everything is measured."""
    seconds: float = 120.0
    """Refinement of the last, largest case."""
    memory_limit: float = 8.0
    """GiB that refinement plans with."""


@dataclass
class Certificates(SceneBenchmark):
    """Certified fraction against time, by set of poses."""

    model: Path | None = None
    """Network, .onnx."""
    property: Path | None = None
    """What is to hold (JSON)."""
    sets: tuple[str, ...] = ("xyz",)
    """Sets of poses: x, xyz, xyz-small, six, six-wide; path: what the camera path says."""
    seconds: float = 120.0
    """Time for every set."""
    workers: int = 2
    """Processes."""
    marks: tuple[float, ...] = (30.0, 60.0, 120.0, 300.0, 600.0)
    """Seconds at which the certified fraction is told, up to the time that there is."""


@dataclass
class Loops:
    """A network in the loop: certified fraction against time, tubes against runs, attacks on tubes."""

    load_config: Path
    """Run (config.yml or .ply)."""
    loop: Path
    """LOOP.json."""
    output_dir: Path = Path("bench")
    """Folder for the tables."""
    seconds: float = 120.0
    """Time for the search."""
    workers: int = 2
    """Processes."""
    runs: int = 10_000
    """Simulated runs from the whole initial box, and from one certified cell."""
    marks: tuple[float, ...] = (30.0, 60.0, 120.0, 300.0, 600.0)
    """Seconds at which the certified fraction is told, up to the time that there is."""
    seed: int = 0
    """Decides every random choice."""
    overrides: SceneOverrides = field(default_factory=Overrides)


@dataclass
class Stiff:
    """Bound and attack tiny scenes at the ends of what can be loaded and asked."""

    output_dir: Path = Path("bench")
    """Folder for the tables."""
    cases: tuple[str, ...] = ()
    """Parts of the names of the cases to run. Default: all cases."""
    arithmetics: tuple[Literal["float32", "real"], ...] = ("float32", "real")
    """What is bounded: float32, real."""
    cells: int = 16
    """Most cells bounded for every case."""
    seconds: float = 20.0
    """Limit of the refinement and of every attack."""
    poses: int = 60
    """Images by the compiled renderer for every case."""
    reference_poses: int = 16
    """Images by each reference."""
    compare: bool = False
    """Also write what float32 costs against real arithmetic."""
    seed: int = 0
    """Decides every random choice."""


@dataclass
class Vnnlib:
    """Decide instances of a verification competition: networks and VNN-LIB properties with boxes of inputs."""

    folder: tyro.conf.Positional[Path]
    """Holds instances.csv (network,property,seconds) and what it names, packed (.gz) or not, or 2.0 or 1.0 that do."""
    output_dir: Path = Path("bench")
    """Folder for results.csv, and for each instance the verdict and a counterexample."""
    only: tuple[str, ...] = ()
    """Parts of the names of networks or properties. Default: all instances."""
    seconds: float | None = None
    """Limit for every instance beside that of the list."""
    memory_limit: float = 2.0
    """GiB that bounds may take."""
    network_arithmetic: Literal["float32", "real"] = "float32"
    """What "unsat" covers: every float32 evaluation and the exact network, or the exact network alone."""
    output: str | None = None
    """Name of the networks' output. Default: the only one."""


@dataclass
class Verify:
    """Decide one VNN-LIB query, as the standard's command "verify" does: its answer alone is printed."""

    query: tyro.conf.Positional[Path]
    """The query (.vnnlib), of version 1 or 2, packed (.gz) or not."""
    network: tuple[str, ...] = ()
    """NAME=FILE.onnx: the file of the network that the query calls NAME."""
    timeout: float | None = None
    """Seconds. Default: no limit."""
    memory_limit: float = 2.0
    """GiB that bounds may take."""
    network_arithmetic: Literal["float32", "real"] = "float32"
    """What "unsat" covers: every float32 evaluation and the exact network, or the exact network alone."""
    output: str | None = None
    """Name of the network's output. Default: the only one."""


def _said(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def vnnlib(options: Vnnlib) -> int:
    """Decide the instances; the exit code is 2 if a file could not be used."""
    from ns_abstract.bench.vnnlib import run_folder
    from ns_abstract.io.errors import visible

    for name, value in (("--seconds", options.seconds), ("--memory-limit", options.memory_limit)):
        if value is not None and not 0.0 < value <= 1e6:
            raise InputError(f"{value}", field=name, fix="give a positive number")
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

    for name, value in (("--timeout", options.timeout), ("--memory-limit", options.memory_limit)):
        if value is not None and not 0.0 < value <= 1e6:
            raise InputError(f"{value}", field=name, fix="give a positive number")
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
    from ns_abstract.bench.stiff import all_cases, compare, run_case
    from ns_abstract.bench.tables import markdown, write

    cases = [c for c in all_cases() if not options.cases or any(part in c.name for part in options.cases)]
    if not cases:
        raise InputError(
            f"no case has {' or '.join(options.cases)} in its name",
            field="--cases",
            fix="give parts of names, such as needles, or leave the option out",
        )
    rows: list[dict[str, Any]] = []
    failed = 0
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
            rows.append(outcome.row)
            failed += outcome.failed
            # a case that never ends must not take the others' rows with it
            write(rows, options.output_dir, "stiff", "Stiff and extreme cases")
            print(markdown(rows[-1:]) if len(rows) == 1 else markdown(rows[-1:]).splitlines()[2], flush=True)
            for violation in outcome.worst[:1]:
                print(f"  {violation}", flush=True)
    if options.compare and (differences := compare(rows)):
        write(differences, options.output_dir, "stiff-compare", "Float32 against real arithmetic")
        print(markdown(differences))
    total = sum(row["comparisons"] for row in rows)
    violations = sum(row["violations"] for row in rows)
    print(f"{len(rows)} runs, {failed} failed: {total:,} comparisons, {violations:,} violations")
    return 1 if failed else DONE


def scale(options: ScaleBenchmark) -> int:
    """Measure how cost grows; the table and the picture are written after every row."""
    from ns_abstract.bench.plots import save_scale
    from ns_abstract.bench.scale import curve
    from ns_abstract.bench.tables import markdown, write

    if len(options.load_config) != 1:
        problem = f"found {len(options.load_config)} runs"
        raise InputError(problem, field="--load-config", fix="give one run, whose Gaussians are resampled")
    rows: list[dict[str, Any]] = []
    for row in curve(
        options.load_config[0], options.camera_path_filename, options.frame, options.set, options.gaussians,
        options.widths, options.repeats, options.seconds, options.memory_limit, options.gsplat_version,
        options.overrides,
    ):  # fmt: skip
        rows.append(row)
        print("\n".join(markdown([row]).splitlines()[0 if len(rows) == 1 else 2 :]), flush=True)
        write(rows, options.output_dir, "scale", "Cost against Gaussians and pixels")
        save_scale(options.output_dir / "scale.png", rows)
    return DONE


def certificates(options: Certificates) -> int:
    """Measure how fast sets are certified; the table is written after every row."""
    from ns_abstract.api.scenes import SceneSource
    from ns_abstract.bench.certificates import SETS, curve
    from ns_abstract.bench.tables import markdown, write
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
    rows: list[dict[str, Any]] = []
    for name in options.sets:
        marks = [mark for mark in options.marks if mark <= options.seconds]
        rows.append(
            curve(
                scene, path.cameras[options.frame], name, sets[name], options.model, options.property, options.seconds,
                options.workers, marks, _said, path.following(options.frame),
            )
        )  # fmt: skip
        print("\n".join(markdown([rows[-1]]).splitlines()[0 if len(rows) == 1 else 2 :]), flush=True)
        write(rows, options.output_dir, "certificates", _TITLES["certificates"])
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
    """What a benchmark without curves finds for one scene and set of poses."""
    if isinstance(options, CellBenchmark):
        from ns_abstract.bench.cell import cell_cost

        return [cell_cost(job, name, options.frame, options.repeats)]
    if isinstance(options, Compile):
        from ns_abstract.bench.compiling import compile_times

        return compile_times(job, name, options.frame)
    if isinstance(options, Soundness):
        from ns_abstract.bench.soundness import attack

        return [
            attack(
                job, name, options.frame, options.seconds, options.poses, options.reference_poses, options.seed,
                options.scale, options.target_ratio,
            )
        ]  # fmt: skip
    if isinstance(options, PlanBenchmark):
        from ns_abstract.bench.plan import without

        return without(job, name, options.frame, options.cells, options.scale)
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


def bench(
    options: CellBenchmark
    | Compile
    | Tightness
    | Soundness
    | PlanBenchmark
    | RulesBenchmark
    | Rays
    | ScaleBenchmark
    | Certificates
    | Loops
    | Stiff
    | Vnnlib
    | Verify,
) -> int:
    """Run one benchmark; the exit code is 1 if a bound was violated."""
    if isinstance(options, Vnnlib):
        return vnnlib(options)
    if isinstance(options, Verify):
        return verify(options)
    if isinstance(options, Stiff):
        return stiff(options)
    if isinstance(options, ScaleBenchmark):
        return scale(options)
    if isinstance(options, Certificates):
        return certificates(options)
    if isinstance(options, Loops):
        return loops(options)
    from ns_abstract.bench import paper
    from ns_abstract.bench.sets import open_jobs, pose_set
    from ns_abstract.bench.tables import markdown, write

    program = ProgramOptions(
        gsplat_version=options.gsplat_version,
        occupancy_grid=options.occupancy_grid if isinstance(options, Rays | Tightness) else None,
        device=options.device if isinstance(options, Rays) else None,
    )
    jobs = open_jobs(
        options.load_config, options.camera_path_filename, options.downscale_factor, None, program, options.overrides
    )
    rows: list[dict[str, Any]] = []
    tables: dict[int, list[dict[str, Any]]] = {}
    results = {}
    for job in jobs:
        for name in options.sets:
            printed = len(rows)
            if isinstance(options, Tightness):
                from ns_abstract.bench.tightness import refine, summary

                poses = pose_set(job, name, options.frame, options.scale)
                result = refine(job, poses, options.frame, options.seconds, options.target_ratio)
                results[f"{job.method.name} {name}"] = result
                rows.append(summary(job, name, result))
                tables.setdefault(paper.table_of(poses), []).append(paper.ours(job, name, poses, result))
            else:
                rows += rows_of(options, job, name)
            lines = markdown(rows).splitlines()
            print("\n".join(lines[0 if not printed else 2 + printed :]), flush=True)
    kind = next(name for name, default in _DEFAULTS.items() if type(default) is type(options))
    write(rows, options.output_dir, kind, _TITLES[kind])
    if results:
        from ns_abstract.bench.plots import save_curves

        save_curves(options.output_dir / "tightness.png", results)
    for number, ours in tables.items():
        write(
            [{"by": "ns-abstract", **row} for row in ours] + [{"by": "paper", **row} for row in paper.TABLES[number]],
            options.output_dir,
            f"table-{number}",
            f"Beside the paper's Table {number}",
        )
    violations = sum(int(str(row.get("violations", 0))) for row in rows)
    if isinstance(options, Soundness | Rays):
        total = sum(int(str(row["comparisons"])) for row in rows)
        print(f"{total:,} comparisons, {violations} violations")
    return 1 if violations else DONE


def main() -> None:
    """Entry point of the console script."""
    kinds = tyro.extras.subcommand_type_from_defaults(_DEFAULTS)
    run(bench, command("ns-abstract-bench", kinds, _DEFAULTS, _ABOUT))


if __name__ == "__main__":
    main()
