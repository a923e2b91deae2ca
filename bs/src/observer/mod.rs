//! The interface by which a run is observed, in memory and over the bus.
//!
//! The [`Cycle`](crate::cycle::Cycle) notifies an [`Observer`] in order. The [`Session`](crate::session::Session) adds
//! the device states if the observer wants them. Scenario, seed, options and external inputs (operator actions, removed
//! devices, decisions of a policy process) determine the stream of [`Notification`]s, whether devices run in memory or
//! in processes; `tests/tests/observer.rs` compares both. The run waits for its observer, so a recorder loses nothing.
//! A live view that must not delay the run reads the tap of the bus.
//!
//! An observer can end the run ([`Observer::window_closed`]) but not change it otherwise. `()` ignores everything.

pub mod frames;

use reveille_common::event::{ActiveEvent, EventRecord, Stimulus};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{
    DeviceRemoval, FailedTransmission, OperatorAction, PlanUpdate, Report, WakeOutcome, WeightedPoint,
};
use reveille_common::score::WindowRecord;
use reveille_common::state::DeviceView;
use reveille_common::units::Energy;

/// A notification about a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Notification<'a> {
    /// The base station has sent its δ plan.
    PlanSent {
        /// The plan.
        update: &'a PlanUpdate,
        /// Whether it differs from the previous plan; if not, it is sent for synchronisation.
        is_new: bool,
    },
    /// The devices may advance through these TTIs. Notifications about these TTIs follow. One grant to the devices can
    /// consist of several of these in a row, with the plans between them.
    TtisGranted(&'a Grant),
    /// An event has started. Ground truth.
    EventStarted(&'a ActiveEvent),
    /// A device with δ = 1 has reported an event.
    ReportReceived(&'a Report),
    /// A report of a device with δ = 1 was lost on the radio channel. Ground truth.
    ReportLost(&'a Report),
    /// A device with δ = 1 has detected an event but could not transmit. Ground truth.
    ReportFailed {
        /// The TTI.
        tti: Tti,
        /// The device and the energy that it lost.
        failure: &'a FailedTransmission,
    },
    /// The base station has sent a wake-up signal.
    WakeUpSent {
        /// The TTI.
        tti: Tti,
        /// The woken device.
        device: DeviceId,
        /// TTI of transmission. It is later than `tti` only if devices take time to wake and others were woken before.
        sent: Tti,
    },
    /// The outcome of the last wake-up is known.
    WakeUpCompleted {
        /// The TTI.
        tti: Tti,
        /// The woken device.
        device: DeviceId,
        /// The outcome.
        outcome: &'a WakeOutcome,
    },
    /// The belief over the epicentre after all reports of a TTI. Sent only if the observer wants it and the policy has
    /// one.
    BeliefUpdated {
        /// The TTI.
        tti: Tti,
        /// Candidate epicentres with weights that sum to 1.
        places: &'a [WeightedPoint],
    },
    /// An operator's action takes effect in the next TTI, before its plan and its grant. Ground truth.
    ActionTaken(&'a OperatorAction),
    /// Devices were removed in a granted TTI. Ground truth.
    DevicesRemoved(&'a DeviceRemoval),
    /// An event has ended, reported or not. Ground truth.
    EventEnded(&'a EventRecord),
    /// All TTIs up to and including this one are closed.
    TtiClosed(Tti),
    /// The devices at the end of the last closed TTI, by device id, if the observer wants them. Ground truth.
    DeviceStates(&'a [DeviceView]),
}

/// An observer of a run. The default methods ignore everything.
///
/// A new method must also be forwarded by the implementations for `&mut O`, `Option<O>` and pairs below, and by the
/// observers in other crates that contain one, such as `RunObservers` in `deploy/src/commands/run.rs`. Otherwise the
/// default hides it there.
pub trait Observer {
    /// Receives a notification.
    fn notify(&mut self, _notification: &Notification<'_>) {}

    /// The next TTI at whose end [`Notification::DeviceStates`] is wanted. Devices return their states at the end of a
    /// grant, so the next grant ends with this TTI at the latest.
    fn states_due(&self) -> Tti {
        Tti::NEVER
    }

    /// Whether [`Notification::BeliefUpdated`] is wanted in the TTI being closed.
    fn wants_beliefs(&self) -> bool {
        false
    }

    /// Receives the true `batteries`, by device id, that the policy gets before its decision in TTI `tti`. They are an
    /// input of the policy, so no [`Notification`] carries them.
    fn batteries_revealed(&mut self, _tti: Tti, _batteries: &[Energy]) {}

    /// Receives the sums of a window of TTIs and returns whether the run continues. Over the bus they arrive one grant
    /// later than in memory, so no [`Notification`] carries them.
    fn window_closed(&mut self, _window: &WindowRecord) -> bool {
        true
    }
}

/// Ignores all notifications.
impl Observer for () {}

impl<O: Observer> Observer for &mut O {
    fn notify(&mut self, notification: &Notification<'_>) {
        (**self).notify(notification);
    }

    fn states_due(&self) -> Tti {
        (**self).states_due()
    }

    fn wants_beliefs(&self) -> bool {
        (**self).wants_beliefs()
    }

    fn batteries_revealed(&mut self, tti: Tti, batteries: &[Energy]) {
        (**self).batteries_revealed(tti, batteries);
    }

    fn window_closed(&mut self, window: &WindowRecord) -> bool {
        (**self).window_closed(window)
    }
}

/// Ignores all notifications if it is `None`.
impl<O: Observer> Observer for Option<O> {
    fn notify(&mut self, notification: &Notification<'_>) {
        if let Some(observer) = self {
            observer.notify(notification);
        }
    }

    fn states_due(&self) -> Tti {
        self.as_ref().map_or(Tti::NEVER, Observer::states_due)
    }

    fn wants_beliefs(&self) -> bool {
        self.as_ref().is_some_and(Observer::wants_beliefs)
    }

    fn batteries_revealed(&mut self, tti: Tti, batteries: &[Energy]) {
        if let Some(observer) = self {
            observer.batteries_revealed(tti, batteries);
        }
    }

    fn window_closed(&mut self, window: &WindowRecord) -> bool {
        self.as_mut().is_none_or(|observer| observer.window_closed(window))
    }
}

/// Notifies both observers in order.
impl<A: Observer, B: Observer> Observer for (A, B) {
    fn notify(&mut self, notification: &Notification<'_>) {
        self.0.notify(notification);
        self.1.notify(notification);
    }

    fn states_due(&self) -> Tti {
        self.0.states_due().min(self.1.states_due())
    }

    fn wants_beliefs(&self) -> bool {
        self.0.wants_beliefs() || self.1.wants_beliefs()
    }

    fn batteries_revealed(&mut self, tti: Tti, batteries: &[Energy]) {
        self.0.batteries_revealed(tti, batteries);
        self.1.batteries_revealed(tti, batteries);
    }

    fn window_closed(&mut self, window: &WindowRecord) -> bool {
        // Not one expression: `&&` would keep the window from the second observer if the first one ends the run.
        let first_continues = self.0.window_closed(window);
        self.1.window_closed(window) && first_continues
    }
}

/// The TTIs through which devices may advance next.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Grant {
    /// First granted TTI.
    pub first: Tti,
    /// Last granted TTI; the only one in which a device can have something to report.
    pub last: Tti,
    /// The event that devices may detect in `last`, if any.
    pub stimulus: Option<Stimulus>,
    /// Last TTI in which the active event can be detected; TTI 0 if no event is active. Messages call it `until`.
    pub event_last_tti: Tti,
}
