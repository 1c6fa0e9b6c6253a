"""Small scenes, camera paths and runs that several test files share."""

from __future__ import annotations

import logging
import os
import signal
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

import numba
import numpy as np
import pytest

from ns_abstract.arithmetic.kernel_cache import store
from ns_abstract.execution.engine_options import EngineOptions
from ns_abstract.geometry.keyframe_cameras import KeyframeCamera, look_at, path_json
from ns_abstract.io.atomic import write_json
from ns_abstract.methods.overrides import Overrides
from ns_abstract.methods.program_options import ProgramOptions
from ns_abstract.methods.splat.scene import SplatScene
from ns_abstract.methods.splat.write import write_splatfacto_run

# what is said of compiling depends on what was compiled before
logging.getLogger("ns_abstract.kernels").setLevel(logging.ERROR)

ROOT = Path(__file__).resolve().parents[1]
TIMESTAMP = "2026-01-01_000000"


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Gives `slow` to the cases that `slow_cases` leaves out of the fast set, before ``-m`` chooses."""
    seen: dict[str, int] = {}
    for item in items:
        mark = item.get_closest_marker("slow_cases")
        if mark is None:
            continue
        function = item.nodeid.partition("[")[0]
        number = seen.get(function, 0)
        seen[function] = number + 1
        if number % mark.kwargs.get("every", 1 << 30):
            item.add_marker("slow")


@pytest.fixture(autouse=True, scope="session")
def one_thread():
    """Small pictures gain nothing from threads, and waiting threads take the processor from other workers."""
    numba.set_num_threads(1)


#: Before any command has run.
HANDLERS = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}


@pytest.fixture(autouse=True)
def signals_as_before() -> Iterator[None]:
    """Commands that tests and fixtures call in this process handle signals and lost errors, and leave it so."""
    unraisable = sys.unraisablehook
    for number, handler in HANDLERS.items():
        signal.signal(number, handler)
    yield
    for number, handler in HANDLERS.items():
        signal.signal(number, handler)
    sys.unraisablehook = unraisable


def environment() -> dict[str, str]:
    """For processes of their own: they find this package wherever they run, and the kernels that were compiled here."""
    store().publish()
    return os.environ | {"PYTHONPATH": str(ROOT)}


#: Records of options that several commands have.
_RECORDS = {"program": ProgramOptions, "where": EngineOptions, "overrides": Overrides}
T = TypeVar("T")


def command_options(command: Callable[..., T], **values: Any) -> T:
    """Options of a command by name, whichever record declares them."""
    for record, kind in _RECORDS.items():
        names = {entry.name for entry in fields(kind)} & set(values)
        if names:
            values[record] = kind(**{name: values.pop(name) for name in names})
    return command(**values)


#: A command's ``main`` and its options to exit code, stdout and stderr.
InProcess = Callable[[Callable[[], None], list[str]], tuple[int, str, str]]


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> InProcess:
    """Runs a command in this process."""

    def run(main: Callable[[], None], options: list[str]) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["command", *options])
        capsys.readouterr()
        with pytest.raises(SystemExit) as leave:
            main()
        assert isinstance(leave.value.code, int)
        said = capsys.readouterr()
        return leave.value.code, said.out, said.err

    return run


#: A sideways shift, wide enough for several cells.
SHIFT = {"version": 1, "translation": {"x": 0.03}}


def blob_scene(count: int = 50, seed: int = 7, degree: int = 1) -> SplatScene:
    """A cloud of ``count`` Gaussians of radius 0.4 about the origin, with spherical harmonics."""
    rng = np.random.default_rng(seed)
    bands = (degree + 1) ** 2
    values = {
        "means": 0.4 * rng.uniform(-1.0, 1.0, (count, 3)),
        "log_scales": rng.uniform(-3.6, -2.2, (count, 3)),
        "quats": rng.normal(size=(count, 4)),
        "opacity_logits": rng.uniform(-1.0, 3.0, count),
        "sh": rng.normal(size=(count, bands, 3)) * np.where(np.arange(bands) == 0, 0.8, 0.1)[:, None],
    }
    return SplatScene(
        **{name: value.astype(np.float32) for name, value in values.items()},  # type: ignore[arg-type]
        sh_degree=degree,
        background=np.array([0.1, 0.2, 0.3], np.float32),
        name="blobs",
    )


def ring(count: int = 3, size: int = 32) -> list[KeyframeCamera]:
    """``count`` views of the origin from a quarter of a circle."""
    angles = np.linspace(0.0, 0.5 * np.pi, count)
    return [
        KeyframeCamera(look_at((1.6 * np.cos(a), 1.6 * np.sin(a), 0.4), (0.0, 0.0, 0.0)), 45.0, size, size)
        for a in angles
    ]


@dataclass(frozen=True)
class Inputs:
    """What a command needs; `options` gives its command line."""

    config: Path
    path: Path
    spec: Path

    @property
    def checkpoint(self) -> Path:
        """The run's checkpoint."""
        return next((self.config.parent / "nerfstudio_models").glob("step-*.ckpt"))

    def options(self, output: Path, **changes: Any) -> list[str]:
        """Options of ns-abstract-render; a change of None leaves its option out, True is a flag."""
        values: dict[str, Any] = {
            "load_config": self.config,
            "camera_path_filename": self.path,
            "perturbation_filename": self.spec,
            "output_dir": output,
        }
        found: list[str] = []
        for name, value in (values | changes).items():
            if value is None:
                continue
            found.append("--" + name.replace("_", "-"))
            if value is not True:
                found.extend(map(str, value if isinstance(value, (list, tuple)) else [value]))
        return found


@pytest.fixture(scope="session")
def blobs(tmp_path_factory: pytest.TempPathFactory) -> Inputs:
    """A run of `blob_scene`, three views of 32 x 32 pixels and a shift; not to be changed."""
    return _write(tmp_path_factory.mktemp("blobs"))


@pytest.fixture
def make_blobs(tmp_path: Path) -> Callable[..., Inputs]:
    """Writes inputs that a test may damage."""
    return lambda **changes: _write(tmp_path / "inputs", **changes)


def _write(
    folder: Path, scene: SplatScene | None = None, views: list[KeyframeCamera] | None = None, spec: Any = None
) -> Inputs:
    folder.mkdir(exist_ok=True)
    config = write_splatfacto_run(
        blob_scene() if scene is None else scene, folder, timestamp=TIMESTAMP, experiment_name="blobs"
    )
    path = path_json(ring() if views is None else views)
    return Inputs(
        config,
        write_json(folder / "camera_path.json", path),
        write_json(folder / "spec.json", SHIFT if spec is None else spec),
    )
