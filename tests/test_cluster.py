"""Dask as real processes: workers, scheduler and client that are killed, addresses, TLS."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from conftest import Inputs
from test_cli import call, environment, one_line  # noqa: F401
from test_ending import alive
from waiting import until

from ns_abstract.execution import cluster
from ns_abstract.execution.cluster import Cluster, Tls, connected
from ns_abstract.io.errors import InputError

pytestmark = pytest.mark.skipif(importlib.util.find_spec("distributed") is None, reason="dask is not installed")


def slow(folder: str, number: int) -> tuple[int, int]:
    """Takes a moment, and notes who did it."""
    (Path(folder) / f"{number}-{os.getpid()}").touch()
    time.sleep(0.2)
    return number, os.getpid()


def address(file: Path) -> str | None:
    """Where the scheduler of ``file`` listens, as soon as all of the file is there: it is not written at once."""
    try:
        return json.loads(file.read_text())["address"]
    except (FileNotFoundError, json.JSONDecodeError):
        return None


class Parts:
    """A scheduler and two workers."""

    def __init__(self, folder: Path, *security: str) -> None:
        self.processes: list[subprocess.Popen[str]] = []
        self._security = security
        file = folder / "scheduler.json"
        self.scheduler = self._start("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard",
                                     "--scheduler-file", str(file))  # fmt: skip
        self.address: str = until(lambda: address(file), "the scheduler's file")
        self.workers = [self.worker() for _ in range(2)]

    def worker(self) -> subprocess.Popen[str]:
        return self._start("worker", self.address, "--nthreads", "1", "--no-nanny", "--no-dashboard",
                           "--host", "127.0.0.1")  # fmt: skip

    def _start(self, kind: str, *options: str) -> subprocess.Popen[str]:
        variables = environment()
        variables["PYTHONPATH"] += os.pathsep + str(Path(__file__).parent)
        command = [sys.executable, "-m", "distributed.cli.dask_" + kind, *options, *self._security]
        process = subprocess.Popen(command, text=True, env=variables, stderr=subprocess.DEVNULL)
        self.processes.append(process)
        return process

    def close(self) -> None:
        for process in self.processes:
            process.kill()
            process.wait()


@pytest.fixture
def parts(tmp_path: Path) -> Iterator[Parts]:
    found = Parts(tmp_path)
    yield found
    found.close()


def busy(client: Any, folder: Path) -> Cluster:
    """Two workers with much to do, and a first result."""
    until(lambda: len(client.nthreads()) == 2)
    engine = Cluster(client)
    for number in range(1000):
        engine.submit(number, slow, str(folder), number)
    found: list[Any] = []
    while not found:
        found = engine.collect(1.0)
    return engine


@pytest.mark.slow
def test_a_killed_worker_loses_nothing(parts: Parts, tmp_path: Path) -> None:
    with connected(parts.address) as client:
        until(lambda: len(client.nthreads()) == 2)
        engine = Cluster(client)
        for number in range(12):
            engine.submit(number, slow, str(tmp_path), number)
        found = engine.collect(60.0)
        parts.workers[0].kill()
        while len(found) < 12:
            found += engine.collect(1.0)
        assert sorted(key for key, _ in found) == list(range(12)) and all(key == value[0] for key, value in found)
        assert engine.collect(0.1) == []


@pytest.mark.slow
def test_a_killed_scheduler_is_noticed(parts: Parts, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "_GONE", 1.0)
    with connected(parts.address) as client:
        engine = busy(client, tmp_path)
        parts.scheduler.kill()
        with pytest.raises(InputError, match="the scheduler is gone"):
            for _ in range(600):
                engine.collect(0.5)
        engine.close()


@pytest.mark.slow
def test_workers_that_do_not_come_back_are_noticed(
    parts: Parts, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "_GONE", 1.0)
    with connected(parts.address) as client:
        engine = busy(client, tmp_path)
        for worker in parts.workers:
            worker.kill()
        with pytest.raises(InputError, match="no workers left"):
            for _ in range(600):
                engine.collect(0.5)
        engine.close()


CLIENT = """
import sys, os
from ns_abstract.execution.cluster import Cluster, connected
from test_cluster import slow
if __name__ == "__main__":
    address = sys.argv[2] if len(sys.argv) > 2 else None
    with connected(address, 2) as client:
        engine = Cluster(client)
        for number in range(1000):
            engine.submit(number, slow, sys.argv[1], number)
        engine.collect(60.0)
        print(*client.run(os.getpid).values(), flush=True)
        while True:
            engine.collect(1.0)
"""


@pytest.mark.slow
@pytest.mark.parametrize("local", [True, False])
def test_a_killed_client_leaves_nothing_behind(local: bool, tmp_path: Path) -> None:
    """A cluster of its own ends with it; another one forgets its tasks and serves the next client."""
    (tmp_path / "client.py").write_text(CLIENT)
    (tmp_path / "done").mkdir()
    variables = environment()
    variables["PYTHONPATH"] += os.pathsep + str(Path(__file__).parent)
    parts = None if local else Parts(tmp_path)
    command = [sys.executable, str(tmp_path / "client.py"), str(tmp_path / "done")]
    command += [] if parts is None else [parts.address]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=variables)
    try:
        assert process.stdout is not None
        pids = [int(word) for word in process.stdout.readline().split()]
        assert pids and all(map(alive, pids))
        process.send_signal(signal.SIGKILL)
        process.wait()
        if parts is None:
            until(lambda: not any(map(alive, pids)))
        else:
            with connected(parts.address) as client:
                until(lambda: not any(client.processing().values()))
                engine = Cluster(client)
                engine.submit(0, slow, str(tmp_path / "done"), 7)
                found: list[Any] = []
                while not found:
                    found = engine.collect(1.0)
                assert found[0][1][0] == 7
    finally:
        process.kill()
        process.wait()
        if parts is not None:
            parts.close()


@pytest.mark.slow
def test_a_cluster_on_this_machine_listens_to_itself_alone() -> None:
    with connected(None, 1) as client:
        info = client.scheduler_info()
        addresses = [info["address"], *info["workers"], *(w["nanny"] for w in info["workers"].values() if w["nanny"])]
        assert all(address.startswith("tcp://127.0.0.1:") for address in addresses)
        listening = listeners({os.getpid(), *client.run(os.getpid).values()})
    assert listening and all(host.startswith("127.") for host in listening)


def listeners(pids: set[int]) -> set[str]:
    """Addresses on which processes listen."""
    found = set()
    for pid in pids:
        sockets = {os.readlink(f"/proc/{pid}/fd/{fd}") for fd in os.listdir(f"/proc/{pid}/fd") if _is_link(pid, fd)}
        for kind in ("tcp", "tcp6"):
            for line in Path(f"/proc/{pid}/net/{kind}").read_text().splitlines()[1:]:
                words = line.split()
                if words[3] == "0A" and f"socket:[{words[9]}]" in sockets:
                    digits = words[1].split(":")[0][-8:]
                    found.add(".".join(str(int(digits[i : i + 2], 16)) for i in (6, 4, 2, 0)))
    return found


def _is_link(pid: int, fd: str) -> bool:
    return os.path.islink(f"/proc/{pid}/fd/{fd}")


class Flaky:
    """A client whose connection is lost once, and whose scheduler answers again."""

    status = "running"

    def __init__(self) -> None:
        self.submitted: list[str] = []

    def nthreads(self) -> dict[str, int]:
        return {"w": 1}

    def submit(self, function: Any, *arguments: Any, key: str, **rest: Any) -> Any:
        from concurrent.futures import Future

        self.submitted.append(key)
        future: Future[Any] = Future()
        if len(self.submitted) > 3:
            future.set_result(function(*arguments))
        return future


def test_tasks_lost_with_the_connection_are_handed_in_again(monkeypatch: pytest.MonkeyPatch) -> None:
    import distributed

    client = Flaky()
    engine = Cluster(client)
    for number in range(3):
        engine.submit(number, divmod, 10 * number, 7)
    answers: list[Any] = []

    def wait(futures: list[Any], **rest: Any) -> Any:
        if not answers:
            answers.append(1)
            raise CancelledError
        return type("Waited", (), {"done": set(futures)})

    monkeypatch.setattr(distributed, "wait", wait)
    assert engine.collect(0.1) == []
    assert sorted(engine.collect(0.1)) == [(n, divmod(10 * n, 7)) for n in range(3)]
    assert engine.collect(0.1) == [] and len(set(client.submitted)) == 6
    client.status = "closed"
    answers.clear()
    engine.submit(5, divmod, 7, 2)
    with pytest.raises(InputError, match="the scheduler is gone"):
        engine.collect(0.1)


class Lost:
    """A finished result whose worker is gone: it cannot be fetched until it was made again."""

    def __init__(self, asked: list[float]) -> None:
        self.asked = asked

    def result(self, timeout: float) -> int:
        self.asked.append(timeout)
        if len(self.asked) < 3:
            raise TimeoutError
        return 7


def test_a_result_whose_worker_is_gone_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    import distributed

    asked: list[float] = []
    client: Any = SimpleNamespace(
        status="running", nthreads=lambda: {"w": 1}, submit=lambda *arguments, **rest: Lost(asked)
    )
    monkeypatch.setattr(distributed, "wait", lambda futures, **rest: type("Waited", (), {"done": set(futures)}))
    engine = Cluster(client)
    engine.submit(3, divmod, 7, 1)
    assert engine.collect(0.1) == []
    client.nthreads = dict
    assert engine.collect(0.1) == []
    assert engine.collect(0.1) == [(3, 7)] and engine.collect(0.1) == []
    assert asked[0] <= 10.0 and asked == [asked[0], 2.0 * asked[0], 4.0 * asked[0]]

    # nobody is left who could make it again
    asked.clear()
    monkeypatch.setattr(cluster, "_GONE", 0.0)
    engine.submit(4, divmod, 7, 1)
    with pytest.raises(InputError, match="no workers left"):
        for _ in range(3):
            engine.collect(0.1)


# ---------------------------------------------------------------- TLS


@pytest.fixture
def pem(tmp_path: Path) -> dict[str, Path]:
    """A certificate that signs itself, and its key."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    cert, key = tmp_path / "cert.pem", tmp_path / "key.pem"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=localhost",
         "-keyout", key, "-out", cert],
        check=True, capture_output=True,
    )  # fmt: skip
    return {"ca_file": cert, "cert": cert, "key": key}


@pytest.mark.slow
def test_tls_from_end_to_end(pem: dict[str, Path], tmp_path: Path) -> None:
    security = [word for name, file in pem.items() for word in (f"--tls-{name.replace('_', '-')}", str(file))]
    parts = Parts(tmp_path, "--protocol", "tls", *security)
    try:
        assert parts.address.startswith("tls://")
        tls = Tls.of(pem["ca_file"], pem["cert"], pem["key"], parts.address)
        with connected(parts.address.removeprefix("tls://"), 1, tls) as client:
            until(lambda: len(client.nthreads()) > 0)
            engine = Cluster(client)
            engine.submit(0, slow, str(tmp_path), 5)
            found: list[Any] = []
            while not found:
                found = engine.collect(1.0)
            assert found[0][1][0] == 5
    finally:
        parts.close()


def test_tls_mistakes(
    call: Callable[..., tuple[int, str]],  # noqa: F811
    blobs: Inputs,
    tmp_path: Path,
) -> None:
    base = blobs.options(tmp_path / "out", engine="dask")
    one_line(*call([*base, "--tls-cert", str(blobs.spec), "--scheduler-address", "h:1"]), "--tls-ca-file", "missing")
    names = [word for name in ("ca-file", "cert", "key") for word in (f"--tls-{name}", str(blobs.spec))]
    one_line(*call([*base, *names]), "without --scheduler-address")
    names[1] = str(tmp_path / "none.pem")
    one_line(*call([*base, *names, "--scheduler-address", "h:1"]), "none.pem", "no such PEM file")
