"""The view of notebooks: it shows what it was given and fetches nothing."""

from __future__ import annotations

import html
import json
import re
import time
from pathlib import Path

import numpy as np
import pytest
from example_registration import example_registration
from headless_browser import HeadlessBrowser
from matplotlib.colors import to_rgb
from test_report import decoded, placed

from vanejax.cad import guide_vane
from vanejax.errors import InputError
from vanejax.plotting.canvas import HIDDEN, SCAN
from vanejax.plotting.clouds import seen_and_hidden
from vanejax.report import View3d, pose_view, scan_view
from vanejax.scanner import Camera, Scan, Scanner, hemisphere_viewpoints

PART = guide_vane()
VIEW = hemisphere_viewpoints(PART.center).view(53)


@pytest.fixture(scope="module")
def scan() -> Scan:
    return Scanner(PART, surface_samples=4000).scan(Camera().scaled(0.25), VIEW, hidden=True)


@pytest.fixture(scope="module")
def view(scan: Scan) -> View3d:
    return scan_view(scan, PART)


def scene(view: View3d) -> dict:
    return json.loads(re.search(r'<script type="application/json".*?>(.*?)</script>', view.page)[1])


# ---------------------------------------------------------------- the data


def test_seen_and_hidden_points_have_their_colours(scan):
    shown = scene(scan_view(scan, PART, voxel_mm=2.0))
    seen, hidden = seen_and_hidden(scan, voxel_mm=2.0)
    code = decoded(shown["scan"]["deviation_um"], "<i2")
    found = placed(shown["scan"]["points"], shown["poses"][1]["model"]) + PART.center
    # half a step of the grid of 65,535 over at most 130 mm
    np.testing.assert_allclose(found[code < 0], seen, atol=0.002)
    np.testing.assert_allclose(found[code > 0], hidden, atol=0.002)
    table = decoded(shown["colors"], "u1").reshape(256, 4)
    np.testing.assert_allclose(table[[0, -1], :3] / 255, [to_rgb(SCAN), to_rgb(HIDDEN)], atol=2e-3)


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


def test_a_notebook_shows_a_frame_that_may_run_scripts_only(view):
    shown = view._repr_html_()
    assert shown.startswith("<iframe")
    assert 'sandbox="allow-scripts"' in shown
    inside = re.search(r'srcdoc="(.*?)" sandbox', shown, re.S)[1]
    assert html.unescape(inside) == view.page


def test_the_page_names_no_other_place(view):
    assert not re.search(r"(https?|wss?):|(src|href)=\"(?!data:)|url\(|@import", view.page)
    assert "default-src 'none'" in view.page


def test_it_is_written_whole(view, tmp_path):
    view.save(tmp_path / "view.html")
    assert (tmp_path / "view.html").read_text(encoding="utf-8") == view.page
    assert [p.name for p in tmp_path.iterdir()] == ["view.html"]
    with pytest.raises(InputError, match=r"view\.png: the view is an HTML page"):
        view.save(tmp_path / "view.png")
    with pytest.raises(InputError, match=r"voxel_mm=0.0 should be positive"):
        scan_view(None, PART, voxel_mm=0.0)


# ---------------------------------------------------------------- in a browser


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


def share(pixels: np.ndarray, color: str) -> float:
    """Share of pixels [H, W, 3] that have nearly this colour."""
    return float((np.abs(pixels - to_rgb(color)).max(axis=-1) < 0.15).mean())


@pytest.mark.slow
def test_a_scan_is_drawn_in_both_colours(browser, view, tmp_path):
    seen = opened(browser, view, tmp_path)
    assert share(seen, SCAN) > 0.01
    assert share(seen, HIDDEN) > 0.002
    browser.evaluate("document.querySelector('canvas').focus()")
    for _ in range(12):
        event = "new KeyboardEvent('keydown', {key: 'ArrowLeft'})"
        browser.evaluate(f"document.querySelector('canvas').dispatchEvent({event})")
    # from behind there is more shadow
    assert share(shot(browser), HIDDEN) > 1.5 * share(seen, HIDDEN)


@pytest.mark.slow
def test_a_view_that_changes_its_size_still_fits(browser, view, tmp_path):
    """A frame may be loaded before it has its size."""
    alone = opened(browser, view, tmp_path)
    browser.evaluate("document.querySelector('canvas').style.width = '60px'")
    browser.settle()
    browser.evaluate("document.querySelector('button[data-reset]').click()")
    assert np.abs(shot(browser) - alone).max() > 0.1
    browser.evaluate("document.querySelector('canvas').style.width = ''")
    np.testing.assert_allclose(shot(browser), alone, atol=0.02)


@pytest.mark.slow
def test_a_frame_in_a_page_is_drawn_too(browser, view, tmp_path):
    """As in a notebook: sandboxed, from srcdoc, and without a request."""
    alone = opened(browser, view, tmp_path)
    path = tmp_path / "notebook.html"
    frame = view._repr_html_()
    path.write_text(f"<!doctype html><link rel=icon href='data:,'><body style='margin:0'>{frame}")
    browser.open(path, width=900, height=560)
    for _ in range(100):  # the frame loads on its own, slowly where the machine is busy
        time.sleep(0.1)
        difference = np.abs(shot(browser) - alone).max(axis=-1) > 0.1
        if difference.mean() < 1e-3:
            break
    assert difference.mean() < 1e-3
    assert browser.requests() == [path.as_uri()]
    assert browser.complaints() == []
