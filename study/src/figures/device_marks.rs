//! Marks of devices on a map, shared by the figures of deployments and missed events: numbers, and rings of classes.

use reveille_bs::scenario::Scenario;
use reveille_common::geometry::Point;
use reveille_common::scenario::assign_classes;

use super::area_plot::AreaPlot;
use super::font::{Weight, wrap_text};
use super::note::{Obstacles, place_notes};
use super::path::VectorPath;
use super::scene::{Paint, Rgb, Scene, Stroke, Text};
use super::style::{COLUMN_WIDTH, GREY, LEADING, MARGIN, ORANGE, PURPLE, SKY, TEXT_SIZE, VERMILION};

/// Largest number of devices of which all have their number. Larger maps lack the room.
pub(super) const MAX_NUMBERED: usize = 60;
/// Rings of device classes: colour and dashes. The most frequent class has none; classes beyond the last ring share it.
const CLASS_RINGS: [(Rgb, &[f64]); 5] = [
    (PURPLE, &[]),
    (ORANGE, &[2.5, 1.5]),
    (SKY, &[]),
    (GREY, &[1.0, 1.2]),
    (VERMILION, &[4.0, 1.2]),
];
/// Radius of a class ring, points: larger than any device symbol.
const RING_RADIUS: f64 = 5.2;

/// Draws the labels of devices, `labels`, each with its position, next to the devices, with a light background. They
/// avoid `markers`, the symbols of all devices with their radii and class rings, and cover `smaller_marks` only without
/// other space. Labels without room are left out.
pub(super) fn draw_labels(
    scene: &mut Scene,
    (plot, classes): (&AreaPlot, &ClassMarks),
    labels: &[((f64, f64), String)],
    markers: Vec<((f64, f64), f64)>,
    smaller_marks: &[(f64, f64)],
) {
    let labels: Vec<((f64, f64), &str)> = labels.iter().map(|(at, label)| (*at, label.as_str())).collect();
    let (right, _) = plot.to_canvas(Point::new(plot.area.width, 0.0));
    let obstacles = Obstacles {
        markers,
        lines: smaller_marks
            .iter()
            .map(|&(x, y)| [(x - 2.0, y), (x + 2.0, y)])
            .collect(),
        // No label touches the ring of its device.
        extra_gap: if classes.ranked.is_empty() {
            0.0
        } else {
            RING_RADIUS - 3.0
        },
    };
    for label in place_notes(&labels, &obstacles, [plot.left, plot.top, right, plot.bottom()]) {
        scene.area(VectorPath::rectangle(label.bounds()), Paint::Paper, 0.65);
        scene.text(label);
    }
}

/// The marks of device classes; empty if there is only one.
pub(super) struct ClassMarks {
    /// Class of each device.
    class_of: Vec<u16>,
    /// Index, name and number of devices of each class that has devices, the most frequent first.
    ranked: Vec<(u16, String, usize)>,
}

impl ClassMarks {
    pub(super) fn new(scenario: &Scenario) -> Self {
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

    /// Returns the radius that the mark of `device` needs, with its class ring if it has one.
    pub(super) fn radius(&self, device: usize, symbol_radius: f64) -> f64 {
        let ring = self.class_of.get(device).and_then(|class| self.ring(*class));
        ring.map_or(symbol_radius, |ring| RING_RADIUS + 0.5 * ring.width)
    }

    /// Draws the rings of the devices at `positions`.
    pub(super) fn draw_rings(&self, scene: &mut Scene, plot: &AreaPlot, positions: &[Point]) {
        for (p, class) in positions.iter().zip(&self.class_of) {
            if let Some(ring) = self.ring(*class) {
                scene.line(VectorPath::circle(plot.to_canvas(*p), RING_RADIUS), ring);
            }
        }
    }

    /// Draws a legend entry for each class, the first with the base line `y`: its ring around a dot, which stands for a
    /// device. Returns the base line of the text below.
    pub(super) fn draw_legend(&self, scene: &mut Scene, mut y: f64) -> f64 {
        for (index, name, devices) in &self.ranked {
            let centre = (MARGIN + 6.0, y - 0.35 * TEXT_SIZE);
            draw_dot(scene, centre);
            let mut text = format!("class {name} ({devices})");
            if let Some(ring) = self.ring(*index) {
                scene.line(VectorPath::circle(centre, RING_RADIUS), ring);
            } else {
                text.push_str(", no ring");
            }
            for line in wrap_text(&text, Weight::Regular, TEXT_SIZE, COLUMN_WIDTH - 2.0 * MARGIN - 14.0) {
                scene.text(Text::new(line, (MARGIN + 14.0, y), TEXT_SIZE));
                y += LEADING + 2.0;
            }
        }
        y + if self.ranked.is_empty() { 0.0 } else { 3.0 }
    }
}

/// Draws the dot of a device without another symbol.
pub(super) fn draw_dot(scene: &mut Scene, at: (f64, f64)) {
    scene.area(VectorPath::circle(at, DOT_RADIUS), Paint::Ink, 1.0);
}

/// Radius of the dot of a device, points.
pub(super) const DOT_RADIUS: f64 = 1.7;
