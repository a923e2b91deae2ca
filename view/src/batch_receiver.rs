//! Receiver that takes items from another thread in batches. The recorder and the dashboard receive frames with it.
//!
//! A thread that waits for each item is woken for each, at the sender's cost. A thread that sleeps between batches
//! avoids that cost. No result depends on the numbers here. Both threads lower their priority with [`lower_priority`].

use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::time::Duration;

/// Pause after the first item of a batch, in which others arrive.
const BATCH_PAUSE: Duration = Duration::from_millis(15);
/// Maximum number of items after the first of a batch. After such a full batch the next one follows
/// without a pause, so that a fast sender does not wait.
const MAX_FURTHER_ITEMS: usize = 1_000;

/// Niceness of an observing thread.
#[cfg(target_os = "linux")]
const OBSERVER_NICENESS: i32 = 10;

/// Receiving end of a bounded queue. Without room for the items that arrive in `BATCH_PAUSE`, the sender waits: the
/// capacity must be some thousand items or more.
#[derive(Debug)]
pub struct BatchReceiver<T> {
    items: Receiver<T>,
    /// Whether the last batch was full.
    was_full: bool,
}

impl<T> BatchReceiver<T> {
    /// Creates a receiver of the items of `items`.
    pub const fn new(items: Receiver<T>) -> Self {
        Self { items, was_full: false }
    }

    /// Waits for the next batch, of at least one item. Sleeps for `BATCH_PAUSE` unless the last batch was full.
    ///
    /// # Errors
    /// If no item arrives within `timeout`, or every sender was dropped and no item is left.
    pub fn next_batch(&mut self, timeout: Duration) -> Result<Vec<T>, RecvTimeoutError> {
        let mut batch = vec![self.items.recv_timeout(timeout)?];
        // A full batch means that more is waiting already, and the queue must not fill up.
        if !self.was_full {
            std::thread::sleep(BATCH_PAUSE);
        }
        batch.extend(self.items.try_iter().take(MAX_FURTHER_ITEMS));
        self.was_full = batch.len() > MAX_FURTHER_ITEMS;
        Ok(batch)
    }
}

/// Lowers the priority of this thread, which only observes, below the threads of the run.
pub fn lower_priority() {
    // On Linux each thread has its own niceness; elsewhere the call would slow the run as well.
    #[cfg(target_os = "linux")]
    let _refused = rustix::process::setpriority_process(None, OBSERVER_NICENESS).is_err();
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::sync_channel;

    use super::*;

    #[test]
    fn all_items_arrive_in_order() {
        // Fewer places than items, so that the sender waits at times.
        let (sender, items) = sync_channel(4_096);
        let sending_thread = std::thread::spawn(move || {
            for item in 0..20_000 {
                sender.send(item).expect("the receiver is alive");
            }
        });
        let mut batches = BatchReceiver::new(items);
        let mut received = Vec::new();
        let error = loop {
            match batches.next_batch(Duration::from_secs(20)) {
                Ok(batch) => received.extend(batch),
                Err(error) => break error,
            }
        };
        sending_thread.join().expect("sent");
        assert_eq!(error, RecvTimeoutError::Disconnected);
        assert!(received.into_iter().eq(0..20_000));
    }

    #[test]
    fn a_timeout_and_a_lost_sender_are_reported() {
        let (sender, items) = sync_channel::<u8>(1);
        let mut batches = BatchReceiver::new(items);
        assert_eq!(
            batches.next_batch(Duration::from_millis(1)),
            Err(RecvTimeoutError::Timeout)
        );
        drop(sender);
        assert_eq!(
            batches.next_batch(Duration::from_millis(1)),
            Err(RecvTimeoutError::Disconnected)
        );
    }
}
