//! A bare barrier over zenoh, the baseline of `reveille bench bus`. Nothing else uses its keys.
//!
//! It uses the same sessions and message sizes as the emulator, without model or codec. The base station publishes a
//! grant, every host answers from zenoh's callback, and the next grant follows when all have answered.

use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;

use anyhow::ensure;
use reveille_common::bus::{Bus, BusError, DeclarationGuard, RawTopic};
use reveille_common::ids::HostId;
use reveille_common::secret::{HostCredential, Secret};

/// Time after which a grant counts as lost.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(10);

/// The base station's side of a bare barrier.
pub(super) struct BareBarrier {
    grants: RawTopic,
    /// The number of hosts that have not answered, and the signal that all have.
    unanswered: Arc<(Mutex<usize>, Condvar)>,
    _answers: DeclarationGuard,
}

impl BareBarrier {
    /// Creates a barrier on the session of `bus`.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub(super) fn new(bus: &Bus) -> Result<Self, BusError> {
        let unanswered = Arc::new((Mutex::new(0_usize), Condvar::new()));
        let callback_unanswered = Arc::clone(&unanswered);
        let answers = bus.subscribe_raw(key(bus, "answer/*"), move |_| {
            let mut unanswered = callback_unanswered.0.lock().unwrap_or_else(PoisonError::into_inner);
            *unanswered = unanswered.saturating_sub(1);
            if *unanswered == 0 {
                callback_unanswered.1.notify_one();
            }
        })?;
        Ok(Self {
            grants: bus.publisher_raw(key(bus, "grant"))?,
            unanswered,
            _answers: answers,
        })
    }

    /// Runs one round: publishes `grant` and waits for `hosts` answers. All hosts must have subscribed before.
    ///
    /// # Errors
    /// If an answer is missing after [`ANSWER_TIMEOUT`], or zenoh refuses.
    pub(super) fn round(&self, grant: &[u8], hosts: usize) -> anyhow::Result<()> {
        let (lock, all_answered) = &*self.unanswered;
        // Set before the grant goes out, since answers can arrive before `put` returns. Unlocked during `put`: the
        // callback takes the lock.
        *lock.lock().unwrap_or_else(PoisonError::into_inner) = hosts;
        self.grants.put(grant)?;
        let unanswered = lock.lock().unwrap_or_else(PoisonError::into_inner);
        let (unanswered, _) = all_answered
            .wait_timeout_while(unanswered, ANSWER_TIMEOUT, |unanswered| *unanswered > 0)
            .unwrap_or_else(PoisonError::into_inner);
        ensure!(*unanswered == 0, "{} hosts have not answered", *unanswered);
        Ok(())
    }
}

/// Runs a host: answers every grant with `answer_size` bytes until the base station ends.
///
/// # Errors
/// If zenoh refuses.
pub(super) async fn host(bus: &Bus, number: u32, answer_size: usize) -> Result<(), BusError> {
    let answers = bus.publisher_raw(key(bus, &format!("answer/{number}")))?;
    let payload = vec![0_u8; answer_size];
    let _grants = bus.subscribe_raw(key(bus, "grant"), move |_| {
        // A failed send means that the base station has ended; `_bs_watch` notices that too.
        let _bs_ended = answers.put(&payload).is_err();
    })?;
    let credential = HostCredential {
        host: HostId(number),
        token: Secret::new([0; 16]),
    };
    // Liveliness comes last: the base station sends the first grant as soon as it sees all hosts alive.
    let _host_alive = bus.declare_alive(bus.key_exprs().host_liveliness(credential))?;
    let bs_ended = Arc::new(tokio::sync::Notify::new());
    let end_notifier = Arc::clone(&bs_ended);
    let _bs_watch = bus.watch_alive(bus.key_exprs().bs_liveliness(), move |_, is_alive| {
        if !is_alive {
            end_notifier.notify_one();
        }
    })?;
    bs_ended.notified().await;
    Ok(())
}

/// Returns a key of the bare barrier in the run of `bus`.
fn key(bus: &Bus, suffix: &str) -> String {
    format!("reveille/{}/bare/{suffix}", bus.key_exprs().run())
}
