//! Copies of the BS's traffic for observers.
//!
//! The BS sees every message of a run. While somebody observes over the bus, it hands copies to a thread of its own
//! through a bounded queue that is never waited for; what does not fit is left out, and the numbers of the frames tell
//! how much that was. Who watches in the BS's own process is handed every copy, and may make the run wait.
//!
//! Of the emulation plane what really goes over the bus is copied, what is sent once more included. The air plane and
//! the truth are told by the run ([`Bus::tell`](super::Bus::tell)): the modelled radio loses nothing, so a message that
//! the bus carries twice because a process was slow is one message on the air.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Duration;

use zenoh::Wait;
use zenoh::pubsub::Publisher;
use zenoh::qos::CongestionControl;

use super::error::BusError;
use crate::codec;
use crate::ids::Tti;
use crate::message::{Frame, MessageKind, Plane, TapBatch};

/// Frames that may wait for the tap's thread.
const QUEUE: usize = 16_384;
/// Frames in one batch.
const BATCH: usize = 512;
/// The pause between two batches: with [`BATCH`] it bounds what observation may cost to 100 000 frames a second.
const PAUSE: Duration = Duration::from_millis(5);

/// Takes in every copy, in the BS's own process.
pub type Sink = dyn Fn(&Frame) + Send + Sync;

/// The BS's side of observation.
pub struct Tap {
    is_observed: AtomicBool,
    sink: OnceLock<Box<Sink>>,
    tti: AtomicU64,
    /// The number of the next frame. Held while that frame is queued: several threads see messages, and numbers must
    /// rise along the queue.
    next: Mutex<u64>,
    queue: SyncSender<(u64, Frame)>,
    left_out: AtomicU64,
    /// Frames that are queued and not sent yet.
    waiting: Arc<AtomicU64>,
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
            sink: OnceLock::new(),
            tti: AtomicU64::new(0),
            next: Mutex::new(0),
            queue,
            left_out: AtomicU64::new(0),
            waiting: Arc::default(),
        });
        let waiting = Arc::clone(&tap.waiting);
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
            .spawn(move || publish(&publisher, &frames, &waiting))
            .map_err(|e| BusError::Zenoh(format!("cannot start the tap's thread: {e}")))?;
        Ok(tap)
    }

    /// Notes which TTI it is.
    pub(super) fn set_tti(&self, tti: Tti) {
        self.tti.store(tti.0, Ordering::Relaxed);
    }

    /// Hands every copy to `sink` from now on. False if there is one already.
    pub(super) fn copy_to(&self, sink: Box<Sink>) -> bool {
        self.sink.set(sink).is_ok()
    }

    /// Frames that observers on the bus were not sent, because they could not keep up.
    pub(super) fn left_out(&self) -> u64 {
        self.left_out.load(Ordering::Relaxed)
    }

    /// Whether everything is sent that is to be.
    pub(super) fn is_empty(&self) -> bool {
        self.waiting.load(Ordering::Relaxed) == 0
    }

    /// Whether somebody wants copies.
    pub(super) fn is_observed(&self) -> bool {
        self.is_observed.load(Ordering::Relaxed) || self.sink.get().is_some()
    }

    /// Copies a message of the emulation plane that goes over the bus, if somebody wants it.
    pub(super) fn see(&self, kind: MessageKind, number: Option<u32>, payload: &[u8]) {
        if kind.plane() == Plane::Emu && self.is_observed() {
            self.tell_bytes(kind, number, payload);
        }
    }

    /// Hands on a copy of what goes over the bus now.
    pub(super) fn tell_bytes(&self, kind: MessageKind, number: Option<u32>, payload: &[u8]) {
        self.tell(Frame {
            tti: Tti(self.tti.load(Ordering::Relaxed)),
            kind,
            number,
            payload: payload.to_vec(),
        });
    }

    /// Hands on a copy. Waits for the sink alone.
    pub(super) fn tell(&self, frame: Frame) {
        let mut next = self.next.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(sink) = self.sink.get() {
            sink(&frame);
        }
        if !self.is_observed.load(Ordering::Relaxed) {
            return;
        }
        let number = *next;
        *next += 1;
        // A full queue drops the frame; the observer sees the gap in the numbers.
        self.waiting.fetch_add(1, Ordering::Relaxed);
        if self.queue.try_send((number, frame)).is_err() {
            self.waiting.fetch_sub(1, Ordering::Relaxed);
            self.left_out.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// Publishes batches of consecutively numbered frames until the tap is dropped.
fn publish(publisher: &Publisher<'_>, frames: &Receiver<(u64, Frame)>, waiting: &AtomicU64) {
    let mut held: Option<(u64, Frame)> = None;
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
        let is_sent = publisher.put(codec::encode(&batch)).wait().is_ok();
        waiting.fetch_sub(batch.frames.len() as u64, Ordering::Relaxed);
        if !is_sent {
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
            sink: OnceLock::new(),
            tti: AtomicU64::new(0),
            next: Mutex::new(0),
            queue,
            left_out: AtomicU64::new(0),
            waiting: Arc::default(),
        };
        std::thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| (0..2_000).for_each(|_| tap.see(MessageKind::Clock, None, &[1])));
            }
        });
        drop(tap);
        let numbers: Vec<u64> = frames.iter().map(|(number, _)| number).collect();
        assert_eq!(numbers, (0..8_000).collect::<Vec<u64>>());
    }
}
