//! Candidate epicentres of [`EpicentreBelief`](super::EpicentreBelief) with their likelihoods. Frames and digests
//! depend on their order and on every bit of their weights.

use std::f64::consts::TAU;

use reveille_common::geometry::{Area, Point};

use super::prior::PlacePrior;

/// Largest number of likely points, and of unlikely points, that [`RingPoints::thin`] keeps.
pub(super) const MAX_POINTS_PER_GROUP: usize = 32;

/// A product of factors, most of them below 1, that may be too small for a floating-point number.
#[derive(Clone, Copy, Debug)]
pub(super) struct ScaledLikelihood {
    /// Value in units of [`SCALE_STEP`] to the power of `steps`. It is at least [`SCALE_STEP`]; a prior or
    /// the thinning of points can raise it above 1.
    value: f64,
    steps: u32,
}

/// 2⁻⁵¹²; multiplication by a power of two is exact.
const SCALE_STEP: f64 = 1.0 / (TWO_TO_256 * TWO_TO_256);
const TWO_TO_256: f64 = TWO_TO_128 * TWO_TO_128;
const TWO_TO_128: f64 = (1_u128 << 127) as f64 * 2.0;

impl ScaledLikelihood {
    pub(super) const CERTAIN: Self = Self { value: 1.0, steps: 0 };

    /// Multiplies the likelihood by `factor`, which is at least [`SCALE_STEP`].
    pub(super) fn times(self, factor: f64) -> Self {
        let Self { value, steps } = self;
        // One step is enough, since neither the value nor the factor is below `SCALE_STEP`.
        let value = value * factor;
        if value < SCALE_STEP {
            Self {
                value: value / SCALE_STEP,
                steps: steps + 1,
            }
        } else {
            Self { value, steps }
        }
    }
}

/// cos φ and sin φ of the points on a ring, in order.
#[derive(Clone, Debug)]
pub(super) struct Directions {
    cosines: Box<[f64]>,
    sines: Box<[f64]>,
}

impl Directions {
    /// Creates `count` directions, all around.
    pub(super) fn new(count: usize) -> Self {
        let (cosines, sines): (Vec<f64>, Vec<f64>) = (0..count)
            .map(|i| TAU * i as f64 / count as f64)
            .map(|phi| (libm::cos(phi), libm::sin(phi)))
            .unzip();
        Self {
            cosines: cosines.into(),
            sines: sines.into(),
        }
    }
}

/// The points, one array per property, so that vector instructions can process neighbouring points together.
#[derive(Clone, Debug, Default)]
pub(super) struct RingPoints {
    x: Vec<f64>,
    y: Vec<f64>,
    /// Value and steps of the likelihoods, see [`ScaledLikelihood`].
    values: Vec<f64>,
    steps: Vec<u32>,
    /// The likelihoods in units of [`SCALE_STEP`] to the power of the least number of steps of any point.
    weights: Vec<f64>,
    /// Scratch space of [`Self::apply_silence`]: by point, the number of silent devices in its range.
    silent_counts: Vec<f64>,
}

impl RingPoints {
    pub(super) fn clear(&mut self) {
        self.truncate(0);
    }

    fn truncate(&mut self, count: usize) {
        let Self {
            x, y, values, weights, ..
        } = self;
        for array in [x, y, values, weights] {
            array.truncate(count);
        }
        self.steps.truncate(count);
    }

    pub(super) fn len(&self) -> usize {
        self.x.len()
    }

    pub(super) fn position(&self, i: usize) -> Point {
        Point::new(self.x[i], self.y[i])
    }

    pub(super) fn positions(&self) -> impl Iterator<Item = Point> + '_ {
        self.x.iter().zip(&self.y).map(|(&x, &y)| Point::new(x, y))
    }

    /// Positions east and north, metres.
    pub(super) fn coordinates(&self) -> [&[f64]; 2] {
        [&self.x, &self.y]
    }

    pub(super) fn weights(&self) -> &[f64] {
        &self.weights
    }

    /// Adds a point. [`Self::update_weights`] must follow.
    pub(super) fn push(&mut self, position: Point, likelihood: ScaledLikelihood) {
        self.x.push(position.x);
        self.y.push(position.y);
        self.values.push(likelihood.value);
        self.steps.push(likelihood.steps);
        self.weights.push(1.0);
    }

    /// Replaces the points by those at distance `d` from `centre` in the given `directions` that lie in `area`. All are
    /// equally likely. Fast where it is inlined into `VectorWidth::run`.
    #[inline(always)]
    pub(super) fn set_ring(&mut self, centre: Point, d: f64, directions: &Directions, area: Area) {
        self.clear();
        self.x
            .extend(directions.cosines.iter().map(|cosine| centre.x + d * cosine));
        self.y.extend(directions.sines.iter().map(|sine| centre.y + d * sine));
        // Rounding keeps the order of numbers, so these corners bound all points.
        let [south_west, north_east] = [-d, d].map(|d| Point::new(centre.x + d, centre.y + d));
        if !(area.contains(south_west) && area.contains(north_east)) {
            let mut kept_count = 0;
            let (xs, ys) = (
                &mut self.x[..directions.cosines.len()],
                &mut self.y[..directions.cosines.len()],
            );
            for i in 0..xs.len() {
                let (x, y) = (xs[i], ys[i]);
                (xs[kept_count], ys[kept_count]) = (x, y);
                // Without a branch, which would often be mispredicted.
                let bounds = [x >= 0.0, x <= area.width, y >= 0.0, y <= area.height];
                kept_count += bounds.iter().fold(1, |all, &holds| all & usize::from(holds));
            }
            self.x.truncate(kept_count);
            self.y.truncate(kept_count);
        }
        let count = self.x.len();
        self.values.resize(count, 1.0);
        self.steps.resize(count, 0);
        self.weights.resize(count, 1.0);
    }

    /// Multiplies the likelihoods of the points for which `is_affected` holds by `factor`.
    pub(super) fn multiply_where(&mut self, is_affected: impl Fn(Point) -> bool, factor: f64) {
        for i in 0..self.len() {
            if is_affected(self.position(i)) {
                self.set_likelihood(i, self.likelihood(i).times(factor));
            }
        }
        self.update_weights();
    }

    /// Sets the likelihood of each point by its position.
    pub(super) fn set_likelihoods(&mut self, likelihood_at: impl Fn(Point) -> ScaledLikelihood) {
        for i in 0..self.len() {
            self.set_likelihood(i, likelihood_at(self.position(i)));
        }
        self.update_weights();
    }

    fn likelihood(&self, i: usize) -> ScaledLikelihood {
        ScaledLikelihood {
            value: self.values[i],
            steps: self.steps[i],
        }
    }

    fn set_likelihood(&mut self, i: usize, likelihood: ScaledLikelihood) {
        (self.values[i], self.steps[i]) = (likelihood.value, likelihood.steps);
    }

    /// Sets the likelihood of each point to the `prior` of its place, times `factor` for each of the `silent` devices
    /// that is near: whose squared distance is at most `max_squared`. Fast where it is inlined into `VectorWidth::run`.
    /// [`Self::update_weights`] must follow.
    #[inline(always)]
    pub(super) fn apply_silence(&mut self, silent: &[Point], max_squared: f64, factor: f64, prior: &impl PlacePrior) {
        let Self {
            x,
            y,
            values,
            steps,
            silent_counts,
            ..
        } = self;
        prior.densities_at(x, y, values);
        let mut min_value = values
            .iter()
            .fold(f64::INFINITY, |min, &value| if value < min { value } else { min });
        silent_counts.clear();
        silent_counts.resize(values.len(), 0.0);
        for device in silent {
            for ((count, x), y) in silent_counts.iter_mut().zip(&*x).zip(&*y) {
                let (dx, dy) = (device.x - x, device.y - y);
                *count += f64::from(u8::from(dx * dx + dy * dy <= max_squared));
            }
        }
        let max_count = silent_counts
            .iter()
            .fold(0.0, |max: f64, &count| if count > max { count } else { max });
        // One multiplication at a time, since each of them rounds.
        let mut applied = 0.0;
        while applied < max_count && min_value * factor >= SCALE_STEP {
            applied += 1.0;
            min_value *= factor;
            for (value, &count) in values.iter_mut().zip(&*silent_counts) {
                let product = *value * factor;
                *value = if count >= applied { product } else { *value };
            }
        }
        steps.fill(0);
        if applied < max_count {
            for i in 0..self.len() {
                let mut likelihood = self.likelihood(i);
                for _ in applied as u32..self.silent_counts[i] as u32 {
                    likelihood = likelihood.times(factor);
                }
                self.set_likelihood(i, likelihood);
            }
        }
    }

    /// Keeps the points for which `is_kept` holds.
    pub(super) fn retain(&mut self, is_kept: impl Fn(Point) -> bool) {
        let mut kept_count = 0;
        for i in 0..self.len() {
            if is_kept(self.position(i)) {
                self.copy_point(i, kept_count);
                kept_count += 1;
            }
        }
        self.truncate(kept_count);
        self.update_weights();
    }

    /// Copies the position and likelihood of a point.
    fn copy_point(&mut self, from: usize, to: usize) {
        (self.x[to], self.y[to]) = (self.x[from], self.y[from]);
        self.set_likelihood(to, self.likelihood(from));
    }

    /// Computes the relative weights of the points. A point 2⁵¹² times less likely than another may get weight 0.
    #[inline(always)]
    pub(super) fn update_weights(&mut self) {
        let min_steps = self.steps.iter().copied().min().unwrap_or(0);
        let likelihoods = self.values.iter().zip(&self.steps);
        for (weight, (&value, &steps)) in self.weights.iter_mut().zip(likelihoods) {
            *weight = match steps - min_steps {
                0 => value,
                1 => value * SCALE_STEP,
                _ => 0.0,
            };
        }
    }

    /// Reduces the number of points. Among the likely points, and among the others, it keeps every n-th point, which
    /// then stands for the points dropped.
    #[inline(always)]
    pub(super) fn thin(&mut self) {
        let max_weight = self
            .weights
            .iter()
            .fold(0.0, |max: f64, &weight| if weight > max { weight } else { max });
        let limit = 0.5 * max_weight;
        let likely_count: usize = self.weights.iter().map(|&weight| usize::from(weight > limit)).sum();
        // A group without points gets a stride of 1.
        let strides =
            [self.len() - likely_count, likely_count].map(|count| count.div_ceil(MAX_POINTS_PER_GROUP).max(1));
        // By group, the number of points up to the next one that is kept.
        let mut countdowns = strides.map(|stride| stride / 2 + 1);
        let mut kept_count = 0;
        for i in 0..self.len() {
            let group = usize::from(self.weights[i] > limit);
            countdowns[group] -= 1;
            if countdowns[group] == 0 {
                countdowns[group] = strides[group];
                self.copy_point(i, kept_count);
                self.values[kept_count] *= strides[group] as f64;
                kept_count += 1;
            }
        }
        self.truncate(kept_count);
        self.update_weights();
    }
}

#[cfg(test)]
mod tests {
    use reveille_common::rng::{Purpose, Stream};

    use super::*;
    use crate::vector_width::VectorWidth;

    const AREA: Area = Area {
        width: 12.0,
        height: 9.0,
    };

    fn place(stream: &mut Stream) -> Point {
        Point::new(AREA.width * stream.unit(), AREA.height * stream.unit())
    }

    #[test]
    fn a_ring_has_the_points_in_the_area_in_order() {
        let (directions, mut stream) = (Directions::new(512), Stream::new(1, Purpose::Epicentre, 0));
        let mut points = RingPoints::default();
        for _ in 0..200 {
            let (centre, d) = (place(&mut stream), 4.0 * stream.unit());
            let all = directions.cosines.iter().zip(&directions.sines);
            let expected: Vec<Point> = all
                .map(|(cosine, sine)| Point::new(centre.x + d * cosine, centre.y + d * sine))
                .filter(|&at| AREA.contains(at))
                .collect();
            for width in VectorWidth::supported() {
                width.run(|| points.set_ring(centre, d, &directions, AREA));
                assert!(points.positions().eq(expected.iter().copied()), "{centre:?}, {d} m");
                assert!(points.weights().len() == expected.len() && points.weights().iter().all(|&w| w >= 1.0));
            }
        }
    }

    /// Few and many silent devices, likely and extremely unlikely places: the likelihoods may need more than one step.
    #[test]
    fn silence_multiplies_one_factor_per_near_device() {
        let (directions, mut stream) = (Directions::new(512), Stream::new(2, Purpose::Epicentre, 0));
        for (case, device_count) in [0, 1, 4, 30, 200, 700].into_iter().enumerate() {
            for (factor, prior_scale) in [(0.02, 1.0), (0.9, 255.0), (1.0, 1.0), (0.02, 1e-140)] {
                let prior = |at: Point| prior_scale * (1.0 + at.x.floor());
                let silent: Vec<Point> = (0..device_count).map(|_| place(&mut stream)).collect();
                let mut points = RingPoints::default();
                points.set_ring(Point::new(6.0, 5.0), 3.0, &directions, AREA);
                let mut expected = points.clone();
                expected.set_likelihoods(|at| {
                    let near = silent.iter().filter(|device| device.distance(at) <= 2.0);
                    near.fold(ScaledLikelihood::CERTAIN.times(prior(at)), |likelihood, _| {
                        likelihood.times(factor)
                    })
                });
                for width in VectorWidth::supported() {
                    let mut points = points.clone();
                    width.run(|| points.apply_silence(&silent, 4.0, factor, &prior));
                    points.update_weights();
                    assert_eq!(points.steps, expected.steps, "case {case}, factor {factor}");
                    let bits = |values: &[f64]| values.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
                    assert_eq!(
                        bits(&points.values),
                        bits(&expected.values),
                        "case {case}, factor {factor}"
                    );
                    assert_eq!(
                        bits(&points.weights),
                        bits(&expected.weights),
                        "case {case}, factor {factor}"
                    );
                }
            }
        }
    }

    /// Thinning by the definition: in each group, every n-th point from the middle of the first n.
    #[test]
    fn every_nth_point_of_a_group_is_kept_and_stands_for_the_others() {
        let mut stream = Stream::new(3, Purpose::Epicentre, 0);
        for count in [1, 2, 31, 33, 64, 65, 100, 512] {
            let mut points = RingPoints::default();
            for _ in 0..count {
                let likelihood = [0.1, 1.0][stream.below(2) as usize];
                points.push(place(&mut stream), ScaledLikelihood::CERTAIN.times(likelihood));
            }
            points.update_weights();
            let max_weight = points.weights.iter().copied().fold(0.0, f64::max);
            let is_likely = |i: &usize| points.weights[*i] > 0.5 * max_weight;
            let groups = [false, true].map(|group| (0..count).filter(|i| is_likely(i) == group).collect::<Vec<_>>());
            let mut expected = Vec::new();
            for group in &groups {
                let stride = group.len().div_ceil(MAX_POINTS_PER_GROUP).max(1);
                let kept = group.iter().skip(stride / 2).step_by(stride);
                expected.extend(kept.map(|&i| (i, points.values[i] * stride as f64)));
            }
            expected.sort_by_key(|(i, _)| *i);
            let expected: Vec<(Point, f64)> = expected.iter().map(|&(i, value)| (points.position(i), value)).collect();
            points.thin();
            let kept: Vec<(Point, f64)> = points.positions().zip(points.values.iter().copied()).collect();
            assert_eq!(kept, expected, "{count} points");
        }
    }
}
