"""Bounds and pictures of splats are the same bit for bit however their kernels are run (docs/guarantee.md).

Compiled for this processor, or interpreted with scalar arithmetic, where nothing is contracted or reordered, and with
numpy, OpenBLAS and torch held to the oldest instructions that they know.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys

import numpy as np
import pytest
from conftest import environment
from test_bounds import TURN, Case, camera, moves, scene

from ns_abstract.arithmetic.rounding import FLOAT32, REAL

#: One parameter by both orders and several parameters; the scene has harmonics, compensation and an open order.
SETS = {"one": {"yaw": 0.05}, "six": dict.fromkeys(("x", "y", "z", "yaw", "pitch", "roll"), 0.01)}


def case(name: str, opacity: float = 0.8) -> Case:
    harmonics = [[1.0, 0.1, 0.0], [0.1, 0.2, -0.1], [0.05, 0.1, 0.1], [0.02, -0.3, 0.2]]
    splats = scene(
        {"mean": (-0.4, 0.0, -5.0), "scale": (0.8, 0.3, 0.5), "quat": TURN, "opacity": 0.9, "sh": harmonics},
        {"mean": (0.4, 0.1, -5.0), "scale": (0.2, 0.5, 0.4), "quat": TURN[::-1], "opacity": opacity, "sh": harmonics},
        background=(0.2, 0.3, 0.4),
        antialiased=True,
    )
    return Case(splats, moves(**SETS[name]), camera(8, 8, 8.0))


def bits(*arrays: np.ndarray) -> str:
    found = hashlib.sha256()
    for array in arrays:
        found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()


def digests() -> dict[str, str]:
    """Of bounds by order and arithmetic, and of a picture."""
    found = {}
    for name in SETS:
        one = case(name)
        for order in (1, 2) if name == "one" else (1,):
            for arithmetic in (REAL, FLOAT32):
                cell = one.bounds(one.poses.box, order, arithmetic)
                found[f"{name}, order {order}, {arithmetic.name}"] = bits(cell.lower, cell.upper)
        found[f"{name}, picture"] = bits(one.image(np.full(one.poses.box.dimensions, 0.007)))
    return found


@pytest.mark.slow
def test_interpreted_and_with_old_instructions() -> None:
    plain = {
        "NUMBA_DISABLE_JIT": "1",
        "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX2 FMA3 AVX512F AVX512_SKX AVX512_ICL",
        "OPENBLAS_CORETYPE": "Nehalem",
        "ATEN_CPU_CAPABILITY": "default",
    }
    places = os.pathsep.join(filter(None, (os.path.dirname(__file__), environment()["PYTHONPATH"])))
    done = subprocess.run(
        [sys.executable, "-W", "ignore", __file__],
        check=False,
        capture_output=True,
        text=True,
        env=environment() | plain | {"PYTHONPATH": places},
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == digests()


def test_a_last_bit_is_noticed() -> None:
    pose = np.array([0.007])
    last = case("one", float(np.nextafter(0.8, 1.0)))
    assert bits(case("one").image(pose)) == bits(case("one").image(pose)) != bits(last.image(pose))


if __name__ == "__main__":
    print(json.dumps(digests()))
