//! Which part of the area is covered, counted on a raster.

use reveille_common::geometry::{Area, Point};
use reveille_common::sensing::{DetectionKind, Sensing};

/// Cells of the raster on which the covered area is counted, along d_max.
pub const CELLS_PER_RANGE: f64 = 10.0;

/// Cells that are computed side by side.
const LANES: usize = 4;

/// Parts of a cell, where it can be covered in part.
const PARTS: u32 = 64;

/// The area in cells of about d_max/10.
#[derive(Clone, Debug)]
struct Raster {
    columns: usize,
    rows: usize,
    /// Size of a cell, metres.
    width: f64,
    height: f64,
}

impl Raster {
    fn new(area: Area, d_max: f64) -> Self {
        let cells = |length: f64| ((length / d_max * CELLS_PER_RANGE).ceil() as usize).max(1);
        let (columns, rows) = (cells(area.width), cells(area.height));
        Self {
            columns,
            rows,
            width: area.width / columns as f64,
            height: area.height / rows as f64,
        }
    }

    fn cells(&self) -> usize {
        self.columns * self.rows
    }

    /// The rows and columns that a disc of radius `d_max` around `centre` may touch.
    fn around(&self, centre: Point, d_max: f64) -> [std::ops::Range<usize>; 2] {
        let span = |at: f64, size: f64, count: usize| {
            let first = ((at - d_max) / size).floor().max(0.0) as usize;
            let end = ((at + d_max) / size).ceil().max(0.0) as usize;
            first.min(count)..end.min(count)
        };
        [
            span(centre.y, self.height, self.rows),
            span(centre.x, self.width, self.columns),
        ]
    }

    /// The largest and the middle distance of a cell's points from `p`, metres.
    fn distances(&self, row: usize, column: usize, p: Point) -> (f64, f64) {
        let (west, south) = (column as f64 * self.width, row as f64 * self.height);
        let x = (p.x - west).abs().max((west + self.width - p.x).abs());
        let y = (p.y - south).abs().max((south + self.height - p.y).abs());
        let middle = Point::new(west + 0.5 * self.width, south + 0.5 * self.height);
        (Point::new(x, y).distance(Point::default()), middle.distance(p))
    }
}

/// How much of the area is covered by the devices added so far.
///
/// With detection in range a cell is covered by a device that has all of it within d_max, and coverage counts whole
/// cells; with detection by chance each device leaves the share 1 − p(d) of a cell uncovered.
#[derive(Clone, Debug)]
pub struct Coverage {
    raster: Raster,
    cover: Cover,
    /// A device counts once: for one event it detects always or never.
    is_added: Vec<bool>,
    added: Vec<u32>,
}

#[derive(Clone, Debug)]
enum Cover {
    Range(Bits),
    Chance(Shares),
}

impl Coverage {
    /// The coverage by devices at `positions`, none of them added yet.
    pub fn new(positions: &[Point], area: Area, sensing: &Sensing) -> Self {
        let raster = Raster::new(area, sensing.d_max);
        let cover = match sensing.kind {
            DetectionKind::Range => Cover::Range(Bits::new(&raster, positions, sensing.d_max)),
            DetectionKind::Probabilistic => Cover::Chance(Shares::new(&raster, positions, sensing)),
        };
        Self {
            raster,
            cover,
            is_added: vec![false; positions.len()],
            added: Vec::new(),
        }
    }

    /// Forgets all devices.
    pub fn clear(&mut self) {
        match &mut self.cover {
            Cover::Range(bits) => bits.covered.fill(0),
            Cover::Chance(shares) => shares.missed.fill(1.0),
        }
        for j in self.added.drain(..) {
            self.is_added[j as usize] = false;
        }
    }

    /// The share of the area, `[0, 1]`, that the `j`-th device would newly cover.
    pub fn gain(&self, j: usize) -> f64 {
        if self.is_added[j] {
            return 0.0;
        }
        let cells = match &self.cover {
            Cover::Range(bits) => f64::from(bits.gain(j)),
            Cover::Chance(shares) => shares.gain(j),
        };
        cells / self.raster.cells() as f64
    }

    /// The gain in whole parts, rounded down, for comparisons: cells, or with detection by chance 64ths of a cell.
    #[inline]
    pub fn parts(&self, j: usize) -> u32 {
        if self.is_added[j] {
            return 0;
        }
        match &self.cover {
            Cover::Range(bits) => bits.gain(j),
            Cover::Chance(shares) => (shares.gain(j) * f64::from(PARTS)) as u32,
        }
    }

    /// The most that [`Coverage::parts`] can be for any device, and how many make up the area.
    pub fn most_parts(&self) -> (u32, f64) {
        let devices = 0..self.is_added.len();
        let cells = self.raster.cells() as f64;
        match &self.cover {
            Cover::Range(bits) => {
                let own = |j: usize| bits.rows(j).iter().map(|row| row.bits.count_ones()).sum();
                (devices.map(own).max().unwrap_or(0), cells)
            }
            Cover::Chance(shares) => {
                let own = |j: usize| shares.cells(j);
                (devices.map(own).max().unwrap_or(0) * PARTS, cells * f64::from(PARTS))
            }
        }
    }

    /// Adds the `j`-th device.
    pub fn add(&mut self, j: usize) {
        if std::mem::replace(&mut self.is_added[j], true) {
            return;
        }
        self.added.push(j as u32);
        match &mut self.cover {
            Cover::Range(bits) => bits.add(j),
            Cover::Chance(shares) => shares.add(j),
        }
    }

    /// The share of the area, `[0, 1]`, that is not covered.
    pub fn uncovered(&self) -> f64 {
        let cells = match &self.cover {
            Cover::Range(bits) => {
                let covered: u32 = bits.covered.iter().map(|word| word.count_ones()).sum();
                self.raster.cells() as f64 - f64::from(covered)
            }
            Cover::Chance(shares) => shares.missed.iter().sum(),
        };
        cells / self.raster.cells() as f64
    }
}

/// A bit for each cell, in rows of whole words and one word more, so that two neighbouring words can always be read.
#[derive(Clone, Debug)]
struct Bits {
    words: usize,
    covered: Vec<u64>,
    /// The rows of device j are `rows[starts[j] .. starts[j + 1]]`.
    starts: Vec<u32>,
    rows: Vec<Row>,
}

/// The cells of one row of the raster that a device covers.
#[derive(Clone, Copy, Debug)]
struct Row {
    /// The word that holds the first of them.
    word: u32,
    /// Its place in the word.
    shift: u32,
    bits: u32,
}

impl Bits {
    fn new(raster: &Raster, positions: &[Point], d_max: f64) -> Self {
        let words = raster.columns.div_ceil(64) + 1;
        let (mut starts, mut rows) = (vec![0], Vec::new());
        for &p in positions {
            let [south_to_north, west_to_east] = raster.around(p, d_max);
            for row in south_to_north {
                let inside = |column: &usize| raster.distances(row, *column, p).0 <= d_max;
                let mut columns = west_to_east.clone().filter(inside);
                let Some(first) = columns.next() else { continue };
                // The covered cells of a row are neighbours; a row has at most 22 of them.
                let count = 1 + columns.count();
                rows.push(Row {
                    word: (row * words + first / 64) as u32,
                    shift: (first % 64) as u32,
                    bits: ((1_u64 << count) - 1) as u32,
                });
            }
            starts.push(rows.len() as u32);
        }
        Self {
            words,
            covered: vec![0; words * raster.rows],
            starts,
            rows,
        }
    }

    fn rows(&self, j: usize) -> &[Row] {
        &self.rows[self.starts[j] as usize..self.starts[j + 1] as usize]
    }

    fn gain(&self, j: usize) -> u32 {
        let mut gain = 0;
        for row in self.rows(j) {
            let word = row.word as usize;
            let pair = u128::from(self.covered[word]) | u128::from(self.covered[word + 1]) << 64;
            gain += (!((pair >> row.shift) as u32) & row.bits).count_ones();
        }
        gain
    }

    fn add(&mut self, j: usize) {
        let range = self.starts[j] as usize..self.starts[j + 1] as usize;
        for row in &self.rows[range] {
            let pair = u128::from(row.bits) << row.shift;
            self.covered[row.word as usize] |= pair as u64;
            self.covered[row.word as usize + 1] |= (pair >> 64) as u64;
        }
        debug_assert!(self.covered.chunks(self.words).all(|row| row[self.words - 1] == 0));
    }
}

/// The share of each cell that stays uncovered.
#[derive(Clone, Debug)]
struct Shares {
    missed: Vec<f64>,
    /// The rows of device j are `rows[starts[j] .. starts[j + 1]]`.
    starts: Vec<u32>,
    rows: Vec<Stretch>,
    /// p(d) of all cells of all stretches, one after the other.
    detected: Vec<f64>,
}

/// The cells of one row of the raster that a device may detect an event in.
#[derive(Clone, Copy, Debug)]
struct Stretch {
    /// The first of them, and the first of their p(d).
    cell: u32,
    detected: u32,
    length: u32,
}

impl Stretch {
    fn cells(self) -> std::ops::Range<usize> {
        self.cell as usize..(self.cell + self.length) as usize
    }

    fn detected(self) -> std::ops::Range<usize> {
        self.detected as usize..(self.detected + self.length) as usize
    }
}

impl Shares {
    fn new(raster: &Raster, positions: &[Point], sensing: &Sensing) -> Self {
        let (mut starts, mut rows, mut detected) = (vec![0], Vec::new(), Vec::new());
        for &p in positions {
            let [south_to_north, west_to_east] = raster.around(p, sensing.d_max);
            for row in south_to_north {
                let begin = detected.len() as u32;
                let mut first = None;
                // The cells of a row that are near enough are neighbours.
                for column in west_to_east.clone() {
                    let (_, middle) = raster.distances(row, column, p);
                    if middle <= sensing.d_max {
                        first = first.or(Some(column));
                        detected.push(sensing.p(middle));
                    }
                }
                rows.extend(first.map(|column| Stretch {
                    cell: (row * raster.columns + column) as u32,
                    detected: begin,
                    length: detected.len() as u32 - begin,
                }));
            }
            starts.push(rows.len() as u32);
        }
        Self {
            missed: vec![1.0; raster.cells()],
            starts,
            rows,
            detected,
        }
    }

    fn rows(&self, j: usize) -> &[Stretch] {
        &self.rows[self.starts[j] as usize..self.starts[j + 1] as usize]
    }

    fn cells(&self, j: usize) -> u32 {
        self.rows(j).iter().map(|row| row.length).sum()
    }

    fn gain(&self, j: usize) -> f64 {
        let mut lanes = [0.0; LANES];
        let mut rest = 0.0;
        for row in self.rows(j) {
            let (missed, detected) = (&self.missed[row.cells()], &self.detected[row.detected()]);
            let (missed, last_missed) = missed.as_chunks::<LANES>();
            let (detected, last_detected) = detected.as_chunks::<LANES>();
            for (missed, detected) in missed.iter().zip(detected) {
                for lane in 0..LANES {
                    lanes[lane] += missed[lane] * detected[lane];
                }
            }
            for (missed, detected) in last_missed.iter().zip(last_detected) {
                rest += missed * detected;
            }
        }
        lanes.iter().sum::<f64>() + rest
    }

    fn add(&mut self, j: usize) {
        let Self {
            missed,
            starts,
            rows,
            detected,
        } = self;
        for row in &rows[starts[j] as usize..starts[j + 1] as usize] {
            for (missed, p) in missed[row.cells()].iter_mut().zip(&detected[row.detected()]) {
                *missed *= 1.0 - p;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use reveille_common::geometry::{Layout, place};
    use reveille_common::rng::{Purpose, Stream};
    use reveille_common::sensing::Fusion;

    use super::*;

    fn sensing(kind: DetectionKind) -> Sensing {
        Sensing {
            kind,
            d_max: 4.0,
            eta: 1.0,
            psi: 1.0,
            g: Fusion::Max,
        }
    }

    const AREAS: [(f64, f64); 4] = [(20.0, 20.0), (31.0, 7.3), (3.0, 1.0), (70.0, 12.0)];

    #[test]
    fn gains_add_up_to_what_is_covered() {
        for kind in [DetectionKind::Range, DetectionKind::Probabilistic] {
            for (width, height) in AREAS {
                let area = Area { width, height };
                let points = place(&Layout::Uniform, area, 40, 5);
                let mut coverage = Coverage::new(&points, area, &sensing(kind));
                let mut sum = 0.0;
                assert!((coverage.uncovered() - 1.0).abs() < 1e-12);
                for j in 0..40 {
                    sum += coverage.gain(j);
                    coverage.add(j);
                    assert!((coverage.uncovered() - (1.0 - sum)).abs() < 1e-9, "{kind:?} {width}");
                    let again = coverage.gain(j);
                    assert!(again == 0.0, "{again}");
                }
                coverage.clear();
                assert!((coverage.uncovered() - 1.0).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn what_counts_as_covered_is_in_range_and_little_more_is_left_out() {
        for (width, height) in AREAS {
            let area = Area { width, height };
            let points = place(&Layout::Uniform, area, 8, 7);
            let mut coverage = Coverage::new(&points, area, &sensing(DetectionKind::Range));
            (0..8).for_each(|j| coverage.add(j));
            let mut stream = Stream::new(1, Purpose::Epicentre, 0);
            let (draws, mut reached, mut counted) = (40_000, 0, 0);
            let Cover::Range(bits) = &coverage.cover else {
                panic!("range")
            };
            for _ in 0..draws {
                let p = Point::new(stream.unit() * width, stream.unit() * height);
                let raster = &coverage.raster;
                let (row, column) = ((p.y / raster.height) as usize, (p.x / raster.width) as usize);
                let is_counted = bits.covered[row * bits.words + column / 64] >> (column % 64) & 1 == 1;
                let is_reached = points.iter().any(|q| q.distance(p) <= 4.0);
                assert!(is_reached || !is_counted, "{p:?} counts as covered");
                reached += u32::from(is_reached);
                counted += u32::from(is_counted);
            }
            assert!(
                f64::from(counted) > 0.8 * f64::from(reached),
                "{counted} of {reached}, {width} m"
            );
            let share = f64::from(counted) / f64::from(draws);
            assert!((1.0 - coverage.uncovered() - share).abs() < 0.02, "{share}");
        }
    }
}
