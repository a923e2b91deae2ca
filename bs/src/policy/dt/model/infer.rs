//! Forward pass of the model for one TTI. `lab/src/transformer/net.rs` trains the same computation, without the limit
//! of the price; `tests.rs` here repeats it as well. A change needs new models: raise
//! [`FORMAT_VERSION`](super::weights::FORMAT_VERSION) and train both included ones again. The bits of the result are
//! the same for every [`VectorWidth`]; digests depend on them.
//!
//! If `attends_to_past`, a token attends to the last Z TTIs of the same device, whose keys and values are kept: Eqs.
//! (`delta(k)2`) and (`delta(k)3`) in the LaTeX source of the paper. Then, if `attends_to_devices`, the devices attend
//! to each other. There the weight of a pair is the dot product of positive features of a key and a query, without an
//! exponential (linear attention). The time thus grows with N and not with N². A TTI needs no allocation.

use std::sync::Arc;

use pulp::NullaryFnOnce;

use super::kernel::{ColumnSlice, KeyValueSum, add, dot, relu, rms_norm, softmax, weighted_mean};
use super::weights::{AttentionLayer, FeedForward, ModelWeights};
use super::{EXPANSION, OUTPUTS, PRICE_WIDTH};
use crate::vector_width::VectorWidth;

/// Least feature of a key or query, so that every device attends to every other.
pub const MIN_FEATURE: f32 = 0.01;
/// Bound on the absolute value of an output, a logarithm of a ratio or log-odds ([`super::ModelObjective`]).
pub const OUTPUT_LIMIT: f32 = 3.0;
/// Largest absolute logarithm of the price for a target. Without it, a target outside the training range could give any
/// price.
pub(crate) const LOG_PRICE_LIMIT: f32 = 5.0;

/// State of a model that processes the TTIs of one run in order, for N devices. Arrays are stored row by row: `[N, d]`
/// has a row for each device, as wide as an embedding ([`super::ModelShape::width`]).
#[derive(Clone, Debug)]
pub struct ForwardPass {
    weights: Arc<ModelWeights>,
    vector_width: VectorWidth,
    devices: usize,
    ttis_processed: usize,
    /// Keys by TTI modulo Z, `[Z, N, d]`.
    keys: Vec<f32>,
    values: Vec<f32>,
    /// Embedding of each device, to which every layer adds its output, `[N, d]`.
    state: Vec<f32>,
    /// Scratch space of a norm, `[N]`.
    inverse_norms: Vec<f32>,
    /// `state` after a norm, `[N, d]`; after [`Self::step`], the input of the output layer.
    normalised: Vec<f32>,
    /// `[N, d]`.
    query: Vec<f32>,
    /// Values as weighted by attention, `[N, d]`. The attention over devices keeps its keys here first.
    gathered: Vec<f32>,
    /// Output of a layer before it is added to `state`, `[N, d]`. The attention over devices keeps its values here
    /// first.
    projected: Vec<f32>,
    /// `[N, EXPANSION · d]`.
    hidden: Vec<f32>,
    /// `[N, OUTPUTS]`.
    outputs: Vec<f32>,
    /// Shares of the TTIs in the last temporal attention, `[N, heads, Z]` by lag.
    attention: Vec<f32>,
    key_value_sums: Vec<KeyValueSum>,
    /// Mean over devices, followed by a target: `[d + 1]`.
    pooled: Vec<f32>,
}

/// A call of [`ForwardPass::step`]: a type, since a large closure is not inlined into [`VectorWidth::run`].
struct Step<'a> {
    pass: &'a mut ForwardPass,
    tokens: &'a [f32],
}

impl NullaryFnOnce for Step<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        self.pass.compute(self.tokens);
    }
}

impl ForwardPass {
    /// Creates the state for `devices` devices, before the first TTI.
    pub fn new(weights: Arc<ModelWeights>, devices: usize) -> Self {
        let shape = weights.shape;
        let d = shape.width;
        let z = if shape.attends_to_past() { shape.memory } else { 0 };
        let per_device_buffer = || vec![0.0; devices * d];
        Self {
            vector_width: VectorWidth::fastest(),
            devices,
            ttis_processed: 0,
            keys: vec![0.0; z * devices * d],
            values: vec![0.0; z * devices * d],
            state: per_device_buffer(),
            inverse_norms: vec![0.0; devices],
            normalised: per_device_buffer(),
            query: per_device_buffer(),
            gathered: per_device_buffer(),
            projected: per_device_buffer(),
            hidden: vec![0.0; devices * d * EXPANSION],
            outputs: vec![0.0; devices * OUTPUTS],
            attention: vec![0.0; devices * shape.heads * z],
            pooled: vec![0.0; d + 1],
            key_value_sums: vec![KeyValueSum::new(shape.head_width()); shape.heads],
            weights,
        }
    }

    /// Sets the vector instructions, which do not change the result.
    #[must_use]
    pub fn with_vector_width(self, width: VectorWidth) -> Self {
        Self {
            vector_width: width,
            ..self
        }
    }

    /// Processes the next TTI with these tokens, `[N, F]` for F = `tokens::FEATURE_COUNT`. Returns the outputs of each
    /// device, `[N, OUTPUTS]`: logarithms within ± [`OUTPUT_LIMIT`]. The length of `tokens` is not checked; devices
    /// without a token would keep their last state.
    pub fn step(&mut self, tokens: &[f32]) -> &[f32] {
        let vector_width = self.vector_width;
        vector_width.run(Step { pass: self, tokens });
        self.ttis_processed += 1;
        &self.outputs
    }

    #[inline(always)]
    fn compute(&mut self, tokens: &[f32]) {
        let weights = Arc::clone(&self.weights);
        weights.embed.apply(tokens, &mut self.state);
        relu(&mut self.state);
        if let Some((time, lag_bias)) = &weights.time {
            self.attend_in_time(time, lag_bias);
        }
        self.feed_forward(&weights.feed_forward);
        if let Some((space, feed_forward)) = &weights.space {
            self.attend_in_space(space);
            self.feed_forward(feed_forward);
        }
        rms_norm(
            &self.state,
            &weights.output_norm,
            &mut self.inverse_norms,
            &mut self.normalised,
        );
        weights.output.apply(&self.normalised, &mut self.outputs);
        for out in &mut self.outputs {
            *out = OUTPUT_LIMIT * *out / (1.0 + out.abs());
        }
    }

    /// Returns the outputs of the last [`Self::step`].
    pub fn outputs(&self) -> &[f32] {
        &self.outputs
    }

    /// Returns the logarithm of the price in the TTI of the last [`Self::step`], within ± `LOG_PRICE_LIMIT`. `target`
    /// is the share of new events to detect in their first TTI.
    pub fn log_price(&mut self, target: f32) -> f32 {
        let d = self.weights.shape.width;
        self.pooled.fill(0.0);
        for row in self.normalised.chunks_exact(d) {
            add(&mut self.pooled, row);
        }
        for sum in &mut self.pooled {
            *sum /= self.devices as f32;
        }
        // Set after the division: unlike the other inputs, the target is not a mean over devices.
        self.pooled[d] = target;
        let mut inner = [0.0; PRICE_WIDTH];
        self.weights.price_inner.apply(&self.pooled, &mut inner);
        relu(&mut inner);
        let mut price = [0.0];
        self.weights.price_outer.apply(&inner, &mut price);
        price[0].clamp(-LOG_PRICE_LIMIT, LOG_PRICE_LIMIT)
    }

    /// Returns the attention of each device in the last step, `[N, heads, Z]` by lag; each row sums to 1. Lags
    /// before the first TTI have 0. Empty for a model without attention over time.
    pub fn attention(&self) -> &[f32] {
        &self.attention
    }

    #[inline(always)]
    fn attend_in_time(&mut self, time: &AttentionLayer, lag_bias: &[f32]) {
        let shape = self.weights.shape;
        let (d, z, head_width) = (shape.width, shape.memory, shape.head_width());
        let (slot, tti_len) = (self.ttis_processed % z, self.devices * d);
        rms_norm(&self.state, &time.norm, &mut self.inverse_norms, &mut self.normalised);
        time.query.apply(&self.normalised, &mut self.query);
        time.key
            .apply(&self.normalised, &mut self.keys[slot * tti_len..(slot + 1) * tti_len]);
        time.value
            .apply(&self.normalised, &mut self.values[slot * tti_len..(slot + 1) * tti_len]);
        let known_lags = (self.ttis_processed + 1).min(z);
        let scale = 1.0 / (head_width as f32).sqrt();
        // Keys and values are a ring of Z TTIs: the start of the entry for each lag.
        let slot_start = |lag: usize| ((self.ttis_processed - lag) % z) * tti_len;
        for lag in 0..known_lags {
            let keys = &self.keys[slot_start(lag)..][..tti_len];
            // Scores are stored by head and then by lag, so the scores of one lag are Z apart.
            let scores = self.attention[lag..].iter_mut().step_by(z);
            let pairs = self.query.chunks_exact(head_width).zip(keys.chunks_exact(head_width));
            for ((score, (query, key)), head) in scores.zip(pairs).zip((0..shape.heads).cycle()) {
                *score = dot(query, key) * scale + lag_bias[head * z + lag];
            }
        }
        softmax(&mut self.attention, z, known_lags);
        let rows = self.gathered.chunks_exact_mut(head_width);
        let rows = rows.zip(self.attention.chunks_exact(z));
        for ((gathered, shares), row_start) in rows.zip((0..).step_by(head_width)) {
            weighted_mean(gathered, &shares[..known_lags], |lag| {
                &self.values[slot_start(lag) + row_start..][..head_width]
            });
        }
        time.out.apply(&self.gathered, &mut self.projected);
        add(&mut self.state, &self.projected);
    }

    #[inline(always)]
    fn attend_in_space(&mut self, space: &AttentionLayer) {
        let shape = self.weights.shape;
        let (d, head_width) = (shape.width, shape.head_width());
        rms_norm(&self.state, &space.norm, &mut self.inverse_norms, &mut self.normalised);
        space.query.apply(&self.normalised, &mut self.query);
        // Keys and values of this TTI alone, in buffers that the temporal attention no longer needs.
        let (keys, values) = (&mut self.gathered, &mut self.projected);
        space.key.apply(&self.normalised, keys);
        space.value.apply(&self.normalised, values);
        // All features are above 0, and so is the sum by which `KeyValueSum::gather` divides.
        for feature in keys.iter_mut().chain(&mut self.query) {
            *feature = feature.max(0.0) + MIN_FEATURE;
        }
        for (head, sums) in self.key_value_sums.iter_mut().enumerate() {
            sums.sum_over_devices(
                keys,
                values,
                ColumnSlice {
                    start: head * head_width,
                    width: head_width,
                    stride: d,
                },
            );
        }
        for (head, sums) in self.key_value_sums.iter().enumerate() {
            sums.gather(
                &self.query,
                &mut self.gathered,
                ColumnSlice {
                    start: head * head_width,
                    width: head_width,
                    stride: d,
                },
            );
        }
        space.out.apply(&self.gathered, &mut self.projected);
        add(&mut self.state, &self.projected);
    }

    #[inline(always)]
    fn feed_forward(&mut self, layer: &FeedForward) {
        rms_norm(&self.state, &layer.norm, &mut self.inverse_norms, &mut self.normalised);
        layer.inner.apply(&self.normalised, &mut self.hidden);
        relu(&mut self.hidden);
        layer.outer.apply(&self.hidden, &mut self.projected);
        add(&mut self.state, &self.projected);
    }
}
