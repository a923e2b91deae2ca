//! Which exit code an error of a command means.

use reveille_bs::host::BsError;

use crate::commands;
use crate::exit::Exit;

/// How a command ends that has returned `error`.
pub fn of(error: &anyhow::Error) -> Exit {
    let by_bs = error.downcast_ref::<BsError>().is_some_and(BsError::is_interruption);
    let in_memory = error.is::<commands::run::Interrupted>()
        || error.is::<commands::sweep::Interrupted>()
        || error.is::<commands::train::Interrupted>();
    if by_bs || in_memory {
        Exit::Interrupted
    } else {
        Exit::Failed
    }
}
