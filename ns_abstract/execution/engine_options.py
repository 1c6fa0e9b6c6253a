"""Command-line options on where work runs; importing this module is quick, as ``--help`` must be."""

from __future__ import annotations

import os
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ns_abstract.io.errors import InputError

if TYPE_CHECKING:
    from ns_abstract.execution.engines import Engine


@dataclass(frozen=True)
class EngineOptions:
    """Where the work runs."""

    engine: Literal["local", "dask"] = "local"
    """dask: spread the work over a Dask cluster (needs the extra "cluster")."""
    scheduler_address: str | None = None
    """HOST:PORT of a running Dask scheduler. Default: a cluster on this machine."""
    tls_ca_file: Path | None = None
    """Certificate of who signs the scheduler's (PEM), as for `dask scheduler`; with --tls-cert and --tls-key."""
    tls_cert: Path | None = None
    """This command's certificate (PEM)."""
    tls_key: Path | None = None
    """The certificate's key (PEM)."""
    workers: int | None = None
    """Processes on this machine; 1 works in this process. They bound cells of splats, rays of a NeRF. Default:
    one by core."""

    @property
    def processes(self) -> int:
        """Number of worker processes on this machine."""
        return len(os.sched_getaffinity(0)) if self.workers is None else self.workers

    @property
    def ray_processes(self) -> int:
        """Number of processes that bound the rays of a NeRF; each worker of a cluster has one."""
        return 1 if self.engine == "dask" and self.workers is None else self.processes

    def check(self) -> None:
        """Raise InputError where options contradict each other."""
        if self.processes < 1:
            raise InputError(f"found {self.workers}", field="--workers", fix="give a number of at least 1")
        if self.engine == "local" and self.scheduler_address is not None:
            raise InputError("given without --engine dask", field="--scheduler-address", fix="add --engine dask")

    def started(self, processes: int) -> AbstractContextManager[Engine]:
        """Return the engine as a context manager that closes it; ``processes`` workers run on this machine."""
        from ns_abstract.execution.cluster import Tls
        from ns_abstract.execution.starting import started

        tls = Tls.of(self.tls_ca_file, self.tls_cert, self.tls_key, self.scheduler_address)
        return started(self.engine, self.scheduler_address, processes, tls)
