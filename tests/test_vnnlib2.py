"""VNN-LIB 2.0: what queries mean, against the standard's own parser; folders of 2026; hostile files."""

from __future__ import annotations

import gzip
import random
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import InProcess
from test_vnnlib_runner import LOWER, UPPER, grid_outputs, net

from ns_abstract.bench.vnnlib import run_folder, verify_query
from ns_abstract.cli import bench
from ns_abstract.io.errors import InputError
from ns_abstract.verify.vnnlib import load_query, load_vnnlib
from ns_abstract.verify.vnnlib2 import write_query

HEAD = "(vnnlib-version <2.0>)\n(declare-network f (declare-input X {0} [{1}]) (declare-output Y {0} [{2}]))\n"


def query(condition: str, kind: str = "real", inputs: str = "2", outputs: str = "2") -> str:
    lines = [HEAD.format(kind, inputs, outputs)]
    for k, (low, high) in enumerate(zip(LOWER.tolist(), UPPER.tolist(), strict=True)):
        lines += [f"(assert (and (>= X[{k}] {low!r}) (<= X[{k}] {high!r})))"]
    return "\n".join([*lines, f"(assert {condition})\n"])


def read(text: str, shapes: tuple[Any, Any] = ((2,), (2,))) -> Any:
    return load_query(Path("query"), *shapes, text=text)[0]


@pytest.mark.parametrize("kind", ["real", "float32"])
def test_answers_against_a_grid(kind: str, tmp_path: Path) -> None:
    file = net(tmp_path, 0)
    y = grid_outputs(file)
    least, room = float(y[:, 0].min()), float(0.02 * (y[:, 0].max() - y[:, 0].min()))
    for name, value, expected in (("a", least + room, "sat"), ("b", least - room, "unsat")):
        (tmp_path / name).write_text(query(f"(<= Y[0] {value:.12f})", kind))
        word, *lines = verify_query(tmp_path / name, {"f": file}, seconds=60).splitlines()
        assert word == expected
        if word == "unsat":
            assert not lines
            continue
        assert (lines[0], lines[3]) == (f"X {kind} [2]", f"Y {kind} [2]") and len(lines) == 6
        x = np.array(lines[1:3], np.float64)
        assert (x >= np.minimum(LOWER, LOWER.astype(np.float32))).all()
        assert (x <= np.maximum(UPPER, UPPER.astype(np.float32))).all()
        assert float(lines[4]) <= value
        if kind == "float32":
            assert (x == x.astype(np.float32)).all()


def test_numbers_of_float32_queries_are_their_float32_values() -> None:
    """0.1 is rounded up to float32, 0.3 down to it, and so are bounds and constraints; real queries keep them."""
    text = HEAD.format("float32", "2", "2") + (
        "(assert (and (<= X[0] 0.1) (>= X[0] -0.1) (== X[1] 0.7)))(assert (and (<= Y[0] 0.1) (>= Y[1] 0.1)))"
    )
    (region,) = read(text)
    up, seven = float(np.float32(0.1)), sorted((0.7, float(np.float32(0.7))))
    assert up > 0.1
    assert region.upper.tolist() == [up, seven[1]] and region.lower.tolist() == [-up, seven[0]]
    # y_0 <= up and y_1 >= 0.1, which for float32 outputs is y_1 >= up
    for output, unsafe in (([up, up], True), ([np.nextafter(up, 1.0), up], False), ([0.0, 0.0999], False)):
        assert region.holds(np.array(output)) is unsafe
    (region,) = read(text.replace("float32", "real"))
    assert region.upper.tolist() == [0.1, 0.7] and not region.holds(np.array([up, up]))


def test_elements_are_counted_in_rows() -> None:
    text = HEAD.format("real", "1,2,3", "") + "(assert (and {}))(assert (<= Y 0.5))"
    bounds = [
        f"(<= X[0, {i} , {j}] {10 * i + j}.5)(>= X[0,{i},{j}] {10 * i + j}.0)" for i in range(2) for j in range(3)
    ]
    (region,) = read(text.format(" ".join(bounds)), ((2, 3), (1,)))
    assert region.lower.tolist() == [0.0, 1.0, 2.0, 10.0, 11.0, 12.0]
    # sides of 1 do not count, others do
    for shape in ((1, 2, 3), (2, 1, 3), 6):
        assert read(text.format(" ".join(bounds)), (shape, 1))
    with pytest.raises(InputError, match=r"declare-input: X has shape \[1, 2, 3\]"):
        read(text.format(" ".join(bounds)), ((3, 2), (1,)))


GOOD = {
    "negated number": ("(<= Y[0] (- 1.5))", lambda y: y[0] <= -1.5),
    "equality": ("(== Y[0] 0.5)", lambda y: y[0] == 0.5),
    "product of three": ("(<= (* 2.0 Y[0] 3.0) 1.5)", lambda y: 6.0 * y[0] <= 1.5),
    "sums": ("(>= (+ Y[0] (- Y[1]) 0.25) (- Y[1] 0.25 Y[0]))", lambda y: y[0] - y[1] + 0.25 >= y[1] - 0.25 - y[0]),
    "either": ("(or (and (<= Y[0] 0.0) (<= Y[1] 0.0)) (>= Y[0] 1.0))", lambda y: max(y) <= 0.0 or y[0] >= 1.0),
    "space before the bracket": ("(<= Y [ 1 ] Y[0]) ; Y[7] (\n", lambda y: y[1] <= y[0]),
}


@pytest.mark.parametrize("name", GOOD)
def test_conditions_mean_what_the_standard_says(name: str) -> None:
    text, meaning = GOOD[name]
    (region,) = read(query(text))
    for y in np.random.default_rng(0).integers(-6, 7, (200, 2)) / 4.0:
        assert region.holds(y) == bool(meaning(y)), y


def _with(old: str, new: str) -> str:
    """A good query with a change."""
    return query("(<= Y[0] 1.0)").replace(old, new, 1)


BAD = {
    "version 3": (query("(<= Y[0] 1.0)").replace("<2.0>", "<3.0>"), "version"),
    "no version number": (query("(<= Y[0] 1.0)").replace(" <2.0>", ""), "vnnlib-version"),
    "strict": (query("(< Y[0] 1.0)"), "<="),
    "unequal": (query("(!= Y[0] 1.0)"), "!="),
    "index too large": (query("(<= Y[2] 1.0)"), r"Y\[2\]"),
    "index of 400 digits": (query(f"(<= Y[{'9' * 400}] 1.0)"), "whole numbers"),
    "two indices": (query("(<= Y[0,0] 1.0)"), "shape"),
    "no index": (query("(<= Y 1.0)"), "shape"),
    "empty index": (query("(<= Y[,] 1.0)"), "whole numbers"),
    "undeclared": (query("(<= Z[0] 1.0)"), "not declared"),
    "declared twice": (query("(<= X[0] 1.0)").replace("output Y", "output X"), "one input and one output"),
    "two networks": (_with("(assert", "(declare-network g (equal-to f))(assert"), "several"),
    "two inputs": (_with("(declare-output", "(declare-input Z real [2])(declare-output"), "one input"),
    "hidden": (_with("(declare-output", '(declare-hidden H real [2] "h")(declare-output'), "hidden"),
    "initialized": (query("(<= Y[0] 1.0)").replace("real [2])", "real [2] initialized)", 1), "not understood"),
    "float64": (query("(<= Y[0] 1.0)", "float64"), "float64"),
    "int8": (query("(<= Y[0] 1.0)", "int8"), "int8"),
    "shape of 10^30": (query("(<= Y[0] 1.0)", inputs="1" + "0" * 30), "whole numbers"),
    "shape of 10^9 squared": (query("(<= Y[0] 1.0)", inputs="999999999,999999999"), "shape"),
    "shape with a 0": (query("(<= Y[0] 1.0)", inputs="0"), "0"),
    "shape negative": (query("(<= Y[0] 1.0)", inputs="-2"), "not understood"),
    "shape of 10^5 sides": (query("(<= Y[0] 1.0)", inputs="1," * 99999 + "2"), "whole numbers"),
    "no bounds": (HEAD.format("real", "2", "2") + "(assert (<= Y[0] 1.0))", "no bounds"),
    "product of outputs": (query("(<= (* Y[0] Y[1]) 1.0)"), "linear"),
    "rounded sum": (query("(<= (+ Y[0] Y[1]) 1.0)", "float32"), "would round"),
    "rounded product": (query("(<= (* 2.0 Y[0]) 1.0)", "float32"), "would round"),
    "two numbers": (query("(<= 0.5 1.0)", "float32"), "would round"),
    "beyond float32": (query("(<= Y[0] 1" + "0" * 39 + ".0)", "float32"), "float32"),
    "beyond float64": (query("(<= Y[0] 1" + "0" * 400 + ".0)"), "float64"),
    "nan": (query("(<= Y[0] nan)"), "not declared"),
    "nested": (HEAD.format("real", "2", "2") + "(assert " + "(and " * 300000 + "(<= Y[0] 1.0)" + ")" * 300001, "deep"),
    "sum nested": (query("(<= " + "(+ 1.0 " * 100000 + "Y[0]" + ")" * 100000 + " 1.0)"), "deep"),
    "zero byte": (query("(<= Y[0] 1.0)\0)(assert (<= Y[0] -100.0)"), "zero byte"),
    "not closed": (query("(<= Y[0] 1.0"), "never closed"),
    "closed twice": (query("(<= Y[0] 1.0))"), "too many"),
    "words behind": (query("(<= Y[0] 1.0)") + "garbage", "assertions"),
    "implication": (query("(=> (<= Y[0] 1.0) (<= Y[1] 1.0))"), "not understood"),
    "no network": ("(vnnlib-version <2.0>)(assert (<= Y[0] 1.0))", "declare-network"),
    "nothing else": ("(vnnlib-version <2.0>)", "vnnlib-version"),
    "version 1 inside": (query("(<= Y_0 1.0)"), "not declared"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_queries_are_errors_of_one_line(name: str, tmp_path: Path) -> None:
    text, words = BAD[name]
    file = tmp_path / "q.vnnlib"
    file.write_text(text)
    with pytest.raises(InputError, match=words) as caught:
        load_query(file, (2,), (2,))[0]
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 600 and caught.value.fix
    if name != "no bounds":
        # a property of pictures sets bounds of inputs aside
        with pytest.raises(InputError):
            load_vnnlib(file, (2,))


PARSER = """
import sys, vnnlib
try:
    vnnlib.parse_query_string(open(sys.argv[1]).read())
except Exception:
    sys.exit(1)
"""


def test_the_standards_parser_takes_what_is_taken_and_written(tmp_path: Path) -> None:
    pytest.importorskip("vnnlib", reason="vnnlib is not installed")
    texts = [query(text) for text, _ in GOOD.values()] + [write_query(2, 3, [(0,), (0, 1)], 2, ["a note"])]
    for k, text in enumerate(texts):
        (tmp_path / str(k)).write_text(text)
        run = subprocess.run([sys.executable, "-c", PARSER, str(tmp_path / str(k))], capture_output=True, check=False)
        assert run.returncode == 0, text


def test_random_queries_mean_what_their_tree_means() -> None:
    """Conditions drawn at random, evaluated by plain Python, against the sets that are read."""
    rng = random.Random(0)

    def term(depth: int) -> tuple[str, Any]:
        if depth == 0 or rng.random() < 0.3:
            if rng.random() < 0.6:
                k = rng.randrange(2)
                return f"Y[{k}]", lambda y: y[k]
            value = rng.randrange(-8, 9) / 4.0
            return f"{value}", lambda y: value
        (left, f), (right, g) = term(depth - 1), term(depth - 1)
        if rng.random() < 0.2:
            factor = rng.randrange(-4, 5) / 2.0
            return f"(* {factor} {left})", lambda y: factor * f(y)
        if rng.random() < 0.5:
            return f"(- {left} {right})", lambda y: f(y) - g(y)
        return f"(+ {left} {right})", lambda y: f(y) + g(y)

    def condition(depth: int) -> tuple[str, Any]:
        if depth and rng.random() < 0.6:
            parts = [condition(depth - 1) for _ in range(rng.randrange(1, 4))]
            head, join = rng.choice((("and", all), ("or", any)))
            return f"({head} {' '.join(p for p, _ in parts)})", lambda y: join(f(y) for _, f in parts)
        (left, f), (right, g) = term(2), term(2)
        operator = rng.choice(("<=", ">=", "=="))
        compare = {"<=": float.__le__, ">=": float.__ge__, "==": float.__eq__}[operator]
        return f"({operator} {left} {right})", lambda y: compare(float(f(y)), float(g(y)))

    points = np.random.default_rng(1).integers(-8, 9, (40, 2)) / 4.0
    for _ in range(150):
        text, meaning = condition(2)
        regions = read(query(text))
        for y in points:
            assert any(region.holds(y) for region in regions) == meaning(y.tolist()), text


# ---------------------------------------------------------------- folders and commands


def test_a_folder_of_2026(tmp_path: Path) -> None:
    """Version 2.0 below the benchmark, lists of networks, packed files, and a query about two networks."""
    folder = tmp_path / "camera_2026"
    (folder / "2.0" / "onnx").mkdir(parents=True)
    (folder / "1.0").mkdir()
    file = net(folder / "2.0" / "onnx", 0)
    (folder / "2.0" / "onnx" / "net.onnx.gz").write_bytes(gzip.compress(file.read_bytes()))
    file.unlink()
    (folder / "2.0" / "a.vnnlib.gz").write_bytes(gzip.compress(query("(<= Y[0] 1000.0)").encode()))
    (folder / "2.0" / "b.vnnlib").write_text(query("(<= Y[0] -1000.0)", "float32"))
    lines = [
        "onnx/net.onnx,./a.vnnlib,60", "\"[('f', 'onnx/net.onnx')]\",b.vnnlib,60",
        "\"[('g', 'onnx/net.onnx')]\",b.vnnlib,60", "\"[('f', 'onnx/net.onnx'), ('g', 'onnx/net.onnx')]\",c.vnnlib,60",
        "\"[('f', open('x'))]\",c.vnnlib,60", f"\"{'[' * 3000}\",c.vnnlib,60",
    ]  # fmt: skip
    (folder / "2.0" / "instances.csv").write_text("\n".join(lines) + "\n")
    rows = list(run_folder(folder, tmp_path / "out"))
    assert [row["verdict"] for row in rows] == ["sat", "unsat", "error", "error", "error", "error"]
    for row, words in zip(rows[2:], ("names the network f", "several networks", "found [", "found ["), strict=True):
        assert words in row["why"] and "\n" not in row["why"]
    found = (tmp_path / "out" / "net_a.txt").read_text().splitlines()
    assert found[:2] == ["sat", "X real [2]"] and found[4] == "Y real [2]"
    assert (tmp_path / "out" / "results.csv").read_text().startswith("camera_2026,onnx/net.onnx,")
    # real numbers are not what a float32 query asks about
    rows = list(run_folder(folder, tmp_path / "real", only=("b.vnnlib",), arithmetic="real"))
    assert all(row["verdict"] == "error" for row in rows) and "float32" in rows[0]["why"]


def test_the_standards_command(tmp_path: Path, in_process: InProcess) -> None:
    file, target = net(tmp_path, 0), tmp_path / "q.vnnlib"
    target.write_text(query("(<= Y[0] -1000.0)"))
    verify = ["verify", str(target), "--network", f"f={file}"]
    assert in_process(bench.main, [*verify, "--timeout", "60"]) == (0, "unsat\n", "")
    target.write_text(query("(<= Y[0] 1000.0)"))
    code, out, _ = in_process(bench.main, verify)
    assert code == 0 and out.startswith("sat\nX real [2]\n")
    for options, words in (
        (verify[:2], "--network"), ([*verify[:3], str(file)], "NAME=FILE"), ([*verify[:3], f"g={file}"], "network f"),
        ([*verify[:3], f"f={tmp_path / 'none.onnx'}"], "none.onnx"), ([*verify, "--timeout", "0"], "--timeout"),
    ):  # fmt: skip
        code, _, error = in_process(bench.main, options)
        assert code == 2 and words in error and error.count("\n") == 1, error


def test_a_query_is_kept_with_its_tensors() -> None:
    regions, found = load_query(Path("q"), (2,), (2,), text=query("(<= Y[0] 1.0)", "float32"))
    assert found is not None and len(regions) == 1
    assert (found.network, found.input.name, found.input.kind, found.output.shape) == ("f", "X", "float32", (2,))
    assert load_query(Path("q"), 2, 2, text=write_query(1, 1, [(0,), (1,)], 2))[1] is not None
    text = "".join(f"(declare-const {v} Real)" for v in ("X_0", "Y_0")) + "(assert (<= X_0 1.0))(assert (>= X_0 0.0))"
    assert load_query(Path("q"), 1, 1, text=text + "(assert (<= Y_0 1.0))")[1] is None
