//! Shared support for the tests of the crates (`tests/tests/`) and of the program (`tests/program/`).
//!
//! [`mod@reference`] is a second implementation of the model, written from its description and not from the emulator's
//! code. [`scenarios`] generates random scenarios for property tests. [`compare`] runs the emulator for comparison with
//! the reference. [`distributions`] tests samples against their distribution. [`process`] starts the real program and
//! observes it. [`terminal`] starts it in a terminal that can be closed. [`machine`] makes full disks and small
//! networks, and reports skipped checks. [`transcript`] records the decisions of a policy, and [`external_policy`]
//! replays them.

pub mod compare;
pub mod distributions;
pub mod external_policy;
pub mod machine;
pub mod process;
pub mod reference;
pub mod scenarios;
pub mod terminal;
pub mod transcript;
