"""The network on the test views, as recorded and evaluated afresh."""

from __future__ import annotations

from experiments.pages.reproduction.claim import VISIBLE, Claim, Finding, Results, digits, met_if
from experiments.pages.reproduction.live import Live, side_by_side
from experiments.pages.reproduction.topic import Part, Picture, Topic, dated
from experiments.pages.tables import evaluation_table

_COMPARED = {
    "rotation_error_deg": "rotation error (deg)",
    "translation_error_mm": "translation error (mm)",
    "ffmde_abs_mm": "FFMDE, absolute (mm)",
    "rmse_mm": "RMSE (mm)",
}


def _overlays(results: Results) -> Finding:
    report = results["vane"]
    hardest, truth = report["hardest"], report["at_true_pose"]["ffmde_abs_mm"]["mean"]
    turn, shift = (
        hardest["summary"][name]["max"] for name in ("rotation_error_deg", "translation_error_mm")
    )
    ratio = hardest["summary"]["ffmde_abs_mm"]["mean"] / truth
    return Finding(
        f"at most {digits(turn)} deg and {digits(shift)} mm off",
        met_if(ratio <= VISIBLE),
        f"On the {len(hardest['rows'])} least visible views FFMDE is {ratio:.2f} times what the "
        "true pose has.",
    )


def _views(results: Results, live: Live | None) -> list[Part]:
    parts: list[Part] = [
        "RPM-Net alone on views that training never saw, from poses up to 45 deg and half a part "
        "radius away, noise of 0.01 radii on both clouds.",
        dated(results, "vane", evaluation_table),
    ]
    if live is not None:
        parts += ["### Evaluated afresh for this page", _against_record(results, live)]
    words = "scan in green, CAD model in red, before and after"
    parts += [
        Picture(
            f"Six test views, {words}",
            f"The paper's Fig. 7: the least visible view of each elevation, {words}.",
            run="vane/overlays.png",
        ),
        Picture(
            "Rotation and translation error of the test views over azimuth and elevation",
            "Where it is hard: the error of each test view.",
            run="vane/error_map.png",
        ),
    ]
    return parts


def _against_record(results: Results, live: Live) -> str:
    """Live and recorded figures side by side, and whether they are the same."""
    made = (
        f"The weights ({live.weights}) registered the {live.report['views']} test views again in "
        f"{live.seconds:.0f} s, new scans included ({live.report['date'][:10]}, commit "
        f"{str(live.report['commit'])[:10]})."
    )
    if "vane" not in results:
        return f"{made}\n\n{evaluation_table(live.report)}"
    record = results["vane"]
    pairs = {
        f"{label}, {column}": tuple(r["summary"][name][column] for r in (record, live.report))
        for name, label in _COMPARED.items()
        for column in ("mean", "median", "max")
    }
    return (
        f"{made}\n\n{side_by_side(pairs)} The record was made at commit "
        f"{str(record['commit'])[:10]}; these weights were trained from commit "
        f"{str(live.trained)[:10]}."
    )


VIEWS = Topic(
    "The test views: Fig. 7",
    (
        Claim(
            "the six hardest test views are registered without obvious deviation",
            "pictures",
            ("vane",),
            _overlays,
            place="Fig. 7",
        ),
    ),
    _views,
)
