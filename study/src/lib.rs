//! Evaluation of runs, for the commands `analyse`, `compare`, `figures`, `inspect misses`, `report` and `tune`, and for
//! the figures of the Python package.
//!
//! - [`claims`]: the paper's claims as data. Start here.
//! - [`figures`]: result tables merged ([`figures::results`]) and drawn as SVG, PNG and CSV.
//! - [`report`]: verdicts on the claims by the merged tables, as Markdown and HTML.
//! - [`misses`]: the missed events of a run.
//! - [`analysis`]: the paper's closed forms and chains, compared with runs in memory.
//!
//! Nothing here takes part in a run or in its digest. Output is a function of the input: equal tables give equal bytes.
//! docs/reproduction.md and docs/analysis.md contain output of this crate.

pub mod analysis;
pub mod claims;
pub mod figures;
mod first_letter;
pub mod misses;
pub mod report;
