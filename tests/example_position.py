"""A record of the virtual stand whose errors are known."""

from __future__ import annotations

from typing import Any


def stand_record(turn: float, shift: float) -> dict[str, Any]:
    """A record with given errors, the signs of the turns alternating."""
    one = {
        "rotation": {"rows": [{"error_deg": turn}, {"error_deg": -turn / 2}]},
        "translation": [{"against_probe_mm": shift, "origin_mm": 9.0}],
    }
    return {"cameras": [one, one], "positions": 3, "method": "m"}
