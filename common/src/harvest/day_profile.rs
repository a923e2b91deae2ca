//! The expected energy of a source that depends on the time of day, the source `diurnal`. The base station estimates
//! batteries from it (`bs/src/battery_estimator/`), so decisions and digests depend on its rounding.

use crate::ids::Tti;
use crate::units::Energy;

/// The expected energy of a source between any two TTIs, with all days equal: physics without random draws.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DayProfile {
    /// Expected micro-units from the start of a day up to each of its TTIs; the last entry is the whole day.
    cumulative_micro: Vec<u64>,
    /// The TTIs of the day at which day or night begins; empty if it is always day or always night.
    switches: Vec<u64>,
}

impl DayProfile {
    /// Creates the profile of a source with arrivals of `e_b`; `day_probabilities` are the probabilities of an arrival
    /// in each TTI of a day, at least one. TTI 0 of a run is the first of them.
    pub fn new(day_probabilities: impl Iterator<Item = f64>, e_b: Energy) -> Self {
        let (mut sum, mut cumulative_micro, mut is_lit) = (0.0, vec![0], Vec::new());
        for p in day_probabilities {
            sum += p;
            // The running sum is rounded, not each TTI, so that errors do not add up over the day.
            cumulative_micro.push((sum * e_b.micro() as f64).round() as u64);
            is_lit.push(p > 0.0);
        }
        let ttis_per_day = is_lit.len();
        let switches = (0..ttis_per_day).filter(|&tti| is_lit[tti] != is_lit[(tti + ttis_per_day - 1) % ttis_per_day]);
        Self {
            cumulative_micro,
            switches: switches.map(|tti| tti as u64).collect(),
        }
    }

    /// TTIs per day.
    pub fn ttis_per_day(&self) -> u64 {
        self.cumulative_micro.len() as u64 - 1
    }

    /// The mean harvest from TTI `from` to before `end`; 0 if `end` is not later.
    pub fn energy_between(&self, from: Tti, end: Tti) -> Energy {
        Energy::from_micro(self.micro_before(end).saturating_sub(self.micro_before(from)))
    }

    /// The first TTI after `now` at which day or night begins; [`Tti::NEVER`] if that never happens.
    pub fn next_switch_after(&self, now: Tti) -> Tti {
        let (day, slot) = (now.0 / self.ttis_per_day(), now.0 % self.ttis_per_day());
        let later_today = self.switches.iter().find(|&&switch| switch > slot);
        let next = later_today
            .copied()
            .or_else(|| Some(self.switches.first()? + self.ttis_per_day()));
        next.map_or(Tti::NEVER, |switch| {
            Tti(day * self.ttis_per_day()).saturating_add(switch)
        })
    }

    /// Expected micro-units before `end`.
    fn micro_before(&self, end: Tti) -> u64 {
        let whole_day = self.cumulative_micro[self.cumulative_micro.len() - 1];
        let (days, slot) = (end.0 / self.ttis_per_day(), end.0 % self.ttis_per_day());
        days.saturating_mul(whole_day)
            .saturating_add(self.cumulative_micro[slot as usize])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Probability of an arrival in each TTI of a day.
    const PROBABILITIES: [f64; 5] = [0.0, 0.25, 0.5, 0.3, 0.0];

    #[test]
    fn energy_between_adds_up_the_ttis_without_loss() {
        let profile = DayProfile::new(PROBABILITIES.into_iter(), Energy::from_micro(1000));
        let expected_micro = |from: u64, end: u64| -> u64 {
            let micro_by_tti = [0, 250, 500, 300, 0];
            (from..end).map(|k| micro_by_tti[(k % 5) as usize]).sum()
        };
        for from in 0..13 {
            for end in from..23 {
                assert_eq!(
                    profile.energy_between(Tti(from), Tti(end)).micro(),
                    expected_micro(from, end),
                    "TTIs {from} to {end}"
                );
            }
        }
        assert_eq!(profile.energy_between(Tti(7), Tti(3)), Energy::ZERO);
        // A third of a micro-unit per TTI is not lost.
        let thirds = DayProfile::new([1.0 / 3.0; 3].into_iter(), Energy::from_micro(1));
        let sum: u64 = (0..300)
            .map(|k| thirds.energy_between(Tti(k), Tti(k + 1)).micro())
            .sum();
        assert_eq!(sum, 100);
    }

    #[test]
    fn switches_are_at_the_first_light_and_after_the_last() {
        let profile = DayProfile::new(PROBABILITIES.into_iter(), Energy::from_micro(1000));
        let switches: Vec<u64> = (0..11).map(|k| profile.next_switch_after(Tti(k)).0).collect();
        assert_eq!(switches, [1, 4, 4, 4, 6, 6, 9, 9, 9, 11, 11]);
        let always_light = DayProfile::new([0.5; 4].into_iter(), Energy::from_micro(1000));
        assert_eq!(always_light.next_switch_after(Tti(2)), Tti::NEVER);
    }
}
