//! The verdict on a claim. The report and its search call [`judge`]; the claims on λ use only the levels of agreement.
//! The module `notes` of the report states the rule for readers of the report, and `docs/figures-and-report.md` for
//! users; change all three.
//!
//! 1. A policy without runs at a claim's N is *not run*. A statement on several N together needs runs at two of them.
//! 2. A claim is *reproduced* if our mean is within 5 % of a stated value, in a stated range, or meets a bound
//!    ("below", "above"). It is *within 20 %* if it is that near to the value or to the nearer end of the range. A
//!    claim for several N or against several policies must hold for each that was run, and has the worst verdict. A
//!    stated 0 allows 1 % of the largest of the other policies' means.
//! 3. A trend with N has its last mean on the stated side of its first, and allows opposite steps of at most a tenth of
//!    the range of all means. A constant level stays within 20 % of the middle of all means, or counts as 0 at every N
//!    by rule 2.
//! 4. Otherwise its *order is reproduced* if, at each such N, our mean has the same order to every compared policy as
//!    in the paper. A policy is compared if the paper states its order or ratio, or figures for both that all exclude
//!    each other. At least one policy must be compared. A claim that is itself an order, an equality, a gap, a growth
//!    or a trend is not compared.
//! 5. Otherwise it is *not reproduced*.
//!
//! A verdict is *firm* if it is the same for every value in our 95 % intervals.

mod agreement;
mod finding;
mod order;

pub use self::agreement::{Agreement, AgreementLevel, agreement_with_value};
pub use self::finding::Finding;
use self::order::PolicyPair;
use crate::claims::{Claim, ClaimTopic};
use crate::figures::results::RunCondition;

/// Verdict on a claim.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Verdict {
    /// As stated.
    Reproduced,
    /// Not as stated, but within 20 %.
    Near,
    /// Neither, but the policy has the same order among the others as in the paper.
    OrderReproduced,
    /// None of the above.
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

    /// Name of the verdict, as in docs/reproduction.md.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Reproduced => "reproduced",
            Self::Near => "within 20 %",
            Self::OrderReproduced => "order reproduced",
            Self::NotReproduced => "not reproduced",
            Self::NotRun => "not run",
        }
    }
}

/// A claim with its verdict.
#[derive(Clone, Debug, PartialEq)]
pub struct Judgement {
    /// Verdict on the claim.
    pub verdict: Verdict,
    /// Whether the verdict holds throughout our intervals.
    pub is_firm: bool,
    /// Our findings, in ascending order of N, and at each N in the order of the compared policies.
    pub findings: Vec<Finding>,
    /// The comparisons of rule 4. Empty if rules 1 to 3 decide or no policy can be compared.
    pub order_checks: Vec<OrderCheck>,
}

/// Comparison of the order of a claim's policy and another policy, by rule 4.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OrderCheck {
    /// Number of devices N.
    pub n: u32,
    /// The other policy.
    pub other_policy: &'static str,
    /// Whether our order equals the paper's.
    pub is_as_stated: bool,
}

/// Judges one claim of `topic` by the runs of `condition`.
pub fn judge(topic: &ClaimTopic, claim: &Claim, condition: &RunCondition) -> Judgement {
    let findings = finding::findings(topic, claim, condition);
    let mut judgement = Judgement {
        verdict: Verdict::NotRun,
        is_firm: true,
        findings,
        order_checks: Vec::new(),
    };
    let Some(agreement) = Agreement::of_findings(claim.statement, &judgement.findings) else {
        judgement.findings.clear();
        return judgement;
    };
    if let Some(verdict) = verdict_of(agreement.of_means) {
        judgement.verdict = verdict;
        judgement.is_firm = agreement.is_firm();
        return judgement;
    }
    let compared = order::compare_policies(topic, claim, condition, &judgement.findings);
    let has_order = !compared.is_empty() && compared.iter().all(|pair| pair.is_as_stated);
    judgement.verdict = if has_order {
        Verdict::OrderReproduced
    } else {
        Verdict::NotReproduced
    };
    // An order needs all of its pairs, but a single firm pair against it refutes it.
    let is_order_firm = if has_order {
        compared.iter().all(|pair| pair.is_firm)
    } else {
        compared.is_empty() || compared.iter().any(|pair| pair.is_firm && !pair.is_as_stated)
    };
    judgement.is_firm = agreement.is_firm() && is_order_firm;
    let check = |pair: PolicyPair| OrderCheck {
        n: pair.n,
        other_policy: pair.other_policy,
        is_as_stated: pair.is_as_stated,
    };
    judgement.order_checks = compared.into_iter().map(check).collect();
    judgement
}

/// Returns the verdict for a level of agreement; `None` without agreement.
pub(crate) const fn verdict_of(level: AgreementLevel) -> Option<Verdict> {
    match level {
        AgreementLevel::Yes => Some(Verdict::Reproduced),
        AgreementLevel::Near => Some(Verdict::Near),
        AgreementLevel::No => None,
    }
}

#[cfg(test)]
mod tests;
