//! Checkpoints of a training of `dt`, from which [`super::train`] resumes with an identical result: a safetensors file
//! with the weights, the optimiser's state, the best model and the counters. The sum of losses since the last
//! evaluation is not stored: it only serves for display.
//!
//! No random stream is stored: each step draws from a separate stream, made from the seed and the number of the step. A
//! checkpoint can be resumed only with the same [`FORMAT_VERSION`], configuration and model information; there is no
//! conversion of older files.

use std::collections::BTreeMap;

use candle_core::{Device, Tensor};
use reveille_bs::policy::dt::model::weights::encode_metadata;
use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors};

use super::{DtTrainingConfig, TensorByName, TrainerState, TransformerError};

/// The only key of the metadata. Its text has a line with [`FORMAT_VERSION`], a line with the counters, and the
/// [`identity`] of the training.
const CHECKPOINT_KEY: &str = "reveille.dt-training";
/// The version of the format; change it with any change of tensors, counters or identity. Version 1 was not in the
/// text.
const FORMAT_VERSION: &str = "2";
/// The prefixes of the tensors: weights, running means of their gradients, and running means of the squared gradients.
/// Writing and reading list the tensors of a weight in this order.
const TENSOR_PREFIXES: [&str; 3] = ["weight", "mean", "square"];
/// The name of a tensor of bytes that holds the file of the best model.
const BEST_MODEL: &str = "best";

/// A tensor of the file.
struct NamedTensor {
    name: String,
    dtype: Dtype,
    shape: Vec<usize>,
    data: Vec<u8>,
}

impl TrainerState {
    /// Returns the bytes of a checkpoint.
    ///
    /// # Errors
    /// If the framework or the format fails.
    pub(super) fn to_checkpoint(
        &self,
        config: &DtTrainingConfig,
        model_info: &BTreeMap<String, String>,
    ) -> Result<Vec<u8>, TransformerError> {
        let mut tensors: Vec<NamedTensor> = Vec::new();
        for (name, tensor_shape) in self.net.shape().tensors() {
            let tensors_of_weight = [
                self.net.vars()[name].as_tensor(),
                &self.optimiser.mean_gradients[name],
                &self.optimiser.mean_squares[name],
            ];
            for (prefix, tensor) in TENSOR_PREFIXES.iter().zip(tensors_of_weight) {
                let numbers: Vec<f32> = tensor.flatten_all()?.to_vec1()?;
                tensors.push(NamedTensor {
                    name: format!("{prefix}.{name}"),
                    dtype: Dtype::F32,
                    shape: tensor_shape.clone(),
                    data: numbers.into_iter().flat_map(f32::to_le_bytes).collect(),
                });
            }
        }
        if let Some(best_file) = &self.best_file {
            tensors.push(NamedTensor {
                name: BEST_MODEL.to_owned(),
                dtype: Dtype::U8,
                shape: vec![best_file.len()],
                data: best_file.clone(),
            });
        }
        let mut views = Vec::new();
        for tensor in &tensors {
            let view = TensorView::new(tensor.dtype, tensor.shape.clone(), &tensor.data)?;
            views.push((&tensor.name, view));
        }
        let counters = [
            self.optimiser.steps,
            self.evaluations_since_best,
            // As bits, so that it is exact and fits with the integers.
            self.best_loss.to_bits(),
        ];
        let counters = counters.map(|counter| counter.to_string()).join(" ");
        let text = format!("{FORMAT_VERSION}\n{counters}\n{}", identity(config, model_info));
        let metadata = [(CHECKPOINT_KEY.to_owned(), text)].into_iter().collect();
        Ok(safetensors::serialize(views, Some(metadata))?)
    }

    /// Restores the state from the bytes of a checkpoint of this training.
    ///
    /// # Errors
    /// If they are damaged, have another format version, or belong to another training.
    pub(super) fn from_checkpoint(
        bytes: &[u8],
        config: &DtTrainingConfig,
        model_info: &BTreeMap<String, String>,
    ) -> Result<Self, TransformerError> {
        let refuse = |cause: &str| TransformerError::Checkpoint(cause.to_owned());
        let damaged = || refuse("this is not the checkpoint of a training of dt, or it is damaged");
        // Both, because `SafeTensors` checks the tensors but does not give access to the metadata.
        let (_, header) = SafeTensors::read_metadata(bytes).map_err(|_| damaged())?;
        let file = SafeTensors::deserialize(bytes).map_err(|_| damaged())?;
        let metadata = header.metadata().as_ref();
        let text = metadata
            .and_then(|pairs| pairs.get(CHECKPOINT_KEY))
            .ok_or_else(damaged)?;
        let Some((FORMAT_VERSION, after_version)) = text.split_once('\n') else {
            return Err(refuse("this checkpoint has the format of another version of Reveille"));
        };
        let (counters, saved_identity) = after_version.split_once('\n').ok_or_else(damaged)?;
        if saved_identity != identity(config, model_info) {
            return Err(refuse(
                "this is the checkpoint of another training, from other data or with other options",
            ));
        }
        let counters: Result<Vec<u64>, _> = counters.split(' ').map(str::parse).collect();
        let &[steps, evaluations_since_best, best_loss] = &counters.map_err(|_| damaged())?[..] else {
            return Err(damaged());
        };
        let mut state = Self::new(config)?;
        let mut tensors_by_prefix = [TensorByName::new(), TensorByName::new(), TensorByName::new()];
        for (name, tensor_shape) in config.shape.tensors() {
            for (prefix, tensors) in TENSOR_PREFIXES.iter().zip(&mut tensors_by_prefix) {
                let view = file.tensor(&format!("{prefix}.{name}")).map_err(|_| damaged())?;
                if view.dtype() != Dtype::F32 || view.shape() != tensor_shape {
                    return Err(damaged());
                }
                // The file was checked to have 4 bytes for each F32, so the remainder is empty.
                let (words, _) = view.data().as_chunks::<4>();
                let numbers: Vec<f32> = words.iter().map(|word| f32::from_le_bytes(*word)).collect();
                tensors.insert(name, Tensor::from_vec(numbers, tensor_shape.clone(), &Device::Cpu)?);
            }
        }
        let [weights, mean_gradients, mean_squares] = tensors_by_prefix;
        for (name, var) in state.net.vars() {
            var.set(&weights[name])?;
        }
        state.optimiser.steps = steps;
        state.optimiser.mean_gradients = mean_gradients;
        state.optimiser.mean_squares = mean_squares;
        // Absent before the first evaluation.
        state.best_file = file.tensor(BEST_MODEL).ok().map(|best| best.data().to_vec());
        state.best_loss = f64::from_bits(best_loss);
        state.evaluations_since_best = evaluations_since_best;
        Ok(state)
    }
}

/// Returns the parameters that a checkpoint must share with the training that resumes from it.
fn identity(config: &DtTrainingConfig, model_info: &BTreeMap<String, String>) -> String {
    format!("{}\n{}", config.to_json(), encode_metadata(config.shape, model_info))
}
