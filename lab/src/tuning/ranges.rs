//! The search ranges of the weights on a logarithmic scale, and the first pairs to try.

use libm::{exp, log};
use reveille_common::rng::{Purpose, Stream};

use super::error::TuningError;

/// μ1, the weight of misdetections, and μ2, the weight of information (Sec. V-B).
pub type WeightPair = [f64; 2];

/// The smallest number of pairs in a design: a surrogate of two variables needs them.
pub const LEAST_DESIGN: usize = 3;
/// The largest weight in a range.
const LARGEST: f64 = 1e6;
/// The number of Latin hypercubes, of which the one with the widest gaps is used.
const HYPERCUBES: u32 = 64;
/// The number of random pairs, of which the one farthest from all others is used.
const CANDIDATES: u32 = 256;
/// Distance, as a share of the ranges, up to which two pairs count as equal.
const NEAR: f64 = 2e-3;

/// The ranges of both weights.
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
        for (what, (from, to)) in [("mu1", mu1), ("mu2", mu2)] {
            if !(from > 0.0 && from < to && to <= LARGEST) {
                return Err(TuningError::Invalid {
                    what,
                    value: format!("{from},{to}"),
                    allowed: "must be two weights above 0 and at most 1000000, the lesser first".to_owned(),
                });
            }
        }
        Ok(Self { mu1, mu2 })
    }

    fn ends(&self) -> [(f64, f64); 2] {
        [self.mu1, self.mu2]
    }

    /// Returns the pair at `place`, given as shares of the ranges' logarithms, `[0, 1]` each.
    pub fn at(&self, place: [f64; 2]) -> WeightPair {
        let ends = self.ends();
        [0, 1].map(|i| {
            let (from, to) = ends[i];
            // `exp` of a logarithm may leave the range in its last bits.
            exp(log(from) + place[i] * (log(to) - log(from))).clamp(from, to)
        })
    }

    /// Returns the place of `pair`, the inverse of [`Self::at`].
    pub fn place(&self, pair: WeightPair) -> [f64; 2] {
        let ends = self.ends();
        [0, 1].map(|i| {
            let (from, to) = ends[i];
            (log(pair[i] / from) / log(to / from)).clamp(0.0, 1.0)
        })
    }

    /// Returns whether `pair` lies in the ranges.
    pub fn contains(&self, pair: WeightPair) -> bool {
        let ends = self.ends();
        [0, 1].iter().all(|&i| ends[i].0 <= pair[i] && pair[i] <= ends[i].1)
    }

    /// Rounds `pair` to five digits, so that typing it trains the same tables.
    pub fn rounded(&self, pair: WeightPair) -> WeightPair {
        let ends = self.ends();
        [0, 1].map(|i| {
            let short: f64 = format!("{:.4e}", pair[i]).parse().unwrap_or(pair[i]);
            // A limit with more than five digits may be rounded out of the range.
            short.clamp(ends[i].0, ends[i].1)
        })
    }

    /// Returns the distance to the closest of `others`, as a share of the ranges; infinite if `others` is empty.
    fn gap(&self, pair: WeightPair, others: &[WeightPair]) -> f64 {
        let [x, y] = self.place(pair);
        let distance = |other: &WeightPair| {
            let [u, v] = self.place(*other);
            ((x - u) * (x - u) + (y - v) * (y - v)).sqrt()
        };
        others.iter().map(distance).fold(f64::INFINITY, f64::min)
    }

    /// Returns whether one of `others` counts as equal to `pair`.
    pub fn is_near(&self, pair: WeightPair, others: &[WeightPair]) -> bool {
        self.gap(pair, others) <= NEAR
    }

    /// Returns a pair far from all of `others`, drawn with `seed` for the point `number`.
    pub fn farthest(&self, others: &[WeightPair], seed: u64, number: u64) -> WeightPair {
        let mut stream = Stream::new(seed, Purpose::Tuning, number);
        let drawn = (0..CANDIDATES).map(|_| self.rounded(self.at([stream.unit(), stream.unit()])));
        let best = drawn.map(|pair| (self.gap(pair, others), pair));
        let best = best.max_by(|a, b| a.0.total_cmp(&b.0));
        best.expect("there are candidates").1
    }
}

/// Returns the first pairs to try: `start`, if `ranges` contain it, and a Latin hypercube, `count` in all.
pub fn design(ranges: &Ranges, start: WeightPair, count: usize, seed: u64) -> Vec<WeightPair> {
    let known: Vec<WeightPair> = Some(start).filter(|pair| ranges.contains(*pair)).into_iter().collect();
    // `count` is at least `LEAST_DESIGN`, and at most one pair is known.
    let rest = count - known.len();
    let mut stream = Stream::new(seed, Purpose::Tuning, 0);
    let hypercubes = (0..HYPERCUBES).map(|_| {
        let mut all = known.clone();
        let mut least = f64::INFINITY;
        for place in hypercube(rest, &mut stream) {
            let pair = ranges.rounded(ranges.at(place));
            least = least.min(ranges.gap(pair, &all));
            all.push(pair);
        }
        (least, all)
    });
    let widest = hypercubes.max_by(|a, b| a.0.total_cmp(&b.0));
    widest.expect("there are hypercubes").1
}

/// Draws places of which no two share a row or a column of a grid with `count` of each.
fn hypercube(count: usize, stream: &mut Stream) -> Vec<[f64; 2]> {
    let (columns, mut rows): (Vec<usize>, Vec<usize>) = ((0..count).collect(), (0..count).collect());
    stream.shuffle(&mut rows);
    let mut within = |i: usize| (i as f64 + stream.unit()) / count as f64;
    let places = columns.into_iter().zip(rows);
    places.map(|(x, y)| [within(x), within(y)]).collect()
}
