"""Pages from templates: one file that loads nothing from the network, with every text of a template escaped."""

from __future__ import annotations

import base64
import hashlib
import shlex
import unicodedata
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from ns_abstract.report.figures import ShownUnits, number, percent, short_guarantee

_FOLDER = Path(__file__).parent
#: Categories of Unicode: controls, formats such as changes of direction, halves of pairs, ends of lines.
_UNSEEN = ("Cc", "Cf", "Cs", "Zl", "Zp")
#: Sentences on a search that left cells unexamined, by the state of its report.
SEARCH_STATES = {
    "running": "The command was still running, or was killed, when this page was written.",
    "interrupted": "The command was interrupted; go on with --resume.",
    "budget": "The time budget ended first; go on with --resume.",
}


def uri(data: bytes) -> str:
    """Return a PNG as a data URI."""
    return "data:image/png;base64," + base64.b64encode(data).decode()


def counted(number_of: int, noun: str) -> str:
    """Return a number with its noun, singular or plural."""
    return f"{number_of:,} {noun}{'' if number_of == 1 else 's'}"


def set_of(entry: Mapping[str, Any], units: ShownUnits) -> str:
    """Return the ranges of a frame's parameters that vary, as text."""
    sides = [units.interval(p["name"], p["unit"], p["lower"], p["upper"]) for p in entry["parameters"]]
    return " · ".join(sides)


def plain_text(value: Any) -> str:
    """Return a value of report.json as text."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, dict):
        return ", ".join(f"{key}: {plain_text(item)}" for key, item in value.items())
    if isinstance(value, list):
        return ", ".join(map(plain_text, value))
    return str(value)


def _in_order(value: Any) -> Any:
    """Return a template's value; characters that are invisible or turn text around become their numbers."""
    if not isinstance(value, str) or isinstance(value, Markup) or value.isprintable():
        return value
    return "".join(ascii(c)[1:-1] if unicodedata.category(c) in _UNSEEN and c not in "\n\t" else c for c in value)


def _guarantee_of(document: Mapping[str, Any]) -> str:
    return short_guarantee(document["guarantee"], document["scene"].get("bounded"))


@cache
def _templates() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(_FOLDER / "templates"),
        autoescape=True,
        finalize=_in_order,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    environment.filters |= {
        "command": lambda parts: shlex.join(map(str, parts)),
        "counted": counted,
        "number": number,
        "percent": percent,
        "plain": plain_text,
        "repr": repr,
        "uri": uri,
    }
    environment.globals["guarantee_of"] = _guarantee_of
    return environment


def fill(template: str, **values: Any) -> Markup:
    """Return a template of the folder `templates` with values filled in; every value but `Markup` is escaped."""
    return Markup(_templates().get_template(template).render(values))


@cache
def _text(name: str) -> str:
    return (_FOLDER / name).read_text(encoding="utf-8")


def whole_page(template: str, styles: Sequence[str] = (), scripts: Sequence[str] = (), **values: Any) -> str:
    """Return a page that extends base.html, with its style sheets and scripts, which cannot load anything.

    The browser runs only ``scripts``, which the page's policy lists by their hashes.
    """
    script = "".join(_text(name) for name in scripts)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = Markup(f"; script-src 'sha256-{digest}'" if script else "")
    style = Markup("".join(_text(f"templates/{name}") for name in ("page.css", *styles)))
    return str(fill(template, style=style, script=Markup(script), policy=policy, **values))
