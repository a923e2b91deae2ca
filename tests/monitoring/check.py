"""Checks the metrics of `reveille up` with Prometheus: promtool reports no problem, and the values fit the run's summary.

    python tests/monitoring/check.py target/release/reveille

Needs `prometheus` with `promtool`, for example from Debian. Everything listens on loopback.
"""

import argparse
import json
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.parse
import urllib.request
from pathlib import Path

TTIS = 4000


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("reveille", type=Path)
    args = parser.parse_args()
    for program in ("prometheus", "promtool"):
        if not shutil.which(program):
            sys.exit(f"{program}: not installed; metrics not checked")
    with tempfile.TemporaryDirectory() as folder:
        check(args.reveille.resolve(), Path(folder))


def check(reveille, here):
    address = f"127.0.0.1:{free_port()}"
    command = f"up -p knn -n 40 -k {TTIS} -P 2 --pace 2ms --json --out out --window 100 --metrics {address}"
    run = subprocess.Popen([reveille, *command.split()], cwd=here, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    server = None
    try:
        url = f"http://{address}/metrics"
        text = wait(lambda: get(url))
        lint = subprocess.run(["promtool", "check", "metrics"], input=text, capture_output=True, text=True)
        assert lint.returncode == 0 and not lint.stderr.strip(), lint.stderr
        assert get(url, Accept="application/openmetrics-text").endswith("# EOF\n")
        assert status(url, Host="evil.example") == 421
        assert get(url.replace("/metrics", "/")).startswith("# HELP"), "the redirect to /metrics"
        assert status(url.replace("/metrics", "/other")) == 404
        port = free_port()
        (here / "prometheus.yml").write_text(
            "global: { scrape_interval: 1s }\n"
            f"scrape_configs: [{{ job_name: reveille, static_configs: [{{ targets: ['{address}'] }}] }}]\n"
        )
        server = subprocess.Popen(
            [
                "prometheus",
                f"--config.file={here / 'prometheus.yml'}",
                f"--storage.tsdb.path={here / 'data'}",
                f"--web.listen-address=127.0.0.1:{port}",
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        query = lambda text: query_prometheus(port, text)
        wait(lambda: query("reveille_ttis_total") > 0)
        assert query("reveille_hosts_alive") == 2
        assert query("sum(reveille_devices)") == 40
        assert query("reveille_devices_with_battery{at_most='100'}") == 40
        # A pace of 2 ms allows 500 TTIs a second.
        wait(lambda: 100 < query("rate(reveille_ttis_total[4s])") < 600)
        # Reads the last metrics before the end of the run, more often than Prometheus does.
        last, ttis_before = None, 0
        while run.poll() is None:
            try:
                last = get(url) or last
            except (urllib.error.URLError, ConnectionError):
                # The run ends during the request.
                pass
            if last:
                ttis = value(last, "reveille_ttis_total")
                assert ttis >= ttis_before, f"the counter fell from {ttis_before} to {ttis}"
                ttis_before = ttis
            time.sleep(0.05)
        out, err = run.communicate()
        assert run.returncode == 0, err
        summary = json.loads(out)
        scraped_ttis = query("last_over_time(reveille_ttis_total[1m])")
        assert 1000 < scraped_ttis <= TTIS, scraped_ttis
        missing_ttis = TTIS - value(last, "reveille_ttis_total")
        assert 0 <= missing_ttis < 300, f"{missing_ttis} TTIs after the last metrics"
        events = summary["totals"]["events"]["events"]
        assert events - missing_ttis <= value(last, "reveille_events_total") <= events
        print(f"{len(text.splitlines())} lines of metrics, {scraped_ttis:.0f} of {TTIS} TTIs scraped, the last values fit the summary")
    finally:
        for process in (run, server):
            if process and process.poll() is None:
                process.kill()
                process.wait()


def free_port():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def get(url, **headers):
    with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=5) as response:
        return response.read().decode()


def status(url, **headers):
    try:
        get(url, **headers)
    except urllib.error.HTTPError as error:
        return error.code
    return 200


def query_prometheus(port, text):
    query = urllib.parse.urlencode({"query": text})
    results = json.loads(get(f"http://127.0.0.1:{port}/api/v1/query?{query}"))["data"]["result"]
    return float(results[0]["value"][1]) if results else 0.0


def value(metrics, name):
    return next(float(line.split()[1]) for line in metrics.splitlines() if line.startswith(name + " "))


def wait(poll, patience=30):
    deadline = time.monotonic() + patience
    while time.monotonic() < deadline:
        try:
            value = poll()
            if value:
                return value
        except (urllib.error.URLError, ConnectionError):
            pass
        time.sleep(0.1)
    raise AssertionError(f"no result after {patience} s")


if __name__ == "__main__":
    main()
