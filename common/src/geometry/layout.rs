//! Layouts: the positions of the devices of a scenario. Every digest depends on the positions, bit for bit, and so on
//! the order of draws. Words are part of the scenario hash; doc comments of words and fields appear in
//! `docs/scenario.md`.

use super::{Area, FileLayout, Point};
use crate::declare;
use crate::declare::{FieldReader, FieldSink, ScenarioError, Section, Visit, choice, choices, file};
use crate::rng::{Purpose, Stream};

choices! {
    /// Placement of devices in the area. The base station knows all positions.
    pub enum LayoutKind {
        /// Independent and uniform on the area.
        Uniform = "uniform",
        /// One device at a uniform position in each of N random cells of the smallest square grid with at least N
        /// cells.
        JitteredGrid = "jittered-grid",
        /// Random positions with a minimum distance between devices.
        PoissonDisk = "poisson-disk",
        /// Rows and columns as even as N allows; on a square area, a square number N yields a perfect grid.
        Grid = "grid",
        /// As `grid`, with every other row shifted by half a spacing. The row distance is √3/2 of the device spacing.
        Hex = "hex",
        /// Positions from the file `layout.file`.
        File = "file",
    }
}

declare! {
    /// Positions of the devices.
    #[derive(Clone, Debug)]
    struct Settings in "layout" {
        /// Placement of devices in the area.
        kind: LayoutKind = choice::<LayoutKind>("jittered-grid").source("uniform in Sec. II, jittered by calibration"),
        /// CSV file with the columns `x` and `y` in metres and one line per device. An optional column `class` holds
        /// the name of the device's class. The path is relative to the scenario file.
        file: Option<String> = file().only_with("layout.kind", &["file"]),
    }
}

/// The layout of the devices.
#[derive(Clone, Debug, PartialEq)]
pub enum Layout {
    /// See [`LayoutKind::Uniform`].
    Uniform,
    /// See [`LayoutKind::JitteredGrid`].
    JitteredGrid,
    /// See [`LayoutKind::PoissonDisk`].
    PoissonDisk,
    /// See [`LayoutKind::Grid`].
    Grid,
    /// See [`LayoutKind::Hex`].
    Hex,
    /// See [`LayoutKind::File`].
    File(FileLayout),
}

impl Layout {
    /// The fields of a layout.
    pub const SECTION: &'static Section = Settings::SECTION;

    /// Builds the layout in `reader`, for `devices` devices on `area`; `class_names` as in the scenario.
    ///
    /// # Errors
    /// If a file is missing or does not have enough valid devices.
    pub fn from_fields(
        reader: &FieldReader<'_>,
        area: Area,
        devices: u32,
        class_names: &[&str],
    ) -> Result<Self, ScenarioError> {
        let Settings { kind, file } = Settings::read(reader)?;
        Ok(match kind {
            LayoutKind::Uniform => Self::Uniform,
            LayoutKind::JitteredGrid => Self::JitteredGrid,
            LayoutKind::PoissonDisk => Self::PoissonDisk,
            LayoutKind::Grid => Self::Grid,
            LayoutKind::Hex => Self::Hex,
            LayoutKind::File => {
                let file = file.ok_or_else(|| reader.missing_value("layout.file", "layout.kind"))?;
                Self::File(FileLayout::from_fields(reader, &file, area, devices, class_names)?)
            }
        })
    }

    /// The kind of the layout.
    pub const fn kind(&self) -> LayoutKind {
        match self {
            Self::Uniform => LayoutKind::Uniform,
            Self::JitteredGrid => LayoutKind::JitteredGrid,
            Self::PoissonDisk => LayoutKind::PoissonDisk,
            Self::Grid => LayoutKind::Grid,
            Self::Hex => LayoutKind::Hex,
            Self::File(_) => LayoutKind::File,
        }
    }

    /// Its name, as in `layout.kind` of a scenario.
    pub const fn name(&self) -> &'static str {
        self.kind().name()
    }

    /// The class of each device as an index into the scenario's classes, if the layout defines classes.
    pub fn classes(&self) -> Option<&[u16]> {
        match self {
            Self::File(file) => file.classes.as_deref().map(Vec::as_slice),
            Self::Uniform | Self::JitteredGrid | Self::PoissonDisk | Self::Grid | Self::Hex => None,
        }
    }

    /// Passes every field to `sink`. The scenario hash depends on the order.
    pub fn visit(&self, sink: &mut dyn FieldSink) {
        // `FileLayout::visit` passes the file, whose positions are hashed instead of its path.
        let settings = Settings {
            kind: self.kind(),
            file: None,
        };
        settings.visit(sink);
        match self {
            Self::File(file) => file.visit(sink, Self::SECTION),
            Self::Uniform | Self::JitteredGrid | Self::PoissonDisk | Self::Grid | Self::Hex => {}
        }
    }
}

/// Consecutive misses after which the disks of `PoissonDisk` shrink.
const MISSES_BEFORE_SHRINK: u32 = 500;

/// The factor by which the radius of the disks shrinks.
const SHRINK_FACTOR: f64 = 0.98;

/// The positions of `n` devices in `area`, the same for the same `seed`. A `File` has fixed positions, of which the
/// first `n` apply; loading a scenario rules out fewer.
pub fn place_devices(layout: &Layout, area: Area, n: u32, seed: u64) -> Vec<Point> {
    let mut stream = Stream::new(seed, Purpose::Layout, 0);
    match layout {
        Layout::Uniform => (0..n).map(|_| draw_point(&mut stream, area)).collect(),
        Layout::JitteredGrid => jittered_grid(&mut stream, area, n),
        Layout::PoissonDisk => poisson_disk(&mut stream, area, n),
        Layout::Grid => {
            let rows_squared = f64::from(n) * area.height / area.width;
            place_in_rows(area, n, rows_squared.sqrt(), [0.5, 0.5])
        }
        Layout::Hex => {
            // Rows √3/2 of a pitch apart: N = (h / row pitch) · (w / pitch).
            let rows_squared = f64::from(n) * area.height / area.width * 2.0 / 3.0_f64.sqrt();
            place_in_rows(area, n, rows_squared.sqrt(), [0.25, 0.75])
        }
        Layout::File(file) => file.points.iter().take(n as usize).copied().collect(),
    }
}

fn draw_point(stream: &mut Stream, area: Area) -> Point {
    let x = stream.unit() * area.width;
    Point::new(x, stream.unit() * area.height)
}

/// Places one device in each of `n` random cells of the smallest grid of s × s cells with at least `n`.
fn jittered_grid(stream: &mut Stream, area: Area, n: u32) -> Vec<Point> {
    let n = u64::from(n);
    // An integer root is exact, so a square N fills every cell.
    let floor = n.isqrt();
    let side = if floor * floor < n { floor + 1 } else { floor };
    let (width, height) = (area.width / side as f64, area.height / side as f64);
    let mut cells: Vec<u64> = (0..side * side).collect();
    (0..n)
        .map(|device| {
            // A shuffle that stops after n cells (Fisher and Yates).
            let drawn = device + stream.below(side * side - device);
            cells.swap(device as usize, drawn as usize);
            let cell = cells[device as usize];
            let x = ((cell % side) as f64 + stream.unit()) * width;
            let y = ((cell / side) as f64 + stream.unit()) * height;
            // Rounding may put a product just outside the area.
            Point::new(x.min(area.width), y.min(area.height))
        })
        .collect()
}

/// Places `n` devices in about `rows` rows, as evenly as possible. `phases` are the positions of the devices of even
/// and of odd rows within their share of the row, 0 ..= 1.
fn place_in_rows(area: Area, n: u32, rows: f64, phases: [f64; 2]) -> Vec<Point> {
    let n = u64::from(n);
    let rows = (rows.round() as u64).clamp(1, n.max(1));
    let phases = if rows == 1 { [0.5, 0.5] } else { phases };
    let mut points = Vec::with_capacity(n as usize);
    for row in 0..rows {
        // Rows differ by at most one device and add up to n.
        let in_row = (row + 1) * n / rows - row * n / rows;
        let y = (row as f64 + 0.5) * area.height / rows as f64;
        let phase = phases[(row % 2) as usize];
        points.extend((0..in_row).map(|i| Point::new((i as f64 + phase) * area.width / in_row as f64, y)));
    }
    points
}

/// Throws darts until `n` have landed farther than a radius from all earlier darts. The radius starts near the one of
/// the densest packing, which random darts cannot reach, and shrinks while they keep missing.
fn poisson_disk(stream: &mut Stream, area: Area, n: u32) -> Vec<Point> {
    // The spacing of the densest packing, a hexagonal lattice: A/n = √3/2 · spacing².
    let densest_spacing = (2.0 * area.surface() / (3.0_f64.sqrt() * f64::from(n))).sqrt();
    // On a strip narrower than that, devices in a line can be farther apart.
    let line_spacing = area.width.max(area.height) / f64::from(n);
    let mut radius = (0.9 * densest_spacing).max(line_spacing);
    let mut darts = Darts::new(area, radius, n);
    let mut misses = 0;
    while darts.points.len() < n as usize {
        let p = draw_point(stream, area);
        if darts.is_clear(p, radius) {
            darts.push(p);
            misses = 0;
        } else {
            misses += 1;
            if misses == MISSES_BEFORE_SHRINK {
                radius *= SHRINK_FACTOR;
                misses = 0;
            }
        }
    }
    darts.points
}

/// The darts so far, in a bucket grid. Its cells are at least the first radius wide, so a cell and the eight around it
/// hold all darts that a new one can collide with.
struct Darts {
    points: Vec<Point>,
    /// The last dart in each cell; [`NO_DART`] for none.
    last_in_cell: Vec<u32>,
    /// For each dart, the previous dart in its cell, or [`NO_DART`].
    previous_in_cell: Vec<u32>,
    columns: usize,
    rows: usize,
    area: Area,
}

const NO_DART: u32 = u32::MAX;

impl Darts {
    fn new(area: Area, radius: f64, n: u32) -> Self {
        let cells = |length: f64| ((length / radius) as usize).clamp(1, n.max(1) as usize);
        let (columns, rows) = (cells(area.width), cells(area.height));
        Self {
            points: Vec::with_capacity(n as usize),
            last_in_cell: vec![NO_DART; columns * rows],
            previous_in_cell: Vec::with_capacity(n as usize),
            columns,
            rows,
            area,
        }
    }

    fn is_clear(&self, p: Point, radius: f64) -> bool {
        let (column, row) = self.cell(p);
        for near_row in row.saturating_sub(1)..=(row + 1).min(self.rows - 1) {
            for near_column in column.saturating_sub(1)..=(column + 1).min(self.columns - 1) {
                let mut dart = self.last_in_cell[near_row * self.columns + near_column];
                while dart != NO_DART {
                    if self.points[dart as usize].distance_squared(p) < radius * radius {
                        return false;
                    }
                    dart = self.previous_in_cell[dart as usize];
                }
            }
        }
        true
    }

    fn push(&mut self, p: Point) {
        let (column, row) = self.cell(p);
        let last = &mut self.last_in_cell[row * self.columns + column];
        self.previous_in_cell
            .push(std::mem::replace(last, self.points.len() as u32));
        self.points.push(p);
    }

    fn cell(&self, p: Point) -> (usize, usize) {
        let column = (p.x / self.area.width * self.columns as f64) as usize;
        let row = (p.y / self.area.height * self.rows as f64) as usize;
        (column.min(self.columns - 1), row.min(self.rows - 1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SQUARE: Area = Area {
        width: 20.0,
        height: 20.0,
    };
    const WIDE: Area = Area {
        width: 50.0,
        height: 8.0,
    };
    const RANDOM: [Layout; 3] = [Layout::Uniform, Layout::JitteredGrid, Layout::PoissonDisk];
    const REGULAR: [Layout; 2] = [Layout::Grid, Layout::Hex];

    fn smallest_distance(points: &[Point]) -> f64 {
        let mut smallest = f64::INFINITY;
        for (i, a) in points.iter().enumerate() {
            for b in &points[..i] {
                smallest = smallest.min(a.distance(*b));
            }
        }
        smallest
    }

    #[test]
    fn random_and_regular_layouts_place_n_devices_inside_the_area() {
        for layout in RANDOM.iter().chain(&REGULAR) {
            for area in [SQUARE, WIDE] {
                for n in (0..60).chain([250, 1000]) {
                    let points = place_devices(layout, area, n, 5);
                    assert_eq!(points.len(), n as usize, "{layout:?}");
                    assert!(points.iter().all(|&p| area.contains(p)), "{layout:?}, {n} devices");
                    assert_eq!(points, place_devices(layout, area, n, 5), "{layout:?}, {n} devices");
                    assert!(n < 2 || smallest_distance(&points) > 0.0, "{layout:?}, {n} devices");
                }
            }
        }
    }

    #[test]
    fn only_random_layouts_depend_on_the_seed() {
        for layout in &RANDOM {
            assert_ne!(
                place_devices(layout, SQUARE, 30, 1),
                place_devices(layout, SQUARE, 30, 2),
                "{layout:?}"
            );
        }
        for layout in &REGULAR {
            assert_eq!(
                place_devices(layout, SQUARE, 30, 1),
                place_devices(layout, SQUARE, 30, 2),
                "{layout:?}"
            );
        }
    }

    #[test]
    fn uniform_positions_fill_the_area_evenly() {
        let points = place_devices(&Layout::Uniform, WIDE, 40_000, 9);
        // Eight rectangles of 12.5 m by 4 m, with 5000 expected in each.
        let mut counts = [0_u32; 8];
        for p in &points {
            counts[(p.x / 12.5) as usize + 4 * (p.y / 4.0) as usize] += 1;
        }
        assert!(
            counts.iter().all(|&c| (4_700..5_300).contains(&c)),
            "devices by rectangle: {counts:?}"
        );
    }

    #[test]
    fn a_jittered_grid_cell_contains_at_most_one_device() {
        for area in [SQUARE, WIDE] {
            for (n, side) in [(1, 1), (2, 2), (10, 4), (16, 4), (17, 5), (250, 16), (256, 16)] {
                let mut counts = vec![0; side * side];
                for p in place_devices(&Layout::JitteredGrid, area, n, 3) {
                    let column = (p.x / area.width * side as f64) as usize;
                    let row = (p.y / area.height * side as f64) as usize;
                    counts[row * side + column] += 1;
                }
                assert!(counts.iter().all(|&c| c <= 1), "N = {n}: devices by cell {counts:?}");
            }
        }
    }

    #[test]
    fn the_cell_of_a_jittered_grid_is_uniformly_random() {
        // The cell of the first of 10 devices, of 16 cells, with 500 expected in each.
        let mut counts = [0_u32; 16];
        for seed in 0..8000 {
            let p = place_devices(&Layout::JitteredGrid, SQUARE, 10, seed)[0];
            counts[(p.x / 5.0) as usize + 4 * (p.y / 5.0) as usize] += 1;
        }
        assert!(
            counts.iter().all(|&c| (400..600).contains(&c)),
            "first devices by cell: {counts:?}"
        );
    }

    #[test]
    fn poisson_disks_keep_their_distance() {
        for (area, n) in [(SQUARE, 10), (SQUARE, 250), (WIDE, 100), (SQUARE, 2000)] {
            // The distance in the densest packing. Random disks jam at about 0.78 of it.
            let hexagonal_pitch = (2.0 * area.surface() / (3.0_f64.sqrt() * f64::from(n))).sqrt();
            let smallest = smallest_distance(&place_devices(&Layout::PoissonDisk, area, n, 8));
            assert!(
                smallest > 0.65 * hexagonal_pitch,
                "N = {n}: distance {smallest} m, of {hexagonal_pitch} m at most"
            );
        }
        let strip = Area {
            width: 1e6,
            height: 1e-6,
        };
        // Half of the spacing of 100 devices in a line; random darts jam at 0.75 of it.
        assert!(smallest_distance(&place_devices(&Layout::PoissonDisk, strip, 100, 8)) > 5_000.0);
    }

    #[test]
    fn a_hundred_thousand_poisson_disks_are_placed() {
        assert_eq!(place_devices(&Layout::PoissonDisk, WIDE, 100_000, 1).len(), 100_000);
    }

    #[test]
    fn a_square_number_forms_a_perfect_grid() {
        let points = place_devices(&Layout::Grid, SQUARE, 25, 0);
        for (i, p) in points.iter().enumerate() {
            let (column, row) = (i % 5, i / 5);
            let centre = Point::new(column as f64 * 4.0 + 2.0, row as f64 * 4.0 + 2.0);
            assert!(p.distance(centre) < 1e-12, "device {i} at {p:?}");
        }
    }

    #[test]
    fn hex_neighbours_are_about_equally_far_apart() {
        let points = place_devices(&Layout::Hex, SQUARE, 17 * 14, 0);
        let pitch = (2.0 * SQUARE.surface() / (3.0_f64.sqrt() * 17.0 * 14.0)).sqrt();
        let inner = points
            .iter()
            .filter(|p| (4.0..16.0).contains(&p.x) && (4.0..16.0).contains(&p.y));
        for p in inner {
            let mut distances: Vec<_> = points.iter().map(|q| q.distance(*p)).collect();
            distances.sort_by(f64::total_cmp);
            assert!(
                distances[1] > 0.95 * pitch && distances[6] < 1.05 * pitch,
                "pitch {pitch} m, distances {:?}",
                &distances[..8]
            );
        }
    }

    #[test]
    fn a_file_layout_uses_its_first_points() {
        let points: Vec<_> = (0..9).map(|i| Point::new(f64::from(i), 1.0)).collect();
        let layout = Layout::File(FileLayout {
            path: "devices.csv".into(),
            points: std::sync::Arc::new(points.clone()),
            classes: None,
        });
        assert_eq!(place_devices(&layout, SQUARE, 4, 0), points[..4]);
    }
}
