"""What a casting's dimensions may be off by: ISO 8062-3:2007, Table 2."""

from __future__ import annotations

from vanejax.errors import InputError

# nominal sizes up to and including these, mm; each row begins above the one before it
SIZES_MM = (10.0, 16.0, 25.0, 40.0, 63.0, 100.0, 160.0, 250.0, 400.0, 630.0)
# dimensional casting tolerance grades of investment castings of steel and nickel alloys, mm
TOLERANCES_MM = {
    4: (0.26, 0.28, 0.30, 0.32, 0.36, 0.40, 0.44, 0.50, 0.56, 0.64),
    5: (0.36, 0.38, 0.42, 0.46, 0.50, 0.56, 0.62, 0.70, 0.78, 0.90),
    6: (0.52, 0.54, 0.58, 0.64, 0.70, 0.78, 0.88, 1.00, 1.10, 1.20),
}


def dimensional_tolerance_mm(size_mm: float, grade: int) -> float:
    """The whole width of a dimension's tolerance, mm; a casting may be off by half of it.

    ISO 8062-3:2007, Table 2, which is for dimensions of the casting, any machining stock included.

    Args:
      size_mm: the nominal dimension, up to 630 mm.
      grade: DCTG 4, 5 or 6.

    Raises:
      InputError: a size or a grade that is not in the table.
    """
    if grade not in TOLERANCES_MM:
        raise InputError(f"no casting tolerance grade DCTG {grade}; there are 4, 5 and 6")
    if not 0 < size_mm <= SIZES_MM[-1]:
        raise InputError(
            f"no casting tolerance for a nominal size of {size_mm!r} mm; "
            f"sizes are above 0 and up to {SIZES_MM[-1]:g} mm"
        )
    row = next(row for row, most_mm in enumerate(SIZES_MM) if size_mm <= most_mm)
    return TOLERANCES_MM[grade][row]
