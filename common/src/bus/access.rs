//! What a peer may do on the bus of a run: what its part needs, and nothing else.
//!
//! The BS is a router, and all that others send passes through it. Who connects may ask for places, ask the clock, have
//! the run described and read its log of inputs, and follow the tap. A host, which was told the run's secret with its
//! places, may besides hear the clock, plans and wake-ups, and send on keys of hosts; that it sends on its own the BS
//! sees by its token. Nobody but the BS may speak for the clock, tell plans, wake devices, answer the BS's kinds of
//! questions or feed the tap. At the policy port the BS asks and anybody may answer: it believes who shows the run's
//! key. See [`crate::keys`] for why a wildcard does not help a stranger.

use crate::keys::Keys;
use crate::message::MessageKind;

/// What bounds the harm of one peer: the size of a message, how long the BS waits for one that stops reading before it
/// closes its link, and how many sessions may be in the making at once.
pub(super) const LIMITS: [(&str, &str); 3] = [
    ("transport/link/rx/max_message_size", "16777216"),
    (
        "transport/link/tx/queue/congestion_control/block/wait_before_close",
        "500000",
    ),
    ("transport/unicast/accept_pending", "2000"),
];

/// Kinds of messages that the BS alone sends to hosts.
const DOWN: [MessageKind; 2] = [MessageKind::Clock, MessageKind::Plan];
/// Kinds of messages that hosts send to the BS.
const UP: [MessageKind; 2] = [MessageKind::Report, MessageKind::Answer];
/// Queries that the BS answers.
const QUERIES: [MessageKind; 5] = [
    MessageKind::Join,
    MessageKind::Ready,
    MessageKind::Control,
    MessageKind::Describe,
    MessageKind::Log,
];

/// zenoh's configuration of access to the run with these `keys`.
pub(super) fn rules(keys: &Keys) -> String {
    let down: Vec<String> = DOWN.iter().map(|&kind| keys.to_all(kind)).collect();
    let wake = format!("{}/*/*", keys.of(MessageKind::Wake));
    let up: Vec<String> = UP.iter().map(|&kind| keys.uplinks(kind)).collect();
    let queries: Vec<String> = QUERIES.iter().map(|&kind| keys.of(kind)).collect();
    let heard = [&down[..], &[wake, keys.tap()]].concat();
    let (hosts, bs) = (vec![keys.all_alive()], vec![keys.bs_alive()]);
    let policy = vec![keys.policy()];
    let any_bs = vec![Keys::any_bs().to_owned(), keys.bs_alive()];
    let rules = [
        rule("send", "ingress", &["put"], &up),
        rule("hear", "ingress", &["declare_subscriber"], &heard),
        rule("live", "ingress", &["liveliness_token"], &hosts),
        rule(
            "look",
            "ingress",
            &["declare_liveliness_subscriber", "liveliness_query"],
            &any_bs,
        ),
        rule("ask", "ingress", &["query"], &queries),
        rule("decide", "ingress", &["declare_queryable", "reply"], &policy),
        rule("decision", "egress", &["query"], &policy),
        rule("told", "egress", &["put"], &heard),
        rule("wanted", "egress", &["declare_subscriber"], &up),
        rule("answered", "egress", &["declare_queryable", "reply"], &queries),
        rule("alive", "egress", &["liveliness_token"], &bs),
    ];
    let ids: Vec<String> = rules.iter().map(|(id, _)| format!("{id:?}")).collect();
    let rules: Vec<String> = rules.into_iter().map(|(_, rule)| rule).collect();
    format!(
        "{{enabled: true, default_permission: \"deny\", rules: [{}], subjects: [{{id: \"anyone\"}}], \
         policies: [{{rules: [{}], subjects: [\"anyone\"]}}]}}",
        rules.join(", "),
        ids.join(", ")
    )
}

fn rule(id: &'static str, flow: &str, messages: &[&str], keys: &[String]) -> (&'static str, String) {
    let text = format!(
        "{{id: {id:?}, permission: \"allow\", flows: [{flow:?}], messages: {messages:?}, key_exprs: {keys:?}}}"
    );
    (id, text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::message::{Access, Plane};
    use crate::secret::Secret;

    #[test]
    fn every_kind_that_crosses_the_bus_has_its_rule() {
        let listed: Vec<MessageKind> = DOWN.iter().chain(&UP).chain(&QUERIES).copied().collect();
        for &kind in MessageKind::ALL {
            let is_ruled = listed.contains(&kind) || kind == MessageKind::Wake;
            assert_eq!(is_ruled, kind.plane() != Plane::Truth, "{kind:?}");
            let is_query = kind.access() == Access::Anyone || kind == MessageKind::Ready;
            assert_eq!(is_query, QUERIES.contains(&kind), "{kind:?}");
        }
    }

    #[test]
    fn zenoh_takes_the_rules() {
        let keys = Keys::of_members("r1".parse().expect("a name"), Secret::new([7; 16]));
        let mut config = zenoh::Config::default();
        config
            .insert_json5("access_control", &rules(&keys))
            .expect("a configuration");
        for (key, value) in LIMITS {
            config.insert_json5(key, value).expect(key);
        }
    }
}
