//! The sums of the transformer's inference ([`super::infer`]), in a fixed order.
//!
//! Every output of a product is summed in the order of the inner dimension, with separate multiplications and
//! additions. Its bits are therefore the same on every machine. They must stay so: the decisions of `dt` and the digest
//! of a run depend on them. Outputs are computed side by side, which the compiler turns into vector instructions of the
//! chosen [`VectorWidth`](crate::vector_width::VectorWidth). Code must be inlined into `VectorWidth::run` to use them,
//! so every function here is marked for inlining.
//!
//! Loops over `as_chunks` take four columns at a time and silently skip a remainder. Rows must therefore have a
//! multiple of four columns, as [`super::ModelShape::is_valid`] requires of a head.

use super::super::vector_math::exp;

/// Number of output columns that are computed side by side.
const TILE_COLUMNS: usize = 16;
/// Number of output rows that share a load of the weights.
const BLOCK_ROWS: usize = 6;

/// A linear map: `out = x · weight + bias`.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Linear {
    inputs: usize,
    outputs: usize,
    /// Weights by tile of outputs, `[tiles, inputs]`; the last tile is padded with zeros.
    weight: Vec<[f32; TILE_COLUMNS]>,
    /// Bias by tile, `[tiles]`, padded with zeros.
    bias: Vec<[f32; TILE_COLUMNS]>,
}

impl Linear {
    /// Creates the map from `weight`, `[inputs, bias.len()]`, row by row.
    ///
    /// # Panics
    /// If `weight` has another length.
    pub(super) fn new(inputs: usize, weight: &[f32], bias: &[f32]) -> Self {
        let outputs = bias.len();
        assert_eq!(weight.len(), inputs * outputs, "a weight for each input and output");
        let tile = |start: usize| {
            let rows = weight.chunks(outputs);
            rows.map(move |row| pad_to_tile(&row[start..outputs.min(start + TILE_COLUMNS)]))
        };
        Self {
            inputs,
            outputs,
            weight: (0..outputs).step_by(TILE_COLUMNS).flat_map(tile).collect(),
            bias: bias.chunks(TILE_COLUMNS).map(pad_to_tile).collect(),
        }
    }

    /// Creates a map without a bias.
    pub(super) fn without_bias(inputs: usize, outputs: usize, weight: &[f32]) -> Self {
        Self::new(inputs, weight, &vec![0.0; outputs])
    }

    /// Computes `out = x · weight + bias` for each row of `x`, `[rows, inputs]`; `out` is `[rows, outputs]`.
    #[inline(always)]
    pub(super) fn apply(&self, x: &[f32], out: &mut [f32]) {
        let full = |columns| ColumnSlice {
            start: 0,
            width: columns,
            stride: columns,
        };
        multiply(&self.weight, &self.bias, x, full(self.inputs), out, full(self.outputs));
    }
}

/// Columns of a row-major matrix, for example the columns of one attention head.
#[derive(Clone, Copy, Debug)]
pub(super) struct ColumnSlice {
    /// First column.
    pub start: usize,
    /// Number of columns in the slice.
    pub width: usize,
    /// Number of columns of the whole matrix.
    pub stride: usize,
}

/// Computes `out = x · weight + bias` tile by tile, for each row. Reads only `x_columns` of `x` and writes only
/// `out_columns` of `out`.
#[inline(always)]
fn multiply(
    weight: &[[f32; TILE_COLUMNS]],
    bias: &[[f32; TILE_COLUMNS]],
    x: &[f32],
    x_columns: ColumnSlice,
    out: &mut [f32],
    out_columns: ColumnSlice,
) {
    let mut xs = x.chunks_exact(BLOCK_ROWS * x_columns.stride);
    let mut outs = out.chunks_exact_mut(BLOCK_ROWS * out_columns.stride);
    for (x, out) in xs.by_ref().zip(outs.by_ref()) {
        multiply_rows::<BLOCK_ROWS>(weight, bias, x, x_columns, out, out_columns);
    }
    let last_rows = xs.remainder().chunks_exact(x_columns.stride);
    for (x, out) in last_rows.zip(outs.into_remainder().chunks_exact_mut(out_columns.stride)) {
        multiply_rows::<1>(weight, bias, x, x_columns, out, out_columns);
    }
}

/// Does the work of [`multiply`] for exactly `R` rows.
#[inline(always)]
fn multiply_rows<const R: usize>(
    weight: &[[f32; TILE_COLUMNS]],
    bias: &[[f32; TILE_COLUMNS]],
    x: &[f32],
    x_columns: ColumnSlice,
    out: &mut [f32],
    out_columns: ColumnSlice,
) {
    let inputs = x_columns.width;
    let rows: [&[f32]; R] = std::array::from_fn(|row| &x[row * x_columns.stride + x_columns.start..][..inputs]);
    for (tile, (tile_weights, tile_bias)) in weight.chunks_exact(inputs).zip(bias).enumerate() {
        // Each output is summed in the order of `i` for any R, so the rows of a remainder have the same bits.
        let mut row_sums = [*tile_bias; R];
        for (i, input_weights) in tile_weights.iter().enumerate() {
            for (row, sums) in rows.iter().zip(&mut row_sums) {
                let x = row[i];
                for (sum, weight) in sums.iter_mut().zip(input_weights) {
                    *sum += x * weight;
                }
            }
        }
        let start = tile * TILE_COLUMNS;
        for (sums, out_row) in row_sums.iter().zip(out.chunks_exact_mut(out_columns.stride)) {
            let out_tile = &mut out_row[out_columns.start..][..out_columns.width][start..];
            // The last tile is wider than the remaining outputs.
            if let Some(full_tile) = out_tile.first_chunk_mut() {
                *full_tile = *sums;
            } else {
                out_tile.copy_from_slice(&sums[..out_tile.len()]);
            }
        }
    }
}

/// Sums over devices of keys times values for one head. A single product with the query of a device then gathers the
/// values of all others.
#[derive(Clone, Debug)]
pub(super) struct KeyValueSum {
    /// Sums of key · value, by tile of values and by key, `[tiles, d / heads]`.
    key_value_sums: Vec<[f32; TILE_COLUMNS]>,
    /// The bias of the product that gathers values, `[tiles]`.
    zero_bias: Vec<[f32; TILE_COLUMNS]>,
    /// Sums of keys, `[d / heads]`.
    sum_of_keys: Vec<f32>,
}

impl KeyValueSum {
    /// Creates the buffers for heads of `width` columns, a multiple of four.
    pub(super) fn new(width: usize) -> Self {
        let tiles = width.div_ceil(TILE_COLUMNS);
        Self {
            key_value_sums: vec![[0.0; TILE_COLUMNS]; tiles * width],
            zero_bias: vec![[0.0; TILE_COLUMNS]; tiles],
            sum_of_keys: vec![0.0; width],
        }
    }

    /// Computes the sums over the columns `head` of `keys` and `values`, `[N, d]`.
    #[inline(always)]
    pub(super) fn sum_over_devices(&mut self, keys: &[f32], values: &[f32], head: ColumnSlice) {
        const KEYS_PER_PASS: usize = 4;
        self.sum_of_keys.fill(0.0);
        for keys in keys.chunks_exact(head.stride) {
            add(&mut self.sum_of_keys, &keys[head.start..][..head.width]);
        }
        for (tile, tile_sums) in self.key_value_sums.chunks_exact_mut(head.width).enumerate() {
            let start = tile * TILE_COLUMNS;
            for (pass, sums) in tile_sums.as_chunks_mut::<KEYS_PER_PASS>().0.iter_mut().enumerate() {
                let mut pass_sums = [[0.0; TILE_COLUMNS]; KEYS_PER_PASS];
                for (keys, values) in keys.chunks_exact(head.stride).zip(values.chunks_exact(head.stride)) {
                    // The width of a head is a multiple of 4, see `ModelShape::is_valid`.
                    let keys = &keys[head.start + pass * KEYS_PER_PASS..];
                    let keys: &[f32; KEYS_PER_PASS] = keys.first_chunk().expect("four features");
                    let values = &values[head.start..][..head.width][start..];
                    let values: [f32; TILE_COLUMNS] =
                        values.first_chunk().copied().unwrap_or_else(|| pad_to_tile(values));
                    for (key_sums, key) in pass_sums.iter_mut().zip(keys) {
                        for (sum, value) in key_sums.iter_mut().zip(&values) {
                            *sum += key * value;
                        }
                    }
                }
                *sums = pass_sums;
            }
        }
    }

    /// Computes for each of `queries` the mean of the values, weighted by the products of query and key. Requires
    /// [`Self::sum_over_devices`] of this TTI, and features above 0.
    #[inline(always)]
    pub(super) fn gather(&self, queries: &[f32], gathered: &mut [f32], head: ColumnSlice) {
        multiply(&self.key_value_sums, &self.zero_bias, queries, head, gathered, head);
        for (query, gathered_row) in queries
            .chunks_exact(head.stride)
            .zip(gathered.chunks_exact_mut(head.stride))
        {
            let inverse = 1.0 / dot(&query[head.start..][..head.width], &self.sum_of_keys);
            for lanes in gathered_row[head.start..][..head.width].as_chunks_mut::<4>().0 {
                for mean in lanes {
                    *mean *= inverse;
                }
            }
        }
    }
}

fn pad_to_tile(row: &[f32]) -> [f32; TILE_COLUMNS] {
    let mut tile = [0.0; TILE_COLUMNS];
    tile[..row.len()].copy_from_slice(row);
    tile
}

/// Computes `out = x · scale / rms(x)` for each row. The row length is the length of `scale`, a multiple of four.
/// `inverses` has a number per row, of which the inverse roots are computed side by side.
#[inline(always)]
pub(super) fn rms_norm(x: &[f32], scale: &[f32], inverses: &mut [f32], out: &mut [f32]) {
    let width = scale.len();
    for (x, inverse) in x.chunks_exact(width).zip(inverses.iter_mut()) {
        let (x, _) = x.as_chunks::<4>();
        let mut lanes = [0.0_f32; 4];
        for x in x {
            for (lane, x) in lanes.iter_mut().zip(x) {
                *lane += x * x;
            }
        }
        // A fixed order of lanes keeps the bits independent of the vector instructions.
        *inverse = (lanes[0] + lanes[1]) + (lanes[2] + lanes[3]);
    }
    for inverse in inverses.iter_mut() {
        *inverse = 1.0 / (*inverse / width as f32 + NORM_EPSILON).sqrt();
    }
    let rows = x.chunks_exact(width).zip(out.chunks_exact_mut(width));
    for ((x, out), inverse) in rows.zip(inverses.iter()) {
        let (out, _) = out.as_chunks_mut::<4>();
        for ((out, x), scale) in out.iter_mut().zip(x.as_chunks::<4>().0).zip(scale.as_chunks::<4>().0) {
            for lane in 0..4 {
                out[lane] = x[lane] * inverse * scale[lane];
            }
        }
    }
}

/// Computes `out` as the sum of `shares · rows`, where the shares sum to 1; the row length is a multiple of four.
#[inline(always)]
pub(super) fn weighted_mean<'r>(out: &mut [f32], shares: &[f32], row: impl Fn(usize) -> &'r [f32]) {
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

/// Offset of a mean square in `rms_norm`, so that its inverse stays finite. The training uses it too, so a change needs
/// new models.
pub const NORM_EPSILON: f32 = 1e-5;

/// Adds `y` to `x`, element by element.
#[inline(always)]
pub(super) fn add(x: &mut [f32], y: &[f32]) {
    for (x, y) in x.iter_mut().zip(y) {
        *x += y;
    }
}

/// `x = max(x, 0)`.
#[inline(always)]
pub(super) fn relu(x: &mut [f32]) {
    for x in x {
        *x = x.max(0.0);
    }
}

/// Returns the sum of `a · b`, in index order within each of four lanes. Both have the same length, a multiple of four.
#[inline(always)]
pub(super) fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut lanes = [0.0_f32; 4];
    for (a, b) in a.as_chunks::<4>().0.iter().zip(b.as_chunks::<4>().0) {
        for lane in 0..4 {
            lanes[lane] += a[lane] * b[lane];
        }
    }
    // A fixed order of lanes, as in `rms_norm`.
    (lanes[0] + lanes[1]) + (lanes[2] + lanes[3])
}

/// Replaces each row of `scores`, of length `width`, by shares that sum to 1. The shares are proportional to the
/// exponentials of the first `known_count` scores, at least one; the others are 0.
#[inline(always)]
pub(super) fn softmax(scores: &mut [f32], width: usize, known_count: usize) {
    for row in scores.chunks_exact_mut(width) {
        let (known, unknown) = row.split_at_mut(known_count);
        // Exponents relative to the largest score stay within the range of `exp`.
        let mut max_score = f32::NEG_INFINITY;
        for score in known.iter() {
            max_score = max_score.max(*score);
        }
        for score in known {
            *score -= max_score;
        }
        // `exp` turns these into 0 in the same vector loop.
        unknown.fill(f32::NEG_INFINITY);
    }
    for score in scores.iter_mut() {
        *score = exp(*score);
    }
    for row in scores.chunks_exact_mut(width) {
        let inverse = 1.0 / row[..known_count].iter().sum::<f32>();
        for score in row {
            *score *= inverse;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use reveille_common::rng::{Purpose, Stream};

    fn random_values(count: usize, id: u64) -> Vec<f32> {
        let mut stream = Stream::new(7, Purpose::Training, id);
        (0..count).map(|_| (2.0 * stream.unit() - 1.0) as f32).collect()
    }

    #[test]
    fn linear_adds_products_in_order_of_their_index() {
        for (rows, inputs, outputs) in [(1, 3, 1), (4, 20, 32), (7, 32, 64), (9, 5, 17)] {
            let (x, weight) = (random_values(rows * inputs, 1), random_values(inputs * outputs, 2));
            let bias = random_values(outputs, 3);
            let mut out = vec![0.0; rows * outputs];
            Linear::new(inputs, &weight, &bias).apply(&x, &mut out);
            for row in 0..rows {
                for column in 0..outputs {
                    let mut expected = bias[column];
                    for i in 0..inputs {
                        expected += x[row * inputs + i] * weight[i * outputs + column];
                    }
                    assert_eq!(
                        out[row * outputs + column].to_bits(),
                        expected.to_bits(),
                        "{rows} rows of {inputs} to {outputs}: output {column} of row {row}"
                    );
                }
            }
        }
    }

    #[test]
    fn rms_norm_gives_mean_square_one_and_dot_adds_products() {
        let (x, scale) = (random_values(64, 4), vec![1.0; 32]);
        let mut out = vec![0.0; 64];
        rms_norm(&x, &scale, &mut [0.0; 2], &mut out);
        for row in out.chunks(32) {
            let mean_square = row.iter().map(|x| f64::from(x * x)).sum::<f64>() / 32.0;
            assert!((mean_square - 1.0).abs() < 1e-3, "mean square {mean_square}");
        }
        let expected: f64 = x.iter().zip(&out).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum();
        assert!(
            (f64::from(dot(&x, &out)) - expected).abs() < 1e-4,
            "dot product {}, not {expected}",
            dot(&x, &out)
        );
    }
}
