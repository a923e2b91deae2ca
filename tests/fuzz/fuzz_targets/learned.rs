//! Fuzzes the readers of `q-learning` tables and `dt` models: a file is refused with a non-empty error, or accepted
//! without a panic. Accepted tables are written and read again without a change.
//!
//! The first byte modulo 3 selects: 0 the text of tables, 1 their body under a valid header and checksum, as
//! `LearnedTables::to_json` writes it, 2 a model. Corpora rely on these numbers. tests/fuzz/README.md names a seed and
//! shows how to run the target.

#![no_main]

use libfuzzer_sys::fuzz_target;
use reveille_bs::policy::dt::model::weights::ModelWeights;
use reveille_bs::policy::q_learning::learned::{FORMAT, LearnedTables, VERSION};
use sha2::{Digest as _, Sha256};

/// Checks that tables are refused with an error, or written and read again unchanged.
fn check_tables(text: &str) {
    match LearnedTables::parse(text) {
        Ok(learned) => {
            let written = learned.to_json();
            let reread = LearnedTables::parse(&written).expect("written tables can be read");
            assert_eq!(reread.to_json(), written);
        }
        Err(error) => assert!(!error.to_string().trim().is_empty()),
    }
}

fuzz_target!(|data: &[u8]| {
    let Some((selector, content)) = data.split_first() else {
        return;
    };
    if selector % 3 == 2 {
        if let Err(error) = ModelWeights::read(content) {
            assert!(!error.to_string().trim().is_empty());
        }
        return;
    }
    let Ok(text) = std::str::from_utf8(content) else { return };
    if selector % 3 == 0 {
        return check_tables(text);
    }
    let checksum: String = Sha256::digest(text).iter().map(|byte| format!("{byte:02x}")).collect();
    let envelope_start = format!("{{\"format\":\"{FORMAT}\",\"version\":{VERSION},\"sha256\":\"{checksum}\"");
    check_tables(&format!("{envelope_start},\"body\":{text}}}\n"));
});
