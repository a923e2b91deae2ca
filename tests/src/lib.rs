//! Helpers of the whole-product tests.

pub mod process;
