"""Checks the metrics of a run (`--metrics`) with Prometheus: promtool reports no problem, the values that the server scrapes
agree with the run's summary, every query of the Grafana dashboard returns data, and the dashboard has only fields and panel types
of Grafana's schema. Only a few of the metrics are compared.

    python tests/monitoring/check.py target/release/reveille

Needs `prometheus` with `promtool`, for example from Debian, and grafana-foundation-sdk from PyPI. Everything listens on loopback.
"""

import argparse
import json
import re
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

from grafana_foundation_sdk.cog import plugins, runtime
from grafana_foundation_sdk.cog.encoder import JSONEncoder
from grafana_foundation_sdk.models.dashboard import Dashboard

MONITORING = Path(__file__).resolve().parents[2] / "deploy/docker/monitoring"
TTIS = 10000
DEVICES = 40


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("reveille", type=Path)
    args = parser.parse_args()
    for program in ("prometheus", "promtool"):
        if not shutil.which(program):
            sys.exit(f"{program}: not installed; metrics not checked")
    check_grafana_schema()
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
        # The configuration of the testbed, with another address.
        shutil.copy(MONITORING / "alerts.yml", folder)
        config = (MONITORING / "prometheus.yml").read_text()
        assert "bs:9464" in config
        (folder / "prometheus.yml").write_text(config.replace("bs:9464", address))
        config_check = subprocess.run(["promtool", "check", "config", folder / "prometheus.yml"], capture_output=True, text=True)
        assert config_check.returncode == 0, config_check.stdout + config_check.stderr
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
        assert query("sum(reveille_host_devices{pid!=''})") == DEVICES
        assert query("reveille_devices_with_battery{at_most='100'}") == DEVICES
        # A pace of 2 ms allows 500 TTIs a second.
        wait_for(lambda: 100 < query("rate(reveille_ttis_total[4s])") < 600)
        for expression in dashboard_expressions():
            wait_for(lambda: query_series(port, expression), f"data for the Grafana dashboard: {expression}")
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


def check_grafana_schema():
    """Decodes the dashboard with the types that Grafana generates from its schemas, and checks that no field is lost."""
    plugins.register_default_plugins()
    dashboard = read_dashboard()
    for panel in dashboard["panels"]:
        assert runtime.panelcfg_config(panel["type"]), f"Grafana has no panel of type {panel['type']}"
    decoded = json.loads(JSONEncoder().encode(Dashboard.from_json(dashboard)))
    unknown = list(lost_fields(dashboard, decoded))
    assert not unknown, f"fields that Grafana does not know or reads otherwise: {', '.join(unknown)}"
    # The dashboard finds its data source by this uid.
    uids = {panel["datasource"]["uid"] for panel in dashboard["panels"]}
    provisioned = re.findall(r"uid: (.+)", (MONITORING / "grafana/datasource.yml").read_text())
    assert uids == set(provisioned), f"data sources of the dashboard: {uids}; provisioned: {provisioned}"


def lost_fields(written, decoded, path=""):
    """Yields the paths in `written` whose values differ in `decoded`, which may have further fields."""
    if isinstance(written, dict) and isinstance(decoded, dict):
        for name, item in written.items():
            yield from lost_fields(item, decoded.get(name), f"{path}/{name}")
    elif isinstance(written, list) and isinstance(decoded, list) and len(written) == len(decoded):
        for index, item in enumerate(written):
            yield from lost_fields(item, decoded[index], f"{path}/{index}")
    elif written != decoded:
        yield path


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


def dashboard_expressions():
    """Returns the queries of the Grafana dashboard."""
    return [target["expr"] for panel in read_dashboard()["panels"] for target in panel["targets"]]


def read_dashboard():
    return json.loads((MONITORING / "grafana/run.json").read_text())


def query_series(port, expression):
    """Returns the series of the expression's result, without those whose value is NaN."""
    query = urllib.parse.urlencode({"query": expression})
    result = json.loads(get(f"http://127.0.0.1:{port}/api/v1/query?{query}"))["data"]["result"]
    return [series for series in result if series["value"][1] != "NaN"]


def query_prometheus(port, expression):
    """Returns the first value of the expression's result; 0 without a result."""
    series = query_series(port, expression)
    return float(series[0]["value"][1]) if series else 0.0


def value(text, name):
    """Returns the value of a metric without labels in the text of `/metrics`."""
    return next(float(line.split()[1]) for line in text.splitlines() if line.startswith(name + " "))


def wait_for(poll, what="a result", patience=30):
    """Returns the first result of `poll` that is true; `what` names it."""
    deadline = time.monotonic() + patience
    while time.monotonic() < deadline:
        try:
            result = poll()
            if result:
                return result
        except (urllib.error.URLError, ConnectionError):
            pass
        time.sleep(0.1)
    raise AssertionError(f"no {what} after {patience} s")


if __name__ == "__main__":
    main()
