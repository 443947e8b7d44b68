"""The viewer's page in a browser tab, and a server for it."""

from __future__ import annotations

import base64
import io
import json
import threading
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio

from clod_adapter.cli.main import build_parser
from clod_adapter.cli.shared.console import Console
from clod_adapter.cli.view import make_page
from clod_adapter.viewer.page import camera_entry
from clod_adapter.viewer.server import Server

SIZE = {"width": 400, "height": 320}
TALL = {"width": 640, "height": 600}  # the whole panel is shown
WITHIN = 45.0  # dB between the page and our renderer
COUNTS = 1e-3  # of the count
SECONDS = 10  # until waiting ends


@dataclass
class Shown:
    """The page in a tab; its methods wait until their change is drawn."""

    page: Any
    errors: list[str] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)

    def __post_init__(self):
        self.page.on(
            "console", lambda message: message.type == "error" and self.errors.append(message.text)
        )
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))

    def ready(self, url):
        self.page.goto(url)
        self.run("clod.ready")
        return self

    def run(self, script, *arguments):
        waiting = (
            f"async (given) => {{ const r = await {script}; await clod.whenDrawn(); return r }}"
        )
        return self.evaluate(waiting, *arguments)

    def until(self, condition):
        """Waits until it holds. Not Playwright's wait_for_function, which the page's policy forbids
        to evaluate.
        """
        script = f"""() => new Promise((resolve, reject) => {{
            const late = new Error("never " + {json.dumps(condition)});
            const ended = setTimeout(() => reject(late), {SECONDS}000);
            const found = () => (clearTimeout(ended), resolve());
            const look = () => ({condition}) ? found() : setTimeout(look, 20);
            look();
        }})"""
        self.evaluate(script)

    def evaluate(self, script, *arguments):
        return self.page.evaluate(script, *arguments)

    def press(self, key):
        self.page.keyboard.press(key)

    @property
    def dial(self):
        """The dial value, as the page writes it."""
        return self.text("#dial-value")

    def text(self, selector):
        return str(self.page.inner_text(selector))

    def camera(self, camera):
        self.run("clod.setCamera(given)", camera_entry(camera))

    def picture(self):
        """``[H, W, 3]`` uint8 of the splats alone at full resolution."""
        return decoded(self.run("clod.capture()").partition(",")[2])

    def link(self):
        """The state of the page, as the part of its address that L adds."""
        self.press("l")
        return str(self.evaluate("location.hash"))

    def counts(self):
        return dict(self.evaluate("clod.whenDrawn().then(clod.counts)"))


def decoded(data):
    """``[H, W, 3]`` uint8 of an image in base64."""
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))


def assert_alike(picture, wanted):
    """Asserts a PSNR of at least WITHIN between two pictures ``[H, W, 3]`` uint8."""
    assert peak_signal_noise_ratio(wanted, picture) >= WITHIN


def assert_same(shown, wanted):
    """Asserts that the page shows the picture of our renderer and counts the same Gaussians."""
    counts = shown.counts()
    kept = int(wanted.kept.sum())
    assert_alike(shown.picture(), wanted.pixels.numpy())
    assert abs(counts["kept"] - kept) <= COUNTS * kept and counts["total"] == len(wanted.kept)


def drop(shown, name, data, *, wait=0):
    """Drops a file on the page that can be read after ``wait`` milliseconds; a name without a
    suffix never can be.
    """
    script = """([name, data, wait]) => {
        const bytes = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
        const file = new File([bytes], name);
        const read = file.arrayBuffer.bind(file), refused = new DOMException("");
        const later = new Promise((resolve) => setTimeout(resolve, wait));
        const answer = () => name.includes(".") ? read() : Promise.reject(refused);
        file.arrayBuffer = () => later.then(answer);
        const event = new DragEvent("drop", { bubbles: true, cancelable: true });
        Object.defineProperty(event, "dataTransfer", { value: { files: [file] } });
        document.body.dispatchEvent(event);
    }"""
    shown.evaluate(script, [name, base64.b64encode(data).decode(), wait])


def message(shown, name):
    """The page's error message about the file, once there is one; the message is then dismissed."""
    shown.until(f"document.getElementById('message').textContent.includes('{name}')")
    said = shown.text("#message")
    shown.page.click("#dismiss")
    assert shown.page.is_hidden("#message")
    return said


def fold(shown, open):
    shown.page.set_viewport_size(TALL if open else SIZE)
    expanded = json.dumps(str(open).lower())
    script = f"fold => fold.getAttribute('aria-expanded') === {expanded} || fold.click()"
    shown.page.eval_on_selector("#fold", script)


def take(shown, path):
    """Shows another file in the tab, by the page's own function, and waits until it is drawn."""
    script = (
        "clod.load(Uint8Array.from(atob(given[1]), (letter) => letter.charCodeAt(0)).buffer,"
        " given[0])"
    )
    shown.run(script, [path.name, base64.b64encode(path.read_bytes()).decode()])


@contextmanager
def serve(*words):
    """The address of a server of ``clod-adapt view`` with these arguments, by default at s = 1,
    where it stays.
    """
    given = [str(word) for word in words]
    given += [] if "--sv" in given or "--device-preset" in given else ["--sv", "1"]
    answers, _ = make_page(build_parser("view").parse_args(given), Console(quiet=True))
    with Server(answers) as server:
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        yield server.url
        server.shutdown()
