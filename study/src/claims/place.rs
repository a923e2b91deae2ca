//! Where in the paper a claim stands.

use std::fmt;

/// A sentence of the paper.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Place {
    /// The section and the paragraph in it.
    pub passage: &'static str,
    /// The number of the sentence in that paragraph, from 1; 0 where the passage has no sentences.
    pub sentence: u8,
}

/// The abstract.
pub const ABSTRACT: Place = Place::passage("Abstract");
/// The third of the contributions that the introduction lists.
pub const CONTRIBUTION: Place = Place::passage("Sec. I-B, 3rd contribution");
/// The table of parameters.
pub const PARAMETERS: Place = Place::passage("Sec. VI, table of parameters");
/// The paragraph on the two benchmarks.
pub const BENCHMARKS: Place = Place::passage("Sec. VI, on the benchmarks");
/// The paragraph on information per event.
pub const FIG_7: Place = Place::passage("Sec. VI-A, on Fig. 7");
/// The paragraph on consumption.
pub const FIG_8: Place = Place::passage("Sec. VI-A, on Fig. 8");
/// The paragraph on misdetections.
pub const FIG_9: Place = Place::passage("Sec. VI-A, on Fig. 9");
/// The paragraph on batteries.
pub const FIG_10: Place = Place::passage("Sec. VI-A, on Figs. 10 and 11");
/// The paragraph on wrong activations.
pub const FIG_12: Place = Place::passage("Sec. VI-A, on Fig. 12");
/// The paragraph on harvest against λ.
pub const FIG_13: Place = Place::passage("Sec. VI-B, on Fig. 13");
/// The paragraph on net energy against λ.
pub const FIG_14: Place = Place::passage("Sec. VI-B, on Fig. 14");
/// The conclusions.
pub const CONCLUSIONS: Place = Place::passage("Sec. VII");

impl Place {
    /// A passage as a whole.
    pub const fn passage(passage: &'static str) -> Self {
        Self { passage, sentence: 0 }
    }

    /// The `sentence`-th sentence of this passage.
    #[must_use]
    pub const fn sentence(self, sentence: u8) -> Self {
        Self { sentence, ..self }
    }
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { passage, sentence } = self;
        let suffix = match (sentence % 10, sentence % 100) {
            _ if *sentence == 0 => return f.write_str(passage),
            (_, 11..=13) => "th",
            (1, _) => "st",
            (2, _) => "nd",
            (3, _) => "rd",
            _ => "th",
        };
        write!(f, "{passage}, {sentence}{suffix} sentence")
    }
}
