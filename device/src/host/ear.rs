//! On which thread a host does what it hears.
//!
//! A host with few devices does it at once, on the thread that delivers: that is one hand-over less for each message,
//! which is most of what a quiet TTI costs. That thread also empties the link's queue, as processes that carry devices
//! have one thread for zenoh. So what a host sends in one go must fit into the queue, of 128 KiB: a thread that waits
//! for itself would wait until the link is given up. A host with many devices has another thread do it all.

use std::sync::Arc;

use reveille_common::ids::DeviceId;
use reveille_common::message::{Clock, PlanUpdate, WakeUp};
use tokio::sync::mpsc::{UnboundedSender, unbounded_channel};

/// Devices up to which a host does at once what it hears. Their ledgers, at most 250 B each, or their reports, with
/// keys, fill no more than half of the link's queue.
pub const FEW: u32 = 256;

/// What a host hears from its BS.
pub enum Heard {
    /// The plan of the sensing devices.
    Plan(PlanUpdate),
    /// A wake-up for a device.
    Wake(DeviceId, WakeUp),
    /// The virtual clock.
    Clock(Clock),
}

/// Takes in what a host hears, in order.
#[derive(Clone)]
pub enum Ear {
    /// It is done on the thread that delivers it.
    AtOnce(Arc<dyn Fn(Heard) + Send + Sync>),
    /// It is done by a task of the process's own runtime.
    HandedOver(UnboundedSender<Heard>),
}

impl Ear {
    /// The ear of a host whose process carries up to `devices` devices, which does `act` for each message; on another
    /// thread if it must, or `hands_over` asks for it. Call it on the process's own runtime.
    pub fn new(devices: u32, hands_over: bool, act: impl Fn(Heard) + Send + Sync + 'static) -> Self {
        if devices <= FEW && !hands_over {
            return Self::AtOnce(Arc::new(act));
        }
        let (sender, mut heard) = unbounded_channel();
        tokio::spawn(async move {
            while let Some(heard) = heard.recv().await {
                act(heard);
            }
        });
        Self::HandedOver(sender)
    }

    /// Takes in one message.
    pub fn take(&self, heard: Heard) {
        match self {
            Self::AtOnce(act) => act(heard),
            Self::HandedOver(sender) => {
                // The task has panicked, which the host says in other ways.
                let _gone = sender.send(heard).is_err();
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

    /// The threads on which a host with `devices` devices hears TTIs 0 to 9, in the order in which it does.
    fn heard_by(devices: u32, hands_over: bool) -> Vec<(Tti, ThreadId)> {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .build()
            .expect("a runtime");
        let (sender, acts) = channel();
        let _inside = runtime.enter();
        let ear = Ear::new(devices, hands_over, move |heard| {
            if let Heard::Wake(_, WakeUp { tti }) = heard {
                sender.send((tti, thread::current().id())).expect("the test waits");
            }
        });
        for tti in 0..10 {
            ear.take(Heard::Wake(DeviceId(0), WakeUp { tti: Tti(tti) }));
        }
        drop(ear);
        acts.iter().collect()
    }

    #[test]
    fn few_devices_are_served_on_the_thread_that_delivers() {
        let own = thread::current().id();
        let expected: Vec<_> = (0..10).map(|tti| (Tti(tti), own)).collect();
        assert_eq!(heard_by(FEW, false), expected);
    }

    #[test]
    fn many_are_served_on_another_in_order() {
        let own = thread::current().id();
        for (devices, hands_over) in [(FEW + 1, false), (1, true)] {
            let (ttis, threads): (Vec<_>, Vec<_>) = heard_by(devices, hands_over).into_iter().unzip();
            assert_eq!(ttis, (0..10).map(Tti).collect::<Vec<_>>());
            assert!(threads.iter().all(|&thread| thread != own));
        }
    }
}
