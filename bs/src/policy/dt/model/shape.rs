//! The shape of a model.

use super::super::senses;

/// The most TTIs that a model may look back.
pub const LONGEST_MEMORY: u64 = 64;
/// The widest that a model may be.
pub const WIDEST: u64 = 256;
/// The most heads that a model may have.
pub const MOST_HEADS: u64 = 16;
/// Width of the layers between attentions, in widths of the model.
pub const EXPANSION: usize = 2;
/// Width of the layer that turns a target into a price.
pub const PRICE_WIDTH: usize = 16;
/// Outputs per device: what its [`Objective`] says of sensing, and the logarithm of how many times as much information
/// its wake-up is to bring as is expected without history.
pub const HEADS: usize = 2;

/// What the first output of a device says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Objective {
    /// The logarithm of how many times as many events it is to find.
    Events,
    /// The log-odds that a teacher would have it sense: behaviour cloning, Algorithm 2 as the paper has it.
    Actions,
}

impl Objective {
    /// All of them.
    pub const ALL: [Self; 2] = [Self::Events, Self::Actions];

    /// Its name in files and options.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Events => "events",
            Self::Actions => "actions",
        }
    }
}

/// The shape of a model; it has no N.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    /// TTIs Z that a decision attends to, the one that it is for included.
    pub memory: usize,
    /// Width d of a token's embedding, a multiple of `heads` and of 4.
    pub width: usize,
    /// Heads of each attention.
    pub heads: usize,
    /// Whether devices attend to each other.
    pub has_space: bool,
    /// What it has learned to say.
    pub objective: Objective,
}

impl Shape {
    /// The shape of the model that comes with the program.
    pub const USUAL: Self = Self {
        memory: 8,
        width: 32,
        heads: 2,
        has_space: true,
        objective: Objective::Events,
    };

    /// Whether a model may have this shape.
    pub fn is_sound(&self) -> bool {
        let within = |value: usize, most: u64| value > 0 && value as u64 <= most;
        within(self.memory, LONGEST_MEMORY)
            && within(self.heads, MOST_HEADS)
            && within(self.width, WIDEST)
            && self.width.is_multiple_of(4 * self.heads)
    }

    /// Width of a head.
    pub const fn head_width(&self) -> usize {
        self.width / self.heads
    }

    /// The names and sizes of all tensors, in their order.
    pub fn tensors(&self) -> Vec<(&'static str, Vec<usize>)> {
        let (d, wide) = (self.width, EXPANSION * self.width);
        let mut tensors = vec![
            ("embed.weight", vec![senses::COUNT, d]),
            ("embed.bias", vec![d]),
            ("time.norm", vec![d]),
            ("time.query", vec![d, d]),
            ("time.key", vec![d, d]),
            ("time.value", vec![d, d]),
            ("time.out", vec![d, d]),
            ("time.bias", vec![self.heads, self.memory]),
            ("time.mix.norm", vec![d]),
            ("time.mix.in.weight", vec![d, wide]),
            ("time.mix.in.bias", vec![wide]),
            ("time.mix.out.weight", vec![wide, d]),
            ("time.mix.out.bias", vec![d]),
        ];
        if self.has_space {
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
            ("head.weight", vec![d, HEADS]),
            ("head.bias", vec![HEADS]),
            ("price.in.weight", vec![d + 1, PRICE_WIDTH]),
            ("price.in.bias", vec![PRICE_WIDTH]),
            ("price.out.weight", vec![PRICE_WIDTH, 1]),
            ("price.out.bias", vec![1]),
        ]);
        tensors
    }
}
