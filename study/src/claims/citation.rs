//! Citations: a passage of the paper and a sentence in it. [`super`]'s claims and [`crate::analysis::harvest`] cite
//! with these constants; tests compare the displayed text with a transcript, and the report prints it.

use std::fmt;

/// A sentence of the paper.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Citation {
    /// Section, and the paragraph in it.
    pub passage: &'static str,
    /// Number of the sentence in that paragraph, from 1; 0 for the passage as a whole.
    pub sentence: u8,
}

/// The abstract.
pub(super) const ABSTRACT: Citation = Citation::of_passage("Abstract");
/// The third of the contributions that the introduction lists.
pub(super) const CONTRIBUTION: Citation = Citation::of_passage("Sec. I-B, 3rd contribution");
/// The table of parameters.
pub(super) const PARAMETERS: Citation = Citation::of_passage("Sec. VI, table of parameters");
/// The paragraph on the two benchmarks.
pub(super) const BENCHMARKS: Citation = Citation::of_passage("Sec. VI, on the benchmarks");
/// The paragraph on information per event.
pub(super) const FIG_7: Citation = Citation::of_passage("Sec. VI-A, on Fig. 7");
/// The paragraph on consumption.
pub(crate) const FIG_8: Citation = Citation::of_passage("Sec. VI-A, on Fig. 8");
/// The paragraph on misdetections.
pub(super) const FIG_9: Citation = Citation::of_passage("Sec. VI-A, on Fig. 9");
/// The paragraph on batteries.
pub(super) const FIGS_10_11: Citation = Citation::of_passage("Sec. VI-A, on Figs. 10 and 11");
/// The paragraph on wrong activations.
pub(super) const FIG_12: Citation = Citation::of_passage("Sec. VI-A, on Fig. 12");
/// The paragraph on harvest against λ.
pub(crate) const FIG_13: Citation = Citation::of_passage("Sec. VI-B, on Fig. 13");
/// The paragraph on net energy against λ.
pub(crate) const FIG_14: Citation = Citation::of_passage("Sec. VI-B, on Fig. 14");
/// The conclusions.
pub(super) const CONCLUSIONS: Citation = Citation::of_passage("Sec. VII");

impl Citation {
    /// Cites a passage as a whole.
    pub(crate) const fn of_passage(passage: &'static str) -> Self {
        Self { passage, sentence: 0 }
    }

    /// Cites the `sentence`-th sentence of this passage.
    #[must_use]
    pub const fn sentence(self, sentence: u8) -> Self {
        Self { sentence, ..self }
    }
}

impl fmt::Display for Citation {
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
