"""Contents of the panel and calls of its elements, with a gui that keeps its elements by label."""

import re
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

from surgsim_apps.live import panel as module
from surgsim_apps.live.exchange_records import Phase, new_exchange
from surgsim_apps.live.organ_choice import HIDDEN
from surgsim_apps.live.panel import PLOT_LEAST, PLOTTED, Panel
from surgsim_apps.live.stage import NOTHING, STIFFNESS_MAP
from surgsim_env.rendering.painted_fields import PAINTED_FIELDS, field_colours
from surgsim_env.scene.load import make_scene
from surgsim_env.scene.motions import with_motion

BUTTONS = {"Pause": "pause", "Reset": "reset", "Record": "record", "Clear": "clear_map"}
SWITCHES = {
    "Close the jaw": "close_jaw",
    "Hold the breath": "hold_breath",
    "Plain light": "plain",
    "Show lesions": "show_lesions",
}


class Element:
    """An element of a gui; `set` is what a browser does."""

    def __init__(self, value=None, **look):
        self.value, self.visible, self.disabled, self.calls = value, True, False, []
        self.__dict__.update(look)

    def on_click(self, call):
        self.calls.append(call)

    on_update = on_click

    def set(self, value=True):
        self.value = value
        for call in self.calls:
            call(SimpleNamespace(client="tab"))


class Gui:
    """Elements by label, plots by unit, and all texts."""

    def __init__(self):
        self.elements, self.plots, self.texts = {}, {}, []

    def _add(self, label, value=None, **look):
        self.elements[label] = Element(value, label=label, **look)
        return self.elements[label]

    def add_button(self, label, **_):
        return self._add(label)

    def add_button_group(self, label, options):
        return self._add(label, options[0])

    def add_checkbox(self, label, initial_value, visible=True, **_):
        return self._add(label, initial_value, visible=visible)

    def add_slider(self, label, initial_value, **_):
        return self._add(label, initial_value)

    def add_dropdown(self, label, options, initial_value=None):
        return self._add(label, initial_value or options[0], options=options)

    def add_uplot(self, data, series, scales, **_):
        plot = Element(data=data, series=series, scales=scales)
        self.plots[series[1]["label"].rpartition("[")[2].rstrip("]")] = plot
        return plot

    def add_html(self, content, **look):
        self.texts.append(Element(content=content, **look))
        return self.texts[-1]

    add_markdown = add_html

    def add_folder(self, *_, **__):
        return nullcontext()


def made(scene, *, arm_count=1, has_jaw=False):
    """A panel, its gui, and the calls that were made."""
    gui, made_calls = Gui(), []
    names = (*BUTTONS.values(), *SWITCHES.values(), "paint", "view", "picture", "open")
    calls = {name: lambda *given, name=name: made_calls.append((name, *given)) for name in names}
    return Panel(gui, scene, arm_count, has_jaw, calls), gui, made_calls


@pytest.fixture
def clock(monkeypatch):
    now = SimpleNamespace(value=100.0)
    monkeypatch.setattr(module.time, "monotonic", lambda: now.value)
    return now


def test_sliders_describe_an_organ_once_they_stand_still(clock):
    scene = make_scene("liver")
    panel, gui, _ = made(scene)
    assert panel.settled_choice() is None
    modulus, damping = gui.elements["Young's modulus [kPa]"], gui.elements["Damping [1/s]"]
    modulus.set(2.0 * modulus.value)
    damping.set(3.0 * damping.value)
    gui.elements["Lesions' modulus / tissue's"].set(5.0)
    gui.elements["Lesions' size"].set(0.5)
    assert panel.settled_choice() is None
    clock.value += 1.0
    choice = panel.settled_choice()
    assert choice.modulus_factor == pytest.approx(2.0) and choice.damping_factor == pytest.approx(3.0)
    assert choice.lesion_ratio == 5.0 and choice.lesion_size == 0.5
    assert panel.settled_choice() is None


def test_each_click_hides_another_lesion_at_once(clock):
    panel, gui, _ = made(make_scene("phantom_small"))
    seeds = []
    for _ in range(2):
        gui.elements["Hide another lesion"].set()
        clock.value += 0.001
        choice = panel.settled_choice()
        assert choice.lesions == HIDDEN == gui.elements["Lesions"].value
        seeds.append(choice.seed)
    assert seeds[0] != seeds[1]


def test_each_element_has_its_call():
    _, gui, calls = made(with_motion(make_scene("phantom_small"), "calm"), has_jaw=True)
    for label in (*BUTTONS, *SWITCHES):
        gui.elements[label].set(True)
    assert calls == [*((call,) for call in BUTTONS.values()), *((call, True) for call in SWITCHES.values())]


def test_the_menu_opens_a_scene_with_an_instrument():
    _, gui, calls = made(make_scene("phantom_small"))
    assert gui.elements["Organ"].value == "phantom_small" and "liver" in gui.elements["Organ"].options
    gui.elements["Organ"].set("liver")
    gui.elements["Instrument"].set("psm_palpator")
    assert calls == [("open", "liver", None), ("open", "liver", "psm_palpator")]


def test_a_view_and_a_picture_are_of_the_tab_that_asks():
    _, gui, calls = made(make_scene("phantom_small"))
    gui.elements["Camera"].set("endoscope")
    gui.elements["Picture"].set()
    assert calls == [("view", "tab", "endoscope"), ("picture", "tab")]


def test_the_paint_is_chosen_by_its_title_and_has_the_end_of_its_scale():
    panel, gui, calls = made(make_scene("phantom_small"))
    paint, legend = gui.elements["Paint"], next(text for text in gui.texts if "lower quartile" in text.content)
    for name, field in PAINTED_FIELDS.items():
        paint.set(field.title)
        assert calls.pop() == ("paint", name)
        panel.show_legend(name, 7.25)
        assert f"7.25 {field.unit}" in legend.content and not gui.elements["Clear"].visible
    paint.set("none")
    assert calls.pop() == ("paint", NOTHING)
    panel.show_legend(NOTHING, 0.0)
    assert not legend.visible
    panel.show_legend(STIFFNESS_MAP, 0.0)
    assert legend.visible and gui.elements["Clear"].visible


def test_the_pointer_presses_as_deep_as_the_slider_says():
    scene = make_scene("phantom_small")
    panel, gui, _ = made(scene)
    assert panel.press_depth == pytest.approx(scene.palpation.press_depth)
    gui.elements["Press depth [mm]"].set(2.5)
    assert panel.press_depth == pytest.approx(0.0025)


def test_only_what_there_is_can_be_switched():
    for scene in (make_scene("phantom_small"), with_motion(make_scene("phantom_small"), "calm")):
        for has_jaw in (False, True):
            _, gui, _ = made(scene, has_jaw=has_jaw)
            assert gui.elements["Close the jaw"].visible == has_jaw
            assert gui.elements["Hold the breath"].visible == scene.has_breath


def test_buttons_are_named_by_what_a_click_does():
    panel, gui, _ = made(make_scene("phantom_small"))
    pause, record = (gui.elements[name] for name in ("Pause", "Record"))
    frame = new_exchange(1, 4, 1, {}).frame.read()
    for phase, recording, names in (
        (Phase.RUNNING, False, ("Pause", "Record")),
        (Phase.PAUSED, False, ("Continue", "Record")),
        (Phase.RUNNING, True, ("Pause", "End recording (2 s)")),
    ):
        frame["phase"], frame["recording"] = phase, recording
        panel.show_phase(frame, 2.0, jaw_closed=True, breath_held=True)
        assert (pause.label, record.label) == names
    assert gui.elements["Close the jaw"].value and gui.elements["Hold the breath"].value
    panel.show_phase(frame, 0.0, jaw_closed=False, breath_held=False)
    assert not gui.elements["Close the jaw"].value
    panel.show_status(frame, [("physics", "1000 steps/s"), ("", "written")])
    first, timing = gui.texts[0].content, next(text.content for text in gui.texts if "steps/s" in text.content)
    assert "recording" in first and "written" in first and "steps/s" not in first and "written" not in timing
    panel.show_plain(True)
    assert gui.elements["Plain light"].value


def test_plots_show_the_last_seconds_of_each_arm():
    panel, gui, _ = made(make_scene("phantom_small"), arm_count=2)
    trace = np.zeros(2000, dtype=new_exchange(2, 4, 1, {}).trace.read()["row"].dtype)
    trace["time"] = 0.01 * np.arange(len(trace))
    trace["force"][:, 0, 2], trace["force"][:, 1, 0] = 0.3, -0.7
    trace["depth"][:, 0] = 0.001
    panel.plot(trace)
    time, left, right = gui.plots["N"].data
    assert time[0] == pytest.approx(-PLOTTED, abs=0.1) and time[-1] == pytest.approx(0.0, abs=0.1)
    assert np.allclose(left, 0.3) and np.allclose(right, 0.7)
    assert gui.plots["N"].scales["y"]["max"] == 2.0 * PLOT_LEAST["N"]
    assert np.allclose(gui.plots["mm"].data[1], 1.0) and gui.plots["mm"].scales["y"]["max"] == PLOT_LEAST["mm"]


def test_taxels_are_coloured_by_their_force_from_the_bottom_row_up():
    panel, gui, _ = made(make_scene("phantom_small"))
    normal = np.zeros((1, 2, 3), dtype=np.float32)
    normal[0, 0, 2] = 0.05
    panel.show_taxels(normal)
    (shown,) = [text for text in gui.texts if "taxels" in text.content]
    cells = re.findall(r"rgb\((\d+, \d+, \d+)\)", shown.content)
    low, high = (", ".join(map(str, colour.tolist())) for colour in field_colours(256)[[0, -1]])
    assert shown.visible and cells == [low] * 5 + [high] and "up to 50 mN" in shown.content
