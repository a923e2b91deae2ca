//! Ctrl-C, SIGTERM and a closed terminal: the first asks for a clean end, the second ends at once.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use tokio::signal::unix::{SignalKind, signal};

/// Waits for the first signal.
///
/// # Errors
/// If the handlers cannot be installed.
pub async fn told() -> std::io::Result<()> {
    let (mut interrupt, mut terminate) = (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?);
    let mut hang_up = signal(SignalKind::hangup())?;
    tokio::select! {
        _ = interrupt.recv() => {}
        _ = terminate.recv() => {}
        _ = hang_up.recv() => {}
    }
    Ok(())
}

/// Watches for signals; the flag is set at the first one.
///
/// # Errors
/// If the handlers cannot be installed.
pub fn watch() -> std::io::Result<Arc<AtomicBool>> {
    let flag = Arc::new(AtomicBool::new(false));
    let (mut interrupt, mut terminate) = (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?);
    let mut hang_up = signal(SignalKind::hangup())?;
    let set = Arc::clone(&flag);
    tokio::spawn(async move {
        loop {
            tokio::select! {
                _ = interrupt.recv() => {}
                _ = terminate.recv() => {}
                _ = hang_up.recv() => {}
            }
            if set.swap(true, Ordering::Relaxed) {
                crate::exit::Exit::Interrupted.now();
            }
            tracing::warn!("ending as soon as what there is can be kept; once more to end at once");
        }
    });
    Ok(flag)
}
