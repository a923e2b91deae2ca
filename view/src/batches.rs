//! What another thread sends, a batch at a time.
//!
//! A thread that waits for each item is woken for each, and who sends them pays for that. One that sleeps for a moment
//! between batches is not.

use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::Duration;

/// How long the first item of a batch waits for others.
const PAUSE: Duration = Duration::from_millis(15);
/// A batch of so many items is followed by the next at once, so that nobody waits who sends much.
const MANY: usize = 1_000;

/// The niceness of a thread that watches.
#[cfg(target_os = "linux")]
const BEHIND: i32 = 10;

/// The receiving end of a bounded queue of at least some thousand items.
#[derive(Debug)]
pub struct Batches<T> {
    items: Receiver<T>,
    is_busy: bool,
}

impl<T> Batches<T> {
    /// What comes out of `items`.
    pub const fn new(items: Receiver<T>) -> Self {
        Self { items, is_busy: false }
    }

    /// The next batch, which has at least one item.
    ///
    /// # Errors
    /// If nothing has come for `patience`, or nothing can come any more.
    pub fn next(&mut self, patience: Duration) -> Result<Vec<T>, RecvTimeoutError> {
        let mut batch = vec![self.items.recv_timeout(patience)?];
        if !self.is_busy {
            std::thread::sleep(PAUSE);
        }
        batch.extend(self.items.try_iter().take(MANY));
        self.is_busy = batch.len() > MANY;
        Ok(batch)
    }
}

/// Lets the threads of the run go before this one, which only watches it.
pub fn step_back() {
    // On Linux a niceness is a thread's own; elsewhere it is that of the whole program.
    #[cfg(target_os = "linux")]
    let _refused = rustix::process::setpriority_process(None, BEHIND).is_err();
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::sync_channel;

    use super::*;

    #[test]
    fn all_items_come_in_their_order() {
        let (send, items) = sync_channel(4_096);
        let sender = std::thread::spawn(move || {
            for item in 0..20_000 {
                send.send(item).expect("somebody receives");
            }
        });
        let mut batches = Batches::new(items);
        let mut all = Vec::new();
        let end = loop {
            match batches.next(Duration::from_secs(20)) {
                Ok(batch) => all.extend(batch),
                Err(end) => break end,
            }
        };
        sender.join().expect("sent");
        assert_eq!(end, RecvTimeoutError::Disconnected);
        assert!(all.into_iter().eq(0..20_000));
    }

    #[test]
    fn silence_is_told() {
        let (send, items) = sync_channel::<u8>(1);
        let mut batches = Batches::new(items);
        assert_eq!(batches.next(Duration::from_millis(1)), Err(RecvTimeoutError::Timeout));
        drop(send);
        assert_eq!(
            batches.next(Duration::from_millis(1)),
            Err(RecvTimeoutError::Disconnected)
        );
    }
}
