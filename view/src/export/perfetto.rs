//! A run as a trace for Perfetto: protocol buffers of type `perfetto.protos.Trace` with track events.
//!
//! A track for each device with slices of its states, a counter with its battery, and for each wake-up an arrow from
//! the base station to the device that reports. A TTI is a millisecond.

use std::io::{self, Write};

use reveille_common::deployment::Deployment;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{EventNews, Frame, Message, WakeOutcome};
use reveille_common::scenario::Scenario;
use reveille_common::state::{DeviceState, DeviceView};

use super::protobuf::Proto;
use crate::mirror::{Discrepancy, Mirror};
use crate::recording::NANOS_PER_TTI;

/// Tracks have numbers: the run's process, the base station, the events, then two for each device.
const PROCESS: u64 = 1;
const STATION: u64 = 2;
const EVENTS: u64 = 3;
const DEVICES: u64 = 16;

/// The sequence that all packets are of.
const SEQUENCE: u64 = 1;
/// `TrackEvent.Type`.
const BEGIN: u64 = 1;
const END: u64 = 2;
const INSTANT: u64 = 3;
const COUNTER: u64 = 4;

/// Why a trace cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum TraceError {
    /// The operating system refuses.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// The frames are not those of one run from its start.
    #[error("the states of devices cannot be worked out: {0}")]
    Frames(#[from] Discrepancy),
}

/// Writes a trace.
pub struct Trace<W> {
    out: W,
    mirror: Mirror,
    /// By device, the slice that is open and the battery that was told last.
    open: Vec<Option<(&'static str, u64)>>,
    /// TTIs between two values of a battery.
    every: u64,
    /// Arrows so far.
    flows: u64,
    /// The first TTI of which states have not been told.
    next: Tti,
}

impl<W: Write> Trace<W> {
    /// Begins the trace of a run of `scenario`, with the batteries once in `every` TTIs.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn begin(out: W, run: &str, scenario: &Scenario, every: u64) -> io::Result<Self> {
        let deployment = Deployment::new(scenario);
        let mut trace = Self {
            out,
            mirror: Mirror::new(scenario, &deployment),
            open: vec![None; deployment.devices.len()],
            every,
            flows: 0,
            next: Tti::ZERO,
        };
        let process = Proto::new().number(1, 1).text(6, &format!("reveille {run}"));
        trace.describe(&Proto::new().number(1, PROCESS).message(3, &process))?;
        for (track, name) in [(STATION, "base station"), (EVENTS, "events")] {
            trace.describe(&Proto::new().number(1, track).text(2, name).number(5, PROCESS))?;
        }
        for device in &deployment.devices {
            let (id, place) = (device.id, device.position);
            let name = format!("device {id} at ({:.1}, {:.1}) m", place.x, place.y);
            let track = Proto::new().number(1, states(id)).text(2, &name).number(5, PROCESS);
            trace.describe(&track)?;
            let counter = Proto::new().text(6, "units");
            let track = Proto::new().number(1, battery(id)).text(2, "battery");
            trace.describe(&track.number(5, states(id)).message(8, &counter))?;
        }
        Ok(trace)
    }

    /// Goes on with `frame`.
    ///
    /// # Errors
    /// If it cannot be written, or does not fit to what was before it.
    pub fn write(&mut self, frame: &Frame) -> Result<(), TraceError> {
        let Ok(message) = frame.message() else {
            return Ok(());
        };
        let device = frame.number.map(DeviceId);
        // What was reached is told before anything new comes to it.
        if matches!(message, Message::Plan(_) | Message::World(_)) {
            self.tell_until(self.mirror.next())?;
        }
        if let Message::World(world) = &message {
            self.mirror
                .fits(world)
                .map_err(|what| Discrepancy { tti: frame.tti, what })?;
            // In all but the last nothing is heard of anybody.
            self.tell_until(world.last)?;
        }
        self.mirror.take(frame, &message)?;
        match (&message, device) {
            (Message::Plan(_) | Message::Gone(_), _) => {
                self.instant(frame.tti, STATION, &message.to_string(), None)?;
            }
            (Message::Wake(_), Some(device)) => {
                self.flows += 1;
                let flow = Some((47, self.flows));
                self.instant(frame.tti, STATION, &format!("wake device {device}"), flow)?;
            }
            (Message::Woken(woken), Some(device)) => {
                let flow = Some((48, self.flows));
                let said = match &woken.outcome {
                    WakeOutcome::Reported(report) => format!("woken: {report}"),
                    outcome @ (WakeOutcome::Failed(_)
                    | WakeOutcome::Unheard
                    | WakeOutcome::Lost(_)
                    | WakeOutcome::Late { .. }) => outcome.to_string(),
                };
                self.instant(frame.tti, states(device), &said, flow)?;
            }
            (Message::Report(report), Some(device)) if !self.mirror.is_waking() => {
                self.instant(frame.tti, states(device), &report.to_string(), None)?;
            }
            (Message::Lost(lost), Some(device)) => {
                self.instant(frame.tti, states(device), &lost.to_string(), None)?;
            }
            (Message::Failed(failed), Some(device)) => {
                self.instant(frame.tti, states(device), &failed.to_string(), None)?;
            }
            (Message::Event(EventNews::Started(event)), _) => {
                let name = format!("event {}", event.stimulus.event.0);
                self.event(
                    event.start,
                    &Proto::new().number(9, BEGIN).number(11, EVENTS).text(23, &name),
                )?;
            }
            (Message::Event(EventNews::Ended(record)), _) => {
                self.event(record.last + 1, &Proto::new().number(9, END).number(11, EVENTS))?;
            }
            _ => {}
        }
        Ok(())
    }

    /// Ends the trace. Gives back what it was written to.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn finish(mut self) -> Result<W, TraceError> {
        let end = self.mirror.next();
        self.tell_until(end)?;
        for (at, open) in std::mem::take(&mut self.open).into_iter().enumerate() {
            if open.is_some() {
                self.end(end, DeviceId(at as u32))?;
            }
        }
        self.out.flush()?;
        Ok(self.out)
    }

    /// Tells the states of all TTIs before `end` that are not told yet.
    fn tell_until(&mut self, end: Tti) -> io::Result<()> {
        while self.next < end {
            let views = self.mirror.views_at(self.next);
            for (id, view) in (0..).map(DeviceId).zip(views) {
                self.tell(self.next, id, view)?;
            }
            self.next = self.next + 1;
        }
        Ok(())
    }

    fn tell(&mut self, tti: Tti, id: DeviceId, view: DeviceView) -> io::Result<()> {
        let (name, level) = (named(view.state), view.battery.micro());
        let before = self.open[id.index()];
        let is_other = before.is_none_or(|(open, _)| open != name);
        if is_other {
            if before.is_some() {
                self.end(tti, id)?;
            }
            self.event(
                tti,
                &Proto::new().number(9, BEGIN).number(11, states(id)).text(23, name),
            )?;
        }
        let is_due = tti.0.is_multiple_of(self.every) && before.is_none_or(|(_, told)| told != level);
        let told = if is_other || is_due {
            let event = Proto::new().number(9, COUNTER).number(11, battery(id));
            self.event(tti, &event.double(44, view.battery.units()))?;
            level
        } else {
            before.map_or(level, |(_, told)| told)
        };
        self.open[id.index()] = Some((name, told));
        Ok(())
    }

    fn end(&mut self, tti: Tti, id: DeviceId) -> io::Result<()> {
        self.event(tti, &Proto::new().number(9, END).number(11, states(id)))
    }

    /// An event that takes no time, with the field and the number of an arrow that starts or ends in it.
    fn instant(&mut self, tti: Tti, track: u64, name: &str, flow: Option<(u32, u64)>) -> io::Result<()> {
        let event = Proto::new().number(9, INSTANT).number(11, track).text(23, name);
        self.event(
            tti,
            &match flow {
                Some((field, number)) => event.fixed(field, number),
                None => event,
            },
        )
    }

    fn event(&mut self, tti: Tti, event: &Proto) -> io::Result<()> {
        let packet = Proto::new().number(8, tti.0 * NANOS_PER_TTI).number(10, SEQUENCE);
        self.packet(&packet.message(11, event))
    }

    fn describe(&mut self, track: &Proto) -> io::Result<()> {
        self.packet(&Proto::new().number(10, SEQUENCE).message(60, track))
    }

    fn packet(&mut self, packet: &Proto) -> io::Result<()> {
        self.out.write_all(&Proto::new().message(1, packet).into_bytes())
    }
}

const fn states(id: DeviceId) -> u64 {
    DEVICES + 2 * id.0 as u64
}

const fn battery(id: DeviceId) -> u64 {
    states(id) + 1
}

/// The name of a slice.
const fn named(state: DeviceState) -> &'static str {
    match state {
        DeviceState::Idle => "S1 idle",
        DeviceState::Active => "S2 active",
        DeviceState::Transmission => "S3 transmission",
        DeviceState::Sleep { powered: true } => "S4 sleep",
        DeviceState::Sleep { powered: false } => "S4 sleep, deaf",
    }
}
