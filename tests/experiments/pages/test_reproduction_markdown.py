"""The Markdown of the report as HTML."""

from __future__ import annotations

import re

from experiments.pages.reproduction.markdown import cells, inline, to_html
from experiments.runner.markdown import table


def test_markdown_becomes_html() -> None:
    text = """### A & b

One **bold** `a<b` [link](#x)
goes on.

- first
  more
- second

| a | b |
|---|---|
| x \\| y | 1.5 |

```text
 <pre>
```"""
    made = to_html(text, name="N")
    for words in (
        '<h3 id="a--b">A &amp; b</h3>',
        '<p>One <strong>bold</strong> <code>a&lt;b</code> <a href="#x">link</a> goes on.</p>',
        "<ul><li>first more</li><li>second</li></ul>",
        '<td>x | y</td><td class="n">1.5</td>',
        '<pre style="--columns: 6"> &lt;pre&gt;</pre>',
        'aria-label="N: table"',
    ):
        assert words in made, words


def test_text_is_no_code() -> None:
    evil = "<script>alert(1)</script>"
    for text in (
        evil,
        f"{evil} `x`",
        f"- {evil}",
        f"| {evil} |\n|---|\n| {evil} |",
        f"```\n{evil}\n```",
        f"`{evil}`",
        f"### {evil}",
    ):
        assert "<script>" not in to_html(text)
    assert '"' not in re.sub(r'href="[^"]*"', "", inline('[a](x"onclick=)'))


def test_tables_survive_bars() -> None:
    made = table(["a|b", "c"], [["1|2", "3"]])
    assert [cells(line) for line in made.splitlines()] == [["a|b", "c"], ["---"] * 2, ["1|2", "3"]]
