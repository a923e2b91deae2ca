//! Learning curves of tables: reward and information per episode, with a row of panels for each N and window.
//!
//! Every panel has its own axis, since rewards vary little within a panel but differ greatly between few and many
//! devices.

use std::fmt::Write as _;

use reveille_bs::policy::q_learning::learned::{CurvePoint, LearnedTables, Lookback, TableSet};

use super::error::FigureError;
use super::font::{Weight, width, wrap};
use super::path::{Rect, VectorPath};
use super::q_table::{setting, trained};
use super::scale::Scale;
use super::scene::{Anchor, Paint, Scene, Stroke, Text};
use super::study::csv_cell;
use super::style::{EDGE, LARGE, LEADING, SMALL, Style, WIDE};

/// Largest number of files, and of rows, in one figure.
const LIMITS: (usize, usize) = (6, 40);
/// Largest number of points of a line with markers.
const MARKED: usize = 40;
/// Height of a panel and of the gap below it, points.
const PANEL: (f64, f64) = (38.0, 11.0);
/// Left edge of the panels, and the gap between them, points.
const LEFT: f64 = 88.0;
const GAP: f64 = 48.0;
/// Opacity of grid lines.
const GRID: f64 = 0.14;

/// Quantity shown in a column of panels.
struct Quantity {
    title: &'static str,
    of: fn(&CurvePoint) -> f64,
}

const QUANTITIES: [Quantity; 2] = [
    Quantity {
        title: "reward r(k) per TTI",
        of: |point| point.reward,
    },
    Quantity {
        title: "information (P1)",
        of: |point| point.information,
    },
];

/// File name of learned tables, with the tables.
pub type NamedTables = (String, LearnedTables);

/// Key shared by the curves in one row of panels.
#[derive(Clone, Copy, PartialEq)]
struct Row {
    lookback: Lookback,
    devices: u32,
    /// Area, m².
    surface: f64,
}

impl Row {
    const fn of(entry: &TableSet) -> Self {
        Self {
            lookback: entry.lookback,
            devices: entry.devices,
            surface: entry.surface,
        }
    }

    /// Returns whether window and area, in this order, are equal in both rows.
    fn is_beside(&self, other: &Self) -> [bool; 2] {
        [
            self.lookback == other.lookback,
            self.surface.to_bits() == other.surface.to_bits(),
        ]
    }
}

/// Returns the rows of all curves of `sources`, in ascending order of window, area and N.
fn rows(sources: &[NamedTables]) -> Vec<Row> {
    let entries = sources.iter().flat_map(|(_, learned)| &learned.entries);
    let drawn = entries.filter(|entry| !entry.curve.is_empty());
    let mut rows: Vec<Row> = drawn.map(Row::of).collect();
    let order = |a: &Row, b: &Row| {
        let by_window = a.lookback.cmp(&b.lookback).then(a.surface.total_cmp(&b.surface));
        by_window.then(a.devices.cmp(&b.devices))
    };
    rows.sort_by(order);
    // Sorted by all three fields, so equal rows are neighbours.
    rows.dedup();
    rows
}

fn curve(learned: &LearnedTables, row: Row) -> &[CurvePoint] {
    let mut entries = learned.entries.iter();
    entries
        .find(|entry| Row::of(entry) == row)
        .map_or(&[], |entry| &entry.curve)
}

/// Draws the figure, with a row for each N and a line for each of `sources`.
///
/// # Errors
/// A file has no learning curve, or there are too many files or N.
pub fn scene(sources: &[NamedTables]) -> Result<Scene, FigureError> {
    let too_many = |count, what, limit| FigureError::Curves { count, what, limit };
    if sources.len() > LIMITS.0 {
        return Err(too_many(sources.len(), "files", LIMITS.0));
    }
    let is_bare = |(_, learned): &&NamedTables| learned.entries.iter().all(|entry| entry.curve.is_empty());
    if let Some((file, _)) = sources.iter().find(is_bare) {
        return Err(FigureError::NoCurve { file: file.clone() });
    }
    let rows = rows(sources);
    if rows.len() > LIMITS.1 {
        return Err(too_many(rows.len(), "numbers of devices", LIMITS.1));
    }
    let mut scene = Scene::new(WIDE, 0.0);
    "Learning curves of q-learning".clone_into(&mut scene.title);
    scene.description = caption(sources);
    let mut y = EDGE + LARGE;
    scene.text(Text::new(scene.title.clone(), (EDGE, y), LARGE).bold());
    y = legend(&mut scene, sources, y + LEADING + 3.0);
    let wide = 0.5 * (WIDE - EDGE - 14.0 - LEFT - GAP);
    let lefts = [LEFT, LEFT + wide + GAP];
    for (left, quantity) in lefts.iter().zip(&QUANTITIES) {
        let at = (left + 0.5 * wide, y);
        scene.text(Text::new(quantity.title, at, SMALL).bold().anchored(Anchor::Middle));
    }
    let last = sources.iter().flat_map(|(_, l)| &l.entries).flat_map(|e| &e.curve);
    // All panels share x, so its labels are drawn only below the last row.
    let x = Scale::linear([0.0, last.map(|p| p.ttis as f64).fold(1.0, f64::max)], true);
    let are_one = rows.windows(2).fold([true; 2], |[window, area], pair| {
        let [same_window, same_area] = pair[0].is_beside(&pair[1]);
        [window && same_window, area && same_area]
    });
    let mut top = y + 7.0;
    for (i, row) in rows.iter().enumerate() {
        name(&mut scene, *row, are_one, top);
        for (left, quantity) in lefts.iter().zip(&QUANTITIES) {
            let panel = Panel {
                corners: [*left, top, left + wide, top + PANEL.0],
                x,
                is_last: i + 1 == rows.len(),
            };
            panel.draw(&mut scene, sources, *row, quantity);
        }
        top += PANEL.0 + PANEL.1;
    }
    let mut y = top - PANEL.1 + 3.0 * LEADING + 6.0;
    for line in wrap(&scene.description.clone(), Weight::Regular, SMALL, WIDE - 2.0 * EDGE) {
        scene.text(Text::new(line, (EDGE, y), SMALL));
        y += LEADING;
    }
    scene.height = (y - LEADING + 0.24 * SMALL + EDGE).ceil();
    Ok(scene)
}

/// Draws N next to a row, with its window and area if these differ between rows.
fn name(scene: &mut Scene, row: Row, [is_one_window, is_one_area]: [bool; 2], top: f64) {
    let Row {
        lookback,
        devices,
        surface,
    } = row;
    let mut y = top + 0.5 * PANEL.0 + 0.36 * SMALL;
    scene.text(Text::new(format!("N = {devices}"), (EDGE, y), SMALL).bold());
    let more = [
        (!is_one_window).then(|| lookback.label()),
        (!is_one_area).then(|| format!("{surface} m²")),
    ];
    for text in more.into_iter().flatten() {
        y += LEADING;
        scene.text(Text::new(text, (EDGE, y), SMALL));
    }
}

/// Draws the legend of the files, if there are several. Returns the y below it.
fn legend(scene: &mut Scene, sources: &[NamedTables], mut y: f64) -> f64 {
    const SWATCH: f64 = 22.0;
    if sources.len() < 2 {
        return y + 2.0;
    }
    let mut x = EDGE;
    for (i, (file, _)) in sources.iter().enumerate() {
        let (style, file) = (Style::nth(i), fit(file, WIDE - 2.0 * EDGE - SWATCH));
        let needed = SWATCH + width(&file, Weight::Regular, SMALL);
        if x > EDGE && x + needed > WIDE - EDGE {
            (x, y) = (EDGE, y + LEADING + 1.0);
        }
        let middle = y - 0.35 * SMALL;
        scene.line(VectorPath::segment((x, middle), (x + 18.0, middle)), style.line());
        style.mark(scene, (x + 9.0, middle));
        scene.text(Text::new(file, (x + SWATCH, y), SMALL));
        x += needed + 9.0;
    }
    y + LEADING + 6.0
}

/// Returns the longest end of `text` that fits in `limit` points.
fn fit(text: &str, limit: f64) -> String {
    let all: Vec<char> = text.chars().collect();
    let shortened = (0..all.len()).map(|from| {
        let mark = if from == 0 { "" } else { "…" };
        format!("{mark}{}", all[from..].iter().collect::<String>())
    });
    let mut fitting = shortened.filter(|text| width(text, Weight::Regular, SMALL) <= limit);
    fitting.next().unwrap_or_default()
}

fn caption(sources: &[NamedTables]) -> String {
    let mut text = String::from(
        "A point is an episode on its own deployment: its mean reward and its information (P1), exploration included. \
         Episodes alternate between the rankings posterior and p42. Every panel has a separate axis, which need not \
         start at zero.",
    );
    let is_one_setting = sources.windows(2).all(|pair| pair[0].1.setting == pair[1].1.setting);
    for (file, learned) in sources {
        if sources.len() > 1 {
            let _ = write!(text, " {}:", fit(file, WIDE - 8.0 * EDGE));
        }
        let _ = write!(text, " {}", trained(learned, &learned.lookbacks(), "for each N"));
        if !is_one_setting {
            let _ = write!(text, " {}", setting(learned));
        }
    }
    if let Some((_, first)) = sources.first().filter(|_| is_one_setting) {
        let _ = write!(text, " {}", setting(first));
    }
    text
}

/// One panel.
struct Panel {
    /// Left, top, right, bottom.
    corners: Rect,
    x: Scale,
    is_last: bool,
}

impl Panel {
    fn draw(&self, scene: &mut Scene, sources: &[NamedTables], row: Row, quantity: &Quantity) {
        let [left, top, right, bottom] = self.corners;
        let points = || sources.iter().flat_map(|(_, learned)| curve(learned, row));
        let scale = Scale::linear(points().map(quantity.of), false);
        self.axes(scene, scale);
        let at = |point: &CurvePoint| {
            let x = left + self.x.place(point.ttis as f64) * (right - left);
            (x, bottom - scale.place((quantity.of)(point)) * (bottom - top))
        };
        for (i, (_, learned)) in sources.iter().enumerate() {
            let (style, curve) = (Style::nth(i), curve(learned, row));
            if curve.len() > 1 {
                scene.line(VectorPath::polyline(curve.iter().map(at), false), style.line());
            }
            if curve.len() <= MARKED {
                for point in curve {
                    style.mark(scene, at(point));
                }
            }
        }
    }

    /// Draws the axes. Only the first and last tick of y have labels, since there is no room for more.
    fn axes(&self, scene: &mut Scene, y: Scale) {
        let [left, top, right, bottom] = self.corners;
        let (axis, grid) = (
            Stroke::solid(Paint::Ink, 0.7),
            Stroke::solid(Paint::Ink, 0.5).faded(GRID),
        );
        let ticks = y.ticks();
        for (i, tick) in ticks.iter().enumerate() {
            let at = bottom - y.place(tick.value) * (bottom - top);
            scene.line(VectorPath::segment((left, at), (right, at)), grid);
            scene.line(VectorPath::segment((left - 2.5, at), (left, at)), axis);
            if i == 0 || i + 1 == ticks.len() {
                let text = Text::new(tick.label.as_str(), (left - 4.0, at + 0.36 * SMALL), SMALL);
                scene.text(text.anchored(Anchor::End));
            }
        }
        for tick in self.x.ticks() {
            let at = left + self.x.place(tick.value) * (right - left);
            scene.line(VectorPath::segment((at, top), (at, bottom)), grid);
            scene.line(VectorPath::segment((at, bottom), (at, bottom + 2.5)), axis);
            if self.is_last {
                let text = Text::new(tick.label, (at, bottom + LEADING + 1.5), SMALL);
                scene.text(text.anchored(Anchor::Middle));
            }
        }
        scene.line(
            VectorPath::polyline([(left, top), (left, bottom), (right, bottom)], false),
            axis,
        );
        if self.is_last {
            let below = (0.5 * (left + right), bottom + 2.0 * LEADING + 2.5);
            scene.text(Text::new("TTIs of training", below, SMALL).anchored(Anchor::Middle));
        }
    }
}

/// Formats the plotted data as CSV.
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
