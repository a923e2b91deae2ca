//! The weights of a model, and the file that holds them: read here for `policy.dt.model`, written by `reveille train
//! dt` (`lab/src/transformer/`).
//!
//! A file has the safetensors format: named tensors of 32-bit floats, with a description of the training as metadata.
//! [`ModelShape::tensors`] lists the names and sizes of the tensors; [`ModelWeights`] and `lab/src/transformer/net.rs`
//! repeat the names. RELEASING.md lists the version of the format.

use std::collections::BTreeMap;

use safetensors::{Dtype, SafeTensors};
use sha2::{Digest, Sha256};

use super::super::tokens::FEATURES;
use super::kernel::Linear;
use super::{EXPANSION, MAX_HEADS, MAX_MEMORY, MAX_WIDTH, ModelObjective, ModelShape, PRICE_WIDTH};

/// Version of the file format. Raise it when the meaning of features or tensors changes, and train
/// `../shipped.safetensors` and `../attention.safetensors` again: files of other versions are refused.
pub const FORMAT_VERSION: &str = "1";

/// Only key of the metadata. Its value is a JSON object of strings, sorted by key, so that the contents determine the
/// bytes of a file.
pub const METADATA_KEY: &str = "reveille.dt";

/// Keys of that object, in addition to the description of the training.
mod metadata_keys {
    /// See [`super::FORMAT_VERSION`].
    pub(super) const VERSION: &str = "version";
    /// The features of a token, joined by commas.
    pub(super) const FEATURES: &str = "features";
    /// Z, d, heads, and whether devices attend to each other, joined by commas.
    pub(super) const SHAPE: &str = "shape";
    /// Name of the [`super::ModelObjective`].
    pub(super) const OBJECTIVE: &str = "objective";
}

/// Reason why a file is not a model.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum ModelError {
    /// The file has another format or is truncated.
    #[error("is not a readable safetensors file ({0}); train one: reveille train dt")]
    Format(String),
    /// The file was written by another program or version.
    #[error(
        "is not a model of this program: its metadata has {key} = {found}, not {wanted}; train one: reveille train dt"
    )]
    Foreign {
        /// The key of the metadata.
        key: &'static str,
        /// The value found.
        found: String,
        /// The value expected.
        wanted: String,
    },
    /// A tensor is missing or unexpected, or has another shape or type.
    #[error(
        "its tensor {name} is {found}, not {wanted}; the file is damaged or from another version; train one: \
             reveille train dt"
    )]
    Tensor {
        /// Name of the tensor.
        name: String,
        /// The shape or type found.
        found: String,
        /// The shape or type expected.
        wanted: String,
    },
    /// A weight is NaN or infinite.
    #[error("its tensor {0} holds a value that is not finite: the training has failed")]
    NotFinite(String),
}

/// Feed-forward layer after the embedding or an attention: `mix` in the names of tensors. `norm` is the scale of the
/// norm of its input.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct FeedForward {
    pub(super) norm: Vec<f32>,
    pub(super) inner: Linear,
    pub(super) outer: Linear,
}

/// Attention layer: the scale of the norm of its input, queries, keys and values.
#[derive(Clone, Debug, PartialEq)]
pub struct AttentionLayer {
    pub(super) norm: Vec<f32>,
    pub(super) query: Linear,
    pub(super) key: Linear,
    pub(super) value: Linear,
    pub(super) out: Linear,
}

/// Weights of a model.
#[derive(Clone, Debug, PartialEq)]
pub struct ModelWeights {
    pub(super) shape: ModelShape,
    pub(super) embed: Linear,
    /// Attention of a device to its last Z TTIs, if [`ModelShape::attends_to_past`], with the offset of the score by
    /// head and lag, `[heads, Z]`.
    pub(super) time: Option<(AttentionLayer, Vec<f32>)>,
    /// The layer after the temporal attention, or after the embedding without one.
    pub(super) feed_forward: FeedForward,
    /// Attention of devices to each other, if [`ModelShape::attends_to_devices`], with the layer after it.
    pub(super) space: Option<(AttentionLayer, FeedForward)>,
    pub(super) output_norm: Vec<f32>,
    pub(super) output: Linear,
    /// The two layers from the mean over devices and the target to the logarithm of the price.
    pub(super) price_inner: Linear,
    pub(super) price_outer: Linear,
    /// Metadata of the file.
    pub metadata: BTreeMap<String, String>,
    /// SHA-256 of the file; of the metadata for an untrained model. The hash of a scenario covers it.
    pub hash: [u8; 32],
}

type Tensors = BTreeMap<&'static str, Vec<f32>>;

impl ModelWeights {
    /// Reads the weights from the bytes of a file.
    ///
    /// # Errors
    /// The file is not a model of this program, is damaged, or holds values that are not finite.
    pub fn read(bytes: &[u8]) -> Result<Self, ModelError> {
        let format = |error: safetensors::SafeTensorError| ModelError::Format(error.to_string());
        let (_, header) = SafeTensors::read_metadata(bytes).map_err(format)?;
        let file = SafeTensors::deserialize(bytes).map_err(format)?;
        let text = header.metadata().as_ref().and_then(|pairs| pairs.get(METADATA_KEY));
        // Metadata that is missing or unreadable becomes empty; `decode_shape` then reports the missing version.
        let metadata: BTreeMap<String, String> = text
            .and_then(|text| serde_json::from_str(text).ok())
            .unwrap_or_default();
        let shape = decode_shape(&metadata)?;
        let wanted = shape.tensors();
        if let Some(name) = file
            .names()
            .iter()
            .find(|name| wanted.iter().all(|(tensor, _)| tensor != *name))
        {
            return Err(ModelError::Tensor {
                name: (*name).to_owned(),
                found: "there".to_owned(),
                wanted: "part of this shape".to_owned(),
            });
        }
        let mut tensors = Tensors::new();
        for (name, size) in wanted {
            tensors.insert(name, read_tensor(&file, name, &size)?);
        }
        Ok(Self::assemble(shape, tensors, metadata, Sha256::digest(bytes).into()))
    }

    /// Creates an untrained model of `shape`. All weights are 0, so it expects events by age and α alone.
    pub fn untrained(shape: ModelShape) -> Self {
        let zeros = |(name, size): (&'static str, Vec<usize>)| (name, vec![0.0; size.iter().product()]);
        let tensors = shape.tensors().into_iter().map(zeros).collect();
        // An untrained model has no file, so its hash covers the metadata, which names the shape.
        let text = encode_metadata(shape, &BTreeMap::new());
        Self::assemble(shape, tensors, BTreeMap::new(), Sha256::digest(text).into())
    }

    /// Assembles the layers from `tensors`, whose names and sizes [`ModelShape::tensors`] lists.
    fn assemble(shape: ModelShape, mut tensors: Tensors, metadata: BTreeMap<String, String>, hash: [u8; 32]) -> Self {
        let (d, wide) = (shape.width, EXPANSION * shape.width);
        let take = |tensors: &mut Tensors, name: &str| tensors.remove(name).expect("all tensors were read");
        let attention = |tensors: &mut Tensors, layer: &str| {
            let mut square = |part: &str| Linear::without_bias(d, d, &take(tensors, &format!("{layer}.{part}")));
            AttentionLayer {
                query: square("query"),
                key: square("key"),
                value: square("value"),
                out: square("out"),
                norm: take(tensors, &format!("{layer}.norm")),
            }
        };
        let feed_forward = |tensors: &mut Tensors, layer: &str| {
            let mut part = |part: &str| take(tensors, &format!("{layer}.mix.{part}"));
            FeedForward {
                norm: part("norm"),
                inner: Linear::new(d, &part("in.weight"), &part("in.bias")),
                outer: Linear::new(wide, &part("out.weight"), &part("out.bias")),
            }
        };
        let linear = |tensors: &mut Tensors, inputs: usize, layer: &str| {
            let (weight, bias) = (format!("{layer}.weight"), format!("{layer}.bias"));
            Linear::new(inputs, &take(tensors, &weight), &take(tensors, &bias))
        };
        Self {
            embed: linear(&mut tensors, FEATURES.len(), "embed"),
            time: shape
                .attends_to_past()
                .then(|| (attention(&mut tensors, "time"), take(&mut tensors, "time.bias"))),
            feed_forward: feed_forward(&mut tensors, "time"),
            space: shape
                .attends_to_devices
                .then(|| (attention(&mut tensors, "space"), feed_forward(&mut tensors, "space"))),
            output_norm: take(&mut tensors, "head.norm"),
            output: linear(&mut tensors, d, "head"),
            price_inner: linear(&mut tensors, d + 1, "price.in"),
            price_outer: linear(&mut tensors, PRICE_WIDTH, "price.out"),
            shape,
            metadata,
            hash,
        }
    }

    /// The shape of the model.
    pub const fn shape(&self) -> ModelShape {
        self.shape
    }
}

/// Returns the value of [`METADATA_KEY`] for a model of this shape, where `training` describes the training.
pub fn encode_metadata(shape: ModelShape, training: &BTreeMap<String, String>) -> String {
    let ModelShape {
        memory,
        width,
        heads,
        attends_to_devices,
        objective,
    } = shape;
    let entries = [
        (metadata_keys::VERSION, FORMAT_VERSION.to_owned()),
        (metadata_keys::FEATURES, FEATURES.join(",")),
        (
            metadata_keys::SHAPE,
            format!("{memory},{width},{heads},{}", u8::from(attends_to_devices)),
        ),
        (metadata_keys::OBJECTIVE, objective.name().to_owned()),
    ];
    let entries = entries.map(|(key, value)| (key.to_owned(), value));
    // These entries last, so that no key of `training` replaces them.
    let metadata: BTreeMap<String, String> = training.clone().into_iter().chain(entries).collect();
    serde_json::to_string(&metadata).expect("texts can be written")
}

fn decode_shape(metadata: &BTreeMap<String, String>) -> Result<ModelShape, ModelError> {
    let found = |key: &'static str| metadata.get(key).map_or("nothing", String::as_str);
    // Weights of the embedding belong to features by position, so the list must be the same.
    for (key, wanted) in [
        (metadata_keys::VERSION, FORMAT_VERSION.to_owned()),
        (metadata_keys::FEATURES, FEATURES.join(",")),
    ] {
        if found(key) != wanted {
            return Err(ModelError::Foreign {
                key,
                found: found(key).to_owned(),
                wanted,
            });
        }
    }
    let is_found = |objective: &ModelObjective| objective.name() == found(metadata_keys::OBJECTIVE);
    let Some(objective) = ModelObjective::ALL.into_iter().find(is_found) else {
        return Err(ModelError::Foreign {
            key: metadata_keys::OBJECTIVE,
            found: found(metadata_keys::OBJECTIVE).to_owned(),
            wanted: ModelObjective::ALL.map(ModelObjective::name).join(" or "),
        });
    };
    let foreign = || ModelError::Foreign {
        key: metadata_keys::SHAPE,
        found: found(metadata_keys::SHAPE).to_owned(),
        wanted: format!(
            "Z from 1 to {MAX_MEMORY}, d up to {MAX_WIDTH} and a multiple of 4 times the heads, up to {MAX_HEADS} \
             heads, and 0 or 1"
        ),
    };
    let numbers: Vec<usize> = found(metadata_keys::SHAPE)
        .split(',')
        .filter_map(|number| number.parse().ok())
        .collect();
    let &[memory, width, heads, attends_to_devices @ 0..=1] = &numbers[..] else {
        return Err(foreign());
    };
    let shape = ModelShape {
        memory,
        width,
        heads,
        attends_to_devices: attends_to_devices == 1,
        objective,
    };
    if shape.is_valid() { Ok(shape) } else { Err(foreign()) }
}

fn read_tensor(file: &SafeTensors<'_>, name: &str, size: &[usize]) -> Result<Vec<f32>, ModelError> {
    let wrong = |found: String| ModelError::Tensor {
        name: name.to_owned(),
        found,
        wanted: format!("F32 {size:?}"),
    };
    let view = file.tensor(name).map_err(|_| wrong("missing".to_owned()))?;
    if view.dtype() != Dtype::F32 || view.shape() != size {
        return Err(wrong(format!("{:?} {:?}", view.dtype(), view.shape())));
    }
    // The format is little-endian on every machine.
    let values: Vec<f32> = view
        .data()
        .as_chunks::<4>()
        .0
        .iter()
        .map(|bytes| f32::from_le_bytes(*bytes))
        .collect();
    if values.iter().all(|value| value.is_finite()) {
        Ok(values)
    } else {
        Err(ModelError::NotFinite(name.to_owned()))
    }
}
