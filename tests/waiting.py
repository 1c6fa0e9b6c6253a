"""Waiting for what comes by itself."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

#: Seconds after which what is waited for is not going to come, on any machine.
LONG = 3600.0


def until(
    question: Callable[[], Any], what: str = "what is waited for", alive: Callable[[], bool] = lambda: True
) -> Any:
    """Ask until the answer is true, and return it; fails if what brings it has ended (not ``alive``) or hangs."""
    end = time.monotonic() + LONG
    while not (answer := question()):
        assert alive(), f"{what}: its process has ended"
        assert time.monotonic() < end, f"{what}: hangs"
        time.sleep(0.02)
    return answer
