"""Virtual scans of guide vanes, learned registration in JAX, and a pose to trust."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vanejax.locate import register

__all__ = ["register"]


def __getattr__(name: str) -> Any:
    """Loads `register` when it is asked for: importing the package stays cheap."""
    if name == "register":
        from vanejax.locate import register

        return register
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
