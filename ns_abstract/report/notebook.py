"""HTML of results for notebooks."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape

from ns_abstract.refine.result import FrameResult
from ns_abstract.report.picture import previews

#: Longest side of a picture in pixels.
_SIDE = 320
_TITLES = {"lower": "lower bound", "upper": "upper bound", "gap": "gap", "image": "one render"}
_COLORS = {"certified": "#2e7d4f", "falsified": "#b3341d", "unknown": "#b9b9b9"}


def _panel(title: str, png: bytes) -> str:
    source = base64.b64encode(png).decode()
    style = "margin:0 8px 0 0;display:inline-block;text-align:center"
    return (
        f'<figure style="{style}"><img alt="{title}" style="image-rendering:pixelated;width:200px" '
        f'src="data:image/png;base64,{source}"><figcaption>{title}</figcaption></figure>'
    )


def _block(lines: Sequence[str]) -> str:
    return f"<p>{'<br>'.join(escape(line) for line in lines)}</p>"


def frame_html(frame: FrameResult, lines: Sequence[str]) -> str:
    """Return the four pictures of an abstract image with lines of text below."""
    pictures = previews(frame, _SIDE)
    panels = "".join(_panel(title, pictures[name]) for name, title in _TITLES.items() if name in pictures)
    return f"<div>{panels}{_block(lines)}</div>"


def verdicts_html(shares: Mapping[str, float], lines: Sequence[str]) -> str:
    """Return a bar of a set's fractions by verdict with lines of text below."""
    bar = "".join(
        f'<span title="{kind}" style="display:inline-block;height:14px;width:{100.0 * share:.4f}%;'
        f'background:{_COLORS[kind]}"></span>'
        for kind, share in shares.items()
    )
    return f'<div><div style="width:100%;font-size:0;line-height:0">{bar}</div>{_block(lines)}</div>'
