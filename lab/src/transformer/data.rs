//! Batches of what was recorded.

use std::collections::BTreeMap;

#[cfg(test)]
use candle_core::DType;
use candle_core::{Device, Result, Tensor};
use reveille_bs::policy::dt::model::shape::{Objective, Shape};
use reveille_bs::policy::dt::senses::{CAN_SENSE, COUNT};
use reveille_common::rng::Stream;

use crate::trajectories::{Chunk, Trajectories};

/// Of ten runs, as many are held out.
const HELD_OUT: u32 = 1;

/// Device-TTIs of a look at what is held out, about.
const JUDGED: usize = 500_000;

/// Chunks to learn from, and chunks of other runs to be judged by, each by N and length.
pub struct Data {
    groups: Vec<Group>,
    /// Device-TTIs of each group's learning chunks: how often it is drawn.
    weights: Vec<f64>,
}

/// Chunks with the same N and length.
struct Group {
    learn: Vec<Chunk>,
    judge: Vec<Chunk>,
}

/// A batch.
pub struct Batch {
    /// What is learned from it.
    pub objective: Objective,
    /// `[C, T, N, F]`.
    pub tokens: Tensor,
    /// `[C, T]` each.
    pub targets: Tensor,
    /// The logarithm of the teacher's price; 0 where it has none.
    pub prices: Tensor,
    /// 1 where there is a price to learn, else 0.
    pub priced: Tensor,
    /// `[C, T, N]` each: events expected of those that looked, events found; what wake-ups were expected to bring, and
    /// what they brought. Where actions are learned: 1 for those that could sense, and for those of them that did.
    pub expected: Tensor,
    pub found: Tensor,
    pub wake_expected: Tensor,
    pub wake_brought: Tensor,
}

impl Data {
    /// Of `trajectories`. One run of ten is held out. Runs of a grid that differ in their settings alone have their
    /// seeds in common, and so their events: what is held out is other batteries and decisions in the same worlds.
    pub fn new(trajectories: Vec<Trajectories>) -> Self {
        let mut groups: BTreeMap<(usize, usize), Group> = BTreeMap::new();
        for (file, one) in trajectories.into_iter().enumerate() {
            for chunk in one.chunks {
                let key = (chunk.devices, chunk.steps.len());
                let group = groups.entry(key).or_insert_with(|| Group {
                    learn: Vec::new(),
                    judge: Vec::new(),
                });
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

    /// Chunks to learn from.
    pub fn learned_from(&self) -> usize {
        self.groups.iter().map(|group| group.learn.len()).sum()
    }

    /// Chunks that are held out.
    pub fn held_out(&self) -> usize {
        self.groups.iter().map(|group| group.judge.len()).sum()
    }

    /// Chunks with the same N and length, of about `device_ttis` together, drawn by `stream`.
    pub fn draw(&self, device_ttis: usize, stream: &mut Stream) -> Vec<&Chunk> {
        let all: f64 = self.weights.iter().sum();
        let mut left = stream.unit() * all;
        let chosen = self.weights.iter().position(|weight| {
            left -= weight;
            left < 0.0
        });
        let group = &self.groups[chosen.unwrap_or(self.groups.len() - 1)];
        let count = (device_ttis / group.learn[0].device_ttis()).max(1);
        (0..count)
            .map(|_| &group.learn[stream.below(group.learn.len() as u64) as usize])
            .collect()
    }

    /// What is held out, of each group as much as makes [`JUDGED`] device-TTIs in all, as chunks of batches of about
    /// `device_ttis`.
    pub fn held_out_batches(&self, device_ttis: usize) -> Vec<Vec<&Chunk>> {
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

impl Batch {
    /// Of `chunks`, all with the same N and length, for a model of `shape`. TTIs before the Z-th of a chunk are not
    /// learned from, unless a run begins with it: what was before them is not known.
    pub fn of(chunks: &[&Chunk], shape: Shape) -> Result<Self> {
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
                        Objective::Events if look.on => (look.expected, look.found),
                        Objective::Actions if token[CAN_SENSE] > 0.5 => (1.0, look.on),
                        Objective::Events | Objective::Actions => (0.0, false),
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

    /// The same as numbers of another type.
    #[cfg(test)]
    pub fn of_type(&self, dtype: DType) -> Result<Self> {
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
