//! Where weights are looked for, by their logarithms, and which pairs are tried first.

use libm::{exp, log};
use reveille_common::rng::{Purpose, Stream};

use super::error::TuningError;

/// μ1, the weight of misdetections, and μ2, that of information (Sec. V-B).
pub type Pair = [f64; 2];

/// The fewest pairs of a design: a surrogate of two variables needs them.
pub const LEAST_DESIGN: usize = 3;
/// The largest weight that a range may have.
const LARGEST: f64 = 1e6;
/// Latin hypercubes among which that of the widest gaps is taken.
const HYPERCUBES: u32 = 64;
/// Pairs among which the one farthest from all others is taken.
const CANDIDATES: u32 = 256;
/// Pairs at most so far apart, as a share of the ranges, count as the same.
const NEAR: f64 = 2e-3;

/// The ranges of both weights.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ranges {
    /// Least and largest μ1.
    pub mu1: (f64, f64),
    /// Least and largest μ2.
    pub mu2: (f64, f64),
}

impl Ranges {
    /// The ranges between these ends.
    ///
    /// # Errors
    /// An end is not above 0 or too large, or the first is not below the second.
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

    /// The pair at `place`, shares of the ranges' logarithms, `[0, 1]` each.
    pub fn at(&self, place: [f64; 2]) -> Pair {
        let ends = self.ends();
        [0, 1].map(|i| {
            let (from, to) = ends[i];
            exp(log(from) + place[i] * (log(to) - log(from))).clamp(from, to)
        })
    }

    /// Where `pair` is, as [`Self::at`] has it.
    pub fn place(&self, pair: Pair) -> [f64; 2] {
        let ends = self.ends();
        [0, 1].map(|i| {
            let (from, to) = ends[i];
            (log(pair[i] / from) / log(to / from)).clamp(0.0, 1.0)
        })
    }

    /// Whether `pair` lies in them.
    pub fn hold(&self, pair: Pair) -> bool {
        let ends = self.ends();
        [0, 1].iter().all(|&i| ends[i].0 <= pair[i] && pair[i] <= ends[i].1)
    }

    /// `pair` to five digits, so that whoever types it trains the same tables.
    pub fn rounded(&self, pair: Pair) -> Pair {
        let ends = self.ends();
        [0, 1].map(|i| {
            let short: f64 = format!("{:.4e}", pair[i]).parse().unwrap_or(pair[i]);
            short.clamp(ends[i].0, ends[i].1)
        })
    }

    /// The distance to the closest of `others`, as a share of the ranges; infinite if there is none.
    fn gap(&self, pair: Pair, others: &[Pair]) -> f64 {
        let [x, y] = self.place(pair);
        let distance = |other: &Pair| {
            let [u, v] = self.place(*other);
            ((x - u) * (x - u) + (y - v) * (y - v)).sqrt()
        };
        others.iter().map(distance).fold(f64::INFINITY, f64::min)
    }

    /// Whether one of `others` is as good as the same.
    pub fn is_near(&self, pair: Pair, others: &[Pair]) -> bool {
        self.gap(pair, others) <= NEAR
    }

    /// A pair far from all of `others`, drawn with `seed` for the point `number`.
    pub fn farthest(&self, others: &[Pair], seed: u64, number: u64) -> Pair {
        let mut stream = Stream::new(seed, Purpose::Tuning, number);
        let drawn = (0..CANDIDATES).map(|_| self.rounded(self.at([stream.unit(), stream.unit()])));
        let best = drawn.map(|pair| (self.gap(pair, others), pair));
        let best = best.max_by(|a, b| a.0.total_cmp(&b.0));
        best.expect("there are candidates").1
    }
}

/// The pairs to try first: `start`, if `ranges` hold it, and a Latin hypercube, `count` in all.
pub fn design(ranges: &Ranges, start: Pair, count: usize, seed: u64) -> Vec<Pair> {
    let known: Vec<Pair> = Some(start).filter(|pair| ranges.hold(*pair)).into_iter().collect();
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

/// Places of which no two share a row or a column of a grid with `count` of each.
fn hypercube(count: usize, stream: &mut Stream) -> Vec<[f64; 2]> {
    let (columns, mut rows): (Vec<usize>, Vec<usize>) = ((0..count).collect(), (0..count).collect());
    stream.shuffle(&mut rows);
    let mut within = |i: usize| (i as f64 + stream.unit()) / count as f64;
    let places = columns.into_iter().zip(rows);
    places.map(|(x, y)| [within(x), within(y)]).collect()
}
