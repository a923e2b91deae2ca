//! Identifiers of devices, hosts and events, and TTIs ([`Tti`]). Messages, keys, tables and the input log hold them as
//! plain numbers: `#[serde(transparent)]` is part of these formats.

use std::fmt;
use std::ops::{Add, Sub};

use serde::{Deserialize, Serialize};

/// Maximum number of devices N. `lab/src/training/mod.rs` has a constant with this value; error texts in tests and
/// `docs/scenario.md` state both maxima.
pub const MAX_DEVICES: u32 = 1_000_000;
/// Maximum length of a run K, an event or an interval, in TTIs. It must be below 2³⁰
/// ([`DutyCycle::sum_over_span`](crate::plan::DutyCycle::sum_over_span)).
pub const MAX_TTIS: u64 = 1_000_000_000;

/// The number of a device, `0 .. N`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct DeviceId(pub u32);

impl DeviceId {
    /// Returns the number as an index into per-device arrays.
    pub const fn index(self) -> usize {
        self.0 as usize
    }
}

impl fmt::Display for DeviceId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// The number of a host process within a run from 0, in the order in which hosts joined.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct HostId(pub u32);

impl HostId {
    /// Returns the number as an index into per-host arrays.
    pub const fn index(self) -> usize {
        self.0 as usize
    }
}

impl fmt::Display for HostId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// The number of an event from 0, in the order of starts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct EventId(pub u64);

/// A transmission time interval (TTI) `k`, `0 .. K`: the slot of model time in which devices sense, transmit and sleep.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Tti(pub u64);

impl Tti {
    /// The first TTI of a run.
    pub const ZERO: Self = Self(0);
    /// A TTI later than any TTI of a run, which stands for "never".
    pub const NEVER: Self = Self(u64::MAX);

    /// Returns the TTI `n` TTIs later, at most [`Tti::NEVER`].
    #[must_use]
    pub const fn saturating_add(self, n: u64) -> Self {
        Self(self.0.saturating_add(n))
    }

    /// Returns the TTI before this one, which must not be the first; [`Tti::NEVER`] stays unchanged.
    #[must_use]
    pub(crate) const fn previous(self) -> Self {
        if self.0 == u64::MAX { self } else { Self(self.0 - 1) }
    }
}

impl Add<u64> for Tti {
    type Output = Self;
    /// Returns the TTI `n` TTIs later. For a TTI that can be [`Tti::NEVER`], use [`Tti::saturating_add`].
    fn add(self, n: u64) -> Self {
        Self(self.0 + n)
    }
}

impl Sub for Tti {
    type Output = u64;
    /// Returns the number of TTIs from `other`, which must not be later, to this one.
    fn sub(self, other: Self) -> u64 {
        self.0 - other.0
    }
}

impl fmt::Display for Tti {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}
