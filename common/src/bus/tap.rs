//! The tap: copies of the BS's traffic for observers.
//!
//! The BS sees every message of a run. While observers are connected to the bus, the tap passes copies to its own
//! thread through a bounded queue and never waits for the queue. It drops frames that do not fit; gaps in the frame
//! numbers show their number. A sink in the BS's own process receives every copy and may make the run wait. Only
//! [`Bus`](super::Bus) and its topics call the tap.
//!
//! Two numbers differ: a frame's number in the queue, and the addressee number [`Frame::number`] of a device or host.
//!
//! The tap copies the actual bus traffic of the emulation plane, retransmitted messages included. The run itself
//! publishes frames of the air plane and the ground truth ([`Bus::publish_frame`](super::Bus::publish_frame)). The
//! modelled radio alone decides about them: a message that the bus carries twice because a process was slow is one
//! message on the air.

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
use crate::message::{Frame, FrameBatch, MessageKind, Plane};

/// Capacity of the queue of the tap's thread, in frames.
const MAX_QUEUED_FRAMES: usize = 16_384;
const MAX_BATCH_FRAMES: usize = 512;
/// Pause between two batches: with [`MAX_BATCH_FRAMES`] it limits the cost of observation to 100 000 frames a second.
const BATCH_PAUSE: Duration = Duration::from_millis(5);

/// A callback in the BS's own process that receives every copy. It is called under the lock of the frame numbers, so it
/// must not use the bus.
pub type FrameSink = dyn Fn(&Frame) + Send + Sync;

/// The BS's side of observation.
pub struct Tap {
    /// Whether an observer is connected to the bus.
    has_bus_observers: AtomicBool,
    sink: OnceLock<Box<FrameSink>>,
    /// The TTI with which copies are labelled.
    tti: AtomicU64,
    /// The number of the next frame; only frames for observers on the bus have one. Locked while that frame is queued:
    /// several threads copy messages, and the numbers must rise along the queue.
    next_frame_number: Mutex<u64>,
    queue: SyncSender<(u64, Frame)>,
    dropped_frames: AtomicU64,
    /// Frames that are queued but not sent yet.
    queued_frames: Arc<AtomicU64>,
}

impl Tap {
    /// Starts the thread, which publishes on the key expression `key` of `session`.
    pub(super) fn start(session: &zenoh::Session, key: String) -> Result<Arc<Self>, BusError> {
        let publisher = session
            .declare_publisher(key)
            // A slow observer must not hold up the run; it sees a gap in the numbers instead.
            .congestion_control(CongestionControl::Drop)
            .wait()?;
        let (queue, frames) = sync_channel(MAX_QUEUED_FRAMES);
        let tap = Arc::new(Self {
            has_bus_observers: AtomicBool::new(false),
            sink: OnceLock::new(),
            tti: AtomicU64::new(0),
            next_frame_number: Mutex::new(0),
            queue,
            dropped_frames: AtomicU64::new(0),
            queued_frames: Arc::default(),
        });
        let queued_frames = Arc::clone(&tap.queued_frames);
        // Weak, because the listener lives as long as the session: the thread ends when the tap is dropped.
        let weak = Arc::downgrade(&tap);
        publisher
            .matching_listener()
            .callback(move |status| {
                if let Some(tap) = weak.upgrade() {
                    tap.has_bus_observers.store(status.matching(), Ordering::Relaxed);
                }
            })
            .background()
            .wait()?;
        std::thread::Builder::new()
            .name("tap".to_owned())
            .spawn(move || publish_batches(&publisher, &frames, &queued_frames))
            .map_err(|e| BusError::Zenoh(format!("cannot start the tap's thread: {e}")))?;
        Ok(tap)
    }

    pub(super) fn set_tti(&self, tti: Tti) {
        self.tti.store(tti.0, Ordering::Relaxed);
    }

    /// Passes every later copy to `sink`. Returns false if a sink exists already.
    pub(super) fn set_local_sink(&self, sink: Box<FrameSink>) -> bool {
        self.sink.set(sink).is_ok()
    }

    /// The number of frames dropped because observers on the bus were too slow.
    pub(super) fn dropped_frames(&self) -> u64 {
        self.dropped_frames.load(Ordering::Relaxed)
    }

    /// Whether all queued frames are sent. It can stay false after a failed publication, which ends the thread.
    pub(super) fn is_empty(&self) -> bool {
        self.queued_frames.load(Ordering::Relaxed) == 0
    }

    /// Whether any observer is connected or a local sink is set.
    pub(super) fn is_observed(&self) -> bool {
        self.has_bus_observers.load(Ordering::Relaxed) || self.sink.get().is_some()
    }

    /// Copies a message of the emulation plane that the bus carries, if it is observed.
    pub(super) fn copy_emulation(&self, kind: MessageKind, addressee_number: Option<u32>, payload: &[u8]) {
        if kind.plane() == Plane::Emu && self.is_observed() {
            self.forward_bytes(kind, addressee_number, payload);
        }
    }

    /// Forwards a copy of a message that the bus carries in the current TTI, from its `payload`.
    pub(super) fn forward_bytes(&self, kind: MessageKind, addressee_number: Option<u32>, payload: &[u8]) {
        self.forward(Frame {
            tti: Tti(self.tti.load(Ordering::Relaxed)),
            kind,
            number: addressee_number,
            payload: payload.to_vec(),
        });
    }

    /// Forwards a copy. Waits only for the sink.
    pub(super) fn forward(&self, frame: Frame) {
        // A sink panics before the number changes, so a poisoned lock still holds a valid number.
        let mut next_frame_number = self.next_frame_number.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(sink) = self.sink.get() {
            // Called under the lock, so that the sink receives frames of several threads in the order of their
            // numbers.
            sink(&frame);
        }
        if !self.has_bus_observers.load(Ordering::Relaxed) {
            return;
        }
        let frame_number = *next_frame_number;
        *next_frame_number += 1;
        // Counted before it is queued, because the thread may send it and count down before `try_send` returns. A full
        // queue drops the frame; the observer sees the gap in the numbers.
        self.queued_frames.fetch_add(1, Ordering::Relaxed);
        if self.queue.try_send((frame_number, frame)).is_err() {
            self.queued_frames.fetch_sub(1, Ordering::Relaxed);
            self.dropped_frames.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// Publishes batches of consecutively numbered frames until the tap is dropped or a publication fails.
fn publish_batches(publisher: &Publisher<'_>, frames: &Receiver<(u64, Frame)>, queued_frames: &AtomicU64) {
    let mut first_of_next_batch: Option<(u64, Frame)> = None;
    loop {
        let Some((first_number, frame)) = first_of_next_batch.take().or_else(|| frames.recv().ok()) else {
            return;
        };
        let mut batch = FrameBatch {
            first: first_number,
            frames: vec![frame],
        };
        while batch.frames.len() < MAX_BATCH_FRAMES {
            match frames.try_recv() {
                // A batch carries only its first number, so it ends where frames are missing.
                Ok((frame_number, frame)) if frame_number == first_number + batch.frames.len() as u64 => {
                    batch.frames.push(frame);
                }
                Ok(frame_after_gap) => {
                    first_of_next_batch = Some(frame_after_gap);
                    break;
                }
                Err(_) => break,
            }
        }
        let is_sent = publisher.put(codec::encode(&batch)).wait().is_ok();
        queued_frames.fetch_sub(batch.frames.len() as u64, Ordering::Relaxed);
        if !is_sent {
            return;
        }
        std::thread::sleep(BATCH_PAUSE);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frame_numbers_are_consecutive_in_the_queue_with_concurrent_senders() {
        let (queue, frames) = sync_channel(MAX_QUEUED_FRAMES);
        let tap = Tap {
            has_bus_observers: AtomicBool::new(true),
            sink: OnceLock::new(),
            tti: AtomicU64::new(0),
            next_frame_number: Mutex::new(0),
            queue,
            dropped_frames: AtomicU64::new(0),
            queued_frames: Arc::default(),
        };
        std::thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| (0..2_000).for_each(|_| tap.copy_emulation(MessageKind::Clock, None, &[1])));
            }
        });
        drop(tap);
        let frame_numbers: Vec<u64> = frames.iter().map(|(frame_number, _)| frame_number).collect();
        assert_eq!(frame_numbers, (0..8_000).collect::<Vec<u64>>());
    }
}
