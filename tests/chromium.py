"""A headless Chromium, spoken to through its own debugging protocol: no driver needed, software drawing enough."""

import base64
import contextlib
import json
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from websockets.sync.client import connect

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

COUNT_PICTURES = """(() => {
  window.frames_drawn = window.pictures = 0;
  let drawn = false, heard = false;
  const Real = window.Worker;
  window.Worker = class extends Real {
    constructor(...given) { super(...given); this.addEventListener("message", () => { heard = true; }); }
  };
  for (const name of ["drawElements", "drawArrays", "drawElementsInstanced"]) {
    const real = WebGL2RenderingContext.prototype[name];
    WebGL2RenderingContext.prototype[name] = function (...given) { drawn = true; return real.apply(this, given); };
  }
  const tick = () => {
    if (drawn) { window.frames_drawn += 1; if (heard) window.pictures += 1; heard = false; }
    drawn = false;
    requestAnimationFrame(tick);
  };
  requestAnimationFrame(tick);
})()"""


# How long anything may take before a test gives up [s]. Nothing that passes depends on it.
PATIENCE = 600.0
# A press is repeated where the server has not heard of it after this time [s], this often.
GRAB_TIMEOUT, PRESSES = 5.0, 10


class Chromium:
    """A headless browser process, ended at the end of a `with`; each page that it opens has cookies of its own."""

    def __init__(self, folder: Path) -> None:
        assert CHROMIUM is not None
        self._profile = folder / "profile"
        self._process = subprocess.Popen(
            [
                *(CHROMIUM, "--headless", "--no-sandbox", "--disable-dev-shm-usage", "--hide-scrollbars"),
                *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--no-first-run"),
                *("--disable-background-networking", "--remote-debugging-port=0", f"--user-data-dir={self._profile}"),
                *("--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1", "about:blank"),
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            # Linux shares the processor between sessions first: a browser has one of its own.
            start_new_session=True,
        )

    def __enter__(self) -> "Chromium":
        port_file = self._profile / "DevToolsActivePort"
        deadline = time.monotonic() + PATIENCE
        while not (port_file.is_file() and port_file.read_text().count("\n")):
            assert time.monotonic() < deadline and self._process.poll() is None, "Chromium does not start"
            time.sleep(0.02)
        port, path = port_file.read_text().splitlines()
        self._address = f"ws://127.0.0.1:{port}/devtools"
        self._link = Link(f"ws://127.0.0.1:{port}{path}")
        return self

    def __exit__(self, *_: object) -> None:
        self._link.close()
        self._process.terminate()
        self._process.wait(timeout=PATIENCE)

    @contextlib.contextmanager
    def page(self, width: int, height: int) -> Iterator["Browser"]:
        """An empty page of some size [pixels]."""
        context = self._link.do("Target.createBrowserContext")["browserContextId"]
        page = self._link.do("Target.createTarget", url="about:blank", browserContextId=context)["targetId"]
        browser = Browser(f"{self._address}/page/{page}", width, height)
        try:
            yield browser
        finally:
            browser.close()
            self._link.do("Target.disposeBrowserContext", browserContextId=context)


class Link:
    """A connection of the debugging protocol."""

    def __init__(self, address: str) -> None:
        self._socket = connect(address, max_size=None, ping_interval=None, open_timeout=PATIENCE)
        self._count = 0
        self.events: list[dict[str, Any]] = []

    def close(self) -> None:
        self._socket.close()

    def do(self, method: str, **parameters: Any) -> dict[str, Any]:
        """One command, and its answer; events that come meanwhile are kept."""
        self._count += 1
        self._socket.send(json.dumps({"id": self._count, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=PATIENCE))
            if answer.get("id") == self._count:
                assert "error" not in answer, answer
                return answer["result"]
            self.events.append(answer)


class Browser(Link):
    """One page of a browser."""

    def __init__(self, address: str, width: int, height: int) -> None:
        super().__init__(address)
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.do(f"{domain}.enable")
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.do("Emulation.setDeviceMetricsOverride", **size)

    def before_pages(self, script: str) -> None:
        """Run a script in every page that is opened from now on, before the page's own."""
        self.do("Page.addScriptToEvaluateOnNewDocument", source=script)

    def open(self, address: str) -> None:
        self.do("Page.navigate", url=address)

    def run(self, script: str) -> Any:
        """The value of an expression in the page."""
        result = self.do("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in result, result["exceptionDetails"]
        return result["result"].get("value")

    def wait_for(self, script: str) -> Any:
        """Until an expression is true; its value."""
        deadline = time.monotonic() + PATIENCE
        while True:
            value = self.run(script)
            if value:
                return value
            assert time.monotonic() < deadline, f"{script} stays {value!r}; console: {self.complaints()}"
            time.sleep(0.05)

    def wait_for_page(self) -> None:
        """Until the page that was opened last is whole, its pictures and style sheets with it."""
        self.wait_for("location.href !== 'about:blank' && document.readyState === 'complete'")

    def wait_until(self, condition: Callable[[], Any], state: Callable[[], Any] = lambda: "not told") -> None:
        """Until something is true on the server's side, while the page goes on; a failure shows the state."""
        assert self.becomes(condition, PATIENCE), (
            f"the condition stays false; state: {state()}; console: {self.complaints()}"
        )

    def becomes(self, condition: Callable[[], Any], timeout: float) -> bool:
        """True if a condition holds on the server's side within `timeout` [s], while the page goes on."""
        deadline = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > deadline:
                return False
            self.run("new Promise(done => setTimeout(done, 50))")
        return True

    def type(self, text: str) -> None:
        """Press and release a key for each letter: pages listen to keys, which text that is pasted does not send."""
        for letter in text:
            self.do("Input.dispatchKeyEvent", type="keyDown", text=letter, key=letter)
            self.do("Input.dispatchKeyEvent", type="keyUp", key=letter)

    def mouse(self, kind: str, x: float, y: float, buttons: int = 0) -> None:
        pressed = {"button": "left"} if kind != "mouseMoved" or buttons else {}
        self.do("Input.dispatchMouseEvent", type=kind, x=x, y=y, buttons=buttons, clickCount=1, **pressed)

    def drag(
        self,
        start: tuple[float, float],
        end: tuple[float, float],
        arrived: Callable[[], Any],
        *,
        grabbed: Callable[[], Any] | None = None,
        state: Callable[[], Any] = lambda: "not told",
        steps: int = 12,
    ) -> None:
        """Press at a place, move to another one, a frame of the page for each step, and let go once it has arrived.

        `grabbed` tells whether the server knows of the press. A slow page may be pressed before it has drawn what is
        there: then press again.
        """
        (x, y), (to_x, to_y) = start, end
        self.mouse("mouseMoved", x, y)
        self.next_frame()
        for _ in range(PRESSES):
            self.mouse("mousePressed", x, y, 1)
            if grabbed is None or self.becomes(grabbed, GRAB_TIMEOUT):
                break
            self.mouse("mouseReleased", x, y)
            self.next_frame()
        else:
            raise AssertionError(f"nothing is grabbed at {start}; state: {state()}; console: {self.complaints()}")
        for step in range(1, steps + 1):
            share = step / steps
            self.mouse("mouseMoved", x + share * (to_x - x), y + share * (to_y - y), 1)
            self.next_frame()
        self.wait_until(arrived, state)
        self.mouse("mouseReleased", to_x, to_y)

    def next_frame(self) -> None:
        """Until the page has drawn what it knows by now."""
        self.run("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done())))")

    def click_on(self, text: str) -> None:
        """Click the button with a text."""
        box = self.run(
            "(() => { const b = [...document.querySelectorAll('button')]"
            f".find(one => one.textContent.includes({text!r}));"
            " if (!b) return null; b.scrollIntoView({block: 'nearest'}); const r = b.getBoundingClientRect();"
            " return [r.x + r.width / 2, r.y + r.height / 2]; })()"
        )
        assert box, f"no button {text!r}"
        self.mouse("mousePressed", *box, 1)
        self.mouse("mouseReleased", *box)

    def text(self) -> str:
        return self.run("document.body?.innerText")

    def count_pictures(self) -> None:
        """Count, in pages that are opened from now on, frames that are drawn in three dimensions.

        All in `window.frames_drawn`; in `window.pictures` those before which viser's worker handed something new over.
        """
        self.before_pages(COUNT_PICTURES)

    def shot(self) -> bytes:
        """A picture of the page, as PNG."""
        return base64.b64decode(self.do("Page.captureScreenshot", format="png")["data"])

    def printed(self) -> bytes:
        """The page on paper, as PDF."""
        return base64.b64decode(self.do("Page.printToPDF", printBackground=True)["data"])

    def complaints(self) -> list[str]:
        """Errors on the page's console, and what the browser refused."""
        messages = []
        for event in self.events:
            if event.get("method") == "Runtime.exceptionThrown":
                messages.append(
                    event["params"]["exceptionDetails"].get("text", "")
                    + str(event["params"]["exceptionDetails"].get("exception", {}).get("description"))
                )
            if event.get("method") == "Log.entryAdded" and event["params"]["entry"]["level"] == "error":
                messages.append(event["params"]["entry"]["text"] + " " + event["params"]["entry"].get("url", ""))
            if event.get("method") == "Runtime.consoleAPICalled" and event["params"]["type"] == "error":
                messages.append(str([argument.get("value") for argument in event["params"]["args"]]))
        return messages
