//! Settings of the `random` policy (Sec. VI).

use reveille_common::declare;
use reveille_common::declare::{Reader, ScenarioError, Sink, wholes};
use reveille_common::plan::DutyCycle;
use reveille_common::scenario::PolicySettings;

/// The longest list of t_on or t_DRX to draw from.
const MOST_CYCLES: usize = 64;

declare! {
    /// Settings of the policy `random` (Sec. VI). The paper does not say what its devices draw from.
    #[derive(Clone, Debug, PartialEq, Eq)]
    pub struct RandomSettings in "policy.random" {
        /// Values of t_on that a device draws from, each equally likely. None is longer than the shortest of `t_drx`.
        pub t_on: Vec<u32> = wholes(1, DutyCycle::LONGEST, MOST_CYCLES, &[1, 2]).unit("TTIs").source("by calibration"),
        /// Values of t_DRX that a device draws from, each equally likely.
        pub t_drx: Vec<u32> = wholes(1, DutyCycle::LONGEST, MOST_CYCLES, &[2, 4, 8])
            .unit("TTIs")
            .source("by calibration"),
    }
}

impl RandomSettings {
    /// The settings that `reader` has.
    ///
    /// # Errors
    /// A value that may not be, or a t_on that is longer than a t_DRX.
    pub fn settle(reader: &Reader<'_>) -> Result<Self, ScenarioError> {
        let settings = Self::read(reader)?;
        let shortest = settings.t_drx.iter().min().copied().unwrap_or(1);
        if settings.t_on.iter().any(|&t_on| t_on > shortest) {
            let allowed = format!("none may be longer than the shortest of policy.random.t_drx, {shortest}");
            return Err(reader.refuse("policy.random.t_on", format!("{:?}", settings.t_on), allowed));
        }
        Ok(settings)
    }
}

impl PolicySettings for RandomSettings {
    fn visit(&self, sink: &mut dyn Sink) {
        Self::visit(self, sink);
    }
}
