//! One file for each subcommand, and those with what several of them do: `resolution` at the start, `conclusion` at the
//! end, `taken` for a run that is taken up, `pictures` for the files of tables and pictures.

pub mod analyse;
pub mod bs;
pub mod clock;
mod conclusion;
pub mod dashboard;
pub mod device;
mod experiment;
pub mod figures;
pub mod inspect;
pub mod merge;
mod pictures;
pub mod policy_process;
pub mod report;
mod resolution;
pub mod run;
pub mod scenario;
pub mod sweep;
mod taken;
pub mod train;
#[cfg(feature = "tune")]
pub mod tune;
pub mod up;
