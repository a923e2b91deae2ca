//! The origin of a table: key-value metadata in Parquet files, the sidecar of CSV files. The keys are a file format.

use super::error::{SchemaMismatch, TABLE_VERSION};

/// The origin of a table.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct TableMetadata {
    /// The version of Reveille that made the runs.
    pub version: String,
    /// The experiment as TOML; empty for a CSV file without its sidecar.
    pub experiment: String,
    /// SHA-256 over the scenarios of all cells, hexadecimal.
    pub grid: String,
    /// The shard of the experiment; `None` for the whole experiment.
    pub shard: Option<String>,
}

impl TableMetadata {
    /// Returns the script of actions of every run; `None` if the experiment has none.
    pub fn action_script(&self) -> Option<String> {
        let experiment = self.experiment.parse::<toml::Table>().ok()?;
        experiment.get("action_script")?.as_str().map(str::to_owned)
    }

    /// Returns the metadata as pairs of key and value, in a fixed order.
    pub(super) fn pairs(&self) -> Vec<(&'static str, String)> {
        let mut pairs = vec![
            (TABLE_VERSION_KEY, TABLE_VERSION.to_string()),
            (REVEILLE_VERSION_KEY, self.version.clone()),
            (EXPERIMENT_KEY, self.experiment.clone()),
            (GRID_KEY, self.grid.clone()),
        ];
        if let Some(shard) = &self.shard {
            pairs.push((SHARD_KEY, shard.clone()));
        }
        pairs
    }

    /// Parses key-value metadata, after a check of the table's version.
    pub(super) fn from_pairs<'p>(get: impl Fn(&str) -> Option<&'p str>) -> Result<Self, SchemaMismatch> {
        // The version first: in another one the other keys may have another meaning.
        let Some(version) = get(TABLE_VERSION_KEY) else {
            return Err(SchemaMismatch::NotOurs);
        };
        if !(1..=TABLE_VERSION).any(|readable| version == readable.to_string()) {
            return Err(SchemaMismatch::Version {
                found: version.to_owned(),
                by: get(REVEILLE_VERSION_KEY).unwrap_or("unknown").to_owned(),
            });
        }
        let text = |key: &str| get(key).unwrap_or_default().to_owned();
        Ok(Self {
            version: text(REVEILLE_VERSION_KEY),
            experiment: text(EXPERIMENT_KEY),
            grid: text(GRID_KEY),
            shard: get(SHARD_KEY).map(str::to_owned),
        })
    }
}

/// The version of the table format, [`TABLE_VERSION`].
pub(super) const TABLE_VERSION_KEY: &str = "reveille.table";
/// The version of Reveille that made the runs.
pub(super) const REVEILLE_VERSION_KEY: &str = "reveille.version";
/// The experiment as TOML.
pub(super) const EXPERIMENT_KEY: &str = "reveille.experiment";
/// SHA-256 over the scenarios of all cells.
pub(super) const GRID_KEY: &str = "reveille.grid";
/// `i/n` in the table of a shard, `i,j/n` in a merge of some shards; absent in a whole table.
pub(super) const SHARD_KEY: &str = "reveille.shard";
/// The types of the swept columns in sidecars: `int`, `float` or `text`, separated by commas.
pub(super) const COLUMN_TYPES_KEY: &str = "reveille.kinds";
/// The number of rows, in sidecars.
pub(super) const ROW_COUNT_KEY: &str = "reveille.rows";
