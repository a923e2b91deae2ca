//! What a table says about its origin.

use super::error::Refusal;
use super::keys::{self, TABLE_VERSION};

/// What a table says about its origin.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct About {
    /// The version of Reveille that made the runs.
    pub version: String,
    /// The experiment as TOML; empty for a CSV file without its side-car.
    pub experiment: String,
    /// SHA-256 over the scenarios of all cells, hexadecimal.
    pub grid: String,
    /// Which shard of the experiment it is; `None` for all of it.
    pub shard: Option<String>,
}

impl About {
    /// What is known about the table as pairs of key and value, in a fixed order.
    pub(super) fn pairs(&self) -> Vec<(&'static str, String)> {
        let mut pairs = vec![
            (keys::TABLE, TABLE_VERSION.to_string()),
            (keys::VERSION, self.version.clone()),
            (keys::EXPERIMENT, self.experiment.clone()),
            (keys::GRID, self.grid.clone()),
        ];
        if let Some(shard) = &self.shard {
            pairs.push((keys::SHARD, shard.clone()));
        }
        pairs
    }

    /// From key-value metadata, after a check of the table's version.
    pub(super) fn from_pairs<'p>(get: impl Fn(&str) -> Option<&'p str>) -> Result<Self, Refusal> {
        let Some(version) = get(keys::TABLE) else {
            return Err(Refusal::NotOurs);
        };
        if version != TABLE_VERSION.to_string() {
            return Err(Refusal::Version {
                found: version.to_owned(),
                by: get(keys::VERSION).unwrap_or("unknown").to_owned(),
            });
        }
        let text = |key: &str| get(key).unwrap_or_default().to_owned();
        Ok(Self {
            version: text(keys::VERSION),
            experiment: text(keys::EXPERIMENT),
            grid: text(keys::GRID),
            shard: get(keys::SHARD).map(str::to_owned),
        })
    }
}
