//! Priors over the place of an event, from which the belief over its epicentre starts. Digests depend on every bit of a
//! density.

use reveille_common::geometry::Point;

/// A prior over the place of the epicentre, before any report. A function of the place is one.
pub trait PlacePrior {
    /// Returns the relative density at `place`, at least 2⁻⁵¹².
    fn density_at(&self, place: Point) -> f64;

    /// Writes [`Self::density_at`] of the places at `x` and `y`, metres, to `densities`. All have the same length.
    #[inline(always)]
    fn densities_at(&self, x: &[f64], y: &[f64], densities: &mut [f64]) {
        for ((density, &x), &y) in densities.iter_mut().zip(x).zip(y) {
            *density = self.density_at(Point::new(x, y));
        }
    }
}

impl<F: Fn(Point) -> f64> PlacePrior for F {
    #[inline(always)]
    fn density_at(&self, place: Point) -> f64 {
        self(place)
    }
}

/// Returns the relative prior density of the epicentre at a point: the same everywhere.
pub fn uniform_prior(_point: Point) -> f64 {
    1.0
}
