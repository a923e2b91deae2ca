# Common tasks. To install just: `cargo install --locked just`, or `pip install rust-just`.

# Tools that `just tools` installs. Programs elsewhere on the path take precedence.
export PATH := env("PATH") + ":" + justfile_directory() / "target/venv/bin"

# Recipes receive their arguments as "$1", "$2" and so on, which keeps quoted spaces.
set positional-arguments

# List the recipes.
default:
    @just --list

# Check formatting, spelling, lints and library tests; before each commit.
check: tools
    cargo fmt --all --check
    typos
    cargo clippy --workspace --all-targets --locked -- -D warnings
    cargo test --workspace --lib --locked --quiet

# Run every check of continuous integration; before a pull request.
full:
    .ci/run

# Start a base station and device processes, and show the run.
up *arguments:
    cargo run --release --locked -- up "$@"

# Build the documentation of the code, in target/doc.
doc:
    cargo doc --workspace --no-deps --document-private-items --locked

# Build the pages of docs/ as a site in target/book, and check its links.
book: tools
    mdbook build docs
    python3 tests/book/check.py target/book

# Install missing text tools into target/venv.
tools:
    @command -v typos >/dev/null && command -v mdbook >/dev/null || \
        { python3 -m venv target/venv && target/venv/bin/pip install --quiet -r .ci/requirements.txt; }
