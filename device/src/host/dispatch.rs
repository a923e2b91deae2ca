//! Choice of the thread that processes a host's messages, by the number of devices of the process.
//!
//! A host with few devices processes a message on the thread that delivers it. This saves a thread switch per message,
//! which is most of the cost of a quiet TTI. The same thread also empties the link's queue, because device processes
//! give zenoh one thread. The host's output per message must therefore fit into the queue of 128 KiB. Otherwise the
//! thread would wait for itself until the link times out. A host with many devices uses another thread.

use std::sync::Arc;

use reveille_common::ids::DeviceId;
use reveille_common::message::{ClockMessage, PlanUpdate, WakeUp};
use tokio::sync::mpsc::{UnboundedSender, unbounded_channel};

/// Largest number of devices for which a host processes messages on the delivering thread. Their ledgers (at most 250 B
/// each) or their reports, with keys, fill at most half of the link's queue.
pub(super) const MAX_INLINE_DEVICES: u32 = 256;

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
    /// Processes a message in a task of the process's own runtime.
    Worker(UnboundedSender<HostMessage>),
}

impl Dispatcher {
    /// Creates the dispatcher of a host whose process runs up to `devices` devices, with `handle` for each message. It
    /// uses another thread for more than [`MAX_INLINE_DEVICES`] devices or if `uses_worker` is set. Call it on the
    /// process's own runtime.
    pub(super) fn new(devices: u32, uses_worker: bool, handle: impl Fn(HostMessage) + Send + Sync + 'static) -> Self {
        if devices <= MAX_INLINE_DEVICES && !uses_worker {
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
                let _gone = sender.send(message).is_err();
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

    /// Returns TTIs 0 to 9 and the threads on which a host with `devices` devices handles them, in order of handling.
    fn heard_by(devices: u32, uses_worker: bool) -> Vec<(Tti, ThreadId)> {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .build()
            .expect("a runtime");
        let (sender, acts) = channel();
        let _inside = runtime.enter();
        let ear = Dispatcher::new(devices, uses_worker, move |heard| {
            if let HostMessage::Wake(_, WakeUp { tti }) = heard {
                sender.send((tti, thread::current().id())).expect("the test waits");
            }
        });
        for tti in 0..10 {
            ear.dispatch(HostMessage::Wake(DeviceId(0), WakeUp { tti: Tti(tti) }));
        }
        drop(ear);
        acts.iter().collect()
    }

    #[test]
    fn few_devices_are_served_on_the_thread_that_delivers() {
        let own = thread::current().id();
        let expected: Vec<_> = (0..10).map(|tti| (Tti(tti), own)).collect();
        assert_eq!(heard_by(MAX_INLINE_DEVICES, false), expected);
    }

    #[test]
    fn many_are_served_on_another_in_order() {
        let own = thread::current().id();
        for (devices, uses_worker) in [(MAX_INLINE_DEVICES + 1, false), (1, true)] {
            let (ttis, threads): (Vec<_>, Vec<_>) = heard_by(devices, uses_worker).into_iter().unzip();
            assert_eq!(ttis, (0..10).map(Tti).collect::<Vec<_>>());
            assert!(threads.iter().all(|&thread| thread != own));
        }
    }
}
