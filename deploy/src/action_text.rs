//! The actions of a run as text, for reports on finished runs.

use reveille_common::message::OperatorAction;

use crate::display::count_noun;

/// Most actions of a run that are named.
const MAX_NAMED: usize = 3;

/// Names the first of `actions`, with their TTIs.
pub(crate) fn name_actions(actions: &[OperatorAction]) -> Vec<String> {
    let named = actions.iter().take(MAX_NAMED);
    named
        .map(|action| format!("TTI {} {}", action.tti, action.change))
        .collect()
}

/// Counts `actions` and names the first of them; `None` without actions.
pub(crate) fn describe_actions(actions: &[OperatorAction]) -> Option<String> {
    let more = if actions.len() > MAX_NAMED { ", …" } else { "" };
    let names = name_actions(actions).join(", ");
    (!actions.is_empty()).then(|| format!("{}: {names}{more}", count_noun(actions.len(), "action")))
}
