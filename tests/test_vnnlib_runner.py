"""Instances of verification competitions: verdicts against a dense grid, counterexamples, packed and hostile files."""

from __future__ import annotations

import csv
import dataclasses
import gzip
import itertools
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from onnx_files import OnnxFile, session

from ns_abstract.bench import vnnlib as module
from ns_abstract.bench.vnnlib import run_folder
from ns_abstract.cli import bench
from ns_abstract.execution.cancellation import Deadline
from ns_abstract.io.errors import InputError
from ns_abstract.verify import box_decisions
from ns_abstract.verify.network import load_network
from ns_abstract.verify.vnnlib import load_query

LOWER, UPPER = np.array([-0.5, 0.1]), np.array([0.75, 0.9])


def net(folder: Path, seed: int = 0, inputs: int = 2) -> Path:
    f = OnnxFile((inputs,), seed)
    f.relu_layers(inputs, 8, 8, 2)
    return f.write(folder / "net.onnx")


def text(condition: str, lower: np.ndarray = LOWER, upper: np.ndarray = UPPER) -> str:
    lines = [f"(declare-const X_{k} Real)" for k in range(len(lower))]
    lines += ["(declare-const Y_0 Real)", "(declare-const Y_1 Real)"]
    for k, (low, high) in enumerate(zip(lower.tolist(), upper.tolist(), strict=True)):
        lines += [f"(assert (>= X_{k} {low!r}))", f"(assert (<= X_{k} {high!r}))"]
    return "\n".join([*lines, f"(assert {condition})"])


def grid_outputs(file: Path) -> np.ndarray:
    ticks = np.linspace(0.0, 1.0, 201)
    x = LOWER + np.stack(np.meshgrid(ticks, ticks), -1).reshape(-1, 2) * (UPPER - LOWER)
    return session(file)(x.astype(np.float32)).astype(np.float64)


def decided(folder: Path, conditions: dict[str, str], packed: bool = False, seconds: float = 20.0) -> dict[str, str]:
    """Verdicts by property."""
    for name, value in conditions.items():
        if packed:
            (folder / f"{name}.vnnlib.gz").write_bytes(gzip.compress(value.encode()))
        else:
            (folder / f"{name}.vnnlib").write_text(value)
    (folder / "instances.csv").write_text("".join(f"net.onnx,{name}.vnnlib,{seconds}\n" for name in conditions))
    return {row["property"].split(".")[0]: row["verdict"] for row in run_folder(folder, folder / "out")}


@pytest.mark.slow
def test_verdicts_against_a_grid(tmp_path: Path) -> None:
    for seed in range(3):
        file = net(tmp_path, seed)
        y = grid_outputs(file)
        least, most, room = ((v + 0.0).tolist() for v in (y.min(0), y.max(0), 0.02 * (y.max(0) - y.min(0))))
        found = decided(
            tmp_path,
            {
                "below": text(f"(<= Y_0 {least[0] + room[0]!r})"),
                "never": text(f"(<= Y_0 {least[0] - room[0]!r})"),
                "either": text(f"(or (and (<= Y_0 {least[0] - room[0]!r})) (and (>= Y_1 {most[1] - room[1]!r})))"),
                "neither": text(f"(or (<= Y_0 {least[0] - room[0]!r}) (>= Y_1 {most[1] + room[1]!r}))"),
                "empty": text("(<= Y_0 1e9)", UPPER, LOWER),
            },
        )
        assert found == {"below": "sat", "never": "unsat", "either": "sat", "neither": "unsat", "empty": "unsat"}


def test_boxes_of_cases(tmp_path: Path) -> None:
    """Inputs in one of two boxes: what only the hull of both holds is no counterexample."""
    file = net(tmp_path, 4)
    run = session(file)
    inside = [LOWER + part * (UPPER - LOWER) for part in (0.1, 0.9)]
    values = [float(run(x[None].astype(np.float32))[0, 0]) for x in inside]

    def box(x: np.ndarray) -> str:
        return " ".join(f"(>= X_{k} {v - 1e-6!r}) (<= X_{k} {v + 1e-6!r})" for k, v in enumerate(x.tolist()))

    declare = "".join(f"(declare-const {name} Real)" for name in ("X_0", "X_1", "Y_0", "Y_1"))
    top, gap = max(values), 1e-3
    cases = f"(assert (or (and {box(inside[0])}) (and {box(inside[1])})))"
    found = decided(
        tmp_path,
        {
            "reached": declare + cases + f"(assert (>= Y_0 {top - gap!r}))",
            "missed": declare + cases + f"(assert (>= Y_0 {top + gap!r}))",
        },
    )
    assert found == {"reached": "sat", "missed": "unsat"}


def test_runs_of_bounds_mean_what_single_ones_mean(tmp_path: Path) -> None:
    """Many bounds next to each other are read together; a second space keeps them apart."""
    rng = np.random.default_rng(5)
    names = [f"X_{k}" for k in range(12)]
    declare = "".join(f"(declare-const {name} Real)\n" for name in [*names, "Y_0"])
    ways = []
    for way in range(3):
        parts = [f"({sign} {name} {v!r})" for name in names for sign, v in ((">=", way - 9.0), ("<=", rng.normal()))]
        # the same input again, a number with an exponent, and a bound of an output in between
        parts += ["(<= X_3 -1.25)", "(>= X_3 -9.5e0)", f"(<= Y_0 {way}.5)", *parts[:9], "(<= X_4 -2)"]
        ways.append(f"(and {' '.join(parts)})")
    text = declare + f"(assert (or\n{chr(10).join(ways)}))"
    found = [load_query(tmp_path, 12, 1, one)[0] for one in (text, text.replace("= X", "=  X"))]
    assert len(found[0]) == 3
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one.lower, other.lower)
        np.testing.assert_array_equal(one.upper, other.upper)
        np.testing.assert_array_equal(one.unsafe.offset, other.unsafe.offset)
    assert found[0][0].upper[3] == -1.25 and found[0][1].upper[4] <= -2.0
    for bad, said in (("(<= X_12 1.0)", "X_12"), ("(<= X_1 1e999)", "1e999"), ("(<= X_1 1.2.3)", "1.2.3")):
        with pytest.raises(InputError, match=said):
            load_query(tmp_path, 12, 1, text.replace("(<= X_3 -1.25)", bad))[0]


@pytest.mark.slow
def test_unsafe_instances_are_never_proved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What one input reaches exactly is unsafe: found or unknown, never proved; counterexamples are re-run."""
    # a second passes whenever somebody looks
    seconds = itertools.count()
    monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=lambda: float(next(seconds))))
    rng = np.random.default_rng(0)
    shown = 0
    for seed in range(4):
        file = net(tmp_path, seed, 20)
        run = session(file)
        lower = rng.uniform(-1, 0, 20)
        upper = lower + rng.choice([0.0, 1e-3, 0.3], 20)
        conditions = {}
        for k in range(3):
            x = (lower + rng.uniform(size=20) * (upper - lower)).astype(np.float32)
            y = run(np.clip(x, lower, upper).astype(np.float32)[None])[0].astype(np.float64).tolist()
            conditions[f"p{k}"] = text(f"(and (<= Y_0 {y[0]!r}) (>= Y_1 {y[1]!r}))", lower, upper)
        found = decided(tmp_path, conditions, packed=bool(seed % 2), seconds=40.0)
        assert "unsat" not in found.values()
        shown += sum(word == "sat" for word in found.values())
        for name, word in found.items():
            written = (tmp_path / "out" / f"net_{name}.txt").read_text()
            assert written.splitlines()[0] == word
            if word == "sat":
                values = {key: float(v) for key, v in re.findall(r"\((\w+) ([^\s()]+)\)", written)}
                x = np.array([values[f"X_{k}"] for k in range(20)])
                assert ((lower <= x) & (x <= upper)).all()
                y = run(x.astype(np.float32)[None])[0].astype(np.float64)
                assert [values["Y_0"], values["Y_1"]] == y.tolist()
                (region,) = load_query(tmp_path / "a", 20, 2, conditions[name])[0]
                assert region.holds(y)
        for path in tmp_path.glob("*.vnnlib*"):
            path.unlink()
    assert shown >= 4


def proved(file: Path, condition: str, asks: int = 400) -> str:
    """What proofs alone say, since no output that the program computes is finite, until time has been asked for."""
    times = itertools.count()
    regions = load_query(file.parent / "a", 2, 2, text(condition))[0]
    return box_decisions.decide(
        load_network(file), lambda image: np.full(2, np.nan), regions, Deadline(request=lambda: next(times) > asks)
    ).word


@pytest.mark.slow
def test_proofs_alone_never_decide_unsafe_instances(tmp_path: Path) -> None:
    """Without any attack, what is unsafe in one corner of the box or by one of two cases is not proved."""
    for seed in range(2):
        file = net(tmp_path, seed)
        y = grid_outputs(file)
        low, high = (v.tolist() for v in (y.min(0), y.max(0)))
        conditions = [f"(or (<= Y_0 {low[0] + 1e-3!r}) (<= Y_1 {low[1] - 9.0!r}))"]
        for k in (0, 1):
            conditions += [f"(<= Y_{k} {low[k] + 1e-3!r})", f"(>= Y_{k} {high[k] - 1e-3!r})"]
        assert "unsat" not in {proved(file, condition) for condition in conditions}
        # it can: what lies beyond the grid by more than the grid can miss
        assert proved(file, f"(<= Y_0 {low[0] - 0.1 * (high[0] - low[0])!r})") == "unsat"


def test_planted_faults_are_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A proof from the best of a group's bounds, or without one group, decides an unsafe instance."""
    file = net(tmp_path, 1)
    y = grid_outputs(file)
    both = f"(or (<= Y_0 {float(y[:, 0].min()) - 1.0!r}) (<= Y_1 {float(np.median(y[:, 1]))!r}))"
    assert proved(file, both) in ("unknown", "timeout")
    monkeypatch.setattr(box_decisions, "proves", lambda bounds, groups: (bounds.lower > 0.0).any(1))
    assert proved(file, both) == "unsat"


def test_time_is_kept(tmp_path: Path) -> None:
    file = net(tmp_path, 1)
    regions = load_query(tmp_path / "a", 2, 2, text("(<= Y_0 -1e9)"))[0]
    answer = box_decisions.decide(load_network(file), session(file), regions, Deadline(request=lambda: True))
    assert answer.word == "timeout"


def test_the_first_attack_leaves_time_for_proofs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After its part of the time inputs are evaluated and not moved: none is left out, and no gradient is asked for."""
    file = net(tmp_path, 1)
    low, high = (v[0].item() for v in (grid_outputs(file).min(0), grid_outputs(file).max(0)))
    network, run = load_network(file), session(file)
    conditions = {"unsat": f"(<= Y_0 {low - (high - low)!r})", "sat": f"(<= Y_0 {high + 1.0!r})"}

    def words() -> list[str]:
        regions = [load_query(tmp_path / "a", 2, 2, text(condition))[0] for condition in conditions.values()]
        return [box_decisions.decide(network, run, one, Deadline(60.0)).word for one in regions]

    assert words() == list(conditions)
    moved: list[int] = []
    gradient = torch.autograd.grad
    monkeypatch.setattr(torch.autograd, "grad", lambda *given, **more: [moved.append(1), gradient(*given, **more)][1])
    assert words() == list(conditions) and len(moved) == box_decisions._TUNING.first_attack[1] - 1
    moved.clear()
    tuning = dataclasses.replace(box_decisions._TUNING, first_share=0.0)
    monkeypatch.setattr(box_decisions, "_TUNING", tuning)
    assert words() == list(conditions) and not moved


@pytest.mark.parametrize(
    ("condition", "said"),
    [
        ("(<= (+ X_0 X_1) 1.0)", "joins several inputs"),
        ("(<= X_0 Y_0)", "joins several inputs"),
        ("(<= X_7 1.0)", "X_7"),
        ("(<= Y_7 1.0)", "Y_7"),
    ],
)
def test_constraints_that_are_refused(condition: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=said):
        load_query(tmp_path / "a", 2, 2, text(condition).replace("(assert", "(declare-const X_7 Real)(assert", 1))[0]


def test_inputs_without_bounds_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="X_1 has no bounds"):
        load_query(tmp_path / "a", 2, 2, text("(<= Y_0 1.0)").replace("(assert (<= X_1 0.9))", ""))[0]


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ({"instances.csv": b"../net.onnx,p.vnnlib,5\n"}, "leads out"),
        ({"instances.csv": b"net.onnx,p.vnnlib\n"}, "2 fields"),
        ({"instances.csv": b"net.onnx,p.vnnlib,nan\n"}, "seconds"),
        ({"instances.csv": b"net.onnx,p.vnnlib,5\n", "p.vnnlib.gz": b"no gzip"}, "unpacked"),
        ({"instances.csv": b"q.onnx,p.vnnlib,5\n", "q.onnx.gz": gzip.compress(b"0" * (5 << 20))}, "q.onnx.gz"),
    ],
)
def test_hostile_files_end_in_one_line(
    files: dict[str, bytes],
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    net(tmp_path)
    monkeypatch.setattr(module, "_NETWORK_LIMIT", 4 << 20)
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    if "p.vnnlib.gz" not in files:
        (tmp_path / "p.vnnlib").write_text(text("(<= Y_0 1e9)"))
    monkeypatch.setattr(sys, "argv", ["bench", "vnnlib", str(tmp_path), "--output-dir", str(tmp_path / "out")])
    with pytest.raises(SystemExit) as left:
        bench.main()
    shown = capsys.readouterr().err.splitlines()
    assert left.value.code == 2
    assert len(shown) == 1 and shown[0].startswith("error: ") and said in shown[0]


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    net(tmp_path)
    (tmp_path / "p.vnnlib").write_text(text("(<= Y_0 -1e9)"))
    (tmp_path / "instances.csv").write_text("net.onnx,p.vnnlib,30\n")
    monkeypatch.setattr(sys, "argv", ["bench", "vnnlib", str(tmp_path), "--output-dir", str(tmp_path / "o")])
    with pytest.raises(SystemExit) as left:
        bench.main()
    assert left.value.code == 0 and "1 unsat" in capsys.readouterr().out
    (row,) = csv.reader((tmp_path / "o" / "results.csv").read_text().splitlines())
    assert row[1:3] == ["net.onnx", "p.vnnlib"] and row[4] == "unsat"
