"""The report's part about how far the scene may vary."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Any

from ns_abstract.report.figures import number

_OUTCOMES = {"falsified": "a scene breaks it", "unknown": "not proved"}


def scene_margin(entry: Mapping[str, Any]) -> str:
    """HTML of the key ``scene_margin`` of report.json."""
    title = "<h2>How wrong the scene may be</h2>"
    if entry["skipped"]:
        return f"{title}<p>No margin: {escape(entry['skipped'])}.</p>"

    def tried(trial: Mapping[str, Any] | None) -> str:
        if trial is None:
            return "–"
        why = f" ({escape(trial['reason'])})" if trial["outcome"] == "unknown" else ""
        return f"{number(trial['radius'], 4)}: {_OUTCOMES[trial['outcome']]}{why}"

    rows = "".join(
        f'<tr><td class="left">{escape(kind["kind"])}</td><td>{number(kind["radius"], 4)} {escape(kind["unit"])}</td>'
        f'<td class="left">{tried(kind["not_certified"])}</td><td class="left">{tried(kind["falsified"])}</td>'
        f"<td>{kind['runs']}</td><td>{number(kind['seconds'], 3)}</td></tr>"
        for kind in entry["kinds"]
    )
    lines = "".join(f"<li>{escape(kind['text'])}.</li>" for kind in entry["kinds"])
    return (
        f"{title}<p>Every certified cell was bounded again for all scenes that are off by no more than a radius, every "
        f"Gaussian by itself, the camera, or (registration, turn) the scene as a whole; it is certified again "
        f"for the radius in the table, and so for every smaller one."
        f'</p><ul>{lines}</ul><div class="wide"><table><thead><tr><th class="left">what varies</th>'
        '<th>radius, certified</th><th class="left">smallest not certified</th><th class="left">smallest broken</th>'
        f"<th>runs</th><th>seconds</th></tr></thead><tbody>{rows}</tbody></table></div>"
    )
