//! Checkpoints of a training in files.

use std::path::Path;

use reveille_bs::policy::q_learning::learned::Learned;
use reveille_common::io::Disk;

use super::{Trainer, TrainingError, TrainingProgress};
use crate::io::replace;

impl Trainer {
    /// Goes on from the checkpoint at `path`, if there is one. Says whether there was.
    ///
    /// # Errors
    /// It is damaged or of another training.
    pub fn resume(&mut self, path: &Path) -> Result<bool, TrainingError> {
        if !path.exists() {
            return Ok(false);
        }
        let found = Learned::read(&Disk, path).map_err(|error| TrainingError::Checkpoint {
            path: path.to_owned(),
            error,
        })?;
        self.go_on(found).map_err(|why| TrainingError::OtherCheckpoint {
            path: path.to_owned(),
            why,
        })?;
        Ok(true)
    }

    /// As [`Trainer::train`], and keeps what is done in the file `checkpoint`.
    ///
    /// # Errors
    /// The checkpoint cannot be written, or threads cannot be started.
    pub fn train_keeping(
        &mut self,
        threads: usize,
        checkpoint: &Path,
        observer: &impl TrainingProgress,
    ) -> Result<bool, TrainingError> {
        let keep = |learned: &Learned| {
            replace(checkpoint, learned.to_json().as_bytes()).map_err(|error| TrainingError::Write {
                path: checkpoint.to_owned(),
                error,
            })
        };
        self.train(threads, &keep, observer)
    }
}
