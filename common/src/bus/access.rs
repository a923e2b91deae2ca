//! Access control on the bus of a run: a peer has only the rights that its role needs. A new kind of message that
//! crosses the bus needs an entry in one of the lists below.
//!
//! The BS is a router, and all messages of others pass through it. Any client may send join requests, clock controls,
//! actions and queries for the run's description and input log, and may follow the tap. A host receives the run's
//! secret with its assignment. With it, the host may also receive clock messages, plans and wake-ups, and send on keys
//! of hosts; the token in its credential identifies it to the BS. Only the BS may send clock messages, plans and
//! wake-ups, answer its own kinds of queries, or feed the tap. At the policy port the BS asks and any client may
//! answer. No rule checks the run's key or a host's token: the handlers in `bs/src/server/` do. See [`crate::keys`] for
//! why a wildcard does not help an outsider. `tests/untrusted_clients/` and `tests/program/hostile_peer.rs` try the
//! rules on a running base station; the test below only compares the lists with [`MessageKind`].

use crate::keys::KeyExprs;
use crate::message::MessageKind;

/// Limits on the harm that one peer can do: the size in bytes of a message to the BS, the wait in microseconds for a
/// peer that stops reading before the BS closes its link, and the number of sessions that open simultaneously. A larger
/// message does not arrive, so the size also bounds the number of devices whose ledgers one host can send.
pub(super) const PEER_LIMITS: [(&str, &str); 3] = [
    ("transport/link/rx/max_message_size", "16777216"),
    (
        "transport/link/tx/queue/congestion_control/block/wait_before_close",
        "500000",
    ),
    ("transport/unicast/accept_pending", "2000"),
];

/// Kinds of messages that the BS sends to all hosts. Wake-ups, each to one host, have keys of another form.
const BS_TO_HOSTS: [MessageKind; 2] = [MessageKind::Clock, MessageKind::Plan];
/// Kinds of messages that hosts send to the BS.
const HOSTS_TO_BS: [MessageKind; 2] = [MessageKind::Report, MessageKind::Answer];
/// Kinds of queries that the BS answers; only the key of `Ready` has the run's secret, which hosts know.
const BS_QUERIES: [MessageKind; 6] = [
    MessageKind::Join,
    MessageKind::Ready,
    MessageKind::Control,
    MessageKind::Describe,
    MessageKind::Log,
    MessageKind::Act,
];

/// Returns zenoh's access configuration of the run with these `keys`.
pub(super) fn access_config(keys: &KeyExprs) -> String {
    let bs_to_hosts: Vec<String> = BS_TO_HOSTS.iter().map(|&kind| keys.to_all_hosts(kind)).collect();
    let wake_key = format!("{}/*/*", keys.base_key(MessageKind::Wake));
    let hosts_to_bs: Vec<String> = HOSTS_TO_BS.iter().map(|&kind| keys.uplinks(kind)).collect();
    let query_keys: Vec<String> = BS_QUERIES.iter().map(|&kind| keys.base_key(kind)).collect();
    let sent_to_peers = [&bs_to_hosts[..], &[wake_key, keys.tap()]].concat();
    let (host_liveliness, bs_liveliness) = (vec![keys.all_host_liveliness()], vec![keys.bs_liveliness()]);
    let policy_port = vec![keys.policy_port()];
    let visible_liveliness = vec![KeyExprs::all_bs_liveliness().to_owned(), keys.bs_liveliness()];
    // Ingress is the flow from a peer to the BS, egress the flow from the BS to a peer. The ids occur only here.
    let rules = [
        rule("host_messages_in", "ingress", &["put"], &hosts_to_bs),
        rule("subscriptions_in", "ingress", &["declare_subscriber"], &sent_to_peers),
        rule("host_tokens_in", "ingress", &["liveliness_token"], &host_liveliness),
        rule(
            "token_queries_in",
            "ingress",
            &["declare_liveliness_subscriber", "liveliness_query"],
            &visible_liveliness,
        ),
        rule("queries_in", "ingress", &["query"], &query_keys),
        rule("policy_in", "ingress", &["declare_queryable", "reply"], &policy_port),
        rule("policy_out", "egress", &["query"], &policy_port),
        rule("bs_messages_out", "egress", &["put"], &sent_to_peers),
        rule("subscriptions_out", "egress", &["declare_subscriber"], &hosts_to_bs),
        rule("replies_out", "egress", &["declare_queryable", "reply"], &query_keys),
        rule("bs_token_out", "egress", &["liveliness_token"], &bs_liveliness),
    ];
    let ids: Vec<String> = rules.iter().map(|(id, _)| format!("{id:?}")).collect();
    let rule_texts: Vec<String> = rules.into_iter().map(|(_, text)| text).collect();
    // zenoh's subjects are static, so no single host can be named. One subject covers all; secrets in the keys tell
    // hosts apart.
    format!(
        "{{enabled: true, default_permission: \"deny\", rules: [{}], subjects: [{{id: \"anyone\"}}], \
         policies: [{{rules: [{}], subjects: [\"anyone\"]}}]}}",
        rule_texts.join(", "),
        ids.join(", ")
    )
}

/// Returns `id` and zenoh's configuration of a rule that allows `messages` on `keys` in the direction `flow`.
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

    #[test]
    fn every_kind_that_crosses_the_bus_has_an_access_rule() {
        let kinds_with_rules: Vec<MessageKind> = BS_TO_HOSTS
            .iter()
            .chain(&HOSTS_TO_BS)
            .chain(&BS_QUERIES)
            .copied()
            .collect();
        for &kind in MessageKind::ALL {
            // Wake-ups have a separate rule, since each is sent to one host.
            let has_rule = kinds_with_rules.contains(&kind) || kind == MessageKind::Wake;
            assert_eq!(has_rule, kind.plane() != Plane::Truth, "{kind:?}");
            let is_query = kind.access() == Access::Anyone || kind == MessageKind::Ready;
            assert_eq!(is_query, BS_QUERIES.contains(&kind), "{kind:?}");
        }
    }
}
