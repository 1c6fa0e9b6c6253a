"""Memory that is left, asked before anything large is allocated."""

from __future__ import annotations

from pathlib import Path

from ns_abstract.io.errors import InputError


def available_memory() -> int | None:
    """Bytes of memory this process may still take, or None where the system does not say."""
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


def check_memory(needed: int, file: Path, what: str) -> None:
    """Raise InputError if ``needed`` bytes are more than the memory available."""
    available = available_memory()
    if available is not None and needed > available:
        raise InputError(
            f"{what} needs about {needed / 2**30:.1f} GiB of memory, {available / 2**30:.1f} GiB are free",
            file=file,
            fix="use a machine with more memory or a smaller scene",
        )
