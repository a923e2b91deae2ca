"""Checks the metrics of a run (`--metrics`) with Prometheus: promtool reports no problem, and the values that the server
scrapes agree with the run's summary. Only a few of the metrics are compared.

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
DEVICES = 40


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("reveille", type=Path)
    args = parser.parse_args()
    for program in ("prometheus", "promtool"):
        if not shutil.which(program):
            sys.exit(f"{program}: not installed; metrics not checked")
    with tempfile.TemporaryDirectory() as folder:
        check(args.reveille.resolve(), Path(folder))


def check(reveille, folder):
    address = f"127.0.0.1:{free_port()}"
    command = f"up -p knn -n {DEVICES} -k {TTIS} -P 2 --pace 2ms --json --out out --window 100 --metrics {address}"
    run = subprocess.Popen([reveille, *command.split()], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    server = None
    try:
        url = f"http://{address}/metrics"
        text = wait_for(lambda: get(url))
        lint = subprocess.run(["promtool", "check", "metrics"], input=text, capture_output=True, text=True)
        assert lint.returncode == 0 and not lint.stderr.strip(), lint.stderr
        assert get(url, Accept="application/openmetrics-text").endswith("# EOF\n")
        assert status(url, Host="evil.example") == 421
        assert get(url.replace("/metrics", "/")).startswith("# HELP"), "the redirect to /metrics"
        assert status(url.replace("/metrics", "/other")) == 404
        port = free_port()
        (folder / "prometheus.yml").write_text(
            "global: { scrape_interval: 1s }\n"
            f"scrape_configs: [{{ job_name: reveille, static_configs: [{{ targets: ['{address}'] }}] }}]\n"
        )
        server = subprocess.Popen(
            [
                "prometheus",
                f"--config.file={folder / 'prometheus.yml'}",
                f"--storage.tsdb.path={folder / 'data'}",
                f"--web.listen-address=127.0.0.1:{port}",
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        query = lambda expression: query_prometheus(port, expression)
        wait_for(lambda: query("reveille_ttis_total") > 0)
        assert query("reveille_hosts_alive") == 2
        assert query("sum(reveille_devices)") == DEVICES
        assert query("reveille_devices_with_battery{at_most='100'}") == DEVICES
        # A pace of 2 ms allows 500 TTIs a second.
        wait_for(lambda: 100 < query("rate(reveille_ttis_total[4s])") < 600)
        # Reads the last metrics before the end of the run more often than Prometheus does.
        last_text, last_ttis = None, 0
        while run.poll() is None:
            try:
                last_text = get(url)
            except urllib.error.URLError:
                # The server no longer listens. A request that it has accepted must have its response.
                pass
            if last_text:
                ttis = value(last_text, "reveille_ttis_total")
                assert ttis >= last_ttis, f"the counter of TTIs fell from {last_ttis} to {ttis}"
                last_ttis = ttis
            time.sleep(0.05)
        stdout, stderr = run.communicate()
        assert run.returncode == 0, stderr
        summary = json.loads(stdout)
        scraped_ttis = query(f"last_over_time(reveille_ttis_total[1m])")
        assert 1000 < scraped_ttis <= TTIS, f"{scraped_ttis} TTIs scraped"
        # TTIs after the last read; at most one event starts in each of them.
        unread_ttis = TTIS - value(last_text, "reveille_ttis_total")
        assert 0 <= unread_ttis < 300, f"{unread_ttis} TTIs after the last read"
        events = summary["totals"]["events"]["events"]
        assert events - unread_ttis <= value(last_text, "reveille_events_total") <= events
        print(f"{len(text.splitlines())} lines of metrics, {scraped_ttis:.0f} of {TTIS} TTIs scraped, as in the summary")
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


def query_prometheus(port, expression):
    """Returns the first value of the expression's result; 0 without a result."""
    query = urllib.parse.urlencode({"query": expression})
    result = json.loads(get(f"http://127.0.0.1:{port}/api/v1/query?{query}"))["data"]["result"]
    return float(result[0]["value"][1]) if result else 0.0


def value(text, name):
    """Returns the value of a metric without labels in the text of `/metrics`."""
    return next(float(line.split()[1]) for line in text.splitlines() if line.startswith(name + " "))


def wait_for(poll, patience=30):
    """Returns the first result of `poll` that is true."""
    deadline = time.monotonic() + patience
    while time.monotonic() < deadline:
        try:
            result = poll()
            if result:
                return result
        except (urllib.error.URLError, ConnectionError):
            pass
        time.sleep(0.1)
    raise AssertionError(f"no result after {patience} s")


if __name__ == "__main__":
    main()
