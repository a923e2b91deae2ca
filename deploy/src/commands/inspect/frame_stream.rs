//! The batches of frames that a live run sends, until its base station leaves the bus. `live` declares the tap that
//! fills the queue, and waits for the return of a lost base station.
//!
//! The loss of the base station and its last batches arrive in either order: a liveliness token overtakes data. So a
//! batch after the loss still belongs to the run, unless the base station is back.

use std::time::Duration;

use reveille_common::message::{ClockMessage, Frame, FrameBatch, Message, MessageKind};
use tokio::sync::mpsc::Receiver;
use tokio::sync::watch;

/// Longest wait for each of the last frames of an ended run.
const LAST_FRAME_TIMEOUT: Duration = Duration::from_millis(300);

/// Whether the base station is on the bus, and how often it has left it.
#[derive(Clone, Copy, Default)]
pub(super) struct BsPresence {
    pub(super) is_present: bool,
    pub(super) losses: u64,
}

/// The frames of an observed run.
pub(super) struct FrameStream {
    /// The batches from the tap, each with the losses of the base station before it.
    batches: Receiver<(u64, FrameBatch)>,
    bs_presence: watch::Receiver<BsPresence>,
    /// The losses of the base station that were followed by its return.
    survived_losses: u64,
    /// Whether the base station has left the bus. The last frames can follow.
    pub(super) is_bs_lost: bool,
    /// Whether a message of the virtual clock has ended the run.
    pub(super) is_run_over: bool,
    /// The number of the next frame, once one has arrived.
    next_frame_number: Option<u64>,
    /// Frames dropped because this reader was too slow.
    pub(super) dropped_frames: u64,
    /// The part of `dropped_frames` that [`Self::take_unreported_drops`] has returned.
    reported_drops: u64,
}

impl FrameStream {
    /// Creates the stream of `batches`, each with the losses of the base station before it.
    pub(super) const fn new(batches: Receiver<(u64, FrameBatch)>, bs_presence: watch::Receiver<BsPresence>) -> Self {
        Self {
            batches,
            bs_presence,
            survived_losses: 0,
            is_bs_lost: false,
            is_run_over: false,
            next_frame_number: None,
            dropped_frames: 0,
            reported_drops: 0,
        }
    }

    /// Receives the next frames and the number of frames dropped before them. Returns `None` once the base station has
    /// left the bus and its last frames have been returned.
    pub(super) async fn next(&mut self) -> Option<(Vec<Frame>, u64)> {
        let survived_losses = self.survived_losses;
        if !self.is_bs_lost {
            let batch = tokio::select! {
                // Batches that have arrived come before the end of the run.
                biased;
                batch = self.batches.recv() => Some(batch?),
                _ = self.bs_presence.wait_for(|presence| presence.losses > survived_losses) => None,
            };
            match batch {
                Some((losses, batch)) if losses == survived_losses => return Some(self.count_gap(batch)),
                Some((_, batch)) => return self.take_late(batch),
                None => self.is_bs_lost = true,
            }
        }
        let last_batch = tokio::time::timeout(LAST_FRAME_TIMEOUT, self.batches.recv()).await;
        let (_, batch) = last_batch.ok().flatten()?;
        self.take_late(batch)
    }

    /// Takes a batch that arrived after the loss of the base station. Returns its frames, unless the base station has
    /// returned since: then it may be a batch of a later connection, whose frames the catch-up repeats.
    fn take_late(&mut self, batch: FrameBatch) -> Option<(Vec<Frame>, u64)> {
        self.is_bs_lost = true;
        let presence = *self.bs_presence.borrow();
        if presence.is_present || presence.losses > self.survived_losses + 1 {
            self.note_end(&batch);
            return None;
        }
        Some(self.count_gap(batch))
    }

    /// Adds the frames missing before `batch` to the count. Returns the frames of `batch` and the missing number.
    fn count_gap(&mut self, batch: FrameBatch) -> (Vec<Frame>, u64) {
        // Saturating: a batch whose numbers go back must not wrap the count.
        let missing = batch
            .first
            .saturating_sub(self.next_frame_number.unwrap_or(batch.first));
        self.dropped_frames += missing;
        self.next_frame_number = Some(batch.first.saturating_add(batch.frames.len() as u64));
        self.note_end(&batch);
        (batch.frames, missing)
    }

    /// Returns the number of frames dropped since the last call.
    pub(super) const fn take_unreported_drops(&mut self) -> u64 {
        let unreported = self.dropped_frames - self.reported_drops;
        self.reported_drops = self.dropped_frames;
        unreported
    }

    /// Records whether a message of the virtual clock in `batch` ends the run.
    fn note_end(&mut self, batch: &FrameBatch) {
        let is_last = |frame: &Frame| {
            frame.kind == MessageKind::Clock
                && matches!(
                    frame.message(),
                    Ok(Message::Clock(
                        ClockMessage::CollectLedgers(_) | ClockMessage::Dismiss | ClockMessage::RunFailed(_)
                    ))
                )
        };
        self.is_run_over |= batch.frames.iter().any(is_last);
    }

    /// After a loss: waits until the base station is on the bus again; false if a late message ends the run. Drops the
    /// batches that arrive before the return.
    pub(super) async fn wait_for_bs(&mut self) -> anyhow::Result<bool> {
        loop {
            let batch = tokio::select! {
                biased;
                batch = self.batches.recv() => batch,
                presence = self.bs_presence.wait_for(|presence| presence.is_present) => {
                    self.survived_losses = presence?.losses;
                    return Ok(true);
                }
            };
            let Some((_, batch)) = batch else { return Ok(false) };
            self.note_end(&batch);
            if self.is_run_over {
                return Ok(false);
            }
        }
    }

    /// Continues after the return of the base station. Frames sent before are lost.
    pub(super) const fn resume(&mut self) {
        (self.is_bs_lost, self.next_frame_number) = (false, None);
    }
}

#[cfg(test)]
mod tests {
    use reveille_common::ids::Tti;
    use tokio::sync::mpsc::{Sender, channel};

    use super::*;

    /// The sending ends of a stream.
    struct Bus {
        batches: Sender<(u64, FrameBatch)>,
        presence: watch::Sender<BsPresence>,
    }

    impl Bus {
        /// Sends the frames `first` to `last`.
        fn send(&self, first: u64, last: u64) {
            // Frames of a kind that does not end the run.
            let frames = (first..=last).map(|tti| Frame::new(Tti(tti), (), &ClockMessage::Dismiss));
            let frames = frames
                .map(|frame| Frame {
                    kind: MessageKind::Answer,
                    ..frame
                })
                .collect();
            let losses = self.presence.borrow().losses;
            self.batches
                .try_send((losses, FrameBatch { first, frames }))
                .expect("room");
        }

        fn set_present(&self, is_present: bool) {
            self.presence.send_modify(|presence| {
                presence.is_present = is_present;
                presence.losses += u64::from(!is_present);
            });
        }
    }

    fn connect() -> (Bus, FrameStream) {
        let (batches, receiver) = channel(8);
        let (presence, bs_presence) = watch::channel(BsPresence::default());
        let bus = Bus { batches, presence };
        bus.set_present(true);
        (bus, FrameStream::new(receiver, bs_presence))
    }

    /// The next frames by their TTIs, and the number of those dropped before.
    async fn next(stream: &mut FrameStream) -> Option<(Vec<u64>, u64)> {
        let (frames, dropped) = stream.next().await?;
        Some((frames.iter().map(|frame| frame.tti.0).collect(), dropped))
    }

    #[tokio::test]
    async fn the_last_batches_may_follow_the_loss_of_the_base_station() {
        let (bus, mut stream) = connect();
        bus.send(0, 1);
        bus.set_present(false);
        bus.send(2, 3);
        bus.send(4, 4);
        assert_eq!(next(&mut stream).await, Some((vec![0, 1], 0)));
        assert_eq!(next(&mut stream).await, Some((vec![2, 3], 0)));
        assert!(stream.is_bs_lost);
        assert_eq!(next(&mut stream).await, Some((vec![4], 0)));
        assert_eq!(next(&mut stream).await, None);
        assert_eq!(stream.dropped_frames, 0);
    }

    #[tokio::test]
    async fn batches_of_the_next_connection_wait_for_the_catch_up() {
        let (bus, mut stream) = connect();
        bus.send(0, 1);
        assert_eq!(next(&mut stream).await, Some((vec![0, 1], 0)));
        for (first, losses) in [(7, 1), (20, 2)] {
            for _ in 0..losses {
                bus.set_present(false);
                bus.set_present(true);
                bus.send(first, first);
            }
            // A connection that has ended again is not the one before the first loss either.
            if losses == 2 {
                bus.set_present(false);
                assert_eq!(next(&mut stream).await, None, "frame {first} comes after two losses");
                bus.set_present(true);
            }
            assert_eq!(next(&mut stream).await, None, "frame {first} comes after a loss");
            assert!(stream.wait_for_bs().await.expect("a sender"));
            stream.resume();
            bus.send(first + 1, first + 2);
            assert_eq!(next(&mut stream).await, Some((vec![first + 1, first + 2], 0)));
        }
        assert_eq!(stream.dropped_frames, 0);
    }

    #[tokio::test]
    async fn missing_numbers_are_counted() {
        let (bus, mut stream) = connect();
        for (first, last, dropped) in [(3, 4, 0), (7, 7, 2), (8, 9, 0), (5, 6, 0), (10, 10, 3)] {
            bus.send(first, last);
            assert_eq!(next(&mut stream).await, Some(((first..=last).collect(), dropped)));
            assert_eq!(stream.take_unreported_drops(), dropped);
            assert_eq!(stream.take_unreported_drops(), 0, "each drop is reported once");
        }
        assert_eq!(stream.dropped_frames, 5);
    }
}
