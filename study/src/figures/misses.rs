//! Figure of missed events: their places in the deployment, with a colour and marker for each cause. Devices that
//! actions failed have an upright cross, as on the map of the dashboard. [`file_name`] names the files of `reveille
//! figures misses`. Users' scripts, `docs/reading-results.md` and `tests/program/misses.rs` have these names.

use reveille_common::geometry::voronoi_cells;
use reveille_common::ids::DeviceId;
use reveille_common::totals::MissCause;

use super::area_plot::{AreaPlot, Legend, draw_caption, draw_title};
use super::device_marks::{ClassMarks, MAX_NUMBERED, draw_labels};
use super::path::VectorPath;
use super::run_title::run_name;
use super::scene::{Paint, Scene, Stroke};
use super::style::{BLUE, COLUMN_WIDTH, GREEN, GREY, LEADING, MarkerShape, ORANGE, PURPLE, SKY, VERMILION};
use crate::misses::{Misses, cause_name};

/// Largest number of devices for which Voronoi cells are drawn; smaller cells would hide the events.
const MAX_CELLS: usize = 1000;
/// Half the size of the marker of a missed event, points.
const EVENT_RADIUS: f64 = 2.2;
/// Radius of the dot of a device, points.
const DEVICE_RADIUS: f64 = 2.0;
/// Half the size of the cross of a failed device, points.
const CROSS_RADIUS: f64 = 3.0;

/// Returns the paint and shape of a cause; `None` is an unknown cause. No two causes share a shape.
const fn cause_style(cause: Option<MissCause>) -> (Paint, MarkerShape) {
    match cause {
        Some(MissCause::OutOfReach) => (Paint::Colour(VERMILION), MarkerShape::TriangleUp),
        Some(MissCause::Removed) => (Paint::Colour(GREY), MarkerShape::Diamond),
        Some(MissCause::Undetected) => (Paint::Colour(PURPLE), MarkerShape::Pentagon),
        Some(MissCause::Asleep) => (Paint::Colour(BLUE), MarkerShape::Circle),
        Some(MissCause::Failed) => (Paint::Colour(GREY), MarkerShape::SixPoints),
        // Ink, not black, which would vanish on a dark page.
        Some(MissCause::Unpowered) => (Paint::Ink, MarkerShape::TriangleDown),
        Some(MissCause::WakeMissed) => (Paint::Colour(SKY), MarkerShape::Hexagon),
        Some(MissCause::NoEnergy) => (Paint::Colour(ORANGE), MarkerShape::Square),
        Some(MissCause::Lost) => (Paint::Colour(GREEN), MarkerShape::Star),
        None => (Paint::Ink, MarkerShape::FourPoints),
    }
}

/// Returns the file name, without extension, of the figure.
pub fn file_name(misses: &Misses) -> String {
    let scenario = &misses.scenario;
    let (policy, run) = (scenario.policy.name(), &scenario.run);
    format!("misses-{policy}-n{}-s{}", run.devices, run.seed)
}

/// Draws `misses`, of a run at any stage: without a counted event the caption states this.
pub fn scene(misses: &Misses) -> Scene {
    let scenario = &misses.scenario;
    let mut scene = Scene::new(COLUMN_WIDTH, 0.0);
    scene.title = format!("Missed events by cause: {}", run_name(scenario));
    let y = draw_title(&mut scene);
    let plot = AreaPlot::new(scenario.area, y - 2.0);
    if misses.positions.len() <= MAX_CELLS {
        let border = Stroke::solid(Paint::Ink, 0.5).with_opacity(0.3);
        for cell in voronoi_cells(&misses.positions, scenario.area) {
            let corners = cell.iter().map(|p| plot.to_canvas(*p));
            scene.line(VectorPath::closed_line(corners), border);
        }
    }
    plot.draw_axes(&mut scene);
    let events: Vec<(f64, f64)> = misses
        .missed
        .iter()
        .map(|event| plot.to_canvas(event.epicentre))
        .collect();
    for (event, at) in misses.missed.iter().zip(&events) {
        draw_miss(&mut scene, event.cause, *at);
    }
    let classes = ClassMarks::new(scenario);
    classes.draw_rings(&mut scene, &plot, &misses.positions);
    // Devices are on top of the events, which are many.
    let failed = misses.action_failures();
    let devices: Vec<(f64, f64)> = misses.positions.iter().map(|p| plot.to_canvas(*p)).collect();
    for (device, at) in (0..).map(DeviceId).zip(&devices) {
        if failed.contains_key(&device) {
            draw_cross(&mut scene, *at);
        } else {
            draw_device(&mut scene, *at);
        }
    }
    if devices.len() <= MAX_NUMBERED {
        let labels: Vec<_> = (0..)
            .zip(&devices)
            .map(|(device, at): (u32, _)| (*at, device.to_string()))
            .collect();
        let places = devices.iter().enumerate();
        let markers = places
            .map(|(device, at)| (*at, classes.radius(device, CROSS_RADIUS)))
            .collect();
        draw_labels(&mut scene, (&plot, &classes), &labels, markers, &events);
    }
    let y = draw_legend(&mut scene, misses, plot.bottom() + 2.0 * LEADING + 15.0);
    let y = classes.draw_legend(&mut scene, y);
    scene.description = caption(misses);
    draw_caption(&mut scene, y);
    scene
}

fn draw_device(scene: &mut Scene, at: (f64, f64)) {
    // The light border separates the dot from dark events below it.
    scene.outlined_area(
        VectorPath::circle(at, DEVICE_RADIUS),
        Paint::Ink,
        Stroke::solid(Paint::Paper, 0.7),
    );
}

fn draw_cross(scene: &mut Scene, (x, y): (f64, f64)) {
    let stroke = Stroke::solid(Paint::Ink, 1.3);
    scene.line(
        VectorPath::segment((x - CROSS_RADIUS, y), (x + CROSS_RADIUS, y)),
        stroke,
    );
    scene.line(
        VectorPath::segment((x, y - CROSS_RADIUS), (x, y + CROSS_RADIUS)),
        stroke,
    );
}

fn draw_miss(scene: &mut Scene, cause: Option<MissCause>, at: (f64, f64)) {
    let (paint, shape) = cause_style(cause);
    scene.outlined_area(shape.path(at, EVENT_RADIUS), paint, Stroke::solid(Paint::Paper, 0.3));
}

/// Draws the causes that occur, with their numbers of events. Returns the base line of the text below.
fn draw_legend(scene: &mut Scene, misses: &Misses, y: f64) -> f64 {
    let mut legend = Legend::new(y);
    for (cause, count) in misses.causes() {
        let at = legend.place(scene, &format!("{} ({count})", cause_name(cause)));
        draw_miss(scene, cause, at);
    }
    let numbers = if misses.positions.len() <= MAX_NUMBERED {
        ", with its number"
    } else {
        ""
    };
    let at = legend.place(scene, &format!("device{numbers}"));
    draw_device(scene, at);
    let failed = misses.action_failures();
    if !failed.is_empty() {
        let at = legend.place(scene, &format!("failed device ({})", failed.len()));
        draw_cross(scene, at);
    }
    legend.next_base_line()
}

fn caption(misses: &Misses) -> String {
    let (missed, events) = (misses.missed.len(), misses.counted_starts.len());
    let share_text = if events == 0 {
        "No event was counted.".to_owned()
    } else {
        format!(
            "{missed} of {events} events were missed ({:.2} %).",
            misses.missed_pct()
        )
    };
    let advice = misses
        .advice()
        .map_or_else(String::new, |advice| format!("{} ", advice.summary()));
    let failed_text = match misses.action_failures().len() {
        0 => "",
        1 => "A cross marks the device that actions failed. ",
        _ => "Crosses mark the devices that actions failed. ",
    };
    format!("{share_text} {failed_text}{advice}Seed {}.", misses.scenario.run.seed)
}
