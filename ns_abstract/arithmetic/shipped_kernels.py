"""Compiled kernels that come with an installation, for processors of a level of x86-64.

numba loads a kernel on the processor alone that it was compiled for. What a wheel brings was compiled for a level,
x86-64-v3 say (NUMBA_CPU_NAME), and gets the name of this processor where it has the level's features (System V ABI,
AMD64 supplement, section 3.1.1). A level's folder is ``kernels/LEVEL/<hash of the sources>`` in the package, of the
form that `kernel_cache` describes; ``benchmarks/ship_kernels.py`` makes it.
"""

from __future__ import annotations

from pathlib import Path

import numba.core.config as settings
from numba.core.caching import IndexDataCacheFile
from numba.core.codegen import get_host_cpu_features
from numba.core.registry import cpu_target

#: The folder of the package that levels lie in.
SHIPPED = "kernels"
_V2 = frozenset(("cx16", "popcnt", "sahf", "sse3", "sse4.1", "sse4.2", "ssse3"))
_V3 = _V2 | {"avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe", "xsave"}
#: Features of each level in LLVM's names, the highest level first.
LEVELS = {"x86-64-v4": _V3 | {"avx512bw", "avx512cd", "avx512dq", "avx512f", "avx512vl"}, "x86-64-v3": _V3}


def runs(level: str) -> bool:
    """Whether this processor has all features of a level."""
    features = get_host_cpu_features().split(",")
    return LEVELS[level] <= {feature[1:] for feature in features if feature.startswith("+")}


def shipped_folder(package: Path, key: str) -> Path | None:
    """Return the folder of kernels (``key``: hash of their sources) for this processor's highest level, or None.

    None, too, where NUMBA_CPU_NAME or NUMBA_CPU_FEATURES say what to compile for.
    """
    if settings.CPU_NAME is not None or settings.CPU_FEATURES is not None:  # pyright: ignore[reportAttributeAccessIssue]
        return None
    folders = [(level, package / SHIPPED / level / key[:32]) for level in LEVELS]
    return next((folder for level, folder in folders if folder.is_dir() and runs(level)), None)


def adopt(folder: Path, function: str, stamp: str) -> None:
    """Rewrite a function's kernels in ``folder``: they name this processor in place of the level compiled for.

    Kernels of other sources than those of ``stamp`` are dropped.
    """
    index = IndexDataCacheFile(str(folder), function, stamp)
    # compiled for: triple, name of the processor, its features
    own = cpu_target.target_context.codegen().magic_tuple()  # pyright: ignore[reportAttributeAccessIssue]
    overloads = {
        (signature, own if target[0] == own[0] and target[1] in LEVELS else target, hashes): name
        for (signature, target, hashes), name in index._load_index().items()
    }
    index._save_index(overloads)
