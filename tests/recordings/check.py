"""Reads recordings and exports with third-party programs; the messages must equal `reveille inspect tail --json`.

    python tests/recordings/check.py target/release/reveille

`mcap` from PyPI reads the recording, tshark with the dissector the packets, the schema of Perfetto from PyPI the trace,
and pyarrow the table. Without one of these programs the exit code is 1; --allow-missing skips its check.
"""

import argparse
import csv
import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

NANOS_PER_TTI = 1_000_000


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("reveille", type=Path)
    parser.add_argument("--allow-missing", action="store_true")
    args = parser.parse_args()
    reveille = args.reveille.resolve()
    missing = []
    with tempfile.TemporaryDirectory() as folder:
        for number, command in enumerate(RUNS):
            run_folder = Path(folder) / str(number)
            run_folder.mkdir()
            run = Run(reveille, run_folder, command)
            for check in CHECKS:
                try:
                    check(run)
                except Missing as program:
                    missing.append(str(program))
            print(f"{command}: {len(run.lines)} messages, equal in all checked formats")
    if missing:
        print("not checked:", ", ".join(sorted(set(missing))))
        sys.exit(0 if args.allow_missing else 1)


# Policies that send few and many plans, devices that fail, states; in memory and over the bus.
RUNS = [
    "up -p knn -n 30 -k 1500 -P 3 --record-states 100",
    "run -p age-index -n 60 -k 800 --set harvest.e_b=2",
]


class Missing(Exception):
    """A program that a check needs is not installed."""


class Run:
    """A recorded run with its exports and its `tail --json` output."""

    def __init__(self, reveille, folder, command):
        self.reveille, self.folder = reveille, folder
        self.file = folder / "run.mcap"
        self.call(*command.split(), "--quiet", "--out", "out", "--record", str(self.file))
        self.call("inspect", "verify", str(self.file))
        tail = self.call("inspect", "tail", str(self.file), "--json")
        self.lines = [json.loads(line) for line in tail.splitlines()]
        # The text of a message follows its number of bytes.
        tail = self.call("inspect", "tail", str(self.file))
        self.texts = [line.split(" B  ", 1)[1] for line in tail.splitlines()]
        assert len(self.texts) == len(self.lines)
        assert len(self.lines) > 1000, f"only {len(self.lines)} messages"

    def call(self, *args):
        process = subprocess.run([self.reveille, *args], cwd=self.folder, capture_output=True, text=True)
        assert process.returncode == 0, (args, process.stderr)
        return process.stdout

    def export(self, form):
        path = self.folder / f"run.{form}"
        self.call("inspect", "export", str(self.file), "--to", form, "--out", str(path))
        return path


def check_mcap(run):
    try:
        from mcap.reader import make_reader
    except ImportError:
        raise Missing("mcap (PyPI)")
    with open(run.file, "rb") as file:
        reader = make_reader(file)
        assert reader.get_summary().statistics.message_count == len(run.lines)
        attachments = {attachment.name for attachment in reader.iter_attachments()}
        assert {"scenario.toml", "summary.json"} <= attachments, attachments
        # File order, since several messages have the same log time.
        messages = list(reader.iter_messages(log_time_order=False))
    assert [json.loads(message.data) for _, _, message in messages] == run.lines
    for (schema, channel, message), line in zip(messages, run.lines):
        assert channel.topic == f"/{line['plane']}/{line['kind']}"
        assert channel.message_encoding == "json" and schema.encoding == "jsonschema"
        assert message.log_time == line["tti"] * NANOS_PER_TTI
    schemas = {schema.name: json.loads(schema.data) for schema, _, _ in messages}
    try:
        from jsonschema import Draft202012Validator
    except ImportError:
        raise Missing("jsonschema (PyPI)")
    validators = {name: Draft202012Validator(schema) for name, schema in schemas.items()}
    for schema, _, message in messages:
        validators[schema.name].validate(json.loads(message.data))


def snake_case(name):
    """Returns the dissector's name of a variant, such as `grant_done` for `GrantDone`."""
    return re.sub(r"(?<=.)(?=[A-Z])", "_", name).lower()


def flatten(value, path):
    """Yields the dissector names and values of the numbers and texts among a message's fields."""
    if isinstance(value, dict):
        for key, inner in value.items():
            if inner is None:
                continue
            # Only names of variants begin with a capital.
            if key[:1].isupper():
                yield f"{path}.is", key
                yield from flatten(inner, f"{path}.{snake_case(key)}")
            else:
                yield from flatten(inner, f"{path}.{key}")
    elif isinstance(value, str) and value[:1].isupper():
        yield f"{path}.is", value
    elif isinstance(value, (int, float, str)):
        yield path, value


def check_pcapng(run):
    if not shutil.which("tshark"):
        raise Missing("tshark")
    dissector = run.folder / "reveille.lua"
    run.call("inspect", "export", "--dissector", str(dissector))
    command = ["tshark", "-X", f"lua_script:{dissector}", "-r", str(run.export("pcapng"))]
    process = subprocess.run([*command, "-T", "ek"], capture_output=True, text=True)
    assert process.returncode == 0, process.stderr
    packets = [json.loads(line) for line in process.stdout.splitlines() if '"timestamp"' in line]
    assert len(packets) == len(run.lines), (len(packets), len(run.lines))
    compared_values = 0
    for packet, line in zip(packets, run.lines):
        layer = packet["layers"]["reveille"]
        get = lambda path: layer.get("reveille_reveille_" + path.replace(".", "_"))
        assert get("kind") == line["kind"] and int(get("tti")) == line["tti"], (layer, line)
        assert int(get("bytes")) == line["bytes"] and "_ws_malformed" not in str(layer), layer
        expected_values = {}
        for path, value in flatten(line["message"], line["kind"]):
            expected_values.setdefault(path, []).append(value)
        for path, values in expected_values.items():
            shown_values = get(path)
            shown_values = shown_values if isinstance(shown_values, list) else [shown_values]
            # Numbers of more than 64 bits are texts in another base.
            if path.endswith("_sum") or path.endswith("_pico"):
                continue
            for shown, value in zip(shown_values, values):
                compared_values += 1
                if isinstance(value, bool):
                    assert str(shown).lower() in (str(value).lower(), str(int(value))), (path, shown, value)
                elif isinstance(value, (int, float)):
                    # tshark shows six digits of a number.
                    assert abs(float(shown) - value) <= 1e-5 * max(1.0, abs(value)), (path, shown, value)
                else:
                    assert shown == value, (path, shown, value)
    assert compared_values > 3 * len(run.lines), f"only {compared_values} values compared"
    # A display filter on a field of the dissector.
    device = next(line["number"] for line in run.lines if line["kind"] == "report")
    filtered = subprocess.run(
        [*command, "-Y", f"reveille.report.device == {device}", "-T", "fields", "-e", "reveille.tti"],
        capture_output=True, text=True,
    )
    expected_ttis = [line["tti"] for line in run.lines if line["kind"] == "report" and line["number"] == device]
    assert [int(tti) for tti in filtered.stdout.split()] == expected_ttis
    check_packet_list(run, command)


def check_packet_list(run, command):
    """Compares the columns of tshark, and the filter on each kind, with the lines of `inspect tail`."""
    # The info separates source and destination, between which tshark would print an arrow.
    columns = [*command, "-T", "tabs", "-o", 'gui.column.format:"source","%s","info","%i","destination","%d"']
    parties = {
        "plan": ("BS", "all devices"), "wake": ("BS", "device {}"), "report": ("device {}", "BS"),
        "answer": ("host {}", "BS"), "clock": ("BS", "all hosts"), "woken": ("world", "observers"),
    }
    kinds = {line["kind"] for line in run.lines} & parties.keys()
    # The run over the bus has answers, the run in memory wake-ups.
    assert {"plan", "report"} < kinds, kinds
    for kind in kinds:
        lines = [(line, text) for line, text in zip(run.lines, run.texts) if line["kind"] == kind]
        listed = subprocess.run([*columns, "-Y", f"reveille.{kind}"], capture_output=True, text=True)
        rows = [[cell.strip() for cell in row.split("\t")] for row in listed.stdout.splitlines()]
        assert len(rows) == len(lines), (kind, len(rows), len(lines), listed.stderr)
        for (source, info, destination), (line, expected_text) in zip(rows, lines):
            expected = tuple(party.format(line["number"]) for party in parties[kind])
            assert (source, destination) == expected, (source, destination, line)
            header, text = info.split(": ", 1)
            assert header.startswith(f"TTI {line['tti']} {line['plane']} {kind}"), (info, line)
            assert text == expected_text, (info, expected_text)
    details = subprocess.run([*command, "-V", "-Y", "reveille.report"], capture_output=True, text=True).stdout
    assert "battery (micro-units): " in details and "tti (TTI): " in details, details[:2000]


def check_perfetto(run):
    try:
        from perfetto.protos.perfetto.trace import perfetto_trace_pb2 as pb
    except ImportError:
        raise Missing("perfetto (PyPI)")
    trace = pb.Trace()
    data = run.export("perfetto").read_bytes()
    assert trace.ParseFromString(data) in (None, len(data))
    assert trace.SerializeToString() == data, "a field that the schema does not know"
    tracks, open_slices, slices, flow_starts, flow_ends = {}, Counter(), Counter(), set(), set()
    for packet in trace.packet:
        if packet.HasField("track_descriptor"):
            tracks[packet.track_descriptor.uuid] = packet.track_descriptor
            continue
        event = packet.track_event
        assert event.track_uuid in tracks, event
        if event.type == pb.TrackEvent.TYPE_SLICE_BEGIN:
            open_slices[event.track_uuid] += 1
            slices[event.track_uuid, event.name] += 1
        elif event.type == pb.TrackEvent.TYPE_SLICE_END:
            open_slices[event.track_uuid] -= 1
        assert 0 <= open_slices[event.track_uuid] <= 1, event
        flow_starts.update(event.flow_ids)
        flow_ends.update(event.terminating_flow_ids)
    device_tracks = [track for track in tracks.values() if track.name.startswith("device ")]
    wake_ups = sum(line["kind"] == "wake" for line in run.lines)
    assert len(flow_starts) == wake_ups and flow_starts == flow_ends, (len(flow_starts), wake_ups)
    # A slice of S3 covers every TTI in which a device reported; consecutive reports share a slice.
    for device, track in enumerate(device_tracks):
        ttis = {line["tti"] for line in run.lines if line["kind"] == "report" and line["number"] == device}
        expected_slices = sum(tti - 1 not in ttis for tti in ttis)
        assert slices[track.uuid, "S3 transmission"] == expected_slices, (device, expected_slices)
    # Events still active at the end of the run have open slices.
    assert sum(open_slices.values()) <= 1, open_slices


def check_tables(run):
    with open(run.export("csv"), newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(run.lines)
    for row, line in zip(rows, run.lines):
        assert (int(row["tti"]), row["plane"], row["kind"]) == (line["tti"], line["plane"], line["kind"])
        assert json.loads(row["message"]) == line["message"]
        if row["kind"] == "report":
            assert float(row["information"]) == line["message"]["information"]
    try:
        import pyarrow.parquet as parquet
    except ImportError:
        raise Missing("pyarrow (PyPI)")
    columns = parquet.read_table(run.export("parquet")).to_pydict()
    assert columns["tti"] == [line["tti"] for line in run.lines]
    assert columns["number"] == [line["number"] for line in run.lines]
    assert [json.loads(message) for message in columns["message"]] == [line["message"] for line in run.lines]
    for information, line in zip(columns["information"], run.lines):
        assert information == (line["message"]["information"] if line["kind"] == "report" else None)


CHECKS = [check_mcap, check_pcapng, check_perfetto, check_tables]

if __name__ == "__main__":
    main()
