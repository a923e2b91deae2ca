"""The dashboard in a real browser: Chromium, driven over the DevTools protocol.

    python tests/browser/check.py target/release/reveille [--pictures FOLDER]

Needs `chromium` and the package websocket-client. The page loads without a message on the console, the map shows every
device, an event appears, pause stops the clock, step moves it by one, the scrubber goes back and shows that TTI's states,
a device's history and a message open, the keyboard works; at desktop and phone size, light and dark.
"""

import argparse
import base64
import json
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

from websocket import create_connection

DEVICES = 250


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("reveille", type=Path)
    parser.add_argument("--pictures", type=Path, help="keep screenshots in this folder")
    args = parser.parse_args()
    if not shutil.which("chromium"):
        sys.exit("chromium is not here: not checked")
    if args.pictures:
        args.pictures.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        check(args.reveille.resolve(), Path(folder), args.pictures)


class Page:
    """A page of Chromium, driven over the DevTools protocol."""

    def __init__(self, port):
        target = wait(lambda: next(t for t in json.load(urllib.request.urlopen(f"http://127.0.0.1:{port}/json")) if t["type"] == "page"))
        self.socket = create_connection(target["webSocketDebuggerUrl"], timeout=30, suppress_origin=True)
        self.number, self.complaints = 0, []
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method, **params):
        self.number += 1
        self.socket.send(json.dumps({"id": self.number, "method": method, "params": params}))
        while True:
            told = json.loads(self.socket.recv())
            if told.get("id") == self.number:
                assert "error" not in told, (method, told)
                return told["result"]
            kind = told.get("method")
            if kind == "Runtime.exceptionThrown":
                self.complaints.append(told["params"]["exceptionDetails"])
            elif kind == "Log.entryAdded" and told["params"]["entry"]["level"] in ("error", "warning"):
                self.complaints.append(told["params"]["entry"])
            elif kind == "Runtime.consoleAPICalled" and told["params"]["type"] in ("error", "warning"):
                self.complaints.append(told["params"])

    def value(self, text):
        told = self.call("Runtime.evaluate", expression=text, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in told, (text, told)
        return told["result"].get("value")

    def until(self, text, patience=20):
        return wait(lambda: self.value(text), patience)

    def press(self, key, code=None, modifiers=0):
        text = {"text": key} if len(key) == 1 else {}
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, code=code or key, modifiers=modifiers, **(text if kind == "keyDown" else {}))

    def click(self, x, y):
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def shape(self, width, height, scheme):
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 600)
        self.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])

    def picture(self, path):
        self.value("new Promise((go) => requestAnimationFrame(() => requestAnimationFrame(go)))")
        data = self.call("Page.captureScreenshot", captureBeyondViewport=False)["data"]
        path.write_bytes(base64.b64decode(data))


def check(reveille, here, pictures):
    run = subprocess.Popen(
        [reveille, *f"up -p knn -n {DEVICES} -k 100000 -P 3 --pace 4ms --quiet --out out --dashboard 127.0.0.1:0".split()],
        cwd=here, stdout=subprocess.DEVNULL, stderr=(here / "said").open("w"),
    )
    port = free_port()
    browser = None
    try:
        url = wait(lambda: next((word.strip(";") for word in (here / "said").read_text().split() if word.startswith("http://")), None))
        browser = subprocess.Popen(
            ["chromium", "--headless=new", "--no-sandbox", "--disable-gpu", f"--remote-debugging-port={port}",
             f"--user-data-dir={here / 'profile'}", "--window-size=1280,900", "about:blank"],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )
        page = Page(port)
        page.shape(1280, 900, "light")
        page.call("Page.navigate", url=url)
        page.until("window.reveille?.moment && window.reveille.now.next > 300")
        look(page, pictures)
        assert not page.complaints, page.complaints
    finally:
        for process in (browser, run):
            if process:
                process.kill()
                process.wait()


def look(page, pictures):
    assert page.value("reveille.run.positions.length") == DEVICES
    assert page.value("reveille.moment.states.length") == DEVICES
    loaded = page.value("performance.getEntriesByType('resource').every((r) => r.name.startsWith(location.origin))")
    assert loaded, "something is loaded from elsewhere"
    painted = page.value(
        "(() => { const m = document.getElementById('map'), d = m.getContext('2d').getImageData(0, 0, m.width, m.height).data;"
        " const seen = new Set(); for (let i = 0; i < d.length; i += 4) seen.add(d[i] << 16 | d[i + 1] << 8 | d[i + 2]); return seen.size; })()"
    )
    assert painted > 50, f"{painted} colours on the map"
    before, start = page.value("reveille.updates"), time.monotonic()
    time.sleep(3)
    rate = (page.value("reveille.updates") - before) / (time.monotonic() - start)
    assert rate >= 15, f"{rate:.1f} updates a second"
    page.until("document.querySelectorAll('#ticker li').length > 0")
    # The clock.
    page.value("document.getElementById('pause').click()")
    page.until("document.getElementById('said').textContent.startsWith('paused')")
    page.until("document.getElementById('pause').textContent === 'go on'")
    time.sleep(0.5)
    stood = page.value("reveille.now.next")
    time.sleep(1)
    assert page.value("reveille.now.next") == stood, "paused"
    page.value("document.getElementById('step').click()")
    page.until(f"reveille.now.next === {stood + 1}")
    # Back by a hundred TTIs, with the states of that one.
    page.value(
        f"(() => {{ const s = document.getElementById('scrubber'); s.value = {stood - 100}; s.dispatchEvent(new Event('input')); }})()"
    )
    page.until(f"reveille.tti === {stood - 100} && reveille.moment.tti === {stood - 100}")
    same = page.value(
        f"fetch('api/tti/{stood - 100}').then((a) => a.json()).then((m) => m.states === reveille.moment.states && m.batteries === reveille.moment.batteries)"
    )
    assert same
    page.press("ArrowLeft")
    page.until(f"reveille.moment.tti === {stood - 101}")
    page.press("ArrowRight", modifiers=8)
    page.until(f"reveille.moment.tti === {stood - 91}")
    page.press("b")
    page.until("document.querySelectorAll('#marks button').length === 1")
    # A device, by a click on the map, and a message with its bytes.
    x, y = page.value(
        "(() => { const b = document.getElementById('map').getBoundingClientRect(), [w, h] = reveille.run.area, p = reveille.run.positions[7];"
        " return [b.left + 10 + p.x / w * (b.width - 20), b.bottom - 10 - p.y / h * (b.height - 20)]; })()"
    )
    page.click(x, y)
    page.until("reveille.device === 7 && !document.getElementById('one').hidden")
    page.until("document.getElementById('ledger').textContent.includes('S4')")
    page.until("document.querySelectorAll('#messages tbody tr').length > 0")
    if pictures:
        page.picture(pictures / "desktop-light.png")
    page.value("document.querySelector('#messages tbody tr').click()")
    page.until("document.getElementById('detail').open && document.getElementById('hex').textContent.length > 3")
    page.value("document.getElementById('detail').close()")
    for name, width, height, scheme in [
        ("desktop-dark", 1280, 900, "dark"), ("phone-light", 390, 844, "light"), ("phone-dark", 390, 844, "dark"),
    ]:
        page.shape(width, height, scheme)
        time.sleep(0.3)
        wide = page.value("document.documentElement.scrollWidth")
        assert wide <= width, f"{name}: {wide} pixels wide"
        if pictures:
            page.picture(pictures / f"{name}.png")
    page.value("document.getElementById('follow').click()")
    page.value("document.getElementById('pause').click()")
    page.until(f"reveille.now.next > {stood + 50}")
    print(f"{DEVICES} devices, {rate:.0f} updates a second, nothing on the console")


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def wait(look, patience=20):
    end, error = time.monotonic() + patience, None
    while time.monotonic() < end:
        try:
            found = look()
            if found:
                return found
        except (OSError, StopIteration) as one:
            error = one
        time.sleep(0.1)
    raise AssertionError(f"waited in vain: {error}")


if __name__ == "__main__":
    main()
