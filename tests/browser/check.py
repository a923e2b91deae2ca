"""Checks the dashboard in Chromium, driven over the DevTools protocol.

    python tests/browser/check.py target/release/reveille [--pictures FOLDER]

Needs `chromium` and the package websocket-client. The page loads without a console message, the map shows every device,
and an event appears. Pause stops the clock, and step moves it by one. The scrubber goes back and shows that TTI's
states; a device's history and a message open; the keyboard works. The checks cover desktop and phone size, light and
dark. For two recordings the page names the first difference and shows both side by side with the beliefs of the base
stations.

    python tests/browser/check.py target/release/reveille --minutes 10 [--devices 2500]

watches a run for this time instead. It prints updates per second and the page's memory, which must not grow.
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
        sys.exit("chromium: not installed; dashboard not checked")
    if args.pictures:
        args.pictures.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        reveille, folder = args.reveille.resolve(), Path(folder)
        if args.minutes:
            with live_page(reveille, folder, args.devices, "1ms") as page:
                check_memory(page, args.minutes)
            return
        with live_page(reveille, folder, DEVICES, "4ms") as page:
            check_live_page(page, args.pictures)
        with comparison_page(reveille, folder) as page:
            check_comparison(page, args.pictures)


class Page:
    """A page of Chromium, driven over the DevTools protocol."""

    def __init__(self, port):
        list_url = f"http://127.0.0.1:{port}/json"
        target = wait_for(lambda: next(t for t in json.load(urllib.request.urlopen(list_url)) if t["type"] == "page"))
        self.socket = create_connection(target["webSocketDebuggerUrl"], timeout=30, suppress_origin=True)
        self.call_id, self.console_messages = 0, []
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method, **params):
        self.call_id += 1
        self.socket.send(json.dumps({"id": self.call_id, "method": method, "params": params}))
        while True:
            message = json.loads(self.socket.recv())
            if message.get("id") == self.call_id:
                assert "error" not in message, (method, message)
                return message["result"]
            event, params = message.get("method"), message.get("params")
            if event == "Runtime.exceptionThrown":
                self.console_messages.append(params["exceptionDetails"])
            elif event == "Log.entryAdded" and params["entry"]["level"] in ("error", "warning"):
                self.console_messages.append(params["entry"])
            elif event == "Runtime.consoleAPICalled" and params["type"] in ("error", "warning"):
                self.console_messages.append(params)

    def value(self, script):
        """Returns the value of a JavaScript expression."""
        result = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in result, (script, result)
        return result["result"].get("value")

    def wait_until(self, script, patience=20):
        return wait_for(lambda: self.value(script), patience)

    def press(self, key, code=None, modifiers=0):
        text = {"text": key} if len(key) == 1 else {}
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, code=code or key, modifiers=modifiers, **(text if kind == "keyDown" else {}))

    def click(self, x, y):
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def emulate_screen(self, width, height, scheme):
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 600)
        self.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])

    def take_picture(self, path):
        # The second frame shows all changes.
        self.value("new Promise((go) => requestAnimationFrame(() => requestAnimationFrame(go)))")
        data = self.call("Page.captureScreenshot", captureBeyondViewport=False)["data"]
        path.write_bytes(base64.b64decode(data))


@contextlib.contextmanager
def running(folder, log_name, *command):
    """Starts a process and yields the address that it prints."""
    log = folder / log_name
    process = subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL, stderr=log.open("w"))

    def address():
        return next((word.strip(";") for word in log.read_text().split() if word.startswith("http://")), None)

    try:
        yield wait_for(address, 60)
    finally:
        if process.poll() is not None:
            print(f"process ended early: {' '.join(map(str, command))}\n{log.read_text()}", file=sys.stderr)
        process.kill()
        process.wait()


@contextlib.contextmanager
def opened_page(folder, url):
    """Opens the page at an address; fails if the console has an error or a warning at the end."""
    port = free_port()
    browser = subprocess.Popen(
        ["chromium", "--headless=new", "--no-sandbox", "--disable-gpu", f"--remote-debugging-port={port}",
         f"--user-data-dir={folder / 'profile'}", "--window-size=1280,900", "about:blank"],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )
    try:
        page = Page(port)
        page.emulate_screen(1280, 900, "light")
        page.call("Page.navigate", url=url)
        yield page
        assert not page.console_messages, page.console_messages
    finally:
        browser.kill()
        browser.wait()


@contextlib.contextmanager
def live_page(reveille, folder, devices, pace):
    """Opens the dashboard of a run in progress."""
    run = f"up -p knn -n {devices} -k 10000000 -P 3 --pace {pace} --quiet --out out --dashboard 127.0.0.1:0".split()
    with running(folder, "run.log", reveille, *run) as url, opened_page(folder, url) as page:
        page.wait_until("window.reveille?.moment && window.reveille.now.next > 300", 60)
        yield page


@contextlib.contextmanager
def comparison_page(reveille, folder):
    """Opens the comparison of two recordings, and adds the words of `inspect compare` about their first difference."""
    for seed in (1, 2):
        run = f"run -p age-index -n 60 -k 900 --set seed={seed} --record {seed}.mcap --quiet --out of-{seed}".split()
        subprocess.run([reveille, *run], cwd=folder, check=True, stdout=subprocess.DEVNULL)
    command = [reveille, "inspect", "compare", "1.mcap", "2.mcap"]
    comparison = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert comparison.returncode == 1, comparison
    first_difference = next(line for line in comparison.stdout.splitlines() if line.startswith("first difference"))
    command = "dashboard --from 1.mcap --compare 2.mcap --listen 127.0.0.1:0".split()
    with running(folder, "comparison.log", reveille, *command) as url, opened_page(folder, url) as page:
        page.first_difference = first_difference.split()[2:6]
        yield page


def check_comparison(page, pictures):
    """Compares two seeds: the first difference equals the one in `inspect compare`, and a click shows its TTI."""
    page.wait_until("document.querySelectorAll('#differences li').length > 0")
    kind, tti = page.first_difference[0], page.first_difference[3].strip(",")
    shown = page.value("document.querySelector('#differences li').textContent")
    assert f"first difference: {kind}" in shown and f"TTI {tti} " in shown, (page.first_difference, shown)
    assert "seed: 1, other 2" in page.value("document.getElementById('fields').textContent")
    assert not page.value("reveille.run.controls")
    page.value("document.querySelectorAll('#differences button')[1].click()")
    page.wait_until("reveille.moment && reveille.other.moment && reveille.moment.tti === reveille.other.moment.tti")
    # A TTI with a belief over several places and a true event, in both recordings.
    found = page.value(
        "(async () => { for (let k = 100; k < 900; k++) {"
        " const [a, b] = await Promise.all(['', 'other/'].map((of) => fetch(`api/${of}tti/${k}`).then((r) => r.json())));"
        " if (a.belief?.length > 1 && a.event) return [k, a.belief.reduce((sum, p) => sum + p.share, 0), b.states.length]; } })()"
    )
    assert found, "no TTI with a belief and an event"
    belief_tti, total_share, states = found
    assert abs(total_share - 1) < 1e-3 and states == 60, f"TTI {belief_tti}: total share {total_share}, {states} states"
    page.value(f"(() => {{ const t = document.getElementById('tti'); t.value = {belief_tti}; t.dispatchEvent(new Event('change')); }})()")
    page.wait_until(f"reveille.moment.tti === {belief_tti} && reveille.moment.belief.length > 1")
    # `inspect tail` has the same filters.
    page.value(
        "(() => { const f = document.getElementById('filters'); f.here.checked = false; f.kind.value = 'wake'; f.state.value = 'S4'; f.requestSubmit(); })()"
    )
    page.wait_until("[...document.querySelectorAll('#messages tbody tr')].every((r) => r.cells[2].textContent === 'wake') && document.querySelectorAll('#messages tbody tr').length > 3")
    page.value("(() => { const f = document.getElementById('filters'); f.state.value = ''; f.kind.value = 'nonsense'; f.requestSubmit(); })()")
    page.wait_until("document.getElementById('refused').textContent.includes('no such kind')")
    page.value("(() => { const f = document.getElementById('filters'); f.kind.value = ''; f.here.checked = true; f.requestSubmit(); })()")
    page.wait_until("document.getElementById('refused').textContent === ''")
    # The browser's log holds the refused request and nothing else.
    page.console_messages = [message for message in page.console_messages if "400" not in message.get("text", "")]
    check_screens(page, pictures, [("compare", 1280, 900, "light"), ("compare-phone", 390, 844, "dark")])
    print(f"two seeds: {shown.split(chr(10))[0][:60]}")


def check_screens(page, pictures, screens):
    """Checks that the page fits screens of these names, widths, heights and colour schemes."""
    for name, width, height, scheme in screens:
        page.emulate_screen(width, height, scheme)
        time.sleep(0.3)
        page_width = page.value("document.documentElement.scrollWidth")
        assert page_width <= width, f"{name}: {page_width} pixels wide"
        if pictures:
            page.take_picture(pictures / f"{name}.png")


def check_memory(page, minutes):
    """Watches a long run and measures the page's updates and memory."""
    start = time.monotonic()
    last_updates, last_time = page.value("reveille.updates"), start
    sizes_mb = []
    while time.monotonic() < start + 60 * minutes:
        time.sleep(min(30, 15 * minutes))
        page.call("HeapProfiler.collectGarbage")
        size_mb = page.call("Runtime.getHeapUsage")["usedSize"] / 1e6
        sizes_mb.append(size_mb)
        updates, tti = page.value("[reveille.updates, reveille.now.next]")
        now = time.monotonic()
        rate = (updates - last_updates) / (now - last_time)
        print(f"{now - start:6.0f} s  TTI {tti:8}  {rate:5.1f} updates a second  {size_mb:6.1f} MB", flush=True)
        last_updates, last_time = updates, now
    quarter = max(len(sizes_mb) // 4, 1)
    first, last = sum(sizes_mb[:quarter]) / quarter, sum(sizes_mb[-quarter:]) / quarter
    # Less than 20 % and 2 MB is noise of the garbage collection.
    assert last < first * 1.2 + 2, f"the page has grown from {first:.1f} to {last:.1f} MB"


def check_live_page(page, pictures):
    """Uses every part of the dashboard of a run in progress."""
    assert page.value("reveille.run.positions.length") == DEVICES
    assert page.value("reveille.moment.states.length") == DEVICES
    is_local = page.value("performance.getEntriesByType('resource').every((r) => r.name.startsWith(location.origin))")
    assert is_local, "the page loads a resource from another server"
    count_colours = (
        "(() => { const m = document.getElementById('map'), d = m.getContext('2d').getImageData(0, 0, m.width, m.height).data;"
        " const seen = new Set(); for (let i = 0; i < d.length; i += 4) seen.add(d[i] << 16 | d[i + 1] << 8 | d[i + 2]); return seen.size; })()"
    )
    # States arrive before they are painted. A painted map has more than 50 colours.
    deadline = time.monotonic() + 5
    while (colours := page.value(count_colours)) <= 50:
        assert time.monotonic() < deadline, f"{colours} colours on the map"
        time.sleep(0.05)
    updates, start = page.value("reveille.updates"), time.monotonic()
    time.sleep(3)
    rate = (page.value("reveille.updates") - updates) / (time.monotonic() - start)
    assert rate >= 15, f"{rate:.1f} updates a second"
    page.wait_until("document.querySelectorAll('#ticker li').length > 0")
    page.value("document.getElementById('pause').click()")
    page.wait_until("document.getElementById('said').textContent.startsWith('paused')")
    page.wait_until("document.getElementById('pause').textContent === 'Resume'")
    time.sleep(0.5)
    paused_tti = page.value("reveille.now.next")
    time.sleep(1)
    assert page.value("reveille.now.next") == paused_tti, "the run continues while it is paused"
    page.value("document.getElementById('step').click()")
    page.wait_until(f"reveille.now.next === {paused_tti + 1}")
    page.value("(() => { document.getElementById('pace').value = 7; document.getElementById('set-pace').click(); })()")
    page.wait_until("document.getElementById('said').textContent.endsWith('a TTI every 7ms')")
    # Moves back by a hundred TTIs and compares the states shown.
    page.value(
        f"(() => {{ const s = document.getElementById('scrubber'); s.value = {paused_tti - 100}; s.dispatchEvent(new Event('input')); }})()"
    )
    page.wait_until(f"reveille.tti === {paused_tti - 100} && reveille.moment.tti === {paused_tti - 100}")
    is_equal = page.value(
        f"fetch('api/tti/{paused_tti - 100}').then((a) => a.json()).then((m) => m.states === reveille.moment.states && m.batteries === reveille.moment.batteries)"
    )
    assert is_equal, "the page shows other states than the server"
    page.press("ArrowLeft")
    page.wait_until(f"reveille.moment.tti === {paused_tti - 101}")
    page.press("ArrowRight", modifiers=8)
    page.wait_until(f"reveille.moment.tti === {paused_tti - 91}")
    page.press("b")
    page.wait_until("document.querySelectorAll('#marks button').length === 1")
    # Opens a device by a click on the map, then a message with its bytes.
    x, y = page.value(
        "(() => { const b = document.getElementById('map').getBoundingClientRect(), [w, h] = reveille.run.area, p = reveille.run.positions[7];"
        " return [b.left + 10 + p.x / w * (b.width - 20), b.bottom - 10 - p.y / h * (b.height - 20)]; })()"
    )
    page.click(x, y)
    page.wait_until("reveille.device === 7 && !document.getElementById('one').hidden")
    page.wait_until("document.getElementById('ledger').textContent.includes('S4')")
    page.wait_until("document.querySelectorAll('#messages tbody tr').length > 0")
    if pictures:
        page.take_picture(pictures / "desktop-light.png")
    page.value("document.querySelector('#messages tbody tr').click()")
    page.wait_until("document.getElementById('detail').open && document.getElementById('hex').textContent.length > 3")
    page.value("document.getElementById('detail').close()")
    check_screens(page, pictures, [
        ("desktop-dark", 1280, 900, "dark"), ("phone-light", 390, 844, "light"), ("phone-dark", 390, 844, "dark"),
    ])
    page.value("document.getElementById('follow').click()")
    page.value("document.getElementById('pause').click()")
    page.wait_until(f"reveille.now.next > {paused_tti + 50}")
    print(f"{DEVICES} devices, {rate:.0f} updates a second, nothing on the console")


def free_port():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def wait_for(poll, patience=20):
    """Returns the first result of `poll` that is true."""
    deadline, last_error = time.monotonic() + patience, None
    while time.monotonic() < deadline:
        try:
            result = poll()
            if result:
                return result
        except (OSError, StopIteration) as error:
            last_error = error
        time.sleep(0.1)
    raise AssertionError(f"no result after {patience} s: {last_error}")


if __name__ == "__main__":
    main()
