//! Runs of the Reveille machines in memory, without a bus, and everything built on such runs. Start with
//! [`preparation::run`] and [`run::Run`].
//!
//! - One run: [`preparation`], [`run`], [`stepped_run`], which stops at each decision, and [`gym`], its environments;
//!   [`action_script`] parses actions for runs in memory and over the bus.
//! - A run over the bus: [`replay`] restores and audits it, [`external_inputs`] and [`resume_mark`] are its files.
//! - Many runs: [`sweep`] fills a [`table`]; [`stats`], [`metric_estimate`] and [`series`] evaluate it.
//! - Training: [`training`] and [`tuning`] of `q-learning`, [`trajectories`] and `transformer` for `dt`.

pub mod action_script;
pub mod external_inputs;
pub mod gym;
pub mod io;
pub mod metric_estimate;
pub mod preparation;
pub mod replay;
pub mod resume_mark;
pub mod run;
pub mod series;
pub mod stats;
pub mod stepped_run;
pub mod sweep;
pub mod table;
pub mod training;
pub mod trajectories;
#[cfg(feature = "train-dt")]
pub mod transformer;
pub mod tuning;
