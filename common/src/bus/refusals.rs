//! A log of refused peers for a base station with TLS. zenoh logs a failed handshake with a misleading hint, and each
//! message that it drops only at its most detailed level, together with each message that it admits. This layer picks
//! the refusals and logs them as warnings, without the secrets in keys.

use std::cell::Cell;
use std::collections::BTreeMap;
use std::fmt;
use std::sync::mpsc::{SyncSender, sync_channel};
use std::sync::{PoisonError, RwLock};

use tracing::callsite::Identifier;
use tracing::field::{Field, Visit};
use tracing::{Event, Subscriber};
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::layer::{Context, Layer};
use tracing_subscriber::registry::LookupSpan;

use crate::keys;

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
/// Different refusals that are logged; later ones are not.
const MAX_TEXTS: usize = 1_000;

thread_local! {
    /// Whether the events of this thread are permissions and not messages.
    static LISTS_PERMISSIONS: Cell<bool> = const { Cell::new(false) };
}

/// The layer of the log. It passes refusals to a thread, because an event must not cause another one.
pub struct RefusalLog {
    queue: SyncSender<String>,
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
        let (queue, refusals) = sync_channel::<String>(MAX_QUEUED_TEXTS);
        std::thread::Builder::new().name("refusals".to_owned()).spawn(move || {
            let mut counts: BTreeMap<String, u64> = BTreeMap::new();
            let mut is_full = false;
            for text in refusals {
                if counts.len() >= MAX_TEXTS && !counts.contains_key(&text) {
                    if !is_full {
                        is_full = true;
                        tracing::warn!("too many different refusals; further ones are not logged");
                    }
                    continue;
                }
                let count = counts.entry(text.clone()).or_default();
                *count += 1;
                // A client repeats a refused attempt for a while.
                if *count == 1 {
                    tracing::warn!("{text}");
                } else if count.is_power_of_two() {
                    tracing::warn!("{text} ({count} times)");
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
            Some(format!("refused a TLS connection: {cause}"))
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

/// Whether `text` is zenoh's note that a rule admitted a message. The key at its end comes from the peer, so only the
/// first verb counts.
fn is_admission(text: &str) -> bool {
    let verb = text.find(" is ").map(|start| &text[start..]);
    verb.is_some_and(|rest| rest.starts_with(" is authorized to "))
}

/// Describes a message of a peer that a rule refused: zenoh's text is `PEER[ on SUBJECT] is unauthorized to ACTION
/// (ingress) on KEY`. `None` for other texts, and for messages that the BS would have sent to the peer.
fn describe_refusal(text: &str) -> Option<String> {
    let (peer, refused) = text.split_once(" is unauthorized to ")?;
    let (action, key) = refused.split_once(" (ingress) on ")?;
    let (peer, role) = peer.split_once(" on ").unwrap_or((peer, ""));
    let peer = peer.trim_start_matches("Using cached result: ");
    let role = role
        .split_once("CertCommonName(")
        .and_then(|(_, rest)| rest.split_once(')'));
    let role = role.map_or_else(String::new, |(role, _)| {
        format!(" with a certificate of the role {role}")
    });
    let subject = match keys::classify(key) {
        Some((kind, _)) => format!("messages of kind {}", kind.name()),
        // Secrets of the run are parts of keys.
        None => key
            .split('/')
            .filter(|part| part.len() < 32)
            .collect::<Vec<_>>()
            .join("/")
            // The peer chooses the key, and must not write lines of the log.
            .replace(char::is_control, ""),
    };
    Some(format!(
        "refused by the access rules: {action} for {subject}, from peer {peer}{role}"
    ))
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
        let described = describe_refusal(&text).expect("a refusal");
        assert!(
            described.contains("Put for messages of kind plan, from peer 7f with a certificate of the role device"),
            "{described}"
        );
        let text = format!("Using cached result: 7f is unauthorized to Put (ingress) on reveille/r/@{secret}/emu/x/1");
        let described = describe_refusal(&text).expect("a refusal");
        assert!(
            described.contains("reveille/r/emu/x/1, from peer 7f") && !described.contains(&secret),
            "{described}"
        );
        let deceptive = "7f is unauthorized to Put (ingress) on x is authorized to \ny";
        assert!(!is_admission(deceptive) && is_admission("7f is authorized to Put (ingress) on x"));
        assert!(!describe_refusal(deceptive).expect("a refusal").contains('\n'));
        assert_eq!(
            describe_refusal("7f is unauthorized to Put (egress) on reveille/r/tap"),
            None
        );
        assert_eq!(
            describe_refusal("7f is authorized to Put (ingress) on reveille/r/tap"),
            None
        );
    }
}
