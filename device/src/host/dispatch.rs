//! Choice of the thread that processes a host's messages, by the capacity of its process: the largest number of devices
//! that it may run. `forces_worker` overrides this rule. `join` creates the dispatcher; `host/mod.rs` feeds it from the
//! subscriptions and handles each message.
//!
//! A host with a small capacity processes a message on the thread that delivers it. This saves a thread switch per
//! message, which is most of the cost of a quiet TTI. The same thread also empties the link's queue, because device
//! processes give zenoh one thread (`deploy/src/child_process.rs`). The host's output per message must therefore fit
//! into the queue of 128 KiB. Otherwise the thread would wait for itself until the link times out. A host with a large
//! capacity uses another thread.

use std::sync::Arc;

use reveille_common::ids::DeviceId;
use reveille_common::message::{ClockMessage, PlanUpdate, WakeUp};
use tokio::sync::mpsc::{UnboundedSender, unbounded_channel};

/// Largest capacity with which a host processes messages on the delivering thread. The ledgers of 256 devices (at most
/// 250 B each) or their reports, with keys, fill at most half of the link's queue. A longer ledger or report lowers
/// this number. `docs/design.md` and `docs/command-line.md` repeat it.
pub const MAX_INLINE_DEVICES: u32 = 256;

/// A message from the base station to a host.
pub(super) enum HostMessage {
    /// The plan of the sensing devices.
    Plan(PlanUpdate),
    /// A wake-up for a device.
    Wake(DeviceId, WakeUp),
    /// The virtual clock.
    Clock(ClockMessage),
}

/// A handler of a host's messages that keeps their order.
#[derive(Clone)]
pub(super) enum Dispatcher {
    /// Processes a message on the thread that delivers it.
    Inline(Arc<dyn Fn(HostMessage) + Send + Sync>),
    /// Processes a message in one task of the runtime on which the dispatcher was created.
    Worker(UnboundedSender<HostMessage>),
}

impl Dispatcher {
    /// Creates the dispatcher of a host whose process has this `capacity`, with `handle` for each message. It uses
    /// another thread for a capacity above [`MAX_INLINE_DEVICES`] or with `forces_worker`. `--untuned` sets
    /// `forces_worker`; a takeover does if the total capacity of the process is above the limit.
    ///
    /// # Panics
    /// If it uses another thread and is not called on a tokio runtime.
    pub(super) fn new(
        capacity: u32,
        forces_worker: bool,
        handle: impl Fn(HostMessage) + Send + Sync + 'static,
    ) -> Self {
        if capacity <= MAX_INLINE_DEVICES && !forces_worker {
            return Self::Inline(Arc::new(handle));
        }
        // Unbounded, because zenoh's thread must not wait for the task.
        let (sender, mut messages) = unbounded_channel();
        tokio::spawn(async move {
            while let Some(message) = messages.recv().await {
                handle(message);
            }
        });
        Self::Worker(sender)
    }

    /// Processes one message, or queues it for the task.
    pub(super) fn dispatch(&self, message: HostMessage) {
        match self {
            Self::Inline(handle) => handle(message),
            Self::Worker(sender) => {
                // The task ends early only with a panic, which the panic hook prints.
                let _closed = sender.send(message).is_err();
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::channel;
    use std::thread::{self, ThreadId};

    use reveille_common::ids::Tti;

    use super::*;

    /// Dispatches wake-ups of TTIs 0 to 9 from this thread. Returns their TTIs in the order of handling, each with the
    /// thread that handled it.
    fn handle_ten_messages(capacity: u32, forces_worker: bool) -> Vec<(Tti, ThreadId)> {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .build()
            .expect("a runtime");
        let (sender, handled) = channel();
        let _guard = runtime.enter();
        let dispatcher = Dispatcher::new(capacity, forces_worker, move |message| {
            if let HostMessage::Wake(_, WakeUp { tti }) = message {
                sender
                    .send((tti, thread::current().id()))
                    .expect("the receiver is open");
            }
        });
        for tti in 0..10 {
            dispatcher.dispatch(HostMessage::Wake(DeviceId(0), WakeUp { tti: Tti(tti) }));
        }
        drop(dispatcher);
        handled.iter().collect()
    }

    #[test]
    fn few_devices_are_handled_on_the_receiving_thread() {
        let this_thread = thread::current().id();
        let expected: Vec<_> = (0..10).map(|tti| (Tti(tti), this_thread)).collect();
        assert_eq!(handle_ten_messages(MAX_INLINE_DEVICES, false), expected);
    }

    #[test]
    fn many_devices_are_handled_on_another_thread_in_order() {
        let this_thread = thread::current().id();
        for (capacity, forces_worker) in [(MAX_INLINE_DEVICES + 1, false), (1, true)] {
            let (ttis, threads): (Vec<_>, Vec<_>) = handle_ten_messages(capacity, forces_worker).into_iter().unzip();
            assert_eq!(ttis, (0..10).map(Tti).collect::<Vec<_>>());
            assert!(
                threads.iter().all(|&thread| thread != this_thread),
                "capacity {capacity}"
            );
        }
    }
}
