//! What is made of runs: the paper's analysis beside what the machines do, figures, and a report that holds results
//! against the paper's claims.

pub mod analysis;
pub mod claims;
pub mod figures;
pub mod report;
