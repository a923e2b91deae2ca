//! `reveille inspect export --to perfetto`: a run as a Perfetto trace, protocol buffers of type
//! `perfetto.protos.Trace`.
//!
//! Each device has a track with slices of its states and a counter with its battery. Each wake-up is an arrow from the
//! base station to the device, where the outcome is named. Wake-ups follow each other, so the last arrow is always the
//! open one. A TTI is a millisecond. The writer needs all frames of a run from TTI 0 in order, and skips frames that
//! cannot be decoded. `tests/recordings/check.py` reads the traces and repeats names of tracks and slices.
//!
//! Field numbers are copies of Perfetto's schema. A new kind of message is not shown unless `write` lists it.

use std::io::{self, Write};

use reveille_bs::scenario::Scenario;
use reveille_common::deployment::Deployment;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{EventUpdate, Frame, Message, WakeOutcome};
use reveille_common::state::{DeviceState, DeviceView};
use reveille_common::units::Energy;

use super::protobuf::ProtoMessage;
use crate::device_mirror::{DeviceMirror, Discrepancy};
use crate::recording::NANOS_PER_TTI;

/// Track numbers: the process of the run, the base station, the events, then two for each device.
const PROCESS_TRACK: u64 = 1;
const STATION_TRACK: u64 = 2;
const EVENTS_TRACK: u64 = 3;
const FIRST_DEVICE_TRACK: u64 = 16;

/// Sequence of all packets; any number except 0 will do.
const PACKET_SEQUENCE_ID: u64 = 1;

/// Field numbers and values of `perfetto.protos.TrackEvent`.
mod track_event {
    pub(super) const TYPE: u32 = 9;
    pub(super) const BEGIN: u64 = 1;
    pub(super) const END: u64 = 2;
    pub(super) const INSTANT: u64 = 3;
    pub(super) const COUNTER: u64 = 4;
    pub(super) const TRACK_UUID: u32 = 11;
    pub(super) const NAME: u32 = 23;
    pub(super) const DOUBLE_COUNTER_VALUE: u32 = 44;
    pub(super) const FLOW_IDS: u32 = 47;
    pub(super) const TERMINATING_FLOW_IDS: u32 = 48;
}

/// Field numbers of `perfetto.protos.TrackDescriptor`.
mod track_descriptor {
    pub(super) const UUID: u32 = 1;
    pub(super) const NAME: u32 = 2;
    pub(super) const PROCESS: u32 = 3;
    pub(super) const PARENT_UUID: u32 = 5;
    pub(super) const COUNTER: u32 = 8;
}

/// Field numbers of `perfetto.protos.TracePacket`.
mod trace_packet {
    pub(super) const TIMESTAMP: u32 = 8;
    pub(super) const TRUSTED_PACKET_SEQUENCE_ID: u32 = 10;
    pub(super) const TRACK_EVENT: u32 = 11;
    pub(super) const TRACK_DESCRIPTOR: u32 = 60;
}

/// `ProcessDescriptor.pid`.
const PROCESS_PID: u32 = 1;
/// `ProcessDescriptor.process_name`.
const PROCESS_NAME: u32 = 6;
/// `CounterDescriptor.unit_name`.
const COUNTER_UNIT_NAME: u32 = 6;
/// `Trace.packet`.
const TRACE_PACKET: u32 = 1;

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

/// The last values written for a device.
#[derive(Clone, Copy)]
struct WrittenState {
    /// Name of the open slice.
    slice: &'static str,
    battery: Energy,
}

/// Writer of a trace.
pub struct PerfettoWriter<W> {
    out: W,
    mirror: DeviceMirror,
    /// By device: the open slice and the last battery level; `None` before the first TTI.
    written: Vec<Option<WrittenState>>,
    /// TTIs between two battery values while the state stays the same.
    battery_interval: u64,
    /// Id of the last arrow; 0 before the first.
    last_flow_id: u64,
    /// First TTI whose states are not written yet, unlike the mirror's next TTI, which is the next one to grant.
    next_unwritten_tti: Tti,
}

impl<W: Write> PerfettoWriter<W> {
    /// Writes the start of the trace of a run of `scenario`. A battery level is written at each change of state, and,
    /// if it has changed, at multiples of `battery_interval` TTIs.
    ///
    /// # Errors
    /// If the trace cannot be written.
    pub fn begin(out: W, run: &str, scenario: &Scenario, battery_interval: u64) -> io::Result<Self> {
        let deployment = Deployment::new(scenario);
        let mut trace = Self {
            out,
            mirror: DeviceMirror::new(scenario, &deployment),
            written: vec![None; deployment.devices.len()],
            battery_interval,
            last_flow_id: 0,
            next_unwritten_tti: Tti::ZERO,
        };
        let process = ProtoMessage::new()
            .varint(PROCESS_PID, 1)
            .string(PROCESS_NAME, &format!("reveille {run}"));
        let process_track = ProtoMessage::new().varint(track_descriptor::UUID, PROCESS_TRACK);
        trace.write_track(&process_track.message(track_descriptor::PROCESS, &process))?;
        for (uuid, name) in [(STATION_TRACK, "base station"), (EVENTS_TRACK, "events")] {
            trace.write_track(&describe_track(uuid, name, PROCESS_TRACK))?;
        }
        let counter = ProtoMessage::new().string(COUNTER_UNIT_NAME, "units");
        for device in &deployment.devices {
            let (id, position) = (device.id, device.position);
            let name = format!("device {id} at ({:.1}, {:.1}) m", position.x, position.y);
            trace.write_track(&describe_track(state_track(id), &name, PROCESS_TRACK))?;
            let battery = describe_track(battery_track(id), "battery", state_track(id));
            trace.write_track(&battery.message(track_descriptor::COUNTER, &counter))?;
        }
        Ok(trace)
    }

    /// Writes `frame`, unless it cannot be decoded.
    ///
    /// # Errors
    /// If the trace cannot be written, or the frame contradicts the frames before it. No frame may follow an error.
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
                self.last_flow_id += 1;
                // The outcome below ends the arrow.
                let flow = Some((track_event::FLOW_IDS, self.last_flow_id));
                self.write_instant(frame.tti, STATION_TRACK, &format!("wake device {device}"), flow)?;
            }
            (Message::Woken(woken), Some(device)) => {
                let flow = Some((track_event::TERMINATING_FLOW_IDS, self.last_flow_id));
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
            (Message::Report(report), Some(device)) if !self.mirror.has_open_wake_up() => {
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
                self.write_event(event.start, &begin_slice(EVENTS_TRACK, &name))?;
            }
            (Message::Event(EventUpdate::Ended(record)), _) => {
                self.write_event(record.last + 1, &new_event(track_event::END, EVENTS_TRACK))?;
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
        for (id, written) in (0..).map(DeviceId).zip(std::mem::take(&mut self.written)) {
            if written.is_some() {
                self.end_slice(end, id)?;
            }
        }
        self.out.flush()?;
        Ok(self.out)
    }

    /// Writes the outstanding states of all TTIs before `end`.
    fn write_states_until(&mut self, end: Tti) -> io::Result<()> {
        while self.next_unwritten_tti < end {
            let views = self.mirror.views_at(self.next_unwritten_tti);
            for (id, view) in (0..).map(DeviceId).zip(views) {
                self.write_state(self.next_unwritten_tti, id, view)?;
            }
            self.next_unwritten_tti = self.next_unwritten_tti + 1;
        }
        Ok(())
    }

    fn write_state(&mut self, tti: Tti, id: DeviceId, view: DeviceView) -> io::Result<()> {
        let slice = state_name(view.state);
        let previous = self.written[id.index()];
        let is_new_state = previous.is_none_or(|written| written.slice != slice);
        if is_new_state {
            if previous.is_some() {
                self.end_slice(tti, id)?;
            }
            self.write_event(tti, &begin_slice(state_track(id), slice))?;
        }
        // Unchanged levels are not repeated, which keeps the trace small.
        let is_changed = previous.is_none_or(|written| written.battery != view.battery);
        let is_due = tti.0.is_multiple_of(self.battery_interval) && is_changed;
        let battery = if is_new_state || is_due {
            let event = new_event(track_event::COUNTER, battery_track(id));
            self.write_event(
                tti,
                &event.double(track_event::DOUBLE_COUNTER_VALUE, view.battery.units()),
            )?;
            view.battery
        } else {
            previous.map_or(view.battery, |written| written.battery)
        };
        self.written[id.index()] = Some(WrittenState { slice, battery });
        Ok(())
    }

    fn end_slice(&mut self, tti: Tti, id: DeviceId) -> io::Result<()> {
        self.write_event(tti, &new_event(track_event::END, state_track(id)))
    }

    /// Writes an instant event. `flow` is the field number and the id of an arrow that starts or ends in it.
    fn write_instant(&mut self, tti: Tti, track: u64, name: &str, flow: Option<(u32, u64)>) -> io::Result<()> {
        let event = new_event(track_event::INSTANT, track).string(track_event::NAME, name);
        self.write_event(
            tti,
            &match flow {
                Some((field_number, flow_id)) => event.fixed64(field_number, flow_id),
                None => event,
            },
        )
    }

    fn write_event(&mut self, tti: Tti, event: &ProtoMessage) -> io::Result<()> {
        let packet = ProtoMessage::new().varint(trace_packet::TIMESTAMP, tti.0 * NANOS_PER_TTI);
        self.write_packet(&with_sequence(packet).message(trace_packet::TRACK_EVENT, event))
    }

    fn write_track(&mut self, track: &ProtoMessage) -> io::Result<()> {
        let packet = with_sequence(ProtoMessage::new());
        self.write_packet(&packet.message(trace_packet::TRACK_DESCRIPTOR, track))
    }

    fn write_packet(&mut self, packet: &ProtoMessage) -> io::Result<()> {
        self.out
            .write_all(&ProtoMessage::new().message(TRACE_PACKET, packet).into_bytes())
    }
}

/// Appends the sequence of all packets. Fields are written in the order of their numbers, as protobuf libraries do.
fn with_sequence(packet: ProtoMessage) -> ProtoMessage {
    packet.varint(trace_packet::TRUSTED_PACKET_SEQUENCE_ID, PACKET_SEQUENCE_ID)
}

fn describe_track(uuid: u64, name: &str, parent: u64) -> ProtoMessage {
    ProtoMessage::new()
        .varint(track_descriptor::UUID, uuid)
        .string(track_descriptor::NAME, name)
        .varint(track_descriptor::PARENT_UUID, parent)
}

fn new_event(event_type: u64, track: u64) -> ProtoMessage {
    ProtoMessage::new()
        .varint(track_event::TYPE, event_type)
        .varint(track_event::TRACK_UUID, track)
}

fn begin_slice(track: u64, name: &str) -> ProtoMessage {
    new_event(track_event::BEGIN, track).string(track_event::NAME, name)
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
