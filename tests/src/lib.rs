//! What the tests of the whole product share.
//!
//! [`mod@reference`] is a second implementation of the model, written from its description and not from the emulator's
//! code; [`scenarios`] makes random scenarios for property tests; [`compare`] sets the emulator beside the reference;
//! [`laws`] holds what was drawn against its law; [`process`] starts the real program and watches it; [`terminal`]
//! starts it in a window that can be closed; [`disk`] lets it run out of room, [`network`] of ports; [`transcript`]
//! keeps what a policy commands, and [`deciding`] commands it once more; [`found`] checks that no file of tests is left
//! out.

pub mod compare;
pub mod deciding;
pub mod disk;
pub mod found;
pub mod laws;
pub mod network;
pub mod process;
pub mod reference;
pub mod scenarios;
pub mod terminal;
pub mod transcript;
