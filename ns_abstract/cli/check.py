"""``ns-abstract-check``: audits a result with a program that shares no code with the bounds."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ns_abstract.cli.common import command, run


@dataclass
class Check:
    """Prove claims of a stored result again, drawn at random, with a second and much smaller program.

    A claim says that one channel of a pixel stays between its bounds for every pose of one cell. Each is proved,
    refuted by a pose, or left open when its time is over. Writes check.json into the folder. Exit codes: 0 nothing is
    refuted; 1 a claim is refuted; 2 bad input; 3 fewer than 80 % of the claims were settled, or interrupted.
    """

    output_dir: Annotated[Path, tyro.conf.Positional]
    """Output folder of ns-abstract-render --save-cells, ns-abstract-certify or ns-abstract-reach."""
    claims: int = 200
    """Number of claims to draw."""
    seconds: float = 600.0
    """Time for all of them."""
    seed: int = 0
    """Of the draws."""
    load_config: Path | None = None
    """config.yml or scene file, if it has been moved since."""
    camera_path_filename: Path | None = None
    """The camera path, if it has been moved since."""
    perturbation_filename: Path | None = None
    """The perturbation file, if it has been moved since."""
    model: Path | None = None
    """The network's .onnx file, if it has been moved since."""
    property: Path | None = None
    """The property file, if it has been moved since."""
    loop: Path | None = None
    """LOOP.json, if it has been moved since."""


def check(options: Check) -> int:
    from ns_abstract.api.checking import check as audited

    audit = audited(
        options.output_dir,
        claims=options.claims,
        seconds=options.seconds,
        seed=options.seed,
        load_config=options.load_config,
        camera_path=options.camera_path_filename,
        perturbation=options.perturbation_filename,
        model=options.model,
        property=options.property,
        loop=options.loop,
    )
    for text in audit.structure:
        print(f"refuted: {text}")
    for entry in audit.refutations[:10]:
        where = f"frame {entry['frame']}, cell {entry['cell']}"
        if "pixel" in entry:
            row, column = entry["pixel"]
            what = f"{entry['value']:.6f} is beyond the {entry['bound']} bound by {entry['excess']:.2g}"
            where = f"{where}, pixel ({row}, {column}), channel {entry['channel']}"
        else:
            what = f"the margin is {entry['margin']:.6g} at most, {entry['excess']:.2g} below what is claimed"
        print(f"refuted: {where}: {what} at {entry['pose']}")
    print(
        f"{audit.claims} claims: {audit.proved} proved ({audit.float32} of every float32 evaluation, the others of the "
        f"picture in real numbers), {audit.refuted} refuted, {audit.unsettled} not settled; "
        f"{audit.median_seconds:.2g} s a claim"
    )
    share, count = audit.uniform["holds_at_least"], audit.uniform["claims"]
    print(
        f"at least {100.0 * share:.1f} % of all claims hold in real numbers, and "
        f"{100.0 * audit.uniform['float32_at_least']:.1f} % in float32 (95 % confidence, {count} drawn uniformly)"
    )
    if audit.unsettled:
        print("claims that are not settled need more --seconds, or are of bounds too tight for this program to prove")
    if audit.unclaimed:
        print(f"nothing is claimed, and checked, of frames {', '.join(map(str, audit.unclaimed))}")
    print(f"details: {options.output_dir / 'check.json'}")
    return audit.exit_code


def main() -> None:
    run(check, command("ns-abstract-check", Check), "close other programs")


if __name__ == "__main__":
    main()
