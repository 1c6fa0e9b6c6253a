"""Available memory, checked before large allocations."""

from __future__ import annotations

from pathlib import Path

from ns_abstract.io.arguments import positive
from ns_abstract.io.errors import InputError

#: GiB: larger limits are taken for this one, which no machine has.
MOST_MEMORY = 2.0**20
#: Default share of free memory to use, and bytes to use if the system does not tell what is free.
_SHARE, _USUAL = 0.8, 8 << 30


def available_memory() -> int | None:
    """Return the bytes that this process may still allocate, or None where the system does not tell."""
    amounts = []
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                amounts.append(int(line.split()[1]) * 1024)
    except (OSError, ValueError, IndexError):
        pass
    try:
        amounts.append(int(Path("/sys/fs/cgroup/memory.max").read_text()))
    except (OSError, ValueError):
        pass
    return min(amounts) if amounts else None


def allowed_memory(limit: float | None) -> int:
    """Return the bytes that may be taken: ``limit`` in GiB, or most of the free memory where it is None.

    Raises InputError: it is no positive number.
    """
    if limit is not None:
        return int(min(positive(limit, "--memory-limit"), MOST_MEMORY) * 2**30)
    free = available_memory()
    return _USUAL if free is None else int(_SHARE * free)


def check_memory(needed: int, file: Path, what: str) -> None:
    """Raise InputError if ``needed`` bytes are more than the memory available."""
    available = available_memory()
    if available is not None and needed > available:
        raise InputError(
            f"{what} needs about {needed / 2**30:.1f} GiB of memory, {available / 2**30:.1f} GiB are free",
            file=file,
            fix="use a machine with more memory or a smaller scene",
        )
