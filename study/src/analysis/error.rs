//! What cannot be analysed, and why.

/// A study that cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum AnalysisError {
    /// A list of values to study is empty.
    #[error("{what}: the list is empty, so there is nothing to study; give at least one value, for example {example}")]
    Empty {
        /// The list.
        what: &'static str,
        /// A list that would do.
        example: &'static str,
    },
    /// A value is out of its range.
    #[error("{what} = {value}: {allowed}")]
    Invalid {
        /// The quantity.
        what: &'static str,
        /// Its value.
        value: String,
        /// What it has to be, and what to do.
        allowed: String,
    },
}

impl AnalysisError {
    /// `what` must not be `value`.
    pub(crate) fn invalid(what: &'static str, value: &impl ToString, allowed: impl Into<String>) -> Self {
        Self::Invalid {
            what,
            value: value.to_string(),
            allowed: allowed.into(),
        }
    }
}
