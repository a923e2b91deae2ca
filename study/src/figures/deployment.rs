//! Deployment figure: the area with the devices' Voronoi cells and clusters, and one event with the devices involved in
//! the TTI in which it closed; or a TTI without an event. A role needs an arm in `draw_role` and an entry in
//! `draw_legend`. [`file_name`] names the files of `reveille figures deployment` and the picture in Python.

use libm::{cos, sin};
use reveille_bs::scenario::Scenario;
use reveille_common::deployment::Deployment;
use reveille_common::digits::format_significant;
use reveille_common::event::EventRecord;
use reveille_common::geometry::{Point, voronoi_cells};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::WakeOutcome;
use reveille_common::state::DeviceState;

use super::area_plot::{AreaPlot, Legend, draw_caption, draw_title};
use super::cell_map::{self, assign_tints};
use super::device_marks::{ClassMarks, DOT_RADIUS, MAX_NUMBERED, draw_dot, draw_labels};
use super::error::FigureError;
use super::path::VectorPath;
use super::run_title::{policy_sentence, run_name};
use super::run_walk::{RunWalk, TtiOutcome, run_to_end};
use super::scene::{Paint, Rgb, Scene, Stroke};
use super::style::{BLUE, COLUMN_WIDTH, GREEN, LEADING, MarkerShape, ORANGE, VERMILION};

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

/// Largest radius of the symbol of a device or of the epicentre, points.
const SYMBOL_RADIUS: f64 = 3.6;

/// The event of a figure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EventChoice {
    /// The first event that shows most, see [`EventScene::from_scenario`].
    Automatic,
    /// The event with this number, from 0.
    Number(u64),
    /// No event.
    Without,
}

/// Role of a device in the TTI shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DeviceRole {
    /// In S1, and reported.
    Reporter,
    /// Woken within d_max, and reported; with the number of its wake-up.
    Woken(u32),
    /// Woken beyond d_max, so its report carried no information: a wrong activation. With the number of its wake-up.
    WrongActivation(u32),
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

/// One event, or none, and the devices around it.
#[derive(Clone, Debug)]
pub struct EventScene {
    /// The event, if one is shown.
    pub event: Option<EventRecord>,
    /// The TTI shown: the event's last one.
    pub tti: Tti,
    /// Positions of the devices, metres.
    pub positions: Vec<Point>,
    /// Role of each device in that TTI.
    pub roles: Vec<DeviceRole>,
    /// Cluster of each device, if the policy has clusters.
    pub clusters: Option<Vec<u32>>,
    /// Threshold I_min at which the policy stops waking devices, if it has one.
    pub i_min: Option<f64>,
    /// Number of wake-ups sent in that TTI.
    pub wake_up_count: usize,
}

impl EventScene {
    /// Runs `scenario` up to the TTI in which the chosen event closes. The automatic choice is the first event after
    /// the warm-up with several reports and a wake-up. Failing that, it is the first event after the warm-up with a
    /// report, or else the first event of the run. Without an event, the TTI is the first one after the warm-up in
    /// which none is active. Help texts and `python/reveille/figures.py` describe this choice to users.
    ///
    /// # Errors
    /// There are more than `MAX_DEVICES` devices, the event does not exist, or an event is active in every TTI.
    pub fn from_scenario(scenario: &Scenario, choice: EventChoice) -> Result<Self, FigureError> {
        if scenario.run.devices > MAX_DEVICES {
            return Err(FigureError::TooManyDevices {
                count: scenario.run.devices,
                figure: "a deployment picture",
                limit: MAX_DEVICES,
                advice: "give fewer with --devices",
            });
        }
        let (events, outcome) = run_to_end(scenario);
        let event = choose_event(&events, choice, scenario.run.ttis)?;
        let tti = match &event {
            Some(event) => event.last,
            None => quiet_tti(scenario, &events)?,
        };
        let i_min = outcome.facts.iter().find(|(name, _)| *name == "i_min");
        let i_min = i_min.map(|(_, value)| *value);
        let mut walk = RunWalk::new(scenario);
        let outcome = walk.run_through(tti);
        let positions = Deployment::new(scenario).positions();
        let (epicentre, d_max) = (event.map(|event| event.epicentre), scenario.sensing.d_max);
        let role = |(j, position): (DeviceId, &Point)| {
            let is_far = epicentre.is_some_and(|epicentre| position.distance(epicentre) > d_max);
            role_of(j, &outcome, walk.state_and_battery(j, tti).0, is_far)
        };
        Ok(Self {
            event,
            tti,
            roles: (0..).map(DeviceId).zip(&positions).map(role).collect(),
            clusters: walk.groups().map(<[u32]>::to_vec),
            i_min,
            positions,
            wake_up_count: outcome.wake_ups.len(),
        })
    }
}

/// Returns the chosen event of a run of `ttis` TTIs with these `events`.
fn choose_event(events: &[EventRecord], choice: EventChoice, ttis: u64) -> Result<Option<EventRecord>, FigureError> {
    let counted_events = || events.iter().filter(|e| e.counted);
    let chosen = match choice {
        EventChoice::Without => return Ok(None),
        EventChoice::Number(event) => events.iter().find(|e| e.event.0 == event),
        EventChoice::Automatic => counted_events()
            .find(|e| e.tally.reports > 1 && e.tally.wake_ups > 0)
            .or_else(|| counted_events().find(|e| e.tally.reports > 0))
            .or_else(|| events.first()),
    };
    chosen.copied().map(Some).ok_or(match choice {
        EventChoice::Number(event) if !events.is_empty() => FigureError::UnknownEvent {
            event,
            count: events.len(),
            ttis,
        },
        EventChoice::Number(_) | EventChoice::Automatic | EventChoice::Without => FigureError::NoEvent { ttis },
    })
}

/// Returns the first TTI after the warm-up in which none of `events` is active.
fn quiet_tti(scenario: &Scenario, events: &[EventRecord]) -> Result<Tti, FigureError> {
    let is_quiet = |k: &Tti| !events.iter().any(|event| (event.start..=event.last).contains(k));
    let mut ttis = (scenario.warm_up_end().0..scenario.run.ttis).map(Tti);
    ttis.find(is_quiet).ok_or(FigureError::NoQuietTti)
}

/// Returns the role of `device`, whose state at the end of the TTI is `state`; `is_far` if it is beyond d_max.
fn role_of(device: DeviceId, outcome: &TtiOutcome, state: DeviceState, is_far: bool) -> DeviceRole {
    // Wake-ups first: a woken device that has reported also ends its TTI in S3.
    let wake_up = (1..).zip(&outcome.wake_ups).find(|(_, (woken, _))| *woken == device);
    match wake_up {
        Some((number, (_, WakeOutcome::Reported(_)))) if is_far => return DeviceRole::WrongActivation(number),
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
    let shown = match &event_scene.event {
        Some(event) => format!("e{}", event.event.0),
        None => format!("k{}", event_scene.tti),
    };
    format!(
        "deployment-{}-n{}-s{}-{shown}",
        scenario.policy.name(),
        scenario.run.devices,
        scenario.run.seed
    )
}

/// Draws `event_scene`.
pub fn scene(scenario: &Scenario, event_scene: &EventScene) -> Scene {
    let mut scene = Scene::new(COLUMN_WIDTH, 0.0);
    let subject = match &event_scene.event {
        Some(event) => format!("Event {}", event.event.0),
        None => format!("TTI {}", event_scene.tti),
    };
    scene.title = format!("{subject}: {}", run_name(scenario));
    let mut y = draw_title(&mut scene);
    let plot = AreaPlot::new(scenario.area, y - 2.0);
    plot.draw_cells(&mut scene, event_scene);
    plot.draw_axes(&mut scene);
    if let Some(event) = &event_scene.event {
        plot.draw_event(&mut scene, event.epicentre, scenario.sensing.d_max);
    }
    let classes = ClassMarks::new(scenario);
    classes.draw_rings(&mut scene, &plot, &event_scene.positions);
    plot.draw_devices(&mut scene, event_scene, &classes);
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
    fn draw_event(&self, scene: &mut Scene, centre: Point, d_max: f64) {
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

    /// Draws the symbol of each device. All devices have their number if these fit, otherwise only those with a part in
    /// the event. The order of its wake-up follows the number of a woken device.
    fn draw_devices(&self, scene: &mut Scene, event_scene: &EventScene, classes: &ClassMarks) {
        let places: Vec<(f64, f64)> = event_scene.positions.iter().map(|p| self.to_canvas(*p)).collect();
        for (at, role) in places.iter().zip(&event_scene.roles) {
            draw_role(scene, *role, *at);
        }
        let label = |(device, (at, role)): (usize, (&(f64, f64), &DeviceRole))| {
            let text = match role.wake_up_order() {
                Some(order) => format!("{device} (w{order})"),
                None => device.to_string(),
            };
            (*at, text)
        };
        let devices = || places.iter().zip(&event_scene.roles).enumerate();
        // Devices with a part in the event have the first choice of places.
        let with_part = devices().filter(|(_, (_, role))| role.takes_part());
        let others = devices().filter(|(_, (_, role))| !role.takes_part() && places.len() <= MAX_NUMBERED);
        let labels: Vec<((f64, f64), String)> = with_part.chain(others).map(label).collect();
        let radius = |role: &DeviceRole| {
            if matches!(role, DeviceRole::Asleep | DeviceRole::WithoutPower) {
                DOT_RADIUS
            } else {
                SYMBOL_RADIUS
            }
        };
        let symbols = devices().map(|(device, (at, role))| (*at, classes.radius(device, radius(role))));
        let epicentre = event_scene
            .event
            .map(|event| (self.to_canvas(event.epicentre), SYMBOL_RADIUS));
        let markers = symbols.chain(epicentre).collect();
        draw_labels(scene, (self, classes), &labels, markers, &[]);
    }
}

impl DeviceRole {
    /// Whether the device was woken, reported or tried to.
    const fn takes_part(self) -> bool {
        !matches!(self, Self::Sensing | Self::Asleep | Self::WithoutPower)
    }

    /// The number of the wake-up of a woken device that reported.
    const fn wake_up_order(self) -> Option<u32> {
        if let Self::Woken(order) | Self::WrongActivation(order) = self {
            Some(order)
        } else {
            None
        }
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
        DeviceRole::WrongActivation(_) => {
            let diamond = MarkerShape::Diamond.path(at, SYMBOL_RADIUS);
            scene.outlined_area(diamond, Paint::Colour(ORANGE), border);
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
        DeviceRole::Asleep => draw_dot(scene, at),
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
            DeviceRole::WrongActivation(1),
            "wrong activation, beyond d_max",
            count_roles(|r| matches!(r, DeviceRole::WrongActivation(_))),
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
    if event_scene.event.is_some() {
        let at = legend.place(scene, "event, with d_max");
        draw_star(scene, at);
    }
    for (role, text, count) in entries.into_iter().filter(|(_, _, count)| *count > 0) {
        let at = legend.place(scene, &format!("{text} ({count})"));
        draw_role(scene, role, at);
    }
    legend.next_base_line()
}

fn caption(scenario: &Scenario, event_scene: &EventScene) -> String {
    let mut sentences = vec![event_scene.clusters.as_ref().map_or_else(
        || "Cells are the devices' Voronoi cells.".to_owned(),
        |cluster_of| {
            let count = cluster_of.iter().max().map_or(0, |largest| largest + 1);
            format!("Cells are the devices' Voronoi cells, tinted by their {count} clusters.")
        },
    )];
    sentences.push(if event_scene.positions.len() <= MAX_NUMBERED {
        "Numbers are devices.".to_owned()
    } else if event_scene.event.is_some() {
        "Numbers are devices with a part in the event.".to_owned()
    } else {
        String::new()
    });
    sentences.extend(event_sentences(event_scene));
    sentences.push(policy_sentence(scenario));
    sentences.push(format!("Seed {}.", scenario.run.seed));
    sentences.retain(|sentence| !sentence.is_empty());
    sentences.join(" ")
}

/// Describes the event, or the lack of one.
fn event_sentences(event_scene: &EventScene) -> Vec<String> {
    let tti = event_scene.tti;
    let Some(EventRecord { start, last, tally, .. }) = event_scene.event else {
        return vec![format!("No event is active in TTI {tti}, which is shown.")];
    };
    let span = if start == last {
        format!("The event began and ended in TTI {last}, which is shown.")
    } else {
        format!("The event began in TTI {start} and ended in TTI {last}, which is shown.")
    };
    let wake_ups = match event_scene.wake_up_count {
        0 => "no wake-up".to_owned(),
        1 => "one wake-up (w1)".to_owned(),
        many => format!("{many} wake-ups (w1, w2, … in this order, if they led to a report)"),
    };
    let information = format_significant(tally.information(), 3);
    let target = event_scene.i_min.map_or_else(String::new, |i_min| {
        format!("; the policy stops at I_min = {}", format_significant(i_min, 3))
    });
    let received = format!("The BS sent {wake_ups} and got information {information}{target}.");
    vec![span, received]
}
