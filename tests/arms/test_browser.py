"""The report as a browser shows it: nothing asked of the network, no error on its console, every picture there."""

import contextlib
import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from surgsim_apps.arms.pictures import ArmMaps
from surgsim_apps.arms.ranking import rank
from surgsim_apps.arms.report import write_report
from surgsim_apps.reports.html_page import POLICY, SCENE_POLICY
from surgsim_apps.reports.surface_drawing import OrthographicView
from surgsim_apps.reports.turning_scene import SolidPart, turning_scene
from tests.arms.made import made_evaluation
from tests.chromium import Browser

# Measured in the page: the widths of its pictures, its width and that of the window, the addresses it has fetched.
MADE = """({
  images: [...document.images].map(one => one.complete ? one.naturalWidth : 0),
  widest: document.documentElement.scrollWidth, window: innerWidth,
  loaded: performance.getEntriesByType("resource").filter(one => !one.name.startsWith("data:")).length,
})"""


@pytest.fixture
def shown(chromium):
    """A function that opens a page in a window of some size [pixels]."""
    with contextlib.ExitStack() as stack:

        def show(page: Path, width: int = 1280, height: int = 900) -> Browser:
            browser = stack.enter_context(chromium.page(width, height))
            browser.open(page.as_uri())
            browser.wait_for_page()
            return browser

        yield show


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    evaluation = made_evaluation()
    part = SolidPart("organ", evaluation.surface_points, evaluation.surface_triangles, "#0000ff")
    view = OrthographicView.along(np.array([0.0, 1.0, 0.0]))
    evaluation = replace(evaluation, turning=turning_scene([part], view, "An organ.", [("organ", "#0000ff")]))
    others = [("ports.toml", "as given", evaluation), ("wide.toml", "ports", made_evaluation(seed=1))]
    path = folder / "report.html"
    write_report(
        evaluation,
        path,
        maps=ArmMaps(evaluation).write_all(folder),
        command="surgsim arms --scene liver --left psm_grasper --right psm_palpator --ports ports.toml",
        ranking=rank(others),
    )
    return path


def test_the_report_opens_without_an_error(report, shown):
    browser = shown(report, 1280, 2400)
    image = imread(io.BytesIO(browser.shot()))[:, :, :3]
    assert browser.complaints() == []
    # Dark text and the maps' colours on white, down to the foot of the window.
    assert (image == 1.0).all(axis=2).mean() > 0.4
    for part in np.split(image, 4):
        assert len(np.unique((part * 255).astype(np.uint8).reshape(-1, 3), axis=0)) > 200
    assert (image.max(axis=2) < 0.25).mean() > 0.003


def test_a_page_with_a_fault_is_noticed(report, tmp_path, shown):
    """That the console is read at all: a picture from the network is refused by the page's own policy, and said."""
    faulty = tmp_path / "faulty.html"
    faulty.write_text(
        report.read_text(encoding="utf-8").replace("</main>", '<img src="http://example.org/a.png"></main>')
    )
    assert any("Content Security Policy" in line for line in shown(faulty).complaints())


@pytest.mark.parametrize("width", [1280, 500])
def test_every_picture_is_decoded_and_nothing_is_wider_than_the_window(report, shown, width):
    text = report.read_text(encoding="utf-8")
    assert f'<meta http-equiv="Content-Security-Policy" content="{POLICY}{SCENE_POLICY}">' in text
    browser = shown(report, width)
    made = browser.run(MADE)
    assert browser.complaints() == []
    assert len(made["images"]) == text.count("<img") == 10
    assert min(made["images"]) >= 60
    assert made["widest"] <= made["window"] == width
    assert made["loaded"] == 0


def test_the_scene_turns(report, shown):
    """It is drawn, by the page's one script, and again from another side after a drag."""
    browser = shown(report, 1280, 1600)
    box = browser.run(
        "(() => { const r = document.querySelector('iframe').getBoundingClientRect();"
        " return [r.x + r.width / 2, r.y + r.height / 2]; })()"
    )

    def blue():
        image = imread(io.BytesIO(browser.shot()))
        return image[:, :, 2] > image[:, :, 0] + 0.3

    browser.wait_until(lambda: blue().sum() > 20_000)
    before = blue()
    browser.drag(tuple(box), (box[0] + 120.0, box[1] + 60.0), lambda: (blue() != before).sum() > 2000)
    assert browser.complaints() == []


def test_it_prints(report, shown):
    browser = shown(report)
    data = browser.printed()
    assert browser.complaints() == []
    assert data.startswith(b"%PDF") and len(data) > 100_000
