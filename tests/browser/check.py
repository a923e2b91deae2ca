"""The dashboard in a real browser: Chromium, driven over the DevTools protocol.

    python tests/browser/check.py target/release/reveille [--pictures FOLDER]

Needs `chromium` and the package websocket-client. The page must load without a console message and control the clock of
a live run. The map, the curves, the timeline, the device panel and the messages are compared with the answers of the
program. Mouse, touch and keyboard, exports, names for assistive technology, contrasts, and desktop and phone sizes in
both colour schemes are checked. For two recordings the page must name the first difference and show both runs. The
looks of the page are not checked: see the pictures.

    python tests/browser/check.py target/release/reveille --minutes 10 [--devices 2500]

watches a run for this time instead; prints updates and paints per second and the memory of the page and of the program.
The page's memory must not grow.

    python tests/browser/check.py target/release/reveille --rates --devices 2500 [--rounds 2]

prints how often the page shows another TTI of a run at full speed, next to a run with 250 devices.
"""

import argparse
import base64
import contextlib
import itertools
import json
import math
import os
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

from websocket import create_connection

DEVICES = 250

# Axes, cluster numbers and the scale bar are painted on canvases: this records their text.
RECORD_PAINTED_TEXT = """
  window.painted = new Set();
  const fillText = CanvasRenderingContext2D.prototype.fillText;
  CanvasRenderingContext2D.prototype.fillText = function (text, ...rest) {
    window.painted.add(String(text));
    return fillText.call(this, text, ...rest);
  };
"""


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("reveille", type=Path)
    parser.add_argument("--minutes", type=float, help="watch a run and measure the memory of the page")
    parser.add_argument("--rates", action="store_true", help="measure the updates of the page at full speed")
    parser.add_argument("--rounds", type=int, default=2, help="measurements of each run with --rates")
    parser.add_argument("--devices", type=int, default=DEVICES)
    parser.add_argument("--pictures", type=Path, help="keep screenshots in this folder")
    args = parser.parse_args()
    if not shutil.which("chromium"):
        sys.exit("chromium is not here: not checked")
    if args.pictures:
        args.pictures.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        reveille, here = args.reveille.resolve(), Path(folder)
        if args.minutes:
            with live(reveille, here, args.devices, "max", usual_range(args.devices)) as page:
                watch(page, args.minutes)
            return
        if args.rates:
            measure_rates(reveille, here, args.devices, args.rounds)
            return
        # A short range and a lossy uplink give missed events, wake-ups and lost reports.
        with live(reveille, here, DEVICES, "4ms", "--set sensing.d_max=2 --set radio.uplink_loss=0.5") as page:
            check_live(page, args.pictures)
        with compared(reveille, here) as page:
            check_comparison(page, args.pictures)
        check_without_token(reveille, here)


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
            message = json.loads(self.socket.recv())
            if message.get("id") == self.number:
                assert "error" not in message, (method, message)
                return message["result"]
            kind = message.get("method")
            if kind == "Runtime.exceptionThrown":
                self.complaints.append(message["params"]["exceptionDetails"])
            elif kind == "Log.entryAdded" and message["params"]["entry"]["level"] in ("error", "warning"):
                self.complaints.append(message["params"]["entry"])
            elif kind == "Runtime.consoleAPICalled" and message["params"]["type"] in ("error", "warning"):
                self.complaints.append(message["params"])

    def value(self, text):
        answer = self.call("Runtime.evaluate", expression=text, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in answer, (text, answer)
        return answer["result"].get("value")

    def until(self, text, patience=20):
        try:
            return wait(lambda: self.value(text), patience)
        except AssertionError as error:
            raise AssertionError(f"{text}: {error}") from error

    def text(self, selector):
        return self.value(f"document.querySelector({selector!r}).textContent")

    def fill(self, selector, value, event="change"):
        self.value(
            f"(() => {{ const field = document.querySelector({selector!r}); field.value = {json.dumps(value)};"
            f" field.dispatchEvent(new Event({event!r}, {{ bubbles: true }})); }})()"
        )

    def push(self, selector):
        self.value(f"document.querySelector({selector!r}).click()")

    def centre(self, selector, x=0.5, y=0.5):
        """A place in an element, as shares of its width and height, after scrolling to it."""
        return self.value(
            f"(() => {{ const it = document.querySelector({selector!r}); it.scrollIntoView({{ block: 'center' }}); const box = it.getBoundingClientRect();"
            f" return [box.left + {x} * box.width, box.top + {y} * box.height]; }})()"
        )

    def move(self, x, y, button="none"):
        self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y, button=button)

    def drag(self, start, end):
        self.call("Input.dispatchMouseEvent", type="mousePressed", x=start[0], y=start[1], button="left", clickCount=1)
        for share in (0.25, 0.5, 0.75, 1):
            self.move(*(a + share * (b - a) for a, b in zip(start, end)), button="left")
        self.call("Input.dispatchMouseEvent", type="mouseReleased", x=end[0], y=end[1], button="left", clickCount=1)

    def touch(self, x, y):
        self.call("Input.dispatchTouchEvent", type="touchStart", touchPoints=[{"x": x, "y": y}])
        self.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

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
    """Starts a process and yields its id and the address that it prints."""
    log = here / name
    process = subprocess.Popen(command, cwd=here, stdout=subprocess.DEVNULL, stderr=log.open("w"))
    try:
        yield process.pid, wait(lambda: next((word for word in log.read_text().split() if word.startswith("http://")), None), 60)
    finally:
        if process.poll() is not None:
            print(f"process ended early: {' '.join(map(str, command))}\n{log.read_text()}", file=sys.stderr)
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
        page.call("Page.addScriptToEvaluateOnNewDocument", source=RECORD_PAINTED_TEXT)
        page.call("Page.navigate", url=url)
        yield page
        assert not page.complaints, page.complaints
    finally:
        browser.kill()
        browser.wait()


@contextlib.contextmanager
def live(reveille, here, devices, pace, options=""):
    run = f"up -p knn -n {devices} -k 10000000 -P 3 --pace {pace} {options} --quiet --out out --dashboard 127.0.0.1:0".split()
    with started(here, "log", reveille, *run) as (program, url), browsed(here, url) as page:
        page.program = program
        page.until("window.reveille?.moment && window.reveille.now.next > 300", 60)
        yield page


@contextlib.contextmanager
def compared(reveille, here):
    # Lost reports let both runs miss events.
    for seed in (1, 2):
        run = f"run -p age-index -n 60 -k 900 --set radio.uplink_loss=0.3 --set seed={seed} --record {seed}.mcap --quiet --out of-{seed}".split()
        subprocess.run([reveille, *run], cwd=here, check=True, stdout=subprocess.DEVNULL)
    compared = subprocess.run([reveille, "compare", "--exit-code", "1.mcap", "2.mcap"], cwd=here, capture_output=True, text=True)
    assert compared.returncode == 1, compared
    first = compared.stdout.partition("first difference: ")[2]
    command = "dashboard 1.mcap --compare 2.mcap --listen 127.0.0.1:0".split()
    with started(here, "comparison", reveille, *command) as (_, url), browsed(here, url) as page:
        page.first = first.split()[:4]
        yield page


def check_comparison(page, pictures):
    """Compares two seeds: the first difference equals the one in `compare`, and a click shows its TTI."""
    page.until("document.querySelectorAll('#differences li').length > 0")
    kind, tti = page.first[0], page.first[3].strip(",")
    difference = page.text("#differences li")
    assert f"first difference: {kind}" in difference and f"TTI {tti} " in difference, (page.first, difference)
    assert "seed: 1, other 2" in page.text("#fields")
    assert not page.value("reveille.run.controls") and page.text("#state") == "finished"
    page.value("document.querySelectorAll('#differences button')[1].click()")
    page.until("reveille.moment && reveille.other.moment && reveille.moment.tti === reveille.other.moment.tti")
    # A TTI with a belief over several places and a true event, in both recordings.
    found = page.value(
        "(async () => { for (let k = 100; k < 900; k++) {"
        " const [a, b] = await Promise.all(['', 'other/'].map((of) => fetch(`api/${of}tti/${k}`).then((r) => r.json())));"
        " if (a.belief?.length > 1 && a.event) return [k, a.belief.reduce((sum, p) => sum + p.share, 0), b.states.length]; } })()"
    )
    assert found and abs(found[1] - 1) < 1e-3 and found[2] == 60, found
    page.fill("#tti", found[0])
    page.until(f"reveille.moment.tti === {found[0]} && reveille.moment.belief.length > 1")
    page.until("document.getElementById('legend').textContent.includes('belief')")
    # Each curve names both runs, and each value has the colour of its run.
    assert page.text("#this-name").startswith("this run: ") and page.text("#other-name").startswith("other run: ")
    colours = "[...document.querySelectorAll('#chart-p1 .legend b')].map((value) => value.style.color)"
    page.until(f"new Set({colours}).size === 2")
    check_compared_heading(page)
    assert page.text("#timeline-title") == "Timeline of this run"
    # `inspect tail` has the same filters.
    fields = "const fields = document.getElementById('filters');"
    page.value(f"(() => {{ {fields} fields.here.checked = false; fields.kind.value = 'wake'; fields.state.value = 'S4'; fields.requestSubmit(); }})()")
    page.until("[...document.querySelectorAll('#messages tbody tr')].every((r) => r.cells[2].textContent === 'wake') && document.querySelectorAll('#messages tbody tr').length > 3")
    page.value(f"(() => {{ {fields} fields.state.value = ''; fields.kind.value = 'nonsense'; fields.requestSubmit(); }})()")
    page.until("document.getElementById('refused').textContent.includes('no such kind')")
    page.value(f"(() => {{ {fields} fields.kind.value = ''; fields.here.checked = true; fields.requestSubmit(); }})()")
    page.until("document.getElementById('refused').textContent === ''")
    # The browser's log holds the refused request and nothing else.
    page.complaints = [one for one in page.complaints if "400" not in one.get("text", "")]
    check_exports(page, "Two runs", "Energy ledger")
    check_grid(page)
    check_shapes(page, pictures, "compare")
    print(f"two seeds: {difference.split(chr(10))[0][:60]}")


def check_without_token(reveille, here):
    """A page that may not read the run without the token of its address names what is missing."""
    command = "dashboard 1.mcap --listen 0.0.0.0:0".split()
    with started(here, "no-token", reveille, *command) as (_, url), browsed(here, url.partition("#")[0]) as page:
        page.until("document.getElementById('state')?.textContent === 'not connected'")
        problem = page.text("#problem")
        assert problem == "this page needs the address that the program printed (it contains a token)", problem
        page.complaints = [one for one in page.complaints if "401" not in one.get("text", "")]


def check_compared_heading(page):
    """The heading names both runs with the events that each of them has missed."""
    missed = page.value(
        "(async () => { const counts = []; for (const run of ['', 'other/']) {"
        "  const points = await fetch(`api/${run}curves`).then((answer) => answer.json()); counts.push(points.at(-1).metrics[1]); }"
        " return counts; })()"
    )
    for nth, (selector, which) in enumerate((("#counted", "this run, of-1 "), ("#other-counted", "other run, of-2 "))):
        page.until(f"/ of [0-9]+ events? missed/.test(document.querySelector({selector!r}).textContent)")
        text = page.text(selector)
        share = float(text.rpartition("(")[2].split()[0])
        assert text.startswith(which) and abs(share - missed[nth]) < 0.01, (text, missed)
    assert page.text("#run") == "of-1 and of-2", page.text("#run")


# Counts the frames in which the shown TTI differs from the one in the frame before.
COUNT_CHANGES = """
  (() => {
    const count = (last) => requestAnimationFrame(() => {
      window.changes = (window.changes ?? 0) + (reveille.tti !== last);
      count(reveille.tti);
    });
    count(reveille.tti);
  })()
"""


def usual_range(devices):
    """The option that keeps the mean number of devices within range of an event.

    Otherwise an event among many devices wakes hundreds of them in one TTI, and the run itself has few TTIs to show.
    """
    return f"--set sensing.d_max={4 * (DEVICES / devices) ** 0.5:.3f}"


def measure_rates(reveille, here, devices, rounds):
    """Prints the updates of the page per second, with the timeline on the screen; few and many devices take turns."""
    found = {}
    for nth, count in enumerate([DEVICES, devices] * rounds):
        folder = here / str(nth)
        folder.mkdir()
        with live(reveille, folder, count, "max", usual_range(count)) as page:
            page.shape(1440, 900, "light")
            page.centre("#timeline")
            page.value(COUNT_CHANGES)
            for mode in ("following", "idle"):
                page.value(f"reveille.timeline.window.follows = {json.dumps(mode == 'following')}; 0")
                time.sleep(3)
                counts = "[window.changes, reveille.timeline.paints, reveille.now.next]"
                before, start = page.value(counts), time.monotonic()
                time.sleep(10)
                after, passed = page.value(counts), time.monotonic() - start
                changes, paints, ttis = ((b - a) / passed for a, b in zip(before, after))
                found.setdefault((mode, count), []).append(changes)
                print(f"{count:5} devices, timeline {mode:9}: {changes:5.1f} updates and {paints:5.1f} paints of the timeline a second, {ttis:6.0f} TTIs/s", flush=True)
    for mode in ("following", "idle"):
        few, many = (statistics.median(found[mode, count]) for count in (DEVICES, devices))
        print(f"timeline {mode}: {many:.1f} updates a second with {devices} devices, {many / few:.2f} of those with {DEVICES}")


def cpu_times():
    """Seconds that all cores were idle, and that other virtual machines took from them."""
    fields = Path("/proc/stat").read_text().split("\n", 1)[0].split()
    return [int(fields[place]) / os.sysconf("SC_CLK_TCK") for place in (4, 8)]


def watch(page, minutes):
    """Watches a long run with the timeline on the screen, and measures the page's updates, paints and memory."""
    page.shape(1440, 900, "light")
    page.centre("#timeline")
    start = time.monotonic()
    counts = "[reveille.updates, reveille.paints, reveille.timeline.paints, reveille.now.next]"
    (updates, paints, timeline_paints, _), begun = page.value(counts), start
    sizes, cores = [], cpu_times()
    while time.monotonic() < start + 60 * minutes:
        time.sleep(min(30, 15 * minutes))
        now = page.value(counts)
        passed = time.monotonic() - begun
        rates = [(after - before) / passed for after, before in zip(now, (updates, paints, timeline_paints))]
        # The record of painted text grows with every label of an axis.
        page.value("window.painted.clear()")
        page.call("HeapProfiler.collectGarbage")
        size = page.call("Runtime.getHeapUsage")["usedSize"] / 1e6
        sizes.append(size)
        resident = next(int(line.split()[1]) for line in Path(f"/proc/{page.program}/status").read_text().splitlines() if line.startswith("VmRSS")) / 1e3
        idle, stolen = (after - before for after, before in zip(cpu_times(), cores))
        print(
            f"{time.monotonic() - start:6.0f} s  TTI {now[3]:8}  {rates[0]:5.1f} updates, {rates[1]:5.1f} paints and"
            f" {rates[2]:5.1f} paints of the timeline a second  {size:6.1f} MB, program {resident:6.1f} MB,"
            f" CPU idle {idle / passed:.2f} and stolen {stolen / passed:.2f} cores", flush=True,
        )
        cores = cpu_times()
        (updates, paints, timeline_paints, _), begun = page.value(counts), time.monotonic()
    quarter = max(len(sizes) // 4, 1)
    first, last = sum(sizes[:quarter]) / quarter, sum(sizes[-quarter:]) / quarter
    print(f"page: first {sizes[0]:.1f}, min {min(sizes):.1f}, max {max(sizes):.1f}, last {sizes[-1]:.1f} MB")
    assert last < first * 1.2 + 2, f"the page has grown from {first:.1f} to {last:.1f} MB"


def check_live(page, pictures):
    assert page.value("reveille.run.positions.length") == DEVICES
    assert page.value("reveille.moment.states.length") == DEVICES
    loaded = page.value("performance.getEntriesByType('resource').every((r) => r.name.startsWith(location.origin))")
    assert loaded, "something is loaded from elsewhere"
    # States arrive before they are painted.
    page.until(f"{COLOURS.replace('CANVAS', 'map')} > 50")
    before, start = page.value("[reveille.updates, reveille.paints]"), time.monotonic()
    time.sleep(3)
    after, passed = page.value("[reveille.updates, reveille.paints]"), time.monotonic() - start
    update_rate, paint_rate = ((b - a) / passed for a, b in zip(before, after))
    assert update_rate > 0 and paint_rate > 0, "the page stands still"
    page.until("document.querySelectorAll('#ticker li').length > 0")
    stopped = check_clock(page)
    check_moving_back(page, stopped)
    check_map(page)
    check_curves(page)
    check_timeline(page, stopped)
    check_misses(page)
    check_resize(page)
    check_last_events(page)
    check_histogram(page)
    check_singulars(page)
    check_address(page)
    check_messages(page)
    check_exports(page, "Energy ledger", "Messages", "Timeline")
    check_names(page)
    check_actions(page)
    check_grid(page)
    check_shapes(page, pictures, "live")
    page.push("#follow")
    page.push("#pause")
    page.until(f"reveille.now.next > {stopped + 50}")
    assert page.value("reveille.timeline.window.follows")
    page.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-reduced-motion", "value": "reduce"}])
    before, start = page.value("reveille.updates"), time.monotonic()
    page.until(f"reveille.updates > {before + 2}")
    rate = (page.value("reveille.updates") - before) / (time.monotonic() - start)
    assert rate < 4, f"{rate:.1f} updates a second with reduced motion"
    # The address of another run on this port differs in its token.
    page.value("window.isOld = true; location.hash = '#other'")
    time.sleep(1)
    page.until("window.isOld === undefined && window.reveille?.updates > 0", 60)
    print(f"{DEVICES} devices, {update_rate:.0f} updates and {paint_rate:.0f} paints a second, nothing on the console")


# The number of colours on a canvas.
COLOURS = (
    "(() => { const m = document.getElementById('CANVAS'), d = m.getContext('2d').getImageData(0, 0, m.width, m.height).data;"
    " const seen = new Set(); for (let i = 0; i < d.length; i += 4) seen.add(d[i] << 16 | d[i + 1] << 8 | d[i + 2]); return seen.size; })()"
)


def check_clock(page):
    """Pauses, steps and sets the pace. Returns the next TTI of the paused run."""
    page.until("document.getElementById('state').textContent === 'running'")
    page.until("/^wall clock 0:0/.test(document.getElementById('wall').textContent)")
    assert "/out" in page.text("#path"), page.text("#path")
    page.push("#path")
    links = "[...document.querySelectorAll('#file-list a')]"
    page.until(f"document.getElementById('files').open && {links}.some((link) => link.download === 'scenario.toml')")
    text = page.value(f"fetch({links}.find((link) => link.download === 'scenario.toml').href).then((answer) => answer.text())")
    assert text.startswith("preset = "), text
    page.value("document.getElementById('files').close()")
    assert page.text("#counted") == "warm-up until TTI 1\u202f000\u202f000; nothing is counted yet", page.text("#counted")
    page.push("#pause")
    page.until("document.getElementById('state').textContent === 'paused'")
    page.until("document.getElementById('pause').textContent === 'Resume'")
    time.sleep(0.5)
    stopped = page.value("reveille.now.next")
    time.sleep(1)
    assert page.value("reveille.now.next") == stopped, "paused"
    # In the words of `reveille clock status`.
    assert page.text("#progress").replace("\u202f", "").startswith(f"before TTI {stopped} of"), page.text("#progress")
    assert page.value("document.getElementById('pace').placeholder") == "max"
    assert "TTI" not in page.text("#clock-note") and page.value("reveille.tti") == stopped - 1
    page.push("#step")
    page.until(f"reveille.now.next === {stopped + 1}")
    page.fill("#pace", 7)
    # A status that arrives in the meantime leaves the number in the field.
    time.sleep(1.5)
    page.push("#set-pace")
    page.until("reveille.clock.pace.RealTime === 7000")
    return stopped


def check_moving_back(page, stopped):
    """Moves back by a hundred TTIs and compares the states shown; then the keys."""
    page.fill("#scrubber", stopped - 100, "input")
    page.until(f"reveille.tti === {stopped - 100} && reveille.moment.tti === {stopped - 100}")
    same = page.value(
        f"fetch('api/tti/{stopped - 100}').then((a) => a.json()).then((m) => m.states === reveille.moment.states && m.batteries === reveille.moment.batteries)"
    )
    assert same
    assert "before the latest" in page.until("document.getElementById('shown').textContent")
    page.press("ArrowLeft")
    page.until(f"reveille.moment.tti === {stopped - 101}")
    page.press("ArrowRight", modifiers=8)
    page.until(f"reveille.moment.tti === {stopped - 91}")
    page.press("b")
    page.until("document.querySelectorAll('#bookmarks button').length === 1")


def check_map(page):
    """The scale bar, cluster numbers, layers and legend; a click chooses a device."""
    groups = page.value("[...new Set(reveille.run.groups)].map(String)")
    assert page.value(f"{json.dumps(groups)}.every((group) => window.painted.has(group))"), "cluster numbers"
    assert page.value("[...window.painted].some((text) => /^[0-9.]+ m$/.test(text))"), "scale bar"
    assert "belief" not in page.text("#legend"), "knn has no belief"
    # The first picture of the legend is the range of batteries.
    symbols = page.value("[...document.querySelectorAll('#legend span + span canvas')].map((canvas) => canvas.toDataURL())")
    assert len(symbols) == 7 and len(set(symbols)) == 7, "the symbols differ"
    # The two reasons of a report differ in shape, not only in colour: a diamond covers more than a triangle.
    areas = page.value(
        "[...document.querySelectorAll('#legend span + span canvas')].map((m) => [...m.getContext('2d').getImageData(0, 0, m.width, m.height).data].filter((value, i) => i % 4 === 3 && value > 128).length)"
    )
    assert areas[2] > areas[1] + 10, areas
    picture = "document.getElementById('map').toDataURL()"
    pictures = [page.value(picture)]
    for layer in ("looks", "misses", "battery", "none", "cluster"):
        page.fill("#layer", layer)
        page.until(f"{picture} !== {json.dumps(pictures[-1])}")
        pictures.append(page.value(picture))
        if layer == "looks":
            page.until("/sensed.*TTI 0 to ([0-9]+): darkest [1-9]/.exec(document.getElementById('legend').textContent)?.[1] === `${reveille.tti}`")
    # On a small phone, only numbers that would cover others are left out.
    page.shape(320, 700, "light")
    page.until("innerWidth === 320")
    page.value("(() => { window.painted.clear(); dispatchEvent(new Event('resize')); })()")
    page.until(f"{json.dumps(groups)}.filter((group) => window.painted.has(group)).length > {0.7 * len(groups)}")
    page.shape(1280, 900, "light")
    page.until("innerWidth === 1280")
    centre = page.value("(() => { const [w, h] = reveille.run.area, p = reveille.run.positions[7]; return [p.x / w, 1 - p.y / h]; })()")
    width, height = page.value("(() => { const box = document.getElementById('map').getBoundingClientRect(); return [box.width, box.height]; })()")
    page.click(*page.centre("#map", (10 + centre[0] * (width - 20)) / width, (10 + centre[1] * (height - 20)) / height))
    page.until("reveille.device === 7 && !document.getElementById('one').hidden")
    page.until("/ · host \\d+, the process with pid \\d+$/.test(document.getElementById('one-facts').textContent)")
    page.until("document.getElementById('ledger').textContent.includes('unpowered')")
    assert page.text("#one-title") == "Device 7"


def check_actions(page):
    """Fails, charges and revives the chosen device of the paused run."""
    page.push("#follow")
    page.fill("#device", 7)
    page.until("reveille.device === 7 && document.getElementById('revive').disabled && !document.getElementById('fail').disabled")
    state = "reveille.now.states[7]"
    assert page.value(f"{state} !== 'x' && document.querySelector('#device-actions').checkVisibility()")
    for button, note, failed in (("fail", "device 7 fails in TTI", True), ("add-energy", "device 7 receives 10 units", True), ("revive", "device 7 is revived", False)):
        page.push(f"#{button}")
        page.until(f"document.getElementById('action-note').textContent.startsWith({json.dumps(note)})")
        page.push("#step")
        page.until(f"({state} === 'x') === {json.dumps(failed)}")
        if failed:
            page.until("document.getElementById('one-facts').textContent.startsWith('failed by an operator')")
            page.until("!document.getElementById('revive').disabled && document.getElementById('fail').disabled")


def check_curves(page):
    """Axes with ticks and units, and values for mouse, touch and keyboard."""
    assert page.value("document.querySelectorAll('#charts .chart').length") == 7
    units = page.value("[...document.querySelectorAll('#charts .unit')].map((unit) => unit.textContent.trim())")
    assert all(units), units
    # Without cluster numbers, all numbers belong to axes.
    page.fill("#layer", "none")
    page.centre("#chart-battery canvas")
    page.value("(() => { window.painted.clear(); dispatchEvent(new Event('resize')); })()")
    page.until("window.painted.has('TTI') && window.painted.has('units')")
    ticks = page.value("[...window.painted].filter((text) => /^[0-9.]+k?$/.test(text))")
    assert len(ticks) > 8 and {"0", "50", "100"} <= set(ticks), ticks
    page.fill("#layer", "cluster")
    assert page.value("document.getElementById('chart-p1').hidden")
    note = page.text("#curves-note")
    assert "begin at TTI 1\u202f000\u202f000, the end of the warm-up" in note, note
    readout = "document.querySelector('#chart-battery .readout')"
    page.move(*page.centre("#chart-battery canvas"))
    page.until(f"!{readout}.hidden && /^TTI [^]*median [0-9]/.test({readout}.textContent)")
    page.move(2, 2)
    page.until(f"{readout}.hidden")
    page.value("document.querySelector('#chart-battery canvas').focus({ preventScroll: true })")
    tti = page.value("reveille.tti")
    page.press("ArrowLeft")
    page.until(f"!{readout}.hidden")
    first = page.value(f"{readout}.textContent")
    page.press("ArrowLeft")
    page.until(f"{readout}.textContent !== {json.dumps(first)}")
    assert page.value("reveille.tti") == tti, "the keys of a chart do not move the shown TTI"
    page.press("Escape")
    page.until(f"{readout}.hidden")
    page.touch(*page.centre("#chart-battery canvas", 0.7))
    page.until(f"!{readout}.hidden")
    page.value("document.activeElement.blur()")
    check_axes(page)
    histogram = "document.querySelector('#histogram .readout')"
    page.move(*page.centre("#histogram canvas", 0.9))
    page.until(f"!{histogram}.hidden && /units[^]*device/.test({histogram}.textContent)")
    page.move(2, 2)


def check_axes(page):
    """Ticks next to each other have different labels, and the highest value of a curve is in its chart."""
    page.value(
        "import('./chart.js').then(({ Chart }) => { document.querySelector('main').insertAdjacentHTML('beforebegin', '<div id=\"trial\" style=\"width: 400px; height: 260px\"></div>');"
        " window.trial = new Chart(document.getElementById('trial'), { id: 'trial', title: 'Trial', unit: '1', series: [''], onChoose() {} });"
        " window.painted.clear(); scrollTo(0, 0); trial.figure.style.height = '100%';"
        " trial.show([{ name: 'trial', colour: '--ink', points: Array.from({ length: 40 }, (_, nth) => [1279100 + nth, [nth ? 20001 : 20400]]) }], 1279100, 1279140, null); })"
    )
    page.until("trial.ground?.hasValues && window.painted.has('20k')")
    ttis = page.value("[...window.painted].filter((text) => /M$/.test(text))")
    assert len(ttis) >= 4 and "1.27911M" in ttis, ttis
    # The first tick is not below the highest value.
    values = page.value("[...window.painted].filter((text) => /^[0-9]+k$/.test(text))")
    assert max(int(text[:-1]) for text in values) >= 20.4, values
    top, bottom = page.value("[20400, 20001].map((value) => trial.y(value))")
    assert 8 < top < bottom, (top, bottom)
    # A short peak is cut off, with its value, so that it does not flatten the other values.
    page.value("trial.show([{ name: 'trial', colour: '--ink', points: Array.from({ length: 60 }, (_, nth) => [nth, [nth ? 2 : 90]]) }], 0, 60, null)")
    page.until("window.painted.has('▲ 90')")
    peak, usual, bottom = page.value("[90, 2, 0].map((value) => trial.y(value))")
    assert peak < 0 < usual < bottom - 50, (peak, usual, bottom)
    page.value("document.getElementById('trial').remove()")


def check_timeline(page, stopped):
    """Compares cells with the history of their devices; then zoom, pan, filters and the last rows."""
    page.fill("#tti", stopped - 60)
    page.until(f"reveille.moment.tti === {stopped - 60}")
    page.centre("#timeline")
    page.until(f"reveille.timeline.cell(5, {stopped - 60}) !== null")
    page.until(f"{COLOURS.replace('CANVAS', 'timeline')} > 10")
    differing = page.value(
        f"(async () => {{ const names = {{ 1: 'S1 senses', 2: 'S3 reports', 3: 'S3 reports', 4: 'S4 sleeps', 0: 'S4 unpowered', x: 'failed by an operator' }}, found = [];"
        f" for (const device of [0, 5, 9]) {{ const own = await fetch(`api/device/${{device}}?from={stopped - 120}&end={stopped - 20}`).then((a) => a.json());"
        " [...own.states].forEach((state, nth) => { const cell = reveille.timeline.cell(device, own.from + nth);"
        " if (!cell?.states.includes(names[state]) || Math.abs(cell.battery - own.batteries[nth]) > 0.5) found.push([device, own.from + nth, state, cell]); }); }"
        " return found; })()"
    )
    assert not differing, differing[:3]
    page.move(*page.centre("#timeline", 0.6, 0.5))
    page.until("/^device [0-9]+\\nTTI/.test(document.getElementById('timeline-readout').textContent)")
    scale = page.value("reveille.timeline.window.scale")
    page.value("document.getElementById('timeline-scroll').focus({ preventScroll: true })")
    page.press("+")
    page.until(f"reveille.timeline.window.scale > {scale}")
    start = page.value("reveille.timeline.window.from")
    page.drag(page.centre("#timeline", 0.4, 0.5), page.centre("#timeline", 0.7, 0.5))
    page.until(f"reveille.timeline.window.from < {start} - 5")
    # The whole run in one view: columns of several TTIs.
    page.push("#timeline-fit")
    page.until(f"reveille.timeline.window.from <= 1 && reveille.timeline.window.tti(reveille.timeline.window.width) >= {stopped}")
    page.press("End")
    page.until(f"reveille.device === {DEVICES - 1}")
    page.until(f"reveille.timeline.cell({DEVICES - 1}, 10) !== null")
    page.fill("#timeline-filter [name=devices]", "3-6, 40", "input")
    page.until("String(reveille.timeline.devices) === '3,4,5,6,40'")
    page.fill("#timeline-filter [name=devices]", "3-x", "input")
    page.until("document.getElementById('timeline-note').textContent.includes('not a number')")
    page.fill("#timeline-filter [name=devices]", "", "input")
    page.fill("#timeline-filter [name=cluster]", "0", "input")
    page.until("reveille.timeline.devices.length > 0 && reveille.timeline.devices.every((device) => reveille.run.groups[device] === 0)")
    page.push("#timeline-filter [type=reset]")
    page.fill("#timeline-filter [name=state]", "S1", "input")
    page.until("reveille.timeline.devices.length > 0 && reveille.timeline.devices.every((device) => reveille.moment.states[device] === '1')")
    page.push("#timeline-filter [type=reset]")
    page.until(f"reveille.timeline.devices.length === {DEVICES}")


def check_misses(page):
    """The keys N and P show the neighbouring missed events."""
    misses = page.value("fetch('api/events?from=0').then((a) => a.json()).then((all) => all.filter((event) => event.delay === null).map((event) => event.start))")
    assert len(misses) > 2, misses
    page.fill("#tti", misses[0])
    page.until(f"reveille.moment.tti === {misses[0]}")
    page.value("document.activeElement.blur()")
    page.press("n")
    page.until(f"reveille.moment.tti === {misses[1]} && reveille.moment.event")
    assert page.text("#miss-note").startswith("missed event "), page.text("#miss-note")
    # The heading counts no events of the warm-up, in which this run stays. The note wraps and is not cut off.
    assert ", in the warm-up, not counted: " in page.text("#miss-note"), page.text("#miss-note")
    assert page.value("(() => { const { scrollWidth, clientWidth } = document.getElementById('miss-note'); return scrollWidth <= clientWidth; })()")
    page.press("p")
    page.until(f"reveille.moment.tti === {misses[0]}")
    page.push("#previous-miss")
    page.until("document.getElementById('miss-note').textContent.startsWith('no missed event before')")
    page.push("#next-miss")
    page.until(f"reveille.moment.tti === {misses[1]}")


def check_resize(page):
    """The timeline shows the TTI of a missed event also in a narrower window."""
    page.shape(844, 390, "light")
    page.centre("#timeline")
    page.until("reveille.timeline.window.width > 700")
    page.push("#timeline-fit")
    page.fill("#tti", page.value("reveille.now.next - 1"))
    page.until("reveille.moment.tti === reveille.now.next - 1")
    page.push("#previous-miss")
    page.until("document.getElementById('miss-note').textContent.startsWith('missed event ')")
    place = "[reveille.timeline.window.x(reveille.tti), reveille.timeline.window.width]"
    page.until(f"(([x, width]) => 84 <= x && x < width)({place})")
    page.shape(390, 844, "light")
    page.centre("#timeline")
    page.until("reveille.timeline.window.width < 390")
    x, width = page.value(place)
    assert 84 <= x < width, (x, width)
    page.shape(1280, 900, "light")


def check_last_events(page):
    """The list of the last events ends at the shown TTI, and names the cause of a missed event."""
    miss = page.value(
        "fetch('api/events?from=0').then((a) => a.json()).then((all) => { const found = all.filter((event) => event.delay === null); return found[found.length >> 1]; })"
    )
    assert miss["cause"], miss
    page.fill("#tti", miss["last"])
    first = "document.querySelector('#ticker li').textContent"
    page.until(f"reveille.moment.tti === {miss['last']} && {first}.includes('event {miss['event']} has ended, missed ({miss['cause']})')")
    ttis = page.value("[...document.querySelectorAll('#ticker button')].map((button) => +button.textContent.slice(4))")
    assert ttis[0] == miss["last"] and ttis == sorted(ttis, reverse=True), ttis
    # The map is painted only on the screen.
    page.centre("#map")
    page.until(f"document.getElementById('description').textContent.includes('event missed: {miss['cause']}')")
    page.fill("#tti", miss["last"] - 1)
    page.until(f"reveille.moment.tti === {miss['last'] - 1} && !{first}.includes('event {miss['event']} ')")
    page.fill("#tti", miss["start"] - 1)
    page.until(f"reveille.moment.tti === {miss['start'] - 1}")
    page.push("#next-miss")
    page.until(f"document.getElementById('miss-note').textContent.endsWith({json.dumps(miss['cause'])})")


def check_histogram(page):
    """The histogram counts the states that the map shows, in a TTI in which a woken device has reported."""
    woken = page.value(
        "(async () => { for (let tti = reveille.now.next - 1; tti >= 0; tti--) {"
        " const moment = await fetch(`api/tti/${tti}`).then((answer) => answer.json());"
        " if (moment.reported?.length && moment.woken?.some(({ outcome }) => outcome.Reported)) return tti; } })()"
    )
    assert woken is not None, "no woken device has reported"
    page.fill("#tti", woken)
    page.until(f"reveille.moment.tti === {woken}")
    page.centre("#histogram canvas")
    shown = "[...document.querySelectorAll('#histogram .legend > span')].map((entry) => entry.textContent.trim()).sort()"
    expected = (
        "Promise.all([import('./map_symbols.js'), import('./states.js')]).then(([{ symbolsOf }, { STATES }]) => { const counts = {};"
        " for (const symbol of symbolsOf(reveille.moment)) counts[symbol] = (counts[symbol] ?? 0) + 1;"
        " return Object.entries(counts).map(([symbol, count]) => `${STATES[symbol].name} ${count}`).sort(); })"
    )
    states = page.value(expected)
    assert any(text.startswith("S3 reports after a wake-up ") for text in states), states
    page.until(f"JSON.stringify({shown}) === {json.dumps(json.dumps(states, separators=(',', ':')))}")


def check_singulars(page):
    """A count of one has its noun in the singular, in the texts of the page and of the program."""
    ones = page.value(
        "fetch('api/events?from=0').then((a) => a.json()).then((all) => all.find((event) => event.reports === 1 && event.wake_ups !== 1)?.last)"
    )
    assert ones, "no event with one report"
    page.fill("#tti", ones)
    page.until(f"reveille.moment.tti === {ones} && /, 1 report, /.test(document.querySelector('#ticker li').textContent)")
    wrong = page.value("document.body.innerText.match(/(?<![0-9.,])1 (reports|wake-ups|devices|TTIs|events|units|messages|wrong activations)\\b/g)")
    assert not wrong, wrong


def check_address(page):
    """The address holds the shown TTI and the chosen device, and a changed address is followed."""
    here = page.value("reveille.tti")
    page.fill("#device", 5)
    page.until(f"new RegExp('^#[^&]+&tti={here}&device=5$').test(location.hash)")
    token = page.value("location.hash.slice(1).split('&')[0]")
    page.value(f"window.isOld = true; location.hash = '#{token}&tti={here + 40}&device=9'")
    page.until(f"reveille.moment.tti === {here + 40} && reveille.device === 9 && document.getElementById('one-title').textContent === 'Device 9'")
    assert page.value("window.isOld"), "the page was loaded again"
    # A reload opens the address as a link does.
    page.call("Page.reload")
    page.until(f"window.isOld === undefined && window.reveille?.moment?.tti === {here + 40} && reveille.device === 9", 30)
    page.until("document.getElementById('state').textContent === 'paused' && !document.getElementById('one').hidden")
    page.value(f"location.hash = '#{token}&tti=99999999'")
    page.until("document.getElementById('miss-note').textContent === 'the run has not reached TTI 99999999' && reveille.device === -1")
    page.push("#follow")
    page.until(f"location.hash === '#{token}'")
    page.fill("#tti", here)
    page.until(f"reveille.moment.tti === {here}")


def check_messages(page):
    """The shown TTI comes first; emulation messages and quiet ones are hidden; a message opens with its bytes."""
    planes = "[...document.querySelectorAll('#messages tbody tr[data-id]')].map((line) => line.dataset.plane)"
    page.until(f"document.querySelector('#messages tbody tr').className === 'shown' && {planes}.length > 0")
    assert "emu" not in page.value(planes)
    page.push("#filters [name=emulation]")
    page.until(f"{planes}.includes('emu')")
    page.push("#filters [name=emulation]")
    page.until(f"!{planes}.includes('emu') && {planes}.length > 0")
    # A `world` message of a TTI without an event has no news; after the TTI it names no event.
    texts = "[...document.querySelectorAll('#messages tbody tr[data-id]')].map((line) => `${line.cells[2].textContent} ${line.cells[5].textContent}`)"
    quiet = f"{texts}.filter((text) => /^world TTIs? [0-9]+( to [0-9]+)?$/.test(text)).length"
    assert page.value(quiet) == 0, page.value(texts)
    page.push("#filters [name=quiet]")
    page.until(f"{quiet} > 0")
    page.push("#filters [name=quiet]")
    page.until(f"{quiet} === 0 && {planes}.length > 0")
    # The rows have one tab stop, and the arrows move it.
    tab_stops = "[...document.querySelectorAll('#messages tbody tr')].flatMap((line, nth) => (line.tabIndex === 0 ? [nth] : []))"
    first = page.value(tab_stops)
    page.value(f"document.querySelectorAll('#messages tbody tr')[{first[0]}].focus()")
    page.press("ArrowDown")
    assert page.value(tab_stops) == [first[0] + 1] and page.value("document.activeElement.tabIndex === 0"), first
    page.push("#messages tbody tr[data-id]")
    page.until("document.getElementById('detail').open && document.getElementById('hex').textContent.length > 3")
    page.value("document.getElementById('detail').close()")


def check_exports(page, *titles):
    """Each panel on the page saves a picture and a table, also the panels with these titles."""
    page.fill("#device", 8)
    page.until("document.getElementById('ledger').textContent.includes('unpowered')")
    # A chart is painted once it is on the screen.
    page.centre("#history canvas")
    page.until("document.querySelector('#history canvas').width > 0 && document.querySelector('#history canvas').height > 0")
    page.value("window.saved = []; URL.createObjectURL = (blob) => { window.saved.push(blob); return 'data:,'; }; HTMLAnchorElement.prototype.click = () => {};")
    # The warm-up hides four charts.
    exports = "[...document.querySelectorAll('.export')].filter((bar) => !bar.closest('[hidden]'))"
    panels = page.value(f"{exports}.length")
    assert panels >= 7, f"{panels} panels"
    labels = page.value(f"{exports}.map((bar) => bar.querySelector('button').getAttribute('aria-label'))")
    missing = {f"Save {title} as PNG" for title in titles} - set(labels)
    assert not missing, (missing, labels)
    for nth in range(panels):
        page.value("window.saved.length = 0")
        page.value(f"{exports}[{nth}].querySelectorAll('button').forEach((button) => button.click())")
        page.until("window.saved.length === 2")
        heads = page.value("Promise.all(window.saved.map((blob) => blob.slice(0, 4000).text().then((text) => [blob.type, blob.size, text])))")
        label = page.value(f"{exports}[{nth}].querySelector('button').getAttribute('aria-label')")
        kinds = {kind: (size, text) for kind, size, text in heads}
        assert kinds["image/png"][0] > 1000 and kinds["image/png"][1][1:4] == "PNG", (label, kinds["image/png"])
        header, *rows = kinds["text/csv"][1].splitlines()
        assert "," in header and rows, (label, kinds["text/csv"])


def check_names(page):
    """Controls and canvases have names, and text has enough contrast in both colour schemes."""
    unnamed = page.value(
        "[...document.querySelectorAll('button, input, select, canvas:not([aria-hidden])')].filter((it) =>"
        " !(it.textContent.trim() || it.getAttribute('aria-label') || it.labels?.length)).map((it) => it.outerHTML)"
    )
    assert not unnamed, unnamed
    unreachable = page.value("[...document.querySelectorAll('.chart canvas, #timeline-scroll, .scroll')].filter((it) => it.tabIndex !== 0).length")
    assert unreachable == 0, f"{unreachable} parts without keyboard focus"
    contrast = (
        "(() => { const style = getComputedStyle(document.documentElement), light = (name) => { const digits = style.getPropertyValue(name).trim().slice(1);"
        " const [r, g, b] = [0, 2, 4].map((at) => parseInt(digits.slice(at, at + 2), 16) / 255).map((v) => v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);"
        " return 0.2126 * r + 0.7152 * g + 0.0722 * b; };"
        " const ratio = (a, b) => { const [low, high] = [light(a), light(b)].sort((x, y) => x - y); return (high + 0.05) / (low + 0.05); };"
        " return Object.fromEntries([['--ink', 4.5], ['--faint', 4.5], ['--accent', 4.5], ['--other', 4.5], ['--alarm', 4.5], ['--event', 3], ['--woken', 3], ['--belief', 3]]"
        "   .flatMap(([name, least]) => ['--panel', '--field'].map((ground) => [`${name} on ${ground}`, ratio(name, ground) / least]))); })()"
    )
    for scheme in ("light", "dark"):
        page.shape(1280, 900, scheme)
        low = {pair: share for pair, share in page.value(contrast).items() if share < 1}
        assert not low, (scheme, low)
        check_state_colours(page, scheme)


# The names of the colours of states, and of the area of the battery next to them in the timeline.
STATE_COLOURS = ("sensing", "reporting", "woken", "failed", "asleep", "unpowered", "out", "battery")
# Linear RGB as seen with each kind of dichromacy (Machado et al., 2009, severity 1), and without.
VISIONS = {
    "full": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "protanopia": ((0.152286, 1.052583, -0.204868), (0.114503, 0.786281, 0.099216), (-0.003882, -0.048116, 1.051998)),
    "deuteranopia": ((0.367322, 0.860646, -0.227968), (0.280085, 0.672501, 0.047413), (-0.011820, 0.042940, 0.968881)),
    "tritanopia": ((1.255528, -0.076749, -0.178779), (-0.078411, 0.930809, 0.147602), (0.004733, 0.691367, 0.303900)),
}


def check_state_colours(page, scheme):
    """The colours of two states differ for everyone: by a distance of 0.12 in the colour space Oklab."""
    read = "((style) => (name) => style.getPropertyValue(`--${name}`).trim())(getComputedStyle(document.documentElement))"
    colours = dict(zip(STATE_COLOURS, page.value(f"{json.dumps(STATE_COLOURS)}.map({read})")))
    for vision, matrix in VISIONS.items():
        seen = {name: oklab(matrix, colour) for name, colour in colours.items()}
        for (one, a), (other, b) in itertools.combinations(seen.items(), 2):
            assert math.dist(a, b) > 0.12, (scheme, vision, one, other, math.dist(a, b))


def oklab(matrix, colour):
    """The Oklab coordinates (Ottosson, 2020) of a colour such as #0072b2, seen through a matrix on linear RGB."""
    shares = [int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5)]
    linear = [share / 12.92 if share <= 0.04045 else ((share + 0.055) / 1.055) ** 2.4 for share in shares]
    product = lambda rows, vector: [sum(a * b for a, b in zip(row, vector)) for row in rows]
    rgb = [min(max(share, 0), 1) for share in product(matrix, linear)]
    cones = product(((0.4122214708, 0.5363325363, 0.0514459929), (0.2119034982, 0.6806995451, 0.1073969566), (0.0883024619, 0.2817188376, 0.6299787005)), rgb)
    rows = ((0.2104542553, 0.7936177850, -0.0040720468), (1.9779984951, -2.4285922050, 0.4505937099), (0.0259040371, 0.7827717662, -0.8086757660))
    return product(rows, [cone ** (1 / 3) for cone in cones])


def check_grid(page):
    """The charts leave no blank cell at any width."""
    for width in (1280, 1440, 1920, 2560):
        page.shape(width, 1000, "light")
        page.until(f"innerWidth === {width}")
        # The layout is complete after two frames.
        page.value("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        rows = page.value(
            "(() => { const rows = {}, { right } = document.getElementById('charts').getBoundingClientRect();"
            " for (const chart of document.querySelectorAll('#charts .chart:not([hidden])')) { const box = chart.getBoundingClientRect();"
            "  rows[Math.round(box.top)] = Math.max(rows[Math.round(box.top)] ?? 0, box.right); }"
            " return Object.values(rows).map((end) => right - end); })()"
        )
        assert all(blank < 2 for blank in rows), (width, rows)


def check_shapes(page, pictures, name):
    """No size or colour scheme makes the page wider than the screen."""
    for size, width, height in (("desktop", 1440, 900), ("phone", 390, 844)):
        for scheme in ("light", "dark"):
            page.shape(width, height, scheme)
            page.value("scrollTo(0, 0)")
            time.sleep(0.3)
            wide = page.value("document.documentElement.scrollWidth")
            assert wide <= width, f"{name}, {size}: {wide} pixels wide"
            if size == "phone" and page.value("reveille.run.controls"):
                below = page.value("document.getElementById('clock').getBoundingClientRect().bottom <= document.getElementById('map').getBoundingClientRect().top")
                assert below, "the clock is above the map"
                clock = page.value("document.getElementById('time').getBoundingClientRect().height")
                assert clock <= 110, f"the clock takes {clock} pixels"
            if pictures:
                page.picture(pictures / f"{name}-{size}-{scheme}.png")


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def wait(condition, patience=20):
    end, error = time.monotonic() + patience, None
    while time.monotonic() < end:
        try:
            found = condition()
            if found:
                return found
        except (OSError, StopIteration) as one:
            error = one
        time.sleep(0.1)
    raise AssertionError(f"no result after {patience} s: {error}")


if __name__ == "__main__":
    main()
