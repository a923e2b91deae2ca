//! Charts: axes, lines with markers and interval bands, marks for the paper's statements, a legend and a caption.
//!
//! The figure modules fill a [`Chart`]; [`Chart::scene`] draws it, and `chart_grid.rs` draws several on one page. The
//! layout fits a journal column, 3.5 inch wide, with no text below 8 points. Items are drawn from back to front, so
//! that no interval hides a mean.

use super::font::{Weight, text_width, wrap_text};
use super::note::{Note, Obstacles, place_notes};
use super::path::{Rect, VectorPath};
use super::scale::{AxisTick, Scale};
use super::scene::{Anchor, Paint, Scene, Stroke, Text};
use super::style::{COLUMN_WIDTH, LEADING, LINE_WIDTH, MARGIN, MARKER_RADIUS, Style, TEXT_SIZE, TITLE_SIZE};

/// Height of the plot, points.
const PLOT_HEIGHT: f64 = 158.0;
/// Legend entry of the marks.
const MARKS_LEGEND: &str = "hollow: stated in the paper";
/// Largest horizontal offset, in points, of the paper's marks that share an x. On the axis of N it is the width of a
/// few devices.
const MAX_MARK_OFFSET: f64 = 4.0;
/// Opacity of grid lines.
const GRID_OPACITY: f64 = 0.14;

/// A measured point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ChartPoint {
    /// Position along x.
    pub x: f64,
    /// Position along y, a mean.
    pub y: f64,
    /// Half the width of the 95 % interval of y; NaN without an interval, as for a single run or a closed form.
    pub y_half_width: f64,
    /// Half the width of the interval of x; NaN if x is given, not measured.
    pub x_half_width: f64,
}

/// Drawing style of a line's intervals.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Interval {
    /// Bars with caps at the points, and a band if the points are joined and several have an interval.
    Bars,
    /// A band without bars.
    Band,
    /// A band with its edges, in place of the line.
    BandEdges,
    /// Bars with caps at the points in both directions, without a band.
    Crosses,
    /// A light band between thin edges, so that several bands remain distinct.
    LightBand,
}

/// A line of a chart.
#[derive(Clone, Debug, PartialEq)]
pub struct Series {
    /// Name in the legend; empty for a line without an entry.
    pub name: String,
    /// Style of line and markers.
    pub style: Style,
    /// Whether the points are joined.
    pub is_joined: bool,
    /// Whether the points have markers.
    pub has_markers: bool,
    /// Drawing style of the intervals.
    pub interval: Interval,
    /// Points, in the order in which they are joined.
    pub points: Vec<ChartPoint>,
}

/// Value that the paper states for a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum StatedValue {
    /// Exactly this value.
    Value(f64),
    /// A value between these two.
    Range(f64, f64),
    /// A value less than this.
    Below(f64),
    /// A value greater than this.
    Above(f64),
}

impl StatedValue {
    /// Lower and upper value; equal except for a range.
    pub fn values(self) -> [f64; 2] {
        match self {
            Self::Value(v) | Self::Below(v) | Self::Above(v) => [v, v],
            Self::Range(low, high) => [low, high],
        }
    }
}

/// A mark for a value stated in the paper.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StatedMark {
    /// Position along x.
    pub x: f64,
    /// Horizontal offset from x, points, so that marks at the same x do not hide each other.
    pub x_offset: f64,
    /// Stated value.
    pub stated: StatedValue,
    /// Style of the mark.
    pub style: Style,
}

/// A statement of the paper about a policy for a range of x.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StatedSpan {
    /// Smallest x.
    pub from: f64,
    /// Largest x.
    pub to: f64,
    /// Stated value.
    pub stated: StatedValue,
    /// Colour of the policy.
    pub paint: Paint,
}

/// A chart.
#[derive(Clone, Debug, PartialEq)]
pub struct Chart {
    /// Title.
    pub title: String,
    /// Quantity along x, with its unit.
    pub x_label: String,
    /// Quantity along y, with its unit.
    pub y_label: String,
    /// The x axis.
    pub x: Scale,
    /// The y axis.
    pub y: Scale,
    /// Lines.
    pub series: Vec<Series>,
    /// Values stated in the paper.
    pub marks: Vec<StatedMark>,
    /// Values stated for ranges of x, drawn as hatching.
    pub spans: Vec<StatedSpan>,
    /// Labels next to points, most important first. Labels without room are left out.
    pub notes: Vec<Note>,
    /// Whether values of zero are drawn on the lower border of a logarithmic y axis, which is then labelled 0. The
    /// scale must begin below all other values.
    pub has_zero_at_border: bool,
    /// Caption: how to read marks and intervals, and a description of the runs.
    pub caption: String,
}

/// Position of the plot on the canvas, points.
pub(super) struct PlotFrame<'a> {
    pub(super) chart: &'a Chart,
    pub(super) left: f64,
    pub(super) top: f64,
    pub(super) right: f64,
    pub(super) bottom: f64,
}

impl Chart {
    /// Draws the chart.
    pub fn scene(&self) -> Scene {
        let mut scene = Scene::new(COLUMN_WIDTH, 0.0);
        scene.title.clone_from(&self.title);
        scene.description.clone_from(&self.caption);
        let mut y = MARGIN + TITLE_SIZE;
        for line in wrap_text(&self.title, Weight::Bold, TITLE_SIZE, COLUMN_WIDTH - 2.0 * MARGIN) {
            scene.text(Text::new(line, (MARGIN, y), TITLE_SIZE).bold());
            y += LEADING + 1.0;
        }
        let labels = self.y_ticks().into_iter().map(|tick| tick.label);
        let widest_label = labels
            .map(|l| text_width(&l, Weight::Regular, TEXT_SIZE))
            .fold(0.0, f64::max);
        let frame = PlotFrame {
            chart: self,
            left: MARGIN + LEADING + widest_label + 5.0,
            top: y - 2.0,
            right: COLUMN_WIDTH - MARGIN - 4.0,
            bottom: y - 2.0 + PLOT_HEIGHT,
        };
        frame.draw(&mut scene);
        frame.draw_labels(&mut scene);
        let mut y = frame.bottom + 3.0 * LEADING + 6.0;
        y = self.draw_legend(&mut scene, y, COLUMN_WIDTH);
        y += 1.0;
        for line in wrap_text(&self.caption, Weight::Regular, TEXT_SIZE, COLUMN_WIDTH - 2.0 * MARGIN) {
            scene.text(Text::new(line, (MARGIN, y), TEXT_SIZE));
            y += LEADING;
        }
        scene.height = (y - LEADING + 0.24 * TEXT_SIZE + MARGIN).ceil();
        scene
    }

    fn y_ticks(&self) -> Vec<AxisTick> {
        let mut ticks = self.y.ticks();
        if let Some(lowest) = ticks.first_mut().filter(|_| self.has_zero_at_border) {
            "0".clone_into(&mut lowest.label);
        }
        ticks
    }

    /// Draws rows of as many entries as fit in `width` points, the first with the base line `y`. Returns the base line
    /// of the text below.
    pub(super) fn draw_legend(&self, scene: &mut Scene, mut y: f64, width: f64) -> f64 {
        /// Width of an entry's line and marker, points.
        const SWATCH_WIDTH: f64 = 22.0;
        let mut x = MARGIN;
        for series in self.series.iter().filter(|s| !s.name.is_empty()) {
            let lines = wrap_text(
                &series.name,
                Weight::Regular,
                TEXT_SIZE,
                width - 2.0 * MARGIN - SWATCH_WIDTH,
            );
            let widest = lines
                .iter()
                .map(|line| text_width(line, Weight::Regular, TEXT_SIZE))
                .fold(0.0, f64::max);
            let entry_width = SWATCH_WIDTH + widest;
            if x > MARGIN && (x + entry_width > width - MARGIN || lines.len() > 1) {
                (x, y) = (MARGIN, y + LEADING + 1.0);
            }
            let middle = y - 0.35 * TEXT_SIZE;
            if series.is_joined {
                scene.line(
                    VectorPath::segment((x, middle), (x + 18.0, middle)),
                    series.style.stroke(),
                );
            }
            if series.has_markers {
                series.style.draw_marker(scene, (x + 9.0, middle));
            }
            for (i, line) in lines.into_iter().enumerate() {
                y += if i > 0 { LEADING } else { 0.0 };
                scene.text(Text::new(line, (x + SWATCH_WIDTH, y), TEXT_SIZE));
            }
            x += entry_width + 9.0;
        }
        if let Some(mark) = self.marks.first() {
            let entry_width = 10.0 + text_width(MARKS_LEGEND, Weight::Regular, TEXT_SIZE);
            if x + entry_width > width - MARGIN {
                (x, y) = (MARGIN, y + LEADING + 1.0);
            }
            let hollow = Style {
                paint: Paint::Ink,
                ..mark.style
            };
            hollow.draw_hollow_marker(scene, (x + 4.0, y - 0.35 * TEXT_SIZE));
            scene.text(Text::new(MARKS_LEGEND, (x + 11.0, y), TEXT_SIZE));
        }
        y + LEADING + 2.0
    }
}

impl PlotFrame<'_> {
    /// Draws the axes without their names, and the data.
    pub(super) fn draw(&self, scene: &mut Scene) {
        self.draw_axes(scene);
        self.draw_data(scene);
    }

    fn canvas_x(&self, value: f64) -> f64 {
        self.left + self.chart.x.position(value) * (self.right - self.left)
    }

    fn canvas_y(&self, value: f64) -> f64 {
        self.bottom - self.chart.y.position(value) * (self.bottom - self.top)
    }

    fn draw_axes(&self, scene: &mut Scene) {
        let (axis, grid) = (
            Stroke::solid(Paint::Ink, 0.7),
            Stroke::solid(Paint::Ink, 0.5).with_opacity(GRID_OPACITY),
        );
        for tick in self.chart.y_ticks() {
            let y = self.canvas_y(tick.value);
            let is_main = !tick.label.is_empty();
            if is_main {
                scene.line(VectorPath::segment((self.left, y), (self.right, y)), grid);
                let at = (self.left - 4.0, y + 0.36 * TEXT_SIZE);
                scene.text(Text::new(tick.label, at, TEXT_SIZE).anchored(Anchor::End));
            }
            let length = if is_main { 2.5 } else { 1.5 };
            scene.line(VectorPath::segment((self.left - length, y), (self.left, y)), axis);
        }
        for tick in self.chart.x.ticks() {
            let x = self.canvas_x(tick.value);
            let is_main = !tick.label.is_empty();
            if is_main {
                scene.line(VectorPath::segment((x, self.top), (x, self.bottom)), grid);
                let at = (x, self.bottom + LEADING + 1.5);
                scene.text(Text::new(tick.label, at, TEXT_SIZE).anchored(Anchor::Middle));
            }
            let length = if is_main { 2.5 } else { 1.5 };
            scene.line(VectorPath::segment((x, self.bottom), (x, self.bottom + length)), axis);
        }
        let corner = [
            (self.left, self.top),
            (self.left, self.bottom),
            (self.right, self.bottom),
        ];
        scene.line(VectorPath::open_line(corner), axis);
    }

    /// Draws the names of the axes.
    fn draw_labels(&self, scene: &mut Scene) {
        let below = (0.5 * (self.left + self.right), self.bottom + 2.0 * LEADING + 2.5);
        scene.text(Text::new(self.chart.x_label.as_str(), below, TEXT_SIZE).anchored(Anchor::Middle));
        let label_position = (MARGIN + 0.76 * TEXT_SIZE, 0.5 * (self.top + self.bottom));
        let mut label = Text::new(self.chart.y_label.as_str(), label_position, TEXT_SIZE).anchored(Anchor::Middle);
        label.is_vertical = true;
        scene.text(label);
    }

    fn draw_data(&self, scene: &mut Scene) {
        // From back to front: bands first and markers last, so that no interval hides a mean.
        for series in &self.chart.series {
            self.draw_intervals(scene, series);
        }
        for span in &self.chart.spans {
            self.draw_span(scene, span);
        }
        for mark in &self.chart.marks {
            self.draw_stated_range(scene, mark);
        }
        let has_line = |s: &&Series| s.is_joined && s.interval != Interval::BandEdges;
        for series in self.chart.series.iter().filter(has_line) {
            let points = series.points.iter().map(|p| (self.canvas_x(p.x), self.canvas_y(p.y)));
            scene.line(VectorPath::open_line(points), series.style.stroke());
        }
        for mark in &self.chart.marks {
            self.draw_stated_point(scene, mark);
        }
        for series in self.chart.series.iter().filter(|s| s.has_markers) {
            for point in &series.points {
                series
                    .style
                    .draw_marker(scene, (self.canvas_x(point.x), self.canvas_y(point.y)));
            }
        }
        self.draw_notes(scene);
    }

    fn draw_notes(&self, scene: &mut Scene) {
        let notes = self.chart.notes.iter();
        let notes: Vec<_> = notes
            .map(|n| ((self.canvas_x(n.x), self.canvas_y(n.y)), n.text.as_str()))
            .collect();
        let mut obstacles = Obstacles::default();
        for series in &self.chart.series {
            let to_canvas = |p: &ChartPoint| (self.canvas_x(p.x), self.canvas_y(p.y));
            let markers = series.points.iter().map(|p| (to_canvas(p), MARKER_RADIUS));
            obstacles.markers.extend(markers);
            let lines = series
                .points
                .windows(2)
                .map(|pair| [to_canvas(&pair[0]), to_canvas(&pair[1])]);
            obstacles.lines.extend(lines.filter(|_| series.is_joined));
            for p in &series.points {
                let (x, y) = to_canvas(p);
                let ends = [-1.0, 1.0].map(|side| (self.canvas_x(p.x + side * p.x_half_width), y));
                obstacles.lines.extend(p.x_half_width.is_finite().then_some(ends));
                let ends = [-1.0, 1.0].map(|side| (x, self.canvas_y(p.y + side * p.y_half_width)));
                obstacles.lines.extend(p.y_half_width.is_finite().then_some(ends));
            }
        }
        let marks = self.chart.marks.iter();
        // A number next to a hollow mark would be read as the value of the mark.
        let mark_discs = marks.map(|m| {
            (
                (self.canvas_x_of_mark(m), self.canvas_y(m.stated.values()[0])),
                4.0 * MARKER_RADIUS,
            )
        });
        obstacles.markers.extend(mark_discs);
        for text in place_notes(&notes, &obstacles, [self.left, self.top, self.right, self.bottom]) {
            scene.text(text);
        }
    }

    /// Draws the band and the bars of a series according to its [`Interval`]; points without an interval have neither.
    fn draw_intervals(&self, scene: &mut Scene, series: &Series) {
        let with_interval: Vec<&ChartPoint> = series.points.iter().filter(|p| p.y_half_width.is_finite()).collect();
        if series.interval == Interval::LightBand {
            self.draw_light_band(scene, series.style.paint, &with_interval);
            return;
        }
        if series.is_joined && series.interval != Interval::Crosses {
            self.draw_band(scene, series.style.paint, &with_interval);
        }
        match series.interval {
            Interval::Bars | Interval::Crosses | Interval::LightBand => {}
            Interval::Band => return,
            Interval::BandEdges => {
                for sign in [1.0, -1.0] {
                    let edge = with_interval
                        .iter()
                        .map(|p| (self.canvas_x(p.x), self.canvas_y(p.y + sign * p.y_half_width)));
                    scene.line(VectorPath::open_line(edge), series.style.stroke());
                }
                return;
            }
        }
        let bar = Stroke::solid(series.style.paint, 0.7);
        for point in with_interval {
            let x = self.canvas_x(point.x);
            let (top, bottom) = (
                self.canvas_y(point.y + point.y_half_width),
                self.canvas_y(point.y - point.y_half_width),
            );
            let mut path = VectorPath::segment((x, top), (x, bottom));
            path.extend(VectorPath::segment((x - 2.0, top), (x + 2.0, top)));
            path.extend(VectorPath::segment((x - 2.0, bottom), (x + 2.0, bottom)));
            scene.line(path, bar);
        }
        for point in series.points.iter().filter(|p| p.x_half_width.is_finite()) {
            let y = self.canvas_y(point.y);
            let (left, right) = (
                self.canvas_x(point.x - point.x_half_width),
                self.canvas_x(point.x + point.x_half_width),
            );
            let mut path = VectorPath::segment((left, y), (right, y));
            path.extend(VectorPath::segment((left, y - 2.0), (left, y + 2.0)));
            path.extend(VectorPath::segment((right, y - 2.0), (right, y + 2.0)));
            scene.line(path, bar);
        }
    }

    /// Draws a band through the intervals of neighbouring `points`. Zeros at the border of a logarithmic axis have
    /// none, since it would fill the axis.
    fn draw_band(&self, scene: &mut Scene, paint: Paint, points: &[&ChartPoint]) {
        let is_at_border = |p: &ChartPoint| self.chart.has_zero_at_border && p.y <= self.chart.y.ends().0;
        for points in points.split(|p| is_at_border(p)).filter(|points| points.len() > 1) {
            let end = |p: &&ChartPoint, side: f64| (self.canvas_x(p.x), self.canvas_y(p.y + side * p.y_half_width));
            let upper = points.iter().map(|p| end(p, 1.0));
            let lower = points.iter().rev().map(|p| end(p, -1.0));
            scene.area(VectorPath::closed_line(upper.chain(lower)), paint, 0.25);
        }
    }

    /// Draws a light band through the intervals of `points`, with thin edges.
    fn draw_light_band(&self, scene: &mut Scene, paint: Paint, points: &[&ChartPoint]) {
        let edge = |sign: f64| {
            points
                .iter()
                .map(move |p| (self.canvas_x(p.x), self.canvas_y(p.y + sign * p.y_half_width)))
        };
        let outline: Vec<(f64, f64)> = edge(1.0).chain(edge(-1.0).rev()).collect();
        scene.area(VectorPath::closed_line(outline), paint, 0.12);
        for sign in [1.0, -1.0] {
            let thin = Stroke::solid(paint, 0.4).with_opacity(0.6);
            scene.line(VectorPath::open_line(edge(sign)), thin);
        }
    }

    fn canvas_x_of_mark(&self, mark: &StatedMark) -> f64 {
        (self.canvas_x(mark.x) + mark.x_offset).clamp(self.left + 3.0, self.right + 2.0)
    }

    fn draw_stated_range(&self, scene: &mut Scene, mark: &StatedMark) {
        let StatedValue::Range(low, high) = mark.stated else {
            return;
        };
        let x = self.canvas_x_of_mark(mark);
        let corners = [x - 2.2, self.canvas_y(high), x + 2.2, self.canvas_y(low)];
        scene.outlined_area(
            VectorPath::rectangle(corners),
            Paint::Paper,
            Stroke::solid(mark.style.paint, 0.9),
        );
    }

    /// Draws a range as two dashed lines with light hatching between them, a value as a dashed line, and a bound as a
    /// dashed line hatched on its permitted side.
    fn draw_span(&self, scene: &mut Scene, span: &StatedSpan) {
        /// Height of the hatching on the permitted side of a bound, points.
        const HATCH_HEIGHT: f64 = 7.0;
        let (left, right) = (self.canvas_x(span.from), self.canvas_x(span.to));
        let stroke = Stroke::solid(span.paint, 0.6).with_opacity(0.6);
        let (top, bottom) = match span.stated {
            StatedValue::Range(low, high) => (self.canvas_y(high), self.canvas_y(low)),
            StatedValue::Value(v) => (self.canvas_y(v), self.canvas_y(v)),
            StatedValue::Below(v) => (self.canvas_y(v), (self.canvas_y(v) + HATCH_HEIGHT).min(self.bottom)),
            StatedValue::Above(v) => ((self.canvas_y(v) - HATCH_HEIGHT).max(self.top), self.canvas_y(v)),
        };
        let edges = match span.stated {
            StatedValue::Range(..) => vec![top, bottom],
            StatedValue::Value(_) | StatedValue::Below(_) => vec![top],
            StatedValue::Above(_) => vec![bottom],
        };
        for y in edges {
            scene.line(VectorPath::segment((left, y), (right, y)), stroke.dashed(&[3.0, 1.5]));
        }
        for hatch in hatch_lines([left, top, right, bottom]) {
            scene.line(hatch, Stroke::solid(span.paint, 0.4).with_opacity(0.4));
        }
    }

    fn draw_stated_point(&self, scene: &mut Scene, mark: &StatedMark) {
        let x = self.canvas_x_of_mark(mark);
        let (value, direction) = match mark.stated {
            StatedValue::Range(..) => return,
            StatedValue::Value(value) => (value, 0.0),
            StatedValue::Below(value) => (value, 1.0),
            StatedValue::Above(value) => (value, -1.0),
        };
        let y = self.canvas_y(value);
        if direction != 0.0 {
            // The arrow stays in the plot. If the bound is at the border, it lies next to the bound.
            let tip = (y + direction * 13.0).clamp(self.top - 4.0, self.bottom);
            let mut arrow = VectorPath::segment((x, y), (x, tip));
            let barb = tip - direction * 3.0;
            arrow.extend(VectorPath::open_line([(x - 2.0, barb), (x, tip), (x + 2.0, barb)]));
            scene.line(arrow, Stroke::solid(mark.style.paint, 0.8 * LINE_WIDTH));
        }
        mark.style.draw_hollow_marker(scene, (x, y));
    }
}

/// Returns lines that rise through a rectangle at 45°.
pub(super) fn hatch_lines([left, top, right, bottom]: Rect) -> Vec<VectorPath> {
    /// Horizontal distance between two lines, points.
    const STEP: f64 = 6.0;
    let height = bottom - top;
    if height <= 0.0 {
        return Vec::new();
    }
    let last_index = ((right - left + height) / STEP) as u32;
    let line = |i: u32| {
        let foot = left - height + STEP * f64::from(i);
        let (from, to) = ((left - foot).max(0.0), (right - foot).min(height));
        (to > from).then(|| VectorPath::segment((foot + from, bottom - from), (foot + to, bottom - to)))
    };
    (0..=last_index).filter_map(line).collect()
}

/// Spreads marks that share an x around it, in order: a marker width apart, or closer if one would be more than
/// `MAX_MARK_OFFSET` from x.
pub fn separate_overlapping(marks: &mut [StatedMark]) {
    let originals = marks.to_vec();
    for (i, mark) in marks.iter_mut().enumerate() {
        let has_same_x = |other: &&StatedMark| (other.x - mark.x).abs() < 1e-9;
        let count = originals.iter().filter(has_same_x).count();
        let rank = originals[..i].iter().filter(has_same_x).count();
        let gap_count = count as f64 - 1.0;
        // A lone mark has no gaps and stays at its x.
        let step = (2.4 * MARKER_RADIUS).min(2.0 * MAX_MARK_OFFSET / gap_count.max(1.0));
        mark.x_offset = (rank as f64 - 0.5 * gap_count) * step;
    }
}
