//! A model at work: the forward pass of one TTI.
//!
//! A token attends to the last Z TTIs of its own device (paper, Eqs. (δ(k)2) and (δ(k)3)), whose keys and values are
//! kept, and then the devices attend to each other. For the latter the weight of a pair is a product of two features
//! and not an exponential of one, so that its time grows with N and not with N². Nothing is allocated in a TTI.

#![expect(
    clippy::inline_always,
    reason = "what is not inlined there is not compiled for the instructions that Width::run chooses"
)]

use std::sync::Arc;

use super::kernel::{Part, Summary, Width, add, dot, mean, norm, relu, softmax};
use super::shape::{EXPANSION, HEADS, PRICE_WIDTH};
use super::weights::{Attention, Mix, Weights};

/// The least that a device attends to another.
pub const LEAST_FEATURE: f32 = 0.01;
/// The largest logarithm that a head gives: nothing is expected e³ times as often as without history.
pub const LIMIT: f32 = 3.0;
/// The most by which the logarithm of a target's price may differ from 0: targets beyond those that were learned from
/// would else give any price.
pub const PRICE_LIMIT: f32 = 5.0;

/// What a model makes of one TTI after another, for N devices.
#[derive(Clone, Debug)]
pub struct Forward {
    weights: Arc<Weights>,
    width: Width,
    devices: usize,
    /// TTIs seen so far.
    passed: usize,
    /// By TTI modulo Z, `[Z, N, d]`.
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
    /// The weights of the last temporal attention, `[N, heads, Z]` by lag.
    attended: Vec<f32>,
    /// By head.
    summaries: Vec<Summary>,
    /// The mean over devices, and a target: `[d + 1]`.
    pooled: Vec<f32>,
}

impl Forward {
    /// For `devices` devices, before the first TTI.
    pub fn new(weights: Arc<Weights>, devices: usize) -> Self {
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
            summaries: vec![Summary::new(shape.head_width()); shape.heads],
            weights,
        }
    }

    /// As before, by instructions of another width.
    #[must_use]
    pub fn with_width(self, width: Width) -> Self {
        Self { width, ..self }
    }

    /// One more TTI, with these tokens, `[N, F]`. Gives what is expected of each device, `[N, HEADS]`: logarithms
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

    /// The logarithm of the price that goes with a target in the TTI of the last step, within ± [`PRICE_LIMIT`].
    pub fn price(&mut self, target: f32) -> f32 {
        let d = self.weights.shape.width;
        self.pooled.fill(0.0);
        for row in self.normed.chunks_exact(d) {
            add(&mut self.pooled, row);
        }
        for sum in &mut self.pooled {
            *sum /= self.devices as f32;
        }
        self.pooled[d] = target;
        let mut inner = [0.0; PRICE_WIDTH];
        self.weights.price_inner.apply(&self.pooled, &mut inner);
        relu(&mut inner);
        let mut price = [0.0];
        self.weights.price_outer.apply(&inner, &mut price);
        price[0].clamp(-PRICE_LIMIT, PRICE_LIMIT)
    }

    /// What each device attended to in the last step, `[N, heads, Z]` by lag; each sums to 1.
    pub fn attended(&self) -> &[f32] {
        &self.attended
    }

    #[inline(always)]
    fn attend_in_time(&mut self, weights: &Weights) {
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
        // Of each lag, the TTI's place among those that are kept.
        let place = |lag: usize| ((self.passed - lag) % z) * size;
        for lag in 0..known {
            let keys = &self.keys[place(lag)..][..size];
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
    fn attend_in_space(&mut self, space: &Attention) {
        let shape = self.weights.shape;
        let (d, width) = (shape.width, shape.head_width());
        norm(&self.state, &space.norm, &mut self.normed);
        space.query.apply(&self.normed, &mut self.query);
        // Keys and values of this TTI alone.
        let (keys, values) = (&mut self.gathered, &mut self.added);
        space.key.apply(&self.normed, keys);
        space.value.apply(&self.normed, values);
        for feature in keys.iter_mut().chain(&mut self.query) {
            *feature = feature.max(0.0) + LEAST_FEATURE;
        }
        for (head, summary) in self.summaries.iter_mut().enumerate() {
            summary.fill(
                keys,
                values,
                Part {
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
                Part {
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
    fn mix(&mut self, mix: &Mix) {
        norm(&self.state, &mix.norm, &mut self.normed);
        mix.inner.apply(&self.normed, &mut self.wide);
        relu(&mut self.wide);
        mix.outer.apply(&self.wide, &mut self.added);
        add(&mut self.state, &self.added);
    }
}
