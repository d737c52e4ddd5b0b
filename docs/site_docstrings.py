"""What the API reference makes of docstrings: an extension of griffe, which mkdocs loads."""

from __future__ import annotations

import re
from typing import Any

import griffe


class PublicNames(griffe.Extension):
    """Lists what a package exports as links, where each object is shown once, in its module."""

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        """Rewrites the packages when all modules are read."""
        for package in [pkg, *pkg.modules.values()]:
            if not (package.is_package or package.is_subpackage) or package.docstring is None:
                continue
            paths = {
                name: member.target_path
                for name, member in package.members.items()
                if member.is_alias
                and member.target_path.startswith("vanejax.")
                and not name.isupper()  # constants have no entry of their own
            }
            for name in paths:
                package.del_member(name)
            links = [f"[`{name}`][{path}]" for name, path in sorted(paths.items())]
            if links:
                package.docstring.value += f"\n\nPublic names: {', '.join(links)}."

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """One entry for several names: 'width, height: image size in pixels'."""
        if obj.docstring is not None:
            obj.docstring.value = re.sub(
                r"(?m)^( *)(\w+(?:, \w+)+):",
                lambda entry: entry[1] + entry[2].replace(" ", "\u00a0") + ":",
                obj.docstring.value,
            )
