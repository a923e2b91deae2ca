//! Checkpoints of a training, from which it resumes with an identical result: a safetensors file with the weights, the
//! optimiser's state, the best model and the counters.

use std::collections::BTreeMap;

use candle_core::{Device, Tensor};
use reveille_bs::policy::dt::model::weights::encode_metadata;
use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors};

use super::{ByWeight, DtTrainingConfig, TrainerState, TransformerError};

/// The only key of the metadata.
const KEY: &str = "reveille.dt-training";
/// The prefixes of the tensors: weights, running means of their gradients, and running means of the squared gradients.
const TENSOR_PREFIXES: [&str; 3] = ["weight", "mean", "square"];
/// The name of the best model's file.
const BEST: &str = "best";

impl TrainerState {
    pub(super) fn to_checkpoint(
        &self,
        training: &DtTrainingConfig,
        about: &BTreeMap<String, String>,
    ) -> Result<Vec<u8>, TransformerError> {
        let mut values: Vec<(String, Dtype, Vec<usize>, Vec<u8>)> = Vec::new();
        for (name, size) in self.net.shape().tensors() {
            let tensors_of_weight = [
                self.net.vars()[name].as_tensor(),
                &self.optimiser.means[name],
                &self.optimiser.squares[name],
            ];
            for (prefix, tensor) in TENSOR_PREFIXES.iter().zip(tensors_of_weight) {
                let numbers: Vec<f32> = tensor.flatten_all()?.to_vec1()?;
                let bytes = numbers.into_iter().flat_map(f32::to_le_bytes).collect();
                values.push((format!("{prefix}.{name}"), Dtype::F32, size.clone(), bytes));
            }
        }
        if let Some(best) = &self.best {
            values.push((BEST.to_owned(), Dtype::U8, vec![best.len()], best.clone()));
        }
        let mut tensors = Vec::new();
        for (name, dtype, size, bytes) in &values {
            tensors.push((name, TensorView::new(*dtype, size.clone(), bytes)?));
        }
        let counts = [
            self.optimiser.steps,
            self.evaluations_since_best,
            // As bits, because it is infinite before the first evaluation.
            self.best_loss.to_bits(),
        ];
        let text = format!(
            "{}\n{}",
            counts.map(|count| count.to_string()).join(" "),
            identity(training, about)
        );
        let metadata = [(KEY.to_owned(), text)].into_iter().collect();
        Ok(safetensors::serialize(tensors, Some(metadata))?)
    }

    /// Restores the state from the bytes of a checkpoint of this training.
    ///
    /// # Errors
    /// If they are damaged, or belong to another training.
    pub(super) fn from_checkpoint(
        bytes: &[u8],
        training: &DtTrainingConfig,
        about: &BTreeMap<String, String>,
    ) -> Result<Self, TransformerError> {
        let damaged = || TransformerError::Checkpoint("is not a checkpoint, or is damaged".to_owned());
        let (_, header) = SafeTensors::read_metadata(bytes).map_err(|_| damaged())?;
        let file = SafeTensors::deserialize(bytes).map_err(|_| damaged())?;
        let text = header.metadata().as_ref().and_then(|pairs| pairs.get(KEY));
        let (counts, saved_identity) = text.and_then(|text| text.split_once('\n')).ok_or_else(damaged)?;
        if saved_identity != identity(training, about) {
            return Err(TransformerError::Checkpoint(
                "is the checkpoint of another training, from other data or with other options".to_owned(),
            ));
        }
        let counts: Vec<u64> = counts.split(' ').filter_map(|count| count.parse().ok()).collect();
        // Unreadable text is dropped above, so damage changes the number of counts.
        let &[steps, evaluations_since_best, best_loss] = &counts[..] else {
            return Err(damaged());
        };
        let mut state = Self::new(training)?;
        let mut maps = [ByWeight::new(), ByWeight::new(), ByWeight::new()];
        for (name, size) in training.shape.tensors() {
            for (prefix, map) in TENSOR_PREFIXES.iter().zip(&mut maps) {
                let view = file.tensor(&format!("{prefix}.{name}")).map_err(|_| damaged())?;
                // The tensors have the size of the shape, so no bytes are left over below.
                if view.dtype() != Dtype::F32 || view.shape() != size {
                    return Err(damaged());
                }
                let (bytes, _) = view.data().as_chunks::<4>();
                let numbers: Vec<f32> = bytes.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
                map.insert(name, Tensor::from_vec(numbers, size.clone(), &Device::Cpu)?);
            }
        }
        let [weights, means, squares] = maps;
        for (name, var) in state.net.vars() {
            var.set(&weights[name])?;
        }
        state.optimiser.steps = steps;
        state.optimiser.means = means;
        state.optimiser.squares = squares;
        state.best = file.tensor(BEST).ok().map(|best| best.data().to_vec());
        state.best_loss = f64::from_bits(best_loss);
        state.evaluations_since_best = evaluations_since_best;
        Ok(state)
    }
}

/// Returns the parameters that a checkpoint must share with the training that resumes from it.
fn identity(training: &DtTrainingConfig, about: &BTreeMap<String, String>) -> String {
    format!("{training:?}\n{}", encode_metadata(training.shape, about))
}
