#!/usr/bin/env python3
"""Runs the benchmarks of docs/benchmarks.md on this machine and writes their output there.

    cargo build --release
    deploy/bench/write_page.py target/release/reveille                 # all, about half an hour
    deploy/bench/write_page.py target/release/reveille memory study    # only commands with one of these words

The page states each command in a comment, `<!-- bench: COMMAND -->`; the text up to `<!-- /bench -->` is replaced by
the command, the machine and the output. `reveille` in a command is the given program. Nothing else should run.
"""

import os
import re
import shlex
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
PAGE = ROOT / "docs" / "benchmarks.md"
BLOCK = re.compile(r"<!-- bench: (?P<command>.+?) -->\n.*?<!-- /bench -->", re.DOTALL)


def machine():
    """Describes the machine: date, processor, cores and load."""
    info = Path("/proc/cpuinfo").read_text()
    model = re.search(r"model name\s*: (.+)", info)
    name = re.sub(r"\s+", " ", model[1]) if model else os.uname().machine
    load = os.getloadavg()[0]
    return f"{time.strftime('%Y-%m-%d')}, {name}, {os.cpu_count()} cores, load {load:.1f} before"


def measure(command, program):
    """Runs `command` and returns the block of the page with its output."""
    print(f"{command} ...", flush=True)
    about = machine()
    quoted = shlex.quote(str(program))
    actual = re.sub(r"\breveille (?=bench|analyse)", lambda _: f"{quoted} ", command)
    finished = subprocess.run(actual, shell=True, cwd=ROOT, stdout=subprocess.PIPE, text=True, encoding="utf-8")
    if finished.returncode != 0:
        sys.exit(f"{command}: ended with {finished.returncode}; its block on the page is unchanged")
    lines = "\n".join(line.rstrip() for line in finished.stdout.strip("\n").split("\n"))
    return f"<!-- bench: {command} -->\n{about}:\n\n```console\n$ {command}\n{lines}\n```\n<!-- /bench -->"


def main():
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    program, words = Path(sys.argv[1]).resolve(), set(sys.argv[2:])
    if not program.is_file():
        sys.exit(f"{program}: no such file; build it: cargo build --release")
    commands = [block["command"] for block in BLOCK.finditer(PAGE.read_text(encoding="utf-8"))]
    wanted = [command for command in commands if not words or not words.isdisjoint(command.split())]
    if not wanted:
        sys.exit(f"no command with {' or '.join(sorted(words))}; the page has:\n" + "\n".join(commands))
    for command in wanted:
        new = measure(command, program)
        page = PAGE.read_text(encoding="utf-8")
        page = BLOCK.sub(lambda block: new if block["command"] == command else block[0], page)
        PAGE.write_text(page, encoding="utf-8")


main()
