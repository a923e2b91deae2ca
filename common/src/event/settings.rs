//! How often events come and how long they last.

use crate::declare::{ABOVE_ZERO, number, whole};
use crate::ids::MAX_TTIS;

crate::declare! {
    /// The event process (paper Sec. II).
    #[derive(Clone, Copy, Debug, PartialEq)]
    pub struct Events in "events" {
        /// Probability α that an event starts in a TTI in which none is active.
        pub alpha: f64 = number(ABOVE_ZERO, 0.2).unit("per TTI").source("Sec. II; 0.1 there, 0.2 by calibration"),
        /// How long an event lasts unless a report ends it.
        pub duration: u64 = whole(1, MAX_TTIS, 4).unit("TTIs").source("by calibration"),
    }
}
