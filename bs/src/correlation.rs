//! How likely a device is to have sensed an event that another device reported (Sec. III).

use std::f64::consts::PI;

use reveille_common::sensing::Sensing;

/// Points of the quadrature for η·`d_max` up to [`DECAY`].
const NODES: f64 = 18.0;

/// Beyond this η·`d_max` the peak of the integrand is so narrow that more points are needed.
const DECAY: f64 = 8.0;

/// The wake-up correlation of Eq. (`cosine_rule2`), ready to be averaged over the unknown direction φ of the event.
#[derive(Clone, Debug)]
pub struct Correlation {
    sensing: Sensing,
    /// 2 (1 − cos φ) and the weight of each node φ on [0, π]; the weights add up to 1. The nodes are those of the
    /// Gauss-Legendre rule in t ∈ [0, 1] with φ = πt³: where γ is close to d the integrand is all but a kink at φ = 0,
    /// and the cube gathers nodes there. The plain rule needs three times as many for the same error.
    nodes: Vec<(f64, f64)>,
    threshold: f64,
}

impl Correlation {
    /// The correlation of devices that sense as `sensing` says.
    pub fn new(sensing: &Sensing) -> Self {
        let narrower = (sensing.eta * sensing.d_max / DECAY).max(1.0);
        let count = (NODES * narrower.sqrt()).ceil().min(1024.0) as usize;
        Self {
            sensing: sensing.clone(),
            nodes: gauss_legendre(count)
                .map(|(t, weight)| {
                    let t = 0.5 * (t + 1.0);
                    let twice_versine = 2.0 - 2.0 * libm::cos(PI * t * t * t);
                    (twice_versine, 0.5 * weight * 3.0 * t * t)
                })
                .collect(),
            threshold: sensing.p(sensing.d_max),
        }
    }

    /// Pr(`S_j` = S3 | `S_h` = S3), `[0, 1]`: the mean of p(√(d² + γ² − 2dγ cos φ)) over φ uniform on [0, 2π), for a
    /// reporter h at distance `d` from the event and a device j at distance `gamma` from h, metres. The absolute error
    /// is below 1e-6 for `d` up to `d_max` and `gamma` up to 2 `d_max`.
    pub fn p42(&self, d: f64, gamma: f64) -> f64 {
        let product = d * gamma;
        if product == 0.0 {
            return self.sensing.p(d + gamma);
        }
        let difference = (d - gamma) * (d - gamma);
        self.nodes
            .iter()
            .map(|&(twice_versine, weight)| weight * self.sensing.p((difference + product * twice_versine).sqrt()))
            .sum()
    }

    /// No less than [`Correlation::p42`], and cheap: the event is at least |γ − d| from the device. The margin covers
    /// the rounding of the mean.
    pub(crate) fn bound(&self, d: f64, gamma: f64) -> f64 {
        self.sensing.p((d - gamma).abs()) * (1.0 + 1e-12)
    }

    /// The least probability for which a device is woken, p(`d_max`) (Algorithm 1, line 8).
    pub fn threshold(&self) -> f64 {
        self.threshold
    }

    /// The sensing range `d_max`, metres.
    pub(crate) fn range(&self) -> f64 {
        self.sensing.d_max
    }
}

/// The nodes t on [-1, 1], falling, and weights of the Gauss-Legendre rule with `count` points.
fn gauss_legendre(count: usize) -> impl Iterator<Item = (f64, f64)> {
    let n = count as f64;
    (0..count).map(move |i| {
        let mut t = libm::cos(PI * (i as f64 + 0.75) / (n + 0.5));
        // Newton's method doubles the digits of a start that has three.
        for _ in 0..6 {
            let (value, slope) = legendre(count, t);
            t -= value / slope;
        }
        let (_, slope) = legendre(count, t);
        (t, 2.0 / ((1.0 - t * t) * slope * slope))
    })
}

/// The Legendre polynomial of degree `n` ≥ 1 at |`t`| < 1, and its derivative.
fn legendre(n: usize, t: f64) -> (f64, f64) {
    let (mut before, mut value) = (1.0, t);
    for k in 2..=n {
        let k = k as f64;
        (before, value) = (value, ((2.0 * k - 1.0) * t * value - (k - 1.0) * before) / k);
    }
    (value, n as f64 * (before - t * value) / (1.0 - t * t))
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

    /// The same mean by adaptive Simpson integration over the full circle, from the cosine rule as the paper has it.
    fn reference(sensing: &Sensing, d: f64, gamma: f64) -> f64 {
        let f = |phi: f64| {
            let squared = d * d + gamma * gamma - 2.0 * d * gamma * libm::cos(phi);
            libm::exp(-sensing.eta * squared.max(0.0).sqrt())
        };
        // Pieces of unequal width, so that no symmetry of the integrand can fool the error estimate.
        let cuts = [0.0, 0.01, 0.1, 0.7, 2.1, PI, 4.0, 5.3, 6.0, 6.25, 2.0 * PI];
        let pieces = cuts.windows(2).map(|w| {
            let (a, b) = (w[0], w[1]);
            adaptive(&f, [a, b], [f(a), f(0.5 * (a + b)), f(b)], 1e-10, 40)
        });
        pieces.sum::<f64>() / (2.0 * PI)
    }

    fn adaptive(f: &impl Fn(f64) -> f64, [a, b]: [f64; 2], [fa, fm, fb]: [f64; 3], tolerance: f64, depth: u32) -> f64 {
        let (m, h) = (0.5 * (a + b), b - a);
        let (left, right) = (f(0.5 * (a + m)), f(0.5 * (m + b)));
        let whole = h / 6.0 * (fa + 4.0 * fm + fb);
        let halves = h / 12.0 * (fa + 4.0 * left + 2.0 * fm + 4.0 * right + fb);
        if depth == 0 || (halves - whole).abs() < 15.0 * tolerance {
            return halves + (halves - whole) / 15.0;
        }
        adaptive(f, [a, m], [fa, left, fm], 0.5 * tolerance, depth - 1)
            + adaptive(f, [m, b], [fm, right, fb], 0.5 * tolerance, depth - 1)
    }

    /// The largest error over a grid, over random places and over places near γ = d, where the integrand has a kink.
    fn worst_error(eta: f64, d_max: f64) -> (f64, f64, f64) {
        let (model, mut worst) = (sensing(eta, d_max), (0.0, 0.0, 0.0));
        let correlation = Correlation::new(&model);
        let mut check = |d: f64, gamma: f64| {
            let error = (correlation.p42(d, gamma) - reference(&model, d, gamma)).abs();
            if error > worst.0 {
                worst = (error, d, gamma);
            }
        };
        for i in 0..=20 {
            for j in 0..=40 {
                check(d_max * f64::from(i) / 20.0, d_max * f64::from(j) / 20.0);
            }
        }
        let mut stream = Stream::new(4, Purpose::Epicentre, 0);
        for _ in 0..1000 {
            let d = d_max * stream.unit();
            check(d, 2.0 * d_max * stream.unit());
            let gap = d_max * libm::pow(10.0, -6.0 * stream.unit());
            check(d, d + gap);
            check(d, (d - gap).max(0.0));
        }
        worst
    }

    #[test]
    fn the_error_of_p42_is_below_a_millionth() {
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
    fn without_a_direction_p42_is_p() {
        let model = sensing(1.0, 4.0);
        let correlation = Correlation::new(&model);
        for distance in [0.0, 1e-9, 0.7, 4.0, 8.0] {
            assert!((correlation.p42(0.0, distance) - model.p(distance)).abs() < f64::EPSILON);
            assert!((correlation.p42(distance, 0.0) - model.p(distance)).abs() < f64::EPSILON);
        }
        // The rule itself, right next to the special case.
        assert!((correlation.p42(1e-12, 2.0) - model.p(2.0)).abs() < 1e-11);
    }

    #[test]
    fn p42_lies_between_its_bounds() {
        let model = sensing(1.0, 4.0);
        let correlation = Correlation::new(&model);
        let mut stream = Stream::new(5, Purpose::Epicentre, 0);
        for _ in 0..10_000 {
            let (d, gamma) = (4.0 * stream.unit(), 8.0 * stream.unit());
            let mean = correlation.p42(d, gamma);
            assert!(
                mean <= correlation.bound(d, gamma) && mean >= model.p(d + gamma),
                "{d}, {gamma}"
            );
        }
    }

    #[test]
    fn the_quadrature_is_exact_for_polynomials() {
        for count in [1_u32, 2, 5, 16, 33] {
            let rule: Vec<_> = gauss_legendre(count as usize).collect();
            for power in 0..2 * count {
                let sum: f64 = rule.iter().map(|&(t, w)| w * libm::pow(t, f64::from(power))).sum();
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
