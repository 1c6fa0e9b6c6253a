"""An audit of a stored result by `ns_abstract.check`, which shares no code with the bounds."""

from __future__ import annotations

import math
import os
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

from ns_abstract.check.audit import ClaimOutcome, open_result, settle_claims
from ns_abstract.check.inputs import BadInput
from ns_abstract.io.arguments import callback, file_path, positive, whole
from ns_abstract.io.atomic import write_json
from ns_abstract.io.errors import InputError
from ns_abstract.io.jsonio import unusable

#: Part of the claims that must be settled.
_ENOUGH = 0.8
#: What of every claim is known stays in memory.
_MOST_CLAIMS = 1_000_000


@dataclass
class Audit:
    """The outcome of an audit: numbers of claims that were proved, refuted and not settled.

    Attributes:
        claims: Number of claims that were examined.
        proved, refuted, unsettled: Their numbers by outcome.
        float32: Number of those proved for every float32 evaluation; the others concern the picture in real numbers.
        refutations: For each refuted claim: frame, cell, pose, what is wrong.
        uniform: Claims and proofs of the uniform sample, and the least fraction of all claims that holds, at 95 %.
        structure: Faults of the cells; empty: they tile every set, every pixel is bounded, counts are right.
        seconds, median_seconds: Of all claims, and of one that was settled.
        picture: What all proved claims hold of: "real numbers", or "every float32 evaluation".
        unclaimed: Numbers of frames of which nothing is claimed: they are missing, or their cells do not cover the set.
    """

    claims: int = 0
    proved: int = 0
    refuted: int = 0
    unsettled: int = 0
    float32: int = 0
    refutations: list[dict[str, Any]] = field(default_factory=list)
    uniform: dict[str, Any] = field(default_factory=dict)
    structure: list[str] = field(default_factory=list)
    seconds: float = 0.0
    median_seconds: float = 0.0
    picture: str = "real numbers"
    unclaimed: list[int] = field(default_factory=list)

    @property
    def exit_code(self) -> int:
        """0 nothing refuted, 1 refuted, 3 too few claims settled."""
        if self.refuted or self.structure:
            return 1
        return 3 if self.proved < _ENOUGH * self.claims or not self.claims else 0

    def _tally(self, outcomes: list[ClaimOutcome]) -> None:
        """Sets the counts of proved, refuted and unsettled claims from ``outcomes``, the outcome of every claim."""
        self.claims, self.proved = len(outcomes), sum(o.verdict is True for o in outcomes)
        self.refuted, self.unsettled = (sum(o.verdict is v for o in outcomes) for v in (False, None))
        self.float32 = sum(o.verdict is True and o.float32 for o in outcomes)
        self.refutations = [o.refutation for o in outcomes if o.verdict is False]
        self.picture = "every float32 evaluation" if self.proved == self.float32 > 0 else "real numbers"
        drawn = [o for o in outcomes if o.uniform]
        proved = [o for o in drawn if o.verdict is True]
        sure = sum(o.float32 for o in proved)
        self.uniform = {
            "claims": len(drawn), "proved": len(proved), "holds_at_least": least_part(len(proved), len(drawn)),
            "float32": sure, "float32_at_least": least_part(sure, len(drawn)),
        }  # fmt: skip


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
    property: str | os.PathLike[str] | None = None,
    loop: str | os.PathLike[str] | None = None,
    on_progress: Callable[[Audit], object] | None = None,
) -> Audit:
    """Return numbers of claims of a result that were proved, refuted and left open by a second program.

    Args:
        output_dir: Output folder of ``ns-abstract-render --save-cells``, ``ns-abstract-certify`` or
            ``ns-abstract-reach``; ``check.json`` is written there.
        claims: Number of claims to draw; a claim is one channel of a pixel over one cell, or one certified cell.
        seconds: Time for all of them.
        seed: Of the draws.
        load_config, camera_path, perturbation, model, property, loop: Where files lie that have been moved since; None:
            where the report says.
        on_progress: Called after every claim; returning False ends the audit.

    Raises:
        InputError: A file or a field in it cannot be used.
    """
    callback(on_progress)
    claims, seconds, seed = whole(claims, 1, "claims"), positive(seconds, "seconds"), whole(seed, 0, "seed")
    if claims > _MOST_CLAIMS:
        raise unusable(claims, field="claims", fix=f"give a number of at most {_MOST_CLAIMS:,}")
    if seed >= 2**63:
        raise unusable(seed, field="seed", fix="give a number below 2**63")
    moved = {
        "load_config": load_config,
        "camera_path_filename": camera_path,
        "perturbation_filename": perturbation,
        "model": model,
        "property": property,
        "loop": loop,
    }
    files = {name: None if file is None else file_path(file, name) for name, file in moved.items()}
    folder, begin = file_path(output_dir, "output_dir"), time.monotonic()
    finished, spent = [], []
    try:
        wrong, subjects, silent = open_result(folder, files)
        audit = Audit(structure=wrong, unclaimed=silent)
        start = time.monotonic()
        for outcome in settle_claims(subjects, 0 if wrong else claims, begin + seconds - start, seed):
            finished.append(outcome)
            spent.append(time.monotonic() - start)
            if on_progress is not None:
                audit._tally(finished)
                if on_progress(audit) is False:
                    break
            start = time.monotonic()
        else:
            # there was no time for the others
            late = range(len(finished), 0 if wrong else claims)
            finished += [ClaimOutcome(None, False, number % 2 == 0, {}) for number in late]
        audit._tally(finished)
    except BadInput as error:
        raise InputError(error.problem, fix=error.fix, file=error.file, field=error.field) from None
    # claims that the time did not reach come last and took none
    settled = [took for outcome, took in zip(finished, spent, strict=False) if outcome.verdict is not None]
    audit.seconds, audit.median_seconds = time.monotonic() - begin, statistics.median(settled or spent or [0.0])
    write_json(folder / "check.json", {"version": 1, "seed": seed, **asdict(audit)})
    return audit


def least_part(proved: int, count: int, level: float = 0.95) -> float:
    """Return Clopper and Pearson's lower limit, at ``level``, of the part that holds: ``proved`` of ``count`` do."""
    low, high = 0.0, float(proved > 0)
    for _ in range(60):
        p = 0.5 * (low + high)
        logs = (
            math.lgamma(count + 1) - math.lgamma(k + 1) - math.lgamma(count - k + 1)
            + k * math.log(p) + (count - k) * math.log1p(-p)
            for k in range(proved, count + 1)
            if proved
        )  # fmt: skip
        low, high = (p, high) if sum(map(math.exp, logs)) <= 1.0 - level else (low, p)
    return low if proved else 0.0
