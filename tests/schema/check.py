#!/usr/bin/env python3
"""Checks the JSON Schema of scenario files with a validator that is not ours.

    pip install jsonschema
    reveille scenario schema --out reveille.schema.json
    tests/schema/check.py reveille.schema.json

The shipped scenarios, the presets and what `reveille scenario show` prints have to pass, each file in `broken/` has to be
refused. `--reveille PROGRAM` adds the scenarios that the program prints. The exit code is 1 if anything is otherwise.
"""

import argparse
import json
import subprocess
import sys
import tomllib
from pathlib import Path

from jsonschema import Draft202012Validator

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("schema", type=Path)
    parser.add_argument("--reveille", help="the program; checks its output for each preset")
    args = parser.parse_args()
    schema = json.loads(args.schema.read_text(encoding="utf-8"))
    Draft202012Validator.check_schema(schema)
    validator = Draft202012Validator(schema)

    def problem(text: str) -> str | None:
        first = next(iter(validator.iter_errors(tomllib.loads(text))), None)
        return first and f"{first.json_path}: {first.message}"

    good = {
        str(path.relative_to(ROOT)): path.read_text(encoding="utf-8")
        for folder in ("deploy/scenarios", "common/src/scenario/presets")
        for path in sorted((ROOT / folder).glob("*.toml"))
    }
    if args.reveille:
        for preset in ("paper", "paper-literal", "quick"):
            show = [args.reveille, "scenario", "show", preset]
            good[f"scenario show {preset}"] = subprocess.run(show, check=True, capture_output=True, text=True).stdout
    broken = {path.name: path.read_text(encoding="utf-8") for path in sorted((HERE / "broken").glob("*.toml"))}
    failures = 0
    for name, text in good.items():
        found = problem(text)
        failures += found is not None
        print(f"{'ok     ' if found is None else 'REFUSED'} {name}{f': {found}' if found else ''}")
    for name, text in broken.items():
        found = problem(text)
        failures += found is None
        print(f"{'refused' if found else 'PASSED '} broken/{name}{f': {found}' if found else ''}")
    print(f"{len(good)} good and {len(broken)} broken files, {failures} not as they should be")
    return 1 if failures or not good or len(broken) < 10 else 0


if __name__ == "__main__":
    sys.exit(main())
