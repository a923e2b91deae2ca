//! Where finished runs are kept, as pure code asks for it.

use std::collections::BTreeMap;

use super::lines::{Entry, Job};
use crate::sweep::error::SweepError;

/// Keeps finished runs.
pub trait Keeper: Send {
    /// The finished runs.
    fn runs(&self) -> &BTreeMap<Job, Entry>;

    /// Adds a finished run that took `device_ttis`.
    ///
    /// # Errors
    /// It cannot be kept; the runs before it are.
    fn add(&mut self, job: Job, entry: Entry, device_ttis: u64) -> Result<(), SweepError>;

    /// Brings everything to where it outlasts a power cut.
    ///
    /// # Errors
    /// It cannot.
    fn sync(&mut self) -> Result<(), SweepError>;
}
