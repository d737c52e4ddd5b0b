"""The report: its words are the result's, it asks the network for nothing, and it can be turned."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import html.parser
import json
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from example_registration import NOISE_MM, Registration, example_registration
from headless_browser import CHROMIUM, HeadlessBrowser
from matplotlib.colors import to_rgb
from scipy.spatial.transform import Rotation

from vanejax.cad import Part
from vanejax.errors import InputError
from vanejax.localization import Limits
from vanejax.localization.pose_result import FormDeviation
from vanejax.plotting.canvas import SCAN
from vanejax.report import write_report
from vanejax.report.viewer import MAX_POINTS, simplified, viewer
from vanejax.report.wording import degrees, direction, fixed, millimetres, percent, plus_minus
from vanejax.rigid import RigidTransform
from vanejax.scans import MeasuredScan

EVIL = "</script><script>document.title='owned'</script>\"'><img src=x onerror=alert(1)>&amp;"


class Page(html.parser.HTMLParser):
    """A page's text, its elements with their attributes, and its scripts."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.words: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.code: dict[str, str] = {}
        self._inside = ""
        self.source = path.read_text(encoding="utf-8")
        self.feed(self.source)
        self.text = re.sub(r"\s+", " ", " ".join(self.words))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        self._inside = dict(attrs).get("type") or tag if tag in ("script", "style") else ""

    def handle_endtag(self, tag: str) -> None:
        self._inside = ""

    def handle_data(self, data: str) -> None:
        if self._inside:
            self.code[self._inside] = self.code.get(self._inside, "") + data
        else:
            self.words.append(data)


def write(case: Registration, folder: Path, **options: object) -> Path:
    path = folder / "report.html"
    write_report(path, case.result, case.scan, case.part, **options)
    return path


def numbers(text: str) -> list[float]:
    """All numbers of a text, also with a true minus sign."""
    return [float(n) for n in re.findall(r"-?\d+(?:\.\d+)?", text.replace("−", "-"))]


@pytest.fixture(scope="module")
def reports(tmp_path_factory) -> dict[str, Path]:
    """One of each verdict; the accepted one with the truth."""
    found = {}
    for status in ("accepted", "ambiguous", "rejected"):
        case = example_registration(status)
        options = {"truth": case.truth} if status == "accepted" else {}
        found[status] = write(case, tmp_path_factory.mktemp(status), **options)
    return found


@pytest.fixture(scope="module")
def written(reports) -> Path:
    return reports["ambiguous"]


@pytest.fixture(scope="module")
def evil(tmp_path_factory) -> Path:
    return write(evil_case(), tmp_path_factory.mktemp("evil"))


# ---------------------------------------------------------------- words


def test_the_verdict_comes_first(reports):
    for status, advice in (
        ("accepted", "The scan confirms this pose."),
        ("ambiguous", "Do not machine before it is decided."),
        ("rejected", "Do not use this pose."),
    ):
        page = Page(reports[status])
        title = f"{status.capitalize()}: casting_0417 on guide-vane segment"
        assert page.text.strip().startswith(title)
        assert advice in page.text
        assert f"made up to be {status}" in page.text
        assert ("body", {"class": status}) in page.elements


def test_ambiguous_without_another_pose_does_not_speak_of_one(tmp_path):
    case = example_registration("ambiguous").replace(alternatives=())
    text = Page(write(case, tmp_path)).text
    assert "The scan does not fix the pose well enough." in text
    assert "More than one pose" not in text


def test_every_form_of_the_pose_is_the_pose(written):
    text = Page(written).text
    pose = example_registration().result.part_from_camera
    start = text.index("in mm. ") + 7
    matrix = np.array(numbers(text[start : text.index("Translation, mm")])).reshape(4, 4)
    # 8 digits of the rotation, 4 of the translation
    np.testing.assert_allclose(matrix, pose.as_matrix(), atol=6e-5)
    np.testing.assert_allclose(matrix[:3, :3], pose.rotation, atol=6e-9)
    translation = numbers(text[text.index("Translation, mm") :])[:3]
    np.testing.assert_allclose(translation, pose.translation, atol=6e-5)
    euler = numbers(text[text.index("Euler XYZ") :])[:3]
    turned = Rotation.from_euler("xyz", euler, degrees=True).as_matrix()
    np.testing.assert_allclose(turned, pose.rotation, atol=3e-7)  # 5 digits of a degree
    w, x, y, z = numbers(text[text.index("Quaternion") :])[:4]
    turned = Rotation.from_quat([x, y, z, w]).as_matrix()
    np.testing.assert_allclose(turned, pose.rotation, atol=5e-8)


def test_what_was_found_is_on_the_page(written):
    case = example_registration("ambiguous")
    text = Page(written).text
    for words in (
        "0.0017°", "0.0030 mm", "about the part's z axis", "along the part's y axis",
        "sensor's calibration", percent(case.result.verification.inlier_share),
        f"{len(case.scan.points):,} points", "Unmeasured", "3.1 %", "free-space violation",
        "Another pose that the scan does not rule out", "Turned by 180°, moved by 0.20 mm",
        "95.0 % of the points on the part", "The sensor looks along -z.", "2 points dropped.",
        "search 1.25 s", "all 1.75 s", case.part.sha256, "vanejax", "converged in 7 steps",
        "3.0° and 3.0 mm from the result", f"σ {millimetres(NOISE_MM, 3)}",
    ):  # fmt: skip
        assert words in text, words


def test_the_truth_is_compared_where_it_is_known(reports):
    case = example_registration()
    assert "true pose" not in Page(reports["rejected"]).text
    text = Page(reports["accepted"]).text
    assert "Off by 0.0020° and 0.0050 mm" in text
    # the true pose undoes what was done to it: about y by 0.002 deg, x by 0.003 and z by 0.004 mm
    sigma = np.sqrt(np.diag(case.result.uncertainty.covariance))
    error = np.array([0, np.radians(0.002), 0, 0.003, 0, 0.004])
    found = numbers(text[text.index("6 degrees of freedom") :])[1]
    assert found == pytest.approx(np.sum((error / sigma) ** 2), rel=5e-3)  # three digits
    assert numbers(text[text.index("Rotation error") :])[:3] == [0, -0.002, 0]
    assert numbers(text[text.index("Translation error, mm") :])[:3] == [-0.003, 0, 0.004]


def test_what_is_unknown_is_said_to_be(tmp_path):
    case = example_registration()
    verification = dataclasses.replace(
        case.result.verification, violation_share=np.nan, unmeasured_share=np.nan
    )
    uncertainty = dataclasses.replace(
        case.result.uncertainty,
        rotation_sigma_deg=np.full(3, np.inf),
        covariance=np.full((6, 6), np.nan),
        weakest_rotation_sigma_deg=np.inf,
        weakest_rotation_axis=np.full(3, np.nan),
    )
    case = case.replace(
        verification=verification, uncertainty=uncertainty, sensor_origin=None, notes=()
    )
    case = dataclasses.replace(
        case, scan=dataclasses.replace(case.scan, sensor_origin=None, notes=())
    )
    text = Page(write(case, tmp_path, truth=case.truth)).text
    for words in (
        "place unknown", "The sensor's place is unknown, so its rays are too", "undetermined",
        "no single direction", "Behind it .{0,80} unknown", "Unmeasured .{0,80} unknown",
        "Nothing was assumed, dropped or repaired.", "From the measured side", "nearest surface",
    ):  # fmt: skip
        assert re.search(words, text), words
    assert not re.search(r"\b(nan|inf|None)\b", text)


def test_a_result_with_nothing_in_it_is_reported(tmp_path):
    """Rejected at once: no point checked, no time taken, a guess two metres off, Euler locked."""
    case = example_registration("rejected")
    verification = dataclasses.replace(
        case.result.verification,
        checked=np.zeros(0, np.int64),
        status=np.zeros(0, np.uint8),
        deviation_mm=np.zeros(0),
        inlier_share=0.0,
        tolerance_mm=np.nan,
    )
    locked = RigidTransform(Rotation.from_euler("y", 90, degrees=True).as_matrix(), np.zeros(3))
    far = RigidTransform(np.eye(3), np.array([0.0, 2000.0, 0.0]))
    case = case.replace(verification=verification, part_from_camera=locked, before=far, seconds={})
    text = Page(write(case, tmp_path)).text
    assert "0 points checked" in text
    assert "only the sum or difference" in text


def with_form(form: FormDeviation | None) -> Registration:
    case = example_registration()
    return case.replace(refinement=dataclasses.replace(case.result.refinement, form=form))


def test_the_form_has_a_section_with_figures(tmp_path):
    form = FormDeviation(
        stock_mm=0.5026, stock_sigma_mm=0.0025, scale_error=-0.0101, scale_sigma=0.0001,
        field="facing", field_mm=0.16, field_length_mm=29.0, unexplained_share=0.02,
        beyond_edges_share=0.004, converged=False,
    )  # fmt: skip
    page = Page(write(with_form(form), tmp_path))
    assert ("section", {"class": "card", "id": "form"}) in page.elements
    for words in (
        "0.503 ± 0.003 mm", "1.010 ± 0.010 % smaller", "0.16 mm over 29 mm", "2.0 %", "0.4 %",
        "stock on a few faces", "did not converge",
        "Found: stock 0.503 ± 0.003 mm; the scan is", "Without stock and the difference of size",
        "Each colour is drawn where the sensor should have met the surface of the CAD model.",
    ):  # fmt: skip
        assert words in page.text, words
    images = [a["alt"] or "" for t, a in page.elements if t == "img"]
    assert sum(words.startswith("Signed deviations") for words in images) == 4


@pytest.mark.parametrize(
    ("form", "words"),
    [
        (None, "Nobody asked how the part differs"),
        (FormDeviation(is_told=False), "Too little smooth surface was measured"),
        (FormDeviation(), "Stock no uniform offset that the scan shows none found"),
    ],
)
def test_no_form_is_not_a_form_without_deviation(tmp_path, form, words):
    text = Page(write(with_form(form), tmp_path)).text
    assert words in text
    assert "Found:" not in text
    assert ("as designed" in text) == (form == FormDeviation())


def test_the_bounds_are_beside_what_the_job_needs(tmp_path):
    # sigmas up to 0.0017 deg and 0.003 mm
    limits = Limits(tolerance_deg=0.002, tolerance_mm=0.05)
    text = Page(write(example_registration(), tmp_path, limits=limits)).text
    assert "Rotation 0.0037° 0.0020° no" in text
    assert "Position 0.0066 mm 0.050 mm yes" in text


def test_many_alternatives_have_few_pictures(tmp_path):
    case, count = example_registration("ambiguous"), 9
    other = case.result.alternatives[0]
    page = Page(write(case.replace(alternatives=(other,) * count), tmp_path))
    assert f"Alternative {count}" in page.text
    pictures = [a for t, a in page.elements if t == "img" and "alternative" in (a["alt"] or "")]
    assert len(pictures) == 6


@pytest.mark.parametrize(
    ("shown", "expected"),
    [
        (degrees(0.00312), "0.0031°"), (degrees(9.96), "10°"), (degrees(180.0, 3), "180°"),
        (degrees(float("inf")), "undetermined"), (millimetres(0.0), "0.0 mm"),
        (millimetres(1234.6), "1,200 mm"), (millimetres(1e-9), "below 0.000001 mm"),
        (percent(0.97), "97.0 %"), (percent(1e-5), "< 0.1 %"), (percent(0.99999), "> 99.9 %"),
        (percent(1.0), "100.0 %"), (percent(0.0), "0.0 %"), (percent(float("nan")), "unknown"),
        (fixed(-1.25, 2), "−1.25"), (fixed(-1e-9, 4), "0.0000"),
        (plus_minus(0.502596, 0.002519), "0.503 ± 0.003"), (plus_minus(-1.2, 0.96), "−1.2 ± 1.0"),
        (plus_minus(1.00184, 0.00171), "1.0018 ± 0.0017"), (plus_minus(0.2, 0.0), "0.200"),
        (plus_minus(12.3, 16.0), "12 ± 16"),
        (direction(np.array([0, 0.1, -5.0])), "the part's z axis"),
        (direction(np.array([-1, 0, 1.01])),
         "the direction (−0.70, 0.00, 0.71), between the part's z and −x axes"),
        (direction(np.ones(3)), "the direction (0.58, 0.58, 0.58) of the part's frame"),
        (direction(np.zeros(3)), "no single direction"),
    ],
)  # fmt: skip
def test_numbers_and_directions_in_words(shown, expected):
    assert shown == expected


# ---------------------------------------------------------------- the file


def test_one_file_fetches_nothing(written):
    assert list(written.parent.iterdir()) == [written]
    page = Page(written)
    for tag, attributes in page.elements:
        assert tag not in ("iframe", "object", "embed", "base", "form"), tag
        for name in ("src", "href", "srcset", "data", "action", "poster", "background"):
            value = attributes.get(name)
            assert value is None or value.startswith("data:"), (tag, name, value)
    assert not re.search(r"(https?|wss?|ftp):", page.source, re.I)
    assert "url(" not in page.code["style"]
    assert "@import" not in page.code["style"]


def test_the_policy_allows_this_script_only(written):
    page = Page(written)
    policy = next(a["content"] for t, a in page.elements if "http-equiv" in a)
    digest = base64.b64encode(hashlib.sha256(page.code["script"].encode()).digest()).decode()
    assert "default-src 'none'" in policy
    assert re.search(r"script-src ([^;]*);", policy)[1] == f"'sha256-{digest}'"


def evil_case() -> Registration:
    case = example_registration("ambiguous")
    case = case.replace(notes=(EVIL,), seconds={EVIL: 1.0})
    verdict = dataclasses.replace(case.result.verdict, reason=EVIL)
    return dataclasses.replace(
        case.replace(verdict=verdict),
        scan=dataclasses.replace(case.scan, name=EVIL, notes=(EVIL,)),
        part=Part(case.part.mesh, EVIL, (EVIL,)),
    )


def test_names_and_notes_are_words_not_code(evil, written):
    page, tame = Page(evil), Page(written)
    scripts = [attributes for tag, attributes in page.elements if tag == "script"]
    assert len(scripts) == 2
    assert page.code["script"] == tame.code["script"]
    assert page.text.count(EVIL) >= 5  # title, heading, reason, notes, time, provenance
    assert all(a["src"].startswith("data:") for t, a in page.elements if t == "img")


def test_what_cannot_be_written_is_refused(tmp_path):
    case = example_registration()
    with pytest.raises(InputError, match=r"end in \.html"):
        write_report(tmp_path / "report.pdf", case.result, case.scan, case.part)
    with pytest.raises(InputError, match=r"there is no folder .*no; make it"):
        write_report(tmp_path / "no" / "report.html", case.result, case.scan, case.part)
    short = MeasuredScan(case.scan.points[:10], None, None, name="short")
    with pytest.raises(InputError, match="'short' has 10: it is another scan's result"):
        write_report(tmp_path / "report.html", case.result, short, case.part)
    assert list(tmp_path.iterdir()) == []


# ---------------------------------------------------------------- the view's data


def decoded(text: str, dtype: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype)


def placed(grid: str, matrix: list[float]) -> np.ndarray:
    """What WebGL makes of 16-bit positions and a column-major matrix: points [N, 3]."""
    share = decoded(grid, "<u2").reshape(-1, 3) / 65535
    model = np.reshape(matrix, (4, 4)).T
    return share @ model[:3, :3].T + model[:3, 3]


def test_the_view_shows_the_poses():
    case = example_registration("ambiguous")
    scene = json.loads(viewer(case.result, case.scan, case.part).json)
    assert [p["name"] for p in scene["poses"]] == ["Before", "After", "Alternative 1"]
    assert [p["measured"] for p in scene["poses"]] == [False, True, False]
    wanted = (
        case.result.before,
        case.result.part_from_camera,
        case.result.alternatives[0].part_from_camera,
    )
    step = np.ptp(case.scan.points, axis=0).max() / 65535
    for shown, pose in zip(scene["poses"], wanted, strict=True):
        found = placed(scene["scan"]["points"], shown["model"]) + case.part.center
        # half a step of the grid in each axis
        np.testing.assert_allclose(found, pose.apply(case.scan.points), atol=step)
    vertices = placed(scene["mesh"]["vertices"], scene["mesh"]["model"]) + case.part.center
    np.testing.assert_allclose(vertices, case.part.mesh.vertices, atol=0.002)
    faces = decoded(scene["mesh"]["faces"], "<u2").reshape(-1, 3)
    np.testing.assert_array_equal(faces, case.part.mesh.faces)
    deviation = decoded(scene["scan"]["deviation_um"], "<i2")
    wanted = case.result.verification.deviation_mm
    np.testing.assert_array_equal(deviation == -32768, np.isnan(wanted))
    there = ~np.isnan(wanted)
    np.testing.assert_allclose(deviation[there] / 1000, wanted[there], atol=0.000501)


def test_a_large_scan_is_thinned_with_its_deviations():
    case = example_registration()
    count = 100_000
    points = np.column_stack([np.arange(count) / 1000, np.zeros(count), np.zeros(count)])
    verification = dataclasses.replace(
        case.result.verification,
        checked=np.arange(0, count),
        status=np.zeros(count, np.uint8),
        deviation_mm=points[:, 0] / 10,
    )
    result = dataclasses.replace(case.result, verification=verification)
    shown = viewer(result, MeasuredScan(points, None, np.zeros(3)), case.part)
    assert shown.num_points == MAX_POINTS
    scene = json.loads(shown.json)
    grid = decoded(scene["scan"]["points"], "<u2").reshape(-1, 3)
    # each point has kept its own deviation
    x = grid[:, 0] / 65535 * (count - 1) / 1000
    deviation = decoded(scene["scan"]["deviation_um"], "<i2") / 1000
    np.testing.assert_allclose(deviation, x / 10, atol=0.002)


def test_a_large_part_is_simplified():
    sphere = trimesh.creation.icosphere(subdivisions=6, radius=50.0)  # 40,962 vertices
    vertices, faces, side = simplified(
        np.asarray(sphere.vertices), np.asarray(sphere.faces), max_vertices=5000
    )
    assert 2500 < len(vertices) <= 5000
    # means of points in a cell: inside of it
    assert np.abs(np.linalg.norm(vertices, axis=1) - 50).max() < side
    shown = trimesh.Trimesh(vertices, faces, process=False)
    assert shown.area == pytest.approx(sphere.area, rel=0.03)
    assert (faces[:, 0] != faces[:, 1]).all()
    assert faces.max() < len(vertices)
    same, _, none = simplified(np.asarray(sphere.vertices), np.asarray(sphere.faces))
    assert (len(same), none) == (len(sphere.vertices), 0)


@pytest.mark.slow
def test_a_report_of_a_large_part_stays_small(tmp_path):
    case = example_registration()
    sphere = trimesh.creation.icosphere(subdivisions=7, radius=60.0)  # 163,842 vertices
    path = write(dataclasses.replace(case, part=Part(sphere, "sphere")), tmp_path)
    assert "The part is shown simplified" in Page(path).text
    assert path.stat().st_size < 8e6


# ---------------------------------------------------------------- in a browser


BOX = "(({x, y, width, height}) => ({x: x + scrollX, y: y + scrollY, width, height}))"
CANVAS = f"{BOX}(document.querySelector('canvas').getBoundingClientRect())"
PIXELS = """(() => {
  const gl = document.querySelector('canvas').getContext('webgl2');
  const [w, h] = [gl.drawingBufferWidth, gl.drawingBufferHeight];
  const pixels = new Uint8Array(4 * w * h);
  gl.readPixels(0, 0, w, h, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  const colors = new Set();
  let drawn = 0;
  for (let i = 0; i < pixels.length; i += 4) {
    if (pixels[i + 3]) drawn++;
    colors.add((pixels[i] << 16) + (pixels[i + 1] << 8) + pixels[i + 2]);
  }
  return {share: drawn / (w * h), colors: colors.size, error: gl.getError()};
})()"""


def canvas(browser: HeadlessBrowser) -> np.ndarray:
    """What is seen of the interactive view, [height, width, 3]."""
    browser.settle()
    return browser.screenshot(browser.evaluate(CANVAS))


def changed(one: np.ndarray, other: np.ndarray) -> float:
    """Share of the pixels that differ visibly."""
    return float((np.abs(one - other).max(axis=-1) > 0.1).mean())


def click(browser: HeadlessBrowser, selector: str) -> None:
    browser.evaluate(f"document.querySelector({json.dumps(selector)}).click()")


def middle(browser: HeadlessBrowser) -> tuple[float, float]:
    box = browser.evaluate(CANVAS)
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def test_the_view_is_drawn_without_a_network_or_a_complaint(browser, written):
    browser.open(written)
    assert browser.complaints() == []
    assert browser.requests() == [written.as_uri()]
    assert browser.evaluate("document.body.dataset.viewer") == "ready"
    pixels = browser.evaluate(PIXELS)
    assert pixels["error"] == 0
    assert 0.2 < pixels["share"] < 0.9
    assert pixels["colors"] > 200
    seen = canvas(browser)
    assert len(np.unique(np.round(255 * seen).reshape(-1, 3), axis=0)) > 200
    assert (
        browser.evaluate("getComputedStyle(document.querySelector('.missing')).display") == "none"
    )
    loaded = "[...document.images].every(i => i.complete && i.naturalWidth > 0)"
    assert browser.evaluate(loaded)


@pytest.mark.slow
def test_every_pose_can_be_shown(browser, written):
    browser.open(written)
    after = canvas(browser)
    click(browser, "button[data-pose='0']")
    before = canvas(browser)
    assert browser.evaluate("document.body.dataset.pose") == "Before"
    assert changed(after, before) > 0.05
    scan = np.abs(before - to_rgb(SCAN)).max(axis=-1) < 0.15
    assert scan.mean() > 0.02
    click(browser, "button[data-pose='2']")
    assert changed(canvas(browser), before) > 0.05
    click(browser, "button[data-pose='1']")
    np.testing.assert_array_equal(canvas(browser), after)
    pressed = "[...document.querySelectorAll('[aria-pressed=true]')].map(b => b.textContent)"
    assert browser.evaluate(pressed) == ["After"]


@pytest.mark.slow
def test_part_and_scan_can_be_hidden(browser, written):
    browser.open(written)
    click(browser, "[data-show=showScan]")
    browser.settle()
    only_part = browser.evaluate(PIXELS)["share"]
    click(browser, "[data-show=showPart]")
    browser.settle()
    assert only_part > 0.1
    assert browser.evaluate(PIXELS)["share"] == 0


@pytest.mark.slow
def test_it_turns_zooms_moves_and_comes_back(browser, written):
    browser.open(written)
    start = canvas(browser)
    x, y = middle(browser)
    for button, held, last in (("left", 1, (120, 40)), ("right", 2, (90, -60))):
        browser.mouse("mousePressed", x, y, button=button, buttons=held, clickCount=1)
        browser.mouse("mouseMoved", x + last[0], y + last[1], button=button, buttons=held)
        browser.mouse(
            "mouseReleased", x + last[0], y + last[1], button=button, buttons=0, clickCount=1
        )
        assert changed(start, canvas(browser)) > 0.1, button
        click(browser, "[data-reset]")
        np.testing.assert_array_equal(canvas(browser), start)
    share = browser.evaluate(PIXELS)["share"]
    browser.mouse("mouseWheel", x, y, deltaX=0, deltaY=400)
    browser.settle()
    assert browser.evaluate(PIXELS)["share"] < 0.6 * share
    assert browser.evaluate("scrollY") == 0
    click(browser, "[data-reset]")
    browser.evaluate("document.querySelector('canvas').focus()")
    browser.call("Input.dispatchKeyEvent", type="keyDown", key="ArrowLeft")
    assert changed(start, canvas(browser)) > 0.05


@pytest.mark.slow
def test_fingers_turn_and_pinch(browser, written):
    browser.open(written, width=400)
    browser.evaluate("document.querySelector('canvas').scrollIntoView({block: 'center'})")
    start = canvas(browser)
    share = browser.evaluate(PIXELS)["share"]
    x, y = middle(browser)
    y -= browser.evaluate("scrollY")

    def touch(kind: str, *fingers: tuple[float, float]) -> None:
        points = [{"x": x + dx, "y": y + dy, "id": i} for i, (dx, dy) in enumerate(fingers)]
        browser.call("Input.dispatchTouchEvent", type=kind, touchPoints=points)

    touch("touchStart", (0, 0))
    touch("touchMove", (60, 20))
    touch("touchEnd")
    assert changed(start, canvas(browser)) > 0.1
    click(browser, "[data-reset]")
    touch("touchStart", (-80, 0), (80, 0))
    touch("touchMove", (-30, 0), (30, 0))
    touch("touchEnd")
    browser.settle()
    assert browser.evaluate(PIXELS)["share"] < 0.6 * share


@pytest.mark.slow
def test_a_dot_says_its_deviation(browser, written):
    browser.open(written)
    x, y = middle(browser)
    found = set()
    for dx in range(-60, 61, 12):
        browser.mouse("mouseMoved", x + dx, y)
        found.add(browser.evaluate("document.querySelector('.readout').textContent"))
    values = [text for text in found if re.fullmatch(r"[+−]?\d+\.\d{3} mm", text)]
    assert len(values) >= 3, found
    assert all(abs(numbers(text)[0]) < 1 for text in values)


@pytest.mark.slow
@pytest.mark.parametrize("width", [1280, 400])
def test_nothing_sticks_out(browser, written, width):
    browser.open(written, width=width)
    assert browser.evaluate("document.documentElement.scrollWidth") <= width


@pytest.mark.slow
def test_code_in_names_does_not_run(browser, evil):
    browser.open(evil)
    assert browser.complaints() == []
    assert browser.requests() == [evil.as_uri()]
    assert EVIL in browser.evaluate("document.title")
    assert EVIL in browser.evaluate("document.querySelector('.reason').textContent")


@pytest.mark.slow
def test_without_webgl_the_pictures_remain(written):
    if CHROMIUM is None:
        pytest.skip("no chromium or google-chrome on the PATH")
    with HeadlessBrowser("--disable-3d-apis") as plain:
        plain.open(written)
        assert plain.evaluate("document.body.dataset.viewer") == "unavailable"
        text = plain.evaluate("document.body.innerText")
        assert "This browser shows no interactive 3-D" in text
        assert "Drag to turn" not in text
        box = plain.evaluate(
            f"{BOX}(document.querySelector('.stills img').getBoundingClientRect())"
        )
        assert box["width"] > 200
        assert np.ptp(plain.screenshot(box)) > 0.5
