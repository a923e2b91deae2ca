//! Sums in a fixed order.
//!
//! Every output of a product is summed by rising index of the inner dimension, by separate multiplications and
//! additions, so that its bits are the same on every machine. Outputs are computed side by side, which the compiler
//! turns into vector instructions of whatever [`Width`] it is told: whatever runs inside of [`Width::run`] is inlined
//! there, which is why everything here is marked so.

#![expect(
    clippy::inline_always,
    reason = "what is not inlined there is not compiled for the instructions that Width::run chooses"
)]

use pulp::Scalar;
use pulp::Simd as _;
#[cfg(target_arch = "x86_64")]
use pulp::x86::{V3, V4};

/// Columns of the output that are computed side by side.
const TILE: usize = 16;
/// Rows of the output that share a load of the weights.
const ROWS: usize = 6;

/// The vector instructions that are used. They change how long a sum takes and not one bit of it.
#[derive(Clone, Copy, Debug)]
pub enum Width {
    /// Those that every CPU of the kind has.
    Least(Scalar),
    /// x86-64-v3: eight numbers at once.
    #[cfg(target_arch = "x86_64")]
    V3(V3),
    /// x86-64-v4: sixteen.
    #[cfg(target_arch = "x86_64")]
    V4(V4),
}

impl Width {
    /// Those that this CPU has.
    pub fn here() -> Vec<Self> {
        let mut here = vec![Self::Least(Scalar)];
        #[cfg(target_arch = "x86_64")]
        {
            here.extend(V3::try_new().map(Self::V3));
            here.extend(V4::try_new().map(Self::V4));
        }
        here
    }

    /// Those that are taken. Of v4 none are: they are a few hundredths faster on some CPUs, and half as fast again
    /// where they lower the clock.
    pub fn fastest() -> Self {
        #[cfg(target_arch = "x86_64")]
        if let Some(v3) = V3::try_new() {
            return Self::V3(v3);
        }
        Self::Least(Scalar)
    }

    /// What `work` gives, compiled for these instructions where it is inlined.
    #[inline(always)]
    pub fn run<R>(self, work: impl FnOnce() -> R) -> R {
        match self {
            Self::Least(least) => least.vectorize(work),
            #[cfg(target_arch = "x86_64")]
            Self::V3(v3) => v3.vectorize(work),
            #[cfg(target_arch = "x86_64")]
            Self::V4(v4) => v4.vectorize(work),
        }
    }
}

/// A linear map: `out = x · weight + bias`.
#[derive(Clone, Debug, PartialEq)]
pub struct Linear {
    inputs: usize,
    outputs: usize,
    /// By tile of outputs, `[tiles, inputs]`; the last tile is filled up with zeros.
    weight: Vec<[f32; TILE]>,
    /// `[tiles]`, filled up as well.
    bias: Vec<[f32; TILE]>,
}

impl Linear {
    /// `weight` is `[inputs, bias.len()]`, row by row.
    ///
    /// # Panics
    /// If there are more or fewer weights.
    pub fn new(inputs: usize, weight: &[f32], bias: &[f32]) -> Self {
        let outputs = bias.len();
        assert_eq!(weight.len(), inputs * outputs, "a weight for each input and output");
        let column = |start: usize| {
            let rows = weight.chunks(outputs);
            rows.map(move |row| filled(&row[start..outputs.min(start + TILE)]))
        };
        Self {
            inputs,
            outputs,
            weight: (0..outputs).step_by(TILE).flat_map(column).collect(),
            bias: bias.chunks(TILE).map(filled).collect(),
        }
    }

    /// Without a bias.
    pub fn plain(inputs: usize, outputs: usize, weight: &[f32]) -> Self {
        Self::new(inputs, weight, &vec![0.0; outputs])
    }

    /// `out = x · weight + bias` for each row of `x`, `[rows, inputs]`; `out` is `[rows, outputs]`.
    #[inline(always)]
    pub fn apply(&self, x: &[f32], out: &mut [f32]) {
        let part = |of| Part { at: 0, width: of, of };
        product(&self.weight, &self.bias, x, part(self.inputs), out, part(self.outputs));
    }
}

/// The columns of a matrix that a head has.
#[derive(Clone, Copy, Debug)]
pub struct Part {
    /// The first.
    pub at: usize,
    /// How many.
    pub width: usize,
    /// Columns of the matrix.
    pub of: usize,
}

/// `out = x · weight + bias`, tile by tile, row by row of a part of `x` and of `out`.
#[inline(always)]
fn product(weight: &[[f32; TILE]], bias: &[[f32; TILE]], x: &[f32], from: Part, out: &mut [f32], to: Part) {
    let mut xs = x.chunks_exact(ROWS * from.of);
    let mut outs = out.chunks_exact_mut(ROWS * to.of);
    for (x, out) in xs.by_ref().zip(outs.by_ref()) {
        block::<ROWS>(weight, bias, x, from, out, to);
    }
    let rest = xs.remainder().chunks_exact(from.of);
    for (x, out) in rest.zip(outs.into_remainder().chunks_exact_mut(to.of)) {
        block::<1>(weight, bias, x, from, out, to);
    }
}

#[inline(always)]
fn block<const R: usize>(
    weight: &[[f32; TILE]],
    bias: &[[f32; TILE]],
    x: &[f32],
    from: Part,
    out: &mut [f32],
    to: Part,
) {
    let inputs = from.width;
    let rows: [&[f32]; R] = std::array::from_fn(|row| &x[row * from.of + from.at..][..inputs]);
    for (at, (weights, bias)) in weight.chunks_exact(inputs).zip(bias).enumerate() {
        let mut sums = [*bias; R];
        for (i, weights) in weights.iter().enumerate() {
            for (row, sums) in rows.iter().zip(&mut sums) {
                let x = row[i];
                for (sum, weight) in sums.iter_mut().zip(weights) {
                    *sum += x * weight;
                }
            }
        }
        let start = at * TILE;
        for (sums, out) in sums.iter().zip(out.chunks_exact_mut(to.of)) {
            let out = &mut out[to.at..][..to.width][start..];
            if let Some(whole) = out.first_chunk_mut() {
                *whole = *sums;
            } else {
                out.copy_from_slice(&sums[..out.len()]);
            }
        }
    }
}

/// For one head, the sums over devices of keys times values, so that what a device gathers from all others is one
/// product with its query.
#[derive(Clone, Debug)]
pub struct Summary {
    /// By tile of values, `[tiles, d / heads]`.
    sums: Vec<[f32; TILE]>,
    zeros: Vec<[f32; TILE]>,
    /// Sums of keys, `[d / heads]`.
    keys: Vec<f32>,
}

impl Summary {
    /// For heads of this width.
    pub fn new(width: usize) -> Self {
        let tiles = width.div_ceil(TILE);
        Self {
            sums: vec![[0.0; TILE]; tiles * width],
            zeros: vec![[0.0; TILE]; tiles],
            keys: vec![0.0; width],
        }
    }

    /// Sums up the part `of` of `keys` and `values`, `[N, d]`.
    #[inline(always)]
    pub fn fill(&mut self, keys: &[f32], values: &[f32], of: Part) {
        const AT_ONCE: usize = 4;
        self.keys.fill(0.0);
        for keys in keys.chunks_exact(of.of) {
            add(&mut self.keys, &keys[of.at..][..of.width]);
        }
        for (tile, sums) in self.sums.chunks_exact_mut(of.width).enumerate() {
            let start = tile * TILE;
            for (four, sums) in sums.as_chunks_mut::<AT_ONCE>().0.iter_mut().enumerate() {
                let mut held = [[0.0; TILE]; AT_ONCE];
                for (keys, values) in keys.chunks_exact(of.of).zip(values.chunks_exact(of.of)) {
                    let keys: &[f32; AT_ONCE] = keys[of.at + four * AT_ONCE..].first_chunk().expect("four features");
                    let values = &values[of.at..][..of.width][start..];
                    let values: [f32; TILE] = values.first_chunk().copied().unwrap_or_else(|| filled(values));
                    for (held, key) in held.iter_mut().zip(keys) {
                        for (sum, value) in held.iter_mut().zip(&values) {
                            *sum += key * value;
                        }
                    }
                }
                *sums = held;
            }
        }
    }

    /// What each of `queries` gathers: a mean of the values, weighted by the products of query and key.
    #[inline(always)]
    pub fn gather(&self, queries: &[f32], gathered: &mut [f32], of: Part) {
        product(&self.sums, &self.zeros, queries, of, gathered, of);
        for (query, gathered) in queries.chunks_exact(of.of).zip(gathered.chunks_exact_mut(of.of)) {
            let inverse = 1.0 / dot(&query[of.at..][..of.width], &self.keys);
            for gathered in gathered[of.at..][..of.width].as_chunks_mut::<4>().0 {
                for gathered in gathered {
                    *gathered *= inverse;
                }
            }
        }
    }
}

/// `row` with zeros after it.
fn filled(row: &[f32]) -> [f32; TILE] {
    let mut tile = [0.0; TILE];
    tile[..row.len()].copy_from_slice(row);
    tile
}

/// `out = x · scale / rms(x)`, row by row of as many values as `scale` has, a multiple of four.
#[inline(always)]
pub fn norm(x: &[f32], scale: &[f32], out: &mut [f32]) {
    let width = scale.len();
    for (x, out) in x.chunks_exact(width).zip(out.chunks_exact_mut(width)) {
        let (x, _) = x.as_chunks::<4>();
        let mut lanes = [0.0_f32; 4];
        for x in x {
            for (lane, x) in lanes.iter_mut().zip(x) {
                *lane += x * x;
            }
        }
        let mean = ((lanes[0] + lanes[1]) + (lanes[2] + lanes[3])) / width as f32;
        let inverse = 1.0 / (mean + NORM_EPSILON).sqrt();
        let (out, _) = out.as_chunks_mut::<4>();
        for ((out, x), scale) in out.iter_mut().zip(x).zip(scale.as_chunks::<4>().0) {
            for lane in 0..4 {
                out[lane] = x[lane] * inverse * scale[lane];
            }
        }
    }
}

/// `out` is the sum of `shares · rows`, for rows of a multiple of four.
#[inline(always)]
pub fn mean<'r>(out: &mut [f32], shares: &[f32], row: impl Fn(usize) -> &'r [f32]) {
    let (out, _) = out.as_chunks_mut::<4>();
    out.fill([0.0; 4]);
    for (i, share) in shares.iter().enumerate() {
        for (out, x) in out.iter_mut().zip(row(i).as_chunks::<4>().0) {
            for lane in 0..4 {
                out[lane] += share * x[lane];
            }
        }
    }
}

/// What keeps the norms of tokens finite.
pub const NORM_EPSILON: f32 = 1e-5;

/// `x += y`.
#[inline(always)]
pub fn add(x: &mut [f32], y: &[f32]) {
    for (x, y) in x.iter_mut().zip(y) {
        *x += y;
    }
}

/// `x = max(x, 0)`.
#[inline(always)]
pub fn relu(x: &mut [f32]) {
    for x in x {
        *x = x.max(0.0);
    }
}

/// The sum of `a · b`, by rising index within each of four lanes.
#[inline(always)]
pub fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut lanes = [0.0_f32; 4];
    for (a, b) in a.as_chunks::<4>().0.iter().zip(b.as_chunks::<4>().0) {
        for lane in 0..4 {
            lanes[lane] += a[lane] * b[lane];
        }
    }
    (lanes[0] + lanes[1]) + (lanes[2] + lanes[3])
}

/// e^x within two units in the last place; 0 below [`LEAST_EXPONENT`], and not for x above 88. A polynomial, so that
/// many can be computed side by side.
#[inline(always)]
pub fn exp(x: f32) -> f32 {
    let held = x.max(LEAST_EXPONENT);
    // Adding 3·2²² rounds to a whole number, which then stands in the lowest bits.
    let rounded = held * std::f32::consts::LOG2_E + 12_582_912.0;
    let whole = rounded - 12_582_912.0;
    // ln 2 in two parts, the first with so few bits that its products are exact.
    let rest = (held - whole * (355.0 / 512.0)) - whole * -2.121_944_4e-4;
    let series = [1.0 / 5040.0, 1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0];
    let mut sum = series[0];
    for term in &series[1..] {
        sum = sum * rest + term;
    }
    let power = f32::from_bits(rounded.to_bits().wrapping_add(127) << 23);
    let value = (sum * rest + 1.0) * power;
    if x < LEAST_EXPONENT { 0.0 } else { value }
}

/// Shares that sum to 1, row by row of `scores`, in proportion to the exponentials of the first `known` of each, which
/// is of length `width`; the others get none.
#[inline(always)]
pub fn softmax(scores: &mut [f32], width: usize, known: usize) {
    for row in scores.chunks_exact_mut(width) {
        let (known, rest) = row.split_at_mut(known);
        let mut most = f32::NEG_INFINITY;
        for score in known.iter() {
            most = most.max(*score);
        }
        for score in known {
            *score -= most;
        }
        rest.fill(f32::NEG_INFINITY);
    }
    for score in scores.iter_mut() {
        *score = exp(*score);
    }
    for row in scores.chunks_exact_mut(width) {
        let inverse = 1.0 / row[..known].iter().sum::<f32>();
        for score in row {
            *score *= inverse;
        }
    }
}

/// Where e^x is as good as 0.
const LEAST_EXPONENT: f32 = -87.0;

#[cfg(test)]
mod tests {
    use super::*;
    use reveille_common::rng::{Purpose, Stream};

    fn numbers(count: usize, id: u64) -> Vec<f32> {
        let mut stream = Stream::new(7, Purpose::Training, id);
        (0..count).map(|_| (2.0 * stream.unit() - 1.0) as f32).collect()
    }

    #[test]
    fn a_linear_map_is_the_sum_of_products_by_rising_index() {
        for (rows, inputs, outputs) in [(1, 3, 1), (4, 20, 32), (7, 32, 64), (9, 5, 17)] {
            let (x, weight) = (numbers(rows * inputs, 1), numbers(inputs * outputs, 2));
            let bias = numbers(outputs, 3);
            let mut out = vec![0.0; rows * outputs];
            Linear::new(inputs, &weight, &bias).apply(&x, &mut out);
            for row in 0..rows {
                for column in 0..outputs {
                    let mut sum = bias[column];
                    for i in 0..inputs {
                        sum += x[row * inputs + i] * weight[i * outputs + column];
                    }
                    assert_eq!(out[row * outputs + column].to_bits(), sum.to_bits());
                }
            }
        }
    }

    #[test]
    fn exponentials_are_right() {
        for step in -87_000..=20_000 {
            let x = step as f32 / 1000.0;
            let exact = libm::exp(f64::from(x));
            assert!(
                (f64::from(exp(x)) / exact - 1.0).abs() < 2.5e-7,
                "{x}: {}, not {exact}",
                exp(x)
            );
        }
        let bits = [0.0, -1000.0, f32::NEG_INFINITY].map(|x| exp(x).to_bits());
        assert_eq!(bits, [1.0_f32, 0.0, 0.0].map(f32::to_bits));
    }

    #[test]
    fn norms_are_one_and_products_are_sums() {
        let (x, scale) = (numbers(64, 4), vec![1.0; 32]);
        let mut out = vec![0.0; 64];
        norm(&x, &scale, &mut out);
        for row in out.chunks(32) {
            let mean = row.iter().map(|x| f64::from(x * x)).sum::<f64>() / 32.0;
            assert!((mean - 1.0).abs() < 1e-3, "{mean}");
        }
        let exact: f64 = x.iter().zip(&out).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum();
        assert!((f64::from(dot(&x, &out)) - exact).abs() < 1e-4);
    }
}
