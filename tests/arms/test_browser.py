"""The report as a browser shows it: nothing asked of the network, no error on its console, every picture there."""

import contextlib
import io
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from surgsim_apps.arms.pictures import ArmMaps, write_picture
from surgsim_apps.arms.ranking import rank
from surgsim_apps.arms.report import write_report
from surgsim_apps.reports.html_page import POLICY
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
    others = [("ports.toml", "as given", evaluation), ("wide.toml", "ports", made_evaluation(seed=1))]
    path = folder / "report.html"
    write_report(
        evaluation,
        path,
        pictures=[write_picture(evaluation.picture, folder / "arms.png")],
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
    assert f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">' in text
    browser = shown(report, width)
    made = browser.run(MADE)
    assert browser.complaints() == []
    assert len(made["images"]) == text.count("<img") == 11
    assert min(made["images"]) >= 60
    assert made["widest"] <= made["window"] == width
    assert made["loaded"] == 0


def test_it_prints(report, shown):
    browser = shown(report)
    data = browser.printed()
    assert browser.complaints() == []
    assert data.startswith(b"%PDF") and len(data) > 100_000
