//! Named random streams, the only source of randomness in the model.
//!
//! Each stream is keyed by the scenario's seed, a [`Purpose`], and a device or an event. No draw depends on the process
//! or on draws from other streams, so a run is the same however it is scheduled. Any change of a key, a purpose's
//! number or the arithmetic of a draw changes all digests. The reference in `tests/src/` draws from the same streams:
//! it cannot find an error here.

use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::{Rng, SeedableRng};

/// The purpose of a stream. The numbers are part of the digest's meaning: never renumber them. A new purpose has a new
/// number, and a policy that uses it a variant of [`PolicyPurpose`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u64)]
pub enum Purpose {
    /// Positions of the devices (one stream a run).
    Layout = 1,
    /// The assignment of devices to classes (one stream a run).
    Classes = 2,
    /// A device's energy arrivals.
    Harvest = 3,
    /// The gap before an event, in TTIs.
    EventGap = 4,
    /// An event's epicentre.
    Epicentre = 5,
    /// Whether a device detects an event (keyed by both).
    Detection = 6,
    /// A device's duty cycle under the `random` policy.
    DutyCycle = 7,
    /// The k-means++ start of the clusters (one stream a run).
    Clusters = 8,
    /// The exploration of a learning policy (one stream a TTI).
    Exploration = 9,
    /// Battery levels at the start of a training run (one stream a run).
    Training = 10,
    /// The weights that a tuning tries (one stream for the initial points, one for each later point).
    Tuning = 11,
    /// The duration of an event, if it is random.
    EventDuration = 12,
    /// The hot spots of events (one stream a run).
    HotSpots = 13,
    /// Whether an event is near a hot spot or near the previous event, and its position there.
    Attraction = 14,
    /// The busy and the quiet phases of the event process (one stream a run).
    EventPhases = 15,
    /// The order in which devices take their offsets under the `adjusted` policy (one stream a run).
    Offsets = 16,
    /// Whether a wake-up radio misses a wake-up (keyed by device and TTI).
    WakeMiss = 20,
    /// The TTIs of a device's false wake-ups.
    FalseWakeUps = 21,
    /// Whether the radio loses a report (keyed by device and TTI).
    UplinkLoss = 22,
    /// Whether a device misses a plan (keyed by device and TTI).
    PlanLoss = 23,
    /// The bursts of interference (one stream a run).
    InterferencePhases = 24,
    /// The random times of scripted actions on a device (keyed by the line of the script and the device).
    Actions = 25,
    /// Which segments `reveille link` loses (one stream for each direction of a connection). No run draws from it.
    LinkLoss = 26,
}

/// A stream of pseudo-random numbers (xoshiro256++), the same on every machine.
#[derive(Clone, Debug)]
pub struct Stream(Xoshiro256PlusPlus);

impl Stream {
    /// Creates the stream of `purpose` for `id` (a device or event number; 0 if a run has only one such stream).
    pub fn new(seed: u64, purpose: Purpose, id: u64) -> Self {
        Self(Xoshiro256PlusPlus::seed_from_u64(stream_key(seed, purpose, id)))
    }

    /// Draws a number uniform on `[0, 1)`, with 53 random bits.
    pub fn unit(&mut self) -> f64 {
        to_unit(self.0.next_u64())
    }

    /// Draws a whole number uniform on `0 .. n`.
    ///
    /// # Panics
    /// If `n` is 0.
    pub fn below(&mut self, n: u64) -> u64 {
        assert!(n > 0, "an empty range has no element to draw");
        // Lemire's method: low words below 2⁶⁴ mod n are rejected, because they would make some results more likely.
        let threshold = n.wrapping_neg() % n;
        loop {
            let wide = u128::from(self.0.next_u64()) * u128::from(n);
            if wide as u64 >= threshold {
                return (wide >> 64) as u64;
            }
        }
    }

    /// Shuffles `items` (Fisher and Yates).
    pub fn shuffle<T>(&mut self, items: &mut [T]) {
        for i in (1..items.len()).rev() {
            let j = self.below(i as u64 + 1) as usize;
            items.swap(i, j);
        }
    }
}

/// Draws a number uniform on `[0, 1)` for `purpose` and the pair of ids (`a`, `b`), without a stream.
pub fn unit_for_pair(seed: u64, purpose: Purpose, a: u64, b: u64) -> f64 {
    to_unit(mix_bits(
        stream_key(seed, purpose, a) ^ mix_bits(b ^ 0xD1B5_4A32_D192_ED03),
    ))
}

/// The purposes of the draws that a policy may make.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PolicyPurpose {
    /// See [`Purpose::DutyCycle`].
    DutyCycle,
    /// See [`Purpose::Clusters`].
    Clusters,
    /// See [`Purpose::Exploration`].
    Exploration,
    /// See [`Purpose::Offsets`].
    Offsets,
}

impl PolicyPurpose {
    const fn purpose(self) -> Purpose {
        match self {
            Self::DutyCycle => Purpose::DutyCycle,
            Self::Clusters => Purpose::Clusters,
            Self::Exploration => Purpose::Exploration,
            Self::Offsets => Purpose::Offsets,
        }
    }
}

/// The random streams of a policy. They come from the scenario's seed, which is private: with it a policy could
/// predict events and harvests.
#[derive(Clone)]
pub struct PolicyStreams {
    seed: u64,
}

impl PolicyStreams {
    /// Creates the streams of a run with this seed.
    pub const fn new(seed: u64) -> Self {
        Self { seed }
    }

    /// Returns the stream of `purpose` for `id`, see [`Stream::new`].
    pub fn stream(&self, purpose: PolicyPurpose, id: u64) -> Stream {
        Stream::new(self.seed, purpose.purpose(), id)
    }

    /// Draws a number for `purpose` and (`a`, `b`), uniform on `[0, 1)`, see [`unit_for_pair`].
    pub fn unit_for_pair(&self, purpose: PolicyPurpose, a: u64, b: u64) -> f64 {
        unit_for_pair(self.seed, purpose.purpose(), a, b)
    }
}

/// Omits the seed.
impl std::fmt::Debug for PolicyStreams {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("PolicyStreams")
    }
}

/// The distribution of the gap between two successes of a Bernoulli trial made once per TTI.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Geometric {
    /// 1 / ln(1 − p).
    inverse_log_failure: f64,
}

impl Geometric {
    /// Creates the distribution for a trial with success probability `p`, `0 ..= 1`. With `p = 0` it never succeeds.
    ///
    /// # Panics
    /// If `p` is outside this range.
    pub fn new(p: f64) -> Self {
        assert!((0.0..=1.0).contains(&p), "the probability {p} is not within 0 and 1");
        Self {
            inverse_log_failure: 1.0 / libm::log1p(-p),
        }
    }

    /// Draws a gap of 1, 2, … TTIs; `u64::MAX` for never.
    pub fn draw(self, stream: &mut Stream) -> u64 {
        self.gap(stream.unit())
    }

    /// Returns the gap for the draw `unit`, uniform on `[0, 1)`. It is non-decreasing in `unit`.
    fn gap(self, unit: f64) -> u64 {
        // Below 9·10¹⁵ an f64 holds every integer, and no run is as long. p = 0 with unit = 0 gives 0 · ∞, not a
        // number.
        let failures = libm::log1p(-unit) * self.inverse_log_failure;
        if failures.is_nan() || failures >= 9e15 {
            never_or_now(self)
        } else {
            failures as u64 + 1
        }
    }
}

/// Returns the gap if the quotient of logarithms has no finite value: p = 0 or a gap longer than any run.
fn never_or_now(distribution: Geometric) -> u64 {
    if distribution.inverse_log_failure == 0.0 {
        1
    } else {
        u64::MAX
    }
}

/// Number of leading bits of a draw that index a [`GapTable`].
const INDEX_BITS: u32 = 11;

/// A [`Geometric`] distribution that computes few logarithms: a table over the leading bits of the draw holds the gap
/// wherever those bits alone decide it. Every draw equals the distribution's.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct GapTable {
    distribution: Geometric,
    /// The gap for each value of the leading bits, 0 if they do not decide it.
    gaps: Vec<u16>,
}

impl GapTable {
    /// Creates the table of `distribution`. Its 4096 logarithms pay off if thousands of gaps are drawn.
    pub(crate) fn new(distribution: Geometric) -> Self {
        let cells = 1_u64 << INDEX_BITS;
        // The first draw of cell c, c = 0 ..= cells, and the last of the cell before it. For c = cells the shift gives
        // 0, which wraps to the largest draw.
        let first_draw = |c: u64| to_unit(c << (64 - INDEX_BITS));
        let last_draw = |c: u64| to_unit((c << (64 - INDEX_BITS)).wrapping_sub(1));
        let decided_gap = |c: u64| {
            // The gap is non-decreasing in the draw, so equal gaps at both ends hold for the whole cell.
            let gap = distribution.gap(first_draw(c));
            (gap == distribution.gap(last_draw(c + 1)))
                .then(|| u16::try_from(gap).ok())
                .flatten()
        };
        Self {
            distribution,
            gaps: (0..cells).map(|c| decided_gap(c).unwrap_or(0)).collect(),
        }
    }

    /// Draws a gap of 1, 2, … TTIs; `u64::MAX` for never.
    #[inline]
    pub(crate) fn draw(&self, stream: &mut Stream) -> u64 {
        let bits = stream.0.next_u64();
        match self.gaps[(bits >> (64 - INDEX_BITS)) as usize] {
            0 => self.distribution.gap(to_unit(bits)),
            gap => u64::from(gap),
        }
    }
}

fn stream_key(seed: u64, purpose: Purpose, id: u64) -> u64 {
    mix_bits(
        mix_bits(seed ^ (purpose as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15))
            .wrapping_add(id.wrapping_mul(0xBF58_476D_1CE4_E5B9)),
    )
}

/// The finaliser of `SplitMix64`: a bijection of 64 bits that spreads every input bit over the whole word.
fn mix_bits(mut z: u64) -> u64 {
    z = z.wrapping_add(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

fn to_unit(bits: u64) -> f64 {
    // 53 bits fill the mantissa of an f64: each value is exact, and rounding never gives 1.
    (bits >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn geometric_gaps_have_the_mean_one_over_p() {
        for p in [0.05, 0.2, 0.9] {
            let (distribution, mut stream, n) = (Geometric::new(p), Stream::new(7, Purpose::EventGap, 3), 200_000);
            let mean = (0..n).map(|_| distribution.draw(&mut stream) as f64).sum::<f64>() / f64::from(n);
            let standard_error = ((1.0 - p) / (p * p) / f64::from(n)).sqrt();
            assert!((mean - 1.0 / p).abs() < 4.0 * standard_error, "p {p}: mean {mean}");
        }
    }

    #[test]
    fn certain_success_has_gap_one_and_impossible_success_none() {
        let mut stream = Stream::new(1, Purpose::Harvest, 0);
        for _ in 0..1000 {
            assert_eq!(Geometric::new(1.0).draw(&mut stream), 1);
            assert_eq!(Geometric::new(0.0).draw(&mut stream), u64::MAX);
        }
    }

    #[test]
    fn a_gap_table_draws_the_same_as_its_distribution() {
        for p in [0.0, 1e-12, 1e-4, 0.090_483_741_8, 0.5, 0.97, 1.0] {
            let (distribution, table) = (Geometric::new(p), GapTable::new(Geometric::new(p)));
            let (mut stream, mut same_stream) =
                (Stream::new(8, Purpose::Harvest, 1), Stream::new(8, Purpose::Harvest, 1));
            for draw in 0..300_000 {
                assert_eq!(
                    table.draw(&mut stream),
                    distribution.draw(&mut same_stream),
                    "p {p}, draw {draw}"
                );
            }
        }
    }

    #[test]
    fn neighbouring_streams_are_uncorrelated() {
        let n = 20_000;
        let first_draw = |id: u64| Stream::new(5, Purpose::Epicentre, id).unit();
        let mean = (0..n).map(first_draw).sum::<f64>() / n as f64;
        let covariance = (0..n)
            .map(|i| (first_draw(i) - 0.5) * (first_draw(i + 1) - 0.5))
            .sum::<f64>()
            / n as f64;
        // The bounds are about five standard deviations.
        assert!((mean - 0.5).abs() < 0.01, "mean {mean}");
        assert!(covariance.abs() < 0.003, "covariance {covariance}");
        let pair_mean = (0..n)
            .map(|i| unit_for_pair(5, Purpose::Detection, i, i ^ 1))
            .sum::<f64>()
            / n as f64;
        assert!((pair_mean - 0.5).abs() < 0.01, "mean of pairs {pair_mean}");
    }

    #[test]
    fn below_covers_its_range_evenly() {
        let mut stream = Stream::new(2, Purpose::Layout, 0);
        // 10 000 on average for each value, with a standard deviation of 93.
        let mut counts = [0u32; 7];
        for _ in 0..70_000 {
            counts[stream.below(7) as usize] += 1;
        }
        assert!(
            counts.iter().all(|&c| (9_600..10_400).contains(&c)),
            "draws by value: {counts:?}"
        );
    }
}
