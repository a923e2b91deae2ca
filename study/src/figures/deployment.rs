//! Deployment figure: the area with the devices' Voronoi cells and clusters, and one event with the devices involved in
//! the TTI in which it closed.

use libm::{cos, sin};
use reveille_bs::beliefs::ranking::i_min;
use reveille_bs::scenario::Scenario;
use reveille_common::deployment::Deployment;
use reveille_common::event::EventRecord;
use reveille_common::geometry::{Point, cells};
use reveille_common::ids::DeviceId;
use reveille_common::message::WakeOutcome;
use reveille_common::state::DeviceState;

use super::area_plot::AreaPlot;
use super::cell_map::{self, tints};
use super::error::FigureError;
use super::font::{Weight, width, wrap};
use super::path::VectorPath;
use super::run_walk::{RunWalk, TtiOutcome, events};
use super::scene::{Anchor, Paint, Rgb, Scene, Stroke, Text};
use super::style::{BLUE, COLUMN, EDGE, GREEN, LARGE, LEADING, SMALL, VERMILION};

/// Largest number of devices in a figure.
pub(crate) const CROWD: u32 = 1000;

/// Background colours of clusters: pale, so that markers stand out.
const TINTS: [Rgb; 6] = [
    Rgb(0xD6, 0xE6, 0xF2),
    Rgb(0xFB, 0xEC, 0xCC),
    Rgb(0xD2, 0xEE, 0xE4),
    Rgb(0xF3, 0xE0, 0xEA),
    Rgb(0xEC, 0xEC, 0xEC),
    Rgb(0xF8, 0xF6, 0xCF),
];

/// Role of a device in the TTI shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DeviceRole {
    /// In S1, and reported.
    Reporter,
    /// Woken, and reported; with the number of its wake-up.
    Woken(u32),
    /// In S1 or woken, but could not pay E_Tx.
    Failed,
    /// Woken, but no report arrived: unpowered, not asleep, or the wake-up or report was lost.
    Unpowered,
    /// In S1 without an event to report.
    Sensing,
    /// In S4.
    Asleep,
    /// Without power.
    Empty,
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
    /// Number of wake-ups sent.
    pub wake_ups: usize,
}

impl EventScene {
    /// Finds the TTI in which event `event` of `scenario` closes. The default is the first event after the warm-up with
    /// several reports and a wake-up. Failing that, it is the first reported event, or else the first event.
    ///
    /// # Errors
    /// There are more than `CROWD` devices, or the event does not exist.
    pub fn from_scenario(scenario: &Scenario, event: Option<u64>) -> Result<Self, FigureError> {
        if scenario.run.devices > CROWD {
            return Err(FigureError::Crowd {
                count: scenario.run.devices,
                what: "a deployment picture",
                limit: CROWD,
                advice: "give fewer with --devices",
            });
        }
        let all = events(scenario);
        let counted = || all.iter().filter(|e| e.counted);
        let chosen = match event {
            Some(event) => all.iter().find(|e| e.event.0 == event),
            None => counted()
                .find(|e| e.tally.reports > 1 && e.tally.wake_ups > 0)
                .or_else(|| counted().find(|e| e.tally.reports > 0))
                .or_else(|| all.first()),
        };
        let Some(chosen) = chosen else {
            return Err(FigureError::NoEvent {
                event: event.unwrap_or(0),
                count: all.len(),
                ttis: scenario.run.ttis,
            });
        };
        let mut walk = RunWalk::new(scenario);
        let happened = walk.reach(chosen.last);
        let positions = Deployment::new(scenario).positions();
        let roles = (0..scenario.run.devices).map(DeviceId);
        let roles = roles.map(|j| role(j, &happened, walk.state(j, chosen.last).0));
        Ok(Self {
            event: *chosen,
            roles: roles.collect(),
            clusters: walk.groups().map(<[u32]>::to_vec),
            i_min: i_min(&positions, scenario.area, &scenario.sensing),
            positions,
            wake_ups: happened.woken.len(),
        })
    }
}

fn role(device: DeviceId, happened: &TtiOutcome, state: DeviceState) -> DeviceRole {
    // Wake-ups first: a woken device that has reported also ends its TTI in S3.
    let wake_up = (1..).zip(&happened.woken).find(|(_, (woken, _))| *woken == device);
    match wake_up {
        Some((number, (_, WakeOutcome::Reported(_)))) => return DeviceRole::Woken(number),
        Some((_, (_, WakeOutcome::Failed(_) | WakeOutcome::Late { .. }))) => return DeviceRole::Failed,
        Some((_, (_, WakeOutcome::Missed | WakeOutcome::Lost(_)))) => return DeviceRole::Unpowered,
        None => {}
    }
    if happened.failures.iter().any(|f| f.device == device) {
        return DeviceRole::Failed;
    }
    match state {
        DeviceState::Transmission => DeviceRole::Reporter,
        DeviceState::Idle | DeviceState::Active => DeviceRole::Sensing,
        DeviceState::Sleep { powered: true } => DeviceRole::Asleep,
        DeviceState::Sleep { powered: false } => DeviceRole::Empty,
    }
}

/// Returns the file name, without extension, of the figure.
pub fn name(scenario: &Scenario, moment: &EventScene) -> String {
    let (policy, event) = (scenario.policy.name(), moment.event.event.0);
    format!(
        "deployment-{policy}-n{}-s{}-e{event}",
        scenario.run.devices, scenario.run.seed
    )
}

/// Draws `moment`.
pub fn scene(scenario: &Scenario, moment: &EventScene) -> Scene {
    let mut scene = Scene::new(COLUMN, 0.0);
    scene.title = format!(
        "Event {}, policy {}, N = {}",
        moment.event.event.0,
        scenario.policy.name(),
        scenario.run.devices
    );
    let mut y = EDGE + LARGE;
    for line in wrap(&scene.title.clone(), Weight::Bold, LARGE, COLUMN - 2.0 * EDGE) {
        scene.text(Text::new(line, (EDGE, y), LARGE).bold());
        y += LEADING + 1.0;
    }
    let ground = AreaPlot::new(scenario.area, y - 2.0);
    ground.cells(&mut scene, moment);
    ground.axes(&mut scene);
    ground.event(&mut scene, moment, scenario.sensing.d_max);
    ground.devices(&mut scene, moment);
    y = legend(&mut scene, moment, ground.bottom() + 2.0 * LEADING + 15.0);
    scene.description = caption(scenario, moment);
    for line in wrap(&scene.description.clone(), Weight::Regular, SMALL, COLUMN - 2.0 * EDGE) {
        scene.text(Text::new(line, (EDGE, y), SMALL));
        y += LEADING;
    }
    scene.height = (y - LEADING + 0.24 * SMALL + EDGE).ceil();
    scene
}

impl AreaPlot {
    fn cells(&self, scene: &mut Scene, moment: &EventScene) {
        let cells = cells(&moment.positions, self.area);
        let border = Stroke::solid(Paint::Ink, 0.5).faded(0.3);
        if let Some(of) = &moment.clusters {
            let tints = tints(&cell_map::neighbours(&moment.positions, &cells), of, TINTS.len());
            for (cell, cluster) in cells.iter().zip(of) {
                let tint = TINTS[tints[*cluster as usize]];
                let corners = cell.iter().map(|p| self.at(*p));
                scene.area(VectorPath::polyline(corners, true), Paint::Colour(tint), 1.0);
            }
        }
        for cell in &cells {
            scene.line(VectorPath::polyline(cell.iter().map(|p| self.at(*p)), true), border);
        }
        if let Some(of) = &moment.clusters {
            for (from, to) in cell_map::borders(&moment.positions, &cells, of) {
                let line = VectorPath::segment(self.at(from), self.at(to));
                scene.line(line, Stroke::solid(Paint::Ink, 1.1).faded(0.75));
            }
        }
    }

    /// Draws the epicentre, and the part of the circle of radius d_max around it that lies in the area.
    fn event(&self, scene: &mut Scene, moment: &EventScene, d_max: f64) {
        let centre = moment.event.epicentre;
        let stroke = Stroke::solid(Paint::Colour(VERMILION), 1.2).dashed(&[4.0, 2.0]);
        let mut arc: Vec<(f64, f64)> = Vec::new();
        for i in 0..=360 {
            let angle = f64::from(i).to_radians();
            let p = Point::new(centre.x + d_max * cos(angle), centre.y + d_max * sin(angle));
            if self.area.contains(p) {
                arc.push(self.at(p));
            } else if !arc.is_empty() {
                // The circle leaves the area here, so the next point inside begins another arc.
                scene.line(VectorPath::polyline(std::mem::take(&mut arc), false), stroke);
            }
        }
        if !arc.is_empty() {
            scene.line(VectorPath::polyline(arc, false), stroke);
        }
        epicentre(scene, self.at(centre));
    }

    fn devices(&self, scene: &mut Scene, moment: &EventScene) {
        for (p, role) in moment.positions.iter().zip(&moment.roles) {
            draw_role(scene, *role, self.at(*p));
        }
        for (p, role) in moment.positions.iter().zip(&moment.roles) {
            if let DeviceRole::Woken(number) = role {
                let (x, y) = self.at(*p);
                let text = number.to_string();
                // On the right, unless the text would extend beyond the area.
                let room = width(&text, Weight::Bold, SMALL) + 6.0;
                let is_left = x + room < self.left + self.area.width * self.scale;
                let (x, anchor) = if is_left {
                    (x + 4.0, Anchor::Start)
                } else {
                    (x - 4.0, Anchor::End)
                };
                let y = (y - 2.0).max(self.top + 0.8 * SMALL);
                scene.text(Text::new(text, (x, y), SMALL).bold().anchored(anchor));
            }
        }
    }
}

pub(super) fn epicentre(scene: &mut Scene, at: (f64, f64)) {
    let star = VectorPath::polygon(at, 6.0, 8, 0.0, 0.4);
    let border = Stroke::solid(Paint::Ink, 0.6);
    scene.outlined(star, Paint::Colour(VERMILION), border);
}

fn cross(scene: &mut Scene, (x, y): (f64, f64), size: f64, stroke: Stroke) {
    let mut path = VectorPath::segment((x - size, y - size), (x + size, y + size));
    path.extend(VectorPath::segment((x - size, y + size), (x + size, y - size)));
    scene.line(path, stroke);
}

fn draw_role(scene: &mut Scene, role: DeviceRole, at: (f64, f64)) {
    let (x, y) = at;
    let border = Stroke::solid(Paint::Ink, 0.5);
    match role {
        DeviceRole::Reporter => scene.outlined(VectorPath::circle(at, 3.4), Paint::Colour(BLUE), border),
        DeviceRole::Woken(_) => {
            let square = VectorPath::rectangle([x - 2.8, y - 2.8, x + 2.8, y + 2.8]);
            scene.outlined(square, Paint::Colour(GREEN), border);
        }
        DeviceRole::Failed => cross(scene, at, 3.0, Stroke::solid(Paint::Colour(VERMILION), 1.6)),
        DeviceRole::Unpowered => {
            let square = VectorPath::rectangle([x - 2.6, y - 2.6, x + 2.6, y + 2.6]);
            scene.outlined(square, Paint::Paper, Stroke::solid(Paint::Ink, 0.8));
            cross(scene, at, 2.6, Stroke::solid(Paint::Ink, 0.8));
        }
        DeviceRole::Sensing => scene.outlined(
            VectorPath::circle(at, 2.8),
            Paint::Paper,
            Stroke::solid(Paint::Colour(BLUE), 1.2),
        ),
        DeviceRole::Asleep => scene.area(VectorPath::circle(at, 1.5), Paint::Ink, 1.0),
        DeviceRole::Empty => cross(scene, at, 1.7, Stroke::solid(Paint::Ink, 0.8)),
    }
}

/// Draws the roles in the figure, with the number of devices in each. Returns the base line of the text below.
fn legend(scene: &mut Scene, moment: &EventScene, mut y: f64) -> f64 {
    let count = |is: fn(&DeviceRole) -> bool| moment.roles.iter().filter(|role| is(role)).count();
    let entries = [
        (
            DeviceRole::Reporter,
            "S1, reported",
            count(|r| matches!(r, DeviceRole::Reporter)),
        ),
        (
            DeviceRole::Woken(1),
            "woken, reported",
            count(|r| matches!(r, DeviceRole::Woken(_))),
        ),
        (
            DeviceRole::Failed,
            "lacked E_Tx",
            count(|r| matches!(r, DeviceRole::Failed)),
        ),
        (
            DeviceRole::Unpowered,
            "woken, no report",
            count(|r| matches!(r, DeviceRole::Unpowered)),
        ),
        (
            DeviceRole::Sensing,
            "S1, nothing to report",
            count(|r| matches!(r, DeviceRole::Sensing)),
        ),
        (
            DeviceRole::Asleep,
            "S4, asleep",
            count(|r| matches!(r, DeviceRole::Asleep)),
        ),
        (DeviceRole::Empty, "no power", count(|r| matches!(r, DeviceRole::Empty))),
    ];
    let mut x = EDGE;
    let mut place = |scene: &mut Scene, text: String| {
        let needed = 14.0 + width(&text, Weight::Regular, SMALL);
        if x > EDGE && x + needed > COLUMN - EDGE {
            (x, y) = (EDGE, y + LEADING + 2.0);
        }
        scene.text(Text::new(text, (x + 14.0, y), SMALL));
        let at = (x + 6.0, y - 0.35 * SMALL);
        x += needed + 10.0;
        at
    };
    let at = place(scene, "event, with d_max".to_owned());
    epicentre(scene, at);
    for (role, text, count) in entries.into_iter().filter(|(_, _, count)| *count > 0) {
        let at = place(scene, format!("{text} ({count})"));
        draw_role(scene, role, at);
    }
    y + LEADING + 5.0
}

fn caption(scenario: &Scenario, moment: &EventScene) -> String {
    let EventRecord { start, last, tally, .. } = moment.event;
    let ground = moment.clusters.as_ref().map_or_else(
        || "Cells are the devices' Voronoi cells.".to_owned(),
        |of| {
            let count = of.iter().max().map_or(0, |last| last + 1);
            format!("Cells are the devices' Voronoi cells, tinted by their {count} clusters.")
        },
    );
    let information = tally.information();
    let wake_ups = match moment.wake_ups {
        0 => "no wake-up".to_owned(),
        1 => "one wake-up (numbered if it led to a report)".to_owned(),
        many => format!("{many} wake-ups (numbered if they led to a report)"),
    };
    format!(
        "{ground} The event began in TTI {start} and ended in TTI {last}, which is shown. The BS sent {wake_ups} and \
         got information {information:.3}; I_min of the deployment is {:.3}. Preset {}, seed {}.",
        moment.i_min, scenario.run.preset, scenario.run.seed
    )
}
