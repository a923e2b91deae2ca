//! Figure of a tuning: the surrogate of the objective over (μ1, μ2), and the evaluated pairs.
//!
//! Colours run from dark to light, so that they can be read in print without colours.

use reveille_lab::tuning::{History, Ranges, Surface, WeightPair};

use super::contour::segments;
use super::font::{Weight, width, wrap};
use super::heat::{blend, contrast_colour};
use super::path::{Rect, VectorPath, overlap};
use super::scale::{AxisTick, Scale, label};
use super::scene::{Anchor, Paint, Rgb, Scene, Stroke, Text};
use super::style::{EDGE, LARGE, LEADING, MarkerShape, SMALL, WIDE};

/// Left, top, right and bottom of the panel, points.
const PANEL: Rect = [46.0, 28.0, 376.0, 286.0];
/// Left and width of the key, points.
const KEY: (f64, f64) = (392.0, 14.0);
/// Number of colour steps in the key.
const STEPS: u32 = 60;
/// Half the size of the mark of a pair, and of the mark of the best pair, points.
const DOT: f64 = 2.0;
const STAR: f64 = 4.6;
/// Possible distances of a number from its pair, points.
const REACHES: [f64; 7] = [9.0, 13.0, 18.0, 25.0, 34.0, 46.0, 60.0];
/// Number of possible directions of a number from its pair.
const TURNS: u32 = 16;
/// Least distance of a contour's label from other items, points.
const CLEAR: f64 = 3.0;

/// Draws `history`, whose surrogate over `ranges` is `surface`.
pub fn scene(history: &History, ranges: &Ranges, surface: &Surface) -> Scene {
    let mut scene = Scene::new(WIDE, 0.0);
    let (objective, devices) = (history.header_value("objective"), history.header_value("devices"));
    let name = objective.split(':').next().unwrap_or_default();
    scene.title = format!("Tuning of q-learning with N = {devices}: objective {name}");
    scene.description = caption(history);
    scene.text(Text::new(scene.title.clone(), (EDGE, EDGE + LARGE), LARGE).bold());
    let panel = Panel::new(ranges, surface);
    panel.cells(&mut scene, surface);
    // Numbers are placed first, so that the labels of contours avoid them, and drawn last.
    let mut front = Scene::new(WIDE, 0.0);
    let taken = panel.points(&mut front, history);
    panel.contours(&mut scene, surface, taken);
    scene.put(front, (0.0, 0.0));
    panel.axes(&mut scene);
    panel.key(&mut scene, history);
    let mut y = PANEL[3] + 3.0 * LEADING + 8.0;
    for line in wrap(&scene.description.clone(), Weight::Regular, SMALL, WIDE - 2.0 * EDGE) {
        scene.text(Text::new(line, (EDGE, y), SMALL));
        y += LEADING;
    }
    scene.height = (y - LEADING + 0.24 * SMALL + EDGE).ceil();
    scene
}

fn caption(history: &History) -> String {
    let says = |name: &str| history.header_value(name).to_owned();
    let best = history.ranked().first().map(|&number| {
        let point = &history.points[number];
        let [mu1, mu2] = point.weights;
        format!(
            " The best is number {}: μ1 = {mu1}, μ2 = {mu2}, objective {}.",
            number + 1,
            label(point.evaluation.objective, 0.0001)
        )
    });
    format!(
        "The tuning maximises the objective, {}. Colours and lines are the mean of a Gaussian process through the \
         evaluated pairs, which are numbered in order; it is reliable only near them.{} For each pair, tables were \
         trained ({}) and measured ({}), all with the same seeds. Ranking {}, preset {}, seed {}.",
        says("objective").split_once(": ").map_or("", |(_, words)| words),
        best.unwrap_or_default(),
        says("training"),
        says("evaluation"),
        says("ranking"),
        says("preset"),
        says("seed")
    )
}

fn grown([left, top, right, bottom]: Rect, by: f64) -> Rect {
    [left - by, top - by, right + by, bottom + by]
}

/// Scales of the panel, and the range of values.
struct Panel {
    x: Scale,
    y: Scale,
    values: (f64, f64),
}

impl Panel {
    fn new(ranges: &Ranges, surface: &Surface) -> Self {
        let log = |(from, to): (f64, f64)| Scale::Log { from, to };
        let values = surface.rows.iter().flatten();
        let ends = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| {
            (low.min(*value), high.max(*value))
        });
        Self {
            x: log(ranges.mu1),
            y: log(ranges.mu2),
            values: ends,
        }
    }

    /// Maps a point of the unit square to the canvas.
    fn at((x, y): (f64, f64)) -> (f64, f64) {
        let [left, top, right, bottom] = PANEL;
        (left + x * (right - left), bottom - y * (bottom - top))
    }

    fn position(&self, [mu1, mu2]: WeightPair) -> (f64, f64) {
        Self::at((self.x.place(mu1), self.y.place(mu2)))
    }

    fn colour(&self, value: f64) -> Rgb {
        let (low, high) = self.values;
        let share = if high > low { (value - low) / (high - low) } else { 0.5 };
        blend(2.0 * share.clamp(0.0, 1.0) - 1.0)
    }

    fn levels(&self) -> (Vec<AxisTick>, f64) {
        let (low, high) = self.values;
        let ticks = Scale::Linear {
            from: low,
            to: if high > low { high } else { low + 1.0 },
        }
        .ticks();
        let step = ticks.get(1).map_or(1.0, |second| second.value - ticks[0].value);
        (ticks, step)
    }

    fn cells(&self, scene: &mut Scene, surface: &Surface) {
        // The cells overlap slightly to avoid gaps between them.
        let over = 0.3;
        let high = surface.rows.len() as f64;
        for (j, row) in surface.rows.iter().enumerate() {
            for (i, value) in row.iter().enumerate() {
                let place = |i: usize, j: usize| Self::at((i as f64 / row.len() as f64, j as f64 / high));
                let ((left, bottom), (right, top)) = (place(i, j), place(i + 1, j + 1));
                let corners = [left, top, (right + over).min(PANEL[2]), (bottom + over).min(PANEL[3])];
                scene.area(VectorPath::rectangle(corners), Paint::Colour(self.colour(*value)), 1.0);
            }
        }
    }

    /// Draws the pairs with their numbers. Returns the boxes around them.
    fn points(&self, scene: &mut Scene, history: &History) -> Vec<Rect> {
        let best = history.ranked().first().copied();
        let places: Vec<(f64, f64)> = history
            .points
            .iter()
            .map(|point| self.position(point.weights))
            .collect();
        let marks = places.iter().enumerate().map(|(number, &(x, y))| {
            let size = if best == Some(number) { 1.4 * STAR } else { DOT + 0.8 };
            [x - size, y - size, x + size, y + size]
        });
        let mut taken: Vec<Rect> = marks.collect();
        let mut numbers = Vec::new();
        for (number, place) in places.iter().enumerate() {
            let text = (number + 1).to_string();
            let (at, corners) = free(*place, &text, &taken);
            taken.push(corners);
            let (dx, dy) = (at.0 - place.0, at.1 - place.1);
            if (dx * dx + dy * dy).sqrt() > REACHES[1] + 1.0 {
                // A line in both paints is visible on dark and on light.
                scene.line(
                    VectorPath::segment(*place, at),
                    Stroke::solid(Paint::Colour(Rgb(255, 255, 255)), 1.4),
                );
                scene.line(
                    VectorPath::segment(*place, at),
                    Stroke::solid(Paint::Colour(Rgb(0, 0, 0)), 0.6),
                );
            }
            numbers.push((text, at, corners));
        }
        for (number, place) in places.iter().enumerate() {
            mark(scene, *place, best == Some(number));
        }
        for (number, (text, at, corners)) in numbers.into_iter().enumerate() {
            scene.area(VectorPath::rectangle(corners), Paint::Colour(Rgb(255, 255, 255)), 0.85);
            let mut text = Text::new(text, (at.0, at.1 + 0.36 * SMALL), SMALL).anchored(Anchor::Middle);
            text.paint = Paint::Colour(Rgb(0, 0, 0));
            scene.text(if best == Some(number) { text.bold() } else { text });
        }
        taken
    }

    /// Draws the contour lines, each with its value if there is room.
    fn contours(&self, scene: &mut Scene, surface: &Surface, mut taken: Vec<Rect>) {
        let (levels, step) = self.levels();
        let mut labels = Vec::new();
        for level in levels {
            let all = segments(&surface.rows, level.value);
            let mut path = VectorPath::default();
            for (from, to) in &all {
                path.extend(VectorPath::segment(Self::at(*from), Self::at(*to)));
            }
            if path.0.is_empty() {
                continue;
            }
            let ground = self.colour(level.value);
            scene.line(path, Stroke::solid(contrast_colour(ground), 0.8));
            let text = label(level.value, step);
            let half = 0.5 * width(&text, Weight::Regular, SMALL) + 1.5;
            let boxes = all.iter().map(|(a, b)| {
                let (x, y) = Self::at((0.5 * (a.0 + b.0), 0.5 * (a.1 + b.1)));
                ((x, y), [x - half, y - 0.6 * SMALL, x + half, y + 0.6 * SMALL])
            });
            let room = boxes.filter(|(_, corners)| within(corners)).map(|(at, corners)| {
                let gaps = taken.iter().map(|other| gap(&corners, other));
                (gaps.fold(f64::INFINITY, f64::min), at, corners)
            });
            let widest = room.max_by(|a, b| a.0.total_cmp(&b.0));
            if let Some((_, at, corners)) = widest.filter(|(gap, ..)| *gap >= CLEAR) {
                taken.push(corners);
                labels.push((text, at, corners, ground));
            }
        }
        for (text, at, corners, ground) in labels {
            scene.area(VectorPath::rectangle(corners), Paint::Colour(ground), 1.0);
            let mut text = Text::new(text, (at.0, at.1 + 0.36 * SMALL), SMALL).anchored(Anchor::Middle);
            text.paint = contrast_colour(ground);
            scene.text(text);
        }
    }

    fn axes(&self, scene: &mut Scene) {
        let [left, top, right, bottom] = PANEL;
        let axis = Stroke::solid(Paint::Ink, 0.7);
        for tick in ticks(self.x) {
            let (x, long) = (Self::at((self.x.place(tick.value), 0.0)).0, long(&tick));
            scene.line(VectorPath::segment((x, bottom), (x, bottom + long)), axis);
            let text = Text::new(tick.label, (x, bottom + LEADING + 1.5), SMALL);
            scene.text(text.anchored(Anchor::Middle));
        }
        for tick in ticks(self.y) {
            let (y, long) = (Self::at((0.0, self.y.place(tick.value))).1, long(&tick));
            scene.line(VectorPath::segment((left - long, y), (left, y)), axis);
            let text = Text::new(tick.label, (left - 5.0, y + 0.36 * SMALL), SMALL);
            scene.text(text.anchored(Anchor::End));
        }
        scene.line(VectorPath::rectangle(PANEL), axis);
        let below = (0.5 * (left + right), bottom + 2.0 * LEADING + 3.0);
        scene.text(Text::new("μ1, weight of misdetections (logarithmic)", below, SMALL).anchored(Anchor::Middle));
        let label_position = (EDGE + 0.76 * SMALL, 0.5 * (top + bottom));
        let mut text =
            Text::new("μ2, weight of information (logarithmic)", label_position, SMALL).anchored(Anchor::Middle);
        text.upwards = true;
        scene.text(text);
    }

    /// Draws the key: the colour scale with values, and the meaning of marks.
    fn key(&self, scene: &mut Scene, history: &History) {
        let ((left, wide), [_, top, _, bottom]) = (KEY, PANEL);
        let top = top + 2.0 * LEADING + 48.0;
        let (low, high) = self.values;
        let place = |share: f64| bottom - share * (bottom - top);
        for i in 0..STEPS {
            let share = |i: f64| i / f64::from(STEPS);
            let (from, to) = (place(share(f64::from(i))), place(share(f64::from(i) + 1.0)));
            let value = low + share(f64::from(i) + 0.5) * (high - low);
            let corners = [left, to, left + wide, (from + 0.3).min(bottom)];
            scene.area(VectorPath::rectangle(corners), Paint::Colour(self.colour(value)), 1.0);
        }
        let line = Stroke::solid(Paint::Ink, 0.5);
        scene.line(VectorPath::rectangle([left, top, left + wide, bottom]), line);
        let (levels, step) = self.levels();
        for level in levels.iter().filter(|_| high > low) {
            let y = place((level.value - low) / (high - low));
            scene.line(VectorPath::segment((left + wide, y), (left + wide + 2.5, y)), line);
            scene.text(Text::new(
                label(level.value, step),
                (left + wide + 5.0, y + 0.36 * SMALL),
                SMALL,
            ));
        }
        scene.text(Text::new("objective (mean)", (left, top - 5.0), SMALL));
        let mut y = PANEL[1] + 0.76 * SMALL;
        for (is_best, words) in [(false, "evaluated pair, its number"), (true, "best pair")] {
            if is_best && history.points.is_empty() {
                continue;
            }
            mark(scene, (left + 6.0, y - 0.36 * SMALL), is_best);
            scene.text(Text::new(words, (left + 17.0, y), SMALL));
            y += LEADING + 4.0;
        }
    }
}

/// Adds the mark of a pair to `scene`.
fn mark(scene: &mut Scene, at: (f64, f64), is_best: bool) {
    let (paper, ink) = (Paint::Colour(Rgb(255, 255, 255)), Paint::Colour(Rgb(0, 0, 0)));
    if is_best {
        scene.outlined(MarkerShape::Star.path(at, STAR), paper, Stroke::solid(ink, 0.9));
    } else {
        scene.outlined(MarkerShape::Circle.path(at, DOT), ink, Stroke::solid(paper, 0.8));
    }
}

/// Finds a position for the middle of `text` near `place`, clear of all `taken` boxes. Returns it with the text's box.
fn free(place: (f64, f64), text: &str, taken: &[Rect]) -> ((f64, f64), Rect) {
    let half = 0.5 * width(text, Weight::Regular, SMALL) + 1.2;
    let candidates = REACHES.iter().flat_map(|reach| {
        (0..TURNS).map(move |turn| {
            let angle = std::f64::consts::TAU * f64::from(turn) / f64::from(TURNS);
            let at = (place.0 + reach * libm::cos(angle), place.1 - reach * libm::sin(angle));
            let corners = [at.0 - half, at.1 - 0.56 * SMALL, at.0 + half, at.1 + 0.56 * SMALL];
            (at, corners)
        })
    });
    let mut fitting = candidates
        .clone()
        .filter(|(_, corners)| within(corners) && !taken.iter().any(|other| overlap(&grown(*corners, 0.6), other)));
    // Without any free position, an overlap cannot be avoided.
    fitting
        .next()
        .or_else(|| candidates.clone().next())
        .expect("there are candidates")
}

/// Returns whether a box lies in the panel.
fn within(corners: &Rect) -> bool {
    let [left, top, right, bottom] = grown(PANEL, -2.0);
    corners[0] >= left && corners[1] >= top && corners[2] <= right && corners[3] <= bottom
}

/// Returns the distance between two boxes, negative if they overlap.
fn gap(a: &Rect, b: &Rect) -> f64 {
    let apart = |low: usize, high: usize| (b[low] - a[high]).max(a[low] - b[high]);
    apart(0, 2).max(apart(1, 3))
}

const fn long(tick: &AxisTick) -> f64 {
    if tick.label.is_empty() { 1.8 } else { 3.0 }
}

/// Returns the ticks of a logarithmic axis with arbitrary ends. Multiples of powers of ten by 1, 2 and 5 have labels.
/// If there are few of these, all ticks have labels.
fn ticks(scale: Scale) -> Vec<AxisTick> {
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
            label(value, power.min(1.0))
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
    fn ticks_fit_any_ends() {
        let labels = |from: f64, to: f64| -> Vec<String> {
            let all = ticks(Scale::Log { from, to });
            all.into_iter().map(|t| t.label).filter(|l| !l.is_empty()).collect()
        };
        assert_eq!(labels(0.5, 20.0), ["0.5", "1", "2", "5", "10", "20"]);
        assert_eq!(labels(1.0, 5.0), ["1", "2", "3", "4", "5"]);
        assert_eq!(labels(0.05, 3.0), ["0.05", "0.1", "0.2", "0.5", "1", "2"]);
    }
}
