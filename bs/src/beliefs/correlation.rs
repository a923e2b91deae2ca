//! The probability that a device has sensed an event that another device reported (Sec. III), `P_4,2`.
//!
//! [`Ranking`](super::ranking::Ranking) orders candidates by it. The order of float operations is fixed, since a
//! changed last bit can change which device is woken, and so the digest.

use std::f64::consts::{LOG2_E, PI};
use std::sync::Arc;

#[cfg(target_arch = "x86_64")]
use pulp::{f64x4, x86::V3};
use reveille_common::sensing::Sensing;

use crate::bounds_cache::{Band, BoundsCache, CorrelationBounds};

/// Points computed in parallel. Each lane has a sum, so the rounding of `P_4,2` depends on their number.
const LANES: usize = 2;

/// Quadrature points for η·`d_max` up to [`BASE_DECAY`].
const BASE_NODES: f64 = 18.0;

/// Largest number of quadrature points. No valid scenario needs as many; the limit bounds the work for other values.
const MAX_NODES: f64 = 1024.0;

/// η times the step of the grid of bounds, unless d would get more than [`MAX_GRID_STEPS`]. A smaller step gives
/// tighter bounds and more bands.
const GRID_STEP_DECAY: f64 = 0.1;
/// Largest number of steps of the grid along d.
const MAX_GRID_STEPS: f64 = 100.0;
/// Upper bound on the error of [`Correlation::p42`].
const QUADRATURE_ERROR: f64 = 1e-6;

/// Largest η·`d_max` for [`BASE_NODES`] points; beyond it the peak of the integrand is narrower and needs more points.
const BASE_DECAY: f64 = 8.0;

/// The wake-up correlation, Eq. (`cosine_rule2`) in the LaTeX source of the paper, prepared for the mean over the
/// unknown direction φ of the event.
#[derive(Clone, Debug)]
pub struct Correlation {
    sensing: Sensing,
    /// 2 (1 − cos φ) and the weight of each node φ on [0, π], [`LANES`] at a time; the weights add up to 1. The nodes
    /// follow the Gauss-Legendre rule in t ∈ [0, 1] with φ = πt³. Where γ is close to d the integrand nearly has a kink
    /// at φ = 0, and the cube gathers nodes there. The plain rule needs three times as many nodes for the same error.
    doubled_versines: Vec<[f64; LANES]>,
    weights: Vec<[f64; LANES]>,
    /// p(`d_max`).
    threshold: f64,
    bounds: Arc<CorrelationBounds>,
}

impl Correlation {
    /// Creates the correlation for the given sensing model. The bounds come from `cache`, computed if it has none.
    pub fn new(sensing: &Sensing, cache: &BoundsCache) -> Self {
        let decay_ratio = (sensing.eta * sensing.d_max / BASE_DECAY).max(1.0);
        let node_count = (BASE_NODES * decay_ratio.sqrt()).ceil().min(MAX_NODES) as usize;
        // A node of weight 0 fills the last lane.
        let nodes = gauss_legendre(node_count).chain(std::iter::once((1.0, 0.0)));
        let (doubled_versines, weights): (Vec<f64>, Vec<f64>) = nodes
            .map(|(t, weight)| {
                let t = 0.5 * (t + 1.0);
                let doubled_versine = 2.0 - 2.0 * libm::cos(PI * t * t * t);
                (doubled_versine, 0.5 * weight * 3.0 * t * t)
            })
            .unzip();
        let mut correlation = Self {
            sensing: sensing.clone(),
            doubled_versines: doubled_versines.as_chunks().0.to_vec(),
            weights: weights.as_chunks().0.to_vec(),
            threshold: sensing.p(sensing.d_max),
            bounds: Arc::default(),
        };
        let model_key = (sensing.eta.to_bits(), sensing.d_max.to_bits());
        correlation.bounds = cache.get_or_make(model_key, || correlation.compute_bounds());
        correlation
    }

    /// Computes the bands in descending order of bound, for each d of a grid. A step of h in d or in γ moves the event
    /// by at most h relative to the device, so ln p changes by at most ηh. A pair is at most half a step from its grid
    /// point in each coordinate, so the total change is at most ηh. The bounds depend on η and d_max alone, the key of
    /// the cache.
    fn compute_bounds(&self) -> CorrelationBounds {
        let Sensing { eta, d_max, .. } = self.sensing;
        let step = (GRID_STEP_DECAY / eta).max(d_max / MAX_GRID_STEPS);
        let rows = (d_max / step).round() as usize + 1;
        let columns = (2.0 * d_max / step).round() as usize + 2;
        // exp(ηh) bounds the change within a grid cell; the other factor covers the rounding of the bound.
        let error_factor = libm::exp(eta * step) * (1.0 + 1e-9);
        let bound_at = |i: usize, j: usize| {
            let bound = (self.p42(i as f64 * step, j as f64 * step) + QUADRATURE_ERROR) * error_factor;
            // For a steep decay the factor is large, but no probability exceeds 1.
            bound.min(1.0)
        };
        let band_at = |i: usize, column: usize| Band {
            column,
            bound: bound_at(i, column),
        };
        let bands_of_row = |i: usize| {
            let unfiltered = (0..columns).map(|column| band_at(i, column));
            let mut bands: Vec<Band> = unfiltered.filter(|band| band.bound >= self.threshold).collect();
            bands.sort_by(|a, b| b.bound.total_cmp(&a.bound));
            bands
        };
        CorrelationBounds {
            points_per_metre: 1.0 / step,
            columns,
            bands: (0..rows).map(bands_of_row).collect(),
        }
    }

    /// Returns the bands of γ that can hold a candidate for a reporter `d` metres from the event, the highest bound
    /// first.
    pub(crate) fn bands(&self, d: f64) -> &[Band] {
        let CorrelationBounds {
            points_per_metre,
            bands,
            ..
        } = &*self.bounds;
        // Rounding can place a reporter just beyond the last row.
        &bands[((d * points_per_metre + 0.5) as usize).min(bands.len() - 1)]
    }

    /// Returns the number of bands per metre, and the number of bands from γ = 0 to at least 2 `d_max`. The lists of
    /// neighbours must have the same bands.
    pub(crate) fn bands_per_metre_and_count(&self) -> (f64, usize) {
        (self.bounds.points_per_metre, self.bounds.columns)
    }

    /// Returns Pr(`S_j` = S3 | `S_h` = S3), `[0, 1]`: the mean of p(√(d² + γ² − 2dγ cos φ)) over φ uniform on [0, 2π).
    /// Reporter h is at distance `d` from the event and device j at distance `gamma` from h, metres. The absolute error
    /// is below 1e-6 for `d` up to `d_max` and `gamma` up to 2 `d_max`.
    pub fn p42(&self, d: f64, gamma: f64) -> f64 {
        let product = d * gamma;
        // If d or γ is 0, the distance does not depend on φ.
        if product == 0.0 {
            return self.sensing.p(d + gamma);
        }
        // d² + γ² − 2dγ cos φ as a sum of non-negative terms, so that rounding cannot make it negative.
        let squared_difference = (d - gamma) * (d - gamma);
        let eta = self.sensing.eta;
        // One sum per lane and a fixed order of lanes, so the result does not depend on the vector width.
        let mut sums = [0.0; LANES];
        for (doubled_versines, weights) in self.doubled_versines.iter().zip(&self.weights) {
            for lane in 0..LANES {
                let distance = (squared_difference + product * doubled_versines[lane]).sqrt();
                sums[lane] += weights[lane] * exp_negative(eta * distance);
            }
        }
        sums.iter().sum()
    }

    /// Smallest probability for which a device is woken, p(`d_max`) (Algorithm 1, line 8).
    pub fn threshold(&self) -> f64 {
        self.threshold
    }
}

/// Returns exp(-x) for `x` ≥ 0 to 15 digits, in a form that the compiler can vectorise. Beyond 708, where normal
/// doubles end, it stays at exp(-708), which is less than any valid p(d_max).
#[inline]
pub(crate) fn exp_negative(x: f64) -> f64 {
    let x = if x < MAX_EXPONENT { x } else { MAX_EXPONENT };
    let shifted = -x * LOG2_E + ROUND;
    let n = shifted - ROUND;
    let r = (-x - n * LN2_HIGH) - n * LN2_LOW;
    // The series of exp to r¹² / 12!, |r| ≤ ln 2 / 2.
    let series = INVERSE_FACTORIALS.iter().rev().fold(0.0, |sum, term| sum * r + term);
    // Puts the whole number into the exponent bits, which are offset by 1023.
    let power = f64::from_bits((shifted.to_bits() << 52).wrapping_add(1023 << 52));
    series * power
}

/// Returns [`exp_negative`] of four numbers, bit by bit.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
pub(crate) fn exp_negative_v3(v3: V3, x: f64x4) -> f64x4 {
    let splat = |value: f64| v3.splat_f64x4(value);
    let largest = splat(MAX_EXPONENT);
    let x: f64x4 = pulp::cast(v3.avx._mm256_min_pd(pulp::cast(x), pulp::cast(largest)));
    let minus_x = v3.mul_f64x4(x, splat(-1.0));
    let shifted = v3.add_f64x4(v3.mul_f64x4(minus_x, splat(LOG2_E)), splat(ROUND));
    let n = v3.sub_f64x4(shifted, splat(ROUND));
    let high = v3.sub_f64x4(minus_x, v3.mul_f64x4(n, splat(LN2_HIGH)));
    let r = v3.sub_f64x4(high, v3.mul_f64x4(n, splat(LN2_LOW)));
    let mut series = splat(INVERSE_FACTORIALS[INVERSE_FACTORIALS.len() - 1]);
    for term in INVERSE_FACTORIALS[..INVERSE_FACTORIALS.len() - 1].iter().rev() {
        series = v3.add_f64x4(v3.mul_f64x4(series, r), splat(*term));
    }
    let exponent_bits = v3.avx2._mm256_slli_epi64::<52>(pulp::cast(shifted));
    let power = v3
        .avx2
        ._mm256_add_epi64(exponent_bits, pulp::cast(v3.splat_u64x4(1023 << 52)));
    v3.mul_f64x4(series, pulp::cast(power))
}

/// Adding this constant leaves the nearest whole number in the lowest bits.
const ROUND: f64 = (3_u64 << 51) as f64;
/// ln 2 in two parts; the first has so few digits that its multiples are exact.
const LN2_HIGH: f64 = 0.693_147_180_369_123_8;
const LN2_LOW: f64 = 1.908_214_929_270_587_7e-10;

/// Largest exponent of [`exp_negative`].
const MAX_EXPONENT: f64 = 708.0;

/// 1 / k! for k = 0, 1, …
const INVERSE_FACTORIALS: [f64; 13] = [
    1.0,
    1.0,
    1.0 / 2.0,
    1.0 / 6.0,
    1.0 / 24.0,
    1.0 / 120.0,
    1.0 / 720.0,
    1.0 / 5_040.0,
    1.0 / 40_320.0,
    1.0 / 362_880.0,
    1.0 / 3_628_800.0,
    1.0 / 39_916_800.0,
    1.0 / 479_001_600.0,
];

/// Returns the nodes t on [-1, 1], in descending order, and weights of the Gauss-Legendre rule with `count` points.
fn gauss_legendre(count: usize) -> impl Iterator<Item = (f64, f64)> {
    let n = count as f64;
    (0..count).map(move |i| {
        let mut t = libm::cos(PI * (i as f64 + 0.75) / (n + 0.5));
        // Newton's method doubles the correct digits, and the start value has three.
        for _ in 0..6 {
            let (value, slope) = legendre(count, t);
            t -= value / slope;
        }
        let (_, slope) = legendre(count, t);
        (t, 2.0 / ((1.0 - t * t) * slope * slope))
    })
}

/// Returns the Legendre polynomial of degree `n` ≥ 1 at |`t`| < 1, and its derivative.
fn legendre(n: usize, t: f64) -> (f64, f64) {
    let (mut previous, mut value) = (1.0, t);
    for k in 2..=n {
        let k = k as f64;
        (previous, value) = (value, ((2.0 * k - 1.0) * t * value - (k - 1.0) * previous) / k);
    }
    (value, n as f64 * (previous - t * value) / (1.0 - t * t))
}

#[cfg(test)]
mod tests {
    use reveille_common::rng::{Purpose, Stream};
    use reveille_common::sensing::{DetectionKind, Fusion};

    use super::*;

    fn sensing(eta: f64, d_max: f64) -> Sensing {
        Sensing {
            kind: DetectionKind::Range,
            d_max,
            eta,
            psi: 1.0,
            g: Fusion::Max,
        }
    }

    /// Computes `P_4,2` by adaptive Simpson integration over the full circle, with the cosine rule as in the paper.
    fn integrated_p42(sensing: &Sensing, d: f64, gamma: f64) -> f64 {
        let detection_probability = |phi: f64| {
            let squared = d * d + gamma * gamma - 2.0 * d * gamma * libm::cos(phi);
            libm::exp(-sensing.eta * squared.max(0.0).sqrt())
        };
        // Unequal widths, so that no symmetry of the integrand distorts the error estimate.
        let cuts = [0.0, 0.01, 0.1, 0.7, 2.1, PI, 4.0, 5.3, 6.0, 6.25, 2.0 * PI];
        let integrals = cuts.windows(2).map(|w| {
            let (a, b) = (w[0], w[1]);
            adaptive_simpson(
                &detection_probability,
                [a, b],
                [
                    detection_probability(a),
                    detection_probability(0.5 * (a + b)),
                    detection_probability(b),
                ],
                1e-10,
                40,
            )
        });
        integrals.sum::<f64>() / (2.0 * PI)
    }

    /// Integrates `f` from a to b, given its values at a, in the middle and at b.
    fn adaptive_simpson(
        f: &impl Fn(f64) -> f64,
        [a, b]: [f64; 2],
        [fa, fm, fb]: [f64; 3],
        tolerance: f64,
        depth: u32,
    ) -> f64 {
        let (m, h) = (0.5 * (a + b), b - a);
        let (left, right) = (f(0.5 * (a + m)), f(0.5 * (m + b)));
        let whole = h / 6.0 * (fa + 4.0 * fm + fb);
        let halves = h / 12.0 * (fa + 4.0 * left + 2.0 * fm + 4.0 * right + fb);
        if depth == 0 || (halves - whole).abs() < 15.0 * tolerance {
            return halves + (halves - whole) / 15.0;
        }
        adaptive_simpson(f, [a, m], [fa, left, fm], 0.5 * tolerance, depth - 1)
            + adaptive_simpson(f, [m, b], [fm, right, fb], 0.5 * tolerance, depth - 1)
    }

    /// Returns the largest error with its d and γ, over a grid, random points, and points near γ = d, where the
    /// integrand has a kink.
    fn worst_error(eta: f64, d_max: f64) -> (f64, f64, f64) {
        let (model, mut worst) = (sensing(eta, d_max), (0.0, 0.0, 0.0));
        let correlation = Correlation::new(&model, &BoundsCache::default());
        let mut update = |d: f64, gamma: f64| {
            let error = (correlation.p42(d, gamma) - integrated_p42(&model, d, gamma)).abs();
            if error > worst.0 {
                worst = (error, d, gamma);
            }
        };
        for i in 0..=20 {
            for j in 0..=40 {
                update(d_max * f64::from(i) / 20.0, d_max * f64::from(j) / 20.0);
            }
        }
        let mut stream = Stream::new(4, Purpose::Epicentre, 0);
        for _ in 0..1000 {
            let d = d_max * stream.unit();
            update(d, 2.0 * d_max * stream.unit());
            let gap = d_max * libm::pow(10.0, -6.0 * stream.unit());
            update(d, d + gap);
            update(d, (d - gap).max(0.0));
        }
        worst
    }

    #[test]
    fn the_error_of_p42_is_below_one_millionth() {
        for (eta, d_max) in [
            (1.0, 4.0),
            (1.0, 8.0),
            (2.0, 4.0),
            (0.05, 4.0),
            (0.25, 4.0),
            (0.5, 4.0),
            (1.5, 4.0),
        ] {
            let (error, d, gamma) = worst_error(eta, d_max);
            assert!(
                error < 1e-6,
                "eta {eta}, d_max {d_max}: {error} at d = {d}, gamma = {gamma}"
            );
        }
    }

    #[test]
    fn exp_negative_equals_the_exponential_function() {
        for i in 0..=70_000 {
            let x = f64::from(i) / 100.0 + f64::from(i % 7) * 1e-4;
            let exact = libm::exp(-x);
            assert!((exp_negative(x) / exact - 1.0).abs() < 4e-16 * (1.0 + x), "exp(-{x})");
        }
        assert_eq!(exp_negative(0.0).to_bits(), 1.0_f64.to_bits());
        // Larger arguments count as 708, below which the result is a normal double.
        assert_eq!(exp_negative(2100.0).to_bits(), exp_negative(708.0).to_bits());
    }

    #[cfg(target_arch = "x86_64")]
    #[test]
    fn four_exponentials_at_once_are_the_same_to_the_bit() {
        let Some(v3) = V3::try_new() else { return };
        let check = |x: [f64; 4]| {
            let values: [f64; 4] = pulp::cast(exp_negative_v3(v3, pulp::cast(x)));
            assert_eq!(values.map(f64::to_bits), x.map(|x| exp_negative(x).to_bits()), "{x:?}");
        };
        let mut stream = Stream::new(8, Purpose::Epicentre, 0);
        for _ in 0..20_000 {
            check(std::array::from_fn(|lane| {
                stream.unit() * [1e-3, 1.0, 40.0, 720.0][lane]
            }));
        }
        check([0.0, 708.0, 1e6, f64::INFINITY]);
    }

    #[test]
    fn p42_equals_p_at_distance_zero() {
        let model = sensing(1.0, 4.0);
        let correlation = Correlation::new(&model, &BoundsCache::default());
        for distance in [0.0, 1e-9, 0.7, 4.0, 8.0] {
            assert!((correlation.p42(0.0, distance) - model.p(distance)).abs() < f64::EPSILON);
            assert!((correlation.p42(distance, 0.0) - model.p(distance)).abs() < f64::EPSILON);
        }
        // Next to the special case, the quadrature itself is used.
        assert!((correlation.p42(1e-12, 2.0) - model.p(2.0)).abs() < 1e-11);
    }

    #[test]
    fn p42_lies_between_its_bounds() {
        let model = sensing(1.0, 4.0);
        let correlation = Correlation::new(&model, &BoundsCache::default());
        let mut stream = Stream::new(5, Purpose::Epicentre, 0);
        for _ in 0..10_000 {
            let (d, gamma) = (4.0 * stream.unit(), 8.0 * stream.unit());
            let p42 = correlation.p42(d, gamma);
            assert!(p42 >= model.p(d + gamma), "d = {d}, γ = {gamma}: {p42}");
            let (bands_per_metre, band_count) = correlation.bands_per_metre_and_count();
            let column = (gamma * bands_per_metre + 0.5) as usize;
            assert!(column < band_count, "γ = {gamma}: column {column} of {band_count}");
            let band = correlation.bands(d).iter().find(|band| band.column == column);
            assert!(
                p42 <= band.map_or(correlation.threshold(), |band| band.bound),
                "d = {d}, γ = {gamma}: {p42}"
            );
        }
    }

    #[test]
    fn gauss_legendre_is_exact_for_polynomials() {
        for count in [1_u32, 2, 5, 16, 33] {
            let points_and_weights: Vec<_> = gauss_legendre(count as usize).collect();
            for power in 0..2 * count {
                let sum: f64 = points_and_weights
                    .iter()
                    .map(|&(t, w)| w * libm::pow(t, f64::from(power)))
                    .sum();
                let exact = if power % 2 == 0 {
                    2.0 / f64::from(power + 1)
                } else {
                    0.0
                };
                assert!((sum - exact).abs() < 1e-13, "{count} points, t^{power}: {sum}");
            }
        }
    }
}
