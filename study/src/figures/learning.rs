//! Learning curves of `q-learning` tables: reward and information per episode, with a row of panels for each window,
//! area and N.
//!
//! Every panel has its own axis, since rewards vary little within a panel but differ greatly between few and many
//! devices. The columns of [`csv`] are a file format. `reveille figures learning` draws and writes both, and takes the
//! file names from its arguments.

use std::fmt::Write as _;

use reveille_bs::policy::q_learning::learned::{CurvePoint, LearnedTables, Lookback, TableSet};

use super::error::FigureError;
use super::font::{Weight, text_width, wrap_text};
use super::path::{Rect, VectorPath};
use super::q_table::{describe_setting, describe_training};
use super::scale::Scale;
use super::scene::{Anchor, Paint, Scene, Stroke, Text};
use super::study::csv_cell;
use super::style::{LEADING, MARGIN, PAGE_WIDTH, Style, TEXT_SIZE, TITLE_SIZE};

/// Largest number of files in one figure: the number of styles of [`Style::from_palette`].
const MAX_FILES: usize = 6;
/// Largest number of rows in one figure.
const MAX_ROWS: usize = 40;
/// Largest number of points of a line with markers.
const MAX_MARKED_POINTS: usize = 40;
/// Height of a panel, and of the gap below it, points.
const PANEL_HEIGHT: f64 = 38.0;
const ROW_GAP: f64 = 11.0;
/// Left edge of the left panels, and the gap between the two columns, points.
const PANELS_LEFT: f64 = 88.0;
const COLUMN_GAP: f64 = 48.0;
/// Opacity of grid lines.
const GRID_OPACITY: f64 = 0.14;

/// Quantity shown in a column of panels.
struct CurveQuantity {
    title: &'static str,
    value: fn(&CurvePoint) -> f64,
}

const QUANTITIES: [CurveQuantity; 2] = [
    CurveQuantity {
        title: "reward r(k) per TTI",
        value: |point| point.reward,
    },
    CurveQuantity {
        title: "information (P1)",
        value: |point| point.information,
    },
];

/// File name of learned tables, with the tables.
pub type NamedTables = (String, LearnedTables);

/// Key shared by the curves in one row of panels.
#[derive(Clone, Copy, PartialEq)]
struct PanelRow {
    lookback: Lookback,
    devices: u32,
    /// Area, m².
    surface: f64,
}

impl PanelRow {
    const fn of(entry: &TableSet) -> Self {
        Self {
            lookback: entry.lookback,
            devices: entry.devices,
            surface: entry.surface,
        }
    }

    /// Returns whether the window and whether the area is equal in both rows, in this order.
    fn equal_window_and_area(&self, other: &Self) -> [bool; 2] {
        [
            self.lookback == other.lookback,
            self.surface.to_bits() == other.surface.to_bits(),
        ]
    }
}

/// Returns the rows of all curves of `sources`, in ascending order of window, area and N.
fn panel_rows(sources: &[NamedTables]) -> Vec<PanelRow> {
    let entries = sources.iter().flat_map(|(_, learned)| &learned.entries);
    let with_curve = entries.filter(|entry| !entry.curve.is_empty());
    let mut rows: Vec<PanelRow> = with_curve.map(PanelRow::of).collect();
    let order = |a: &PanelRow, b: &PanelRow| {
        let by_window = a.lookback.cmp(&b.lookback).then(a.surface.total_cmp(&b.surface));
        by_window.then(a.devices.cmp(&b.devices))
    };
    rows.sort_by(order);
    // Sorted by all three fields, so equal rows are neighbours.
    rows.dedup();
    rows
}

/// Returns the curve of the first tables of `learned` for `row`; empty without such tables.
fn curve(learned: &LearnedTables, row: PanelRow) -> &[CurvePoint] {
    let mut entries = learned.entries.iter();
    entries
        .find(|entry| PanelRow::of(entry) == row)
        .map_or(&[], |entry| &entry.curve)
}

/// Draws the figure, with a row for each window, area and N, and a line for each of `sources`.
///
/// # Errors
/// A file has no learning curve, or there are too many files or rows.
pub fn scene(sources: &[NamedTables]) -> Result<Scene, FigureError> {
    let too_many = |count, items, limit| FigureError::TooManyCurves { count, items, limit };
    if sources.len() > MAX_FILES {
        return Err(too_many(sources.len(), "files", MAX_FILES));
    }
    let has_no_curve = |(_, learned): &&NamedTables| learned.entries.iter().all(|entry| entry.curve.is_empty());
    if let Some((file, _)) = sources.iter().find(has_no_curve) {
        return Err(FigureError::NoCurve { file: file.clone() });
    }
    let rows = panel_rows(sources);
    if rows.len() > MAX_ROWS {
        return Err(too_many(rows.len(), "tables of different N, window and area", MAX_ROWS));
    }
    let mut scene = Scene::new(PAGE_WIDTH, 0.0);
    "Learning curves of q-learning".clone_into(&mut scene.title);
    scene.description = caption(sources);
    let mut y = MARGIN + TITLE_SIZE;
    scene.text(Text::new(scene.title.clone(), (MARGIN, y), TITLE_SIZE).bold());
    y = draw_legend(&mut scene, sources, y + LEADING + 3.0);
    let panel_width = 0.5 * (PAGE_WIDTH - MARGIN - 14.0 - PANELS_LEFT - COLUMN_GAP);
    let panel_lefts = [PANELS_LEFT, PANELS_LEFT + panel_width + COLUMN_GAP];
    for (left, quantity) in panel_lefts.iter().zip(&QUANTITIES) {
        let at = (left + 0.5 * panel_width, y);
        scene.text(Text::new(quantity.title, at, TEXT_SIZE).bold().anchored(Anchor::Middle));
    }
    let curve_points = sources.iter().flat_map(|(_, l)| &l.entries).flat_map(|e| &e.curve);
    // All panels share x, so its labels are drawn only below the last row.
    let x = Scale::linear([0.0, curve_points.map(|p| p.ttis as f64).fold(1.0, f64::max)], true);
    let [is_one_window, is_one_area] = rows
        .windows(2)
        .fold([true; 2], |[all_windows_equal, all_areas_equal], pair| {
            let [same_window, same_area] = pair[0].equal_window_and_area(&pair[1]);
            [all_windows_equal && same_window, all_areas_equal && same_area]
        });
    let mut top = y + 7.0;
    for (i, row) in rows.iter().enumerate() {
        draw_row_name(&mut scene, *row, [is_one_window, is_one_area], top);
        for (left, quantity) in panel_lefts.iter().zip(&QUANTITIES) {
            let panel = CurvePanel {
                corners: [*left, top, left + panel_width, top + PANEL_HEIGHT],
                x,
                is_in_last_row: i + 1 == rows.len(),
            };
            panel.draw(&mut scene, sources, *row, quantity);
        }
        top += PANEL_HEIGHT + ROW_GAP;
    }
    let mut y = top - ROW_GAP + 3.0 * LEADING + 6.0;
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
    Ok(scene)
}

/// Draws N next to a row, with its window and area if these differ between rows.
fn draw_row_name(scene: &mut Scene, row: PanelRow, [is_one_window, is_one_area]: [bool; 2], top: f64) {
    let PanelRow {
        lookback,
        devices,
        surface,
    } = row;
    let mut y = top + 0.5 * PANEL_HEIGHT + 0.36 * TEXT_SIZE;
    scene.text(Text::new(format!("N = {devices}"), (MARGIN, y), TEXT_SIZE).bold());
    let differences = [
        (!is_one_window).then(|| lookback.label()),
        (!is_one_area).then(|| format!("{surface} m²")),
    ];
    for text in differences.into_iter().flatten() {
        y += LEADING;
        scene.text(Text::new(text, (MARGIN, y), TEXT_SIZE));
    }
}

/// Draws the legend of the files, if there are several, with the base line `y`. Returns the base line of the text
/// below.
fn draw_legend(scene: &mut Scene, sources: &[NamedTables], mut y: f64) -> f64 {
    /// Width of an entry's line and marker, points.
    const SWATCH_WIDTH: f64 = 22.0;
    if sources.len() < 2 {
        return y + 2.0;
    }
    let mut x = MARGIN;
    for (i, (file, _)) in sources.iter().enumerate() {
        let (style, file) = (
            Style::from_palette(i),
            shorten_start(file, PAGE_WIDTH - 2.0 * MARGIN - SWATCH_WIDTH),
        );
        let entry_width = SWATCH_WIDTH + text_width(&file, Weight::Regular, TEXT_SIZE);
        if x > MARGIN && x + entry_width > PAGE_WIDTH - MARGIN {
            (x, y) = (MARGIN, y + LEADING + 1.0);
        }
        let middle = y - 0.35 * TEXT_SIZE;
        scene.line(VectorPath::segment((x, middle), (x + 18.0, middle)), style.stroke());
        style.draw_marker(scene, (x + 9.0, middle));
        scene.text(Text::new(file, (x + SWATCH_WIDTH, y), TEXT_SIZE));
        x += entry_width + 9.0;
    }
    y + LEADING + 6.0
}

/// Returns the longest end of `text` that fits in `max_width` points, with an ellipsis in front if it is not all.
fn shorten_start(text: &str, max_width: f64) -> String {
    let letters: Vec<char> = text.chars().collect();
    let shortened = (0..letters.len()).map(|from| {
        let ellipsis = if from == 0 { "" } else { "…" };
        format!("{ellipsis}{}", letters[from..].iter().collect::<String>())
    });
    let mut fitting = shortened.filter(|text| text_width(text, Weight::Regular, TEXT_SIZE) <= max_width);
    fitting.next().unwrap_or_default()
}

/// Returns the caption. `lab/src/training` sets the order of the rankings that it names.
fn caption(sources: &[NamedTables]) -> String {
    let mut text = String::from(
        "A point is an episode on its own deployment: its mean reward and its information (P1), exploration included. \
         Episodes alternate between the rankings posterior and p42. Every panel has a separate axis, which need not \
         start at zero.",
    );
    let is_one_setting = sources.windows(2).all(|pair| pair[0].1.site == pair[1].1.site);
    for (file, learned) in sources {
        if sources.len() > 1 {
            let _ = write!(text, " {}:", shorten_start(file, PAGE_WIDTH - 8.0 * MARGIN));
        }
        let _ = write!(
            text,
            " {}",
            describe_training(learned, &learned.lookbacks(), "for each N")
        );
        if !is_one_setting {
            let _ = write!(text, " {}", describe_setting(learned));
        }
    }
    if let Some((_, first)) = sources.first().filter(|_| is_one_setting) {
        let _ = write!(text, " {}", describe_setting(first));
    }
    text
}

/// One panel.
struct CurvePanel {
    /// Left, top, right, bottom.
    corners: Rect,
    /// The x axis, shared by all panels.
    x: Scale,
    /// Whether the panel has the labels of the x axis.
    is_in_last_row: bool,
}

impl CurvePanel {
    fn draw(&self, scene: &mut Scene, sources: &[NamedTables], row: PanelRow, quantity: &CurveQuantity) {
        let [left, top, right, bottom] = self.corners;
        let points = || sources.iter().flat_map(|(_, learned)| curve(learned, row));
        let y_scale = Scale::linear(points().map(quantity.value), false);
        self.draw_axes(scene, y_scale);
        let at = |point: &CurvePoint| {
            let x = left + self.x.position(point.ttis as f64) * (right - left);
            (x, bottom - y_scale.position((quantity.value)(point)) * (bottom - top))
        };
        for (i, (_, learned)) in sources.iter().enumerate() {
            let (style, curve) = (Style::from_palette(i), curve(learned, row));
            if curve.len() > 1 {
                scene.line(VectorPath::open_line(curve.iter().map(at)), style.stroke());
            }
            if curve.len() <= MAX_MARKED_POINTS {
                for point in curve {
                    style.draw_marker(scene, at(point));
                }
            }
        }
    }

    /// Draws the axes. Only the first and last tick of y have labels, since there is no room for more.
    fn draw_axes(&self, scene: &mut Scene, y: Scale) {
        let [left, top, right, bottom] = self.corners;
        let (axis, grid) = (
            Stroke::solid(Paint::Ink, 0.7),
            Stroke::solid(Paint::Ink, 0.5).with_opacity(GRID_OPACITY),
        );
        let ticks = y.ticks();
        for (i, tick) in ticks.iter().enumerate() {
            let at = bottom - y.position(tick.value) * (bottom - top);
            scene.line(VectorPath::segment((left, at), (right, at)), grid);
            scene.line(VectorPath::segment((left - 2.5, at), (left, at)), axis);
            if i == 0 || i + 1 == ticks.len() {
                let text = Text::new(tick.label.as_str(), (left - 4.0, at + 0.36 * TEXT_SIZE), TEXT_SIZE);
                scene.text(text.anchored(Anchor::End));
            }
        }
        for tick in self.x.ticks() {
            let at = left + self.x.position(tick.value) * (right - left);
            scene.line(VectorPath::segment((at, top), (at, bottom)), grid);
            scene.line(VectorPath::segment((at, bottom), (at, bottom + 2.5)), axis);
            if self.is_in_last_row {
                let text = Text::new(tick.label, (at, bottom + LEADING + 1.5), TEXT_SIZE);
                scene.text(text.anchored(Anchor::Middle));
            }
        }
        scene.line(
            VectorPath::open_line([(left, top), (left, bottom), (right, bottom)]),
            axis,
        );
        if self.is_in_last_row {
            let below = (0.5 * (left + right), bottom + 2.0 * LEADING + 2.5);
            scene.text(Text::new("TTIs of training", below, TEXT_SIZE).anchored(Anchor::Middle));
        }
    }
}

/// Formats the plotted data, with the energy of each episode, as CSV.
pub fn csv(sources: &[NamedTables]) -> String {
    let mut out = String::from("file,window,n,surface,ttis,reward_per_tti,info_p1,energy_per_device_tti\n");
    for (file, learned) in sources {
        let file = csv_cell(file);
        for entry in &learned.entries {
            for point in &entry.curve {
                let CurvePoint {
                    ttis,
                    reward,
                    information,
                    energy,
                } = point;
                let (window, n, surface) = (entry.lookback, entry.devices, entry.surface);
                let _ = writeln!(
                    out,
                    "{file},{window},{n},{surface},{ttis},{reward},{information},{energy}"
                );
            }
        }
    }
    out
}
