//! Shards of a sweep for several machines. The assignment of runs is fixed: `merge` interleaves the rows by it, and the
//! journal of a shard stays valid when its seeds are raised. The text `i/n` of a shard is the value of `--shard`, and
//! part of result tables and of the identity of journals.

use std::fmt;
use std::str::FromStr;

/// The `index`-th of `count` shards. The runs of a cell are distributed round robin; the next cell starts at the next
/// shard. Each shard has some runs of every cell, and a run's shard does not depend on the number of seeds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shard {
    /// The index of the shard, from 1.
    index: u64,
    count: u64,
}

impl Shard {
    /// The largest number of shards.
    pub const MAX_COUNT: u64 = 100_000;

    /// The only shard of an undivided sweep.
    pub const WHOLE: Self = Self { index: 1, count: 1 };

    /// The index of the shard, from 1.
    pub const fn index(self) -> u64 {
        self.index
    }

    /// The number of shards.
    pub const fn count(self) -> u64 {
        self.count
    }

    /// Returns the index, 1 to `shard_count`, of the shard that holds the run. `cell` and `seed_index` count from 0.
    pub const fn shard_index_of_run(cell: u64, seed_index: u64, shard_count: u64) -> u64 {
        // Each term is reduced first: the sum of a cell and a seed could overflow.
        (cell % shard_count + seed_index % shard_count) % shard_count + 1
    }

    /// Returns whether the run of a cell and the index of a seed, both from 0, belongs to the shard.
    pub const fn contains(self, cell: u64, seed_index: u64) -> bool {
        Self::shard_index_of_run(cell, seed_index, self.count) == self.index
    }

    /// Returns the index, from 0, of the first of the shard's seeds of `cell`: the inverse of
    /// [`Self::shard_index_of_run`].
    const fn first_seed_index(self, cell: u64) -> u64 {
        // The count is added before the subtraction, which would otherwise go below zero.
        (self.index - 1 + self.count - cell % self.count) % self.count
    }

    /// Iterates in ascending order over the indices, from 0, of the shard's seeds of `cell`, which has `seed_count`
    /// seeds in all shards.
    pub fn seed_indices(self, cell: u64, seed_count: u64) -> impl Iterator<Item = u64> {
        (self.first_seed_index(cell)..seed_count).step_by(self.count as usize)
    }

    /// Returns the number of the shard's runs in `cell_count` cells with `seed_count` seeds each.
    pub fn run_count(self, cell_count: u64, seed_count: u64) -> u64 {
        let runs_in_cell = |cell| {
            seed_count
                .saturating_sub(self.first_seed_index(cell))
                .div_ceil(self.count)
        };
        (0..cell_count).map(runs_in_cell).sum()
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
            Some((index, count)) if 1 <= index && index <= count && count <= Self::MAX_COUNT => {
                Ok(Self { index, count })
            }
            Some(_) | None => Err(format!(
                "must be i/n, the i-th of n shares with 1 ≤ i ≤ n ≤ {}, such as 2/8",
                Self::MAX_COUNT
            )),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shards_are_even_and_list_their_runs() {
        for (cells, seeds, count) in [
            (8, 7, 5),
            (40, 1000, 8),
            (1, 3, 7),
            (10, 10, 10),
            (3, 100, 1),
            (4, 20, 8),
        ] {
            let mut sizes = Vec::new();
            for index in 1..=count {
                let shard = Shard { index, count };
                let runs = (0..cells).flat_map(|cell| (0..seeds).map(move |seed| (cell, seed)));
                let contained: Vec<(u64, u64)> = runs.filter(|(cell, seed)| shard.contains(*cell, *seed)).collect();
                let listed = (0..cells).flat_map(|cell| shard.seed_indices(cell, seeds).map(move |seed| (cell, seed)));
                assert_eq!(listed.collect::<Vec<_>>(), contained, "{shard}");
                assert_eq!(shard.run_count(cells, seeds), contained.len() as u64, "{shard}");
                // The numbers of runs per cell differ by at most one.
                let runs_in_cell = |cell| contained.iter().filter(|(other, _)| *other == cell).count() as u64;
                assert!((0..cells).all(|cell| (seeds / count..=seeds.div_ceil(count)).contains(&runs_in_cell(cell))));
                sizes.push(contained.len() as u64);
            }
            assert_eq!(sizes.iter().sum::<u64>(), cells * seeds);
            let spread = sizes.iter().max().expect("some") - sizes.iter().min().expect("some");
            // The remainder of each cell goes to neighbouring shards, one further on than in the previous cell. The
            // sizes therefore never differ by more than this.
            assert!(spread <= count / 2, "{cells} cells, {seeds} seeds: {sizes:?}");
        }
    }

    #[test]
    fn every_run_is_in_one_shard_and_invalid_shards_are_refused() {
        let shards: Vec<Shard> = (1..=3).map(|i| format!("{i}/3").parse().expect("valid")).collect();
        for (cell, seed) in (0..7).flat_map(|cell| (0..11).map(move |seed| (cell, seed))) {
            assert_eq!(shards.iter().filter(|shard| shard.contains(cell, seed)).count(), 1);
        }
        assert_eq!(shards[1].to_string(), "2/3");
        for invalid in ["5/4", "0/3", "1/0", "", "2", "a/b", "-1/2", "1/2/3", "1/100001"] {
            let reason = invalid.parse::<Shard>().expect_err(invalid);
            assert!(reason.contains("1 ≤ i ≤ n"), "{invalid}: {reason}");
        }
    }
}
