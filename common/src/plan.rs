//! The δ plan: which devices sense in which TTI.

use serde::{Deserialize, Serialize};

use crate::ids::{DeviceId, Tti};

/// The duty cycle of one device: δ_j(k) = 1 in the first `t_on` of every `t_drx` TTIs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DutyCycle {
    /// TTIs in S1 per cycle, `0 ..= t_drx`.
    pub t_on: u32,
    /// Length of the cycle in TTIs, `1 ..= `[`DutyCycle::LONGEST`].
    pub t_drx: u32,
    /// TTIs into its cycle at which the device is at k = 0, `0 .. t_drx`.
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

    /// The longest cycle, in TTIs.
    pub const LONGEST: u32 = 1 << 24;

    /// Whether the three numbers are within their ranges.
    pub const fn is_valid(self) -> bool {
        self.t_drx >= 1 && self.t_drx <= Self::LONGEST && self.t_on <= self.t_drx && self.offset < self.t_drx
    }

    /// δ_j(k).
    #[inline]
    pub const fn is_on(self, k: Tti) -> bool {
        self.phase(k) < self.t_on
    }

    /// The first TTI with δ_j = 1 that is not before `from`, [`Tti::NEVER`] if there is none.
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

    /// Over `n` TTIs, the first of them `phase` TTIs into its cycle (`0 .. t_drx`): how many have δ_j = 1, the sum over
    /// those of the TTIs from it to the end of the span, itself included, and the phase after the span. The second is
    /// what a cost paid in S1 takes off the battery, summed over the span. `n` is at most 2³⁰.
    #[inline]
    pub const fn span(self, phase: u32, n: u32) -> (u64, u64, u32) {
        let end = phase + n;
        let before = least(phase, self.t_on) as u64;
        // With x counted from the start of the first cycle: how many x before the end have δ = 1, and the sum of those
        // x.
        if end < self.t_drx {
            let after = least(end, self.t_on) as u64;
            let on = after - before;
            return (on, end as u64 * on - (triangle(after) - triangle(before)), end);
        }
        let (cycles, rest) = ((end / self.t_drx) as u64, end % self.t_drx);
        let (t_on, cycle, after) = (self.t_on as u64, self.t_drx as u64, least(rest, self.t_on) as u64);
        let on = cycles * t_on + after - before;
        let full = cycle * t_on * triangle(cycles) + cycles * triangle(t_on);
        let sum = full + cycles * cycle * after + triangle(after) - triangle(before);
        (on, end as u64 * on - sum, rest)
    }

    /// How many TTIs into its cycle the device is in TTI `k`, `0 .. t_drx`.
    #[inline]
    pub const fn phase(self, k: Tti) -> u32 {
        let into = k.0 + self.offset as u64;
        // Dividing 32 bits takes less time, and few runs are longer.
        if into <= u32::MAX as u64 {
            into as u32 % self.t_drx
        } else {
            (into % self.t_drx as u64) as u32
        }
    }
}

#[inline]
fn is_set(bits: &[u8], j: usize) -> bool {
    bits.get(j / 8).is_some_and(|byte| byte >> (j % 8) & 1 == 1)
}

const fn least(a: u32, b: u32) -> u32 {
    if a < b { a } else { b }
}

/// 0 + 1 + … + (n − 1).
const fn triangle(n: u64) -> u64 {
    // With n = 0 the other factor does not matter.
    n.wrapping_mul(n.wrapping_sub(1)) / 2
}

/// What the BS commands: δ for all devices, until the next plan.
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
    /// A plan of bits from δ_j for each device.
    pub fn from_bits(delta: impl IntoIterator<Item = bool>) -> Self {
        let delta = delta.into_iter();
        let mut bits = Vec::with_capacity(delta.size_hint().0.div_ceil(8));
        for (j, on) in delta.enumerate() {
            if j % 8 == 0 {
                bits.push(0);
            }
            bits[j / 8] |= u8::from(on) << (j % 8);
        }
        Self::Bits { bits }
    }

    /// A plan of bits for `devices` devices, of which `chosen` sense.
    pub fn from_chosen(devices: usize, chosen: &[DeviceId]) -> Self {
        let mut bits = vec![0; devices.div_ceil(8)];
        for device in chosen {
            bits[device.index() / 8] |= 1 << (device.index() % 8);
        }
        Self::Bits { bits }
    }

    /// The devices whose bit is set in the `bits` of a plan, in the order of ids.
    pub fn chosen(bits: &[u8]) -> impl Iterator<Item = DeviceId> {
        let all = 0..bits.len() * 8;
        all.filter(|&j| is_set(bits, j)).map(|j| DeviceId(j as u32))
    }

    /// δ_j(k) of `device` in TTI `k`, which a bit says without its duty cycle.
    #[inline]
    pub fn is_on(&self, device: DeviceId, k: Tti) -> bool {
        match self {
            Self::Bits { bits } => is_set(bits, device.index()),
            Self::Periodic(_) => self.duty_cycle(device).is_on(k),
        }
    }

    /// The duty cycle of `device`; asleep where the plan does not reach it.
    #[inline]
    pub fn duty_cycle(&self, device: DeviceId) -> DutyCycle {
        let j = device.index();
        match self {
            Self::Bits { bits } if is_set(bits, j) => DutyCycle::SENSING,
            Self::Bits { .. } => DutyCycle::ASLEEP,
            Self::Periodic(cycles) => cycles
                .get(j)
                .copied()
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
    fn bits_come_back() {
        let delta = [true, false, false, true, true, false, true, false, false, true];
        let plan = Plan::from_bits(delta);
        for (j, on) in delta.into_iter().enumerate() {
            assert_eq!(plan.duty_cycle(DeviceId(j as u32)).is_on(Tti(5)), on, "device {j}");
        }
        assert_eq!(plan.duty_cycle(DeviceId(10)), DutyCycle::ASLEEP);
    }

    proptest! {
        #[test]
        fn closed_forms_agree_with_counting(
            t_drx in 1u32..40, on in 0u32..40, off in 0u32..40, from in 0u64..200, n in 0u64..300
        ) {
            let cycle = DutyCycle { t_on: on.min(t_drx), t_drx, offset: off % t_drx };
            let on_ttis: Vec<u64> = (0..n).filter(|i| cycle.is_on(Tti(from + i))).collect();
            let remaining: u64 = on_ttis.iter().map(|i| n - i).sum();
            let span = cycle.span(cycle.phase(Tti(from)), n as u32);
            prop_assert_eq!(span, (on_ttis.len() as u64, remaining, cycle.phase(Tti(from + n))));
            let next = (from..from + 100).map(Tti).find(|&k| cycle.is_on(k)).unwrap_or(Tti::NEVER);
            prop_assert_eq!(cycle.next_on(Tti(from)), next);
        }
    }
}
