//! Placeholder.

pub mod clusters;
mod correlation;
pub mod wakeup;
