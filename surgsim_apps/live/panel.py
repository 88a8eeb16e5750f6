"""The page's panel: buttons, sliders, plots, and a status text with the timing of the physics."""

import html
import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surgsim_apps.haptics.pacing import Timeliness
from surgsim_apps.live.exchange_records import Phase
from surgsim_apps.live.organ_choice import HIDDEN, SHOWN, OrganChoice, lesion_kinds
from surgsim_apps.live.stage import CONTRASTS, LEVELS, NOTHING, STIFFNESS_MAP
from surgsim_env.rendering import CAMERAS, PAINTED_FIELDS, field_colours
from surgsim_env.scene import Scene, list_arms, list_scenes

# Time span of the plots [s], and their number of points.
PLOTTED, PLOT_POINTS = 10.0, 250
# Smallest upper end of a plot's scale; it doubles as needed.
PLOT_LEAST = {"N": 0.5, "mm": 4.0}
# Least end of the colours of taxels [N].
TAXEL_LEAST = 0.01
# Time without a motion of the sliders before a change applies [s].
SETTLED = 0.35
# Young's modulus of tissues of the breast [kPa] (Samani et al. 2007, under small deformation).
TISSUES = {
    "fat": 3.25,
    "a fibroadenoma": 6.41,
    "a low-grade carcinoma": 10.4,
    "an intermediate-grade carcinoma": 20.0,
    "a high-grade carcinoma": 42.5,
}
# Choices of the paint, with their names.
PAINTS = {
    "none": NOTHING,
    "stiffness map": STIFFNESS_MAP,
    **{field.title: name for name, field in PAINTED_FIELDS.items()},
}
# Names of a scene and an instrument; None for the scene's own instrument, which the menu calls OWN_INSTRUMENT.
Opened = tuple[str, str | None]
OWN_INSTRUMENT = "the scene's own"
BUTTON_COLOUR = (52, 84, 96)
ARM_COLOURS = ("#e8590c", "#1971c2")
TITLES = {
    Phase.STARTING: "starting",
    Phase.RUNNING: "running",
    Phase.PAUSED: "paused",
    Phase.FAULT: "stopped by a fault: press Reset",
    Phase.ENDED: "ended",
}
STEERING = """
| | |
|---|---|
| mouse | press and hold on the organ, drag to slide, shift to press deeper; or drag an arrow of the handle |
| arrow keys | across the organ |
| Page up / down | out / in (also shift + up / down) |
| gamepad | left stick across, triggers out / in |{jaw}{second}

Drag elsewhere to turn the view, wheel to zoom.
"""


class Panel:
    """The panel beside the picture. viser's threads call the callbacks.

    Fields:
        choice: the organ of the sliders
    """

    def __init__(
        self,
        gui: Any,
        scene: Scene,
        arm_count: int,
        has_jaw: bool,
        calls: dict[str, Callable[..., None]],
        opened: Opened = ("", None),
    ) -> None:
        """Build it.

        Args:
            gui: viser's.
            scene: of the session.
            arm_count: 1 or 2.
            has_jaw: True if the first arm has a jaw.
            calls: callbacks by name: pause() and record(), which toggle;
                reset(), show_lesions(on), paint(value of PAINTS), clear_map(), close_jaw(on), hold_breath(on),
                plain(on), view(viser's client, name of a camera), picture(client), open(scene, instrument).
            opened: scene and instrument that the menu shows; a file's path or a name.
        """
        self._gui, self._scene, self._calls = gui, scene, calls
        self.choice = OrganChoice(lesions=lesion_kinds(scene)[0])
        self._changed: float | None = None
        self._headline = gui.add_html(_status_html("starting", []))
        self._add_buttons()
        with gui.add_folder("Scene", expand_by_default=False):
            scenes = dict.fromkeys((opened[0] or scene.name, *list_scenes()))
            arms = dict.fromkeys((opened[1] or OWN_INSTRUMENT, OWN_INSTRUMENT, *list_arms()))
            self._scenes, self._arms = (
                gui.add_dropdown(*menu) for menu in (("Organ", tuple(scenes)), ("Instrument", tuple(arms)))
            )
            for menu in (self._scenes, self._arms):
                menu.on_update(lambda _: self._open())
        self._jaw = self._checkbox("Close the jaw", "close_jaw", visible=has_jaw)
        hint = "the present breath ends, and no other begins; the heart goes on"
        self._breath = self._checkbox("Hold the breath", "hold_breath", visible=scene.has_breath, hint=hint)
        depth = round(1e3 * scene.palpation.press_depth, 1)
        self._press_depth = self._slider("Press depth [mm]", 0.25, 2.0, 0.05, 1.0, depth)
        with gui.add_folder("Force and depth"):
            self._force = _plot(gui, "N", arm_count)
            self._depth = _plot(gui, "mm", arm_count)
            self._tone = gui.add_checkbox("Tone at the limits of force", initial_value=False)
        self._taxels = gui.add_html("", visible=False)
        with gui.add_folder("Tissue"):
            self._add_tissue()
        with gui.add_folder("Colours"):
            self._paint = gui.add_dropdown("Paint", tuple(PAINTS), initial_value="stiffness map")
            self._paint.on_update(lambda _: self._calls["paint"](PAINTS[self._paint.value]))
            self._legend = gui.add_html(_legend_html(STIFFNESS_MAP, 0.0))
            self._clear = self._button("Clear", "clear the stiffness map", calls["clear_map"])
        self._plain = self._checkbox("Plain light", "plain", hint="faster without a graphics card")
        with gui.add_folder("View", expand_by_default=False):
            views = gui.add_button_group("Camera", CAMERAS)
            views.on_click(lambda event: self._calls["view"](event.client, views.value))
            picture = gui.add_button("Picture", hint="save it as a file", color=BUTTON_COLOUR)
            picture.on_click(lambda event: self._calls["picture"](event.client))
        with gui.add_folder("Timing", expand_by_default=False):
            self._status = gui.add_html("")
        with gui.add_folder("How to steer", expand_by_default=False):
            second = "\n| X, or a shoulder button | the other arm |" if arm_count > 1 else ""
            jaw = "\n| G, or the first button | close or open the jaw |" if has_jaw else ""
            gui.add_markdown(STEERING.format(second=second, jaw=jaw))

    def settled_choice(self) -> OrganChoice | None:
        """The organ of the sliders, once they have stopped moving; None otherwise."""
        if self._changed is None or time.monotonic() - self._changed < SETTLED:
            return None
        self._changed = None
        return self.choice

    def show_status(self, frame: NDArray[Any], rows: list[tuple[str, str]]) -> None:
        """Show the state of the physics in a frame, and names with values."""
        _set(self._headline, "content", _status_html(headline(frame), [row for row in rows if not row[0]]))
        self._status.content = _status_html("", [row for row in rows if row[0]])

    @property
    def press_depth(self) -> float:
        """Depth of a press by the pointer [m]."""
        return self._press_depth.value / 1e3

    @property
    def tone(self) -> bool:
        """True if a tone sounds at the limits of force."""
        return self._tone.value

    def show_lesions(self, on: bool) -> None:
        """Set its check box, which calls."""
        _set(self._show_lesions, "value", on)

    def hide(self, seed: int) -> None:
        """Hide a lesion, at once."""
        self._lesions.value = HIDDEN
        self._choose(seed=seed)
        self._changed = time.monotonic() - SETTLED

    def show_phase(self, frame: NDArray[Any], recorded: float, *, jaw_closed: bool, breath_held: bool) -> None:
        """Label the buttons with the effect of a click; `recorded` is the length of the recording [s]."""
        recording = bool(frame["recording"])
        _set(self._jaw, "value", jaw_closed)
        _set(self._breath, "value", breath_held)
        _set(self._pause, "label", "Continue" if frame["phase"] == Phase.PAUSED else "Pause")
        _set(self._record, "label", f"End recording ({recorded:.0f} s)" if recording else "Record")

    def show_plain(self, on: bool) -> None:
        """Set its check box."""
        _set(self._plain, "value", on)

    def show_legend(self, kind: str, end: float) -> None:
        """Show the colours of a kind of paint; `end` is that of a field's scale, in its unit."""
        _set(self._legend, "content", _legend_html(kind, end))
        _set(self._legend, "visible", kind != NOTHING)
        _set(self._clear, "visible", kind == STIFFNESS_MAP)

    def show_taxels(self, normal: NDArray[np.float32]) -> None:
        """Show the normal force on each taxel of patches side by side [N], (n_patch, rows, columns)."""
        self._taxels.content = _taxels_html(normal)
        _set(self._taxels, "visible", True)

    def plot(self, trace: np.ndarray) -> None:
        """Show a trace's rows: time [s], force [N] and depth [m] of each arm."""
        if len(trace) < 2:
            return
        # Seconds before now: a fixed window, also for a tab that is loaded again.
        now = float(trace["time"][-1])
        trace = trace[trace["time"] >= now - PLOTTED]
        trace = trace[:: max(1, len(trace) // PLOT_POINTS)]
        since = trace["time"] - now
        force = np.linalg.norm(trace["force"], axis=2)
        for plot, unit, values in ((self._force, "N", force), (self._depth, "mm", trace["depth"] * 1e3)):
            top = PLOT_LEAST[unit]
            while top < 1.05 * values.max():
                top *= 2.0
            if plot.scales["y"]["max"] != top:
                plot.scales = _scales(top)
            plot.data = (since, *(np.ascontiguousarray(curve) for curve in values.T))

    def _add_buttons(self) -> None:
        calls = self._calls
        self._pause = self._button("Pause", "pause the physics, or continue", calls["pause"])
        self._button("Reset", "the same organ at rest, tips parked", calls["reset"])
        self._record = self._button("Record", "record hands, tips and forces at 1 kHz to a CSV file", calls["record"])

    def _add_tissue(self) -> None:
        gui, scene = self._gui, self._scene
        self._modulus = self._slider("Young's modulus [kPa]", 0.5, 2.0, 0.05, 1.0, scene.material.youngs_modulus / 1e3)
        self._damping = self._slider("Damping [1/s]", 0.25, 4.0, 0.05, 1.0, max(scene.damping.alpha, 1e-3))
        kinds = lesion_kinds(scene)
        self._lesions = gui.add_dropdown("Lesions", kinds, initial_value=kinds[0])
        ratio = max(
            (lesion.modulus_ratio for lesion in scene.demonstration),
            default=scene.lesion.modulus_ratio[1] if scene.lesion else 8.0,
        )
        self._ratio = self._slider("Lesions' modulus / tissue's", 1.0, 12.0, 0.5, min(float(ratio), 12.0))
        self._size = self._slider("Lesions' size", 0.5, 1.3, 0.05, 1.0)
        hide = self._button(
            "Hide another lesion", "draw one from the scene's ranges", lambda: self.hide(self.choice.seed + 1)
        )
        hide.visible = HIDDEN in kinds
        self._names = gui.add_html(self._names_html(self._modulus.value))
        for control in (self._modulus, self._damping, self._ratio, self._size, self._lesions):
            control.on_update(lambda _: self._choose())
        self._show_lesions = self._checkbox("Show lesions", "show_lesions")

    def _open(self) -> None:
        instrument = self._arms.value
        self._calls["open"](self._scenes.value, None if instrument == OWN_INSTRUMENT else instrument)

    def _choose(self, **changes: Any) -> None:
        scene = self._scene
        self.choice = OrganChoice(
            modulus_factor=self._modulus.value / (scene.material.youngs_modulus / 1e3),
            damping_factor=self._damping.value / max(scene.damping.alpha, 1e-3),
            lesions=self._lesions.value,
            lesion_ratio=self._ratio.value if self._lesions.value in (SHOWN, HIDDEN) else None,
            lesion_size=self._size.value,
            seed=changes.get("seed", self.choice.seed),
        )
        _set(self._names, "content", self._names_html(self._modulus.value))
        self._changed = time.monotonic()

    def _names_html(self, modulus: float) -> str:
        """Tissues of the breast as stiff as tissue of a modulus [kPa], and as its lesions."""
        lesions = f", its lesions as {tissue_name(self._ratio.value * modulus)}"
        text = f"stiff as {tissue_name(modulus)}{lesions if self._lesions.value in (SHOWN, HIDDEN) else ''}"
        return f'<div style="padding:0 .9em .5em;font-size:.8em;opacity:.8">{text} (breast, Samani 2007)</div>'

    def _slider(self, label: str, low: float, high: float, step: float, start: float, unit: float = 1.0) -> Any:
        values = [round(value * unit, 6) for value in (low, high, step, start)]
        return self._gui.add_slider(label, min=values[0], max=values[1], step=values[2], initial_value=values[3])

    def _button(self, label: str, hint: str, clicked: Callable[..., None]) -> Any:
        button = self._gui.add_button(label, hint=hint, color=BUTTON_COLOUR)
        button.on_click(lambda _: clicked())
        return button

    def _checkbox(self, label: str, name: str, *, initial_value: bool = False, **options: Any) -> Any:
        """A check box for the callback of a name."""
        box = self._gui.add_checkbox(label, initial_value=initial_value, **options)
        box.on_update(lambda _: self._calls[name](box.value))
        return box


def tissue_name(modulus: float) -> str:
    """The tissue of TISSUES whose Young's modulus is nearest to one [kPa], by their ratio."""
    return min(TISSUES, key=lambda name: abs(math.log(TISSUES[name] / modulus)))


def _set(handle: Any, name: str, value: object) -> None:
    """Set an attribute of an element if it differs: viser sends every assignment."""
    if getattr(handle, name) != value:
        setattr(handle, name, value)


def _scales(top: float) -> dict[str, Any]:
    return {"x": {"time": False, "range": (-PLOTTED, 0.0)}, "y": {"auto": False, "min": 0.0, "max": top}}


def _plot(gui: Any, unit: str, arm_count: int) -> Any:
    start = (np.array([0.0, 1.0]), *(np.zeros(2) for _ in range(arm_count)))
    names = ("left arm", "right arm") if arm_count > 1 else ("force" if unit == "N" else "depth",)
    series: list[dict[str, Any]] = [{"label": "s"}]
    for name, colour in zip(names, ARM_COLOURS, strict=False):
        series.append({"label": f"{name} [{unit}]", "stroke": colour, "width": 2, "points": {"show": False}})
    axes = (
        {"stroke": "#888", "grid": {"stroke": "#8883", "width": 1}},
        {"stroke": "#888", "grid": {"stroke": "#8883", "width": 1}, "size": 44},
    )
    return gui.add_uplot(
        start,
        tuple(series),
        scales=_scales(PLOT_LEAST[unit]),
        axes=axes,
        legend={"show": True, "live": False},
        padding=(12, 16, 0, 0),
        height=150,
    )


def _status_html(headline: str, rows: list[tuple[str, str]]) -> str:
    cells = "".join(
        f'<tr><td style="opacity:.65;padding-right:.8em">{name}</td>'
        f'<td style="text-align:right;font-variant-numeric:tabular-nums">{value}</td></tr>'
        # A text without a name takes the whole width.
        if name
        else f'<tr><td colspan="2" style="color:{ARM_COLOURS[0]}">{value}</td></tr>'
        for name, value in rows
    )
    return (
        f'<div style="padding:.2em .9em .5em;font-size:.85em"><b>{headline}</b>'
        f'<table style="width:100%;border-spacing:0">{cells}</table></div>'
    )


def _taxels_html(normal: NDArray[np.float32]) -> str:
    colours, most = field_colours(256), float(normal.max())
    patches = []
    for patch in normal:
        places = np.clip(255.0 * patch / max(most, TAXEL_LEAST), 0.0, 255.0).astype(int)
        # The first row is at the bottom, as seen along the patch's own axes.
        cells = "".join(
            f'<i style="background:rgb{tuple(map(int, colours[place]))}"></i>' for place in places[::-1].flat
        )
        rows, width = patch.shape
        columns = f"grid-template-columns:repeat({width},1fr);aspect-ratio:{width}/{rows}"
        patches.append(f'<div style="display:grid;gap:1px;flex:1;max-width:9em;{columns}">{cells}</div>')
    return (
        '<div style="padding:.2em .9em;font-size:.8em">'
        f'<div style="display:flex;gap:.6em">{"".join(patches)}</div>taxels: up to {1e3 * most:.0f} mN</div>'
    )


def _legend_html(kind: str, end: float) -> str:
    low, high = CONTRASTS
    text = f"stiffness over the lower quartile: {low:g} to {high:g} and more"
    if kind in PAINTED_FIELDS:
        text = PAINTED_FIELDS[kind].scale_text(end)
    colours = ", ".join(f"rgb{tuple(colour)}" for colour in field_colours(LEVELS).tolist())
    return (
        '<div style="padding:.2em .9em;font-size:.8em"><div style="height:.7em;border-radius:.35em;'
        f'background:linear-gradient(to right, {colours})"></div>{text}</div>'
    )


def headline(frame: NDArray[Any]) -> str:
    """The state of the physics in a frame, in words."""
    return "recording" if frame["recording"] else TITLES[Phase(int(frame["phase"]))]


def status_rows(
    frame: NDArray[Any],
    kept: Timeliness,
    *,
    skipped: int,
    fps: float,
    message: str,
    has_breath: bool = False,
) -> list[tuple[str, str]]:
    """Names with values, as HTML.

    Args:
        frame: the newest.
        kept: timing of the steps since the last call.
        skipped: steps skipped since the start.
        fps: pictures sent [1/s].
        message: of the page, shown if the physics has none.
        has_breath: True if the patient can hold the breath.
    """
    rows = [
        ("simulated time", f"{float(frame['time']):.1f} s"),
        ("physics", f"{kept.rate:.0f} steps/s"),
        ("real-time factor", f"{kept.real_time:.3f}"),
        ("late, median / 99 %", f"{kept.late_p50 * 1e3:.2f} / {kept.late_p99 * 1e3:.2f} ms"),
        ("a step takes", f"{kept.spent_p50 * 1e3:.2f} ms"),
        ("steps skipped so far", f"{skipped}"),
        ("pictures", f"{fps:.0f} /s"),
    ]
    if has_breath:
        rows.insert(1, ("breath", "held" if frame["breath_held"] else "goes on"))
    if float(frame["added_mass"]) > 0.0:
        rows.append(("mass added for the step", f"{float(frame['added_mass']) * 1e3:.1f} g"))
    words = bytes(frame["message"]).decode("utf-8", "replace") or message
    if words:
        rows.append(("", html.escape(words)))
    return rows
