//! Ctrl-C, SIGTERM and a closed terminal: the first asks for a clean end, the second ends at once.

use std::fs;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};

use tokio::signal::unix::{Signal, SignalKind, signal};

/// Waits for the first signal.
///
/// # Errors
/// If the handlers cannot be installed.
pub async fn told() -> std::io::Result<()> {
    Signals::install()?.any().await;
    Ok(())
}

/// Watches for signals; the flag is set at the first one.
///
/// # Errors
/// If the handlers cannot be installed.
pub fn watch() -> std::io::Result<Arc<AtomicBool>> {
    let flag = Arc::new(AtomicBool::new(false));
    let mut signals = Signals::install()?;
    let set = Arc::clone(&flag);
    tokio::spawn(async move {
        loop {
            let told = signals.next().await;
            let is_first = !set.swap(true, Ordering::Relaxed);
            match told {
                Told::Asked | Told::HungUp if is_first => {
                    tracing::warn!("ending as soon as what there is can be kept; once more to end at once");
                }
                Told::Asked => crate::exit::Exit::Interrupted.now(),
                // A terminal that closes says so more than once: the kernel does, and its shell.
                Told::HungUp => {}
            }
        }
    });
    Ok(flag)
}

/// What a signal says.
enum Told {
    /// Somebody wants the end.
    Asked,
    /// The terminal is gone.
    HungUp,
}

/// The signals that end a command. Once these are there, none ends it by itself.
pub struct Signals {
    interrupt: Signal,
    terminate: Signal,
    /// None under `nohup`, which has asked to outlive the terminal.
    hang_up: Option<Signal>,
}

impl Signals {
    /// Begins to watch for them.
    ///
    /// # Errors
    /// If the handlers cannot be installed.
    pub fn install() -> std::io::Result<Self> {
        Ok(Self {
            interrupt: signal(SignalKind::interrupt())?,
            terminate: signal(SignalKind::terminate())?,
            hang_up: if is_under_nohup() {
                None
            } else {
                Some(signal(SignalKind::hangup())?)
            },
        })
    }

    /// Waits for the next of them.
    pub async fn any(&mut self) {
        self.next().await;
    }

    async fn next(&mut self) -> Told {
        let hung_up = async {
            match &mut self.hang_up {
                Some(signal) => signal.recv().await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            _ = self.interrupt.recv() => Told::Asked,
            _ = self.terminate.recv() => Told::Asked,
            _ = hung_up => Told::HungUp,
        }
    }
}

/// Whether this process was started to ignore that its terminal closes. A handler takes that away, so it is asked once.
fn is_under_nohup() -> bool {
    static ANSWER: OnceLock<bool> = OnceLock::new();
    *ANSWER.get_or_init(|| {
        let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
        let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
        let mask = mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok());
        mask.is_some_and(|mask| mask >> (SignalKind::hangup().as_raw_value() - 1) & 1 == 1)
    })
}
