"""Checks the dashboard in Chromium, driven over the DevTools protocol.

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
        sys.exit("chromium: not installed; the dashboard is not checked")
    if args.pictures:
        args.pictures.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        reveille, here = args.reveille.resolve(), Path(folder)
        if args.minutes:
            with live_dashboard(reveille, here, args.devices, "1ms") as page:
                measure_memory(page, args.minutes)
            return
        with live_dashboard(reveille, here, DEVICES, "4ms") as page:
            check_live_run(page, args.pictures)
        with comparison_dashboard(reveille, here) as page:
            check_comparison(page, args.pictures)


class Page:
    """A page of Chromium, driven over the DevTools protocol."""

    def __init__(self, port):
        target = wait(lambda: next(t for t in json.load(urllib.request.urlopen(f"http://127.0.0.1:{port}/json")) if t["type"] == "page"))
        self.socket = create_connection(target["webSocketDebuggerUrl"], timeout=30, suppress_origin=True)
        self.last_id, self.console_messages = 0, []
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method, **params):
        self.last_id += 1
        self.socket.send(json.dumps({"id": self.last_id, "method": method, "params": params}))
        while True:
            message = json.loads(self.socket.recv())
            if message.get("id") == self.last_id:
                assert "error" not in message, (method, message)
                return message["result"]
            kind = message.get("method")
            if kind == "Runtime.exceptionThrown":
                self.console_messages.append(message["params"]["exceptionDetails"])
            elif kind == "Log.entryAdded" and message["params"]["entry"]["level"] in ("error", "warning"):
                self.console_messages.append(message["params"]["entry"])
            elif kind == "Runtime.consoleAPICalled" and message["params"]["type"] in ("error", "warning"):
                self.console_messages.append(message["params"])

    def evaluate(self, expression):
        result = self.call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in result, (expression, result)
        return result["result"].get("value")

    def wait_for(self, expression, patience=20):
        return wait(lambda: self.evaluate(expression), patience)

    def press(self, key, code=None, modifiers=0):
        text = {"text": key} if len(key) == 1 else {}
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, code=code or key, modifiers=modifiers, **(text if kind == "keyDown" else {}))

    def click(self, x, y):
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def set_size(self, width, height, scheme):
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 600)
        self.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])

    def save_picture(self, path):
        self.evaluate("new Promise((go) => requestAnimationFrame(() => requestAnimationFrame(go)))")
        data = self.call("Page.captureScreenshot", captureBeyondViewport=False)["data"]
        path.write_bytes(base64.b64decode(data))


@contextlib.contextmanager
def started(here, name, *command):
    """Starts a process and yields the address that it prints."""
    stderr = here / name
    process = subprocess.Popen(command, cwd=here, stdout=subprocess.DEVNULL, stderr=stderr.open("w"))
    try:
        yield wait(lambda: next((word.strip(";") for word in stderr.read_text().split() if word.startswith("http://")), None), 60)
    finally:
        if process.poll() is not None:
            print(f"process ended early: {' '.join(map(str, command))}\n{stderr.read_text()}", file=sys.stderr)
        process.kill()
        process.wait()


@contextlib.contextmanager
def opened(here, url):
    """Opens the page at an address; fails if the console holds any message at the end."""
    port = free_port()
    browser = subprocess.Popen(
        ["chromium", "--headless=new", "--no-sandbox", "--disable-gpu", f"--remote-debugging-port={port}",
         f"--user-data-dir={here / 'profile'}", "--window-size=1280,900", "about:blank"],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )
    try:
        page = Page(port)
        page.set_size(1280, 900, "light")
        page.call("Page.navigate", url=url)
        yield page
        assert not page.console_messages, page.console_messages
    finally:
        browser.kill()
        browser.wait()


@contextlib.contextmanager
def live_dashboard(reveille, here, devices, pace):
    run = f"up -p knn -n {devices} -k 10000000 -P 3 --pace {pace} --quiet --out out --dashboard 127.0.0.1:0".split()
    with started(here, "live", reveille, *run) as url, opened(here, url) as page:
        page.wait_for("window.reveille?.moment && window.reveille.now.next > 300", 60)
        yield page


@contextlib.contextmanager
def comparison_dashboard(reveille, here):
    for seed in (1, 2):
        run = f"run -p age-index -n 60 -k 900 --set seed={seed} --record {seed}.mcap --quiet --out of-{seed}".split()
        subprocess.run([reveille, *run], cwd=here, check=True, stdout=subprocess.DEVNULL)
    comparison = subprocess.run([reveille, "inspect", "compare", "1.mcap", "2.mcap"], cwd=here, capture_output=True, text=True)
    assert comparison.returncode == 1, comparison
    first_difference = next(line for line in comparison.stdout.splitlines() if line.startswith("first difference"))
    command = "dashboard --from 1.mcap --compare 2.mcap --listen 127.0.0.1:0".split()
    with started(here, "comparison", reveille, *command) as url, opened(here, url) as page:
        page.first_difference = first_difference.split()[2:6]
        yield page


def check_comparison(page, pictures):
    """Compares two seeds: the first difference equals the one in `inspect compare`, and a click shows its TTI."""
    page.wait_for("document.querySelectorAll('#differences li').length > 0")
    kind, tti = page.first_difference[0], page.first_difference[3].strip(",")
    difference = page.evaluate("document.querySelector('#differences li').textContent")
    assert f"first difference: {kind}" in difference and f"TTI {tti} " in difference, (page.first_difference, difference)
    assert "seed: 1, other 2" in page.evaluate("document.getElementById('fields').textContent")
    assert not page.evaluate("reveille.run.controls")
    page.evaluate("document.querySelectorAll('#differences button')[1].click()")
    page.wait_for("reveille.moment && reveille.other.moment && reveille.moment.tti === reveille.other.moment.tti")
    # A TTI with a belief over several places and a true event, in both recordings.
    found = page.evaluate(
        "(async () => { for (let k = 100; k < 900; k++) {"
        " const [a, b] = await Promise.all(['', 'other/'].map((of) => fetch(`api/${of}tti/${k}`).then((r) => r.json())));"
        " if (a.belief?.length > 1 && a.event) return [k, a.belief.reduce((sum, p) => sum + p.share, 0), b.states.length]; } })()"
    )
    assert found, "no TTI with a belief over several places and an event"
    belief_tti, share_sum, device_count = found
    assert abs(share_sum - 1) < 1e-3 and device_count == 60, found
    page.evaluate(f"(() => {{ const t = document.getElementById('tti'); t.value = {belief_tti}; t.dispatchEvent(new Event('change')); }})()")
    page.wait_for(f"reveille.moment.tti === {belief_tti} && reveille.moment.belief.length > 1")
    # The filters of `inspect tail`.
    page.evaluate(
        "(() => { const f = document.getElementById('filters'); f.here.checked = false; f.kind.value = 'wake'; f.state.value = 'S4'; f.requestSubmit(); })()"
    )
    page.wait_for("[...document.querySelectorAll('#messages tbody tr')].every((r) => r.cells[2].textContent === 'wake') && document.querySelectorAll('#messages tbody tr').length > 3")
    page.evaluate("(() => { const f = document.getElementById('filters'); f.state.value = ''; f.kind.value = 'nonsense'; f.requestSubmit(); })()")
    page.wait_for("document.getElementById('refused').textContent.includes('no such kind')")
    page.evaluate("(() => { const f = document.getElementById('filters'); f.kind.value = ''; f.here.checked = true; f.requestSubmit(); })()")
    page.wait_for("document.getElementById('refused').textContent === ''")
    # The browser's log holds the refused request and nothing else.
    page.console_messages = [entry for entry in page.console_messages if "400" not in entry.get("text", "")]
    for name, width, height, scheme in [("compare", 1280, 900, "light"), ("compare-phone", 390, 844, "dark")]:
        page.set_size(width, height, scheme)
        time.sleep(0.3)
        wide = page.evaluate("document.documentElement.scrollWidth")
        assert wide <= width, f"{name}: {wide} pixels wide"
        if pictures:
            page.save_picture(pictures / f"{name}.png")
    print(f"two seeds: {difference.split(chr(10))[0][:60]}")


def measure_memory(page, minutes):
    """Watches a long run and measures the page's updates and memory."""
    start = time.monotonic()
    updates, interval_start = page.evaluate("reveille.updates"), start
    sizes = []
    while time.monotonic() < start + 60 * minutes:
        time.sleep(min(30, 15 * minutes))
        page.call("HeapProfiler.collectGarbage")
        size = page.call("Runtime.getHeapUsage")["usedSize"] / 1e6
        sizes.append(size)
        update_count, tti = page.evaluate("[reveille.updates, reveille.now.next]")
        print(f"{time.monotonic() - start:6.0f} s  TTI {tti:8}  {(update_count - updates) / (time.monotonic() - interval_start):5.1f} updates a second  {size:6.1f} MB", flush=True)
        updates, interval_start = update_count, time.monotonic()
    quarter = max(len(sizes) // 4, 1)
    mean_before, mean_after = sum(sizes[:quarter]) / quarter, sum(sizes[-quarter:]) / quarter
    assert mean_after < mean_before * 1.2 + 2, f"the page has grown from {mean_before:.1f} to {mean_after:.1f} MB"


def check_live_run(page, pictures):
    assert page.evaluate("reveille.run.positions.length") == DEVICES
    assert page.evaluate("reveille.moment.states.length") == DEVICES
    is_local = page.evaluate("performance.getEntriesByType('resource').every((r) => r.name.startsWith(location.origin))")
    assert is_local, "something is loaded from elsewhere"
    script = (
        "(() => { const m = document.getElementById('map'), d = m.getContext('2d').getImageData(0, 0, m.width, m.height).data;"
        " const seen = new Set(); for (let i = 0; i < d.length; i += 4) seen.add(d[i] << 16 | d[i + 1] << 8 | d[i + 2]); return seen.size; })()"
    )
    # States arrive before they are painted.
    until = time.monotonic() + 5
    while (painted := page.evaluate(script)) <= 50:
        assert time.monotonic() < until, f"{painted} colours on the map"
        time.sleep(0.05)
    before, start = page.evaluate("reveille.updates"), time.monotonic()
    time.sleep(3)
    rate = (page.evaluate("reveille.updates") - before) / (time.monotonic() - start)
    assert rate >= 15, f"{rate:.1f} updates a second"
    page.wait_for("document.querySelectorAll('#ticker li').length > 0")
    page.evaluate("document.getElementById('pause').click()")
    page.wait_for("document.getElementById('said').textContent.startsWith('paused')")
    page.wait_for("document.getElementById('pause').textContent === 'Resume'")
    time.sleep(0.5)
    paused_at = page.evaluate("reveille.now.next")
    time.sleep(1)
    assert page.evaluate("reveille.now.next") == paused_at, "the clock advanced while paused"
    page.evaluate("document.getElementById('step').click()")
    page.wait_for(f"reveille.now.next === {paused_at + 1}")
    page.evaluate("(() => { document.getElementById('pace').value = 7; document.getElementById('set-pace').click(); })()")
    page.wait_for("document.getElementById('said').textContent.endsWith('a TTI every 7ms')")
    # Moves back by a hundred TTIs and compares the states shown.
    page.evaluate(
        f"(() => {{ const s = document.getElementById('scrubber'); s.value = {paused_at - 100}; s.dispatchEvent(new Event('input')); }})()"
    )
    page.wait_for(f"reveille.tti === {paused_at - 100} && reveille.moment.tti === {paused_at - 100}")
    is_same_state = page.evaluate(
        f"fetch('api/tti/{paused_at - 100}').then((a) => a.json()).then((m) => m.states === reveille.moment.states && m.batteries === reveille.moment.batteries)"
    )
    assert is_same_state, "the page shows other states than the server"
    page.press("ArrowLeft")
    page.wait_for(f"reveille.moment.tti === {paused_at - 101}")
    page.press("ArrowRight", modifiers=8)
    page.wait_for(f"reveille.moment.tti === {paused_at - 91}")
    page.press("b")
    page.wait_for("document.querySelectorAll('#marks button').length === 1")
    # Opens a device by a click on the map, then a message with its bytes.
    x, y = page.evaluate(
        "(() => { const b = document.getElementById('map').getBoundingClientRect(), [w, h] = reveille.run.area, p = reveille.run.positions[7];"
        " return [b.left + 10 + p.x / w * (b.width - 20), b.bottom - 10 - p.y / h * (b.height - 20)]; })()"
    )
    page.click(x, y)
    page.wait_for("reveille.device === 7 && !document.getElementById('one').hidden")
    page.wait_for("document.getElementById('ledger').textContent.includes('S4')")
    page.wait_for("document.querySelectorAll('#messages tbody tr').length > 0")
    if pictures:
        page.save_picture(pictures / "desktop-light.png")
    page.evaluate("document.querySelector('#messages tbody tr').click()")
    page.wait_for("document.getElementById('detail').open && document.getElementById('hex').textContent.length > 3")
    page.evaluate("document.getElementById('detail').close()")
    for name, width, height, scheme in [
        ("desktop-dark", 1280, 900, "dark"), ("phone-light", 390, 844, "light"), ("phone-dark", 390, 844, "dark"),
    ]:
        page.set_size(width, height, scheme)
        time.sleep(0.3)
        wide = page.evaluate("document.documentElement.scrollWidth")
        assert wide <= width, f"{name}: {wide} pixels wide"
        if pictures:
            page.save_picture(pictures / f"{name}.png")
    page.evaluate("document.getElementById('follow').click()")
    page.evaluate("document.getElementById('pause').click()")
    page.wait_for(f"reveille.now.next > {paused_at + 50}")
    print(f"{DEVICES} devices, {rate:.0f} updates a second, nothing on the console")


def free_port():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def wait(poll, patience=20):
    deadline, error = time.monotonic() + patience, None
    while time.monotonic() < deadline:
        try:
            value = poll()
            if value:
                return value
        except (OSError, StopIteration) as exception:
            error = exception
        time.sleep(0.1)
    raise AssertionError(f"no result after {patience} s: {error}")


if __name__ == "__main__":
    main()
