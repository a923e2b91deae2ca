//! Timeline figure: battery and states of selected devices per TTI, with the events and wake-ups of a repeated run.
//! [`file_name`] names the files of `reveille figures timeline` and the picture in Python. The limits and the default
//! number of devices are also in `deploy/src/cli/figures.rs` and `python/reveille/figures.py`.

use reveille_bs::scenario::Scenario;
use reveille_common::digits::{count_noun, format_significant};
use reveille_common::event::EventRecord;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::WakeOutcome;
use reveille_common::scenario::{EnergyModel, assign_classes};
use reveille_common::state::DeviceState;
use reveille_common::units::Energy;

use super::error::FigureError;
use super::font::{Weight, wrap_text};
use super::path::VectorPath;
use super::run_title::{policy_sentence, run_name};
use super::run_walk::{RunWalk, TtiOutcome, collect_events};
use super::scale::Scale;
use super::scene::{Anchor, Paint, Scene, Stroke, Text};
use super::style::{BLUE, GREEN, LEADING, MARGIN, ORANGE, PAGE_WIDTH, TEXT_SIZE, TITLE_SIZE, VERMILION};

/// Left and right edge of the plots, points.
const PLOT_LEFT: f64 = 48.0;
const PLOT_RIGHT: f64 = PAGE_WIDTH - MARGIN - 4.0;
/// Height of a battery plot, of a lane of states, and of the gap to the next device, points.
const BATTERY_HEIGHT: f64 = 62.0;
const LANE_HEIGHT: f64 = 9.0;
const DEVICE_GAP: f64 = 12.0;
/// Number of devices in a timeline by default.
const DEFAULT_DEVICES: usize = 3;
/// Largest number of devices in a timeline.
pub(crate) const MAX_DEVICES: u32 = 8;

/// One device in one TTI.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DeviceTti {
    /// The TTI.
    pub tti: Tti,
    /// State in the TTI after its events, reports and wake-ups.
    pub state: DeviceState,
    /// Whether the device, on duty or woken, was in S2 and could not transmit.
    pub could_not_transmit: bool,
    /// Whether the BS sent the device a wake-up signal.
    pub has_wake_up: bool,
    /// Battery level at the end of the TTI.
    pub battery: Energy,
}

/// Content of a timeline figure.
#[derive(Clone, Debug)]
pub struct Timeline {
    /// First TTI.
    pub from: Tti,
    /// TTI after the last one.
    pub end: Tti,
    /// Shown devices with their energy model and their history.
    pub devices: Vec<(DeviceId, EnergyModel, Vec<DeviceTti>)>,
    /// Events that overlap these TTIs, warm-up events included.
    pub events: Vec<EventRecord>,
}

impl Timeline {
    /// Collects `ttis` TTIs of a run of `scenario`, from TTI `from`. Without `devices` it selects the three devices
    /// with most reports, sent or failed, and wake-ups in these TTIs, lower numbers first in a tie.
    ///
    /// # Errors
    /// The run has no such device or TTIs, `ttis` is not from 10 to 2000, or there are more than `MAX_DEVICES` devices.
    pub fn from_scenario(scenario: &Scenario, devices: &[u32], from: u64, ttis: u64) -> Result<Self, FigureError> {
        // Both numbers are user input, so the sum may overflow. `FigureError::NoWindow` states the limits.
        let end = from.saturating_add(ttis);
        if !(10..=2000).contains(&ttis) || end > scenario.run.ttis {
            return Err(FigureError::NoWindow {
                from,
                to: end.saturating_sub(1),
                ttis: scenario.run.ttis,
            });
        }
        if let Some(&device) = devices.iter().find(|d| **d >= scenario.run.devices) {
            return Err(FigureError::NoDevice {
                device,
                count: scenario.run.devices,
            });
        }
        if devices.len() > MAX_DEVICES as usize {
            return Err(FigureError::TooManyDevices {
                count: devices.len() as u32,
                figure: "a timeline",
                limit: MAX_DEVICES,
                advice: "draw several",
            });
        }
        let shown = if devices.is_empty() {
            busiest_devices(scenario, Tti(from), Tti(end))
        } else {
            devices.iter().copied().map(DeviceId).collect()
        };
        let overlaps = |e: &EventRecord| e.start.0 < end && e.last.0 >= from;
        Ok(Self {
            from: Tti(from),
            end: Tti(end),
            devices: device_histories(scenario, &shown, Tti(from), Tti(end)),
            // These come from a whole run: an event is recorded when it ends, which may be after the last TTI shown.
            events: collect_events(scenario).into_iter().filter(overlaps).collect(),
        })
    }
}

/// Runs the TTIs before `end`, which is at most the run's length, and calls `visit` for each of them from `from` on.
fn for_each_tti(scenario: &Scenario, from: Tti, end: Tti, mut visit: impl FnMut(&RunWalk, Tti, &TtiOutcome)) {
    let mut walk = RunWalk::new(scenario);
    loop {
        let (k, outcome) = walk.step();
        if k >= from {
            visit(&walk, k, &outcome);
        }
        if k + 1 >= end {
            return;
        }
    }
}

/// Returns the devices with most reports and wake-ups, as [`Timeline::from_scenario`] states, in the order of ids.
fn busiest_devices(scenario: &Scenario, from: Tti, end: Tti) -> Vec<DeviceId> {
    let mut activity_counts = vec![0_u32; scenario.run.devices as usize];
    for_each_tti(scenario, from, end, |_, _, outcome| {
        let reporters = outcome.duty_reports.iter().map(|r| r.device);
        let unable_to_transmit = outcome.duty_failures.iter().map(|f| f.device);
        let woken = outcome.wake_ups.iter().map(|(device, _)| *device);
        for device in reporters.chain(unable_to_transmit).chain(woken) {
            activity_counts[device.index()] += 1;
        }
    });
    let mut ids: Vec<DeviceId> = (0..scenario.run.devices).map(DeviceId).collect();
    // A stable sort: of equally busy devices the lower numbers come first.
    ids.sort_by_key(|id| std::cmp::Reverse(activity_counts[id.index()]));
    ids.truncate(DEFAULT_DEVICES);
    ids.sort_unstable();
    ids
}

fn device_histories(
    scenario: &Scenario,
    shown: &[DeviceId],
    from: Tti,
    end: Tti,
) -> Vec<(DeviceId, EnergyModel, Vec<DeviceTti>)> {
    let deployment = reveille_common::deployment::Deployment::new(scenario);
    let empty_history = |id: &DeviceId| (*id, deployment.devices[id.index()].energy, Vec::new());
    let mut devices: Vec<(DeviceId, EnergyModel, Vec<DeviceTti>)> = shown.iter().map(empty_history).collect();
    for_each_tti(scenario, from, end, |walk, k, outcome| {
        for (id, _, history) in &mut devices {
            let (state, battery) = walk.state_and_battery(*id, k);
            let wake_up = outcome.wake_ups.iter().find(|(woken, _)| woken == id);
            let failed_after_wake_up = wake_up.is_some_and(|(_, outcome)| matches!(outcome, WakeOutcome::Failed(_)));
            history.push(DeviceTti {
                tti: k,
                state,
                could_not_transmit: failed_after_wake_up || outcome.duty_failures.iter().any(|f| f.device == *id),
                has_wake_up: wake_up.is_some(),
                battery,
            });
        }
    });
    devices
}

/// Returns the file name, without extension, of the figure.
pub fn file_name(scenario: &Scenario, timeline: &Timeline) -> String {
    let (policy, from) = (scenario.policy.name(), timeline.from);
    format!(
        "timeline-{policy}-n{}-s{}-k{from}",
        scenario.run.devices, scenario.run.seed
    )
}

/// Draws `timeline`, which was collected from `scenario`.
pub fn scene(scenario: &Scenario, timeline: &Timeline) -> Scene {
    let mut scene = Scene::new(PAGE_WIDTH, 0.0);
    scene.title = format!(
        "Battery and states of {}: {}",
        count_noun(timeline.devices.len() as u64, "device"),
        run_name(scenario)
    );
    scene.text(Text::new(scene.title.clone(), (MARGIN, MARGIN + TITLE_SIZE), TITLE_SIZE).bold());
    let axis = TtiAxis {
        from: timeline.from.0 as f64,
        ttis: (timeline.end - timeline.from) as f64,
    };
    let top = MARGIN + TITLE_SIZE + LEADING + 4.0;
    draw_legend(&mut scene, top);
    let top = top + 8.0;
    // A line above each device names its class, if there are several.
    let classes = (scenario.classes.len() > 1).then(|| assign_classes(scenario));
    let class_line_height = if classes.is_some() { LEADING } else { 0.0 };
    let device_height = class_line_height + BATTERY_HEIGHT + 4.0 * LANE_HEIGHT + DEVICE_GAP;
    let bottom = top + device_height * timeline.devices.len() as f64 - DEVICE_GAP;
    for (i, (id, energy, history)) in timeline.devices.iter().enumerate() {
        let top = top + device_height * i as f64 + class_line_height;
        // Events stop short of the class line of the next device.
        let events_bottom = bottom.min(top + device_height - class_line_height);
        axis.draw_events(&mut scene, &timeline.events, top, events_bottom);
        if let Some(classes) = &classes {
            let class = &scenario.classes[usize::from(classes[id.index()])];
            let text = class_line(&class.name, energy);
            scene.text(Text::new(text, (PLOT_LEFT, top - 3.0), TEXT_SIZE));
        }
        axis.draw_battery(&mut scene, *id, energy, history, top);
        axis.draw_states(&mut scene, history, top + BATTERY_HEIGHT);
    }
    axis.draw_ticks(&mut scene, bottom);
    let mut y = bottom + 3.0 * LEADING + 10.0;
    scene.description = caption(scenario, timeline);
    for line in wrap_text(
        &scene.description.clone(),
        Weight::Regular,
        TEXT_SIZE,
        PAGE_WIDTH - 2.0 * MARGIN,
    ) {
        scene.text(Text::new(line, (MARGIN, y), TEXT_SIZE));
        y += LEADING;
    }
    scene.height = (y - LEADING + 0.24 * TEXT_SIZE + MARGIN).ceil();
    scene
}

/// Describes the class of a device in one line.
fn class_line(name: &str, energy: &EnergyModel) -> String {
    let [e_max, e_idle, e_wur, e_tx] =
        [energy.e_max, energy.e_idle, energy.e_wur, energy.e_tx].map(|energy| format_significant(energy.units(), 3));
    format!("class {name}: E_max {e_max}, E_idle {e_idle}, E_WuR {e_wur}, E_Tx {e_tx} units")
}

fn draw_legend(scene: &mut Scene, y: f64) {
    let mut x = MARGIN;
    let middle = y - 0.35 * TEXT_SIZE;
    let mut entry = |scene: &mut Scene, text: &str, draw: &dyn Fn(&mut Scene, f64)| {
        draw(scene, x);
        scene.text(Text::new(text, (x + 13.0, y), TEXT_SIZE));
        x += 13.0 + super::font::text_width(text, Weight::Regular, TEXT_SIZE) + 11.0;
    };
    entry(scene, "event", &|scene, x| {
        let span = [x, middle - 4.0, x + 10.0, middle + 4.0];
        scene.area(VectorPath::rectangle(span), Paint::Colour(ORANGE), 0.35);
    });
    entry(scene, "event, no report", &|scene, x| {
        let span = [x, middle - 4.0, x + 10.0, middle + 4.0];
        scene.area(VectorPath::rectangle(span), Paint::Ink, 0.25);
    });
    entry(scene, "battery", &|scene, x| {
        let line = VectorPath::segment((x, middle), (x + 10.0, middle));
        scene.line(line, Stroke::solid(Paint::Colour(BLUE), 1.2));
    });
    entry(scene, "E_Tx", &|scene, x| {
        scene.line(VectorPath::segment((x, middle), (x + 10.0, middle)), threshold_stroke());
    });
    entry(scene, "wake-up", &|scene, x| draw_arrow(scene, x + 5.0, middle + 4.0));
    entry(scene, "S2 without the energy for a report", &|scene, x| {
        draw_cross(scene, x + 5.0, middle);
    });
    entry(scene, "no power", &|scene, x| {
        let span = [x, middle - 3.0, x + 10.0, middle + 3.0];
        scene.outlined_area(
            VectorPath::rectangle(span),
            Paint::Paper,
            Stroke::solid(Paint::Ink, 0.5),
        );
    });
}

/// The x axis of all plots.
struct TtiAxis {
    /// First TTI.
    from: f64,
    /// Number of TTIs.
    ttis: f64,
}

impl TtiAxis {
    /// Returns the x position of the start of TTI `k`.
    fn x(&self, k: f64) -> f64 {
        PLOT_LEFT + ((k - self.from) / self.ttis).clamp(0.0, 1.0) * (PLOT_RIGHT - PLOT_LEFT)
    }

    fn draw_events(&self, scene: &mut Scene, events: &[EventRecord], top: f64, bottom: f64) {
        for event in events {
            let (from, to) = (self.x(event.start.0 as f64), self.x(event.last.0 as f64 + 1.0));
            let (paint, opacity) = if event.tally.reports > 0 {
                (Paint::Colour(ORANGE), 0.35)
            } else {
                (Paint::Ink, 0.25)
            };
            scene.area(VectorPath::rectangle([from, top, to, bottom]), paint, opacity);
        }
    }

    fn draw_battery(&self, scene: &mut Scene, id: DeviceId, energy: &EnergyModel, history: &[DeviceTti], top: f64) {
        let bottom = top + BATTERY_HEIGHT - 4.0;
        let scale = Scale::Linear {
            from: 0.0,
            to: energy.e_max.units(),
        };
        let y = |units: f64| bottom - scale.position(units) * (bottom - top - 4.0);
        let frame = [(PLOT_LEFT, top), (PLOT_LEFT, bottom), (PLOT_RIGHT, bottom)];
        scene.line(VectorPath::open_line(frame), Stroke::solid(Paint::Ink, 0.7));
        for value in [0.0, 0.5 * energy.e_max.units(), energy.e_max.units()] {
            let at = (PLOT_LEFT - 4.0, y(value) + 0.36 * TEXT_SIZE);
            scene.text(Text::new(format_significant(value, 3), at, TEXT_SIZE).anchored(Anchor::End));
            let tick = VectorPath::segment((PLOT_LEFT - 2.5, y(value)), (PLOT_LEFT, y(value)));
            scene.line(tick, Stroke::solid(Paint::Ink, 0.7));
        }
        let e_tx = y(energy.e_tx.units());
        scene.line(
            VectorPath::segment((PLOT_LEFT, e_tx), (PLOT_RIGHT, e_tx)),
            threshold_stroke(),
        );
        let steps = history.iter().flat_map(|entry| {
            let (k, level) = (entry.tti.0 as f64, y(entry.battery.units()));
            [(self.x(k), level), (self.x(k + 1.0), level)]
        });
        scene.line(VectorPath::open_line(steps), Stroke::solid(Paint::Colour(BLUE), 1.1));
        let mut label = Text::new(
            format!("device {id}"),
            (MARGIN + 0.76 * TEXT_SIZE, 0.5 * (top + bottom)),
            TEXT_SIZE,
        );
        label.is_vertical = true;
        scene.text(label.anchored(Anchor::Middle));
        let mut unit = Text::new("units", (MARGIN + 1.9 * TEXT_SIZE, 0.5 * (top + bottom)), TEXT_SIZE);
        unit.is_vertical = true;
        scene.text(unit.anchored(Anchor::Middle));
    }

    /// Draws four lanes, from S1 at the top to S4.
    fn draw_states(&self, scene: &mut Scene, history: &[DeviceTti], top: f64) {
        for (lane, name) in ["S1", "S2", "S3", "S4"].iter().enumerate() {
            let y = top + LANE_HEIGHT * (lane as f64 + 1.0) - 1.5;
            scene.text(Text::new(*name, (PLOT_LEFT - 4.0, y), TEXT_SIZE).anchored(Anchor::End));
            let line = VectorPath::segment((PLOT_LEFT, y + 1.5), (PLOT_RIGHT, y + 1.5));
            scene.line(line, Stroke::solid(Paint::Ink, 0.4).with_opacity(0.3));
        }
        // Equal neighbours become one block.
        for block in history.chunk_by(|a, b| a.state == b.state && !a.could_not_transmit && !b.could_not_transmit) {
            let (first, last) = (block[0], block[block.len() - 1]);
            let (from, to) = (self.x(first.tti.0 as f64), self.x(last.tti.0 as f64 + 1.0));
            let lane = |lane: f64| {
                VectorPath::rectangle([
                    from,
                    top + LANE_HEIGHT * lane + 1.0,
                    to,
                    top + LANE_HEIGHT * (lane + 1.0) - 1.0,
                ])
            };
            match first.state {
                DeviceState::Idle => scene.area(lane(0.0), Paint::Colour(BLUE), 1.0),
                DeviceState::Active => scene.area(lane(1.0), Paint::Colour(ORANGE), 1.0),
                DeviceState::Transmission => {
                    scene.area(lane(1.0), Paint::Colour(ORANGE), 1.0);
                    scene.area(lane(2.0), Paint::Colour(VERMILION), 1.0);
                }
                DeviceState::Sleep { powered: true } => scene.area(lane(3.0), Paint::Ink, 0.45),
                DeviceState::Sleep { powered: false } | DeviceState::Failed => {
                    scene.outlined_area(lane(3.0), Paint::Paper, Stroke::solid(Paint::Ink, 0.5));
                }
            }
        }
        for entry in history {
            let middle = self.x(entry.tti.0 as f64 + 0.5);
            if entry.could_not_transmit {
                draw_cross(scene, middle, top + 1.5 * LANE_HEIGHT);
            }
            if entry.has_wake_up {
                draw_arrow(scene, middle, top + 4.0 * LANE_HEIGHT + 5.5);
            }
        }
    }

    fn draw_ticks(&self, scene: &mut Scene, bottom: f64) {
        let y = bottom + 7.0;
        scene.line(
            VectorPath::segment((PLOT_LEFT, y), (PLOT_RIGHT, y)),
            Stroke::solid(Paint::Ink, 0.7),
        );
        let scale = Scale::linear([self.from, self.from + self.ttis], false);
        for tick in scale.ticks() {
            if tick.value < self.from || tick.value > self.from + self.ttis {
                continue;
            }
            let x = self.x(tick.value);
            scene.line(
                VectorPath::segment((x, y), (x, y + 2.5)),
                Stroke::solid(Paint::Ink, 0.7),
            );
            // A label at the very end would extend beyond the page.
            let at = x.min(PLOT_RIGHT - 4.0);
            scene.text(Text::new(tick.label, (at, y + LEADING), TEXT_SIZE).anchored(Anchor::Middle));
        }
        let middle = (0.5 * (PLOT_LEFT + PLOT_RIGHT), y + 2.0 * LEADING);
        scene.text(Text::new("TTI k", middle, TEXT_SIZE).anchored(Anchor::Middle));
    }
}

/// Returns the stroke of the line at E_Tx.
const fn threshold_stroke() -> Stroke {
    Stroke::solid(Paint::Colour(VERMILION), 0.8).dashed(&[3.0, 2.0])
}

/// Draws the mark of a wake-up: a small arrowhead that points up, with its tip at `y - 5`.
fn draw_arrow(scene: &mut Scene, x: f64, y: f64) {
    let arrowhead = VectorPath::closed_line([(x, y - 5.0), (x + 2.4, y), (x - 2.4, y)]);
    scene.area(arrowhead, Paint::Colour(GREEN), 1.0);
}

/// Draws the mark of a device that could not transmit.
fn draw_cross(scene: &mut Scene, x: f64, y: f64) {
    let mut cross = VectorPath::segment((x - 2.5, y - 2.5), (x + 2.5, y + 2.5));
    cross.extend(VectorPath::segment((x - 2.5, y + 2.5), (x + 2.5, y - 2.5)));
    scene.line(cross, Stroke::solid(Paint::Ink, 1.1));
}

fn caption(scenario: &Scenario, timeline: &Timeline) -> String {
    let unreported = timeline.events.iter().filter(|e| e.tally.reports == 0).count();
    format!(
        "Battery at the end of each TTI and states S1 (idle: sensing), S2 (active), S3 (transmission), S4 (sleep). A \
         device that reports goes through S2 and S3 within its TTI. {}, {unreported} of them without a report. {} \
         Seed {}, K = {}.",
        count_noun(timeline.events.len() as u64, "event"),
        policy_sentence(scenario),
        scenario.run.seed,
        scenario.run.ttis
    )
}
