"""HTML of reports: one self-contained page, one style sheet for all, and tables."""

from collections.abc import Iterable, Mapping
from html import escape
from itertools import chain, repeat
from typing import Any, Final

_STYLE: Final = """
:root{color-scheme:light dark;--good:#1565c0;--bad:#b3202a}
@media (prefers-color-scheme:dark){:root{--good:#7db4f5;--bad:#ff7864}}
body{font:clamp(15px,.8vw,32px)/1.5 system-ui,sans-serif;max-width:72em;margin:2em auto;padding:0 1em}
h2{margin-top:1.8em}code{font-size:90%;overflow-wrap:anywhere}.b{font-size:1.3em}
table{border-collapse:collapse;margin:.6em 0 1.2em}th,td{padding:.2em .8em;text-align:left;vertical-align:top}
th,td{border-bottom:1px solid #8884}th{background:#8882}.n{text-align:right;font-variant-numeric:tabular-nums}
figure{margin:1em 0;background:#fff;color:#000}
p{overflow-wrap:anywhere}svg,img{width:60em;max-width:100%;height:auto}.wide svg{width:100%}
.verdict{padding:.4em .8em;color:#fff;background:#b3202a}.passed{background:#1565c0}
.kept{color:var(--good)}.broken,.failed{color:var(--bad);font-weight:bold}
@media (max-width:48em){table{display:block;overflow-x:auto}th,td{padding:.2em .5em}
td:nth-child(2):last-child{overflow-wrap:anywhere}td table{overflow-wrap:normal}}
@media print{h2{break-after:avoid}img,svg{break-inside:avoid}}
"""
"""Good and bad in the colours of the viewer's lanes, 50 and more apart (CIELAB) to the colour-blind too; text
grows with a window beyond 1875 px, and on a telephone a table that is too wide moves by itself."""

_PERCENT: Final = "\N{NO-BREAK SPACE}%"


def html_page(title: str, parts: Iterable[str]) -> str:
    """Return the page; ``parts`` are HTML."""
    head = (
        "<meta charset='utf-8'><meta name='viewport' content='width=device-width'>"
        f"<title>{escape(title)}</title><style>{_STYLE}</style>"
    )
    return f"<!doctype html><html lang='en'><head>{head}</head><body>{''.join(parts)}</body></html>\n"


def html_table(
    heads: Iterable[str],
    rows: Iterable[Iterable[Any]],
    ids: Iterable[str] = (),
    classes: Mapping[Any, str] | None = None,
) -> str:
    """Return a table; without words in ``heads`` it has no first row.

    A mapping in a cell is a table of its own. ``ids``: of the rows, for links to them. ``classes``: of cells,
    by what stands in them.
    """
    titles = list(heads)
    head = "".join(f"<th>{escape(each)}</th>" for each in titles) if any(titles) else ""
    marks = chain((f" id='{each}'" for each in ids), repeat(""))
    body = "".join(
        f"<tr{mark}>{''.join(_cell(value, classes or {}) for value in row)}</tr>"
        for row, mark in zip(rows, marks, strict=False)
    )
    return f"<table>{f'<tr>{head}</tr>' if head else ''}{body}</table>"


def html_pairs(values: Mapping[str, Any]) -> str:
    """Return a table of names and values, without those that are empty."""
    shown = ((name, _told(value)) for name, value in values.items() if value not in (None, "", {}))
    return html_table([], shown)


def _told(value: Any) -> Any:
    """A number in a column of words is read as one."""
    return f"{value:.6g}" if isinstance(value, float) else str(value) if isinstance(value, int) else value


def _cell(value: Any, classes: Mapping[Any, str]) -> str:
    if isinstance(value, Mapping):
        return f"<td>{html_pairs(value)}</td>"
    kind = "n" if isinstance(value, int | float) else classes.get(value, "")
    mark = f" class='{kind}'" if kind else ""
    return f"<td{mark}>{escape(str(value)).replace(' %', _PERCENT)}</td>"
