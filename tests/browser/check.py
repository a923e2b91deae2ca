"""The dashboard in a real browser: Chromium, driven over the DevTools protocol.

    python tests/browser/check.py target/release/reveille [--pictures FOLDER]

Needs `chromium` and the package websocket-client. The page loads without a console message, the map shows every device,
and an event appears. Pause stops the clock, and step moves it by one. The scrubber goes back and shows that TTI's
states; a device's history and a message open; the keyboard works. The checks cover desktop and phone size, light and
dark. For two recordings the page names the first difference and shows both side by side with the beliefs of the base
stations.

    python tests/browser/check.py target/release/reveille --minutes 10 [--devices 2500]

watches a run for this time instead; prints updates per second and the page's memory, which must not grow.
"""

import argparse
import base64
import contextlib
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
    parser.add_argument("--minutes", type=float, help="watch a run and measure the memory of the page")
    parser.add_argument("--devices", type=int, default=DEVICES)
    parser.add_argument("--pictures", type=Path, help="keep screenshots in this folder")
    args = parser.parse_args()
    if not shutil.which("chromium"):
        sys.exit("chromium is not here: not checked")
    if args.pictures:
        args.pictures.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        reveille, here = args.reveille.resolve(), Path(folder)
        if args.minutes:
            with live(reveille, here, args.devices, "1ms") as page:
                watch(page, args.minutes)
            return
        with live(reveille, here, DEVICES, "4ms") as page:
            look(page, args.pictures)
        with compared(reveille, here) as page:
            compare(page, args.pictures)


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


@contextlib.contextmanager
def started(here, name, *command):
    """Starts a process and yields the address that it prints."""
    said = here / name
    process = subprocess.Popen(command, cwd=here, stdout=subprocess.DEVNULL, stderr=said.open("w"))
    try:
        yield wait(lambda: next((word.strip(";") for word in said.read_text().split() if word.startswith("http://")), None), 60)
    finally:
        if process.poll() is not None:
            print(f"process ended early: {' '.join(map(str, command))}\n{said.read_text()}", file=sys.stderr)
        process.kill()
        process.wait()


@contextlib.contextmanager
def browsed(here, url):
    """Opens the page at an address; fails if the console holds any message at the end."""
    port = free_port()
    browser = subprocess.Popen(
        ["chromium", "--headless=new", "--no-sandbox", "--disable-gpu", f"--remote-debugging-port={port}",
         f"--user-data-dir={here / 'profile'}", "--window-size=1280,900", "about:blank"],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )
    try:
        page = Page(port)
        page.shape(1280, 900, "light")
        page.call("Page.navigate", url=url)
        yield page
        assert not page.complaints, page.complaints
    finally:
        browser.kill()
        browser.wait()


@contextlib.contextmanager
def live(reveille, here, devices, pace):
    run = f"up -p knn -n {devices} -k 10000000 -P 3 --pace {pace} --quiet --out out --dashboard 127.0.0.1:0".split()
    with started(here, "said", reveille, *run) as url, browsed(here, url) as page:
        page.until("window.reveille?.moment && window.reveille.now.next > 300", 60)
        yield page


@contextlib.contextmanager
def compared(reveille, here):
    for seed in (1, 2):
        run = f"run -p age-index -n 60 -k 900 --set seed={seed} --record {seed}.mcap --quiet --out of-{seed}".split()
        subprocess.run([reveille, *run], cwd=here, check=True, stdout=subprocess.DEVNULL)
    told = subprocess.run([reveille, "inspect", "compare", "1.mcap", "2.mcap"], cwd=here, capture_output=True, text=True)
    assert told.returncode == 1, told
    first = next(line for line in told.stdout.splitlines() if line.startswith("first difference"))
    command = "dashboard --from 1.mcap --compare 2.mcap --listen 127.0.0.1:0".split()
    with started(here, "comparison", reveille, *command) as url, browsed(here, url) as page:
        page.first = first.split()[2:6]
        yield page


def compare(page, pictures):
    """Compares two seeds: the first difference equals the one in `inspect compare`, and a click shows its TTI."""
    page.until("document.querySelectorAll('#differences li').length > 0")
    kind, tti = page.first[0], page.first[3].strip(",")
    said = page.value("document.querySelector('#differences li').textContent")
    assert f"first difference: {kind}" in said and f"TTI {tti} " in said, (page.first, said)
    assert "seed: 1, other 2" in page.value("document.getElementById('fields').textContent")
    assert not page.value("reveille.run.controls")
    page.value("document.querySelectorAll('#differences button')[1].click()")
    page.until("reveille.moment && reveille.other.moment && reveille.moment.tti === reveille.other.moment.tti")
    # A TTI with a belief over several places and a true event, in both recordings.
    found = page.value(
        "(async () => { for (let k = 100; k < 900; k++) {"
        " const [a, b] = await Promise.all(['', 'other/'].map((of) => fetch(`api/${of}tti/${k}`).then((r) => r.json())));"
        " if (a.belief?.length > 1 && a.event) return [k, a.belief.reduce((sum, p) => sum + p.share, 0), b.states.length]; } })()"
    )
    assert found and abs(found[1] - 1) < 1e-3 and found[2] == 60, found
    page.value(f"(() => {{ const t = document.getElementById('tti'); t.value = {found[0]}; t.dispatchEvent(new Event('change')); }})()")
    page.until(f"reveille.moment.tti === {found[0]} && reveille.moment.belief.length > 1")
    # `inspect tail` has the same filters.
    page.value(
        "(() => { const f = document.getElementById('filters'); f.here.checked = false; f.kind.value = 'wake'; f.state.value = 'S4'; f.requestSubmit(); })()"
    )
    page.until("[...document.querySelectorAll('#messages tbody tr')].every((r) => r.cells[2].textContent === 'wake') && document.querySelectorAll('#messages tbody tr').length > 3")
    page.value("(() => { const f = document.getElementById('filters'); f.state.value = ''; f.kind.value = 'nonsense'; f.requestSubmit(); })()")
    page.until("document.getElementById('refused').textContent.includes('no such kind')")
    page.value("(() => { const f = document.getElementById('filters'); f.kind.value = ''; f.here.checked = true; f.requestSubmit(); })()")
    page.until("document.getElementById('refused').textContent === ''")
    # The browser's log holds the refused request and nothing else.
    page.complaints = [one for one in page.complaints if "400" not in one.get("text", "")]
    for name, width, height, scheme in [("compare", 1280, 900, "light"), ("compare-phone", 390, 844, "dark")]:
        page.shape(width, height, scheme)
        time.sleep(0.3)
        wide = page.value("document.documentElement.scrollWidth")
        assert wide <= width, f"{name}: {wide} pixels wide"
        if pictures:
            page.picture(pictures / f"{name}.png")
    print(f"two seeds: {said.split(chr(10))[0][:60]}")


def watch(page, minutes):
    """Watches a long run and measures the page's updates and memory."""
    start = time.monotonic()
    updates, begun = page.value("reveille.updates"), start
    sizes = []
    while time.monotonic() < start + 60 * minutes:
        time.sleep(min(30, 15 * minutes))
        page.call("HeapProfiler.collectGarbage")
        size = page.call("Runtime.getHeapUsage")["usedSize"] / 1e6
        sizes.append(size)
        now, tti = page.value("[reveille.updates, reveille.now.next]")
        print(f"{time.monotonic() - start:6.0f} s  TTI {tti:8}  {(now - updates) / (time.monotonic() - begun):5.1f} updates a second  {size:6.1f} MB", flush=True)
        updates, begun = now, time.monotonic()
    quarter = max(len(sizes) // 4, 1)
    first, last = sum(sizes[:quarter]) / quarter, sum(sizes[-quarter:]) / quarter
    assert last < first * 1.2 + 2, f"the page has grown from {first:.1f} to {last:.1f} MB"


def look(page, pictures):
    assert page.value("reveille.run.positions.length") == DEVICES
    assert page.value("reveille.moment.states.length") == DEVICES
    loaded = page.value("performance.getEntriesByType('resource').every((r) => r.name.startsWith(location.origin))")
    assert loaded, "something is loaded from elsewhere"
    script = (
        "(() => { const m = document.getElementById('map'), d = m.getContext('2d').getImageData(0, 0, m.width, m.height).data;"
        " const seen = new Set(); for (let i = 0; i < d.length; i += 4) seen.add(d[i] << 16 | d[i + 1] << 8 | d[i + 2]); return seen.size; })()"
    )
    # States arrive before they are painted.
    until = time.monotonic() + 5
    while (painted := page.value(script)) <= 50:
        assert time.monotonic() < until, f"{painted} colours on the map"
        time.sleep(0.05)
    before, start = page.value("reveille.updates"), time.monotonic()
    time.sleep(3)
    rate = (page.value("reveille.updates") - before) / (time.monotonic() - start)
    assert rate >= 15, f"{rate:.1f} updates a second"
    page.until("document.querySelectorAll('#ticker li').length > 0")
    page.value("document.getElementById('pause').click()")
    page.until("document.getElementById('said').textContent.startsWith('paused')")
    page.until("document.getElementById('pause').textContent === 'Resume'")
    time.sleep(0.5)
    stood = page.value("reveille.now.next")
    time.sleep(1)
    assert page.value("reveille.now.next") == stood, "paused"
    page.value("document.getElementById('step').click()")
    page.until(f"reveille.now.next === {stood + 1}")
    page.value("(() => { document.getElementById('pace').value = 7; document.getElementById('set-pace').click(); })()")
    page.until("document.getElementById('said').textContent.endsWith('a TTI every 7ms')")
    # Moves back by a hundred TTIs and compares the states shown.
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
    # Opens a device by a click on the map, then a message with its bytes.
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
    raise AssertionError(f"no result after {patience} s: {error}")


if __name__ == "__main__":
    main()
