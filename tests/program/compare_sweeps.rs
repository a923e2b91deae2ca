//! `compare` on sweeps: paired differences between policies, computed again from the CSV table.

use std::collections::BTreeMap;

use reveille_tests::process::{TestFolder, assert_refused};
use serde_json::Value;

/// The two-sided 95 % quantiles of Student's t with 6 degrees of freedom, from a printed table.
const T_6: f64 = 2.446_912;
const SWEEP: &str = "sweep --policies random,knn,age-index --devices 20,40 --ttis 900 --seeds 7 --format csv --quiet";

/// Reads a metric of a CSV table by policy, N and seed.
fn metric(table: &str, name: &str) -> BTreeMap<(String, u32, u64), f64> {
    let mut lines = table.lines();
    let header: Vec<&str> = lines.next().expect("a header").split(',').collect();
    let at = |name: &str| header.iter().position(|known| *known == name).expect("a column");
    let columns = [at("policy"), at("n"), at("seed"), at(name)];
    let row = |line: &str| {
        let cells: Vec<&str> = line.split(',').collect();
        let [policy, n, seed, value] = columns.map(|column| cells[column]);
        let key = (policy.to_owned(), n.parse().expect("N"), seed.parse().expect("a seed"));
        Some((key, value.parse().ok()?))
    };
    lines.filter_map(row).collect()
}

#[test]
fn differences_of_policies_equal_those_of_the_table() {
    let folder = TestFolder::new();
    let end = folder.run(&format!("{SWEEP} --out s"));
    assert!(end.is_success(), "{end}");
    let table = String::from_utf8(folder.bytes("s/results.csv")).expect("text");
    let names = ["info_p1", "energy_per_device_tti", "mean_battery"];
    let end = folder.run(&format!("compare s --against knn --metric {} --json", names.join(",")));
    let report: Value = serde_json::from_str(&end.stdout).expect("JSON");
    assert_eq!(report["against"], "knn");
    let rows = report["conditions"][0]["differences"].as_array().expect("rows");
    assert_eq!(rows.len(), 3 * 2 * 2, "metrics, policies and N: {report}");
    for row in rows {
        let (name, policy) = (
            row["metric"].as_str().expect("text"),
            row["policy"].as_str().expect("text"),
        );
        let n = u32::try_from(row["n"].as_u64().expect("N")).expect("small");
        let values = metric(&table, name);
        let differences: Vec<f64> = (1..=7)
            .map(|seed| values[&(policy.to_owned(), n, seed)] - values[&("knn".to_owned(), n, seed)])
            .collect();
        let mean = differences.iter().sum::<f64>() / 7.0;
        let variance = differences.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / 6.0;
        let half_width = T_6 * (variance / 7.0).sqrt();
        for (key, expected) in [("difference", mean), ("half_width", half_width)] {
            let found = row[key].as_f64().expect("a number");
            assert!(
                (found - expected).abs() < 1e-5 * expected.abs(),
                "{key} of {row}: {expected}"
            );
        }
        assert_eq!((&row["seeds"], &row["paired"]), (&7.into(), &true.into()));
    }
    let by_default = folder.run("compare s/results.csv");
    let text = &by_default.stdout;
    for part in [
        "differences from random over the same seeds",
        "\nmisdetection_pct, % of events\n",
        "\nage-index    40",
    ] {
        assert!(text.contains(part), "no {part:?}: {by_default}");
    }
    assert!(text.lines().all(|line| line.chars().count() <= 80), "{by_default}");
}

#[test]
fn two_sweeps_are_compared_over_their_common_seeds() {
    let folder = TestFolder::new();
    for (args, out) in [("--policies knn --seeds 4", "a"), ("--policies random --seeds 6", "b")] {
        let end = folder.run(&format!("sweep {args} --devices 20 --ttis 600 --quiet --out {out}"));
        assert!(end.is_success(), "{end}");
    }
    let end = folder.run("compare a b --metric info_p1 --json");
    let report: Value = serde_json::from_str(&end.stdout).expect("JSON");
    let row = &report["conditions"][0]["differences"][0];
    assert_eq!(
        (&row["policy"], &row["seeds"]),
        (&"random".into(), &4.into()),
        "{report}"
    );
    // Other conditions are not compared with each other.
    let end = folder.run("sweep --policies random --seeds 4 --devices 20 --ttis 700 --quiet --out c");
    assert!(end.is_success(), "{end}");
    assert_refused(&folder.run("compare a c"), 1, &["no other policy has runs", "knn"]);
}

#[test]
fn wrong_requests_are_refused() {
    let folder = TestFolder::new();
    let end = folder.run("sweep --policies knn,random --seeds 2 --devices 20 --ttis 300 --quiet --out s");
    assert!(end.is_success(), "{end}");
    assert!(folder.run("run -s quick --quiet --out r").is_success());
    for (args, code, part) in [
        (
            "s --against dt",
            1,
            "--against dt: the sweep has no runs of this policy; use one of knn, random",
        ),
        ("s --exit-code", 2, "--exit-code needs runs"),
        ("s r", 2, "sweeps and runs do not compare"),
        ("r r --against knn", 2, "--against and --metric need a sweep"),
        ("nowhere.parquet", 1, "nowhere.parquet: no such file; name a table"),
    ] {
        assert_refused(&folder.run(&format!("compare {args}")), code, &[part]);
    }
}
