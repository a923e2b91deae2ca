//! Expected gains of candidates: sums over the points of a belief. Which device is woken, and so digests, depend on
//! every bit of a sum, so its terms are added in the order of the points for all vector instructions.

#[cfg(target_arch = "x86_64")]
use pulp::{f64x4, x86::V3};
use reveille_common::geometry::Point;
use reveille_common::sensing::{Fusion, Sensing};

use super::points::RingPoints;
use crate::beliefs::correlation::exp_negative;
#[cfg(target_arch = "x86_64")]
use crate::beliefs::correlation::exp_negative_v3;
use crate::vector_width::VectorWidth;

/// Points that are processed together.
const LANES: usize = 4;

/// Relative margin of a distance for the rounding of information.
const REACH_MARGIN: f64 = 1e-9;

/// Neighbouring points. The last block is filled with points of weight 0 at an infinite distance.
#[derive(Clone, Copy, Debug)]
struct PointBlock {
    x: [f64; LANES],
    y: [f64; LANES],
    weights: [f64; LANES],
}

/// Sums over the points of a belief, for one value of the information Î.
#[derive(Clone, Debug)]
pub(super) struct GainSums {
    sensing: Sensing,
    /// Largest squared distance, square metres, whose root is at most d_max.
    max_squared: f64,
    vector_width: VectorWidth,
    blocks: Vec<PointBlock>,
    information: f64,
    /// Squared distance, square metres, beyond which a report adds no information.
    reach_squared: f64,
    /// Whether the weight of points too far from a device is needed.
    counts_misses: bool,
}

impl GainSums {
    pub(super) fn new(sensing: &Sensing) -> Self {
        Self {
            sensing: sensing.clone(),
            max_squared: largest_square(sensing.d_max),
            vector_width: VectorWidth::fastest(),
            blocks: Vec::new(),
            information: 0.0,
            reach_squared: 0.0,
            counts_misses: true,
        }
    }

    /// Largest squared distance, square metres, whose root is at most d_max.
    pub(super) const fn max_squared(&self) -> f64 {
        self.max_squared
    }

    pub(super) const fn vector_width(&self) -> VectorWidth {
        self.vector_width
    }

    /// Prepares sums over `points` with Î at `information`. A report from farther than `reach` adds nothing to it.
    pub(super) fn prepare(&mut self, points: &RingPoints, information: f64, reach: f64, counts_misses: bool) {
        let Sensing { d_max, eta, .. } = self.sensing;
        let margin = REACH_MARGIN * (reach + 1.0 / eta);
        self.reach_squared = if reach < d_max {
            ((reach + margin) * (reach + margin)).min(self.max_squared)
        } else {
            self.max_squared
        };
        (self.information, self.counts_misses) = (information, counts_misses);
        let [x, y] = points.coordinates();
        let blocks = x.chunks(LANES).zip(y.chunks(LANES)).zip(points.weights().chunks(LANES));
        self.blocks.clear();
        self.blocks.extend(blocks.map(|((x, y), weights)| PointBlock {
            x: filled(x, f64::INFINITY),
            y: filled(y, f64::INFINITY),
            weights: filled(weights, 0.0),
        }));
    }

    /// Returns the gain from a device at `position`, and the weight of points farther from it than d_max, both as
    /// weighted sums over the points. The weight is 0 if it was not asked for. Fast where it is inlined into
    /// [`VectorWidth::run`].
    #[inline(always)]
    pub(super) fn gain_and_missed_weight(&self, position: Point) -> (f64, f64) {
        match self.vector_width {
            #[cfg(target_arch = "x86_64")]
            VectorWidth::V3(v3) => self.sum_by_blocks(v3, position),
            _ => self.sum_by_points(position),
        }
    }

    /// Computes [`Self::gain_and_missed_weight`] point by point.
    fn sum_by_points(&self, position: Point) -> (f64, f64) {
        let Sensing { d_max, eta, psi, .. } = self.sensing;
        let (mut gain, mut missed_weight) = (0.0, 0.0);
        for block in &self.blocks {
            for ((&x, &y), &weight) in block.x.iter().zip(&block.y).zip(&block.weights) {
                let d = Point::new(x, y).distance(position);
                if d > d_max {
                    missed_weight += weight;
                } else {
                    let report_information = psi * exp_negative(eta * d);
                    gain += weight * (self.sensing.fuse(self.information, report_information) - self.information);
                }
            }
        }
        (gain, if self.counts_misses { missed_weight } else { 0.0 })
    }

    /// Computes [`Self::gain_and_missed_weight`] four points at a time.
    #[cfg(target_arch = "x86_64")]
    #[inline(always)]
    fn sum_by_blocks(&self, v3: V3, position: Point) -> (f64, f64) {
        let splat = |value: f64| v3.splat_f64x4(value);
        let Sensing { eta, psi, g, .. } = self.sensing;
        let (x, y, eta, psi) = (splat(position.x), splat(position.y), splat(eta), splat(psi));
        let (max_squared, reach_squared) = (splat(self.max_squared), splat(self.reach_squared));
        let information = splat(self.information);
        let (mut gain, mut missed_weight) = (0.0, 0.0);
        for block in &self.blocks {
            let dx = v3.sub_f64x4(pulp::cast(block.x), x);
            let dy = v3.sub_f64x4(pulp::cast(block.y), y);
            let squared = v3.add_f64x4(v3.mul_f64x4(dx, dx), v3.mul_f64x4(dy, dy));
            let weights: f64x4 = pulp::cast(block.weights);
            if self.counts_misses {
                let is_far = v3.cmp_gt_f64x4(squared, max_squared);
                let missed = v3.select_f64x4(is_far, weights, splat(0.0));
                missed_weight = add_in_order(missed_weight, pulp::cast(missed));
            }
            let is_in_reach = v3.cmp_le_f64x4(squared, reach_squared);
            if v3.avx._mm256_movemask_pd(pulp::cast(is_in_reach)) == 0 {
                // All terms would be 0, which changes no sum.
                continue;
            }
            let decay = v3.mul_f64x4(eta, v3.sqrt_f64x4(squared));
            let report = v3.mul_f64x4(psi, exp_negative_v3(v3, decay));
            let fused: f64x4 = match g {
                Fusion::Max => pulp::cast(v3.avx._mm256_max_pd(pulp::cast(information), pulp::cast(report))),
                Fusion::SumSaturation => {
                    let sum = v3.add_f64x4(information, report);
                    pulp::cast(v3.avx._mm256_min_pd(pulp::cast(sum), pulp::cast(psi)))
                }
            };
            let terms = v3.mul_f64x4(weights, v3.sub_f64x4(fused, information));
            let is_near = v3.cmp_le_f64x4(squared, max_squared);
            gain = add_in_order(gain, pulp::cast(v3.select_f64x4(is_near, terms, splat(0.0))));
        }
        (gain, missed_weight)
    }
}

#[inline(always)]
fn add_in_order(sum: f64, terms: [f64; LANES]) -> f64 {
    let mut sum = sum;
    for term in terms {
        sum += term;
    }
    sum
}

/// Returns the numbers of `slice`, at most [`LANES`], followed by `filler`.
fn filled(slice: &[f64], filler: f64) -> [f64; LANES] {
    let mut block = [filler; LANES];
    block[..slice.len()].copy_from_slice(slice);
    block
}

/// Returns the largest number whose square root, as rounded, is at most `root`, > 0.
fn largest_square(root: f64) -> f64 {
    let mut square = root * root;
    while square.sqrt() > root {
        square = square.next_down();
    }
    while square.next_up().sqrt() <= root {
        square = square.next_up();
    }
    square
}

#[cfg(test)]
mod tests {
    use reveille_common::rng::{Purpose, Stream};
    use reveille_common::sensing::DetectionKind;

    use super::super::points::ScaledLikelihood;
    use super::*;

    #[test]
    fn the_largest_square_separates_distances_as_their_roots_do() {
        let mut stream = Stream::new(1, Purpose::Epicentre, 0);
        for case in 0..1000 {
            let root = if case < 10 {
                f64::from(case + 1)
            } else {
                1e-3 + 1e3 * stream.unit()
            };
            let square = largest_square(root);
            assert!(square.sqrt() <= root && square.next_up().sqrt() > root, "{root}");
        }
    }

    /// The sum by definition, term by term.
    fn plain_sums(sensing: &Sensing, points: &RingPoints, position: Point, information: f64) -> (f64, f64) {
        let (mut gain, mut missed_weight) = (0.0, 0.0);
        for (at, weight) in points.positions().zip(points.weights()) {
            let d = at.distance(position);
            if d > sensing.d_max {
                missed_weight += weight;
            } else {
                let report = sensing.psi * exp_negative(sensing.eta * d);
                gain += weight * (sensing.fuse(information, report) - information);
            }
        }
        (gain, missed_weight)
    }

    #[test]
    fn sums_equal_the_plain_sums_bit_by_bit() {
        let mut stream = Stream::new(2, Purpose::Epicentre, 0);
        for case in 0..400_u32 {
            let sensing = Sensing {
                kind: DetectionKind::Range,
                d_max: 4.0,
                eta: [1.0, 0.03, 20.0][case as usize % 3],
                psi: 1.5,
                g: [Fusion::Max, Fusion::SumSaturation][case as usize % 2],
            };
            let mut points = RingPoints::default();
            let d = 4.0 * stream.unit();
            for _ in 0..=case % 67 {
                let phi = std::f64::consts::TAU * stream.unit();
                let position = Point::new(8.0 + d * libm::cos(phi), 8.0 + d * libm::sin(phi));
                points.push(position, ScaledLikelihood::CERTAIN.times(stream.unit() + 1e-9));
            }
            points.update_weights();
            let information = [sensing.information(d), 0.0, sensing.psi][case as usize / 2 % 3];
            let reach = match sensing.distance(information) {
                Some(reach) if sensing.g == Fusion::Max => reach.min(4.0),
                _ => 4.0,
            };
            let mut sums = GainSums::new(&sensing);
            for _ in 0..40 {
                let position = Point::new(16.0 * stream.unit(), 16.0 * stream.unit());
                let expected = plain_sums(&sensing, &points, position, information);
                for counts_misses in [true, false] {
                    sums.prepare(&points, information, reach, counts_misses);
                    for width in VectorWidth::supported() {
                        sums.vector_width = width;
                        let (gain, missed_weight) = width.run(|| sums.gain_and_missed_weight(position));
                        assert_eq!(gain.to_bits(), expected.0.to_bits(), "case {case}, {width:?}");
                        let expected_miss = if counts_misses { expected.1 } else { 0.0 };
                        assert_eq!(
                            missed_weight.to_bits(),
                            expected_miss.to_bits(),
                            "case {case}, {width:?}"
                        );
                    }
                }
            }
        }
    }
}
