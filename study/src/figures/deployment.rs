//! Deployment figure: the area with the devices' Voronoi cells and clusters, and one event with the devices involved in
//! the TTI in which it closed. A role needs an arm in `draw_role` and an entry in `draw_legend`. [`file_name`] names
//! the files of `reveille figures deployment` and the picture in Python.

use libm::{cos, sin};
use reveille_bs::beliefs::ranking::i_min;
use reveille_bs::scenario::Scenario;
use reveille_common::deployment::Deployment;
use reveille_common::digits::format_significant;
use reveille_common::event::EventRecord;
use reveille_common::geometry::{Point, voronoi_cells};
use reveille_common::ids::DeviceId;
use reveille_common::message::WakeOutcome;
use reveille_common::scenario::assign_classes;
use reveille_common::state::DeviceState;

use super::area_plot::{AreaPlot, Legend, draw_caption, draw_title};
use super::cell_map::{self, assign_tints};
use super::error::FigureError;
use super::font::{Weight, text_width, wrap_text};
use super::path::VectorPath;
use super::run_walk::{RunWalk, TtiOutcome, collect_events};
use super::scene::{Anchor, Paint, Rgb, Scene, Stroke, Text};
use super::style::{BLUE, COLUMN_WIDTH, GREEN, GREY, LEADING, MARGIN, ORANGE, PURPLE, SKY, TEXT_SIZE, VERMILION};

/// Largest number of devices in a figure.
pub(crate) const MAX_DEVICES: u32 = 1000;

/// Background colours of clusters: pale, so that markers stand out.
const TINTS: [Rgb; 6] = [
    Rgb(0xD6, 0xE6, 0xF2),
    Rgb(0xFB, 0xEC, 0xCC),
    Rgb(0xD2, 0xEE, 0xE4),
    Rgb(0xF3, 0xE0, 0xEA),
    Rgb(0xEC, 0xEC, 0xEC),
    Rgb(0xF8, 0xF6, 0xCF),
];

/// Rings of device classes: colour and dashes. The most frequent class has none; classes beyond the last ring share it.
const CLASS_RINGS: [(Rgb, &[f64]); 5] = [
    (PURPLE, &[]),
    (ORANGE, &[2.5, 1.5]),
    (SKY, &[]),
    (GREY, &[1.0, 1.2]),
    (VERMILION, &[4.0, 1.2]),
];

/// Role of a device in the TTI shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DeviceRole {
    /// In S1, and reported.
    Reporter,
    /// Woken, and reported; with the number of its wake-up.
    Woken(u32),
    /// In S1 or woken, but could not pay E_Tx.
    LackedEnergy,
    /// Woken, but no report arrived: unpowered, not asleep, awake too late, or the wake-up or report was lost.
    NoReport,
    /// In S1 without an event to report.
    Sensing,
    /// In S4.
    Asleep,
    /// Without power.
    WithoutPower,
}

/// One event and the devices around it.
#[derive(Clone, Debug)]
pub struct EventScene {
    /// The event.
    pub event: EventRecord,
    /// Positions of the devices, metres.
    pub positions: Vec<Point>,
    /// Role of each device in the event's last TTI.
    pub roles: Vec<DeviceRole>,
    /// Cluster of each device, if the policy has clusters.
    pub clusters: Option<Vec<u32>>,
    /// Threshold I_min of the deployment.
    pub i_min: f64,
    /// Number of wake-ups sent in that TTI.
    pub wake_up_count: usize,
}

impl EventScene {
    /// Runs `scenario` up to the TTI in which its event `event` closes. The default is the first event after the
    /// warm-up with several reports and a wake-up. Failing that, it is the first event after the warm-up with a report,
    /// or else the first event. `python/reveille/figures.py` describes this choice to users.
    ///
    /// # Errors
    /// There are more than `MAX_DEVICES` devices, or the event does not exist.
    pub fn from_scenario(scenario: &Scenario, event: Option<u64>) -> Result<Self, FigureError> {
        if scenario.run.devices > MAX_DEVICES {
            return Err(FigureError::TooManyDevices {
                count: scenario.run.devices,
                figure: "a deployment picture",
                limit: MAX_DEVICES,
                advice: "give fewer with --devices",
            });
        }
        let events = collect_events(scenario);
        let counted_events = || events.iter().filter(|e| e.counted);
        let chosen = match event {
            Some(event) => events.iter().find(|e| e.event.0 == event),
            None => counted_events()
                .find(|e| e.tally.reports > 1 && e.tally.wake_ups > 0)
                .or_else(|| counted_events().find(|e| e.tally.reports > 0))
                .or_else(|| events.first()),
        };
        let Some(chosen) = chosen else {
            let ttis = scenario.run.ttis;
            return Err(match event {
                Some(event) if !events.is_empty() => FigureError::UnknownEvent {
                    event,
                    count: events.len(),
                    ttis,
                },
                _ => FigureError::NoEvent { ttis },
            });
        };
        let mut walk = RunWalk::new(scenario);
        let outcome = walk.run_through(chosen.last);
        let positions = Deployment::new(scenario).positions();
        let devices = (0..scenario.run.devices).map(DeviceId);
        let roles = devices.map(|j| role_of(j, &outcome, walk.state_and_battery(j, chosen.last).0));
        Ok(Self {
            event: *chosen,
            roles: roles.collect(),
            clusters: walk.groups().map(<[u32]>::to_vec),
            i_min: i_min(&positions, scenario.area, &scenario.sensing),
            positions,
            wake_up_count: outcome.wake_ups.len(),
        })
    }
}

/// Returns the role of `device`, whose state at the end of the TTI is `state`.
fn role_of(device: DeviceId, outcome: &TtiOutcome, state: DeviceState) -> DeviceRole {
    // Wake-ups first: a woken device that has reported also ends its TTI in S3.
    let wake_up = (1..).zip(&outcome.wake_ups).find(|(_, (woken, _))| *woken == device);
    match wake_up {
        Some((number, (_, WakeOutcome::Reported(_)))) => return DeviceRole::Woken(number),
        Some((_, (_, WakeOutcome::Failed(_)))) => return DeviceRole::LackedEnergy,
        Some((_, (_, WakeOutcome::Missed | WakeOutcome::Late { .. } | WakeOutcome::Lost(_)))) => {
            return DeviceRole::NoReport;
        }
        None => {}
    }
    if outcome.duty_failures.iter().any(|f| f.device == device) {
        return DeviceRole::LackedEnergy;
    }
    match state {
        DeviceState::Transmission => DeviceRole::Reporter,
        DeviceState::Idle | DeviceState::Active => DeviceRole::Sensing,
        DeviceState::Sleep { powered: true } => DeviceRole::Asleep,
        DeviceState::Sleep { powered: false } | DeviceState::Failed => DeviceRole::WithoutPower,
    }
}

/// Returns the file name, without extension, of the figure.
pub fn file_name(scenario: &Scenario, event_scene: &EventScene) -> String {
    let (policy, event) = (scenario.policy.name(), event_scene.event.event.0);
    format!(
        "deployment-{policy}-n{}-s{}-e{event}",
        scenario.run.devices, scenario.run.seed
    )
}

/// Draws `event_scene`.
pub fn scene(scenario: &Scenario, event_scene: &EventScene) -> Scene {
    let mut scene = Scene::new(COLUMN_WIDTH, 0.0);
    scene.title = format!(
        "Event {}, policy {}, N = {}",
        event_scene.event.event.0,
        scenario.policy.name(),
        scenario.run.devices
    );
    let mut y = draw_title(&mut scene);
    let plot = AreaPlot::new(scenario.area, y - 2.0);
    plot.draw_cells(&mut scene, event_scene);
    plot.draw_axes(&mut scene);
    plot.draw_event(&mut scene, event_scene, scenario.sensing.d_max);
    let classes = ClassMarks::new(scenario);
    plot.draw_class_rings(&mut scene, event_scene, &classes);
    plot.draw_devices(&mut scene, event_scene);
    y = draw_legend(&mut scene, event_scene, plot.bottom() + 2.0 * LEADING + 15.0);
    y = classes.draw_legend(&mut scene, y);
    scene.description = caption(scenario, event_scene);
    draw_caption(&mut scene, y);
    scene
}

impl AreaPlot {
    fn draw_cells(&self, scene: &mut Scene, event_scene: &EventScene) {
        let cells = voronoi_cells(&event_scene.positions, self.area);
        let border = Stroke::solid(Paint::Ink, 0.5).with_opacity(0.3);
        if let Some(cluster_of) = &event_scene.clusters {
            let tints = assign_tints(
                &cell_map::adjacent_devices(&event_scene.positions, &cells),
                cluster_of,
                TINTS.len(),
            );
            for (cell, cluster) in cells.iter().zip(cluster_of) {
                let tint = TINTS[tints[*cluster as usize]];
                let corners = cell.iter().map(|p| self.to_canvas(*p));
                scene.area(VectorPath::closed_line(corners), Paint::Colour(tint), 1.0);
            }
        }
        for cell in &cells {
            scene.line(VectorPath::closed_line(cell.iter().map(|p| self.to_canvas(*p))), border);
        }
        if let Some(cluster_of) = &event_scene.clusters {
            for (from, to) in cell_map::cluster_borders(&event_scene.positions, &cells, cluster_of) {
                let line = VectorPath::segment(self.to_canvas(from), self.to_canvas(to));
                scene.line(line, Stroke::solid(Paint::Ink, 1.1).with_opacity(0.75));
            }
        }
    }

    /// Draws the epicentre, and the part of the circle of radius d_max around it that lies in the area.
    fn draw_event(&self, scene: &mut Scene, event_scene: &EventScene, d_max: f64) {
        let centre = event_scene.event.epicentre;
        let stroke = Stroke::solid(Paint::Colour(VERMILION), 1.2).dashed(&[4.0, 2.0]);
        let mut arc: Vec<(f64, f64)> = Vec::new();
        for i in 0..=360 {
            let angle = f64::from(i).to_radians();
            let p = Point::new(centre.x + d_max * cos(angle), centre.y + d_max * sin(angle));
            if self.area.contains(p) {
                arc.push(self.to_canvas(p));
            } else if !arc.is_empty() {
                // The circle leaves the area here, so the next point inside begins another arc.
                scene.line(VectorPath::open_line(std::mem::take(&mut arc)), stroke);
            }
        }
        if !arc.is_empty() {
            scene.line(VectorPath::open_line(arc), stroke);
        }
        draw_star(scene, self.to_canvas(centre));
    }

    fn draw_class_rings(&self, scene: &mut Scene, event_scene: &EventScene, classes: &ClassMarks) {
        for (p, class) in event_scene.positions.iter().zip(&classes.class_of) {
            if let Some(ring) = classes.ring(*class) {
                scene.line(VectorPath::circle(self.to_canvas(*p), RING_RADIUS), ring);
            }
        }
    }

    fn draw_devices(&self, scene: &mut Scene, event_scene: &EventScene) {
        for (p, role) in event_scene.positions.iter().zip(&event_scene.roles) {
            draw_role(scene, *role, self.to_canvas(*p));
        }
        for (p, role) in event_scene.positions.iter().zip(&event_scene.roles) {
            if let DeviceRole::Woken(number) = role {
                let (x, y) = self.to_canvas(*p);
                let text = number.to_string();
                // On the right, unless the text would extend beyond the area.
                let room = text_width(&text, Weight::Bold, TEXT_SIZE) + 6.0;
                let is_on_right = x + room < self.left + self.area.width * self.points_per_metre;
                let (x, anchor) = if is_on_right {
                    (x + 4.0, Anchor::Start)
                } else {
                    (x - 4.0, Anchor::End)
                };
                let y = (y - 2.0).max(self.top + 0.8 * TEXT_SIZE);
                scene.text(Text::new(text, (x, y), TEXT_SIZE).bold().anchored(anchor));
            }
        }
    }
}

/// Radius of a class ring, points: larger than any device symbol.
const RING_RADIUS: f64 = 5.2;

/// The marks of device classes; empty if there is only one.
struct ClassMarks {
    /// Class of each device.
    class_of: Vec<u16>,
    /// Index, name and number of devices of each class that has devices, the most frequent first.
    ranked: Vec<(u16, String, usize)>,
}

impl ClassMarks {
    fn new(scenario: &Scenario) -> Self {
        if scenario.classes.len() < 2 {
            return Self {
                class_of: Vec::new(),
                ranked: Vec::new(),
            };
        }
        let class_of = assign_classes(scenario);
        let with_counts = (0_u16..).zip(&scenario.classes).map(|(index, class)| {
            let devices = class_of.iter().filter(|assigned| **assigned == index).count();
            (index, class.name.clone(), devices)
        });
        let mut ranked: Vec<(u16, String, usize)> = with_counts.filter(|(_, _, devices)| *devices > 0).collect();
        // A stable sort: of equally frequent classes the first in the scenario has no ring.
        ranked.sort_by_key(|(_, _, devices)| std::cmp::Reverse(*devices));
        Self { class_of, ranked }
    }

    /// The ring of `class`; `None` for the most frequent class.
    fn ring(&self, class: u16) -> Option<Stroke> {
        let rank = self.ranked.iter().position(|(index, ..)| *index == class)?;
        let (colour, dashes) = CLASS_RINGS[rank.checked_sub(1)?.min(CLASS_RINGS.len() - 1)];
        Some(Stroke::solid(Paint::Colour(colour), 1.3).dashed(dashes))
    }

    /// Draws a legend entry for each class, the first with the base line `y`. Returns the base line of the text below.
    fn draw_legend(&self, scene: &mut Scene, mut y: f64) -> f64 {
        for (index, name, devices) in &self.ranked {
            let mut text = format!("class {name} ({devices})");
            if let Some(ring) = self.ring(*index) {
                scene.line(
                    VectorPath::circle((MARGIN + 6.0, y - 0.35 * TEXT_SIZE), RING_RADIUS),
                    ring,
                );
            } else {
                text.push_str(", without a ring");
            }
            for line in wrap_text(&text, Weight::Regular, TEXT_SIZE, COLUMN_WIDTH - 2.0 * MARGIN - 14.0) {
                scene.text(Text::new(line, (MARGIN + 14.0, y), TEXT_SIZE));
                y += LEADING + 2.0;
            }
        }
        y + if self.ranked.is_empty() { 0.0 } else { 3.0 }
    }
}

pub(super) fn draw_star(scene: &mut Scene, at: (f64, f64)) {
    let star = VectorPath::polygon(at, 6.0, 8, 0.0, 0.4);
    let border = Stroke::solid(Paint::Ink, 0.6);
    scene.outlined_area(star, Paint::Colour(VERMILION), border);
}

fn draw_cross(scene: &mut Scene, (x, y): (f64, f64), size: f64, stroke: Stroke) {
    let mut path = VectorPath::segment((x - size, y - size), (x + size, y + size));
    path.extend(VectorPath::segment((x - size, y + size), (x + size, y - size)));
    scene.line(path, stroke);
}

fn draw_role(scene: &mut Scene, role: DeviceRole, at: (f64, f64)) {
    let (x, y) = at;
    let border = Stroke::solid(Paint::Ink, 0.5);
    match role {
        DeviceRole::Reporter => scene.outlined_area(VectorPath::circle(at, 3.4), Paint::Colour(BLUE), border),
        DeviceRole::Woken(_) => {
            let square = VectorPath::rectangle([x - 2.8, y - 2.8, x + 2.8, y + 2.8]);
            scene.outlined_area(square, Paint::Colour(GREEN), border);
        }
        DeviceRole::LackedEnergy => draw_cross(scene, at, 3.0, Stroke::solid(Paint::Colour(VERMILION), 1.6)),
        DeviceRole::NoReport => {
            let square = VectorPath::rectangle([x - 2.6, y - 2.6, x + 2.6, y + 2.6]);
            scene.outlined_area(square, Paint::Paper, Stroke::solid(Paint::Ink, 0.8));
            draw_cross(scene, at, 2.6, Stroke::solid(Paint::Ink, 0.8));
        }
        DeviceRole::Sensing => scene.outlined_area(
            VectorPath::circle(at, 2.8),
            Paint::Paper,
            Stroke::solid(Paint::Colour(BLUE), 1.2),
        ),
        DeviceRole::Asleep => scene.area(VectorPath::circle(at, 1.5), Paint::Ink, 1.0),
        DeviceRole::WithoutPower => draw_cross(scene, at, 1.7, Stroke::solid(Paint::Ink, 0.8)),
    }
}

/// Draws the roles in the figure, with the number of devices in each. Returns the base line of the text below.
fn draw_legend(scene: &mut Scene, event_scene: &EventScene, y: f64) -> f64 {
    let count_roles =
        |has_role: fn(&DeviceRole) -> bool| event_scene.roles.iter().filter(|role| has_role(role)).count();
    let entries = [
        (
            DeviceRole::Reporter,
            "S1, reported",
            count_roles(|r| matches!(r, DeviceRole::Reporter)),
        ),
        (
            DeviceRole::Woken(1),
            "woken, reported",
            count_roles(|r| matches!(r, DeviceRole::Woken(_))),
        ),
        (
            DeviceRole::LackedEnergy,
            "lacked E_Tx",
            count_roles(|r| matches!(r, DeviceRole::LackedEnergy)),
        ),
        (
            DeviceRole::NoReport,
            "woken, no report",
            count_roles(|r| matches!(r, DeviceRole::NoReport)),
        ),
        (
            DeviceRole::Sensing,
            "S1, nothing to report",
            count_roles(|r| matches!(r, DeviceRole::Sensing)),
        ),
        (
            DeviceRole::Asleep,
            "S4, asleep",
            count_roles(|r| matches!(r, DeviceRole::Asleep)),
        ),
        (
            DeviceRole::WithoutPower,
            "no power",
            count_roles(|r| matches!(r, DeviceRole::WithoutPower)),
        ),
    ];
    let mut legend = Legend::new(y);
    let at = legend.place(scene, "event, with d_max");
    draw_star(scene, at);
    for (role, text, count) in entries.into_iter().filter(|(_, _, count)| *count > 0) {
        let at = legend.place(scene, &format!("{text} ({count})"));
        draw_role(scene, role, at);
    }
    legend.next_base_line()
}

fn caption(scenario: &Scenario, event_scene: &EventScene) -> String {
    let EventRecord { start, last, tally, .. } = event_scene.event;
    let cells = event_scene.clusters.as_ref().map_or_else(
        || "Cells are the devices' Voronoi cells.".to_owned(),
        |cluster_of| {
            let count = cluster_of.iter().max().map_or(0, |largest| largest + 1);
            format!("Cells are the devices' Voronoi cells, tinted by their {count} clusters.")
        },
    );
    let [information, i_min] = [tally.information(), event_scene.i_min].map(|x| format_significant(x, 3));
    let wake_ups = match event_scene.wake_up_count {
        0 => "no wake-up".to_owned(),
        1 => "one wake-up (numbered if it led to a report)".to_owned(),
        many => format!("{many} wake-ups (numbered if they led to a report)"),
    };
    format!(
        "{cells} The event began in TTI {start} and ended in TTI {last}, which is shown. The BS sent {wake_ups} and \
         got information {information}; I_min of the deployment is {i_min}. Preset {}, seed {}.",
        scenario.run.preset, scenario.run.seed
    )
}
