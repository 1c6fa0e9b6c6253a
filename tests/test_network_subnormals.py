"""Bounds where the calling program flushes subnormal numbers to zero: the same as elsewhere, or refused."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest
import torch
from extreme_networks import Extreme, flushing, gemm, plain, scale

from ns_abstract.io.errors import InputError
from ns_abstract.verify.network import ImageSets, Network, SharedCoefficients, bound_outputs, load_network
from ns_abstract.verify.network.subnormals import subnormals_kept

TINY = np.ldexp(1.0, [-130, -140, -127, -149])


def keeps() -> bool:
    half = np.float32(2.0**-126) * np.float32(0.5)
    return bool(half + half == np.float32(2.0**-126))


def tiny_network(folder: Path) -> Path:
    """Offsets, weights and values that are subnormal, and what makes them count."""
    weight = np.tile(TINY, (4, 1)) * np.array([[1.0], [-1.0], [2.0], [-2.0]])
    layers = [gemm(weight, TINY), plain("Relu", torch.relu), scale(np.full(4, 2.0**120), np.zeros(4))]
    return Extreme((4,), layers).write(folder / "net.onnx")


def images() -> ImageSets:
    low, zero = np.array([[-1.0, 0.5, -0.25, 1.0]]), np.zeros((1, 4, 1))
    return ImageSets(zero, low, zero, low + 0.5, low, low + 0.5)


def bounds(network: Network) -> np.ndarray:
    rows = np.concatenate([np.eye(4), -np.eye(4)])
    real = bound_outputs(network, images(), rows, np.zeros(8), arithmetic="real").lower
    family = SharedCoefficients(network, images()).first(rows, np.zeros(8)).lower
    return np.concatenate([bound_outputs(network, images(), rows, np.zeros(8)).lower, real, family])


def test_bounds_do_not_depend_on_the_callers_subnormals(tmp_path: Path) -> None:
    file = tiny_network(tmp_path)
    expected = bounds(load_network(file))
    with flushing():
        if keeps():
            pytest.skip("this processor flushes nothing")
        found = bounds(load_network(file))
        assert not keeps()
    assert keeps()
    np.testing.assert_array_equal(found, expected)


def test_the_thread_is_left_as_it_was() -> None:
    with flushing():
        with pytest.raises(ZeroDivisionError), subnormals_kept():
            assert keeps()
            raise ZeroDivisionError
        assert not keeps()
    with subnormals_kept():
        assert keeps()
    assert keeps()


def test_threads_that_flush_are_refused() -> None:
    """torch's threads flush as the thread did that made them, and cannot be told otherwise."""
    found: list[str] = []

    def work() -> None:
        # threads of this thread's own
        torch.set_num_threads(2)
        with flushing():
            torch.ones(1 << 20).mul_(2.0)
            try:
                with subnormals_kept():
                    found.append("kept")
            except InputError as error:
                found.append(str(error))

    before = torch.get_num_threads()
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    torch.set_num_threads(before)
    assert len(found) == 1 and "flushes subnormal numbers" in found[0]
