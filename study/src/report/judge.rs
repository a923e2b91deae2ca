//! The verdict on a claim.
//!
//! 1. A policy without runs at a claim's N is *not run*. What is said of several N together needs two of them.
//! 2. A claim is *reproduced* if our mean is within 5 % of a stated value, in a stated range, or meets a bound
//!    ("below", "above"); it is *within 20 %* if it is that near to the value or to the nearer end of the range. A
//!    claim for several N or against several policies must hold for each that was run, and has the verdict of the
//!    worst. A stated 0 allows 1 % of the largest of the other policies' means.
//! 3. What falls or rises with N may go against that by at most a tenth of the range of all means; what stays level
//!    stays within 20 % of the middle of them.
//! 4. Otherwise its *order is reproduced* if, at each such N, our means stand to those of every other policy as the
//!    paper's figures do, where the paper states their order, their ratio or figures for both all of which exclude each
//!    other, and there is at least one such policy.
//! 5. Otherwise it is *not reproduced*.
//!
//! A verdict is *firm* if it would be the same for every value in our 95 % intervals.

mod finding;
mod fit;
mod order;

pub use self::finding::Finding;
pub use self::fit::{Fit, Tier, about};
use crate::claims::{Claim, Topic};
use crate::figures::results::Condition;

/// The verdict.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Verdict {
    /// As stated.
    Reproduced,
    /// Not that, but within 20 % of it.
    Near,
    /// Neither, but the policy stands among the others where the paper has it.
    OrderReproduced,
    /// None of that.
    NotReproduced,
    /// There are no runs.
    NotRun,
}

impl Verdict {
    /// All verdicts, the best first.
    pub const ALL: [Self; 5] = [
        Self::Reproduced,
        Self::Near,
        Self::OrderReproduced,
        Self::NotReproduced,
        Self::NotRun,
    ];

    /// The verdict in words.
    pub const fn words(self) -> &'static str {
        match self {
            Self::Reproduced => "reproduced",
            Self::Near => "within 20 %",
            Self::OrderReproduced => "order reproduced",
            Self::NotReproduced => "not reproduced",
            Self::NotRun => "not run",
        }
    }
}

/// A claim, judged.
#[derive(Clone, Debug, PartialEq)]
pub struct Judgement {
    /// The verdict.
    pub verdict: Verdict,
    /// Whether it holds throughout our intervals.
    pub firm: bool,
    /// Our figures, by rising N, and at an N by the policies compared with.
    pub findings: Vec<Finding>,
    /// The policies whose order was compared, with N, and whether we have it as the paper has it.
    pub order: Vec<(u32, &'static str, bool)>,
}

/// Judges one claim of `topic` by the runs of `condition`.
pub fn judge(topic: &Topic, claim: &Claim, condition: &Condition) -> Judgement {
    let findings = finding::findings(topic, claim, condition);
    let mut judgement = Judgement {
        verdict: Verdict::NotRun,
        firm: true,
        findings,
        order: Vec::new(),
    };
    let Some(fit) = Fit::of(claim.statement, &judgement.findings) else {
        judgement.findings.clear();
        return judgement;
    };
    if let Some(verdict) = verdict_of(fit.tier) {
        judgement.verdict = verdict;
        judgement.firm = fit.is_firm();
        return judgement;
    }
    let compared = order::compared(topic, claim, condition, &judgement.findings);
    let has_order = !compared.is_empty() && compared.iter().all(|pair| pair.as_stated);
    judgement.verdict = if has_order {
        Verdict::OrderReproduced
    } else {
        Verdict::NotReproduced
    };
    let order_firm = if has_order {
        compared.iter().all(|pair| pair.firm)
    } else {
        compared.is_empty() || compared.iter().any(|pair| pair.firm && !pair.as_stated)
    };
    judgement.firm = fit.is_firm() && order_firm;
    let pairs = compared.into_iter();
    judgement.order = pairs.map(|pair| (pair.n, pair.other, pair.as_stated)).collect();
    judgement
}

/// The verdict on what fits, or nothing where it does not.
pub const fn verdict_of(tier: Tier) -> Option<Verdict> {
    match tier {
        Tier::Yes => Some(Verdict::Reproduced),
        Tier::Near => Some(Verdict::Near),
        Tier::No => None,
    }
}

#[cfg(test)]
mod tests;
