//! Tables written, read back, and broken.

use std::fs;
use std::path::PathBuf;

use super::*;

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
fn both_formats_give_back_what_was_written() {
    let folder = TableTestFolder::new("formats");
    let table = fixtures::table();
    for name in ["t.parquet", "t.csv"] {
        let path = folder.path(name);
        table.write(&path, Format::from_path(&path)).expect("written");
        assert_eq!(Table::read(&path).expect("read"), table, "{name}");
        let first = fs::read(&path).expect("there");
        table.write(&path, Format::from_path(&path)).expect("written");
        assert_eq!(fs::read(&path).expect("there"), first, "the same bytes again");
    }
    assert!(!folder.path("t.parquet.part").exists());
}

#[test]
fn an_empty_table_and_one_of_many_groups_are_read() {
    let folder = TableTestFolder::new("sizes");
    let path = folder.path("t.parquet");
    let mut table = fixtures::table();
    let rows = std::mem::take(&mut table.rows);
    table.write(&path, Format::Parquet).expect("written");
    assert_eq!(Table::read(&path).expect("read"), table);
    table.rows = rows.iter().cycle().take(150_001).cloned().collect();
    table.write(&path, Format::Parquet).expect("written");
    assert!(Table::read(&path).expect("read") == table);
}

#[test]
fn tables_with_former_names_are_read() {
    let folder = TableTestFolder::new("former");
    let path = folder.path("t.csv");
    let table = fixtures::table();
    table.write(&path, Format::Csv).expect("written");
    for (file, current, former) in [
        ("t.csv", "unpowered_pct", "dark_pct"),
        ("t.csv", "removed_pct", "gone_pct"),
        ("t.csv.toml", "\"reveille.table\" = \"2\"", "\"reveille.table\" = \"1\""),
    ] {
        let file = folder.path(file);
        let text = fs::read_to_string(&file).expect("there");
        assert!(text.contains(current), "{current}");
        fs::write(&file, text.replace(current, former)).expect("written");
    }
    assert_eq!(Table::read(&path).expect("a table of version 1"), table);
}

#[test]
fn other_versions_and_other_files_are_refused() {
    let folder = TableTestFolder::new("refused");
    let path = folder.path("t.csv");
    let table = fixtures::table();
    table.write(&path, Format::Csv).expect("written");
    let side = folder.path("t.csv.toml");
    let text = fs::read_to_string(&side).expect("there");
    let newer = text.replace("\"reveille.table\" = \"2\"", "\"reveille.table\" = \"7\"");
    assert_ne!(newer, text);
    fs::write(&side, newer).expect("written");
    let message = Table::read(&path).expect_err("another version").to_string();
    assert!(message.contains("version 7") && message.contains("t.csv"), "{message}");
    fs::remove_file(&side).expect("there");
    assert_eq!(Table::read(&path).expect("no side-car is needed").rows, table.rows);
    for (from, to, part) in [
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
        fs::write(&side, changed).expect("written");
        let message = Table::read(&path).expect_err(to).to_string();
        assert!(message.contains(part), "{message}");
    }
    fs::remove_file(&side).expect("there");

    for (text, part) in [
        ("a,b\n1,2\n", "not a result table"),
        ("", "cut off"),
        ("scenario_hash,preset\n", "no column `policy`"),
    ] {
        fs::write(&path, text).expect("written");
        let message = Table::read(&path).expect_err(text).to_string();
        assert!(message.contains(part), "{text:?}: {message}");
    }
    let message = Table::read(&folder.path("none.parquet"))
        .expect_err("not there")
        .to_string();
    assert!(message.contains("none.parquet: cannot be read"), "{message}");
}

#[test]
fn text_that_looks_like_numbers_stays_text() {
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
fn a_parquet_file_of_another_version_is_refused() {
    use ::parquet::file::reader::{FileReader, SerializedFileReader};
    use reveille_common::parquet::Writer;

    let folder = TableTestFolder::new("parquet-version");
    let path = folder.path("t.parquet");
    fixtures::table().write(&path, Format::Parquet).expect("written");
    let rewritten = |version: &str| {
        let reader = SerializedFileReader::new(fs::File::open(&path).expect("there")).expect("Parquet");
        let metadata = reader.metadata().file_metadata();
        let other = fs::File::create(folder.path("other.parquet")).expect("writable");
        let pairs = metadata.key_value_metadata().expect("ours").iter().map(|pair| {
            let value = pair.value.clone().filter(|_| pair.key != metadata::TABLE_VERSION_KEY);
            (pair.key.clone(), value.unwrap_or_else(|| version.to_owned()))
        });
        let writer = Writer::begin(other, metadata.schema().clone(), pairs);
        writer.and_then(Writer::finish).expect("written");
        Table::read(&folder.path("other.parquet"))
    };
    assert!(rewritten("2").expect("this version").rows.is_empty());
    let message = rewritten("7").expect_err("another version").to_string();
    for part in [
        "other.parquet",
        "version 7",
        "by reveille 0.1.0",
        "reads versions 1 to 2",
    ] {
        assert!(message.contains(part), "{message}");
    }
}

#[test]
fn a_cut_file_is_refused_at_every_length() {
    let folder = TableTestFolder::new("cut");
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
                Ok(_) => panic!("{name} at {length} of {}", bytes.len()),
            }
        }
    }
}

#[test]
fn what_cannot_be_written_leaves_the_old_file() {
    let folder = TableTestFolder::new("write");
    let message = fixtures::table()
        .write(&folder.path("no/such/t.parquet"), Format::Parquet)
        .expect_err("no such folder")
        .to_string();
    assert!(message.contains("t.parquet: cannot be written"), "{message}");
}
