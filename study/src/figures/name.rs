//! What pictures are called.

/// `name` as a part of a file's name.
pub fn as_file(name: &str) -> String {
    let keep = |c: char| {
        if c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_') {
            c
        } else {
            '_'
        }
    };
    name.chars().map(keep).collect()
}
