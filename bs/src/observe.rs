//! The one seam by which a run is observed, in memory and over the bus.
//!
//! The [`Cycle`](crate::cycle::Cycle) tells an [`Observer`] what happens, in order; who drives it adds the states of
//! the devices where they are asked for. The stream of [`Happening`]s is the same for the same scenario, seed and
//! options, whoever drives the run. An observer is called before the run goes on, so nothing is lost: a recorder may
//! take its time, and the run waits. A live view that must never be waited for reads the tap of the bus, or puts a
//! [`Lossy`] in front.
//!
//! An observer must not change the run, and cannot: it is given references alone. `()` observes nothing and costs
//! nothing.

pub mod frames;

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

use reveille_common::event::{ActiveEvent, EventRecord};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Failure, Likely, Outage, PlanUpdate, Report, WakeOutcome};
use reveille_common::score::WindowRecord;
use reveille_common::state::DeviceView;
use reveille_common::units::Energy;

use crate::grant::Grant;

/// Something that happens in a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Happening<'a> {
    /// δ goes out on the air.
    Plan {
        /// The plan.
        update: &'a PlanUpdate,
        /// Whether it differs from the plan before; if not, it is sent for synchronisation.
        is_new: bool,
    },
    /// The devices go through these TTIs. What the world does in them follows.
    Granted(&'a Grant),
    /// An event has started. Ground truth.
    EventStarted(&'a ActiveEvent),
    /// A device with δ = 1 has reported the event.
    Reported(&'a Report),
    /// A device with δ = 1 has reported the event, and the report was lost on its way. Ground truth.
    Lost(&'a Report),
    /// A device with δ = 1 has detected the event and could not transmit. Ground truth.
    Failed {
        /// The TTI.
        tti: Tti,
        /// The device, and what it lost.
        failure: &'a Failure,
    },
    /// The base station has sent a wake-up.
    WakeUp {
        /// The TTI.
        tti: Tti,
        /// The device that is woken.
        device: DeviceId,
        /// When it is sent, where devices take time to wake and others were woken before; as a rule `tti`.
        sent: Tti,
    },
    /// What came of the last wake-up.
    Woken {
        /// The TTI.
        tti: Tti,
        /// The device that was to be woken.
        device: DeviceId,
        /// What came of it.
        outcome: &'a WakeOutcome,
    },
    /// Where the base station believes the event to be after all reports of a TTI, for an observer that wants to know,
    /// where its policy has such a belief.
    Believed {
        /// The TTI.
        tti: Tti,
        /// The places, with shares whose sum is 1.
        places: &'a [Likely],
    },
    /// Devices are gone, in a TTI that has been granted. Ground truth.
    Gone(&'a Outage),
    /// An event has ended, reported or not. Ground truth.
    EventEnded(&'a EventRecord),
    /// All TTIs up to and including this one are closed.
    Closed(Tti),
    /// The devices at the end of the TTI closed last, in the order of ids, for an observer that wants them. Ground
    /// truth.
    States(&'a [DeviceView]),
}

/// Follows a run. The default methods look at nothing.
pub trait Observer {
    /// Something has happened.
    fn see(&mut self, _happening: &Happening<'_>) {}

    /// Whether [`Happening::States`] is wanted at the end of the TTIs that are granted next. Asked before each grant.
    fn wants_states(&self) -> bool {
        false
    }

    /// Whether [`Happening::Believed`] is wanted in the TTI that is being closed.
    fn wants_beliefs(&self) -> bool {
        false
    }

    /// The policy was told the true `batteries`, in the order of ids, before it decides of TTI `tti`: what it goes by
    /// is no happening of the run.
    fn told(&mut self, _tti: Tti, _batteries: &[Energy]) {}

    /// The sums of a window of TTIs have come in. Over the bus that is a grant later than in memory, and so it is no
    /// happening. Says whether to go on with the run.
    fn window(&mut self, _window: &WindowRecord) -> bool {
        true
    }
}

/// An observer that does not look.
impl Observer for () {}

impl<O: Observer> Observer for &mut O {
    fn see(&mut self, happening: &Happening<'_>) {
        (**self).see(happening);
    }

    fn wants_states(&self) -> bool {
        (**self).wants_states()
    }

    fn wants_beliefs(&self) -> bool {
        (**self).wants_beliefs()
    }

    fn told(&mut self, tti: Tti, batteries: &[Energy]) {
        (**self).told(tti, batteries);
    }

    fn window(&mut self, window: &WindowRecord) -> bool {
        (**self).window(window)
    }
}

/// An observer, if there is one.
impl<O: Observer> Observer for Option<O> {
    fn see(&mut self, happening: &Happening<'_>) {
        if let Some(observer) = self {
            observer.see(happening);
        }
    }

    fn wants_states(&self) -> bool {
        self.as_ref().is_some_and(Observer::wants_states)
    }

    fn wants_beliefs(&self) -> bool {
        self.as_ref().is_some_and(Observer::wants_beliefs)
    }

    fn told(&mut self, tti: Tti, batteries: &[Energy]) {
        if let Some(observer) = self {
            observer.told(tti, batteries);
        }
    }

    fn window(&mut self, window: &WindowRecord) -> bool {
        self.as_mut().is_none_or(|observer| observer.window(window))
    }
}

/// Two observers, told one after the other.
impl<A: Observer, B: Observer> Observer for (A, B) {
    fn see(&mut self, happening: &Happening<'_>) {
        self.0.see(happening);
        self.1.see(happening);
    }

    fn wants_states(&self) -> bool {
        self.0.wants_states() || self.1.wants_states()
    }

    fn wants_beliefs(&self) -> bool {
        self.0.wants_beliefs() || self.1.wants_beliefs()
    }

    fn told(&mut self, tti: Tti, batteries: &[Energy]) {
        self.0.told(tti, batteries);
        self.1.told(tti, batteries);
    }

    fn window(&mut self, window: &WindowRecord) -> bool {
        let goes_on = self.0.window(window);
        self.1.window(window) && goes_on
    }
}

/// An observer that never waits: it turns what it sees into items for another thread, through a bounded queue. What
/// does not fit is left out and counted.
#[derive(Debug)]
pub struct Lossy<T, F> {
    make: F,
    queue: SyncSender<T>,
    left_out: Arc<AtomicU64>,
}

impl<T, F: FnMut(&Happening<'_>) -> Option<T>> Lossy<T, F> {
    /// An observer that sends what `make` makes of each happening into a queue of `capacity` items, and the queue's
    /// other end.
    pub fn new(capacity: usize, make: F) -> (Self, Receiver<T>) {
        let (queue, items) = sync_channel(capacity);
        let lossy = Self {
            make,
            queue,
            left_out: Arc::default(),
        };
        (lossy, items)
    }

    /// How many items were left out so far; to be kept by the reader.
    pub fn left_out(&self) -> Arc<AtomicU64> {
        Arc::clone(&self.left_out)
    }
}

impl<T, F: FnMut(&Happening<'_>) -> Option<T>> Observer for Lossy<T, F> {
    fn see(&mut self, happening: &Happening<'_>) {
        if let Some(item) = (self.make)(happening)
            && self.queue.try_send(item).is_err()
        {
            self.left_out.fetch_add(1, Ordering::Relaxed);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_queue_leaves_out_and_counts() {
        let (mut lossy, items) = Lossy::new(3, |happening| {
            if let Happening::Closed(tti) = happening {
                Some(tti.0)
            } else {
                None
            }
        });
        let left_out = lossy.left_out();
        for k in 0..5 {
            lossy.see(&Happening::Closed(Tti(k)));
            lossy.see(&Happening::WakeUp {
                tti: Tti(k),
                device: DeviceId(0),
                sent: Tti(k),
            });
        }
        drop(lossy);
        assert_eq!(items.iter().collect::<Vec<_>>(), [0, 1, 2]);
        assert_eq!(left_out.load(Ordering::Relaxed), 2);
    }
}
