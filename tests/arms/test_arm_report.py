"""The report, its tables and maps show what the arrays of an evaluation hold."""

import csv
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from matplotlib.image import imread

from surgsim_apps.arms.pictures import ArmMaps
from surgsim_apps.arms.points_file import columns, write_points
from surgsim_apps.arms.quantities import QUANTITIES
from surgsim_apps.arms.report import write_report
from surgsim_apps.arms.results import REASONS
from surgsim_apps.arms.wording import number_text, verdict
from tests.arms.made import made_evaluation

VOID = {"meta", "link", "img", "br"}


class Page(HTMLParser):
    """Checks that tags balance; collects attributes, headings of sections and the text of table rows."""

    def __init__(self, text):
        super().__init__()
        self.open, self.attributes, self.rows, self.text = [], [], [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.attributes.append((tag, dict(attrs)))
        assert len(dict(attrs)) == len(attrs), f"<{tag}> names an attribute twice"
        if tag not in VOID:
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag):
        assert self.open and self.open.pop() == tag, f"</{tag}> closes nothing"

    def handle_data(self, data):
        if "style" in self.open:
            return
        self.text.append(data)
        if self.open and ({"td", "th"} & set(self.open)):
            self.rows[-1][-1] += data

    def of(self, tag):
        return [attributes for name, attributes in self.attributes if name == tag]

    def row(self, head, number=0):
        return [row for row in self.rows if row and row[0] == head][number]


@pytest.fixture(scope="module")
def evaluation():
    return made_evaluation()


@pytest.fixture(scope="module")
def folder(evaluation, tmp_path_factory):
    return written(evaluation, tmp_path_factory.mktemp("report"))


def written(evaluation, folder):
    maps = ArmMaps(evaluation).write_all(folder)
    write_points(evaluation, folder / "points.csv")
    write_report(evaluation, folder / "report.html", maps=maps, command="surgsim arms <b>&amp;")
    return folder


@pytest.fixture(scope="module")
def page(folder):
    return Page((folder / "report.html").read_text(encoding="utf-8"))


def test_the_verdict_says_what_the_arrays_say(evaluation):
    sentence = verdict(evaluation)
    left, right, outer = evaluation.left, evaluation.right, ~evaluation.inner
    shares = [f"{100 * mask[outer].mean():.0f} %" for mask in (left.reachable, right.reachable, evaluation.both)]
    assert f"the left arm reaches {shares[0]}, the right arm {shares[1]}, and both at once {shares[2]}." in sentence
    assert "of 110 points on the surface of ellipsoid that face the ports" in sentence
    assert f"Of 10 targets inside it both at once reach {evaluation.both[evaluation.inner].sum()}." in sentence


def test_tables_show_least_median_and_greatest(evaluation, page):
    for quantity in QUANTITIES:
        cells = page.row(quantity.label)[1:]
        arrays = [getattr(evaluation.left, quantity.field), getattr(evaluation.right, quantity.field)]
        pair = np.stack(arrays)
        worse = pair.min(axis=0) if quantity.more_is_better else pair.max(axis=0)
        arrays.append(np.where(evaluation.both, worse, np.nan))
        wanted = [
            number_text(float(pick(values)), quantity.scale, quantity.digits)
            for values in arrays
            for pick in (np.nanmin, np.nanmedian, np.nanmax)
        ]
        assert cells == wanted, quantity.field
    metres = evaluation.arm_distance_outside * 1e3
    assert page.row("distance between the arms outside the body")[1:] == [
        f"{value:.1f}" for value in (np.nanmin(metres), np.nanmedian(metres), np.nanmax(metres))
    ]


def test_tables_show_shares_and_reasons(evaluation, page):
    surface = ~evaluation.inner
    masks = (evaluation.left.reachable, evaluation.right.reachable, evaluation.both)
    assert page.row("on the surface (110 points)")[1:] == [f"{100 * mask[surface].mean():.0f} %" for mask in masks]
    assert page.row("inside the organ (10 points)")[1:] == [f"{100 * mask[~surface].mean():.0f} %" for mask in masks]
    for index, reason in enumerate(REASONS):
        counts = [int((arm.reason == index).sum()) for arm in (evaluation.left, evaluation.right)]
        assert [int(cell.split()[0]) for cell in page.row(reason)[1:]] == counts


def test_errors_of_joints_are_shown_of_arms_that_state_them(page):
    assert page.row("left arm")[1:] == ["3.0", "3.0", "1.0", "1.0", "90 %"]


def test_the_worse_of_both_is_the_less_useful(evaluation):
    for field, pick in (("tip_force", np.minimum), ("trocar_load", np.maximum)):
        quantity = next(item for item in QUANTITIES if item.field == field)
        wanted = pick(getattr(evaluation.left, field), getattr(evaluation.right, field))[evaluation.both]
        worse = quantity.worse_of_both(evaluation)
        np.testing.assert_array_equal(worse[evaluation.both], wanted)
        assert np.isnan(worse[~evaluation.both]).all()


def test_points_come_back_from_the_table(evaluation, folder):
    with (folder / "points.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert list(rows[0]) == list(columns(evaluation))
    assert len(rows) == len(evaluation.points)

    def read(name):
        return np.array([float(row[name]) if row[name] else np.nan for row in rows])

    def same(name, values):
        np.testing.assert_allclose(read(name), values, rtol=1e-8, atol=1e-15, equal_nan=True, err_msg=name)

    for axis, letter in enumerate("xyz"):
        same(f"{letter}_m", evaluation.points[:, axis])
        same(f"normal_{letter}", evaluation.normals[:, axis])
    same("inner", evaluation.inner)
    same("both", evaluation.both)
    same("arm_distance_inside_m", evaluation.arm_distance_inside)
    same("arm_distance_outside_m", evaluation.arm_distance_outside)
    for side, arm in (("left", evaluation.left), ("right", evaluation.right)):
        same(f"{side}_reachable", arm.reachable)
        assert [row[f"{side}_reason"] for row in rows] == [REASONS[index] if index else "" for index in arm.reason]
        for joint in range(arm.joints.shape[1]):
            same(f"{side}_joint_{joint}", arm.joints[:, joint])
        for quantity in QUANTITIES:
            same(f"{side}_{quantity.field}{quantity.si}", getattr(arm, quantity.field))


def test_the_page_is_whole_and_stands_alone(folder, page):
    text = (folder / "report.html").read_text(encoding="utf-8")
    assert text.startswith("<!DOCTYPE html>")
    assert not re.findall(r"https?:|//|@import|url\(", re.sub(r"base64,[^\"]*", "", text))
    for tag, attributes in page.attributes:
        assert tag not in ("script", "iframe", "object", "embed", "base")
        for name in ("src", "href", "srcset", "data", "action"):
            value = attributes.get(name)
            assert value is None or value.startswith(("data:", "#")), (tag, name, value[:40])
    identifiers = [attributes["id"] for _, attributes in page.attributes if "id" in attributes]
    assert len(identifiers) == len(set(identifiers))
    for link in page.of("a"):
        assert link["href"][1:] in identifiers
    assert "surgsim arms <b>&amp;" in "".join(page.text)


def test_the_page_says_the_verdict_first(evaluation, page):
    text = "".join(page.text)
    parts = ["Maps on the organ", "Numbers", "What each figure means"]
    body = text[text.index("Contents") :] if "Contents" in text else text
    assert text.index(verdict(evaluation)) < text.index("Who reaches what")
    places = [body.rindex(part) for part in parts]
    assert places == sorted(places)
    for quantity in QUANTITIES:
        assert quantity.definition in text


@pytest.mark.slow
def test_every_map_is_a_picture_with_something_in_it(folder):
    maps = sorted(folder.glob("map_*.png"))
    assert len(maps) == 10
    for path in maps:
        image = imread(path)
        assert len(np.unique(image.reshape(-1, image.shape[2])[:, :3], axis=0)) > 100, path.name


def test_the_map_is_grey_just_where_neither_arm_reaches(evaluation):
    """Each patch has the state of the point nearest to it, place and normal counted."""
    maps = ArmMaps(evaluation)
    centres = maps._patches.corners.mean(axis=1)
    surface = np.flatnonzero(~evaluation.inner)
    for index in range(0, len(centres), 7):
        nearest = maps._nearest[index, 0]
        weight = 0.15 * np.ptp(evaluation.surface_points, axis=0).max()
        far = np.linalg.norm(evaluation.points[surface] - centres[index], axis=1) ** 2
        turned = np.linalg.norm(evaluation.normals[surface] - maps._patches.normals[index], axis=1) ** 2
        assert nearest == surface[np.argmin(far + weight**2 * turned)]


def test_nothing_is_painted_where_no_point_was_tried(evaluation):
    """Points on one half only: the other half is claimed by no colour."""
    kept = evaluation.inner | (evaluation.points @ np.array([0.0, -0.74, 0.67]) > 0.0)
    names = ("points", "normals", "inner", "both", "arm_distance_inside", "arm_distance_outside")
    arms = {
        side: replace(
            getattr(evaluation, side),
            **{name: value[kept] for name, value in vars(getattr(evaluation, side)).items() if name != "name"},
        )
        for side in ("left", "right")
    }
    half = replace(evaluation, **{name: getattr(evaluation, name)[kept] for name in names}, **arms)
    maps = ArmMaps(half)
    centres = maps._patches.corners.mean(axis=1)
    height = centres @ np.array([0.0, -0.74, 0.67])
    assert not maps._tried[height < -0.03].any()
    assert maps._tried[height > 0.01].mean() > 0.9


@pytest.mark.slow
def test_nothing_reached_is_told_as_that(tmp_path):
    evaluation = made_evaluation(left_to=-2.0, right_to=-2.0)
    assert not evaluation.left.reachable.any()
    assert "reaches 0 %" in verdict(evaluation)
    page = Page((written(evaluation, tmp_path) / "report.html").read_text(encoding="utf-8"))
    assert page.row("tip force [N]")[1:] == ["–"] * 9


@pytest.mark.slow
@pytest.mark.usefixtures("few_maps")
def test_everything_reached_without_inner_targets(tmp_path):
    evaluation = made_evaluation(inner_count=0, count=60)
    everywhere = np.zeros(60, dtype=np.int32)
    arms = {side: replace(getattr(evaluation, side), reason=everywhere) for side in ("left", "right")}
    evaluation = replace(evaluation, both=np.ones(60, dtype=bool), **arms)
    page = Page((written(evaluation, tmp_path) / "report.html").read_text(encoding="utf-8"))
    assert page.row("on the surface (60 points)")[1:] == ["100 %"] * 3


@pytest.mark.slow
def test_the_files_repeat_to_the_byte(evaluation, folder, tmp_path):
    again = written(evaluation, tmp_path / "elsewhere" if (tmp_path / "elsewhere").mkdir() is None else tmp_path)
    names = {path.name for path in folder.iterdir()}
    assert names == {path.name for path in again.iterdir()}
    for name in names:
        assert (folder / name).read_bytes() == (again / name).read_bytes(), name
    for path in folder.glob("*.png"):
        assert b"tIME" not in path.read_bytes()
