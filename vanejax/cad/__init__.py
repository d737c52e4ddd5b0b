"""From a CAD file to a `Part`.

In: STL, OBJ, PLY, GLB or STEP, in any unit; or the parameters of a guide vane. Out: a `Part`, a
closed solid in millimetres in a fixed order of faces, with samples of its surface, nearest points,
and castings of it that differ from the model as investment castings do.
"""

from vanejax.cad.casting_tolerances import dimensional_tolerance_mm
from vanejax.cad.declared_symmetry import PartSymmetry, Symmetry
from vanejax.cad.investment_casting import (
    InvestmentCasting,
    as_cast,
    with_stock_on_one_side,
    without_a_corner,
)
from vanejax.cad.parametric_vane import GuideVaneSegment, guide_vane
from vanejax.cad.part import Part, load_part, part_from_mesh
from vanejax.cad.surface import NearestFace, Surface
from vanejax.cad.triangles import Triangles

__all__ = [
    "GuideVaneSegment",
    "InvestmentCasting",
    "NearestFace",
    "Part",
    "PartSymmetry",
    "Surface",
    "Symmetry",
    "Triangles",
    "as_cast",
    "dimensional_tolerance_mm",
    "guide_vane",
    "load_part",
    "part_from_mesh",
    "with_stock_on_one_side",
    "without_a_corner",
]
