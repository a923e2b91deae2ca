//! Tests that call the crates and need no program. Every file of this folder is a module of this one binary, which
//! `tidy` checks. `cargo test -p reveille-tests` runs them.

mod actions;
mod adjusted;
mod age_index;
mod analysis;
mod audit;
mod bursts;
mod classes;
mod closed_forms;
mod clusters;
mod device_removal;
mod dt;
mod events;
mod external;
mod knowledge_wall;
mod ledger;
mod levels;
mod lookahead;
mod observer;
mod q_learning;
mod radio;
mod reference;
mod scaling;
mod session;
mod testbed_files;
mod tidy;
mod tutorial;
