"""The figures of a frame, and their texts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from ns_abstract.refine.result import FrameResult, TracePoint, max_pixel_gap, mean_pixel_gap

#: Ratios whose times are told.
MARKS = (1.5, 1.25, 1.1, 1.05)
#: Runs of numbers that a line lists.
_RUNS = 8


def metrics(result: FrameResult) -> dict[str, float | None]:
    """Return the figures of one frame.

    ``mpg``, ``xpg``: mean and maximum over the pixels of the length over RGB of upper - lower (the paper's metrics);
    ``mpg_witness``, ``xpg_witness``: the same of the rendered extremes; ``ratio``: mpg / mpg_witness, None where that
    is not finite.
    """
    mpg = mean_pixel_gap(result.lower, result.upper)
    witness = mean_pixel_gap(result.witness_lower, result.witness_upper)
    ratio = mpg / witness if witness > 0.0 else math.inf
    return {
        "mpg": mpg,
        "xpg": max_pixel_gap(result.lower, result.upper),
        "mpg_witness": witness,
        "xpg_witness": max_pixel_gap(result.witness_lower, result.witness_upper),
        "ratio": ratio if math.isfinite(ratio) else None,
    }


def layer_metrics(result: FrameResult) -> dict[str, dict[str, float | None]]:
    """Return the figures of a frame's further outputs, by name; None where a number is not finite.

    ``mean_gap``: mean over the pixels of upper - lower, in the output's unit; ``mean_gap_witness``: the same of the
    rendered extremes; ``ratio``: the first over the second.
    """
    metrics_by_name: dict[str, dict[str, float | None]] = {}
    for name, layer in result.layers.items():
        outer, inner = layer.mean_gap(), layer.mean_gap_witness()
        ratio = outer / inner if inner > 0.0 else math.inf
        values = {"mean_gap": outer, "mean_gap_witness": inner, "ratio": ratio}
        metrics_by_name[name] = {key: value if math.isfinite(value) else None for key, value in values.items()}
    return metrics_by_name


def seconds_to(trace: Sequence[TracePoint], marks: Sequence[float] = MARKS) -> dict[float, float | None]:
    """Return the seconds of work until MPG was at most each of ``marks`` times the witness MPG; None: never."""
    seconds: dict[float, float | None] = {}
    for mark in marks:
        times = (p.seconds for p in trace if p.covered == 1.0 and p.mpg <= mark * p.mpg_witness)
        seconds[mark] = next(times, None)
    return seconds


def number(value: float | None, digits: int = 4) -> str:
    """Return a number as text with ``digits`` significant digits; a dash for None."""
    if value is None:
        return "–"
    text = f"{value:.{digits}g}"
    if "e" not in text:
        return text
    mantissa, exponent = text.split("e")
    return f"{mantissa}e{int(exponent)}"


def percent(part: float | None) -> str:
    """Return a fraction as text in per cent; "100 %" and "0 %" are returned only where exact."""
    if part is None:
        return "–"
    text = f"{100.0 * part:.2f}"
    if part < 1.0 and text == "100.00":
        return "> 99.99 %"
    if part > 0.0 and text == "0.00":
        return "< 0.01 %"
    return f"{text} %"


def unit_of_axis(unit: str) -> str:
    """Return a unit's text, shortened for an axis."""
    return "units" if unit == "normalised units" else unit


#: A cell as a report has it: lower, upper, verdict, counterexample.
Row = Mapping[str, Any]
#: An orbit is drawn as a ring from so many radians on.
_RING = 1.0


def is_ring(parameter: Mapping[str, Any]) -> bool:
    """Return whether a parameter is a full turn, which is drawn as a ring."""
    return parameter["name"] == "azimuth" and parameter["upper"] - parameter["lower"] >= _RING


class _OtherUnit(NamedTuple):
    """A unit beside that of files, the factor to it, and whether it is the one that was requested."""

    unit: str
    factor: float
    is_requested: bool


@dataclass(frozen=True)
class ShownUnits:
    """The units in which a pose set was stated: texts have these, and the files' units beside them.

    ``translation``: "normalised" or "dataset"; ``angle``: "radians" or "degrees"; ``dataset_scale``: normalised units
    per unit of the data set.
    """

    translation: str = "normalised"
    angle: str = "radians"
    dataset_scale: float = 1.0

    @classmethod
    def of(cls, scene: Mapping[str, Any]) -> ShownUnits:
        """Return the units that a report's ``scene`` names, or those of the normalised frame."""
        return cls(**scene.get("units", {}))

    def axis(self, unit: str) -> tuple[str, float]:
        """Return the unit in which values in ``unit`` are drawn, and the factor to it."""
        other = self._other(unit)
        return (other.unit, other.factor) if other is not None and other.is_requested else (unit, 1.0)

    def _other(self, unit: str) -> _OtherUnit | None:
        """Return the second unit for values in ``unit``, or None."""
        if unit == "rad":
            return _OtherUnit("degrees", math.degrees(1.0), self.angle == "degrees")
        if unit == "normalised units" and (self.translation == "dataset" or self.dataset_scale != 1.0):
            return _OtherUnit("units of the data set", 1.0 / self.dataset_scale, self.translation == "dataset")
        return None

    def value(self, name: str, unit: str, value: float) -> str:
        """Return a parameter's value as text: as it is stored, then in the requested unit."""
        shown_unit, factor = self.axis(unit)
        beside = "" if factor == 1.0 else f" ({number(value * factor, 6)} {shown_unit})"
        return f"{name} = {value!r}{beside}"

    def drawn(self, entry: Mapping[str, Any], rows: Sequence[Row]) -> tuple[dict[str, Any], list[Row]]:
        """Return a frame's entry of report.json and its cells, converted to the requested units.

        A full turn stays in radians: it is drawn as a ring.
        """
        parameters = entry["parameters"]
        axes = [(p["unit"], 1.0) if is_ring(p) else self.axis(p["unit"]) for p in parameters]
        factors = [factor for _, factor in axes]
        if all(factor == 1.0 for factor in factors):
            return dict(entry), list(rows)

        def scaled(values: Sequence[float] | None) -> list[float] | None:
            return None if values is None else [v * f for v, f in zip(values, factors, strict=True)]

        sides = [
            {**p, "unit": unit, "lower": p["lower"] * factor, "upper": p["upper"] * factor}
            for p, (unit, factor) in zip(parameters, axes, strict=True)
        ]
        places = ("lower", "upper", "counterexample")
        return {**entry, "parameters": sides}, [
            {**row, **{key: scaled(row[key]) for key in places if key in row}} for row in rows
        ]

    def interval(self, name: str, unit: str, low: float, high: float) -> str:
        """Return one side of a box as text, in the requested unit and in the files' unit."""
        text, other = interval(name, unit, low, high), self._other(unit)
        if other is None:
            return text
        beside = interval(name, other.unit, low * other.factor, high * other.factor)
        first, second = (beside, text) if other.is_requested else (text, beside)
        return f"{first} ({second.removeprefix(name).strip().removeprefix('∈ ')})"


def interval(name: str, unit: str, low: float, high: float) -> str:
    """Return one side of a box as text; a symmetric one as a radius."""
    size = f"± {number(high)}" if low == -high else f"∈ [{number(low, 6)}, {number(high, 6)}]"
    return f"{name} {size} {unit}".strip()


def listed(numbers: Sequence[int]) -> str:
    """Return ascending ``numbers`` as text, runs by their ends; of many runs, how many there are."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    texts = [f"{a} to {b}" if b > a + 1 else ", ".join(map(str, dict.fromkeys((a, b)))) for a, b in runs[:_RUNS]]
    return ", ".join(texts) + (f" and others, {len(numbers):,} together" if len(runs) > _RUNS else "")


def frames_listed(indices: Sequence[int]) -> str:
    """Return ascending ``indices`` of frames as text, such as "frame 3" or "frames 0 to 4, 7"."""
    return f"frame{'' if len(indices) == 1 else 's'} {listed(indices)}"


def short_guarantee(guarantee: str, bounded: str | None) -> str:
    """Return a guarantee's name and the bounded part of the scene, as "float32-sound, of the Gaussians alone".

    Args:
        guarantee: "float32-sound", "real-sound" or "sampled".
        bounded: The bounded part of the scene, such as "of the Gaussians alone"; None: all of it.
    """
    return guarantee if bounded is None or guarantee == "sampled" else f"{guarantee}, {bounded}"
