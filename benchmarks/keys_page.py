"""Write docs/keys.md: every key of config.yml, camera paths and perturbation files, and what it does to the picture.

python benchmarks/keys_page.py
"""

from __future__ import annotations

from pathlib import Path

from ns_abstract.geometry import path_keys
from ns_abstract.io.keys import Key, KeyTable
from ns_abstract.methods import config_keys
from ns_abstract.perturbation.specification import FILE_KEYS, ROTATIONS, TRANSLATIONS
from ns_abstract.perturbation.variations import KEYS, SELECT_KEYS

PAGE = Path(__file__).resolve().parents[1] / "docs" / "keys.md"
_INTRODUCTION = """# Keys of every file

You give files that other programs wrote. This page says for each of their keys whether it is *used*, *irrelevant* to
the evaluated picture (why, and the file and line of Nerfstudio 1.1.5 that show it), or *refused*. A key that changes
the picture is never ignored.

What happens to a key that is on none of these lists:

| file | unknown key |
|---|---|
| perturbation file, property, loop | an error (exit code 2); `"$schema"` is accepted |
| config.yml, under `pipeline.model` | an error that names the key |
| config.yml elsewhere, camera path | named in the notes of the report |

A key stands for all that is below it, unless keys below it are listed.
"""
_PARTS = {
    "translation": TRANSLATIONS,
    "rotation": ROTATIONS,
    "orbit": ("target", "axis", "azimuth"),
    "scene": (*KEYS, *(f"select.{name}" for name in SELECT_KEYS)),
}


def perturbation_table() -> KeyTable:
    """The keys of a perturbation file."""
    found = []
    for name, meaning in FILE_KEYS.items():
        found.append(Key(name, "used", meaning))
        if name in _PARTS:
            found += [Key(f"{name}{'[]' * (name == 'scene')}.{part}", "used", "") for part in _PARTS[name]]
    return KeyTable("The perturbation file", tuple(found))


def _values(key: Key) -> str:
    """What is taken or refused of a key that is refused in part."""

    def shown(values: tuple) -> str:
        names = {False: "false", True: "true", None: "null"}
        return ", ".join(f"`{value if isinstance(value, str) else names[value]}`" for value in values)

    if key.refuses:
        return f" (refused: {shown(key.refuses)})"
    return f" (but {shown(key.accepts)})" if key.accepts else ""


def section(table: KeyTable) -> str:
    """The Markdown of one table."""
    lines = [f"## {table.title}", "", "| key | | why | Nerfstudio 1.1.5 |", "|---|---|---|---|"]
    for key in table.keys:
        where = f"`{key.where}`" if key.where else ""
        lines.append(f"| `{key.name}` | {key.status}{_values(key)} | {key.why} | {where} |")
    return "\n".join(lines)


def page() -> str:
    """The whole page."""
    tables = (*config_keys.TABLES, *path_keys.TABLES, perturbation_table())
    return "\n\n".join([_INTRODUCTION.rstrip(), *(section(table) for table in tables)]) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page())
