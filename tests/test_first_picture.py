"""The script that measures the README's first command."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import pytest
from benchmark_scripts import script

first_picture = script("first_picture")
README = Path(__file__).resolve().parents[1] / "README.md"


def test_the_readme_runs_a_demo_and_a_render() -> None:
    demo, render = first_picture.commands(README.read_text(encoding="utf-8"))
    assert demo[0].endswith("ns-abstract-demo") and "--time-budget" in render
    with pytest.raises(ValueError, match="expected a demo and a render"):
        first_picture.commands("```sh\nns-abstract-demo\n```\n")


def test_rows_are_added(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "ns-abstract-demo"
    program.write_text(
        f'#!{sys.executable}\nimport os, sys\nopen(os.environ["NS_ABSTRACT_CACHE_DIR"] + "-seen", "a")\n'
    )
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    rows = [first_picture.measure([["x/ns-abstract-demo", "a"], ["ns-abstract-demo"]], tmp_path) for _ in range(2)]
    assert (tmp_path / "kernels-seen").exists()
    for row in rows:
        first_picture.keep([row], tmp_path / "rows.csv")
    with open(tmp_path / "rows.csv", newline="") as stream:
        read = list(csv.DictReader(stream))
    assert len(read) == 2 and float(read[0]["wall"]) >= float(read[0]["demo_wall"])
