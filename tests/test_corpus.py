"""The corpus of hostile and clumsy input: one line for a case, tried by `corpus.Bench` (see there).

A case is the command, what is wrong, the words that the error must say, and the files or options that are changed;
its exit code is 2 where nothing else stands. For every case: no traceback, no hanging, no control characters, one
line that names a fix, memory within its limit, and no file touched but the command's own output. In the end
``pytest tests/test_corpus.py`` prints figures of all cases.
"""

# a line for a case, however long
# ruff: noqa: E501

from __future__ import annotations

import importlib.util
import json
import os
import re
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
import threading
import zipfile
from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import test_formats
from certifying import classifier
from conftest import SHIFT, blob_scene, ring
from corpus import Bench, Row, check, row, rows_by_name
from nerfs import tiny_scene

from ns_abstract.api.cell_search import CellSearch
from ns_abstract.api.certification import CertifySettings, open_certification
from ns_abstract.api.certifying import CertificateQuestion
from ns_abstract.api.compiling import compile_beside
from ns_abstract.api.files import Settings, open_job
from ns_abstract.geometry.keyframe_cameras import path_json
from ns_abstract.io.atomic import write_json
from ns_abstract.io.folder import MARK, claim
from ns_abstract.io.stamps import file_stamp
from ns_abstract.methods.nerf.occupancy import OccupancyGrid
from ns_abstract.methods.nerf.write import write_nerf_run
from ns_abstract.methods.splat.load import load_scene
from ns_abstract.methods.splat.write import write_ply, write_splatfacto_run
from ns_abstract.refine.result import FrameResult, TracePoint
from ns_abstract.report.certificate import write_certificate
from ns_abstract.report.record import Report, RunRecord
from ns_abstract.verify.search_results import BlockResult, FinishedCell

SIZE = 16
PREPROCESS = {"resize": [SIZE, SIZE], "mean": [0.4, 0.45, 0.5], "std": [0.25, 0.25, 0.3]}
PROPERTY = {"type": "classification", "label": 0, "preprocess": PREPROCESS}
UNSAFE = "(declare-const Y_0 Real)\n(declare-const Y_1 Real)\n(assert (<= Y_0 Y_1))\n"
GRID = {"occupied": np.ones((2, 2, 2), bool), "aabb": np.array([[-1.0] * 3, [1.0] * 3])}
#: A step sideways by the first of the network's outputs.
LOOP: dict[str, Any] = {
    "version": 1, "state": ["x"], "initial": {"x": [-0.01, 0.01]}, "steps": 2, "sampling_time": 0.1,
    "dynamics": {"type": "affine", "A": [[1.0]], "B": [[0.001, 0.0, 0.0]]},
    "camera": {
        "camera_to_world": [[0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]],
        "position": {"offset": [1.6, 0.0, 0.0], "matrix": [[0.0], [1.0], [0.0]]},
    },
    "network": "net.onnx", "preprocess": PREPROCESS, "control": {}, "unsafe": [{"box": {"x": [0.5, None]}}],
}  # fmt: skip
#: Bytes of a case that really works.
WORK = 4 << 30


# ---------------------------------------------------------------- base files


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Iterator[Bench]:
    folder = tmp_path_factory.mktemp("corpus")
    base = folder / "base"
    base.mkdir()
    scene = blob_scene(4, degree=1)
    files = {
        "config": write_splatfacto_run(scene, base, timestamp="run", experiment_name="blobs", views=ring(2, 8)),
        "nerf": write_nerf_run(tiny_scene(), base, timestamp="run", experiment_name="tiny", views=ring(2, 8)),
        "path": write_json(base / "path.json", path_json(ring(2, SIZE))),
        "nerf_path": write_json(base / "nerf_path.json", path_json(ring(2, 4))),
        "spec": write_json(base / "spec.json", SHIFT),
        "prop": write_json(base / "prop.json", PROPERTY),
        "net": classifier(base / "net.onnx", SIZE),
        "grid": base / "grid.npz",
        "lib": base / "unsafe.vnnlib",
        "loop": write_json(base / "loop.json", LOOP),
        "results": base / "results",
        "search": base / "search",
    }
    files["lib"].write_text(UNSAFE)
    OccupancyGrid.of_box(-np.ones(3), np.ones(3), np.ones((2, 2, 2), bool)).write(files["grid"])
    write_ply(load_scene(files["config"]), base / "scene.ply")
    write_results(files)
    write_search(files)
    found = Bench(folder, files | {"scene_ply": base / "scene.ply"})
    yield found
    found.server.close()
    # what is captured here, nobody sees
    capture = request.config.pluginmanager.getplugin("capturemanager")
    with capture.global_and_fixture_disabled() if capture else nullcontext():
        print(f"\n{found.summary}")


def write_results(files: dict[str, Path]) -> None:
    """What ns-abstract-render leaves, without the work: two frames of bounds that say nothing new."""
    job = open_job(Settings(files["config"], files["path"], files["spec"]))
    run = RunRecord(
        guarantee="float32-sound", renderer=job.method.program, scene=job.describe(), frames=(0, 1),
        fingerprint=job.fingerprint, settings={"target_ratio": 1.05},
    )  # fmt: skip
    report = Report(files["results"], run)
    for index in range(2):
        image = np.full((SIZE, SIZE, 3), 0.5, np.float32)
        low, high = image - np.float32(0.125), image + np.float32(0.125)
        box = job.pose_sets[index].box
        trace = (TracePoint(1.0, 1, 0.1, 0.1),)
        report.add(FrameResult(index, box, low, high, low, high, image, 1.0, 1, trace), "done")
    report.finish("done")


def write_search(files: dict[str, Path]) -> None:
    """What ns-abstract-certify leaves, without the work: some cells with a verdict, some open blocks, a report."""
    settings = CertifySettings(Settings(files["config"], files["path"], files["spec"]), files["net"], files["prop"])
    job = open_certification(settings)
    # kernels are compiled here, which no case is charged for
    compile_beside(job.job, 0)
    job.job.warm_up(0)
    question = CertificateQuestion(job, [0, 1], {}, ("ns-abstract-certify",))
    search = CellSearch(question, files["search"])
    store = search.open(resume=False)
    for block in store.pending(set(), 3):
        leaves = tuple(FinishedCell(cell, "unknown", None, 0.1, reason="the finest cell") for cell in block.cells)
        store.close_block(block, BlockResult(leaves, (), (), 0, 0.1), search.grids[block.frame])
    document, _ = question.reports(search).document(store, "interrupted")
    write_certificate(files["search"], document, "<html></html>")
    store.close()


# ---------------------------------------------------------------- rows


def edited(**changes: Any) -> Any:
    """A change of a JSON file: keys replaced, removed where the value is `...`."""

    def change(file: Path) -> None:
        value = json.loads(file.read_text())
        for name, new in changes.items():
            value.pop(name, None) if new is ... else value.__setitem__(name, new)
        file.write_text(json.dumps(value))

    return change


def entry(**changes: Any) -> Any:
    """A change of a camera path's first entry."""

    def change(file: Path) -> None:
        value = json.loads(file.read_text())
        value["camera_path"][0] |= changes
        file.write_text(json.dumps(value))

    return change


def fifo(file: Path) -> None:
    """A pipe that nobody writes to, in place of a file."""
    file.unlink(missing_ok=True)
    os.mkfifo(file)


def folder(file: Path) -> None:
    """A folder in place of a file."""
    file.unlink(missing_ok=True)
    file.mkdir()


def absent(file: Path) -> None:
    """No file."""
    file.unlink(missing_ok=True)


def cut(count: int) -> Any:
    """The file without its last bytes."""
    return lambda file: file.write_bytes(file.read_bytes()[:-count])


def replaced(old: str, new: str) -> Any:
    """A change of config.yml's text."""

    def change(text: str) -> str:
        assert old in text
        return text.replace(old, new)

    return change


def ply(change: Any = None) -> Any:
    """The base scene as .ply, changed."""

    def write(file: Path) -> None:
        shutil.copy(file.parents[1] / "base" / "scene.ply", file)
        if change is not None:
            file.write_bytes(change(file.read_bytes()))

    return write


def frame_file(change: Any, index: int = 0) -> Any:
    """A change of one frame file of the results."""
    return lambda results: change(results / f"frame_{index:05d}.npz")


def onnx_file(change: Any) -> Any:
    """A change of the network's messages."""

    def write(file: Path) -> None:
        model = onnx.load(str(file))
        change(model)
        file.write_bytes(model.SerializeToString())

    return write


def layers(*nodes: Any, shape: tuple[int, ...] = (3, SIZE, SIZE), **weights: Any) -> Any:
    """Another network; ``weights`` by name, the last node makes the output."""

    def write(file: Path) -> None:
        sizes = ["N", *shape]
        graph = onnx.helper.make_graph(
            list(nodes), "net", [onnx.helper.make_tensor_value_info("image", onnx.TensorProto.FLOAT, sizes)],
            [onnx.helper.make_tensor_value_info(nodes[-1].output[0], onnx.TensorProto.FLOAT, None)],
            [onnx.numpy_helper.from_array(np.asarray(v), name) for name, v in weights.items()],
        )  # fmt: skip
        model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8)
        file.write_bytes(model.SerializeToString())

    return write


node = onnx.helper.make_node


def external(location: str, place: Any = None, **more: str) -> Any:
    """The first weights stand in another file, which ``place`` makes."""

    def change(file: Path) -> None:
        model = onnx.load(str(file))
        tensor = model.graph.initializer[0]
        if place is not None:
            place(file.parent / location)
        tensor.ClearField("raw_data")
        tensor.data_location = onnx.TensorProto.EXTERNAL
        for key, value in {"location": location, **more}.items():
            tensor.external_data.add(key=key, value=value)
        file.write_bytes(model.SerializeToString())

    return change


def sparse(size: int, head: bytes = b"") -> Any:
    """A file of ``size`` bytes that takes none."""

    def write(file: Path) -> None:
        with file.open("wb") as stream:
            stream.write(head)
            stream.truncate(size)

    return write


def arrays(**found: Any) -> Any:
    """An .npz of arrays, deflated."""
    return lambda file: np.savez_compressed(file, **found)


def damaged_lzma(file: Path) -> None:
    """A grid compressed by LZMA, the data spoilt."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_LZMA) as archive:
        for name, array in GRID.items():
            with archive.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array(member, array)
    data = bytearray(file.read_bytes())
    data[60:90] = bytes(30)
    file.write_bytes(bytes(data))


def resumed(**changes: Any) -> Any:
    """Results whose first frame has other arrays, and whose report knows it."""

    def change(results: Path) -> None:
        file = results / "frame_00000.npz"
        with np.load(file) as stored:
            found = dict(stored) | {k: v(stored[k]) for k, v in changes.items()}
        np.savez_compressed(file, **found)
        report = json.loads((results / "report.json").read_text())
        report["sha256"][file.name] = file_stamp(file)["sha256"]
        (results / "report.json").write_text(json.dumps(report))

    return change


def link(target: str) -> Any:
    """A link in place of a file."""

    def write(file: Path) -> None:
        file.unlink(missing_ok=True)
        file.symlink_to(target)

    return write


RESUME = "--resume --output-dir {here}/results"

OPTIONS = [
    row("render", "no such option", "--bogus", options="--bogus 1"),
    row("render", "frame out of range", "--frames", options="--frames 7"),
    row("render", "negative frame", "--frames", options="--frames -1"),
    row("render", "ratio below 1", "--target-ratio", options="--target-ratio 0.5"),
    row("render", "ratio NaN", "--target-ratio", options="--target-ratio nan"),
    row("render", "budget 0", "--time-budget", options="--time-budget 0"),
    row("render", "budget infinite", "--time-budget", options="--time-budget inf"),
    row("render", "memory 0", "--memory-limit", options="--memory-limit 0"),
    row("render", "memory negative", "--memory-limit", options="--memory-limit -4"),
    row("render", "memory NaN", "--memory-limit", options="--memory-limit nan"),
    row("render", "seed negative", "--seed", options="--seed -1"),
    row("render", "workers 0", "--workers", options="--workers 0"),
    row("render", "scheduler without dask", "--scheduler-address", options="--scheduler-address 127.0.0.1:1"),
    row("render", "downscale 0", "downscale", options="--downscale-factor 0"),
    row("render", "downscale NaN", "downscale", options="--downscale-factor nan"),
    row("render", "downscale 1e9", "downscale", options="--downscale-factor 1e9"),
    row("render", "renderer unknown", "renderer", options="--renderer blender"),
    row("render", "NeRF option on a splat", "num-samples", options="--num-samples 5"),
    row("nerf", "samples 0", "--num-samples", options="--num-samples 0"),
    row("nerf", "samples 10^9", "--num-samples", options="--num-samples 1000000000"),
    row("nerf", "near plane negative", "--near-plane", options="--near-plane -1"),
    row("nerf", "near plane NaN", "--near-plane", options="--near-plane nan"),
    row("nerf", "arithmetic float32", "arithmetic", options="--arithmetic float32"),
    row("certify", "budget negative", "--time-budget", options="--time-budget -1"),
    row("certify", "workers 0", "--workers", options="--workers 0"),
    row("certify", "memory NaN", "--memory-limit", options="--memory-limit nan"),
    row("certify", "frames out of range", "--frames", options="--frames 5"),
    row("bench", "no such benchmark", "bogus", options="bogus"),
    row("bench", "scale without a run", "--load-config", options="scale --no-load-config"),
    row("bench", "case that is not there", "--cases", options="stiff --cases nothing --no-load-config --no-camera-path-filename"),
    row("bench", "set that is not there", "sideways", options="cell --sets sideways"),
    row("demo", "no such option", "--bogus", options="--bogus 1"),
    row("demo", "output without a name", "--output-dir", options=("--output-dir",)),
    row("demo", "flag with a value", "maybe", options="--splats-only maybe"),
    row("vnnlib", "timeout 0", "--timeout", options="--timeout 0"),
    row("vnnlib", "parts 0", "--parts", options="--parts 0"),
    row("vnnlib", "parts of other number", "--parts", options="--parts 2 2 2"),
    row("occupancy", "resolution 0", "--resolution", options="--resolution 0"),
    row("occupancy", "resolution 10^6", "--resolution", options="--resolution 1000000"),
    row("occupancy", "box reversed", "--aabb", options="--aabb 1 1 1 0 0 0"),
    row("occupancy", "box NaN", "--aabb", options="--aabb nan 0 0 1 1 1"),
    row("occupancy", "threshold negative", "--threshold", options="--threshold -1"),
    row("png", "no pictures", "--pictures", options="--pictures"),
    row("mp4", "rate 0", "fps", options="--fps 0"),
]  # fmt: skip

RUNS = [
    row("render", "config absent", "no such", options="--load-config {here}/none.yml"),
    row("render", "config empty", "empty", yml=""),
    row("render", "config is a list", "mapping", yml="- 1\n- 2\n"),
    row("render", "config binary", "UTF-8", yml=b"\xff\xfe\x00\x01"),
    row("render", "config runs a command", "config.yml", yml="!!python/object/apply:os.system ['touch hacked']"),
    row("render", "config nested", "levels deep", yml="a: " + "[" * 100 + "]" * 100),
    row("render", "config of aliases", "alias", yml="a: &a [1]\nb: &b [*a,*a,*a,*a,*a,*a,*a,*a]\n" + "".join(f"{chr(c + 1)}: &{chr(c + 1)} [{','.join(['*' + chr(c)] * 8)}]\n" for c in range(98, 105))),
    row("render", "config with a key twice", "twice", yml="a: 1\na: 2\n"),
    row("render", "config without a model", "pipeline", yml="method_name: splatfacto\n"),
    row("render", "degree 99", "sh_degree", yml=replaced("sh_degree: 3", "sh_degree: 99")),
    row("render", "checkpoint empty", "checkpoint", ckpt=b""),
    row("render", "checkpoint cut off", "checkpoint", ckpt=cut(100)),
    row("render", "checkpoint of zeros", "checkpoint", ckpt=bytes(5000)),
    row("render", "checkpoint is a pipe", "checkpoint", ckpt=fifo),
    row("render", "transforms empty", "empty", transforms=b""),
    row("render", "transforms singular", "determinant", transforms={"transform": [[0, 0, 0, 0]] * 3, "scale": 1}),
    row("render", "transforms scale 0", "scale", transforms={"transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], "scale": 0}),
    row("certify", "config absent", "no such", options="--load-config {here}/none.yml"),
    row("ply", "config absent", "no such", options="--load-config {here}/none.yml"),
    row("ply", "NeRF as splat", "splat", options="--load-config {here}/../base/tiny/vanilla-nerf/run/config.yml"),
    row("occupancy", "splat as NeRF", "splat", options="--load-config {here}/../base/blobs/splatfacto/run/config.yml"),
    row("render", "ply empty", "header", scene=b""),
    row("render", "ply cut off", "cut off", scene=ply(lambda data: data[:-50])),
    row("render", "ply of 10^12 rows", "claims", scene=ply(lambda data: data.replace(b"element vertex 4", b"element vertex 100000000000"))),
    row("render", "ply without opacity", "opacity", scene=ply(lambda data: data.replace(b"opacity", b"opaciti"))),
]  # fmt: skip

PATHS = [
    row("render", "path absent", "no such", options="--camera-path-filename {here}/none.json"),
    row("render", "path empty", "empty", path=b""),
    row("render", "path is a list", "object", path=[1]),
    row("render", "path nested", "levels deep", path="[" * 5000 + "]" * 5000),
    row("render", "path of a long number", "too large", path='{"a": ' + "9" * 5000 + "}"),
    row("render", "path with NaN", "NaN", path='{"a": NaN}'),
    row("render", "path with a key twice", "twice", path='{"a": 1, "a": 2}'),
    row("render", "path is a pipe", "regular file", path=fifo),
    row("render", "path is a folder", "folder", path=folder),
    row("render", "path without cameras", "camera_path", path=edited(camera_path=[])),
    row("render", "picture of 10^9 rows", "render_height", path=edited(render_height=10**9)),
    row("render", "picture of 1.5 rows", "render_height", path=edited(render_height=1.5)),
    row("render", "fisheye", "camera_type", path=edited(camera_type="fisheye")),
    row("render", "field of view 0", "fov", path=entry(fov=0)),
    row("render", "field of view 180", "fov", path=entry(fov=180)),
    row("render", "matrix of zeros", "camera_to_world", path=entry(camera_to_world=[0] * 16)),
    row("render", "matrix of 15 numbers", "camera_to_world", path=entry(camera_to_world=[0] * 15)),
    row("render", "matrix of 1e300", "camera_to_world", path=entry(camera_to_world=[1e300] * 16)),
    row("render", "matrix that mirrors", "mirrors", path=entry(camera_to_world=[-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1])),
    row("render", "picture beyond memory", "--memory-limit", path=edited(render_height=16000, render_width=16000), options="--memory-limit 0.5"),
    row("certify", "path empty", "empty", path=b""),
]  # fmt: skip

SETS = [
    row("render", "set absent", "no such", options="--perturbation-filename {here}/none.json"),
    row("render", "set is a number", "object", spec="3"),
    row("render", "set of version 2", "version", spec={"version": 2}),
    row("render", "set with an unknown key", "unknown key", spec={"translations": {"x": 1}}),
    row("render", "set reversed", "reversed", spec={"translation": {"x": [1, 0]}}),
    row("render", "set with text", "translation.x", spec={"translation": {"x": "far"}}),
    row("render", "set with 1e999", "too large", spec='{"translation": {"x": 1e999}}'),
    row("render", "set with a negative radius", "negative", spec={"translation": {"x": -1}}),
    row("render", "orbit without axis", "orbit.axis", spec={"orbit": {"target": [0, 0, 0], "azimuth": [0, 1]}}),
    row("render", "orbit about nothing", "orbit.axis", spec={"orbit": {"target": [0, 0, 0], "axis": [0, 0, 0], "azimuth": [0, 1]}}),
    row("render", "hue of a splat", "hue", spec={"hue": 0.1}),
    row("render", "variation that selects nothing", "scene[0]", spec={"scene": [{"select": {"opacity": [2, 3]}, "mean": 1}]}),
    row("render", "variation of index 10^9", "scene[0]", spec={"scene": [{"select": {"indices": [10**9]}, "mean": 1}]}),
    row("nerf", "variation of a NeRF", "scene", spec={"scene": [{"select": {}, "mean": 1}]}),
]  # fmt: skip

PROPERTIES = [
    row("certify", "property absent", "no such", options="--property {here}/none.json"),
    row("certify", "property empty", "empty", prop=b""),
    row("certify", "property of no type", "type", prop=edited(type=...)),
    row("certify", "label out of range", "label", prop=edited(label=3)),
    row("certify", "label true", "label", prop=edited(label=True)),
    row("certify", "unknown key", "lable", prop=edited(lable=1)),
    row("certify", "partitions 10^30", "partitions", prop=edited(partitions=10**30)),
    row("certify", "std 0", "preprocess.std", prop=edited(preprocess=PREPROCESS | {"std": [0, 1, 1]})),
    row("certify", "mean 1e300", "preprocess.mean", prop=edited(preprocess=PREPROCESS | {"mean": [1e300, 1, 1]})),
    row("certify", "resize other than the network", "preprocess.resize", prop=edited(preprocess={"resize": [8, 8]})),
    row("certify", "tolerance 1e308", "tolerance", prop={"type": "regression", "target": [0, 0, 0], "tolerance": {"absolute": 1e308}, "preprocess": PREPROCESS}),
    row("certify", "scale 1e308", "scale", prop={"type": "regression", "target": "camera", "scale": 1e308, "tolerance": {"relative": 1}, "preprocess": PREPROCESS}),
    row("certify", "VNN-LIB with an open bracket", "closed", lib="(assert (<= Y_0 1)"),
    row("certify", "VNN-LIB nested", "deep", lib="(" * 5000),
    row("certify", "VNN-LIB with factors that overflow", "overflow", lib="(declare-const Y_0 Real)(assert (<= (* 1e300 (* 1e300 Y_0)) 1))"),
    row("certify", "VNN-LIB of another network", "Y_9", lib="(declare-const Y_9 Real)(assert (<= Y_9 1))"),
    row("certify", "VNN-LIB of many cases", "combinations", lib="(declare-const Y_0 Real)" + "(assert (or (<= Y_0 1) (<= Y_0 2) (<= Y_0 3)))" * 30),
    row("vnnlib", "property of type regression", "linear", prop={"type": "regression", "target": [0, 0, 0], "tolerance": {"absolute": 1}, "preprocess": PREPROCESS}, memory=WORK),
]  # fmt: skip

RESULTS = [
    row("npz", "results absent", "cannot be listed", options="--input-dir {here}/none"),
    row("npz", "results of no frames", "no frame", results=lambda f: [x.unlink() for x in f.glob("frame_*.npz")]),
    row("npz", "frame cut off", "frame_00000.npz", results=frame_file(cut(500))),
    row("png", "frame empty", "frame_00001.npz", results=frame_file(lambda f: f.write_bytes(b""), 1)),
    row("png", "frame of another number", "not as report.json", results=frame_file(lambda f: shutil.copy(f, f.with_name("frame_00007.npz")))),
    row("npz", "output is a folder", "written", options="--output-filename {here}"),
    row("render", "frame damaged, resumed", "not used: frame_00000.npz", results=frame_file(cut(500)), options=f"{RESUME} --frames 1", code=0, memory=WORK),
    row("render", "results of another set, resumed", "fingerprint", results=lambda f: None, spec={"translation": {"x": 0.5}}, options=RESUME, memory=WORK),
]  # fmt: skip


def _strangers(**files: str) -> Any:
    """The folder of results holds others' files alone."""

    def change(results: Path) -> None:
        for file in results.iterdir():
            file.unlink()
        for name, content in files.items():
            (results / name.replace("__", ".")).write_text(content)

    return change


INTO = "--output-dir {here}/results"

OUTPUTS = [
    row("render", "output is a file", "name a folder", options="--output-dir {spec}"),
    row("render", "output below a file", "name a folder", options="--output-dir {spec}/out"),
    row("render", "output of no name", "is empty", options=("--output-dir", "")),
    row("render", "output of no name, joined", "is empty", options=("--output-dir=",)),
    row("render", "output of a long name", "shorter name", options="--output-dir {here}/" + 300 * "x"),
    row("render", "report of others", "report.json stands there", results=_strangers(report__json='{"mine": 1}'), options=INTO),
    row("render", "page of others", "report.html stands there", results=_strangers(report__html="mine"), options=INTO),
    row("render", "frame of others, resumed", "frame_00000.npz stands there", results=_strangers(frame_00000__npz="mine"), options=RESUME),
    row("certify", "database of others", "cells.sqlite stands there", results=_strangers(cells__sqlite="mine"), options=INTO),
    row("certify", "authority without its fellows", "--tls-cert", options="--engine dask --workers 1 --scheduler-address h:1 --tls-ca-file {spec}"),
]  # fmt: skip

ON = "--resume --output-dir {here}/search --workers 1 --time-budget 1"


def database(change: Any) -> Any:
    """A change of a search's cells.sqlite: a function of the file, or SQL."""

    def write(search: Path) -> Any:
        file = search / "cells.sqlite"
        if not isinstance(change, str):
            return change(file)
        with closing(sqlite3.connect(file)) as base, base:
            base.executescript(change)
        return None

    return write


@contextmanager
def _kept_busy(file: Path) -> Iterator[None]:
    """Another program writes to a database all the time."""
    code = (
        "import sqlite3, sys; base = sqlite3.connect(sys.argv[1], isolation_level=None); "
        "base.execute('PRAGMA locking_mode=EXCLUSIVE'); base.execute('BEGIN EXCLUSIVE'); print(flush=True); input()"
    )
    command = [sys.executable, "-c", code, str(file)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        process.stdout.readline()
        yield
        process.kill()


@contextmanager
def _locked(search: Path) -> Iterator[None]:
    """Another command works in the folder."""
    with closing(claim(search)):
        yield


def replaced_by(content: bytes) -> Any:
    """A file of other content."""
    return lambda file: file.write_bytes(content)


def spoilt(place: int, count: int) -> Any:
    """A file in which some bytes are others."""

    def write(file: Path) -> None:
        data = bytearray(file.read_bytes())
        data[place : place + count] = bytes(b ^ 0x5A for b in data[place : place + count])
        file.write_bytes(bytes(data))

    return write


def beside(suffix: str, place: Any) -> Any:
    """What lies beside cells.sqlite: its log, or what SQLite takes for it."""
    return lambda file: place(file.with_name(file.name + suffix))


def another_database(file: Path) -> None:
    """The database of another program."""
    file.unlink()
    with closing(sqlite3.connect(file)) as base, base:
        base.execute("CREATE TABLE search_state(key TEXT, value TEXT)")


SEARCHES = [
    row("certify", "search continued", "3 cells kept from before", search=lambda f: None, options=ON, code=0, memory=WORK),
    row("certify", "search held by another program", "is locked", search=database(_kept_busy), options=ON),
    row("certify", "search held by another command", "still running", search=_locked, options=ON),
    row("certify", "search of another version", "another version", search=database("UPDATE search_state SET value = '1' WHERE key = 'version'"), options=ON),
    row("certify", "search of another network", "model", search=lambda f: None, options=ON, net=onnx_file(lambda m: setattr(m, "producer_name", "x"))),
    row("certify", "search of another property", "property", search=lambda f: None, options=ON, prop=edited(label=1)),
    row("certify", "search of another set", "poses", search=lambda f: None, options=ON, spec={"version": 1, "translation": {"x": 0.2}}),
    row("certify", "database empty", "cannot be used", search=database(replaced_by(b"")), options=ON),
    row("certify", "database of zeros", "cannot be used", search=database(replaced_by(bytes(20000))), options=ON),
    row("certify", "database of noise", "cannot be used", search=database(replaced_by(bytes(range(256)) * 80)), options=ON),
    row("certify", "database of a text", "cannot be used", search=database(replaced_by(b"SQLite format 3\0" + b"x" * 5000)), options=ON),
    row("certify", "database cut off", "cannot be used", search=database(cut(9000)), options=ON),
    row("certify", "database cut to its head", "cannot be used", search=database(lambda f: f.write_bytes(f.read_bytes()[:100])), options=ON),
    row("certify", "database with a spoilt head", "cannot be used", search=database(spoilt(0, 16)), options=ON),
    row("certify", "database with a spoilt page size", "cannot be used", search=database(spoilt(16, 2)), options=ON),
    row("certify", "database with a spoilt schema", "cannot be used", search=database(spoilt(100, 400)), options=ON),
    row("certify", "database with spoilt pages", "cannot be used", search=database(spoilt(4096, 16000)), options=ON),
    row("certify", "database is a folder", "no regular file", search=database(lambda f: (f.unlink(), f.mkdir())), options=ON),
    row("certify", "database is a pipe", "no regular file", search=database(fifo), options=ON),
    row("certify", "database is a link", "no regular file", search=database(lambda f: (f.rename(f.with_name("elsewhere")), f.symlink_to("elsewhere"))), options=ON),
    row("certify", "database is a link to nowhere", "no regular file", search=database(lambda f: (f.unlink(), f.symlink_to("nowhere"))), options=ON),
    row("certify", "database of another program", "another version", search=database(another_database), options=ON),
    row("certify", "log is a folder", "cannot be used", search=database(beside("-wal", lambda f: f.mkdir())), options=ON),
    row("certify", "log of noise", "cells kept from before", search=database(beside("-wal", lambda f: f.write_bytes(bytes(range(256)) * 40))), options=ON, code=0, memory=WORK),
    row("certify", "cells dropped", "cannot be used", search=database("DROP TABLE cells"), options=ON),
    row("certify", "cells made certified", "changed since", search=database("UPDATE cells SET verdict = 'certified', margin = 1.0"), options=ON),
    row("certify", "cells doubled", "changed since", search=database("INSERT INTO cells SELECT * FROM cells"), options=ON),
    row("certify", "cells without open blocks", "changed", search=database("DELETE FROM search_blocks"), options=ON),
    row("certify", "cells that a view stands for", "tables", search=database("ALTER TABLE cells RENAME TO other; CREATE VIEW cells AS SELECT * FROM other"), options=ON),
    row("certify", "cells with a trigger", "tables", search=database("CREATE TRIGGER t AFTER INSERT ON cells BEGIN UPDATE cells SET verdict = 'certified'; END"), options=ON),
    row("certify", "blocks of cells outside", "changed", search=database("UPDATE search_blocks SET cells = '[[[99999999], [999999999]]]'"), options=ON),
    row("certify", "state nested", "cannot be used", search=database("UPDATE search_state SET value = replace(hex(zeroblob(50000)), '0', '[') WHERE key = 'seals'"), options=ON),
    row("certify", "state of NULL", "cannot be used", search=database("UPDATE search_state SET value = NULL WHERE key = 'fingerprint'"), options=ON),
    row("certify", "state of bytes", "cannot be used", search=database("UPDATE search_state SET value = x'ff00' WHERE key = 'fingerprint'"), options=ON),
    row("certify", "search without its report", "cells kept from before", search=lambda f: (f / "report.json").unlink(), options=ON, code=0, memory=WORK),
    row("certify", "search with a report of noise", "cells kept from before", search=lambda f: (f / "report.json").write_bytes(bytes(range(256))), options=ON, code=0, memory=WORK),
    row("certify", "lock is a folder", "cannot be written", search=lambda f: ((f / MARK).unlink(missing_ok=True), (f / MARK).mkdir()), options=ON),
    row("certify", "lock is a link", "cannot be written", search=lambda f: ((f / MARK).unlink(missing_ok=True), (f / MARK).symlink_to("mine.txt")), options=ON),
    row("certify", "output where nothing can be made", "cannot be written", options="--output-dir /proc/out"),
    row("render", "output where nothing can be made", "cannot be written", options="--output-dir /proc/out"),
    row("certify", "disk full at the beginning", "cannot be", options="--workers 1", room=4096, memory=WORK),
    row("certify", "disk full in the middle", "make room", options="--workers 1", room=1 << 17, memory=WORK),
    row("certify", "disk full, continued", "make room", search=lambda f: None, options=ON, room=1 << 15, memory=WORK),
    row("render", "disk full", "make room", options="--target-ratio 3", room=1 << 10, memory=WORK),
    row("npz", "disk full", "out.npz", room=1 << 10),
    row("ply", "disk full", "out.ply", room=100),
]  # fmt: skip


@contextmanager
def silent() -> Iterator[int]:
    """A port that takes connections and says nothing."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()[1]


@contextmanager
def rude() -> Iterator[int]:
    """A port that answers in another language."""

    def answer() -> None:
        with suppress(OSError):
            while True:
                connection, _ = server.accept()
                with connection, suppress(OSError):
                    connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n" * 100)

    with socket.create_server(("127.0.0.1", 0)) as server:
        threading.Thread(target=answer, daemon=True).start()
        yield server.getsockname()[1]
        server.shutdown(socket.SHUT_RDWR)


DASK = "--engine dask --workers 1 --scheduler-address "

CLUSTERS = [
    row("certify", "scheduler that is not there", "no scheduler answers", options=DASK + "127.0.0.1:1"),
    row("render", "scheduler that is not there", "no scheduler answers", options="--engine dask --scheduler-address 127.0.0.1:1"),
    row("nerf", "scheduler that is not there", "no scheduler answers", options="--engine dask --scheduler-address 127.0.0.1:1"),
    row("certify", "scheduler that says nothing", "no scheduler answers", options=DASK + "127.0.0.1:{port}", listener=silent),
    row("certify", "scheduler of another kind", "no scheduler answers", options=DASK + "127.0.0.1:{port}", listener=rude),
    row("certify", "scheduler without a port", "no scheduler answers", options=DASK + "tcp://"),
    row("certify", "scheduler of a large port", "no scheduler answers", options=DASK + "127.0.0.1:99999999"),
    row("certify", "scheduler of a negative port", "no scheduler answers", options=DASK + "127.0.0.1:-1"),
    row("certify", "scheduler of a port in words", "no scheduler answers", options=DASK + "127.0.0.1:port"),
    row("certify", "scheduler of another protocol", "no scheduler answers", options=DASK + "gopher://127.0.0.1:70"),
    row("certify", "scheduler half in brackets", "no scheduler answers", options=DASK + "[::1"),
    row("certify", "scheduler of no host", "no scheduler answers", options=DASK + "no.such.host.invalid:8786"),
    row("certify", "scheduler with escapes", "no scheduler answers", options=DASK + "\x1b[31mred:1"),
    row("certify", "scheduler of no name", "is empty", options=("--engine", "dask", "--scheduler-address", "")),
    row("certify", "authority that is no certificate", "PEM", options=DASK + "127.0.0.1:1 --tls-ca-file {spec} --tls-cert {spec} --tls-key {spec}"),
    row("certify", "engine unknown", "engine", options="--engine spark"),
]  # fmt: skip

LONG = "--time-budget 600"

SIGNALS = [
    row("certify", "SIGINT", "", options=f"{LONG} --workers 1", signals=(signal.SIGINT,), after="larger than", code=3, memory=WORK, prop={"type": "classification", "label": 0, "preprocess": PREPROCESS, "partitions": 100000}),
    row("certify", "SIGTERM", "", options=f"{LONG} --workers 1", signals=(signal.SIGTERM,), after="larger than", code=3, memory=WORK, prop={"type": "classification", "label": 0, "preprocess": PREPROCESS, "partitions": 100000}),
    row("certify", "SIGINT twice", "", options=f"{LONG} --workers 1", signals=(signal.SIGINT, signal.SIGINT), after="larger than", code=3, memory=WORK, prop={"type": "classification", "label": 0, "preprocess": PREPROCESS, "partitions": 100000}),
    row("certify", "SIGTERM and SIGINT", "", options=f"{LONG} --workers 2", signals=(signal.SIGTERM, signal.SIGINT), after="larger than", code=3, memory=WORK, prop={"type": "classification", "label": 0, "preprocess": PREPROCESS, "partitions": 100000}),
    row("certify", "SIGHUP", "", options=f"{LONG} --workers 1", signals=(signal.SIGHUP,), after="larger than", code=-1, memory=WORK, prop={"type": "classification", "label": 0, "preprocess": PREPROCESS, "partitions": 100000}),
    row("render", "SIGINT", "", options=f"{LONG} --target-ratio 1.00001", signals=(signal.SIGINT,), after="gsplat", code=3, memory=WORK),
    row("render", "SIGTERM", "", options=f"{LONG} --target-ratio 1.00001", signals=(signal.SIGTERM,), after="gsplat", code=3, memory=WORK),
    row("render", "SIGINT twice", "", options=f"{LONG} --target-ratio 1.00001", signals=(signal.SIGINT, signal.SIGINT), after="gsplat", code=3, memory=WORK),
    row("nerf", "SIGINT", "", options=f"{LONG} --target-ratio 1.00001 --workers 1", signals=(signal.SIGINT,), after="vanilla NeRF", code=3, memory=WORK),
    row("nerf", "SIGTERM, hierarchical", "", options=f"{LONG} --target-ratio 1.00001 --workers 1 --sampling hierarchical", signals=(signal.SIGTERM,), after="vanilla NeRF", code=3, memory=WORK),
]  # fmt: skip

#: Two parameters, and the runs that go wrong lie beyond a slanted line: a search of minutes.
SLANTED: dict[str, Any] = {
    "state": ["x", "y"], "initial": {"x": [0.0, 0.9], "y": [-1.0, 1.0]}, "steps": 8,
    "dynamics": {"type": "affine", "A": [[1.0, 0.01], [0.0, 1.0]], "B": [[0.001, 0.0, 0.0], [0.0, 0.0, 0.0]]},
    "camera": LOOP["camera"] | {"position": {"offset": [1.6, 0.0, 0.0], "matrix": [[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]]}},
    "unsafe": [{"box": {"x": [0.45, None]}}],
}  # fmt: skip

LOOPS = [
    row("reach", "good", "safe: certified", code=0, memory=WORK),
    row("reach", "done on a full disk", "cannot be used", room=1 << 15, memory=WORK),
    row("reach", "SIGINT", "", signals=(signal.SIGINT,), after="safe", options=LONG, code=3, memory=WORK, loop=edited(**SLANTED)),
    row("reach", "loop absent", "none.json", options="--loop {here}/none.json"),
    row("reach", "loop empty", "is empty", loop=b""),
    row("reach", "loop not text", "UTF-8", loop=b"\xff\x00\xfe"),
    row("reach", "loop nested", "JSON", loop="[" * 100000),
    row("reach", "loop a list", "an object", loop=[]),
    row("reach", "loop is a folder", "folder", loop=folder),
    row("reach", "loop is a pipe", "regular file", loop=fifo),
    row("reach", "unknown key", "bogus", loop=edited(bogus=1)),
    row("reach", "version 2", "version", loop=edited(version=2)),
    row("reach", "no states", "state", loop=edited(state=[])),
    row("reach", "states of one name", "state", loop=edited(state=["x", "x"])),
    row("reach", "name with escapes", "state", loop=edited(state=["\x1b[2J"])),
    row("reach", "range upside down", "initial.x", loop=edited(initial={"x": [1.0, -1.0]})),
    row("reach", "range infinite", "Infinity", loop=edited(initial={"x": [0.0, float("inf")]})),
    row("reach", "range not a number", "NaN", loop=edited(initial={"x": [0.0, float("nan")]})),
    row("reach", "range of 1e300", "initial.x", loop=edited(initial={"x": [0.0, 1e300]})),
    row("reach", "10^9 steps", "steps", loop=edited(steps=10**9)),
    row("reach", "half a step", "steps", loop=edited(steps=0.5)),
    row("reach", "time stands still", "sampling_time", loop=edited(sampling_time=0.0)),
    row("reach", "dynamics of another kind", "dynamics", loop=edited(dynamics={"type": "bogus"})),
    row("reach", "dynamics of another size", "dynamics", loop=edited(dynamics={"type": "affine", "A": [[1.0, 2.0]], "B": [[1.0]]})),
    row("reach", "dynamics not a number", "NaN", loop=edited(dynamics={"type": "affine", "A": [[float("nan")]], "B": [[1.0, 0.0, 0.0]]})),
    row("reach", "disturbance negative", "disturbance", loop=edited(disturbance={"x": [1.0, 0.0]})),
    row("reach", "camera that stands still", "camera", loop=edited(camera={**LOOP["camera"], "position": {"matrix": [[0.0], [0.0], [0.0]]}})),
    row("reach", "camera no rotation", "camera", loop=edited(camera={**LOOP["camera"], "camera_to_world": [[0.0] * 4] * 4})),
    row("reach", "network elsewhere", "network", loop=edited(network="../../../etc/passwd")),
    row("reach", "network absent", "none.onnx", loop=edited(network="none.onnx")),
    row("reach", "network empty", "net.onnx", net=b"", loop=edited()),
    row("reach", "gain that does not fit", "control.gain", loop=edited(control={"gain": [[1.0], [1.0]]})),
    row("reach", "clip upside down", "control.clip", loop=edited(control={"clip": [[1.0, -1.0]] * 3})),
    row("reach", "10^4 unsafe sets", "unsafe", loop=edited(unsafe=[{"box": {"x": [0.5, None]}}] * 10000)),
    row("reach", "unsafe of another kind", "unsafe[0]", loop=edited(unsafe=[{"ball": 1}])),
    row("reach", "nothing asked", "unsafe", loop=edited(unsafe=...)),
    row("reach", "goal at noon", "goal.when", loop=edited(goal={"box": {"x": [0.0, 1.0]}, "when": "noon"})),
    row("reach", "no such option", "--bogus", options="--bogus 1"),
    row("reach", "scene empty", "", scene=b""),
]  # fmt: skip

GOOD = [
    row("render", "resumed, nothing left to do", "kept from before: frames 0, 1", results=lambda f: None, options=RESUME, code=0, memory=WORK),
    row("npz", "good", "out.npz", code=0),
    row("png", "good", "out", code=0),
    row("ply", "good", "out.ply", code=0),
    row("occupancy", "good", "out.npz", options="--resolution 4 --threshold 0.001", code=0),
]  # fmt: skip

NETWORKS = [
    row("certify", "network absent", "no such", options="--model {here}/none.onnx"),
    row("certify", "network is a folder", "folder", net=folder),
    row("certify", "network is a pipe", "regular file", net=fifo),
    row("certify", "network of another kind", "ending", options="--model {here}/out/mine.txt"),
    row("certify", "network empty", "net.onnx", net=b""),
    row("certify", "network of zeros", "net.onnx", net=bytes(3000)),
    row("certify", "network of noise", "net.onnx", net=bytes(range(256)) * 8),
    row("certify", "network cut off", "net.onnx", net=cut(300)),
    row("certify", "network of 2 GB, sparse", "are stored", net=sparse(2**31 - 5)),
    row("certify", "network of 3 GB, sparse", "are stored", net=sparse(3 * 2**30, b"\x08\x08")),
    row("certify", "network of another operator", "not supported", net=layers(node("NonZero", ["image"], ["y"]))),
    row("certify", "network of another domain", "domain", net=layers(node("Relu", ["image"], ["y"], domain="evil"))),
    row("certify", "network without nodes", "no network", net=onnx_file(lambda m: m.graph.ClearField("node"))),
    row("certify", "network without outputs", "no network", net=onnx_file(lambda m: m.graph.ClearField("output"))),
    row("certify", "network of operator set 99", "operator set", net=onnx_file(lambda m: setattr(m.opset_import[0], "version", 99))),
    row("certify", "network of 2^62 rows", "numbers", net=layers(node("Relu", ["image"], ["y"]), shape=(3, 2**62, 2**62))),
    row("certify", "network of 10^9 rows", "numbers", net=layers(node("Relu", ["image"], ["y"]), shape=(3, 10**9, 4))),
    row("certify", "network of no rows", "shape", net=layers(node("Relu", ["image"], ["y"]), shape=(3, 0, 4))),
    row("certify", "network of one channel", "three channels", net=layers(node("Flatten", ["image"], ["y"]), shape=(1, SIZE, SIZE))),
    row("certify", "network with NaN", "not finite", net=layers(node("Add", ["image", "w"], ["y"]), w=np.full((3, 1, 1), np.nan, np.float32))),
    row("certify", "network with 1e300", "cannot compute", net=layers(node("Mul", ["image", "w"], ["y"]), w=np.full((3, 1, 1), 1e300))),
    row("certify", "network with text", "type", net=layers(node("Add", ["image", "w"], ["y"]), w=np.array(["a", "b"]))),
    row("certify", "network that claims 2^60 numbers", "numbers", net=onnx_file(lambda m: m.graph.initializer[0].dims.__setitem__(0, 2**60))),
    row("certify", "network of negative size", "negative", net=onnx_file(lambda m: m.graph.initializer[0].dims.__setitem__(0, -4))),
    row("certify", "network of other weights", "cannot be read", net=onnx_file(lambda m: m.graph.initializer[0].dims.__setitem__(0, 5))),
    row("certify", "network whose node reads nothing", "not known", net=layers(node("Relu", ["gone"], ["y"]))),
    row("certify", "network that reads itself", "(y)", net=layers(node("Add", ["image", "y"], ["y"]))),
    row("certify", "network padded to 2^60", "numbers", net=layers(node("Pad", ["image", "w"], ["y"]), w=np.array([0, 0, 0, 0, 0, 0, 2**60, 2**60]))),
    row("certify", "network of strides 0", "strides", net=layers(node("MaxPool", ["image"], ["y"], kernel_shape=[2, 2], strides=[0, 0]))),
    row("certify", "network of negative pads", "pads", net=layers(node("MaxPool", ["image"], ["y"], kernel_shape=[2, 2], pads=[-1, -1, 0, 0]))),
    row("certify", "network that doubles itself 30 times", "numbers", net=layers(*[node("Concat", ["image" if k == 0 else f"v{k}"] * 2, [f"v{k + 1}"], axis=1) for k in range(30)]), memory=3 << 30),
    row("certify", "network that doubles its rows 40 times", "numbers", net=layers(*[node("Concat", ["image" if k == 0 else f"v{k}"] * 2, [f"v{k + 1}"], axis=2) for k in range(40)]), memory=3 << 30),
    row("certify", "network as pt2", "torch.export.load", net=lambda f: (f.with_suffix(".pt2").write_bytes(b"PK"), f.with_suffix(".pt2"))[1]),
    row("certify", "external data on a pipe", "regular file", net=external("data.bin", fifo)),
    row("certify", "external data in a folder", "folder", net=external("data.bin", folder)),
    row("certify", "external data absent", "no such", net=external("data.bin")),
    row("certify", "external data outside", "outside", net=external("../secret.bin")),
    row("certify", "external data at the root", "outside", net=external("/etc/hostname")),
    row("certify", "external data through a link", "outside", net=external("data.bin", link("/etc/hostname"))),
    row("certify", "external data too short", "needs", net=external("data.bin", lambda f: f.write_bytes(bytes(8)))),
    row("certify", "external data at 10^18", "needs", net=external("data.bin", lambda f: f.write_bytes(bytes(8)), offset=str(10**18))),
    row("certify", "external data of negative length", "needs", net=external("data.bin", lambda f: f.write_bytes(bytes(8)), length="-5")),
    row("certify", "external data of a length in words", "cannot read", net=external("data.bin", lambda f: f.write_bytes(bytes(8)), length="all")),
    row("certify", "external data of 2 GB, sparse", "needs", net=external("data.bin", sparse(2**31), length=str(2**31))),
    row("certify", "external data named by escapes", "outside", net=external("../\x1b[31mred")),
    row("vnnlib", "network absent", "no such", options="--model {here}/none.onnx"),
]  # fmt: skip

GRIDS = [
    row("nerf", "grid absent", "no such", options="--occupancy-grid {here}/none.npz"),
    row("nerf", "grid is a folder", "folder", grid=folder),
    row("nerf", "grid is a pipe", "regular file", grid=fifo),
    row("nerf", "grid as npy", "grid.npy", grid=lambda f: (np.save(f.with_suffix(".npy"), np.ones((2, 2, 2), bool)), f.with_suffix(".npy"))[1]),
    row("nerf", "grid empty", "cannot be read", grid=b""),
    row("nerf", "grid cut off", "cannot be read", grid=cut(60)),
    row("nerf", "grid without box", "aabb", grid=arrays(occupied=np.ones((2, 2, 2), bool))),
    row("nerf", "grid of numbers", "occupied", grid=arrays(occupied=np.ones((2, 2, 2)), aabb=[[0, 0, 0], [1, 1, 1]])),
    row("nerf", "grid of 64 MiB deflated", "occupied", grid=arrays(occupied=np.zeros(1 << 23), aabb=[[0, 0, 0], [1, 1, 1]]), memory=96 << 20),
    row("nerf", "box of 64 MiB deflated", "aabb", grid=arrays(occupied=np.ones((2, 2, 2), bool), aabb=np.zeros(1 << 23)), memory=96 << 20),
    row("nerf", "grid beyond memory", "--memory-limit", grid=arrays(occupied=np.zeros((256, 256, 512), bool), aabb=[[0.0, 0, 0], [1, 1, 1]]), options="--memory-limit 1.2"),
    row("nerf", "grid of flat box", "aabb", grid=arrays(occupied=np.ones((2, 2, 2), bool), aabb=[[0, 0, 0], [1, 1, 0]])),
    row("nerf", "grid of infinite box", "aabb", grid=arrays(occupied=np.ones((2, 2, 2), bool), aabb=[[0, 0, 0], [1, 1, np.inf]])),
    row("nerf", "grid of objects", "Python objects", grid=lambda f: np.savez(f, occupied=np.array([[[print]]]), aabb=[[0, 0, 0], [1, 1, 1]])),
    row("nerf", "grid by damaged LZMA", "compressed", grid=damaged_lzma),
    row("nerf", "grid of a text", "cannot be read", grid="occupied"),
    row("render", "grid for a splat", "occupancy", options="--occupancy-grid {here}/../base/grid.npz"),
]  # fmt: skip

MORE = [
    row("render", "number of 200,000 digits in YAML", "characters", yml=lambda text: text + "\nx: " + "9" * 200000 + "\n"),
    row("render", "sexagesimal number of 300 kB in YAML", "characters", yml=lambda text: text + "\nx: 1" + ":59" * 100000 + "\n"),
    row("render", "sexagesimal float of 300 kB in YAML", "characters", yml=lambda text: text + "\nx: 1" + ":59" * 100000 + ".5\n"),
    row("render", "hexadecimal number of 100 kB in YAML", "characters", yml=lambda text: text + "\nx: 0x" + "f" * 100000 + "\n"),
    row("render", "tagged number of 10 kB in YAML", "characters", yml=lambda text: text + "\nx: !!python/int '" + "9" * 10000 + "'\n"),
    row("render", "merge key in YAML", "merge", yml=lambda text: text + "\nx: {<<: {a: 1}}\n"),
    row("render", "two documents in YAML", "YAML", yml=lambda text: text + "\n---\na: 1\n"),
    row("render", "tab in YAML", "YAML", yml="a:\n\t- 1"),
    row("render", "impossible date in YAML", "YAML", yml="a: 2020-99-99\n"),
    row("render", "NUL in YAML", "YAML", yml="a: \x00\n"),
    row("ply", "escapes in a scene's name", "out.ply", yml=lambda text: re.sub("experiment_name: .*", r'experiment_name: "\\e[2J\\e]0;owned\\a"', text), code=0),
    row("render", "escapes in a scene's name, resumed", "\\x1b[2J", results=lambda f: None, yml=lambda text: re.sub("experiment_name: .*", r'experiment_name: "\\e[2J\\e]0;owned\\a"', text), options=RESUME, code=0, memory=WORK),
    row("render", "escapes in a file's name", "no such", options="--load-config \x1b[31m.yml"),
    row("render", "escapes in a path's name", "no such", options="--camera-path-filename \x1b]0;x\x07.json"),
    row("certify", "escapes in a network's name", "no such", options="--model \x1b[2Jnet.onnx"),
    row("render", "right-to-left marks in a file's name", "no such", options="--load-config a\u202egmy.yml"),
    row("render", "name that is no text", "no such", options="--load-config a\udcff.yml"),
    row("render", "name of 500 characters", "a" * 50, options="--load-config " + "a" * 500),
    row("render", "field with escapes", "unknown key", spec='{"\\u001b[31m": 1}'),
    row("certify", "VNN-LIB with escapes", "not understood", lib="(assert (\x1b[31m Y_0 1))"),
    row("certify", "VNN-LIB outside of the folder", "leads out", prop={"type": "vnnlib", "file": "../base/unsafe.vnnlib", "preprocess": PREPROCESS}),
    row("certify", "VNN-LIB at the root", "leads out", prop={"type": "vnnlib", "file": "/etc/passwd", "preprocess": PREPROCESS}),
    row("certify", "VNN-LIB through a link", "leads out", lib=link("/etc/passwd")),
    row("certify", "VNN-LIB is the folder", "leads out", prop={"type": "vnnlib", "file": ".", "preprocess": PREPROCESS}),
    row("certify", "VNN-LIB is a pipe", "regular file", lib=fifo),
    row("certify", "VNN-LIB empty", "empty", lib=b""),
    row("certify", "VNN-LIB of NaN", "not understood", lib="(declare-const Y_0 Real)(assert (<= Y_0 nan))"),
    row("certify", "VNN-LIB of a product", "linear", lib="(declare-const Y_0 Real)(assert (<= (* Y_0 Y_0) 1))"),
    row("certify", "VNN-LIB without assertions", "no assertion", lib="(declare-const Y_0 Real)"),
    row("certify", "VNN-LIB of 5,000 digits", "float64", lib="(declare-const Y_0 Real)(assert (<= Y_0 " + "9" * 5000 + "))"),
    row("render", "index file outside of the folder", "leads out", spec={"scene": [{"select": {"indices": "../base/path.json"}, "mean": 1}]}),
    row("render", "index file at the root", "leads out", spec={"scene": [{"select": {"indices": "/etc/passwd"}, "mean": 1}]}),
    row("render", "index file with NUL", "leads out", spec='{"scene": [{"select": {"indices": "a\\u0000b"}, "mean": 1}]}'),
    row("render", "index file is a pipe", "regular file", indices=fifo, spec={"scene": [{"select": {"indices": "chosen.txt"}, "mean": 1}]}),
    row("render", "index file of words", "whole numbers", indices="one two", spec={"scene": [{"select": {"indices": "chosen.txt"}, "mean": 1}]}),
    row("render", "index file empty", "empty", indices=b"", spec={"scene": [{"select": {"indices": "chosen.txt"}, "mean": 1}]}),
    row("render", "index file that claims 2^40 numbers", "damaged .npy", indices=lambda f: f.with_name("many.npy").write_bytes(b"\x93NUMPY\x01\x00v\x00{'descr': '<i8', 'fortran_order': False, 'shape': (1099511627776,), }".ljust(127) + b"\n"), spec={"scene": [{"select": {"indices": "many.npy"}, "mean": 1}]}),
    row("npz", "frame of other size", "not as report.json", results=frame_file(lambda f: np.savez(f, lower=np.zeros(3)))),
    row("render", "frame of 64 MiB deflated, resumed", "not used: frame_00000.npz: has 2896 x 2048 pixels", results=resumed(**{k: lambda a: np.full((2048, 2896, 3), a.flat[0], np.float32) for k in ("lower", "upper", "witness_lower", "witness_upper", "image")}), options=f"{RESUME} --frames 1", code=0, memory=WORK),
    row("render", "record of 80 MiB, resumed", "not used: frame_00000.npz: record has", results=resumed(record=lambda a: np.array("[" * (20 << 20))), options=f"{RESUME} --frames 1", code=0, memory=WORK),
    row("render", "frame of objects, resumed", "Python objects", results=resumed(record=lambda a: np.array(print)), options=f"{RESUME} --frames 1", code=0, memory=WORK),
    row("render", "frame with NaN, resumed", "not used: frame_00000.npz", results=resumed(lower=lambda a: a * np.float32(np.nan)), options=f"{RESUME} --frames 1", code=0, memory=WORK),
    row("render", "frame that crosses, resumed", "not used: frame_00000.npz", results=resumed(lower=lambda a: a + np.float32(0.4)), options=f"{RESUME} --frames 1", code=0, memory=WORK),
    row("render", "record of a list, resumed", "not used: frame_00000.npz", results=resumed(record=lambda a: np.array("[1]")), options=f"{RESUME} --frames 1", code=0, memory=WORK),
    row("render", "report of noise, resumed", "frame_00000.npz stands there", results=lambda f: (f / "report.json").write_bytes(bytes(range(256))), options=f"{RESUME} --frames 1", memory=WORK),
]  # fmt: skip

VIEWER = [
    row("viewer", "config absent", "no such", options="--load-config {here}/none.yml", memory=WORK),
    row("viewer", "config empty", "empty", yml="", memory=WORK),
    row("viewer", "config that runs a command", "os.system", yml=lambda text: text + "\nx: !!python/object/apply:os.system ['touch hacked']\n", memory=WORK),
    row("viewer", "config that runs nerfstudio's command", "run_command", yml=lambda text: text + "\nx: !!python/object/apply:nerfstudio.utils.scripts.run_command ['touch hacked']\n", memory=WORK),
    row("viewer", "config that names a function", "subprocess.call", yml=lambda text: text.replace("!!python/name:nerfstudio.models.splatfacto.SplatfactoModel", "!!python/name:subprocess.call"), memory=WORK),
    row("viewer", "config that takes an attribute", "builtins.getattr", yml=lambda text: text + "\nx: !!python/object/apply:builtins.getattr [!!python/name:nerfstudio.utils.writer.EventName '', __class__]\n", memory=WORK),
    row("viewer", "config that names a module", "names the Python object", yml=lambda text: text + "\nx: !!python/module:antigravity\n", memory=WORK),
    row("viewer", "config that makes an object anew", "names the Python object", yml=lambda text: text + "\nx: !!python/object/new:type ['a', [], {}]\n", memory=WORK),
    row("viewer", "config that names what is not there", "names the Python object", yml=lambda text: text + "\nx: !!python/name:nerfstudio.nowhere.Nothing ''\n", memory=WORK),
    row("viewer", "config with a tag as key", "YAML", yml=lambda text: text + "\n? !!python/object/apply:os.system ['touch hacked']\n: 1\n", memory=WORK),
    row("viewer", "config of another method", "not bounded", yml=lambda text: text.replace("splatfacto.SplatfactoModelConfig", "nerfacto.NerfactoModelConfig"), memory=WORK),
    row("viewer", "checkpoint empty", "checkpoint", ckpt=b"", memory=WORK),
    row("viewer", "no such option", "--bogus", options="--bogus 1", memory=WORK),
    row("viewer", "ply cut off", "cut off", scene=ply(lambda data: data[:-50]), memory=WORK),
]  # fmt: skip


def _format_rows() -> Iterator[Row]:
    """Every damaged file of other programs' formats, as a scene."""
    for name, (write, mentions) in test_formats.BAD.items():
        # a scale below 0 is never drawn, and no error
        if name != "splat: scales below 0":
            yield row("render", name, *mentions, scene=lambda file, write=write: write(file.parent))


QUERY = (
    "(vnnlib-version <2.0>)(declare-network f (declare-input X float32 [1,3,16,16])(declare-output Y float32 [1,3]))"
)
EXPORTS = [
    row("vnnlib", "prefix of a folder", "--prefix", options="--prefix ../x_"),
    row("vnnlib", "prefix of 100 letters", "--prefix", options=("--prefix", "a" * 100)),
    row("vnnlib", "two properties for a network", "--property", options="--property {spec} {spec}"),
    row("vnnlib", "a version of VNN-LIB that does not exist", "vnnlib-version", options="--vnnlib-version 3.0"),
    row("certify", "VNN-LIB 2.0 of strict comparisons", "<=", lib=QUERY + "(assert (< Y[0,0] 1.0))"),
    row("certify", "VNN-LIB 2.0 of another shape", "declare-input", lib=QUERY.replace("16,16", "8,8") + "(assert (<= Y[0,0] 1.0))"),
    row("certify", "VNN-LIB 2.0 nested", "deep", lib=QUERY + "(assert " + "(and " * 100000),
    row("certify", "VNN-LIB 2.0 with a zero byte", "zero byte", lib=QUERY + "(assert (<= Y[0,0] 1.0))\0"),
    row("certify", "VNN-LIB 2.0 of 10^12 elements", "shape", lib=QUERY.replace("1,3,16,16", "999999,999999") + "(assert (<= Y[0,0] 1.0))"),
    row("certify", "VNN-LIB 3.0", "version", lib=QUERY.replace("2.0", "3.0") + "(assert (<= Y[0,0] 1.0))"),
    row("exr", "results absent", "cannot be listed", options="--input-dir {here}/none"),
    row("safetensors", "frame cut off", "frame_00000.npz", results=frame_file(cut(500))),
    row("rrd", "frame empty", "frame_00001.npz", results=frame_file(lambda f: f.write_bytes(b""), 1)),
    row("viser", "results of no frames", "no frame", results=lambda f: [x.unlink() for x in f.glob("frame_*.npz")]),
    row("viser", "half a year a frame", "--seconds", options="--seconds 1e7"),
    row("viser", "path of one camera", "cameras", path=lambda f: f.write_text(json.dumps(path_json(ring(2, 16)[:1])))),
    row("statement", "result absent", "no such folder", options="--input-dir {here}/none"),
    row("statement", "result of pictures", "no certificate", options="--input-dir {here}/../base/results"),
    row("statement", "report empty", "report.json", search=lambda f: (f / "report.json").write_bytes(b"")),
    row("statement", "report of text", "report.json", search=lambda f: (f / "report.json").write_text("done")),
    row("statement", "cells cut off", "cells.sqlite", search=lambda f: (f / "cells.sqlite").write_bytes(b"SQLite format 3\0")),
]  # fmt: skip

ROWS = dict(
    rows_by_name(
        [
            *GOOD,
            *OPTIONS,
            *RUNS,
            *PATHS,
            *SETS,
            *PROPERTIES,
            *NETWORKS,
            *GRIDS,
            *RESULTS,
            *MORE,
            *VIEWER,
            *OUTPUTS,
            *SEARCHES,
            *CLUSTERS,
            *SIGNALS,
            *LOOPS,
            *EXPORTS,
            *_format_rows(),
        ]
    )
)


@pytest.mark.slow_cases(every=100)
@pytest.mark.parametrize("name", ROWS)
def test_case(name: str, bench: Bench) -> None:
    case: Row = ROWS[name]
    if case.command == "viewer" and importlib.util.find_spec("nerfstudio") is None:
        pytest.skip("nerfstudio is not installed (extra nerfstudio)")
    check(case, bench.run(case))
