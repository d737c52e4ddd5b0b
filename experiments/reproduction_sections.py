"""The report's sections: what the studies' own tables and pictures say, beside the paper's claims.

Text is Markdown; one document becomes the HTML page and docs/results.md.
"""

from __future__ import annotations

import dataclasses
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments import (
    ablation_picture,
    ablation_table,
    any_pose,
    comparison_pictures,
    comparison_table,
    density_report,
    fine,
    performance_page,
    position_report,
    public_vs_virtual,
    real_scans,
    robustness_report,
    sensor_fit,
    sensor_transfer,
    verdict_report,
)
from experiments.reproduction_claims import (
    CLAIMS,
    GOALS,
    Claim,
    Results,
    Verdict,
    digits,
    position_errors,
)
from experiments.reproduction_live import Live
from experiments.reproduction_markdown import slug, table
from experiments.reproduction_studies import BY_RECORD, Outcome
from experiments.results_page import text_block, tuning_table, vane_table
from vanejax import plotting

ON_PAGE = 3  # series of robustness side by side: more are too small on paper
LEAST_WIDTH_IN = 9.3  # of their picture, for its legend
SAME = 0.02  # relative: a live figure that differs by less is called the same
PAPER_SERIES = ("distance", "angle", "light")
SIGNS = {
    Verdict.BETTER: "better",
    Verdict.MET: "met",
    Verdict.PARTLY: "partly met",
    Verdict.MISSED: "not met",
    Verdict.INCOMPARABLE: "not comparable",
    Verdict.UNKNOWN: "not measured",
}


@dataclasses.dataclass(frozen=True, eq=False)
class Picture:
    """A figure of the report: drawn from a result, or made by a study.

    Attributes:
      alt: what it shows, for who cannot see it.
      caption: what to look for.
      docs: its name under docs, where the recorded result's picture is.
      run: its path under a run's folder.
      draw: makes it from the results; then no file is needed but for Markdown.
    """

    alt: str
    caption: str
    docs: str = ""
    run: str = ""
    draw: Callable[[], Figure] | None = None


@dataclasses.dataclass(frozen=True)
class Section:
    """A part of the report.

    Attributes:
      name: by which claims refer to it.
      title: heading; its slug is the anchor.
      parts: Markdown and pictures, in order.
    """

    name: str
    title: str
    parts: Sequence[str | Picture]

    @property
    def anchor(self) -> str:
        """Of the heading."""
        return slug(self.title)


TITLES = {
    "scanner": "Virtual scans: Table 2, Algorithm 1, Figs 4 to 6",
    "density": "Metrics and density: Figs 1 and 2",
    "methods": "Every method: Table 1 and Fig. 3",
    "views": "The test views: Fig. 7",
    "public": "Public shapes against virtual scans: Figs 8 and 9",
    "ablations": "Ablations: k and noise",
    "sensing": "Distance, angle, strong light: Figs 10 and 11",
    "position": "Position verification: Figs 12 to 15",
    "bound": "Error against the Cramer-Rao bound",
    "verdict": "Whether the verdict can be trusted",
    "any pose": "From any pose",
    "real scans": "Real scans",
    "clutter": "Clutter, castings, noise, random scans",
    "speed": "Times",
}


def summary(claims: Sequence[Claim], results: Results, *, paper: bool) -> str:
    """The table at the top: claim, the paper's value or the goal, ours, verdict, where."""
    rows = []
    for claim in claims:
        found = claim.finding(results)
        says = f"{claim.place}: {claim.says}" if claim.place else claim.says
        where = f"[{TITLES[claim.section].split(':')[0]}](#{slug(TITLES[claim.section])})"
        verdict = f"**{SIGNS[found.verdict]}**"
        rows.append([says, claim.published(results), found.ours, verdict, where])
    return table(
        ["claim of the paper" if paper else "what", "paper" if paper else "goal", "ours", "verdict",
         "where"],
        rows,
    )  # fmt: skip


def counts(claims: Sequence[Claim], results: Results) -> str:
    """How many claims stand how, in words."""
    found = Counter(claim.finding(results).verdict for claim in claims)
    told = [f"{found[verdict]} {SIGNS[verdict]}" for verdict in Verdict if found[verdict]]
    return f"{len(claims)} in all: {', '.join(told)}"


def judged(name: str, results: Results) -> str:
    """The claims that a section shows the figures of, each with its sentence."""
    rows = []
    claims = [claim for claim in (*CLAIMS, *GOALS) if claim.section == name]
    for claim in claims:
        found = claim.finding(results)
        says = f"{claim.place}: {claim.says}" if claim.place else claim.says
        verdict = f"**{SIGNS[found.verdict]}**"
        rows.append([says, claim.published(results), found.ours, verdict, found.because])
    whose = "paper" if all(claim.place for claim in claims) else "goal"
    return table(["claim", whose, "ours", "verdict", "because"], rows)


def sections(results: Results, live: Live | None = None) -> list[Section]:
    """All sections, those without any result too: they say so."""
    bodies: dict[str, Callable[[Results, Live | None], list[str | Picture]]] = {
        "scanner": _scanner,
        "density": _density,
        "methods": _methods,
        "views": _views,
        "public": _public,
        "ablations": _ablations,
        "sensing": _sensing,
        "position": _position,
        "bound": _bound,
        "verdict": _verdict,
        "any pose": _any_pose,
        "real scans": _real_scans,
        "clutter": _clutter,
        "speed": _speed,
    }
    return [
        Section(name, title, [judged(name, results), *bodies[name](results, live)])
        for name, title in TITLES.items()
    ]


def _dated(results: Results, name: str, body: Callable[[Any], str]) -> str:
    """A record's table with its origin below; a word where it is missing."""
    if name not in results:
        return _missing(name)
    return f"{body(results[name])}\n\n{origin(results, name)}"


def _missing(name: str) -> str:
    study = BY_RECORD[name]
    return f"**Not measured yet:** there is no result {name}. `{study.command()}` makes it."


def origin(results: Results, name: str) -> str:
    """Which record, from where."""
    report = results[name]
    commit = str(report["commit"] or "unknown")[:10]
    return f"Record `{name}.json`: {_machine(report)}; {report['date'][:10]}, commit {commit}."


def _machine(report: Mapping[str, Any]) -> str:
    """What a record was measured on, as far as it says."""
    machine = report.get("machine", {})
    name = machine.get("cpu") or machine.get("processor") or report.get("device") or "unknown"
    cores = machine.get("cores")
    return f"{name}, {cores} core{'s' if cores != 1 else ''}" if cores else str(name)


def _scanner(results: Results, live: Live | None) -> list[str | Picture]:
    parts: list[str | Picture] = [
        "A hemisphere of viewpoints 400 mm around the part's centre, elevations 60 to 85 deg by 5, "
        "azimuths 0 to 350 deg by 10; a pixel is a ray that Embree casts at the CAD model, so what "
        "the part hides from the camera is not in the scan. Azimuths 0, 40, ... 320 deg are for "
        "the test."
    ]
    caption = (
        "What the camera sees (green) and what the part hides from it (red), for the least "
        "visible test view of each elevation."
    )
    parts.append(
        Picture(
            "Six virtual scans of the guide vane in green with the self-occluded surface in red",
            caption + (" Drawn for this page." if live else ""),
            run="vane/view_and_shadow.png",
        )
    )
    if live is None:
        parts.append(
            Picture(
                "The guide vane, a virtual scan with its shadow, and a registration",
                "From CAD model to registration: the part, a scan (green) with what the part hides "
                "(red), and the same scan registered.",
                docs="overview.png",
            )
        )
    if "sensor_effects" in results:
        parts += [
            Picture(
                "Each effect of the virtual sensor alone on the guide vane",
                "Beyond the paper's z-buffer: each effect of the virtual structured-light camera.",
                docs="sensor_effects.png",
                run="sensor_effects/sensor_effects.png",
            ),
            origin(results, "sensor_effects"),
        ]
    return parts


def _density(results: Results, _: Live | None) -> list[str | Picture]:
    if "density" not in results:
        return [_missing("density")]
    sweeps = results["density"]["sweeps"]
    return [
        "Scans lie on samples of the CAD surface at a fixed error of the pose, and the number of "
        "points is varied: a metric that judges the pose alone would draw level lines.",
        Picture(
            "RMSE and FFMDE over the number of CAD points, at fixed pose errors",
            "The paper's Fig. 1 (left) with FFMDE, absolute and as printed, beside it; a row for "
            "each kind of noise.",
            docs="density.png",
            draw=lambda: density_report.picture(sweeps),
        ),
        _in_lines(density_report.verdict(sweeps)),
        text_block("\n\n".join(density_report.table(sweep) for sweep in sweeps)),
        text_block(density_report.LEGEND),
        origin(results, "density"),
    ]


def _in_lines(text: str) -> str:
    """The study's verdict, which is one long paragraph, as a list: a line for each sweep."""
    return "\n".join(f"- {line}" for line in re.split(r" (?=With more |The scan's |So at )", text))


def _methods(results: Results, _: Live | None) -> list[str | Picture]:
    if "comparison" not in results:
        return [_missing("comparison")]
    report = results["comparison"]
    return [
        "The same noisy points of the same views for every method, no initial guess. Refined is "
        "what ray casting makes of the same points from where the method ended.",
        _dated(results, "comparison", comparison_table.table),
        Picture(
            "Share of the test views whose error is below a value, a line for each method",
            "As the method leaves the pose (above) and refined by ray casting (below); the grey "
            "line is what the paper's process needs.",
            docs="comparison_errors.png",
            draw=lambda: comparison_pictures.error_shares(report),
        ),
        Picture(
            "The hardest test view after each method, scan in green, CAD model in red",
            "The paper's Fig. 3: the least visible view after each method.",
            docs="comparison_methods.png",
            run="comparison/methods.png",
        ),
        "### How the classical methods were tuned",
        _dated(results, "tuning", tuning_table),
    ]


def _views(results: Results, live: Live | None) -> list[str | Picture]:
    parts: list[str | Picture] = [
        "RPM-Net alone on views that training never saw, from poses up to 45 deg and half a part "
        "radius away, noise of 0.01 radii on both clouds.",
        _dated(results, "vane", vane_table),
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
    lines = [
        f"The weights ({live.weights}) registered the {live.report['views']} test views again in "
        f"{live.seconds:.0f} s, new scans included ({live.report['date'][:10]}, commit "
        f"{str(live.report['commit'])[:10]}).",
        "",
    ]
    if "vane" not in results:
        return "\n".join([*lines, vane_table(live.report)])
    record = results["vane"]
    labels = {
        "rotation_error_deg": "rotation error (deg)",
        "translation_error_mm": "translation error (mm)",
        "ffmde_abs_mm": "FFMDE, absolute (mm)",
        "rmse_mm": "RMSE (mm)",
    }
    pairs = {
        f"{label}, {column}": tuple(r["summary"][name][column] for r in (record, live.report))
        for name, label in labels.items()
        for column in ("mean", "median", "max")
    }
    told = _side_by_side(pairs)
    told += (
        f" The record was made at commit {str(record['commit'])[:10]}; these weights were trained "
        f"from commit {str(live.trained)[:10]}."
    )
    return "\n".join([*lines, told])


def _side_by_side(pairs: Mapping[str, tuple[float, float]]) -> str:
    """Recorded and live figures, and in a sentence whether they are the same."""
    rows, apart = [], []
    for words, (old, new) in pairs.items():
        change = new / old - 1
        rows.append([words, digits(old, 3), digits(new, 3), f"{change:+.1%}"])
        if abs(change) > SAME:
            apart.append((abs(change), words))
    told = f"All {len(rows)} figures are the recorded ones within {SAME:.0%}."
    if apart:
        size, words = max(apart)
        told = (
            f"{len(apart)} of {len(rows)} figures differ from the record by more than {SAME:.0%}, "
            f"most the {words} ({size:.0%})."
        )
    return table(["", "recorded", "live", "difference"], rows) + "\n\n" + told


def _public(results: Results, _: Live | None) -> list[str | Picture]:
    if "public_vs_virtual" not in results:
        return [_missing("public_vs_virtual")]
    report = results["public_vs_virtual"]

    def picture(views: str) -> Picture:
        return Picture(
            f"Mean errors per axis and per view of both networks, {views} views",
            f"The paper's Figs 8 and 9, {views} views: bars are MRE and MTE per axis (eqs 8, 9), "
            "lines the means over the axes of each view (eqs 10, 11).",
            docs=f"public_axis_errors_{views}.png",
            draw=lambda: _axis_errors(report, views),
        )

    return [
        "The same network, loss, optimizer and number of steps; only what is seen in training "
        "differs.",
        _dated(results, "public_vs_virtual", public_vs_virtual.table),
        picture("hardest"),
        picture("all"),
    ]


def _axis_errors(report: Mapping[str, Any], views: str) -> Figure:
    """Figs 8 and 9 of a record, which holds the errors' means only.

    The picture shows the means over views and over axes of errors [V, 3]; the product of both over
    the mean of all is such errors.
    """
    series = {}
    for source in (public_vs_virtual.PUBLIC, public_vs_virtual.VIRTUAL):
        found = report[f"{views}_views"][source]
        both = [
            (np.array(found[f"{name}_per_view_{unit}"]), np.array(found[f"{name}_per_axis_{unit}"]))
            for name, unit in (("mre", "deg"), ("mte", "mm"))
        ]
        errors = [np.outer(rows, columns) / columns.mean() for rows, columns in both]
        title = report["trained_on"][source]["title"]
        series[title] = plotting.AxisErrors(rotation_deg=errors[0], translation_mm=errors[1])
    return plotting.axis_errors(series)


def _ablations(results: Results, _: Live | None) -> list[str | Picture]:
    parts: list[str | Picture] = []
    for name, title in (
        ("ablation_neighbors", "Neighbours k"),
        ("ablation_noise", "Noise of training"),
    ):
        parts.append(f"### {title}")
        parts.append(_dated(results, name, lambda r: text_block(ablation_table.table(r))))
        if name in results:
            parts.append(
                Picture(
                    f"Mean errors over the swept value: {title}",
                    f"{title}: mean errors over the test views.",
                    docs=f"{name}.png",
                    draw=lambda report=results[name]: ablation_picture.picture(report),
                )
            )
    return parts


def _sensing(results: Results, _: Live | None) -> list[str | Picture]:
    if "robustness" not in results:
        return [_missing("robustness")]
    report = _only(results["robustness"], PAPER_SERIES)
    return [
        "The paper turned and moved a real camera above a real vane; here a virtual "
        f"structured-light camera ({report['sensor']}) with shadow, dropout, calibration errors "
        "and noise does. FFMDE and RMSE have a floor, printed beside them: what they are at the "
        "true pose.",
        Picture(
            "Errors, FFMDE and RMSE over distance, angle and saturated pixels",
            "The paper's Fig. 11: each network alone (dashed), refined (full), at the true pose "
            "(dotted); the paper's mean in grey.",
            docs="robustness.png",
            draw=lambda: robustness_report.picture(report),
        ),
        robustness_report.markdown(report),
        origin(results, "robustness"),
    ]


def _only(report: Mapping[str, Any], names: Sequence[str]) -> Mapping[str, Any]:
    """A record of robustness with these series alone."""
    return {**report, "series": [s for s in report["series"] if s["name"] in names]}


def _position(results: Results, live: Live | None) -> list[str | Picture]:
    parts: list[str | Picture] = [
        "A stage turns the vane about its R axis and moves it along X, Y and Z; each position is "
        "scanned by a virtual camera with its own errors of calibration and registered, and the "
        "motion T2 T1^-1 is compared with the stage's or with that of a probe, whose frame a "
        "scanned and touched cube joins to the camera's."
    ]
    if "position" not in results:
        return [*parts, _missing("position")]
    report = results["position"]
    if live is not None and live.position is not None:
        parts.append(_position_against_record(report, live.position))
    return [
        *parts,
        Picture(
            "Errors of the recognised turns and moves over the positions of the stage",
            "The paper's Fig. 15 again: errors of the turns about R and of the moves.",
            docs="position.png",
            draw=lambda: position_report.picture(report),
        ),
        position_report.table(report),
        origin(results, "position"),
    ]


def _position_against_record(report: Mapping[str, Any], live: Mapping[str, Any]) -> str:
    """Whether the stand that was run for the page found what the record says."""
    if report is live:
        return "There is no record of this study; it was run for this page."
    old, new = (position_errors(one) for one in (report, live))
    pairs = {
        f"{words}, {column}": (old[name][column], new[name][column])
        for name, words in (("turns", "rotation (deg)"), ("moves", "translation (mm)"))
        for column in ("mean", "max")
    }
    return "The stand was run again for this page.\n\n" + _side_by_side(pairs)


def _bound(results: Results, _: Live | None) -> list[str | Picture]:
    if "fine" not in results:
        return [_missing("fine")]
    levels = results["fine"]["levels"]
    return [
        "The paper asks how far a registration is off; the bound says how far the best possible "
        "one would be, from the same rays and noise. Full scans with white noise along the rays, "
        "started 5 deg and 5 mm off.",
        Picture(
            "Errors over noise with the Cramer-Rao bound, and how often the ellipsoid holds",
            "Errors of every view (grey), their rms (blue) on the bound (black), the paper's mean "
            "errors (red dashes); right: truth inside the reported 95 % ellipsoid.",
            run="fine/fine.png",
            draw=lambda: fine.picture(levels),
        ),
        _dated(results, "fine", lambda report: text_block(fine.table(report["levels"]))),
    ]


def _verdict(results: Results, _: Live | None) -> list[str | Picture]:
    if "verdicts" not in results:
        return [_missing("verdicts")]
    report = {"judged": [], **results["verdicts"]}
    parts: list[str | Picture] = [
        "Poses that a registration might end in, right and wrong, of many parts under virtual "
        "sensors, each judged as `register` judges its own. AUC: the chance that a right pose "
        "scores above a wrong one.",
        text_block(verdict_report.table(report)),
        origin(results, "verdicts"),
    ]
    if report["judged"]:
        parts.insert(
            1,
            Picture(
                "ROC curves, and verdicts by kind of pose",
                "Right against wrong poses by each figure alone; verdicts by kind of pose.",
                draw=lambda: verdict_report.picture(report),
            ),
        )
    return parts


def _any_pose(results: Results, _: Live | None) -> list[str | Picture]:
    return [
        "`register` without a guess, on scans turned to uniformly random rotations.",
        _dated(results, "any_pose", lambda report: text_block(any_pose.table(report))),
    ]


def _real_scans(results: Results, _: Live | None) -> list[str | Picture]:
    parts: list[str | Picture] = [
        "Scans of two parts by a depth camera much coarser than the paper's, registered without "
        "training and without guess.",
        _dated(results, "real_scans", lambda report: text_block(real_scans.table(report))),
        "### How alike virtual and real scans are",
        _dated(results, "sensor_fit", sensor_fit.table),
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
    parts += [
        "### Networks by the sensor of their training",
        _dated(results, "sensor_transfer", sensor_transfer.table),
    ]
    return parts


def _clutter(results: Results, _: Live | None) -> list[str | Picture]:
    if "robustness" not in results:
        return [_missing("robustness")]
    names = [s["name"] for s in results["robustness"]["series"] if s["name"] not in PAPER_SERIES]
    parts: list[str | Picture] = []
    first = len(names) % ON_PAGE  # the few come first: castings stand beside castings
    for start in ([0] if first else []) + list(range(first, len(names), ON_PAGE)):
        shown = names[start : first if start < first else start + ON_PAGE]
        report = _only(results["robustness"], shown)
        words = "; ".join(series["title"].lower() for series in report["series"])
        parts.append(
            Picture(
                f"Errors, FFMDE and RMSE over {words}",
                f"Drawn as Fig. 11, each network alone (dashed) and refined (full): {words}.",
                draw=lambda report=report: _wide_enough(robustness_report.picture(report)),
            )
        )
    parts.append(robustness_report.markdown(_only(results["robustness"], names)))
    if results["robustness"]["random"]:
        parts.append(robustness_report.random_lines(results["robustness"]["random"]))
    return [*parts, origin(results, "robustness")]


def _wide_enough(figure: Figure) -> Figure:
    """A picture of few series, with room for the legend."""
    width, height = figure.get_size_inches()
    figure.set_size_inches(max(width, LEAST_WIDTH_IN), height)
    return figure


def _speed(results: Results, _: Live | None) -> list[str | Picture]:
    for name in performance_page.NAMES:
        if name not in results:
            return [_missing(name)]
    return [performance_page.figures(*(results[name] for name in performance_page.NAMES))]


def provenance(results: Results) -> str:
    """Where every number comes from: record, date, commit, machine, seed, command."""
    rows = []
    for name, report in results.items():
        config = report.get("config", {})
        seed = report.get("seed", report.get("seeds", config.get("seed", "–")))
        rows.append(
            [
                f"`{name}.json`",
                str(report["date"])[:10],
                f"`{str(report['commit'] or 'unknown')[:11]}`",
                _machine(report),
                ", ".join(map(str, seed)) if isinstance(seed, list) else str(seed),
                f"`{BY_RECORD[name].command()}`",
            ]
        )
    return table(["record", "date", "commit", "machine", "seed", "command"], rows)


def outcomes_table(outcomes: Sequence[Outcome]) -> str:
    """What became of the studies of a run."""
    rows = [
        [o.study.name, o.study.title, f"**{o.state}**" if not o.ended else o.state, o.why,
         f"{o.seconds / 60:.1f}"]
        for o in outcomes
    ]  # fmt: skip
    return table(["study", "finds", "state", "why", "minutes"], rows)


def picture_file(picture: Picture, *, docs: Path | None, run: Path | None) -> Path | None:
    """The file of a picture that is not drawn: the run's, or the recorded one; None if neither."""
    for folder, name in ((run, picture.run), (docs, picture.docs)):
        if folder is not None and name and (folder / name).is_file():
            return folder / name
    return None
