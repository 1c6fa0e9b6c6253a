"""Importing torch starts nothing of this package; nerfstudio's commands start through its wrapper."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from nerfstudio_runs import environment, needs_nerfstudio

ROOT = Path(__file__).resolve().parents[1]


def run(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments], env=environment(folder), cwd=folder, capture_output=True, text=True, check=False
    )


def test_no_entry_point_is_called_by_other_packages(tmp_path: Path) -> None:
    tomllib = pytest.importorskip("tomllib", reason="tomllib comes with Python 3.11")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert set(project["entry-points"]) == {"nerfstudio.method_configs"}


@pytest.mark.slow
def test_importing_torch_changes_no_import(tmp_path: Path) -> None:
    """Also where an older editable install still names `autoload` to PyTorch."""
    code = (
        "import sys; before = list(sys.meta_path); import torch; "
        "from ns_abstract.nerfstudio.torchvision_operators import autoload; autoload(); "
        "assert [f for f in sys.meta_path if f not in before and type(f).__module__.startswith('ns_abstract')] == []; "
        "assert not hasattr(torch.ops.torchvision, 'nms')"
    )
    done = run("-c", code, folder=tmp_path)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@needs_nerfstudio
def test_torchvision_imports_once_the_operators_are_declared(tmp_path: Path) -> None:
    code = (
        "from ns_abstract.nerfstudio.torchvision_operators import declare_missing; declare_missing(); "
        "declare_missing(); import torchvision, torch; assert hasattr(torch.ops.torchvision, 'nms')"
    )
    done = run("-c", code, folder=tmp_path)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("name", [(), ("ns-trian",), ("python",), ("--help",)])
def test_wrapper_refuses_what_is_no_command_in_one_line(tmp_path: Path, name: tuple[str, ...]) -> None:
    done = run("-m", "ns_abstract.nerfstudio", *name, folder=tmp_path)
    assert done.returncode == 2 and not done.stdout
    assert done.stderr.count("\n") == 1 and "ns-" in done.stderr and (not name or name[0] in done.stderr)
