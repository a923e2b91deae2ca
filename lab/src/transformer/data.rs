//! Recorded chunks, split into training and held-out data, and the batches drawn from them. The draws are part of the
//! result: a resumed training must draw the same batches.

use std::collections::BTreeMap;

#[cfg(test)]
use candle_core::DType;
use candle_core::{Device, Result, Tensor};
use reveille_bs::policy::dt::model::{ModelObjective, ModelShape};
use reveille_bs::policy::dt::tokens::{CAN_SENSE, FEATURE_COUNT};
use reveille_common::rng::Stream;

use crate::trajectories::{Chunk, Trajectories};

const HELD_OUT_RUNS_OF_TEN: u32 = 1;

/// The approximate number of device-TTIs of an evaluation on held-out data.
const EVALUATION_DEVICE_TTIS: usize = 500_000;

/// Training chunks, and held-out chunks of other runs, each by N and length.
pub(super) struct Data {
    groups: Vec<DatasetGroup>,
    /// The device-TTIs of each group's training chunks, which weight its draws.
    weights: Vec<f64>,
}

/// Chunks with the same N and length.
struct DatasetGroup {
    training: Vec<Chunk>,
    held_out: Vec<Chunk>,
}

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
        let mut groups: BTreeMap<(usize, usize), DatasetGroup> = BTreeMap::new();
        for (file, recorded) in trajectories.into_iter().enumerate() {
            for chunk in recorded.chunks {
                // A batch is one tensor, so its chunks must have the same N and length.
                let key = (chunk.devices, chunk.steps.len());
                let group = groups.entry(key).or_insert_with(|| DatasetGroup {
                    training: Vec::new(),
                    held_out: Vec::new(),
                });
                // Whole runs: chunks of one run share its deployment and events. The number of the file shifts the
                // choice, so that files with few runs are held out in turn.
                let is_held_out = (chunk.run + file as u32) % 10 < HELD_OUT_RUNS_OF_TEN;
                if is_held_out {
                    &mut group.held_out
                } else {
                    &mut group.training
                }
                .push(chunk);
            }
        }
        let groups: Vec<DatasetGroup> = groups
            .into_values()
            .filter(|group| !group.training.is_empty())
            .collect();
        let size = |group: &DatasetGroup| group.training.iter().map(|chunk| chunk.device_ttis() as f64).sum();
        Self {
            weights: groups.iter().map(size).collect(),
            groups,
        }
    }

    pub(super) fn training_chunk_count(&self) -> usize {
        self.groups.iter().map(|group| group.training.len()).sum()
    }

    pub(super) fn held_out_chunk_count(&self) -> usize {
        self.groups.iter().map(|group| group.held_out.len()).sum()
    }

    /// Draws chunks with the same N and length, of about `device_ttis` in all, from `stream`.
    pub(super) fn draw(&self, device_ttis: usize, stream: &mut Stream) -> Vec<&Chunk> {
        let total: f64 = self.weights.iter().sum();
        let mut remaining = stream.unit() * total;
        let chosen = self.weights.iter().position(|weight| {
            remaining -= weight;
            remaining < 0.0
        });
        // Rounding may leave a remainder above zero after the last group.
        let group = &self.groups[chosen.unwrap_or(self.groups.len() - 1)];
        let count = (device_ttis / group.training[0].device_ttis()).max(1);
        (0..count)
            .map(|_| &group.training[stream.below(group.training.len() as u64) as usize])
            .collect()
    }

    /// Returns batches of held-out chunks, each of about `device_ttis`. Groups are sampled evenly, to about
    /// [`EVALUATION_DEVICE_TTIS`] in all.
    pub(super) fn held_out_batches(&self, device_ttis: usize) -> Vec<Vec<&Chunk>> {
        let size = |group: &DatasetGroup| group.held_out.iter().map(Chunk::device_ttis).sum::<usize>();
        let total: usize = self.groups.iter().map(size).sum();
        let step = total.div_ceil(EVALUATION_DEVICE_TTIS).max(1);
        let mut batches = Vec::new();
        for group in &self.groups {
            let chunks: Vec<&Chunk> = group.held_out.iter().step_by(step).collect();
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
    pub(super) fn from_chunks(chunks: &[&Chunk], shape: ModelShape) -> Result<Self> {
        let (c, t, n) = (chunks.len(), chunks[0].steps.len(), chunks[0].devices);
        let mut tokens = Vec::with_capacity(c * t * n * FEATURE_COUNT);
        let mut flat: [Vec<f32>; 7] = std::array::from_fn(|_| Vec::with_capacity(c * t * n));
        let [targets, prices, priced, expected, found, wake_expected, wake_brought] = &mut flat;
        for chunk in chunks {
            let is_start = chunk.steps[0].tti.0 == 0;
            for (index, step) in chunk.steps.iter().enumerate() {
                let counts = is_start || index + 1 >= shape.memory.min(t);
                tokens.extend_from_slice(&step.tokens);
                targets.push(chunk.returns[index]);
                let price = chunk.price.filter(|price| counts && *price > 0.0);
                prices.push(price.map_or(0.0, libm::logf));
                priced.push(f32::from(u8::from(price.is_some())));
                for (look, token) in step.devices.iter().zip(step.tokens.as_chunks::<FEATURE_COUNT>().0) {
                    let (weight, is_hit) = match shape.objective {
                        ModelObjective::Events if look.is_sensing => (look.expected_events, look.has_reported_first),
                        ModelObjective::Actions if token[CAN_SENSE] > 0.5 => (1.0, look.is_sensing),
                        ModelObjective::Events | ModelObjective::Actions => (0.0, false),
                    };
                    let weight = if counts { weight.max(0.0) } else { 0.0 };
                    expected.push(weight);
                    found.push(f32::from(u8::from(weight > 0.0 && is_hit)));
                    let (expected_gain, gain) = look
                        .wake_up
                        .filter(|(expected_gain, _)| counts && *expected_gain > 0.0)
                        .unwrap_or_default();
                    wake_expected.push(expected_gain);
                    wake_brought.push(gain);
                }
            }
        }
        let [targets, prices, priced, expected, found, wake_expected, wake_brought] = flat;
        let by_tti = |values: Vec<f32>| Tensor::from_vec(values, (c, t), &Device::Cpu);
        let by_device = |values: Vec<f32>| Tensor::from_vec(values, (c, t, n), &Device::Cpu);
        Ok(Self {
            tokens: Tensor::from_vec(tokens, (c, t, n, FEATURE_COUNT), &Device::Cpu)?,
            targets: by_tti(targets)?,
            prices: by_tti(prices)?,
            priced: by_tti(priced)?,
            expected: by_device(expected)?,
            found: by_device(found)?,
            wake_expected: by_device(wake_expected)?,
            wake_brought: by_device(wake_brought)?,
            objective: shape.objective,
        })
    }

    #[cfg(test)]
    pub(super) fn to_type(&self, dtype: DType) -> Result<Self> {
        let convert = |tensor: &Tensor| tensor.to_dtype(dtype);
        Ok(Self {
            tokens: convert(&self.tokens)?,
            targets: convert(&self.targets)?,
            prices: convert(&self.prices)?,
            priced: convert(&self.priced)?,
            expected: convert(&self.expected)?,
            found: convert(&self.found)?,
            wake_expected: convert(&self.wake_expected)?,
            wake_brought: convert(&self.wake_brought)?,
            objective: self.objective,
        })
    }
}
