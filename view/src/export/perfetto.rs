//! Export of a run as a Perfetto trace: protocol buffers of type `perfetto.protos.Trace` with track events.
//!
//! Each device has a track with slices of its states and a counter with its battery. Each wake-up is an arrow from the
//! base station to the device that reports. A TTI is a millisecond. Track numbers only have to be distinct; field
//! numbers are Perfetto's.

use std::io::{self, Write};

use reveille_bs::scenario::Scenario;
use reveille_common::deployment::Deployment;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{EventUpdate, Frame, Message, WakeOutcome};
use reveille_common::state::{DeviceState, DeviceView};

use super::protobuf::Proto;
use crate::device_mirror::{DeviceMirror, Discrepancy};
use crate::recording::NANOS_PER_TTI;

/// Track numbers: the process of the run, the base station, the events, then two for each device.
const PROCESS_TRACK: u64 = 1;
const STATION_TRACK: u64 = 2;
const EVENTS_TRACK: u64 = 3;
const FIRST_DEVICE_TRACK: u64 = 16;

/// Sequence of all packets.
const SEQUENCE: u64 = 1;
/// `TrackEvent.Type`.
const BEGIN: u64 = 1;
const END: u64 = 2;
const INSTANT: u64 = 3;
const COUNTER: u64 = 4;

/// Reason why a trace cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum TraceError {
    /// The operating system returned an error.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// The frames do not form one run from its start.
    #[error("the states of devices cannot be computed: {0}")]
    Frames(#[from] Discrepancy),
}

/// Writer of a trace.
pub struct PerfettoWriter<W> {
    out: W,
    mirror: DeviceMirror,
    /// Open slice and last written battery of each device.
    open_slices: Vec<Option<(&'static str, u64)>>,
    /// TTIs between two battery values.
    battery_interval: u64,
    /// Number of arrows so far.
    arrow_count: u64,
    /// First TTI whose states are not written yet.
    next_tti: Tti,
}

impl<W: Write> PerfettoWriter<W> {
    /// Writes the start of the trace of a run of `scenario`, with battery values every `battery_interval` TTIs.
    ///
    /// # Errors
    /// If the trace cannot be written.
    pub fn begin(out: W, run: &str, scenario: &Scenario, battery_interval: u64) -> io::Result<Self> {
        let deployment = Deployment::new(scenario);
        let mut trace = Self {
            out,
            mirror: DeviceMirror::new(scenario, &deployment),
            open_slices: vec![None; deployment.devices.len()],
            battery_interval,
            arrow_count: 0,
            next_tti: Tti::ZERO,
        };
        // `ProcessDescriptor`: pid 1, process_name 6. `TrackDescriptor`: uuid 1, name 2, process 3, parent_uuid 5,
        // counter 8.
        let process = Proto::new().number(1, 1).text(6, &format!("reveille {run}"));
        trace.write_track(&Proto::new().number(1, PROCESS_TRACK).message(3, &process))?;
        for (track, name) in [(STATION_TRACK, "base station"), (EVENTS_TRACK, "events")] {
            trace.write_track(&Proto::new().number(1, track).text(2, name).number(5, PROCESS_TRACK))?;
        }
        for device in &deployment.devices {
            let (id, position) = (device.id, device.position);
            let name = format!("device {id} at ({:.1}, {:.1}) m", position.x, position.y);
            let track = Proto::new()
                .number(1, state_track(id))
                .text(2, &name)
                .number(5, PROCESS_TRACK);
            trace.write_track(&track)?;
            let counter = Proto::new().text(6, "units");
            let track = Proto::new().number(1, battery_track(id)).text(2, "battery");
            trace.write_track(&track.number(5, state_track(id)).message(8, &counter))?;
        }
        Ok(trace)
    }

    /// Writes `frame`.
    ///
    /// # Errors
    /// If the trace cannot be written, or the frame contradicts the frames before it.
    pub fn write(&mut self, frame: &Frame) -> Result<(), TraceError> {
        let Ok(message) = frame.message() else {
            return Ok(());
        };
        let device = frame.number.map(DeviceId);
        // A plan or a grant closes the current TTI, so its states are final.
        if matches!(message, Message::Plan(_) | Message::World(_)) {
            self.write_states_until(self.mirror.next_tti())?;
        }
        if let Message::World(world) = &message {
            self.mirror.check_grant(world).map_err(|description| Discrepancy {
                tti: frame.tti,
                description,
            })?;
            // Devices act only in the last TTI of a grant, so the states of the other TTIs are final too.
            self.write_states_until(world.last)?;
        }
        self.mirror.apply(frame, &message)?;
        match (&message, device) {
            (Message::Plan(_) | Message::Removed(_) | Message::Action(_), _) => {
                self.write_instant(frame.tti, STATION_TRACK, &message.to_string(), None)?;
            }
            (Message::Wake(_), Some(device)) => {
                self.arrow_count += 1;
                // `TrackEvent.flow_ids`; the outcome below ends the arrow with `terminating_flow_ids`, 48.
                let flow = Some((47, self.arrow_count));
                self.write_instant(frame.tti, STATION_TRACK, &format!("wake device {device}"), flow)?;
            }
            (Message::Woken(woken), Some(device)) => {
                let flow = Some((48, self.arrow_count));
                let text = match &woken.outcome {
                    WakeOutcome::Reported(report) => format!("woken: {report}"),
                    outcome @ (WakeOutcome::Failed(_)
                    | WakeOutcome::Missed
                    | WakeOutcome::Lost(_)
                    | WakeOutcome::Late { .. }) => outcome.to_string(),
                };
                self.write_instant(frame.tti, state_track(device), &text, flow)?;
            }
            // A woken device's report is part of the outcome of its wake-up.
            (Message::Report(report), Some(device)) if !self.mirror.is_waking() => {
                self.write_instant(frame.tti, state_track(device), &report.to_string(), None)?;
            }
            (Message::Lost(lost), Some(device)) => {
                self.write_instant(frame.tti, state_track(device), &lost.to_string(), None)?;
            }
            (Message::Failed(failed), Some(device)) => {
                self.write_instant(frame.tti, state_track(device), &failed.to_string(), None)?;
            }
            (Message::Event(EventUpdate::Started(event)), _) => {
                let name = format!("event {}", event.stimulus.event.0);
                self.write_event(
                    event.start,
                    &Proto::new().number(9, BEGIN).number(11, EVENTS_TRACK).text(23, &name),
                )?;
            }
            (Message::Event(EventUpdate::Ended(record)), _) => {
                self.write_event(record.last + 1, &Proto::new().number(9, END).number(11, EVENTS_TRACK))?;
            }
            _ => {}
        }
        Ok(())
    }

    /// Completes the trace and returns its output.
    ///
    /// # Errors
    /// If the trace cannot be written.
    pub fn finish(mut self) -> Result<W, TraceError> {
        let end = self.mirror.next_tti();
        self.write_states_until(end)?;
        for (index, open_slice) in std::mem::take(&mut self.open_slices).into_iter().enumerate() {
            if open_slice.is_some() {
                self.end_slice(end, DeviceId(index as u32))?;
            }
        }
        self.out.flush()?;
        Ok(self.out)
    }

    /// Writes the outstanding states of all TTIs before `end`.
    fn write_states_until(&mut self, end: Tti) -> io::Result<()> {
        while self.next_tti < end {
            let views = self.mirror.views_at(self.next_tti);
            for (id, view) in (0..).map(DeviceId).zip(views) {
                self.write_state(self.next_tti, id, view)?;
            }
            self.next_tti = self.next_tti + 1;
        }
        Ok(())
    }

    fn write_state(&mut self, tti: Tti, id: DeviceId, view: DeviceView) -> io::Result<()> {
        let (name, level) = (state_name(view.state), view.battery.micro());
        let previous = self.open_slices[id.index()];
        let is_new_state = previous.is_none_or(|(slice, _)| slice != name);
        if is_new_state {
            if previous.is_some() {
                self.end_slice(tti, id)?;
            }
            self.write_event(
                tti,
                &Proto::new().number(9, BEGIN).number(11, state_track(id)).text(23, name),
            )?;
        }
        // Unchanged levels are not repeated, which keeps the trace small.
        let is_changed = previous.is_none_or(|(_, written)| written != level);
        let is_due = tti.0.is_multiple_of(self.battery_interval) && is_changed;
        let written_level = if is_new_state || is_due {
            // `TrackEvent`: type 9, track_uuid 11, name 23, double_counter_value 44.
            let event = Proto::new().number(9, COUNTER).number(11, battery_track(id));
            self.write_event(tti, &event.double(44, view.battery.units()))?;
            level
        } else {
            previous.map_or(level, |(_, written)| written)
        };
        self.open_slices[id.index()] = Some((name, written_level));
        Ok(())
    }

    fn end_slice(&mut self, tti: Tti, id: DeviceId) -> io::Result<()> {
        self.write_event(tti, &Proto::new().number(9, END).number(11, state_track(id)))
    }

    /// Writes an instant event, with the field and number of an arrow that starts or ends in it.
    fn write_instant(&mut self, tti: Tti, track: u64, name: &str, flow: Option<(u32, u64)>) -> io::Result<()> {
        let event = Proto::new().number(9, INSTANT).number(11, track).text(23, name);
        self.write_event(
            tti,
            &match flow {
                Some((field, number)) => event.fixed(field, number),
                None => event,
            },
        )
    }

    fn write_event(&mut self, tti: Tti, event: &Proto) -> io::Result<()> {
        // `TracePacket`: timestamp 8, trusted_packet_sequence_id 10, track_event 11.
        let packet = Proto::new().number(8, tti.0 * NANOS_PER_TTI).number(10, SEQUENCE);
        self.write_packet(&packet.message(11, event))
    }

    fn write_track(&mut self, track: &Proto) -> io::Result<()> {
        self.write_packet(&Proto::new().number(10, SEQUENCE).message(60, track))
    }

    fn write_packet(&mut self, packet: &Proto) -> io::Result<()> {
        self.out.write_all(&Proto::new().message(1, packet).into_bytes())
    }
}

const fn state_track(id: DeviceId) -> u64 {
    FIRST_DEVICE_TRACK + 2 * id.0 as u64
}

const fn battery_track(id: DeviceId) -> u64 {
    state_track(id) + 1
}

/// Name of the slice of a state.
const fn state_name(state: DeviceState) -> &'static str {
    match state {
        DeviceState::Idle => "S1 idle",
        DeviceState::Active => "S2 active",
        DeviceState::Transmission => "S3 transmission",
        DeviceState::Sleep { powered: true } => "S4 sleep",
        DeviceState::Sleep { powered: false } => "S4 sleep, unpowered",
        DeviceState::Failed => "failed",
    }
}
