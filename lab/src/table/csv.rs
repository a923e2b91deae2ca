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
use super::{About, Failure, Refusal, Table, keys};

/// Where the side-car of the CSV file at `path` is.
pub(super) fn side_car(path: &Path) -> PathBuf {
    let mut name = OsString::from(path);
    name.push(".toml");
    PathBuf::from(name)
}

/// The side-car.
pub(super) fn side_car_text(table: &Table) -> String {
    let kinds: Vec<&str> = table.schema.swept.iter().map(|(_, kind)| kind.name()).collect();
    let own = [
        (keys::KINDS, kinds.join(",")),
        (keys::ROWS, table.rows.len().to_string()),
    ];
    let pairs = table.about.pairs().into_iter().chain(own);
    pairs.fold(String::new(), |mut text, (key, value)| {
        let _ = writeln!(text, "\"{key}\" = {}", toml::Value::String(value));
        text
    })
}

/// What the side-car says; nothing of it if there is none.
#[derive(Default)]
struct Side {
    about: About,
    kinds: Option<Vec<Kind>>,
    rows: Option<usize>,
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
    Ok(decode(&text, side_of(path)?)?)
}

/// What the table in the file at `path` says of itself.
pub(super) fn about(path: &Path) -> Result<About, Failure> {
    side_of(path).map(|side| side.about)
}

fn side_of(path: &Path) -> Result<Side, Failure> {
    match fs::read_to_string(side_car(path)) {
        Ok(text) => Ok(side(&text)?),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(Side::default()),
        Err(error) => Err(error.into()),
    }
}

fn side(text: &str) -> Result<Side, Refusal> {
    let pairs: BTreeMap<String, String> =
        toml::from_str(text).map_err(|error| Refusal::Broken(format!("its side-car: {}", error.message())))?;
    let broken = |key: &str| Refusal::Broken(format!("its side-car: {key} = \"{}\"", pairs[key].escape_default()));
    let kinds = pairs.get(keys::KINDS).map(|names| {
        let names = names.split(',').filter(|name| !name.is_empty());
        let kinds: Option<Vec<Kind>> = names.map(Kind::named).collect();
        kinds.ok_or_else(|| broken(keys::KINDS))
    });
    let rows = pairs
        .get(keys::ROWS)
        .map(|rows| rows.parse().map_err(|_| broken(keys::ROWS)));
    Ok(Side {
        about: About::from_pairs(|key| pairs.get(key).map(String::as_str))?,
        kinds: kinds.transpose()?,
        rows: rows.transpose()?,
    })
}

/// The swept columns: of the kinds that the side-car tells, or else of those that their values look like.
fn schema(names: &[&str], told: Option<Vec<Kind>>, records: &[csv::StringRecord]) -> Result<Schema, Refusal> {
    let names = Schema::swept_among(names)?;
    let kinds = told.unwrap_or_else(|| {
        let kind = |at: usize| {
            let kinds = records.iter().map(|record| guess(&record[IDENTITY.len() + at]));
            kinds.reduce(Kind::join).unwrap_or(Kind::Text)
        };
        (0..names.len()).map(kind).collect()
    });
    if kinds.len() != names.len() {
        let (told, found) = (kinds.len(), names.len());
        return Err(Refusal::Broken(format!(
            "its side-car tells of {told} swept columns, but it has {found}"
        )));
    }
    Ok(Schema {
        swept: names.into_iter().map(str::to_owned).zip(kinds).collect(),
    })
}

fn decode(text: &str, side: Side) -> Result<Table, Refusal> {
    let broken = |error: csv::Error| Refusal::Broken(error.to_string());
    if !text.ends_with('\n') {
        return Err(Refusal::Broken("its last row has no end".to_owned()));
    }
    let mut reader = csv::Reader::from_reader(text.as_bytes());
    let header = reader.headers().map_err(broken)?.clone();
    let records = reader.records().collect::<Result<Vec<_>, _>>().map_err(broken)?;
    let schema = schema(&header.iter().collect::<Vec<_>>(), side.kinds, &records)?;
    if let Some(rows) = side.rows.filter(|rows| *rows != records.len()) {
        let found = records.len();
        return Err(Refusal::Broken(format!(
            "it has {found} rows, but its side-car says {rows}"
        )));
    }
    Ok(Table {
        about: side.about,
        rows: rows(&schema, &records)?,
        schema,
    })
}

fn rows(schema: &Schema, records: &[csv::StringRecord]) -> Result<Vec<Row>, Refusal> {
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
    Ok(rows)
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
