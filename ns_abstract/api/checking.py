"""An audit of a stored result by `ns_abstract.check`, which shares no code with the bounds."""

from __future__ import annotations

import os
from collections.abc import Callable

from ns_abstract.check.audit import Audit, run
from ns_abstract.check.inputs import BadInput
from ns_abstract.io.arguments import file_path, positive, whole
from ns_abstract.io.errors import InputError


def check(
    output_dir: str | os.PathLike[str],
    *,
    claims: int = 200,
    seconds: float = 600.0,
    seed: int = 0,
    load_config: str | os.PathLike[str] | None = None,
    camera_path: str | os.PathLike[str] | None = None,
    perturbation: str | os.PathLike[str] | None = None,
    model: str | os.PathLike[str] | None = None,
    loop: str | os.PathLike[str] | None = None,
    on_progress: Callable[[Audit], object] | None = None,
) -> Audit:
    """Numbers of claims of a result that were proved, refuted and left open by a second program.

    Args:
        output_dir: Output folder of ``ns-abstract-render --save-cells``, ``ns-abstract-certify`` or
            ``ns-abstract-reach``; ``check.json`` is written there.
        claims: Number of claims to draw; a claim is one channel of a pixel over one cell, or one certified cell.
        seconds: Time for all of them.
        seed: Of the draws.
        load_config, camera_path, perturbation, model, loop: Where files lie that have been moved since; None: where the
            report says.
        on_progress: Called after every claim; returning False ends the audit.

    Raises:
        InputError: A file or a field in it cannot be used.
    """
    whole(claims, 1, "claims")
    positive(seconds, "seconds")
    if whole(seed, 0, "seed") >= 2**63:
        raise InputError(f"found {seed}", field="seed", fix="give a number below 2**63")
    moved = {
        "load_config": load_config,
        "camera_path_filename": camera_path,
        "perturbation_filename": perturbation,
        "model": model,
        "loop": loop,
    }
    files = {name: None if file is None else file_path(file, name) for name, file in moved.items()}
    try:
        return run(
            file_path(output_dir, "output_dir"),
            claims=claims,
            seconds=seconds,
            seed=seed,
            moved=files,
            on_claim=on_progress,
        )
    except BadInput as error:
        raise InputError(error.problem, fix=error.fix, file=error.file, field=error.field) from None
