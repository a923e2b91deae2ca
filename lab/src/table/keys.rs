//! Keys of the metadata of a Parquet file, and of the side-car of a CSV file.

/// The form of the table; raised when a column changes its meaning.
pub const TABLE_VERSION: u32 = 1;

/// [`TABLE_VERSION`].
pub const TABLE: &str = "reveille.table";
/// The version of Reveille that made the runs.
pub const VERSION: &str = "reveille.version";
/// The experiment as TOML.
pub const EXPERIMENT: &str = "reveille.experiment";
/// SHA-256 over the scenarios of all cells.
pub const GRID: &str = "reveille.grid";
/// `i/n` in the table of a shard, `i,j/n` in a merge of some shards; absent in a whole table.
pub const SHARD: &str = "reveille.shard";
/// In side-cars: what the swept columns hold, `int`, `float` or `text`, separated by commas.
pub const KINDS: &str = "reveille.kinds";
/// In side-cars: the number of rows.
pub const ROWS: &str = "reveille.rows";
