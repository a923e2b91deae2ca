//! The transformer: its shape, its weights, and how it is run.

pub mod infer;
mod kernel;
pub mod shape;
pub mod weights;

pub use kernel::{NORM_EPSILON, Width};

#[cfg(test)]
mod tests;
