//! Settings of the `dt` policy (Sec. V-C).

use std::path::PathBuf;
use std::sync::Arc;

use reveille_common::declare;
use reveille_common::declare::{
    Alternative, NOT_NEGATIVE, PROBABILITY, Reader, ScenarioError, Section, Sink, Value, number, source,
};
use reveille_common::scenario::{PolicySettings, Site};

use super::model::weights::Weights;
use crate::beliefs::ages;
use crate::beliefs::raster::MOST_CELLS;

/// Where models come from, but for files.
const MODELS: &[Alternative] = &[Alternative {
    name: "shipped",
    about: "The model that comes with the program.",
}];

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
    }
}

/// Bytes of the largest file that is read.
const LARGEST: u64 = 64 << 20;

/// Where a model comes from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ModelSource {
    /// The program.
    Shipped,
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
        let cells = ages::cells(site.area, site.sensing.d_max);
        if cells > MOST_CELLS {
            let allowed = format!(
                "is so small against the area that dt would keep the ages of {cells:.0} cells, more than {MOST_CELLS}"
            );
            return Err(reader.refuse("sensing.d_max", site.sensing.d_max, allowed));
        }
        let fields = Fields::read(reader)?;
        let (source, weights) = match fields.model.as_deref().unwrap_or("shipped") {
            "shipped" => (ModelSource::Shipped, shipped()),
            file => {
                let field = "policy.dt.model";
                let path = reader.file(field, file)?;
                let refuse = |why: String| reader.data(field, path.clone(), why);
                let bytes = reader
                    .files()
                    .read(&path, LARGEST)
                    .map_err(|error| refuse(format!("cannot be read: {error}")))?;
                let weights = Weights::read(&bytes).map_err(|error| refuse(error.to_string()))?;
                (ModelSource::File(path), weights)
            }
        };
        Ok(Self {
            source,
            weights: Arc::new(weights),
            price: fields.price,
            target: fields.target,
        })
    }
}

impl PolicySettings for DtSettings {
    fn visit(&self, sink: &mut dyn Sink) {
        let model = match &self.source {
            ModelSource::Shipped => "shipped".into(),
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
        };
        fields.visit(sink);
    }
}
