"""The page docs/dev/network-charges.md: the table of what networks are charged with, and its constants."""

from __future__ import annotations

from pathlib import Path

from network_table import FUNCTIONS, SUMS, SYMBOLS, Row  # pyright: ignore[reportMissingImports]

from ns_abstract.arithmetic import network_charges

CHARGES = Path(__file__).resolve().parents[1] / "docs" / "dev" / "network-charges.md"


def page() -> str:
    """docs/dev/network-charges.md."""

    def rows(part: tuple[Row, ...]) -> str:
        lines = ["| layer | charge | programs | proof |", "|---|---|---|---|"]
        for row in part:
            charge = f"`{row.charge}`".replace("|", "\\|")
            also = "; with real arithmetic, too" if row.real else ""
            lines.append(f"| {row.kind} | {charge}{also} | {row.programs} | {row.labels} |")
        return "\n".join(lines)

    symbols = "\n".join(f"| `{name}` | {meaning} |" for name, meaning in SYMBOLS.items())
    constants = "\n".join(
        f"| `{name}` | {value / network_charges.UNIT:.6g} | {value:.4g} |"
        for name, value in vars(network_charges).items()
        if name.isupper() and isinstance(value, float) and value < 2.0**-8
    )
    return f"""# What networks are charged with

For every kind of layer: how far a float32 program may be from the layer's exact value, which programs that covers, and
where it is proved. The table is `benchmarks/network_table.py`, its constants with their counts are in
`ns_abstract/arithmetic/network_charges.py`; `python benchmarks/network_ledger.py --write` writes this page and measures
every row ([measurements](measurements.md#ledger-of-networks-charges)).

Not covered: TF32 and half precision, Winograd and FFT convolutions.

## Sums, scales, maps

{rows(SUMS)}

## Functions of one number

{rows(FUNCTIONS)}

## Symbols

| symbol | meaning |
|---|---|
{symbols}

## Constants

| constant | units of float32 | value |
|---|---|---|
{constants}
"""
