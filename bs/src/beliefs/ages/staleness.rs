//! Ages for devices that only record looks, without choosing devices ahead or removing them. The history of external
//! policies (`policy/external/history.rs`) reads their worths as features, so these must be bit-equal to the gains in
//! [`Ages`], as a test below checks.
//!
//! An environment keeps these ages for each of its runs and reads all devices in each step. So they are small: three
//! bytes per cell and 36 per device.

use reveille_common::geometry::{Area, Point};
use reveille_common::sensing::{DetectionKind, Sensing};

use super::Ages;
use super::cells::{Cells, DISC_SIDE};
use super::index_table;

/// Worth of a look relative to a look right after another, for each device and for the whole area.
#[derive(Clone, Debug)]
pub(crate) struct Staleness {
    model: StalenessModel,
    /// Worth of a look by device, if every place was covered in the last TTI.
    fresh_worths: Vec<f64>,
    /// Worth of a look at the whole area in that case.
    fresh_total: f64,
}

#[derive(Clone, Debug)]
enum StalenessModel {
    Certain(CertainStaleness),
    Probabilistic(Box<Ages>),
}

impl Staleness {
    /// Creates the state before the first TTI; arguments as in [`Ages::with_loss`].
    pub(crate) fn with_loss(loss_probability: f64, positions: &[Point], area: Area, sensing: &Sensing) -> Self {
        let model = match sensing.kind {
            DetectionKind::Range if loss_probability <= 0.0 => {
                StalenessModel::Certain(CertainStaleness::new(area, positions, sensing.d_max))
            }
            DetectionKind::Range | DetectionKind::Probabilistic => {
                StalenessModel::Probabilistic(Box::new(Ages::with_loss(loss_probability, positions, area, sensing)))
            }
        };
        let mut staleness = Self {
            model,
            fresh_worths: Vec::new(),
            fresh_total: 0.0,
        };
        // All ages are 1 here, so these are the worths right after a look.
        staleness.fresh_worths = (0..positions.len()).map(|j| staleness.worth(j)).collect();
        staleness.fresh_total = staleness.total_worth();
        staleness
    }

    /// Lets the `j`-th device sense in the next TTI; at most one call per device and TTI. Call [`Self::advance`] before
    /// the next reading: until then the two models give different values.
    #[inline]
    pub(crate) fn add(&mut self, j: usize) {
        match &mut self.model {
            StalenessModel::Certain(certain) => certain.add(j),
            StalenessModel::Probabilistic(ages) => ages.add(j),
        }
    }

    /// Passes a TTI. All ages are 1 again if `is_event_reported`.
    pub(crate) fn advance(&mut self, is_event_reported: bool) {
        match &mut self.model {
            StalenessModel::Certain(certain) => certain.advance(is_event_reported),
            StalenessModel::Probabilistic(ages) => ages.advance(is_event_reported),
        }
    }

    /// Returns the worth of a look of the `j`-th device, ≥ 1, relative to its worth right after a look. A device
    /// without cells has worth 1.
    #[inline]
    pub(crate) fn device_staleness(&self, j: usize) -> f64 {
        let fresh = self.fresh_worths[j];
        if fresh > 0.0 { self.worth(j) / fresh } else { 1.0 }
    }

    /// Returns the worth of a look at the whole area, ≥ 1, relative to its worth right after a look.
    pub(crate) fn area_staleness(&self) -> f64 {
        self.total_worth() / self.fresh_total
    }

    #[inline]
    fn worth(&self, j: usize) -> f64 {
        match &self.model {
            StalenessModel::Certain(certain) => f64::from(certain.worth(j)),
            StalenessModel::Probabilistic(ages) => ages.gain(j),
        }
    }

    fn total_worth(&self) -> f64 {
        match &self.model {
            StalenessModel::Certain(certain) => certain.total_worth as f64,
            StalenessModel::Probabilistic(ages) => ages.total_worth(),
        }
    }
}

/// Cells that a device covers. In row i of the square at `corner`, these are `row_spans[i].1` cells from column
/// `row_spans[i].0` of the square on.
#[derive(Clone, Debug)]
struct RowDisc {
    corner: u32,
    row_spans: [(u8, u8); DISC_SIDE],
}

impl RowDisc {
    /// Returns the index of the first covered cell of each row, and the index after the last.
    #[inline]
    fn cell_ranges(&self, stride: usize) -> impl Iterator<Item = (usize, usize)> {
        let row_begins = (0..).map(move |i| self.corner as usize + i * stride);
        let rows = row_begins.zip(&self.row_spans);
        rows.map(|(row_begin, (first, count))| {
            let first = row_begin + usize::from(*first);
            (first, first + usize::from(*count))
        })
    }
}

/// Ages in whole TTIs, row by row. If the area has fewer rows or columns than a square, the rest are cells outside it.
#[derive(Clone, Debug)]
struct CertainStaleness {
    stride: usize,
    columns: usize,
    rows: usize,
    discs: Vec<RowDisc>,
    /// Age of each cell; 0 in a TTI in which a device covers it.
    ages: Vec<u8>,
    /// Prefix sums of the worths, modulo 2¹⁶, with the sum of all cells last. A difference below 2¹⁶ is exact.
    prefix_sums: Vec<u16>,
    /// Sum of the worths of the area.
    total_worth: u64,
}

impl CertainStaleness {
    fn new(area: Area, positions: &[Point], d_max: f64) -> Self {
        let cells = Cells::new(area, d_max);
        let [rows, columns] = cells.rows_and_columns();
        let (stride, height) = (columns.max(DISC_SIDE), rows.max(DISC_SIDE));
        let disc = |&p: &Point| {
            let spans = cells.within(p, d_max);
            // Rows of a square are read in full, so the square moves inwards at the border.
            let south = spans.first().map_or(0, |span| span.row).min(height - DISC_SIDE);
            let west = spans.iter().map(|span| span.first_column).min().unwrap_or(0);
            let west = west.min(stride - DISC_SIDE);
            let mut row_spans = [(0, 0); DISC_SIDE];
            for span in &spans {
                row_spans[span.row - south] = ((span.first_column - west) as u8, span.count as u8);
            }
            RowDisc {
                corner: (south * stride + west) as u32,
                row_spans,
            }
        };
        let mut certain = Self {
            stride,
            columns,
            rows,
            discs: positions.iter().map(disc).collect(),
            ages: vec![0; stride * height],
            prefix_sums: vec![0; stride * height + 1],
            total_worth: 0,
        };
        // Before the first TTI every place has age 1, as after a reported event.
        certain.advance(true);
        certain
    }

    #[inline]
    fn add(&mut self, j: usize) {
        let disc = &self.discs[j];
        let mut begin = disc.corner as usize;
        for (first, count) in &disc.row_spans {
            let ages = self.ages[begin..].first_chunk_mut::<DISC_SIDE>().expect(SQUARE_FITS);
            begin += self.stride;
            // One byte per cell, the first cell in the lowest byte.
            let cells = match count {
                0 => continue,
                count => u128::MAX >> (128 - 8 * u32::from(*count)) << (8 * u32::from(*first)),
            };
            *ages = (u128::from_le_bytes(*ages) & !cells).to_le_bytes();
        }
    }

    fn advance(&mut self, is_event_reported: bool) {
        if is_event_reported {
            self.ages.fill(0);
        }
        let mut sum = 0_u64;
        for (ages, prefix_sums) in self.ages.chunks_mut(LANES).zip(self.prefix_sums[1..].chunks_mut(LANES)) {
            // Ages and worths first: without the running sum, cells do not depend on each other and are computed in
            // parallel.
            let mut worths = [0_u8; LANES];
            for (age, worth) in ages.iter_mut().zip(&mut worths) {
                *age = age.saturating_add(1);
                *worth = index_table::worth_at_age(*age);
            }
            for (prefix_sum, worth) in prefix_sums.iter_mut().zip(worths) {
                sum += u64::from(worth);
                // Wraps on purpose: only differences over one row are used, at most 16 · 255.
                *prefix_sum = sum as u16;
            }
        }
        self.total_worth = sum - self.worth_outside_area();
    }

    /// Returns the sum of the worths of the cells outside the area, usually none.
    fn worth_outside_area(&self) -> u64 {
        if self.ages.len() == self.rows * self.columns {
            return 0;
        }
        let rows = self.ages.chunks_exact(self.stride).enumerate();
        let beyond = rows.flat_map(|(row, ages)| &ages[if row < self.rows { self.columns } else { 0 }..]);
        beyond.map(|age| u64::from(index_table::worth_at_age(*age))).sum()
    }

    /// Returns the worth of a look, at most 16 · 16 · 255.
    #[inline]
    fn worth(&self, j: usize) -> u32 {
        let ranges = self.discs[j].cell_ranges(self.stride);
        ranges
            .map(|(first, end)| u32::from(self.prefix_sums[end].wrapping_sub(self.prefix_sums[first])))
            .sum()
    }
}

/// Cells computed in parallel.
const LANES: usize = 64;

const SQUARE_FITS: &str = "a square is within the cells";

#[cfg(test)]
mod tests {
    use reveille_common::geometry::{Layout, place_devices};
    use reveille_common::rng::{Purpose, Stream};
    use reveille_common::sensing::Fusion;

    use super::*;

    /// Random looks, in areas with fewer rows or columns than a square and in large ones.
    #[test]
    fn staleness_equals_ratios_of_gains_in_ages_bit_by_bit() {
        for (kind, loss_probability) in [
            (DetectionKind::Range, 0.0),
            (DetectionKind::Range, 0.3),
            (DetectionKind::Probabilistic, 0.0),
        ] {
            for (width, height) in [(20.0, 20.0), (31.0, 7.3), (3.0, 1.0), (70.0, 12.0), (5.0, 60.0)] {
                let sensing = Sensing {
                    kind,
                    d_max: 4.0,
                    eta: 1.0,
                    psi: 1.0,
                    g: Fusion::Max,
                };
                let area = Area { width, height };
                let positions = place_devices(&Layout::Uniform, area, 25, 3);
                let mut stream = Stream::new(9, Purpose::Epicentre, 0);
                let mut ages = Ages::with_loss(loss_probability, &positions, area, &sensing);
                let mut staleness = Staleness::with_loss(loss_probability, &positions, area, &sensing);
                let fresh_worths: Vec<f64> = (0..25).map(|j| ages.gain(j)).collect();
                let fresh_total = ages.total_worth();
                for _ in 0..300 {
                    for (j, fresh_worth) in fresh_worths.iter().enumerate() {
                        let expected = if *fresh_worth > 0.0 {
                            ages.gain(j) / fresh_worth
                        } else {
                            1.0
                        };
                        assert_eq!(
                            staleness.device_staleness(j).to_bits(),
                            expected.to_bits(),
                            "{kind:?}, loss {loss_probability}, {width} m wide, device {j}"
                        );
                    }
                    assert_eq!(
                        staleness.area_staleness().to_bits(),
                        (ages.total_worth() / fresh_total).to_bits(),
                        "{kind:?}, loss {loss_probability}, {width} m wide"
                    );
                    for j in (0..25).filter(|_| stream.unit() < 0.06) {
                        ages.add(j);
                        staleness.add(j);
                    }
                    let is_event_reported = stream.unit() < 0.02;
                    ages.advance(is_event_reported);
                    staleness.advance(is_event_reported);
                }
            }
        }
    }
}
