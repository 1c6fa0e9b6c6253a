"""Formulas as MathML: browsers show them without scripts, and the site loads nothing from elsewhere."""

from __future__ import annotations

import re
from html import unescape
from typing import Any

from latex2mathml.converter import convert

# what pymdownx.arithmatex leaves in place of $...$ and $$...$$
_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[\(\[](.*?)\\[\)\]]</\1>', re.DOTALL)
# a formula on lines of its own inside a paragraph
_DISPLAYED = re.compile(r"^\$\$(.*?)\$\$", re.DOTALL | re.MULTILINE)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """The page's source with blank lines around displayed formulas, which makes them blocks."""
    return _DISPLAYED.sub(lambda match: f"\n$$\n{match[1].strip()}\n$$\n\n", markdown)


def on_page_content(html: str, **_: Any) -> str:
    """The page with every formula in MathML; a formula that cannot be read stops the build."""

    def written(match: re.Match[str]) -> str:
        kind, formula = match[1], unescape(match[2]).strip()
        display = "block" if kind == "div" else "inline"
        try:
            return convert(formula, display=display)
        except Exception as error:
            raise ValueError(f"formula {formula!r} cannot be read: {error!r}") from error

    return _FORMULA.sub(written, html)
