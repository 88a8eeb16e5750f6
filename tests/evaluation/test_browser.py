"""The report as a browser shows it: nothing asked of the network, no error on its console, every picture there."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from surgsim_env.evaluation.arm_maps import ArmMaps
from surgsim_env.evaluation.arm_picture import write_given_pictures
from surgsim_env.evaluation.arm_report import POLICY, write_report
from surgsim_env.evaluation.arm_table import Candidate, rank
from tests.evaluation.made import made_episodes, made_evaluation

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt-get install chromium (.ci/run does)")
# Puts into the page's title what the browser made of it. Only in a copy: the report itself has no script.
PROBE = """<script>addEventListener("load", () => {
const images = [...document.images].map(one => `${one.complete && one.naturalWidth}`).join(" ");
document.title = `images ${images} widest ${document.documentElement.scrollWidth} of ${innerWidth} `
  + `loaded ${performance.getEntriesByType("resource").filter(one => !one.name.startsWith("data:")).length}`;
});</script>"""


def browse(page: Path, folder: Path, *options: str) -> subprocess.CompletedProcess:
    assert CHROMIUM is not None
    return subprocess.run(
        [
            *(CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars"),
            *("--disable-background-networking", "--no-first-run", f"--user-data-dir={folder / 'profile'}"),
            *("--enable-logging=stderr", "--host-resolver-rules=MAP * ~NOTFOUND", *options, page.as_uri()),
        ],
        capture_output=True,
        text=True,
        timeout=180,
    )


def console(done: subprocess.CompletedProcess) -> list[str]:
    """What the page, or the browser about the page, wrote to the console."""
    return [line for line in done.stderr.splitlines() if "CONSOLE" in line]


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    evaluation = made_evaluation()
    others = [Candidate("ports.toml", "as given", evaluation), Candidate("wide.toml", "ports", made_evaluation(seed=1))]
    path = folder / "report.html"
    episodes = made_episodes(failing=True)
    write_report(
        evaluation,
        path,
        pictures=write_given_pictures(evaluation.pictures, folder, name="arms"),
        maps=ArmMaps(evaluation).write_all(folder),
        command="surgsim arms --scene liver --left psm_grasper --right psm_palpator --ports ports.toml",
        ranking=rank(others),
        episodes=episodes,
        episode_pictures=write_given_pictures(episodes.pictures, folder, name="episode"),
    )
    return path


def test_the_report_opens_without_an_error(report, tmp_path):
    picture = tmp_path / "shot.png"
    done = browse(report, tmp_path, f"--screenshot={picture}", "--window-size=1280,2400")
    assert done.returncode == 0, done.stderr
    assert console(done) == []
    image = imread(picture)[:, :, :3]
    assert image.shape == (2400, 1280, 3)
    # Dark text and the maps' colours on white, down to the foot of the window.
    assert (image == 1.0).all(axis=2).mean() > 0.4
    for part in np.split(image, 4):
        assert len(np.unique((part * 255).astype(np.uint8).reshape(-1, 3), axis=0)) > 200
    assert (image.max(axis=2) < 0.25).mean() > 0.003


def test_a_page_with_a_fault_is_noticed(report, tmp_path):
    """That the console is read at all: a picture from the network is refused by the page's own policy, and said."""
    faulty = tmp_path / "faulty.html"
    faulty.write_text(
        report.read_text(encoding="utf-8").replace("</main>", '<img src="http://example.org/a.png"></main>')
    )
    done = browse(faulty, tmp_path, "--dump-dom")
    assert any("Content Security Policy" in line for line in console(done)), done.stderr


@pytest.mark.parametrize("width", [1280, 500])
def test_every_picture_is_decoded_and_nothing_is_wider_than_the_window(report, tmp_path, width):
    text = report.read_text(encoding="utf-8")
    assert POLICY in text
    copy = tmp_path / "copy.html"
    policy = f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">'
    copy.write_text(text.replace(policy, PROBE), encoding="utf-8")
    done = browse(copy, tmp_path, "--dump-dom", "--virtual-time-budget=10000", f"--window-size={width},900")
    assert console(done) == []
    (title,) = re.findall(r"<title>(.*?)</title>", done.stdout)
    found = re.fullmatch(r"images ([\d ]+) widest (\d+) of (\d+) loaded (\d+)", title)
    assert found, title
    widths = [int(one) for one in found[1].split()]
    assert len(widths) == text.count("<img") == 13
    assert min(widths) >= 60
    assert int(found[2]) <= int(found[3])
    assert int(found[4]) == 0
    assert done.stdout.count("<img") == 13


def test_it_prints(report, tmp_path):
    sheet = tmp_path / "report.pdf"
    done = browse(report, tmp_path, f"--print-to-pdf={sheet}", "--no-pdf-header-footer")
    assert done.returncode == 0 and console(done) == []
    data = sheet.read_bytes()
    assert data.startswith(b"%PDF") and len(data) > 100_000
