"""Options of the benchmarks."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import tyro

from ns_abstract.cli.sets import Overrides, SceneOverrides


@dataclass
class SceneBenchmark:
    """What is measured."""

    load_config: tuple[Path, ...] = ()
    """Runs (config.yml) or scene files. Default: the demo scene."""
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
class _Sets(SceneBenchmark):
    sets: tuple[str, ...] = ("x", "yaw")
    """Sets of poses: x, yaw, roll, six, segments, orbit, point."""


@dataclass
class _Scaled(_Sets):
    scale: float = 1.0
    """Multiplies the ranges of translations and rotations."""


@dataclass(kw_only=True)
class _Seeded:
    seed: int = 0
    """Decides every random choice."""


@dataclass(kw_only=True)
class _Library:
    memory_limit: float = 2.0
    """GiB that bounds may take."""
    network_arithmetic: Literal["float32", "real"] = "float32"
    """What "unsat" covers: every float32 evaluation and the exact network, or the exact network alone."""
    output: str | None = None
    """Name of the network's output. Default: the only one."""


@dataclass
class CellBenchmark(_Sets):
    """What one bounded cell costs in units of the concrete render of the same view."""

    sets: tuple[str, ...] = ("x",)
    repeats: int = 15
    """Times that everything is measured."""


@dataclass
class Compile(_Sets):
    """What compiling costs at first use, by kernel: seconds by the clock, of the processor, and inside LLVM."""

    sets: tuple[str, ...] = ("x",)


@dataclass
class Tightness(_Scaled):
    """Error against run time: ratio of outer to inner gap, with curves."""

    sets: tuple[str, ...] = ("x", "yaw")
    """Sets: x, yaw, roll, six, segments, orbit, point; mean, opacity, color of a splat; hue, saturation of a NeRF."""
    seconds: float = 60.0
    """Time for every scene and set."""
    target_ratio: float = 1.01
    """Where a set is tight enough."""
    occupancy_grid: Path | None = None
    """Declare the fields of a NeRF empty outside of this grid's occupied voxels."""


@dataclass
class Soundness(_Seeded, _Scaled):
    """Attack abstract images by random poses, corners, gradient ascent and threshold jumps."""

    sets: tuple[str, ...] = ("x", "yaw", "roll", "six", "segments", "orbit")
    seconds: float = 10.0
    """Time for bounding every scene and set."""
    poses: int = 200
    """Images by the compiled renderer for every scene and set."""
    reference_poses: int = 20
    """Images by the independent reference."""
    target_ratio: float = 1.0
    """Where a set is tight enough; from 1.05 on, a first cover leaves out what hardly any light comes to."""


@dataclass
class PlanBenchmark(_Scaled):
    """Take back, one by one, what a scene's plan leaves out: what it costs, and how bounds differ."""

    cells: int = 24
    """Cells that every scene and set is bounded with."""


@dataclass
class RulesBenchmark(_Seeded, _Sets):
    """Our bounds against the paper's rules, on the same Gaussians, pixels and cells."""

    parts: tuple[int, ...] = (8, 64)
    """Cells by axis that a set is cut into; the middle one is bounded."""
    pixels: int = 8
    """Pixels for every scene, set and cell."""
    gaussians: int = 30
    """Most Gaussians by pixel."""


@dataclass
class Rays(_Seeded, _Scaled):
    """Random rays of a NeRF: CPU seconds by ray to a ratio, then attacks on the bounds."""

    sets: tuple[str, ...] = ("yaw",)
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
class Loops(_Seeded):
    """A network in the loop: certified fraction against time, tubes against runs, attacks on tubes."""

    load_config: Path
    """Run (config.yml) or scene file."""
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
    overrides: SceneOverrides = field(default_factory=Overrides)


@dataclass
class Stiff(_Seeded):
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


@dataclass
class Vnnlib(_Library):
    """Decide instances of a verification competition: networks and VNN-LIB properties with boxes of inputs."""

    folder: tyro.conf.Positional[Path]
    """Holds instances.csv (network,property,seconds) and what it names, packed (.gz) or not, or 2.0 or 1.0 that do."""
    output_dir: Path = Path("bench")
    """Folder for results.csv, and for each instance the verdict and a counterexample."""
    only: tuple[str, ...] = ()
    """Parts of the names of networks or properties. Default: all instances."""
    seconds: float | None = None
    """Limit for every instance beside that of the list."""


@dataclass
class Verify(_Library):
    """Decide one VNN-LIB query, as the standard's command "verify" does: its answer alone is printed."""

    query: tyro.conf.Positional[Path]
    """The query (.vnnlib), of version 1 or 2, packed (.gz) or not."""
    network: tuple[str, ...] = ()
    """NAME=FILE.onnx: the file of the network that the query calls NAME."""
    timeout: float | None = None
    """Seconds. Default: no limit."""
