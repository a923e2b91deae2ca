//! Bayesian optimisation: a Gaussian process over (ln μ1, ln μ2) proposes the pair with the largest expected
//! improvement.
//!
//! The optimiser is egobox. It runs on one thread and from one seed, so equal points always give the same proposal.
//! Another version of egobox may propose other pairs.

use egobox_ego::{CorrelationSpec, EgorServiceBuilder, InfillStrategy, RegressionSpec};
use egobox_gp::GaussianProcess;
use egobox_gp::correlation_models::Matern52Corr;
use egobox_gp::mean_models::ConstantMean;
use linfa::Dataset;
use linfa::traits::Fit;
use ndarray::{Array1, Array2, array};

use super::error::TuningError;
use super::history::History;
use super::plan::new_pool;
use super::ranges::{Ranges, WeightPair};
use super::{Proposer, Surface};

/// Values along each side of a surface.
const SURFACE_SIDE: usize = 40;
/// The smallest noise of a surrogate, as a share of the variance of its points; it keeps matrices regular.
const MIN_NOISE: f64 = 1e-6;

/// The optimiser: log expected improvement.
#[derive(Clone, Copy, Debug)]
pub struct Bayes {
    /// The seed.
    pub seed: u64,
}

/// Returns the positions of `points` in the unit square, their objectives with mean 0 and variance 1, and the mean and
/// the standard deviation of the original objectives.
fn standardise(ranges: &Ranges, points: &[(WeightPair, f64)]) -> (Array2<f64>, Array1<f64>, (f64, f64)) {
    let positions: Array1<[f64; 2]> = points.iter().map(|(pair, _)| ranges.position(*pair)).collect();
    let x = Array2::from_shape_fn((points.len(), 2), |(row, column)| positions[row][column]);
    let count = points.len() as f64;
    let mean = points.iter().map(|(_, value)| value).sum::<f64>() / count;
    let variance = points
        .iter()
        .map(|(_, value)| (value - mean) * (value - mean))
        .sum::<f64>()
        / count;
    // Equal objectives have no deviation to divide by.
    let deviation = variance.sqrt().max(f64::MIN_POSITIVE);
    let y = points.iter().map(|(_, value)| (value - mean) / deviation).collect();
    (x, y, (mean, deviation))
}

impl Proposer for Bayes {
    fn propose(&self, ranges: &Ranges, points: &[(WeightPair, f64)]) -> Result<WeightPair, TuningError> {
        let (x, y, _) = standardise(ranges, points);
        // The optimiser minimises.
        let y = y.mapv(|value| -value).insert_axis(ndarray::Axis(1));
        let optimiser = EgorServiceBuilder::optimize()
            .configure(|config| {
                config
                    .configure_gp(|gp| {
                        gp.regression_spec(RegressionSpec::CONSTANT)
                            .correlation_spec(CorrelationSpec::MATERN52)
                    })
                    .infill_strategy(InfillStrategy::LogEI)
                    .seed(self.seed)
            })
            .min_within(&array![[0.0, 1.0], [0.0, 1.0]])
            .map_err(|error| TuningError::Model {
                part: "optimiser",
                reason: error.to_string(),
            })?;
        // On one thread, so that equal points always give the same proposal.
        let next = new_pool(1)?.install(|| optimiser.suggest(&x, &y));
        let position = next.row(0).iter().copied().collect::<Vec<f64>>();
        match position[..] {
            [u, v] if u.is_finite() && v.is_finite() => Ok(ranges.pair_at([u.clamp(0.0, 1.0), v.clamp(0.0, 1.0)])),
            _ => Err(TuningError::Model {
                part: "optimiser",
                reason: format!("the proposed pair {position:?} is not two finite numbers; repeat with another --seed"),
            }),
        }
    }
}

/// Computes the mean of a Gaussian process through the points of `history`, at the centres of 40 × 40 cells of
/// `ranges`.
///
/// Its noise is the mean variance of the objective's mean at a point, from the intervals.
///
/// # Errors
/// If the points do not determine a process.
pub fn surface(ranges: &Ranges, history: &History) -> Result<Surface, TuningError> {
    let failed = |error: egobox_gp::GpError| TuningError::Model {
        part: "surrogate",
        reason: error.to_string(),
    };
    let (x, y, (mean, deviation)) = standardise(ranges, &history.objectives());
    let process = new_pool(1)?.install(|| {
        GaussianProcess::<f64, ConstantMean, Matern52Corr>::params(ConstantMean::default(), Matern52Corr::default())
            .nugget(noise(history, deviation))
            .fit(&Dataset::new(x, y))
            .map_err(failed)
    })?;
    let cell_centre = |i: usize| (i as f64 + 0.5) / SURFACE_SIDE as f64;
    let grid = Array2::from_shape_fn((SURFACE_SIDE * SURFACE_SIDE, 2), |(row, column)| {
        cell_centre(if column == 0 {
            row % SURFACE_SIDE
        } else {
            row / SURFACE_SIDE
        })
    });
    let values = process.predict(&grid).map_err(failed)?;
    let values: Vec<f64> = values.iter().map(|value| mean + deviation * value).collect();
    Ok(Surface {
        rows: values.chunks(SURFACE_SIDE).map(<[f64]>::to_vec).collect(),
    })
}

/// Returns the noise of a point as a share of the variance of all points, which is `deviation` squared.
fn noise(history: &History, deviation: f64) -> f64 {
    let half_widths = history.points.iter().map(|point| point.evaluation.objective_half_width);
    let variances: Vec<f64> = half_widths
        .filter(|half| half.is_finite())
        // A 95 % interval extends about two standard errors to each side.
        .map(|half| (0.5 * half / deviation) * (0.5 * half / deviation))
        .collect();
    // Points of a single run have no interval, so `variances` may be empty.
    let mean = variances.iter().sum::<f64>() / variances.len().max(1) as f64;
    mean.clamp(MIN_NOISE, 1.0)
}
