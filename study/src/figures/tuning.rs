//! Figure of a tuning: the surrogate of the objective over (μ1, μ2), and the evaluated pairs. `reveille tune` draws it.
//!
//! Colours run from dark to light, so that they can be read in print without colours. The figure reads the header of
//! the history by the names that `TuningPlan::header` writes, and expects `NAME: DESCRIPTION` as objective.

use reveille_lab::tuning::{History, Ranges, Surface, WeightPair};

use super::contour::contour_segments;
use super::font::{Weight, text_width, wrap_text};
use super::heat::{colour_at, contrast_colour};
use super::path::{Rect, VectorPath, boxes_overlap};
use super::scale::{AxisTick, Scale, format_with_step};
use super::scene::{Anchor, Paint, Rgb, Scene, Stroke, Text};
use super::style::{LEADING, MARGIN, MarkerShape, PAGE_WIDTH, TEXT_SIZE, TITLE_SIZE};

/// Left, top, right and bottom of the panel, points.
const PANEL_BOX: Rect = [46.0, 28.0, 376.0, 286.0];
/// Left edge of the key, and width of its colour scale, points.
const KEY_LEFT: f64 = 392.0;
const KEY_WIDTH: f64 = 14.0;
/// Number of colour steps in the key.
const KEY_STEPS: u32 = 60;
/// Half the size of the mark of a pair, and of the mark of the best pair, points.
const PAIR_RADIUS: f64 = 2.0;
const BEST_PAIR_RADIUS: f64 = 4.6;
/// Possible distances of a number from its pair, points.
const NUMBER_DISTANCES: [f64; 7] = [9.0, 13.0, 18.0, 25.0, 34.0, 46.0, 60.0];
/// Number of possible directions of a number from its pair.
const NUMBER_DIRECTIONS: u32 = 16;
/// Least distance of a contour's label from other items, points.
const MIN_LABEL_GAP: f64 = 3.0;

/// Draws `history`, whose surrogate over its `ranges` is `surface`. A pair outside `ranges` is drawn on the border.
pub fn scene(history: &History, ranges: &Ranges, surface: &Surface) -> Scene {
    let mut scene = Scene::new(PAGE_WIDTH, 0.0);
    let (objective, devices) = (history.header_value("objective"), history.header_value("devices"));
    let name = objective.split(':').next().unwrap_or_default();
    scene.title = format!("Tuning of q-learning with N = {devices}: objective {name}");
    scene.description = caption(history);
    scene.text(Text::new(scene.title.clone(), (MARGIN, MARGIN + TITLE_SIZE), TITLE_SIZE).bold());
    let panel = SurfacePanel::new(ranges, surface);
    panel.draw_cells(&mut scene, surface);
    // Numbers are placed first, so that the labels of contours avoid them, and drawn last.
    let mut pairs_scene = Scene::new(PAGE_WIDTH, 0.0);
    let taken_boxes = panel.draw_pairs(&mut pairs_scene, history);
    panel.draw_contours(&mut scene, surface, taken_boxes);
    scene.add_scene(pairs_scene, (0.0, 0.0));
    panel.draw_axes(&mut scene);
    panel.draw_key(&mut scene, history);
    let mut y = PANEL_BOX[3] + 3.0 * LEADING + 8.0;
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

fn caption(history: &History) -> String {
    let header = |name: &str| history.header_value(name).to_owned();
    let best = history.ranked().first().map(|&number| {
        let point = &history.points[number];
        let [mu1, mu2] = point.weights;
        format!(
            " The best is number {}: μ1 = {mu1}, μ2 = {mu2}, objective {}.",
            number + 1,
            format_with_step(point.evaluation.objective, 0.0001)
        )
    });
    format!(
        "The tuning maximises the objective, {}. Colours and lines are the mean of a Gaussian process through the \
         evaluated pairs, numbered in order from 1 (the history counts from 0); it is reliable only near them.{} For \
         each pair, tables were trained ({}) and measured ({}), all with the same seeds. Ranking {}, preset {}, seed \
         {}.",
        header("objective").split_once(": ").map_or("", |(_, words)| words),
        best.unwrap_or_default(),
        header("training"),
        header("evaluation"),
        header("ranking"),
        header("preset"),
        header("seed")
    )
}

fn enlarge([left, top, right, bottom]: Rect, by: f64) -> Rect {
    [left - by, top - by, right + by, bottom + by]
}

/// Scales of the panel, and the range of the surrogate's values.
struct SurfacePanel {
    /// Scale of μ1.
    x: Scale,
    /// Scale of μ2.
    y: Scale,
    value_range: (f64, f64),
}

impl SurfacePanel {
    fn new(ranges: &Ranges, surface: &Surface) -> Self {
        let log = |(from, to): (f64, f64)| Scale::Log { from, to };
        let values = surface.rows.iter().flatten();
        let ends = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| {
            (low.min(*value), high.max(*value))
        });
        Self {
            x: log(ranges.mu1),
            y: log(ranges.mu2),
            value_range: ends,
        }
    }

    /// Maps a point of the unit square to the canvas.
    fn unit_square_to_canvas((x, y): (f64, f64)) -> (f64, f64) {
        let [left, top, right, bottom] = PANEL_BOX;
        (left + x * (right - left), bottom - y * (bottom - top))
    }

    fn position(&self, [mu1, mu2]: WeightPair) -> (f64, f64) {
        Self::unit_square_to_canvas((self.x.position(mu1), self.y.position(mu2)))
    }

    fn colour(&self, value: f64) -> Rgb {
        let (low, high) = self.value_range;
        let share = if high > low { (value - low) / (high - low) } else { 0.5 };
        colour_at(2.0 * share.clamp(0.0, 1.0) - 1.0)
    }

    /// Returns the levels of the contour lines and of the key, and the step between them.
    fn contour_levels(&self) -> (Vec<AxisTick>, f64) {
        let (low, high) = self.value_range;
        let ticks = Scale::Linear {
            from: low,
            to: if high > low { high } else { low + 1.0 },
        }
        .ticks();
        let step = ticks.get(1).map_or(1.0, |second| second.value - ticks[0].value);
        (ticks, step)
    }

    fn draw_cells(&self, scene: &mut Scene, surface: &Surface) {
        // The cells overlap slightly to avoid gaps between them.
        let overlap = 0.3;
        let row_count = surface.rows.len() as f64;
        for (j, row) in surface.rows.iter().enumerate() {
            for (i, value) in row.iter().enumerate() {
                let corner = |i: usize, j: usize| {
                    Self::unit_square_to_canvas((i as f64 / row.len() as f64, j as f64 / row_count))
                };
                let ((left, bottom), (right, top)) = (corner(i, j), corner(i + 1, j + 1));
                let corners = [
                    left,
                    top,
                    (right + overlap).min(PANEL_BOX[2]),
                    (bottom + overlap).min(PANEL_BOX[3]),
                ];
                scene.area(VectorPath::rectangle(corners), Paint::Colour(self.colour(*value)), 1.0);
            }
        }
    }

    /// Draws the pairs with their numbers, from 1 in order of evaluation. Returns the boxes around both.
    fn draw_pairs(&self, scene: &mut Scene, history: &History) -> Vec<Rect> {
        let best = history.ranked().first().copied();
        let positions: Vec<(f64, f64)> = history
            .points
            .iter()
            .map(|point| self.position(point.weights))
            .collect();
        let marks = positions.iter().enumerate().map(|(number, &(x, y))| {
            let size = if best == Some(number) {
                1.4 * BEST_PAIR_RADIUS
            } else {
                PAIR_RADIUS + 0.8
            };
            [x - size, y - size, x + size, y + size]
        });
        let mut taken_boxes: Vec<Rect> = marks.collect();
        let mut numbers = Vec::new();
        for (number, position) in positions.iter().enumerate() {
            let text = (number + 1).to_string();
            let (at, corners) = free_position(*position, &text, &taken_boxes);
            taken_boxes.push(corners);
            let (dx, dy) = (at.0 - position.0, at.1 - position.1);
            if (dx * dx + dy * dy).sqrt() > NUMBER_DISTANCES[1] + 1.0 {
                // A line in both paints is visible on dark and on light.
                scene.line(
                    VectorPath::segment(*position, at),
                    Stroke::solid(Paint::Colour(Rgb(255, 255, 255)), 1.4),
                );
                scene.line(
                    VectorPath::segment(*position, at),
                    Stroke::solid(Paint::Colour(Rgb(0, 0, 0)), 0.6),
                );
            }
            numbers.push((text, at, corners));
        }
        for (number, position) in positions.iter().enumerate() {
            draw_pair_mark(scene, *position, best == Some(number));
        }
        for (number, (text, at, corners)) in numbers.into_iter().enumerate() {
            scene.area(VectorPath::rectangle(corners), Paint::Colour(Rgb(255, 255, 255)), 0.85);
            let mut text = Text::new(text, (at.0, at.1 + 0.36 * TEXT_SIZE), TEXT_SIZE).anchored(Anchor::Middle);
            text.paint = Paint::Colour(Rgb(0, 0, 0));
            scene.text(if best == Some(number) { text.bold() } else { text });
        }
        taken_boxes
    }

    /// Draws the contour lines, each with its value where it is farthest from `taken_boxes`, if there is room.
    fn draw_contours(&self, scene: &mut Scene, surface: &Surface, mut taken_boxes: Vec<Rect>) {
        let (levels, step) = self.contour_levels();
        let mut labels = Vec::new();
        for level in levels {
            let segments = contour_segments(&surface.rows, level.value);
            let mut path = VectorPath::default();
            for (from, to) in &segments {
                path.extend(VectorPath::segment(
                    Self::unit_square_to_canvas(*from),
                    Self::unit_square_to_canvas(*to),
                ));
            }
            if path.0.is_empty() {
                continue;
            }
            let background = self.colour(level.value);
            scene.line(path, Stroke::solid(contrast_colour(background), 0.8));
            let text = format_with_step(level.value, step);
            let half_width = 0.5 * text_width(&text, Weight::Regular, TEXT_SIZE) + 1.5;
            let boxes = segments.iter().map(|(a, b)| {
                let (x, y) = Self::unit_square_to_canvas((0.5 * (a.0 + b.0), 0.5 * (a.1 + b.1)));
                (
                    (x, y),
                    [x - half_width, y - 0.6 * TEXT_SIZE, x + half_width, y + 0.6 * TEXT_SIZE],
                )
            });
            let candidates = boxes.filter(|(_, corners)| is_in_panel(corners)).map(|(at, corners)| {
                let gaps = taken_boxes.iter().map(|other| distance_between(&corners, other));
                (gaps.fold(f64::INFINITY, f64::min), at, corners)
            });
            let most_distant = candidates.max_by(|a, b| a.0.total_cmp(&b.0));
            if let Some((_, at, corners)) = most_distant.filter(|(gap, ..)| *gap >= MIN_LABEL_GAP) {
                taken_boxes.push(corners);
                labels.push((text, at, corners, background));
            }
        }
        for (text, at, corners, background) in labels {
            scene.area(VectorPath::rectangle(corners), Paint::Colour(background), 1.0);
            let mut text = Text::new(text, (at.0, at.1 + 0.36 * TEXT_SIZE), TEXT_SIZE).anchored(Anchor::Middle);
            text.paint = contrast_colour(background);
            scene.text(text);
        }
    }

    fn draw_axes(&self, scene: &mut Scene) {
        let [left, top, right, bottom] = PANEL_BOX;
        let axis = Stroke::solid(Paint::Ink, 0.7);
        for tick in log_ticks_within(self.x) {
            let (x, length) = (
                Self::unit_square_to_canvas((self.x.position(tick.value), 0.0)).0,
                tick_length(&tick),
            );
            scene.line(VectorPath::segment((x, bottom), (x, bottom + length)), axis);
            let text = Text::new(tick.label, (x, bottom + LEADING + 1.5), TEXT_SIZE);
            scene.text(text.anchored(Anchor::Middle));
        }
        for tick in log_ticks_within(self.y) {
            let (y, length) = (
                Self::unit_square_to_canvas((0.0, self.y.position(tick.value))).1,
                tick_length(&tick),
            );
            scene.line(VectorPath::segment((left - length, y), (left, y)), axis);
            let text = Text::new(tick.label, (left - 5.0, y + 0.36 * TEXT_SIZE), TEXT_SIZE);
            scene.text(text.anchored(Anchor::End));
        }
        scene.line(VectorPath::rectangle(PANEL_BOX), axis);
        let below = (0.5 * (left + right), bottom + 2.0 * LEADING + 3.0);
        scene.text(Text::new("μ1, weight of misdetections (logarithmic)", below, TEXT_SIZE).anchored(Anchor::Middle));
        let label_position = (MARGIN + 0.76 * TEXT_SIZE, 0.5 * (top + bottom));
        let mut text =
            Text::new("μ2, weight of information (logarithmic)", label_position, TEXT_SIZE).anchored(Anchor::Middle);
        text.is_vertical = true;
        scene.text(text);
    }

    /// Draws the key: the colour scale with values, and the meaning of marks.
    fn draw_key(&self, scene: &mut Scene, history: &History) {
        let (left, right) = (KEY_LEFT, KEY_LEFT + KEY_WIDTH);
        let [_, panel_top, _, bottom] = PANEL_BOX;
        // The meaning of marks and the heading are above the colour scale.
        let top = panel_top + 2.0 * LEADING + 48.0;
        let (low, high) = self.value_range;
        let place = |share: f64| bottom - share * (bottom - top);
        for i in 0..KEY_STEPS {
            let share = |i: f64| i / f64::from(KEY_STEPS);
            let (from, to) = (place(share(f64::from(i))), place(share(f64::from(i) + 1.0)));
            let value = low + share(f64::from(i) + 0.5) * (high - low);
            let corners = [left, to, right, (from + 0.3).min(bottom)];
            scene.area(VectorPath::rectangle(corners), Paint::Colour(self.colour(value)), 1.0);
        }
        let line = Stroke::solid(Paint::Ink, 0.5);
        scene.line(VectorPath::rectangle([left, top, right, bottom]), line);
        let (levels, step) = self.contour_levels();
        for level in levels.iter().filter(|_| high > low) {
            let y = place((level.value - low) / (high - low));
            scene.line(VectorPath::segment((right, y), (right + 2.5, y)), line);
            scene.text(Text::new(
                format_with_step(level.value, step),
                (right + 5.0, y + 0.36 * TEXT_SIZE),
                TEXT_SIZE,
            ));
        }
        scene.text(Text::new("objective (mean)", (left, top - 5.0), TEXT_SIZE));
        let mut y = panel_top + 0.76 * TEXT_SIZE;
        for (is_best, words) in [(false, "evaluated pair, its number"), (true, "best pair")] {
            if is_best && history.points.is_empty() {
                continue;
            }
            draw_pair_mark(scene, (left + 6.0, y - 0.36 * TEXT_SIZE), is_best);
            scene.text(Text::new(words, (left + 17.0, y), TEXT_SIZE));
            y += LEADING + 4.0;
        }
    }
}

/// Adds the mark of a pair to `scene`.
fn draw_pair_mark(scene: &mut Scene, at: (f64, f64), is_best: bool) {
    let (paper, ink) = (Paint::Colour(Rgb(255, 255, 255)), Paint::Colour(Rgb(0, 0, 0)));
    if is_best {
        scene.outlined_area(
            MarkerShape::Star.path(at, BEST_PAIR_RADIUS),
            paper,
            Stroke::solid(ink, 0.9),
        );
    } else {
        scene.outlined_area(
            MarkerShape::Circle.path(at, PAIR_RADIUS),
            ink,
            Stroke::solid(paper, 0.8),
        );
    }
}

/// Finds a position for the middle of `text` near `pair_position`, clear of all `taken_boxes` if possible. Also
/// returns the text's box.
fn free_position(pair_position: (f64, f64), text: &str, taken_boxes: &[Rect]) -> ((f64, f64), Rect) {
    let half_width = 0.5 * text_width(text, Weight::Regular, TEXT_SIZE) + 1.2;
    let candidates = NUMBER_DISTANCES.iter().flat_map(|distance| {
        (0..NUMBER_DIRECTIONS).map(move |direction| {
            let angle = std::f64::consts::TAU * f64::from(direction) / f64::from(NUMBER_DIRECTIONS);
            let at = (
                pair_position.0 + distance * libm::cos(angle),
                pair_position.1 - distance * libm::sin(angle),
            );
            let corners = [
                at.0 - half_width,
                at.1 - 0.56 * TEXT_SIZE,
                at.0 + half_width,
                at.1 + 0.56 * TEXT_SIZE,
            ];
            (at, corners)
        })
    });
    let mut free_positions = candidates.clone().filter(|(_, corners)| {
        is_in_panel(corners)
            && !taken_boxes
                .iter()
                .any(|other| boxes_overlap(&enlarge(*corners, 0.6), other))
    });
    // Without any free position, an overlap cannot be avoided.
    free_positions
        .next()
        .or_else(|| candidates.clone().next())
        .expect("there are candidates")
}

/// Returns whether a box lies in the panel.
fn is_in_panel(corners: &Rect) -> bool {
    let [left, top, right, bottom] = enlarge(PANEL_BOX, -2.0);
    corners[0] >= left && corners[1] >= top && corners[2] <= right && corners[3] <= bottom
}

/// Returns the distance between two boxes, negative if they overlap.
fn distance_between(a: &Rect, b: &Rect) -> f64 {
    let apart = |low: usize, high: usize| (b[low] - a[high]).max(a[low] - b[high]);
    apart(0, 2).max(apart(1, 3))
}

const fn tick_length(tick: &AxisTick) -> f64 {
    if tick.label.is_empty() { 1.8 } else { 3.0 }
}

/// Returns the ticks of a logarithmic axis with arbitrary ends, for which [`Scale::ticks`] is not meant. Multiples of
/// powers of ten by 1, 2 and 5 have labels. If there are few of these, all ticks have labels.
fn log_ticks_within(scale: Scale) -> Vec<AxisTick> {
    let (from, to) = scale.ends();
    let powers = libm::floor(libm::log10(from)) as i32..=libm::floor(libm::log10(to)) as i32;
    let all = powers.flat_map(|n| (1..10).map(move |factor| (factor, libm::exp10(f64::from(n)))));
    let inside = all.filter(|(factor, power)| {
        let value = f64::from(*factor) * power;
        value >= from * (1.0 - 1e-9) && value <= to * (1.0 + 1e-9)
    });
    let inside: Vec<(i32, f64)> = inside.collect();
    let is_round = |factor: i32| matches!(factor, 1 | 2 | 5);
    let are_few = inside.iter().filter(|(factor, _)| is_round(*factor)).count() < 4 && inside.len() < 8;
    let ticks = inside.iter().map(|&(factor, power)| {
        let value = f64::from(factor) * power;
        let text = if are_few || is_round(factor) {
            format_with_step(value, power.min(1.0))
        } else {
            String::new()
        };
        AxisTick { value, label: text }
    });
    ticks.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_between_any_ends() {
        let labels = |from: f64, to: f64| -> Vec<String> {
            let ticks = super::log_ticks_within(Scale::Log { from, to });
            ticks
                .into_iter()
                .map(|tick| tick.label)
                .filter(|label| !label.is_empty())
                .collect()
        };
        assert_eq!(labels(0.5, 20.0), ["0.5", "1", "2", "5", "10", "20"]);
        assert_eq!(labels(1.0, 5.0), ["1", "2", "3", "4", "5"]);
        assert_eq!(labels(0.05, 3.0), ["0.05", "0.1", "0.2", "0.5", "1", "2"]);
    }
}
