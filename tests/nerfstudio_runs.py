"""Runs and commands for the tests against the real nerfstudio."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
#: Where the commands of this environment are.
BIN = Path(sys.executable).parent

needs_nerfstudio = pytest.mark.skipif(
    importlib.util.find_spec("nerfstudio") is None, reason="nerfstudio is not installed (extra nerfstudio)"
)

#: How a program begins that evaluates Nerfstudio in a process of its own, without weights from elsewhere.
START = """
import sys

import torch

torch.set_num_threads(1)
try:
    import torchvision
except RuntimeError:
    # A torchvision built for CUDA beside a CPU torch: declare the operators that it registers fakes for.
    for name in [m for m in sys.modules if m.split(".")[0] == "torchvision"]:
        del sys.modules[name]
    library = torch.library.Library("torchvision", "FRAGMENT")
    library.define("nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    library.define("qnms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    import torchvision
import torchmetrics.functional.image.lpips as lpips

features = lpips._get_tv_model_features
lpips._get_tv_model_features = lambda net, pretrained=False: features(net, pretrained=False)
"""


def environment(folder: Path) -> dict[str, str]:
    """For commands: this package with the entry points that pyproject.toml states, and no network."""
    tomllib = pytest.importorskip("tomllib", reason="tomllib comes with Python 3.11")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    site = folder / "site"
    about = site / "ns_abstract-0.1.dist-info"
    if not about.exists():
        about.mkdir(parents=True)
        groups = {"console_scripts": project["scripts"], **project["entry-points"]}
        lines = [f"[{g}]\n" + "".join(f"{k} = {v}\n" for k, v in entries.items()) for g, entries in groups.items()]
        (about / "entry_points.txt").write_text("".join(lines))
        (about / "METADATA").write_text("Metadata-Version: 2.1\nName: ns-abstract\nVersion: 0.1\n")
    path = [str(site), str(ROOT), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    nowhere = {f"{name}_proxy": "http://127.0.0.1:9" for name in ("http", "https", "HTTP", "HTTPS")}
    return os.environ | nowhere | {
        "PYTHONPATH": os.pathsep.join(part for part in path if part),
        "TORCH_HOME": str(folder / "torch"),
        "NUMBA_NUM_THREADS": "1",
        "WANDB_MODE": "offline",
        "no_proxy": "localhost,127.0.0.1",
        "COLUMNS": "200",
    }  # fmt: skip


def wrapped(name: str) -> list[object]:
    """How one of nerfstudio's commands is started, whatever build of torchvision there is."""
    if not (BIN / name).exists():
        pytest.skip(f"{name} is not installed")
    return [sys.executable, "-m", "ns_abstract.nerfstudio", name]


def command(name: str, *options: object, folder: Path, where: Path, ok: bool = True) -> str:
    """Run one of nerfstudio's commands in ``where``; returns what it said."""
    done = subprocess.run(
        [str(part) for part in (*wrapped(name), *options)],
        cwd=where, env=environment(folder), capture_output=True, text=True, timeout=900, check=False,
    )  # fmt: skip
    said = done.stdout + done.stderr
    assert (done.returncode == 0) == ok, said[-4000:]
    return said


def lpips_cache(folder: Path) -> None:
    """What nerfstudio would fetch for its LPIPS metric, without the values."""
    import torch

    shapes = {
        "features.0": (64, 3, 11, 11), "features.3": (192, 64, 5, 5), "features.6": (384, 192, 3, 3),
        "features.8": (256, 384, 3, 3), "features.10": (256, 256, 3, 3), "classifier.1": (4096, 9216),
        "classifier.4": (4096, 4096), "classifier.6": (1000, 4096),
    }  # fmt: skip
    state = {}
    for name, shape in shapes.items():
        # one stored number stands for all
        state[f"{name}.weight"] = torch.zeros(1).expand(shape)
        state[f"{name}.bias"] = torch.zeros(1).expand(shape[0])
    target = folder / "torch" / "hub" / "checkpoints" / "alexnet-owt-7be5be79.pth"
    target.parent.mkdir(parents=True, exist_ok=True)
    torch.save(state, target)


class Server:
    """A viewer in a process of its own; use as a context manager."""

    def __init__(self, arguments: list[object], port: int, folder: Path, where: Path) -> None:
        self.arguments, self.port, self.where = [str(a) for a in arguments], port, where
        self.environment = environment(folder)
        self.log = folder / f"viewer-{port}.log"

    def __enter__(self) -> Server:
        options = ["--viewer.websocket-port", str(self.port), "--viewer.websocket-host", "127.0.0.1"]
        with self.log.open("w") as log:
            self.process = subprocess.Popen(
                [*self.arguments, *options], cwd=self.where, env=self.environment, stdout=log, stderr=log
            )
        return self

    def __exit__(self, *_: Any) -> None:
        self.process.terminate()
        self.process.wait(60)

    @property
    def url(self) -> str:
        """Where the viewer is, once it answers."""
        import urllib.request

        end = time.monotonic() + 3600.0
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        while True:
            assert self.process.poll() is None, self.said()
            try:
                with opener.open(f"http://127.0.0.1:{self.port}", timeout=10) as page:
                    assert page.status == 200
                    return f"http://127.0.0.1:{self.port}"
            except OSError:
                assert time.monotonic() < end, self.said()
                time.sleep(0.5)

    def said(self) -> str:
        """What it wrote."""
        return self.log.read_text()


def free_port() -> int:
    """A port that nobody listens on."""
    import socket

    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]
