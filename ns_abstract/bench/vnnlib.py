"""Run folders of instances in the format of the verification competitions: networks, properties, time limits.

Folders of 2026 have the versions 1.0 and 2.0 of VNN-LIB below them; a network of 2.0 may be a list of names and files.
"""

from __future__ import annotations

import ast
import csv
import io
import re
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ns_abstract.execution.cancellation import Deadline, WorkCancelledError
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import file_beside, read_text
from ns_abstract.io.packed import unpacked
from ns_abstract.verify.box_decisions import Decision, decide
from ns_abstract.verify.network import Network, NetworkArithmetic, load_network
from ns_abstract.verify.network.comparison import compare
from ns_abstract.verify.network.explain import check_cell
from ns_abstract.verify.network.load import onnx_runner
from ns_abstract.verify.vnnlib import load_query
from ns_abstract.verify.vnnlib2 import Vnnlib2Query
from ns_abstract.verify.vnnlib_sets import InputRegion

_LIST_LIMIT = 16 << 20
_INSTANCES = 100_000
#: Bytes that a packed network may grow to.
_NETWORK_LIMIT = 1 << 30
_LONGEST = 1e6
#: Characters of a list of networks.
_LIST_LENGTH = 10_000
_ONE_NETWORK = "queries about one network are decided: give it as --network NAME=FILE.onnx"
#: Boxes at whose corners the reading of a network is compared.
_COMPARED = 4


@dataclass(frozen=True)
class Instance:
    """One line of instances.csv."""

    network: str
    property: str
    seconds: float


def instances(folder: Path) -> list[Instance]:
    """Return the lines of ``folder/instances.csv``: network, property, seconds.

    Raises:
        InputError: The list is absent, or a line is not understood.
    """
    path = folder / "instances.csv"
    lines = []
    text = read_text(path, "list of instances", _LIST_LIMIT)
    try:
        for number, row in enumerate(csv.reader(io.StringIO(text)), 1):
            row = [part.strip() for part in row]
            if not any(row):
                continue
            if len(row) != 3 or number > _INSTANCES:
                raise InputError(
                    f"line {number} has {len(row)} fields", file=path, fix="write network,property,seconds on a line"
                )
            try:
                seconds = float(row[2])
            except ValueError:
                seconds = np.nan
            if not 0.0 < seconds <= _LONGEST:
                raise InputError(f"line {number}: {row[2]!r} seconds", file=path, fix=f"between 0 and {_LONGEST:g}")
            lines.append(Instance(row[0], row[1], seconds))
    except csv.Error as error:
        raise InputError(f"cannot be read: {error}", file=path, fix="write network,property,seconds") from None
    return lines


def version_folder(folder: Path) -> Path:
    """Return the folder of instances.csv: ``folder`` itself, or the first of its parts 2.0 and 1.0 that has one."""
    for part in (folder, folder / "2.0", folder / "1.0"):
        if (part / "instances.csv").exists():
            return part
    return folder


def networks_of(text: str) -> dict[str, str]:
    """Return files by the names of networks, from ``[('f', 'net.onnx')]``; a file alone has the name "".

    Raises:
        InputError: The list is not understood.
    """
    if not text.startswith("["):
        return {"": text}
    try:
        pairs = ast.literal_eval(text) if len(text) <= _LIST_LENGTH else None
        good = isinstance(pairs, list) and all(isinstance(p, tuple) and len(p) == 2 for p in pairs)
        files = dict(pairs) if good and pairs else {}
    except (ValueError, SyntaxError, MemoryError, RecursionError, TypeError):
        files = {}
    if not files or not all(isinstance(v, str) for pair in files.items() for v in pair):
        raise InputError(f"found {text[:60]}", field="network", fix="write a file, or [('f', 'net.onnx')]")
    return files


def stored_file(folder: Path, name: str) -> Path:
    """Return the file that a line names, or its packed form."""
    path = file_beside(folder, name)
    if path.suffix != ".gz" and not path.exists():
        packed = file_beside(folder, f"{name}.gz")
        return packed if packed.exists() else path
    return path


class _Networks:
    """Loads networks; the latest is kept, since neighbouring lines name the same."""

    def __init__(self, scratch: Path, output: str | None) -> None:
        self.scratch, self.output = scratch, output
        self.latest: tuple[Path, Network, Any] | None = None

    def load(self, path: Path) -> tuple[Network, Any]:
        if self.latest is None or self.latest[0] != path:
            self.latest = None
            file = path
            if path.suffix.lower() == ".gz":
                file = self.scratch / "network.onnx"
                with open(file, "wb") as stream:
                    for part in unpacked(path, _NETWORK_LIMIT):
                        stream.write(part)
            if file.suffix.lower() != ".onnx":
                raise InputError("is no .onnx file", file=path, fix="name an .onnx or .onnx.gz file")
            network = load_network(file, output=self.output)
            self.latest = path, network, onnx_runner(file, network.output, network.input_shape)
        return self.latest[1:]


def run_folder(
    folder: Path,
    output_dir: Path,
    *,
    only: Sequence[str] = (),
    numbers: Sequence[int] | None = None,
    seconds: float | None = None,
    memory: int = 2 << 30,
    arithmetic: NetworkArithmetic = "float32",
    output: str | None = None,
) -> Iterator[dict[str, Any]]:
    """Decide the instances of ``folder``; a row for each, as soon as it is known.

    ``output_dir/results.csv`` gets the competitions' lines (category, network, property, seconds to prepare, verdict,
    seconds), and ``output_dir/NETWORK_PROPERTY.txt`` the verdict and, with "sat", the counterexample.

    Args:
        folder: Holds instances.csv and what it names, also packed (.gz); or the folders 2.0 or 1.0 that do.
        only: Parts of names of networks or properties; all if there are none.
        numbers: Places in the list, from 0; None: all.
        seconds: Limit beside those of the list; loading and checking count, compiling kernels cannot be interrupted.
        memory: Bytes that bounds may take.
        arithmetic: What "unsat" covers.
        output: Name of the networks' output; None: the only one.

    Raises:
        InputError: The list cannot be read. A network or a property that cannot is a row with "error" and a reason.
    """
    benchmark, folder = folder, version_folder(folder)
    chosen = [
        one
        for number, one in enumerate(instances(folder))
        if (not only or any(part in name for part in only for name in (one.network, one.property)))
        and (numbers is None or number in numbers)
    ]
    if not chosen:
        raise InputError("no instance is chosen", file=folder / "instances.csv", fix="check --only")
    output_dir.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch, open(output_dir / "results.csv", "w", newline="") as stream:
        networks = _Networks(Path(scratch), output)
        writer = csv.writer(stream)
        for one in chosen:
            limit = one.seconds if seconds is None else min(one.seconds, seconds)
            start = time.perf_counter()
            ready, answer, why = start, None, ""
            query: Vnnlib2Query | None = None
            deadline = Deadline(limit)
            try:
                with deadline.enforced():
                    files = networks_of(one.network)
                    if len(files) > 1:
                        raise InputError("is about several networks", field=one.property, fix=_ONE_NETWORK)
                    ((name, file),) = files.items()
                    network, run = networks.load(stored_file(folder, file))
                    regions, query = _question(
                        network, run, stored_file(folder, one.property), name, memory, arithmetic
                    )
                ready = time.perf_counter()
                answer = decide(network, run, regions, deadline, memory=memory, arithmetic=arithmetic)
            except WorkCancelledError:
                answer = Decision("timeout")
            except InputError as error:
                why = str(error)
            word = "error" if answer is None else answer.word
            prepared, spent = ready - start, time.perf_counter() - ready
            writer.writerow([benchmark.name, one.network, one.property, f"{prepared:.3f}", word, f"{spent:.3f}"])
            stream.flush()
            name = f"{_stem(one.network)}_{_stem(one.property)}.txt"
            (output_dir / name).write_text(word + "\n" + ("" if answer is None else assignment(answer, query)))
            yield {
                "network": one.network,
                "property": one.property,
                "verdict": word,
                "seconds": round(spent, 3),
                "boxes": 0 if answer is None else answer.boxes,
                "why": why,
            }


def _stem(name: str) -> str:
    """Return a file's name without its endings."""
    # the last of a list's files
    last = re.sub(r"[\[\]()' ]", "", Path(name).name)
    for ending in (".gz", ".onnx", ".vnnlib"):
        last = last[: -len(ending)] if last.lower().endswith(ending) else last
    return last


def assignment(answer: Decision, query: Vnnlib2Query | None = None) -> str:
    """Return a counterexample in the form of the competitions, of a query of version 2 in its own; "" without one."""
    if answer.x is None or answer.y is None:
        return ""
    if query is not None:
        return query.input.assignment(answer.x) + query.output.assignment(answer.y)
    lines = [f"(X_{k} {value!r})" for k, value in enumerate(answer.x.tolist())]
    lines += [f"(Y_{k} {value!r})" for k, value in enumerate(answer.y.tolist())]
    return "(" + "\n".join(lines) + ")\n"


def _question(
    network: Network, run: Any, file: Path, name: str, memory: int, arithmetic: NetworkArithmetic
) -> tuple[tuple[InputRegion, ...], Vnnlib2Query | None]:
    """Return the network and question of a property file, once the network agrees with its runtime.

    Raises:
        InputError: The file is about another network, or asks more than ``arithmetic`` covers.
    """
    check_cell(network, 1, memory)
    regions, query = load_query(file, network.input_shape, network.output_shape)
    if query is not None and name not in ("", query.network):
        raise InputError(f"names the network {query.network}, given is {name}", file=file, fix=f"give {query.network}=")
    if query is not None and query.input.kind == "float32" and arithmetic != "float32":
        fix = "leave --network-arithmetic out, or declare the tensors as real"
        raise InputError("asks about float32", file=file, field="--network-arithmetic", fix=fix)
    ends = [image[None] for r in regions[:_COMPARED] for image in (r.lower, r.upper, 0.5 * (r.lower + r.upper))]
    shape = (1, *network.input_shape)
    compare(network, run, [image.reshape(shape) for image in ends], usual=False)
    return regions, query


def verify_query(
    file: Path,
    networks: Mapping[str, Path],
    *,
    seconds: float | None = None,
    memory: int = 2 << 30,
    arithmetic: NetworkArithmetic = "float32",
    output: str | None = None,
) -> str:
    """Return the standard's answer to a query: ``sat`` and an assignment, ``unsat``, ``unknown`` or ``timed-out``.

    Args:
        file: The query, of version 1 or 2.
        networks: Files by the names of the query's networks; of version 1 by any name.
        seconds: Limit; None: none.
        memory: Bytes that bounds may take.
        arithmetic: What "unsat" covers.
        output: Name of the network's output; None: the only one.

    Raises:
        InputError: A file cannot be used, or other networks are given than the query is about.
    """
    if len(networks) != 1:
        raise InputError(f"{len(networks)} networks", field="--network", fix=_ONE_NETWORK)
    ((name, path),) = networks.items()
    deadline = Deadline(_LONGEST if seconds is None else seconds)
    query = None
    try:
        with tempfile.TemporaryDirectory() as scratch, deadline.enforced():
            network, run = _Networks(Path(scratch), output).load(path)
            regions, query = _question(network, run, file, name, memory, arithmetic)
        answer = decide(network, run, regions, deadline, memory=memory, arithmetic=arithmetic)
    except WorkCancelledError:
        answer = Decision("timeout")
    word = "timed-out" if answer.word == "timeout" else answer.word
    return f"{word}\n{assignment(answer, query)}"
