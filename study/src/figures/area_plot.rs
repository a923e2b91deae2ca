//! Plot of the deployment area with its axes, its legend and its caption, shared by the figures of deployments,
//! attention and missed events. Nothing but their look depends on it. `chart.rs` and `chart_grid.rs` lay out their
//! titles and captions by the same rules, which are repeated there.

use reveille_common::geometry::{Area, Point};

use super::cell_map;
use super::font::{Weight, text_width, wrap_text};
use super::path::VectorPath;
use super::scene::{Anchor, Paint, Scene, Stroke, Text};
use super::style::{COLUMN_WIDTH, LEADING, MARGIN, TEXT_SIZE, TITLE_SIZE};

/// Position of the area on the canvas.
#[derive(Clone, Copy, Debug)]
pub struct AreaPlot {
    /// The area, metres.
    pub area: Area,
    /// Left edge, points.
    pub left: f64,
    /// Upper edge, points.
    pub top: f64,
    /// Scale, points per metre.
    pub points_per_metre: f64,
}

impl AreaPlot {
    /// Fits `area` into a column's width below `top`.
    pub fn new(area: Area, top: f64) -> Self {
        let left = MARGIN + 2.0 * LEADING + 5.0;
        let scale = (COLUMN_WIDTH - MARGIN - 3.0 - left) / area.width;
        // A tall area would extend beyond the page.
        let scale = scale.min(2.0 * COLUMN_WIDTH / area.height);
        Self {
            area,
            left,
            top,
            points_per_metre: scale,
        }
    }

    /// Maps `p` to the canvas, points.
    pub fn to_canvas(&self, p: Point) -> (f64, f64) {
        (
            self.left + p.x * self.points_per_metre,
            self.bottom() - p.y * self.points_per_metre,
        )
    }

    /// Lower edge, points.
    pub fn bottom(&self) -> f64 {
        self.top + self.area.height * self.points_per_metre
    }

    /// Draws a frame with ticks in metres.
    pub fn draw_axes(&self, scene: &mut Scene) {
        let (right, top) = self.to_canvas(Point::new(self.area.width, self.area.height));
        let frame = [self.left, top, right, self.bottom()];
        scene.line(VectorPath::rectangle(frame), Stroke::solid(Paint::Ink, 0.8));
        for tick in cell_map::metre_ticks(self.area.width) {
            let (x, y) = self.to_canvas(Point::new(tick.value, 0.0));
            scene.line(
                VectorPath::segment((x, y), (x, y + 2.5)),
                Stroke::solid(Paint::Ink, 0.7),
            );
            scene.text(Text::new(tick.label, (x, y + LEADING), TEXT_SIZE).anchored(Anchor::Middle));
        }
        for tick in cell_map::metre_ticks(self.area.height) {
            let (x, y) = self.to_canvas(Point::new(0.0, tick.value));
            scene.line(
                VectorPath::segment((x - 2.5, y), (x, y)),
                Stroke::solid(Paint::Ink, 0.7),
            );
            let at = (x - 4.0, y + 0.36 * TEXT_SIZE);
            scene.text(Text::new(tick.label, at, TEXT_SIZE).anchored(Anchor::End));
        }
        let below = (0.5 * (self.left + right), self.bottom() + 2.0 * LEADING);
        scene.text(Text::new("x, metres", below, TEXT_SIZE).anchored(Anchor::Middle));
        let label_position = (MARGIN + 0.76 * TEXT_SIZE, 0.5 * (top + self.bottom()));
        let mut label = Text::new("y, metres", label_position, TEXT_SIZE).anchored(Anchor::Middle);
        label.is_vertical = true;
        scene.text(label);
    }
}

/// Draws `scene.title`, set before, in as many lines as it needs. Returns the y of the next line.
pub fn draw_title(scene: &mut Scene) -> f64 {
    let mut y = MARGIN + TITLE_SIZE;
    for line in wrap_text(
        &scene.title.clone(),
        Weight::Bold,
        TITLE_SIZE,
        COLUMN_WIDTH - 2.0 * MARGIN,
    ) {
        scene.text(Text::new(line, (MARGIN, y), TITLE_SIZE).bold());
        y += LEADING + 1.0;
    }
    y
}

/// Legend below a plot, in as many lines as it needs: the position of its next entry.
#[derive(Clone, Copy, Debug)]
pub struct Legend {
    x: f64,
    y: f64,
}

impl Legend {
    /// Starts a legend with the base line `y`.
    pub const fn new(y: f64) -> Self {
        Self { x: MARGIN, y }
    }

    /// Adds an entry with `text` to `scene`. Returns the centre of its symbol.
    pub fn place(&mut self, scene: &mut Scene, text: &str) -> (f64, f64) {
        let entry_width = 14.0 + text_width(text, Weight::Regular, TEXT_SIZE);
        if self.x > MARGIN && self.x + entry_width > COLUMN_WIDTH - MARGIN {
            (self.x, self.y) = (MARGIN, self.y + LEADING + 2.0);
        }
        scene.text(Text::new(text, (self.x + 14.0, self.y), TEXT_SIZE));
        let symbol_centre = (self.x + 6.0, self.y - 0.35 * TEXT_SIZE);
        self.x += entry_width + 10.0;
        symbol_centre
    }

    /// The base line of the text below.
    pub const fn next_base_line(self) -> f64 {
        self.y + LEADING + 5.0
    }
}

/// Draws `scene.description`, set before, from the base line `y` on, and ends the canvas below it. Call it last in a
/// figure.
pub fn draw_caption(scene: &mut Scene, mut y: f64) {
    for line in wrap_text(
        &scene.description.clone(),
        Weight::Regular,
        TEXT_SIZE,
        COLUMN_WIDTH - 2.0 * MARGIN,
    ) {
        scene.text(Text::new(line, (MARGIN, y), TEXT_SIZE));
        y += LEADING;
    }
    scene.height = (y - LEADING + 0.24 * TEXT_SIZE + MARGIN).ceil();
}
