//! The actions of a run as text, for `compare` and `inspect misses`. The JSON of both holds the names as
//! `first_actions`.

use reveille_common::message::OperatorAction;

use crate::display::count_noun;

/// Maximum number of actions of a run that are named.
const MAX_NAMED: usize = 3;

/// Names the first of `actions`, with their TTIs.
pub(crate) fn name_actions(actions: &[OperatorAction]) -> Vec<String> {
    let first_actions = actions.iter().take(MAX_NAMED);
    first_actions
        .map(|action| format!("TTI {} {}", action.tti, action.change))
        .collect()
}

/// Counts `actions` and names the first of them; `None` without actions.
pub(crate) fn describe_actions(actions: &[OperatorAction]) -> Option<String> {
    let ellipsis = if actions.len() > MAX_NAMED { ", …" } else { "" };
    let names = name_actions(actions).join(", ");
    (!actions.is_empty()).then(|| format!("{}: {names}{ellipsis}", count_noun(actions.len(), "action")))
}
