//! Result tables as CSV files. What Parquet keeps in its metadata lies in a side-car, `NAME.csv.toml`.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::Arc;

use super::columns::{IDENTITY, Kind, METRICS, Schema, Value};
use super::parquet::Shared;
use super::row::Row;
use super::{About, Failure, Refusal, Table};

/// Where the side-car of the CSV file at `path` is.
pub(super) fn side_car(path: &Path) -> PathBuf {
    let mut name = OsString::from(path);
    name.push(".toml");
    PathBuf::from(name)
}

/// The side-car.
pub(super) fn side_car_text(about: &About) -> String {
    about.pairs().into_iter().fold(String::new(), |mut text, (key, value)| {
        let _ = writeln!(text, "\"{key}\" = {}", toml::Value::String(value));
        text
    })
}

/// The bytes of the file of `table`. Numbers are written so that they read back as the same bits.
pub(super) fn to_bytes(table: &Table) -> Result<Vec<u8>, String> {
    encode(table).map_err(|error| error.to_string())
}

fn encode(table: &Table) -> Result<Vec<u8>, csv::Error> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    writer.write_record(table.schema.names())?;
    for row in &table.rows {
        let identity = [
            row.scenario_hash.to_string(),
            row.preset.to_string(),
            row.policy.to_string(),
            row.n.to_string(),
            row.ttis.to_string(),
            row.seed.to_string(),
        ];
        let swept = row.swept.iter().map(written);
        let metrics = row.metrics.iter().map(|value| {
            if value.is_nan() {
                String::new()
            } else {
                value.to_string()
            }
        });
        let tail = [row.events.to_string(), row.digest.to_string()];
        writer.write_record(identity.into_iter().chain(swept).chain(metrics).chain(tail))?;
    }
    writer.into_inner().map_err(|error| error.into_error().into())
}

/// A swept value; a number that happens to be whole keeps its point, so that its column stays one of numbers.
fn written(value: &Value) -> String {
    match value {
        Value::Float(value) => format!("{value:?}"),
        Value::Int(_) | Value::Text(_) => value.to_string(),
    }
}

/// Reads the table in the file at `path`, and its side-car if it is there.
pub(super) fn read(path: &Path) -> Result<Table, Failure> {
    let text = fs::read_to_string(path)?;
    let about = match fs::read_to_string(side_car(path)) {
        Ok(text) => about(&text)?,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => About::default(),
        Err(error) => return Err(error.into()),
    };
    Ok(decode(&text, about)?)
}

fn about(text: &str) -> Result<About, Refusal> {
    let pairs: BTreeMap<String, String> =
        toml::from_str(text).map_err(|error| Refusal::Broken(format!("its side-car: {}", error.message())))?;
    About::from_pairs(|key| pairs.get(key).map(String::as_str))
}

fn decode(text: &str, about: About) -> Result<Table, Refusal> {
    let broken = |error: csv::Error| Refusal::Broken(error.to_string());
    if !text.ends_with('\n') {
        return Err(Refusal::Broken("its last row has no end".to_owned()));
    }
    let mut reader = csv::Reader::from_reader(text.as_bytes());
    let header = reader.headers().map_err(broken)?.clone();
    let names: Vec<&str> = header.iter().collect();
    let names: Vec<String> = Schema::swept_among(&names)?.into_iter().map(str::to_owned).collect();
    let records = reader.records().collect::<Result<Vec<_>, _>>().map_err(broken)?;
    let mut schema = Schema::default();
    for (at, name) in names.into_iter().enumerate() {
        let kinds = records.iter().map(|record| guess(&record[IDENTITY.len() + at]));
        let kind = kinds.reduce(Kind::join).unwrap_or(Kind::Text);
        schema.swept.push((name, kind));
    }
    let (mut preset, mut policy, mut cell) = (Shared::default(), Shared::default(), Arc::from([]));
    let mut rows = Vec::with_capacity(records.len());
    for (number, record) in records.iter().enumerate() {
        let fields = Fields { record, number };
        let swept: Vec<Value> = schema
            .swept
            .iter()
            .enumerate()
            .map(|(at, (_, kind))| fields.swept(IDENTITY.len() + at, *kind))
            .collect::<Result<_, _>>()?;
        if *cell != *swept {
            cell = Arc::from(swept);
        }
        let first = IDENTITY.len() + schema.swept.len();
        let mut metrics = [f64::NAN; METRICS];
        for (at, slot) in metrics.iter_mut().enumerate() {
            if !record[first + at].is_empty() {
                *slot = fields.get(first + at)?;
            }
        }
        rows.push(Row {
            scenario_hash: fields.get(0)?,
            preset: preset.of(&record[1]),
            policy: policy.of(&record[2]),
            n: fields.get(3)?,
            ttis: fields.get(4)?,
            seed: fields.get(5)?,
            swept: Arc::clone(&cell),
            metrics,
            events: fields.get(first + METRICS)?,
            digest: fields.get(first + METRICS + 1)?,
        });
    }
    Ok(Table { about, schema, rows })
}

/// What a cell seems to hold.
fn guess(text: &str) -> Kind {
    if text.parse::<i64>().is_ok() {
        Kind::Int
    } else if text.parse::<f64>().is_ok() {
        Kind::Float
    } else {
        Kind::Text
    }
}

/// One row of the file.
struct Fields<'r> {
    record: &'r csv::StringRecord,
    number: usize,
}

impl Fields<'_> {
    fn get<T: FromStr>(&self, at: usize) -> Result<T, Refusal> {
        let text = &self.record[at];
        text.parse().map_err(|_| {
            let row = self.number + 1;
            Refusal::Broken(format!("row {row}, field {}: \"{}\"", at + 1, text.escape_default()))
        })
    }

    fn swept(&self, at: usize, kind: Kind) -> Result<Value, Refusal> {
        Ok(match kind {
            Kind::Int => Value::Int(self.get(at)?),
            Kind::Float => Value::Float(self.get(at)?),
            Kind::Text => Value::Text(self.record[at].to_owned()),
        })
    }
}
