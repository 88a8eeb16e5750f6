"""A report of one file that any browser shows, prints and reads aloud, and that asks nothing of the network."""

import base64
from collections.abc import Sequence
from html import escape

# Nothing is loaded from anywhere: the browser itself refuses it.
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
STYLE = """
:root { color-scheme: light; }
body { margin: 0 auto; max-width: 72rem; padding: 1.5rem; color: #20242c; background: #fff;
       font: 16px/1.5 system-ui, -apple-system, "Segoe UI", "DejaVu Sans", sans-serif; }
h1 { font-size: 1.7rem; line-height: 1.25; margin: 0 0 .75rem; }
h2 { font-size: 1.25rem; margin: 2.25rem 0 .5rem; border-bottom: 1px solid #c9cdd4; padding-bottom: .2rem; }
p, li { max-width: 60rem; }
.verdict { font-size: 1.15rem; border-left: .3rem solid #0072b2; padding-left: 1rem; margin: 1rem 0; }
nav ul { list-style: none; padding: 0; margin: 0; display: flex; flex-wrap: wrap; gap: .25rem 1.25rem; }
a { color: #005a8f; }
figure { margin: 1.25rem 0 1.75rem; }
figcaption { max-width: 60rem; margin-top: .4rem; }
figcaption b { display: block; }
img { max-width: 100%; height: auto; display: block; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; margin: .75rem 0 1rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; font-weight: 600; padding-bottom: .35rem; }
th, td { padding: .3rem .7rem; border-bottom: 1px solid #d9dce1; text-align: left; vertical-align: top; }
thead th { border-bottom: 2px solid #20242c; vertical-align: bottom; }
tbody th { font-weight: 500; }
td.number, th.number { text-align: right; }
td.number { white-space: nowrap; }
td.wide { min-width: 14rem; }
.total th, .total td { border-top: 2px solid #20242c; font-weight: 600; }
.group { border-left: 1px solid #d9dce1; }
code, pre { font: .9rem/1.45 ui-monospace, "DejaVu Sans Mono", Menlo, Consolas, monospace; }
pre { background: #f3f4f6; padding: .75rem 1rem; white-space: pre-wrap; overflow-wrap: anywhere; }
td code { overflow-wrap: anywhere; }
dt { font-weight: 600; margin-top: .6rem; }
dd { margin: 0 0 0 1.25rem; max-width: 60rem; }
@media print {
  body { max-width: none; padding: 0; font-size: 10pt; }
  nav { display: none; }
  h2 { break-after: avoid; }
  figure, tr, dt { break-inside: avoid; }
  .scroll { overflow: visible; }
  table { font-size: 8.5pt; }
  th, td { padding: .15rem .35rem; }
  a { color: inherit; text-decoration: none; }
}
"""


def page_start(generator: str) -> str:
    """How every page of a program begins; by it a program knows its own pages."""
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="generator" content="{escape(generator)}">\n'
    )


def html_page(title: str, verdict: str, sections: Sequence[tuple[str, str, str]], *, generator: str = "surgsim") -> str:
    """The page's text.

    Args:
        title: of the page, plain text.
        verdict: what matters most, in a paragraph of plain text.
        sections: (id, heading in plain text, content in HTML).
        generator: the program that makes it.
    """
    links = "".join(f'<li><a href="#{name}">{escape(heading)}</a></li>' for name, heading, _ in sections)
    body = "\n".join(
        f'<section id="{name}" aria-labelledby="{name}-heading">\n<h2 id="{name}-heading">{escape(heading)}</h2>\n'
        f"{content}\n</section>"
        for name, heading, content in sections
    )
    return (
        f'{page_start(generator)}<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<title>{escape(title)}</title>\n<link rel="icon" href="data:,">\n<style>{STYLE}</style>\n</head>\n<body>\n'
        f'<header>\n<h1>{escape(title)}</h1>\n<p class="verdict">{escape(verdict)}</p>\n'
        f'<nav aria-label="Contents"><ul>{links}</ul></nav>\n</header>\n<main>\n{body}\n</main>\n</body>\n</html>\n'
    )


def html_picture(data: bytes, title: str, description: str, note: str = "") -> str:
    """A PNG picture as a figure with its caption; plain text but for the note, which is HTML."""
    return (
        f'<figure>\n<img src="data:image/png;base64,{base64.b64encode(data).decode("ascii")}" '
        f'alt="{escape(f"{title}. {description}")}">\n'
        f"<figcaption><b>{escape(title)}</b> {escape(description)}{note}</figcaption>\n</figure>"
    )


def html_table(caption: str, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of plain text whose first column names the rows."""
    head = "".join(f'<th scope="col">{escape(one)}</th>' for one in heads)
    body = "\n".join(
        f'<tr><th scope="row">{escape(row[0])}</th>' + "".join(f"<td>{escape(one)}</td>" for one in row[1:]) + "</tr>"
        for row in rows
    )
    return (
        f'<div class="scroll"><table><caption>{escape(caption)}</caption><thead><tr>{head}</tr></thead>\n'
        f"<tbody>{body}</tbody></table></div>"
    )
