"""Pages from templates: one file that needs nothing from the net, and every text that a template is given escaped."""

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
    """A PNG as an address that needs no file."""
    return "data:image/png;base64," + base64.b64encode(data).decode()


def counted(number_of: int, noun: str) -> str:
    """A number of things in words."""
    return f"{number_of:,} {noun}{'' if number_of == 1 else 's'}"


def set_of(entry: Mapping[str, Any], units: ShownUnits) -> str:
    """The sides of a frame's set that vary, in words."""
    sides = [units.interval(p["name"], p["unit"], p["lower"], p["upper"]) for p in entry["parameters"]]
    return " · ".join(sides)


def plain_text(value: Any) -> str:
    """A value of report.json for people."""
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
    """A value of a template; of a text, characters that are not seen or turn others round stand as their numbers."""
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
    """A template of the folder `templates` with values in its places; what is not `Markup` is escaped."""
    return Markup(_templates().get_template(template).render(values))


@cache
def _text(name: str) -> str:
    return (_FOLDER / name).read_text(encoding="utf-8")


def whole_page(template: str, styles: Sequence[str] = (), scripts: Sequence[str] = (), **values: Any) -> str:
    """A page that extends base.html, with its style sheets and scripts and no way to load anything.

    The only code that the browser runs in it is ``scripts``, which the page's policy names by their hash.
    """
    script = "".join(_text(name) for name in scripts)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = Markup(f"; script-src 'sha256-{digest}'" if script else "")
    style = Markup("".join(_text(f"templates/{name}") for name in ("page.css", *styles)))
    return str(fill(template, style=style, script=Markup(script), policy=policy, **values))
