//! Batches of recorded data.

use std::collections::BTreeMap;

#[cfg(test)]
use candle_core::DType;
use candle_core::{Device, Result, Tensor};
use reveille_bs::policy::dt::model::{ModelObjective, ModelShape};
use reveille_bs::policy::dt::tokens::{CAN_SENSE, COUNT};
use reveille_common::rng::Stream;

use crate::trajectories::{Chunk, Trajectories};

/// The number of runs out of ten that are held out.
const HELD_OUT: u32 = 1;

/// The approximate number of device-TTIs of an evaluation on held-out data.
const JUDGED: usize = 500_000;

/// Training chunks, and held-out chunks of other runs, each by N and length.
pub(super) struct Data {
    groups: Vec<Group>,
    /// The device-TTIs of each group's training chunks, which weight its draws.
    weights: Vec<f64>,
}

/// Chunks with the same N and length.
struct Group {
    learn: Vec<Chunk>,
    judge: Vec<Chunk>,
}

/// A batch.
pub(super) struct TrainingBatch {
    /// The training objective.
    pub objective: ModelObjective,
    /// The features of the tokens, `[C, T, N, F]`.
    pub tokens: Tensor,
    /// The target returns, `[C, T]`, as for `prices` and `priced`.
    pub targets: Tensor,
    /// The logarithm of the teacher's price; 0 without a price.
    pub prices: Tensor,
    /// 1 for a TTI with a price to learn, else 0.
    pub priced: Tensor,
    /// The labels, `[C, T, N]` each: events expected from devices that looked, events found, the expected gain of
    /// wake-ups, and their gain. For a model that learns actions, the first two are 1 for devices that could sense
    /// and for devices that sensed.
    pub expected: Tensor,
    pub found: Tensor,
    pub wake_expected: Tensor,
    pub wake_brought: Tensor,
}

impl Data {
    /// Groups the chunks of `trajectories` and holds out one run of ten. Runs of a grid that differ in their settings
    /// alone share seeds and events. The held-out data then has other batteries and decisions in the same worlds.
    pub(super) fn new(trajectories: Vec<Trajectories>) -> Self {
        let mut groups: BTreeMap<(usize, usize), Group> = BTreeMap::new();
        for (file, one) in trajectories.into_iter().enumerate() {
            for chunk in one.chunks {
                // A batch is one tensor, so its chunks must have the same N and length.
                let key = (chunk.devices, chunk.steps.len());
                let group = groups.entry(key).or_insert_with(|| Group {
                    learn: Vec::new(),
                    judge: Vec::new(),
                });
                // Whole runs: chunks of one run share its deployment and events. The number of the file shifts the
                // choice, so that files with few runs are held out in turn.
                let is_held_out = (chunk.run + file as u32) % 10 < HELD_OUT;
                if is_held_out {
                    &mut group.judge
                } else {
                    &mut group.learn
                }
                .push(chunk);
            }
        }
        let groups: Vec<Group> = groups.into_values().filter(|group| !group.learn.is_empty()).collect();
        let size = |group: &Group| group.learn.iter().map(|chunk| chunk.device_ttis() as f64).sum();
        Self {
            weights: groups.iter().map(size).collect(),
            groups,
        }
    }

    /// The number of training chunks.
    pub(super) fn learned_from(&self) -> usize {
        self.groups.iter().map(|group| group.learn.len()).sum()
    }

    /// The number of held-out chunks.
    pub(super) fn held_out(&self) -> usize {
        self.groups.iter().map(|group| group.judge.len()).sum()
    }

    /// Draws chunks with the same N and length, of about `device_ttis` in all, from `stream`.
    pub(super) fn draw(&self, device_ttis: usize, stream: &mut Stream) -> Vec<&Chunk> {
        let all: f64 = self.weights.iter().sum();
        let mut left = stream.unit() * all;
        let chosen = self.weights.iter().position(|weight| {
            left -= weight;
            left < 0.0
        });
        // Rounding may leave a remainder above zero after the last group.
        let group = &self.groups[chosen.unwrap_or(self.groups.len() - 1)];
        let count = (device_ttis / group.learn[0].device_ttis()).max(1);
        (0..count)
            .map(|_| &group.learn[stream.below(group.learn.len() as u64) as usize])
            .collect()
    }

    /// Returns batches of held-out chunks, each of about `device_ttis`. Groups are sampled evenly, to about [`JUDGED`]
    /// device-TTIs in all.
    pub(super) fn held_out_batches(&self, device_ttis: usize) -> Vec<Vec<&Chunk>> {
        let size = |group: &Group| group.judge.iter().map(Chunk::device_ttis).sum::<usize>();
        let all: usize = self.groups.iter().map(size).sum();
        let every = all.div_ceil(JUDGED).max(1);
        let mut batches = Vec::new();
        for group in &self.groups {
            let chunks: Vec<&Chunk> = group.judge.iter().step_by(every).collect();
            let Some(first) = chunks.first() else { continue };
            let count = (device_ttis / first.device_ttis()).max(1);
            batches.extend(chunks.chunks(count).map(<[&Chunk]>::to_vec));
        }
        batches
    }
}

impl TrainingBatch {
    /// Creates a batch of `chunks`, all with the same N and length, for a model of `shape`. TTIs before the Z-th of a
    /// chunk do not count, unless the run starts with the chunk: their history is unknown.
    pub(super) fn of(chunks: &[&Chunk], shape: ModelShape) -> Result<Self> {
        let (c, t, n) = (chunks.len(), chunks[0].steps.len(), chunks[0].devices);
        let mut tokens = Vec::with_capacity(c * t * n * COUNT);
        let mut flat: [Vec<f32>; 7] = std::array::from_fn(|_| Vec::with_capacity(c * t * n));
        let [targets, prices, priced, expected, found, wake_expected, wake_brought] = &mut flat;
        for chunk in chunks {
            let is_start = chunk.steps[0].tti.0 == 0;
            for (at, step) in chunk.steps.iter().enumerate() {
                let counts = is_start || at + 1 >= shape.memory.min(t);
                tokens.extend_from_slice(&step.tokens);
                targets.push(chunk.returns[at]);
                let price = chunk.price.filter(|price| counts && *price > 0.0);
                prices.push(price.map_or(0.0, libm::logf));
                priced.push(f32::from(u8::from(price.is_some())));
                for (look, token) in step.looks.iter().zip(step.tokens.as_chunks::<COUNT>().0) {
                    let (weight, is_hit) = match shape.objective {
                        ModelObjective::Events if look.on => (look.expected, look.found),
                        ModelObjective::Actions if token[CAN_SENSE] > 0.5 => (1.0, look.on),
                        ModelObjective::Events | ModelObjective::Actions => (0.0, false),
                    };
                    let weight = if counts { weight.max(0.0) } else { 0.0 };
                    expected.push(weight);
                    found.push(f32::from(u8::from(weight > 0.0 && is_hit)));
                    let (hoped, brought) = look
                        .wake_up
                        .filter(|(hoped, _)| counts && *hoped > 0.0)
                        .unwrap_or_default();
                    wake_expected.push(hoped);
                    wake_brought.push(brought);
                }
            }
        }
        let [targets, prices, priced, expected, found, wake_expected, wake_brought] = flat;
        let of_ttis = |values: Vec<f32>| Tensor::from_vec(values, (c, t), &Device::Cpu);
        let of_devices = |values: Vec<f32>| Tensor::from_vec(values, (c, t, n), &Device::Cpu);
        Ok(Self {
            tokens: Tensor::from_vec(tokens, (c, t, n, COUNT), &Device::Cpu)?,
            targets: of_ttis(targets)?,
            prices: of_ttis(prices)?,
            priced: of_ttis(priced)?,
            expected: of_devices(expected)?,
            found: of_devices(found)?,
            wake_expected: of_devices(wake_expected)?,
            wake_brought: of_devices(wake_brought)?,
            objective: shape.objective,
        })
    }

    /// Converts the batch to numbers of another type.
    #[cfg(test)]
    pub(super) fn of_type(&self, dtype: DType) -> Result<Self> {
        let of = |tensor: &Tensor| tensor.to_dtype(dtype);
        Ok(Self {
            tokens: of(&self.tokens)?,
            targets: of(&self.targets)?,
            prices: of(&self.prices)?,
            priced: of(&self.priced)?,
            expected: of(&self.expected)?,
            found: of(&self.found)?,
            wake_expected: of(&self.wake_expected)?,
            wake_brought: of(&self.wake_brought)?,
            objective: self.objective,
        })
    }
}
