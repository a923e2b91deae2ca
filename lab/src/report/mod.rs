//! The report: every claim of the paper beside what the lab measured, with a verdict by a stated rule.

pub mod claims;
