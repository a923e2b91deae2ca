//! Tests that call the crates and need no program: every file of this folder is a module of this one binary.
//!
//! A new file is found by itself; touch this one if the binary is older. `cargo fmt` does not follow `automod`, so
//! format a file here with `rustfmt --edition 2024 tests/tests/FILE.rs`.

automod::dir!("tests");

#[test]
fn every_file_is_in_this_binary() {
    reveille_tests::found::assert_all_of(concat!(env!("CARGO_MANIFEST_DIR"), "/tests"));
}
