//! Merges the tables of shards (`reveille merge`). The result equals the table of an undivided sweep, byte for byte in
//! a file. Tables hold no number of a run, so the merge relies on [`Shard`] for the place of each row. The reasons of
//! errors follow `FILE: cannot be merged: `.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::vec::IntoIter;

use reveille_common::digits::count_noun;

use super::error::SweepError;
use super::experiment::{Experiment, describe_difference};
use super::experiment_builder::ExperimentBuilder;
use super::grid::check_size;
use super::shard::Shard;
use crate::table::{ColumnType, ResultRow, Schema, Table, TableMetadata};

/// Merges the tables of shards, in any order, into the table of an undivided sweep. With `partial`, shards may be
/// missing, and the table names the shards that it holds.
///
/// # Errors
/// If the tables come from different experiments or versions, are not shards, overlap, or (without `partial`) are
/// incomplete.
pub fn merge(tables: Vec<(PathBuf, Table)>, partial: bool) -> Result<Table, SweepError> {
    let mut shards = Vec::new();
    for (path, table) in tables {
        let shard = shard_of(&path, &table)?;
        shards.push((shard, path, table));
    }
    shards.sort_by_key(|(shard, _, _)| shard.index());
    let Some((first_shard, first_path, first)) = shards.first() else {
        return Err(SweepError::invalid(
            "tables",
            "none",
            "name at least one table or folder of a shard",
        ));
    };
    for (shard, path, table) in &shards[1..] {
        check_same_sweep(first_path, first, path, table)?;
        if shard.count() != first_shard.count() {
            let reason = format!(
                "it is shard {shard}, but {} is shard {first_shard}",
                first_path.display()
            );
            return Err(merge_error(path, reason));
        }
    }
    // Sorted by index, so equal shards are neighbours.
    for pair in shards.windows(2) {
        let [(a, path_a, _), (b, path_b, _)] = pair else {
            continue;
        };
        if a == b {
            let reason = format!("it is shard {b}, and so is {}; name each shard once", path_a.display());
            return Err(merge_error(path_b, reason));
        }
    }
    let count = first_shard.count();
    let present_indices: Vec<u64> = shards.iter().map(|(shard, _, _)| shard.index()).collect();
    let missing_shards: Vec<String> = (1..=count)
        .filter(|index| present_indices.binary_search(index).is_err())
        .map(|index| format!("{index}/{count}"))
        .collect();
    if !missing_shards.is_empty() && !partial {
        let shown = missing_shards.iter().take(20).cloned().collect::<Vec<_>>().join(", ");
        let reason = format!(
            "{} of {count} shards are missing: {shown}; add them, or merge the present ones with --partial",
            missing_shards.len()
        );
        return Err(merge_error(first_path, reason));
    }
    let experiment = ExperimentBuilder::parse(&first.metadata.experiment, "its experiment", Path::new(""))?.build()?;
    // The experiment comes from a file: without a bound, the loops over its cells and seeds could run for years.
    check_size(&experiment)?;
    for (shard, path, table) in &shards {
        check_complete(&experiment, *shard, path, table)?;
    }
    let indices: Vec<String> = present_indices.iter().map(ToString::to_string).collect();
    let metadata = TableMetadata {
        shard: (!missing_shards.is_empty()).then(|| format!("{}/{count}", indices.join(","))),
        ..first.metadata.clone()
    };
    let schema = join_schemas(&shards);
    let mut rows_by_shard = BTreeMap::new();
    for (shard, _, mut table) in shards {
        convert_swept_values(&mut table, &schema);
        rows_by_shard.insert(shard.index(), table.rows.into_iter());
    }
    Ok(Table {
        metadata,
        schema,
        rows: interleave_rows(&experiment, count, rows_by_shard),
    })
}

/// Returns columns whose types hold the values of all shards. Without its types, a CSV file gets them from its values,
/// and a file without rows gives no information.
fn join_schemas(shards: &[(Shard, PathBuf, Table)]) -> Schema {
    let mut non_empty = shards
        .iter()
        .map(|(_, _, table)| table)
        .filter(|table| !table.rows.is_empty());
    let mut schema = non_empty.next().unwrap_or(&shards[0].2).schema.clone();
    for table in non_empty {
        for ((_, column_type), (_, other)) in schema.swept.iter_mut().zip(&table.schema.swept) {
            *column_type = column_type.join(*other);
        }
    }
    schema
}

/// Converts the swept values of `table` to the types of `schema`. The schema of `table` stays as it is.
fn convert_swept_values(table: &mut Table, schema: &Schema) {
    if table.schema == *schema {
        return;
    }
    for row in &mut table.rows {
        let values = row.swept.iter().cloned().zip(&schema.swept);
        row.swept = values
            .map(|(value, (_, column_type))| value.into_type(*column_type))
            .collect();
    }
}

fn merge_error(path: &Path, reason: String) -> SweepError {
    SweepError::Merge {
        path: path.to_owned(),
        reason,
    }
}

/// Returns the shard that `table` names in its metadata.
fn shard_of(path: &Path, table: &Table) -> Result<Shard, SweepError> {
    if table.metadata.experiment.is_empty() {
        let reason = "it does not name its experiment; a CSV file needs its side-car NAME.csv.toml in the same folder";
        return Err(merge_error(path, reason.to_owned()));
    }
    let Some(shard) = &table.metadata.shard else {
        return Err(merge_error(
            path,
            "it is the table of a whole sweep, not of a shard".to_owned(),
        ));
    };
    shard.parse().map_err(|_| {
        let reason =
            format!("it holds shards {shard} and was merged with --partial; merge the tables of the shards themselves");
        merge_error(path, reason)
    })
}

fn check_same_sweep(first_path: &Path, first: &Table, path: &Path, table: &Table) -> Result<(), SweepError> {
    let (expected, found) = (&first.metadata, &table.metadata);
    let column_name = |(name, _): &(String, ColumnType)| name.clone();
    let difference = if expected.version != found.version {
        format!(
            "it is from reveille {}, the other table from {}",
            found.version, expected.version
        )
    } else if expected.experiment != found.experiment {
        format!(
            "its experiment differs: {}",
            describe_difference(&found.experiment, &expected.experiment)
        )
    } else if expected.grid_hash != found.grid_hash {
        "the scenario files or traces behind its experiment differ".to_owned()
    } else if !first
        .schema
        .swept
        .iter()
        .map(column_name)
        .eq(table.schema.swept.iter().map(column_name))
    {
        "its columns differ".to_owned()
    } else {
        return Ok(());
    };
    let reason = format!(
        "it does not belong to the sweep of {}: {difference}",
        first_path.display()
    );
    Err(merge_error(path, reason))
}

/// Checks by the number and the seeds of its rows that the table holds exactly its share. Shards exclude `until_ci`
/// ([`super::SweepGrid::check_shard`]), so the share has a row for every seed.
fn check_complete(experiment: &Experiment, shard: Shard, path: &Path, table: &Table) -> Result<(), SweepError> {
    let (cells, seeds) = (experiment.cell_count(), experiment.seeds);
    let expected_seeds = (0..cells).flat_map(|cell| shard.seed_indices(cell, seeds.count));
    if !expected_seeds
        .map(|seed| seeds.first + seed)
        .eq(table.rows.iter().map(|row| row.seed))
    {
        let (rows, runs) = (table.rows.len(), shard.run_count(cells, seeds.count));
        let reason = format!(
            "it holds {}, not the {} of shard {shard}; run the shard again",
            count_noun(rows, "row"),
            count_noun(runs, "run")
        );
        return Err(merge_error(path, reason));
    }
    Ok(())
}

/// Returns the rows of the `count` shards, in the order of cells and then of seeds. `rows_by_shard` holds the rows of
/// each present shard by its index; [`check_complete`] must have checked them, because they are taken by position.
fn interleave_rows(
    experiment: &Experiment,
    count: u64,
    mut rows_by_shard: BTreeMap<u64, IntoIter<ResultRow>>,
) -> Vec<ResultRow> {
    let mut rows = Vec::with_capacity(rows_by_shard.values().map(IntoIter::len).sum());
    for cell in 0..experiment.cell_count() {
        for seed_index in 0..experiment.seeds.count {
            let shard_rows = rows_by_shard.get_mut(&Shard::shard_index_of_run(cell, seed_index, count));
            rows.extend(shard_rows.and_then(Iterator::next));
        }
    }
    rows
}
