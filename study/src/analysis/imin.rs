//! E(I_min) over deployments (Sec. V-A, Eqs. (`E_Info3`) and (`E_Info1`)): the mean over random layouts next to the
//! closed form for a square grid. `reveille analyse imin` shows the results, and docs/analysis.md quotes them.

use reveille_bs::beliefs::ranking::i_min;
use reveille_bs::scenario::Scenario;
use reveille_common::deployment::Deployment;
use reveille_lab::stats::Estimate;

use super::{AnalysisError, check_seeds, map_seeds};

/// I_min of the deployments of one scenario.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct IMinComparison {
    /// Ψ p(d*) over the deployments, one for each seed; d* is the distance from the worst place to its closest device.
    pub measured: Estimate,
    /// Minimum and maximum over the deployments.
    pub measured_range: (f64, f64),
    /// Ψ p(√(ξ/(2N))), Eq. (`E_Info1`), for a square grid.
    pub square_grid: f64,
}

/// Measures I_min of `scenario`'s layout under `seeds` consecutive seeds from its own.
///
/// # Errors
/// If `seeds` is 0 or above 1 000 000.
pub fn measure(scenario: &Scenario, seeds: u64) -> Result<IMinComparison, AnalysisError> {
    check_seeds(seeds)?;
    let values = map_seeds(scenario, seeds, |seeded| {
        i_min(&Deployment::new(seeded).positions(), seeded.area, &seeded.sensing)
    });
    let least = values.iter().copied().fold(f64::INFINITY, f64::min);
    let largest = values.iter().copied().fold(0.0, f64::max);
    // In a square cell of ξ/N the farthest point from the device is a corner, √(ξ/(2N)) away.
    let half_diagonal = (scenario.area.surface() / (2.0 * f64::from(scenario.run.devices))).sqrt();
    Ok(IMinComparison {
        measured: Estimate::from_values_or_nan(values),
        measured_range: (least, largest),
        square_grid: scenario.sensing.psi * scenario.sensing.p(half_diagonal),
    })
}

#[cfg(test)]
mod tests {
    use reveille_bs::scenario::{Override, load};

    use super::*;

    /// Measures the preset with `overrides` over 40 deployments.
    fn compare_with(overrides: &[&str]) -> IMinComparison {
        let parse = |text: &&str| Override::parse(text).expect("an override");
        let overrides: Vec<Override> = overrides.iter().map(parse).collect();
        measure(&load("paper", &overrides).expect("a scenario").scenario, 40).expect("a study")
    }

    #[test]
    fn a_square_grid_has_the_closed_form_and_random_layouts_less() {
        let grid = compare_with(&["layout.kind=grid", "devices=100"]);
        assert!(
            (grid.measured.mean - grid.square_grid).abs() < 1e-12 && grid.measured.deviation < 1e-12,
            "{grid:?}"
        );
        // exp(-√2): the farthest place is √(400 / 200) = √2 m away.
        assert!((grid.square_grid - 0.243_116_734).abs() < 1e-9);
        for layout in [
            "layout.kind=uniform",
            "layout.kind=jittered-grid",
            "layout.kind=poisson-disk",
        ] {
            let random = compare_with(&[layout, "devices=100"]);
            assert!(
                random.measured.mean + random.measured.half_width < random.square_grid,
                "{layout}: {random:?}"
            );
            assert!(
                random.measured.deviation > 0.0 && random.measured_range.0 < random.measured.mean,
                "{layout}: {random:?}"
            );
        }
    }

    /// The corners are 5 m from the middle, and I_min is not cut off at d_max.
    #[test]
    fn with_one_device_the_farthest_corner_decides() {
        let one_device = compare_with(&[
            "layout.kind=grid",
            "devices=1",
            "area.width=6",
            "area.height=8",
            "sensing.d_max=4",
        ]);
        assert!(
            (one_device.measured.mean - libm::exp(-5.0)).abs() < 1e-12,
            "{one_device:?}"
        );
    }
}
