//! Heat maps with a colour and a number in every cell that has a value; zero is in the middle of the colour scale.
//!
//! The colours run from dark blue through grey to light yellow. Their lightness increases throughout, so they suit
//! colour-blind readers and print without colours. `q_table` and `attention` draw such maps, and `tuning` uses the
//! colours alone. The maps of a figure and their key need the same `scale_end`, the magnitude at its ends.

use libm::sqrt;

use super::chart::hatch_lines;
use super::font::{Weight, text_width};
use super::path::{Rect, VectorPath};
use super::scale::format_with_step;
use super::scene::{Anchor, Paint, Rgb, Scene, Stroke, Text};
use super::style::{LEADING, TEXT_SIZE};

/// Evenly spaced colours from the least value to the largest. The tests below need rising lightness, grey in the middle
/// and legible numbers on all of them.
const RAMP: [Rgb; 5] = [
    Rgb(0x00, 0x22, 0x4E),
    Rgb(0x3D, 0x4B, 0x70),
    Rgb(0x86, 0x86, 0x86),
    Rgb(0xC6, 0xB8, 0x68),
    Rgb(0xFE, 0xE8, 0x38),
];
/// Colours of numbers on light and on dark cells.
const NUMBER_COLOURS: [Rgb; 2] = [Rgb(0, 0, 0), Rgb(255, 255, 255)];
/// Luminance, as a share of white's, above which numbers are black. Both colours are legible at this limit.
const LIGHT_LUMINANCE: f64 = 0.18;
/// Size of the mark on partly known cells, points.
const CORNER_SIZE: f64 = 4.5;
/// Width of the line around framed cells, points.
const FRAME_WIDTH: f64 = 1.8;

/// Degree to which the value of a cell is known.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum KnowledgeDegree {
    /// There is no value: for example, learning never visited the cell. Drawn with hatching.
    Unknown,
    /// One of the two actions behind the value was never tried. Drawn with a mark in the corner.
    PartlyKnown,
    /// The value is known.
    Known,
}

/// A cell of a heat map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct HeatCell {
    /// Value of the cell; not read if it is unknown.
    pub value: f64,
    /// Degree to which the value is known.
    pub knowledge: KnowledgeDegree,
    /// Whether the cell lies within the bold line, whose meaning the figure states.
    pub is_framed: bool,
}

/// Labels of the rows.
#[derive(Clone, Debug, PartialEq)]
pub enum RowLabels {
    /// A name for each row.
    Names(Vec<String>),
    /// Limits of the rows, one more than there are rows.
    Limits(Vec<String>),
}

/// A heat map.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct HeatMap {
    /// Quantity along x, with its unit.
    pub x_label: String,
    /// Quantity along y, with its unit.
    pub y_label: String,
    /// Limits of the columns, one more than there are columns, in one or more units: name of the unit, limits.
    pub columns: Vec<(String, Vec<String>)>,
    /// Labels of the rows, from the lowest.
    pub rows: RowLabels,
    /// Cells by rows, from the lowest: at least one row and one column, all rows of equal length.
    pub cells: Vec<Vec<HeatCell>>,
}

/// Position of the cells on the canvas, points.
struct HeatGrid<'a> {
    map: &'a HeatMap,
    left: f64,
    top: f64,
    /// Width and height of a cell.
    cell_size: (f64, f64),
}

impl HeatMap {
    /// Largest magnitude of the known values.
    pub(crate) fn largest_magnitude(&self) -> f64 {
        let cells = self
            .cells
            .iter()
            .flatten()
            .filter(|cell| cell.knowledge != KnowledgeDegree::Unknown);
        cells.map(|cell| cell.value.abs()).fold(0.0, f64::max)
    }

    /// Returns the number of cells that are known to this degree.
    pub(crate) fn count(&self, degree: KnowledgeDegree) -> usize {
        self.cells
            .iter()
            .flatten()
            .filter(|cell| cell.knowledge == degree)
            .count()
    }

    /// Draws the map with its upper left corner at `at`, labels included, `width` points wide, with rows `row_height`
    /// points high. The colour scale ends at ±`scale_end`. Returns the y below the map.
    pub(crate) fn draw(
        &self,
        scene: &mut Scene,
        at: (f64, f64),
        (width, row_height): (f64, f64),
        scale_end: f64,
    ) -> f64 {
        let width_of = |text: &String| text_width(text, Weight::Regular, TEXT_SIZE);
        let (RowLabels::Names(labels) | RowLabels::Limits(labels)) = &self.rows;
        let unit_widths = self.columns.iter().map(|(unit, _)| width_of(unit) + 8.0);
        let widest = labels.iter().map(width_of).chain(unit_widths).fold(0.0, f64::max);
        let left = at.0 + LEADING + widest + 5.0;
        let columns = self.cells.first().map_or(1, Vec::len);
        let last_limits = self.columns.iter().filter_map(|(_, limits)| limits.last());
        let overhang = last_limits.map(width_of).fold(0.0, f64::max) * 0.5;
        let grid = HeatGrid {
            map: self,
            left,
            top: at.1,
            cell_size: ((at.0 + width - overhang - left) / columns as f64, row_height),
        };
        for (row, cells) in self.cells.iter().enumerate() {
            for (column, cell) in cells.iter().enumerate() {
                grid.draw_cell(scene, (row, column), cell, scale_end);
            }
        }
        grid.draw_map_border_and_cell_frames(scene);
        grid.draw_labels(scene, at.0)
    }
}

impl HeatGrid<'_> {
    /// Returns left, top, right, bottom of a cell.
    fn corners(&self, row: usize, column: usize) -> Rect {
        let (wide, high) = self.cell_size;
        let rows_above = self.map.cells.len() - 1 - row;
        let (left, top) = (self.left + wide * column as f64, self.top + high * rows_above as f64);
        [left, top, left + wide, top + high]
    }

    fn draw_cell(&self, scene: &mut Scene, (row, column): (usize, usize), cell: &HeatCell, scale_end: f64) {
        let corners = self.corners(row, column);
        match cell.knowledge {
            KnowledgeDegree::Unknown => draw_hatching(scene, corners),
            KnowledgeDegree::PartlyKnown | KnowledgeDegree::Known => {
                let colour = colour_of(cell.value, scale_end);
                scene.area(VectorPath::rectangle(corners), Paint::Colour(colour), 1.0);
                if cell.knowledge == KnowledgeDegree::PartlyKnown {
                    draw_corner_mark(scene, corners, contrast_colour(colour));
                }
                let at = (
                    0.5 * (corners[0] + corners[2]),
                    0.5 * (corners[1] + corners[3]) + 0.36 * TEXT_SIZE,
                );
                let mut text = Text::new(short_number(cell.value), at, TEXT_SIZE).anchored(Anchor::Middle);
                text.paint = contrast_colour(colour);
                scene.text(text);
            }
        }
    }

    /// Draws a thin line around the map, and a bold one around the framed cells.
    fn draw_map_border_and_cell_frames(&self, scene: &mut Scene) {
        let cells = &self.map.cells;
        let framed = |row: Option<usize>, column: Option<usize>| {
            let row = row.and_then(|row| cells.get(row));
            row.and_then(|row| column.and_then(|column| row.get(column)))
                .is_some_and(|cell| cell.is_framed)
        };
        let mut bold = VectorPath::default();
        // One step past the last row and column closes the outlines at the far borders.
        for row in 0..=cells.len() {
            for column in 0..=cells[0].len() {
                let here = framed(Some(row), Some(column));
                let (left, below) = (
                    framed(Some(row), column.checked_sub(1)),
                    framed(row.checked_sub(1), Some(column)),
                );
                let (wide, high) = self.cell_size;
                let x = self.left + wide * column as f64;
                let y = self.top + high * (cells.len() - row) as f64;
                if here != left {
                    bold.extend(VectorPath::segment(
                        (x, y + 0.5 * FRAME_WIDTH),
                        (x, y - high - 0.5 * FRAME_WIDTH),
                    ));
                }
                if here != below {
                    bold.extend(VectorPath::segment(
                        (x - 0.5 * FRAME_WIDTH, y),
                        (x + wide + 0.5 * FRAME_WIDTH, y),
                    ));
                }
            }
        }
        let [left, _, _, bottom] = self.corners(0, 0);
        let [_, top, right, _] = self.corners(cells.len() - 1, cells[0].len() - 1);
        scene.line(
            VectorPath::rectangle([left, top, right, bottom]),
            Stroke::solid(Paint::Ink, 0.7),
        );
        if !bold.0.is_empty() {
            scene.line(bold, Stroke::solid(Paint::Ink, FRAME_WIDTH));
        }
    }

    /// Draws the labels of rows and columns and the names of the axes, the name of y at `left_edge`. Returns the y
    /// below them.
    fn draw_labels(&self, scene: &mut Scene, left_edge: f64) -> f64 {
        let rows = self.map.cells.len();
        let row_label = |text: &str, y: f64| {
            Text::new(text, (self.left - 4.0, y + 0.36 * TEXT_SIZE), TEXT_SIZE).anchored(Anchor::End)
        };
        match &self.map.rows {
            RowLabels::Names(names) => {
                for (row, name) in names.iter().enumerate() {
                    let [_, top, _, bottom] = self.corners(row, 0);
                    scene.text(row_label(name, 0.5 * (top + bottom)));
                }
            }
            RowLabels::Limits(limits) => {
                for (row, limit) in limits.iter().enumerate() {
                    scene.text(row_label(limit, self.top + self.cell_size.1 * (rows - row) as f64));
                }
            }
        }
        let bottom = self.top + self.cell_size.1 * rows as f64;
        // The label of the lowest limit reaches half a line below the cells.
        let mut y = bottom
            + LEADING
            + if matches!(self.map.rows, RowLabels::Limits(_)) {
                2.5
            } else {
                0.5
            };
        for (unit, limits) in &self.map.columns {
            if !unit.is_empty() {
                scene.text(Text::new(unit.as_str(), (self.left - 8.0, y), TEXT_SIZE).anchored(Anchor::End));
            }
            for (column, limit) in limits.iter().enumerate() {
                let x = self.left + self.cell_size.0 * column as f64;
                scene.text(Text::new(limit.as_str(), (x, y), TEXT_SIZE).anchored(Anchor::Middle));
            }
            y += LEADING;
        }
        let right = self.left + self.cell_size.0 * self.map.cells[0].len() as f64;
        let below = (0.5 * (self.left + right), y + 1.0);
        scene.text(Text::new(self.map.x_label.as_str(), below, TEXT_SIZE).anchored(Anchor::Middle));
        let middle = (left_edge + 0.76 * TEXT_SIZE, 0.5 * (self.top + bottom));
        let mut label = Text::new(self.map.y_label.as_str(), middle, TEXT_SIZE).anchored(Anchor::Middle);
        label.is_vertical = true;
        scene.text(label);
        y + LEADING
    }
}

/// Length and height of the colour scale in the key, points; number of its colours.
const COLOUR_SCALE_WIDTH: f64 = 132.0;
const COLOUR_SCALE_HEIGHT: f64 = 9.0;
const COLOUR_COUNT: u32 = 66;

/// Draws the colour scale up to ±`scale_end` from `at` to the right. Returns the y below it.
pub(crate) fn draw_colour_scale(scene: &mut Scene, at: (f64, f64), scale_end: f64) -> f64 {
    let (left, top) = (at.0 + 13.0, at.1);
    for i in 0..COLOUR_COUNT {
        let place = |i: u32| left + COLOUR_SCALE_WIDTH * f64::from(i) / f64::from(COLOUR_COUNT);
        let share = 2.0 * (f64::from(i) + 0.5) / f64::from(COLOUR_COUNT) - 1.0;
        // The colours overlap slightly to avoid gaps between them.
        let right = (place(i + 1) + 0.3).min(left + COLOUR_SCALE_WIDTH);
        let paint = Paint::Colour(colour_at(share));
        scene.area(
            VectorPath::rectangle([place(i), top, right, top + COLOUR_SCALE_HEIGHT]),
            paint,
            1.0,
        );
    }
    scene.line(
        VectorPath::rectangle([left, top, left + COLOUR_SCALE_WIDTH, top + COLOUR_SCALE_HEIGHT]),
        Stroke::solid(Paint::Ink, 0.5),
    );
    // The colours follow the square root, so a quarter of the largest value is halfway.
    for (share, value) in [
        (-1.0, -scale_end),
        (-0.5, -0.25 * scale_end),
        (0.0, 0.0),
        (0.5, 0.25 * scale_end),
        (1.0, scale_end),
    ] {
        let x = left + 0.5 * COLOUR_SCALE_WIDTH * (1.0 + share);
        scene.line(
            VectorPath::segment((x, top + COLOUR_SCALE_HEIGHT), (x, top + COLOUR_SCALE_HEIGHT + 2.0)),
            Stroke::solid(Paint::Ink, 0.5),
        );
        let text = Text::new(short_number(value), (x, top + COLOUR_SCALE_HEIGHT + LEADING), TEXT_SIZE);
        scene.text(text.anchored(Anchor::Middle));
    }
    top + COLOUR_SCALE_HEIGHT + LEADING + 0.24 * TEXT_SIZE
}

/// Draws the key: the colour scale and the meaning of marks. `framed_text` describes the cells within the bold line,
/// `partly_known_text` the partly known cells, if any. Unknown cells are "never visited". Returns the y below the key.
pub fn draw_key(
    scene: &mut Scene,
    at: (f64, f64),
    scale_end: f64,
    framed_text: &str,
    partly_known_text: Option<&str>,
) -> f64 {
    let below = draw_colour_scale(scene, at, scale_end);
    let top = at.1;
    let mut x = at.0 + 13.0 + COLOUR_SCALE_WIDTH + 22.0;
    let base = top + COLOUR_SCALE_HEIGHT - 1.5;
    let swatch = |x: f64| [x, top - 0.5, x + 15.0, top + COLOUR_SCALE_HEIGHT + 0.5];
    let draw_entry_text = |scene: &mut Scene, x: &mut f64, words: &str| {
        scene.text(Text::new(words, (*x + 19.0, base), TEXT_SIZE));
        *x += 19.0 + text_width(words, Weight::Regular, TEXT_SIZE) + 11.0;
    };
    scene.line(VectorPath::rectangle(swatch(x)), Stroke::solid(Paint::Ink, FRAME_WIDTH));
    draw_entry_text(scene, &mut x, framed_text);
    if let Some(partly_known_text) = partly_known_text {
        let colour = colour_at(0.4);
        scene.area(VectorPath::rectangle(swatch(x)), Paint::Colour(colour), 1.0);
        draw_corner_mark(scene, swatch(x), contrast_colour(colour));
        draw_entry_text(scene, &mut x, partly_known_text);
    }
    draw_hatching(scene, swatch(x));
    draw_entry_text(scene, &mut x, "never visited");
    below
}

fn draw_hatching(scene: &mut Scene, corners: Rect) {
    for line in hatch_lines(corners) {
        scene.line(line, Stroke::solid(Paint::Ink, 0.5).with_opacity(0.35));
    }
}

/// Draws the mark in the upper right corner of a cell.
fn draw_corner_mark(scene: &mut Scene, [_, top, right, _]: Rect, paint: Paint) {
    let points = [(right - CORNER_SIZE, top), (right, top), (right, top + CORNER_SIZE)];
    scene.area(VectorPath::closed_line(points), paint, 1.0);
}

/// Returns the colour of `value` on a scale of ±`scale_end`. It follows the square root of the share, so that small
/// values are visible.
pub(super) fn colour_of(value: f64, scale_end: f64) -> Rgb {
    if scale_end <= 0.0 {
        return colour_at(0.0);
    }
    let share = (value / scale_end).clamp(-1.0, 1.0);
    colour_at(sqrt(share.abs()) * share.signum())
}

/// Returns the colour at `share` of the scale, −1 to 1.
pub(super) fn colour_at(share: f64) -> Rgb {
    let position = 0.5 * (share + 1.0) * (RAMP.len() - 1) as f64;
    // At the very end of the scale there is no next colour to blend with.
    let lower = (position as usize).min(RAMP.len() - 2);
    let part = position - lower as f64;
    let (Rgb(r, g, b), Rgb(red, green, blue)) = (RAMP[lower], RAMP[lower + 1]);
    let mix = |from: u8, to: u8| (f64::from(from) + part * (f64::from(to) - f64::from(from))).round() as u8;
    Rgb(mix(r, red), mix(g, green), mix(b, blue))
}

/// Returns the luminance of a colour, 0 for black and 1 for white: the weights of ITU-R BT.709, with a gamma of 2.2.
fn luminance(Rgb(r, g, b): Rgb) -> f64 {
    let linear = |channel: u8| libm::pow(f64::from(channel) / 255.0, 2.2);
    0.2126 * linear(r) + 0.7152 * linear(g) + 0.0722 * linear(b)
}

/// Returns a text colour that is legible on `background`: black or white.
pub(super) fn contrast_colour(background: Rgb) -> Paint {
    let [black, white] = NUMBER_COLOURS;
    Paint::Colour(if luminance(background) > LIGHT_LUMINANCE {
        black
    } else {
        white
    })
}

/// Formats a number in short form: two decimals below 10, one below 100, then none; thousands from 10 000 on with k,
/// and millions with M.
pub fn short_number(value: f64) -> String {
    let size = value.abs();
    // The limits lie where rounding would add a digit: 9999.5 would become 10000.
    for (min_size, divisor, suffix, step) in [
        (9.95e6, 1e6, "M", 1.0),
        (999_500.0, 1e6, "M", 0.1),
        (9999.5, 1e3, "k", 1.0),
    ] {
        if size >= min_size {
            return format!("{}{suffix}", format_with_step(value / divisor, step));
        }
    }
    let step = if size < 9.995 {
        0.01
    } else if size < 99.95 {
        0.1
    } else {
        1.0
    };
    format_with_step(value, step)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_get_lighter_with_the_value_and_are_grey_at_0() {
        let luminances: Vec<f64> = (-100..=100)
            .map(|i| luminance(colour_at(f64::from(i) / 100.0)))
            .collect();
        assert!(luminances.windows(2).all(|pair| pair[0] <= pair[1]), "{luminances:?}");
        let Rgb(r, g, b) = colour_of(0.0, 5.0);
        assert!(r == g && g == b);
        assert_eq!([colour_of(-9.0, 5.0), colour_of(9.0, 5.0)], [RAMP[0], RAMP[4]]);
        assert_eq!(
            colour_of(1.25, 5.0),
            colour_at(0.5),
            "colours follow the square root of the share"
        );
        assert_eq!(colour_of(3.0, 0.0), colour_at(0.0));
    }

    #[test]
    fn numbers_are_legible_on_every_colour() {
        // 4.5 is the minimum of the accessibility guidelines (WCAG, level AA).
        for i in -100..=100 {
            let background = colour_at(f64::from(i) / 100.0);
            let Paint::Colour(text) = contrast_colour(background) else {
                panic!("not a fixed colour")
            };
            let (a, b) = (luminance(background), luminance(text));
            let contrast = (a.max(b) + 0.05) / (a.min(b) + 0.05);
            assert!(contrast >= 4.5, "contrast {contrast} at {i} %");
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
        assert_eq!(values.map(short_number), expected.map(str::to_owned));
    }
}
