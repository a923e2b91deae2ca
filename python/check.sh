#!/usr/bin/env bash
# Builds the wheel, installs it into a fresh venv, and tests it there. Without a suitable Python, pip or network it
# prints the reason and skips, or fails if the variable CI is true.
set -euo pipefail
cd "$(dirname "$0")"
skip() {
    echo "SKIPPED: the package for Python: $1" >&2
    [ "${CI:-}" = true ] && exit 1 || exit 0
}
target=${CARGO_TARGET_DIR:-../target}
case $target in /*) ;; *) target=$PWD/$target ;; esac
export CARGO_TARGET_DIR=$target
venv=$target/python/venv
wheels=$target/python/wheels
rm -rf "$venv" "$wheels"
python3 -c 'import sys; sys.exit(sys.version_info < (3, 10))' || skip "there is no python3 of version 3.10 or later here"
python3 -m venv "$venv" || skip "no Python environment can be made here"
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check 'maturin>=1.9,<2' || skip "maturin cannot be installed here"
"$venv/bin/maturin" build --quiet --release --locked --interpreter "$venv/bin/python" --out "$wheels"
wheel=("$wheels"/reveille_emulator-*.whl)
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check "${wheel[0]}[test]"
# The emulator for the tests of the policy client, if it is built.
program=$target/release/reveille
if [ -x "$program" ]; then export REVEILLE=$program; else
    echo "SKIPPED: no $program, so deciding for it is not tested" >&2
    [ "${CI:-}" != true ] || exit 1
fi
# Another working folder ensures that the tests use the wheel and not the sources next to them.
cd tests
PYTHONDONTWRITEBYTECODE=1 "$venv/bin/python" -m pytest -q -p no:cacheprovider .
