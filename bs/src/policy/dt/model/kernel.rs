//! Sums in a fixed order.
//!
//! Every output of a product is summed by rising index of the inner dimension, by separate multiplications and
//! additions, so that its bits are the same on every machine. Outputs are computed side by side, which the compiler
//! turns into vector instructions of whatever width there is.

/// Columns of the output that are computed side by side.
const TILE: usize = 16;
/// Rows of the output that share a load of the weights.
const ROWS: usize = 4;

/// A linear map: `out = x · weight + bias`.
#[derive(Clone, Debug, PartialEq)]
pub struct Linear {
    inputs: usize,
    outputs: usize,
    /// `[inputs, outputs]`, the outputs padded with zeros to a multiple of [`TILE`].
    weight: Vec<f32>,
    /// `[outputs]`, padded as well.
    bias: Vec<f32>,
}

impl Linear {
    /// `weight` is `[inputs, bias.len()]`, row by row.
    ///
    /// # Panics
    /// If there are more or fewer weights.
    pub fn new(inputs: usize, weight: &[f32], bias: &[f32]) -> Self {
        let (outputs, padded) = (bias.len(), bias.len().next_multiple_of(TILE));
        assert_eq!(weight.len(), inputs * outputs, "a weight for each input and output");
        let pad = |row: &[f32]| {
            let mut row = row.to_vec();
            row.resize(padded, 0.0);
            row
        };
        Self {
            inputs,
            outputs,
            weight: weight.chunks(outputs).flat_map(pad).collect(),
            bias: pad(bias),
        }
    }

    /// Without a bias.
    pub fn plain(inputs: usize, outputs: usize, weight: &[f32]) -> Self {
        Self::new(inputs, weight, &vec![0.0; outputs])
    }

    /// `out = x · weight + bias` for each row of `x`, `[rows, inputs]`; `out` is `[rows, outputs]`.
    pub fn apply(&self, x: &[f32], out: &mut [f32]) {
        let mut xs = x.chunks_exact(ROWS * self.inputs);
        let mut outs = out.chunks_exact_mut(ROWS * self.outputs);
        for (x, out) in xs.by_ref().zip(outs.by_ref()) {
            self.block::<ROWS>(x, out);
        }
        let rest = xs.remainder().chunks_exact(self.inputs);
        for (x, out) in rest.zip(outs.into_remainder().chunks_exact_mut(self.outputs)) {
            self.block::<1>(x, out);
        }
    }

    fn block<const R: usize>(&self, x: &[f32], out: &mut [f32]) {
        let padded = self.bias.len();
        for tile in (0..self.outputs).step_by(TILE) {
            let bias: [f32; TILE] = lane(&self.bias[tile..]);
            let mut sums = [bias; R];
            for (i, weights) in self.weight.chunks_exact(padded).enumerate() {
                let weights: [f32; TILE] = lane(&weights[tile..]);
                for (row, sums) in sums.iter_mut().enumerate() {
                    let x = x[row * self.inputs + i];
                    for (sum, weight) in sums.iter_mut().zip(weights) {
                        *sum += x * weight;
                    }
                }
            }
            let width = TILE.min(self.outputs - tile);
            for (row, sums) in sums.iter().enumerate() {
                let at = row * self.outputs + tile;
                out[at..at + width].copy_from_slice(&sums[..width]);
            }
        }
    }
}

/// The first values of `from`.
fn lane(from: &[f32]) -> [f32; TILE] {
    *from.first_chunk().expect("padded to whole tiles")
}

/// `out = x · scale / rms(x)`, row by row of as many values as `scale` has.
pub fn norm(x: &[f32], scale: &[f32], out: &mut [f32]) {
    let width = scale.len();
    for (x, out) in x.chunks_exact(width).zip(out.chunks_exact_mut(width)) {
        let mut lanes = [0.0_f32; 4];
        for x in x.as_chunks::<4>().0 {
            for (lane, x) in lanes.iter_mut().zip(x) {
                *lane += x * x;
            }
        }
        let mean = ((lanes[0] + lanes[1]) + (lanes[2] + lanes[3])) / width as f32;
        let inverse = 1.0 / (mean + NORM_EPSILON).sqrt();
        for ((out, x), scale) in out.iter_mut().zip(x).zip(scale) {
            *out = x * inverse * scale;
        }
    }
}

/// What keeps the norms of tokens finite.
pub const NORM_EPSILON: f32 = 1e-5;

/// `x += y`.
pub fn add(x: &mut [f32], y: &[f32]) {
    for (x, y) in x.iter_mut().zip(y) {
        *x += y;
    }
}

/// `x = max(x, 0)`.
pub fn relu(x: &mut [f32]) {
    for x in x {
        *x = x.max(0.0);
    }
}

/// The sum of `a · b`, by rising index within each of four lanes.
pub fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut lanes = [0.0_f32; 4];
    for (a, b) in a.as_chunks::<4>().0.iter().zip(b.as_chunks::<4>().0) {
        for lane in 0..4 {
            lanes[lane] += a[lane] * b[lane];
        }
    }
    (lanes[0] + lanes[1]) + (lanes[2] + lanes[3])
}

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
