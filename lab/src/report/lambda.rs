//! The claims on λ (Figs. 13 and 14): from which λ on a device harvests more than it spends.
//!
//! As in the paper, consumption is held fixed at what the policies spend in the tables (Fig. 8) while λ varies.

use super::judge::{Verdict, within};
use super::words::{number, plain, plus_minus};
use super::{Column, Line, Ours};
use crate::analysis::harvest::{Reading, STATED, Stated, positive_net};
use crate::figures::energy::consumption;
use crate::figures::results::Setting;
use crate::stats::Estimate;

/// Which end of the paper's range of λ.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum End {
    /// For the policy that spends least.
    Least,
    /// For the policy that spends most.
    Most,
}

/// All claims on λ.
pub fn lines(columns: &[Column<'_>]) -> Vec<Line> {
    let mut lines = Vec::new();
    for stated in &STATED {
        for (end, value) in [(End::Least, stated.low), (End::Most, stated.high)] {
            if !value.is_nan() {
                lines.push(line(stated, end, value, columns));
            }
        }
    }
    lines.sort_by_key(|line| line.source);
    lines
}

fn line(stated: &Stated, end: End, value: f64, columns: &[Column<'_>]) -> Line {
    let ours = |column: &Column<'_>| {
        let spent = column.setting.and_then(|setting| spent(setting, stated.devices, end));
        match spent {
            Some((policy, spent)) => judge(stated.e_b, value, &policy, &spent),
            None => Ours {
                found: String::new(),
                verdict: Verdict::NotRun,
                firm: true,
                why: format!(
                    "It takes runs of two policies or more with N = {}, the genie aside.",
                    stated.devices
                ),
            },
        }
    };
    Line {
        source: stated.source,
        about: format!("λ above which net energy is positive, E_B = {}", stated.e_b),
        policy: match end {
            End::Least => "the one that spends least".to_owned(),
            End::Most => "the one that spends most".to_owned(),
        },
        sites: format!("N = {}", stated.devices),
        paper: format!("≈ {}", plain(value)),
        ours: columns.iter().map(ours).collect(),
    }
}

fn spent(setting: &Setting, n: u32, end: End) -> Option<(String, Estimate)> {
    let [least, most] = consumption(setting, n)?;
    Some(match end {
        End::Least => least,
        End::Most => most,
    })
}

fn judge(e_b: f64, stated: f64, policy: &str, spent: &Estimate) -> Ours {
    let threshold =
        |spent: f64| positive_net(Reading::Eq5, e_b, spent.max(f64::MIN_POSITIVE), 1.0).map(|(from, _)| from);
    let (low, high) = (
        threshold(spent.mean - spent.half_width),
        threshold(spent.mean + spent.half_width),
    );
    let Some(found) = threshold(spent.mean) else {
        let most = e_b * Reading::Eq5.probability(1.0, 1.0);
        return Ours {
            found: format!("never ({policy})"),
            verdict: Verdict::NotReproduced,
            firm: low.is_none(),
            why: format!(
                "{policy} spends {} units, and under Eq. (5) no λ brings more than E_B/e = {}. The paper's values fit a harvest \
                 of about λ·E_B, which λ·exp(-λ)·E_B is for small λ only.",
                number(spent.mean),
                number(most)
            ),
        };
    };
    let fits = within(found, stated, stated);
    let measured = match (low, high) {
        (Some(low), Some(high)) => plus_minus(found, 0.5 * (high - low)),
        (Some(_) | None, None) | (None, Some(_)) => format!("{}, perhaps never", number(found)),
    };
    let firm = low
        .zip(high)
        .is_some_and(|(a, b)| within(a, stated, stated) == fits && within(b, stated, stated) == fits);
    let doubt = if firm {
        ""
    } else {
        " Our interval reaches across the border of this verdict: more runs would decide."
    };
    let why = if fits {
        doubt.trim_start().to_owned()
    } else {
        let needed = e_b * Reading::Eq5.probability(stated, 1.0);
        format!(
            "{policy} spends {} units here; the paper's λ stands for a consumption of {}.{doubt}",
            number(spent.mean),
            number(needed)
        )
    };
    Ours {
        found: format!("{measured} ({policy})"),
        verdict: if fits {
            Verdict::Reproduced
        } else {
            Verdict::NotReproduced
        },
        firm,
        why,
    }
}
