//! The base station (BS): its knowledge and policies, the cycle of a TTI and the virtual clock. Only [`server`], the
//! shell on the bus, and `scenario/disk.rs` perform I/O, as `tests/tests/tidy/` checks.
//!
//! Start with [`session`], which defines the order of a TTI. [`cycle`] carries out its steps on the world, the
//! [`base_station`] and the score; an [`observer`] receives notifications. [`policy`] holds the policies, which see
//! only [`knowledge`] and [`observation`]; `genie` alone also receives events. [`beliefs`] holds the models that they
//! share, with [`bounds_cache`] for several runs, and [`battery_estimator`] the levels that they read. `boundaries`
//! limits grants to windows, [`actions`] checks changes by operators, and [`scenario`] reads and describes scenarios.

// A policy refers to this crate by the same name, in its folder here and in a separate crate.
#[expect(unused_extern_crates, reason = "for policies that say `reveille_bs`")]
extern crate self as reveille_bs;

pub mod actions;
pub mod base_station;
pub mod battery_estimator;
pub mod beliefs;
mod boundaries;
pub mod bounds_cache;
pub mod cycle;
pub mod knowledge;
pub mod observation;
pub mod observer;
pub mod policy;
pub mod scenario;
pub mod server;
pub mod session;
pub mod vector_width;
