"""The report as one HTML file for screen and paper."""

from __future__ import annotations

import base64
import datetime
import html
import io
import re
from pathlib import Path

from matplotlib.image import imread

from experiments.pages.reproduction.claim import Verdict
from experiments.pages.reproduction.document import (
    HOW_TO_READ,
    PAPER,
    SOURCES,
    SUMMARIES,
    TITLE,
    WAS_RUN,
    Document,
    closing,
    summaries,
)
from experiments.pages.reproduction.markdown import to_html
from experiments.pages.reproduction.topic import Picture
from experiments.runner.machine import cores, cpu_model
from experiments.runner.markdown import slug
from experiments.runner.run_folder import git_commit

PICTURE_DPI = 110

STYLE = """
:root { --ink: #1d2025; --soft: #5b626d; --line: #dfe2e6; --well: #f6f7f8; --link: #0b5cad;
  --good: #14783a; --half: #8a5a00; --bad: #b3261e; --none: #5b626d; }
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; }
body { margin: 0; background: #fff; color: var(--ink); font-size: 16px; line-height: 1.5;
  font-family: system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", "Noto Sans", Arial,
  sans-serif; font-variant-numeric: tabular-nums; }
main, header, footer { max-width: 1080px; margin: 0 auto; padding: 0 24px; }
header { padding-top: 40px; }
footer { padding-top: 8px; padding-bottom: 40px; color: var(--soft); font-size: 14px; }
h1 { font-size: 34px; line-height: 1.15; margin: 0 0 8px; letter-spacing: -.015em; }
h2 { font-size: 23px; line-height: 1.25; margin: 52px 0 12px; padding-top: 14px;
  border-top: 2px solid var(--ink); }
h3 { font-size: 17px; margin: 30px 0 8px; }
p, ul { margin: 12px 0; max-width: 78ch; }
.lead { color: var(--soft); }
a { color: var(--link); }
nav { background: var(--well); padding: 14px 20px; border-radius: 8px; margin: 24px 0; }
nav h2 { border: 0; margin: 0 0 6px; padding: 0; font-size: 15px; }
nav ol { margin: 0; padding-left: 22px; columns: 2; column-gap: 36px; font-size: 15px; }
nav li { break-inside: avoid; }
.scroll { overflow-x: auto; margin: 16px 0; }
.scroll:focus-visible, a:focus-visible { outline: 2px solid #2b6cb0; outline-offset: 2px; }
table { border-collapse: collapse; font-size: 14px; line-height: 1.4; width: 100%; }
th, td { text-align: left; vertical-align: top; padding: 7px 14px 7px 0;
  border-bottom: 1px solid var(--line); }
th { font-weight: 600; color: var(--soft); border-bottom: 1px solid var(--soft);
  vertical-align: bottom; }
th.n, td.n { text-align: right; }
td.k { white-space: nowrap; }
table.wide { font-size: 12.5px; }
table.wide th, table.wide td { padding: 5px 10px 5px 0; }
pre { margin: 0; padding: 14px 16px; background: var(--well); border-radius: 8px; font-size: 12px;
  line-height: 1.45; display: inline-block; min-width: 100%;
  font-family: ui-monospace, "SF Mono", "Cascadia Mono", "DejaVu Sans Mono", Menlo, Consolas,
  monospace; }
code { font-family: ui-monospace, "SF Mono", "Cascadia Mono", "DejaVu Sans Mono", Menlo, Consolas,
  monospace; font-size: .88em; overflow-wrap: anywhere; }
figure { margin: 22px 0; }
figure img { display: block; width: 100%; height: auto; max-width: var(--width); margin: 0 auto; }
figcaption { color: var(--soft); font-size: 14px; margin: 8px auto 0; max-width: 90ch; }
.verdict { font-weight: 650; white-space: nowrap; }
.verdict::before { content: ""; display: inline-block; width: 9px; height: 9px; margin-right: 6px;
  border-radius: 50%; background: currentColor; }
.good { color: var(--good); } .half { color: var(--half); } .bad { color: var(--bad); }
table.stack td.n { text-align: left; } table.stack th.n { text-align: left; }
.none { color: var(--none); } .none::before { background: none; border: 1.5px solid; }
@media (max-width: 700px) {
  main, header, footer { padding-left: 16px; padding-right: 16px; }
  header { padding-top: 24px; }
  h1 { font-size: 27px; } h2 { font-size: 20px; margin-top: 40px; }
  nav ol { columns: 1; }
  table:not(.stack) { min-width: 620px; }
  .stack thead { position: absolute; width: 1px; height: 1px; overflow: hidden;
    clip-path: inset(50%); }
  .stack, .stack tbody, .stack tr, .stack td { display: block; }
  .stack tr { padding: 10px 0; border-bottom: 1px solid var(--line); }
  .stack td, .stack td.n { border: 0; padding: 2px 0 2px 92px; text-align: left;
    position: relative; }
  .stack td::before { content: attr(data-head); position: absolute; left: 0; width: 84px;
    color: var(--soft); font-size: 13px; }
  .stack td:first-child { padding-left: 0; font-weight: 600; }
  .stack td:first-child::before { content: none; }
}
@page { size: A4; margin: 15mm 14mm 16mm; }
@media print {
  body { font-size: 9.5pt; line-height: 1.4; }
  main, header, footer { max-width: none; padding: 0; }
  h1 { font-size: 21pt; } h2 { font-size: 14pt; margin-top: 18pt; } h3 { font-size: 11pt; }
  h2, h3 { break-after: avoid; }
  p { orphans: 3; widows: 3; }
  a { color: inherit; text-decoration: none; }
  nav { background: none; padding: 0; break-inside: avoid; }
  .scroll { overflow: visible; }
  table { font-size: 7.8pt; line-height: 1.3; }
  th, td { padding: 2.5pt 8pt 2.5pt 0; }
  table.wide { font-size: 6.3pt; }
  table.wide th, table.wide td { padding: 2pt 4pt 2pt 0; }
  thead { display: table-header-group; }
  tr { break-inside: avoid; }
  pre { display: block; min-width: 0; background: none; border: .5pt solid var(--line);
    padding: 2mm; font-size: min(8pt, calc(176mm / var(--columns) / .605)); }
  figure { break-inside: avoid; margin: 10pt 0; }
  figure img { max-height: 150mm; width: auto; max-width: 100%; }
  figcaption { font-size: 8.5pt; }
}
"""
_KINDS = {
    Verdict.BETTER.value: "good",
    Verdict.MET.value: "good",
    Verdict.PARTLY.value: "half",
    Verdict.MISSED.value: "bad",
    Verdict.INCOMPARABLE.value: "none",
    Verdict.UNKNOWN.value: "none",
    "failed": "bad",
    "not run": "none",
}


def to_page(report: Document) -> str:
    """The HTML file's text: no script, no request, every picture inside."""
    body = [f"<p>{html.escape(HOW_TO_READ)}</p>", _stacked(to_html(summaries(report)))]
    for section in report.sections:
        topic = section.topic
        body.append(f'<section aria-labelledby="{topic.anchor}">')
        body.append(f'<h2 id="{topic.anchor}">{html.escape(topic.title)}</h2>')
        for number, part in enumerate(section.parts):
            if isinstance(part, Picture):
                body.append(_figure(part, report))
            else:
                text = to_html(part, name=topic.title)
                body.append(_stacked(text) if number == 0 else text)
        body.append("</section>")
    body.append(_stacked(to_html(closing(report))))
    machine = f"{cpu_model()}, {cores()} cores"
    now = datetime.datetime.now().astimezone().isoformat(sep=" ", timespec="minutes")
    made = f"Made {now}, commit {(git_commit() or 'unknown')[:11]}, {machine}."
    titles = [*SUMMARIES, *(section.topic.title for section in report.sections)]
    titles += [WAS_RUN, SOURCES] if report.outcomes else [SOURCES]
    contents = "".join(
        f'<li><a href="#{slug(title)}">{html.escape(title)}</a></li>' for title in titles
    )
    return _badges(f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src \
'unsafe-inline'">
<title>{TITLE}</title>
<style>{STYLE}</style>
</head>
<body>
<header>
<h1>{TITLE}</h1>
<p class="lead">{html.escape(PAPER)}: every table and figure, with the paper’s value, ours, and \
what follows. {html.escape(report.mode)}</p>
<p class="lead">{html.escape(made)}</p>
</header>
<main>
<nav aria-labelledby="contents"><h2 id="contents">Contents</h2><ol>{contents}</ol></nav>
{chr(10).join(body)}
</main>
<footer><p>{html.escape(made)}</p></footer>
</body>
</html>
""")


def _badges(text: str) -> str:
    """Verdicts with their colour beside their words."""
    for words, kind in _KINDS.items():
        mark = f"<strong>{words}</strong>"
        text = text.replace(mark, f'<strong class="verdict {kind}">{words}</strong>')
    return text


def _stacked(text: str) -> str:
    """Tables whose rows a narrow screen shows as blocks: every cell knows its column's head."""
    pieces = text.split("<table>")
    for index, piece in enumerate(pieces[1:], 1):
        heads = re.findall(r'<th scope="col"[^>]*>(.*?)</th>', piece)
        head, _, rest = piece.partition("<tbody>")
        rows = rest.split("<tr>")
        for number, row in enumerate(rows[1:], 1):
            cells = row.split("<td")
            rows[number] = cells[0] + "".join(
                f'<td data-head="{name}"{cell}' for name, cell in zip(heads, cells[1:], strict=True)
            )
        pieces[index] = f"{head}<tbody>{'<tr>'.join(rows)}"
    return '<table class="stack">'.join(pieces)


def _figure(picture: Picture, report: Document) -> str:
    """A picture with its words; nothing where it was not made."""
    if picture.draw is not None:
        buffer = io.BytesIO()
        picture.draw().savefig(buffer, format="png", dpi=PICTURE_DPI, metadata={"Software": None})
        data = buffer.getvalue()
    else:
        path = _file(picture, report)
        if path is None:
            return ""
        data = path.read_bytes()
    height, width = imread(io.BytesIO(data)).shape[:2]
    address = "data:image/png;base64," + base64.b64encode(data).decode("ascii")
    return (
        f'<figure><img src="{address}" width="{width}" height="{height}" '
        f'style="--width: {width}px" alt="{html.escape(picture.alt)}">'
        f"<figcaption>{html.escape(picture.caption)}</figcaption></figure>"
    )


def _file(picture: Picture, report: Document) -> Path | None:
    """The file of a picture that is not drawn: the run's, or the recorded one; None if neither."""
    for folder, name in ((report.run, picture.run), (report.docs, picture.docs)):
        if folder is not None and name and (folder / name).is_file():
            return folder / name
    return None
