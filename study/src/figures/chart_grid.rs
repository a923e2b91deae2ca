//! A page of small charts for [`super::robustness`]: a row for each impairment, a column for each metric, with one
//! legend. [`ChartGrid::share_y_axes`] must be called before drawing, so that rows compare.

use super::chart::{Chart, PlotFrame};
use super::font::{Weight, text_width, wrap_text};
use super::scale::Scale;
use super::scene::{Scene, Text};
use super::style::{LEADING, MARGIN, PAGE_WIDTH, TEXT_SIZE, TITLE_SIZE};

/// Height of a plot, points.
const PLOT_HEIGHT: f64 = 62.0;
/// Width of the labels of a y axis, points.
const LABEL_WIDTH: f64 = 26.0;
/// Gap between two columns, points.
const COLUMN_GAP: f64 = 8.0;

/// A row of charts.
#[derive(Clone, Debug, PartialEq)]
pub struct ChartRow {
    /// Heading.
    pub title: String,
    /// Quantity along x, with its unit.
    pub x_label: String,
    /// A chart for each column, with equal lines in all of them.
    pub charts: Vec<Chart>,
}

/// A grid of charts.
#[derive(Clone, Debug, PartialEq)]
pub struct ChartGrid {
    /// Title, one line: it is not wrapped.
    pub title: String,
    /// Quantity along y of each column, with its unit.
    pub columns: Vec<String>,
    /// Rows, at least one. The legend is drawn from the first chart.
    pub rows: Vec<ChartRow>,
    /// Caption.
    pub caption: String,
}

impl ChartGrid {
    /// Replaces the y axes in each column by one axis. `scale` creates it from the number of the column, from 0, and
    /// the ends of the axes of its charts.
    pub fn share_y_axes(&mut self, scale: impl Fn(usize, Vec<f64>) -> Scale) {
        for column in 0..self.columns.len() {
            let charts = self.rows.iter().filter_map(|row| row.charts.get(column));
            let ends = charts.flat_map(|chart| <[f64; 2]>::from(chart.y.ends())).collect();
            let shared = scale(column, ends);
            for chart in self.rows.iter_mut().filter_map(|row| row.charts.get_mut(column)) {
                chart.y = shared;
            }
        }
    }

    /// Draws the grid.
    pub fn scene(&self) -> Scene {
        let mut scene = Scene::new(PAGE_WIDTH, 0.0);
        scene.title.clone_from(&self.title);
        scene.description.clone_from(&self.caption);
        let mut y = MARGIN + TITLE_SIZE;
        scene.text(Text::new(self.title.as_str(), (MARGIN, y), TITLE_SIZE).bold());
        y += LEADING + 6.0;
        let column_count = self.columns.len().max(1) as f64;
        let column_width = (PAGE_WIDTH - 2.0 * MARGIN - (column_count - 1.0) * COLUMN_GAP) / column_count;
        let column_left = |column: usize| MARGIN + column as f64 * (column_width + COLUMN_GAP);
        for (column, name) in self.columns.iter().enumerate() {
            scene.text(Text::new(name.as_str(), (column_left(column), y), TEXT_SIZE));
        }
        y += LEADING + 3.0;
        for row in &self.rows {
            scene.text(Text::new(row.title.as_str(), (MARGIN, y), TEXT_SIZE).bold());
            let after_title = MARGIN + text_width(&row.title, Weight::Bold, TEXT_SIZE) + 6.0;
            scene.text(Text::new(format!("x: {}", row.x_label), (after_title, y), TEXT_SIZE));
            let top = y + 6.0;
            for (column, chart) in row.charts.iter().enumerate() {
                let frame = PlotFrame {
                    chart,
                    left: column_left(column) + LABEL_WIDTH,
                    top,
                    right: column_left(column) + column_width - 4.0,
                    bottom: top + PLOT_HEIGHT,
                };
                frame.draw(&mut scene);
            }
            y = top + PLOT_HEIGHT + LEADING + 15.0;
        }
        if let Some(chart) = self.rows.first().and_then(|row| row.charts.first()) {
            y = chart.draw_legend(&mut scene, y, PAGE_WIDTH);
        }
        for line in wrap_text(&self.caption, Weight::Regular, TEXT_SIZE, PAGE_WIDTH - 2.0 * MARGIN) {
            scene.text(Text::new(line, (MARGIN, y), TEXT_SIZE));
            y += LEADING;
        }
        scene.height = (y - LEADING + 0.24 * TEXT_SIZE + MARGIN).ceil();
        scene
    }
}
