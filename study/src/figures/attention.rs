//! Attention of a decision of `dt`: a map of its expectation for each device in one TTI, and the attention of some
//! devices to each of the last Z TTIs.

use std::fmt::Write as _;
use std::sync::Arc;

use reveille_bs::policy::dt::model::infer::Forward;
use reveille_bs::policy::dt::model::{HEADS, ModelObjective, ModelShape};
use reveille_bs::policy::dt::record::TrajectoryStep;
use reveille_bs::policy::dt::settings::DtSettings;
use reveille_bs::scenario::Scenario;
use reveille_common::deployment::Deployment;
use reveille_common::geometry::{Point, cells};
use reveille_common::ids::Tti;
use reveille_lab::trajectories::steps;

use super::area_plot::AreaPlot;
use super::deployment::epicentre;
use super::error::FigureError;
use super::font::{Weight, wrap};
use super::heat::{HeatCell, HeatMap, RowLabels, VisitCount, colour, ramp};
use super::path::VectorPath;
use super::scene::{Paint, Scene, Stroke, Text};
use super::style::{BLUE, COLUMN, EDGE, LARGE, LEADING, SMALL};

/// Number of devices whose attention is shown by default.
const SHOWN: usize = 6;
/// Height of a row, points.
const ROW: f64 = 13.0;

/// A decision with its attention and inputs.
#[derive(Clone, Debug)]
pub struct AttentionFigure {
    /// TTI of the decision.
    pub tti: Tti,
    shape: ModelShape,
    positions: Vec<Point>,
    /// By device, the logarithm of expected events relative to the expectation from age and α. For a model that
    /// imitates actions, the log-odds of telling the device to sense.
    pub logs: Vec<f64>,
    /// Attention shares `[N, heads, Z]`, by lag.
    pub shares: Vec<f32>,
    /// Whether the decision sets δ = 1, by device.
    pub on: Vec<bool>,
    /// Number of TTIs since each device last found an event, if within the Z TTIs.
    pub found: Vec<Option<usize>>,
    /// Devices whose attention is shown.
    pub shown: Vec<usize>,
}

impl AttentionFigure {
    /// Evaluates the decision on TTI `tti` of `scenario`, whose policy is `dt`, and shows `devices`. By default it
    /// shows the devices with the largest magnitude in `logs`.
    ///
    /// # Errors
    /// The policy is not `dt`, or the TTI or a device does not exist.
    pub fn from_scenario(scenario: &Scenario, tti: Tti, devices: &[u32]) -> Result<Self, FigureError> {
        let Some(settings) = scenario.policy.settings().downcast_ref::<DtSettings>() else {
            return Err(FigureError::NoAttention(scenario.policy.name().to_owned()));
        };
        // A step is recorded when the next TTI begins, so the last TTI of a run has none.
        if tti.0 + 1 >= scenario.run.ttis {
            return Err(FigureError::NoTti {
                tti: tti.0,
                last: scenario.run.ttis.saturating_sub(2),
            });
        }
        if let Some(device) = devices.iter().find(|device| **device >= scenario.run.devices) {
            return Err(FigureError::NoDevice {
                device: *device,
                count: scenario.run.devices,
            });
        }
        let shape = settings.weights.shape();
        // The model attends only to the last Z TTIs, so earlier ones need not be replayed through it.
        let from = Tti((tti.0 + 1).saturating_sub(shape.memory as u64));
        let window = steps(scenario, from, tti);
        let mut forward = Forward::new(Arc::clone(&settings.weights), scenario.run.devices as usize);
        let mut logs = Vec::new();
        for step in &window {
            logs = forward.step(&step.tokens).to_vec();
        }
        // The first head is about looks, the second about wake-ups.
        let logs: Vec<f64> = logs.chunks(HEADS).map(|heads| f64::from(heads[0])).collect();
        let mut shown: Vec<usize> = devices.iter().map(|device| *device as usize).collect();
        if shown.is_empty() {
            shown = (0..logs.len()).collect();
            shown.sort_by(|a, b| logs[*b].abs().total_cmp(&logs[*a].abs()));
            shown.truncate(SHOWN);
        }
        let now = window.last().map_or(&[][..], |step| &step.looks[..]);
        Ok(Self {
            tti,
            shape,
            positions: Deployment::new(scenario).positions(),
            shares: forward.attended().to_vec(),
            on: now.iter().map(|look| look.on).collect(),
            found: (0..logs.len()).map(|j| last_found(&window, j)).collect(),
            logs,
            shown,
        })
    }

    /// Formats one CSV row per device and head: the value in `logs`, whether δ = 1, and the attention by lag.
    pub fn csv(&self) -> String {
        let lags: Vec<String> = (0..self.shape.memory).map(|lag| format!("lag_{lag}")).collect();
        let said = match self.shape.objective {
            ModelObjective::Events => "log_expected",
            ModelObjective::Actions => "log_odds",
        };
        let mut csv = format!("device,on,{said},head,{}\n", lags.join(","));
        let heads = self.shares.chunks(self.shape.memory);
        for (row, shares) in heads.enumerate() {
            let (device, head) = (row / self.shape.heads, row % self.shape.heads);
            let shares: Vec<String> = shares.iter().map(f32::to_string).collect();
            let (on, log) = (u8::from(self.on[device]), self.logs[device]);
            let _ = writeln!(csv, "{device},{on},{log},{head},{}", shares.join(","));
        }
        csv
    }

    /// Creates the heat map of the attention of one head for the selected devices.
    fn heat(&self, head: usize) -> HeatMap {
        let z = self.shape.memory;
        let cell = |device: usize, lag: usize| HeatCell {
            value: f64::from(self.shares[(device * self.shape.heads + head) * z + lag]),
            // Before the run began there is nothing to attend to.
            known: if lag as u64 <= self.tti.0 {
                VisitCount::Well
            } else {
                VisitCount::Never
            },
            framed: false,
        };
        let row = |device: &usize| (0..z).rev().map(|lag| cell(*device, lag)).collect();
        HeatMap {
            x_label: format!("TTIs before the decision, head {}", head + 1),
            y_label: "device".to_owned(),
            columns: vec![("TTIs".to_owned(), (0..=z).rev().map(|lag| lag.to_string()).collect())],
            rows: RowLabels::Names(self.shown.iter().rev().map(ToString::to_string).collect()),
            cells: self.shown.iter().rev().map(row).collect(),
        }
    }
}

/// Returns the number of TTIs from the last find of device `j` to the end of `window`; `None` without a find.
fn last_found(window: &[TrajectoryStep], j: usize) -> Option<usize> {
    let before = window.iter().rev().skip(1);
    (1..)
        .zip(before)
        .find(|(_, step)| step.looks[j].found)
        .map(|(lag, _)| lag)
}

/// Draws `attention`.
pub fn scene(scenario: &Scenario, attention: &AttentionFigure) -> Scene {
    let mut scene = Scene::new(COLUMN, 0.0);
    let did = match attention.shape.objective {
        ModelObjective::Events => "Expectation",
        ModelObjective::Actions => "Choice",
    };
    scene.title = format!("{did} of dt in TTI {}, N = {}", attention.tti, scenario.run.devices);
    let mut y = EDGE + LARGE;
    for line in wrap(&scene.title.clone(), Weight::Bold, LARGE, COLUMN - 2.0 * EDGE) {
        scene.text(Text::new(line, (EDGE, y), LARGE).bold());
        y += LEADING + 1.0;
    }
    let ground = AreaPlot::new(scenario.area, y - 2.0);
    let largest = attention.logs.iter().fold(0.0, |most: f64, log| most.max(log.abs()));
    let border = Stroke::solid(Paint::Ink, 0.5).faded(0.3);
    for (cell, log) in cells(&attention.positions, scenario.area).iter().zip(&attention.logs) {
        let corners = VectorPath::polyline(cell.iter().map(|p| ground.at(*p)), true);
        scene.outlined(corners, Paint::Colour(colour(*log, largest)), border);
    }
    ground.axes(&mut scene);
    for (j, place) in attention.positions.iter().enumerate() {
        let at = ground.at(*place);
        if attention.on[j] {
            let blue = Stroke::solid(Paint::Colour(BLUE), 1.2);
            scene.outlined(VectorPath::circle(at, 2.8), Paint::Paper, blue);
        } else {
            scene.area(VectorPath::circle(at, 1.2), Paint::Ink, 1.0);
        }
        if attention.found[j].is_some() {
            epicentre(&mut scene, at);
        }
    }
    y = ground.bottom() + 2.0 * LEADING + 8.0;
    y = ramp(&mut scene, (EDGE, y), largest) + 8.0;
    for head in 0..attention.shape.heads {
        let heat = attention.heat(head);
        y = heat.draw(&mut scene, (EDGE, y), (COLUMN - 2.0 * EDGE, ROW), 1.0) + LEADING;
    }
    scene.description = caption(scenario, attention);
    for line in wrap(&scene.description.clone(), Weight::Regular, SMALL, COLUMN - 2.0 * EDGE) {
        scene.text(Text::new(line, (EDGE, y), SMALL));
        y += LEADING;
    }
    scene.height = (y - LEADING + 0.24 * SMALL + EDGE).ceil();
    scene
}

fn caption(scenario: &Scenario, attention: &AttentionFigure) -> String {
    let on = attention.on.iter().filter(|on| **on).count();
    let ago: Vec<usize> = attention.found.iter().flatten().copied().collect();
    let found = ago.iter().min().map_or_else(
        || "No device detected an event in the attended TTIs.".to_owned(),
        |least| {
            let ttis = if *least == 1 { "TTI" } else { "TTIs" };
            format!("Stars are devices that detected an event in those TTIs, the latest {least} {ttis} before.")
        },
    );
    let said = match attention.shape.objective {
        ModelObjective::Events => {
            "the logarithm of the events that dt expects of a device, relative to the number that α and the ages of \
             its places imply"
        }
        ModelObjective::Actions => "the log-odds that the teacher lets the device sense",
    };
    format!(
        "Colours of the Voronoi cells: {said}. {on} devices, with circles, were commanded to sense. Below, for each \
         head: the share of a device's attention to each of the last {} TTIs. {found} Preset {}, seed {}.",
        attention.shape.memory, scenario.run.preset, scenario.run.seed
    )
}
