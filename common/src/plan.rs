//! The δ plan, which determines the sensing devices of each TTI: policies create it, devices and the world follow it.
//!
//! Plans travel on the bus and enter the digest. A change of their fields raises the version of the wire format, and of
//! the digest if it is hashed. Recordings hold the names of the fields (`view/src/schemas.rs`). The input log and the
//! policy port have other forms (`lab/src/external_inputs/mod.rs`, `bs/src/policy/external/wire.rs`).

use serde::{Deserialize, Serialize};

use crate::ids::{DeviceId, Tti};

/// The duty cycle of one device: δ_j(k) = 1 in the first `t_on` of every `t_drx` TTIs. Methods other than
/// [`Self::is_valid`] need a valid cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DutyCycle {
    /// TTIs in S1 per cycle, `0 ..= t_drx`.
    pub t_on: u32,
    /// Length of the cycle in TTIs, `1 ..= `[`DutyCycle::MAX_T_DRX`].
    pub t_drx: u32,
    /// The position in the device's cycle at k = 0 in TTIs, `0 .. t_drx`.
    pub offset: u32,
}

impl DutyCycle {
    /// Always in S4.
    pub const ASLEEP: Self = Self {
        t_on: 0,
        t_drx: 1,
        offset: 0,
    };
    /// Always in S1.
    pub const SENSING: Self = Self {
        t_on: 1,
        t_drx: 1,
        offset: 0,
    };

    /// Maximum length of a cycle, in TTIs; [`Self::sum_over_span`] relies on it.
    pub const MAX_T_DRX: u32 = 1 << 24;

    /// Whether the three numbers are within their ranges.
    pub const fn is_valid(self) -> bool {
        self.t_drx >= 1 && self.t_drx <= Self::MAX_T_DRX && self.t_on <= self.t_drx && self.offset < self.t_drx
    }

    /// Returns δ_j(k).
    #[inline]
    pub const fn is_on(self, k: Tti) -> bool {
        self.phase(k) < self.t_on
    }

    /// Returns the first TTI from `from` on with δ_j = 1; [`Tti::NEVER`] if δ_j stays 0.
    pub const fn next_on(self, from: Tti) -> Tti {
        let phase = self.phase(from);
        if self.t_on == 0 {
            Tti::NEVER
        } else if phase < self.t_on {
            from
        } else {
            from.saturating_add((self.t_drx - phase) as u64)
        }
    }

    /// Sums over a span of `n` TTIs that starts at the position `phase` of the cycle (`0 .. t_drx`); `n` is at most
    /// 2³⁰, and [`MAX_TTIS`](crate::ids::MAX_TTIS) is less. Returns three values:
    /// - the number of TTIs with δ_j = 1;
    /// - the sum over those TTIs of the number of TTIs from each one, itself included, to the end of the span. This is
    ///   the reduction of the battery by a unit cost paid in S1, summed over the span;
    /// - the phase after the span.
    #[inline]
    pub const fn sum_over_span(self, phase: u32, n: u32) -> (u64, u64, u32) {
        // No overflow: phase is below 2²⁴, and n at most 2³⁰.
        let end = phase + n;
        let on_before = min_u32(phase, self.t_on) as u64;
        // x counts TTIs from the start of the first cycle, so the span is phase ≤ x < end. A TTI x with δ = 1 adds
        // end − x to the sum, so the number of such x and their sum suffice.
        // A span within one cycle needs no division.
        if end < self.t_drx {
            let on_until_end = min_u32(end, self.t_on) as u64;
            let on = on_until_end - on_before;
            let sum = sum_below(on_until_end) - sum_below(on_before);
            return (on, end as u64 * on - sum, end);
        }
        let (cycles, end_phase) = ((end / self.t_drx) as u64, end % self.t_drx);
        let (t_on, t_drx) = (self.t_on as u64, self.t_drx as u64);
        let on_in_last = min_u32(end_phase, self.t_on) as u64;
        let on = cycles * t_on + on_in_last - on_before;
        // Whole cycle c begins at x = c · t_drx and adds t_on · c · t_drx + 0 + … + (t_on − 1).
        let sum_of_cycles = t_drx * t_on * sum_below(cycles) + cycles * sum_below(t_on);
        let sum = sum_of_cycles + cycles * t_drx * on_in_last + sum_below(on_in_last) - sum_below(on_before);
        (on, end as u64 * on - sum, end_phase)
    }

    /// Returns the position in the cycle in TTI `k`, `0 .. t_drx`.
    #[inline]
    pub const fn phase(self, k: Tti) -> u32 {
        let ttis = k.0 + self.offset as u64;
        // A 32-bit division takes less time, and few runs are longer.
        if ttis <= u32::MAX as u64 {
            ttis as u32 % self.t_drx
        } else {
            (ttis % self.t_drx as u64) as u32
        }
    }
}

#[inline]
fn is_set(bits: &[u8], j: usize) -> bool {
    // A plan from the bus can be shorter than N; devices beyond it sleep.
    bits.get(j / 8).is_some_and(|byte| byte >> (j % 8) & 1 == 1)
}

const fn min_u32(a: u32, b: u32) -> u32 {
    if a < b { a } else { b }
}

/// Returns 0 + 1 + … + (n − 1).
const fn sum_below(n: u64) -> u64 {
    // With n = 0 the other factor does not matter.
    n.wrapping_mul(n.wrapping_sub(1)) / 2
}

/// The BS's command to all devices: δ until the next plan.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Plan {
    /// δ(k) as a set of N bits (device j is bit j mod 8 of byte j / 8), the same in every TTI until replaced.
    Bits {
        /// The bits.
        bits: Vec<u8>,
    },
    /// A duty cycle for each device, in the order of ids.
    Periodic(Vec<DutyCycle>),
}

impl Plan {
    /// Creates a plan of bits from δ_j of each device.
    pub fn from_bits(delta: impl IntoIterator<Item = bool>) -> Self {
        let delta = delta.into_iter();
        let mut bits = Vec::with_capacity(delta.size_hint().0.div_ceil(8));
        // Whole bytes: a policy process and the Python package create a plan in every TTI, and a bounds check for each
        // device costs three times as much.
        let (mut byte, mut bit) = (0, 0);
        for is_on in delta {
            byte |= u8::from(is_on) << bit;
            bit += 1;
            if bit == 8 {
                bits.push(byte);
                (byte, bit) = (0, 0);
            }
        }
        if bit > 0 {
            bits.push(byte);
        }
        Self::Bits { bits }
    }

    /// Creates a plan of bits for `device_count` devices, of which `sensing` have δ = 1. All ids must be below
    /// `device_count`: a larger one panics, or sets a spare bit of the last byte.
    pub fn from_devices(device_count: usize, sensing: &[DeviceId]) -> Self {
        let mut bits = vec![0; device_count.div_ceil(8)];
        for device in sensing {
            bits[device.index() / 8] |= 1 << (device.index() % 8);
        }
        Self::Bits { bits }
    }

    /// Returns the devices whose bit is set in the `bits` of a plan, in the order of ids.
    pub fn sensing_devices(bits: &[u8]) -> impl Iterator<Item = DeviceId> {
        let numbers = 0..bits.len() * 8;
        numbers.filter(|&j| is_set(bits, j)).map(|j| DeviceId(j as u32))
    }

    /// Returns δ_j(k) of `device` in TTI `k`; for a plan of bits, without the detour over a duty cycle.
    #[inline]
    pub fn is_on(&self, device: DeviceId, k: Tti) -> bool {
        match self {
            Self::Bits { bits } => is_set(bits, device.index()),
            Self::Periodic(_) => self.duty_cycle(device).is_on(k),
        }
    }

    /// Returns the duty cycle of `device`; asleep if the plan does not include the device.
    #[inline]
    pub fn duty_cycle(&self, device: DeviceId) -> DutyCycle {
        let j = device.index();
        match self {
            Self::Bits { bits } if is_set(bits, j) => DutyCycle::SENSING,
            Self::Bits { .. } => DutyCycle::ASLEEP,
            Self::Periodic(cycles) => cycles
                .get(j)
                .copied()
                // A plan from the bus can hold t_drx = 0, by which `phase` would divide.
                .filter(|c| c.is_valid())
                .unwrap_or(DutyCycle::ASLEEP),
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn bits_become_duty_cycles() {
        let delta = [true, false, false, true, true, false, true, false, false, true];
        let plan = Plan::from_bits(delta);
        for (j, on) in delta.into_iter().enumerate() {
            assert_eq!(plan.duty_cycle(DeviceId(j as u32)).is_on(Tti(5)), on, "device {j}");
        }
        assert_eq!(plan.duty_cycle(DeviceId(10)), DutyCycle::ASLEEP);
    }

    proptest! {
        #[test]
        fn closed_forms_equal_counts(
            t_drx in 1u32..40, t_on in 0u32..40, offset in 0u32..40, from in 0u64..200, n in 0u64..300
        ) {
            let cycle = DutyCycle { t_on: t_on.min(t_drx), t_drx, offset: offset % t_drx };
            let on_ttis: Vec<u64> = (0..n).filter(|i| cycle.is_on(Tti(from + i))).collect();
            let remaining: u64 = on_ttis.iter().map(|i| n - i).sum();
            let span = cycle.sum_over_span(cycle.phase(Tti(from)), n as u32);
            prop_assert_eq!(span, (on_ttis.len() as u64, remaining, cycle.phase(Tti(from + n))));
            let next = (from..from + 100).map(Tti).find(|&k| cycle.is_on(k)).unwrap_or(Tti::NEVER);
            prop_assert_eq!(cycle.next_on(Tti(from)), next);
        }
    }
}
