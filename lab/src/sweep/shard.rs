//! Shares of a sweep for several machines.

use std::fmt;
use std::str::FromStr;

/// The `index`-th of `count` shares: runs, counted over cells and then seeds, are dealt round robin.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shard {
    /// From 1.
    index: u64,
    count: u64,
}

impl Shard {
    /// The most shares.
    pub const MOST: u64 = 100_000;

    /// The only share of an undivided sweep.
    pub const WHOLE: Self = Self { index: 1, count: 1 };

    /// Which share it is, from 1.
    pub const fn index(self) -> u64 {
        self.index
    }

    /// How many there are.
    pub const fn count(self) -> u64 {
        self.count
    }

    /// Whether the run with this number, from 0, belongs to the share.
    pub const fn holds(self, number: u64) -> bool {
        number % self.count == self.index - 1
    }
}

impl fmt::Display for Shard {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.index, self.count)
    }
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts = text.split_once('/');
        let parts = parts.and_then(|(index, count)| Some((index.parse().ok()?, count.parse().ok()?)));
        match parts {
            Some((index, count)) if 1 <= index && index <= count && count <= Self::MOST => Ok(Self { index, count }),
            Some(_) | None => Err(format!(
                "must be i/n, the i-th of n shares with 1 ≤ i ≤ n ≤ {}, such as 2/8",
                Self::MOST
            )),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_are_read_and_every_run_is_in_one() {
        let shards: Vec<Shard> = (1..=3).map(|i| format!("{i}/3").parse().expect("valid")).collect();
        for number in 0..20 {
            assert_eq!(shards.iter().filter(|shard| shard.holds(number)).count(), 1);
        }
        assert_eq!(shards[1].to_string(), "2/3");
        for bad in ["5/4", "0/3", "1/0", "", "2", "a/b", "-1/2", "1/2/3", "1/100001"] {
            let reason = bad.parse::<Shard>().expect_err(bad);
            assert!(reason.contains("1 ≤ i ≤ n"), "{reason}");
        }
    }
}
