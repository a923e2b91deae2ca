//! Forward pass of the model for one TTI.
//!
//! A token attends to the last Z TTIs of its own device (paper, Eqs. (δ(k)2) and (δ(k)3)), whose keys and values are
//! kept. Then the devices attend to each other. There the weight of a pair is a product of two features, not an
//! exponential of one. The time thus grows with N and not with N². A TTI needs no allocation.

#![expect(
    clippy::inline_always,
    reason = "what is not inlined there is not compiled for the instructions that Width::run chooses"
)]

use std::sync::Arc;

use super::kernel::{HeadSlice, KeyValueSum, Width, add, dot, mean, norm, relu, softmax};
use super::weights::{AttentionLayer, FeedForward, ModelWeights};
use super::{EXPANSION, HEADS, PRICE_WIDTH};

/// Least feature of a key or query, so that every device attends to every other.
pub const LEAST_FEATURE: f32 = 0.01;
/// Largest absolute logarithm of an output: no expectation exceeds e³ times the expectation without history.
pub const LIMIT: f32 = 3.0;
/// Largest absolute logarithm of the price for a target. Without it, a target outside the training range could give any
/// price.
pub(crate) const PRICE_LIMIT: f32 = 5.0;

/// State of a model that processes one TTI after another, for N devices.
#[derive(Clone, Debug)]
pub struct Forward {
    weights: Arc<ModelWeights>,
    width: Width,
    devices: usize,
    /// Number of TTIs processed so far.
    passed: usize,
    /// Keys by TTI modulo Z, `[Z, N, d]`.
    keys: Vec<f32>,
    values: Vec<f32>,
    /// `[N, d]` each.
    state: Vec<f32>,
    normed: Vec<f32>,
    query: Vec<f32>,
    gathered: Vec<f32>,
    added: Vec<f32>,
    /// `[N, 2d]`.
    wide: Vec<f32>,
    /// `[N, HEADS]`.
    out: Vec<f32>,
    /// Weights of the last temporal attention, `[N, heads, Z]` by lag.
    attended: Vec<f32>,
    /// Key-value sums by head.
    summaries: Vec<KeyValueSum>,
    /// Mean over devices, followed by a target: `[d + 1]`.
    pooled: Vec<f32>,
}

impl Forward {
    /// Creates the state for `devices` devices, before the first TTI.
    pub fn new(weights: Arc<ModelWeights>, devices: usize) -> Self {
        let shape = weights.shape;
        let (d, z) = (shape.width, shape.memory);
        let tokens = || vec![0.0; devices * d];
        Self {
            width: Width::fastest(),
            devices,
            passed: 0,
            keys: vec![0.0; z * devices * d],
            values: vec![0.0; z * devices * d],
            state: tokens(),
            normed: tokens(),
            query: tokens(),
            gathered: tokens(),
            added: tokens(),
            wide: vec![0.0; devices * d * EXPANSION],
            out: vec![0.0; devices * HEADS],
            attended: vec![0.0; devices * shape.heads * z],
            pooled: vec![0.0; d + 1],
            summaries: vec![KeyValueSum::new(shape.head_width()); shape.heads],
            weights,
        }
    }

    /// Sets the width of the vector instructions, which does not change the result.
    #[must_use]
    pub fn with_width(self, width: Width) -> Self {
        Self { width, ..self }
    }

    /// Processes the next TTI with these tokens, `[N, F]`. Returns the outputs of each device, `[N, HEADS]`: logarithms
    /// within ± [`LIMIT`].
    pub fn step(&mut self, tokens: &[f32]) -> &[f32] {
        let width = self.width;
        width.run(
            #[inline(always)]
            || self.compute(tokens),
        );
        self.passed += 1;
        &self.out
    }

    #[inline(always)]
    fn compute(&mut self, tokens: &[f32]) {
        let weights = Arc::clone(&self.weights);
        weights.embed.apply(tokens, &mut self.state);
        relu(&mut self.state);
        self.attend_in_time(&weights);
        if let Some(space) = &weights.space {
            self.attend_in_space(space);
        }
        norm(&self.state, &weights.head_norm, &mut self.normed);
        weights.head.apply(&self.normed, &mut self.out);
        for out in &mut self.out {
            *out = LIMIT * *out / (1.0 + out.abs());
        }
    }

    /// Returns the logarithm of the price for a target in the TTI of the last step, within ± `PRICE_LIMIT`.
    pub fn price(&mut self, target: f32) -> f32 {
        let d = self.weights.shape.width;
        self.pooled.fill(0.0);
        for row in self.normed.chunks_exact(d) {
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
        price[0].clamp(-PRICE_LIMIT, PRICE_LIMIT)
    }

    /// Returns the attention of each device in the last step, `[N, heads, Z]` by lag; each row sums to 1.
    pub fn attended(&self) -> &[f32] {
        &self.attended
    }

    #[inline(always)]
    fn attend_in_time(&mut self, weights: &ModelWeights) {
        let shape = weights.shape;
        let (d, z, width) = (shape.width, shape.memory, shape.head_width());
        let time = &weights.time;
        let (slot, size) = (self.passed % z, self.devices * d);
        norm(&self.state, &time.norm, &mut self.normed);
        time.query.apply(&self.normed, &mut self.query);
        time.key
            .apply(&self.normed, &mut self.keys[slot * size..(slot + 1) * size]);
        time.value
            .apply(&self.normed, &mut self.values[slot * size..(slot + 1) * size]);
        let known = (self.passed + 1).min(z);
        let scale = 1.0 / (width as f32).sqrt();
        // Keys and values are a ring of Z TTIs: the start of the entry for each lag.
        let place = |lag: usize| ((self.passed - lag) % z) * size;
        for lag in 0..known {
            let keys = &self.keys[place(lag)..][..size];
            // Scores are stored by head and then by lag, so the scores of one lag are Z apart.
            let scores = self.attended[lag..].iter_mut().step_by(z);
            let pairs = self.query.chunks_exact(width).zip(keys.chunks_exact(width));
            for ((score, (query, key)), head) in scores.zip(pairs).zip((0..shape.heads).cycle()) {
                *score = dot(query, key) * scale + weights.lags[head * z + lag];
            }
        }
        softmax(&mut self.attended, z, known);
        let heads = self.gathered.chunks_exact_mut(width).zip(self.attended.chunks_exact(z));
        for ((gathered, shares), at) in heads.zip((0..).step_by(width)) {
            mean(gathered, &shares[..known], |lag| {
                &self.values[place(lag) + at..][..width]
            });
        }
        time.out.apply(&self.gathered, &mut self.added);
        add(&mut self.state, &self.added);
        self.mix(&time.mix);
    }

    #[inline(always)]
    fn attend_in_space(&mut self, space: &AttentionLayer) {
        let shape = self.weights.shape;
        let (d, width) = (shape.width, shape.head_width());
        norm(&self.state, &space.norm, &mut self.normed);
        space.query.apply(&self.normed, &mut self.query);
        // Keys and values of this TTI alone, in buffers that the temporal attention no longer needs.
        let (keys, values) = (&mut self.gathered, &mut self.added);
        space.key.apply(&self.normed, keys);
        space.value.apply(&self.normed, values);
        // All features are above 0, and so is the sum by which `KeyValueSum::gather` divides.
        for feature in keys.iter_mut().chain(&mut self.query) {
            *feature = feature.max(0.0) + LEAST_FEATURE;
        }
        for (head, summary) in self.summaries.iter_mut().enumerate() {
            summary.fill(
                keys,
                values,
                HeadSlice {
                    at: head * width,
                    width,
                    of: d,
                },
            );
        }
        for (head, summary) in self.summaries.iter().enumerate() {
            summary.gather(
                &self.query,
                &mut self.gathered,
                HeadSlice {
                    at: head * width,
                    width,
                    of: d,
                },
            );
        }
        space.out.apply(&self.gathered, &mut self.added);
        add(&mut self.state, &self.added);
        self.mix(&space.mix);
    }

    #[inline(always)]
    fn mix(&mut self, mix: &FeedForward) {
        norm(&self.state, &mix.norm, &mut self.normed);
        mix.inner.apply(&self.normed, &mut self.wide);
        relu(&mut self.wide);
        mix.outer.apply(&self.wide, &mut self.added);
        add(&mut self.state, &self.added);
    }
}
