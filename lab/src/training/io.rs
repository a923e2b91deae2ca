//! Checkpoints of a training in files, written after every episode, for `reveille train q-learning`. A checkpoint is a
//! file of [`LearnedTables`], which have their own format version.

use std::path::Path;

use reveille_bs::policy::q_learning::learned::LearnedTables;
use reveille_common::io::Disk;

use super::{Trainer, TrainingError, TrainingProgress};
use crate::io::replace;

impl Trainer {
    /// Resumes from the checkpoint at `path`. Returns whether there is one; without one, the training is unchanged.
    ///
    /// # Errors
    /// If the checkpoint is damaged or belongs to another training.
    pub fn resume(&mut self, path: &Path) -> Result<bool, TrainingError> {
        if !path.exists() {
            return Ok(false);
        }
        let checkpoint = LearnedTables::read(&Disk, path).map_err(|error| TrainingError::Checkpoint {
            path: path.to_owned(),
            error,
        })?;
        self.resume_from(checkpoint)
            .map_err(|differences| TrainingError::OtherCheckpoint {
                path: path.to_owned(),
                differences,
            })?;
        Ok(true)
    }

    /// Trains as [`Trainer::train`] does, and writes the tables after each episode to the file `checkpoint_path`, which
    /// the caller removes in the end. Returns `false` if the observer has stopped it.
    ///
    /// # Errors
    /// If the checkpoint cannot be written or threads cannot be started.
    pub fn train_and_save(
        &mut self,
        threads: usize,
        checkpoint_path: &Path,
        observer: &impl TrainingProgress,
    ) -> Result<bool, TrainingError> {
        let save = |learned: &LearnedTables| {
            replace(checkpoint_path, learned.to_json().as_bytes()).map_err(|error| TrainingError::Write {
                path: checkpoint_path.to_owned(),
                error,
            })
        };
        self.train(threads, &save, observer)
    }
}
