#!/usr/bin/env bash
# Builds the wheel, installs it into a fresh venv, and tests it there. Where there is no pip or no network it says so.
set -euo pipefail
cd "$(dirname "$0")"
target=${CARGO_TARGET_DIR:-../target}
case $target in /*) ;; *) target=$PWD/$target ;; esac
export CARGO_TARGET_DIR=$target
venv=$target/python/venv
wheels=$target/python/wheels
rm -rf "$venv" "$wheels"
python3 -m venv "$venv" || { echo "no Python environment can be made here: the package for Python is not checked"; exit 0; }
if ! "$venv/bin/python" -m pip install --quiet --disable-pip-version-check 'maturin>=1.9,<2'; then
    echo "maturin cannot be installed here: the package for Python is not checked"
    exit 0
fi
"$venv/bin/maturin" build --quiet --release --locked --interpreter "$venv/bin/python" --out "$wheels"
wheel=("$wheels"/reveille-*.whl)
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check "${wheel[0]}[test]"
# The emulator that it decides for, if it is built.
program=$target/release/reveille
if [ -x "$program" ]; then export REVEILLE=$program; else echo "no $program: deciding for it is not tested"; fi
# From another folder, so that it is the wheel that is tested and not the sources beside it.
cd tests
PYTHONDONTWRITEBYTECODE=1 "$venv/bin/python" -m pytest -q -p no:cacheprovider .
