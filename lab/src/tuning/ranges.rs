//! The search ranges of the weights on a logarithmic scale, and the first pairs to try. A position is a place in the
//! unit square: the shares of the ranges' logarithms.
//!
//! A resumed tuning must choose the pairs of an uninterrupted one. [`super::Tuner::open`] refuses a history of another
//! version or plan, or with another design. It cannot see a change of the later pairs (`draw_farthest`,
//! `is_close_to_any`, `position`), which within a version silently alters resumed tunings.

use libm::{exp, log};
use reveille_common::rng::{Purpose, Stream};

use super::error::TuningError;

/// μ1, the weight of misdetections, and μ2, the weight of information (Sec. V-B).
pub type WeightPair = [f64; 2];

/// The smallest number of pairs in a design: a surrogate of two variables needs them.
pub const MIN_DESIGN_PAIRS: usize = 3;
/// The largest weight in a range; the error text of [`Ranges::new`] repeats it.
const MAX_WEIGHT: f64 = 1e6;
/// The number of Latin hypercubes, of which the one with the widest gaps is used.
const HYPERCUBES: u32 = 64;
/// The number of random pairs, of which the one farthest from all others is used.
const FARTHEST_CANDIDATES: u32 = 256;
/// Distance, as a share of the ranges, up to which two pairs count as equal.
const SAME_PAIR_DISTANCE: f64 = 2e-3;

/// The ranges of both weights. The methods rely on the checks of [`Ranges::new`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ranges {
    /// The smallest and largest μ1.
    pub mu1: (f64, f64),
    /// The smallest and largest μ2.
    pub mu2: (f64, f64),
}

impl Ranges {
    /// Creates ranges with these limits.
    ///
    /// # Errors
    /// If a limit is not above 0 or is too large, or the first is not below the second.
    pub fn new(mu1: (f64, f64), mu2: (f64, f64)) -> Result<Self, TuningError> {
        for (option, (from, to)) in [("mu1", mu1), ("mu2", mu2)] {
            if !(from > 0.0 && from < to && to <= MAX_WEIGHT) {
                return Err(TuningError::Invalid {
                    option,
                    value: format!("{from},{to}"),
                    requirement: "must be two weights above 0 and at most 1000000, the lesser first".to_owned(),
                });
            }
        }
        Ok(Self { mu1, mu2 })
    }

    fn limits(&self) -> [(f64, f64); 2] {
        [self.mu1, self.mu2]
    }

    /// Returns the pair at `position`, given as shares of the ranges' logarithms, `[0, 1]` each.
    pub fn pair_at(&self, position: [f64; 2]) -> WeightPair {
        let limits = self.limits();
        [0, 1].map(|i| {
            let (from, to) = limits[i];
            // `exp` of a logarithm may leave the range in its last bits.
            exp(log(from) + position[i] * (log(to) - log(from))).clamp(from, to)
        })
    }

    /// Returns the position of `pair`, the inverse of [`Self::pair_at`]. A pair out of the ranges counts as the closest
    /// one in them.
    pub fn position(&self, pair: WeightPair) -> [f64; 2] {
        let limits = self.limits();
        [0, 1].map(|i| {
            let (from, to) = limits[i];
            (log(pair[i] / from) / log(to / from)).clamp(0.0, 1.0)
        })
    }

    /// Returns whether `pair` lies in the ranges.
    pub fn contains(&self, pair: WeightPair) -> bool {
        let limits = self.limits();
        [0, 1].iter().all(|&i| limits[i].0 <= pair[i] && pair[i] <= limits[i].1)
    }

    /// Rounds `pair` to five digits, so that typing it trains the same tables.
    pub fn rounded(&self, pair: WeightPair) -> WeightPair {
        let limits = self.limits();
        [0, 1].map(|i| {
            let short: f64 = format!("{:.4e}", pair[i]).parse().unwrap_or(pair[i]);
            // A limit with more than five digits may be rounded out of the range.
            short.clamp(limits[i].0, limits[i].1)
        })
    }

    /// Returns the distance to the closest of `known_pairs`, as a share of the ranges; infinite without pairs.
    fn distance_to_closest(&self, pair: WeightPair, known_pairs: &[WeightPair]) -> f64 {
        let [x, y] = self.position(pair);
        let distance = |other: &WeightPair| {
            let [u, v] = self.position(*other);
            ((x - u) * (x - u) + (y - v) * (y - v)).sqrt()
        };
        known_pairs.iter().map(distance).fold(f64::INFINITY, f64::min)
    }

    /// Returns whether one of `known_pairs` counts as equal to `pair`.
    pub fn is_close_to_any(&self, pair: WeightPair, known_pairs: &[WeightPair]) -> bool {
        self.distance_to_closest(pair, known_pairs) <= SAME_PAIR_DISTANCE
    }

    /// Returns a pair far from all of `known_pairs`, drawn from the stream `point_number` of `seed`, the point's number
    /// in the history. It is above 0, because [`design`] draws from stream 0.
    pub fn draw_farthest(&self, known_pairs: &[WeightPair], seed: u64, point_number: u64) -> WeightPair {
        let mut stream = Stream::new(seed, Purpose::Tuning, point_number);
        let candidates = (0..FARTHEST_CANDIDATES).map(|_| self.rounded(self.pair_at([stream.unit(), stream.unit()])));
        let with_distances = candidates.map(|pair| (self.distance_to_closest(pair, known_pairs), pair));
        let farthest = with_distances.max_by(|a, b| a.0.total_cmp(&b.0));
        farthest.expect("there are candidates").1
    }
}

/// Returns the first pairs to try: `start`, if `ranges` contain it, and a Latin hypercube, `count` in all. `count` is
/// at least [`MIN_DESIGN_PAIRS`]; `TuningPlan::check` refuses fewer.
pub fn design(ranges: &Ranges, start: WeightPair, count: usize, seed: u64) -> Vec<WeightPair> {
    let start_in_ranges: Vec<WeightPair> = Some(start).filter(|pair| ranges.contains(*pair)).into_iter().collect();
    let hypercube_count = count - start_in_ranges.len();
    let mut stream = Stream::new(seed, Purpose::Tuning, 0);
    let hypercubes = (0..HYPERCUBES).map(|_| {
        let mut pairs = start_in_ranges.clone();
        let mut smallest_distance = f64::INFINITY;
        for position in hypercube(hypercube_count, &mut stream) {
            let pair = ranges.rounded(ranges.pair_at(position));
            smallest_distance = smallest_distance.min(ranges.distance_to_closest(pair, &pairs));
            pairs.push(pair);
        }
        (smallest_distance, pairs)
    });
    let widest = hypercubes.max_by(|a, b| a.0.total_cmp(&b.0));
    widest.expect("there are hypercubes").1
}

/// Draws `count` positions, one in each row and each column of a grid of `count` × `count` cells on the unit square.
fn hypercube(count: usize, stream: &mut Stream) -> Vec<[f64; 2]> {
    let (columns, mut rows): (Vec<usize>, Vec<usize>) = ((0..count).collect(), (0..count).collect());
    stream.shuffle(&mut rows);
    let mut draw_within = |i: usize| (i as f64 + stream.unit()) / count as f64;
    let cells = columns.into_iter().zip(rows);
    cells.map(|(x, y)| [draw_within(x), draw_within(y)]).collect()
}
