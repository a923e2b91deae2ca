//! The transformer of the policy `dt`: its shape ([`ModelShape`]), its [`weights`] with their file, and its inference
//! ([`infer`], with the arithmetic in `kernel`). `lab/src/transformer/` trains it. The names and sizes of the tensors
//! ([`ModelShape::tensors`]) are the format of the weights file, such as `../shipped.safetensors`; `weights` and
//! `lab/src/transformer/net.rs` repeat the names. In the code, a *target* is the share of new events to detect in their
//! first TTI, and the *price* is the price θ of a TTI in S1.

pub mod infer;
mod kernel;
pub mod weights;

use super::tokens;

pub use kernel::NORM_EPSILON;

/// Largest number of TTIs that a model can look back, including its own.
pub(crate) const MAX_MEMORY: u64 = 64;
/// Largest [`ModelShape::width`]. The three limits are also ranges of fields in `../settings.rs`.
pub(crate) const MAX_WIDTH: u64 = 256;
/// Largest number of heads.
pub(crate) const MAX_HEADS: u64 = 16;
/// Width of the feed-forward layers, in widths of the model. This and the next two constants size tensors, so a
/// change invalidates all model files.
pub(crate) const EXPANSION: usize = 2;
/// Width of the layer that turns a target into a price.
pub(crate) const PRICE_WIDTH: usize = 16;
/// Outputs per device. [`ModelObjective`] defines the first. The second is the logarithm of a ratio: the expected
/// information of a wake-up of the device to the expectation without history.
pub const OUTPUTS: usize = 2;

/// Meaning of the first output of a device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ModelObjective {
    /// Logarithm of the ratio of expected events to the expectation without history.
    Events,
    /// Log-odds that the teacher lets the device sense: behaviour cloning, Algorithm 2 as in the paper.
    Actions,
}

impl ModelObjective {
    /// All objectives.
    pub const ALL: [Self; 2] = [Self::Events, Self::Actions];

    /// Returns the name in model files and in the option `--objective`. Another name invalidates model files.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Events => "events",
            Self::Actions => "actions",
        }
    }
}

/// Shape of a model, independent of N.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ModelShape {
    /// Number Z of TTIs that a decision attends to, including its own. With 1 there is no attention over time.
    pub memory: usize,
    /// Width d of a token's embedding, a multiple of 4 · `heads`: the kernel processes the columns of a head four by
    /// four.
    pub width: usize,
    /// Number of heads in each attention layer.
    pub heads: usize,
    /// Whether devices attend to each other.
    pub attends_to_devices: bool,
    /// Meaning of the first output, fixed by the training.
    pub objective: ModelObjective,
}

impl ModelShape {
    /// Shape of the model that comes with the program (`../shipped.safetensors`), and default of an untrained model.
    /// The texts of the fields in `../settings.rs` repeat the sizes.
    pub const SHIPPED: Self = Self {
        memory: 1,
        width: 16,
        heads: 1,
        attends_to_devices: false,
        objective: ModelObjective::Events,
    };

    /// Shape of the second model that comes with the program (`../attention.safetensors`), with both attentions of the
    /// paper's Algorithm 2.
    pub const WITH_ATTENTION: Self = Self {
        memory: 8,
        width: 32,
        heads: 2,
        attends_to_devices: true,
        objective: ModelObjective::Events,
    };

    /// Returns whether each size is above 0 and within its limit, and the width is a multiple of 4 · `heads`.
    pub fn is_valid(&self) -> bool {
        let within = |value: usize, max: u64| value > 0 && value as u64 <= max;
        within(self.memory, MAX_MEMORY)
            && within(self.heads, MAX_HEADS)
            && within(self.width, MAX_WIDTH)
            && self.width.is_multiple_of(4 * self.heads)
    }

    /// Whether a device attends to earlier TTIs.
    pub const fn attends_to_past(&self) -> bool {
        self.memory > 1
    }

    /// Width of a head.
    pub const fn head_width(&self) -> usize {
        self.width / self.heads
    }

    /// Returns the names and sizes of all tensors. In the names, `time` and `space` are the attention layers, `mix` is
    /// a feed-forward layer and `head` the output layer, not a head of an attention. A model without attention has
    /// `time.mix` too. The training draws initial values by the order, and chooses their distribution by the names.
    pub fn tensors(&self) -> Vec<(&'static str, Vec<usize>)> {
        let (d, wide) = (self.width, EXPANSION * self.width);
        let mut tensors = vec![
            ("embed.weight", vec![tokens::FEATURE_COUNT, d]),
            ("embed.bias", vec![d]),
        ];
        if self.attends_to_past() {
            tensors.extend([
                ("time.norm", vec![d]),
                ("time.query", vec![d, d]),
                ("time.key", vec![d, d]),
                ("time.value", vec![d, d]),
                ("time.out", vec![d, d]),
                ("time.bias", vec![self.heads, self.memory]),
            ]);
        }
        tensors.extend([
            ("time.mix.norm", vec![d]),
            ("time.mix.in.weight", vec![d, wide]),
            ("time.mix.in.bias", vec![wide]),
            ("time.mix.out.weight", vec![wide, d]),
            ("time.mix.out.bias", vec![d]),
        ]);
        if self.attends_to_devices {
            tensors.extend([
                ("space.norm", vec![d]),
                ("space.query", vec![d, d]),
                ("space.key", vec![d, d]),
                ("space.value", vec![d, d]),
                ("space.out", vec![d, d]),
                ("space.mix.norm", vec![d]),
                ("space.mix.in.weight", vec![d, wide]),
                ("space.mix.in.bias", vec![wide]),
                ("space.mix.out.weight", vec![wide, d]),
                ("space.mix.out.bias", vec![d]),
            ]);
        }
        tensors.extend([
            ("head.norm", vec![d]),
            ("head.weight", vec![d, OUTPUTS]),
            ("head.bias", vec![OUTPUTS]),
            ("price.in.weight", vec![d + 1, PRICE_WIDTH]),
            ("price.in.bias", vec![PRICE_WIDTH]),
            ("price.out.weight", vec![PRICE_WIDTH, 1]),
            ("price.out.bias", vec![1]),
        ]);
        tensors
    }
}

#[cfg(test)]
mod tests;
