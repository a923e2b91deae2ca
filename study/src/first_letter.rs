//! The case of the first letter of a text that moves into or out of the start of a sentence.

/// Returns `text` with a lower-case first letter, unless it starts with an acronym or a symbol.
pub(crate) fn lower_first(text: &str) -> String {
    let mut letters = text.chars();
    match (letters.next(), letters.clone().next()) {
        (Some(first), Some(second)) if first.is_uppercase() && second.is_lowercase() => {
            first.to_lowercase().chain(letters).collect()
        }
        _ => text.to_owned(),
    }
}

/// Returns `text` with an upper-case first letter.
pub(crate) fn upper_first(text: &str) -> String {
    let mut letters = text.chars();
    let first: String = letters.next().into_iter().flat_map(char::to_uppercase).collect();
    first + letters.as_str()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_letter_changes_unless_the_text_starts_with_an_acronym() {
        assert_eq!(
            [lower_first("Energy"), lower_first("TTIs since")],
            ["energy", "TTIs since"]
        );
        assert_eq!([upper_first("energy"), upper_first("")], ["Energy", ""]);
    }
}
