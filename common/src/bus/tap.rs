//! Copies of the BS's traffic for observers.
//!
//! The BS sees every message of a run. While somebody observes, it hands copies to a thread of its own through a
//! bounded queue that is never waited for; what does not fit is left out, and the numbers of the frames tell how much
//! that was.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use zenoh::Wait;
use zenoh::pubsub::Publisher;
use zenoh::qos::CongestionControl;

use super::error::BusError;
use crate::codec;
use crate::ids::Tti;
use crate::message::{TapBatch, TapFrame};

/// Frames that may wait for the tap's thread.
const QUEUE: usize = 16_384;
/// Frames in one batch.
const BATCH: usize = 512;
/// The pause between two batches: with [`BATCH`] it bounds what observation may cost to 100 000 frames a second.
const PAUSE: Duration = Duration::from_millis(5);

/// The BS's side of observation.
pub struct Tap {
    is_observed: AtomicBool,
    tti: AtomicU64,
    /// The number of the next frame. Held while that frame is queued: several threads see messages, and numbers must
    /// rise along the queue.
    next: Mutex<u64>,
    queue: SyncSender<(u64, TapFrame)>,
}

impl Tap {
    /// Starts the thread, which publishes on `key` of `session`.
    pub(super) fn start(session: &zenoh::Session, key: String) -> Result<Arc<Self>, BusError> {
        let publisher = session
            .declare_publisher(key)
            .congestion_control(CongestionControl::Drop)
            .wait()?;
        let (queue, frames) = sync_channel(QUEUE);
        let tap = Arc::new(Self {
            is_observed: AtomicBool::new(false),
            tti: AtomicU64::new(0),
            next: Mutex::new(0),
            queue,
        });
        let weak = Arc::downgrade(&tap);
        publisher
            .matching_listener()
            .callback(move |status| {
                if let Some(tap) = weak.upgrade() {
                    tap.is_observed.store(status.matching(), Ordering::Relaxed);
                }
            })
            .background()
            .wait()?;
        std::thread::Builder::new()
            .name("tap".to_owned())
            .spawn(move || publish(&publisher, &frames))
            .map_err(|e| BusError::Zenoh(format!("cannot start the tap's thread: {e}")))?;
        Ok(tap)
    }

    /// Notes which TTI it is.
    pub(super) fn set_tti(&self, tti: Tti) {
        self.tti.store(tti.0, Ordering::Relaxed);
    }

    /// Copies a message if somebody observes. Never waits.
    pub(super) fn see(&self, key: &str, payload: &[u8]) {
        if !self.is_observed.load(Ordering::Relaxed) {
            return;
        }
        let mut next = self.next.lock().unwrap_or_else(PoisonError::into_inner);
        let number = *next;
        *next += 1;
        let tti = Tti(self.tti.load(Ordering::Relaxed));
        // A full queue drops the frame; the observer sees the gap in the numbers.
        let _left_out = self
            .queue
            .try_send((
                number,
                TapFrame {
                    tti,
                    key: key.to_owned(),
                    payload: payload.to_vec(),
                },
            ))
            .is_err();
    }
}

/// Publishes batches of consecutively numbered frames until the tap is dropped.
fn publish(publisher: &Publisher<'_>, frames: &Receiver<(u64, TapFrame)>) {
    let mut held: Option<(u64, TapFrame)> = None;
    loop {
        let Some((first, frame)) = held.take().or_else(|| frames.recv().ok()) else {
            return;
        };
        let mut batch = TapBatch {
            first,
            frames: vec![frame],
        };
        while batch.frames.len() < BATCH {
            match frames.try_recv() {
                Ok((number, frame)) if number == first + batch.frames.len() as u64 => batch.frames.push(frame),
                Ok(next) => {
                    held = Some(next);
                    break;
                }
                Err(_) => break,
            }
        }
        if publisher.put(codec::encode(&batch)).wait().is_err() {
            return;
        }
        std::thread::sleep(PAUSE);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_rise_along_the_queue_whoever_sees_a_message() {
        let (queue, frames) = sync_channel(QUEUE);
        let tap = Tap {
            is_observed: AtomicBool::new(true),
            tti: AtomicU64::new(0),
            next: Mutex::new(0),
            queue,
        };
        std::thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| (0..2_000).for_each(|_| tap.see("key", &[1])));
            }
        });
        drop(tap);
        let numbers: Vec<u64> = frames.iter().map(|(number, _)| number).collect();
        assert_eq!(numbers, (0..8_000).collect::<Vec<u64>>());
    }
}
