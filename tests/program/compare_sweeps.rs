//! `compare` on sweeps: paired differences between policies and between sweeps equal a second computation from the CSV
//! tables of the sweeps; invalid requests are refused. The tests depend on JSON keys and texts of
//! `deploy/src/commands/compare/`, `sweep.rs` and `tables.rs` there. `compare.rs` compares runs.

use std::collections::BTreeMap;

use reveille_tests::process::{TestFolder, assert_refused};
use serde_json::Value;

/// Seeds of [`SWEEP`], 1 to this number; [`SWEEP`] and [`T_QUANTILE`] have to match it.
const SEEDS: u64 = 7;
/// The two-sided 95 % quantile of Student's t with [`SEEDS`] - 1 degrees of freedom, from a printed table.
const T_QUANTILE: f64 = 2.446_912;
/// Sweep with a CSV table.
const SWEEP: &str = "sweep --policies random,age-index,knn --devices 20,40 --ttis 900 --seeds 7 --format csv --quiet";

/// Values of a metric by policy, N and seed.
type MetricValues = BTreeMap<(String, u32, u64), f64>;

/// Reads the metric `name` of the result table `table`, in CSV. Rows without a value are left out.
fn read_metric(table: &str, name: &str) -> MetricValues {
    let mut lines = table.lines();
    let header: Vec<&str> = lines.next().expect("a header").split(',').collect();
    let column = |name: &str| header.iter().position(|known| *known == name).expect("a column");
    let columns = ["policy", "n", "seed", name].map(column);
    let parse_row = |line: &str| {
        let cells: Vec<&str> = line.split(',').collect();
        let [policy, n, seed, value] = columns.map(|column| cells[column]);
        let key = (policy.to_owned(), n.parse().expect("N"), seed.parse().expect("a seed"));
        Some((key, value.parse().ok()?))
    };
    lines.filter_map(parse_row).collect()
}

/// Checks `difference` and `half_width` of a row of the report against the differences of the single seeds.
fn assert_interval(row: &Value, differences: &[f64]) {
    let n = differences.len() as f64;
    let mean = differences.iter().sum::<f64>() / n;
    let variance = differences.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / (n - 1.0);
    for (key, expected) in [("difference", mean), ("half_width", T_QUANTILE * (variance / n).sqrt())] {
        let reported = row[key].as_f64().expect("a number");
        assert!(
            (reported - expected).abs() < 1e-5 * expected.abs(),
            "{key} of {row}: {expected}"
        );
    }
}

/// Half the width of the interval of the ratio of the means of `policy` and knn, from the moments of both and their
/// covariance: (s_a² - 2 r s_ab + r² s_b²) / (n b²), with r = a / b.
fn ratio_half_width(values: &MetricValues, policy: &str, n: u32) -> f64 {
    let of_policy =
        |policy: &str| -> Vec<f64> { (1..=SEEDS).map(|seed| values[&(policy.to_owned(), n, seed)]).collect() };
    let (a, b) = (of_policy(policy), of_policy("knn"));
    let count = SEEDS as f64;
    let mean = |list: &[f64]| list.iter().sum::<f64>() / count;
    let covariance = |x: &[f64], y: &[f64]| {
        let (mean_x, mean_y) = (mean(x), mean(y));
        let products = x.iter().zip(y).map(|(x, y)| (x - mean_x) * (y - mean_y));
        products.sum::<f64>() / (count - 1.0)
    };
    let ratio = mean(&a) / mean(&b);
    let variance = covariance(&a, &a) - 2.0 * ratio * covariance(&a, &b) + ratio * ratio * covariance(&b, &b);
    T_QUANTILE * (variance / count).sqrt() / mean(&b)
}

#[test]
fn differences_of_policies_equal_those_of_the_table() {
    let folder = TestFolder::new();
    let finished = folder.run(&format!("{SWEEP} --out s"));
    assert!(finished.is_success(), "{finished}");
    let table = String::from_utf8(folder.bytes("s/results.csv")).expect("text");
    let names = ["info_p1", "energy_per_device_tti", "mean_battery"];
    let finished = folder.run(&format!("compare s --against knn --metric {} --json", names.join(",")));
    let report: Value = serde_json::from_str(&finished.stdout).expect("JSON");
    assert_eq!(report["against"], "knn");
    let rows = report["conditions"][0]["differences"].as_array().expect("rows");
    assert_eq!(rows.len(), 3 * 2 * 2, "metrics, policies and N: {report}");
    for row in rows {
        let (name, policy) = (
            row["metric"].as_str().expect("text"),
            row["policy"].as_str().expect("text"),
        );
        let n = u32::try_from(row["n"].as_u64().expect("N")).expect("small");
        let values = read_metric(&table, name);
        let differences: Vec<f64> = (1..=SEEDS)
            .map(|seed| values[&(policy.to_owned(), n, seed)] - values[&("knn".to_owned(), n, seed)])
            .collect();
        assert_interval(row, &differences);
        let ratios = ratio_half_width(&values, policy, n);
        let share_half_width = row["share_half_width"].as_f64().expect("a number");
        assert!((share_half_width - ratios).abs() < 1e-5 * ratios, "{row}: {ratios}");
        assert_eq!((&row["seeds"], &row["paired"]), (&SEEDS.into(), &true.into()));
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
    // The order of figures, not the one of the command line or the alphabet.
    let rows = text.lines().map(|line| line.split_whitespace().next());
    let mut policies: Vec<&str> = rows
        .flatten()
        .filter(|word| ["knn", "age-index"].contains(word))
        .collect();
    policies.dedup();
    assert_eq!(policies, ["knn", "age-index"].repeat(5), "{by_default}");
}

#[test]
fn two_sweeps_are_compared_over_their_common_seeds() {
    let folder = TestFolder::new();
    for (args, out) in [("--policies knn --seeds 4", "a"), ("--policies random --seeds 6", "b")] {
        let finished = folder.run(&format!("sweep {args} --devices 20 --ttis 600 --quiet --out {out}"));
        assert!(finished.is_success(), "{finished}");
    }
    let finished = folder.run("compare a b --metric info_p1 --json");
    let report: Value = serde_json::from_str(&finished.stdout).expect("JSON");
    let row = &report["conditions"][0]["differences"][0];
    assert_eq!(
        (&row["policy"], &row["seeds"]),
        (&"random".into(), &4.into()),
        "{report}"
    );
    // Other conditions are not compared with each other.
    let finished = folder.run("sweep --policies random --seeds 4 --devices 20 --ttis 700 --quiet --out c");
    assert!(finished.is_success(), "{finished}");
    assert_refused(
        &folder.run("compare a c"),
        1,
        &["nothing to compare", "--policies knn,random"],
    );
    for (policies, ttis, out) in [("knn,random", 600, "both"), ("genie", 700, "other")] {
        let sweep = format!("sweep --policies {policies} --seeds 2 --devices 20 --ttis {ttis} --quiet --out {out}");
        let finished = folder.run(&sweep);
        assert!(finished.is_success(), "{finished}");
    }
    let finished = folder.run("compare both a other");
    let note = |name: &str| {
        finished
            .stderr
            .contains(&format!("{name}/results.parquet: not compared with both"))
    };
    assert!(finished.is_success() && note("other") && !note("a"), "{finished}");
}

#[test]
fn sweeps_are_compared_by_policy_and_n() {
    let folder = TestFolder::new();
    folder.write("script", "from 0 every 100 fail 0-9 for 60 at random\n");
    // Sweep `both` differs from `calm` in actions and in fields. The text wraps at 80 columns, so the names of the
    // folders determine its line ends below.
    for (args, out) in [
        ("", "calm"),
        ("--actions script", "acted"),
        (
            "--actions script --set events.alpha=0.3 --set radio.uplink_loss=0.2",
            "both",
        ),
    ] {
        let sweep = SWEEP.replace("random,age-index,knn", "knn");
        let finished = folder.run(&format!("{sweep} {args} --out {out}"));
        assert!(finished.is_success(), "{finished}");
    }
    let finished = folder.run("compare calm acted both --all-metrics --json");
    assert!(finished.is_success(), "{finished}");
    let report: Value = serde_json::from_str(&finished.stdout).expect("JSON");
    let changed_fields = serde_json::json!({"events.alpha": ["0.2", "0.3"], "radio.uplink_loss": ["0.0", "0.2"]});
    for (index, name, fields) in [(0, "acted", serde_json::json!({})), (1, "both", changed_fields)] {
        let comparison = &report["tables"][index];
        assert_eq!(comparison["table"], format!("{name}/results.csv"));
        assert_eq!(comparison["against_table"], "calm/results.csv");
        assert_eq!(
            (&comparison["actions_differ"], &comparison["fields"]),
            (&true.into(), &fields)
        );
        let tables = ["calm", name].map(|out| {
            let table = folder.bytes(&format!("{out}/results.csv"));
            String::from_utf8(table).expect("text")
        });
        for metric_name in ["info_p1", "energy_per_device_tti"] {
            let [calm_values, changed_values] = tables.each_ref().map(|table| read_metric(table, metric_name));
            for n in [20, 40] {
                let rows = comparison["differences"].as_array().expect("rows");
                let is_row = |row: &&Value| row["metric"] == metric_name && row["n"] == n;
                let row = rows.iter().find(is_row).expect("a row");
                let differences: Vec<f64> = (1..=SEEDS)
                    .map(|seed| ("knn".to_owned(), n, seed))
                    .map(|run| changed_values[&run] - calm_values[&run])
                    .collect();
                assert_interval(row, &differences);
            }
        }
    }
    let finished = folder.run("compare calm both");
    for part in [
        "differences of both/results.csv from calm/results.csv over the same seeds, with",
        "they differ in: actions, events.alpha = 0.2 | 0.3, radio.uplink_loss = 0.0 | 0.2",
        "with the actions of\nboth/results.csv",
        "\nknn       40     7",
    ] {
        assert!(finished.stdout.contains(part), "no {part:?}: {finished}");
    }
    assert!(
        finished.stdout.lines().all(|line| line.chars().count() <= 80),
        "{finished}"
    );
    // Under the same script, only the fields differ.
    let finished = folder.run("compare acted both");
    assert!(finished.stdout.contains("they differ in: events.alpha"), "{finished}");
    assert_refused(&folder.run("compare calm calm"), 1, &["no two settings of a policy"]);
}

#[test]
fn fields_of_a_scenario_file_are_named() {
    let folder = TestFolder::new();
    let finished = folder.run("run -k 100 -n 20 --set events.alpha=0.3 --set harvest.lambda=0.05 --quiet --out base");
    assert!(finished.is_success(), "{finished}");
    // The run folder's scenario has all fields; only those that differ from the preset are changes.
    for (out, source) in [("file", "-s base/scenario.toml"), ("preset", "-s paper")] {
        let finished = folder.run(&format!(
            "sweep {source} -p knn,random -n 20 -k 500 --seeds 3 --set radio.uplink_loss=0.1 --quiet --out {out}"
        ));
        assert!(finished.is_success(), "{finished}");
    }
    std::fs::remove_dir_all(folder.path().join("base")).expect("the run folder");
    let finished = folder.run("compare preset file --metric info_p1");
    for part in [
        "they differ in: events.alpha = 0.2 | 0.3, harvest.lambda = 0.1 | 0.05\n",
        "paper, events.alpha = 0.3, harvest.lambda = 0.05, radio.uplink_loss = 0.1",
    ] {
        assert!(finished.stdout.contains(part), "no {part:?}: {finished}");
    }
}

#[test]
fn wrong_requests_are_refused() {
    let folder = TestFolder::new();
    let finished = folder.run("sweep --policies knn,random --seeds 2 --devices 20 --ttis 300 --quiet --out s");
    assert!(finished.is_success(), "{finished}");
    assert!(folder.run("run -s quick --quiet --out r").is_success());
    for (args, code, part) in [
        (
            "s --against dt",
            1,
            "--against dt: the sweep has no runs of this policy; use one of knn, random",
        ),
        ("s --exit-code", 2, "--exit-code needs runs"),
        ("s r", 2, "sweeps and runs do not compare"),
        ("s nowhere", 1, "nowhere: no such file or folder; name a sweep folder"),
        ("r r --against knn", 2, "--against and --metric need a sweep"),
        ("nowhere.parquet", 1, "nowhere.parquet: no such file; name a table"),
    ] {
        assert_refused(&folder.run(&format!("compare {args}")), code, &[part]);
    }
}
