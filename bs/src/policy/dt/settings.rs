//! Settings of the `dt` policy (Sec. V-C).

use std::path::PathBuf;
use std::sync::Arc;

use reveille_common::declare;
use reveille_common::declare::{
    Alternative, NOT_NEGATIVE, PROBABILITY, Reader, ScenarioError, Section, Sink, Value, number, source, whole,
};
use reveille_common::scenario::{PolicySettings, Site};

use super::model::shape::{LONGEST_MEMORY, MOST_HEADS, Objective, Shape, WIDEST};
use super::model::weights::Weights;
use crate::beliefs::ages;

/// Where models come from, but for files.
const MODELS: &[Alternative] = &[
    Alternative {
        name: "shipped",
        about: "The model that comes with the program.",
    },
    Alternative {
        name: "untrained",
        about: "One that has learned nothing; with in_vain = 0 it is age-index, bit by bit.",
    },
];

declare! {
    /// Settings of the policy `dt` (Sec. V-C, Algorithm 2).
    #[derive(Clone, Debug)]
    struct Fields in "policy.dt" {
        /// Where the model comes from; a file is one that `reveille train dt` wrote.
        model: Option<String> = source(MODELS, "shipped").source("Sec. V-C"),
        /// Price θ of a TTI in S1, in reaches, as under `age-index`: the energy target. With 0 every place in reach is
        /// looked at in every TTI. It is not asked for where a target return is set.
        price: f64 = number(NOT_NEGATIVE, 0.35),
        /// Target return: the share of new events that is to be found in the TTI in which they start; the model names
        /// the price for it. With 0 the price above is taken.
        target: f64 = number(PROBABILITY, 0.0).source("Sec. V-C"),
        /// What waking a device in vain, farther than d_max from the event, counts as a loss of when devices are
        /// compared, as a share of Ψ. The higher, the surer are those that are woken, and the less they bring.
        in_vain: f64 = number(PROBABILITY, 0.16),
        /// TTIs Z that a decision attends to. With 0 as many as the model does; a training takes 8.
        memory: u64 = whole(0, LONGEST_MEMORY, 0).unit("TTIs").source("Sec. V-C"),
        /// Width of a device's embedding, a multiple of 4 times its heads. With 0 that of the model; a training
        /// takes 32.
        width: u64 = whole(0, WIDEST, 0).source("Sec. V-C"),
        /// Heads of each attention. With 0 those of the model; a training takes 2.
        heads: u64 = whole(0, MOST_HEADS, 0).source("Sec. V-C"),
    }
}

/// Bytes of the largest file that is read.
const LARGEST: u64 = 64 << 20;

/// Where a model comes from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ModelSource {
    /// The program.
    Shipped,
    /// None: it has learned nothing.
    Untrained,
    /// A file that `reveille train dt` wrote.
    File(PathBuf),
}

/// Settings of the `dt` policy.
#[derive(Clone, Debug, PartialEq)]
pub struct DtSettings {
    /// Where the model comes from.
    pub source: ModelSource,
    /// The model.
    pub weights: Arc<Weights>,
    /// The price θ of a TTI in S1, ≥ 0, where no target is set.
    pub price: f64,
    /// The share of new events to be found in their first TTI, `[0, 1]`; 0 for none.
    pub target: f64,
    /// What a wake-up in vain costs, a share of Ψ, `[0, 1]`.
    pub in_vain: f64,
    /// What the scenario asks of the model.
    pub asked: AskedShape,
}

/// The shape that a scenario asks of a model; 0 leaves it to the model.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct AskedShape {
    /// TTIs Z that a decision attends to.
    pub memory: u64,
    /// Width of a device's embedding.
    pub width: u64,
    /// Heads of each attention.
    pub heads: u64,
}

impl AskedShape {
    /// What is asked for, and of the rest what `shape` has.
    const fn or(self, shape: Shape) -> Shape {
        const fn or(asked: u64, other: usize) -> usize {
            if asked == 0 { other } else { asked as usize }
        }
        Shape {
            memory: or(self.memory, shape.memory),
            width: or(self.width, shape.width),
            heads: or(self.heads, shape.heads),
            ..shape
        }
    }

    /// The field that asks for something else than `shape` has, what it asks for, and what there is.
    fn other_than(self, shape: Shape) -> Option<(&'static str, u64, usize)> {
        let Self { memory, width, heads } = self;
        let fields = [
            ("memory", memory, shape.memory),
            ("width", width, shape.width),
            ("heads", heads, shape.heads),
        ];
        let differs = |(_, asked, has): &(&str, u64, usize)| *asked != 0 && *asked != *has as u64;
        fields.into_iter().find(differs)
    }
}

/// The model that comes with the program.
fn shipped() -> Weights {
    Weights::read(include_bytes!("shipped.safetensors")).expect("the model of this program")
}

impl DtSettings {
    /// The price θ, if no target stands in its place.
    pub fn fixed_price(&self) -> Option<f64> {
        (self.target <= 0.0).then_some(self.price)
    }

    /// Its fields as they are declared.
    pub const SECTION: &'static Section = Fields::SECTION;

    /// The settings that `reader` has, for a base station that knows `site`.
    ///
    /// # Errors
    /// A value that may not be, a model that cannot be used, or an area of too many cells.
    pub fn settle(reader: &Reader<'_>, site: &Site<'_>) -> Result<Self, ScenarioError> {
        let fields = Fields::read(reader)?;
        let price = (fields.target <= 0.0).then_some(fields.price);
        ages::check("dt", price, reader, site)?;
        let asked = AskedShape {
            memory: fields.memory,
            width: fields.width,
            heads: fields.heads,
        };
        let (source, weights) = match fields.model.as_deref().unwrap_or("shipped") {
            "shipped" => (ModelSource::Shipped, shipped()),
            "untrained" => {
                let shape = asked.or(Shape::USUAL);
                if !shape.is_sound() {
                    let allowed = format!("must be a multiple of 4 times the heads, {}", 4 * shape.heads);
                    return Err(reader.refuse("policy.dt.width", shape.width, allowed));
                }
                (ModelSource::Untrained, Weights::untrained(shape))
            }
            file => {
                let field = "policy.dt.model";
                let path = reader.file(field, file)?;
                let refuse = |why: String| reader.data(field, path.clone(), why);
                let bytes = reader
                    .files()
                    .read(&path, LARGEST)
                    .map_err(|error| refuse(error.to_string()))?;
                let weights = Weights::read(&bytes).map_err(|error| refuse(error.to_string()))?;
                (ModelSource::File(path), weights)
            }
        };
        if let Some((name, asked, has)) = asked.other_than(weights.shape()) {
            let allowed = format!(
                "is not what the model has, {has}; train one: reveille train dt --set policy.dt.{name}={asked}"
            );
            return Err(reader.refuse(&format!("policy.dt.{name}"), asked, allowed));
        }
        let knows_prices = source != ModelSource::Untrained && weights.shape().objective == Objective::Events;
        if fields.target > 0.0 && !knows_prices {
            reader.warn(format!(
                "policy.dt.target is {}, and the model has not learned what price goes with it: {}",
                fields.target,
                match weights.shape().objective {
                    Objective::Events => "an untrained one takes 1",
                    Objective::Actions => "one that imitates actions has none",
                }
            ));
        }
        Ok(Self {
            source,
            weights: Arc::new(weights),
            price: fields.price,
            target: fields.target,
            in_vain: fields.in_vain,
            asked,
        })
    }
}

impl PolicySettings for DtSettings {
    fn visit(&self, sink: &mut dyn Sink) {
        let model = match &self.source {
            ModelSource::Shipped => "shipped".into(),
            ModelSource::Untrained => "untrained".into(),
            ModelSource::File(path) => path.to_string_lossy(),
        };
        if let Some(field) = Fields::SECTION.field("model") {
            sink.field(Fields::SECTION, field, Value::Path(&model));
            sink.content(&self.weights.hash);
        }
        let fields = Fields {
            model: None,
            price: self.price,
            target: self.target,
            in_vain: self.in_vain,
            memory: self.asked.memory,
            width: self.asked.width,
            heads: self.asked.heads,
        };
        fields.visit(sink);
    }
}
