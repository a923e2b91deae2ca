//! A log of refused peers for a base station with TLS. zenoh logs a failed handshake with a misleading hint, and each
//! message that it drops only at its most detailed level, together with each message that it admits. This layer picks
//! the refusals and logs them as warnings, without the secrets in keys.
//!
//! After a restart of the base station, its hosts reconnect with the secret of the former one, until they join again.
//! Each host then causes several refusals. The log shows the first refusal of each peer, then the number of all.

use std::cell::Cell;
use std::collections::BTreeMap;
use std::fmt;
use std::sync::mpsc::{RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{PoisonError, RwLock};
use std::time::Duration;

use tracing::callsite::Identifier;
use tracing::field::{Field, Visit};
use tracing::{Event, Subscriber};
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::layer::{Context, Layer};
use tracing_subscriber::registry::LookupSpan;

use super::tls::Role;
use crate::keys;
use crate::message::MessageKind;

/// zenoh's module that accepts TLS connections.
const TLS_LISTENER: &str = "zenoh_link_tls::unicast";
/// zenoh's module that applies the rules of `access`.
const ACCESS_CONTROL: &str = "zenoh::net::routing::interceptor::access_control";
/// Start of zenoh's note that the permissions for a declared key follow, each with the text of an actual message.
const PERMISSIONS_FOLLOW: &str = "ACL (ingress): caching permissions";
/// Part of the last of these permissions.
const LAST_PERMISSION: &str = " Declare Liveliness Subscriber (ingress) on ";
/// Refusals that can wait for the thread of the log.
const MAX_QUEUED_TEXTS: usize = 1_024;
/// Most different refusals that are logged, and most peers whose first refusal is logged; later ones are not.
const MAX_TEXTS: usize = 1_000;
/// The number of refusals of a peer from which powers of two are logged. A host has fewer at a rejoin.
const MANY_REFUSALS: u64 = 256;
/// Time without a refusal after which the number of refusals of each host is logged.
const QUIET_TIME: Duration = Duration::from_secs(5);
/// zenoh's name for the declaration of a liveliness token.
const TOKEN: &str = "Liveliness Token";

thread_local! {
    /// Whether the events of this thread are permissions and not messages.
    static LISTS_PERMISSIONS: Cell<bool> = const { Cell::new(false) };
}

/// The layer of the log. It passes refusals to a thread, because an event must not cause another one.
pub struct RefusalLog {
    queue: SyncSender<Refusal>,
    /// The places in zenoh that log admitted messages, whose events are not formatted again.
    admissions: RwLock<Vec<Identifier>>,
}

impl RefusalLog {
    /// Starts the thread of the log and returns its layer, with its filter.
    ///
    /// # Errors
    /// If the thread cannot be started.
    pub fn start<S>() -> std::io::Result<impl Layer<S> + Send + Sync>
    where
        S: Subscriber + for<'a> LookupSpan<'a>,
    {
        let (queue, refusals) = sync_channel(MAX_QUEUED_TEXTS);
        std::thread::Builder::new().name("refusals".to_owned()).spawn(move || {
            let mut counts = RefusalCounts::default();
            loop {
                let received = if counts.hosts.is_empty() {
                    refusals.recv().map_err(RecvTimeoutError::from)
                } else {
                    refusals.recv_timeout(QUIET_TIME)
                };
                match received {
                    Ok(refusal) => {
                        if let Some(line) = counts.add(refusal) {
                            tracing::warn!("{line}");
                        }
                    }
                    Err(RecvTimeoutError::Timeout) => {
                        for line in counts.take_host_lines() {
                            tracing::warn!("{line}");
                        }
                    }
                    Err(RecvTimeoutError::Disconnected) => return,
                }
            }
        })?;
        let layer = Self {
            queue,
            admissions: RwLock::default(),
        };
        let filter = Targets::new()
            .with_target(TLS_LISTENER, LevelFilter::WARN)
            .with_target(ACCESS_CONTROL, LevelFilter::TRACE);
        Ok(layer.with_filter(filter))
    }

    fn is_admission(&self, place: &Identifier) -> bool {
        let admissions = self.admissions.read().unwrap_or_else(PoisonError::into_inner);
        admissions.contains(place)
    }
}

impl<S: Subscriber> Layer<S> for RefusalLog {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        let place = event.metadata().callsite();
        let lists_permissions = LISTS_PERMISSIONS.get();
        if !lists_permissions && self.is_admission(&place) {
            return;
        }
        let mut message = Message::default();
        event.record(&mut message);
        if lists_permissions || message.0.starts_with(PERMISSIONS_FOLLOW) {
            LISTS_PERMISSIONS.set(!message.0.contains(LAST_PERMISSION));
            return;
        }
        let refusal = if event.metadata().target() == TLS_LISTENER {
            let cause = message.0.split(". Hint:").next().unwrap_or_default();
            Some(Refusal {
                text: format!("refused a TLS connection: {cause}"),
                host_peer: None,
            })
        } else if is_admission(&message.0) {
            let mut admissions = self.admissions.write().unwrap_or_else(PoisonError::into_inner);
            admissions.push(place);
            None
        } else {
            describe_refusal(&message.0)
        };
        if let Some(refusal) = refusal {
            // Never waits: a peer that floods the base station loses entries of the log.
            let _no_room = self.queue.try_send(refusal).is_err();
        }
    }
}

/// A refusal to log.
#[derive(Debug, PartialEq, Eq)]
struct Refusal {
    text: String,
    /// The peer, if it may do this with the secret of the run: it is a host of an earlier base station, or a stranger
    /// that tries a secret.
    host_peer: Option<String>,
}

/// The refusals so far.
#[derive(Default)]
struct RefusalCounts {
    texts: BTreeMap<String, u64>,
    /// Whether a text was left out.
    is_full: bool,
    /// The number of refusals of each [`Refusal::host_peer`] since the last quiet time.
    hosts: BTreeMap<String, u64>,
    /// The number of first refusals that were logged for them.
    logged_hosts: usize,
}

impl RefusalCounts {
    /// Counts a refusal and returns the line to log for it, if any.
    fn add(&mut self, Refusal { text, host_peer }: Refusal) -> Option<String> {
        if let Some(peer) = host_peer
            && (self.logged_hosts < MAX_TEXTS || self.hosts.contains_key(&peer))
        {
            let count = self.hosts.entry(peer).or_default();
            *count += 1;
            if *count == 1 {
                self.logged_hosts += 1;
                let note =
                    "the peer lacks the role or the secret of the run; hosts of an earlier base station join again";
                return Some(format!("{text}: {note}"));
            }
            // A stranger never stops.
            return (*count >= MANY_REFUSALS && count.is_power_of_two())
                .then(|| format!("{text} (refusal {count} of this peer)"));
        }
        if self.texts.len() >= MAX_TEXTS && !self.texts.contains_key(&text) {
            let is_first = !std::mem::replace(&mut self.is_full, true);
            return is_first.then(|| "too many different refusals; further ones are not logged".to_owned());
        }
        let count = self.texts.entry(text.clone()).or_default();
        *count += 1;
        // A client repeats a refused attempt for a while.
        if *count == 1 {
            Some(text)
        } else {
            count.is_power_of_two().then(|| format!("{text} ({count} times)"))
        }
    }

    /// Returns the lines with the number of refusals of each host with several, and forgets the hosts.
    fn take_host_lines(&mut self) -> Vec<String> {
        let hosts = std::mem::take(&mut self.hosts).into_iter();
        let several = hosts.filter(|(_, count)| *count > 1);
        several
            .map(|(peer, count)| format!("refused by the access rules: {count} messages in all, from peer {peer}"))
            .collect()
    }
}

/// Whether `text` is zenoh's note that a rule admitted a message. The key at its end comes from the peer, so only the
/// first verb counts.
fn is_admission(text: &str) -> bool {
    let verb = text.find(" is ").map(|start| &text[start..]);
    verb.is_some_and(|rest| rest.starts_with(" is authorized to "))
}

/// Describes a message of a peer that a rule refused: zenoh's text is `PEER[ on SUBJECT] is unauthorized to ACTION
/// (ingress) on KEY`. `None` for other texts, and for messages that the BS would have sent to the peer.
fn describe_refusal(text: &str) -> Option<Refusal> {
    let (peer, refused) = text.split_once(" is unauthorized to ")?;
    let (action, key) = refused.split_once(" (ingress) on ")?;
    let (peer, role) = peer.split_once(" on ").unwrap_or((peer, ""));
    let peer = peer.trim_start_matches("Using cached result: ");
    let role = role
        .split_once("CertCommonName(")
        .and_then(|(_, rest)| rest.split_once(')'));
    let role = role.map(|(role, _)| role);
    let kind = keys::classify(key).map(|(kind, _)| kind);
    let subject = match kind {
        Some(kind) => format!("messages of kind {}", kind.name()),
        // Secrets of the run are parts of keys.
        None => key
            .split('/')
            .filter(|part| part.len() < 32)
            .collect::<Vec<_>>()
            .join("/")
            // The peer chooses the key, and must not write lines of the log.
            .replace(char::is_control, ""),
    };
    let may_be_host = role.is_none_or(|role| role == Role::Device.name()) && is_right_of_hosts(action, kind);
    let role = role.map_or_else(String::new, |role| format!(" with a certificate of the role {role}"));
    Some(Refusal {
        text: format!("refused by the access rules: {action} for {subject}, from peer {peer}{role}"),
        host_peer: may_be_host.then(|| peer.to_owned()),
    })
}

/// Whether the rules of `access` allow hosts with the secret of the run this action on messages of `kind`.
fn is_right_of_hosts(action: &str, kind: Option<MessageKind>) -> bool {
    use MessageKind::{Answer, Clock, Plan, Ready, Report, Wake};
    match action {
        "Declare Subscriber" => matches!(kind, Some(Clock | Plan | Wake)),
        "Put" => matches!(kind, Some(Report | Answer)),
        "Query" => kind == Some(Ready),
        _ => action == TOKEN,
    }
}

/// The message of an event.
#[derive(Default)]
struct Message(String);

impl Visit for Message {
    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        if field.name() == "message" {
            self.0 = format!("{value:?}");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refusal_names_the_kind_and_no_secret() {
        let secret = "ab".repeat(16);
        let peer = "7f on Interface(lo)+CertCommonName(device)+Transport(Tls)+7f";
        let text = format!("{peer} is unauthorized to Put (ingress) on reveille/r/@{secret}/air/plan/*");
        let described = describe_refusal(&text).expect("a refusal").text;
        assert!(
            described.contains("Put for messages of kind plan, from peer 7f with a certificate of the role device"),
            "{described}"
        );
        let text = format!("Using cached result: 7f is unauthorized to Put (ingress) on reveille/r/@{secret}/emu/x/1");
        let described = describe_refusal(&text).expect("a refusal").text;
        assert!(
            described.contains("reveille/r/emu/x/1, from peer 7f") && !described.contains(&secret),
            "{described}"
        );
        let deceptive = "7f is unauthorized to Put (ingress) on x is authorized to \ny";
        assert!(!is_admission(deceptive) && is_admission("7f is authorized to Put (ingress) on x"));
        assert!(!describe_refusal(deceptive).expect("a refusal").text.contains('\n'));
        assert_eq!(
            describe_refusal("7f is unauthorized to Put (egress) on reveille/r/tap"),
            None
        );
        assert_eq!(
            describe_refusal("7f is authorized to Put (ingress) on reveille/r/tap"),
            None
        );
    }

    #[test]
    fn refusals_of_a_former_host_are_one_line_and_their_number() {
        let secret = "ab".repeat(16);
        let refuse = |counts: &mut RefusalCounts, role: &str, action: &str, key: &str| {
            let subject = format!("7f on Interface(lo)+CertCommonName({role})+Transport(Tls)+7f");
            let text = format!("{subject} is unauthorized to {action} (ingress) on reveille/r/@{secret}/{key}");
            counts.add(describe_refusal(&text).expect("a refusal"))
        };
        let rejoin = [
            ("Declare Subscriber", "emu/clock"),
            ("Declare Subscriber", "air/plan"),
            ("Declare Subscriber", "air/wake/7/*"),
            ("Liveliness Token", "emu/alive/7"),
            ("Query", "emu/ready"),
            ("Put", "emu/answer/7"),
        ];
        let mut counts = RefusalCounts::default();
        for outage in 0..2 {
            let lines: Vec<_> = rejoin
                .iter()
                .filter_map(|(action, key)| refuse(&mut counts, "device", action, key))
                .collect();
            assert_eq!(lines.len(), 1, "outage {outage}: {lines:?}");
            assert!(
                lines[0].contains("from peer 7f with a certificate of the role device"),
                "{lines:?}"
            );
            let last = counts.take_host_lines();
            assert_eq!(last, ["refused by the access rules: 6 messages in all, from peer 7f"]);
        }
        let tries = (0..1000).filter_map(|_| refuse(&mut counts, "device", "Query", "emu/ready"));
        assert_eq!(tries.count(), 3, "the first, 256 and 512");
        counts.take_host_lines();
        // Hosts never send these, and an observer has none of the rights above.
        for (role, action, key) in [
            ("device", "Put", "emu/clock"),
            ("device", "Declare Subscriber", "emu/answer/7"),
            ("observer", "Declare Subscriber", "air/plan"),
            ("observer", "Query", "emu/ready"),
        ] {
            assert!(
                refuse(&mut counts, role, action, key).is_some(),
                "{role}: {action} {key}"
            );
        }
        assert!(counts.take_host_lines().is_empty());
    }
}
