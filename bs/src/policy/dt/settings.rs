//! Settings of the policy `dt` (Sec. V-C): reads them with the model that they name, and refuses a shape that the model
//! does not have. The hash of a scenario covers the hash of the model and depends on the order of the fields and of the
//! calls in `visit`.

use std::path::PathBuf;
use std::sync::Arc;

use reveille_common::declare;
use reveille_common::declare::{
    Alternative, FieldReader, FieldSink, FieldValue, NOT_NEGATIVE, PROBABILITY, ScenarioError, Section, Visit, number,
    whole, word_or_file,
};
use reveille_common::scenario::Site;

use super::model::weights::ModelWeights;
use super::model::{MAX_HEADS, MAX_MEMORY, MAX_WIDTH, ModelObjective, ModelShape};
use crate::beliefs::ages;

/// Named sources of models, other than files. `from_fields` and `visit` repeat the names.
const MODELS: &[Alternative] = &[
    Alternative {
        name: "shipped",
        about: "The model shipped with the program, without attention.",
    },
    Alternative {
        name: "attention",
        about: "A shipped model with both attentions of the paper's Algorithm 2, over 8 TTIs and between devices.",
    },
    Alternative {
        name: "untrained",
        about: "An untrained model; with miss_cost = 0 it decides exactly as `age-index`.",
    },
];

// The texts repeat sizes of `ModelShape::SHIPPED` and `WITH_ATTENTION`. `price` has the default of `age-index`, which
// an untrained model must equal.
declare! {
    /// Settings of the policy `dt` (Sec. V-C, Algorithm 2).
    #[derive(Clone, Debug)]
    struct Fields in "policy.dt" {
        /// Source of the model; a file must be written by `reveille train dt`.
        model: Option<String> = word_or_file(MODELS, "shipped").source("Sec. V-C"),
        /// Price θ of a TTI in S1, in reaches, as under `age-index`: the energy target. With 0, every place in reach is
        /// covered in every TTI. It has no effect if a target return is set.
        price: f64 = number(NOT_NEGATIVE, 0.35),
        /// Target return: share of new events to detect in the TTI in which they start. The model predicts the price
        /// for it; with 0, `price` applies.
        target: f64 = number(PROBABILITY, 0.0).source("Sec. V-C"),
        /// Loss, as a share of Ψ, for a wake-up farther than d_max from the event, in the comparison of devices. A
        /// higher loss selects devices that are surer to sense the event but add less information.
        miss_cost: f64 = number(PROBABILITY, 0.16).formerly("in_vain"),
        /// TTIs Z that a decision attends to; 1 means no attention over time. With 0, the value of the model; training
        /// uses 1.
        memory: u64 = whole(0, MAX_MEMORY, 0).unit("TTIs").source("Sec. V-C"),
        /// Width of a device's embedding, a multiple of 4 times its heads. With 0, the width of the model; training
        /// uses 16.
        width: u64 = whole(0, MAX_WIDTH, 0).source("Sec. V-C"),
        /// Heads of each attention layer. With 0, the number in the model; training uses 1.
        heads: u64 = whole(0, MAX_HEADS, 0).source("Sec. V-C"),
    }
}

/// Size of the largest file that is read, bytes.
const MAX_FILE_BYTES: u64 = 64 << 20;

/// Source of a model.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ModelSource {
    /// The model that comes with the program.
    Shipped,
    /// The model with attention that comes with the program.
    Attention,
    /// An untrained model.
    Untrained,
    /// A file that `reveille train dt` wrote.
    File(PathBuf),
}

/// Settings of the `dt` policy, with the model that they name.
#[derive(Clone, Debug, PartialEq)]
pub struct DtSettings {
    /// Source of the model.
    pub model_source: ModelSource,
    /// The model.
    pub weights: Arc<ModelWeights>,
    /// Price θ of a TTI in S1, ≥ 0, used without a target.
    pub price: f64,
    /// Target share of new events detected in their first TTI, `[0, 1]`; 0 for no target.
    pub target: f64,
    /// Cost of a wake-up of a device beyond d_max of the event, a share of Ψ, `[0, 1]`.
    pub miss_cost: f64,
    /// Model shape that the scenario requests.
    pub requested_shape: RequestedShape,
}

/// Model shape that a scenario requests; 0 accepts the value of the model.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RequestedShape {
    /// TTIs Z that a decision attends to.
    pub memory: u64,
    /// Width of a device's embedding.
    pub width: u64,
    /// Heads of each attention.
    pub heads: u64,
}

impl RequestedShape {
    /// Returns the requested shape, with values of `shape` where nothing is requested.
    const fn with_defaults(self, shape: ModelShape) -> ModelShape {
        const fn or_default(requested: u64, default: usize) -> usize {
            if requested == 0 { default } else { requested as usize }
        }
        ModelShape {
            memory: or_default(self.memory, shape.memory),
            width: or_default(self.width, shape.width),
            heads: or_default(self.heads, shape.heads),
            ..shape
        }
    }

    /// Returns the first field that differs from `shape`, with the requested and the actual value.
    fn first_difference(self, shape: ModelShape) -> Option<(&'static str, u64, usize)> {
        let Self { memory, width, heads } = self;
        let fields = [
            ("memory", memory, shape.memory),
            ("width", width, shape.width),
            ("heads", heads, shape.heads),
        ];
        let differs = |(_, requested, actual): &(&str, u64, usize)| *requested != 0 && *requested != *actual as u64;
        fields.into_iter().find(differs)
    }
}

/// Returns `price`, or `None` if `target` asks the model for the price.
fn price_without_target(price: f64, target: f64) -> Option<f64> {
    (target <= 0.0).then_some(price)
}

fn included_model(bytes: &[u8]) -> ModelWeights {
    ModelWeights::read(bytes).expect("the model of this program")
}

impl DtSettings {
    /// Returns the price θ, or `None` if a target is set.
    pub fn fixed_price(&self) -> Option<f64> {
        price_without_target(self.price, self.target)
    }

    /// The declared fields of the section.
    pub const SECTION: &'static Section = Fields::SECTION;

    /// Reads the settings for a base station that knows `site`.
    ///
    /// # Errors
    /// A value is out of range, the model cannot be used, or the area has too many cells.
    pub fn from_fields(reader: &FieldReader<'_>, site: &Site<'_>) -> Result<Self, ScenarioError> {
        let fields = Fields::read(reader)?;
        ages::check_price("dt", price_without_target(fields.price, fields.target), reader, site)?;
        let requested_shape = RequestedShape {
            memory: fields.memory,
            width: fields.width,
            heads: fields.heads,
        };
        let (model_source, weights) = match fields.model.as_deref().unwrap_or("shipped") {
            "shipped" => (
                ModelSource::Shipped,
                included_model(include_bytes!("shipped.safetensors")),
            ),
            "attention" => (
                ModelSource::Attention,
                included_model(include_bytes!("attention.safetensors")),
            ),
            "untrained" => {
                let shape = requested_shape.with_defaults(ModelShape::SHIPPED);
                if !shape.is_valid() {
                    let allowed = format!("must be a multiple of 4 times the heads, {}", 4 * shape.heads);
                    return Err(reader.invalid_value("policy.dt.width", shape.width, allowed));
                }
                (ModelSource::Untrained, ModelWeights::untrained(shape))
            }
            file => {
                let field = "policy.dt.model";
                let path = reader.absolute_path(field, file)?;
                let refuse = |why: String| reader.file_error(field, path.clone(), why);
                let bytes = reader
                    .files()
                    .read(&path, MAX_FILE_BYTES)
                    .map_err(|error| refuse(error.to_string()))?;
                let weights = ModelWeights::read(&bytes).map_err(|error| refuse(error.to_string()))?;
                (ModelSource::File(path), weights)
            }
        };
        if let Some((name, requested, actual)) = requested_shape.first_difference(weights.shape()) {
            let attention = ModelShape::WITH_ATTENTION;
            let alternative = if requested_shape.first_difference(attention).is_none() {
                "choose policy.dt.model=attention".to_owned()
            } else {
                format!("train one: reveille train dt --set policy.dt.{name}={requested}")
            };
            let allowed = format!("the model has {actual}; omit the field, or {alternative}");
            return Err(reader.invalid_value(&format!("policy.dt.{name}"), requested, allowed));
        }
        let has_learned_price =
            model_source != ModelSource::Untrained && weights.shape().objective == ModelObjective::Events;
        if fields.target > 0.0 && !has_learned_price {
            reader.warn(format!(
                "policy.dt.target is {}, and the model has not learned its price: {}",
                fields.target,
                match weights.shape().objective {
                    ModelObjective::Events => "an untrained model uses 1",
                    ModelObjective::Actions => "a model that imitates actions has none",
                }
            ));
        }
        Ok(Self {
            model_source,
            weights: Arc::new(weights),
            price: fields.price,
            target: fields.target,
            miss_cost: fields.miss_cost,
            requested_shape,
        })
    }
}

impl Visit for DtSettings {
    fn visit(&self, sink: &mut dyn FieldSink) {
        let model = match &self.model_source {
            ModelSource::Shipped => "shipped".into(),
            ModelSource::Attention => "attention".into(),
            ModelSource::Untrained => "untrained".into(),
            ModelSource::File(path) => path.to_string_lossy(),
        };
        if let Some(field) = Fields::SECTION.field("model") {
            sink.field(Fields::SECTION, field, FieldValue::Path(&model));
            // Another model under the same path makes another scenario.
            sink.content(&self.weights.hash);
        }
        let fields = Fields {
            // Visited above, with the content of the model.
            model: None,
            price: self.price,
            target: self.target,
            miss_cost: self.miss_cost,
            memory: self.requested_shape.memory,
            width: self.requested_shape.width,
            heads: self.requested_shape.heads,
        };
        fields.visit(sink);
    }
}
