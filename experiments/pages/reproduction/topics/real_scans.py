"""Real scans of a depth camera, and how alike virtual ones are."""

from __future__ import annotations

from experiments.pages.reproduction.claim import Claim, Finding, Results, met_if
from experiments.pages.reproduction.live import Live
from experiments.pages.reproduction.topic import Part, Picture, Topic, dated, dated_text
from experiments.studies.real_scans import study as real_scans
from experiments.studies.sensor_fit import study as sensor_fit
from experiments.studies.sensor_transfer import study as sensor_transfer


def _right(results: Results) -> Finding:
    report = results["real_scans"]
    return Finding(
        f"{report['right']} of {report['scans']}, {report['accepted_wrong']} wrong accepted",
        met_if(report["right"] == report["scans"] and not report["accepted_wrong"]),
        f"Right is within {real_scans.RIGHT_DEG:g} deg and {real_scans.RIGHT_MM:g} mm, of a truth "
        f"good to about 1 deg and 2 mm; {report['accepted']} accepted.",
    )


def _likeness(results: Results) -> Finding:
    report = results["sensor_fit"]
    ideal, fitted = (report["virtual"][name]["distance_held_out"] for name in ("ideal", "all"))
    return Finding(
        f"{fitted:.2f}, an ideal camera {ideal:.2f}",
        met_if(fitted <= report["real"]["distance_of_halves"], partly=fitted < ideal),
        f"Mean logarithmic distance of {len(report['real']['statistics'])} statistics, on scans "
        "that the sensor was not fitted to.",
    )


def _halves(results: Results) -> str:
    apart = results["sensor_fit"]["real"]["distance_of_halves"]
    return f"{apart:.2f}, as two halves of the real scans"


def _real_scans(results: Results, _: Live | None) -> list[Part]:
    parts: list[Part] = [
        "Scans of two parts by a depth camera much coarser than the paper's, registered without "
        "training and without guess.",
        dated_text(results, "real_scans", real_scans.table),
        "### How alike virtual and real scans are",
        dated(results, "sensor_fit", sensor_fit.table),
    ]
    if "sensor_fit" in results:
        parts.append(
            Picture(
                "Residuals of two real scans, and of virtual ones of the same pose",
                "Measured minus predicted range of two scans that the sensor was not fitted to.",
                docs="real_scans.png",
                run="sensor_fit/real_scans.png",
            )
        )
    return [
        *parts,
        "### Networks by the sensor of their training",
        dated(results, "sensor_transfer", sensor_transfer.table),
    ]


REAL_SCANS = Topic(
    "Real scans",
    (
        Claim(
            "real depth-camera scans, no training, no guess: right",
            "all, no wrong one accepted",
            ("real_scans",),
            _right,
        ),
        Claim(
            "virtual scans by the fitted sensor are as near to real ones as these are to each "
            "other",
            _halves,
            ("sensor_fit",),
            _likeness,
        ),
    ),
    _real_scans,
)
