"""How results show themselves in a notebook."""

from __future__ import annotations

import base64
from html import escape
from typing import TYPE_CHECKING

from ns_abstract.report.certificate_page import percent
from ns_abstract.report.figures import interval, number
from ns_abstract.report.picture import previews

if TYPE_CHECKING:
    from ns_abstract.api.bounding import BoundResult
    from ns_abstract.api.certifying import Certificate

#: Longest side of a picture in pixels.
_SIDE = 320
_TITLES = {"lower": "lower bound", "upper": "upper bound", "gap": "gap", "image": "one render"}


def _panel(title: str, png: bytes) -> str:
    source = base64.b64encode(png).decode()
    style = "margin:0 8px 0 0;display:inline-block;text-align:center"
    return (
        f'<figure style="{style}"><img alt="{title}" style="image-rendering:pixelated;width:200px" '
        f'src="data:image/png;base64,{source}"><figcaption>{title}</figcaption></figure>'
    )


def bound_html(result: BoundResult) -> str:
    """The four pictures of an abstract image and its figures."""
    pictures = previews(result.frame, _SIDE)
    panels = "".join(_panel(title, pictures[name]) for name, title in _TITLES.items() if name in pictures)
    box = result.parameters
    sides = [interval(*side) for side in zip(box.names, box.units, box.lower, box.upper, strict=True)]
    known = f"mean gap {number(result.mpg)}, largest {number(result.xpg)}, ratio to real renders {number(result.ratio)}"
    lines = [
        known if result.bounded else "no bounds but [0, 1] yet",
        f"{result.guarantee}; {result.cell_count} cells, {result.seconds:.1f} s; {result.status}",
        "; ".join(sides) or "one camera pose",
    ]
    return f"<div>{panels}<p>{'<br>'.join(escape(line) for line in lines)}</p></div>"


def certificate_html(certificate: Certificate) -> str:
    """Verdict, coverage and the cells' verdicts in a bar."""
    shares = {kind: getattr(certificate, kind) for kind in ("certified", "falsified", "unknown")}
    colors = {"certified": "#2e7d4f", "falsified": "#b3341d", "unknown": "#b9b9b9"}
    bar = "".join(
        f'<span title="{kind}" style="display:inline-block;height:14px;width:{100.0 * share:.4f}%;'
        f'background:{colors[kind]}"></span>'
        for kind, share in shares.items()
    )
    figures = ", ".join(f"{kind} {percent(share)}" for kind, share in shares.items())
    lines = [
        f"{certificate.verdict}: on every image {certificate.sentence}",
        figures,
        f"{certificate.guarantee}; {len(certificate.cells)} cells, {certificate.seconds:.1f} s; {certificate.state}",
    ]
    text = "<br>".join(escape(line) for line in lines)
    return f'<div><div style="width:100%;font-size:0;line-height:0">{bar}</div><p>{text}</p></div>'
