//! Missed events of one run: by cause, place, nearest device and time, and the changes that the main cause suggests.
//! `deploy/src/run_reader.rs` fills [`Misses`] from the files of a run, `reveille inspect misses` prints it, and
//! [`crate::figures::misses`] draws it. All numbers cover counted events, as the metrics do.

mod advice;
mod phases;
mod suggestion;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;

use libm::{log10, pow};
use reveille_bs::scenario::Scenario;
use reveille_common::deployment::Deployment;
use reveille_common::geometry::{Buckets, Point};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::OperatorAction;
use reveille_common::totals::MissCause;

use self::advice::{HotSpot, MainCause};

pub use advice::{Advice, RunEnergy};
pub use phases::{ActionFailure, Phase};
pub use suggestion::{FieldChange, Suggestion};

/// Name of the cause of events whose table has no causes. A key in `inspect misses --json`, like the names of causes.
pub const UNKNOWN_CAUSE: &str = "unknown";
/// Most columns and rows of a [`MissMap`].
const MAP_COLUMNS: usize = 16;
const MAP_ROWS: usize = 16;

/// A missed event.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MissedEvent {
    /// Number of the event.
    pub event: u64,
    /// TTI in which it started.
    pub start: Tti,
    /// Place, metres.
    pub epicentre: Point,
    /// Cause; `None` in tables of versions without causes.
    pub cause: Option<MissCause>,
    /// The nearest device.
    pub nearest: DeviceId,
    /// Distance from it, metres.
    pub distance_m: f64,
}

/// The missed events of a run. The caller of [`Misses::new`] fills all fields after `positions`.
#[derive(Clone, Debug)]
pub struct Misses {
    /// The scenario of the run.
    pub scenario: Scenario,
    /// Positions of the devices, metres, in the order of ids.
    pub positions: Vec<Point>,
    /// Start of every counted event, missed or not, in order. None is in the warm-up.
    pub counted_starts: Vec<Tti>,
    /// The counted events that were missed, in order.
    pub missed: Vec<MissedEvent>,
    /// Number of missed events in the warm-up, which no other number includes.
    pub in_warm_up: u64,
    /// End of the covered TTIs, exclusive.
    pub end: Tti,
    /// The energy of a finished run.
    pub energy: Option<RunEnergy>,
    /// The actions of operators and scripts.
    pub actions: Vec<OperatorAction>,
}

/// Numbers of missed events and devices in the square cells of the area. Rows start in the south, cells in the west.
#[derive(Clone, Debug, PartialEq)]
pub struct MissMap {
    /// Side of a cell, metres.
    pub cell_m: f64,
    /// Cells per row.
    pub columns: usize,
    /// Numbers of missed events, by row and column.
    pub missed_counts: Vec<Vec<u64>>,
    /// Numbers of devices, by row and column.
    pub device_counts: Vec<Vec<u64>>,
    /// Numbers of devices that actions failed, by row and column.
    pub failed_counts: Vec<Vec<u64>>,
}

/// The events of a part of the run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MissBin {
    /// First TTI.
    pub first: Tti,
    /// TTI after the last.
    pub end: Tti,
    /// Counted events that started in these TTIs.
    pub events: u64,
    /// Numbers of missed events by cause, in the order of [`Misses::causes`].
    pub missed_by_cause: Vec<u64>,
}

/// A device that was the nearest to missed events.
#[derive(Clone, Debug, PartialEq)]
pub struct InvolvedDevice {
    /// The device.
    pub device: DeviceId,
    /// Number of missed events to which it was the nearest device.
    pub missed_count: u64,
    /// The most frequent cause of them; of equally frequent ones, the first in the order of `count_causes`. `None` is
    /// an unknown cause.
    pub main_cause: Option<MissCause>,
    /// Mean distance of the events, metres.
    pub mean_distance_m: f64,
}

/// Returns the name of a cause in tables.
pub fn cause_name(cause: Option<MissCause>) -> &'static str {
    cause.map_or(UNKNOWN_CAUSE, MissCause::name)
}

/// Counts causes, the most frequent first. Equally frequent ones are in the order of [`MissCause::ALL`], after unknown
/// causes.
fn count_causes<'e>(events: impl IntoIterator<Item = &'e MissedEvent>) -> Vec<(Option<MissCause>, u64)> {
    let order = |cause: Option<MissCause>| MissCause::ALL.iter().position(|known| Some(*known) == cause);
    let mut counts: BTreeMap<Option<usize>, (Option<MissCause>, u64)> = BTreeMap::new();
    for event in events {
        counts.entry(order(event.cause)).or_insert((event.cause, 0)).1 += 1;
    }
    let mut counts: Vec<_> = counts.into_values().collect();
    counts.sort_by_key(|(_, count)| std::cmp::Reverse(*count));
    counts
}

impl Misses {
    /// Creates the missed events of a run of `scenario` that has no events yet.
    pub fn new(scenario: Scenario) -> Self {
        let positions = Deployment::new(&scenario).positions();
        let end = scenario.warm_up_end();
        Self {
            scenario,
            positions,
            counted_starts: Vec::new(),
            missed: Vec::new(),
            in_warm_up: 0,
            end,
            energy: None,
            actions: Vec::new(),
        }
    }

    /// Returns the device nearest to each place, with the distance in metres.
    pub fn nearest_devices(&self, places: impl IntoIterator<Item = Point>) -> Vec<(DeviceId, f64)> {
        let buckets = Buckets::new(&self.positions, self.scenario.area, self.scenario.sensing.d_max);
        let nearest = |place| {
            // A scenario has at least one device.
            let found = buckets.nearest(place, 1);
            found.first().map_or((DeviceId(0), f64::NAN), |(squared, device)| {
                (DeviceId(*device), squared.sqrt())
            })
        };
        places.into_iter().map(nearest).collect()
    }

    /// Share of the counted events that were missed, %; NaN without events.
    pub fn missed_pct(&self) -> f64 {
        100.0 * self.missed.len() as f64 / self.counted_starts.len() as f64
    }

    /// The causes that occur, each with its number of events, the most frequent first.
    pub fn causes(&self) -> Vec<(Option<MissCause>, u64)> {
        count_causes(&self.missed)
    }

    /// Divides the area into cells.
    fn grid(&self) -> Grid {
        let area = self.scenario.area;
        let cell_m = round_up((area.width / MAP_COLUMNS as f64).max(area.height / MAP_ROWS as f64));
        let cell_count = |length: f64| ((length / cell_m - 1e-9).ceil() as usize).max(1);
        Grid {
            cell_m,
            columns: cell_count(area.width),
            rows: cell_count(area.height),
        }
    }

    /// Counts the missed events and the devices in cells of the area.
    pub fn map(&self) -> MissMap {
        let grid = self.grid();
        let failed = self.action_failures();
        let failed_positions = failed.keys().filter_map(|device| self.positions.get(device.index()));
        MissMap {
            cell_m: grid.cell_m,
            columns: grid.columns,
            missed_counts: grid.count(self.missed.iter().map(|event| event.epicentre)),
            device_counts: grid.count(self.positions.iter().copied()),
            failed_counts: grid.count(failed_positions.copied()),
        }
    }

    /// Divides the measured TTIs into at most `count` bins of equal length, the last one possibly shorter. The missed
    /// events of each bin are in the order of [`Self::causes`].
    pub fn bins(&self, count: u64) -> Vec<MissBin> {
        let (first, causes) = (self.scenario.warm_up_end(), self.causes());
        let ttis = self.end.0.saturating_sub(first.0);
        if ttis == 0 || count == 0 {
            return Vec::new();
        }
        let length = ttis.div_ceil(count);
        let bin = |number: u64| MissBin {
            first: first + number * length,
            end: (first + (number + 1) * length).min(self.end),
            events: 0,
            missed_by_cause: vec![0; causes.len()],
        };
        let mut bins: Vec<MissBin> = (0..ttis.div_ceil(length)).map(bin).collect();
        let bin_index = |start: Tti| (start.0.saturating_sub(first.0) / length) as usize;
        for start in &self.counted_starts {
            if let Some(bin) = bins.get_mut(bin_index(*start)) {
                bin.events += 1;
            }
        }
        for event in &self.missed {
            let cause_index = causes.iter().position(|(cause, _)| *cause == event.cause);
            if let (Some(bin), Some(cause_index)) = (bins.get_mut(bin_index(event.start)), cause_index) {
                bin.missed_by_cause[cause_index] += 1;
            }
        }
        bins
    }

    /// The devices nearest to missed events: most events first, lower numbers first in a tie.
    pub fn involved_devices(&self) -> Vec<InvolvedDevice> {
        let mut by_device: BTreeMap<DeviceId, Vec<&MissedEvent>> = BTreeMap::new();
        for event in &self.missed {
            by_device.entry(event.nearest).or_default().push(event);
        }
        let involved = |(device, events): (DeviceId, Vec<&MissedEvent>)| InvolvedDevice {
            device,
            missed_count: events.len() as u64,
            main_cause: count_causes(events.iter().copied())
                .first()
                .and_then(|(cause, _)| *cause),
            mean_distance_m: events.iter().map(|event| event.distance_m).sum::<f64>() / events.len() as f64,
        };
        let mut devices: Vec<InvolvedDevice> = by_device.into_iter().map(involved).collect();
        devices.sort_by_key(|device| std::cmp::Reverse(device.missed_count));
        devices
    }

    /// Returns the main cause and the scenario fields to change; `None` without missed events. Events near devices that
    /// actions failed count as one cause.
    pub fn advice(&self) -> Option<Advice> {
        let missed = self.missed_by_failures();
        let (cause, count) = *count_causes(&missed).first()?;
        let Some(cause) = cause else {
            return Some(Advice {
                finding: "The table has no causes of missed events.".to_owned(),
                suggestions: vec![Suggestion::without_trials(
                    "repeat the run with this version of Reveille",
                )],
            });
        };
        let of_cause: Vec<&MissedEvent> = missed.iter().filter(|event| event.cause == Some(cause)).collect();
        let main_cause = MainCause {
            cause,
            count,
            missed: missed.len(),
            hot_spot: self.hot_spot(&of_cause),
            farthest_m: of_cause.iter().map(|event| event.distance_m).fold(0.0, f64::max),
        };
        Some(advice::advise(&self.scenario, &main_cause, self.energy))
    }

    /// Returns the cell with most of `events`, unless chance explains their number.
    fn hot_spot(&self, events: &[&MissedEvent]) -> Option<HotSpot> {
        let grid = self.grid();
        let places: Vec<Point> = events.iter().map(|event| event.epicentre).collect();
        let counts = grid.count(places.iter().copied());
        let cells = places.iter().map(|place| grid.cell(*place));
        // Of equally full cells the one farthest south-west.
        let fullest = cells.max_by_key(|cell| (counts[cell.0][cell.1], std::cmp::Reverse(*cell)))?;
        let in_fullest: Vec<&Point> = places.iter().filter(|place| grid.cell(**place) == fullest).collect();
        let count = in_fullest.len() as f64;
        let mean_count = places.len() as f64 / (grid.columns * grid.rows) as f64;
        // Poisson counts reach the limits somewhere in 256 cells in at most about 2 % of runs with uniform places.
        let limits = [5.0, 3.0 * mean_count, mean_count + 4.0 * mean_count.sqrt() + 2.0];
        let mean =
            |coordinate: fn(&Point) -> f64| in_fullest.iter().map(|place| coordinate(place)).sum::<f64>() / count;
        limits.into_iter().all(|limit| count >= limit).then(|| HotSpot {
            count: in_fullest.len(),
            place: Point::new(mean(|place| place.x), mean(|place| place.y)),
        })
    }
}

/// Square cells of the area.
struct Grid {
    /// Side of a cell, metres.
    cell_m: f64,
    columns: usize,
    rows: usize,
}

impl Grid {
    /// Returns the row and column of the cell at `place`. The outer border belongs to the last cells.
    fn cell(&self, place: Point) -> (usize, usize) {
        let index = |metres: f64, cells: usize| ((metres / self.cell_m) as usize).min(cells - 1);
        (index(place.y, self.rows), index(place.x, self.columns))
    }

    /// Counts `places` by row and column.
    fn count(&self, places: impl Iterator<Item = Point>) -> Vec<Vec<u64>> {
        let mut counts = vec![vec![0; self.columns]; self.rows];
        for place in places {
            let (row, column) = self.cell(place);
            counts[row][column] += 1;
        }
        counts
    }
}

/// Rounds a positive length up to 1, 2 or 5 times a power of ten.
fn round_up(length: f64) -> f64 {
    let power = pow(10.0, log10(length).floor());
    let steps = [1.0, 2.0, 5.0, 10.0].map(|step| step * power);
    // The tolerance keeps a length that is such a number up to rounding.
    steps
        .into_iter()
        .find(|step| *step >= length * (1.0 - 1e-9))
        .unwrap_or(length)
}
