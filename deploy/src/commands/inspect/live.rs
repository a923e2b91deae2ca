//! A run that goes on, seen through the tap of its bus.

use std::sync::Arc;
use std::time::Duration;

use anyhow::anyhow;
use reveille_common::bus::{Bus, Declared};
use reveille_common::ids::Tti;
use reveille_common::message::{
    ClockCommand, ClockStatus, Describe, Frame, LogPart, Message, MessageKind, ReadLog, TapBatch,
};
use reveille_view::recording::Bundle;
use tokio::sync::Notify;
use tokio::sync::mpsc::Receiver;

use super::past::Past;
use crate::cli::TargetArgs;
use crate::display::note;
use crate::local;

const PATIENCE: Duration = Duration::from_secs(5);
/// Batches of frames that may wait to be taken.
const QUEUE: usize = 4_096;
/// How long to wait for each of the last frames of a run that has ended.
const LAST: Duration = Duration::from_millis(300);

/// A run that is watched.
pub struct Live {
    bus: Bus,
    /// The run's name.
    pub run: String,
    /// Number of devices N.
    pub devices: u32,
    /// Where it was when this connected.
    status: ClockStatus,
    batches: Receiver<TapBatch>,
    ended: Arc<Notify>,
    is_over: bool,
    /// Whether Ctrl-C was pressed.
    pub is_interrupted: bool,
    /// The TTI before which all is handed on by [`Self::follow`].
    reached: Tti,
    /// The number of the next frame, once one has come.
    expected: Option<u64>,
    /// Frames that were left out because this could not keep up.
    pub left_out: u64,
    _declared: [Declared; 2],
}

impl Live {
    /// Connects to the run that `target` means.
    ///
    /// # Errors
    /// If there is no such run.
    pub async fn connect(target: &TargetArgs) -> anyhow::Result<Self> {
        let found = local::find(target)?;
        let bus = Bus::connect(&found.endpoint, found.run, PATIENCE)
            .await?
            .with_key(found.key);
        if !bus.runs(PATIENCE).await?.contains(&bus.keys().run().to_string()) {
            return Err(bus.no_run().await.into());
        }
        let Some(status) = bus.ask(&ClockCommand::Status, PATIENCE).await? else {
            return Err(bus.no_run().await.into());
        };
        let (send, batches) = tokio::sync::mpsc::channel(QUEUE);
        let ended = Arc::new(Notify::new());
        let bell = Arc::clone(&ended);
        let watch = bus.watch_alive(bus.keys().bs_alive(), move |_, alive| {
            if !alive {
                bell.notify_one();
            }
        })?;
        let tap = bus.observe(move |batch| {
            // The gap in the numbers of its frames tells of one that has no room.
            let _no_room = send.try_send(batch).is_err();
        })?;
        Ok(Self {
            run: bus.keys().run().to_string(),
            devices: status.devices,
            status,
            bus,
            batches,
            ended,
            is_over: false,
            is_interrupted: false,
            reached: Tti::ZERO,
            expected: None,
            left_out: 0,
            _declared: [watch, tap],
        })
    }

    /// The session.
    pub fn bus(&self) -> Bus {
        self.bus.clone()
    }

    /// Whether the run has ended.
    pub const fn has_ended(&self) -> bool {
        self.is_over
    }

    /// Says where the run is: of a paused run nothing else may come for long.
    pub fn greet(&self) {
        note!("connected to run {}: {}", self.run, self.status);
    }

    /// The scenario of the run.
    ///
    /// # Errors
    /// If the run is gone.
    pub async fn bundle(&self) -> anyhow::Result<Bundle> {
        match self.bus.ask(&Describe, PATIENCE).await? {
            Some(description) => Ok(description.into()),
            None => Err(self.bus.no_run().await.into()),
        }
    }

    /// The next frames, as many as have come; nothing once the run has ended, or Ctrl-C was pressed. The second is
    /// how many were left out before them.
    pub async fn next(&mut self) -> Option<(Vec<Frame>, u64)> {
        if !self.is_over {
            tokio::select! {
                batch = self.batches.recv() => return batch.map(|batch| self.take(batch)),
                () = self.ended.notified() => self.is_over = true,
                _ = crate::interrupt::told() => {
                    self.is_interrupted = true;
                    return None;
                }
            }
        }
        // That the run has ended is told faster than what it said last.
        tokio::select! {
            last = tokio::time::timeout(LAST, self.batches.recv()) => last.ok().flatten().map(|batch| self.take(batch)),
            _ = crate::interrupt::told() => {
                self.is_interrupted = true;
                None
            }
        }
    }

    /// Says that the run was cut short, if what was followed has come to the end of it before its last TTI.
    ///
    /// # Errors
    /// It was.
    pub fn check_whole(&self) -> anyhow::Result<()> {
        let (reached, ttis) = (self.reached, self.status.ttis);
        anyhow::ensure!(
            !self.is_over || reached.0 >= ttis,
            "the run ended before TTI {reached} of {ttis}: it was interrupted or has failed"
        );
        Ok(())
    }

    /// What happened before this has connected to the run that `bundle` describes.
    ///
    /// # Errors
    /// The scenario of `bundle` cannot be used, or the run has ended.
    pub async fn past(&self, bundle: &Bundle) -> anyhow::Result<Past> {
        let mut past = Past::new(bundle.load()?);
        if self.learn(&mut past).await? {
            Ok(past)
        } else {
            Err(self.bus.no_run().await.into())
        }
    }

    /// Hands to `take` every frame of the run from TTI 0 on, with those of its `past`, but for those of the emulation
    /// plane of before; until the run ends, Ctrl-C is pressed, or `take` wants no more. Messages that were left out on
    /// the way are said once, and counted.
    ///
    /// # Errors
    /// What the run depends on besides is not known.
    pub async fn follow(&mut self, mut past: Past, mut take: impl FnMut(Frame) -> bool) -> anyhow::Result<()> {
        let mut reached = Tti::ZERO;
        let mut take = |frame: Frame| {
            if frame.kind == MessageKind::World
                && let Ok(Message::World(world)) = frame.message()
            {
                reached = world.last + 1;
            }
            take(frame)
        };
        let (mut goes_on, mut is_told, mut is_there) = (true, false, true);
        // Nobody else has a say in this process: what has to be worked out may take its time.
        tokio::task::block_in_place(|| past.catch_up(&self.status, |frame| goes_on &= take(frame)))?;
        while goes_on && let Some((frames, _)) = self.next().await {
            // Who asks hears of that as well, and does not ask again because of it.
            let is_due =
                |frame: &Frame| matches!(frame.kind, MessageKind::Plan | MessageKind::World | MessageKind::Clock);
            if !past.is_over() && frames.iter().any(is_due) {
                is_there = self.learn(&mut past).await?;
            }
            tokio::task::block_in_place(|| {
                let mut frames = frames.into_iter();
                frames.try_for_each(|frame| past.hear(frame, |frame| goes_on &= take(frame)))
            })
            .map_err(|error| {
                if is_there {
                    return error;
                }
                anyhow!("the run has ended before this was with it; `up --record` records from the beginning")
            })?;
            if self.left_out > 0 && !is_told {
                let (left_out, tti) = (self.left_out, past.told());
                note!("{left_out} messages after TTI {tti} were left out, because this could not keep up");
                is_told = true;
            }
        }
        self.reached = reached;
        Ok(())
    }

    /// Tells `past` what the run has come to depend on besides; false if the run is not there any more.
    async fn learn(&self, past: &mut Past) -> anyhow::Result<bool> {
        loop {
            let from = past.read();
            let Some(part) = self.bus.ask(&ReadLog { from }, PATIENCE).await? else {
                return Ok(false);
            };
            let is_more = tokio::task::block_in_place(|| past.learn(&part.bytes))?;
            // What is added while this is read is asked for when it is needed.
            if !is_more || (part.bytes.len() as u64) < LogPart::LONGEST {
                return Ok(true);
            }
        }
    }

    fn take(&mut self, batch: TapBatch) -> (Vec<Frame>, u64) {
        let missing = batch.first.saturating_sub(self.expected.unwrap_or(batch.first));
        self.left_out += missing;
        self.expected = Some(batch.first.saturating_add(batch.frames.len() as u64));
        (batch.frames, missing)
    }

    /// Ends the connection.
    pub async fn close(self) {
        self.bus.close().await;
    }
}
