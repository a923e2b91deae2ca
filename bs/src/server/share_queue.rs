//! Shares of the devices, for hosts that offer no number. When no new host has arrived for [`SETTLING_TIME`], every
//! waiting host gets an equal part of the free devices. `join` passes the requests on; a host repeats its request until
//! it has a share (`device/src/host/join.rs`).

use std::time::{Duration, Instant};

/// Time without a further host after which the devices are divided. Containers of one testbed start within seconds.
const SETTLING_TIME: Duration = Duration::from_secs(2);
/// Time without a request after which a host has left. It must exceed the pause between the requests of a host.
const LEFT_AFTER: Duration = Duration::from_secs(2);

#[derive(Clone, Copy, Debug)]
struct WaitingHost {
    nonce: u64,
    last_request: Instant,
}

/// The hosts that wait for a share.
#[derive(Clone, Debug, Default)]
pub(super) struct ShareQueue {
    waiting_hosts: Vec<WaitingHost>,
    last_arrival: Option<Instant>,
}

impl ShareQueue {
    /// Handles a request at `now` of the host that drew `nonce`. Returns its share of the `free` devices, ≥ 1, or
    /// `None` while it has to wait. With its share the host leaves the queue.
    pub(super) fn request(&mut self, nonce: u64, free: u32, now: Instant) -> Option<u32> {
        let known = self.waiting_hosts.iter_mut().find(|host| host.nonce == nonce);
        if let Some(host) = known {
            host.last_request = now;
        } else {
            self.waiting_hosts.push(WaitingHost {
                nonce,
                last_request: now,
            });
            self.last_arrival = Some(now);
        }
        self.drop_hosts_that_left(now);
        let is_settled = self
            .last_arrival
            .is_some_and(|arrival| now.saturating_duration_since(arrival) >= SETTLING_TIME);
        if !is_settled || free == 0 {
            return None;
        }
        // Rounded up: the last hosts get the smaller shares, and no device is left over.
        let share = free.div_ceil(self.waiting_hosts.len() as u32);
        self.waiting_hosts.retain(|host| host.nonce != nonce);
        Some(share)
    }

    /// Whether no host waits for a share, and none has come for a while.
    pub(super) fn is_idle(&mut self, now: Instant) -> bool {
        self.drop_hosts_that_left(now);
        let is_quiet = |arrival| now.saturating_duration_since(arrival) >= 2 * SETTLING_TIME;
        self.waiting_hosts.is_empty() && self.last_arrival.is_some_and(is_quiet)
    }

    fn drop_hosts_that_left(&mut self, now: Instant) {
        self.waiting_hosts
            .retain(|host| now.saturating_duration_since(host.last_request) < LEFT_AFTER);
    }
}

#[cfg(test)]
#[expect(clippy::disallowed_methods, reason = "the tests need an instant")]
mod tests {
    use super::*;

    /// Lets the hosts `nonces` repeat their requests every 250 ms, from `start` on, until all have a share of `free`
    /// devices. Returns the shares in the order in which they were given, and the time that it took.
    fn divide(queue: &mut ShareQueue, nonces: &[u64], mut free: u32, start: Instant) -> (Vec<u32>, Duration) {
        let (mut open, mut shares, mut time) = (nonces.to_vec(), Vec::new(), Duration::ZERO);
        while !open.is_empty() && time < Duration::from_mins(1) {
            open.retain(|nonce| match queue.request(*nonce, free, start + time) {
                Some(share) => {
                    free -= share;
                    shares.push(share);
                    false
                }
                None => true,
            });
            time += Duration::from_millis(250);
        }
        (shares, time)
    }

    #[test]
    fn waiting_hosts_get_equal_shares_without_a_remainder() {
        for (hosts, free, expected) in [
            (1, 50, vec![50]),
            (5, 50, vec![10; 5]),
            (4, 50, vec![13, 13, 12, 12]),
            (3, 3, vec![1, 1, 1]),
        ] {
            let nonces: Vec<u64> = (0..hosts).collect();
            let (shares, time) = divide(&mut ShareQueue::default(), &nonces, free, Instant::now());
            assert_eq!(shares, expected);
            assert!(time >= SETTLING_TIME && time < 2 * SETTLING_TIME, "{time:?}");
        }
    }

    #[test]
    fn hosts_beyond_the_number_of_devices_wait() {
        let mut queue = ShareQueue::default();
        let (shares, _) = divide(&mut queue, &[1, 2, 3, 4, 5], 3, Instant::now());
        assert_eq!((shares, queue.waiting_hosts.len()), (vec![1, 1, 1], 2));
    }

    #[test]
    fn a_queue_is_idle_once_every_host_has_its_share_or_has_left() {
        let (mut queue, now) = (ShareQueue::default(), Instant::now());
        assert!(!queue.is_idle(now), "no host has come yet");
        let (shares, time) = divide(&mut queue, &[1], 50, now);
        assert_eq!(shares, [50]);
        assert!(!queue.is_idle(now + time), "a host came a short time ago");
        let later = now + 2 * SETTLING_TIME;
        assert!(queue.is_idle(later));
        assert_eq!(queue.request(2, 0, later), None);
        assert!(!queue.is_idle(later + LEFT_AFTER / 2), "a host waits");
        assert!(queue.is_idle(later + 2 * SETTLING_TIME));
    }

    #[test]
    fn a_host_that_left_gets_no_share() {
        let (mut queue, now) = (ShareQueue::default(), Instant::now());
        assert_eq!(queue.request(9, 50, now), None);
        let (shares, _) = divide(&mut queue, &[1, 2], 50, now);
        assert_eq!(shares, [25, 25]);
    }

    #[test]
    fn a_late_host_delays_the_division() {
        let (mut queue, now) = (ShareQueue::default(), Instant::now());
        let almost = SETTLING_TIME.mul_f64(0.9);
        assert_eq!(queue.request(1, 50, now), None);
        assert_eq!(queue.request(2, 50, now + almost), None);
        assert_eq!(
            queue.request(1, 50, now + SETTLING_TIME),
            None,
            "2 came only just before"
        );
        let settled = now + almost + SETTLING_TIME;
        assert_eq!(queue.request(2, 50, settled), Some(25));
        assert_eq!(queue.request(1, 25, settled), Some(25));
    }
}
