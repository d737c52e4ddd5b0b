"""The files that pages are made of: templates, styles and scripts beside this module."""

from __future__ import annotations

from importlib import resources

import jinja2


def templates() -> jinja2.Environment:
    """Of HTML: what is put in is escaped, and what is missing is an error."""
    return jinja2.Environment(
        loader=jinja2.PackageLoader("vanejax", "report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def source(name: str) -> str:
    """A style or a script, as it is."""
    return (resources.files("vanejax") / "report" / name).read_text(encoding="utf-8")
