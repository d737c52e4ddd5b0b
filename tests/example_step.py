"""A corner of 40 x 30 x 20 mm, and STEP files of it in several units."""

from __future__ import annotations

import numpy as np

VERTICES = np.array([[0.0, 0, 0], [40, 0, 0], [0, 30, 0], [0, 0, 20]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
STEP_UNITS = {
    "mm": ("(LENGTH_UNIT() NAMED_UNIT(*) SI_UNIT(.MILLI.,.METRE.))", 1.0),
    "m": ("(LENGTH_UNIT() NAMED_UNIT(*) SI_UNIT($,.METRE.))", 1000.0),
    "in": ("(CONVERSION_BASED_UNIT('INCH',#18) LENGTH_UNIT() NAMED_UNIT(#17))", 25.4),
}


def step(unit: str) -> str:
    """The corner as a faceted solid in STEP (ISO 10303-21, AP214), in `unit`."""
    entity, mm = STEP_UNITS[unit]

    def triple(vector) -> str:
        return "(" + ",".join(f"{x:.9E}" for x in vector) + ")"

    lines = [
        f"#1={entity};",
        "#2=(NAMED_UNIT(*) PLANE_ANGLE_UNIT() SI_UNIT($,.RADIAN.));",
        "#3=(NAMED_UNIT(*) SI_UNIT($,.STERADIAN.) SOLID_ANGLE_UNIT());",
        "#4=UNCERTAINTY_MEASURE_WITH_UNIT(LENGTH_MEASURE(1.E-07),#1,'distance_accuracy_value','');",
        "#5=(GEOMETRIC_REPRESENTATION_CONTEXT(3) GLOBAL_UNCERTAINTY_ASSIGNED_CONTEXT((#4)) "
        "GLOBAL_UNIT_ASSIGNED_CONTEXT((#1,#2,#3)) REPRESENTATION_CONTEXT('',''));",
        "#6=APPLICATION_CONTEXT('automotive design');",
        "#7=PRODUCT_CONTEXT('',#6,'mechanical');",
        "#8=PRODUCT('corner','corner','',(#7));",
        "#9=PRODUCT_DEFINITION_FORMATION('','',#8);",
        "#10=PRODUCT_DEFINITION_CONTEXT('part definition',#6,'design');",
        "#11=PRODUCT_DEFINITION('design','',#9,#10);",
        "#12=PRODUCT_DEFINITION_SHAPE('','',#11);",
        "#13=SHAPE_DEFINITION_REPRESENTATION(#12,#14);",
        "#14=FACETED_BREP_SHAPE_REPRESENTATION('',(#15),#5);",
        "#15=FACETED_BREP('',#16);",
        "#16=CLOSED_SHELL('',(#206,#306,#406,#506));",
        "#17=DIMENSIONAL_EXPONENTS(1.,0.,0.,0.,0.,0.,0.);",
        "#18=LENGTH_MEASURE_WITH_UNIT(LENGTH_MEASURE(25.4),#19);",
        "#19=(LENGTH_UNIT() NAMED_UNIT(*) SI_UNIT(.MILLI.,.METRE.));",
    ]
    for index, vertex in enumerate(VERTICES / mm):
        lines.append(f"#{100 + index}=CARTESIAN_POINT('',{triple(vertex)});")
    for k, face in zip((200, 300, 400, 500), FACES, strict=True):
        a, b, c = VERTICES[face] / mm
        normal, along = np.cross(b - a, c - a), b - a
        loop = ",".join(f"#{100 + index}" for index in face)
        lines += [
            f"#{k}=DIRECTION('',{triple(normal / np.linalg.norm(normal))});",
            f"#{k + 1}=DIRECTION('',{triple(along / np.linalg.norm(along))});",
            f"#{k + 2}=AXIS2_PLACEMENT_3D('',#{100 + face[0]},#{k},#{k + 1});",
            f"#{k + 3}=PLANE('',#{k + 2});",
            f"#{k + 4}=POLY_LOOP('',({loop}));",
            f"#{k + 5}=FACE_OUTER_BOUND('',#{k + 4},.T.);",
            f"#{k + 6}=FACE_SURFACE('',(#{k + 5}),#{k + 3},.T.);",
        ]
    head = (
        "ISO-10303-21;\nHEADER;\nFILE_DESCRIPTION((''),'2;1');\n"
        "FILE_NAME('','',(''),(''),'','','');\n"
        "FILE_SCHEMA(('AUTOMOTIVE_DESIGN { 1 0 10303 214 1 1 1 1 }'));\nENDSEC;\nDATA;\n"
    )
    return head + "\n".join(lines) + "\nENDSEC;\nEND-ISO-10303-21;\n"
