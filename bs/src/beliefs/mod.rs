//! What a base station makes of what it knows: structures that several policies share.

pub mod ages;
pub mod aim;
pub mod candidates;
pub mod clusters;
pub mod correlation;
pub mod coverage;
mod neighbours;
pub mod posterior;
pub mod ranking;
pub(crate) mod raster;
pub mod reward;
