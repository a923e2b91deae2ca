//! The origin of a table: key-value metadata in Parquet files, the sidecar of CSV files. The keys at the end are a file
//! format: other programs and some tests repeat them as text.

use super::error::{SchemaMismatch, TABLE_VERSION};

/// The origin of a table.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct TableMetadata {
    /// The version of Reveille that made the runs.
    pub version: String,
    /// The experiment as TOML. A CSV file without its sidecar has no metadata: this text, the version and the hash are
    /// then empty.
    pub experiment: String,
    /// The fields of the scenario file that the experiment names, as TOML, except names of files; `None` for a preset.
    pub scenario_fields: Option<String>,
    /// SHA-256 over the scenarios of all cells, hexadecimal.
    pub grid_hash: String,
    /// The shard `i/n` of the experiment, or the shards `i,j/n` of a merge; `None` for the whole experiment.
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
            (GRID_KEY, self.grid_hash.clone()),
        ];
        let optional = [(SCENARIO_KEY, &self.scenario_fields), (SHARD_KEY, &self.shard)];
        pairs.extend(
            optional
                .into_iter()
                .filter_map(|(key, value)| Some((key, value.clone()?))),
        );
        pairs
    }

    /// Parses key-value metadata, after a check of the table's version. `value_of` returns the value of a key.
    pub(super) fn from_pairs<'p>(value_of: impl Fn(&str) -> Option<&'p str>) -> Result<Self, SchemaMismatch> {
        // The version first: in another one the other keys may have another meaning.
        let Some(table_version) = value_of(TABLE_VERSION_KEY) else {
            return Err(SchemaMismatch::NotOurs);
        };
        if !(1..=TABLE_VERSION).any(|readable| table_version == readable.to_string()) {
            return Err(SchemaMismatch::Version {
                table_version: table_version.to_owned(),
                reveille_version: value_of(REVEILLE_VERSION_KEY).unwrap_or("unknown").to_owned(),
            });
        }
        let text_or_empty = |key: &str| value_of(key).unwrap_or_default().to_owned();
        let mut version = text_or_empty(REVEILLE_VERSION_KEY);
        // Rows of an older table can lack metrics, so they count as rows of another version.
        if table_version != TABLE_VERSION.to_string() {
            version = format!("{version}, with tables of version {table_version}");
        }
        Ok(Self {
            version,
            experiment: text_or_empty(EXPERIMENT_KEY),
            scenario_fields: value_of(SCENARIO_KEY).map(str::to_owned),
            grid_hash: text_or_empty(GRID_KEY),
            shard: value_of(SHARD_KEY).map(str::to_owned),
        })
    }
}

/// The version of the table format, [`TABLE_VERSION`].
pub(super) const TABLE_VERSION_KEY: &str = "reveille.table";
/// The version of Reveille that made the runs.
pub(super) const REVEILLE_VERSION_KEY: &str = "reveille.version";
/// The experiment as TOML.
pub(super) const EXPERIMENT_KEY: &str = "reveille.experiment";
/// The fields of the scenario file, as TOML; absent for a preset.
pub(super) const SCENARIO_KEY: &str = "reveille.scenario";
/// SHA-256 over the scenarios of all cells.
pub(super) const GRID_KEY: &str = "reveille.grid";
/// `i/n` in the table of a shard, `i,j/n` in a merge of some shards; absent in a whole table.
pub(super) const SHARD_KEY: &str = "reveille.shard";
/// The types of the swept columns in sidecars: `int`, `float` or `text`, separated by commas.
pub(super) const COLUMN_TYPES_KEY: &str = "reveille.kinds";
/// The number of rows, in sidecars.
pub(super) const ROW_COUNT_KEY: &str = "reveille.rows";
