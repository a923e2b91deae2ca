//! Evaluation of runs: the paper's analysis compared with the emulation, figures, and a report that compares results
//! with the paper's claims.

pub mod analysis;
pub mod claims;
pub mod figures;
pub mod report;
