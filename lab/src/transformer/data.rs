//! Recorded chunks for the training of the policy `dt`, split into training and held-out data, and the batches drawn
//! from them. A chunk is a span of consecutive TTIs of one run.
//!
//! The order of groups (N, length), of chunks and of calls to `stream` is part of the result: a resumed training must
//! draw the same batches.

use std::collections::BTreeMap;

#[cfg(test)]
use candle_core::DType;
use candle_core::{Device, Result, Tensor};
use reveille_bs::policy::dt::model::{ModelObjective, ModelShape};
use reveille_bs::policy::dt::tokens::{CAN_SENSE, FEATURE_COUNT};
use reveille_common::rng::Stream;

use crate::trajectories::{Chunk, Trajectories};

/// One run in this many is held out. Another number makes trained models and scores incomparable.
const HELD_OUT_PERIOD: u32 = 10;

/// The approximate number of device-TTIs of an evaluation on held-out data.
const EVALUATION_DEVICE_TTIS: usize = 500_000;

/// Training chunks, and held-out chunks of other runs, each by N and length.
pub(super) struct Dataset {
    groups: Vec<DatasetGroup>,
    /// The device-TTIs of each group's training chunks, which weight its draws.
    draw_weights: Vec<f64>,
}

/// Chunks with the same N and length.
struct DatasetGroup {
    training: Vec<Chunk>,
    held_out: Vec<Chunk>,
}

/// A batch of C chunks with N devices and T TTIs; F features per token.
pub(super) struct TrainingBatch {
    /// The training objective.
    pub objective: ModelObjective,
    /// The features of the tokens, `[C, T, N, F]`.
    pub tokens: Tensor,
    /// The target returns, `[C, T]`.
    pub targets: Tensor,
    /// The logarithm of the price θ of the policy that recorded the chunk, `[C, T]`; 0 without a price.
    pub log_prices: Tensor,
    /// 1 for a TTI with a price to learn, else 0, `[C, T]`.
    pub has_price: Tensor,
    /// `[C, T, N]`. For [`ModelObjective::Events`]: the events that a sensing device is expected to find, given only α.
    /// For [`ModelObjective::Actions`]: 1 for a device that could sense. Otherwise 0.
    pub expected: Tensor,
    /// `[C, T, N]`. For [`ModelObjective::Events`]: 1 for a sensing device with a first report of an event. For
    /// [`ModelObjective::Actions`]: 1 for a device that sensed. Otherwise 0.
    pub found: Tensor,
    /// The expected information gain of waking the device, in Ψ, `[C, T, N]`; 0 without a wake-up.
    pub wake_expected_gain: Tensor,
    /// The actual information gain of the wake-up, in Ψ, `[C, T, N]`; 0 without a wake-up.
    pub wake_gain: Tensor,
}

/// The values of a [`TrainingBatch`] before they become tensors, in the order of its dimensions.
#[derive(Default)]
struct BatchValues {
    tokens: Vec<f32>,
    targets: Vec<f32>,
    log_prices: Vec<f32>,
    has_price: Vec<f32>,
    expected: Vec<f32>,
    found: Vec<f32>,
    wake_expected_gain: Vec<f32>,
    wake_gain: Vec<f32>,
}

impl Dataset {
    /// Groups the chunks of `trajectories` and holds out one run in [`HELD_OUT_PERIOD`]. A group without training
    /// chunks is left out, with its held-out chunks. A held-out run is not always a new world: runs of a grid that
    /// differ only in their settings share seeds and events.
    pub(super) fn new(trajectories: Vec<Trajectories>) -> Self {
        let mut groups: BTreeMap<(usize, usize), DatasetGroup> = BTreeMap::new();
        for (file_index, recorded) in trajectories.into_iter().enumerate() {
            for chunk in recorded.chunks {
                // A batch is one tensor, so its chunks must have the same N and length.
                let key = (chunk.devices, chunk.steps.len());
                let group = groups.entry(key).or_insert_with(|| DatasetGroup {
                    training: Vec::new(),
                    held_out: Vec::new(),
                });
                // Whole runs: chunks of one run share its deployment and events, so a model that has learned one
                // would score too well on another. The index of the file shifts the choice, so that files with fewer
                // runs than the period do not all hold out their first.
                let is_held_out = (chunk.run + file_index as u32).is_multiple_of(HELD_OUT_PERIOD);
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
        let training_size = |group: &DatasetGroup| group.training.iter().map(|chunk| chunk.device_ttis() as f64).sum();
        Self {
            draw_weights: groups.iter().map(training_size).collect(),
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
    ///
    /// # Panics
    /// If there is no training chunk.
    pub(super) fn draw(&self, device_ttis: usize, stream: &mut Stream) -> Vec<&Chunk> {
        let total: f64 = self.draw_weights.iter().sum();
        let mut remaining = stream.unit() * total;
        let chosen = self.draw_weights.iter().position(|weight| {
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
        let held_out_size = |group: &DatasetGroup| group.held_out.iter().map(Chunk::device_ttis).sum::<usize>();
        let total: usize = self.groups.iter().map(held_out_size).sum();
        let stride = total.div_ceil(EVALUATION_DEVICE_TTIS).max(1);
        let mut batches = Vec::new();
        for group in &self.groups {
            let chunks: Vec<&Chunk> = group.held_out.iter().step_by(stride).collect();
            let Some(first) = chunks.first() else { continue };
            let count = (device_ttis / first.device_ttis()).max(1);
            batches.extend(chunks.chunks(count).map(<[&Chunk]>::to_vec));
        }
        batches
    }
}

impl TrainingBatch {
    /// Creates a batch of `chunks`, all with the same N and length, for a model of `shape`. Unless a chunk starts its
    /// run, its first `shape.memory − 1` TTIs have no weight, because the model would attend to TTIs before the chunk.
    ///
    /// # Panics
    /// If `chunks` is empty, or a chunk has no TTI.
    pub(super) fn from_chunks(chunks: &[&Chunk], shape: ModelShape) -> Result<Self> {
        let (c, t, n) = (chunks.len(), chunks[0].steps.len(), chunks[0].devices);
        let mut values = BatchValues::default();
        for chunk in chunks {
            let starts_run = chunk.steps[0].tti.0 == 0;
            for (index, step) in chunk.steps.iter().enumerate() {
                // In a chunk shorter than the memory, the last TTI has weight.
                let has_weight = starts_run || index + 1 >= shape.memory.min(t);
                values.tokens.extend_from_slice(&step.tokens);
                values.targets.push(chunk.returns[index]);
                let price = chunk.price.filter(|price| has_weight && *price > 0.0);
                // `libm` returns the same bits on every platform, unlike `f32::ln`.
                values.log_prices.push(price.map_or(0.0, libm::logf));
                values.has_price.push(f32::from(u8::from(price.is_some())));
                for (device, token) in step.devices.iter().zip(step.tokens.as_chunks::<FEATURE_COUNT>().0) {
                    let (expected, is_found) = match shape.objective {
                        ModelObjective::Events if device.is_sensing => {
                            (device.expected_events, device.has_reported_first)
                        }
                        ModelObjective::Actions if token[CAN_SENSE] > 0.5 => (1.0, device.is_sensing),
                        ModelObjective::Events | ModelObjective::Actions => (0.0, false),
                    };
                    let expected = if has_weight { expected.max(0.0) } else { 0.0 };
                    values.expected.push(expected);
                    values.found.push(f32::from(u8::from(expected > 0.0 && is_found)));
                    let (expected_gain, gain) = device
                        .wake_up
                        .filter(|(expected_gain, _)| has_weight && *expected_gain > 0.0)
                        .unwrap_or_default();
                    values.wake_expected_gain.push(expected_gain);
                    values.wake_gain.push(gain);
                }
            }
        }
        let by_tti = |values: Vec<f32>| Tensor::from_vec(values, (c, t), &Device::Cpu);
        let by_device = |values: Vec<f32>| Tensor::from_vec(values, (c, t, n), &Device::Cpu);
        Ok(Self {
            tokens: Tensor::from_vec(values.tokens, (c, t, n, FEATURE_COUNT), &Device::Cpu)?,
            targets: by_tti(values.targets)?,
            log_prices: by_tti(values.log_prices)?,
            has_price: by_tti(values.has_price)?,
            expected: by_device(values.expected)?,
            found: by_device(values.found)?,
            wake_expected_gain: by_device(values.wake_expected_gain)?,
            wake_gain: by_device(values.wake_gain)?,
            objective: shape.objective,
        })
    }

    #[cfg(test)]
    pub(super) fn to_dtype(&self, dtype: DType) -> Result<Self> {
        let convert = |tensor: &Tensor| tensor.to_dtype(dtype);
        Ok(Self {
            tokens: convert(&self.tokens)?,
            targets: convert(&self.targets)?,
            log_prices: convert(&self.log_prices)?,
            has_price: convert(&self.has_price)?,
            expected: convert(&self.expected)?,
            found: convert(&self.found)?,
            wake_expected_gain: convert(&self.wake_expected_gain)?,
            wake_gain: convert(&self.wake_gain)?,
            objective: self.objective,
        })
    }
}
