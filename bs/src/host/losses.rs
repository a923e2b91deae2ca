//! Devices whose host is lost, until it is back or another host carries them.

use std::sync::Arc;
use std::time::{Duration, Instant};

use reveille_common::ids::{DeviceId, HostId, Tti};
use reveille_common::message::{Checkpoint, Outage, Resumption};
use reveille_common::totals::Ledger;

use super::admission::Places;
use crate::outcome::Outcome;
use crate::policy::external::Answered;

/// A replay of the run, which knows the devices at any TTI: all that they do follows from the scenario and the seed.
pub trait Replay: Send + Sync {
    /// The devices from `first` on, `count` of them, as they are before TTI `k`. May take as long as a run in memory up
    /// to there.
    ///
    /// # Errors
    /// Why there is no such state, in words.
    fn devices(&self, k: Tti, first: DeviceId, count: u32) -> Result<Vec<Checkpoint>, String>;

    /// What the run has come to before TTI `k`.
    ///
    /// # Errors
    /// Why there is no such state, in words.
    fn outcome(&self, k: Tti) -> Result<Outcome, String>;

    /// The books of the devices from `first` on, `count` of them, before TTI `k`.
    ///
    /// # Errors
    /// Why there is no such state, in words.
    fn ledgers(&self, k: Tti, first: DeviceId, count: u32) -> Result<Vec<Ledger>, String>;

    /// Devices have gone for good, in the TTI that is open. When this returns, that is kept for whoever replays the
    /// run.
    ///
    /// # Errors
    /// Why it cannot be kept, in words.
    fn lose(&self, outage: &Outage) -> Result<(), String>;

    /// Somebody outside has decided. When this returns, that is kept for whoever replays the run.
    ///
    /// # Errors
    /// Why it cannot be kept, in words.
    fn decided(&self, decision: Answered) -> Result<(), String>;
}

/// Where newcomers take up the devices of a lost host.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Point {
    /// The first TTI of the last grant, which they are asked again.
    pub next: Tti,
    /// The TTI from which the plan holds that was in force before it.
    pub plan: Option<Tti>,
}

/// The devices of one lost host.
#[derive(Clone, Debug)]
struct Vacancy {
    places: Places,
    since: Instant,
    /// The TTI of which a replay has been asked for them.
    asked: Option<Tti>,
    resumption: Option<Arc<Resumption>>,
    /// The newcomer that is to carry them and has not said yet that it does.
    offered: Option<HostId>,
}

/// All devices whose host is lost.
#[derive(Clone, Debug, Default)]
pub struct Losses {
    open: Vec<Vacancy>,
    mended: Vec<Duration>,
}

impl Losses {
    /// The host with these places is lost. False if that was known.
    pub fn lose(&mut self, places: Places, now: Instant) -> bool {
        if self.of(places.host).is_some() {
            return false;
        }
        self.open.push(Vacancy {
            places,
            since: now,
            asked: None,
            resumption: None,
            offered: None,
        });
        true
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.open.is_empty()
    }

    /// The places of the hosts that are lost.
    pub fn places(&self) -> impl Iterator<Item = Places> + '_ {
        self.open.iter().map(|vacancy| vacancy.places)
    }

    /// Those that no replay has been asked for; now one is, for TTI `next`.
    pub fn unasked(&mut self, next: Tti) -> Vec<Places> {
        let unasked = self.open.iter_mut().filter(|vacancy| vacancy.asked.is_none());
        unasked
            .map(|vacancy| {
                vacancy.asked = Some(next);
                vacancy.places
            })
            .collect()
    }

    /// A replay has found the devices of `host`. What it found for a loss that is over is of no use.
    pub fn found(&mut self, host: HostId, resumption: Resumption) {
        if let Some(at) = self.of(host).filter(|&at| self.open[at].asked == Some(resumption.next)) {
            self.open[at].resumption = Some(Arc::new(resumption));
        }
    }

    /// The devices of a lost host that a newcomer which would carry `count` can have: the most that fit.
    pub fn fitting(&self, count: u32) -> Option<(Places, Arc<Resumption>)> {
        let free = self
            .open
            .iter()
            .filter(|v| v.offered.is_none() && v.places.count <= count);
        let ready = free.filter_map(|v| Some((v.places, Arc::clone(v.resumption.as_ref()?))));
        ready.max_by_key(|(places, _)| places.count)
    }

    /// What the newcomer `host` was offered, with where it takes it up.
    pub fn offered_to(&self, host: HostId) -> Option<(Places, Arc<Resumption>)> {
        let vacancy = self.open.iter().find(|vacancy| vacancy.offered == Some(host))?;
        Some((vacancy.places, Arc::clone(vacancy.resumption.as_ref()?)))
    }

    /// The newcomer is to carry the devices of `lost`.
    pub fn offer(&mut self, lost: HostId, newcomer: HostId) {
        if let Some(at) = self.of(lost) {
            self.open[at].offered = Some(newcomer);
        }
    }

    /// The newcomer has gone before it carried anything.
    pub fn decline(&mut self, newcomer: HostId) {
        for vacancy in self.open.iter_mut().filter(|v| v.offered == Some(newcomer)) {
            vacancy.offered = None;
        }
    }

    /// Nobody is to carry the devices of `host` any more.
    pub fn forget(&mut self, host: HostId) {
        self.open.retain(|vacancy| vacancy.places.host != host);
    }

    /// The host is back: its devices are its own. Gives the newcomer, if there is one, that was to carry them.
    pub fn back(&mut self, host: HostId, now: Instant) -> Option<Option<HostId>> {
        let at = self.of(host)?;
        Some(self.close(at, now).offered)
    }

    /// The newcomer carries what it was offered. Gives the places of the host that is lost for good, and for how long
    /// nobody carried its devices.
    pub fn filled(&mut self, newcomer: HostId, now: Instant) -> Option<(Places, Duration)> {
        let at = self.open.iter().position(|vacancy| vacancy.offered == Some(newcomer))?;
        let vacancy = self.close(at, now);
        Some((vacancy.places, now.saturating_duration_since(vacancy.since)))
    }

    /// How long each loss lasted that is over.
    pub fn mended(&self) -> &[Duration] {
        &self.mended
    }

    fn close(&mut self, at: usize, now: Instant) -> Vacancy {
        let vacancy = self.open.swap_remove(at);
        self.mended.push(now.saturating_duration_since(vacancy.since));
        vacancy
    }

    fn of(&self, host: HostId) -> Option<usize> {
        self.open.iter().position(|vacancy| vacancy.places.host == host)
    }
}

#[cfg(test)]
#[expect(clippy::disallowed_methods, reason = "the tests need some moment")]
mod tests {
    use super::*;

    fn places(host: u32, first: u32, count: u32) -> Places {
        Places {
            host: HostId(host),
            first: DeviceId(first),
            count,
        }
    }

    fn resumption() -> Resumption {
        Resumption {
            next: Tti(7),
            plan: None,
            devices: Vec::new(),
        }
    }

    #[test]
    fn a_newcomer_gets_what_fits_once_it_is_known() {
        let mut losses = Losses::default();
        let now = Instant::now();
        assert!(losses.lose(places(0, 0, 5), now) && losses.lose(places(1, 5, 9), now));
        assert!(!losses.lose(places(0, 0, 5), now), "that was known");
        assert_eq!(losses.unasked(Tti(7)).len(), 2);
        assert!(losses.unasked(Tti(7)).is_empty() && losses.fitting(20).is_none());
        losses.found(HostId(0), resumption());
        losses.found(HostId(1), resumption());
        assert_eq!(losses.fitting(4).map(|(places, _)| places), None);
        assert_eq!(losses.fitting(8).map(|(places, _)| places), Some(places(0, 0, 5)));
        assert_eq!(losses.fitting(9).map(|(places, _)| places), Some(places(1, 5, 9)));
        losses.offer(HostId(1), HostId(2));
        assert_eq!(losses.fitting(9).map(|(places, _)| places), Some(places(0, 0, 5)));
        losses.decline(HostId(2));
        assert_eq!(losses.fitting(9).map(|(places, _)| places), Some(places(1, 5, 9)));
        losses.offer(HostId(1), HostId(3));
        let second = Duration::from_secs(1);
        assert_eq!(losses.filled(HostId(3), now + second), Some((places(1, 5, 9), second)));
        assert_eq!(losses.places().collect::<Vec<_>>(), [places(0, 0, 5)]);
        assert_eq!(losses.mended(), [second]);
    }

    #[test]
    fn a_host_that_is_back_keeps_its_devices() {
        let mut losses = Losses::default();
        let now = Instant::now();
        losses.lose(places(0, 0, 5), now);
        losses.unasked(Tti(7));
        losses.found(HostId(0), resumption());
        losses.offer(HostId(0), HostId(1));
        assert_eq!(losses.back(HostId(0), now), Some(Some(HostId(1))));
        assert_eq!(losses.back(HostId(0), now), None);
        assert!(losses.is_empty() && losses.filled(HostId(1), now).is_none());
        losses.lose(places(0, 0, 5), now);
        losses.unasked(Tti(9));
        losses.found(HostId(0), resumption());
        assert!(losses.fitting(9).is_none(), "that was for the first loss");
    }
}
