"""The files that pages are made of: templates, styles and scripts beside this module."""

from __future__ import annotations

import base64
import hashlib
from importlib import resources
from typing import Any

import jinja2

from vanejax.report.pictures import color_bar
from vanejax.report.wording import (
    degrees,
    direction,
    fixed,
    millimetres,
    percent,
    plus_minus,
    significant,
)


def page(name: str, **values: Any) -> str:
    """HTML by a template: what is put in is escaped, and what is missing is an error."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("vanejax", "report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    for words in (degrees, direction, fixed, millimetres, percent, plus_minus, significant):
        environment.filters[words.__name__] = words
    script = source("viewer.js")
    return environment.get_template(name).render(
        values,
        color_bar=color_bar(),
        style=source("page.css"),
        script=script,
        script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
    )


def source(name: str) -> str:
    """A style or a script, as it is."""
    return (resources.files("vanejax") / "report" / name).read_text(encoding="utf-8")
