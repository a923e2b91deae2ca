//! A barrier over zenoh and nothing else: what `reveille bench bus` compares the emulator with.
//!
//! The same sessions and the same message sizes, no model, no codec: the BS publishes a tick, every host answers from
//! zenoh's callback, and the next tick follows when all have answered.

use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;

use zenoh::Wait;
use zenoh::qos::CongestionControl;
use zenoh::sample::Sample;

use super::{Bus, BusError};
use crate::ids::HostId;

/// How long a tick may take before it counts as lost.
const PATIENCE: Duration = Duration::from_secs(10);

/// The BS's side of a bare barrier.
pub struct BareBarrier {
    publisher: zenoh::pubsub::Publisher<'static>,
    waiting: Arc<(Mutex<usize>, Condvar)>,
    _answers: super::Declared,
}

impl BareBarrier {
    /// A barrier on the session of `bus`.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn new(bus: &Bus) -> Result<Self, BusError> {
        let (tick, answer) = keys(bus);
        let waiting = Arc::new((Mutex::new(0_usize), Condvar::new()));
        let seen = Arc::clone(&waiting);
        let on_answer = move |_: Sample| {
            let mut waiting = seen.0.lock().unwrap_or_else(PoisonError::into_inner);
            *waiting = waiting.saturating_sub(1);
            if *waiting == 0 {
                seen.1.notify_one();
            }
        };
        let answers = bus
            .session
            .declare_subscriber(format!("{answer}/*"))
            .callback(on_answer)
            .wait()?;
        let publisher = bus
            .session
            .declare_publisher(tick)
            .congestion_control(CongestionControl::Block)
            .wait()?;
        Ok(Self {
            publisher,
            waiting,
            _answers: super::Declared::new(answers),
        })
    }

    /// One round: publishes `tick` and waits for `hosts` answers.
    ///
    /// # Errors
    /// If not all come.
    pub fn round(&self, tick: &[u8], hosts: usize) -> Result<(), BusError> {
        let (lock, all) = &*self.waiting;
        *lock.lock().unwrap_or_else(PoisonError::into_inner) = hosts;
        self.publisher.put(tick).wait()?;
        let waiting = lock.lock().unwrap_or_else(PoisonError::into_inner);
        let (waiting, _) = all
            .wait_timeout_while(waiting, PATIENCE, |waiting| *waiting > 0)
            .unwrap_or_else(PoisonError::into_inner);
        if *waiting == 0 {
            Ok(())
        } else {
            Err(BusError::Zenoh(format!("{} hosts did not answer", *waiting)))
        }
    }
}

/// A host's side: answers every tick with `answer` bytes until the BS is gone, then returns.
///
/// # Errors
/// If zenoh refuses.
pub async fn bare_host(bus: &Bus, number: u32, answer: usize) -> Result<(), BusError> {
    let (tick, answers) = keys(bus);
    let publisher = bus
        .session
        .declare_publisher(format!("{answers}/{number}"))
        .congestion_control(CongestionControl::Block)
        .wait()?;
    let payload = vec![0_u8; answer];
    let _ticks = bus
        .session
        .declare_subscriber(tick)
        .callback(move |_| {
            // The link is gone with the BS.
            let _gone = publisher.put(payload.as_slice()).wait().is_err();
        })
        .wait()?;
    let _here = bus.declare_alive(bus.keys().alive(HostId(number)))?;
    let gone = Arc::new(tokio::sync::Notify::new());
    let bell = Arc::clone(&gone);
    let _watch = bus.watch_alive(bus.keys().bs_alive(), move |_, alive| {
        if !alive {
            bell.notify_one();
        }
    })?;
    gone.notified().await;
    Ok(())
}

fn keys(bus: &Bus) -> (String, String) {
    let run = bus.keys().run();
    (
        format!("reveille/{run}/bare/tick"),
        format!("reveille/{run}/bare/answer"),
    )
}
