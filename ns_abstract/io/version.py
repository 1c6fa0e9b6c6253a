"""The version and rules that a result was computed with, and the check for results of other versions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: Version of the package.
VERSION = "0.2.0"
#: Number of the rules that abstract images are computed by. It is raised whenever a wrong image is mended.
RENDER_RULES = 1
#: Keys of a fingerprint that say what computed a result. Searches number their own rules under "rules".
_KEYS = ("ns_abstract", "render_rules", "rules")
#: What to do with results of another version, at the end of a fix.
ADVISORY = "docs/advisories.md lists what earlier versions got wrong"


def computed_by() -> dict[str, Any]:
    """Return the part of a fingerprint that names this version of the package and its rules for abstract images."""
    return {"ns_abstract": VERSION, "render_rules": RENDER_RULES}


def stale(stored: Mapping[str, Any], current: Mapping[str, Any]) -> str | None:
    """Return a note if ``stored`` was computed by another version or other rules than ``current`` names.

    ``current``: fingerprint that it must agree with; keys that it lacks are not compared. Returns the end of a sentence
    about the result; None where version and rules agree.
    """
    if all(stored.get(key) == current[key] for key in _KEYS if key in current):
        return None
    return f"computed by {_named(stored)}, not by {_named(current)}"


def _named(fingerprint: Mapping[str, Any]) -> str:
    version = fingerprint.get("ns_abstract")
    if not isinstance(version, str) or not version.replace(".", "").isalnum() or len(version) > 20:
        return "an ns-abstract before 0.2.0" if version is None else "another ns-abstract"
    numbers = {key: fingerprint.get(key) for key in _KEYS[1:]}
    rules = [f"{key.replace('_', ' ')} {value}" for key, value in numbers.items() if isinstance(value, int)]
    return f"ns-abstract {version}" + (f" ({', '.join(rules)})" if rules else "")
