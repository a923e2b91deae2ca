//! `reveille train dt` in a build that cannot.

use std::process::ExitCode;

use crate::cli::DtArgs;
use crate::display::note;

/// Says how to get a build that can.
#[expect(clippy::unnecessary_wraps, reason = "as in the build that can")]
pub fn run(_: &DtArgs) -> anyhow::Result<ExitCode> {
    note!(
        "reveille: train dt needs the cargo feature train-dt, which brings a training framework of some 150 crates: \
         cargo run --release --features train-dt -- train dt …"
    );
    Ok(ExitCode::from(2))
}
