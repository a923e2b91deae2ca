//! The deployment picture: the area with the devices' Voronoi cells and clusters, and one event with all who had to do
//! with it in the TTI in which it closed.

use libm::{cos, sin};
use reveille_bs::beliefs::ranking::i_min;
use reveille_common::deployment::Deployment;
use reveille_common::event::EventRecord;
use reveille_common::geometry::{Point, cells};
use reveille_common::ids::DeviceId;
use reveille_common::message::WakeOutcome;
use reveille_common::scenario::Scenario;
use reveille_common::state::DeviceState;

use super::error::FigureError;
use super::font::{Weight, width, wrap};
use super::ground::Ground;
use super::layout::{COLUMN, EDGE, LARGE, LEADING, SMALL};
use super::map::{self, tints};
use super::path::Path;
use super::scene::{Anchor, Paint, Rgb, Scene, Stroke, Text};
use super::style::{BLUE, GREEN, VERMILION};
use super::witness::{Happened, Walk, events};

/// The most devices that a picture shows.
pub const CROWD: u32 = 1000;

/// Ground colours of clusters: pale, so that markers stand out.
const TINTS: [Rgb; 6] = [
    Rgb(0xD6, 0xE6, 0xF2),
    Rgb(0xFB, 0xEC, 0xCC),
    Rgb(0xD2, 0xEE, 0xE4),
    Rgb(0xF3, 0xE0, 0xEA),
    Rgb(0xEC, 0xEC, 0xEC),
    Rgb(0xF8, 0xF6, 0xCF),
];

/// What a device did in the TTI shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// In S1, and reported.
    Reporter,
    /// Woken, and reported; the number of its wake-up.
    Woken(u32),
    /// In S1 or woken, and could not pay E_Tx.
    Failed,
    /// Woken, and not heard of: its wake-up radio had no power, or it was not asleep.
    Deaf,
    /// In S1 without anything to report.
    Sensing,
    /// In S4.
    Asleep,
    /// Without power.
    Empty,
}

/// One event and the devices around it.
#[derive(Clone, Debug)]
pub struct Moment {
    /// The event.
    pub event: EventRecord,
    /// The devices' positions, metres.
    pub positions: Vec<Point>,
    /// What each device did in the event's last TTI.
    pub roles: Vec<Role>,
    /// The cluster of each device, where the policy has clusters.
    pub clusters: Option<Vec<u32>>,
    /// The threshold I_min of the deployment.
    pub i_min: f64,
    /// Wake-ups sent.
    pub wake_ups: usize,
}

impl Moment {
    /// The moment in which event `event` of `scenario` closes; by default the first event after the warm-up that made
    /// the BS wake somebody who reported, or else the first reported, or else the first.
    ///
    /// # Errors
    /// More than [`CROWD`] devices, or no such event.
    pub fn of(scenario: &Scenario, event: Option<u64>) -> Result<Self, FigureError> {
        if scenario.devices > CROWD {
            return Err(FigureError::Crowd {
                count: scenario.devices,
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
                ttis: scenario.ttis,
            });
        };
        let mut walk = Walk::new(scenario);
        let happened = walk.reach(chosen.last);
        let positions = Deployment::new(scenario).positions();
        let roles = (0..scenario.devices).map(DeviceId);
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

fn role(device: DeviceId, happened: &Happened, state: DeviceState) -> Role {
    let wake_up = (1..).zip(&happened.woken).find(|(_, (woken, _))| *woken == device);
    match wake_up {
        Some((number, (_, WakeOutcome::Reported(_)))) => return Role::Woken(number),
        Some((_, (_, WakeOutcome::Failed(_) | WakeOutcome::Late { .. }))) => return Role::Failed,
        Some((_, (_, WakeOutcome::Unheard | WakeOutcome::Lost(_)))) => return Role::Deaf,
        None => {}
    }
    if happened.failures.iter().any(|f| f.device == device) {
        return Role::Failed;
    }
    match state {
        DeviceState::Transmission => Role::Reporter,
        DeviceState::Idle | DeviceState::Active => Role::Sensing,
        DeviceState::Sleep { powered: true } => Role::Asleep,
        DeviceState::Sleep { powered: false } => Role::Empty,
    }
}

/// What the picture of `moment` is called.
pub fn name(scenario: &Scenario, moment: &Moment) -> String {
    let (policy, event) = (scenario.policy.name(), moment.event.event.0);
    format!("deployment-{policy}-n{}-s{}-e{event}", scenario.devices, scenario.seed)
}

/// The picture of `moment`.
pub fn scene(scenario: &Scenario, moment: &Moment) -> Scene {
    let mut scene = Scene::new(COLUMN, 0.0);
    scene.title = format!(
        "Event {}, policy {}, N = {}",
        moment.event.event.0,
        scenario.policy.name(),
        scenario.devices
    );
    let mut y = EDGE + LARGE;
    for line in wrap(&scene.title.clone(), Weight::Bold, LARGE, COLUMN - 2.0 * EDGE) {
        scene.text(Text::new(line, (EDGE, y), LARGE).bold());
        y += LEADING + 1.0;
    }
    let ground = Ground::new(scenario.area, y - 2.0);
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

impl Ground {
    fn cells(&self, scene: &mut Scene, moment: &Moment) {
        let cells = cells(&moment.positions, self.area);
        let border = Stroke::solid(Paint::Ink, 0.5).faded(0.3);
        if let Some(of) = &moment.clusters {
            let tints = tints(&map::neighbours(&moment.positions, &cells), of, TINTS.len());
            for (cell, cluster) in cells.iter().zip(of) {
                let tint = TINTS[tints[*cluster as usize]];
                let corners = cell.iter().map(|p| self.at(*p));
                scene.area(Path::polyline(corners, true), Paint::Colour(tint), 1.0);
            }
        }
        for cell in &cells {
            scene.line(Path::polyline(cell.iter().map(|p| self.at(*p)), true), border);
        }
        if let Some(of) = &moment.clusters {
            for (from, to) in map::borders(&moment.positions, &cells, of) {
                let line = Path::segment(self.at(from), self.at(to));
                scene.line(line, Stroke::solid(Paint::Ink, 1.1).faded(0.75));
            }
        }
    }

    /// The epicentre, and the part of the circle of radius d_max around it that lies in the area.
    fn event(&self, scene: &mut Scene, moment: &Moment, d_max: f64) {
        let centre = moment.event.epicentre;
        let stroke = Stroke::solid(Paint::Colour(VERMILION), 1.2).dashed(&[4.0, 2.0]);
        let mut arc: Vec<(f64, f64)> = Vec::new();
        for i in 0..=360 {
            let angle = f64::from(i).to_radians();
            let p = Point::new(centre.x + d_max * cos(angle), centre.y + d_max * sin(angle));
            if self.area.contains(p) {
                arc.push(self.at(p));
            } else if !arc.is_empty() {
                scene.line(Path::polyline(std::mem::take(&mut arc), false), stroke);
            }
        }
        if !arc.is_empty() {
            scene.line(Path::polyline(arc, false), stroke);
        }
        epicentre(scene, self.at(centre));
    }

    fn devices(&self, scene: &mut Scene, moment: &Moment) {
        for (p, role) in moment.positions.iter().zip(&moment.roles) {
            draw_role(scene, *role, self.at(*p));
        }
        for (p, role) in moment.positions.iter().zip(&moment.roles) {
            if let Role::Woken(number) = role {
                let (x, y) = self.at(*p);
                let text = number.to_string();
                // On the side where the area is.
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
    let star = Path::polygon(at, 6.0, 8, 0.0, 0.4);
    let border = Stroke::solid(Paint::Ink, 0.6);
    scene.outlined(star, Paint::Colour(VERMILION), border);
}

fn cross(scene: &mut Scene, (x, y): (f64, f64), size: f64, stroke: Stroke) {
    let mut path = Path::segment((x - size, y - size), (x + size, y + size));
    path.extend(Path::segment((x - size, y + size), (x + size, y - size)));
    scene.line(path, stroke);
}

fn draw_role(scene: &mut Scene, role: Role, at: (f64, f64)) {
    let (x, y) = at;
    let border = Stroke::solid(Paint::Ink, 0.5);
    match role {
        Role::Reporter => scene.outlined(Path::circle(at, 3.4), Paint::Colour(BLUE), border),
        Role::Woken(_) => {
            let square = Path::rectangle([x - 2.8, y - 2.8, x + 2.8, y + 2.8]);
            scene.outlined(square, Paint::Colour(GREEN), border);
        }
        Role::Failed => cross(scene, at, 3.0, Stroke::solid(Paint::Colour(VERMILION), 1.6)),
        Role::Deaf => {
            let square = Path::rectangle([x - 2.6, y - 2.6, x + 2.6, y + 2.6]);
            scene.outlined(square, Paint::Paper, Stroke::solid(Paint::Ink, 0.8));
            cross(scene, at, 2.6, Stroke::solid(Paint::Ink, 0.8));
        }
        Role::Sensing => scene.outlined(
            Path::circle(at, 2.8),
            Paint::Paper,
            Stroke::solid(Paint::Colour(BLUE), 1.2),
        ),
        Role::Asleep => scene.area(Path::circle(at, 1.5), Paint::Ink, 1.0),
        Role::Empty => cross(scene, at, 1.7, Stroke::solid(Paint::Ink, 0.8)),
    }
}

/// The kinds of devices that the picture shows, with how many of each; gives the base line of what follows.
fn legend(scene: &mut Scene, moment: &Moment, mut y: f64) -> f64 {
    let count = |is: fn(&Role) -> bool| moment.roles.iter().filter(|role| is(role)).count();
    let entries = [
        (Role::Reporter, "S1, reported", count(|r| matches!(r, Role::Reporter))),
        (
            Role::Woken(1),
            "woken, reported",
            count(|r| matches!(r, Role::Woken(_))),
        ),
        (Role::Failed, "could not pay E_Tx", count(|r| matches!(r, Role::Failed))),
        (Role::Deaf, "woken, not heard of", count(|r| matches!(r, Role::Deaf))),
        (
            Role::Sensing,
            "S1, nothing to report",
            count(|r| matches!(r, Role::Sensing)),
        ),
        (Role::Asleep, "S4, asleep", count(|r| matches!(r, Role::Asleep))),
        (Role::Empty, "no power", count(|r| matches!(r, Role::Empty))),
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

fn caption(scenario: &Scenario, moment: &Moment) -> String {
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
        1 => "one wake-up (numbered if a report came of it)".to_owned(),
        many => format!("{many} wake-ups (numbered where a report came of it)"),
    };
    format!(
        "{ground} The event began in TTI {start} and ended in TTI {last}, which is shown. The BS sent {wake_ups} and \
         got information {information:.3}; I_min of the deployment is {:.3}. Preset {}, seed {}.",
        moment.i_min, scenario.preset, scenario.seed
    )
}
