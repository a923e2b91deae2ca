//! Attention of a decision of `dt`: a map of its expectation for each device in one TTI, and the attention of some
//! devices to each of the last Z TTIs. `reveille figures attention` writes both; the columns of
//! [`AttentionFigure::csv`] are a file format.

use std::fmt::Write as _;
use std::sync::Arc;

use reveille_bs::policy::dt::model::infer::ForwardPass;
use reveille_bs::policy::dt::model::{ModelObjective, ModelShape, OUTPUTS};
use reveille_bs::policy::dt::record::TrajectoryStep;
use reveille_bs::policy::dt::settings::DtSettings;
use reveille_bs::scenario::Scenario;
use reveille_common::deployment::Deployment;
use reveille_common::geometry::{Point, voronoi_cells};
use reveille_common::ids::Tti;
use reveille_lab::trajectories::record_steps;

use super::area_plot::{AreaPlot, draw_caption, draw_title};
use super::deployment::draw_star;
use super::error::FigureError;
use super::heat::{HeatCell, HeatMap, KnowledgeDegree, RowLabels, colour_of, draw_colour_scale};
use super::path::VectorPath;
use super::scene::{Paint, Scene, Stroke};
use super::style::{BLUE, COLUMN_WIDTH, LEADING, MARGIN};

/// Number of devices whose attention is shown by default.
const DEFAULT_DEVICES: usize = 6;
/// Height of a row, points.
const ROW_HEIGHT: f64 = 13.0;

/// A decision with its attention and inputs.
#[derive(Clone, Debug)]
pub struct AttentionFigure {
    /// TTI of the decision.
    pub tti: Tti,
    shape: ModelShape,
    positions: Vec<Point>,
    /// By device, the logarithm of expected events relative to the expectation from age and α. For a model that
    /// imitates actions, the log-odds of telling the device to sense.
    pub log_expectations: Vec<f64>,
    /// Attention shares `[N, heads, Z]`, by lag.
    pub attention_shares: Vec<f32>,
    /// Whether the decision sets δ = 1, by device.
    pub is_sensing: Vec<bool>,
    /// Number of TTIs since each device last sent the first report of an event, if within the Z TTIs.
    pub ttis_since_first_report: Vec<Option<usize>>,
    /// Devices whose attention is shown.
    pub shown_devices: Vec<usize>,
}

impl AttentionFigure {
    /// Evaluates the decision on TTI `tti` of `scenario`, whose policy is `dt`, and shows `devices`. By default it
    /// shows the devices with the largest magnitude in `log_expectations`.
    ///
    /// # Errors
    /// The policy is not `dt`, its model has no attention over time, or the TTI or a device does not exist.
    pub fn from_scenario(scenario: &Scenario, tti: Tti, devices: &[u32]) -> Result<Self, FigureError> {
        let Some(settings) = scenario.policy.settings().downcast_ref::<DtSettings>() else {
            return Err(FigureError::NoAttention(scenario.policy.name().to_owned()));
        };
        // A step is recorded when the next TTI begins, so the last TTI of a run has none.
        if tti.0 >= scenario.run.ttis.saturating_sub(1) {
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
        if !shape.attends_to_past() {
            return Err(FigureError::NoAttentionInModel);
        }
        // The model attends only to the last Z TTIs, so earlier ones need not be replayed through it.
        let first_tti = Tti((tti.0 + 1).saturating_sub(shape.memory as u64));
        let steps = record_steps(scenario, first_tti, tti);
        let mut forward = ForwardPass::new(Arc::clone(&settings.weights), scenario.run.devices as usize);
        let mut outputs = Vec::new();
        for step in &steps {
            outputs = forward.step(&step.tokens).to_vec();
        }
        // The first output of a device is about sensing, the second about wake-ups.
        let log_expectations: Vec<f64> = outputs
            .chunks(OUTPUTS)
            .map(|device_outputs| f64::from(device_outputs[0]))
            .collect();
        let mut shown_devices: Vec<usize> = devices.iter().map(|device| *device as usize).collect();
        if shown_devices.is_empty() {
            shown_devices = (0..log_expectations.len()).collect();
            shown_devices.sort_by(|a, b| log_expectations[*b].abs().total_cmp(&log_expectations[*a].abs()));
            shown_devices.truncate(DEFAULT_DEVICES);
        }
        let last_devices = steps.last().map_or(&[][..], |step| &step.devices[..]);
        Ok(Self {
            tti,
            shape,
            positions: Deployment::new(scenario).positions(),
            attention_shares: forward.attention().to_vec(),
            is_sensing: last_devices.iter().map(|device| device.is_sensing).collect(),
            ttis_since_first_report: (0..log_expectations.len())
                .map(|j| lag_of_first_report(&steps, j))
                .collect(),
            log_expectations,
            shown_devices,
        })
    }

    /// Formats one CSV row per device and head: the value in `log_expectations`, whether δ = 1, and the attention by
    /// lag.
    pub fn csv(&self) -> String {
        let lags: Vec<String> = (0..self.shape.memory).map(|lag| format!("lag_{lag}")).collect();
        let value_column = match self.shape.objective {
            ModelObjective::Events => "log_expected",
            ModelObjective::Actions => "log_odds",
        };
        let mut csv = format!("device,on,{value_column},head,{}\n", lags.join(","));
        let heads = self.attention_shares.chunks(self.shape.memory);
        for (row, shares) in heads.enumerate() {
            let (device, head) = (row / self.shape.heads, row % self.shape.heads);
            let shares: Vec<String> = shares.iter().map(f32::to_string).collect();
            let (on, log) = (u8::from(self.is_sensing[device]), self.log_expectations[device]);
            let _ = writeln!(csv, "{device},{on},{log},{head},{}", shares.join(","));
        }
        csv
    }

    /// Creates the heat map of the attention of one head for the selected devices.
    fn heat_map(&self, head: usize) -> HeatMap {
        let z = self.shape.memory;
        let cell = |device: usize, lag: usize| HeatCell {
            value: f64::from(self.attention_shares[(device * self.shape.heads + head) * z + lag]),
            // Before the run began there is nothing to attend to.
            knowledge: if lag as u64 <= self.tti.0 {
                KnowledgeDegree::Known
            } else {
                KnowledgeDegree::Unknown
            },
            is_framed: false,
        };
        let row = |device: &usize| (0..z).rev().map(|lag| cell(*device, lag)).collect();
        HeatMap {
            x_label: format!("TTIs before the decision, head {}", head + 1),
            y_label: "device".to_owned(),
            columns: vec![("TTIs".to_owned(), (0..=z).rev().map(|lag| lag.to_string()).collect())],
            rows: RowLabels::Names(self.shown_devices.iter().rev().map(ToString::to_string).collect()),
            cells: self.shown_devices.iter().rev().map(row).collect(),
        }
    }
}

/// Returns the number of TTIs from the last first report of device `j` to the last of `steps`, which does not count;
/// `None` without one.
fn lag_of_first_report(steps: &[TrajectoryStep], j: usize) -> Option<usize> {
    let before = steps.iter().rev().skip(1);
    (1..)
        .zip(before)
        .find(|(_, step)| step.devices[j].has_reported_first)
        .map(|(lag, _)| lag)
}

/// Draws `attention`.
pub fn scene(scenario: &Scenario, attention: &AttentionFigure) -> Scene {
    let mut scene = Scene::new(COLUMN_WIDTH, 0.0);
    let subject = match attention.shape.objective {
        ModelObjective::Events => "Expectation",
        ModelObjective::Actions => "Choice",
    };
    scene.title = format!("{subject} of dt in TTI {}, N = {}", attention.tti, scenario.run.devices);
    let mut y = draw_title(&mut scene);
    let plot = AreaPlot::new(scenario.area, y - 2.0);
    let largest = attention
        .log_expectations
        .iter()
        .fold(0.0, |most: f64, log| most.max(log.abs()));
    let border = Stroke::solid(Paint::Ink, 0.5).with_opacity(0.3);
    for (cell, log) in voronoi_cells(&attention.positions, scenario.area)
        .iter()
        .zip(&attention.log_expectations)
    {
        let corners = VectorPath::closed_line(cell.iter().map(|p| plot.to_canvas(*p)));
        scene.outlined_area(corners, Paint::Colour(colour_of(*log, largest)), border);
    }
    plot.draw_axes(&mut scene);
    for (j, position) in attention.positions.iter().enumerate() {
        let at = plot.to_canvas(*position);
        if attention.is_sensing[j] {
            let blue = Stroke::solid(Paint::Colour(BLUE), 1.2);
            scene.outlined_area(VectorPath::circle(at, 2.8), Paint::Paper, blue);
        } else {
            scene.area(VectorPath::circle(at, 1.2), Paint::Ink, 1.0);
        }
        if attention.ttis_since_first_report[j].is_some() {
            draw_star(&mut scene, at);
        }
    }
    y = plot.bottom() + 2.0 * LEADING + 8.0;
    y = draw_colour_scale(&mut scene, (MARGIN, y), largest) + 8.0;
    for head in 0..attention.shape.heads {
        let heat = attention.heat_map(head);
        y = heat.draw(&mut scene, (MARGIN, y), (COLUMN_WIDTH - 2.0 * MARGIN, ROW_HEIGHT), 1.0) + LEADING;
    }
    scene.description = caption(scenario, attention);
    draw_caption(&mut scene, y);
    scene
}

fn caption(scenario: &Scenario, attention: &AttentionFigure) -> String {
    let sensing = attention.is_sensing.iter().filter(|is_sensing| **is_sensing).count();
    let ttis_ago: Vec<usize> = attention.ttis_since_first_report.iter().flatten().copied().collect();
    let first_reports = ttis_ago.iter().min().map_or_else(
        || "No device was the first to report an event in the attended TTIs.".to_owned(),
        |least| {
            let ttis = if *least == 1 { "TTI" } else { "TTIs" };
            format!(
                "Stars are devices that were the first to report an event in those TTIs, the latest {least} {ttis} \
                 before."
            )
        },
    );
    let quantity = match attention.shape.objective {
        ModelObjective::Events => {
            "the logarithm of the events that dt expects of a device, relative to the number that α and the ages of \
             its places imply"
        }
        ModelObjective::Actions => "the log-odds that the imitated policy lets the device sense",
    };
    format!(
        "Colours of the Voronoi cells: {quantity}. {sensing} devices, with circles, were commanded to sense. Below, \
         for each head: the share of a device's attention to each of the last {} TTIs. {first_reports} Preset {}, \
         seed {}.",
        attention.shape.memory, scenario.run.preset, scenario.run.seed
    )
}
