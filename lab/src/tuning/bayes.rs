//! Bayesian optimisation: a Gaussian process over (ln μ1, ln μ2) proposes the pair with the largest expected
//! improvement.
//!
//! The optimiser is egobox. It runs on one thread and from one seed, so equal points always give the same proposal.
//! Another version of egobox may propose other pairs, and so may other settings below: a resumed tuning then differs
//! from an uninterrupted one, without an error.

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

/// The number of values along each side of a surface.
const SURFACE_SIDE: usize = 40;
/// The smallest noise of a surrogate, as a share of the variance of its points; it keeps matrices regular.
const MIN_NOISE: f64 = 1e-6;

/// The optimiser: log expected improvement.
#[derive(Clone, Copy, Debug)]
pub struct Bayes {
    /// The seed of the optimiser. `reveille tune` uses the seed of the scenario.
    pub seed: u64,
}

/// The points of a tuning as a process takes them.
struct StandardisedPoints {
    /// The positions of the pairs in the unit square, a row each.
    positions: Array2<f64>,
    /// The objectives, shifted and scaled to mean 0 and variance 1.
    objectives: Array1<f64>,
    /// The mean of the original objectives.
    mean: f64,
    /// The standard deviation of the original objectives.
    deviation: f64,
}

impl StandardisedPoints {
    /// Standardises `points`, at least one.
    fn new(ranges: &Ranges, points: &[(WeightPair, f64)]) -> Self {
        let pair_positions: Vec<[f64; 2]> = points.iter().map(|(pair, _)| ranges.position(*pair)).collect();
        let count = points.len() as f64;
        let mean = points.iter().map(|(_, objective)| objective).sum::<f64>() / count;
        let variance = points
            .iter()
            .map(|(_, objective)| (objective - mean) * (objective - mean))
            .sum::<f64>()
            / count;
        // Equal objectives have no deviation to divide by.
        let deviation = variance.sqrt().max(f64::MIN_POSITIVE);
        Self {
            positions: Array2::from_shape_fn((points.len(), 2), |(row, column)| pair_positions[row][column]),
            objectives: points
                .iter()
                .map(|(_, objective)| (objective - mean) / deviation)
                .collect(),
            mean,
            deviation,
        }
    }
}

impl Proposer for Bayes {
    fn propose(&self, ranges: &Ranges, points: &[(WeightPair, f64)]) -> Result<WeightPair, TuningError> {
        let points = StandardisedPoints::new(ranges, points);
        // The optimiser minimises.
        let costs = points
            .objectives
            .mapv(|objective| -objective)
            .insert_axis(ndarray::Axis(1));
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
        let proposed = new_pool(1)?.install(|| optimiser.suggest(&points.positions, &costs));
        let position = proposed.row(0).iter().copied().collect::<Vec<f64>>();
        match position[..] {
            [x, y] if x.is_finite() && y.is_finite() => Ok(ranges.pair_at([x.clamp(0.0, 1.0), y.clamp(0.0, 1.0)])),
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
/// Its noise is the mean variance of the objective's mean at a point, from the intervals. The history must have
/// [`super::MIN_DESIGN_PAIRS`] points or more; the caller checks this.
///
/// # Errors
/// If the points do not determine a process.
pub fn surface(ranges: &Ranges, history: &History) -> Result<Surface, TuningError> {
    let failed = |error: egobox_gp::GpError| TuningError::Model {
        part: "surrogate",
        reason: error.to_string(),
    };
    let StandardisedPoints {
        positions,
        objectives,
        mean,
        deviation,
    } = StandardisedPoints::new(ranges, &history.objectives());
    let process = new_pool(1)?.install(|| {
        GaussianProcess::<f64, ConstantMean, Matern52Corr>::params(ConstantMean::default(), Matern52Corr::default())
            .nugget(noise_share(history, deviation))
            .fit(&Dataset::new(positions, objectives))
            .map_err(failed)
    })?;
    let cell_centre = |i: usize| (i as f64 + 0.5) / SURFACE_SIDE as f64;
    // Cell by cell, μ1 fastest: `Surface` has a row for each μ2.
    let cell_positions = Array2::from_shape_fn((SURFACE_SIDE * SURFACE_SIDE, 2), |(cell, axis)| {
        cell_centre(if axis == 0 {
            cell % SURFACE_SIDE
        } else {
            cell / SURFACE_SIDE
        })
    });
    let standardised_values = process.predict(&cell_positions).map_err(failed)?;
    let values: Vec<f64> = standardised_values
        .iter()
        .map(|value| mean + deviation * value)
        .collect();
    Ok(Surface {
        rows: values.chunks(SURFACE_SIDE).map(<[f64]>::to_vec).collect(),
    })
}

/// Returns the noise of a point as a share of the variance of all points, which is `deviation` squared.
fn noise_share(history: &History, deviation: f64) -> f64 {
    let half_widths = history.points.iter().map(|point| point.evaluation.objective_half_width);
    let variances: Vec<f64> = half_widths
        .filter(|half_width| half_width.is_finite())
        // A 95 % interval extends about two standard errors to each side.
        .map(|half_width| (0.5 * half_width / deviation) * (0.5 * half_width / deviation))
        .collect();
    // Points of a single run have no interval, so `variances` may be empty.
    let mean_variance = variances.iter().sum::<f64>() / variances.len().max(1) as f64;
    mean_variance.clamp(MIN_NOISE, 1.0)
}
