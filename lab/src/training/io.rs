//! Checkpoints of a training in files.

use std::path::Path;

use reveille_bs::policy::q_learning::learned::LearnedTables;
use reveille_common::io::Disk;

use super::{Trainer, TrainingError, TrainingProgress};
use crate::io::replace;

impl Trainer {
    /// Resumes from the checkpoint at `path`. Returns `false` without one.
    ///
    /// # Errors
    /// If the checkpoint is damaged or belongs to another training.
    pub fn resume(&mut self, path: &Path) -> Result<bool, TrainingError> {
        if !path.exists() {
            return Ok(false);
        }
        let found = LearnedTables::read(&Disk, path).map_err(|error| TrainingError::Checkpoint {
            path: path.to_owned(),
            error,
        })?;
        self.resume_from(found).map_err(|why| TrainingError::OtherCheckpoint {
            path: path.to_owned(),
            why,
        })?;
        Ok(true)
    }

    /// Trains as [`Trainer::train`] does, and writes each finished round to the file `checkpoint`.
    ///
    /// # Errors
    /// If the checkpoint cannot be written or threads cannot be started.
    pub fn train_keeping(
        &mut self,
        threads: usize,
        checkpoint: &Path,
        observer: &impl TrainingProgress,
    ) -> Result<bool, TrainingError> {
        let keep = |learned: &LearnedTables| {
            replace(checkpoint, learned.to_json().as_bytes()).map_err(|error| TrainingError::Write {
                path: checkpoint.to_owned(),
                error,
            })
        };
        self.train(threads, &keep, observer)
    }
}
