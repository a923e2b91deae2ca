//! The clock on the wall, which paces a run and bounds waits and has no say in its results.

use std::time::Instant;

/// This moment.
#[expect(
    clippy::disallowed_methods,
    reason = "the shell keeps the pace and reports how long things took"
)]
pub(super) fn now() -> Instant {
    Instant::now()
}
