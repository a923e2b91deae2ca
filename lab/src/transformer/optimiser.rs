//! AdamW with a clipped gradient, whose state can be kept.

use std::collections::BTreeMap;

use candle_core::backprop::GradStore;
use candle_core::{Result, Tensor, Var};

/// Decay of the running means of gradients, and of their squares.
const BETAS: (f64, f64) = (0.9, 0.999);
const EPSILON: f64 = 1e-8;
/// The largest norm of a gradient.
const CLIP: f64 = 1.0;
/// Decay of weights, in learning rates.
const DECAY: f64 = 0.01;

/// The running means of each weight's gradient.
pub struct AdamW {
    steps: u64,
    means: BTreeMap<&'static str, (Tensor, Tensor)>,
}

impl AdamW {
    /// Before the first step.
    pub fn new(vars: &BTreeMap<&'static str, Var>) -> Result<Self> {
        let start =
            |(name, var): (&&'static str, &Var)| -> Result<_> { Ok((*name, (var.zeros_like()?, var.zeros_like()?))) };
        Ok(Self {
            steps: 0,
            means: vars.iter().map(start).collect::<Result<_>>()?,
        })
    }

    /// Goes a step of `rate` against `gradients`. Gives the norm that the gradient had.
    ///
    /// # Errors
    /// A weight has no gradient, or the framework has failed.
    pub fn step(&mut self, vars: &BTreeMap<&'static str, Var>, gradients: &GradStore, rate: f64) -> Result<f64> {
        let mut squares = 0.0;
        for (name, var) in vars {
            let Some(gradient) = gradients.get(var.as_tensor()) else {
                candle_core::bail!("no gradient reaches {name}");
            };
            squares += f64::from(gradient.sqr()?.sum_all()?.to_scalar::<f32>()?);
        }
        let norm = squares.sqrt();
        let clip = if norm > CLIP { CLIP / norm } else { 1.0 };
        self.steps += 1;
        let (first, second) = BETAS;
        let unbias = |beta: f64| 1.0 - libm::pow(beta, self.steps as f64);
        for (name, var) in vars {
            let gradient = (gradients.get(var.as_tensor()).expect("looked for above") * clip)?;
            let (mean, square) = self.means.get_mut(name).expect("a mean for each weight");
            *mean = ((&*mean * first)? + (&gradient * (1.0 - first))?)?.detach();
            *square = ((&*square * second)? + (gradient.sqr()? * (1.0 - second))?)?.detach();
            let size = ((&*square / unbias(second))?.sqrt()? + EPSILON)?;
            let step = ((&*mean / unbias(first))? / size)?;
            let kept = (var.as_tensor() * (1.0 - rate * DECAY))?;
            var.set(&(kept - (step * rate)?)?)?;
        }
        Ok(norm)
    }
}
