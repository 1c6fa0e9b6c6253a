"""Reading a file of `torch.export.save` into a network, without unpickling or executing anything in it."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import file_size, show
from ns_abstract.io.memory import check_memory
from ns_abstract.verify.network.exported_graph import FIX, Reader, contents
from ns_abstract.verify.network.exported_rules import OPERATORS
from ns_abstract.verify.network.graph import Network

#: Bytes in memory for a byte of a file.
_COPIES = 6

Run = Callable[[np.ndarray], np.ndarray]


def read_exported(path: Path, output: str | None = None) -> tuple[Network, Run]:
    """The network in a .pt2 file, and the same graph run with torch's own operators on one image [1, ...].

    ``output``: the output that is read; None: the only one.

    Raises:
        InputError: The file cannot be read, or uses what is not supported; names node, operator and argument.
    """
    try:
        check_memory(_COPIES * file_size(path, "network"), path, "the network")
        with zipfile.ZipFile(path) as archive:
            graph, weights = contents(path, archive)
        reader = Reader(path, graph, weights, OPERATORS, output)
        return reader.network(), reader.run
    except (InputError, MemoryError):
        raise
    except (OSError, zipfile.BadZipFile) as error:
        raise InputError(f"is not an archive of torch.export ({error})", file=path, fix=FIX) from None
    except RecursionError:
        raise InputError("its graph is nested too deep", file=path, fix=FIX) from None
    except Exception as error:  # zipfile, json and the graph's own reading raise many types on damaged files
        problem = f"holds what is not read here, or is damaged ({show(repr(error))})"
        raise InputError(problem, file=path, fix=FIX) from None
