//! AdamW with a clipped gradient, for [`super::train`]. Its state is part of a checkpoint; sums follow the order of the
//! weights' names. Another constant below changes trained models.

use std::collections::BTreeMap;

use candle_core::{Result, Tensor, Var};

/// Decay of the running means of gradients, and of their squares.
const BETAS: (f64, f64) = (0.9, 0.999);
/// Keeps divisors above 0.
const EPSILON: f64 = 1e-8;
/// The norm over all weights above which the gradient is scaled down.
const MAX_GRADIENT_NORM: f64 = 1.0;
/// Decay of weights per step, as a multiple of the learning rate.
const WEIGHT_DECAY: f64 = 0.01;

/// A tensor for each weight, by the name of the weight.
pub(super) type TensorByName = BTreeMap<&'static str, Tensor>;

/// The running means of each weight's gradient, and of its square.
pub(super) struct AdamW {
    /// The number of completed steps. It is also the training's: batches and the learning rate follow from it.
    pub steps: u64,
    /// The mean gradients by weight.
    pub mean_gradients: TensorByName,
    /// The mean squared gradients by weight.
    pub mean_squares: TensorByName,
}

impl AdamW {
    /// Creates the optimiser before the first step.
    pub(super) fn new(vars: &BTreeMap<&'static str, Var>) -> Result<Self> {
        let zeros = || {
            vars.iter()
                .map(|(name, var)| Ok((*name, var.zeros_like()?)))
                .collect::<Result<_>>()
        };
        Ok(Self {
            steps: 0,
            mean_gradients: zeros()?,
            mean_squares: zeros()?,
        })
    }

    /// Takes a step of `rate` against `gradients`, one for each weight.
    ///
    /// # Errors
    /// If the framework fails.
    ///
    /// # Panics
    /// If a weight has no gradient.
    pub(super) fn step(
        &mut self,
        vars: &BTreeMap<&'static str, Var>,
        gradients: &TensorByName,
        rate: f64,
    ) -> Result<()> {
        // One norm over all weights, in the order of their names: the clip keeps the direction of the step.
        let mut squared_norm = 0.0;
        for gradient in gradients.values() {
            squared_norm += f64::from(gradient.sqr()?.sum_all()?.to_scalar::<f32>()?);
        }
        let norm = squared_norm.sqrt();
        let clip = if norm > MAX_GRADIENT_NORM {
            MAX_GRADIENT_NORM / norm
        } else {
            1.0
        };
        self.steps += 1;
        let (mean_decay, square_decay) = BETAS;
        let bias_divisor = |beta: f64| 1.0 - libm::pow(beta, self.steps as f64);
        for (name, var) in vars {
            let gradient = (&gradients[name] * clip)?;
            // Detached: otherwise each mean would hold the graph of all earlier steps.
            let mean_gradient =
                ((&self.mean_gradients[name] * mean_decay)? + (&gradient * (1.0 - mean_decay))?)?.detach();
            let mean_square =
                ((&self.mean_squares[name] * square_decay)? + (gradient.sqr()? * (1.0 - square_decay))?)?.detach();
            let root_mean_square = ((&mean_square / bias_divisor(square_decay))?.sqrt()? + EPSILON)?;
            let direction = ((&mean_gradient / bias_divisor(mean_decay))? / root_mean_square)?;
            let decayed = (var.as_tensor() * (1.0 - rate * WEIGHT_DECAY))?;
            var.set(&(decayed - (direction * rate)?)?)?;
            self.mean_gradients.insert(name, mean_gradient);
            self.mean_squares.insert(name, mean_square);
        }
        Ok(())
    }
}
