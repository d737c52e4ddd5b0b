"""The view of notebooks: it shows what it was given, can be played, and fetches nothing."""

from __future__ import annotations

import base64
import html
import json
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from example_registration import example_registration
from headless_browser import CHROMIUM, HeadlessBrowser
from scipy.spatial.transform import Rotation

from vanejax.cad.parametric_vane import guide_vane
from vanejax.errors import InputError
from vanejax.plotting.clouds import seen_and_hidden
from vanejax.report.view3d import View3d, motion_view, pose_view, scan_view
from vanejax.rigid import RigidTransform
from vanejax.scanner.camera import Camera, hemisphere_viewpoints
from vanejax.scanner.ideal_scan import Scan
from vanejax.scanner.virtual_scanner import Scanner

PART = guide_vane()
VIEW = hemisphere_viewpoints(PART.center).view(53)
NAMES = ["start <b>", "after iteration 1", "after iteration 2"]


@pytest.fixture(scope="module")
def scan() -> Scan:
    return Scanner(PART, surface_samples=4000).scan(Camera().scaled(0.25), VIEW, hidden=True)


def poses() -> list[RigidTransform]:
    """From 40 deg and 30 mm off to the true pose, camera frame to part frame."""
    true = VIEW.inverse()
    about = RigidTransform(np.eye(3), -PART.center)
    found = []
    for share in (1.0, 0.1, 0.0):
        turn = Rotation.from_rotvec(share * np.radians(40) * np.array([0.0, 0.6, 0.8])).as_matrix()
        move = RigidTransform(turn, share * np.array([0.0, -30.0, 0.0]))
        found.append(about.inverse() @ move @ about @ true)
    return found


@pytest.fixture(scope="module")
def film(scan: Scan) -> View3d:
    return motion_view(scan.points[::4], poses(), NAMES, PART, camera_from_part=VIEW)


def scene(view: View3d) -> dict:
    return json.loads(re.search(r'<script type="application/json".*?>(.*?)</script>', view.page)[1])


def placed(grid: str, matrix: list[float]) -> np.ndarray:
    """What WebGL makes of 16-bit positions and a column-major matrix: points [N, 3]."""
    share = np.frombuffer(base64.b64decode(grid), "<u2").reshape(-1, 3) / 65535
    model = np.reshape(matrix, (4, 4)).T
    return share @ model[:3, :3].T + model[:3, 3]


# ---------------------------------------------------------------- the data


def test_seen_is_green_and_hidden_is_red(scan):
    shown = scene(scan_view(scan, PART, voxel_mm=2.0))
    seen, hidden = seen_and_hidden(scan, voxel_mm=2.0)
    code = np.frombuffer(base64.b64decode(shown["scan"]["deviation_um"]), "<i2")
    found = placed(shown["scan"]["points"], shown["poses"][1]["model"]) + PART.center
    # half a step of the grid of 65,535 over at most 130 mm
    np.testing.assert_allclose(found[code < 0], seen, atol=0.002)
    np.testing.assert_allclose(found[code > 0], hidden, atol=0.002)
    table = np.frombuffer(base64.b64decode(shown["colors"]), "u1").reshape(256, 4)
    assert table[0, 1] > table[0, 0] + 100  # green
    assert table[-1, 0] > table[-1, 1] + 100  # red


def test_a_film_goes_through_the_poses(film, scan):
    shown = scene(film)
    stops = [int(s) for s in re.search(r'data-stops="(.*?)"', film.page)[1].split()]
    assert stops[0] == 0
    assert stops[-1] == len(shown["poses"]) - 1
    points = scan.points[::4].astype(np.float64)
    for stop, pose in zip(stops, poses(), strict=True):
        found = placed(shown["scan"]["points"], shown["poses"][stop]["model"]) + PART.center
        np.testing.assert_allclose(found, pose.apply(points), atol=0.004)  # a step of the grid


def test_between_two_poses_the_centre_goes_straight_and_nothing_is_bent(film, scan):
    shown = scene(film)
    frames = [placed(shown["scan"]["points"], pose["model"]) for pose in shown["poses"][:13]]
    centers = np.stack([frame.mean(axis=0) for frame in frames])
    steps = np.diff(centers, axis=0)
    np.testing.assert_allclose(steps, np.tile(steps[0], (12, 1)), atol=2e-3)
    size = [np.linalg.norm(frame - frame.mean(axis=0)) for frame in frames]
    np.testing.assert_allclose(size, size[0], rtol=1e-4)


def test_no_pose_leaves_the_picture(film, scan):
    shown = scene(film)
    reader = np.reshape(shown["view"], (4, 4)).T[:3, :3]
    for pose in shown["poses"]:
        seen = placed(shown["scan"]["points"], pose["model"]) @ reader.T
        assert (np.abs(seen).max(axis=0) <= np.array(shown["half_mm"]) + 5).all()  # some were asked


def test_a_result_is_shown_as_in_the_report():
    case = example_registration("ambiguous")
    page = pose_view(case.result, case.scan, case.part).page
    assert re.findall(r'data-pose="\d" aria-pressed="(\w+)">(.*?)<', page) == [
        ("false", "Before"),
        ("true", "After"),
        ("false", "Alternative 1"),
    ]
    assert "no partner on the part" in page
    assert "outside the material" in page


# ---------------------------------------------------------------- the page


def test_a_notebook_shows_a_frame_that_may_run_scripts_only(film):
    shown = film._repr_html_()
    assert shown.startswith("<iframe")
    assert 'sandbox="allow-scripts"' in shown
    inside = re.search(r'srcdoc="(.*?)" sandbox', shown, re.S)[1]
    assert html.unescape(inside) == film.page
    assert "start &lt;b&gt;" in film.page
    assert "<b>" not in film.page


def test_the_page_names_no_other_place(film, scan):
    for view in (film, scan_view(scan, PART)):
        assert not re.search(r"(https?|wss?):|(src|href)=\"(?!data:)|url\(|@import", view.page)
        assert "default-src 'none'" in view.page


def test_it_is_written_whole(film, tmp_path):
    film.save(tmp_path / "film.html")
    assert (tmp_path / "film.html").read_text(encoding="utf-8") == film.page
    assert [p.name for p in tmp_path.iterdir()] == ["film.html"]
    with pytest.raises(InputError, match=r"film\.png: the view is an HTML page"):
        film.save(tmp_path / "film.png")


def test_what_cannot_be_shown_is_refused(scan):
    points, true = scan.points[:50], VIEW.inverse()
    broken = RigidTransform(np.full((3, 3), np.nan), np.zeros(3))
    for arguments, words in (
        ((points, [true], ["one"]), "1 poses with 1 names; a film needs two"),
        ((points, [true, true], ["one"]), "2 poses with 1 names"),
        ((points, [true, broken], ["one", "two"]), "not finite"),
        ((points[:, :2], [true, true], ["one", "two"]), r"shape \(50, 2\)"),
    ):
        with pytest.raises(InputError, match=words):
            motion_view(*arguments, PART, camera_from_part=VIEW)
    with pytest.raises(InputError, match=r"voxel_mm=0.0 should be positive"):
        scan_view(scan, PART, voxel_mm=0.0)


# ---------------------------------------------------------------- in a browser


@pytest.fixture(scope="module")
def browser() -> Iterator[HeadlessBrowser]:
    if CHROMIUM is None:
        pytest.skip("no chromium or google-chrome on the PATH")
    with HeadlessBrowser() as running:
        yield running


def opened(browser: HeadlessBrowser, view: View3d, folder: Path) -> np.ndarray:
    """The page as it first appears, after checks that hold for every view."""
    path = folder / "view.html"
    view.save(path)
    browser.open(path, width=900, height=560)
    assert browser.complaints() == []
    assert browser.requests() == [path.as_uri()]
    assert browser.evaluate("document.body.dataset.viewer") == "ready"
    return shot(browser)


def shot(browser: HeadlessBrowser) -> np.ndarray:
    browser.settle()
    return browser.screenshot({"x": 0, "y": 0, "width": 900, "height": 560})


def share(pixels: np.ndarray, channel: int) -> float:
    """Share of pixels [H, W, 3] in which one of red and green is much the strongest."""
    others = np.delete(pixels, channel, axis=-1).max(axis=-1)
    return float((pixels[..., channel] > others + 0.3).mean())


def test_a_scan_is_drawn_in_both_colours(browser, scan, tmp_path):
    seen = opened(browser, scan_view(scan, PART), tmp_path)
    assert share(seen, 1) > 0.01
    assert share(seen, 0) > 0.002
    browser.evaluate("document.querySelector('canvas').focus()")
    for _ in range(12):
        event = "new KeyboardEvent('keydown', {key: 'ArrowLeft'})"
        browser.evaluate(f"document.querySelector('canvas').dispatchEvent({event})")
    # from behind there is more shadow
    assert share(shot(browser), 0) > 1.5 * share(seen, 0)


def test_a_film_is_played_to_its_end(browser, film, tmp_path):
    start = opened(browser, film, tmp_path)
    caption = "document.querySelector('.film output').textContent"
    assert browser.evaluate(caption) == NAMES[0]
    browser.evaluate("document.querySelector('[data-play]').click()")
    done = (
        "new Promise(r => { const t = setInterval(() => { const s = document.querySelector("
        "'.film input'); if (s.value === s.max) { clearInterval(t); r(true); } }, 20); })"
    )
    assert browser.evaluate(done)
    assert browser.evaluate(caption) == NAMES[-1]
    assert browser.evaluate("document.querySelector('[data-play]').textContent") == "Play"
    end = shot(browser)
    moved = np.abs(end[:430] - start[:430]).max(axis=-1) > 0.1
    assert moved.mean() > 0.005


def test_the_slider_chooses_the_frame(browser, film, tmp_path):
    opened(browser, film, tmp_path)
    browser.evaluate(
        "(() => { const s = document.querySelector('.film input'); s.value = 12;"
        " s.dispatchEvent(new Event('input')); })()"
    )
    browser.settle()
    assert browser.evaluate("document.body.dataset.pose") == "12"
    assert browser.evaluate("document.querySelector('.film output').textContent") == NAMES[1]


def test_a_frame_in_a_page_is_drawn_too(browser, film, tmp_path):
    """As in a notebook: sandboxed, from srcdoc, and without a request."""
    alone = opened(browser, film, tmp_path)
    assert share(alone, 1) > 0.002
    path = tmp_path / "notebook.html"
    frame = film._repr_html_()
    path.write_text(f"<!doctype html><link rel=icon href='data:,'><body style='margin:0'>{frame}")
    browser.open(path, width=900, height=560)
    for _ in range(100):  # the frame loads on its own
        difference = np.abs(shot(browser) - alone).max(axis=-1) > 0.1
        if difference.mean() < 1e-3:
            break
    assert difference.mean() < 1e-3
    assert browser.requests() == [path.as_uri()]
    assert browser.complaints() == []
