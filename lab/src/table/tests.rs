//! Tests of [`Table::read`] and [`Table::write`] in both formats: round trips, older and newer versions, and damaged
//! files. Texts such as `reveille.rows` repeat the keys of `metadata`. Not checked: files of former releases, which the
//! tests imitate.

use std::fs;
use std::path::PathBuf;

use reveille_common::score::Metrics;

use super::error::TABLE_VERSION;
use super::*;

/// Returns the line of a sidecar with the version of the format.
fn version_line(version: u32) -> String {
    format!("\"reveille.table\" = \"{version}\"")
}

/// A temporary folder that is removed on drop.
struct TableTestFolder(PathBuf);

impl TableTestFolder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("reveille-table-{}-{name}", std::process::id()));
        fs::create_dir_all(&path).expect("writable");
        Self(path)
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }
}

impl Drop for TableTestFolder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

#[test]
fn tables_round_trip_in_both_formats() {
    let folder = TableTestFolder::new("formats");
    let table = fixtures::table();
    for name in ["t.parquet", "t.csv"] {
        let path = folder.path(name);
        table.write(&path, Format::from_path(&path)).expect("written");
        assert_eq!(Table::read(&path).expect("read"), table, "{name}");
        let first_bytes = fs::read(&path).expect("there");
        table.write(&path, Format::from_path(&path)).expect("written");
        assert_eq!(fs::read(&path).expect("there"), first_bytes, "{name}, written again");
    }
    assert!(!folder.path("t.parquet.part").exists());
}

#[test]
fn empty_and_large_tables_round_trip() {
    let folder = TableTestFolder::new("sizes");
    let path = folder.path("t.parquet");
    let mut table = fixtures::table();
    let rows = std::mem::take(&mut table.rows);
    table.write(&path, Format::Parquet).expect("written");
    assert_eq!(Table::read(&path).expect("read"), table);
    // More rows than fit into two row groups of the file.
    table.rows = rows.iter().cycle().take(150_001).cloned().collect();
    table.write(&path, Format::Parquet).expect("written");
    assert!(Table::read(&path).expect("read") == table);
}

#[test]
fn tables_with_former_names_are_read() {
    let folder = TableTestFolder::new("former");
    let path = folder.path("t.csv");
    let mut table = fixtures::table();
    table.write(&path, Format::Csv).expect("written");
    let (today, version_1) = (version_line(TABLE_VERSION), version_line(1));
    for (file, new_text, old_text) in [
        ("t.csv", ",unpowered_pct", ",dark_pct"),
        ("t.csv", ",removed_pct", ",gone_pct"),
        ("t.csv.toml", today.as_str(), version_1.as_str()),
    ] {
        let file = folder.path(file);
        let text = fs::read_to_string(&file).expect("there");
        assert!(text.contains(new_text), "{new_text}");
        fs::write(&file, text.replace(new_text, old_text)).expect("written");
    }
    // Runs of such a table are not reused.
    table.metadata.version += ", with tables of version 1";
    assert_eq!(Table::read(&path).expect("a table of version 1"), table);
}

#[test]
fn invalid_files_are_refused_with_the_reason() {
    let folder = TableTestFolder::new("refused");
    let path = folder.path("t.csv");
    let table = fixtures::table();
    table.write(&path, Format::Csv).expect("written");
    let sidecar = folder.path("t.csv.toml");
    let text = fs::read_to_string(&sidecar).expect("a side-car");
    let newer_version = TABLE_VERSION + 1;
    let newer = text.replace(&version_line(TABLE_VERSION), &version_line(newer_version));
    assert_ne!(newer, text);
    fs::write(&sidecar, newer).expect("written");
    let message = Table::read(&path).expect_err("another version").to_string();
    assert!(
        message.contains(&format!("version {newer_version}")) && message.contains("t.csv"),
        "{message}"
    );
    fs::remove_file(&sidecar).expect("a side-car");
    assert_eq!(Table::read(&path).expect("no side-car is needed").rows, table.rows);
    for (from, to, cause) in [
        (
            "\"reveille.rows\" = \"5\"",
            "\"reveille.rows\" = \"6\"",
            "5 rows, but its side-car says 6",
        ),
        ("float,int,text", "float,int", "lists 2 swept columns, but it has 3"),
        ("float,int,text", "float,int,colour", "reveille.kinds"),
    ] {
        let changed = text.replace(from, to);
        assert_ne!(changed, text);
        fs::write(&sidecar, changed).expect("written");
        let message = Table::read(&path).expect_err(to).to_string();
        assert!(message.contains(cause), "{message}");
    }
    fs::remove_file(&sidecar).expect("a side-car");

    for (text, cause) in [
        ("a,b\n1,2\n", "not a result table"),
        ("", "cut off"),
        ("scenario_hash,preset\n", "no column `policy`"),
    ] {
        fs::write(&path, text).expect("written");
        let message = Table::read(&path).expect_err(text).to_string();
        assert!(message.contains(cause), "{text:?}: {message}");
    }
    let message = Table::read(&folder.path("none.parquet"))
        .expect_err("not there")
        .to_string();
    assert!(
        message.contains("none.parquet: no such file; name a table"),
        "{message}"
    );
}

#[test]
fn text_of_digits_stays_text() {
    let folder = TableTestFolder::new("kinds");
    let mut table = fixtures::table();
    for row in &mut table.rows {
        row.swept = [
            SweptValue::Float(2.0),
            SweptValue::Int(4),
            SweptValue::Text("5".to_owned()),
        ]
        .into();
    }
    let path = folder.path("t.csv");
    table.write(&path, Format::Csv).expect("written");
    assert_eq!(Table::read(&path).expect("read"), table);
    table.schema.swept[2].1 = ColumnType::Int;
    let message = table
        .write(&folder.path("t.parquet"), Format::Parquet)
        .expect_err("text among numbers")
        .to_string();
    assert!(message.contains("`5` is in a column of whole numbers"), "{message}");
}

#[test]
fn a_table_of_version_2_lacks_later_metrics() {
    let folder = TableTestFolder::new("version-2");
    let path = folder.path("t.csv");
    let mut table = fixtures::table();
    table.write(&path, Format::Csv).expect("written");
    let text = fs::read_to_string(&path).expect("there");
    let mut reader = ::csv::ReaderBuilder::new()
        .has_headers(false)
        .from_reader(text.as_bytes());
    let records: Vec<::csv::StringRecord> = reader.records().collect::<Result<_, _>>().expect("CSV");
    let mut writer = ::csv::Writer::from_writer(Vec::new());
    for record in &records {
        let fields = record.iter().zip(&records[0]);
        let kept = fields.filter(|(_, name)| !Metrics::ADDED_LATER.contains(name));
        writer.write_record(kept.map(|(field, _)| field)).expect("in memory");
    }
    let shorter = writer.into_inner().expect("in memory");
    fs::write(&path, shorter).expect("written");
    for row in &mut table.rows {
        for name in Metrics::ADDED_LATER {
            let index = Metrics::NAMES.iter().position(|metric| *metric == name);
            row.metrics[index.expect("a metric")] = f64::NAN;
        }
    }
    assert_eq!(Table::read(&path).expect("a table of version 2"), table);
    let without_p1 = text.replacen("info_p1,", "other,", 1);
    fs::write(&path, without_p1).expect("written");
    let message = Table::read(&path).expect_err("a missing metric").to_string();
    assert!(message.contains("no column `info_p1`"), "{message}");
}

#[test]
fn a_parquet_file_of_another_version_is_refused() {
    use ::parquet::file::reader::{FileReader, SerializedFileReader};
    use reveille_common::parquet::Writer;

    let folder = TableTestFolder::new("parquet-version");
    let path = folder.path("t.parquet");
    fixtures::table().write(&path, Format::Parquet).expect("written");
    let read_with_version = |version: u32| {
        let reader = SerializedFileReader::new(fs::File::open(&path).expect("there")).expect("Parquet");
        let metadata = reader.metadata().file_metadata();
        let file = fs::File::create(folder.path("other.parquet")).expect("writable");
        let pairs = metadata.key_value_metadata().expect("ours").iter().map(|pair| {
            let value = pair.value.clone().filter(|_| pair.key != metadata::TABLE_VERSION_KEY);
            (pair.key.clone(), value.unwrap_or_else(|| version.to_string()))
        });
        let writer = Writer::begin(file, metadata.schema().clone(), pairs);
        writer.and_then(Writer::finish).expect("written");
        Table::read(&folder.path("other.parquet"))
    };
    assert!(read_with_version(TABLE_VERSION).expect("this version").rows.is_empty());
    let newer_version = TABLE_VERSION + 1;
    let message = read_with_version(newer_version)
        .expect_err("another version")
        .to_string();
    for part in [
        "other.parquet",
        &format!("version {newer_version}"),
        // The version of the fixture.
        "by reveille 0.1.0",
        &format!("reads versions 1 to {TABLE_VERSION}"),
    ] {
        assert!(message.contains(part), "{message}");
    }
}

#[test]
fn a_truncated_file_is_refused_at_every_length() {
    let folder = TableTestFolder::new("truncated");
    for name in ["t.parquet", "t.csv"] {
        let path = folder.path(name);
        fixtures::table()
            .write(&path, Format::from_path(&path))
            .expect("written");
        let bytes = fs::read(&path).expect("there");
        for length in 0..bytes.len() {
            fs::write(&path, &bytes[..length]).expect("written");
            match Table::read(&path) {
                Err(_) => {}
                Ok(_) => panic!("{name}: {length} of {} bytes were accepted", bytes.len()),
            }
        }
    }
}

#[test]
fn a_write_into_a_missing_folder_names_the_file() {
    let folder = TableTestFolder::new("write");
    let message = fixtures::table()
        .write(&folder.path("no/such/t.parquet"), Format::Parquet)
        .expect_err("no such folder")
        .to_string();
    assert!(message.contains("t.parquet: cannot be written"), "{message}");
}
