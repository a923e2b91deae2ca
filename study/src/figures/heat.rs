//! Heat maps: a colour and a number in every cell, zero in the middle of the colours.
//!
//! The colours run from dark blue through grey to light yellow: they grow lighter throughout, so that they mean the
//! same in print without colours, and the colour-blind tell them apart.

use libm::sqrt;

use super::chart::hatching;
use super::font::{Weight, width};
use super::layout::{LEADING, SMALL};
use super::path::Path;
use super::scale::label;
use super::scene::{Anchor, Paint, Rgb, Scene, Stroke, Text};

/// The colours from the least value to the largest, evenly.
const RAMP: [Rgb; 5] = [
    Rgb(0x00, 0x22, 0x4E),
    Rgb(0x3D, 0x4B, 0x70),
    Rgb(0x86, 0x86, 0x86),
    Rgb(0xC6, 0xB8, 0x68),
    Rgb(0xFE, 0xE8, 0x38),
];
/// The colour that numbers have on light cells, and that on dark ones.
const NUMBERS: [Rgb; 2] = [Rgb(0, 0, 0), Rgb(255, 255, 255)];
/// How light a colour must be for black numbers, as a share of white's luminance: there both are told apart as well.
const LIGHT: f64 = 0.18;
/// The size of the mark of cells that are known in part, points.
const CORNER: f64 = 4.5;
/// The line around what is framed.
const BORDER: f64 = 1.8;

/// How well a value is known.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Known {
    /// Not at all: it was never visited.
    Never,
    /// In part: of two actions one was never tried.
    Half,
    /// It was visited.
    Well,
}

/// One cell.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HeatCell {
    /// Its value.
    pub value: f64,
    /// How well it is known.
    pub known: Known,
    /// Whether a bold line goes around it and others.
    pub framed: bool,
}

/// What stands beside the rows.
#[derive(Clone, Debug, PartialEq)]
pub enum Rows {
    /// A name for each.
    Names(Vec<String>),
    /// Their ends, one more than there are rows.
    Ends(Vec<String>),
}

/// A heat map.
#[derive(Clone, Debug, PartialEq)]
pub struct HeatMap {
    /// What x is, with its unit.
    pub x_label: String,
    /// What y is, with its unit.
    pub y_label: String,
    /// The ends of columns, one more than there are columns, in one or more units: what the unit is called, and the
    /// ends.
    pub columns: Vec<(String, Vec<String>)>,
    /// What stands beside the rows, from the lowest.
    pub rows: Rows,
    /// The cells by rows, from the lowest.
    pub cells: Vec<Vec<HeatCell>>,
}

/// Where the cells of a heat map are.
struct Grid<'a> {
    map: &'a HeatMap,
    left: f64,
    top: f64,
    cell: (f64, f64),
}

impl HeatMap {
    /// The largest magnitude of a value that is known.
    pub fn largest(&self) -> f64 {
        let cells = self.cells.iter().flatten().filter(|cell| cell.known != Known::Never);
        cells.map(|cell| cell.value.abs()).fold(0.0, f64::max)
    }

    /// How many cells are `known` so well.
    pub fn count(&self, known: Known) -> usize {
        self.cells.iter().flatten().filter(|cell| cell.known == known).count()
    }

    /// Puts it on `scene` with its upper left corner at `at`, `wide` points wide, rows `height` points high and
    /// ±`largest` at the ends of the colours. Gives the y below it.
    pub fn draw(&self, scene: &mut Scene, at: (f64, f64), (wide, height): (f64, f64), largest: f64) -> f64 {
        let measure = |text: &String| width(text, Weight::Regular, SMALL);
        let (Rows::Names(words) | Rows::Ends(words)) = &self.rows;
        let units = self.columns.iter().map(|(unit, _)| measure(unit) + 8.0);
        let widest = words.iter().map(measure).chain(units).fold(0.0, f64::max);
        let left = at.0 + LEADING + widest + 5.0;
        let columns = self.cells.first().map_or(1, Vec::len);
        let last = self.columns.iter().filter_map(|(_, ends)| ends.last());
        let beyond = last.map(measure).fold(0.0, f64::max) * 0.5;
        let grid = Grid {
            map: self,
            left,
            top: at.1,
            cell: ((at.0 + wide - beyond - left) / columns as f64, height),
        };
        for (row, cells) in self.cells.iter().enumerate() {
            for (column, cell) in cells.iter().enumerate() {
                grid.cell(scene, (row, column), cell, largest);
            }
        }
        grid.borders(scene);
        grid.labels(scene, at.0)
    }
}

impl Grid<'_> {
    /// Left, top, right, bottom of a cell.
    fn corners(&self, row: usize, column: usize) -> [f64; 4] {
        let (wide, high) = self.cell;
        let up = self.map.cells.len() - 1 - row;
        let (left, top) = (self.left + wide * column as f64, self.top + high * up as f64);
        [left, top, left + wide, top + high]
    }

    fn cell(&self, scene: &mut Scene, (row, column): (usize, usize), cell: &HeatCell, largest: f64) {
        let corners = self.corners(row, column);
        match cell.known {
            Known::Never => hatched(scene, corners),
            Known::Half | Known::Well => {
                let colour = colour(cell.value, largest);
                scene.area(Path::rectangle(corners), Paint::Colour(colour), 1.0);
                if cell.known == Known::Half {
                    corner(scene, corners, on(colour));
                }
                let at = (
                    0.5 * (corners[0] + corners[2]),
                    0.5 * (corners[1] + corners[3]) + 0.36 * SMALL,
                );
                let mut text = Text::new(number(cell.value), at, SMALL).anchored(Anchor::Middle);
                text.paint = on(colour);
                scene.text(text);
            }
        }
    }

    /// A thin line around everything, and a bold one around the cells that are framed.
    fn borders(&self, scene: &mut Scene) {
        let cells = &self.map.cells;
        let framed = |row: Option<usize>, column: Option<usize>| {
            let row = row.and_then(|row| cells.get(row));
            row.and_then(|row| column.and_then(|column| row.get(column)))
                .is_some_and(|cell| cell.framed)
        };
        let mut bold = Path::default();
        for row in 0..=cells.len() {
            for column in 0..=cells[0].len() {
                let here = framed(Some(row), Some(column));
                let (left, below) = (
                    framed(Some(row), column.checked_sub(1)),
                    framed(row.checked_sub(1), Some(column)),
                );
                let (wide, high) = self.cell;
                let x = self.left + wide * column as f64;
                let y = self.top + high * (cells.len() - row) as f64;
                if here != left {
                    bold.extend(Path::segment((x, y + 0.5 * BORDER), (x, y - high - 0.5 * BORDER)));
                }
                if here != below {
                    bold.extend(Path::segment((x - 0.5 * BORDER, y), (x + wide + 0.5 * BORDER, y)));
                }
            }
        }
        let [left, _, _, bottom] = self.corners(0, 0);
        let [_, top, right, _] = self.corners(cells.len() - 1, cells[0].len() - 1);
        scene.line(
            Path::rectangle([left, top, right, bottom]),
            Stroke::solid(Paint::Ink, 0.7),
        );
        if !bold.0.is_empty() {
            scene.line(bold, Stroke::solid(Paint::Ink, BORDER));
        }
    }

    fn labels(&self, scene: &mut Scene, edge: f64) -> f64 {
        let rows = self.map.cells.len();
        let beside =
            |text: &str, y: f64| Text::new(text, (self.left - 4.0, y + 0.36 * SMALL), SMALL).anchored(Anchor::End);
        match &self.map.rows {
            Rows::Names(names) => {
                for (row, name) in names.iter().enumerate() {
                    let [_, top, _, bottom] = self.corners(row, 0);
                    scene.text(beside(name, 0.5 * (top + bottom)));
                }
            }
            Rows::Ends(ends) => {
                for (row, end) in ends.iter().enumerate() {
                    scene.text(beside(end, self.top + self.cell.1 * (rows - row) as f64));
                }
            }
        }
        let bottom = self.top + self.cell.1 * rows as f64;
        // The lowest end of the rows stands half a line deeper than the cells.
        let mut y = bottom
            + LEADING
            + if matches!(self.map.rows, Rows::Ends(_)) {
                2.5
            } else {
                0.5
            };
        for (unit, ends) in &self.map.columns {
            if !unit.is_empty() {
                scene.text(Text::new(unit.as_str(), (self.left - 8.0, y), SMALL).anchored(Anchor::End));
            }
            for (column, end) in ends.iter().enumerate() {
                let x = self.left + self.cell.0 * column as f64;
                scene.text(Text::new(end.as_str(), (x, y), SMALL).anchored(Anchor::Middle));
            }
            y += LEADING;
        }
        let right = self.left + self.cell.0 * self.map.cells[0].len() as f64;
        let below = (0.5 * (self.left + right), y + 1.0);
        scene.text(Text::new(self.map.x_label.as_str(), below, SMALL).anchored(Anchor::Middle));
        let middle = (edge + 0.76 * SMALL, 0.5 * (self.top + bottom));
        let mut label = Text::new(self.map.y_label.as_str(), middle, SMALL).anchored(Anchor::Middle);
        label.upwards = true;
        scene.text(label);
        y + LEADING
    }
}

/// Length and height of the key's colours, points.
const BAR: f64 = 132.0;
const HIGH: f64 = 9.0;

/// Puts the colours up to ±`largest` on `scene`, from `at` to the right. Gives the y below them.
pub fn ramp(scene: &mut Scene, at: (f64, f64), largest: f64) -> f64 {
    const STEPS: u32 = 66;
    let (left, top) = (at.0 + 13.0, at.1);
    for i in 0..STEPS {
        let place = |i: u32| left + BAR * f64::from(i) / f64::from(STEPS);
        let share = 2.0 * (f64::from(i) + 0.5) / f64::from(STEPS) - 1.0;
        // A little wider, so that no gaps show between them.
        let end = (place(i + 1) + 0.3).min(left + BAR);
        let paint = Paint::Colour(blend(share));
        scene.area(Path::rectangle([place(i), top, end, top + HIGH]), paint, 1.0);
    }
    scene.line(
        Path::rectangle([left, top, left + BAR, top + HIGH]),
        Stroke::solid(Paint::Ink, 0.5),
    );
    // The colours follow the root, so a quarter of the largest is halfway.
    for (share, value) in [
        (-1.0, -largest),
        (-0.5, -0.25 * largest),
        (0.0, 0.0),
        (0.5, 0.25 * largest),
        (1.0, largest),
    ] {
        let x = left + 0.5 * BAR * (1.0 + share);
        scene.line(
            Path::segment((x, top + HIGH), (x, top + HIGH + 2.0)),
            Stroke::solid(Paint::Ink, 0.5),
        );
        let text = Text::new(number(value), (x, top + HIGH + LEADING), SMALL);
        scene.text(text.anchored(Anchor::Middle));
    }
    top + HIGH + LEADING + 0.24 * SMALL
}

/// Puts the key on `scene`: [`ramp`], and what marks mean; `framed` says what the bold line is around, `half` what is
/// known in part if anything is.
pub fn key(scene: &mut Scene, at: (f64, f64), largest: f64, framed: &str, half: Option<&str>) -> f64 {
    let below = ramp(scene, at, largest);
    let top = at.1;
    let mut x = at.0 + 13.0 + BAR + 22.0;
    let base = top + HIGH - 1.5;
    let swatch = |x: f64| [x, top - 0.5, x + 15.0, top + HIGH + 0.5];
    let entry = |scene: &mut Scene, x: &mut f64, words: &str| {
        scene.text(Text::new(words, (*x + 19.0, base), SMALL));
        *x += 19.0 + width(words, Weight::Regular, SMALL) + 11.0;
    };
    scene.line(Path::rectangle(swatch(x)), Stroke::solid(Paint::Ink, BORDER));
    entry(scene, &mut x, framed);
    if let Some(half) = half {
        let colour = blend(0.4);
        scene.area(Path::rectangle(swatch(x)), Paint::Colour(colour), 1.0);
        corner(scene, swatch(x), on(colour));
        entry(scene, &mut x, half);
    }
    hatched(scene, swatch(x));
    entry(scene, &mut x, "never visited");
    below
}

fn hatched(scene: &mut Scene, corners: [f64; 4]) {
    for line in hatching(corners) {
        scene.line(line, Stroke::solid(Paint::Ink, 0.5).faded(0.35));
    }
}

/// The mark in the upper right corner of a cell.
fn corner(scene: &mut Scene, [_, top, right, _]: [f64; 4], paint: Paint) {
    let points = [(right - CORNER, top), (right, top), (right, top + CORNER)];
    scene.area(Path::polyline(points, true), paint, 1.0);
}

/// The colour of `value` where ±`largest` are the ends: by the root of its share, so that small values show as well.
pub(super) fn colour(value: f64, largest: f64) -> Rgb {
    if largest <= 0.0 {
        return blend(0.0);
    }
    let share = (value / largest).clamp(-1.0, 1.0);
    blend(sqrt(share.abs()) * share.signum())
}

/// The colour at `share` of the ramp, −1 to 1.
pub(super) fn blend(share: f64) -> Rgb {
    let at = 0.5 * (share + 1.0) * (RAMP.len() - 1) as f64;
    let first = (at as usize).min(RAMP.len() - 2);
    let part = at - first as f64;
    let (Rgb(r, g, b), Rgb(red, green, blue)) = (RAMP[first], RAMP[first + 1]);
    let mix = |from: u8, to: u8| (f64::from(from) + part * (f64::from(to) - f64::from(from))).round() as u8;
    Rgb(mix(r, red), mix(g, green), mix(b, blue))
}

/// The luminance of a colour, 0 for black and 1 for white (ITU-R BT.709).
fn luminance(Rgb(r, g, b): Rgb) -> f64 {
    let linear = |channel: u8| libm::pow(f64::from(channel) / 255.0, 2.2);
    0.2126 * linear(r) + 0.7152 * linear(g) + 0.0722 * linear(b)
}

/// What is told apart from `ground` best: black or white.
pub(super) fn on(ground: Rgb) -> Paint {
    let [black, white] = NUMBERS;
    Paint::Colour(if luminance(ground) > LIGHT { black } else { white })
}

/// A number as short as a cell needs it: three digits or two decimals, thousands as k and millions as M.
pub fn number(value: f64) -> String {
    let size = value.abs();
    for (from, unit, name, step) in [
        (9.95e6, 1e6, "M", 1.0),
        (999_500.0, 1e6, "M", 0.1),
        (9999.5, 1e3, "k", 1.0),
    ] {
        if size >= from {
            return format!("{}{name}", label(value / unit, step));
        }
    }
    let step = if size < 9.995 {
        0.01
    } else if size < 99.95 {
        0.1
    } else {
        1.0
    };
    label(value, step)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_grow_lighter_throughout_and_are_neutral_at_zero() {
        let all: Vec<f64> = (-100..=100).map(|i| luminance(blend(f64::from(i) / 100.0))).collect();
        assert!(all.windows(2).all(|pair| pair[0] <= pair[1]), "{all:?}");
        let Rgb(r, g, b) = colour(0.0, 5.0);
        assert!(r == g && g == b);
        assert_eq!([colour(-9.0, 5.0), colour(9.0, 5.0)], [RAMP[0], RAMP[4]]);
        assert_eq!(colour(1.25, 5.0), blend(0.5), "a quarter of the largest is halfway");
        assert_eq!(colour(3.0, 0.0), blend(0.0));
    }

    #[test]
    fn numbers_are_legible_on_every_colour() {
        for i in -100..=100 {
            let ground = blend(f64::from(i) / 100.0);
            let Paint::Colour(text) = on(ground) else {
                panic!("a colour that stays")
            };
            let (a, b) = (luminance(ground), luminance(text));
            let contrast = (a.max(b) + 0.05) / (a.min(b) + 0.05);
            assert!(contrast >= 4.5, "{contrast} at {i}");
        }
    }

    #[test]
    fn numbers_are_short() {
        let values = [
            0.0, -0.001, 0.006, -9.96, 9.999, -12.34, 99.97, 229.6, -1234.0, 12_345.0, 2.5e7,
        ];
        let expected = [
            "0", "0", "0.01", "−9.96", "10.0", "−12.3", "100", "230", "−1234", "12k", "25M",
        ];
        assert_eq!(values.map(number), expected.map(str::to_owned));
    }
}
