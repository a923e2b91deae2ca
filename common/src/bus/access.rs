//! Access control on the bus of a run: a peer has only the rights that its role needs. A new kind of message that
//! crosses the bus needs an entry in one of the lists below.
//!
//! The BS is a router, and all messages of others pass through it. Any client may send join requests, clock controls,
//! actions and queries for the run's description and input log, and may follow the tap. A host receives the run's
//! secret with its assignment. With it, the host may also receive clock messages, plans and wake-ups, and send on keys
//! of hosts; the token in its credential identifies it to the BS. Only the BS may send clock messages, plans and
//! wake-ups, answer its own kinds of queries, or feed the tap. At the policy port the BS asks and any client may
//! answer. Over TLS, each of these rights also needs a certificate of the role that uses it ([`Role`]).
//!
//! No rule checks the run's key or a host's token: the handlers in `bs/src/server/` do. See [`crate::keys`] for why a
//! wildcard does not help an outsider. `tests/untrusted_clients/`, `tests/program/hostile_peer.rs` and `tls.rs` try the
//! rules on a running base station; the test below only compares the lists with [`MessageKind`].
//!
//! A router (`router`) has a link towards the BS, and may have many others. On its other links it applies the rules of
//! the BS. On the link towards the BS the directions are swapped: only there do clock messages, plans and wake-ups come
//! in. The BS treats a router as any client, so a router has no right beyond the rights of the peers behind it. zenoh
//! identifies the link towards the BS by the id of the session at its other end, which a peer can claim while that
//! session is absent: routers belong in networks that the operator trusts.

use super::tls::Role;
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

/// The flow from a peer to this session.
const INGRESS: &str = "ingress";
/// The flow from this session to a peer.
const EGRESS: &str = "egress";

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

/// Roles whose certificates allow to follow the run.
const WATCHERS: [Role; 2] = [Role::Observer, Role::Operator];
/// Roles of all peers of the BS. A router has the rights of all peers, since it forwards their messages.
const PEERS: [Role; 5] = [Role::Device, Role::Observer, Role::Operator, Role::Policy, Role::Router];

/// Returns the roles that may send queries of `kind` over TLS.
const fn roles_with_query(kind: MessageKind) -> &'static [Role] {
    if matches!(kind, MessageKind::Join | MessageKind::Ready) {
        &[Role::Device]
    } else if matches!(kind, MessageKind::Act) {
        &[Role::Operator]
    } else {
        // The status of the clock is for all that follow the run; other commands to it need the run's key.
        &WATCHERS
    }
}

/// Returns zenoh's access configuration of the run with these `keys`: of the BS, or of a router whose link towards the
/// BS ends at the session with the id `upstream`. If peers have certificates, each has only the rights of its role;
/// otherwise any peer has the rights of all roles.
pub(super) fn access_config(keys: &KeyExprs, has_certificates: bool, upstream: Option<&str>) -> String {
    let rules = rules(keys);
    // zenoh's subjects are static, so no single host can be named. Secrets in the keys tell hosts apart. A peer may do
    // what any of its subjects may do.
    let mut policies = Vec::new();
    let mut subjects = Vec::new();
    let mut add = |name: &str, condition: &str, ids: Vec<String>| {
        subjects.push(format!("{{id: {name:?}{condition}}}"));
        policies.push(format!("{{rules: {ids:?}, subjects: [{name:?}]}}"));
    };
    if has_certificates {
        for role in PEERS {
            let allowed = rules.iter().filter(|rule| rule.allows(role));
            let condition = format!(", cert_common_names: [{:?}]", role.name());
            add(role.name(), &condition, allowed.map(|rule| rule.id.clone()).collect());
        }
    } else {
        add("anyone", "", rules.iter().map(|rule| rule.id.clone()).collect());
    }
    let mut all_rules: Vec<String> = rules.iter().map(Rule::text).collect();
    if let Some(session_id) = upstream {
        let swapped: Vec<Rule> = rules.iter().map(Rule::swapped).collect();
        let roles = [Role::Bs, Role::Router].map(Role::name);
        let condition = if has_certificates {
            format!(", zids: [{session_id:?}], cert_common_names: {roles:?}")
        } else {
            format!(", zids: [{session_id:?}]")
        };
        add(
            "upstream",
            &condition,
            swapped.iter().map(|rule| rule.id.clone()).collect(),
        );
        all_rules.extend(swapped.iter().map(Rule::text));
    }
    format!(
        "{{enabled: true, default_permission: \"deny\", rules: [{}], subjects: [{}], policies: [{}]}}",
        all_rules.join(", "),
        subjects.join(", "),
        policies.join(", ")
    )
}

/// A rule that allows messages on some keys in one direction, for peers of some roles.
struct Rule {
    roles: &'static [Role],
    id: String,
    flow: &'static str,
    messages: &'static [&'static str],
    keys: Vec<String>,
}

impl Rule {
    fn new(
        roles: &'static [Role],
        flow: &'static str,
        id: &str,
        messages: &'static [&'static str],
        keys: &[String],
    ) -> Self {
        Self {
            roles,
            id: format!("{id}_{flow}"),
            flow,
            messages,
            keys: keys.to_vec(),
        }
    }

    fn allows(&self, role: Role) -> bool {
        role == Role::Router || self.roles.contains(&role)
    }

    /// Returns this rule for the link towards the BS, with the other direction.
    fn swapped(&self) -> Self {
        let flow = if self.flow == INGRESS { EGRESS } else { INGRESS };
        Self {
            id: format!("{}_upstream", self.id),
            keys: self.keys.clone(),
            flow,
            ..*self
        }
    }

    /// Returns zenoh's configuration of the rule.
    fn text(&self) -> String {
        let Self {
            id,
            flow,
            messages,
            keys,
            ..
        } = self;
        format!("{{id: {id:?}, permission: \"allow\", flows: [{flow:?}], messages: {messages:?}, key_exprs: {keys:?}}}")
    }
}

/// Returns the rules of the run with these `keys`, for the links of the BS.
fn rules(keys: &KeyExprs) -> Vec<Rule> {
    const SUBSCRIBE: &[&str] = &["declare_subscriber"];
    const REPLIES: &[&str] = &["declare_queryable", "reply"];
    const TOKEN: &[&str] = &["liveliness_token"];
    let mut bs_to_hosts: Vec<String> = BS_TO_HOSTS.iter().map(|&kind| keys.to_all_hosts(kind)).collect();
    bs_to_hosts.push(format!("{}/*/*", keys.base_key(MessageKind::Wake)));
    let hosts_to_bs: Vec<String> = HOSTS_TO_BS.iter().map(|&kind| keys.uplinks(kind)).collect();
    let tap = [keys.tap()];
    let (host_liveliness, bs_liveliness) = ([keys.all_host_liveliness()], [keys.bs_liveliness()]);
    let visible_liveliness = [KeyExprs::all_bs_liveliness().to_owned(), keys.bs_liveliness()];
    let policy_port = [keys.policy_port()];
    let (hosts, policies) = (&[Role::Device], &[Role::Policy]);
    let mut rules = vec![
        Rule::new(hosts, INGRESS, "host_messages", &["put"], &hosts_to_bs),
        Rule::new(hosts, EGRESS, "host_messages", SUBSCRIBE, &hosts_to_bs),
        Rule::new(hosts, INGRESS, "bs_messages", SUBSCRIBE, &bs_to_hosts),
        Rule::new(hosts, EGRESS, "bs_messages", &["put"], &bs_to_hosts),
        Rule::new(&WATCHERS, INGRESS, "tap", SUBSCRIBE, &tap),
        Rule::new(&WATCHERS, EGRESS, "tap", &["put"], &tap),
        Rule::new(hosts, INGRESS, "host_tokens", TOKEN, &host_liveliness),
        Rule::new(
            &PEERS,
            INGRESS,
            "bs_token",
            &["declare_liveliness_subscriber", "liveliness_query"],
            &visible_liveliness,
        ),
        Rule::new(&PEERS, EGRESS, "bs_token", TOKEN, &bs_liveliness),
        Rule::new(policies, INGRESS, "policy", REPLIES, &policy_port),
        Rule::new(policies, EGRESS, "policy", &["query"], &policy_port),
    ];
    for kind in BS_QUERIES {
        let (roles, key) = (roles_with_query(kind), [keys.base_key(kind)]);
        rules.push(Rule::new(roles, INGRESS, kind.name(), &["query"], &key));
        rules.push(Rule::new(roles, EGRESS, kind.name(), REPLIES, &key));
    }
    rules
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
