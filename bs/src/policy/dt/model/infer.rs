//! A model at work: the forward pass of one TTI.
//!
//! A token attends to the last Z TTIs of its own device (paper, Eqs. (δ(k)2) and (δ(k)3)), whose keys and values are
//! kept, and then the devices attend to each other. For the latter the weight of a pair is a product of two features
//! and not an exponential of one, so that its time grows with N and not with N². Nothing is allocated in a TTI.

use std::sync::Arc;

use super::kernel::{add, dot, norm, relu};
use super::shape::{EXPANSION, HEADS, PRICE_WIDTH};
use super::weights::{Attention, Mix, Weights};

/// The least that a device attends to another.
pub const LEAST_FEATURE: f32 = 0.01;
/// The largest logarithm that a head gives: nothing is expected e³ times as often as without history.
pub const LIMIT: f32 = 3.0;

/// What a model makes of one TTI after another, for N devices.
#[derive(Clone, Debug)]
pub struct Forward {
    weights: Arc<Weights>,
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
    /// By head, sums over devices: `[heads, d / heads, d / heads + 1]`.
    summary: Vec<f32>,
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
            summary: vec![0.0; shape.heads * shape.head_width() * (shape.head_width() + 1)],
            weights,
        }
    }

    /// One more TTI, with these tokens, `[N, F]`. Gives what is expected of each device, `[N, HEADS]`: logarithms
    /// within ± [`LIMIT`].
    pub fn step(&mut self, tokens: &[f32]) -> &[f32] {
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
        self.passed += 1;
        &self.out
    }

    /// The logarithm of the price that goes with a target in the TTI of the last step.
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
        price[0]
    }

    /// What each device attended to in the last step, `[N, heads, Z]` by lag; each sums to 1.
    pub fn attended(&self) -> &[f32] {
        &self.attended
    }

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
        for j in 0..self.devices {
            for head in 0..shape.heads {
                let at = j * d + head * width;
                let query = &self.query[at..at + width];
                let share = &mut self.attended[(j * shape.heads + head) * z..][..z];
                share.fill(0.0);
                let place = |lag: usize| ((self.passed - lag) % z) * size + at;
                for (lag, share) in share[..known].iter_mut().enumerate() {
                    let key = &self.keys[place(lag)..][..width];
                    *share = dot(query, key) * scale + weights.lags[head * z + lag];
                }
                softmax(&mut share[..known]);
                let gathered = &mut self.gathered[at..at + width];
                gathered.fill(0.0);
                for (lag, share) in share[..known].iter().enumerate() {
                    let value = &self.values[place(lag)..][..width];
                    for (gathered, value) in gathered.iter_mut().zip(value) {
                        *gathered += share * value;
                    }
                }
            }
        }
        time.out.apply(&self.gathered, &mut self.added);
        add(&mut self.state, &self.added);
        self.mix(&time.mix);
    }

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
        self.summary.fill(0.0);
        for (keys, values) in keys.chunks_exact(d).zip(values.chunks_exact(d)) {
            let heads = keys.chunks_exact(width).zip(values.chunks_exact(width));
            for ((keys, values), sums) in heads.zip(self.summary.chunks_exact_mut(width * (width + 1))) {
                for (key, sums) in keys.iter().zip(sums.chunks_exact_mut(width + 1)) {
                    let (last, sums) = sums.split_last_mut().expect("a column for the sum of keys");
                    for (sum, value) in sums.iter_mut().zip(values) {
                        *sum += key * value;
                    }
                    *last += key;
                }
            }
        }
        for (queries, gathered) in self.query.chunks_exact(d).zip(self.gathered.chunks_exact_mut(d)) {
            let heads = queries.chunks_exact(width).zip(gathered.chunks_exact_mut(width));
            for ((queries, gathered), sums) in heads.zip(self.summary.chunks_exact(width * (width + 1))) {
                gathered.fill(0.0);
                let mut all = 0.0;
                for (query, sums) in queries.iter().zip(sums.chunks_exact(width + 1)) {
                    for (gathered, sum) in gathered.iter_mut().zip(sums) {
                        *gathered += query * sum;
                    }
                    all += query * sums[width];
                }
                for gathered in gathered {
                    *gathered /= all;
                }
            }
        }
        space.out.apply(&self.gathered, &mut self.added);
        add(&mut self.state, &self.added);
        self.mix(&space.mix);
    }

    fn mix(&mut self, mix: &Mix) {
        norm(&self.state, &mix.norm, &mut self.normed);
        mix.inner.apply(&self.normed, &mut self.wide);
        relu(&mut self.wide);
        mix.outer.apply(&self.wide, &mut self.added);
        add(&mut self.state, &self.added);
    }
}

/// Shares that sum to 1, in proportion to the exponentials of `scores`.
fn softmax(scores: &mut [f32]) {
    let most = scores.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let mut sum = 0.0;
    for score in scores.iter_mut() {
        *score = libm::expf(*score - most);
        sum += *score;
    }
    for score in scores {
        *score /= sum;
    }
}
