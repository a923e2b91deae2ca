//! The timeline of many devices in a compact binary form, for `page/timeline_data.js`.
//!
//! An answer has a header of four little-endian numbers: the first TTI and the end of the TTIs that it covers (64 bits
//! each), the number of columns and the number of rows (32 bits each). Three planes of bytes follow, row by row: the
//! flags of each column, 255 times the share of its TTIs in S1, and the battery at its end. A column covers `step`
//! TTIs; the first and the last one can have fewer. The first TTI is the requested one; the cells of TTIs that are not
//! available stay 0.

use std::sync::{Mutex, PoisonError};

use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Frame, Message, MessageKind, WakeOutcome};
use reveille_common::state::{DeviceState, DeviceView};
use reveille_common::units::Energy;
use reveille_view::history::{HistorySpan, ResumeSnapshot, RunHistory};

/// Most rows of one answer; an error text of `api` repeats it. The tiles of `page/timeline_data.js` stay below all
/// three limits.
pub(super) const MAX_ROWS: usize = 256;
/// Most columns of one answer.
pub(super) const MAX_COLUMNS: u64 = 4_096;
/// Most states that one answer computes: rows × TTIs.
pub(super) const MAX_DEVICE_TTIS: u64 = 8_000_000;

// The flags of a column: states in which its TTIs ended, and marks. `page/timeline_data.js` repeats names and values.
/// S1.
const SENSING: u8 = 1;
/// S2 or S3.
const REPORTING: u8 = 2;
/// S4 with power for the wake-up radio.
const ASLEEP: u8 = 4;
/// S4 without power for the wake-up radio.
const UNPOWERED: u8 = 8;
/// The device sent a report that arrived.
const REPORTED: u8 = 16;
/// The base station sent a wake-up signal to the device.
const WAKE_UP_SENT: u8 = 32;
/// The device lacked the energy for a report, or its report was lost.
const FAILED: u8 = 64;
/// An operator has let the device fail.
const OUT: u8 = 128;

/// A requested part of the timeline.
pub(super) struct TimelineRequest {
    pub from: Tti,
    /// The TTI after the last one.
    pub end: Tti,
    /// TTIs in a column, at least 1.
    pub step: u64,
    /// The devices of the rows, in the order of the rows.
    pub devices: Vec<DeviceId>,
}

/// The snapshot that the last answer ended with. Requests that follow a live run continue from it.
#[derive(Default)]
pub(super) struct TimelineCursor(Mutex<Option<ResumeSnapshot>>);

impl TimelineCursor {
    /// Copies the requested TTIs from `history`; `None` if none of them is available.
    pub(super) fn copy_span(&self, history: &RunHistory, request: &TimelineRequest) -> Option<HistorySpan> {
        // A request for one device, whose panel shows older TTIs, leaves the snapshot to the timeline.
        let snapshot_near_end = if request.devices.len() > 1 {
            self.lock().take()
        } else {
            None
        };
        history.span(request.from, request.end, snapshot_near_end)
    }

    /// Encodes the answer to `request` from `span`, which [`Self::copy_span`] has copied for it. Battery levels are
    /// shares of `e_max`, the capacities by device.
    pub(super) fn encode(&self, request: &TimelineRequest, span: HistorySpan, e_max: &[Energy]) -> Vec<u8> {
        let mut cells = Cells::new(request, span.ttis().1);
        for frame in span.frames() {
            cells.mark(frame, request);
        }
        let end = span.ttis().1;
        let row_e_max: Vec<Energy> = request.devices.iter().map(|device| e_max[device.index()]).collect();
        let snapshot_near_end = span.for_each_tti(&request.devices, |tti, views| cells.add_tti(tti, views, &row_e_max));
        if request.devices.len() > 1 {
            *self.lock() = Some(snapshot_near_end);
        }
        cells.encode(end)
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Option<ResumeSnapshot>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The cells of an answer, row by row.
struct Cells {
    from: Tti,
    step: u64,
    columns: usize,
    rows: usize,
    flags: Vec<u8>,
    /// Available TTIs of each column.
    column_ttis: Vec<u32>,
    /// TTIs in S1 of each cell.
    sensing_ttis: Vec<u32>,
    batteries: Vec<u8>,
}

impl Cells {
    fn new(request: &TimelineRequest, end: Tti) -> Self {
        let columns = (end - request.from).div_ceil(request.step) as usize;
        let rows = request.devices.len();
        let cells = columns * rows;
        Self {
            from: request.from,
            step: request.step,
            columns,
            rows,
            flags: vec![0; cells],
            column_ttis: vec![0; columns],
            sensing_ttis: vec![0; cells],
            batteries: vec![0; cells],
        }
    }

    /// The index of the cell of `row` in TTI `tti`, a TTI of the span.
    const fn cell(&self, row: usize, tti: Tti) -> usize {
        row * self.columns + ((tti.0 - self.from.0) / self.step) as usize
    }

    /// Sets the mark of a frame, if it has one and its device a row.
    fn mark(&mut self, frame: &Frame, request: &TimelineRequest) {
        let is_failed_wake_up = || {
            let Ok(Message::Woken(woken)) = frame.message() else {
                return false;
            };
            matches!(woken.outcome, WakeOutcome::Failed(_) | WakeOutcome::Lost(_))
        };
        let flag = if frame.kind == MessageKind::Report {
            REPORTED
        } else if frame.kind == MessageKind::Wake {
            WAKE_UP_SENT
        } else if matches!(frame.kind, MessageKind::Failed | MessageKind::Lost)
            || (frame.kind == MessageKind::Woken && is_failed_wake_up())
        {
            FAILED
        } else {
            return;
        };
        let Some(number) = frame.number else { return };
        if let Some(row) = request.devices.iter().position(|device| device.0 == number) {
            let cell = self.cell(row, frame.tti);
            self.flags[cell] |= flag;
        }
    }

    /// Adds the end of TTI `tti`; `views` and the capacities `e_max` are in the order of the rows.
    fn add_tti(&mut self, tti: Tti, views: &[DeviceView], e_max: &[Energy]) {
        let column = self.cell(0, tti);
        self.column_ttis[column] += 1;
        for (row, (view, &e_max)) in views.iter().zip(e_max).enumerate() {
            let cell = self.cell(row, tti);
            self.flags[cell] |= match view.state {
                DeviceState::Idle => SENSING,
                DeviceState::Active | DeviceState::Transmission => REPORTING,
                DeviceState::Sleep { powered: true } => ASLEEP,
                DeviceState::Sleep { powered: false } => UNPOWERED,
                DeviceState::Failed => OUT,
            };
            self.sensing_ttis[cell] += u32::from(view.state == DeviceState::Idle);
            self.batteries[cell] = battery_byte(view.battery, e_max);
        }
    }

    fn encode(&self, end: Tti) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(24 + 3 * self.flags.len());
        bytes.extend(self.from.0.to_le_bytes());
        bytes.extend(end.0.to_le_bytes());
        bytes.extend((self.columns as u32).to_le_bytes());
        bytes.extend((self.rows as u32).to_le_bytes());
        bytes.extend(&self.flags);
        // The first and the last column can have fewer TTIs than the others.
        bytes.extend(self.sensing_ttis.iter().enumerate().map(|(cell, ttis)| {
            let column_ttis = self.column_ttis[cell % self.columns].max(1);
            (u64::from(*ttis) * 255 / u64::from(column_ttis)) as u8
        }));
        bytes.extend(&self.batteries);
        bytes
    }
}

/// A battery level as a byte: 0 to 255 for a share of `e_max`. Rounded up, so that only an empty battery is 0.
pub(super) fn battery_byte(battery: Energy, e_max: Energy) -> u8 {
    (battery.micro() * 255).div_ceil(e_max.micro().max(1)).min(255) as u8
}

/// The devices of a list such as `0-31,40`, each below `devices`; `None` if it is malformed or has more than
/// [`MAX_ROWS`].
pub(super) fn parse_rows(list: &str, devices: u32) -> Option<Vec<DeviceId>> {
    let mut rows = Vec::new();
    for part in list.split(',') {
        let (first, last) = part.split_once('-').unwrap_or((part, part));
        let (first, last): (u32, u32) = (first.trim().parse().ok()?, last.trim().parse().ok()?);
        if first > last || last >= devices || (last - first) as usize >= MAX_ROWS {
            return None;
        }
        rows.extend((first..=last).map(DeviceId));
        if rows.len() > MAX_ROWS {
            return None;
        }
    }
    Some(rows)
}

#[cfg(test)]
mod tests {
    use reveille_bs::observer::frames::FrameObserver;
    use reveille_bs::scenario::{Override, load};
    use reveille_lab::preparation::prepare;
    use reveille_lab::run::{Run, RunOptions};

    use super::*;

    #[test]
    fn rows_are_lists_and_ranges() {
        let ids = |list| parse_rows(list, 300).map(|rows| rows.iter().map(|id| id.0).collect::<Vec<_>>());
        assert_eq!(ids("3,5-7, 9"), Some(vec![3, 5, 6, 7, 9]));
        for list in ["", "x", "7-5", "300", "0-256", "0-200,0-200"] {
            assert_eq!(ids(list), None, "{list}");
        }
    }

    #[test]
    fn cells_hold_the_states_and_batteries_of_the_history() {
        let set = ["devices=30", "ttis=1500", "policy.name=knn", "events.alpha=0.4"];
        let set = set.map(|set| Override::parse(set).expect("an override"));
        let scenario = load("paper", &set).expect("a scenario").scenario;
        let mut history = RunHistory::new(&scenario, u64::MAX);
        let take = |frame| history.push(frame).expect("a consistent frame");
        Run::new(&prepare(&scenario), RunOptions::default()).finish(&mut FrameObserver::new(0, take));
        let cursor = TimelineCursor::default();
        // Unlike in the scenario, each device has its own.
        let e_max: Vec<Energy> = (0..30)
            .map(|j| Energy::from_units(100.0 + f64::from(j)).expect("a level"))
            .collect();
        let mut marks = 0;
        // The second request continues where the first ends. The last column of each is cut short.
        for (from, end) in [(600, 950), (950, 1302)] {
            let request = TimelineRequest {
                from: Tti(from),
                end: Tti(end),
                step: 4,
                devices: parse_rows("2-9,20", 30).expect("rows"),
            };
            let span = cursor.copy_span(&history, &request).expect("available TTIs");
            let bytes = cursor.encode(&request, span, &e_max);
            let columns = (end - from).div_ceil(4) as usize;
            let cells = columns * 9;
            assert_eq!(bytes.len(), 24 + 3 * cells);
            for column in 0..columns {
                let ttis = (from + 4 * column as u64)..(from + 4 * column as u64 + 4).min(end);
                let snapshots: Vec<_> = ttis
                    .clone()
                    .map(|k| history.snapshot_at(Tti(k)).expect("an available TTI"))
                    .collect();
                for (row, device) in request.devices.iter().enumerate() {
                    let cell = 24 + row * columns + column;
                    let mut views = snapshots.iter().map(|snapshot| snapshot.views[device.index()]);
                    let sensing = views.clone().filter(|view| view.state == DeviceState::Idle).count();
                    assert_eq!(
                        usize::from(bytes[cells + cell]),
                        sensing * 255 / snapshots.len(),
                        "TTIs {ttis:?}"
                    );
                    assert_eq!(bytes[cell] & SENSING != 0, sensing > 0, "TTIs {ttis:?}");
                    let last = views.next_back().expect("a TTI");
                    assert_eq!(
                        bytes[2 * cells + cell],
                        battery_byte(last.battery, e_max[device.index()]),
                        "TTIs {ttis:?}"
                    );
                    let is_woken = snapshots
                        .iter()
                        .any(|snapshot| snapshot.woken.iter().any(|(woken, _)| woken == device));
                    assert_eq!(bytes[cell] & WAKE_UP_SENT != 0, is_woken, "TTIs {ttis:?}");
                    marks += usize::from(bytes[cell] & (WAKE_UP_SENT | REPORTED) != 0);
                }
            }
        }
        assert!(marks > 10, "{marks} marks");
    }
}
