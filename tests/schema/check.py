#!/usr/bin/env python3
"""Checks the JSON Schema of scenario files with the validator of the package jsonschema.

    pip install jsonschema
    reveille scenario schema --out reveille.schema.json
    tests/schema/check.py reveille.schema.json

The shipped scenarios and the presets must be valid, each file in `broken/` must be invalid. `--reveille PROGRAM` adds
the output of `reveille scenario show` for each preset. The exit code is 1 if a file has the other result.
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

    def first_error(text: str) -> str | None:
        first = next(iter(validator.iter_errors(tomllib.loads(text))), None)
        return first and f"{first.json_path}: {first.message}"

    valid = {
        str(path.relative_to(ROOT)): path.read_text(encoding="utf-8")
        for folder in ("deploy/scenarios", "common/src/scenario/presets")
        for path in sorted((ROOT / folder).glob("*.toml"))
    }
    if args.reveille:
        for preset in ("paper", "paper-literal", "quick"):
            command = [args.reveille, "scenario", "show", preset]
            valid[f"scenario show {preset}"] = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    broken = {path.name: path.read_text(encoding="utf-8") for path in sorted((HERE / "broken").glob("*.toml"))}
    failures = 0
    for name, text in valid.items():
        error = first_error(text)
        failures += error is not None
        print(f"{'valid  ' if error is None else 'INVALID'} {name}{f': {error}' if error else ''}")
    for name, text in broken.items():
        error = first_error(text)
        failures += error is None
        print(f"{'invalid' if error else 'VALID  '} broken/{name}{f': {error}' if error else ''}")
    print(f"{len(valid)} valid and {len(broken)} broken files, {failures} with the wrong result")
    # A missing folder must not pass.
    return 1 if failures or not valid or len(broken) < 10 else 0


if __name__ == "__main__":
    sys.exit(main())
